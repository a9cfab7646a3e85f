/* GeographicLib for C. No exception leaves these functions. */
#ifndef DEM_GEOGRAPHICLIB_H
#define DEM_GEOGRAPHICLIB_H

#include <stdbool.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Length in metres of the geodesic between two points (degrees) on the ellipsoid of `semi_major` metres; NaN where a
 * latitude is none or the ellipsoid is not sound. */
double dem_geodesic_length(double semi_major, double flattening, double longitude1, double latitude1, double longitude2,
                           double latitude2);

/* Metres east, north and up of the plane tangent at an origin (degrees, metres). NULL: out of memory, or an origin or
 * ellipsoid that is not sound. */
void *dem_tangent_create(double semi_major, double flattening, double longitude, double latitude, double height);
void dem_tangent_destroy(void *tangent);
/* NaN where the point is not sound. */
void dem_tangent_forward(const void *tangent, double longitude, double latitude, double height, double xyz[3]);

/* UTM zone `zone` (north: false northing 0; south: 10,000 km) to longitude and latitude on WGS 84; false where the
 * coordinates are outside of it. */
bool dem_utm_to_lonlat(int zone, bool north, double easting, double northing, double *longitude, double *latitude);

#ifdef __cplusplus
}
#endif

#endif
