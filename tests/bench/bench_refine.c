/* Nanoseconds a sample of noise, of one level of refinement and of a chain of four, on one thread, for every kernel
 * that runs here, beside a memcpy of the same bytes. */
#include "fbm/kernel.h"
#include "fbm/refine.h"
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

static void finish(chain *c)
{
    for (int l = 0; l <= LEVELS; l++)
        free(c->heights[l]);
    free(c->scratch);
}

static void run_chain(void *context)
{
    chain *c = context;
    for (int l = c->first; l < LEVELS; l++)
        fbm_refine_by(c->kernel, &c->steps[l], c->heights[l], c->windows[l], c->heights[l + 1], c->windows[l + 1],
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
    finish(&c);
}

int main(void)
{
    bench_print_machine();
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++) {
        measure(scheme, 257);
        measure(scheme, 513);
    }
    return 0;
}
