#include "fbm/places.h"

#include "fbm/elementary.h"
#include "fbm/kernel.h"

#include <assert.h>
#include <math.h>
#include <string.h>

/* Taps are kept without the factor sqrt(1 - H), which bends without limit towards 1. */
enum { KNOTS = FBM_PLACES_STEPS + 1, SQUARE_SIZE = 12, SIZE = 20 };

static const double knot_step = (FBM_HURST_MAX - FBM_HURST_MIN) / FBM_PLACES_STEPS;

/* Coefficients by their place among a fbm_weights' values, for centres and for edges. The first orbit is not among
 * them: it has what is left of 1. Of squares one of two equal orbits is enough. What they are multiplied with is in
 * kernel.c. */
static const unsigned char square_values[SQUARE_SIZE] = {1, 3, 4, 6, 7, 9, 12, 14, 16, 18, 19, 20};
static const unsigned char values_of[SIZE] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21};

static bool is_tap(unsigned char value)
{
    return (value >= 6 && value < 10) || value >= 18;
}

size_t fbm_places_size(bool square)
{
    return square ? SQUARE_SIZE : SIZE;
}

/* ---- The table --------------------------------------------------------------------------------- */

static bool is_square(double low, double high)
{
    return low == 0 && high == 0;
}

size_t fbm_places_table_size(double low, double high)
{
    return KNOTS * fbm_places_size(is_square(low, high)) * (low == high ? 1 : FBM_ASPECT_NODES);
}

/* What a shape changes, as Chebyshev's series in the exponent: kriging is analytic in it. */
enum { TERMS = 12 };

typedef struct change {
    double of[TERMS][FBM_WEIGHT_VALUES];
} change;

static void taps_by_root(double hurst, double *values)
{
    for (int k = 0; k < FBM_WEIGHT_VALUES; k++)
        if (is_tap((unsigned char)k))
            values[k] /= sqrt(1 - hurst);
}

static void measure_change(double aspect, change *out)
{
    const double middle = (FBM_HURST_MIN + FBM_HURST_MAX) / 2, reach = FBM_HURST_MAX - middle;
    memset(out, 0, sizeof *out);
    for (size_t n = 0; n < TERMS; n++) {
        double c, s, here[FBM_WEIGHT_VALUES], flat[FBM_WEIGHT_VALUES];
        fbm_turn(2 * n + 1, 4 * TERMS, &c, &s);
        double hurst = middle + reach * c;
        fbm_values_stationary(hurst, aspect, here);
        fbm_values_stationary(hurst, 1, flat);
        taps_by_root(hurst, here);
        taps_by_root(hurst, flat);
        for (size_t m = 0; m < TERMS; m++) {
            fbm_turn((2 * n + 1) * m, 4 * TERMS, &c, &s);
            for (int k = 0; k < FBM_WEIGHT_VALUES; k++)
                out->of[m][k] += (m ? 2.0 : 1.0) / TERMS * c * (here[k] - flat[k]);
        }
    }
}

static double change_at(const change *of, int value, double x)
{
    double before = 1, now = x, sum = of->of[0][value] + x * of->of[1][value];
    for (int m = 2; m < TERMS; m++) {
        double next = 2 * x * now - before;
        sum += next * of->of[m][value];
        before = now;
        now = next;
    }
    return sum;
}

/* Values at a knot: those of squares, taps by the root. */
static void knot_values(int knot, double values[FBM_WEIGHT_VALUES])
{
    double hurst = fbm_hurst_clamp(FBM_HURST_MIN + knot * knot_step);
    fbm_values_table(hurst, values);
    taps_by_root(hurst, values);
}

void fbm_places_table_make(double low, double high, float *values, fbm_places_table *out)
{
    bool square = is_square(low, high);
    *out = (fbm_places_table){.square = square, .nodes = low == high ? 1 : FBM_ASPECT_NODES, .low = low};
    out->step = (high - low) / (FBM_ASPECT_NODES - 1);
    out->values = values;
    const unsigned char *index = square ? square_values : values_of;
    size_t size = fbm_places_size(square);
    change changes[FBM_ASPECT_NODES];
    for (int n = 0; n < out->nodes && !square; n++)
        measure_change(fbm_exp2(low + n * out->step), &changes[n]);
    for (int knot = 0; knot < KNOTS; knot++) {
        double all[FBM_WEIGHT_VALUES];
        knot_values(knot, all);
        for (int n = 0; n < out->nodes; n++)
            for (size_t p = 0; p < size; p++) {
                double more = square ? 0 : change_at(&changes[n], index[p], 2.0 * knot / FBM_PLACES_STEPS - 1);
                *values++ = (float)(all[index[p]] + more);
            }
    }
}

/* ---- Rows -------------------------------------------------------------------------------------- */

/* Lagrange's weights of the aspect's nodes. */
static void node_weights(const fbm_places_table *table, double log_aspect, float *out)
{
    double at = table->nodes > 1 ? (log_aspect - table->low) / table->step : 0;
    at = fmin(fmax(at, 0), table->nodes - 1);
    for (int n = 0; n < table->nodes; n++) {
        double product = 1;
        for (int m = 0; m < table->nodes; m++)
            if (m != n)
                product *= (at - m) / (n - m);
        out[n] = (float)product;
    }
}

void fbm_places_unit(const fbm_places_table *table, double log_aspect, const float *hurst, size_t count, float *unit)
{
    enum { PIECE = 64 };
    float nodes[FBM_ASPECT_NODES], roots[PIECE];
    node_weights(table, log_aspect, nodes);
    for (size_t x = 0; x < count; x += PIECE) {
        size_t n = count - x < PIECE ? count - x : PIECE;
        for (size_t k = 0; k < n; k++)
            roots[k] = sqrtf(1 - hurst[x + k]);
        fbm_kernels()[0]->place_unit(table, nodes, hurst + x, roots, n, count, unit + x);
    }
}

void fbm_places_strengths(double fall, const float *strength, const float *hurst, size_t count, float *out)
{
    fbm_kernels()[0]->strengths(strength, hurst, (float)fall, out, count);
}

void fbm_places_scale(const fbm_places_table *table, const float *strengths, size_t count, const float *unit,
                      size_t stride, float *values)
{
    fbm_kernels()[0]->place_scale(table->square, strengths, count, unit, stride, values);
}
