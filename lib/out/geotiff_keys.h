/* The GeoTIFF keys of a raster that is written: what its coordinates are. */
#ifndef OUT_GEOTIFF_KEYS_H
#define OUT_GEOTIFF_KEYS_H

#include "lib/talus.h"

#include <tiffio.h>

enum { OUT_TAG_PIXEL_SCALE = 33550, OUT_TAG_TIE_POINTS = 33922, OUT_TAG_MATRIX = 34264 };

/* Makes the tags of GeoTIFF known to libtiff; any number of times. */
void out_geokeys_register(void);

/* The keys of a raster's CRS and of its raster type, into the directory that is being written. */
bool out_geokeys_write(TIFF *tiff, const tl_source_info *info);

#endif
