/* tl_statistics_measure: one pass over the source in blocks, whose sums are merged in order. */
#include "lib/scene/raster_statistics.h"

#include "fbm/elementary.h"
#include "fbm/estimate.h"
#include "fbm/spectrum.h"
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <assert.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

enum {
    WHOLE = 1024, /* a raster no larger on either side is one block */
    BLOCK = 512,
    FIRST_MEANS = 5, /* the means of 2^5 x 2^5 samples are kept for the whole raster: 1/1024 of it, or less */
    LAST_MEANS = 9,
    MEANS_LIMIT = 4 << 20, /* samples */
    LEAST_BLOCKS = 64,     /* of an octave: fewer say nothing of a variance */
    DETAIL_SPAN = 14,
    WINDOWS = 8, /* of the spectrum, along either axis */
};

/* Four a factor of two would be no finer than what they measure. */
static const int lags[] = {1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256};
enum { LAGS = sizeof lags / sizeof *lags, LONGEST = 128 };

/* Sums over a grid, at lags in its own samples. */
typedef struct sums {
    fbm_moments moments[2][LAGS * FBM_DIRECTIONS]; /* by order - 1 */
} sums;

typedef struct block_result {
    sums sums;
    fbm_positions positions;
    fbm_detail octaves[TL_STATISTICS_OCTAVES];
    uint64_t voids;
    double highest; /* magnitude */
} block_result;

typedef struct measuring {
    const tl_source *source;
    int64_t block, columns;
    int64_t stride; /* every so many samples is kept */
    float *sparse;  /* those, NULL: the raster is one block */
    int64_t sparse_width, sparse_height;
    int mean_level;
    float *means; /* of 2^mean_level samples a side, whole cells only; NULL likewise */
    int64_t means_width, means_height;
    block_result total;
} measuring;

tl_status scene_read_measured(const tl_source *source, tl_window window, float *heights, tl_error *error)
{
    tl_status status = tl_source_read(source, source->info.level, window, heights, error);
    if (status != TL_OK || !source->validity)
        return status;
    unsigned char *validity = tl_alloc_grid(window.width, window.height, 1);
    if (!validity)
        return tl_fail_memory(error, source->info.name);
    status = tl_source_validity(source, source->info.level, window, validity, error);
    for (int64_t k = 0; status == TL_OK && k < window.width * window.height; k++)
        if (validity[k] == TL_FILLED)
            heights[k] = NAN;
    free(validity);
    return status;
}

/* ---- one block ---- */

static void add_lags(const float *heights, size_t width, size_t height, int longest, sums *out)
{
    size_t side = width < height ? width : height;
    for (int order = 1; order <= 2; order++)
        for (size_t l = 0; l < LAGS && lags[l] <= longest; l++)
            for (int d = 0; d < FBM_DIRECTIONS; d++)
                if ((size_t)(4 * lags[l]) <= side || lags[l] <= 2)
                    fbm_increments_add(heights, width, height, (size_t)lags[l], order, d, order == 2 && lags[l] <= 8,
                                       &out->moments[order - 1][l * FBM_DIRECTIONS + (size_t)d]);
}

/* Means of 2 x 2 samples, in place; odd last columns and rows are dropped. */
static void halve(float *heights, size_t *width, size_t *height)
{
    size_t w = *width / 2, h = *height / 2;
    for (size_t y = 0; y < h; y++)
        for (size_t x = 0; x < w; x++) {
            const float *a = heights + 2 * y * *width + 2 * x, *b = a + *width;
            heights[y * w + x] = (0.25f * a[0] + 0.25f * a[1]) + (0.25f * b[0] + 0.25f * b[1]);
        }
    *width = w;
    *height = h;
}

/* Octaves first ... last of a grid that holds the children of `first`. `scratch`: 3 floats a sample. */
static void add_octaves(float *heights, size_t width, size_t height, int first, int last, float *scratch,
                        fbm_detail *octaves)
{
    for (int k = first; k <= last && width >= DETAIL_SPAN && height >= DETAIL_SPAN; k++) {
        fbm_detail pair[2] = {{0}, {0}};
        fbm_detail_add(heights, width, height, 0, 0, width, height, scratch, pair);
        octaves[k].x += pair[0].x;
        octaves[k].y += pair[0].y;
        octaves[k].mixed += pair[0].mixed;
        octaves[k].count += pair[0].count;
        halve(heights, &width, &height);
    }
}

static void look(const float *heights, size_t count, block_result *out)
{
    for (size_t k = 0; k < count; k++) {
        double size = fabs((double)heights[k]);
        if (size - size != 0)
            out->voids++;
        else if (size > out->highest)
            out->highest = size;
    }
}

/* Every stride-th column and row of the raster. */
static void keep_sparse(const measuring *m, tl_window w, const float *heights)
{
    for (int64_t y = tl_div_up(w.y, m->stride); y < m->sparse_height && y * m->stride < w.y + w.height; y++)
        for (int64_t x = tl_div_up(w.x, m->stride); x < m->sparse_width && x * m->stride < w.x + w.width; x++)
            m->sparse[y * m->sparse_width + x] = heights[(y * m->stride - w.y) * w.width + x * m->stride - w.x];
}

static void keep_means(const measuring *m, tl_window w, float *heights)
{
    size_t width = (size_t)w.width, height = (size_t)w.height;
    for (int k = 0; k < m->mean_level; k++)
        halve(heights, &width, &height);
    for (size_t y = 0; y < height; y++)
        memcpy(m->means + ((w.y >> m->mean_level) + (int64_t)y) * m->means_width + (w.x >> m->mean_level),
               heights + y * width, width * sizeof *heights);
}

static void measure_heights(const measuring *m, tl_window w, float *heights, size_t samples, block_result *out)
{
    size_t width = (size_t)w.width, height = (size_t)w.height;
    float *copy = heights + samples;
    look(heights, samples, out);
    add_lags(heights, width, height, m->sparse ? LONGEST : lags[LAGS - 1], &out->sums);
    fbm_positions_add(heights, width, height, (uint64_t)w.x, (uint64_t)w.y, &out->positions);
    memcpy(copy, heights, samples * sizeof *copy);
    add_octaves(copy, width, height, 0, m->means ? m->mean_level - 1 : TL_STATISTICS_OCTAVES - 1, copy + samples,
                out->octaves);
    if (!m->sparse)
        return;
    keep_sparse(m, w, heights);
    keep_means(m, w, heights);
}

static void merge_sums(sums *into, const sums *part)
{
    for (int order = 0; order < 2; order++)
        for (size_t k = 0; k < LAGS * FBM_DIRECTIONS; k++)
            fbm_moments_merge(&into->moments[order][k], &part->moments[order][k]);
}

static void merge(block_result *into, const block_result *part)
{
    merge_sums(&into->sums, &part->sums);
    for (size_t k = 0; k < FBM_POSITIONS; k++) {
        into->positions.rows[k] += part->positions.rows[k];
        into->positions.columns[k] += part->positions.columns[k];
        into->positions.count[k] += part->positions.count[k];
    }
    for (size_t k = 0; k < TL_STATISTICS_OCTAVES; k++) {
        into->octaves[k].x += part->octaves[k].x;
        into->octaves[k].y += part->octaves[k].y;
        into->octaves[k].mixed += part->octaves[k].mixed;
        into->octaves[k].count += part->octaves[k].count;
    }
    into->voids += part->voids;
    into->highest = part->highest > into->highest ? part->highest : into->highest;
}

static tl_status measure_block(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)worker;
    measuring *m = context;
    const tl_source_info *info = &m->source->info;
    int64_t x = (int64_t)item % m->columns * m->block, y = (int64_t)item / m->columns * m->block;
    tl_window window = {x, y, tl_int64_min(m->block, info->width - x), tl_int64_min(m->block, info->height - y)};
    size_t samples = (size_t)(window.width * window.height);
    float *heights = tl_alloc(samples, 5 * sizeof *heights);
    block_result *own = calloc(1, sizeof *own);
    tl_status status =
        heights && own ? scene_read_measured(m->source, window, heights, error) : tl_fail_memory(error, info->name);
    if (status == TL_OK) {
        measure_heights(m, window, heights, samples, own);
        if (tl_parallel_wait_turn(loop, item)) { /* sums depend on the order */
            merge(&m->total, own);
            tl_parallel_end_turn(loop, item);
        } else
            status = tl_fail(error, TL_ERROR_CANCELLED, "interrupted");
    }
    free(heights);
    free(own);
    return status;
}

/* ---- the pass ---- */

static tl_status plan(measuring *m, const tl_run *run, tl_error *error)
{
    const tl_source_info *info = &m->source->info;
    int64_t longer = tl_int64_max(info->width, info->height);
    m->block = longer <= WHOLE ? WHOLE : BLOCK;
    m->columns = tl_div_up(info->width, m->block);
    m->stride = tl_div_up(longer, WHOLE);
    double own = (double)m->block * (double)m->block * 5 * sizeof(float) + sizeof(block_result);
    double bytes = own * tl_parallel_workers(run, (uint64_t)(m->columns * tl_div_up(info->height, m->block)));
    if (longer > WHOLE) {
        m->sparse_width = tl_div_up(info->width, m->stride);
        m->sparse_height = tl_div_up(info->height, m->stride);
        m->mean_level = FIRST_MEANS;
        while (m->mean_level < LAST_MEANS &&
               (info->width >> m->mean_level) * (double)(info->height >> m->mean_level) > MEANS_LIMIT)
            m->mean_level++;
        m->means_width = info->width >> m->mean_level;
        m->means_height = info->height >> m->mean_level;
        bytes +=
            4.0 * sizeof(float) *
            ((double)m->sparse_width * (double)m->sparse_height + (double)m->means_width * (double)m->means_height);
    }
    return tl_run_fits(run, bytes, info->name, "measuring its statistics", error);
}

static tl_status allocate(measuring *m, tl_error *error)
{
    if (m->block == WHOLE)
        return TL_OK;
    m->sparse = tl_alloc_grid(m->sparse_width, m->sparse_height, sizeof *m->sparse);
    m->means = tl_alloc_grid(m->means_width, m->means_height, 4 * sizeof *m->means); /* with scratch */
    return m->sparse && m->means ? TL_OK : tl_fail_memory(error, m->source->info.name);
}

static void finish(measuring *m)
{
    free(m->sparse);
    free(m->means);
}

/* ---- what the sums say ---- */

fbm_sampling scene_sampling_of(const tl_source_info *info, int order, double noise)
{
    double x = info->georef.cell_x, y = info->georef.cell_y, unit = sqrt(x * y);
    bool usable = x > 0 && y > 0 && unit > 0 && isfinite(unit) && x / y < 1e6 && y / x < 1e6;
    return (fbm_sampling){.order = order,
                          .area = info->type == TL_RASTER_AREA,
                          .width = (double)info->width,
                          .height = (double)info->height,
                          .cell_x = usable ? x / unit : 1,
                          .cell_y = usable ? y / unit : 1,
                          .noise = noise};
}

double scene_noise_of(const tl_source_info *info, double highest)
{
    double rounding = highest > 0 ? ldexp(1, ilogb(highest) - 23) : 0;
    double step = info->quantum > rounding ? info->quantum : rounding;
    return step * step / 12;
}

static void fitted_moments(const sums *from, int order, fbm_moment_table out)
{
    for (size_t l = 0, to = 0; l < LAGS && to < FBM_FIT_LAGS; l++)
        if (lags[l] == 1 << to) {
            memcpy(out + to * FBM_DIRECTIONS, from->moments[order - 1] + l * FBM_DIRECTIONS,
                   FBM_DIRECTIONS * sizeof *out);
            to++;
        }
}

const char *scene_refusal_text(fbm_refusal refusal, int order)
{
    switch (refusal) {
    case FBM_FIT_SMALL:
        return "too few samples";
    case FBM_FIT_FLAT:
        return "flat, or its increments are hidden by the rounding of heights";
    case FBM_FIT_SMOOTH:
        return order == 1 ? "smoother than any fBm" : NULL; /* its H is good */
    default:
        return NULL;
    }
}

static tl_fbm_estimate estimate_of(const char *name, const fbm_fit *fit, int order)
{
    tl_fbm_estimate e = {.name = name, .refusal = scene_refusal_text(fit->refusal, order)};
    if (e.refusal)
        return e;
    e.hurst = fit->hurst;
    e.hurst_error = fit->hurst_error;
    e.delta_known = fit->refusal == FBM_FIT_GOOD;
    e.delta = fit->delta;
    e.delta_error = fit->delta_error;
    e.misfit = order == 2 ? fit->misfit : 0; /* of first-order increments it is meaningless beside their ridge */
    return e;
}

double scene_azimuth_of(const tl_georef *georef, double angle)
{
    const double *t = georef->transform, degree = 3.14159265358979323846 / 180;
    double along = hypot(t[1], t[4]), down = hypot(t[2], t[5]);
    if (!(along > 0) || !(down > 0))
        return 0;
    double c = cos(angle), s = sin(angle);
    double azimuth = atan2(c * t[1] / along + s * t[2] / down, c * t[4] / along + s * t[5] / down) / degree;
    azimuth = fmod(azimuth + 360, 180);
    return azimuth;
}

static tl_status tell_fits(const tl_source_info *info, const sums *all, tl_statistics *out, tl_error *error)
{
    static const char *const names[] = {"structure", "increments"};
    for (int order = 1; order <= 2; order++) {
        fbm_moment_table moments;
        fbm_fit fit;
        fbm_sampling s = scene_sampling_of(info, order, out->noise);
        fitted_moments(all, order, moments);
        if (!fbm_fit_increments(&s, (const fbm_moments *)moments, NULL, &fit))
            return tl_fail_memory(error, info->name);
        out->estimates[2 - order] = estimate_of(names[order - 1], &fit, order);
        if (order == 2 && !out->estimates[0].refusal) {
            out->anisotropy = fit.anisotropy;
            out->anisotropy_error = fit.anisotropy_error;
            out->isotropy_chance = fit.isotropy_chance;
            out->azimuth = scene_azimuth_of(&info->georef, fit.angle);
        }
    }
    return TL_OK;
}

/* Rounding is not Gaussian: it counts for nothing where it is a 64th of the increments' variance. */
static tl_status tell_normality(const tl_source_info *info, const sums *all, tl_statistics *out, tl_error *error)
{
    fbm_moment_table moments;
    fbm_sampling s = scene_sampling_of(info, 2, out->noise);
    fitted_moments(all, 2, moments);
    for (int lag = 0; lag < FBM_FIT_LAGS && !out->estimates[0].refusal; lag++) {
        const fbm_moments *m = &moments[lag * FBM_DIRECTIONS];
        if (!(m[0].second > 64 * 6 * out->noise * (double)m[0].count) ||
            !(m[1].second > 64 * 6 * out->noise * (double)m[1].count))
            continue;
        fbm_normality n;
        if (!fbm_normality_of(&s, (const fbm_moments *)moments, lag, out->estimates[0].hurst, &n))
            return tl_fail_memory(error, info->name);
        out->normality_lag = n.known ? 1 << lag : 0;
        out->skewness = n.skewness;
        out->skewness_error = n.skewness_error;
        out->kurtosis = n.kurtosis;
        out->kurtosis_error = n.kurtosis_error;
        out->normality_chance = n.chance;
        break;
    }
    return TL_OK;
}

/* Squares vary by 2 + excess kurtosis of their mean's square, 2 for Gaussian increments: heavy tails widen the limit.
 */
static tl_status tell_positions(const fbm_positions *positions, const char *name, tl_statistics *out, tl_error *error)
{
    if (out->estimates[0].refusal)
        return TL_OK;
    double tails = sqrt(fmax(1, 1 + 0.5 * (out->normality_lag == 1 ? out->kurtosis : 0)));
    for (int k = 1; k <= FBM_POSITION_OCTAVES; k++) {
        double limit;
        out->positions[k - 1] = fbm_position_ratio(positions, k, out->estimates[0].hurst, &limit);
        if (out->positions[k - 1] < 0)
            return tl_fail_memory(error, name);
        out->position_limits[k - 1] = limit > 0 ? pow(limit, tails) : 0;
    }
    return TL_OK;
}

static double mean_square(const fbm_moments *m)
{
    return m->count ? m->second / (double)m->count : (double)NAN;
}

static void tell_lags(const sums *s, int64_t stride, int64_t beyond, tl_statistics *out)
{
    for (size_t l = 0; l < LAGS && out->lag_count < TL_STATISTICS_LAGS; l++) {
        const fbm_moments *first = &s->moments[0][l * FBM_DIRECTIONS], *second = &s->moments[1][l * FBM_DIRECTIONS];
        if (lags[l] * stride <= beyond || (!first[0].count && !first[1].count))
            continue;
        tl_lag *lag = &out->lags[out->lag_count++];
        lag->lag = lags[l] * stride;
        for (int d = 0; d < FBM_DIRECTIONS; d++) {
            lag->structure[d] = mean_square(&first[d]);
            lag->second[d] = mean_square(&second[d]);
        }
    }
}

/* The H whose details grow so from octave k to the next: means of 2^k points a side, or cells. */
static double hurst_of_exponent(double exponent, int k, bool area)
{
    if (area || k > 2)
        return exponent >= 0.01 && exponent <= 0.99 ? exponent : (double)NAN;
    int points = 1 << k;
    double low = 0.01, high = 0.99, guess[2] = {low, high}, at[2];
    for (int end = 0; end < 2; end++)
        at[end] = guess[end] +
                  0.5 * log2(fbm_detail_of_means(guess[end], 2 * points) / fbm_detail_of_means(guess[end], points));
    if (exponent < at[0] || exponent > at[1])
        return (double)NAN;
    for (int round = 0; round < 16; round++) {
        double middle = 0.5 * (low + high);
        double there =
            middle + 0.5 * log2(fbm_detail_of_means(middle, 2 * points) / fbm_detail_of_means(middle, points));
        *(there < exponent ? &low : &high) = middle;
    }
    return 0.5 * (low + high);
}

static void tell_octaves(const fbm_detail *octaves, bool area, tl_statistics *out)
{
    for (int k = 0; k < TL_STATISTICS_OCTAVES && octaves[k].count >= LEAST_BLOCKS; k++) {
        tl_octave *o = &out->octaves[out->octave_count++];
        double share = out->noise * ldexp(1, -2 * k); /* a mean of 4^k samples */
        *o = (tl_octave){.cells = ldexp(1, k),
                         .sigma = sqrt(fbm_detail_variance(&octaves[k], 0, share)),
                         .exponent = (double)NAN,
                         .hurst = (double)NAN,
                         .count = octaves[k].count};
        double raw = (octaves[k].x + octaves[k].y + octaves[k].mixed) / (double)octaves[k].count;
        if (!(raw > 4 * share))
            o->sigma = 0;
    }
    for (size_t k = 0; k + 1 < out->octave_count; k++)
        if (out->octaves[k].sigma > 0 && out->octaves[k + 1].sigma > 0) {
            out->octaves[k].exponent = log2(out->octaves[k + 1].sigma / out->octaves[k].sigma);
            out->octaves[k].hurst = hurst_of_exponent(out->octaves[k].exponent, (int)k, area);
        }
}

/* ---- the spectrum ---- */

/* Where the k-th of `count` windows of a side begins, spread over `size` samples. */
static int64_t window_start(int64_t k, int64_t count, int64_t size, int64_t side)
{
    return count > 1 ? (size - side) / (count - 1) * k : (size - side) / 2;
}

static bool all_finite(const float *heights, size_t count)
{
    for (size_t k = 0; k < count; k++)
        if (!isfinite(heights[k]))
            return false;
    return true;
}

static tl_status add_windows(const tl_source *source, int64_t side, double scale, float *heights, double *power,
                             double *windows, tl_error *error)
{
    const tl_source_info *info = &source->info;
    int64_t columns = tl_int64_min(WINDOWS, info->width / side), rows = tl_int64_min(WINDOWS, info->height / side);
    size_t samples = (size_t)(side * side);
    for (int64_t k = 0; k < columns * rows; k++) {
        tl_window window = {window_start(k % columns, columns, info->width, side),
                            window_start(k / columns, rows, info->height, side), side, side};
        tl_status status = scene_read_measured(source, window, heights, error);
        if (status != TL_OK)
            return status;
        if (!all_finite(heights, samples))
            continue;
        if (fbm_spectrum_add(heights, (size_t)side, scale, power) != FBM_OK)
            return tl_fail_memory(error, info->name);
        ++*windows;
    }
    for (size_t k = 0; k<samples && * windows> 0; k++)
        power[k] /= *windows;
    return TL_OK;
}

static tl_status tell_power(const tl_source_info *info, int64_t side, double windows, double scale, const double *power,
                            tl_statistics *out, tl_error *error)
{
    const fbm_sampling s = scene_sampling_of(info, 1, 0);
    fbm_spectrum_fit fit;
    double noise = out->noise * scale * scale;
    fbm_status status = fbm_spectrum_fit_power(power, (size_t)side, windows, s.cell_x, s.cell_y, s.area, noise, &fit);
    if (status != FBM_OK)
        return tl_fail_memory(error, info->name);
    fbm_spectrum_radial(power, (size_t)side, out->power);
    out->wave_count = (size_t)side / 2;
    for (size_t k = 0; k < out->wave_count; k++) {
        out->waves[k] = (double)(k + 1) / (double)side;
        out->power[k] /= scale * scale;
    }
    tl_fbm_estimate *e = &out->estimates[2];
    if (!fit.known) {
        e->refusal = "its spectrum is no power law of fBm";
        return TL_OK;
    }
    *e = (tl_fbm_estimate){.name = e->name,
                           .hurst = fit.hurst,
                           .hurst_error = fit.hurst_error,
                           .delta_known = fit.delta > 0,
                           .delta = fit.delta / scale};
    /* delta is known at wavelengths of a few samples, so what H errs by moves it but little: by its part in the
     * constant of proportionality, of order 1 */
    e->delta_error = e->delta * e->hurst_error * (fit.hurst < 0.99 ? 2 + 0.5 / (1 - fit.hurst) : 0);
    out->slope = 2 * fit.hurst + 2;
    out->slope_error = 2 * fit.hurst_error;
    return TL_OK;
}

static tl_status tell_spectrum(const tl_source *source, tl_statistics *out, tl_error *error)
{
    const tl_source_info *info = &source->info;
    int64_t shorter = tl_int64_min(info->width, info->height), side = FBM_SPECTRUM_SIDE_MAX;
    out->estimates[2] = (tl_fbm_estimate){.name = "spectrum", .refusal = "no window of 32 x 32 samples without voids"};
    double step = out->lag_count ? sqrt(out->lags[0].structure[0]) : 0;
    if (out->estimates[0].refusal || !(step > 0) || !isfinite(step)) {
        out->estimates[2].refusal = out->estimates[0].refusal ? out->estimates[0].refusal : "flat";
        return TL_OK;
    }
    tl_status status = TL_OK;
    float *heights = malloc((size_t)(side * side) * sizeof *heights);
    double *power = malloc((size_t)(side * side) * sizeof *power), windows = 0;
    if (!heights || !power)
        status = tl_fail_memory(error, info->name);
    for (; status == TL_OK && windows == 0 && side >= FBM_SPECTRUM_SIDE_MIN; side /= 2)
        if (side <= shorter) {
            memset(power, 0, (size_t)(side * side) * sizeof *power);
            status = add_windows(source, side, 1 / step, heights, power, &windows, error);
            if (status == TL_OK && windows > 0)
                status = tell_power(info, side, windows, 1 / step, power, out, error);
        }
    free(heights);
    free(power);
    return status;
}

/* ---- all ---- */

static tl_status tell_all(measuring *m, tl_statistics *out, tl_error *error)
{
    const tl_source_info *info = &m->source->info;
    out->samples = (uint64_t)info->width * (uint64_t)info->height;
    out->voids = m->total.voids;
    out->noise = scene_noise_of(info, m->total.highest);
    tell_lags(&m->total.sums, 1, 0, out);
    if (m->sparse) {
        sums *far = calloc(1, sizeof *far);
        if (!far)
            return tl_fail_memory(error, info->name);
        add_lags(m->sparse, (size_t)m->sparse_width, (size_t)m->sparse_height, lags[LAGS - 1], far);
        tell_lags(far, m->stride, LONGEST, out);
        free(far);
        add_octaves(m->means, (size_t)m->means_width, (size_t)m->means_height, m->mean_level, TL_STATISTICS_OCTAVES - 1,
                    m->means + m->means_width * m->means_height, m->total.octaves);
    }
    tl_status status = tell_fits(info, &m->total.sums, out, error);
    if (status == TL_OK)
        status = tell_normality(info, &m->total.sums, out, error);
    if (status == TL_OK)
        status = tell_positions(&m->total.positions, info->name, out, error);
    tell_octaves(m->total.octaves, info->type == TL_RASTER_AREA, out);
    return status == TL_OK ? tell_spectrum(m->source, out, error) : status;
}

tl_status tl_statistics_measure(const tl_source *source, const tl_run *run, tl_statistics *out, tl_error *error)
{
    const tl_source_info *info = &source->info;
    tl_statistics result = {0};
    measuring *m = calloc(1, sizeof *m);
    if (!m)
        return tl_fail_memory(error, info->name);
    m->source = source;
    tl_status status = plan(m, run, error);
    if (status == TL_OK)
        status = allocate(m, error);
    if (status == TL_OK) {
        uint64_t blocks = (uint64_t)(m->columns * tl_div_up(info->height, m->block));
        status = tl_parallel_for(run, blocks, (uint64_t)info->width * (uint64_t)info->height, measure_block, m, error);
    }
    if (status == TL_OK)
        status = tell_all(m, &result, error);
    finish(m);
    free(m);
    if (status == TL_OK)
        *out = result;
    return status;
}

tl_status tl_statistics_expect(const tl_statistics *statistics, const tl_expectation *expected, const char *name,
                               tl_error *error)
{
    const tl_fbm_estimate *e = &statistics->estimates[0];
    double tolerance = expected->tolerance > 0 ? expected->tolerance : 0.05;
    if (!expected->hurst_given && !expected->delta_given)
        return TL_OK;
    if (e->refusal)
        return tl_fail(error, TL_ERROR_DATA, "%s: H cannot be told: %s", name, e->refusal);
    if (expected->hurst_given && !(fabs(e->hurst - expected->hurst) <= tolerance))
        return tl_fail(error, TL_ERROR_DATA, "%s: H is %.4f (standard error %.4f), not within %g of %g", name, e->hurst,
                       e->hurst_error, tolerance, expected->hurst);
    if (!expected->delta_given)
        return TL_OK;
    if (!e->delta_known)
        return tl_fail(error, TL_ERROR_DATA, "%s: delta cannot be told, for H is %.4f (standard error %.4f)", name,
                       e->hurst, e->hurst_error);
    if (!(fabs(e->delta - expected->delta) <= tolerance * expected->delta))
        return tl_fail(error, TL_ERROR_DATA, "%s: delta is %.5g (standard error %.2g), not within %g %% of %g", name,
                       e->delta, e->delta_error, 100 * tolerance, expected->delta);
    return TL_OK;
}
