/* Blocks of a TIFF as heights, decoded once and shared by threads. */
#ifndef DEM_TIFF_BLOCKS_H
#define DEM_TIFF_BLOCKS_H

#include "dem/block_cache.h"
#include "dem/tiff_layout.h"

typedef struct dem_blocks dem_blocks;

/* The image at the directory with this offset (0: the first). Borrows the file and the cache and copies the layout.
 * NULL, described, when out of memory. */
dem_blocks *dem_blocks_create(dem_tiff_file *file, uint64_t directory, const dem_layout *layout, dem_block_cache *cache,
                              tl_error *error);
/* Takes NULL. */
void dem_blocks_destroy(dem_blocks *blocks);

/* Heights of a window inside of the raster. Thread-safe. */
tl_status dem_blocks_read(dem_blocks *blocks, tl_window window, float *out, tl_error *error);

#endif
