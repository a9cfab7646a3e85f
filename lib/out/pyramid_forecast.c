/* What a pyramid will be, from some of its blocks, which are made but not written. */
#include "lib/out/tile_pyramid.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { SHARE = 8, LEAST = 16, MOST = 24 /* one block of so many is made, within these numbers */ };

/* Of the time of a block of the deepest lattice, what one of the others takes: 0.57 ... 0.7 are measured. */
static const double upper_share = 0.6;

typedef struct sample {
    double foreseen; /* tiles of the deepest level in the source's box */
    double bytes[OUT_TILE_LEVELS], all_bytes, seconds;
    uint64_t tiles;
} sample;

typedef struct forecast {
    out_pyramid *p;
    size_t count;
    sample samples[MOST];
} forecast;

/* ---- Samples ---- */

size_t out_sample_place(size_t number, size_t count, size_t all)
{
    double golden = 0.6180339887498949 * (double)number, within = golden - floor(golden);
    size_t at = (size_t)(((double)number + within) * (double)all / (double)count);
    return count == all ? number : at < all ? at : all - 1;
}

double out_seconds_of_thread(void)
{
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int64_t overlap(int64_t from, int64_t to, int64_t low, int64_t high)
{
    return tl_int64_max(0, tl_int64_min(to, high) - tl_int64_max(from, low));
}

/* Tiles of the deepest level in a block that the source's box touches; the box may go around the world. */
static double foreseen_in(const out_pyramid *p, const out_block_place *at)
{
    const tl_window w = p->scheme->window(p);
    const int64_t cells = OUT_TILE_CELLS, in_block = SCENE_BLOCK / OUT_TILE_CELLS;
    const int64_t turn = out_blocks_across(p, p->deepest) * in_block;
    int64_t x0 = w.x >= 0 ? w.x / cells : -tl_div_up(-w.x, cells), x1 = (w.x + w.width - 1) / cells + 1, columns = 0;
    int64_t rows = overlap(w.y / cells, (w.y + w.height - 1) / cells + 1, at->row * in_block, (at->row + 1) * in_block);
    for (int k = -1; k <= (p->scheme->roots > 1 ? 1 : 0); k++)
        columns += overlap(x0, x1, at->column * in_block + k * turn, (at->column + 1) * in_block + k * turn);
    return (double)(rows * tl_int64_min(columns, in_block));
}

static tl_status make_sample(void *context, tl_parallel *loop, uint64_t item, unsigned index, tl_error *error)
{
    (void)loop;
    forecast *f = context;
    out_pyramid *p = f->p;
    sample *s = &f->samples[item];
    const out_block_place *at = &p->blocks[out_sample_place(item, f->count, p->block_count)];
    out_piece piece = {.level = p->level, .column = at->column, .row = at->row};
    double before = out_seconds_of_thread();
    if (!p->workers[index] && !(p->workers[index] = out_block_worker_create(p, error)))
        return TL_ERROR_MEMORY;
    tl_status status = out_block_make(p, p->workers[index], at, &piece, error);
    for (size_t k = 0; status == TL_OK && k < piece.tile_count; k++) {
        s->bytes[piece.tiles[k].level] += (double)piece.tiles[k].bytes;
        s->all_bytes += (double)piece.tiles[k].bytes;
        s->tiles += piece.tiles[k].bytes > 0;
    }
    s->seconds = out_seconds_of_thread() - before;
    s->foreseen = foreseen_in(p, at);
    out_piece_finish(&piece);
    return status;
}

static tl_status make_samples(forecast *f, tl_error *error)
{
    out_pyramid *p = f->p;
    tl_run run = out_pyramid_run(p);
    f->count = p->block_count / SHARE;
    f->count = f->count < LEAST ? LEAST : f->count > MOST ? MOST : f->count;
    f->count = f->count > p->block_count ? p->block_count : f->count;
    run.threads = tl_parallel_workers(&run, f->count);
    p->workers = calloc(run.threads, sizeof *p->workers);
    p->worker_count = p->workers ? run.threads : 0;
    p->rehearses = true;
    if (!p->workers)
        return tl_fail_memory(error, p->folder);
    return tl_parallel_for(&run, f->count, f->count, make_sample, f, error);
}

/* ---- What follows from them ---- */

/* Bytes for a tile that was foreseen, so that blocks at the rim count as what they hold; by two standard errors of
 * such a ratio [Cochran, Sampling Techniques, 1977, 6.4], as a share of it. */
static double spread_of(const forecast *f, double foreseen, double bytes)
{
    double n = (double)f->count, all = (double)f->p->block_count, squares = 0;
    if (n == all)
        return 0;
    if (!(bytes > 0) || n < 2)
        return (double)NAN;
    for (size_t k = 0; k < f->count; k++) {
        double off = f->samples[k].all_bytes - bytes / foreseen * f->samples[k].foreseen;
        squares += off * off;
    }
    return 2 * sqrt(squares / (n - 1) / n * (1 - n / all)) / (bytes / n);
}

/* The levels of the deepest lattice by their samples; those above go on falling as these do. */
static void expect_bytes(forecast *f)
{
    out_pyramid *p = f->p;
    double foreseen = 0, bytes[OUT_TILE_LEVELS] = {0}, all = 0;
    for (size_t k = 0; k < f->count; k++) {
        foreseen += f->samples[k].foreseen;
        all += f->samples[k].all_bytes;
        for (int level = 0; level <= p->deepest; level++)
            bytes[level] += f->samples[k].bytes[level];
    }
    double scale = foreseen > 0 ? (double)out_pyramid_foreseen(p, p->deepest) / foreseen : 0, falls = 0.5, last = 0;
    int lowest = p->deepest - 2;
    for (int level = p->deepest; level >= p->options->first_level; level--) {
        if (level == lowest && bytes[level + 1] > 0)
            falls = fmin(fmax(bytes[level] / bytes[level + 1], 0.25), 0.9);
        last = level >= lowest ? bytes[level] * scale : last * falls;
        p->report.levels[level].bytes = (uint64_t)last;
    }
    p->report.forecast.spread = spread_of(f, foreseen, all);
}

/* Blocks of each lattice on all threads, one lattice after the other. */
static tl_status expect_seconds(forecast *f, tl_error *error)
{
    out_pyramid *p = f->p;
    const tl_run run = out_pyramid_run(p);
    unsigned threads = tl_parallel_workers(&run, UINT64_MAX >> 1);
    double block = 0, whole = 0;
    tl_status status = TL_OK;
    for (size_t k = 0; k < f->count; k++) {
        block += f->samples[k].seconds / (double)f->count;
        p->report.forecast.sampled += f->samples[k].tiles;
    }
    whole = block * (double)((p->block_count + threads - 1) / threads);
    while (status == TL_OK && p->level > OUT_ROOT_LATTICE && p->level - 2 > p->options->first_level) {
        status = out_pyramid_go_up(p, error);
        whole += upper_share * block * (double)((p->block_count + threads - 1) / threads);
    }
    p->report.forecast.seconds = whole;
    p->report.forecast.threads = threads;
    return status;
}

tl_status out_pyramid_forecast(out_pyramid *p, tl_error *error)
{
    forecast f = {.p = p};
    p->level = p->deepest;
    tl_status status = make_samples(&f, error);
    if (status != TL_OK)
        return status;
    expect_bytes(&f);
    return expect_seconds(&f, error);
}
