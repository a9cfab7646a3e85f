/* Detail of real terrain below a raster of cell means: fbm/relief.h, with its numbers taken from the raster. */
#ifndef SCENE_TERRAIN_H
#define SCENE_TERRAIN_H

#include "fbm/relief.h"
#include "lib/scene/chain.h"
#include "lib/scene/patch.h"
#include "lib/scene/roughness.h"

/* Parts of the rule, to be left out where their worth is measured. */
typedef enum scene_terrain_part {
    SCENE_TERRAIN_PLACE = 1,  /* strength by the energy of the place */
    SCENE_TERRAIN_LEVEL = 2,  /* less strength where it is level */
    SCENE_TERRAIN_STEER = 4,  /* noise down the slope */
    SCENE_TERRAIN_SLOPES = 8, /* levelling of steep slopes */
    SCENE_TERRAIN_PITS = 16,  /* softening of pits */
} scene_terrain_part;

/* A raster's own numbers. All is decided once, so that every window is made alone. */
typedef struct scene_terrain {
    double mean_energy, noise_energy; /* of the finest details; of its quantisation */
    double mean_amplitude;            /* mean square amplitude of octave 0 over the raster */
    float filled_slope2;              /* square slope that filled voids are taken to have */
    double steering, levelling;       /* how the detail goes with the slope: see fbm_relief_fit */
    unsigned without;                 /* parts that are left out: an or of scene_terrain_part */
    scene_growth growth;
    fbm_relief_step steps[SCENE_LEVEL_MAX]; /* steps[l] leads from level l to level l + 1 */
    /* The caller's, set once all is measured: energies and patches, kept for the windows beside. NULL: not kept. */
    scene_cell_store *kept_energies, *kept_patches;
} scene_terrain;

/* Measures a raster, and calibrates its octaves on samples of it so that they get the standard deviations asked for:
 * octaves[0 ... SCENE_LEVEL_MAX - 1], of which `levels` are used. `without`: an or of scene_terrain_part. */
tl_status scene_terrain_measure(const tl_source *dem, const scene_detail *detail, const scene_octave *octaves,
                                int levels, uint64_t seed, unsigned without, const tl_run *run, scene_terrain *out,
                                tl_error *error);

/* Only what scene_terrain_strengths needs. */
tl_status scene_terrain_measure_strengths(const tl_source *dem, const scene_detail *detail, const scene_octave *octaves,
                                          const tl_run *run, scene_terrain *out, tl_error *error);
/* The strength of the detail at the samples of a window, mean square 1 over the raster: by the energy of the place,
 * less where it is level. `patch` reaches FBM_ENERGY_MARGIN beyond it. */
tl_status scene_terrain_strengths(const scene_terrain *terrain, const scene_patch *patch, fbm_window window, float *out,
                                  const char *name, tl_error *error);

/* Makes a window of level `level` > 0 (which may reach beyond the raster), row by row `stride` apart; samples under
 * voids are made up too. `patch`, if not NULL, gets the part of level 0 that it was made from; free it. */
tl_status scene_terrain_read(const scene_terrain *terrain, const tl_source *dem, int level, fbm_window window,
                             float *out, scene_patch *patch, tl_error *error);

#endif
