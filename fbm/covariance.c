#include "fbm/covariance.h"

#include "fbm/kernel.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { LEVELS = 6, CELLS = 8, SIDE = 129, DIRECTIONS = 8, HALVINGS = 2, STAGES = LEVELS + HALVINGS };

static const int directions[DIRECTIONS][2] = {{1, 0}, {0, 1}, {1, 1}, {1, -1}, {2, 1}, {2, -1}, {1, 2}, {1, -2}};

typedef struct analysis {
    fbm_kernel kernel; /* whose noise is one impulse */
    fbm_step step;
    const fbm_refinement *refinement;
    int levels, stages;            /* stages: halvings of the rows, then levels */
    fbm_window window[STAGES + 1]; /* before every stage; the last is the window looked at */
    float *heights[STAGES + 1];
    float *scratch;
    int width, height, lags; /* samples of the last window; lags looked at */
    size_t inputs;           /* samples of the first window */
    double *responses;       /* [samples][inputs]: of a sample to each input */
    double *products;        /* the same times the covariance of the inputs */
    double *variances;       /* [direction][lag - 1][samples]: of the increment that starts there */
} analysis;

/* ---- Impulses ---------------------------------------------------------------------------------- */

/* Noise that is 1 at one point and 0 elsewhere. The point travels in the seed: kind, row and column + 2^20. */
enum { BIAS = 1 << 20 };

static uint64_t impulse_seed(fbm_noise_kind kind, int64_t row, int64_t column)
{
    return (uint64_t)kind << 60 | (uint64_t)(row + BIAS) << 30 | (uint64_t)(column + BIAS);
}

static void impulse_noise(uint64_t seed, int32_t level, fbm_noise_kind kind, int64_t row, int64_t first, size_t count,
                          float *out)
{
    (void)level;
    memset(out, 0, count * sizeof *out);
    int64_t column = (int64_t)(seed & 0x3fffffff) - BIAS;
    bool here = kind == (fbm_noise_kind)(seed >> 60) && row == (int64_t)(seed >> 30 & 0x3fffffff) - BIAS;
    if (here && column >= first && column - first < (int64_t)count)
        out[column - first] = 1;
}

/* Refines from stage `first` to the last; the noise impulse, if any, is in that first one. */
static void run(analysis *a, int first, float amplitude, uint64_t seed)
{
    for (int s = first; s < a->stages; s++, amplitude = 0) {
        const float *in = a->heights[s];
        float *out = a->heights[s + 1];
        if (s < a->refinement->halvings) {
            fbm_row_step step = {.weights = a->refinement->rows[s], .amplitude = amplitude, .seed = seed};
            fbm_refine_rows_by(&a->kernel, &step, in, NULL, a->window[s], out, a->window[s + 1], a->scratch);
            continue;
        }
        a->step.seed = seed;
        a->step.amplitude = amplitude;
        fbm_refine_by(&a->kernel, &a->step, in, NULL, a->window[s], out, a->window[s + 1], a->scratch);
    }
}

static size_t samples(fbm_window window)
{
    return window.width * window.height;
}

static void clear(analysis *a, int stage)
{
    memset(a->heights[stage], 0, samples(a->window[stage]) * sizeof(float));
}

/* ---- Inputs ------------------------------------------------------------------------------------ */

static void input_responses(analysis *a)
{
    size_t points = samples(a->window[a->stages]);
    const float *last = a->heights[a->stages];
    clear(a, 0);
    for (size_t k = 0; k < a->inputs; k++) {
        a->heights[0][k] = 1;
        run(a, 0, 0, 0);
        for (size_t p = 0; p < points; p++)
            a->responses[p * a->inputs + k] = (double)last[p];
        a->heights[0][k] = 0;
    }
    /* The covariance below holds for contrasts only, and grows with distance: what float leaves of the sum of the
     * responses beyond 1 would count as a contrast with something far away. */
    for (size_t p = 0; p < points; p++) {
        double *row = a->responses + p * a->inputs, sum = 0;
        for (size_t k = 0; k < a->inputs; k++)
            sum += row[k];
        for (size_t k = 0; k < a->inputs; k++)
            row[k] /= sum;
    }
}

/* Generalised covariance -|h|^(2H) / 2 of vertices k and m of level 0. */
static double covariance(const analysis *a, size_t k, size_t m)
{
    size_t width = a->window[0].width;
    double dx = (double)(k % width) - (double)(m % width), dy = (double)(k / width) - (double)(m / width);
    dx *= a->refinement->aspect;
    double square = dx * dx + dy * dy;
    return square > 0 ? -0.5 * pow(square, a->refinement->hurst) : 0;
}

static bool multiply_covariance(analysis *a)
{
    size_t n = a->inputs, points = samples(a->window[a->stages]);
    double *matrix = malloc(n * n * sizeof *matrix);
    if (!matrix)
        return false;
    for (size_t k = 0; k < n; k++)
        for (size_t m = 0; m < n; m++)
            matrix[k * n + m] = covariance(a, k, m);
    memset(a->products, 0, points * n * sizeof *a->products);
    for (size_t p = 0; p < points; p++)
        for (size_t k = 0; k < n; k++) {
            double response = a->responses[p * n + k], *product = a->products + p * n;
            for (size_t m = 0; response != 0 && m < n; m++)
                product[m] += response * matrix[k * n + m];
        }
    free(matrix);
    return true;
}

/* ---- Increments -------------------------------------------------------------------------------- */

typedef struct box {
    int x0, y0, x1, y1; /* inclusive */
} box;

static int least(int a, int b)
{
    return a < b ? a : b;
}

static int most(int a, int b)
{
    return a > b ? a : b;
}

/* Calls visit(a, offset in the variances, p, q) for every increment from p to q of which an end may lie in `in`. */
static void each_increment(analysis *a, box in, void (*visit)(analysis *, size_t, size_t, size_t))
{
    int n = a->width, m = a->height;
    for (int d = 0; d < DIRECTIONS; d++)
        for (int lag = 1; lag <= a->lags; lag++) {
            int dx = lag * directions[d][0], dy = lag * directions[d][1];
            size_t base = (size_t)(d * a->lags + lag - 1) * (size_t)n * (size_t)m;
            int y0 = most(most(0, -dy), least(in.y0, in.y0 - dy)),
                y1 = least(m - 1 - most(0, dy), most(in.y1, in.y1 - dy));
            int x0 = most(0, in.x0 - dx), x1 = least(n - 1 - dx, in.x1);
            for (int y = y0; y <= y1; y++)
                for (int x = x0; x <= x1; x++) {
                    size_t p = (size_t)y * (size_t)n + (size_t)x;
                    visit(a, base + p, p, (size_t)((y + dy) * n + x + dx));
                }
        }
}

static void add_input_variance(analysis *a, size_t at, size_t p, size_t q)
{
    size_t n = a->inputs;
    const double *rp = a->responses + p * n, *rq = a->responses + q * n;
    const double *cp = a->products + p * n, *cq = a->products + q * n;
    double sum = 0;
    for (size_t k = 0; k < n; k++)
        sum += (rp[k] - rq[k]) * (cp[k] - cq[k]);
    a->variances[at] += sum;
}

static void add_noise_variance(analysis *a, size_t at, size_t p, size_t q)
{
    const float *last = a->heights[a->stages];
    double contrast = (double)last[p] - (double)last[q];
    a->variances[at] += contrast * contrast;
}

/* The box of the samples that are not 0; false where all are. */
static bool bounds(const analysis *a, box *out)
{
    const float *last = a->heights[a->stages];
    *out = (box){a->width, a->height, -1, -1};
    for (int y = 0; y < a->height; y++)
        for (int x = 0; x < a->width; x++)
            if (last[y * a->width + x] != 0)
                *out = (box){least(out->x0, x), least(out->y0, y), most(out->x1, x), most(out->y1, y)};
    return out->x1 >= 0;
}

/* Every noise value of one stage that may be seen; those beyond give no response. Of some kinds there are several in a
 * column or row of the lattice. */
static void add_noise_kind(analysis *a, int stage, fbm_noise_kind kind, int across, int down)
{
    fbm_window w = a->window[stage];
    float amplitude = (float)pow(2, -stage * a->refinement->hurst); /* every stage begins with rows half as far apart */
    clear(a, stage);
    for (int64_t j = down * (w.j - 1); j < down * (w.j + (int64_t)w.height); j++)
        for (int64_t i = across * (w.i - 1); i < across * (w.i + (int64_t)w.width); i++) {
            box seen;
            run(a, stage, amplitude, impulse_seed(kind, j, i));
            if (bounds(a, &seen))
                each_increment(a, seen, add_noise_variance);
        }
}

static void add_noise(analysis *a, int stage)
{
    const fbm_scheme *scheme = a->refinement->scheme;
    if (stage < a->refinement->halvings) {
        add_noise_kind(a, stage, FBM_NOISE_ROWS, 1, 1);
        return;
    }
    if (scheme->cells) {
        add_noise_kind(a, stage, FBM_NOISE_CELLS, 2, 2);
        return;
    }
    for (int kind = FBM_NOISE_CENTRES; kind <= FBM_NOISE_COLUMN_EDGES; kind++)
        add_noise_kind(a, stage, (fbm_noise_kind)kind, 1, 1);
    if (scheme->moves)
        add_noise_kind(a, stage, FBM_NOISE_ADDITIONS, 1, 4);
}
/* ---- Result ------------------------------------------------------------------------------------ */

/* |h|^(2H) of an increment. */
static double theory_of(const analysis *a, int dx, int dy)
{
    double rows = (double)dy / (1 << a->refinement->halvings);
    return pow(hypot(dx * a->refinement->aspect, rows) / (1 << a->levels), 2 * a->refinement->hurst);
}

static void visit_all(const analysis *a, fbm_increment_visit visit, void *context)
{
    size_t points = (size_t)a->width * (size_t)a->height;
    for (int d = 0; d < DIRECTIONS; d++)
        for (int lag = 1; lag <= a->lags; lag++) {
            int dx = lag * directions[d][0], dy = lag * directions[d][1];
            double theory = theory_of(a, dx, dy);
            const double *v = a->variances + (size_t)(d * a->lags + lag - 1) * points;
            for (int y = most(0, -dy); y < a->height - most(0, dy); y++)
                for (int x = 0; x < a->width - dx; x++)
                    visit(context, dx, dy, x, y, v[y * a->width + x] / theory);
        }
}

static void summarise(const analysis *a, fbm_deviation *out)
{
    int n = a->width, m = a->height;
    double lowest = HUGE_VAL, highest = 0;
    *out = (fbm_deviation){.ratio = 1};
    for (int d = 0; d < DIRECTIONS; d++)
        for (int lag = 1; lag <= a->lags; lag++) {
            int dx = lag * directions[d][0], dy = lag * directions[d][1];
            double theory = theory_of(a, dx, dy);
            double low = HUGE_VAL, high = 0, sum = 0;
            const double *v = a->variances + (size_t)(d * a->lags + lag - 1) * (size_t)n * (size_t)m;
            for (int y = most(0, -dy); y < m - most(0, dy); y++)
                for (int x = 0; x < n - dx; x++) {
                    double relative = v[y * n + x] / theory;
                    low = fmin(low, relative);
                    high = fmax(high, relative);
                    sum += relative;
                }
            double mean = sum / ((double)(n - dx) * (m - abs(dy)));
            out->point = fmax(out->point, fmax(fabs(low - 1), fabs(high - 1)));
            out->mean = fmax(out->mean, fabs(mean - 1));
            out->ratio = fmax(out->ratio, high / low);
            lowest = fmin(lowest, mean);
            highest = fmax(highest, mean);
        }
    out->mean_scaled = (highest - lowest) / (highest + lowest);
}

static bool allocate(analysis *a)
{
    size_t points = samples(a->window[a->stages]), scratch = 0;
    bool good = true;
    for (int s = 0; s <= a->stages; s++) {
        size_t width = a->window[s].width;
        a->heights[s] = malloc(samples(a->window[s]) * sizeof(float));
        good = good && a->heights[s];
        scratch = scratch < fbm_rows_scratch(width) ? fbm_rows_scratch(width) : scratch;
        scratch = scratch < fbm_refine_scratch(width) ? fbm_refine_scratch(width) : scratch;
    }
    a->scratch = malloc(scratch * sizeof(float));
    a->responses = malloc(points * a->inputs * sizeof(double));
    a->products = malloc(points * a->inputs * sizeof(double));
    a->variances = calloc(points * DIRECTIONS * (size_t)a->lags, sizeof(double));
    return good && a->scratch && a->responses && a->products && a->variances;
}

static void release(analysis *a)
{
    for (int s = 0; s <= a->stages; s++)
        free(a->heights[s]);
    free(a->scratch);
    free(a->responses);
    free(a->products);
    free(a->variances);
}

static void plan(analysis *a, int cells)
{
    int halvings = a->refinement->halvings;
    a->stages = halvings + a->levels;
    a->width = (cells << a->levels) + 1;
    a->height = (cells << a->stages) + 1;
    a->lags = most(1, (a->width - 1) / 4);
    size_t width = (size_t)a->width;
    a->window[a->stages] = (fbm_window){0, 0, width, (size_t)a->height, width};
    for (int s = a->stages; s > 0; s--)
        a->window[s - 1] =
            s > halvings ? fbm_refine_support(a->step.scheme, a->window[s]) : fbm_rows_support(a->window[s]);
    a->inputs = samples(a->window[0]);
    a->kernel = *fbm_kernels()[0];
    a->kernel.noise = impulse_noise;
}

/* Hands over to `visit`, or summarises to `out` where that is NULL. */
static fbm_status analyse(const fbm_refinement *r, int levels, int cells, fbm_increment_visit visit, void *context,
                          fbm_deviation *out)
{
    if (levels < 1 || levels > LEVELS || cells < 1 || cells > CELLS || r->halvings < 0 || r->halvings > HALVINGS ||
        cells << (levels + r->halvings) >= SIDE)
        return FBM_TOO_LARGE;
    analysis a = {.step = {.scheme = r->scheme, .weights = *r->weights}, .refinement = r, .levels = levels};
    plan(&a, cells);
    bool good = allocate(&a);
    if (good)
        input_responses(&a);
    good = good && multiply_covariance(&a);
    if (good) {
        each_increment(&a, (box){0, 0, a.width - 1, a.height - 1}, add_input_variance);
        for (int s = 0; s < a.stages; s++)
            add_noise(&a, s);
        if (visit)
            visit_all(&a, visit, context);
        else
            summarise(&a, out);
    }
    release(&a);
    return good ? FBM_OK : FBM_NO_MEMORY;
}

fbm_status fbm_refinement_deviation(const fbm_refinement *refinement, int levels, int cells, fbm_deviation *out)
{
    return analyse(refinement, levels, cells, NULL, NULL, out);
}

fbm_status fbm_refinement_increments(const fbm_refinement *refinement, int levels, int cells, fbm_increment_visit visit,
                                     void *context)
{
    return analyse(refinement, levels, cells, visit, context, NULL);
}

fbm_status fbm_structure_deviation(const fbm_scheme *scheme, const fbm_weights *weights, double hurst, int levels,
                                   int cells, fbm_deviation *out)
{
    fbm_refinement r = {.scheme = scheme, .hurst = hurst, .aspect = 1, .weights = weights};
    return fbm_refinement_deviation(&r, levels, cells, out);
}
