/* Coarser levels of an elevation model, made from finer samples when they are asked for.
 *
 * Level -k of a point raster has the samples whose column and row are multiples of 2^k; that of an area raster the
 * means of the valid samples of 2^k x 2^k cells, fewer at the right and lower rim, void where there are none. There are
 * levels down to one sample. */
#ifndef DEM_LEVELS_H
#define DEM_LEVELS_H

#include "lib/talus.h"

/* Size of level `level` (0 or below) of a raster whose samples are those of level 0; for tl_source.size. */
tl_status dem_level_size(const tl_source *source, int level, int64_t *width, int64_t *height, tl_error *error);

/* Finer samples that a level is made of: the raster itself, or a reduced copy. */
typedef struct dem_level_base {
    tl_status (*read)(const void *context, tl_window window, float *out, tl_error *error);
    const void *context;
    int64_t width, height;
    tl_raster_type type;
    const char *name;
} dem_level_base;

/* A window of the level that is `halvings` below the base. Memory does not depend on the window. The result is the
 * same, bit for bit, wherever the window lies. */
tl_status dem_level_read(const dem_level_base *base, int halvings, tl_window window, float *out, tl_error *error);

#endif
