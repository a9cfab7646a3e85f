/* A chain of refinement steps: any window of any level, from a window of level 0. */
#ifndef SCENE_CHAIN_H
#define SCENE_CHAIN_H

#include "fbm/refine.h"
#include "lib/talus.h"

enum { SCENE_LEVEL_MAX = 30 };

typedef struct scene_chain {
    fbm_step steps[SCENE_LEVEL_MAX + 1]; /* steps[l] leads from level l to level l + 1 */
    bool mapped;                         /* the noise has a strength that varies: `load` tells it */
} scene_chain;

/* Fills buffer[window.width * window.height] with the heights of level 0, all finite, and `map`, unless NULL, with the
 * factors on the noise there. */
typedef tl_status (*scene_chain_load)(void *context, fbm_window window, float *buffer, float *map, tl_error *error);

/* Where the heights of one call go: the samples of a lattice, or the centres of its cells (see fbm_centres). */
typedef struct scene_chain_target {
    int level; /* 0 ... SCENE_LEVEL_MAX */
    bool centres;
    fbm_window window; /* in lattice (or cell) coordinates of `level`; its stride is that of out */
    float *out;
} scene_chain_target;

/* The window of level 0 that a target needs. */
fbm_window scene_chain_support(const scene_chain *chain, const scene_chain_target *target);

/* Makes the target; `name` is for messages. */
tl_status scene_chain_run(const scene_chain *chain, const scene_chain_target *target, scene_chain_load load,
                          void *context, const char *name, tl_error *error);

/* The name of the scheme that is not in fbm_schemes. */
#define SCENE_TERRAIN "terrain"

/* The scheme of fBm of this name, the first for NULL; NULL, described, when there is none. */
const fbm_scheme *scene_scheme(const char *name, tl_error *error);

#endif
