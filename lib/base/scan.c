#include "lib/base/scan.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

/* Samples that a worker reads at once. Rows are taken in bands of it at most. */
enum { BAND_SAMPLES = 1 << 18 };

typedef struct scan {
    const tl_source *source;
    int64_t band_rows;
    float *scratch; /* BAND_SAMPLES a worker */
    tl_scan_visit *visit;
    void *context;
} scan;

static int64_t rows_of_band(const tl_source *source)
{
    return tl_int64_max(1, BAND_SAMPLES / source->info.width);
}

uint64_t tl_scan_bands(const tl_source *source)
{
    return (uint64_t)tl_div_up(source->info.height, rows_of_band(source));
}

unsigned tl_scan_workers(const tl_source *source, const tl_run *run)
{
    return tl_parallel_workers(run, tl_scan_bands(source));
}

/* A band of rows, in pieces of columns where one row alone is too long. */
static tl_status scan_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    const scan *s = context;
    const tl_source_info *info = &s->source->info;
    float *scratch = s->scratch + (size_t)worker * BAND_SAMPLES;
    int64_t y = (int64_t)item * s->band_rows, rows = tl_int64_min(s->band_rows, info->height - y);
    for (int64_t x = 0; x < info->width; x += BAND_SAMPLES) {
        tl_window window = {x, y, tl_int64_min(BAND_SAMPLES, info->width - x), rows};
        tl_status status = tl_source_read(s->source, info->level, window, scratch, error);
        if (status != TL_OK)
            return status;
        s->visit(s->context, item, worker, scratch, (size_t)(window.width * window.height));
    }
    return TL_OK;
}

tl_status tl_scan(const tl_source *source, const tl_run *run, tl_scan_visit *visit, void *context, tl_error *error)
{
    const tl_source_info *info = &source->info;
    scan s = {.source = source, .band_rows = rows_of_band(source), .visit = visit, .context = context};
    s.scratch = tl_alloc((size_t)tl_scan_workers(source, run) * BAND_SAMPLES, sizeof *s.scratch);
    if (!s.scratch)
        return tl_fail_memory(error, info->name);
    tl_status status = tl_parallel_for(run, tl_scan_bands(source), (uint64_t)info->width * (uint64_t)info->height,
                                       scan_band, &s, error);
    free(s.scratch);
    return status;
}
