#include "lib/out/tile_pyramid.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

/* What a worker takes, as measured, and with room for rougher ground. */
enum { LEAST_WORKER_BYTES = 72 << 20, WORKER_BYTES = 80 << 20 };

/* The bound of a level. A tile has no more than 256 cells on a side: at the top, what the Earth's curve takes of them
 * is more than small bounds allow. */
double out_pyramid_bound(const out_pyramid *p, int level)
{
    double doubled = p->max_error * ldexp(1, p->deepest - level);
    int lattice = level + 2 < p->deepest ? level + 2 : p->deepest;
    int cells_log = 6 + lattice - level;
    return level == p->deepest ? doubled
                               : fmax(doubled, 2 * p->scheme->sag(p, lattice, 2 * (cells_log > 7 ? 1 : 0) + 1));
}

int64_t out_blocks_across(const out_pyramid *p, int level)
{
    return tl_int64_max(((int64_t)p->scheme->roots * OUT_TILE_CELLS << level) / SCENE_BLOCK, 1);
}

int64_t out_blocks_down(int level)
{
    return tl_int64_max(((int64_t)OUT_TILE_CELLS << level) / SCENE_BLOCK, 1);
}

int out_compare_blocks(const void *a, const void *b)
{
    const out_block_place *p = a, *q = b;
    if (p->row != q->row)
        return p->row < q->row ? -1 : 1;
    return (p->column > q->column) - (p->column < q->column);
}

/* ---- Lattices ---- */

static tl_status do_block(void *context, tl_parallel *loop, uint64_t item, unsigned index, tl_error *error)
{
    (void)loop;
    out_pyramid *p = context;
    const out_block_place *at = &p->blocks[item];
    out_piece *piece = &p->pieces[item];
    bool found = false;
    *piece = (out_piece){.level = p->level, .column = at->column, .row = at->row};
    tl_status status = out_piece_load(piece, p->folder, false, &found, error);
    if (status == TL_OK && found && out_block_is_whole(p, piece)) {
        __atomic_add_fetch(&p->report.done_before, 1, __ATOMIC_RELAXED);
        return TL_OK;
    }
    out_piece_finish(piece);
    if (status == TL_OK && p->options->finish && p->level == p->deepest)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: block %lld, %lld is not done; run the shards first", p->folder,
                       (long long)at->column, (long long)at->row);
    if (status == TL_OK && !p->workers[index]) {
        p->workers[index] = out_block_worker_create(p, error);
        status = p->workers[index] ? TL_OK : TL_ERROR_MEMORY;
    }
    if (status == TL_OK)
        status = out_block_make(p, p->workers[index], at, piece, error);
    free(piece->z);
    free(piece->lost);
    piece->z = piece->lost = NULL;
    return status;
}

static tl_status keep_tile(out_pyramid *p, const out_piece_tile *tile, tl_error *error)
{
    if (p->tile_count == p->tile_room) {
        size_t room = 2 * p->tile_room + 256, bytes;
        out_piece_tile *more = tl_size_mul(room, sizeof *more, &bytes) ? realloc(p->tiles, bytes) : NULL;
        if (!more)
            return tl_fail_memory(error, p->folder);
        p->tiles = more;
        p->tile_room = room;
    }
    p->tiles[p->tile_count++] = *tile;
    return TL_OK;
}

/* What the blocks of a lattice have made goes into the list and the report. */
static tl_status take_pieces(out_pyramid *p, tl_error *error)
{
    tl_status status = TL_OK;
    for (size_t b = 0; b < p->block_count; b++) {
        for (size_t k = 0; k < p->pieces[b].tile_count && status == TL_OK; k++) {
            const out_piece_tile *tile = &p->pieces[b].tiles[k];
            tl_tiles_level *level = &p->report.levels[tile->level];
            status = out_tile_list_add(&p->list, tile->level, tile->column, tile->row, error);
            if (status == TL_OK && p->scheme->keeps_tiles)
                status = keep_tile(p, tile, error);
            if (!tile->bytes)
                continue;
            level->tiles++;
            level->triangles += tile->triangles;
            level->vertices += tile->vertices;
            level->bytes += (uint64_t)tile->bytes;
            level->error = fmax(level->error, tile->error);
        }
        p->report.resampling = fmax(p->report.resampling, p->pieces[b].resampling);
        out_piece_finish(&p->pieces[b]);
    }
    out_tile_list_sort(&p->list);
    return status;
}

tl_run out_pyramid_run(const out_pyramid *p)
{
    static const tl_run none;
    tl_run run = p->options->run ? *p->options->run : none;
    unsigned most = tl_parallel_workers(&run, UINT64_MAX >> 1);
    size_t room = run.memory ? run.memory / WORKER_BYTES : most;
    run.threads = room < 1 ? 1 : room < most ? (unsigned)room : most;
    return run;
}

static void free_workers(out_pyramid *p)
{
    for (unsigned k = 0; k < p->worker_count; k++)
        out_block_worker_destroy(p, p->workers[k]);
    free(p->workers);
    p->workers = NULL;
    p->worker_count = 0;
}

static tl_status do_lattice(out_pyramid *p, tl_error *error)
{
    const tl_run run = out_pyramid_run(p);
    if (!p->workers && (p->workers = calloc(tl_parallel_workers(&run, UINT64_MAX >> 1), sizeof *p->workers)))
        p->worker_count = tl_parallel_workers(&run, UINT64_MAX >> 1);
    p->pieces = calloc(p->block_count, sizeof *p->pieces);
    tl_status status = p->workers && p->pieces ? TL_OK : tl_fail_memory(error, p->folder);
    p->report.blocks += p->block_count;
    if (status == TL_OK && p->block_count)
        status = tl_parallel_for(&run, p->block_count, p->block_count * SCENE_BLOCK * SCENE_BLOCK, do_block, p, error);
    if (p->level == p->deepest) /* the others have room for what is lost, too */
        free_workers(p);
    if (status == TL_OK)
        status = take_pieces(p, error);
    for (size_t b = 0; status != TL_OK && p->pieces && b < p->block_count; b++)
        out_piece_finish(&p->pieces[b]);
    free(p->pieces);
    p->pieces = NULL;
    return status;
}

/* ---- Which blocks there are ---- */

static void sort_blocks(out_pyramid *p)
{
    size_t kept = 0;
    if (p->block_count)
        qsort(p->blocks, p->block_count, sizeof *p->blocks, out_compare_blocks);
    for (size_t k = 0; k < p->block_count; k++)
        if (!k || out_compare_blocks(&p->blocks[k], &p->blocks[kept - 1]) != 0)
            p->blocks[kept++] = p->blocks[k];
    p->block_count = kept;
}

static int64_t floor_div(int64_t a, int64_t b)
{
    return a >= 0 ? a / b : -((b - 1 - a) / b);
}

/* Those that the source touches. */
static tl_status list_blocks(out_pyramid *p, tl_error *error)
{
    tl_window window = p->scheme->window(p);
    int64_t across = out_blocks_across(p, p->deepest), down = out_blocks_down(p->deepest);
    int64_t x0 = floor_div(window.x, SCENE_BLOCK), x1 = floor_div(window.x + window.width - 1, SCENE_BLOCK);
    int64_t y0 = floor_div(window.y, SCENE_BLOCK), y1 = floor_div(window.y + window.height - 1, SCENE_BLOCK);
    y1 = tl_int64_min(y1, down - 1);
    x1 = tl_int64_min(x1, x0 + across - 1);
    p->blocks = tl_alloc_grid(x1 - x0 + 1, y1 - y0 + 1, sizeof *p->blocks);
    if (!p->blocks)
        return tl_fail_memory(error, p->folder);
    for (int64_t y = y0; y <= y1; y++)
        for (int64_t x = x0; x <= x1; x++)
            p->blocks[p->block_count++] = (out_block_place){((x % across) + across) % across, y};
    sort_blocks(p);
    return TL_OK;
}

/* Those of the shard. */
static void take_shard(out_pyramid *p)
{
    size_t kept = 0;
    for (size_t k = p->options->shard; k < p->block_count; k += p->options->shards)
        p->blocks[kept++] = p->blocks[k];
    p->block_count = kept;
}

tl_status out_pyramid_go_up(out_pyramid *p, tl_error *error)
{
    free(p->finer);
    p->finer = tl_alloc(p->block_count, sizeof *p->finer);
    p->finer_count = p->finer ? p->block_count : 0;
    if (!p->finer)
        return tl_fail_memory(error, p->folder);
    memcpy(p->finer, p->blocks, p->block_count * sizeof *p->finer);
    int64_t across = out_blocks_across(p, p->level);
    for (size_t k = 0; k < p->block_count; k++) {
        p->blocks[k].column = across > 1 ? p->blocks[k].column / 2 : 0;
        p->blocks[k].row = out_blocks_down(p->level) > 1 ? p->blocks[k].row / 2 : 0;
    }
    sort_blocks(p);
    p->level--;
    return TL_OK;
}

/* ---- The whole ---- */

static tl_status check_options(const tl_tiles_options *o, const char *folder, tl_error *error)
{
    if (!(o->max_error >= 0 && o->max_error <= 1e6) || !(fabs(o->outside) <= 1e5))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: bounds are 0...1e6 m, heights outside within 100 km", folder);
    if (o->shards && (o->shard >= o->shards || o->finish))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: a shard is one of 0 ... %u, and does not finish", folder,
                       o->shards - 1);
    return TL_OK;
}

uint64_t out_pyramid_foreseen(const out_pyramid *p, int level)
{
    const tl_window w = p->scheme->window(p);
    int64_t cells = (int64_t)OUT_TILE_CELLS << (p->deepest - level);
    int64_t across = floor_div(w.x + w.width - 1, cells) - floor_div(w.x, cells) + 1;
    int64_t down = floor_div(w.y + w.height - 1, cells) - floor_div(w.y, cells) + 1;
    if (level == 0 && p->scheme->covers)
        return (uint64_t)p->scheme->roots;
    return (uint64_t)(tl_int64_min(across, (int64_t)p->scheme->roots << level) *
                      tl_int64_min(down, INT64_C(1) << level));
}

static tl_status foresee(out_pyramid *p, tl_error *error)
{
    p->report.blocks = p->block_count;
    for (int level = p->deepest; level >= p->options->first_level; level--)
        p->report.levels[level].tiles = out_pyramid_foreseen(p, level);
    return out_pyramid_forecast(p, error);
}

static tl_status work(out_pyramid *p, tl_error *error)
{
    tl_status status = tl_run_fits(p->options->run, LEAST_WORKER_BYTES, p->source->info.name, "a worker", error);
    if (status == TL_OK)
        status = list_blocks(p, error);
    if (status != TL_OK || p->options->dry_run)
        return status == TL_OK ? foresee(p, error) : status;
    status = out_sum_rows(p->source, &p->sum, error);
    if (status != TL_OK)
        return status;
    char *text = out_describe_job(p);
    if (text && (p->options->resume || p->options->finish) && out_folder_is_complete(p, text)) {
        free(text);
        out_clear_work(p); /* which may not have come to its end */
        p->report.complete = true;
        return TL_OK;
    }
    status = text ? out_begin_folder(p, text, error) : tl_fail_memory(error, p->folder);
    free(text);
    if (status == TL_OK && p->options->shards)
        take_shard(p);
    p->level = p->deepest;
    if (status == TL_OK)
        status = do_lattice(p, error);
    if (status == TL_OK && !p->options->shards && (p->deepest > 0 || !p->scheme->covers) &&
        !p->list.levels[p->deepest].count) {
        out_clear_work(p);
        rmdir(p->folder);
        return tl_fail(error, TL_ERROR_DATA, "%s: no height is known in it; --nodata, --band or --voids may help",
                       p->source->info.name);
    }
    while (status == TL_OK && !p->options->shards && p->level > OUT_ROOT_LATTICE &&
           p->level - 2 > p->options->first_level) {
        status = out_pyramid_go_up(p, error);
        if (status == TL_OK)
            status = do_lattice(p, error);
    }
    if (status != TL_OK || p->options->shards)
        return status;
    status = p->scheme->finish(p, error);
    if (status != TL_OK)
        return status;
    out_clear_work(p);
    p->report.complete = true;
    return TL_OK;
}

tl_status out_pyramid_make(out_pyramid *p, tl_error *error)
{
    tl_status status = check_options(p->options, p->folder, error);
    p->report.first_level = p->options->first_level;
    p->report.last_level = p->deepest;
    return status == TL_OK ? work(p, error) : status;
}

void out_pyramid_finish(out_pyramid *p)
{
    free_workers(p);
    out_tile_list_finish(&p->list);
    free(p->tiles);
    free(p->blocks);
    free(p->finer);
}
