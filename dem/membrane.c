/* Cell-centred multigrid. At every level the surface is a network of conductances: wx, wy lead to the neighbours to the
 * right and below, `tie` to known heights. 2 x 2 cells become one of the next level, so that any shape of hole has an
 * image there: of the two edges that cross a side in parallel each is twice as long, so their sum is halved; ties get a
 * resistance in series, 1/16, for the way to the middle of the larger cell: a straight rim has 1/4, but where a cell
 * has one unknown sample in a corner that much made corrections overshoot, and less only makes them smaller. Residuals
 * are added up (they are fluxes), corrections come back bilinearly (P. Wesseling, "An introduction to multigrid
 * methods", 1992, chapter 5). Smoothing is red-black, so that the order of rows, and with it the number of threads,
 * does not matter. */
#include "dem/membrane.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <float.h>
#include <math.h>
#include <string.h>

enum {
    LEVELS_MAX = 40,
    SWEEPS = 2,    /* before and after the coarser level */
    COARSEST = 64, /* cells; solved by sweeps alone */
    COARSEST_SWEEPS = 200,
    W_LEVEL = 3, /* from here on every level is visited twice as often as the one before: cheap there, and holes of any
                    size converge */
    CYCLES_MAX = 60,          /* 4 to 10 are usual */
    BAND = 64,                /* rows a work item */
    PARALLEL_CELLS = 1 << 16, /* smaller levels are done by one thread */
};

static const float TOLERANCE = 1e-5F, TIE_RESISTANCE = 0.0625F;

/* The finest level has no arrays of weights: each is 1 where one of the two samples is unknown. */
typedef struct level {
    int64_t width, height;
    float *u, *f;         /* unknowns and right-hand sides */
    float *wx, *wy, *tie; /* NULL at the finest level */
} level;

typedef struct membrane {
    level levels[LEVELS_MAX];
    int count;
    unsigned char *unknown; /* of the finest level */
    const tl_run *run;
    float change; /* largest change of a height in this cycle */
} membrane;

/* ---- loops over rows ---- */

typedef struct rows {
    membrane *m;
    int level;
    int colour;
    void (*row)(membrane *m, int level, int64_t y, int colour);
} rows;

static tl_status run_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    (void)error;
    const rows *r = context;
    int64_t end = tl_int64_min(((int64_t)item + 1) * BAND, r->m->levels[r->level].height);
    for (int64_t y = (int64_t)item * BAND; y < end; y++)
        r->row(r->m, r->level, y, r->colour);
    return TL_OK;
}

static void for_rows(membrane *m, int at, int colour, void (*row)(membrane *, int, int64_t, int))
{
    const level *l = &m->levels[at];
    rows r = {.m = m, .level = at, .colour = colour, .row = row};
    bool large = l->width * l->height >= PARALLEL_CELLS;
    const tl_run quiet = {.threads = !large ? 1 : m->run ? m->run->threads : 0};
    tl_parallel_for(&quiet, (uint64_t)tl_div_up(l->height, BAND), 0, run_band, &r, NULL);
}

/* ---- smoothing ---- */

static void smooth_finest_row(membrane *m, int at, int64_t y, int colour)
{
    const level *l = &m->levels[at];
    const unsigned char *unknown = m->unknown + y * l->width;
    float *u = l->u + y * l->width;
    for (int64_t x = (y + colour) & 1; x < l->width; x += 2) {
        if (!unknown[x])
            continue;
        float sum = 0, count = 0;
        if (x > 0) {
            sum += u[x - 1];
            count++;
        }
        if (x + 1 < l->width) {
            sum += u[x + 1];
            count++;
        }
        if (y > 0) {
            sum += u[x - l->width];
            count++;
        }
        if (y + 1 < l->height) {
            sum += u[x + l->width];
            count++;
        }
        if (count > 0)
            u[x] = sum / count;
    }
}

/* Weighted sum of the neighbours of cell (x, y), and the sum of the weights, ties included. */
static float neighbours(const level *l, int64_t x, int64_t y, float *weight)
{
    int64_t k = y * l->width + x;
    float sum = 0, total = l->tie[k];
    if (x > 0) {
        sum += l->wx[k - 1] * l->u[k - 1];
        total += l->wx[k - 1];
    }
    if (x + 1 < l->width) {
        sum += l->wx[k] * l->u[k + 1];
        total += l->wx[k];
    }
    if (y > 0) {
        sum += l->wy[k - l->width] * l->u[k - l->width];
        total += l->wy[k - l->width];
    }
    if (y + 1 < l->height) {
        sum += l->wy[k] * l->u[k + l->width];
        total += l->wy[k];
    }
    *weight = total;
    return sum;
}

static void smooth_coarse_row(membrane *m, int at, int64_t y, int colour)
{
    const level *l = &m->levels[at];
    for (int64_t x = (y + colour) & 1; x < l->width; x += 2) {
        float weight, sum = neighbours(l, x, y, &weight);
        if (weight > 0)
            l->u[y * l->width + x] = (l->f[y * l->width + x] + sum) / weight;
    }
}

/* `first` is the colour of the first half sweep: the reverse order behind the coarse level keeps the cycle symmetric.
 */
static void smooth(membrane *m, int at, int sweeps, int first)
{
    for (int sweep = 0; sweep < sweeps; sweep++)
        for (int half = 0; half < 2; half++)
            for_rows(m, at, first ^ half, at ? smooth_coarse_row : smooth_finest_row);
}

/* ---- between levels ---- */

static float finest_residual(const membrane *m, int64_t x, int64_t y)
{
    const level *l = &m->levels[0];
    int64_t k = y * l->width + x;
    float r = 0;
    if (!m->unknown[k])
        return 0;
    if (x > 0)
        r += l->u[k - 1] - l->u[k];
    if (x + 1 < l->width)
        r += l->u[k + 1] - l->u[k];
    if (y > 0)
        r += l->u[k - l->width] - l->u[k];
    if (y + 1 < l->height)
        r += l->u[k + l->width] - l->u[k];
    return r;
}

static float coarse_residual(const level *l, int64_t x, int64_t y)
{
    float weight, sum = neighbours(l, x, y, &weight);
    return l->f[y * l->width + x] + sum - weight * l->u[y * l->width + x];
}

/* Row y of level `at`: residuals of the four cells above are added up, and the correction begins at 0. */
static void restrict_row(membrane *m, int at, int64_t y, int colour)
{
    (void)colour;
    const level *fine = &m->levels[at - 1], *l = &m->levels[at];
    for (int64_t x = 0; x < l->width; x++) {
        float sum = 0;
        for (int64_t v = 2 * y; v < tl_int64_min(2 * y + 2, fine->height); v++)
            for (int64_t u = 2 * x; u < tl_int64_min(2 * x + 2, fine->width); u++)
                sum += at == 1 ? finest_residual(m, u, v) : coarse_residual(fine, u, v);
        l->f[y * l->width + x] = sum;
        l->u[y * l->width + x] = 0;
    }
}

static float coarse_at(const level *l, int64_t x, int64_t y)
{
    return l->u[y * l->width + x];
}

/* Bilinear between the centres of the coarser cells. */
static float interpolate(const level *coarse, int64_t x, int64_t y)
{
    int64_t i = x >> 1, j = y >> 1, side = x & 1 ? i + 1 : i - 1, above = y & 1 ? j + 1 : j - 1;
    /* the raster's edge is a mirror, not a known height */
    side = side < 0 || side >= coarse->width ? i : side;
    above = above < 0 || above >= coarse->height ? j : above;
    return 0.0625F * (9 * coarse_at(coarse, i, j) + 3 * (coarse_at(coarse, side, j) + coarse_at(coarse, i, above)) +
                      coarse_at(coarse, side, above));
}

static void add_correction_row(membrane *m, int at, int64_t y, int colour)
{
    (void)colour;
    const level *l = &m->levels[at];
    for (int64_t x = 0; x < l->width; x++)
        if (at || m->unknown[y * l->width + x])
            l->u[y * l->width + x] += interpolate(&m->levels[at + 1], x, y);
}

static void cycle(membrane *m, int at)
{
    if (at == m->count - 1) {
        smooth(m, at, COARSEST_SWEEPS, 0);
        return;
    }
    smooth(m, at, SWEEPS, 0);
    for (int visit = 0; visit < (at < W_LEVEL ? 1 : 2); visit++) {
        for_rows(m, at + 1, 0, restrict_row);
        cycle(m, at + 1);
        for_rows(m, at, 0, add_correction_row);
        smooth(m, at, SWEEPS, 1);
    }
}

/* ---- setting up ---- */

/* Cell k of a coarser level from the sums over its cells: see the head of this file. `f` is the ties' sum times the
 * known heights. */
static void set_coarse(const level *l, int64_t k, float wx, float wy, float tie, float f)
{
    float series = 1 / (1 + TIE_RESISTANCE * tie);
    l->wx[k] = 0.5F * wx;
    l->wy[k] = 0.5F * wy;
    l->tie[k] = series * tie;
    l->f[k] = series * f;
    l->u[k] = 0;
}

/* Row y of level 1, from the unknown samples of its cells: edges between two of them, and between one and a known one.
 */
static void build_first_row(membrane *m, int at, int64_t y, int colour)
{
    (void)colour;
    const level *fine = &m->levels[0], *l = &m->levels[at];
    for (int64_t x = 0; x < l->width; x++) {
        float wx = 0, wy = 0, tie = 0, f = 0;
        for (int64_t v = 2 * y; v < tl_int64_min(2 * y + 2, fine->height); v++)
            for (int64_t u = 2 * x; u < tl_int64_min(2 * x + 2, fine->width); u++) {
                int64_t k = v * fine->width + u;
                if (!m->unknown[k])
                    continue;
                const struct {
                    bool there;
                    int64_t k;
                    float *across; /* where an edge to an unknown sample counts; NULL: inside of the cell, or stored
                                      there */
                } edges[4] = {{u > 0, k - 1, NULL},
                              {u + 1 < fine->width, k + 1, u & 1 ? &wx : NULL},
                              {v > 0, k - fine->width, NULL},
                              {v + 1 < fine->height, k + fine->width, v & 1 ? &wy : NULL}};
                for (int e = 0; e < 4; e++) {
                    if (!edges[e].there)
                        continue;
                    if (!m->unknown[edges[e].k]) {
                        tie += 1;
                        f += fine->u[edges[e].k];
                    } else if (edges[e].across)
                        *edges[e].across += 1;
                }
            }
        int64_t k = y * l->width + x;
        set_coarse(l, k, wx, wy, tie, f);
    }
}

static void build_row(membrane *m, int at, int64_t y, int colour)
{
    (void)colour;
    const level *fine = &m->levels[at - 1], *l = &m->levels[at];
    for (int64_t x = 0; x < l->width; x++) {
        float wx = 0, wy = 0, tie = 0, f = 0;
        for (int64_t v = 2 * y; v < tl_int64_min(2 * y + 2, fine->height); v++)
            for (int64_t u = 2 * x; u < tl_int64_min(2 * x + 2, fine->width); u++) {
                int64_t k = v * fine->width + u;
                wx += u & 1 ? fine->wx[k] : 0;
                wy += v & 1 ? fine->wy[k] : 0;
                tie += fine->tie[k];
                f += fine->f[k];
            }
        int64_t k = y * l->width + x;
        set_coarse(l, k, wx, wy, tie, f);
    }
}

static bool allocate_level(level *l, int64_t width, int64_t height)
{
    *l = (level){.width = width, .height = height};
    float **arrays[] = {&l->u, &l->f, &l->wx, &l->wy, &l->tie};
    bool good = true;
    for (size_t i = 0; i < sizeof arrays / sizeof *arrays; i++) {
        *arrays[i] = tl_alloc_grid(width, height, sizeof(float));
        good = good && *arrays[i];
    }
    return good;
}

static bool build(membrane *m)
{
    for (m->count = 1; m->count < LEVELS_MAX; m->count++) {
        const level *fine = &m->levels[m->count - 1];
        if (m->count > 1 && fine->width * fine->height <= COARSEST)
            return true;
        if (!allocate_level(&m->levels[m->count], tl_div_up(fine->width, 2), tl_div_up(fine->height, 2))) {
            m->count++;
            return false;
        }
        for_rows(m, m->count, 0, m->count == 1 ? build_first_row : build_row);
    }
    return true;
}

static void release(membrane *m)
{
    for (int at = 1; at < m->count; at++) {
        const level *l = &m->levels[at];
        free(l->u);
        free(l->f);
        free(l->wx);
        free(l->wy);
        free(l->tie);
    }
    free(m->unknown);
}

/* From the coarsest level up, each solution is the next one's first guess: full multigrid. */
static void first_guess(membrane *m)
{
    cycle(m, m->count - 1);
    for (int at = m->count - 2; at >= 0; at--) {
        level *l = &m->levels[at];
        const level *coarse = &m->levels[at + 1];
        for (int64_t y = 0; y < l->height; y++)
            for (int64_t x = 0; x < l->width; x++)
                if (at || m->unknown[y * l->width + x])
                    l->u[y * l->width + x] = coarse->u[y / 2 * coarse->width + x / 2];
        cycle(m, at);
    }
}

/* Largest change that one more cycle makes. */
static float change_of_cycle(membrane *m, float *before)
{
    const level *l = &m->levels[0];
    size_t samples = (size_t)(l->width * l->height);
    memcpy(before, l->u, samples * sizeof *before);
    cycle(m, 0);
    float change = 0;
    for (size_t k = 0; k < samples; k++)
        change = fmaxf(change, fabsf(l->u[k] - before[k]));
    return change;
}

/* Marks the unknown samples and gives them some height, and says what change counts as none: a share of the known
 * heights' range, but not less than their rounding. False: nothing to do. */
static bool mark_unknown(membrane *m, float *tolerance)
{
    const level *l = &m->levels[0];
    float low = INFINITY, high = -INFINITY;
    bool any = false;
    for (int64_t k = 0; k < l->width * l->height; k++) {
        m->unknown[k] = isnan(l->u[k]) != 0;
        if (m->unknown[k])
            any = true;
        else {
            low = fminf(low, l->u[k]);
            high = fmaxf(high, l->u[k]);
        }
    }
    for (int64_t k = 0; any && low <= high && k < l->width * l->height; k++)
        if (m->unknown[k])
            l->u[k] = low;
    *tolerance = TOLERANCE * (high - low) + 4 * FLT_EPSILON * fmaxf(fabsf(low), fabsf(high));
    return any && low <= high;
}

static tl_status iterate(membrane *m, float tolerance, float *before, tl_error *error)
{
    first_guess(m);
    float last = 0;
    for (int n = 0; n < CYCLES_MAX; n++) {
        tl_status status = tl_run_check(m->run, error);
        if (status != TL_OK)
            return status;
        float change = change_of_cycle(m, before), shrinking = (n ? last : 2 * change) - change;
        /* what is still to come, when every change is as much smaller than the one before as this one: change^2 /
         * shrinking */
        if (change == 0 || (shrinking > 0 && change * (change / shrinking) <= tolerance))
            break;
        last = change;
    }
    return TL_OK;
}

tl_status dem_membrane_fill(float *heights, int64_t width, int64_t height, const tl_run *run, tl_error *error)
{
    membrane m = {.run = run, .count = 1};
    m.levels[0] = (level){.width = width, .height = height, .u = heights};
    m.unknown = tl_alloc_grid(width, height, 1);
    float tolerance, *before = tl_alloc_grid(width, height, sizeof *before);
    tl_status status = m.unknown && before ? TL_OK : tl_fail_memory(error, "filling voids");
    if (status == TL_OK && mark_unknown(&m, &tolerance))
        status = build(&m) ? iterate(&m, tolerance, before, error) : tl_fail_memory(error, "filling voids");
    free(before);
    release(&m);
    return status;
}
