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

/* A ring of rows: row r at r modulo KEPT. The pipeline below keeps of everything the few rows that are still to be
 * looked at, so that they stay in the caches. */
enum { KEPT = 8 };

typedef struct kept {
    float *first;
    size_t stride;
} kept;

static inline float *row_at(kept r, ptrdiff_t row)
{
    return r.first + ((size_t)row & (KEPT - 1)) * r.stride;
}

/* Rows -3, -2, -1, 1, 2, 3 about a row, at a column: what D across rows looks at. */
typedef struct beside {
    const float *of[2 * REACH];
} beside;

static inline beside across_at(kept r, ptrdiff_t row, size_t column)
{
    beside a;
    for (int k = 0; k < REACH; k++) {
        a.of[k] = row_at(r, row - REACH + k) + column;
        a.of[REACH + k] = row_at(r, row + 1 + k) + column;
    }
    return a;
}

/* A row of children, or of what there is one a child: those of even and of odd columns, of block k each at [k]. So
 * nothing is shuffled but white noise and the result. */
typedef struct halves {
    float *of[2];
} halves;

/* Both rows of a block row are a row of a ring. */
static inline halves child_row(kept r, ptrdiff_t row)
{
    float *first = row_at(r, row >> 1) + (row & 1 ? r.stride / 2 : 0);
    return (halves){{first, first + r.stride / 4}};
}

/* The column before that of a half; the one behind is the next. */
static inline const float *beside_half(halves row, int half)
{
    return half ? row.of[0] : row.of[1] - 1;
}

enum { CELL_RINGS = 16, CHILD_RINGS = 2, ROWS = 38, ROW_MARGIN = 8 };

/* Rows are made in whole vectors, for which they have room: short ones would spend much of their time on what is left.
 * What is so made behind a row's end is never looked at. */
static inline size_t whole_vectors(size_t count)
{
    return (count + 7) / 8 * 8;
}

typedef struct planes {
    blocks at;
    size_t columns;     /* blocks of NOISE rows */
    size_t stride;      /* of cells' rows, at least SMOOTH wide */
    const float *input; /* at the first block */
    size_t input_stride;
    ptrdiff_t next_slopes, next_prediction, next_details; /* rows that are made next */
    kept cells;                                           /* SMOOTH and REACH columns */
    kept slopes;                                          /* D along rows: SMOOTH columns; the x detail there */
    kept smooth_y, smooth_mixed;                          /* details of the smooth prediction, SMOOTH columns */
    kept smooth;                                          /* its children, SMOOTH columns */
    kept mean[2], x[2], y[2], mixed[2]; /* NOISE columns: means and details of the noise and of the levelling */
    kept mean_slopes[2];                /* D along rows of the means, PITS columns */
    kept children;                      /* the result, PITS columns */
    kept pits[2];                       /* of each softening: 1/2 where a block has one, else 0 */
    float *row[ROWS];                   /* the first block's columns of rows that have ROW_MARGIN more before them */
} planes;

/* Rows that are taken twice: what is in them is used up before. */
enum {
    SPARE = 0,
    GX = 0,
    GY,
    G2,
    ENERGIES = 5,
    SLACKS = 7,
    MIXED = 9,
    WHITE = 10,
    FX = 16,
    FY = 22,
    NOISY = 28,
    LEVELLED = 32,
    LONG = 36 /* one of twice the length */
};

static halves halves_at(const planes *p, int row)
{
    return (halves){{p->row[row], p->row[row + 1]}};
}

/* As fbm_relief_scratch() counts. */
static planes lay_out(const float *cells, fbm_window in, fbm_window children, float *scratch)
{
    planes p = {.at = blocks_of(children)};
    p.columns = p.at.width + 2 * NOISE;
    p.stride = padded(p.at.width + 2 * SMOOTH);
    p.input = cells + (size_t)(p.at.j - in.j) * in.stride + (size_t)(p.at.i - in.i);
    p.input_stride = in.stride;
    p.next_slopes = -FBM_RELIEF_MARGIN;
    p.next_prediction = -SMOOTH;
    p.next_details = -NOISE;
    assert(p.at.i - in.i >= FBM_RELIEF_MARGIN && p.at.j - in.j >= FBM_RELIEF_MARGIN);
    kept *cell_rings[CELL_RINGS] = {&p.cells,          &p.slopes,         &p.smooth_y, &p.smooth_mixed,
                                    &p.mean[0],        &p.mean[1],        &p.x[0],     &p.x[1],
                                    &p.y[0],           &p.y[1],           &p.mixed[0], &p.mixed[1],
                                    &p.mean_slopes[0], &p.mean_slopes[1], &p.pits[0],  &p.pits[1]};
    for (size_t k = 0; k < CELL_RINGS; k++, scratch += KEPT * p.stride)
        *cell_rings[k] = (kept){scratch, p.stride};
    kept *child_rings[CHILD_RINGS] = {&p.smooth, &p.children};
    for (size_t k = 0; k < CHILD_RINGS; k++, scratch += KEPT * 4 * p.stride)
        *child_rings[k] = (kept){scratch, 4 * p.stride};
    for (size_t k = 0; k < ROWS; k++, scratch += p.stride)
        p.row[k] = scratch + ROW_MARGIN;
    return p;
}

static inline const float *cell_row(const planes *p, ptrdiff_t row)
{
    return p->input + row * (ptrdiff_t)p->input_stride;
}

/* ---- Prediction ---- */

static void slopes_along(const float *restrict z, size_t count, float *restrict out)
{
    for (size_t k = 0; k < whole_vectors(count); k++)
        out[k] = D1 * (z[k + 4] - z[k + 2]) + D2 * (z[k + 5] - z[k + 1]) + D3 * (z[k + 6] - z[k]);
}

/* D across rows `stride` apart, at `z`. */
static inline float slope_across(const float *z, ptrdiff_t stride)
{
    return D1 * (z[stride] - z[-stride]) + D2 * (z[2 * stride] - z[-2 * stride]) +
           D3 * (z[3 * stride] - z[-3 * stride]);
}

/* D across rows for a row: of the cells (y) and of their slopes along (mixed). */
static void slopes_across(beside z, size_t count, float *restrict out)
{
    const float *restrict a = z.of[0], *restrict b = z.of[1], *restrict c = z.of[2], *restrict d = z.of[3],
                          *restrict e = z.of[4], *restrict f = z.of[5];
    for (size_t k = 0; k < whole_vectors(count); k++)
        out[k] = D1 * (d[k] - c[k]) + D2 * (e[k] - b[k]) + D3 * (f[k] - a[k]);
}

static void interleave(const float *restrict even, const float *restrict odd, size_t count, float *restrict out)
{
    for (size_t k = 0; k < count; k++) {
        out[2 * k] = even[k];
        out[2 * k + 1] = odd[k];
    }
}

/* Children of cells with details x, y and mixed. */
static void children_rows(const float *restrict z, const float *restrict x, const float *restrict y,
                          const float *restrict mixed, size_t count, halves upper, halves lower)
{
    float *restrict a = upper.of[0], *restrict b = upper.of[1], *restrict c = lower.of[0], *restrict d = lower.of[1];
    for (size_t k = 0; k < whole_vectors(count); k++) {
        float left = z[k] - x[k], right = z[k] + x[k], left_rise = y[k] - mixed[k], right_rise = y[k] + mixed[k];
        a[k] = left - left_rise;
        b[k] = right - right_rise;
        c[k] = left + left_rise;
        d[k] = right + right_rise;
    }
}

/* Makes the smooth prediction up to a row of blocks. */
static void predict(planes *p, ptrdiff_t last)
{
    const size_t columns = p->at.width + 2 * SMOOTH;
    for (ptrdiff_t r; (r = p->next_prediction) <= last; p->next_prediction++) {
        for (ptrdiff_t s; (s = p->next_slopes) <= r + REACH; p->next_slopes++) {
            float *cells = row_at(p->cells, s);
            memcpy(cells, cell_row(p, s) - SMOOTH - REACH, (columns + 2 * REACH) * sizeof *cells);
            slopes_along(cells, columns, row_at(p->slopes, s));
        }
        float *y = row_at(p->smooth_y, r), *mixed = row_at(p->smooth_mixed, r);
        slopes_across(across_at(p->cells, r, REACH), columns, y);
        slopes_across(across_at(p->slopes, r, 0), columns, mixed);
        children_rows(row_at(p->cells, r) + REACH, row_at(p->slopes, r), y, mixed, columns, child_row(p->smooth, 2 * r),
                      child_row(p->smooth, 2 * r + 1));
    }
}

/* ---- Slopes ---- */

static inline float lesser(float a, float b)
{
    return a < b ? a : b;
}

static inline float greater(float a, float b)
{
    return a > b ? a : b;
}

/* Slopes beyond this count as this, so that squares stay finite. Volatile, for of constants GCC makes branches. */
static const volatile float steepest = 1e9F;

/* At `count` children between rows, and between what is beside them in their own: slopes, their square, and
 * the flux (g - mean) grad z / g. One loop, so that roots and quotients overlap with the rest. */
static void slope_row(const float *restrict above, const float *restrict below, const float *restrict side, float per_x,
                      float per_y, float mean, size_t count, float *restrict gx, float *restrict gy, float *restrict g2,
                      float *restrict fx, float *restrict fy)
{
    const float most = steepest;
    for (size_t k = 0; k < whole_vectors(count); k++) {
        float x = lesser(greater((side[k + 1] - side[k]) * per_x, -most), most);
        float y = lesser(greater((below[k] - above[k]) * per_y, -most), most);
        float square = x * x + y * y, share = 1 - mean / sqrtf(square + TINY);
        gx[k] = x;
        gy[k] = y;
        g2[k] = square;
        fx[k] = x * share;
        fy[k] = y * share;
    }
}

static void divergence_row(const float *restrict side, const float *restrict above, const float *restrict below,
                           float per_x, float per_y, size_t count, float *restrict out)
{
    for (size_t k = 0; k < whole_vectors(count); k++)
        out[k] = (side[k + 1] - side[k]) * per_x + (below[k] - above[k]) * per_y;
}

/* ---- Noise ---- */

/* White noise about children: rows above, at and below, in their columns and in those before and behind. */
typedef struct around {
    const float *own[3], *beside[3];
} around;

/* White noise under the steered kernel. Square amplitudes: energy, less where it is level, over the kernel's variance.
 */
static void noise_row(const fbm_relief_step *step, const float *restrict gx, const float *restrict gy,
                      const float *restrict g2, const float *restrict energy, const float *restrict slack,
                      const around *white, size_t count, float *restrict out)
{
    const float steer = step->steer, most = .95F, soft = step->steer_slope2, limit = step->limit;
    const float strength = steer < 0 ? -steer : steer, clipped = steer < 0 ? -most : most;
    const float b = SIDE * SIDE, whole = b * b + 4 * b + 4;
    const float *restrict a = white->own[0], *restrict z = white->own[1], *restrict c = white->own[2],
                          *restrict a_side = white->beside[0], *restrict z_side = white->beside[1],
                          *restrict c_side = white->beside[2];
    for (size_t k = 0; k < whole_vectors(count); k++) {
        float square = g2[k], sum = square + soft;
        bool clip = strength * square > most * sum;
        float ratio = (clip ? clipped : steer) / ((clip ? square : sum) + TINY);
        float p = ratio * (gx[k] * gx[k] - gy[k] * gy[k]), t = ratio * (2 * gx[k] * gy[k]);
        float variance = whole + 4 * (b * (p * p) + t * t);
        float free = square + slack[k];
        float amplitude = sqrtf(energy[k] * free / ((free + limit * energy[k] + TINY) * variance));
        float across = (1 + p) * (z_side[k] + z_side[k + 1]) + (1 - p) * (a[k] + c[k]);
        float diagonal = (1 + t) * (a_side[k] + c_side[k + 1]) + (1 - t) * (a_side[k + 1] + c_side[k]);
        out[k] = amplitude * (b * z[k] + SIDE * across + diagonal);
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
                       float *restrict even, float *restrict odd)
{
    for (size_t k = 0; k < cells + 2; k++)
        mixed[k] = .75F * at[k] + .25F * other[k];
    for (size_t k = 0; k < whole_vectors(cells); k++) {
        even[k] = .75F * mixed[k + 1] + .25F * mixed[k];
        odd[k] = .75F * mixed[k + 1] + .25F * mixed[k + 2];
    }
}

/* Energies of the children of cells `first` ... of row `row` / 2 of the input, counted from the first block. */
static void child_energy(const float *energy, size_t stride, ptrdiff_t row, ptrdiff_t first, size_t cells, float *mixed,
                         halves out)
{
    ptrdiff_t cell = (row - (row & 1)) / 2;
    const float *at = energy + cell * (ptrdiff_t)stride + first - 1;
    energy_row(at, at + (row & 1 ? (ptrdiff_t)stride : -(ptrdiff_t)stride), cells, mixed, out.of[0], out.of[1]);
}

/* ---- Details ---- */

/* The mean and the details of four children. */
static inline void haar(float a, float b, float c, float d, float out[4])
{
    float ab = a + b, cd = c + d, ba = b - a, dc = d - c;
    out[0] = .25F * (ab + cd);
    out[1] = .25F * (ba + dc);
    out[2] = .25F * (cd - ab);
    out[3] = .25F * (dc - ba);
}

static void haar_row(const float *restrict a, const float *restrict b, const float *restrict c, const float *restrict d,
                     size_t count, float *restrict mean, float *restrict x, float *restrict y, float *restrict mixed)
{
    for (size_t k = 0; k < whole_vectors(count); k++) {
        float out[4];
        haar(a[k], b[k], c[k], d[k], out);
        mean[k] = out[0];
        x[k] = out[1];
        y[k] = out[2];
        mixed[k] = out[3];
    }
}

static void store_details(const planes *p, int which, ptrdiff_t block_row, const halves lines[2])
{
    float *mean = row_at(p->mean[which], block_row);
    haar_row(lines[0].of[0], lines[0].of[1], lines[1].of[0], lines[1].of[1], p->columns, mean,
             row_at(p->x[which], block_row), row_at(p->y[which], block_row), row_at(p->mixed[which], block_row));
    slopes_along(mean, p->at.width + 2 * PITS, row_at(p->mean_slopes[which], block_row));
}

typedef struct walk {
    const fbm_kernel *noise; /* NULL: only the levelling */
    const fbm_relief_step *step;
    const float *energy, *slack; /* at the first block */
    size_t energy_stride;
    planes *p;
    float per_x, per_y; /* 1 / two children */
    halves white[RING], fx[RING], fy[RING];
    halves energies, slacks, noisy[2], levelled[2];
} walk;

/* Rows of children are counted from the first block's. */
static halves ring(const halves of[RING], ptrdiff_t row)
{
    return of[(size_t)(row + 2 * FBM_RELIEF_MARGIN) % RING];
}

/* From a child before the NOISE columns to one behind. */
static void draw_row(const walk *w, ptrdiff_t row)
{
    const planes *p = w->p;
    const halves white = ring(w->white, row);
    const size_t pairs = whole_vectors(p->columns + 1);
    float *restrict drawn = p->row[LONG], *restrict odd = white.of[1] - 1, *restrict even = white.of[0];
    draw_noise(w->noise, w->step, 2 * p->at.j + row, 2 * (p->at.i - NOISE) - 1, 2 * pairs, drawn);
    for (size_t k = 0; k < pairs; k++) {
        odd[k] = drawn[2 * k];
        even[k] = drawn[2 * k + 1];
    }
}

/* Of even columns one block more behind, of odd ones one more before. */
static void walk_slopes(const walk *w, ptrdiff_t row, int half)
{
    const planes *p = w->p;
    const ptrdiff_t column = SMOOTH - NOISE - half;
    const halves z = child_row(p->smooth, row);
    float *const *room = p->row;
    slope_row(child_row(p->smooth, row - 1).of[half] + column, child_row(p->smooth, row + 1).of[half] + column,
              beside_half(z, half) + column, w->per_x, w->per_y, w->step->level_slope, p->columns + 1, room[GX] - half,
              room[GY] - half, room[G2] - half, ring(w->fx, row).of[half] - half, ring(w->fy, row).of[half] - half);
}

/* Behind the slopes of its half. */
static void walk_noise(const walk *w, ptrdiff_t row, int half)
{
    around white;
    for (int k = 0; k < 3; k++) {
        const halves drawn = ring(w->white, row - 1 + k);
        white.own[k] = drawn.of[half];
        white.beside[k] = beside_half(drawn, half);
    }
    float *const *room = w->p->row;
    noise_row(w->step, room[GX], room[GY], room[G2], w->energies.of[half], w->slacks.of[half], &white, w->p->columns,
              w->noisy[row & 1].of[half]);
}

/* Slopes of a row, and its noise. */
static void walk_row(const walk *w, ptrdiff_t row, bool noisy)
{
    float *mixed = w->p->row[MIXED];
    if (noisy) {
        draw_row(w, row + 1);
        child_energy(w->energy, w->energy_stride, row, -NOISE, w->p->columns, mixed, w->energies);
        if (w->slack)
            child_energy(w->slack, w->energy_stride, row, -NOISE, w->p->columns, mixed, w->slacks);
    }
    for (int half = 0; half < 2; half++) {
        walk_slopes(w, row, half);
        if (noisy)
            walk_noise(w, row, half);
    }
}

static void walk_levelling(const walk *w, ptrdiff_t row)
{
    float area = w->step->level;
    const halves fx = ring(w->fx, row);
    for (int half = 0; half < 2; half++)
        divergence_row(beside_half(fx, half), ring(w->fy, row - 1).of[half], ring(w->fy, row + 1).of[half],
                       area * w->per_x, area * w->per_y, w->p->columns, w->levelled[row & 1].of[half]);
}

/* What the first row of details needs before it. */
static void prime(walk *w)
{
    const ptrdiff_t first = 2 * w->p->next_details;
    predict(w->p, w->p->next_details);
    walk_row(w, first - 1, false);
    if (w->noise) {
        draw_row(w, first - 1);
        draw_row(w, first);
    }
    walk_row(w, first, w->noise != NULL);
}

/* Before make_details(). `energy` is not looked at without noise. */
static walk begin_walk(const fbm_kernel *noise, const fbm_relief_step *step, const float *energy, fbm_window in,
                       planes *p)
{
    walk w = {.noise = noise, .step = step, .energy_stride = in.stride, .p = p};
    if (noise)
        w.energy = energy + (size_t)(p->at.j - in.j) * in.stride + (size_t)(p->at.i - in.i);
    if (noise && step->slack)
        w.slack = w.energy + in.stride * in.height;
    w.per_x = 1 / (2 * step->children_x);
    w.per_y = 1 / (2 * step->children_y);
    for (int k = 0; k < RING; k++) {
        w.white[k] = halves_at(p, WHITE + 2 * k);
        w.fx[k] = halves_at(p, FX + 2 * k);
        w.fy[k] = halves_at(p, FY + 2 * k);
    }
    for (int k = 0; k < 2; k++) {
        w.noisy[k] = halves_at(p, NOISY + 2 * k);
        w.levelled[k] = halves_at(p, LEVELLED + 2 * k);
    }
    w.energies = halves_at(p, ENERGIES);
    w.slacks = halves_at(p, SLACKS);
    for (int half = 0; half < 2; half++)
        memset(w.slacks.of[half], 0, p->columns * sizeof(float));
    prime(&w);
    return w;
}

/* Makes the details of the noise and of the levelling up to a row of blocks, child row by child row. */
static void make_details(const walk *w, ptrdiff_t last)
{
    planes *p = w->p;
    for (ptrdiff_t r; (r = p->next_details) <= last; p->next_details++) {
        predict(p, r + 1);
        for (ptrdiff_t row = 2 * r + 1; row <= 2 * r + 2; row++) {
            walk_row(w, row, w->noise != NULL);
            if (w->noise && row & 1)
                store_details(p, 0, r, w->noisy);
            walk_levelling(w, row - 1);
        }
        store_details(p, 1, r, w->levelled);
    }
}

/* ---- Children ---- */

/* out = detail + (gain * (noise - its prediction) + (levelling - its prediction)) */
static void sum_details(const float *restrict smooth, const float *restrict noise, const float *restrict noise_smooth,
                        const float *restrict level, const float *restrict level_smooth, float gain, size_t count,
                        float *restrict out)
{
    for (size_t k = 0; k < whole_vectors(count); k++)
        out[k] = smooth[k] + (gain * (noise[k] - noise_smooth[k]) + (level[k] - level_smooth[k]));
}

/* The children of a row of blocks, before pits are softened. */
static void finish_row(const planes *p, const float gains[3], ptrdiff_t r)
{
    const size_t count = p->at.width + 2 * PITS, smooth = SMOOTH - PITS, noise = NOISE - PITS;
    float *const *details = p->row + SPARE, *of_noise = p->row[SPARE + 3], *of_level = p->row[SPARE + 4];
    sum_details(row_at(p->slopes, r) + smooth, row_at(p->x[0], r) + noise, row_at(p->mean_slopes[0], r),
                row_at(p->x[1], r) + noise, row_at(p->mean_slopes[1], r), gains[0], count, details[0]);
    slopes_across(across_at(p->mean[0], r, noise), count, of_noise);
    slopes_across(across_at(p->mean[1], r, noise), count, of_level);
    sum_details(row_at(p->smooth_y, r) + smooth, row_at(p->y[0], r) + noise, of_noise, row_at(p->y[1], r) + noise,
                of_level, gains[1], count, details[1]);
    slopes_across(across_at(p->mean_slopes[0], r, 0), count, of_noise);
    slopes_across(across_at(p->mean_slopes[1], r, 0), count, of_level);
    sum_details(row_at(p->smooth_mixed, r) + smooth, row_at(p->mixed[0], r) + noise, of_noise,
                row_at(p->mixed[1], r) + noise, of_level, gains[2], count, details[2]);
    children_rows(row_at(p->cells, r) + REACH + smooth, details[0], details[1], details[2], count,
                  child_row(p->children, 2 * r), child_row(p->children, 2 * r + 1));
}

/* 1/2 where one of a block's children is lower than the eight around it, else 0. */
static void pit_row(halves above, halves upper, halves lower, halves below, size_t count, float *restrict out)
{
    const float *restrict p = above.of[0], *restrict q = above.of[1], *restrict a = upper.of[0],
                          *restrict b = upper.of[1], *restrict c = lower.of[0], *restrict d = lower.of[1],
                          *restrict r = below.of[0], *restrict s = below.of[1];
    const float *restrict q_left = q - 1, *restrict b_left = b - 1, *restrict d_left = d - 1, *restrict s_left = s - 1;
    for (size_t k = 0; k < whole_vectors(count); k++) {
        float left = lesser(b_left[k], d_left[k]), right = lesser(a[k + 1], c[k + 1]);
        float two_above = lesser(p[k], q[k]), two_upper = lesser(a[k], b[k]);
        float two_lower = lesser(c[k], d[k]), two_below = lesser(r[k], s[k]);
        float around_upper = lesser(two_above, two_lower), around_lower = lesser(two_upper, two_below);
        int pit_a = a[k] < lesser(lesser(around_upper, left), lesser(q_left[k], b[k]));
        int pit_b = b[k] < lesser(lesser(around_upper, right), lesser(p[k + 1], a[k]));
        int pit_c = c[k] < lesser(lesser(around_lower, left), lesser(s_left[k], d[k]));
        int pit_d = d[k] < lesser(lesser(around_lower, right), lesser(r[k + 1], c[k]));
        out[k] = (pit_a | pit_b) | (pit_c | pit_d) ? .5F : 0.F;
    }
}

static void soften_row(const float *restrict pits, const float *restrict z, size_t count, halves upper, halves lower)
{
    float *restrict a = upper.of[0], *restrict b = upper.of[1], *restrict c = lower.of[0], *restrict d = lower.of[1];
    for (size_t k = 0; k < whole_vectors(count); k++) {
        float soften = pits[k], height = z[k];
        a[k] += soften * (height - a[k]);
        b[k] += soften * (height - b[k]);
        c[k] += soften * (height - c[k]);
        d[k] += soften * (height - d[k]);
    }
}

/* Softening halves the details of every block that holds a pit: first of the blocks one around, then, for that may make
 * others, of those that are wanted. Here are a row's pits found before softening `which`; the rows above and below must
 * be there. */
static halves blocks_row(const planes *p, ptrdiff_t row, size_t margin)
{
    halves all = child_row(p->children, row);
    return (halves){{all.of[0] + PITS - margin, all.of[1] + PITS - margin}};
}

static void find_pits(const planes *p, size_t which, ptrdiff_t r)
{
    const size_t margin = 1 - which;
    pit_row(blocks_row(p, 2 * r - 1, margin), blocks_row(p, 2 * r, margin), blocks_row(p, 2 * r + 1, margin),
            blocks_row(p, 2 * r + 2, margin), p->at.width + 2 * margin, row_at(p->pits[which], r));
}

/* The rows above and below must have found theirs. */
static void soften_pits(const planes *p, size_t which, ptrdiff_t r)
{
    const size_t margin = 1 - which;
    soften_row(row_at(p->pits[which], r), cell_row(p, r) - margin, p->at.width + 2 * margin,
               blocks_row(p, 2 * r, margin), blocks_row(p, 2 * r + 1, margin));
}

static bool within(const planes *p, ptrdiff_t r, ptrdiff_t margin)
{
    return r >= -margin && r < (ptrdiff_t)p->at.height + margin;
}

/* Everything that can be done once the children of block row r are there; row r - 4 is then ready. */
static void soften_behind(const planes *p, ptrdiff_t r)
{
    for (size_t which = 0; which < 2; which++) {
        const ptrdiff_t margin = 1 - (ptrdiff_t)which, last = r - 2 * (ptrdiff_t)which;
        if (within(p, last - 1, margin))
            find_pits(p, which, last - 1);
        if (within(p, last - 2, margin))
            soften_pits(p, which, last - 2);
    }
}

/* A row that is counted from the first block's, cut to the window. */
static void hand_out(const planes *p, ptrdiff_t row, halves of, fbm_window children, float *out)
{
    const size_t skip = (size_t)(children.i - 2 * p->at.i);
    row -= (ptrdiff_t)(children.j - 2 * p->at.j);
    if (row < 0 || row >= (ptrdiff_t)children.height)
        return;
    out += (size_t)row * children.stride;
    if (skip == 0 && children.width == 2 * p->at.width) {
        interleave(of.of[0], of.of[1], p->at.width, out);
        return;
    }
    interleave(of.of[0], of.of[1], p->at.width, p->row[LONG]);
    memcpy(out, p->row[LONG] + skip, children.width * sizeof *out);
}

static void hand_out_energy(const planes *p, const float *energy, fbm_window in, fbm_window children, float *out)
{
    const float *at = energy + (size_t)(p->at.j - in.j) * in.stride + (size_t)(p->at.i - in.i);
    const halves room = halves_at(p, ENERGIES);
    for (ptrdiff_t row = 0; row < 2 * (ptrdiff_t)p->at.height; row++) {
        child_energy(at, in.stride, row, 0, p->at.width, p->row[MIXED], room);
        hand_out(p, row, room, children, out);
    }
}

static void refine(const fbm_kernel *noise, const fbm_relief_step *step, const float *heights, const float *energy,
                   fbm_window in, float *out, float *out_energy, fbm_window children, float *scratch)
{
    planes p = lay_out(heights, in, children, scratch);
    const walk w = begin_walk(noise, step, energy, in, &p);
    for (ptrdiff_t r = -PITS; r < (ptrdiff_t)p.at.height + 2 * PITS; r++) {
        if (within(&p, r, PITS)) {
            make_details(&w, r + REACH);
            finish_row(&p, step->gains, r);
        }
        if (!step->pits)
            soften_behind(&p, r);
        for (ptrdiff_t row = 2 * (r - 2 * PITS), k = row; k < row + 2 && within(&p, r - 2 * PITS, 0); k++)
            hand_out(&p, k, blocks_row(&p, k, 0), children, out);
    }
    if (out_energy)
        hand_out_energy(&p, energy, in, children, out_energy);
    if (out_energy && step->slack)
        hand_out_energy(&p, energy + in.stride * in.height, in, children,
                        out_energy + children.stride * children.height);
}

/* ---- Sums over blocks ---- */

/* What the x, y and mixed details of a row of blocks have beyond what the means predict. */
typedef struct surplus {
    const float *of[3];
} surplus;

static void subtract(const float *restrict a, const float *restrict b, size_t count, float *restrict out)
{
    for (size_t k = 0; k < whole_vectors(count); k++)
        out[k] = a[k] - b[k];
}

/* In three rows of `room`. */
static surplus surplus_of(const planes *p, int which, ptrdiff_t r, float *const room[3])
{
    float *spare = p->row[SPARE + 6];
    const float *slopes = row_at(p->mean_slopes[which], r) + PITS;
    subtract(row_at(p->x[which], r) + NOISE, slopes, p->at.width, room[0]);
    slopes_across(across_at(p->mean[which], r, NOISE), p->at.width, spare);
    subtract(row_at(p->y[which], r) + NOISE, spare, p->at.width, room[1]);
    slopes_across(across_at(p->mean_slopes[which], r, PITS), p->at.width, spare);
    subtract(row_at(p->mixed[which], r) + NOISE, spare, p->at.width, room[2]);
    return (surplus){{room[0], room[1], room[2]}};
}

static void add_sums(const fbm_kernel *noise, const fbm_relief_step *step, const float *heights, const float *energy,
                     fbm_window in, fbm_window children, float *scratch, fbm_relief_sums *sums)
{
    assert(!((children.i | children.j | (int64_t)children.width | (int64_t)children.height) & 1));
    planes p = lay_out(heights, in, children, scratch);
    const walk w = begin_walk(noise, step, energy, in, &p);
    for (ptrdiff_t r = 0; r < (ptrdiff_t)p.at.height; r++) {
        make_details(&w, r + REACH);
        const surplus f = surplus_of(&p, 0, r, p.row + SPARE), h = surplus_of(&p, 1, r, p.row + SPARE + 3);
        for (size_t k = 0; k < p.at.width; k++)
            for (int d = 0; d < 3; d++) {
                double noisy = (double)f.of[d][k], levelled = (double)h.of[d][k];
                sums->noise[d] += noisy * noisy;
                sums->levelling[d] += levelled * levelled;
            }
    }
    sums->count += p.at.width * p.at.height;
}

static void add_slopes(const fbm_relief_step *step, const float *heights, fbm_window in, fbm_window children,
                       float *scratch, fbm_slopes *slopes)
{
    planes p = lay_out(heights, in, children, scratch);
    const ptrdiff_t first = (ptrdiff_t)(children.j - 2 * p.at.j);
    const float per_x = 1 / (2 * step->children_x), per_y = 1 / (2 * step->children_y);
    float *const *spare = p.row + SPARE, *squares = p.row[LONG] + (size_t)(children.i - 2 * p.at.i);
    for (ptrdiff_t r = first; r < first + (ptrdiff_t)children.height; r++) {
        predict(&p, (r + 1) >> 1);
        const halves above = child_row(p.smooth, r - 1), z = child_row(p.smooth, r), below = child_row(p.smooth, r + 1);
        for (int half = 0; half < 2; half++)
            slope_row(above.of[half] + SMOOTH, below.of[half] + SMOOTH, beside_half(z, half) + SMOOTH, per_x, per_y, 0,
                      p.at.width, spare[0], spare[1], spare[2 + half], spare[4], spare[5]);
        interleave(spare[2], spare[3], p.at.width, p.row[LONG]);
        for (size_t k = 0; k < children.width; k++) {
            uint32_t bits;
            memcpy(&bits, &squares[k], sizeof bits);
            slopes->bins[bits >> 16 & (FBM_SLOPE_BINS - 1)]++;
            slopes->sum += (double)squares[k];
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
    const walk w = begin_walk(NULL, step, NULL, in, &p);
    const double roots[2] = {sqrt(shares[0]), sqrt(shares[1])};
    const double per_x = 1 / (4 * (double)step->children_x), per_y = 1 / (4 * (double)step->children_y);
    for (ptrdiff_t r = 0; r < (ptrdiff_t)p.at.height; r++) {
        make_details(&w, r + REACH);
        const surplus h = surplus_of(&p, 1, r, p.row + SPARE);
        const float *z = cell_row(&p, r);
        const float *smooth[3] = {row_at(p.slopes, r) + SMOOTH, row_at(p.smooth_y, r) + SMOOTH,
                                  row_at(p.smooth_mixed, r) + SMOOTH};
        const float *upper = samples + 2 * (size_t)r * children.stride, *lower = upper + children.stride;
        for (size_t k = 0; k < p.at.width; k++) {
            double gx = ((double)z[k + 1] - (double)z[(ptrdiff_t)k - 1]) * per_x;
            double gy = ((double)z[k + p.input_stride] - (double)z[(ptrdiff_t)k - (ptrdiff_t)p.input_stride]) * per_y;
            if (!(gx * gx + gy * gy > steep))
                continue;
            float own[4];
            haar(upper[2 * k], upper[2 * k + 1], lower[2 * k], lower[2 * k + 1], own);
            double a[3];
            for (int d = 0; d < 3; d++)
                a[d] = (double)(own[1 + d] - smooth[d][k]);
            const double b[3] = {(double)h.of[0][k], (double)h.of[1][k], (double)h.of[2][k]};
            fit_block(a, b, gx, gy, roots, fit);
        }
    }
}

/* ---- Energy ---- */

enum { SMOOTHING = 8 };

/* exp(-k^2 / 8): a Gaussian of two cells */
static const float gauss[SMOOTHING + 1] = {1,          .8824969F,   .60653066F,   .32465247F,   .13533528F,
                                           .04393693F, .011108997F, .0021874911F, .00033546263F};

_Static_assert(SMOOTHING == 8, "the sum's terms are written out");
static void smooth_across(const float *in, ptrdiff_t stride, size_t count, float *restrict out)
{
    for (ptrdiff_t k = 0; k < (ptrdiff_t)count; k++) {
        const float *at = in + k;
        float sum = at[0] + gauss[1] * (at[-stride] + at[stride]);
        sum += gauss[2] * (at[-2 * stride] + at[2 * stride]);
        sum += gauss[3] * (at[-3 * stride] + at[3 * stride]);
        sum += gauss[4] * (at[-4 * stride] + at[4 * stride]);
        sum += gauss[5] * (at[-5 * stride] + at[5 * stride]);
        sum += gauss[6] * (at[-6 * stride] + at[6 * stride]);
        sum += gauss[7] * (at[-7 * stride] + at[7 * stride]);
        sum += gauss[8] * (at[-8 * stride] + at[8 * stride]);
        out[k] = sum;
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
        for (size_t k = 0; k < o.width; k++) { /* NaN where nothing is known, but not by a division by 0 */
            float weight = weights[r * o.width + k];
            out[r * o.stride + k] = (weight > 0 ? sums[r * o.width + k] : NAN) / (weight > 0 ? weight : 1);
        }
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
