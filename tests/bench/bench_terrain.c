/* What each part of the scheme `terrain` is worth: rasters averaged down by 8, refined again with all of it, without
 * one part, and as fractional Brownian motion, and compared with what they were. bench_terrain [RASTER...]    (default:
 * examples/jacksboro.tif of the sources in TALUS_SOURCE_ROOT) */
#include "fbm/likeness.h"
#include "lib/base/size.h"
#include "lib/scene/terrain.h"
#include "tests/bench/bench.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

enum { FACTOR = 8, LEVELS = 3 };

typedef struct truth {
    float *fine, *coarse, *made;
    int64_t width, height; /* fine samples, whole cells of FACTOR */
    tl_source *source;     /* the means */
} truth;

static void stop(const char *what)
{
    fprintf(stderr, "%s\n", what);
    exit(1);
}

static truth average(const tl_source *dem)
{
    truth t = {.width = dem->info.width / FACTOR * FACTOR, .height = dem->info.height / FACTOR * FACTOR};
    size_t count = (size_t)(t.width * t.height);
    t.fine = tl_alloc(count, sizeof(float));
    t.made = tl_alloc(count, sizeof(float));
    t.coarse = calloc(count / (FACTOR * FACTOR), sizeof(float));
    tl_error error;
    if (!t.fine || !t.made || !t.coarse)
        stop("out of memory");
    if (tl_source_read(dem, 0, (tl_window){0, 0, t.width, t.height}, t.fine, &error) != TL_OK)
        stop(error.text);
    for (int64_t k = 0; k < t.width * t.height; k++) {
        if (isnan(t.fine[k]))
            stop("the raster has voids");
        t.coarse[k / t.width / FACTOR * (t.width / FACTOR) + k % t.width / FACTOR] += t.fine[k] / (FACTOR * FACTOR);
    }
    tl_source_info info = dem->info;
    info.width = t.width / FACTOR;
    info.height = t.height / FACTOR;
    info.quantum = 0;
    info.georef.cell_x *= FACTOR;
    info.georef.cell_y *= FACTOR;
    t.source = tl_array_source_create(t.coarse, &info, &error);
    if (!t.source)
        stop(error.text);
    return t;
}

static void judge(const char *name, const truth *t, const tl_georef *fine)
{
    fbm_likeness like;
    if (!fbm_likeness_measure(t->made, t->fine, (size_t)t->width, (size_t)t->height, FACTOR,
                              fine->cell_x / fine->height_unit, fine->cell_y / fine->height_unit, &like))
        stop("too small a raster, or out of memory");
    printf("  %-34s %9.3f %9.3f %9.3f %9.3f\n", name, like.structure, like.spectrum, like.slope, like.rms);
}

static void refine(const truth *t, unsigned without)
{
    scene_detail detail;
    scene_octave octaves[SCENE_LEVEL_MAX + 1];
    scene_terrain *terrain = malloc(sizeof *terrain);
    tl_error error;
    if (!terrain)
        stop("out of memory");
    if (scene_detail_measure(t->source, NULL, &detail, &error) != TL_OK)
        stop(error.text);
    tl_roughness measured = scene_roughness_of(&detail, &t->source->info.georef);
    scene_predict_octaves(&measured, &t->source->info.georef, octaves, SCENE_LEVEL_MAX + 1);
    fbm_window window = {0, 0, (size_t)t->width, (size_t)t->height, (size_t)t->width};
    if (scene_terrain_measure(t->source, &detail, octaves, LEVELS, 1, without, NULL, terrain, &error) != TL_OK ||
        scene_terrain_read(terrain, t->source, LEVELS, window, t->made, NULL, &error) != TL_OK)
        stop(error.text);
    free(terrain);
}

static void refine_by(const truth *t, const char *scheme)
{
    tl_error error;
    tl_source *field =
        tl_field_create(t->source, &(tl_field_options){.levels = LEVELS, .scheme = scheme, .seed = 1}, &error);
    if (!field || tl_source_read(field, LEVELS, (tl_window){0, 0, t->width, t->height}, t->made, &error) != TL_OK)
        stop(error.text);
    tl_source_destroy(field);
}

static void measure(const char *path)
{
    static const struct {
        const char *name;
        unsigned without;
    } runs[] = {{"terrain", 0},
                {"without strength by the place", SCENE_TERRAIN_PLACE},
                {"without less where it is level", SCENE_TERRAIN_LEVEL},
                {"without noise down the slope", SCENE_TERRAIN_STEER},
                {"without levelling of steep slopes", SCENE_TERRAIN_SLOPES},
                {"without softening of pits", SCENE_TERRAIN_PITS},
                {"none of these", 31}};
    tl_error error;
    tl_source *dem = tl_open(path, &error);
    if (!dem)
        stop(error.text);
    truth t = average(dem);
    printf("%s: %lld x %lld\n  %-34s %9s %9s %9s %9s\n", path, (long long)t.width, (long long)t.height, "", "structure",
           "spectrum", "slope", "rms");
    for (size_t k = 0; k < sizeof runs / sizeof *runs; k++) {
        refine(&t, runs[k].without);
        judge(runs[k].name, &t, &dem->info.georef);
    }
    refine_by(&t, "stationary");
    judge("stationary", &t, &dem->info.georef);
    tl_source_destroy(t.source);
    tl_source_destroy(dem);
    free(t.fine);
    free(t.coarse);
    free(t.made);
}

int main(int argc, char **argv)
{
    bench_print_machine();
    for (int k = 1; k < argc; k++)
        measure(argv[k]);
    if (argc == 1) {
        char path[4096];
        const char *root = getenv("TALUS_SOURCE_ROOT");
        snprintf(path, sizeof path, "%s/examples/jacksboro.tif", root ? root : ".");
        measure(path);
    }
    return 0;
}
