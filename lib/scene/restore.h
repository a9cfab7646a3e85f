/* Sites around a vertex that is being made, and the kriging of its height from those that are known. */
#ifndef SCENE_RESTORE_H
#define SCENE_RESTORE_H

#include "dem/framework.h"
#include "lib/talus.h"

/* In a half step at spacing S a centre lies in the middle of a square of side S, an edge point in the middle of one of
 * the sides. Sites are counted in S / 4 from it: first those of the lattice before, then finer ones that a framework
 * may keep while it drops the vertex itself, within 1.42 S. Triangles that conform have none nearer than 0.79 S,
 * but for those that split beside voids. */
enum { SCENE_COARSE = 24, SCENE_FINE = 24, SCENE_SITES = SCENE_COARSE + SCENE_FINE };

typedef enum scene_half { SCENE_CENTRES = 0, SCENE_EDGES } scene_half;

typedef struct scene_weights {
    double weights[SCENE_SITES]; /* 0 for sites that are not known */
    double sigma; /* standard deviation of what they leave open, of fBm with E|Z(x + h) - Z(x)|^2 = |h|^(2 H) */
} scene_weights;

typedef struct scene_kriging {
    int32_t sites[2][SCENE_SITES][2];                                /* by half step */
    double between[2][SCENE_SITES][SCENE_SITES], to[2][SCENE_SITES]; /* half the squares of increments */
    /* Of the residuals at a new vertex, its four nearest new neighbours and the four next: a filter over independent
     * noise that gives residuals the correlation that they have where all coarse sites are known; unit variance. */
    double taps[2][3];
    /* Of square cells, all coarse sites known and no others: the table of the `stationary` scheme, which is nearer to
     * fBm than kriging and a filter of two neighbours are for exponents below 0.3. */
    bool tabulated;
    scene_weights table[2];
} scene_kriging;

/* For cells `aspect` times as wide as high. */
void scene_kriging_init(scene_kriging *self, double hurst, double aspect);
/* The weights where the sites with bits in `known` are known, at least one. */
void scene_kriging_solve(const scene_kriging *self, scene_half half, uint64_t known, scene_weights *out);

/* Exponent and spreads (see tl_framework) of what a framework drops of its model; its own where it has them. */
tl_status scene_restore_measure(const tl_framework *framework, const tl_source *dem, const tl_run *run, double *hurst,
                                double spread[TL_STAGES], tl_error *error);

/* tl_framework_restore; with `ignores` it takes no notice of points that are finer than the vertex being made, which
 * shows what they are good for. */
tl_source *scene_restore(const tl_framework *framework, const tl_source *dem, const tl_restore_options *options,
                         bool ignores, tl_error *error);

#endif
