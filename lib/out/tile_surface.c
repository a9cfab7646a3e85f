#include "lib/out/tile_surface.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
    ROW = SCENE_BLOCK_VERTICES,
    MOST = (SCENE_RIM + 1) * (SCENE_RIM + 1),
    NODES = 9, /* places along each side where the directions of columns and rows are known */
    TABLE = 1 << 12,
    CORNERS = 5 /* of a triangle that was cut twice */
};

static const double pi = 3.14159265358979323846;
/* The least radius of curvature of the ellipsoid: of the meridian at the equator, metres. */
static const double least_radius = 6335439;

tl_status out_surface_init(out_surface *s, const scene_own_lattice *lattice, tl_error *error)
{
    *s = (out_surface){.lattice = lattice, .placer = scene_placer_create(lattice, error)};
    if (!s->placer)
        return TL_ERROR_DATA;
    /* cuts and skirts have vertices of their own */
    s->vertex_room = MOST + 16 * (SCENE_RIM + 1);
    s->index_room = 3 * (2 * MOST + 24 * (SCENE_RIM + 1));
    s->vertices = tl_alloc(s->vertex_room, sizeof *s->vertices);
    s->indices = tl_alloc(s->index_room, sizeof *s->indices);
    s->table = tl_alloc(TABLE, sizeof *s->table);
    if (s->vertices && s->indices && s->table)
        return TL_OK;
    out_surface_finish(s);
    return tl_fail_memory(error, "a tile");
}

void out_surface_finish(out_surface *s)
{
    scene_placer_destroy(s->placer);
    free(s->vertices);
    free(s->indices);
    free(s->table);
    *s = (out_surface){0};
}

/* ---- Vertices of the lattice ---- */

/* A difference of heights on both sides, on one where the other is not known or beyond the end. */
static double slope_along(const float *z, ptrdiff_t stride, bool before, bool behind)
{
    before = before && isfinite(z[-stride]);
    behind = behind && isfinite(z[stride]);
    double low = (double)z[before ? -stride : 0], high = (double)z[behind ? stride : 0];
    return before || behind ? (high - low) / (before + behind) : 0;
}

static void take_vertex(const out_glb_tile *t, const tl_window *all, const struct scene_tile_vertex *v,
                        out_surface_vertex *out)
{
    const float *z = t->drawn->block->z + (size_t)(t->drawn->y + v->j) * ROW + (size_t)(t->drawn->x + v->i);
    int64_t x = t->x + v->i * t->step, y = t->y + v->j * t->step;
    *out = (out_surface_vertex){.x = (double)x, .y = (double)y, .z = (double)v->z};
    out->gradient[0] = slope_along(z, 1, x > 0, x + t->step < all->width);
    out->gradient[1] = slope_along(z, ROW, y > 0, y + t->step < all->height);
}

/* ---- Cutting where the lattice ends ---- */

static size_t slot_of(double x, double y)
{
    uint64_t bits[2];
    memcpy(&bits[0], &x, sizeof x);
    memcpy(&bits[1], &y, sizeof y);
    return (size_t)((bits[0] * UINT64_C(0x9e3779b97f4a7c15) ^ bits[1] * UINT64_C(0xc2b2ae3d27d4eb4f)) >> 40) % TABLE;
}

/* The number of the vertex; triangles beside each other share those of their common edge. */
static uint32_t add_cut(out_surface *s, const out_surface_vertex *v)
{
    size_t slot = slot_of(v->x, v->y);
    for (; s->table[slot] != UINT32_MAX; slot = (slot + 1) % TABLE) {
        const out_surface_vertex *there = &s->vertices[s->table[slot]];
        if (there->x == v->x && there->y == v->y)
            return s->table[slot];
    }
    s->vertices[s->vertex_count] = *v;
    return s->table[slot] = (uint32_t)s->vertex_count++;
}

/* Where the edge crosses `end` along an axis; the same from both of its sides. */
static uint32_t cut_edge(out_surface *s, uint32_t a, uint32_t b, int axis, double end)
{
    const out_surface_vertex *p = &s->vertices[a], *q = &s->vertices[b];
    if (p->y > q->y || (p->y == q->y && p->x > q->x)) {
        const out_surface_vertex *swapped = p;
        p = q;
        q = swapped;
    }
    double from = axis ? p->y : p->x, to = axis ? q->y : q->x, f = (end - from) / (to - from);
    out_surface_vertex v = {
        .x = p->x + f * (q->x - p->x), .y = p->y + f * (q->y - p->y), .z = p->z + f * (q->z - p->z)};
    for (int k = 0; k < 2; k++)
        v.gradient[k] = p->gradient[k] + f * (q->gradient[k] - p->gradient[k]);
    *(axis ? &v.y : &v.x) = end;
    return add_cut(s, &v);
}

/* What of a polygon lies up to `end` along an axis; its corners [Sutherland and Hodgman 1974]. */
static int cut_polygon(out_surface *s, const uint32_t *in, int count, int axis, double end, uint32_t *out)
{
    int made = 0;
    for (int k = 0; k < count; k++) {
        uint32_t a = in[k], b = in[(k + 1) % count];
        double at_a = axis ? s->vertices[a].y : s->vertices[a].x, at_b = axis ? s->vertices[b].y : s->vertices[b].x;
        if (at_a <= end)
            out[made++] = a;
        if ((at_a < end && at_b > end) || (at_a > end && at_b < end))
            out[made++] = cut_edge(s, a, b, axis, end);
    }
    return made;
}

static bool has_area(const out_surface *s, const uint32_t c[3])
{
    const out_surface_vertex *a = &s->vertices[c[0]], *b = &s->vertices[c[1]], *d = &s->vertices[c[2]];
    return (b->x - a->x) * (d->y - a->y) - (b->y - a->y) * (d->x - a->x) > 0;
}

static void cut_triangle(out_surface *s, const uint32_t corner[3], const tl_window *all)
{
    uint32_t once[CORNERS + 1], twice[CORNERS + 2];
    int count = cut_polygon(s, corner, 3, 0, (double)(all->width - 1), once);
    count = cut_polygon(s, once, count, 1, (double)(all->height - 1), twice);
    for (int k = 2; k < count; k++) {
        const uint32_t part[3] = {twice[0], twice[k - 1], twice[k]};
        if (!has_area(s, part))
            continue;
        memcpy(s->indices + s->index_count, part, sizeof part);
        s->index_count += 3;
    }
}

/* Drops vertices that no triangle has any more. */
static void drop_unused(out_surface *s, uint32_t *numbers)
{
    size_t kept = 0;
    for (size_t k = 0; k < s->vertex_count; k++)
        numbers[k] = 0;
    for (size_t k = 0; k < s->index_count; k++)
        numbers[s->indices[k]] = 1;
    for (size_t k = 0; k < s->vertex_count; k++)
        if (numbers[k]) {
            s->vertices[kept] = s->vertices[k];
            numbers[k] = (uint32_t)kept++;
        }
    for (size_t k = 0; k < s->index_count; k++)
        s->indices[k] = numbers[s->indices[k]];
    s->vertex_count = kept;
}

static tl_status take_ground(out_surface *s, const out_glb_tile *t, tl_error *error)
{
    const scene_tile_mesh *mesh = t->drawn->mesh;
    const tl_window all = scene_own_lattice_window(s->lattice);
    bool whole = t->x + mesh->cells * t->step < all.width && t->y + mesh->cells * t->step < all.height;
    s->vertex_count = mesh->vertex_count;
    s->index_count = 0;
    for (size_t k = 0; k < mesh->vertex_count; k++)
        take_vertex(t, &all, &mesh->vertices[k], &s->vertices[k]);
    if (whole) {
        s->index_count = 3 * mesh->triangle_count;
        memcpy(s->indices, mesh->indices, s->index_count * sizeof *s->indices);
        return TL_OK;
    }
    uint32_t *numbers = tl_alloc(s->vertex_room, sizeof *numbers);
    if (!numbers)
        return tl_fail_memory(error, "a tile");
    memset(s->table, 0xff, TABLE * sizeof *s->table);
    for (size_t k = 0; k < mesh->triangle_count; k++)
        cut_triangle(s, mesh->indices + 3 * k, &all);
    drop_unused(s, numbers);
    free(numbers);
    return TL_OK;
}

/* ---- Places ---- */

/* Directions of a tile's columns and rows, in metres for a cell of the finest lattice, at NODES x NODES places that
 * neighbours share along their edges. */
typedef struct directions {
    double at[NODES][NODES][2][3];
} directions;

static double within(double value, double low, double high)
{
    return value < low ? low : value > high ? high : value;
}

static void find_direction(out_surface *s, double x, double y, int axis, double reach, double out[3])
{
    const tl_window all = scene_own_lattice_window(s->lattice);
    const double last[2] = {(double)(all.width - 1), (double)(all.height - 1)};
    double px[2] = {within(x, 0, last[0]), within(x, 0, last[0])};
    double py[2] = {within(y, 0, last[1]), within(y, 0, last[1])}, *moved = axis ? py : px;
    double longitude[2], latitude[2], at[2][3];
    moved[0] = within(moved[0] - reach, 0, last[axis]);
    moved[1] = within(moved[1] + reach, 0, last[axis]);
    scene_placer_lonlat(s->placer, 2, px, py, longitude, latitude);
    for (int k = 0; k < 2; k++)
        scene_to_ecef(longitude[k], latitude[k], 0, at[k]);
    for (int a = 0; a < 3; a++)
        out[a] = (at[1][a] - at[0][a]) / (moved[1] - moved[0]);
}

static void find_directions(out_surface *s, const out_glb_tile *t, directions *d)
{
    double between = (double)t->step * t->drawn->mesh->cells / (NODES - 1);
    for (int j = 0; j < NODES; j++)
        for (int i = 0; i < NODES; i++)
            for (int axis = 0; axis < 2; axis++)
                find_direction(s, (double)t->x + i * between, (double)t->y + j * between, axis, 0.5 * between,
                               d->at[j][i][axis]);
}

static void mix_direction(const directions *d, double u, double v, int axis, double out[3])
{
    int i = u < NODES - 1 ? (int)u : NODES - 2, j = v < NODES - 1 ? (int)v : NODES - 2;
    double a = u - i, b = v - j;
    for (int k = 0; k < 3; k++)
        out[k] = (1 - b) * ((1 - a) * d->at[j][i][axis][k] + a * d->at[j][i + 1][axis][k]) +
                 b * ((1 - a) * d->at[j + 1][i][axis][k] + a * d->at[j + 1][i + 1][axis][k]);
}

static void find_normal(const out_glb_tile *t, const directions *d, const double up[3], out_surface_vertex *v)
{
    double side = (double)t->step * t->drawn->mesh->cells / (NODES - 1), along[2][3], n[3];
    for (int axis = 0; axis < 2; axis++) {
        mix_direction(d, (v->x - (double)t->x) / side, (v->y - (double)t->y) / side, axis, along[axis]);
        for (int a = 0; a < 3; a++)
            along[axis][a] = along[axis][a] * (double)t->step + v->gradient[axis] * up[a];
    }
    for (int a = 0; a < 3; a++)
        n[a] = along[0][(a + 1) % 3] * along[1][(a + 2) % 3] - along[0][(a + 2) % 3] * along[1][(a + 1) % 3];
    double length = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    for (int a = 0; a < 3; a++) /* at a pole, where meridians end, they have no direction */
        v->normal[a] = (float)(length > 0 && isfinite(length) ? n[a] / length : up[a]);
}

/* A picture has the normals, in the axes of columns, rows and the vertical. */
static void find_tangent(const out_glb_tile *t, const directions *d, const double up[3], out_surface_vertex *v)
{
    double side = (double)t->step * t->drawn->mesh->cells / (NODES - 1), along[3], upright = 0, length = 0;
    mix_direction(d, (v->x - (double)t->x) / side, (v->y - (double)t->y) / side, 0, along);
    for (int a = 0; a < 3; a++)
        upright += along[a] * up[a];
    for (int a = 0; a < 3; a++) {
        along[a] -= upright * up[a];
        length += along[a] * along[a];
    }
    const double any[3] = {-up[1], up[0], 0}; /* at a pole */
    for (int a = 0; a < 3; a++) {
        v->normal[a] = (float)up[a];
        v->tangent[a] = (float)(length > 0 ? along[a] / sqrt(length) : any[a]);
    }
}

static tl_status place_ground(out_surface *s, const out_glb_tile *t, tl_error *error)
{
    directions d;
    find_directions(s, t, &d);
    for (size_t k = 0; k < s->vertex_count; k++) {
        out_surface_vertex *v = &s->vertices[k];
        double up[3];
        scene_placer_lonlat(s->placer, 1, &v->x, &v->y, &v->longitude, &v->latitude);
        if (!isfinite(v->longitude) || !isfinite(v->latitude))
            return tl_fail(
                error, TL_ERROR_DATA,
                "a sample of the source lies nowhere on the globe: beyond the edge of its map; cut it off by "
                "--bbox");
        scene_to_ecef(v->longitude, v->latitude, v->z, v->at);
        scene_up(v->longitude, v->latitude, up);
        find_normal(t, &d, up, v);
        if (t->pictures && t->pictures->bytes[1])
            find_tangent(t, &d, up, v);
    }
    return TL_OK;
}

/* ---- Skirts ---- */

/* Whether the edge lies on a side of the tile behind which there is a neighbour. Where columns go around, that is so at
 * the first and the last, too: of coarse lattices, the last may lie between vertices, and its heights be others. */
static bool is_border(const out_surface *s, const out_glb_tile *t, const out_surface_vertex *a,
                      const out_surface_vertex *b)
{
    const tl_window all = scene_own_lattice_window(s->lattice);
    double side = (double)t->step * t->drawn->mesh->cells;
    const double first[2] = {(double)t->x, (double)t->y};
    const double last[2] = {(double)(all.width - 1), (double)(all.height - 1)};
    if (scene_own_lattice_goes_around(s->lattice) && a->x == b->x && (a->x == 0 || a->x == last[0]))
        return true;
    for (int axis = 0; axis < 2; axis++) {
        double p = axis ? a->y : a->x, q = axis ? b->y : b->x;
        if (p == q && ((p == first[axis] && p > 0) || (p == first[axis] + side && p < last[axis])))
            return true;
    }
    return false;
}

static uint32_t lower_vertex(out_surface *s, uint32_t above, double depth, uint32_t *lower)
{
    if (lower[above] == UINT32_MAX) {
        out_surface_vertex *v = &s->vertices[s->vertex_count];
        *v = s->vertices[above];
        v->z -= depth;
        scene_to_ecef(v->longitude, v->latitude, v->z, v->at);
        lower[above] = (uint32_t)s->vertex_count++;
    }
    return lower[above];
}

static tl_status add_skirts(out_surface *s, const out_glb_tile *t, tl_error *error)
{
    uint32_t *lower = tl_alloc(s->vertex_count, sizeof *lower);
    s->ground_count = s->index_count;
    if (!lower)
        return tl_fail_memory(error, "a tile");
    memset(lower, 0xff, s->vertex_count * sizeof *lower);
    for (size_t k = 0; k < s->ground_count && t->skirt > 0; k++) {
        uint32_t a = s->indices[k], b = s->indices[k % 3 == 2 ? k - 2 : k + 1];
        if (!is_border(s, t, &s->vertices[a], &s->vertices[b]))
            continue;
        uint32_t c = lower_vertex(s, a, t->skirt, lower), d = lower_vertex(s, b, t->skirt, lower);
        const uint32_t wall[6] = {c, d, b, c, b, a}; /* seen from outside */
        memcpy(s->indices + s->index_count, wall, sizeof wall);
        s->index_count += 6;
    }
    free(lower);
    return TL_OK;
}

/* ---- The region ---- */

static void widen(double region[6], int low, int high, double from, double to)
{
    region[low] = fmin(region[low], from);
    region[high] = fmax(region[high], to);
}

/* A flat triangle reaches over the parallels of its corners towards the pole: where they span an angle w around the
 * axis, the tangent of the latitude grows by 1 / cos(w / 2) at most; twice that is taken, as the ellipsoid's latitudes
 * are not the sphere's. From a quarter of a turn on, it may reach the pole. Upright it sags below its corners by
 * (2 r)^2 / 8 R, with r <= side / sqrt 3 the radius of a circle around it. */
static void contain_triangle(const out_surface_vertex *const v[3], double region[6])
{
    double box[6] = {HUGE_VAL, HUGE_VAL, -HUGE_VAL, -HUGE_VAL, HUGE_VAL, -HUGE_VAL}, longest = 0;
    for (int k = 0; k < 3; k++) {
        const double *p = v[k]->at, *q = v[(k + 1) % 3]->at;
        widen(box, 0, 2, v[k]->longitude, v[k]->longitude);
        widen(box, 1, 3, v[k]->latitude, v[k]->latitude);
        widen(box, 4, 5, v[k]->z, v[k]->z);
        longest = fmax(longest,
                       (p[0] - q[0]) * (p[0] - q[0]) + (p[1] - q[1]) * (p[1] - q[1]) + (p[2] - q[2]) * (p[2] - q[2]));
    }
    double width = box[2] - box[0], bulge = width < 0.5 * pi ? width * width / 8 : pi;
    widen(box, 1, 3, box[1] < 0 ? box[1] - bulge : box[1], box[3] > 0 ? box[3] + bulge : box[3]);
    if (width > pi) { /* around the back of the globe, or of a pole */
        double middle = 0.5 * (box[0] + box[2]);
        widen(box, 0, 2, middle - pi, middle + pi);
    }
    widen(region, 0, 2, box[0], box[2]);
    widen(region, 1, 3, fmax(box[1], -0.5 * pi), fmin(box[3], 0.5 * pi));
    widen(region, 4, 5, box[4] - longest / (6 * least_radius), box[5]);
}

static void find_region(const out_surface *s, double region[6])
{
    const double nothing[6] = {HUGE_VAL, HUGE_VAL, -HUGE_VAL, -HUGE_VAL, HUGE_VAL, -HUGE_VAL};
    memcpy(region, nothing, sizeof nothing);
    for (size_t k = 0; k < s->index_count; k += 3) {
        const out_surface_vertex *const corners[3] = {&s->vertices[s->indices[k]], &s->vertices[s->indices[k + 1]],
                                                      &s->vertices[s->indices[k + 2]]};
        contain_triangle(corners, region);
    }
}

void out_surface_widen(out_glb_facts *facts, double metres)
{
    double *r = facts->region, angle = metres / least_radius;
    double pole = fmin(fmin(0.5 * pi - r[3], 0.5 * pi + r[1]), 0.5 * pi); /* how near it comes to one */
    double across = pole > 2 * angle ? asin(fmin(1, angle / sin(pole - angle))) : pi;
    r[0] -= across;
    r[2] += across;
    r[1] = fmax(r[1] - angle, -0.5 * pi);
    r[3] = fmin(r[3] + angle, 0.5 * pi);
    r[4] -= metres;
    r[5] += metres;
}

/* ---- All ---- */

/* Metres up for a metre along, by how far the triangle's normal is turned from the vertical of a corner. */
static double slope_of(const out_surface *s, size_t k)
{
    const out_surface_vertex *v[3] = {&s->vertices[s->indices[k]], &s->vertices[s->indices[k + 1]],
                                      &s->vertices[s->indices[k + 2]]};
    double e[2][3], n[3], up[3], along = 0, whole = 0;
    for (int a = 0; a < 3; a++) {
        e[0][a] = v[1]->at[a] - v[0]->at[a];
        e[1][a] = v[2]->at[a] - v[0]->at[a];
    }
    scene_up(v[0]->longitude, v[0]->latitude, up);
    for (int a = 0; a < 3; a++) {
        n[a] = e[0][(a + 1) % 3] * e[1][(a + 2) % 3] - e[0][(a + 2) % 3] * e[1][(a + 1) % 3];
        along += n[a] * up[a];
        whole += n[a] * n[a];
    }
    return along > 0 ? sqrt(fmax(whole / (along * along) - 1, 0)) : 0;
}

tl_status out_surface_build(out_surface *s, const out_glb_tile *t, out_glb_facts *facts, tl_error *error)
{
    *facts = (out_glb_facts){.steepest = 0};
    tl_status status = take_ground(s, t, error);
    if (status == TL_OK)
        status = place_ground(s, t, error);
    if (status == TL_OK)
        status = add_skirts(s, t, error);
    if (status != TL_OK)
        return status;
    for (size_t k = 0; k < s->ground_count; k += 3)
        facts->steepest = fmax(facts->steepest, slope_of(s, k));
    find_region(s, facts->region);
    facts->triangles = s->ground_count / 3;
    facts->vertices = s->vertex_count;
    return TL_OK;
}
