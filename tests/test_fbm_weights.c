/* Coefficients of the refinement schemes. */
#include "fbm/refine.h"
#include "fbm/weights.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <string.h>

#include <cmocka.h>

static double predictor_sum(const fbm_weights *weights)
{
    const float *w = weights->w;
    return 4 * (double)w[0] + 8 * (double)w[1] + 4 * (double)w[2] + 8 * (double)w[3];
}

static void predictorSumsToOneAsRounded(void **state)
{
    (void)state;
    for (int k = 0; k <= 1000; k++) {
        fbm_weights weights;
        fbm_weights_stationary(k / 1000.0, &weights);
        assert_true(fabs(predictor_sum(&weights) - 1) < 1e-8);
        fbm_weights_square(k / 1000.0, &weights);
        assert_true(predictor_sum(&weights) == 1);
    }
}

/* Rows of the published table: first, inner, last. Rounding to float moves a coefficient by half a unit of 2^-25 at
 * most, and the one that takes the others' rounding by 8 times as much. */
static void splineIsExactAtTheKnots(void **state)
{
    (void)state;
    static const double rows[][8] = {
        {0.01, 0.0118095959, 0.0344980304, 0.0233623129, 0.0729160152, 0.695579447, -0.00564104416, -0.00384819002},
        {0.3, 0.231845279, 0.0185349017, -0.00374850454, -0.00758328876, 0.636190188, 0.0197974639, 0.00148488066},
        {0.99, 0.335262625, -0.0471377709, -0.00589762418, 0.00745527055, 0.0632748394, -0.000501610883,
         -0.00305178856},
    };
    for (size_t r = 0; r < 3; r++) {
        fbm_weights weights;
        fbm_weights_stationary(rows[r][0], &weights);
        for (int k = 0; k < 4; k++)
            assert_true(fabs((double)weights.w[k] - rows[r][1 + k]) < 9 * 0x1p-26);
        for (int k = 0; k < 3; k++) {
            assert_true(weights.centre_taps[k] == (float)rows[r][5 + k]);
            assert_true(weights.edge_taps[k] == (float)(rows[r][5 + k] * pow(2, -rows[r][0] / 2)));
        }
    }
}

/* A cubic spline has a continuous curvature: second differences over a step of 1e-3 vary slowly, while those of a
 * linear interpolation would vanish between knots and jump at them. */
static void splineIsSmooth(void **state)
{
    (void)state;
    const double step = 1e-3;
    double before = (double)NAN;
    for (int k = 150; k <= 940; k++) {
        fbm_weights a, b, c;
        fbm_weights_stationary((k - 1) * step, &a);
        fbm_weights_stationary(k * step, &b);
        fbm_weights_stationary((k + 1) * step, &c);
        double curvature = ((double)a.centre_taps[0] - 2 * (double)b.centre_taps[0] + (double)c.centre_taps[0]);
        /* 4 roundings of 2^-25 each in either difference, on a curvature of about 1 * step^2 */
        if (!isnan(before))
            assert_true(fabs(curvature - before) < 8 * 0x1p-25 + 0.1 * step * step);
        before = curvature;
    }
}

/* At the ends the spline is "not a knot": one cubic over the first two intervals, whose fourth differences vanish to 16
 * roundings of half a unit of 2^-28 (w[3] is 0.07 there). The natural spline fails here. */
static void splineEndsAreNotKnots(void **state)
{
    (void)state;
    static const int binomial[5] = {1, -4, 6, -4, 1};
    double difference = 0;
    for (int k = 0; k < 5; k++) {
        fbm_weights weights;
        fbm_weights_stationary(0.01 + 0.005 * k, &weights);
        difference += binomial[k] * (double)weights.w[3];
    }
    assert_true(fabs(difference) < 16 * 0x1p-29);
}

static void hurstIsClamped(void **state)
{
    (void)state;
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++) {
        fbm_weights low, high, other;
        scheme->weights(FBM_HURST_MIN, &low);
        scheme->weights(FBM_HURST_MAX, &high);
        scheme->weights(-3, &other);
        assert_memory_equal(&other, &low, sizeof low);
        scheme->weights((double)NAN, &other);
        assert_memory_equal(&other, &low, sizeof low);
        scheme->weights(1.3, &other);
        assert_memory_equal(&other, &high, sizeof high);
    }
}

static void squareHasTheVariancesOfTwoDimensionalKriging(void **state)
{
    (void)state;
    for (double hurst = 0.1; hurst < 1; hurst += 0.2) {
        fbm_weights weights;
        double centre, edge;
        fbm_weights_square(hurst, &weights);
        fbm_weights_residual(&weights, &centre, &edge);
        assert_true(fabs(centre * centre - (pow(2, -hurst) - 0.25 - pow(2, hurst) / 8)) < 1e-7);
        assert_true(fabs(edge * edge - (pow(2, -2 * hurst) - 0.25)) < 1e-7);
    }
}

static void schemesAreFoundByName(void **state)
{
    (void)state;
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++)
        assert_ptr_equal(fbm_scheme_find(scheme->name), scheme);
    assert_string_equal(fbm_schemes[0].name, "stationary");
    assert_null(fbm_scheme_find("Stationary"));
    assert_null(fbm_scheme_find(""));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(predictorSumsToOneAsRounded),
        cmocka_unit_test(splineIsExactAtTheKnots),
        cmocka_unit_test(splineIsSmooth),
        cmocka_unit_test(splineEndsAreNotKnots),
        cmocka_unit_test(hurstIsClamped),
        cmocka_unit_test(squareHasTheVariancesOfTwoDimensionalKriging),
        cmocka_unit_test(schemesAreFoundByName),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
