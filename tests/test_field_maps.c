/* Maps of the Hurst exponent and of delta under a field: where they lie, windows, means of cells, statistics. */
#include "fbm/estimate.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/scene/field_map.h"
#include "lib/scene/patch.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

enum { WIDTH = 37, HEIGHT = 29 };

static uint32_t arbitrary_state = 77;

static uint32_t arbitrary(uint32_t below)
{
    arbitrary_state = arbitrary_state * 1664525 + 1013904223;
    return (uint32_t)((uint64_t)(arbitrary_state >> 8) * below >> 24);
}

static tl_source_info info_of(int64_t width, int64_t height, tl_raster_type type, double cell, const char *name)
{
    tl_source_info info = {.width = width, .height = height, .type = type, .georef = tl_georef_none(), .name = name};
    info.georef.located = true;
    info.georef.transform[1] = info.georef.cell_x = cell;
    info.georef.transform[5] = -cell;
    info.georef.cell_y = cell;
    return info;
}

/* A raster that keeps its own numbers. */
typedef struct raster {
    float numbers[WIDTH * HEIGHT];
    tl_source *source;
} raster;

typedef float (*number_at)(int i, int j);

static void raster_make(raster *r, number_at at, tl_raster_type type, double cell, const char *name)
{
    for (int j = 0; j < HEIGHT; j++)
        for (int i = 0; i < WIDTH; i++)
            r->numbers[j * WIDTH + i] = at(i, j);
    tl_source_info info = info_of(WIDTH, HEIGHT, type, cell, name);
    info.has_voids = true;
    r->source = tl_array_source_create(r->numbers, &info, NULL);
    assert_non_null(r->source);
}

static float ground_at(int i, int j)
{
    return (float)(500 + 40 * sin(.3 * i) * cos(.23 * j));
}

static float ramp_at(int i, int j)
{
    return .05F + .9F * (float)(i + j) / (WIDTH + HEIGHT);
}

static float strength_at(int i, int j)
{
    return (i + j) % 2 ? 1e-3F : 10;
}

static float seven_tenths(int i, int j)
{
    (void)i;
    (void)j;
    return .7F;
}

static float five(int i, int j)
{
    (void)i;
    (void)j;
    return 5;
}

static float one_half(int i, int j)
{
    (void)i;
    (void)j;
    return .5F;
}

static float nothing(int i, int j)
{
    (void)i;
    (void)j;
    return NAN;
}

static float voids_about(int i, int j)
{
    return (i + 2 * j) % 5 ? ramp_at(i, j) : NAN;
}

static const tl_field_options fbm_of = {
    .levels = 5, .hurst_given = true, .hurst = (double).7F, .delta_given = true, .delta = 5, .seed = 3};

static tl_source *make_field(const tl_source *dem, tl_field_options options)
{
    tl_error error;
    tl_source *field = tl_field_create(dem, &options, &error);
    if (!field)
        fail_msg("%s", error.text);
    return field;
}

static float *read_part(const tl_source *source, tl_window window)
{
    tl_error error;
    float *out = tl_alloc_grid(window.width, window.height, sizeof *out);
    assert_non_null(out);
    if (tl_source_read(source, source->info.level, window, out, &error) != TL_OK)
        fail_msg("%s", error.text);
    return out;
}

static float *read_all(const tl_source *source)
{
    return read_part(source, (tl_window){0, 0, source->info.width, source->info.height});
}

/* The level below 500 m that a new sample may be off by, where coefficients are off by 5e-6 and 1e-6 and rounding (see
 * test_fbm_places.c): heights have a range of 80, and noise of 5 standard deviations and 4.9 times these at most is
 * another 50. Predictors hand on errors of the levels above, no more than a few times in all. */
static const double nearly = 5 * (24 * 5e-6 * 130 + 24 * 0x1p-23 * 700);

static double largest_difference(const tl_source *a, const tl_source *b)
{
    float *x = read_all(a), *y = read_all(b);
    double largest = 0;
    for (int64_t k = 0; k < a->info.width * a->info.height; k++)
        largest = fmax(largest, fabs((double)x[k] - (double)y[k]));
    free(x);
    free(y);
    return largest;
}

static double rms_difference(const tl_source *a, const tl_source *b)
{
    float *x = read_all(a), *y = read_all(b);
    double sum = 0;
    for (int64_t k = 0; k < a->info.width * a->info.height; k++)
        sum += ((double)x[k] - (double)y[k]) * ((double)x[k] - (double)y[k]);
    free(x);
    free(y);
    return sqrt(sum / (double)(a->info.width * a->info.height));
}

static void mapsOfOneValueMakeTheSameField(void **state)
{
    (void)state;
    raster dem, hurst, delta;
    raster_make(&hurst, seven_tenths, TL_RASTER_POINT, 30, "hurst");
    raster_make(&delta, five, TL_RASTER_POINT, 30, "delta");
    for (int type = 0; type < 2; type++) {
        raster_make(&dem, ground_at, (tl_raster_type)type, 30, "ground");
        tl_field_options options = fbm_of;
        options.scheme = "stationary";
        tl_source *plain = make_field(dem.source, options);
        options.delta_map = delta.source;
        tl_source *scaled = make_field(dem.source, options);
        options.hurst_map = hurst.source;
        tl_source *placed = make_field(dem.source, options);
        assert_true(largest_difference(plain, scaled) < nearly);
        assert_true(largest_difference(plain, placed) < nearly);
        tl_source_destroy(plain), tl_source_destroy(scaled), tl_source_destroy(placed);
        tl_source_destroy(dem.source);
    }
    tl_source_destroy(hurst.source);
    tl_source_destroy(delta.source);
}

static float one_tenth(int i, int j)
{
    (void)i, (void)j;
    return .1F;
}

/* Far from the exponent that the command line gives: the means of cells are kept by points that are chosen with the
 * place's own response, not by bumps within the cells. */
static void areaMapsKeepMeansByTheirOwnExponent(void **state)
{
    (void)state;
    raster dem, hurst;
    raster_make(&hurst, one_tenth, TL_RASTER_AREA, 30, "hurst");
    raster_make(&dem, ground_at, TL_RASTER_AREA, 30, "ground");
    tl_field_options options = fbm_of;
    options.scheme = "stationary";
    options.hurst = .1;
    tl_source *plain = make_field(dem.source, options);
    options.hurst = .5;
    options.hurst_map = hurst.source;
    tl_source *placed = make_field(dem.source, options);
    /* what is left to bumps with the own response is .023 delta rms; with that of 1/2 it was .39 delta */
    assert_true(rms_difference(plain, placed) < .023 * options.delta);
    tl_source_destroy(plain), tl_source_destroy(placed);
    tl_source_destroy(dem.source);
    tl_source_destroy(hurst.source);
}

/* Cells whose rows are halved once and twice, or columns, at an exponent that the halvings' weights are made for. */
static void mapsOfOneValueFollowTheShapeOfCells(void **state)
{
    (void)state;
    static const double aspects[] = {.8, .55, .3, 2.2};
    raster dem, hurst;
    raster_make(&hurst, one_half, TL_RASTER_POINT, 30, "hurst");
    for (size_t k = 0; k < sizeof aspects / sizeof *aspects; k++) {
        raster_make(&dem, ground_at, TL_RASTER_POINT, 30, "ground");
        dem.source->info.georef.cell_x *= aspects[k];
        tl_field_options options = fbm_of;
        options.scheme = "stationary";
        options.levels = 3;
        options.hurst = .5;
        tl_source *plain = make_field(dem.source, options);
        options.hurst_map = hurst.source;
        tl_source *placed = make_field(dem.source, options);
        assert_true(largest_difference(plain, placed) < nearly);
        tl_source_destroy(plain), tl_source_destroy(placed), tl_source_destroy(dem.source);
    }
    tl_source_destroy(hurst.source);
}

static float above_one(int i, int j)
{
    (void)j;
    return i % 2 ? 1.3F : 1.9F;
}

static float ninety_nine(int i, int j)
{
    (void)i;
    (void)j;
    return .99F;
}

/* What real terrain measures where it is smooth. */
static void exponentsAboveOneAreTheNearest(void **state)
{
    (void)state;
    raster dem, high, most;
    raster_make(&dem, ground_at, TL_RASTER_POINT, 30, "ground");
    raster_make(&high, above_one, TL_RASTER_POINT, 30, "high");
    raster_make(&most, ninety_nine, TL_RASTER_POINT, 30, "most");
    tl_field_options options = fbm_of;
    options.hurst_map = high.source;
    tl_source *a = make_field(dem.source, options);
    options.hurst_map = most.source;
    tl_source *b = make_field(dem.source, options);
    assert_true(largest_difference(a, b) == 0);
    tl_source_destroy(a), tl_source_destroy(b);
    tl_source_destroy(dem.source), tl_source_destroy(high.source), tl_source_destroy(most.source);
}

static void voidsInMapsTakeTheModelsOwn(void **state)
{
    (void)state;
    raster dem, empty;
    raster_make(&dem, ground_at, TL_RASTER_POINT, 30, "ground");
    raster_make(&empty, nothing, TL_RASTER_POINT, 30, "empty");
    tl_field_options options = fbm_of;
    options.scheme = "stationary";
    tl_source *plain = make_field(dem.source, options);
    options.hurst_map = options.delta_map = empty.source;
    tl_source *mapped = make_field(dem.source, options);
    options.delta_map_is_sigma = true;
    tl_source *sigma = make_field(dem.source, options);
    assert_true(largest_difference(plain, mapped) < nearly);
    assert_true(largest_difference(mapped, sigma) < nearly);
    tl_source_destroy(plain), tl_source_destroy(mapped), tl_source_destroy(sigma);
    tl_source_destroy(dem.source), tl_source_destroy(empty.source);
}

static void check_windows(const tl_source *field)
{
    float *whole = read_all(field);
    int64_t width = field->info.width, height = field->info.height;
    for (int n = 0; n < 20; n++) {
        tl_window w = {.width = 1 + arbitrary(110), .height = 1 + arbitrary(110)};
        w.x = arbitrary((uint32_t)(width - w.width + 1));
        w.y = arbitrary((uint32_t)(height - w.height + 1));
        float *part = read_part(field, w);
        for (int64_t y = 0; y < w.height; y++)
            assert_memory_equal(part + y * w.width, whole + (w.y + y) * width + w.x, (size_t)w.width * sizeof *part);
        for (int64_t k = 0; k < w.width * w.height; k++)
            assert_true(isfinite(part[k]));
        free(part);
    }
    free(whole);
}

/* Also with a delta that jumps ten-thousandfold from sample to sample, and with cells of another shape. */
static void windowsUnderMapsEqualTheWhole(void **state)
{
    (void)state;
    raster dem, hurst, delta;
    raster_make(&hurst, voids_about, TL_RASTER_POINT, 30, "hurst");
    raster_make(&delta, strength_at, TL_RASTER_POINT, 30, "delta");
    for (int type = 0; type < 2; type++)
        for (int shape = 0; shape < 5; shape++)
            for (int maps = 1; maps < 4; maps++) {
                raster_make(&dem, ground_at, (tl_raster_type)type, 30, "ground");
                static const double aspects[5] = {1, .8, 1.3, .3, 2.2};
                dem.source->info.georef.cell_x *= aspects[shape];
                tl_field_options options = fbm_of;
                options.levels = shape < 3 ? 4 : 2;
                options.hurst_map = maps & 1 ? hurst.source : NULL;
                options.delta_map = maps & 2 ? delta.source : NULL;
                tl_source *field = make_field(dem.source, options);
                check_windows(field);
                tl_source_destroy(field);
                tl_source_destroy(dem.source);
            }
    tl_source_destroy(hurst.source), tl_source_destroy(delta.source);
}

/* Every 2^l-th sample is the model's own, bit for bit. */
static void samplesAreKeptUnderMaps(void **state)
{
    (void)state;
    raster dem, hurst;
    raster_make(&dem, ground_at, TL_RASTER_POINT, 30, "ground");
    raster_make(&hurst, ramp_at, TL_RASTER_POINT, 30, "hurst");
    tl_field_options options = fbm_of;
    options.hurst_map = hurst.source;
    tl_source *field = make_field(dem.source, options);
    float *all = read_all(field);
    for (int64_t j = 0; j < HEIGHT; j++)
        for (int64_t i = 0; i < WIDTH; i++)
            assert_true(all[j * 32 * field->info.width + i * 32] == dem.numbers[j * WIDTH + i]);
    free(all);
    tl_source_destroy(field), tl_source_destroy(dem.source), tl_source_destroy(hurst.source);
}

/* As without maps: means are of heights up to 700 that are rounded to float, each by 2^-15 at most. */
static void meansOfCellsAreKeptUnderMaps(void **state)
{
    (void)state;
    raster dem, hurst, delta;
    raster_make(&dem, ground_at, TL_RASTER_AREA, 30, "ground");
    raster_make(&hurst, ramp_at, TL_RASTER_AREA, 30, "hurst");
    raster_make(&delta, ramp_at, TL_RASTER_AREA, 30, "delta");
    for (int levels = 1; levels <= 4; levels += 3) {
        tl_field_options options = fbm_of;
        options.levels = levels;
        options.hurst_map = hurst.source;
        options.delta_map = delta.source;
        tl_source *field = make_field(dem.source, options);
        float *all = read_all(field);
        int64_t side = INT64_C(1) << levels;
        for (int64_t k = 0; k < WIDTH * HEIGHT; k++) {
            double sum = 0;
            for (int64_t n = 0; n < side * side; n++)
                sum += (double)all[(k / WIDTH * side + n / side) * field->info.width + k % WIDTH * side + n % side];
            assert_true(fabs(sum / (double)(side * side) - (double)dem.numbers[k]) < 2e-4);
        }
        free(all);
        tl_source_destroy(field);
    }
    tl_source_destroy(dem.source), tl_source_destroy(hurst.source), tl_source_destroy(delta.source);
}

/* ---- Where maps lie -------------------------------------------------------------------------------- */

static const scene_field_map_rule zero_to_one = {"numbers", 0, 1, 0, 1};

static void check_laid(const scene_field_map *map, double i0, double step)
{
    float out[WIDTH * HEIGHT];
    fbm_window window = {-3, -2, WIDTH, HEIGHT, WIDTH};
    assert_int_equal(scene_field_map_read(map, window, out, NULL), TL_OK);
    for (int y = 0; y < HEIGHT; y++)
        for (int x = 0; x < WIDTH; x++) { /* the ramp is a plane, so bilinear is exact but for rounding */
            double u = fmin(fmax(i0 + step * (x - 3), 0), WIDTH - 1),
                   v = fmin(fmax(i0 + step * (y - 2), 0), HEIGHT - 1);
            double expected = (double).05F + (double).9F * (u + v) / (WIDTH + HEIGHT);
            assert_true(fabs((double)out[y * WIDTH + x] - expected) < 1e-6);
        }
}

static void mapsAreLaidByPlace(void **state)
{
    (void)state;
    raster map;
    raster_make(&map, ramp_at, TL_RASTER_POINT, 80, "map");
    tl_source_info model = info_of(100, 80, TL_RASTER_AREA, 20, "model");
    model.georef.transform[0] = 40;
    model.georef.transform[3] = -40;
    scene_field_map laid;
    assert_int_equal(scene_field_map_open(map.source, &model, &zero_to_one, 0, NULL, &laid, NULL), TL_OK);
    check_laid(&laid, .5, .25);
    assert_true(laid.least == 0);
    tl_source_destroy(map.source);
}

/* A map that does not know where it lies covers the model: of half as many samples, each covers two. */
static void mapsWithoutAPlaceCoverTheModel(void **state)
{
    (void)state;
    raster map;
    raster_make(&map, ramp_at, TL_RASTER_POINT, 80, "map");
    map.source->info.georef = tl_georef_none();
    tl_source_info model = info_of(2 * WIDTH, 2 * HEIGHT, TL_RASTER_AREA, 20, "model");
    scene_field_map laid;
    assert_int_equal(scene_field_map_open(map.source, &model, &zero_to_one, 1, NULL, &laid, NULL), TL_OK);
    check_laid(&laid, -.25, .5);
    model = info_of(WIDTH, HEIGHT, TL_RASTER_AREA, 20, "model");
    assert_int_equal(scene_field_map_open(map.source, &model, &zero_to_one, 1, NULL, &laid, NULL), TL_OK);
    check_laid(&laid, 0, 1);
    tl_source_destroy(map.source);
}

static float chequered(int i, int j)
{
    return (float)((i + j) % 2);
}

static float each_fourth(int i, int j)
{
    return i % 4 || j % 4 ? 0 : 1;
}

/* Of a map four times as fine the model's samples take the mean of 16 places an even distance apart, so a linear map is
 * as it is, a chequered one grey, and what every fourth sample says counts no more than it covers. */
static void finerMapsAreAveraged(void **state)
{
    (void)state;
    static const number_at maps[] = {ramp_at, chequered, each_fourth};
    for (int m = 0; m < 3; m++) {
        raster map;
        raster_make(&map, maps[m], TL_RASTER_POINT, 5, "map");
        tl_source_info model = info_of(10, 8, TL_RASTER_POINT, 20, "model");
        scene_field_map laid;
        float all[8 * 10], part[3];
        assert_int_equal(scene_field_map_open(map.source, &model, &zero_to_one, 0, NULL, &laid, NULL), TL_OK);
        assert_int_equal(scene_field_map_read(&laid, (fbm_window){0, 0, 10, 8, 0}, all, NULL), TL_OK);
        for (int j = 1; j < 7; j++)
            for (int i = 1; i < 9; i++) {
                double expected = m == 0 ? (double)ramp_at(4 * i, 4 * j) : m == 1 ? .5 : 1. / 16;
                assert_true(fabs((double)all[10 * j + i] - expected) < 1e-6);
            }
        assert_int_equal(scene_field_map_read(&laid, (fbm_window){4, 2, 3, 1, 0}, part, NULL), TL_OK);
        assert_memory_equal(part, all + 24, sizeof part);
        tl_source_destroy(map.source);
    }
}

/* Around a globe: column -1 is the last, and a map that goes around, too, has no seam. */
static void mapsGoAroundWithTheModel(void **state)
{
    (void)state;
    raster map;
    raster_make(&map, ramp_at, TL_RASTER_AREA, 20, "map");
    tl_source_info model = info_of(2 * WIDTH, HEIGHT, TL_RASTER_AREA, 10, "model");
    model.georef.located = false;
    model.wraps = true;
    map.source->info.wraps = true;
    scene_field_map laid;
    float out[6 * WIDTH];
    assert_int_equal(scene_field_map_open(map.source, &model, &zero_to_one, 1, NULL, &laid, NULL), TL_OK);
    assert_int_equal(scene_field_map_read(&laid, (fbm_window){-WIDTH, 3, 6 * WIDTH, 1, 0}, out, NULL), TL_OK);
    for (int i = -WIDTH; i < 5 * WIDTH; i++) {
        double u = (double)((i + 2 * WIDTH) % (2 * WIDTH)) / 2 - .25, part = u - floor(u);
        int before = ((int)floor(u) + WIDTH) % WIDTH, after = (before + 1) % WIDTH;
        double expected = (1 - part) * (double)ramp_at(before, 3) + part * (double)ramp_at(after, 3);
        assert_true(fabs((double)out[i + WIDTH] - expected) < 1e-6);
    }
    tl_source_destroy(map.source);
}

/* ---- Errors ---------------------------------------------------------------------------------------- */

static void check_refused(const tl_source *dem, tl_field_options options, const char *part)
{
    tl_error error = {.text = ""};
    assert_null(tl_field_create(dem, &options, &error));
    if (!strstr(error.text, part))
        fail_msg("'%s' does not say '%s'", error.text, part);
}

static void wrongMapsAreTold(void **state)
{
    (void)state;
    raster dem, hurst, delta;
    raster_make(&dem, ground_at, TL_RASTER_POINT, 30, "ground");
    raster_make(&hurst, ramp_at, TL_RASTER_POINT, 30, "hurst.tif");
    raster_make(&delta, five, TL_RASTER_POINT, 30, "delta.tif");
    tl_field_options options = fbm_of;
    options.hurst_map = delta.source;
    check_refused(dem.source, options, "delta.tif: holds 5 ... 5, but Hurst exponents must be from 0 to 2");
    options.hurst_map = hurst.source;
    options.scheme = "terrain";
    check_refused(dem.source, options, "scheme 'terrain' takes no maps");
    options.scheme = "square";
    check_refused(dem.source, options, "scheme 'square' takes no map of H");
    delta.numbers[5] = -1;
    options = fbm_of;
    options.delta_map = delta.source;
    check_refused(dem.source, options, "delta.tif: holds -1 ... 5, but delta must be from 0");
    delta.numbers[5] = (float)INFINITY;
    check_refused(dem.source, options, "delta.tif: holds 5 ... inf");
    tl_source_destroy(dem.source), tl_source_destroy(hurst.source), tl_source_destroy(delta.source);
}

/* ---- Statistics ------------------------------------------------------------------------------------ */

static float two_halves(int i, int j)
{
    (void)j;
    return i < WIDTH / 2 ? .3F : .8F;
}

/* The detail of a flat model has the place's exponent at lags below a node's spacing: increments over 1 ... 8 samples
 * of 32 a node. Around a node that stays flat they are not quite those of fBm, by up to a few hundredths in H: the
 * nodes, whose heights fBm would not have, hold the nearest samples down. So each half is compared with a field without
 * a map, of the same seed: where the noise is the same, so is what the estimator makes of it, but for the other half,
 * which reaches 4 nodes in. What is left is rounding and the table, below 1e-3 in H and delta. */
static void halvesHaveTheirOwnStatistics(void **state)
{
    (void)state;
    raster dem, hurst;
    raster_make(&dem, five, TL_RASTER_POINT, 32, "flat");
    raster_make(&hurst, two_halves, TL_RASTER_POINT, 32, "hurst");
    for (uint64_t seed = 1; seed < 4; seed++) {
        tl_field_options options = fbm_of;
        options.scheme = "stationary";
        options.seed = seed;
        options.delta = 3;
        options.hurst_map = hurst.source;
        tl_source *mapped = make_field(dem.source, options);
        options.hurst_map = NULL;
        for (int side = 0; side < 2; side++) {
            options.hurst = side ? (double).8F : (double).3F;
            tl_source *plain = make_field(dem.source, options);
            tl_window half = {side ? 26 * 32 : 0, 0, 12 * 32 - (side ? 64 : 0), (HEIGHT - 1) * 32 + 1};
            tl_source *parts[2] = {tl_cut_create(mapped, half, NULL), tl_cut_create(plain, half, NULL)};
            tl_statistics found[2];
            for (int k = 0; k < 2; k++) {
                assert_int_equal(tl_statistics_measure(parts[k], NULL, &found[k], NULL), TL_OK);
                tl_source_destroy(parts[k]);
            }
            const tl_fbm_estimate *a = &found[0].estimates[0], *b = &found[1].estimates[0];
            assert_true(fabs(a->hurst - b->hurst) < 1e-3 && fabs(a->delta / b->delta - 1) < 1e-3);
            assert_true(fabs(a->hurst - options.hurst) < .05);
            tl_source_destroy(plain);
        }
        tl_source_destroy(mapped);
    }
    tl_source_destroy(dem.source), tl_source_destroy(hurst.source);
}

/* Sigma of the finest octave of fBm of a given delta, as a map, makes the field of that delta. */
static void sigmaMapsMeanTheirDelta(void **state)
{
    (void)state;
    raster dem, sigma;
    for (int type = 0; type < 2; type++) {
        raster_make(&dem, ground_at, (tl_raster_type)type, 30, "ground");
        raster_make(&sigma, five, (tl_raster_type)type, 30, "sigma");
        double octave = 5 * exp2(fbm_of.hurst) * sqrt(fbm_detail_of_fbm(fbm_of.hurst, type == TL_RASTER_AREA));
        for (int k = 0; k < WIDTH * HEIGHT; k++)
            sigma.numbers[k] = (float)octave;
        tl_field_options options = fbm_of;
        tl_source *plain = make_field(dem.source, options);
        options.delta_map = sigma.source;
        options.delta_map_is_sigma = true;
        tl_source *mapped = make_field(dem.source, options);
        /* between the knots of sigma over delta lines are within 2e-5 of the curve; of noise within 130 that is: */
        assert_true(largest_difference(plain, mapped) < nearly + 130 * 2e-5);
        tl_source_destroy(plain), tl_source_destroy(mapped);
        tl_source_destroy(dem.source), tl_source_destroy(sigma.source);
    }
}

/* The maps that tl_statistics_write_maps makes are those that a field takes: of fBm they are near what it was made of,
 * so the field with them is near the field without. */
static void measuredMapsMakeAField(void **state)
{
    (void)state;
    char folder[] = "/tmp/talus-maps-XXXXXX", path[64];
    assert_non_null(mkdtemp(folder));
    snprintf(path, sizeof path, "%s/maps.tif", folder);
    tl_error error;
    tl_source *dem = tl_noise_create(&(tl_noise_options){.size = 257, .hurst = .6, .delta = 4, .seed = 5}, &error);
    assert_non_null(dem);
    tl_map_options how = {.overwrite = true};
    if (tl_statistics_write_maps(dem, path, &how, &error) != TL_OK)
        fail_msg("%s", error.text);
    tl_source *hurst = tl_open_with(path, &(tl_dem_options){.band = 1}, &error);
    tl_source *sigma = tl_open_with(path, &(tl_dem_options){.band = 2}, &error);
    assert_non_null(hurst);
    assert_non_null(sigma);
    tl_field_options options = {.levels = 2, .hurst_map = hurst, .delta_map = sigma, .delta_map_is_sigma = true};
    tl_source *field = make_field(dem, options);
    tl_statistics s;
    assert_int_equal(tl_statistics_measure(field, NULL, &s, NULL), TL_OK);
    /* A window of 65 x 65 tells H to 0.02 (see talus.h), and four octaves of delta 2^(-l H) are fitted. */
    assert_true(fabs(s.estimates[0].hurst - .6) < .05);
    assert_true(fabs(s.estimates[0].delta / (4 * exp2(-2 * .6)) - 1) < .1);
    tl_source_destroy(field), tl_source_destroy(hurst), tl_source_destroy(sigma), tl_source_destroy(dem);
    unlink(path);
    rmdir(folder);
}

/* ---- Beyond the rim ---------------------------------------------------------------------------- */

typedef struct halves {
    float delta[2], hurst[2]; /* west and east of the model's middle */
} halves;

static tl_status halves_read(const void *context, fbm_window window, float *delta, float *hurst, tl_error *error)
{
    (void)error;
    const halves *h = context;
    for (size_t k = 0; k < window.width * window.height; k++) {
        int east = window.i + (int64_t)(k % window.width) >= WIDTH / 2;
        delta[k] = h->delta[east];
        hurst[k] = h->hurst[east];
    }
    return TL_OK;
}

static scene_patch read_patch(const tl_source *dem, const halves *by, double delta, double hurst, fbm_window window)
{
    scene_patch out;
    tl_error error;
    scene_growth growth = {.rings = 10, .trend = .5F, .delta = delta, .hurst = hurst, .aspect = 1, .seed = 5};
    if (by) {
        growth.by_place = halves_read;
        growth.context = by;
    }
    assert_int_equal(scene_patch_read(dem, growth, window, &out, &error), TL_OK);
    return out;
}

/* Each half, far from the other, is as if there were but its own strength and exponent: a multiple of 1/64 is taken as
 * it is. Of another exponent the best guess is linear between two, which misses it by 1e-3 of the heights' range. */
static void surroundingsFollowTheMaps(void **state)
{
    (void)state;
    static const halves cases[] = {{{3, 0}, {.75F, .25F}}, {{.5F, 7}, {.5F, .5F}}, {{2, 2}, {.7F, .3F}}};
    const fbm_window window = {-8, -8, WIDTH + 16, HEIGHT + 16, WIDTH + 16};
    raster ground;
    raster_make(&ground, ground_at, TL_RASTER_POINT, 1, "ground");
    for (size_t c = 0; c < 3; c++) {
        scene_patch both = read_patch(ground.source, &cases[c], 1, .6, window);
        for (int east = 0; east < 2; east++) {
            halves same = {{cases[c].delta[east], cases[c].delta[east]}, {cases[c].hurst[east], cases[c].hurst[east]}};
            scene_patch alone = read_patch(ground.source, &same, 1, .6, window);
            scene_patch plain =
                read_patch(ground.source, NULL, fmax((double)same.delta[0], 1e-30), (double)same.hurst[0], window);
            for (size_t k = 0; k < window.width * window.height; k++) {
                int64_t i = window.i + (int64_t)(k % window.width);
                double most = c < 2 ? (double)fabsf(plain.heights[k]) * 0x1p-22 : .1;
                assert_true(fabs((double)alone.heights[k] - (double)plain.heights[k]) <= most);
                if (east ? i > WIDTH / 2 + 20 : i < WIDTH / 2 - 20) /* two cells a turn of 20 */
                    assert_true(alone.heights[k] == both.heights[k]);
            }
            scene_patch_free(&alone);
            scene_patch_free(&plain);
        }
        scene_patch_free(&both);
    }
    tl_source_destroy(ground.source);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(mapsOfOneValueMakeTheSameField),
        cmocka_unit_test(mapsOfOneValueFollowTheShapeOfCells),
        cmocka_unit_test(exponentsAboveOneAreTheNearest),
        cmocka_unit_test(voidsInMapsTakeTheModelsOwn),
        cmocka_unit_test(windowsUnderMapsEqualTheWhole),
        cmocka_unit_test(samplesAreKeptUnderMaps),
        cmocka_unit_test(meansOfCellsAreKeptUnderMaps),
        cmocka_unit_test(mapsAreLaidByPlace),
        cmocka_unit_test(areaMapsKeepMeansByTheirOwnExponent),
        cmocka_unit_test(mapsWithoutAPlaceCoverTheModel),
        cmocka_unit_test(finerMapsAreAveraged),
        cmocka_unit_test(mapsGoAroundWithTheModel),
        cmocka_unit_test(wrongMapsAreTold),
        cmocka_unit_test(halvesHaveTheirOwnStatistics),
        cmocka_unit_test(sigmaMapsMeanTheirDelta),
        cmocka_unit_test(measuredMapsMakeAField),
        cmocka_unit_test(surroundingsFollowTheMaps),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
