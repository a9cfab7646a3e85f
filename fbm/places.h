/* Coefficients of a refinement step that change from place to place, with a Hurst exponent and a strength that are
 * fields.
 *
 * At the vertices of a coarser lattice, 2^shift vertices of the step's input apart, they are those of the exponent
 * there, the noise multiplied by
 *   strength 2^(-fall H);
 * between them they are bilinear. A predictor between two predictors is one, too, so nothing rings where the exponent
 * jumps, and at a depth of `shift` levels and more the exponent itself is all but bilinear between the nodes where it
 * was given. Where exponent and strength do not change, the coefficients are those of a step without places, to
 * rounding. */
#ifndef FBM_PLACES_H
#define FBM_PLACES_H

#include "fbm/aspect.h"
#include "fbm/window.h"

#include <stdbool.h>
#include <stddef.h>

/* The knots of exponents, 1/1024 apart: the predictor bends most at the lower end, by 37 a unit squared, and a straight
 * line misses that by 37 / 1024^2 / 8 < 5e-6. */
enum { FBM_PLACES_STEPS = 1004 };
#define FBM_PLACES_LOW 0.01F
#define FBM_PLACES_KNOTS_PER_UNIT 1024.4898F /* 1004 / 0.98 */

/* Most levels that the vertices of coefficients lie above the step's input. */
enum { FBM_PLACES_SHIFT = 3 };
/* Floats behind the last value that are read, too; they must be finite. */
enum { FBM_PLACES_SPARE = 8 };

typedef struct fbm_places {
    int shift;           /* 0 ... FBM_PLACES_SHIFT */
    bool square;         /* of the table that the values are of */
    fbm_window window;   /* vertices (i, j), vertices (i << shift, j << shift) of the input; they must span it */
    const float *values; /* fbm_places_size(square) a vertex: row by row, each in planes of window.width; and
                            FBM_PLACES_SPARE */
} fbm_places;

/* Coefficients by exponent, at knots so close that straight lines between them are within 5e-6 of the curves. */
typedef struct fbm_places_table {
    bool square;
    int nodes;           /* of the aspect: 1, or FBM_ASPECT_NODES */
    double low, step;    /* log2 of the first aspect, and between them */
    const float *values; /* [knot][node][fbm_places_unit_size] */
} fbm_places_table;

/* Floats that a table needs for aspects of which `low` and `high` are the binary logarithms. */
size_t fbm_places_table_size(double low, double high);
/* Makes the table in `values`, which it keeps pointing to. Some 5 ms for squares (low == high == 0), 40 ms for cells of
 * one other shape, 200 ms for a range. */
void fbm_places_table_make(double low, double high, float *values, fbm_places_table *out);

/* Floats a vertex in what fbm_places_unit and fbm_places_scale make, those for centres before those for edges of either
 * direction. */
size_t fbm_places_size(bool square);

/* The coefficients of a row of `count` vertices with these exponents (of FBM_HURST_MIN ... FBM_HURST_MAX) and strength
 * 1, where cells have the aspect 2^log_aspect: planes of `count`, one a coefficient. */
void fbm_places_unit(const fbm_places_table *table, double log_aspect, const float *hurst, size_t count, float *unit);
/* out[x] = strength[x] 2^(-fall hurst[x]), of |fall| <= 64 */
void fbm_places_strengths(double fall, const float *strength, const float *hurst, size_t count, float *out);
/* Coefficients with the noise multiplied by strengths >= 0, from planes `stride` apart, so that `count` may be a part
 * of a row. */
void fbm_places_scale(const fbm_places_table *table, const float *strengths, size_t count, const float *unit,
                      size_t stride, float *values);

#endif
