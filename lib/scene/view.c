#include "lib/scene/view.h"

#include "lib/base/error.h"
#include "lib/scene/view_frame.h"

#include <math.h>
#include <stdlib.h>

static const double radian = 3.14159265358979323846 / 180;

enum { DEFAULT_WIDTH = 1920, DEFAULT_HEIGHT = 1080, LARGEST = 32768 };

/* ---- checks ---- */

static bool all_finite(const double *values, int count)
{
    for (int k = 0; k < count; k++)
        if (!isfinite(values[k]))
            return false;
    return true;
}

static tl_status check_angles(const tl_view *v, const char *name, tl_error *error)
{
    if (!isfinite(v->heading) || !isfinite(v->roll))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the view's heading and roll must be finite numbers of degrees",
                       name);
    if (!(v->pitch >= -90 && v->pitch <= 90))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: a view with a pitch of %g degrees was asked for; -90 (down) to 90 (up) is possible", name,
                       v->pitch);
    if (!(v->fov == 0 || (v->fov >= 0.01 && v->fov <= 179)))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: a field of view of %g degrees was asked for; 0.01 to 179 is possible", name, v->fov);
    if (!(v->refraction >= 0 && v->refraction <= 0.9))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: a refraction of %g was asked for; 0 to 0.9 is possible", name,
                       v->refraction);
    return TL_OK;
}

static tl_status check_position(const tl_view *v, const double position[3], const char *what, bool global,
                                const char *name, tl_error *error)
{
    if (!all_finite(position, 3))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the %s of the view must be three finite numbers", name, what);
    if (global && !v->projected && !(fabs(position[1]) <= 90 && fabs(position[0]) <= 540))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: the %s is at longitude %.10g and latitude %.10g, and there are none such; to give CRS "
                       "coordinates, say so",
                       name, what, position[0], position[1]);
    return TL_OK;
}

static tl_status check(const tl_view *v, const tl_source *dem, tl_error *error)
{
    const char *name = dem->info.name;
    bool global = dem->info.georef.crs && dem->info.georef.located;
    tl_status status = check_angles(v, name, error);
    if (status == TL_OK)
        status = check_position(v, v->eye, "eye", global, name, error);
    if (status == TL_OK && v->target_given)
        status = check_position(v, v->target, "target", global, name, error);
    bool both = v->width == 0 && v->height == 0;
    if (status == TL_OK && !both && !(v->width >= 1 && v->width <= LARGEST && v->height >= 1 && v->height <= LARGEST))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: a view of %d x %d pixels was asked for; 1 to %d is possible",
                       name, v->width, v->height, LARGEST);
    return status;
}

/* ---- ground ---- */

static tl_status off_ground(const tl_source *dem, const char *what, double i, double j, const char *why,
                            tl_error *error)
{
    return tl_fail(error, TL_ERROR_ARGUMENT,
                   "%s: the %s, over column %.1f, row %.1f, is %s, so there is no height above ground; give it above "
                   "the datum, or move it",
                   dem->info.name, what, i, j, why);
}

tl_status scene_ground_height(const tl_source *dem, const char *what, double i, double j, double *out, tl_error *error)
{
    const tl_source_info *info = &dem->info;
    /* an outermost cell of an area raster reaches half a cell beyond its centre, and is level there */
    double reach = info->type == TL_RASTER_AREA ? 0.5 : 1e-6, right = (double)(info->width - 1),
           bottom = (double)(info->height - 1);
    if (!(i >= -reach && j >= -reach && i <= right + reach && j <= bottom + reach))
        return off_ground(dem, what, i, j, "not on the raster", error);
    i = fmin(fmax(i, 0), right);
    j = fmin(fmax(j, 0), bottom);
    tl_window w = {(int64_t)i, (int64_t)j, 1, 1};
    double u = i - (double)w.x, v = j - (double)w.y, sum = 0;
    w.width += u > 0;
    w.height += v > 0;
    float heights[4] = {0};
    tl_status status = tl_source_read(dem, info->level, w, heights, error);
    if (status != TL_OK)
        return status;
    for (int64_t k = 0; k < w.width * w.height; k++) {
        bool east = k % w.width, south = k >= w.width;
        sum += (east ? u : 1 - u) * (south ? v : 1 - v) * (double)heights[k];
    }
    if (!isfinite(sum))
        return off_ground(dem, what, i, j, "in a void", error);
    *out = sum * info->georef.height_unit;
    return TL_OK;
}

/* Metres above the datum of a position. */
static tl_status height_of(const scene_view *self, const double position[2], const char *what, bool above, double given,
                           double *out, tl_error *error)
{
    *out = given;
    if (!above)
        return TL_OK;
    double i, j, ground = 0;
    scene_places_sample(self->places, position, &i, &j);
    tl_status status = scene_ground_height(self->dem, what, i, j, &ground, error);
    *out = given + ground;
    return status;
}

/* ---- the camera ---- */

static void aim(scene_camera *c, double heading, double pitch)
{
    double h = heading * radian, p = pitch * radian;
    const double ahead[3] = {sin(h) * cos(p), cos(h) * cos(p), sin(p)}, right[3] = {cos(h), -sin(h), 0},
                 down[3] = {sin(h) * sin(p), cos(h) * sin(p), -cos(p)};
    for (int a = 0; a < 3; a++) {
        c->ahead[a] = ahead[a];
        c->right[a] = right[a];
        c->down[a] = down[a];
    }
}

static void roll(scene_camera *c, double degrees)
{
    double cosine = cos(degrees * radian), sine = sin(degrees * radian);
    for (int a = 0; a < 3 && degrees != 0; a++) {
        double right = c->right[a], down = c->down[a];
        c->right[a] = right * cosine + down * sine;
        c->down[a] = down * cosine - right * sine;
    }
}

static tl_status aim_at_target(scene_view *self, double eye_height, tl_error *error)
{
    const tl_view *v = &self->given;
    double position[2] = {v->target[0], v->target[1]}, target[3], height;
    if (v->projected)
        scene_places_unproject(self->places, position);
    tl_status status = height_of(self, position, "target", v->target_above_ground, v->target[2], &height, error);
    if (status != TL_OK)
        return status;
    scene_places_point(self->places, position, height, target);
    const double eye[3] = {0, 0, eye_height};
    if (!all_finite(target, 3))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the target at %.10g, %.10g has no place in %s; move it",
                       self->dem->info.name, v->target[0], v->target[1],
                       self->dem->info.georef.crs ? tl_crs_name(self->dem->info.georef.crs) : "space");
    double distance = hypot(hypot(target[0], target[1]), target[2] - eye[2]);
    /* places are rounded to some 1e-9 m, and to 1e-16 of their height */
    if (!(distance > 1e-6 + 1e-12 * fabs(eye_height)))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the eye and the target are the same point; move one",
                       self->dem->info.name);
    scene_camera_look(&self->camera, eye, target, v->fov, v->width, v->height);
    return TL_OK;
}

static tl_status place_camera(scene_view *self, tl_error *error)
{
    const tl_view *v = &self->given;
    double foot[2] = {v->eye[0], v->eye[1]}, height;
    if (v->projected)
        scene_places_unproject(self->places, foot);
    tl_status status = height_of(self, foot, "eye", v->above_ground, v->eye[2], &height, error);
    scene_camera *c = &self->camera;
    if (status == TL_OK && v->target_given)
        status = aim_at_target(self, height, error);
    else if (status == TL_OK)
        aim(c, v->heading, v->pitch);
    c->eye[0] = c->eye[1] = 0;
    c->eye[2] = height;
    c->width = v->width;
    c->height = v->height;
    c->focal = v->width / 2.0 / tan(v->fov / 2 * radian);
    roll(c, v->roll);
    return status;
}

/* A plane through the eye: `ahead` times the axis, `right` times the one to the right, and so on. */
static void set_plane(scene_view *self, int k, double ahead, double right, double down)
{
    const scene_camera *c = &self->camera;
    for (int a = 0; a < 3; a++)
        self->planes[k][a] = ahead * c->ahead[a] + right * c->right[a] + down * c->down[a];
}

/* The frustum, and a pixel more on all sides, so that no rounding counts. */
static void place_frustum(scene_view *self)
{
    const scene_camera *c = &self->camera;
    double across = c->width / 2 / c->focal, along = c->height / 2 / c->focal, pixel = 1 / c->focal;
    set_plane(self, 0, 1, 0, 0);
    set_plane(self, 1, across + pixel, 1, 0);
    set_plane(self, 2, across + pixel, -1, 0);
    set_plane(self, 3, along + pixel, 0, 1);
    set_plane(self, 4, along + pixel, 0, -1);
    self->widest = 1 + across * across + along * along;
}

static void fill_defaults(tl_view *v)
{
    if (v->fov == 0)
        v->fov = 60;
    if (v->width == 0 && v->height == 0) {
        v->width = DEFAULT_WIDTH;
        v->height = DEFAULT_HEIGHT;
    }
}

static tl_status place(scene_view *self, tl_error *error)
{
    const tl_view *v = &self->given;
    const scene_bending bending = {v->flat, v->refraction};
    self->places = scene_places_create(self->dem, v->eye, v->projected, bending, error);
    if (!self->places)
        return TL_ERROR_DATA;
    tl_status status = place_camera(self, error);
    if (status != TL_OK)
        return status;
    place_frustum(self);
    status = scene_places_prepare(self->places, fabs(self->camera.eye[2]), 1 / self->camera.focal, error);
    self->slack = 2 * scene_places_error(self->places, true) + 1e-6;
    self->radius = scene_places_radius(self->places);
    return status;
}

scene_view *scene_view_create(const tl_view *view, const tl_source *dem, tl_error *error)
{
    if (check(view, dem, error) != TL_OK)
        return NULL;
    scene_view *self = calloc(1, sizeof *self);
    if (!self) {
        tl_fail_memory(error, "the view");
        return NULL;
    }
    self->given = *view;
    fill_defaults(&self->given);
    self->dem = dem;
    self->has_holes = dem->info.has_voids;
    self->floor = SCENE_LOWEST_GROUND;
    if (place(self, error) == TL_OK)
        return self;
    scene_view_destroy(self);
    return NULL;
}

void scene_view_destroy(scene_view *view)
{
    if (!view)
        return;
    scene_places_destroy(view->places);
    free(view);
}

void scene_view_know_ground(scene_view *view, double lowest, bool has_holes)
{
    if (isfinite(lowest))
        view->floor = lowest * view->dem->info.georef.height_unit;
    view->has_holes = has_holes;
}

double scene_view_above_ground(const scene_view *view)
{
    double i, j, ground = 0;
    scene_places_sample(view->places, scene_places_origin(view->places), &i, &j);
    bool known = scene_ground_height(view->dem, "eye", i, j, &ground, NULL) == TL_OK;
    return known ? view->camera.eye[2] - ground : (double)NAN;
}

const scene_camera *scene_view_camera(const scene_view *view)
{
    return &view->camera;
}

void scene_view_place(const scene_view *view, size_t n, const double *i, const double *j, const float *z,
                      double (*xyz)[3])
{
    scene_places_at(view->places, n, i, j, z, xyz);
}

double scene_view_distance(const scene_view *view, const scene_box *box)
{
    double sum = 0;
    for (int a = 0; a < 3; a++) {
        double e = view->camera.eye[a], d = fmax(fmax(box->low[a] - e, e - box->high[a]), 0);
        sum += d * d;
    }
    return sqrt(sum);
}

double scene_view_pixels(const scene_view *view, double length, double distance)
{
    /* Two points at least `distance` away and `length` apart are seen under an angle of 2 asin(x) at most, x = length /
     * (2 distance); asin(x) <= x + (pi / 2 - 1) x^3 on 0 ... 1. An angle t becomes focal t / cos^2 at most, by the
     * angle from straight ahead in the corner of the screen. */
    if (!(length < 2 * distance))
        return length > 0 ? (double)INFINITY : 0;
    double x = length / (2 * distance);
    return view->camera.focal * view->widest * 2 * (x + 0.5708 * x * x * x);
}
