#include "cmd/report/cases.h"

#include "cmd/progress.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { SIDE = 33, WINDOW = 65 };

/* ---- Models ---- */

static double hills(int i, int j)
{
    return 100 + 20 * sin(i * .4) * cos(j * .3) + 3 * sin(i * 1.7 + j * 2.3);
}

static double flat(int i, int j)
{
    (void)i, (void)j;
    return 100;
}

static double spike(int i, int j)
{
    return i == SIDE / 2 && j == SIDE / 2 ? 1e6 : 0;
}

static double cliff(int i, int j)
{
    (void)j;
    return i < SIDE / 2 ? 0 : 3000;
}

static double saw(int i, int j)
{
    return (i + j) & 1 ? 10 : -10;
}

static double shorts(int i, int j)
{
    return (i * 7 + j * 3) % 5 < 2 ? -32768 : 32767;
}

static double vast(int i, int j)
{
    return (i + j) & 1 ? 1e30 : -1e30;
}

static double tiny(int i, int j)
{
    return i % 3 == 1 ? -0. : 1e-42 * ((i + 2 * j) % 5 - 2);
}

static double lofty(int i, int j)
{
    return 1e9 + 64 * ((i * 5 + j) % 7);
}

static double nothing(int i, int j)
{
    (void)i, (void)j;
    return (double)NAN;
}

static double checkers(int i, int j)
{
    return (i + j) & 1 ? (double)NAN : hills(i, j);
}

static double lone(int i, int j)
{
    return i == 5 && j == 7 ? 12 : (double)NAN;
}

#define FIELD .hurst = -1, .delta = -1
#define HILLS .z = hills, FIELD
#define FBM(h, d) .z = hills, .hurst = (h), .delta = (d)

const report_case report_cases[] = {
    {"field", "H = 0.01", FBM(.01, 1)},
    {"field", "H = 0.1", FBM(.1, 1)},
    {"field", "H = 0.5", FBM(.5, 1)},
    {"field", "H = 0.99", FBM(.99, 1)},
    {"field", "H jumps between 0.1 and 0.9 from sample to sample", FBM(-1, 1), .hurst_map = {.1, .9}},
    {"field", "delta = 0", FBM(.5, 0)},
    {"field", "delta = 1e-6", FBM(.5, 1e-6)},
    {"field", "delta = 1e6", FBM(.5, 1e6)},
    {"field", "delta jumps a million-fold from sample to sample", FBM(.5, -1), .delta_map = {1e-3, 1e3}},
    {"field", "30 levels deep, H = 0.1", FBM(.1, 1), .levels = 30},
    {"field", "30 levels deep, H = 0.9", FBM(.9, 1), .levels = 30},
    {"field", "30 levels deep, measured", HILLS, .levels = 30},
    {"field", "5 levels deep, means of cells", HILLS, .levels = 5, .means = true},
    {"field", "30 levels deep, means of cells", HILLS, .levels = 30, .means = true},

    {"model", "constant", .z = flat, FIELD},
    {"model", "1 x 1", HILLS, .width = 1, .height = 1},
    {"model", "1 x 1, means of cells", HILLS, .width = 1, .height = 1, .means = true},
    {"model", "1 x 33", HILLS, .width = 1},
    {"model", "33 x 1", HILLS, .height = 1},
    {"model", "33 x 1, means of cells", HILLS, .height = 1, .means = true},
    {"model", "2 x 2", HILLS, .width = 2, .height = 2},
    {"model", "one spike of 1e6", .z = spike, FIELD},
    {"model", "one spike of 1e6, means of cells", .z = spike, FIELD, .means = true},
    {"model", "a cliff of 3000 in one cell", .z = cliff, FIELD},
    {"model", "a saw of the shortest wave", .z = saw, FIELD},
    {"model", "int16, both ends", .z = shorts, FIELD, .quantum = 1},
    {"model", "-1e30 and 1e30", .z = vast, FIELD, .may_refuse = true},
    {"model", "denormal numbers and -0", .z = tiny, FIELD},
    {"model", "1e9 and some steps of a float", .z = lofty, FIELD},
    {"model", "all void", .z = nothing, FIELD},
    {"model", "every second sample void", .z = checkers, FIELD},
    {"model", "one valid sample", .z = lone, FIELD},

    {"place", "cells 1000 times as wide as high", HILLS, .cell_x = 1000, .cell_y = 1, .may_refuse = true},
    {"place", "the same, fractional Brownian motion", FBM(.5, 1), .cell_x = 1000, .cell_y = 1, .may_refuse = true},
    {"place", "cells of 1e-9 degrees", HILLS, .crs = "EPSG:4326", .x = 11, .y = 47, .cell_x = 1e-9, .cell_y = 1e-9},
    {"place", "cells of 1000 km", HILLS, .cell_x = 1e6, .cell_y = 1e6},
    {"place", "latitude 89.9", HILLS, .crs = "EPSG:4326", .x = 11, .y = 89.9, .cell_x = .001, .cell_y = .001,
     .may_refuse = true},
    {"place", "across the antimeridian", HILLS, .crs = "EPSG:4326", .x = 179.99, .y = 10, .cell_x = .001,
     .cell_y = .001},
    {"place", "coordinates of 1e7 m, cells of a millimetre", HILLS, .crs = "EPSG:32733", .x = 5e5, .y = 1e7 - 1,
     .cell_x = .001, .cell_y = .001},

    {"view", "an eye 100 m under the ground", HILLS, .fov = 60, .up = -100, .pixel_error = 1},
    {"view", "an eye on the ground", HILLS, .fov = 60, .up = 0, .pixel_error = 1},
    {"view", "an eye at 1e9 m", HILLS, .fov = 60, .up = 1e9, .pixel_error = 1},
    {"view", "0.01 degrees", HILLS, .fov = .01, .up = 300, .pixel_error = 1},
    {"view", "179 degrees", HILLS, .fov = 179, .up = 300, .pixel_error = 1},
    {"view", "a pixel error of 1e-6", HILLS, .fov = 60, .up = 300, .pixel_error = 1e-6},
    {"view", "a pixel error of 1e6", HILLS, .fov = 60, .up = 300, .pixel_error = 1e6},
    {"view", "a budget of 2 triangles", HILLS, .fov = 60, .up = 300, .budget = 2, .may_refuse = true},
    {"view", "a budget of 2^31 triangles", HILLS, .fov = 60, .up = 300, .budget = UINT64_C(1) << 31},
    {"view", "coordinates of 1e7 m, cells of a millimetre", HILLS, .crs = "EPSG:32733", .x = 5e5, .y = 1e7 - 1,
     .cell_x = .001, .cell_y = .001, .fov = 60, .up = .01, .pixel_error = 1},
    {0}};

#define DEPTH(l, h, d, at)                                                                           \
    {                                                                                                \
        .levels = (l), .hurst = {(h), (h)}, .delta = (d), .column = (at), .row = (at) / 3, .seed = 5 \
    }

const report_depth report_depths[] = {{"10 levels, H = 0.5", DEPTH(10, .5, 1, 0)},
                                      {"20 levels, H = 0.5", DEPTH(20, .5, 1, 0)},
                                      {"30 levels, H = 0.01", DEPTH(30, .01, 1, 0)},
                                      {"30 levels, H = 0.1", DEPTH(30, .1, 1, 0)},
                                      {"30 levels, H = 0.5", DEPTH(30, .5, 1, 0)},
                                      {"30 levels, H = 0.99", DEPTH(30, .99, 1, 0)},
                                      {"30 levels, H = 0.5, delta = 1e-6", DEPTH(30, .5, 1e-6, 0)},
                                      {"30 levels, H = 0.5, delta = 1e6", DEPTH(30, .5, 1e6, 0)},
                                      {"30 levels, H = 0.5, at column 2^40", DEPTH(30, .5, 1, INT64_C(1) << 40)},
                                      {"30 levels, H jumps between 0.1 and 0.9",
                                       {.levels = 30, .hurst = {.1, .9}, .by_place = true, .delta = 1, .seed = 5}},
                                      {0}};

/* ---- The run of one ---- */

typedef struct trial {
    const report_case *c;
    tl_run run;
    tl_source_info info;
    float *z;
    double relief, largest; /* of the valid heights: range, and the greatest of their absolute values */
    double deviation;       /* their standard deviation */
    tl_crs *crs;
    float *map_heights[2]; /* of the exponent and of delta */
    tl_source *maps[2], *dem, *field;
    case_result *out;
} trial;

static void fail(trial *t, const char *what)
{
    if (t->out->end == CASE_RIGHT) {
        t->out->end = CASE_FAILED;
        snprintf(t->out->text, sizeof t->out->text, "%s", what);
    }
}

/* An error is an answer where the case says so. */
static void take_error(trial *t, const tl_error *error)
{
    bool told = error->status == TL_ERROR_DATA || error->status == TL_ERROR_ARGUMENT;
    t->out->end = t->c->may_refuse && told ? CASE_REFUSED : CASE_FAILED;
    snprintf(t->out->text, sizeof t->out->text, "%s", error->text);
}

static double deviation_of(const float *z, size_t count)
{
    double sum = 0, squares = 0, known = 0;
    for (size_t k = 0; k < count; k++)
        if (!isnan(z[k]))
            sum += (double)z[k], known++;
    for (size_t k = 0; k < count; k++)
        if (!isnan(z[k]))
            squares += ((double)z[k] - sum / known) * ((double)z[k] - sum / known);
    return known > 0 ? sqrt(squares / known) : 0;
}

static bool make_model(trial *t, tl_error *error)
{
    const report_case *c = t->c;
    int width = c->width ? c->width : SIDE, height = c->height ? c->height : SIDE;
    double cell_x = c->cell_x > 0 ? c->cell_x : 10, cell_y = c->cell_y > 0 ? c->cell_y : 10, low = HUGE_VAL,
           high = -HUGE_VAL;
    t->z = malloc((size_t)width * (size_t)height * sizeof *t->z);
    if (!t->z) {
        error->status = TL_ERROR_MEMORY;
        snprintf(error->text, sizeof error->text, "not enough memory for a model");
        return false;
    }
    for (int j = 0; j < height; j++)
        for (int i = 0; i < width; i++) {
            float z = (float)c->z(i, j);
            t->z[j * width + i] = z;
            if (!isnan(z)) {
                low = fmin(low, (double)z), high = fmax(high, (double)z);
                t->largest = fmax(t->largest, fabs((double)z));
            }
        }
    t->relief = high > low ? high - low : 0;
    t->deviation = deviation_of(t->z, (size_t)width * (size_t)height);
    if (c->crs && !(t->crs = tl_crs_create(c->crs, error)))
        return false;
    t->info = (tl_source_info){.width = width,
                               .height = height,
                               .type = c->means ? TL_RASTER_AREA : TL_RASTER_POINT,
                               .has_voids = true,
                               .quantum = c->quantum,
                               .name = c->name};
    t->info.georef =
        (tl_georef){.crs = t->crs, .located = true, .transform = {c->x, cell_x, 0, c->y, 0, -cell_y}, .height_unit = 1};
    if (tl_georef_measure(&t->info.georef, width, height, error) != TL_OK)
        return false;
    t->dem = tl_array_source_create(t->z, &t->info, error);
    return t->dem != NULL;
}

/* The framework's bound, against every sample. */
static bool try_framework(trial *t, tl_error *error)
{
    const double shares[] = {0, .02};
    for (size_t k = 0; k < sizeof shares / sizeof *shares; k++) {
        tl_simplify_options options = {.max_error = shares[k] * t->relief, .frame = TL_FRAME_PROJECTED, .run = &t->run};
        tl_mesh *mesh = NULL;
        tl_mesh_report found;
        bool good = tl_simplify(t->dem, &options, &mesh, NULL, error) == TL_OK &&
                    tl_mesh_verify(mesh, t->dem, &t->run, &found, error) == TL_OK;
        tl_mesh_destroy(mesh);
        if (!good)
            return false;
        t->out->bound = options.max_error;
        t->out->found = found.max_error;
        if (!(found.max_error <= options.max_error))
            fail(t, "the framework's bound does not hold");
    }
    return true;
}

/* Samples of a map that goes from one value to the other and back. */
static tl_source *make_map(const trial *t, const double values[2], float **heights, tl_error *error)
{
    size_t count = (size_t)t->info.width * (size_t)t->info.height;
    *heights = malloc(count * sizeof **heights);
    for (size_t k = 0; *heights && k < count; k++)
        (*heights)[k] = (float)values[(k % (size_t)t->info.width + k / (size_t)t->info.width) & 1];
    return *heights ? tl_array_source_create(*heights, &t->info, error) : NULL;
}

static bool make_field(trial *t, tl_error *error)
{
    const report_case *c = t->c;
    const double *values[2] = {c->hurst_map, c->delta_map};
    for (int k = 0; k < 2; k++)
        if (values[k][1] > 0 && !(t->maps[k] = make_map(t, values[k], &t->map_heights[k], error)))
            return false;
    tl_field_options options = {.levels = c->levels ? c->levels : 2,
                                .scheme = c->scheme,
                                .seed = 5,
                                .hurst_given = c->hurst >= 0,
                                .hurst = c->hurst,
                                .delta_given = c->delta >= 0,
                                .delta = c->delta,
                                .hurst_map = t->maps[0],
                                .delta_map = t->maps[1],
                                .run = &t->run};
    t->field = tl_field_create(t->dem, &options, error);
    return t->field != NULL;
}

/* Whether the sample of the model that an index of the field lies in, or beside, is known, on all sides. */
static bool is_known(const trial *t, int64_t x, int64_t y)
{
    int levels = t->field->info.level;
    bool area = t->info.type == TL_RASTER_AREA;
    int64_t i = x >> levels, j = y >> levels, one = 1;
    for (int64_t b = 0; b <= 1; b++)
        for (int64_t a = 0; a <= 1; a++) {
            int64_t column = i + (!area && x != i * (one << levels) ? a : 0),
                    row = j + (!area && y != j * (one << levels) ? b : 0);
            if (isnan(t->z[row * t->info.width + column]))
                return false;
        }
    return true;
}

static void look_at(trial *t, tl_window w, const float *z)
{
    int levels = t->field->info.level;
    int64_t mask = (INT64_C(1) << levels) - 1;
    case_result *out = t->out;
    for (int64_t k = 0; k < w.width * w.height; k++) {
        int64_t x = w.x + k % w.width, y = w.y + k / w.width;
        if (isinf(z[k]))
            fail(t, "the field has an infinite height");
        if (isnan(z[k]) == is_known(t, x, y))
            fail(t, isnan(z[k]) ? "the field is void where the model is known" : "the field has heights in a void");
        if (t->info.type == TL_RASTER_POINT && !(x & mask) && !(y & mask) && !isnan(z[k]) &&
            z[k] != t->z[(y >> levels) * t->info.width + (x >> levels)])
            fail(t, "the field does not pass through the model's samples");
        if (!isnan(z[k])) {
            out->low = fmin(out->low, (double)z[k]);
            out->high = fmax(out->high, (double)z[k]);
            out->samples++;
        }
    }
}

/* Of area rasters: the mean over each cell that lies in the window as a whole. */
static void look_at_means(trial *t, tl_window w, const float *z)
{
    int levels = t->field->info.level;
    int64_t cell = levels < 20 ? INT64_C(1) << levels : INT64_MAX;
    /* a thousandth of the model's deviation is what is promised; heights are floats */
    double allowed = 1e-3 * t->deviation + t->largest * 0x1p-23;
    if (t->info.type != TL_RASTER_AREA || w.x || w.y || cell > w.width || cell > w.height)
        return;
    for (int64_t j = 0; (j + 1) * cell <= w.height; j++)
        for (int64_t i = 0; (i + 1) * cell <= w.width; i++) {
            double sum = 0;
            for (int64_t y = 0; y < cell; y++)
                for (int64_t x = 0; x < cell; x++)
                    sum += (double)z[(j * cell + y) * w.width + i * cell + x];
            double off = fabs(sum / (double)(cell * cell) - (double)t->z[j * t->info.width + i]);
            if (off > allowed) /* NaN of voids is not */
                fail(t, "the means over cells are not the model's");
        }
}

static bool try_field(trial *t, tl_error *error)
{
    tl_window w = {0, 0, WINDOW, WINDOW};
    case_result *out = t->out;
    out->low = HUGE_VAL, out->high = -HUGE_VAL;
    if (!make_field(t, error))
        return false;
    const tl_source_info *info = &t->field->info;
    w.width = info->width < WINDOW ? info->width : WINDOW;
    w.height = info->height < WINDOW ? info->height : WINDOW;
    float *z = malloc((size_t)w.width * (size_t)w.height * sizeof *z);
    if (!z) {
        error->status = TL_ERROR_MEMORY;
        snprintf(error->text, sizeof error->text, "not enough memory for a window");
        return false;
    }
    for (int k = 0; k < 3; k++) { /* at the corners and in the middle */
        w.x = k * (info->width - w.width) / 2;
        w.y = k * (info->height - w.height) / 2;
        if (tl_source_read(t->field, info->level, w, z, error) != TL_OK) {
            free(z);
            return false;
        }
        look_at(t, w, z);
        look_at_means(t, w, z);
    }
    if (!out->samples)
        out->low = out->high = (double)NAN;
    free(z);
    return true;
}

static bool try_view(trial *t, tl_error *error)
{
    const report_case *c = t->c;
    if (!(c->fov > 0))
        return true;
    tl_pyramid_options errors = {.frame = TL_FRAME_PROJECTED, .run = &t->run};
    tl_pyramid *pyramid = tl_pyramid_create(t->dem, &errors, error);
    tl_view view = {.projected = true, .above_ground = true, .pitch = -90, .fov = c->fov, .width = 640, .height = 480};
    const double *at = t->info.georef.transform;
    view.eye[0] = at[0] + at[1] * ((double)t->info.width - 1) / 2;
    view.eye[1] = at[3] + at[5] * ((double)t->info.height - 1) / 2;
    view.eye[2] = c->up;
    bool good = pyramid != NULL;
    for (int selector = 0; good && selector < 3; selector++) {
        tl_lod_options options = {
            .selector = (tl_selector)selector, .pixel_error = c->pixel_error, .budget = c->budget, .run = &t->run};
        tl_mesh *mesh = NULL;
        good = tl_select(t->field, t->dem, pyramid, &view, &options, &mesh, NULL, error) == TL_OK;
        if (good && c->budget && mesh->triangle_count > c->budget)
            fail(t, "the view takes more triangles than its budget");
        for (size_t k = 0; good && k < mesh->vertex_count; k++)
            if (!isfinite(mesh->vertices[k].z))
                fail(t, "the view has a vertex without a height");
        t->out->triangles = good ? mesh->triangle_count : 0;
        tl_mesh_destroy(mesh);
    }
    tl_pyramid_destroy(pyramid);
    return good;
}

void report_run_case(const report_case *c, const tl_run *run, case_result *out)
{
    tl_error error = {.status = TL_OK};
    trial t = {.c = c, .run = *run, .out = out};
    t.run.memory = CASE_MEMORY;
    *out = (case_result){.end = CASE_RIGHT};
    double start = progress_clock();
    if (!make_model(&t, &error) || !try_framework(&t, &error) || !try_field(&t, &error) || !try_view(&t, &error))
        take_error(&t, &error);
    out->seconds = progress_clock() - start;
    tl_source_destroy(t.field);
    for (int k = 0; k < 2; k++) {
        tl_source_destroy(t.maps[k]);
        free(t.map_heights[k]);
    }
    tl_source_destroy(t.dem);
    tl_crs_destroy(t.crs);
    free(t.z);
}
