/* A source's own samples as a lattice for tiles, and where its vertices lie on the globe.
 *
 * Vertex (x, y) counts from the corner from which both the columns run on and the axes (x, y, up) are right-handed: the
 * south-western one, of rasters whose first row is the north. A raster that goes around the globe has its first column
 * once more behind the last. */
#ifndef SCENE_OWN_LATTICE_H
#define SCENE_OWN_LATTICE_H

#include "lib/talus.h"

typedef struct scene_own_lattice scene_own_lattice;

/* Of a source's finest level, whose CRS and place must be known and which must have at least 2 x 2 samples. */
scene_own_lattice *scene_own_lattice_create(const tl_source *source, tl_error *error);
void scene_own_lattice_destroy(scene_own_lattice *lattice);

/* All vertices: from (0, 0) on. */
tl_window scene_own_lattice_window(const scene_own_lattice *lattice);
/* Whether the last column is the first once more. */
bool scene_own_lattice_goes_around(const scene_own_lattice *lattice);
/* Whether columns are meridians and rows parallels. */
bool scene_own_lattice_is_geographic(const scene_own_lattice *lattice);
/* Heights in metres, row by row upwards; NaN where there are none, as outside. Any thread. */
tl_status scene_own_lattice_read(const scene_own_lattice *lattice, tl_window window, float *out, tl_error *error);

/* How far flat triangles are from the lattice in space, metres: their hypotenuse is sqrt(length2) cells, their slope at
 * most 2. */
double scene_own_lattice_sag(const scene_own_lattice *lattice, double length2);

/* Where vertices are; for one thread at a time. */
typedef struct scene_placer scene_placer;
scene_placer *scene_placer_create(const scene_own_lattice *lattice, tl_error *error);
void scene_placer_destroy(scene_placer *placer);
/* Longitudes (of Greenwich, going on beyond half a turn) and latitudes of n places, in radians; NaN where there is
 * none. */
void scene_placer_lonlat(scene_placer *placer, size_t n, const double *x, const double *y, double *longitude,
                         double *latitude);

/* WGS 84: metres in the axes of the Earth, and the unit vector upwards there. */
void scene_to_ecef(double longitude, double latitude, double height, double out[3]);
void scene_up(double longitude, double latitude, double out[3]);

#endif
