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

typedef struct made {
    tl_mesh *mesh;
    uint64_t uncovered;
} made;

static made simplify_source(const tl_source *source, const tl_simplify_options *options)
{
    made out = {0};
    tl_error error = {0};
    if (tl_simplify(source, options, &out.mesh, &out.uncovered, &error) != TL_OK)
        fail_msg("%s", error.text);
    return out;
}

static made simplify(const grid *of, tl_mesh_kind kind, double max_error, unsigned threads)
{
    tl_source *source = open_grid(of);
    tl_run run = {.threads = threads};
    made out = simplify_source(
        source, &(tl_simplify_options){.max_error = max_error, .kind = kind, .canonical_borders = true, .run = &run});
    tl_source_destroy(source);
    return out;
}

/* ---- What must hold of every mesh ------------------------------------------------------------------ */

static long area2(const tl_vertex *a, const tl_vertex *b, long x, long y)
{
    return (long)(b->i - a->i) * (y - a->j) - (long)(b->j - a->j) * (x - a->i);
}

/* Points of a lattice of sixteenths, four in each half of a cell, that lie on no edge between samples that are less
 * than 16 cells apart; of longer edges some may run through one of them, which counts for no triangle then. */
enum { PARTS = 16, PROBES = 4 };
static const int probes[PROBES][2] = {{3, 5}, {11, 7}, {6, 13}, {13, 2}};

/* Counts in how many triangles each probe lies. */
static void count_probes(const grid *of, const tl_vertex *const v[3], unsigned char *hits)
{
    int x0 = (int)fmin(fmin(v[0]->i, v[1]->i), v[2]->i), x1 = (int)fmax(fmax(v[0]->i, v[1]->i), v[2]->i);
    int y0 = (int)fmin(fmin(v[0]->j, v[1]->j), v[2]->j), y1 = (int)fmax(fmax(v[0]->j, v[1]->j), v[2]->j);
    tl_vertex fine[3];
    for (int k = 0; k < 3; k++)
        fine[k] = (tl_vertex){PARTS * v[k]->i, PARTS * v[k]->j, 0};
    for (int y = y0; y < y1; y++)
        for (int x = x0; x < x1; x++)
            for (int p = 0; p < PROBES; p++) {
                int px = PARTS * x + probes[p][0], py = PARTS * y + probes[p][1], inside = 0;
                for (int k = 0; k < 3; k++)
                    inside += area2(&fine[k], &fine[(k + 1) % 3], px, py) < 0;
                hits[(y * of->width + x) * PROBES + p] += inside == 3;
            }
}

static void check_samples(const grid *of, const tl_vertex *const v[3], double max_error, unsigned char *covered)
{
    long whole = area2(v[0], v[1], v[2]->i, v[2]->j);
    assert_true(whole < 0); /* counter-clockwise where rows go down */
    int x0 = (int)fmin(fmin(v[0]->i, v[1]->i), v[2]->i), x1 = (int)fmax(fmax(v[0]->i, v[1]->i), v[2]->i);
    int y0 = (int)fmin(fmin(v[0]->j, v[1]->j), v[2]->j), y1 = (int)fmax(fmax(v[0]->j, v[1]->j), v[2]->j);
    for (int y = y0; y <= y1; y++)
        for (int x = x0; x <= x1; x++) {
            long w[3];
            double sum = 0;
            for (int k = 0; k < 3; k++) {
                w[k] = area2(v[(k + 1) % 3], v[(k + 2) % 3], x, y);
                sum += (double)w[k] * (double)v[k]->z;
            }
            if (w[0] > 0 || w[1] > 0 || w[2] > 0)
                continue;
            double z = (double)of->z[y * of->width + x];
            if (!(fabs(sum / (double)whole - z) <= max_error)) /* a void is none either */
                fail_msg("%d x %d, max_error %.17g: sample %d, %d is off by %.17g", of->width, of->height, max_error, x,
                         y, fabs(sum / (double)whole - z));
            covered[y * of->width + x] = 1;
        }
}

static bool valid_at(const grid *of, int x, int y)
{
    return x >= 0 && y >= 0 && x < of->width && y < of->height && !isnan(of->z[y * of->width + x]);
}

static int cell_corners(const grid *of, int x, int y)
{
    if (x < 0 || y < 0 || x >= of->width - 1 || y >= of->height - 1)
        return 0;
    return valid_at(of, x, y) + valid_at(of, x + 1, y) + valid_at(of, x, y + 1) + valid_at(of, x + 1, y + 1);
}

/* Whether some cell has a sample and two more valid corners: then the full grid has a triangle with it. */
static bool has_cell(const grid *of, int x, int y)
{
    return valid_at(of, x, y) && (cell_corners(of, x - 1, y - 1) > 2 || cell_corners(of, x, y - 1) > 2 ||
                                  cell_corners(of, x - 1, y) > 2 || cell_corners(of, x, y) > 2);
}

static void check_surface(const grid *of, const made *result, double max_error)
{
    size_t samples = (size_t)of->width * (size_t)of->height, uncovered = 0;
    unsigned char *covered = calloc(samples, 1), *hits = calloc(samples, PROBES);
    const tl_mesh *mesh = result->mesh;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        const tl_vertex *v[3];
        for (int k = 0; k < 3; k++) {
            v[k] = &mesh->vertices[mesh->indices[3 * t + (size_t)k]];
            assert_true(v[k]->z == of->z[v[k]->j * of->width + v[k]->i]);
        }
        check_samples(of, v, max_error, covered);
        count_probes(of, v, hits);
    }
    for (size_t k = 0; k < samples * PROBES; k++)
        if (hits[k] > 1)
            fail_msg("%d x %d, max_error %g: triangles overlap in cell %d, %d", of->width, of->height, max_error,
                     (int)(k / PROBES) % of->width, (int)(k / PROBES) / of->width);
    for (int y = 0; y < of->height; y++)
        for (int x = 0; x < of->width; x++) {
            uncovered += valid_at(of, x, y) && !covered[y * of->width + x];
            if (has_cell(of, x, y) && !covered[y * of->width + x])
                fail_msg("%d x %d, max_error %g: sample %d, %d is in no triangle", of->width, of->height, max_error, x,
                         y);
        }
    assert_int_equal(result->uncovered, uncovered);
    free(covered);
    free(hits);
}

typedef struct edge {
    uint32_t low, high;
    int direction;
} edge;

static int compare_edges(const void *a, const void *b)
{
    const edge *p = a, *q = b;
    if (p->low != q->low)
        return p->low < q->low ? -1 : 1;
    return p->high < q->high ? -1 : p->high > q->high;
}

static bool void_near(const grid *of, const tl_vertex *a, const tl_vertex *b)
{
    for (int y = (a->j < b->j ? a->j : b->j) - 1; y <= (a->j > b->j ? a->j : b->j) + 1; y++)
        for (int x = (a->i < b->i ? a->i : b->i) - 1; x <= (a->i > b->i ? a->i : b->i) + 1; x++)
            if (x >= 0 && y >= 0 && x < of->width && y < of->height && !valid_at(of, x, y))
                return true;
    return false;
}

static bool on_rim(const grid *of, const tl_vertex *a, const tl_vertex *b)
{
    return (a->i == b->i && (a->i == 0 || a->i == of->width - 1)) ||
           (a->j == b->j && (a->j == 0 || a->j == of->height - 1));
}

/* An edge with one triangle lies on the rim or beside a void, and no vertex lies on it. */
static void check_open_edge(const grid *of, const tl_vertex *a, const tl_vertex *b, const unsigned char *used)
{
    assert_true(on_rim(of, a, b) || void_near(of, a, b));
    int dx = b->i - a->i, dy = b->j - a->j, parts = abs(dx), rest = abs(dy);
    while (rest) {
        int swap = parts % rest;
        parts = rest, rest = swap;
    }
    for (int p = 1; p < parts; p++)
        assert_false(used[(a->j + dy / parts * p) * of->width + a->i + dx / parts * p]);
}

static void check_topology(const grid *of, const tl_mesh *mesh)
{
    size_t count = 3 * mesh->triangle_count;
    edge *edges = malloc((count + 1) * sizeof *edges);
    unsigned char *used = calloc((size_t)of->width, (size_t)of->height);
    for (size_t k = 0; k < count; k++) {
        uint32_t a = mesh->indices[k], b = mesh->indices[k % 3 == 2 ? k - 2 : k + 1];
        edges[k] = (edge){a < b ? a : b, a < b ? b : a, a < b ? 1 : -1};
        used[mesh->vertices[a].j * of->width + mesh->vertices[a].i] = 1;
    }
    for (size_t k = 0; k < mesh->vertex_count; k++) /* no vertex without a triangle */
        assert_true(used[mesh->vertices[k].j * of->width + mesh->vertices[k].i]);
    qsort(edges, count, sizeof *edges, compare_edges);
    for (size_t k = 0, n; k < count; k += n) {
        for (n = 1; k + n < count && compare_edges(&edges[k], &edges[k + n]) == 0;)
            n++;
        assert_true(n <= 2);
        if (n == 2)
            assert_int_equal(edges[k].direction + edges[k + 1].direction, 0);
        else
            check_open_edge(of, &mesh->vertices[edges[k].low], &mesh->vertices[edges[k].high], used);
    }
    free(edges);
    free(used);
}

static void check_grid(const grid *of, tl_mesh_kind kind, double max_error)
{
    made result = simplify(of, kind, max_error, 1);
    check_surface(of, &result, max_error);
    check_topology(of, result.mesh);
    tl_mesh_destroy(result.mesh);
}

static void keepsBoundOnRandomDems(void **state)
{
    (void)state;
    static const double bounds[] = {0, 0.4, 1, 3, 12, 100};
    for (unsigned seed = 0; seed < 900; seed++) {
        random_state = seed;
        int width = 1 + random_below(seed % 10 ? 24 : 90), height = 1 + random_below(seed % 10 ? 24 : 90);
        terrain kind = (terrain)random_below(TERRAINS);
        voids holes = seed % 2 ? VOIDS_NONE : (voids)random_below(VOIDS_KINDS);
        grid of = make_grid(width, height, kind, holes);
        double max_error = bounds[random_below(6)];
        check_grid(&of, seed % 3 ? TL_MESH_TIN : TL_MESH_QUADTREE, max_error);
        free(of.z);
    }
}

static void keepsBoundAtSpikesAndVoidsOnTheRim(void **state)
{
    (void)state;
    for (unsigned seed = 0; seed < 300; seed++) {
        random_state = seed;
        grid of = make_grid(2 + random_below(14), 2 + random_below(14), TERRAIN_PLANE, VOIDS_NONE);
        for (int k = random_below(12); k >= 0; k--) {
            int x = random_below(of.width), y = random_below(of.height), side = random_below(4);
            x = side == 0 ? random_below(2) % of.width : side == 1 ? of.width - 1 - random_below(2) : x;
            y = side == 2 ? random_below(2) % of.height : side == 3 ? of.height - 1 - random_below(2) : y;
            of.z[y * of.width + x] = random_below(2) ? NAN : 1e6f;
        }
        check_grid(&of, seed % 2 ? TL_MESH_TIN : TL_MESH_QUADTREE, 2);
        free(of.z);
    }
}

static void keepsBoundOverSeveralWindows(void **state)
{
    (void)state;
    random_state = 5;
    grid of = make_grid(1100, 620, TERRAIN_HILLS, VOIDS_NONE),
         holes = make_grid(530, 1061, TERRAIN_HILLS, VOIDS_BLOCKS);
    check_grid(&of, TL_MESH_TIN, 6);
    check_grid(&of, TL_MESH_QUADTREE, 6);
    check_grid(&holes, TL_MESH_TIN, 6);
    check_grid(&of, TL_MESH_TIN, 1000);
    free(of.z);
    free(holes.z);
}

static void isTheSameForAnyThreads(void **state)
{
    (void)state;
    random_state = 6;
    grid of = make_grid(1201, 700, TERRAIN_HILLS, VOIDS_NONE);
    made one = simplify(&of, TL_MESH_TIN, 5, 1);
    for (unsigned threads = 2; threads <= 5; threads += 3) {
        made more = simplify(&of, TL_MESH_TIN, 5, threads);
        assert_int_equal(one.mesh->vertex_count, more.mesh->vertex_count);
        assert_int_equal(one.mesh->triangle_count, more.mesh->triangle_count);
        assert_memory_equal(one.mesh->vertices, more.mesh->vertices, one.mesh->vertex_count * sizeof(tl_vertex));
        assert_memory_equal(one.mesh->indices, more.mesh->indices, 3 * one.mesh->triangle_count * sizeof(uint32_t));
        tl_mesh_destroy(more.mesh);
    }
    tl_mesh_destroy(one.mesh);
    free(of.z);
}

/* A plane needs its corners only, and two more samples on each side where a line between windows ends. */
static void planeTakesNoMoreThanItsRim(void **state)
{
    (void)state;
    random_state = 1;
    grid of = make_grid(400, 300, TERRAIN_PLANE, VOIDS_NONE);
    for (int y = 0; y < of.height; y++)
        for (int x = 0; x < of.width; x++)
            of.z[y * of.width + x] = (float)(3 * x - 2 * y);
    made result = simplify(&of, TL_MESH_TIN, 0, 1);
    assert_int_equal(result.mesh->triangle_count, 2);
    tl_mesh_destroy(result.mesh);
    free(of.z);
}

/* The irregular mesh is what it is for. Hills of the test's noise: three samples of it a wave or so. */
static void tinIsSmallerThanQuadtree(void **state)
{
    (void)state;
    random_state = 8;
    grid of = make_grid(300, 300, TERRAIN_HILLS, VOIDS_NONE);
    made tin = simplify(&of, TL_MESH_TIN, 8, 1), tree = simplify(&of, TL_MESH_QUADTREE, 8, 1);
    assert_true(2 * tin.mesh->triangle_count < tree.mesh->triangle_count);
    tl_mesh_destroy(tin.mesh);
    tl_mesh_destroy(tree.mesh);
    free(of.z);
}

/* ---- Tiles ------------------------------------------------------------------------------------------- */

/* Columns x0 ... x1 and rows y0 ... y1. */
static grid cut(const grid *of, int x0, int y0, int x1, int y1)
{
    grid out = {x1 - x0 + 1, y1 - y0 + 1, NULL};
    out.z = malloc((size_t)out.width * (size_t)out.height * sizeof *out.z);
    for (int y = 0; y < out.height; y++)
        memcpy(out.z + y * out.width, of->z + (y0 + y) * of->width + x0, (size_t)out.width * sizeof *out.z);
    return out;
}

/* Adds a tile's triangles to a mesh over the whole, where vertices are named by their sample. */
static void add_tile(const grid *of, const tl_mesh *tile, int x0, int y0, tl_mesh *to)
{
    for (size_t k = 0; k < 3 * tile->triangle_count; k++) {
        const tl_vertex *v = &tile->vertices[tile->indices[k]];
        to->indices[3 * to->triangle_count + k] = (uint32_t)((v->j + y0) * of->width + v->i + x0);
    }
    to->triangle_count += tile->triangle_count;
}

/* Drops the samples that are no vertices. */
static void compact(tl_mesh *mesh)
{
    uint32_t *number = calloc(mesh->vertex_count, sizeof *number), next = 0;
    for (size_t k = 0; k < 3 * mesh->triangle_count; k++)
        number[mesh->indices[k]] = 1;
    for (size_t k = 0; k < mesh->vertex_count; k++)
        if (number[k]) {
            mesh->vertices[next] = mesh->vertices[k];
            number[k] = next++;
        }
    for (size_t k = 0; k < 3 * mesh->triangle_count; k++)
        mesh->indices[k] = number[mesh->indices[k]];
    mesh->vertex_count = next;
    free(number);
}

static void check_tiles(const grid *of, int middle_x, int middle_y, double max_error, bool mixed)
{
    size_t samples = (size_t)of->width * (size_t)of->height;
    tl_mesh whole = {.vertex_count = samples,
                     .vertices = malloc(samples * sizeof(tl_vertex)),
                     .indices = malloc(samples * 6 * sizeof(uint32_t))};
    for (size_t k = 0; k < samples; k++)
        whole.vertices[k] = (tl_vertex){(int32_t)(k % (size_t)of->width), (int32_t)(k / (size_t)of->width), of->z[k]};
    for (int k = 0; k < 4; k++) {
        int x0 = k & 1 ? middle_x : 0, x1 = k & 1 ? of->width - 1 : middle_x;
        int y0 = k & 2 ? middle_y : 0, y1 = k & 2 ? of->height - 1 : middle_y;
        grid part = cut(of, x0, y0, x1, y1);
        made tile = simplify(&part, mixed && k % 3 ? TL_MESH_QUADTREE : TL_MESH_TIN, max_error, 1);
        add_tile(of, tile.mesh, x0, y0, &whole);
        tl_mesh_destroy(tile.mesh);
        free(part.z);
    }
    compact(&whole);
    made result = {&whole, 0};
    check_surface(of, &result, max_error);
    check_topology(of, &whole);
    free(whole.vertices);
    free(whole.indices);
}

/* The union of tiles simplified apart passes all checks of one mesh: no crack, no T-junction on the rims they share. */
static void tilesJoinWithoutACrack(void **state)
{
    (void)state;
    for (unsigned seed = 0; seed < 60; seed++) {
        random_state = seed;
        terrain kind = seed % 2 ? TERRAIN_HILLS : seed % 4 ? TERRAIN_EIGHTHS : TERRAIN_NOISE;
        grid of = make_grid(9 + random_below(60), 9 + random_below(60), kind, VOIDS_NONE);
        check_tiles(&of, 4 + random_below(of.width - 8), 4 + random_below(of.height - 8), 1 + random_below(20),
                    seed % 3 == 0);
        free(of.z);
    }
}

static void wideTilesJoinWithoutACrack(void **state)
{
    (void)state;
    random_state = 3;
    grid of = make_grid(1300, 400, TERRAIN_HILLS, VOIDS_NONE);
    check_tiles(&of, 650, 100, 15, false);
    check_tiles(&of, 50, 200, 60, true);
    free(of.z);
}

/* ---- Bent frames --------------------------------------------------------------------------------------- */

typedef struct ground {
    const char *crs;
    double x, y, cell, relief, height_unit;
} ground;

enum { GROUND = 401 };

/* Hills, and a cliff of the whole relief along a slanting line that ends on the rim. */
static float ground_height(const ground *of, int i, int j)
{
    double u = 2 * i / (GROUND - 1.0) - 1, v = 2 * j / (GROUND - 1.0) - 1;
    double z = of->relief * (sin(5 * u + 2 * v) * cos(3 * v - u) + 0.05 * sin(90 * u) * sin(70 * v));
    return (float)((z + (3 * i > 2 * j + 200 ? of->relief : 0)) / of->height_unit);
}

static void check_ground(const ground *of, tl_mesh_kind kind, double max_error)
{
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text(of->crs, "ground", &crs, NULL), TL_OK);
    float *heights = malloc((size_t)GROUND * GROUND * sizeof *heights);
    for (int k = 0; k < GROUND * GROUND; k++)
        heights[k] = ground_height(of, k % GROUND, k / GROUND);
    tl_source_info info = {.width = GROUND, .height = GROUND, .name = "ground"};
    info.georef = (tl_georef){.crs = crs,
                              .located = true,
                              .transform = {of->x, of->cell, 0, of->y, 0, -of->cell},
                              .height_unit = of->height_unit};
    assert_int_equal(dem_georef_measure(&info.georef, GROUND, GROUND, NULL), TL_OK);
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    char path[64];
    snprintf(path, sizeof path, "test_tin_%ld.ply", (long)getpid());
    tl_simplify_options options = {
        .max_error = max_error, .frame = TL_FRAME_ENU, .kind = kind, .canonical_borders = true};
    options.rounding = tl_write_rounding(&info, path, &(tl_write_options){.frame = TL_FRAME_ENU});
    made result = simplify_source(source, &options);
    tl_mesh_report report = {0};
    assert_int_equal(tl_mesh_verify_in(result.mesh, source, TL_FRAME_ENU, NULL, &report, NULL), TL_OK);
    /* positions of 6.4e6 m round to 1e-9 m; a few of these and a division by the height's unit follow */
    if (!(report.max_error <= max_error + 1e-7))
        fail_msg("%s, %g: off by %.9g at %d, %d", of->crs, max_error, report.max_error, (int)report.worst_i,
                 (int)report.worst_j);
    assert_int_equal(report.uncovered, 0);
    /* and of the file, with its rounded numbers */
    tl_write_options writing = {.overwrite = true, .frame = TL_FRAME_ENU};
    assert_int_equal(tl_write_mesh(result.mesh, path, &writing, NULL), TL_OK);
    assert_int_equal(tl_mesh_verify_file(path, result.mesh, source, NULL, TL_FRAME_ENU, NULL, &report, NULL), TL_OK);
    unlink(path);
    if (!(report.max_error <= max_error))
        fail_msg("%s, %g: the file is off by %.9g", of->crs, max_error, report.max_error);
    tl_mesh_destroy(result.mesh);
    tl_source_destroy(source);
    tl_crs_release(crs);
    free(heights);
}

static void keepsBoundInEnuFrames(void **state)
{
    (void)state;
    static const ground grounds[] = {
        {"EPSG:32630", 400000, 5000000, 1, 40, 1},     {"EPSG:32630", 166000, 9300000, 300, 900, 0.3048},
        {"EPSG:4326", 10, 47, 1 / 300.0, 1500, 1},     {"EPSG:4326", -30, 84, 1 / 60.0, 300, 1},
        {"EPSG:3857", 1000000, 9000000, 500, 2000, 1}, {"EPSG:3031", -600000, 700000, 1000, 1000, 1},
        {"EPSG:4326", 10, 47, 1 / 3600.0, 1500, 1},
    };
    for (size_t k = 0; k < sizeof grounds / sizeof *grounds; k++) {
        check_ground(&grounds[k], TL_MESH_TIN, 3);
        check_ground(&grounds[k], TL_MESH_TIN, 60);
        check_ground(&grounds[k], TL_MESH_QUADTREE, 60);
    }
}

typedef struct moved {
    double x, y, z;
} moved;

static double turn(const moved *a, const moved *b, double x, double y)
{
    return (b->x - a->x) * (y - a->y) - (b->y - a->y) * (x - a->x);
}

/* The largest error of a sample of the grid under the triangle of moved corners that covers it. */
static double error_of_moved(const grid *of, const moved v[3])
{
    double worst = 0, whole = turn(&v[0], &v[1], v[2].x, v[2].y);
    int x0 = (int)fmax(ceil(fmin(fmin(v[0].x, v[1].x), v[2].x)), 0),
        y0 = (int)fmax(ceil(fmin(fmin(v[0].y, v[1].y), v[2].y)), 0);
    double x1 = fmin(fmax(fmax(v[0].x, v[1].x), v[2].x), of->width - 1);
    double y1 = fmin(fmax(fmax(v[0].y, v[1].y), v[2].y), of->height - 1);
    for (int y = y0; y <= y1; y++)
        for (int x = x0; x <= x1; x++) {
            double a = turn(&v[1], &v[2], x, y) / whole, b = turn(&v[2], &v[0], x, y) / whole;
            if (a >= 0 && b >= 0 && a + b <= 1)
                worst = fmax(worst,
                             fabs(a * v[0].z + b * v[1].z + (1 - a - b) * v[2].z - (double)of->z[y * of->width + x]));
        }
    return worst;
}

/* Whatever a file's numbers do to the vertices within the rounding that is allowed for. */
static void keepsBoundWhereVerticesAreMoved(void **state)
{
    (void)state;
    const tl_rounding rounding = {.along = 0.02, .upright = 0.1, .of_range = 0.0005};
    for (unsigned seed = 0; seed < 12; seed++) {
        random_state = seed;
        grid of = make_grid(60, 60, TERRAIN_HILLS, VOIDS_NONE);
        float low = of.z[0], high = of.z[0];
        for (int k = 0; k < 3600; k++)
            low = fminf(low, of.z[k]), high = fmaxf(high, of.z[k]);
        tl_source *source = open_grid(&of);
        made result = simplify_source(source, &(tl_simplify_options){.max_error = 8,
                                                                     .kind = seed % 3 ? TL_MESH_TIN : TL_MESH_QUADTREE,
                                                                     .canonical_borders = true,
                                                                     .rounding = rounding});
        const tl_mesh *mesh = result.mesh;
        assert_true(mesh->triangle_count < 59 * 59);
        moved *at = malloc(mesh->vertex_count * sizeof *at);
        for (size_t k = 0; k < mesh->vertex_count; k++) { /* to the rim of what is allowed */
            double angle = random_below(1000), up = rounding.upright + rounding.of_range * (double)(high - low);
            at[k] = (moved){mesh->vertices[k].i + rounding.along * cos(angle),
                            mesh->vertices[k].j + rounding.along * sin(angle),
                            (double)mesh->vertices[k].z + (random_below(2) ? up : -up)};
        }
        double worst = 0;
        for (size_t t = 0; t < mesh->triangle_count; t++) {
            const uint32_t *k = mesh->indices + 3 * t;
            worst = fmax(worst, error_of_moved(&of, (moved[3]){at[k[0]], at[k[1]], at[k[2]]}));
        }
        if (!(worst <= 8))
            fail_msg("seed %u: off by %.9g", seed, worst);
        free(at);
        tl_mesh_destroy(result.mesh);
        tl_source_destroy(source);
        free(of.z);
    }
}

/* ---- Refusals ------------------------------------------------------------------------------------------ */

static void refusesBoundsThatAreNone(void **state)
{
    (void)state;
    grid of = make_grid(9, 9, TERRAIN_PLANE, VOIDS_NONE);
    tl_source *source = open_grid(&of);
    static const double bounds[] = {-1, (double)NAN, (double)INFINITY};
    for (size_t k = 0; k < 3; k++) {
        tl_mesh *mesh = NULL;
        tl_error error = {0};
        tl_simplify_options options = {.max_error = bounds[k], .kind = TL_MESH_TIN};
        assert_int_equal(tl_simplify(source, &options, &mesh, NULL, &error), TL_ERROR_ARGUMENT);
        assert_null(mesh);
        assert_non_null(strstr(error.text, "max_error"));
    }
    tl_source_destroy(source);
    free(of.z);
}

static void stopsWhenCancelled(void **state)
{
    (void)state;
    grid of = make_grid(90, 90, TERRAIN_HILLS, VOIDS_NONE);
    tl_source *source = open_grid(&of);
    volatile int cancel = 1;
    tl_run run = {.cancel = &cancel};
    tl_mesh *mesh = NULL;
    tl_simplify_options options = {.max_error = 3, .kind = TL_MESH_TIN, .run = &run};
    assert_int_equal(tl_simplify(source, &options, &mesh, NULL, NULL), TL_ERROR_CANCELLED);
    assert_null(mesh);
    tl_source_destroy(source);
    free(of.z);
}

static void refusesWhatDoesNotFitIntoTheMemoryGiven(void **state)
{
    (void)state;
    random_state = 9;
    grid of = make_grid(200, 200, TERRAIN_NOISE, VOIDS_NONE);
    tl_source *source = open_grid(&of);
    static const size_t few[] = {1, 40000, 4 * 40000, 40 * 40000};
    for (size_t k = 0; k < 4; k++) { /* for nothing, for heights in part, for no mesh, for no collapse */
        tl_run run = {.threads = 1, .memory = few[k]};
        tl_mesh *mesh = NULL;
        tl_error error = {0};
        tl_simplify_options options = {.max_error = 0.1, .kind = TL_MESH_TIN, .run = &run};
        assert_int_equal(tl_simplify(source, &options, &mesh, NULL, &error), TL_ERROR_MEMORY);
        assert_null(mesh);
        assert_non_null(strstr(error.text, "MB"));
    }
    tl_source_destroy(source);
    free(of.z);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(keepsBoundOnRandomDems),
        cmocka_unit_test(keepsBoundAtSpikesAndVoidsOnTheRim),
        cmocka_unit_test(keepsBoundOverSeveralWindows),
        cmocka_unit_test(isTheSameForAnyThreads),
        cmocka_unit_test(planeTakesNoMoreThanItsRim),
        cmocka_unit_test(tinIsSmallerThanQuadtree),
        cmocka_unit_test(tilesJoinWithoutACrack),
        cmocka_unit_test(wideTilesJoinWithoutACrack),
        cmocka_unit_test(keepsBoundInEnuFrames),
        cmocka_unit_test(keepsBoundWhereVerticesAreMoved),
        cmocka_unit_test(refusesBoundsThatAreNone),
        cmocka_unit_test(stopsWhenCancelled),
        cmocka_unit_test(refusesWhatDoesNotFitIntoTheMemoryGiven),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
