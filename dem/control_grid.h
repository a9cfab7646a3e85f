/* Smooth functions over a raster, interpolated from a coarse grid of their values with a stated error: for coordinates
 * of a million samples, where the exact formulas give a million a second. */
#ifndef DEM_CONTROL_GRID_H
#define DEM_CONTROL_GRID_H

#include "lib/talus.h"

enum { DEM_CONTROL_COMPONENTS = 6 }; /* at most */

typedef struct dem_control_function {
    size_t components;
    /* Values at n sample positions, `components` a position. */
    void (*evaluate)(void *context, size_t n, const double *i, const double *j, double *out);
    void *context;
    double weights[DEM_CONTROL_COMPONENTS]; /* what an error of 1 in a component counts */
    double tolerance;                       /* of the sum of the weighted components' errors */
} dem_control_function;

typedef struct dem_control_grid dem_control_grid;

/* A grid over the samples of a window, fine enough that in the middles of its cells the error is below half of the
 * tolerance; between them the error of bicubic interpolation is at most 1.07 times as large (t(t-1)(t-2)(t-3) is 1 at
 * its greatest, 15/16 in the middle of an outer cell). *out becomes NULL where that would take more than `budget`
 * evaluations, or where the function is not finite: use the function itself. */
tl_status dem_control_grid_create(const dem_control_function *function, tl_window window, size_t budget,
                                  dem_control_grid **out, tl_error *error);
void dem_control_grid_destroy(dem_control_grid *grid);
/* Values at n positions in the window. Fast where neighbours in the list are neighbours in a row; the values do not
 * depend on the order. Any number of threads may share a grid. */
void dem_control_grid_apply(const dem_control_grid *grid, size_t n, const double *i, const double *j, double *out);
/* The largest error that was found in the cells' middles. */
double dem_control_grid_error(const dem_control_grid *grid);

#endif
