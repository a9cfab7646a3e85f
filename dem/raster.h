/* One file as a source. */
#ifndef DEM_RASTER_H
#define DEM_RASTER_H

#include "dem/block_cache.h"
#include "dem/file_pool.h"
#include "lib/talus.h"

/* What the files of one elevation model share. Every member may be NULL. */
typedef struct dem_sharing {
    dem_file_pool *pool;    /* that keeps the file open; NULL: the source does */
    dem_block_cache *cache; /* of decoded blocks; NULL: one of its own */
    const tl_crs *crs;      /* probably that of the file too, which saves making it again */
} dem_sharing;

enum { DEM_CACHE_BYTES = 64 << 20 };

/* Bytes of decoded blocks to keep. */
static inline size_t dem_cache_budget(const tl_dem_options *options)
{
    return options->memory ? options->memory : DEM_CACHE_BYTES;
}

/* Opens a GeoTIFF or an SRTM .hgt file. */
tl_source *dem_file_source(const char *path, const dem_sharing *sharing, const tl_dem_options *options,
                           tl_error *error);

/* Sources over an open file, which becomes the source's, or is closed when they fail. */
tl_source *dem_raster_create(dem_file *file, const dem_sharing *sharing, const tl_dem_options *options,
                             tl_error *error);
tl_source *dem_hgt_create(dem_file *file, const dem_sharing *sharing, tl_error *error);
/* Whether a name ends as those of .hgt files do. */
bool dem_hgt_named(const char *path);

/* Levels that a GeoTIFF holds reduced copies of and reads them from: bit k is set for level -k, k >= 1. 0 for others.
 */
uint64_t dem_raster_reduced(const tl_source *source);

/* Details of a source of that kind; false for others. */
bool dem_raster_details(const tl_source *source, tl_dem_details *out);
bool dem_hgt_details(const tl_source *source, tl_dem_details *out);

#endif
