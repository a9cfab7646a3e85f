#define _GNU_SOURCE /* mkdtemp */
#include "dem/framework_kernel.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

#include "tests/grids.h"

static tl_pyramid *build(const grid *from, bool exact, unsigned threads)
{
    tl_source *source = open_grid(from);
    tl_run run = {.threads = threads};
    tl_error error = {0};
    tl_pyramid *pyramid = tl_pyramid_create(source, &(tl_pyramid_options){.exact = exact, .run = &run}, &error);
    tl_source_destroy(source);
    if (!pyramid)
        fail_msg("%s", error.text);
    return pyramid;
}

static tl_framework *choose(const tl_pyramid *pyramid, const grid *from, tl_selection selection)
{
    tl_source *source = open_grid(from);
    tl_error error = {0};
    tl_framework *framework = tl_framework_from_pyramid(pyramid, source, &selection, &error);
    tl_source_destroy(source);
    if (!framework)
        fail_msg("%s", error.text);
    return framework;
}

static tl_mesh *draw(const tl_framework *framework)
{
    tl_mesh *mesh = NULL;
    tl_error error = {0};
    if (tl_framework_mesh(framework, &mesh, &error) != TL_OK)
        fail_msg("%s", error.text);
    return mesh;
}

/* ---- The definition ---------------------------------------------------------------------------------- */

typedef struct naive {
    const grid *of;
    int size; /* of the virtual lattice, a power of two */
    double *errors;
    bool changed;
} naive;

typedef struct place {
    int x, y;
} place;

static double *error_at(const naive *self, place at)
{
    return &self->errors[(size_t)at.y * (size_t)(self->size + 1) + (size_t)at.x];
}

/* -1 outside, 0 inside, 1 over the rim. */
static int naive_side(const naive *self, place a, place b, place c)
{
    int right = self->of->width - 1, bottom = self->of->height - 1;
    if (a.x <= right && b.x <= right && c.x <= right && a.y <= bottom && b.y <= bottom && c.y <= bottom)
        return 0;
    if ((a.x >= right && b.x >= right && c.x >= right) || (a.y >= bottom && b.y >= bottom && c.y >= bottom))
        return -1;
    if (abs(a.x - b.x) <= 1 && abs(a.y - b.y) <= 1)
        return -1;
    place m = {(a.x + b.x) / 2, (a.y + b.y) / 2};
    return naive_side(self, c, a, m) >= 0 || naive_side(self, b, c, m) >= 0 ? 1 : -1;
}

static long area2(place a, place b, long x, long y)
{
    return (long)(b.x - a.x) * (y - a.y) - (long)(b.y - a.y) * (x - a.x);
}

static double height_of(const naive *self, place at)
{
    return (double)self->of->z[at.y * self->of->width + at.x];
}

/* The largest distance of a sample from the triangle; infinite if it is mixed, 0 if it is void. */
static double naive_distance(const naive *self, place a, place b, place c)
{
    int x0 = (int)fmin(fmin(a.x, b.x), c.x), x1 = (int)fmax(fmax(a.x, b.x), c.x);
    int y0 = (int)fmin(fmin(a.y, b.y), c.y), y1 = (int)fmax(fmax(a.y, b.y), c.y);
    long whole = area2(a, b, c.x, c.y);
    size_t valid = 0, all = 0;
    double worst = 0;
    for (int y = y0; y <= y1; y++)
        for (int x = x0; x <= x1; x++) {
            long wa = area2(b, c, x, y), wb = area2(c, a, x, y), wc = area2(a, b, x, y);
            if (wa > 0 || wb > 0 || wc > 0)
                continue;
            double z = height_of(self, (place){x, y});
            double plane =
                (double)wa * height_of(self, a) + (double)wb * height_of(self, b) + (double)wc * height_of(self, c);
            all++;
            valid += !isnan(z);
            worst = fmax(worst, fabs(plane / (double)whole - z));
        }
    return valid == 0 ? 0 : valid < all ? HUGE_VAL : worst;
}

static void naive_measure(naive *self, place a, place b, place c)
{
    int side = naive_side(self, a, b, c);
    if (side < 0 || (abs(a.x - b.x) <= 1 && abs(a.y - b.y) <= 1))
        return;
    place m = {(a.x + b.x) / 2, (a.y + b.y) / 2};
    double *to = error_at(self, m);
    *to = fmax(*to, side > 0 ? HUGE_VAL : naive_distance(self, a, b, c));
    naive_measure(self, c, a, m);
    naive_measure(self, b, c, m);
}

/* One pass of the rule that a vertex has at least the error of those below; `c` splits the parent. */
static void naive_saturate(naive *self, place a, place b, place c, bool root)
{
    if (naive_side(self, a, b, c) < 0 || (abs(a.x - b.x) <= 1 && abs(a.y - b.y) <= 1))
        return;
    place m = {(a.x + b.x) / 2, (a.y + b.y) / 2};
    naive_saturate(self, c, a, m, false);
    naive_saturate(self, b, c, m, false);
    if (!root && *error_at(self, m) > *error_at(self, c)) {
        *error_at(self, c) = *error_at(self, m);
        self->changed = true;
    }
}

static naive naive_build(const grid *of)
{
    naive self = {.of = of, .size = 1};
    while (self.size < of->width - 1 || self.size < of->height - 1)
        self.size *= 2;
    self.errors = calloc((size_t)(self.size + 1) * (size_t)(self.size + 1), sizeof *self.errors);
    place nw = {0, 0}, ne = {self.size, 0}, sw = {0, self.size}, se = {self.size, self.size};
    naive_measure(&self, nw, se, ne);
    naive_measure(&self, se, nw, sw);
    do {
        self.changed = false;
        naive_saturate(&self, nw, se, ne, true);
        naive_saturate(&self, se, nw, sw, true);
    } while (self.changed);
    return self;
}

/* The errors of the pyramid are those of the definition: as floats, rounded up; as codes, to four bits of mantissa. */
static void check_errors(const grid *of, const tl_pyramid *pyramid, bool exact)
{
    naive expected = naive_build(of);
    for (int y = 0; y < of->height; y++)
        for (int x = 0; x < of->width; x++) {
            double want = *error_at(&expected, (place){x, y}), found = tl_pyramid_error(pyramid, x, y);
            double most = exact ? want * (1 + 0x1p-23) : fmax(want * (1 + 1.0 / 16), want > 0 ? 1e-2 : 0);
            if (!(found >= want && found <= most))
                fail_msg("%d x %d: the error of %d, %d is %.17g, not %.17g", of->width, of->height, x, y, found, want);
        }
    free(expected.errors);
}

/* ---- Tests --------------------------------------------------------------------------------------------- */

static void pyramidIsTheDefinitionOnRandomDems(void **state)
{
    (void)state;
    for (int round = 0; round < 200; round++) {
        random_state = (uint64_t)round * 7919 + 1;
        int width = 1 + random_below(70), height = 1 + random_below(70);
        grid of = make_grid(width, height, (terrain)(round % TERRAIN_WIDE), (voids)(round / TERRAINS % VOIDS_KINDS));
        tl_pyramid *pyramid = build(&of, round % 3, 1);
        check_errors(&of, pyramid, round % 3);
        tl_pyramid_destroy(pyramid);
        free(of.z);
    }
}

static const int border_sizes[][2] = {{256, 257}, {257, 257}, {258, 513}, {513, 258}, {514, 90}, {40, 600}, {600, 3}};

static void pyramidIsTheDefinitionAcrossBlocks(void **state)
{
    (void)state;
    for (size_t k = 0; k < sizeof border_sizes / sizeof *border_sizes; k++) {
        random_state = k + 77;
        grid of = make_grid(border_sizes[k][0], border_sizes[k][1], k % 2 ? TERRAIN_HILLS : TERRAIN_PLANE,
                            k % 3 == 2 ? VOIDS_BLOCKS : VOIDS_NONE);
        tl_pyramid *pyramid = build(&of, k % 2, 2);
        check_errors(&of, pyramid, k % 2);
        tl_pyramid_destroy(pyramid);
        free(of.z);
    }
}

/* Several levels above blocks. */
static void pyramidIsTheDefinitionAboveBlocks(void **state)
{
    (void)state;
    for (int round = 0; round < 2; round++) {
        random_state = (uint64_t)round + 5;
        grid of = make_grid(1025 + 300 * round, 1025, TERRAIN_EIGHTHS, VOIDS_NONE);
        tl_pyramid *pyramid = build(&of, true, 2);
        check_errors(&of, pyramid, true);
        tl_pyramid_destroy(pyramid);
        free(of.z);
    }
}

static void check_same(const tl_framework *a, const tl_framework *b)
{
    tl_mesh *p = draw(a), *q = draw(b);
    assert_int_equal(p->vertex_count, q->vertex_count);
    assert_int_equal(p->triangle_count, q->triangle_count);
    assert_memory_equal(p->vertices, q->vertices, p->vertex_count * sizeof *p->vertices);
    assert_memory_equal(p->indices, q->indices, 3 * p->triangle_count * sizeof *p->indices);
    tl_mesh_destroy(p);
    tl_mesh_destroy(q);
}

/* Bounds of four bits, for which codes are as good as floats. */
static void pyramidGivesTheFrameworkOfEveryBound(void **state)
{
    static const double bounds[] = {0, 0.25, 0.5, 1, 3, 10, 40, 1000};
    (void)state;
    for (size_t k = 0; k < 2 * sizeof border_sizes / sizeof *border_sizes; k++) {
        random_state = k;
        grid of = make_grid(border_sizes[k / 2][0], border_sizes[k / 2][1], k % 3 ? TERRAIN_HILLS : TERRAIN_EIGHTHS,
                            (voids)(k % VOIDS_KINDS));
        tl_pyramid *pyramid = build(&of, k % 2, 3);
        tl_source *source = open_grid(&of);
        for (size_t i = 0; i < sizeof bounds / sizeof *bounds; i++) {
            tl_framework *direct = tl_framework_build(source, &(tl_framework_options){.max_error = bounds[i]}, NULL);
            tl_framework *chosen = choose(pyramid, &of, (tl_selection){.max_error = bounds[i]});
            check_same(direct, chosen);
            assert_int_equal(tl_framework_isolated_count(direct), tl_framework_isolated_count(chosen));
            tl_framework_destroy(direct);
            tl_framework_destroy(chosen);
        }
        tl_source_destroy(source);
        tl_pyramid_destroy(pyramid);
        free(of.z);
    }
}

/* Whatever rounds, and whatever the bound: strict as tl_mesh_verify measures it. */
static void pyramidIsStrictForEveryBound(void **state)
{
    (void)state;
    for (int round = 0; round < 60; round++) {
        random_state = (uint64_t)round;
        grid of = make_grid(1 + random_below(300), 1 + random_below(90), (terrain)(round % TERRAINS),
                            (voids)(round % 7 ? VOIDS_NONE : VOIDS_FEW));
        tl_pyramid *pyramid = build(&of, round % 2, 1);
        tl_source *source = open_grid(&of);
        for (int i = 0; i < 6; i++) {
            double max_error = ldexp((double)random_below(1000), random_below(20) - 14);
            tl_framework *framework = choose(pyramid, &of, (tl_selection){.max_error = max_error});
            tl_mesh *mesh = draw(framework);
            tl_mesh_report report;
            assert_int_equal(tl_mesh_verify(mesh, source, NULL, &report, NULL), TL_OK);
            assert_true(report.max_error <= max_error);
            tl_mesh_destroy(mesh);
            tl_framework_destroy(framework);
        }
        tl_source_destroy(source);
        tl_pyramid_destroy(pyramid);
        free(of.z);
    }
}

static void check_nested(const grid *of, const tl_framework *small, const tl_framework *large)
{
    for (int y = 0; y < of->height; y++)
        for (int x = 0; x < of->width; x++)
            assert_true(!tl_framework_has_point(small, x, y) || tl_framework_has_point(large, x, y));
}

/* A budget of triangles is met to one split, one of vertices exactly, until everything is kept; larger budgets contain
 * smaller ones; and the bound that the framework tells is kept. */
static void budgetsAreExactAndNest(void **state)
{
    (void)state;
    for (int round = 0; round < 24; round++) {
        random_state = (uint64_t)round * 31 + 7;
        grid of = make_grid(40 + random_below(300), 40 + random_below(300), (terrain)(round % TERRAIN_WIDE),
                            round % 3 ? VOIDS_NONE : VOIDS_BLOCKS);
        tl_pyramid *pyramid = build(&of, round % 2, 2);
        tl_source *source = open_grid(&of);
        tl_framework *all = choose(pyramid, &of, (tl_selection){0}),
                     *least = choose(pyramid, &of, (tl_selection){.max_error = 1e30});
        tl_mesh *most = draw(all), *fewest = draw(least);
        bool vertices = round % 4 == 1;
        size_t low = vertices ? fewest->vertex_count : fewest->triangle_count;
        size_t high = vertices ? most->vertex_count : most->triangle_count;
        tl_framework *before = NULL;
        for (int i = 0; i <= 6; i++) {
            size_t budget = low + (high - low) * (size_t)i / 6 + (i == 6 ? 1000 : 0);
            tl_selection selection = {.triangles = vertices ? 0 : budget, .vertices = vertices ? budget : 0};
            tl_framework *framework = choose(pyramid, &of, selection);
            tl_mesh *mesh = draw(framework);
            size_t got = vertices ? mesh->vertex_count : mesh->triangle_count;
            assert_true(got <= budget);
            assert_true(i == 6 ? got == high : got + !vertices >= budget);
            tl_mesh_report report;
            assert_int_equal(tl_mesh_verify(mesh, source, NULL, &report, NULL), TL_OK);
            assert_true(report.max_error <= tl_framework_max_error(framework));
            if (before)
                check_nested(&of, before, framework);
            tl_framework_destroy(before);
            before = framework;
            tl_mesh_destroy(mesh);
        }
        tl_framework_destroy(before);
        if (low > 1) {
            tl_error error = {0};
            tl_selection little = {.triangles = vertices ? 0 : low - 1, .vertices = vertices ? low - 1 : 0};
            assert_null(tl_framework_from_pyramid(pyramid, source, &little, &error));
            assert_int_equal(error.status, TL_ERROR_ARGUMENT);
            assert_non_null(strstr(error.text, "budget"));
        }
        tl_mesh_destroy(most);
        tl_mesh_destroy(fewest);
        tl_framework_destroy(all);
        tl_framework_destroy(least);
        tl_source_destroy(source);
        tl_pyramid_destroy(pyramid);
        free(of.z);
    }
}

static void pyramidDoesNotDependOnThreads(void **state)
{
    (void)state;
    for (size_t k = 0; k < sizeof border_sizes / sizeof *border_sizes; k++) {
        random_state = k;
        grid of = make_grid(2 * border_sizes[k][0], border_sizes[k][1], TERRAIN_HILLS, k % 2 ? VOIDS_FEW : VOIDS_NONE);
        tl_pyramid *one = build(&of, k % 2, 1), *many = build(&of, k % 2, 5);
        for (int y = 0; y < of.height; y++)
            for (int x = 0; x < of.width; x++)
                assert_true(tl_pyramid_error(one, x, y) == tl_pyramid_error(many, x, y));
        tl_pyramid_destroy(one);
        tl_pyramid_destroy(many);
        free(of.z);
    }
}

/* ---- Files --------------------------------------------------------------------------------------------- */

static char folder[] = "/tmp/talus-test-XXXXXX";

static int make_folder(void **state)
{
    (void)state;
    return mkdtemp(folder) ? 0 : -1;
}

static int remove_folder(void **state)
{
    (void)state;
    return rmdir(folder);
}

static void flip_bit(const char *path, int bit)
{
    FILE *file = fopen(path, "r+b");
    assert_non_null(file);
    assert_int_equal(fseek(file, bit / 8, SEEK_SET), 0);
    int byte = fgetc(file);
    assert_int_equal(fseek(file, bit / 8, SEEK_SET), 0);
    assert_true(byte >= 0 && fputc(byte ^ 1 << bit % 8, file) >= 0);
    assert_int_equal(fclose(file), 0);
}

static void expect_same(const grid *of, const tl_pyramid *a, const tl_pyramid *b)
{
    for (int y = 0; y < of->height; y++)
        for (int x = 0; x < of->width; x++)
            assert_true(tl_pyramid_error(a, x, y) == tl_pyramid_error(b, x, y));
}

/* With one bit of the file wrong, which may be one that says nothing. */
static void expect_same_or_none(const char *path, const grid *of, const tl_pyramid *made, bool exact)
{
    FILE *file = fopen(path, "rb");
    assert_non_null(file);
    assert_int_equal(fseek(file, 0, SEEK_END), 0);
    int bit = random_below(8 * (int)ftell(file));
    assert_int_equal(fclose(file), 0);
    flip_bit(path, bit);
    tl_source *source = open_grid(of);
    tl_error error = {0};
    tl_pyramid *loaded = tl_pyramid_load(path, source, &(tl_pyramid_options){.exact = exact}, &error);
    if (loaded)
        expect_same(of, made, loaded);
    else
        assert_true(error.status != TL_OK && strstr(error.text, path));
    tl_pyramid_destroy(loaded);
    tl_source_destroy(source);
    flip_bit(path, bit);
}

static void expect_no_pyramid(const char *path, const grid *of, bool exact, tl_status status)
{
    tl_source *source = open_grid(of);
    tl_error error = {0};
    assert_null(tl_pyramid_load(path, source, &(tl_pyramid_options){.exact = exact}, &error));
    assert_int_equal(error.status, status);
    assert_non_null(strstr(error.text, path));
    tl_source_destroy(source);
}

/* The one digit after "base " in the file that makes another number of codes of it. */
static void change_base(const char *path)
{
    static const char mark[] = " base ";
    char text[4096];
    FILE *file = fopen(path, "r+b");
    assert_non_null(file);
    size_t size = 0, at = 0;
    for (long offset = 0; !at; offset += (long)(sizeof text - sizeof mark)) {
        assert_int_equal(fseek(file, offset, SEEK_SET), 0);
        size = fread(text, 1, sizeof text, file);
        assert_true(size > sizeof mark);
        for (size_t k = 0; k + sizeof mark < size && !at; k++)
            if (memcmp(text + k, mark, sizeof mark - 1) == 0) {
                at = (size_t)offset + k + sizeof mark - 1;
                text[0] = text[k + sizeof mark - 1];
            }
    }
    assert_int_equal(fseek(file, (long)at, SEEK_SET), 0);
    assert_int_not_equal(fputc(text[0] == '1' ? '3' : '1', file), EOF);
    assert_int_equal(fclose(file), 0);
}

/* Codes count from a base that only the label tells: another one would be other errors, or none. */
static void pyramidsOfAnotherBaseAreDamaged(void **state)
{
    (void)state;
    char path[64];
    snprintf(path, sizeof path, "%s/pyramid.tif", folder);
    random_state = 7;
    grid of = make_grid(65, 40, (terrain)0, VOIDS_NONE);
    tl_pyramid *made = build(&of, false, 1);
    assert_int_equal(tl_pyramid_save(made, path, &(tl_write_options){0}, NULL), TL_OK);
    change_base(path);
    expect_no_pyramid(path, &of, false, TL_ERROR_DATA);
    tl_pyramid_destroy(made);
    assert_int_equal(unlink(path), 0);
    free(of.z);
}

/* A saved pyramid comes back as it was, for the same heights and options; a damaged one does not. */
static void pyramidsAreUsedAgainForTheSameHeights(void **state)
{
    (void)state;
    for (int round = 0; round < 8; round++) {
        char path[64];
        snprintf(path, sizeof path, "%s/pyramid.tif", folder);
        random_state = (uint64_t)round;
        grid of = make_grid(1 + random_below(600), 1 + random_below(300), (terrain)(round % TERRAINS),
                            round % 3 ? VOIDS_NONE : VOIDS_FEW);
        bool exact = round % 2;
        tl_pyramid *made = build(&of, exact, 2);
        tl_error error = {0};
        if (tl_pyramid_save(made, path, &(tl_write_options){0}, &error) != TL_OK)
            fail_msg("%s", error.text);
        assert_int_equal(tl_pyramid_save(made, path, &(tl_write_options){0}, NULL), TL_ERROR_IO); /* exists */
        tl_source *source = open_grid(&of);
        tl_pyramid *loaded = tl_pyramid_load(path, source, &(tl_pyramid_options){.exact = exact}, &error);
        if (!loaded)
            fail_msg("%s", error.text);
        expect_same(&of, made, loaded);
        tl_framework *a = choose(made, &of, (tl_selection){.max_error = 2});
        tl_framework *b = choose(loaded, &of, (tl_selection){.max_error = 2});
        check_same(a, b);
        tl_framework_destroy(a);
        tl_framework_destroy(b);
        tl_source_destroy(source);
        tl_pyramid_destroy(loaded);
        if (of.width > 1 && of.height > 1) {
            expect_no_pyramid(path, &of, !exact, TL_ERROR_DATA);
            float *z = &of.z[random_below(of.width * of.height)], before = *z;
            *z = isnan(*z) ? 1 : *z + 1;
            expect_no_pyramid(path, &of, exact, TL_ERROR_DATA);
            *z = before;
            for (int i = 0; i < 20; i++)
                expect_same_or_none(path, &of, made, exact);
        }
        tl_pyramid_destroy(made);
        assert_int_equal(unlink(path), 0);
        free(of.z);
    }
}

/* ---- Kernels ------------------------------------------------------------------------------------------- */

typedef struct run_of_kernel {
    float heights[(TL_BLOCK + 3) * (TL_BLOCK + 3) + TL_ERROR_PAD];
    float errors[TL_ERROR_STRIDE * TL_ERROR_STRIDE], centres[(TL_BLOCK / 2 + 3) * (TL_BLOCK / 2 + 3)];
    float across[(TL_BLOCK / 4 + 1) * (TL_BLOCK / 4 + 1)], down[(TL_BLOCK / 4 + 1) * (TL_BLOCK / 4 + 1)];
    float parts[8 * (TL_BLOCK / 2 + 4)];
    double rows[3 * (TL_BLOCK / 2 + 4)], half[4];
    unsigned char codes[TL_ERROR_STRIDE * TL_ERROR_STRIDE];
} run_of_kernel;

static void run_kernel(const tl_error_kernel *kernel, const grid *of, int rim, bool careful, run_of_kernel *out)
{
    static const double add[TL_SIZES] = {0, 0.125, 0.5};
    int stride = TL_BLOCK + 3;
    memset(out, 0, sizeof *out);
    for (int y = 0; y < stride; y++)
        for (int x = 0; x < stride; x++)
            out->heights[y * stride + x] = of->z[y * stride + x];
    tl_error_block block = {.heights = out->heights + stride + 1,
                            .stride = stride,
                            .width = rim < TL_BLOCK ? rim : TL_BLOCK,
                            .height = TL_BLOCK,
                            .rim_x = rim,
                            .rim_y = 1000,
                            .voids = true,
                            .rounding = careful ? 1e-3 : 0,
                            .add = add,
                            .errors = out->errors,
                            .centres = out->centres,
                            .across = out->across,
                            .down = out->down,
                            .rows = out->rows,
                            .parts = out->parts};
    kernel->block(&block, TL_BLOCK);
    kernel->encode(out->errors, TL_ERROR_STRIDE * TL_ERROR_STRIDE, 1900, out->codes);
    for (int k = 0; k < 4; k++)
        out->half[k] = kernel->half(block.heights, stride, 64, k & 1, k & 2 ? TL_HALF_SECOND : TL_HALF_FIRST,
                                    (const double[]){3, 5, 500.5, 7});
}

static void kernelsAgreeBitForBit(void **state)
{
    const tl_error_kernel *const *kernels = tl_error_kernels();
    run_of_kernel *a = malloc(sizeof *a), *b = malloc(sizeof *b);
    (void)state;
    for (size_t other = 1; kernels[other]; other++)
        for (int round = 0; round < 10; round++) {
            random_state = (uint64_t)round;
            grid of = make_grid(TL_BLOCK + 3, TL_BLOCK + 3, (terrain)(round % TERRAINS),
                                round % 2 ? VOIDS_BLOCKS : VOIDS_NONE);
            run_kernel(kernels[0], &of, round % 3 ? 1000 : 200, round % 4 == 3, a);
            run_kernel(kernels[other], &of, round % 3 ? 1000 : 200, round % 4 == 3, b);
            assert_memory_equal(a->errors, b->errors, sizeof a->errors);
            assert_memory_equal(a->codes, b->codes, sizeof a->codes);
            assert_memory_equal(a->half, b->half, sizeof a->half);
            free(of.z);
        }
    free(a);
    free(b);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(pyramidIsTheDefinitionOnRandomDems), cmocka_unit_test(pyramidIsTheDefinitionAcrossBlocks),
        cmocka_unit_test(pyramidIsTheDefinitionAboveBlocks),  cmocka_unit_test(pyramidGivesTheFrameworkOfEveryBound),
        cmocka_unit_test(pyramidIsStrictForEveryBound),       cmocka_unit_test(budgetsAreExactAndNest),
        cmocka_unit_test(pyramidDoesNotDependOnThreads),      cmocka_unit_test(pyramidsAreUsedAgainForTheSameHeights),
        cmocka_unit_test(pyramidsOfAnotherBaseAreDamaged),    cmocka_unit_test(kernelsAgreeBitForBit),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
