/* Heights at the pixels of a picture, from a source of any size. */
#ifndef SCENE_RESAMPLE_H
#define SCENE_RESAMPLE_H

#include "lib/talus.h"

/* One axis of a picture: the centre of pixel p is at sample origin + step * p. */
typedef struct scene_axis {
    double origin, step; /* samples; step > 0 */
    int64_t pixels;
} scene_axis;

/* A picture's heights. A pixel that no valid sample reaches is NaN; `coverage` is the part of a pixel (0 ... 255) that
 * valid samples fill. */
typedef struct scene_raster {
    int64_t width, height;
    float *heights;
    unsigned char *coverage;
} scene_raster;

tl_status scene_raster_init(scene_raster *raster, int64_t width, int64_t height, tl_error *error);
void scene_raster_finish(scene_raster *raster);

/* Fills raster (of x->pixels by y->pixels) from the finest level of `source`, or, where a pixel is four cells of an
 * area raster and more, from the coarsest one that has two cells and more a pixel each way. Where pixels are larger
 * than samples, by the mean over the pixel's box; where they are smaller, by cubic interpolation (Catmull-Rom: it goes
 * through the samples and its slopes there are their central differences, so a shaded picture shows no cell borders).
 * Both reproduce planes. Pulls the source by windows, in parallel; memory does not depend on the source's size. */
tl_status scene_resample(const tl_source *source, const scene_axis *x, const scene_axis *y, const tl_run *run,
                         scene_raster *raster, tl_error *error);

#endif
