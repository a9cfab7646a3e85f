/* The stiff and extreme cases that `talus report` shows. */
#include "cmd/report/cases.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <sys/resource.h>

#include <cmocka.h>

enum { FEW_ARE_REFUSED = 6 };

static void everyCaseEndsRightOrInOneError(void **state)
{
    (void)state;
    size_t refused = 0, count = 0;
    for (const report_case *c = report_cases; c->name; c++, count++) {
        tl_run run = {.threads = 2};
        case_result found;
        report_run_case(c, &run, &found);
        if (found.end == CASE_FAILED)
            fail_msg("%s, %s: %s", c->group, c->name, found.text);
        if (found.end == CASE_REFUSED) {
            refused++;
            assert_true(strlen(found.text) > 20 && !strchr(found.text, '\n'));
        } else if (c->z(0, 0) == c->z(0, 0)) /* not void there */
            assert_true(found.samples > 0);
    }
    assert_true(count > 40);
    assert_true(refused <= FEW_ARE_REFUSED);
}

static void everyDepthKeepsToLongDouble(void **state)
{
    (void)state;
    size_t count = 0;
    for (const report_depth *d = report_depths; d->name; d++, count++) {
        tl_precision found;
        tl_error error;
        assert_int_equal(tl_precision_measure(&d->options, &found, &error), TL_OK);
        if (!(found.largest <= REPORT_ROUNDING * d->options.delta))
            fail_msg("%s: %g off", d->name, found.largest);
    }
    assert_true(count >= 10);
}

/* One after the other in one process: what one may take, and what the process is itself. */
static void casesStayInTheirMemory(void **state)
{
    (void)state;
    struct rusage used;
    getrusage(RUSAGE_SELF, &used);
#if !defined(__SANITIZE_ADDRESS__) && !defined(__SANITIZE_THREAD__)
    assert_true(used.ru_maxrss < (CASE_MEMORY >> 10) + (64 << 10));
#endif
}

/* The threads of a run change nothing of what is found. */
static void casesDoNotDependOnThreads(void **state)
{
    (void)state;
    for (const report_case *c = report_cases; c->name; c++) {
        case_result found[2];
        for (unsigned k = 0; k < 2; k++) {
            tl_run run = {.threads = 1 + 2 * k};
            report_run_case(c, &run, &found[k]);
            found[k].seconds = 0;
        }
        assert_int_equal(found[0].end, found[1].end);
        assert_string_equal(found[0].text, found[1].text);
        assert_memory_equal(&found[0].low, &found[1].low, sizeof found[0].low);
        assert_memory_equal(&found[0].high, &found[1].high, sizeof found[0].high);
        assert_int_equal(found[0].samples, found[1].samples);
        assert_int_equal(found[0].triangles, found[1].triangles);
    }
}

/* Errors where none is allowed are failures. */
static void errorsWhereNoneIsAllowedAreFailures(void **state)
{
    (void)state;
    report_case none = report_cases[0];
    none.fov = 400; /* no view is that wide */
    none.pixel_error = 1;
    tl_run run = {.threads = 1};
    case_result found;
    report_run_case(&none, &run, &found);
    assert_int_equal(found.end, CASE_FAILED);
    none.may_refuse = true;
    report_run_case(&none, &run, &found);
    assert_int_equal(found.end, CASE_REFUSED);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(everyCaseEndsRightOrInOneError),
        cmocka_unit_test(everyDepthKeepsToLongDouble),
        cmocka_unit_test(casesStayInTheirMemory),
        cmocka_unit_test(casesDoNotDependOnThreads),
        cmocka_unit_test(errorsWhereNoneIsAllowedAreFailures),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
