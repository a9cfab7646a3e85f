#include "lib/base/scan.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

/* Samples that a worker reads at once. */
enum { PIECE_SAMPLES = 1 << 18, ITEM_SIDE = 512 };

typedef struct scan {
    const tl_source *source;
    float *scratch; /* PIECE_SAMPLES a worker */
    tl_scan_visit *visit;
    void *context;
} scan;

/* The least multiple of a block's side that is not below ITEM_SIDE. */
static int64_t side_of_item(int64_t block)
{
    return block * tl_div_up(ITEM_SIDE, block);
}

/* What one item is: blocks of the source where it has blocks that are not whole rows, else a band of rows. */
static void item_size(const tl_source *source, int64_t *width, int64_t *height)
{
    const tl_source_info *info = &source->info;
    bool blocks = info->block_width > 0 && info->block_width < info->width && info->block_height > 0;
    *width = blocks ? side_of_item(info->block_width) : info->width;
    *height = blocks ? side_of_item(info->block_height) : tl_int64_max(1, PIECE_SAMPLES / info->width);
}

uint64_t tl_scan_items(const tl_source *source)
{
    int64_t width, height;
    item_size(source, &width, &height);
    return (uint64_t)(tl_div_up(source->info.width, width) * tl_div_up(source->info.height, height));
}

unsigned tl_scan_workers(const tl_source *source, const tl_run *run)
{
    return tl_parallel_workers(run, tl_scan_items(source));
}

/* An item, in pieces of rows, and of columns where one row alone is too long. */
static tl_status scan_item(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    const scan *s = context;
    const tl_source_info *info = &s->source->info;
    float *scratch = s->scratch + (size_t)worker * PIECE_SAMPLES;
    int64_t width, height, columns;
    item_size(s->source, &width, &height);
    columns = tl_div_up(info->width, width);
    int64_t x0 = (int64_t)item % columns * width, x1 = tl_int64_min(x0 + width, info->width);
    int64_t y0 = (int64_t)item / columns * height, y1 = tl_int64_min(y0 + height, info->height);
    int64_t piece_width = tl_int64_min(x1 - x0, PIECE_SAMPLES), piece_height = PIECE_SAMPLES / piece_width;
    for (int64_t y = y0; y < y1; y += piece_height)
        for (int64_t x = x0; x < x1; x += piece_width) {
            tl_window window = {x, y, tl_int64_min(piece_width, x1 - x), tl_int64_min(piece_height, y1 - y)};
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
    scan s = {.source = source, .visit = visit, .context = context};
    s.scratch = tl_alloc((size_t)tl_scan_workers(source, run) * PIECE_SAMPLES, sizeof *s.scratch);
    if (!s.scratch)
        return tl_fail_memory(error, info->name);
    tl_status status = tl_parallel_for(run, tl_scan_items(source), (uint64_t)info->width * (uint64_t)info->height,
                                       scan_item, &s, error);
    free(s.scratch);
    return status;
}
