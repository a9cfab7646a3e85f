/* CRSs whose heights count from their own ellipsoid. */
#ifndef DEM_CRS_ELLIPSOIDAL_H
#define DEM_CRS_ELLIPSOIDAL_H

#include "lib/base/georef.h"

#include <proj.h>

/* What tl_crs_vertical_name calls them. */
extern const char dem_ellipsoidal_name[];

/* Takes a two-dimensional CRS and gives it with a third axis, of heights above its ellipsoid, whose unit has `metres`
 * metres; the CRS itself where PROJ cannot. */
PJ *dem_crs_promote(PJ_CONTEXT *context, PJ *crs, double metres);

/* The code that GeoTIFF has for heights above an ellipsoid by its EPSG code; 0 where it has none. */
int dem_ellipsoidal_key(int ellipsoid);

/* A CRS with the horizontal part of `crs` and heights above its ellipsoid, in units of `metres`: another reference to
 * take. Fails where the heights of `crs` count from there already, or downwards, or where it has no WKT; `path` is for
 * messages. */
tl_status dem_crs_make_ellipsoidal(const tl_crs *crs, double metres, const char *path, const tl_crs **out,
                                   tl_error *error);

/* Longitude of the CRS's prime meridian, in degrees east of Greenwich; 0 where it cannot be told. */
double dem_crs_prime_meridian(const tl_crs *crs);

#endif
