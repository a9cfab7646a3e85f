/* Walks a window row by row, holding the few rows of centres and noise that the stencils see. The arithmetic is in
 * kernel.c. */
#include "fbm/refine.h"

#include "fbm/kernel.h"

#include <assert.h>
#include <stdbool.h>
#include <string.h>

enum { RULE_STENCIL24, RULE_MEANS, RULE_CHILDREN, RULE_ADDITIONS };

const fbm_scheme fbm_schemes[] = {
    {"stationary", "fractional Brownian motion: 24-point predictor, filtered residual (within 1 % of theory)",
     fbm_weights_stationary, fbm_values_stationary, 4, 2, 3, RULE_STENCIL24, false, false},
    {"square", "square subdivision of Hu and Wang: means of corners and ends, independent noise (for comparison)",
     fbm_weights_square, fbm_values_square, 1, 0, 1, RULE_MEANS, false, false},
    {"diamond-square", "means of four corners, then of four neighbours, independent noise (for comparison)",
     fbm_weights_diamond, fbm_values_diamond, 4, 2, 3, RULE_STENCIL24, false, false},
    {"square-square", "Miller's subdivision of cells by weights 9, 3, 3, 1 (for comparison; moves samples)",
     fbm_weights_children, fbm_values_children, 1, 0, 0, RULE_CHILDREN, true, true},
    {"successive", "diamond-square with Voss's additions to the old points too (for comparison; moves samples)",
     fbm_weights_diamond, fbm_values_diamond, 1, 0, 1, RULE_ADDITIONS, true, false},
    {.name = NULL},
};

const fbm_scheme *fbm_scheme_find(const char *name)
{
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++)
        if (!strcmp(scheme->name, name))
            return scheme;
    return NULL;
}

bool fbm_scheme_has_places(const fbm_scheme *scheme)
{
    return scheme->values == fbm_values_stationary;
}

/* An assertion whose condition counts as used where assertions are off. */
static void require(bool met)
{
    assert(met);
    (void)met;
}

/* floor(a / 2), for negative numbers too */
static int64_t half(int64_t a)
{
    return (a - (a & 1)) / 2;
}

fbm_window fbm_refine_support(const fbm_scheme *scheme, fbm_window out)
{
    assert(out.width && out.height);
    int64_t last_i = half(out.i + (int64_t)out.width - 1), last_j = half(out.j + (int64_t)out.height - 1);
    fbm_window in = {.i = half(out.i) - scheme->margin, .j = half(out.j) - scheme->margin};
    in.width = (size_t)(last_i + scheme->margin - in.i + 1);
    in.height = (size_t)(last_j + scheme->margin - in.j + 1);
    in.stride = in.width;
    return in;
}

fbm_window fbm_centres_support(const fbm_scheme *scheme, fbm_window cells)
{
    size_t more = (size_t)(scheme->centre_before + scheme->centre_after);
    return (fbm_window){cells.i - scheme->centre_before, cells.j - scheme->centre_before, cells.width + more,
                        cells.height + more, cells.width + more};
}

/* ---- The walk ---------------------------------------------------------------------------------- */

/* Most columns of cells that are made at a time, so that 22 rows of scratch stay in a second-level cache. Narrower
 * strips that would fit into the first level are slower: they write the output in short pieces. */
enum { STRIP = 2048, RING = 4, MARGIN = 16, PARTIALS = 5, ROWS = 4 * RING + PARTIALS + 1, LINE = 16 };

/* Floats of a scratch row for n cells. Odd multiples of a cache line, lest the rows fall into the same few sets. */
static size_t row_size(size_t n)
{
    return (n + MARGIN + 15) / 16 * 16 | 16;
}

/* Cells a strip when `cells` are made in strips of equal width (but for the last). */
static size_t strip_size(size_t cells)
{
    size_t strips = (cells - 1) / STRIP + 1;
    return (cells - 1) / strips + 1;
}

size_t fbm_refine_scratch(size_t width)
{
    size_t cells = width / 2 + 1, rows = ROWS * row_size(cells < STRIP ? cells : STRIP) + LINE;
    return rows > fbm_classic_scratch() ? rows : fbm_classic_scratch();
}

typedef struct walk {
    const fbm_kernel *kernel;
    const fbm_step *step;
    const float *in, *map;
    fbm_window from;
    int64_t column; /* of the first cell of the strip */
    size_t count;   /* cells of the strip */
    bool noisy;
    /* Rings of rows, row j at [j & 3]; first columns relative to `column` in brackets. */
    float *centre[RING];       /* [-2], count + 3 */
    float *centre_noise[RING]; /* [-3], count + 5 */
    float *row_noise[RING];    /* of edges along rows: [-2], count + 3 */
    float *column_noise[RING]; /* of edges along columns: [-1], count + 3 */
    float *partial[PARTIALS];
    float *edge; /* [0], count */
} walk;

static const float *input(const walk *w, int64_t column, int64_t row)
{
    return w->in + (size_t)(row - w->from.j) * w->from.stride + (size_t)(column - w->from.i);
}

static const float *factors(const walk *w, int64_t column, int64_t row)
{
    return w->map + (size_t)(row - w->from.j) * w->from.stride + (size_t)(column - w->from.i);
}

static float *ring_row(float *const ring[RING], int64_t row)
{
    return ring[row & (RING - 1)];
}

static void unit_noise(const walk *w, fbm_noise_kind kind, int64_t row, int64_t first, size_t count, float *out)
{
    fbm_step_noise(w->kernel, w->step, w->step->period, kind, row, first, count, out);
}

/* Multiplies noise by the map at its vertices' means. */
static void apply_map(const walk *w, fbm_noise_kind kind, int64_t row, int64_t first, size_t count, float *noise)
{
    const float *at = factors(w, first, row);
    if (kind == FBM_NOISE_ROW_EDGES)
        w->kernel->scale2(at, at + 1, noise, count);
    else if (kind == FBM_NOISE_COLUMN_EDGES)
        w->kernel->scale2(at, at + w->from.stride, noise, count);
    else
        w->kernel->scale4(at, at + w->from.stride, noise, count);
}

static void noise_row(const walk *w, fbm_noise_kind kind, int64_t row, int64_t first, size_t count, float *out)
{
    unit_noise(w, kind, row, first, count, out);
    if (w->map)
        apply_map(w, kind, row, first, count, out);
}

/* The noise of `count` points, rounded up to whole vectors, for which the rows have room. */
static void make_noise(const walk *w, float *const ring[RING], fbm_noise_kind kind, int64_t row, int64_t first,
                       size_t count)
{
    unit_noise(w, kind, row, first, (count + 7) / 8 * 8, ring_row(ring, row));
    if (w->map)
        apply_map(w, kind, row, first, count, ring_row(ring, row));
}

static void start(walk *w, const fbm_kernel *kernel, const fbm_step *step, const float *in, const float *map,
                  fbm_window from, float *scratch, size_t cells)
{
    *w = (walk){.kernel = kernel, .step = step, .in = in, .map = map, .from = from, .noisy = step->amplitude != 0};
    size_t size = row_size(strip_size(cells));
    scratch += -((uintptr_t)scratch / sizeof *scratch) % LINE;
    float **rows[] = {w->centre, w->centre_noise, w->row_noise, w->column_noise};
    for (int k = 0; k < 4; k++)
        for (int r = 0; r < RING; r++, scratch += size)
            rows[k][r] = scratch;
    for (int k = 0; k < PARTIALS; k++, scratch += size)
        w->partial[k] = scratch;
    w->edge = scratch;
}

/* Weights of row j, or of what lies between it and the next. */
static const fbm_weights *weights_at(const walk *w, int64_t j, bool between)
{
    const fbm_step *step = w->step;
    return step->rows ? step->rows + (2 * j + between - step->first_row) : &step->weights;
}

/* The coefficients of points in a row of input row j, from column i on. */
static fbm_place_row place_row(const walk *w, fbm_noise_kind kind, int64_t i, int64_t j, size_t count)
{
    const fbm_places *places = w->step->places;
    const fbm_window *at = &places->window;
    const int shift = places->shift;
    const size_t unit = (size_t)2 << shift, planes = fbm_places_size(places->square);
    const size_t down = (size_t)(2 * (j - at->j * ((int64_t)1 << shift)) + (kind != FBM_NOISE_ROW_EDGES));
    const size_t first = (size_t)(i - at->i * ((int64_t)1 << shift)), row = down >> (shift + 1);
    const float part = (float)(down & (unit - 1)) / (float)unit;
    const float *from = places->values + row * at->width * planes;
    if (kind != FBM_NOISE_CENTRES)
        from += (places->square ? 6 : 9) * at->width;
    require(i >= at->i * ((int64_t)1 << shift) && (first + count - 1) >> shift < at->width &&
            row + (part > 0) < at->height);
    return (fbm_place_row){.above = from,
                           .below = part > 0 ? from + at->width * planes : from,
                           .stride = at->width,
                           .part = part,
                           .first = first,
                           .shift = shift,
                           .half = kind != FBM_NOISE_COLUMN_EDGES,
                           .square = places->square};
}

static void scale_taps(const walk *w, const float taps[4], float *out)
{
    for (int k = 0; k < 4; k++)
        out[k] = w->step->amplitude * taps[k];
}

/* ---- The 24-point stencil ---------------------------------------------------------------------- */

/* Centres of `count` cells of row j from cell i on; the noise of rows j - 1 ... j + 1 is there, from cell i - 1 on. */
static void stencil_centres(const walk *w, int64_t i, int64_t j, size_t count, float *out)
{
    fbm_centre_job job = {.out = out};
    for (int k = 0; k < 6; k++)
        job.z[k] = input(w, i - 2, j - 2 + k);
    if (w->noisy)
        for (int k = 0; k < 3; k++)
            job.g[k] = ring_row(w->centre_noise, j - 1 + k);
    memcpy(job.partial, w->partial, sizeof job.partial);
    if (w->step->places) {
        fbm_place_row row = place_row(w, FBM_NOISE_CENTRES, i, j, count);
        w->kernel->place_centres(&job, &row, count);
        return;
    }
    const fbm_weights *weights = weights_at(w, j, true);
    memcpy(job.w, weights->centre, sizeof job.w);
    scale_taps(w, weights->centre_taps, job.t);
    w->kernel->centres(&job, count);
}

/* Row j of the centres that the edges of the strip see; rows must be made in order. */
static void next_centres(const walk *w, int64_t j)
{
    if (w->noisy)
        make_noise(w, w->centre_noise, FBM_NOISE_CENTRES, j + 1, w->column - 3, w->count + 5);
    stencil_centres(w, w->column - 2, j, w->count + 3, ring_row(w->centre, j));
}

static void next_edge_noise(const walk *w, int64_t j)
{
    if (!w->noisy)
        return;
    make_noise(w, w->row_noise, FBM_NOISE_ROW_EDGES, j, w->column - 2, w->count + 3);
    make_noise(w, w->column_noise, FBM_NOISE_COLUMN_EDGES, j, w->column - 1, w->count + 3);
}

/* Makes the edges of a job whose rows are there. */
static void make_edges(const walk *w, fbm_noise_kind kind, int64_t j, fbm_edge_job *job)
{
    memcpy(job->partial, w->partial, sizeof job->partial);
    job->out = w->edge;
    if (w->step->places) {
        fbm_place_row row = place_row(w, kind, w->column, j, w->count);
        w->kernel->place_edges(job, &row, w->count);
        return;
    }
    const fbm_weights *weights = weights_at(w, j, kind == FBM_NOISE_COLUMN_EDGES);
    memcpy(job->w, weights->edge, sizeof job->w);
    scale_taps(w, weights->edge_taps, job->t);
    w->kernel->edges(job, w->count);
}

/* Edges along row j: vertices beside them, centres above and below. */
static void stencil_row_edges(const walk *w, int64_t j)
{
    fbm_edge_job job = {.g = {NULL}};
    for (int k = 0; k < 3; k++) {
        job.side[k] = input(w, w->column - 1, j - 1 + k);
        if (w->noisy)
            job.g[k] = ring_row(w->row_noise, j - 1 + k) + 1;
    }
    for (int k = 0; k < 4; k++)
        job.same[k] = ring_row(w->centre, j - 2 + k) + 1;
    for (int k = 0; k < 2; k++)
        job.other[k] = ring_row(w->column_noise, j - 1 + k);
    if (w->step->places) { /* the input has no room behind it */
        memcpy(w->partial[PARTIALS - 1], job.side[1], (w->count + 3) * sizeof *job.out);
        job.side[1] = w->partial[PARTIALS - 1];
    }
    make_edges(w, FBM_NOISE_ROW_EDGES, j, &job);
}

/* Edges along columns, between rows j and j + 1: centres beside them, vertices above and below. */
static void stencil_column_edges(const walk *w, int64_t j)
{
    fbm_edge_job job = {.g = {NULL}};
    for (int k = 0; k < 3; k++) {
        job.side[k] = ring_row(w->centre, j - 1 + k);
        if (w->noisy)
            job.g[k] = ring_row(w->column_noise, j - 1 + k);
    }
    for (int k = 0; k < 4; k++)
        job.same[k] = input(w, w->column - 1, j - 1 + k);
    for (int k = 0; k < 2; k++)
        job.other[k] = ring_row(w->row_noise, j + k);
    make_edges(w, FBM_NOISE_COLUMN_EDGES, j, &job);
}

/* ---- Means ------------------------------------------------------------------------------------- */

static void mean_centres(const walk *w, int64_t i, int64_t j, size_t count, float *out)
{
    float *noise = w->noisy ? w->partial[0] : NULL;
    if (noise)
        noise_row(w, FBM_NOISE_CENTRES, j, i, count, noise);
    float tap = w->step->amplitude * weights_at(w, j, true)->centre_taps[0];
    w->kernel->mean4(input(w, i, j), input(w, i, j + 1), noise, tap, out, count);
}

static void mean_edges(const walk *w, fbm_noise_kind kind, int64_t j)
{
    float *noise = w->noisy ? w->partial[0] : NULL;
    if (noise)
        noise_row(w, kind, j, w->column, w->count, noise);
    const float *ends = input(w, w->column, j);
    bool along = kind == FBM_NOISE_ROW_EDGES;
    const float *others = along ? ends + 1 : input(w, w->column, j + 1);
    const fbm_weights *weights = weights_at(w, j, !along);
    float tap = w->step->amplitude * (along ? weights->edge_taps[0] : weights->column_tap);
    w->kernel->mean2(ends, others, noise, tap, w->edge, w->count);
}

/* ---- Schemes ----------------------------------------------------------------------------------- */

/* Brings the rings to where row_edges(first row) can start. */
static void prime(const walk *w, int64_t j)
{
    if (w->step->scheme->rule != RULE_STENCIL24)
        return;
    if (w->noisy)
        for (int64_t r = j - 3; r < j - 1; r++)
            make_noise(w, w->centre_noise, FBM_NOISE_CENTRES, r, w->column - 3, w->count + 5);
    for (int64_t r = j - 2; r <= j; r++)
        next_centres(w, r);
    next_edge_noise(w, j - 1);
    next_edge_noise(w, j);
}

/* Makes the centres of row j + 1 and the noise beyond, which the edges of row j need. Rows come in order. */
static void advance(const walk *w, int64_t j)
{
    if (w->step->scheme->rule != RULE_STENCIL24)
        return;
    next_centres(w, j + 1);
    next_edge_noise(w, j + 1);
}

static const float *row_edges(const walk *w, int64_t j)
{
    if (w->step->scheme->rule == RULE_STENCIL24)
        stencil_row_edges(w, j);
    else
        mean_edges(w, FBM_NOISE_ROW_EDGES, j);
    return w->edge;
}

static const float *column_edges(const walk *w, int64_t j)
{
    if (w->step->scheme->rule == RULE_STENCIL24)
        stencil_column_edges(w, j);
    else
        mean_edges(w, FBM_NOISE_COLUMN_EDGES, j);
    return w->edge;
}

/* Centres of row j in the columns of the strip. */
static const float *centre_row(const walk *w, int64_t j)
{
    if (w->step->scheme->rule == RULE_STENCIL24)
        return ring_row(w->centre, j) + 2;
    mean_centres(w, w->column, j, w->count, w->centre[0]);
    return w->centre[0];
}

/* ---- Entry points ------------------------------------------------------------------------------ */

/* Samples 2 * column ... of a fine row, clipped to the window: `even` and `odd` hold the strip's. */
static void put_row(const walk *w, const float *even, const float *odd, float *row, fbm_window to)
{
    int64_t begin = 2 * w->column - to.i, end = begin + 2 * (int64_t)w->count;
    size_t count = w->count;
    if (begin < 0) {
        row[0] = odd[0];
        even++, odd++, count--, begin += 2;
    }
    if (end > (int64_t)to.width) {
        count--;
        row[to.width - 1] = even[count];
    }
    w->kernel->interleave(even, odd, row + begin, count);
}

static void refine_strip(const walk *w, float *out, fbm_window to)
{
    int64_t first = half(to.j), last = half(to.j + (int64_t)to.height - 1);
    prime(w, first);
    for (int64_t j = first; j <= last; j++) {
        int64_t y = 2 * j - to.j; /* may be -1 for the first row */
        float *row = out + (size_t)(y < 0 ? 0 : y) * to.stride;
        advance(w, j);
        if (y >= 0) {
            put_row(w, input(w, w->column, j), row_edges(w, j), row, to);
            row += to.stride;
        }
        if (y + 1 < (int64_t)to.height)
            put_row(w, column_edges(w, j), centre_row(w, j), row, to);
    }
}

static bool contains(fbm_window outer, fbm_window inner)
{
    return inner.i >= outer.i && inner.j >= outer.j &&
           inner.i + (int64_t)inner.width <= outer.i + (int64_t)outer.width &&
           inner.j + (int64_t)inner.height <= outer.j + (int64_t)outer.height && outer.stride >= outer.width;
}

void fbm_refine_by(const fbm_kernel *kernel, const fbm_step *step, const float *in, const float *map,
                   fbm_window in_window, float *out, fbm_window out_window, float *scratch)
{
    if (!out_window.width || !out_window.height)
        return;
    require(contains(in_window, fbm_refine_support(step->scheme, out_window)) && out_window.stride >= out_window.width);
    require(!step->places || fbm_scheme_has_places(step->scheme));
    int rule = step->scheme->rule;
    if (rule == RULE_CHILDREN || rule == RULE_ADDITIONS) {
        fbm_classic_refine(kernel, step, rule == RULE_CHILDREN, in, map, in_window, out, out_window, scratch);
        return;
    }
    int64_t first = half(out_window.i), last = half(out_window.i + (int64_t)out_window.width - 1);
    size_t cells = (size_t)(last - first + 1), strip = strip_size(cells);
    walk w;
    start(&w, kernel, step, in, map, in_window, scratch, cells);
    for (size_t x = 0; x < cells; x += strip) {
        w.column = first + (int64_t)x;
        w.count = cells - x < strip ? cells - x : strip;
        refine_strip(&w, out, out_window);
    }
}

void fbm_centres_by(const fbm_kernel *kernel, const fbm_step *step, const float *in, const float *map,
                    fbm_window in_window, float *out, fbm_window cells, float *scratch)
{
    if (!cells.width || !cells.height)
        return;
    require(contains(in_window, fbm_centres_support(step->scheme, cells)) && cells.stride >= cells.width);
    require(!step->scheme->cells);
    if (step->scheme->rule == RULE_ADDITIONS) {
        fbm_successive_centres(kernel, step, in, map, in_window, out, cells, scratch);
        return;
    }
    walk w;
    start(&w, kernel, step, in, map, in_window, scratch, cells.width);
    size_t strip = strip_size(cells.width);
    for (size_t x = 0; x < cells.width; x += strip) {
        size_t count = cells.width - x < strip ? cells.width - x : strip;
        int64_t i = cells.i + (int64_t)x;
        bool ring = w.noisy && step->scheme->rule == RULE_STENCIL24;
        for (int64_t j = cells.j - 1; ring && j <= cells.j; j++)
            make_noise(&w, w.centre_noise, FBM_NOISE_CENTRES, j, i - 1, count + 2);
        for (size_t y = 0; y < cells.height; y++) {
            int64_t j = cells.j + (int64_t)y;
            float *row = out + y * cells.stride + x;
            if (ring)
                make_noise(&w, w.centre_noise, FBM_NOISE_CENTRES, j + 1, i - 1, count + 2);
            if (step->places) { /* which are made by eights */
                stencil_centres(&w, i, j, count, w.edge);
                memcpy(row, w.edge, count * sizeof *row);
            } else if (step->scheme->rule == RULE_STENCIL24)
                stencil_centres(&w, i, j, count, row);
            else
                mean_centres(&w, i, j, count, row);
        }
    }
}

void fbm_refine_mapped(const fbm_step *step, const float *in, const float *map, fbm_window in_window, float *out,
                       fbm_window out_window, float *scratch)
{
    fbm_refine_by(fbm_kernels()[0], step, in, map, in_window, out, out_window, scratch);
}

void fbm_refine(const fbm_step *step, const float *in, fbm_window in_window, float *out, fbm_window out_window,
                float *scratch)
{
    fbm_refine_mapped(step, in, NULL, in_window, out, out_window, scratch);
}

void fbm_centres_mapped(const fbm_step *step, const float *in, const float *map, fbm_window in_window, float *out,
                        fbm_window cells, float *scratch)
{
    fbm_centres_by(fbm_kernels()[0], step, in, map, in_window, out, cells, scratch);
}

void fbm_centres(const fbm_step *step, const float *in, fbm_window in_window, float *out, fbm_window cells,
                 float *scratch)
{
    fbm_centres_mapped(step, in, NULL, in_window, out, cells, scratch);
}
