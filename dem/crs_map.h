/* Map projections by their parameters, as PROJ tells them. */
#ifndef DEM_CRS_MAP_H
#define DEM_CRS_MAP_H

#include "dem/geographiclib.h"
#include "lib/base/georef.h"

#include <proj.h>

/* A context of PROJ's that prints nothing and asks no network; NULL when out of memory. */
PJ_CONTEXT *dem_proj_context(void);

/* The map of a projected CRS, whose PROJ object is `object`; false where GeographicLib has no such projection, or where
 * its coordinates do not run to the east and to the north. */
bool dem_crs_map(PJ_CONTEXT *context, const PJ *object, const tl_crs *crs, dem_map_definition *out);

#endif
