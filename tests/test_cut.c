/* Parts of sources: the same heights at the same places, around the globe, in coarser levels. */
#include "dem/crs.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

/* A raster whose height at (i, j) is i + 1000 j, with a void at (3, 2). */
typedef struct whole {
    tl_source *source;
    tl_crs *crs;
    float *heights;
} whole;

static whole make(const char *crs, const double t[6], int64_t width, int64_t height, tl_raster_type type)
{
    whole w = {.heights = malloc((size_t)(width * height) * sizeof(float))};
    for (int64_t k = 0; k < width * height; k++)
        w.heights[k] = (float)(k % width + 1000 * (k / width));
    w.heights[2 * width + 3] = NAN;
    assert_int_equal(dem_crs_from_text(crs, "test", &w.crs, NULL), TL_OK);
    tl_source_info info = {.width = width, .height = height, .type = type, .name = "whole", .has_voids = true};
    info.georef = (tl_georef){.crs = w.crs, .located = true, .height_unit = 1};
    memcpy(info.georef.transform, t, 6 * sizeof *t);
    dem_georef_measure(&info.georef, width, height, NULL);
    info.wraps = dem_georef_goes_around(&info.georef, width);
    w.source = tl_array_source_create(w.heights, &info, NULL);
    return w;
}

static void finish(whole *w)
{
    tl_source_destroy(w->source);
    tl_crs_release(w->crs);
    free(w->heights);
}

static float expected(const whole *w, int64_t i, int64_t j)
{
    int64_t width = w->source->info.width;
    return w->heights[j * width + (i + width) % width];
}

static bool same(float a, float b)
{
    return a == b || (isnan(a) && isnan(b));
}

/* Every window of a part holds the heights that the whole has there. */
static void check_part(const whole *w, tl_window part)
{
    tl_source *cut = tl_cut_create(w->source, part, NULL);
    assert_non_null(cut);
    float heights[64];
    unsigned char validity[64];
    for (int64_t y = 0; y < part.height; y += 3)
        for (int64_t x = 0; x < part.width; x += 2) {
            tl_window window = {x, y, part.width - x < 5 ? part.width - x : 5,
                                part.height - y < 4 ? part.height - y : 4};
            assert_int_equal(tl_source_read(cut, 0, window, heights, NULL), TL_OK);
            assert_int_equal(tl_source_validity(cut, 0, window, validity, NULL), TL_OK);
            for (int64_t k = 0; k < window.width * window.height; k++) {
                float truth = expected(w, part.x + x + k % window.width, part.y + y + k / window.width);
                assert_true(same(heights[k], truth));
                assert_int_equal(validity[k], isnan(truth) ? TL_VOID : TL_MEASURED);
            }
        }
    const double *t = cut->info.georef.transform, *s = w->source->info.georef.transform;
    for (int k = 0; k < 2; k++) {
        double there = s[3 * k] + s[3 * k + 1] * (double)part.x + s[3 * k + 2] * (double)part.y;
        assert_true(fabs(t[3 * k] - there) <= 1e-12 * fabs(there));
        assert_true(t[3 * k + 1] == s[3 * k + 1] && t[3 * k + 2] == s[3 * k + 2]);
    }
    assert_string_equal(cut->info.parameters[cut->info.parameter_count - 1].name, "window");
    tl_source_destroy(cut);
}

static void partsHoldWhatTheWholeHolds(void **state)
{
    (void)state;
    whole w = make("EPSG:32632", (double[]){500000, 30, 5, 5000000, 4, -30}, 23, 17, TL_RASTER_AREA);
    check_part(&w, (tl_window){0, 0, 23, 17});
    check_part(&w, (tl_window){2, 1, 11, 9});
    check_part(&w, (tl_window){22, 16, 1, 1});
    finish(&w);
}

static void partsGoOverTheAntimeridian(void **state)
{
    (void)state;
    whole w = make("EPSG:4326", (double[]){-170, 20, 0, 80, 0, -20}, 18, 9, TL_RASTER_AREA);
    assert_true(w.source->info.wraps);
    check_part(&w, (tl_window){15, 2, 9, 5});
    check_part(&w, (tl_window){17, 0, 18, 9});
    tl_source *cut = tl_cut_create(w.source, (tl_window){17, 0, 18, 9}, NULL);
    assert_true(cut->info.wraps);
    tl_source_destroy(cut);
    cut = tl_cut_create(w.source, (tl_window){17, 0, 17, 9}, NULL);
    assert_false(cut->info.wraps);
    tl_source_destroy(cut);
    finish(&w);
}

static void windowsOutsideAreRefused(void **state)
{
    (void)state;
    whole flat = make("EPSG:32632", (double[]){500000, 30, 0, 5000000, 0, -30}, 23, 17, TL_RASTER_AREA);
    whole globe = make("EPSG:4326", (double[]){-170, 20, 0, 80, 0, -20}, 18, 9, TL_RASTER_AREA);
    static const tl_window outside[] = {{0, 0, 24, 1},  {0, 0, 1, 18},        {-1, 0, 2, 2},       {0, -1, 2, 2},
                                        {0, 0, 0, 1},   {0, 0, 1, 0},         {23, 0, 1, 1},       {0, 17, 1, 1},
                                        {5, 5, -1, -1}, {1, 0, INT64_MAX, 1}, {0, 1, 1, INT64_MAX}};
    for (size_t k = 0; k < sizeof outside / sizeof *outside; k++) {
        tl_error error = {0};
        assert_null(tl_cut_create(flat.source, outside[k], &error));
        assert_int_equal(error.status, TL_ERROR_ARGUMENT);
        assert_null(tl_cut_create(globe.source, outside[k], &error));
    }
    assert_null(tl_cut_create(globe.source, (tl_window){17, 0, 19, 9}, NULL));
    assert_null(tl_cut_create(globe.source, (tl_window){18, 0, 1, 1}, NULL));
    finish(&flat);
    finish(&globe);
}

/* A part has a level of the file where its cells are the file's, and none where they are not. */
static void coarserLevelsAreTheFilesOwn(void **state)
{
    (void)state;
    char folder[] = "/tmp/talus-cut-XXXXXX", path[64];
    assert_non_null(mkdtemp(folder));
    snprintf(path, sizeof path, "%s/a.tif", folder);
    for (int type = 0; type < 2; type++) {
        whole w = make("EPSG:32632", (double[]){500000, 30, 0, 5000000, 0, -30}, 61, 47, (tl_raster_type)type);
        assert_int_equal(tl_write_grid(w.source, path, &(tl_write_options){.overwrite = true}, NULL), TL_OK);
        tl_source *file = tl_open(path, NULL);
        tl_source *good = tl_cut_create(file, (tl_window){8, 16, 53, 31}, NULL),
                  *odd = tl_cut_create(file, (tl_window){9, 16, 52, 31}, NULL),
                  *inner = tl_cut_create(file, (tl_window){8, 16, 18, 12}, NULL);
        int64_t width, height;
        assert_int_equal(tl_source_size(good, -3, &width, &height, NULL), TL_OK);
        assert_true(width == 7 && height == 4);
        assert_int_equal(tl_source_size(good, -4, &width, &height, NULL), TL_ERROR_ARGUMENT);
        assert_int_equal(tl_source_size(odd, -1, &width, &height, NULL), TL_ERROR_ARGUMENT);
        assert_int_equal(tl_source_size(inner, -1, &width, &height, NULL), TL_OK);
        assert_int_equal(tl_source_size(inner, -2, &width, &height, NULL), type ? TL_OK : TL_ERROR_ARGUMENT);
        float part[28], same_part[28];
        assert_int_equal(tl_source_read(good, -3, (tl_window){0, 0, 7, 4}, part, NULL), TL_OK);
        assert_int_equal(tl_source_read(file, -3, (tl_window){1, 2, 7, 4}, same_part, NULL), TL_OK);
        assert_memory_equal(part, same_part, sizeof part);
        tl_source_destroy(good);
        tl_source_destroy(odd);
        tl_source_destroy(inner);
        tl_source_destroy(file);
        finish(&w);
    }
    unlink(path);
    rmdir(folder);
}

static void expect_window(const whole *w, const double box[4], tl_window expected_window)
{
    tl_window found = {0};
    tl_error error = {0};
    if (tl_cut_of_box(&w->source->info, box, &found, &error) != TL_OK)
        fail_msg("%s", error.text);
    assert_memory_equal(&found, &expected_window, sizeof found);
}

static void boxesBecomeWindows(void **state)
{
    (void)state;
    whole area = make("EPSG:32632", (double[]){500015, 30, 0, 4999985, 0, -30}, 23, 17, TL_RASTER_AREA);
    expect_window(&area, (double[]){500000, 4999490, 500690, 5000000}, (tl_window){0, 0, 23, 17});
    expect_window(&area, (double[]){500030, 4999910, 500090, 4999970}, (tl_window){1, 1, 2, 2}); /* its cells' edges */
    expect_window(&area, (double[]){400000, 4999970, 500030, 6000000}, (tl_window){0, 0, 1, 1});
    tl_error error = {0};
    tl_window none;
    assert_int_equal(tl_cut_of_box(&area.source->info, (double[]){0, 0, 1, 1}, &none, &error), TL_ERROR_ARGUMENT);
    assert_int_equal(tl_cut_of_box(&area.source->info, (double[]){500090, 0, 500000, 1e7}, &none, &error),
                     TL_ERROR_ARGUMENT);
    assert_int_equal(tl_cut_of_box(&area.source->info, (double[]){500000, (double)NAN, 500090, 1e7}, &none, &error),
                     TL_ERROR_ARGUMENT);
    finish(&area);

    whole point = make("EPSG:4326", (double[]){179, 0.5, 0, 10, 0, -0.5}, 9, 5, TL_RASTER_POINT);
    expect_window(&point, (double[]){179.5, 9, 180.5, 9.5}, (tl_window){1, 1, 3, 2});
    expect_window(&point, (double[]){179.5, 9, -179.5, 9.5}, (tl_window){1, 1, 3, 2});
    expect_window(&point, (double[]){-180, 8, -179, 9}, (tl_window){2, 2, 3, 3});
    finish(&point);

    whole globe = make("EPSG:4326", (double[]){-170, 20, 0, 80, 0, -20}, 18, 9, TL_RASTER_AREA);
    expect_window(&globe, (double[]){140, -40, -140, 40}, (tl_window){16, 2, 4, 5});
    expect_window(&globe, (double[]){-180, -90, 180, 90}, (tl_window){0, 0, 18, 9});
    expect_window(&globe, (double[]){0, -90, 360, 90}, (tl_window){9, 0, 18, 9});
    finish(&globe);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(partsHoldWhatTheWholeHolds), cmocka_unit_test(partsGoOverTheAntimeridian),
        cmocka_unit_test(windowsOutsideAreRefused),   cmocka_unit_test(coarserLevelsAreTheFilesOwn),
        cmocka_unit_test(boxesBecomeWindows),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
