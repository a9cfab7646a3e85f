#include "lib/scene/mesh_colour.h"

#include "dem/crs.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { LEVELS = 32, MOST_TEXELS = 1 << 24, BANDS = 3, ROWS = 64 };

/* A byte of sRGB a band; alpha is 0 where there is no colour. */
typedef struct texel {
    unsigned char of[BANDS], alpha;
} texel;

typedef struct sheet {
    int64_t width, height;
    texel *texels;
} sheet;

struct scene_colours {
    sheet sheets[LEVELS]; /* each of half of the one before */
    int count;
    double to_texel[6]; /* column and row of the model to those of the first sheet, texels' middles at halves */
    double metres;      /* of its texels */
    float linear[256];
};

/* ---- reading ---- */

static int64_t size_at(int64_t size, int halvings)
{
    return tl_div_up(size, INT64_C(1) << halvings);
}

/* Halvings that make the raster small enough. */
static int halvings_of(const tl_source_info *info, const tl_run *run)
{
    double most = MOST_TEXELS;
    int halvings = 0;
    if (run && run->memory && (double)run->memory / (4 * 1.34 * sizeof(texel)) < most)
        most = (double)run->memory / (4 * 1.34 * sizeof(texel));
    while ((double)size_at(info->width, halvings) * (double)size_at(info->height, halvings) > most)
        halvings++;
    return halvings;
}

/* Layers as colours: shares of a byte of sRGB. */

static scene_rgb colour_of_normal(const float v[4])
{
    return (scene_rgb){.5F + .5F * v[0], .5F + .5F * v[1], .5F + .5F * v[2]};
}

static scene_rgb colour_of_slope(const float v[4])
{
    return (scene_rgb){v[0] / 90, v[0] / 90, v[0] / 90};
}

static scene_rgb colour_of_splat(const float v[4])
{
    const scene_rgb kinds[4] = {{.52F, .49F, .46F}, {.66F, .63F, .59F}, {.40F, .48F, .28F}, {.95F, .96F, .97F}};
    scene_rgb out = {0, 0, 0};
    for (int k = 0; k < 4; k++)
        out = (scene_rgb){out.r + v[k] * kinds[k].r, out.g + v[k] * kinds[k].g, out.b + v[k] * kinds[k].b};
    return out;
}

enum { CHANNELS = 4 };
static const struct drape {
    const char *name; /* of the layer */
    size_t channels;
    scene_rgb (*colour)(const float values[CHANNELS]);
} drapes[] = {{"normal", 3, colour_of_normal}, {"slope", 1, colour_of_slope}, {"splat", 4, colour_of_splat}};

static const struct drape *drape_of(const char *name)
{
    for (size_t k = 0; k < sizeof drapes / sizeof *drapes; k++)
        if (strcmp(drapes[k].name, name) == 0)
            return &drapes[k];
    return NULL;
}

static unsigned char byte_of(float share)
{
    return (unsigned char)(fminf(fmaxf(share, 0), 1) * 255 + .5F);
}

static tl_status read_drape(const struct drape *drape, const tl_source *const *channels, int halvings, sheet *to,
                            tl_error *error)
{
    float *values = tl_alloc_grid(to->width, (int64_t)ROWS * CHANNELS, sizeof *values);
    tl_status status = values ? TL_OK : tl_fail_memory(error, "the picture's colours");
    for (int64_t y = 0; y < to->height && status == TL_OK; y += ROWS) {
        tl_window w = {0, y, to->width, tl_int64_min(ROWS, to->height - y)};
        int64_t count = w.width * w.height;
        for (size_t c = 0; c < drape->channels && status == TL_OK; c++)
            status =
                tl_source_read(channels[c], channels[c]->info.level - halvings, w, values + (int64_t)c * count, error);
        for (int64_t k = 0; k < count && status == TL_OK; k++) {
            float v[CHANNELS] = {0};
            for (size_t c = 0; c < drape->channels; c++)
                v[c] = values[(int64_t)c * count + k];
            scene_rgb colour = drape->colour(v);
            texel *t = &to->texels[y * to->width + k];
            *t = (texel){{0}, 0};
            if (!isnan(v[0]))
                *t = (texel){{byte_of(colour.r), byte_of(colour.g), byte_of(colour.b)}, 255};
        }
    }
    free(values);
    return status;
}

static tl_status read_band(const tl_source *band, int halvings, int which, bool all, sheet *to, tl_error *error)
{
    float *values = tl_alloc_grid(to->width, ROWS, sizeof *values);
    tl_status status = values ? TL_OK : tl_fail_memory(error, "the picture's colours");
    for (int64_t y = 0; y < to->height && status == TL_OK; y += ROWS) {
        tl_window w = {0, y, to->width, tl_int64_min(ROWS, to->height - y)};
        status = tl_source_read(band, band->info.level - halvings, w, values, error);
        for (int64_t k = 0; status == TL_OK && k < w.width * w.height; k++) {
            texel *t = &to->texels[y * to->width + k];
            unsigned char byte = (unsigned char)(values[k] > 0 ? fminf(values[k], 255) + .5F : 0);
            for (int c = all ? 0 : which; c <= (all ? BANDS - 1 : which); c++)
                t->of[c] = byte;
            t->alpha = isnan(values[k]) || (which && !t->alpha) ? 0 : 255;
        }
    }
    free(values);
    return status;
}

static bool make_sheet(scene_colours *c, int64_t width, int64_t height)
{
    sheet *s = &c->sheets[c->count];
    *s = (sheet){width, height, tl_alloc_grid(width, height, sizeof *s->texels)};
    c->count += s->texels != NULL;
    return s->texels != NULL;
}

static tl_status read_all(scene_colours *c, const char *path, const tl_source *first, const tl_run *run,
                          tl_error *error)
{
    int halvings = halvings_of(&first->info, run);
    if (!make_sheet(c, size_at(first->info.width, halvings), size_at(first->info.height, halvings)))
        return tl_fail_memory(error, "the picture's colours");
    tl_status status = TL_OK;
    bool grey = false;
    for (unsigned band = 1; band <= BANDS && status == TL_OK && !grey; band++) {
        tl_source *more = band > 1 ? tl_open_with(path, &(tl_dem_options){.band = band, .run = run}, error) : NULL;
        grey = band > 1 && !more;
        if (grey && band > 2)
            return tl_fail(error, TL_ERROR_DATA, "%s: has two bands; colours have three, or one", path);
        status = read_band(grey   ? first
                           : more ? more
                                  : first,
                           halvings, grey ? 0 : (int)band - 1, grey, &c->sheets[0], error);
        tl_source_destroy(more);
    }
    return status;
}

static tl_status read_layer(scene_colours *c, const struct drape *drape, const tl_source *dem, const tl_run *run,
                            tl_error *error)
{
    int halvings = halvings_of(&dem->info, run);
    tl_source *channels[CHANNELS] = {NULL};
    tl_status status = TL_OK;
    if (!make_sheet(c, size_at(dem->info.width, halvings), size_at(dem->info.height, halvings)))
        return tl_fail_memory(error, "the picture's colours");
    for (size_t k = 0; k < drape->channels && status == TL_OK; k++) {
        channels[k] = tl_layer_create(dem, drape->name, k, &(tl_layer_options){.run = run}, error);
        status = channels[k] ? TL_OK : TL_ERROR_ARGUMENT;
    }
    if (status == TL_OK)
        status = read_drape(drape, (const tl_source *const *)channels, halvings, &c->sheets[0], error);
    for (size_t k = 0; k < CHANNELS; k++)
        tl_source_destroy(channels[k]);
    return status;
}

/* ---- means ---- */

static int64_t at_most(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

/* Of light, not of bytes, and of what has a colour. */
static texel mean_of(const scene_colours *c, const sheet *from, int64_t x, int64_t y)
{
    float sum[BANDS] = {0};
    int count = 0;
    for (int k = 0; k < 4; k++) {
        const texel *t = &from->texels[at_most(2 * y + k / 2, from->height - 1) * from->width +
                                       at_most(2 * x + k % 2, from->width - 1)];
        for (int band = 0; band < BANDS && t->alpha; band++)
            sum[band] += c->linear[t->of[band]];
        count += t->alpha != 0;
    }
    texel out = {{0}, (unsigned char)(count >= 2 ? 255 : 0)};
    for (int band = 0; band < BANDS && count; band++)
        out.of[band] = scene_encode(sum[band] / (float)count);
    return out;
}

static tl_status make_means(scene_colours *c, tl_error *error)
{
    while (c->count < LEVELS && (c->sheets[c->count - 1].width > 1 || c->sheets[c->count - 1].height > 1)) {
        const sheet *from = &c->sheets[c->count - 1];
        int64_t width = size_at(from->width, 1), height = size_at(from->height, 1);
        if (!make_sheet(c, width, height))
            return tl_fail_memory(error, "the picture's colours");
        for (int64_t k = 0; k < width * height; k++)
            from[1].texels[k] = mean_of(c, from, k % width, k / width);
    }
    return TL_OK;
}

/* ---- places ---- */

static tl_status find_places(scene_colours *c, const tl_source_info *raster, const tl_source_info *dem, int halvings,
                             const char *path, tl_error *error)
{
    const tl_crs *crs = dem->georef.crs, *other = raster->georef.crs;
    const double *m = dem->georef.transform, *t = raster->georef.transform;
    double area = t[1] * t[5] - t[2] * t[4], scale = ldexp(1, -halvings);
    bool same = crs && other ? dem_crs_equivalent(crs, other) : crs == other;
    if (!same || !raster->georef.located || !dem->georef.located || area == 0)
        return tl_fail(
            error, TL_ERROR_ARGUMENT,
            "%s: colours must be in the CRS of the elevation model, %s; project them there (gdalwarp -t_srs)", path,
            crs ? tl_crs_name(crs) : "which has none");
    for (int k = 0; k < 3; k++) {
        double x = m[k] - (k ? 0 : t[0]), y = m[3 + k] - (k ? 0 : t[3]);
        c->to_texel[k] = scale * (t[5] * x - t[2] * y) / area;
        c->to_texel[3 + k] = scale * (t[1] * y - t[4] * x) / area;
    }
    /* sample 0 of an area raster is the middle of the first texel's first cell */
    c->to_texel[0] += .5 * scale, c->to_texel[3] += .5 * scale;
    double texels = fabs(c->to_texel[1] * c->to_texel[5] - c->to_texel[2] * c->to_texel[4]);
    c->metres = sqrt(dem->georef.cell_x * dem->georef.cell_y / texels);
    return TL_OK;
}

static void fill_linear(scene_colours *c)
{
    for (unsigned k = 0; k < 256; k++)
        c->linear[k] = scene_rgb_of(k).b;
}

static tl_status open_layer(scene_colours *c, const struct drape *drape, const tl_source *dem, const tl_run *run,
                            tl_error *error)
{
    tl_status status = find_places(c, &dem->info, &dem->info, halvings_of(&dem->info, run), drape->name, error);
    return status == TL_OK ? read_layer(c, drape, dem, run, error) : status;
}

static tl_status open_raster(scene_colours *c, const char *path, const tl_source *dem, const tl_run *run,
                             tl_error *error)
{
    tl_source *first = tl_open_with(path, &(tl_dem_options){.band = 1, .run = run}, error);
    tl_status status =
        first ? find_places(c, &first->info, &dem->info, halvings_of(&first->info, run), path, error) : TL_ERROR_DATA;
    if (status == TL_OK)
        status = read_all(c, path, first, run, error);
    tl_source_destroy(first);
    return status;
}

scene_colours *scene_colours_open(const char *path, const tl_source *dem, const tl_run *run, tl_error *error)
{
    scene_colours *c = calloc(1, sizeof *c);
    if (!c) {
        tl_fail_memory(error, "the picture's colours");
        return NULL;
    }
    scene_encode_prepare();
    fill_linear(c);
    const struct drape *drape = drape_of(path);
    tl_status status = drape ? open_layer(c, drape, dem, run, error) : open_raster(c, path, dem, run, error);
    if (status == TL_OK)
        status = make_means(c, error);
    if (status == TL_OK)
        return c;
    scene_colours_destroy(c);
    return NULL;
}

void scene_colours_destroy(scene_colours *c)
{
    for (int k = 0; c && k < c->count; k++)
        free(c->sheets[k].texels);
    free(c);
}

/* ---- colours ---- */

/* Adds the light of a sheet at a place of the first one, bilinear, times its share. */
static float add_light(const scene_colours *c, int level, double x, double y, float share, float sum[BANDS])
{
    const sheet *s = &c->sheets[level];
    double u = ldexp(x, -level) - .5, v = ldexp(y, -level) - .5, left = floor(u), top = floor(v), weight = 0;
    for (int k = 0; k < 4; k++) {
        int64_t i = tl_int64_min(tl_int64_max((int64_t)left + (k & 1), 0), s->width - 1);
        int64_t j = tl_int64_min(tl_int64_max((int64_t)top + (k >> 1), 0), s->height - 1);
        const texel *t = &s->texels[j * s->width + i];
        double own = (k & 1 ? u - left : 1 - u + left) * (k >> 1 ? v - top : 1 - v + top);
        if (!t->alpha)
            continue;
        weight += own;
        for (int band = 0; band < BANDS; band++)
            sum[band] += share * (float)own * c->linear[t->of[band]];
    }
    return share * (float)weight;
}

bool scene_colours_at(const scene_colours *c, double i, double j, double metres, scene_rgb *out)
{
    double x = c->to_texel[0] + c->to_texel[1] * i + c->to_texel[2] * j,
           y = c->to_texel[3] + c->to_texel[4] * i + c->to_texel[5] * j;
    if (!(x >= 0 && y >= 0 && x <= (double)c->sheets[0].width && y <= (double)c->sheets[0].height))
        return false;
    double level = fmin(fmax(log2(fmax(metres, 1e-30) / c->metres), 0), c->count - 1);
    int coarse = (int)floor(level);
    float sum[BANDS] = {0}, between = (float)(level - coarse);
    float weight = add_light(c, coarse, x, y, 1 - between, sum);
    if (between > 0)
        weight += add_light(c, coarse + 1, x, y, between, sum);
    if (!(weight > 0.25F))
        return false;
    *out = (scene_rgb){sum[0] / weight, sum[1] / weight, sum[2] / weight};
    return true;
}
