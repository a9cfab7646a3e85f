/* Two classical schemes that do not keep old samples: Miller's square-square subdivision, and successive random
 * additions. For comparison, so one portable build is enough. */
#include "fbm/kernel.h"

#include <stdbool.h>
#include <string.h>

static int64_t half(int64_t a)
{
    return (a - (a & 1)) / 2;
}

static const float *sample(const float *base, fbm_window w, int64_t i, int64_t j)
{
    return base + (size_t)(j - w.j) * w.stride + (size_t)(i - w.i);
}

void fbm_step_noise(const fbm_kernel *kernel, const fbm_step *step, int64_t period, fbm_noise_kind kind, int64_t row,
                    int64_t first, size_t count, float *out)
{
    if (period == 0) {
        kernel->noise(step->seed, step->level, kind, row, first, count, out);
        return;
    }
    int64_t column = (first % period + period) % period;
    for (size_t done = 0, n; done < count; done += n, column = 0) {
        n = (uint64_t)(period - column) < count - done ? (size_t)(period - column) : count - done;
        kernel->noise(step->seed, step->level, kind, row, column, n, out + done);
    }
}

/* What is made at a time. */
typedef struct part {
    const fbm_kernel *kernel;
    const fbm_step *step;
    const float *in, *map;
    fbm_window from;
    int64_t column; /* of the first cell */
    size_t count;   /* cells */
    float *row[8];  /* scratch, count + 4 each; the last two are one of twice as many */
} part;

static const fbm_weights *weights_at(const part *p, int64_t j, bool between)
{
    const fbm_step *step = p->step;
    return step->rows ? step->rows + (2 * j + between - step->first_row) : &step->weights;
}

/* ---- Square-square ----------------------------------------------------------------------------- */

/* The children of row j of cells that lie above (q = 0) or below its middle, from column 2 `column` on. */
static void child_row(const part *p, int64_t j, int q, float *restrict out)
{
    const float *restrict own = sample(p->in, p->from, p->column - 1, j), *restrict other =
                                                                              sample(p->in, p->from, p->column - 1,
                                                                                     q ? j + 1 : j - 1);
    float *restrict v = p->row[0], *restrict g = p->row[6];
    for (size_t k = 0; k < p->count + 2; k++)
        v[k] = .75F * own[k] + .25F * other[k];
    for (size_t k = 0; k < p->count; k++) {
        out[2 * k] = .75F * v[k + 1] + .25F * v[k];
        out[2 * k + 1] = .75F * v[k + 1] + .25F * v[k + 2];
    }
    if (p->step->amplitude == 0)
        return;
    float tap = p->step->amplitude * weights_at(p, j, false)->centre_taps[0];
    fbm_step_noise(p->kernel, p->step, 2 * p->step->period, FBM_NOISE_CELLS, 2 * j + q, 2 * p->column, 2 * p->count, g);
    const float *map = p->map ? sample(p->map, p->from, p->column, j) : NULL;
    for (size_t x = 0; x < 2 * p->count; x++)
        out[x] += tap * (map ? g[x] * map[x / 2] : g[x]);
}

/* ---- Successive additions ---------------------------------------------------------------------- */

/* Noise of the old points: four rows of it belong to a row of cells, so that all are independent. */
enum addition { VERTICES_FIRST, VERTICES_SECOND, CENTRES_SECOND };

static void add_noise(const part *p, fbm_noise_kind kind, int64_t row, int64_t i, int64_t j, size_t count, bool middle,
                      float tap, float *restrict z)
{
    if (p->step->amplitude == 0)
        return;
    float *restrict g = p->row[5];
    fbm_step_noise(p->kernel, p->step, p->step->period, kind, row, i, count, g);
    if (p->map && middle)
        p->kernel->scale4(sample(p->map, p->from, i, j), sample(p->map, p->from, i, j + 1), g, count);
    else if (p->map)
        p->kernel->scale2(sample(p->map, p->from, i, j), sample(p->map, p->from, i, j), g, count);
    tap *= p->step->amplitude;
    for (size_t k = 0; k < count; k++)
        z[k] += tap * g[k];
}

/* Vertices of row j after the first addition, from column i on. */
static void moved_vertices(const part *p, int64_t i, int64_t j, size_t count, float *out)
{
    memcpy(out, sample(p->in, p->from, i, j), count * sizeof *out);
    add_noise(p, FBM_NOISE_ADDITIONS, 4 * j + VERTICES_FIRST, i, j, count, false,
              weights_at(p, j, false)->centre_taps[0], out);
}

/* Centres of row j as they are made, from cell i on. */
static void new_centres(const part *p, int64_t i, int64_t j, size_t count, float *out)
{
    p->kernel->mean4(sample(p->in, p->from, i, j), sample(p->in, p->from, i, j + 1), NULL, 0, out, count);
    add_noise(p, FBM_NOISE_CENTRES, j, i, j, count, true, weights_at(p, j, true)->centre_taps[0], out);
}

static void move_centres(const part *p, int64_t i, int64_t j, size_t count, float *centres)
{
    add_noise(p, FBM_NOISE_ADDITIONS, 4 * j + CENTRES_SECOND, i, j, count, true, weights_at(p, j, true)->edge_taps[0],
              centres);
}

/* Means of an edge's two ends and the two centres beside it. */
static void mean_edges(const float *restrict a, const float *restrict b, const float *restrict c,
                       const float *restrict d, size_t count, float *restrict out)
{
    for (size_t k = 0; k < count; k++)
        out[k] = .25F * ((a[k] + b[k]) + (c[k] + d[k]));
}

/* Samples of rows 2j (q = 0) or 2j + 1, from column 2 `column` on. */
static void added_row(const part *p, int64_t j, int q, float *out)
{
    size_t n = p->count;
    float *even = p->row[0], *odd = p->row[1], *a = p->row[2], *b = p->row[3], *c = p->row[4];
    float *d = p->row[6];
    float tap = weights_at(p, j, q != 0)->edge_taps[0];
    moved_vertices(p, p->column, j, n + 1, a);
    new_centres(p, p->column - 1, j, n + 1, c); /* from the cell before */
    if (q == 0) {
        new_centres(p, p->column, j - 1, n, d);
        mean_edges(a, a + 1, d, c + 1, n, odd);
        add_noise(p, FBM_NOISE_ROW_EDGES, j, p->column, j, n, false, tap, odd);
        memcpy(even, a, n * sizeof *even);
        add_noise(p, FBM_NOISE_ADDITIONS, 4 * j + VERTICES_SECOND, p->column, j, n, false, tap, even);
    } else {
        moved_vertices(p, p->column, j + 1, n, b);
        mean_edges(a, b, c, c + 1, n, even);
        add_noise(p, FBM_NOISE_COLUMN_EDGES, j, p->column, j, n, false, tap, even);
        memcpy(odd, c + 1, n * sizeof *odd);
        move_centres(p, p->column, j, n, odd);
    }
    p->kernel->interleave(even, odd, out, n);
}

/* ---- Windows ----------------------------------------------------------------------------------- */

/* Cells that are made at a time, and floats of scratch: 8 rows of COLUMNS + 4, and two for a row of output. */
enum { COLUMNS = 256, ROW = COLUMNS + 16 };

static part part_of(const fbm_kernel *kernel, const fbm_step *step, const float *in, const float *map, fbm_window from,
                    float *scratch)
{
    part p = {.kernel = kernel, .step = step, .in = in, .map = map, .from = from};
    for (int k = 0; k < 8; k++)
        p.row[k] = scratch + k * ROW;
    return p;
}

size_t fbm_classic_scratch(void)
{
    return 10 * ROW;
}

void fbm_classic_refine(const fbm_kernel *kernel, const fbm_step *step, bool children, const float *in,
                        const float *map, fbm_window from, float *out, fbm_window to, float *scratch)
{
    part p = part_of(kernel, step, in, map, from, scratch);
    float *row = scratch + 8 * ROW;
    int64_t first = half(to.i), last = half(to.i + (int64_t)to.width - 1);
    for (p.column = first; p.column <= last; p.column += COLUMNS) {
        p.count = (size_t)(last - p.column + 1 < COLUMNS ? last - p.column + 1 : COLUMNS);
        int64_t begin = 2 * p.column > to.i ? 2 * p.column : to.i, end = 2 * (p.column + (int64_t)p.count);
        if (end > to.i + (int64_t)to.width)
            end = to.i + (int64_t)to.width;
        for (size_t y = 0; y < to.height; y++) {
            int64_t fine = to.j + (int64_t)y;
            if (children)
                child_row(&p, half(fine), (int)(fine & 1), row);
            else
                added_row(&p, half(fine), (int)(fine & 1), row);
            memcpy(out + y * to.stride + (begin - to.i), row + (begin - 2 * p.column),
                   (size_t)(end - begin) * sizeof *out);
        }
    }
}

void fbm_successive_centres(const fbm_kernel *kernel, const fbm_step *step, const float *in, const float *map,
                            fbm_window from, float *out, fbm_window cells, float *scratch)
{
    part p = part_of(kernel, step, in, map, from, scratch);
    for (size_t y = 0; y < cells.height; y++)
        for (size_t x = 0; x < cells.width; x += COLUMNS) {
            size_t count = cells.width - x < COLUMNS ? cells.width - x : COLUMNS;
            int64_t i = cells.i + (int64_t)x, j = cells.j + (int64_t)y;
            float *row = out + y * cells.stride + x;
            new_centres(&p, i, j, count, row);
            move_centres(&p, i, j, count, row);
        }
}
