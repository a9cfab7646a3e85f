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

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(placesAreThoseOfTheEllipsoid),
        cmocka_unit_test(boxesHoldAllThatIsInTheirExtents),
        cmocka_unit_test(refractionIsALargerEarth),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
