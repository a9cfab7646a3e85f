/* Samples of an elevation model, with what is made up beyond its rim and in its voids. */
#ifndef SCENE_PATCH_H
#define SCENE_PATCH_H

#include "fbm/refine.h"
#include "lib/scene/cell_store.h"
#include "lib/talus.h"

/* A rectangle of level 0, in samples, that may reach beyond the model. */
typedef struct scene_patch {
    fbm_window window;    /* without gaps between rows */
    float *heights;       /* all finite */
    unsigned char *known; /* a scene_known for each; NULL: all are SCENE_MODEL */
} scene_patch;

typedef enum scene_known {
    SCENE_NOTHING = 0,
    SCENE_MODEL,  /* the model's own */
    SCENE_FILLED, /* the model's, but made up in a void: smoother than what is around */
    SCENE_BEYOND, /* and all that follows: not the model's */
} scene_known;

/* How heights are made up. First, if `reflect`, beyond the raster's rim: by odd reflection there, z(-k) = 2 z(0) -
 * z(k). Then ring by ring, for `rings` rings around the known samples, each the mean over directions of the neighbour's
 * height and a share `trend` of the step to it. What lies farther is 0.
 *
 * Where `delta` is not 0, the first rings are simulated instead, so that the outermost cells are as those inside:
 * sample by sample, each the best guess of fBm from those before it within two cells, plus noise keyed by its place
 * with the variance of that guess; between exponents that are multiples of 1/64 it is linear. The order, ring by ring
 * and by the parity of column and row within a ring, is that of the lattice, not of the window. */
typedef struct scene_growth {
    int rings; /* at most 40 */
    float trend;
    bool reflect;
    double delta, hurst, aspect; /* of fBm over the geometric mean of a cell's sides; width over height of a cell */
    uint64_t seed;
    /* NULL, or strengths and exponents at the samples of a window instead of delta, where that is not 0, and hurst; an
     * exponent of 0 stands for that. */
    tl_status (*by_place)(const void *context, fbm_window window, float *delta, float *hurst, tl_error *error);
    const void *context;
} scene_growth;

/* Reads a patch; the result does not depend on where the window lies. Free with scene_patch_free. */
tl_status scene_patch_read(const tl_source *dem, scene_growth growth, fbm_window window, scene_patch *out,
                           tl_error *error);
/* The same, what takes long to make being kept: patches that reach beyond the model, or may have voids. `kept` must be
 * of this model and growth alone. */
tl_status scene_patch_recall(scene_cell_store *kept, const tl_source *dem, scene_growth growth, fbm_window window,
                             scene_patch *out, tl_error *error);
void scene_patch_free(scene_patch *patch);

/* Whether a sample is the model's, filled or not. */
static inline bool scene_patch_known(const scene_patch *p, int64_t i, int64_t j)
{
    unsigned char known =
        p->known ? p->known[(size_t)(j - p->window.j) * p->window.width + (size_t)(i - p->window.i)] : SCENE_MODEL;
    return known == SCENE_MODEL || known == SCENE_FILLED;
}

/* The window with `by` samples more on every side. */
fbm_window scene_widened(fbm_window window, int by);

#endif
