/* Coefficients for cells that are not square: width dx = aspect * dy. The field is to be isotropic in metres.
 *
 * The rows' spacing is halved k times first, so that a = 2^k aspect lies about 1 (fbm_refine_rows); then the usual half
 * steps go on at the constant aspect a, with the weights
 *   kriging(H, a) + (tuned table(H) - kriging(H, 1)),
 * the taps' difference scaled by t0_kriging(a) / t0_kriging(1). Kriging uses the covariance
 *   -1/2 (h^(2H) - h^2) / (1 - H),
 * whose second term cancels in symmetric sums that add up to 1 and keeps the system well conditioned up to H = 1. The
 * taps are the least-squares fit of the filter's autocovariance to that of kriging's residual.
 *
 * Worst deviation of the structure function, at any position and lag, for H >= 0.1 and aspects 0.25 ... 1: 2 %. */
#ifndef FBM_ASPECT_H
#define FBM_ASPECT_H

#include "fbm/weights.h"

#include <stdbool.h>

/* Aspects from this to 1 are good; those above 1 are, too, when rows and columns change places. */
#define FBM_ASPECT_MIN 0.2

/* Halvings of the rows that bring an aspect nearest to 1: 0 for 2^-1/2 and more. */
int fbm_aspect_halvings(double aspect);

/* Coefficients of the `stationary` scheme at an aspect of 1/2 ... 2. At 1 they are the table's. About 2 ms. */
void fbm_values_stationary(double hurst, double aspect, double values[FBM_WEIGHT_VALUES]);

/* The same by kriging alone, without the table. */
void fbm_values_kriging(double hurst, double aspect, double values[FBM_WEIGHT_VALUES]);

/* Coefficients of a step that halves the rows' spacing: new samples at (i, j + 1/2), by orbits (columns, rows off it):
 *   w    (0, 1/2) (1, 1/2) (2, 1/2) (3, 1/2) (0, 3/2) (1, 3/2) (2, 3/2)
 *   taps (0, 0) (1, 0) (2, 0) (0, 1) (1, 1) (2, 1) (3, 0)
 * in units of the spacing of the rows before. */
typedef struct fbm_row_weights {
    float w[7], taps[7];
} fbm_row_weights;

enum { FBM_ROW_VALUES = 14 };

/* By kriging alone, for an aspect (before the step) of 0.17 ... 1. `wide`: with the last tap, which the first of two
 * halvings needs; else it is 0. */
void fbm_values_rows(double hurst, double aspect, bool wide, double values[FBM_ROW_VALUES]);
void fbm_row_weights_round(const double values[FBM_ROW_VALUES], fbm_row_weights *out);

/* Coefficients that follow the aspect: quartics in its logarithm, through five aspects of the range. */
enum { FBM_ASPECT_NODES = 5 };

typedef struct fbm_aspect_table {
    double low, step; /* log2 of the first node, and between nodes; 0: one aspect only */
    double weights[FBM_ASPECT_NODES][FBM_WEIGHT_VALUES];
} fbm_aspect_table;

typedef struct fbm_row_table {
    double low, step;
    double weights[FBM_ASPECT_NODES][FBM_ROW_VALUES];
} fbm_row_table;

/* `values` as those of a fbm_scheme; low <= high: log2 of the least and the greatest aspect. */
void fbm_aspect_table_make(void (*values)(double hurst, double aspect, double values[FBM_WEIGHT_VALUES]), double hurst,
                           double low, double high, fbm_aspect_table *out);
void fbm_row_table_make(double hurst, double low, double high, bool wide, fbm_row_table *out);
/* Coefficients at log2 of an aspect. */
void fbm_aspect_table_at(const fbm_aspect_table *table, double log_aspect, fbm_weights *out);
void fbm_row_table_at(const fbm_row_table *table, double log_aspect, fbm_row_weights *out);

#endif
