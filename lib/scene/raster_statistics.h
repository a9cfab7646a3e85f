/* What the statistics of a whole raster and the local maps share. */
#ifndef SCENE_RASTER_STATISTICS_H
#define SCENE_RASTER_STATISTICS_H

#include "fbm/statistics.h"
#include "lib/talus.h"

/* Reads a window of the finest level; what was filled into voids is NaN. */
tl_status scene_read_measured(const tl_source *source, tl_window window, float *heights, tl_error *error);
/* Variance of the rounding of heights up to `highest` in magnitude: uniform over the quantum, or a float's last place.
 */
double scene_noise_of(const tl_source_info *info, double highest);
/* How a raster samples the ground, in units of sqrt(cell_x cell_y). */
fbm_sampling scene_sampling_of(const tl_source_info *info, int order, double noise);
/* NULL: the fit's H is good. */
const char *scene_refusal_text(fbm_refusal refusal, int order);
/* Degrees clockwise from the grid's north, 0 ... 180, of an angle from the rows towards the columns. */
double scene_azimuth_of(const tl_georef *georef, double angle);

#endif
