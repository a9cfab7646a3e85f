/* Where the files of a mosaic lie on its lattice. */
#ifndef DEM_MOSAIC_PLAN_H
#define DEM_MOSAIC_PLAN_H

#include "dem/bins.h"

/* A member on the lattice of its layer. One that reaches around the globe may have two places. */
typedef struct dem_placement {
    const tl_source *source;
    size_t member;
    tl_window place;
    bool mirror_x, mirror_y; /* its columns, or rows, run the other way */
} dem_placement;

/* Members whose samples lie on one lattice, the best first. */
typedef struct dem_layer {
    double x0, dx, y0, dy; /* CRS coordinates of the lattice: x0 + dx i, y0 + dy j */
    bool area;
    dem_placement *placements;
    size_t count, room;
    tl_window bounds; /* of the placements */
    dem_bins *bins;   /* of the placements */
    /* Sample (i, j) of the mosaic lies at column c0 + cs i, row r0 + rs j of this lattice. */
    double c0, cs, r0, rs;
    tl_window cover; /* samples of the mosaic that may get a height from here */
} dem_layer;

/* layers[0] is on the mosaic's own lattice, and its placements are in samples of the mosaic. */
typedef struct dem_plan {
    dem_layer *layers;
    size_t count, room;
    dem_bins *covers; /* of layers 1 ... */
    int64_t width, height;
} dem_plan;

/* Places `count` members: the finest lattice is the mosaic's. Fails where they cannot be put together. On failure *out
 * is empty. */
tl_status dem_plan_make(tl_source *const *members, size_t count, dem_plan *out, tl_error *error);
void dem_plan_finish(dem_plan *plan);

#endif
