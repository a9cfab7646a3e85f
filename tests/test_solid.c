#include "dem/crs.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

#include "tests/grids.h"

static tl_mesh *mesh_of(const grid *of, double max_error, tl_mesh_kind kind)
{
    tl_source *source = open_grid(of);
    tl_mesh *mesh = NULL;
    tl_error error = {0};
    tl_simplify_options options = {.max_error = max_error, .kind = kind};
    if (tl_simplify(source, &options, &mesh, NULL, &error) != TL_OK)
        fail_msg("%s", error.text);
    tl_source_destroy(source);
    return mesh;
}

/* ---- Edges ------------------------------------------------------------------------------------------- */

/* Edge between two points, which are numbered in some way. */
typedef struct side {
    uint32_t from, to;
} side;

static int compare_sides(const void *a, const void *b)
{
    const side *p = a, *q = b;
    if (p->from != q->from)
        return p->from < q->from ? -1 : 1;
    return p->to < q->to ? -1 : p->to > q->to;
}

/* Whether every side is met by as many that run the other way; and by one alone, if `single`. */
static bool is_closed(const uint32_t *indices, size_t count, bool single)
{
    side *one = malloc((count + 1) * sizeof *one), *other = malloc((count + 1) * sizeof *other);
    bool closed = true;
    for (size_t k = 0; k < count; k++) {
        one[k] = (side){indices[k], indices[k % 3 == 2 ? k - 2 : k + 1]};
        other[k] = (side){one[k].to, one[k].from};
    }
    qsort(one, count, sizeof *one, compare_sides);
    qsort(other, count, sizeof *other, compare_sides);
    for (size_t k = 0; k < count; k++) {
        closed = closed && compare_sides(&one[k], &other[k]) == 0;
        closed = closed && !(single && k && compare_sides(&one[k - 1], &one[k]) == 0);
    }
    free(one);
    free(other);
    return closed;
}

/* Volume of a closed mesh in cells and units of height, x to the right and y upwards: positive where faces look out. */
static double volume(const tl_mesh *mesh)
{
    double sum = 0;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        double p[3][3];
        for (int k = 0; k < 3; k++) {
            const tl_vertex *v = &mesh->vertices[mesh->indices[3 * t + (size_t)k]];
            p[k][0] = v->i, p[k][1] = -v->j, p[k][2] = (double)v->z;
        }
        sum += p[0][0] * (p[1][1] * p[2][2] - p[2][1] * p[1][2]) - p[0][1] * (p[1][0] * p[2][2] - p[2][0] * p[1][2]) +
               p[0][2] * (p[1][0] * p[2][1] - p[2][0] * p[1][1]);
    }
    return sum / 6;
}

/* Volume under a surface down to a height. */
static double volume_under(const tl_mesh *mesh, double floor)
{
    double sum = 0;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        const tl_vertex *a = &mesh->vertices[mesh->indices[3 * t]], *b = &mesh->vertices[mesh->indices[3 * t + 1]];
        const tl_vertex *c = &mesh->vertices[mesh->indices[3 * t + 2]];
        double area = -0.5 * ((double)(b->i - a->i) * (c->j - a->j) - (double)(b->j - a->j) * (c->i - a->i));
        sum += area * (((double)a->z + (double)b->z + (double)c->z) / 3 - floor);
    }
    return sum;
}

static double lowest(const tl_mesh *mesh)
{
    double low = HUGE_VAL;
    for (size_t k = 0; k < mesh->vertex_count; k++)
        low = fmin(low, (double)mesh->vertices[k].z);
    return low;
}

static void check_solid(const grid *of, double max_error, tl_mesh_kind kind)
{
    tl_mesh *mesh = mesh_of(of, max_error, kind);
    if (mesh->triangle_count) {
        double low = lowest(mesh), expected = volume_under(mesh, low - 2.5);
        size_t before = mesh->triangle_count;
        assert_int_equal(tl_mesh_add_base(mesh, 2.5, NULL), TL_OK);
        assert_true(is_closed(mesh->indices, 3 * mesh->triangle_count, true));
        assert_true(mesh->triangle_count > 2 * before);
        assert_true(lowest(mesh) == low - 2.5);
        /* sums of at most 2^13 terms, below 2^26 and exact to 2^-53 of it */
        assert_true(fabs(volume(mesh) - expected) <= 0x1p-14);
    }
    tl_mesh_destroy(mesh);
}

/* Heights of whole numbers, so that the floor is exact; with voids of all kinds, which touch in single samples too. */
static void solidsAreClosedAndFaceOutwards(void **state)
{
    (void)state;
    for (unsigned seed = 0; seed < 200; seed++) {
        random_state = seed;
        voids holes = seed % 4 ? (voids)random_below(VOIDS_KINDS) : VOIDS_NONE;
        grid of =
            make_grid(2 + random_below(28), 2 + random_below(28), seed % 3 ? TERRAIN_HILLS : TERRAIN_NOISE, holes);
        check_solid(&of, 1 + random_below(8), seed % 2 ? TL_MESH_TIN : TL_MESH_QUADTREE);
        free(of.z);
    }
}

/* ---- Skirts ------------------------------------------------------------------------------------------ */

/* A skirt keeps the surface as it is and adds two triangles an open edge, whose lower corners lie straight below. */
static void skirtsHangBelowEveryOpenEdge(void **state)
{
    (void)state;
    for (unsigned seed = 0; seed < 60; seed++) {
        random_state = seed;
        grid of =
            make_grid(2 + random_below(28), 2 + random_below(28), TERRAIN_HILLS, (voids)random_below(VOIDS_KINDS));
        tl_mesh *mesh = mesh_of(&of, 3, TL_MESH_QUADTREE), *plain = mesh_of(&of, 3, TL_MESH_QUADTREE);
        assert_int_equal(tl_mesh_add_skirt(mesh, 7, NULL), TL_OK);
        size_t triangles = plain->triangle_count, vertices = plain->vertex_count;
        assert_memory_equal(mesh->indices, plain->indices, 3 * triangles * sizeof(uint32_t));
        assert_memory_equal(mesh->vertices, plain->vertices, vertices * sizeof(tl_vertex));
        for (size_t t = triangles; t < mesh->triangle_count; t += 2) {
            const uint32_t *w = mesh->indices + 3 * t; /* b, a, below a; b, below a, below b */
            const tl_vertex *a = &mesh->vertices[w[1]], *b = &mesh->vertices[w[0]], *under_a = &mesh->vertices[w[2]];
            const tl_vertex *under_b = &mesh->vertices[w[5]];
            assert_true(w[0] < vertices && w[1] < vertices && w[2] >= vertices && w[5] >= vertices);
            assert_true(w[3] == w[0] && w[4] == w[2]);
            assert_true(under_a->i == a->i && under_a->j == a->j && under_a->z == a->z - 7);
            assert_true(under_b->i == b->i && under_b->j == b->j && under_b->z == b->z - 7);
        }
        /* one wall for each side that no other meets */
        size_t walls = (mesh->triangle_count - triangles) / 2, open = 0, count = 3 * triangles;
        for (size_t k = 0; k < count; k++) {
            bool met = false;
            uint32_t a = plain->indices[k], b = plain->indices[k % 3 == 2 ? k - 2 : k + 1];
            for (size_t m = 0; m < count && !met; m++)
                met = plain->indices[m] == b && plain->indices[m % 3 == 2 ? m - 2 : m + 1] == a;
            open += !met;
        }
        assert_int_equal(walls, open);
        tl_mesh_destroy(mesh);
        tl_mesh_destroy(plain);
        free(of.z);
    }
}

static void refusesDepthsThatDoNotReachDown(void **state)
{
    (void)state;
    random_state = 4;
    grid of = make_grid(5, 5, TERRAIN_PLANE, VOIDS_NONE);
    for (int k = 0; k < 25; k++)
        of.z[k] += 1e9f;
    static const double depths[] = {0, -1, (double)NAN, (double)INFINITY, 1e-3};
    for (size_t k = 0; k < sizeof depths / sizeof *depths; k++) {
        tl_mesh *mesh = mesh_of(&of, 1, TL_MESH_QUADTREE);
        tl_error error = {0};
        size_t triangles = mesh->triangle_count;
        assert_int_equal(tl_mesh_add_base(mesh, depths[k], &error), TL_ERROR_ARGUMENT);
        assert_non_null(strstr(error.text, "base"));
        assert_int_equal(tl_mesh_add_skirt(mesh, depths[k], &error), TL_ERROR_ARGUMENT);
        assert_non_null(strstr(error.text, "skirt"));
        assert_int_equal(mesh->triangle_count, triangles);
        tl_mesh_destroy(mesh);
    }
    free(of.z);
}

/* ---- STL ----------------------------------------------------------------------------------------------- */

typedef struct stl {
    size_t triangles;
    float (*places)[3]; /* of corners */
    float (*normals)[3];
    char header[81];
} stl;

static stl read_stl(const char *path)
{
    stl out = {0};
    unsigned char head[84], record[50];
    FILE *file = fopen(path, "rb");
    assert_non_null(file);
    assert_int_equal(fread(head, 1, sizeof head, file), sizeof head);
    memcpy(out.header, head, 80);
    out.triangles = head[80] | (size_t)head[81] << 8 | (size_t)head[82] << 16 | (size_t)head[83] << 24;
    out.places = malloc((3 * out.triangles + 1) * sizeof *out.places);
    out.normals = malloc((out.triangles + 1) * sizeof *out.normals);
    for (size_t t = 0; t < out.triangles; t++) { /* this test runs on little-endian machines, as those that it guards */
        assert_int_equal(fread(record, 1, sizeof record, file), sizeof record);
        memcpy(out.normals[t], record, 12);
        memcpy(out.places[3 * t], record + 12, 36);
        assert_true(record[48] == 0 && record[49] == 0);
    }
    assert_int_equal(fread(record, 1, 1, file), 0);
    fclose(file);
    return out;
}

static void free_stl(stl *s)
{
    free(s->places);
    free(s->normals);
}

static const float (*sorting)[3];

static int compare_places(const void *a, const void *b)
{
    return memcmp(sorting[*(const uint32_t *)a], sorting[*(const uint32_t *)b], 12);
}

/* Corners numbered by their place, equal bytes alike. */
static uint32_t *number_places(const stl *s)
{
    size_t count = 3 * s->triangles;
    uint32_t *order = malloc((count + 1) * sizeof *order), *number = malloc((count + 1) * sizeof *number);
    for (size_t k = 0; k < count; k++)
        order[k] = (uint32_t)k;
    sorting = (const float(*)[3])s->places;
    qsort(order, count, sizeof *order, compare_places);
    for (size_t k = 0, next = 0; k < count; k++) {
        next += k && compare_places(&order[k - 1], &order[k]) != 0;
        number[order[k]] = (uint32_t)next;
    }
    free(order);
    return number;
}

static double stl_volume(const stl *s)
{
    double sum = 0;
    for (size_t t = 0; t < s->triangles; t++) {
        double p[3][3];
        for (int k = 0; k < 3; k++)
            for (int a = 0; a < 3; a++)
                p[k][a] = (double)s->places[3 * t + (size_t)k][a] - (double)s->places[0][a];
        sum += p[0][0] * (p[1][1] * p[2][2] - p[2][1] * p[1][2]) - p[0][1] * (p[1][0] * p[2][2] - p[2][0] * p[1][2]) +
               p[0][2] * (p[1][0] * p[2][1] - p[2][0] * p[1][1]);
    }
    return sum / 6;
}

static void check_normals(const stl *s)
{
    for (size_t t = 0; t < s->triangles; t++) {
        double length = 0, along[2] = {0, 0};
        for (int a = 0; a < 3; a++) {
            double n = (double)s->normals[t][a], origin = (double)s->places[3 * t][a];
            length += n * n;
            along[0] += n * ((double)s->places[3 * t + 1][a] - origin);
            along[1] += n * ((double)s->places[3 * t + 2][a] - origin);
        }
        assert_true(fabs(length - 1) < 1e-6); /* three roundings to 2^-24 */
        /* edges of a few kilometres at most, by such a normal */
        assert_true(fabs(along[0]) < 1e-2 && fabs(along[1]) < 1e-2);
    }
}

static void stlHoldsAClosedSolidInEveryFrame(void **state)
{
    (void)state;
    static const tl_frame frames[] = {TL_FRAME_ENU, TL_FRAME_PROJECTED, TL_FRAME_PIXEL};
    random_state = 2;
    grid of = make_grid(60, 45, TERRAIN_HILLS, VOIDS_BLOCKS);
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text("EPSG:32630", "grid", &crs, NULL), TL_OK);
    tl_source_info info = {.width = of.width, .height = of.height, .has_voids = true, .name = "grid"};
    info.georef =
        (tl_georef){.crs = crs, .located = true, .transform = {400000, 30, 0, 5000000, 0, -30}, .height_unit = 1};
    assert_int_equal(dem_georef_measure(&info.georef, of.width, of.height, NULL), TL_OK);
    tl_source *source = tl_array_source_create(of.z, &info, NULL);
    char path[64];
    snprintf(path, sizeof path, "test_solid_%ld.stl", (long)getpid());
    for (size_t k = 0; k < 3; k++) {
        tl_mesh *mesh = NULL;
        tl_simplify_options simplify = {.max_error = 4, .frame = frames[k], .kind = TL_MESH_TIN};
        assert_int_equal(tl_simplify(source, &simplify, &mesh, NULL, NULL), TL_OK);
        double under = volume_under(mesh, lowest(mesh) - 10) * (frames[k] == TL_FRAME_PIXEL ? 1 : 900);
        assert_int_equal(tl_mesh_add_base(mesh, 10, NULL), TL_OK);
        tl_write_options options = {.overwrite = true, .frame = frames[k]};
        tl_error error = {0};
        if (tl_write_mesh(mesh, path, &options, &error) != TL_OK)
            fail_msg("%s", error.text);
        stl read = read_stl(path);
        assert_int_equal(read.triangles, mesh->triangle_count);
        assert_memory_equal(read.header, "talus ", 6);
        uint32_t *number = number_places(&read);
        assert_true(is_closed(number, 3 * read.triangles, false));
        /* the scale of UTM is 0.9996 to 1.0004, so areas differ by a thousandth; floats add less */
        assert_true(fabs(stl_volume(&read) / under - 1) < 1.5e-3);
        check_normals(&read);
        free(number);
        free_stl(&read);
        tl_mesh_destroy(mesh);
    }
    unlink(path);
    tl_source_destroy(source);
    tl_crs_release(crs);
    free(of.z);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(solidsAreClosedAndFaceOutwards),
        cmocka_unit_test(skirtsHangBelowEveryOpenEdge),
        cmocka_unit_test(refusesDepthsThatDoNotReachDown),
        cmocka_unit_test(stlHoldsAClosedSolidInEveryFrame),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
