#include "dem/crs.h"
#include "lib/base/georef.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "tests/grids.h"

static tl_mesh *framework_mesh(const tl_source *source, double max_error)
{
    tl_mesh *mesh = NULL;
    tl_framework_options options = {.max_error = max_error};
    tl_framework *framework = tl_framework_build(source, &options, NULL);
    assert_non_null(framework);
    assert_int_equal(tl_framework_mesh(framework, &mesh, NULL), TL_OK);
    tl_framework_destroy(framework);
    return mesh;
}

static tl_diagonal_report turn(tl_mesh *mesh, const tl_source *source, double max_error, unsigned threads)
{
    tl_run run = {.threads = threads};
    tl_diagonal_report out;
    tl_error error;
    tl_diagonal_options options = {.max_error = max_error, .run = &run};
    if (tl_mesh_lower_diagonals(mesh, source, &options, &out, &error) != TL_OK)
        fail_msg("%s", error.text);
    return out;
}

static const tl_vertex *corner(const tl_mesh *mesh, size_t triangle, int k)
{
    return &mesh->vertices[mesh->indices[3 * triangle + (size_t)(k % 3)]];
}

static long area2(const tl_vertex *a, const tl_vertex *b, const tl_vertex *c)
{
    return (long)(b->i - a->i) * (c->j - a->j) - (long)(b->j - a->j) * (c->i - a->i);
}

/* Sum of all areas, of which each must be positive: what is covered, while nothing folds. */
static long covered_area(const tl_mesh *mesh)
{
    long sum = 0;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        long area = -area2(corner(mesh, t, 0), corner(mesh, t, 1), corner(mesh, t, 2));
        assert_true(area > 0);
        sum += area;
    }
    return sum;
}

/* The third corner of the triangle that has the edge from q to p, or NULL. */
static const tl_vertex *beyond(const tl_mesh *mesh, const tl_vertex *p, const tl_vertex *q)
{
    for (size_t t = 0; t < mesh->triangle_count; t++)
        for (int k = 0; k < 3; k++)
            if (corner(mesh, t, k) == q && corner(mesh, t, k + 1) == p)
                return corner(mesh, t, k + 2);
    return NULL;
}

/* The largest error of triangle a, b, c at samples that are no corners. */
static double worst_in(const grid *of, const tl_vertex *a, const tl_vertex *b, const tl_vertex *c)
{
    double worst = 0, whole = (double)area2(a, b, c);
    for (int y = 0; y < of->height; y++)
        for (int x = 0; x < of->width; x++) {
            tl_vertex at = {x, y, 0};
            double u = (double)area2(&at, b, c) / whole, v = (double)area2(a, &at, c) / whole, w = 1 - u - v;
            if (u < 0 || v < 0 || w < 0)
                continue;
            double z = (u * (double)a->z + v * (double)b->z + w * (double)c->z) - (double)of->z[y * of->width + x];
            worst = fmax(worst, isnan(z) ? HUGE_VAL : fabs(z));
        }
    return worst;
}

/* Whether q ends a leg of length^2 `leg` at a right angle: p - apex - q. */
static bool half_square(const tl_vertex *p, const tl_vertex *q, const tl_vertex *apex)
{
    long ax = p->i - apex->i, ay = p->j - apex->j, bx = q->i - apex->i, by = q->j - apex->j;
    return ax * bx + ay * by == 0 && ax * ax + ay * ay == bx * bx + by * by;
}

/* Every square is cut along the lower diagonal, or would break the bound if it were. */
static void check_squares(const grid *of, const tl_mesh *mesh, double max_error, const tl_diagonal_report *report)
{
    uint64_t squares = 0, higher = 0;
    for (size_t t = 0; t < mesh->triangle_count; t++)
        for (int k = 0; k < 3; k++) {
            const tl_vertex *p = corner(mesh, t, k), *q = corner(mesh, t, k + 1), *apex = corner(mesh, t, k + 2);
            const tl_vertex *other = p < q && half_square(p, q, apex) ? beyond(mesh, p, q) : NULL;
            if (!other || !half_square(p, q, other))
                continue;
            squares++;
            if ((double)apex->z + (double)other->z >= (double)p->z + (double)q->z)
                continue;
            higher++;
            double worst = fmax(worst_in(of, p, apex, other), worst_in(of, q, apex, other));
            if (worst <= max_error * (1 - 1e-9))
                fail_msg("a square is left with its higher diagonal, where the other is off by %g of %g", worst,
                         max_error);
        }
    assert_int_equal(report->squares, squares);
    assert_int_equal(report->held, higher);
    assert_int_equal(report->lower + report->turned + report->held, squares);
}

static void boundHoldsAndAllElseIsLower(void **state)
{
    (void)state;
    random_state = 7;
    uint64_t turned = 0, held = 0;
    for (int round = 0; round < 4 * TERRAINS; round++)
        for (int holes = 0; holes < VOIDS_KINDS; holes++) {
            int kind = round % TERRAINS;
            grid of = make_grid(9 + random_below(25), 9 + random_below(25), (terrain)kind, (voids)holes);
            tl_source *source = open_grid(&of);
            double max_error = kind == TERRAIN_WIDE ? 0.1 : 1 + random_below(12);
            tl_mesh *mesh = framework_mesh(source, max_error);
            long area = covered_area(mesh);
            tl_mesh_report before, after;
            assert_int_equal(tl_mesh_verify(mesh, source, NULL, &before, NULL), TL_OK);
            tl_diagonal_report report = turn(mesh, source, max_error, 1);
            assert_int_equal(tl_mesh_verify(mesh, source, NULL, &after, NULL), TL_OK);
            assert_true(before.samples == 0 || after.max_error <= max_error);
            assert_int_equal(after.samples, before.samples);
            assert_int_equal(covered_area(mesh), area);
            check_squares(&of, mesh, max_error, &report);
            turned += report.turned, held += report.held;
            tl_mesh_destroy(mesh);
            tl_source_destroy(source);
            free(of.z);
        }
    assert_true(turned > 1000 && held > 100); /* there was something to see */
}

/* Wide cells on the ellipsoid, where triangles sag under the ground by metres: the bound holds there. */
static void boundHoldsOnTheEllipsoid(void **state)
{
    (void)state;
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text("EPSG:32633", "test", &crs, NULL), TL_OK);
    uint64_t turned = 0, held = 0;
    for (int round = 0; round < 4; round++) {
        grid of = {130, 110, malloc(130 * 110 * sizeof(float))};
        double cell = round & 1 ? 4000 : 1500;
        for (int k = 0; k < 130 * 110; k++)
            of.z[k] = (float)(30 * sin(k % 130 * .11 + round) * cos(k / 130 * .17) + 0.02 * (k * 7 % 101));
        tl_source *source = open_grid(&of);
        const double transform[6] = {400000 - 65 * cell, cell, 0, 5100000, 0, -cell};
        memcpy(source->info.georef.transform, transform, sizeof transform);
        source->info.georef.located = true;
        source->info.georef.crs = crs;
        source->info.georef.cell_x = source->info.georef.cell_y = cell;
        tl_framework_options build = {.max_error = 12, .frame = TL_FRAME_ENU};
        tl_framework *framework = tl_framework_build(source, &build, NULL);
        tl_mesh *mesh = NULL;
        tl_mesh_report report;
        assert_int_equal(tl_framework_mesh(framework, &mesh, NULL), TL_OK);
        tl_diagonal_options options = {.max_error = 12, .frame = TL_FRAME_ENU};
        tl_diagonal_report out;
        assert_int_equal(tl_mesh_lower_diagonals(mesh, source, &options, &out, NULL), TL_OK);
        assert_int_equal(tl_mesh_verify_in(mesh, source, TL_FRAME_ENU, NULL, &report, NULL), TL_OK);
        if (!(report.max_error <= 12))
            fail_msg("cells of %g: %g instead of 12", cell, report.max_error);
        turned += out.turned, held += out.held;
        tl_mesh_destroy(mesh);
        tl_framework_destroy(framework);
        tl_source_destroy(source);
        free(of.z);
    }
    if (!(turned > 200 && held > 20))
        fail_msg("%d turned, %d held", (int)turned, (int)held);
    tl_crs_release(crs);
}

static void saddleIsCutLow(void **state)
{
    (void)state;
    grid of = {2, 2, (float[]){5, 0, 0, 5}};
    tl_source *source = open_grid(&of);
    tl_mesh *mesh = framework_mesh(source, 0);
    tl_diagonal_report report = turn(mesh, source, 0, 1);
    assert_int_equal(report.turned, 1);
    assert_int_equal(mesh->triangle_count, 2);
    for (size_t t = 0; t < 2; t++) {
        int high = 0;
        for (int k = 0; k < 3; k++)
            high += (double)corner(mesh, t, k)->z == 5;
        assert_int_equal(high, 1);
    }
    bool told = false;
    for (size_t k = 0; k < mesh->parameter_count; k++)
        told |= strcmp(mesh->parameters[k].name, "diagonal") == 0 && strcmp(mesh->parameters[k].value, "lower") == 0;
    assert_true(told);
    assert_int_equal(turn(mesh, source, 0, 1).turned, 0); /* it is low now */
    tl_mesh_destroy(mesh);
    tl_source_destroy(source);
}

static void threadsChangeNothing(void **state)
{
    (void)state;
    random_state = 11;
    grid of = make_grid(193, 161, TERRAIN_HILLS, VOIDS_FEW);
    tl_source *source = open_grid(&of);
    tl_mesh *one = framework_mesh(source, 3), *three = framework_mesh(source, 3);
    tl_diagonal_report a = turn(one, source, 3, 1), b = turn(three, source, 3, 3);
    assert_memory_equal(one->indices, three->indices, 3 * one->triangle_count * sizeof *one->indices);
    assert_memory_equal(&a, &b, sizeof a);
    assert_true(one->triangle_count > 3 * 4096); /* several chunks */
    tl_mesh_destroy(one);
    tl_mesh_destroy(three);
    tl_source_destroy(source);
    free(of.z);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(boundHoldsAndAllElseIsLower),
        cmocka_unit_test(boundHoldsOnTheEllipsoid),
        cmocka_unit_test(saddleIsCutLow),
        cmocka_unit_test(threadsChangeNothing),
    };
    return cmocka_run_group_tests_name("diagonals", tests, NULL, NULL);
}
