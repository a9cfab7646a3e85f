/* CRSs whose heights count from their own ellipsoid. */
#ifndef DEM_CRS_ELLIPSOIDAL_H
#define DEM_CRS_ELLIPSOIDAL_H

#include "lib/base/georef.h"

struct PJconsts; /* PJ and PJ_CONTEXT of <proj.h> */
struct pj_ctx;

/* What tl_crs_vertical_name calls them. */
extern const char dem_ellipsoidal_name[];

/* Takes a two-dimensional CRS and gives it with a third axis, of heights above its ellipsoid, whose unit has `metres`
 * metres; the CRS itself where PROJ cannot. */
struct PJconsts *dem_crs_promote(struct pj_ctx *context, struct PJconsts *crs, double metres);

/* What the keys of a GeoTIFF say of heights: the code of their CRS, user-defined (32767) where they have a name and no
 * code; 0 where the CRS says nothing of them. */
int dem_crs_vertical_key(const tl_crs *crs);
/* The code of a unit of length, by its metres: 9001 to 9003; 0 for others. */
int dem_crs_unit_key(double metres);

/* A CRS with the horizontal part of `crs` and heights above its ellipsoid, in units of `metres`: another reference to
 * take. Fails where the heights of `crs` count from there already, or downwards, or where it has no WKT; `path` is for
 * messages. */
tl_status dem_crs_make_ellipsoidal(const tl_crs *crs, double metres, const char *path, const tl_crs **out,
                                   tl_error *error);

/* Longitude of the CRS's prime meridian, in degrees east of Greenwich; 0 where it cannot be told. */
double dem_crs_prime_meridian(const tl_crs *crs);

#endif
