#include "fbm/likeness.h"

#include <kiss_fft.h>

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { BANDS = 12, QUANTILES = 2001, DIRECTIONS = 4 };

/* The part of a surface that is looked at. */
typedef struct view {
    const float *z;
    size_t width, height, stride;
} view;

static double structure(const view *v, size_t h, int direction)
{
    size_t dx = direction == 1 ? 0 : h, dy = direction == 0 ? 0 : h;
    double sum = 0;
    for (size_t y = 0; y + dy < v->height; y++) {
        const float *a = v->z + y * v->stride, *b = a + dy * v->stride;
        for (size_t x = 0; x + dx < v->width; x++) {
            /* the fourth direction runs up to the right */
            double d = direction == 3 ? (double)b[x] - (double)a[x + dx] : (double)b[x + dx] - (double)a[x];
            sum += d * d;
        }
    }
    return sum / ((double)(v->width - dx) * (double)(v->height - dy));
}

static double compare_structure(const view *candidate, const view *truth, int factor)
{
    double worst = 0;
    for (size_t h = 1; h <= 2 * (size_t)factor; h *= 2)
        for (int d = 0; d < DIRECTIONS; d++) {
            double ratio = fabs(log(structure(candidate, h, d) / structure(truth, h, d)));
            worst = ratio > worst ? ratio : worst;
        }
    return worst;
}

/* Slopes of the plane through a square, by least squares about its middle. */
static void plane_of(const view *v, size_t n, double plane[3])
{
    double sum = 0, sum_x = 0, sum_y = 0, square = 0;
    for (size_t k = 0; k < n; k++) {
        double t = (double)k - .5 * (double)(n - 1);
        square += t * t;
    }
    for (size_t y = 0; y < n; y++)
        for (size_t x = 0; x < n; x++) {
            double z = (double)v->z[y * v->stride + x];
            sum += z;
            sum_x += z * ((double)x - .5 * (double)(n - 1));
            sum_y += z * ((double)y - .5 * (double)(n - 1));
        }
    plane[0] = sum / ((double)n * (double)n);
    plane[1] = sum_x / (square * (double)n);
    plane[2] = sum_y / (square * (double)n);
}

static double hann(size_t k, size_t n)
{
    const double pi = 3.14159265358979323846;
    return .5 - .5 * cos(2 * pi * (double)k / (double)n);
}

static void window_square(const view *v, size_t n, kiss_fft_cpx *out)
{
    double plane[3];
    plane_of(v, n, plane);
    for (size_t y = 0; y < n; y++)
        for (size_t x = 0; x < n; x++) {
            double at_x = (double)x - .5 * (double)(n - 1), at_y = (double)y - .5 * (double)(n - 1);
            double z = (double)v->z[y * v->stride + x] - (plane[0] + plane[1] * at_x + plane[2] * at_y);
            out[y * n + x] = (kiss_fft_cpx){(float)(z * hann(x, n) * hann(y, n)), 0};
        }
}

/* In place, rows then columns; `line` has room for 2 n. */
static void transform(kiss_fft_cfg plan, kiss_fft_cpx *square, size_t n, kiss_fft_cpx *line)
{
    for (size_t y = 0; y < n; y++) {
        kiss_fft(plan, square + y * n, line);
        memcpy(square + y * n, line, n * sizeof *line);
    }
    for (size_t x = 0; x < n; x++) {
        for (size_t y = 0; y < n; y++)
            line[y] = square[y * n + x];
        kiss_fft(plan, line, line + n);
        for (size_t y = 0; y < n; y++)
            square[y * n + x] = line[n + y];
    }
}

/* Mean power in each band. */
static bool powers(const view *v, int factor, double out[BANDS])
{
    size_t n = v->width < v->height ? v->width : v->height, counts[BANDS] = {0};
    kiss_fft_cpx *square = malloc(n * n * sizeof *square), *line = malloc(2 * n * sizeof *line);
    kiss_fft_cfg plan = kiss_fft_alloc((int)n, 0, NULL, NULL);
    bool good = square && line && plan;
    memset(out, 0, BANDS * sizeof *out);
    if (good) {
        window_square(v, n, square);
        transform(plan, square, n, line);
    }
    for (size_t k = 0; good && k < n * n; k++) {
        double x = (double)(k % n < (n + 1) / 2 ? k % n : n - k % n) / (double)n;
        double y = (double)(k / n < (n + 1) / 2 ? k / n : n - k / n) / (double)n;
        double band = log(hypot(x, y) * 2 * factor) / log((double)factor) * BANDS;
        if (!(band >= 0) || band >= BANDS)
            continue;
        double re = (double)square[k].r, im = (double)square[k].i;
        out[(int)band] += re * re + im * im;
        counts[(int)band]++;
    }
    for (int b = 0; b < BANDS; b++)
        out[b] = counts[b] ? out[b] / (double)counts[b] : 0;
    free(square);
    free(line);
    kiss_fft_free(plan);
    return good;
}

static bool compare_spectrum(const view *candidate, const view *truth, int factor, double *out)
{
    double a[BANDS], b[BANDS], sum = 0;
    int count = 0;
    if (!powers(candidate, factor, a) || !powers(truth, factor, b))
        return false;
    for (int k = 0; k < BANDS; k++)
        if (a[k] > 0 && b[k] > 0) {
            double ratio = log10(a[k] / b[k]);
            sum += ratio * ratio;
            count++;
        }
    *out = count ? sqrt(sum / count) : 0;
    return true;
}

static int ascending(const void *a, const void *b)
{
    float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

/* Slopes of all inner samples in degrees, sorted. */
static float *slopes(const view *v, double cell_x, double cell_y, size_t *count)
{
    const double degrees = 57.29577951308232;
    float *out = malloc(v->width * v->height * sizeof *out);
    *count = 0;
    for (size_t y = 1; out && y + 1 < v->height; y++)
        for (size_t x = 1; x + 1 < v->width; x++) {
            const float *z = v->z + y * v->stride + x;
            double gx = ((double)z[1] - (double)z[-1]) / (2 * cell_x);
            double gy = ((double)z[v->stride] - (double)(z - v->stride)[0]) / (2 * cell_y);
            out[(*count)++] = (float)(degrees * atan(hypot(gx, gy)));
        }
    if (out)
        qsort(out, *count, sizeof *out, ascending);
    return out;
}

static bool compare_slopes(const view *candidate, const view *truth, double cell_x, double cell_y, double *out)
{
    size_t n, m;
    float *a = slopes(candidate, cell_x, cell_y, &n), *b = slopes(truth, cell_x, cell_y, &m);
    double sum = 0;
    for (int q = 0; a && b && q < QUANTILES; q++)
        sum +=
            fabs((double)a[(size_t)q * (n - 1) / (QUANTILES - 1)] - (double)b[(size_t)q * (m - 1) / (QUANTILES - 1)]);
    *out = sum / QUANTILES;
    bool good = a && b;
    free(a);
    free(b);
    return good;
}

static double compare_heights(const view *candidate, const view *truth)
{
    double sum = 0;
    for (size_t y = 0; y < truth->height; y++)
        for (size_t x = 0; x < truth->width; x++) {
            double d = (double)candidate->z[y * truth->stride + x] - (double)truth->z[y * truth->stride + x];
            sum += d * d;
        }
    return sqrt(sum / ((double)truth->width * (double)truth->height));
}

bool fbm_likeness_measure(const float *candidate, const float *truth, size_t width, size_t height, int factor,
                          double cell_x, double cell_y, fbm_likeness *out)
{
    size_t frame = 2 * (size_t)factor;
    if (width < 4 * frame || height < 4 * frame || width > 1 << 14 || height > 1 << 14)
        return false;
    view a = {candidate + frame * width + frame, width - 2 * frame, height - 2 * frame, width}, b = a;
    b.z = truth + frame * width + frame;
    out->structure = compare_structure(&a, &b, factor);
    out->rms = compare_heights(&a, &b);
    return compare_spectrum(&a, &b, factor, &out->spectrum) && compare_slopes(&a, &b, cell_x, cell_y, &out->slope);
}
