#include "lib/out/texture.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/layer_paint.h"
#include "lib/out/png_encoder.h"
#include "lib/scene/field.h"
#include "lib/scene/layers.h"
#include "lib/scene/light.h"

#include <math.h>
#include <string.h>
#include <sys/stat.h>

enum { ROWS = 32, MOST_HALVINGS = 40 };

/* ---- A part of a level as a source ---- */

typedef struct ground {
    tl_source source;
    const tl_source *from;
    int level;    /* of `from` */
    int64_t skip; /* every skip-th of its samples */
    int64_t x, y; /* of the first, in these */
} ground;

static tl_status ground_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const ground *g = (const ground *)self;
    tl_window theirs = {(g->x + window.x) * g->skip, (g->y + window.y) * g->skip, window.width, window.height};
    (void)level; /* there is one */
    if (g->skip == 1)
        return tl_source_read(g->from, g->level, theirs, out, error);
    theirs.width = (window.width - 1) * g->skip + 1;
    theirs.height = 1;
    float *row = tl_alloc_grid(theirs.width, 1, sizeof *row);
    tl_status status = row ? TL_OK : tl_fail_memory(error, g->from->info.name);
    for (int64_t y = 0; y < window.height && status == TL_OK; y++, theirs.y += g->skip) {
        status = tl_source_read(g->from, g->level, theirs, row, error);
        for (int64_t x = 0; x < window.width && status == TL_OK; x++)
            out[y * window.width + x] = row[x * g->skip];
    }
    free(row);
    return status;
}

static void ground_destroy(tl_source *self)
{
    free(self);
}

/* ---- Choosing the level ---- */

static void find_box(const tl_mesh *mesh, out_texture *t)
{
    t->low[0] = t->low[1] = INT64_MAX;
    t->high[0] = t->high[1] = INT64_MIN;
    for (size_t k = 0; k < mesh->vertex_count; k++) {
        const int64_t at[2] = {mesh->vertices[k].i, mesh->vertices[k].j};
        for (int a = 0; a < 2; a++) {
            t->low[a] = tl_int64_min(t->low[a], at[a]);
            t->high[a] = tl_int64_max(t->high[a], at[a]);
        }
    }
}

/* The source of a level with so many halvings below the finest: the surface, the model that a field was made of, or
 * one of these with samples left out. */
static tl_status find_level(const tl_source *surface, int halvings, ground *g, int64_t size[2], tl_error *error)
{
    const tl_source *model = scene_field_dem(surface);
    for (int k = halvings; k >= 0; k--) {
        int level = surface->info.level - k;
        g->from = model && level < 0 ? model : surface;
        g->level = level;
        g->skip = INT64_C(1) << (halvings - k);
        if (tl_source_size(g->from, level, &size[0], &size[1], NULL) == TL_OK) {
            size[0] = (size[0] - 1) / g->skip + 1;
            size[1] = (size[1] - 1) / g->skip + 1;
            return TL_OK;
        }
    }
    return tl_fail(error, TL_ERROR_DATA, "%s: has no samples for a texture", surface->info.name);
}

/* Takes the level that is so many halvings coarser; false where it has too many texels. */
static bool take_level(const tl_source *surface, int halvings, int most, out_texture *t, ground *g)
{
    int64_t size[2], from[2], to[2];
    if (find_level(surface, halvings, g, size, NULL) != TL_OK)
        return false;
    double step = ldexp(1, halvings), inner = ldexp(1, surface->info.level - g->level);
    double offset = surface->info.type == TL_RASTER_AREA ? (inner - 1) / 2 : 0; /* means stand in their cells' middle */
    if (g->from != surface && g->from->info.type == TL_RASTER_AREA && surface->info.type != TL_RASTER_AREA)
        offset = (inner - ldexp(1, surface->info.level)) / 2; /* of a model whose own samples are taken for points */
    for (int a = 0; a < 2; a++) {
        from[a] = tl_int64_max(0, (int64_t)floor(((double)t->low[a] - offset) / step));
        to[a] = tl_int64_min(size[a] - 1, (int64_t)ceil(((double)t->high[a] - offset) / step));
        from[a] = tl_int64_min(from[a], to[a]);
        t->first[a] = (double)from[a] * step + offset;
    }
    t->step = step;
    g->x = from[0];
    g->y = from[1];
    g->source.info.width = to[0] - from[0] + 1;
    g->source.info.height = to[1] - from[1] + 1;
    return g->source.info.width <= most && g->source.info.height <= most;
}

static void set_place(const tl_source *surface, const out_texture *t, tl_source_info *info)
{
    tl_georef *to = &info->georef;
    *to = surface->info.georef;
    const double *from = surface->info.georef.transform;
    for (int a = 0; a < 2; a++) {
        to->transform[3 * a] = from[3 * a] + t->first[0] * from[3 * a + 1] + t->first[1] * from[3 * a + 2];
        to->transform[3 * a + 1] = from[3 * a + 1] * t->step;
        to->transform[3 * a + 2] = from[3 * a + 2] * t->step;
    }
    to->cell_x *= t->step;
    to->cell_y *= t->step;
}

static ground *ground_create(const tl_source *surface)
{
    ground *g = calloc(1, sizeof *g);
    if (g) {
        g->source = (tl_source){.info = surface->info, .read = ground_read, .destroy = ground_destroy};
        g->source.info.level = 0;
    }
    return g;
}

tl_status out_texture_open(const tl_mesh *mesh, const tl_source *surface, int most, out_texture *out, tl_error *error)
{
    ground *g = ground_create(surface);
    *out = (out_texture){.whole = scene_field_dem(surface) ? scene_field_dem(surface) : surface};
    if (!g)
        return tl_fail_memory(error, surface->info.name);
    find_box(mesh, out);
    int halvings = 0;
    while (halvings < MOST_HALVINGS && !take_level(surface, halvings, most ? most : OUT_TEXTURE_SIZE, out, g))
        halvings++;
    out->ground = &g->source;
    set_place(surface, out, &g->source.info);
    if (halvings < MOST_HALVINGS)
        return TL_OK;
    out_texture_close(out);
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: no level of it fits into a texture", surface->info.name);
}

tl_status out_texture_open_box(const tl_source *surface, const int64_t low[2], const int64_t high[2], int spacing,
                               out_texture *out, tl_error *error)
{
    ground *g = ground_create(surface);
    *out = (out_texture){.whole = scene_field_dem(surface) ? scene_field_dem(surface) : surface};
    if (!g)
        return tl_fail_memory(error, surface->info.name);
    memcpy(out->low, low, sizeof out->low);
    memcpy(out->high, high, sizeof out->high);
    out->ground = &g->source;
    bool good = take_level(surface, spacing, INT32_MAX, out, g);
    set_place(surface, out, &g->source.info);
    if (good)
        return TL_OK;
    out_texture_close(out);
    return tl_fail(error, TL_ERROR_DATA, "%s: has no samples for a texture", surface->info.name);
}

void out_texture_close(out_texture *texture)
{
    tl_source_destroy(texture->ground);
    texture->ground = NULL;
}

void out_texture_place(const out_texture *t, double i, double j, float uv[2])
{
    const double at[2] = {i, j}, size[2] = {(double)t->ground->info.width, (double)t->ground->info.height};
    for (int a = 0; a < 2; a++) {
        double texel = fmin(fmax((at[a] - t->first[a]) / t->step, 0), size[a] - 1);
        uv[a] = (float)((texel + 0.5) / size[a]);
    }
}

/* ---- Painting ---- */

typedef struct painting {
    const scene_layer *layer;
    int64_t width, height;
    unsigned char *rgba;
} painting;

/* Voids take the colour of the texel before them, else of the one behind. */
static void spread(unsigned char *row, int64_t width)
{
    const unsigned char *last = NULL;
    for (int64_t x = 0; x < 2 * width; x++) {
        unsigned char *texel = row + 4 * (x < width ? x : 2 * width - 1 - x);
        if (texel[3])
            last = texel;
        else if (last) {
            memcpy(texel, last, 3);
            texel[3] = 255;
        }
    }
}

tl_status out_texture_pixels(const scene_layer *layer, tl_window window, unsigned char *rgba, tl_error *error)
{
    const tl_layer_kind *kind = scene_layer_kind(layer);
    const bool normals = strcmp(kind->name, "tangent") == 0;
    size_t samples = (size_t)(window.width * window.height);
    float *values = tl_alloc(kind->channels * samples, sizeof *values);
    tl_status status = values ? scene_layer_read(layer, window, values, error) : tl_fail_memory(error, "a texture");
    scene_encode_prepare();
    for (size_t k = 0; status == TL_OK && k < samples; k++)
        out_layer_paint(kind, values + k, samples, rgba + 4 * k);
    for (int64_t y = 0; status == TL_OK && y < window.height; y++)
        spread(rgba + y * window.width * 4, window.width);
    for (size_t k = 0; status == TL_OK && k < samples; k++)
        if (!rgba[4 * k + 3]) /* a row without any height */
            memcpy(rgba + 4 * k, normals ? "\x80\x80\xff\xff" : "\x80\x80\x80\xff", 4);
    free(values);
    return status;
}

static tl_status paint_band(void *context, tl_parallel *loop, uint64_t band, unsigned worker, tl_error *error)
{
    const painting *p = context;
    const tl_window window = {0, (int64_t)band * ROWS, p->width, tl_int64_min(ROWS, p->height - (int64_t)band * ROWS)};
    (void)loop;
    (void)worker;
    return out_texture_pixels(p->layer, window, p->rgba + window.y * p->width * 4, error);
}

static tl_status write_png(const painting *p, tl_output *output, const tl_run *run, uint64_t *bytes, tl_error *error)
{
    const scene_picture picture = {.width = p->width, .height = p->height, .rgba = p->rgba};
    struct stat written;
    tl_status status = out_picture_write(&picture, output, run, error);
    if (status == TL_OK)
        status = tl_output_flush(output, error);
    if (status == TL_OK && fstat(tl_output_descriptor(output), &written) != 0)
        status = tl_fail(error, TL_ERROR_IO, "%s: its texture cannot be read back", tl_output_path(output));
    *bytes = status == TL_OK ? (uint64_t)written.st_size : 0;
    return status;
}

static tl_status paint(painting *p, tl_output *output, const tl_run *run, uint64_t *bytes, tl_error *error)
{
    tl_run quiet = run ? *run : (tl_run){0};
    quiet.progress = NULL;
    tl_status status = tl_run_fits(run, 4.0 * (double)p->width * (double)p->height, tl_output_path(output),
                                   "its texture (--texture-size makes it smaller)", error);
    if (status != TL_OK)
        return status;
    p->rgba = tl_alloc_grid(p->width, p->height, 4);
    if (!p->rgba)
        return tl_fail_memory(error, tl_output_path(output));
    scene_encode_prepare();
    status = tl_parallel_for(&quiet, (uint64_t)tl_div_up(p->height, ROWS), (uint64_t)(p->width * p->height), paint_band,
                             p, error);
    if (status == TL_OK)
        status = write_png(p, output, run, bytes, error);
    free(p->rgba);
    return status;
}

tl_output *out_texture_paint(const out_texture *texture, const char *layer, const char *path, const tl_run *run,
                             uint64_t *bytes, tl_error *error)
{
    scene_layer *made = scene_layer_create_over(texture->ground, layer, texture->whole, error);
    tl_output *output = made ? tl_output_open(path, true, error) : NULL;
    painting p = {.layer = made, .width = texture->ground->info.width, .height = texture->ground->info.height};
    tl_status status = output ? paint(&p, output, run, bytes, error) : TL_ERROR_IO;
    scene_layer_destroy(made);
    if (status == TL_OK)
        return output;
    tl_output_abort(output);
    return NULL;
}

unsigned char *out_texture_bytes(const out_texture *texture, const scene_layer *layer, const char *path,
                                 const tl_run *run, uint64_t *bytes, tl_error *error)
{
    scene_layer *own = scene_layer_copy_over(layer, texture->ground);
    tl_output *output = own ? tl_output_open(path, true, error) : NULL;
    painting p = {.layer = own, .width = texture->ground->info.width, .height = texture->ground->info.height};
    unsigned char *out = NULL;
    tl_status status = output ? TL_OK : own ? TL_ERROR_IO : tl_fail_memory(error, path);
    p.rgba = tl_alloc_grid(p.width, p.height, 4);
    if (status == TL_OK && !p.rgba)
        status = tl_fail_memory(error, path);
    if (status == TL_OK)
        status = out_texture_pixels(own, (tl_window){0, 0, p.width, p.height}, p.rgba, error);
    if (status == TL_OK)
        status = write_png(&p, output, run, bytes, error);
    if (status == TL_OK) {
        out = calloc(((size_t)*bytes + 3) / 4, 4);
        status = out ? tl_output_read_at(output, out, (size_t)*bytes, 0, error) : tl_fail_memory(error, path);
    }
    tl_output_abort(output);
    scene_layer_destroy(own);
    free(p.rgba);
    if (status == TL_OK)
        return out;
    free(out);
    return NULL;
}
