#include "lib/scene/chain.h"

#include "fbm/elementary.h"
#include "fbm/kernel.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <assert.h>
#include <math.h>
#include <pthread.h>
#include <string.h>

enum { STAGES = SCENE_LEVEL_MAX + 3 };

/* How a target is made: stages are the halvings of the rows, then the levels. windows[s]: what must be there before
 * stage s; the last is what the stages make (or the cells, for centres). Where rows were halved, the target is every
 * 2^halvings-th row of that, and centres of cells are samples of the next level. */
typedef struct work {
    const scene_chain *chain;
    int stages;
    bool centres;
    fbm_window windows[STAGES + 1];
    size_t step_x, step_y; /* of the target in what is made */
    float *level[2];       /* before even and odd stages */
    /* Planes before even and odd stages. Where they are of coefficients by place, they lag behind: the stages s and
     * s - FBM_PLACES_SHIFT go together, and fields[s] is the planes' window. */
    float *planes[2][SCENE_PLANES];
    fbm_window fields[STAGES + 1];
    int field; /* the stage that the coefficients of strength 1 are of, -1: none */
    float *unit, *values, *strengths;
    float *faded, *halved; /* of halvings by place: strengths of the noise, and a result for one exponent */
    float *made;           /* NULL: it is made in its place */
    float *scratch;
    void *rows; /* weights that follow the rows */
} work;

static fbm_window transposed(fbm_window w)
{
    return (fbm_window){w.j, w.i, w.height, w.width, w.height};
}

/* ---- Planning ---------------------------------------------------------------------------------- */

/* The window that the last stage makes. */
static fbm_window goal(const scene_chain *chain, const scene_chain_target *target, work *w)
{
    int halvings = chain->shape.halvings;
    fbm_window g = chain->shape.turned ? transposed(target->window) : target->window;
    w->stages = halvings + target->level;
    w->centres = target->centres && halvings == 0;
    w->step_x = 1;
    w->step_y = (size_t)1 << halvings;
    if (target->centres && halvings) { /* (i + 1/2, j + 1/2) is (2i + 1, 2j + 1) of the next level */
        w->stages++;
        w->step_x = 2;
        w->step_y *= 2;
        g.i = 2 * g.i + 1;
        g.width = 2 * g.width - 1;
    }
    int64_t step = (int64_t)w->step_y;
    g.j = g.j * step + (target->centres && halvings ? step / 2 : 0);
    g.height = (g.height - 1) * w->step_y + 1;
    return g;
}

static void plan(const scene_chain *chain, const scene_chain_target *target, work *w)
{
    assert(target->level >= 0 && target->level <= SCENE_LEVEL_MAX && target->window.width && target->window.height);
    int halvings = chain->shape.halvings;
    *w = (work){.chain = chain};
    fbm_window g = goal(chain, target, w);
    const fbm_step *steps = chain->steps;
    w->windows[w->stages] = w->centres ? fbm_centres_support(steps[target->level].scheme, g) : g;
    for (int s = w->stages; s > 0; s--)
        w->windows[s - 1] = s > halvings ? fbm_refine_support(steps[s - 1 - halvings].scheme, w->windows[s])
                                         : fbm_rows_support(w->windows[s]);
}

static fbm_window asked_for(const scene_chain *chain, fbm_window window)
{
    return chain->shape.turned ? transposed(window) : window;
}

/* The stage on whose vertices the coefficients of a stage lie. */
static int field_of(const work *w, int stage)
{
    int halvings = w->chain->shape.halvings;
    return stage - FBM_PLACES_SHIFT > halvings ? stage - FBM_PLACES_SHIFT : halvings;
}

/* The vertices of coefficients that span a stage's input. */
static fbm_window vertices_of(const work *w, int stage)
{
    const fbm_window *from = &w->windows[stage];
    int shift = stage - field_of(w, stage);
    int64_t unit = INT64_C(1) << shift, last_i = from->i + (int64_t)from->width - 1,
            last_j = from->j + (int64_t)from->height - 1;
    fbm_window of = {.i = from->i >> shift, .j = from->j >> shift};
    of.width = of.stride = (size_t)(((last_i + unit - 1) >> shift) - of.i + 1);
    of.height = (size_t)(((last_j + unit - 1) >> shift) - of.j + 1);
    return of;
}

static fbm_window hull(fbm_window a, fbm_window b)
{
    int64_t i = tl_int64_min(a.i, b.i), j = tl_int64_min(a.j, b.j);
    int64_t right = tl_int64_max(a.i + (int64_t)a.width, b.i + (int64_t)b.width);
    int64_t below = tl_int64_max(a.j + (int64_t)a.height, b.j + (int64_t)b.height);
    return (fbm_window){i, j, (size_t)(right - i), (size_t)(below - j), (size_t)(right - i)};
}

/* The planes' windows. Up to the first level they are the heights'; those of later stages take less of it than the
 * heights do, which need 4 samples more on every side for a level where planes need one. */
static void plan_fields(work *w)
{
    int first = w->chain->shape.halvings, last_stage = w->stages - !w->centres, last = field_of(w, last_stage);
    for (int s = 0; s <= first; s++)
        w->fields[s] = w->windows[s];
    for (int s = last; s > first; s--) {
        w->fields[s] = vertices_of(w, s + FBM_PLACES_SHIFT);
        if (s < last)
            w->fields[s] = hull(w->fields[s], fbm_refine_support(fbm_scheme_find("square"), w->fields[s + 1]));
    }
    for (int s = 0; s <= last; s++)
        w->fields[s].stride = w->fields[s].width;
}

fbm_window scene_chain_support(const scene_chain *chain, const scene_chain_target *target)
{
    work w;
    plan(chain, target, &w);
    fbm_window window = asked_for(chain, w.windows[0]);
    window.stride = window.width;
    return window;
}

static void work_free(work *w)
{
    for (int k = 0; k < 2; k++) {
        free(w->level[k]);
        for (int p = 0; p < SCENE_PLANES; p++)
            free(w->planes[k][p]);
    }
    free(w->unit);
    free(w->values);
    free(w->strengths);
    free(w->faded);
    free(w->halved);
    free(w->made);
    free(w->scratch);
    free(w->rows);
}

static size_t larger(size_t a, size_t b)
{
    return a > b ? a : b;
}

/* Room for a plane before even and odd stages. */
static bool allocate_planes(work *w, const size_t most[2])
{
    const bool wanted[SCENE_PLANES] = {w->chain->mapped || w->chain->placed, w->chain->placed};
    for (int k = 0; k < 2; k++)
        for (int p = 0; p < SCENE_PLANES; p++) {
            w->planes[k][p] = wanted[p] ? tl_alloc(most[k], sizeof(float)) : NULL;
            if (wanted[p] && !w->planes[k][p])
                return false;
        }
    return true;
}

/* Room for the coefficients of any stage. */
static bool allocate_places(work *w)
{
    size_t most = 1, values, last = (size_t)(w->stages + w->centres);
    for (size_t s = (size_t)w->chain->shape.halvings; s < last; s++) {
        fbm_window of = w->fields[field_of(w, (int)s)];
        most = larger(most, of.width * of.height); /* no more than the heights, whose size is checked */
    }
    if (!tl_size_mul(most, fbm_places_size(w->chain->places.square), &values))
        return false;
    w->unit = tl_alloc(values, sizeof(float));
    w->values = tl_alloc(values + FBM_PLACES_SPARE, sizeof(float));
    w->strengths = tl_alloc(most, sizeof(float));
    if (w->values)
        memset(w->values, 0, (values + FBM_PLACES_SPARE) * sizeof(float));
    return w->unit && w->values && w->strengths;
}

/* Room for every window of the plan but the one that is written straight to the caller. */
static bool allocate(work *w, bool in_place)
{
    size_t most[2] = {1, 1}, width = 1, height = 1, last = 1;
    for (int s = 0; s <= w->stages; s++) {
        size_t samples;
        if (!tl_size_mul(w->windows[s].width, w->windows[s].height, &samples))
            return false;
        if (s < w->stages || w->centres || w->chain->placed)
            most[s & 1] = larger(most[s & 1], samples);
        if (s == w->stages)
            last = samples;
        width = larger(width, w->windows[s].width);
        height = larger(height, w->windows[s].height);
        w->windows[s].stride = s < w->stages || w->centres || !in_place ? w->windows[s].width : w->windows[s].stride;
    }
    bool good = true;
    for (int k = 0; k < 2; k++) {
        w->level[k] = tl_alloc(most[k], sizeof(float));
        good = good && w->level[k];
    }
    w->field = -1;
    if (w->chain->placed)
        plan_fields(w);
    good = good && allocate_planes(w, most) && (!w->chain->placed || allocate_places(w));
    if (w->chain->placed && w->chain->shape.halvings) {
        w->faded = tl_alloc(larger(most[0], most[1]), sizeof(float));
        w->halved = tl_alloc(larger(larger(most[0], most[1]), last), sizeof(float));
        good = good && w->faded && w->halved;
    }
    size_t scratch = larger(fbm_refine_scratch(2 * width), fbm_rows_scratch(width));
    w->scratch = tl_alloc(scratch, sizeof(float));
    w->made = in_place ? NULL : tl_alloc(last, sizeof(float));
    w->rows = w->chain->tables ? tl_alloc(2 * height + 8, sizeof(fbm_weights)) : NULL;
    return good && w->scratch && (w->made || in_place) && (w->rows || !w->chain->tables);
}

/* ---- Weights that follow the rows -------------------------------------------------------------- */

/* log2 of the aspect at a place, in rows of level 0; beyond the raster that of its rim. */
static double log_aspect(const scene_shape *shape, double row)
{
    if (!(row > 0))
        return shape->log_aspects[0];
    if (row >= (double)(shape->rows - 1))
        return shape->log_aspects[shape->rows - 1];
    int64_t at = (int64_t)row;
    double part = row - (double)at;
    return (1 - part) * shape->log_aspects[at] + part * shape->log_aspects[at + 1];
}

/* Half a row before stage s, in rows of level 0. */
static double half_row(int stage)
{
    return 1 / (double)((int64_t)2 << stage);
}

static fbm_step step_at(work *w, int stage)
{
    const scene_chain *c = w->chain;
    fbm_step step = c->steps[stage - c->shape.halvings];
    if (!c->tables || c->placed)
        return step;
    fbm_window from = w->windows[stage];
    fbm_weights *rows = w->rows;
    double unit = half_row(stage);
    step.first_row = 2 * from.j - 2;
    for (size_t k = 0; k < 2 * from.height + 4; k++) {
        double place = (double)(step.first_row + (int64_t)k) * unit;
        fbm_aspect_table_at(&c->tables[stage - c->shape.halvings], log_aspect(&c->shape, place), &rows[k]);
    }
    step.rows = rows;
    return step;
}

/* With the weights of a table that follow the rows, or that has one aspect. */
static fbm_row_step row_step_by(work *w, int stage, const fbm_row_table *table)
{
    const scene_chain *c = w->chain;
    fbm_row_step step = c->row_steps[stage];
    if (!c->row_tables) {
        fbm_row_table_at(table, table->low, &step.weights);
        return step;
    }
    fbm_row_weights *rows = w->rows;
    double before = stage - c->shape.halvings; /* aspects are those after all halvings */
    step.first_row = w->windows[stage].j;
    for (size_t k = 0; k < w->windows[stage].height; k++) {
        double place = (double)(2 * (step.first_row + (int64_t)k) + 1) * half_row(stage);
        fbm_row_table_at(table, log_aspect(&c->shape, place) + before, &rows[k]);
    }
    step.rows = rows;
    return step;
}

static fbm_row_step row_step_at(work *w, int stage)
{
    const scene_chain *c = w->chain;
    return c->row_tables ? row_step_by(w, stage, &c->row_tables[stage]) : c->row_steps[stage];
}

/* ---- Refining ---------------------------------------------------------------------------------- */

/* The planes of the next stage, bilinear between the vertices of this one: means, without noise. */
static void refine_planes(work *w, int stage, fbm_window from, fbm_window to)
{
    fbm_step means = {.scheme = fbm_scheme_find("square")};
    means.scheme->weights(.5, &means.weights);
    fbm_row_step row_means = {.weights = {.w = {.5F}}};
    for (int p = 0; p < SCENE_PLANES; p++) {
        const float *in = w->planes[stage & 1][p];
        float *out = w->planes[(stage + 1) & 1][p];
        if (in && stage < w->chain->shape.halvings)
            fbm_refine_rows(&row_means, in, NULL, from, out, to, w->scratch);
        else if (in)
            fbm_refine(&means, in, from, out, to, w->scratch);
    }
}

/* Brings the planes, and the coefficients of strength 1, to the vertices that a stage's coefficients lie on. */
static void advance_fields(work *w, int stage)
{
    const scene_chain *c = w->chain;
    int wanted = field_of(w, stage);
    if (w->field == wanted)
        return;
    for (int s = w->field < 0 ? c->shape.halvings : w->field; s < wanted; s++)
        refine_planes(w, s, w->fields[s], w->fields[s + 1]);
    w->field = wanted;
    const fbm_window *of = &w->fields[wanted];
    double unit = 2 * half_row(wanted);
    for (size_t row = 0; row < of->height; row++) {
        double log = c->tables ? log_aspect(&c->shape, (double)(of->j + (int64_t)row) * unit) : c->places.low;
        fbm_places_unit(&c->places, log, w->planes[wanted & 1][SCENE_HURST] + row * of->width, of->width,
                        w->unit + row * of->width * fbm_places_size(c->places.square));
    }
}

/* The coefficients of a stage. */
static fbm_places places_at(work *w, int stage)
{
    const scene_chain *c = w->chain;
    advance_fields(w, stage);
    int field = w->field;
    const size_t size = fbm_places_size(c->places.square);
    const fbm_window *of = &w->fields[field], window = vertices_of(w, stage);
    const double fall = c->fall + (double)(stage - c->shape.halvings);
    fbm_places_strengths(fall, w->planes[field & 1][SCENE_STRENGTH], w->planes[field & 1][SCENE_HURST],
                         of->width * of->height, w->strengths);
    for (size_t row = 0; row < window.height; row++) {
        size_t line = (row + (size_t)(window.j - of->j)) * of->width, first = (size_t)(window.i - of->i);
        fbm_places_scale(&c->places, w->strengths + line + first, window.width, w->unit + line * size + first,
                         of->width, w->values + row * window.width * size);
    }
    return (fbm_places){.shift = stage - field, .square = c->places.square, .window = window, .values = w->values};
}

/* An exponent's place among the exponents of halvings. */
static float row_place(float hurst)
{
    const float most = SCENE_ROW_EXPONENTS - 1;
    return fminf(fmaxf((hurst - FBM_PLACES_LOW) * (most / .98F), 0), most);
}

/* Adds what one exponent has in the results of all to new rows; old ones are the same in each. */
static void add_halved(const work *w, int stage, int exponent, float *out)
{
    const fbm_window *to = &w->windows[stage + 1];
    const float *hurst = w->planes[(stage + 1) & 1][SCENE_HURST];
    for (size_t y = 0; y < to->height; y++) {
        const float *from = w->halved + y * to->width, *h = hurst + y * to->width;
        float *row = out + y * to->stride;
        if ((to->j + (int64_t)y) % 2 == 0)
            memcpy(row, from, to->width * sizeof *row);
        else
            for (size_t x = 0; x < to->width; x++)
                row[x] += fmaxf(1 - fabsf(row_place(h[x]) - (float)exponent), 0) * from[x];
    }
}

/* A halving of the rows by place: weights are linear between exponents, so it is the mean of what these make of the
 * same noise. Only exponents that occur are made; of the others the share is 0. The planes of the next stage must be
 * there. */
static void halve_by_place(work *w, int stage, float *out)
{
    const fbm_window *from = &w->windows[stage], *to = &w->windows[stage + 1];
    const float *strength = w->planes[stage & 1][SCENE_STRENGTH], *hurst = w->planes[stage & 1][SCENE_HURST];
    const float fall = (float)(w->chain->fall - w->chain->shape.halvings + stage);
    fbm_kernels()[0]->strengths(strength, hurst, fall, w->faded, from->width * from->height);
    float low = SCENE_ROW_EXPONENTS, high = 0;
    for (size_t k = 0; k < to->width * to->height; k++) {
        float place = row_place(w->planes[(stage + 1) & 1][SCENE_HURST][k]);
        low = fminf(low, place);
        high = fmaxf(high, place);
    }
    for (size_t y = 0; y < to->height; y++)
        memset(out + y * to->stride, 0, to->width * sizeof *out);
    fbm_window dense = *to;
    dense.stride = to->width;
    for (int e = (int)low; e < SCENE_ROW_EXPONENTS && (float)e < high + 1; e++) {
        fbm_row_step step = row_step_by(w, stage, &w->chain->place_rows[stage * SCENE_ROW_EXPONENTS + e]);
        step.amplitude = 1;
        fbm_refine_rows(&step, w->level[stage & 1], w->faded, *from, w->halved, dense, w->scratch);
        add_halved(w, stage, e, out);
    }
}

static void run_stage(work *w, int stage, float *out)
{
    if (w->chain->placed && stage < w->chain->shape.halvings) {
        halve_by_place(w, stage, out);
        return;
    }
    const float *in = w->level[stage & 1], *map = w->chain->placed ? NULL : w->planes[stage & 1][SCENE_STRENGTH];
    if (stage < w->chain->shape.halvings) {
        fbm_row_step step = row_step_at(w, stage);
        fbm_refine_rows(&step, in, map, w->windows[stage], out, w->windows[stage + 1], w->scratch);
        return;
    }
    fbm_step step = step_at(w, stage);
    fbm_places places;
    if (w->chain->placed) {
        places = places_at(w, stage);
        step.places = &places;
    }
    fbm_refine_mapped(&step, in, map, w->windows[stage], out, w->windows[stage + 1], w->scratch);
}

static void run_centres(work *w, float *out, fbm_window cells)
{
    int stage = w->stages;
    fbm_step step = step_at(w, stage);
    fbm_places places;
    if (w->chain->placed) {
        places = places_at(w, stage);
        step.places = &places;
    }
    fbm_centres_mapped(&step, w->level[stage & 1], w->chain->placed ? NULL : w->planes[stage & 1][SCENE_STRENGTH],
                       w->windows[stage], out, cells, w->scratch);
}

/* Makes `out`, of the last window; for centres, of the window `cells`. */
static void refine_all(work *w, float *out, fbm_window cells)
{
    for (int s = 0; s < w->stages; s++) {
        bool last = s + 1 == w->stages && !w->centres, halving = s < w->chain->shape.halvings;
        if (w->chain->placed ? halving : w->chain->mapped && !last)
            refine_planes(w, s, w->windows[s], w->windows[s + 1]);
        run_stage(w, s, last ? out : w->level[(s + 1) & 1]);
    }
    if (w->centres)
        run_centres(w, out, cells);
}

/* Takes the target's samples out of what was made, turned back if it was turned. */
static void pick(const work *w, const scene_chain_target *target)
{
    size_t stride = w->windows[w->stages].width;
    bool turned = w->chain->shape.turned;
    for (size_t y = 0; y < target->window.height; y++)
        for (size_t x = 0; x < target->window.width; x++) {
            size_t i = turned ? y : x, j = turned ? x : y;
            target->out[y * target->window.stride + x] = w->made[j * w->step_y * stride + i * w->step_x];
        }
}

static void transpose(const float *in, size_t width, size_t height, float *out)
{
    for (size_t y = 0; y < height; y++)
        for (size_t x = 0; x < width; x++)
            out[x * height + y] = in[y * width + x];
}

static tl_status load_turned(work *w, scene_chain_load load, void *context, const char *name, tl_error *error)
{
    fbm_window window = asked_for(w->chain, w->windows[0]);
    size_t count = window.width * window.height;
    float *heights = tl_alloc(count, sizeof *heights), *planes[SCENE_PLANES] = {NULL};
    bool good = heights != NULL;
    for (int p = 0; p < SCENE_PLANES && good; p++)
        if (w->planes[0][p]) {
            planes[p] = tl_alloc(count, sizeof *planes[p]);
            good = planes[p] != NULL;
        }
    tl_status status = good ? load(context, window, heights, planes, error) : tl_fail_memory(error, name);
    if (status == TL_OK)
        transpose(heights, window.width, window.height, w->level[0]);
    for (int p = 0; p < SCENE_PLANES; p++) {
        if (status == TL_OK && planes[p])
            transpose(planes[p], window.width, window.height, w->planes[0][p]);
        free(planes[p]);
    }
    free(heights);
    return status;
}

/* Centres of turned cells go to a buffer, too: the window is then that of the cells. */
static tl_status run_turned_centres(work *w, const scene_chain_target *target, const char *name, tl_error *error)
{
    fbm_window cells = transposed(target->window);
    float *made = tl_alloc_grid((int64_t)cells.width, (int64_t)cells.height, sizeof *made);
    if (!made)
        return tl_fail_memory(error, name);
    refine_all(w, made, cells);
    for (size_t y = 0; y < target->window.height; y++)
        for (size_t x = 0; x < target->window.width; x++)
            target->out[y * target->window.stride + x] = made[x * cells.width + y];
    free(made);
    return TL_OK;
}

tl_status scene_chain_run(const scene_chain *chain, const scene_chain_target *target, scene_chain_load load,
                          void *context, const char *name, tl_error *error)
{
    work w;
    plan(chain, target, &w);
    bool turned = chain->shape.turned;
    bool in_place = w.centres || (w.step_y == 1 && !turned && w.stages > 0);
    tl_status status = allocate(&w, in_place) ? TL_OK : tl_fail_memory(error, name);
    if (status == TL_OK && w.stages == 0 && !w.centres) { /* level 0: what is loaded is what is made */
        free(w.level[0]);
        w.level[0] = w.made;
        for (int p = 0; p < SCENE_PLANES; p++) {
            free(w.planes[0][p]);
            w.planes[0][p] = NULL;
        }
    }
    if (status == TL_OK)
        status = turned ? load_turned(&w, load, context, name, error)
                        : load(context, w.windows[0], w.level[0], w.planes[0], error);
    if (status == TL_OK && w.centres && turned)
        status = run_turned_centres(&w, target, name, error);
    else if (status == TL_OK)
        refine_all(&w, in_place ? target->out : w.made, target->window);
    if (status == TL_OK && !in_place)
        pick(&w, target);
    if (w.level[0] == w.made)
        w.made = NULL;
    work_free(&w);
    return status;
}

tl_status scene_chain_fit_places(scene_chain *chain, const char *name, tl_error *error)
{
    const scene_shape *shape = &chain->shape;
    double log = fbm_log2(ldexp(shape->aspect, shape->halvings));
    double low = chain->tables ? shape->low : log, high = chain->tables ? shape->high : log;
    chain->place_values = tl_alloc(fbm_places_table_size(low, high), sizeof(float));
    if (!chain->place_values)
        return tl_fail_memory(error, name);
    fbm_places_table_make(low, high, chain->place_values, &chain->places);
    if (shape->halvings) {
        chain->place_rows = tl_alloc((size_t)shape->halvings * SCENE_ROW_EXPONENTS, sizeof *chain->place_rows);
        if (!chain->place_rows)
            return tl_fail_memory(error, name);
    }
    for (int k = 0; k < shape->halvings * SCENE_ROW_EXPONENTS; k++) {
        int step = k / SCENE_ROW_EXPONENTS, back = step - shape->halvings;
        double hurst =
            FBM_HURST_MIN + k % SCENE_ROW_EXPONENTS * (FBM_HURST_MAX - FBM_HURST_MIN) / (SCENE_ROW_EXPONENTS - 1);
        fbm_row_table_make(hurst, low + back, high + back, step == 0 && shape->halvings == 2, &chain->place_rows[k]);
    }
    chain->placed = chain->mapped = true;
    /* delta is over the geometric mean of a cell's sides, the noise is in units of the rows' spacing */
    chain->fall = shape->halvings + fbm_log2(shape->aspect) / 2;
    for (int l = 0; l <= SCENE_LEVEL_MAX; l++)
        chain->steps[l].amplitude = 1;
    return TL_OK;
}

void scene_planes_cut(const scene_planes *planes, fbm_window part, float *const out[SCENE_PLANES])
{
    const fbm_window *w = &planes->window;
    for (int p = 0; p < SCENE_PLANES; p++)
        for (size_t row = 0; out[p] && row < part.height; row++) {
            assert(part.i >= w->i && part.j >= w->j && part.width <= w->width && part.height <= w->height);
            memcpy(out[p] + row * part.width,
                   planes->of[p] + ((size_t)(part.j - w->j) + row) * w->width + (size_t)(part.i - w->i),
                   part.width * sizeof *out[p]);
        }
}

const fbm_scheme *scene_scheme(const char *name, tl_error *error)
{
    if (name && !strcmp(name, SCENE_EXACT)) {
        tl_fail(error, TL_ERROR_ARGUMENT,
                "scheme 'exact': makes whole surfaces, which do not go on from an elevation model; take 'stationary'");
        return NULL;
    }
    const fbm_scheme *scheme = name ? fbm_scheme_find(name) : &fbm_schemes[0];
    if (!scheme)
        tl_fail(error, TL_ERROR_ARGUMENT, "scheme '%s': there is none of this name", name);
    return scheme;
}

static const char exact_summary[] = "Stein's exact generator, whole and in memory: the reference";

enum { SCHEMES_MAX = 16 };

static tl_scheme schemes[SCHEMES_MAX];

static void list_schemes(void)
{
    schemes[0] = (tl_scheme){
        .name = SCENE_TERRAIN, .summary = "detail shaped by the place, as real terrain has it", .field = true};
    size_t count = 1;
    for (size_t i = 0; fbm_schemes[i].name; i++) {
        assert(count + 2 < SCHEMES_MAX);
        schemes[count++] =
            (tl_scheme){.name = fbm_schemes[i].name, .summary = fbm_schemes[i].summary, .noise = true, .field = true};
    }
    schemes[count] = (tl_scheme){.name = SCENE_EXACT, .summary = exact_summary, .noise = true};
}

const tl_scheme *tl_schemes(void)
{
    static pthread_once_t once = PTHREAD_ONCE_INIT;
    pthread_once(&once, list_schemes);
    return schemes;
}
