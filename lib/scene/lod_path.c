/* Views along a path: a cubic through keyframes. */
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/talus.h"

#include <math.h>
#include <string.h>

enum { EYE = 0, TARGET = 3, HEADING = 6, PITCH, ROLL, FOV, REFRACTION, CHANNELS, PARTS = 64 };

/* Keys as numbers, at their knots: times, or metres along the chords. */
typedef struct path {
    size_t count;
    double *knots, (*values)[CHANNELS], (*slopes)[CHANNELS];
} path;

/* ---- Keys ---- */

static void take(const tl_view *v, double out[CHANNELS])
{
    memcpy(out + EYE, v->eye, sizeof v->eye);
    memcpy(out + TARGET, v->target, sizeof v->target);
    out[HEADING] = v->heading, out[PITCH] = v->pitch, out[ROLL] = v->roll;
    out[FOV] = v->fov > 0 ? v->fov : 60;
    out[REFRACTION] = v->refraction;
}

static void give(const double values[CHANNELS], tl_view *v)
{
    memcpy(v->eye, values + EYE, sizeof v->eye);
    memcpy(v->target, values + TARGET, sizeof v->target);
    v->heading = values[HEADING], v->roll = values[ROLL];
    v->pitch = fmin(fmax(values[PITCH], -90), 90); /* a cubic may swing beyond its keys */
    v->fov = fmin(fmax(values[FOV], .01), 179);
    v->refraction = fmin(fmax(values[REFRACTION], 0), .9);
}

static bool alike(const tl_view *a, const tl_view *b)
{
    return a->projected == b->projected && a->above_ground == b->above_ground && a->target_given == b->target_given &&
           a->target_above_ground == b->target_above_ground && a->width == b->width && a->height == b->height &&
           a->flat == b->flat;
}

static tl_status check(const tl_view_key *keys, size_t count, tl_error *error)
{
    if (!count)
        return tl_fail(error, TL_ERROR_ARGUMENT, "a path needs a view at least");
    for (size_t k = 1; k < count; k++) {
        if (!alike(&keys[0].view, &keys[k].view))
            return tl_fail(error, TL_ERROR_ARGUMENT,
                           "views 1 and %zu of the path differ in what heights count from, in being given a target, or "
                           "in their viewports; make them alike",
                           k + 1);
        if (!isnan(keys[0].time) && !(keys[k].time > keys[k - 1].time))
            return tl_fail(error, TL_ERROR_ARGUMENT,
                           "the times of a path must rise from view to view, or be left out of all: see view %zu",
                           k + 1);
    }
    return TL_OK;
}

/* The whole turns that bring an angle within half a turn of the one before. */
static void unwrap(double before, double *angle)
{
    *angle -= 360 * round((*angle - before) / 360);
}

/* Metres between two keys, by a sphere; where coordinates are no degrees, their own units. */
static double chord(const tl_view *first, const double a[CHANNELS], const double b[CHANNELS])
{
    const double degree = 111195, radian = 3.14159265358979323846 / 180;
    double scale = first->projected ? 1 : degree, east = (b[0] - a[0]) * scale, north = (b[1] - a[1]) * scale;
    if (!first->projected)
        east *= cos(.5 * (a[1] + b[1]) * radian);
    return sqrt(east * east + north * north + (b[2] - a[2]) * (b[2] - a[2]));
}

static void find_slopes(path *p)
{
    for (size_t k = 0; k < p->count; k++)
        for (int c = 0; c < CHANNELS; c++) {
            double before = k ? p->knots[k] - p->knots[k - 1] : 0,
                   after = k + 1 < p->count ? p->knots[k + 1] - p->knots[k] : 0;
            double rise = before > 0 ? (p->values[k][c] - p->values[k - 1][c]) / before : 0,
                   next = after > 0 ? (p->values[k + 1][c] - p->values[k][c]) / after : 0;
            p->slopes[k][c] = before > 0 && after > 0 ? (rise * after + next * before) / (before + after) : rise + next;
        }
}

static void fill(path *p, const tl_view_key *keys)
{
    const tl_view *first = &keys[0].view;
    double whole = 0;
    for (size_t k = 0; k < p->count; k++) {
        take(&keys[k].view, p->values[k]);
        if (!k)
            continue;
        unwrap(p->values[k - 1][HEADING], &p->values[k][HEADING]);
        unwrap(p->values[k - 1][ROLL], &p->values[k][ROLL]);
        if (!first->projected) {
            unwrap(p->values[k - 1][EYE], &p->values[k][EYE]);
            unwrap(p->values[k - 1][TARGET], &p->values[k][TARGET]);
        }
        whole += chord(first, p->values[k - 1], p->values[k]);
    }
    for (size_t k = 0; k < p->count; k++) { /* turning on the spot goes on a little, too */
        double step = k ? chord(first, p->values[k - 1], p->values[k]) : 0, least = fmax(whole * 1e-3, 1e-6);
        p->knots[k] = !isnan(keys[0].time) ? keys[k].time : k ? p->knots[k - 1] + fmax(step, least) : 0;
    }
    find_slopes(p);
}

/* ---- Places on it ---- */

/* The cubic with the keys' values and slopes. */
static void at(const path *p, double knot, double out[CHANNELS])
{
    size_t k = 0;
    while (k + 2 < p->count && knot > p->knots[k + 1])
        k++;
    size_t end = k + 1 < p->count ? k + 1 : k;
    double length = p->knots[end] - p->knots[k], t = length > 0 ? (knot - p->knots[k]) / length : 0;
    double t2 = t * t, t3 = t2 * t;
    for (int c = 0; c < CHANNELS; c++) /* what stays the same does so to the last bit: another lens is a new start */
        out[c] = p->values[k][c] + (3 * t2 - 2 * t3) * (p->values[end][c] - p->values[k][c]) +
                 (t3 - 2 * t2 + t) * length * p->slopes[k][c] + (t3 - t2) * length * p->slopes[end][c];
}

/* Knots at equal distances along the way: its length is summed up over PARTS steps a key. */
static tl_status even_out(const path *p, const tl_view *first, size_t frames, double *knots, tl_error *error)
{
    size_t parts = (p->count - 1) * PARTS;
    double *way = tl_alloc(parts + 1, sizeof *way), before[CHANNELS], here[CHANNELS];
    double start = p->knots[0], whole = p->knots[p->count - 1] - start;
    if (!way)
        return tl_fail_memory(error, "the path");
    way[0] = 0;
    at(p, start, before);
    for (size_t k = 1; k <= parts; k++) {
        at(p, start + whole * (double)k / (double)parts, here);
        way[k] = way[k - 1] + chord(first, before, here) + 1e-6 * whole / (double)parts;
        memcpy(before, here, sizeof before);
    }
    for (size_t f = 0, k = 0; f < frames; f++) {
        double goal = frames > 1 ? way[parts] * (double)f / (double)(frames - 1) : 0;
        while (k + 1 < parts && way[k + 1] < goal)
            k++;
        knots[f] = start + whole * ((double)k + (goal - way[k]) / (way[k + 1] - way[k])) / (double)parts;
    }
    free(way);
    return TL_OK;
}

static tl_status sample(const path *p, const tl_view_key *keys, size_t frames, tl_view *out, tl_error *error)
{
    double *knots = tl_alloc(frames, sizeof *knots), values[CHANNELS];
    double start = p->knots[0], whole = p->knots[p->count - 1] - start;
    if (!knots)
        return tl_fail_memory(error, "the path");
    for (size_t f = 0; f < frames; f++)
        knots[f] = start + (frames > 1 ? whole * (double)f / (double)(frames - 1) : 0);
    tl_status status = TL_OK;
    if (isnan(keys[0].time) && p->count > 1)
        status = even_out(p, &keys[0].view, frames, knots, error);
    for (size_t f = 0; f < frames && status == TL_OK; f++) {
        at(p, knots[f], values);
        out[f] = keys[0].view;
        give(values, &out[f]);
    }
    free(knots);
    return status;
}

tl_status tl_view_path_sample(const tl_view_key *keys, size_t count, size_t frames, tl_view *out, tl_error *error)
{
    tl_status status = check(keys, count, error);
    if (status != TL_OK)
        return status;
    path p = {.count = count};
    p.knots = tl_alloc(count, sizeof *p.knots);
    p.values = tl_alloc(count, sizeof *p.values);
    p.slopes = tl_alloc(count, sizeof *p.slopes);
    if (p.knots && p.values && p.slopes) {
        fill(&p, keys);
        status = sample(&p, keys, frames, out, error);
    } else
        status = tl_fail_memory(error, "the path");
    free(p.knots);
    free(p.values);
    free(p.slopes);
    return status;
}
