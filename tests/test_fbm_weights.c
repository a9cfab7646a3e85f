/* Coefficients of the refinement schemes. */
#include "fbm/aspect.h"
#include "fbm/covariance.h"
#include "fbm/refine.h"
#include "fbm/tune.h"
#include "fbm/weights.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <string.h>

#include <cmocka.h>

static double predictor_sum(const fbm_weights *weights)
{
    static const double orbits[8] = {2, 2, 4, 4, 2, 2, 4, 4};
    double centre = 0, edge = 0;
    for (int k = 0; k < 6; k++)
        centre += 4 * (double)weights->centre[k];
    for (int k = 0; k < 8; k++)
        edge += orbits[k] * (double)weights->edge[k];
    return fabs(centre - 1) > fabs(edge - 1) ? centre : edge;
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
        static const int centre[6] = {0, 1, 1, 2, 3, 3}, edge[8] = {0, 0, 1, 1, 2, 2, 3, 3};
        static const int centre_taps[4] = {0, 1, 1, 2}, edge_taps[4] = {0, 1, 2, 2};
        for (int k = 0; k < 6; k++)
            assert_true(fabs((double)weights.centre[k] - rows[r][1 + centre[k]]) < 9 * 0x1p-26);
        for (int k = 0; k < 8; k++)
            assert_true(fabs((double)weights.edge[k] - rows[r][1 + edge[k]]) < 9 * 0x1p-26);
        for (int k = 0; k < 4; k++) {
            assert_true(weights.centre_taps[k] == (float)rows[r][5 + centre_taps[k]]);
            assert_true(weights.edge_taps[k] == (float)(rows[r][5 + edge_taps[k]] * pow(2, -rows[r][0] / 2)));
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
        difference += binomial[k] * (double)weights.centre[4];
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

/* Values of an independent computation, to the digits given. */
static void stretchedWeightsHaveTheCheckValues(void **state)
{
    (void)state;
    static const double expected[22] = {.276758,  .004227,  -.013642, -.010488, -.005399, -.001456, .499312,  .025974,
                                        .000591,  -.005878, .339831,  .217564,  -.008238, -.003664, -.005240, -.015196,
                                        -.002449, -.004129, .413449,  .008963,  -.005052, -.003386};
    static const double rows[13] = {.313461, .122971, .007542, -.005326, -.018495, -.014136, -.008535,
                                    .464936, .063982, .007755, -.010223, -.007530, -.003786};
    double values[FBM_WEIGHT_VALUES], between[FBM_ROW_VALUES];
    fbm_values_stationary(.5, .8, values);
    for (int k = 0; k < 22; k++)
        assert_true(fabs(values[k] - expected[k]) < 1.5e-6);
    fbm_values_rows(.5, .5, false, between);
    for (int k = 0; k < 13; k++)
        assert_true(fabs(between[k] - rows[k]) < 1.5e-6);
    assert_true(between[13] == 0);
}

/* At 1 / a the picture is that at a with rows and columns exchanged, in units a times as large. */
static void stretchedWeightsTurn(void **state)
{
    (void)state;
    static const int turned[22] = {0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 13, 12, 15, 14, 17, 16, 18, 19, 21, 20};
    for (double hurst = .1; hurst < 1; hurst += .2) {
        double a[FBM_WEIGHT_VALUES], b[FBM_WEIGHT_VALUES], grow = pow(1.25, hurst);
        fbm_values_stationary(hurst, .8, a);
        fbm_values_stationary(hurst, 1.25, b);
        for (int k = 0; k < 22; k++) {
            bool tap = (k >= 6 && k < 10) || k >= 18;
            assert_true(fabs(b[turned[k]] - (tap ? grow : 1) * a[k]) < 1e-9);
        }
    }
}

static void classicalVariancesAreThoseOfTwoDimensions(void **state)
{
    (void)state;
    for (double hurst = 0.1; hurst < 1; hurst += 0.2) {
        fbm_weights diamond, children;
        fbm_weights_diamond(hurst, &diamond);
        fbm_weights_children(hurst, &children);
        double centre = pow(2, -hurst) - .25 - pow(2, hurst) / 8, at = (double)diamond.centre_taps[0],
               edge = (double)diamond.edge_taps[0], child = (double)children.centre_taps[0];
        assert_true(fabs(at * at - centre) < 1e-7);
        assert_true(fabs(edge * edge - centre * pow(2, -hurst)) < 1e-7);
        /* distances sqrt(1/8), sqrt(5/8) twice and sqrt(9/8); pairs of cells at 1 and sqrt 2 */
        double known = 9 / 16. * pow(.125, hurst) + 6 / 16. * pow(.625, hurst) + pow(1.125, hurst) / 16 -
                       (60 + 18 * pow(2, hurst)) / 256;
        assert_true(fabs(child * child - known) < 1e-7);
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

/* The generator, on a window smaller than the table was made for: at the lags that it sees, it comes down from kriging
 * to deviations that are no worse than the table's there. */
static void tuningComesDownToTheTable(void **state)
{
    (void)state;
    for (int k = 0; k < 2; k++) {
        double values[FBM_WEIGHT_VALUES], hurst = k ? 0.8 : 0.3;
        fbm_table_row tuned, known;
        fbm_deviation krigeds, tuneds, knowns;
        fbm_weights weights;
        assert_int_equal(fbm_tune(hurst, 2, 2, &tuned), FBM_OK);
        fbm_weights_of_row(&tuned, &weights);
        assert_int_equal(fbm_structure_deviation(fbm_schemes, &weights, hurst, 2, 2, &tuneds), FBM_OK);
        fbm_values_kriging(hurst, 1, values);
        fbm_weights_round(values, &weights);
        assert_int_equal(fbm_structure_deviation(fbm_schemes, &weights, hurst, 2, 2, &krigeds), FBM_OK);
        int knot = 0;
        while (fbm_table_row_at(knot, &known) && known.hurst != hurst)
            knot++;
        fbm_weights_of_row(&known, &weights);
        assert_int_equal(fbm_structure_deviation(fbm_schemes, &weights, hurst, 2, 2, &knowns), FBM_OK);
        assert_true(tuneds.point < krigeds.point && tuneds.point <= knowns.point);
        for (int i = 0; i < 4; i++)
            assert_true(fabs(tuned.w[i] - known.w[i]) < 0.01);
        for (int i = 0; i < 3; i++)
            assert_true(fabs(tuned.t[i] - known.t[i]) < 0.005);
    }
    fbm_table_row none;
    assert_false(fbm_table_row_at(25, &none) || fbm_table_row_at(-1, &none));
    assert_int_equal(fbm_tune(0.5, 0, 2, &none), FBM_TOO_LARGE);
    assert_int_equal(fbm_tune(0.5, 3, 5, &none), FBM_TOO_LARGE);
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
        cmocka_unit_test(stretchedWeightsHaveTheCheckValues),
        cmocka_unit_test(stretchedWeightsTurn),
        cmocka_unit_test(classicalVariancesAreThoseOfTwoDimensions),
        cmocka_unit_test(schemesAreFoundByName),
        cmocka_unit_test(tuningComesDownToTheTable),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
