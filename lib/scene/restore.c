/* An elevation model again from its framework: the surface of its triangles, and detail where samples were dropped.
 *
 * The lattice is filled from coarse to fine. At each half step a vertex that the framework keeps has its height; any
 * other gets the mean that the heights around it leave, by kriging of the coarser lattice and of the finer points that
 * are kept nearby, and keyed noise of the spread that they leave. It is then drawn towards the triangles' surface so
 * that it stays within the bound. The solutions are kept by which sites are known. */
#include "lib/scene/restore.h"

#include "dem/framework.h"
#include "fbm/elementary.h"
#include "fbm/rng.h"
#include "fbm/weights.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum { CACHE = 1 << 12, ROWS = 64 };

/* Heights, the triangles' surface, the mesh. */
static const double BYTES_A_SAMPLE = 14, BYTES_A_POINT = 40;

/* Solutions by what is known; 0 marks a free place, for some site always is known. */
typedef struct cache {
    uint64_t known[2][CACHE];
    scene_weights *of[2];
    size_t used[2];
} cache;

typedef struct restored {
    tl_source source;
    float *heights;
    tl_parameter *parameters;
} restored;

typedef struct filler {
    const tl_framework *framework;
    const tl_source *dem; /* may be NULL */
    int64_t width, height;
    float *z;       /* NaN: void, or not yet */
    float *surface; /* NaN: void */
    float *model;   /* the DEM, or NULL */
    uint64_t seed;
    double hurst, delta, limit, aspect;
    double spread[TL_STAGES]; /* see tl_framework */
    bool hurst_given, delta_given;
    bool ignores; /* finer points: only to show what they are good for */
    scene_kriging kriging;
    cache *caches; /* by worker */
    float **noise; /* by worker: rows of noise */
    unsigned workers;
    int64_t s; /* of the stage, half of its spacing */
    double amplitude;
    double *squares;  /* while it measures: by row of the half step, the residuals' squares over what fBm of delta 1 */
    uint64_t *counts; /* at spacing 1 has, and their number; else NULL */
    double quantum_square; /* variance of the model's rounding */
} filler;

/* ---- The triangles' surface ------------------------------------------------------------------------ */

static void draw_triangle(filler *self, const tl_vertex *const v[3])
{
    int64_t ax = v[1]->i - v[0]->i, ay = v[1]->j - v[0]->j, bx = v[2]->i - v[0]->i, by = v[2]->j - v[0]->j;
    int64_t whole = ax * by - ay * bx;
    int64_t x0 = tl_int64_min(v[0]->i, tl_int64_min(v[1]->i, v[2]->i)),
            x1 = tl_int64_max(v[0]->i, tl_int64_max(v[1]->i, v[2]->i));
    int64_t y0 = tl_int64_min(v[0]->j, tl_int64_min(v[1]->j, v[2]->j)),
            y1 = tl_int64_max(v[0]->j, tl_int64_max(v[1]->j, v[2]->j));
    int64_t sign = whole < 0 ? -1 : 1;
    for (int64_t y = y0; whole && y <= y1; y++)
        for (int64_t x = x0; x <= x1; x++) {
            int64_t dx = x - v[0]->i, dy = y - v[0]->j, b = sign * (dx * by - dy * bx), c = sign * (ax * dy - ay * dx);
            int64_t a = sign * whole - b - c;
            if (a >= 0 && b >= 0 && c >= 0)
                self->surface[y * self->width + x] =
                    (float)(((double)a * (double)v[0]->z + (double)b * (double)v[1]->z + (double)c * (double)v[2]->z) /
                            (double)(sign * whole));
        }
}

static tl_status draw_surface(filler *self, tl_error *error)
{
    tl_mesh *mesh = NULL;
    tl_status status = tl_framework_mesh(self->framework, &mesh, error);
    if (status != TL_OK)
        return status;
    for (int64_t k = 0; k < self->width * self->height; k++)
        self->surface[k] = NAN;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        const tl_vertex *v[3];
        for (int k = 0; k < 3; k++)
            v[k] = &mesh->vertices[mesh->indices[3 * t + (size_t)k]];
        draw_triangle(self, v);
    }
    tl_mesh_destroy(mesh);
    return TL_OK;
}

/* ---- One vertex ------------------------------------------------------------------------------------- */

static inline bool is_inside(const filler *self, int64_t x, int64_t y)
{
    return x >= 0 && y >= 0 && x < self->width && y < self->height;
}

/* Sample offset of a site, or false where it lies between samples or outside. */
static inline bool site_at(const filler *self, const int32_t site[2], int64_t x, int64_t y, int64_t *at)
{
    int64_t dx = site[0] * self->s, dy = site[1] * self->s; /* s = S / 2 */
    if ((dx | dy) & 1)
        return false;
    x += dx / 2, y += dy / 2;
    *at = y * self->width + x;
    return is_inside(self, x, y);
}

static const scene_weights *weights_of(const filler *self, cache *own, scene_half half, uint64_t known)
{
    size_t slot = (size_t)((known * UINT64_C(0x9E3779B97F4A7C15)) >> 52);
    while (own->known[half][slot] && own->known[half][slot] != known)
        slot = (slot + 1) % CACHE;
    if (own->known[half][slot] == known)
        return &own->of[half][slot];
    if (own->used[half]++ > CACHE / 2) { /* start again */
        memset(own->known[half], 0, sizeof own->known[half]);
        own->used[half] = 1;
        slot = 0;
    }
    own->known[half][slot] = known;
    scene_kriging_solve(&self->kriging, half, known, &own->of[half][slot]);
    return &own->of[half][slot];
}

static inline bool has_point(const filler *self, int64_t at)
{
    return tl_bit(self->framework->points, self->framework->words, at % self->width, at / self->width);
}

/* Within the bound: a residual of up to half of it as it is, a larger one drawn towards it. */
static double held(double residual, double limit)
{
    double half = 0.5 * limit, over = (fabs(residual) - half) / (half > 0 ? half : 1);
    if (!(fabs(residual) > half))
        return residual;
    return copysign(half + half * (over / (1 + over)), residual);
}

/* The nearest float to a value that is not farther than `limit` from `centre`. */
static float within(double value, double centre, double limit)
{
    float low = (float)(centre - limit), high = (float)(centre + limit), z = (float)value;
    while (centre - (double)low > limit)
        low = nextafterf(low, INFINITY);
    while ((double)high - centre > limit)
        high = nextafterf(high, -INFINITY);
    return z < low ? low : z > high ? high : z;
}

/* Compares a dropped sample with what is expected there. */
static void note_residual(const filler *self, const scene_weights *w, double residual, int64_t row)
{
    double rounding = 1;
    for (int i = 0; i < SCENE_SITES; i++)
        rounding += w->weights[i] * w->weights[i];
    double square = residual * residual - self->quantum_square * rounding;
    if (!(w->sigma > 0))
        return;
    self->squares[row] += square / (w->sigma * w->sigma);
    self->counts[row]++;
}

static void make_vertex(const filler *self, cache *own, scene_half half, int64_t x, int64_t y, double noise,
                        int64_t row)
{
    const int32_t(*sites)[2] = self->kriging.sites[half];
    int64_t here = y * self->width + x, at[SCENE_SITES];
    uint64_t known = 0;
    float *z = &self->z[here];
    if (isnan(self->surface[here]) || has_point(self, here))
        return; /* its height, or none, is there already */
    for (int i = 0; i < SCENE_COARSE; i++)
        if (site_at(self, sites[i], x, y, &at[i]) && !isnan(self->z[at[i]]))
            known |= UINT64_C(1) << i;
    for (int i = SCENE_COARSE; i < SCENE_SITES && !self->ignores; i++)
        if (site_at(self, sites[i], x, y, &at[i]) && has_point(self, at[i]))
            known |= UINT64_C(1) << i;
    double centre = (double)self->surface[here], value = centre;
    if (known) {
        const scene_weights *w = weights_of(self, own, half, known);
        value = noise * w->sigma * self->amplitude;
        for (uint64_t left = known; left; left &= left - 1) {
            int i = __builtin_ctzll(left);
            value += w->weights[i] * (double)self->z[at[i]];
        }
        if (self->squares)
            note_residual(self, w, (double)*z - value, row);
    }
    if (self->squares)
        return;
    *z = within(centre + held(value - centre, self->limit), centre, self->limit);
    if (self->model)
        *z = within((double)*z, (double)self->model[here], self->limit);
}

/* ---- Rows of a half step ---------------------------------------------------------------------------- */

/* Noise of columns -1 ... count of a row of the stage, at row + 1. */
static const float *noise_row(const filler *self, float *to, fbm_noise_kind kind, int64_t row, size_t count)
{
    int32_t level = -1 - __builtin_ctzll((unsigned long long)self->s); /* that of the spacing S, below all others */
    fbm_noise_row(self->seed, level, kind, row, -1, count, to);
    return to + 1;
}

static tl_status fill_centres(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    const filler *self = context;
    int64_t j = (int64_t)item, s = self->s, columns = (self->width - 1 + s) / (2 * s);
    size_t room = (size_t)columns + 3;
    const double *taps = self->kriging.taps[SCENE_CENTRES];
    const float *g[3];
    (void)loop;
    (void)error;
    for (int k = 0; k < 3; k++)
        g[k] = noise_row(self, self->noise[worker] + (size_t)k * room, FBM_NOISE_CENTRES, j - 1 + k, room);
    for (int64_t i = 0; i < columns; i++) {
        double near = (double)g[0][i] + (double)g[2][i] + (double)g[1][i - 1] + (double)g[1][i + 1];
        double next = (double)g[0][i - 1] + (double)g[0][i + 1] + (double)g[2][i - 1] + (double)g[2][i + 1];
        make_vertex(self, &self->caches[worker], SCENE_CENTRES, (2 * i + 1) * s, (2 * j + 1) * s,
                    taps[0] * (double)g[1][i] + taps[1] * near + taps[2] * next, (int64_t)item);
    }
    return TL_OK;
}

/* Row `item` at spacing s: an even one has the edges along rows, an odd one those along columns. Of the neighbours
 * along diagonals, the other kind, two lie in the row above and two in the row below. */
static tl_status fill_edges(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    const filler *self = context;
    int64_t r = (int64_t)item, s = self->s, columns = (self->width - 1) / (2 * s) + 1;
    bool odd = r & 1;
    int64_t j = r / 2, shift = odd ? 0 : 1;
    size_t room = (size_t)columns + 3;
    fbm_noise_kind own = odd ? FBM_NOISE_COLUMN_EDGES : FBM_NOISE_ROW_EDGES;
    fbm_noise_kind other = odd ? FBM_NOISE_ROW_EDGES : FBM_NOISE_COLUMN_EDGES;
    const double *taps = self->kriging.taps[SCENE_EDGES];
    const float *g[3], *d[2];
    (void)loop;
    (void)error;
    for (int k = 0; k < 3; k++)
        g[k] = noise_row(self, self->noise[worker] + (size_t)k * room, own, j - 1 + k, room);
    for (int k = 0; k < 2; k++)
        d[k] = noise_row(self, self->noise[worker] + (size_t)(3 + k) * room, other, odd ? j + k : j - 1 + k, room);
    for (int64_t i = 0; i < columns; i++) {
        int64_t x = (2 * i + shift) * s, left = odd ? i - 1 : i;
        if (x >= self->width)
            break;
        double near = (double)d[0][left] + (double)d[0][left + 1] + (double)d[1][left] + (double)d[1][left + 1];
        double next = (double)g[0][i] + (double)g[2][i] + (double)g[1][i - 1] + (double)g[1][i + 1];
        make_vertex(self, &self->caches[worker], SCENE_EDGES, x, r * s,
                    taps[0] * (double)g[1][i] + taps[1] * near + taps[2] * next, (int64_t)item);
    }
    return TL_OK;
}

static tl_status fill_stage(filler *self, int64_t s, const tl_run *run, tl_error *error)
{
    self->s = s;
    self->amplitude = self->spread[__builtin_ctzll((unsigned long long)s)];
    tl_status status = TL_OK;
    if (s < self->height && s < self->width)
        status = tl_parallel_for(run, (uint64_t)((self->height - 1 + s) / (2 * s)), 0, fill_centres, self, error);
    if (status == TL_OK)
        status = tl_parallel_for(run, (uint64_t)((self->height - 1) / s + 1), 0, fill_edges, self, error);
    return status;
}

/* ---- What lies between: measured on the samples that were dropped -------------------------------------- */

/* The square of a stage's spread as the samples tell it that were dropped there; 0 where they are too few. Rows are
 * added in order, so that threads do not matter. */
static tl_status measure_stage(filler *self, int64_t s, const tl_run *run, double *square, tl_error *error)
{
    enum { ENOUGH = 50 };
    uint64_t count = 0;
    double sum = 0;
    memset(self->squares, 0, (size_t)self->height * sizeof *self->squares);
    memset(self->counts, 0, (size_t)self->height * sizeof *self->counts);
    tl_status status = fill_stage(self, s, run, error);
    for (int64_t y = 0; y < self->height; y++) {
        sum += self->squares[y];
        count += self->counts[y];
    }
    *square = count < ENOUGH || !(sum > 0) ? 0 : sum / (double)count;
    return status;
}

/* The spread of every stage. What is dropped lies where the model is smooth, and the more so the larger the triangles
 * are, so neither delta nor the exponent is that of the whole; a stage without samples follows the finer one. */
static tl_status measure_dropped(filler *self, const tl_run *run, tl_error *error)
{
    self->squares = tl_alloc((size_t)self->height, sizeof *self->squares);
    self->counts = tl_alloc((size_t)self->height, sizeof *self->counts);
    if (!self->squares || !self->counts)
        return tl_fail_memory(error, "the framework's terrain");
    scene_kriging_init(&self->kriging, self->hurst, self->aspect);
    tl_status status = TL_OK;
    for (int k = 0; status == TL_OK && k < self->framework->lattice_log; k++) {
        double square = 0;
        status = measure_stage(self, INT64_C(1) << k, run, &square, error);
        self->spread[k] = square > 0 ? sqrt(square) : k ? self->spread[k - 1] : 0;
    }
    return status;
}

/* ---- All -------------------------------------------------------------------------------------------- */

static tl_status make_room(filler *self, const tl_run *run, tl_error *error)
{
    self->workers = tl_parallel_workers(run, (uint64_t)self->height);
    self->surface = tl_alloc_grid(self->width, self->height, sizeof *self->surface);
    self->model = self->dem ? tl_alloc_grid(self->width, self->height, sizeof *self->model) : NULL;
    self->caches = calloc(self->workers, sizeof *self->caches);
    self->noise = calloc(self->workers, sizeof *self->noise);
    bool good = self->surface && self->caches && self->noise && (!self->dem || self->model);
    for (unsigned i = 0; good && i < self->workers; i++) {
        self->noise[i] = tl_alloc((size_t)self->width + 8, 5 * sizeof **self->noise);
        good = self->noise[i];
        for (int half = 0; good && half < 2; half++) {
            self->caches[i].of[half] = tl_alloc(CACHE, sizeof *self->caches[i].of[half]);
            good = self->caches[i].of[half];
        }
    }
    return good ? TL_OK : tl_fail_memory(error, "the framework's terrain");
}

static void free_room(filler *self)
{
    for (unsigned i = 0; i < self->workers; i++) {
        if (self->noise)
            free(self->noise[i]);
        if (self->caches) {
            free(self->caches[i].of[0]);
            free(self->caches[i].of[1]);
        }
    }
    free(self->noise);
    free(self->caches);
    free(self->squares);
    free(self->counts);
    free(self->surface);
    free(self->model);
}

/* The points' heights; and of samples in no triangle what the model knows. */
static tl_status place_points(filler *self, tl_error *error)
{
    tl_status status = TL_OK;
    for (int64_t y = 0; status == TL_OK && self->model && y < self->height; y += ROWS) {
        tl_window window = {0, y, self->width, tl_int64_min(ROWS, self->height - y)};
        float *to = self->model + y * self->width;
        status = tl_source_read(self->dem, self->dem->info.level, window, to, error);
        if (status == TL_OK)
            tl_heights_clean(to, (size_t)(window.width * window.height));
    }
    for (int64_t y = 0; status == TL_OK && y < self->height; y++)
        tl_framework_heights(self->framework, 0, y, self->width, self->z + y * self->width);
    for (int64_t k = 0; status == TL_OK && self->model && k < self->width * self->height; k++)
        if (isnan(self->surface[k]))
            self->z[k] = self->model[k];
        else if (isnan(self->model[k]))
            return tl_fail(error, TL_ERROR_ARGUMENT, "%s: is not the model of this framework", self->dem->info.name);
    return status;
}

/* Exponent and spreads: those that are given, of the framework's file, or measured. */
static tl_status choose_model(filler *self, const tl_run *run, tl_error *error)
{
    const tl_framework *framework = self->framework;
    tl_roughness found = {.measurable = false};
    bool known = framework->hurst > 0, measures = !known && self->model;
    tl_status status = measures && !self->hurst_given ? tl_roughness_measure(self->dem, run, &found, error) : TL_OK;
    if (!self->hurst_given)
        self->hurst = known ? framework->hurst : found.measurable ? found.hurst : 0.5;
    self->hurst = fmin(fmax(self->hurst, FBM_HURST_MIN), FBM_HURST_MAX);
    for (int k = 0; k < TL_STAGES; k++)
        self->spread[k] = self->delta_given ? self->delta * fbm_pow(0.5 * (double)(INT64_C(1) << k), self->hurst)
                                            : framework->spread[k];
    if (status != TL_OK || self->delta_given || !measures)
        return status;
    double quantum = self->dem->info.quantum;
    self->quantum_square = quantum * quantum / 12;
    float *heights = self->z;
    self->z = self->model;
    status = measure_dropped(self, run, error);
    self->z = heights;
    free(self->squares);
    free(self->counts);
    self->squares = NULL, self->counts = NULL;
    return status;
}

static tl_status prepare(filler *self, const tl_run *run, tl_error *error)
{
    const tl_georef *georef = &self->framework->info.georef;
    self->aspect = georef->cell_x > 0 && georef->cell_y > 0 ? georef->cell_x / georef->cell_y : 1;
    self->aspect = fmin(fmax(self->aspect, 0.05), 20);
    if (!(self->delta >= 0 && self->delta <= 1e30))
        return tl_fail(error, TL_ERROR_ARGUMENT, "delta must be from 0 to 1e30, not %g", self->delta);
    tl_status status = make_room(self, run, error);
    if (status == TL_OK)
        status = draw_surface(self, error);
    if (status == TL_OK)
        status = place_points(self, error);
    return status == TL_OK ? choose_model(self, run, error) : status;
}

static tl_status fill(filler *self, const tl_run *run, tl_error *error)
{
    tl_status status = prepare(self, run, error);
    scene_kriging_init(&self->kriging, self->hurst, self->aspect);
    for (int64_t s = (INT64_C(1) << self->framework->lattice_log) / 2; status == TL_OK && s > 0; s /= 2)
        status = fill_stage(self, s, run, error);
    return status;
}

static tl_status read_restored(const tl_source *source, int level, tl_window window, float *out, tl_error *error)
{
    const restored *self = (const restored *)source;
    (void)level;
    (void)error;
    for (int64_t y = 0; y < window.height; y++)
        memcpy(out + y * window.width, self->heights + (window.y + y) * source->info.width + window.x,
               (size_t)window.width * sizeof *out);
    return TL_OK;
}

static void destroy_restored(tl_source *source)
{
    restored *self = (restored *)source;
    tl_crs_release(source->info.georef.crs);
    free((char *)source->info.name);
    free(self->heights);
    free(self->parameters);
    free(self);
}

static tl_status describe(restored *self, const filler *by, const tl_framework *framework, tl_error *error)
{
    tl_source_info *info = &self->source.info;
    char bound[TL_NUMBER_TEXT], hurst[TL_NUMBER_TEXT], delta[TL_NUMBER_TEXT], seed[TL_NUMBER_TEXT];
    tl_number_text(framework->max_error, bound);
    tl_number_text(by->hurst, hurst);
    if (by->delta_given)
        tl_number_text(by->delta, delta);
    else
        snprintf(delta, sizeof delta, "by stage");
    snprintf(seed, sizeof seed, "%llu", (unsigned long long)by->seed);
    const tl_parameter all[] = {{"framework_max_error", bound},
                                {"framework_hurst", hurst},
                                {"framework_delta", delta},
                                {"framework_seed", seed}};
    tl_status status = tl_parameters_add_origin(&self->parameters, &info->parameter_count, &framework->info, error);
    for (size_t k = 0; status == TL_OK && k < sizeof all / sizeof *all; k++)
        status = tl_parameters_add(&self->parameters, &info->parameter_count, all[k].name, all[k].value, error);
    info->parameters = self->parameters;
    return status;
}

/* Whether what a filler takes is within the memory. */
static tl_status fits(const tl_framework *framework, const tl_run *run, const char *work, tl_error *error)
{
    const tl_source_info *info = &framework->info;
    double bytes =
        BYTES_A_SAMPLE * (double)info->width * (double)info->height + BYTES_A_POINT * (double)framework->point_count;
    return tl_run_fits(run, bytes, info->name, work, error);
}

tl_status scene_restore_measure(const tl_framework *framework, const tl_source *dem, const tl_run *run, double *hurst,
                                double spread[TL_STAGES], tl_error *error)
{
    filler self = {.framework = framework, .dem = dem, .width = dem->info.width, .height = dem->info.height};
    if (fits(framework, run, "measuring what its framework drops", error) != TL_OK)
        return TL_ERROR_MEMORY;
    self.z = tl_alloc_grid(self.width, self.height, sizeof *self.z);
    tl_status status = self.z ? prepare(&self, run, error) : tl_fail_memory(error, "the framework's terrain");
    *hurst = self.hurst;
    memcpy(spread, self.spread, sizeof self.spread);
    free(self.z);
    free_room(&self);
    return status;
}

static restored *make_source(const tl_framework *framework, tl_error *error)
{
    restored *self = calloc(1, sizeof *self);
    if (!self) {
        tl_fail_memory(error, "the framework's terrain");
        return NULL;
    }
    self->source = (tl_source){.info = framework->info, .read = read_restored, .destroy = destroy_restored};
    tl_source_info *info = &self->source.info;
    tl_crs_retain(info->georef.crs);
    info->name = strdup(framework->info.name);
    info->parameters = NULL;
    info->parameter_count = 0;
    info->has_voids = framework->valid_count < (uint64_t)info->width * (uint64_t)info->height;
    info->quantum = 0;
    info->level = 0;
    info->block_width = info->block_height = 0;
    self->heights = tl_alloc_grid(info->width, info->height, sizeof *self->heights);
    if (info->name && self->heights)
        return self;
    tl_fail_memory(error, "the framework's terrain");
    destroy_restored(&self->source);
    return NULL;
}

tl_source *tl_framework_restore(const tl_framework *framework, const tl_source *dem, const tl_restore_options *options,
                                tl_error *error)
{
    return scene_restore(framework, dem, options, false, error);
}

tl_source *scene_restore(const tl_framework *framework, const tl_source *dem, const tl_restore_options *options,
                         bool ignores, tl_error *error)
{
    static const tl_restore_options defaults;
    const tl_restore_options *o = options ? options : &defaults;
    const tl_source_info *info = &framework->info;
    if (fits(framework, o->run, "its terrain from the framework", error) != TL_OK)
        return NULL;
    if (dem && (dem->info.width != info->width || dem->info.height != info->height)) {
        tl_fail(error, TL_ERROR_ARGUMENT, "%s: is not the model of this framework", dem->info.name);
        return NULL;
    }
    restored *made = make_source(framework, error);
    if (!made)
        return NULL;
    filler self = {.framework = framework,
                   .dem = dem,
                   .width = info->width,
                   .height = info->height,
                   .z = made->heights,
                   .seed = o->seed,
                   .hurst_given = o->hurst_given,
                   .delta_given = o->delta_given,
                   .hurst = o->hurst,
                   .delta = o->delta_given ? o->delta : 0,
                   .limit = framework->max_error,
                   .ignores = ignores};
    tl_status status = fill(&self, o->run, error);
    if (status == TL_OK)
        status = describe(made, &self, framework, error);
    free_room(&self);
    if (status == TL_OK)
        return &made->source;
    destroy_restored(&made->source);
    return NULL;
}
