#include "fbm/weights.h"

#include "fbm/elementary.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

/* The tuned table, reference data of the project (weights24.csv): for each H the coefficients of the 24-point
 * predictor and of the 3 x 3 residual filter that bring the exactly propagated structure function of repeated
 * refinement closest to fBm's at all positions and lags. fbm/tune.h derives such rows again: `ninja weights-table`
 * prints them, and how good both are; doc/accuracy.md has the comparison. */
enum { KNOTS = 25, COLUMNS = 7 };

static const double table[KNOTS][1 + COLUMNS] = {
    /* H, w0 ... w3, t0 ... t2 */
    {0.01, 0.0118095959, 0.0344980304, 0.0233623129, 0.0729160152, 0.695579447, -0.00564104416, -0.00384819002},
    {0.02, 0.0354263263, 0.0316602013, 0.0225852437, 0.0643340137, 0.70459567, 0.00179706095, 0.00179938236},
    {0.03, 0.0552760928, 0.0305232117, 0.0216393753, 0.0560190543, 0.710650028, 0.00765468736, 0.00517344371},
    {0.05, 0.0866314323, 0.0308480976, 0.019615903, 0.0410282348, 0.716501369, 0.0158263895, 0.00854949424},
    {0.075, 0.114684905, 0.0333960126, 0.0167600163, 0.0258815266, 0.716810051, 0.0209344412, 0.0105104422},
    {0.1, 0.136518225, 0.0346980995, 0.0139146294, 0.0150854733, 0.712876369, 0.0231316702, 0.0108503223},
    {0.15, 0.169341284, 0.0342273317, 0.00855953593, 0.00182225843, 0.699019233, 0.0240817353, 0.00936379535},
    {0.2, 0.194366143, 0.0304523556, 0.00366151899, -0.00446618637, 0.680770028, 0.023247109, 0.00671588191},
    {0.25, 0.214799039, 0.0248136476, -0.000539558621, -0.00694338779, 0.659623525, 0.0217209604, 0.00407073073},
    {0.3, 0.231845279, 0.0185349017, -0.00374850454, -0.00758328876, 0.636190188, 0.0197974639, 0.00148488066},
    {0.35, 0.246606361, 0.0117636275, -0.00607052897, -0.00703154346, 0.610742211, 0.0178652442, -0.000618145069},
    {0.4, 0.259356691, 0.00530195067, -0.0084055832, -0.00577750438, 0.583502142, 0.0158616676, -0.00243497228},
    {0.45, 0.270498901, -0.00104548587, -0.00932698259, -0.00454047355, 0.554631743, 0.013805201, -0.00412669631},
    {0.5, 0.280323682, -0.00706950698, -0.00981654707, -0.00318406053, 0.524214693, 0.0117955833, -0.00560311792},
    {0.55, 0.289054178, -0.0128070918, -0.00970363348, -0.00186818026, 0.492276841, 0.00987237948, -0.00690016007},
    {0.6, 0.296777916, -0.0180069548, -0.00982720829, -0.000468398856, 0.458809772, 0.00795417983, -0.00796943918},
    {0.65, 0.30366306, -0.0228044165, -0.00981991689, 0.000882845126, 0.423709155, 0.00612274581, -0.0088109481},
    {0.7, 0.309836345, -0.0272975749, -0.00942985641, 0.00209433072, 0.386772251, 0.00444873412, -0.00944617645},
    {0.75, 0.315378546, -0.0314960562, -0.00868325786, 0.00314841204, 0.347655106, 0.00294795805, -0.00984050061},
    {0.8, 0.320399762, -0.0353465226, -0.00811694278, 0.00420511311, 0.305746678, 0.00162881798, -0.00981977421},
    {0.85, 0.324848854, -0.0387914456, -0.00759442612, 0.00516423168, 0.26001132, 0.000498337426, -0.00942121777},
    {0.9, 0.328845038, -0.0419133416, -0.00712976567, 0.00605570567, 0.208163271, -0.000348471709, -0.00842722887},
    {0.95, 0.33254289, -0.0452423523, -0.00490020358, 0.00642100909, 0.144081023, -0.00067627036, -0.00660863531},
    {0.98, 0.334706053, -0.0465899479, -0.00648945231, 0.00748164745, 0.0898955377, -0.000632534236, -0.00419066415},
    {0.99, 0.335262625, -0.0471377709, -0.00589762418, 0.00745527055, 0.0632748394, -0.000501610883, -0.00305178856},
};

double fbm_hurst_clamp(double hurst)
{
    if (!(hurst > FBM_HURST_MIN))
        return FBM_HURST_MIN;
    return hurst < FBM_HURST_MAX ? hurst : FBM_HURST_MAX;
}

/* ---- Splines ----------------------------------------------------------------------------------- */

/* Residual filters vanish like sqrt(1 - H) at H = 1, which no cubic follows; without this factor they are smooth. */
static double knot_value(int knot, int column)
{
    double value = table[knot][1 + column];
    return column < 4 ? value : value / sqrt(1 - table[knot][0]);
}

/* Second derivatives m of the not-a-knot spline through (x, y): continuity of the slope at the inner knots,
 *   h[k-1] m[k-1] + 2 (h[k-1] + h[k]) m[k] + h[k] m[k+1] = 6 (slope[k] - slope[k-1]),
 * and of the third derivative at the first and last of them, which gives m[0] and m[KNOTS - 1]. */
static void spline_curvatures(const double *x, const double *y, double *m)
{
    enum { N = KNOTS - 1 };
    double diagonal[N], upper[N], right[N];
    for (int k = 1; k < N; k++) {
        double before = x[k] - x[k - 1], after = x[k + 1] - x[k], lower = before;
        diagonal[k] = 2 * (before + after);
        upper[k] = after;
        right[k] = 6 * ((y[k + 1] - y[k]) / after - (y[k] - y[k - 1]) / before);
        if (k == 1) {
            diagonal[k] += before * (1 + before / after);
            upper[k] -= before * before / after;
            continue;
        }
        if (k == N - 1) {
            diagonal[k] += after * (1 + after / before);
            lower -= after * after / before;
        }
        double factor = lower / diagonal[k - 1];
        diagonal[k] -= factor * upper[k - 1];
        right[k] -= factor * right[k - 1];
    }
    m[N - 1] = right[N - 1] / diagonal[N - 1];
    for (int k = N - 2; k >= 1; k--)
        m[k] = (right[k] - upper[k] * m[k + 1]) / diagonal[k];
    m[0] = m[1] + (m[1] - m[2]) * (x[1] - x[0]) / (x[2] - x[1]);
    m[N] = m[N - 1] + (m[N - 1] - m[N - 2]) * (x[N] - x[N - 1]) / (x[N - 1] - x[N - 2]);
}

/* Column `column` of the table at `hurst`, exact at the knots. */
static double interpolate(int column, double hurst)
{
    double x[KNOTS], y[KNOTS], m[KNOTS];
    for (int k = 0; k < KNOTS; k++) {
        x[k] = table[k][0];
        y[k] = knot_value(k, column);
        if (hurst == x[k])
            return table[k][1 + column];
    }
    spline_curvatures(x, y, m);
    int k = 0;
    while (k < KNOTS - 2 && hurst > x[k + 1])
        k++;
    double h = x[k + 1] - x[k], a = (x[k + 1] - hurst) / h, b = 1 - a;
    double value = a * y[k] + b * y[k + 1] + ((a * a * a - a) * m[k] + (b * b * b - b) * m[k + 1]) * h * h / 6;
    return column < 4 ? value : value * sqrt(1 - hurst);
}

/* ---- Rounding ---------------------------------------------------------------------------------- */

/* Points in each orbit of the predictors. */
static const double centre_orbits[6] = {4, 4, 4, 4, 4, 4}, edge_orbits[8] = {2, 2, 4, 4, 2, 2, 4, 4};

void fbm_round_predictor(const double *w, const double *orbits, size_t count, float *out)
{
    size_t least = 0;
    for (size_t k = 1; k < count; k++)
        if (fabs(w[k]) < fabs(w[least]))
            least = k;
    double rest = 1;
    for (size_t k = 0; k < count; k++) {
        out[k] = (float)w[k];
        if (k != least)
            rest -= orbits[k] * (double)out[k];
    }
    out[least] = (float)(rest / orbits[least]);
}

static void round_taps(const double *values, size_t count, float *out)
{
    for (size_t k = 0; k < count; k++)
        out[k] = (float)values[k];
}

void fbm_weights_round(const double values[FBM_WEIGHT_VALUES], fbm_weights *out)
{
    fbm_round_predictor(values, centre_orbits, 6, out->centre);
    round_taps(values + 6, 4, out->centre_taps);
    fbm_round_predictor(values + 10, edge_orbits, 8, out->edge);
    round_taps(values + 18, 4, out->edge_taps);
    out->column_tap = (float)values[22];
}

/* ---- Schemes ----------------------------------------------------------------------------------- */

/* Coefficients of the square's symmetry {w0 ... w3; t0 ... t2} as those of the rectangle's; edges see the centres'
 * picture turned by 45 degrees, where axes and diagonals change places. */
void fbm_values_of_row(const fbm_table_row *row, double values[FBM_WEIGHT_VALUES])
{
    const double *w = row->w, *t = row->t, turn = fbm_exp2(-row->hurst / 2);
    const double all[FBM_WEIGHT_VALUES] = {
        w[0], w[1], w[1], w[2], w[3], w[3], t[0],        t[1],        t[1],        t[2],        w[0],       w[0],
        w[1], w[1], w[2], w[2], w[3], w[3], turn * t[0], turn * t[1], turn * t[2], turn * t[2], turn * t[0]};
    for (int k = 0; k < FBM_WEIGHT_VALUES; k++)
        values[k] = all[k];
}

bool fbm_table_row_at(int knot, fbm_table_row *out)
{
    if (knot < 0 || knot >= KNOTS)
        return false;
    const double *row = table[knot];
    *out = (fbm_table_row){row[0], {row[1], row[2], row[3], row[4]}, {row[5], row[6], row[7]}};
    return true;
}

static fbm_table_row row_between(double hurst)
{
    fbm_table_row row = {.hurst = fbm_hurst_clamp(hurst)};
    for (int k = 0; k < 4; k++)
        row.w[k] = interpolate(k, row.hurst);
    for (int k = 0; k < 3; k++)
        row.t[k] = interpolate(4 + k, row.hurst);
    return row;
}

void fbm_values_table(double hurst, double values[FBM_WEIGHT_VALUES])
{
    fbm_table_row row = row_between(hurst);
    fbm_values_of_row(&row, values);
}

/* Orbits of the square's symmetry keep their equality when they are rounded: what the others' rounding costs goes to
 * the orbit that weighs least, whose own rounding is the smallest. Else every level would shift a plateau at 4,000 m by
 * up to a millimetre. */
void fbm_weights_of_row(const fbm_table_row *row, fbm_weights *out)
{
    static const double orbits[4] = {4, 8, 4, 8};
    double values[FBM_WEIGHT_VALUES];
    float w[4];
    fbm_values_of_row(row, values);
    fbm_round_predictor((const double[]){values[0], values[1], values[3], values[4]}, orbits, 4, w);
    fbm_weights_round(values, out);
    const float centre[6] = {w[0], w[1], w[1], w[2], w[3], w[3]};
    const float edge[8] = {w[0], w[0], w[1], w[1], w[2], w[2], w[3], w[3]};
    memcpy(out->centre, centre, sizeof centre);
    memcpy(out->edge, edge, sizeof edge);
}

void fbm_weights_stationary(double hurst, fbm_weights *out)
{
    fbm_table_row row = row_between(hurst);
    fbm_weights_of_row(&row, out);
}

/* h^(2H) of a distance, by its square. */
static double power(double x, double y, double hurst)
{
    return fbm_pow(x * x + y * y, hurst);
}

/* Standard deviation of fBm at 0 about the weighted mean of `count` points. */
static double residual_of_mean(const double (*points)[2], const double *w, size_t count, double hurst)
{
    double variance = 0;
    for (size_t i = 0; i < count; i++) {
        variance += w[i] * power(points[i][0], points[i][1], hurst);
        for (size_t j = 0; j < count; j++)
            variance -= w[i] * w[j] / 2 * power(points[i][0] - points[j][0], points[i][1] - points[j][1], hurst);
    }
    return sqrt(variance);
}

static const double quarters[4] = {.25, .25, .25, .25};

static double corners_residual(double hurst, double aspect)
{
    double x = aspect / 2;
    const double corners[4][2] = {{-x, -.5}, {x, -.5}, {-x, .5}, {x, .5}};
    return residual_of_mean(corners, quarters, 4, hurst);
}

static void clear(double *values)
{
    for (int k = 0; k < FBM_WEIGHT_VALUES; k++)
        values[k] = 0;
    values[0] = .25;
}

void fbm_values_square(double hurst, double aspect, double values[FBM_WEIGHT_VALUES])
{
    hurst = fbm_hurst_clamp(hurst);
    double edge = sqrt(fbm_exp2(-2 * hurst) - .25);
    clear(values);
    values[10] = .5; /* not used: see the kernels of means */
    values[6] = corners_residual(hurst, aspect);
    values[18] = edge * fbm_pow(aspect, hurst);
    values[22] = edge;
}

void fbm_values_diamond(double hurst, double aspect, double values[FBM_WEIGHT_VALUES])
{
    hurst = fbm_hurst_clamp(hurst);
    double x = aspect / 2;
    const double ends[4][2] = {{-x, 0}, {x, 0}, {0, -.5}, {0, .5}};
    clear(values);
    values[10] = values[11] = .25;
    values[6] = corners_residual(hurst, aspect);
    values[18] = values[22] = residual_of_mean(ends, quarters, 4, hurst);
}

void fbm_values_children(double hurst, double aspect, double values[FBM_WEIGHT_VALUES])
{
    static const double w[4] = {9 / 16., 3 / 16., 3 / 16., 1 / 16.};
    hurst = fbm_hurst_clamp(hurst);
    double x = aspect / 4;
    const double cells[4][2] = {{-x, -.25}, {3 * x, -.25}, {-x, .75}, {3 * x, .75}};
    clear(values);
    values[10] = .5;
    values[6] = values[18] = values[22] = residual_of_mean(cells, w, 4, hurst);
}

void fbm_weights_square(double hurst, fbm_weights *out)
{
    hurst = fbm_hurst_clamp(hurst);
    double grow = fbm_exp2(hurst);
    *out = (fbm_weights){.centre = {0.25F}, .edge = {0.5F}};
    out->centre_taps[0] = (float)sqrt(1 / grow - 0.25 - grow / 8);
    out->edge_taps[0] = out->column_tap = (float)sqrt(1 / (grow * grow) - 0.25);
}

void fbm_weights_diamond(double hurst, fbm_weights *out)
{
    double values[FBM_WEIGHT_VALUES];
    fbm_values_diamond(hurst, 1, values);
    fbm_weights_round(values, out);
}

void fbm_weights_children(double hurst, fbm_weights *out)
{
    double values[FBM_WEIGHT_VALUES];
    fbm_values_children(hurst, 1, values);
    fbm_weights_round(values, out);
}

void fbm_weights_residual(const fbm_weights *weights, double *centre, double *edge)
{
    static const double centre_counts[4] = {1, 2, 2, 4}, edge_counts[4] = {1, 4, 2, 2};
    double sums[2] = {0};
    for (int k = 0; k < 4; k++) {
        sums[0] += centre_counts[k] * (double)weights->centre_taps[k] * (double)weights->centre_taps[k];
        sums[1] += edge_counts[k] * (double)weights->edge_taps[k] * (double)weights->edge_taps[k];
    }
    if (centre)
        *centre = sqrt(sums[0]);
    if (edge)
        *edge = sqrt(sums[1]);
}
