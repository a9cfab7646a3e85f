/* Datum shifts that GeoTIFF keys give. talus makes none itself; they go into the CRS's WKT, for those who read it. */
#ifndef DEM_CRS_SHIFT_H
#define DEM_CRS_SHIFT_H

#include "dem/geokeys.h"

#include <proj.h>

/* Takes a CRS and gives it bound to WGS 84 by the three or seven parameters of GeogTOWGS84GeoKey; the CRS itself where
 * the keys have none, or PROJ refuses them. */
PJ *dem_crs_bind(PJ_CONTEXT *context, PJ *crs, const dem_geokeys *keys);

#endif
