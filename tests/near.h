/* cmocka's assert_float_equal compares as float; this one in double, and shows the numbers. */
#ifndef TESTS_NEAR_H
#define TESTS_NEAR_H

#include <math.h>

/* Needs cmocka.h before it. False for NaN. */
#define assert_near(value, expected, tolerance)                                                          \
    do {                                                                                                 \
        double near_value = (value), near_expected = (expected), near_tolerance = (tolerance);           \
        if (!(fabs(near_value - near_expected) <= near_tolerance))                                       \
            fail_msg("%s is %.17g, not %.17g to %g", #value, near_value, near_expected, near_tolerance); \
    } while (0)

#endif
