/* Gaussian noise that is keyed, not drawn: a value is a pure function of (seed, level, kind, row, column), so any
 * window of it can be made alone, in any order, on any thread. */
#ifndef FBM_RNG_H
#define FBM_RNG_H

#include <stddef.h>
#include <stdint.h>

/* Independent families of noise. The numbers are part of what a seed means: never change them. */
typedef enum fbm_noise_kind {
    FBM_NOISE_CENTRES = 0,      /* (i, j): the centre (i + 1/2, j + 1/2) of a cell */
    FBM_NOISE_ROW_EDGES = 1,    /* (i, j): the middle (i + 1/2, j) of an edge along a row */
    FBM_NOISE_COLUMN_EDGES = 2, /* (i, j): the middle (i, j + 1/2) of an edge along a column */
    FBM_NOISE_SPECTRUM = 3,     /* coefficients of the exact generator */
    FBM_NOISE_PLANE = 4,        /* slopes of its plane term */
    FBM_NOISE_VERTICES = 5,     /* (i, j): a vertex itself, as for simulated borders */
    FBM_NOISE_CELLS = 6,        /* (i, j): a child of a cell, as its mean */
    FBM_NOISE_ROWS = 7,         /* (i, j): the sample (i, j + 1/2) of a row put between two; the level is -1 - step */
    FBM_NOISE_ADDITIONS = 8,    /* (i, j): an old point of the finer lattice, moved by successive additions */
} fbm_noise_kind;

/* Writes the noise of columns first ... first + count - 1 of one row to out[count].
 *
 * Mean 0, variance 1 to 2e-4, Kolmogorov-Smirnov distance to N(0, 1) below 1e-3, |value| < 5. Values at different
 * columns, rows, levels, kinds or seeds are independent. All int64 rows and columns are good, as long as
 * first + count - 1 is an int64 too; nothing repeats with a period of 2^32.
 *
 * A value is the sum of four 16-bit uniforms, drawn towards the Gaussian by an odd polynomial of degree 7; the uniforms
 * are a hash of the column under two 32-bit keys, which are a hash of the rest. */
void fbm_noise_row(uint64_t seed, int32_t level, fbm_noise_kind kind, int64_t row, int64_t first, size_t count,
                   float *out);

#endif
