#include "dem/tiff_layout.h"

#include "dem/text.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

enum {
    TAG_GDAL_METADATA = 42112,
    TAG_GDAL_NODATA = 42113,
    MAX_BLOCK_BYTES = 1 << 30,     /* decoded; no writer of rasters makes such blocks on purpose */
    STREAM_ABOVE_BYTES = 32 << 20, /* heights of a strip that is not kept whole */
    CHUNK_BYTES = 4 << 20,         /* heights of a part of such a strip */
    MAX_DIRECTORIES = 64,
};

/* expansion: deflate's longest match is 258 bytes in 2 bits, PackBits repeats 128 times for 2 bytes, LZW's longest
 * string is 4096 bytes in 9 bits, a block of ZSTD that repeats one byte is 128 KB in 4; LZMA's longest match is 273
 * bytes in some 14 binary choices of at least 0.022 bits (31 / 2048 is the least likely side of one). The others have
 * none worth a name. */
static const struct {
    uint16_t code;
    const char *name;
    int64_t expansion;
} codecs[] = {
    {COMPRESSION_NONE, "none", 1},
    {COMPRESSION_LZW, "lzw", 4096},
    {COMPRESSION_ADOBE_DEFLATE, "deflate", 1040},
    {COMPRESSION_DEFLATE, "deflate", 1040},
    {COMPRESSION_PACKBITS, "packbits", 64},
    {COMPRESSION_ZSTD, "zstd", 32768},
    {COMPRESSION_LERC, "lerc", 0},
    {COMPRESSION_LZMA, "lzma", 8192},
    {COMPRESSION_JPEG, "jpeg", 0},
    {COMPRESSION_OJPEG, "old jpeg", 0},
    {COMPRESSION_CCITTRLE, "ccitt rle", 0},
    {COMPRESSION_CCITTRLEW, "ccitt rle", 0},
    {COMPRESSION_CCITTFAX3, "ccitt g3", 0},
    {COMPRESSION_CCITTFAX4, "ccitt g4", 0},
    {COMPRESSION_WEBP, "webp", 0},
    {COMPRESSION_JBIG, "jbig", 0},
    {COMPRESSION_JP2000, "jpeg 2000", 0},
    {COMPRESSION_THUNDERSCAN, "thunderscan", 0},
    {COMPRESSION_NEXT, "next", 0},
    {50002, "jpeg xl", 0},
};

const char *dem_codec_name(uint16_t codec)
{
    for (size_t i = 0; i < sizeof codecs / sizeof *codecs; i++)
        if (codecs[i].code == codec)
            return codecs[i].name;
    return "unknown";
}

int64_t dem_codec_expansion(uint16_t codec)
{
    for (size_t i = 0; i < sizeof codecs / sizeof *codecs; i++)
        if (codecs[i].code == codec)
            return codecs[i].expansion;
    return 0;
}

static uint16_t short_tag(TIFF *tiff, uint32_t tag, uint16_t otherwise)
{
    uint16_t value;
    return TIFFGetFieldDefaulted(tiff, tag, &value) ? value : otherwise;
}

static uint32_t long_tag(TIFF *tiff, uint32_t tag, uint32_t otherwise)
{
    uint32_t value;
    return TIFFGetField(tiff, tag, &value) ? value : otherwise;
}

/* ---- What the samples are ---- */

static tl_status read_sample_type(TIFF *tiff, const char *path, dem_layout *out, tl_error *error)
{
    static const char *const names[] = {"uint", "int", "float"};
    uint16_t format = short_tag(tiff, TIFFTAG_SAMPLEFORMAT, SAMPLEFORMAT_UINT);
    int bits = out->bits = short_tag(tiff, TIFFTAG_BITSPERSAMPLE, 1);
    if (format == SAMPLEFORMAT_COMPLEXINT || format == SAMPLEFORMAT_COMPLEXIEEEFP)
        return tl_fail(error, TL_ERROR_DATA, "%s: holds complex numbers, which are no heights", path);
    out->kind = format == SAMPLEFORMAT_INT      ? DEM_SAMPLE_INT
                : format == SAMPLEFORMAT_IEEEFP ? DEM_SAMPLE_FLOAT
                                                : DEM_SAMPLE_UINT;
    bool fine = out->kind == DEM_SAMPLE_FLOAT ? bits == 16 || bits == 24 || bits == 32 || bits == 64
                                              : (bits >= 1 && bits <= 32) || bits == 64;
    if (!fine)
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: samples of %d bits of TIFF sample format %d cannot be read; convert them to float32", path,
                       bits, format);
    snprintf(out->sample_type, sizeof out->sample_type, "%s%d", names[out->kind], bits);
    return TL_OK;
}

static tl_status check_photometric(TIFF *tiff, const char *path, bool band_given, tl_error *error)
{
    uint16_t photometric;
    if (!TIFFGetField(tiff, TIFFTAG_PHOTOMETRIC, &photometric))
        return TL_OK;
    const char *what = NULL;
    switch (photometric) {
    case PHOTOMETRIC_MINISWHITE: /* the stored numbers are taken as they are, as GDAL does */
    case PHOTOMETRIC_MINISBLACK:
    case PHOTOMETRIC_MASK:
        return TL_OK;
    case PHOTOMETRIC_RGB:
        what = "a colour picture (RGB)";
        break;
    case PHOTOMETRIC_PALETTE:
        what = "a picture with a colour table";
        break;
    case PHOTOMETRIC_SEPARATED:
        what = "a colour picture (CMYK)";
        break;
    default:
        return tl_fail(error, TL_ERROR_DATA, "%s: a picture (TIFF photometric %d), no elevation model", path,
                       photometric);
    }
    if (band_given)
        return TL_OK;
    return tl_fail(error, TL_ERROR_DATA, "%s: %s; name the band that holds heights, counted from 1", path, what);
}

static tl_status read_bands(TIFF *tiff, const char *path, unsigned band, dem_layout *out, tl_error *error)
{
    out->bands = short_tag(tiff, TIFFTAG_SAMPLESPERPIXEL, 1);
    out->band = band ? band - 1 : 0;
    out->separate = short_tag(tiff, TIFFTAG_PLANARCONFIG, PLANARCONFIG_CONTIG) == PLANARCONFIG_SEPARATE;
    if (out->bands == 0)
        return tl_fail(error, TL_ERROR_DATA, "%s: has no bands", path);
    if (out->band >= out->bands)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no band %u; it has %u", path, band, out->bands);
    tl_status status = check_photometric(tiff, path, band != 0, error);
    return status == TL_OK ? read_sample_type(tiff, path, out, error) : status;
}

static tl_status read_codec(TIFF *tiff, const char *path, dem_layout *out, tl_error *error)
{
    out->codec = short_tag(tiff, TIFFTAG_COMPRESSION, COMPRESSION_NONE);
    if (!TIFFIsCODECConfigured(out->codec))
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: compressed by a scheme that libtiff cannot read (%s, code %d); convert it, for example "
                       "with gdal_translate -co COMPRESS=DEFLATE",
                       path, dem_codec_name(out->codec), out->codec);
    /* the tag exists only in the codecs that have predictors */
    uint16_t predictor;
    out->predictor = TIFFGetField(tiff, TIFFTAG_PREDICTOR, &predictor) ? predictor : 1;
    return TL_OK;
}

/* ---- Where the samples are ---- */

static void choose_chunk(dem_layout *out)
{
    int64_t row = out->block_width * (int64_t)sizeof(float);
    out->chunk_rows = out->block_height;
    if (!out->tiled && row * out->block_height > STREAM_ABOVE_BYTES)
        out->chunk_rows = tl_int64_max(1, CHUNK_BYTES / row);
}

static tl_status check_block(TIFF *tiff, const char *path, dem_layout *out, tl_error *error)
{
    /* width <= 2^32, bands < 2^16, bits <= 64: the product is below 2^55 */
    int64_t bits = out->block_width * (out->separate ? 1 : (int64_t)out->bands) * out->bits;
    int64_t bytes;
    out->row_bytes = tl_div_up(bits, 8);
    if (!tl_int64_mul(out->row_bytes, out->block_height, &bytes) || bytes > MAX_BLOCK_BYTES ||
        out->block_width * out->block_height > MAX_BLOCK_BYTES / (int64_t)sizeof(float))
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: its %s of %lld x %lld samples exceed 1 GiB; rewrite it with tiles of 256 x 256", path,
                       out->tiled ? "tiles" : "strips", (long long)out->block_width, (long long)out->block_height);
    uint64_t row = out->tiled ? TIFFTileRowSize64(tiff) : TIFFScanlineSize64(tiff);
    if (row != (uint64_t)out->row_bytes)
        return tl_fail(error, TL_ERROR_DATA, "%s: its samples are laid out in a way that cannot be read", path);
    choose_chunk(out);
    return TL_OK;
}

static tl_status read_blocks(TIFF *tiff, const char *path, dem_layout *out, tl_error *error)
{
    out->tiled = TIFFIsTiled(tiff);
    if (out->tiled) {
        out->block_width = long_tag(tiff, TIFFTAG_TILEWIDTH, 0);
        out->block_height = long_tag(tiff, TIFFTAG_TILELENGTH, 0);
    } else {
        out->block_width = out->width;
        out->block_height = tl_int64_min(long_tag(tiff, TIFFTAG_ROWSPERSTRIP, UINT32_MAX), out->height);
    }
    if (out->block_width <= 0 || out->block_height <= 0)
        return tl_fail(error, TL_ERROR_DATA, "%s: its tiles or strips have no size", path);
    out->across = tl_div_up(out->width, out->block_width);
    out->down = tl_div_up(out->height, out->block_height);
    /* libtiff numbers blocks in 32 bits */
    int64_t blocks;
    if (!tl_int64_mul(out->across, out->down, &blocks) ||
        !tl_int64_mul(blocks, out->separate ? (int64_t)out->bands : 1, &blocks) || blocks > UINT32_MAX)
        return tl_fail(error, TL_ERROR_DATA, "%s: has more tiles or strips than a TIFF file can", path);
    return check_block(tiff, path, out, error);
}

static tl_status read_size(TIFF *tiff, const char *path, dem_layout *out, tl_error *error)
{
    int64_t samples;
    out->width = long_tag(tiff, TIFFTAG_IMAGEWIDTH, 0);
    out->height = long_tag(tiff, TIFFTAG_IMAGELENGTH, 0);
    if (out->width == 0 || out->height == 0)
        return tl_fail(error, TL_ERROR_DATA, "%s: has no samples (%lld x %lld)", path, (long long)out->width,
                       (long long)out->height);
    if (!tl_int64_mul(out->width, out->height, &samples))
        return tl_fail(error, TL_ERROR_DATA, "%s: %lld x %lld samples are too many", path, (long long)out->width,
                       (long long)out->height);
    if (long_tag(tiff, TIFFTAG_IMAGEDEPTH, 1) > 1 || long_tag(tiff, TIFFTAG_TILEDEPTH, 1) > 1)
        return tl_fail(error, TL_ERROR_DATA, "%s: holds a volume, no raster of heights", path);
    return TL_OK;
}

/* ---- What the numbers mean ---- */

static void read_nodata(TIFF *tiff, dem_layout *out)
{
    char *text = dem_tiff_text(tiff, TAG_GDAL_NODATA);
    out->has_nodata = text && dem_parse_number(text, &out->nodata);
    free(text);
}

/* Which stored numbers are void. A nodata value of 1e30 and more stands for a whole neighbourhood: it is some type's
 * lowest or highest number, printed with fewer digits than it has ("-3.40282e+38"). */
static void set_void_range(dem_layout *out)
{
    dem_value_rule *rule = &out->rule;
    rule->void_low = (double)INFINITY;
    rule->void_high = (double)-INFINITY;
    if (!out->has_nodata || isnan(out->nodata))
        return;
    double value = out->nodata;
    if (out->kind == DEM_SAMPLE_FLOAT && out->bits <= 32)
        value = (double)(float)value;
    double margin = out->kind == DEM_SAMPLE_FLOAT && fabs(value) >= 1e30 ? fabs(value) * 1e-5 : 0;
    rule->void_low = value - margin;
    rule->void_high = value + margin;
}

static bool can_be_void(const dem_layout *out)
{
    if (out->kind == DEM_SAMPLE_FLOAT)
        return true;
    const dem_value_rule *rule = &out->rule;
    bool has_sign = out->kind == DEM_SAMPLE_INT;
    double high = ldexp(1, out->bits - has_sign) - 1, low = has_sign ? -high - 1 : 0;
    if (rule->void_low <= high && rule->void_high >= low)
        return true;
    return fabs(rule->offset) + fabs(rule->scale) * high > (double)FLT_MAX;
}

static void read_meaning(TIFF *tiff, dem_layout *out)
{
    char *metadata = dem_tiff_text(tiff, TAG_GDAL_METADATA);
    dem_value_rule *rule = &out->rule;
    rule->scale = 1;
    if (metadata) {
        dem_band_item(metadata, out->band, "scale", &rule->scale);
        dem_band_item(metadata, out->band, "offset", &rule->offset);
    }
    free(metadata);
    if (!isfinite(rule->scale) || rule->scale == 0)
        rule->scale = 1;
    if (!isfinite(rule->offset))
        rule->offset = 0;
    rule->plain = rule->scale == 1 && rule->offset == 0;
    read_nodata(tiff, out);
    set_void_range(out);
    out->has_voids = can_be_void(out);
    out->quantum = out->kind == DEM_SAMPLE_FLOAT ? 0 : fabs(rule->scale);
}

tl_status dem_layout_read(dem_tiff_handle *handle, unsigned band, dem_layout *out, tl_error *error)
{
    TIFF *tiff = handle->tiff;
    const char *path = dem_tiff_file_path(handle->file);
    *out = (dem_layout){.big_tiff = TIFFIsBigTIFF(tiff), .big_endian = TIFFIsBigEndian(tiff)};
    tl_status status = read_size(tiff, path, out, error);
    if (status == TL_OK)
        status = read_bands(tiff, path, band, out, error);
    if (status == TL_OK)
        status = read_codec(tiff, path, out, error);
    if (status == TL_OK)
        status = read_blocks(tiff, path, out, error);
    if (status == TL_OK)
        read_meaning(tiff, out);
    return status;
}

/* The number of halvings k for which `size` is exactly 2^k of `reduced`; 0 where there is none. A copy whose size was
 * rounded does not count: its samples are not quite 2^k of the image's apart, so the last ones would lie elsewhere. */
static int halvings_of(int64_t size, int64_t reduced)
{
    for (int k = 1; k < 32 && reduced << k <= size; k++)
        if (reduced << k == size)
            return k;
    return 0;
}

/* Whether an overview says itself that its samples are no means, which levels of areas are. */
static bool is_sampled(TIFF *tiff)
{
    char *metadata = dem_tiff_text(tiff, TAG_GDAL_METADATA);
    const char *item = metadata ? strstr(metadata, "name=\"RESAMPLING\"") : NULL;
    const char *value = item ? strchr(item, '>') : NULL;
    bool sampled = value && strncmp(value + 1, "NEAREST", 7) == 0;
    free(metadata);
    return sampled;
}

static bool use_overview(dem_tiff_handle *handle, const dem_layout *main, dem_overview *out)
{
    if (is_sampled(handle->tiff) || dem_layout_read(handle, main->band + 1, &out->layout, NULL) != TL_OK)
        return false;
    out->halvings = halvings_of(main->width, out->layout.width);
    out->directory = TIFFCurrentDirOffset(handle->tiff);
    /* what its numbers mean is told once, in the image's own directory */
    bool same_numbers = out->layout.kind == main->kind && out->layout.bits == main->bits;
    out->layout.has_nodata = main->has_nodata;
    out->layout.nodata = main->nodata;
    out->layout.rule = main->rule;
    return same_numbers && out->halvings && halvings_of(main->height, out->layout.height) == out->halvings;
}

unsigned dem_overviews_read(dem_tiff_handle *handle, const dem_layout *main, dem_overview *out, unsigned *usable)
{
    unsigned count = 0;
    *usable = 0;
    for (unsigned i = 0; i < MAX_DIRECTORIES && TIFFReadDirectory(handle->tiff); i++) {
        uint32_t kind = long_tag(handle->tiff, TIFFTAG_SUBFILETYPE, 0);
        if (!(kind & FILETYPE_REDUCEDIMAGE) || (kind & FILETYPE_MASK))
            continue;
        count++;
        *usable += *usable < DEM_MAX_OVERVIEWS && use_overview(handle, main, &out[*usable]);
    }
    return count;
}
