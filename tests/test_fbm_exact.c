/* Exact fractional Brownian surfaces. */
#include "fbm/exact.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

static float *make_field(size_t size, double hurst, double delta, uint64_t seed)
{
    float *out = malloc(size * size * sizeof *out);
    assert_non_null(out);
    assert_int_equal(fbm_exact(size, hurst, delta, seed, out), FBM_OK);
    return out;
}

/* Sums of increments (b - a)^2 over a field by lag, and their number. */
static double squared_increments(const float *z, int size, int dx, int dy)
{
    double sum = 0;
    int count = 0;
    for (int y = dy < 0 ? -dy : 0; y < size - (dy > 0 ? dy : 0); y++)
        for (int x = 0; x + dx < size; x++, count++) {
            double d = (double)z[(y + dy) * size + x + dx] - (double)z[y * size + x];
            sum += d * d;
        }
    return sum / count;
}

/* The mean of n independent fields scatters with a standard error estimated from them; tolerance 4.5 of these. The
 * estimate itself is good to 1 / sqrt(2 n) = 4 %, its skewness for the longest lags (chi-squared of few degrees) asks
 * for n >= 300. */
static void incrementsHaveTheVarianceOfFbmAtEveryLag(void **state)
{
    (void)state;
    enum { SIZE = 24, FIELDS = 400, LAGS = 9 };
    static const int lags[LAGS][2] = {{1, 0}, {0, 1}, {1, 1}, {1, -1}, {2, 5}, {12, 0}, {0, 23}, {23, 0}, {17, -19}};
    static const double hursts[] = {0.01, 0.2, 0.5, 0.75, 0.76, 0.9, 0.99};
    for (size_t h = 0; h < sizeof hursts / sizeof *hursts; h++) {
        double sum[LAGS] = {0}, squares[LAGS] = {0};
        for (uint64_t seed = 0; seed < FIELDS; seed++) {
            float *z = make_field(SIZE, hursts[h], 3, seed + 1000 * h);
            for (int l = 0; l < LAGS; l++) {
                double theory = 9 * pow(hypot(lags[l][0], lags[l][1]), 2 * hursts[h]);
                double found = squared_increments(z, SIZE, lags[l][0], lags[l][1]) / theory;
                sum[l] += found / FIELDS;
                squares[l] += found * found / FIELDS;
            }
            free(z);
        }
        for (int l = 0; l < LAGS; l++)
            assert_true(fabs(sum[l] - 1) < 4.5 * sqrt((squares[l] - sum[l] * sum[l]) / (FIELDS - 1)));
    }
}

/* Second differences of a smooth large field are small against its size: an error of single precision in the spectrum
 * would drown them. E(z0 - 2 z1 + z2)^2 = delta^2 (4 - 4^H). Fields are independent; the standard error comes from
 * them. */
static void smoothFieldsKeepTheirFinestScale(void **state)
{
    (void)state;
    enum { SIZE = 300, FIELDS = 6 };
    const double hurst = 0.99, theory = 4 - pow(4, hurst);
    double sum = 0, squares = 0;
    for (uint64_t seed = 0; seed < FIELDS; seed++) {
        float *z = make_field(SIZE, hurst, 1, seed);
        double mean = 0;
        for (int y = 0; y < SIZE; y++)
            for (int x = 0; x + 2 < SIZE; x++) {
                const float *p = z + y * SIZE + x;
                double d = (double)p[0] - 2 * (double)p[1] + (double)p[2];
                mean += d * d / (SIZE * (SIZE - 2)) / theory;
            }
        sum += mean / FIELDS;
        squares += mean * mean / FIELDS;
        free(z);
    }
    double error = sqrt((squares - sum * sum) / (FIELDS - 1));
    assert_true(error < 0.01);
    /* 6.9: Student's t with 5 degrees of freedom at the level of 1e-3; 1e-3: rounding of the output */
    assert_true(fabs(sum - 1) < 6.9 * error + 1e-3);
}

static void fieldStartsAtZeroAndScalesWithDelta(void **state)
{
    (void)state;
    for (size_t size = 1; size < 40; size += 7) {
        float *one = make_field(size, 0.6, 1, 5), *four = make_field(size, 0.6, 4, 5);
        float *none = make_field(size, 0.6, 0, 5);
        assert_true(one[0] == 0);
        for (size_t k = 0; k < size * size; k++) {
            assert_true(four[k] == 4 * one[k]);
            assert_true(none[k] == 0);
            assert_true(k == 0 || one[k] != 0);
        }
        free(one), free(four), free(none);
    }
}

static void seedsNameFields(void **state)
{
    (void)state;
    enum { SIZE = 33 };
    float *a = make_field(SIZE, 0.8, 1, 7), *b = make_field(SIZE, 0.8, 1, 7), *c = make_field(SIZE, 0.8, 1, 8);
    assert_memory_equal(a, b, SIZE * SIZE * sizeof *a);
    for (size_t k = 1; k < SIZE * SIZE; k++)
        assert_true(a[k] != c[k]);
    free(a), free(b), free(c);
}

static void hurstOutOfRangeIsClamped(void **state)
{
    (void)state;
    static const double pairs[][2] = {{-1, 0.01}, {(double)NAN, 0.01}, {2, 0.99}};
    for (int k = 0; k < 3; k++) {
        float *a = make_field(9, pairs[k][0], 1, 7), *b = make_field(9, pairs[k][1], 1, 7);
        assert_memory_equal(a, b, 81 * sizeof *a);
        free(a), free(b);
    }
}

static void unreasonableSizesAreRefused(void **state)
{
    (void)state;
    float untouched = 42;
    static const size_t sizes[] = {0, FBM_EXACT_SIZE_MAX + 1, SIZE_MAX / 2, SIZE_MAX};
    for (size_t k = 0; k < sizeof sizes / sizeof *sizes; k++) {
        assert_int_equal(fbm_exact_memory(sizes[k], 1, 0.9), 0);
        assert_int_equal(fbm_exact(sizes[k], 0.9, 1, 1, &untouched), FBM_TOO_LARGE);
    }
    assert_true(untouched == 42);
    for (double hurst = 0.1; hurst < 1; hurst += 0.8) {
        double square = 1025.0 * 1025, bytes = (double)fbm_exact_memory(1025, 1, hurst);
        assert_true(bytes > 35 * square && bytes < 125 * square);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(incrementsHaveTheVarianceOfFbmAtEveryLag),
        cmocka_unit_test(smoothFieldsKeepTheirFinestScale),
        cmocka_unit_test(fieldStartsAtZeroAndScalesWithDelta),
        cmocka_unit_test(seedsNameFields),
        cmocka_unit_test(hurstOutOfRangeIsClamped),
        cmocka_unit_test(unreasonableSizesAreRefused),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
