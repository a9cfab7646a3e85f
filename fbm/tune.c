#include "fbm/tune.h"

#include "fbm/aspect.h"
#include "fbm/covariance.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

/* What is measured: lags are held out beyond 8. */
enum { FREE = 6, LEVELS = 3, CELLS = 4, LAGS = 8, MOST_LEVELS = 4, MOST_CELLS = 4 };

/* ---- Rows and their free coefficients ---- */

/* Free are w[1 ... 3] and t; w[0] makes the predictor's sum 1. */
static fbm_table_row row_of(double hurst, const double *x)
{
    fbm_table_row row = {hurst, {0, x[0], x[1], x[2]}, {x[3], x[4], x[5]}};
    row.w[0] = (1 - 8 * x[0] - 4 * x[1] - 8 * x[2]) / 4;
    return row;
}

static void start(double hurst, double *x)
{
    double values[FBM_WEIGHT_VALUES];
    fbm_values_kriging(hurst, 1, values);
    const double first[FREE] = {values[1], values[3], values[4], values[6], values[7], values[9]};
    memcpy(x, first, sizeof first);
}

/* ---- Deviations ---- */

/* Increments come as multiples 1 ... LAGS (and more) of eight directions. */
static bool is_tuned(int dx, int dy)
{
    int a = abs(dx), b = abs(dy);
    while (b) {
        int rest = a % b;
        a = b, b = rest;
    }
    return a <= LAGS;
}

typedef struct deviations {
    size_t count;
    double *values;
} deviations;

static void collect(void *context, int dx, int dy, int x, int y, double relative)
{
    deviations *to = context;
    (void)x;
    (void)y;
    (void)dx;
    (void)dy;
    to->values[to->count++] = relative - 1;
}

typedef struct descent {
    double hurst;
    int levels, cells;
    int power;
    double x[FREE];
    double scale; /* of deviations, so that their powers neither vanish nor overflow */
    deviations now, other;
    double *slopes; /* [FREE][room] */
    size_t room;
} descent;

static fbm_refinement refinement_of(const fbm_table_row *row, fbm_weights *weights)
{
    fbm_weights_of_row(row, weights);
    return (fbm_refinement){.scheme = fbm_schemes, .hurst = row->hurst, .aspect = 1, .weights = weights};
}

static fbm_status evaluate(const descent *d, const double *x, deviations *out)
{
    fbm_weights weights;
    fbm_table_row row = row_of(d->hurst, x);
    fbm_refinement r = refinement_of(&row, &weights);
    out->count = 0;
    return fbm_refinement_increments(&r, d->levels, d->cells, collect, out);
}

/* ---- Descent ---- */

static double objective(const descent *d, const deviations *of)
{
    double sum = 0;
    for (size_t k = 0; k < of->count; k++)
        sum += pow(fabs(of->values[k]) / d->scale, d->power);
    return sum;
}

/* Coefficients are floats where they are used: steps of 2^-10 drown their rounding, and the deviations are nearly
 * quadratic in them. */
static fbm_status find_slopes(descent *d)
{
    const double h = 0x1p-10;
    for (int i = 0; i < FREE; i++) {
        double x[FREE];
        memcpy(x, d->x, sizeof x);
        for (int side = 0; side < 2; side++) {
            x[i] = d->x[i] + (side ? -h : h);
            fbm_status status = evaluate(d, x, &d->other);
            if (status != FBM_OK)
                return status;
            for (size_t k = 0; k < d->other.count; k++)
                d->slopes[(size_t)i * d->room + k] =
                    side ? (d->slopes[(size_t)i * d->room + k] - d->other.values[k]) / (2 * h) : d->other.values[k];
        }
    }
    return FBM_OK;
}

/* Solves a symmetric positive definite system by Cholesky's factors. */
static bool solve(double a[FREE][FREE], double *b)
{
    for (int j = 0; j < FREE; j++) {
        for (int k = 0; k < j; k++)
            a[j][j] -= a[j][k] * a[j][k];
        if (!(a[j][j] > 0))
            return false;
        a[j][j] = sqrt(a[j][j]);
        for (int i = j + 1; i < FREE; i++) {
            for (int k = 0; k < j; k++)
                a[i][j] -= a[i][k] * a[j][k];
            a[i][j] /= a[j][j];
        }
    }
    for (int i = 0; i < FREE; i++) {
        for (int k = 0; k < i; k++)
            b[i] -= a[i][k] * b[k];
        b[i] /= a[i][i];
    }
    for (int i = FREE - 1; i >= 0; i--) {
        for (int k = i + 1; k < FREE; k++)
            b[i] -= a[k][i] * b[k];
        b[i] /= a[i][i];
    }
    return true;
}

/* Gauss and Newton's system of the sum of powers, with deviations weighted by |r|^(p-2). */
static void set_up(const descent *d, double normal[FREE][FREE], double *right)
{
    memset(normal, 0, FREE * sizeof *normal);
    memset(right, 0, FREE * sizeof *right);
    for (size_t k = 0; k < d->now.count; k++) {
        double r = d->now.values[k], weight = pow(fabs(r) / d->scale, d->power - 2);
        for (int i = 0; i < FREE; i++) {
            double slope = d->slopes[(size_t)i * d->room + k];
            right[i] -= weight * slope * r;
            for (int j = 0; j <= i; j++)
                normal[i][j] += weight * slope * d->slopes[(size_t)j * d->room + k];
        }
    }
}

/* One step, damped until it goes down. *moved: whether it did, by more than a part in 10^6. */
static fbm_status step_down(descent *d, double *damping, bool *moved)
{
    double normal[FREE][FREE], right[FREE], before = objective(d, &d->now);
    *moved = false;
    fbm_status status = find_slopes(d);
    if (status != FBM_OK)
        return status;
    set_up(d, normal, right);
    for (int tries = 0; tries < 12; tries++, *damping *= 8) {
        double system[FREE][FREE], step[FREE], x[FREE];
        memcpy(system, normal, sizeof system);
        memcpy(step, right, sizeof step);
        for (int i = 0; i < FREE; i++)
            system[i][i] += *damping * normal[i][i];
        if (!solve(system, step))
            continue;
        for (int i = 0; i < FREE; i++)
            x[i] = d->x[i] + step[i] / (d->power - 1);
        status = evaluate(d, x, &d->other);
        if (status != FBM_OK)
            return status;
        double after = objective(d, &d->other);
        if (!(after < before))
            continue;
        deviations swap = d->now;
        d->now = d->other;
        d->other = swap;
        memcpy(d->x, x, sizeof x);
        *moved = after < before * (1 - 1e-6);
        *damping /= 8;
        return FBM_OK;
    }
    return FBM_OK;
}

static fbm_status descend(descent *d)
{
    fbm_status status = evaluate(d, d->x, &d->now);
    for (d->power = 2; status == FBM_OK && d->power <= 16; d->power *= 2) {
        double damping = 1e-3;
        bool moved = true;
        d->scale = 1e-12;
        for (size_t k = 0; k < d->now.count; k++)
            d->scale = fmax(d->scale, fabs(d->now.values[k]));
        for (int round = 0; round < 8 && moved && status == FBM_OK; round++)
            status = step_down(d, &damping, &moved);
    }
    return status;
}

fbm_status fbm_tune(double hurst, int levels, int cells, fbm_table_row *out)
{
    if (levels < 1 || levels > MOST_LEVELS || cells < 1 || cells > MOST_CELLS)
        return FBM_TOO_LARGE;
    size_t side = ((size_t)cells << levels) + 1, lags = side < 8 ? 1 : side / 4;
    descent d = {.hurst = fbm_hurst_clamp(hurst), .levels = levels, .cells = cells, .room = 8 * lags * side * side};
    d.now.values = malloc(d.room * sizeof *d.now.values);
    d.other.values = malloc(d.room * sizeof *d.other.values);
    d.slopes = malloc(FREE * d.room * sizeof *d.slopes);
    fbm_status status = FBM_NO_MEMORY;
    if (d.now.values && d.other.values && d.slopes) {
        start(d.hurst, d.x);
        status = descend(&d);
    }
    if (status == FBM_OK)
        *out = row_of(d.hurst, d.x);
    free(d.now.values);
    free(d.other.values);
    free(d.slopes);
    return status;
}

/* ---- Measuring ---- */

typedef struct worst {
    bool tuned;
    double value;
} worst;

static void note_worst(void *context, int dx, int dy, int x, int y, double relative)
{
    worst *to = context;
    (void)x;
    (void)y;
    if (is_tuned(dx, dy) == to->tuned)
        to->value = fmax(to->value, fabs(relative - 1));
}

fbm_status fbm_tune_measure(const fbm_table_row *row, fbm_tuning *out)
{
    fbm_weights weights;
    fbm_refinement r = refinement_of(row, &weights);
    worst tuned = {.tuned = true}, held_out = {.tuned = false};
    fbm_status status = fbm_refinement_increments(&r, LEVELS, CELLS, note_worst, &tuned);
    if (status == FBM_OK)
        status = fbm_refinement_increments(&r, LEVELS + 1, CELLS, note_worst, &held_out);
    *out = (fbm_tuning){tuned.value, held_out.value};
    return status;
}
