#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>

/* Samples that a worker reads at once. Rows are taken in bands of it at most; the bands, and with them the order of
 * summation, depend on the source's size alone. */
enum { BAND_SAMPLES = 1 << 18 };

typedef struct band_range {
    float low, high;
    uint64_t voids;
    double sum;
} band_range;

typedef struct range_job {
    const tl_source *source;
    int64_t band_rows;
    float *scratch; /* BAND_SAMPLES a worker */
    band_range *bands;
} range_job;

static band_range no_samples(void)
{
    return (band_range){.low = INFINITY, .high = -INFINITY};
}

static void add_heights(band_range *range, const float *heights, size_t count)
{
    for (size_t k = 0; k < count; k++) {
        float height = heights[k];
        if (isnan(height)) {
            range->voids++;
            continue;
        }
        range->low = height < range->low ? height : range->low;
        range->high = height > range->high ? height : range->high;
        range->sum += (double)height;
    }
}

/* A band of rows, in pieces of columns where one row alone is too long. */
static tl_status scan_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    range_job *job = context;
    const tl_source_info *info = &job->source->info;
    float *scratch = job->scratch + (size_t)worker * BAND_SAMPLES;
    int64_t y = (int64_t)item * job->band_rows, rows = tl_int64_min(job->band_rows, info->height - y);
    band_range range = no_samples();
    for (int64_t x = 0; x < info->width; x += BAND_SAMPLES) {
        tl_window window = {x, y, tl_int64_min(BAND_SAMPLES, info->width - x), rows};
        tl_status status = tl_source_read(job->source, info->level, window, scratch, error);
        if (status != TL_OK)
            return status;
        add_heights(&range, scratch, (size_t)(window.width * window.height));
    }
    job->bands[item] = range;
    return TL_OK;
}

static void join_bands(const range_job *job, uint64_t count, tl_range *out)
{
    const tl_source_info *info = &job->source->info;
    band_range all = no_samples();
    for (uint64_t k = 0; k < count; k++) {
        const band_range *band = &job->bands[k];
        all.low = band->low < all.low ? band->low : all.low;
        all.high = band->high > all.high ? band->high : all.high;
        all.voids += band->voids;
        all.sum += band->sum;
    }
    uint64_t samples = (uint64_t)info->width * (uint64_t)info->height, valid = samples - all.voids;
    *out = (tl_range){.low = NAN, .high = NAN, .samples = samples, .voids = all.voids, .mean = (double)NAN};
    if (valid) {
        out->low = all.low;
        out->high = all.high;
        out->mean = all.sum / (double)valid;
    }
}

tl_status tl_source_range(const tl_source *source, const tl_run *run, tl_range *out, tl_error *error)
{
    const tl_source_info *info = &source->info;
    range_job job = {.source = source, .band_rows = tl_int64_max(1, BAND_SAMPLES / info->width)};
    uint64_t count = (uint64_t)tl_div_up(info->height, job.band_rows);
    unsigned workers = tl_parallel_workers(run, count);
    job.scratch = tl_alloc((size_t)workers * BAND_SAMPLES, sizeof *job.scratch);
    job.bands = tl_alloc(count, sizeof *job.bands);
    tl_status status = TL_OK;
    if (!job.scratch || !job.bands)
        status = tl_fail_memory(error, info->name);
    else
        status = tl_parallel_for(run, count, (uint64_t)info->width * (uint64_t)info->height, scan_band, &job, error);
    if (status == TL_OK)
        join_bands(&job, count, out);
    free(job.scratch);
    free(job.bands);
    return status;
}
