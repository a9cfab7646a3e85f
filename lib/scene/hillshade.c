/* The picture from above. */
#include "dem/crs.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/scene/light.h"
#include "lib/scene/render.h"
#include "lib/scene/resample.h"

#include <math.h>
#include <string.h>

enum {
    LONGEST = 2048,
    GAP = 8,                     /* pixels between two pictures */
    PANEL = (LONGEST - GAP) / 2, /* of two pictures side by side */
    PALETTE_SAMPLES = 1 << 16,
};

/* ---- picture ---- */

tl_status scene_picture_check(int64_t width, int64_t height, tl_error *error)
{
    if (width > SCENE_PICTURE_MAX || height > SCENE_PICTURE_MAX)
        return tl_fail(
            error, TL_ERROR_ARGUMENT,
            "the picture would have %lld x %lld pixels, and %d on a side are the most; ask for a smaller one",
            (long long)width, (long long)height, SCENE_PICTURE_MAX);
    return TL_OK;
}

tl_status scene_picture_init(scene_picture *picture, int64_t width, int64_t height, tl_error *error)
{
    tl_status status = scene_picture_check(width, height, error);
    if (status != TL_OK)
        return status;
    *picture = (scene_picture){.width = width, .height = height};
    picture->rgba = tl_alloc_grid(width, height, 4);
    if (!picture->rgba)
        return tl_fail_memory(error, "the picture");
    memset(picture->rgba, 0, (size_t)(width * height) * 4);
    return TL_OK;
}

void scene_picture_finish(scene_picture *picture)
{
    free(picture->rgba);
    if (picture->finish)
        picture->finish(picture->context);
    *picture = (scene_picture){0};
}

bool scene_has_sea_level(const tl_georef *georef)
{
    /* every ellipsoid of the Earth is within a kilometre of this, and no other body is */
    return georef->crs && fabs(georef->crs->semi_major - 6378000) < 2000;
}

/* ---- what is shown ---- */

/* The part of a raster that a picture shows, and the size of its pixels. */
typedef struct frame {
    double pixel; /* metres */
    int64_t width, height;
    scene_axis x, y;
} frame;

static int64_t at_least_one(double pixels)
{
    return pixels < 1 ? 1 : pixels > 1e15 ? (int64_t)1e15 : (int64_t)(pixels + 0.5);
}

/* Whole pixels of a raster in the middle of the picture. Where a pixel is a whole number of samples, its rim is on that
 * of samples, so that the mean is one of whole samples. */
static scene_axis centred(int64_t samples, int64_t pixels, double step)
{
    scene_axis axis = {.step = step, .pixels = pixels};
    axis.origin = ((double)samples - 1) / 2 - step * ((double)pixels - 1) / 2;
    if (step == floor(step))
        axis.origin = floor(axis.origin - (step - 1) / 2 + 0.5) + (step - 1) / 2;
    return axis;
}

/* Metres a pixel: at most `most` pixels each way, a whole number of the smaller cells if no size is asked for. */
static double pixel_of(const tl_source_info *info, int64_t width, int64_t height)
{
    const tl_georef *g = &info->georef;
    double east = g->cell_x * (double)info->width, north = g->cell_y * (double)info->height;
    if (width && height)
        return fmax(east / (double)width, north / (double)height);
    if (width || height)
        return width ? east / (double)width : north / (double)height;
    double cell = fmin(g->cell_x, g->cell_y);
    return cell * fmax(1, ceil(fmax(east, north) / cell / LONGEST - 1e-9));
}

static frame frame_of(const tl_source_info *info, double pixel, int64_t width, int64_t height)
{
    const tl_georef *g = &info->georef;
    frame f = {.pixel = pixel};
    f.width = width ? width : at_least_one(g->cell_x * (double)info->width / pixel);
    f.height = height ? height : at_least_one(g->cell_y * (double)info->height / pixel);
    f.x = centred(info->width, f.width, pixel / g->cell_x);
    f.y = centred(info->height, f.height, pixel / g->cell_y);
    return f;
}

/* Of two: the finer one with a sample a pixel, as much around the middle as fits. */
static frame frame_of_two(const tl_source_info *a, const tl_source_info *b, int64_t width, int64_t height)
{
    const tl_georef *g = &a->georef, *h = &b->georef;
    double pixel = fmin(fmin(g->cell_x, g->cell_y), fmin(h->cell_x, h->cell_y));
    int64_t widest = width ? (width - GAP) / 2 : PANEL, highest = height ? height : PANEL;
    int64_t wide = at_least_one(g->cell_x * (double)a->width / pixel),
            high = at_least_one(g->cell_y * (double)a->height / pixel);
    return frame_of(a, pixel, width ? widest : tl_int64_min(wide, widest),
                    height ? highest : tl_int64_min(high, highest));
}

static bool placed(const tl_georef *g)
{
    return g->located && g->transform[2] == 0 && g->transform[4] == 0 && g->transform[1] != 0 && g->transform[5] != 0;
}

/* The same pixels on the axis of a second raster: by coordinates in the same CRS, else both cover the same ground. */
static scene_axis axis_beside(const scene_axis *axis, const tl_source_info *a, const tl_source_info *b, bool columns)
{
    const double *s = a->georef.transform + (columns ? 0 : 3), *t = b->georef.transform + (columns ? 0 : 3);
    int k = columns ? 1 : 2;
    int64_t m = columns ? a->width : a->height, n = columns ? b->width : b->height;
    double scale, offset;
    const tl_crs *crs = a->georef.crs, *other = b->georef.crs;
    bool same = crs && other ? dem_crs_equivalent(crs, other) : crs == other;
    if (same && placed(&a->georef) && placed(&b->georef)) {
        scale = s[k] / t[k];
        offset = (s[0] - t[0]) / t[k];
    } else if (a->type == TL_RASTER_POINT && m > 1 && n > 1) {
        scale = (double)(n - 1) / (double)(m - 1);
        offset = 0;
    } else {
        scale = (double)n / (double)m;
        offset = 0.5 * scale - 0.5;
    }
    return (scene_axis){scale * axis->origin + offset, scale * axis->step, axis->pixels};
}

static bool meets(const scene_axis *axis, int64_t samples)
{
    return axis->step > 0 && isfinite(axis->origin) && axis->origin < (double)samples &&
           axis->origin + axis->step * (double)axis->pixels > -1;
}

/* ---- shading ---- */

/* One raster or two beside each other, and all that rows of their picture are made of. */
typedef struct shading {
    int count;
    scene_raster rasters[2];
    double metres[2]; /* exaggerated metres a pixel: one unit of height / the pixel */
    int64_t width;    /* of the whole picture */
    scene_palette palette;
    scene_light light;
    tl_run run;
} shading;

/* A band of rows of the picture. */
typedef struct band {
    const shading *shading;
    int64_t y;
    unsigned char *rgba;
} band;

/* Slope between the neighbours of pixel p along one direction, whichever of them are there; units of height a pixel. */
static double difference(const float *heights, size_t p, ptrdiff_t stride, bool before, bool after)
{
    double here = (double)heights[p];
    double low = before ? (double)heights[(ptrdiff_t)p - stride] : (double)NAN;
    double high = after ? (double)heights[(ptrdiff_t)p + stride] : (double)NAN;
    if (!isnan(low) && !isnan(high))
        return (high - low) / 2;
    return !isnan(high) ? high - here : !isnan(low) ? here - low : 0;
}

static void shade_pixel(const shading *s, int raster, int64_t x, int64_t y, unsigned char *rgba)
{
    const scene_raster *r = &s->rasters[raster];
    double metres = s->metres[raster];
    size_t p = (size_t)(y * r->width + x);
    float height = r->heights[p];
    if (isnan(height))
        return;
    double east = difference(r->heights, p, 1, x > 0, x + 1 < r->width) * metres;
    double south = difference(r->heights, p, r->width, y > 0, y + 1 < r->height) * metres;
    scene_rgb c = scene_lit(&s->light, scene_palette_at(&s->palette, height), (float)east, (float)-south, 1);
    rgba[0] = scene_encode(c.r);
    rgba[1] = scene_encode(c.g);
    rgba[2] = scene_encode(c.b);
    rgba[3] = r->coverage[p];
}

static tl_status shade_row(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    (void)error;
    const band *b = context;
    const shading *s = b->shading;
    unsigned char *row = b->rgba + (int64_t)item * s->width * 4;
    memset(row, 0, (size_t)s->width * 4);
    for (int i = 0; i < s->count; i++) {
        int64_t width = s->rasters[i].width, left = i * (width + GAP);
        for (int64_t x = 0; x < width; x++)
            shade_pixel(s, i, x, b->y + (int64_t)item, row + 4 * (left + x));
    }
    return TL_OK;
}

static tl_status shade_rows(void *context, int64_t y, int64_t count, unsigned char *rgba, tl_error *error)
{
    const shading *s = context;
    band b = {s, y, rgba};
    return tl_parallel_for(&s->run, (uint64_t)count, 0, shade_row, &b, error);
}

static void shading_destroy(void *context)
{
    shading *s = context;
    for (int i = 0; i < s->count; i++)
        scene_raster_finish(&s->rasters[i]);
    free(s);
}

static void pick(const scene_raster *raster, size_t count, float *out)
{
    size_t pixels = (size_t)(raster->width * raster->height);
    for (size_t i = 0; i < count; i++)
        out[i] = raster->heights[(size_t)((double)i / (double)count * (double)pixels)];
}

/* One scale of colours for all rasters of a picture. */
static tl_status palette_init(scene_palette *palette, const scene_raster *rasters, int count, bool grey, bool sea_level,
                              tl_error *error)
{
    float *heights = tl_alloc(PALETTE_SAMPLES, 2 * sizeof *heights);
    if (!heights)
        return tl_fail_memory(error, "the picture");
    for (int i = 0; i < count; i++)
        pick(&rasters[i], PALETTE_SAMPLES, heights + i * PALETTE_SAMPLES);
    scene_palette_init(palette, heights, (size_t)count * PALETTE_SAMPLES, grey, sea_level);
    free(heights);
    return TL_OK;
}

static tl_run quiet(const tl_run *run)
{
    tl_run result = run ? *run : (tl_run){0};
    result.progress = NULL;
    return result;
}

static void prepare(shading *s, const tl_source *const *sources, const frame *f, const tl_preview_options *options)
{
    bool given = options->sun_azimuth != 0 || options->sun_elevation != 0;
    double exaggeration = options->exaggeration != 0 ? options->exaggeration : 1;
    scene_light_init(&s->light, given ? options->sun_azimuth : 315, given ? options->sun_elevation : 45);
    scene_encode_prepare();
    s->run = quiet(options->run); /* the work was in the reading */
    for (int i = 0; i < s->count; i++)
        s->metres[i] = sources[i]->info.georef.height_unit * exaggeration / f->pixel;
}

static tl_status resample(shading *s, const tl_source *const *sources, const frame *f, const tl_run *run,
                          tl_error *error)
{
    tl_status status = TL_OK;
    for (int i = 0; i < s->count && status == TL_OK; i++) {
        const tl_source_info *a = &sources[0]->info, *b = &sources[i]->info;
        scene_axis x = i ? axis_beside(&f->x, a, b, true) : f->x, y = i ? axis_beside(&f->y, a, b, false) : f->y;
        if (!meets(&x, b->width) || !meets(&y, b->height))
            status = tl_fail(error, TL_ERROR_ARGUMENT, "%s: does not cover the middle of %s; name rasters of one place",
                             b->name, a->name);
        if (status == TL_OK)
            status = scene_raster_init(&s->rasters[i], f->width, f->height, error);
        if (status == TL_OK)
            status = scene_resample(sources[i], &x, &y, run, &s->rasters[i], error);
    }
    return status;
}

tl_status scene_hillshade(const tl_source *source, const tl_source *beside, const tl_preview_options *options,
                          scene_picture *picture, tl_error *error)
{
    const tl_source_info *info = &source->info;
    const tl_source *const sources[2] = {source, beside};
    if (beside && options->width && options->width < GAP + 2)
        return tl_fail(error, TL_ERROR_ARGUMENT, "a picture of two needs a width of at least %d pixels", GAP + 2);
    frame f = beside ? frame_of_two(info, &beside->info, options->width, options->height)
                     : frame_of(info, pixel_of(info, options->width, options->height), options->width, options->height);
    int64_t width = beside ? 2 * f.width + GAP : f.width;
    tl_status status = scene_picture_check(width, f.height, error);
    const double pixel_bytes = sizeof(float) + 1; /* height and coverage */
    if (status == TL_OK)
        status = tl_run_fits(options->run, pixel_bytes * (double)width * (double)f.height, "the picture", "drawing it",
                             error);
    if (status != TL_OK)
        return status;
    shading *s = calloc(1, sizeof *s);
    if (!s)
        return tl_fail_memory(error, "the picture");
    s->count = beside ? 2 : 1;
    s->width = width;
    prepare(s, sources, &f, options);
    status = resample(s, sources, &f, options->run, error);
    if (status == TL_OK)
        status =
            palette_init(&s->palette, s->rasters, s->count, options->grey, scene_has_sea_level(&info->georef), error);
    if (status == TL_OK)
        *picture = (scene_picture){
            .width = width, .height = f.height, .context = s, .rows = shade_rows, .finish = shading_destroy};
    else
        shading_destroy(s);
    return status;
}
