/* What choosing the triangles of a view costs: by selector, and from frame to frame of a flight. Model: 1025 x 1025
 * samples of fBm on cells of 90 m, refined by 6 levels, from 300 m above its middle, 1920 x 1080, 1 pixel. Times are of
 * this process's processors, the least of some runs. */
#include "lib/talus.h"
#include "tests/bench/bench.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { SIZE = 1025, RUNS = 3, FRAMES = 60 };

typedef struct scene {
    tl_source *dem, *field;
    tl_pyramid *pyramid;
    tl_view view;
} scene;

static double processor_seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void expect(tl_status status, const tl_error *error)
{
    if (status == TL_OK)
        return;
    fprintf(stderr, "%s\n", error->text);
    exit(1);
}

static float *make_heights(void)
{
    tl_error error;
    const tl_noise_options noise = {.size = SIZE, .hurst = .9, .delta = 12, .seed = 1};
    float *heights = malloc(SIZE * SIZE * sizeof *heights);
    tl_source *source = tl_noise_create(&noise, &error);
    if (!heights || !source)
        exit(1);
    expect(tl_source_read(source, source->info.level, (tl_window){0, 0, SIZE, SIZE}, heights, &error), &error);
    tl_source_destroy(source);
    return heights;
}

static scene make_scene(const float *heights)
{
    tl_error error;
    scene s = {.view = {.eye = {SIZE / 2., -SIZE / 2., 300}, .above_ground = true, .heading = 30, .pitch = -5}};
    const tl_source_info info = {
        .width = SIZE,
        .height = SIZE,
        .type = TL_RASTER_POINT,
        .name = "fBm",
        .georef = {.transform = {0, 1, 0, 0, 0, -1}, .cell_x = 90, .cell_y = 90, .height_unit = 1}};
    const tl_field_options options = {
        .levels = 6, .support = TL_SUPPORT_POINT, .hurst_given = true, .hurst = .9, .delta_given = true, .delta = 12};
    s.dem = tl_array_source_create(heights, &info, &error);
    s.pyramid = s.dem ? tl_pyramid_create(s.dem, NULL, &error) : NULL;
    s.field = s.pyramid ? tl_field_create(s.dem, &options, &error) : NULL;
    expect(s.field ? TL_OK : TL_ERROR_MEMORY, &error);
    return s;
}

static void measure_selector(const scene *s, const char *name, tl_lod_options options)
{
    tl_error error;
    double least = HUGE_VAL;
    tl_lod_stats stats;
    for (int run = 0; run < RUNS; run++) {
        tl_mesh *mesh = NULL;
        double start = processor_seconds();
        expect(tl_select(s->field, s->dem, s->pyramid, &s->view, &options, &mesh, &stats, &error), &error);
        least = fmin(least, processor_seconds() - start);
        tl_mesh_destroy(mesh);
    }
    printf("%-28s %9llu triangles  %7.1f ms  %6.1f ns a triangle  %6llu tiles made\n", name,
           (unsigned long long)stats.triangles, 1e3 * least, 1e9 * least / (double)stats.triangles,
           (unsigned long long)stats.tiles_made);
}

static void measure_flight(const scene *s)
{
    tl_error error;
    const tl_lod_options options = {.pixel_error = 1};
    tl_roam *roam = tl_roam_create(s->field, s->dem, s->pyramid, &options, &error);
    tl_view view = s->view;
    double first = 0, others = 0;
    expect(roam ? TL_OK : TL_ERROR_MEMORY, &error);
    for (int frame = 0; frame < FRAMES; frame++) {
        double start = processor_seconds();
        expect(tl_roam_look(roam, &view, NULL, &error), &error);
        *(frame ? &others : &first) += processor_seconds() - start;
        view.eye[0] += 3. / 90; /* 3 m */
        view.heading += .1;
    }
    others /= FRAMES - 1;
    tl_roam_destroy(roam);
    printf("%-28s first frame %7.1f ms, then %6.1f ms: 1/%.1f\n", "roam, a flight", 1e3 * first, 1e3 * others,
           first / others);
}

int main(void)
{
    bench_print_machine();
    float *heights = make_heights();
    scene s = make_scene(heights);
    measure_selector(&s, "quadtree", (tl_lod_options){.pixel_error = 1});
    measure_selector(&s, "chunk", (tl_lod_options){.selector = TL_SELECTOR_CHUNK, .pixel_error = 1});
    measure_selector(&s, "roam", (tl_lod_options){.selector = TL_SELECTOR_ROAM, .pixel_error = 1});
    measure_selector(&s, "quadtree, 4 pixels", (tl_lod_options){.pixel_error = 4});
    measure_selector(&s, "quadtree, 4, nothing culled", (tl_lod_options){.pixel_error = 4, .keep = 15});
    measure_flight(&s);
    tl_source_destroy(s.field);
    tl_pyramid_destroy(s.pyramid);
    tl_source_destroy(s.dem);
    free(heights);
    return 0;
}
