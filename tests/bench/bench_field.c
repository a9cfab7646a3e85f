/* Nanoseconds per sample of the field as a source (level-0 reads, all levels, voids checked), tile by tile on one core,
 * and of writing it to EXR with all cores; as ratios to a copy and to a plain write of the same bytes. */
#define _GNU_SOURCE /* O_TMPFILE */
#include "lib/base/georef.h"
#include "lib/talus.h"
#include "tests/bench/bench.h"

#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
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
            tl_source *field = tl_field_create(dem, &(tl_field_options){.levels = levels}, NULL);
            if (!field)
                return 1;
            snprintf(what, sizeof what, "field, %s, %d levels", type == TL_RASTER_AREA ? "area" : "point", levels);
            measure_tiles(what, field);
            if (levels == 2 && type == TL_RASTER_POINT)
                measure_writing(field);
            tl_source_destroy(field);
        }
        tl_source_destroy(dem);
    }
    tl_source *noise = tl_noise_create(&(tl_noise_options){.size = OUTPUT, .hurst = 0.8, .delta = 1}, NULL);
    measure_tiles("noise", noise);
    tl_source_destroy(noise);
    free(heights);
    return 0;
}
