/* Rectangles, found by place. */
#ifndef DEM_BINS_H
#define DEM_BINS_H

#include "lib/talus.h"

typedef struct dem_bins dem_bins;

/* Rectangles 0 ... count - 1; they are copied. Their coordinates are below 2^61 and they are not empty. NULL when out
 * of memory. */
dem_bins *dem_bins_create(const tl_window *rectangles, size_t count);
/* Takes NULL. */
void dem_bins_destroy(dem_bins *bins);

/* Numbers that were found; grows, and can be used again. Starts as {0}. */
typedef struct dem_hits {
    uint32_t *numbers; /* from malloc */
    size_t count, room;
} dem_hits;

/* The rectangles that share a sample with the window, in rising order. False when out of memory. */
bool dem_bins_find(const dem_bins *bins, tl_window window, dem_hits *hits);

/* What two windows share; its width or height is not positive where they share nothing. */
tl_window dem_window_common(tl_window a, tl_window b);
bool dem_window_empty(tl_window window);

#endif
