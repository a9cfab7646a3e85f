/* The TIFF reader, on files of every kind that are made here. */
#include "dem/text.h"
#include "lib/talus.h"
#include "make_tiff.h"

#include <math.h>
#include <pthread.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <tiffio.h>
#include <unistd.h>

#include <cmocka.h>

static char folder[64], path[96];
static const double none = (double)NAN, infinite = (double)INFINITY;

static uint32_t random_number(uint32_t *state)
{
    *state ^= *state << 13;
    *state ^= *state >> 17;
    return *state ^= *state << 5;
}

static bool same_float(float a, float b)
{
    return memcmp(&a, &b, sizeof a) == 0 || (isnan(a) && isnan(b));
}

static tl_source *open_band(unsigned band)
{
    tl_error error = {0};
    tl_source *source = tl_dem_open((const char *const[]){path}, 1, &(tl_dem_options){.band = band}, &error);
    if (!source)
        print_error("%s\n", error.text);
    assert_non_null(source);
    return source;
}

static tl_source *make_and_open(const make_tiff_options *options)
{
    assert_true(make_tiff(path, options));
    return open_band(0);
}

static void read_window(const tl_source *source, tl_window window, float *out)
{
    tl_error error = {0};
    tl_status status = tl_source_read(source, 0, window, out, &error);
    if (status != TL_OK)
        print_error("%s\n", error.text);
    assert_int_equal(status, TL_OK);
}

static float one_height(const tl_source *source, int64_t x, int64_t y)
{
    float height = 0;
    read_window(source, (tl_window){x, y, 1, 1}, &height);
    return height;
}

/* The whole raster and some random windows hold what was written. */
static void check_values(const make_tiff_options *o, unsigned band, uint32_t *state)
{
    uint16_t format = o->format;
    tl_source *source = open_band(band + 1);
    assert_int_equal(source->info.width, o->width);
    assert_int_equal(source->info.height, o->height);
    float *heights = malloc(sizeof *heights * o->width * o->height);
    for (int k = 0; k < 4; k++) {
        tl_window window = {0, 0, o->width, o->height};
        if (k) {
            window.x = random_number(state) % o->width;
            window.y = random_number(state) % o->height;
            window.width = 1 + random_number(state) % (o->width - window.x);
            window.height = 1 + random_number(state) % (o->height - window.y);
        }
        read_window(source, window, heights);
        for (int64_t y = 0; y < window.height; y++)
            for (int64_t x = 0; x < window.width; x++) {
                double value =
                    make_tiff_value(band, (uint32_t)(window.x + x), (uint32_t)(window.y + y), o->bits, format);
                if (heights[y * window.width + x] != (float)value)
                    fail_msg("codec %d, predictor %d, %d bits at %d, %d of band %u: %.9g instead of %.9g", o->codec,
                             o->predictor, o->bits, (int)(window.x + x), (int)(window.y + y), band,
                             (double)heights[y * window.width + x], value);
            }
    }
    free(heights);
    tl_source_destroy(source);
}

/* ---- The matrix ---- */

typedef struct sample_type {
    uint16_t bits, format;
    const char *name;
} sample_type;

static const sample_type types[] = {
    {8, SAMPLEFORMAT_UINT, "uint8"},      {16, SAMPLEFORMAT_UINT, "uint16"}, {32, SAMPLEFORMAT_UINT, "uint32"},
    {64, SAMPLEFORMAT_UINT, "uint64"},    {8, SAMPLEFORMAT_INT, "int8"},     {16, SAMPLEFORMAT_INT, "int16"},
    {32, SAMPLEFORMAT_INT, "int32"},      {64, SAMPLEFORMAT_INT, "int64"},   {32, SAMPLEFORMAT_IEEEFP, "float32"},
    {64, SAMPLEFORMAT_IEEEFP, "float64"},
};

static const struct {
    uint16_t code;
    const char *name;
    bool predictors;
} codecs[] = {
    {COMPRESSION_NONE, "none", false},
    {COMPRESSION_LZW, "lzw", true},
    {COMPRESSION_ADOBE_DEFLATE, "deflate", true},
    {COMPRESSION_DEFLATE, "deflate", true},
    {COMPRESSION_PACKBITS, "packbits", false},
    {COMPRESSION_ZSTD, "zstd", true},
    {COMPRESSION_LERC, "lerc", false},
    {COMPRESSION_LZMA, "lzma", true},
};

/* One type and codec in every layout, byte order, arrangement of bands and predictor; the number of files read. */
static unsigned check_layouts(const sample_type *type, size_t codec, uint32_t *state)
{
    unsigned count = 0;
    int predictors = !codecs[codec].predictors ? 1 : type->format == SAMPLEFORMAT_IEEEFP ? 3 : 2;
    for (int k = 0; k < 16 * predictors; k++) {
        make_tiff_options options = {
            .width = 37,
            .height = 29,
            .bands = 2,
            .bits = type->bits,
            .format = type->format,
            .codec = codecs[codec].code,
            .predictor = codecs[codec].predictors ? (uint16_t)(1 + k / 16) : 0,
            .block_width = k & 1 ? 16 : 0,
            .block_height = k & 1 ? 32 : 7,
            .big_endian = k & 2,
            .separate = k & 4,
            .big_tiff = k & 8,
        };
        if (!make_tiff(path, &options))
            return 0;
        check_values(&options, count & 1, state);
        count++;
    }
    return count;
}

static void readsEveryTypeCodecAndLayout(void **state)
{
    (void)state;
    uint32_t random = 2463534242u;
    for (size_t type = 0; type < sizeof types / sizeof *types; type++)
        for (size_t codec = 0; codec < sizeof codecs / sizeof *codecs; codec++) {
            /* LERC has no 64-bit integers */
            bool impossible = codecs[codec].code == COMPRESSION_LERC && types[type].bits == 64 &&
                              types[type].format != SAMPLEFORMAT_IEEEFP;
            unsigned count = check_layouts(&types[type], codec, &random);
            if (!count != impossible)
                fail_msg("%s %s: %u files", types[type].name, codecs[codec].name, count);
        }
}

static void readsPackedBits(void **state)
{
    (void)state;
    uint32_t random = 88172645u;
    for (uint16_t bits = 1; bits < 32; bits++)
        for (int k = 0; k < 8; k++) {
            if (bits % 8 == 0)
                continue;
            make_tiff_options options = {
                .width = 21,
                .height = 6,
                .bands = 3,
                .bits = bits,
                .format = k & 4 && bits > 1 ? SAMPLEFORMAT_INT : SAMPLEFORMAT_UINT,
                .codec = COMPRESSION_ADOBE_DEFLATE,
                .block_height = 4,
                .big_endian = k & 1,
                .separate = k & 2,
            };
            assert_true(make_tiff(path, &options));
            check_values(&options, (unsigned)k % 3, &random);
        }
}

static const uint16_t halves[] = {0x0000, 0x3c00, 0xc000, 0x7bff, 0x0400, 0x0001, 0x83ff, 0x7c00, 0xfc00, 0x7e00};

static double half_bits(unsigned band, uint32_t x, uint32_t y, uint16_t bits, uint16_t format)
{
    (void)band, (void)y, (void)bits, (void)format;
    return halves[x];
}

static void readsHalfFloats(void **state)
{
    (void)state;
    const double expected[] = {0, 1, -2, 65504, 0x1p-14, 0x1p-24, -1023 * 0x1p-24, none, none, none};
    for (int big_endian = 0; big_endian < 2; big_endian++) {
        tl_source *source = make_and_open(&(make_tiff_options){.width = 10,
                                                               .height = 1,
                                                               .bits = 16,
                                                               .format = SAMPLEFORMAT_IEEEFP,
                                                               .value = half_bits,
                                                               .big_endian = big_endian});
        for (int x = 0; x < 10; x++)
            assert_true(same_float(one_height(source, x, 0), (float)expected[x]));
        tl_source_destroy(source);
    }
}

/* ---- Details and meaning ---- */

static void tellsWhatTheFileIs(void **state)
{
    (void)state;
    tl_dem_details details;
    tl_source *source = make_and_open(&(make_tiff_options){.width = 40,
                                                           .height = 30,
                                                           .bands = 3,
                                                           .bits = 16,
                                                           .format = SAMPLEFORMAT_INT,
                                                           .codec = COMPRESSION_LZW,
                                                           .predictor = 2,
                                                           .block_width = 32,
                                                           .block_height = 16,
                                                           .big_endian = true,
                                                           .big_tiff = true,
                                                           .nodata = "-32768",
                                                           .overviews = 2});
    tl_source_destroy(source);
    source = open_band(2);
    assert_int_equal(tl_dem_get_details(source, &details, NULL), TL_OK);
    assert_string_equal(details.sample_type, "int16");
    assert_string_equal(details.codec, "lzw");
    assert_int_equal(details.predictor, 2);
    assert_true(details.tiled && details.big_tiff && details.big_endian && details.has_nodata);
    assert_int_equal(details.block_width, 32);
    assert_int_equal(details.block_height, 16);
    assert_int_equal(details.bands, 3);
    assert_int_equal(details.band, 2);
    assert_true(details.nodata == -32768 && details.scale == 1 && details.offset == 0);
    assert_int_equal(details.overviews, 2);
    assert_true(source->info.quantum == 1 && source->info.has_voids);
    assert_string_equal(source->info.name, path);
    struct stat status;
    assert_int_equal(stat(path, &status), 0);
    assert_int_equal(details.bytes, status.st_size);
    tl_source_destroy(source);
    const float height = 1;
    const tl_source_info info = {.width = 1, .height = 1, .georef = {.transform = {0}}, .name = "array"};
    source = tl_array_source_create(&height, &info, NULL);
    assert_int_equal(tl_dem_get_details(source, &details, NULL), TL_ERROR_ARGUMENT);
    tl_source_destroy(source);
}

static double special[8];

static double special_value(unsigned band, uint32_t x, uint32_t y, uint16_t bits, uint16_t format)
{
    (void)band, (void)y, (void)bits, (void)format;
    return special[x];
}

/* Writes `count` numbers as one row and checks what heights they become. */
static void check_row(const make_tiff_options *base, size_t count, const double *stored, const double *heights)
{
    make_tiff_options options = *base;
    options.width = (uint32_t)count;
    options.height = 1;
    options.value = special_value;
    memcpy(special, stored, count * sizeof *stored);
    tl_source *source = make_and_open(&options);
    for (size_t k = 0; k < count; k++) {
        float height = one_height(source, (int64_t)k, 0);
        if (!same_float(height, (float)heights[k]))
            fail_msg("nodata %s: %.9g is read as %.9g", base->nodata ? base->nodata : "none", stored[k],
                     (double)height);
        if (isnan(height))
            assert_true(source->info.has_voids);
    }
    tl_source_destroy(source);
}

static void nodataBecomesVoid(void **state)
{
    (void)state;
    const make_tiff_options int16 = {.bits = 16, .format = SAMPLEFORMAT_INT, .nodata = "-32768"};
    check_row(&int16, 3, (double[]){-32768, -32767, 0}, (double[]){none, -32767, 0});
    const make_tiff_options spaced = {.bits = 16, .format = SAMPLEFORMAT_INT, .nodata = " -9999 "};
    check_row(&spaced, 2, (double[]){-9999, 9999}, (double[]){none, 9999});
    const make_tiff_options nan = {.nodata = "nan"};
    check_row(&nan, 3, (double[]){none, 0, -0.0}, (double[]){none, 0, -0.0});
    /* a float's lowest number, exactly, cut to six digits, and beyond what a float can hold */
    const char *const lowest[] = {"-3.4028234663852886e+38", "-3.40282e+38", "-1.7976931348623157e+308"};
    for (int k = 0; k < 3; k++) {
        const make_tiff_options o = {.nodata = lowest[k]};
        check_row(&o, 2, (double[]){-3.4028234663852886e+38, -1e37},
                  (double[]){k < 2 ? none : -3.4028234663852886e+38, -1e37});
    }
    /* 0.1 is no float: it means the float next to it */
    const make_tiff_options tenth = {.nodata = "0.1"};
    check_row(&tenth, 2, (double[]){(double)0.1f, 0.2}, (double[]){none, 0.2});
    const make_tiff_options tenth64 = {.bits = 64, .format = SAMPLEFORMAT_IEEEFP, .nodata = "0.1"};
    check_row(&tenth64, 2, (double[]){0.1, (double)0.1f}, (double[]){none, 0.1});
    const make_tiff_options microsoft = {.nodata = "1.#INF"};
    check_row(&microsoft, 2, (double[]){1, infinite}, (double[]){1, none});
}

static void nodataOutsideOfTheTypeNeverMatches(void **state)
{
    (void)state;
    const char *const outside[] = {"-9999", "256", "1e300", "12.5", "nan", "", "none"};
    for (size_t k = 0; k < sizeof outside / sizeof *outside; k++) {
        const make_tiff_options o = {.bits = 8, .nodata = outside[k]};
        check_row(&o, 4, (double[]){0, 12, 241, 255}, (double[]){0, 12, 241, 255});
        tl_source *source = open_band(0);
        if (strcmp(outside[k], "12.5") != 0) /* within the range, so voids are not ruled out */
            assert_false(source->info.has_voids);
        tl_source_destroy(source);
    }
}

static void floatsThatAreNoHeightsAreVoid(void **state)
{
    (void)state;
    const make_tiff_options single = {.bits = 32, .format = SAMPLEFORMAT_IEEEFP};
    check_row(&single, 6, (double[]){none, infinite, -infinite, -0.0, 0x1p-149, 3.4028234663852886e+38},
              (double[]){none, none, none, -0.0, 0x1p-149, 3.4028234663852886e+38});
    const make_tiff_options wide = {.bits = 64, .format = SAMPLEFORMAT_IEEEFP};
    check_row(&wide, 4, (double[]){1e300, -1e300, 1e-300, 0.1}, (double[]){none, none, 0, 0.1});
}

static void scaleAndOffsetApplyToTheBand(void **state)
{
    (void)state;
    const char *metadata = "<GDALMetadata>\n <Item name=\"SCALE\" sample=\"1\" role=\"scale\">7</Item>\n"
                           " <Item name=\"note\">scale</Item>\n"
                           " <Item name=\"OFFSET\" sample=\"0\" role=\"offset\">-100</Item>\n"
                           " <Item name=\"SCALE\" sample=\"0\" role=\"scale\">0.1</Item>\n</GDALMetadata>\n";
    const make_tiff_options decimetres = {.bits = 16, .format = SAMPLEFORMAT_INT, .nodata = "-1", .metadata = metadata};
    check_row(&decimetres, 4, (double[]){0, 1, 32767, -1}, (double[]){-100, -100 + 0.1 * 1, -100 + 0.1 * 32767, none});
    tl_source *source = open_band(0);
    assert_true(source->info.quantum == 0.1);
    tl_source_destroy(source);
    const char *const broken[] = {"<Item name=\"S\" sample=\"0\" role=\"scale\">nan</Item>",
                                  "<Item name=\"S\" sample=\"0\" role=\"scale\">0</Item>",
                                  "<Item name=\"S\" sample=\"0\" role=\"scale\"",
                                  "<Item ",
                                  "<Item >",
                                  "<Item name=\"S\" sample=\"0\" role=\"scale\">x</Item>"};
    for (size_t k = 0; k < sizeof broken / sizeof *broken; k++) {
        const make_tiff_options o = {.bits = 16, .metadata = broken[k]};
        check_row(&o, 2, (double[]){3, 500}, (double[]){3, 500});
    }
}

static void scaledHeightsBeyondFloatAreVoid(void **state)
{
    (void)state;
    const make_tiff_options huge = {.bits = 8, .metadata = "<Item name=\"S\" sample=\"0\" role=\"scale\">1e38</Item>"};
    check_row(&huge, 3, (double[]){0, 3, 4}, (double[]){0, 3e38, none});
}

static void numbersDoNotDependOnTheLocale(void **state)
{
    (void)state;
    double value = 0;
    assert_true(dem_parse_number("0.25 m", &value));
    assert_true(value == 0.25);
    assert_false(dem_parse_number("m", &value));
    assert_false(dem_parse_number("", &value));
    assert_true(value == 0.25);
}

/* ---- Layout ---- */

static void blocksLeftOutAreNodataOrZero(void **state)
{
    (void)state;
    for (int k = 0; k < 4; k++) {
        make_tiff_options o = {.width = 40,
                               .height = 40,
                               .bits = 16,
                               .format = SAMPLEFORMAT_INT,
                               .block_width = k & 1 ? 16 : 0,
                               .block_height = 16,
                               .leave_out = 2,
                               .nodata = k & 2 ? "-9999" : NULL,
                               .codec = COMPRESSION_ADOBE_DEFLATE};
        tl_source *source = make_and_open(&o);
        assert_true(same_float(one_height(source, 3, 3), k & 2 ? NAN : 0));
        float value = (float)make_tiff_value(0, 20, 20, 16, SAMPLEFORMAT_INT);
        uint32_t block = k & 1 ? 4 : 1; /* the block of (20, 20) */
        assert_true(same_float(one_height(source, 20, 20), block % 2 ? value : k & 2 ? NAN : 0));
        value = (float)make_tiff_value(0, 20, 3, 16, SAMPLEFORMAT_INT);
        if (k & 1)
            assert_true(same_float(one_height(source, 20, 3), value));
        tl_source_destroy(source);
    }
}

static void readsSingleSamplesRowsAndColumns(void **state)
{
    (void)state;
    uint32_t random = 12345;
    const uint32_t sizes[][2] = {{1, 1}, {1, 300}, {300, 1}, {2, 2}};
    for (size_t k = 0; k < 4; k++)
        for (int tiled = 0; tiled < 2; tiled++) {
            make_tiff_options o = {.width = sizes[k][0],
                                   .height = sizes[k][1],
                                   .bits = 16,
                                   .format = SAMPLEFORMAT_UINT,
                                   .block_width = tiled ? 64 : 0,
                                   .block_height = tiled ? 16 : 0};
            assert_true(make_tiff(path, &o));
            check_values(&o, 0, &random);
        }
}

/* 3000 x 3000 floats are more than the reader keeps of one strip, so it decodes parts of it as they are wanted. */
static void readsAStripThatIsTooLargeToKeep(void **state)
{
    (void)state;
    uint32_t random = 99;
    for (int separate = 0; separate < 2; separate++) {
        make_tiff_options o = {.width = 3000,
                               .height = 3000,
                               .bits = 8,
                               .format = SAMPLEFORMAT_UINT,
                               .bands = 2,
                               .codec = COMPRESSION_ZSTD,
                               .predictor = 2,
                               .separate = separate};
        assert_true(make_tiff(path, &o));
        check_values(&o, 1, &random);
        tl_source *source = open_band(1);
        const int64_t rows[] = {2999, 0, 1500, 1499, 2, 2998};
        for (size_t k = 0; k < 6; k++)
            assert_true(one_height(source, 7, rows[k]) ==
                        (float)make_tiff_value(0, 7, (uint32_t)rows[k], 8, SAMPLEFORMAT_UINT));
        tl_source_destroy(source);
    }
}

/* ---- Position ---- */

static void check_transform(const make_tiff_options *options, const double expected[6])
{
    tl_source *source = make_and_open(options);
    assert_true(source->info.georef.located == (expected != NULL));
    for (int k = 0; expected && k < 6; k++)
        if (fabs(source->info.georef.transform[k] - expected[k]) > 1e-9)
            fail_msg("transform[%d] is %.12g instead of %.12g", k, source->info.georef.transform[k], expected[k]);
    tl_source_destroy(source);
}

static const uint16_t point_key[] = {1025, 0, 1, 2};
static const double scale_10[] = {10, 20, 0}, tie_corner[] = {0, 0, 0, 1000, 2000, 0};

static void areaSamplesLieHalfACellFromTheCorner(void **state)
{
    (void)state;
    make_tiff_options o = {.width = 4, .height = 3, .scale = scale_10, .ties = tie_corner};
    check_transform(&o, (double[]){1005, 10, 0, 1990, 0, -20});
    o.keys = point_key;
    o.key_count = 1;
    check_transform(&o, (double[]){1000, 10, 0, 2000, 0, -20});
    tl_source *source = open_band(0);
    assert_int_equal(source->info.type, TL_RASTER_POINT);
    tl_source_destroy(source);
    /* a tie point in the middle of the raster, and a scale that counts upwards */
    const double tie[] = {2, 1, 0, 1020, 1980, 0}, negative[] = {10, -20, 0};
    o.ties = tie;
    o.scale = negative;
    check_transform(&o, (double[]){1000, 10, 0, 2000, 0, -20});
}

static void matrixAndTiePointsGiveTheTransform(void **state)
{
    (void)state;
    const double matrix[] = {3, 4, 0, 100, 4, -3, 0, 200, 0, 0, 0, 0, 0, 0, 0, 1};
    make_tiff_options o = {.width = 4, .height = 3, .matrix = matrix};
    check_transform(&o, (double[]){103.5, 3, 4, 200.5, 4, -3});
    double ties[24];
    const double corners[4][2] = {{0, 0}, {4, 0}, {0, 3}, {4, 3}};
    for (int k = 0; k < 4; k++) {
        const double i = corners[k][0], j = corners[k][1];
        const double tie[6] = {i, j, 0, 100 + 3 * i + 4 * j, 200 + 4 * i - 3 * j, 0};
        memcpy(ties + 6 * k, tie, sizeof tie);
    }
    o = (make_tiff_options){.width = 4, .height = 3, .ties = ties, .tie_count = 4};
    check_transform(&o, (double[]){103.5, 3, 4, 200.5, 4, -3});
    ties[21] += 1; /* no affine map any more */
    check_transform(&o, NULL);
}

static void positionsThatMakeNoSenseAreNone(void **state)
{
    (void)state;
    const double flat[] = {0, 10, 0}, nowhere[] = {0, 0, 0, none, 0, 0};
    const double line[] = {0, 0, 0, 0, 0, 0, 1, 1, 0, 1, 1, 0, 2, 2, 0, 2, 2, 0};
    check_transform(&(make_tiff_options){.width = 4, .height = 3}, NULL);
    check_transform(&(make_tiff_options){.width = 4, .height = 3, .scale = scale_10}, NULL);
    check_transform(&(make_tiff_options){.width = 4, .height = 3, .scale = flat, .ties = tie_corner}, NULL);
    check_transform(&(make_tiff_options){.width = 4, .height = 3, .scale = scale_10, .ties = nowhere}, NULL);
    check_transform(&(make_tiff_options){.width = 4, .height = 3, .ties = line, .tie_count = 3}, NULL);
    tl_source *source = open_band(0);
    assert_true(source->info.georef.cell_x == 1 && source->info.georef.cell_y == 1);
    assert_null(source->info.georef.crs);
    tl_source_destroy(source);
}

/* ---- Threads and range ---- */

typedef struct reader {
    const tl_source *source;
    uint32_t seed;
    bool same;
} reader;

static void *read_randomly(void *argument)
{
    reader *self = argument;
    float *heights = malloc(sizeof *heights * 100 * 100);
    self->same = true;
    for (int k = 0; k < 200; k++) {
        tl_window window = {random_number(&self->seed) % 500, random_number(&self->seed) % 400, 100, 100};
        self->same &= tl_source_read(self->source, 0, window, heights, NULL) == TL_OK;
        for (uint32_t i = 0; i < 100 * 100 && self->same; i++)
            self->same = heights[i] == (float)make_tiff_value(0, (uint32_t)window.x + i % 100,
                                                              (uint32_t)window.y + i / 100, 32, SAMPLEFORMAT_IEEEFP);
    }
    free(heights);
    return NULL;
}

static void threadsReadTheSame(void **state)
{
    (void)state;
    for (int tiled = 0; tiled < 2; tiled++) {
        tl_source *source = make_and_open(&(make_tiff_options){.width = 600,
                                                               .height = 500,
                                                               .codec = COMPRESSION_LZW,
                                                               .predictor = 3,
                                                               .block_width = tiled ? 64 : 0,
                                                               .block_height = tiled ? 64 : 0});
        pthread_t threads[6];
        reader readers[6];
        for (uint32_t k = 0; k < 6; k++) {
            readers[k] = (reader){.source = source, .seed = 1000 + k};
            assert_int_equal(pthread_create(&threads[k], NULL, read_randomly, &readers[k]), 0);
        }
        for (int k = 0; k < 6; k++) {
            pthread_join(threads[k], NULL);
            assert_true(readers[k].same);
        }
        tl_source_destroy(source);
    }
}

static void rangeIsExactAndTheSameForAnyThreads(void **state)
{
    (void)state;
    tl_source *source = make_and_open(&(make_tiff_options){.width = 1000, .height = 999, .nodata = "0"});
    float low = INFINITY, high = -INFINITY;
    uint64_t voids = 0;
    long double sum = 0;
    for (uint32_t y = 0; y < 999; y++)
        for (uint32_t x = 0; x < 1000; x++) {
            float value = (float)make_tiff_value(0, x, y, 32, SAMPLEFORMAT_IEEEFP);
            voids += value == 0;
            low = value < low ? value : low;
            high = value > high ? value : high;
            sum += (long double)value;
        }
    double first = 0;
    for (unsigned threads = 1; threads < 5; threads++) {
        tl_range range;
        assert_int_equal(tl_source_range(source, &(tl_run){.threads = threads}, &range, NULL), TL_OK);
        assert_true(range.low == low && range.high == high && range.voids == voids && range.samples == 999000);
        /* heights are multiples of 1/64 below 2^17 and there are fewer than 2^20: every partial sum fits a double */
        assert_true(range.mean == (double)sum / (double)(999000 - voids));
        first = threads == 1 ? range.mean : first;
        assert_true(range.mean == first);
    }
    tl_source_destroy(source);
    memset(special, 0, sizeof special);
    source =
        make_and_open(&(make_tiff_options){.width = 3, .height = 2, .bits = 16, .nodata = "0", .value = special_value});
    tl_range range;
    assert_int_equal(tl_source_range(source, NULL, &range, NULL), TL_OK);
    assert_true(isnan(range.low) && isnan(range.high) && isnan(range.mean) && range.voids == 6);
    tl_source_destroy(source);
}

/* ---- Refusals ---- */

static void write_file(const char *content, size_t bytes)
{
    FILE *file = fopen(path, "wb");
    assert_non_null(file);
    assert_int_equal(fwrite(content, 1, bytes, file), bytes);
    fclose(file);
}

static void expect_refusal(const char *name, unsigned band, tl_status status, const char *part)
{
    tl_error error = {0};
    tl_source *source = tl_dem_open(&name, 1, &(tl_dem_options){.band = band}, &error);
    assert_null(source);
    assert_int_equal(error.status, status);
    if (strncmp(error.text, name, strlen(name)) != 0 || !strstr(error.text, part) || strchr(error.text, '\n'))
        fail_msg("\"%s\" does not say: %s", error.text, part);
}

static void refusalsSayWhy(void **state)
{
    (void)state;
    char missing[112];
    snprintf(missing, sizeof missing, "%s-missing", path);
    expect_refusal(missing, 0, TL_ERROR_IO, "cannot read");
    snprintf(missing, sizeof missing, "%s/empty", folder);
    assert_int_equal(mkdir(missing, 0700), 0);
    expect_refusal(missing, 0, TL_ERROR_DATA, "in this directory");
    rmdir(missing);
    expect_refusal("/dev/null", 0, TL_ERROR_DATA, "regular file");
    write_file("", 0);
    expect_refusal(path, 0, TL_ERROR_DATA, "empty");
    write_file("II", 2);
    expect_refusal(path, 0, TL_ERROR_DATA, "not a TIFF file");
    write_file("\x89PNG\r\n\x1a\n", 8);
    expect_refusal(path, 0, TL_ERROR_DATA, "not a TIFF file");
    write_file("II*\0\xff\xff\xff\x7f", 8);
    expect_refusal(path, 0, TL_ERROR_DATA, "TIFF directory");
    assert_true(make_tiff(path, &(make_tiff_options){.width = 2, .height = 2, .bands = 2}));
    expect_refusal(path, 3, TL_ERROR_ARGUMENT, "no band 3; it has 2");
    assert_true(make_tiff(
        path, &(make_tiff_options){.width = 2, .height = 2, .bits = 64, .format = SAMPLEFORMAT_COMPLEXIEEEFP}));
    expect_refusal(path, 0, TL_ERROR_DATA, "complex");
    assert_true(make_tiff(
        path, &(make_tiff_options){.width = 2, .height = 2, .bands = 3, .bits = 8, .photometric = PHOTOMETRIC_RGB}));
    expect_refusal(path, 0, TL_ERROR_DATA, "name the band");
    tl_source *source = open_band(3);
    assert_true(one_height(source, 1, 1) == (float)make_tiff_value(2, 1, 1, 8, SAMPLEFORMAT_UINT));
    tl_source_destroy(source);
}

/* Opens and reads everything; whatever happens, it is the right heights or one line. True: heights. */
static bool survives(const make_tiff_options *must_equal)
{
    tl_error error = {0};
    tl_source *source = tl_dem_open((const char *const[]){path}, 1, &(tl_dem_options){.band = 1}, &error);
    tl_status status = source ? TL_OK : error.status;
    if (source && source->info.width * source->info.height <= 1 << 20) {
        size_t count = (size_t)(source->info.width * source->info.height);
        float *heights = malloc(count * sizeof *heights);
        status = tl_source_read(source, 0, (tl_window){0, 0, source->info.width, source->info.height}, heights, &error);
        for (uint32_t k = 0; must_equal && status == TL_OK && k < count; k++)
            assert_true(heights[k] == (float)make_tiff_value(0, k % must_equal->width, k / must_equal->width,
                                                             must_equal->bits, must_equal->format));
        free(heights);
    }
    tl_source_destroy(source);
    if (status != TL_OK) {
        assert_true(strncmp(error.text, path, strlen(path)) == 0);
        assert_null(strchr(error.text, '\n'));
    }
    return status == TL_OK;
}

static size_t load(char **content)
{
    FILE *file = fopen(path, "rb");
    assert_non_null(file);
    fseek(file, 0, SEEK_END);
    size_t bytes = (size_t)ftell(file);
    rewind(file);
    *content = malloc(bytes);
    assert_int_equal(fread(*content, 1, bytes, file), bytes);
    fclose(file);
    return bytes;
}

static const make_tiff_options victims[] = {
    {.width = 50,
     .height = 40,
     .bits = 16,
     .format = SAMPLEFORMAT_INT,
     .codec = COMPRESSION_ADOBE_DEFLATE,
     .predictor = 2,
     .block_width = 16,
     .block_height = 16,
     .directory_first = true},
    {.width = 50,
     .height = 40,
     .bits = 32,
     .format = SAMPLEFORMAT_IEEEFP,
     .codec = COMPRESSION_LZW,
     .predictor = 3,
     .block_height = 3,
     .big_endian = true,
     .big_tiff = true,
     .directory_first = true},
    {.width = 50,
     .height = 40,
     .bits = 32,
     .format = SAMPLEFORMAT_IEEEFP,
     .block_height = 11,
     .directory_first = true,
     .scale = scale_10,
     .ties = tie_corner,
     .keys = point_key,
     .key_count = 1,
     .nodata = "-9999",
     .metadata = "<Item "},
    {.width = 50, .height = 40, .bits = 12, .format = SAMPLEFORMAT_UINT, .codec = COMPRESSION_PACKBITS, .bands = 2},
    {.width = 50, .height = 40, .bits = 32, .format = SAMPLEFORMAT_IEEEFP, .codec = COMPRESSION_LERC},
};

static void truncatedFilesAreErrorsOrRight(void **state)
{
    (void)state;
    for (size_t k = 0; k < sizeof victims / sizeof *victims; k++) {
        char *content;
        assert_true(make_tiff(path, &victims[k]));
        size_t bytes = load(&content);
        assert_true(survives(&victims[k]));
        unsigned refused = 0, cuts = 0;
        for (size_t length = 0; length < bytes; length += 37, cuts++) {
            write_file(content, length);
            refused += !survives(&victims[k]);
        }
        /* nothing but the last bytes, which only pad, can be missing unnoticed */
        assert_true(refused + 1 >= cuts);
        free(content);
    }
}

static void flippedBitsNeverDoHarm(void **state)
{
    (void)state;
    for (size_t k = 0; k < sizeof victims / sizeof *victims; k++) {
        char *content;
        assert_true(make_tiff(path, &victims[k]));
        size_t bytes = load(&content);
        for (uint32_t seed = 1; seed <= 300; seed++) {
            uint32_t random = seed * 2654435761u;
            char *damaged = malloc(bytes);
            memcpy(damaged, content, bytes);
            /* half of them in the first bytes, where the directory is */
            size_t reach = seed % 2 && bytes > 400 ? 400 : bytes;
            for (unsigned flips = 1 + seed % 4; flips; flips--) {
                uint32_t bit = random_number(&random) % (uint32_t)(8 * reach);
                damaged[bit / 8] ^= (char)(1 << bit % 8);
            }
            write_file(damaged, bytes);
            survives(NULL);
            free(damaged);
        }
        free(content);
    }
}

/* ---- Real files, where they are ---- */

static void realFileHasItsKnownRange(void **state)
{
    (void)state;
    const char *shared = getenv("TALUS_SHARED"), *root = getenv("TALUS_SOURCE_ROOT");
    char name[1024];
    if (shared)
        snprintf(name, sizeof name, "%s/dem/nfong_S33W071.tif", shared);
    else
        snprintf(name, sizeof name, "%s/../shared/data/dem/nfong_S33W071.tif", root ? root : ".");
    if (access(name, R_OK) != 0)
        skip();
    tl_source *source = tl_dem_open((const char *const[]){name}, 1, NULL, NULL);
    assert_non_null(source);
    tl_range range;
    assert_int_equal(tl_source_range(source, NULL, &range, NULL), TL_OK);
    assert_true(range.low == 250 && range.high == 6929 && range.voids == 0);
    assert_int_equal(tl_crs_epsg(source->info.georef.crs), 4326);
    assert_true(source->info.georef.transform[0] == -71 && source->info.georef.transform[3] == -32);
    tl_source_destroy(source);
}

static int make_folder(void **state)
{
    (void)state;
    const char *place = getenv("TMPDIR");
    snprintf(folder, sizeof folder, "%.40s/talus-XXXXXX", place ? place : "/tmp");
    if (!mkdtemp(folder))
        return -1;
    snprintf(path, sizeof path, "%s/dem.tif", folder);
    return 0;
}

static int remove_folder(void **state)
{
    (void)state;
    unlink(path);
    return rmdir(folder);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(readsEveryTypeCodecAndLayout),
        cmocka_unit_test(readsPackedBits),
        cmocka_unit_test(readsHalfFloats),
        cmocka_unit_test(tellsWhatTheFileIs),
        cmocka_unit_test(nodataBecomesVoid),
        cmocka_unit_test(nodataOutsideOfTheTypeNeverMatches),
        cmocka_unit_test(floatsThatAreNoHeightsAreVoid),
        cmocka_unit_test(scaleAndOffsetApplyToTheBand),
        cmocka_unit_test(scaledHeightsBeyondFloatAreVoid),
        cmocka_unit_test(numbersDoNotDependOnTheLocale),
        cmocka_unit_test(blocksLeftOutAreNodataOrZero),
        cmocka_unit_test(readsSingleSamplesRowsAndColumns),
        cmocka_unit_test(readsAStripThatIsTooLargeToKeep),
        cmocka_unit_test(areaSamplesLieHalfACellFromTheCorner),
        cmocka_unit_test(matrixAndTiePointsGiveTheTransform),
        cmocka_unit_test(positionsThatMakeNoSenseAreNone),
        cmocka_unit_test(threadsReadTheSame),
        cmocka_unit_test(rangeIsExactAndTheSameForAnyThreads),
        cmocka_unit_test(refusalsSayWhy),
        cmocka_unit_test(truncatedFilesAreErrorsOrRight),
        cmocka_unit_test(flippedBitsNeverDoHarm),
        cmocka_unit_test(realFileHasItsKnownRange),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
