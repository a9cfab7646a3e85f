/* Coefficients of one refinement step: predictor and residual filter. */
#ifndef FBM_WEIGHTS_H
#define FBM_WEIGHTS_H

/* The Hurst exponents that the table covers; others are clamped to this range. */
#define FBM_HURST_MIN 0.01
#define FBM_HURST_MAX 0.99

/* The nearest exponent in that range; the lower end for NaN. */
double fbm_hurst_clamp(double hurst);

/* Coefficients in units of the lattice spacing, for amplitude 1.
 *
 * The predictor of a cell's centre, by orbits of the square's symmetry (offsets from the centre in cells):
 *   w[0] each of (+-1/2, +-1/2)                           4 samples
 *   w[1] each of (+-3/2, +-1/2), (+-1/2, +-3/2)           8
 *   w[2] each of (+-3/2, +-3/2)                           4
 *   w[3] each of (+-5/2, +-1/2), (+-1/2, +-5/2)           8
 * and 4 w[0] + 8 w[1] + 4 w[2] + 8 w[3] = 1 to 1e-8, also as rounded to float.
 *
 * The residual is a filter over independent N(0, 1) values at the new points of the same half step:
 *   taps[0] at the point itself, taps[1] each of the 4 nearest neighbours, taps[2] each of the 4 next ones.
 * For centres the nearest lie along the axes and the next along the diagonals; for edges, the same picture turned by 45
 * degrees and scaled by 1/sqrt(2), it is the other way round. */
typedef struct fbm_weights {
    float w[4];
    float centre_taps[3];
    float edge_taps[3]; /* includes the factor 2^(-H/2) that the shorter distance brings */
} fbm_weights;

/* The tuned table of the `stationary` scheme, interpolated by cubic splines at Hurst exponent `hurst` (clamped; NaN
 * counts as the lower end). Worst deviation of the structure function from delta^2 h^(2H), at any position and lag:
 * 9 % at H = 0.01, 3.7 % at 0.05, 0.95 % at 0.1, 0.7 % up to 0.25, 0.5 % up to 0.45, 0.05 % from 0.6. */
void fbm_weights_stationary(double hurst, fbm_weights *out);

/* The `square` scheme of Hu and Wang: a centre is the mean of its 4 corners, an edge's middle the mean of its 2 ends,
 * each plus independent noise. The noise has the variance of fBm around these means in two dimensions (for spacing s):
 *   centres  delta^2 s^(2H) (2^-H - 1/4 - 2^H / 8),   edges  delta^2 s^(2H) (2^(-2H) - 1/4).
 * (The factor 1 - 2^(2H-2) that is often copied here is the variance of midpoints in one dimension.) */
void fbm_weights_square(double hurst, fbm_weights *out);

/* Standard deviations that a step of amplitude 1 adds to centres and to edges: sqrt(t0^2 + 4 t1^2 + 4 t2^2). Either
 * pointer may be NULL. With them a caller who has measured the detail can choose the amplitude. */
void fbm_weights_residual(const fbm_weights *weights, double *centre, double *edge);

#endif
