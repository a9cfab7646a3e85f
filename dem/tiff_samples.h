/* From stored samples to heights. */
#ifndef DEM_TIFF_SAMPLES_H
#define DEM_TIFF_SAMPLES_H

#include "dem/tiff_layout.h"

/* Heights of `count` samples of the band of a decoded row of a block (native byte order, predictor undone). */
void dem_samples_to_heights(const dem_layout *layout, const void *row, size_t count, float *heights);

/* The height of one stored number. */
float dem_height_of(const dem_value_rule *rule, double stored);

#endif
