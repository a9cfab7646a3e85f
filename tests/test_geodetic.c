/* Rasters on the lattices of the geographic tile scheme: where they come to lie, and that no vertex depends on what is
 * read with it. */
#include "dem/crs.h"
#include "dem/crs_ellipsoidal.h"
#include "lib/base/georef.h"
#include "lib/scene/geodetic.h"
#include "lib/scene/source_part.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "near.h"

static const double degree = 3.14159265358979323846 / 180;

typedef struct ground {
    const char *name, *crs;
    double transform[6];
    int width, height;
    tl_raster_type type;
    double wave; /* degrees */
} ground;

static const ground grounds[] = {
    {"areas", "EPSG:4326", {10.003, 0.001, 0, 47.2, 0, -0.001}, 200, 150, TL_RASTER_AREA, 0.05},
    {"points", "EPSG:4326", {10.003, 0.001, 0, 47.2, 0, -0.001}, 200, 150, TL_RASTER_POINT, 0.05},
    {"south up", "EPSG:4326", {10.003, 0.001, 0, 47.2, 0, 0.001}, 200, 150, TL_RASTER_AREA, 0.05},
    {"columns down", "EPSG:4326", {10.003, 0, 0.001, 47.2, -0.001, 0}, 200, 150, TL_RASTER_AREA, 0.05},
    {"a map", "EPSG:32632", {500010, 60, 0, 5200000, 0, -60}, 200, 150, TL_RASTER_AREA, 0.04},
    {"a turned map", "EPSG:32633", {300010, 50, 30, 5200000, 30, -50}, 200, 150, TL_RASTER_POINT, 0.04},
    {"the antimeridian", "EPSG:4326", {179.9, 0.001, 0, -17, 0, -0.001}, 200, 150, TL_RASTER_AREA, 0.05},
    {"beyond it", "EPSG:4326", {539.9, 0.001, 0, -17, 0, -0.001}, 200, 150, TL_RASTER_AREA, 0.05},
    {"a map of the antimeridian", "EPSG:3832", {3340000, 200, 0, -1900000, 0, -200}, 200, 150, TL_RASTER_AREA, 0.1},
    {"a pole", "EPSG:3413", {-60000, 600, 0, 60000, 0, -600}, 201, 201, TL_RASTER_POINT, 0.5},
    {"the globe", "EPSG:4326", {0.5, 1, 0, 89.5, 0, -1}, 360, 180, TL_RASTER_AREA, 40},
    {"from Paris", "EPSG:4807", {8.003, 0.001, 0, 52.2, 0, -0.001}, 200, 150, TL_RASTER_AREA, 0.05},
};
enum { GROUNDS = sizeof grounds / sizeof grounds[0] };

/* Smooth on the globe, and by turns of 360 degrees the same: of the place on a unit sphere. */
static double height_at(const ground *g, double longitude, double latitude)
{
    double x = cos(latitude * degree) * cos(longitude * degree), y = cos(latitude * degree) * sin(longitude * degree);
    double z = sin(latitude * degree), k = 2 * 3.14159265358979 / (g->wave * degree);
    return 1000 * (sin(k * x) + sin(k * 0.9 * y + 1) + sin(k * 0.8 * z + 2));
}

static tl_source *open_ground(const ground *g, float **heights)
{
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text(g->crs, g->name, &crs, NULL), TL_OK);
    tl_source_info info = {.width = g->width, .height = g->height, .type = g->type, .name = g->name};
    info.georef = (tl_georef){.crs = crs, .located = true, .height_unit = 1};
    memcpy(info.georef.transform, g->transform, sizeof g->transform);
    assert_int_equal(dem_georef_measure(&info.georef, g->width, g->height, NULL), TL_OK);
    info.wraps = dem_georef_goes_around(&info.georef, g->width);
    *heights = malloc((size_t)g->width * (size_t)g->height * sizeof **heights);
    double meridian = dem_crs_prime_meridian(crs); /* longitudes count from it */
    double *x = malloc((size_t)g->width * sizeof *x), *y = malloc((size_t)g->width * sizeof *y);
    for (int j = 0; j < g->height; j++) {
        for (int i = 0; i < g->width; i++)
            x[i] = i, y[i] = j;
        assert_int_equal(tl_georef_to_lonlat(&info.georef, (size_t)g->width, x, y, NULL), TL_OK);
        for (int i = 0; i < g->width; i++)
            (*heights)[j * g->width + i] = (float)height_at(g, x[i] + meridian, y[i]);
    }
    free(x);
    free(y);
    tl_source *source = tl_array_source_create(*heights, &info, NULL);
    assert_non_null(source);
    return source;
}

static void close_ground(tl_source *source, float *heights)
{
    const tl_crs *crs = source->info.georef.crs;
    tl_source_destroy(source);
    tl_crs_release(crs);
    free(heights);
}

static float *read_lattice(const scene_geodetic *g, tl_window w)
{
    float *z = malloc((size_t)(w.width * w.height) * sizeof *z);
    tl_error error = {0};
    if (scene_geodetic_read(g, w, z, &error) != TL_OK)
        fail_msg("%s", error.text);
    return z;
}

/* The shift that fits best, in cells of the lattice: residuals are d . grad h in the first order, so least squares give
 * d. The known rim is left out, where an area raster repeats its outermost samples. */
static void find_shift(const ground *g, int level, tl_window w, const float *z, double shift[2], size_t *used)
{
    double step = scene_geodetic_step(level), a = 0, b = 0, c = 0, p = 0, q = 0;
    *used = 0;
    for (int64_t y = 2; y < w.height - 2; y++)
        for (int64_t x = 2; x < w.width - 2; x++) {
            double longitude = -180 + (double)(w.x + x) * step, latitude = -90 + (double)(w.y + y) * step;
            const float *here = z + y * w.width + x;
            if (!isfinite(here[0]) || !isfinite(here[2]) || !isfinite(here[-2]) || !isfinite(here[2 * w.width]) ||
                !isfinite(here[-2 * w.width]) || fabs(latitude) > 89.9)
                continue;
            double e = 1e-3 * step;
            double gx = (height_at(g, longitude + e, latitude) - height_at(g, longitude - e, latitude)) / 2e-3;
            double gy = (height_at(g, longitude, latitude + e) - height_at(g, longitude, latitude - e)) / 2e-3;
            double off = (double)here[0] - height_at(g, longitude, latitude);
            a += gx * gx, b += gx * gy, c += gy * gy, p += gx * off, q += gy * off;
            ++*used;
        }
    double whole = a * c - b * b;
    shift[0] = (p * c - q * b) / whole;
    shift[1] = (a * q - b * p) / whole;
}

static void nothingIsShifted(void **state)
{
    (void)state;
    for (int k = 0; k < GROUNDS; k++) {
        const ground *g = &grounds[k];
        float *heights;
        tl_source *source = open_ground(g, &heights);
        int level = scene_geodetic_level(&source->info);
        if (strcmp(g->name, "a pole") == 0)
            level = 6; /* the world is wide around a pole */
        scene_geodetic *lattice = scene_geodetic_create(source, level, NULL);
        assert_non_null(lattice);
        tl_window w = scene_geodetic_window(lattice);
        float *z = read_lattice(lattice, w);
        double shift[2];
        size_t used;
        find_shift(g, level, w, z, shift, &used);
        assert_true(used > 1000);
        if (!(fabs(shift[0]) < 0.05 && fabs(shift[1]) < 0.05))
            fail_msg("%s: shifted by %.4f, %.4f cells", g->name, shift[0], shift[1]);
        free(z);
        scene_geodetic_destroy(lattice);
        close_ground(source, heights);
    }
}

/* Equal bits, NaN or not. */
static void expect_equal(const ground *g, const float *a, const float *b, size_t count)
{
    for (size_t k = 0; k < count; k++)
        if (memcmp(a + k, b + k, sizeof *a) != 0 && !(isnan(a[k]) && isnan(b[k])))
            fail_msg("%s: %.9g and %.9g", g->name, (double)a[k], (double)b[k]);
}

static void verticesDoNotDependOnTheWindow(void **state)
{
    (void)state;
    for (int k = 0; k < GROUNDS; k++) {
        const ground *g = &grounds[k];
        float *heights;
        tl_source *source = open_ground(g, &heights);
        int level = strcmp(g->name, "a pole") == 0 ? 6 : scene_geodetic_level(&source->info);
        scene_geodetic *lattice = scene_geodetic_create(source, level, NULL);
        assert_non_null(lattice);
        const tl_window w = scene_geodetic_window(lattice);
        float *whole = read_lattice(lattice, w);
        for (int turn = -1; turn <= 1; turn++) /* columns go around */
            for (int part = 0; part < 5; part++) {
                int64_t x = w.width * part / 7, y = w.height * part / 9;
                tl_window inner = {w.x + x + turn * scene_geodetic_columns(level), w.y + y, w.width / 3 + 1,
                                   w.height / 4 + 1};
                float *z = read_lattice(lattice, inner);
                for (int64_t row = 0; row < inner.height; row++)
                    expect_equal(g, z + row * inner.width, whole + (y + row) * w.width + x, (size_t)inner.width);
                free(z);
            }
        free(whole);
        scene_geodetic_destroy(lattice);
        close_ground(source, heights);
    }
}

/* A level below has the vertices of this one among its own. */
static void levelsShareTheirVertices(void **state)
{
    (void)state;
    float *heights;
    tl_source *source = open_ground(&grounds[0], &heights);
    int level = scene_geodetic_level(&source->info);
    scene_geodetic *coarse = scene_geodetic_create(source, level, NULL),
                   *fine = scene_geodetic_create(source, level + 1, NULL);
    assert_non_null(coarse);
    assert_non_null(fine);
    tl_window w = scene_geodetic_window(coarse), twice = {2 * w.x, 2 * w.y, 2 * w.width - 1, 2 * w.height - 1};
    float *a = read_lattice(coarse, w), *b = read_lattice(fine, twice);
    for (int64_t y = 0; y < w.height; y++)
        for (int64_t x = 0; x < w.width; x++)
            expect_equal(&grounds[0], a + y * w.width + x, b + 2 * y * twice.width + 2 * x, 1);
    free(a);
    free(b);
    scene_geodetic_destroy(coarse);
    scene_geodetic_destroy(fine);
    close_ground(source, heights);
}

static void heightsAreMetres(void **state)
{
    (void)state;
    float *heights;
    tl_source *source = open_ground(&grounds[4], &heights);
    int level = scene_geodetic_level(&source->info);
    scene_geodetic *lattice = scene_geodetic_create(source, level, NULL);
    tl_window w = scene_geodetic_window(lattice);
    float *metres = read_lattice(lattice, w);
    source->info.georef.height_unit = 0.3048;
    float *feet = read_lattice(lattice, w);
    size_t known = 0;
    for (int64_t k = 0; k < w.width * w.height; k++) {
        known += isfinite(metres[k]);
        if (isfinite(metres[k]))
            assert_near((double)feet[k], 0.3048 * (double)metres[k], 1e-3);
    }
    assert_true(known > 1000);
    free(metres);
    free(feet);
    scene_geodetic_destroy(lattice);
    close_ground(source, heights);
}

/* Rows and columns that are done together come out as positions one by one: at the rim, beyond it, and beside voids. */
static void gridsAreTheirPoints(void **state)
{
    (void)state;
    enum { SIDE = 40, COLUMNS = SCENE_PART_MOST, ROWS = 190 };
    float z[SIDE * SIDE], *out = malloc((COLUMNS + 3) * ROWS * sizeof *out);
    double x[COLUMNS], y[ROWS];
    for (int k = 0; k < SIDE * SIDE; k++)
        z[k] = k % 37 == 5 || (k > 800 && k < 850) ? NAN : (float)(900 * sin(0.7 * k) + 0.01 * k * k);
    for (int k = 0; k < COLUMNS; k++)
        x[k] = k % 61 == 7 ? (double)NAN : -1.2 + 0.165 * k;
    for (int k = 0; k < ROWS; k++)
        y[k] = k == 90 ? (double)NAN : SIDE + 0.3 - 0.22 * k;
    size_t known = 0;
    for (int kind = 0; kind < 4; kind++) {
        const tl_source_info info = {.width = SIDE,
                                     .height = SIDE,
                                     .type = kind & 1 ? TL_RASTER_AREA : TL_RASTER_POINT,
                                     .wraps = kind > 1,
                                     .georef = tl_georef_none(),
                                     .name = "samples"};
        tl_source *source = tl_array_source_create(z, &info, NULL);
        scene_part part = {.z = NULL};
        assert_true(scene_part_find_grid(&info, COLUMNS, x, ROWS, y, &part.window));
        part.z = malloc((size_t)(part.window.width * part.window.height) * sizeof *part.z);
        assert_int_equal(scene_part_read(source, &part, NULL), TL_OK);
        scene_part_heights(&part, &info, COLUMNS, x, ROWS, y, out, COLUMNS + 3);
        for (int k = 0; k < COLUMNS * ROWS; k++) {
            float one = scene_part_height(&part, &info, x[k % COLUMNS], y[k / COLUMNS]);
            const float *in = &out[k / COLUMNS * (COLUMNS + 3) + k % COLUMNS];
            assert_true(isnan(one) ? isnan(*in) : memcmp(in, &one, sizeof one) == 0);
            known += !isnan(one);
        }
        free(part.z);
        tl_source_destroy(source);
    }
    assert_true(known > COLUMNS * ROWS);
    free(out);
}

static void whatHasNoPlaceIsRefused(void **state)
{
    (void)state;
    float z[4] = {0};
    tl_error error = {0};
    tl_source_info info = {.width = 2, .height = 2, .name = "somewhere"};
    info.georef = (tl_georef){.transform = {0, 1, 0, 0, 0, -1}, .cell_x = 1, .cell_y = 1, .height_unit = 1};
    tl_source *source = tl_array_source_create(z, &info, NULL);
    assert_null(scene_geodetic_create(source, 3, &error));
    assert_non_null(strstr(error.text, "somewhere"));
    assert_int_equal(error.status, TL_ERROR_ARGUMENT);
    tl_source_destroy(source);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(nothingIsShifted),         cmocka_unit_test(verticesDoNotDependOnTheWindow),
        cmocka_unit_test(levelsShareTheirVertices), cmocka_unit_test(heightsAreMetres),
        cmocka_unit_test(gridsAreTheirPoints),      cmocka_unit_test(whatHasNoPlaceIsRefused),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
