#include "lib/out/mip.h"

#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/out/out.h"

#include <assert.h>
#include <errno.h>
#include <math.h>
#include <string.h>
#include <unistd.h>

enum { BLOCK = OUT_TILE / 2, BLOCK_SAMPLES = BLOCK * BLOCK, BLOCK_BYTES = BLOCK_SAMPLES * (int)sizeof(float) };

static int64_t blocks_across(const struct out_mip_level *level)
{
    return tl_div_up(level->width, BLOCK);
}

static tl_status make_room(out_mip *mip, bool in_memory, const char *path, tl_error *error)
{
    uint64_t end = 0;
    if (!in_memory)
        mip->spool = tl_output_open(path, true, error);
    if (!in_memory && !mip->spool)
        return TL_ERROR_IO;
    for (int k = 1; k < mip->count; k++) {
        struct out_mip_level *level = &mip->levels[k];
        int64_t across = blocks_across(level), down = tl_div_up(level->height, BLOCK);
        level->offset = end;
        end += (uint64_t)across * (uint64_t)down * BLOCK_BYTES;
        if (in_memory)
            level->blocks = tl_alloc_grid(across, down, BLOCK_BYTES);
        if (in_memory && !level->blocks)
            return tl_fail_memory(error, path);
    }
    return TL_OK;
}

tl_status out_mip_init(out_mip *mip, tl_mip kind, int64_t smallest, int64_t width, int64_t height, const tl_run *run,
                       const char *path, tl_error *error)
{
    *mip = (out_mip){.kind = kind, .count = 1};
    mip->levels[0].width = width;
    mip->levels[0].height = height;
    if (kind == TL_MIP_NONE)
        return TL_OK;
    double bytes = (double)width * (double)height * 4 / 3;
    while (width > smallest || height > smallest) {
        width = (width + 1) / 2;
        height = (height + 1) / 2;
        struct out_mip_level *next = &mip->levels[mip->count++];
        next->width = width;
        next->height = height;
    }
    tl_status status = make_room(mip, !run || !run->memory || bytes <= (double)run->memory, path, error);
    if (status != TL_OK)
        out_mip_finish(mip);
    return status;
}

void out_mip_finish(out_mip *mip)
{
    for (int k = 0; k < mip->count; k++)
        free(mip->levels[k].blocks);
    tl_output_abort(mip->spool);
    mip->spool = NULL;
    mip->count = 0;
}

/* The mean of what is known of 2 x 2 samples, fewer at the rim. */
static float mean_of(const float *z, int64_t stride, bool right, bool below)
{
    double sum = 0;
    int count = 0;
    for (int k = 0; k < 4; k++) {
        if ((k & 1 && !right) || (k & 2 && !below))
            continue;
        float height = z[(k & 1) + (k & 2 ? stride : 0)];
        if (!isnan(height)) {
            sum += (double)height;
            count++;
        }
    }
    return count ? (float)(sum / count) : NAN;
}

static void halve(const out_mip *mip, tl_window tile, const float *heights, float *block)
{
    for (int64_t y = 0; y < tile.height; y += 2)
        for (int64_t x = 0; x < tile.width; x += 2) {
            const float *z = heights + y * tile.width + x;
            block[y / 2 * BLOCK + x / 2] =
                mip->kind == TL_MIP_LATTICE ? *z : mean_of(z, tile.width, x + 1 < tile.width, y + 1 < tile.height);
        }
}

tl_status out_mip_add(const out_mip *mip, int level, tl_window tile, const float *heights, tl_error *error)
{
    if (level + 1 >= mip->count)
        return TL_OK;
    assert(tile.x % OUT_TILE == 0 && tile.y % OUT_TILE == 0 && tile.width <= OUT_TILE && tile.height <= OUT_TILE);
    const struct out_mip_level *next = &mip->levels[level + 1];
    size_t index = (size_t)(tile.y / OUT_TILE * blocks_across(next) + tile.x / OUT_TILE);
    if (next->blocks) {
        halve(mip, tile, heights, next->blocks + index * BLOCK_SAMPLES);
        return TL_OK;
    }
    float block[BLOCK_SAMPLES] = {0};
    halve(mip, tile, heights, block);
    return tl_output_write_at(mip->spool, block, sizeof block, next->offset + index * BLOCK_BYTES, error);
}

/* One block of a level; `room` is where it goes if it is not in memory. */
static tl_status find_block(const out_mip *mip, const struct out_mip_level *level, size_t index, float *room,
                            const float **out, tl_error *error)
{
    *out = level->blocks ? level->blocks + index * BLOCK_SAMPLES : room;
    return level->blocks ? TL_OK
                         : tl_output_read_at(mip->spool, room, BLOCK_BYTES, level->offset + index * BLOCK_BYTES, error);
}

tl_status out_mip_read(const out_mip *mip, int level, tl_window tile, float *out, tl_error *error)
{
    const struct out_mip_level *from = &mip->levels[level];
    float room[BLOCK_SAMPLES];
    tl_status status = TL_OK;
    for (int64_t y = 0; y < tile.height && status == TL_OK; y += BLOCK)
        for (int64_t x = 0; x < tile.width && status == TL_OK; x += BLOCK) {
            size_t index = (size_t)((tile.y + y) / BLOCK * blocks_across(from) + (tile.x + x) / BLOCK);
            size_t width = (size_t)tl_int64_min(BLOCK, tile.width - x);
            const float *block;
            status = find_block(mip, from, index, room, &block, error);
            for (int64_t row = 0; status == TL_OK && row < tl_int64_min(BLOCK, tile.height - y); row++)
                memcpy(out + (y + row) * tile.width + x, block + row * BLOCK, width * sizeof *out);
        }
    return status;
}
