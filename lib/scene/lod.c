/* What a view needs of a field. */
#include "lib/scene/lod.h"

#include "dem/framework_pyramid.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/size.h"
#include "lib/scene/field.h"

#include <math.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

/* ---- The world ---- */

static tl_status check_field(const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid, tl_error *error)
{
    const char *name = dem->info.name;
    const tl_source_info *shape = &pyramid->shape->info;
    if (scene_field_dem(field) != dem)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the view's field is not made over this model; make one",
                       field->info.name);
    if (!scene_field_nests(field))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: the levels of this field have no samples in common; make it with the support of points and "
                       "another scheme than 'successive'",
                       name);
    if (shape->width != dem->info.width || shape->height != dem->info.height)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the error pyramid is that of another model", name);
    return TL_OK;
}

static tl_status check_size(const lod *l, tl_error *error)
{
    const tl_source_info *info = &l->dem->info;
    int64_t larger = tl_int64_max(info->width, info->height) - 1;
    if (l->lattice_log <= LOD_LATTICE_MAX && larger <= INT32_MAX >> l->field->info.level)
        return TL_OK;
    return tl_fail(error, TL_ERROR_ARGUMENT,
                   "%s: %lld x %lld samples refined by %d levels are more than a mesh can number; take fewer levels",
                   info->name, (long long)info->width, (long long)info->height, l->field->info.level);
}

static tl_status check_options(const tl_lod_options *o, const char *name, tl_error *error)
{
    if (!(o->pixel_error >= 0) || isinf(o->pixel_error))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: a pixel error of %g was asked for; it must be above 0", name,
                       o->pixel_error);
    if (o->band_count > TL_LOD_BANDS)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %zu distance bands are more than %d", name, o->band_count,
                       TL_LOD_BANDS);
    for (size_t k = 0; k < o->band_count; k++)
        if (!(o->bands[k] > (k ? o->bands[k - 1] : 0)) || isinf(o->bands[k]))
            return tl_fail(error, TL_ERROR_ARGUMENT, "%s: distance bands must be above 0 and rise, unlike %g", name,
                           o->bands[k]);
    if (o->band_count && o->morph)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: vertices move by pixel errors, not by distance bands; give one",
                       name);
    if (o->band_count && (o->budget || o->pixel_error > 0))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: distance bands take the place of a pixel error and a budget; give one of them", name);
    return TL_OK;
}

/* The range of the model's heights; false where all is void. */
static bool find_range(lod *l)
{
    const tl_framework *shape = l->pyramid->shape;
    l->low = HUGE_VALF, l->high = -HUGE_VALF;
    for (int64_t k = 0; k < shape->columns * shape->rows; k++) {
        const float *range = l->pyramid->ranges + 2 * k;
        l->low = range[0] < l->low ? range[0] : l->low;
        l->high = range[1] > l->high ? range[1] : l->high;
    }
    bool any = l->low <= l->high;
    if (!any)
        l->low = l->high = 0;
    l->filling = .5F * l->low + .5F * l->high;
    return any;
}

tl_status lod_init(lod *l, const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid,
                   const tl_lod_options *options, tl_error *error)
{
    *l = (lod){.field = field, .dem = dem, .pyramid = pyramid, .options = options, .run = options->run};
    tl_status status = check_field(field, dem, pyramid, error);
    if (status == TL_OK)
        status = check_options(options, dem->info.name, error);
    if (status != TL_OK)
        return status;
    const tl_georef *g = &dem->info.georef;
    l->finest =
        options->max_level_given && options->max_level < field->info.level ? options->max_level : field->info.level;
    l->levels = l->finest > 0 ? l->finest : 0;
    l->lattice_log = pyramid->shape->lattice_log + l->levels;
    l->voids = pyramid->shape->voids;
    status = check_size(l, error);
    if (status != TL_OK)
        return status;
    l->cell = INT32_C(1) << l->levels;
    l->right = (int32_t)((dem->info.width - 1) * l->cell);
    l->bottom = (int32_t)((dem->info.height - 1) * l->cell);
    l->unit = g->height_unit;
    l->metres_x = g->cell_x, l->metres_y = g->cell_y;
    l->degrees = g->crs && tl_crs_is_geographic(g->crs) ? fabs(g->transform[1]) + fabs(g->transform[2]) : 0;
    l->rules = TL_CULL_FRUSTUM | TL_CULL_BACK | TL_CULL_HORIZON | TL_CULL_RIDGE;
    bool alone = !(options->budget || options->band_count);
    l->pixel_error = options->pixel_error > 0 ? options->pixel_error : alone ? 1 : 0;
    if (options->morph)
        l->pixel_error *= LOD_MORPH;
    l->empty = !find_range(l);
    l->tiles = scene_tiles_create(field, dem, pyramid, l->levels, options->run, error);
    return l->tiles ? TL_OK : TL_ERROR_MEMORY;
}

void lod_finish(lod *l)
{
    scene_tiles_destroy(l->tiles);
    lod_ridges_destroy(l->ridges);
    free(l->vertices.items);
    free(l->asked.items);
    for (int depth = 0; depth < LOD_DEPTHS; depth++)
        free(l->by_depth[depth].items);
}

tl_status lod_mark_corners(lod *l, tl_error *error)
{
    int32_t end = INT32_C(1) << l->lattice_log;
    tl_status status = TL_OK;
    l->asked.count = 0;
    for (int k = 0; k < 4 && status == TL_OK; k++)
        status = lod_ask(l, k & 1 ? end : 0, k & 2 ? end : 0, error);
    if (status == TL_OK)
        status = lod_mark_asked(l, error);
    for (size_t k = 0; k < 4 && status == TL_OK; k++)
        l->corners[k] = lod_asked(l, k)->vertex;
    return status;
}

void lod_turn(lod *l, const scene_view *view)
{
    l->view = view;
    l->camera = scene_view_camera(view);
    l->stats = (tl_lod_stats){.above_ground = scene_view_above_ground(view)};
    scene_tiles_count_again(l->tiles);
    lod_prepare_tests(l);
    lod_ridges_destroy(l->ridges);
    l->ridges = NULL;
}

tl_status lod_look(lod *l, const scene_view *view, tl_error *error)
{
    lod_turn(l, view);
    tl_status status = l->vertices.count ? lod_place(l, 0, error) : lod_mark_corners(l, error);
    if (status == TL_OK)
        status = lod_ridges_create(l, &l->ridges, error);
    return status;
}

/* ---- Selecting ---- */

static tl_status run_selector(lod *l, uint64_t limit, lod_list *leaves, tl_error *error)
{
    lod_selector *selectors[] = {[TL_SELECTOR_QUADTREE] = lod_quadtree, [TL_SELECTOR_CHUNK] = lod_chunk};
    leaves->count = 0;
    l->overflow = false;
    l->certain = 0;
    return selectors[l->options->selector](l, limit, leaves, error);
}

typedef struct trial {
    lod *l;
    lod_list *leaves;
} trial;

/* One try at a pixel error, from nothing. */
static tl_status try_error(void *context, double pixel_error, bool *fits, tl_error *error)
{
    trial *self = context;
    lod *l = self->l;
    uint64_t triangles = 0;
    lod_clear(l);
    l->stats.pixel_error = 0;
    lod_allow(l, pixel_error);
    tl_status status = lod_mark_corners(l, error);
    if (status == TL_OK)
        status = run_selector(l, l->options->budget, self->leaves, error);
    if (status == TL_OK && !l->overflow)
        status = lod_count(l, self->leaves->items, self->leaves->count, &triangles, error);
    *fits = !l->overflow && triangles <= l->options->budget;
    return status;
}

enum { STEPS = 64, LEAST = -30 * STEPS, LARGEST = 40 * STEPS };

static double error_at(int k, double least)
{
    return fmax(exp2((double)k / STEPS), least);
}

/* The next smaller error to try: at least `step` down, and as far down as nothing changes; first - 1: none does. */
static int go_down(const lod *l, int k, int step, int first)
{
    if (l->next <= error_at(first - 1, 0))
        return first - 1;
    int changes = (int)floor(STEPS * log2(l->next));
    k = changes < k - step ? changes : k - step;
    return k > first ? k : first;
}

/* Goes from `at` upwards until it fits, or downwards until it does not, by larger and larger steps. */
static tl_status bracket(const lod *l, double least, int first, int step, int *good, int *bad, int *last, lod_try *try,
                         void *context, tl_error *error)
{
    bool fits;
    int k = *last;
    tl_status status = try(context, error_at(k, least), &fits, error);
    bool up = !fits;
    *good = LARGEST + 1, *bad = first - 1;
    while (status == TL_OK) {
        *(fits ? good : bad) = k;
        *last = k;
        if (fits == up || (fits && k == first) || (!fits && k == LARGEST))
            break;
        k = up ? (k + step < LARGEST ? k + step : LARGEST) : go_down(l, k, step, first);
        if (k < first) {
            *bad = *good - 1; /* nothing to gain */
            break;
        }
        step = 2 * step < STEPS ? 2 * step : STEPS;
        status = try(context, error_at(k, least), &fits, error);
    }
    return status;
}

tl_status lod_search_budget(const lod *l, double least, int step, int *at, lod_try *try, void *context, tl_error *error)
{
    int first = least > 0 ? (int)floor(STEPS * log2(fmin(fmax(least, exp2(-30)), exp2(39)))) : LEAST, good, bad;
    int last = *at < first ? first : *at;
    tl_status status = bracket(l, least, first, step, &good, &bad, &last, try, context, error);
    while (status == TL_OK && good <= LARGEST && good - bad > 1) {
        bool fits;
        last = bad + (good - bad) / 2;
        status = try(context, error_at(last, least), &fits, error);
        *(fits ? &good : &bad) = last;
    }
    if (status == TL_OK && good > LARGEST)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: a budget of %llu triangles is less than the view's coarsest surface, with its rim and "
                       "voids, takes; allow more",
                       l->dem->info.name, (unsigned long long)l->options->budget);
    bool fits;
    *at = good;
    return status == TL_OK && last != good ? try(context, error_at(good, least), &fits, error) : status;
}

static tl_status select_by_budget(lod *l, lod_list *leaves, tl_error *error)
{
    trial self = {l, leaves};
    int at = LOD_BUDGET_START;
    return lod_search_budget(l, l->pixel_error, LOD_BUDGET_STEP, &at, try_error, &self, error);
}

tl_status lod_describe(const lod *l, const tl_view *view, tl_mesh *mesh, tl_error *error)
{
    static const char *const names[] = {"quadtree", "chunk", "roam"};
    char error_text[TL_NUMBER_TEXT], eye[3 * TL_NUMBER_TEXT], number[3][TL_NUMBER_TEXT];
    for (int k = 0; k < 3; k++)
        tl_number_text(view->eye[k], number[k]);
    snprintf(eye, sizeof eye, "%s,%s,%s", number[0], number[1], number[2]);
    tl_number_text(l->options->morph ? l->pixel_error / LOD_MORPH : l->pixel_error, error_text);
    tl_status status = tl_mesh_add_parameter(mesh, "lod", names[l->options->selector], error);
    if (status == TL_OK)
        status = tl_mesh_add_parameter(mesh, "eye", eye, error);
    if (status == TL_OK && !l->options->band_count)
        status = tl_mesh_add_parameter(mesh, "pixel_error", error_text, error);
    return status;
}

static int finest_of(const lod *l)
{
    for (int depth = LOD_DEPTHS - 1; depth >= 0; depth--)
        if (l->by_depth[depth].count)
            return l->levels - (l->lattice_log - 1 - depth / 2);
    return l->levels - l->lattice_log;
}

void lod_fill_stats(const lod *l, tl_lod_stats *out)
{
    scene_tile_counts counts = scene_tiles_counts(l->tiles);
    *out = l->stats;
    out->tiles_made = counts.tiles_made;
    out->tiles_used = counts.tiles_used;
    out->samples_made = counts.samples_made;
    out->dem_blocks = counts.dem_blocks;
    out->dem_samples = counts.dem_samples;
    out->finest_level = finest_of(l);
}

double lod_now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static tl_status select_triangles(lod *l, const tl_view *view, tl_mesh **out, tl_error *error)
{
    lod_list leaves = {0};
    tl_mesh *mesh = NULL;
    float *heights = NULL;
    double moved = 0;
    tl_status status = l->options->budget ? select_by_budget(l, &leaves, error) : run_selector(l, 0, &leaves, error);
    if (status == TL_OK && l->options->morph)
        status = lod_morph(l, &heights, &moved, error);
    l->stats.pixel_error += moved;
    if (status == TL_OK)
        status = lod_draw(l, leaves.items, leaves.count, heights, &mesh, error);
    free(heights);
    if (status == TL_OK)
        status = lod_describe(l, view, mesh, error);
    free(leaves.items);
    if (status == TL_OK)
        *out = mesh;
    else
        tl_mesh_destroy(mesh);
    return status;
}

/* A mesh of nothing, over a raster without cells. */
static tl_status select_nothing(const lod *l, tl_mesh **out, tl_error *error)
{
    *out = tl_mesh_create(0, 0, &l->field->info, error);
    return *out ? TL_OK : TL_ERROR_MEMORY;
}

static tl_status select_from(lod *l, const tl_view *view, tl_mesh **out, tl_error *error)
{
    scene_view *from = scene_view_create(view, l->dem, error);
    if (!from)
        return TL_ERROR_ARGUMENT;
    scene_view_know_ground(from, (double)l->low, false); /* lod_ridges.c knows where the voids are */
    tl_status status = TL_OK;
    l->stats.above_ground = (double)NAN;
    if (l->empty)
        status = select_nothing(l, out, error);
    else {
        status = lod_look(l, from, error);
        if (status == TL_OK)
            status = select_triangles(l, view, out, error);
    }
    scene_view_destroy(from);
    return status;
}

tl_status tl_select(const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid, const tl_view *view,
                    const tl_lod_options *options, tl_mesh **out, tl_lod_stats *stats, tl_error *error)
{
    static const tl_lod_options defaults;
    options = options ? options : &defaults;
    if (options->selector == TL_SELECTOR_ROAM)
        return lod_roam_once(field, dem, pyramid, view, options, out, stats, error);
    double start = lod_now();
    lod l;
    tl_mesh *mesh = NULL;
    tl_status status = lod_init(&l, field, dem, pyramid, options, error);
    if (status == TL_OK)
        status = select_from(&l, view, &mesh, error);
    if (status == TL_OK && stats) {
        lod_fill_stats(&l, stats);
        stats->triangles = mesh->triangle_count;
        stats->vertices = mesh->vertex_count;
        stats->seconds = lod_now() - start;
    }
    if (status == TL_OK)
        *out = mesh;
    lod_finish(&l);
    return status;
}
