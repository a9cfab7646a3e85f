/* Powers, logarithms and turns against the C library's in long double. */
#include "fbm/elementary.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>

#include <cmocka.h>

static const double ulp = 0x1p-52;

static void powersAreGoodToThreeUlp(void **state)
{
    (void)state;
    for (int k = -200000; k <= 200000; k++) {
        double x = k * 2.5e-3 + 1e-4;
        assert_true(fabsl((long double)fbm_exp2(x) / exp2l((long double)x) - 1) < 3 * (long double)ulp);
    }
    for (int k = -1022; k <= 1023; k++)
        assert_true(fbm_exp2(k) == ldexp(1, k));
    assert_true(fbm_exp2(-1e300) == 0 && isinf(fbm_exp2(1e300)) && isnan(fbm_exp2((double)NAN)));
}

static void logarithmsAreGoodToThreeUlp(void **state)
{
    (void)state;
    for (int k = -300000; k <= 300000; k++) {
        double x = exp(k * 2e-3);
        long double truth = log2l((long double)x);
        assert_true(fabsl((long double)fbm_log2(x) - truth) < 3 * (long double)ulp * fmaxl(1, fabsl(truth)));
    }
    for (int k = -1022; k <= 1023; k++)
        assert_true(fbm_log2(ldexp(1, k)) == k);
}

static void powersOfAnyBase(void **state)
{
    (void)state;
    assert_true(fbm_pow(0, 0.5) == 0 && fbm_pow(0, 0) == 1 && fbm_pow(1, 0.37) == 1);
    for (int k = 1; k < 5000; k++)
        for (double y = 0.01; y < 2; y += 0.11) {
            long double truth = powl(k, (long double)y), bound = ((long double)y * log2l(k) + 4) * (long double)ulp;
            assert_true(fabsl((long double)fbm_pow(k, y) / truth - 1) < bound);
        }
}

static void turnsAreGoodToOneUlp(void **state)
{
    (void)state;
    const long double turn = 2 * acosl(-1);
    for (size_t n = 1; n < 300; n++)
        for (size_t k = 0; k < 2 * n; k++) {
            double c, s;
            fbm_turn(k, n, &c, &s);
            long double angle = turn * (long double)k / (long double)n;
            assert_true(fabsl((long double)c - cosl(angle)) < (long double)ulp);
            assert_true(fabsl((long double)s - sinl(angle)) < (long double)ulp);
        }
    double c, s;
    for (size_t k = 0; k < 4; k++) {
        fbm_turn(k, 4, &c, &s);
        assert_true(c == (k == 0) - (k == 2) && s == (k == 1) - (k == 3));
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(powersAreGoodToThreeUlp),
        cmocka_unit_test(logarithmsAreGoodToThreeUlp),
        cmocka_unit_test(powersOfAnyBase),
        cmocka_unit_test(turnsAreGoodToOneUlp),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
