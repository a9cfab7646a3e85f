#include "lib/scene/terrain.h"

#include "fbm/elementary.h"
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

enum {
    SPOTS = 8,        /* on a side: windows of the raster that stand for all of it */
    SPOT_CELLS = 128, /* on a side of a spot that is measured */
    SPOT_CHILDREN = 64,
    CALIBRATED = 4, /* octaves; below, the numbers of the last are taken */
    /* Rings of made-up samples around the raster: a child sees 9 cells of its parents, 9/2 of theirs, and so on. */
    RINGS = 20,
};

/* Energies less than this share of the mean count as this: the detail of plains. */
static const double FLOOR = .002;

/* ---- Making a window ---- */

/* The energies of a patch's inner window, mean 1, where samples are known; 1 where nothing is. */
static void normalise_energy(const scene_terrain *t, float *energy, size_t count)
{
    const float per = t->mean_energy > 0 ? (float)(1 / t->mean_energy) : 0, noise = (float)t->noise_energy;
    for (size_t k = 0; k < count; k++) {
        float share = (energy[k] - noise) * per;
        energy[k] = isnan(energy[k]) || per == 0 || t->without & SCENE_TERRAIN_PLACE ? 1
                    : share > (float)FLOOR                                           ? share
                                                                                     : (float)FLOOR;
    }
}

/* Makes what was not measured NaN in a copy, and measures energies on it: a filled void is as rough as its
 * surroundings, or where they are far, as the mean. */
static tl_status patch_energy(const scene_terrain *t, const scene_patch *patch, fbm_window window, float *out,
                              const char *name, tl_error *error)
{
    size_t samples = patch->window.width * patch->window.height;
    float *heights = patch->known ? tl_alloc(samples, sizeof *heights) : patch->heights;
    float *scratch = tl_alloc(fbm_energy_scratch(window.width, window.height), sizeof *scratch);
    tl_status status = heights && scratch ? TL_OK : tl_fail_memory(error, name);
    if (status == TL_OK) {
        for (size_t k = 0; patch->known && k < samples; k++)
            heights[k] = patch->known[k] == SCENE_MODEL ? patch->heights[k] : NAN;
        fbm_relief_energy(heights, patch->window, out, window, scratch);
        normalise_energy(t, out, window.width * window.height);
    }
    free(scratch);
    if (patch->known)
        free(heights);
    return status;
}

/* Heights and energies of a window of some level. */
typedef struct layer {
    fbm_window window;
    float *heights, *energy; /* and slacks behind the energies */
} layer;

static tl_status layer_init(layer *l, fbm_window window, const char *name, tl_error *error)
{
    size_t samples;
    *l = (layer){.window = window};
    bool fits = tl_size_mul(window.width, window.height, &samples);
    l->heights = fits ? tl_alloc(samples, 3 * sizeof(float)) : NULL;
    l->energy = l->heights ? l->heights + samples : NULL;
    return l->heights ? TL_OK : tl_fail_memory(error, name);
}

/* What was filled is not as level as it looks: there the slopes of the steeper half are taken for its own. */
static void set_slacks(const scene_terrain *t, const scene_patch *patch, fbm_window window, float *out)
{
    for (size_t r = 0; r < window.height; r++)
        for (size_t c = 0; c < window.width; c++) {
            size_t at = (r + (size_t)(window.j - patch->window.j)) * patch->window.width + c +
                        (size_t)(window.i - patch->window.i);
            out[r * window.width + c] = patch->known && patch->known[at] == SCENE_FILLED ? t->filled_slope2 : 0;
        }
}

typedef struct making {
    const scene_terrain *terrain;
    const tl_source *dem;
} making;

static tl_status make_energies(const void *context, fbm_window window, double *out, tl_error *error)
{
    const making *of = context;
    const char *name = of->dem->info.name;
    const size_t count = window.width * window.height;
    scene_patch patch;
    tl_status status = scene_patch_recall(of->terrain->kept_patches, of->dem, of->terrain->growth,
                                          scene_widened(window, FBM_ENERGY_MARGIN), &patch, error);
    if (status != TL_OK)
        return status;
    float *energy = tl_alloc(count, sizeof *energy);
    status = energy ? patch_energy(of->terrain, &patch, window, energy, name, error) : tl_fail_memory(error, name);
    for (size_t k = 0; status == TL_OK && k < count; k++)
        out[k] = (double)energy[k];
    free(energy);
    scene_patch_free(&patch);
    return status;
}

static tl_status recall_energies(const scene_terrain *t, const tl_source *dem, fbm_window window, float *out,
                                 tl_error *error)
{
    const making of = {t, dem};
    const fbm_window wide = scene_cell_store_window(window);
    double *numbers = tl_alloc_grid((int64_t)wide.width, (int64_t)wide.height, sizeof *numbers);
    if (!numbers)
        return tl_fail_memory(error, dem->info.name);
    tl_status status =
        scene_cell_store_read(t->kept_energies, wide, make_energies, &of, numbers, dem->info.name, error);
    const double *from = numbers + (size_t)(window.j - wide.j) * wide.width + (size_t)(window.i - wide.i);
    for (size_t r = 0; status == TL_OK && r < window.height; r++)
        for (size_t c = 0; c < window.width; c++)
            out[r * window.width + c] = (float)from[r * wide.width + c];
    free(numbers);
    return status;
}

/* The patch of a window; where nothing is kept, FBM_ENERGY_MARGIN more. */
static tl_status read_patch(const scene_terrain *t, const tl_source *dem, fbm_window window, scene_patch *out,
                            tl_error *error)
{
    if (t->kept_energies)
        return scene_patch_recall(t->kept_patches, dem, t->growth, window, out, error);
    return scene_patch_read(dem, t->growth, scene_widened(window, FBM_ENERGY_MARGIN), out, error);
}

/* Level 0 of a window. */
static tl_status layer_read(const scene_terrain *t, const tl_source *dem, fbm_window window, layer *l,
                            scene_patch *patch, tl_error *error)
{
    tl_status status = read_patch(t, dem, window, patch, error);
    if (status != TL_OK)
        return status;
    status = layer_init(l, window, dem->info.name, error);
    if (status == TL_OK)
        status = t->kept_energies ? recall_energies(t, dem, window, l->energy, error)
                                  : patch_energy(t, patch, window, l->energy, dem->info.name, error);
    if (status == TL_OK)
        set_slacks(t, patch, window, l->energy + window.width * window.height);
    const float *from = patch->heights + (size_t)(window.j - patch->window.j) * patch->window.width +
                        (size_t)(window.i - patch->window.i);
    for (size_t r = 0; status == TL_OK && r < window.height; r++)
        memcpy(l->heights + r * window.width, from + r * patch->window.width, window.width * sizeof *l->heights);
    return status;
}

/* Replaces a layer by a window of its children. */
static tl_status layer_refine(const fbm_relief_step *step, layer *l, fbm_window children, const char *name,
                              tl_error *error)
{
    layer finer;
    tl_status status = layer_init(&finer, children, name, error);
    float *scratch = tl_alloc(fbm_relief_scratch(children.width), sizeof *scratch);
    if (status == TL_OK && !scratch)
        status = tl_fail_memory(error, name);
    if (status == TL_OK) {
        fbm_relief_refine(step, l->heights, l->energy, l->window, finer.heights, finer.energy, children, scratch);
        free(l->heights);
        *l = finer;
    } else
        free(finer.heights);
    free(scratch);
    return status;
}

/* windows[l]: what level l must hold so that `window` of `level` can be made. */
static void plan(fbm_window *windows, int level, fbm_window window)
{
    window.stride = window.width;
    windows[level] = window;
    for (; level > 0; level--)
        windows[level - 1] = fbm_relief_support(windows[level]);
}

/* Makes levels 1 ... `level` of a plan, from level 0 on. */
static tl_status descend(const scene_terrain *t, const tl_source *dem, const fbm_window *windows, int level, layer *l,
                         scene_patch *patch, tl_error *error)
{
    tl_status status = layer_read(t, dem, windows[0], l, patch, error);
    for (int k = 0; k < level && status == TL_OK; k++)
        status = layer_refine(&t->steps[k], l, windows[k + 1], dem->info.name, error);
    return status;
}

tl_status scene_terrain_read(const scene_terrain *t, const tl_source *dem, int level, fbm_window window, float *out,
                             scene_patch *patch, tl_error *error)
{
    fbm_window windows[SCENE_LEVEL_MAX + 1], target = window;
    plan(windows, level, window);
    layer l = {.heights = NULL};
    scene_patch ground = {.heights = NULL};
    tl_status status = descend(t, dem, windows, level - 1, &l, &ground, error);
    float *scratch = tl_alloc(fbm_relief_scratch(window.width), sizeof *scratch);
    if (status == TL_OK && !scratch)
        status = tl_fail_memory(error, dem->info.name);
    if (status == TL_OK)
        fbm_relief_refine(&t->steps[level - 1], l.heights, l.energy, l.window, out, NULL, target, scratch);
    free(scratch);
    free(l.heights);
    if (status == TL_OK && patch)
        *patch = ground;
    else
        scene_patch_free(&ground);
    return status;
}

/* ---- Measuring ---- */

/* Windows of at most `side` that stand for the raster: a grid of them, which covers it where it is small. */
typedef struct spots {
    int64_t columns, rows, width, height;
} spots;

static spots choose_spots(int64_t width, int64_t height, int64_t side)
{
    return (spots){tl_int64_min(SPOTS, tl_div_up(width, side)), tl_int64_min(SPOTS, tl_div_up(height, side)),
                   tl_int64_min(width, side), tl_int64_min(height, side)};
}

/* The window of spot `index`, of `width` x `height` units of 1 / scale of a cell, in such units; it begins at an even
 * one. */
static fbm_window spot_window(const tl_source_info *dem, const spots *s, uint64_t index, int64_t scale, int64_t width,
                              int64_t height)
{
    int64_t column = (int64_t)index % s->columns, row = (int64_t)index / s->columns;
    int64_t x = (2 * column + 1) * (dem->width * scale) / (2 * s->columns) - width / 2;
    int64_t y = (2 * row + 1) * (dem->height * scale) / (2 * s->rows) - height / 2;
    fbm_window w = {x - (x & 1), y - (y & 1), (size_t)width, (size_t)height, (size_t)width};
    return w;
}

/* Sums over the cells of a spot, or under its children: of energies (mean 1), of square slopes and of the square
 * amplitudes of each octave. */
typedef struct spot_sums {
    double energy, cell_slope2, amplitudes[CALIBRATED];
    uint64_t cells;
    double slope2[4], slope_count; /* of the predictions from the means of every offset */
    fbm_relief_fit fit;
    fbm_relief_sums sums;
} spot_sums;

typedef struct survey {
    scene_terrain *terrain;
    const tl_source *dem;
    spots spots;
    double shares[2]; /* mean squares of the x and y details */
    double steep, slope_rms;
    int octave;
    fbm_slopes *slopes; /* by worker */
    spot_sums *each;    /* by spot */
} survey;

/* Slope to the cells beside, squared. */
static double cell_slope2(const survey *s, const layer *l, size_t at)
{
    const float *z = l->heights + at;
    const fbm_relief_step *step = &s->terrain->steps[0];
    double x = ((double)z[1] - (double)z[-1]) / (4 * (double)step->children_x);
    double y = ((double)z[l->window.width] - (double)z[-(ptrdiff_t)l->window.width]) / (4 * (double)step->children_y);
    return x * x + y * y;
}

static double amplitude2(double energy, double slope2, double limit)
{
    return slope2 > 0 ? energy * slope2 / (slope2 + limit * energy) : 0;
}

/* Adds energies and amplitudes of the known cells that lie at least a cell inside of the layer. */
static void add_amplitudes(const survey *s, const layer *l, const scene_patch *patch, int first, int last,
                           spot_sums *sums)
{
    for (size_t r = 1; r + 1 < l->window.height; r++)
        for (size_t c = 1; c + 1 < l->window.width; c++) {
            size_t at = r * l->window.width + c;
            if (!scene_patch_known(patch, l->window.i + (int64_t)c, l->window.j + (int64_t)r))
                continue;
            double slope2 = cell_slope2(s, l, at), e = (double)l->energy[at];
            for (int k = first; k <= last; k++)
                sums->amplitudes[k] += amplitude2(e, slope2, (double)s->terrain->steps[k].limit);
            sums->energy += e;
            sums->cell_slope2 += slope2;
            sums->cells++;
        }
}

static tl_status survey_amplitudes(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const survey *s = context;
    spot_sums *sums = &s->each[item];
    fbm_window window = spot_window(&s->dem->info, &s->spots, item, 1, s->spots.width, s->spots.height);
    layer l = {.heights = NULL};
    scene_patch patch = {.heights = NULL};
    tl_status status = layer_read(s->terrain, s->dem, scene_widened(window, 1), &l, &patch, error);
    if (status == TL_OK)
        add_amplitudes(s, &l, &patch, 0, CALIBRATED - 1, sums);
    free(l.heights);
    scene_patch_free(&patch);
    return status;
}

/* The means of 2 x 2 samples of a patch at even distances from (i, j), for a window of them. */
static void block_means(const scene_patch *p, int64_t i, int64_t j, fbm_window blocks, float *out)
{
    for (size_t r = 0; r < blocks.height; r++)
        for (size_t c = 0; c < blocks.width; c++) {
            int64_t x = i + 2 * (blocks.i + (int64_t)c) - p->window.i,
                    y = j + 2 * (blocks.j + (int64_t)r) - p->window.j;
            const float *z = p->heights + (size_t)y * p->window.width + (size_t)x;
            out[r * blocks.width + c] = .25f * ((z[0] + z[1]) + (z[p->window.width] + z[p->window.width + 1]));
        }
}

/* Both passes of the fit need, for a spot and an offset of its blocks, the means around. */
typedef struct spot_means {
    scene_patch patch;
    fbm_window children; /* the samples of the spot's blocks, counted from the first */
    fbm_window window;   /* of the means */
    float *means, *scratch;
    int64_t x, y; /* of the first sample, at offset 0 */
} spot_means;

static void spot_means_finish(spot_means *m)
{
    scene_patch_free(&m->patch);
    free(m->means);
    free(m->scratch);
}

static tl_status spot_means_init(const survey *s, uint64_t item, spot_means *m, tl_error *error)
{
    const char *name = s->dem->info.name;
    fbm_window spot = spot_window(&s->dem->info, &s->spots, item, 1, s->spots.width, s->spots.height);
    size_t width = (spot.width - 1) / 2 * 2, height = (spot.height - 1) / 2 * 2; /* at every offset */
    *m = (spot_means){.children = {0, 0, width, height, width}, .x = spot.i, .y = spot.j};
    if (width == 0 || height == 0)
        return TL_OK;
    m->window = fbm_relief_support(m->children);
    m->means = tl_alloc_grid((int64_t)m->window.width, (int64_t)m->window.height, sizeof *m->means);
    m->scratch = tl_alloc(fbm_relief_scratch(width), sizeof *m->scratch);
    if (!m->means || !m->scratch)
        return tl_fail_memory(error, name);
    return scene_patch_read(s->dem, s->terrain->growth, scene_widened(spot, 2 * FBM_RELIEF_MARGIN + 2), &m->patch,
                            error);
}

/* The refinement of the means: a step whose parents are 2 x 2 samples. */
static fbm_relief_step means_step(const survey *s)
{
    const fbm_relief_step *finest = &s->terrain->steps[0];
    fbm_relief_step step = {.children_x = 2 * finest->children_x, .children_y = 2 * finest->children_y};
    step.level = 4 * step.children_x * step.children_y / 5;
    step.level_slope = (float)s->slope_rms;
    return step;
}

static tl_status survey_slopes(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    const survey *s = context;
    spot_means m;
    tl_status status = spot_means_init(s, item, &m, error);
    const fbm_relief_step step = means_step(s);
    for (int offset = 0; offset < 4 && status == TL_OK && m.means; offset++) {
        block_means(&m.patch, m.x + offset % 2, m.y + offset / 2, m.window, m.means);
        fbm_slopes *slopes = &s->slopes[worker];
        slopes->sum = 0;
        fbm_relief_add_slopes(&step, m.means, m.window, m.children, m.scratch, slopes);
        s->each[item].slope2[offset] = slopes->sum;
        s->each[item].slope_count += (double)(m.children.width * m.children.height);
    }
    spot_means_finish(&m);
    return status;
}

static tl_status survey_fit(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const survey *s = context;
    spot_means m;
    tl_status status = spot_means_init(s, item, &m, error);
    const fbm_relief_step step = means_step(s);
    for (int offset = 0; offset < 4 && status == TL_OK && m.means; offset++) {
        int64_t i = m.x + offset % 2, j = m.y + offset / 2;
        block_means(&m.patch, i, j, m.window, m.means);
        fbm_window children = m.children;
        children.stride = m.patch.window.width;
        const float *samples =
            m.patch.heights + (size_t)(j - m.patch.window.j) * m.patch.window.width + (size_t)(i - m.patch.window.i);
        fbm_relief_add_fit(&step, m.means, m.window, samples, children, s->shares, s->steep, m.scratch,
                           &s->each[item].fit);
    }
    spot_means_finish(&m);
    return status;
}

static double median_of_workers(fbm_slopes *slopes, unsigned workers)
{
    for (unsigned w = 1; w < workers; w++) {
        slopes[0].count += slopes[w].count;
        for (int b = 0; b < FBM_SLOPE_BINS; b++)
            slopes[0].bins[b] += slopes[w].bins[b];
    }
    double median = fbm_slopes_median(&slopes[0]);
    memset(slopes, 0, workers * sizeof *slopes);
    return median;
}

static double clamp(double x, double low, double high)
{
    return x < low ? low : x > high ? high : x;
}

/* How the finest details go with the slope. */
static tl_status fit_slopes(survey *s, const tl_run *run, tl_error *error)
{
    uint64_t count = (uint64_t)(s->spots.columns * s->spots.rows);
    unsigned workers = tl_parallel_workers(run, count);
    tl_status status = tl_parallel_for(run, count, 0, survey_slopes, s, error);
    if (status != TL_OK)
        return status;
    double sum = 0, samples = 0;
    for (uint64_t i = 0; i < count; i++) {
        for (int offset = 0; offset < 4; offset++)
            sum += s->each[i].slope2[offset];
        samples += s->each[i].slope_count;
    }
    s->slope_rms = samples > 0 ? sqrt(sum / samples) : 0;
    s->steep = median_of_workers(s->slopes, workers);
    s->terrain->filled_slope2 = (float)fmin(4 * s->steep, 1e15);
    status = tl_parallel_for(run, count, 0, survey_fit, s, error);
    fbm_relief_fit fit = {0};
    for (uint64_t i = 0; status == TL_OK && i < count; i++) {
        const fbm_relief_fit *each = &s->each[i].fit;
        fit.stretch += each->stretch;
        fit.energy += each->energy;
        fit.levelled += each->levelled;
        fit.levelling2 += each->levelling2;
    }
    s->terrain->steering = fit.energy > 0 && isfinite(fit.stretch) ? clamp(fit.stretch / fit.energy, -.4, .6) : 0;
    s->terrain->levelling =
        fit.levelling2 > 0 && isfinite(fit.levelled) ? clamp(fit.levelled / fit.levelling2, 0, .4) : 0;
    return status;
}

/* ---- Calibrating ---- */

static tl_status calibrate_slopes(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    const survey *s = context;
    fbm_window windows[SCENE_LEVEL_MAX + 1];
    fbm_window children =
        spot_window(&s->dem->info, &s->spots, item, INT64_C(2) << s->octave, s->spots.width, s->spots.height);
    plan(windows, s->octave + 1, children);
    layer l = {.heights = NULL};
    scene_patch patch = {.heights = NULL};
    tl_status status = descend(s->terrain, s->dem, windows, s->octave, &l, &patch, error);
    float *scratch = tl_alloc(fbm_relief_scratch(children.width), sizeof *scratch);
    if (status == TL_OK && !scratch)
        status = tl_fail_memory(error, s->dem->info.name);
    if (status == TL_OK) {
        fbm_slopes *slopes = &s->slopes[worker];
        slopes->sum = 0;
        fbm_relief_add_slopes(&s->terrain->steps[s->octave], l.heights, l.window, children, scratch, slopes);
        s->each[item].slope2[0] = slopes->sum;
        s->each[item].slope_count = (double)(children.width * children.height);
    }
    free(scratch);
    free(l.heights);
    scene_patch_free(&patch);
    return status;
}

/* The cells of level 0 that a spot's children lie in. */
static fbm_window cells_under(fbm_window children, int level)
{
    int64_t x0 = children.i >> level, y0 = children.j >> level;
    int64_t x1 = ((children.i + (int64_t)children.width - 1) >> level) + 1;
    int64_t y1 = ((children.j + (int64_t)children.height - 1) >> level) + 1;
    return (fbm_window){x0, y0, (size_t)(x1 - x0), (size_t)(y1 - y0), (size_t)(x1 - x0)};
}

static tl_status calibrate_sums(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const survey *s = context;
    fbm_window windows[SCENE_LEVEL_MAX + 1];
    fbm_window children =
        spot_window(&s->dem->info, &s->spots, item, INT64_C(2) << s->octave, s->spots.width, s->spots.height);
    plan(windows, s->octave + 1, children);
    layer l = {.heights = NULL}, ground = {.heights = NULL};
    scene_patch patch = {.heights = NULL}, under = {.heights = NULL};
    tl_status status = descend(s->terrain, s->dem, windows, s->octave, &l, &patch, error);
    float *scratch = tl_alloc(fbm_relief_scratch(children.width), sizeof *scratch);
    if (status == TL_OK && !scratch)
        status = tl_fail_memory(error, s->dem->info.name);
    spot_sums *sums = &s->each[item];
    if (status == TL_OK) {
        fbm_relief_add_sums(&s->terrain->steps[s->octave], l.heights, l.energy, l.window, children, scratch,
                            &sums->sums);
        status = layer_read(s->terrain, s->dem, scene_widened(cells_under(children, s->octave + 1), 1), &ground, &under,
                            error);
    }
    if (status == TL_OK)
        add_amplitudes(s, &ground, &under, s->octave, s->octave, sums);
    free(scratch);
    free(l.heights);
    free(ground.heights);
    scene_patch_free(&patch);
    scene_patch_free(&under);
    return status;
}

/* Mean square details of the noise per square amplitude, and those of the levelling. */
typedef struct response {
    double noise[3], levelling[3];
} response;

static response gather_response(const survey *s, uint64_t count)
{
    fbm_relief_sums sum = {{0}, {0}, 0};
    double amplitude = 0;
    uint64_t cells = 0;
    for (uint64_t i = 0; i < count; i++) {
        const spot_sums *each = &s->each[i];
        for (int d = 0; d < 3; d++) {
            sum.noise[d] += each->sums.noise[d];
            sum.levelling[d] += each->sums.levelling[d];
        }
        sum.count += each->sums.count;
        amplitude += each->amplitudes[s->octave];
        cells += each->cells;
    }
    response r = {{0}, {0}};
    if (!(amplitude > 0) || !sum.count)
        return r;
    for (int d = 0; d < 3; d++) {
        r.noise[d] = sum.noise[d] / (double)sum.count * ((double)cells / amplitude);
        r.levelling[d] = sum.levelling[d] / (double)sum.count;
    }
    return r;
}

static tl_status calibrate_octave(survey *s, int octave, const tl_run *run, response *out, tl_error *error)
{
    int64_t scale = INT64_C(2) << octave;
    s->spots = choose_spots(s->dem->info.width * scale, s->dem->info.height * scale, SPOT_CHILDREN);
    s->octave = octave;
    uint64_t count = (uint64_t)(s->spots.columns * s->spots.rows);
    unsigned workers = tl_parallel_workers(run, count);
    memset(s->each, 0, SPOTS * SPOTS * sizeof *s->each);
    tl_status status = tl_parallel_for(run, count, 0, calibrate_slopes, s, error);
    if (status != TL_OK)
        return status;
    double sum = 0, samples = 0;
    for (uint64_t i = 0; i < count; i++) {
        sum += s->each[i].slope2[0];
        samples += s->each[i].slope_count;
    }
    fbm_relief_step *step = &s->terrain->steps[octave];
    step->level_slope = (float)sqrt(sum / samples);
    step->steer_slope2 = (float)median_of_workers(s->slopes, workers);
    status = tl_parallel_for(run, count, 0, calibrate_sums, s, error);
    if (status == TL_OK)
        *out = gather_response(s, count);
    return status;
}

/* Shares of an octave's variance in its x, y and mixed details: of cells that are longer one way, and of terrain that
 * has more detail one way. */
static void share_out(double hurst, double log_aspect, double excess, double shares[3])
{
    double ratio = fbm_exp2(2 * (.70 + .815 * hurst) * log_aspect + excess);
    double mixed = fmax(.50 - .135 * hurst, 0) * sqrt(ratio), sum = 1 + ratio + mixed;
    shares[0] = ratio / sum;
    shares[1] = 1 / sum;
    shares[2] = mixed / sum;
}

static void set_gains(fbm_relief_step *step, const response *r, double amplitude, double variance,
                      const double shares[3])
{
    for (int d = 0; d < 3; d++) {
        double wanted = variance * shares[d] - r->levelling[d], unit = r->noise[d] * amplitude;
        step->gains[d] = wanted > 0 && unit > 0 ? (float)sqrt(wanted / unit) : 0;
    }
}

/* What of every step follows from the octaves alone. */
static void set_geometry(scene_terrain *t, const tl_source *dem, const scene_octave *octaves, int levels, uint64_t seed)
{
    const tl_georef *g = &dem->info.georef;
    double x = g->cell_x / g->height_unit, y = g->cell_y / g->height_unit, fading = 1;
    const double steering = t->without & SCENE_TERRAIN_STEER ? 0 : t->steering;
    const double levelling = t->without & SCENE_TERRAIN_SLOPES ? 0 : t->levelling;
    const double limit = t->without & SCENE_TERRAIN_LEVEL ? 0 : 16;
    for (int l = 0; l < levels; l++, x /= 2, y /= 2, fading *= .85) {
        fbm_relief_step *step = &t->steps[l];
        *step = (fbm_relief_step){.children_x = (float)(x / 2),
                                  .children_y = (float)(y / 2),
                                  .steer = (float)(4 * steering * fading),
                                  .level = (float)(x * y / 5 * levelling * fading),
                                  .limit = (float)(limit * octaves[l].sigma * octaves[l].sigma / (x * y)),
                                  .seed = seed,
                                  .octave = l,
                                  .slack = dem->validity != NULL,
                                  .pits = (t->without & SCENE_TERRAIN_PITS) != 0,
                                  .period = dem->info.wraps ? dem->info.width << l : 0};
    }
}

/* Mean square amplitude of an octave over the raster, for energies of mean 1. */
static double mean_amplitude(const survey *s, uint64_t count, int octave)
{
    double amplitude = 0, energy = 0;
    for (uint64_t i = 0; i < count; i++) {
        amplitude += s->each[i].amplitudes[octave];
        energy += s->each[i].energy;
    }
    return energy > 0 ? amplitude / energy : 0;
}

static tl_status calibrate(survey *s, const scene_detail *detail, const scene_octave *octaves, int levels,
                           const tl_run *run, tl_error *error)
{
    const tl_georef *g = &s->dem->info.georef;
    double log_aspect = fbm_log2(g->cell_x / g->cell_y), hurst = scene_roughness_of(detail, g).hurst;
    double excess = 0, means[CALIBRATED];
    if (s->shares[0] > 0 && s->shares[1] > 0)
        excess = fbm_log2(s->shares[0] / s->shares[1]) - 2 * (.70 + .815 * hurst) * log_aspect;
    uint64_t count = (uint64_t)(s->spots.columns * s->spots.rows);
    tl_status status = tl_parallel_for(run, count, 0, survey_amplitudes, s, error);
    for (int l = 0; l < CALIBRATED; l++)
        means[l] = mean_amplitude(s, count, l);
    response r = {{0}, {0}};
    for (int l = 0; l < levels && status == TL_OK; l++) {
        fbm_relief_step *step = &s->terrain->steps[l];
        excess *= .7;
        if (l < CALIBRATED)
            status = calibrate_octave(s, l, run, &r, error);
        else {
            step->level_slope = step[-1].level_slope;
            step->steer_slope2 = step[-1].steer_slope2;
            for (int d = 0; d < 3; d++)
                r.levelling[d] /= 16; /* it is in square cells */
        }
        double shares[3], sigma = octaves[l].sigma;
        share_out(octaves[l].hurst, log_aspect, excess, shares);
        set_gains(step, &r, means[l < CALIBRATED ? l : CALIBRATED - 1], sigma * sigma, shares);
    }
    return status;
}

/* What is known before a survey. */
static survey begin_survey(const tl_source *dem, const scene_detail *detail, scene_terrain *t)
{
    const fbm_detail *finest = &detail->octaves[0];
    double blocks = finest->count ? (double)finest->count : 1;
    *t = (scene_terrain){.growth = {.rings = RINGS, .trend = .9f, .reflect = true}};
    t->mean_energy = fbm_detail_variance(finest, 0, detail->noise);
    t->noise_energy = (finest->x + finest->y + finest->mixed) / blocks - t->mean_energy;
    survey s = {.terrain = t, .dem = dem, .spots = choose_spots(dem->info.width, dem->info.height, SPOT_CELLS)};
    s.shares[0] = finest->x / blocks;
    s.shares[1] = finest->y / blocks;
    return s;
}

tl_status scene_terrain_measure(const tl_source *dem, const scene_detail *detail, const scene_octave *octaves,
                                int levels, uint64_t seed, unsigned without, const tl_run *run, scene_terrain *out,
                                tl_error *error)
{
    survey s = begin_survey(dem, detail, out);
    out->without = without;
    set_geometry(out, dem, octaves, levels > CALIBRATED ? levels : CALIBRATED, seed);
    tl_run quiet = run ? *run : (tl_run){0};
    quiet.progress = NULL; /* the reading before took the time */
    unsigned workers = tl_parallel_workers(run, SPOTS * SPOTS);
    s.slopes = calloc(workers, sizeof *s.slopes);
    s.each = calloc(SPOTS * SPOTS, sizeof *s.each);
    tl_status status = s.slopes && s.each ? TL_OK : tl_fail_memory(error, dem->info.name);
    if (status == TL_OK && s.shares[0] > 0 && s.shares[1] > 0)
        status = fit_slopes(&s, &quiet, error);
    if (status == TL_OK) {
        set_geometry(out, dem, octaves, levels > CALIBRATED ? levels : CALIBRATED, seed);
        status = calibrate(&s, detail, octaves, levels, &quiet, error);
    }
    free(s.slopes);
    free(s.each);
    return status;
}

/* ---- Strengths alone ---- */

tl_status scene_terrain_measure_strengths(const tl_source *dem, const scene_detail *detail, const scene_octave *octaves,
                                          const tl_run *run, scene_terrain *out, tl_error *error)
{
    survey s = begin_survey(dem, detail, out);
    set_geometry(out, dem, octaves, CALIBRATED, 0);
    tl_run quiet = run ? *run : (tl_run){0};
    quiet.progress = NULL;
    uint64_t count = (uint64_t)(s.spots.columns * s.spots.rows);
    s.each = calloc(count, sizeof *s.each);
    if (!s.each)
        return tl_fail_memory(error, dem->info.name);
    tl_status status = tl_parallel_for(&quiet, count, 0, survey_amplitudes, &s, error);
    out->mean_amplitude = mean_amplitude(&s, count, 0);
    double slope2 = 0, cells = 0;
    for (uint64_t i = 0; i < count; i++) {
        slope2 += s.each[i].cell_slope2;
        cells += (double)s.each[i].cells;
    }
    out->filled_slope2 = cells > 0 ? (float)fmin(slope2 / cells, 1e15) : 0;
    free(s.each);
    return status;
}

tl_status scene_terrain_strengths(const scene_terrain *t, const scene_patch *patch, fbm_window window, float *out,
                                  const char *name, tl_error *error)
{
    tl_status status = patch_energy(t, patch, window, out, name, error);
    const fbm_relief_step *step = &t->steps[0];
    const float per_x = 1 / (4 * step->children_x), per_y = 1 / (4 * step->children_y), limit = step->limit;
    const float per_mean = t->mean_amplitude > 0 ? (float)(1 / t->mean_amplitude) : 0;
    const size_t stride = patch->window.width, x0 = (size_t)(window.i - patch->window.i);
    for (size_t r = 0; r < window.height && status == TL_OK; r++) {
        const float *z = patch->heights + (r + (size_t)(window.j - patch->window.j)) * stride + x0;
        const unsigned char *known = patch->known ? patch->known + (z - patch->heights) : NULL;
        float *row = out + r * window.width;
        for (size_t c = 0; c < window.width; c++) {
            float x = (z[c + 1] - z[(ptrdiff_t)c - 1]) * per_x,
                  y = (z[c + stride] - (z + c)[-(ptrdiff_t)stride]) * per_y;
            float square = fminf(x * x + y * y, 1e30f), energy = row[c];
            if (known && known[c] == SCENE_FILLED)
                square += t->filled_slope2;
            row[c] = sqrtf(per_mean * (energy * square / (square + limit * energy + 1e-30f)));
        }
    }
    return status;
}
