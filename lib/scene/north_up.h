/* Rasters as pictures: the first row in the north, the first column in the west. */
#ifndef SCENE_NORTH_UP_H
#define SCENE_NORTH_UP_H

#include "lib/talus.h"

/* A source with the rows of `source` from north to south and its columns from west to east: a raster that is stored the
 * other way would come out mirrored where no georeference is read. Rotated grids stay as they are. */
tl_source *scene_north_up(const tl_source *source, tl_error *error);
/* Whether columns and rows of a raster run the other way. */
void scene_north_up_turns(const tl_georef *georef, bool *columns, bool *rows);
/* Where a window of the turned raster lies in one of width x height samples; and its samples, turned in place. */
tl_window scene_turned_window(tl_window window, int64_t width, int64_t height, bool columns, bool rows);
void scene_turn(float *samples, tl_window window, bool columns, bool rows);

#endif
