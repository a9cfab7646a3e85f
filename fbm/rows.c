/* Puts rows between the rows of a lattice whose cells are higher than wide. That is done once or twice above all other
 * steps, so it is a small part of the work, and one portable build of it is enough. */
#include "fbm/kernel.h"

#include <assert.h>
#include <string.h>

enum { REACH = 3 };

static int64_t half(int64_t a)
{
    return (a - (a & 1)) / 2;
}

fbm_window fbm_rows_support(fbm_window out)
{
    assert(out.width && out.height);
    int64_t first = half(out.j), last = half(out.j + (int64_t)out.height - 1);
    size_t width = out.width + 2 * REACH;
    return (fbm_window){out.i - REACH, first - 1, width, (size_t)(last - first + 4), width};
}

size_t fbm_rows_scratch(size_t width)
{
    return 5 * (width + 2 * REACH);
}

typedef struct between {
    const fbm_kernel *kernel;
    const fbm_row_step *step;
    const float *in, *map;
    fbm_window from;
    int64_t first;             /* column of the output */
    size_t count;              /* columns of it; all rows below begin REACH before and end REACH behind */
    float *near, *far;         /* sums of the two nearest rows, and of the next two */
    float *at, *above, *below; /* noise */
} between;

static const float *row_at(const between *b, const float *base, int64_t j)
{
    return base + (size_t)(j - b->from.j) * b->from.stride + (size_t)(b->first - REACH - b->from.i);
}

static void make_noise(const between *b, int64_t j, float *out)
{
    const fbm_row_step *s = b->step;
    size_t count = b->count + 2 * REACH;
    int64_t column = b->first - REACH, period = s->period;
    size_t run = count;
    for (size_t done = 0; done < count; done += run) {
        int64_t at = column + (int64_t)done;
        if (period) {
            at = (at % period + period) % period;
            run = (uint64_t)(period - at) < count - done ? (size_t)(period - at) : count - done;
        }
        b->kernel->noise(s->seed, s->level, FBM_NOISE_ROWS, j, at, run, out + done);
    }
    if (b->map)
        b->kernel->scale2(row_at(b, b->map, j), row_at(b, b->map, j + 1), out, count);
}

static void predict(const between *b, int64_t j, const float *w, float *restrict out)
{
    const float *restrict z0 = row_at(b, b->in, j - 1), *restrict z1 = row_at(b, b->in, j),
                          *restrict z2 = row_at(b, b->in, j + 1), *restrict z3 = row_at(b, b->in, j + 2);
    float *restrict near = b->near, *restrict far = b->far;
    for (size_t k = 0; k < b->count + 2 * REACH; k++) {
        near[k] = z1[k] + z2[k];
        far[k] = z0[k] + z3[k];
    }
    for (size_t x = 0; x < b->count; x++) {
        float inner = (w[0] * near[x + 3] + w[1] * (near[x + 2] + near[x + 4])) +
                      (w[2] * (near[x + 1] + near[x + 5]) + w[3] * (near[x] + near[x + 6]));
        out[x] = inner + (w[4] * far[x + 3] + (w[5] * (far[x + 2] + far[x + 4]) + w[6] * (far[x + 1] + far[x + 5])));
    }
}

/* The noise of rows j - 1 ... j + 1 is there. */
static void add_residual(const between *b, const float *taps, float *restrict out)
{
    const float *restrict at = b->at, *restrict above = b->above, *restrict below = b->below;
    float t[7], *restrict beside = b->near;
    for (int k = 0; k < 7; k++)
        t[k] = b->step->amplitude * taps[k];
    for (size_t k = 0; k < b->count + 2 * REACH; k++)
        beside[k] = above[k] + below[k];
    for (size_t x = 0; x < b->count; x++) {
        float along = (t[0] * at[x + 3] + t[1] * (at[x + 2] + at[x + 4])) +
                      (t[2] * (at[x + 1] + at[x + 5]) + t[6] * (at[x] + at[x + 6]));
        out[x] += along + (t[3] * beside[x + 3] +
                           (t[4] * (beside[x + 2] + beside[x + 4]) + t[5] * (beside[x + 1] + beside[x + 5])));
    }
}

/* The row between j and j + 1; rows come in order. */
static void make_row(between *b, int64_t j, float *out)
{
    const fbm_row_step *s = b->step;
    const fbm_row_weights *weights = s->rows ? s->rows + (j - s->first_row) : &s->weights;
    predict(b, j, weights->w, out);
    if (s->amplitude == 0)
        return;
    make_noise(b, j + 1, b->below);
    add_residual(b, weights->taps, out);
    float *oldest = b->above;
    b->above = b->at;
    b->at = b->below;
    b->below = oldest;
}

void fbm_refine_rows_by(const fbm_kernel *kernel, const fbm_row_step *step, const float *in, const float *map,
                        fbm_window from, float *out, fbm_window to, float *scratch)
{
    if (!to.width || !to.height)
        return;
    size_t row = to.width + 2 * REACH;
    between b = {.kernel = kernel,
                 .step = step,
                 .in = in,
                 .map = map,
                 .from = from,
                 .first = to.i,
                 .count = to.width,
                 .near = scratch,
                 .far = scratch + row,
                 .at = scratch + 2 * row,
                 .above = scratch + 3 * row,
                 .below = scratch + 4 * row};
    int64_t first = half(to.j), last = half(to.j + (int64_t)to.height - 1);
    if (step->amplitude != 0) {
        make_noise(&b, first - 1, b.above);
        make_noise(&b, first, b.at);
    }
    for (int64_t j = first; j <= last; j++) {
        int64_t y = 2 * j - to.j; /* -1 where the window begins with a row between */
        float *at = out + (size_t)(y < 0 ? 0 : y) * to.stride;
        if (y >= 0) {
            memcpy(at, row_at(&b, in, j) + REACH, to.width * sizeof *at);
            at += to.stride;
        }
        if (y + 1 < (int64_t)to.height)
            make_row(&b, j, at);
    }
}

void fbm_refine_rows(const fbm_row_step *step, const float *in, const float *map, fbm_window in_window, float *out,
                     fbm_window out_window, float *scratch)
{
    fbm_refine_rows_by(fbm_kernels()[0], step, in, map, in_window, out, out_window, scratch);
}
