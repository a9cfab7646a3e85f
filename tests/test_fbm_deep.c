/* Thirty levels deep: the chain in single precision against the same recursion in long double. */
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <string.h>

#include <cmocka.h>

enum { DEPTH = 30, SEED = 7 };

static const double deltas[] = {0, 1e-6, 1, 1e6};
static const int64_t places[] = {0, (int64_t)1 << 40};

static double largest_difference(const double hurst[2], bool by_place, double delta, int64_t at)
{
    tl_precision_options options = {.levels = DEPTH,
                                    .hurst = {hurst[0], hurst[1]},
                                    .by_place = by_place,
                                    .delta = delta,
                                    .column = at - 5,
                                    .row = at / 3 + 11,
                                    .seed = SEED};
    tl_precision found;
    tl_error error;
    assert_int_equal(tl_precision_measure(&options, &found, &error), TL_OK);
    assert_int_equal(found.samples, 21 * 17);
    return found.largest;
}

/* Thirty levels of rounding: within 1e-5 of delta at every sample, and not without any. */
static void keeps(const double hurst[2], bool by_place)
{
    for (size_t d = 0; d < 4; d++)
        for (int k = 0; k < 2; k++) {
            double off = largest_difference(hurst, by_place, deltas[d], places[k]);
            if (!(off <= 1e-5 * deltas[d]) || (deltas[d] > 0 && !(off > 0)))
                fail_msg("H %g and %g, delta %g: %g off", hurst[0], hurst[1], deltas[d], off);
        }
}

static void thirtyLevelsKeepToLongDouble(void **state)
{
    (void)state;
    static const double exponents[][2] = {{.01, .01}, {.1, .1}, {.5, .5}, {.99, .99}};
    for (size_t h = 0; h < 4; h++)
        keeps(exponents[h], false);
}

static void thirtyLevelsOfFieldsKeepToLongDouble(void **state)
{
    (void)state;
    static const double pairs[][2] = {{.01, .01}, {.1, .9}, {.5, .5}, {.99, .99}, {.4, .6}};
    for (size_t h = 0; h < 5; h++)
        keeps(pairs[h], true);
}

static void precisionRefusesWhatItCannotMeasure(void **state)
{
    (void)state;
    const tl_precision_options good = {.levels = 1, .hurst = {.5, .5}, .delta = 1};
    tl_precision_options bad[6] = {good, good, good, good, good, good};
    bad[0].levels = 31;
    bad[1].levels = -1;
    bad[2].hurst[1] = .6;
    bad[3].hurst[0] = bad[3].hurst[1] = (double)NAN;
    bad[4].delta = -1;
    bad[5].row = INT64_MAX;
    tl_precision found;
    tl_error error;
    assert_int_equal(tl_precision_measure(&good, &found, &error), TL_OK);
    for (size_t k = 0; k < 6; k++)
        assert_int_equal(tl_precision_measure(&bad[k], &found, &error), TL_ERROR_ARGUMENT);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(thirtyLevelsKeepToLongDouble),
        cmocka_unit_test(thirtyLevelsOfFieldsKeepToLongDouble),
        cmocka_unit_test(precisionRefusesWhatItCannotMeasure),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
