/* Blocks of a TIFF as heights, decoded once and shared by threads. */
#ifndef DEM_TIFF_BLOCKS_H
#define DEM_TIFF_BLOCKS_H

#include "dem/tiff_layout.h"

typedef struct dem_blocks dem_blocks;

/* Borrows the file and copies the layout. NULL, described, when out of memory. */
dem_blocks *dem_blocks_create(dem_tiff_file *file, const dem_layout *layout, size_t cache_bytes, tl_error *error);
/* Takes NULL. */
void dem_blocks_destroy(dem_blocks *blocks);

/* Heights of a window inside of the raster. Thread-safe. */
tl_status dem_blocks_read(dem_blocks *blocks, tl_window window, float *out, tl_error *error);

#endif
