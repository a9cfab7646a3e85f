/* What a view makes of a triangle: whether it may be seen, and how many pixels its error takes. */
#include "dem/framework_pyramid.h"
#include "lib/base/size.h"
#include "lib/scene/field.h"
#include "lib/scene/lod.h"

#include <math.h>

/* Below the samples, the error of a triangle is so many standard deviations of the field from its plane, at the place
 * in it where that is largest. A normal number is farther in one case of 14; but few triangles are as near as their
 * error allows, where one level more would be a quarter as far, and few places in them are the worst one. Chosen by
 * tl_view_measure, so that in pictures the error is larger than asked for in less than one pixel of a thousand, and
 * nowhere twice as large: doc/accuracy.md. */
static const double QUANTILE = 1.8;
/* Strength of the detail that is taken where it is not looked up: in triangles of more than 64 cells, where what
 * matters is that rough ground among them is not missed. */
#define WIDE_STRENGTH 2.F
/* Rises of the surface between neighbouring vertices that do not happen: standard deviations. */
static const double STEEPEST = 5;
/* Triangles that look larger than this, radians, are tried by the rules that cost much; smaller ones lie in such. */
static const double WORTH_IT = .05;
/* Triangles below the samples are tried for being beside the screen at every so many depths only, where they are eight
 * times as long: a few pixels more at the rim of the screen, but most verdicts do not depend on where the eye turns. */
enum { TRIED = 6 };
/* Legs (metres) and widths (degrees of longitude) up to which the triangle's corners tell where it is. */
static const double LONGEST = 2e4, WIDEST = 8;
/* A lattice line of at most WIDEST degrees is off its chord by at most tan(WIDEST / 4) / 2 of it; and one of `leg`
 * metres on a sphere of more than 1.5e6 m by leg^2 / 8 R, twice for both directions. */
static const double MORE = 1.02, CURVING = 1 / (4 * 1.5e6);

/* ---- Spreads ---- */

/* Variance of fBm of delta 1 about the plane through the corners of a triangle, at the weights w. */
static double variance_at(const double w[3], double hurst)
{
    static const double corner[3][2] = {{0, 0}, {1, 0}, {.5, .5}};
    double x = w[1] + .5 * w[2], y = .5 * w[2], sum = 0;
    for (int k = 0; k < 3; k++) {
        sum += w[k] * pow(hypot(x - corner[k][0], y - corner[k][1]), 2 * hurst);
        int m = (k + 1) % 3;
        sum -= w[k] * w[m] * pow(hypot(corner[m][0] - corner[k][0], corner[m][1] - corner[k][1]), 2 * hurst);
    }
    return sum;
}

/* The largest standard deviation of fBm from a triangle with a hypotenuse of 1. */
static double largest_spread(double hurst)
{
    enum { STEPS = 16 };
    double most = 0;
    for (int a = 0; a <= STEPS; a++)
        for (int b = 0; a + b <= STEPS; b++) {
            const double w[3] = {(double)a / STEPS, (double)b / STEPS, (double)(STEPS - a - b) / STEPS};
            most = fmax(most, variance_at(w, hurst));
        }
    return sqrt(most);
}

/* Stage of the vertices that split triangles of a depth: they lie at odd multiples of 2^stage. */
static int stage_of(const lod *l, int depth)
{
    return l->lattice_log - 1 - depth / 2;
}

static int level_of(const lod *l, int depth)
{
    return l->levels - stage_of(l, depth);
}

static void find_spreads(lod *l)
{
    const tl_georef *g = &l->dem->info.georef;
    double mean = sqrt(g->cell_x * g->cell_y), side = fmax(g->cell_x, g->cell_y) / mean;
    double diagonal = hypot(g->cell_x, g->cell_y) / mean;
    l->steepest = 0;
    for (int depth = 2 * l->lattice_log; depth >= 0; depth--) {
        double cells = ldexp(1, stage_of(l, depth) + 1 - l->levels);
        l->legs[depth] = cells * (depth & 1 ? .5 * hypot(g->cell_x, g->cell_y) : fmax(g->cell_x, g->cell_y));
    }
    for (int depth = 2 * l->lattice_log; depth >= 0; depth--) {
        int level = level_of(l, depth);
        double finer = depth + 1 < LOD_DEPTHS ? l->spread[depth + 1] : 0, delta, hurst;
        l->spread[depth] = finer;
        if (level < 1 || level > l->field->info.level)
            continue;
        scene_field_fractal(l->field, level - 1, &delta, &hurst);
        double own = delta * largest_spread(hurst) * pow(depth & 1 ? side : diagonal, hurst);
        l->spread[depth] = fmax(finer, own);
        l->steepest = fmax(l->steepest, STEEPEST * delta * l->unit / ldexp(mean, 1 - level));
    }
}

int lod_block_depth(const lod *l)
{
    int depth = 2 * (l->lattice_log - l->levels - SCENE_TILE_LOG);
    return depth > 0 ? depth : 0;
}

static void find_planes(lod *l)
{
    const scene_camera *c = l->camera;
    double pixel = 1 / c->focal, across = c->width / 2 / c->focal + pixel, along = c->height / 2 / c->focal + pixel;
    const double parts[5][3] = {{1, 0, 0}, {across, 1, 0}, {across, -1, 0}, {along, 0, 1}, {along, 0, -1}};
    for (int k = 0; k < 5; k++) {
        double length = sqrt(parts[k][0] * parts[k][0] + parts[k][1] * parts[k][1] + parts[k][2] * parts[k][2]);
        for (int a = 0; a < 3; a++)
            l->planes[k][a] =
                (parts[k][0] * c->ahead[a] + parts[k][1] * c->right[a] + parts[k][2] * c->down[a]) / length;
    }
}

void lod_prepare_tests(lod *l)
{
    find_spreads(l);
    find_planes(l);
    lod_allow(l, l->pixel_error);
}

/* ---- One triangle ---- */

typedef struct lying {
    int32_t x0, y0, x1, y1; /* its box on the lattice */
    bool outside, over;     /* see dem/framework.h */
} lying;

static int32_t least(int32_t a, int32_t b, int32_t c)
{
    int32_t m = a < b ? a : b;
    return m < c ? m : c;
}

static int32_t most(int32_t a, int32_t b, int32_t c)
{
    return -least(-a, -b, -c);
}

/* Its edges run along rows, columns and diagonals, so where it shares no area with the raster, one of these directions
 * separates them. */
static lying lie_of(const lod *l, const lod_vertex *const v[3])
{
    lying at = {least(v[0]->x, v[1]->x, v[2]->x),
                least(v[0]->y, v[1]->y, v[2]->y),
                most(v[0]->x, v[1]->x, v[2]->x),
                most(v[0]->y, v[1]->y, v[2]->y),
                false,
                false};
    int64_t sum = (int64_t)v[0]->x + v[0]->y;
    for (int k = 1; k < 3; k++)
        sum = tl_int64_min(sum, (int64_t)v[k]->x + v[k]->y);
    at.outside = at.x0 >= l->right || at.y0 >= l->bottom || sum >= (int64_t)l->right + l->bottom;
    at.over = !at.outside && (at.x1 > l->right || at.y1 > l->bottom);
    return at;
}

/* A triangle as the tests see it. Heights in the model's unit. */
typedef struct subject {
    lying at;
    const lod_vertex *v[3];
    int depth;
    uint32_t block;
    double leg; /* metres, the longer one */
    int void_corners;
    float low, high; /* of its corners; of those that are void, the place's */
    double error;    /* of all levels; infinite where it must be split */
    double reach;    /* how far its surface may be from the plane of its corners */
    scene_cells cells;
} subject;

/* Squares of 2^log cells that a rectangle of cells shares some with: their number, and from ... to. */
static int64_t squares_under(const int64_t cells[4], int64_t side, int64_t columns, int64_t rows, int64_t out[4])
{
    out[0] = tl_int64_min(cells[0] / side, columns - 1), out[2] = tl_int64_min((cells[2] - 1) / side, columns - 1);
    out[1] = tl_int64_min(cells[1] / side, rows - 1), out[3] = tl_int64_min((cells[3] - 1) / side, rows - 1);
    return (out[2] - out[0] + 1) * (out[3] - out[1] + 1);
}

bool lod_wide_range(const lod *l, int64_t i0, int64_t j0, int64_t i1, int64_t j1, double *low, double *high)
{
    enum { FEW_BLOCKS = 4, FEW_SQUARES = 36 };
    const tl_pyramid *p = l->pyramid;
    const tl_framework *shape = p->shape;
    const int64_t cells[4] = {i0, j0, i1, j1};
    int64_t at[4];
    double least_z = HUGE_VAL, most_z = -HUGE_VAL;
    bool voids = false;
    *low = (double)l->low, *high = (double)l->high;
    if (squares_under(cells, 1 << TL_SQUARE_LOG, p->square_columns, p->square_rows, at) <= FEW_SQUARES) {
        for (int64_t j = at[1]; j <= at[3]; j++)
            for (int64_t i = at[0]; i <= at[2]; i++) {
                const tl_square_facts *facts = p->squares + j * p->square_columns + i;
                least_z = fmin(least_z, (double)facts->low);
                most_z = fmax(most_z, (double)facts->high);
                voids |= facts->voids;
            }
    } else if (squares_under(cells, shape->block, shape->columns, shape->rows, at) <= FEW_BLOCKS) {
        for (int64_t j = at[1]; j <= at[3]; j++)
            for (int64_t i = at[0]; i <= at[2]; i++) {
                const float *range = p->ranges + 2 * (j * shape->columns + i);
                least_z = fmin(least_z, (double)range[0]);
                most_z = fmax(most_z, (double)range[1]);
            }
        voids = l->voids;
    } else
        return l->voids;
    if (least_z <= most_z)
        *low = least_z, *high = most_z;
    return voids;
}

static const scene_cells wide_cells = {.strength = WIDE_STRENGTH, .rise = HUGE_VALF, .low = 1};

double lod_residual_at(const lod *l, const scene_cells *cells, int depth)
{
    cells = cells ? cells : &wide_cells;
    int level = level_of(l, depth);
    double noise = QUANTILE * l->spread[depth] * (double)cells->strength, bend = (double)cells->bend;
    if (l->field->info.level == 0)
        return 0;
    if (level > 0) /* a quarter for each halving of the hypotenuse, of which the first is a diagonal */
        bend = bend / (double)(UINT64_C(1) << (2 * (level - 1) + (depth & 1)));
    return sqrt(noise * noise + bend * bend);
}

double lod_residual(const lod *l, const scene_cells *cells)
{
    return lod_residual_at(l, cells, 2 * (l->lattice_log - l->levels));
}

/* Where heights around are all that is known. */
static void reach_by_range(const lod *l, subject *s)
{
    double low, high;
    lod_wide_range(l, s->at.x0 / l->cell, s->at.y0 / l->cell, tl_div_up(s->at.x1, l->cell),
                   tl_div_up(s->at.y1, l->cell), &low, &high);
    s->reach = fmax(high - (double)s->low, (double)s->high - low) + lod_residual_at(l, &s->cells, s->depth);
}

static void find_error(const lod *l, subject *s, int64_t i, int64_t j)
{
    int level = level_of(l, s->depth), log = stage_of(l, s->depth) + 1 - l->levels;
    s->cells = wide_cells;
    if (s->block != LOD_NONE)
        scene_block_at(l->tiles, s->block, s->at.x0 / l->cell, s->at.y0 / l->cell, log > 0 ? log : 0, &s->cells);
    s->error = lod_residual_at(l, &s->cells, s->depth);
    s->reach = s->error;
    if (level > 0) {
        if (s->void_corners)
            reach_by_range(l, s);
        return;
    }
    double own = s->at.over ? HUGE_VAL : tl_pyramid_error(l->pyramid, i, j);
    s->error += own;
    s->reach = s->error;
    if (!(own < HUGE_VAL))
        reach_by_range(l, s);
}

static subject subject_of(const lod *l, const lod_triangle *t, int depth)
{
    subject s = {.v = {lod_at(l, t->a), lod_at(l, t->b), lod_at(l, t->apex)}, .depth = depth, .block = t->block};
    s.at = lie_of(l, s.v);
    s.low = HUGE_VALF, s.high = -HUGE_VALF;
    for (int k = 0; k < 3; k++)
        s.void_corners += isnan(s.v[k]->z);
    for (int k = 0; k < (s.void_corners ? 2 : 3); k++) { /* see look_at */
        float z = isnan(s.v[k]->z) ? l->filling : s.v[k]->z;
        s.low = z < s.low ? z : s.low;
        s.high = z > s.high ? z : s.high;
    }
    s.leg = l->legs[depth];
    return s;
}

/* Where it is, and how near. */
typedef struct sight {
    double distance;
    unsigned hidden;               /* tl_culling */
    double margin, beside[2], far; /* as in lod_verdict, of being hidden or not */
} sight;

/* Beside the screen, by a ball around it. `margins`: how far from changing, as in lod_verdict. */
static bool beside(const lod *l, const double middle[3], double radius, double margins[2])
{
    double inside[2] = {HUGE_VAL, HUGE_VAL};
    for (int k = 0; k < 5; k++) {
        const double *n = l->planes[k];
        double d = n[0] * middle[0] + n[1] * middle[1] + n[2] * middle[2] + radius;
        inside[k > 2] = d < inside[k > 2] ? d : inside[k > 2];
    }
    margins[0] = inside[0], margins[1] = inside[1];
    if (inside[0] >= 0 && inside[1] >= 0)
        return false;
    int most = inside[1] < inside[0]; /* outside of one plane is enough */
    margins[most] = -inside[most];
    margins[!most] = HUGE_VAL;
    return true;
}

static double steepness(const lod *l, const subject *s)
{
    if (s->block == LOD_NONE || !(s->cells.rise < HUGE_VALF))
        return HUGE_VAL;
    return 1.5 * (double)s->cells.rise * l->unit / fmin(l->metres_x, l->metres_y) +
           l->steepest * (double)s->cells.strength;
}

static scene_extent extent_of(const lod *l, const subject *s)
{
    scene_extent e = {(double)s->at.x0 / l->cell,
                      (double)s->at.y0 / l->cell,
                      fmin((double)s->at.x1, (double)l->right) / l->cell,
                      fmin((double)s->at.y1, (double)l->bottom) / l->cell,
                      (double)s->low - s->reach,
                      (double)s->high + s->reach};
    return e;
}

/* By boxes: for what is large, and for rules that cost much. */
static sight look_at_box(const lod *l, const subject *s, unsigned rules)
{
    scene_extent extent = extent_of(l, s);
    scene_box box;
    sight out = {.margin = -1, .beside = {HUGE_VAL, HUGE_VAL}};
    scene_view_box(l->view, &extent, &box);
    out.hidden = scene_view_hides(l->view, &extent, &box, steepness(l, s),
                                  rules & (TL_CULL_FRUSTUM | TL_CULL_BACK | TL_CULL_HORIZON));
    out.distance = scene_view_distance(l->view, &box);
    return out;
}

bool lod_at_ridge(const lod *l, int depth)
{
    return l->ridges && !(depth & 1) && stage_of(l, depth) + 1 - l->levels >= LOD_RIDGE_LOG;
}

static bool behind_ridge(const lod *l, const lying *at, int depth)
{
    return lod_at_ridge(l, depth) &&
           lod_ridges_hide(l->ridges, at->x0 / l->cell, at->y0 / l->cell, stage_of(l, depth) + 1 - l->levels);
}

bool lod_behind_ridge(const lod *l, const lod_triangle *t, int depth)
{
    const lod_vertex *v[3] = {lod_at(l, t->a), lod_at(l, t->b), lod_at(l, t->apex)};
    lying at = lie_of(l, v);
    return behind_ridge(l, &at, depth);
}

/* Where blocks begin a triangle is also tried by the box around the heights that the pyramid knows there, which is
 * smaller than a ball: what that hides is not read. */
static bool stays_out(const lod *l, const subject *s, unsigned rules)
{
    scene_box box;
    scene_extent extent = extent_of(l, s);
    double more = lod_residual(l, NULL);
    if (s->depth != lod_block_depth(l) || !(rules & TL_CULL_FRUSTUM))
        return false;
    lod_wide_range(l, s->at.x0 / l->cell, s->at.y0 / l->cell, tl_div_up(s->at.x1, l->cell),
                   tl_div_up(s->at.y1, l->cell), &extent.low, &extent.high);
    extent.low -= more;
    extent.high += more;
    scene_view_box(l->view, &extent, &box);
    return scene_view_hides(l->view, &extent, &box, HUGE_VAL, TL_CULL_FRUSTUM) != 0;
}

static sight look_at(const lod *l, const subject *s, unsigned rules)
{
    if (s->at.over || s->leg > LONGEST || l->degrees * (s->at.x1 - s->at.x0) / l->cell > WIDEST) {
        sight wide = look_at_box(l, s, rules);
        if (!wide.hidden && rules & TL_CULL_RIDGE && behind_ridge(l, &s->at, s->depth))
            wide.hidden = TL_CULL_RIDGE;
        return wide;
    }
    const float *a = s->v[0]->at, *b = s->v[1]->at, *apex = s->v[2]->at;
    double middle[3], to_a = 0, to_apex = 0, far = 0;
    for (int k = 0; k < 3; k++) {
        middle[k] = .5 * ((double)a[k] + (double)b[k]);
        to_a += ((double)a[k] - middle[k]) * ((double)a[k] - middle[k]);
        to_apex += ((double)apex[k] - middle[k]) * ((double)apex[k] - middle[k]);
        far += middle[k] * middle[k];
    }
    far = sqrt(far);
    if (s->void_corners) /* the other diagonal may be drawn, by whichever half of the square: see both alike */
        to_apex = 1.1 * to_a;
    double radius = MORE * sqrt(fmax(to_a, to_apex)) + CURVING * s->leg * s->leg + s->reach * l->unit + 1e-6 * far;
    sight out = {.distance = fmax(0, far - radius), .margin = HUGE_VAL, .beside = {HUGE_VAL, HUGE_VAL}, .far = far};
    bool box = !(s->depth & 1) && rules & (TL_CULL_BACK | TL_CULL_HORIZON) && s->leg > WORTH_IT * far;
    bool tried = level_of(l, s->depth) <= 0 || s->depth % TRIED == 0;
    if (tried && rules & TL_CULL_FRUSTUM && beside(l, middle, radius, out.beside))
        out.hidden = TL_CULL_FRUSTUM;
    else if (stays_out(l, s, rules)) {
        out.hidden = TL_CULL_FRUSTUM;
        out.margin = -1;
    } else if (box)
        out.hidden = look_at_box(l, s, rules & ~(unsigned)TL_CULL_FRUSTUM).hidden;
    if (box || s->depth == lod_block_depth(l))
        out.margin = -1;
    if (!out.hidden && rules & TL_CULL_RIDGE && behind_ridge(l, &s->at, s->depth))
        out.hidden = TL_CULL_RIDGE;
    return out;
}

/* Whether cells are to be smaller, by distance alone. */
static bool out_of_band(const lod *l, int depth, double distance)
{
    const tl_lod_options *o = l->options;
    size_t k = 0;
    while (k < o->band_count && distance > o->bands[k])
        k++;
    return stage_of(l, depth) + 1 + l->field->info.level - l->levels > (int)k;
}

static float priority_of(const lod *l, int depth, double error, double distance)
{
    if (level_of(l, depth) > l->finest)
        return -1;
    if (l->options->band_count)
        return out_of_band(l, depth, distance) ? HUGE_VALF : -1;
    return (float)scene_view_pixels(l->view, error, distance);
}

bool lod_wants(lod *l, int depth, double error, double distance)
{
    float priority = priority_of(l, depth, error, distance);
    lod_spare(l, priority);
    return (double)priority > l->pixel_error;
}

void lod_allow(lod *l, double pixel_error)
{
    double small = 0, large = 1; /* of x = error / (2 distance): see scene_view_pixels */
    l->pixel_error = pixel_error;
    l->next = 0;
    for (int k = 0; k < 60; k++) {
        double middle = .5 * (small + large);
        *(scene_view_pixels(l->view, 2 * middle, 1) > pixel_error ? &large : &small) = middle;
    }
    l->near = large > 0 ? 1 / (2 * large) : HUGE_VAL;
}

/* Whether a triangle wants to be split for its chunk; finds that, and whether it is hidden. */
static bool wants_for_chunk(const lod *l, const subject *s, const lod_triangle *t, unsigned rules, lod_verdict *out)
{
    int stage = stage_of(l, s->depth), step = t->step - 1;
    unsigned hidden = 0;
    if (!t->step && !(s->depth & 1))
        lod_chunk_says(l->chunks, s->at.x0, s->at.y0, stage + 1, &step, &hidden);
    if (hidden & rules)
        *out = (lod_verdict){.state = LOD_HIDDEN, .rule = (unsigned char)hidden};
    out->step = (signed char)(step + 1);
    return (step < 0 || stage >= step) && level_of(l, s->depth) <= l->finest;
}

lod_verdict lod_test(const lod *l, const lod_triangle *t, int depth, unsigned rules)
{
    subject s = subject_of(l, t, depth);
    int stage = stage_of(l, depth), level = l->levels - stage;
    int32_t x, y;
    lod_middle(l, t, &x, &y);
    bool ends = stage < 0; /* legs of 1 */
    if (s.at.outside)
        return (lod_verdict){
            .state = LOD_DROPPED, .priority = -1, .margin = HUGE_VALF, .beside = {HUGE_VALF, HUGE_VALF}};
    find_error(l, &s, x / l->cell, y / l->cell);
    if (s.void_corners && (level > 0 || s.error < HUGE_VAL) && (level <= 0 || s.void_corners > 1))
        return (lod_verdict){
            .state = LOD_DROPPED, .priority = -1, .margin = HUGE_VALF, .beside = {HUGE_VALF, HUGE_VALF}};
    sight seen = look_at(l, &s, rules);
    if (seen.hidden)
        return (lod_verdict){.state = LOD_HIDDEN,
                             .rule = (unsigned char)seen.hidden,
                             .priority = -1,
                             .margin = seen.hidden & (TL_CULL_RIDGE | TL_CULL_FRUSTUM) ? (float)seen.margin : -1,
                             .beside = {(float)seen.beside[0], (float)seen.beside[1]},
                             .far = (float)seen.far};
    bool forced = !(s.error < HUGE_VAL), can = !ends && !(level > 0 && s.void_corners);
    double error = s.error * l->unit;
    lod_verdict out = {.pixels = forced ? HUGE_VALF : (float)scene_view_pixels(l->view, error, seen.distance),
                       .priority = !can     ? -1
                                   : forced ? HUGE_VALF
                                            : priority_of(l, depth, error, seen.distance),
                       .margin = (float)seen.margin,
                       .beside = {(float)seen.beside[0], (float)seen.beside[1]},
                       .far = (float)seen.far};
    if (can && !forced && level <= l->finest)
        out.margin = l->options->band_count ? -1 : (float)fmin(seen.margin, fabs(seen.distance - l->near * error));
    if (l->chunks) {
        bool wants = wants_for_chunk(l, &s, t, rules, &out);
        if (can && !forced)
            out.priority = wants ? HUGE_VALF : -1;
    }
    if (out.state != LOD_HIDDEN)
        out.state = (double)out.priority > l->pixel_error ? LOD_SPLIT : LOD_LEAF;
    return out;
}
