/* Seconds of a 1920 x 1080 picture of a million triangles, on one core and on two, beside a copy of its samples:
 * placing and drawing, and writing the PNG. */
#include "dem/crs.h"
#include "lib/base/georef.h"
#include "lib/scene/mesh_picture.h"
#include "tests/bench/bench.h"

#include <stdio.h>
#include <stdlib.h>

enum { SIZE = 708, RUNS = 3 };

typedef struct work {
    const tl_source *dem;
    const tl_mesh *mesh;
    tl_view view;
    tl_run run;
    const char *path;
} work;

static void paint(void *context)
{
    work *self = context;
    scene_view *view = scene_view_create(&self->view, self->dem, NULL);
    scene_painter *painter = scene_painter_create(self->dem, &(tl_view_picture_options){.run = &self->run}, NULL);
    scene_picture picture = {0};
    if (!view || !painter ||
        scene_paint(painter, self->mesh, (const scene_view *const *)&view, 1, &picture, NULL) != TL_OK) {
        puts("picture: failed");
        exit(1);
    }
    scene_picture_finish(&picture);
    scene_painter_destroy(painter);
    scene_view_destroy(view);
}

static void place(void *context)
{
    enum { N = 256 };
    work *self = context;
    scene_view *view = scene_view_create(&self->view, self->dem, NULL);
    static double i[N], j[N], at[N][3];
    static float z[N];
    for (int row = 0; row < SIZE * SIZE / N; row++) {
        for (int k = 0; k < N; k++) {
            i[k] = k * 2.5;
            j[k] = row % SIZE;
        }
        scene_view_place(view, N, i, j, z, at);
    }
    scene_view_destroy(view);
}

/* In an order that no row has. */
static void place_scattered(void *context)
{
    enum { N = 256 };
    work *self = context;
    scene_view *view = scene_view_create(&self->view, self->dem, NULL);
    static double i[N], j[N], at[N][3];
    static float z[N];
    unsigned state = 1;
    for (int row = 0; row < SIZE * SIZE / N; row++) {
        for (int k = 0; k < N; k++) {
            state = state * 1664525u + 1013904223u;
            i[k] = (state >> 8) % (SIZE - 1);
            j[k] = (state >> 20) % (SIZE - 1);
        }
        scene_view_place(view, N, i, j, z, at);
    }
    scene_view_destroy(view);
}

int main(void)
{
    static float heights[SIZE * SIZE];
    tl_crs *crs = NULL;
    tl_source *noise = tl_noise_create(&(tl_noise_options){.size = SIZE, .hurst = 0.9, .delta = 10, .seed = 1}, NULL);
    if (!noise || tl_source_read(noise, 0, (tl_window){0, 0, SIZE, SIZE}, heights, NULL) != TL_OK ||
        dem_crs_from_text("EPSG:4326", "picture", &crs, NULL) != TL_OK)
        return 1;
    tl_source_destroy(noise);
    tl_source_info info = {.width = SIZE, .height = SIZE, .type = TL_RASTER_POINT, .name = "noise"};
    info.georef = (tl_georef){crs, true, {11, 1 / 3600.0, 0, 47, 0, -1 / 3600.0}, 0, 0, 1};
    dem_georef_measure(&info.georef, SIZE, SIZE, NULL);
    tl_source *dem = tl_array_source_create(heights, &info, NULL);
    tl_mesh *mesh = NULL;
    if (!dem || tl_mesh_from_source(dem, NULL, &mesh, NULL) != TL_OK)
        return 1;
    work self = {.dem = dem, .mesh = mesh};
    self.view = (tl_view){.eye = {11.098, 46.79, 4000}, .target = {11.098, 46.9, 0}, .target_given = true};
    bench_print_machine();
    printf("copy of the samples %.4f s\n", bench_copy((size_t)1920 * 1080 * 4 * sizeof(scene_hit), RUNS));
    for (unsigned threads = 1; threads <= 2; threads++) {
        self.run.threads = threads;
        printf("picture of %zu triangles, %u threads: %.3f s\n", mesh->triangle_count, threads,
               bench_minimum(paint, &self, RUNS));
    }
    double points = SIZE * SIZE / 256 * 256;
    printf("places: %.1f ns a point along rows, %.1f ns scattered\n", 1e9 * bench_minimum(place, &self, RUNS) / points,
           1e9 * bench_minimum(place_scattered, &self, RUNS) / points);
    tl_mesh_destroy(mesh);
    tl_source_destroy(dem);
    tl_crs_release(crs);
    return 0;
}
