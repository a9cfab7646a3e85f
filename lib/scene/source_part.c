#include "lib/scene/source_part.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

/* ---- Which samples ---- */

/* Whether a position along an axis of `size` samples has a height. */
static bool covers(const tl_source_info *info, double at, int64_t size)
{
    /* the rim itself, for positions that round */
    double margin = info->type == TL_RASTER_AREA ? 0.5 + 1e-9 : 1e-6;
    return at >= -margin && at <= (double)size - 1 + margin;
}

static bool covers_x(const tl_source_info *info, double x)
{
    return info->wraps ? isfinite(x) : covers(info, x, info->width);
}

static bool covers_y(const tl_source_info *info, double y)
{
    return covers(info, y, info->height);
}

typedef struct span {
    double low, high;
} span;

static void widen(span *s, double at)
{
    s->low = at < s->low ? at : s->low;
    s->high = at > s->high ? at : s->high;
}

/* The samples that cubics between these positions ask for. */
static bool samples_around(const tl_source_info *info, span x, span y, tl_window *out)
{
    if (!(x.low <= x.high && y.low <= y.high))
        return false;
    int64_t x0 = (int64_t)floor(x.low) - 1, x1 = (int64_t)floor(x.high) + 2;
    int64_t y0 = scene_clamp((int64_t)floor(y.low) - 1, info->height);
    int64_t y1 = scene_clamp((int64_t)floor(y.high) + 2, info->height);
    if (!info->wraps) {
        x0 = scene_clamp(x0, info->width);
        x1 = scene_clamp(x1, info->width);
    }
    *out = (tl_window){x0, y0, x1 - x0 + 1, y1 - y0 + 1};
    return true;
}

bool scene_part_find(const tl_source_info *info, size_t n, const double *at, tl_window *out)
{
    span x = {HUGE_VAL, -HUGE_VAL}, y = x;
    for (size_t k = 0; k < n; k++)
        if (covers_x(info, at[2 * k]) && covers_y(info, at[2 * k + 1])) {
            widen(&x, at[2 * k]);
            widen(&y, at[2 * k + 1]);
        }
    return samples_around(info, x, y, out);
}

bool scene_part_find_grid(const tl_source_info *info, int64_t columns, const double *x, int64_t rows, const double *y,
                          tl_window *out)
{
    span across = {HUGE_VAL, -HUGE_VAL}, down = across;
    for (int64_t k = 0; k < columns; k++)
        if (covers_x(info, x[k]))
            widen(&across, x[k]);
    for (int64_t k = 0; k < rows; k++)
        if (covers_y(info, y[k]))
            widen(&down, y[k]);
    return samples_around(info, across, down, out);
}

/* Columns x ... x + count - 1 of the raster into column `to` of the part. */
static tl_status read_columns(const tl_source *source, scene_part *p, int64_t x, int64_t count, int64_t to,
                              tl_error *error)
{
    const tl_window *w = &p->window;
    if (count == w->width)
        return tl_source_read(source, source->info.level, (tl_window){x, w->y, count, w->height}, p->z, error);
    float *columns = tl_alloc_grid(count, w->height, sizeof *columns);
    if (!columns)
        return tl_fail_memory(error, source->info.name);
    tl_status status =
        tl_source_read(source, source->info.level, (tl_window){x, w->y, count, w->height}, columns, error);
    for (int64_t y = 0; y < w->height && status == TL_OK; y++)
        memcpy(p->z + y * w->width + to, columns + y * count, (size_t)count * sizeof *columns);
    free(columns);
    return status;
}

/* Columns may be beyond a raster that goes around. */
tl_status scene_part_read(const tl_source *source, scene_part *p, tl_error *error)
{
    int64_t width = source->info.width;
    tl_status status = TL_OK;
    for (int64_t done = 0; done < p->window.width && status == TL_OK;) {
        int64_t x = ((p->window.x + done) % width + width) % width;
        int64_t count = tl_int64_min(p->window.width - done, width - x);
        status = read_columns(source, p, x, count, done, error);
        done += count;
    }
    return status;
}

/* ---- Heights, one by one ---- */

/* Weights of Catmull and Rom's cubic for four samples, `f` from the second to the third. */
static void cubic(double f, double w[4])
{
    w[0] = f * (-0.5 + f * (1 - 0.5 * f));
    w[1] = 1 + f * f * (-2.5 + 1.5 * f);
    w[2] = f * (0.5 + f * (2 - 1.5 * f));
    w[3] = f * f * (-0.5 + 0.5 * f);
}

static int64_t column_of(const scene_part *p, const tl_source_info *info, int64_t i)
{
    return (info->wraps ? i : scene_clamp(i, info->width)) - p->window.x;
}

static const float *row_of(const scene_part *p, const tl_source_info *info, int64_t j)
{
    return p->z + (scene_clamp(j, info->height) - p->window.y) * p->window.width;
}

static float bilinear(const scene_part *p, const tl_source_info *info, double x, double y)
{
    int64_t i = (int64_t)floor(x), j = (int64_t)floor(y), left = column_of(p, info, i),
            right = column_of(p, info, i + 1);
    const float *above = row_of(p, info, j), *below = row_of(p, info, j + 1);
    const float z[4] = {above[left], above[right], below[left], below[right]};
    double fx = x - (double)i, fy = y - (double)j, sum = 0, weights = 0;
    for (int k = 0; k < 4; k++)
        if (isfinite(z[k])) {
            double w = (k & 1 ? fx : 1 - fx) * (k >> 1 ? fy : 1 - fy);
            sum += w * (double)z[k];
            weights += w;
        }
    return weights >= 0.5 ? (float)(sum / weights) : NAN; /* void where most of it is */
}

float scene_part_height(const scene_part *p, const tl_source_info *info, double x, double y)
{
    if (!covers_x(info, x) || !covers_y(info, y))
        return NAN;
    int64_t i = (int64_t)floor(x), j = (int64_t)floor(y);
    double wx[4], wy[4], sum = 0;
    const tl_window *w = &p->window;
    bool inside = i > w->x && j > w->y && i + 2 < w->x + w->width && j + 2 < w->y + w->height;
    cubic(x - (double)i, wx);
    cubic(y - (double)j, wy);
    for (int row = 0; row < 4; row++) {
        float rim[4];
        const float *z = rim;
        if (inside)
            z = p->z + (j + row - 1 - w->y) * w->width + (i - 1 - w->x);
        else
            for (int column = 0; column < 4; column++)
                rim[column] = row_of(p, info, j + row - 1)[column_of(p, info, i + column - 1)];
        sum += wy[row] * (wx[0] * (double)z[0] + wx[1] * (double)z[1] + wx[2] * (double)z[2] + wx[3] * (double)z[3]);
    }
    float height = (float)sum;
    return isfinite(height) ? height : bilinear(p, info, x, y);
}

/* ---- Heights of a grid ---- */

typedef struct taps {
    int32_t at[4][SCENE_PART_MOST]; /* columns of the part */
    double w[4][SCENE_PART_MOST];
} taps;

static void find_taps(const scene_part *p, const tl_source_info *info, int64_t count, const double *x, taps *out)
{
    for (int64_t k = 0; k < count; k++) {
        double w[4] = {0}, at = covers_x(info, x[k]) ? floor(x[k]) : (double)NAN;
        if (!isnan(at))
            cubic(x[k] - at, w);
        for (int c = 0; c < 4; c++) {
            out->w[c][k] = w[c];
            out->at[c][k] = isnan(at) ? 0 : (int32_t)column_of(p, info, (int64_t)at + c - 1);
        }
    }
}

/* A row of samples between its columns. */
static void filter_row(const float *z, const taps *t, int64_t count, double *restrict out)
{
    for (int64_t k = 0; k < count; k++)
        out[k] = t->w[0][k] * (double)z[t->at[0][k]] + t->w[1][k] * (double)z[t->at[1][k]] +
                 t->w[2][k] * (double)z[t->at[2][k]] + t->w[3][k] * (double)z[t->at[3][k]];
}

static void blend_rows(const double *const rows[4], const double w[4], int64_t count, float *restrict out)
{
    const double *a = rows[0], *b = rows[1], *c = rows[2], *d = rows[3];
    for (int64_t k = 0; k < count; k++)
        out[k] = (float)(0 + w[0] * a[k] + w[1] * b[k] + w[2] * c[k] + w[3] * d[k]);
}

/* What the cubic does not give, beside voids and where nothing is. */
static void mend_row(const scene_part *p, const tl_source_info *info, int64_t columns, const double *x, double y,
                     float *out)
{
    for (int64_t k = 0; k < columns; k++)
        if (!covers_x(info, x[k]))
            out[k] = NAN;
        else if (!isfinite(out[k]))
            out[k] = bilinear(p, info, x[k], y);
}

void scene_part_heights(const scene_part *p, const tl_source_info *info, int64_t columns, const double *x, int64_t rows,
                        const double *y, float *out, int64_t stride)
{
    taps t;
    double filtered[4][SCENE_PART_MOST], w[4];
    int64_t held[4] = {-1, -1, -1, -1}; /* rows in it; four in a row, or fewer at the rim, have places of their own */
    find_taps(p, info, columns, x, &t);
    for (int64_t k = 0; k < rows; k++, out += stride) {
        const double *four[4];
        if (!covers_y(info, y[k])) {
            for (int64_t i = 0; i < columns; i++)
                out[i] = NAN;
            continue;
        }
        int64_t j = (int64_t)floor(y[k]);
        for (int r = 0; r < 4; r++) {
            int64_t row = scene_clamp(j + r - 1, info->height), place = row & 3;
            if (held[place] != row)
                filter_row(row_of(p, info, row), &t, columns, filtered[place]);
            held[place] = row;
            four[r] = filtered[place];
        }
        cubic(y[k] - (double)j, w);
        blend_rows(four, w, columns, out);
        mend_row(p, info, columns, x, y[k], out);
    }
}
