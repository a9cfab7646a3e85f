/* Files of 4096 x 4096 floats on one thread and on two, beside plain writes of the same bytes; and GLBs of ten million
 * triangles. Heights lie in memory, so that only writing counts. bench_write [FOLDER [FILE]] */
#include "dem/crs.h"
#include "lib/base/georef.h"
#include "tests/bench/bench.h"

#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <unistd.h>

enum { SIZE = 4096, MESH = 2237 /* 2 x 2236^2 triangles */, RUNS = 3, PIECE = 1 << 20 };

typedef struct work {
    const char *folder;
    char path[4096];
    const tl_source *source;
    const tl_mesh *mesh;
    const float *heights;
    tl_write_options options;
    tl_run run;
    double raw; /* seconds of plain writes */
} work;

static void failed(const char *what)
{
    printf("%s: failed\n", what);
    exit(1);
}

/* As `dd bs=1M` does. */
static void write_plainly(void *context)
{
    const work *self = context;
    size_t bytes = (size_t)SIZE * SIZE * sizeof(float);
    unlink(self->path);
    int to = open(self->path, O_CREAT | O_WRONLY | O_TRUNC, 0666);
    for (size_t at = 0; at < bytes; at += PIECE)
        if (write(to, (const char *)self->heights + at, PIECE) != PIECE)
            failed(self->path);
    close(to);
}

static void write_grid(void *context)
{
    work *self = context;
    tl_error error;
    unlink(self->path);
    if (tl_write_grid(self->source, self->path, &self->options, &error) != TL_OK)
        failed(error.text);
}

static void write_mesh(void *context)
{
    work *self = context;
    tl_error error;
    unlink(self->path);
    if (tl_write_mesh(self->mesh, self->path, &self->options, &error) != TL_OK)
        failed(error.text);
}

static double megabytes(const char *path)
{
    struct stat status;
    return stat(path, &status) == 0 ? (double)status.st_size / 1e6 : 0;
}

static void time_grid(work *self, const char *name, const char *ending, tl_write_options options)
{
    double seconds[2];
    snprintf(self->path, sizeof self->path, "%s/bench-write.%s", self->folder, ending);
    for (unsigned threads = 1; threads <= 2; threads++) {
        self->run = (tl_run){.threads = threads};
        self->options = options;
        self->options.run = &self->run;
        seconds[threads - 1] = bench_minimum(write_grid, self, RUNS);
    }
    printf("%-14s %8.1f %8.3f %8.3f %8.2f %8.2f\n", name, megabytes(self->path), seconds[0], seconds[1],
           seconds[0] / seconds[1], seconds[1] / self->raw);
    unlink(self->path);
}

static void time_mesh(work *self, const char *name, tl_mesh_coding coding)
{
    snprintf(self->path, sizeof self->path, "%s/bench-write.glb", self->folder);
    self->options = (tl_write_options){.coding = coding, .ground = self->source};
    double seconds = bench_minimum(write_mesh, self, 1);
    struct rusage used;
    getrusage(RUSAGE_SELF, &used);
    printf("%-14s %8.1f %8.3f    %.0f MB at most\n", name, megabytes(self->path), seconds,
           (double)used.ru_maxrss / 1e3);
    unlink(self->path);
}

static void time_meshes(work *self, const tl_source_info *info)
{
    tl_source_info part = *info;
    part.width = part.height = MESH;
    tl_source *source = tl_array_source_create(self->heights, &part, NULL); /* rows of another width: as rough */
    tl_mesh *mesh = NULL;
    if (!source || tl_mesh_from_source(source, NULL, &mesh, NULL) != TL_OK)
        failed("mesh");
    const tl_source *whole = self->source;
    self->mesh = mesh;
    self->source = source;
    printf("\n%zu triangles    MB        s\n", mesh->triangle_count);
    time_mesh(self, "glb", TL_CODING_PLAIN);
    time_mesh(self, "glb quantized", TL_CODING_QUANTIZED);
    time_mesh(self, "glb meshopt", TL_CODING_COMPRESSED);
    self->source = whole;
    tl_mesh_destroy(mesh);
    tl_source_destroy(source);
}

static const struct {
    const char *name, *ending;
    tl_write_options options;
} files[] = {
    {"exr none", "exr", {.compression = TL_COMPRESSION_NONE}},
    {"exr zip", "exr", {.compression = TL_COMPRESSION_ZIP}},
    {"exr piz", "exr", {.compression = TL_COMPRESSION_PIZ}},
    {"tif none", "tif", {.compression = TL_COMPRESSION_NONE}},
    {"tif deflate", "tif", {.compression = TL_COMPRESSION_DEFLATE}},
    {"tif zstd", "tif", {.compression = TL_COMPRESSION_ZSTD}},
    {"tif lerc 0.01", "tif", {.compression = TL_COMPRESSION_LERC, .lerc_error = 0.01}},
    {"cog deflate", "tif", {.compression = TL_COMPRESSION_DEFLATE, .cog = true, .mip = TL_MIP_LATTICE}},
};

int main(int argc, char **argv)
{
    work self = {.folder = argc > 1 ? argv[1] : "."};
    float *heights = malloc((size_t)SIZE * SIZE * sizeof *heights);
    tl_crs *crs = NULL;
    tl_source *noise = tl_noise_create(&(tl_noise_options){.size = SIZE, .hurst = 0.8, .delta = 5, .seed = 1}, NULL);
    if (!heights || !noise || tl_source_read(noise, 0, (tl_window){0, 0, SIZE, SIZE}, heights, NULL) != TL_OK ||
        dem_crs_from_text("EPSG:32632", "bench", &crs, NULL) != TL_OK)
        failed("heights");
    tl_source_info info = {.width = SIZE, .height = SIZE, .name = "bench", .type = TL_RASTER_POINT};
    info.georef = (tl_georef){.crs = crs,
                              .located = true,
                              .transform = {400000, 10, 0, 5000000, 0, -10},
                              .cell_x = 10,
                              .cell_y = 10,
                              .height_unit = 1};
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    self.heights = heights;
    self.source = source;
    bench_print_machine();
    snprintf(self.path, sizeof self.path, "%s/bench-write.raw", self.folder);
    self.raw = bench_minimum(write_plainly, &self, RUNS);
    printf("\nfile                 MB      1 t      2 t    gain    x plain writes\n%-14s %8.1f %8.3f\n", "plain writes",
           megabytes(self.path), self.raw);
    unlink(self.path);
    for (size_t k = 0; k < sizeof files / sizeof *files; k++)
        if (argc < 3 || strcmp(argv[2], files[k].name) == 0)
            time_grid(&self, files[k].name, files[k].ending, files[k].options);
    tl_source_destroy(source);
    if (argc < 3 || strcmp(argv[2], "glb") == 0)
        time_meshes(&self, &info);
    tl_source_destroy(noise);
    tl_crs_release(crs);
    free(heights);
    return 0;
}
