/* Nanoseconds per sample of the error pyramid, for all bounds at once, beside the framework of one bound and a copy of
 * the same samples: on terrain that is made here, or on the elevation model that is named. The model is read
 * beforehand.
 */
#include "lib/talus.h"
#include "tests/bench/bench.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>

enum { SIZE = 3601, RUNS = 5 };

typedef struct work {
    const tl_source *source;
    tl_run run;
    bool exact;
    double max_error;
    tl_pyramid *pyramid;
} work;

static void build(void *context)
{
    work *self = context;
    tl_pyramid_destroy(self->pyramid);
    tl_pyramid_options options = {.exact = self->exact, .run = &self->run};
    self->pyramid = tl_pyramid_create(self->source, &options, NULL);
}

static void select_bound(void *context)
{
    const work *self = context;
    tl_selection selection = {.max_error = self->max_error, .run = &self->run};
    tl_framework_destroy(tl_framework_from_pyramid(self->pyramid, self->source, &selection, NULL));
}

static void select_budget(void *context)
{
    const work *self = context;
    tl_selection selection = {.triangles = (uint64_t)(self->source->info.width * self->source->info.height / 10),
                              .run = &self->run};
    tl_framework_destroy(tl_framework_from_pyramid(self->pyramid, self->source, &selection, NULL));
}

static void build_one(void *context)
{
    const work *self = context;
    tl_framework_options options = {.max_error = self->max_error, .run = &self->run};
    tl_framework_destroy(tl_framework_build(self->source, &options, NULL));
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
    for (uint32_t octave = 0; octave < 9; octave++) {
        uint32_t wavelength = 512u >> octave, i = x / wavelength, j = y / wavelength;
        double u = (double)(x % wavelength) / wavelength, v = (double)(y % wavelength) / wavelength;
        double top = noise_at(octave, i, j) * (1 - u) + noise_at(octave, i + 1, j) * u;
        double bottom = noise_at(octave, i, j + 1) * (1 - u) + noise_at(octave, i + 1, j + 1) * u;
        sum += (top * (1 - v) + bottom * v) * wavelength;
    }
    return (float)floor(sum);
}

static tl_source *open_model(const char *path, float **heights)
{
    tl_source_info info = {.width = SIZE, .height = SIZE, .name = "noise"};
    tl_source *file = path ? tl_dem_open(&path, 1, NULL, NULL) : NULL;
    if (path && !file)
        return NULL;
    if (file)
        info =
            (tl_source_info){.width = file->info.width, .height = file->info.height, .name = path, .has_voids = true};
    *heights = malloc(sizeof **heights * (size_t)info.width * (size_t)info.height);
    if (file && *heights)
        tl_source_read(file, 0, (tl_window){0, 0, info.width, info.height}, *heights, NULL);
    for (int64_t i = 0; !file && *heights && i < info.width * info.height; i++)
        (*heights)[i] = height_at((uint32_t)(i % info.width), (uint32_t)(i / info.width));
    tl_source_destroy(file);
    return *heights ? tl_array_source_create(*heights, &info, NULL) : NULL;
}

static long peak_kilobytes(void)
{
    struct rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    return usage.ru_maxrss;
}

static void measure(work *self)
{
    double samples = (double)self->source->info.width * (double)self->source->info.height, per = 1e9 / samples;
    double copy = bench_copy((size_t)samples * sizeof(float), RUNS);
    printf("copy of the samples                      %6.2f ns/sample\n", copy * per);
    for (int exact = 0; exact < 2; exact++) {
        double alone = 0;
        for (unsigned threads = 1; threads <= 2; threads++) {
            self->exact = exact;
            self->run.threads = threads;
            tl_pyramid_destroy(self->pyramid);
            self->pyramid = NULL;
            long before = peak_kilobytes();
            double seconds = bench_minimum(build, self, RUNS);
            alone = threads == 1 ? seconds : alone;
            printf("pyramid of %s, %u thread%s %6.2f ns/sample (%4.1f copies), %.2f times as fast as one; %.2f "
                   "bytes/sample\n",
                   exact ? "floats" : "codes ", threads, threads == 1 ? " " : "s", seconds * per, seconds / copy,
                   alone / seconds, (double)(peak_kilobytes() - before) * 1024 / samples);
        }
        self->run.threads = 1;
        static const double bounds[] = {1, 5, 20};
        for (size_t k = 0; k < 3; k++) {
            self->max_error = bounds[k];
            printf("  max_error %-3g of it %6.2f ns/sample; built alone %6.2f\n", bounds[k],
                   bench_minimum(select_bound, self, RUNS) * per, bench_minimum(build_one, self, RUNS) * per);
        }
        printf("  budget of a triangle for 10 samples %6.2f ns/sample\n",
               bench_minimum(select_budget, self, RUNS) * per);
    }
}

int main(int argc, char **argv)
{
    float *heights = NULL;
    work self = {.source = open_model(argc > 1 ? argv[1] : NULL, &heights)};
    if (!self.source) {
        puts("pyramid: no model, or no memory");
        return 1;
    }
    bench_print_machine();
    measure(&self);
    tl_pyramid_destroy(self.pyramid);
    tl_source_destroy((tl_source *)self.source);
    free(heights);
    return 0;
}
