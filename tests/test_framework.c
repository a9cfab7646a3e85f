#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "tests/grids.h"

static tl_framework *build(const grid *from, double max_error, unsigned threads)
{
    tl_source *source = open_grid(from);
    tl_run run = {.threads = threads};
    tl_error error = {0};
    tl_framework *framework = tl_framework_build(source, &(tl_framework_options){max_error, &run}, &error);
    tl_source_destroy(source);
    if (!framework)
        fail_msg("%s", error.text);
    return framework;
}

static tl_mesh *draw(const tl_framework *framework)
{
    tl_mesh *mesh = NULL;
    tl_error error = {0};
    if (tl_framework_mesh(framework, &mesh, &error) != TL_OK)
        fail_msg("%s", error.text);
    return mesh;
}

/* ---- What must hold of every mesh ------------------------------------------------------------------ */

static long area2(const tl_vertex *a, const tl_vertex *b, long x, long y)
{
    return (long)(b->i - a->i) * (y - a->j) - (long)(b->j - a->j) * (x - a->i);
}

static void check_triangle(const grid *of, const tl_vertex *a, const tl_vertex *b, const tl_vertex *c, double max_error,
                           unsigned char *covered)
{
    long whole = area2(a, b, c->i, c->j);
    assert_true(whole < 0); /* counter-clockwise where rows go down */
    int x0 = (int)fmin(fmin(a->i, b->i), c->i), x1 = (int)fmax(fmax(a->i, b->i), c->i);
    int y0 = (int)fmin(fmin(a->j, b->j), c->j), y1 = (int)fmax(fmax(a->j, b->j), c->j);
    for (int y = y0; y <= y1; y++)
        for (int x = x0; x <= x1; x++) {
            long wa = area2(b, c, x, y), wb = area2(c, a, x, y), wc = area2(a, b, x, y);
            if (wa > 0 || wb > 0 || wc > 0)
                continue;
            double z = (double)of->z[y * of->width + x];
            double plane = ((double)wa * (double)a->z + (double)wb * (double)b->z + (double)wc * (double)c->z);
            if (!(fabs(plane / (double)whole - z) <= max_error))
                fail_msg("%d x %d, max_error %g: sample %d, %d is off by %g", of->width, of->height, max_error, x, y,
                         fabs(plane / (double)whole - z));
            covered[y * of->width + x] = 1;
        }
}

static bool valid_at(const grid *of, int x, int y)
{
    return x >= 0 && y >= 0 && x < of->width && y < of->height && !isnan(of->z[y * of->width + x]);
}

/* Valid corners of cell (x, y); 0 outside. */
static int cell_corners(const grid *of, int x, int y)
{
    if (x < 0 || y < 0 || x >= of->width - 1 || y >= of->height - 1)
        return 0;
    return valid_at(of, x, y) + valid_at(of, x + 1, y) + valid_at(of, x, y + 1) + valid_at(of, x + 1, y + 1);
}

/* Whether a sample is valid, but no cell has it and two more valid corners: cells leave it to ties. */
static bool is_alone(const grid *of, int x, int y)
{
    return valid_at(of, x, y) && cell_corners(of, x - 1, y - 1) < 3 && cell_corners(of, x, y - 1) < 3 &&
           cell_corners(of, x - 1, y) < 3 && cell_corners(of, x, y) < 3;
}

static bool is_tie(const grid *of, const tl_mesh *mesh, size_t triangle)
{
    for (int k = 0; k < 3; k++) {
        const tl_vertex *v = &mesh->vertices[mesh->indices[3 * triangle + (size_t)k]];
        if (is_alone(of, v->i, v->j))
            return true;
    }
    return false;
}

/* Every triangle within the bound; drawn area, covered and isolated samples as the valid cells say. */
static void check_surface(const grid *of, const tl_framework *framework, const tl_mesh *mesh, double max_error)
{
    size_t samples = (size_t)of->width * (size_t)of->height, alone = 0, uncovered = 0;
    unsigned char *covered = calloc(samples, 1);
    long area = 0, expected = 0;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        const tl_vertex *v = mesh->vertices;
        const uint32_t *k = mesh->indices + 3 * t;
        check_triangle(of, v + k[0], v + k[1], v + k[2], max_error, covered);
        long own = -area2(v + k[0], v + k[1], v[k[2]].i, v[k[2]].j);
        assert_true(own == 1 || !is_tie(of, mesh, t));
        area += is_tie(of, mesh, t) ? 0 : own;
    }
    for (int y = 0; y < of->height; y++)
        for (int x = 0; x < of->width; x++) {
            int corners = cell_corners(of, x, y);
            expected += corners == 4 ? 2 : corners == 3;
            uncovered += valid_at(of, x, y) && !covered[y * of->width + x];
            alone += is_alone(of, x, y);
        }
    assert_int_equal(area, expected);
    assert_true(uncovered <= alone);
    assert_int_equal(tl_framework_isolated_count(framework), uncovered);
    free(covered);
}

typedef struct edge {
    uint32_t low, high;
    int direction;
    bool of_tie;
} edge;

static int compare_edges(const void *a, const void *b)
{
    const edge *p = a, *q = b;
    if (p->low != q->low)
        return p->low < q->low ? -1 : 1;
    return p->high < q->high ? -1 : p->high > q->high;
}

static int common_factor(int a, int b)
{
    return b ? common_factor(b, a % b) : a;
}

/* An edge with one triangle: the raster's rim, or one unit long beside a cell that cannot be drawn there. */
static void check_open_edge(const grid *of, const tl_vertex *a, const tl_vertex *b)
{
    int dx = abs(a->i - b->i), dy = abs(a->j - b->j), x = a->i < b->i ? a->i : b->i, y = a->j < b->j ? a->j : b->j;
    if (dx == 0 && (x == 0 || x == of->width - 1))
        return;
    if (dy == 0 && (y == 0 || y == of->height - 1))
        return;
    assert_true(dx <= 1 && dy <= 1);
    if (dx && dy)
        assert_int_equal(cell_corners(of, x, y), 3);
    else
        assert_true(cell_corners(of, x, y) < 3 || cell_corners(of, x - (dx == 0), y - (dy == 0)) < 3);
}

static void check_topology(const grid *of, const tl_mesh *mesh)
{
    size_t count = 3 * mesh->triangle_count;
    edge *edges = malloc((count + 1) * sizeof *edges);
    unsigned char *used = calloc(mesh->vertex_count + 1, 1);
    for (size_t k = 0; k < count; k++) {
        uint32_t a = mesh->indices[k], b = mesh->indices[k % 3 == 2 ? k - 2 : k + 1];
        assert_true(a < mesh->vertex_count && a != b);
        used[a] = 1;
        edges[k] = a < b ? (edge){a, b, 1, is_tie(of, mesh, k / 3)} : (edge){b, a, -1, is_tie(of, mesh, k / 3)};
        const tl_vertex *from = &mesh->vertices[a], *to = &mesh->vertices[b]; /* ties pass no sample */
        assert_true(!edges[k].of_tie || common_factor(abs(from->i - to->i), abs(from->j - to->j)) == 1);
    }
    for (size_t v = 0; v < mesh->vertex_count; v++)
        assert_true(used[v]);
    qsort(edges, count, sizeof *edges, compare_edges);
    for (size_t k = 0; k < count; k++) {
        bool twin = k + 1 < count && compare_edges(&edges[k], &edges[k + 1]) == 0;
        if (!twin && edges[k].of_tie)
            continue;
        if (!twin) {
            check_open_edge(of, &mesh->vertices[edges[k].low], &mesh->vertices[edges[k].high]);
            continue;
        }
        assert_int_equal(edges[k].direction + edges[k + 1].direction, 0);
        assert_true(k + 2 >= count || compare_edges(&edges[k], &edges[k + 2]) != 0);
        k++;
    }
    free(edges);
    free(used);
}

static void check_points(const grid *of, const tl_framework *framework, const tl_mesh *mesh)
{
    size_t next = 0;
    assert_int_equal(tl_framework_point_count(framework), mesh->vertex_count);
    for (int y = 0; y < of->height; y++)
        for (int x = 0; x < of->width; x++) {
            if (!tl_framework_has_point(framework, x, y))
                continue;
            assert_true(next < mesh->vertex_count);
            const tl_vertex *v = &mesh->vertices[next++];
            assert_true(v->i == x && v->j == y);
            assert_memory_equal(&v->z, &of->z[y * of->width + x], sizeof v->z);
        }
    assert_int_equal(next, mesh->vertex_count);
}

/* ---- Ties, by all pairs of triangles ----------------------------------------------------------------- */

enum { TIE_REACH = 3 };

static bool edge_separates(const tl_vertex t[3], const tl_vertex u[3])
{
    for (int k = 0; k < 3; k++) {
        int outer = 0;
        for (int i = 0; i < 3; i++)
            outer += area2(&t[k], &t[(k + 1) % 3], u[i].i, u[i].j) >= 0;
        if (outer == 3)
            return true;
    }
    return false;
}

/* Whether two triangles, both counter-clockwise where rows go down, share area. */
static bool overlap(const tl_vertex t[3], const tl_vertex u[3])
{
    return !edge_separates(t, u) && !edge_separates(u, t);
}

static void corners_of(const tl_mesh *mesh, size_t triangle, tl_vertex out[3])
{
    for (int k = 0; k < 3; k++)
        out[k] = mesh->vertices[mesh->indices[3 * triangle + (size_t)k]];
}

/* The triangles that may share area with ties of a sample; returns their number. */
static size_t triangles_near(const tl_mesh *mesh, int x, int y, uint32_t *out)
{
    size_t count = 0;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        tl_vertex c[3];
        corners_of(mesh, t, c);
        int left = 0, right = 0, above = 0, below = 0;
        for (int k = 0; k < 3; k++) {
            left += c[k].i <= x - TIE_REACH, right += c[k].i >= x + TIE_REACH;
            above += c[k].j <= y - TIE_REACH, below += c[k].j >= y + TIE_REACH;
        }
        if (left < 3 && right < 3 && above < 3 && below < 3)
            out[count++] = (uint32_t)t;
    }
    return count;
}

/* Whether a triangle of twice the area 1 fits between sample (x, y), a and b. */
static bool tie_fits(const grid *of, const tl_mesh *mesh, const uint32_t *near, size_t count, const tl_vertex c[3])
{
    if (abs(c[1].i - c[2].i) > TIE_REACH || abs(c[1].j - c[2].j) > TIE_REACH)
        return false;
    if (area2(&c[0], &c[1], c[2].i, c[2].j) != -1 || !valid_at(of, c[1].i, c[1].j) || !valid_at(of, c[2].i, c[2].j))
        return false;
    for (size_t n = 0; n < count; n++) {
        tl_vertex other[3];
        corners_of(mesh, near[n], other);
        if (overlap(c, other))
            return false;
    }
    return true;
}

/* No tie shares area with any triangle; and no sample that is left out could have been tied in. */
static void check_ties(const grid *of, const tl_framework *framework, const tl_mesh *mesh)
{
    enum { SIDE = 2 * TIE_REACH + 1 };
    uint32_t *near = malloc((mesh->triangle_count + 1) * sizeof *near);
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        tl_vertex own[3], other[3];
        corners_of(mesh, t, own);
        size_t count = is_tie(of, mesh, t) ? triangles_near(mesh, own[0].i, own[0].j, near) : 0;
        for (size_t n = 0; n < count; n++) {
            corners_of(mesh, near[n], other);
            assert_true(near[n] == t || !overlap(own, other));
        }
    }
    for (int y = 0; y < of->height; y++)
        for (int x = 0; x < of->width; x++) {
            if (!valid_at(of, x, y) || !is_alone(of, x, y) || tl_framework_has_point(framework, x, y))
                continue;
            size_t count = triangles_near(mesh, x, y, near);
            for (int k = 0; k < SIDE * SIDE * SIDE * SIDE; k++) {
                tl_vertex c[3] = {{x, y, 0},
                                  {x + k % SIDE - TIE_REACH, y + k / SIDE % SIDE - TIE_REACH, 0},
                                  {x + k / SIDE / SIDE % SIDE - TIE_REACH, y + k / SIDE / SIDE / SIDE - TIE_REACH, 0}};
                assert_false(tie_fits(of, mesh, near, count, c));
            }
        }
    free(near);
}

static tl_mesh *check_all(const grid *of, const tl_framework *framework, double max_error)
{
    tl_mesh *mesh = draw(framework);
    check_surface(of, framework, mesh, max_error);
    check_topology(of, mesh);
    check_points(of, framework, mesh);
    check_ties(of, framework, mesh);
    return mesh;
}

/* ---- The definition, without any of the staging ------------------------------------------------------ */

typedef struct naive {
    const grid *of;
    double max_error;
    int size; /* of the virtual lattice, a power of two */
    unsigned char *needed;
    bool changed;
    size_t count; /* of triangles drawn */
    uint64_t *drawn;
} naive;

typedef struct place {
    int x, y;
} place;

static unsigned char *needed_at(const naive *self, place at)
{
    return &self->needed[(size_t)at.y * (size_t)(self->size + 1) + (size_t)at.x];
}

/* -1 outside, 0 inside, 1 over the rim: clips the triangle's corners and midpoints against the raster. A triangle with
 * area inside has its centroid there, or a part of it has: the halves are asked, down to single cells. */
static int naive_side(const naive *self, place a, place b, place c)
{
    int right = self->of->width - 1, bottom = self->of->height - 1;
    if (a.x <= right && b.x <= right && c.x <= right && a.y <= bottom && b.y <= bottom && c.y <= bottom)
        return 0;
    if ((a.x >= right && b.x >= right && c.x >= right) || (a.y >= bottom && b.y >= bottom && c.y >= bottom))
        return -1;
    if (abs(a.x - b.x) <= 1 && abs(a.y - b.y) <= 1)
        return -1; /* a single cell is inside or outside, and inside was answered */
    place m = {(a.x + b.x) / 2, (a.y + b.y) / 2};
    return naive_side(self, c, a, m) >= 0 || naive_side(self, b, c, m) >= 0 ? 1 : -1;
}

static bool naive_bad(const naive *self, place a, place b, place c)
{
    const grid *of = self->of;
    int x0 = (int)fmin(fmin(a.x, b.x), c.x), x1 = (int)fmax(fmax(a.x, b.x), c.x);
    int y0 = (int)fmin(fmin(a.y, b.y), c.y), y1 = (int)fmax(fmax(a.y, b.y), c.y);
    tl_vertex va = {a.x, a.y, of->z[a.y * of->width + a.x]}, vb = {b.x, b.y, of->z[b.y * of->width + b.x]};
    tl_vertex vc = {c.x, c.y, of->z[c.y * of->width + c.x]};
    long whole = area2(&va, &vb, c.x, c.y);
    size_t valid = 0, all = 0;
    double worst = 0;
    for (int y = y0; y <= y1; y++)
        for (int x = x0; x <= x1; x++) {
            long wa = area2(&vb, &vc, x, y), wb = area2(&vc, &va, x, y), wc = area2(&va, &vb, x, y);
            if (wa > 0 || wb > 0 || wc > 0)
                continue;
            double z = (double)of->z[y * of->width + x];
            double plane = (double)wa * (double)va.z + (double)wb * (double)vb.z + (double)wc * (double)vc.z;
            all++;
            valid += !isnan(z);
            worst = fmax(worst, fabs(plane / (double)whole - z));
        }
    return valid != 0 && (valid < all || worst > self->max_error);
}

/* Marks all split vertices whose triangles are bad; `c` splits the parent. */
static void naive_mark(naive *self, place a, place b, place c)
{
    int side = naive_side(self, a, b, c);
    if (side < 0 || (abs(a.x - b.x) <= 1 && abs(a.y - b.y) <= 1))
        return;
    place m = {(a.x + b.x) / 2, (a.y + b.y) / 2};
    if (!*needed_at(self, m) && (side > 0 || naive_bad(self, a, b, c)))
        *needed_at(self, m) = 1;
    naive_mark(self, c, a, m);
    naive_mark(self, b, c, m);
}

/* One pass of the rule that a needed vertex needs those that make its triangles. */
static void naive_saturate(naive *self, place a, place b, place c, bool root)
{
    if (naive_side(self, a, b, c) < 0 || (abs(a.x - b.x) <= 1 && abs(a.y - b.y) <= 1))
        return;
    place m = {(a.x + b.x) / 2, (a.y + b.y) / 2};
    naive_saturate(self, c, a, m, false);
    naive_saturate(self, b, c, m, false);
    if (!root && *needed_at(self, m) && !*needed_at(self, c)) {
        *needed_at(self, c) = 1;
        self->changed = true;
    }
}

static uint64_t naive_key(const naive *self, place a, place b, place c)
{
    uint64_t k[3] = {(uint64_t)(a.y * self->of->width + a.x), (uint64_t)(b.y * self->of->width + b.x),
                     (uint64_t)(c.y * self->of->width + c.x)};
    int first = k[0] < k[1] && k[0] < k[2] ? 0 : k[1] < k[2] ? 1 : 2; /* keeps the direction of turning */
    return k[first] << 42 | k[(first + 1) % 3] << 21 | k[(first + 2) % 3];
}

static void naive_emit(naive *self, place a, place b, place c)
{
    const grid *of = self->of;
    if (valid_at(of, a.x, a.y) && valid_at(of, b.x, b.y) && valid_at(of, c.x, c.y))
        self->drawn[self->count++] = naive_key(self, a, b, c);
}

static void naive_draw(naive *self, place a, place b, place c)
{
    if (naive_side(self, a, b, c) < 0)
        return;
    place m = {(a.x + b.x) / 2, (a.y + b.y) / 2};
    bool finest = abs(a.x - b.x) <= 1 && abs(a.y - b.y) <= 1;
    if (!finest && *needed_at(self, m)) {
        naive_draw(self, c, a, m);
        naive_draw(self, b, c, m);
        return;
    }
    place d = {a.x + b.x - c.x, a.y + b.y - c.y};
    bool turned = finest && !(valid_at(self->of, a.x, a.y) && valid_at(self->of, b.x, b.y));
    if (!turned) {
        naive_emit(self, a, b, c);
    } else if (c.y > d.y || (c.y == d.y && c.x > d.x)) { /* the other diagonal, once a cell */
        naive_emit(self, a, d, c);
        naive_emit(self, d, b, c);
    }
}

static int compare_keys(const void *a, const void *b)
{
    uint64_t p = *(const uint64_t *)a, q = *(const uint64_t *)b;
    return p < q ? -1 : p > q;
}

static naive naive_build(const grid *of, double max_error)
{
    naive self = {.of = of, .max_error = max_error, .size = 1};
    while (self.size < of->width - 1 || self.size < of->height - 1)
        self.size *= 2;
    self.needed = calloc((size_t)(self.size + 1) * (size_t)(self.size + 1), 1);
    self.drawn = malloc((2 * (size_t)of->width * (size_t)of->height + 2) * sizeof *self.drawn);
    place nw = {0, 0}, ne = {self.size, 0}, sw = {0, self.size}, se = {self.size, self.size};
    naive_mark(&self, nw, se, ne);
    naive_mark(&self, se, nw, sw);
    do {
        self.changed = false;
        naive_saturate(&self, nw, se, ne, true);
        naive_saturate(&self, se, nw, sw, true);
    } while (self.changed);
    naive_draw(&self, nw, se, ne);
    naive_draw(&self, se, nw, sw);
    qsort(self.drawn, self.count, sizeof *self.drawn, compare_keys);
    return self;
}

/* The mesh without its ties is, triangle by triangle, the one of the definition. */
static void check_against_definition(const grid *of, const tl_mesh *mesh, double max_error)
{
    naive expected = naive_build(of, max_error);
    uint64_t *keys = malloc((mesh->triangle_count + 1) * sizeof *keys);
    size_t count = 0;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        const tl_vertex *v[3];
        if (is_tie(of, mesh, t))
            continue;
        for (int k = 0; k < 3; k++)
            v[k] = &mesh->vertices[mesh->indices[3 * t + (size_t)k]];
        keys[count++] =
            naive_key(&expected, (place){v[0]->i, v[0]->j}, (place){v[1]->i, v[1]->j}, (place){v[2]->i, v[2]->j});
    }
    qsort(keys, count, sizeof *keys, compare_keys);
    assert_int_equal(count, expected.count);
    assert_memory_equal(keys, expected.drawn, expected.count * sizeof *keys);
    free(keys);
    free(expected.needed);
    free(expected.drawn);
}

/* ---- Tests ------------------------------------------------------------------------------------------- */

static const double bounds[] = {0, 0.25, 1, 3, 10, 40, 1000};

static void frameworkKeepsBoundOnRandomDems(void **state)
{
    (void)state;
    for (int round = 0; round < 300; round++) {
        random_state = (uint64_t)round * 1000003;
        int width = 1 + random_below(70), height = 1 + random_below(70);
        double max_error = bounds[random_below(7)];
        grid of = make_grid(width, height, (terrain)(round % TERRAINS), (voids)(round / TERRAINS % VOIDS_KINDS));
        tl_framework *framework = build(&of, max_error, 1);
        tl_mesh_destroy(check_all(&of, framework, max_error));
        tl_framework_destroy(framework);
        free(of.z);
    }
}

static void frameworkIsTheDefinitionOnRandomDems(void **state)
{
    (void)state;
    for (int round = 0; round < 200; round++) {
        random_state = (uint64_t)round * 7919 + 1;
        int width = 1 + random_below(70), height = 1 + random_below(70);
        double max_error = bounds[random_below(7)];
        grid of = make_grid(width, height, (terrain)(round % TERRAIN_WIDE), (voids)(round / TERRAINS % VOIDS_KINDS));
        tl_framework *framework = build(&of, max_error, 1);
        tl_mesh *mesh = draw(framework);
        check_against_definition(&of, mesh, max_error);
        tl_mesh_destroy(mesh);
        tl_framework_destroy(framework);
        free(of.z);
    }
}

static const int border_sizes[][2] = {{256, 257}, {257, 257}, {258, 513}, {513, 258}, {514, 90}, {40, 600}, {600, 3}};

/* Blocks are 256 samples wide: sizes around them, with bounds that keep triangles larger than blocks in places. */
static void frameworkIsTheDefinitionAcrossBlocks(void **state)
{
    (void)state;
    for (size_t k = 0; k < sizeof border_sizes / sizeof *border_sizes; k++) {
        random_state = k + 77;
        double max_error = k % 2 ? 6 : 0.5;
        grid of = make_grid(border_sizes[k][0], border_sizes[k][1], k % 2 ? TERRAIN_HILLS : TERRAIN_PLANE,
                            k % 3 == 2 ? VOIDS_BLOCKS : VOIDS_NONE);
        tl_framework *framework = build(&of, max_error, 2);
        tl_mesh *mesh = check_all(&of, framework, max_error);
        check_against_definition(&of, mesh, max_error);
        tl_mesh_destroy(mesh);
        tl_framework_destroy(framework);
        free(of.z);
    }
}

/* One bump in a plain: the mark that it leaves must cross the borders of blocks on its way up. */
static void frameworkForcesParentsInOtherBlocks(void **state)
{
    static const int at[][2] = {{255, 100}, {256, 100}, {257, 101}, {256, 256}, {300, 255}, {511, 257}, {128, 512}};
    (void)state;
    for (size_t k = 0; k < sizeof at / sizeof *at; k++) {
        grid of = make_grid(601, 521, TERRAIN_PLANE, VOIDS_NONE);
        for (int y = 0; y < 521; y++)
            for (int x = 0; x < 601; x++)
                of.z[y * 601 + x] = (float)(2 * x + y);
        of.z[at[k][1] * 601 + at[k][0]] += 100;
        tl_framework *framework = build(&of, 1, 3);
        tl_mesh *mesh = check_all(&of, framework, 1);
        check_against_definition(&of, mesh, 1);
        assert_true(mesh->triangle_count < 2000); /* a few for each level, and those along the rim */
        tl_mesh_destroy(mesh);
        tl_framework_destroy(framework);
        free(of.z);
    }
}

/* The same where no rim splits the top: a block's centre that only a neighbour's mark forces has parents there. */
static void frameworkForcesTheTopAboveOtherBlocks(void **state)
{
    static const int at[][2] = {{257, 101}, {511, 700}};
    (void)state;
    for (size_t k = 0; k < sizeof at / sizeof *at; k++) {
        grid of = make_grid(1025, 1025, TERRAIN_PLANE, VOIDS_NONE);
        for (int y = 0; y < 1025; y++)
            for (int x = 0; x < 1025; x++)
                of.z[y * 1025 + x] = (float)(2 * x + y);
        of.z[at[k][1] * 1025 + at[k][0]] += 100;
        tl_framework *framework = build(&of, 1, 2);
        tl_mesh *mesh = check_all(&of, framework, 1);
        check_against_definition(&of, mesh, 1);
        assert_true(mesh->triangle_count < 400);
        tl_mesh_destroy(mesh);
        tl_framework_destroy(framework);
        free(of.z);
    }
}

/* A bound one unit in the last place below the error that a mesh has, as another order of rounding than the
 * framework's measures it: the next mesh must keep it as measured. */
static void frameworkKeepsBoundsThatRoundingCouldBreak(void **state)
{
    int rebuilt = 0;
    (void)state;
    for (int round = 0; round < 400; round++) {
        random_state = (uint64_t)round + 31;
        grid of = make_grid(5 + 4 * (round % 2), 5 + 4 * (round % 2), TERRAIN_WIDE, VOIDS_NONE);
        double max_error = 1e7; /* all heights are below 2^24 / 2 */
        tl_source *source = open_grid(&of);
        for (int step = 0; step < 6 && max_error > 0; step++) {
            tl_framework *framework = build(&of, max_error, 1);
            tl_mesh *mesh = check_all(&of, framework, max_error);
            tl_mesh_report report;
            assert_int_equal(tl_mesh_verify(mesh, source, NULL, &report, NULL), TL_OK);
            assert_true(report.max_error <= max_error);
            rebuilt += step && report.max_error > 0;
            max_error = report.max_error > 0 ? nextafter(report.max_error, 0) : 0;
            tl_mesh_destroy(mesh);
            tl_framework_destroy(framework);
        }
        tl_source_destroy(source);
        free(of.z);
    }
    assert_true(rebuilt > 400); /* or there was nothing to break */
}

static void frameworkDoesNotDependOnThreads(void **state)
{
    (void)state;
    for (size_t k = 0; k < sizeof border_sizes / sizeof *border_sizes; k++) {
        random_state = k;
        grid of = make_grid(border_sizes[k][0], border_sizes[k][1], TERRAIN_HILLS, (voids)(k % VOIDS_KINDS));
        tl_framework *one = build(&of, 4, 1), *many = build(&of, 4, 5);
        tl_mesh *a = draw(one), *b = draw(many);
        assert_int_equal(a->vertex_count, b->vertex_count);
        assert_int_equal(a->triangle_count, b->triangle_count);
        assert_memory_equal(a->vertices, b->vertices, a->vertex_count * sizeof *a->vertices);
        assert_memory_equal(a->indices, b->indices, 3 * a->triangle_count * sizeof *a->indices);
        tl_mesh_destroy(a);
        tl_mesh_destroy(b);
        tl_framework_destroy(one);
        tl_framework_destroy(many);
        free(of.z);
    }
}

static void frameworkNestsWithTheBound(void **state)
{
    (void)state;
    random_state = 5;
    grid of = make_grid(300, 280, TERRAIN_HILLS, VOIDS_FEW);
    tl_framework *fine = build(&of, bounds[0], 1);
    for (int k = 1; k < 7; k++) {
        tl_framework *coarse = build(&of, bounds[k], 1);
        assert_true(tl_framework_point_count(coarse) <= tl_framework_point_count(fine));
        for (int y = 0; y < of.height; y++)
            for (int x = 0; x < of.width; x++)
                assert_true(!tl_framework_has_point(coarse, x, y) || tl_framework_has_point(fine, x, y));
        tl_framework_destroy(fine);
        fine = coarse;
    }
    tl_framework_destroy(fine);
    free(of.z);
}

typedef struct degenerate {
    int width, height;
    const char *samples; /* row by row: 'x' a valid sample, '.' a void */
    size_t triangles, points, isolated;
} degenerate;

static void frameworkCountsDegenerateGrids(void **state)
{
    static const degenerate cases[] = {
        {1, 1, "x", 0, 0, 1},
        {1, 1, ".", 0, 0, 0},
        {5, 1, "xx.xx", 0, 0, 4},
        {1, 4, "xxxx", 0, 0, 4},
        {2, 2, "xxxx", 2, 4, 0},
        {2, 2, ".xxx", 1, 3, 0},
        {2, 2, "x.xx", 1, 3, 0},
        {2, 2, "x..x", 0, 0, 2},
        {2, 2, "....", 0, 0, 0},
        {3, 3, "xxxxxxxxx", 2, 4, 0},
        {3, 3, "xxxx.xxxx", 4, 8, 0},
        {3, 3, ".x.x.x.x.", 0, 0, 4},
        {3, 3, "....x....", 0, 0, 1},
        {3, 2, "xxxxxx", 3, 5, 0},
        {4, 4, "................", 0, 0, 0},
        /* ties: a row's end, of one sample and of two; beyond a corner; three that nothing else holds, and three that
         * span too much */
        {4, 3, "x...xxx.x...", 2, 4, 0},
        {5, 3, "x....xxxx......", 3, 5, 0},
        {4, 3, "xx..xx....x.", 3, 5, 0},
        {4, 2, "x.....xx", 1, 3, 0},
        {4, 2, "x..x.x..", 0, 0, 3},
    };
    (void)state;
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        float z[16];
        grid of = {cases[k].width, cases[k].height, z};
        for (int i = 0; i < of.width * of.height; i++)
            z[i] = cases[k].samples[i] == 'x' ? 7 : NAN;
        tl_framework *framework = build(&of, 0, 1);
        tl_mesh *mesh = check_all(&of, framework, 0);
        assert_int_equal(mesh->triangle_count, cases[k].triangles);
        assert_int_equal(tl_framework_point_count(framework), cases[k].points);
        assert_int_equal(tl_framework_isolated_count(framework), cases[k].isolated);
        tl_mesh_destroy(mesh);
        tl_framework_destroy(framework);
    }
}

static void frameworkDrawsTwoTrianglesForPlanes(void **state)
{
    (void)state;
    grid of = make_grid(513, 513, TERRAIN_PLANE, VOIDS_NONE);
    for (int i = 0; i < 513 * 513; i++) /* not exact in sixteen bits, but exactly flat */
        of.z[i] = 0.1f;
    of.z[0] = -0.0f;
    for (int round = 0; round < 2; round++) {
        tl_framework *framework = build(&of, round ? 0 : 0.1, 2);
        tl_mesh *mesh = check_all(&of, framework, round ? 0 : 0.1);
        assert_int_equal(mesh->triangle_count, 2);
        tl_mesh_destroy(mesh);
        tl_framework_destroy(framework);
        for (int i = 0; i < 513 * 513; i++)
            of.z[i] = (float)(i % 513 * 7 - i / 513 * 5);
    }
    free(of.z);
}

/* Where a wide range of heights makes double arithmetic round, flat parts stay as flat at a bound of 0 as they are
 * beside noise of 20 bits, which is exact. (That three such heights are in line by chance has a probability of 1e-6.)
 */
static void frameworkKeepsFlatPartsBesideRoundedOnes(void **state)
{
    (void)state;
    random_state = 9;
    grid wide = make_grid(257, 257, TERRAIN_WIDE, VOIDS_NONE), exact = make_grid(257, 257, TERRAIN_NOISE, VOIDS_NONE);
    for (int i = 0; i < 257 * 257; i++) {
        exact.z[i] = (float)(random_bits() & 0xfffff);
        if (i % 257 <= 128)
            exact.z[i] = wide.z[i] = 0.3f;
    }
    tl_framework *a = build(&wide, 0, 1), *b = build(&exact, 0, 1);
    tl_mesh_destroy(check_all(&wide, a, 0));
    for (int y = 0; y < 257; y++)
        for (int x = 0; x < 257; x++)
            assert_int_equal(tl_framework_has_point(a, x, y), tl_framework_has_point(b, x, y));
    assert_true(tl_framework_point_count(a) < 257 * 150); /* 129 columns of noise, and those that grade them */
    tl_framework_destroy(a);
    tl_framework_destroy(b);
    free(wide.z);
    free(exact.z);
}

static void frameworkTakesExtremeHeights(void **state)
{
    static const float extremes[] = {1e30f, -1e30f, 3e38f, -3e38f, 1e-42f, -1e-42f, -0.0f, 1, 1e6f};
    (void)state;
    for (int round = 0; round < 40; round++) {
        random_state = (uint64_t)round;
        grid of = make_grid(40, 33, TERRAIN_NOISE, round % 2 ? VOIDS_FEW : VOIDS_NONE);
        for (int i = 0; i < 40 * 33; i++)
            if (random_below(round % 4 ? 200 : 2) == 0)
                of.z[i] = extremes[random_below(9)];
        double max_error = round % 5 ? bounds[random_below(7)] : 1e30;
        tl_framework *framework = build(&of, max_error, 1);
        tl_mesh_destroy(check_all(&of, framework, max_error));
        tl_framework_destroy(framework);
        free(of.z);
    }
}

static void frameworkTakesInfiniteHeightsForVoids(void **state)
{
    float z[9] = {1, 2, 3, 4, INFINITY, 6, 7, 8, -INFINITY}, same[9] = {1, 2, 3, 4, NAN, 6, 7, 8, NAN};
    grid infinite = {3, 3, z}, of = {3, 3, same};
    (void)state;
    tl_framework *framework = build(&infinite, 0, 1);
    tl_mesh *mesh = check_all(&of, framework, 0);
    assert_int_equal(mesh->triangle_count, 3);
    tl_mesh_destroy(mesh);
    tl_framework_destroy(framework);
}

static void frameworkRefusesBadBounds(void **state)
{
    float z[4] = {0};
    grid of = {2, 2, z};
    tl_source *source = open_grid(&of);
    const double bad[] = {-1, (double)NAN, HUGE_VAL};
    (void)state;
    for (int k = 0; k < 3; k++) {
        tl_error error = {0};
        assert_null(tl_framework_build(source, &(tl_framework_options){.max_error = bad[k]}, &error));
        assert_int_equal(error.status, TL_ERROR_ARGUMENT);
        assert_non_null(strstr(error.text, "max_error"));
    }
    tl_source_destroy(source);
    tl_framework_destroy(NULL);
}

static tl_status failing_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    (void)self, (void)level, (void)out;
    if (window.y)
        *error = (tl_error){TL_ERROR_IO, "broken: cannot be read"};
    return window.y ? TL_ERROR_IO : TL_OK;
}

static void frameworkReportsFailingReads(void **state)
{
    tl_source source = {.info = {.width = 4, .height = 1000, .name = "broken"}, .read = failing_read};
    tl_error error = {0};
    (void)state;
    assert_null(tl_framework_build(&source, &(tl_framework_options){.max_error = 1}, &error));
    assert_int_equal(error.status, TL_ERROR_IO);
    assert_string_equal(error.text, "broken: cannot be read");
}

typedef struct watch {
    volatile int cancel;
    uint64_t calls, done, total;
} watch;

static void watch_progress(void *user, uint64_t done, uint64_t total)
{
    watch *self = user;
    assert_true(done >= self->done && done <= total);
    self->done = done;
    self->total = total;
    self->calls++;
}

static void frameworkCancelsAndReportsProgress(void **state)
{
    (void)state;
    random_state = 3;
    grid of = make_grid(600, 300, TERRAIN_HILLS, VOIDS_NONE);
    tl_source *source = open_grid(&of);
    watch self = {0};
    tl_run run = {.threads = 2, .cancel = &self.cancel, .progress = watch_progress, .user = &self};
    tl_framework *framework = tl_framework_build(source, &(tl_framework_options){1, &run}, NULL);
    assert_non_null(framework);
    assert_true(self.calls > 0 && self.total > 0);
    assert_int_equal(self.done, self.total);
    tl_framework_destroy(framework);
    self.cancel = 1;
    self.done = 0;
    tl_error error = {0};
    assert_null(tl_framework_build(source, &(tl_framework_options){1, &run}, &error));
    assert_int_equal(error.status, TL_ERROR_CANCELLED);
    tl_source_destroy(source);
    free(of.z);
}

static void meshRecordsHowItWasMade(void **state)
{
    static const char *const expected[][2] = {
        {"made_by", "made: by a test"}, {"max_error", "2.5"}, {"mesh", "quadtree"}};
    float z[4] = {0, 1, 2, 3};
    grid of = {2, 2, z};
    (void)state;
    tl_framework *framework = build(&of, 2.5, 1); /* the source is gone by now */
    tl_mesh *mesh = draw(framework);
    tl_framework_destroy(framework);
    assert_true(mesh->max_error == 2.5 && mesh->georef.transform[5] == -1);
    assert_int_equal(mesh->parameter_count, 5); /* first the version and the input's name */
    assert_string_equal(mesh->parameters[0].value, tl_version());
    for (int k = 0; k < 3; k++) {
        assert_string_equal(mesh->parameters[k + 2].name, expected[k][0]);
        assert_string_equal(mesh->parameters[k + 2].value, expected[k][1]);
    }
    tl_mesh_destroy(mesh);
}

static tl_source *open_shared(const char *name)
{
    char path[1024];
    const char *shared = getenv("TALUS_SHARED"), *root = getenv("TALUS_SOURCE_ROOT");
    if (shared)
        snprintf(path, sizeof path, "%s/dem/%s", shared, name);
    else
        snprintf(path, sizeof path, "%s/../shared/data/dem/%s", root ? root : ".", name);
    return tl_dem_open((const char *const[]){path}, 1, NULL, NULL);
}

/* The exact and saturated triangulation of the first 1025 x 1025 samples at 20 m, as independent prototypes had it. */
static void frameworkIsExactOnTheAndes(void **state)
{
    (void)state;
    tl_source *dem = open_shared("nfong_S33W071.tif");
    if (!dem)
        skip();
    grid of = {1025, 1025, malloc(sizeof(float) * 1025 * 1025)};
    assert_int_equal(tl_source_read(dem, 0, (tl_window){0, 0, 1025, 1025}, of.z, NULL), TL_OK);
    tl_framework *framework = build(&of, 20, 0);
    tl_mesh *mesh = check_all(&of, framework, 20);
    assert_int_equal(mesh->triangle_count, 550030);
    tl_mesh_destroy(mesh);
    tl_framework_destroy(framework);
    tl_source_destroy(dem);
    free(of.z);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(frameworkKeepsBoundOnRandomDems),
        cmocka_unit_test(frameworkIsTheDefinitionOnRandomDems),
        cmocka_unit_test(frameworkIsTheDefinitionAcrossBlocks),
        cmocka_unit_test(frameworkForcesParentsInOtherBlocks),
        cmocka_unit_test(frameworkForcesTheTopAboveOtherBlocks),
        cmocka_unit_test(frameworkKeepsBoundsThatRoundingCouldBreak),
        cmocka_unit_test(frameworkDoesNotDependOnThreads),
        cmocka_unit_test(frameworkNestsWithTheBound),
        cmocka_unit_test(frameworkCountsDegenerateGrids),
        cmocka_unit_test(frameworkDrawsTwoTrianglesForPlanes),
        cmocka_unit_test(frameworkKeepsFlatPartsBesideRoundedOnes),
        cmocka_unit_test(frameworkTakesExtremeHeights),
        cmocka_unit_test(frameworkTakesInfiniteHeightsForVoids),
        cmocka_unit_test(frameworkRefusesBadBounds),
        cmocka_unit_test(frameworkReportsFailingReads),
        cmocka_unit_test(frameworkCancelsAndReportsProgress),
        cmocka_unit_test(meshRecordsHowItWasMade),
        cmocka_unit_test(frameworkIsExactOnTheAndes),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
