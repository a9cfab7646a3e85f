/* A refined field whose means over the cells of level 0 are what an area raster says.
 *
 * The chain refines heights at points, the cells' centres. These points are not known; they are chosen such that the
 * means over the cells come out: the raster's own means plus what the means of a field made from them are off, through
 * the inverse of the response of means to points, cut to a few cells. What is left then, a small part, is added as a
 * bump within the cell that vanishes on its rim, so that the field stays continuous. Means are taken at level 5 at
 * most; finer levels change them by 2^(-5 (1 + H)) delta and less. */
#ifndef SCENE_CELL_MEANS_H
#define SCENE_CELL_MEANS_H

#include "lib/scene/cell_store.h"
#include "lib/scene/chain.h"
#include "lib/scene/patch.h"

/* Level 0 in some window: a patch that may reach farther than the window, and planes of the window. */
typedef struct scene_ground {
    scene_patch patch;
    scene_planes planes;
} scene_ground;

void scene_ground_free(scene_ground *ground);

/* Reads it; `out` is to be freed after a failure, too. */
typedef tl_status (*scene_ground_read)(const void *context, fbm_window window, scene_ground *out, tl_error *error);

enum { SCENE_MEANS_REACH = 3, SCENE_MEANS_LEVEL = 4, SCENE_MEANS_EXPONENTS = 9 };

typedef struct scene_cell_means {
    int level; /* at which means are taken, 1 ... SCENE_MEANS_LEVEL */
    /* The first, or where exponents follow the place those of exponents from FBM_HURST_MIN to FBM_HURST_MAX, between
     * which a point's own is linear. */
    bool placed;
    /* What the raster's samples, taken for points, lack of its means; and the points that are chosen. */
    scene_cell_store *lacking, *points;
    double inverses[SCENE_MEANS_EXPONENTS][2 * SCENE_MEANS_REACH + 1][2 * SCENE_MEANS_REACH + 1];
} scene_cell_means;

/* Measures the response of the chain, by an impulse at a row of level 0, for means at level min(levels, 4). `width`:
 * the raster's. scene_cell_means_finish frees what is kept, also after a failure; of one that is all 0 there is
 * nothing. */
tl_status scene_cell_means_measure(const scene_chain *chain, int64_t width, int64_t row, int levels,
                                   scene_cell_means *out, const char *name, tl_error *error);
void scene_cell_means_finish(scene_cell_means *means);
/* The window of level 0 that scene_cell_means_run wants for a window of cells of level `level`. */
fbm_window scene_cell_means_support(const scene_cell_means *means, const scene_chain *chain, int level,
                                    fbm_window window);
/* Makes a window of cells of level `level` > 0 from the ground of that window: the raster's means, and what the chain
 * is to be told. `read` is asked, with `context`, for what else is needed of the same raster and not kept yet. */
tl_status scene_cell_means_run(const scene_cell_means *means, const scene_chain *chain, int level, fbm_window window,
                               const scene_ground *ground, scene_ground_read read, const void *context, float *out,
                               const char *name, tl_error *error);

#endif
