#include "fbm/spectrum.h"

#include "fbm/elementary.h"

#include <kiss_fft.h>

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* ---- power ---- */

static void subtract_plane(double *z, size_t side)
{
    double middle = 0.5 * ((double)side - 1), mean = 0, x = 0, y = 0, n = (double)side;
    for (size_t j = 0; j < side; j++)
        for (size_t i = 0; i < side; i++) {
            mean += z[j * side + i];
            x += z[j * side + i] * ((double)i - middle);
            y += z[j * side + i] * ((double)j - middle);
        }
    /* sum of squares of (i - middle) over the window: n^2 (n^2 - 1) / 12 */
    double square = n * n * (n * n - 1) / 12;
    for (size_t j = 0; j < side; j++)
        for (size_t i = 0; i < side; i++)
            z[j * side + i] -= mean / (n * n) + x / square * ((double)i - middle) + y / square * ((double)j - middle);
}

/* Hann's taper at half samples, with a mean square of 1. */
static double taper(size_t i, size_t side)
{
    double cosine, sine;
    fbm_turn(2 * i + 1, 2 * side, &cosine, &sine);
    return sqrt(2.0 / 3) * (1 - cosine);
}

static void transform_rows(kiss_fft_cfg plan, kiss_fft_cpx *field, size_t side, kiss_fft_cpx *row)
{
    for (size_t j = 0; j < side; j++) {
        kiss_fft(plan, field + j * side, row);
        memcpy(field + j * side, row, side * sizeof *row);
    }
}

static void transpose(kiss_fft_cpx *field, size_t side)
{
    for (size_t j = 0; j < side; j++)
        for (size_t i = 0; i < j; i++) {
            kiss_fft_cpx keep = field[j * side + i];
            field[j * side + i] = field[i * side + j];
            field[i * side + j] = keep;
        }
}

fbm_status fbm_spectrum_add(const float *heights, size_t side, double scale, double *power)
{
    size_t samples = side * side;
    double *z = malloc(samples * sizeof *z);
    kiss_fft_cpx *field = malloc((samples + side) * sizeof *field);
    kiss_fft_cfg plan = kiss_fft_alloc((int)side, 0, NULL, NULL);
    fbm_status status = z && field && plan ? FBM_OK : FBM_NO_MEMORY;
    if (status == FBM_OK) {
        for (size_t k = 0; k < samples; k++)
            z[k] = scale * ((double)heights[k] - (double)heights[0]);
        subtract_plane(z, side);
        for (size_t k = 0; k < samples; k++)
            field[k] = (kiss_fft_cpx){(float)(z[k] * taper(k % side, side) * taper(k / side, side)), 0};
        transform_rows(plan, field, side, field + samples);
        transpose(field, side);
        transform_rows(plan, field, side, field + samples);
        transpose(field, side);
        for (size_t k = 0; k < samples; k++)
            power[k] +=
                ((double)field[k].r * (double)field[k].r + (double)field[k].i * (double)field[k].i) / (double)samples;
    }
    free(z);
    free(field);
    kiss_fft_free(plan);
    return status;
}

/* Cycles a window, from 0 to side / 2 and back. */
static double cycles(size_t k, size_t side)
{
    return k <= side / 2 ? (double)k : (double)k - (double)side;
}

void fbm_spectrum_radial(const double *power, size_t side, double *radial)
{
    size_t count[FBM_SPECTRUM_SIDE_MAX / 2] = {0};
    memset(radial, 0, side / 2 * sizeof *radial);
    for (size_t j = 0; j < side; j++)
        for (size_t i = 0; i < side; i++) {
            double x = cycles(i, side), y = cycles(j, side);
            size_t k = (size_t)(sqrt(x * x + y * y) + 0.5);
            if (k < 1 || k > side / 2)
                continue;
            radial[k - 1] += power[j * side + i];
            count[k - 1]++;
        }
    for (size_t k = 0; k < side / 2; k++)
        radial[k] /= (double)count[k];
}

/* ---- fit ---- */

enum { ALIASES = 2, FIRST = 5, ROUNDS = 30 };

static const double lowest = 0.01, highest = 1.95; /* exponents */

typedef struct ordinates {
    size_t side;
    double aspect; /* frequency along rows over that along columns, for as many cycles a window */
    bool area;
    double windows, noise;
    const double *power;
    double *model, *smeared; /* of side * side */
} ordinates;

static double sinc_square(double x)
{
    if (fabs(x) < 1e-9)
        return 1;
    double s = sin(3.14159265358979323846 * x) / (3.14159265358979323846 * x);
    return s * s;
}

enum { NEARBY = (2 * ALIASES + 1) * (2 * ALIASES + 1) };

/* |k|^-(2H+2), k in cycles a sample, over all frequencies that sampling cannot tell apart; those beyond the nearest
 * ones as an integral over a plane without a disc of their area: `rest`. */
static double aliased(const ordinates *o, double x, double y, double hurst, double rest)
{
    double sum = 0, powers[NEARBY], across[2 * ALIASES + 1];
    int n = 0;
    for (int b = -ALIASES; b <= ALIASES; b++)
        for (int a = -ALIASES; a <= ALIASES; a++) {
            double u = (x + a) * o->aspect, v = (y + b) / o->aspect;
            powers[n++] = u * u + v * v;
        }
    fbm_pow_all(powers, hurst + 1, powers, NEARBY);
    if (!o->area) {
        for (n = 0; n < NEARBY; n++)
            sum += 1 / powers[n];
        return sum + rest;
    }
    for (int a = -ALIASES; a <= ALIASES; a++)
        across[a + ALIASES] = sinc_square(x + a);
    n = 0;
    for (int b = -ALIASES; b <= ALIASES; b++) {
        double down = sinc_square(y + b);
        for (int a = 0; a <= 2 * ALIASES; a++)
            sum += 1 / powers[n++] * across[a] * down;
    }
    return sum;
}

/* Hann's taper gives a frequency 1/6, 2/3 and 1/6 of the power at its neighbours and itself, along either axis: the
 * squares of -1/4, 1/2, -1/4 over their sum. */
static double smear(const double *model, size_t side, size_t i, size_t j)
{
    static const double share[3] = {1.0 / 6, 2.0 / 3, 1.0 / 6};
    double sum = 0;
    for (size_t b = 0; b < 3; b++)
        for (size_t a = 0; a < 3; a++)
            sum += share[a] * share[b] * model[(j + b + side - 1) % side * side + (i + a + side - 1) % side];
    return sum;
}

static void make_model(ordinates *o, double hurst)
{
    size_t side = o->side, half = side / 2;
    double radius_square = NEARBY / 3.14159265358979323846;
    double rest = 3.14159265358979323846 / hurst / fbm_pow(radius_square, hurst);
    for (size_t j = 0; j <= half; j++)
        for (size_t i = 0; i <= half; i++) {
            double value = i + j == 0 ? 0 : aliased(o, (double)i / (double)side, (double)j / (double)side, hurst, rest);
            size_t across = (side - i) % side, down = (side - j) % side;
            o->model[j * side + i] = o->model[j * side + across] = o->model[down * side + i] =
                o->model[down * side + across] = value;
        }
    for (size_t j = 0; j < side; j++)
        for (size_t i = 0; i < side; i++)
            o->smeared[j * side + i] = smear(o->model, side, i, j);
}

static bool counts(const ordinates *o, size_t i, size_t j)
{
    double x = cycles(i, o->side), y = cycles(j, o->side), k2 = x * x + y * y, most = 0.375 * (double)o->side;
    return k2 >= FIRST * FIRST && k2 <= most * most;
}

/* log amplitude and H, and the information on H with the amplitude free. */
typedef struct scoring {
    double log_amplitude, hurst, information;
} scoring;

/* One step of Fisher's scoring. With f = a m + noise and s = a m / f, an exponential ordinate I has the scores
 * s (I / f - 1) for log a and s g (I / f - 1) for H, g the slope of log m in H. Half of the ordinates repeat the
 * others, and Hann's taper makes them share (35/18)^2 times more with their neighbours than independent ones. */
static bool score(ordinates *o, double *before, scoring *at)
{
    const double half_step = 0.005, repeated = 0.5 * o->windows / (35.0 / 18 * 35 / 18);
    size_t samples = o->side * o->side;
    double aa = 0, ah = 0, hh = 0, ra = 0, rh = 0, amplitude = exp(at->log_amplitude);
    make_model(o, at->hurst - half_step);
    memcpy(before, o->smeared, samples * sizeof *before);
    make_model(o, at->hurst + half_step);
    for (size_t k = 0; k < samples; k++)
        if (counts(o, k % o->side, k / o->side)) {
            double m = sqrt(before[k] * o->smeared[k]), g = log(o->smeared[k] / before[k]) / (2 * half_step);
            double f = amplitude * m + o->noise, s = amplitude * m / f, r = o->power[k] / f - 1;
            aa += s * s;
            ah += s * s * g;
            hh += s * s * g * g;
            ra += s * r;
            rh += s * g * r;
        }
    double determinant = aa * hh - ah * ah;
    if (!(determinant > 0))
        return false;
    double step = (aa * rh - ah * ra) / determinant;
    step = step > 0.3 ? 0.3 : step < -0.3 ? -0.3 : step;
    double hurst = at->hurst + step;
    hurst = hurst < lowest ? lowest : hurst > highest ? highest : hurst;
    step = hurst - at->hurst;
    double grow = (ra - ah * step) / aa;
    at->hurst = hurst;
    at->log_amplitude += grow > 2 ? 2 : grow < -2 ? -2 : grow;
    at->information = repeated * determinant / aa;
    return isfinite(at->hurst) && isfinite(at->log_amplitude);
}

/* The first guess: H = 1/2, and the amplitude by the mean ratio. */
static scoring guess(ordinates *o)
{
    double ratio = 0, n = 0;
    make_model(o, 0.5);
    for (size_t k = 0; k < o->side * o->side; k++)
        if (counts(o, k % o->side, k / o->side)) {
            ratio += o->power[k] / o->smeared[k];
            n++;
        }
    return (scoring){.log_amplitude = log(ratio / n), .hurst = 0.5};
}

/* The spectrum of fBm in the plane with E|Z(x+h) - Z(x)|^2 = |h|^2H is c |k|^-(2H+2), k in cycles,
 * c = H 2^(2H) Gamma(1+H) / (pi Gamma(1-H)) (2 pi)^-2H / (2 pi)^0 ... written out: S(h) = 2 int (1 - cos 2 pi k h)
 * f(k). */
static double spectral_constant(double hurst)
{
    const double pi = 3.14159265358979323846;
    return hurst * exp(lgamma(1 + hurst) - lgamma(1 - hurst)) / (2 * pi * pow(pi, 2 * hurst));
}

fbm_status fbm_spectrum_fit_power(const double *power, size_t side, double windows, double cell_x, double cell_y,
                                  bool area, double noise, fbm_spectrum_fit *out)
{
    size_t samples = side * side;
    *out = (fbm_spectrum_fit){0};
    double *room = malloc(3 * samples * sizeof *room);
    if (!room)
        return FBM_NO_MEMORY;
    ordinates o = {.side = side,
                   .aspect = sqrt(cell_y / cell_x),
                   .area = area,
                   .windows = windows,
                   .noise = noise,
                   .power = power,
                   .model = room,
                   .smeared = room + samples};
    scoring at = guess(&o);
    bool good = isfinite(at.log_amplitude), still = false;
    for (int round = 0; good && !still && round < ROUNDS; round++) {
        double before = at.hurst;
        good = score(&o, room + 2 * samples, &at);
        still = fabs(at.hurst - before) < 1e-6;
    }
    free(room);
    out->known = good && still && at.information > 0 && at.hurst > lowest && at.hurst < highest;
    if (!out->known)
        return FBM_OK;
    out->hurst = at.hurst;
    out->hurst_error = 1 / sqrt(at.information);
    if (out->hurst < 0.995) /* from samples to the unit of distance */
        out->delta = exp(0.5 * at.log_amplitude) / sqrt(spectral_constant(out->hurst)) /
                     fbm_pow(cell_x * cell_y, 0.5 * out->hurst);
    return FBM_OK;
}
