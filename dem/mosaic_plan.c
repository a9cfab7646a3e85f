#include "dem/mosaic_plan.h"

#include "dem/crs.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

/* Samples that lie this near to those of a lattice, in cells, are on it. */
static const double on_lattice = 1e-3;
/* Rounding of positions, in cells. */
static const double rounding = 1e-6;
/* Lattice coordinates, and with them sizes, are below this: sums of a few of them are exact in double and in int64. */
static const double farthest = 0x1p50;

/* ---- Do the members go together? ---- */

static tl_status check_place(const tl_source_info *info, tl_error *error)
{
    const double *t = info->georef.transform;
    double lean_x = t[2] * (double)(info->height - 1), lean_y = t[4] * (double)(info->width - 1);
    if (!info->georef.located)
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: does not say where it lies, so it cannot be joined with others; leave it out", info->name);
    if (!(fabs(lean_x) <= on_lattice * fabs(t[1])) || !(fabs(lean_y) <= on_lattice * fabs(t[5])))
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: is rotated against the axes of its CRS, so it cannot be joined with others; warp it first, "
                       "for example with gdalwarp",
                       info->name);
    if (!isfinite(t[0]) || !isfinite(t[3]) || !(fabs(t[1]) > 0) || !(fabs(t[5]) > 0))
        return tl_fail(error, TL_ERROR_DATA, "%s: has cells of no size, so it cannot be joined with others",
                       info->name);
    return TL_OK;
}

static const char *crs_text(const tl_source_info *info)
{
    return info->georef.crs ? tl_crs_name(info->georef.crs) : "an unknown CRS";
}

static tl_status check_pair(const tl_source_info *first, const tl_source_info *other, tl_error *error)
{
    const tl_georef *a = &first->georef, *b = &other->georef;
    if (!a->crs != !b->crs || (a->crs && !dem_crs_equivalent(a->crs, b->crs)))
        return tl_fail(error, TL_ERROR_DATA,
                       "%s is in %s, but %s is in %s: one elevation model has one CRS; warp one of them first, for "
                       "example with gdalwarp",
                       other->name, crs_text(other), first->name, crs_text(first));
    if (a->height_unit != b->height_unit)
        return tl_fail(error, TL_ERROR_DATA, "%s has heights in units of %g m, but %s in units of %g m; convert one",
                       other->name, b->height_unit, first->name, a->height_unit);
    return TL_OK;
}

static tl_status check_members(tl_source *const *members, size_t count, tl_error *error)
{
    for (size_t k = 0; k < count; k++) {
        tl_status status = check_place(&members[k]->info, error);
        if (status == TL_OK && k)
            status = check_pair(&members[0]->info, &members[k]->info, error);
        if (status != TL_OK)
            return status;
    }
    return TL_OK;
}

/* ---- Order: finest first, then as they were given ---- */

typedef struct rank {
    size_t member;
    double cell; /* area of a cell */
} rank;

static int by_cell(const void *a, const void *b)
{
    const rank *first = a, *second = b;
    if (first->cell != second->cell)
        return first->cell < second->cell ? -1 : 1;
    return (first->member > second->member) - (first->member < second->member);
}

static int by_member(const void *a, const void *b)
{
    size_t first = ((const rank *)a)->member, second = ((const rank *)b)->member;
    return (first > second) - (first < second);
}

/* Cells that differ by rounding alone are equally fine: sorted by cell, those up to a millionth above the first of a
 * run belong to the run. */
static rank *rank_members(tl_source *const *members, size_t count)
{
    rank *ranks = tl_alloc(count, sizeof *ranks);
    if (!ranks)
        return NULL;
    for (size_t k = 0; k < count; k++) {
        const double *t = members[k]->info.georef.transform;
        ranks[k] = (rank){k, fabs(t[1]) * fabs(t[5])};
    }
    qsort(ranks, count, sizeof *ranks, by_cell);
    for (size_t first = 0, end; first < count; first = end) {
        for (end = first + 1; end < count && ranks[end].cell <= ranks[first].cell * (1 + 1e-6);)
            end++;
        qsort(ranks + first, end - first, sizeof *ranks, by_member);
    }
    return ranks;
}

/* ---- Longitudes: which turn of the globe ---- */

/* The part of the x axis that the mosaic has. Members are shifted by whole turns into it. */
typedef struct range {
    double low, high;
    bool turns;  /* false: nothing is shifted */
    bool closed; /* goes once around; low is the western edge of the finest member */
} range;

/* The footprint, half a cell beyond the samples: [0] low, [1] high. */
static void span_of(const tl_source *member, double span[2])
{
    const double *t = member->info.georef.transform;
    double a = t[0] - t[1] / 2, b = t[0] + t[1] * ((double)member->info.width - 0.5);
    span[0] = fmin(a, b);
    span[1] = fmax(a, b);
}

static int by_low(const void *a, const void *b)
{
    double first = *(const double *)a, second = *(const double *)b;
    return (first > second) - (first < second);
}

/* The largest part of the circle that no span covers; *behind is where it ends. */
static double largest_gap(double (*spans)[2], size_t count, double *behind)
{
    double best = 0, reach = -HUGE_VAL;
    for (size_t k = 0; k < count; k++) {
        double turn = 360 * floor(spans[k][0] / 360);
        spans[k][0] -= turn;
        spans[k][1] -= turn;
        reach = fmax(reach, spans[k][1] - 360); /* around the end of the circle */
    }
    qsort(spans, count, sizeof *spans, by_low);
    *behind = spans[0][0];
    for (size_t k = 0; k < count; k++) {
        if (spans[k][0] - reach > best) {
            best = spans[k][0] - reach;
            *behind = spans[k][0];
        }
        reach = fmax(reach, spans[k][1]);
    }
    return best;
}

/* As few degrees as hold all members. They stay as they are given where that is as narrow. */
static range choose_range(tl_source *const *members, size_t count, const tl_source *finest, double (*spans)[2])
{
    range all = {.low = HUGE_VAL, .high = -HUGE_VAL};
    for (size_t k = 0; k < count; k++) {
        span_of(members[k], spans[k]);
        all.low = fmin(all.low, spans[k][0]);
        all.high = fmax(all.high, spans[k][1]);
    }
    const tl_georef *georef = &finest->info.georef;
    double cell = fabs(georef->transform[1]), home[2], behind;
    if (!georef->crs || !tl_crs_is_geographic(georef->crs) || georef->transform[1] < 0 || !(all.high - all.low < 1e6))
        return all;
    double gap = largest_gap(spans, count, &behind);
    if (all.high - all.low <= 360 - gap + 1.5 * cell)
        return all;
    span_of(finest, home);
    range turned = {.low = home[0], .high = home[0] + 360, .turns = true, .closed = gap < cell / 2};
    if (!turned.closed) {
        /* the turn in which the finest member stays where it is */
        turned.low = behind + 360 * floor((home[0] - behind) / 360 + 1e-9);
        turned.high = turned.low + 360 - gap;
    }
    return turned;
}

/* ---- Layers ---- */

/* Whether `count` samples at a0 + da k lie on the lattice x0 + dx i; then `first` is the lowest i, and `mirror` tells
 * whether i falls with k. */
static bool fits_axis(double x0, double dx, double a0, double da, int64_t count, int64_t *first, bool *mirror)
{
    double begin = (a0 - x0) / dx, end = (a0 + da * (double)(count - 1) - x0) / dx;
    double low = nearbyint(begin), high = nearbyint(end);
    if (!(fabs(begin) < farthest && fabs(end) < farthest) || fabs(begin - low) > on_lattice ||
        fabs(end - high) > on_lattice || fabs(fabs(da / dx) - 1) > on_lattice ||
        fabs(high - low) != (double)(count - 1))
        return false;
    *mirror = high < low;
    *first = (int64_t)fmin(low, high);
    return true;
}

static bool fits(const dem_layer *layer, const tl_source *source, double shift, dem_placement *out)
{
    const tl_source_info *info = &source->info;
    const double *t = info->georef.transform;
    out->place.width = info->width;
    out->place.height = info->height;
    return fits_axis(layer->x0, layer->dx, t[0] + shift, t[1], info->width, &out->place.x, &out->mirror_x) &&
           fits_axis(layer->y0, layer->dy, t[3], t[5], info->height, &out->place.y, &out->mirror_y);
}

static dem_layer *new_layer(dem_plan *plan, const tl_source *first, double shift)
{
    if (plan->count == plan->room) {
        size_t room = plan->room ? 2 * plan->room : 4;
        dem_layer *layers = realloc(plan->layers, room * sizeof *layers);
        if (!layers)
            return NULL;
        plan->layers = layers;
        plan->room = room;
    }
    const double *t = first->info.georef.transform;
    dem_layer *layer = &plan->layers[plan->count++];
    *layer =
        (dem_layer){.x0 = t[0] + shift, .dx = t[1], .y0 = t[3], .dy = t[5], .area = first->info.type == TL_RASTER_AREA};
    return layer;
}

static bool add_placement(dem_layer *layer, const dem_placement *placement)
{
    if (layer->count == layer->room) {
        size_t room = layer->room ? 2 * layer->room : 4;
        dem_placement *placements = realloc(layer->placements, room * sizeof *placements);
        if (!placements)
            return false;
        layer->placements = placements;
        layer->room = room;
    }
    layer->placements[layer->count++] = *placement;
    return true;
}

/* Into the layer whose lattice the member is on, or a new one. Where it is not on the mosaic's own lattice, it must be
 * of the same type as the layer too, for the rims of areas and of points differ. */
static bool place_member(dem_plan *plan, const tl_source *source, size_t member, double shift)
{
    dem_placement placement = {.source = source, .member = member};
    bool area = source->info.type == TL_RASTER_AREA;
    for (size_t k = 0; k < plan->count; k++)
        if ((k == 0 || plan->layers[k].area == area) && fits(&plan->layers[k], source, shift, &placement))
            return add_placement(&plan->layers[k], &placement);
    dem_layer *layer = new_layer(plan, source, shift);
    placement.place = (tl_window){0, 0, source->info.width, source->info.height};
    placement.mirror_x = placement.mirror_y = false;
    return layer && add_placement(layer, &placement);
}

static tl_status place_all(dem_plan *plan, tl_source *const *members, const rank *ranks, size_t count,
                           const range *x_range, tl_error *error)
{
    double margin = 0.25 * fabs(members[ranks[0].member]->info.georef.transform[1]);
    for (size_t k = 0; k < count; k++) {
        const tl_source *source = members[ranks[k].member];
        double span[2], low = 0, high = 0;
        span_of(source, span);
        if (x_range->turns) {
            low = ceil((x_range->low + margin - span[1]) / 360);
            high = floor((x_range->high - margin - span[0]) / 360);
        }
        for (double turn = low; turn <= high; turn++)
            if (!place_member(plan, source, ranks[k].member, 360 * turn))
                return tl_fail_memory(error, source->info.name);
    }
    return TL_OK;
}

/* ---- Extent ---- */

static tl_window union_of(const dem_layer *layer)
{
    int64_t x0 = INT64_MAX, y0 = INT64_MAX, x1 = INT64_MIN, y1 = INT64_MIN;
    for (size_t k = 0; k < layer->count; k++) {
        tl_window place = layer->placements[k].place;
        x0 = tl_int64_min(x0, place.x);
        y0 = tl_int64_min(y0, place.y);
        x1 = tl_int64_max(x1, place.x + place.width);
        y1 = tl_int64_max(y1, place.y + place.height);
    }
    return (tl_window){x0, y0, x1 - x0, y1 - y0};
}

/* The mosaic's columns, or rows, that `count` of a layer from `first` on can give: those from the first sample of
 * points to the last; those within the cells of areas, where a cell has its lower edge but not its upper one. False
 * where they are too far away. */
static bool covered(double from0, double step, double own0, double own_step, int64_t first, int64_t count, bool area,
                    int64_t *begin, int64_t *size)
{
    double margin = area ? 0.5 : 0;
    double low = (from0 + step * ((double)first - margin) - own0) / own_step;
    double high = (from0 + step * ((double)(first + count - 1) + margin) - own0) / own_step;
    if (!(fabs(low) < farthest && fabs(high) < farthest))
        return false;
    bool rising = low <= high;
    double from = fmin(low, high), to = fmax(low, high);
    *begin = area && !rising ? (int64_t)floor(from + rounding) + 1 : (int64_t)ceil(from - rounding);
    *size = (area && rising ? (int64_t)ceil(to - rounding) : (int64_t)floor(to + rounding) + 1) - *begin;
    return true;
}

static bool cover_layer(const dem_layer *own, dem_layer *layer)
{
    tl_window b = layer->bounds;
    layer->cs = own->dx / layer->dx;
    layer->c0 = (own->x0 - layer->x0) / layer->dx;
    layer->rs = own->dy / layer->dy;
    layer->r0 = (own->y0 - layer->y0) / layer->dy;
    return covered(layer->x0, layer->dx, own->x0, own->dx, b.x, b.width, layer->area, &layer->cover.x,
                   &layer->cover.width) &&
           covered(layer->y0, layer->dy, own->y0, own->dy, b.y, b.height, layer->area, &layer->cover.y,
                   &layer->cover.height);
}

static tl_status fail_far(const dem_plan *plan, size_t layer, tl_error *error)
{
    return tl_fail(error, TL_ERROR_DATA, "%s lies too far from %s to be joined with it; leave one out",
                   plan->layers[layer].placements[0].source->info.name,
                   plan->layers[0].placements[0].source->info.name);
}

/* Union of all covers, in samples of the first layer's lattice. */
static tl_status find_extent(dem_plan *plan, const range *x_range, tl_window *extent, tl_error *error)
{
    dem_layer *own = &plan->layers[0];
    own->bounds = own->cover = union_of(own);
    tl_window all = own->bounds;
    for (size_t k = 1; k < plan->count; k++) {
        dem_layer *layer = &plan->layers[k];
        layer->bounds = union_of(layer);
        if (!cover_layer(own, layer))
            return fail_far(plan, k, error);
        if (dem_window_empty(layer->cover))
            continue;
        int64_t x1 = tl_int64_max(all.x + all.width, layer->cover.x + layer->cover.width);
        int64_t y1 = tl_int64_max(all.y + all.height, layer->cover.y + layer->cover.height);
        all.x = tl_int64_min(all.x, layer->cover.x);
        all.y = tl_int64_min(all.y, layer->cover.y);
        all.width = x1 - all.x;
        all.height = y1 - all.y;
    }
    if (x_range->closed) { /* the first sample of the finest member is column 0 of its lattice */
        all.x = 0;
        all.width = (int64_t)floor(360 / own->dx + on_lattice);
    }
    int64_t samples;
    if (!tl_int64_mul(all.width, all.height, &samples))
        return fail_far(plan, plan->count - 1, error);
    *extent = all;
    return TL_OK;
}

/* From the first layer's lattice to the mosaic's samples. */
static void move_origin(dem_plan *plan, tl_window extent)
{
    dem_layer *own = &plan->layers[0];
    own->x0 += own->dx * (double)extent.x;
    own->y0 += own->dy * (double)extent.y;
    own->cs = own->rs = 1;
    for (size_t k = 0; k < own->count; k++) {
        own->placements[k].place.x -= extent.x;
        own->placements[k].place.y -= extent.y;
    }
    own->bounds.x -= extent.x;
    own->bounds.y -= extent.y;
    for (size_t k = 0; k < plan->count; k++) {
        dem_layer *layer = &plan->layers[k];
        layer->c0 += k ? layer->cs * (double)extent.x : 0;
        layer->r0 += k ? layer->rs * (double)extent.y : 0;
        layer->cover.x -= extent.x;
        layer->cover.y -= extent.y;
        layer->cover = dem_window_common(layer->cover, (tl_window){0, 0, extent.width, extent.height});
    }
    plan->width = extent.width;
    plan->height = extent.height;
}

/* ---- Indices ---- */

static dem_bins *index_places(const dem_layer *layer)
{
    tl_window *places = tl_alloc(layer->count, sizeof *places);
    for (size_t k = 0; places && k < layer->count; k++)
        places[k] = layer->placements[k].place;
    dem_bins *bins = places ? dem_bins_create(places, layer->count) : NULL;
    free(places);
    return bins;
}

/* A layer that covers nothing is put where nobody looks. */
static dem_bins *index_covers(const dem_plan *plan)
{
    tl_window *covers = tl_alloc(plan->count, sizeof *covers);
    for (size_t k = 1; covers && k < plan->count; k++) {
        covers[k - 1] = plan->layers[k].cover;
        if (dem_window_empty(covers[k - 1]))
            covers[k - 1] = (tl_window){-1, -1, 1, 1};
    }
    dem_bins *bins = covers ? dem_bins_create(covers, plan->count - 1) : NULL;
    free(covers);
    return bins;
}

static tl_status make_indices(dem_plan *plan, tl_error *error)
{
    bool made = true;
    for (size_t k = 0; k < plan->count; k++) {
        plan->layers[k].bins = index_places(&plan->layers[k]);
        made = made && plan->layers[k].bins;
    }
    plan->covers = index_covers(plan);
    return made && plan->covers ? TL_OK : tl_fail_memory(error, "the index of a mosaic");
}

/* ---- All ---- */

static tl_status plan_ranked(dem_plan *plan, tl_source *const *members, const rank *ranks, size_t count,
                             const range *x_range, tl_error *error)
{
    tl_window extent = {0};
    tl_status status = place_all(plan, members, ranks, count, x_range, error);
    if (status == TL_OK)
        status = find_extent(plan, x_range, &extent, error);
    if (status != TL_OK)
        return status;
    move_origin(plan, extent);
    return make_indices(plan, error);
}

tl_status dem_plan_make(tl_source *const *members, size_t count, dem_plan *out, tl_error *error)
{
    *out = (dem_plan){0};
    tl_status status = check_members(members, count, error);
    if (status != TL_OK)
        return status;
    rank *ranks = rank_members(members, count);
    double(*spans)[2] = tl_alloc(count, sizeof *spans);
    if (!ranks || !spans) {
        status = tl_fail_memory(error, "the plan of a mosaic");
    } else {
        range x_range = choose_range(members, count, members[ranks[0].member], spans);
        status = plan_ranked(out, members, ranks, count, &x_range, error);
    }
    free(ranks);
    free(spans);
    if (status != TL_OK)
        dem_plan_finish(out);
    return status;
}

void dem_plan_finish(dem_plan *plan)
{
    for (size_t k = 0; k < plan->count; k++) {
        free(plan->layers[k].placements);
        dem_bins_destroy(plan->layers[k].bins);
    }
    free(plan->layers);
    dem_bins_destroy(plan->covers);
    *plan = (dem_plan){0};
}
