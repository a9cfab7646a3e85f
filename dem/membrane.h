/* A membrane over holes: Laplace's equation with the known heights as boundary values, by multigrid. */
#ifndef DEM_MEMBRANE_H
#define DEM_MEMBRANE_H

#include "lib/talus.h"

/* Replaces the NaN of heights[width * height] by the discrete harmonic surface through the other heights: every filled
 * sample is the mean of its four neighbours (fewer at the edge of the array, where the surface meets it at a right
 * angle), to 2e-5 of the range of the known heights. An array without any known height stays as it is.
 *
 * Linear in time; about 12 bytes of memory a sample beside the array. The result does not depend on run->threads. */
tl_status dem_membrane_fill(float *heights, int64_t width, int64_t height, const tl_run *run, tl_error *error);

#endif
