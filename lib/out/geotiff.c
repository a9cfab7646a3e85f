/* GeoTIFF: tiled, float32, or bytes of validity, with overviews on request. libtiff keeps the directories; tiles are
 * predicted and compressed in parallel, and handed to it in order. A cloud-optimised file is put in its order at last.
 */
#include "lib/base/error.h"
#include "lib/base/number.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/backlog.h"
#include "lib/out/cog.h"
#include "lib/out/geotiff_keys.h"
#include "lib/out/geotiff_pack.h"
#include "lib/out/mip.h"
#include "lib/out/out.h"

#include <libdeflate.h>
#include <tiffio.h>

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

enum {
    TILE_BYTES = OUT_TILE * OUT_TILE * (int)sizeof(float),
    GDAL_METADATA = 42112, /* GDAL's private tags */
    GDAL_NODATA = 42113,
};

/* Above this many bytes of tiles the file is a BigTIFF: a classic one ends at 2^32. */
static const double classic_limit = 4e9;

/* The first failure that libtiff told of. Its own words for a full disk are "Write error at scanline 4294967295", so
 * the system's reason, where there is one, goes before them: errno is set to 0 before each call that writes. */
typedef struct complaint {
    bool made;
    int code; /* errno-value, 0: none */
    char text[300];
} complaint;

static int no_message(TIFF *tiff, void *user, const char *module, const char *format, va_list list)
{
    (void)tiff;
    (void)module;
    complaint *said = user;
    if (said && !said->made) {
        said->made = true;
        said->code = errno;
        vsnprintf(said->text, sizeof said->text, format, list);
    }
    return 1;
}

static tl_status tiff_failed(const char *path, const complaint *said, tl_error *error)
{
    if (said->code)
        return tl_fail_system(error, path, "write", said->code);
    return tl_fail(error, TL_ERROR_IO, "%s: cannot write: %s", path, said->made ? said->text : "libtiff refused it");
}

/* ---- directory ---- */

static void define_gdal_tags(TIFF *tiff)
{
    static const TIFFFieldInfo fields[] = {
        {GDAL_METADATA, -1, -1, TIFF_ASCII, FIELD_CUSTOM, 1, 0, (char *)"GDALMetadata"},
        {GDAL_NODATA, -1, -1, TIFF_ASCII, FIELD_CUSTOM, 1, 0, (char *)"GDALNoDataValue"},
    };
    TIFFMergeFieldInfo(tiff, fields, 2);
}

/* Appends text with XML's special characters replaced: at most six bytes each. */
static char *append_escaped(char *to, const char *text)
{
    for (; *text; text++) {
        const char *entity = *text == '&'   ? "&amp;"
                             : *text == '<' ? "&lt;"
                             : *text == '>' ? "&gt;"
                             : *text == '"' ? "&quot;"
                                            : NULL;
        if (entity)
            to = stpcpy(to, entity);
        else
            *to++ = *text;
    }
    *to = '\0';
    return to;
}

enum { ITEM_ROOM = 128 }; /* bytes of an item beside its value, whose name is cut at 60 */

static char *append_item(char *to, const char *name, const char *value)
{
    to += snprintf(to, ITEM_ROOM, "  <Item name=\"talus_%.60s\">", name);
    return stpcpy(append_escaped(to, value), "</Item>\n");
}

static char *metadata_of(const tl_source_info *info, double lerc_error)
{
    size_t room = 3 * ITEM_ROOM + 6 * (info->contents ? strlen(info->contents) : 0);
    for (size_t i = 0; i < info->parameter_count; i++)
        room += ITEM_ROOM + 6 * strlen(info->parameters[i].value);
    char *text = malloc(room), *to = text, number[TL_NUMBER_TEXT];
    if (!text)
        return NULL;
    to = stpcpy(to, "<GDALMetadata>\n");
    for (size_t i = 0; i < info->parameter_count; i++)
        to = append_item(to, info->parameters[i].name, info->parameters[i].value);
    if (info->contents)
        to = append_item(to, "contents", info->contents);
    tl_number_text(lerc_error, number);
    if (lerc_error > 0)
        to = append_item(to, "lerc_error", number);
    stpcpy(to, "</GDALMetadata>\n");
    return text;
}

static bool set_metadata(TIFF *tiff, const tl_source_info *info, const out_packing *packing)
{
    char *text = metadata_of(info, packing->lerc_error);
    bool good = text && TIFFSetField(tiff, GDAL_METADATA, text) == 1;
    free(text);
    return good;
}

/* Tie point and scale, or the whole matrix where rows and columns are not along the axes. A PixelIsPoint file ties the
 * sample, a PixelIsArea one the corner of its cell. */
static bool set_transform(TIFF *tiff, const tl_source_info *info)
{
    const double *t = info->georef.transform;
    double margin = info->type == TL_RASTER_AREA ? 0.5 : 0;
    double x = t[0] - margin * (t[1] + t[2]), y = t[3] - margin * (t[4] + t[5]);
    if (t[2] == 0 && t[4] == 0 && t[1] > 0 && t[5] < 0) {
        double scale[3] = {t[1], -t[5], 0}, tie[6] = {0, 0, 0, x, y, 0};
        return TIFFSetField(tiff, OUT_TAG_PIXEL_SCALE, 3, scale) == 1 &&
               TIFFSetField(tiff, OUT_TAG_TIE_POINTS, 6, tie) == 1;
    }
    double matrix[16] = {t[1], t[2], 0, x, t[4], t[5], 0, y, 0, 0, 0, 0, 0, 0, 0, 1};
    return TIFFSetField(tiff, OUT_TAG_MATRIX, 16, matrix) == 1;
}

static bool set_samples(TIFF *tiff, const out_packing *packing)
{
    uint16_t other[OUT_BANDS] = {EXTRASAMPLE_UNSPECIFIED};
    bool good =
        TIFFSetField(tiff, TIFFTAG_BITSPERSAMPLE, packing->bytes ? 8 : 32) == 1 &&
        TIFFSetField(tiff, TIFFTAG_SAMPLEFORMAT, packing->bytes ? SAMPLEFORMAT_UINT : SAMPLEFORMAT_IEEEFP) == 1 &&
        TIFFSetField(tiff, TIFFTAG_SAMPLESPERPIXEL, (int)packing->bands) == 1 &&
        TIFFSetField(tiff, TIFFTAG_PLANARCONFIG, PLANARCONFIG_CONTIG) == 1;
    return good &&
           (packing->bands == 1 || TIFFSetField(tiff, TIFFTAG_EXTRASAMPLES, (int)packing->bands - 1, other) == 1);
}

static bool set_compression(TIFF *tiff, const out_packing *packing)
{
    bool good = TIFFSetField(tiff, TIFFTAG_COMPRESSION, out_packing_codec(packing)) == 1;
    if (good && packing->compression == TL_COMPRESSION_LERC)
        good = TIFFSetField(tiff, TIFFTAG_LERC_VERSION, LERC_VERSION_2_4) == 1 &&
               TIFFSetField(tiff, TIFFTAG_LERC_ADD_COMPRESSION, LERC_ADD_COMPRESSION_NONE) == 1;
    return good &&
           (!out_packing_predicts(packing) || TIFFSetField(tiff, TIFFTAG_PREDICTOR, PREDICTOR_FLOATINGPOINT) == 1);
}

/* Says in GDAL's words that an overview's samples are not means. */
static bool set_overview(TIFF *tiff, tl_mip kind)
{
    return TIFFSetField(tiff, TIFFTAG_SUBFILETYPE, FILETYPE_REDUCEDIMAGE) == 1 &&
           TIFFSetField(tiff, GDAL_METADATA,
                        kind == TL_MIP_BOX
                            ? "<GDALMetadata><Item name=\"RESAMPLING\" sample=\"0\">AVERAGE</Item></GDALMetadata>"
                            : "<GDALMetadata><Item name=\"RESAMPLING\" sample=\"0\">NEAREST</Item></GDALMetadata>") ==
               1;
}

/* The directory of a level, 0 the finest. */
static bool set_directory(TIFF *tiff, const tl_source_info *info, const out_packing *packing, const out_mip *mip,
                          int level)
{
    define_gdal_tags(tiff);
    bool good = TIFFSetField(tiff, TIFFTAG_IMAGEWIDTH, (uint32_t)mip->levels[level].width) == 1 &&
                TIFFSetField(tiff, TIFFTAG_IMAGELENGTH, (uint32_t)mip->levels[level].height) == 1 &&
                TIFFSetField(tiff, TIFFTAG_TILEWIDTH, OUT_TILE) == 1 &&
                TIFFSetField(tiff, TIFFTAG_TILELENGTH, OUT_TILE) == 1 && set_samples(tiff, packing) &&
                TIFFSetField(tiff, TIFFTAG_PHOTOMETRIC, PHOTOMETRIC_MINISBLACK) == 1 && set_compression(tiff, packing);
    if (good && info->has_voids && !packing->bytes)
        good = TIFFSetField(tiff, GDAL_NODATA, "nan") == 1;
    if (level)
        return good && set_overview(tiff, mip->kind);
    if (good && info->georef.located)
        good = set_transform(tiff, info);
    good = good && out_geokeys_write(tiff, info); /* also without a place: the raster type is a key */
    bool record = info->parameter_count > 0 || info->contents || packing->lerc_error > 0;
    return good && (!record || set_metadata(tiff, info, packing));
}

/* ---- tiles ---- */

/* Spreads the rows of a narrower window over a whole tile, the last column and row repeated: what compresses best. */
static void pad_tile(unsigned char *samples, size_t size, tl_window window)
{
    size_t width = (size_t)window.width * size, stride = OUT_TILE * size;
    for (int64_t row = window.height - 1; row >= 0; row--) {
        unsigned char *to = samples + (size_t)row * stride;
        memmove(to, samples + (size_t)row * width, width);
        for (size_t at = width; at < stride; at += size)
            memcpy(to + at, to + width - size, size);
    }
    for (int64_t row = window.height; row < OUT_TILE; row++)
        memcpy(samples + (size_t)row * stride, samples + (size_t)(window.height - 1) * stride, stride);
}

enum { MASK_BYTES = OUT_TILE * OUT_TILE / 8, MASK_LEVEL = 6 };

typedef struct worker {
    void *samples; /* floats, or bytes of validity */
    out_packer *packer;
    struct libdeflate_compressor *masks; /* NULL: none are wanted */
} worker;

/* A tile of a mask, compressed. */
typedef struct mask_tile {
    unsigned char *bytes;
    size_t count;
} mask_tile;

typedef struct writing {
    const tl_source *const *bands;
    out_packing packing; /* of several bands empty tiles are left out */
    TIFF *tiff;
    out_mip mip;
    int level;
    out_tiling tiling; /* of the level in hand */
    worker *workers;
    out_backlog backlog;
    bool masked;
    mask_tile
        *masks; /* of the level in hand, kept until its heights are written: a few dozen bytes where all is known */
    complaint said;
} writing;

static tl_status read_tile(const writing *w, worker *self, tl_window window, tl_error *error)
{
    int level = w->bands[0]->info.level;
    size_t size = w->packing.bytes ? 1 : sizeof(float);
    tl_status status = TL_OK;
    for (size_t k = 0; status == TL_OK && k < w->packing.bands; k++) {
        unsigned char *to = (unsigned char *)self->samples + k * TILE_BYTES;
        float *heights = (float *)(void *)to;
        status = w->level           ? out_mip_read(&w->mip, w->level, window, heights, error)
                 : w->packing.bytes ? tl_source_validity(w->bands[k], level, window, to, error)
                                    : tl_source_read(w->bands[k], level, window, heights, error);
        if (status == TL_OK)
            status = out_mip_add(&w->mip, w->level, window, heights, error);
        if (status == TL_OK)
            pad_tile(to, size, window);
    }
    return status;
}

static bool is_empty(const float *heights, size_t count)
{
    size_t at = 0;
    while (at < count && isnan(heights[at]))
        at++;
    return at == count;
}

/* One bit a sample, the first the highest: 1 where it is known. */
static tl_status pack_mask(const float *heights, worker *self, mask_tile *out, tl_error *error)
{
    unsigned char bits[MASK_BYTES] = {0};
    for (int i = 0; i < OUT_TILE * OUT_TILE; i++)
        bits[i / 8] |= (unsigned char)(!isnan(heights[i]) << (7 - i % 8));
    size_t room = libdeflate_zlib_compress_bound(self->masks, sizeof bits);
    out->bytes = malloc(room);
    if (!out->bytes)
        return tl_fail_memory(error, "the mask");
    out->count = libdeflate_zlib_compress(self->masks, bits, sizeof bits, out->bytes, room);
    unsigned char *fitted = realloc(out->bytes, out->count);
    out->bytes = fitted ? fitted : out->bytes;
    return TL_OK;
}

static bool set_mask_directory(TIFF *tiff, const out_mip *mip, int level)
{
    return TIFFSetField(tiff, TIFFTAG_SUBFILETYPE, FILETYPE_MASK | (level ? FILETYPE_REDUCEDIMAGE : 0)) == 1 &&
           TIFFSetField(tiff, TIFFTAG_IMAGEWIDTH, (uint32_t)mip->levels[level].width) == 1 &&
           TIFFSetField(tiff, TIFFTAG_IMAGELENGTH, (uint32_t)mip->levels[level].height) == 1 &&
           TIFFSetField(tiff, TIFFTAG_TILEWIDTH, OUT_TILE) == 1 &&
           TIFFSetField(tiff, TIFFTAG_TILELENGTH, OUT_TILE) == 1 && TIFFSetField(tiff, TIFFTAG_BITSPERSAMPLE, 1) == 1 &&
           TIFFSetField(tiff, TIFFTAG_SAMPLESPERPIXEL, 1) == 1 &&
           TIFFSetField(tiff, TIFFTAG_PLANARCONFIG, PLANARCONFIG_CONTIG) == 1 &&
           TIFFSetField(tiff, TIFFTAG_PHOTOMETRIC, PHOTOMETRIC_MASK) == 1 &&
           TIFFSetField(tiff, TIFFTAG_COMPRESSION, COMPRESSION_ADOBE_DEFLATE) == 1;
}

/* The mask of the level that was just written. */
static tl_status write_mask(writing *w, uint64_t tiles, tl_error *error)
{
    errno = 0;
    bool good = set_mask_directory(w->tiff, &w->mip, w->level);
    for (uint64_t k = 0; good && k < tiles; k++)
        good = TIFFWriteRawTile(w->tiff, (uint32_t)k, w->masks[k].bytes, (tmsize_t)w->masks[k].count) ==
               (tmsize_t)w->masks[k].count;
    if (good && TIFFWriteDirectory(w->tiff) && !w->said.made)
        return TL_OK;
    return tiff_failed(w->packing.path, &w->said, error);
}

static void drop_masks(writing *w, uint64_t tiles)
{
    for (uint64_t k = 0; w->masks && k < tiles; k++)
        free(w->masks[k].bytes);
    free(w->masks);
    w->masks = NULL;
}

static tl_status write_tile(void *context, tl_parallel *loop, uint64_t tile, unsigned index, tl_error *error)
{
    writing *w = context;
    worker *self = &w->workers[index];
    size_t count, bands = w->packing.bands;
    const void *bytes;
    tl_status status = read_tile(w, self, out_tile_window(&w->tiling, tile), error);
    bool left_out = status == TL_OK && bands > 1 && is_empty(self->samples, bands * OUT_TILE * OUT_TILE);
    if (status == TL_OK)
        status = out_packer_pack(self->packer, self->samples, &bytes, &count, error);
    if (status == TL_OK && w->masks)
        status = pack_mask(self->samples, self, &w->masks[tile], error);
    if (status != TL_OK)
        return status;
    return out_backlog_add(&w->backlog, loop, tile, bytes, left_out ? 0 : count, error);
}

static tl_status write_packed(void *context, uint64_t tile, const void *bytes, size_t count, tl_error *error)
{
    writing *w = context;
    errno = 0;
    if (!count || TIFFWriteRawTile(w->tiff, (uint32_t)tile, (void *)bytes, (tmsize_t)count) == (tmsize_t)count)
        return TL_OK;
    return tiff_failed(w->packing.path, &w->said, error);
}

/* One level and its directory. */
static tl_status write_level(writing *w, const tl_run *run, tl_error *error)
{
    int64_t width = w->mip.levels[w->level].width, height = w->mip.levels[w->level].height;
    w->tiling = (out_tiling){tl_div_up(width, OUT_TILE), tl_div_up(height, OUT_TILE), width, height};
    uint64_t tiles = (uint64_t)w->tiling.columns * (uint64_t)w->tiling.rows;
    errno = 0;
    if (!set_directory(w->tiff, &w->bands[0]->info, &w->packing, &w->mip, w->level))
        return tiff_failed(w->packing.path, &w->said, error);
    if (w->masked && !(w->masks = calloc((size_t)tiles, sizeof *w->masks)))
        return tl_fail_memory(error, w->packing.path);
    out_backlog_restart(&w->backlog);
    tl_status status = tl_parallel_for(run, tiles, (uint64_t)(width * height), write_tile, w, error);
    errno = 0;
    if (status == TL_OK && (!TIFFWriteDirectory(w->tiff) || w->said.made))
        status = tiff_failed(w->packing.path, &w->said, error);
    if (status == TL_OK && w->masked)
        status = write_mask(w, tiles, error);
    drop_masks(w, tiles);
    return status;
}

/* Level after level; the coarser ones are there when the finer ones are written. */
static tl_status write_levels(writing *w, const tl_run *run, tl_error *error)
{
    uint64_t tiles = (uint64_t)w->tiling.columns * (uint64_t)w->tiling.rows;
    unsigned count = tl_parallel_workers(run, tiles);
    tl_run quiet = run ? *run : (tl_run){0};
    quiet.progress = NULL; /* of the coarser levels, which are no work */
    w->workers = calloc(count, sizeof *w->workers);
    if (!w->workers)
        return tl_fail_memory(error, w->packing.path);
    w->backlog = (out_backlog){.write = write_packed, .context = w};
    tl_status status = out_backlog_init(&w->backlog, count, w->packing.path, error);
    for (unsigned i = 0; i < count; i++) {
        w->workers[i].samples = malloc(w->packing.bands * TILE_BYTES);
        w->workers[i].packer = out_packer_create(&w->packing);
        w->workers[i].masks = w->masked ? libdeflate_alloc_compressor(MASK_LEVEL) : NULL;
        if (!w->workers[i].samples || !w->workers[i].packer || (w->masked && !w->workers[i].masks))
            status = tl_fail_memory(error, w->packing.path);
    }
    for (w->level = 0; w->level < w->mip.count && status == TL_OK; w->level++)
        status = write_level(w, w->level ? &quiet : run, error);
    for (unsigned i = 0; i < count; i++) {
        free(w->workers[i].samples);
        out_packer_destroy(w->workers[i].packer);
        if (w->workers[i].masks)
            libdeflate_free_compressor(w->workers[i].masks);
    }
    out_backlog_finish(&w->backlog);
    free(w->workers);
    return status;
}

/* libtiff on a copy of the descriptor, which it closes; its messages go to `said`. */
static TIFF *open_tiff(tl_output *output, bool big, complaint *said)
{
    TIFFOpenOptions *options = TIFFOpenOptionsAlloc();
    int descriptor = options ? fcntl(tl_output_descriptor(output), F_DUPFD_CLOEXEC, 0) : -1;
    TIFF *tiff = NULL;
    if (descriptor >= 0) {
        errno = 0;
        TIFFOpenOptionsSetErrorHandlerExtR(options, no_message, said);
        TIFFOpenOptionsSetWarningHandlerExtR(options, no_message, NULL);
        tiff = TIFFFdOpenExt(descriptor, tl_output_path(output), big ? "w8l" : "wl", options);
        if (!tiff)
            close(descriptor);
    }
    if (options)
        TIFFOpenOptionsFree(options);
    return tiff;
}

/* Bytes that the tiles may take at most. LZW's codes have up to 12 bits for each byte. */
static double most_bytes(const writing *w)
{
    const tl_source_info *info = &w->bands[0]->info;
    double samples = (double)info->width * (double)info->height * (double)w->packing.bands;
    return samples * sizeof(float) * (w->mip.count > 1 ? 4 / 3.0 : 1) *
           (w->packing.compression == TL_COMPRESSION_LZW ? 1.5 : 1);
}

/* All levels as a TIFF whose directories stand behind their tiles. */
static tl_status write_tiff(writing *w, tl_output *output, bool big, const tl_run *run, tl_error *error)
{
    out_geokeys_register();
    w->tiff = open_tiff(output, big, &w->said);
    if (!w->tiff)
        return tiff_failed(w->packing.path, &w->said, error);
    tl_status status = write_levels(w, run, error);
    /* closing would write what is left, and cannot fail */
    errno = 0;
    TIFFClose(w->tiff);
    if (status == TL_OK && w->said.made)
        status = tiff_failed(w->packing.path, &w->said, error);
    return status;
}

/* The same in another order, by a file that gets no name. */
static tl_status write_cog(writing *w, tl_output *output, const tl_run *run, tl_error *error)
{
    tl_output *spool = tl_output_open(w->packing.path, true, error);
    tl_status status = spool ? write_tiff(w, spool, true, run, error) : TL_ERROR_IO;
    if (status == TL_OK)
        status = out_cog_write(spool, output, run, error);
    tl_output_abort(spool);
    return status;
}

static tl_status check_size(const tl_source_info *info, const char *path, tl_error *error)
{
    int64_t samples;
    if (info->width <= INT32_MAX && info->height <= INT32_MAX && tl_int64_mul(info->width, info->height, &samples) &&
        tl_div_up(info->width, OUT_TILE) * tl_div_up(info->height, OUT_TILE) <= INT32_MAX)
        return TL_OK;
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %lld x %lld samples are too many for a TIFF; refine by fewer levels",
                   path, (long long)info->width, (long long)info->height);
}

/* Overviews stop where one tile holds all. */
static tl_status write_geotiff(const tl_source *const *bands, const out_packing *packing,
                               const tl_write_options *options, tl_output *output, tl_error *error)
{
    const tl_run *run = options->run;
    const tl_source_info *info = &bands[0]->info;
    writing w = {.bands = bands, .packing = *packing, .tiling = out_tiling_of(bands[0]), .masked = options->mask};
    tl_status status = check_size(info, packing->path, error);
    if (status == TL_OK)
        status = out_packing_check(packing, error);
    if (status == TL_OK)
        status = out_mip_init(&w.mip, options->mip, OUT_TILE, info->width, info->height, run, packing->path, error);
    if (status != TL_OK)
        return status;
    status = options->cog ? write_cog(&w, output, run, error)
                          : write_tiff(&w, output, most_bytes(&w) > classic_limit, run, error);
    out_mip_finish(&w.mip);
    return status;
}

tl_status out_geotiff_write(const tl_source *source, tl_output *output, const tl_write_options *options,
                            tl_error *error)
{
    const out_packing packing = {.path = tl_output_path(output),
                                 .compression = options->compression,
                                 .bands = 1,
                                 .lerc_error = options->lerc_error};
    return write_geotiff(&source, &packing, options, output, error);
}

tl_status out_validity_write(const tl_source *source, tl_output *output, const tl_write_options *options,
                             tl_error *error)
{
    const out_packing packing = {.path = tl_output_path(output),
                                 .compression = options->compression == TL_COMPRESSION_NONE ? TL_COMPRESSION_NONE
                                                                                            : TL_COMPRESSION_DEFLATE,
                                 .bytes = true,
                                 .bands = 1};
    return write_geotiff(&source, &packing, &(tl_write_options){.run = options->run}, output, error);
}

tl_status out_geotiff_write_bands(const tl_source *const *bands, size_t count, tl_output *output,
                                  const tl_write_options *options, tl_error *error)
{
    const out_packing packing = {.path = tl_output_path(output), .compression = options->compression, .bands = count};
    return write_geotiff(bands, &packing, &(tl_write_options){.run = options->run}, output, error);
}
