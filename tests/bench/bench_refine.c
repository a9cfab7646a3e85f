/* Nanoseconds a sample of noise, of one level of refinement and of a chain of four, on one thread, for every kernel
 * that runs here, beside a memcpy of the same bytes. */
#include "fbm/kernel.h"
#include "fbm/refine.h"
#include "fbm/relief_kernel.h"
#include "tests/bench/bench.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

enum { LEVELS = 4, RUNS = 25, NOISE_ROWS = 256 };

typedef struct chain {
    const fbm_kernel *kernel;
    int first; /* level that is refined first */
    fbm_step steps[LEVELS];
    fbm_window windows[LEVELS + 1];
    float *heights[LEVELS + 1];
    float *scratch;
    /* Coefficients by place: from fields on level 0. */
    fbm_places_table table;
    fbm_places places[LEVELS];
    float *table_values, *unit, *values, *strength, *hurst, *strengths;
} chain;

static void *allocate(size_t count, size_t size)
{
    void *memory = calloc(count, size);
    if (!memory) {
        fputs("out of memory\n", stderr);
        exit(1);
    }
    return memory;
}

/* A tile of `side` samples at level LEVELS, and all that leads there. */
static void plan(chain *c, const fbm_scheme *scheme, size_t side)
{
    size_t scratch = 0;
    c->windows[LEVELS] = (fbm_window){0, 0, side, side, side};
    for (int l = LEVELS; l > 0; l--) {
        c->windows[l - 1] = fbm_refine_support(scheme, c->windows[l]);
        size_t need = fbm_refine_scratch(c->windows[l].width);
        scratch = need > scratch ? need : scratch;
    }
    for (int l = 0; l <= LEVELS; l++)
        c->heights[l] = allocate(c->windows[l].stride * c->windows[l].height, sizeof(float));
    for (int l = 0; l < LEVELS; l++) {
        c->steps[l] = (fbm_step){.scheme = scheme, .amplitude = powf(0.6F, (float)l), .seed = 1, .level = l};
        scheme->weights(0.7, &c->steps[l].weights);
    }
    c->scratch = allocate(scratch, sizeof(float));
}

/* Fields of strength and exponent at the vertices of level 0, where the vertices of coefficients of these levels lie.
 */
static void plan_places(chain *c)
{
    const fbm_window *nodes = &c->windows[0];
    size_t count = nodes->width * nodes->height, size = fbm_places_size(true);
    c->table_values = allocate(fbm_places_table_size(0, 0), sizeof(float));
    fbm_places_table_make(0, 0, c->table_values, &c->table);
    c->unit = allocate(count * fbm_places_size(true), sizeof(float));
    c->values = allocate(count * size + FBM_PLACES_SPARE, sizeof(float));
    c->strengths = allocate(count, sizeof(float));
    c->strength = allocate(count, sizeof(float));
    c->hurst = allocate(count, sizeof(float));
    for (size_t k = 0; k < count; k++) {
        c->strength[k] = 1 + (float)(k % 7) / 8;
        c->hurst[k] = .3F + (float)(k % nodes->width) / 100;
    }
    for (int l = 0; l < LEVELS; l++)
        c->places[l] = (fbm_places){.shift = l, .square = true, .window = *nodes, .values = c->values};
}

static void run_places(void *context)
{
    chain *c = context;
    const fbm_window *nodes = &c->windows[0];
    for (size_t row = 0; row < nodes->height; row++)
        fbm_places_unit(&c->table, 0, c->hurst + row * nodes->width, nodes->width,
                        c->unit + row * nodes->width * fbm_places_size(true));
    for (int l = c->first; l < LEVELS; l++) {
        fbm_places_strengths(l, c->strength, c->hurst, nodes->width * nodes->height, c->strengths);
        for (size_t row = 0; row < nodes->height; row++)
            fbm_places_scale(&c->table, c->strengths + row * nodes->width, nodes->width,
                             c->unit + row * nodes->width * fbm_places_size(true), nodes->width,
                             c->values + row * nodes->width * fbm_places_size(true));
        fbm_step step = c->steps[l];
        step.places = &c->places[l];
        fbm_refine_by(c->kernel, &step, c->heights[l], NULL, c->windows[l], c->heights[l + 1], c->windows[l + 1],
                      c->scratch);
    }
}

static void finish(chain *c)
{
    free(c->table_values);
    free(c->unit);
    free(c->values);
    free(c->strengths);
    free(c->strength);
    free(c->hurst);
    for (int l = 0; l <= LEVELS; l++)
        free(c->heights[l]);
    free(c->scratch);
}

static void run_chain(void *context)
{
    chain *c = context;
    for (int l = c->first; l < LEVELS; l++)
        fbm_refine_by(c->kernel, &c->steps[l], c->heights[l], NULL, c->windows[l], c->heights[l + 1], c->windows[l + 1],
                      c->scratch);
}

static void run_noise(void *context)
{
    chain *c = context;
    for (int j = 0; j < NOISE_ROWS; j++)
        c->kernel->noise(1, 2, FBM_NOISE_CENTRES, j, -3, c->windows[LEVELS].width, c->heights[LEVELS]);
}

static void measure(const fbm_scheme *scheme, size_t side)
{
    chain c = {0};
    double count = (double)side * (double)side, copy = bench_copy(side * side * sizeof(float), RUNS) / count;
    plan(&c, scheme, side);
    printf("%s, tile of %zu x %zu; memcpy of the same bytes %.3f ns a sample\n", scheme->name, side, side, 1e9 * copy);
    printf("  %-8s %10s %10s %10s %14s\n", "kernel", "noise", "1 level", "4 levels", "4 levels/copy");
    for (const fbm_kernel *const *kernel = fbm_kernels(); *kernel; kernel++) {
        c.kernel = *kernel;
        double noise = bench_minimum(run_noise, &c, RUNS) / ((double)side * NOISE_ROWS);
        c.first = 0;
        double levels = bench_minimum(run_chain, &c, RUNS) / count;
        c.first = LEVELS - 1;
        double level = bench_minimum(run_chain, &c, RUNS) / count;
        printf("  %-8s %7.3f ns %7.3f ns %7.3f ns %14.1f\n", (*kernel)->name, 1e9 * noise, 1e9 * level, 1e9 * levels,
               levels / copy);
    }
    if (fbm_scheme_has_places(scheme)) {
        plan_places(&c);
        c.first = 0;
        for (const fbm_kernel *const *kernel = fbm_kernels(); *kernel; kernel++) {
            c.kernel = *kernel;
            double plain = bench_minimum(run_chain, &c, RUNS), by_place = bench_minimum(run_places, &c, RUNS);
            printf("  %-8s with fields of H and delta, 4 levels: %.3f ns, %.2f times one H, %.1f copies\n",
                   (*kernel)->name, 1e9 * by_place / count, by_place / plain, by_place / count / copy);
        }
    }
    finish(&c);
}

/* The same for terrain's detail: its levels are cells, three of them as from a DEM to an eighth of its spacing. */
enum { OCTAVES = 3 };

typedef struct terrain_chain {
    const fbm_kernel *noise;
    const fbm_relief_kernel *kernel;
    int first;
    fbm_relief_step step;
    fbm_window windows[OCTAVES + 1];
    float *heights[OCTAVES + 1], *energy[OCTAVES + 1];
    float *scratch;
} terrain_chain;

static void run_terrain(void *context)
{
    terrain_chain *c = context;
    for (int l = c->first; l < OCTAVES; l++)
        c->kernel->refine(c->noise, &c->step, c->heights[l], c->energy[l], c->windows[l], c->heights[l + 1],
                          l + 1 < OCTAVES ? c->energy[l + 1] : NULL, c->windows[l + 1], c->scratch);
}

static void plan_terrain(terrain_chain *c, size_t side)
{
    c->step = (fbm_relief_step){.children_x = 5,
                                .children_y = 7,
                                .gains = {1, 1, 1},
                                .steer = 1,
                                .steer_slope2 = .1F,
                                .level = 4,
                                .level_slope = .3F,
                                .limit = .01F};
    c->windows[OCTAVES] = (fbm_window){0, 0, side, side, side};
    for (int l = OCTAVES; l > 0; l--)
        c->windows[l - 1] = fbm_relief_support(c->windows[l]);
    for (int l = 0; l <= OCTAVES; l++) {
        size_t count = c->windows[l].stride * c->windows[l].height;
        c->heights[l] = allocate(count, sizeof(float));
        c->energy[l] = allocate(count, sizeof(float));
        for (size_t k = 0; k < count; k++) {
            c->heights[l][k] = (float)(k * 2654435761U >> 8 & 0xff);
            c->energy[l][k] = 1;
        }
    }
    c->scratch = allocate(fbm_relief_scratch(side), sizeof(float));
}

static void measure_terrain(size_t side)
{
    terrain_chain c = {0};
    double count = (double)side * (double)side, copy = bench_copy(side * side * sizeof(float), RUNS) / count;
    plan_terrain(&c, side);
    printf("terrain, tile of %zu x %zu; memcpy of the same bytes %.3f ns a sample\n", side, side, 1e9 * copy);
    printf("  %-8s %10s %10s %14s\n", "kernel", "1 level", "3 levels", "3 levels/copy");
    const fbm_kernel *const *noise = fbm_kernels();
    for (const fbm_relief_kernel *const *kernel = fbm_relief_kernels(); *kernel; kernel++, noise++) {
        c.kernel = *kernel;
        c.noise = *noise;
        c.first = 0;
        double levels = bench_minimum(run_terrain, &c, RUNS) / count;
        c.first = OCTAVES - 1;
        double level = bench_minimum(run_terrain, &c, RUNS) / count;
        printf("  %-8s %7.3f ns %7.3f ns %14.1f\n", (*kernel)->name, 1e9 * level, 1e9 * levels, levels / copy);
    }
    for (int l = 0; l <= OCTAVES; l++) {
        free(c.heights[l]);
        free(c.energy[l]);
    }
    free(c.scratch);
}

int main(void)
{
    bench_print_machine();
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++) {
        measure(scheme, 257);
        measure(scheme, 513);
    }
    measure_terrain(256);
    measure_terrain(512);
    return 0;
}
