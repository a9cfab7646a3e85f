/* Tiles of heights: shared edges, levels, voids beyond the rim, 16-bit values, and the same bytes from any threads,
 * shards and breaks. */
#include "lib/talus.h"

#include <dirent.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cmocka.h>

#include "near.h"

enum { WIDTH = 75, HEIGHT = 50, TILE = 17, CELLS = TILE - 1, LEVELS = 4 };

static char folder[64];
static float heights[WIDTH * HEIGHT];

/* ---- Rasters and folders ---- */

static bool is_void(int i, int j)
{
    return i > 30 && i < 70 && j < 20;
}

static tl_source *make_source(tl_raster_type type, bool south_up)
{
    tl_error error;
    tl_source_info info = {.width = WIDTH, .height = HEIGHT, .type = type, .has_voids = true, .name = "hills"};
    double down = south_up ? 10 : -10;
    info.georef = (tl_georef){
        .located = true, .transform = {500, 10, 0, 9000, 0, down}, .cell_x = 10, .cell_y = 10, .height_unit = 1};
    for (int j = 0; j < HEIGHT; j++)
        for (int i = 0; i < WIDTH; i++)
            heights[j * WIDTH + i] = is_void(i, j) ? NAN : (float)(100 + 30 * sin(i * .3) * cos(j * .2) + i);
    tl_source *source = tl_array_source_create(heights, &info, &error);
    assert_non_null(source);
    return source;
}

static void remove_all(const char *path)
{
    DIR *directory = opendir(path);
    struct dirent *entry;
    while (directory && (entry = readdir(directory))) {
        char inside[512];
        if (strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0)
            continue;
        snprintf(inside, sizeof inside, "%s/%s", path, entry->d_name);
        if (unlink(inside))
            remove_all(inside);
    }
    if (directory)
        closedir(directory);
    rmdir(path);
}

static int begin(void **state)
{
    (void)state;
    strcpy(folder, "/tmp/talus-grid-tiles-XXXXXX");
    return mkdtemp(folder) ? 0 : -1;
}

static int end(void **state)
{
    (void)state;
    remove_all(folder);
    return 0;
}

/* A hash of the names and bytes of all files: in no order, so sums. */
static uint64_t hash_tree(const char *path, size_t from, size_t *files)
{
    DIR *directory = opendir(path);
    struct dirent *entry;
    uint64_t sum = 0;
    while (directory && (entry = readdir(directory))) {
        char inside[512];
        if (strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0)
            continue;
        snprintf(inside, sizeof inside, "%s/%s", path, entry->d_name);
        struct stat found;
        assert_int_equal(stat(inside, &found), 0);
        if (S_ISDIR(found.st_mode)) {
            sum += hash_tree(inside, from, files);
            continue;
        }
        uint64_t hash = UINT64_C(14695981039346656037);
        for (const char *c = inside + from; *c; c++)
            hash = (hash ^ (unsigned char)*c) * UINT64_C(1099511628211);
        FILE *file = fopen(inside, "rb");
        for (int c; (c = fgetc(file)) != EOF;)
            hash = (hash ^ (unsigned char)c) * UINT64_C(1099511628211);
        fclose(file);
        sum += hash;
        ++*files;
    }
    if (directory)
        closedir(directory);
    return sum;
}

static uint64_t hash_of(const char *path, size_t *files)
{
    size_t none = 0;
    return hash_tree(path, strlen(path), files ? files : &none);
}

/* ---- Reading tiles ---- */

/* The heights of a tile; false where there is no such file. */
static bool read_tile(const char *where, int level, int64_t column, int64_t row, const char *ending,
                      float out[TILE * TILE])
{
    char path[512];
    tl_error error;
    snprintf(path, sizeof path, "%s/%d/%d_%d.%s", where, level, (int)column, (int)row, ending);
    if (access(path, F_OK))
        return false;
    if (strcmp(ending, "raw") == 0) {
        FILE *file = fopen(path, "rb");
        assert_int_equal(fread(out, sizeof *out, TILE * TILE, file), TILE * TILE);
        assert_int_equal(fgetc(file), EOF);
        fclose(file);
        return true;
    }
    tl_source *tile = tl_open(path, &error);
    assert_non_null(tile);
    assert_int_equal(tile->info.width, TILE);
    assert_int_equal(tile->info.height, TILE);
    assert_int_equal(tl_source_read(tile, 0, (tl_window){0, 0, TILE, TILE}, out, &error), TL_OK);
    tl_source_destroy(tile);
    return true;
}

/* What a level's sample ought to be. */
static double wanted(tl_raster_type type, int halvings, int64_t i, int64_t j, bool south_up)
{
    int64_t step = INT64_C(1) << halvings;
    double sum = 0, count = 0;
    if (type == TL_RASTER_POINT) {
        i *= step, j *= step;
        j = south_up ? HEIGHT - 1 - j : j;
        return i < WIDTH && j >= 0 && j < HEIGHT ? (double)heights[j * WIDTH + i] : (double)NAN;
    }
    for (int64_t y = j * step; y < (j + 1) * step && y < HEIGHT; y++)
        for (int64_t x = i * step; x < (i + 1) * step && x < WIDTH; x++) {
            double z = (double)heights[(south_up ? HEIGHT - 1 - y : y) * WIDTH + x];
            if (!isnan(z))
                sum += z, count++;
        }
    return count > 0 ? sum / count : (double)NAN;
}

static void check_tiles(const tl_grid_tiles_report *r, const char *where, const char *ending, tl_raster_type type,
                        bool south_up, double tolerance)
{
    for (int k = 0; k < r->level_count; k++) {
        uint64_t found = 0;
        for (int64_t row = 0; row < r->levels[k].rows; row++)
            for (int64_t column = 0; column < r->levels[k].columns; column++) {
                float z[TILE * TILE];
                bool there = read_tile(where, k, column, row, ending, z), any = false;
                found += there;
                for (int s = 0; s < TILE * TILE; s++) {
                    int64_t i = column * CELLS + s % TILE, j = row * CELLS + s / TILE;
                    bool inside = i < r->levels[k].width && j < r->levels[k].height;
                    double want = inside ? wanted(type, r->level_count - 1 - k, i, j, south_up) : (double)NAN;
                    any = any || !isnan(want);
                    if (!there)
                        continue;
                    assert_int_equal(isnan(z[s]), isnan(want));
                    if (!isnan(want))
                        assert_near((double)z[s], want, tolerance);
                }
                assert_int_equal(there, any);
            }
        assert_int_equal(found, r->levels[k].tiles);
    }
}

/* ---- Tests ---- */

static void tilesHoldTheirLevels(void **state)
{
    (void)state;
    const char *endings[] = {"exr", "tif", "raw"};
    const tl_grid_tiles_format formats[] = {TL_GRID_TILES_EXR, TL_GRID_TILES_TIFF, TL_GRID_TILES_RAW};
    for (int kind = 0; kind < 12; kind++) {
        tl_error error;
        tl_grid_tiles_report report;
        tl_raster_type type = kind & 1 ? TL_RASTER_POINT : TL_RASTER_AREA;
        bool south_up = kind & 2;
        char where[128];
        snprintf(where, sizeof where, "%s/%d", folder, kind);
        tl_source *source = make_source(type, south_up);
        tl_grid_tiles_options options = {.format = formats[kind / 4], .tile = TILE};
        assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_OK);
        assert_true(report.complete);
        assert_int_equal(report.level_count, LEVELS);
        assert_int_equal(report.levels[LEVELS - 1].columns, 5);
        assert_int_equal(report.levels[LEVELS - 1].rows, 4);
        assert_int_equal(report.levels[0].columns * report.levels[0].rows, 1);
        check_tiles(&report, where, endings[kind / 4], type, south_up, 1e-4);
        tl_source_destroy(source);
    }
}

/* Those of a field of points are the field's own coarser levels, so that the model's samples are among them. */
static void fieldsAreNested(void **state)
{
    (void)state;
    tl_error error;
    tl_grid_tiles_report report;
    char where[128];
    snprintf(where, sizeof where, "%s/field", folder);
    tl_source *source = make_source(TL_RASTER_POINT, false);
    tl_field_options below = {.levels = 2, .seed = 3};
    tl_source *field = tl_field_create(source, &below, &error);
    tl_grid_tiles_options options = {.tile = TILE};
    assert_non_null(field);
    assert_int_equal(tl_write_grid_tiles(field, where, &options, &report, &error), TL_OK);
    for (int k = 0; k < report.level_count; k++) {
        int64_t step = INT64_C(1) << (report.level_count - 1 - k);
        float z[TILE * TILE];
        if (!read_tile(where, k, 0, 0, "exr", z))
            continue;
        for (int s = 0; s < TILE * TILE; s++) {
            int64_t i = s % TILE * step, j = s / TILE * step;
            float own = NAN;
            if (i < field->info.width && j < field->info.height)
                assert_int_equal(tl_source_read(field, field->info.level, (tl_window){i, j, 1, 1}, &own, &error),
                                 TL_OK);
            assert_true(z[s] == own || (isnan(z[s]) && isnan(own)));
        }
    }
    tl_source_destroy(field);
    tl_source_destroy(source);
}

static void sixteenBitsShareOneRange(void **state)
{
    (void)state;
    tl_error error;
    tl_grid_tiles_report report;
    char where[128], path[256];
    snprintf(where, sizeof where, "%s/r16", folder);
    tl_source *source = make_source(TL_RASTER_POINT, false);
    tl_grid_tiles_options options = {
        .format = TL_GRID_TILES_R16, .tile = TILE, .range_given = true, .low = 0, .high = 65534};
    assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_OK);
    snprintf(path, sizeof path, "%s/%d/1_1.r16", where, report.last_level);
    FILE *file = fopen(path, "rb");
    assert_non_null(file);
    for (int s = 0; s < TILE * TILE; s++) {
        int low = fgetc(file), value = low | fgetc(file) << 8;
        double z = (double)heights[(CELLS + s / TILE) * WIDTH + CELLS + s % TILE];
        if (isnan(z)) /* 0; the least height is 1 */
            assert_int_equal(value, 0);
        else
            assert_near(value, z + 1, 0.5);
    }
    fclose(file);
    snprintf(where, sizeof where, "%s/cut", folder);
    options.high = 110;
    assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_ERROR_DATA);
    assert_non_null(strstr(error.text, "range"));
    snprintf(where, sizeof where, "%s/shard", folder);
    options = (tl_grid_tiles_options){.format = TL_GRID_TILES_PNG16, .tile = TILE, .shards = 2};
    assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_ERROR_ARGUMENT);
    tl_source_destroy(source);
}

static void threadsShardsAndBreaksChangeNoByte(void **state)
{
    (void)state;
    tl_error error;
    tl_grid_tiles_report report;
    char where[128], path[256];
    size_t files = 0, again = 0;
    tl_source *source = make_source(TL_RASTER_AREA, false);
    tl_run one = {.threads = 1}, three = {.threads = 3};
    tl_grid_tiles_options options = {.tile = 5, .run = &one};
    snprintf(where, sizeof where, "%s/one", folder);
    assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_OK);
    uint64_t whole = hash_of(where, &files);
    assert_true(files > 200);
    for (unsigned shards = 1; shards <= 7; shards += 3) {
        snprintf(where, sizeof where, "%s/shards%u", folder, shards);
        options = (tl_grid_tiles_options){.tile = 5, .run = &three, .shards = shards};
        for (unsigned k = 0; k < shards; k++) {
            options.shard = (5 * k + 3) % shards;
            assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_OK);
            assert_false(report.complete);
        }
        options = (tl_grid_tiles_options){.tile = 5, .run = &three, .finish = true};
        assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_OK);
        assert_true(report.complete && report.done_before > 0);
        again = 0;
        assert_true(hash_of(where, &again) == whole && again == files);
    }
    /* a break: two of three parts, then a file too few and one that is torn */
    snprintf(where, sizeof where, "%s/break", folder);
    options = (tl_grid_tiles_options){.tile = 5, .run = &one, .shards = 3};
    for (options.shard = 0; options.shard < 2; options.shard++)
        assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_OK);
    snprintf(path, sizeof path, "%s/%d/0_8.exr", where, report.last_level);
    unlink(path);
    snprintf(path, sizeof path, "%s/%d/17_9.exr", where, report.last_level);
    assert_int_equal(truncate(path, 100), 0);
    options = (tl_grid_tiles_options){.tile = 5, .run = &three};
    assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_ERROR_IO);
    options.resume = true;
    assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_OK);
    assert_true(hash_of(where, NULL) == whole && !report.already);
    assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_OK);
    assert_true(hash_of(where, NULL) == whole && report.already);
    /* what shards have not done is told */
    snprintf(where, sizeof where, "%s/early", folder);
    options = (tl_grid_tiles_options){.tile = 5, .run = &one, .shards = 3};
    assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_OK);
    options = (tl_grid_tiles_options){.tile = 5, .run = &one, .finish = true};
    assert_int_equal(tl_write_grid_tiles(source, where, &options, &report, &error), TL_ERROR_ARGUMENT);
    assert_non_null(strstr(error.text, "shards"));
    tl_source_destroy(source);
}

static void refusesWhatMakesNoSense(void **state)
{
    (void)state;
    tl_error error;
    char where[128];
    snprintf(where, sizeof where, "%s/none", folder);
    tl_source *source = make_source(TL_RASTER_AREA, false);
    const tl_grid_tiles_options wrong[] = {{.tile = 16},
                                           {.tile = 1},
                                           {.levels_given = true, .first_level = 2, .last_level = 1},
                                           {.levels_given = true, .last_level = 30},
                                           {.shard = 2, .shards = 2}};
    for (size_t k = 0; k < sizeof wrong / sizeof *wrong; k++) {
        assert_int_equal(tl_write_grid_tiles(source, where, &wrong[k], NULL, &error), TL_ERROR_ARGUMENT);
        assert_int_not_equal(access(where, F_OK), 0);
    }
    tl_grid_tiles_options dry = {.tile = TILE, .dry_run = true};
    tl_grid_tiles_report report;
    assert_int_equal(tl_write_grid_tiles(source, where, &dry, &report, &error), TL_OK);
    assert_int_equal(report.levels[report.last_level].tiles, 20);
    assert_int_not_equal(access(where, F_OK), 0);
    tl_source_destroy(source);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup_teardown(tilesHoldTheirLevels, begin, end),
        cmocka_unit_test_setup_teardown(fieldsAreNested, begin, end),
        cmocka_unit_test_setup_teardown(sixteenBitsShareOneRange, begin, end),
        cmocka_unit_test_setup_teardown(threadsShardsAndBreaksChangeNoByte, begin, end),
        cmocka_unit_test_setup_teardown(refusesWhatMakesNoSense, begin, end),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
