/* The check on meshes: every triangle over every sample that it covers, whatever made them. It knows nothing of the
 * framework, so that neither can hide the other's mistakes. */
#include "dem/verify.h"

#include "dem/bend.h"
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <float.h>
#include <math.h>
#include <string.h>

/* Samples of a band: one double and one float each stay in a core's cache. */
enum { BAND_SAMPLES = 1 << 16, MAX_SIDE = 1 << 30 };

typedef struct band_result {
    double worst, squares, excess;
    int64_t i, j, over_i, over_j; /* of the worst, and of the largest excess */
    uint64_t samples, uncovered, exceeding;
} band_result;

/* A sample in space: where its ground is, and which way is up there. */
typedef struct place {
    double at[3], up[3];
} place;

typedef struct verifier {
    const tl_mesh *mesh;
    const tl_source *source;
    int64_t width, height, band_rows;
    size_t bands;
    size_t *first;              /* where the triangles of a band begin in `triangles`; bands + 1 */
    uint32_t *triangles;        /* by band, every triangle in each band that it reaches */
    float **heights;            /* by worker: the band's samples */
    double **errors;            /* and the largest error of each, negative where no triangle covers it */
    float **limits;             /* and their bounds; NULL: the same for all */
    const tl_selection *bounds; /* NULL: none */
    band_result *results;       /* by band */
    const dem_placed *placed;   /* NULL: vertices are at their samples */
    bool bent;                  /* the rest is for frames where the lattice is bent: */
    place *corners;             /* of the mesh, by vertex; only `at` */
    place **places;             /* by worker: the band's samples */
    double **beside;            /* and the error of each on the lattice's triangle, for those beside all flat ones */
    dem_space **spaces;         /* by worker */
} verifier;

static const tl_vertex *corner(const verifier *self, size_t triangle, int k)
{
    return &self->mesh->vertices[self->mesh->indices[3 * triangle + (size_t)k]];
}

/* ---- One triangle -------------------------------------------------------------------------------- */

/* Twice the signed area of a, b and the sample (x, y). Sides of at most 2^30 keep it below 2^61. */
static inline int64_t area(const tl_vertex *a, const tl_vertex *b, int64_t x, int64_t y)
{
    return (int64_t)(b->i - a->i) * (y - a->j) - (int64_t)(b->j - a->j) * (x - a->i);
}

static inline int64_t div_down(int64_t a, int64_t b)
{
    return a / b - (a % b != 0 && (a < 0) != (b < 0));
}

/* Narrows low ... high to those x with value + slope (x - from) >= 0. */
static inline void narrow(int64_t value, int64_t slope, int64_t from, int64_t *low, int64_t *high)
{
    if (slope > 0)
        *low = tl_int64_max(*low, from - div_down(value, slope));
    else if (slope < 0)
        *high = tl_int64_min(*high, from + div_down(value, -slope));
    else if (value < 0)
        *high = *low - 1;
}

static inline void note(double *error, double e)
{
    if (isnan(e))
        e = HUGE_VAL;
    if (e > *error)
        *error = e;
}

/* A triangle of positive area on the lattice, and its plane: by the corners' weights where these are at their samples,
 * which is exact wherever heights have few enough bits; else by its slopes from the place `at`. */
typedef struct flat {
    const tl_vertex *v[3];
    int64_t whole;
    double z[3];
    bool moved;
    double at[3], across, down;
} flat;

/* Compares row y of a triangle; `x0` ... `x1` are its columns, heights and errors those of the row. */
static void compare_row(const flat *of, int64_t y, int64_t x0, int64_t x1, const float *z, double *errors)
{
    int64_t low = x0, high = x1, w[3], step[3];
    for (int k = 0; k < 3; k++) { /* the weight of vertex k is the area on the opposite side */
        const tl_vertex *a = of->v[(k + 1) % 3], *b = of->v[(k + 2) % 3];
        w[k] = area(a, b, x0, y);
        step[k] = (int64_t)a->j - b->j;
        narrow(w[k], step[k], x0, &low, &high);
    }
    for (int64_t x = low; x <= high; x++) {
        double sum = 0;
        for (int k = 0; k < 3; k++)
            sum += (double)(w[k] + step[k] * (x - x0)) * of->z[k];
        double plane = of->moved ? of->at[2] + of->across * ((double)x - of->at[0]) + of->down * ((double)y - of->at[1])
                                 : sum / (double)of->whole;
        if (fabsf(z[x]) <= FLT_MAX) /* not a void */
            note(&errors[x], fabs(plane - (double)z[x]));
    }
}

/* The plane of a triangle by the places of its corners. */
static void place_flat(flat *to, const double *const p[3])
{
    double u[2][3];
    for (int k = 0; k < 3; k++) {
        to->z[k] = p[k][2];
        to->at[k] = p[0][k];
        to->moved |= p[k][0] != to->v[k]->i || p[k][1] != to->v[k]->j;
    }
    for (int a = 0; a < 3; a++) {
        u[0][a] = p[1][a] - p[0][a];
        u[1][a] = p[2][a] - p[0][a];
    }
    double twice = u[0][0] * u[1][1] - u[0][1] * u[1][0];
    to->across = (u[0][2] * u[1][1] - u[1][2] * u[0][1]) / twice;
    to->down = (u[1][2] * u[0][0] - u[0][2] * u[1][0]) / twice;
}

/* Compares the part of a triangle in rows top ... bottom. */
static void compare_triangle(const verifier *self, size_t triangle, int64_t top, int64_t bottom, const float *heights,
                             double *errors)
{
    flat of = {.v = {corner(self, triangle, 0), corner(self, triangle, 1), corner(self, triangle, 2)}};
    const tl_vertex **v = of.v;
    of.whole = area(v[0], v[1], v[2]->i, v[2]->j);
    if (of.whole == 0)
        return; /* covers nothing */
    if (of.whole < 0) {
        const tl_vertex *swap = v[1];
        v[1] = v[2];
        v[2] = swap;
        of.whole = -of.whole;
    }
    const double *places[3];
    for (int k = 0; k < 3; k++) {
        of.z[k] = (double)v[k]->z;
        places[k] = self->placed ? self->placed->at[v[k] - self->mesh->vertices] : NULL;
    }
    if (self->placed)
        place_flat(&of, places);
    int64_t x0 = tl_int64_min(tl_int64_min(v[0]->i, v[1]->i), v[2]->i);
    int64_t x1 = tl_int64_max(tl_int64_max(v[0]->i, v[1]->i), v[2]->i);
    int64_t y0 = tl_int64_max(tl_int64_min(tl_int64_min(v[0]->j, v[1]->j), v[2]->j), top);
    int64_t y1 = tl_int64_min(tl_int64_max(tl_int64_max(v[0]->j, v[1]->j), v[2]->j), bottom);
    for (int64_t y = y0; y <= y1; y++) {
        int64_t offset = (y - top) * self->width;
        compare_row(&of, y, x0, x1, heights + offset, errors + offset);
    }
}

/* ---- One flat triangle over a bent lattice ---------------------------------------------------------- */

static inline double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static inline void minus(const double a[3], const double b[3], double out[3])
{
    for (int k = 0; k < 3; k++)
        out[k] = a[k] - b[k];
}

static inline void cross(const double a[3], const double b[3], double out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

/* How far a triangle reaches beyond its box on the lattice. A row that is bent at all is so by less than this share of
 * the triangle, and samples of small ones are not near enough to an edge for it to pass them. */
static int64_t reach(const tl_vertex *const v[3])
{
    int64_t x =
        tl_int64_max(tl_int64_max(v[0]->i, v[1]->i), v[2]->i) - tl_int64_min(tl_int64_min(v[0]->i, v[1]->i), v[2]->i);
    int64_t y =
        tl_int64_max(tl_int64_max(v[0]->j, v[1]->j), v[2]->j) - tl_int64_min(tl_int64_min(v[0]->j, v[1]->j), v[2]->j);
    return tl_int64_max(x, y) / 64;
}

/* Metres from a sample to the triangle's plane upwards; *inside tells whether it is met in the triangle. */
static double distance_up(const double *const c[3], const double normal[3], const place *from, bool *inside)
{
    double to[3][3], side[3];
    for (int k = 0; k < 3; k++)
        minus(c[k], from->at, to[k]);
    double up = dot(normal, to[0]) / dot(normal, from->up);
    for (int k = 0; k < 3; k++)
        for (int a = 0; a < 3; a++)
            to[k][a] -= up * from->up[a];
    *inside = true;
    for (int k = 0; k < 3; k++) {
        cross(to[k], to[(k + 1) % 3], side);
        *inside = *inside && dot(side, normal) >= 0;
    }
    return up;
}

/* Whether the sample (x, y) is in the triangle on the lattice. */
static bool covers(const tl_vertex *const v[3], int64_t x, int64_t y)
{
    int64_t a = area(v[0], v[1], x, y), b = area(v[1], v[2], x, y), c = area(v[2], v[0], x, y);
    return (a >= 0 && b >= 0 && c >= 0) || (a <= 0 && b <= 0 && c <= 0);
}

typedef struct bent_band {
    int64_t top, bottom;
    const float *heights;
    const place *places;
    double *errors, *beside;
} bent_band;

static void compare_place(const verifier *self, const tl_vertex *const v[3], const double *const c[3],
                          const double normal[3], int64_t x, int64_t y, const bent_band *band)
{
    int64_t at = (y - band->top) * self->width + x;
    if (!(fabsf(band->heights[at]) <= FLT_MAX))
        return;
    bool inside, at_corner = false;
    for (int k = 0; k < 3; k++)
        at_corner |= v[k]->i == x && v[k]->j == y;
    for (int k = 0; at_corner && !self->placed && k < 3; k++)
        if (v[k]->i == x && v[k]->j == y) { /* not by way of rounded places */
            note(&band->errors[at], fabs((double)v[k]->z - (double)band->heights[at]));
            return;
        }
    double up = distance_up(c, normal, &band->places[at], &inside) / self->source->info.georef.height_unit;
    if (inside || at_corner || isnan(up))
        note(&band->errors[at], fabs(up));
    else if (covers(v, x, y))
        note(&band->beside[at], fabs(up));
}

static void compare_bent(const verifier *self, size_t triangle, const bent_band *band)
{
    const tl_vertex *v[3];
    const double *c[3];
    for (int k = 0; k < 3; k++) {
        v[k] = corner(self, triangle, k);
        c[k] = self->corners[v[k] - self->mesh->vertices].at;
    }
    if (area(v[0], v[1], v[2]->i, v[2]->j) == 0)
        return;
    double ab[3], ac[3], normal[3];
    minus(c[1], c[0], ab);
    minus(c[2], c[0], ac);
    cross(ab, ac, normal);
    int64_t pad = reach(v);
    int64_t x0 = tl_int64_max(tl_int64_min(tl_int64_min(v[0]->i, v[1]->i), v[2]->i) - pad, 0);
    int64_t x1 = tl_int64_min(tl_int64_max(tl_int64_max(v[0]->i, v[1]->i), v[2]->i) + pad, self->width - 1);
    int64_t y0 = tl_int64_max(tl_int64_min(tl_int64_min(v[0]->j, v[1]->j), v[2]->j) - pad, band->top);
    int64_t y1 = tl_int64_min(tl_int64_max(tl_int64_max(v[0]->j, v[1]->j), v[2]->j) + pad, band->bottom);
    for (int64_t y = y0; y <= y1; y++)
        for (int64_t x = x0; x <= x1; x++)
            compare_place(self, v, c, normal, x, y, band);
}

static void compare_bent_band(const verifier *self, size_t item, unsigned worker, int64_t top, int64_t rows)
{
    bent_band band = {.top = top,
                      .bottom = top + rows - 1,
                      .heights = self->heights[worker],
                      .places = self->places[worker],
                      .errors = self->errors[worker],
                      .beside = self->beside[worker]};
    double unit = self->source->info.georef.height_unit;
    for (int64_t at = 0; at < rows * self->width; at++) {
        place *to = &self->places[worker][at];
        band.beside[at] = -1;
        dem_space_at(self->spaces[worker], (double)(at % self->width), (double)(top + at / self->width),
                     unit * (double)band.heights[at], to->at, to->up);
    }
    for (size_t at = self->first[item]; at < self->first[item + 1]; at++)
        compare_bent(self, self->triangles[at], &band);
    for (int64_t at = 0; at < rows * self->width; at++)
        if (band.errors[at] < 0)
            band.errors[at] = band.beside[at];
}

/* ---- One band of rows ------------------------------------------------------------------------------ */

/* Compares with the sample's own bound. */
static void hold_to(const verifier *self, double error, const float *limits, int64_t at, int64_t top, band_result *out)
{
    double limit = limits && !isnan(limits[at]) ? (double)limits[at] : self->bounds->max_error;
    if (error <= limit)
        return;
    out->exceeding++;
    if (error - limit > out->excess) {
        out->excess = error - limit;
        out->over_i = at % self->width;
        out->over_j = top + at / self->width;
    }
}

static void sum_up(const verifier *self, int64_t top, int64_t rows, const float *heights, const double *errors,
                   const float *limits, band_result *out)
{
    *out = (band_result){.worst = -1, .i = -1, .j = -1};
    for (int64_t at = 0; at < rows * self->width; at++) {
        if (!(fabsf(heights[at]) <= FLT_MAX))
            continue;
        if (errors[at] < 0) {
            out->uncovered++;
            continue;
        }
        out->samples++;
        out->squares += errors[at] * errors[at];
        if (self->bounds)
            hold_to(self, errors[at], limits, at, top, out);
        if (errors[at] > out->worst) {
            out->worst = errors[at];
            out->i = at % self->width;
            out->j = top + at / self->width;
        }
    }
}

static tl_status verify_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    verifier *self = context;
    (void)loop;
    int64_t top = (int64_t)item * self->band_rows, rows = tl_int64_min(self->band_rows, self->height - top);
    float *heights = self->heights[worker];
    double *errors = self->errors[worker];
    tl_window window = {0, top, self->width, rows};
    tl_status status = tl_source_read(self->source, self->source->info.level, window, heights, error);
    float *limits = self->limits ? self->limits[worker] : NULL;
    if (status == TL_OK && limits)
        status =
            tl_source_read(self->bounds->max_error_map, self->bounds->max_error_map->info.level, window, limits, error);
    if (status != TL_OK)
        return status;
    for (int64_t at = 0; at < rows * self->width; at++)
        errors[at] = -1;
    if (self->bent)
        compare_bent_band(self, (size_t)item, worker, top, rows);
    for (size_t at = self->first[item]; !self->bent && at < self->first[item + 1]; at++)
        compare_triangle(self, self->triangles[at], top, top + rows - 1, heights, errors);
    sum_up(self, top, rows, heights, errors, limits, &self->results[item]);
    return TL_OK;
}

/* ---- Triangles by bands ---------------------------------------------------------------------------- */

static void bands_of(const verifier *self, size_t triangle, size_t *first, size_t *last)
{
    const tl_vertex *v[3] = {corner(self, triangle, 0), corner(self, triangle, 1), corner(self, triangle, 2)};
    int64_t pad = self->bent ? reach(v) : 0;
    int64_t low = tl_int64_min(tl_int64_min(v[0]->j, v[1]->j), v[2]->j) - pad;
    int64_t high = tl_int64_max(tl_int64_max(v[0]->j, v[1]->j), v[2]->j) + pad;
    *first = (size_t)(tl_int64_max(low, 0) / self->band_rows);
    *last = (size_t)(tl_int64_min(high, self->height - 1) / self->band_rows);
}

/* Counts first, then fills; a triangle keeps its place in the order of the mesh. */
static tl_status sort_triangles(verifier *self, tl_error *error)
{
    size_t first, last, sum = 0;
    for (size_t t = 0; t < self->mesh->triangle_count; t++) {
        bands_of(self, t, &first, &last);
        for (size_t band = first; band <= last; band++)
            self->first[band]++;
    }
    for (size_t band = 0; band <= self->bands; band++) {
        size_t count = self->first[band];
        self->first[band] = sum;
        sum += count;
    }
    self->triangles = tl_alloc(sum, sizeof *self->triangles);
    if (!self->triangles)
        return tl_fail_memory(error, "the mesh's verification");
    for (size_t t = 0; t < self->mesh->triangle_count; t++) {
        bands_of(self, t, &first, &last);
        for (size_t band = first; band <= last; band++)
            self->triangles[self->first[band]++] = (uint32_t)t;
    }
    memmove(self->first + 1, self->first, self->bands * sizeof *self->first); /* each stands at its end now */
    self->first[0] = 0;
    return TL_OK;
}

/* ---- The whole ------------------------------------------------------------------------------------- */

static tl_status check_mesh(const verifier *self, tl_error *error)
{
    const tl_mesh *mesh = self->mesh;
    const char *name = self->source->info.name;
    if (self->width > MAX_SIDE || self->height > MAX_SIDE || mesh->triangle_count > UINT32_MAX)
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: too large to verify, more than 2^30 samples on a side or 2^32 triangles", name);
    for (size_t k = 0; k < mesh->vertex_count; k++)
        if (mesh->vertices[k].i < 0 || mesh->vertices[k].i >= self->width || mesh->vertices[k].j < 0 ||
            mesh->vertices[k].j >= self->height)
            return tl_fail(
                error, TL_ERROR_DATA, "%s: the mesh's vertex %zu lies outside of the %lld x %lld samples; %s", name, k,
                (long long)self->width, (long long)self->height, "verify it against the grid that it was made from");
    for (size_t k = 0; k < 3 * mesh->triangle_count; k++)
        if (mesh->indices[k] >= mesh->vertex_count)
            return tl_fail(error, TL_ERROR_DATA, "%s: triangle %zu of the mesh names vertex %u, but there are %zu",
                           name, k / 3, mesh->indices[k], mesh->vertex_count);
    return TL_OK;
}

static bool make_scratch(verifier *self, unsigned workers)
{
    self->heights = calloc(workers, sizeof *self->heights);
    self->errors = calloc(workers, sizeof *self->errors);
    self->first = calloc(self->bands + 1, sizeof *self->first);
    self->results = calloc(self->bands, sizeof *self->results);
    bool mapped = self->bounds && self->bounds->max_error_map;
    self->limits = mapped ? calloc(workers, sizeof *self->limits) : NULL;
    if (mapped && !self->limits)
        return false;
    for (unsigned i = 0; self->heights && self->errors && i < workers; i++) {
        self->heights[i] = tl_alloc_grid(self->width, self->band_rows, sizeof **self->heights);
        self->errors[i] = tl_alloc_grid(self->width, self->band_rows, sizeof **self->errors);
        if (mapped)
            self->limits[i] = tl_alloc_grid(self->width, self->band_rows, sizeof **self->limits);
        if (!self->heights[i] || !self->errors[i] || (mapped && !self->limits[i]))
            return false;
    }
    return self->heights && self->errors && self->first && self->results;
}

/* What bent frames need beside. */
static tl_status make_bent(verifier *self, unsigned workers, tl_error *error)
{
    const tl_source_info *info = &self->source->info;
    self->corners = tl_alloc(self->mesh->vertex_count, sizeof *self->corners);
    self->places = calloc(workers, sizeof *self->places);
    self->beside = calloc(workers, sizeof *self->beside);
    self->spaces = calloc(workers, sizeof(dem_space *));
    if (!self->corners || !self->places || !self->beside || !self->spaces)
        return tl_fail_memory(error, "the mesh's verification");
    for (unsigned i = 0; i < workers; i++) {
        self->places[i] = tl_alloc_grid(self->width, self->band_rows, sizeof **self->places);
        self->beside[i] = tl_alloc_grid(self->width, self->band_rows, sizeof **self->beside);
        if (!self->places[i] || !self->beside[i])
            return tl_fail_memory(error, "the mesh's verification");
        self->spaces[i] = self->placed ? dem_space_create_at(&info->georef, self->placed->origin, info->name, error)
                                       : dem_space_create(&info->georef, self->width, self->height, info->name, error);
        if (!self->spaces[i])
            return TL_ERROR_DATA;
    }
    for (size_t k = 0; k < self->mesh->vertex_count; k++) {
        const tl_vertex *v = &self->mesh->vertices[k];
        if (self->placed)
            memcpy(self->corners[k].at, self->placed->at[k], sizeof self->corners[k].at);
        else
            dem_space_at(self->spaces[0], v->i, v->j, info->georef.height_unit * (double)v->z, self->corners[k].at,
                         NULL);
    }
    return TL_OK;
}

static void free_bent(verifier *self, unsigned workers)
{
    for (unsigned i = 0; i < workers; i++) {
        if (self->places)
            free(self->places[i]);
        if (self->beside)
            free(self->beside[i]);
        if (self->spaces)
            dem_space_destroy(self->spaces[i]);
    }
    free(self->corners);
    free(self->places);
    free(self->beside);
    free(self->spaces);
}

static void free_scratch(verifier *self, unsigned workers)
{
    for (unsigned i = 0; i < workers; i++) {
        if (self->heights)
            free(self->heights[i]);
        if (self->errors)
            free(self->errors[i]);
        if (self->limits)
            free(self->limits[i]);
    }
    free(self->limits);
    free(self->heights);
    free(self->errors);
    free(self->first);
    free(self->triangles);
    free(self->results);
}

static void merge_excess(const verifier *self, tl_mesh_report *out)
{
    for (size_t band = 0; band < self->bands; band++) {
        const band_result *each = &self->results[band];
        out->exceeding += each->exceeding;
        if (each->excess > out->max_excess) {
            out->max_excess = each->excess;
            out->worst_i = each->over_i;
            out->worst_j = each->over_j;
        }
    }
}

static tl_mesh_report merge(const verifier *self)
{
    tl_mesh_report out = {.worst_i = -1, .worst_j = -1};
    double squares = 0;
    for (size_t band = 0; band < self->bands; band++) {
        const band_result *each = &self->results[band];
        out.samples += each->samples;
        out.uncovered += each->uncovered;
        squares += each->squares;
        if (each->samples && (out.worst_i < 0 || each->worst > out.max_error)) {
            out.max_error = each->worst;
            out.worst_i = each->i;
            out.worst_j = each->j;
        }
    }
    out.rms_error = out.samples ? sqrt(squares / (double)out.samples) : 0;
    merge_excess(self, &out);
    return out;
}

tl_status tl_mesh_verify(const tl_mesh *mesh, const tl_source *source, const tl_run *run, tl_mesh_report *out,
                         tl_error *error)
{
    return tl_mesh_verify_in(mesh, source, TL_FRAME_PIXEL, run, out, error);
}

tl_status tl_mesh_verify_in(const tl_mesh *mesh, const tl_source *source, tl_frame frame, const tl_run *run,
                            tl_mesh_report *out, tl_error *error)
{
    return dem_verify_placed(mesh, NULL, source, NULL, frame, run, out, error);
}

static tl_status check_bounds(const verifier *self, tl_error *error)
{
    const tl_source *map = self->bounds ? self->bounds->max_error_map : NULL;
    if (!map || (map->info.width == self->width && map->info.height == self->height))
        return TL_OK;
    return tl_fail(error, TL_ERROR_DATA, "%s: %lld x %lld bounds for the %lld x %lld samples of %s; give one for each",
                   map->info.name, (long long)map->info.width, (long long)map->info.height, (long long)self->width,
                   (long long)self->height, self->source->info.name);
}

tl_status dem_verify_placed(const tl_mesh *mesh, const dem_placed *placed, const tl_source *source,
                            const tl_selection *bounds, tl_frame frame, const tl_run *run, tl_mesh_report *out,
                            tl_error *error)
{
    verifier self = {.mesh = mesh,
                     .placed = placed,
                     .source = source,
                     .bounds = bounds,
                     .width = source->info.width,
                     .height = source->info.height};
    tl_status status = check_mesh(&self, error);
    if (status == TL_OK)
        status = check_bounds(&self, error);
    if (status != TL_OK)
        return status;
    self.band_rows = tl_int64_min(self.height, tl_int64_max(8, BAND_SAMPLES / self.width));
    self.bands = (size_t)tl_div_up(self.height, self.band_rows);
    unsigned workers = tl_parallel_workers(run, self.bands);
    self.bent = dem_frame_bends(&source->info.georef, frame);
    status =
        make_scratch(&self, workers) ? sort_triangles(&self, error) : tl_fail_memory(error, "the mesh's verification");
    if (status == TL_OK && self.bent)
        status = make_bent(&self, workers, error);
    if (status == TL_OK)
        status =
            tl_parallel_for(run, self.bands, (uint64_t)self.width * (uint64_t)self.height, verify_band, &self, error);
    if (status == TL_OK)
        *out = merge(&self);
    free_scratch(&self, workers);
    free_bent(&self, workers);
    return status;
}
