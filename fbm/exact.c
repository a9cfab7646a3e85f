#include "fbm/exact.h"

#include "fbm/elementary.h"

#include "fbm/rng.h"
#include "fbm/weights.h"

#include <kiss_fft.h>

#include <assert.h>
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

/* Stein's intrinsic embedding. Lengths are in units of `radius`, the grid's diagonal. The stationary field with the
 * covariance
 *   rho(r) = c0 - r^a + c2 r^2            for r <= 1,
 *            b (R - r)^3 / r              for 1 <= r <= R, 0 beyond
 * has the variogram r^a - c2 r^2 within the grid; a random plane with slopes of variance 2 c2 adds the rest. */
typedef struct embedding {
    size_t size;   /* samples on a side of the output */
    size_t period; /* samples on a side of the torus, even and 5-smooth */
    double aspect; /* distance of columns, rows being at distance 1 */
    double radius; /* rows */
    double hurst;  /* a = 2 H */
    double reach;  /* R */
    double b, c0, c2;
} embedding;

/* The least even number >= n that has no prime factor above 5. */
static size_t smooth_even(size_t n)
{
    for (n += n & 1;; n += 2) {
        size_t rest = n;
        while (rest % 2 == 0)
            rest /= 2;
        while (rest % 3 == 0)
            rest /= 3;
        while (rest % 5 == 0)
            rest /= 5;
        if (rest == 1)
            return n;
    }
}

static embedding plan(size_t size, double aspect, double hurst)
{
    embedding e = {.size = size, .aspect = aspect, .hurst = hurst, .reach = 1};
    double a = 2 * hurst;
    e.radius = (double)(size - 1) * sqrt(1 + aspect * aspect);
    e.c2 = hurst;
    e.c0 = 1 - hurst;
    if (a > 1.5) { /* R = 1 has negative eigenvalues there */
        double R = e.reach = 2;
        e.b = a * (2 - a) / (3 * R * (R * R - 1));
        e.c2 = (a - e.b * (R - 1) * (R - 1) * (R + 2)) / 2;
        e.c0 = e.b * (R - 1) * (R - 1) * (R - 1) + 1 - e.c2;
    }
    e.period = smooth_even(2 * ((size_t)ceil(e.radius * e.reach / fmin(aspect, 1)) + 1));
    return e;
}

static double covariance(const embedding *e, double r)
{
    if (r <= 1)
        return e->c0 - fbm_pow(r, 2 * e->hurst) + e->c2 * r * r;
    if (r < e->reach)
        return e->b * (e->reach - r) * (e->reach - r) * (e->reach - r) / r;
    return 0;
}

/* ---- Spectrum, in double ----------------------------------------------------------------------- */

/* Eigenvalues fall off as k^(-2 - 2H), over 12 decades for large smooth fields, so that a single-precision transform
 * would bury the finest scales in its rounding error. */

typedef struct complex_double {
    double re, im;
} complex_double;

static size_t smallest_factor(size_t n)
{
    return n % 2 == 0 ? 2 : n % 3 == 0 ? 3 : n % 5 == 0 ? 5 : n;
}

/* out[k] = sum over x of in[x stride] exp(-2 pi i k x / n), by decimation in time; roots[k] = exp(-2 pi i k / period),
 * period = n * root_stride. */
static void transform(const complex_double *in, complex_double *out, size_t n, size_t stride,
                      const complex_double *roots, size_t root_stride)
{
    if (n == 1) {
        *out = *in;
        return;
    }
    size_t p = smallest_factor(n), m = n / p;
    assert(p <= 5);
    for (size_t r = 0; r < p; r++)
        transform(in + r * stride, out + r * m, m, stride * p, roots, root_stride * p);
    for (size_t k = 0; k < m; k++) {
        complex_double parts[5];
        for (size_t r = 0; r < p; r++)
            parts[r] = out[r * m + k];
        for (size_t q = 0; q < p; q++) {
            complex_double sum = parts[0];
            size_t turn = k + q * m, root = 0; /* root = turn * r mod n */
            for (size_t r = 1; r < p; r++) {
                root = root + turn < n ? root + turn : root + turn - n;
                complex_double w = roots[root * root_stride];
                sum.re += parts[r].re * w.re - parts[r].im * w.im;
                sum.im += parts[r].re * w.im + parts[r].im * w.re;
            }
            out[q * m + k] = sum;
        }
    }
}

static void make_roots(complex_double *roots, size_t n)
{
    for (size_t k = 0; k < n; k++) {
        fbm_turn(k, n, &roots[k].re, &roots[k].im);
        roots[k].im = -roots[k].im;
    }
}

/* Transforms two even real sequences of `half` + 1 values each, `step` apart, in place: as real and imaginary part of
 * one complex sequence, for the transform of an even real sequence is real. */
static void transform_pair(double *a, double *b, size_t half, size_t step, const complex_double *roots,
                           complex_double *work)
{
    size_t n = 2 * half;
    complex_double *spread = work, *result = work + n;
    for (size_t k = 0; k <= half; k++)
        spread[k] = spread[(n - k) % n] = (complex_double){a[k * step], b[k * step]};
    transform(spread, result, n, 1, roots, 1);
    for (size_t k = 0; k <= half; k++) {
        a[k * step] = result[k].re;
        b[k * step] = result[k].im;
    }
}

/* Square roots of the torus's eigenvalues over its size, for frequencies 0 ... period / 2 in both directions. work: 3
 * periods of complex numbers. */
static void make_spectrum(const embedding *e, double *s, complex_double *work)
{
    size_t half = e->period / 2, side = half + 1;
    double scale = e->radius > 0 ? 1 / e->radius : 0;
    for (size_t y = 0; y <= half; y++)
        for (size_t x = 0; x <= half; x++) {
            double dx = (double)x * e->aspect, dy = (double)y;
            s[y * side + x] = covariance(e, sqrt(dx * dx + dy * dy) * scale);
        }
    complex_double *roots = work + 2 * e->period;
    make_roots(roots, e->period);
    /* of an odd last row or column both halves of the pair are the same, and get the same result */
    for (size_t y = 0; y <= half; y += 2)
        transform_pair(s + y * side, s + (y < half ? y + 1 : y) * side, half, 1, roots, work);
    for (size_t x = 0; x <= half; x += 2)
        transform_pair(s + x, s + (x < half ? x + 1 : x), half, side, roots, work);
    for (size_t k = 0; k < side * side; k++)
        s[k] = s[k] > 0 ? sqrt(s[k]) / (double)e->period : 0;
}

/* ---- Field ------------------------------------------------------------------------------------- */

/* Columns that are transformed at a time: reading one column at a time would touch a cache line for every value. */
enum { BLOCK = 16 };

typedef struct workspace {
    double *spectrum;       /* (period / 2 + 1)^2 */
    complex_double *work;   /* 3 * period */
    kiss_fft_cpx *rows;     /* period rows of the `size` columns that are kept */
    kiss_fft_cpx *line;     /* BLOCK + 1 lines of a period */
    float *noise;           /* 2 * period */
    kiss_fft_cfg transform; /* of one period */
} workspace;

/* Row `y` of the torus's random spectrum, transformed along x; the first `size` values are kept. */
static void make_row(const embedding *e, const workspace *ws, uint64_t seed, size_t y)
{
    size_t n = e->period, half = n / 2;
    const double *s = ws->spectrum + (y <= half ? y : n - y) * (half + 1);
    kiss_fft_cpx *row = ws->line, *result = ws->line + n;
    fbm_noise_row(seed, 0, FBM_NOISE_SPECTRUM, (int64_t)y, 0, 2 * n, ws->noise);
    for (size_t x = 0; x < n; x++) {
        double amplitude = s[x <= half ? x : n - x];
        row[x].r = (float)(amplitude * (double)ws->noise[2 * x]);
        row[x].i = (float)(amplitude * (double)ws->noise[2 * x + 1]);
    }
    kiss_fft(ws->transform, row, result);
    memcpy(ws->rows + y * e->size, result, e->size * sizeof *result);
}

/* Columns x ... x + count - 1 of the stationary field. */
static void make_columns(const embedding *e, const workspace *ws, size_t x, size_t count, float *out)
{
    size_t n = e->period;
    kiss_fft_cpx *result = ws->line + BLOCK * n;
    for (size_t y = 0; y < n; y++)
        for (size_t k = 0; k < count; k++)
            ws->line[k * n + y] = ws->rows[y * e->size + x + k];
    for (size_t k = 0; k < count; k++) {
        kiss_fft(ws->transform, ws->line + k * n, result);
        for (size_t y = 0; y < e->size; y++)
            out[y * e->size + x + k] = result[y].r;
    }
}

/* Adds the plane, brings the variogram r^a (r in radii) to delta^2 h^a / 2 (h in samples) and puts 0 at the first
 * sample. */
static void finish_field(const embedding *e, double delta, uint64_t seed, float *out)
{
    float slopes[2];
    fbm_noise_row(seed, 0, FBM_NOISE_PLANE, 0, 0, 2, slopes);
    double plane = e->radius > 0 ? sqrt(2 * e->c2) / e->radius : 0;
    double scale = delta * fbm_pow(e->radius, e->hurst) / sqrt(2), first = (double)out[0];
    for (size_t y = 0; y < e->size; y++)
        for (size_t x = 0; x < e->size; x++) {
            double tilt = plane * ((double)x * e->aspect * (double)slopes[0] + (double)y * (double)slopes[1]);
            float *z = out + y * e->size + x;
            *z = (float)(((double)*z - first + tilt) * scale);
        }
}

static bool product(size_t a, size_t b, size_t *result)
{
    *result = a * b;
    return !b || a <= SIZE_MAX / b;
}

/* Bytes of each part of the workspace in the order of its members; false where they cannot be addressed. */
static bool workspace_bytes(const embedding *e, size_t bytes[6])
{
    size_t n = e->period, side = n / 2 + 1, count;
    bool good = product(side, side, &count) && product(count, sizeof(double), &bytes[0]);
    good = good && product(3 * n, sizeof(complex_double), &bytes[1]);
    good = good && product(n, e->size, &count) && product(count, sizeof(kiss_fft_cpx), &bytes[2]);
    good = good && product((BLOCK + 1) * n, sizeof(kiss_fft_cpx), &bytes[3]);
    good = good && product(2 * n, sizeof(float), &bytes[4]);
    bytes[5] = 0;
    kiss_fft_alloc((int)n, 0, NULL, &bytes[5]);
    return good;
}

static size_t memory(const embedding *e)
{
    size_t bytes[6], sum = 0;
    if (e->size < 1 || e->size > FBM_EXACT_SIZE_MAX)
        return 0;
    if (!workspace_bytes(e, bytes))
        return 0;
    for (int k = 0; k < 6; k++) {
        if (bytes[k] > SIZE_MAX - sum)
            return 0;
        sum += bytes[k];
    }
    return sum;
}

size_t fbm_exact_memory(size_t size, double aspect, double hurst)
{
    embedding e = plan(size, aspect, fbm_hurst_clamp(hurst));
    return memory(&e);
}

static bool allocate(const embedding *e, workspace *ws)
{
    size_t bytes[6];
    workspace_bytes(e, bytes);
    ws->spectrum = malloc(bytes[0]);
    ws->work = malloc(bytes[1]);
    ws->rows = malloc(bytes[2]);
    ws->line = malloc(bytes[3]);
    ws->noise = malloc(bytes[4]);
    ws->transform = kiss_fft_alloc((int)e->period, 0, NULL, NULL);
    return ws->spectrum && ws->work && ws->rows && ws->line && ws->noise && ws->transform;
}

static void release(workspace *ws)
{
    free(ws->spectrum);
    free(ws->work);
    free(ws->rows);
    free(ws->line);
    free(ws->noise);
    free(ws->transform);
}

fbm_status fbm_exact(size_t size, double hurst, double delta, uint64_t seed, float *out)
{
    return fbm_exact_cells(size, 1, hurst, delta, seed, out);
}

fbm_status fbm_exact_cells(size_t size, double aspect, double hurst, double delta, uint64_t seed, float *out)
{
    embedding e = plan(size, aspect, fbm_hurst_clamp(hurst));
    if (!memory(&e))
        return FBM_TOO_LARGE;
    workspace ws = {NULL};
    if (!allocate(&e, &ws)) {
        release(&ws);
        return FBM_NO_MEMORY;
    }
    make_spectrum(&e, ws.spectrum, ws.work);
    for (size_t y = 0; y < e.period; y++)
        make_row(&e, &ws, seed, y);
    for (size_t x = 0; x < size; x += BLOCK)
        make_columns(&e, &ws, x, size - x < BLOCK ? size - x : BLOCK, out);
    finish_field(&e, delta, seed, out);
    release(&ws);
    return FBM_OK;
}
