/* The record that talus leaves in its GeoTIFFs: items "talus_NAME" of GDAL's metadata. */
#ifndef DEM_TIFF_RECORD_H
#define DEM_TIFF_RECORD_H

#include "dem/tiff_file.h"

/* The parameters in an open TIFF's first directory; free() frees the list, NULL where there are none. */
tl_status dem_record_read(TIFF *tiff, const char *path, tl_parameter **list, size_t *count, tl_error *error);

#endif
