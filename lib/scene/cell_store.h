/* Numbers of cells of level 0 that take long to make, kept for the next window that asks for them. Neighbouring windows
 * of a fine level ask for much the same cells. */
#ifndef SCENE_CELL_STORE_H
#define SCENE_CELL_STORE_H

#include "fbm/window.h"
#include "lib/talus.h"

typedef struct scene_cell_store scene_cell_store;

/* Makes the numbers of a window, row by row without gaps. A cell's must not depend on the window. */
typedef tl_status (*scene_cell_store_make)(const void *context, fbm_window window, double *out, tl_error *error);

/* For a raster of this width; 9 MB at most, as they are needed. NULL where there is no memory. */
scene_cell_store *scene_cell_store_create(int64_t width);
void scene_cell_store_destroy(scene_cell_store *store);
/* The least window around `window` that a store keeps: of whole blocks. */
fbm_window scene_cell_store_window(fbm_window window);
/* The numbers of such a window, row by row without gaps: kept ones, and where some are not, those that `make` makes of
 * the least window around these. Any number of threads may ask at once: what one is making, others wait for. So `make`
 * must not ask the store that it makes for, nor one whose `make` does. */
tl_status scene_cell_store_read(scene_cell_store *store, fbm_window window, scene_cell_store_make make,
                                const void *context, double *out, const char *name, tl_error *error);

#endif
