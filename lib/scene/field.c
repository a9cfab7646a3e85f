/* The fractal field over an elevation model, as a source. */
#include "lib/scene/field.h"
#include "fbm/elementary.h"
#include "fbm/estimate.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/size.h"
#include "lib/scene/cell_means.h"
#include "lib/scene/cell_store.h"
#include "lib/scene/chain.h"
#include "lib/scene/field_map.h"
#include "lib/scene/patch.h"
#include "lib/scene/roughness.h"
#include "lib/scene/terrain.h"

#include <assert.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

enum {
    UNITS = 99,  /* of exponents 0.01 ... 0.99: see units_of */
    BLOCK = 512, /* reads are cut into blocks of at most this, so that the levels of one stay in cache */
    /* Cells beyond the known samples that are made up so that the predictor has something to see. The output lies at
     * most half a cell outside of a known sample, and the halo of the refinement converges to 8 cells. */
    GROWTH = 10,
    ROW_GROWTH = 3, /* and so many more for every halving of the rows */
};

typedef struct field {
    tl_source source;
    const tl_source *dem;
    const char *scheme;
    scene_chain chain;
    scene_terrain *terrain;               /* of cell means, or the strengths of the chain's noise; NULL: neither */
    scene_cell_means means;               /* level 0: not for this field */
    scene_growth growth;                  /* beyond the rim, but for its rings */
    scene_cell_store *kept[SCENE_PLANES]; /* what maps say of cells; NULL: it is not kept */
    scene_cell_store *rim;                /* patches that reach beyond the model, or have voids */
    scene_cell_store *energies;           /* of the terrain */
    /* Fields of exponent and delta; without sources where there is no map. */
    scene_field_map maps[SCENE_PLANES];
    double units[UNITS]; /* sigma over delta at exponents 0.01, 0.02 ...; all 1 where the map is of delta */
    double deltas[SCENE_LEVEL_MAX + 1], hursts[SCENE_LEVEL_MAX + 1]; /* see scene_field_fractal */
    tl_parameter *parameters;
} field;

/* Whether samples stand for cells: the raster's own type, or what is said of it. */
static bool is_area(const field *f)
{
    return f->source.info.type == TL_RASTER_AREA;
}

/* ---- voids ---- */

/* Voids of the DEM stay voids. A cell of an area raster is known when the sample whose cell it lies in is; a point when
 * the samples around it, one, two or four, all are. */
static void cut_voids(const scene_patch *g, bool area, int level, tl_window window, float *out, int64_t stride)
{
    int64_t unit = (int64_t)1 << level, mask = area ? 0 : unit - 1;
    int64_t right = window.x + window.width, below = window.y + window.height;
    for (int64_t j = window.y >> level; j <= (below - 1 + mask) >> level; j++)
        for (int64_t i = window.x >> level; i <= (right - 1 + mask) >> level; i++) {
            if (scene_patch_known(g, i, j))
                continue;
            int64_t x0 = tl_int64_max(i * unit - mask, window.x), x1 = tl_int64_min((i + 1) * unit, right);
            int64_t y0 = tl_int64_max(j * unit - mask, window.y), y1 = tl_int64_min((j + 1) * unit, below);
            for (int64_t y = y0; y < y1; y++)
                for (int64_t x = x0; x < x1; x++)
                    out[(y - window.y) * stride + x - window.x] = NAN;
        }
}

/* ---- reading ---- */

static tl_status load(void *context, fbm_window window, float *buffer, float *const planes[SCENE_PLANES],
                      tl_error *error)
{
    (void)error;
    const scene_ground *g = context;
    const fbm_window *w = &g->patch.window;
    assert(window.i >= w->i && window.j >= w->j && window.width <= w->width && window.height <= w->height);
    const float *from = g->patch.heights + (size_t)(window.j - w->j) * w->width + (size_t)(window.i - w->i);
    for (size_t row = 0; row < window.height; row++)
        memcpy(buffer + row * window.width, from + row * w->width, window.width * sizeof *buffer);
    scene_planes_cut(&g->planes, window, planes);
    return TL_OK;
}

/* Sigma over delta at an exponent. */
static double unit_at(const field *f, double hurst)
{
    double place = fmin(fmax(100 * hurst - 1, 0), UNITS - 1);
    int at = place < UNITS - 1 ? (int)place : UNITS - 2;
    return f->units[at] + (place - at) * (f->units[at + 1] - f->units[at]);
}

/* The planes of maps: delta, and the exponent where that has a map. */
static tl_status read_maps(const field *f, fbm_window window, scene_planes *out, tl_error *error)
{
    float *delta = out->of[SCENE_STRENGTH], *hurst = out->of[SCENE_HURST];
    const scene_field_map *maps = f->maps;
    tl_status status = scene_field_map_read(&maps[SCENE_STRENGTH], window, delta, error);
    if (status == TL_OK && hurst)
        status = scene_field_map_read(&maps[SCENE_HURST], window, hurst, error);
    for (size_t k = 0; status == TL_OK && k < window.width * window.height; k++) {
        if (hurst) /* bilinear to rounding */
            hurst[k] = fminf(fmaxf(hurst[k], (float)FBM_HURST_MIN), (float)FBM_HURST_MAX);
        double unit = unit_at(f, hurst ? (double)hurst[k] : maps[SCENE_HURST].fallback);
        if (unit != 1)
            delta[k] = (float)((double)delta[k] / unit);
    }
    return status;
}

/* What read_maps makes of one plane. */
static tl_status make_plane(const field *f, fbm_window window, int plane, double *out, tl_error *error)
{
    size_t count = window.width * window.height;
    float *delta = tl_alloc(count, 2 * sizeof *delta);
    if (!delta)
        return tl_fail_memory(error, f->dem->info.name);
    float *hurst = f->chain.placed ? delta + count : NULL;
    scene_planes planes = {window, {[SCENE_STRENGTH] = delta, [SCENE_HURST] = hurst}};
    tl_status status = read_maps(f, window, &planes, error);
    for (size_t k = 0; status == TL_OK && k < count; k++)
        out[k] = (double)planes.of[plane][k];
    free(delta);
    return status;
}

static tl_status make_strengths(const void *context, fbm_window window, double *out, tl_error *error)
{
    return make_plane(context, window, SCENE_STRENGTH, out, error);
}

static tl_status make_hursts(const void *context, fbm_window window, double *out, tl_error *error)
{
    return make_plane(context, window, SCENE_HURST, out, error);
}

/* The planes of maps, what is known of them being kept. */
static tl_status recall_maps(const field *f, fbm_window window, scene_planes *out, tl_error *error)
{
    static const scene_cell_store_make make[SCENE_PLANES] = {
        [SCENE_STRENGTH] = make_strengths, [SCENE_HURST] = make_hursts};
    const char *name = f->dem->info.name;
    const fbm_window wide = scene_cell_store_window(window);
    double *numbers = tl_alloc_grid((int64_t)wide.width, (int64_t)wide.height, sizeof *numbers);
    tl_status status = numbers ? TL_OK : tl_fail_memory(error, name);
    const size_t first = (size_t)(window.j - wide.j) * wide.width + (size_t)(window.i - wide.i);
    for (int p = 0; p < SCENE_PLANES && status == TL_OK; p++) {
        if (!out->of[p])
            continue;
        status = scene_cell_store_read(f->kept[p], wide, make[p], f, numbers, name, error);
        for (size_t row = 0; status == TL_OK && row < window.height; row++)
            for (size_t k = 0; k < window.width; k++)
                out->of[p][row * window.width + k] = (float)numbers[first + row * wide.width + k];
    }
    free(numbers);
    return status;
}

/* What fBm is made with beyond the rim and in voids: what the maps say there, or at their own rims. */
static tl_status read_growth(const void *context, fbm_window window, float *delta, float *hurst, tl_error *error)
{
    const field *f = context;
    scene_planes planes = {window, {[SCENE_STRENGTH] = delta, [SCENE_HURST] = f->chain.placed ? hurst : NULL}};
    for (size_t k = 0; !f->chain.placed && k < window.width * window.height; k++)
        hurst[k] = 0;
    return recall_maps(f, window, &planes, error);
}

static tl_status read_planes(const field *f, fbm_window window, scene_ground *g, tl_error *error)
{
    const char *name = f->dem->info.name;
    g->planes.window = window;
    for (int p = 0; p < SCENE_PLANES; p++)
        if (p == SCENE_STRENGTH || f->chain.placed) {
            g->planes.of[p] = tl_alloc_grid((int64_t)window.width, (int64_t)window.height, sizeof(float));
            if (!g->planes.of[p])
                return tl_fail_memory(error, name);
        }
    if (f->terrain)
        return scene_terrain_strengths(f->terrain, &g->patch, window, g->planes.of[SCENE_STRENGTH], name, error);
    return recall_maps(f, window, &g->planes, error);
}

static scene_growth growth_of(const field *f)
{
    scene_growth growth = f->growth;
    growth.rings = GROWTH + ROW_GROWTH * f->chain.shape.halvings;
    growth.by_place = f->chain.mapped && !f->terrain ? read_growth : NULL;
    growth.context = f;
    return growth;
}

static tl_status ground_read(const field *f, fbm_window window, scene_ground *g, tl_error *error)
{
    *g = (scene_ground){.planes = {.of = {NULL}}};
    fbm_window wide = f->terrain ? scene_widened(window, FBM_ENERGY_MARGIN) : window;
    tl_status status = scene_patch_recall(f->rim, f->dem, growth_of(f), wide, &g->patch, error);
    return status == TL_OK && f->chain.mapped ? read_planes(f, window, g, error) : status;
}

/* For scene_cell_means_run. */
static tl_status read_ground(const void *context, fbm_window window, scene_ground *out, tl_error *error)
{
    return ground_read(context, window, out, error);
}

/* The lattice window, or the window of cells, that a window of samples is. Cell k of an area raster at level l has its
 * centre at (k + 1/2) / 2^l - 1/2 samples, which is that of cell k - 2^(l-1) of the lattice of level l. */
static scene_chain_target target_of(const field *f, int level, tl_window window, float *out, int64_t stride)
{
    bool centres = is_area(f) && level > 0 && !f->chain.steps[0].scheme->cells; /* which go from cells to cells */
    int64_t shift = centres ? (int64_t)1 << (level - 1) : 0;
    return (scene_chain_target){
        .level = level,
        .centres = centres,
        .window = {window.x - shift, window.y - shift, (size_t)window.width, (size_t)window.height, (size_t)stride},
        .out = out};
}

static tl_status read_terrain(const field *f, int level, tl_window window, float *out, int64_t stride, tl_error *error)
{
    scene_patch patch;
    fbm_window target = {window.x, window.y, (size_t)window.width, (size_t)window.height, (size_t)stride};
    tl_status status = scene_terrain_read(f->terrain, f->dem, level, target, out, &patch, error);
    if (status != TL_OK)
        return status;
    if (patch.known)
        cut_voids(&patch, true, level, window, out, stride);
    scene_patch_free(&patch);
    return TL_OK;
}

/* Cells of an area raster whose means are kept. */
static tl_status read_means(const field *f, int level, tl_window window, float *out, int64_t stride, tl_error *error)
{
    const char *name = f->dem->info.name;
    fbm_window target = {window.x, window.y, (size_t)window.width, (size_t)window.height, (size_t)stride};
    fbm_window support = scene_cell_means_support(&f->means, &f->chain, level, target);
    scene_ground g;
    tl_status status = ground_read(f, support, &g, error);
    if (status == TL_OK)
        status = scene_cell_means_run(&f->means, &f->chain, level, target, &g, read_ground, f, out, name, error);
    if (status == TL_OK && g.patch.known)
        cut_voids(&g.patch, true, level, window, out, stride);
    scene_ground_free(&g);
    return status;
}

static tl_status read_block(const field *f, int level, tl_window window, float *out, int64_t stride, tl_error *error)
{
    if (f->terrain && !f->chain.mapped)
        return read_terrain(f, level, window, out, stride, error);
    if (f->means.level)
        return read_means(f, level, window, out, stride, error);
    scene_chain_target target = target_of(f, level, window, out, stride);
    fbm_window support = scene_chain_support(&f->chain, &target);
    support.stride = support.width;
    scene_ground g;
    tl_status status = ground_read(f, support, &g, error);
    if (status == TL_OK)
        status = scene_chain_run(&f->chain, &target, load, &g, f->source.info.name, error);
    if (status == TL_OK && g.patch.known)
        cut_voids(&g.patch, is_area(f), level, window, out, stride);
    scene_ground_free(&g);
    return status;
}

static tl_status field_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const field *f = (const field *)self;
    if (level == 0)
        return tl_source_read(f->dem, 0, window, out, error);
    for (int64_t y = 0; y < window.height; y += BLOCK)
        for (int64_t x = 0; x < window.width; x += BLOCK) {
            tl_window block = {window.x + x, window.y + y, tl_int64_min(BLOCK, window.width - x),
                               tl_int64_min(BLOCK, window.height - y)};
            tl_status status = read_block(f, level, block, out + y * window.width + x, window.width, error);
            if (status != TL_OK)
                return status;
        }
    return TL_OK;
}

/* The least known of the samples that a refined one lies among: see cut_voids. */
static unsigned char least_known(const unsigned char *known, tl_window g, int64_t i, int64_t j, int64_t right,
                                 int64_t below)
{
    const unsigned char *at = known + (j - g.y) * g.width + i - g.x;
    unsigned char least = at[0];
    const unsigned char others[3] = {at[right], at[below * g.width], at[below * g.width + right]};
    for (int k = 0; k < 3; k++)
        least = others[k] < least ? others[k] : least;
    return least;
}

static tl_status field_validity(const tl_source *self, int level, tl_window window, unsigned char *out, tl_error *error)
{
    const field *f = (const field *)self;
    if (window.width == 0 || window.height == 0)
        return TL_OK;
    int64_t mask = is_area(f) ? 0 : ((int64_t)1 << level) - 1;
    tl_window g = {window.x >> level, window.y >> level, 0, 0};
    g.width = ((window.x + window.width - 1 + mask) >> level) + 1 - g.x;
    g.height = ((window.y + window.height - 1 + mask) >> level) + 1 - g.y;
    unsigned char *known = tl_alloc_grid(g.width, g.height, 1);
    if (!known)
        return tl_fail_memory(error, self->info.name);
    tl_status status = tl_source_validity(f->dem, 0, g, known, error);
    for (int64_t k = 0; status == TL_OK && k < window.width * window.height; k++) {
        int64_t x = window.x + k % window.width, y = window.y + k / window.width;
        out[k] = least_known(known, g, x >> level, y >> level, (x & mask) != 0, (y & mask) != 0);
    }
    free(known);
    return status;
}

static int64_t refined_size(int64_t samples, int level, tl_raster_type type)
{
    return type == TL_RASTER_AREA ? samples << level : ((samples - 1) << level) + 1;
}

static tl_status field_size(const tl_source *self, int level, int64_t *width, int64_t *height, tl_error *error)
{
    const field *f = (const field *)self;
    if (level < 0)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no level %d", self->info.name, level);
    *width = refined_size(f->dem->info.width, level, f->source.info.type);
    *height = refined_size(f->dem->info.height, level, f->source.info.type);
    return TL_OK;
}

static void field_destroy(tl_source *self)
{
    field *f = (field *)self;
    tl_crs_release(self->info.georef.crs);
    free(f->parameters);
    free(f->terrain);
    scene_chain_finish(&f->chain);
    scene_cell_means_finish(&f->means);
    for (int p = 0; p < SCENE_PLANES; p++)
        scene_cell_store_destroy(f->kept[p]);
    scene_cell_store_destroy(f->rim);
    scene_cell_store_destroy(f->energies);
    free(f);
}

/* ---- making ---- */

static tl_status too_large(const tl_source *dem, int levels, tl_error *error)
{
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %lld x %lld samples cannot be refined by %d levels; take fewer",
                   dem->info.name, (long long)dem->info.width, (long long)dem->info.height, levels);
}

static tl_status check(const tl_source *dem, const tl_field_options *o, tl_error *error)
{
    const tl_source_info *info = &dem->info;
    if (o->levels < 0 || o->levels > SCENE_LEVEL_MAX)
        return tl_fail(error, TL_ERROR_ARGUMENT, "levels must be from 0 to %d, not %d", SCENE_LEVEL_MAX, o->levels);
    if (o->hurst_given && !(o->hurst >= FBM_HURST_MIN && o->hurst <= FBM_HURST_MAX))
        return tl_fail(error, TL_ERROR_ARGUMENT, "the Hurst exponent must be from 0.01 to 0.99, not %g", o->hurst);
    if (o->delta_given && !(o->delta >= 0 && o->delta <= 1e30))
        return tl_fail(error, TL_ERROR_ARGUMENT, "delta must be from 0 to 1e30, not %g", o->delta);
    bool mapped = o->hurst_map || o->delta_map;
    if (mapped && o->scheme && !strcmp(o->scheme, SCENE_TERRAIN))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "scheme 'terrain' takes no maps of H and delta, it has its own; take 'stationary'");
    int64_t limit = INT64_C(1) << 60; /* coordinates of every level, and of the halo, must fit */
    if (info->level != 0 || info->width > limit >> o->levels || info->height > limit >> o->levels)
        return too_large(dem, o->levels, error);
    return TL_OK;
}

/* The octaves below the DEM. What is not given is predicted from the measurement; of fBm with given delta, an octave
 * has the variance that its details have. */
static void schedule(const field *f, const tl_field_options *o, const tl_roughness *measured, scene_octave *octaves)
{
    scene_predict_octaves(measured, &f->dem->info.georef, octaves, SCENE_LEVEL_MAX + 1);
    bool area = is_area(f);
    double amplitude = o->delta;
    for (int l = 0; l <= SCENE_LEVEL_MAX; l++) {
        double hurst = o->hurst_given ? o->hurst : octaves[l].hurst;
        double unit = sqrt(fbm_detail_of_fbm(fmin(fmax(hurst, FBM_HURST_MIN), FBM_HURST_MAX), area));
        if (l > 0)
            amplitude *= fbm_exp2(-hurst);
        if (!o->delta_given && (l == 0 || !o->hurst_given))
            amplitude = octaves[l].sigma / unit;
        octaves[l] = (scene_octave){.sigma = amplitude * unit, .hurst = hurst};
    }
}

/* Of maps of delta (and of the exponent) the noise has the place's own strength: the octaves are left with what delta
 * 1 gives them. */
static void take_out_delta(field *f, const tl_field_options *o, const tl_roughness *measured, scene_octave *octaves)
{
    double hurst = fmin(fmax(octaves[0].hurst, FBM_HURST_MIN), FBM_HURST_MAX);
    double delta = octaves[0].sigma / sqrt(fbm_detail_of_fbm(hurst, is_area(f)));
    f->maps[SCENE_STRENGTH].fallback = delta;
    f->maps[SCENE_HURST].fallback = hurst;
    tl_field_options one = *o;
    one.delta_given = true;
    one.delta = 1;
    if (!(delta > 0)) {
        schedule(f, &one, measured, octaves);
        return;
    }
    for (int l = 0; l <= SCENE_LEVEL_MAX; l++)
        octaves[l].sigma /= delta;
}

/* Sigma of the octave whose parents are 2 samples apart, for delta 1, at exponents 0.01, 0.02 ... */
static void units_of(field *f, bool sigma)
{
    for (int k = 0; k < UNITS; k++) {
        double hurst = (k + 1) / 100.0;
        f->units[k] = sigma ? fbm_exp2(hurst) * sqrt(fbm_detail_of_fbm(hurst, is_area(f))) : 1;
    }
}

/* Amplitude of the residual filter at each level, and the exponent for its weights: a measured octave of variance
 * sigma^2 is that of fBm whose delta makes it so, at an exponent below 1. */
static tl_status set_steps(field *f, const tl_field_options *o, const scene_octave *octaves, tl_error *error)
{
    double hursts[SCENE_LEVEL_MAX + 1];
    bool area = is_area(f);
    for (int l = 0; l <= SCENE_LEVEL_MAX && l <= o->levels; l++) {
        double model = fmin(fmax(octaves[l].hurst, FBM_HURST_MIN), FBM_HURST_MAX);
        fbm_step *step = &f->chain.steps[l];
        hursts[l] = model;
        step->amplitude = (float)(octaves[l].sigma / sqrt(fbm_detail_of_fbm(model, area)));
        f->deltas[l] = (double)step->amplitude;
        f->hursts[l] = model;
        step->period = f->dem->info.wraps ? f->dem->info.width << l : 0;
        if (l == 0)
            f->growth = (scene_growth){.trend = (float)(fbm_exp2(2 * model - 1) - 1),
                                       .delta = (double)step->amplitude,
                                       .hurst = model,
                                       .aspect = 1,
                                       .seed = o->seed};
    }
    bool terrain = !strcmp(f->scheme, SCENE_TERRAIN);
    if (terrain && area)
        return TL_OK;                                /* not by the chain */
    f->growth.delta = terrain ? 0 : f->growth.delta; /* whose strength goes with the place */
    tl_status status = scene_chain_fit(&f->chain, &f->dem->info, hursts, o->levels, !terrain, error);
    const scene_shape *shape = &f->chain.shape;
    f->growth.aspect = shape->turned ? 1 / shape->aspect : shape->aspect;
    int64_t limit = INT64_C(1) << (58 - f->chain.shape.halvings); /* there are so many rows more, and centres */
    if (status == TL_OK && f->chain.shape.halvings &&
        (f->dem->info.height > limit >> o->levels || f->dem->info.width > limit >> o->levels))
        return too_large(f->dem, o->levels, error);
    return status;
}

/* Lays the maps over the DEM and makes the chain follow them. */
static tl_status open_maps(field *f, const tl_field_options *o, tl_error *error)
{
    const tl_source_info *dem = &f->dem->info;
    scene_field_map *delta = &f->maps[SCENE_STRENGTH], *hurst = &f->maps[SCENE_HURST];
    bool sigma = o->delta_map && o->delta_map_is_sigma;
    units_of(f, sigma);
    f->chain.mapped = true;
    /* real terrain measures above 1 where it is smooth: that is as near as fBm comes */
    const scene_field_map_rule exponents = {"Hurst exponents", 0, 2, FBM_HURST_MIN, FBM_HURST_MAX};
    const scene_field_map_rule strengths = {sigma ? "sigma" : "delta", 0, 1e30, 0, 1e30};
    tl_status status = scene_field_map_open(o->hurst_map, dem, &exponents, hurst->fallback, o->run, hurst, error);
    double known = delta->fallback * (sigma ? unit_at(f, hurst->fallback) : 1);
    if (status == TL_OK)
        status = scene_field_map_open(o->delta_map, dem, &strengths, known, o->run, delta, error);
    for (int l = 0; o->hurst_map && l <= SCENE_LEVEL_MAX; l++) { /* no place has more */
        f->hursts[l] = fmax(hurst->least, FBM_HURST_MIN);
        f->deltas[l] = fbm_exp2(-l * f->hursts[l]);
    }
    f->growth.delta = 1; /* the maps' */
    for (int p = 0; p < SCENE_PLANES && status == TL_OK; p++) {
        f->kept[p] = scene_cell_store_create(dem->width);
        status = f->kept[p] ? TL_OK : tl_fail_memory(error, dem->name);
    }
    return status == TL_OK && o->hurst_map ? scene_chain_fit_places(&f->chain, dem->name, error) : status;
}

static const char *name_alone(const tl_source *map)
{
    const char *slash = strrchr(map->info.name, '/');
    return slash ? slash + 1 : map->info.name;
}

/* The record: pairs of name and value. */
static tl_status note_all(field *f, const tl_field_options *o, const tl_roughness *measured, tl_error *error)
{
    char levels[TL_NUMBER_TEXT], seed[TL_NUMBER_TEXT], hurst[TL_NUMBER_TEXT] = "measured",
                                                       delta[TL_NUMBER_TEXT] = "measured";
    char found[80] = "nothing: too small or too flat, so no detail is added";
    snprintf(levels, sizeof levels, "%d", o->levels);
    snprintf(seed, sizeof seed, "%llu", (unsigned long long)o->seed);
    if (o->hurst_given)
        tl_number_text(o->hurst, hurst);
    if (o->delta_given)
        tl_number_text(o->delta, delta);
    if (measured->measurable)
        snprintf(found, sizeof found, "sigma %.6g, exponent %.4g", measured->sigma, measured->hurst);
    const tl_parameter all[] = {{"levels", levels}, {"scheme", f->scheme}, {"seed", seed},
                                {"hurst", hurst},   {"delta", delta},      {"measured", found}};
    size_t count = sizeof all / sizeof *all - (o->hurst_given && o->delta_given);
    tl_status status = tl_parameters_add_origin(&f->parameters, &f->source.info.parameter_count, &f->dem->info, error);
    for (size_t i = 0; i < count && status == TL_OK; i++)
        status = tl_parameters_add(&f->parameters, &f->source.info.parameter_count, all[i].name, all[i].value, error);
    if (status == TL_OK && o->hurst_map)
        status = tl_parameters_add(&f->parameters, &f->source.info.parameter_count, "hurst_map",
                                   name_alone(o->hurst_map), error);
    if (status == TL_OK && o->delta_map)
        status = tl_parameters_add(&f->parameters, &f->source.info.parameter_count,
                                   o->delta_map_is_sigma ? "sigma_map" : "delta_map", name_alone(o->delta_map), error);
    f->source.info.parameters = f->parameters;
    return status;
}

static void place(field *f, int levels)
{
    tl_source_info *info = &f->source.info;
    const tl_source_info *dem = &f->dem->info;
    double scale = ldexp(1, -levels);
    info->width = refined_size(dem->width, levels, info->type);
    info->height = refined_size(dem->height, levels, info->type);
    info->level = levels;
    info->quantum = levels ? 0 : dem->quantum;
    info->block_width = info->block_height = 0;          /* whatever window is wanted is made */
    info->wraps = dem->wraps && (is_area(f) || !levels); /* points end a cell before the first */
    double *t = info->georef.transform;
    if (is_area(f)) { /* the first cell's centre moves towards the corner */
        double shift = 0.5 * scale - 0.5;
        t[0] += shift * (t[1] + t[2]);
        t[3] += shift * (t[4] + t[5]);
    }
    for (int k = 0; k < 6; k++)
        t[k] *= k % 3 ? scale : 1;
    info->georef.cell_x *= scale;
    info->georef.cell_y *= scale;
}

static tl_status prepare(field *f, const tl_field_options *o, tl_error *error)
{
    bool mapped = o->hurst_map || o->delta_map;
    bool terrain = o->scheme ? !strcmp(o->scheme, SCENE_TERRAIN) : !o->hurst_given && !o->delta_given && !mapped;
    const fbm_scheme *scheme = scene_scheme(terrain ? NULL : o->scheme, error);
    if (!scheme)
        return TL_ERROR_ARGUMENT;
    f->scheme = terrain ? SCENE_TERRAIN : scheme->name;
    if (scheme->cells && !is_area(f))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: scheme '%s' refines cells, and these are points; take --support area, or another scheme",
                       f->dem->info.name, scheme->name);
    if (o->hurst_map && !fbm_scheme_has_places(scheme))
        return tl_fail(error, TL_ERROR_ARGUMENT, "scheme '%s' takes no map of H; take 'stationary'", scheme->name);
    for (int l = 0; l <= SCENE_LEVEL_MAX; l++)
        f->chain.steps[l] = (fbm_step){.scheme = scheme, .seed = o->seed, .level = l};
    scene_detail detail = {.noise = 0};
    tl_status status = TL_OK;
    if (terrain || !(o->hurst_given && o->delta_given))
        status = scene_detail_measure(f->dem, o->run, &detail, error);
    if (status != TL_OK)
        return status;
    tl_roughness measured = scene_roughness_of(&detail, &f->dem->info.georef);
    scene_octave octaves[SCENE_LEVEL_MAX + 1];
    schedule(f, o, &measured, octaves);
    if (mapped)
        take_out_delta(f, o, &measured, octaves);
    status = set_steps(f, o, octaves, error);
    if (status == TL_OK && mapped)
        status = open_maps(f, o, error);
    if (status != TL_OK)
        return status;
    place(f, o->levels);
    if (is_area(f) && !terrain && scheme == fbm_schemes && o->levels > 0)
        status = scene_cell_means_measure(&f->chain, f->dem->info.width, f->dem->info.height / 2, o->levels, &f->means,
                                          f->dem->info.name, error);
    if (status == TL_OK && terrain && o->levels > 0) {
        f->terrain = malloc(sizeof *f->terrain);
        if (!f->terrain)
            return tl_fail_memory(error, f->dem->info.name);
        f->chain.mapped = !is_area(f); /* its samples stay: the lattice is refined */
        status = f->chain.mapped ? scene_terrain_measure_strengths(f->dem, &detail, octaves, o->run, f->terrain, error)
                                 : scene_terrain_measure(f->dem, &detail, octaves, o->levels, o->seed, 0, o->run,
                                                         f->terrain, error);
    }
    if (status == TL_OK && f->terrain && !f->chain.mapped) {
        f->energies = scene_cell_store_create(f->dem->info.width);
        f->terrain->kept_energies = f->energies;
        f->terrain->kept_patches = f->rim;
        status = f->energies ? TL_OK : tl_fail_memory(error, f->dem->info.name);
    }
    return status == TL_OK ? note_all(f, o, &measured, error) : status;
}

tl_source *tl_field_create(const tl_source *dem, const tl_field_options *options, tl_error *error)
{
    static const tl_field_options defaults;
    const tl_field_options *o = options ? options : &defaults;
    if (check(dem, o, error) != TL_OK)
        return NULL;
    field *f = calloc(1, sizeof *f);
    if (!f) {
        tl_fail_memory(error, dem->info.name);
        return NULL;
    }
    f->source = (tl_source){.info = dem->info,
                            .read = field_read,
                            .size = field_size,
                            .validity = field_validity,
                            .destroy = field_destroy};
    if (o->support != TL_SUPPORT_RASTER)
        f->source.info.type = o->support == TL_SUPPORT_AREA ? TL_RASTER_AREA : TL_RASTER_POINT;
    f->source.info.parameter_count = 0; /* the record is its own */
    f->source.info.parameters = NULL;
    f->dem = dem;
    f->rim = scene_cell_store_create(dem->info.width);
    tl_crs_retain(f->source.info.georef.crs);
    if (!f->rim)
        tl_fail_memory(error, dem->info.name);
    else if (prepare(f, o, error) == TL_OK)
        return &f->source;
    field_destroy(&f->source);
    return NULL;
}

/* ---- For those who choose what of it is needed ---- */

static const field *as_field(const tl_source *source)
{
    return source->read == field_read ? (const field *)source : NULL;
}

const tl_source *scene_field_dem(const tl_source *source)
{
    const field *f = as_field(source);
    return f ? f->dem : NULL;
}

bool scene_field_nests(const tl_source *source)
{
    const field *f = as_field(source);
    return f && !is_area(f) && !f->chain.steps[0].scheme->moves;
}

void scene_field_fractal(const tl_source *source, int level, double *delta, double *hurst)
{
    const field *f = as_field(source);
    *delta = f->deltas[level];
    *hurst = f->hursts[level];
}

bool scene_field_has_exponents(const tl_source *source)
{
    return as_field(source)->chain.placed;
}

/* One of the planes at the model's samples; `otherwise` everywhere where the chain has none. */
static tl_status read_plane(const field *f, int plane, bool is_there, float otherwise, tl_window window, float *out,
                            tl_error *error)
{
    size_t count = (size_t)(window.width * window.height);
    for (size_t k = 0; k < count; k++)
        out[k] = otherwise;
    if (!is_there)
        return TL_OK;
    scene_ground g;
    fbm_window from = {window.x, window.y, (size_t)window.width, (size_t)window.height, (size_t)window.width};
    tl_status status = ground_read(f, from, &g, error);
    if (status == TL_OK)
        memcpy(out, g.planes.of[plane], count * sizeof *out);
    scene_ground_free(&g);
    return status;
}

tl_status scene_field_strengths(const tl_source *source, tl_window window, float *out, tl_error *error)
{
    const field *f = as_field(source);
    return read_plane(f, SCENE_STRENGTH, f->chain.mapped, 1, window, out, error);
}

tl_status scene_field_hursts(const tl_source *source, tl_window window, float *out, tl_error *error)
{
    const field *f = as_field(source);
    return read_plane(f, SCENE_HURST, f->chain.placed, (float)f->hursts[f->source.info.level], window, out, error);
}

tl_window scene_field_support(const tl_source *source, int level, tl_window window)
{
    const field *f = as_field(source);
    fbm_window from = {window.x, window.y, (size_t)window.width, (size_t)window.height, (size_t)window.width};
    if (level > 0) {
        scene_chain_target target = target_of(f, level, window, NULL, window.width);
        from = scene_chain_support(&f->chain, &target);
    }
    if (f->terrain)
        from = scene_widened(from, FBM_ENERGY_MARGIN);
    int64_t right = tl_int64_min(from.i + (int64_t)from.width, f->dem->info.width);
    int64_t bottom = tl_int64_min(from.j + (int64_t)from.height, f->dem->info.height);
    tl_window out = {tl_int64_max(from.i, 0), tl_int64_max(from.j, 0), 0, 0};
    out.width = tl_int64_max(right - out.x, 0);
    out.height = tl_int64_max(bottom - out.y, 0);
    return out;
}
