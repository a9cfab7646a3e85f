#include "lib/scene/roughness.h"

#include "fbm/elementary.h"
#include "fbm/estimate.h"
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

enum {
    BLOCK = 512,
    /* Rasters of more work items than this are measured without the blocks that reach over an item's rim, one in ten,
     * so that nothing is decoded twice. */
    MARGIN_LIMIT = 64,
    MIN_BLOCKS = 64, /* fewer overlapping 2 x 2 blocks than this say nothing of a variance */
};

typedef struct measurement {
    const tl_source *dem;
    int64_t columns;
    bool margins;          /* whether an item sees beyond its rim */
    fbm_detail (*sums)[2]; /* one pair a block of the raster, so that the order of adding is fixed */
} measurement;

/* What was filled into voids is too smooth to tell anything. */
static tl_status drop_filled(const tl_source *dem, tl_window window, float *heights, tl_error *error)
{
    if (!dem->validity)
        return TL_OK;
    unsigned char *validity = tl_alloc_grid(window.width, window.height, 1);
    if (!validity)
        return tl_fail_memory(error, dem->info.name);
    tl_status status = tl_source_validity(dem, dem->info.level, window, validity, error);
    for (int64_t k = 0; status == TL_OK && k < window.width * window.height; k++)
        if (validity[k] == TL_FILLED)
            heights[k] = NAN;
    free(validity);
    return status;
}

static tl_status measure_block(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const measurement *m = context;
    const tl_source_info *info = &m->dem->info;
    int64_t x = (int64_t)item % m->columns * BLOCK, y = (int64_t)item / m->columns * BLOCK;
    int64_t before = m->margins ? FBM_DETAIL_BEFORE : 0, after = m->margins ? FBM_DETAIL_AFTER : 0;
    int64_t x0 = tl_int64_max(0, x - before), x1 = tl_int64_min(info->width, x + BLOCK + after);
    int64_t y0 = tl_int64_max(0, y - before), y1 = tl_int64_min(info->height, y + BLOCK + after);
    tl_window window = {x0, y0, x1 - x0, y1 - y0};
    size_t samples = (size_t)(window.width * window.height);
    float *heights = tl_alloc(samples, 4 * sizeof *heights);
    if (!heights)
        return tl_fail_memory(error, info->name);
    tl_status status = tl_source_read(m->dem, info->level, window, heights, error);
    if (status == TL_OK)
        status = drop_filled(m->dem, window, heights, error);
    if (status == TL_OK)
        fbm_detail_add(heights, (size_t)window.width, (size_t)window.height, (size_t)(x - x0), (size_t)(y - y0),
                       (size_t)(tl_int64_min(x + BLOCK, info->width) - x0),
                       (size_t)(tl_int64_min(y + BLOCK, info->height) - y0), heights + samples, m->sums[item]);
    free(heights);
    return status;
}

static void add(fbm_detail *sum, const fbm_detail *part)
{
    sum->x += part->x;
    sum->y += part->y;
    sum->mixed += part->mixed;
    sum->count += part->count;
}

/* The exponent that real terrain has at this ratio of its finest detail to the cell: fbm/relief.h's rule. */
static double usual_hurst(double ratio)
{
    return 1.191 + .266 * (ratio + 5);
}

/* log2 of a standard deviation to the cell, metres to metres. */
static double ratio_of(double sigma, const tl_georef *georef)
{
    return fbm_log2(sigma * georef->height_unit / sqrt(georef->cell_x * georef->cell_y));
}

tl_roughness scene_roughness_of(const scene_detail *detail, const tl_georef *georef)
{
    const fbm_detail *octaves = detail->octaves;
    tl_roughness result = {0};
    if (octaves[0].count < MIN_BLOCKS)
        return result;
    double finest = sqrt(fbm_detail_variance(&octaves[0], 0, detail->noise)),
           next = sqrt(fbm_detail_variance(&octaves[1], 1, detail->noise));
    bool both = octaves[1].count >= MIN_BLOCKS;
    if (!(finest > 0) || !isfinite(finest) || (both && (!(next > 0) || !isfinite(next))))
        return result;
    result.measurable = true;
    result.sigma = finest;
    result.hurst = both ? fbm_log2(next / finest) : usual_hurst(ratio_of(finest, georef));
    return result;
}

tl_status scene_detail_measure(const tl_source *dem, const tl_run *run, scene_detail *out, tl_error *error)
{
    const tl_source_info *info = &dem->info;
    measurement m = {.dem = dem, .columns = tl_div_up(info->width, BLOCK)};
    int64_t blocks = m.columns * tl_div_up(info->height, BLOCK);
    m.margins = blocks <= MARGIN_LIMIT;
    m.sums = calloc((size_t)blocks, sizeof *m.sums);
    if (!m.sums)
        return tl_fail_memory(error, info->name);
    uint64_t samples = (uint64_t)info->width * (uint64_t)info->height;
    tl_status status = tl_parallel_for(run, (uint64_t)blocks, samples, measure_block, &m, error);
    if (status == TL_OK) {
        *out = (scene_detail){.noise = info->quantum * info->quantum / 12};
        for (int64_t i = 0; i < blocks; i++)
            for (int k = 0; k < 2; k++)
                add(&out->octaves[k], &m.sums[i][k]);
    }
    free(m.sums);
    return status;
}

tl_status tl_roughness_measure(const tl_source *dem, const tl_run *run, tl_roughness *out, tl_error *error)
{
    scene_detail detail;
    tl_status status = scene_detail_measure(dem, run, &detail, error);
    if (status == TL_OK)
        *out = scene_roughness_of(&detail, &dem->info.georef);
    return status;
}

void scene_predict_octaves(const tl_roughness *measured, const tl_georef *georef, scene_octave *octaves, int count)
{
    if (!measured->measurable) {
        memset(octaves, 0, (size_t)count * sizeof *octaves);
        for (int j = 0; j < count; j++)
            octaves[j].hurst = 1;
        return;
    }
    double hurst = measured->hurst, sigma = measured->sigma;
    double ratio = ratio_of(sigma, georef);
    for (int j = 0; j < count; j++) {
        hurst += .276 * (usual_hurst(ratio) - hurst);
        sigma *= fbm_exp2(-hurst);
        ratio += 1 - hurst;
        octaves[j] = (scene_octave){.sigma = sigma, .hurst = hurst};
    }
}
