/* Detail of real terrain: refinement of cell means by one octave, with noise that is shaped by the place.
 *
 * Every cell is cut into 2 x 2 children whose mean is the cell's height. What the children have beyond the smooth
 * prediction is noise that is strong where the elevation model is rough (its energy), weak where it is level, stretched
 * down the slope, and a levelling of steep slopes; pits are softened. The rule and its constants were measured on 35
 * real elevation models; here it is a pure function of a window of cells, so that any window of children, made alone,
 * has the bits of the whole.
 *
 * Pure functions: the caller's memory, no allocation, no failure; contracts are asserted. */
#ifndef FBM_RELIEF_H
#define FBM_RELIEF_H

#include "fbm/refine.h"

#include <stdbool.h>

enum {
    FBM_RELIEF_MARGIN = 9,  /* cells that a block's children see on every side: 2 for pits, 3 for the prediction of
                                means, 4 for slopes and their divergence */
    FBM_ENERGY_MARGIN = 15, /* cells that an energy sees: 7 of a block's detail, 8 of the smoothing */
    FBM_SLOPE_BINS = 1 << 15,
};

/* One octave. Lengths are in units of height, so that slopes are pure numbers. */
typedef struct fbm_relief_step {
    float children_x, children_y; /* spacing of the children */
    float gains[3];               /* on the x, y and mixed details of the noise */
    float steer, steer_slope2;    /* stretch s = steer g^2 / (g^2 + steer_slope2), within +-0.95; > 0: down the slope */
    float level, level_slope;     /* levelling: level * div((g - level_slope) grad z / g); level: square length */
    float limit;                  /* square amplitude E q / (q + limit E), q = g^2 + slack */
    bool slack;                   /* a plane of slacks (0 where it is not level in truth) follows that of energies */
    bool pits;                    /* leave pits as they are */
    uint64_t seed;
    int32_t octave; /* of the input: a key of the noise, nothing else */
    int64_t period; /* columns of the input after which the noise comes again; 0: never */
} fbm_relief_step;

/* The cells from which a window of children is made. */
fbm_window fbm_relief_support(fbm_window children);
/* Floats of scratch for a window of children of this width, whatever its height. Never less for a greater one. */
size_t fbm_relief_scratch(size_t width);
/* Makes a window of children, and their energies (and slacks) if `out_energy` is not NULL (same window), from the
 * heights and energies (and slacks) of fbm_relief_support(). All must be finite. */
void fbm_relief_refine(const fbm_relief_step *step, const float *heights, const float *energy, fbm_window in,
                       float *out, float *out_energy, fbm_window children, float *scratch);

/* ---- What the rule is calibrated with ---- */

/* Sums of squares over blocks, for the x, y and mixed details: of the noise, before its gain, and of the levelling. */
typedef struct fbm_relief_sums {
    double noise[3], levelling[3];
    uint64_t count;
} fbm_relief_sums;

/* Adds the sums for the blocks of a window of children, which must begin and end at whole blocks. */
void fbm_relief_add_sums(const fbm_relief_step *step, const float *heights, const float *energy, fbm_window in,
                         fbm_window children, float *scratch, fbm_relief_sums *sums);

/* Square slopes: a histogram over the upper 16 bits of floats (so within 1/128), and the sum. */
typedef struct fbm_slopes {
    uint64_t bins[FBM_SLOPE_BINS];
    double sum;
    uint64_t count;
} fbm_slopes;

double fbm_slopes_median(const fbm_slopes *slopes);
/* Adds the square slopes of the smooth prediction of a window of children. */
void fbm_relief_add_slopes(const fbm_relief_step *step, const float *heights, fbm_window in, fbm_window children,
                           float *scratch, fbm_slopes *slopes);

/* How the details of a raster go with its slopes, over blocks steeper than `steep` (square slope of the means). */
typedef struct fbm_relief_fit {
    double stretch, energy;      /* their ratio: the preference for running down the slope */
    double levelled, levelling2; /* their ratio: how much the slope is levelled */
} fbm_relief_fit;

/* Adds the fit for blocks of children, the raster's own samples, whose means are `means`: `step` as for a refinement of
 * the means, with level = cell area / 5 and level_slope the root mean square slope. `shares`: mean squares of the x and
 * y details. `children` must begin and end at whole blocks, and is stored with its own stride. */
void fbm_relief_add_fit(const fbm_relief_step *step, const float *means, fbm_window in, const float *samples,
                        fbm_window children, const double shares[2], double steep, float *scratch, fbm_relief_fit *fit);

/* The local energy of the finest details: mean square of the details (fbm/estimate.h) of the four blocks at a cell,
 * smoothed with a Gaussian of two cells over what is known. `heights` are those of `in`, which must reach
 * FBM_ENERGY_MARGIN beyond `out_window`; NaN for what is not known. NaN where no block is known. */
void fbm_relief_energy(const float *heights, fbm_window in, float *out, fbm_window out_window, float *scratch);
/* Floats of scratch for an output of this size. */
size_t fbm_energy_scratch(size_t width, size_t height);

#endif
