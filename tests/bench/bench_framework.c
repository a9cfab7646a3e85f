/* Nanoseconds per sample of the strict framework at several bounds, its mesh and the verification, on one core; and
 * as ratios to a copy of the same samples. The terrain is made here: octaves of lattice noise, rough enough that fine
 * bounds keep most samples and coarse ones few. */
#include "lib/talus.h"
#include "tests/bench/bench.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

enum { SIZE = 1201, RUNS = 7, OCTAVES = 9 };

static const tl_run one_thread = {.threads = 1};

typedef struct work {
    const tl_source *source;
    double max_error;
    tl_framework *framework;
    tl_mesh *mesh;
} work;

static void build(void *context)
{
    work *self = context;
    tl_framework_destroy(self->framework);
    tl_framework_options options = {.max_error = self->max_error, .run = &one_thread};
    self->framework = tl_framework_build(self->source, &options, NULL);
}

static void draw(void *context)
{
    work *self = context;
    tl_mesh_destroy(self->mesh);
    self->mesh = NULL;
    tl_framework_mesh(self->framework, &self->mesh, NULL);
}

static void verify(void *context)
{
    const work *self = context;
    tl_mesh_report report;
    tl_mesh_verify(self->mesh, self->source, &one_thread, &report, NULL);
}

static double noise_at(uint32_t octave, uint32_t x, uint32_t y)
{
    uint32_t h = (x * 0x9E3779B1u) ^ (y * 0x85EBCA77u) ^ (octave * 0xC2B2AE3Du);
    h = (h ^ h >> 15) * 0x2C1B3C6Du;
    h = (h ^ h >> 12) * 0x297A2D39u;
    return (double)(h ^ h >> 15) * 0x1p-31 - 1;
}

/* Bilinear noise, halved in height by every halving of its wavelength: relief of about 2,000. */
static float height_at(uint32_t x, uint32_t y)
{
    double sum = 0;
    for (uint32_t octave = 0; octave < OCTAVES; octave++) {
        uint32_t wavelength = 512u >> octave, i = x / wavelength, j = y / wavelength;
        double u = (double)(x % wavelength) / wavelength, v = (double)(y % wavelength) / wavelength;
        double top = noise_at(octave, i, j) * (1 - u) + noise_at(octave, i + 1, j) * u;
        double bottom = noise_at(octave, i, j + 1) * (1 - u) + noise_at(octave, i + 1, j + 1) * u;
        sum += (top * (1 - v) + bottom * v) * wavelength;
    }
    return (float)floor(sum);
}

static void measure(work *self)
{
    double samples = (double)SIZE * SIZE, per = 1e9 / samples;
    double copy = bench_copy((size_t)SIZE * SIZE * sizeof(float), RUNS);
    double building = bench_minimum(build, self, RUNS), drawing = bench_minimum(draw, self, RUNS);
    if (!self->mesh) {
        puts("framework: failed");
        exit(1);
    }
    double verifying = bench_minimum(verify, self, RUNS);
    printf("framework max_error %-4g points/sample %.3f  build %6.2f ns/sample (%5.1f copies)  mesh %6.2f (%5.1f)  "
           "verify %6.2f (%5.1f)\n",
           self->max_error, (double)tl_framework_point_count(self->framework) / samples, building * per,
           building / copy, drawing * per, drawing / copy, verifying * per, verifying / copy);
}

int main(void)
{
    static const double bounds[] = {0, 1, 5, 20, 100};
    float *heights = malloc(sizeof *heights * SIZE * SIZE);
    if (!heights)
        return 1;
    for (uint32_t y = 0; y < SIZE; y++)
        for (uint32_t x = 0; x < SIZE; x++)
            heights[y * SIZE + x] = height_at(x, y);
    tl_source_info info = {.width = SIZE, .height = SIZE, .name = "noise"};
    info.georef = (tl_georef){.transform = {0, 1, 0, 0, 0, -1}, .cell_x = 1, .cell_y = 1, .height_unit = 1};
    work self = {.source = tl_array_source_create(heights, &info, NULL)};
    bench_print_machine();
    for (size_t k = 0; k < sizeof bounds / sizeof *bounds; k++) {
        self.max_error = bounds[k];
        measure(&self);
    }
    tl_mesh_destroy(self.mesh);
    tl_framework_destroy(self.framework);
    tl_source_destroy((tl_source *)self.source);
    free(heights);
    return 0;
}
