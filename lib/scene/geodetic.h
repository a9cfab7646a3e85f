/* A source on the lattices of the geographic tile scheme (EPSG:4326, TMS): what web globes tile by.
 *
 * Level L has 2^(L+1) x 2^L tiles of 64 x 64 cells. Vertex (i, j) of its lattice, counted from the south-western corner
 * of the world, is at longitude -180 + i d, latitude -90 + j d, d = 180 / (64 * 2^L) degrees; it is vertex (2i, 2j) of
 * level L + 1. Columns go around: i and i + 128 * 2^L are the same. */
#ifndef SCENE_GEODETIC_H
#define SCENE_GEODETIC_H

#include "lib/talus.h"

enum { SCENE_TILE_CELLS = 64, SCENE_GEODETIC_DEEPEST = 24 };

/* Cells around the world and from pole to pole. */
static inline int64_t scene_geodetic_columns(int level)
{
    return (int64_t)(2 * SCENE_TILE_CELLS) << level;
}
static inline int64_t scene_geodetic_rows(int level)
{
    return (int64_t)SCENE_TILE_CELLS << level;
}
/* Degrees between vertices. */
static inline double scene_geodetic_step(int level)
{
    return 180.0 / (double)scene_geodetic_rows(level);
}

typedef struct scene_geodetic scene_geodetic;

/* The lattice of `level` over a source whose CRS and place are known; heights become metres. Longitudes are those of
 * Greenwich; the datum's own ellipsoid is taken for WGS 84's. `source` is read through its finest level. */
scene_geodetic *scene_geodetic_create(const tl_source *source, int level, tl_error *error);
void scene_geodetic_destroy(scene_geodetic *lattice);

/* The first level whose cells are no larger than the source's, either way. */
int scene_geodetic_level(const tl_source_info *info);

/* Vertices around all samples: first column and row, and how many; columns may be negative or go beyond the world. */
tl_window scene_geodetic_window(const scene_geodetic *lattice);

/* Heights at the vertices of a window, row by row from the south; NaN where the source has none. Any thread. By
 * Catmull-Rom's cubic through the samples, bilinearly beside voids; up to half a cell beyond the outermost samples of
 * an area raster they are those of the rim. The height of a vertex does not depend on the window. */
tl_status scene_geodetic_read(const scene_geodetic *lattice, tl_window window, float *out, tl_error *error);

/* The largest difference, in metres, between the surface over heights of the lattice (the smallest triangles of the
 * framework's rule, dem/framework.h) and the source's samples under the `cells` cells from vertex (x, y) on; z: the
 * height of that vertex, in rows of `stride`.
 */
tl_status scene_geodetic_compare(const scene_geodetic *lattice, int64_t x, int64_t y, int cells, const float *z,
                                 int64_t stride, double *worst, tl_error *error);

#endif
