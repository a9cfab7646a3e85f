/* Nanoseconds per sample of the irregular mesh at several bounds, on one core and on two, beside the quadtree that it
 * is made from and a copy of the same samples; and what it saves. The terrain is fractional noise in whole numbers. */
#include "lib/base/georef.h"
#include "lib/talus.h"
#include "tests/bench/bench.h"

#include <stdio.h>
#include <stdlib.h>

enum { SIZE = 1201, RUNS = 3 };

typedef struct work {
    const tl_source *source;
    tl_simplify_options options;
    tl_mesh *mesh;
} work;

static void simplify(void *context)
{
    work *self = context;
    tl_mesh_destroy(self->mesh);
    self->mesh = NULL;
    tl_simplify(self->source, &self->options, &self->mesh, NULL, NULL);
}

/* Nanoseconds a sample; the number of triangles goes to *triangles. */
static double time_of(work *self, tl_mesh_kind kind, unsigned threads, size_t *triangles)
{
    tl_run run = {.threads = threads};
    self->options.kind = kind;
    self->options.run = &run;
    double seconds = bench_minimum(simplify, self, RUNS);
    if (!self->mesh) {
        puts("tin: failed");
        exit(1);
    }
    *triangles = self->mesh->triangle_count;
    return 1e9 * seconds / ((double)SIZE * SIZE);
}

int main(void)
{
    static const double bounds[] = {1, 5, 20, 50};
    static float heights[SIZE * SIZE];
    tl_source *noise = tl_noise_create(&(tl_noise_options){.size = SIZE, .hurst = 0.8, .delta = 10, .seed = 1}, NULL);
    if (!noise || tl_source_read(noise, 0, (tl_window){0, 0, SIZE, SIZE}, heights, NULL) != TL_OK)
        return 1;
    tl_source_destroy(noise);
    for (int k = 0; k < SIZE * SIZE; k++)
        heights[k] = (float)(int)heights[k];
    tl_source_info info = {.width = SIZE, .height = SIZE, .georef = tl_georef_none(), .name = "noise"};
    work self = {.source = tl_array_source_create(heights, &info, NULL)};
    bench_print_machine();
    printf("copy %.2f ns/sample\n", 1e9 * bench_copy(sizeof heights, RUNS) / ((double)SIZE * SIZE));
    for (size_t k = 0; k < sizeof bounds / sizeof *bounds; k++) {
        size_t tree, tin;
        self.options = (tl_simplify_options){.max_error = bounds[k], .frame = TL_FRAME_PIXEL};
        double quadtree = time_of(&self, TL_MESH_QUADTREE, 1, &tree), one = time_of(&self, TL_MESH_TIN, 1, &tin);
        double two = time_of(&self, TL_MESH_TIN, 2, &tin);
        printf("tin max_error %-4g %8zu triangles (%.2f of the quadtree's)  %7.1f ns/sample (quadtree %.1f)  "
               "two threads %.2f times as fast\n",
               bounds[k], tin, (double)tin / (double)tree, one, quadtree, one / two);
    }
    tl_mesh_destroy(self.mesh);
    tl_source_destroy((tl_source *)self.source);
    return 0;
}
