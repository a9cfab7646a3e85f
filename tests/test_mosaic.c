/* Several files as one elevation model, .hgt files, and coarser levels, on files that are made here. */
#include "dem/bins.h"
#include "lib/talus.h"
#include "make_tiff.h"

#include <math.h>
#include <pthread.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <tiffio.h>
#include <unistd.h>

#include <cmocka.h>

enum { MAX_FILES = 320, VOID_NUMBER = -9999 };

static char folder[64], files[MAX_FILES][128];
static const char *paths[MAX_FILES];
static size_t file_count;

static uint32_t random_number(uint32_t *state)
{
    *state ^= *state << 13;
    *state ^= *state >> 17;
    return *state ^= *state << 5;
}

/* ---- Making files ---- */

/* A tile in the world: sample (i, j) lies at x + dx i, y - dy j, or y + dy j where it runs south up. */
typedef struct tile {
    double x, y, dx, dy;
    uint32_t width, height;
    uint16_t epsg; /* 0: 32632; 1: none; 4326 is geographic */
    bool point, flip_y, flip_x, integers;
    int nodata; /* VOID_NUMBER where it is 0 */
    bool rotated, nowhere, feet;
    /* The height at a place of the world; NaN: void. */
    double (*world)(double x, double y);
} tile;

static const tile *current;

static double tile_value(unsigned band, uint32_t i, uint32_t j, uint16_t bits, uint16_t format)
{
    (void)band;
    (void)bits;
    (void)format;
    const tile *t = current;
    double x = t->x + t->dx * (t->flip_x ? t->width - 1 - i : i),
           y = t->y - t->dy * (t->flip_y ? t->height - 1 - j : j);
    double height = t->world(x, y);
    return isnan(height) ? (t->nodata ? t->nodata : VOID_NUMBER) : height;
}

static void write_tile(const char *path, const tile *t)
{
    uint16_t geographic = t->epsg == 4326, raster = t->point ? 2 : 1;
    uint16_t keys[4][4] = {{1024, 0, 1, geographic ? 2 : 1},
                           {1025, 0, 1, raster},
                           {geographic ? 2048 : 3072, 0, 1, t->epsg ? t->epsg : 32632},
                           {4099, 0, 1, 9002}};
    double sx = t->flip_x ? -t->dx : t->dx, sy = t->flip_y ? t->dy : -t->dy, half = t->point ? 0 : 0.5;
    double x0 = t->x + (t->flip_x ? t->dx * (t->width - 1) : 0), y0 = t->y - (t->flip_y ? t->dy * (t->height - 1) : 0);
    double lean = t->rotated ? 0.3 * t->dx : 0;
    double matrix[16] = {sx, lean, 0, x0 - half * (sx + lean), lean, sy, 0, y0 - half * (sy + lean), 0, 0, 0, 0, 0,
                         0,  0,    1};
    char nodata[16];
    snprintf(nodata, sizeof nodata, "%d", t->nodata ? t->nodata : VOID_NUMBER);
    make_tiff_options o = {.width = t->width,
                           .height = t->height,
                           .bits = t->integers ? 16 : 32,
                           .format = t->integers ? SAMPLEFORMAT_INT : SAMPLEFORMAT_IEEEFP,
                           .block_width = 16,
                           .block_height = 16,
                           .nodata = nodata,
                           .matrix = t->nowhere ? NULL : matrix,
                           .keys = t->epsg == 1 ? keys[1] : keys[0],
                           .key_count = t->epsg == 1 ? 1
                                        : t->feet    ? 4
                                                     : 3,
                           .value = tile_value};
    current = t;
    assert_true(make_tiff(path, &o));
}

/* Writes a tile as the next file; its number. */
static size_t add_tile(const tile *t)
{
    assert_true(file_count < MAX_FILES);
    snprintf(files[file_count], sizeof files[0], "%s/%03zu.tif", folder, file_count);
    paths[file_count] = files[file_count];
    write_tile(files[file_count], t);
    return file_count++;
}

static int begin(void **state)
{
    (void)state;
    file_count = 0;
    return 0;
}

static int end(void **state)
{
    (void)state;
    for (size_t k = 0; k < file_count; k++)
        unlink(files[k]);
    return 0;
}

/* ---- Reading ---- */

static tl_source *open_files(const tl_dem_options *options)
{
    tl_error error = {0};
    tl_source *source = tl_dem_open(paths, file_count, options, &error);
    if (!source)
        print_error("%s\n", error.text);
    assert_non_null(source);
    return source;
}

static void expect_refusal(const char *part, const char *also)
{
    tl_error error = {0};
    assert_null(tl_dem_open(paths, file_count, NULL, &error));
    if (!strstr(error.text, part) || (also && !strstr(error.text, also)) || strchr(error.text, '\n'))
        fail_msg("\"%s\" does not say: %s, %s", error.text, part, also ? also : "");
    assert_int_equal(error.status, TL_ERROR_DATA);
}

static void read_level(const tl_source *source, int level, tl_window window, float *out)
{
    tl_error error = {0};
    if (tl_source_read(source, level, window, out, &error) != TL_OK)
        fail_msg("%s", error.text);
}

static float *read_all(const tl_source *source)
{
    float *heights = malloc(sizeof *heights * (size_t)(source->info.width * source->info.height));
    assert_non_null(heights);
    read_level(source, 0, (tl_window){0, 0, source->info.width, source->info.height}, heights);
    return heights;
}

static bool same(float a, float b)
{
    return a == b || (isnan(a) && isnan(b));
}

/* Every sample has the height of the world at its place; `inside` tells where there is one. */
static void expect_world(const tl_source *source, double (*world)(double, double))
{
    float *heights = read_all(source);
    const double *t = source->info.georef.transform;
    for (int64_t j = 0; j < source->info.height; j++)
        for (int64_t i = 0; i < source->info.width; i++) {
            double x = t[0] + t[1] * (double)i, y = t[3] + t[5] * (double)j;
            float wanted = (float)world(x, y), got = heights[j * source->info.width + i];
            if (!same(wanted, got))
                fail_msg("sample %d, %d at %g, %g: %g instead of %g", (int)i, (int)j, x, y, (double)got,
                         (double)wanted);
        }
    free(heights);
}

/* Random windows are parts of the whole. */
static void expect_windows(const tl_source *source)
{
    uint32_t state = 99;
    int64_t width = source->info.width, height = source->info.height;
    float *whole = read_all(source), *part = malloc(sizeof *part * (size_t)(width * height));
    for (int k = 0; k < 60; k++) {
        tl_window w = {random_number(&state) % width, random_number(&state) % height, 0, 0};
        w.width = 1 + random_number(&state) % (width - w.x);
        w.height = 1 + random_number(&state) % (height - w.y);
        read_level(source, 0, w, part);
        for (int64_t y = 0; y < w.height; y++)
            for (int64_t x = 0; x < w.width; x++)
                assert_true(same(part[y * w.width + x], whole[(w.y + y) * width + w.x + x]));
    }
    free(part);
    free(whole);
}

/* ---- Worlds ---- */

/* Looks random, whole, differs at places that differ by a metre. */
static double bumps(double x, double y)
{
    int64_t i = llround(4 * x), j = llround(4 * y);
    uint32_t h = (uint32_t)i * 2654435761u ^ (uint32_t)j * 2246822519u;
    h ^= h >> 15;
    return (h * 3266489917u >> 16) % 4000;
}

static double bumps_with_holes(double x, double y)
{
    double height = bumps(x, y);
    return height < 500 ? (double)NAN : height;
}

/* Bilinear interpolation gives it back: exact in float where the coefficients are powers of two. */
static double plane(double x, double y)
{
    return x / 8 + y / 4;
}

/* ---- One lattice ---- */

static void fourPointTilesAreOneRaster(void **state)
{
    (void)state;
    for (int k = 0; k < 4; k++) /* tiles share their edge rows and columns */
        add_tile(&(tile){.x = 1000 + 40 * (k & 1),
                         .y = 5000 - 60 * (k >> 1),
                         .dx = 2,
                         .dy = 2,
                         .width = 21,
                         .height = 31,
                         .point = true,
                         .integers = true,
                         .world = bumps_with_holes});
    tl_source *source = open_files(NULL);
    assert_int_equal(source->info.width, 41);
    assert_int_equal(source->info.height, 61);
    assert_int_equal(source->info.type, TL_RASTER_POINT);
    assert_true(source->info.quantum == 1);
    assert_true(source->info.georef.transform[0] == 1000 && source->info.georef.transform[3] == 5000);
    expect_world(source, bumps_with_holes);
    expect_windows(source);
    tl_source_destroy(source);
}

static void fourAreaTilesAreOneRaster(void **state)
{
    (void)state;
    for (int k = 3; k >= 0; k--) /* in another order than they lie */
        add_tile(&(tile){.x = 1000 + 40 * (k & 1),
                         .y = 5000 - 60 * (k >> 1),
                         .dx = 2,
                         .dy = 2,
                         .width = 20,
                         .height = 30,
                         .world = bumps});
    tl_source *source = open_files(NULL);
    assert_int_equal(source->info.width, 40);
    assert_int_equal(source->info.height, 60);
    assert_int_equal(source->info.type, TL_RASTER_AREA);
    assert_int_equal(tl_crs_epsg(source->info.georef.crs), 32632);
    expect_world(source, bumps);
    expect_windows(source);
    tl_source_destroy(source);
}

static void tilesThatRunTheOtherWayAreTurned(void **state)
{
    (void)state;
    for (int k = 0; k < 4; k++)
        add_tile(&(tile){.x = 100 * (k & 1),
                         .y = 70 * (k >> 1),
                         .dx = 10,
                         .dy = 10,
                         .width = 10,
                         .height = 7,
                         .flip_x = k == 1 || k == 3,
                         .flip_y = k >= 2,
                         .world = bumps});
    tl_source *source = open_files(NULL);
    assert_int_equal(source->info.width, 20);
    assert_int_equal(source->info.height, 14);
    expect_world(source, bumps);
    expect_windows(source);
    tl_source_destroy(source);
}

static double west_half(double x, double y)
{
    return x < 1020 ? bumps(x, y) : (double)NAN;
}

static void theNextFillsVoidsOfTheFirst(void **state)
{
    (void)state;
    tile t = {.x = 1000, .y = 5000, .dx = 1, .dy = 1, .width = 50, .height = 40, .world = west_half};
    add_tile(&t);
    t.world = bumps;
    t.nodata = 7777; /* each file has its own nodata; the first's is a height here, and the other way round */
    add_tile(&t);
    tl_source *source = open_files(NULL);
    expect_world(source, bumps);
    tl_source_destroy(source);
}

static double one(double x, double y)
{
    (void)x;
    (void)y;
    return 1;
}

static double two(double x, double y)
{
    (void)x;
    (void)y;
    return 2;
}

static void theFirstWinsAmongEquals(void **state)
{
    (void)state;
    tile t = {.x = 0, .y = 0, .dx = 1, .dy = 1, .width = 20, .height = 20, .world = one};
    add_tile(&t);
    t.x = 10;
    t.world = two;
    add_tile(&t);
    tl_source *source = open_files(NULL);
    float *heights = read_all(source);
    assert_int_equal(source->info.width, 30);
    for (int64_t k = 0; k < 600; k++)
        assert_true(heights[k] == (k % 30 < 20 ? 1 : 2));
    free(heights);
    tl_source_destroy(source);
}

static void gapsAreVoid(void **state)
{
    (void)state;
    tile t = {.x = 0, .y = 0, .dx = 1, .dy = 1, .width = 20, .height = 10, .world = bumps};
    add_tile(&t);
    t.x = 50;
    t.y = -25;
    add_tile(&t);
    tl_source *source = open_files(NULL);
    assert_int_equal(source->info.width, 70);
    assert_int_equal(source->info.height, 35);
    assert_true(source->info.has_voids);
    float *heights = read_all(source);
    for (int64_t j = 0; j < 35; j++)
        for (int64_t i = 0; i < 70; i++) {
            bool inside = (i < 20 && j < 10) || (i >= 50 && j >= 25);
            float height = heights[j * 70 + i];
            assert_true(inside ? height == (float)bumps((double)i, -(double)j) : isnan(height));
        }
    free(heights);
    tl_source_destroy(source);
}

/* ---- Several lattices ---- */

static double plane_plus(double x, double y)
{
    return plane(x, y) + 1000;
}

static void theFinestWinsAndOthersAreInterpolated(void **state)
{
    (void)state;
    /* coarse points every 8 m around fine ones every 2 m, which are 1000 m higher */
    add_tile(&(tile){.x = 0, .y = 0, .dx = 8, .dy = 8, .width = 21, .height = 16, .point = true, .world = plane});
    add_tile(
        &(tile){.x = 42, .y = -30, .dx = 2, .dy = 2, .width = 20, .height = 15, .point = true, .world = plane_plus});
    tl_source *source = open_files(NULL);
    const tl_source_info *info = &source->info;
    assert_true(info->width == 81 && info->height == 61 && info->georef.transform[1] == 2);
    assert_true(info->quantum == 0);
    float *heights = read_all(source);
    for (int64_t j = 0; j < 61; j++)
        for (int64_t i = 0; i < 81; i++) {
            double x = 2 * (double)i, y = -2 * (double)j;
            bool fine = x >= 42 && x <= 80 && y <= -30 && y >= -58;
            assert_true(heights[j * 81 + i] == (float)(fine ? plane_plus : plane)(x, y));
        }
    free(heights);
    expect_windows(source);
    tl_dem_member member;
    assert_int_equal(tl_dem_get_member(source, 0, &member, NULL), TL_OK);
    assert_true(member.resampled && member.window.x == 0 && member.window.width == 81 && member.window.height == 61);
    assert_int_equal(tl_dem_get_member(source, 1, &member, NULL), TL_OK);
    assert_true(!member.resampled && member.window.x == 21 && member.window.y == 15 && member.window.width == 20);
    tl_source_destroy(source);
}

static void pointsAndAreasJoinHalfACellApart(void **state)
{
    (void)state;
    /* points from 0 to 40; cells of the same size from 40 on, so their centres lie half a cell beside the lattice */
    add_tile(&(tile){.x = 0, .y = 0, .dx = 4, .dy = 4, .width = 11, .height = 11, .point = true, .world = plane});
    add_tile(&(tile){.x = 42, .y = -2, .dx = 4, .dy = 4, .width = 10, .height = 10, .world = plane});
    tl_source *source = open_files(NULL);
    const tl_source_info *info = &source->info;
    assert_int_equal(info->type, TL_RASTER_POINT);
    assert_int_equal(info->width, 20); /* the last point within the cells is at 76 */
    assert_int_equal(info->height, 11);
    float *heights = read_all(source);
    for (int64_t j = 0; j < 11; j++)
        for (int64_t i = 0; i < 20; i++) {
            double x = 4 * (double)i, y = -4 * (double)j;
            float height = heights[j * 20 + i];
            /* rows 0 and 10 lie on the outer edges of the cells: the first is theirs, the last is not */
            if (x > 40 && j == 10)
                assert_true(isnan(height));
            else if (x > 40 && j == 0)
                assert_true(height == (float)plane(x, -2)); /* the cell's own height goes on to its edge */
            else
                assert_true(height == (float)plane(x, y));
        }
    free(heights);
    expect_windows(source);
    tl_source_destroy(source);
}

static double plane_with_hole(double x, double y)
{
    return x == 32 && y == -32 ? (double)NAN : plane(x, y);
}

static void interpolationStopsAtVoids(void **state)
{
    (void)state;
    add_tile(
        &(tile){.x = 0, .y = 0, .dx = 8, .dy = 8, .width = 9, .height = 9, .point = true, .world = plane_with_hole});
    add_tile(&(tile){.x = 200, .y = 0, .dx = 4, .dy = 4, .width = 4, .height = 4, .point = true, .world = plane});
    tl_source *source = open_files(NULL);
    float *heights = read_all(source);
    for (int64_t j = 0; j < 17; j++)
        for (int64_t i = 0; i < 17; i++) {
            double x = 4 * (double)i, y = -4 * (double)j;
            bool near = fabs(x - 32) < 8 && fabs(y + 32) < 8;
            float height = heights[j * source->info.width + i];
            assert_true(near ? isnan(height) : height == (float)plane(x, y));
        }
    free(heights);
    tl_source_destroy(source);
}

static void coarseAreaTilesJoinWithoutAGap(void **state)
{
    (void)state;
    /* four coarse tiles beside each other, and one fine cell raster beside them that makes the lattice */
    for (int k = 0; k < 4; k++)
        add_tile(&(tile){.x = 16 + 160 * (k & 1),
                         .y = -16 - 160 * (k >> 1),
                         .dx = 32,
                         .dy = 32,
                         .width = 5,
                         .height = 5,
                         .world = plane});
    add_tile(&(tile){.x = 324, .y = -4, .dx = 8, .dy = 8, .width = 5, .height = 40, .world = plane});
    tl_source *source = open_files(NULL);
    assert_true(source->info.width == 45 && source->info.height == 40);
    float *heights = read_all(source);
    for (int64_t j = 0; j < 40; j++)
        for (int64_t i = 0; i < 45; i++) {
            double x = 4 + 8 * (double)i, y = -4 - 8 * (double)j;
            /* beyond the outer centres of the coarse cells their own height goes on */
            bool fine = x > 320;
            double cx = fine ? x : fmin(fmax(x, 16), 304), cy = fine ? y : fmin(fmax(y, -304), -16);
            assert_true(heights[j * 45 + i] == (float)plane(cx, cy));
        }
    free(heights);
    expect_windows(source);
    tl_source_destroy(source);
}

/* ---- Feathering ---- */

static void featheredJoinsAreSmooth(void **state)
{
    (void)state;
    static const int overlaps[] = {1, 5, 20, 32, 50, 90};
    for (size_t n = 0; n < sizeof overlaps / sizeof *overlaps; n++) {
        int overlap = overlaps[n];
        begin(NULL);
        tile t = {.x = 0, .y = 0, .dx = 1, .dy = 1, .width = 200, .height = 100, .world = one};
        add_tile(&t);
        t.x = 200 - overlap;
        t.world = two;
        add_tile(&t);
        tl_source *source = open_files(&(tl_dem_options){.feather = true});
        assert_true(source->info.quantum == 0);
        int64_t width = source->info.width;
        float *heights = read_all(source), *row = heights + 50 * width;
        /* w = d/33 and (n+1-d)/33 from either rim: the share of the first is w1 / (w1 + (1 - w1) w2), whose steps are
         * largest at the ends; it falls from 1 to 0 in no fewer steps than min(n, 32) + 1, the first and the last of
         * which are at most 4 times their mean */
        double most = 4.0 / ((overlap < 32 ? overlap : 32) + 1);
        for (int64_t i = 0; i + 1 < width; i++) {
            assert_true(row[i + 1] >= row[i]);
            if (overlap > 1)
                assert_true((double)(row[i + 1] - row[i]) <= most);
        }
        assert_true(row[0] == 1 && row[width - 1] == 2);
        /* where only one is, and deep inside of the first, nothing is blended */
        for (int64_t i = 0; i < width; i++)
            if (i < 200 - overlap || i < 200 - 32)
                assert_true(row[i] == 1);
            else if (i >= 200)
                assert_true(row[i] == 2);
        free(heights);
        expect_windows(source);
        tl_source_destroy(source);
        end(NULL);
    }
    begin(NULL);
}

static void featheringKeepsWhatAgrees(void **state)
{
    (void)state;
    add_tile(&(tile){.x = 0, .y = 0, .dx = 1, .dy = 1, .width = 60, .height = 60, .world = bumps});
    add_tile(&(tile){.x = 40, .y = 10, .dx = 1, .dy = 1, .width = 60, .height = 60, .world = bumps_with_holes});
    add_tile(&(tile){.x = 30, .y = -30, .dx = 1, .dy = 1, .width = 60, .height = 60, .world = bumps});
    tl_source *source = open_files(&(tl_dem_options){.feather = true}), *hard = open_files(NULL);
    float *a = read_all(source), *b = read_all(hard);
    for (int64_t k = 0; k < source->info.width * source->info.height; k++)
        assert_true(same(a[k], b[k]));
    free(a);
    free(b);
    tl_source_destroy(hard);
    tl_source_destroy(source);
}

static void aFineTileFadesIntoACoarseOne(void **state)
{
    (void)state;
    add_tile(&(tile){.x = -400, .y = 400, .dx = 4, .dy = 4, .width = 301, .height = 301, .point = true, .world = one});
    add_tile(&(tile){.x = 100, .y = -100, .dx = 1, .dy = 1, .width = 201, .height = 201, .point = true, .world = two});
    tl_source *source = open_files(&(tl_dem_options){.feather = true});
    int64_t width = source->info.width;
    float *heights = read_all(source), *row = heights + 600 * width + 400;
    assert_true(row[99] == 1 && row[301] == 1 && row[100 + 32] == 2 && row[200] == 2);
    for (int64_t i = 99; i < 132; i++) /* the coarse one is deep there, so the change is linear */
        assert_true(fabs((double)(row[i + 1] - row[i]) - 1 / 33.0) <= 1e-6);
    free(heights);
    tl_source_destroy(source);
}

/* ---- Refusals ---- */

static void membersThatDoNotFitAreRefusedByName(void **state)
{
    (void)state;
    const tile good = {.x = 0, .y = 0, .dx = 1, .dy = 1, .width = 4, .height = 4, .world = one};
    tile bad = good;
    add_tile(&good);
    bad.epsg = 32633;
    add_tile(&bad);
    expect_refusal("000.tif is in WGS 84 / UTM zone 32N", "001.tif is in WGS 84 / UTM zone 33N");
    bad.epsg = 1;
    write_tile(files[1], &bad);
    expect_refusal("001.tif is in an unknown CRS", "000.tif");
    bad = good;
    bad.rotated = true;
    write_tile(files[1], &bad);
    expect_refusal("001.tif: is rotated", NULL);
    bad = good;
    bad.nowhere = true;
    write_tile(files[1], &bad);
    expect_refusal("001.tif: does not say where it lies", NULL);
    bad = good;
    bad.feet = true;
    write_tile(files[1], &bad);
    expect_refusal("001.tif has heights in units of 0.3048", "000.tif");
    bad = good;
    bad.x = 1e300;
    write_tile(files[1], &bad);
    expect_refusal("too far", "001.tif");
    write_tile(files[1], &good);
    truncate(files[1], 100);
    expect_refusal("001.tif", NULL);
}

/* ---- Around the globe ---- */

static void tilesBesideTheAntimeridianAreNeighbours(void **state)
{
    (void)state;
    add_tile(&(tile){.x = 178,
                     .y = 10,
                     .dx = 0.125,
                     .dy = 0.125,
                     .width = 17,
                     .height = 9,
                     .epsg = 4326,
                     .point = true,
                     .world = bumps});
    add_tile(&(tile){.x = -180,
                     .y = 10,
                     .dx = 0.125,
                     .dy = 0.125,
                     .width = 25,
                     .height = 9,
                     .epsg = 4326,
                     .point = true,
                     .world = bumps});
    for (int k = 0; k < 2; k++) {
        tl_source *source = open_files(NULL);
        assert_int_equal(source->info.width, 41);
        assert_int_equal(source->info.height, 9);
        /* the first file stays where it is */
        assert_true(source->info.georef.transform[0] == (k ? -182 : 178));
        float *heights = read_all(source);
        for (int64_t i = 0; i < 41; i++) {
            double x = 178 + 0.125 * (double)i;
            bool second = k ? x >= 180 : x > 180;
            assert_true(heights[i] == (float)bumps(second ? x - 360 : x, 10));
        }
        free(heights);
        expect_windows(source);
        tl_source_destroy(source);
        const char *first = paths[0]; /* the other way round */
        paths[0] = paths[1];
        paths[1] = first;
    }
}

static double globe(double x, double y)
{
    double turned = fmod(x + 720, 360);
    return bumps(turned, y);
}

static void longitudesTo360JoinThoseFromMinus180(void **state)
{
    (void)state;
    /* the world's north from 0 to 360, its south from -180 to 180 in two pieces */
    add_tile(&(tile){.x = 0.5, .y = 89.5, .dx = 1, .dy = 1, .width = 360, .height = 90, .epsg = 4326, .world = globe});
    add_tile(
        &(tile){.x = -179.5, .y = -0.5, .dx = 1, .dy = 1, .width = 100, .height = 90, .epsg = 4326, .world = globe});
    add_tile(
        &(tile){.x = -79.5, .y = -0.5, .dx = 1, .dy = 1, .width = 260, .height = 90, .epsg = 4326, .world = globe});
    tl_source *source = open_files(NULL);
    assert_int_equal(source->info.width, 360);
    assert_int_equal(source->info.height, 180);
    assert_true(source->info.georef.transform[0] == 0.5 && source->info.wraps);
    expect_world(source, globe);
    expect_windows(source);
    tl_source_destroy(source);
}

static void aWholeGlobeOfTilesStaysWhereItIs(void **state)
{
    (void)state;
    for (int k = 0; k < 36; k++)
        add_tile(&(tile){.x = -180 + 10 * k,
                         .y = 5,
                         .dx = 1,
                         .dy = 1,
                         .width = 11,
                         .height = 3,
                         .epsg = 4326,
                         .point = true,
                         .world = globe});
    tl_source *source = open_files(NULL);
    assert_int_equal(source->info.width, 361);
    assert_true(source->info.georef.transform[0] == -180);
    assert_false(source->info.wraps); /* its last column is the first again */
    expect_world(source, globe);
    tl_source_destroy(source);
}

static void aRasterOf360DegreesWraps(void **state)
{
    (void)state;
    /* the first within half a cell of a turn, the second beyond, the third in metres */
    static const struct {
        double dx;
        uint16_t epsg;
        bool wraps;
    } cases[] = {
        {5, 4326, true}, {5 * (1 + 0.9 / 144), 4326, true}, {5 * (1 - 1.1 / 144), 4326, false}, {5, 32632, false}};
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        begin(NULL);
        add_tile(&(tile){.x = -177.5,
                         .y = 80,
                         .dx = cases[k].dx,
                         .dy = 5,
                         .width = 72,
                         .height = 4,
                         .epsg = cases[k].epsg,
                         .world = one});
        tl_source *source = open_files(NULL);
        assert_int_equal(source->info.wraps, cases[k].wraps);
        tl_source_destroy(source);
        end(NULL);
    }
    begin(NULL);
}

/* ---- Many files ---- */

static void hundredsOfTilesNeedFewOpenFiles(void **state)
{
    (void)state;
    for (int k = 0; k < 300; k++)
        add_tile(&(tile){.x = 40 * (k % 20),
                         .y = -30 * (k / 20),
                         .dx = 1,
                         .dy = 1,
                         .width = 40,
                         .height = 30,
                         .integers = true,
                         .world = bumps});
    struct rlimit before, low;
    assert_int_equal(getrlimit(RLIMIT_NOFILE, &before), 0);
    low = before;
    low.rlim_cur = 24;
    for (unsigned k = 0; k < 3; k++) {
        tl_source *source = NULL;
        if (k == 2) /* the limit falls when 64 are open already */
            source = open_files(NULL);
        assert_int_equal(setrlimit(RLIMIT_NOFILE, &low), 0);
        if (k < 2)
            source = open_files(&(tl_dem_options){.open_files = k ? 4 : 0});
        assert_int_equal(tl_dem_member_count(source), 300);
        assert_true(source->info.width == 800 && source->info.height == 450);
        expect_world(source, bumps);
        expect_windows(source);
        FILE *other = fopen(files[0], "rb"); /* some are left for others */
        assert_true(k == 2 || other);
        if (other)
            fclose(other);
        tl_source_destroy(source);
        assert_int_equal(setrlimit(RLIMIT_NOFILE, &before), 0);
    }
}

static void aFileThatChangesMeanwhileIsAnError(void **state)
{
    (void)state;
    tile t = {.y = 0, .dx = 1, .dy = 1, .width = 20, .height = 20, .world = bumps};
    for (int k = 0; k < 3; k++, t.x += 20)
        add_tile(&t);
    tl_source *source = open_files(&(tl_dem_options){.open_files = 1});
    t.x = 0;
    t.width = 24;
    unlink(files[0]);
    write_tile(files[0], &t);
    float *heights = malloc(sizeof *heights * 60 * 20);
    tl_error error = {0};
    assert_int_equal(tl_source_read(source, 0, (tl_window){0, 0, 60, 20}, heights, &error), TL_ERROR_IO);
    assert_non_null(strstr(error.text, "000.tif: was changed"));
    read_level(source, 0, (tl_window){20, 0, 40, 20}, heights); /* the others are as they were */
    free(heights);
    tl_source_destroy(source);
}

typedef struct reader {
    const tl_source *source;
    const float *whole;
    uint32_t seed;
    bool failed;
} reader;

static void *read_randomly(void *argument)
{
    reader *r = argument;
    float part[48 * 48];
    for (int k = 0; k < 150 && !r->failed; k++) {
        tl_window w = {random_number(&r->seed) % (r->source->info.width - 48),
                       random_number(&r->seed) % (r->source->info.height - 48), 48, 48};
        r->failed = tl_source_read(r->source, 0, w, part, NULL) != TL_OK;
        for (int64_t n = 0; n < 48 * 48 && !r->failed; n++)
            r->failed = !same(part[n], r->whole[(w.y + n / 48) * r->source->info.width + w.x + n % 48]);
    }
    return NULL;
}

static void threadsReadTheSame(void **state)
{
    (void)state;
    for (int k = 0; k < 24; k++) /* every third is coarser */
        add_tile(&(tile){.x = 40 * (k % 6),
                         .y = -40 * (k / 6),
                         .dx = k % 3 ? 1 : 2,
                         .dy = k % 3 ? 1 : 2,
                         .width = k % 3 ? 40 : 20,
                         .height = k % 3 ? 40 : 20,
                         .world = bumps_with_holes});
    tl_source *source = open_files(&(tl_dem_options){.open_files = 3, .feather = true});
    float *whole = read_all(source);
    pthread_t threads[6];
    reader readers[6];
    for (uint32_t k = 0; k < 6; k++) {
        readers[k] = (reader){source, whole, 17 + k, false};
        assert_int_equal(pthread_create(&threads[k], NULL, read_randomly, &readers[k]), 0);
    }
    for (int k = 0; k < 6; k++) {
        pthread_join(threads[k], NULL);
        assert_false(readers[k].failed);
    }
    free(whole);
    tl_source_destroy(source);
}

static void binsFindWhatASearchFinds(void **state)
{
    (void)state;
    uint32_t seed = 5;
    for (int round = 0; round < 40; round++) {
        tl_window places[80];
        size_t count = 1 + random_number(&seed) % 80;
        for (size_t k = 0; k < count; k++)
            places[k] =
                (tl_window){(int64_t)(random_number(&seed) % 400) - 200, (int64_t)(random_number(&seed) % 100) - 50,
                            1 + random_number(&seed) % (round % 2 ? 300 : 20), 1 + random_number(&seed) % 30};
        dem_bins *bins = dem_bins_create(places, count);
        dem_hits hits = {0};
        assert_non_null(bins);
        for (int n = 0; n < 50; n++) {
            tl_window w = {(int64_t)(random_number(&seed) % 600) - 300, (int64_t)(random_number(&seed) % 200) - 100,
                           1 + random_number(&seed) % 100, 1 + random_number(&seed) % 40};
            assert_true(dem_bins_find(bins, w, &hits));
            size_t found = 0;
            for (uint32_t k = 0; k < count; k++) {
                if (dem_window_empty(dem_window_common(w, places[k])))
                    continue;
                assert_true(found < hits.count && hits.numbers[found] == k);
                found++;
            }
            assert_int_equal(hits.count, found);
        }
        free(hits.numbers);
        dem_bins_destroy(bins);
    }
}

/* ---- .hgt ---- */

static void write_hgt(const char *name, int side, double x0, double y0)
{
    snprintf(files[file_count], sizeof files[0], "%s/%s", folder, name);
    paths[file_count] = files[file_count];
    FILE *file = fopen(files[file_count++], "wb");
    assert_non_null(file);
    for (int j = 0; j < side; j++)
        for (int i = 0; i < side; i++) {
            double height = bumps_with_holes(x0 + (double)i / (side - 1), y0 + 1 - (double)j / (side - 1));
            int stored = isnan(height) ? -32768 : (int)height - 1000;
            fputc(stored >> 8 & 0xff, file);
            fputc(stored & 0xff, file);
        }
    fclose(file);
}

static double lowered(double x, double y)
{
    return bumps_with_holes(x, y) - 1000;
}

static void hgtFilesLieWhereTheirNamesSay(void **state)
{
    (void)state;
    static const struct {
        const char *name;
        double x, y;
    } cells[] = {
        {"N48W125.hgt", -125, 48}, {"n00e006.HGT", 6, 0}, {"S01E179.SRTMGL1.hgt", 179, -1}, {"S90W180.hgt", -180, -90}};
    for (size_t k = 0; k < sizeof cells / sizeof *cells; k++) {
        begin(NULL);
        write_hgt(cells[k].name, 5, cells[k].x, cells[k].y);
        tl_source *source = open_files(NULL);
        const tl_source_info *info = &source->info;
        assert_true(info->width == 5 && info->height == 5 && info->type == TL_RASTER_POINT && info->quantum == 1);
        assert_true(info->georef.transform[0] == cells[k].x && info->georef.transform[3] == cells[k].y + 1);
        assert_int_equal(tl_crs_epsg(info->georef.crs), 4326);
        expect_world(source, lowered);
        tl_dem_details details;
        assert_int_equal(tl_dem_get_details(source, &details, NULL), TL_OK);
        assert_string_equal(details.sample_type, "int16");
        assert_int_equal(details.bytes, 50);
        assert_int_equal(tl_dem_member_count(source), 1);
        tl_source_destroy(source);
        end(NULL);
    }
    begin(NULL);
}

static void hgtTilesJoinWithoutASeam(void **state)
{
    (void)state;
    write_hgt("N10E020.hgt", 9, 20, 10);
    write_hgt("N10E021.hgt", 9, 21, 10);
    write_hgt("N11E020.hgt", 9, 20, 11);
    write_hgt("N11E021.hgt", 9, 21, 11);
    tl_source *source = open_files(NULL);
    assert_true(source->info.width == 17 && source->info.height == 17 && source->info.quantum == 1);
    expect_world(source, lowered);
    expect_windows(source);
    tl_dem_details details;
    tl_error error = {0};
    assert_int_equal(tl_dem_get_details(source, &details, &error), TL_ERROR_ARGUMENT);
    assert_non_null(strstr(error.text, "4 files"));
    tl_source_destroy(source);
}

static void badHgtFilesSayWhy(void **state)
{
    (void)state;
    static const char *const names[] = {"elevation.hgt", "N48.hgt",      "N48W12.hgt", "N4813W125.hgt",
                                        "N95E000.hgt",   "N10E1234.hgt", "X10E123.hgt"};
    for (size_t k = 0; k < sizeof names / sizeof *names; k++) {
        begin(NULL);
        write_hgt(names[k], 3, 0, 0);
        expect_refusal(names[k], "by its name");
        end(NULL);
    }
    begin(NULL);
    write_hgt("N10E010.hgt", 5, 0, 0);
    truncate(files[0], 48);
    expect_refusal("N10E010.hgt: 48 bytes", "square");
    truncate(files[0], 2);
    expect_refusal("N10E010.hgt: 2 bytes", "square");
    truncate(files[0], 0);
    expect_refusal("N10E010.hgt: the file is empty", NULL);
}

/* ---- Coarser levels ---- */

static double mean_of(const float *heights, int64_t width, int64_t height, int64_t x, int64_t y, int64_t step)
{
    double sum = 0;
    int64_t count = 0;
    for (int64_t j = y * step; j < (y + 1) * step && j < height; j++)
        for (int64_t i = x * step; i < (x + 1) * step && i < width; i++)
            if (!isnan(heights[j * width + i])) {
                sum += (double)heights[j * width + i];
                count++;
            }
    return count ? sum / (double)count : (double)NAN;
}

/* Every level, whole and in windows. */
static void check_levels(const tl_source *source)
{
    int64_t width = source->info.width, height = source->info.height, w, h;
    float *finest = read_all(source), *whole = malloc(sizeof *whole * (size_t)(width * height));
    bool area = source->info.type == TL_RASTER_AREA;
    uint32_t seed = 3;
    int level = -1;
    for (; tl_source_size(source, level, &w, &h, NULL) == TL_OK; level--) {
        int64_t step = (int64_t)1 << -level;
        assert_int_equal(w, (width + step - 1) / step);
        assert_int_equal(h, (height + step - 1) / step);
        read_level(source, level, (tl_window){0, 0, w, h}, whole);
        for (int64_t y = 0; y < h; y++)
            for (int64_t x = 0; x < w; x++) {
                float wanted =
                    area ? (float)mean_of(finest, width, height, x, y, step) : finest[y * step * width + x * step];
                assert_true(same(whole[y * w + x], wanted));
            }
        for (int k = 0; k < 5; k++) {
            tl_window at = {random_number(&seed) % w, random_number(&seed) % h, 1, 1};
            float one_height;
            read_level(source, level, at, &one_height);
            assert_true(same(one_height, whole[at.y * w + at.x]));
        }
    }
    /* the level before the first that fails is the first of a single sample */
    assert_int_equal(tl_source_size(source, level + 1, &w, &h, NULL), TL_OK);
    assert_true(w == 1 && h == 1);
    if (level < -1) {
        assert_int_equal(tl_source_size(source, level + 2, &w, &h, NULL), TL_OK);
        assert_true(w > 1 || h > 1);
    }
    assert_int_equal(tl_source_size(source, 1, &w, &h, NULL), TL_ERROR_ARGUMENT);
    free(whole);
    free(finest);
}

static void coarserLevelsArePointsOrMeans(void **state)
{
    (void)state;
    static const uint32_t sizes[][2] = {{37, 29}, {64, 64}, {65, 33}, {1, 50}, {1, 1}, {2, 1}, {5000, 3}};
    for (size_t k = 0; k < 2 * sizeof sizes / sizeof *sizes; k++) {
        begin(NULL);
        add_tile(&(tile){.dx = 1,
                         .dy = 1,
                         .width = sizes[k / 2][0],
                         .height = sizes[k / 2][1],
                         .point = k % 2,
                         .world = bumps_with_holes});
        tl_source *source = open_files(NULL);
        check_levels(source);
        tl_source_destroy(source);
        end(NULL);
    }
    begin(NULL);
}

static void mosaicsAndHgtFilesHaveLevelsToo(void **state)
{
    (void)state;
    for (int k = 0; k < 4; k++)
        add_tile(&(tile){.x = 30 * (k & 1),
                         .y = -20 * (k >> 1),
                         .dx = 1,
                         .dy = 1,
                         .width = 30,
                         .height = 20,
                         .world = bumps_with_holes});
    tl_source *source = open_files(NULL);
    check_levels(source);
    tl_source_destroy(source);
    end(NULL);
    begin(NULL);
    write_hgt("N10E010.hgt", 33, 0, 0);
    source = open_files(NULL);
    check_levels(source);
    tl_source_destroy(source);
}

/* Appends a reduced copy whose samples all are `value`. */
static void add_overview(const char *path, uint32_t width, uint32_t height, float value)
{
    TIFF *tiff = TIFFOpen(path, "a");
    assert_non_null(tiff);
    TIFFSetField(tiff, TIFFTAG_SUBFILETYPE, FILETYPE_REDUCEDIMAGE);
    TIFFSetField(tiff, TIFFTAG_IMAGEWIDTH, width);
    TIFFSetField(tiff, TIFFTAG_IMAGELENGTH, height);
    TIFFSetField(tiff, TIFFTAG_BITSPERSAMPLE, 32);
    TIFFSetField(tiff, TIFFTAG_SAMPLEFORMAT, SAMPLEFORMAT_IEEEFP);
    TIFFSetField(tiff, TIFFTAG_SAMPLESPERPIXEL, 1);
    TIFFSetField(tiff, TIFFTAG_PHOTOMETRIC, PHOTOMETRIC_MINISBLACK);
    TIFFSetField(tiff, TIFFTAG_ROWSPERSTRIP, 8);
    float row[64];
    for (uint32_t k = 0; k < 64; k++)
        row[k] = value;
    for (uint32_t y = 0; y < height; y++)
        assert_int_equal(TIFFWriteScanline(tiff, row, y, 0), 1);
    TIFFClose(tiff);
}

static float first_of_level(const tl_source *source, int level)
{
    float height;
    read_level(source, level, (tl_window){0, 0, 1, 1}, &height);
    return height;
}

static void reducedCopiesServeForLevelsTheyFit(void **state)
{
    (void)state;
    tile t = {.dx = 1, .dy = 1, .width = 64, .height = 48, .world = one};
    add_tile(&t);
    add_overview(files[0], 32, 24, 2);                /* exactly a half */
    add_overview(files[0], 17, 12, 3);                /* not a power of two */
    add_overview(files[0], 8, 6, (float)VOID_NUMBER); /* an eighth; nodata counts there too */
    tl_source *source = open_files(NULL);
    tl_dem_details details;
    assert_int_equal(tl_dem_get_details(source, &details, NULL), TL_OK);
    assert_int_equal(details.overviews, 3);
    assert_true(first_of_level(source, 0) == 1);
    assert_true(first_of_level(source, -1) == 2);
    assert_true(first_of_level(source, -2) == 2);
    assert_true(isnan(first_of_level(source, -3)));
    assert_true(isnan(first_of_level(source, -6)));
    tl_source_destroy(source);
    source = open_files(&(tl_dem_options){.exact_levels = true});
    check_levels(source);
    tl_source_destroy(source);
    t.point = true; /* a level of points holds samples, which no copy is known to hold */
    write_tile(files[0], &t);
    add_overview(files[0], 32, 24, 2);
    source = open_files(NULL);
    check_levels(source);
    tl_source_destroy(source);
}

static void reducedCopiesOfAllFilesServeForAMosaic(void **state)
{
    (void)state;
    tile t = {.dx = 1, .dy = 1, .width = 32, .height = 24, .world = one};
    add_tile(&t);
    t.x = 32;
    add_tile(&t);
    for (int k = 0; k < 2; k++) {
        add_overview(files[k], 16, 12, (float)(2 + k));
        add_overview(files[k], 8, 6, (float)(4 + k));
    }
    add_overview(files[0], 4, 3, 6); /* the other has none of these */
    tl_source *source = open_files(NULL);
    float row[32];
    read_level(source, -1, (tl_window){0, 11, 32, 1}, row);
    for (int k = 0; k < 32; k++)
        assert_true(row[k] == (k < 16 ? 2 : 3));
    read_level(source, -2, (tl_window){0, 5, 16, 1}, row);
    for (int k = 0; k < 16; k++)
        assert_true(row[k] == (k < 8 ? 4 : 5));
    read_level(source, -4, (tl_window){0, 1, 4, 1}, row); /* made of level -2 */
    for (int k = 0; k < 4; k++)
        assert_true(row[k] == (k < 2 ? 4 : 5));
    tl_source_destroy(source);
    source = open_files(&(tl_dem_options){.exact_levels = true});
    check_levels(source);
    tl_source_destroy(source);
    source = open_files(&(tl_dem_options){.feather = true});
    assert_true(first_of_level(source, -1) == 1);
    tl_source_destroy(source);
}

/* Cells of a file that begins within one of the mosaic's are not the mosaic's; gaps are no matter. */
static void reducedCopiesServeWhereTheirCellsAreTheMosaics(void **state)
{
    (void)state;
    tile t = {.dx = 1, .dy = 1, .width = 30, .height = 24, .world = one};
    add_tile(&t);
    t.x = 34;
    add_tile(&t);
    for (int k = 0; k < 2; k++) {
        add_overview(files[k], 15, 12, (float)(2 + k));
        add_overview(files[k], 8, 6, (float)(4 + k));
    }
    tl_source *source = open_files(NULL); /* 34 is no multiple of 4 */
    float row[32];
    read_level(source, -1, (tl_window){0, 3, 32, 1}, row);
    for (int k = 0; k < 32; k++)
        assert_true(k < 15 ? row[k] == 2 : k < 17 ? isnan(row[k]) : row[k] == 3);
    read_level(source, -2, (tl_window){0, 3, 16, 1}, row);
    for (int k = 0; k < 16; k++)
        assert_true(k < 8 ? row[k] == 2 : row[k] == 3);
    tl_source_destroy(source);
}

static int make_folder(void **state)
{
    (void)state;
    const char *place = getenv("TMPDIR");
    snprintf(folder, sizeof folder, "%.40s/talus-XXXXXX", place ? place : "/tmp");
    return mkdtemp(folder) ? 0 : -1;
}

static int remove_folder(void **state)
{
    (void)state;
    return rmdir(folder);
}

#define TEST(name) cmocka_unit_test_setup_teardown(name, begin, end)

int main(void)
{
    const struct CMUnitTest tests[] = {
        TEST(fourPointTilesAreOneRaster),
        TEST(fourAreaTilesAreOneRaster),
        TEST(tilesThatRunTheOtherWayAreTurned),
        TEST(theNextFillsVoidsOfTheFirst),
        TEST(theFirstWinsAmongEquals),
        TEST(gapsAreVoid),
        TEST(theFinestWinsAndOthersAreInterpolated),
        TEST(pointsAndAreasJoinHalfACellApart),
        TEST(interpolationStopsAtVoids),
        TEST(coarseAreaTilesJoinWithoutAGap),
        TEST(featheredJoinsAreSmooth),
        TEST(featheringKeepsWhatAgrees),
        TEST(aFineTileFadesIntoACoarseOne),
        TEST(membersThatDoNotFitAreRefusedByName),
        TEST(tilesBesideTheAntimeridianAreNeighbours),
        TEST(longitudesTo360JoinThoseFromMinus180),
        TEST(aWholeGlobeOfTilesStaysWhereItIs),
        TEST(aRasterOf360DegreesWraps),
        TEST(hundredsOfTilesNeedFewOpenFiles),
        TEST(aFileThatChangesMeanwhileIsAnError),
        TEST(threadsReadTheSame),
        TEST(binsFindWhatASearchFinds),
        TEST(hgtFilesLieWhereTheirNamesSay),
        TEST(hgtTilesJoinWithoutASeam),
        TEST(badHgtFilesSayWhy),
        TEST(coarserLevelsArePointsOrMeans),
        TEST(mosaicsAndHgtFilesHaveLevelsToo),
        TEST(reducedCopiesServeForLevelsTheyFit),
        TEST(reducedCopiesOfAllFilesServeForAMosaic),
        TEST(reducedCopiesServeWhereTheirCellsAreTheMosaics),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
