#include "fbm/estimate.h"

#include "fbm/elementary.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Weights of the mean-exact prediction; d1 + 2 d2 + 3 d3 = 1/8 makes it exact for planes. */
enum { REACH = 3 };
static const float slope_weights[REACH + 1] = {0, .22405f, -.06762f, .01206f};

/* Share of white noise's variance that the three details keep together. A detail of the children keeps 1/4. A mean of
 * four has 1/4 of the noise, and its slope, q = 2 (d1^2 + d2^2 + d3^2) of that; the prediction touches no child of the
 * block itself, so variances add: (1 + q)/4 for x and for y, (1 + q^2)/4 for the mixed one. */
static const double slope_gain = 2 * (.22405 * .22405 + .06762 * .06762 + .01206 * .01206);

static double noise_share(void)
{
    return 0.5 * (1 + slope_gain) + 0.25 * (1 + slope_gain * slope_gain);
}

/* Means of 2 x 2 samples at distance `step`, each at its block's first sample; the last `step` columns and rows have
 * none. */
static void block_means(const float *in, size_t width, size_t height, size_t step, float *out)
{
    for (size_t y = 0; y + step < height; y++) {
        const float *a = in + y * width, *b = a + step * width;
        for (size_t x = 0; x + step < width; x++)
            out[y * width + x] = 0.25f * ((a[x] + a[x + step]) + (b[x] + b[x + step]));
    }
}

/* D at one place of a field, `stride` between neighbours: the predicted half difference of the children. */
static inline float slope_at(const float *field, ptrdiff_t stride)
{
    return slope_weights[1] * (field[stride] - field[-stride]) +
           slope_weights[2] * (field[2 * stride] - field[-2 * stride]) +
           slope_weights[3] * (field[3 * stride] - field[-3 * stride]);
}

/* D along rows of the means, for the columns x0 ... x1 - 1 of all rows. */
static void row_slopes(const float *means, size_t width, size_t height, size_t step, size_t x0, size_t x1, float *out)
{
    for (size_t y = 0; y + step < height; y++) /* the last rows have no means */
        for (size_t x = x0; x < x1; x++)
            out[y * width + x] = slope_at(means + y * width + x, 2 * (ptrdiff_t)step);
}

/* Columns that are summed up as floats' squares before they are added in double, in four interleaved sums: the order is
 * fixed. */
enum { LANES = 4 };

typedef struct sums {
    double x[LANES], y[LANES], mixed[LANES], count[LANES];
} sums;

/* Adds the details of the blocks at columns x0 ... x1 - 1 of row y. */
static void add_row(const float *children, const float *means, const float *slopes, size_t width, size_t step,
                    size_t x0, size_t x1, sums *total)
{
    const float *below = children + step * width;
    ptrdiff_t down = (ptrdiff_t)(2 * step * width);
    for (size_t k = x0; k < x1; k++) {
        float a = children[k], b = children[k + step], c = below[k], d = below[k + step];
        float x = 0.25f * ((b - a) + (d - c)) - slopes[k];
        float y = 0.25f * ((c - a) + (d - b)) - slope_at(means + k, down);
        float mixed = 0.25f * ((a - b) + (d - c)) - slope_at(slopes + k, down);
        float all = x * x + y * y + mixed * mixed;
        bool known = all - all == 0; /* neither NaN, as with a void in the support, nor infinite */
        size_t lane = k % LANES;
        total->x[lane] += known ? (double)(x * x) : 0;
        total->y[lane] += known ? (double)(y * y) : 0;
        total->mixed[lane] += known ? (double)(mixed * mixed) : 0;
        total->count[lane] += known;
    }
}

static void add_octave(const float *children, const float *means, size_t width, size_t height, size_t step,
                       const size_t box[4], float *slopes, fbm_detail *detail)
{
    size_t before = 2 * REACH * step, after = (2 * REACH + 1) * step;
    if (width <= before + after || height <= before + after)
        return;
    size_t x0 = box[0] > before ? box[0] : before, x1 = box[2] < width - after ? box[2] : width - after;
    size_t y0 = box[1] > before ? box[1] : before, y1 = box[3] < height - after ? box[3] : height - after;
    sums total = {{0}, {0}, {0}, {0}};
    row_slopes(means, width, height, step, x0, x1, slopes);
    for (size_t y = y0; y < y1; y++)
        add_row(children + y * width, means + y * width, slopes + y * width, width, step, x0, x1, &total);
    for (int lane = 0; lane < LANES; lane++) {
        detail->x += total.x[lane];
        detail->y += total.y[lane];
        detail->mixed += total.mixed[lane];
        detail->count += (uint64_t)total.count[lane];
    }
}

void fbm_detail_add(const float *heights, size_t width, size_t height, size_t x0, size_t y0, size_t x1, size_t y1,
                    float *scratch, fbm_detail octaves[2])
{
    const size_t box[4] = {x0, y0, x1, y1};
    float *means = scratch, *means_of_means = scratch + width * height, *slopes = scratch + 2 * width * height;
    block_means(heights, width, height, 1, means);
    add_octave(heights, means, width, height, 1, box, slopes, &octaves[0]);
    if (width < 2 || height < 2)
        return;
    /* what block_means leaves unset at the rim must not look like heights */
    for (size_t y = 0; y < height; y++)
        means[y * width + width - 1] = NAN;
    for (size_t x = 0; x < width; x++)
        means[(height - 1) * width + x] = NAN;
    block_means(means, width, height, 2, means_of_means);
    add_octave(means, means_of_means, width, height, 2, box, slopes, &octaves[1]);
}

double fbm_detail_variance(const fbm_detail *detail, int octave, double noise)
{
    if (!detail->count)
        return 0;
    double raw = (detail->x + detail->y + detail->mixed) / (double)detail->count;
    double share = noise * noise_share() * (octave ? 0.25 : 1); /* a mean of four has a quarter of the noise */
    return raw - share > 0.25 * raw ? raw - share : 0.25 * raw;
}

/* ---- the same for fBm ---- */

enum { WIDE = 2 * (2 * REACH + 1), CELL_STEPS = 16 };

/* One-dimensional stencils over the WIDE children about a block, whose own are at 2 REACH and 2 REACH + 1. */
typedef struct stencils {
    double mean[WIDE];  /* the block's mean */
    double haar[WIDE];  /* half the difference of its children */
    double slope[WIDE]; /* the predicted half difference */
} stencils;

static stencils make_stencils(void)
{
    stencils s;
    memset(&s, 0, sizeof s);
    const int own = 2 * REACH;
    s.mean[own] = s.mean[own + 1] = 0.5;
    s.haar[own] = -0.5;
    s.haar[own + 1] = 0.5;
    for (int k = 1; k <= REACH; k++)
        for (int child = 0; child < 2; child++) {
            s.slope[own + 2 * k + child] += 0.5 * (double)slope_weights[k];
            s.slope[own - 2 * k + child] -= 0.5 * (double)slope_weights[k];
        }
    return s;
}

/* -1/2 E|x - y|^(2H) for two children at a lag in children's cells, in units of the parents' distance. A child is the
 * mean of points x points evenly spaced ones; 0: of its whole cell, by the midpoint rule. Differences of two members of
 * such a lattice have triangular weights. */
static double covariance(int i, int j, double hurst, int points)
{
    int n = points ? points : CELL_STEPS / 2;
    double sum = 0, weight = 0, shift = points ? 0 : 0.5;
    for (int a = points ? 1 - n : -n; a < n; a++)
        for (int b = points ? 1 - n : -n; b < n; b++) {
            double u = (a + shift) / n, v = (b + shift) / n;
            double w = (1 - fabs(u)) * (1 - fabs(v));
            sum += w * fbm_pow(0.25 * ((i + u) * (i + u) + (j + v) * (j + v)), hurst);
            weight += w;
        }
    return -0.5 * sum / weight;
}

/* Variance of the detail with row stencil `fx` and column stencil `fy`, minus the prediction of the same kind. */
static double detail_variance(const double covariances[WIDE][WIDE], const double haar_x[WIDE],
                              const double haar_y[WIDE], const double slope_x[WIDE], const double slope_y[WIDE])
{
    double weights[WIDE][WIDE], sum = 0;
    for (int y = 0; y < WIDE; y++)
        for (int x = 0; x < WIDE; x++)
            weights[y][x] = haar_y[y] * haar_x[x] - slope_y[y] * slope_x[x];
    for (int y = 0; y < WIDE; y++)
        for (int x = 0; x < WIDE; x++)
            for (int v = 0; v < WIDE; v++)
                for (int u = 0; u < WIDE; u++)
                    sum += weights[y][x] * weights[v][u] * covariances[abs(y - v)][abs(x - u)];
    return sum;
}

double fbm_detail_of_means(double hurst, int points)
{
    double covariances[WIDE][WIDE];
    for (int j = 0; j < WIDE; j++)
        for (int i = j; i < WIDE; i++)
            covariances[j][i] = covariances[i][j] = covariance(i, j, hurst, points);
    const stencils s = make_stencils();
    /* x and y alike; the mixed detail's prediction is the product of the slopes */
    return 2 * detail_variance(covariances, s.haar, s.mean, s.slope, s.mean) +
           detail_variance(covariances, s.haar, s.haar, s.slope, s.slope);
}

double fbm_detail_of_fbm(double hurst, bool area)
{
    return fbm_detail_of_means(hurst, area ? 0 : 1);
}
