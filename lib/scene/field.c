/* The fractal field over an elevation model, as a source. */
#include "fbm/elementary.h"
#include "fbm/estimate.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/size.h"
#include "lib/scene/chain.h"
#include "lib/scene/roughness.h"

#include <assert.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

enum {
    BLOCK = 512, /* reads are cut into blocks of at most this, so that the levels of one stay in cache */
    /* Cells beyond the known samples that are made up so that the predictor has something to see. The output lies at
     * most half a cell outside of a known sample, and the halo of the refinement converges to 8 cells. */
    GROWTH = 10,
    GROWTH_REACH = 2 * GROWTH, /* how far a made-up sample can see: two cells a pass */
};

typedef struct field {
    tl_source source;
    const tl_source *dem;
    scene_chain chain;
    float trend; /* how far a slope goes on beyond the rim: see grow_sample */
    tl_parameter *parameters;
} field;

/* ---- level 0: the samples, and what is made up around them ---- */

/* A rectangle of level 0, in DEM samples, that may reach beyond the DEM. */
typedef struct ground {
    fbm_window window;
    float *heights;
    unsigned char *known; /* NULL: all are */
} ground;

static void ground_free(ground *g)
{
    free(g->heights);
    free(g->known);
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

static fbm_window widened(fbm_window w, int by)
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

/* The height of an unknown sample, from its neighbours that are known after `pass` passes: the mean, over the eight
 * directions, of the nearest height and `trend` times the step to it. For fBm on a line the best guess behind two known
 * samples has trend 2^(2H-1) - 1: flat at H = 1/2, straight at H = 1. NaN where no neighbour is known. */
static float grow_sample(const field *f, const ground *g, size_t x, size_t y, unsigned char pass)
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
            if (g->known[k1] == 0 || g->known[k1] > pass)
                continue;
            bool second = x2 < g->window.width && y2 < g->window.height && g->known[k2] && g->known[k2] <= pass;
            sum += g->heights[k1] + (second ? f->trend * (g->heights[k1] - g->heights[k2]) : 0);
            count++;
        }
    return count ? sum / (float)count : NAN;
}

/* Fills the unknown samples ring by ring. known[k] is 0 for unknown, 1 for the DEM's, p + 1 for those of pass p; a pass
 * sees only those before it, so the result does not depend on the order of samples nor on where the window lies. */
static void grow(const field *f, ground *g)
{
    for (unsigned char pass = 1; pass <= GROWTH; pass++)
        for (size_t y = 0; y < g->window.height; y++)
            for (size_t x = 0; x < g->window.width; x++) {
                size_t k = y * g->window.width + x;
                if (g->known[k])
                    continue;
                float height = grow_sample(f, g, x, y, pass);
                if (isfinite(height)) {
                    g->heights[k] = height;
                    g->known[k] = (unsigned char)(pass + 1);
                }
            }
    /* nothing that is kept can see what is left; it only must not be NaN */
    for (size_t k = 0; k < g->window.width * g->window.height; k++)
        if (!g->known[k])
            g->heights[k] = 0;
}

static tl_status ground_allocate(ground *g, fbm_window w, bool with_known, const char *name, tl_error *error)
{
    *g = (ground){.window = w};
    g->heights = tl_alloc_grid((int64_t)w.width, (int64_t)w.height, sizeof *g->heights);
    g->known = with_known ? tl_alloc_grid((int64_t)w.width, (int64_t)w.height, 1) : NULL;
    if (g->heights && (g->known || !with_known))
        return TL_OK;
    ground_free(g);
    *g = (ground){0};
    return tl_fail_memory(error, name);
}

/* Cuts the inner window `w` out of a wider ground. */
static void crop(const ground *wide, ground *g)
{
    fbm_window w = g->window;
    size_t dx = (size_t)(w.i - wide->window.i), dy = (size_t)(w.j - wide->window.j);
    for (size_t row = 0; row < w.height; row++) {
        size_t from = (dy + row) * wide->window.width + dx;
        memcpy(g->heights + row * w.width, wide->heights + from, w.width * sizeof *g->heights);
        memcpy(g->known + row * w.width, wide->known + from, w.width);
    }
}

static tl_status ground_with_rim(const field *f, fbm_window w, ground *g, tl_error *error)
{
    const char *name = f->dem->info.name;
    ground wide;
    tl_status status = ground_allocate(&wide, widened(w, GROWTH_REACH), true, name, error);
    if (status != TL_OK)
        return status;
    status = read_ground(f->dem, wide.window, wide.heights, error);
    if (status == TL_OK)
        status = ground_allocate(g, w, true, name, error);
    if (status == TL_OK) {
        for (size_t k = 0; k < wide.window.width * wide.window.height; k++)
            wide.known[k] = !isnan(wide.heights[k]);
        grow(f, &wide);
        crop(&wide, g);
    }
    ground_free(&wide);
    return status;
}

static bool all_known(const float *heights, size_t count)
{
    for (size_t k = 0; k < count; k++)
        if (isnan(heights[k]))
            return false;
    return true;
}

static tl_status ground_read(const field *f, fbm_window w, ground *g, tl_error *error)
{
    if (inside(&f->dem->info, w)) {
        tl_status status = ground_allocate(g, w, false, f->dem->info.name, error);
        if (status == TL_OK)
            status = read_ground(f->dem, w, g->heights, error);
        if (status != TL_OK || all_known(g->heights, w.width * w.height))
            return status;
        ground_free(g);
        *g = (ground){0};
    }
    return ground_with_rim(f, w, g, error);
}

/* ---- voids ---- */

static bool sample_known(const ground *g, int64_t i, int64_t j)
{
    return g->known[(size_t)(j - g->window.j) * g->window.width + (size_t)(i - g->window.i)] == 1;
}

/* Voids of the DEM stay voids. A cell of an area raster is known when the sample whose cell it lies in is; a point when
 * the samples around it, one, two or four, all are. */
static void cut_voids(const ground *g, bool area, int level, tl_window window, float *out, int64_t stride)
{
    int64_t unit = (int64_t)1 << level, mask = area ? 0 : unit - 1;
    for (int64_t row = 0; row < window.height; row++)
        for (int64_t column = 0; column < window.width; column++) {
            int64_t x = window.x + column, y = window.y + row;
            int64_t i = x >> level, j = y >> level, right = (x & mask) != 0, below = (y & mask) != 0;
            if (!sample_known(g, i, j) || !sample_known(g, i + right, j) || !sample_known(g, i, j + below) ||
                !sample_known(g, i + right, j + below))
                out[row * stride + column] = NAN;
        }
}

/* ---- reading ---- */

static tl_status load(void *context, fbm_window window, float *buffer, tl_error *error)
{
    (void)error;
    const ground *g = context;
    assert(window.i == g->window.i && window.width == g->window.width && window.height == g->window.height);
    memcpy(buffer, g->heights, window.width * window.height * sizeof *buffer);
    return TL_OK;
}

/* The lattice window, or the window of cells, that a window of samples is. Cell k of an area raster at level l has its
 * centre at (k + 1/2) / 2^l - 1/2 samples, which is that of cell k - 2^(l-1) of the lattice of level l. */
static scene_chain_target target_of(const field *f, int level, tl_window window, float *out, int64_t stride)
{
    bool centres = f->source.info.type == TL_RASTER_AREA && level > 0;
    int64_t shift = centres ? (int64_t)1 << (level - 1) : 0;
    return (scene_chain_target){
        .level = level,
        .centres = centres,
        .window = {window.x - shift, window.y - shift, (size_t)window.width, (size_t)window.height, (size_t)stride},
        .out = out};
}

static tl_status read_block(const field *f, int level, tl_window window, float *out, int64_t stride, tl_error *error)
{
    scene_chain_target target = target_of(f, level, window, out, stride);
    fbm_window support = scene_chain_support(&f->chain, &target);
    support.stride = support.width;
    ground g;
    tl_status status = ground_read(f, support, &g, error);
    if (status != TL_OK)
        return status;
    status = scene_chain_run(&f->chain, &target, load, &g, f->source.info.name, error);
    if (status == TL_OK && g.known)
        cut_voids(&g, f->source.info.type == TL_RASTER_AREA, level, window, out, stride);
    ground_free(&g);
    return status;
}

static tl_status field_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const field *f = (const field *)self;
    if (level == 0)
        return tl_source_read(f->dem, 0, window, out, error);
    for (int64_t y = 0; y < window.height; y += BLOCK)
        for (int64_t x = 0; x < window.width; x += BLOCK) {
            tl_window block = {window.x + x, window.y + y, tl_int64_min(BLOCK, window.width - x),
                               tl_int64_min(BLOCK, window.height - y)};
            tl_status status = read_block(f, level, block, out + y * window.width + x, window.width, error);
            if (status != TL_OK)
                return status;
        }
    return TL_OK;
}

/* The least known of the samples that a refined one lies among: see cut_voids. */
static unsigned char least_known(const unsigned char *known, tl_window g, int64_t i, int64_t j, int64_t right,
                                 int64_t below)
{
    const unsigned char *at = known + (j - g.y) * g.width + i - g.x;
    unsigned char least = at[0];
    const unsigned char others[3] = {at[right], at[below * g.width], at[below * g.width + right]};
    for (int k = 0; k < 3; k++)
        least = others[k] < least ? others[k] : least;
    return least;
}

static tl_status field_validity(const tl_source *self, int level, tl_window window, unsigned char *out, tl_error *error)
{
    const field *f = (const field *)self;
    if (window.width == 0 || window.height == 0)
        return TL_OK;
    int64_t mask = self->info.type == TL_RASTER_AREA ? 0 : ((int64_t)1 << level) - 1;
    tl_window g = {window.x >> level, window.y >> level, 0, 0};
    g.width = ((window.x + window.width - 1 + mask) >> level) + 1 - g.x;
    g.height = ((window.y + window.height - 1 + mask) >> level) + 1 - g.y;
    unsigned char *known = tl_alloc_grid(g.width, g.height, 1);
    if (!known)
        return tl_fail_memory(error, self->info.name);
    tl_status status = tl_source_validity(f->dem, 0, g, known, error);
    for (int64_t k = 0; status == TL_OK && k < window.width * window.height; k++) {
        int64_t x = window.x + k % window.width, y = window.y + k / window.width;
        out[k] = least_known(known, g, x >> level, y >> level, (x & mask) != 0, (y & mask) != 0);
    }
    free(known);
    return status;
}

static int64_t refined_size(int64_t samples, int level, tl_raster_type type)
{
    return type == TL_RASTER_AREA ? samples << level : ((samples - 1) << level) + 1;
}

static tl_status field_size(const tl_source *self, int level, int64_t *width, int64_t *height, tl_error *error)
{
    const field *f = (const field *)self;
    if (level < 0)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no level %d", self->info.name, level);
    *width = refined_size(f->dem->info.width, level, self->info.type);
    *height = refined_size(f->dem->info.height, level, self->info.type);
    return TL_OK;
}

static void field_destroy(tl_source *self)
{
    field *f = (field *)self;
    tl_crs_release(self->info.georef.crs);
    free(f->parameters);
    free(f);
}

/* ---- making ---- */

static tl_status check(const tl_source *dem, const tl_field_options *o, tl_error *error)
{
    const tl_source_info *info = &dem->info;
    if (o->levels < 0 || o->levels > SCENE_LEVEL_MAX)
        return tl_fail(error, TL_ERROR_ARGUMENT, "levels must be from 0 to %d, not %d", SCENE_LEVEL_MAX, o->levels);
    if (o->hurst_given && !(o->hurst >= FBM_HURST_MIN && o->hurst <= FBM_HURST_MAX))
        return tl_fail(error, TL_ERROR_ARGUMENT, "the Hurst exponent must be from 0.01 to 0.99, not %g", o->hurst);
    if (o->delta_given && !(o->delta >= 0 && o->delta <= 1e30))
        return tl_fail(error, TL_ERROR_ARGUMENT, "delta must be from 0 to 1e30, not %g", o->delta);
    int64_t limit = INT64_C(1) << 60; /* coordinates of every level, and of the halo, must fit */
    if (info->level != 0 || info->width > limit >> o->levels || info->height > limit >> o->levels)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %lld x %lld samples cannot be refined by %d levels; take fewer",
                       info->name, (long long)info->width, (long long)info->height, o->levels);
    return TL_OK;
}

/* Amplitude of the residual filter at each level, and the exponent for its weights. What is not given is predicted from
 * the measurement. A measured octave of variance sigma^2 is that of fBm whose delta makes it so, at an exponent
 * below 1. */
static void schedule(field *f, const tl_field_options *o, const tl_roughness *measured)
{
    scene_octave octaves[SCENE_LEVEL_MAX + 1];
    scene_predict_octaves(measured, &f->dem->info.georef, octaves, SCENE_LEVEL_MAX + 1);
    bool area = f->dem->info.type == TL_RASTER_AREA;
    double amplitude = o->delta;
    for (int l = 0; l <= SCENE_LEVEL_MAX && l <= o->levels; l++) {
        double hurst = o->hurst_given ? o->hurst : octaves[l].hurst;
        double model = fmin(fmax(hurst, FBM_HURST_MIN), FBM_HURST_MAX);
        if (l > 0)
            amplitude *= fbm_exp2(-hurst);
        if (!o->delta_given && (l == 0 || !o->hurst_given))
            amplitude = octaves[l].sigma / sqrt(fbm_detail_of_fbm(model, area));
        fbm_step *step = &f->chain.steps[l];
        step->scheme->weights(model, &step->weights);
        step->amplitude = (float)amplitude;
        step->period = f->dem->info.wraps ? f->dem->info.width << l : 0;
        if (l == 0)
            f->trend = (float)(fbm_exp2(2 * model - 1) - 1);
    }
}

/* The record: pairs of name and value. */
static tl_status note_all(field *f, const tl_field_options *o, const tl_roughness *measured, tl_error *error)
{
    char levels[TL_NUMBER_TEXT], seed[TL_NUMBER_TEXT], hurst[TL_NUMBER_TEXT] = "measured",
                                                       delta[TL_NUMBER_TEXT] = "measured";
    char found[80] = "nothing: too small or too flat, so no detail is added";
    snprintf(levels, sizeof levels, "%d", o->levels);
    snprintf(seed, sizeof seed, "%llu", (unsigned long long)o->seed);
    if (o->hurst_given)
        tl_number_text(o->hurst, hurst);
    if (o->delta_given)
        tl_number_text(o->delta, delta);
    if (measured->measurable)
        snprintf(found, sizeof found, "sigma %.6g, exponent %.4g", measured->sigma, measured->hurst);
    const tl_parameter all[] = {{"levels", levels}, {"scheme", f->chain.steps[0].scheme->name},
                                {"seed", seed},     {"hurst", hurst},
                                {"delta", delta},   {"measured", found}};
    size_t count = sizeof all / sizeof *all - (o->hurst_given && o->delta_given);
    tl_status status = tl_parameters_add_origin(&f->parameters, &f->source.info.parameter_count, &f->dem->info, error);
    for (size_t i = 0; i < count && status == TL_OK; i++)
        status = tl_parameters_add(&f->parameters, &f->source.info.parameter_count, all[i].name, all[i].value, error);
    f->source.info.parameters = f->parameters;
    return status;
}

static void place(field *f, int levels)
{
    tl_source_info *info = &f->source.info;
    const tl_source_info *dem = &f->dem->info;
    double scale = ldexp(1, -levels);
    info->width = refined_size(dem->width, levels, dem->type);
    info->height = refined_size(dem->height, levels, dem->type);
    info->level = levels;
    info->quantum = levels ? 0 : dem->quantum;
    info->block_width = info->block_height = 0;                           /* whatever window is wanted is made */
    info->wraps = dem->wraps && (dem->type == TL_RASTER_AREA || !levels); /* points end a cell before the first */
    double *t = info->georef.transform;
    if (dem->type == TL_RASTER_AREA) { /* the first cell's centre moves towards the corner */
        double shift = 0.5 * scale - 0.5;
        t[0] += shift * (t[1] + t[2]);
        t[3] += shift * (t[4] + t[5]);
    }
    for (int k = 0; k < 6; k++)
        t[k] *= k % 3 ? scale : 1;
    info->georef.cell_x *= scale;
    info->georef.cell_y *= scale;
}

tl_source *tl_field_create(const tl_source *dem, const tl_field_options *options, tl_error *error)
{
    static const tl_field_options defaults;
    const tl_field_options *o = options ? options : &defaults;
    const fbm_scheme *scheme = scene_scheme(o->scheme, error);
    if (!scheme || check(dem, o, error) != TL_OK)
        return NULL;
    tl_roughness measured = {0};
    if (!(o->hurst_given && o->delta_given) && tl_roughness_measure(dem, o->run, &measured, error) != TL_OK)
        return NULL;
    field *f = calloc(1, sizeof *f);
    if (!f) {
        tl_fail_memory(error, dem->info.name);
        return NULL;
    }
    f->source = (tl_source){.info = dem->info,
                            .read = field_read,
                            .size = field_size,
                            .validity = field_validity,
                            .destroy = field_destroy};
    f->source.info.parameter_count = 0; /* the record is its own */
    f->source.info.parameters = NULL;
    f->dem = dem;
    tl_crs_retain(f->source.info.georef.crs);
    for (int l = 0; l <= SCENE_LEVEL_MAX; l++)
        f->chain.steps[l] = (fbm_step){.scheme = scheme, .seed = o->seed, .level = l};
    schedule(f, o, &measured);
    place(f, o->levels);
    if (note_all(f, o, &measured, error) == TL_OK)
        return &f->source;
    field_destroy(&f->source);
    return NULL;
}
