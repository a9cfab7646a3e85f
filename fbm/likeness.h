/* How like a surface is to another that it stands for: their statistics below a cell that is known, not their heights.
 */
#ifndef FBM_LIKENESS_H
#define FBM_LIKENESS_H

#include <stdbool.h>
#include <stddef.h>

typedef struct fbm_likeness {
    /* Largest |ln(S / S_truth)| of the structure functions S(h) = mean (z(x + h) - z(x))^2 at the lags 1, 2, 4 ...
     * 2 factor along rows, columns and both diagonals. */
    double structure;
    /* Root mean square of log10(P / P_truth) over 12 bands of frequency between 1 / (2 factor) and 1/2, of equal ratio:
     * P is the radial power of the middle square, less its plane, under a Hann window. */
    double spectrum;
    /* Wasserstein-1 distance of the distributions of slopes, in degrees. */
    double slope;
    double rms; /* of the differences of heights */
} fbm_likeness;

/* Compares two surfaces of width x height samples (finite, rows without gaps), of which only every `factor`-th cell's
 * mean was known; a frame of 2 factor samples is left out. cell_x, cell_y: spacing in units of height. False where
 * memory is short, or less than 4 factor samples are left. */
bool fbm_likeness_measure(const float *candidate, const float *truth, size_t width, size_t height, int factor,
                          double cell_x, double cell_y, fbm_likeness *out);

#endif
