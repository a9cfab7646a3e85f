/* Heights rounded to a step. */
#include "lib/base/georef.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <string.h>

#include <cmocka.h>

static void heightsAreTheNearestMultiples(void **state)
{
    (void)state;
    const float heights[6] = {0.1f, -0.1f, 1000.013f, NAN, -3.03125f, 8848.9f};
    const float wanted[6] = {0.125f, -0.125f, 1000, NAN, -3, 8848.875f};
    tl_source_info info = {.width = 3, .height = 2, .georef = tl_georef_none(), .name = "six", .has_voids = true};
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    tl_source *rounded = tl_quantized_create(source, 1.0 / 16, NULL);
    assert_non_null(rounded);
    float out[6];
    assert_int_equal(tl_source_read(rounded, 0, (tl_window){0, 0, 3, 2}, out, NULL), TL_OK);
    for (int k = 0; k < 6; k++) {
        assert_true(isnan(wanted[k]) ? isnan(out[k]) : out[k] == wanted[k]);
        assert_true(isnan(wanted[k]) || fabs((double)out[k] - (double)heights[k]) <= 1.0 / 32);
    }
    assert_true(rounded->info.quantum == 1.0 / 16);
    assert_int_equal(rounded->info.parameter_count, 1);
    assert_string_equal(rounded->info.parameters[0].name, "height_quantum");
    assert_string_equal(rounded->info.parameters[0].value, "0.0625");
    tl_source_destroy(rounded);
    tl_source_destroy(source);
}

static void stepsThatAreNoneAreRefused(void **state)
{
    (void)state;
    const float height = 1;
    tl_source_info info = {.width = 1, .height = 1, .georef = tl_georef_none(), .name = "one"};
    tl_source *source = tl_array_source_create(&height, &info, NULL);
    const double bad[] = {0, -1, 1e31, NAN, INFINITY};
    for (int k = 0; k < 5; k++) {
        tl_error error = {0};
        assert_null(tl_quantized_create(source, bad[k], &error));
        assert_int_equal(error.status, TL_ERROR_ARGUMENT);
    }
    tl_source_destroy(source);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(heightsAreTheNearestMultiples),
        cmocka_unit_test(stepsThatAreNoneAreRefused),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
