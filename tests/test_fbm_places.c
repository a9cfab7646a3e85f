/* Coefficients by place: the same field where they do not change, windows and instruction sets, plateaus, jumps. */
#include "fbm/covariance.h"
#include "fbm/kernel.h"
#include "fbm/places.h"
#include "fbm/refine.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

static uint32_t arbitrary_state = 4711;

static uint32_t arbitrary(uint32_t below)
{
    arbitrary_state = arbitrary_state * 1664525 + 1013904223;
    return (uint32_t)((uint64_t)(arbitrary_state >> 8) * below >> 24);
}

static float *allocate(size_t count)
{
    float *out = malloc(count * sizeof *out);
    assert_non_null(out);
    return out;
}

/* Fields of strength and exponent over vertices of coefficients. */
typedef struct fields {
    fbm_window window;
    float *strength, *hurst;
} fields;

static fields make_fields(fbm_window window)
{
    size_t count = window.width * window.height;
    return (fields){window, allocate(count), allocate(count)};
}

static void free_fields(fields *f)
{
    free(f->strength);
    free(f->hurst);
}

/* The vertices that span an input. */
static fbm_window spanning(fbm_window from, int shift)
{
    int64_t unit = (int64_t)1 << shift, right = from.i + (int64_t)from.width - 1,
            below = from.j + (int64_t)from.height - 1;
    fbm_window w = {.i = from.i >> shift, .j = from.j >> shift};
    w.width = w.stride = (size_t)(((right + unit - 1) >> shift) - w.i + 1);
    w.height = (size_t)(((below + unit - 1) >> shift) - w.j + 1);
    return w;
}

/* Tables are made once a shape. */
static const fbm_places_table *table_of(double aspect)
{
    static fbm_places_table tables[3];
    static double of[3];
    int k = 0;
    while (k < 2 && of[k] && of[k] != aspect)
        k++;
    if (of[k] != aspect) {
        double log = aspect == 1 ? 0 : log2(aspect);
        fbm_places_table_make(log, log, allocate(fbm_places_table_size(log, log)), &tables[k]);
        of[k] = aspect;
    }
    return &tables[k];
}

/* The coefficients of the part of the fields that spans an input, in arrays of their own. */
static fbm_places make_places(const fbm_kernel *kernel, const fbm_places_table *table, double fall, const fields *f,
                              fbm_window from, int shift)
{
    fbm_window w = spanning(from, shift);
    bool square = table->square;
    float *values = calloc(w.width * w.height * fbm_places_size(square) + FBM_PLACES_SPARE, sizeof *values), roots[512],
          nodes[] = {1};
    float *unit = allocate(w.width * fbm_places_size(square)), *strengths = allocate(w.width);
    assert_true(w.width <= 512);
    for (size_t y = 0; y < w.height; y++) {
        size_t at = ((size_t)(w.j - f->window.j) + y) * f->window.width + (size_t)(w.i - f->window.i);
        for (size_t x = 0; x < w.width; x++)
            roots[x] = sqrtf(1 - f->hurst[at + x]);
        kernel->place_unit(table, nodes, f->hurst + at, roots, w.width, w.width, unit);
        kernel->strengths(f->strength + at, f->hurst + at, (float)fall, strengths, w.width);
        kernel->place_scale(square, strengths, w.width, unit, w.width, values + y * w.width * fbm_places_size(square));
    }
    free(unit);
    free(strengths);
    return (fbm_places){.shift = shift, .square = square, .window = w, .values = values};
}

static float *refine(const fbm_kernel *kernel, const fbm_places_table *table, fbm_step step, double fall,
                     const fields *f, int shift, const float *in, fbm_window from, fbm_window to)
{
    float *out = allocate(to.stride * to.height), *scratch = allocate(fbm_refine_scratch(to.width));
    fbm_places places = make_places(kernel, table, fall, f, from, shift);
    step.places = &places;
    fbm_refine_by(kernel, &step, in, NULL, from, out, to, scratch);
    free((float *)places.values);
    free(scratch);
    return out;
}

static float *cut(const float *in, fbm_window from, fbm_window part)
{
    float *out = allocate(part.width * part.height);
    for (size_t y = 0; y < part.height; y++)
        memcpy(out + y * part.width, in + ((size_t)(part.j - from.j) + y) * from.stride + (part.i - from.i),
               part.width * sizeof *out);
    return out;
}

static float *make_heights(fbm_window window, float range)
{
    float *out = allocate(window.width * window.height);
    for (size_t k = 0; k < window.width * window.height; k++)
        out[k] = range * (float)arbitrary(1 << 20) / (1 << 20);
    return out;
}

static void fill(fields *f, bool jumping)
{
    for (size_t k = 0; k < f->window.width * f->window.height; k++) {
        f->hurst[k] = jumping ? (arbitrary(2) ? .9F : .1F) : .01F + .98F * (float)arbitrary(1 << 20) / (1 << 20);
        f->strength[k] = jumping ? (arbitrary(2) ? 1e3F : 1e-3F) : (float)arbitrary(1000) / 250;
    }
}

static const double shapes[] = {1, .8};

/* Against a step with the exponent's own weights. Knots miss the predictor's weights by 5e-6 each, of differences from
 * the nearest orbit that are at most the range of the heights, over 24 points; of the noise, which is 4.9 at most, the
 * taps likewise, at 9 points, where amplitudes have 1e-6 from the power beside. Rounding has 24 steps of 2^-24 in
 * either. Edges see centres, with a factor of sum |w| < 2.2. */
static void fieldsOfOneValueEqualAStepWithoutPlaces(void **state)
{
    (void)state;
    const float range = 100, amplitude = 30;
    for (size_t s = 0; s < 2; s++)
        for (int shift = 0; shift <= FBM_PLACES_SHIFT; shift++)
            for (double hurst = .01; hurst < 1; hurst += .07) {
                fbm_step step = {.scheme = fbm_schemes, .seed = 5, .level = 2};
                double values[FBM_WEIGHT_VALUES], fall = 3.25;
                fbm_values_stationary((double)(float)hurst, shapes[s], values);
                fbm_weights_round(values, &step.weights);
                step.amplitude = amplitude * (float)exp2(-fall * (double)(float)hurst);
                fbm_window to = {-11, 6, 75, 41, 75}, from = fbm_refine_support(step.scheme, to);
                fields f = make_fields(spanning(from, shift));
                for (size_t k = 0; k < f.window.width * f.window.height; k++) {
                    f.hurst[k] = (float)hurst;
                    f.strength[k] = amplitude;
                }
                float *in = make_heights(from, range), *scratch = allocate(fbm_refine_scratch(to.width));
                float *plain = allocate(to.width * to.height);
                fbm_refine(&step, in, from, plain, to, scratch);
                float *placed = refine(fbm_kernels()[0], table_of(shapes[s]), step, fall, &f, shift, in, from, to);
                double most = (24 * 5e-6 + 24 * 0x1p-23) * (double)range +
                              (9 * 5e-6 + 1e-6 + 24 * 0x1p-23) * 4.9 * (double)step.amplitude;
                for (size_t k = 0; k < to.width * to.height; k++)
                    assert_true(fabs((double)plain[k] - (double)placed[k]) <= most * (1 + 2.2));
                free(in), free(scratch), free(plain), free(placed);
                free_fields(&f);
            }
}

static void windowsWithPlacesEqualTheWholeBitForBit(void **state)
{
    (void)state;
    const fbm_window wholes[] = {
        {0, 0, 90, 70, 90}, {-41, -33, 131, 65, 131}, {((int64_t)1 << 40) - 31, -35, 80, 50, 80}};
    for (size_t s = 0; s < 2; s++)
        for (int shift = 0; shift <= FBM_PLACES_SHIFT; shift++)
            for (size_t k = 0; k < sizeof wholes / sizeof *wholes; k++) {
                fbm_step step = {.scheme = fbm_schemes, .amplitude = 1, .seed = 5, .level = 2};
                fbm_window to = wholes[k], from = fbm_refine_support(step.scheme, to);
                fields f = make_fields(spanning(from, shift));
                fill(&f, false);
                const fbm_places_table *table = table_of(shapes[s]);
                float *in = make_heights(from, 100);
                float *whole = refine(fbm_kernels()[0], table, step, 1.5, &f, shift, in, from, to);
                for (int n = 0; n < 40; n++) {
                    fbm_window part = {.width = 1 + arbitrary(60), .height = 1 + arbitrary(40)};
                    part.i = to.i + arbitrary((uint32_t)(to.width - part.width + 1));
                    part.j = to.j + arbitrary((uint32_t)(to.height - part.height + 1));
                    part.stride = part.width;
                    fbm_window need = fbm_refine_support(step.scheme, part);
                    const fbm_kernel *kernel = fbm_kernels()[n & 1 && fbm_kernels()[1] ? 1 : 0];
                    float *some = cut(in, from, need);
                    float *found = refine(kernel, table, step, 1.5, &f, shift, some, need, part);
                    for (size_t y = 0; y < part.height; y++)
                        assert_memory_equal(found + y * part.width,
                                            whole + ((size_t)(part.j - to.j) + y) * to.width + (part.i - to.i),
                                            part.width * sizeof *found);
                    free(some), free(found);
                }
                free(in), free(whole);
                free_fields(&f);
            }
}

static void everyKernelHasTheSameBitsWithPlaces(void **state)
{
    (void)state;
    for (size_t s = 0; s < 2; s++)
        for (int shift = 0; shift <= FBM_PLACES_SHIFT; shift++)
            for (size_t width = 1; width < 300; width += width < 40 ? 1 : 37) {
                fbm_step step = {.scheme = fbm_schemes, .amplitude = width % 3 ? 1.F : 0, .seed = 5, .level = 2};
                fbm_window to = {-3, 5, width, 11, width}, from = fbm_refine_support(step.scheme, to);
                fields f = make_fields(spanning(from, shift));
                fill(&f, width % 2);
                const fbm_places_table *table = table_of(shapes[s]);
                float *in = make_heights(from, 1000);
                float *expected = refine(fbm_kernels()[0], table, step, 30, &f, shift, in, from, to);
                for (const fbm_kernel *const *kernel = fbm_kernels() + 1; *kernel; kernel++) {
                    float *found = refine(*kernel, table, step, 30, &f, shift, in, from, to);
                    assert_memory_equal(found, expected, width * 11 * sizeof *found);
                    free(found);
                }
                free(in), free(expected);
                free_fields(&f);
            }
}

static void centresWithPlacesEqualTheOddSamples(void **state)
{
    (void)state;
    for (int shift = 0; shift <= FBM_PLACES_SHIFT; shift++) {
        fbm_step step = {.scheme = fbm_schemes, .amplitude = 1, .seed = 5, .level = 2};
        fbm_window cells = {-7, 3, 61, 20, 61}, fine = {-14, 6, 122, 40, 122};
        fbm_window from = fbm_refine_support(step.scheme, fine), need = fbm_centres_support(step.scheme, cells);
        fields f = make_fields(spanning(from, shift));
        fill(&f, false);
        float *in = make_heights(from, 10), *some = cut(in, from, need), *out = allocate(61 * 20);
        float *all = refine(fbm_kernels()[0], table_of(1), step, 2, &f, shift, in, from, fine);
        fbm_places places = make_places(fbm_kernels()[0], table_of(1), 2, &f, need, shift);
        float *scratch = allocate(fbm_refine_scratch(122));
        step.places = &places;
        fbm_centres(&step, some, need, out, cells, scratch);
        for (size_t y = 0; y < 20; y++)
            for (size_t x = 0; x < 61; x++)
                assert_true(out[y * 61 + x] == all[(2 * y + 1) * 122 + 2 * x + 1]);
        free(in), free(some), free(out), free(all), free(scratch);
        free((float *)places.values);
        free_fields(&f);
    }
}

/* The mean of the nearest orbit and weighted differences: equal heights cancel without rounding. */
static void plateausStayWhateverTheExponents(void **state)
{
    (void)state;
    for (size_t s = 0; s < 2; s++)
        for (int shift = 0; shift <= FBM_PLACES_SHIFT; shift++) {
            fbm_step step = {.scheme = fbm_schemes, .amplitude = 0};
            fbm_window to = {-40, -41, 150, 90, 150}, from = fbm_refine_support(step.scheme, to);
            fields f = make_fields(spanning(from, shift));
            fill(&f, shift % 2);
            float *in = allocate(from.width * from.height);
            for (size_t k = 0; k < from.width * from.height; k++)
                in[k] = 4321.567F;
            float *out = refine(fbm_kernels()[0], table_of(shapes[s]), step, 1, &f, shift, in, from, to);
            for (size_t k = 0; k < 150 * 90; k++)
                assert_true(out[k] == 4321.567F);
            free(in), free(out);
            free_fields(&f);
        }
}

/* The most that predictors weigh, sum |w| over all exponents, and filters. */
static void bound_weights(double *predictor, double *filter)
{
    *predictor = *filter = 0;
    for (double hurst = .01; hurst < .995; hurst += .001) {
        double v[FBM_WEIGHT_VALUES];
        fbm_values_table(hurst, v);
        *predictor = fmax(*predictor, 4 * (fabs(v[0]) + 2 * fabs(v[1]) + fabs(v[3]) + 2 * fabs(v[4])));
        *filter = fmax(*filter, fabs(v[6]) + 4 * fabs(v[7]) + 4 * fabs(v[9]));
    }
}

/* Coefficients are means of those of single exponents. So of heights within +-1 no centre is beyond L = max sum |w|,
 * no edge beyond L^2, and noise adds 4.9 max sum |t| times the largest strength, to centres, and to edges once more
 * (filters there are 2^(-H/2) as strong) and L times that of the centres. Where the strength is 0 all around, nothing
 * is added. */
static void jumpsDoNotRing(void **state)
{
    (void)state;
    double weight, tap;
    bound_weights(&weight, &tap);
    for (int shift = 0; shift <= FBM_PLACES_SHIFT; shift++)
        for (int noisy = 0; noisy < 2; noisy++) {
            fbm_step step = {.scheme = fbm_schemes, .amplitude = (float)noisy, .seed = 9};
            fbm_window to = {0, 0, 200, 150, 200}, from = fbm_refine_support(step.scheme, to);
            fields f = make_fields(spanning(from, shift));
            fill(&f, true);
            float *in = make_heights(from, 2);
            for (size_t k = 0; k < from.width * from.height; k++)
                in[k] = in[k] < 1 ? -1 : 1;
            float *out = refine(fbm_kernels()[0], table_of(1), step, 0, &f, shift, in, from, to);
            double noise = noisy ? 4.9 * tap * 1000 : 0, most = fmax(weight * (weight + noise) + noise, 1) * 1.0001;
            for (size_t k = 0; k < 200 * 150; k++)
                assert_true(fabs((double)out[k]) <= most); /* not for NaN */
            free(in), free(out);
            free_fields(&f);
        }
}

static void noStrengthMeansNoNoise(void **state)
{
    (void)state;
    fbm_step noisy = {.scheme = fbm_schemes, .amplitude = 1, .seed = 9}, smooth = {.scheme = fbm_schemes};
    fbm_window to = {0, 0, 100, 50, 100}, from = fbm_refine_support(noisy.scheme, to);
    fields f = make_fields(spanning(from, 3));
    fill(&f, true);
    memset(f.strength, 0, f.window.width * f.window.height * sizeof *f.strength);
    float *in = make_heights(from, 2);
    float *a = refine(fbm_kernels()[0], table_of(1), noisy, 5, &f, 3, in, from, to);
    float *b = refine(fbm_kernels()[0], table_of(1), smooth, 5, &f, 3, in, from, to);
    for (size_t k = 0; k < 100 * 50; k++)
        assert_true(a[k] == b[k]);
    free(in), free(a), free(b);
    free_fields(&f);
}

/* 2^-fall H against the C library's: the series has 4e-7, and the product, rounded, 2^-24 of itself in the exponent. */
static void strengthsFallWithTheExponent(void **state)
{
    (void)state;
    for (const fbm_kernel *const *kernel = fbm_kernels(); *kernel; kernel++)
        for (double fall = -3; fall <= 33; fall += .75) {
            float strength[99], hurst[99], out[99];
            for (int k = 0; k < 99; k++) {
                strength[k] = k % 5 ? 1e-6F * (float)(1 + k) : 1e6F;
                hurst[k] = (float)(k + 1) / 100;
            }
            (*kernel)->strengths(strength, hurst, (float)fall, out, 99);
            for (int k = 0; k < 99; k++) {
                double power = -fall * (double)hurst[k], exact = (double)strength[k] * exp2(power);
                assert_true(fabs((double)out[k] - exact) <= exact * (5e-7 + fabs(power) * 0x1p-23));
            }
        }
}

/* The weights that the coefficients of squares stand for. */
static void weights_of(const float *unit, fbm_weights *out)
{
    out->centre[1] = out->centre[2] = unit[0];
    out->centre[3] = unit[1];
    out->centre[4] = out->centre[5] = unit[2];
    out->centre[0] = .25F - 2 * unit[0] - unit[1] - 2 * unit[2];
    out->centre_taps[0] = unit[3];
    out->centre_taps[1] = out->centre_taps[2] = unit[4];
    out->centre_taps[3] = unit[5];
    out->edge[2] = out->edge[3] = unit[6];
    out->edge[4] = out->edge[5] = unit[7];
    out->edge[6] = out->edge[7] = unit[8];
    out->edge[0] = out->edge[1] = .25F - 2 * unit[6] - unit[7] - 2 * unit[8];
    out->edge_taps[0] = unit[9];
    out->edge_taps[1] = unit[10];
    out->edge_taps[2] = out->edge_taps[3] = unit[11];
}

/* Between the knots, where lines are farthest from the curves: the structure function, exactly propagated, moves by no
 * more than 1e-5 of itself from H = 0.1 on. Below, where the weights bend up to ten times as much, by 5e-5. */
static void linesBetweenKnotsKeepTheStructureFunction(void **state)
{
    (void)state;
    static const double exponents[] = {.01, .02, .05, .1, .3, .5, .8, .95, .988};
    for (size_t k = 0; k < sizeof exponents / sizeof *exponents; k++) {
        double knot = floor((exponents[k] - .01) * 1004 / .98 + .5) + .5;
        float hurst = (float)(.01 + knot * .98 / 1004), unit[16];
        fbm_places_unit(table_of(1), 0, &hurst, 1, unit);
        fbm_weights exact, lines;
        fbm_weights_stationary((double)hurst, &exact);
        lines = exact;
        weights_of(unit, &lines);
        fbm_deviation a, b;
        assert_int_equal(fbm_structure_deviation(fbm_schemes, &exact, (double)hurst, 3, 3, &a), FBM_OK);
        assert_int_equal(fbm_structure_deviation(fbm_schemes, &lines, (double)hurst, 3, 3, &b), FBM_OK);
        double most = exponents[k] < .1 ? 5e-5 : 1e-5;
        assert_true(fabs(a.point - b.point) <= most && fabs(a.mean - b.mean) <= most);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(fieldsOfOneValueEqualAStepWithoutPlaces),
        cmocka_unit_test(windowsWithPlacesEqualTheWholeBitForBit),
        cmocka_unit_test(everyKernelHasTheSameBitsWithPlaces),
        cmocka_unit_test(centresWithPlacesEqualTheOddSamples),
        cmocka_unit_test(plateausStayWhateverTheExponents),
        cmocka_unit_test(jumpsDoNotRing),
        cmocka_unit_test(noStrengthMeansNoNoise),
        cmocka_unit_test(strengthsFallWithTheExponent),
        cmocka_unit_test(linesBetweenKnotsKeepTheStructureFunction),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
