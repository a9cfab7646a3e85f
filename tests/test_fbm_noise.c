/* Keyed Gaussian noise. Estimates from n values scatter about the truth with the standard errors named at each check; a
 * tolerance is 4.5 of them (one false alarm in 150,000) plus, where the polynomial's own error counts, its size. The
 * seeds are fixed, so that a failure repeats. */
#include "fbm/kernel.h"
#include "fbm/rng.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

enum { ROWS = 64, COLUMNS = 16384, COUNT = ROWS * COLUMNS };

static float *make_rows(uint64_t seed, int32_t level, fbm_noise_kind kind, int64_t row, int64_t first)
{
    float *out = malloc(COUNT * sizeof *out);
    assert_non_null(out);
    for (int j = 0; j < ROWS; j++)
        fbm_noise_row(seed, level, kind, row + j, first, COLUMNS, out + j * COLUMNS);
    return out;
}

/* Standard errors for independent normal values: mean 1/sqrt(n), variance sqrt(2/n), skewness sqrt(6/n), kurtosis
 * sqrt(24/n). */
static void noiseHasMomentsOfStandardNormal(void **state)
{
    (void)state;
    float *g = make_rows(1, 0, FBM_NOISE_CENTRES, -20, -5000);
    double m1 = 0, m2 = 0, m3 = 0, m4 = 0, largest = 0, n = COUNT;
    for (int k = 0; k < COUNT; k++) {
        double x = (double)g[k];
        m1 += x / n;
        m2 += x * x / n;
        m3 += x * x * x / n;
        m4 += x * x * x * x / n;
        largest = fmax(largest, fabs(x));
    }
    assert_true(fabs(m1) < 4.5 / sqrt(n));
    assert_true(fabs(m2 - 1) < 4.5 * sqrt(2 / n) + 1e-4);
    assert_true(fabs(m3) < 4.5 * sqrt(15 / n)); /* the raw third moment has variance 15 */
    assert_true(fabs(m4 - 3) < 4.5 * sqrt(96 / n) + 1e-3);
    /* expected largest of 1e6: 4.9, which is where the sum of four uniforms ends */
    assert_true(largest > 4 && largest < 5);
    free(g);
}

static int compare_floats(const void *a, const void *b)
{
    float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

/* sqrt(n) D exceeds 2.4 with probability 2 exp(-2 * 2.4^2) = 2e-5; the polynomial itself is 6e-4 off. */
static void noiseIsNormalByKolmogorovSmirnov(void **state)
{
    (void)state;
    float *g = make_rows(2, 3, FBM_NOISE_ROW_EDGES, 1000000, (int64_t)1 << 40);
    qsort(g, COUNT, sizeof *g, compare_floats);
    double distance = 0;
    for (int k = 0; k < COUNT; k++) {
        double theory = 0.5 * erfc(-(double)g[k] / sqrt(2));
        distance = fmax(distance, fmax(fabs(theory - (double)k / COUNT), fabs(theory - (k + 1.0) / COUNT)));
    }
    assert_true(distance < 6e-4 + 2.4 / sqrt(COUNT));
    free(g);
}

/* The correlation of n independent pairs has the standard error 1/sqrt(n); so has that of their squares. */
static void assert_uncorrelated(const float *a, const float *b, size_t n)
{
    double products = 0, squares = 0;
    for (size_t k = 0; k < n; k++) {
        double x = (double)a[k], y = (double)b[k];
        products += x * y;
        squares += (x * x - 1) * (y * y - 1) / 2;
    }
    assert_true(fabs(products / (double)n) < 4.5 / sqrt((double)n));
    assert_true(fabs(squares / (double)n) < 4.5 / sqrt((double)n));
}

static void neighboursInARowAreUncorrelated(void **state)
{
    (void)state;
    static const int lags[] = {1, 2, 3, 4, 7, 8, 16, 64, 256, 4096};
    float *g = make_rows(3, 0, FBM_NOISE_CENTRES, 0, 0);
    for (size_t l = 0; l < sizeof lags / sizeof *lags; l++)
        assert_uncorrelated(g, g + lags[l], COUNT - 4096);
    free(g);
}

static void otherKeysGiveIndependentNoise(void **state)
{
    (void)state;
    float *g = make_rows(4, 5, FBM_NOISE_CENTRES, 0, 0);
    float *others[] = {
        make_rows(4, 5, FBM_NOISE_CENTRES, 1, 0),
        make_rows(4, 5, FBM_NOISE_CENTRES, 1, 1),
        make_rows(4, 5, FBM_NOISE_CENTRES, -1, 0),
        make_rows(4, 6, FBM_NOISE_CENTRES, 0, 0),
        make_rows(4, -5, FBM_NOISE_CENTRES, 0, 0),
        make_rows(4, 5, FBM_NOISE_ROW_EDGES, 0, 0),
        make_rows(4, 5, FBM_NOISE_COLUMN_EDGES, 0, 0),
        make_rows(5, 5, FBM_NOISE_CENTRES, 0, 0),
        make_rows(4 + ((uint64_t)1 << 32), 5, FBM_NOISE_CENTRES, 0, 0),
        make_rows(4, 5, FBM_NOISE_CENTRES, (int64_t)1 << 32, 0),
        make_rows(4, 5, FBM_NOISE_CENTRES, 0, (int64_t)1 << 32),
        make_rows(4, 5, FBM_NOISE_CENTRES, 0, -((int64_t)1 << 32)),
    };
    for (size_t k = 0; k < sizeof others / sizeof *others; k++) {
        assert_uncorrelated(g, others[k], COUNT);
        free(others[k]);
    }
    free(g);
}

/* Correlation of two rows at every shift. The largest of 8 * 7 / 2 * 4097 correlations with standard error 1/sqrt(n)
 * passes 5.8 of them with probability 1e5 * 7e-9 = 8e-4; a shifted copy has the correlation 1, that is 64 standard
 * errors. */
static void rowsAreNotShiftedCopies(void **state)
{
    (void)state;
    enum { N = 4096, SHIFT = 2048, LENGTH = N + 2 * SHIFT, TRIED = 8 };
    static float rows[TRIED][LENGTH];
    for (int j = 0; j < TRIED; j++)
        fbm_noise_row(77, 2, FBM_NOISE_COLUMN_EDGES, j - 3, -100, LENGTH, rows[j]);
    for (int a = 0; a < TRIED; a++)
        for (int b = a + 1; b < TRIED; b++)
            for (int shift = 0; shift <= 2 * SHIFT; shift++) {
                float sum = 0;
                for (int k = 0; k < N; k++)
                    sum += rows[a][SHIFT + k] * rows[b][shift + k];
                assert_true(fabs((double)sum) / N < 5.8 / sqrt(N));
            }
}

static void windowsOfARowAgree(void **state)
{
    (void)state;
    static const int64_t firsts[] = {
        0, -37, INT64_MAX - 4999, INT64_MIN, ((int64_t)1 << 32) - 2000, -((int64_t)1 << 32) - 1, 123456789012345};
    static float whole[5000], part[5000];
    for (size_t f = 0; f < sizeof firsts / sizeof *firsts; f++) {
        fbm_noise_row(9, 1, FBM_NOISE_CENTRES, INT64_MIN, firsts[f], 5000, whole);
        for (int k = 0; k < 200; k++) {
            size_t from = (size_t)rand() % 5000, count = (size_t)rand() % (5000 - from + 1);
            fbm_noise_row(9, 1, FBM_NOISE_CENTRES, INT64_MIN, firsts[f] + (int64_t)from, count, part);
            assert_memory_equal(part, whole + from, count * sizeof *part);
        }
    }
}

static void everyKernelMakesTheSameBits(void **state)
{
    (void)state;
    static float expected[1003], found[1003];
    for (const fbm_kernel *const *kernel = fbm_kernels(); *kernel; kernel++)
        for (size_t count = 0; count <= 1003; count += count < 40 ? 1 : 321) {
            fbm_noise_row(11, 7, FBM_NOISE_SPECTRUM, -4, ((int64_t)5 << 32) - 500, count, expected);
            (*kernel)->noise(11, 7, FBM_NOISE_SPECTRUM, -4, ((int64_t)5 << 32) - 500, count, found);
            assert_memory_equal(found, expected, count * sizeof *found);
        }
}

/* What a seed means must not change from release to release: the first values, as exact bits. */
static void valuesOfASeedAreFixed(void **state)
{
    (void)state;
    static const float expected[4] = {-0x1.cb8692p+0F, 0x1.29677ep-1F, -0x1.1f9292p-1F, -0x1.13122cp+0F};
    float g[4];
    fbm_noise_row(1, 2, FBM_NOISE_ROW_EDGES, 3, 4, 4, g);
    assert_memory_equal(g, expected, sizeof g);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(noiseHasMomentsOfStandardNormal), cmocka_unit_test(noiseIsNormalByKolmogorovSmirnov),
        cmocka_unit_test(neighboursInARowAreUncorrelated), cmocka_unit_test(otherKeysGiveIndependentNoise),
        cmocka_unit_test(rowsAreNotShiftedCopies),         cmocka_unit_test(windowsOfARowAgree),
        cmocka_unit_test(everyKernelMakesTheSameBits),     cmocka_unit_test(valuesOfASeedAreFixed),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
