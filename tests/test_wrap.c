/* Rasters that go around the globe: their first and last columns are neighbours. */
#include "fbm/kernel.h"
#include "lib/base/georef.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

enum { WIDTH = 48, HEIGHT = 40 };

static tl_source *array_of(const float *heights, int64_t width, int64_t height, tl_raster_type type, bool wraps)
{
    tl_source_info info = {.width = width,
                           .height = height,
                           .type = type,
                           .georef = tl_georef_none(),
                           .has_voids = true,
                           .wraps = wraps,
                           .name = "globe"};
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    assert_non_null(source);
    return source;
}

static tl_source *refine(const tl_source *dem, int levels, double delta)
{
    tl_error error = {0};
    tl_source *field = tl_field_create(dem,
                                       &(tl_field_options){.levels = levels,
                                                           .scheme = "stationary",
                                                           .hurst_given = true,
                                                           .delta_given = true,
                                                           .hurst = 0.6,
                                                           .delta = delta,
                                                           .seed = 11},
                                       &error);
    if (!field)
        fail_msg("%s", error.text);
    return field;
}

static void read_window(const tl_source *source, tl_window window, float *out)
{
    tl_error error = {0};
    if (tl_source_read(source, source->info.level, window, out, &error) != TL_OK)
        fail_msg("%s", error.text);
}

static float *read_all(const tl_source *source)
{
    float *heights = malloc(sizeof *heights * (size_t)(source->info.width * source->info.height));
    assert_non_null(heights);
    read_window(source, (tl_window){0, 0, source->info.width, source->info.height}, heights);
    return heights;
}

static bool same(float a, float b)
{
    return a == b || (isnan(a) && isnan(b));
}

/* Heights with some voids, `turns` times side by side. */
static float *make_globe(int turns)
{
    float *heights = malloc(sizeof *heights * (size_t)(WIDTH * turns * HEIGHT));
    assert_non_null(heights);
    for (int j = 0; j < HEIGHT; j++)
        for (int i = 0; i < WIDTH * turns; i++) {
            uint32_t h = (uint32_t)(i % WIDTH) * 2654435761u ^ (uint32_t)j * 2246822519u;
            h = (h ^ h >> 15) * 3266489917u;
            heights[j * WIDTH * turns + i] = h >> 24 < 4 ? NAN : (float)(h >> 20);
        }
    return heights;
}

/* Without noise, the globe is the middle one of three side by side. */
static void refinementSeesAcrossTheSeam(void **state)
{
    (void)state;
    float *once = make_globe(1), *thrice = make_globe(3);
    for (int k = 0; k < 6; k++) {
        tl_raster_type type = k % 2 ? TL_RASTER_POINT : TL_RASTER_AREA;
        int levels = 1 + k / 2;
        tl_source *dem = array_of(once, WIDTH, HEIGHT, type, true);
        tl_source *three = array_of(thrice, 3 * WIDTH, HEIGHT, type, false);
        tl_source *field = refine(dem, levels, 0), *wide = refine(three, levels, 0);
        assert_int_equal(field->info.wraps, type == TL_RASTER_AREA);
        float *a = read_all(field), *b = malloc(sizeof *b * (size_t)(field->info.width * field->info.height));
        read_window(wide, (tl_window){(int64_t)WIDTH << levels, 0, field->info.width, field->info.height}, b);
        for (int64_t n = 0; n < field->info.width * field->info.height; n++)
            assert_true(same(a[n], b[n]));
        free(a);
        free(b);
        tl_source_destroy(field);
        tl_source_destroy(wide);
        tl_source_destroy(dem);
        tl_source_destroy(three);
    }
    free(once);
    free(thrice);
}

/* A window of any width around the globe, by every kernel, has the bits of the one a turn before. */
static void noiseComesAgainAfterATurn(void **state)
{
    (void)state;
    enum { PERIOD = 21, OUT = 75 };
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++)
        for (const fbm_kernel *const *kernel = fbm_kernels(); *kernel; kernel++)
            for (int64_t turn = -2; turn <= 2; turn++) {
                fbm_step step = {.scheme = scheme, .amplitude = 1, .seed = 3, .period = PERIOD};
                scheme->weights(0.4, &step.weights);
                fbm_window to = {.i = 5, .j = -3, .width = OUT, .height = 9, .stride = OUT};
                fbm_window from = fbm_refine_support(scheme, to);
                float *in = calloc(from.width * from.height, sizeof *in);
                float *scratch = malloc(sizeof *scratch * fbm_refine_scratch(OUT));
                static float here[OUT * 9], there[OUT * 9];
                fbm_refine_by(*kernel, &step, in, NULL, from, here, to, scratch);
                to.i += 2 * PERIOD * turn;
                from.i += PERIOD * turn;
                fbm_refine_by(*kernel, &step, in, NULL, from, there, to, scratch);
                assert_memory_equal(here, there, sizeof here);
                /* and within the window */
                for (int x = 0; x + 2 * PERIOD < OUT; x++)
                    assert_true(here[x] == here[x + 2 * PERIOD]);
                step.period = 0;
                fbm_refine_by(*kernel, &step, in, NULL, from, there, to, scratch);
                assert_true(turn == 0 || memcmp(here, there, sizeof here) != 0);
                free(in);
                free(scratch);
            }
}

/* Mean square of the step from one column to the next over the boundary behind cell `column` of the DEM. */
static double step_over(const float *heights, int64_t width, int64_t height, int64_t x)
{
    double sum = 0;
    for (int64_t y = 0; y < height; y++) {
        double step = (double)heights[y * width + (x + 1) % width] - (double)heights[y * width + x];
        sum += step * step;
    }
    return sum / (double)height;
}

/* How far the step over the seam lies from those over the other cell boundaries, in standard deviations of these. */
static double seam_deviation(bool wraps)
{
    enum { LEVELS = 3, ROWS = 512 };
    float *flat = calloc(WIDTH * ROWS, sizeof *flat);
    tl_source *dem = array_of(flat, WIDTH, ROWS, TL_RASTER_AREA, wraps), *field = refine(dem, LEVELS, 1);
    float *heights = read_all(field);
    int64_t width = field->info.width, unit = 1 << LEVELS;
    double sum = 0, squares = 0, seam = step_over(heights, width, field->info.height, width - 1);
    for (int64_t k = 1; k < WIDTH; k++) {
        double mean = step_over(heights, width, field->info.height, k * unit - 1);
        sum += mean;
        squares += mean * mean;
    }
    double mean = sum / (WIDTH - 1), variance = squares / (WIDTH - 1) - mean * mean;
    free(heights);
    tl_source_destroy(field);
    tl_source_destroy(dem);
    free(flat);
    return fabs(seam - mean) / sqrt(variance);
}

/* The steps over the boundaries are means of 4096 squares each, near to normal: 5 deviations come by chance once in two
 * million. Where nothing wraps, both sides of the seam are independent, and the step is far larger. */
static void detailJoinsAtTheSeamAsElsewhere(void **state)
{
    (void)state;
    double around = seam_deviation(true), flat = seam_deviation(false);
    if (!(around <= 5) || !(flat > 5))
        fail_msg("the seam is off by %g deviations, without wrapping by %g", around, flat);
}

static void aNarrowGlobeIsReadSeveralTimesAround(void **state)
{
    (void)state;
    static const float heights[3 * 5] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    for (int64_t width = 1; width <= 3; width++) {
        tl_source *dem = array_of(heights, width, 5, TL_RASTER_AREA, true), *field = refine(dem, 4, 1);
        float *all = read_all(field);
        for (int64_t k = 0; k < field->info.width * field->info.height; k++)
            assert_true(isfinite(all[k]));
        free(all);
        tl_source_destroy(field);
        tl_source_destroy(dem);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(refinementSeesAcrossTheSeam),
        cmocka_unit_test(noiseComesAgainAfterATurn),
        cmocka_unit_test(detailJoinsAtTheSeamAsElsewhere),
        cmocka_unit_test(aNarrowGlobeIsReadSeveralTimesAround),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
