/* The rim of a mesh that joins its neighbours without a crack. Which samples of the raster's outermost rows and columns
 * are vertices is decided by their own heights alone (Douglas and Peucker, 1973, in one dimension), so two tiles that
 * share a row choose the same ones. The band of cells between the rim and the mesh of the inner raster holds no sample
 * but on its two borders, so every triangulation of it keeps the bound.
 *
 * Voids break the chains of vertices on either side of the band. What would be left alone then is given neighbours: the
 * inner mesh gets all samples of its border that lie beside a void of the rim, and the rim those beside a sample of the
 * second row that stands alone there. */
#include "dem/tin.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static const uint32_t NONE = UINT32_MAX;

enum { TOP, BOTTOM, LEFT, RIGHT, SIDES };

/* One side of the raster: the samples of its outermost row (or column) and of the second. */
typedef struct side {
    int kind;
    int64_t length;
    unsigned char *kept; /* of the rim: whether it is a vertex */
    uint32_t *outer;     /* numbers of the vertices of the rim, or NONE */
    uint32_t *inner;     /* likewise of the second row */
    int64_t *next;       /* of the second row: the other end of the inner mesh's edge from here on, or 0 */
} side;

typedef struct band {
    const tl_tin_rim *rim;
    tl_tin_soup *soup;
    side sides[SIDES];
    int64_t *stack;
    bool narrow; /* two rows or columns: each side's second row is the other rim */
} band;

/* ---- Places ------------------------------------------------------------------------------------------ */

static void place(const band *self, const side *of, int64_t depth, int64_t at, int64_t *x, int64_t *y)
{
    int64_t width = self->rim->width, height = self->rim->height;
    bool row = of->kind == TOP || of->kind == BOTTOM;
    int64_t across = of->kind == TOP || of->kind == LEFT ? depth : (row ? height : width) - 1 - depth;
    *x = row ? at : across;
    *y = row ? across : at;
}

static float height_at(const band *self, const side *of, int64_t depth, int64_t at)
{
    int64_t x, y;
    place(self, of, depth, at, &x, &y);
    return self->rim->heights[y * self->rim->width + x];
}

static bool valid(const band *self, const side *of, int64_t depth, int64_t at)
{
    return at >= 0 && at < of->length && !isnan(height_at(self, of, depth, at));
}

/* Whether the second row holds sample `at`: it begins and ends a sample later. */
static bool valid_inner(const band *self, const side *of, int64_t at)
{
    return at >= 1 && at < of->length - 1 && valid(self, of, 1, at);
}

static tl_status add_vertex(band *self, int64_t x, int64_t y, uint32_t *number, tl_error *error)
{
    tl_tin_soup *soup = self->soup;
    if (soup->vertex_count == soup->vertex_room) {
        size_t room = soup->vertex_room + soup->vertex_room / 2 + 64;
        tl_vertex *more = room < UINT32_MAX ? realloc(soup->vertices, room * sizeof *more) : NULL;
        if (!more)
            return tl_fail_memory(error, "the mesh");
        soup->vertices = more;
        soup->vertex_room = room;
    }
    *number = (uint32_t)soup->vertex_count++;
    soup->vertices[*number] = (tl_vertex){(int32_t)x, (int32_t)y, self->rim->heights[y * self->rim->width + x]};
    return TL_OK;
}

/* Turned so that its area is positive. */
static tl_status add_triangle(band *self, uint32_t a, uint32_t b, uint32_t c, tl_error *error)
{
    tl_tin_soup *soup = self->soup;
    const tl_vertex *u = &soup->vertices[a], *v = &soup->vertices[b], *w = &soup->vertices[c];
    if (soup->triangle_count == soup->triangle_room) {
        size_t room = soup->triangle_room + soup->triangle_room / 2 + 64;
        uint32_t *more = realloc(soup->triangles, 3 * room * sizeof *more);
        if (!more)
            return tl_fail_memory(error, "the mesh");
        soup->triangles = more;
        soup->triangle_room = room;
    }
    bool turned = (int64_t)(v->i - u->i) * (w->j - u->j) < (int64_t)(v->j - u->j) * (w->i - u->i);
    uint32_t *to = soup->triangles + 3 * soup->triangle_count++;
    to[0] = a, to[1] = turned ? c : b, to[2] = turned ? b : c;
    return TL_OK;
}

/* Notes the number of a vertex with every side whose second row it lies on. */
static void note_inner(band *self, int64_t x, int64_t y, uint32_t number)
{
    const tl_tin_rim *rim = self->rim;
    if (y == 1)
        self->sides[TOP].inner[x] = number;
    if (y == rim->height - 2)
        self->sides[BOTTOM].inner[x] = number;
    if (x == 1)
        self->sides[LEFT].inner[y] = number;
    if (x == rim->width - 2)
        self->sides[RIGHT].inner[y] = number;
}

/* ---- The border of the inner mesh ---------------------------------------------------------------------- */

/* The side on whose second row both vertices lie, or NULL; *from and *to become their places there, in order. */
static side *side_of_edge(band *self, const tl_vertex *a, const tl_vertex *b, int64_t *from, int64_t *to)
{
    const tl_tin_rim *rim = self->rim;
    side *found = NULL;
    if (a->j == b->j && (a->j == 1 || a->j == rim->height - 2))
        found = &self->sides[a->j == 1 ? TOP : BOTTOM];
    if (a->i == b->i && (a->i == 1 || a->i == rim->width - 2))
        found = &self->sides[a->i == 1 ? LEFT : RIGHT];
    bool row = a->j == b->j;
    int64_t p = row ? a->i : a->j, q = row ? b->i : b->j;
    *from = tl_int64_min(p, q);
    *to = tl_int64_max(p, q);
    return found;
}

/* Whether a void of the rim, or a missing sample, lies beside samples from ... to of the second row. */
static bool beside_void(const band *self, const side *of, int64_t from, int64_t to)
{
    for (int64_t at = from; at <= to; at++)
        if (!valid(self, of, 0, at))
            return true;
    return false;
}

/* Cuts a triangle at all samples of its edge corner-next. They are at most half of max_error away from it, so what is
 * left of the triangle moves by no more than that. */
static tl_status cut_triangle(band *self, size_t triangle, int corner, side *of, tl_error *error)
{
    uint32_t *t = self->soup->triangles + 3 * triangle, last = t[corner], end = t[(corner + 1) % 3];
    uint32_t apex = t[(corner + 2) % 3];
    const tl_vertex a = self->soup->vertices[last], b = self->soup->vertices[end];
    int32_t di = (b.i > a.i) - (b.i < a.i), dj = (b.j > a.j) - (b.j < a.j);
    tl_status status = TL_OK;
    for (int32_t i = a.i + di, j = a.j + dj; (i != b.i || j != b.j) && status == TL_OK; i += di, j += dj) {
        uint32_t number;
        status = add_vertex(self, i, j, &number, error);
        if (status == TL_OK)
            status = add_triangle(self, last, number, apex, error);
        if (status != TL_OK)
            break;
        note_inner(self, i, j, number);
        int64_t at = of->kind == TOP || of->kind == BOTTOM ? i : j, before = at - di - dj;
        of->next[tl_int64_min(at, before)] = tl_int64_max(at, before);
        last = number;
    }
    t = self->soup->triangles + 3 * triangle;
    t[corner] = last;
    int64_t p = of->kind == TOP || of->kind == BOTTOM ? b.i - di : b.j - dj, q = p + di + dj;
    of->next[tl_int64_min(p, q)] = tl_int64_max(p, q);
    return status;
}

/* An inner raster of one row has its only row on two sides; no triangle then has an edge there. */
static tl_status find_border(band *self, tl_error *error)
{
    tl_tin_soup *soup = self->soup;
    for (size_t k = 0; k < soup->vertex_count; k++)
        note_inner(self, soup->vertices[k].i, soup->vertices[k].j, (uint32_t)k);
    tl_status status = TL_OK;
    for (size_t t = 0; t < soup->triangle_count && status == TL_OK; t++) /* those that are added too */
        for (int k = 0; k < 3 && status == TL_OK; k++) {
            const uint32_t *corner = soup->triangles + 3 * t;
            int64_t from, to;
            side *of = side_of_edge(self, &soup->vertices[corner[k]], &soup->vertices[corner[(k + 1) % 3]], &from, &to);
            if (!of)
                continue;
            if (to - from > 1 && beside_void(self, of, from, to))
                status = cut_triangle(self, t, k, of, error);
            else
                of->next[from] = to;
        }
    return status;
}

/* Makes vertices of the samples of a second row that the inner mesh does not cover, and keeps the rim beside them. */
static tl_status add_lone(band *self, side *of, tl_error *error)
{
    int64_t covered = 0; /* up to here the inner mesh has an edge */
    tl_status status = TL_OK;
    for (int64_t at = 1; at < of->length - 1 && status == TL_OK; at++) {
        bool on_edge = at <= covered || of->next[at];
        covered = of->next[at] ? of->next[at] : covered;
        if (on_edge || !valid_inner(self, of, at))
            continue;
        int64_t x, y;
        place(self, of, 1, at, &x, &y);
        uint32_t number = of->inner[at];
        if (number == NONE)
            status = add_vertex(self, x, y, &number, error);
        note_inner(self, x, y, number);
        bool single = of->length > 3 && !valid_inner(self, of, at - 1) && !valid_inner(self, of, at + 1);
        for (int64_t beside = at - 1; single && beside <= at + 1; beside++)
            of->kept[beside] = 1;
    }
    return status;
}

/* Unit edges between neighbours that both are vertices but on no edge of the inner mesh. */
static void join_lone(band *self, side *of)
{
    for (int64_t at = 1; at + 1 < of->length - 1; at++)
        if (!of->next[at] && of->inner[at] != NONE && of->inner[at + 1] != NONE && valid_inner(self, of, at + 1))
            of->next[at] = at + 1;
}

/* ---- Which samples of the rim stay --------------------------------------------------------------------- */

/* Bound of what double arithmetic rounds in interpolating between heights up to m: three roundings of sums up to m. */
static double line_rounding(double a, double b)
{
    return fmax(fabs(a), fabs(b)) * (8 * 0x1p-53);
}

/* Where the edge a-b of a side's rim must be split, or 0. `rise` is that of the ground beside it, where it is known. */
static int64_t find_split(const band *self, const side *of, int64_t a, int64_t b, double rise)
{
    const tl_tin_rim *rim = self->rim;
    double from = (double)height_at(self, of, 0, a), to = (double)height_at(self, of, 0, b), worst = -1;
    int64_t at = 0;
    for (int64_t k = a + 1; k < b; k++) {
        double line = (from * (double)(b - k) + to * (double)(k - a)) / (double)(b - a);
        double error = fabs(line - (double)height_at(self, of, 0, k));
        if (error > worst)
            worst = error, at = k;
    }
    if (b - a < 2)
        return 0;
    bool exact = from == floor(from) && to == floor(to) && fabs(from) < 0x1p31 && fabs(to) < 0x1p31;
    double rest = rim->sag ? rim->sag(rim->context, of->kind, (double)(b - a), rise) : 0;
    if (!exact)
        rest += line_rounding(from, to);
    if (worst + rest <= rim->max_error)
        return 0;
    return worst > 0 ? at : (a + b) / 2;
}

/* What the ground rises by in a cell at most between an edge a-b of the rim and the second row. */
static double rise_beside(const band *self, const side *of, int64_t a, int64_t b)
{
    double most = 0;
    for (int64_t k = a - 1; k <= b + 1; k++)
        if (valid(self, of, 1, k) && valid(self, of, 0, k))
            most = fmax(most, fabs((double)height_at(self, of, 1, k) - (double)height_at(self, of, 0, k)));
    double along = ((double)height_at(self, of, 0, b) - (double)height_at(self, of, 0, a)) / (double)(b - a);
    return hypot(most + self->rim->max_error, along);
}

/* Splits a-b, of which all samples are valid, until every part will do. */
static void keep_between(band *self, side *of, int64_t a, int64_t b, bool beside)
{
    size_t depth = 0;
    self->stack[depth++] = b;
    while (depth) {
        int64_t end = self->stack[depth - 1];
        int64_t at = find_split(self, of, a, end, beside ? rise_beside(self, of, a, end) : 0);
        if (at) {
            of->kept[at] = 1;
            self->stack[depth++] = at;
        } else {
            a = end;
            depth--;
        }
    }
}

/* Goes over the stretches between vertices that stay in any case. */
static void keep_side(band *self, side *of, bool beside)
{
    int64_t begin = -1;
    for (int64_t at = 0; at < of->length; at++) {
        if (!valid(self, of, 0, at)) {
            of->kept[at] = 0;
            begin = -1;
        } else if (begin < 0 || of->kept[at]) {
            if (begin >= 0)
                keep_between(self, of, begin, at, beside);
            begin = at;
        }
    }
}

static void keep_ends(band *self, side *of)
{
    for (int64_t at = 0; at < of->length; at++) {
        bool line = at > 1 && at < of->length - 2 && (at - 1) % self->rim->step == 0;
        if (line || !valid(self, of, 0, at - 1) || !valid(self, of, 0, at + 1))
            of->kept[at] = 1;
        if (at == 1 || at == of->length - 2) /* beside a corner whose diagonal is cut off */
            of->kept[at] |= of->length > 2 && !valid_inner(self, of, at);
    }
}

/* In the narrowest raster the other rim is the second row: beside its voids all samples stay. */
static void keep_beside_voids(band *self, side *of)
{
    for (int64_t at = 0; at < of->length; at++)
        of->kept[at] |= !valid(self, of, 1, at - 1) || !valid(self, of, 1, at) || !valid(self, of, 1, at + 1);
}

/* ---- The band --------------------------------------------------------------------------------------------- */

/* Vertices of one border of the band; `joined` tells whether the next one is on the same stretch. */
typedef struct chain {
    size_t count;
    int64_t *at;
    uint32_t *number;
    bool *joined;
} chain;

static void free_chain(chain *c)
{
    free(c->at);
    free(c->number);
    free(c->joined);
}

static bool make_chain(chain *c, int64_t length)
{
    c->at = tl_alloc((size_t)length, sizeof *c->at);
    c->number = tl_alloc((size_t)length, sizeof *c->number);
    c->joined = tl_alloc((size_t)length, sizeof *c->joined);
    return c->at && c->number && c->joined;
}

static void string_outer(const band *self, const side *of, chain *out)
{
    out->count = 0;
    for (int64_t at = 0; at < of->length; at++) {
        if (!valid(self, of, 0, at)) {
            if (out->count)
                out->joined[out->count - 1] = false;
        } else if (of->outer[at] != NONE) {
            out->at[out->count] = at;
            out->number[out->count] = of->outer[at];
            /* where the diagonal of a corner's cell is void, the corner's own triangle takes its edges */
            bool cut =
                (at == 0 && !valid(self, of, 1, 1)) || (at == of->length - 2 && !valid(self, of, 1, of->length - 2));
            out->joined[out->count++] = !cut || self->narrow;
        }
    }
    if (out->count)
        out->joined[out->count - 1] = false;
}

static void string_inner(const side *of, chain *out)
{
    out->count = 0;
    int64_t covered = 0;
    for (int64_t at = 1; at < of->length - 1; at++) {
        if (of->inner[at] == NONE || at < covered)
            continue;
        out->at[out->count] = at;
        out->number[out->count] = of->inner[at];
        out->joined[out->count++] = of->next[at];
        covered = of->next[at];
    }
}

/* Whether edge k of a chain comes near vertex m of the other, or near the edges there. */
static bool comes_near(const chain *edges, size_t k, const chain *others, size_t m)
{
    int64_t low = m && others->joined[m - 1] ? others->at[m - 1] : others->at[m];
    int64_t high = others->joined[m] ? others->at[m + 1] : others->at[m];
    return edges->at[k] <= high + 1 && edges->at[k + 1] >= low - 1;
}

/* Goes along both chains at once, and fills in a triangle for each edge. */
static tl_status fill_between(band *self, const chain *a, const chain *b, tl_error *error)
{
    tl_status status = TL_OK;
    size_t i = 0, j = 0;
    while (a->count && b->count && (i + 1 < a->count || j + 1 < b->count) && status == TL_OK) {
        bool first = i + 1 < a->count;
        if (first && j + 1 < b->count)
            first = a->at[i] + a->at[i + 1] <= b->at[j] + b->at[j + 1];
        if (first) {
            if (a->joined[i] && comes_near(a, i, b, j))
                status = add_triangle(self, a->number[i], a->number[i + 1], b->number[j], error);
            i++;
        } else {
            if (b->joined[j] && comes_near(b, j, a, i))
                status = add_triangle(self, b->number[j], b->number[j + 1], a->number[i], error);
            j++;
        }
    }
    return status;
}

static tl_status fill_side(band *self, const side *of, const side *opposite, tl_error *error)
{
    chain outer = {0}, inner = {0};
    tl_status status = TL_OK;
    if (!make_chain(&outer, of->length) || !make_chain(&inner, of->length)) {
        status = tl_fail_memory(error, "the mesh");
    } else {
        string_outer(self, of, &outer);
        if (opposite)
            string_outer(self, opposite, &inner);
        else
            string_inner(of, &inner);
        status = fill_between(self, &outer, &inner, error);
    }
    free_chain(&outer);
    free_chain(&inner);
    return status;
}

/* A corner cell of which one end of the diagonal is void, which both sides leave out. */
static tl_status fill_corner(band *self, int column_side, int row_side, tl_error *error)
{
    const side *row = &self->sides[row_side], *column = &self->sides[column_side];
    int64_t x = column_side == LEFT ? 0 : row->length - 1, beside_x = column_side == LEFT ? 1 : x - 1;
    int64_t y = row_side == TOP ? 0 : column->length - 1, beside_y = row_side == TOP ? 1 : y - 1;
    uint32_t corner = row->outer[x], inner = row->inner[beside_x];
    uint32_t a = row->outer[beside_x], b = column->outer[beside_y];
    if (a == NONE || b == NONE || (corner == NONE) == (inner == NONE))
        return TL_OK;
    return add_triangle(self, corner == NONE ? inner : corner, a, b, error);
}

/* ---- The whole --------------------------------------------------------------------------------------------- */

static tl_status number_rim(band *self, side *of, tl_error *error)
{
    tl_status status = TL_OK;
    for (int64_t at = 0; at < of->length && status == TL_OK; at++) {
        bool row = of->kind == TOP || of->kind == BOTTOM, low = of->kind == TOP || of->kind == LEFT;
        bool corner = at == 0 || at == of->length - 1;
        if (!of->kept[at])
            continue;
        int64_t x, y;
        place(self, of, 0, at, &x, &y);
        if (!row && corner) { /* rows come first, and have it */
            of->outer[at] = self->sides[at ? BOTTOM : TOP].outer[low ? 0 : self->rim->width - 1];
            continue;
        }
        status = add_vertex(self, x, y, &of->outer[at], error);
    }
    return status;
}

static bool make_sides(band *self)
{
    const tl_tin_rim *rim = self->rim;
    bool made = true;
    for (int k = 0; k < SIDES; k++) {
        side *of = &self->sides[k];
        size_t length = (size_t)(k == TOP || k == BOTTOM ? rim->width : rim->height);
        of->kind = k;
        of->length = (int64_t)length;
        of->kept = calloc(length, 1);
        of->outer = tl_alloc(length, sizeof *of->outer);
        of->inner = tl_alloc(length, sizeof *of->inner);
        of->next = calloc(length, sizeof *of->next);
        made = made && of->kept && of->outer && of->inner && of->next;
        if (of->outer && of->inner) {
            memset(of->outer, 0xff, length * sizeof *of->outer);
            memset(of->inner, 0xff, length * sizeof *of->inner);
        }
    }
    self->stack = tl_alloc((size_t)tl_int64_max(rim->width, rim->height) + 1, sizeof *self->stack);
    return made && self->stack;
}

static void free_sides(band *self)
{
    for (int k = 0; k < SIDES; k++) {
        free(self->sides[k].kept);
        free(self->sides[k].outer);
        free(self->sides[k].inner);
        free(self->sides[k].next);
    }
    free(self->stack);
}

static tl_status choose_rim(band *self, tl_error *error)
{
    tl_status status = self->narrow ? TL_OK : find_border(self, error);
    for (int k = 0; k < SIDES && status == TL_OK; k++) {
        side *of = &self->sides[k];
        if (!self->narrow)
            status = add_lone(self, of, error);
        keep_ends(self, of);
        if (self->narrow)
            keep_beside_voids(self, of);
        keep_side(self, of, false);
        if (self->rim->sag)
            keep_side(self, of, true);
    }
    for (int k = 0; k < SIDES && status == TL_OK; k++) {
        if (!self->narrow)
            join_lone(self, &self->sides[k]);
        status = number_rim(self, &self->sides[k], error);
    }
    return status;
}

static tl_status fill_band(band *self, tl_error *error)
{
    if (self->narrow) {
        int k = self->rim->height == 2 ? TOP : LEFT;
        return fill_side(self, &self->sides[k], &self->sides[k + 1], error);
    }
    tl_status status = TL_OK;
    for (int k = 0; k < SIDES && status == TL_OK; k++)
        status = fill_side(self, &self->sides[k], NULL, error);
    for (int k = 0; k < 4 && status == TL_OK; k++)
        status = fill_corner(self, k & 1 ? RIGHT : LEFT, k & 2 ? BOTTOM : TOP, error);
    return status;
}

tl_status tl_tin_add_rim(const tl_tin_rim *rim, tl_tin_soup *soup, tl_error *error)
{
    band self = {.rim = rim, .soup = soup, .narrow = rim->width == 2 || rim->height == 2};
    tl_status status = make_sides(&self) ? choose_rim(&self, error) : tl_fail_memory(error, "the mesh");
    if (status == TL_OK)
        status = fill_band(&self, error);
    free_sides(&self);
    return status;
}
