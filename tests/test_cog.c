/* GeoTIFFs with overviews, in the order of cloud-optimised ones, by each compression: judged by libtiff and by hand. */
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/out/out.h"

#include <setjmp.h>
#include <stdarg.h>

#include <cmocka.h>

#include "tests/near.h"

#include <tiffio.h>

#include <math.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

enum { WIDTH = 1100, HEIGHT = 601, LEVELS = 4 /* 1100, 550, 275, 138 */, TILE = 256 };

static const tl_compression compressions[] = {TL_COMPRESSION_DEFAULT, TL_COMPRESSION_NONE, TL_COMPRESSION_DEFLATE,
                                              TL_COMPRESSION_ZSTD,    TL_COMPRESSION_LZW,  TL_COMPRESSION_LERC};
static const int codecs[] = {COMPRESSION_ADOBE_DEFLATE, COMPRESSION_NONE, COMPRESSION_ADOBE_DEFLATE,
                             COMPRESSION_ZSTD,          COMPRESSION_LZW,  COMPRESSION_LERC};
enum { KINDS = sizeof compressions / sizeof *compressions };

typedef struct bench {
    float *heights;
    tl_source *source;
    char path[64], other[64];
} bench;

static int setUp(void **state)
{
    bench *b = calloc(1, sizeof *b);
    b->heights = tl_alloc_grid(WIDTH, HEIGHT, sizeof *b->heights);
    for (int64_t k = 0; k < WIDTH * HEIGHT; k++) {
        int64_t x = k % WIDTH, y = k / WIDTH;
        b->heights[k] =
            (x - 500) * (x - 500) + (y - 300) * (y - 300) < 40000
                ? NAN
                : (float)(900 + 80 * sin((double)x * .03) * cos((double)y * .02) + (double)(k * 37 % 101) / 50);
    }
    const tl_source_info info = {.width = WIDTH,
                                 .height = HEIGHT,
                                 .georef = {.located = true,
                                            .transform = {400015, 30, 0, 3999985, 0, -30},
                                            .cell_x = 30,
                                            .cell_y = 30,
                                            .height_unit = 1},
                                 .has_voids = true,
                                 .name = "steps"};
    b->source = tl_array_source_create(b->heights, &info, NULL);
    snprintf(b->path, sizeof b->path, "cog-%ld.tif", (long)getpid());
    snprintf(b->other, sizeof b->other, "cog-%ld-2.tif", (long)getpid());
    *state = b;
    return 0;
}

static int tearDown(void **state)
{
    bench *b = *state;
    unlink(b->path);
    unlink(b->other);
    tl_source_destroy(b->source);
    free(b->heights);
    free(b);
    return 0;
}

static void write_ok(const bench *b, const char *path, tl_write_options options)
{
    tl_error error;
    options.overwrite = true;
    if (tl_write_grid(b->source, path, &options, &error) != TL_OK)
        fail_msg("%s", error.text);
}

static unsigned char *slurp(const char *path, size_t *size)
{
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    fseek(f, 0, SEEK_END);
    *size = (size_t)ftell(f);
    rewind(f);
    unsigned char *bytes = malloc(*size);
    assert_int_equal(fread(bytes, 1, *size, f), *size);
    fclose(f);
    return bytes;
}

static bool same(float a, float b)
{
    return a == b || (isnan(a) && isnan(b));
}

/* What a level has at a sample, straight from the definition. */
static float wanted(const bench *b, tl_mip kind, int level, int64_t x, int64_t y)
{
    if (level == 0 || kind == TL_MIP_LATTICE)
        return b->heights[(y << level) * WIDTH + (x << level)];
    int64_t w = tl_div_up(WIDTH, 1 << (level - 1)), h = tl_div_up(HEIGHT, 1 << (level - 1));
    double sum = 0;
    int count = 0;
    for (int k = 0; k < 4; k++) {
        int64_t u = 2 * x + (k & 1), v = 2 * y + (k >> 1);
        float z = u < w && v < h ? wanted(b, kind, level - 1, u, v) : NAN;
        sum += isnan(z) ? 0 : (double)z;
        count += !isnan(z);
    }
    return count ? (float)(sum / count) : NAN;
}

/* The heights of the directory in hand. */
static float *read_image(TIFF *tiff, uint32_t *width, uint32_t *height)
{
    static float tile[TILE * TILE];
    assert_int_equal(TIFFGetField(tiff, TIFFTAG_IMAGEWIDTH, width), 1);
    assert_int_equal(TIFFGetField(tiff, TIFFTAG_IMAGELENGTH, height), 1);
    float *out = tl_alloc_grid(*width, *height, sizeof *out);
    for (uint32_t y = 0; y < *height; y += TILE)
        for (uint32_t x = 0; x < *width; x += TILE) {
            assert_int_equal(TIFFReadTile(tiff, tile, x, y, 0, 0), sizeof tile);
            for (uint32_t v = 0; v < TILE && y + v < *height; v++)
                memcpy(out + (y + v) * *width + x, tile + v * TILE,
                       sizeof(float) * (*width - x < TILE ? *width - x : TILE));
        }
    return out;
}

static void check_levels(const bench *b, tl_mip kind, int codec)
{
    TIFF *tiff = TIFFOpen(b->path, "r");
    assert_non_null(tiff);
    for (int level = 0; level < LEVELS; level++) {
        uint32_t width, height, reduced = 0;
        uint16_t found;
        assert_int_equal(TIFFSetDirectory(tiff, (tdir_t)level), 1);
        TIFFGetFieldDefaulted(tiff, TIFFTAG_SUBFILETYPE, &reduced);
        assert_int_equal(reduced, level ? FILETYPE_REDUCEDIMAGE : 0);
        assert_int_equal(TIFFGetField(tiff, TIFFTAG_COMPRESSION, &found), 1);
        assert_int_equal(found, codec);
        float *heights = read_image(tiff, &width, &height);
        assert_int_equal(width, tl_div_up(WIDTH, 1 << level));
        assert_int_equal(height, tl_div_up(HEIGHT, 1 << level));
        for (int64_t y = 0; y < height; y++)
            for (int64_t x = 0; x < width; x++)
                if (!same(heights[y * width + x], wanted(b, kind, level, x, y)))
                    fail_msg("level %d at %d, %d", level, (int)x, (int)y);
        free(heights);
    }
    assert_int_equal(TIFFReadDirectory(tiff), 0);
    TIFFClose(tiff);
}

static void overviewsAreTheLevels(void **state)
{
    const bench *b = *state;
    for (int kind = TL_MIP_LATTICE; kind <= TL_MIP_BOX; kind++)
        for (int cog = 0; cog < 2; cog++)
            for (size_t k = 0; k < KINDS; k++) {
                if (!TIFFIsCODECConfigured((uint16_t)codecs[k]))
                    continue;
                write_ok(b, b->path,
                         (tl_write_options){.mip = (tl_mip)kind, .cog = cog, .compression = compressions[k]});
                check_levels(b, (tl_mip)kind, codecs[k]);
            }
}

static uint64_t number(const unsigned char *bytes, size_t count)
{
    uint64_t value = 0;
    while (count-- > 0)
        value = value << 8 | bytes[count];
    return value;
}

/* The file's own structure, by its bytes: [header][ghost][directories][tiles of the coarsest level] ... [of the
 * finest], each tile between its size and its last four bytes. */
static void cogsAreInTheirOrder(void **state)
{
    const bench *b = *state;
    size_t size;
    write_ok(b, b->path, (tl_write_options){.mip = TL_MIP_BOX, .cog = true});
    unsigned char *bytes = slurp(b->path, &size);
    assert_memory_equal(bytes, "II*", 4);
    assert_memory_equal(bytes + 8, "GDAL_STRUCTURAL_METADATA_SIZE=000140 bytes\nLAYOUT=IFDS_BEFORE_DATA\n", 67);
    uint64_t at = number(bytes + 4, 4), before = size, end = 0;
    int images = 0;
    assert_int_equal(at, 192); /* behind the ghost: 8 + 43 + 140, made even */
    for (; at; images++) {
        uint64_t entries = number(bytes + at, 2), offsets = 0, sizes = 0, tiles = 0, tag = 0;
        for (uint64_t k = 0; k < entries; k++) {
            const unsigned char *e = bytes + at + 2 + 12 * k;
            assert_true(number(e, 2) > tag); /* rising, without repetition */
            tag = number(e, 2);
            if (tag == TIFFTAG_TILEOFFSETS)
                offsets = number(e + 8, 4), tiles = number(e + 4, 4);
            if (tag == TIFFTAG_TILEBYTECOUNTS)
                sizes = number(e + 8, 4);
        }
        assert_true(tiles > 0 && sizes);
        uint64_t first = tiles == 1 ? offsets : number(bytes + offsets, 4), next = first;
        for (uint64_t k = 0; k < tiles; k++) {
            uint64_t from = tiles == 1 ? offsets : number(bytes + offsets + 4 * k, 4);
            uint64_t count = tiles == 1 ? sizes : number(bytes + sizes + 4 * k, 4);
            assert_int_equal(from, next);
            assert_int_equal(number(bytes + from - 4, 4), count);
            assert_memory_equal(bytes + from + count, bytes + from + count - 4, 4);
            next = from + count + 8;
        }
        assert_int_equal(next - 4, before); /* the finer level begins where the coarser one ends */
        before = first - 4;
        end = at + 2 + 12 * entries + 4;
        at = number(bytes + end - 4, 4);
    }
    assert_int_equal(images, LEVELS);
    assert_true(end <= before); /* directories first */
    free(bytes);
}

static void masksTellVoids(void **state)
{
    const bench *b = *state;
    for (int cog = 0; cog < 2; cog++) {
        write_ok(b, b->path, (tl_write_options){.mip = TL_MIP_LATTICE, .mask = true, .cog = cog});
        TIFF *tiff = TIFFOpen(b->path, "r");
        assert_non_null(tiff);
        for (int level = 0; level < LEVELS; level++) { /* each behind its heights */
            static unsigned char tile[TILE * TILE / 8];
            uint32_t width, height, kind = 0;
            assert_int_equal(TIFFSetDirectory(tiff, (tdir_t)(2 * level + 1)), 1);
            assert_int_equal(TIFFGetField(tiff, TIFFTAG_SUBFILETYPE, &kind), 1);
            assert_int_equal(kind, FILETYPE_MASK | (level ? FILETYPE_REDUCEDIMAGE : 0));
            TIFFGetField(tiff, TIFFTAG_IMAGEWIDTH, &width);
            TIFFGetField(tiff, TIFFTAG_IMAGELENGTH, &height);
            for (uint32_t y = 0; y < height; y++)
                for (uint32_t x = 0; x < width; x++) {
                    if (x % TILE == 0)
                        assert_int_equal(TIFFReadTile(tiff, tile, x, y, 0, 0), sizeof tile);
                    size_t at = y % TILE * TILE + x % TILE;
                    bool known = tile[at / 8] >> (7 - at % 8) & 1;
                    assert_int_equal(known, !isnan(wanted(b, TL_MIP_LATTICE, level, x, y)));
                }
        }
        assert_int_equal(TIFFSetDirectory(tiff, 2 * LEVELS), 0);
        TIFFClose(tiff);
        tl_source *back = tl_open(b->path, NULL); /* our own reader has its voids as before */
        float z;
        assert_int_equal(tl_source_read(back, 0, (tl_window){500, 300, 1, 1}, &z, NULL), TL_OK);
        assert_true(isnan(z));
        tl_source_destroy(back);
    }
}

static void lercKeepsItsBound(void **state)
{
    const bench *b = *state;
    if (!TIFFIsCODECConfigured(COMPRESSION_LERC))
        skip();
    for (double bound = 1e-5; bound < 100; bound *= 10) {
        write_ok(b, b->path, (tl_write_options){.compression = TL_COMPRESSION_LERC, .lerc_error = bound});
        tl_source *back = tl_open(b->path, NULL);
        assert_non_null(back);
        float *heights = tl_alloc_grid(WIDTH, HEIGHT, sizeof *heights);
        assert_int_equal(tl_source_read(back, 0, (tl_window){0, 0, WIDTH, HEIGHT}, heights, NULL), TL_OK);
        double worst = 0;
        for (int64_t k = 0; k < WIDTH * HEIGHT; k++) {
            assert_int_equal(isnan(heights[k]) != 0, isnan(b->heights[k]) != 0);
            if (!isnan(heights[k]))
                worst = fmax(worst, fabs((double)heights[k] - (double)b->heights[k]));
        }
        if (worst > bound)
            fail_msg("%g, not %g", worst, bound);
        assert_true(bound < 1e-4 || worst > bound / 2); /* it is used */
        char told[32];
        assert_true(out_geotiff_item(b->path, "lerc_error", told, sizeof told));
        assert_near(atof(told), bound, 0);
        free(heights);
        tl_source_destroy(back);
    }
}

static void bytesDoNotDependOnThreadsOrMemory(void **state)
{
    const bench *b = *state;
    for (size_t k = 0; k < KINDS; k++) {
        if (!TIFFIsCODECConfigured((uint16_t)codecs[k]))
            continue;
        const tl_run one = {.threads = 1}, three = {.threads = 3, .memory = 1000}; /* bytes: coarser levels on disk */
        tl_write_options options = {.mip = TL_MIP_BOX, .cog = true, .compression = compressions[k], .run = &one};
        size_t size, size2;
        write_ok(b, b->path, options);
        options.run = &three;
        write_ok(b, b->other, options);
        unsigned char *bytes = slurp(b->path, &size), *bytes2 = slurp(b->other, &size2);
        assert_int_equal(size, size2);
        assert_memory_equal(bytes, bytes2, size);
        free(bytes);
        free(bytes2);
    }
}

/* Levels of areas are means, so overviews of every second sample must not pass for them. */
static void sampledOverviewsAreNoLevelsOfAreas(void **state)
{
    const bench *b = *state;
    float plain[64], read[64];
    const tl_window window = {40, 40, 8, 8};
    write_ok(b, b->path, (tl_write_options){.cog = true});
    tl_source *without = tl_open(b->path, NULL);
    assert_int_equal(tl_source_read(without, -1, window, plain, NULL), TL_OK);
    tl_source_destroy(without);
    for (int kind = TL_MIP_LATTICE; kind <= TL_MIP_BOX; kind++) {
        write_ok(b, b->path, (tl_write_options){.mip = (tl_mip)kind});
        tl_source *with = tl_open(b->path, NULL);
        assert_int_equal(tl_source_read(with, -1, window, read, NULL), TL_OK);
        tl_source_destroy(with);
        for (int k = 0; k < 64; k++)
            if (fabsf(read[k] - plain[k]) > 1e-4f) /* a mean of four, rounded otherwise */
                fail_msg("kind %d: %g, not %g", kind, (double)read[k], (double)plain[k]);
    }
}

static void whatCannotBeIsTold(void **state)
{
    const bench *b = *state;
    tl_error error;
    const struct {
        const char *name;
        tl_write_options options;
        const char *word;
    } cases[] = {{"x.tif", {.compression = TL_COMPRESSION_PIZ}, "EXR"},
                 {"x.tif", {.compression = TL_COMPRESSION_ZIPS}, "EXR"},
                 {"x.tif", {.lerc_error = 1}, "lerc"},
                 {"x.tif", {.compression = TL_COMPRESSION_LERC, .lerc_error = -1}, "above 0"},
                 {"x.exr", {.compression = TL_COMPRESSION_ZSTD}, "GeoTIFF"},
                 {"x.exr", {.compression = TL_COMPRESSION_LERC}, "GeoTIFF"}};
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        assert_int_equal(tl_write_grid(b->source, cases[k].name, &cases[k].options, &error), TL_ERROR_ARGUMENT);
        assert_non_null(strstr(error.text, cases[k].word));
        assert_int_not_equal(access(cases[k].name, F_OK), 0);
    }
}

int main(void)
{
    TIFFSetWarningHandler(NULL); /* of GDAL's tags */
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup_teardown(overviewsAreTheLevels, setUp, tearDown),
        cmocka_unit_test_setup_teardown(cogsAreInTheirOrder, setUp, tearDown),
        cmocka_unit_test_setup_teardown(masksTellVoids, setUp, tearDown),
        cmocka_unit_test_setup_teardown(lercKeepsItsBound, setUp, tearDown),
        cmocka_unit_test_setup_teardown(bytesDoNotDependOnThreadsOrMemory, setUp, tearDown),
        cmocka_unit_test_setup_teardown(sampledOverviewsAreNoLevelsOfAreas, setUp, tearDown),
        cmocka_unit_test_setup_teardown(whatCannotBeIsTold, setUp, tearDown),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
