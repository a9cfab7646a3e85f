/* What GeographicLib would do, in a build without C++. Lengths of steps and local frames are computed here; maps are
 * PROJ's. */
#include "dem/geographiclib.h"

#include <math.h>
#include <stdlib.h>

static const double degree = 3.14159265358979323846 / 180;

/* Radii of curvature along the meridian and across it, at a latitude in radians. */
static void radii(double semi_major, double flattening, double latitude, double *along, double *across)
{
    double e2 = flattening * (2 - flattening), s = sin(latitude), w = 1 - e2 * s * s;
    *across = semi_major / sqrt(w);
    *along = *across * (1 - e2) / w;
}

/* By the radii in the middle, which is right to the square of the angle: the steps that are measured are those of
 * cells. Longer ones are measured in parts. */
double dem_geodesic_length(double semi_major, double flattening, double longitude1, double latitude1, double longitude2,
                           double latitude2)
{
    if (!(fabs(latitude1) <= 90 && fabs(latitude2) <= 90) || !isfinite(longitude1) || !isfinite(longitude2))
        return (double)NAN;
    enum { PARTS = 64 };
    double length = 0, step_x = (longitude2 - longitude1) / PARTS * degree,
           step_y = (latitude2 - latitude1) / PARTS * degree;
    for (int k = 0; k < PARTS; k++) {
        double along, across, latitude = latitude1 * degree + (k + 0.5) * step_y;
        radii(semi_major, flattening, latitude, &along, &across);
        length += hypot(across * cos(latitude) * step_x, along * step_y);
    }
    return length;
}

/* ---- Frames: x = R^T (X - X0), with the geocentric coordinates X of a point and of the origin ---- */

typedef struct plane {
    double semi_major, flattening, origin[3], axes[3][3]; /* east, north, up */
} plane;

static void geocentric(const plane *t, double longitude, double latitude, double height, double xyz[3])
{
    double along, across, e2 = t->flattening * (2 - t->flattening), b = latitude * degree, l = longitude * degree;
    radii(t->semi_major, t->flattening, b, &along, &across);
    xyz[0] = (across + height) * cos(b) * cos(l);
    xyz[1] = (across + height) * cos(b) * sin(l);
    xyz[2] = (across * (1 - e2) + height) * sin(b);
}

void *dem_tangent_create(double semi_major, double flattening, double longitude, double latitude, double height)
{
    if (!(fabs(latitude) <= 90) || !isfinite(longitude) || !isfinite(height))
        return NULL;
    plane *t = malloc(sizeof *t);
    if (!t)
        return NULL;
    double b = latitude * degree, l = longitude * degree;
    *t = (plane){.semi_major = semi_major,
                 .flattening = flattening,
                 .axes = {{-sin(l), cos(l), 0},
                          {-sin(b) * cos(l), -sin(b) * sin(l), cos(b)},
                          {cos(b) * cos(l), cos(b) * sin(l), sin(b)}}};
    geocentric(t, longitude, latitude, height, t->origin);
    return t;
}

void dem_tangent_destroy(void *tangent)
{
    free(tangent);
}

void dem_tangent_forward(const void *frame, double longitude, double latitude, double height, double xyz[3])
{
    const plane *t = frame;
    double at[3];
    geocentric(t, longitude, fabs(latitude) <= 90 ? latitude : (double)NAN, height, at);
    for (int a = 0; a < 3; a++)
        xyz[a] = t->axes[a][0] * (at[0] - t->origin[0]) + t->axes[a][1] * (at[1] - t->origin[1]) +
                 t->axes[a][2] * (at[2] - t->origin[2]);
}

/* ---- Maps: none ---- */

bool dem_utm_to_lonlat(int zone, bool north, double easting, double northing, double *longitude, double *latitude)
{
    (void)zone;
    (void)north;
    (void)easting;
    (void)northing;
    (void)longitude;
    (void)latitude;
    return false;
}

dem_map *dem_map_create(const dem_map_definition *definition)
{
    (void)definition;
    return NULL;
}

void dem_map_destroy(dem_map *map)
{
    (void)map;
}

void dem_map_to_lonlat(const dem_map *map, size_t n, double *x, double *y)
{
    (void)map;
    (void)n;
    (void)x;
    (void)y;
}

void dem_map_from_lonlat(const dem_map *map, size_t n, double *longitude, double *latitude)
{
    (void)map;
    (void)n;
    (void)longitude;
    (void)latitude;
}
