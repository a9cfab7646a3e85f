#include "lib/base/error.h"
#include "lib/base/scan.h"
#include "lib/base/size.h"

#include <math.h>

/* One a band, joined in order: the sum does not depend on threads. */
typedef struct band_range {
    float low, high;
    uint64_t voids;
    double sum;
} band_range;

static void add_heights(void *context, uint64_t band, unsigned worker, const float *heights, size_t count)
{
    (void)worker;
    band_range *range = (band_range *)context + band;
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

static void join_bands(const tl_source_info *info, const band_range *bands, uint64_t count, tl_range *out)
{
    band_range all = {.low = INFINITY, .high = -INFINITY};
    for (uint64_t k = 0; k < count; k++) {
        const band_range *band = &bands[k];
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
    uint64_t count = tl_scan_items(source);
    band_range *bands = tl_alloc(count, sizeof *bands);
    if (!bands)
        return tl_fail_memory(error, source->info.name);
    for (uint64_t k = 0; k < count; k++)
        bands[k] = (band_range){.low = INFINITY, .high = -INFINITY};
    tl_status status = tl_scan(source, run, add_heights, bands, error);
    if (status == TL_OK)
        join_bands(&source->info, bands, count, out);
    free(bands);
    return status;
}
