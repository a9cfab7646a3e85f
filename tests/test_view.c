/* Views: places against the exact formulas, and rules that hide against brute force. */
#include "dem/bend.h"
#include "dem/crs.h"
#include "lib/scene/view.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

static const double radian = 3.14159265358979323846 / 180;

/* ---- Rasters, and views over them ---------------------------------------------------------------- */

typedef struct ground {
    int width, height;
    const char *crs; /* NULL: none */
    double x, y, dx, dy;
    double relief; /* metres */
    double eye[3]; /* as given, metres above the datum */
} ground;

static const ground grounds[] = {
    {1025, 1025, "EPSG:32630", 400000, 5000000, 100, 100, 0, {-2.9, 44.6, 300}}, /* flat, 102 km wide */
    {513, 513, "EPSG:32630", 166000, 9300000, 300, 300, 900, {-15, 83, 2000}},   /* the rim of a zone, far north */
    {513, 513, "EPSG:4326", 10, 47, 1 / 300.0, 1 / 300.0, 1500, {10.7, 46.2, 1800}},
    {257, 257, "EPSG:4326", -30, 84, 1 / 60.0, 1 / 60.0, 300, {-28.2, 81.1, 400}}, /* meridians that meet */
    {257, 257, "EPSG:3031", -600000, 700000, 5000, 5000, 1000, {12, -84, 5000}},   /* around a pole */
    {361, 181, "EPSG:4326", -180, 90, 1, 1, 5000, {11.3, 46.7, 3000}},             /* the world */
    {361, 181, "EPSG:4326", -180, 90, 1, 1, 5000, {-100, 20, 2e7}},                /* and from far above */
    {129, 257, NULL, 0, 0, 30, 30, 800, {40, -200, 900}},
};
enum { GROUNDS = sizeof grounds / sizeof grounds[0] };

static double height_at(const ground *of, double i, double j)
{
    double u = 2 * i / of->width - 1, v = 2 * j / of->height - 1;
    return of->relief * (sin(5 * u + 2 * v) * cos(7 * v - u) + 0.3 * sin(23 * u) * sin(31 * v));
}

static tl_source *open_ground(const ground *of, float **heights)
{
    tl_crs *crs = NULL;
    tl_error error = {0};
    if (of->crs && dem_crs_from_text(of->crs, "ground", &crs, &error) != TL_OK)
        fail_msg("%s", error.text);
    *heights = malloc((size_t)of->width * (size_t)of->height * sizeof **heights);
    for (int k = 0; k < of->width * of->height; k++)
        (*heights)[k] = (float)height_at(of, k % of->width, k / of->width);
    tl_source_info info = {.width = of->width, .height = of->height, .type = TL_RASTER_POINT, .name = "ground"};
    info.georef = (tl_georef){.crs = crs,
                              .located = crs != NULL,
                              .transform = {of->x, of->dx, 0, of->y, 0, -of->dy},
                              .cell_x = of->dx,
                              .cell_y = of->dy,
                              .height_unit = 1};
    if (!crs)
        memcpy(info.georef.transform, (const double[6]){0, 1, 0, 0, 0, -1}, sizeof info.georef.transform);
    else
        assert_int_equal(dem_georef_measure(&info.georef, of->width, of->height, NULL), TL_OK);
    return tl_array_source_create(*heights, &info, NULL);
}

static void close_ground(tl_source *source, float *heights)
{
    const tl_crs *crs = source->info.georef.crs;
    tl_source_destroy(source);
    tl_crs_release((tl_crs *)crs);
    free(heights);
}

static scene_view *open_view(const tl_view *view, const tl_source *dem)
{
    tl_error error = {0};
    scene_view *opened = scene_view_create(view, dem, &error);
    if (!opened)
        fail_msg("%s", error.text);
    return opened;
}

static uint64_t draw_state;

static double draw(void)
{
    draw_state = draw_state * 6364136223846793005u + 1442695040888963407u;
    return (double)(draw_state >> 11) / 9007199254740992.0;
}

static double between(double low, double high)
{
    return low + (high - low) * draw();
}

static void place(const scene_view *view, double i, double j, double z, double xyz[3])
{
    float height = (float)z;
    double at[1][3];
    scene_view_place(view, 1, &i, &j, &height, at);
    memcpy(xyz, at[0], sizeof at[0]);
}

static double length(const double a[3])
{
    return sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]);
}

/* ---- Places ---------------------------------------------------------------------------------------- */

/* The stated bound: 1e-4 m (and rounding of floats' heights is no part of it) within 500 km of the eye, a hundredth of
 * a pixel beyond, which at the nearest point out there is no more than one at any. */
static void placesAreThoseOfTheEllipsoid(void **state)
{
    (void)state;
    for (int g = 0; g < GROUNDS; g++) {
        const ground *of = &grounds[g];
        float *heights;
        tl_source *dem = open_ground(of, &heights);
        tl_view v = {.eye = {of->eye[0], of->eye[1], of->eye[2]}};
        scene_view *view = open_view(&v, dem);
        dem_space *space = NULL;
        if (of->crs)
            space = dem_space_create_at(&dem->info.georef, (const double[3]){of->eye[0], of->eye[1], 0}, "x", NULL);
        double focal = scene_view_camera(view)->focal;
        draw_state = 1;
        for (int k = 0; k < 20000; k++) {
            double i = between(0, of->width - 1), j = between(0, of->height - 1), xyz[3], truth[3], off[3];
            float z = (float)between(-500, 9000);
            place(view, i, j, (double)z, xyz);
            if (space)
                dem_space_at(space, i, j, (double)z, truth, NULL);
            else
                memcpy(truth, (const double[3]){(i - of->eye[0]) * of->dx, (-j - of->eye[1]) * of->dy, (double)z},
                       sizeof truth);
            for (int a = 0; a < 3; a++)
                off[a] = xyz[a] - truth[a];
            const double from_eye[3] = {truth[0], truth[1], truth[2] - of->eye[2]};
            assert_true(length(off) <= fmax(1e-4, 0.01 * length(from_eye) / focal));
        }
        dem_space_destroy(space);
        scene_view_destroy(view);
        close_ground(dem, heights);
    }
}

/* ---- Boxes ----------------------------------------------------------------------------------------- */

static scene_extent some_extent(const ground *of)
{
    /* from a thousandth of a cell to the whole raster */
    double size = pow(of->width, draw()) * pow(1e-3, draw() * draw());
    double i0 = between(0, of->width - 1), j0 = between(0, of->height - 1);
    double low = between(-500, 5000), high = low + pow(10, between(-2, 3.5));
    return (scene_extent){i0, j0, fmin(i0 + size, of->width - 1), fmin(j0 + size, of->height - 1), low, high};
}

static void boxesHoldAllThatIsInTheirExtents(void **state)
{
    (void)state;
    for (int g = 0; g < 2 * GROUNDS; g++) {
        const ground *of = &grounds[g % GROUNDS];
        float *heights;
        tl_source *dem = open_ground(of, &heights);
        tl_view v = {.eye = {of->eye[0], of->eye[1], of->eye[2]}, .refraction = g < GROUNDS ? 0 : 0.13};
        scene_view *view = open_view(&v, dem);
        draw_state = 2;
        for (int n = 0; n < 1000; n++) {
            scene_extent e = some_extent(of);
            scene_box box;
            scene_view_box(view, &e, &box);
            for (int k = 0; k < 50; k++) {
                /* corners and edges more often than chance has it */
                double u = fmin(fmax(between(-0.3, 1.3), 0), 1), w = fmin(fmax(between(-0.3, 1.3), 0), 1), xyz[3];
                double t = fmin(fmax(between(-0.3, 1.3), 0), 1);
                place(view, e.i0 + u * (e.i1 - e.i0), e.j0 + w * (e.j1 - e.j0), e.low + t * (e.high - e.low), xyz);
                for (int a = 0; a < 3; a++) {
                    /* heights are rounded to floats */
                    assert_true(xyz[a] >= box.low[a] - 1e-3);
                    assert_true(xyz[a] <= box.high[a] + 1e-3);
                }
            }
        }
        scene_view_destroy(view);
        close_ground(dem, heights);
    }
}

/* ---- Refraction and the flat Earth ------------------------------------------------------------------- */

/* Over a sphere, a point at distance s along the ground and height h comes to R' = R / (1 - k): angle s / R'. */
static void refractionIsALargerEarth(void **state)
{
    (void)state;
    tl_error error = {0};
    tl_crs *crs = NULL;
    const double r = 6371000, k = 0.13;
    assert_int_equal(dem_crs_from_text("+proj=longlat +R=6371000 +type=crs", "sphere", &crs, &error), TL_OK);
    float heights[4] = {0};
    tl_source_info info = {.width = 2, .height = 2, .type = TL_RASTER_POINT, .name = "sphere"};
    info.georef = (tl_georef){crs, true, {0, 1, 0, 1, 0, -1}, 111000, 111000, 1};
    tl_source *dem = tl_array_source_create(heights, &info, NULL);
    tl_view v = {.eye = {0, 0, 100}, .refraction = k};
    scene_view *refracted = open_view(&v, dem);
    v.refraction = 0;
    v.flat = true;
    scene_view *flat = open_view(&v, dem);
    for (int n = 0; n <= 10; n++) {
        double i = n / 10.0, s = i * radian * r, h = 3000, larger = r / (1 - k), xyz[3];
        place(refracted, i, 1, h, xyz);
        assert_true(fabs(xyz[0] - (larger + h) * sin(s / larger)) < 1e-3);
        assert_true(fabs(xyz[2] - ((larger + h) * cos(s / larger) - larger)) < 1e-3);
        place(flat, i, 1, h, xyz);
        assert_true(fabs(xyz[0] - s) < 1e-3 && fabs(xyz[1]) < 1e-3 && fabs(xyz[2] - h) < 1e-3);
    }
    scene_view_destroy(refracted);
    scene_view_destroy(flat);
    tl_source_destroy(dem);
    tl_crs_release(crs);
}

/* ---- Rules ------------------------------------------------------------------------------------------- */

static tl_view some_view(const ground *of)
{
    tl_view v = {.eye = {of->eye[0], of->eye[1], of->eye[2]}, .width = 1920, .height = 1080};
    if (draw() < 0.2)
        v.eye[2] = pow(10, between(0, 9));
    v.heading = between(-180, 180);
    v.pitch = draw() < 0.2 ? -90 : between(-60, 40);
    v.roll = draw() < 0.5 ? 0 : between(-180, 180);
    v.fov = draw() < 0.2 ? 0.01 : draw() < 0.2 ? 179 : between(10, 120);
    return v;
}

static bool is_on_screen(const scene_camera *c, const double xyz[3])
{
    double v[3];
    scene_camera_view(c, xyz, v);
    return v[2] > 0 && fabs(v[0]) <= c->width / 2 * v[2] && fabs(v[1]) <= c->height / 2 * v[2];
}

/* Whether the way from the eye to a point goes through the ellipsoid, lowered by 11.5 km: no ground is below it. */
static bool goes_through_earth(const tl_georef *g, const double origin[2], const double eye[3], const double xyz[3])
{
    dem_local_frame *at = dem_local_frame_create(g->crs, origin[0], origin[1], 0, NULL);
    /* the frame at the equator, under the origin's meridian, gives the Earth's own axes */
    double centre[3], north[3], axis[3] = {0}, a = 6378137 - 11500, b = 6356752.3 - 11500;
    dem_local_frame_forward(at, origin[0], 90, 0, north);
    dem_local_frame_forward(at, origin[0], -90, 0, centre);
    for (int k = 0; k < 3; k++) {
        axis[k] = (north[k] - centre[k]) / (2 * 6356752.314);
        centre[k] = (north[k] + centre[k]) / 2;
    }
    bool through = false;
    for (int step = 0; step <= 4000 && !through; step++) {
        double p[3], along = 0, all = 0, t = step / 4000.0;
        for (int k = 0; k < 3; k++) {
            p[k] = eye[k] + t * (xyz[k] - eye[k]) - centre[k];
            along += p[k] * axis[k];
            all += p[k] * p[k];
        }
        through = (all - along * along) / (a * a) + along * along / (b * b) < 1;
    }
    dem_local_frame_destroy(at);
    return through;
}

/* Some direction within the cone of slopes around the way up at a place. */
static void some_normal(const scene_view *view, double i, double j, double slope, double out[3])
{
    double low[3], high[3], up[3], side[3], n[3];
    place(view, i, j, 0, low);
    place(view, i, j, 1000, high);
    for (int a = 0; a < 3; a++)
        up[a] = (high[a] - low[a]) / 1000;
    for (int a = 0; a < 3; a++)
        side[a] = between(-1, 1);
    n[0] = up[1] * side[2] - up[2] * side[1];
    n[1] = up[2] * side[0] - up[0] * side[2];
    n[2] = up[0] * side[1] - up[1] * side[0];
    double steep = slope * (draw() < 0.5 ? 1 : draw()) / length(n);
    for (int a = 0; a < 3; a++)
        out[a] = up[a] + steep * n[a];
}

static void rulesHideNothingThatIsToBeSeen(void **state)
{
    (void)state;
    int hidden[3] = {0}, tried = 0;
    for (int g = 0; g < GROUNDS; g++) {
        const ground *of = &grounds[g];
        float *heights;
        tl_source *dem = open_ground(of, &heights);
        draw_state = 3;
        for (int n = 0; n < 150; n++) {
            tl_view v = some_view(of);
            scene_view *view = open_view(&v, dem);
            const double *eye = scene_view_camera(view)->eye;
            for (int m = 0; m < 10; m++, tried++) {
                scene_extent e = some_extent(of);
                scene_box box;
                scene_view_box(view, &e, &box);
                double slope = pow(10, between(-3, 1));
                unsigned rules[3];
                for (int r = 0; r < 3; r++)
                    hidden[r] += (rules[r] = scene_view_hides(view, &e, &box, slope, 1u << r)) != 0;
                assert_int_equal(scene_view_hides(view, &e, &box, slope, 0), 0);
                for (int k = 0; k < 4; k++) {
                    double i = between(e.i0, e.i1), j = between(e.j0, e.j1), xyz[3], normal[3], facing = 0;
                    place(view, i, j, between(e.low, e.high), xyz);
                    if (rules[0])
                        assert_false(is_on_screen(scene_view_camera(view), xyz));
                    some_normal(view, i, j, slope, normal);
                    for (int a = 0; a < 3; a++)
                        facing += normal[a] * (eye[a] - xyz[a]);
                    if (rules[1])
                        assert_true(facing < 0);
                    if (rules[2] && k == 0)
                        assert_true(goes_through_earth(&dem->info.georef, of->eye, eye, xyz));
                }
            }
            scene_view_destroy(view);
        }
        close_ground(dem, heights);
    }
    /* they do hide: of boxes of all sizes anywhere, the frustum more than half */
    assert_true(2 * hidden[0] > tried && 50 * hidden[1] > tried && 50 * hidden[2] > tried);
}

/* ---- Ridges ------------------------------------------------------------------------------------------ */

enum { SIDE = 257, SQUARE = 4, SQUARES = (SIDE - 1) / SQUARE };

/* Bilinear between samples. */
static double surface(const float *heights, double i, double j)
{
    int x = (int)fmin(floor(i), SIDE - 2), y = (int)fmin(floor(j), SIDE - 2);
    double u = i - x, v = j - y;
    const float *h = heights + y * SIDE + x;
    return (1 - v) * ((1 - u) * (double)h[0] + u * (double)h[1]) +
           v * ((1 - u) * (double)h[SIDE] + u * (double)h[SIDE + 1]);
}

typedef struct square {
    scene_extent extent;
    scene_box box;
    double distance;
} square;

static int by_distance(const void *a, const void *b)
{
    double x = ((const square *)a)->distance, y = ((const square *)b)->distance;
    return (x > y) - (x < y);
}

static scene_extent square_extent(const float *heights, int column, int row)
{
    scene_extent e = {column * SQUARE, row * SQUARE, (column + 1) * SQUARE, (row + 1) * SQUARE, 1e9, -1e9};
    for (int y = 0; y <= SQUARE; y++)
        for (int x = 0; x <= SQUARE; x++) {
            double z = (double)heights[(row * SQUARE + y) * SIDE + column * SQUARE + x];
            e.low = fmin(e.low, z);
            e.high = fmax(e.high, z);
        }
    return e;
}

/* Whether the way from the eye to a point of the lattice is in the ground somewhere. */
static bool is_in_ground(const float *heights, const double from[3], const double to[3])
{
    double length_in_cells = hypot(to[0] - from[0], to[1] - from[1]);
    int steps = (int)(length_in_cells * 8) + 1;
    for (int k = 0; k < steps; k++) {
        double t = (double)k / steps;
        double i = from[0] + t * (to[0] - from[0]), j = from[1] + t * (to[1] - from[1]);
        if (from[2] + t * (to[2] - from[2]) < surface(heights, i, j))
            return true;
    }
    return false;
}

static void ridgesHideOnlyWhatIsBehindThem(void **state)
{
    (void)state;
    static float heights[SIDE * SIDE];
    static square squares[SQUARES * SQUARES];
    const ground of = {SIDE, SIDE, NULL, 0, 0, 30, 30, 500, {0}};
    for (int k = 0; k < SIDE * SIDE; k++)
        heights[k] = (float)height_at(&of, k % SIDE, k / SIDE);
    tl_source_info info = {.width = SIDE, .height = SIDE, .type = TL_RASTER_POINT, .name = "hills"};
    info.georef = (tl_georef){NULL, false, {0, 1, 0, 0, 0, -1}, 30, 30, 1};
    tl_source *dem = tl_array_source_create(heights, &info, NULL);
    int hidden = 0, visible = 0;
    for (int n = 0; n < 6; n++) {
        const double from[2] = {60.3 + 30 * n, 200.7 - 25 * n};
        tl_view v = {.eye = {from[0], -from[1], 60}, .above_ground = true, .heading = 72 * n, .fov = n < 4 ? 70 : 15};
        v.pitch = n == 5 ? -60 : -4;
        scene_view *view = open_view(&v, dem);
        const double eye[3] = {from[0], from[1], scene_view_camera(view)->eye[2]};
        scene_skyline *skyline = scene_skyline_create(view, NULL);
        for (int k = 0; k < SQUARES * SQUARES; k++) {
            square *s = &squares[k];
            s->extent = square_extent(heights, k % SQUARES, k / SQUARES);
            scene_view_box(view, &s->extent, &s->box);
            s->distance = scene_view_distance(view, &s->box);
        }
        qsort(squares, SQUARES * SQUARES, sizeof *squares, by_distance);
        for (int k = 0; k < SQUARES * SQUARES; k++) {
            const square *s = &squares[k];
            bool hides = scene_skyline_hides(skyline, view, &s->extent, &s->box);
            scene_skyline_raise(skyline, view, &s->extent);
            hidden += hides;
            visible += !hides && !scene_view_hides(view, &s->extent, &s->box, HUGE_VAL, SCENE_HIDDEN_FRUSTUM);
            for (int p = 0; p < 40 && hides; p++) {
                double i = between(s->extent.i0, s->extent.i1), j = between(s->extent.j0, s->extent.j1), xyz[3];
                double z = surface(heights, i, j);
                place(view, i, j, z, xyz);
                if (is_on_screen(scene_view_camera(view), xyz))
                    assert_true(is_in_ground(heights, eye, (const double[3]){i, j, z - 1e-3}));
            }
        }
        scene_skyline_destroy(skyline);
        scene_view_destroy(view);
    }
    tl_source_destroy(dem);
    assert_true(hidden > visible / 2);
}

/* A void lets lines of sight below the ground behind it. */
static void holesLeakIntoTheSkyline(void **state)
{
    (void)state;
    static float heights[SIDE * SIDE];
    tl_source_info info = {.width = SIDE, .height = SIDE, .type = TL_RASTER_POINT, .name = "hills"};
    info.georef = (tl_georef){NULL, false, {0, 1, 0, 0, 0, -1}, 30, 30, 1};
    tl_source *dem = tl_array_source_create(heights, &info, NULL);
    tl_view v = {.eye = {10.5, -128, 50}};
    v.heading = 90;
    scene_view *view = open_view(&v, dem);
    const scene_extent hole = {50, 100, 60, 150, 0, 10}, near = {30, 118, 40, 138, 200, 300},
                       wall = {100, 80, 110, 180, 900, 1000}, behind = {200, 120, 210, 130, 0, 100};
    scene_box box, hole_box;
    scene_view_box(view, &behind, &box);
    scene_view_box(view, &hole, &hole_box);
    {
        scene_skyline *skyline = scene_skyline_create(view, NULL);
        assert_false(scene_skyline_hides(skyline, view, &behind, &box));
        scene_skyline_raise(skyline, view, &wall);
        assert_true(scene_skyline_hides(skyline, view, &behind, &box));
        scene_skyline_leak(skyline, &hole_box);
        assert_false(scene_skyline_hides(skyline, view, &behind, &box));
        scene_skyline_raise(skyline, view, &wall);
        assert_false(scene_skyline_hides(skyline, view, &behind, &box));
        scene_skyline_raise(skyline, view, &near);
        assert_true(scene_skyline_hides(skyline, view, &behind, &box));
        scene_skyline_destroy(skyline);
    }
    /* an eye under the ground, and a raster with holes nobody tells of: nothing is hidden */
    scene_view_know_ground(view, 0, true);
    scene_skyline *skyline = scene_skyline_create(view, NULL);
    scene_skyline_raise(skyline, view, &wall);
    assert_false(scene_skyline_hides(skyline, view, &behind, &box));
    scene_skyline_destroy(skyline);
    scene_view_destroy(view);
    v.eye[2] = -1;
    view = open_view(&v, dem);
    skyline = scene_skyline_create(view, NULL);
    scene_skyline_raise(skyline, view, &wall);
    assert_false(scene_skyline_hides(skyline, view, &behind, &box));
    scene_skyline_destroy(skyline);
    scene_view_destroy(view);
    tl_source_destroy(dem);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(placesAreThoseOfTheEllipsoid),   cmocka_unit_test(boxesHoldAllThatIsInTheirExtents),
        cmocka_unit_test(refractionIsALargerEarth),       cmocka_unit_test(rulesHideNothingThatIsToBeSeen),
        cmocka_unit_test(ridgesHideOnlyWhatIsBehindThem), cmocka_unit_test(holesLeakIntoTheSkyline),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
