/* A refined field whose means over the cells of level 0 are what an area raster says.
 *
 * The chain refines heights at points, the cells' centres. These points are not known; they are chosen such that the
 * means over the cells come out: the raster's own means plus what the means of a field made from them are off, through
 * the inverse of the response of means to points, cut to a few cells. What is left then, a small part, is added as a
 * bump within the cell that vanishes on its rim, so that the field stays continuous. Means are taken at level 5 at
 * most; finer levels change them by 2^(-5 (1 + H)) delta and less. */
#ifndef SCENE_CELL_MEANS_H
#define SCENE_CELL_MEANS_H

#include "lib/scene/chain.h"
#include "lib/scene/patch.h"

enum { SCENE_MEANS_REACH = 3, SCENE_MEANS_LEVEL = 4, SCENE_MEANS_EXPONENTS = 9 };

typedef struct scene_cell_means {
    int level; /* at which means are taken, 1 ... SCENE_MEANS_LEVEL */
    /* The first, or where exponents follow the place those of exponents from FBM_HURST_MIN to FBM_HURST_MAX, between
     * which a point's own is linear. */
    bool placed;
    double inverses[SCENE_MEANS_EXPONENTS][2 * SCENE_MEANS_REACH + 1][2 * SCENE_MEANS_REACH + 1];
} scene_cell_means;

/* Measures the response of the chain, by an impulse at a row of level 0, for means at level min(levels, 4). */
tl_status scene_cell_means_measure(const scene_chain *chain, int64_t row, int levels, scene_cell_means *out,
                                   const char *name, tl_error *error);
/* The window of level 0 from which scene_cell_means_run makes a window of cells of level `level`. */
fbm_window scene_cell_means_support(const scene_cell_means *means, const scene_chain *chain, int level,
                                    fbm_window window);
/* Makes a window of cells of level `level` > 0 from a patch of that window, the raster's means. `planes`: of the same
 * window, what the chain is to be told. */
tl_status scene_cell_means_run(const scene_cell_means *means, const scene_chain *chain, int level, fbm_window window,
                               const scene_patch *patch, const scene_planes *planes, float *out, const char *name,
                               tl_error *error);

#endif
