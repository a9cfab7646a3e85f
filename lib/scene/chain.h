/* A chain of refinement steps: any window of any level, from a window of level 0. */
#ifndef SCENE_CHAIN_H
#define SCENE_CHAIN_H

#include "fbm/refine.h"
#include "lib/talus.h"

enum { SCENE_LEVEL_MAX = 30 };

/* The shape of a raster's cells. */
typedef struct scene_shape {
    double aspect; /* width over height at the raster's middle; height over width where `turned` */
    int halvings;  /* of the rows' spacing, before all levels */
    bool turned;   /* rows and columns change places: cells are wider than high */
    /* log2 of width over height at each row of level 0, where it changes from row to row; NULL: it does not. */
    double *log_aspects;
    int64_t rows;
    double low, high; /* of these */
} scene_shape;

/* Exponents between which the weights of halvings are linear, from FBM_HURST_MIN to FBM_HURST_MAX. */
enum { SCENE_ROW_EXPONENTS = 25 };

typedef struct scene_chain {
    fbm_step steps[SCENE_LEVEL_MAX + 1]; /* steps[l] leads from level l to level l + 1 */
    bool mapped;                         /* the noise has a strength that varies: `load` tells it */
    /* The exponent varies, too, as `load` tells it, and the strength is then delta; see scene_chain_fit_places. */
    bool placed;
    fbm_places_table places;
    float *place_values;
    fbm_row_table *place_rows; /* of the halvings: [halvings][SCENE_ROW_EXPONENTS] */
    double fall;               /* of the noise before the first level: its amplitude is delta 2^(-(fall + level) H) */
    scene_shape shape;
    fbm_row_step row_steps[2]; /* of the halvings */
    /* Weights that follow the rows, where the shape does; NULL, or [SCENE_LEVEL_MAX + 1] and [2]. */
    fbm_aspect_table *tables;
    fbm_row_table *row_tables;
} scene_chain;

/* Fits a chain whose steps have scheme and amplitude, as for square cells, to the shape of the raster's cells: sets the
 * steps' weights, scales their amplitudes from delta over the geometric mean of the cell's sides to that over a row's
 * spacing, and adds the halvings. `hursts`: of levels 0 ... levels. `strict`: refuses aspects for which fBm cannot be
 * had; else the nearest good one is taken. scene_chain_finish frees what is made. */
tl_status scene_chain_fit(scene_chain *chain, const tl_source_info *raster, const double *hursts, int levels,
                          bool strict, tl_error *error);
/* The same for cells of one shape, of which nothing is kept to be freed. `aspect`: 0.2 ... 5. */
void scene_chain_fit_aspect(scene_chain *chain, double aspect, const double *hursts, int levels);
/* Makes a chain that was fitted one whose strength and exponent are fields. Its scheme must be one of
 * fbm_scheme_has_places. */
tl_status scene_chain_fit_places(scene_chain *chain, const char *name, tl_error *error);
void scene_chain_finish(scene_chain *chain);

/* Planes beside the heights of level 0: the factor on the noise, and the Hurst exponent. */
enum { SCENE_STRENGTH, SCENE_HURST, SCENE_PLANES };

/* Some of them over a window, without gaps between rows; NULL: not this one. */
typedef struct scene_planes {
    fbm_window window;
    float *of[SCENE_PLANES];
} scene_planes;

/* Copies a part of them to `out`, where that is not NULL; likewise without gaps. */
void scene_planes_cut(const scene_planes *planes, fbm_window part, float *const out[SCENE_PLANES]);

/* Fills buffer[window.width * window.height] with the heights of level 0, all finite, and those of `planes` that are
 * not NULL likewise: factors on the noise, >= 0, and exponents of FBM_HURST_MIN ... FBM_HURST_MAX. */
typedef tl_status (*scene_chain_load)(void *context, fbm_window window, float *buffer,
                                      float *const planes[SCENE_PLANES], tl_error *error);

/* Where the heights of one call go: the samples of a lattice, or the centres of its cells (see fbm_centres). */
typedef struct scene_chain_target {
    int level; /* 0 ... SCENE_LEVEL_MAX */
    bool centres;
    fbm_window window; /* in lattice (or cell) coordinates of `level`; its stride is that of `out` */
    float *out;
} scene_chain_target;

/* The window of level 0 that a target needs. */
fbm_window scene_chain_support(const scene_chain *chain, const scene_chain_target *target);

/* Makes the target; `name` is for messages. */
tl_status scene_chain_run(const scene_chain *chain, const scene_chain_target *target, scene_chain_load load,
                          void *context, const char *name, tl_error *error);

/* The names of the schemes that are not in fbm_schemes. */
#define SCENE_TERRAIN "terrain"
#define SCENE_EXACT "exact"

/* The scheme of fBm of this name, the first for NULL; NULL, described, when there is none. */
const fbm_scheme *scene_scheme(const char *name, tl_error *error);

#endif
