/* Row functions of the refinement, built once an instruction set. Private to fbm and its tests. */
#ifndef FBM_KERNEL_H
#define FBM_KERNEL_H

#include "fbm/refine.h"
#include "fbm/rng.h"

/* Every row pointer of a job points to the first column named with it; rows are read only where stated, `count` being
 * the number of points to make. `g` and `other` hold noise, or NULL where none is to be added. Coefficients are ready
 * to use: the taps hold the amplitude. */
typedef struct fbm_centre_job {
    const float *z[6]; /* rows j - 2 ... j + 3, from column i - 2: count + 5 */
    const float *g[3]; /* centre noise of rows j - 1 ... j + 1, from column i - 1: count + 2 */
    float w[6], t[4];  /* orbits as in fbm_weights */
    float *partial[5]; /* scratch rows of count + 5 */
    float *out;        /* count centres from column i */
} fbm_centre_job;

/* Edges of one orientation lie between samples of two lattices: `side`, whose columns are half a cell off the edge's
 * (for an edge along a row: the vertices), and `same`, in the columns of the edges (then: the centres). */
typedef struct fbm_edge_job {
    const float *side[3];  /* rows -1, 0, +1 about the edge, from 3/2 cells before it: count + 3 */
    const float *same[4];  /* rows -3/2, -1/2, +1/2, +3/2, from 1 cell before: count + 2 */
    const float *g[3];     /* noise of this orientation, rows -1, 0, +1, from 1 cell before: count + 2 */
    const float *other[2]; /* noise of the other one, rows -1/2, +1/2, from 3/2 cells before: count + 3 */
    float w[8], t[4];
    float *partial[4]; /* scratch rows of count + 3 */
    float *out;        /* count edges */
} fbm_edge_job;

/* Coefficients that change along a row (see fbm/places.h): `part` of the way from the planes of the vertices above to
 * those below. The point x of a job lies in the block of vertex (first + x) >> shift, `half` a cell into its cell. */
typedef struct fbm_place_row {
    const float *above, *below; /* coefficient k of vertex v at [k * stride + v]; FBM_PLACES_SPARE more are read */
    size_t stride;
    float part;
    size_t first;
    int shift; /* 0 ... FBM_PLACES_SHIFT */
    bool half, square;
} fbm_place_row;

typedef struct fbm_kernel {
    const char *name; /* "avx2" */
    void (*noise)(uint64_t seed, int32_t level, fbm_noise_kind kind, int64_t row, int64_t first, size_t count,
                  float *out);
    void (*centres)(const fbm_centre_job *job, size_t count);
    void (*edges)(const fbm_edge_job *job, size_t count);
    /* The same with coefficients by place instead of the job's own. They work by eights: behind `out`, a job's scratch,
     * noise and side[1] there must be room for 8 floats more. */
    void (*place_centres)(const fbm_centre_job *job, const fbm_place_row *row, size_t count);
    void (*place_edges)(const fbm_edge_job *job, const fbm_place_row *row, size_t count);
    /* See fbm/places.h; exponents are in the table's range, `nodes` weighs the aspects, roots[x] is sqrt(1 - hurst[x]);
     * planes are `stride` apart. */
    void (*place_unit)(const fbm_places_table *table, const float *nodes, const float *hurst, const float *roots,
                       size_t count, size_t stride, float *out);
    /* From planes `stride` apart to planes of `count`. */
    void (*place_scale)(bool square, const float *strengths, size_t count, const float *unit, size_t stride,
                        float *out);
    /* out[x] = strength[x] 2^(-fall hurst[x]), to 4e-7 and what rounding fall hurst costs */
    void (*strengths)(const float *strength, const float *hurst, float fall, float *out, size_t count);
    /* out[x] = (a[x] + b[x]) / 2 + t g[x]; g may be NULL */
    void (*mean2)(const float *a, const float *b, const float *g, float t, float *out, size_t count);
    /* the same of the 4 corners (a[x], a[x + 1], b[x], b[x + 1]) */
    void (*mean4)(const float *a, const float *b, const float *g, float t, float *out, size_t count);
    /* g[x] *= (a[x] + b[x]) / 2, and the same of the 4 corners */
    void (*scale2)(const float *a, const float *b, float *g, size_t count);
    void (*scale4)(const float *a, const float *b, float *g, size_t count);
    /* out[2x] = even[x], out[2x + 1] = odd[x] */
    void (*interleave)(const float *even, const float *odd, float *out, size_t count);
} fbm_kernel;

/* The kernels that were built and that this processor runs, best first, ended by NULL; the last is the portable one. */
const fbm_kernel *const *fbm_kernels(void);

/* Noise of a step, columns counted modulo `period` unless that is 0. */
void fbm_step_noise(const fbm_kernel *kernel, const fbm_step *step, int64_t period, fbm_noise_kind kind, int64_t row,
                    int64_t first, size_t count, float *out);

/* The schemes that do not keep old samples (classic.c); the output must not be empty. */
size_t fbm_classic_scratch(void);
void fbm_classic_refine(const fbm_kernel *kernel, const fbm_step *step, bool children, const float *in,
                        const float *map, fbm_window in_window, float *out, fbm_window out_window, float *scratch);
void fbm_successive_centres(const fbm_kernel *kernel, const fbm_step *step, const float *in, const float *map,
                            fbm_window in_window, float *out, fbm_window cells, float *scratch);

/* fbm_refine_mapped and fbm_centres_mapped with a kernel of the caller's choice; `map` may be NULL. */
void fbm_refine_by(const fbm_kernel *kernel, const fbm_step *step, const float *in, const float *map,
                   fbm_window in_window, float *out, fbm_window out_window, float *scratch);
void fbm_refine_rows_by(const fbm_kernel *kernel, const fbm_row_step *step, const float *in, const float *map,
                        fbm_window in_window, float *out, fbm_window out_window, float *scratch);
void fbm_centres_by(const fbm_kernel *kernel, const fbm_step *step, const float *in, const float *map,
                    fbm_window in_window, float *out, fbm_window cells, float *scratch);

#endif
