/* How a chain of refinement follows the shape of a raster's cells: see fbm/aspect.h. */
#include "fbm/elementary.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/scene/chain.h"

#include <math.h>

static const double widest = 1 / FBM_ASPECT_MIN;

/* Cells this near to squares are squares: the structure function is off by no more than this share. */
static const double square_enough = 1e-4;

/* ---- Steps ------------------------------------------------------------------------------------- */

static bool is_stretched(const fbm_scheme *scheme)
{
    return scheme->values == fbm_values_stationary;
}

/* Weights of level l at the shape's aspects, one or a table. */
static void set_weights(scene_chain *chain, int l, const double *hursts)
{
    const scene_shape *shape = &chain->shape;
    fbm_step *step = &chain->steps[l];
    if (chain->tables) {
        if (l > 0 && hursts[l] == hursts[l - 1])
            chain->tables[l] = chain->tables[l - 1];
        else
            fbm_aspect_table_make(step->scheme->values, hursts[l], shape->low, shape->high, &chain->tables[l]);
        return;
    }
    double aspect = ldexp(shape->aspect, shape->halvings), values[FBM_WEIGHT_VALUES];
    if (l > 0 && hursts[l] == hursts[l - 1])
        step->weights = chain->steps[l - 1].weights;
    else if (aspect == 1)
        step->scheme->weights(hursts[l], &step->weights);
    else {
        step->scheme->values(hursts[l], aspect, values);
        fbm_weights_round(values, &step->weights);
    }
}

static void set_row_step(scene_chain *chain, int k, double hurst, double amplitude)
{
    const scene_shape *shape = &chain->shape;
    const fbm_step *first = &chain->steps[0];
    fbm_row_step *step = &chain->row_steps[k];
    bool wide = k == 0 && shape->halvings == 2;
    *step =
        (fbm_row_step){.amplitude = (float)amplitude, .seed = first->seed, .level = -1 - k, .period = first->period};
    if (chain->row_tables) {
        double low = shape->low - shape->halvings + k, high = shape->high - shape->halvings + k;
        fbm_row_table_make(hurst, low, high, wide, &chain->row_tables[k]);
        return;
    }
    double values[FBM_ROW_VALUES];
    fbm_values_rows(hurst, ldexp(shape->aspect, k), wide, values);
    fbm_row_weights_round(values, &step->weights);
}

/* Noise is in units of the rows' spacing: of delta, which is over the geometric mean of a cell's sides, the share
 * (rows' spacing / that mean)^H. */
static void set_steps(scene_chain *chain, const double *hursts, int levels)
{
    const scene_shape *shape = &chain->shape;
    double unit = 1 / sqrt(shape->aspect), delta = (double)chain->steps[0].amplitude;
    for (int l = 0; l <= levels; l++) {
        set_weights(chain, l, hursts);
        double share = fbm_pow(ldexp(unit, -shape->halvings), hursts[l]);
        chain->steps[l].amplitude = (float)((double)chain->steps[l].amplitude * share);
    }
    for (int k = 0; k < shape->halvings; k++)
        set_row_step(chain, k, hursts[0], delta * fbm_pow(ldexp(unit, -k), hursts[0]));
}

/* ---- Shapes ------------------------------------------------------------------------------------ */

/* Width over height of a degree's square at a latitude: N cos(lat) / M, with the ellipsoid's radii of curvature. */
static double degree_aspect(double latitude, double flattening)
{
    enum { BITS = 40 };
    latitude = fmin(fmax(latitude, -90), 90);
    double cosine, sine, square = flattening * (2 - flattening);
    fbm_turn((size_t)floor(ldexp(fabs(latitude) / 360, BITS) + .5), (size_t)1 << BITS, &cosine, &sine);
    return fmax(cosine, 0) * (1 - square * sine * sine) / (1 - square);
}

/* Whether rows are parallels, so that the aspect goes with them. */
static bool follows_rows(const tl_source_info *raster)
{
    const tl_georef *g = &raster->georef;
    return g->located && g->crs && g->crs->geographic && g->transform[2] == 0 && g->transform[4] == 0;
}

static double row_aspect(const tl_source_info *raster, int64_t row)
{
    const tl_georef *g = &raster->georef;
    const double *t = g->transform;
    return fabs(t[1] / t[5]) * degree_aspect(t[3] + t[5] * (double)row, g->crs->flattening);
}

static double middle_aspect(const tl_source_info *raster)
{
    const tl_georef *g = &raster->georef;
    return g->cell_x > 0 && g->cell_y > 0 ? g->cell_x / g->cell_y : 1;
}

static double limited(double aspect)
{
    return fmin(fmax(aspect, FBM_ASPECT_MIN), widest);
}

static tl_status refuse(const tl_source_info *raster, const char *scheme, double aspect, tl_error *error)
{
    return tl_fail(
        error, TL_ERROR_ARGUMENT,
        "%s: cells %.3g times as wide as high are beyond what scheme '%s' can keep isotropic (%g to %g): take a "
        "part of it by --bbox, or reproject it",
        raster->name, aspect, scheme, FBM_ASPECT_MIN, widest);
}

/* log2 of the aspect of every row. */
static tl_status measure_rows(scene_chain *chain, const tl_source_info *raster, bool strict, tl_error *error)
{
    scene_shape *shape = &chain->shape;
    double *logs = tl_alloc((size_t)raster->height, sizeof *logs);
    if (!logs)
        return tl_fail_memory(error, raster->name);
    shape->log_aspects = logs;
    shape->rows = raster->height;
    shape->low = (double)INFINITY;
    shape->high = -(double)INFINITY;
    for (int64_t row = 0; row < raster->height; row++) {
        double aspect = row_aspect(raster, row);
        if (strict && aspect != limited(aspect))
            return refuse(raster, chain->steps[0].scheme->name, aspect, error);
        logs[row] = fbm_log2(limited(aspect));
        shape->low = fmin(shape->low, logs[row]);
        shape->high = fmax(shape->high, logs[row]);
    }
    return TL_OK;
}

/* One aspect for all rows: turned where cells are wider than high by more than a factor of sqrt 2. */
static void take_one_aspect(scene_chain *chain, double aspect)
{
    scene_shape *shape = &chain->shape;
    free(shape->log_aspects);
    bool stretched = is_stretched(chain->steps[0].scheme);
    *shape = (scene_shape){.aspect = fabs(aspect - 1) <= square_enough ? 1 : aspect};
    shape->turned = stretched && fbm_aspect_halvings(1 / aspect) > 0;
    if (shape->turned)
        shape->aspect = 1 / aspect;
    if (stretched)
        shape->halvings = fbm_aspect_halvings(shape->aspect);
}

/* Tables for weights that follow the rows: the range of aspects is that after the halvings. */
static tl_status follow_rows(scene_chain *chain, const char *name, tl_error *error)
{
    scene_shape *shape = &chain->shape;
    double middle = fbm_exp2((shape->low + shape->high) / 2);
    shape->aspect = middle;
    shape->halvings = is_stretched(chain->steps[0].scheme) ? fbm_aspect_halvings(middle) : 0;
    for (int64_t row = 0; row < shape->rows; row++)
        shape->log_aspects[row] += shape->halvings;
    shape->low += shape->halvings;
    shape->high += shape->halvings;
    chain->tables = tl_alloc(SCENE_LEVEL_MAX + 1, sizeof *chain->tables);
    chain->row_tables = tl_alloc(2, sizeof *chain->row_tables);
    return chain->tables && chain->row_tables ? TL_OK : tl_fail_memory(error, name);
}

void scene_chain_fit_aspect(scene_chain *chain, double aspect, const double *hursts, int levels)
{
    take_one_aspect(chain, limited(aspect));
    set_steps(chain, hursts, levels);
}

tl_status scene_chain_fit(scene_chain *chain, const tl_source_info *raster, const double *hursts, int levels,
                          bool strict, tl_error *error)
{
    double middle = middle_aspect(raster);
    strict = strict && is_stretched(chain->steps[0].scheme);
    bool wide = fbm_aspect_halvings(1 / middle) > 0; /* turned: rows are then columns, and one aspect must do */
    if (strict && (middle != limited(middle) || (wide && raster->wraps)))
        return refuse(raster, chain->steps[0].scheme->name, middle, error);
    tl_status status = TL_OK;
    if (follows_rows(raster) && !wide) {
        status = measure_rows(chain, raster, strict, error);
        if (status == TL_OK && chain->shape.high - chain->shape.low > square_enough)
            status = follow_rows(chain, raster->name, error);
        else if (status == TL_OK)
            take_one_aspect(chain, fbm_exp2(chain->shape.low));
    } else {
        take_one_aspect(chain, wide && raster->wraps ? 1 : limited(middle));
    }
    if (status == TL_OK)
        set_steps(chain, hursts, levels);
    return status;
}

void scene_chain_finish(scene_chain *chain)
{
    free(chain->shape.log_aspects);
    free(chain->tables);
    free(chain->row_tables);
    free(chain->place_values);
    free(chain->place_rows);
}
