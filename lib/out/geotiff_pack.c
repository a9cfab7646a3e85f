#include "lib/out/geotiff_pack.h"

#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/out/out.h"

#include <libdeflate.h>
#include <tiffio.h>

#include <math.h>
#include <string.h>

enum {
    SAMPLES = OUT_TILE * OUT_TILE,
    TILE_BYTES = SAMPLES * (int)sizeof(float),
    DEFLATE_LEVEL = 6,
    SPARSE_LEVEL = 9, /* there is little to compress */
};

/* A file in memory, for libtiff to write one tile to. */
typedef struct scratch {
    unsigned char *bytes;
    size_t size, room, at;
} scratch;

struct out_packer {
    const out_packing *packing;
    unsigned char *arranged, *packed;
    size_t packed_limit;
    struct libdeflate_compressor *compressor;
    scratch file;
};

/* ---- What there is ---- */

static const struct codec {
    tl_compression compression;
    int number;
    const char *name;
} codecs[] = {{TL_COMPRESSION_DEFAULT, COMPRESSION_ADOBE_DEFLATE, "deflate"},
              {TL_COMPRESSION_NONE, COMPRESSION_NONE, "none"},
              {TL_COMPRESSION_ZIP, COMPRESSION_ADOBE_DEFLATE, "deflate"},
              {TL_COMPRESSION_DEFLATE, COMPRESSION_ADOBE_DEFLATE, "deflate"},
              {TL_COMPRESSION_ZSTD, COMPRESSION_ZSTD, "zstd"},
              {TL_COMPRESSION_LZW, COMPRESSION_LZW, "lzw"},
              {TL_COMPRESSION_LERC, COMPRESSION_LERC, "lerc"}};

static const struct codec *codec_of(tl_compression compression)
{
    for (size_t k = 0; k < sizeof codecs / sizeof *codecs; k++)
        if (codecs[k].compression == compression)
            return &codecs[k];
    return NULL;
}

tl_status out_packing_check(const out_packing *packing, tl_error *error)
{
    const struct codec *codec = codec_of(packing->compression);
    if (!codec)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: piz and zips are compressions of EXR; use deflate, zstd, lzw, lerc or none", packing->path);
    if (packing->lerc_error != 0 && (packing->compression != TL_COMPRESSION_LERC || !(packing->lerc_error > 0)))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: an error of lerc is for the compression lerc, and above 0",
                       packing->path);
    if (codec->number != COMPRESSION_ADOBE_DEFLATE && !TIFFIsCODECConfigured((uint16_t)codec->number))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: libtiff was built without %s here; use deflate", packing->path,
                       codec->name);
    return TL_OK;
}

int out_packing_codec(const out_packing *packing)
{
    return codec_of(packing->compression)->number;
}

bool out_packing_predicts(const out_packing *packing)
{
    return !packing->bytes && packing->bands == 1 && packing->compression != TL_COMPRESSION_NONE &&
           packing->compression != TL_COMPRESSION_LERC;
}

static bool deflates(const out_packing *packing)
{
    return out_packing_codec(packing) == COMPRESSION_ADOBE_DEFLATE;
}

/* ---- Life ---- */

out_packer *out_packer_create(const out_packing *packing)
{
    out_packer *self = calloc(1, sizeof *self);
    if (!self)
        return NULL;
    self->packing = packing;
    self->arranged = malloc(packing->bands * TILE_BYTES);
    bool good = self->arranged;
    if (deflates(packing)) {
        self->compressor = libdeflate_alloc_compressor(packing->bands > 1 ? SPARSE_LEVEL : DEFLATE_LEVEL);
        self->packed_limit = libdeflate_zlib_compress_bound(NULL, packing->bands * TILE_BYTES);
        self->packed = malloc(self->packed_limit);
        good = good && self->compressor && self->packed;
    }
    if (good)
        return self;
    out_packer_destroy(self);
    return NULL;
}

void out_packer_destroy(out_packer *self)
{
    if (!self)
        return;
    free(self->arranged);
    free(self->packed);
    free(self->file.bytes);
    if (self->compressor)
        libdeflate_free_compressor(self->compressor);
    free(self);
}

/* ---- By libtiff, into memory ---- */

static tmsize_t on_read(thandle_t user, void *to, tmsize_t count)
{
    scratch *f = user;
    size_t have = f->at < f->size ? f->size - f->at : 0, some = (size_t)count < have ? (size_t)count : have;
    memcpy(to, f->bytes + f->at, some);
    f->at += some;
    return (tmsize_t)some;
}

static tmsize_t on_write(thandle_t user, void *from, tmsize_t count)
{
    scratch *f = user;
    size_t end = f->at + (size_t)count;
    if (end > f->room) {
        size_t room = end + end / 2;
        unsigned char *bytes = realloc(f->bytes, room);
        if (!bytes)
            return -1;
        f->bytes = bytes;
        f->room = room;
    }
    if (f->at > f->size)
        memset(f->bytes + f->size, 0, f->at - f->size);
    memcpy(f->bytes + f->at, from, (size_t)count);
    f->at = end;
    f->size = end > f->size ? end : f->size;
    return count;
}

static toff_t on_seek(thandle_t user, toff_t offset, int from)
{
    scratch *f = user;
    f->at = (size_t)offset + (from == SEEK_CUR ? f->at : from == SEEK_END ? f->size : 0);
    return f->at;
}

static toff_t on_size(thandle_t user)
{
    return ((scratch *)user)->size;
}

static int on_close(thandle_t user)
{
    (void)user;
    return 0;
}

static int no_message(TIFF *tiff, void *user, const char *module, const char *format, va_list list)
{
    (void)tiff;
    (void)user;
    (void)module;
    (void)format;
    (void)list;
    return 1;
}

static TIFF *open_scratch(scratch *file)
{
    TIFFOpenOptions *options = TIFFOpenOptionsAlloc();
    if (!options)
        return NULL;
    file->size = file->at = 0;
    TIFFOpenOptionsSetErrorHandlerExtR(options, no_message, NULL);
    TIFFOpenOptionsSetWarningHandlerExtR(options, no_message, NULL);
    TIFF *tiff =
        TIFFClientOpenExt("tile", "wl", file, on_read, on_write, on_seek, on_close, on_size, NULL, NULL, options);
    TIFFOpenOptionsFree(options);
    return tiff;
}

/* What lerc may be told so that the bound holds for decoded floats: these are rounded, by half a unit in the last place
 * of the tile's largest. */
static double lerc_bound(const out_packing *packing, const float *heights)
{
    float largest = 0;
    for (size_t k = 0; k < SAMPLES; k++)
        largest = fabsf(heights[k]) > largest ? fabsf(heights[k]) : largest;
    return fmax(packing->lerc_error - (double)largest * 0x1p-24, 0);
}

static bool set_tile(TIFF *tiff, const out_packing *packing, const float *samples)
{
    bool good =
        TIFFSetField(tiff, TIFFTAG_IMAGEWIDTH, OUT_TILE) == 1 &&
        TIFFSetField(tiff, TIFFTAG_IMAGELENGTH, OUT_TILE) == 1 &&
        TIFFSetField(tiff, TIFFTAG_TILEWIDTH, OUT_TILE) == 1 && TIFFSetField(tiff, TIFFTAG_TILELENGTH, OUT_TILE) == 1 &&
        TIFFSetField(tiff, TIFFTAG_BITSPERSAMPLE, packing->bytes ? 8 : 32) == 1 &&
        TIFFSetField(tiff, TIFFTAG_SAMPLEFORMAT, packing->bytes ? SAMPLEFORMAT_UINT : SAMPLEFORMAT_IEEEFP) == 1 &&
        TIFFSetField(tiff, TIFFTAG_SAMPLESPERPIXEL, (int)packing->bands) == 1 &&
        TIFFSetField(tiff, TIFFTAG_PLANARCONFIG, PLANARCONFIG_CONTIG) == 1 &&
        TIFFSetField(tiff, TIFFTAG_PHOTOMETRIC, PHOTOMETRIC_MINISBLACK) == 1 &&
        TIFFSetField(tiff, TIFFTAG_COMPRESSION, out_packing_codec(packing)) == 1;
    if (good && out_packing_predicts(packing))
        good = TIFFSetField(tiff, TIFFTAG_PREDICTOR, PREDICTOR_FLOATINGPOINT) == 1;
    if (good && packing->compression == TL_COMPRESSION_LERC && !packing->bytes && packing->bands == 1)
        good = TIFFSetField(tiff, TIFFTAG_LERC_MAXZERROR, lerc_bound(packing, samples)) == 1;
    return good;
}

static tl_status pack_by_tiff(out_packer *self, const void *samples, size_t size, const void **out, size_t *count,
                              tl_error *error)
{
    TIFF *tiff = open_scratch(&self->file);
    bool good = tiff && set_tile(tiff, self->packing, samples) &&
                TIFFWriteEncodedTile(tiff, 0, (void *)samples, (tmsize_t)size) == (tmsize_t)size;
    uint64_t at = good ? TIFFGetStrileOffset(tiff, 0) : 0;
    *count = good ? (size_t)TIFFGetStrileByteCount(tiff, 0) : 0;
    if (tiff)
        TIFFCleanup(tiff); /* without its directory */
    *out = self->file.bytes + at;
    if (good && at && *count && at + *count <= self->file.size)
        return TL_OK;
    return tl_fail(error, TL_ERROR_IO, "%s: libtiff cannot compress a tile by %s; use deflate", self->packing->path,
                   codec_of(self->packing->compression)->name);
}

/* ---- By hand ---- */

/* TIFF's predictor 3: in each row the bytes of all samples by significance, highest first, then differences of
 * neighbours. (Adobe Photoshop TIFF Technical Note 3.) */
static void predict_rows(const float *heights, unsigned char *out)
{
    for (int row = 0; row < OUT_TILE; row++, heights += OUT_TILE, out += OUT_TILE * sizeof(float)) {
        for (int i = 0; i < OUT_TILE; i++) {
            uint32_t bits;
            memcpy(&bits, &heights[i], sizeof bits);
            for (int byte = 0; byte < 4; byte++)
                out[byte * OUT_TILE + i] = (unsigned char)(bits >> (24 - 8 * byte));
        }
        for (int i = OUT_TILE * (int)sizeof(float) - 1; i > 0; i--)
            out[i] = (unsigned char)(out[i] - out[i - 1]);
    }
}

/* The bands beside each other, sample by sample: where few samples are known, their places are stored once. */
static void interleave(const float *bands, size_t count, float *out)
{
    for (size_t i = 0; i < SAMPLES; i++)
        for (size_t k = 0; k < count; k++)
            *out++ = bands[k * SAMPLES + i];
}

tl_status out_packer_pack(out_packer *self, const void *samples, const void **out, size_t *count, tl_error *error)
{
    const out_packing *packing = self->packing;
    const void *bytes = samples;
    *count = packing->bytes ? SAMPLES : packing->bands * TILE_BYTES;
    if (packing->bands > 1) {
        interleave(samples, packing->bands, (float *)(void *)self->arranged);
        bytes = self->arranged;
    }
    *out = bytes;
    if (packing->compression == TL_COMPRESSION_NONE)
        return TL_OK;
    if (!deflates(packing))
        return pack_by_tiff(self, bytes, *count, out, count, error);
    if (out_packing_predicts(packing)) {
        predict_rows(samples, self->arranged);
        bytes = self->arranged;
    }
    *count = libdeflate_zlib_compress(self->compressor, bytes, *count, self->packed, self->packed_limit);
    *out = self->packed;
    return TL_OK;
}
