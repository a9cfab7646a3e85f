#include "lib/scene/layers.h"

#include "fbm/elementary.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/scene/field.h"
#include "lib/scene/layer_rules.h"
#include "lib/scene/light.h"
#include "lib/scene/north_up.h"
#include "lib/scene/render.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct patch patch;

/* One sample, with what is around it. */
typedef struct spot {
    double z;
    double east, north; /* slopes along rows, and against columns as rows run: metres up a metre */
    double curvature;   /* mean curvature, 1 / metre: above 0 in hollows, below 0 on ridges */
    double sigma;       /* NaN where it is not asked for */
    double hurst;       /* likewise */
} spot;

typedef void (*maker)(const scene_layer *, const spot *, float *out);

struct scene_layer {
    const tl_layer_kind *kind;
    maker make;
    const tl_source *heights;
    bool needs_sigma, needs_hurst;
    double axes[2][2]; /* unit vectors of columns and of rows in the CRS's plane, east and north */
    double sigma;      /* metres over one sample of the finest level where the strength is 1 or, */
    bool has_places;   /* where exponents vary, over one of the model */
    scene_light light;
    scene_palette palette;
    layer_rules rules;
};

/* ---- Kinds ---- */

static double height_in_metres(const scene_layer *layer, double z)
{
    return z * layer->heights->info.georef.height_unit;
}

/* Unit normal of a surface with these slopes. */
static void normal_of(double x, double y, float *out)
{
    double length = sqrt(1 + x * x + y * y);
    out[0] = (float)(-x / length), out[1] = (float)(-y / length), out[2] = (float)(1 / length);
}

/* Slopes along the CRS's axes, from those along columns and against rows. */
static void to_axes(const scene_layer *layer, const spot *at, double *east, double *north)
{
    *east = at->east * layer->axes[0][0] - at->north * layer->axes[1][0];
    *north = at->east * layer->axes[0][1] - at->north * layer->axes[1][1];
}

static void make_normal(const scene_layer *layer, const spot *at, float *out)
{
    double east, north;
    to_axes(layer, at, &east, &north);
    normal_of(east, north, out);
}

static void make_tangent(const scene_layer *layer, const spot *at, float *out)
{
    (void)layer;
    normal_of(at->east, at->north, out);
}

static double degrees(double slope)
{
    return atan(slope) * (180 / 3.14159265358979323846);
}

static void make_slope(const scene_layer *layer, const spot *at, float *out)
{
    (void)layer;
    *out = (float)degrees(hypot(at->east, at->north));
}

static void make_curvature(const scene_layer *layer, const spot *at, float *out)
{
    (void)layer;
    *out = (float)at->curvature;
}

static void make_sigma(const scene_layer *layer, const spot *at, float *out)
{
    (void)layer;
    *out = (float)at->sigma;
}

static void make_splat(const scene_layer *layer, const spot *at, float *out)
{
    const double facts[LAYER_FACTS] = {degrees(hypot(at->east, at->north)), height_in_metres(layer, at->z),
                                       at->curvature, at->sigma};
    layer_rules_weigh(&layer->rules, facts, out);
}

static void make_colour(const scene_layer *layer, const spot *at, float *out)
{
    double east, north;
    to_axes(layer, at, &east, &north);
    scene_rgb c =
        scene_lit(&layer->light, scene_palette_at(&layer->palette, (float)at->z), (float)east, (float)north, 1);
    out[0] = c.r, out[1] = c.g, out[2] = c.b;
}

static void make_albedo(const scene_layer *layer, const spot *at, float *out)
{
    scene_rgb c = scene_palette_at(&layer->palette, (float)at->z);
    out[0] = c.r, out[1] = c.g, out[2] = c.b;
}

static void make_hurst(const scene_layer *layer, const spot *at, float *out)
{
    (void)layer;
    *out = (float)at->hurst;
}

/* Made from the validity, which voids have too: see scene_layer_read. */
static void make_mask(const scene_layer *layer, const spot *at, float *out)
{
    (void)layer;
    (void)at;
    *out = 1;
}

static const tl_layer_kind kinds[] = {
    {"normal", "unit normals: east, north, up", 3, {"R", "G", "B"}},
    {"tangent", "unit normals in the picture's own axes: right, up, out of it", 3, {"R", "G", "B"}},
    {"slope", "steepness in degrees", 1, {"slope"}},
    {"curvature", "mean curvature in 1/m: above 0 in hollows, below 0 on ridges", 1, {"curvature"}},
    {"splat", "shares of rock, scree, soil and snow, by rules", 4, {"R", "G", "B", "A"}},
    {"colour", "colours by height, shaded, linear", 3, {"R", "G", "B"}},
    {"albedo", "the same without light, for what is lit later", 3, {"R", "G", "B"}},
    {"sigma",
     "standard deviation of the detail's height difference over one sample, in metres (--support point)",
     1,
     {"sigma"}},
    {"hurst", "Hurst exponent of the finest detail", 1, {"hurst"}},
    {"mask", "1 where the height is known, 0.5 where it was filled, 0 in voids", 1, {"mask"}},
    {NULL, NULL, 0, {NULL}},
};

/* In the order of `kinds`. */
static const maker makers[] = {make_normal, make_tangent, make_slope, make_curvature, make_splat,
                               make_colour, make_albedo,  make_sigma, make_hurst,     make_mask};

const tl_layer_kind *tl_layers(void)
{
    return kinds;
}

/* ---- What is around a sample ---- */

/* Metres from sample to sample in a row, and from row to row: of a geographic raster by the ellipsoid's radii at that
 * row's latitude. */
static void cell_of_row(const tl_source_info *info, int64_t row, double *x, double *y)
{
    const tl_georef *g = &info->georef;
    *x = g->cell_x, *y = g->cell_y;
    if (!g->crs || !g->located || !tl_crs_is_geographic(g->crs) || !(g->crs->semi_major > 0) || g->transform[4] != 0)
        return;
    const double radian = 3.14159265358979323846 / 180;
    double latitude = (g->transform[3] + g->transform[5] * (double)row) * radian, f = g->crs->flattening;
    double e2 = f * (2 - f), root = sqrt(1 - e2 * sin(latitude) * sin(latitude)), a = g->crs->semi_major;
    *x = fabs(g->transform[1]) * radian * a / root * fmax(cos(latitude), 1e-6);
    *y = fabs(g->transform[5]) * radian * a * (1 - e2) / (root * root * root);
}

/* Heights of a window with one sample more on all sides, in metres; NaN where there is none. */
struct patch {
    tl_window window;
    float *heights;
    float *strengths, *exponents; /* of the model's samples around; NULL: not asked for, or 1 everywhere */
    tl_window model;              /* their window */
    int level, cells;             /* cells: 1 where samples stand for them */
};

static inline double height_at(const patch *p, int64_t x, int64_t y)
{
    return (double)p->heights[(y + 1) * (p->window.width + 2) + x + 1];
}

static double bend_of(double before, double here, double behind, double step)
{
    double bend = ((before - here) + (behind - here)) / (step * step);
    return isnan(bend) ? 0 : bend;
}

/* Mean curvature of the graph of heights [do Carmo, Differential Geometry of Curves and Surfaces, 3-3]: of slopes p, q
 * and second derivatives r, s, t it is ((1 + q^2) r - 2 p q s + (1 + p^2) t) / (2 (1 + p^2 + q^2)^(3/2)). */
static double curvature_of(double p, double q, double r, double s, double t)
{
    double w = 1 + p * p + q * q;
    return ((1 + q * q) * r - 2 * p * q * s + (1 + p * p) * t) / (2 * w * sqrt(w));
}

/* What is known at the model's samples, between them. */
static double between(const patch *p, const float *values, int64_t x, int64_t y)
{
    if (!values)
        return 1;
    double scale = ldexp(1, -p->level), shift = 0.5 * p->cells * (1 - scale); /* cells' middles */
    double u = (double)(p->window.x + x) * scale - shift, v = (double)(p->window.y + y) * scale - shift;
    int64_t i0 = (int64_t)floor(u), j0 = (int64_t)floor(v);
    const float *at = values + (j0 - p->model.y) * p->model.width + i0 - p->model.x;
    double a = u - (double)i0, b = v - (double)j0;
    return (1 - b) * ((1 - a) * (double)at[0] + a * (double)at[1]) +
           b * ((1 - a) * (double)at[p->model.width] + a * (double)at[p->model.width + 1]);
}

/* fBm's rule, where exponents vary: delta over 2^-level samples of the model. */
static double sigma_at(const scene_layer *layer, const patch *p, int64_t x, int64_t y)
{
    double sigma = layer->sigma * between(p, p->strengths, x, y);
    return layer->has_places ? sigma * fbm_exp2(-p->level * between(p, p->exponents, x, y)) : sigma;
}

static spot spot_at(const scene_layer *layer, const patch *p, int64_t x, int64_t y, double dx, double dy)
{
    double z = height_at(p, x, y), west = height_at(p, x - 1, y), east = height_at(p, x + 1, y);
    double up = height_at(p, x, y - 1), down = height_at(p, x, y + 1);
    double cross = height_at(p, x + 1, y - 1) - height_at(p, x - 1, y - 1) - height_at(p, x + 1, y + 1) +
                   height_at(p, x - 1, y + 1);
    spot at = {.z = z / layer->heights->info.georef.height_unit,
               .east = scene_slope(west, z, east, dx),
               .north = scene_slope(down, z, up, dy),
               .sigma = layer->needs_sigma ? sigma_at(layer, p, x, y) : (double)NAN,
               .hurst = layer->needs_hurst ? between(p, p->exponents, x, y) : (double)NAN};
    at.curvature = curvature_of(at.east, at.north, bend_of(west, z, east, dx), isnan(cross) ? 0 : cross / (4 * dx * dy),
                                bend_of(up, z, down, dy));
    return at;
}

/* ---- Reading ---- */

static tl_status read_strengths(const scene_layer *layer, patch *p, tl_error *error)
{
    if (!(layer->needs_sigma || layer->needs_hurst) || !scene_field_dem(layer->heights))
        return TL_OK;
    tl_window w = p->window, *m = &p->model;
    p->level = layer->heights->info.level;
    p->cells = layer->heights->info.type == TL_RASTER_AREA;
    m->x = (w.x >> p->level) - p->cells, m->y = (w.y >> p->level) - p->cells;
    m->width = ((w.x + w.width - 1) >> p->level) + 2 - m->x;
    m->height = ((w.y + w.height - 1) >> p->level) + 2 - m->y;
    const tl_source *field = layer->heights;
    bool exponents = layer->needs_hurst || layer->has_places;
    p->strengths = tl_alloc_grid(m->width, m->height, sizeof *p->strengths);
    p->exponents = exponents ? tl_alloc_grid(m->width, m->height, sizeof *p->exponents) : NULL;
    if (!p->strengths || (exponents && !p->exponents))
        return tl_fail_memory(error, field->info.name);
    tl_status status = layer->needs_sigma ? scene_field_strengths(field, *m, p->strengths, error) : TL_OK;
    return status == TL_OK && exponents ? scene_field_hursts(field, *m, p->exponents, error) : status;
}

static tl_status read_heights(const scene_layer *layer, patch *p, tl_error *error)
{
    const tl_source_info *info = &layer->heights->info;
    tl_window w = p->window;
    int64_t stride = w.width + 2, rows = w.height + 2;
    int64_t x0 = tl_int64_max(w.x - 1, 0), y0 = tl_int64_max(w.y - 1, 0);
    int64_t x1 = tl_int64_min(w.x + w.width + 1, info->width), y1 = tl_int64_min(w.y + w.height + 1, info->height);
    tl_window inside = {x0, y0, x1 - x0, y1 - y0};
    float *read = tl_alloc_grid(inside.width, inside.height, sizeof *read);
    p->heights = tl_alloc_grid(stride, rows, sizeof *p->heights);
    tl_status status = read && p->heights ? tl_source_read(layer->heights, info->level, inside, read, error)
                                          : tl_fail_memory(error, info->name);
    for (int64_t k = 0; status == TL_OK && k < stride * rows; k++)
        p->heights[k] = NAN;
    for (int64_t y = 0; status == TL_OK && y < inside.height; y++)
        for (int64_t x = 0; x < inside.width; x++)
            p->heights[(inside.y + y - w.y + 1) * stride + inside.x + x - w.x + 1] =
                (float)((double)read[y * inside.width + x] * info->georef.height_unit);
    free(read);
    return status;
}

static tl_status read_mask(const scene_layer *layer, tl_window window, float *out, tl_error *error)
{
    size_t samples = (size_t)(window.width * window.height);
    unsigned char *known = tl_alloc(samples, 1);
    tl_status status = known ? tl_source_validity(layer->heights, layer->heights->info.level, window, known, error)
                             : tl_fail_memory(error, layer->heights->info.name);
    for (size_t k = 0; status == TL_OK && k < samples; k++)
        out[k] = known[k] == TL_MEASURED ? 1.0f : known[k] == TL_FILLED ? 0.5f : 0.0f;
    free(known);
    return status;
}

tl_status scene_layer_read(const scene_layer *layer, tl_window window, float *out, tl_error *error)
{
    if (layer->make == make_mask)
        return read_mask(layer, window, out, error);
    patch p = {.window = window};
    size_t channels = layer->kind->channels, samples = (size_t)(window.width * window.height);
    tl_status status = read_heights(layer, &p, error);
    if (status == TL_OK)
        status = read_strengths(layer, &p, error);
    for (int64_t y = 0; status == TL_OK && y < window.height; y++) {
        double dx, dy;
        cell_of_row(&layer->heights->info, window.y + y, &dx, &dy);
        for (int64_t x = 0; x < window.width; x++) {
            float values[SCENE_LAYER_CHANNELS] = {NAN, NAN, NAN, NAN};
            if (!isnan(height_at(&p, x, y))) {
                spot at = spot_at(layer, &p, x, y, dx, dy);
                layer->make(layer, &at, values);
            }
            for (size_t c = 0; c < channels; c++)
                out[c * samples + (size_t)(y * window.width + x)] = values[c];
        }
    }
    free(p.heights);
    free(p.strengths);
    free(p.exponents);
    return status;
}

tl_status scene_layer_read_upright(const scene_layer *layer, tl_window window, float *out, tl_error *error)
{
    const tl_source_info *info = &layer->heights->info;
    size_t samples = (size_t)(window.width * window.height);
    bool columns, rows;
    scene_north_up_turns(&info->georef, &columns, &rows);
    tl_window theirs = scene_turned_window(window, info->width, info->height, columns, rows);
    tl_status status = scene_layer_read(layer, theirs, out, error);
    for (size_t c = 0; status == TL_OK && c < layer->kind->channels; c++) {
        float *channel = out + c * samples;
        scene_turn(channel, window, columns, rows);
        bool turned = c == 0 ? columns : c == 1 && rows; /* what points to the right, and up, points back */
        for (size_t k = 0; k < samples && turned && layer->make == make_tangent; k++)
            channel[k] = -channel[k];
    }
    return status;
}

/* ---- Creation ---- */

static void find_axes(scene_layer *layer)
{
    const tl_georef *g = &layer->heights->info.georef;
    const double *t = g->transform;
    double x = hypot(t[1], t[4]), y = hypot(t[2], t[5]);
    layer->axes[0][0] = x > 0 ? t[1] / x : 1, layer->axes[0][1] = x > 0 ? t[4] / x : 0;
    layer->axes[1][0] = y > 0 ? t[2] / y : 0, layer->axes[1][1] = y > 0 ? t[5] / y : -1;
}

/* Colours over the heights of some rows of the coarsest level that is the source's own samples. */
static tl_status choose_colours(scene_layer *layer, const tl_source *s, tl_error *error)
{
    enum { ROWS = 512, MOST_WIDTH = 1 << 20 };
    const tl_source *model = scene_field_dem(s) ? scene_field_dem(s) : s;
    int64_t width = tl_int64_min(model->info.width, MOST_WIDTH), rows = tl_int64_min(model->info.height, ROWS);
    float *sample = tl_alloc_grid(width, rows, sizeof *sample);
    tl_status status = sample ? TL_OK : tl_fail_memory(error, s->info.name);
    for (int64_t k = 0; status == TL_OK && k < rows; k++) {
        tl_window row = {0, k * model->info.height / rows, width, 1};
        status = tl_source_read(model, model->info.level, row, sample + k * width, error);
    }
    if (status == TL_OK)
        scene_palette_init(&layer->palette, sample, (size_t)(width * rows), false,
                           scene_has_sea_level(&s->info.georef));
    free(sample);
    return status;
}

/* Of the field's own detail, at its finest level. */
static tl_status find_sigma(scene_layer *layer, tl_error *error)
{
    const tl_source *s = layer->heights;
    if (!scene_field_dem(s) || !scene_field_nests(s))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: the strength of its detail is not known place by place; sigma is a layer of fields over "
                       "points (--support point)",
                       s->info.name);
    double hurst;
    layer->has_places = scene_field_has_exponents(s);
    scene_field_fractal(s, layer->has_places ? 0 : s->info.level, &layer->sigma, &hurst);
    layer->sigma *= s->info.georef.height_unit;
    return TL_OK;
}

static tl_status check_hurst(const scene_layer *layer, tl_error *error)
{
    const tl_source *s = layer->heights;
    return scene_field_dem(s) ? TL_OK
                              : tl_fail(error, TL_ERROR_ARGUMENT,
                                        "%s: has no fractal detail; hurst is a layer of fields", s->info.name);
}

static tl_status prepare(scene_layer *layer, const tl_layer_options *options, const tl_source *colours_of,
                         tl_error *error)
{
    find_axes(layer);
    scene_light_init(&layer->light, 315, 45);
    layer->needs_sigma = layer->make == make_sigma;
    layer->needs_hurst = layer->make == make_hurst;
    tl_status status = layer->needs_hurst ? check_hurst(layer, error) : TL_OK;
    if (layer->make == make_splat) {
        status = layer_rules_read(options ? options->rules : NULL, &layer->rules, error);
        layer->needs_sigma = status == TL_OK && layer_rules_use(&layer->rules, LAYER_SIGMA);
    }
    if (status == TL_OK && layer->needs_sigma)
        status = find_sigma(layer, error);
    if (status == TL_OK && (layer->make == make_colour || layer->make == make_albedo))
        status = choose_colours(layer, colours_of, error);
    return status;
}

static scene_layer *create(const tl_source *heights, const char *kind, const tl_layer_options *options,
                           const tl_source *colours_of, tl_error *error)
{
    size_t k = 0;
    while (kinds[k].name && strcmp(kinds[k].name, kind) != 0)
        k++;
    if (!kinds[k].name) {
        tl_fail(error, TL_ERROR_ARGUMENT,
                "no layer '%.60s'; use normal, tangent, slope, curvature, splat, colour, albedo, sigma, hurst or mask",
                kind);
        return NULL;
    }
    scene_layer *layer = calloc(1, sizeof *layer);
    if (!layer) {
        tl_fail_memory(error, heights->info.name);
        return NULL;
    }
    layer->kind = &kinds[k];
    layer->make = makers[k];
    layer->heights = heights;
    if (prepare(layer, options, colours_of, error) == TL_OK)
        return layer;
    scene_layer_destroy(layer);
    return NULL;
}

scene_layer *scene_layer_create(const tl_source *heights, const char *kind, const tl_layer_options *options,
                                tl_error *error)
{
    return create(heights, kind, options, heights, error);
}

scene_layer *scene_layer_create_over(const tl_source *heights, const char *kind, const tl_source *colours_of,
                                     tl_error *error)
{
    return create(heights, kind, NULL, colours_of, error);
}

scene_layer *scene_layer_copy_over(const scene_layer *layer, const tl_source *heights)
{
    scene_layer *copy = malloc(sizeof *copy);
    if (copy) {
        *copy = *layer;
        copy->heights = heights;
    }
    return copy;
}

void scene_layer_destroy(scene_layer *layer)
{
    free(layer);
}

const tl_layer_kind *scene_layer_kind(const scene_layer *layer)
{
    return layer->kind;
}
