/* Voids: membranes are harmonic, whatever the shape of the hole, the window that is read and the number of threads. */
#include "dem/membrane.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>

#include <cmocka.h>

#include "tests/near.h"

#include <stdio.h>
#include <string.h>

/* A discrete harmonic function: the mean of the four neighbours of every sample, exactly. */
static double harmonic(double x, double y)
{
    return 1000 * (x * x - y * y) + 300 * x * y + 50 * y;
}

typedef struct raster {
    int64_t width, height;
    float *truth, *heights; /* heights has the holes */
    tl_source *source;
} raster;

typedef bool (*hole)(int64_t x, int64_t y, int64_t width, int64_t height);

static void raster_make(raster *r, int64_t width, int64_t height, hole is_void)
{
    *r = (raster){.width = width, .height = height};
    r->truth = tl_alloc_grid(width, height, sizeof *r->truth);
    r->heights = tl_alloc_grid(width, height, sizeof *r->heights);
    for (int64_t y = 0; y < height; y++)
        for (int64_t x = 0; x < width; x++) {
            float z = (float)harmonic((double)x / 500, (double)y / 500);
            r->truth[y * width + x] = z;
            r->heights[y * width + x] = is_void(x, y, width, height) ? NAN : z;
        }
    tl_source_info info = {
        .width = width, .height = height, .has_voids = true, .georef = tl_georef_none(), .name = "raster"};
    r->source = tl_array_source_create(r->heights, &info, NULL);
}

static void raster_free(raster *r)
{
    tl_source_destroy(r->source);
    free(r->truth);
    free(r->heights);
}

static bool square(int64_t x, int64_t y, int64_t w, int64_t h)
{
    return x > 2 && y > 2 && x < w - 3 && y < h - 3;
}

static bool ring(int64_t x, int64_t y, int64_t w, int64_t h)
{
    double r = hypot((double)x / (double)w - .5, (double)y / (double)h - .5);
    return r > .15 && r < .45 && x && y && x < w - 1 && y < h - 1;
}

static bool scattered(int64_t x, int64_t y, int64_t w, int64_t h)
{
    uint32_t k = (uint32_t)(x * 2654435761u) ^ (uint32_t)(y * 2246822519u);
    k = (k ^ k >> 15) * 0x2c1b3c6du;
    return x && y && x < w - 1 && y < h - 1 && (k >> 16) % 100 < 40;
}

static bool comb(int64_t x, int64_t y, int64_t w, int64_t h)
{
    return x && y && x < w - 1 && y < h - 1 && (x % 2 || y % 7);
}

static bool everything(int64_t x, int64_t y, int64_t w, int64_t h)
{
    (void)x, (void)y, (void)w, (void)h;
    return true;
}

static float *read_all(const tl_source *s)
{
    float *out = tl_alloc_grid(s->info.width, s->info.height, sizeof *out);
    assert_int_equal(tl_source_read(s, 0, (tl_window){0, 0, s->info.width, s->info.height}, out, NULL), TL_OK);
    return out;
}

static tl_source *filled(const raster *r, const tl_run *run)
{
    tl_error error;
    tl_source *source = tl_voids_create(r->source, &(tl_void_options){.rule = TL_VOIDS_FILL, .run = run}, &error);
    if (!source)
        fail_msg("%s", error.text);
    return source;
}

/* A cycle that changes less than 1e-5 of the range ends the solution, and takes off well over half of the error; 5e-5
 * covers what is left, and the rounding of floats. */
static void harmonicSurfacesComeBack(void **state)
{
    (void)state;
    const hole holes[] = {square, ring, scattered, comb};
    const int64_t sizes[][2] = {{300, 300}, {257, 190}, {700, 65}, {8, 9}, {513, 514}};
    for (size_t h = 0; h < 4; h++)
        for (size_t s = 0; s < 5; s++) {
            raster r;
            raster_make(&r, sizes[s][0], sizes[s][1], holes[h]);
            tl_source *full = filled(&r, NULL);
            float *heights = read_all(full);
            double low = (double)INFINITY, high = -low;
            for (int64_t k = 0; k < r.width * r.height; k++) {
                low = fmin(low, (double)r.truth[k]);
                high = fmax(high, (double)r.truth[k]);
            }
            for (int64_t k = 0; k < r.width * r.height; k++)
                assert_near((double)heights[k], (double)r.truth[k],
                            2e-5 * (high - low) + 1e-6 * fmax(fabs(low), fabs(high)));
            assert_false(full->info.has_voids);
            free(heights);
            tl_source_destroy(full);
            raster_free(&r);
        }
}

static void measuredSamplesAreKeptBitForBit(void **state)
{
    (void)state;
    raster r;
    raster_make(&r, 200, 150, ring);
    tl_source *full = filled(&r, NULL);
    float *heights = read_all(full);
    unsigned char *validity = tl_alloc_grid(200, 150, 1);
    assert_int_equal(tl_source_validity(full, 0, (tl_window){0, 0, 200, 150}, validity, NULL), TL_OK);
    for (int64_t k = 0; k < 200 * 150; k++) {
        if (!isnan(r.heights[k]))
            assert_true(heights[k] == r.heights[k]);
        assert_int_equal(validity[k], isnan(r.heights[k]) ? TL_FILLED : TL_MEASURED);
    }
    free(validity);
    free(heights);
    tl_source_destroy(full);
    raster_free(&r);
}

/* Rough ground: filled samples lie within the range of the known ones, and are the mean of their neighbours. */
static void roughRimsGiveAMembrane(void **state)
{
    (void)state;
    raster r;
    raster_make(&r, 260, 260, ring);
    float low = INFINITY, high = -INFINITY;
    for (int64_t k = 0; k < 260 * 260; k++)
        if (!isnan(r.heights[k])) {
            r.heights[k] = (float)((k * 7919) % 1000);
            low = fminf(low, r.heights[k]);
            high = fmaxf(high, r.heights[k]);
        }
    tl_source *full = filled(&r, NULL);
    float *z = read_all(full);
    for (int64_t y = 1; y < 259; y++)
        for (int64_t x = 1; x < 259; x++) {
            int64_t k = y * 260 + x;
            if (!isnan(r.heights[k]))
                continue;
            assert_true(z[k] >= low - 0.02F && z[k] <= high + 0.02F);
            double mean = 0.25 * ((double)z[k - 1] + (double)z[k + 1] + (double)z[k - 260] + (double)z[k + 260]);
            assert_near((double)z[k], mean, 0.04); /* two errors of 2e-5 of 1000 */
        }
    free(z);
    tl_source_destroy(full);
    raster_free(&r);
}

static void threadsAndWindowsDoNotMatter(void **state)
{
    (void)state;
    raster r;
    raster_make(&r, 1200, 900, square); /* large enough for the solver's own threads */
    const tl_run one = {.threads = 1}, four = {.threads = 4};
    tl_source *a = filled(&r, &one), *b = filled(&r, &four);
    float *whole = read_all(a), *other = read_all(b);
    assert_memory_equal(whole, other, 1200 * 900 * sizeof *whole);
    float part[50 * 70];
    assert_int_equal(tl_source_read(b, 0, (tl_window){611, 333, 70, 50}, part, NULL), TL_OK);
    for (int64_t y = 0; y < 50; y++)
        assert_memory_equal(part + y * 70, whole + (333 + y) * 1200 + 611, 70 * sizeof *part);
    free(whole);
    free(other);
    tl_source_destroy(a);
    tl_source_destroy(b);
    raster_free(&r);
}

/* A hole across the seam of a raster that goes around the globe, between heights 0 and 100: a ramp. */
static void holesJoinAroundTheGlobe(void **state)
{
    (void)state;
    const int64_t widths[] = {256, 300};
    for (size_t n = 0; n < 2; n++) {
        int64_t width = widths[n], height = 8;
        float *heights = tl_alloc_grid(width, height, sizeof *heights);
        for (int64_t k = 0; k < width * height; k++) {
            int64_t x = k % width;
            heights[k] = x < 9 || x >= width - 10 ? NAN : x < width / 2 ? 100 : 0; /* 19 voids: 20 steps of 5 */
        }
        tl_source_info info = {.width = width,
                               .height = height,
                               .has_voids = true,
                               .georef = tl_georef_none(),
                               .name = "globe",
                               .wraps = true};
        raster r = {.width = width, .height = height, .source = tl_array_source_create(heights, &info, NULL)};
        tl_source *full = filled(&r, NULL);
        float *z = read_all(full);
        for (int64_t y = 0; y < height; y++)
            for (int64_t step = 0; step <= 20; step++) {
                int64_t x = (width - 11 + step) % width;
                assert_near((double)z[y * width + x], 5.0 * (double)step, 0.01);
            }
        free(z);
        tl_source_destroy(full);
        tl_source_destroy(r.source);
        free(heights);
    }
}

static void holesAtTheRimMeetItFlat(void **state)
{
    (void)state;
    enum { SIDE = 40 };
    float heights[SIDE * SIDE];
    for (int k = 0; k < SIDE * SIDE; k++)
        heights[k] = k % SIDE < 20 ? 7 : NAN; /* the right half is open: the only bounded harmonic surface is flat */
    assert_int_equal(dem_membrane_fill(heights, SIDE, SIDE, NULL, NULL), TL_OK);
    for (int k = 0; k < SIDE * SIDE; k++)
        assert_near((double)heights[k], 7, 1e-4);
}

static void linesAndSingleSamplesAreFilled(void **state)
{
    (void)state;
    float line[9] = {0, NAN, NAN, NAN, 4, NAN, NAN, 10, NAN};
    const double expected[9] = {0, 1, 2, 3, 4, 6, 8, 10, 10};
    float column[9];
    memcpy(column, line, sizeof line);
    assert_int_equal(dem_membrane_fill(line, 9, 1, NULL, NULL), TL_OK);
    assert_int_equal(dem_membrane_fill(column, 1, 9, NULL, NULL), TL_OK);
    for (int k = 0; k < 9; k++) {
        assert_near((double)line[k], expected[k], 1e-3);
        assert_near((double)column[k], expected[k], 1e-3);
    }
    float one[1] = {NAN};
    assert_int_equal(dem_membrane_fill(one, 1, 1, NULL, NULL), TL_OK);
    assert_true(isnan(one[0]));
}

static void extremeHeightsStayFinite(void **state)
{
    (void)state;
    enum { SIDE = 65 };
    float heights[SIDE * SIDE];
    for (int k = 0; k < SIDE * SIDE; k++)
        heights[k] = k % SIDE % 64 && k / SIDE % 64 ? NAN : k % 2 ? 1e30F : -1e30F;
    assert_int_equal(dem_membrane_fill(heights, SIDE, SIDE, NULL, NULL), TL_OK);
    for (int k = 0; k < SIDE * SIDE; k++)
        assert_true(fabsf(heights[k]) <= 1.0001e30F);
}

static void allVoidStaysVoid(void **state)
{
    (void)state;
    raster r;
    raster_make(&r, 130, 70, everything);
    tl_source *full = filled(&r, NULL);
    float *heights = read_all(full);
    for (int64_t k = 0; k < 130 * 70; k++)
        assert_true(isnan(heights[k]));
    assert_true(full->info.has_voids);
    free(heights);
    tl_source_destroy(full);
    raster_free(&r);
}

static void voidsTakeAValue(void **state)
{
    (void)state;
    raster r;
    raster_make(&r, 50, 40, ring);
    tl_source *full = tl_voids_create(r.source, &(tl_void_options){.rule = TL_VOIDS_VALUE, .value = -3}, NULL);
    float *heights = read_all(full);
    for (int64_t k = 0; k < 50 * 40; k++)
        assert_true(heights[k] == (isnan(r.heights[k]) ? -3 : r.heights[k]));
    assert_string_equal(full->info.parameters[full->info.parameter_count - 1].value, "-3");
    free(heights);
    tl_source_destroy(full);
    tl_error error;
    assert_null(tl_voids_create(r.source, &(tl_void_options){.rule = TL_VOIDS_VALUE, .value = NAN}, &error));
    assert_int_equal(error.status, TL_ERROR_ARGUMENT);
    full = tl_voids_create(r.source, NULL, NULL);
    heights = read_all(full);
    assert_memory_equal(heights, r.heights, 50 * 40 * sizeof *heights);
    free(heights);
    tl_source_destroy(full);
    raster_free(&r);
}

static void cancellingEndsTheFilling(void **state)
{
    (void)state;
    raster r;
    raster_make(&r, 300, 300, square);
    int raised = 1;
    tl_run run = {.cancel = &raised};
    tl_error error;
    assert_null(tl_voids_create(r.source, &(tl_void_options){.rule = TL_VOIDS_FILL, .run = &run}, &error));
    assert_int_equal(error.status, TL_ERROR_CANCELLED);
    raster_free(&r);
}

/* The detail around a hole is that of the measured ground: the smooth filling must not count. */
/* What a large hole takes is told before it is tried, and is enough; with just enough for one small hole at a time many
 * of them are filled as by all threads. */
static void memoryIsAskedForBeforeItIsTaken(void **state)
{
    (void)state;
    raster large, small;
    raster_make(&large, 1500, 900, square);
    raster_make(&small, 1500, 900, ring);
    tl_error error = {0};
    tl_run run = {.threads = 4, .memory = 8 << 20};
    tl_void_options options = {.rule = TL_VOIDS_FILL, .run = &run};
    assert_null(tl_voids_create(large.source, &options, &error));
    assert_int_equal(error.status, TL_ERROR_MEMORY);
    const char *number = strstr(error.text, "filling its voids takes ");
    assert_non_null(number);
    run.memory = (size_t)(atof(number + strlen("filling its voids takes ")) + 1) << 20;
    tl_source *filled = tl_voids_create(large.source, &options, &error);
    assert_non_null(filled);
    tl_source_destroy(filled);
    filled = tl_voids_create(small.source, &options, &error);
    assert_non_null(filled);
    tl_source_destroy(filled);
    raster_free(&large);
    raster_free(&small);
}

static void roughnessLooksAtMeasuredSamplesOnly(void **state)
{
    (void)state;
    raster r;
    raster_make(&r, 300, 300, ring);
    uint64_t random = 9;
    for (int64_t k = 0; k < 300 * 300; k++) {
        random = random * UINT64_C(6364136223846793005) + 1;
        r.heights[k] += (float)(random >> 40) * 1e-6F;
    }
    tl_source *full = filled(&r, NULL);
    tl_roughness with, without;
    assert_int_equal(tl_roughness_measure(r.source, NULL, &without, NULL), TL_OK);
    assert_int_equal(tl_roughness_measure(full, NULL, &with, NULL), TL_OK);
    assert_true(with.sigma == without.sigma && with.hurst == without.hurst);
    tl_source_destroy(full);
    raster_free(&r);
}

static void theFieldTellsWhatIsFilled(void **state)
{
    (void)state;
    for (int type = 0; type < 2; type++) {
        raster r;
        raster_make(&r, 40, 30, ring);
        r.source->info.type = (tl_raster_type)type;
        tl_source *full = filled(&r, NULL);
        tl_source *field = tl_field_create(full, &(tl_field_options){.levels = 2}, NULL);
        int64_t width = field->info.width, height = field->info.height;
        unsigned char *validity = tl_alloc_grid(width, height, 1);
        assert_int_equal(tl_source_validity(field, 2, (tl_window){0, 0, width, height}, validity, NULL), TL_OK);
        for (int64_t y = 0; y < height; y++)
            for (int64_t x = 0; x < width; x++) {
                bool right = type == TL_RASTER_POINT && x % 4, below = type == TL_RASTER_POINT && y % 4;
                bool made_up = false;
                for (int k = 0; k < 4; k++)
                    made_up |= isnan(r.heights[(y / 4 + (k / 2 && below)) * 40 + x / 4 + (k % 2 && right)]) != 0;
                assert_int_equal(validity[y * width + x], made_up ? TL_FILLED : TL_MEASURED);
            }
        free(validity);
        tl_source_destroy(field);
        tl_source_destroy(full);
        raster_free(&r);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(harmonicSurfacesComeBack),
        cmocka_unit_test(measuredSamplesAreKeptBitForBit),
        cmocka_unit_test(roughRimsGiveAMembrane),
        cmocka_unit_test(threadsAndWindowsDoNotMatter),
        cmocka_unit_test(holesJoinAroundTheGlobe),
        cmocka_unit_test(holesAtTheRimMeetItFlat),
        cmocka_unit_test(linesAndSingleSamplesAreFilled),
        cmocka_unit_test(extremeHeightsStayFinite),
        cmocka_unit_test(allVoidStaysVoid),
        cmocka_unit_test(voidsTakeAValue),
        cmocka_unit_test(cancellingEndsTheFilling),
        cmocka_unit_test(memoryIsAskedForBeforeItIsTaken),
        cmocka_unit_test(roughnessLooksAtMeasuredSamplesOnly),
        cmocka_unit_test(theFieldTellsWhatIsFilled),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
