/* Local maps of a raster's statistics: one window after the other, in blocks of windows that are read once. */
#include "fbm/estimate.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/output.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/out.h"
#include "lib/scene/raster_statistics.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum {
    BANDS = 5,
    SIDE = 8,     /* cells on a side of a block of them, at most */
    REACH = 1024, /* samples that such a block may span */
    MODELS = 15,  /* exponents at which a window's covariance is kept: 0.05, 0.15 ... 1.45 */
    LEAST_DETAILS = 64,
};

static const char band_names[] =
    "1 H, 2 sigma of the finest octave, 3 azimuth of the roughest direction, 4 error of H, "
    "5 increments";

typedef struct mapping {
    const tl_source *source;
    int64_t window, stride;
    int64_t width, height; /* cells */
    int64_t side, columns; /* cells on a side of a block, and blocks in a row */
    float *bands[BANDS];
    fbm_sampling sampling; /* of one window */
    double (*models)[FBM_FIT_VALUES][FBM_FIT_VALUES];
} mapping;

/* ---- one window ---- */

static void measure_lags(const float *heights, size_t side, fbm_moment_table moments)
{
    for (int value = 0; value < FBM_FIT_VALUES; value++)
        fbm_increments_add(heights, side, side, (size_t)1 << (value / FBM_DIRECTIONS), 2, value % FBM_DIRECTIONS, false,
                           &moments[value]);
}

/* Fitted with the covariance of H = 1/2, then with that of what came out. */
static fbm_fit fit_window(const mapping *m, double noise, const fbm_moment_table moments)
{
    fbm_sampling sampling = m->sampling;
    sampling.noise = noise;
    fbm_fit fit = {.hurst = 0.5};
    for (int pass = 0; pass < 2 && fit.refusal != FBM_FIT_SMALL && fit.refusal != FBM_FIT_FLAT; pass++) {
        int model = (int)((fit.hurst - 0.05) * 10 + 0.5);
        model = model < 0 ? 0 : model >= MODELS ? MODELS - 1 : model;
        fbm_fit_increments(&sampling, moments, (const double(*)[FBM_FIT_VALUES])m->models[model], &fit);
    }
    return fit;
}

static double highest_of(const float *heights, size_t count)
{
    double highest = 0;
    for (size_t k = 0; k < count; k++)
        if (fabs((double)heights[k]) > highest && isfinite(heights[k]))
            highest = fabs((double)heights[k]);
    return highest;
}

static double finest_sigma(const float *heights, size_t side, double noise, float *scratch)
{
    fbm_detail octaves[2] = {{0}, {0}};
    fbm_detail_add(heights, side, side, 0, 0, side, side, scratch, octaves);
    const fbm_detail *d = &octaves[0];
    if (d->count < LEAST_DETAILS || !((d->x + d->y + d->mixed) > 4 * noise * (double)d->count))
        return (double)NAN;
    return sqrt(fbm_detail_variance(d, 0, noise));
}

/* heights: the window, and three times as much scratch behind it. */
static void measure_window(const mapping *m, float *heights, float cell[BANDS])
{
    size_t side = (size_t)m->window;
    double noise = scene_noise_of(&m->source->info, highest_of(heights, side * side));
    fbm_moment_table moments;
    memset(moments, 0, sizeof moments);
    measure_lags(heights, side, moments);
    fbm_fit fit = fit_window(m, noise, (const fbm_moments *)moments);
    double sigma = finest_sigma(heights, side, noise, heights + side * side);
    bool known = !scene_refusal_text(fit.refusal, 2);
    cell[0] = known ? (float)fit.hurst : NAN;
    cell[1] = (float)sigma;
    cell[2] = known ? (float)scene_azimuth_of(&m->source->info.georef, fit.angle) : NAN;
    cell[3] = known ? (float)fit.hurst_error : NAN;
    cell[4] = (float)moments[0].count;
}

/* ---- all windows ---- */

static tl_status map_block(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const mapping *m = context;
    int64_t x = (int64_t)item % m->columns * m->side, y = (int64_t)item / m->columns * m->side;
    int64_t across = tl_int64_min(m->side, m->width - x), down = tl_int64_min(m->side, m->height - y);
    tl_window window = {x * m->stride, y * m->stride, (across - 1) * m->stride + m->window,
                        (down - 1) * m->stride + m->window};
    float *block = tl_alloc_grid(window.width, window.height, sizeof *block);
    float *heights = tl_alloc_grid(m->window, m->window, 4 * sizeof *heights);
    tl_status status = block && heights ? scene_read_measured(m->source, window, block, error)
                                        : tl_fail_memory(error, m->source->info.name);
    for (int64_t k = 0; status == TL_OK && k < across * down; k++) {
        int64_t i = k % across, j = k / across;
        for (int64_t row = 0; row < m->window; row++)
            memcpy(heights + row * m->window, block + (j * m->stride + row) * window.width + i * m->stride,
                   (size_t)m->window * sizeof *heights);
        float cell[BANDS];
        measure_window(m, heights, cell);
        for (int b = 0; b < BANDS; b++)
            m->bands[b][(y + j) * m->width + x + i] = cell[b];
    }
    free(block);
    free(heights);
    return status;
}

static tl_status plan(mapping *m, const tl_map_options *o, tl_error *error)
{
    const tl_source_info *info = &m->source->info;
    m->window = o->window ? o->window : 65;
    m->stride = o->stride ? o->stride : 32;
    if (m->window < 33 || m->window > 513 || m->stride < 8 || m->stride > 512)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "a map's window must be from 33 to 513 samples and its stride from 8 to 512, not %lld and %lld",
                       (long long)m->window, (long long)m->stride);
    if (info->width < m->window || info->height < m->window)
        return tl_fail(error, TL_ERROR_DATA, "%s: maps need %lld x %lld samples at least; take a smaller window",
                       info->name, (long long)m->window, (long long)m->window);
    m->width = (info->width - m->window) / m->stride + 1;
    m->height = (info->height - m->window) / m->stride + 1;
    m->side = tl_int64_min(SIDE, tl_int64_max(1, (REACH - m->window) / m->stride));
    m->columns = tl_div_up(m->width, m->side);
    m->sampling = scene_sampling_of(info, 2, 0);
    m->sampling.width = m->sampling.height = (double)m->window;
    double worker = (double)REACH * REACH * sizeof(float) + 4.0 * (double)m->window * (double)m->window * sizeof(float);
    uint64_t blocks = (uint64_t)(m->columns * tl_div_up(m->height, m->side));
    return tl_run_fits(o->run,
                       (double)m->width * (double)m->height * BANDS * sizeof(float) +
                           worker * tl_parallel_workers(o->run, blocks),
                       info->name, "mapping its statistics", error);
}

static tl_status make_models(mapping *m, tl_error *error)
{
    m->models = malloc(MODELS * sizeof *m->models);
    for (int k = 0; m->models && k < MODELS; k++)
        if (!fbm_increment_covariance(&m->sampling, 0.05 + 0.1 * k, m->models[k]))
            return tl_fail_memory(error, m->source->info.name);
    return m->models ? TL_OK : tl_fail_memory(error, m->source->info.name);
}

/* A map's cells are centred on their windows. */
static tl_source_info map_info(const mapping *m)
{
    tl_source_info info = m->source->info;
    double *t = info.georef.transform, middle = 0.5 * ((double)m->window - 1);
    t[0] += middle * (t[1] + t[2]);
    t[3] += middle * (t[4] + t[5]);
    for (int k = 0; k < 6; k++)
        if (k % 3)
            t[k] *= (double)m->stride;
    info.georef.cell_x *= (double)m->stride;
    info.georef.cell_y *= (double)m->stride;
    info.georef.height_unit = 1; /* bands differ in what they count */
    info.width = m->width;
    info.height = m->height;
    info.type = TL_RASTER_AREA;
    info.level = 0;
    info.has_voids = true;
    info.wraps = false;
    info.quantum = 0;
    info.block_width = info.block_height = 0;
    return info;
}

static tl_status add_parameters(const mapping *m, tl_parameter **list, size_t *count, tl_error *error)
{
    char window[32], stride[32];
    snprintf(window, sizeof window, "%lld", (long long)m->window);
    snprintf(stride, sizeof stride, "%lld", (long long)m->stride);
    tl_status status = tl_parameters_add_origin(list, count, &m->source->info, error);
    if (status == TL_OK)
        status = tl_parameters_add(list, count, "bands", band_names, error);
    if (status == TL_OK)
        status = tl_parameters_add(list, count, "map_window", window, error);
    return status == TL_OK ? tl_parameters_add(list, count, "map_stride", stride, error) : status;
}

static tl_status write_bands(const mapping *m, tl_output *output, const tl_write_options *options, tl_error *error)
{
    tl_source_info info = map_info(m);
    tl_parameter *parameters = NULL;
    info.parameter_count = 0;
    tl_status status = add_parameters(m, &parameters, &info.parameter_count, error);
    info.parameters = parameters;
    tl_source *sources[BANDS] = {NULL};
    for (int b = 0; b < BANDS && status == TL_OK; b++) {
        sources[b] = tl_array_source_create(m->bands[b], &info, error);
        if (!sources[b])
            status = error ? error->status : TL_ERROR_MEMORY;
    }
    if (status == TL_OK)
        status = out_geotiff_write_bands((const tl_source *const *)sources, BANDS, output, options, error);
    for (int b = 0; b < BANDS; b++)
        tl_source_destroy(sources[b]);
    free(parameters);
    return status;
}

tl_status tl_statistics_write_maps(const tl_source *source, const char *path, const tl_map_options *options,
                                   tl_error *error)
{
    static const tl_map_options defaults;
    const tl_map_options *o = options ? options : &defaults;
    const tl_write_options write = {.overwrite = o->overwrite, .run = o->run};
    mapping m = {.source = source};
    tl_status status = plan(&m, o, error);
    tl_output *output = status == TL_OK ? tl_output_open(path, o->overwrite, error) : NULL;
    if (status == TL_OK && !output)
        status = error ? error->status : TL_ERROR_IO;
    for (int b = 0; b < BANDS && status == TL_OK; b++) {
        m.bands[b] = tl_alloc_grid(m.width, m.height, sizeof *m.bands[b]);
        if (!m.bands[b])
            status = tl_fail_memory(error, path);
    }
    if (status == TL_OK)
        status = make_models(&m, error);
    if (status == TL_OK)
        status = tl_parallel_for(o->run, (uint64_t)(m.columns * tl_div_up(m.height, m.side)),
                                 (uint64_t)(source->info.width * source->info.height), map_block, &m, error);
    if (status == TL_OK)
        status = write_bands(&m, output, &write, error);
    if (status == TL_OK)
        status = tl_output_commit(output, error);
    else
        tl_output_abort(output);
    for (int b = 0; b < BANDS; b++)
        free(m.bands[b]);
    free(m.models);
    return status;
}
