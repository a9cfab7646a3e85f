#include "fbm/elementary.h"

#include <math.h>

/* Only functions of <math.h> that are exact by their definition are used here: floor, frexp, ldexp. */

static const double ln2 = 0.69314718055994530942, pi = 3.14159265358979323846, root_half = 0.70710678118654752440;

/* e^x for |x| <= ln(2) / 2 by Taylor's series: the term x^14 / 14! is below 2^-60. */
static double exp_near_0(double x)
{
    double sum = 1;
    for (int k = 13; k >= 1; k--)
        sum = 1 + sum * x / k;
    return sum;
}

double fbm_exp2(double x)
{
    if (!(x >= -1080))
        return x != x ? x : 0;
    if (x > 1024)
        return (double)INFINITY;
    double whole = floor(x + 0.5);
    return ldexp(exp_near_0((x - whole) * ln2), (int)whole);
}

/* ln m = 2 artanh s, s = (m - 1) / (m + 1); for m in [sqrt(1/2), sqrt(2)] s^2 < 0.0295, and the 12th term is below
 * 2^-60. */
double fbm_log2(double x)
{
    int exponent;
    double m = frexp(x, &exponent);
    if (m < root_half) {
        m *= 2;
        exponent--;
    }
    double s = (m - 1) / (m + 1), square = s * s, sum = 0;
    for (int k = 12; k >= 0; k--)
        sum = sum * square + 1.0 / (2 * k + 1);
    return exponent + 2 * s * sum / ln2;
}

double fbm_pow(double x, double y)
{
    if (x == 0)
        return y == 0 ? 1 : 0;
    return fbm_exp2(y * fbm_log2(x));
}

enum { TOGETHER = 16 };

/* fbm_exp2 of so many numbers at once. */
static void exp2_together(double x[TOGETHER])
{
    double whole[TOGETHER], rest[TOGETHER], sum[TOGETHER];
    for (int k = 0; k < TOGETHER; k++) {
        double within = x[k] >= -1080 && x[k] <= 1024 ? x[k] : 0;
        whole[k] = floor(within + 0.5);
        rest[k] = (within - whole[k]) * ln2;
        sum[k] = 1;
    }
    for (int n = 13; n >= 1; n--)
        for (int k = 0; k < TOGETHER; k++)
            sum[k] = 1 + sum[k] * rest[k] / n;
    for (int k = 0; k < TOGETHER; k++)
        x[k] = x[k] >= -1080 && x[k] <= 1024 ? ldexp(sum[k], (int)whole[k]) : fbm_exp2(x[k]);
}

void fbm_pow_all(const double *x, double y, double *out, size_t count)
{
    for (size_t from = 0; from < count; from += TOGETHER) {
        double power[TOGETHER] = {0};
        size_t some = count - from < TOGETHER ? count - from : TOGETHER;
        for (size_t k = 0; k < some; k++)
            power[k] = y * fbm_log2(x[from + k]);
        exp2_together(power);
        for (size_t k = 0; k < some; k++)
            out[from + k] = x[from + k] == 0 ? fbm_pow(0, y) : power[k];
    }
}

/* Cosine and sine of |x| <= pi / 4 by Taylor's series: the terms left out are below 2^-60. */
static void turn_near_0(double x, double *cosine, double *sine)
{
    double square = x * x, c = 1, s = 1;
    for (int k = 9; k >= 1; k--) {
        c = 1 - c * square / ((2 * k - 1) * (2 * k));
        s = 1 - s * square / ((2 * k) * (2 * k + 1));
    }
    *cosine = c;
    *sine = s * x;
}

void fbm_turn(size_t k, size_t n, double *cosine, double *sine)
{
    size_t eighths = 8 * (k % n), octant = eighths / n, rest = eighths % n;
    /* odd octants are looked at from their other end, where the angle is within an eighth of a turn of an axis */
    size_t quarter = (octant + 1) / 2 % 4;
    double angle = pi / 4 * (double)(octant % 2 ? n - rest : rest) / (double)n, c, s;
    turn_near_0(angle, &c, &s);
    if (octant % 2)
        s = -s;
    const double turned[4][2] = {{c, s}, {-s, c}, {-c, -s}, {s, -c}};
    *cosine = turned[quarter][0];
    *sine = turned[quarter][1];
}
