/* The seeds of the fuzz targets: make_corpus FOLDER writes small TIFFs into FOLDER/raster and EXRs into FOLDER/exr. */
#include "lib/talus.h"
#include "tests/make_tiff.h"

#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <tiffio.h>

enum { PATH_BYTES = 4096 };

typedef struct corpus {
    char folder[PATH_BYTES - 256];
    unsigned tiffs, exrs;
    bool failed;
} corpus;

static void name_file(const corpus *c, const char *kind, unsigned number, char *path)
{
    snprintf(path, PATH_BYTES, "%s/%s/%04u.%s", c->folder, kind, number, kind[0] == 'e' ? "exr" : "tif");
}

/* Combinations that libtiff refuses are left out. */
static void add_tiff(corpus *c, const make_tiff_options *options)
{
    char path[PATH_BYTES];
    name_file(c, "raster", c->tiffs, path);
    if (make_tiff(path, options))
        c->tiffs++;
    else
        remove(path);
}

/* ---- Layouts ---- */

static const struct {
    uint16_t bits, format;
} types[] = {{1, SAMPLEFORMAT_UINT},    {4, SAMPLEFORMAT_UINT},    {12, SAMPLEFORMAT_INT},   {8, SAMPLEFORMAT_UINT},
             {8, SAMPLEFORMAT_INT},     {16, SAMPLEFORMAT_UINT},   {16, SAMPLEFORMAT_INT},   {24, SAMPLEFORMAT_UINT},
             {32, SAMPLEFORMAT_UINT},   {32, SAMPLEFORMAT_INT},    {64, SAMPLEFORMAT_UINT},  {64, SAMPLEFORMAT_INT},
             {16, SAMPLEFORMAT_IEEEFP}, {32, SAMPLEFORMAT_IEEEFP}, {64, SAMPLEFORMAT_IEEEFP}};
static const uint16_t codecs[] = {COMPRESSION_NONE, COMPRESSION_LZW,  COMPRESSION_ADOBE_DEFLATE, COMPRESSION_PACKBITS,
                                  COMPRESSION_ZSTD, COMPRESSION_LERC, COMPRESSION_LZMA};

static bool has_predictors(uint16_t codec)
{
    return codec == COMPRESSION_LZW || codec == COMPRESSION_ADOBE_DEFLATE || codec == COMPRESSION_ZSTD ||
           codec == COMPRESSION_LZMA;
}

/* Byte orders, both sizes of offsets, the planes together and apart. */
static void add_variants(corpus *c, make_tiff_options o)
{
    for (unsigned k = 0; k < 8; k++) {
        o.big_endian = k & 1;
        o.big_tiff = k & 2;
        o.separate = k & 4;
        o.bands = k & 4 ? 2 : 1;
        add_tiff(c, &o);
    }
}

static void add_layouts(corpus *c)
{
    static const struct {
        uint32_t width, height, block_width, block_height;
    } shapes[] = {{9, 7, 0, 0}, {9, 7, 0, 2}, {19, 17, 16, 16}};
    for (size_t t = 0; t < sizeof types / sizeof *types; t++)
        for (size_t k = 0; k < sizeof codecs / sizeof *codecs; k++)
            for (size_t s = 0; s < sizeof shapes / sizeof *shapes; s++)
                for (uint16_t predictor = 1; predictor <= (has_predictors(codecs[k]) ? 3 : 1); predictor++)
                    add_variants(c, (make_tiff_options){.width = shapes[s].width,
                                                        .height = shapes[s].height,
                                                        .block_width = shapes[s].block_width,
                                                        .block_height = shapes[s].block_height,
                                                        .bits = types[t].bits,
                                                        .format = types[t].format,
                                                        .codec = codecs[k],
                                                        .predictor = predictor > 1 ? predictor : 0});
}

static void add_oddities(corpus *c)
{
    add_tiff(c, &(make_tiff_options){.width = 33, .height = 33, .block_width = 16, .block_height = 16, .leave_out = 2});
    add_tiff(c, &(make_tiff_options){.width = 16, .height = 16, .overviews = 3});
    add_tiff(c, &(make_tiff_options){.width = 16, .height = 16, .directory_first = true});
    add_tiff(c, &(make_tiff_options){.width = 5, .height = 5, .bits = 16, .bands = 3});
    add_tiff(c, &(make_tiff_options){.width = 5, .height = 5, .nodata = "-3.40282e+38"});
    add_tiff(c, &(make_tiff_options){.width = 5,
                                     .height = 5,
                                     .bits = 16,
                                     .nodata = "0",
                                     .metadata = "<GDALMetadata><Item name=\"SCALE\" sample=\"0\" "
                                                 "role=\"scale\">0.1</Item><Item name=\"OFFSET\" sample=\"0\" "
                                                 "role=\"offset\">-100</Item></GDALMetadata>"});
}

/* ---- Georeferences ---- */

typedef struct keyed {
    const uint16_t *keys;
    unsigned key_count;
    const double *doubles;
    unsigned double_count;
    const char *ascii;
    double step;
} keyed;

static const uint16_t geographic[] = {1024, 0, 1, 2, 1025, 0, 1, 1, 2048, 0, 1, 4326};
static const uint16_t utm[] = {1024, 0, 1, 1, 1025, 0, 1, 2, 3072, 0, 1, 32632, 4099, 0, 1, 9001};
static const uint16_t compound[] = {1024, 0,     1,    1, 1025, 0,    1,    1, 3072, 0,
                                    1,    27700, 4096, 0, 1,    5701, 4099, 0, 1,    9002};
static const uint16_t body[] = {1024, 0,     1, 2,     1025, 0,     1, 1,     2048, 0,     1, 32767,
                                2049, 34737, 5, 0,     2050, 0,     1, 32767, 2054, 0,     1, 9102,
                                2056, 0,     1, 32767, 2057, 34736, 1, 0,     2058, 34736, 1, 1};
static const double body_doubles[] = {3396190, 3376200};
/* Lambert conformal conic in US survey feet, by parameters */
static const uint16_t conic[] = {1024, 0,     1, 1,     1025, 0,     1, 1, 2048, 0,     1, 4267, 3072, 0,     1, 32767,
                                 3074, 0,     1, 32767, 3075, 0,     1, 8, 3076, 0,     1, 9003, 3078, 34736, 1, 0,
                                 3079, 34736, 1, 1,     3084, 34736, 1, 2, 3085, 34736, 1, 3,    3086, 34736, 1, 4,
                                 3087, 34736, 1, 5,     3073, 34737, 9, 0};
static const double conic_doubles[] = {28.383333333333333, 30.283333333333333, -99, 27.833333333333332, 2000000, 0};
static const uint16_t transverse[] = {1024, 0,     1, 1,     1025, 0,     1, 2,     2048, 0,     1, 4326,
                                      3072, 0,     1, 32767, 3074, 0,     1, 32767, 3075, 0,     1, 1,
                                      3076, 0,     1, 9001,  3080, 34736, 1, 0,     3081, 34736, 1, 1,
                                      3092, 34736, 1, 2,     3082, 34736, 1, 3,     3083, 34736, 1, 4};
static const double transverse_doubles[] = {9, 0, 0.9996, 500000, 0};

/* libgeotiff prints these into a buffer that they overflow */
static const double endless_doubles[] = {1e300, -1e300, 1e300, 1e300, 1e300};

static const keyed references[] = {
    {geographic, 3, NULL, 0, NULL, 0.01},
    {utm, 4, NULL, 0, NULL, 30},
    {compound, 5, NULL, 0, NULL, 30},
    {body, 9, body_doubles, 2, "Mars|", 0.01},
    {conic, 14, conic_doubles, 6, "Texas SC|", 100},
    {transverse, 12, transverse_doubles, 5, NULL, 30},
    {transverse, 12, endless_doubles, 5, NULL, 30},
    {NULL, 0, NULL, 0, NULL, 1},
};

static void add_georeferences(corpus *c)
{
    for (size_t k = 0; k < sizeof references / sizeof *references; k++) {
        const keyed *r = &references[k];
        const double scale[3] = {r->step, r->step, 0}, tie[6] = {0, 0, 0, 9, 48, 0};
        const double matrix[16] = {r->step, r->step / 8, 0, 9, r->step / 8, -r->step, 0, 48, [15] = 1};
        make_tiff_options o = {.width = 6,
                               .height = 5,
                               .keys = r->keys,
                               .key_count = r->key_count,
                               .key_doubles = r->doubles,
                               .key_double_count = r->double_count,
                               .key_ascii = r->ascii,
                               .scale = scale,
                               .ties = tie};
        add_tiff(c, &o);
        o.scale = o.ties = NULL;
        o.matrix = matrix;
        add_tiff(c, &o);
    }
}

/* ---- EXRs: what talus makes of some of the TIFFs ---- */

static void add_exr(corpus *c, const tl_source *source, tl_compression compression)
{
    char path[PATH_BYTES];
    const tl_run run = {.threads = 1};
    tl_error error = {0};
    const tl_write_options options = {.overwrite = true, .compression = compression, .run = &run};
    name_file(c, "exr", c->exrs++, path);
    if (tl_write_grid(source, path, &options, &error) != TL_OK) {
        fprintf(stderr, "%s\n", error.text);
        c->failed = true;
    }
}

static void add_exrs(corpus *c)
{
    static const tl_compression kinds[] = {TL_COMPRESSION_NONE, TL_COMPRESSION_ZIP, TL_COMPRESSION_ZIPS,
                                           TL_COMPRESSION_PIZ};
    unsigned with_keys = 2 * sizeof references / sizeof *references;
    for (unsigned number = c->tiffs - with_keys; number < c->tiffs; number++) {
        char path[PATH_BYTES];
        name_file(c, "raster", number, path);
        const char *name = path;
        tl_source *source = tl_dem_open(&name, 1, NULL, NULL);
        for (size_t k = 0; source && k < sizeof kinds / sizeof *kinds; k++)
            add_exr(c, source, kinds[k]);
        tl_source_destroy(source);
    }
}

/* More than one tile. */
static void add_large_exr(corpus *c)
{
    for (int k = 0; k < 2; k++) {
        const tl_noise_options options = {.size = 270, .hurst = 0.7, .delta = 0, .seed = 1};
        tl_source *source = tl_noise_create(&options, NULL);
        if (source)
            add_exr(c, source, k ? TL_COMPRESSION_PIZ : TL_COMPRESSION_ZIP);
        else
            c->failed = true;
        tl_source_destroy(source);
    }
}

int main(int argc, char **argv)
{
    if (argc != 2) {
        fprintf(stderr, "make_corpus FOLDER\n");
        return 2;
    }
    static corpus c;
    char path[PATH_BYTES];
    static const char *const parts[] = {"", "/raster", "/exr"};
    snprintf(c.folder, sizeof c.folder, "%s", argv[1]);
    for (int k = 0; k < 3; k++) {
        snprintf(path, sizeof path, "%s%s", c.folder, parts[k]);
        mkdir(path, 0777);
    }
    add_layouts(&c);
    add_oddities(&c);
    add_georeferences(&c);
    add_exrs(&c);
    add_large_exr(&c);
    printf("%u TIFFs, %u EXRs in %s\n", c.tiffs, c.exrs, c.folder);
    return c.failed || !c.tiffs || !c.exrs;
}
