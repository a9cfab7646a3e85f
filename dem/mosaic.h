/* Several rasters as one source. */
#ifndef DEM_MOSAIC_H
#define DEM_MOSAIC_H

#include "dem/raster.h"

/* Joins `count` sources, which become the mosaic's, as do the pool, the cache (both may be NULL) and nothing else.
 * Where it fails they stay the caller's. */
tl_source *dem_mosaic_create(tl_source **members, size_t count, const dem_sharing *sharing, const char *name,
                             const tl_dem_options *options, tl_error *error);

/* Members of a mosaic; NULL for other sources. */
tl_source *const *dem_mosaic_members(const tl_source *source, size_t *count);
/* Where member `index` lies on the mosaic, and whether its samples are interpolated there. */
tl_window dem_mosaic_place(const tl_source *source, size_t index, bool *resampled);

#endif
