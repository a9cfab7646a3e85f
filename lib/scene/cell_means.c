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

static size_t area(fbm_window w)
{
    return w.width * w.height;
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
fbm_window scene_cell_means_support(const scene_cell_means *m, const scene_chain *chain, int level, fbm_window window)
{
    scene_chain_target itself = target_of(level, window, NULL),
                       cells = target_of(m->level, whole_cells(m, level, window), NULL);
    return hull(scene_chain_support(chain, &itself), scene_chain_support(chain, &cells));
}

enum { CELLS_AT_ONCE = 8 };

/* Adds a row's parts of `count` cells to their sums, side by side, for a sum waits for the one before. */
static inline void add_parts(const float *heights, int level, size_t count, double *sums)
{
    double of[CELLS_AT_ONCE];
    for (size_t x = 0; x < count; x++)
        of[x] = sums[x];
    for (size_t part = 0; part < (size_t)1 << level; part++)
        for (size_t x = 0; x < count; x++)
            of[x] += (double)heights[(x << level) + part];
    for (size_t x = 0; x < count; x++)
        sums[x] = of[x];
}

/* Means over the cells of level 0 in `window`, of the heights of their parts at the level of means. */
static void average(const scene_cell_means *m, fbm_window window, const float *heights, size_t stride, double *out)
{
    memset(out, 0, area(window) * sizeof *out);
    for (size_t y = 0; y < window.height << m->level; y++, heights += stride) {
        double *sums = out + (y >> m->level) * window.width;
        size_t x = 0;
        for (; x + CELLS_AT_ONCE <= window.width; x += CELLS_AT_ONCE)
            add_parts(heights + (x << m->level), m->level, CELLS_AT_ONCE, sums + x);
        add_parts(heights + (x << m->level), m->level, window.width - x, sums + x);
    }
    const double share = ldexp(1, -2 * m->level);
    for (size_t k = 0; k < area(window); k++)
        out[k] *= share;
}

/* Those of the field made from points. */
static tl_status means_of(const scene_cell_means *m, const scene_chain *chain, const points *p, fbm_window window,
                          double *out, const char *name, tl_error *error)
{
    fbm_window fine = finer(window, m->level);
    float *heights = tl_alloc_grid((int64_t)fine.width, (int64_t)fine.height, sizeof *heights);
    scene_chain_target target = target_of(m->level, fine, heights);
    points at = *p;
    tl_status status = heights ? scene_chain_run(chain, &target, load, &at, name, error) : tl_fail_memory(error, name);
    if (status == TL_OK)
        average(m, window, heights, fine.width, out);
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

tl_status scene_cell_means_measure(const scene_chain *chain, int64_t width, int64_t row, int levels,
                                   scene_cell_means *out, const char *name, tl_error *error)
{
    *out = (scene_cell_means){.level = levels < SCENE_MEANS_LEVEL ? levels : SCENE_MEANS_LEVEL,
                              .placed = chain->placed,
                              .lacking = scene_cell_store_create(width),
                              .points = scene_cell_store_create(width)};
    if (!out->lacking || !out->points)
        return tl_fail_memory(error, name);
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

/* For a window, from what the means of another lack. */
static void choose_points(const scene_cell_means *m, const scene_ground *ground, fbm_window known, const double *errors,
                          fbm_window w, double *out)
{
    size_t stride = known.width;
    double room[TAPS];
    errors += (size_t)(w.j - REACH - known.j) * stride + (size_t)(w.i - REACH - known.i);
    for (size_t y = 0; y < w.height; y++)
        for (size_t x = 0; x < w.width; x++) {
            int64_t i = w.i + (int64_t)x, j = w.j + (int64_t)y;
            double sum = (double)patch_height(&ground->patch, i, j);
            const double *inverse = inverse_at(m, &ground->planes, i, j, room) + TAPS - 1;
            for (size_t v = 0; v <= 2 * REACH; v++)
                for (size_t u = 0; u <= 2 * REACH; u++)
                    sum += *inverse-- * errors[(y + v) * stride + x + u];
            *out++ = sum;
        }
}

/* 6 u (1 - u) across a cell, u in 0 ... 1. */
static double bump(int64_t k, int level)
{
    double u = ldexp((double)(2 * (k & (((int64_t)1 << level) - 1)) + 1), -level - 1);
    return 6 * u * (1 - u);
}

/* `bumps`: room for a row. */
static void add_bumps(const scene_cell_means *m, int level, fbm_window window, fbm_window cells, const double *errors,
                      double *bumps, float *out)
{
    /* the mean of a bump over n midpoints is 1 + 1 / (2 n^2) */
    double one = 1 + ldexp(.5, -2 * m->level), scale = 1 / (one * one);
    const int64_t right = window.i + (int64_t)window.width;
    for (size_t x = 0; x < window.width; x++)
        bumps[x] = bump(window.i + (int64_t)x, level);
    for (size_t y = 0; y < window.height; y++) {
        int64_t row = window.j + (int64_t)y;
        const double *error = errors + (size_t)((row >> level) - cells.j) * cells.width;
        double down = bump(row, level) * scale;
        float *line = out + y * window.stride;
        for (int64_t column = window.i, end; column < right; column = end) {
            end = tl_int64_min(((column >> level) + 1) * ((int64_t)1 << level), right);
            const double lacking = error[(column >> level) - cells.i] * down;
            for (int64_t x = column - window.i; x < end - window.i; x++)
                line[x] += (float)(lacking * bumps[x]);
        }
    }
}

/* What is made from a raster. */
typedef struct making {
    const scene_cell_means *means;
    const scene_chain *chain;
    scene_ground_read read;
    const void *context;
    const char *name;
} making;

static points points_of(const scene_chain *chain, fbm_window window, float *heights, const scene_ground *ground)
{
    return (points){window, heights, chain->mapped ? &ground->planes : NULL};
}

/* What the raster's own samples, taken for points, lack of its means. */
static tl_status make_lacking(const void *context, fbm_window window, double *out, tl_error *error)
{
    const making *of = context;
    scene_chain_target cells = target_of(of->means->level, finer(window, of->means->level), NULL);
    scene_ground ground = {.patch = {.heights = NULL}};
    tl_status status = of->read(of->context, hull(window, scene_chain_support(of->chain, &cells)), &ground, error);
    if (status == TL_OK) {
        points own = points_of(of->chain, ground.patch.window, ground.patch.heights, &ground);
        status = means_of(of->means, of->chain, &own, window, out, of->name, error);
    }
    if (status == TL_OK)
        errors_of(&ground.patch, window, out);
    scene_ground_free(&ground);
    return status;
}

static tl_status make_points(const void *context, fbm_window window, double *out, tl_error *error)
{
    const making *of = context;
    const fbm_window wide = scene_cell_store_window(scene_widened(window, SCENE_MEANS_REACH));
    scene_ground ground = {.patch = {.heights = NULL}};
    double *errors = tl_alloc(area(wide), sizeof *errors);
    tl_status status = errors ? of->read(of->context, window, &ground, error) : tl_fail_memory(error, of->name);
    if (status == TL_OK)
        status = scene_cell_store_read(of->means->lacking, wide, make_lacking, of, errors, of->name, error);
    if (status == TL_OK)
        choose_points(of->means, &ground, wide, errors, window, out);
    scene_ground_free(&ground);
    free(errors);
    return status;
}

/* The points of a window; those around it are kept. */
static tl_status read_points(const making *of, fbm_window window, float *out, tl_error *error)
{
    const fbm_window wide = scene_cell_store_window(window);
    double *numbers = tl_alloc(area(wide), sizeof *numbers);
    if (!numbers)
        return tl_fail_memory(error, of->name);
    tl_status status = scene_cell_store_read(of->means->points, wide, make_points, of, numbers, of->name, error);
    const double *from = numbers + (size_t)(window.j - wide.j) * wide.width + (size_t)(window.i - wide.i);
    for (size_t row = 0; status == TL_OK && row < window.height; row++)
        for (size_t k = 0; k < window.width; k++)
            out[row * window.width + k] = (float)from[row * wide.width + k];
    free(numbers);
    return status;
}

/* Makes the field from points, and the means over the cells that the window touches: of the same heights, where these
 * are at the level of means. */
static tl_status make_field(const making *of, int level, fbm_window window, points *p, fbm_window cells, double *means,
                            float *out, tl_error *error)
{
    const scene_cell_means *m = of->means;
    const fbm_window fine = finer(cells, level);
    const bool all = fine.width == window.width && fine.height == window.height;
    if (level != m->level || all) {
        scene_chain_target target = target_of(level, window, out);
        tl_status status = scene_chain_run(of->chain, &target, load, p, of->name, error);
        if (status == TL_OK && level == m->level)
            average(m, cells, out, window.stride, means);
        else if (status == TL_OK)
            status = means_of(m, of->chain, p, cells, means, of->name, error);
        return status;
    }
    float *heights = tl_alloc_grid((int64_t)fine.width, (int64_t)fine.height, sizeof *heights);
    if (!heights)
        return tl_fail_memory(error, of->name);
    scene_chain_target target = target_of(level, fine, heights);
    tl_status status = scene_chain_run(of->chain, &target, load, p, of->name, error);
    if (status == TL_OK)
        average(m, cells, heights, fine.width, means);
    const float *from = heights + (size_t)(window.j - fine.j) * fine.width + (size_t)(window.i - fine.i);
    for (size_t row = 0; row < window.height && status == TL_OK; row++)
        memcpy(out + row * window.stride, from + row * fine.width, window.width * sizeof *out);
    free(heights);
    return status;
}

tl_status scene_cell_means_run(const scene_cell_means *m, const scene_chain *chain, int level, fbm_window window,
                               const scene_ground *ground, scene_ground_read read, const void *context, float *out,
                               const char *name, tl_error *error)
{
    const making of = {m, chain, read, context, name};
    fbm_window at = scene_cell_means_support(m, chain, level, window), cells = coarser(window, level);
    float *heights = tl_alloc(area(at), sizeof *heights);
    double *errors = tl_alloc(area(cells) + window.width, sizeof *errors), *bumps = errors + area(cells);
    points chosen = points_of(chain, at, heights, ground);
    tl_status status = heights && errors ? read_points(&of, at, heights, error) : tl_fail_memory(error, name);
    if (status == TL_OK)
        status = make_field(&of, level, window, &chosen, cells, errors, out, error);
    if (status == TL_OK) {
        errors_of(&ground->patch, cells, errors);
        add_bumps(m, level, window, cells, errors, bumps, out);
    }
    free(heights);
    free(errors);
    return status;
}

void scene_cell_means_finish(scene_cell_means *m)
{
    scene_cell_store_destroy(m->lacking);
    scene_cell_store_destroy(m->points);
}

void scene_ground_free(scene_ground *ground)
{
    scene_patch_free(&ground->patch);
    for (int p = 0; p < SCENE_PLANES; p++)
        free(ground->planes.of[p]);
}
