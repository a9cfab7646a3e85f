#include "lib/scene/resample.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

enum {
    BLOCK_SAMPLES = 1024, /* of the source that a block of pixels covers each way, if it is more than one pixel */
    BLOCK_PIXELS = 256,
    READ = 512, /* samples each way that are read at once, from multiples of it: whole tiles of most files */
};

tl_status scene_raster_init(scene_raster *raster, int64_t width, int64_t height, tl_error *error)
{
    *raster = (scene_raster){.width = width, .height = height};
    raster->heights = tl_alloc_grid(width, height, sizeof *raster->heights);
    raster->coverage = tl_alloc_grid(width, height, sizeof *raster->coverage);
    if (raster->heights && raster->coverage)
        return TL_OK;
    scene_raster_finish(raster);
    return tl_fail_memory(error, "the picture");
}

void scene_raster_finish(scene_raster *raster)
{
    free(raster->heights);
    free(raster->coverage);
    raster->heights = NULL;
    raster->coverage = NULL;
}

/* ---- weights of samples in pixels ---- */

/* Weights of the samples first ... first + count - 1 in one pixel. */
typedef struct taps {
    int64_t first;
    int count;
    size_t weights; /* index of the first in kernel.pool */
} taps;

/* Taps of the pixels of one axis. */
typedef struct kernel {
    taps *pixels; /* count 0: the pixel lies outside of the raster */
    double *pool;
} kernel;

static void kernel_finish(kernel *k)
{
    free(k->pixels);
    free(k->pool);
    *k = (kernel){0};
}

/* The integral from a to b of the hat function around 0, which is 1 at 0 and 0 from -1 and 1 on. */
static double hat_integral(double a, double b)
{
    a = fmin(fmax(a, -1), 1);
    b = fmin(fmax(b, -1), 1);
    double below = fmin(b, 0) - fmin(a, 0), above = fmax(b, 0) - fmax(a, 0);
    double left = below > 0 ? below * (1 + (fmin(a, 0) + fmin(b, 0)) / 2) : 0;
    double right = above > 0 ? above * (1 - (fmax(a, 0) + fmax(b, 0)) / 2) : 0;
    return left + right;
}

/* Mean over a box: of whole samples where the box consists of such, else of their linear interpolation, because cutting
 * the outer samples would bend a plane. */
static double box_weight(double centre, double step, double sample)
{
    double low = centre - step / 2, high = centre + step / 2;
    if (step == floor(step) && low + 0.5 == floor(low + 0.5))
        return sample > low && sample < high ? 1 / step : 0;
    return hat_integral(low - sample, high - sample) / step;
}

static double cubic_weight(double distance)
{
    double d = fabs(distance);
    if (d >= 2)
        return 0;
    return d < 1 ? 1 + d * d * (1.5 * d - 2.5) : 2 + d * (-4 + d * (2.5 - 0.5 * d));
}

static double linear_weight(double distance)
{
    double d = fabs(distance);
    return d < 1 ? 1 - d : 0;
}

/* Adds the weight of a sample that may lie outside of the raster: there the heights go on linearly, or, where weights
 * must not be negative, as they end. */
static void add_tap(double *weights, int64_t first, int64_t sample, int64_t samples, double weight, bool linear)
{
    int64_t end = sample < 0 ? 0 : samples - 1;
    if (sample >= 0 && sample < samples) {
        weights[sample - first] += weight;
        return;
    }
    int64_t beyond = sample < 0 ? -sample : sample - end, inner = sample < 0 ? 1 : end - 1;
    bool extend = linear && samples > 1;
    weights[end - first] += extend ? weight * (double)(1 + beyond) : weight;
    if (extend)
        weights[inner - first] -= weight * (double)beyond;
}

static taps taps_of(const scene_axis *axis, int64_t pixel, int64_t samples, bool smooth, size_t at, double *pool)
{
    double centre = axis->origin + axis->step * (double)pixel;
    if (!(centre > -0.5 - 1e-9 && centre < (double)samples - 0.5 + 1e-9))
        return (taps){0};
    bool box = axis->step > 1;
    double reach = box ? axis->step / 2 + 1 : smooth ? 2 : 1;
    int64_t low = (int64_t)ceil(centre - reach), high = (int64_t)floor(centre + reach);
    taps t = {.first = tl_int64_min(tl_int64_max(low, 0), tl_int64_max(samples - 2, 0)), .weights = at};
    t.count =
        (int)(tl_int64_max(tl_int64_min(high, samples - 1), tl_int64_min(t.first + 1, samples - 1)) - t.first + 1);
    memset(pool + at, 0, (size_t)t.count * sizeof *pool);
    for (int64_t sample = low; sample <= high; sample++) {
        double distance = (double)sample - centre;
        double weight = box      ? box_weight(centre, axis->step, (double)sample)
                        : smooth ? cubic_weight(distance)
                                 : linear_weight(distance);
        add_tap(pool + at, t.first, sample, samples, weight, smooth && !box);
    }
    /* a tap of weight 0 would still spread a void */
    while (t.count > 1 && pool[t.weights + (size_t)t.count - 1] == 0)
        t.count--;
    while (t.count > 1 && pool[t.weights] == 0) {
        t.weights++;
        t.first++;
        t.count--;
    }
    return t;
}

static tl_status kernel_init(kernel *k, const scene_axis *axis, int64_t samples, bool smooth, tl_error *error)
{
    size_t most = (size_t)fmin(ceil(axis->step) + 4, (double)samples + 1) + 2, all = 0;
    *k = (kernel){0};
    k->pixels = tl_alloc((size_t)axis->pixels, sizeof *k->pixels);
    k->pool = tl_size_mul(most, (size_t)axis->pixels, &all) ? tl_alloc(all, sizeof *k->pool) : NULL;
    if (!k->pixels || !k->pool) {
        kernel_finish(k);
        return tl_fail_memory(error, "the picture");
    }
    for (int64_t p = 0; p < axis->pixels; p++)
        k->pixels[p] = taps_of(axis, p, samples, smooth, (size_t)p * most, k->pool);
    return TL_OK;
}

/* ---- blocks of pixels ---- */

typedef struct resampling {
    const tl_source *source;
    int level;
    scene_raster *raster;
    kernel smooth[2], safe[2]; /* x and y; `safe` has no negative weights */
    double sharpness[2];       /* pixels a sample, at least 1 */
    int64_t columns, block_width, block_height;
} resampling;

/* The scratch of one block. Sums are kept by pixel. */
typedef struct block {
    tl_window pixels;
    float *heights; /* READ * READ, as read */
    double *rows;   /* READ rows of the block's width: sums along the rows, for one of the kernels */
    double *sums;   /* 3 planes: with the smooth kernel (NaN where a void is near), with the safe one, its weights */
    bool voids;     /* one was met: the safe sums are wanted */
    bool safe;      /* they are being made */
} block;

/* Range of samples that pixels [from, to) of an axis touch; empty (low > high) where all lie outside. */
static void touched(const kernel *k, int64_t from, int64_t to, int64_t *low, int64_t *high)
{
    *low = INT64_MAX;
    *high = -1;
    for (int64_t p = from; p < to; p++) {
        const taps *t = &k->pixels[p];
        if (t->count) {
            *low = tl_int64_min(*low, t->first);
            *high = tl_int64_max(*high, t->first + t->count - 1);
        }
    }
}

typedef enum part { PART_SMOOTH, PART_SAFE, PART_WEIGHT } part;

static double row_sum(const float *row, const double *weights, int64_t count, part what)
{
    double sum = 0;
    if (what == PART_SMOOTH) {
        for (int64_t s = 0; s < count; s++)
            sum += weights[s] * (double)row[s];
        return sum;
    }
    for (int64_t s = 0; s < count; s++)
        if (isfinite(row[s]))
            sum += what == PART_SAFE ? weights[s] * (double)row[s] : weights[s];
    return sum;
}

/* The part of a pixel's taps that lies in [low, low + size): its first tap; how many. */
static int64_t shared(const taps *t, int64_t low, int64_t size, int64_t *skip)
{
    int64_t from = tl_int64_max(t->first, low), to = tl_int64_min(t->first + t->count, low + size);
    *skip = from - t->first;
    return to - from;
}

static void sum_rows(const kernel *k, const block *b, tl_window window, part what)
{
    for (int64_t p = 0; p < b->pixels.width; p++) {
        const taps *t = &k->pixels[b->pixels.x + p];
        int64_t skip, count = shared(t, window.x, window.width, &skip);
        const float *column = b->heights + (t->first + skip - window.x);
        for (int64_t y = 0; y < window.height; y++)
            b->rows[y * b->pixels.width + p] =
                count > 0 ? row_sum(column + y * window.width, k->pool + t->weights + skip, count, what) : 0;
    }
}

static void sum_columns(const kernel *k, const block *b, tl_window window, double *sums)
{
    int64_t width = b->pixels.width;
    for (int64_t p = 0; p < b->pixels.height; p++) {
        const taps *t = &k->pixels[b->pixels.y + p];
        int64_t skip, count = shared(t, window.y, window.height, &skip);
        for (int64_t s = 0; s < count; s++) {
            double weight = k->pool[t->weights + (size_t)(skip + s)];
            const double *row = b->rows + (t->first + skip + s - window.y) * width;
            for (int64_t x = 0; x < width; x++)
                sums[p * width + x] += weight * row[x];
        }
    }
}

static tl_status add_window(const resampling *r, block *b, tl_window window, tl_error *error)
{
    tl_status status = tl_source_read(r->source, r->level, window, b->heights, error);
    if (status != TL_OK)
        return status;
    size_t pixels = (size_t)(b->pixels.width * b->pixels.height), samples = (size_t)(window.width * window.height);
    for (size_t i = 0; i < samples; i++)
        if (!isfinite(b->heights[i])) {
            b->heights[i] = NAN;
            b->voids = true;
        }
    sum_rows(&r->smooth[0], b, window, PART_SMOOTH);
    sum_columns(&r->smooth[1], b, window, b->sums);
    if (!b->safe)
        return TL_OK;
    sum_rows(&r->safe[0], b, window, PART_SAFE);
    sum_columns(&r->safe[1], b, window, b->sums + pixels);
    sum_rows(&r->safe[0], b, window, PART_WEIGHT);
    sum_columns(&r->safe[1], b, window, b->sums + 2 * pixels);
    return TL_OK;
}

static tl_status add_windows(const resampling *r, block *b, tl_error *error)
{
    memset(b->sums, 0, 3 * (size_t)(b->pixels.width * b->pixels.height) * sizeof *b->sums);
    b->safe = b->voids;
    int64_t x0, x1, y0, y1, safe0, safe1;
    touched(&r->smooth[0], b->pixels.x, b->pixels.x + b->pixels.width, &x0, &x1);
    touched(&r->smooth[1], b->pixels.y, b->pixels.y + b->pixels.height, &y0, &y1);
    touched(&r->safe[0], b->pixels.x, b->pixels.x + b->pixels.width, &safe0, &safe1);
    x0 = tl_int64_min(x0, safe0);
    x1 = tl_int64_max(x1, safe1);
    touched(&r->safe[1], b->pixels.y, b->pixels.y + b->pixels.height, &safe0, &safe1);
    y0 = tl_int64_min(y0, safe0);
    y1 = tl_int64_max(y1, safe1);
    tl_status status = TL_OK;
    for (int64_t y = y0; y <= y1 && status == TL_OK; y = (y / READ + 1) * READ)
        for (int64_t x = x0; x <= x1 && status == TL_OK; x = (x / READ + 1) * READ) {
            tl_window window = {x, y, tl_int64_min((x / READ + 1) * READ, x1 + 1) - x,
                                tl_int64_min((y / READ + 1) * READ, y1 + 1) - y};
            status = add_window(r, b, window, error);
        }
    /* the first void of the block: what was summed before lacks the safe sums */
    return status == TL_OK && b->voids && !b->safe ? add_windows(r, b, error) : status;
}

/* Where pixels are smaller than samples, the rim of a void is sharp, half-way between void and valid samples, not a
 * ramp as wide as a cell. */
static float coverage_of(const resampling *r, double weight)
{
    double sharp = fmin(r->sharpness[0], r->sharpness[1]);
    return (float)fmin(fmax((weight - 0.5) * sharp + 0.5, 0), 1);
}

static void conclude(const resampling *r, const block *b)
{
    size_t pixels = (size_t)(b->pixels.width * b->pixels.height);
    for (int64_t y = 0; y < b->pixels.height; y++)
        for (int64_t x = 0; x < b->pixels.width; x++) {
            size_t p = (size_t)(y * b->pixels.width + x);
            size_t at = (size_t)((b->pixels.y + y) * r->raster->width + b->pixels.x + x);
            bool inside = r->smooth[0].pixels[b->pixels.x + x].count && r->smooth[1].pixels[b->pixels.y + y].count;
            double height = b->sums[p], weight = inside;
            if (b->voids) {
                weight = b->sums[2 * pixels + p];
                if (isnan(height) && weight > 0)
                    height = b->sums[pixels + p] / weight;
            }
            float coverage = coverage_of(r, weight);
            r->raster->heights[at] = inside && coverage > 0 ? (float)height : NAN;
            r->raster->coverage[at] = inside && !isnan(height) ? (unsigned char)(coverage * 255 + 0.5f) : 0;
        }
}

static tl_status resample_block(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const resampling *r = context;
    int64_t x = (int64_t)item % r->columns * r->block_width, y = (int64_t)item / r->columns * r->block_height;
    block b = {.pixels = {x, y, tl_int64_min(r->block_width, r->raster->width - x),
                          tl_int64_min(r->block_height, r->raster->height - y)}};
    b.heights = tl_alloc(READ * READ, sizeof *b.heights);
    b.rows = tl_alloc((size_t)(READ * b.pixels.width), sizeof *b.rows);
    b.sums = tl_alloc((size_t)(b.pixels.width * b.pixels.height), 3 * sizeof *b.sums);
    tl_status status = b.heights && b.rows && b.sums ? add_windows(r, &b, error) : tl_fail_memory(error, "the picture");
    if (status == TL_OK)
        conclude(r, &b);
    free(b.heights);
    free(b.rows);
    free(b.sums);
    return status;
}

static int64_t block_pixels(double step)
{
    double pixels = floor(BLOCK_SAMPLES / step);
    return pixels < 1 ? 1 : pixels > BLOCK_PIXELS ? BLOCK_PIXELS : (int64_t)pixels;
}

/* The coarsest level that the pixels can be made of: they are to have two of its samples each way at least, so that the
 * mean of some is still one over the pixel. Levels of points are no means. */
static int coarsest_level(const tl_source *source, const scene_axis *x, const scene_axis *y, int64_t samples[2])
{
    double step = fmin(x->step, y->step);
    int level = source->info.level;
    samples[0] = source->info.width;
    samples[1] = source->info.height;
    for (int halvings = 1; source->info.type == TL_RASTER_AREA && halvings < 62 && ldexp(step, -halvings) >= 2;
         halvings++)
        if (tl_source_size(source, source->info.level - halvings, &samples[0], &samples[1], NULL) == TL_OK)
            level = source->info.level - halvings;
        else
            break;
    return level;
}

/* The same pixels in samples of a coarser level, whose first cell begins where the first sample's does. */
static scene_axis at_level(const scene_axis *axis, int halvings)
{
    return (scene_axis){ldexp(axis->origin + 0.5, -halvings) - 0.5, ldexp(axis->step, -halvings), axis->pixels};
}

tl_status scene_resample(const tl_source *source, const scene_axis *x, const scene_axis *y, const tl_run *run,
                         scene_raster *raster, tl_error *error)
{
    int64_t samples[2];
    resampling r = {.source = source, .raster = raster, .level = coarsest_level(source, x, y, samples)};
    const scene_axis coarse[2] = {at_level(x, source->info.level - r.level), at_level(y, source->info.level - r.level)};
    const scene_axis *axes[2] = {&coarse[0], &coarse[1]};
    tl_status status = TL_OK;
    for (int a = 0; a < 2; a++) {
        r.sharpness[a] = axes[a]->step < 1 ? 1 / axes[a]->step : 1;
        if (status == TL_OK)
            status = kernel_init(&r.smooth[a], axes[a], samples[a], true, error);
        if (status == TL_OK)
            status = kernel_init(&r.safe[a], axes[a], samples[a], false, error);
    }
    if (status == TL_OK) {
        r.block_width = block_pixels(coarse[0].step);
        r.block_height = block_pixels(coarse[1].step);
        r.columns = tl_div_up(x->pixels, r.block_width);
        uint64_t blocks = (uint64_t)(r.columns * tl_div_up(y->pixels, r.block_height));
        uint64_t work = (uint64_t)(fmin((double)samples[0], coarse[0].step * (double)x->pixels) *
                                   fmin((double)samples[1], coarse[1].step * (double)y->pixels));
        status = tl_parallel_for(run, blocks, work, resample_block, &r, error);
    }
    for (int a = 0; a < 2; a++) {
        kernel_finish(&r.smooth[a]);
        kernel_finish(&r.safe[a]);
    }
    return status;
}
