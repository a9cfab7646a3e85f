/* Where a grid lies, from what files other than GeoTIFFs say of it. */
#ifndef OUT_PLACE_H
#define OUT_PLACE_H

#include "lib/talus.h"

/* As a file has it: NULL or 0 for what it does not say. */
typedef struct out_place {
    const double *transform; /* GDAL's geotransform, from the outer corner of the first cell */
    const char *wkt;
    const char *keys; /* GeoTIFF keys: see dem/crs_keys.h */
    double height_unit;
} out_place;

/* Fills in info->georef, with a reference to the CRS that is the caller's, and info->wraps; the size is set. */
tl_status out_place_read(const out_place *place, const char *path, tl_source_info *info, tl_error *error);

#endif
