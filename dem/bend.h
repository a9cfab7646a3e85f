/* How far flat triangles are from a lattice that is bent in space: samples on the ellipsoid, triangles in an ENU frame.
 *
 * Let X(i, j) be the place in space of a point of the lattice and d its second derivative in any unit direction of the
 * lattice. A triangle through three such places misses the others by at most |d| (r^2 - c^2) / 2, where r is the radius
 * of its circumscribed circle on the lattice and c the distance from that circle's centre [Waldron 1998, the error of
 * linear interpolation]. Right triangles of hypotenuse L have r = L / 2, so they miss by |d| L^2 / 8 at most: upright,
 * that is the sag (d = cell^2 / R: the chord under the curve); level, it is the bending of rows and columns, parallels
 * for instance, which counts by the slope of the triangles that one is shifted over. A triangle that rises by w metres
 * a metre is bent more, as its upper end stands on a wider circle: by 2 w times the upright part. */
#ifndef DEM_BEND_H
#define DEM_BEND_H

#include "dem/crs.h"

/* Where samples lie: metres in an ENU frame at the raster's middle. For one thread at a time. */
typedef struct dem_space dem_space;

/* Whether a mesh written in `frame` is bent against its lattice. */
bool dem_frame_bends(const tl_georef *georef, tl_frame frame);
/* Borrows `georef`, of a raster of width x height samples that lies on a known CRS. */
dem_space *dem_space_create(const tl_georef *georef, int64_t width, int64_t height, const char *name, tl_error *error);
/* The same with its origin there: longitude, latitude, height in metres. */
dem_space *dem_space_create_at(const tl_georef *georef, const double origin[3], const char *name, tl_error *error);
void dem_space_destroy(dem_space *space);
/* The lattice's point (i, j) at height h in metres; and, where up is not NULL, the unit vector upwards there. */
void dem_space_at(const dem_space *space, double i, double j, double h, double xyz[3], double up[3]);

/* Of a part of the lattice: */
typedef struct dem_bend {
    double upright, level; /* largest second derivative, metres in a cell squared */
    double cell;           /* smallest extent of a cell in any direction, metres; 0 where it vanishes */
} dem_bend;

/* For samples (x, y) ... (x + width, y + height) with heights up to `top` metres. */
dem_bend dem_space_bend(const dem_space *space, double x, double y, double width, double height, double top);
/* The worse of both. */
dem_bend dem_bend_worse(dem_bend a, dem_bend b);
/* How far triangles whose hypotenuse is sqrt(length2) cells are from the lattice, in metres along the vertical, where
 * none around rises more than `rise` metres in a cell. */
double dem_bend_error(const dem_bend *bend, double length2, double rise);

#endif
