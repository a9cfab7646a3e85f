/* Heights between a source's samples, from a part of them: Catmull-Rom's cubic, bilinear beside voids. Positions are in
 * samples, columns to the right and rows down. */
#ifndef SCENE_SOURCE_PART_H
#define SCENE_SOURCE_PART_H

#include "lib/talus.h"

typedef struct scene_part {
    tl_window window; /* columns of a source that wraps may be beyond it */
    float *z;
} scene_part;

enum { SCENE_PART_MOST = 256 }; /* columns and rows of a grid of positions */

static inline int64_t scene_clamp(int64_t value, int64_t size)
{
    return value < 0 ? 0 : value >= size ? size - 1 : value;
}

/* The samples that n positions (x, y), one after the other, ask for; false: none. */
bool scene_part_find(const tl_source_info *info, size_t n, const double *at, tl_window *out);
/* The same for the grid of columns x and rows y. */
bool scene_part_find_grid(const tl_source_info *info, int64_t columns, const double *x, int64_t rows, const double *y,
                          tl_window *out);
/* Reads part->window into part->z, which has room for it. */
tl_status scene_part_read(const tl_source *source, scene_part *part, tl_error *error);

/* The height at a position for which the part was found; NaN where there is none, as at a position that is NaN. */
float scene_part_height(const scene_part *part, const tl_source_info *info, double x, double y);
/* The same, to the last bit, for a grid: row by row, with `stride` from one to the next. */
void scene_part_heights(const scene_part *part, const tl_source_info *info, int64_t columns, const double *x,
                        int64_t rows, const double *y, float *out, int64_t stride);

#endif
