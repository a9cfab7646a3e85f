#include "lib/scene/mesh_picture.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/scene/light.h"
#include "lib/scene/mesh_colour.h"

#include <math.h>
#include <stdlib.h>

enum { SAMPLES = 2, PALETTE_WINDOWS = 24, PALETTE_SIDE = 8, FEW_HEIGHTS = 1 << 16 };

struct scene_painter {
    tl_view_picture_options options; /* with what is left out filled in */
    const tl_source *dem;
    scene_palette palette;
    scene_light light;
    scene_colours *colours; /* NULL: by height */
};

/* ---- colours ---- */

static tl_status check(const tl_view_picture_options *o, const char *name, tl_error *error)
{
    if (!isfinite(o->sun_azimuth) || !(o->sun_elevation >= 0 && o->sun_elevation <= 90))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the sun's elevation must be within 0...90 degrees", name);
    if (!(o->exaggeration >= 0 && o->exaggeration <= 1e6))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the exaggeration must be within 0...1000000", name);
    if (!(o->haze >= 0 && isfinite(o->haze)))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the haze must be a number of metres, or 0 for none", name);
    return TL_OK;
}

/* Heights of windows spread over the whole raster, or all of a small one. */
static tl_status sample_heights(const tl_source *dem, float **out, size_t *count, tl_error *error)
{
    const tl_source_info *info = &dem->info;
    bool few = info->width <= FEW_HEIGHTS / info->height;
    int64_t across = few ? 1 : tl_int64_min(PALETTE_WINDOWS, info->width),
            down = few ? 1 : tl_int64_min(PALETTE_WINDOWS, info->height);
    int64_t width = few ? info->width : tl_int64_min(PALETTE_SIDE, info->width),
            height = few ? info->height : tl_int64_min(PALETTE_SIDE, info->height);
    float *heights = tl_alloc_grid(across * width, down * height, sizeof *heights);
    if (!heights)
        return tl_fail_memory(error, "the picture");
    tl_status status = TL_OK;
    *count = 0;
    for (int64_t k = 0; k < across * down && status == TL_OK; k++) {
        /* the middles of equal parts */
        int64_t x = (info->width - width) * (2 * (k % across) + 1) / (2 * across),
                y = (info->height - height) * (2 * (k / across) + 1) / (2 * down);
        status = tl_source_read(dem, info->level, (tl_window){x, y, width, height}, heights + *count, error);
        *count += (size_t)(width * height);
    }
    if (status == TL_OK)
        *out = heights;
    else
        free(heights);
    return status;
}

scene_painter *scene_painter_create(const tl_source *dem, const tl_view_picture_options *options, tl_error *error)
{
    const tl_view_picture_options defaults = {0};
    options = options ? options : &defaults;
    if (check(options, dem->info.name, error) != TL_OK)
        return NULL;
    scene_painter *p = calloc(1, sizeof *p);
    float *heights = NULL;
    size_t count = 0;
    if (!p)
        tl_fail_memory(error, "the picture");
    if (!p || sample_heights(dem, &heights, &count, error) != TL_OK) {
        free(p);
        return NULL;
    }
    p->options = *options;
    p->dem = dem;
    if (p->options.exaggeration == 0)
        p->options.exaggeration = 1;
    if (p->options.sun_azimuth == 0 && p->options.sun_elevation == 0) {
        p->options.sun_azimuth = 315;
        p->options.sun_elevation = 45;
    }
    scene_palette_init(&p->palette, heights, count, options->grey, scene_has_sea_level(&dem->info.georef));
    free(heights);
    scene_light_init(&p->light, p->options.sun_azimuth, p->options.sun_elevation);
    scene_encode_prepare();
    if (options->colour && !(p->colours = scene_colours_open(options->colour, dem, options->run, error))) {
        free(p);
        return NULL;
    }
    return p;
}

void scene_painter_destroy(scene_painter *painter)
{
    if (painter)
        scene_colours_destroy(painter->colours);
    free(painter);
}

/* ---- light ---- */

/* A picture in the making. */
typedef struct painting {
    const scene_painter *painter;
    const scene_stage *stage;
    const scene_camera *camera; /* of pixels */
    scene_picture *picture;
    float share;      /* of this view in the picture */
    scene_rgb *light; /* by pixel, summed over views; NULL: there is only one */
    bool last;
    float *depth; /* NULL: colours are wanted */
} painting;

/* The sine of the elevation of a direction, in pixels from straight ahead, and its length at 1 ahead. */
static double sine_of(const scene_camera *c, double x, double y, double *length)
{
    double a = x / c->focal, b = y / c->focal;
    *length = sqrt(1 + a * a + b * b);
    return (c->right[2] * a + c->down[2] * b + c->ahead[2]) / *length;
}

static scene_rgb sky(float sine)
{
    const scene_rgb horizon = {0.72f, 0.79f, 0.86f}, zenith = {0.20f, 0.36f, 0.62f}, below = {0.56f, 0.61f, 0.66f};
    return sine > 0 ? scene_mix(horizon, zenith, sine * (2 - sine)) : scene_mix(horizon, below, -sine);
}

static scene_rgb light_of(const painting *p, const scene_hit *hit, double x, double y)
{
    const scene_painter *painter = p->painter;
    double length, sine = sine_of(p->camera, x / SAMPLES, y / SAMPLES, &length);
    if (!(hit->nearness > 0))
        return sky((float)sine);
    scene_point point;
    scene_stage_point(p->stage, hit, x, y, painter->options.facets, &point);
    scene_rgb colour;
    double pixel = point.at[2] * length / p->camera->focal;
    if (!painter->colours || !scene_colours_at(painter->colours, point.i, point.j, pixel, &colour))
        colour = scene_palette_at(&painter->palette, (float)point.height);
    colour = scene_lit_normal(&painter->light, colour, point.normal, 1);
    if (painter->options.haze == 0)
        return colour;
    const scene_rgb air = {0.66f, 0.74f, 0.83f};
    double distance = point.at[2] * length / painter->options.haze;
    float lost = (float)(distance * distance / (1 + distance * distance));
    return scene_mix(colour, air, isnan(lost) ? 1 : lost);
}

/* A threshold in (-0.5, 0.5) steps of a byte, by position: a slow gradient comes out without bands. */
static float dither(int64_t x, int64_t y)
{
    uint32_t h = (uint32_t)x * 0x9e3779b1u ^ (uint32_t)y * 0x85ebca77u;
    h = (h ^ h >> 15) * 0x2c1b3c6du;
    h = (h ^ h >> 12) * 0x297a2d39u;
    return ((float)((h ^ h >> 15) >> 8) + 0.5f) / 16777216 - 0.5f;
}

static void encode(const scene_rgb *light, float noise, unsigned char out[4])
{
    /* a byte of sRGB is about that share of bright linear light, and less of dim one */
    float factor = 1 + noise * 0.0089f;
    out[0] = scene_encode(light->r * factor);
    out[1] = scene_encode(light->g * factor);
    out[2] = scene_encode(light->b * factor);
    out[3] = 255;
}

/* The mean of a pixel's samples. Where all show the same triangle, its middle counts for them. */
static scene_rgb pixel_light(const painting *p, const scene_canvas *canvas, int column, int row)
{
    const scene_hit *first = &canvas->hits[(size_t)row * SAMPLES * (size_t)canvas->width + (size_t)column * SAMPLES];
    double x = canvas->left + column * SAMPLES, y = canvas->top + row * SAMPLES;
    const scene_hit *hits[SAMPLES * SAMPLES];
    bool same = true;
    for (int k = 0; k < SAMPLES * SAMPLES; k++) {
        hits[k] = first + k / SAMPLES * canvas->width + k % SAMPLES;
        same = same && (hits[k]->nearness > 0) == (first->nearness > 0) &&
               (hits[k]->triangle == first->triangle || !(first->nearness > 0));
    }
    if (same)
        return light_of(p, first, x + SAMPLES / 2.0, y + SAMPLES / 2.0);
    scene_rgb sum = {0, 0, 0};
    for (int k = 0; k < SAMPLES * SAMPLES; k++) {
        scene_rgb c = light_of(p, hits[k], x + k % SAMPLES + 0.5, y + k / SAMPLES + 0.5);
        sum = (scene_rgb){sum.r + c.r, sum.g + c.g, sum.b + c.b};
    }
    const float share = 1.0f / (SAMPLES * SAMPLES);
    return (scene_rgb){sum.r * share, sum.g * share, sum.b * share};
}

static void resolve(const painting *p, const scene_canvas *canvas, int64_t top)
{
    int64_t width = p->picture->width;
    for (int row = 0; row < canvas->height / SAMPLES; row++)
        for (int column = 0; column < width; column++) {
            size_t at = (size_t)((top + row) * width + column);
            scene_rgb light = pixel_light(p, canvas, column, row);
            if (p->light) {
                scene_rgb *sum = &p->light[at];
                *sum =
                    (scene_rgb){sum->r + light.r * p->share, sum->g + light.g * p->share, sum->b + light.b * p->share};
                light = *sum;
            }
            if (p->last)
                encode(&light, dither(column, top + row), p->picture->rgba + 4 * at);
        }
}

static void keep_depth(const painting *p, const scene_canvas *canvas, int64_t top)
{
    for (int row = 0; row < canvas->height; row++)
        for (int column = 0; column < canvas->width; column++) {
            size_t at = (size_t)row * (size_t)canvas->width + (size_t)column;
            scene_point point = {.at = {0, 0, (double)NAN}};
            if (canvas->hits[at].nearness > 0)
                scene_stage_point(p->stage, &canvas->hits[at], canvas->left + column + 0.5, canvas->top + row + 0.5,
                                  true, &point);
            p->depth[(size_t)top * (size_t)canvas->width + at] = (float)point.at[2];
        }
}

static tl_status paint_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const painting *p = context;
    scene_canvas canvas = {.hits = tl_alloc(scene_stage_band_hits(p->stage), sizeof *canvas.hits)};
    if (!canvas.hits)
        return tl_fail_memory(error, "the picture");
    scene_stage_draw(p->stage, (int)item, &canvas);
    double tall = p->camera->height / 2;
    if (p->depth)
        keep_depth(p, &canvas, (int64_t)(canvas.top + tall));
    else
        resolve(p, &canvas, (int64_t)((canvas.top + tall * SAMPLES) / SAMPLES));
    free(canvas.hits);
    return TL_OK;
}

/* Draws one view of a picture. */
static tl_status paint_view(painting *p, const tl_mesh *mesh, const scene_view *view, tl_error *error)
{
    const tl_view_picture_options *o = &p->painter->options;
    const scene_stage_options so = {.samples = p->depth ? 1 : SAMPLES,
                                    .exaggeration = o->exaggeration,
                                    .normals = !p->depth && !o->facets,
                                    .run = o->run};
    scene_stage *stage = scene_stage_create(mesh, p->painter->dem, view, &so, error);
    if (!stage)
        return TL_ERROR_MEMORY;
    p->stage = stage;
    p->camera = scene_view_camera(view);
    tl_run quiet = o->run ? *o->run : (tl_run){0};
    quiet.progress = NULL;
    tl_status status = tl_parallel_for(&quiet, (uint64_t)scene_stage_bands(stage), 0, paint_band, p, error);
    scene_stage_destroy(stage);
    return status;
}

tl_status scene_paint(const scene_painter *painter, const tl_mesh *mesh, const scene_view *const *views, size_t count,
                      scene_picture *out, tl_error *error)
{
    const scene_camera *c = scene_view_camera(views[0]);
    painting p = {.painter = painter, .share = 1 / (float)count, .picture = out};
    tl_error local = {0};
    error = error ? error : &local;
    for (size_t k = 1; k < count; k++)
        if (scene_view_camera(views[k])->width != c->width || scene_view_camera(views[k])->height != c->height)
            return tl_fail(error, TL_ERROR_ARGUMENT, "%s: views of different sizes make no picture",
                           painter->dem->info.name);
    tl_status status = tl_run_fits(painter->options.run, c->width * c->height * (count > 1 ? 16 : 4), "the picture",
                                   "drawing it", error);
    if (status == TL_OK)
        status = scene_picture_init(out, (int64_t)c->width, (int64_t)c->height, error);
    if (status != TL_OK)
        return status;
    if (count > 1 && !(p.light = calloc((size_t)c->width * (size_t)c->height, sizeof *p.light)))
        status = tl_fail_memory(error, "the picture");
    for (size_t k = 0; k < count && status == TL_OK; k++) {
        p.last = k == count - 1;
        error->status = TL_OK;
        if (paint_view(&p, mesh, views[k], error) != TL_OK)
            status = error->status;
    }
    free(p.light);
    if (status != TL_OK)
        scene_picture_finish(out);
    return status;
}

tl_status scene_paint_depth(const scene_painter *painter, const tl_mesh *mesh, const scene_view *view, float **out,
                            tl_error *error)
{
    const scene_camera *c = scene_view_camera(view);
    painting p = {.painter = painter};
    tl_error local = {0};
    error = error ? error : &local;
    tl_status status = tl_run_fits(painter->options.run, c->width * c->height * 4, "the picture", "its depths", error);
    if (status != TL_OK)
        return status;
    p.depth = tl_alloc_grid((int64_t)c->width, (int64_t)c->height, sizeof *p.depth);
    if (!p.depth)
        return tl_fail_memory(error, "the picture");
    error->status = TL_OK;
    if (paint_view(&p, mesh, view, error) == TL_OK) {
        *out = p.depth;
        return TL_OK;
    }
    free(p.depth);
    return error->status;
}
