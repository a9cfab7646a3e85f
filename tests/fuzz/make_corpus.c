/* The seeds of the fuzz targets: make_corpus FOLDER GOLDEN writes a folder for each target into FOLDER. Command lines
 * are those of the golden tests, GOLDEN/NAME.args. */
#include "fuzz.h"
#include "lib/out/tile_pieces.h"
#include "lib/talus.h"
#include "tests/make_tiff.h"

#include <dirent.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <tiffio.h>

enum { PATH_BYTES = 4096, MOST_SAMPLES = 1024 };

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

/* The same heights without a CRS, whose text would be most of a small file, and most of the time to read it. */
static tl_source *without_crs(const tl_source *from, float heights[MOST_SAMPLES])
{
    tl_source_info info = from->info;
    info.georef.crs = NULL;
    info.parameters = NULL;
    info.parameter_count = 0;
    fuzz_expect(info.width * info.height <= MOST_SAMPLES);
    tl_status status = tl_source_read(from, 0, (tl_window){0, 0, info.width, info.height}, heights, NULL);
    return status == TL_OK ? tl_array_source_create(heights, &info, NULL) : NULL;
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
        float heights[MOST_SAMPLES];
        tl_source *plain = source ? without_crs(source, heights) : NULL;
        for (size_t k = 0; plain && k < sizeof kinds / sizeof *kinds; k++)
            add_exr(c, k ? plain : source, kinds[k]);
        tl_source_destroy(plain);
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

/* ---- What the other targets read: a byte that chooses the reader, and a file ---- */

typedef struct seeds {
    const corpus *corpus;
    const char *kind; /* the target's */
    unsigned count;
} seeds;

static void add_seed(seeds *s, int choice, const void *bytes, size_t size)
{
    char path[PATH_BYTES];
    snprintf(path, sizeof path, "%s/%s/%04u", s->corpus->folder, s->kind, s->count++);
    FILE *file = fopen(path, "wb");
    fuzz_expect(file && (choice < 0 || fputc(choice, file) == choice) && fwrite(bytes, 1, size, file) == size);
    fclose(file);
}

static void add_text(seeds *s, int choice, const char *text)
{
    add_seed(s, choice, text, strlen(text));
}

/* Bytes of a file, in memory that the next call uses again. */
static const uint8_t *load(const char *path, size_t *size)
{
    static uint8_t bytes[1 << 17];
    FILE *file = fopen(path, "rb");
    fuzz_expect(file != NULL);
    *size = fread(bytes, 1, sizeof bytes, file);
    fclose(file);
    fuzz_expect(*size < sizeof bytes);
    return bytes;
}

static void add_file(seeds *s, int choice, const char *path, size_t skipped)
{
    size_t size;
    const uint8_t *bytes = load(path, &size);
    fuzz_expect(size >= skipped);
    add_seed(s, choice, bytes + skipped, size - skipped);
}

static void name_in_folder(const char *name, char path[PATH_BYTES])
{
    snprintf(path, PATH_BYTES, "%s/%s", fuzz_folder(), name);
}

static const tl_run alone = {.threads = 1};

/* ---- Views and rules ---- */

static void add_views(const corpus *c)
{
    static const char *const views[] = {
        "{\"eye\": [11.3, 46.7, 300], \"above_ground\": true, \"heading\": 120, \"pitch\": -5, \"roll\": 1, \"fov\": "
        "60, "
        "\"width\": 640, \"height\": 480, \"refraction\": 0.13, \"flat\": false}",
        "{\"projected\": true, \"views\": [{\"time\": 0, \"eye\": [0, 0, 9]}, {\"time\": 1.5, \"eye\": [1, 2, 9], "
        "\"target\": [5, 5, 0]}, {\"time\": 3, \"eye\": [4, 4, 1e3], \"target_above_ground\": true}]}",
        "[{\"eye\": [0, 0, 9]}, {\"eye\": [170, 89, 9]}, {\"eye\": [-170, 89, 9]}]",
        "{\"asset\": {\"version\": \"2.0\", \"extras\": {\"origin\": {\"longitude\": 11, \"latitude\": 46, \"height\": "
        "100}, "
        "\"crs_wkt\": \"GEOGCS[\\\"W\\\",DATUM[\\\"W\\\",SPHEROID[\\\"W\\\",6378137,298.257]],PRIMEM[\\\"G\\\",0],"
        "UNIT[\\\"degree\\\",0.0174532925199433]]\"}}, \"scene\": 0, \"scenes\": [{\"nodes\": [0]}], \"nodes\": "
        "[{\"rotation\": "
        "[0, 0.7, 0, 0.7], \"children\": [1, 2]}, {\"camera\": 0, \"translation\": [5, 100, -5]}, {\"camera\": 0, "
        "\"matrix\": [1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 7, 8, 9, 1]}], \"cameras\": [{\"type\": \"perspective\", "
        "\"perspective\": {\"yfov\": 0.8, \"aspectRatio\": 1.5, \"znear\": 1}}]}"};
    static const char *const rules[] = {
        "{\"rock\": {\"slope\": [35, 45], \"weight\": 2}, \"scree\": {\"slope\": [25, 30, 38, 45]}, \"soil\": {}, "
        "\"snow\": {\"height\": [1800, 2200], \"curvature\": [null, null, 0, 0.01], \"sigma\": [0, 1, 2, null]}}",
        "{\"soil\": {\"weight\": 1e300}, \"rock\": {\"weight\": 0}}"};
    seeds s = {.corpus = c, .kind = "views"};
    for (size_t k = 0; k < sizeof views / sizeof *views; k++)
        add_text(&s, 0, views[k]);
    for (size_t k = 0; k < sizeof rules / sizeof *rules; k++)
        add_text(&s, 1, rules[k]);
    /* the last as a GLB */
    uint8_t glb[2048] = "glTF\2\0\0";
    size_t length = strlen(views[3]);
    fuzz_expect(length + 20 <= sizeof glb);
    glb[8] = (uint8_t)(length + 20), glb[9] = (uint8_t)((length + 20) >> 8);
    glb[12] = (uint8_t)length, glb[13] = (uint8_t)(length >> 8);
    memcpy(glb + 16, "JSON", 4);
    memcpy(glb + 20, views[3], length);
    add_seed(&s, 0, glb, length + 20);
}

/* ---- Meshes, points and tiles ---- */

/* A source that lies somewhere: where the cells of tiles are as wide as its own. */
static tl_source *placed_model(void)
{
    enum { ROW = 12 };
    static tl_crs *crs; /* of all of them; kept */
    static float heights[ROW * ROW];
    tl_source_info info = {.width = ROW, .height = ROW, .type = TL_RASTER_POINT, .name = "placed"};
    for (int k = 0; k < ROW * ROW; k++)
        heights[k] = 100 + 10 * sinf((float)(k % ROW)) + (float)(k / ROW);
    const double transform[6] = {1, 5, 0, 60, 0, -5};
    memcpy(info.georef.transform, transform, sizeof transform);
    info.georef.height_unit = 1;
    info.georef.located = true;
    info.georef.crs = crs = crs ? crs : tl_crs_create("EPSG:4326", NULL);
    fuzz_expect(info.georef.crs && tl_georef_measure(&info.georef, ROW, ROW, NULL) == TL_OK);
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    fuzz_expect(source != NULL);
    return source;
}

static void add_meshes(const corpus *c)
{
    static const struct {
        const char *name;
        int choice;
        tl_mesh_coding coding;
        tl_frame frame;
    } files[] = {{"m.glb", 0, TL_CODING_PLAIN, TL_FRAME_PIXEL},      {"m.glb", 0, TL_CODING_QUANTIZED, TL_FRAME_PIXEL},
                 {"m.glb", 0, TL_CODING_COMPRESSED, TL_FRAME_PIXEL}, {"m.obj", 1, TL_CODING_PLAIN, TL_FRAME_PIXEL},
                 {"m.ply", 2, TL_CODING_PLAIN, TL_FRAME_PIXEL},      {"m.ply", 2, TL_CODING_PLAIN, TL_FRAME_PROJECTED},
                 {"m.stl", 3, TL_CODING_PLAIN, TL_FRAME_PIXEL},      {"m.stl", 3, TL_CODING_PLAIN, TL_FRAME_PROJECTED}};
    seeds s = {.corpus = c, .kind = "meshes"};
    char path[PATH_BYTES];
    tl_mesh *mesh = NULL;
    fuzz_expect(tl_mesh_from_source(fuzz_model(), &alone, &mesh, NULL) == TL_OK);
    for (size_t k = 0; k < sizeof files / sizeof *files; k++) {
        const tl_write_options options = {
            .overwrite = true, .coding = files[k].coding, .frame = files[k].frame, .run = &alone};
        name_in_folder(files[k].name, path);
        fuzz_expect(tl_write_mesh(mesh, path, &options, NULL) == TL_OK);
        add_file(&s, files[k].choice, path, 0);
    }
    tl_mesh_destroy(mesh);
    const tl_framework_options options = {.max_error = 5, .run = &alone};
    tl_framework *framework = tl_framework_build(fuzz_model(), &options, NULL);
    for (int k = 0; k < 2; k++) {
        const tl_points_options points = {.overwrite = true, .frame = TL_FRAME_PIXEL, .run = &alone};
        name_in_folder(k ? "m.geojson" : "m.csv", path);
        fuzz_expect(framework && tl_framework_save(framework, fuzz_model(), path, &points, NULL) == TL_OK);
        add_file(&s, 4 + k, path, 0);
    }
    tl_framework_destroy(framework);
    name_in_folder("quantized/0/1/0.terrain", path);
    add_file(&s, 6, path, 0);
}

/* ---- Heights, frameworks ---- */

static void add_heights(const corpus *c)
{
    static const char *const files[] = {"h.png", "h.r16", "h.raw"};
    static const char *const beside[] = {"h.json", "h.r16.json", "h.raw.json"};
    static const uint8_t hgt[] = {0, 1, 0, 2, 128, 0, 255, 255};
    seeds s = {.corpus = c, .kind = "heights"};
    char path[PATH_BYTES];
    tl_source *placed = placed_model();
    for (int k = 0; k < 6; k++) {
        const tl_write_options options = {.overwrite = true, .run = &alone};
        static uint8_t both[1 << 16];
        size_t json, heights;
        name_in_folder(files[k % 3], path);
        fuzz_expect(tl_write_grid(k < 3 ? fuzz_model() : placed, path, &options, NULL) == TL_OK);
        name_in_folder(beside[k % 3], path);
        const uint8_t *bytes = load(path, &json);
        fuzz_expect(json < sizeof both / 2);
        both[0] = (uint8_t)json, both[1] = (uint8_t)(json >> 8);
        memcpy(both + 2, bytes, json);
        name_in_folder(files[k % 3], path);
        bytes = load(path, &heights);
        fuzz_expect(json + 2 + heights <= sizeof both);
        memcpy(both + 2 + json, bytes, heights);
        add_seed(&s, k % 3, both, json + 2 + heights);
    }
    tl_source_destroy(placed);
    add_seed(&s, 3, hgt, sizeof hgt);
    add_text(&s, 4, "# names; with ';' for the dot\nN10E010;hgt\nN10E011;hgt\n");
    add_text(&s, 4, "N1*;hgt\n  S01W00[0-9];hgt\r\n");
}

static void add_frameworks(const corpus *c)
{
    seeds s = {.corpus = c, .kind = "frameworks"};
    char path[PATH_BYTES];
    name_in_folder("f.tif", path);
    for (int k = 0; k < 3; k++) {
        const tl_framework_options options = {.max_error = 5.0 * k, .run = &alone};
        const tl_points_options points = {.overwrite = true, .run = &alone};
        tl_framework *framework = tl_framework_build(fuzz_model(), &options, NULL);
        fuzz_expect(framework && tl_framework_save(framework, fuzz_model(), path, &points, NULL) == TL_OK);
        tl_framework_destroy(framework);
        add_file(&s, -1, path, 0);
    }
    for (int k = 0; k < 2; k++) {
        const tl_pyramid_options options = {.exact = k, .run = &alone};
        const tl_write_options writing = {.overwrite = true, .run = &alone};
        tl_pyramid *pyramid = tl_pyramid_create(fuzz_model(), &options, NULL);
        fuzz_expect(pyramid && tl_pyramid_save(pyramid, path, &writing, NULL) == TL_OK);
        tl_pyramid_destroy(pyramid);
        add_file(&s, -1, path, 0);
    }
}

/* ---- What tiles leave ---- */

static void make_tiles(tl_tiles_format format, const char *name)
{
    char path[PATH_BYTES];
    const tl_tiles_options options = {.format = format, .run = &alone};
    tl_tiles_report report;
    tl_source *placed = placed_model();
    name_in_folder(name, path);
    fuzz_expect(tl_write_terrain_tiles(placed, path, &options, &report, NULL) == TL_OK);
    tl_source_destroy(placed);
}

static void add_piece(seeds *s, bool heights)
{
    enum { CHECKED = 8 }; /* bytes before those that the checksum is of */
    static float z[OUT_PIECE_ROW * OUT_PIECE_ROW], lost[OUT_PIECE * OUT_PIECE];
    out_piece_tile tiles[2] = {{.level = 3, .column = 1, .bytes = 100, .triangles = 2, .error = 1},
                               {.level = 2, .row = 1, .region = {-1, -1, 1, 1, 0, 9}}};
    const out_piece piece = {.level = 3,
                             .column = 2,
                             .row = 1,
                             .resampling = 0.5,
                             .tile_count = 2,
                             .tiles = tiles,
                             .z = heights ? z : NULL,
                             .lost = heights ? lost : NULL};
    char path[PATH_BYTES];
    name_in_folder(".talus", path);
    mkdir(path, 0700);
    name_in_folder(".talus/3_2_1.piece", path);
    fuzz_expect(out_piece_save(&piece, fuzz_folder(), NULL) == TL_OK);
    add_file(s, 1, path, CHECKED);
}

static void add_records(const corpus *c)
{
    static const char *const indices[] = {"quantized/layer.json", "spatial/tileset.json", "grids/index.json", "p.json"};
    seeds s = {.corpus = c, .kind = "records"};
    char path[PATH_BYTES];
    const tl_grid_tiles_options grids = {.tile = 3, .run = &alone};
    const tl_preset_options preset = {.preset = "unity", .overwrite = true, .run = &alone};
    const tl_noise_options noise = {.size = 40, .hurst = 0.7, .delta = 1};
    tl_grid_tiles_report report;
    tl_preset_report made;
    name_in_folder("grids", path);
    fuzz_expect(tl_write_grid_tiles(fuzz_model(), path, &grids, &report, NULL) == TL_OK);
    name_in_folder("p.r16", path);
    tl_source *wide = tl_noise_create(&noise, NULL);
    fuzz_expect(wide && tl_write_preset(wide, path, &preset, &made, NULL) == TL_OK);
    tl_source_destroy(wide);
    for (size_t k = 0; k < sizeof indices / sizeof *indices; k++) {
        name_in_folder(indices[k], path);
        add_file(&s, k ? 0 : 2, path, 0); /* 2: packed, too */
    }
    add_piece(&s, false);
    add_piece(&s, true);
}

/* ---- Command lines ---- */

/* In the order of fuzz_options.c. */
static const char *const names[] = {"info", "simplify", "synth", "preview", "noise", "stats",
                                    "view", "fly",      "tiles", "serve",   "report"};

/* A word a line, without the quotes of a shell. */
static void add_line(seeds *s, const char *line, size_t size)
{
    char words[4096];
    size_t used = 0, name = strcspn(line, " \n");
    int choice = 0;
    const int count = sizeof names / sizeof *names;
    while (choice < count && (strlen(names[choice]) != name || memcmp(names[choice], line, name) != 0))
        choice++;
    for (size_t k = name + 1; k < size && used < sizeof words; k++)
        if (line[k] != '\'' && line[k] != '"' && (line[k] != '\n' || k + 1 < size))
            words[used++] = line[k] == ' ' ? '\n' : line[k];
    if (choice < count)
        add_seed(s, choice, words, used);
}

static void add_options(const corpus *c, const char *golden)
{
    seeds s = {.corpus = c, .kind = "options"};
    DIR *folder = opendir(golden);
    fuzz_expect(folder != NULL);
    for (const struct dirent *entry; (entry = readdir(folder));) {
        char path[PATH_BYTES];
        const char *dot = strrchr(entry->d_name, '.');
        size_t size;
        if (!dot || strcmp(dot, ".args") != 0)
            continue;
        snprintf(path, sizeof path, "%s/%s", golden, entry->d_name);
        const uint8_t *bytes = load(path, &size);
        char line[4096] = "";
        if (size < sizeof line) {
            memcpy(line, bytes, size);
            add_line(&s, line, size);
        }
    }
    closedir(folder);
    fuzz_expect(s.count > 0);
}

int main(int argc, char **argv)
{
    if (argc != 3) {
        fprintf(stderr, "make_corpus FOLDER GOLDEN\n");
        return 2;
    }
    static corpus c;
    char path[PATH_BYTES];
    static const char *const parts[] = {"",         "/raster",     "/exr",     "/views",  "/meshes",
                                        "/heights", "/frameworks", "/records", "/options"};
    snprintf(c.folder, sizeof c.folder, "%s", argv[1]);
    for (size_t k = 0; k < sizeof parts / sizeof *parts; k++) {
        snprintf(path, sizeof path, "%s%s", c.folder, parts[k]);
        mkdir(path, 0777);
    }
    add_layouts(&c);
    add_oddities(&c);
    add_georeferences(&c);
    add_exrs(&c);
    add_large_exr(&c);
    make_tiles(TL_TILES_QUANTIZED_MESH, "quantized");
    make_tiles(TL_TILES_3D, "spatial");
    add_views(&c);
    add_meshes(&c);
    add_heights(&c);
    add_frameworks(&c);
    add_records(&c);
    add_options(&c, argv[2]);
    printf("%u TIFFs, %u EXRs and the seeds of the other targets in %s\n", c.tiffs, c.exrs, c.folder);
    return c.failed || !c.tiffs || !c.exrs;
}
