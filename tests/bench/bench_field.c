/* Nanoseconds per sample of the field as a source (level-0 reads, all levels, voids checked), tile by tile on one core,
 * by a field that was just made and by one that has read the same tiles before (it keeps numbers of the model's cells),
 * and of writing it to EXR with all cores; as ratios to a copy and to a plain write of the same bytes. */
#define _GNU_SOURCE /* O_TMPFILE */
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/talus.h"
#include "tests/bench/bench.h"

#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { DEM = 600, RUNS = 5, TILE_MAX = 512, OUTPUT = 4096 };

typedef struct work {
    const tl_source *source;
    int64_t tile, side; /* tiles of this size over side x side samples */
    float *out;
    tl_compression compression;
} work;

static void read_tiles(void *context)
{
    const work *w = context;
    for (int64_t y = 0; y + w->tile <= w->side; y += w->tile)
        for (int64_t x = 0; x + w->tile <= w->side; x += w->tile)
            tl_source_read(w->source, w->source->info.level, (tl_window){x, y, w->tile, w->tile}, w->out, NULL);
}

static double seconds_now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* A field, made anew for every run, and all tiles of it twice. */
static void measure_field(const char *what, const tl_source *dem, const tl_field_options *options)
{
    static float out[TILE_MAX * TILE_MAX];
    for (int64_t tile = 256; tile <= TILE_MAX; tile *= 2) {
        work w = {.tile = tile, .side = 2048, .out = out};
        double samples = (double)w.side * (double)w.side, best[2] = {1e9, 1e9};
        for (int run = 0; run < RUNS; run++) {
            tl_source *field = tl_field_create(dem, options, NULL);
            if (!field)
                exit(1);
            w.source = field;
            for (int again = 0; again < 2; again++) {
                double begin = seconds_now();
                read_tiles(&w);
                double seconds = seconds_now() - begin;
                best[again] = seconds < best[again] ? seconds : best[again];
            }
            tl_source_destroy(field);
        }
        printf("%-28s tiles of %3lld  %6.2f ns/sample, %6.2f again\n", what, (long long)tile, 1e9 * best[0] / samples,
               1e9 * best[1] / samples);
    }
}

static void measure_tiles(const char *what, const tl_source *source)
{
    static float out[TILE_MAX * TILE_MAX];
    for (int64_t tile = 256; tile <= TILE_MAX; tile *= 2) {
        work w = {.source = source, .tile = tile, .side = 2048, .out = out};
        double samples = (double)w.side * (double)w.side, copy = bench_copy((size_t)samples * sizeof(float), RUNS);
        double seconds = bench_minimum(read_tiles, &w, RUNS);
        printf("%-28s tiles of %3lld  %6.2f ns/sample (%5.1f copies)\n", what, (long long)tile, 1e9 * seconds / samples,
               seconds / copy);
    }
}

/* All tiles by one thread or by two, each into its own memory. */
typedef struct threads {
    const tl_source *source;
    int64_t tile, columns;
    unsigned threads;
    float *out[2];
} threads;

static tl_status read_one(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    const threads *t = context;
    tl_window window = {(int64_t)item % t->columns * t->tile, (int64_t)item / t->columns * t->tile, t->tile, t->tile};
    return tl_source_read(t->source, t->source->info.level, window, t->out[worker], error);
}

static void read_by_threads(void *context)
{
    threads *t = context;
    tl_run run = {.threads = t->threads};
    tl_error error;
    if (tl_parallel_for(&run, (uint64_t)(t->columns * t->columns), 0, read_one, t, &error) != TL_OK)
        exit(1);
}

static double processor_seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* In turns, so that what else the machine does hits both alike. On a busy machine only the processor time tells: two
 * threads that do not hinder each other take no more of it than one. */
static void measure_threads(const char *what, const tl_source *source)
{
    threads t = {.source = source, .tile = 256, .columns = 8};
    double best[2] = {1e9, 1e9}, used[2] = {1e9, 1e9};
    for (int k = 0; k < 2; k++)
        t.out[k] = calloc(TILE_MAX * TILE_MAX, sizeof *t.out[k]);
    for (int run = 0; run < 4 * RUNS; run++) {
        t.threads = 1 + (unsigned)run % 2;
        double before = processor_seconds(), seconds = bench_minimum(read_by_threads, &t, 1);
        double processor = processor_seconds() - before;
        best[run % 2] = seconds < best[run % 2] ? seconds : best[run % 2];
        used[run % 2] = processor < used[run % 2] ? processor : used[run % 2];
    }
    printf("%-28s two threads: %.2f times as fast as one, %.2f times the processor time\n", what, best[0] / best[1],
           used[1] / used[0]);
    for (int k = 0; k < 2; k++)
        free(t.out[k]);
}

static void write_exr(void *context)
{
    const work *w = context;
    tl_error error;
    tl_write_options options = {.overwrite = true, .compression = w->compression};
    if (tl_write_grid(w->source, "bench_field.exr", &options, &error) != TL_OK) {
        puts(error.text);
        exit(1);
    }
    unlink("bench_field.exr");
}

/* The same bytes from memory to an unnamed file in the same folder. */
static void write_plain(void *context)
{
    const work *w = context;
    int descriptor = open(".", O_TMPFILE | O_WRONLY, 0600);
    size_t row = (size_t)w->source->info.width * sizeof(float);
    for (int64_t j = 0; j < w->source->info.height && descriptor >= 0; j++)
        if (write(descriptor, w->out, row) != (ssize_t)row)
            exit(1);
    close(descriptor);
}

static void measure_writing(const tl_source *source)
{
    const struct {
        const char *name;
        tl_compression kind;
    } kinds[] = {{"none", TL_COMPRESSION_NONE}, {"zip", TL_COMPRESSION_ZIP}};
    float *row = calloc((size_t)source->info.width, sizeof *row);
    double samples = (double)source->info.width * (double)source->info.height;
    for (size_t k = 0; k < 2; k++) {
        work w = {.source = source, .out = row, .compression = kinds[k].kind};
        double plain = bench_minimum(write_plain, &w, RUNS), seconds = bench_minimum(write_exr, &w, RUNS);
        printf("field to EXR, %-4s (all cores)              %6.2f ns/sample (%5.1f plain writes)\n", kinds[k].name,
               1e9 * seconds / samples, seconds / plain);
    }
    free(row);
}

/* fBm of one exponent, and of maps. */
static void measure_fbm(const tl_source *dem)
{
    static float exponents[DEM * DEM], deltas[DEM * DEM];
    for (int k = 0; k < DEM * DEM; k++) {
        exponents[k] = .2F + .7F * (float)(k % DEM) / DEM;
        deltas[k] = 1 + (float)(k / DEM) / 100;
    }
    tl_source *hurst = tl_array_source_create(exponents, &dem->info, NULL);
    tl_source *delta = tl_array_source_create(deltas, &dem->info, NULL);
    for (int maps = 0; maps < 2; maps++) {
        tl_field_options options = {.levels = 4,
                                    .hurst_given = true,
                                    .hurst = .7,
                                    .delta_given = true,
                                    .delta = 3,
                                    .hurst_map = maps ? hurst : NULL,
                                    .delta_map = maps ? delta : NULL};
        tl_source *field = tl_field_create(dem, &options, NULL);
        if (!field)
            exit(1);
        char what[64];
        snprintf(what, sizeof what, "fBm%s, %s", maps ? " by maps" : "",
                 dem->info.type == TL_RASTER_AREA ? "area" : "point");
        measure_field(what, dem, &options);
        measure_threads(what, field);
        tl_source_destroy(field);
    }
    tl_source_destroy(hurst);
    tl_source_destroy(delta);
}

static float *make_dem(void)
{
    float *heights = malloc(sizeof *heights * DEM * DEM);
    tl_source *noise = tl_noise_create(&(tl_noise_options){.size = DEM, .hurst = 0.8, .delta = 5}, NULL);
    if (!heights || !noise ||
        tl_source_read(noise, noise->info.level, (tl_window){0, 0, DEM, DEM}, heights, NULL) != TL_OK)
        exit(1);
    tl_source_destroy(noise);
    return heights;
}

int main(void)
{
    bench_print_machine();
    float *heights = make_dem();
    tl_source_info info = {.width = DEM, .height = DEM, .georef = tl_georef_none(), .name = "dem"};
    for (int type = 0; type < 2; type++) {
        info.type = (tl_raster_type)type;
        tl_source *dem = tl_array_source_create(heights, &info, NULL);
        for (int levels = 2; levels <= 4; levels += 2) {
            char what[64];
            tl_field_options options = {.levels = levels};
            tl_source *field = tl_field_create(dem, &options, NULL);
            if (!field)
                return 1;
            snprintf(what, sizeof what, "field, %s, %d levels", type == TL_RASTER_AREA ? "area" : "point", levels);
            measure_field(what, dem, &options);
            measure_threads(what, field);
            if (levels == 2 && type == TL_RASTER_POINT)
                measure_writing(field);
            tl_source_destroy(field);
        }
        measure_fbm(dem);
        tl_source_destroy(dem);
    }
    tl_source *noise = tl_noise_create(&(tl_noise_options){.size = OUTPUT, .hurst = 0.8, .delta = 1}, NULL);
    measure_tiles("noise", noise);
    measure_threads("noise", noise);
    tl_source_destroy(noise);
    free(heights);
    return 0;
}
