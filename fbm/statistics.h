/* What a raster's increments say of fractional Brownian motion: moments by lag and direction, the sampling covariance
 * that fBm gives them, and fits of H and delta with errors that follow from it. */
#ifndef FBM_STATISTICS_H
#define FBM_STATISTICS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum {
    FBM_DIRECTIONS = 4,
    FBM_FIT_LAGS = 4, /* lags 1, 2, 4 and 8 are fitted */
    FBM_FIT_VALUES = FBM_DIRECTIONS * FBM_FIT_LAGS,
    FBM_POSITION_OCTAVES = 3, /* lattice positions are told apart modulo 2, 4 and 8 */
    FBM_POSITIONS = 64,
};

/* Columns and rows of the directions: along rows, along columns, and the two diagonals. */
extern const int fbm_directions[FBM_DIRECTIONS][2];

/* Sums over increments. */
typedef struct fbm_moments {
    uint64_t count;
    double first, second, third, fourth; /* sums of powers */
} fbm_moments;

/* Adds the increments of one order over `lag` samples in one direction, every position in the window:
 * order 1: Z(x + h) - Z(x), order 2: Z(x) - 2 Z(x + h) + Z(x + 2h). Increments with a NaN are left out. Without
 * `shape` only the count and the squares are summed up. */
void fbm_increments_add(const float *heights, size_t width, size_t height, size_t lag, int order, int direction,
                        bool shape, fbm_moments *moments);
void fbm_moments_merge(fbm_moments *sum, const fbm_moments *part);

/* Second-order increments over one sample, squared, by their middle's column and row modulo 8. (x, y): the window's
 * first sample. */
typedef struct fbm_positions {
    double rows[FBM_POSITIONS], columns[FBM_POSITIONS]; /* sums of squares, along rows and along columns */
    uint64_t count[FBM_POSITIONS];                      /* positions where both are known */
} fbm_positions;

void fbm_positions_add(const float *heights, size_t width, size_t height, uint64_t x, uint64_t y,
                       fbm_positions *positions);

/* The largest over the smallest mean square by position modulo 2^octave (1 ... 3), each direction over its own mean.
 * *limit is what it stays below with a probability of at least 0.99 for stationary Gaussian increments of exponent
 * `hurst`: 2 z standard errors of a position's mean in the logarithm, with z exceeded once in 200 / positions. 0 where
 * a position has fewer than 16 increments; -1: out of memory. */
double fbm_position_ratio(const fbm_positions *positions, int octave, double hurst, double *limit);

/* How increments were sampled. */
typedef struct fbm_sampling {
    int order;             /* 1 or 2 */
    bool area;             /* samples are means over their cells */
    double width, height;  /* of the raster, samples */
    double cell_x, cell_y; /* distance of samples, in the unit that delta counts in */
    double noise;          /* variance of white noise in the samples, as a quantum's, q^2 / 12 */
} fbm_sampling;

/* Moments by lag and direction: [lag index * FBM_DIRECTIONS + direction]. */
typedef fbm_moments fbm_moment_table[FBM_FIT_VALUES];

typedef enum fbm_refusal {
    FBM_FIT_GOOD = 0,
    FBM_FIT_SMALL,  /* too few increments, or at too few lags */
    FBM_FIT_FLAT,   /* increments are 0 or hidden by the noise: below four times its share */
    FBM_FIT_SMOOTH, /* smoother than any fBm: delta means nothing (order 2), H neither (order 1) */
} fbm_refusal;

typedef struct fbm_fit {
    fbm_refusal refusal;
    double hurst, hurst_error; /* error: one standard deviation, for fBm sampled like this */
    double delta, delta_error; /* standard deviation of increments over the unit distance; 0 where refused */
    double misfit;             /* chi-square over its degrees of freedom: 1 for fBm */
    int freedom;               /* degrees of freedom; 0: misfit is none */
    int lags;                  /* how many of 1, 2, 4 and 8 were used */
    /* The variance by direction a is fitted by log variance = mean + c cos 2a + s sin 2a. */
    double anisotropy, anisotropy_error; /* largest over smallest amplitude; its error */
    double angle;                        /* of the roughest direction, radians from the rows towards the columns */
    double isotropy_chance;              /* of an isotropic fBm to look as anisotropic as this, or more */
} fbm_fit;

/* The relative sampling covariance of mean squares of Gaussian fBm's increments: cov(A, B) / (E A E B) for all pairs of
 * lags and directions, when every position of the raster is sampled. Var = 2 / N sum_r w(r) rho(r)^2 with the
 * triangular window w of a finite raster, and rho the correlation of increments r apart, which follows from
 * E|Z(x+h) - Z(x)|^2 = |h|^2H alone (Isserlis' theorem). 0 for lags that do not fit. FALSE: no memory. */
bool fbm_increment_covariance(const fbm_sampling *sampling, double hurst,
                              double covariance[FBM_FIT_VALUES][FBM_FIT_VALUES]);

/* Least squares of the logarithms of mean squares, minus the noise's share, with their covariance: H common to all
 * directions, the amplitude each direction's own. `covariance` may be NULL: then it is computed (about 50 ms). The
 * generalised least-squares estimate of quadratic variations: G. Chan and A. T. A. Wood, "Increment-based estimators of
 * fractal dimension for two-dimensional surface data", Statistica Sinica 10 (2000), with their covariance in full.
 * False: no memory. */
bool fbm_fit_increments(const fbm_sampling *sampling, const fbm_moment_table moments,
                        const double covariance[FBM_FIT_VALUES][FBM_FIT_VALUES], fbm_fit *out);

/* Of increments of order 2 over one sample along rows and columns: skewness and excess kurtosis with the standard
 * deviations that Gaussian fBm of exponent `hurst` would give them, and the chance of such a field to depart as far or
 * farther (chi-square with two degrees of freedom). */
typedef struct fbm_normality {
    bool known; /* at least 1000 increments of each direction */
    double skewness, skewness_error, kurtosis, kurtosis_error, chance;
} fbm_normality;

/* `lag` is 1, 2, 4 or 8, by its index. False: no memory. */
bool fbm_normality_of(const fbm_sampling *sampling, const fbm_moment_table moments, int lag, double hurst,
                      fbm_normality *out);

#endif
