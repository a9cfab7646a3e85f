/* Coefficients of one refinement step: predictor and residual filter. */
#ifndef FBM_WEIGHTS_H
#define FBM_WEIGHTS_H

#include <stdbool.h>
#include <stddef.h>

/* The Hurst exponents that the table covers; others are clamped to this range. */
#define FBM_HURST_MIN 0.01
#define FBM_HURST_MAX 0.99

/* The nearest exponent in that range; the lower end for NaN. */
double fbm_hurst_clamp(double hurst);

/* Coefficients in units of the rows' spacing, for amplitude 1.
 *
 * The predictor of a cell's centre, by orbits of the rectangle's symmetry (offsets from the centre in cells, with both
 * signs of what is not 0):
 *   centre[0 ... 5]  (1/2, 1/2) (3/2, 1/2) (1/2, 3/2) (3/2, 3/2) (5/2, 1/2) (1/2, 5/2)
 * and that of an edge's middle, the same picture turned by 45 degrees and scaled by 1/sqrt(2):
 *   edge[0 ... 7]    (1/2, 0) (0, 1/2) (1/2, 1) (1, 1/2) (0, 3/2) (3/2, 0) (1, 3/2) (3/2, 1).
 * Either adds up to 1 over all points, to 1e-8 as rounded to float. (A shift by half a cell makes edges along columns
 * of those along rows, so one set serves both.)
 *
 * The residual is a filter over independent N(0, 1) values at the new points of the same half step, with the taps
 *   centre_taps[0 ... 3]  (0, 0) (1, 0) (0, 1) (1, 1)
 *   edge_taps[0 ... 3]    (0, 0) (1/2, 1/2) (1, 0) (0, 1); shorter distances are in them, as 2^(-H/2). */
typedef struct fbm_weights {
    float centre[6], centre_taps[4];
    float edge[8], edge_taps[4];
    float column_tap; /* schemes of means: edge_taps[0] is for edges along rows, this for those along columns */
} fbm_weights;

/* The same before they are rounded: all of a fbm_weights in its order. */
enum { FBM_WEIGHT_VALUES = 6 + 4 + 8 + 4 + 1 };

/* Rounds a predictor of `count` orbits such that it adds up to 1: what rounding the others costs goes to the orbit
 * whose points weigh least. */
void fbm_round_predictor(const double *w, const double *orbits, size_t count, float *out);
/* Rounds such that the predictors add up to 1. */
void fbm_weights_round(const double values[FBM_WEIGHT_VALUES], fbm_weights *out);

/* The tuned table of the `stationary` scheme, interpolated by cubic splines at Hurst exponent `hurst` (clamped; NaN
 * counts as the lower end). Worst deviation of the structure function from delta^2 h^(2H), at any position and lag:
 * 9 % at H = 0.01, 3.7 % at 0.05, 0.95 % at 0.1, 0.7 % up to 0.25, 0.5 % up to 0.45, 0.05 % from 0.6. */
void fbm_weights_stationary(double hurst, fbm_weights *out);
/* The same as values, not rounded. */
void fbm_values_table(double hurst, double values[FBM_WEIGHT_VALUES]);

/* A row of such a table: coefficients of the square's symmetry. Predictor, for points at (1/2, 1/2), (3/2, 1/2),
 * (3/2, 3/2) and (5/2, 1/2) from the centre; taps at (0, 0), (1, 0) and (1, 1). Edges see the same picture turned. */
typedef struct fbm_table_row {
    double hurst, w[4], t[3];
} fbm_table_row;

/* The row of the table at one of its knots, which are numbered from 0; false behind the last one. fbm/tune.h makes such
 * rows. */
bool fbm_table_row_at(int knot, fbm_table_row *out);
void fbm_values_of_row(const fbm_table_row *row, double values[FBM_WEIGHT_VALUES]);
/* Rounds such that orbits of the square's symmetry stay equal, and predictors add up to 1. */
void fbm_weights_of_row(const fbm_table_row *row, fbm_weights *out);

/* The classical schemes, for comparison: each new point is a mean of its neighbours, plus independent noise with the
 * variance of fBm about that mean in two dimensions. For points p of weights w that add up to 1 it is
 *   delta^2 (sum w_i |p_i|^(2H) - 1/2 sum w_i w_j |p_i - p_j|^(2H)).
 * (The factor 1 - 2^(2H-2) that is often copied for all of them is the variance of midpoints in one dimension.)
 *
 * `square`, of Hu and Wang: the centre is the mean of its 4 corners, an edge's middle the mean of its 2 ends; at
 * spacing s the variances are centres  delta^2 s^(2H) (2^-H - 1/4 - 2^H / 8),   edges  delta^2 s^(2H) (2^(-2H) - 1/4).
 */
void fbm_weights_square(double hurst, fbm_weights *out);
/* `diamond-square`: likewise, but an edge's middle is the mean of its 2 ends and the 2 centres beside it: the centres'
 * rule at spacing s/sqrt(2). */
void fbm_weights_diamond(double hurst, fbm_weights *out);
/* `square-square` (G. S. P. Miller 1986): the four children of a cell lie a quarter of it off its centre, and are 9, 3,
 * 3 and 1 sixteenths of the four cells around them. Only centre_taps[0] says something. */
void fbm_weights_children(double hurst, fbm_weights *out);

/* The coefficients of the schemes for cells of width `aspect` and height 1. For `stationary` see fbm/aspect.h. */
void fbm_values_square(double hurst, double aspect, double values[FBM_WEIGHT_VALUES]);
void fbm_values_diamond(double hurst, double aspect, double values[FBM_WEIGHT_VALUES]);
void fbm_values_children(double hurst, double aspect, double values[FBM_WEIGHT_VALUES]);

/* Standard deviations that a step of amplitude 1 adds to centres and to edges (along rows): the taps' root sum of
 * squares. Either pointer may be NULL. With them a caller who has measured the detail can choose the amplitude. */
void fbm_weights_residual(const fbm_weights *weights, double *centre, double *edge);

#endif
