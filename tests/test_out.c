/* Writers, judged by reading back: with our own readers, libpng, jansson, and by hand where there is no other. */
#define _GNU_SOURCE /* mkdtemp, memmem */
#include "dem/crs.h"
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/out/backlog.h"
#include "lib/out/frame.h"
#include "lib/out/out.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>

#include <cmocka.h>

#include "tests/near.h"

#include <dirent.h>
#include <jansson.h>
#include <limits.h>
#include <png.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

enum { WIDTH = 301, HEIGHT = 270 }; /* two tiles each way, the last ones cut */

/* ---- a folder and a source for every test ---- */

typedef struct place {
    char folder[64];
    char path[128];
    float *heights;
    tl_source_info info;
    tl_source *source;
} place;

static const tl_parameter parameters[] = {{"seed", "7"}, {"input", "a<b>&\"c\".tif"}};

static int setUp(void **state)
{
    place *p = calloc(1, sizeof *p);
    strcpy(p->folder, "/tmp/talus-test-XXXXXX");
    assert_non_null(mkdtemp(p->folder));
    p->heights = tl_alloc_grid(WIDTH, HEIGHT, sizeof *p->heights);
    for (int j = 0; j < HEIGHT; j++)
        for (int i = 0; i < WIDTH; i++)
            p->heights[j * WIDTH + i] =
                (i - 20) * (i - 20) + (j - 30) * (j - 30) < 90
                    ? NAN
                    : (float)(200 + 50 * sin(i * .05) * cos(j * .04) + 1e-3 * ((i * 7 + j * 13) % 101));
    tl_crs *crs = NULL;
    tl_error error;
    if (dem_crs_from_text("EPSG:32611", "test", &crs, &error) != TL_OK)
        fail_msg("%s", error.text);
    p->info = (tl_source_info){.width = WIDTH,
                               .height = HEIGHT,
                               .type = TL_RASTER_AREA,
                               .georef = {.crs = crs,
                                          .located = true,
                                          .transform = {400015, 30, 0, 3999985, 0, -30},
                                          .cell_x = 30,
                                          .cell_y = 30,
                                          .height_unit = 1},
                               .has_voids = true,
                               .name = "test",
                               .parameters = parameters,
                               .parameter_count = 2};
    p->source = tl_array_source_create(p->heights, &p->info, NULL);
    *state = p;
    return 0;
}

static int entries(const char *folder, bool remove_them)
{
    DIR *dir = opendir(folder);
    int count = 0;
    for (struct dirent *e; (e = readdir(dir));) {
        char path[400];
        snprintf(path, sizeof path, "%s/%s", folder, e->d_name);
        if (strcmp(e->d_name, ".") == 0 || strcmp(e->d_name, "..") == 0)
            continue;
        count++;
        if (remove_them)
            unlink(path);
    }
    closedir(dir);
    return count;
}

static int tearDown(void **state)
{
    place *p = *state;
    entries(p->folder, true);
    rmdir(p->folder);
    tl_source_destroy(p->source);
    tl_crs_release(p->info.georef.crs);
    free(p->heights);
    free(p);
    return 0;
}

static const char *in_folder(place *p, const char *name)
{
    snprintf(p->path, sizeof p->path, "%s/%s", p->folder, name);
    return p->path;
}

static unsigned char *slurp(const char *path, size_t *size)
{
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    fseek(f, 0, SEEK_END);
    *size = (size_t)ftell(f);
    rewind(f);
    unsigned char *bytes = malloc(*size + 1);
    assert_int_equal(fread(bytes, 1, *size, f), *size);
    bytes[*size] = 0;
    fclose(f);
    return bytes;
}

static void write_ok(const tl_source *source, const char *path, const tl_write_options *options)
{
    tl_error error;
    if (tl_write_grid(source, path, options, &error) != TL_OK)
        fail_msg("%s", error.text);
}

static tl_source *open_ok(const char *path)
{
    tl_error error;
    tl_source *source = tl_open(path, &error);
    if (!source)
        fail_msg("%s", error.text);
    return source;
}

static void check_equal(const tl_source *a, const float *heights)
{
    assert_int_equal(a->info.width, WIDTH);
    assert_int_equal(a->info.height, HEIGHT);
    float *read = tl_alloc_grid(WIDTH, HEIGHT, sizeof *read);
    assert_int_equal(tl_source_read(a, 0, (tl_window){0, 0, WIDTH, HEIGHT}, read, NULL), TL_OK);
    for (int k = 0; k < WIDTH * HEIGHT; k++)
        assert_true(read[k] == heights[k] || (isnan(read[k]) && isnan(heights[k])));
    free(read);
}

static void check_place(const tl_source_info *a, const tl_source_info *b)
{
    assert_int_equal(a->type, b->type);
    for (int k = 0; k < 6; k++)
        assert_near(a->georef.transform[k], b->georef.transform[k], 1e-9 * (1 + fabs(b->georef.transform[k])));
    assert_non_null(a->georef.crs);
    assert_string_equal(tl_crs_name(a->georef.crs), tl_crs_name(b->georef.crs));
    assert_near(a->georef.cell_x, b->georef.cell_x, 1e-6);
}

/* ---- grids ---- */

static void exrComesBackExactly(void **state)
{
    place *p = *state;
    const tl_compression kinds[] = {TL_COMPRESSION_DEFAULT, TL_COMPRESSION_NONE, TL_COMPRESSION_ZIP,
                                    TL_COMPRESSION_ZIPS, TL_COMPRESSION_PIZ};
    for (int type = 0; type < 2; type++)
        for (size_t k = 0; k < sizeof kinds / sizeof *kinds; k++) {
            p->source->info.type = p->info.type = (tl_raster_type)type;
            write_ok(p->source, in_folder(p, "a.exr"), &(tl_write_options){.compression = kinds[k], .overwrite = true});
            tl_source *back = open_ok(p->path);
            check_equal(back, p->heights);
            check_place(&back->info, &p->info);
            bool seed = false;
            for (size_t i = 0; i < back->info.parameter_count; i++)
                seed |= strcmp(back->info.parameters[i].name, "seed") == 0 &&
                        strcmp(back->info.parameters[i].value, "7") == 0;
            assert_true(seed);
            tl_source_destroy(back);
        }
}

static void exrStatesTheRange(void **state)
{
    place *p = *state;
    write_ok(p->source, in_folder(p, "a.exr"), NULL);
    tl_range range;
    assert_int_equal(tl_source_range(p->source, NULL, &range, NULL), TL_OK);
    size_t size;
    unsigned char *bytes = slurp(p->path, &size);
    const char *at = memmem(bytes, size, "talus:lowest\0float\0\4\0\0\0", 23);
    assert_non_null(at);
    assert_memory_equal(at + 23, &range.low, 4);
    at = memmem(bytes, size, "talus:highest\0float\0\4\0\0\0", 24);
    assert_non_null(at);
    assert_memory_equal(at + 24, &range.high, 4);
    free(bytes);
}

static void geotiffComesBackExactly(void **state)
{
    place *p = *state;
    for (int type = 0; type < 2; type++)
        for (int packed = 0; packed < 2; packed++) {
            p->source->info.type = p->info.type = (tl_raster_type)type;
            write_ok(p->source, in_folder(p, "a.tif"),
                     &(tl_write_options){.compression = packed ? TL_COMPRESSION_ZIP : TL_COMPRESSION_NONE,
                                         .overwrite = true});
            tl_source *back = open_ok(p->path);
            check_equal(back, p->heights);
            check_place(&back->info, &p->info);
            assert_int_equal(tl_crs_epsg(back->info.georef.crs), 32611);
            tl_source_destroy(back);
        }
    tl_error error;
    assert_int_equal(
        tl_write_grid(p->source, in_folder(p, "b.tif"), &(tl_write_options){.compression = TL_COMPRESSION_PIZ}, &error),
        TL_ERROR_ARGUMENT);
    assert_int_equal(entries(p->folder, false), 1);
}

static void geotiffKeepsRotatedAndMirroredGrids(void **state)
{
    place *p = *state;
    const double transforms[][6] = {{100, 2, 0.5, 900, 0.25, -3}, {100, 2, 0, 900, 0, 3}, {100, -2, 0, 900, 0, -3}};
    for (size_t k = 0; k < 3; k++)
        for (int type = 0; type < 2; type++) {
            memcpy(p->source->info.georef.transform, transforms[k], sizeof transforms[k]);
            p->source->info.type = (tl_raster_type)type;
            write_ok(p->source, in_folder(p, "a.tif"), &(tl_write_options){.overwrite = true});
            tl_source *back = open_ok(p->path);
            check_equal(back, p->heights);
            for (int n = 0; n < 6; n++)
                assert_near(back->info.georef.transform[n], transforms[k][n], 1e-9);
            tl_source_destroy(back);
        }
}

static void unlocatedRastersStayUnlocated(void **state)
{
    place *p = *state;
    p->source->info.georef = tl_georef_none();
    const char *const names[] = {"a.exr", "a.tif"};
    for (size_t k = 0; k < 2; k++) {
        write_ok(p->source, in_folder(p, names[k]), NULL);
        tl_source *back = open_ok(p->path);
        assert_false(back->info.georef.located);
        assert_null(back->info.georef.crs);
        tl_source_destroy(back);
    }
}

static void picturesHaveTheNorthOnTop(void **state)
{
    place *p = *state;
    p->source->info.georef.transform[5] = 30; /* stored from south to north */
    write_ok(p->source, in_folder(p, "a.exr"), NULL);
    tl_source *back = open_ok(p->path);
    float row[WIDTH];
    assert_int_equal(tl_source_read(back, 0, (tl_window){0, 0, WIDTH, 1}, row, NULL), TL_OK);
    assert_memory_equal(row, p->heights + (HEIGHT - 1) * WIDTH, sizeof row);
    assert_near(back->info.georef.transform[5], -30, 0);
    assert_near(back->info.georef.transform[3], 3999985 + 30.0 * (HEIGHT - 1), 1e-6);
    tl_source_destroy(back);
}

static void validityTravelsBesideTheHeights(void **state)
{
    place *p = *state;
    const char *const names[] = {"a.exr", "a.tif", "a.png"};
    for (size_t k = 0; k < 3; k++)
        for (int rows = 0; rows < 2; rows++) {
            p->source->info.georef.transform[5] = rows ? 30 : -30;
            tl_source *filled = tl_voids_create(p->source, &(tl_void_options){.rule = TL_VOIDS_FILL}, NULL);
            write_ok(filled, in_folder(p, names[k]), &(tl_write_options){.validity = true, .overwrite = true});
            tl_source *back = open_ok(in_folder(p, "a.validity.tif"));
            float *read = tl_alloc_grid(WIDTH, HEIGHT, sizeof *read);
            assert_int_equal(tl_source_read(back, 0, (tl_window){0, 0, WIDTH, HEIGHT}, read, NULL), TL_OK);
            bool turned = rows && k != 1; /* GeoTIFF keeps the source's order of rows */
            for (int n = 0; n < WIDTH * HEIGHT; n++) {
                int from = turned ? (HEIGHT - 1 - n / WIDTH) * WIDTH + n % WIDTH : n;
                assert_true(read[n] == (isnan(p->heights[from]) ? TL_FILLED : TL_MEASURED));
            }
            assert_near(back->info.georef.transform[5], turned ? -30 : p->source->info.georef.transform[5], 0);
            free(read);
            tl_source_destroy(back);
            tl_source_destroy(filled);
        }
}

static void png16IsWithinHalfAStep(void **state)
{
    place *p = *state;
    write_ok(p->source, in_folder(p, "a.png"), NULL);
    FILE *f = fopen(p->path, "rb");
    png_structp png = png_create_read_struct(PNG_LIBPNG_VER_STRING, NULL, NULL, NULL);
    png_infop info = png_create_info_struct(png);
    png_init_io(png, f);
    png_read_png(png, info, PNG_TRANSFORM_SWAP_ENDIAN, NULL);
    assert_int_equal(png_get_image_width(png, info), WIDTH);
    assert_int_equal(png_get_bit_depth(png, info), 16);
    png_bytepp rows = png_get_rows(png, info);
    json_t *json = json_load_file(in_folder(p, "a.json"), 0, NULL);
    assert_non_null(json);
    double scale = json_real_value(json_object_get(json, "scale")),
           offset = json_real_value(json_object_get(json, "offset"));
    assert_int_equal(json_integer_value(json_object_get(json, "void")), 0);
    for (int j = 0; j < HEIGHT; j++)
        for (int i = 0; i < WIDTH; i++) {
            uint16_t value = ((const uint16_t *)(const void *)rows[j])[i];
            float height = p->heights[j * WIDTH + i];
            assert_int_equal(value == 0, isnan(height) != 0);
            if (value)
                assert_near(offset + scale * value, (double)height, 0.5 * scale + 1e-9);
        }
    assert_string_equal(json_string_value(json_object_get(json_object_get(json, "parameters"), "seed")), "7");
    json_decref(json);
    png_destroy_read_struct(&png, &info, NULL);
    fclose(f);
}

/* The bytes of a file of this size; free them. */
static unsigned char *load_exactly(const char *path, size_t count)
{
    FILE *file = fopen(path, "rb");
    unsigned char *bytes = malloc(count + 1);
    assert_non_null(file);
    assert_int_equal(fread(bytes, 1, count + 1, file), count);
    fclose(file);
    return bytes;
}

static void plainNumbersAreThoseOfTheSidecar(void **state)
{
    place *p = *state;
    write_ok(p->source, in_folder(p, "a.raw"), NULL);
    unsigned char *raw = load_exactly(p->path, 4 * WIDTH * HEIGHT);
    assert_memory_equal(raw, p->heights, 4 * WIDTH * HEIGHT); /* tests run on little-endian machines */
    free(raw);
    write_ok(p->source, in_folder(p, "b.r16"), NULL);
    unsigned char *values = load_exactly(p->path, 2 * WIDTH * HEIGHT);
    json_t *json = json_load_file(in_folder(p, "b.r16.json"), 0, NULL);
    double scale = json_real_value(json_object_get(json, "scale")),
           offset = json_real_value(json_object_get(json, "offset"));
    for (int k = 0; k < WIDTH * HEIGHT; k++) {
        int value = values[2 * k] | values[2 * k + 1] << 8;
        assert_int_equal(value == 0, isnan(p->heights[k]) != 0);
        if (value)
            assert_near(offset + scale * value, (double)p->heights[k], 0.5 * scale + 1e-9);
    }
    json_decref(json);
    free(values);
}

/* Unity's tiles: from the middle, the south first, with shared rims and one scale; voids are the lowest height. */
static void presetsCutAndTurn(void **state)
{
    place *p = *state;
    tl_preset_options options = {.preset = "unity", .tile = 129};
    tl_preset_report report;
    tl_error error;
    if (tl_write_preset(p->source, in_folder(p, "land.r16"), &options, &report, &error) != TL_OK)
        fail_msg("%s", error.text);
    assert_int_equal(report.columns, 2);
    assert_int_equal(report.rows, 2);
    assert_int_equal(report.window.x, (WIDTH - 257) / 2);
    assert_int_equal(report.window.y, (HEIGHT - 257) / 2);
    assert_non_null(strstr(report.import, "Terrain Size X 3840,")); /* 128 cells of 30 m */
    json_t *json = json_load_file(in_folder(p, "land.json"), 0, NULL);
    double scale = json_real_value(json_object_get(json, "scale")),
           offset = json_real_value(json_object_get(json, "offset"));
    assert_int_equal(json_array_size(json_object_get(json, "tiles")), 4);
    assert_near(offset, (double)report.low, 0);
    assert_near(offset + 65535 * scale, (double)report.high, 1e-9);
    for (int row = 0; row < 2; row++)
        for (int column = 0; column < 2; column++) {
            char name[32];
            snprintf(name, sizeof name, "land_x%d_y%d.r16", column, row);
            unsigned char *values = load_exactly(in_folder(p, name), 2 * 129 * 129);
            for (int k = 0; k < 129 * 129; k++) {
                int x = (int)report.window.x + 128 * column + k % 129;
                int y = (int)report.window.y + 256 - (128 * row + k / 129); /* from the south */
                float height = p->heights[y * WIDTH + x];
                double found = offset + scale * (values[2 * k] | values[2 * k + 1] << 8);
                assert_near(found, isnan(height) ? (double)report.low : (double)height, 0.5 * scale + 1e-9);
            }
            free(values);
        }
    json_decref(json);
    /* a file in the way of the last tile: the others are taken back */
    assert_int_equal(unlink(in_folder(p, "land_x0_y0.r16")) | unlink(in_folder(p, "land_x1_y0.r16")) |
                         unlink(in_folder(p, "land_x0_y1.r16")) | unlink(in_folder(p, "land.json")),
                     0);
    assert_int_not_equal(tl_write_preset(p->source, in_folder(p, "land.r16"), &options, NULL, &error), TL_OK);
    assert_non_null(strstr(error.text, "land_x1_y1.r16"));
    assert_int_equal(access(in_folder(p, "land_x0_y0.r16"), F_OK) & access(in_folder(p, "land.json"), F_OK), -1);
}

static void presetsRefuseWhatTheirProgramsDo(void **state)
{
    place *p = *state;
    static const struct {
        const char *preset, *name;
        int64_t tile;
        const char *told;
    } cases[] = {{"unreal", "a.exr", 0, "png r16"},
                 {"unreal", "a.png", 128, "none of unreal's"},
                 {"godot", "a.r16", 0, "use more levels"},
                 {"doom", "a.r16", 0, "no preset 'doom'"},
                 {"blender", "a.exr", 129, "one file"}};
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        tl_preset_options options = {.preset = cases[k].preset, .tile = cases[k].tile};
        tl_error error;
        assert_int_equal(tl_write_preset(p->source, in_folder(p, cases[k].name), &options, NULL, &error),
                         TL_ERROR_ARGUMENT);
        assert_non_null(strstr(error.text, cases[k].told));
        assert_int_equal(access(p->path, F_OK), -1);
    }
    tl_preset_report report;
    write_ok(p->source, in_folder(p, "a.exr"), NULL);
    assert_int_equal(
        tl_write_preset(p->source, in_folder(p, "b.exr"), &(tl_preset_options){.preset = "houdini"}, &report, NULL),
        TL_OK);
    assert_non_null(strstr(report.import, "Grid Spacing 30"));
}

static void constantAndVoidGridsAreWritten(void **state)
{
    place *p = *state;
    const char *const names[] = {"a.exr", "a.tif", "a.png", "a.ply", "a.obj", "a.r16", "a.raw"};
    const float values[] = {5, NAN, -0.0f, 1e30f};
    for (size_t v = 0; v < 4; v++)
        for (size_t k = 0; k < 7; k++) {
            for (int n = 0; n < WIDTH * HEIGHT; n++)
                p->heights[n] = values[v];
            write_ok(p->source, in_folder(p, names[k]), &(tl_write_options){.overwrite = true});
        }
    tl_error error;
    for (int n = 0; n < WIDTH * HEIGHT; n++)
        p->heights[n] = NAN;
    assert_int_equal(tl_write_grid(p->source, in_folder(p, "a.glb"), NULL, &error), TL_ERROR_DATA);
    assert_int_equal(access(p->path, F_OK), -1);
}

static void threadsDoNotChangeTheBytes(void **state)
{
    place *p = *state;
    const char *const names[] = {"a.exr", "a.tif", "a.png", "a.json", "a.ply", "a.obj", "a.glb", "a.r16", "a.raw"};
    for (size_t k = 0; k < 9; k++) {
        unsigned char *bytes[2];
        size_t size[2];
        for (unsigned n = 0; n < 2; n++) {
            tl_run run = {.threads = n ? 4 : 1};
            if (k != 3) /* the JSON comes with the PNG */
                write_ok(p->source, in_folder(p, names[k]), &(tl_write_options){.overwrite = true, .run = &run});
            bytes[n] = slurp(in_folder(p, names[k]), &size[n]);
        }
        assert_int_equal(size[0], size[1]);
        assert_memory_equal(bytes[0], bytes[1], size[0]);
        free(bytes[0]);
        free(bytes[1]);
    }
}

/* ---- failures ---- */

static tl_status refuse(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    (void)self;
    (void)level;
    for (int64_t k = 0; k < window.width * window.height; k++)
        out[k] = 0;
    return window.y + window.height > 200 ? tl_fail(error, TL_ERROR_DATA, "row 200 is broken") : TL_OK;
}

static void aFailingSourceLeavesNothing(void **state)
{
    place *p = *state;
    const char *const names[] = {"a.exr", "a.tif", "a.png", "a.ply", "a.obj", "a.glb"};
    tl_source broken = *p->source;
    broken.read = refuse;
    for (size_t k = 0; k < 6; k++) {
        tl_error error = {0};
        assert_int_equal(tl_write_grid(&broken, in_folder(p, names[k]), NULL, &error), TL_ERROR_DATA);
        assert_string_equal(error.text, "row 200 is broken");
        assert_int_equal(entries(p->folder, false), 0);
    }
}

static void cancellingLeavesNothing(void **state)
{
    place *p = *state;
    const char *const names[] = {"a.exr", "a.tif", "a.png", "a.ply", "a.obj", "a.glb"};
    int raised = 1;
    for (size_t k = 0; k < 6; k++)
        for (unsigned threads = 1; threads < 4; threads += 2) {
            tl_run run = {.threads = threads, .cancel = &raised};
            assert_int_equal(tl_write_grid(p->source, in_folder(p, names[k]), &(tl_write_options){.run = &run}, NULL),
                             TL_ERROR_CANCELLED);
            assert_int_equal(entries(p->folder, false), 0);
        }
}

static void unknownEndingsAreTold(void **state)
{
    place *p = *state;
    tl_error error;
    assert_int_equal(tl_write_grid(p->source, in_folder(p, "a.xyz"), NULL, &error), TL_ERROR_ARGUMENT);
    assert_int_equal(tl_write_grid(p->source, in_folder(p, "noending"), NULL, &error), TL_ERROR_ARGUMENT);
    assert_null(tl_format_of("folder.exr/file"));
    assert_null(tl_format_of(".exr"));
    assert_string_equal(tl_format_of("x/y.EXR")->ending, "exr");
    assert_int_equal(entries(p->folder, false), 0);
}

static void damagedExrIsAnError(void **state)
{
    place *p = *state;
    write_ok(p->source, in_folder(p, "a.exr"), NULL);
    size_t size;
    unsigned char *bytes = slurp(p->path, &size);
    char copy[200];
    snprintf(copy, sizeof copy, "%s/b.exr", p->folder);
    float *heights = tl_alloc_grid(WIDTH, HEIGHT, sizeof *heights);
    uint64_t random = 1;
    for (int round = 0; round < 200; round++) {
        random = random * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
        size_t length = round < 60 ? size * (size_t)round / 60 : size,
               at = (size_t)(random >> 33) % (round % 2 ? 3000 : size);
        unsigned char kept = bytes[at];
        if (round >= 60)
            bytes[at] ^= (unsigned char)(1u << (round % 8));
        FILE *f = fopen(copy, "wb");
        fwrite(bytes, 1, length, f);
        fclose(f);
        bytes[at] = kept;
        tl_error error = {0};
        tl_source *source = tl_open(copy, &error);
        if (source && source->info.width == WIDTH && source->info.height == HEIGHT)
            tl_source_read(source, 0, (tl_window){0, 0, WIDTH, HEIGHT}, heights, &error);
        if (!source)
            assert_true(strstr(error.text, "b.exr") != NULL);
        tl_source_destroy(source);
    }
    free(heights);
    free(bytes);
}

/* ---- meshes ---- */

static tl_mesh *make_mesh(place *p)
{
    tl_mesh *mesh = NULL;
    assert_int_equal(tl_mesh_from_source(p->source, NULL, &mesh, NULL), TL_OK);
    return mesh;
}

static void glbHoldsWhatItsHeaderSays(void **state)
{
    place *p = *state;
    tl_mesh *mesh = make_mesh(p);
    assert_int_equal(tl_write_mesh(mesh, in_folder(p, "a.glb"), NULL, NULL), TL_OK);
    size_t size;
    unsigned char *bytes = slurp(p->path, &size);
    uint32_t head[5], binary[2];
    memcpy(head, bytes, sizeof head);
    assert_int_equal(head[0], 0x46546c67);
    assert_int_equal(head[2], size);
    assert_int_equal(head[3] % 4, 0);
    memcpy(binary, bytes + 20 + head[3], sizeof binary);
    assert_int_equal(20 + head[3] + 8 + binary[0], size);
    json_t *json = json_loadb((const char *)bytes + 20, head[3], 0, NULL);
    assert_non_null(json);
    json_t *position = json_array_get(json_object_get(json, "accessors"), 0);
    assert_int_equal(json_integer_value(json_object_get(position, "count")), mesh->vertex_count);
    /* 300 x 30 m from west to east, 269 x 30 m from north to south, in a frame tangent to the ellipsoid; the grid of a
     * UTM zone is turned and scaled against it by less than 2 % */
    json_t *low = json_object_get(position, "min"), *high = json_object_get(position, "max");
    assert_near(json_number_value(json_array_get(high, 0)) - json_number_value(json_array_get(low, 0)), 9000, 200);
    assert_near(json_number_value(json_array_get(high, 2)) - json_number_value(json_array_get(low, 2)), 8070, 200);
    json_decref(json);
    free(bytes);
    tl_mesh_destroy(mesh);
}

static double signed_area(const tl_mesh *mesh, double (*xyz)[3])
{
    double sum = 0;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        const double *a = xyz[mesh->indices[3 * t]], *b = xyz[mesh->indices[3 * t + 1]],
                     *c = xyz[mesh->indices[3 * t + 2]];
        sum += 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]));
    }
    return sum;
}

static void framesPlaceTheMesh(void **state)
{
    place *p = *state;
    tl_mesh *mesh = make_mesh(p);
    double(*xyz)[3] = tl_alloc(mesh->vertex_count, sizeof *xyz);
    double whole = (double)mesh->triangle_count / 2 * 900;
    const struct {
        tl_frame kind;
        double area, tolerance; /* square metres, or cells */
    } cases[] = {{TL_FRAME_PROJECTED, whole, 1e-6}, {TL_FRAME_ENU, whole, 2e-3}, {TL_FRAME_PIXEL, -whole / 900, 1e-9}};
    for (size_t k = 0; k < 3; k++) {
        out_frame *frame = out_frame_create(mesh, cases[k].kind, "test", NULL);
        assert_non_null(frame);
        assert_int_equal(out_frame_apply(frame, mesh->vertices, mesh->vertex_count, xyz, NULL), TL_OK);
        assert_near(signed_area(mesh, xyz) / cases[k].area, 1, cases[k].tolerance);
        assert_int_equal(out_frame_faces_up(frame), cases[k].area > 0);
        out_frame_destroy(frame);
    }
    mesh->georef.located = false;
    tl_error error;
    assert_null(out_frame_create(mesh, TL_FRAME_ENU, "test", &error));
    assert_non_null(strstr(error.text, "--frame projected"));
    out_frame *frame = out_frame_create(mesh, TL_FRAME_DEFAULT, "test", &error);
    assert_int_equal(out_frame_kind(frame), TL_FRAME_PROJECTED);
    out_frame_destroy(frame);
    free(xyz);
    tl_mesh_destroy(mesh);
}

/* A hemisphere seen from above: the corners of the map show no ground. */
static void samplesWithoutAPlaceAreTold(void **state)
{
    place *p = *state;
    const char *const names[] = {"a.glb", "a.obj", "a.ply"};
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text("+proj=ortho +lat_0=0 +lon_0=0 +R=6378137", "test", &crs, NULL), TL_OK);
    p->source->info.georef.crs = crs;
    const double transform[6] = {-7e6, 14e6 / WIDTH, 0, 7e6, 0, -14e6 / HEIGHT};
    memcpy(p->source->info.georef.transform, transform, sizeof transform);
    tl_mesh *mesh = make_mesh(p);
    for (size_t k = 0; k < 3; k++) {
        tl_error error;
        assert_int_equal(tl_write_mesh(mesh, in_folder(p, names[k]), NULL, &error), TL_ERROR_DATA);
        assert_non_null(strstr(error.text, "column 0, row 0"));
    }
    assert_int_equal(entries(p->folder, false), 0);
    tl_mesh_destroy(mesh);
    p->source->info.georef.crs = p->info.georef.crs;
    tl_crs_release(crs);
}

static void plyHoldsTheSamples(void **state)
{
    place *p = *state;
    tl_mesh *mesh = make_mesh(p);
    assert_int_equal(tl_write_mesh(mesh, in_folder(p, "a.ply"), &(tl_write_options){.frame = TL_FRAME_PIXEL}, NULL),
                     TL_OK);
    size_t size;
    unsigned char *bytes = slurp(p->path, &size);
    const unsigned char *body = memmem(bytes, size, "end_header\n", 11);
    assert_non_null(body);
    body += 11;
    assert_int_equal((size_t)(body - bytes) + 12 * mesh->vertex_count + 13 * mesh->triangle_count, size);
    for (size_t k = 0; k < mesh->vertex_count; k += 97) {
        float at[3];
        memcpy(at, body + 12 * k, 12);
        assert_true(at[0] == (float)mesh->vertices[k].i && at[1] == (float)mesh->vertices[k].j &&
                    at[2] == mesh->vertices[k].z);
    }
    free(bytes);
    tl_mesh_destroy(mesh);
}

static void objCountsFromOne(void **state)
{
    place *p = *state;
    tl_mesh *mesh = make_mesh(p);
    assert_int_equal(tl_write_mesh(mesh, in_folder(p, "a.obj"), NULL, NULL), TL_OK);
    FILE *f = fopen(p->path, "r");
    char line[256];
    size_t vertices = 0, faces = 0;
    unsigned long low = ULONG_MAX, high = 0, n[3];
    while (fgets(line, sizeof line, f)) {
        vertices += line[0] == 'v';
        if (line[0] != 'f')
            continue;
        faces++;
        assert_int_equal(sscanf(line, "f %lu %lu %lu", &n[0], &n[1], &n[2]), 3);
        for (int k = 0; k < 3; k++) {
            low = n[k] < low ? n[k] : low;
            high = n[k] > high ? n[k] : high;
        }
    }
    fclose(f);
    assert_int_equal(vertices, mesh->vertex_count);
    assert_int_equal(faces, mesh->triangle_count);
    assert_int_equal(low, 1);
    assert_int_equal(high, mesh->vertex_count);
    tl_mesh_destroy(mesh);
}

/* ---- tiles before their turn ---- */

enum { TILES = 40, AHEAD = 5 };

typedef struct late {
    out_backlog backlog;
    atomic_int added;
    int written;
    uint64_t refused; /* a tile whose writing fails */
} late;

static tl_status write_in_order(void *context, uint64_t tile, const void *bytes, size_t count, tl_error *error)
{
    late *self = context;
    uint64_t value = 0;
    if (tile == self->refused)
        return tl_fail(error, TL_ERROR_IO, "no room for tile %d", (int)tile);
    memcpy(&value, bytes, count);
    assert_int_equal(tile, self->written++);
    assert_int_equal(value, tile);
    return TL_OK;
}

/* Two tiles are slow: they wait until the other worker is well ahead. The refused one is before the second. */
static tl_status add_tile(void *context, tl_parallel *loop, uint64_t tile, unsigned worker, tl_error *error)
{
    (void)worker;
    late *self = context;
    while (tile % 20 == 0 && self->added < (int)tile + AHEAD)
        sched_yield();
    self->added++;
    uint64_t value = tile;
    return out_backlog_add(&self->backlog, loop, tile, &value, sizeof value, error);
}

static void aSlowTileHoldsNobodyUp(void **state)
{
    (void)state;
    for (int fails = 0; fails < 2; fails++) {
        late self = {.refused = fails ? 5 : TILES};
        tl_error error;
        self.backlog = (out_backlog){.write = write_in_order, .context = &self};
        assert_int_equal(out_backlog_init(&self.backlog, 2, "late", &error), TL_OK);
        tl_status status = tl_parallel_for(&(tl_run){.threads = 2}, TILES, 0, add_tile, &self, &error);
        assert_int_equal(status, fails ? TL_ERROR_IO : TL_OK);
        assert_int_equal(self.written, fails ? 5 : TILES);
        out_backlog_finish(&self.backlog);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup_teardown(exrComesBackExactly, setUp, tearDown),
        cmocka_unit_test_setup_teardown(exrStatesTheRange, setUp, tearDown),
        cmocka_unit_test_setup_teardown(geotiffComesBackExactly, setUp, tearDown),
        cmocka_unit_test_setup_teardown(geotiffKeepsRotatedAndMirroredGrids, setUp, tearDown),
        cmocka_unit_test_setup_teardown(unlocatedRastersStayUnlocated, setUp, tearDown),
        cmocka_unit_test_setup_teardown(picturesHaveTheNorthOnTop, setUp, tearDown),
        cmocka_unit_test_setup_teardown(validityTravelsBesideTheHeights, setUp, tearDown),
        cmocka_unit_test_setup_teardown(png16IsWithinHalfAStep, setUp, tearDown),
        cmocka_unit_test_setup_teardown(plainNumbersAreThoseOfTheSidecar, setUp, tearDown),
        cmocka_unit_test_setup_teardown(presetsCutAndTurn, setUp, tearDown),
        cmocka_unit_test_setup_teardown(presetsRefuseWhatTheirProgramsDo, setUp, tearDown),
        cmocka_unit_test_setup_teardown(constantAndVoidGridsAreWritten, setUp, tearDown),
        cmocka_unit_test_setup_teardown(threadsDoNotChangeTheBytes, setUp, tearDown),
        cmocka_unit_test_setup_teardown(aFailingSourceLeavesNothing, setUp, tearDown),
        cmocka_unit_test_setup_teardown(cancellingLeavesNothing, setUp, tearDown),
        cmocka_unit_test_setup_teardown(unknownEndingsAreTold, setUp, tearDown),
        cmocka_unit_test_setup_teardown(damagedExrIsAnError, setUp, tearDown),
        cmocka_unit_test_setup_teardown(glbHoldsWhatItsHeaderSays, setUp, tearDown),
        cmocka_unit_test_setup_teardown(framesPlaceTheMesh, setUp, tearDown),
        cmocka_unit_test_setup_teardown(samplesWithoutAPlaceAreTold, setUp, tearDown),
        cmocka_unit_test_setup_teardown(plyHoldsTheSamples, setUp, tearDown),
        cmocka_unit_test_setup_teardown(objCountsFromOne, setUp, tearDown),
        cmocka_unit_test(aSlowTileHoldsNobodyUp),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
