/* Rasters as pictures: the first row in the north, the first column in the west. */
#ifndef SCENE_NORTH_UP_H
#define SCENE_NORTH_UP_H

#include "lib/talus.h"

/* A source with the rows of `source` from north to south and its columns from west to east: a raster that is stored the
 * other way would come out mirrored where no georeference is read. Rotated grids stay as they are. */
tl_source *scene_north_up(const tl_source *source, tl_error *error);

#endif
