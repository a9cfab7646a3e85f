/* The levels of any source, down to one sample: those that it holds itself and, below these, every second, fourth ...
 * sample of a raster of points, and means over squares of cells of an area raster. */
#ifndef SCENE_LATTICE_LEVEL_H
#define SCENE_LATTICE_LEVEL_H

#include "lib/talus.h"

/* A source that is `source` so many halvings coarser than its finest level: ceil(size / 2^halvings) samples, its first
 * sample (or cell's corner) where the source's is. Means are of the cells that are known; the last ones may be of
 * fewer. A field of levels above 0 gives its own, so that they are made only once. Borrows the source. */
tl_source *scene_lattice_level_create(const tl_source *source, int halvings, tl_error *error);

#endif
