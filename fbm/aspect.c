#include "fbm/aspect.h"

#include "fbm/elementary.h"

#include <math.h>
#include <string.h>

enum { ORBITS = 8, POINTS = 27, TAPS = 7, TAP_POINTS = 17, LAGS = 48, PERIOD = 24 };

/* Offsets in half cells: columns, rows. */
typedef struct offset {
    int x, y;
} offset;

/* A stencil: the first offset of each orbit, the others by mirrors. */
typedef struct stencil {
    int orbits, taps;
    offset w[ORBITS], t[TAPS];
} stencil;

static const stencil centre_stencil = {
    6, 4, {{1, 1}, {3, 1}, {1, 3}, {3, 3}, {5, 1}, {1, 5}}, {{0, 0}, {2, 0}, {0, 2}, {2, 2}}};
static const stencil edge_stencil = {
    8, 4, {{1, 0}, {0, 1}, {1, 2}, {2, 1}, {0, 3}, {3, 0}, {2, 3}, {3, 2}}, {{0, 0}, {1, 1}, {2, 0}, {0, 2}}};
static const stencil row_stencil = {7,
                                    7,
                                    {{0, 1}, {2, 1}, {4, 1}, {6, 1}, {0, 3}, {2, 3}, {4, 3}},
                                    {{0, 0}, {2, 0}, {4, 0}, {0, 2}, {2, 2}, {4, 2}, {6, 0}}};

static int mirror_images(offset o, offset out[4])
{
    int count = 0;
    for (int sy = 1; sy >= (o.y ? -1 : 1); sy -= 2)
        for (int sx = 1; sx >= (o.x ? -1 : 1); sx -= 2)
            out[count++] = (offset){sx * o.x, sy * o.y};
    return count;
}

/* ---- Kriging ----------------------------------------------------------------------------------- */

typedef struct model {
    double hurst, aspect;
} model;

static double covariance(const model *m, offset a, offset b)
{
    double dx = .5 * m->aspect * (a.x - b.x), dy = .5 * (a.y - b.y), square = dx * dx + dy * dy;
    return square > 0 ? -.5 * (fbm_pow(square, m->hurst) - square) / (1 - m->hurst) : 0;
}

/* Solves the n x n system in the first n columns of rows that hold the right side behind them. */
static void solve(int n, double rows[][ORBITS + 2], double *x)
{
    for (int k = 0; k < n; k++) {
        int pivot = k;
        for (int r = k + 1; r < n; r++)
            if (fabs(rows[r][k]) > fabs(rows[pivot][k]))
                pivot = r;
        for (int c = 0; c <= n; c++) {
            double value = rows[k][c];
            rows[k][c] = rows[pivot][c];
            rows[pivot][c] = value;
        }
        for (int r = k + 1; r < n; r++) {
            double factor = rows[r][k] / rows[k][k];
            for (int c = k; c <= n; c++)
                rows[r][c] -= factor * rows[k][c];
        }
    }
    for (int k = n - 1; k >= 0; k--) {
        x[k] = rows[k][n];
        for (int c = k + 1; c < n; c++)
            x[k] -= rows[k][c] * x[c];
        x[k] /= rows[k][k];
    }
}

/* Weights of the orbits, with the sum 1 over all points. */
static void krige(const model *m, const stencil *s, double *w)
{
    double rows[ORBITS + 1][ORBITS + 2] = {{0}}, x[ORBITS + 1];
    int n = s->orbits;
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            offset points[4];
            int count = mirror_images(s->w[j], points);
            for (int p = 0; p < count; p++)
                rows[i][j] += covariance(m, s->w[i], points[p]);
            rows[n][j] = count;
        }
        rows[i][n] = 1;
        rows[i][n + 1] = covariance(m, s->w[i], (offset){0, 0});
    }
    rows[n][n + 1] = 1;
    solve(n + 1, rows, x);
    memcpy(w, x, (size_t)n * sizeof *w);
}

/* ---- The residual's filter --------------------------------------------------------------------- */

/* What is sought: taps whose autocovariance is that of the prediction's residual. */
typedef struct fit {
    int taps, lags;
    offset lag[LAGS]; /* of one quadrant */
    double multiplicity[LAGS], target[LAGS];
    double pairs[LAGS][TAPS][TAPS]; /* of points of two orbits at this lag */
} fit;

static int lag_index(fit *f, offset lag)
{
    int k = 0;
    while (k < f->lags && (f->lag[k].x != lag.x || f->lag[k].y != lag.y))
        k++;
    if (k == f->lags) {
        f->lag[f->lags++] = lag;
        f->multiplicity[k] = (lag.x ? 2 : 1) * (lag.y ? 2 : 1);
    }
    return k;
}

static void count_pairs(const stencil *s, fit *f)
{
    offset a[4], b[4];
    for (int i = 0; i < s->taps; i++)
        for (int j = 0; j < s->taps; j++) {
            int m = mirror_images(s->t[i], a), n = mirror_images(s->t[j], b);
            for (int p = 0; p < m; p++)
                for (int q = 0; q < n; q++) {
                    offset lag = {a[p].x - b[q].x, a[p].y - b[q].y};
                    if (lag.x >= 0 && lag.y >= 0)
                        f->pairs[lag_index(f, lag)][i][j]++;
                }
        }
}

static void residual_covariances(const model *m, const stencil *s, const double *w, fit *f)
{
    offset points[1 + POINTS] = {{0, 0}};
    double contrast[1 + POINTS] = {1};
    int count = 1;
    for (int i = 0; i < s->orbits; i++) {
        int more = mirror_images(s->w[i], points + count);
        for (int p = 0; p < more; p++)
            contrast[count + p] = -w[i];
        count += more;
    }
    for (int l = 0; l < f->lags; l++) {
        double sum = 0;
        for (int i = 0; i < count; i++)
            for (int j = 0; j < count; j++)
                sum += contrast[i] * contrast[j] *
                       covariance(m, (offset){points[i].x + f->lag[l].x, points[i].y + f->lag[l].y}, points[j]);
        f->target[l] = sum * (1 - m->hurst);
    }
}

static double cosine(int k)
{
    double c, s;
    fbm_turn((size_t)k, PERIOD, &c, &s);
    return c;
}

/* The symmetric filter whose spectrum is the root of the covariances': exact but for what lies beyond the taps. */
static void start_taps(const stencil *s, const fit *f, double *t)
{
    double turn[PERIOD];
    for (int k = 0; k < PERIOD; k++)
        turn[k] = cosine(k);
    for (int i = 0; i < s->taps; i++)
        t[i] = 0;
    for (int v = 0; v < PERIOD; v++)
        for (int u = 0; u < PERIOD; u++) {
            double power = 0;
            for (int l = 0; l < f->lags; l++)
                power +=
                    f->multiplicity[l] * f->target[l] * turn[u * f->lag[l].x % PERIOD] * turn[v * f->lag[l].y % PERIOD];
            double root = power > 0 ? sqrt(power) : 0;
            for (int i = 0; i < s->taps; i++)
                t[i] += root * turn[u * s->t[i].x % PERIOD] * turn[v * s->t[i].y % PERIOD] / (PERIOD * PERIOD);
        }
}

/* Sum of squares of what the autocovariance of `t` is off, weighted; its gradient's system unless NULL. */
static double misfit(const fit *f, const double *t, double normal[][ORBITS + 2])
{
    double sum = 0;
    for (int i = 0; normal && i < f->taps; i++)
        memset(normal[i], 0, sizeof normal[i]);
    for (int l = 0; l < f->lags; l++) {
        double found = -f->target[l], slope[TAPS], weight = f->multiplicity[l];
        if (!f->lag[l].x && !f->lag[l].y)
            weight *= 16;
        for (int i = 0; i < f->taps; i++) {
            double product = 0, mirrored = 0;
            for (int j = 0; j < f->taps; j++) {
                product += f->pairs[l][i][j] * t[j];
                mirrored += f->pairs[l][j][i] * t[j];
            }
            found += t[i] * product;
            slope[i] = product + mirrored;
        }
        sum += weight * found * found;
        for (int i = 0; normal && i < f->taps; i++) {
            for (int j = 0; j < f->taps; j++)
                normal[i][j] += weight * slope[i] * slope[j];
            normal[i][f->taps] -= weight * slope[i] * found;
        }
    }
    return sum;
}

/* Levenberg and Marquardt's descent. */
static void fit_taps(const fit *f, double *t)
{
    double damping = 1e-3, best = misfit(f, t, NULL);
    for (int round = 0; round < 60; round++) {
        double normal[TAPS][ORBITS + 2], step[TAPS], tried[TAPS];
        size_t size = (size_t)f->taps * sizeof *t;
        misfit(f, t, normal);
        for (int i = 0; i < f->taps; i++)
            normal[i][i] *= 1 + damping;
        solve(f->taps, normal, step);
        for (int i = 0; i < f->taps; i++)
            tried[i] = t[i] + step[i];
        double now = misfit(f, tried, NULL);
        damping = now < best ? damping / 8 : damping * 8;
        if (now < best) {
            best = now;
            memcpy(t, tried, size);
        }
    }
}

static void krige_with_taps(const model *m, const stencil *s, double *w, double *t)
{
    fit f = {.taps = s->taps};
    krige(m, s, w);
    count_pairs(s, &f);
    residual_covariances(m, s, w, &f);
    start_taps(s, &f, t);
    fit_taps(&f, t);
}

/* ---- Coefficients ------------------------------------------------------------------------------ */

int fbm_aspect_halvings(double aspect)
{
    int k = 0;
    for (; aspect < .70710678118654752440 && k < 8; k++)
        aspect *= 2;
    return k;
}

/* The two half steps, and where they are in the values. */
static const struct {
    const stencil *stencil;
    int w, t;
} half_steps[2] = {{&centre_stencil, 0, 6}, {&edge_stencil, 10, 18}};

void fbm_values_kriging(double hurst, double aspect, double values[FBM_WEIGHT_VALUES])
{
    model m = {fbm_hurst_clamp(hurst), aspect};
    for (int p = 0; p < 2; p++)
        krige_with_taps(&m, half_steps[p].stencil, values + half_steps[p].w, values + half_steps[p].t);
    values[22] = values[18];
}

void fbm_values_stationary(double hurst, double aspect, double values[FBM_WEIGHT_VALUES])
{
    fbm_values_table(hurst, values);
    if (aspect == 1)
        return;
    double here[FBM_WEIGHT_VALUES], square[FBM_WEIGHT_VALUES];
    fbm_values_kriging(hurst, aspect, here);
    fbm_values_kriging(hurst, 1, square);
    for (int p = 0; p < 2; p++) {
        int w = half_steps[p].w, t = half_steps[p].t;
        for (int k = w; k < w + half_steps[p].stencil->orbits; k++)
            values[k] += here[k] - square[k];
        for (int k = t; k < t + half_steps[p].stencil->taps; k++)
            values[k] = here[k] + (values[k] - square[k]) * here[t] / square[t];
    }
    values[22] = values[18];
}

void fbm_values_rows(double hurst, double aspect, bool wide, double values[FBM_ROW_VALUES])
{
    model m = {fbm_hurst_clamp(hurst), aspect};
    stencil s = row_stencil;
    s.taps = wide ? 7 : 6;
    values[13] = 0;
    krige_with_taps(&m, &s, values, values + 7);
}

void fbm_row_weights_round(const double values[FBM_ROW_VALUES], fbm_row_weights *out)
{
    static const double orbits[7] = {2, 4, 4, 4, 2, 4, 4};
    fbm_round_predictor(values, orbits, 7, out->w);
    for (int k = 0; k < 7; k++)
        out->taps[k] = (float)values[7 + k];
}

/* ---- Interpolation ----------------------------------------------------------------------------- */

static double node(double low, double step, int k)
{
    return fbm_exp2(low + step * k);
}

void fbm_aspect_table_make(void (*values)(double, double, double *), double hurst, double low, double high,
                           fbm_aspect_table *out)
{
    *out = (fbm_aspect_table){.low = low, .step = (high - low) / (FBM_ASPECT_NODES - 1)};
    for (int k = 0; k < (high > low ? FBM_ASPECT_NODES : 1); k++)
        values(hurst, node(low, out->step, k), out->weights[k]);
}

void fbm_row_table_make(double hurst, double low, double high, bool wide, fbm_row_table *out)
{
    *out = (fbm_row_table){.low = low, .step = (high - low) / (FBM_ASPECT_NODES - 1)};
    for (int k = 0; k < (high > low ? FBM_ASPECT_NODES : 1); k++)
        fbm_values_rows(hurst, node(low, out->step, k), wide, out->weights[k]);
}

/* Lagrange's polynomials of the nodes 0 ... 4 at x. */
static void lagrange(double x, double *out)
{
    for (int k = 0; k < FBM_ASPECT_NODES; k++) {
        out[k] = 1;
        for (int m = 0; m < FBM_ASPECT_NODES; m++)
            if (m != k)
                out[k] *= (x - m) / (k - m);
    }
}

static void interpolate(double low, double step, const double *nodes, int count, double at, double *out)
{
    double parts[FBM_ASPECT_NODES];
    lagrange(step > 0 ? (at - low) / step : 0, parts);
    for (int c = 0; c < count; c++) {
        out[c] = 0;
        for (int k = 0; k < FBM_ASPECT_NODES; k++)
            out[c] += parts[k] * nodes[k * count + c];
    }
}

void fbm_aspect_table_at(const fbm_aspect_table *table, double log_aspect, fbm_weights *out)
{
    double values[FBM_WEIGHT_VALUES];
    interpolate(table->low, table->step, table->weights[0], FBM_WEIGHT_VALUES, log_aspect, values);
    fbm_weights_round(values, out);
}

void fbm_row_table_at(const fbm_row_table *table, double log_aspect, fbm_row_weights *out)
{
    double values[FBM_ROW_VALUES];
    interpolate(table->low, table->step, table->weights[0], FBM_ROW_VALUES, log_aspect, values);
    fbm_row_weights_round(values, out);
}
