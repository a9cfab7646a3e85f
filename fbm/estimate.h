/* How rough a raster is at its finest scales: the detail that a halving of the spacing adds. */
#ifndef FBM_ESTIMATE_H
#define FBM_ESTIMATE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* What one octave adds. Take 2 x 2 children and their mean, predict the children from the parents' means by the
 * separable rule z -+ D, D = .22405 (z1 - z-1) - .06762 (z2 - z-2) + .01206 (z3 - z-3), and expand the children minus
 * the prediction in the three Haar details (x, y and mixed) of the block: these are the octave's details. Their
 * energies, over blocks at every offset, are summed here. A sum of squares of all three, over the count, is the
 * variance of the children about the prediction. */
typedef struct fbm_detail {
    double x, y, mixed; /* sums of squares */
    uint64_t count;
} fbm_detail;

/* Samples beyond a block that the first and second octave look at, before and after. */
enum { FBM_DETAIL_BEFORE = 12, FBM_DETAIL_AFTER = 15 };

/* Adds the details of both octaves for the blocks that begin at columns x0 ... x1 - 1 and rows y0 ... y1 - 1 of a
 * window of width x height heights. Octave 0 is the finest (children: the samples themselves), octave 1 that of the 2 x
 * 2 means. Blocks whose support leaves the window or meets a NaN are left out. `scratch` holds 3 * width * height
 * floats. */
void fbm_detail_add(const float *heights, size_t width, size_t height, size_t x0, size_t y0, size_t x1, size_t y1,
                    float *scratch, fbm_detail octaves[2]);

/* The variance of an octave's details when white noise of variance `noise` in the samples (quantisation: quantum^2 /
 * 12) is taken off; at least a quarter of the raw one remains. `octave` 0 or 1. 0 where there is no block. */
double fbm_detail_variance(const fbm_detail *detail, int octave, double noise);

/* The same variance for fBm with E|Z(x+h) - Z(x)|^2 = |h|^(2H) and parents at distance 1; `area`: samples are means
 * over their cells, not points. By exact covariance, the cells' means by a 16 x 16 midpoint rule. hurst in (0, 1). */
double fbm_detail_of_fbm(double hurst, bool area);
/* The same where the children are means of points x points evenly spaced points (1: points; 0: whole cells). */
double fbm_detail_of_means(double hurst, int points);

#endif
