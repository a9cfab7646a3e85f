/* The refinement kernel: windows, instruction sets, exactness. */
#include "fbm/kernel.h"
#include "fbm/refine.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

/* Test input needs to be arbitrary, not random. */
static uint32_t arbitrary_state = 12345;

static uint32_t arbitrary(uint32_t below)
{
    arbitrary_state = arbitrary_state * 1664525 + 1013904223;
    return (uint32_t)((uint64_t)(arbitrary_state >> 8) * below >> 24);
}

static size_t samples(fbm_window window)
{
    return window.stride * window.height;
}

static float *allocate(size_t count)
{
    float *out = malloc(count * sizeof *out);
    assert_non_null(out);
    return out;
}

static float *make_heights(fbm_window window)
{
    float *out = allocate(samples(window));
    for (size_t k = 0; k < samples(window); k++)
        out[k] = (float)arbitrary(1 << 20) / 256 - 1000;
    return out;
}

static fbm_step make_step(const fbm_scheme *scheme, double hurst, float amplitude)
{
    fbm_step step = {.scheme = scheme, .amplitude = amplitude, .seed = 99, .level = 3};
    scheme->weights(hurst, &step.weights);
    return step;
}

/* Refines into a new array that has just the room for `to`. */
static float *refine(const fbm_kernel *kernel, const fbm_step *step, const float *in, fbm_window from, fbm_window to)
{
    float *out = allocate(samples(to)), *scratch = allocate(fbm_refine_scratch(to.width));
    fbm_refine_by(kernel, step, in, NULL, from, out, to, scratch);
    free(scratch);
    return out;
}

static float *refine_mapped(const fbm_kernel *kernel, const fbm_step *step, const float *in, const float *map,
                            fbm_window from, fbm_window to)
{
    float *out = allocate(samples(to)), *scratch = allocate(fbm_refine_scratch(to.width));
    fbm_refine_by(kernel, step, in, map, from, out, to, scratch);
    free(scratch);
    return out;
}

static const fbm_kernel *best(void)
{
    return fbm_kernels()[0];
}

/* A copy of the part of `in` that `part` names, in an array of its own, so that a sanitizer sees every step outside. */
static float *cut(const float *in, fbm_window from, fbm_window part)
{
    float *out = allocate(samples(part));
    for (size_t y = 0; y < part.height; y++)
        memcpy(out + y * part.stride, in + ((size_t)(part.j - from.j) + y) * from.stride + (part.i - from.i),
               part.width * sizeof *out);
    return out;
}

static void assert_part(const float *part, fbm_window part_window, const float *whole, fbm_window window)
{
    for (size_t y = 0; y < part_window.height; y++)
        assert_memory_equal(part + y * part_window.stride,
                            whole + ((size_t)(part_window.j - window.j) + y) * window.stride +
                                (part_window.i - window.i),
                            part_window.width * sizeof *part);
}

static fbm_window random_part(fbm_window window, uint32_t most)
{
    uint32_t limit_x = window.width < most ? (uint32_t)window.width : most;
    uint32_t limit_y = window.height < most ? (uint32_t)window.height : most;
    fbm_window part = {.width = 1 + arbitrary(limit_x), .height = 1 + arbitrary(limit_y)};
    part.i = window.i + arbitrary((uint32_t)(window.width - part.width) + 1);
    part.j = window.j + arbitrary((uint32_t)(window.height - part.height) + 1);
    part.stride = part.width;
    return part;
}

static void check_parts(const fbm_step *step, fbm_window to, int parts, uint32_t most)
{
    fbm_window from = fbm_refine_support(step->scheme, to);
    float *in = make_heights(from), *whole = refine(best(), step, in, from, to);
    for (int k = 0; k < parts; k++) {
        fbm_window part = random_part(to, most), need = fbm_refine_support(step->scheme, part);
        float *part_in = cut(in, from, need), *found = refine(best(), step, part_in, need, part);
        assert_part(found, part, whole, to);
        free(part_in);
        free(found);
    }
    free(in);
    free(whole);
}

/* Sizes beyond 4096 samples cross the columns that the kernel makes at a time. */
static void windowsEqualTheWholeBitForBit(void **state)
{
    (void)state;
    static const int64_t huge = (int64_t)1 << 60;
    const fbm_window wholes[] = {
        {0, 0, 90, 70, 90},
        {-41, -33, 81, 65, 85},
        {7, -1, 9301, 7, 9301},
        {huge - 9, -huge + 3, 64, 64, 64},
        {((int64_t)1 << 33) - 31, -((int64_t)1 << 33) - 30, 80, 50, 80},
    };
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++)
        for (size_t k = 0; k < sizeof wholes / sizeof *wholes; k++) {
            fbm_step noisy = make_step(scheme, 0.35, 2), smooth = make_step(scheme, 0.8, 0);
            check_parts(&noisy, wholes[k], 40, 10000);
            check_parts(&noisy, wholes[k], 40, 4);
            check_parts(&smooth, wholes[k], 20, 10000);
        }
}

static void everyKernelRefinesToTheSameBits(void **state)
{
    (void)state;
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++)
        for (size_t width = 1; width < 700; width += width < 70 ? 1 : 97)
            for (int noisy = 0; noisy < 2; noisy++) {
                fbm_step step = make_step(scheme, 0.6, noisy ? 1.5F : 0);
                fbm_window to = {-3, 5, width, 11, width}, from = fbm_refine_support(scheme, to);
                float *in = make_heights(from), *expected = refine(best(), &step, in, from, to);
                for (const fbm_kernel *const *kernel = fbm_kernels() + 1; *kernel; kernel++) {
                    float *found = refine(*kernel, &step, in, from, to);
                    assert_memory_equal(found, expected, samples(to) * sizeof *found);
                    free(found);
                }
                free(in);
                free(expected);
            }
    const fbm_kernel *const *last = fbm_kernels();
    while (last[1])
        last++;
    assert_string_equal((*last)->name, "plain");
}

/* Where the number of strips changes; exact scratch, so that a sanitizer sees a step outside. */
static void scratchSufficesForEveryWidth(void **state)
{
    (void)state;
    for (size_t width = 1; width<12400; width += width % 4096> 4090 || width % 4096 < 6 ? 1 : 40) {
        assert_true(fbm_refine_scratch(width + 1) >= fbm_refine_scratch(width));
        assert_true(fbm_refine_scratch(width) <= 46000);
        for (int64_t i = 0; i < 2; i++) {
            fbm_step step = make_step(fbm_schemes, 0.5, 1);
            fbm_window to = {i, 0, width, 2, width}, from = fbm_refine_support(step.scheme, to);
            fbm_window end = {i + (int64_t)width - 1, 0, 1, 2, 1}, need = fbm_refine_support(step.scheme, end);
            float *in = make_heights(from), *out = refine(best(), &step, in, from, to);
            float *part = cut(in, from, need), *last = refine(best(), &step, part, need, end);
            assert_part(last, end, out, to);
            free(in), free(out), free(part), free(last);
        }
    }
}

static void centresEqualTheOddSamples(void **state)
{
    (void)state;
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++)
        for (int k = 0; k < 12 && !scheme->cells; k++) {
            fbm_step step = make_step(scheme, 0.5, k % 3 ? 3 : 0);
            size_t width = k == 7 ? 5000 : 1 + arbitrary(40), height = 1 + arbitrary(30);
            fbm_window cells = {(int64_t)arbitrary(20) - 10, (int64_t)arbitrary(20) - 10, width, height, width + 3};
            fbm_window fine = {2 * cells.i, 2 * cells.j, 2 * width, 2 * height, 2 * width};
            fbm_window from = fbm_refine_support(scheme, fine), need = fbm_centres_support(scheme, cells);
            float *in = make_heights(from), *all = refine(best(), &step, in, from, fine), *part = cut(in, from, need);
            float *found = allocate(samples(cells)), *scratch = allocate(fbm_refine_scratch(2 * width));
            fbm_centres(&step, part, need, found, cells, scratch);
            for (size_t y = 0; y < height; y++)
                for (size_t x = 0; x < width; x++)
                    assert_true(found[y * cells.stride + x] == all[(2 * y + 1) * fine.stride + 2 * x + 1]);
            free(in), free(all), free(part), free(found), free(scratch);
        }
}

static void verticesKeepTheirHeights(void **state)
{
    (void)state;
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++) {
        if (scheme->moves)
            continue;
        fbm_step step = make_step(scheme, 0.1, 500);
        fbm_window to = {-7, -4, 55, 41, 55}, from = fbm_refine_support(scheme, to);
        float *in = make_heights(from), *out = refine(best(), &step, in, from, to);
        for (int64_t j = -4; j < 37; j += 2)
            for (int64_t i = -6; i < 48; i += 2)
                assert_true(out[(j + 4) * 55 + i + 7] ==
                            in[(size_t)(j / 2 - from.j) * from.stride + (size_t)(i / 2 - from.i)]);
        free(in), free(out);
    }
}

/* Memory between the rows of a window is not the kernel's. */
static void gapsBetweenRowsAreLeftAlone(void **state)
{
    (void)state;
    fbm_step step = make_step(fbm_schemes, 0.4, 1);
    fbm_window to = {1, 1, 30, 9, 37}, from = fbm_refine_support(step.scheme, to);
    float *in = make_heights(from), *out = allocate(samples(to)), *scratch = allocate(fbm_refine_scratch(to.width));
    for (size_t k = 0; k < samples(to); k++)
        out[k] = 4711;
    fbm_refine(&step, in, from, out, to, scratch);
    for (size_t y = 0; y < to.height; y++)
        for (size_t x = to.width; x < to.stride; x++)
            assert_true(out[y * to.stride + x] == 4711);
    free(in), free(out), free(scratch);
}

/* Weights are symmetric and sum to 1 within 1e-8, so a plane is kept to rounding: at most 12 roundings of relative size
 * 2^-24 on the way of a term, terms that weigh sum |w| < 2.2 in all, and the error of the centres, which the edges see,
 * on top. */
static void smoothRefinementKeepsPlanes(void **state)
{
    (void)state;
    static const double planes[][3] = {{4000, 0, 0}, {-200, 0.25, -0.75}, {0, 3, 17}, {8848, -100, 55}};
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++)
        for (size_t k = 0; k < sizeof planes / sizeof *planes; k++)
            for (double hurst = 0.01; hurst < 1; hurst += 0.14) {
                const double *p = planes[k];
                fbm_step step = make_step(scheme, hurst, 0);
                fbm_window to = {-11, -10, 40, 40, 40}, from = fbm_refine_support(scheme, to);
                float *in = allocate(samples(from));
                double largest = 0;
                for (size_t n = 0; n < samples(from); n++) {
                    double i = (double)from.i + (double)(n % from.width), j = (double)from.j + (double)(n / from.width);
                    in[n] = (float)(p[0] + p[1] * i + p[2] * j);
                    largest = fmax(largest, fabs((double)in[n]));
                }
                double shift = scheme->cells ? .5 : 0; /* children lie a quarter of a cell off their cell */
                float *out = refine(best(), &step, in, from, to);
                double bound = largest * (12 * 0x1p-24 * 2.2 + 2e-8) * (1 + 2.2);
                for (int y = 0; y < 40; y++)
                    for (int x = 0; x < 40; x++)
                        assert_true(fabs((double)out[y * 40 + x] -
                                         (p[0] + p[1] * (x - 11 - shift) / 2 + p[2] * (y - 10 - shift) / 2)) <= bound);
                free(in), free(out);
            }
}

/* Powers of two scale without rounding. */
static void noiseIsProportionalToTheAmplitude(void **state)
{
    (void)state;
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++) {
        fbm_window to = {3, 4, 77, 50, 77}, from = fbm_refine_support(scheme, to);
        float *in = allocate(samples(from));
        memset(in, 0, samples(from) * sizeof *in);
        fbm_step one = make_step(scheme, 0.7, 1), eighth = make_step(scheme, 0.7, 0.125F);
        float *a = refine(best(), &one, in, from, to), *b = refine(best(), &eighth, in, from, to);
        int differ = 0;
        for (size_t k = 0; k < samples(to); k++) {
            assert_true(a[k] == 8 * b[k]);
            differ += a[k] != 0;
        }
        assert_true(differ > 77 * 50 * 3 / 4 - 200);
        free(in), free(a), free(b);
    }
}

/* Seed and level are keys: the noise differs; so do the three kinds of points and the four corners of a large window.
 */
static void otherSeedsAndLevelsGiveOtherNoise(void **state)
{
    (void)state;
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++) {
        fbm_window to = {0, 0, 41, 41, 41}, from = fbm_refine_support(scheme, to);
        float *in = make_heights(from);
        fbm_step steps[3] = {make_step(scheme, 0.7, 9), make_step(scheme, 0.7, 9), make_step(scheme, 0.7, 9)};
        steps[1].seed++;
        steps[2].level++;
        float *a = refine(best(), &steps[0], in, from, to);
        for (int k = 1; k < 3; k++) {
            float *b = refine(best(), &steps[k], in, from, to);
            for (size_t n = 0; n < samples(to); n++)
                assert_true((a[n] == b[n]) == (!scheme->moves && n % 41 % 2 == 0 && n / 41 % 2 == 0));
            free(b);
        }
        free(in), free(a);
    }
}

/* With a filter of one tap and no predictor, the noise shows as it is: that of the new vertex's own cell or edge. */
static void noiseIsKeyedByLatticeCoordinates(void **state)
{
    (void)state;
    const fbm_window to = {-6, 2, 700, 30, 700};
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++) {
        if (scheme->moves)
            continue;
        fbm_window from = fbm_refine_support(scheme, to);
        float *in = allocate(samples(from));
        memset(in, 0, samples(from) * sizeof *in);
        fbm_step step = {.scheme = scheme, .amplitude = 1, .seed = 31, .level = -2};
        step.weights.centre_taps[0] = step.weights.edge_taps[0] = step.weights.column_tap = 1;
        float *out = refine(best(), &step, in, from, to);
        for (int j = 1; j < 16; j++) {
            float centres[350], rows[350], columns[350];
            const float *even = out + (2 * j - 2) * 700, *odd = even + 700;
            fbm_noise_row(31, -2, FBM_NOISE_CENTRES, j, -3, 350, centres);
            fbm_noise_row(31, -2, FBM_NOISE_ROW_EDGES, j, -3, 350, rows);
            fbm_noise_row(31, -2, FBM_NOISE_COLUMN_EDGES, j, -3, 350, columns);
            for (int i = 0; i < 350; i++)
                assert_true(even[2 * i + 1] == rows[i] && odd[2 * i] == columns[i] && odd[2 * i + 1] == centres[i]);
        }
        free(in), free(out);
    }
}

/* Variance of the noise on centres and on edges against fbm_weights_residual. The estimate from n values has the
 * standard error sqrt(2 k / n), k = 1 + 2 sum of squared correlations between neighbours < 1.2 for these filters. */
static void noiseHasTheStatedVariance(void **state)
{
    (void)state;
    enum { SIDE = 512 };
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++) {
        if (scheme->moves)
            continue;
        fbm_window to = {0, 0, SIDE, SIDE, SIDE}, from = fbm_refine_support(scheme, to);
        float *in = allocate(samples(from));
        memset(in, 0, samples(from) * sizeof *in);
        fbm_step step = make_step(scheme, 0.45, 2);
        double expected[2], sums[2] = {0}, error = sqrt(2 * 1.2 / (SIDE * SIDE / 4));
        fbm_weights_residual(&step.weights, &expected[0], &expected[1]);
        memset(step.weights.edge, 0, sizeof step.weights.edge); /* so that edges do not see the centres' noise */
        float *out = refine(best(), &step, in, from, to);
        for (int y = 0; y < SIDE; y++)
            for (int x = 0; x < SIDE; x++) {
                double z = (double)out[y * SIDE + x];
                if (x % 2 && y % 2)
                    sums[0] += z * z;
                else if (x % 2 || y % 2)
                    sums[1] += z * z / 2;
            }
        assert_true(fabs(sums[0] / (SIDE * SIDE / 4) / (4 * expected[0] * expected[0]) - 1) < 4.5 * error);
        assert_true(fabs(sums[1] / (SIDE * SIDE / 4) / (4 * expected[1] * expected[1]) - 1) < 4.5 * error);
        free(in), free(out);
    }
}

static void squareTakesMeansOfCornersAndEnds(void **state)
{
    (void)state;
    fbm_step step = make_step(fbm_scheme_find("square"), 0.5, 0);
    const float in[9] = {1, 2, 4, 8, 16, 32, 64, 128, 256};
    const float expected[9] = {1, 1.5F, 2, 4.5F, 6.75F, 9, 8, 12, 16};
    float all[25] = {0}, out[9], scratch[4096];
    for (int y = 0; y < 3; y++)
        memcpy(all + (y + 1) * 5 + 1, in + 3 * y, 3 * sizeof *in);
    assert_true(fbm_refine_scratch(3) <= 4096);
    fbm_refine(&step, all, (fbm_window){-1, -1, 5, 5, 5}, out, (fbm_window){0, 0, 3, 3, 3}, scratch);
    assert_memory_equal(out, expected, sizeof out);
}

/* A void (NaN) reaches 4 cells far and no farther, and every new sample next to it. */
static void voidsSpreadOverTheStencilOnly(void **state)
{
    (void)state;
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++) {
        if (scheme->cells)
            continue;
        fbm_step step = make_step(scheme, 0.5, 1);
        fbm_window to = {-20, -20, 41, 41, 41}, from = fbm_refine_support(scheme, to);
        float *in = make_heights(from);
        in[(size_t)-from.j * from.stride + (size_t)-from.i] = NAN;
        float *out = refine(best(), &step, in, from, to);
        for (int y = -20; y <= 20; y++)
            for (int x = -20; x <= 20; x++) {
                bool is_void = isnan(out[(y + 20) * 41 + x + 20]), vertex = x % 2 == 0 && y % 2 == 0;
                if (vertex || abs(x) > 2 * scheme->margin || abs(y) > 2 * scheme->margin)
                    assert_int_equal(is_void, x == 0 && y == 0);
                else if (abs(x) <= 1 && abs(y) <= 1)
                    assert_true(is_void);
            }
        free(in), free(out);
    }
}

static void supportIsAHaloThatConverges(void **state)
{
    (void)state;
    /* ceil(halo / 2) + 4 on the near side, floor(halo / 2) + 4 on the far one: 8 and 7 after a few levels, for any tile
     */
    fbm_window window = {-64, 192, 65, 257, 65};
    int64_t shrunk_i = -64, shrunk_j = 192;
    for (int l = 0; l < 6; l++) {
        window = fbm_refine_support(fbm_schemes, window);
        shrunk_i /= 2;
        shrunk_j /= 2;
    }
    assert_int_equal(window.i, shrunk_i - 8);
    assert_int_equal(window.j, shrunk_j - 8);
    assert_int_equal(window.width, 1 + 1 + 8 + 7);
    assert_int_equal(window.height, 4 + 1 + 8 + 7);
    window = fbm_centres_support(fbm_schemes, (fbm_window){5, -5, 3, 4, 3});
    assert_int_equal(window.i, 3);
    assert_int_equal(window.j, -7);
    assert_int_equal(window.width, 8);
    assert_int_equal(window.height, 9);
}

/* A factor of 2 everywhere is the double amplitude, bit for bit; a varying map gives each sample what its own vertices
 * say, whatever the window; on every instruction set. */
static void mapsScaleTheNoise(void **state)
{
    (void)state;
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++) {
        fbm_window to = {-5, 3, 61, 40, 61}, from = fbm_refine_support(scheme, to);
        fbm_step step = make_step(scheme, .6, 3), twice = make_step(scheme, .6, 6);
        float *in = make_heights(from), *map = allocate(samples(from));
        for (size_t k = 0; k < samples(from); k++)
            map[k] = 2;
        float *mapped = refine_mapped(best(), &step, in, map, from, to), *plain = refine(best(), &twice, in, from, to);
        assert_memory_equal(mapped, plain, samples(to) * sizeof *plain);
        free(mapped);
        free(plain);
        for (size_t k = 0; k < samples(from); k++)
            map[k] = (float)arbitrary(1000) / 100;
        float *whole = refine_mapped(best(), &step, in, map, from, to);
        for (const fbm_kernel *const *kernel = fbm_kernels(); *kernel; kernel++) {
            fbm_window part = {to.i + 7, to.j + 5, 30, 22, 30};
            float *some = refine_mapped(*kernel, &step, in, map, from, part);
            for (size_t r = 0; r < part.height; r++)
                assert_memory_equal(some + r * 30, whole + (r + 5) * 61 + 7, 30 * sizeof *some);
            free(some);
        }
        free(whole);
        free(in);
        free(map);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(mapsScaleTheNoise),
        cmocka_unit_test(windowsEqualTheWholeBitForBit),
        cmocka_unit_test(everyKernelRefinesToTheSameBits),
        cmocka_unit_test(scratchSufficesForEveryWidth),
        cmocka_unit_test(centresEqualTheOddSamples),
        cmocka_unit_test(verticesKeepTheirHeights),
        cmocka_unit_test(gapsBetweenRowsAreLeftAlone),
        cmocka_unit_test(smoothRefinementKeepsPlanes),
        cmocka_unit_test(noiseIsProportionalToTheAmplitude),
        cmocka_unit_test(otherSeedsAndLevelsGiveOtherNoise),
        cmocka_unit_test(noiseIsKeyedByLatticeCoordinates),
        cmocka_unit_test(noiseHasTheStatedVariance),
        cmocka_unit_test(squareTakesMeansOfCornersAndEnds),
        cmocka_unit_test(voidsSpreadOverTheStencilOnly),
        cmocka_unit_test(supportIsAHaloThatConverges),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
