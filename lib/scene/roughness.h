/* How rough an elevation model is, and how rough it may be expected to be below its samples. */
#ifndef SCENE_ROUGHNESS_H
#define SCENE_ROUGHNESS_H

#include "fbm/estimate.h"
#include "lib/talus.h"

/* What a raster's two finest octaves hold: octave 0 is that of its samples, octave 1 that of their 2 x 2 means. */
typedef struct scene_detail {
    fbm_detail octaves[2];
    double noise; /* variance of the samples' quantisation */
} scene_detail;

/* Reads the raster once. */
tl_status scene_detail_measure(const tl_source *dem, const tl_run *run, scene_detail *out, tl_error *error);
/* Its roughness; the exponent of a raster that is too small for a second octave is the usual one of terrain as rough.
 */
tl_roughness scene_roughness_of(const scene_detail *detail, const tl_georef *georef);

/* The detail of one octave below the samples. */
typedef struct scene_octave {
    double sigma; /* standard deviation of the detail, units of height */
    double hurst; /* local exponent: this octave's sigma is 2^-hurst of the one before; may exceed 1 */
} scene_octave;

/* Predicts the octaves 0 ... count - 1 below a raster (octave 0 has the raster's own cells as parents) from what was
 * measured: exponents are drawn, octave by octave, to what 35 real elevation models have at that ratio of detail to
 * cell. cell_x, cell_y: metres; height_unit: metres. */
void scene_predict_octaves(const tl_roughness *measured, const tl_georef *georef, scene_octave *octaves, int count);

#endif
