#include "dem/tin.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>

enum {
    MAX_STAR = 64, /* neighbours of a vertex that is tried */
    LANES = 8,     /* samples that are compared together, as two quads */
    SLACK = 4,     /* neighbours that a vertex may win before its list moves */
    MAX_SIDE = 1 << 10
};

static const uint32_t NONE = UINT32_MAX;

/* A vertex's neighbours, in the turn of its triangles; NONE stands behind the last of a fan that does not close. */
typedef struct ring {
    uint32_t first; /* in `pool` */
    uint32_t count, room;
} ring;

struct tl_tin_patch {
    int64_t side;
    uint32_t *local; /* by place in the window: number of the vertex there, or NONE */
    /* of vertices, which are numbered by rows */
    uint32_t *global;
    tl_vertex *vertices;
    ring *rings;
    bool *open, *gone, *tried; /* not to be collapsed; collapsed; tried since its star changed */
    size_t vertex_count, vertex_room;
    uint32_t *pool;
    size_t pool_used, pool_room;
    uint32_t (*links)[2]; /* of corners, by vertex: the next and the last corner of its triangle */
    size_t link_room;
    float *x, *y, *z; /* samples of a star, relative to its middle */
    double *inverse;  /* 1 / k */
    const tl_tin_ground *ground;
};

/* ---- Memory ---------------------------------------------------------------------------------------- */

tl_tin_patch *tl_tin_patch_create(int64_t side)
{
    tl_tin_patch *patch = calloc(1, sizeof *patch);
    if (!patch)
        return NULL;
    patch->side = side;
    size_t samples = (size_t)(side * side) + (size_t)(4 * side) + LANES;
    patch->local = tl_alloc_grid(side, side, sizeof *patch->local);
    patch->x = tl_alloc(samples, sizeof *patch->x);
    patch->y = tl_alloc(samples, sizeof *patch->y);
    patch->z = tl_alloc(samples, sizeof *patch->z);
    patch->inverse = tl_alloc((size_t)side, sizeof *patch->inverse);
    if (side <= MAX_SIDE && patch->local && patch->x && patch->y && patch->z && patch->inverse) {
        for (int64_t k = 0; k < side; k++)
            patch->inverse[k] = k ? 1 / (double)k : 0;
        return patch;
    }
    tl_tin_patch_destroy(patch);
    return NULL;
}

static void free_vertices(tl_tin_patch *patch)
{
    free(patch->global);
    free(patch->vertices);
    free(patch->rings);
    free(patch->open);
    free(patch->gone);
    free(patch->tried);
}

void tl_tin_patch_destroy(tl_tin_patch *patch)
{
    if (!patch)
        return;
    free_vertices(patch);
    free(patch->local);
    free(patch->pool);
    free(patch->links);
    free(patch->x);
    free(patch->y);
    free(patch->z);
    free(patch->inverse);
    free(patch);
}

static bool make_vertices(tl_tin_patch *patch, size_t count)
{
    if (count > patch->vertex_room) {
        free_vertices(patch);
        patch->vertex_room = count;
        patch->global = tl_alloc(count, sizeof *patch->global);
        patch->vertices = tl_alloc(count, sizeof *patch->vertices);
        patch->rings = tl_alloc(count, sizeof *patch->rings);
        patch->open = tl_alloc(count, sizeof *patch->open);
        patch->gone = tl_alloc(count, sizeof *patch->gone);
        patch->tried = tl_alloc(count, sizeof *patch->tried);
    }
    if (patch->global && patch->vertices && patch->rings && patch->open && patch->gone && patch->tried)
        return true;
    patch->vertex_room = 0;
    return false;
}

/* A fan that does not close has two places more than corners, and as many corners as fans at least; each may grow a
 * little, and some move. */
static bool make_pool(tl_tin_patch *patch, size_t corners)
{
    size_t need = 3 * corners + 2 * (SLACK + 1) * patch->vertex_count;
    if (need > patch->pool_room) {
        free(patch->pool);
        patch->pool = tl_alloc(need, sizeof *patch->pool);
        patch->pool_room = patch->pool ? need : 0;
    }
    if (corners > patch->link_room) {
        free(patch->links);
        patch->links = tl_alloc(corners, sizeof *patch->links);
        patch->link_room = patch->links ? corners : 0;
    }
    return patch->pool && patch->links;
}

/* ---- From triangles to rings ------------------------------------------------------------------------ */

static size_t number_vertices(tl_tin_patch *patch, const tl_vertex *vertices, tl_window window,
                              const uint32_t *triangles, size_t count)
{
    size_t next = 0, places = (size_t)(window.width * window.height);
    memset(patch->local, 0xff, places * sizeof *patch->local);
    for (size_t k = 0; k < 3 * count; k++) {
        const tl_vertex *v = &vertices[triangles[k]];
        uint32_t *at = &patch->local[(v->j - window.y) * window.width + v->i - window.x];
        next += *at == NONE;
        *at = triangles[k];
    }
    if (!make_vertices(patch, next))
        return 0;
    next = 0;
    for (size_t k = 0; k < places; k++)
        if (patch->local[k] != NONE) {
            patch->global[next] = patch->local[k];
            patch->vertices[next] = vertices[patch->local[k]];
            patch->local[k] = (uint32_t)next++;
        }
    return next;
}

/* Sorts corners by vertex: those of vertex k end up in links[rings[k].first] and on. */
static void sort_corners(tl_tin_patch *patch, const uint32_t *triangles, size_t count)
{
    memset(patch->rings, 0, patch->vertex_count * sizeof *patch->rings);
    for (size_t k = 0; k < 3 * count; k++)
        patch->rings[triangles[k]].count++;
    uint32_t sum = 0;
    for (size_t k = 0; k < patch->vertex_count; k++) {
        patch->rings[k].first = sum;
        sum += patch->rings[k].count;
        patch->rings[k].count = 0;
    }
    for (size_t t = 0; t < count; t++)
        for (int k = 0; k < 3; k++) {
            const uint32_t *corner = triangles + 3 * t;
            ring *of = &patch->rings[corner[k]];
            uint32_t *link = patch->links[of->first + of->count++];
            link[0] = corner[(k + 1) % 3];
            link[1] = corner[(k + 2) % 3];
        }
}

/* The link among `count` that begins (side 0) or ends (side 1) with a vertex; `count` where there is none. */
static uint32_t find_link(uint32_t (*links)[2], uint32_t count, int side, uint32_t vertex)
{
    uint32_t k = 0;
    while (k < count && links[k][side] != vertex)
        k++;
    return k;
}

static void swap_links(uint32_t (*links)[2], uint32_t a, uint32_t b)
{
    for (int side = 0; side < 2; side++) {
        uint32_t swap = links[a][side];
        links[a][side] = links[b][side];
        links[b][side] = swap;
    }
}

/* Chains the links of a vertex to its ring; true where that closes. */
static bool chain_links(uint32_t (*links)[2], uint32_t count, uint32_t *out, uint32_t *length)
{
    bool closed = true;
    uint32_t n = 0, start = 0;
    for (uint32_t done = 0; done < count; done++) {
        if (done == start) { /* a fan begins: where nothing leads to, if there is such a place */
            uint32_t first = done;
            while (first < count && find_link(links + done, count - done, 1, links[first][0]) < count - done)
                first++;
            swap_links(links, done, first < count ? first : done);
            closed = closed && first == count && done == 0;
        }
        out[n++] = links[done][0];
        uint32_t next = done + 1 + find_link(links + done + 1, count - done - 1, 0, links[done][1]);
        if (next < count) {
            swap_links(links, done + 1, next);
        } else if (links[done][1] != links[start][0]) {
            out[n++] = links[done][1];
            out[n++] = NONE;
            closed = false;
            start = done + 1;
        } else {
            closed = closed && start == 0 && done + 1 == count;
            start = done + 1;
        }
    }
    *length = n;
    return closed;
}

static void make_rings(tl_tin_patch *patch)
{
    patch->pool_used = 0;
    for (size_t k = 0; k < patch->vertex_count; k++) {
        ring *of = &patch->rings[k];
        uint32_t corners = of->count, first = of->first, length;
        bool closed = chain_links(patch->links + first, corners, patch->pool + patch->pool_used, &length);
        patch->open[k] = !closed;
        *of = (ring){(uint32_t)patch->pool_used, length, length + SLACK};
        patch->pool_used += of->room;
    }
}

static tl_status load(tl_tin_patch *patch, const tl_vertex *vertices, tl_window window, uint32_t *triangles,
                      size_t count, tl_error *error)
{
    patch->vertex_count = number_vertices(patch, vertices, window, triangles, count);
    if (!patch->vertex_count || !make_pool(patch, 3 * count))
        return tl_fail_memory(error, "the mesh");
    for (size_t k = 0; k < 3 * count; k++) {
        const tl_vertex *v = &vertices[triangles[k]];
        triangles[k] = patch->local[(v->j - window.y) * window.width + v->i - window.x];
    }
    sort_corners(patch, triangles, count);
    make_rings(patch);
    return TL_OK;
}

/* The triangles of the rings: each by its lowest corner. */
static size_t store(const tl_tin_patch *patch, uint32_t *triangles)
{
    size_t count = 0;
    for (uint32_t v = 0; v < patch->vertex_count; v++) {
        const ring *of = &patch->rings[v];
        const uint32_t *around = patch->pool + of->first;
        for (uint32_t k = 0; !patch->gone[v] && k < of->count; k++) {
            uint32_t a = around[k], b = around[k + 1 == of->count ? 0 : k + 1];
            if (a == NONE || b == NONE || a < v || b < v)
                continue;
            uint32_t *to = triangles + 3 * count++;
            to[0] = patch->global[v], to[1] = patch->global[a], to[2] = patch->global[b];
        }
    }
    return count;
}

/* ---- The star of a vertex ---------------------------------------------------------------------------- */

typedef struct star {
    int n, x[MAX_STAR], y[MAX_STAR]; /* neighbours, from the middle */
    float z[MAX_STAR];               /* likewise */
    float height[MAX_STAR];          /* as they are */
    int i, j;
    float middle; /* the middle's height */
} star;

static void look_around(const tl_tin_patch *patch, uint32_t u, star *out)
{
    const ring *of = &patch->rings[u];
    const tl_vertex *middle = &patch->vertices[u];
    out->n = (int)of->count;
    out->i = middle->i, out->j = middle->j, out->middle = middle->z;
    for (int k = 0; k < out->n; k++) {
        const tl_vertex *v = &patch->vertices[patch->pool[of->first + (uint32_t)k]];
        out->x[k] = v->i - middle->i;
        out->y[k] = v->j - middle->j;
        out->height[k] = v->z;
        out->z[k] = v->z - middle->z;
    }
}

static inline int after(const star *s, int k)
{
    return k + 1 == s->n ? 0 : k + 1;
}

/* floor for values that fit an int */
static inline int floor_int(double a)
{
    int i = (int)a;
    return i - (a < i);
}

/* Columns where row y crosses the star's rim: strictly right of a crossing begins at low, strictly left of it ends at
 * high. Edges hold their upper end, not their lower one, so their number is even. With n and d integers, (n + 1/2) / d
 * is far enough from any integer for its floor not to depend on rounding. */
static int find_crossings(const tl_tin_patch *patch, const star *s, int y, int low[MAX_STAR], int high[MAX_STAR])
{
    int count = 0;
    for (int k = 0; k < s->n; k++) {
        int q = after(s, k), top = k, bottom = q;
        if ((s->y[k] <= y) == (s->y[q] <= y))
            continue;
        if (s->y[k] > s->y[q])
            top = q, bottom = k;
        double inverse = patch->inverse[s->y[bottom] - s->y[top]];
        int rise = (y - s->y[top]) * (s->x[bottom] - s->x[top]);
        int at = count++, from = s->x[top] + floor_int((rise + 0.5) * inverse) + 1;
        int to = s->x[top] + floor_int((rise - 0.5) * inverse);
        for (; at && low[at - 1] + high[at - 1] > from + to; at--) /* in order of columns */
            low[at] = low[at - 1], high[at] = high[at - 1];
        low[at] = from, high[at] = to;
    }
    return count;
}

static int add_row(const tl_tin_patch *patch, const star *s, int y, int x, int end, int count)
{
    const float *row = patch->ground->heights + (s->j + y) * patch->ground->width + s->i;
    for (; x <= end; x++, count++) {
        patch->x[count] = (float)x;
        patch->y[count] = (float)y;
        patch->z[count] = row[x] - s->middle;
    }
    return count;
}

static int divisor(int a, int b)
{
    while (b) {
        int rest = a % b;
        a = b, b = rest;
    }
    return a;
}

/* The samples on the star's rim, which count where limits differ by triangle. */
static int add_rim(const tl_tin_patch *patch, const star *s, int count)
{
    for (int k = 0; k < s->n; k++) {
        int q = after(s, k), dx = s->x[q] - s->x[k], dy = s->y[q] - s->y[k], parts = divisor(abs(dx), abs(dy));
        for (int p = 1; p < parts; p++) {
            int x = s->x[k] + dx / parts * p, y = s->y[k] + dy / parts * p;
            count = add_row(patch, s, y, x, x, count);
        }
    }
    return count;
}

/* All samples strictly inside of the star, the middle first; their number rounded up to LANES. */
static int gather(const tl_tin_patch *patch, const star *s)
{
    int low = 0, high = 0, count = add_row(patch, s, 0, 0, 0, 0);
    for (int k = 0; k < s->n; k++) {
        low = s->y[k] < low ? s->y[k] : low;
        high = s->y[k] > high ? s->y[k] : high;
    }
    for (int y = low + 1; y < high; y++) {
        int from[MAX_STAR], to[MAX_STAR], crossings = find_crossings(patch, s, y, from, to);
        for (int k = 0; k + 1 < crossings; k += 2)
            count = add_row(patch, s, y, from[k], to[k + 1], count);
    }
    if (patch->ground->shaped)
        count = add_rim(patch, s, count);
    while (count % LANES)
        count = add_row(patch, s, 0, 0, 0, count);
    return count;
}

/* ---- Fans ---------------------------------------------------------------------------------------------- */

/* The triangles that would take a star's place, from its neighbour `apex`; triangle k lies between rays k and k + 1. */
typedef struct fan {
    int apex, count;
    float x[MAX_STAR], y[MAX_STAR];                       /* rays, from the apex */
    float across[MAX_STAR], down[MAX_STAR], at[MAX_STAR]; /* plane: across x + down y + at, from the star's middle */
    float sure[MAX_STAR]; /* errors up to here, by float arithmetic, are certainly within the limit */
    double limit[MAX_STAR];
} fan;

/* Twice the area of the triangle with corners (0, 0), a, b. */
static inline int cross(int ax, int ay, int bx, int by)
{
    return ax * by - ay * bx;
}

/* Whether all triangles from neighbour `apex` have an area, and the middle is, but for rounding, within max_error. */
static bool fan_may_do(const star *s, int apex, double max_error)
{
    int vx = s->x[apex], vy = s->y[apex], k = after(s, apex);
    int ax = s->x[k] - vx, ay = s->y[k] - vy, left = cross(ax, ay, -vx, -vy);
    float from = s->z[k] - s->z[apex];
    for (int i = 0; i < s->n - 2; i++) {
        k = after(s, k);
        int bx = s->x[k] - vx, by = s->y[k] - vy, area = cross(ax, ay, bx, by), right = cross(bx, by, -vx, -vy);
        float to = s->z[k] - s->z[apex];
        if (area <= 0)
            return false;
        if (left >= 0 && right <= 0) {
            double rise = (double)left * (double)to - (double)right * (double)from;
            double scale = fabs((double)s->z[apex]) + fabs((double)to) + fabs((double)from);
            if (fabs((double)s->z[apex] + rise / area) > max_error + 1e-6 * scale)
                return false;
        }
        ax = bx, ay = by, left = right, from = to;
    }
    return true;
}

static inline double largest(double a, double b)
{
    return a > b ? a : b;
}

/* The error that triangle k of a fan may have by its class; negative: the triangle may not be. */
static double class_limit(const tl_tin_ground *ground, const fan *f, int k)
{
    double ax = (double)f->x[k], ay = (double)f->y[k], bx = (double)f->x[k + 1], by = (double)f->y[k + 1];
    double length2 = largest(ax * ax + ay * ay, bx * bx + by * by);
    length2 = largest(length2, (bx - ax) * (bx - ax) + (by - ay) * (by - ay));
    int class = tl_tin_class((int64_t)length2);
    double across = (double)f->across[k], down = (double)f->down[k], rise = ground->rise[class];
    return across * across + down * down <= rise * rise ? ground->limit[class] : -1;
}

/* What float arithmetic may be wrong by at the samples of a triangle: less than eight roundings of 2^-24 of the sum of
 * what its terms may be, `reach` cells from the apex. */
static float float_margin(const fan *f, int k, float az, float bz, float area, float reach, float base)
{
    float across = (fabsf(az * f->y[k + 1]) + fabsf(bz * f->y[k])) / area;
    float down = (fabsf(bz * f->x[k]) + fabsf(az * f->x[k + 1])) / area;
    return 0x1p-21F * (2 * reach * (across + down) + base);
}

static bool make_fan(const tl_tin_patch *patch, const star *s, int apex, float reach, fan *f)
{
    const tl_tin_ground *ground = patch->ground;
    float z[MAX_STAR], vx = (float)s->x[apex], vy = (float)s->y[apex], highest = 0;
    f->apex = apex;
    f->count = s->n - 2;
    for (int i = 0, k = apex; i <= f->count; i++) {
        k = after(s, k);
        f->x[i] = (float)s->x[k] - vx;
        f->y[i] = (float)s->y[k] - vy;
        z[i] = s->z[k] - s->z[apex];
        highest = fabsf(s->z[k]) > highest ? fabsf(s->z[k]) : highest;
    }
    float base = fabsf(s->z[apex]) + highest + (float)ground->max_error;
    for (int k = 0; k < f->count; k++) {
        float area = f->x[k] * f->y[k + 1] - f->y[k] * f->x[k + 1];
        f->across[k] = (z[k] * f->y[k + 1] - z[k + 1] * f->y[k]) / area;
        f->down[k] = (z[k + 1] * f->x[k] - z[k] * f->x[k + 1]) / area;
        f->at[k] = s->z[apex] - f->across[k] * vx - f->down[k] * vy;
        f->limit[k] = ground->shaped ? class_limit(ground, f, k) : ground->max_error;
        if (!(f->limit[k] >= 0))
            return false;
        f->sure[k] = (float)f->limit[k] - float_margin(f, k, z[k], z[k + 1], area, reach, base);
    }
    return true;
}

/* The same comparison as tl_mesh_verify's: exact where heights are. */
static bool sample_is_near(const tl_tin_patch *patch, const star *s, const fan *f, int k, int x, int y)
{
    int b = (f->apex + 1 + k) % s->n, corners[3] = {f->apex, b, after(s, b)};
    int64_t weight[3], whole = 0;
    double sum = 0;
    for (int c = 0; c < 3; c++) {
        int p = corners[(c + 1) % 3], q = corners[(c + 2) % 3];
        weight[c] = cross(s->x[p] - x, s->y[p] - y, s->x[q] - x, s->y[q] - y);
        whole += weight[c];
        sum += (double)weight[c] * (double)s->height[corners[c]];
    }
    if (weight[0] < 0 || weight[1] < 0 || weight[2] < 0)
        return true; /* not in this triangle */
    double z = (double)patch->ground->heights[(s->j + y) * patch->ground->width + s->i + x];
    return fabs(sum / (double)whole - z) + patch->ground->rounding <= f->limit[k];
}

/* Four floats, and what comparing them gives: the compiler's own vectors, for it does not find them in loops as short
 * as these. */
typedef float quad __attribute__((vector_size(16)));
typedef int32_t quad_mask __attribute__((vector_size(16)));

static inline quad load_quad(const float *from)
{
    quad out;
    memcpy(&out, from, sizeof out);
    return out;
}

static inline quad quad_of(float a)
{
    return (quad){a, a, a, a};
}

/* Whether some of LANES samples may be beyond the limit. */
static bool lanes_are_unsure(const fan *f, float vx, float vy, const float *xs, const float *ys, const float *zs)
{
    const quad x[2] = {load_quad(xs), load_quad(xs + 4)}, y[2] = {load_quad(ys), load_quad(ys + 4)};
    const quad z[2] = {load_quad(zs), load_quad(zs + 4)}, none = quad_of(0);
    quad before[2];
    quad_mask unsure = {0};
    for (int l = 0; l < 2; l++)
        before[l] = quad_of(f->x[0]) * (y[l] - quad_of(vy)) - quad_of(f->y[0]) * (x[l] - quad_of(vx));
    for (int k = 0; k < f->count; k++) {
        const quad bx = quad_of(f->x[k + 1]), by = quad_of(f->y[k + 1]), sure = quad_of(f->sure[k]);
        const quad across = quad_of(f->across[k]), down = quad_of(f->down[k]), at = quad_of(f->at[k]);
        for (int l = 0; l < 2; l++) {
            quad behind = bx * (y[l] - quad_of(vy)) - by * (x[l] - quad_of(vx));
            quad error = across * x[l] + down * y[l] + at - z[l];
            /* within only if both hold: neither does for what is not a number */
            unsure |= (before[l] >= none) & (behind <= none) & ~((error <= sure) & (-error <= sure));
            before[l] = behind;
        }
    }
    return unsure[0] | unsure[1] | unsure[2] | unsure[3];
}

/* Whether every one of `count` samples is within the limit of its triangle. */
static bool fan_does(const tl_tin_patch *patch, const star *s, const fan *f, int count)
{
    float vx = (float)s->x[f->apex], vy = (float)s->y[f->apex];
    for (int from = 0; from < count; from += LANES) {
        if (!lanes_are_unsure(f, vx, vy, patch->x + from, patch->y + from, patch->z + from))
            continue;
        for (int l = from; l < from + LANES; l++)
            for (int k = 0; k < f->count; k++)
                if (!sample_is_near(patch, s, f, k, (int)patch->x[l], (int)patch->y[l]))
                    return false;
    }
    return true;
}

static inline float larger(float a, float b)
{
    return a > b ? a : b;
}

/* The neighbour that the middle of a star can be moved onto, or -1. */
static int choose(const tl_tin_patch *patch, const star *s)
{
    int samples = 0;
    float reach = 0;
    for (int k = 0; k < s->n; k++) {
        fan f;
        if (!fan_may_do(s, k, patch->ground->max_error))
            continue;
        for (int i = 0; !samples && i < s->n; i++)
            reach = larger(reach, larger(fabsf((float)s->x[i]), fabsf((float)s->y[i])));
        if (!make_fan(patch, s, k, reach, &f))
            continue;
        samples = samples ? samples : gather(patch, s);
        if (fan_does(patch, s, &f, samples))
            return k;
    }
    return -1;
}

/* ---- Collapsing ---------------------------------------------------------------------------------------- */

static uint32_t *find_neighbour(const tl_tin_patch *patch, uint32_t of, uint32_t neighbour)
{
    uint32_t *at = patch->pool + patch->rings[of].first;
    while (*at != neighbour)
        at++;
    return at;
}

static void remove_neighbour(tl_tin_patch *patch, uint32_t of, uint32_t neighbour)
{
    uint32_t *at = find_neighbour(patch, of, neighbour);
    uint32_t *end = patch->pool + patch->rings[of].first + --patch->rings[of].count;
    memmove(at, at + 1, (size_t)(end - at) * sizeof *at);
}

/* Makes a ring ready for `more` neighbours; false where there is no room left. */
static bool make_room(tl_tin_patch *patch, uint32_t of, uint32_t more)
{
    ring *self = &patch->rings[of];
    uint32_t need = self->count + more;
    if (need <= self->room)
        return true;
    if (patch->pool_used + 2 * (size_t)need > patch->pool_room)
        return false;
    memcpy(patch->pool + patch->pool_used, patch->pool + self->first, self->count * sizeof *patch->pool);
    *self = (ring){(uint32_t)patch->pool_used, self->count, 2 * need};
    patch->pool_used += 2 * (size_t)need;
    return true;
}

/* Moves u onto its neighbour number `onto`. False where there is no room. */
static bool collapse(tl_tin_patch *patch, uint32_t u, int onto)
{
    uint32_t chain[MAX_STAR], n = patch->rings[u].count, v = patch->pool[patch->rings[u].first + (uint32_t)onto];
    if (!make_room(patch, v, n - 3))
        return false;
    for (uint32_t k = 0; k + 1 < n; k++) /* the other neighbours, from the one behind v */
        chain[k] = patch->pool[patch->rings[u].first + ((uint32_t)onto + 1 + k) % n];
    remove_neighbour(patch, chain[0], u);
    remove_neighbour(patch, chain[n - 2], u);
    for (uint32_t k = 1; k + 2 < n; k++)
        *find_neighbour(patch, chain[k], u) = v;
    uint32_t *at = find_neighbour(patch, v, u), *end = patch->pool + patch->rings[v].first + patch->rings[v].count;
    memmove(at + n - 3, at + 1, (size_t)(end - at - 1) * sizeof *at);
    memcpy(at, chain + 1, (n - 3) * sizeof *at); /* in the ring of v they take the place of u */
    patch->rings[v].count += n - 4;
    patch->gone[u] = true;
    patch->tried[v] = false;
    for (uint32_t k = 0; k + 1 < n; k++)
        patch->tried[chain[k]] = false;
    return true;
}

/* One walk over the vertices; the number that it took away. */
static size_t sweep(tl_tin_patch *patch)
{
    size_t gone = 0;
    star s;
    for (uint32_t u = 0; u < patch->vertex_count; u++) {
        if (patch->open[u] || patch->gone[u] || patch->tried[u])
            continue;
        patch->tried[u] = true;
        if (patch->rings[u].count > MAX_STAR)
            continue;
        look_around(patch, u, &s);
        int onto = choose(patch, &s);
        gone += onto >= 0 && collapse(patch, u, onto);
    }
    return gone;
}

tl_status tl_tin_patch_run(tl_tin_patch *patch, const tl_tin_ground *ground, const tl_vertex *vertices,
                           tl_tin_mark *settled, tl_window window, uint32_t *triangles, size_t *count, tl_error *error)
{
    if (!*count)
        return TL_OK;
    patch->ground = ground;
    tl_status status = load(patch, vertices, window, triangles, *count, error);
    if (status != TL_OK)
        return status;
    for (size_t k = 0; k < patch->vertex_count; k++) {
        patch->gone[k] = false;
        patch->tried[k] = atomic_load_explicit(&settled[patch->global[k]], memory_order_relaxed);
    }
    while (sweep(patch))
        ;
    /* a vertex of the window's rim is tried again where another window has it inside */
    for (size_t k = 0; k < patch->vertex_count; k++)
        if (!patch->open[k] || !patch->tried[k])
            atomic_store_explicit(&settled[patch->global[k]], !patch->open[k] && patch->tried[k], memory_order_relaxed);
    *count = store(patch, triangles);
    return TL_OK;
}
