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
    if (!(l->low <= l->high))
        l->low = l->high = 0;
    l->filling = .5F * l->low + .5F * l->high;
    return l->low <= l->high;
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
    l->rules = (TL_CULL_FRUSTUM | TL_CULL_BACK | TL_CULL_HORIZON | TL_CULL_RIDGE) & ~options->keep;
    bool alone = !(options->budget || options->band_count);
    l->pixel_error = options->pixel_error > 0 ? options->pixel_error : alone ? 1 : 0;
    find_range(l);
    l->tiles = scene_tiles_create(field, dem, l->levels, options->run, error);
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

static tl_status mark_corners(lod *l, tl_error *error)
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

tl_status lod_look(lod *l, const scene_view *view, tl_error *error)
{
    l->view = view;
    l->camera = scene_view_camera(view);
    l->stats = (tl_lod_stats){0};
    scene_tiles_count_again(l->tiles);
    lod_prepare_tests(l);
    lod_ridges_destroy(l->ridges);
    l->ridges = NULL;
    tl_status status = l->vertices.count ? lod_place(l, 0, error) : mark_corners(l, error);
    if (status == TL_OK && l->rules & TL_CULL_RIDGE)
        status = lod_ridges_create(l, &l->ridges, error);
    return status;
}

/* ---- Selecting ---- */

static tl_status run_selector(lod *l, uint64_t limit, lod_list *leaves, tl_error *error)
{
    lod_selector *selectors[] = {[TL_SELECTOR_QUADTREE] = lod_quadtree, [TL_SELECTOR_CHUNK] = lod_chunk};
    leaves->count = 0;
    l->overflow = false;
    return selectors[l->options->selector](l, limit, leaves, error);
}

/* One try at a pixel error: whether it stays within the budget. */
static tl_status try_error(lod *l, double pixel_error, lod_list *leaves, bool *fits, tl_error *error)
{
    uint64_t triangles = 0;
    lod_clear(l);
    tl_lod_stats before = l->stats;
    before.pixel_error = 0;
    l->stats = before;
    l->pixel_error = pixel_error;
    tl_status status = mark_corners(l, error);
    if (status == TL_OK)
        status = run_selector(l, l->options->budget, leaves, error);
    if (status == TL_OK && !l->overflow)
        status = lod_count(l, leaves->items, leaves->count, &triangles, error);
    *fits = !l->overflow && triangles <= l->options->budget;
    return status;
}

static tl_status budget_too_small(const lod *l, tl_error *error)
{
    return tl_fail(error, TL_ERROR_ARGUMENT,
                   "%s: a budget of %llu triangles is less than the view's coarsest surface, with its rim and voids, "
                   "takes; allow more",
                   l->dem->info.name, (unsigned long long)l->options->budget);
}

/* The smallest pixel error, to a hundredth, that stays within the budget. */
static tl_status select_by_budget(lod *l, lod_list *leaves, tl_error *error)
{
    const double least = fmax(l->pixel_error, 1e-9), largest = 1e12, step = 8, close = 1.01;
    double good = fmax(least, 16), bad = 0;
    bool fits;
    tl_status status = try_error(l, good, leaves, &fits, error);
    while (status == TL_OK && !fits && good < largest) {
        bad = good;
        good = good * step;
        status = try_error(l, good, leaves, &fits, error);
    }
    if (status == TL_OK && !fits)
        return budget_too_small(l, error);
    while (status == TL_OK && !(bad > 0) && good > least) {
        double next = fmax(good / step, least);
        status = try_error(l, next, leaves, &fits, error);
        *(fits ? &good : &bad) = next;
    }
    double last = fits ? good : 0;
    while (status == TL_OK && bad > 0 && good > close * bad) {
        last = sqrt(good * bad);
        status = try_error(l, last, leaves, &fits, error);
        *(fits ? &good : &bad) = last;
    }
    return status == TL_OK && last != good ? try_error(l, good, leaves, &fits, error) : status;
}

static tl_status describe(const lod *l, const tl_view *view, tl_mesh *mesh, tl_error *error)
{
    static const char *const names[] = {"quadtree", "chunk", "roam"};
    char error_text[TL_NUMBER_TEXT], eye[3 * TL_NUMBER_TEXT], number[3][TL_NUMBER_TEXT];
    for (int k = 0; k < 3; k++)
        tl_number_text(view->eye[k], number[k]);
    snprintf(eye, sizeof eye, "%s,%s,%s", number[0], number[1], number[2]);
    tl_number_text(l->pixel_error, error_text);
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

static void fill_stats(lod *l, const tl_mesh *mesh, tl_lod_stats *out)
{
    scene_tile_counts counts = scene_tiles_counts(l->tiles);
    *out = l->stats;
    out->triangles = mesh->triangle_count;
    out->vertices = mesh->vertex_count;
    out->tiles_made = counts.tiles_made;
    out->tiles_used = counts.tiles_used;
    out->samples_made = counts.samples_made;
    out->dem_blocks = counts.dem_blocks;
    out->dem_samples = counts.dem_samples;
    out->finest_level = finest_of(l);
}

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static tl_status select_triangles(lod *l, const tl_view *view, tl_mesh **out, tl_error *error)
{
    lod_list leaves = {0};
    tl_mesh *mesh = NULL;
    tl_status status = l->options->budget ? select_by_budget(l, &leaves, error) : run_selector(l, 0, &leaves, error);
    if (status == TL_OK)
        status = lod_draw(l, leaves.items, leaves.count, &mesh, error);
    if (status == TL_OK)
        status = describe(l, view, mesh, error);
    free(leaves.items);
    if (status == TL_OK)
        *out = mesh;
    else
        tl_mesh_destroy(mesh);
    return status;
}

tl_status tl_select(const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid, const tl_view *view,
                    const tl_lod_options *options, tl_mesh **out, tl_lod_stats *stats, tl_error *error)
{
    static const tl_lod_options defaults;
    double start = now();
    lod l;
    tl_mesh *mesh = NULL;
    tl_status status = lod_init(&l, field, dem, pyramid, options ? options : &defaults, error);
    scene_view *from = status == TL_OK ? scene_view_create(view, dem, error) : NULL;
    if (status == TL_OK && !from)
        status = TL_ERROR_ARGUMENT;
    if (status == TL_OK) {
        scene_view_know_ground(from, (double)l.low, false); /* lod_ridges.c knows where the voids are */
        status = lod_look(&l, from, error);
    }
    if (status == TL_OK)
        status = select_triangles(&l, view, &mesh, error);
    if (status == TL_OK && stats) {
        fill_stats(&l, mesh, stats);
        stats->seconds = now() - start;
    }
    if (status == TL_OK)
        *out = mesh;
    scene_view_destroy(from);
    lod_finish(&l);
    return status;
}
