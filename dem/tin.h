/* The inside of the triangulated irregular network: half-edge collapse on a mesh over a grid, window by window.
 *
 * A collapse takes an inner vertex u away by moving it onto a neighbour v: the star of u, the polygon of triangles
 * around it, becomes a fan of triangles from v. It is made where all of these have a positive area (then they fill the
 * same polygon, without folds) and every sample strictly inside of the polygon is within the limit of its new triangle.
 * Samples on the polygon's edges lie on edges that stay. So a mesh that keeps its bound keeps it. */
#ifndef DEM_TIN_H
#define DEM_TIN_H

#include "lib/talus.h"

/* Triangles are classed by the square of their longest edge in cells: class k holds those below 2^(k+1). */
enum { TL_TIN_CLASSES = 32 };

/* What a collapse is judged by. */
typedef struct tl_tin_ground {
    const float *heights; /* of the whole raster, NaN for voids */
    int64_t width, height;
    double max_error;
    double rounding; /* bound of what double arithmetic rounds on these heights; 0: it is exact */
    /* Where the frame is bent or coordinates are rounded, by class: what the error may reach (below 0: no triangle),
     * and the largest rise in a cell. */
    bool shaped;
    double limit[TL_TIN_CLASSES], rise[TL_TIN_CLASSES];
} tl_tin_ground;

/* The class of a triangle whose longest edge has this square, at least 1. */
static inline int tl_tin_class(int64_t length2)
{
    int log = 63 - __builtin_clzll((unsigned long long)length2);
    return log < TL_TIN_CLASSES ? log : TL_TIN_CLASSES - 1;
}

/* A part of a mesh that is collapsed alone, by one thread; its memory is used again from part to part. */
typedef struct tl_tin_patch tl_tin_patch;

/* For windows of at most side x side samples. NULL when out of memory. */
tl_tin_patch *tl_tin_patch_create(int64_t side);
/* Takes NULL. */
void tl_tin_patch_destroy(tl_tin_patch *patch);

/* Whether vertices need no more tries: shared by patches that work at the same time. */
typedef _Atomic unsigned char tl_tin_mark;

/* Collapses what can be collapsed among `*count` triangles (corners are indices into `vertices`; of positive area with
 * j as the second coordinate), in place. They must lie in `window`, and are tried in the order of its rows. Vertices
 * whose triangles are not all here, or do not go all around, stay. `settled` holds a mark a vertex. */
tl_status tl_tin_patch_run(tl_tin_patch *patch, const tl_tin_ground *ground, const tl_vertex *vertices,
                           tl_tin_mark *settled, tl_window window, uint32_t *triangles, size_t *count, tl_error *error);

/* A mesh in the making. */
typedef struct tl_tin_soup {
    tl_vertex *vertices;
    uint32_t *triangles;
    size_t vertex_count, vertex_room, triangle_count, triangle_room;
} tl_tin_soup;

/* What decides the vertices along the raster's rim, from the rim's samples alone. */
typedef struct tl_tin_rim {
    const float *heights;
    int64_t width, height;
    double max_error;
    int64_t step; /* samples 1 + k step of each side stay, so that no triangle reaches over a line between windows */
    /* Where the frame is bent or coordinates are rounded: by how much an edge of `length` cells may be off for it,
     * where the ground beside it rises by `rise` units of height in a cell, for each side (top, bottom, left, right).
     * NULL: by nothing. */
    double (*sag)(const void *context, int side, double length, double rise);
    const void *context;
} tl_tin_rim;

/* Completes the mesh of the inner raster, without the outermost samples (whose vertices are numbered in the whole), by
 * triangles out to the rim. */
tl_status tl_tin_add_rim(const tl_tin_rim *rim, tl_tin_soup *soup, tl_error *error);

#endif
