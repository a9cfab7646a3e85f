/* Cameras of glTF files. glTF's Y points up, (east, north, up) being (x, -z, y); a camera looks along its own -Z, with
 * +Y at the top of the picture. */
#include "dem/crs.h"
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/scene/view_file.h"

#include <math.h>
#include <string.h>

enum { DEEPEST = 64, MOST_CAMERAS = 1 << 16, VIEWPORT_HEIGHT = 1080 };

static const double radian = 3.14159265358979323846 / 180;

/* The frame of the file: metres east, north and up at an origin. */
typedef struct origin {
    double longitude, latitude, height; /* radians, metres */
    double a, e2;                       /* of the ellipsoid: semi-major axis, eccentricity squared */
} origin;

typedef struct cameras {
    const json_t *root;
    const char *path;
    origin from;
    tl_view_key *keys;
    size_t count, room;
    size_t visits; /* of nodes: each has one parent at most, so there are no more than nodes */
} cameras;

/* A column-major 4 x 4 matrix, as glTF has them. */
typedef struct matrix {
    double m[16];
} matrix;

static const matrix identity = {{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}};

static matrix times(const matrix *a, const matrix *b)
{
    matrix out;
    for (int column = 0; column < 4; column++)
        for (int row = 0; row < 4; row++) {
            double sum = 0;
            for (int k = 0; k < 4; k++)
                sum += a->m[4 * k + row] * b->m[4 * column + k];
            out.m[4 * column + row] = sum;
        }
    return out;
}

/* Numbers of an array; true where there are `count` of them, or the member is missing. */
static bool numbers(const json_t *node, const char *name, size_t count, double *out)
{
    const json_t *list = json_object_get(node, name);
    if (!list)
        return true;
    if (json_array_size(list) != count)
        return false;
    for (size_t k = 0; k < count; k++) {
        const json_t *item = json_array_get(list, k);
        if (!json_is_number(item))
            return false;
        out[k] = json_number_value(item);
    }
    return true;
}

static bool local_matrix(const json_t *node, matrix *out)
{
    double t[3] = {0}, q[4] = {0, 0, 0, 1}, s[3] = {1, 1, 1};
    *out = identity;
    if (json_object_get(node, "matrix"))
        return numbers(node, "matrix", 16, out->m);
    if (!numbers(node, "translation", 3, t) || !numbers(node, "rotation", 4, q) || !numbers(node, "scale", 3, s))
        return false;
    double x = q[0], y = q[1], z = q[2], w = q[3];
    const double turn[9] = {1 - 2 * (y * y + z * z), 2 * (x * y + z * w),     2 * (x * z - y * w),
                            2 * (x * y - z * w),     1 - 2 * (x * x + z * z), 2 * (y * z + x * w),
                            2 * (x * z + y * w),     2 * (y * z - x * w),     1 - 2 * (x * x + y * y)};
    for (int column = 0; column < 3; column++)
        for (int row = 0; row < 3; row++)
            out->m[4 * column + row] = turn[3 * column + row] * s[column];
    memcpy(out->m + 12, t, sizeof t);
    return true;
}

/* ---- places ---- */

/* A vector from the frame of `at` (its longitude counted from the origin's) to axes fixed in the Earth; or back. */
static void turn_to_earth(double longitude, double latitude, const double enu[3], double out[3])
{
    double sl = sin(longitude), cl = cos(longitude), sp = sin(latitude), cp = cos(latitude);
    double outward = cp * enu[2] - sp * enu[1];
    out[0] = cl * outward - sl * enu[0];
    out[1] = sl * outward + cl * enu[0];
    out[2] = cp * enu[1] + sp * enu[2];
}

static void turn_from_earth(double longitude, double latitude, const double in[3], double enu[3])
{
    double sl = sin(longitude), cl = cos(longitude), sp = sin(latitude), cp = cos(latitude);
    double outward = cl * in[0] + sl * in[1];
    enu[0] = cl * in[1] - sl * in[0];
    enu[1] = cp * in[2] - sp * outward;
    enu[2] = cp * outward + sp * in[2];
}

/* Latitude and height of a point at `aside` from the Earth's axis and `along` it. */
static void geodetic(const origin *o, double aside, double along, double *latitude, double *height)
{
    double phi = atan2(along, aside * (1 - o->e2)), n = o->a;
    /* each round leaves at most e^2 of the error, a hundredth */
    for (int round = 0; round < 12; round++) {
        n = o->a / sqrt(1 - o->e2 * sin(phi) * sin(phi));
        phi = atan2(along + o->e2 * n * sin(phi), aside);
    }
    *latitude = phi;
    *height = aside * cos(phi) + along * sin(phi) - o->a * sqrt(1 - o->e2 * sin(phi) * sin(phi));
}

static void to_enu(const double gltf[3], double enu[3])
{
    enu[0] = gltf[0];
    enu[1] = -gltf[2];
    enu[2] = gltf[1];
}

/* Heading, pitch and roll of directions in the frame at the eye's foot. */
static void set_angles(tl_view *view, const double ahead[3], const double up[3])
{
    double level = hypot(ahead[0], ahead[1]);
    bool vertical = level < 1e-9;
    /* straight down the picture's top is ahead, straight up it is behind */
    double sign = ahead[2] < 0 ? 1 : -1;
    double heading = vertical ? atan2(sign * up[0], sign * up[1]) : atan2(ahead[0], ahead[1]);
    const double right[3] = {cos(heading), -sin(heading), 0};
    double across = up[0] * right[0] + up[1] * right[1] + up[2] * right[2];
    double sp = ahead[2], cp = level;
    double along = up[2] * cp - (up[0] * sin(heading) + up[1] * cos(heading)) * sp;
    view->heading = heading / radian;
    view->pitch = atan2(ahead[2], level) / radian;
    view->roll = vertical ? 0 : atan2(across, along) / radian;
}

static void place_view(const origin *o, const matrix *world, tl_view *view)
{
    double n = o->a / sqrt(1 - o->e2 * sin(o->latitude) * sin(o->latitude));
    double aside = (n + o->height) * cos(o->latitude), along = (n * (1 - o->e2) + o->height) * sin(o->latitude);
    double eye[3], at[3], axes[2][3], lengths[2], latitude, height;
    to_enu(world->m + 12, eye);
    turn_to_earth(0, o->latitude, eye, at);
    at[0] += aside;
    at[2] += along;
    double longitude = atan2(at[1], at[0]);
    geodetic(o, hypot(at[0], at[1]), at[2], &latitude, &height);
    for (int k = 0; k < 2; k++) { /* ahead is -Z, up is Y */
        double enu[3], earth[3];
        to_enu(world->m + (k ? 4 : 8), enu);
        turn_to_earth(0, o->latitude, enu, earth);
        turn_from_earth(longitude, latitude, earth, axes[k]);
        lengths[k] = sqrt(enu[0] * enu[0] + enu[1] * enu[1] + enu[2] * enu[2]);
    }
    for (int a = 0; a < 3; a++) {
        axes[0][a] /= -lengths[0];
        axes[1][a] /= lengths[1];
    }
    view->eye[0] = (longitude + o->longitude) / radian;
    view->eye[1] = latitude / radian;
    view->eye[2] = height;
    set_angles(view, axes[0], axes[1]);
}

/* ---- nodes ---- */

static bool set_lens(const json_t *camera, tl_view *view)
{
    const json_t *lens = json_object_get(camera, "perspective");
    const json_t *ratio = json_object_get(lens, "aspectRatio");
    double yfov = json_number_value(json_object_get(lens, "yfov")),
           aspect = ratio ? json_number_value(ratio) : 16 / 9.0;
    if (!(yfov > 0 && yfov < 179.9 * radian && aspect > 1e-3 && aspect < 1e3))
        return false;
    view->fov = 2 * atan(tan(yfov / 2) * aspect) / radian;
    view->height = VIEWPORT_HEIGHT;
    view->width = (int)fmax(floor(VIEWPORT_HEIGHT * aspect + 0.5), 1);
    return true;
}

static tl_status add_camera(cameras *c, const json_t *node, const matrix *world, tl_error *error)
{
    json_int_t index = json_integer_value(json_object_get(node, "camera"));
    const json_t *camera = index >= 0 ? json_array_get(json_object_get(c->root, "cameras"), (size_t)index) : NULL;
    tl_view_key key = {.time = (double)NAN};
    if (!set_lens(camera, &key.view))
        return tl_fail(error, TL_ERROR_DATA, "%s: camera %lld is not a perspective one with a yfov", c->path,
                       (long long)index);
    place_view(&c->from, world, &key.view);
    const tl_view *v = &key.view;
    if (!isfinite(v->eye[0] + v->eye[1] + v->eye[2] + v->heading + v->pitch + v->roll))
        return tl_fail(error, TL_ERROR_DATA, "%s: the node of camera %lld has no finite place and direction", c->path,
                       (long long)index);
    if (c->count == c->room) {
        size_t room = c->room ? 2 * c->room : 8;
        tl_view_key *grown = room <= MOST_CAMERAS ? realloc(c->keys, room * sizeof *grown) : NULL;
        if (!grown)
            return tl_fail(error, TL_ERROR_DATA, "%s: more than %d cameras, or not enough memory", c->path,
                           MOST_CAMERAS);
        c->keys = grown;
        c->room = room;
    }
    c->keys[c->count++] = key;
    return TL_OK;
}

static tl_status visit(cameras *c, const json_t *index, const matrix *above, int depth, tl_error *error)
{
    json_int_t number = json_is_integer(index) ? json_integer_value(index) : -1;
    const json_t *node = number >= 0 ? json_array_get(json_object_get(c->root, "nodes"), (size_t)number) : NULL;
    matrix own, world;
    bool tree = c->visits++ < json_array_size(json_object_get(c->root, "nodes")) && depth <= DEEPEST;
    if (!node || !tree || !local_matrix(node, &own))
        return tl_fail(error, TL_ERROR_DATA, "%s: its node %lld is missing, malformed, more than %d deep or used twice",
                       c->path, (long long)number, DEEPEST);
    world = times(above, &own);
    tl_status status = json_object_get(node, "camera") ? add_camera(c, node, &world, error) : TL_OK;
    const json_t *children = json_object_get(node, "children");
    for (size_t k = 0; k < json_array_size(children) && status == TL_OK; k++)
        status = visit(c, json_array_get(children, k), &world, depth + 1, error);
    return status;
}

/* ---- the file ---- */

static double degrees(const json_t *object, const char *name)
{
    const json_t *value = json_object_get(object, name);
    return json_is_number(value) ? json_number_value(value) : (double)NAN;
}

static tl_status read_origin(cameras *c, tl_error *error)
{
    const json_t *extras = json_object_get(json_object_get(c->root, "asset"), "extras");
    const json_t *at = json_object_get(extras, "origin");
    const char *wkt = json_string_value(json_object_get(extras, "crs_wkt"));
    double longitude = degrees(at, "longitude"), latitude = degrees(at, "latitude"), height = degrees(at, "height");
    if (!wkt || !isfinite(longitude + latitude + height))
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: its asset's extras have no origin and crs_wkt as talus writes them, so where its cameras "
                       "are is not known; begin with a GLB that talus made with --frame enu, or use a JSON",
                       c->path);
    tl_crs *crs = NULL;
    tl_status status = dem_crs_from_text(wkt, c->path, &crs, error);
    if (status != TL_OK)
        return status;
    double f = crs->flattening;
    c->from = (origin){longitude * radian, latitude * radian, height, crs->semi_major, f * (2 - f)};
    tl_crs_release(crs);
    return TL_OK;
}

tl_status scene_view_from_gltf(const json_t *root, const char *path, tl_view_key **keys, size_t *count, tl_error *error)
{
    cameras c = {.root = root, .path = path};
    tl_status status = read_origin(&c, error);
    json_int_t chosen = json_integer_value(json_object_get(root, "scene"));
    const json_t *scene = chosen >= 0 ? json_array_get(json_object_get(root, "scenes"), (size_t)chosen) : NULL;
    const json_t *nodes = json_object_get(scene, "nodes");
    for (size_t k = 0; k < json_array_size(nodes) && status == TL_OK; k++)
        status = visit(&c, json_array_get(nodes, k), &identity, 0, error);
    if (status == TL_OK && c.count == 0)
        status = tl_fail(error, TL_ERROR_DATA, "%s: no node of its scene is a camera", path);
    if (status != TL_OK) {
        free(c.keys);
        return status;
    }
    *keys = c.keys;
    *count = c.count;
    return TL_OK;
}
