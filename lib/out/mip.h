/* Coarser levels of a grid, gathered in memory while the grid is written tile by tile. */
#ifndef OUT_MIP_H
#define OUT_MIP_H

#include "lib/talus.h"

enum { OUT_MIP_LEVELS = 32 };

/* Level k has ceil(size / 2^k) samples each way, down to one. */
typedef struct out_mip {
    tl_mip kind;
    int count; /* of levels, with the grid itself; 1 where there are no coarser ones */
    struct out_mip_level {
        int64_t width, height;
        float *heights; /* NULL for level 0 */
    } levels[OUT_MIP_LEVELS];
} out_mip;

/* Takes a third of the grid's bytes of memory; TL_ERROR_MEMORY where the run may not take that. */
tl_status out_mip_init(out_mip *mip, tl_mip kind, int64_t width, int64_t height, const tl_run *run, const char *name,
                       tl_error *error);
void out_mip_finish(out_mip *mip);
/* Makes what a window of `level`, which begins at even samples, gives of level + 1. Windows of several threads must not
 * overlap. */
void out_mip_add(out_mip *mip, int level, tl_window window, const float *heights);

#endif
