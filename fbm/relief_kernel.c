/* The arithmetic of terrain's detail, in plain C that compilers vectorise. Built once an instruction set, with
 * FBM_KERNEL naming the table; the results are the same bits: every operation is elementwise, in a fixed order, and
 * nothing is contracted. */
#include "fbm/relief_kernel.h"

#include <assert.h>
#include <math.h>
#include <stdbool.h>
#include <string.h>

#ifndef FBM_KERNEL
#define FBM_KERNEL plain
#endif
#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define TEXT_(a) #a
#define TEXT(a) TEXT_(a)

/* What a block's children need around it, in cells: pits look at the blocks around, twice; the details that the noise
 * has beyond its own means' prediction see three means on either side; and slopes see a child more, twice. */
enum { PITS = 2, REACH = 3, NOISE = PITS + REACH, SMOOTH = NOISE + 1, RING = 3 };

/* The mean-exact prediction: the children of z are z -+ D, exact for planes (d1 + 2 d2 + 3 d3 = 1/8). */
static const float D1 = .22405F, D2 = -.06762F, D3 = .01206F;
/* The kernel that white noise is drawn under: centre SIDE^2, sides SIDE, corners 1. */
static const float SIDE = 2.6F;
/* Keeps 0/0 from being one; far below every slope's square and product that matters. */
static const float TINY = 1e-30F;

static int64_t half(int64_t a)
{
    return (a - (a & 1)) / 2;
}

/* ---- Memory ---- */

/* Blocks of a window of children, and the planes over them. A plane's name tells how many blocks it has around them. */
typedef struct blocks {
    int64_t i, j; /* the first block: a cell of the input */
    size_t width, height;
} blocks;

static blocks blocks_of(fbm_window children)
{
    blocks b = {.i = half(children.i), .j = half(children.j)};
    b.width = (size_t)(half(children.i + (int64_t)children.width - 1) - b.i + 1);
    b.height = (size_t)(half(children.j + (int64_t)children.height - 1) - b.j + 1);
    return b;
}

static size_t padded(size_t n)
{
    return (n + 15) / 16 * 16 + 16;
}

typedef struct planes {
    blocks at;
    size_t columns, rows; /* blocks of NOISE planes */
    size_t stride;        /* of cells' planes, at least SMOOTH wide */
    size_t child_stride;  /* of children's planes */
    const float *cells;   /* the input at the first block */
    size_t cell_stride;
    float *slopes;                           /* D along rows: SMOOTH columns, MARGIN rows */
    float *children;                         /* the smooth prediction, SMOOTH; later the result, PITS */
    float *mean[2], *x[2], *y[2], *mixed[2]; /* NOISE: means and details of the noise and of the levelling */
    float *mean_slopes[2];                   /* D along rows of the means: PITS columns, NOISE rows */
    float *soften;                           /* PITS: 1/2 where a block's details are to be halved, else 0 */
    float *row[21];
} planes;

/* As fbm_relief_scratch() counts. */
enum { CELL_PLANES = 12, ROWS = 21 };

static planes lay_out(const float *cells, fbm_window in, fbm_window children, float *scratch)
{
    planes p = {.at = blocks_of(children)};
    p.columns = p.at.width + 2 * NOISE;
    p.rows = p.at.height + 2 * NOISE;
    p.stride = padded(p.at.width + 2 * SMOOTH);
    p.child_stride = padded(2 * (p.at.width + 2 * SMOOTH));
    p.cells = cells + (size_t)(p.at.j - in.j) * in.stride + (size_t)(p.at.i - in.i);
    p.cell_stride = in.stride;
    assert(p.at.i - in.i >= FBM_RELIEF_MARGIN && p.at.j - in.j >= FBM_RELIEF_MARGIN);
    size_t plane = p.stride * (p.at.height + 2 * FBM_RELIEF_MARGIN);
    float **each[CELL_PLANES] = {&p.slopes, &p.mean[0],  &p.mean[1],  &p.x[0],           &p.x[1],           &p.y[0],
                                 &p.y[1],   &p.mixed[0], &p.mixed[1], &p.mean_slopes[0], &p.mean_slopes[1], &p.soften};
    for (size_t k = 0; k < CELL_PLANES; k++, scratch += plane)
        *each[k] = scratch;
    p.children = scratch;
    scratch += p.child_stride * 2 * (p.at.height + 2 * SMOOTH);
    for (size_t k = 0; k < ROWS; k++, scratch += p.child_stride)
        p.row[k] = scratch;
    return p;
}

static inline const float *cell_row(const planes *p, ptrdiff_t row)
{
    return p->cells + row * (ptrdiff_t)p->cell_stride;
}

/* ---- Prediction ---- */

static void slopes_along(const float *restrict z, size_t count, float *restrict out)
{
    for (size_t k = 0; k < count; k++)
        out[k] = D1 * (z[k + 4] - z[k + 2]) + D2 * (z[k + 5] - z[k + 1]) + D3 * (z[k + 6] - z[k]);
}

/* D across rows `stride` apart, at `z`. */
static inline float slope_across(const float *z, ptrdiff_t stride)
{
    return D1 * (z[stride] - z[-stride]) + D2 * (z[2 * stride] - z[-2 * stride]) +
           D3 * (z[3 * stride] - z[-3 * stride]);
}

/* D across rows for a row: of the cells (y) and of their slopes along (mixed). */
static void slopes_across(const float *restrict z, ptrdiff_t stride, size_t count, float *restrict out)
{
    const float *restrict a = z - 3 * stride, *restrict b = z - 2 * stride, *restrict c = z - stride,
                          *restrict d = z + stride, *restrict e = z + 2 * stride, *restrict f = z + 3 * stride;
    for (size_t k = 0; k < count; k++)
        out[k] = D1 * (d[k] - c[k]) + D2 * (e[k] - b[k]) + D3 * (f[k] - a[k]);
}

static void interleave(const float *restrict even, const float *restrict odd, size_t count, float *restrict out)
{
    for (size_t k = 0; k < count; k++) {
        out[2 * k] = even[k];
        out[2 * k + 1] = odd[k];
    }
}

/* Children of cells with details x, y and mixed, which are overwritten. */
static void children_rows(const float *restrict z, float *restrict x, float *restrict y, float *restrict mixed,
                          size_t count, float *spare, float *upper, float *lower)
{
    float *restrict last = spare;
    for (size_t k = 0; k < count; k++) {
        float left = z[k] - x[k], right = z[k] + x[k], left_rise = y[k] - mixed[k], right_rise = y[k] + mixed[k];
        x[k] = left - left_rise;
        y[k] = right - right_rise;
        mixed[k] = left + left_rise;
        last[k] = right + right_rise;
    }
    interleave(x, y, count, upper);
    interleave(mixed, last, count, lower);
}

static void predict(const planes *p)
{
    size_t columns = p->at.width + 2 * SMOOTH, rows = p->at.height + 2 * FBM_RELIEF_MARGIN;
    for (size_t r = 0; r < rows; r++)
        slopes_along(cell_row(p, (ptrdiff_t)r - FBM_RELIEF_MARGIN) - SMOOTH - REACH, columns,
                     p->slopes + r * p->stride);
    for (size_t r = 0; r < p->at.height + 2 * SMOOTH; r++) {
        float *upper = p->children + 2 * r * p->child_stride, *const *row = p->row;
        const float *z = cell_row(p, (ptrdiff_t)r - SMOOTH) - SMOOTH;
        const float *s = p->slopes + (r + FBM_RELIEF_MARGIN - SMOOTH) * p->stride;
        memcpy(row[0], s, columns * sizeof *s);
        slopes_across(z, (ptrdiff_t)p->cell_stride, columns, row[1]);
        slopes_across(s, (ptrdiff_t)p->stride, columns, row[2]);
        children_rows(z, row[0], row[1], row[2], columns, row[3], upper, upper + p->child_stride);
    }
}

/* ---- Slopes ---- */

static inline float bounded(float slope)
{
    float low = slope < -1e9F ? -1e9F : slope;
    return low > 1e9F ? 1e9F : low;
}

/* At `count` children of a row that begins at z[0]: slopes, their square, and the flux (g - mean) grad z / g. One loop,
 * so that roots and quotients overlap with the rest. */
static void slope_row(const float *restrict above, const float *restrict z, const float *restrict below, float per_x,
                      float per_y, float mean, size_t count, float *restrict gx, float *restrict gy, float *restrict g2,
                      float *restrict fx, float *restrict fy)
{
    for (size_t k = 0; k < count; k++) {
        float x = bounded((z[k + 1] - z[(ptrdiff_t)k - 1]) * per_x), y = bounded((below[k] - above[k]) * per_y);
        float square = x * x + y * y, share = 1 - mean / sqrtf(square + TINY);
        gx[k] = x;
        gy[k] = y;
        g2[k] = square;
        fx[k] = x * share;
        fy[k] = y * share;
    }
}

static void divergence_row(const float *restrict fx, const float *restrict above, const float *restrict below,
                           float per_x, float per_y, size_t count, float *restrict out)
{
    for (size_t k = 0; k < count; k++)
        out[k] = (fx[k + 1] - fx[(ptrdiff_t)k - 1]) * per_x + (below[k] - above[k]) * per_y;
}

/* ---- Noise ---- */

/* White noise under the steered kernel. Square amplitudes: energy, less where it is level, over the kernel's variance.
 */
static void noise_row(const fbm_relief_step *step, const float *restrict gx, const float *restrict gy,
                      const float *restrict g2, const float *restrict energy, const float *restrict slack,
                      const float *restrict above, const float *restrict at, const float *restrict below, size_t count,
                      float *restrict out)
{
    const float steer = step->steer, most = .95F, soft = step->steer_slope2, limit = step->limit;
    const float strength = steer < 0 ? -steer : steer, clipped = steer < 0 ? -most : most;
    const float b = SIDE * SIDE, whole = b * b + 4 * b + 4;
    for (size_t k = 0; k < count; k++) {
        float square = g2[k], sum = square + soft;
        bool clip = strength * square > most * sum;
        float ratio = (clip ? clipped : steer) / ((clip ? square : sum) + TINY);
        float p = ratio * (gx[k] * gx[k] - gy[k] * gy[k]), t = ratio * (2 * gx[k] * gy[k]);
        float variance = whole + 4 * (b * (p * p) + t * t);
        float free = square + slack[k];
        float amplitude = sqrtf(energy[k] * free / ((free + limit * energy[k] + TINY) * variance));
        float across = (1 + p) * (at[k] + at[k + 2]) + (1 - p) * (above[k + 1] + below[k + 1]);
        float diagonal = (1 + t) * (above[k] + below[k + 2]) + (1 - t) * (above[k + 2] + below[k]);
        out[k] = amplitude * (b * at[k + 1] + SIDE * across + diagonal);
    }
}

static void draw_noise(const fbm_kernel *noise, const fbm_relief_step *step, int64_t row, int64_t first, size_t count,
                       float *out)
{
    if (step->period == 0) {
        noise->noise(step->seed, step->octave, FBM_NOISE_CELLS, row, first, count, out);
        return;
    }
    int64_t period = 2 * step->period, column = (first % period + period) % period;
    for (size_t done = 0, n; done < count; done += n, column = 0) {
        n = (uint64_t)(period - column) < count - done ? (size_t)(period - column) : count - done;
        noise->noise(step->seed, step->octave, FBM_NOISE_CELLS, row, column, n, out + done);
    }
}

/* ---- Energy of the children: a quarter of the cell beside and a quarter of the one below, as for corners cut ---- */

static void energy_row(const float *restrict at, const float *restrict other, size_t cells, float *restrict mixed,
                       float *restrict out)
{
    for (size_t k = 0; k < cells + 2; k++)
        mixed[k] = .75F * at[k] + .25F * other[k];
    for (size_t k = 0; k < cells; k++) {
        out[2 * k] = .75F * mixed[k + 1] + .25F * mixed[k];
        out[2 * k + 1] = .75F * mixed[k + 1] + .25F * mixed[k + 2];
    }
}

/* Energies of the children of cells `first` ... of row `row` / 2 of the input, counted from the first block. */
static void child_energy(const float *energy, size_t stride, ptrdiff_t row, ptrdiff_t first, size_t cells, float *mixed,
                         float *out)
{
    ptrdiff_t cell = (row - (row & 1)) / 2;
    const float *at = energy + cell * (ptrdiff_t)stride + first - 1;
    energy_row(at, at + (row & 1 ? (ptrdiff_t)stride : -(ptrdiff_t)stride), cells, mixed, out);
}

/* ---- Details ---- */

static void haar_row(const float *restrict upper, const float *restrict lower, size_t count, float *restrict mean,
                     float *restrict x, float *restrict y, float *restrict mixed)
{
    for (size_t k = 0; k < count; k++) {
        float a = upper[2 * k], b = upper[2 * k + 1], c = lower[2 * k], d = lower[2 * k + 1];
        float ab = a + b, cd = c + d, ba = b - a, dc = d - c;
        mean[k] = .25F * (ab + cd);
        x[k] = .25F * (ba + dc);
        y[k] = .25F * (cd - ab);
        mixed[k] = .25F * (dc - ba);
    }
}

static void store_details(const planes *p, int which, size_t block_row, const float *upper, const float *lower)
{
    size_t at = block_row * p->stride;
    haar_row(upper, lower, p->columns, p->mean[which] + at, p->x[which] + at, p->y[which] + at, p->mixed[which] + at);
}

typedef struct walk {
    const fbm_kernel *noise;
    const fbm_relief_step *step;
    const float *energy, *slack; /* at the first block */
    size_t energy_stride;
    const planes *p;
    size_t width;       /* children of a NOISE row */
    float per_x, per_y; /* 1 / two children */
    float *white[RING]; /* from a child before the row */
    float *fx[RING], *fy[RING];
    float *gx, *gy, *g2, *energies, *slacks, *mixed;
    float *noisy[2], *levelled[2];
} walk;

static float *ring(float *const rows[RING], size_t row)
{
    return rows[row % RING];
}

static void draw_row(const walk *w, size_t row)
{
    int64_t child_row = 2 * (w->p->at.j - NOISE) + (int64_t)row - 2, first = 2 * (w->p->at.i - NOISE) - 1;
    draw_noise(w->noise, w->step, child_row, first, w->width + 2, ring(w->white, row));
}

/* Slopes of row `row` of NOISE planes, counted from one child above. */
static void walk_slopes(const walk *w, size_t row)
{
    const planes *p = w->p;
    const float *z = p->children + (row + 2 * (SMOOTH - NOISE) - 1) * p->child_stride + 2 * (SMOOTH - NOISE) - 1;
    slope_row(z - p->child_stride, z, z + p->child_stride, w->per_x, w->per_y, w->step->level_slope, w->width + 2,
              w->gx, w->gy, w->g2, ring(w->fx, row), ring(w->fy, row));
}

static void walk_noise(const walk *w, size_t row)
{
    ptrdiff_t child_row = (ptrdiff_t)row - 1 - 2 * NOISE;
    child_energy(w->energy, w->energy_stride, child_row, -NOISE, w->p->columns, w->mixed, w->energies);
    if (w->slack)
        child_energy(w->slack, w->energy_stride, child_row, -NOISE, w->p->columns, w->mixed, w->slacks);
    /* white row r is that of walk row r - 1 */
    noise_row(w->step, w->gx + 1, w->gy + 1, w->g2 + 1, w->energies, w->slacks, ring(w->white, row),
              ring(w->white, row + 1), ring(w->white, row + 2), w->width, w->noisy[(row - 1) & 1]);
}

static void walk_levelling(const walk *w, size_t row)
{
    float area = w->step->level;
    float *out = w->levelled[(row - 1) & 1];
    divergence_row(ring(w->fx, row) + 1, ring(w->fy, row - 1) + 1, ring(w->fy, row + 1) + 1, area * w->per_x,
                   area * w->per_y, w->width, out);
}

/* Makes the noise (unless it is NULL) and the levelling, child row by child row (row 0 is the one above the NOISE
 * planes), and keeps their details. */
static void make_details(const fbm_kernel *noise, const fbm_relief_step *step, const float *energy, fbm_window in,
                         const planes *p)
{
    walk w = {.noise = noise, .step = step, .energy_stride = in.stride, .p = p};
    if (noise)
        w.energy = energy + (size_t)(p->at.j - in.j) * in.stride + (size_t)(p->at.i - in.i);
    if (noise && step->slack)
        w.slack = w.energy + in.stride * in.height;
    float *const *row = p->row;
    w.width = 2 * p->columns;
    w.per_x = 1 / (2 * step->children_x);
    w.per_y = 1 / (2 * step->children_y);
    for (int k = 0; k < RING; k++) {
        w.white[k] = row[k];
        w.fx[k] = row[RING + k];
        w.fy[k] = row[2 * RING + k];
    }
    w.gx = row[9], w.gy = row[10], w.g2 = row[11], w.energies = row[12], w.mixed = row[13];
    w.noisy[0] = row[14], w.noisy[1] = row[15], w.levelled[0] = row[16], w.levelled[1] = row[17], w.slacks = row[18];
    memset(w.slacks, 0, w.width * sizeof *w.slacks);
    size_t rows = 2 * p->rows;
    if (noise) {
        draw_row(&w, 1);
        draw_row(&w, 2);
    }
    walk_slopes(&w, 0);
    for (size_t r = 1; r <= rows + 1; r++) {
        walk_slopes(&w, r);
        if (noise && r <= rows) {
            draw_row(&w, r + 2);
            walk_noise(&w, r);
            if (r % 2 == 0)
                store_details(p, 0, r / 2 - 1, w.noisy[0], w.noisy[1]);
        }
        if (r >= 2) {
            walk_levelling(&w, r - 1);
            if (r % 2 == 1)
                store_details(p, 1, r / 2 - 1, w.levelled[0], w.levelled[1]);
        }
    }
    for (int which = !noise; which < 2; which++)
        for (size_t r = 0; r < p->rows; r++)
            slopes_along(p->mean[which] + r * p->stride, p->at.width + 2 * PITS, p->mean_slopes[which] + r * p->stride);
}

/* ---- Children ---- */

/* What a detail has beyond what the means predict, for block k of rows that begin at a PITS column. */
typedef struct surplus {
    const float *mean, *x, *y, *mixed, *slopes;
    ptrdiff_t stride;
} surplus;

static surplus surplus_at(const planes *p, int which, size_t row, size_t column)
{
    size_t at = row * p->stride + column;
    return (surplus){p->mean[which] + at,
                     p->x[which] + at,
                     p->y[which] + at,
                     p->mixed[which] + at,
                     p->mean_slopes[which] + at - (NOISE - PITS),
                     (ptrdiff_t)p->stride};
}

static inline float surplus_x(const surplus *s, size_t k)
{
    return s->x[k] - s->slopes[k];
}

static inline float surplus_y(const surplus *s, size_t k)
{
    return s->y[k] - slope_across(s->mean + k, s->stride);
}

static inline float surplus_mixed(const surplus *s, size_t k)
{
    return s->mixed[k] - slope_across(s->slopes + k, s->stride);
}

/* out = detail + (gain * (noise - its prediction) + (levelling - its prediction)) */
static void sum_details(const float *restrict smooth, const float *restrict noise, const float *restrict noise_smooth,
                        const float *restrict level, const float *restrict level_smooth, float gain, size_t count,
                        float *restrict out)
{
    for (size_t k = 0; k < count; k++)
        out[k] = smooth[k] + (gain * (noise[k] - noise_smooth[k]) + (level[k] - level_smooth[k]));
}

static void finish_row(const planes *p, const float gains[3], size_t block_row, float *upper, float *lower)
{
    const surplus f = surplus_at(p, 0, block_row + NOISE - PITS, NOISE - PITS),
                  h = surplus_at(p, 1, block_row + NOISE - PITS, NOISE - PITS);
    const float *z = cell_row(p, (ptrdiff_t)block_row - PITS) - PITS;
    const float *s = p->slopes + (block_row + FBM_RELIEF_MARGIN - PITS) * p->stride + SMOOTH - PITS;
    const ptrdiff_t stride = (ptrdiff_t)p->stride;
    const size_t count = p->at.width + 2 * PITS;
    float *const *row = p->row;
    sum_details(s, f.x, f.slopes, h.x, h.slopes, gains[0], count, row[0]);
    slopes_across(z, (ptrdiff_t)p->cell_stride, count, row[3]);
    slopes_across(f.mean, stride, count, row[4]);
    slopes_across(h.mean, stride, count, row[5]);
    sum_details(row[3], f.y, row[4], h.y, row[5], gains[1], count, row[1]);
    slopes_across(s, stride, count, row[3]);
    slopes_across(f.slopes, stride, count, row[4]);
    slopes_across(h.slopes, stride, count, row[5]);
    sum_details(row[3], f.mixed, row[4], h.mixed, row[5], gains[2], count, row[2]);
    children_rows(z, row[0], row[1], row[2], count, row[3], upper, lower);
}

static inline float lesser(float a, float b)
{
    return a < b ? a : b;
}

/* 1 where a child is lower than the eight around it, else 0. */
static void pit_row(const float *restrict above, const float *restrict z, const float *restrict below, size_t count,
                    float *restrict column, float *restrict out)
{
    for (size_t k = 0; k < count + 2; k++)
        column[k] = lesser(above[(ptrdiff_t)k - 1], below[(ptrdiff_t)k - 1]);
    for (size_t k = 0; k < count; k++) {
        float beside = lesser(z[(ptrdiff_t)k - 1], z[k + 1]);
        float around = lesser(lesser(column[k], column[k + 1]), lesser(column[k + 2], beside));
        out[k] = z[k] < around ? 1.F : 0.F;
    }
}

static void mark_row(const float *restrict upper, const float *restrict lower, size_t count, float *restrict out)
{
    for (size_t k = 0; k < count; k++)
        out[k] = (upper[2 * k] + upper[2 * k + 1]) + (lower[2 * k] + lower[2 * k + 1]) > 0 ? .5F : 0.F;
}

static void soften_row(const float *restrict soften, const float *restrict z, size_t count, float *restrict children)
{
    for (size_t k = 0; k < count; k++) {
        children[2 * k] += soften[k] * (z[k] - children[2 * k]);
        children[2 * k + 1] += soften[k] * (z[k] - children[2 * k + 1]);
    }
}

/* Halves the details of every block that holds a pit, of the blocks `margin` around; the children of one block more
 * must be there. */
static void soften_pits(const planes *p, size_t margin)
{
    size_t columns = p->at.width + 2 * margin, rows = p->at.height + 2 * margin, skip = PITS - margin;
    for (size_t r = 0; r < rows; r++) {
        float *pits[2] = {p->row[0], p->row[1]};
        for (size_t k = 0; k < 2; k++) {
            const float *z = p->children + (2 * (r + skip) + k) * p->child_stride + 2 * skip;
            pit_row(z - p->child_stride, z, z + p->child_stride, 2 * columns, p->row[2], pits[k]);
        }
        mark_row(pits[0], pits[1], columns, p->soften + r * p->stride);
    }
    for (size_t r = 0; r < rows; r++) {
        const float *z = cell_row(p, (ptrdiff_t)r - (ptrdiff_t)margin) - margin;
        for (size_t k = 0; k < 2; k++)
            soften_row(p->soften + r * p->stride, z, columns,
                       p->children + (2 * (r + skip) + k) * p->child_stride + 2 * skip);
    }
}

static void hand_out_energy(const planes *p, const float *energy, fbm_window in, fbm_window children, float *out)
{
    const float *at = energy + (size_t)(p->at.j - in.j) * in.stride + (size_t)(p->at.i - in.i);
    for (size_t r = 0; r < children.height; r++) {
        ptrdiff_t row = (ptrdiff_t)(children.j - 2 * p->at.j) + (ptrdiff_t)r;
        child_energy(at, in.stride, row, 0, p->at.width, p->row[0], p->row[1]);
        memcpy(out + r * children.stride, p->row[1] + (children.i - 2 * p->at.i), children.width * sizeof *out);
    }
}

static void refine(const fbm_kernel *noise, const fbm_relief_step *step, const float *heights, const float *energy,
                   fbm_window in, float *out, float *out_energy, fbm_window children, float *scratch)
{
    planes p = lay_out(heights, in, children, scratch);
    predict(&p);
    make_details(noise, step, energy, in, &p);
    for (size_t r = 0; r < p.at.height + 2 * PITS; r++) {
        float *upper = p.children + 2 * r * p.child_stride;
        finish_row(&p, step->gains, r, upper, upper + p.child_stride);
    }
    if (!step->pits) {
        soften_pits(&p, 1);
        soften_pits(&p, 0);
    }
    size_t x = 2 * PITS + (size_t)(children.i - 2 * p.at.i), y = 2 * PITS + (size_t)(children.j - 2 * p.at.j);
    for (size_t r = 0; r < children.height; r++)
        memcpy(out + r * children.stride, p.children + (y + r) * p.child_stride + x, children.width * sizeof *out);
    if (out_energy)
        hand_out_energy(&p, energy, in, children, out_energy);
    if (out_energy && step->slack)
        hand_out_energy(&p, energy + in.stride * in.height, in, children,
                        out_energy + children.stride * children.height);
}

/* ---- Sums over blocks ---- */

static void add_sums(const fbm_kernel *noise, const fbm_relief_step *step, const float *heights, const float *energy,
                     fbm_window in, fbm_window children, float *scratch, fbm_relief_sums *sums)
{
    assert(!((children.i | children.j | (int64_t)children.width | (int64_t)children.height) & 1));
    planes p = lay_out(heights, in, children, scratch);
    predict(&p);
    make_details(noise, step, energy, in, &p);
    for (size_t r = 0; r < p.at.height; r++) {
        const surplus f = surplus_at(&p, 0, r + NOISE, NOISE), h = surplus_at(&p, 1, r + NOISE, NOISE);
        for (size_t k = 0; k < p.at.width; k++) {
            const double a[3] = {(double)surplus_x(&f, k), (double)surplus_y(&f, k), (double)surplus_mixed(&f, k)};
            const double b[3] = {(double)surplus_x(&h, k), (double)surplus_y(&h, k), (double)surplus_mixed(&h, k)};
            for (int d = 0; d < 3; d++) {
                sums->noise[d] += a[d] * a[d];
                sums->levelling[d] += b[d] * b[d];
            }
        }
    }
    sums->count += p.at.width * p.at.height;
}

static void add_slopes(const fbm_relief_step *step, const float *heights, fbm_window in, fbm_window children,
                       float *scratch, fbm_slopes *slopes)
{
    planes p = lay_out(heights, in, children, scratch);
    predict(&p);
    size_t x = 2 * SMOOTH + (size_t)(children.i - 2 * p.at.i), y = 2 * SMOOTH + (size_t)(children.j - 2 * p.at.j);
    float per_x = 1 / (2 * step->children_x), per_y = 1 / (2 * step->children_y);
    for (size_t r = 0; r < children.height; r++) {
        const float *z = p.children + (y + r) * p.child_stride + x;
        slope_row(z - p.child_stride, z, z + p.child_stride, per_x, per_y, 0, children.width, p.row[0], p.row[1],
                  p.row[2], p.row[3], p.row[4]);
        for (size_t k = 0; k < children.width; k++) {
            uint32_t bits;
            memcpy(&bits, &p.row[2][k], sizeof bits);
            slopes->bins[bits >> 16 & (FBM_SLOPE_BINS - 1)]++;
            slopes->sum += (double)p.row[2][k];
        }
    }
    slopes->count += children.width * children.height;
}

/* The fit of one block: details a (of the samples) and b (of the levelling), slope of the means (gx, gy). */
static void fit_block(const double a[3], const double b[3], double gx, double gy, const double shares[2],
                      fbm_relief_fit *fit)
{
    double g2 = gx * gx + gy * gy, x = a[0] / shares[0], y = a[1] / shares[1];
    fit->stretch += ((y * y - x * x) * (gx * gx - gy * gy) - 2 * x * y * (2 * gx * gy)) / g2;
    fit->energy += x * x + y * y;
    for (int d = 0; d < 3; d++) {
        fit->levelled += a[d] * b[d];
        fit->levelling2 += b[d] * b[d];
    }
}

static void add_fit(const fbm_relief_step *step, const float *means, fbm_window in, const float *samples,
                    fbm_window children, const double shares[2], double steep, float *scratch, fbm_relief_fit *fit)
{
    assert(!((children.i | children.j | (int64_t)children.width | (int64_t)children.height) & 1));
    planes p = lay_out(means, in, children, scratch);
    predict(&p);
    make_details(NULL, step, NULL, in, &p);
    const double roots[2] = {sqrt(shares[0]), sqrt(shares[1])};
    const double per_x = 1 / (4 * (double)step->children_x), per_y = 1 / (4 * (double)step->children_y);
    for (size_t r = 0; r < p.at.height; r++) {
        const surplus h = surplus_at(&p, 1, r + NOISE, NOISE);
        const float *z = cell_row(&p, (ptrdiff_t)r), *s = p.slopes + (r + FBM_RELIEF_MARGIN) * p.stride + SMOOTH;
        const float *upper = samples + 2 * r * children.stride, *lower = upper + children.stride;
        for (size_t k = 0; k < p.at.width; k++) {
            double gx = ((double)z[k + 1] - (double)z[(ptrdiff_t)k - 1]) * per_x;
            double gy = ((double)z[k + p.cell_stride] - (double)z[(ptrdiff_t)k - (ptrdiff_t)p.cell_stride]) * per_y;
            if (!(gx * gx + gy * gy > steep))
                continue;
            float mean, x, y, mixed;
            haar_row(upper + 2 * k, lower + 2 * k, 1, &mean, &x, &y, &mixed);
            const double a[3] = {(double)(x - s[k]), (double)(y - slope_across(z + k, (ptrdiff_t)p.cell_stride)),
                                 (double)(mixed - slope_across(s + k, (ptrdiff_t)p.stride))};
            const double b[3] = {(double)surplus_x(&h, k), (double)surplus_y(&h, k), (double)surplus_mixed(&h, k)};
            fit_block(a, b, gx, gy, roots, fit);
        }
    }
}

/* ---- Energy ---- */

enum { SMOOTHING = 8 };

/* exp(-k^2 / 8): a Gaussian of two cells */
static const float gauss[SMOOTHING + 1] = {1,          .8824969F,   .60653066F,   .32465247F,   .13533528F,
                                           .04393693F, .011108997F, .0021874911F, .00033546263F};

static void smooth_across(const float *in, ptrdiff_t stride, size_t count, float *restrict out)
{
    for (size_t k = 0; k < count; k++)
        out[k] = in[k] + gauss[1] * (in[(ptrdiff_t)k - stride] + in[(ptrdiff_t)k + stride]);
    for (int t = 2; t <= SMOOTHING; t++) {
        const float *before = in - t * stride, *after = in + t * stride;
        const float weight = gauss[t];
        for (size_t k = 0; k < count; k++)
            out[k] += weight * (before[k] + after[k]);
    }
}

static void smooth_along(const float *restrict in, size_t count, float *restrict out)
{
    smooth_across(in, 1, count, out);
}

/* Energies of blocks whose first samples are at `count` columns of z and of the row below, 0 where not known, and
 * whether they are known. */
static void block_energy_row(const float *restrict z, const float *restrict below, const float *restrict means,
                             const float *restrict slopes, ptrdiff_t stride, size_t count, float *restrict energy,
                             float *restrict known)
{
    for (size_t k = 0; k < count; k++) {
        float ba = z[k + 1] - z[k], dc = below[k + 1] - below[k];
        float ca = below[k] - z[k], db = below[k + 1] - z[k + 1];
        float x = .25F * (ba + dc) - slopes[k], y = .25F * (ca + db) - slope_across(means + k, 2 * stride);
        float mixed = .25F * (dc - ba) - slope_across(slopes + k, 2 * stride);
        float sum = x * x + y * y + mixed * mixed;
        bool good = sum < 3e38F; /* not NaN, nor infinite */
        energy[k] = good ? sum : 0.F;
        known[k] = good ? 1.F : 0.F;
    }
}

/* Sums over the four blocks that a cell is in, then over the cells around it. In place: `plane` has `rows` rows. */
static void gather(float *plane, size_t stride, size_t width, size_t height, float *rows, float *out)
{
    size_t columns = width + 2 * SMOOTHING, count = height + 2 * SMOOTHING;
    for (size_t r = 0; r < count; r++) {
        float *restrict a = plane + r * stride;
        const float *restrict b = a + stride;
        for (size_t k = 0; k <= columns; k++)
            a[k] += b[k];
        for (size_t k = 0; k < columns; k++)
            a[k] += a[k + 1];
        smooth_along(a + SMOOTHING, width, rows + r * width);
    }
    for (size_t r = 0; r < height; r++)
        smooth_across(rows + (r + SMOOTHING) * width, (ptrdiff_t)width, width, out + r * width);
}

static void energy(const float *heights, fbm_window in, float *out, fbm_window o, float *scratch)
{
    const size_t edge = 2 * FBM_ENERGY_MARGIN, wide = o.width + edge, high = o.height + edge, stride = padded(wide);
    const size_t plane = stride * high;
    float *means = scratch, *slopes = means + plane, *energies = slopes + plane, *known = energies + plane;
    float *rows = known + plane, *sums = rows + plane, *weights = sums + plane;
    const float *z =
        heights + (size_t)(o.j - in.j - FBM_ENERGY_MARGIN) * in.stride + (size_t)(o.i - in.i - FBM_ENERGY_MARGIN);
    for (size_t r = 0; r + 1 < high; r++)
        for (size_t k = 0; k + 1 < wide; k++)
            means[r * stride + k] = .25F * ((z[r * in.stride + k] + z[r * in.stride + k + 1]) +
                                            (z[(r + 1) * in.stride + k] + z[(r + 1) * in.stride + k + 1]));
    const size_t columns = o.width + 2 * SMOOTHING + 1, block_rows = o.height + 2 * SMOOTHING + 1, first = 2 * REACH;
    for (size_t r = 0; r + 1 < high; r++)
        for (size_t k = 0; k < columns; k++) /* D at a distance of two samples */
            slopes[r * stride + k] = slope_across(means + r * stride + k + first, 2);
    for (size_t r = 0; r < block_rows; r++) {
        const float *row = z + (r + first) * in.stride + first;
        block_energy_row(row, row + in.stride, means + (r + first) * stride + first, slopes + (r + first) * stride,
                         (ptrdiff_t)stride, columns, energies + r * stride, known + r * stride);
    }
    gather(energies, stride, o.width, o.height, rows, sums);
    gather(known, stride, o.width, o.height, rows, weights);
    for (size_t r = 0; r < o.height; r++)
        for (size_t k = 0; k < o.width; k++)
            out[r * o.stride + k] = sums[r * o.width + k] / weights[r * o.width + k]; /* 0/0 is NaN */
}

extern const fbm_relief_kernel JOIN(fbm_relief_kernel_, FBM_KERNEL);
const fbm_relief_kernel JOIN(fbm_relief_kernel_, FBM_KERNEL) = {
    .name = TEXT(FBM_KERNEL),
    .refine = refine,
    .add_sums = add_sums,
    .add_slopes = add_slopes,
    .add_fit = add_fit,
    .energy = energy,
};
