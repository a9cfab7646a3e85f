/* Exact fractional Brownian surfaces, whole, by circulant embedding: M. L. Stein, "Fast and exact simulation of
 * fractional Brownian surfaces", J. Comput. Graph. Stat. 11 (2002). */
#ifndef FBM_EXACT_H
#define FBM_EXACT_H

#include "fbm/status.h"

#include <stddef.h>
#include <stdint.h>

/* Largest side, for which fbm_exact takes 10 GB (hurst <= 0.75) or 30 GB. */
#define FBM_EXACT_SIZE_MAX 16384

/* Bytes that fbm_exact allocates at its peak, without the output; 0 for sizes that it refuses. About 39 n^2 for
 * hurst <= 0.75, 110 n^2 above. */
size_t fbm_exact_memory(size_t size, double aspect, double hurst);

/* Writes a size x size field to out[size * size], with Gaussian increments of mean 0 and
 * E|Z(x + h) - Z(x)|^2 = delta^2 |h|^(2H), h in samples, for every pair of samples. Z is 0 at the first sample.
 *
 * hurst is clamped to [0.01, 0.99]; size >= 1. FBM_TOO_LARGE where fbm_exact_memory is 0. On failure out is untouched.
 */
fbm_status fbm_exact(size_t size, double hurst, double delta, uint64_t seed, float *out);

/* The same with columns at distance `aspect` (0.2 ... 5), rows being at distance 1; it takes up to 25 times the memory.
 */
fbm_status fbm_exact_cells(size_t size, double aspect, double hurst, double delta, uint64_t seed, float *out);

#endif
