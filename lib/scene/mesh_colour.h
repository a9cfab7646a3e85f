/* Colours of a raster that lies over an elevation model, at any distance: a pyramid of means. */
#ifndef SCENE_MESH_COLOUR_H
#define SCENE_MESH_COLOUR_H

#include "lib/scene/light.h"
#include "lib/talus.h"

typedef struct scene_colours scene_colours;

/* Reads a raster of bytes: the bands red, green and blue, or one for grey; it must be in dem's CRS. Or makes a layer of
 * dem: normal, slope, splat. Of what is large, coarser levels are read: it takes at most 90 MB, and at most a quarter
 * of the run's memory. */
scene_colours *scene_colours_open(const char *path, const tl_source *dem, const tl_run *run, tl_error *error);
void scene_colours_destroy(scene_colours *colours);

/* The colour at a column and row of the model, of `metres` around. False: the raster has none there. Any number of
 * threads. */
bool scene_colours_at(const scene_colours *colours, double i, double j, double metres, scene_rgb *out);

#endif
