/* Refinement of a lattice of heights by one level: every cell is halved in both directions.
 *
 * A level takes two half steps: first the centres of the cells, then the middles of their edges, which see the centres.
 * Vertex (i, j) of level l is vertex (2i, 2j) of level l + 1 and keeps its height, bit for bit (but for two classical
 * schemes). Noise is keyed by the
 * lattice coordinates of the new vertices, and every sum is taken in the same order wherever the window lies, so that
 * any window of a level, made alone, has the bits of the whole, on every instruction set.
 *
 * The functions are pure: the caller's memory, no allocation, no failure; contracts are asserted. */
#ifndef FBM_REFINE_H
#define FBM_REFINE_H

#include "fbm/aspect.h"
#include "fbm/places.h"
#include "fbm/weights.h"
#include "fbm/window.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* A rule of refinement, found by name. */
typedef struct fbm_scheme {
    const char *name;    /* "stationary" */
    const char *summary; /* one line */
    /* Coefficients for a Hurst exponent (clamped to FBM_HURST_MIN ... FBM_HURST_MAX). */
    void (*weights)(double hurst, fbm_weights *out);
    /* The same for cells of width `aspect` and height 1, as values. */
    void (*values)(double hurst, double aspect, double values[FBM_WEIGHT_VALUES]);
    int margin; /* cells of level l that fbm_refine needs beyond the output on every side: see fbm_refine_support */
    int centre_before; /* the centre of cell (i, j) needs samples i - centre_before ... */
    int centre_after;  /* ... i + centre_after, likewise for rows */
    int rule;          /* which row functions; private */
    bool moves;        /* old samples move: the finer level does not contain the coarser one */
    bool cells;        /* refines cells, not vertices: sample (i, j) becomes (2i, 2j) ... (2i + 1, 2j + 1), a quarter
                          of a cell off it; there is no fbm_centres */
} fbm_scheme;

/* The schemes, ended by an entry whose name is NULL. The first is the default. */
extern const fbm_scheme fbm_schemes[];
/* NULL where there is none of this name. */
const fbm_scheme *fbm_scheme_find(const char *name);

/* One step, from level `level` to level + 1. */
typedef struct fbm_step {
    const fbm_scheme *scheme;
    fbm_weights weights; /* by scheme->weights; may be scaled or replaced by the caller */
    /* Weights that change from row to row, as where cells grow narrow towards a pole; NULL: `weights` everywhere. Entry
     * 2j - first_row is for edges along row j, the next for centres and for edges along columns between it and row j +
     * 1. It must hold what any row of the support may ask for: rows -1 ... height of the input. */
    const fbm_weights *rows;
    int64_t first_row;
    /* Factor on all noise. For fBm with E|Z(x+h) - Z(x)|^2 = delta^2 |h|^(2H) and the input's spacing s in units of h
     * it is delta s^H; a measured schedule may give any other. 0: no noise is made, the surface is smooth. */
    float amplitude;
    uint64_t seed;
    int32_t level; /* of the input; a key of the noise, nothing else */
    /* Columns of the input after which the noise comes again, so that a surface that goes around a globe joins; 0: it
     * never does. */
    int64_t period;
    /* Coefficients that change from place to place, instead of `weights`, `rows` and `amplitude` (of which counts only
     * whether it is 0); see fbm_scheme_has_places. NULL: they do not. */
    const fbm_places *places;
} fbm_step;

/* Whether steps of a scheme may have coefficients by place. */
bool fbm_scheme_has_places(const fbm_scheme *scheme);

/* The input window of level l from which fbm_refine makes the window `out` of level l + 1: from column
 * floor(out.i / 2) - margin to floor((out.i + out.width - 1) / 2) + margin, likewise for rows, so that a halo of h
 * samples around the output asks for one of ceil(h / 2) + margin around the input. `stride` of the result is its width.
 */
fbm_window fbm_refine_support(const fbm_scheme *scheme, fbm_window out);
/* The same for fbm_centres; `cells` as there. */
fbm_window fbm_centres_support(const fbm_scheme *scheme, fbm_window cells);

/* Floats of scratch that fbm_refine needs for an output of this width, and fbm_centres for half as many cells: at most
 * 46,000, whatever the height. Never less for a greater width, so one scratch serves every window up to it. */
size_t fbm_refine_scratch(size_t width);

/* Makes the window `out_window` of level step->level + 1, in coordinates of that level (odd ones are good), from a
 * window of level step->level that holds fbm_refine_support(). in, out and scratch must not overlap. A NaN in the input
 * spreads to the new samples that see it. */
void fbm_refine(const fbm_step *step, const float *in, fbm_window in_window, float *out, fbm_window out_window,
                float *scratch);

/* The same with a strength that varies: all noise is multiplied by `map`, factors at the input's vertices (of the
 * window `in_window`, with its stride) that are interpolated to where the noise is: the mean of an edge's two ends or
 * of a cell's four corners. Refined by means from level to level (scheme "square", amplitude 0), a map is bilinear
 * between the vertices where it began. NULL: 1 everywhere. */
void fbm_refine_mapped(const fbm_step *step, const float *in, const float *map, fbm_window in_window, float *out,
                       fbm_window out_window, float *scratch);

/* Only the first half step: the centres of the cells `cells`, where cell (i, j) has its centre at (i + 1/2, j + 1/2) of
 * level step->level. Equal, bit for bit, to the samples (2i + 1, 2j + 1) that fbm_refine makes. `scratch` as for an
 * output twice as wide. */
void fbm_centres(const fbm_step *step, const float *in, fbm_window in_window, float *out, fbm_window cells,
                 float *scratch);
void fbm_centres_mapped(const fbm_step *step, const float *in, const float *map, fbm_window in_window, float *out,
                        fbm_window cells, float *scratch);

/* ---- Rows between rows ------------------------------------------------------------------------- */

/* A step that halves the rows' spacing: row j becomes row 2j, and keeps its heights bit for bit. */
typedef struct fbm_row_step {
    fbm_row_weights weights;
    const fbm_row_weights *rows; /* NULL, or the weights between rows j and j + 1 at [j - first_row] */
    int64_t first_row;
    float amplitude; /* delta dy^H, dy the spacing of the rows before */
    uint64_t seed;
    int32_t level; /* of the noise: -1 - step, counted from the raster's own rows */
    int64_t period;
} fbm_row_step;

/* The input from which fbm_refine_rows makes `out`: 3 columns more on either side, a row more above and 2 below. */
fbm_window fbm_rows_support(fbm_window out);
/* Floats of scratch that fbm_refine_rows needs for an output of this width, at most 5 a column and 30. */
size_t fbm_rows_scratch(size_t width);
/* `map` as in fbm_refine_mapped. */
void fbm_refine_rows(const fbm_row_step *step, const float *in, const float *map, fbm_window in_window, float *out,
                     fbm_window out_window, float *scratch);

#endif
