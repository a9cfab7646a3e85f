/* The lattices of a raster at every step of a power of two, for drawing it from near and far. */
#ifndef SCENE_PYRAMID_H
#define SCENE_PYRAMID_H

#include "lib/talus.h"

enum {
    SCENE_TILE = 64, /* cells on a side of a tile of any step */
    SCENE_STEPS = 40,
};

/* A window of the lattice whose vertex i lies at sample min(i * 2^step, last sample) of each axis: all sides of the
 * raster are sides of every lattice. Step 0 is the raster itself; heights of step k + 1 are the means of those of step
 * k around them, with weights 1 2 1, along the sides only of those on the side. NaN where fewer than half are valid. */
typedef struct scene_lattice {
    int64_t width, height; /* vertices of the whole lattice */
    tl_window window;      /* those that are held */
    float *heights;        /* of the window */
} scene_lattice;

/* Lowest and highest height of blocks of the raster; low > high where all is void. */
typedef struct scene_bounds {
    float low, high;
} scene_bounds;

typedef struct scene_pyramid {
    const tl_source *source;
    int base, top;                       /* lattices base ... top are held whole; top has at most one tile */
    scene_lattice lattices[SCENE_STEPS]; /* heights NULL below base */
    int square;                          /* log2 of the samples on a side of the squares in which the source is read */
    int block;                           /* the same of the smallest blocks with bounds */
    int block_levels;
    int64_t block_columns[SCENE_STEPS];
    scene_bounds *bounds[SCENE_STEPS]; /* [k]: of blocks of 2^(block + k) samples */
} scene_pyramid;

/* Reads the source once. It must have at least 2 x 2 samples. The pyramid's memory is bounded: the base has at most
 * 4097 vertices a side. */
tl_status scene_pyramid_init(scene_pyramid *pyramid, const tl_source *source, const tl_run *run, tl_error *error);
void scene_pyramid_finish(scene_pyramid *pyramid);

/* Bounds of the tile (column, row) of a step. */
scene_bounds scene_pyramid_bounds(const scene_pyramid *pyramid, int step, int64_t column, int64_t row);

/* Holds the lattices from `step` to base - 1 for window `w` of lattice `step` and one cell more of each coarser one
 * than it covers, read from the source; lattices[base] and coarser are the pyramid's. Free with scene_near_finish. */
tl_status scene_near_init(scene_lattice lattices[SCENE_STEPS], const scene_pyramid *pyramid, int step, tl_window w,
                          tl_error *error);
void scene_near_finish(scene_lattice lattices[SCENE_STEPS], const scene_pyramid *pyramid);

#endif
