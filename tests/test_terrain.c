/* Terrain's detail: means, windows, instruction sets, calibration. */
#include "fbm/relief_kernel.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/scene/roughness.h"
#include "lib/scene/terrain.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "tests/near.h"

static uint32_t arbitrary_state = 77;

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

static fbm_relief_step make_step(void)
{
    return (fbm_relief_step){.children_x = 4,
                             .children_y = 6,
                             .gains = {2, 3, 1},
                             .steer = 1.3f,
                             .steer_slope2 = .2f,
                             .level = 5,
                             .level_slope = .4f,
                             .limit = .3f,
                             .seed = 5,
                             .octave = 2};
}

typedef struct cells {
    fbm_window window;
    float *heights, *energy;
} cells;

static cells make_cells(fbm_window window)
{
    cells c = {window, allocate(window.stride * window.height), allocate(window.stride * window.height)};
    for (size_t k = 0; k < window.stride * window.height; k++) {
        c.heights[k] = (float)arbitrary(1 << 16) / 512;
        c.energy[k] = (float)(1 + arbitrary(1000)) / 500;
    }
    return c;
}

static void free_cells(cells c)
{
    free(c.heights);
    free(c.energy);
}

static float *refine(size_t kernel, const fbm_relief_step *step, cells in, fbm_window children, float *energy)
{
    float *out = allocate(children.stride * children.height);
    float *scratch = allocate(fbm_relief_scratch(children.width));
    fbm_relief_kernels()[kernel]->refine(fbm_kernels()[kernel], step, in.heights, in.energy, in.window, out, energy,
                                         children, scratch);
    free(scratch);
    return out;
}

/* A mean of four floats, each rounded once or twice at a magnitude below 512: to 8 of their last places. */
static void childrenHaveTheMeanOfTheirCell(void **state)
{
    (void)state;
    const fbm_relief_step step = make_step();
    fbm_window children = {-6, 4, 48, 36, 48};
    cells in = make_cells(fbm_relief_support(children));
    float *out = refine(0, &step, in, children, NULL);
    double moved = 0;
    for (size_t y = 0; y < 36; y += 2)
        for (size_t x = 0; x < 48; x += 2) {
            const float *z = out + y * 48 + x;
            double mean = ((double)z[0] + (double)z[1] + (double)z[48] + (double)z[49]) / 4;
            double cell =
                (double)in.heights[(y / 2 + FBM_RELIEF_MARGIN) * in.window.stride + x / 2 + FBM_RELIEF_MARGIN];
            assert_near(mean, cell, 8 * 512 * 0x1p-24);
            moved += fabs((double)z[0] - cell);
        }
    assert_true(moved > 100); /* there is detail */
    free(out);
    free_cells(in);
}

static void windowsOfChildrenEqualTheWhole(void **state)
{
    (void)state;
    const fbm_relief_step step = make_step();
    fbm_window whole = {-9, -21, 61, 45, 61};
    cells in = make_cells(fbm_relief_support(whole));
    float *energy = allocate(whole.stride * whole.height), *all = refine(0, &step, in, whole, energy);
    for (int round = 0; round < 60; round++) {
        uint32_t x = arbitrary(61), y = arbitrary(45);
        fbm_window w = {whole.i + x, whole.j + y, 1 + arbitrary(61 - x), 1 + arbitrary(45 - y), 0};
        w.stride = w.width + arbitrary(3);
        float *part_energy = allocate(w.stride * w.height), *part = refine(0, &step, in, w, part_energy);
        for (size_t r = 0; r < w.height; r++) {
            assert_memory_equal(part + r * w.stride, all + (y + r) * 61 + x, w.width * sizeof *part);
            assert_memory_equal(part_energy + r * w.stride, energy + (y + r) * 61 + x, w.width * sizeof *part);
        }
        free(part);
        free(part_energy);
    }
    free(all);
    free(energy);
    free_cells(in);
}

static void instructionSetsGiveTheSameBits(void **state)
{
    (void)state;
    const fbm_relief_step step = make_step();
    fbm_window children = {3, 5, 131, 67, 131};
    cells in = make_cells(fbm_relief_support(children));
    float *best = refine(0, &step, in, children, NULL);
    for (size_t k = 1; fbm_relief_kernels()[k]; k++) {
        float *other = refine(k, &step, in, children, NULL);
        assert_memory_equal(best, other, 131 * 67 * sizeof *best);
        free(other);
    }
    free(best);
    fbm_window out = {0, 0, in.window.width - 2 * FBM_ENERGY_MARGIN, in.window.height - 2 * FBM_ENERGY_MARGIN, 0};
    out.i = in.window.i + FBM_ENERGY_MARGIN;
    out.j = in.window.j + FBM_ENERGY_MARGIN;
    out.stride = out.width;
    float *a = allocate(out.width * out.height), *b = allocate(out.width * out.height);
    float *scratch = allocate(fbm_energy_scratch(out.width, out.height));
    fbm_relief_kernels()[0]->energy(in.heights, in.window, a, out, scratch);
    for (size_t k = 1; fbm_relief_kernels()[k]; k++) {
        fbm_relief_kernels()[k]->energy(in.heights, in.window, b, out, scratch);
        assert_memory_equal(a, b, out.width * out.height * sizeof *a);
    }
    free(a);
    free(b);
    free(scratch);
    free_cells(in);
}

/* Around a globe of 40 cells, the children come again after 80. */
static void noiseComesAgainAfterItsPeriod(void **state)
{
    (void)state;
    fbm_relief_step step = make_step();
    step.period = 40;
    fbm_window children = {-7, 0, 110, 10, 110};
    cells in = make_cells(fbm_relief_support(children));
    for (size_t r = 0; r < in.window.height; r++)
        for (size_t c = 40; c < in.window.width; c++) {
            in.heights[r * in.window.stride + c] = in.heights[r * in.window.stride + c - 40];
            in.energy[r * in.window.stride + c] = in.energy[r * in.window.stride + c - 40];
        }
    float *out = refine(0, &step, in, children, NULL);
    for (size_t r = 0; r < 10; r++)
        assert_memory_equal(out + r * 110, out + r * 110 + 80, 30 * sizeof *out);
    free(out);
    free_cells(in);
}

/* White noise of variance 1/12 keeps .279 + .277 + .310 of it (rounded shares of Haar details about the prediction, by
 * fbm_detail_variance). The mean over 200^2 cells of a smoothed square varies by about 1 %. */
static void energyIsThatOfTheDetails(void **state)
{
    (void)state;
    enum { SIDE = 200 };
    fbm_window out = {0, 0, SIDE, SIDE, SIDE}, in = scene_widened(out, FBM_ENERGY_MARGIN);
    float *z = allocate(in.width * in.height), *energy = allocate(SIDE * SIDE);
    float *scratch = allocate(fbm_energy_scratch(SIDE, SIDE));
    for (size_t k = 0; k < in.width * in.height; k++)
        z[k] = (float)arbitrary(1 << 20) / (1 << 20);
    fbm_relief_energy(z, in, energy, out, scratch);
    double sum = 0;
    for (size_t k = 0; k < SIDE * SIDE; k++)
        sum += (double)energy[k];
    const fbm_detail white = {.x = 0, .y = 0, .mixed = 1, .count = 1};
    double share = 1 - fbm_detail_variance(&white, 0, .5); /* of a variance of .5, little enough to leave a quarter */
    assert_near(sum / (SIDE * SIDE), 2 * share / 12, .03 * 2 * share / 12);
    free(z);
    free(energy);
    free(scratch);
}

static void energyLeavesOutWhatIsNotKnown(void **state)
{
    (void)state;
    enum { SIDE = 60 };
    fbm_window out = {0, 0, SIDE, SIDE, SIDE}, in = scene_widened(out, FBM_ENERGY_MARGIN);
    float *z = allocate(in.width * in.height), *before = allocate(SIDE * SIDE), *after = allocate(SIDE * SIDE);
    float *scratch = allocate(fbm_energy_scratch(SIDE, SIDE));
    for (size_t k = 0; k < in.width * in.height; k++)
        z[k] = (float)arbitrary(1 << 20) / (1 << 10);
    fbm_relief_energy(z, in, before, out, scratch);
    for (size_t r = 0; r < in.height; r++)
        for (size_t c = in.width - 20; c < in.width; c++)
            z[r * in.width + c] = NAN;
    fbm_relief_energy(z, in, after, out, scratch);
    for (size_t r = 0; r < SIDE; r++)
        for (size_t c = 0; c < SIDE; c++) {
            /* the voids begin at column 55: cells that see them are those from 55 - 15 on */
            assert_true(after[r * SIDE + c] > 0 || isnan(after[r * SIDE + c]));
            if (c < 40)
                assert_memory_equal(&before[r * SIDE + c], &after[r * SIDE + c], sizeof *after);
            if (c < 50)
                assert_false(isnan(after[r * SIDE + c]));
        }
    free(z);
    free(before);
    free(after);
    free(scratch);
}

/* ---- calibrated on a raster ---- */

enum { WIDTH = 300, HEIGHT = 260 };

typedef struct raster {
    float *heights;
    tl_source *source;
} raster;

/* Hills that get rougher towards the east, of three octaves of noise. */
static raster make_raster(int64_t width, int64_t height, float scale)
{
    raster r = {tl_alloc_grid(width, height, sizeof(float)), NULL};
    assert_non_null(r.heights);
    float *rows[3] = {allocate((size_t)width + 8), allocate((size_t)width + 8), allocate((size_t)width + 8)};
    for (int64_t y = 0; y < height; y++) {
        for (int o = 0; o < 3; o++)
            fbm_noise_row(9, o, FBM_NOISE_CELLS, y >> (2 - o), 0, (size_t)width + 8, rows[o]);
        for (int64_t x = 0; x < width; x++) {
            double hills = 40 * sin((double)x / 11) * cos((double)y / 13);
            double rough = .2 + 2 * (double)x / (double)width;
            r.heights[y * width + x] =
                scale * (float)(hills + rough * (double)(4 * rows[0][x >> 2] + 2 * rows[1][x >> 1] + rows[2][x]));
        }
    }
    for (int o = 0; o < 3; o++)
        free(rows[o]);
    tl_source_info info = {.width = width, .height = height, .georef = tl_georef_none(), .name = "hills"};
    info.georef.cell_x = info.georef.cell_y = 10;
    r.source = tl_array_source_create(r.heights, &info, NULL);
    assert_non_null(r.source);
    return r;
}

static void free_raster(raster r)
{
    tl_source_destroy(r.source);
    free(r.heights);
}

static float *read_whole(const tl_source *s)
{
    float *out = tl_alloc_grid(s->info.width, s->info.height, sizeof *out);
    assert_non_null(out);
    assert_int_equal(tl_source_read(s, s->info.level, (tl_window){0, 0, s->info.width, s->info.height}, out, NULL),
                     TL_OK);
    return out;
}

/* The octave below the samples has the variance that was predicted for it. It is calibrated on samples of the raster,
 * and pits take some of it, so to a seventh of sigma. */
static void octavesGetTheirVariance(void **state)
{
    (void)state;
    raster r = make_raster(WIDTH, HEIGHT, 1);
    tl_roughness dem, made;
    assert_int_equal(tl_roughness_measure(r.source, NULL, &dem, NULL), TL_OK);
    scene_octave octaves[1];
    scene_predict_octaves(&dem, &r.source->info.georef, octaves, 1);
    tl_source *field = tl_field_create(r.source, &(tl_field_options){.levels = 1, .scheme = "terrain"}, NULL);
    assert_non_null(field);
    assert_int_equal(tl_roughness_measure(field, NULL, &made, NULL), TL_OK);
    assert_near(made.sigma, octaves[0].sigma, octaves[0].sigma / 7);
    tl_source_destroy(field);
    free_raster(r);
}

/* The detail is stronger where the raster is rougher: of means and of points. */
static void check_place(tl_raster_type type)
{
    raster r = make_raster(WIDTH, HEIGHT, 1);
    r.source->info.type = type;
    tl_source *field = tl_field_create(r.source, &(tl_field_options){.levels = 2, .scheme = "terrain"}, NULL);
    assert_non_null(field);
    float *z = read_whole(field);
    double energy[2] = {0, 0};
    int64_t width = field->info.width;
    for (int64_t y = 0; y + 1 < field->info.height; y += 2)
        for (int64_t x = 0; x + 1 < width; x += 2) {
            const float *a = z + y * width + x;
            double mixed = (double)a[0] - (double)a[1] - (double)a[width] + (double)a[width + 1];
            if (x < width / 4 || x >= 3 * width / 4)
                energy[x >= width / 2] += mixed * mixed;
        }
    assert_true(energy[1] > 4 * energy[0]);
    free(z);
    tl_source_destroy(field);
    free_raster(r);
}

static void detailFollowsTheRoughnessOfThePlace(void **state)
{
    (void)state;
    check_place(TL_RASTER_AREA);
    check_place(TL_RASTER_POINT);
}

/* In the middle of the raster a membrane is much smoother than the hills; its detail is not. */
static void filledVoidsGetTheDetailAround(void **state)
{
    (void)state;
    raster r = make_raster(WIDTH, HEIGHT, 1);
    for (int64_t y = 110; y < 130; y++)
        for (int64_t x = 140; x < 160; x++)
            r.heights[y * WIDTH + x] = NAN;
    r.source->info.has_voids = true;
    tl_source *full = tl_voids_create(r.source, &(tl_void_options){.rule = TL_VOIDS_FILL}, NULL);
    tl_source *field = tl_field_create(full, &(tl_field_options){.levels = 1, .scheme = "terrain"}, NULL);
    assert_non_null(field);
    float *z = read_whole(field);
    double inside = 0, around = 0;
    int64_t width = field->info.width;
    for (int64_t y = 2 * 90; y < 2 * 150; y += 2)
        for (int64_t x = 2 * 120; x < 2 * 180; x += 2) {
            const float *a = z + y * width + x;
            double mixed = (double)a[0] - (double)a[1] - (double)a[width] + (double)a[width + 1];
            bool in = y >= 2 * 112 && y < 2 * 128 && x >= 2 * 142 && x < 2 * 158;
            *(in ? &inside : &around) += mixed * mixed / (in ? 16 * 16 : 60 * 60 - 16 * 16);
        }
    assert_true(inside > .2 * around);
    free(z);
    tl_source_destroy(field);
    tl_source_destroy(full);
    free_raster(r);
}

static void threadsAndScalesDoNotMatter(void **state)
{
    (void)state;
    raster r = make_raster(WIDTH, HEIGHT, 1);
    const tl_run one = {.threads = 1}, three = {.threads = 3};
    tl_source *a = tl_field_create(r.source, &(tl_field_options){.levels = 2, .run = &one}, NULL);
    tl_source *b = tl_field_create(r.source, &(tl_field_options){.levels = 2, .run = &three}, NULL);
    float *za = read_whole(a), *zb = read_whole(b);
    assert_memory_equal(za, zb, (size_t)(a->info.width * a->info.height) * sizeof *za);
    free(za);
    free(zb);
    tl_source_destroy(a);
    tl_source_destroy(b);
    free_raster(r);
}

/* Rasters of every awkward size, and heights at the ends of what is taken: nothing but finite heights comes out, with
 * the means of the cells to the floats' precision. */
static void extremeRastersGiveFiniteHeights(void **state)
{
    (void)state;
    const int64_t sizes[][2] = {{1, 1}, {1, 40}, {40, 1}, {2, 2}, {7, 5}, {33, 70}};
    const float scales[] = {0, 1e-38f, 1e-6f, 1, 1e6f, 1e28f};
    for (size_t s = 0; s < sizeof sizes / sizeof *sizes; s++)
        for (size_t k = 0; k < sizeof scales / sizeof *scales; k++) {
            raster r = make_raster(sizes[s][0], sizes[s][1], scales[k]);
            tl_source *field = tl_field_create(r.source, &(tl_field_options){.levels = 3, .scheme = "terrain"}, NULL);
            assert_non_null(field);
            float *z = read_whole(field);
            for (int64_t j = 0; j < field->info.width * field->info.height; j++)
                if (!isfinite(z[j]))
                    fail_msg("size %d, scale %g: not finite at %d", (int)s, (double)scales[k], (int)j);
            free(z);
            tl_source_destroy(field);
            free_raster(r);
        }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(childrenHaveTheMeanOfTheirCell),  cmocka_unit_test(windowsOfChildrenEqualTheWhole),
        cmocka_unit_test(instructionSetsGiveTheSameBits),  cmocka_unit_test(noiseComesAgainAfterItsPeriod),
        cmocka_unit_test(energyIsThatOfTheDetails),        cmocka_unit_test(energyLeavesOutWhatIsNotKnown),
        cmocka_unit_test(octavesGetTheirVariance),         cmocka_unit_test(detailFollowsTheRoughnessOfThePlace),
        cmocka_unit_test(threadsAndScalesDoNotMatter),     cmocka_unit_test(filledVoidsGetTheDetailAround),
        cmocka_unit_test(extremeRastersGiveFiniteHeights),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
