/* The table of the `stationary` scheme, derived: what fbm/weights.c holds, and from where. */
#ifndef FBM_TUNE_H
#define FBM_TUNE_H

#include "fbm/status.h"
#include "fbm/weights.h"

/* Worst deviations |S / theory - 1| of the structure function at any position, by exact covariance. */
typedef struct fbm_tuning {
    double tuned;    /* at the lags that are tuned: (1, 0), (1, 1), (2, 1) and their mirror images, up to 8 times, after
                        3 levels */
    double held_out; /* at 9 to 16 times these, after 4 levels */
} fbm_tuning;

/* Derives the row for a Hurst exponent (0.01 ... 0.99): kriging's weights (see fbm/aspect.h) with the filter fitted to
 * the autocovariance of its residual, and from there a descent in all six coefficients (the sum of the weights is 1),
 * by Levenberg and Marquardt, on the deviations of the structure function after `levels` levels (1 ... 4) of a window
 * of `cells` cells (1 ... 4) of the coarsest: their sum of 2nd, then 4th, 8th and 16th powers, which comes near to the
 * smallest worst. Some 40 s for 3 levels of 4 cells, 2 s for 2 of 2. */
fbm_status fbm_tune(double hurst, int levels, int cells, fbm_table_row *out);
/* How good a row is. */
fbm_status fbm_tune_measure(const fbm_table_row *row, fbm_tuning *out);

#endif
