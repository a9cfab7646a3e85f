/* A rectangle of a lattice. */
#ifndef FBM_WINDOW_H
#define FBM_WINDOW_H

#include <stddef.h>
#include <stdint.h>

/* How it lies in memory: sample (i + x, j + y) is at [y * stride + x]. */
typedef struct fbm_window {
    int64_t i, j;         /* lattice coordinates of the first sample; |i|, |j| < 2^61 */
    size_t width, height; /* samples */
    size_t stride;        /* floats between the beginnings of rows, >= width */
} fbm_window;

#endif
