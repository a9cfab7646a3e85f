/* What single precision costs a chain of refinements: the same recursion in long double, with the same noise, weights
 * by the table and not rounded. */
#include "fbm/rng.h"
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/scene/chain.h"

#include <math.h>
#include <stdlib.h>

enum { MOST = 64, COLUMNS = 21, ROWS = 17 };

/* Heights of level 0 within +-delta, and at its nodes one of two exponents in turn. */
static double height_at(const tl_precision_options *m, int64_t i, int64_t j)
{
    uint64_t x = ((uint64_t)i * 0x9e3779b97f4a7c15U) ^ ((uint64_t)j * 0xc2b2ae3d27d4eb4fU);
    x = (x ^ x >> 29) * 0xbf58476d1ce4e5b9U;
    return (double)(float)(m->delta * ((double)(x >> 40) / (1 << 23) - 1));
}

static double hurst_at(const tl_precision_options *m, int64_t i, int64_t j)
{
    return (double)(float)m->hurst[(i + j) & 1];
}

static tl_status load(void *context, fbm_window w, float *buffer, float *const planes[SCENE_PLANES], tl_error *error)
{
    (void)error;
    const tl_precision_options *m = context;
    for (size_t y = 0; y < w.height; y++)
        for (size_t x = 0; x < w.width; x++) {
            int64_t i = w.i + (int64_t)x, j = w.j + (int64_t)y;
            buffer[y * w.width + x] = (float)height_at(m, i, j);
            if (planes[SCENE_STRENGTH])
                planes[SCENE_STRENGTH][y * w.width + x] = (float)m->delta;
            if (planes[SCENE_HURST])
                planes[SCENE_HURST][y * w.width + x] = (float)hurst_at(m, i, j);
        }
    return TL_OK;
}

/* ---- The reference --------------------------------------------------------------------------------- */

/* Coefficients of an orbit each: w[0 ... 3], t[0 ... 2] with the amplitude; of edges the taps are less. */
typedef struct coefficients {
    long double w[4], t[3], edge[3];
} coefficients;

static void at_exponent(const tl_precision_options *m, int level, double hurst, coefficients *out)
{
    double v[FBM_WEIGHT_VALUES];
    fbm_values_table(hurst, v);
    long double amplitude = (long double)m->delta * exp2l(-(long double)level * (long double)hurst);
    const int w[4] = {0, 1, 3, 4}, t[3] = {6, 7, 9}, edge[3] = {18, 19, 20};
    for (int k = 0; k < 4; k++)
        out->w[k] = (long double)v[w[k]];
    for (int k = 0; k < 3; k++) {
        out->t[k] = amplitude * (long double)v[t[k]];
        out->edge[k] = amplitude * (long double)v[edge[k]];
    }
}

/* At a vertex of coefficients, (i, j) of level `of`: the exponent is bilinear between the nodes. */
static void at_vertex(const tl_precision_options *m, int level, int of, int64_t i, int64_t j, coefficients *out)
{
    int64_t unit = (int64_t)1 << of, i0 = i >> of, j0 = j >> of;
    double x = (double)(i - i0 * unit) / (double)unit, y = (double)(j - j0 * unit) / (double)unit;
    double above = (1 - x) * hurst_at(m, i0, j0) + x * hurst_at(m, i0 + 1, j0);
    double below = (1 - x) * hurst_at(m, i0, j0 + 1) + x * hurst_at(m, i0 + 1, j0 + 1);
    at_exponent(m, level, (1 - y) * above + y * below, out);
}

/* What `where` is asked for lies in a grid of vertices that is made once a level. */
typedef struct grid {
    int shift;
    int64_t i, j;
    coefficients *vertices; /* MOST * MOST */
} grid;

static void make_grid(const tl_precision_options *m, int level, fbm_window from, grid *g)
{
    g->shift = level < FBM_PLACES_SHIFT ? level : FBM_PLACES_SHIFT;
    g->i = from.i >> g->shift;
    g->j = from.j >> g->shift;
    for (int y = 0; y <= (int)(from.height >> g->shift) + 2; y++)
        for (int x = 0; x <= (int)(from.width >> g->shift) + 2; x++)
            if (m->by_place)
                at_vertex(m, level, level - g->shift, g->i + x, g->j + y, &g->vertices[y * MOST + x]);
            else if (x + y == 0)
                at_exponent(m, level, hurst_at(m, 0, 0), &g->vertices[0]);
            else
                g->vertices[y * MOST + x] = g->vertices[0];
}

/* Bilinear at half cells (i2, j2) of the level's lattice. */
static coefficients where(const grid *g, int64_t i2, int64_t j2)
{
    int64_t x2 = i2 - 2 * g->i * ((int64_t)1 << g->shift), y2 = j2 - 2 * g->j * ((int64_t)1 << g->shift);
    int64_t unit = (int64_t)2 << g->shift, x = x2 / unit, y = y2 / unit;
    long double u = (long double)(x2 % unit) / (long double)unit, v = (long double)(y2 % unit) / (long double)unit;
    const coefficients *at = &g->vertices[y * MOST + x];
    const long double *corners[4] = {at->w, at[1].w, at[MOST].w, at[MOST + 1].w};
    coefficients out;
    long double *to = out.w;
    for (size_t k = 0; k < sizeof out / sizeof(long double); k++)
        to[k] =
            (1 - v) * ((1 - u) * corners[0][k] + u * corners[1][k]) + v * ((1 - u) * corners[2][k] + u * corners[3][k]);
    return out;
}

/* Heights and noise on the lattice of half cells, where any new vertex sees others at the same offsets. */
typedef struct sheet {
    int64_t i, j; /* half cells */
    long double z[2 * MOST][2 * MOST], g[2 * MOST][2 * MOST];
} sheet;

/* Sums of the points at (+-a, +-b) and (+-b, +-a) half cells, each once. */
static long double orbit(long double (*rows)[2 * MOST], int x, int y, int a, int b)
{
    long double sum = 0;
    for (int turn = 0; turn < (a == b ? 1 : 2); turn++)
        for (int s = -1; s <= 1; s += 2)
            for (int t = -1; t <= 1; t += 2) {
                int dx = turn ? s * b : s * a, dy = turn ? t * a : t * b;
                if ((dx || s > 0) && (dy || t > 0))
                    sum += rows[y + dy][x + dx];
            }
    return sum;
}

static void noise_of(sheet *s, uint64_t seed, int level, fbm_window from, fbm_noise_kind kind, int dx, int dy)
{
    float row[MOST];
    for (size_t y = 0; y < from.height; y++) {
        fbm_noise_row(seed, level, kind, from.j + (int64_t)y, from.i, from.width, row);
        for (size_t x = 0; x < from.width; x++)
            s->g[2 * y + (size_t)dy][2 * x + (size_t)dx] = (long double)row[x];
    }
}

/* One level: centres of the cells, then middles of the edges, over the sheet but for its rim. */
static void refine_sheet(sheet *s, const grid *g, uint64_t seed, int level, fbm_window from)
{
    noise_of(s, seed, level, from, FBM_NOISE_CENTRES, 1, 1);
    noise_of(s, seed, level, from, FBM_NOISE_ROW_EDGES, 1, 0);
    noise_of(s, seed, level, from, FBM_NOISE_COLUMN_EDGES, 0, 1);
    const int right = 2 * (int)from.width - 1, below = 2 * (int)from.height - 1;
    for (int y = 5; y < below - 5; y += 2)
        for (int x = 5; x < right - 5; x += 2) {
            coefficients c = where(g, s->i + x, s->j + y);
            s->z[y][x] = c.w[0] * orbit(s->z, x, y, 1, 1) + c.w[1] * orbit(s->z, x, y, 3, 1) +
                         c.w[2] * orbit(s->z, x, y, 3, 3) + c.w[3] * orbit(s->z, x, y, 5, 1) + c.t[0] * s->g[y][x] +
                         c.t[1] * orbit(s->g, x, y, 2, 0) + c.t[2] * orbit(s->g, x, y, 2, 2);
        }
    for (int y = 8; y < below - 7; y++)
        for (int x = 8 + !(y & 1); x < right - 7; x += 2) {
            coefficients c = where(g, s->i + x, s->j + y);
            s->z[y][x] = c.w[0] * orbit(s->z, x, y, 1, 0) + c.w[1] * orbit(s->z, x, y, 2, 1) +
                         c.w[2] * orbit(s->z, x, y, 3, 0) + c.w[3] * orbit(s->z, x, y, 3, 2) + c.edge[0] * s->g[y][x] +
                         c.edge[1] * orbit(s->g, x, y, 1, 1) + c.edge[2] * orbit(s->g, x, y, 2, 0);
        }
}

/* The window of the deepest level, row by row. */
static void reference(const tl_precision_options *m, fbm_window target, sheet *s, sheet *next, grid *g,
                      long double *out)
{
    fbm_window windows[SCENE_LEVEL_MAX + 1];
    windows[m->levels] = target;
    for (int l = m->levels; l > 0; l--)
        windows[l - 1] = fbm_refine_support(fbm_schemes, windows[l]);
    for (size_t y = 0; y < windows[0].height; y++)
        for (size_t x = 0; x < windows[0].width; x++)
            s->z[2 * y][2 * x] = (long double)height_at(m, windows[0].i + (int64_t)x, windows[0].j + (int64_t)y);
    for (int l = 0; l < m->levels; l++) {
        s->i = 2 * windows[l].i;
        s->j = 2 * windows[l].j;
        make_grid(m, l, windows[l], g);
        refine_sheet(s, g, m->seed, l, windows[l]);
        const fbm_window *to = &windows[l + 1];
        for (size_t y = 0; y < to->height; y++)
            for (size_t x = 0; x < to->width; x++)
                next->z[2 * y][2 * x] = s->z[to->j - s->j + (int64_t)y][to->i - s->i + (int64_t)x];
        sheet *swap = s;
        s = next;
        next = swap;
    }
    for (size_t y = 0; y < target.height; y++)
        for (size_t x = 0; x < target.width; x++)
            out[y * target.width + x] = s->z[2 * y][2 * x];
}

static tl_status run_reference(const tl_precision_options *m, fbm_window target, long double *out, tl_error *error)
{
    sheet *sheets = calloc(2, sizeof *sheets);
    grid g = {.vertices = calloc((size_t)MOST * MOST, sizeof *g.vertices)};
    tl_status status = TL_OK;
    if (sheets && g.vertices)
        reference(m, target, &sheets[0], &sheets[1], &g, out);
    else
        status = tl_fail_memory(error, "precision");
    free(sheets);
    free(g.vertices);
    return status;
}

/* ---- The chain ------------------------------------------------------------------------------------- */

static tl_status run_chain(const tl_precision_options *m, fbm_window window, float *out, tl_error *error)
{
    double hursts[SCENE_LEVEL_MAX + 1];
    scene_chain chain = {.mapped = false};
    for (int l = 0; l <= SCENE_LEVEL_MAX; l++) {
        hursts[l] = hurst_at(m, 0, 0);
        chain.steps[l] = (fbm_step){
            .scheme = fbm_schemes, .seed = m->seed, .level = l, .amplitude = (float)(m->delta * exp2(-l * hursts[l]))};
    }
    scene_chain_fit_aspect(&chain, 1, hursts, SCENE_LEVEL_MAX);
    tl_status status = m->by_place ? scene_chain_fit_places(&chain, "precision", error) : TL_OK;
    scene_chain_target target = {.level = m->levels, .window = window, .out = out};
    if (status == TL_OK)
        status = scene_chain_run(&chain, &target, load, (void *)m, "precision", error);
    scene_chain_finish(&chain);
    return status;
}

static bool are_good(const tl_precision_options *m)
{
    const int64_t most = INT64_C(1) << 60;
    bool exponents = m->hurst[0] >= 0.01 && m->hurst[0] <= 0.99 && m->hurst[1] >= 0.01 && m->hurst[1] <= 0.99 &&
                     (m->by_place || m->hurst[0] == m->hurst[1]);
    return exponents && m->levels >= 0 && m->levels <= SCENE_LEVEL_MAX && m->delta >= 0 && m->delta <= 1e30 &&
           m->column >= -most && m->column <= most && m->row >= -most && m->row <= most;
}

tl_status tl_precision_measure(const tl_precision_options *options, tl_precision *out, tl_error *error)
{
    *out = (tl_precision){.samples = 0};
    if (!are_good(options))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "precision: levels must be 0 ... 30, exponents 0.01 ... 0.99 (two only by place), delta 0 ... "
                       "1e30, columns and rows within 2^60");
    fbm_window window = {options->column, options->row, COLUMNS, ROWS, COLUMNS};
    float found[COLUMNS * ROWS];
    long double expected[COLUMNS * ROWS];
    tl_status status = run_chain(options, window, found, error);
    if (status == TL_OK)
        status = run_reference(options, window, expected, error);
    for (int k = 0; k < COLUMNS * ROWS && status == TL_OK; k++) {
        double off = isfinite(found[k]) ? (double)fabsl((long double)found[k] - expected[k]) : HUGE_VAL;
        out->largest = fmax(out->largest, off);
        out->samples++;
    }
    return status;
}
