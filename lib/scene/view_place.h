/* Where samples of a raster are in the frame of a view: metres east, north and up at the foot of the eye.
 *
 * A place is linear in height: the place at height 0, and a vector for each metre above it. Both are smooth over the
 * lattice, so they are interpolated from control grids: one of the raster, as exact as its distance asks for, and a
 * finer one around the eye.
 *
 * Refraction bends sight lines by a share k of the Earth's curvature. They are straight again over an Earth of radius
 * R / (1 - k), on which distances along the ground and heights are what they are: a point whose direction from the
 * centre of the sphere of radius R that touches the foot is turned by t from the foot's, at distance R + h from it,
 * comes to the angle (1 - k) t and the distance R / (1 - k) + h. R is the ellipsoid's least radius of curvature,
 * b^2 / a. A flat Earth is the limit k = 1: R t metres from the foot, and heights straight up. */
#ifndef SCENE_VIEW_PLACE_H
#define SCENE_VIEW_PLACE_H

#include "lib/talus.h"

typedef struct scene_places scene_places;

/* How the ground is seen. */
typedef struct scene_bending {
    bool flat;
    double refraction; /* k */
} scene_bending;

/* For a raster, with the frame's origin at a position: longitude and latitude where the raster has a CRS and a
 * transform, else its own coordinates (columns and negative rows, where it is not located). `projected`: it is given in
 * CRS coordinates. Borrows the source's info. */
scene_places *scene_places_create(const tl_source *dem, const double origin[2], bool projected, scene_bending bending,
                                  tl_error *error);
/* Makes what interpolation needs. `distance`: metres from the eye to the foot; `pixel`: the size of one, radians.
 * Before it, places are exact and slow. */
tl_status scene_places_prepare(scene_places *places, double distance, double pixel, tl_error *error);
void scene_places_destroy(scene_places *places);

/* Places of n points; NaN where there are none. Any number of threads. */
void scene_places_at(const scene_places *places, size_t n, const double *i, const double *j, const float *z,
                     double (*xyz)[3]);
/* The same in parts: metres at height 0, and a metre's way up, 6 numbers a point. */
void scene_places_parts(const scene_places *places, size_t n, const double *i, const double *j, double *out);
/* The most by which interpolated places are off within `distance` metres of the eye's foot; and anywhere. */
double scene_places_error(const scene_places *places, bool anywhere);
/* The place of a position (as the origin is given) and a height in metres, exactly. */
void scene_places_point(const scene_places *places, const double position[2], double height, double xyz[3]);
/* The sample, with fractions, that lies at a position. */
void scene_places_sample(const scene_places *places, const double position[2], double *i, double *j);
/* From CRS coordinates to a position. Nothing to do for rasters without a CRS. */
void scene_places_unproject(const scene_places *places, double position[2]);
/* The origin's position. */
const double *scene_places_origin(const scene_places *places);
/* Whether positions are longitude and latitude. */
bool scene_places_is_global(const scene_places *places);
/* Radius of a sphere inside of the Earth that touches it at the origin; infinite where the ground is flat. */
double scene_places_radius(const scene_places *places);

#endif
