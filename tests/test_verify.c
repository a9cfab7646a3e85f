#include "lib/base/georef.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

static uint64_t random_state;

static int random_below(int n)
{
    random_state = random_state * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
    return (int)((random_state >> 33) % (uint64_t)n);
}

static tl_source_info grid_info(int width, int height)
{
    tl_source_info info = {.width = width, .height = height, .has_voids = true, .name = "grid"};
    info.georef = (tl_georef){.transform = {0, 1, 0, 0, 0, -1}, .cell_x = 1, .cell_y = 1, .height_unit = 1};
    return info;
}

static tl_mesh *make_mesh(const tl_source_info *info, const tl_vertex *vertices, size_t vertex_count,
                          const uint32_t *indices, size_t triangle_count)
{
    tl_mesh *mesh = tl_mesh_create(vertex_count, triangle_count, info, NULL);
    assert_non_null(mesh);
    if (vertex_count)
        memcpy(mesh->vertices, vertices, vertex_count * sizeof *vertices);
    if (triangle_count)
        memcpy(mesh->indices, indices, 3 * triangle_count * sizeof *indices);
    return mesh;
}

static tl_mesh_report verify(const tl_mesh *mesh, const float *z, const tl_source_info *info, unsigned threads)
{
    tl_source *source = tl_array_source_create(z, info, NULL);
    tl_mesh_report report;
    tl_error error = {0};
    if (tl_mesh_verify(mesh, source, &(tl_run){.threads = threads}, &report, &error) != TL_OK)
        fail_msg("%s", error.text);
    tl_source_destroy(source);
    return report;
}

/* A 5 x 4 grid under one triangle with the corners (0,0), (4,0), (0,3), on the plane z = x + 2 y. Its long edge passes
 * between samples: it covers 5 + 3 + 2 + 1 of them. */
static void verifyFindsTheWorstSampleOfATriangle(void **state)
{
    static const tl_vertex vertices[] = {{0, 0, 0}, {4, 0, 4}, {0, 3, 6}};
    static const uint32_t turns[2][3] = {{0, 1, 2}, {1, 0, 2}};
    tl_source_info info = grid_info(5, 4);
    float z[20];
    (void)state;
    for (int i = 0; i < 20; i++)
        z[i] = (float)(i % 5 + 2 * (i / 5));
    z[1 * 5 + 2] += 3;  /* the worst of those covered */
    z[0 * 5 + 1] -= 2;  /* on an edge */
    z[3 * 5 + 4] += 50; /* not covered */
    z[1 * 5 + 1] = NAN; /* covered, but void */
    for (int turn = 0; turn < 2; turn++) {
        tl_mesh *mesh = make_mesh(&info, vertices, 3, turns[turn], 1);
        tl_mesh_report report = verify(mesh, z, &info, 1);
        assert_true(report.max_error == 3 && report.worst_i == 2 && report.worst_j == 1);
        assert_int_equal(report.samples, 5 + 3 + 2 + 1 - 1);
        assert_int_equal(report.uncovered, 20 - 11);
        assert_true(fabs(report.rms_error - sqrt((9 + 4) / 10.0)) < 1e-15); /* one rounding each of /, sqrt and - */
        tl_mesh_destroy(mesh);
    }
}

static void verifyCountsSharedSamplesOnce(void **state)
{
    static const tl_vertex vertices[] = {{0, 0, 0}, {2, 0, 0}, {0, 2, 0}, {2, 2, 0}};
    static const uint32_t indices[] = {0, 2, 1, 1, 2, 3};
    tl_source_info info = grid_info(3, 3);
    const float z[9] = {0, 0, 0, 0, 6, 0, 0, 0, 0};
    (void)state;
    tl_mesh *mesh = make_mesh(&info, vertices, 4, indices, 2);
    tl_mesh_report report = verify(mesh, z, &info, 1);
    assert_int_equal(report.samples, 9);
    assert_int_equal(report.uncovered, 0);
    assert_true(report.max_error == 6 && report.rms_error == 2);
    tl_mesh_destroy(mesh);
}

/* Where triangles overlap, the worst of them counts. */
static void verifyTakesTheWorstOfOverlappingTriangles(void **state)
{
    static const tl_vertex vertices[] = {{0, 0, 0}, {2, 0, 0}, {0, 2, 0}, {0, 0, 5}, {2, 0, 5}, {0, 2, 5}};
    static const uint32_t indices[] = {3, 5, 4, 0, 2, 1};
    tl_source_info info = grid_info(3, 3);
    const float z[9] = {0};
    (void)state;
    tl_mesh *mesh = make_mesh(&info, vertices, 6, indices, 2);
    tl_mesh_report report = verify(mesh, z, &info, 1);
    assert_true(report.max_error == 5 && report.samples == 6 && report.uncovered == 3);
    tl_mesh_destroy(mesh);
}

static void verifyOfNothingCoversNothing(void **state)
{
    static const tl_vertex vertices[] = {{0, 0, 0}, {1, 1, 0}, {2, 2, 0}};
    static const uint32_t flat[] = {0, 1, 2};
    tl_source_info info = grid_info(3, 3);
    const float z[9] = {1, 1, NAN, 1, 1, 1, 1, 1, 1};
    (void)state;
    for (size_t triangles = 0; triangles < 2; triangles++) { /* none, then one without area */
        tl_mesh *mesh = make_mesh(&info, vertices, 3, flat, triangles);
        tl_mesh_report report = verify(mesh, z, &info, 1);
        assert_int_equal(report.samples, 0);
        assert_int_equal(report.uncovered, 8);
        assert_true(report.worst_i == -1 && report.worst_j == -1 && report.max_error == 0 && report.rms_error == 0);
        tl_mesh_destroy(mesh);
    }
}

/* What a mesh does at a sample, from all triangles, by signs alone; negative where none covers it. */
static double error_at(const tl_mesh *mesh, int x, int y, double z)
{
    double worst = -1;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        const tl_vertex *v[3];
        long w[3], sum = 0;
        double plane = 0;
        for (int k = 0; k < 3; k++)
            v[k] = &mesh->vertices[mesh->indices[3 * t + (size_t)k]];
        for (int k = 0; k < 3; k++) {
            const tl_vertex *a = v[(k + 1) % 3], *b = v[(k + 2) % 3];
            w[k] = (long)(a->i - x) * (b->j - y) - (long)(a->j - y) * (b->i - x);
            sum += w[k];
            plane += (double)w[k] * (double)v[k]->z;
        }
        bool outside = false;
        for (int k = 0; k < 3; k++)
            outside |= sum > 0 ? w[k] < 0 : w[k] > 0;
        if (sum != 0 && !outside)
            worst = fmax(worst, fabs(plane / (double)sum - z));
    }
    return worst;
}

static void check_random_mesh(int width, int height, size_t triangles)
{
    tl_source_info info = grid_info(width, height);
    float *z = malloc((size_t)width * (size_t)height * sizeof *z);
    tl_mesh *mesh = tl_mesh_create(3 * triangles, triangles, &info, NULL);
    for (int i = 0; i < width * height; i++)
        z[i] = random_below(9) ? (float)random_below(1000) : NAN;
    for (size_t k = 0; k < 3 * triangles; k++) {
        mesh->vertices[k] = (tl_vertex){random_below(width), random_below(height), (float)random_below(1000)};
        mesh->indices[k] = (uint32_t)k;
    }
    uint64_t samples = 0, uncovered = 0;
    double worst = 0, squares = 0;
    for (int i = 0; i < width * height; i++) {
        double e = isnan(z[i]) ? -1 : error_at(mesh, i % width, i / width, (double)z[i]);
        samples += e >= 0;
        uncovered += !isnan(z[i]) && e < 0;
        squares += e >= 0 ? e * e : 0;
        worst = fmax(worst, e);
    }
    tl_mesh_report one = verify(mesh, z, &info, 1), many = verify(mesh, z, &info, 4);
    assert_memory_equal(&one, &many, sizeof one);
    assert_int_equal(one.samples, samples);
    assert_int_equal(one.uncovered, uncovered);
    assert_true(one.max_error == worst); /* sums of integers below 2^53, one division: exact alike */
    /* two sums of n squares, each with a relative error of at most n 2^-53 */
    assert_true(!samples || fabs(one.rms_error - sqrt(squares / (double)samples)) <= 1e-12 * one.rms_error);
    assert_true(!samples || error_at(mesh, (int)one.worst_i, (int)one.worst_j,
                                     (double)z[one.worst_j * width + one.worst_i]) == worst);
    tl_mesh_destroy(mesh);
    free(z);
}

static void verifyAgreesWithAllTrianglesAtAllSamples(void **state)
{
    (void)state;
    for (int round = 0; round < 60; round++) {
        random_state = (uint64_t)round * 12345;
        check_random_mesh(1 + random_below(40), 1 + random_below(40), (size_t)random_below(12));
    }
    check_random_mesh(9000, 21, 9); /* several bands of rows */
    check_random_mesh(300, 700, 9);
}

static void verifyNamesWhatDoesNotFit(void **state)
{
    static const tl_vertex vertices[] = {{0, 0, 0}, {3, 0, 0}, {0, 2, 0}};
    static const uint32_t good[] = {0, 1, 2}, bad[] = {0, 1, 3};
    tl_source_info info = grid_info(3, 3), wide = grid_info(4, 3);
    const float z[12] = {0};
    (void)state;
    for (int round = 0; round < 2; round++) {
        tl_source *source = tl_array_source_create(z, round ? &wide : &info, NULL);
        tl_mesh *mesh = make_mesh(&info, vertices, 3, round ? bad : good, 1);
        tl_mesh_report report = {.samples = 77};
        tl_error error = {0};
        assert_int_equal(tl_mesh_verify(mesh, source, NULL, &report, &error), TL_ERROR_DATA);
        assert_non_null(strstr(error.text, round ? "names vertex 3" : "vertex 1 lies outside"));
        assert_int_equal(report.samples, 77);
        tl_mesh_destroy(mesh);
        tl_source_destroy(source);
    }
}

/* A height that is infinite in the mesh is infinitely wrong, not void. */
static void verifyCountsInfiniteVerticesAsErrors(void **state)
{
    static const tl_vertex vertices[] = {{0, 0, INFINITY}, {2, 0, -INFINITY}, {0, 2, 0}};
    static const uint32_t indices[] = {0, 2, 1};
    tl_source_info info = grid_info(3, 3);
    const float z[9] = {0};
    (void)state;
    tl_mesh *mesh = make_mesh(&info, vertices, 3, indices, 1);
    assert_true(isinf(verify(mesh, z, &info, 1).max_error));
    tl_mesh_destroy(mesh);
}

static void verifyCanBeCancelled(void **state)
{
    const volatile int raised = 1;
    tl_source_info info = grid_info(3, 3);
    const float z[9] = {0};
    (void)state;
    tl_source *source = tl_array_source_create(z, &info, NULL);
    tl_mesh *mesh = make_mesh(&info, NULL, 0, NULL, 0);
    tl_mesh_report report;
    tl_error error = {0};
    assert_int_equal(tl_mesh_verify(mesh, source, &(tl_run){.cancel = &raised}, &report, &error), TL_ERROR_CANCELLED);
    tl_mesh_destroy(mesh);
    tl_source_destroy(source);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(verifyFindsTheWorstSampleOfATriangle),      cmocka_unit_test(verifyCountsSharedSamplesOnce),
        cmocka_unit_test(verifyTakesTheWorstOfOverlappingTriangles), cmocka_unit_test(verifyOfNothingCoversNothing),
        cmocka_unit_test(verifyAgreesWithAllTrianglesAtAllSamples),  cmocka_unit_test(verifyNamesWhatDoesNotFit),
        cmocka_unit_test(verifyCountsInfiniteVerticesAsErrors),      cmocka_unit_test(verifyCanBeCancelled),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
