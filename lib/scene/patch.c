#include "lib/scene/patch.h"

#include "fbm/elementary.h"
#include "fbm/rng.h"
#include "fbm/weights.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

void scene_patch_free(scene_patch *patch)
{
    free(patch->heights);
    free(patch->known);
    *patch = (scene_patch){0};
}

static bool inside_columns(const tl_source_info *dem, fbm_window w)
{
    return w.i >= 0 && w.i + (int64_t)w.width <= dem->width;
}

/* Whether the DEM has all of the window; one that goes around the globe has every column. */
static bool inside(const tl_source_info *dem, fbm_window w)
{
    return (dem->wraps || inside_columns(dem, w)) && w.j >= 0 && w.j + (int64_t)w.height <= dem->height;
}

fbm_window scene_widened(fbm_window w, int by)
{
    w.i -= by;
    w.j -= by;
    w.width += 2 * (size_t)by;
    w.height += 2 * (size_t)by;
    w.stride = w.width;
    return w;
}

/* Reads a part of the DEM to where it belongs in the window: its first sample to `out`. */
static tl_status read_part(const tl_source *dem, tl_window part, float *out, size_t stride, tl_error *error)
{
    float *heights = tl_alloc_grid(part.width, part.height, sizeof *heights);
    if (!heights)
        return tl_fail_memory(error, dem->info.name);
    tl_status status = tl_source_read(dem, 0, part, heights, error);
    for (int64_t row = 0; row < part.height && status == TL_OK; row++)
        memcpy(out + (size_t)row * stride, heights + row * part.width, (size_t)part.width * sizeof *out);
    free(heights);
    return status;
}

/* The rows y0 ... y1 - 1 of a window, column by column around the globe. */
static tl_status read_around(const tl_source *dem, fbm_window w, int64_t y0, int64_t y1, float *out, tl_error *error)
{
    int64_t around = dem->info.width, x = (w.i % around + around) % around;
    tl_status status = TL_OK;
    for (int64_t done = 0, n; done < (int64_t)w.width && status == TL_OK; done += n, x = 0) {
        n = tl_int64_min(around - x, (int64_t)w.width - done);
        status = read_part(dem, (tl_window){x, y0, n, y1 - y0}, out + done, w.width, error);
    }
    return status;
}

/* Reads what the DEM has of the window; the rest becomes NaN. */
static tl_status read_ground(const tl_source *dem, fbm_window w, float *out, tl_error *error)
{
    bool columns = inside_columns(&dem->info, w);
    if (columns && inside(&dem->info, w))
        return tl_source_read(dem, 0, (tl_window){w.i, w.j, (int64_t)w.width, (int64_t)w.height}, out, error);
    for (size_t k = 0; k < w.width * w.height; k++)
        out[k] = NAN;
    int64_t y0 = tl_int64_max(w.j, 0), y1 = tl_int64_min(w.j + (int64_t)w.height, dem->info.height);
    if (y0 >= y1)
        return TL_OK;
    float *first = out + (size_t)(y0 - w.j) * w.width;
    if (dem->info.wraps && !columns)
        return read_around(dem, w, y0, y1, first, error);
    int64_t x0 = tl_int64_max(w.i, 0), x1 = tl_int64_min(w.i + (int64_t)w.width, dem->info.width);
    if (x0 >= x1)
        return TL_OK;
    return read_part(dem, (tl_window){x0, y0, x1 - x0, y1 - y0}, first + (x0 - w.i), w.width, error);
}

/* ---- Odd reflection at the rim ---- */

/* Sample `index` of a line of `count`, odd-reflected at both ends: sign * z(at) + share of the ends. With P = count -
 * 1, T = z(P) - z(0) and index = q P + r, 0 <= r <= P: z(r) + q T for even q, z(0) + z(P) + q T - z(P - r) for odd
 * ones. */
typedef struct mirrored {
    int64_t at;
    float sign, first, last;
} mirrored;

static mirrored mirror(int64_t index, int64_t count)
{
    int64_t end = count - 1;
    if (index >= 0 && index <= end)
        return (mirrored){index, 1, 0, 0};
    if (end == 0)
        return (mirrored){0, 1, 0, 0};
    int64_t q = index >= 0 ? index / end : -((end - 1 - index) / end), r = index - q * end;
    float turns = (float)q;
    return q & 1 ? (mirrored){end - r, -1, 1 - turns, 1 + turns} : (mirrored){r, 1, -turns, turns};
}

/* The samples of a line that a window of it is made from. */
static void mirrored_range(int64_t begin, size_t width, int64_t count, int64_t *low, int64_t *high)
{
    *low = count - 1;
    *high = 0;
    for (size_t k = 0; k < width; k++) {
        mirrored m = mirror(begin + (int64_t)k, count);
        *low = tl_int64_min(*low, m.first != 0 ? 0 : m.at);
        *high = tl_int64_max(*high, m.last != 0 ? count - 1 : m.at);
    }
}

static inline float mirrored_value(mirrored m, const float *line, size_t stride, int64_t low, int64_t count)
{
    float z = m.sign * line[(size_t)(m.at - low) * stride];
    if (m.first != 0)
        z += m.first * line[(size_t)(0 - low) * stride];
    if (m.last != 0)
        z += m.last * line[(size_t)(count - 1 - low) * stride];
    return z;
}

/* Reads a window that may reach beyond the raster, from the samples that it is made from. */
static tl_status read_reflected(const tl_source *dem, fbm_window w, float *out, tl_error *error)
{
    const tl_source_info *info = &dem->info;
    int64_t x0 = w.i, x1 = w.i + (int64_t)w.width - 1, y0, y1;
    if (!info->wraps)
        mirrored_range(w.i, w.width, info->width, &x0, &x1);
    mirrored_range(w.j, w.height, info->height, &y0, &y1);
    fbm_window real = {x0, y0, (size_t)(x1 - x0 + 1), (size_t)(y1 - y0 + 1), (size_t)(x1 - x0 + 1)};
    float *heights = tl_alloc_grid((int64_t)real.width, (int64_t)real.height, sizeof *heights);
    float *rows = tl_alloc_grid((int64_t)w.width, (int64_t)real.height, sizeof *rows);
    tl_status status = heights && rows ? read_ground(dem, real, heights, error) : tl_fail_memory(error, info->name);
    if (status == TL_OK) {
        for (size_t c = 0; c < w.width; c++) {
            int64_t x = w.i + (int64_t)c;
            mirrored m = info->wraps ? (mirrored){x, 1, 0, 0} : mirror(x, info->width);
            for (size_t r = 0; r < real.height; r++)
                rows[r * w.width + c] = mirrored_value(m, heights + r * real.width, 1, x0, info->width);
        }
        for (size_t r = 0; r < w.height; r++) {
            mirrored m = mirror(w.j + (int64_t)r, info->height);
            for (size_t c = 0; c < w.width; c++)
                out[r * w.width + c] = mirrored_value(m, rows + c, w.width, y0, info->height);
        }
    }
    free(heights);
    free(rows);
    return status;
}

/* ---- Growth ---- */

/* Further states of a sample: SCENE_BEYOND (reflected) and what is below are known to begin with. */
enum { UNKNOWN = SCENE_NOTHING, FIRST_RING = SCENE_BEYOND + 1 };

/* The height of an unknown sample, from its neighbours whose state is below `state`: the mean, over the eight
 * directions, of the nearest height and `trend` times the step to it. For fBm on a line the best guess behind two known
 * samples has trend 2^(2H-1) - 1: flat at H = 1/2, straight at H = 1. NaN where no neighbour is known. */
static float grow_sample(scene_growth growth, const scene_patch *g, size_t x, size_t y, int state)
{
    float sum = 0;
    int count = 0;
    for (int dy = -1; dy <= 1; dy++)
        for (int dx = -1; dx <= 1; dx++) {
            size_t x1 = x + (size_t)dx, y1 = y + (size_t)dy, x2 = x1 + (size_t)dx, y2 = y1 + (size_t)dy;
            /* sizes wrap around below 0, so one comparison does for both ends */
            if ((!dx && !dy) || x1 >= g->window.width || y1 >= g->window.height)
                continue;
            size_t k1 = y1 * g->window.width + x1, k2 = y2 * g->window.width + x2;
            if (g->known[k1] == UNKNOWN || g->known[k1] >= state)
                continue;
            bool second = x2 < g->window.width && y2 < g->window.height && g->known[k2] && g->known[k2] < state;
            sum += g->heights[k1] + (second ? growth.trend * (g->heights[k1] - g->heights[k2]) : 0);
            count++;
        }
    return count ? sum / (float)count : NAN;
}

/* ---- Simulation -------------------------------------------------------------------------------- */

/* Rings that are simulated: the refinement of the outermost cells sees four. A cell's neighbours are those of 5 x 5. */
enum { SIMULATED = 5, PARITIES = 4, NEAR = 2, ACROSS = 2 * NEAR + 1, NEIGHBOURS = ACROSS * ACROSS - 1, CACHED = 256 };

/* Exponents by place, as numbers of steps; none: that of the growth. */
enum { EXPONENT_STEPS = 64, NO_STEP = 0 };

/* Weights of the neighbours that a mask names, in the order of its bits, and the standard deviation of what is left. */
typedef struct guess {
    uint32_t mask;
    int exponent;
    double weights[NEIGHBOURS], deviation;
} guess;

typedef struct simulation {
    const scene_growth *growth;
    int64_t around;                    /* columns around the globe; 0: it does not wrap */
    int exponent;                      /* of the covariance */
    double covariance[ACROSS][ACROSS]; /* of offsets of 0 ... 4 columns and rows */
    guess cache[CACHED];               /* mask 0: empty */
    float *delta, *hurst;              /* by place; or NULL */
} simulation;

/* Step to neighbour n of 5 x 5. */
static void step_to(int n, int *dx, int *dy)
{
    n += n >= NEIGHBOURS / 2; /* without the middle */
    *dx = n % ACROSS - NEAR;
    *dy = n / ACROSS - NEAR;
}

static void set_exponent(simulation *s, int exponent)
{
    const double nearest = (double)exponent / EXPONENT_STEPS;
    const double hurst = exponent == NO_STEP ? s->growth->hurst : fmin(fmax(nearest, FBM_HURST_MIN), FBM_HURST_MAX);
    s->exponent = exponent;
    for (int dy = 0; dy < ACROSS; dy++)
        for (int dx = 0; dx < ACROSS; dx++) {
            double x = dx, y = dy, a = s->growth->aspect;
            s->covariance[dy][dx] = -.5 * fbm_pow(x * x * a + y * y / a, hurst);
        }
}

/* `g` is all that will be simulated. */
static tl_status simulation_start(simulation *s, const scene_growth *growth, const scene_patch *g,
                                  const tl_source_info *dem, tl_error *error)
{
    *s = (simulation){.growth = growth, .around = dem->wraps ? dem->width : 0};
    set_exponent(s, NO_STEP);
    if (!growth->by_place)
        return TL_OK;
    s->delta = tl_alloc_grid((int64_t)g->window.width, (int64_t)g->window.height, sizeof *s->delta);
    s->hurst = tl_alloc_grid((int64_t)g->window.width, (int64_t)g->window.height, sizeof *s->hurst);
    if (!s->delta || !s->hurst)
        return tl_fail_memory(error, dem->name);
    return growth->by_place(growth->context, g->window, s->delta, s->hurst, error);
}

static void simulation_free(simulation *s)
{
    if (s) {
        free(s->delta);
        free(s->hurst);
    }
    free(s);
}

static double covariance_of(const simulation *s, int dx, int dy)
{
    return s->covariance[dy < 0 ? -dy : dy][dx < 0 ? -dx : dx];
}

/* The best guess with weights that add up to 1, by elimination; the system is that of the neighbours' covariances, with
 * a Lagrange multiplier. */
static void make_guess(const simulation *s, uint32_t mask, guess *out)
{
    double rows[NEIGHBOURS + 1][NEIGHBOURS + 2], right[NEIGHBOURS];
    int x[NEIGHBOURS], y[NEIGHBOURS], n = 0;
    for (int k = 0; k < NEIGHBOURS; k++)
        if (mask >> k & 1) {
            step_to(k, &x[n], &y[n]);
            n++;
        }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++)
            rows[i][j] = covariance_of(s, x[i] - x[j], y[i] - y[j]);
        rows[i][n] = rows[n][i] = 1;
        rows[i][n + 1] = right[i] = covariance_of(s, x[i], y[i]);
    }
    rows[n][n] = 0;
    rows[n][n + 1] = 1;
    for (int k = 0; k <= n; k++) {
        int pivot = k;
        for (int r = k + 1; r <= n; r++)
            pivot = fabs(rows[r][k]) > fabs(rows[pivot][k]) ? r : pivot;
        for (int c = k; c <= n + 1; c++) {
            double value = rows[k][c];
            rows[k][c] = rows[pivot][c];
            rows[pivot][c] = value;
        }
        for (int r = 0; r <= n; r++) {
            double factor = rows[r][k] / rows[k][k];
            for (int c = k; r != k && c <= n + 1; c++)
                rows[r][c] -= factor * rows[k][c];
        }
    }
    /* the variance of ordinary kriging: minus the weighted covariances and the multiplier, for K(0) = 0 */
    double variance = -rows[n][n + 1] / rows[n][n];
    *out = (guess){.mask = mask, .exponent = s->exponent};
    for (int i = 0; i < n; i++) {
        out->weights[i] = rows[i][n + 1] / rows[i][i];
        variance -= out->weights[i] * right[i];
    }
    out->deviation = variance > 0 ? sqrt(variance) : 0;
}

static const guess *find_guess(simulation *s, uint32_t mask, int exponent)
{
    guess *at = &s->cache[(mask ^ (uint32_t)exponent << 24) * 2654435761U >> 24];
    if (at->mask == mask && at->exponent == exponent)
        return at;
    if (s->exponent != exponent)
        set_exponent(s, exponent);
    make_guess(s, mask, at);
    return at;
}

static int64_t column_of(const simulation *s, const scene_patch *g, size_t k)
{
    int64_t i = g->window.i + (int64_t)(k % g->window.width);
    return s->around ? (i % s->around + s->around) % s->around : i;
}

/* The height of unknown sample k from its neighbours whose state is below `state`. NaN where there is none. */
static float simulate(simulation *s, const scene_patch *g, size_t k, int state)
{
    size_t width = g->window.width, x = k % width, y = k / width;
    double heights[NEIGHBOURS], sum = 0, deviation = 0;
    uint32_t mask = 0;
    int count = 0;
    for (int n = 0; n < NEIGHBOURS; n++) {
        int dx, dy;
        step_to(n, &dx, &dy);
        size_t x1 = x + (size_t)dx, y1 = y + (size_t)dy, at = y1 * width + x1;
        if (x1 >= width || y1 >= g->window.height || g->known[at] == SCENE_NOTHING || g->known[at] >= state)
            continue;
        mask |= (uint32_t)1 << n;
        heights[count++] = (double)g->heights[at];
    }
    if (!count)
        return NAN;
    double at = s->hurst ? (double)s->hurst[k] * EXPONENT_STEPS : 0;
    for (int side = 0; side < 2; side++) { /* the steps about the exponent; of none there is but one */
        double step = floor(at) + side, share = 1 - fabs(at - step);
        if (!(share > 0))
            continue;
        const guess *best = find_guess(s, mask, (int)step);
        for (int n = 0; n < count; n++)
            sum += share * (best->weights[n] * (heights[n] - heights[0]));
        deviation += share * best->deviation;
    }
    double delta = s->delta ? (double)s->delta[k] : s->growth->delta;
    float noise;
    fbm_noise_row(s->growth->seed, 0, FBM_NOISE_VERTICES, g->window.j + (int64_t)y, column_of(s, g, k), 1, &noise);
    return (float)(heights[0] + sum + delta * deviation * (double)noise);
}

/* ---- Rings ------------------------------------------------------------------------------------- */

/* Samples that are to be looked at, each once. */
typedef struct frontier {
    uint32_t *samples;
    size_t count;
} frontier;

/* Marks unknown neighbours of sample k as wanted, and adds them. */
static void add_unknown_neighbours(const scene_patch *g, size_t k, unsigned char *wanted, frontier *out)
{
    size_t width = g->window.width, x = k % width, y = k / width;
    for (int dy = -1; dy <= 1; dy++)
        for (int dx = -1; dx <= 1; dx++) {
            size_t x1 = x + (size_t)dx, y1 = y + (size_t)dy, at = y1 * width + x1;
            if (x1 >= width || y1 >= g->window.height || g->known[at] != UNKNOWN || wanted[at])
                continue;
            wanted[at] = 1;
            out->samples[out->count++] = (uint32_t)at;
        }
}

/* One ring, in four turns. */
static void simulate_ring(simulation *s, scene_patch *g, const frontier *ring, int pass)
{
    for (int parity = 0; parity < PARITIES; parity++)
        for (size_t i = 0; i < ring->count; i++) {
            size_t k = ring->samples[i];
            int64_t row = g->window.j + (int64_t)(k / g->window.width);
            if ((column_of(s, g, k) & 1) + 2 * (row & 1) != parity)
                continue;
            int state = FIRST_RING + PARITIES * pass + parity;
            float height = simulate(s, g, k, state);
            if (isfinite(height)) {
                g->heights[k] = height;
                g->known[k] = (unsigned char)state;
            }
        }
}

static void grow_ring(scene_growth growth, scene_patch *g, const frontier *ring, int state)
{
    for (size_t i = 0; i < ring->count; i++) {
        size_t k = ring->samples[i];
        float height = grow_sample(growth, g, k % g->window.width, k / g->window.width, state);
        if (isfinite(height)) {
            g->heights[k] = height;
            g->known[k] = (unsigned char)state;
        }
    }
}

/* Fills the unknown samples ring by ring; a pass sees only those before it, so the result does not depend on the order
 * of samples nor on where the window lies. `wanted` is one zero a sample, `rings` two of room for all. */
static void grow(scene_growth growth, simulation *s, scene_patch *g, unsigned char *wanted, frontier rings[2])
{
    size_t count = g->window.width * g->window.height;
    for (size_t k = 0; k < count; k++)
        if (g->known[k])
            add_unknown_neighbours(g, k, wanted, &rings[0]);
    for (int pass = 0; pass < growth.rings; pass++) {
        frontier *now = &rings[pass & 1], *next = &rings[~pass & 1];
        next->count = 0;
        if (s && pass < SIMULATED)
            simulate_ring(s, g, now, pass);
        else
            grow_ring(growth, g, now, FIRST_RING + (s ? PARITIES * SIMULATED : 0) + pass);
        for (size_t i = 0; i < now->count; i++)
            if (g->known[now->samples[i]])
                add_unknown_neighbours(g, now->samples[i], wanted, next);
    }
    /* nothing that is kept can see what is left; it only must not be NaN */
    for (size_t k = 0; k < count; k++)
        if (!g->known[k])
            g->heights[k] = 0;
}

static tl_status allocate(scene_patch *g, fbm_window w, bool with_known, const char *name, tl_error *error)
{
    *g = (scene_patch){.window = w};
    g->heights = tl_alloc_grid((int64_t)w.width, (int64_t)w.height, sizeof *g->heights);
    g->known = with_known ? tl_alloc_grid((int64_t)w.width, (int64_t)w.height, 1) : NULL;
    if (g->heights && (g->known || !with_known))
        return TL_OK;
    scene_patch_free(g);
    return tl_fail_memory(error, name);
}

/* Cuts the inner window `w` out of a wider ground. */
static void crop(const scene_patch *wide, scene_patch *g)
{
    fbm_window w = g->window;
    size_t dx = (size_t)(w.i - wide->window.i), dy = (size_t)(w.j - wide->window.j);
    for (size_t row = 0; row < w.height; row++) {
        size_t from = (dy + row) * wide->window.width + dx;
        memcpy(g->heights + row * w.width, wide->heights + from, w.width * sizeof *g->heights);
        memcpy(g->known + row * w.width, wide->known + from, w.width);
    }
}

/* Marks the samples of rows y0 ... y1 - 1 and columns x0 ... x1 - 1 that were filled; `x` is the first of these columns
 * in the model. */
static tl_status mark_filled_part(const tl_source *dem, scene_patch *g, int64_t x0, int64_t x1, int64_t x, int64_t y0,
                                  int64_t y1, tl_error *error)
{
    tl_window part = {x, y0, x1 - x0, y1 - y0};
    unsigned char *validity = tl_alloc_grid(part.width, part.height, 1);
    if (!validity)
        return tl_fail_memory(error, dem->info.name);
    tl_status status = tl_source_validity(dem, 0, part, validity, error);
    for (int64_t k = 0; status == TL_OK && k < part.width * part.height; k++) {
        size_t at =
            (size_t)(y0 + k / part.width - g->window.j) * g->window.width + (size_t)(x0 + k % part.width - g->window.i);
        if (validity[k] == TL_FILLED && g->known[at] == SCENE_MODEL)
            g->known[at] = SCENE_FILLED;
    }
    free(validity);
    return status;
}

static tl_status mark_filled(const tl_source *dem, scene_patch *g, tl_error *error)
{
    const tl_source_info *info = &dem->info;
    int64_t y0 = tl_int64_max(g->window.j, 0), y1 = tl_int64_min(g->window.j + (int64_t)g->window.height, info->height);
    int64_t x0 = g->window.i, x1 = g->window.i + (int64_t)g->window.width;
    if (!info->wraps) {
        x0 = tl_int64_max(x0, 0);
        x1 = tl_int64_min(x1, info->width);
    }
    tl_status status = TL_OK;
    for (int64_t n; x0 < x1 && y0 < y1 && status == TL_OK; x0 += n) { /* once, or around the globe */
        int64_t x = (x0 % info->width + info->width) % info->width;
        n = tl_int64_min(info->width - x, x1 - x0);
        status = mark_filled_part(dem, g, x0, x0 + n, x, y0, y1, error);
    }
    return status;
}

/* Reads a window with what is reflected, and tells what is known; UNKNOWN are voids. */
static tl_status read_known(const tl_source *dem, bool reflect, scene_patch *g, bool *all, tl_error *error)
{
    fbm_window w = g->window;
    tl_status status = reflect ? read_reflected(dem, w, g->heights, error) : read_ground(dem, w, g->heights, error);
    *all = true;
    for (size_t row = 0, k = 0; row < w.height && status == TL_OK; row++) {
        const int64_t y = w.j + (int64_t)row;
        const bool within = y >= 0 && y < dem->info.height;
        for (int64_t x = w.i; x < w.i + (int64_t)w.width; x++, k++) {
            bool model = within && (dem->info.wraps || (x >= 0 && x < dem->info.width));
            g->known[k] = isnan(g->heights[k]) ? UNKNOWN : model ? SCENE_MODEL : SCENE_BEYOND;
            *all = *all && g->known[k];
        }
    }
    return status == TL_OK && dem->validity ? mark_filled(dem, g, error) : status;
}

static tl_status grow_patch(scene_growth growth, scene_patch *g, const tl_source_info *dem, tl_error *error)
{
    simulation *s = growth.delta > 0 ? calloc(1, sizeof *s) : NULL;
    size_t count = g->window.width * g->window.height;
    unsigned char *wanted = calloc(count, 1);
    uint32_t *samples = count <= UINT32_MAX ? tl_alloc(count, 2 * sizeof *samples) : NULL;
    bool good = wanted && samples && (s || !(growth.delta > 0));
    tl_status status = good ? TL_OK : tl_fail_memory(error, dem->name);
    if (good && s)
        status = simulation_start(s, &growth, g, dem, error);
    if (status == TL_OK)
        grow(growth, s, g, wanted, (frontier[2]){{samples, 0}, {samples + count, 0}});
    free(wanted);
    free(samples);
    simulation_free(s);
    return status;
}

static tl_status read_with_rim(const tl_source *dem, scene_growth growth, fbm_window w, scene_patch *g, tl_error *error)
{
    const char *name = dem->info.name;
    bool all = false;
    if (growth.reflect || dem->validity) { /* without voids that is all */
        tl_status status = allocate(g, w, true, name, error);
        if (status == TL_OK)
            status = read_known(dem, growth.reflect, g, &all, error);
        if (status != TL_OK || all) {
            if (status != TL_OK)
                scene_patch_free(g);
            return status;
        }
        scene_patch_free(g);
    }
    /* every turn sees two cells beyond what it makes */
    int turns = growth.rings + (growth.delta > 0 ? (PARITIES - 1) * SIMULATED : 0);
    scene_patch wide;
    tl_status status = allocate(&wide, scene_widened(w, 2 * turns), true, name, error);
    if (status != TL_OK)
        return status;
    status = read_known(dem, growth.reflect, &wide, &all, error);
    if (status == TL_OK)
        status = grow_patch(growth, &wide, &dem->info, error);
    if (status == TL_OK)
        status = allocate(g, w, true, name, error);
    if (status == TL_OK)
        crop(&wide, g);
    scene_patch_free(&wide);
    return status;
}

static bool all_known(const float *heights, size_t count)
{
    for (size_t k = 0; k < count; k++)
        if (isnan(heights[k]))
            return false;
    return true;
}

tl_status scene_patch_read(const tl_source *dem, scene_growth growth, fbm_window w, scene_patch *g, tl_error *error)
{
    if (inside(&dem->info, w)) {
        tl_status status = allocate(g, w, false, dem->info.name, error);
        if (status == TL_OK)
            status = read_ground(dem, w, g->heights, error);
        if (status == TL_OK && !dem->validity && all_known(g->heights, w.width * w.height))
            return status;
        scene_patch_free(g);
        if (status != TL_OK)
            return status;
    }
    return read_with_rim(dem, growth, w, g, error);
}

/* ---- Recalling ---- */

typedef struct making {
    const tl_source *dem;
    scene_growth growth;
} making;

/* A sample as a number that is only ever copied: its height, and what is known of it. */
static tl_status make_packed(const void *context, fbm_window window, double *out, tl_error *error)
{
    const making *of = context;
    scene_patch patch;
    tl_status status = scene_patch_read(of->dem, of->growth, window, &patch, error);
    if (status != TL_OK)
        return status;
    for (size_t k = 0; k < window.width * window.height; k++) {
        uint64_t known = patch.known ? patch.known[k] : SCENE_MODEL;
        uint32_t height;
        memcpy(&height, &patch.heights[k], sizeof height);
        const uint64_t both = known << 32 | height;
        memcpy(&out[k], &both, sizeof both);
    }
    scene_patch_free(&patch);
    return TL_OK;
}

/* Fills a patch; whether all of it is the model's own. */
static bool unpack(const double *numbers, fbm_window of, scene_patch *out)
{
    const fbm_window w = out->window;
    const double *from = numbers + (size_t)(w.j - of.j) * of.width + (size_t)(w.i - of.i);
    bool all = true;
    for (size_t row = 0, k = 0; row < w.height; row++)
        for (size_t column = 0; column < w.width; column++, k++) {
            uint64_t both;
            memcpy(&both, &from[row * of.width + column], sizeof both);
            const uint32_t height = (uint32_t)both;
            memcpy(&out->heights[k], &height, sizeof height);
            out->known[k] = (unsigned char)(both >> 32);
            all = all && out->known[k] == SCENE_MODEL;
        }
    return all;
}

tl_status scene_patch_recall(scene_cell_store *kept, const tl_source *dem, scene_growth growth, fbm_window w,
                             scene_patch *g, tl_error *error)
{
    const making of = {dem, growth};
    w.stride = w.width;
    if (inside(&dem->info, w) && !dem->info.has_voids && !dem->validity)
        return scene_patch_read(dem, growth, w, g, error);
    const fbm_window wide = scene_cell_store_window(w);
    double *numbers = tl_alloc_grid((int64_t)wide.width, (int64_t)wide.height, sizeof *numbers);
    *g = (scene_patch){.window = w};
    tl_status status = numbers ? allocate(g, w, true, dem->info.name, error) : tl_fail_memory(error, dem->info.name);
    if (status == TL_OK)
        status = scene_cell_store_read(kept, wide, make_packed, &of, numbers, dem->info.name, error);
    if (status != TL_OK)
        scene_patch_free(g);
    else if (unpack(numbers, wide, g)) {
        free(g->known);
        g->known = NULL;
    }
    free(numbers);
    return status;
}
