#include "lib/talus.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "tests/grids.h"

static tl_features *find(const grid *of, double persistence, bool lines)
{
    tl_source *source = open_grid(of);
    tl_features *out = NULL;
    tl_error error = {0};
    if (tl_features_find(source, &(tl_features_options){.persistence = persistence, .lines = lines}, &out, &error))
        fail_msg("%s", error.text);
    tl_source_destroy(source);
    return out;
}

static unsigned kinds_at(const tl_features *of, int i, int j)
{
    for (size_t k = 0; k < of->count; k++)
        if (of->items[k].i == i && of->items[k].j == j)
            return of->items[k].kinds;
    return 0;
}

/* ---- By definition ---- */

static bool above(const grid *of, int a, int b)
{
    return of->z[a] > of->z[b] || (of->z[a] == of->z[b] && a > b);
}

/* Marks what is connected to `from` over samples that are not below `level`; whether any is above `from`. */
static bool floods_higher(const grid *of, int from, int level)
{
    int count = of->width * of->height, depth = 0, *stack = malloc((size_t)count * sizeof *stack);
    bool *seen = calloc((size_t)count, sizeof *seen), higher = false;
    assert_non_null(stack);
    assert_non_null(seen);
    stack[depth++] = from;
    seen[from] = true;
    while (depth) {
        int at = stack[--depth], x = at % of->width, y = at / of->width;
        higher |= above(of, at, from);
        for (int dy = -1; dy <= 1; dy++)
            for (int dx = -1; dx <= 1; dx++) {
                int i = x + dx, j = y + dy, to = j * of->width + i;
                if (i < 0 || j < 0 || i >= of->width || j >= of->height || seen[to] || isnan(of->z[to]) ||
                    above(of, level, to))
                    continue;
                seen[to] = true;
                stack[depth++] = to;
            }
    }
    free(stack);
    free(seen);
    return higher;
}

/* The drop from a summit to the highest sample from which a higher one is reached without going below it. */
static double naive_persistence(const grid *of, int summit, float lowest)
{
    int count = of->width * of->height, best = -1;
    for (int level = 0; level < count; level++)
        if (!isnan(of->z[level]) && !above(of, level, summit) && (best < 0 || above(of, level, best)) &&
            floods_higher(of, summit, level))
            best = level;
    return best < 0 ? (double)(of->z[summit] - lowest) : (double)(of->z[summit] - of->z[best]);
}

static bool is_peak(const grid *of, int at)
{
    for (int dy = -1; dy <= 1; dy++)
        for (int dx = -1; dx <= 1; dx++) {
            int i = at % of->width + dx, j = at / of->width + dy;
            if (i >= 0 && j >= 0 && i < of->width && j < of->height && !isnan(of->z[j * of->width + i]) &&
                above(of, j * of->width + i, at))
                return false;
        }
    return true;
}

static void check_summits(const grid *of, const tl_features *found, double persistence, unsigned kind)
{
    float lowest = HUGE_VALF;
    for (int k = 0; k < of->width * of->height; k++)
        lowest = of->z[k] < lowest ? of->z[k] : lowest;
    for (int k = 0; k < of->width * of->height; k++) {
        if (isnan(of->z[k]))
            continue;
        bool expected = is_peak(of, k) && naive_persistence(of, k, lowest) >= persistence;
        int at = kind == TL_FEATURE_PIT ? of->width * of->height - 1 - k : k;
        assert_int_equal(expected, (kinds_at(found, at % of->width, at / of->width) & kind) != 0);
    }
}

/* Of a grid turned by half a turn, with its heights negated: pits become summits, and the order of equals too. */
static grid turned(const grid *of)
{
    int count = of->width * of->height;
    grid out = {of->width, of->height, malloc((size_t)count * sizeof *out.z)};
    assert_non_null(out.z);
    for (int k = 0; k < count; k++)
        out.z[k] = -of->z[count - 1 - k];
    return out;
}

static void summitsAndPitsAreTheDefinition(void **state)
{
    (void)state;
    random_state = 71;
    for (int k = 0; k < 40; k++) {
        grid of = make_grid(4 + random_below(9), 4 + random_below(9), TERRAIN_NOISE, k % 2 ? VOIDS_FEW : VOIDS_NONE);
        grid down = turned(&of);
        double persistence = k % 4 ? 3 * (k % 4) : 0;
        tl_features *found = find(&of, persistence, false);
        check_summits(&of, found, persistence, TL_FEATURE_SUMMIT);
        check_summits(&down, found, persistence, TL_FEATURE_PIT);
        tl_features_destroy(found);
        free(of.z);
        free(down.z);
    }
}

/* Two hills of heights 9 and 7 on a plain of 0, with a pass of 4 between. */
static void passesAndRidgesJoinHills(void **state)
{
    static const float row[9] = {0, 5, 9, 6, 4, 6, 7, 5, 0};
    float z[5 * 9] = {0};
    grid of = {9, 5, z};
    (void)state;
    memcpy(z + 2 * 9, row, sizeof row);
    tl_features *found = find(&of, 3, true);
    assert_true(kinds_at(found, 2, 2) & TL_FEATURE_SUMMIT);
    assert_true(kinds_at(found, 6, 2) & TL_FEATURE_SUMMIT);
    assert_true(kinds_at(found, 4, 2) & TL_FEATURE_PASS);
    assert_true(kinds_at(found, 3, 2) & TL_FEATURE_RIDGE);
    assert_true(kinds_at(found, 5, 2) & TL_FEATURE_RIDGE);
    assert_false(kinds_at(found, 1, 2) & TL_FEATURE_RIDGE);
    tl_features_destroy(found);
    found = find(&of, 3.5, true);
    assert_false(kinds_at(found, 6, 2));
    tl_features_destroy(found);
}

static void plateausHaveOneSummit(void **state)
{
    float z[64];
    grid of = {8, 8, z};
    (void)state;
    for (int k = 0; k < 64; k++)
        z[k] = k / 8 >= 2 && k / 8 < 6 && k % 8 >= 2 && k % 8 < 6 ? 10 : 0;
    tl_features *found = find(&of, 5, false);
    int summits = 0;
    for (size_t k = 0; k < found->count; k++)
        summits += (found->items[k].kinds & TL_FEATURE_SUMMIT) != 0;
    assert_int_equal(summits, 1);
    tl_features_destroy(found);
}

/* ---- In frameworks ---- */

static void check_mesh(const tl_framework *framework, const tl_source *source, double max_error)
{
    tl_mesh *mesh = NULL;
    tl_mesh_report report;
    assert_int_equal(tl_framework_mesh(framework, &mesh, NULL), TL_OK);
    assert_int_equal(tl_mesh_verify(mesh, source, NULL, &report, NULL), TL_OK);
    assert_true(report.max_error <= max_error);
    assert_true(report.uncovered == tl_framework_isolated_count(framework));
    tl_mesh_destroy(mesh);
}

static void featuresBecomePointsAndTheBoundHolds(void **state)
{
    (void)state;
    random_state = 72;
    for (int k = 0; k < 60; k++) {
        grid of = make_grid(2 + random_below(600), 2 + random_below(k % 3 ? 60 : 400), (terrain)random_below(4),
                            k % 3 ? VOIDS_NONE : (voids)random_below(VOIDS_KINDS));
        tl_source *source = open_grid(&of);
        double bound = (double)(1 << random_below(6));
        tl_features *features = find(&of, bound, k % 2);
        tl_framework_options options = {.max_error = bound, .features = features};
        tl_framework *framework = tl_framework_build(source, &options, NULL);
        assert_non_null(framework);
        check_mesh(framework, source, bound);
        for (size_t i = 0; i < features->count; i++) {
            const tl_feature *each = &features->items[i];
            bool alone = tl_framework_isolated_count(framework) > 0;
            assert_true(alone || tl_framework_has_point(framework, each->i, each->j));
        }
        tl_framework_destroy(framework);
        tl_features_destroy(features);
        tl_source_destroy(source);
        free(of.z);
    }
}

/* ---- Bounds that vary ---- */

/* The error over the samples whose bound is at most `limit`. */
static double error_within(const tl_mesh *mesh, const grid *of, const float *limits, float limit)
{
    grid part = {of->width, of->height, malloc((size_t)(of->width * of->height) * sizeof *part.z)};
    assert_non_null(part.z);
    for (int k = 0; k < of->width * of->height; k++)
        part.z[k] = limits[k] <= limit ? of->z[k] : NAN;
    tl_source *source = open_grid(&part);
    tl_mesh_report report;
    assert_int_equal(tl_mesh_verify(mesh, source, NULL, &report, NULL), TL_OK);
    tl_source_destroy(source);
    free(part.z);
    return report.max_error;
}

static void boundsThatVaryHoldAtEverySample(void **state)
{
    static const float bounds[] = {0, 1, 5, 20};
    (void)state;
    random_state = 73;
    for (int k = 0; k < 40; k++) {
        grid of = make_grid(2 + random_below(700), 2 + random_below(80), (terrain)random_below(4),
                            k % 3 ? VOIDS_NONE : (voids)random_below(VOIDS_KINDS));
        grid map = {of.width, of.height, malloc((size_t)(of.width * of.height) * sizeof *map.z)};
        int side = 1 + random_below(90);
        for (int i = 0; i < of.width * of.height; i++)
            map.z[i] = bounds[(i % of.width / side * 7 + i / of.width / side * 5 + k) % 4];
        tl_source *source = open_grid(&of), *limits = open_grid(&map);
        tl_pyramid *pyramid = tl_pyramid_create(source, &(tl_pyramid_options){.exact = k % 2}, NULL);
        tl_framework *framework =
            tl_framework_from_pyramid(pyramid, source, &(tl_selection){.max_error_map = limits}, NULL);
        tl_mesh *mesh = NULL;
        assert_non_null(framework);
        check_mesh(framework, source, 20);
        assert_int_equal(tl_framework_mesh(framework, &mesh, NULL), TL_OK);
        for (int b = 0; b < 4; b++)
            assert_true(error_within(mesh, &of, map.z, bounds[b]) <= (double)bounds[b]);
        tl_mesh_destroy(mesh);
        tl_framework_destroy(framework);
        tl_pyramid_destroy(pyramid);
        tl_source_destroy(source);
        tl_source_destroy(limits);
        free(of.z);
        free(map.z);
    }
}

static void aMapOfOneBoundIsThatBound(void **state)
{
    (void)state;
    random_state = 74;
    grid of = make_grid(530, 300, TERRAIN_HILLS, VOIDS_NONE);
    grid map = {530, 300, malloc(530 * 300 * sizeof *map.z)};
    for (int i = 0; i < 530 * 300; i++)
        map.z[i] = i % 3 ? 5 : NAN;
    tl_source *source = open_grid(&of), *limits = open_grid(&map);
    tl_pyramid *pyramid = tl_pyramid_create(source, NULL, NULL);
    tl_selection by_map = {.max_error = 5, .max_error_map = limits}, by_bound = {.max_error = 5};
    tl_framework *a = tl_framework_from_pyramid(pyramid, source, &by_map, NULL);
    tl_framework *b = tl_framework_from_pyramid(pyramid, source, &by_bound, NULL);
    for (int i = 0; i < 530 * 300; i++)
        assert_int_equal(tl_framework_has_point(a, i % 530, i / 530), tl_framework_has_point(b, i % 530, i / 530));
    tl_framework_destroy(a);
    tl_framework_destroy(b);
    by_map.max_error = -1;
    tl_error error;
    assert_null(tl_framework_from_pyramid(pyramid, source, &by_map, &error));
    assert_int_equal(error.status, TL_ERROR_DATA);
    tl_pyramid_destroy(pyramid);
    tl_source_destroy(source);
    tl_source_destroy(limits);
    free(of.z);
    free(map.z);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(summitsAndPitsAreTheDefinition),  cmocka_unit_test(passesAndRidgesJoinHills),
        cmocka_unit_test(plateausHaveOneSummit),           cmocka_unit_test(featuresBecomePointsAndTheBoundHolds),
        cmocka_unit_test(boundsThatVaryHoldAtEverySample), cmocka_unit_test(aMapOfOneBoundIsThatBound),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
