#include "lib/scene/cell_means.h"

#include "fbm/weights.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

/* Heights of level 0, for the chain. */
typedef struct points {
    fbm_window window;
    float *heights;
    const scene_planes *planes;
} points;

static tl_status load(void *context, fbm_window w, float *buffer, float *const planes[SCENE_PLANES], tl_error *error)
{
    (void)error;
    const points *p = context;
    if (p->planes)
        scene_planes_cut(p->planes, w, planes);
    const float *from = p->heights + (size_t)(w.j - p->window.j) * p->window.width + (size_t)(w.i - p->window.i);
    for (size_t row = 0; row < w.height; row++)
        memcpy(buffer + row * w.width, from + row * p->window.width, w.width * sizeof *buffer);
    return TL_OK;
}

/* Cells of level `level`: cell k has its centre in that of cell k - 2^(level - 1) of the chain's lattice. */
static scene_chain_target target_of(int level, fbm_window cells, float *out)
{
    int64_t shift = (int64_t)1 << (level - 1);
    cells.i -= shift;
    cells.j -= shift;
    return (scene_chain_target){.level = level, .centres = true, .window = cells, .out = out};
}

static fbm_window dense(int64_t i, int64_t j, size_t width, size_t height)
{
    return (fbm_window){i, j, width, height, width};
}

/* The cells of level `level` in a window of cells of level 0, and the other way round. */
static fbm_window finer(fbm_window w, int level)
{
    int64_t unit = (int64_t)1 << level;
    return dense(w.i * unit, w.j * unit, w.width << level, w.height << level);
}

static fbm_window coarser(fbm_window w, int level)
{
    int64_t i = w.i >> level, j = w.j >> level;
    return dense(i, j, (size_t)(((w.i + (int64_t)w.width - 1) >> level) - i + 1),
                 (size_t)(((w.j + (int64_t)w.height - 1) >> level) - j + 1));
}

static fbm_window hull(fbm_window a, fbm_window b)
{
    int64_t i = tl_int64_min(a.i, b.i), j = tl_int64_min(a.j, b.j);
    int64_t right = tl_int64_max(a.i + (int64_t)a.width, b.i + (int64_t)b.width);
    int64_t below = tl_int64_max(a.j + (int64_t)a.height, b.j + (int64_t)b.height);
    return dense(i, j, (size_t)(right - i), (size_t)(below - j));
}

/* The cells that are made at the level of means: all of level 0 that the window touches. */
static fbm_window whole_cells(const scene_cell_means *m, int level, fbm_window window)
{
    return finer(coarser(window, level), m->level);
}

/* Points from which a window is made: for itself, and for the means over its cells. */
static fbm_window points_window(const scene_cell_means *m, const scene_chain *chain, int level, fbm_window window)
{
    scene_chain_target itself = target_of(level, window, NULL),
                       cells = target_of(m->level, whole_cells(m, level, window), NULL);
    return hull(scene_chain_support(chain, &itself), scene_chain_support(chain, &cells));
}

/* What the means must be known of, so that the points can be chosen. */
static fbm_window errors_window(fbm_window at)
{
    return scene_widened(at, SCENE_MEANS_REACH);
}

fbm_window scene_cell_means_support(const scene_cell_means *m, const scene_chain *chain, int level, fbm_window window)
{
    fbm_window errors = errors_window(points_window(m, chain, level, window));
    scene_chain_target cells = target_of(m->level, finer(errors, m->level), NULL);
    return hull(errors, scene_chain_support(chain, &cells));
}

/* Means over the cells of level 0 in `window` of the field made from points. */
static tl_status means_of(const scene_cell_means *m, const scene_chain *chain, points *p, fbm_window window,
                          double *out, const char *name, tl_error *error)
{
    fbm_window fine = finer(window, m->level);
    float *heights = tl_alloc_grid((int64_t)fine.width, (int64_t)fine.height, sizeof *heights);
    scene_chain_target target = target_of(m->level, fine, heights);
    tl_status status = heights ? scene_chain_run(chain, &target, load, p, name, error) : tl_fail_memory(error, name);
    memset(out, 0, window.width * window.height * sizeof *out);
    for (size_t y = 0; y < fine.height && status == TL_OK; y++)
        for (size_t x = 0; x < fine.width; x++)
            out[(y >> m->level) * window.width + (x >> m->level)] += (double)heights[y * fine.width + x];
    for (size_t k = 0; k < window.width * window.height; k++)
        out[k] = ldexp(out[k], -2 * m->level);
    free(heights);
    return status;
}

/* ---- The response ------------------------------------------------------------------------------ */

/* Exponent k of the inverses: closer where they are small, for there the response changes most. */
static double exponent_of(int k)
{
    const double part = (double)k / (SCENE_MEANS_EXPONENTS - 1);
    return FBM_HURST_MIN + (FBM_HURST_MAX - FBM_HURST_MIN) * part * part;
}

static double place_of(double hurst)
{
    const double part = sqrt(fmax((hurst - FBM_HURST_MIN) / (FBM_HURST_MAX - FBM_HURST_MIN), 0));
    return fmin((SCENE_MEANS_EXPONENTS - 1) * part, SCENE_MEANS_EXPONENTS - 1);
}

enum {
    REACH = SCENE_MEANS_REACH,
    SPREAD = 6,
    SIDE = 2 * SPREAD + 1,
    ROUNDS = 60,
    TAPS = (2 * REACH + 1) * (2 * REACH + 1)
};

/* Heights at the impulse's row for the window's cells: one point is 1. Where the chain asks for it, of one exponent. */
static tl_status impulse_response(const scene_cell_means *m, const scene_chain *chain, int64_t row, double hurst,
                                  double response[SIDE][SIDE], const char *name, tl_error *error)
{
    fbm_window window = dense(-SPREAD, row - SPREAD, SIDE, SIDE);
    scene_chain_target cells = target_of(m->level, finer(window, m->level), NULL);
    fbm_window support = scene_chain_support(chain, &cells);
    size_t count = support.width * support.height;
    float *heights = calloc(3 * count, sizeof *heights); /* and planes behind them: no noise */
    if (!heights)
        return tl_fail_memory(error, name);
    scene_planes planes = {support, {[SCENE_STRENGTH] = heights + count, [SCENE_HURST] = heights + 2 * count}};
    for (size_t k = 0; k < count; k++)
        planes.of[SCENE_HURST][k] = (float)hurst;
    points p = {support, heights, chain->placed ? &planes : NULL};
    heights[(size_t)(row - support.j) * support.width + (size_t)-support.i] = 1;
    tl_status status = means_of(m, chain, &p, window, response[0], name, error);
    free(heights);
    return status;
}

/* Richardson's iteration for an inverse of few cells: the response of averaging to points lies between 0.3 and 1 at all
 * frequencies, so it converges; but for exponents below 0.1 at one level, where it stops before it grows. */
static void invert(double response[SIDE][SIDE], double inverse[2 * REACH + 1][2 * REACH + 1])
{
    double next[2 * REACH + 1][2 * REACH + 1], sum = 0, last = HUGE_VAL;
    for (int round = 0; round < ROUNDS; round++) {
        double residual = 0;
        for (int y = -REACH; y <= REACH; y++)
            for (int x = -REACH; x <= REACH; x++) {
                double rest = x == 0 && y == 0 ? 1 : 0;
                for (int v = -REACH; v <= REACH; v++)
                    for (int u = -REACH; u <= REACH; u++)
                        rest -= inverse[v + REACH][u + REACH] * response[y - v + SPREAD][x - u + SPREAD];
                next[y + REACH][x + REACH] = inverse[y + REACH][x + REACH] + rest;
                residual += rest * rest;
            }
        if (residual > .98 * last)
            break;
        last = residual;
        memcpy(inverse, next, sizeof next);
    }
    for (int y = 0; y <= 2 * REACH; y++)
        for (int x = 0; x <= 2 * REACH; x++)
            sum += inverse[y][x];
    for (int y = 0; y <= 2 * REACH; y++)
        for (int x = 0; x <= 2 * REACH; x++)
            inverse[y][x] /= sum; /* a plateau is kept */
}

tl_status scene_cell_means_measure(const scene_chain *chain, int64_t row, int levels, scene_cell_means *out,
                                   const char *name, tl_error *error)
{
    *out =
        (scene_cell_means){.level = levels < SCENE_MEANS_LEVEL ? levels : SCENE_MEANS_LEVEL, .placed = chain->placed};
    scene_chain smooth = *chain; /* shares what it points to */
    smooth.mapped = smooth.placed;
    for (int l = 0; l <= SCENE_LEVEL_MAX; l++)
        smooth.steps[l].amplitude = 0;
    for (int k = 0; k < 2; k++)
        smooth.row_steps[k].amplitude = 0;
    double response[SIDE][SIDE];
    tl_status status = TL_OK;
    for (int k = 0; status == TL_OK && k < (out->placed ? SCENE_MEANS_EXPONENTS : 1); k++) {
        status = impulse_response(out, &smooth, row, exponent_of(k), response, name, error);
        if (status == TL_OK)
            invert(response, out->inverses[k]);
    }
    return status;
}

/* ---- Making ------------------------------------------------------------------------------------ */

static float patch_height(const scene_patch *p, int64_t i, int64_t j)
{
    return p->heights[(size_t)(j - p->window.j) * p->window.width + (size_t)(i - p->window.i)];
}

/* Turns means over `window` into what they lack; nothing where the raster says nothing. */
static void errors_of(const scene_patch *patch, fbm_window window, double *means)
{
    for (size_t k = 0; k < window.width * window.height; k++) {
        int64_t i = window.i + (int64_t)(k % window.width), j = window.j + (int64_t)(k / window.width);
        means[k] = scene_patch_known(patch, i, j) ? (double)patch_height(patch, i, j) - means[k] : 0;
    }
}

/* The inverse at a point: the share of the one before and of the one behind its exponent. */
static const double *inverse_at(const scene_cell_means *m, const scene_planes *planes, int64_t i, int64_t j,
                                double room[TAPS])
{
    if (!m->placed)
        return m->inverses[0][0];
    const fbm_window *w = &planes->window;
    double hurst = (double)planes->of[SCENE_HURST][(size_t)(j - w->j) * w->width + (size_t)(i - w->i)];
    double place = place_of(hurst);
    int at = place < SCENE_MEANS_EXPONENTS - 1 ? (int)place : SCENE_MEANS_EXPONENTS - 2;
    const double *before = m->inverses[at][0], *behind = m->inverses[at + 1][0];
    for (int k = 0; k < TAPS; k++)
        room[k] = before[k] + (place - at) * (behind[k] - before[k]);
    return room;
}

static void choose_points(const scene_cell_means *m, const scene_patch *patch, const double *errors, points *p)
{
    fbm_window w = p->window;
    size_t stride = w.width + 2 * REACH;
    double room[TAPS];
    for (size_t y = 0; y < w.height; y++)
        for (size_t x = 0; x < w.width; x++) {
            double sum = (double)patch_height(patch, w.i + (int64_t)x, w.j + (int64_t)y);
            const double *inverse = inverse_at(m, p->planes, w.i + (int64_t)x, w.j + (int64_t)y, room) + TAPS - 1;
            for (size_t v = 0; v <= 2 * REACH; v++)
                for (size_t u = 0; u <= 2 * REACH; u++)
                    sum += *inverse-- * errors[(y + v) * stride + x + u];
            p->heights[y * w.width + x] = (float)sum;
        }
}

/* 6 u (1 - u) across a cell, u in 0 ... 1. */
static double bump(int64_t k, int level)
{
    double u = ldexp((double)(2 * (k & (((int64_t)1 << level) - 1)) + 1), -level - 1);
    return 6 * u * (1 - u);
}

static void add_bumps(const scene_cell_means *m, int level, fbm_window window, fbm_window cells, const double *errors,
                      float *out)
{
    /* the mean of a bump over n midpoints is 1 + 1 / (2 n^2) */
    double one = 1 + ldexp(.5, -2 * m->level), scale = 1 / (one * one);
    for (size_t y = 0; y < window.height; y++) {
        int64_t row = window.j + (int64_t)y;
        const double *error = errors + (size_t)((row >> level) - cells.j) * cells.width;
        double down = bump(row, level) * scale;
        for (size_t x = 0; x < window.width; x++) {
            int64_t column = window.i + (int64_t)x;
            out[y * window.stride + x] += (float)(error[(column >> level) - cells.i] * down * bump(column, level));
        }
    }
}

static size_t area(fbm_window w)
{
    return w.width * w.height;
}

tl_status scene_cell_means_run(const scene_cell_means *m, const scene_chain *chain, int level, fbm_window window,
                               const scene_patch *patch, const scene_planes *planes, float *out, const char *name,
                               tl_error *error)
{
    fbm_window at = points_window(m, chain, level, window), wide = errors_window(at), cells = coarser(window, level);
    points own = {patch->window, patch->heights, planes}, chosen = {at, tl_alloc(area(at), sizeof(float)), planes};
    double *errors = tl_alloc(area(wide), sizeof *errors);
    tl_status status = chosen.heights && errors ? TL_OK : tl_fail_memory(error, name);
    if (status == TL_OK)
        status = means_of(m, chain, &own, wide, errors, name, error);
    if (status == TL_OK) {
        errors_of(patch, wide, errors);
        choose_points(m, patch, errors, &chosen);
        scene_chain_target target = target_of(level, window, out);
        status = scene_chain_run(chain, &target, load, &chosen, name, error);
    }
    if (status == TL_OK)
        status = means_of(m, chain, &chosen, cells, errors, name, error);
    if (status == TL_OK) {
        errors_of(patch, cells, errors);
        add_bumps(m, level, window, cells, errors, out);
    }
    free(chosen.heights);
    free(errors);
    return status;
}
