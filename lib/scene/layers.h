/* Layers over heights: normals, slope, curvature, ground kinds, colours, roughness. Each sample is made from the
 * heights within one sample of it, so that windows made apart join; at the rim and beside voids from those that are
 * there. */
#ifndef SCENE_LAYERS_H
#define SCENE_LAYERS_H

#include "lib/talus.h"

#include <math.h>

enum { SCENE_LAYER_CHANNELS = 4 }; /* at most */

typedef struct scene_layer scene_layer;

/* `kind`: a name of tl_layers(). Borrows `heights`. */
scene_layer *scene_layer_create(const tl_source *heights, const char *kind, const tl_layer_options *options,
                                tl_error *error);
/* The same with default options; colours spread over the heights of `colours_of`. */
scene_layer *scene_layer_create_over(const tl_source *heights, const char *kind, const tl_source *colours_of,
                                     tl_error *error);
/* The same layer, with the same colours, over another lattice of the same ground: its axes have the same directions.
 * NULL when out of memory. */
scene_layer *scene_layer_copy_over(const scene_layer *layer, const tl_source *heights);
void scene_layer_destroy(scene_layer *layer);
const tl_layer_kind *scene_layer_kind(const scene_layer *layer);
/* The window's values, channel by channel; NaN where the height is void. Any number of threads. */
tl_status scene_layer_read(const scene_layer *layer, tl_window window, float *out, tl_error *error);

/* The same of the raster with the north on top and the west on the left: see scene_north_up. */
tl_status scene_layer_read_upright(const scene_layer *layer, tl_window window, float *out, tl_error *error);

/* Slope by both neighbours, `step` away, by the one that is there, or level. */
static inline double scene_slope(double before, double here, double behind, double step)
{
    if (!isnan(before) && !isnan(behind))
        return (behind - before) / (2 * step);
    if (!isnan(behind))
        return (behind - here) / step;
    return isnan(before) ? 0 : (here - before) / step;
}

#endif
