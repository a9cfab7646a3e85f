/* Statistics of rasters: estimates within the errors that they state, on exact fBm; refusals; maps; plots.
 *
 * Seeds are fixed, so a test that passes passes always. Its limits are quantiles of what an honest estimator would give
 * for other seeds: the sum of n squared standard scores is chi-square with n degrees of freedom, and passes the limits
 * below once in 10,000 on either side. */
#include "fbm/exact.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

#ifdef __SANITIZE_ADDRESS__
/* What fontconfig, which sets cairo's text, keeps until the process ends. */
const char *__lsan_default_suppressions(void);
const char *__lsan_default_suppressions(void)
{
    return "leak:libfontconfig";
}
#endif

static const double exponents[] = {0.1, 0.3, 0.5, 0.7, 0.9};
enum { EXPONENTS = sizeof exponents / sizeof *exponents, SEEDS = 6, SIDE = 129 };

/* E. B. Wilson and M. M. Hilferty (1931): the cube root of chi-square over n is normal. */
static double chi_square_limit(int n, double z)
{
    double a = 2.0 / (9 * n);
    return n * pow(1 - a + z * sqrt(a), 3);
}

static const double once_in_ten_thousand = 3.719;

static tl_source_info info_of(int64_t width, int64_t height)
{
    return (tl_source_info){.width = width,
                            .height = height,
                            .type = TL_RASTER_POINT,
                            .georef = {.transform = {0, 1, 0, 0, 0, -1}, .cell_x = 1, .cell_y = 1, .height_unit = 1},
                            .has_voids = true,
                            .name = "a surface"};
}

static tl_statistics measure_as(const float *heights, const tl_source_info *info, unsigned threads)
{
    tl_error error = {.text = ""};
    tl_statistics s;
    const tl_run run = {.threads = threads};
    tl_source *source = tl_array_source_create(heights, info, &error);
    assert_non_null(source);
    if (tl_statistics_measure(source, &run, &s, &error) != TL_OK)
        fail_msg("%s", error.text);
    tl_source_destroy(source);
    return s;
}

static tl_statistics measure(const float *heights, int64_t width, int64_t height)
{
    tl_source_info info = info_of(width, height);
    return measure_as(heights, &info, 1);
}

static float *surface(size_t side, double hurst, double delta, uint64_t seed)
{
    float *z = malloc(side * side * sizeof *z);
    assert_non_null(z);
    assert_int_equal(fbm_exact(side, hurst, delta, seed, z), FBM_OK);
    return z;
}

/* ---- estimates ---- */

typedef struct scores {
    double hurst[3], delta[3]; /* sums of squares */
    int count[3];
    int anisotropic, kurtotic, unstationary, all; /* how often the chance was below 0.05, or the limit passed */
} scores;

static void add_scores(const tl_statistics *s, double hurst, double delta, scores *sum)
{
    for (int k = 0; k < 3; k++) {
        const tl_fbm_estimate *e = &s->estimates[k];
        if (e->refusal) {
            assert_int_equal(k, 1); /* only first-order increments may take an H of 0.9 for 1 */
            assert_true(hurst > 0.8);
            continue;
        }
        assert_true(e->hurst_error > 0 && e->delta_error > 0);
        sum->hurst[k] += pow((e->hurst - hurst) / e->hurst_error, 2);
        if (e->delta_known)
            sum->delta[k] += pow((e->delta - delta) / e->delta_error, 2);
        sum->count[k]++;
    }
    sum->anisotropic += s->isotropy_chance < 0.05;
    sum->kurtotic += s->normality_chance < 0.05;
    for (int k = 0; k < 3; k++)
        sum->unstationary += !(s->positions[k] <= s->position_limits[k]);
    sum->all++;
}

/* Increments: neither too wide nor too narrow. The others' errors are upper bounds: the ridge on first-order increments
 * and Hann's share of ordinates only widen them. */
static void estimatesKeepTheirErrors(void **state)
{
    (void)state;
    scores sum = {{0}, {0}, {0}, 0, 0, 0, 0};
    for (int h = 0; h < EXPONENTS; h++)
        for (uint64_t seed = 1; seed <= SEEDS; seed++) {
            float *z = surface(SIDE, exponents[h], 3, seed + 100 * (uint64_t)h);
            tl_statistics s = measure(z, SIDE, SIDE);
            add_scores(&s, exponents[h], 3, &sum);
            free(z);
        }
    for (int k = 0; k < 3; k++) {
        double high = chi_square_limit(sum.count[k], once_in_ten_thousand);
        double low = chi_square_limit(sum.count[k], -once_in_ten_thousand);
        print_message("%d: H %.1f, delta %.1f for %d\n", k, sum.hurst[k], sum.delta[k], sum.count[k]);
        assert_true(sum.hurst[k] < high && sum.delta[k] < high);
        assert_true(k != 0 || (sum.hurst[k] > low && sum.delta[k] > low));
    }
    assert_int_equal(sum.all, EXPONENTS * SEEDS);
    /* binomial: 7 or more of 30 at 0.05 come once in 1300; 4 or more of 90 at 0.01 or less, once in 70 at most */
    print_message("%d anisotropic, %d kurtotic, %d unstationary\n", sum.anisotropic, sum.kurtotic, sum.unstationary);
    assert_true(sum.anisotropic < 7 && sum.kurtotic < 7 && sum.unstationary < 4);
}

/* The quantum's variance is taken off: integers tell the same, to their error. */
static void roundingIsTakenOff(void **state)
{
    (void)state;
    double sum = 0;
    int n = 0;
    for (uint64_t seed = 1; seed <= 2; seed++)
        for (int h = 0; h < EXPONENTS; h++) {
            float *z = surface(SIDE, exponents[h], 2, seed);
            for (size_t k = 0; k < SIDE * SIDE; k++)
                z[k] = rintf(z[k]);
            tl_source_info info = info_of(SIDE, SIDE);
            info.quantum = 1;
            tl_statistics s = measure_as(z, &info, 1);
            assert_null(s.estimates[0].refusal);
            sum += pow((s.estimates[0].hurst - exponents[h]) / s.estimates[0].hurst_error, 2);
            n++;
            free(z);
        }
    assert_true(sum < chi_square_limit(n, once_in_ten_thousand));
}

/* Where rounding hides the increments nothing is made up. */
static void hiddenIncrementsAreRefused(void **state)
{
    (void)state;
    float *z = surface(SIDE, 0.5, 0.1, 1);
    for (size_t k = 0; k < SIDE * SIDE; k++)
        z[k] = rintf(z[k]);
    tl_source_info info = info_of(SIDE, SIDE);
    info.quantum = 1;
    tl_statistics s = measure_as(z, &info, 1);
    assert_non_null(s.estimates[0].refusal);
    assert_true(s.octaves[0].sigma == 0);
    free(z);
}

/* A billion metres and a millimetre, in floats: their own last place is a quantum. */
static void floatsRoundToo(void **state)
{
    (void)state;
    float *z = surface(SIDE, 0.5, 1, 1);
    for (size_t k = 0; k < SIDE * SIDE; k++)
        z[k] += 1e9f;
    tl_statistics s = measure(z, SIDE, SIDE);
    assert_true(sqrt(12 * s.noise) >= 64);
    assert_non_null(s.estimates[0].refusal);
    free(z);
}

static void hugeHeightsScale(void **state)
{
    (void)state;
    float *z = surface(SIDE, 0.7, 1, 5);
    tl_statistics small = measure(z, SIDE, SIDE);
    for (size_t k = 0; k < SIDE * SIDE; k++)
        z[k] *= 0x1p110f;
    tl_statistics large = measure(z, SIDE, SIDE);
    for (int k = 0; k < 3; k++) {
        assert_true(fabs(large.estimates[k].hurst - small.estimates[k].hurst) < 1e-6);
        assert_true(fabs(large.estimates[k].delta / small.estimates[k].delta / 0x1p110 - 1) < 1e-5);
    }
    free(z);
}

/* Voids are left out, and only widen the error. */
static void voidsAreLeftOut(void **state)
{
    (void)state;
    double sum = 0;
    for (uint64_t seed = 1; seed <= SEEDS; seed++) {
        float *z = surface(SIDE, 0.6, 2, seed);
        double whole = measure(z, SIDE, SIDE).estimates[0].hurst_error;
        for (int j = 40; j < 100; j++)
            for (int i = 20; i < 90; i++)
                z[j * SIDE + i] = NAN;
        tl_statistics s = measure(z, SIDE, SIDE);
        assert_int_equal(s.voids, 60 * 70);
        assert_true(s.estimates[0].hurst_error > whole);
        sum += pow((s.estimates[0].hurst - 0.6) / s.estimates[0].hurst_error, 2);
        free(z);
    }
    assert_true(sum < chi_square_limit(SEEDS, once_in_ten_thousand));
}

/* Columns are stretched by taking every second row: along the columns increments grow by 2^H. */
static void anisotropyIsTold(void **state)
{
    (void)state;
    enum { N = 257, ROWS = 129 };
    float *z = surface(N, 0.6, 1, 3);
    for (int j = 0; j < ROWS; j++)
        memmove(z + j * N, z + 2 * j * N, N * sizeof *z);
    tl_statistics s = measure(z, N, ROWS);
    assert_true(s.isotropy_chance < 1e-6);
    assert_true(s.anisotropy > 1.3 && s.anisotropy < 1.8); /* 2^0.6 is 1.52 */
    assert_true(s.azimuth < 5 || s.azimuth > 175);         /* roughest from north to south */
    /* the same surface as cells of 1 x 2 m is isotropic */
    tl_source_info info = info_of(N, ROWS);
    info.georef.cell_y = 2;
    s = measure_as(z, &info, 1);
    assert_true(s.isotropy_chance > 1e-3);
    free(z);
}

/* Bilinear interpolation between every second sample, the oldest fault of midpoint displacement. */
static void interpolatedSamplesAreFound(void **state)
{
    (void)state;
    float *z = surface(SIDE, 0.5, 1, 2);
    for (int j = 0; j < SIDE; j++)
        for (int i = 1; i < SIDE; i += 2)
            z[j * SIDE + i] = 0.5f * (z[j * SIDE + i - 1] + z[j * SIDE + i + 1]);
    tl_statistics s = measure(z, SIDE, SIDE);
    assert_true(s.positions[0] > 1.5 * s.position_limits[0]);
    free(z);
}

static void spikesAreNotGaussian(void **state)
{
    (void)state;
    float *z = surface(SIDE, 0.5, 1, 2);
    for (int k = 0; k < SIDE * SIDE; k += 97)
        z[k] += 8;
    assert_true(measure(z, SIDE, SIDE).normality_chance < 1e-6);
    free(z);
}

/* Points, and means of points, tell the same exponent octave by octave; 65 x 65 details of the third octave have an
 * error of some 0.03, and 0.12 is four of them. */
static void octavesKnowTheirSupport(void **state)
{
    (void)state;
    enum { N = 513 };
    float *z = surface(N, 0.4, 1, 9);
    tl_statistics s = measure(z, N, N);
    assert_true(s.octave_count >= 5);
    assert_true(s.octaves[0].exponent < 0); /* the means of 2 x 2 points vary less than points */
    for (int k = 0; k < 3; k++)
        assert_true(fabs(s.octaves[k].hurst - 0.4) < 0.12);
    free(z);
}

/* Means over 8 x 8 points, as cells: H and delta of the points come back, delta over a cell. The means of points differ
 * from those of cells by a 64th of the smoothing, less than the error. */
static void cellMeansTellOfTheirPoints(void **state)
{
    (void)state;
    enum { CELLS = 65, PART = 8, N = CELLS * PART };
    double sum[2] = {0, 0};
    int n = 0;
    for (int h = 0; h < 3; h++) {
        double hurst = exponents[2 * h];
        float *z = surface(N, hurst, 1, 20 + (uint64_t)h), *means = malloc(CELLS * CELLS * sizeof *means);
        assert_non_null(means);
        for (int k = 0; k < CELLS * CELLS; k++) {
            double total = 0;
            for (int p = 0; p < PART * PART; p++)
                total += (double)z[(k / CELLS * PART + p / PART) * N + k % CELLS * PART + p % PART];
            means[k] = (float)(total / (PART * PART));
        }
        tl_source_info info = info_of(CELLS, CELLS);
        info.type = TL_RASTER_AREA;
        tl_statistics s = measure_as(means, &info, 1);
        const tl_fbm_estimate *e = &s.estimates[0];
        assert_null(e->refusal);
        sum[0] += pow((e->hurst - hurst) / e->hurst_error, 2);
        if (e->delta_known)
            sum[1] += pow((e->delta / pow(PART, hurst) - 1) * e->delta / e->delta_error, 2);
        n++;
        free(z);
        free(means);
    }
    print_message("H %.1f, delta %.1f for %d\n", sum[0], sum[1], n);
    assert_true(sum[0] < chi_square_limit(n, once_in_ten_thousand));
    assert_true(sum[1] < chi_square_limit(n, once_in_ten_thousand));
}

/* ---- small, flat and void ---- */

static void nothingIsMadeOfNothing(void **state)
{
    (void)state;
    static const int sizes[][2] = {{1, 1}, {2, 2}, {1, 40}, {40, 1}, {3, 5}, {16, 16}, {33, 33}};
    for (size_t k = 0; k < sizeof sizes / sizeof *sizes; k++)
        for (int kind = 0; kind < 3; kind++) {
            int w = sizes[k][0], h = sizes[k][1];
            float *z = malloc((size_t)(w * h) * sizeof *z);
            assert_non_null(z);
            for (int i = 0; i < w * h; i++)
                z[i] = kind == 0 ? 7 : kind == 1 ? NAN : 3 * (float)(i % w) + (float)(i / w);
            tl_statistics s = measure(z, w, h);
            assert_non_null(s.estimates[0].refusal);
            assert_non_null(s.estimates[2].refusal);
            tl_error error;
            const tl_expectation expected = {.hurst_given = true, .hurst = 0.5};
            assert_int_equal(tl_statistics_expect(&s, &expected, "nothing", &error), TL_ERROR_DATA);
            free(z);
        }
}

static void expectationsAreJudged(void **state)
{
    (void)state;
    float *z = surface(SIDE, 0.7, 2, 4);
    tl_statistics s = measure(z, SIDE, SIDE);
    tl_error error;
    const tl_expectation good = {.hurst_given = true, .delta_given = true, .hurst = 0.7, .delta = 2, .tolerance = 0.06};
    tl_expectation bad = good;
    assert_int_equal(tl_statistics_expect(&s, &good, "it", &error), TL_OK);
    bad.hurst = 0.8;
    assert_int_equal(tl_statistics_expect(&s, &bad, "it", &error), TL_ERROR_DATA);
    assert_non_null(strstr(error.text, "standard error"));
    bad = good;
    bad.delta = 2.5;
    assert_int_equal(tl_statistics_expect(&s, &bad, "it", &error), TL_ERROR_DATA);
    assert_non_null(strstr(error.text, "delta"));
    free(z);
}

/* ---- large rasters, threads ---- */

static void threadsDoNotMatter(void **state)
{
    (void)state;
    tl_error error;
    const tl_noise_options options = {.size = 1300, .hurst = 0.5, .delta = 1, .seed = 3};
    tl_source *noise = tl_noise_create(&options, &error);
    assert_non_null(noise);
    tl_statistics one, three;
    memset(&one, 0, sizeof one);
    memset(&three, 0, sizeof three);
    const tl_run few = {.threads = 1}, many = {.threads = 3};
    assert_int_equal(tl_statistics_measure(noise, &few, &one, &error), TL_OK);
    assert_int_equal(tl_statistics_measure(noise, &many, &three, &error), TL_OK);
    assert_memory_equal(&one, &three, sizeof one);
    assert_true(fabs(one.estimates[0].hurst - 0.5) < 0.01);
    assert_true(one.lags[one.lag_count - 1].lag > 128); /* beyond a block */
    assert_true(one.octave_count >= 6);
    const tl_run tight = {.memory = 1 << 20};
    assert_int_equal(tl_statistics_measure(noise, &tight, &one, &error), TL_ERROR_MEMORY);
    tl_source_destroy(noise);
}

/* ---- maps and plots ---- */

static void file_name(char *path, size_t size, const char *name)
{
    const char *folder = getenv("TMPDIR");
    snprintf(path, size, "%s/talus-statistics-%ld-%s", folder ? folder : "/tmp", (long)getpid(), name);
}

static float *read_band(const char *path, unsigned band, tl_source_info *info)
{
    tl_error error;
    const tl_dem_options options = {.band = band};
    tl_source *source = tl_dem_open(&path, 1, &options, &error);
    assert_non_null(source);
    *info = source->info;
    float *out = malloc((size_t)(info->width * info->height) * sizeof *out);
    assert_non_null(out);
    assert_int_equal(tl_source_read(source, 0, (tl_window){0, 0, info->width, info->height}, out, &error), TL_OK);
    tl_source_destroy(source);
    return out;
}

/* Windows of 65 that do not touch are all but independent: their mean H is right to four standard errors of their
 * stated mean, and their scatter is what they state. */
static void mapsTellLocalStatistics(void **state)
{
    (void)state;
    enum { N = 513 };
    float *z = surface(N, 0.6, 2, 11);
    z[0] = NAN;
    char path[200];
    file_name(path, sizeof path, "maps.tif");
    tl_error error = {.text = ""};
    tl_source_info info = info_of(N, N);
    tl_source *source = tl_array_source_create(z, &info, &error);
    const tl_map_options options = {.stride = 64, .overwrite = true};
    if (tl_statistics_write_maps(source, path, &options, &error) != TL_OK)
        fail_msg("%s", error.text);
    tl_source_destroy(source);
    float *hurst = read_band(path, 1, &info), *sigma = read_band(path, 2, &info), *errors = read_band(path, 4, &info),
          *count = read_band(path, 5, &info);
    assert_int_equal(info.width, 8);
    assert_int_equal(info.height, 8);
    double mean = 0, variance = 0, chi = 0;
    for (int k = 0; k < 64; k++) {
        mean += (double)hurst[k] / 64;
        variance += (double)errors[k] * (double)errors[k] / (64.0 * 64);
        chi += pow(((double)hurst[k] - 0.6) / (double)errors[k], 2);
        assert_true(sigma[k] > 0 && errors[k] < 0.03f);
        assert_true(count[k] == (k ? 63 * 65 : 63 * 65 - 1));
    }
    assert_true(fabs(mean - 0.6) < 4 * sqrt(variance));
    assert_true(chi > chi_square_limit(64, -once_in_ten_thousand) && chi < chi_square_limit(64, once_in_ten_thousand));
    free(hurst);
    free(sigma);
    free(errors);
    free(count);
    free(z);
    unlink(path);
}

static void plotsAreDrawn(void **state)
{
    (void)state;
    float *z = surface(SIDE, 0.6, 2, 1), flat[9] = {0};
    tl_statistics s = measure(z, SIDE, SIDE), nothing = measure(flat, 3, 3);
    tl_error error;
    static const char *const names[] = {"plot.svg", "plot.png"}, *const marks[] = {"<?xml", "\x89PNG"};
    for (int k = 0; k < 2; k++) {
        char path[200], start[5] = "";
        file_name(path, sizeof path, names[k]);
        if (tl_statistics_plot(&s, "a & b", path, true, &error) != TL_OK) {
            assert_non_null(strstr(error.text, "cairo")); /* built without */
            free(z);
            skip();
        }
        FILE *file = fopen(path, "rb");
        assert_non_null(file);
        assert_int_equal(fread(start, 1, 4, file), 4);
        fclose(file);
        assert_memory_equal(start, marks[k], 4);
        assert_int_equal(tl_statistics_plot(&s, "again", path, false, &error), TL_ERROR_IO);
        assert_int_equal(tl_statistics_plot(&nothing, "nothing", path, true, &error), TL_OK);
        unlink(path);
    }
    assert_int_equal(tl_statistics_plot(&s, "x", "plot.bmp", true, &error), TL_ERROR_ARGUMENT);
    free(z);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(estimatesKeepTheirErrors),   cmocka_unit_test(roundingIsTakenOff),
        cmocka_unit_test(hiddenIncrementsAreRefused), cmocka_unit_test(floatsRoundToo),
        cmocka_unit_test(hugeHeightsScale),           cmocka_unit_test(voidsAreLeftOut),
        cmocka_unit_test(anisotropyIsTold),           cmocka_unit_test(interpolatedSamplesAreFound),
        cmocka_unit_test(spikesAreNotGaussian),       cmocka_unit_test(octavesKnowTheirSupport),
        cmocka_unit_test(cellMeansTellOfTheirPoints), cmocka_unit_test(nothingIsMadeOfNothing),
        cmocka_unit_test(expectationsAreJudged),      cmocka_unit_test(threadsDoNotMatter),
        cmocka_unit_test(mapsTellLocalStatistics),    cmocka_unit_test(plotsAreDrawn),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
