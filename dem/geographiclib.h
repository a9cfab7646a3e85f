/* GeographicLib for C. No exception leaves these functions. */
#ifndef DEM_GEOGRAPHICLIB_H
#define DEM_GEOGRAPHICLIB_H

#include <stdbool.h>
#include <stddef.h>

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

/* ---- Maps ---- */

typedef enum dem_map_kind {
    DEM_MAP_TRANSVERSE_MERCATOR,
    DEM_MAP_CONFORMAL_CONIC, /* Lambert's, with one or two parallels */
    DEM_MAP_ALBERS,
    DEM_MAP_POLAR_STEREOGRAPHIC,
    DEM_MAP_MERCATOR,
    DEM_MAP_WEB_MERCATOR, /* the sphere's formulas on the ellipsoid's semi-major axis */
} dem_map_kind;

/* A map projection; angles in degrees. */
typedef struct dem_map_definition {
    dem_map_kind kind;
    double semi_major, flattening;
    double longitude, latitude; /* the origin, whose coordinates are `easting` and `northing` */
    double parallels[2];        /* where the scale is `scale`, of the conics (may be equal), of Mercator and the polar
                                   stereographic (the first alone; its sign, or the origin's at a pole, tells which) */
    double scale;               /* on the central meridian of the transverse Mercator */
    double easting, northing;   /* metres */
    double unit;                /* metres in one unit of the coordinates */
} dem_map_definition;

typedef struct dem_map dem_map;

/* NULL: out of memory, or parameters that no such map has. */
dem_map *dem_map_create(const dem_map_definition *definition);
void dem_map_destroy(dem_map *map);
/* In place, n points: coordinates of the map to longitude and latitude and back. What has no image becomes NaN.
 * The longitude is in -180 ... 180. Any number of threads may share a map. */
void dem_map_to_lonlat(const dem_map *map, size_t n, double *x, double *y);
void dem_map_from_lonlat(const dem_map *map, size_t n, double *longitude, double *latitude);

#ifdef __cplusplus
}
#endif

#endif
