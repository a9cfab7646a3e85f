/* Squares of two triangles, cut along the lower of their diagonals.
 *
 * In a mesh by longest-edge bisection, two triangles that share their hypotenuse make a square, upright or on a corner,
 * and which way it is cut follows from its place alone. Hu and Wang cut a node along its lower diagonal instead (the
 * one whose ends are lower in the mean), so that the surface sinks rather than rises where four corners do not lie in a
 * plane. Nothing else changes: the sides stay, so neighbours join as before. A square is only turned where every sample
 * in it keeps the bound. */
#include "dem/bend.h"
#include "dem/framework.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdatomic.h>

enum { CHUNK = 4096, BAND = 1 << 16 };

static const uint32_t NONE = UINT32_MAX;

typedef struct counts {
    uint64_t squares, lower, turned, held, samples;
    double before, after; /* sums of square errors */
} counts;

typedef struct turner {
    tl_mesh *mesh;
    const tl_source *dem;
    const tl_diagonal_options *options;
    uint32_t *partners; /* by triangle: the one beyond its hypotenuse, or NONE */
    dem_bend bend;
    bool bends;
    double rises[TL_SIZES]; /* the largest of the mesh's triangles by their size, units of height in a cell */
    double rounding;
    counts *found; /* by chunk, so that sums do not depend on threads */
} turner;

/* A square: corner a and b at the ends of the diagonal that it has, c and d at those of the other; a, d, b, c lie
 * counter-clockwise as the triangles do. */
typedef struct square {
    uint32_t a, b, c, d;
    int64_t x, y;           /* of corner a */
    int64_t ux, uy, vx, vy; /* the sides from a to c, and to d */
    double za, zb, zc, zd;
    int size;     /* as of its triangles: tl_size_of */
    double limit; /* of the error of the other two triangles; below 0 there must be none */
} square;

static int64_t length2(const tl_vertex *p, const tl_vertex *q)
{
    int64_t x = (int64_t)q->i - p->i, y = (int64_t)q->j - p->j;
    return x * x + y * y;
}

/* The corners of a triangle, its right angle last; false where it is no half of a square. */
static bool corners_of(const tl_mesh *mesh, size_t triangle, uint32_t out[3])
{
    const uint32_t *at = mesh->indices + 3 * triangle;
    for (int k = 0; k < 3; k++) {
        uint32_t apex = at[k], a = at[(k + 1) % 3], b = at[(k + 2) % 3];
        int64_t leg = length2(&mesh->vertices[apex], &mesh->vertices[a]);
        int64_t other = length2(&mesh->vertices[apex], &mesh->vertices[b]);
        if (leg == other && length2(&mesh->vertices[a], &mesh->vertices[b]) == 2 * leg && leg > 0) {
            out[0] = a, out[1] = b, out[2] = apex;
            return true;
        }
    }
    return false;
}

/* ---- Partners ---- */

static uint64_t middle_of(const tl_mesh *mesh, const uint32_t corners[3])
{
    const tl_vertex *a = &mesh->vertices[corners[0]], *b = &mesh->vertices[corners[1]];
    return (uint64_t)((int64_t)a->i + b->i) << 32 | (uint64_t)((int64_t)a->j + b->j);
}

/* Two halves of one square have the same middle of their hypotenuses. `table` holds triangles by that middle, in 2^log
 * places. */
static void find_partner(turner *self, uint32_t *table, int log, uint32_t triangle)
{
    uint32_t own[3], other[3];
    self->partners[triangle] = NONE;
    if (!corners_of(self->mesh, triangle, own))
        return;
    uint64_t key = middle_of(self->mesh, own), mask = (UINT64_C(1) << log) - 1;
    for (uint64_t at = key * UINT64_C(0x9e3779b97f4a7c15) >> (64 - log);; at = (at + 1) & mask) {
        if (table[at] == NONE) {
            table[at] = triangle;
            return;
        }
        corners_of(self->mesh, table[at], other);
        if (middle_of(self->mesh, other) != key)
            continue;
        if (other[0] == own[1] && other[1] == own[0]) {
            self->partners[table[at]] = triangle;
            self->partners[triangle] = table[at];
        }
        return;
    }
}

static tl_status find_partners(turner *self, tl_error *error)
{
    size_t count = self->mesh->triangle_count;
    int log = 4;
    while (log < 40 && (UINT64_C(1) << log) < 2 * (uint64_t)count)
        log++;
    uint32_t *table = tl_alloc((size_t)1 << log, sizeof *table);
    self->partners = tl_alloc(count, sizeof *self->partners);
    if (!table || !self->partners) {
        free(table);
        return tl_fail_memory(error, "the mesh's squares");
    }
    memset(table, 0xff, sizeof *table << log);
    for (size_t k = 0; k < count; k++)
        find_partner(self, table, log, (uint32_t)k);
    free(table);
    return TL_OK;
}

/* ---- One square ---- */

static square square_of(const turner *self, uint32_t triangle)
{
    const tl_vertex *v = self->mesh->vertices;
    uint32_t one[3], two[3];
    corners_of(self->mesh, triangle, one);
    corners_of(self->mesh, self->partners[triangle], two);
    square out = {.a = one[0], .b = one[1], .c = one[2], .d = two[2]};
    out.x = v[out.a].i, out.y = v[out.a].j;
    out.ux = v[out.c].i - out.x, out.uy = v[out.c].j - out.y;
    out.vx = v[out.d].i - out.x, out.vy = v[out.d].j - out.y;
    out.za = (double)v[out.a].z, out.zb = (double)v[out.b].z;
    out.zc = (double)v[out.c].z, out.zd = (double)v[out.d].z;
    out.size = 63 - __builtin_clzll((unsigned long long)length2(&v[out.a], &v[out.b])) - 1;
    return out;
}

/* The steepest way over a triangle of legs `u` and `v` cells long with these rises along them. */
static double rise_of(double u, double v, double leg2)
{
    return sqrt((u * u + v * v) / leg2);
}

static void look_at_rises(turner *self)
{
    const tl_vertex *v = self->mesh->vertices;
    for (size_t k = 0; k < self->mesh->triangle_count; k++) {
        uint32_t c[3];
        if (!corners_of(self->mesh, k, c))
            continue;
        double leg2 = (double)length2(&v[c[0]], &v[c[2]]), z = (double)v[c[2]].z;
        int size = 63 - __builtin_clzll((unsigned long long)length2(&v[c[0]], &v[c[1]])) - 1;
        self->rises[size] = fmax(self->rises[size], rise_of((double)v[c[0]].z - z, (double)v[c[1]].z - z, leg2));
    }
}

/* What the other diagonal's triangles may be off at samples: below 0, or not a number, nothing will do. Their slopes
 * must not be more than the mesh has in this size already, since what lies beside them was allowed for these. */
static double limit_of(const turner *self, const square *at)
{
    double leg2 = (double)(at->ux * at->ux + at->uy * at->uy), unit = self->dem->info.georef.height_unit;
    double rise =
        fmax(rise_of(at->za - at->zc, at->za - at->zd, leg2), rise_of(at->zb - at->zc, at->zb - at->zd, leg2));
    double limit = self->options->max_error;
    if (!self->bends && !tl_rounds(&self->options->rounding))
        return limit;
    int size = at->size;
    double most = self->rises[size];
    if (rise > most)
        return -1;
    most = fmax(most, fmax(size ? self->rises[size - 1] : 0, size + 1 < TL_SIZES ? self->rises[size + 1] : 0));
    if (self->bends)
        limit -= dem_bend_error(&self->bend, 2 * leg2, most * unit) / unit;
    return limit - tl_rounding_error(&self->options->rounding, most);
}

/* Heights of the two triangles on the diagonal a-b, and of those on c-d, at (u, v): the shares of the way from a to c
 * and to d. */
static double on_first(const square *at, double u, double v)
{
    return u >= v ? at->za + u * (at->zc - at->za) + v * (at->zb - at->zc)
                  : at->za + v * (at->zd - at->za) + u * (at->zb - at->zd);
}

static double on_second(const square *at, double u, double v)
{
    return u + v <= 1 ? at->za + u * (at->zc - at->za) + v * (at->zd - at->za)
                      : at->zb + (1 - u) * (at->zd - at->zb) + (1 - v) * (at->zc - at->zb);
}

/* Looks at the samples inside of the square in one row of a band. False where one breaks the limit. */
static bool look_at_row(const square *at, const float *z, int64_t x0, int64_t x1, int64_t y, double rounding,
                        counts *sum)
{
    int64_t leg2 = at->ux * at->ux + at->uy * at->uy;
    bool good = true;
    for (int64_t x = x0; x <= x1; x++) {
        int64_t along = (x - at->x) * at->ux + (y - at->y) * at->uy,
                across = (x - at->x) * at->vx + (y - at->y) * at->vy;
        if (along <= 0 || across <= 0 || along >= leg2 || across >= leg2)
            continue;
        double u = (double)along / (double)leg2, v = (double)across / (double)leg2, height = (double)z[x - x0];
        double first = on_first(at, u, v) - height, second = on_second(at, u, v) - height;
        good = good && fabs(second) + rounding <= at->limit; /* a void is not */
        sum->samples++;
        sum->before += first * first;
        sum->after += second * second;
    }
    return good;
}

/* *holds becomes whether the other diagonal keeps the bound at all samples inside. */
static tl_status look_inside(const turner *self, const square *at, float *band, bool *holds, counts *sum,
                             tl_error *error)
{
    int64_t low_x = tl_int64_min(0, at->ux) + tl_int64_min(0, at->vx), wide = llabs(at->ux) + llabs(at->vx);
    int64_t low_y = tl_int64_min(0, at->uy) + tl_int64_min(0, at->vy), high = llabs(at->uy) + llabs(at->vy);
    int64_t rows = tl_int64_max(1, BAND / (wide + 1));
    *holds = at->limit >= 0;
    for (int64_t y = 1; *holds && y < high; y += rows) {
        tl_window window = {at->x + low_x, at->y + low_y + y, wide + 1, tl_int64_min(rows, high - y)};
        tl_status status = tl_source_read(self->dem, self->dem->info.level, window, band, error);
        if (status != TL_OK)
            return status;
        for (int64_t k = 0; *holds && k < window.height; k++)
            *holds =
                look_at_row(at, band + k * window.width, window.x, window.x + wide, window.y + k, self->rounding, sum);
    }
    return TL_OK;
}

static void turn(const turner *self, uint32_t triangle, const square *at)
{
    uint32_t *one = self->mesh->indices + 3 * (size_t)triangle;
    uint32_t *two = self->mesh->indices + 3 * (size_t)self->partners[triangle];
    one[0] = at->d, one[1] = at->c, one[2] = at->a;
    two[0] = at->c, two[1] = at->d, two[2] = at->b;
}

static tl_status look_at_square(const turner *self, uint32_t triangle, float *band, counts *out, tl_error *error)
{
    square at = square_of(self, triangle);
    out->squares++;
    if (at.zc + at.zd >= at.za + at.zb) {
        out->lower++;
        return TL_OK;
    }
    bool holds;
    counts sum = {0};
    at.limit = limit_of(self, &at);
    tl_status status = look_inside(self, &at, band, &holds, &sum, error);
    if (status != TL_OK)
        return status;
    if (!holds) {
        out->held++;
        return TL_OK;
    }
    turn(self, triangle, &at);
    out->turned++;
    out->samples += sum.samples;
    out->before += sum.before;
    out->after += sum.after;
    return TL_OK;
}

static tl_status run_chunk(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    const turner *self = context;
    (void)loop;
    (void)worker;
    size_t end = self->mesh->triangle_count;
    end = end - item * CHUNK > CHUNK ? (item + 1) * CHUNK : end;
    int64_t width = tl_int64_max(self->dem->info.width, BAND); /* the widest window, and a row of it at least */
    float *band = tl_alloc((size_t)width, sizeof *band);
    tl_status status = band ? TL_OK : tl_fail_memory(error, "a row of the raster");
    for (size_t k = item * CHUNK; status == TL_OK && k < end; k++)
        if (self->partners[k] != NONE && self->partners[k] > k)
            status = look_at_square(self, (uint32_t)k, band, &self->found[item], error);
    free(band);
    return status;
}

/* ---- The whole ---- */

static tl_status look_at_frame(turner *self, tl_error *error)
{
    const tl_source_info *info = &self->dem->info;
    double magnitude = 0;
    for (size_t k = 0; k < self->mesh->vertex_count; k++)
        magnitude = fmax(magnitude, fabs((double)self->mesh->vertices[k].z));
    self->rounding = tl_plane_rounding(magnitude + self->options->max_error);
    self->bends = dem_frame_bends(&info->georef, self->options->frame);
    if (!self->bends)
        return TL_OK;
    dem_space *space = dem_space_create(&info->georef, info->width, info->height, info->name, error);
    if (!space)
        return error->status;
    self->bend = dem_space_bend(space, 0, 0, (double)(info->width - 1), (double)(info->height - 1),
                                magnitude * info->georef.height_unit);
    dem_space_destroy(space);
    return TL_OK;
}

static void report(const turner *self, uint64_t chunks, tl_diagonal_report *out)
{
    counts all = {0};
    for (uint64_t k = 0; k < chunks; k++) {
        const counts *one = &self->found[k];
        all.squares += one->squares, all.lower += one->lower, all.turned += one->turned, all.held += one->held;
        all.samples += one->samples, all.before += one->before, all.after += one->after;
    }
    double samples = all.samples ? (double)all.samples : 1;
    *out = (tl_diagonal_report){.squares = all.squares,
                                .lower = all.lower,
                                .turned = all.turned,
                                .held = all.held,
                                .samples = all.samples,
                                .rms_before = sqrt(all.before / samples),
                                .rms_after = sqrt(all.after / samples)};
}

static tl_status turn_all(turner *self, tl_diagonal_report *out, tl_error *error)
{
    uint64_t chunks = (self->mesh->triangle_count + CHUNK - 1) / CHUNK;
    tl_status status = find_partners(self, error);
    if (status == TL_OK)
        status = look_at_frame(self, error);
    if (status != TL_OK)
        return status;
    look_at_rises(self);
    self->found = calloc(chunks ? chunks : 1, sizeof *self->found);
    if (!self->found)
        return tl_fail_memory(error, "the mesh's squares");
    status = tl_parallel_for(self->options->run, chunks, self->mesh->triangle_count, run_chunk, self, error);
    if (status == TL_OK && out)
        report(self, chunks, out);
    return status;
}

tl_status tl_mesh_lower_diagonals(tl_mesh *mesh, const tl_source *dem, const tl_diagonal_options *options,
                                  tl_diagonal_report *out, tl_error *error)
{
    tl_error own = {0};
    error = error ? error : &own; /* it tells why a frame is none */
    if (mesh->triangle_count > UINT32_MAX - 1)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %zu triangles are too many to be turned; use a larger max_error",
                       dem->info.name, mesh->triangle_count);
    tl_status status =
        tl_run_fits(options->run, 24.0 * (double)mesh->triangle_count, dem->info.name, "turning its diagonals", error);
    if (status != TL_OK)
        return status;
    turner self = {.mesh = mesh, .dem = dem, .options = options};
    status = turn_all(&self, out, error);
    free(self.partners);
    free(self.found);
    return status == TL_OK ? tl_parameters_add(&mesh->parameters, &mesh->parameter_count, "diagonal", "lower", error)
                           : status;
}
