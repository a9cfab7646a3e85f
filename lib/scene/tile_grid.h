/* The surface that a perspective draws: one height for each position, smoother with the distance from the eye. */
#ifndef SCENE_TILE_GRID_H
#define SCENE_TILE_GRID_H

#include "lib/scene/pyramid.h"

enum { SCENE_GRID = SCENE_TILE + 3 }; /* vertices of a tile on a side, with one more on each */

/* The ground under a perspective. */
typedef struct scene_ground {
    const scene_pyramid *pyramid;
    double cell_x, cell_y; /* metres */
    double metres;         /* exaggerated metres in one unit of height */
    double eye[2], rise;   /* the eye's position, and its height above (or below) all ground; metres */
    double per_metre;      /* cells of step 0 that a pixel spans at a distance of a metre */
} scene_ground;

/* A tile of one step: the vertices from one before its first to one behind its last. */
typedef struct scene_tile_id {
    int step;
    int64_t column, row;
} scene_tile_id;

/* Cells on each side of a tile: SCENE_TILE, fewer at the raster's end. */
void scene_tile_cells(const scene_pyramid *pyramid, scene_tile_id tile, int *columns, int *rows);
/* Positions east and north of the raster's middle; those outside of the raster repeat the last. */
void scene_tile_positions(const scene_ground *ground, scene_tile_id tile, double x[SCENE_GRID], double y[SCENE_GRID]);
/* Heights in the source's unit, NaN where there are none. `lattices` must hold those from tile.step on. The height at a
 * vertex depends on its position only, not on the tile, so tiles of different steps meet. */
void scene_tile_heights(const scene_ground *ground, const scene_lattice *lattices, scene_tile_id tile, const double *x,
                        const double *y, float heights[SCENE_GRID * SCENE_GRID]);

/* Size of a pixel at a distance of `x`, `y`, in cells of step 0. */
double scene_ground_pixel(const scene_ground *ground, double x, double y);

#endif
