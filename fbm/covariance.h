/* How far a refinement scheme's statistics are from fractional Brownian motion, computed, not sampled. */
#ifndef FBM_COVARIANCE_H
#define FBM_COVARIANCE_H

#include "fbm/refine.h"
#include "fbm/status.h"

/* Deviations of the structure function S(h) = E|Z(x + h) - Z(x)|^2 from |h|^(2H), as fractions of it, over all
 * multiples of (1, 0), (1, 1), (2, 1) and their mirror images up to a quarter of the window. */
typedef struct fbm_deviation {
    double point;       /* largest |S / theory - 1| at any position and lag */
    double mean;        /* the same of S averaged over the positions */
    double mean_scaled; /* the same after the best single factor on all of S */
    double ratio;       /* largest over smallest S of one lag and direction, by position; 1 for stationary increments */
} fbm_deviation;

/* Starts from exact fBm on the vertices of level 0, refines it `levels` times (1 ... 6) and looks at a window of
 * `cells` cells of level 0 (1 ... 8, at most 128 samples wide). The refinement is known by its impulse responses alone:
 * every input sample and every noise value that the window sees is set to 1 in turn and sent through fbm_refine, so
 * that what is analysed is what runs. The variance of an increment follows exactly, to rounding.
 *
 * FBM_TOO_LARGE outside of these ranges. */
fbm_status fbm_structure_deviation(const fbm_scheme *scheme, const fbm_weights *weights, double hurst, int levels,
                                   int cells, fbm_deviation *out);

/* The same for cells that are `aspect` wide and 1 high, whose rows are halved first. `weights` are for the aspect times
 * 2^halvings, rows[k] for the step after k halvings. Lags are counted in samples of the finest lattice. */
typedef struct fbm_refinement {
    const fbm_scheme *scheme;
    double hurst, aspect;
    const fbm_weights *weights;
    int halvings; /* 0 ... 2 */
    const fbm_row_weights *rows;
} fbm_refinement;

fbm_status fbm_refinement_deviation(const fbm_refinement *refinement, int levels, int cells, fbm_deviation *out);

/* Hands over every increment that fbm_refinement_deviation looks at: over (dx, dy) samples from (x, y), and its S over
 * the theory's. */
typedef void (*fbm_increment_visit)(void *context, int dx, int dy, int x, int y, double relative);
fbm_status fbm_refinement_increments(const fbm_refinement *refinement, int levels, int cells, fbm_increment_visit visit,
                                     void *context);

#endif
