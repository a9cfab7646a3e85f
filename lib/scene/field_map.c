#include "lib/scene/field_map.h"

#include "dem/crs.h"
#include "lib/base/error.h"
#include "lib/base/number.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

/* ---- Laying -------------------------------------------------------------------------------------- */

static void lay_by_place(const double *from, const double *to, double out[6])
{
    double determinant = to[1] * to[5] - to[2] * to[4];
    const double inverse[4] = {to[5] / determinant, -to[2] / determinant, -to[4] / determinant, to[1] / determinant};
    for (int k = 0; k < 3; k++) {
        double x = from[k] - (k ? 0 : to[0]), y = from[3 + k] - (k ? 0 : to[3]);
        out[k] = inverse[0] * x + inverse[1] * y;
        out[3 + k] = inverse[2] * x + inverse[3] * y;
    }
}

static void lay_edge_to_edge(const tl_source_info *model, const tl_source_info *map, double out[6])
{
    double x = (double)map->width / (double)model->width, y = (double)map->height / (double)model->height;
    const double to[6] = {x / 2 - .5, x, 0, y / 2 - .5, 0, y};
    memcpy(out, to, sizeof to);
}

static tl_status lay(const tl_source_info *model, const tl_source_info *map, double out[6], tl_error *error)
{
    const tl_georef *a = &model->georef, *b = &map->georef;
    if (!a->located || !b->located) {
        lay_edge_to_edge(model, map, out);
        return TL_OK;
    }
    if (a->crs && b->crs && !dem_crs_equivalent(a->crs, b->crs))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: is in another CRS (%s) than %s (%s): reproject it to that",
                       map->name, tl_crs_name(b->crs), model->name, tl_crs_name(a->crs));
    if (!tl_transform_is_usable(b->transform))
        return tl_fail(error, TL_ERROR_DATA, "%s: its place cannot be used: write it anew, georeferenced", map->name);
    lay_by_place(a->transform, b->transform, out);
    return TL_OK;
}

/* Where the model's corners lie in the map. */
static void corners_in(const tl_source_info *model, const double to[6], double low[2], double high[2])
{
    for (int axis = 0; axis < 2; axis++) {
        low[axis] = HUGE_VAL, high[axis] = -HUGE_VAL;
        for (int corner = 0; corner < 4; corner++) {
            double i = corner & 1 ? (double)(model->width - 1) : 0, j = corner & 2 ? (double)(model->height - 1) : 0;
            double at = to[3 * axis] + to[3 * axis + 1] * i + to[3 * axis + 2] * j;
            low[axis] = fmin(low[axis], at), high[axis] = fmax(high[axis], at);
        }
    }
}

/* Refuses maps of another place, and those that are so much finer that what a block sees of them does not fit. */
static tl_status check_place(const tl_source_info *model, const tl_source_info *map, const double to[6],
                             const tl_run *run, tl_error *error)
{
    enum { BLOCK = 560 }; /* samples of the model that a block of the finest level sees at most, on a side */
    double low[2], high[2], bytes = sizeof(float) * (double)tl_parallel_workers(run, UINT64_MAX);
    const int64_t sizes[2] = {map->width, map->height}, whole[2] = {model->width, model->height};
    corners_in(model, to, low, high);
    for (int axis = 0; axis < 2; axis++) {
        bool around = map->wraps && axis == 0;
        if (!around && (high[axis] < -0.5 || low[axis] > (double)sizes[axis] - 0.5))
            return tl_fail(error, TL_ERROR_ARGUMENT,
                           "%s: lies beside %s and tells nothing of it; give a map of its place", map->name,
                           model->name);
        double share = whole[axis] > BLOCK ? BLOCK / (double)whole[axis] : 1;
        bytes *= fmin((double)sizes[axis], (high[axis] - low[axis]) * share + 2);
    }
    return tl_run_fits(run, bytes, map->name, "reading it, much finer than the model, as a map", error);
}

/* Places, no farther apart than the map's samples, in a step of the model that is so many of them. */
static int places_about(double columns, double rows)
{
    double samples = fmax(fabs(columns), fabs(rows)) - 1e-6;
    return samples > 1 ? (int)ceil(fmin(samples, 1 << 20)) : 1;
}

tl_status scene_field_map_open(const tl_source *map, const tl_source_info *model, const scene_field_map_rule *rule,
                               double fallback, const tl_run *run, scene_field_map *out, tl_error *error)
{
    *out = (scene_field_map){.source = map,
                             .across = 1,
                             .down = 1,
                             .fallback = fallback,
                             .least = fallback,
                             .turn = model->wraps ? model->width : 0,
                             .low = rule->nearest_low,
                             .high = rule->nearest_high};
    if (!map)
        return TL_OK;
    tl_status status = lay(model, &map->info, out->to, error);
    if (status == TL_OK)
        status = check_place(model, &map->info, out->to, run, error);
    out->across = places_about(out->to[1], out->to[4]);
    out->down = places_about(out->to[2], out->to[5]);
    tl_range range;
    tl_run quiet = run ? *run : (tl_run){0};
    quiet.progress = NULL;
    if (status == TL_OK)
        status = tl_source_range(map, &quiet, &range, error);
    if (status == TL_OK && range.voids < range.samples &&
        !(range.low >= (float)rule->low && range.high <= (float)rule->high))
        return tl_fail(error, TL_ERROR_DATA, "%s: holds %g ... %g, but %s must be from %g to %g; is it the right band?",
                       map->info.name, (double)range.low, (double)range.high, rule->what, rule->low, rule->high);
    if (status == TL_OK)
        out->least = fmax(fmin(fallback, (double)range.low), rule->nearest_low);
    return status;
}

/* ---- Reading ------------------------------------------------------------------------------------- */

/* What is read of the map for a window. */
typedef struct sheet {
    tl_window window;
    float *numbers;
} sheet;

static double position(const double *to, double i, double j)
{
    return to[0] + to[1] * i + to[2] * j;
}

static double column_of(const scene_field_map *map, int64_t i)
{
    int64_t rest = map->turn ? i % map->turn : i;
    return (double)(rest < 0 ? rest + map->turn : rest);
}

/* The samples of one axis of the map that columns (or rows) at positions low ... high see. */
static void span(double low, double high, int64_t samples, bool all, int64_t *first, int64_t *count)
{
    double last = (double)(samples - 1);
    *first = all ? 0 : (int64_t)floor(fmin(fmax(low, 0), last));
    *count = all ? samples : (int64_t)floor(fmin(fmax(high, 0), last)) - *first + 1;
    *count += *first + *count < samples;
}

static tl_status sheet_read(const scene_field_map *map, fbm_window window, sheet *out, tl_error *error)
{
    const tl_source_info *info = &map->source->info;
    double low[2] = {HUGE_VAL, HUGE_VAL}, high[2] = {-HUGE_VAL, -HUGE_VAL};
    const int64_t right = window.i + (int64_t)window.width - 1, below = window.j + (int64_t)window.height - 1;
    const double beside = map->across > 1 ? .5 : 0, beyond = map->down > 1 ? .5 : 0; /* of cells */
    bool turned = map->turn && (window.i < 0 || right >= map->turn);
    for (int corner = 0; corner < 4; corner++) {
        double i = turned ? (corner & 1 ? (double)map->turn : 0) : (double)(corner & 1 ? right : window.i);
        double j = corner & 2 ? (double)below + beyond : (double)window.j - beyond;
        i += corner & 1 ? beside : -beside;
        for (int axis = 0; axis < 2; axis++) {
            double at = position(map->to + 3 * axis, i, j);
            low[axis] = fmin(low[axis], at);
            high[axis] = fmax(high[axis], at);
        }
    }
    span(low[0], high[0], info->width, info->wraps, &out->window.x, &out->window.width);
    span(low[1], high[1], info->height, false, &out->window.y, &out->window.height);
    out->numbers = tl_alloc_grid(out->window.width, out->window.height, sizeof *out->numbers);
    if (!out->numbers)
        return tl_fail_memory(error, info->name);
    tl_status status = tl_source_read(map->source, info->level, out->window, out->numbers, error);
    for (int64_t k = 0; status == TL_OK && k < out->window.width * out->window.height; k++)
        out->numbers[k] = isnan(out->numbers[k]) ? (float)map->fallback
                                                 : fminf(fmaxf(out->numbers[k], (float)map->low), (float)map->high);
    return status;
}

/* The samples before and after a position, and how far it is from the first to the second. */
static double neighbours(double at, int64_t samples, bool wraps, int64_t out[2])
{
    if (wraps)
        at -= floor(at / (double)samples) * (double)samples;
    double limited = fmin(fmax(at, 0), wraps ? (double)samples : (double)(samples - 1)), whole = floor(limited);
    out[0] = (int64_t)whole;
    out[1] = out[0] + (limited > whole);
    for (int k = 0; k < 2 && wraps; k++)
        out[k] %= samples;
    return limited - whole;
}

static float number_at(const scene_field_map *map, const sheet *s, double u, double v)
{
    const tl_source_info *info = &map->source->info;
    int64_t x[2], y[2];
    double across = neighbours(u, info->width, info->wraps, x), down = neighbours(v, info->height, false, y), rows[2];
    for (int k = 0; k < 2; k++) {
        const float *row = s->numbers + (y[k] - s->window.y) * s->window.width - s->window.x;
        rows[k] = (double)row[x[0]] + across * ((double)row[x[1]] - (double)row[x[0]]);
    }
    return (float)(rows[0] + down * (rows[1] - rows[0]));
}

static float mean_at(const scene_field_map *map, const sheet *s, double i, double j)
{
    double sum = 0;
    for (int y = 0; y < map->down; y++)
        for (int x = 0; x < map->across; x++) {
            double u = i + (2 * x + 1 - map->across) / (2.0 * map->across),
                   v = j + (2 * y + 1 - map->down) / (2.0 * map->down);
            sum += (double)number_at(map, s, position(map->to, u, v), position(map->to + 3, u, v));
        }
    return (float)(sum / ((double)map->across * map->down));
}

tl_status scene_field_map_read(const scene_field_map *map, fbm_window window, float *out, tl_error *error)
{
    if (!map->source) {
        for (size_t k = 0; k < window.width * window.height; k++)
            out[k] = (float)map->fallback;
        return TL_OK;
    }
    sheet s = {.numbers = NULL};
    tl_status status = sheet_read(map, window, &s, error);
    for (size_t y = 0; status == TL_OK && y < window.height; y++)
        for (size_t x = 0; x < window.width; x++) {
            double i = column_of(map, window.i + (int64_t)x), j = (double)(window.j + (int64_t)y);
            *out++ = mean_at(map, &s, i, j);
        }
    free(s.numbers);
    return status;
}
