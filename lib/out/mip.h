/* Coarser levels of a grid, gathered while the grid is written tile by tile: in memory, or in a file without a name
 * where memory is short. */
#ifndef OUT_MIP_H
#define OUT_MIP_H

#include "lib/base/output.h"
#include "lib/talus.h"

enum { OUT_MIP_LEVELS = 32 };

/* Level k has ceil(size / 2^k) samples each way. */
typedef struct out_mip {
    tl_mip kind;
    int count; /* of levels, with the grid itself; 1 where there are no coarser ones */
    struct out_mip_level {
        int64_t width, height;
        float *blocks;   /* what a tile of the finer level gives, block by block; NULL for level 0 and in a file */
        uint64_t offset; /* of the blocks in the file */
    } levels[OUT_MIP_LEVELS];
    tl_output *spool; /* the file, never to get a name; NULL: in memory */
} out_mip;

/* Levels down to one of at most `smallest` samples each way. They take a third of the grid's bytes: of memory where the
 * run may take that, else of disk, beside `path`. */
tl_status out_mip_init(out_mip *mip, tl_mip kind, int64_t smallest, int64_t width, int64_t height, const tl_run *run,
                       const char *path, tl_error *error);
void out_mip_finish(out_mip *mip);
/* Makes what a tile (see out_tile_window) of `level` gives of level + 1. From any thread, for each tile once. */
tl_status out_mip_add(const out_mip *mip, int level, tl_window tile, const float *heights, tl_error *error);
/* The heights of a tile of a level above 0, when all tiles of the level below were added. */
tl_status out_mip_read(const out_mip *mip, int level, tl_window tile, float *out, tl_error *error);

#endif
