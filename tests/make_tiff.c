#include "make_tiff.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <tiffio.h>

double make_tiff_value(unsigned band, uint32_t x, uint32_t y, uint16_t bits, uint16_t format)
{
    uint32_t hash = (x * 2654435761u) ^ (y * 2246822519u + 374761393u) ^ (band * 3266489917u);
    hash = (hash ^ hash >> 15) * 2246822519u;
    hash ^= hash >> 13;
    int kept = bits < 24 ? bits : 24; /* a float holds 24 bits */
    int64_t number = hash & ((1u << kept) - 1);
    if (format == SAMPLEFORMAT_IEEEFP)
        return (double)(number - (1 << (kept - 1))) / 64;
    return (double)(format == SAMPLEFORMAT_INT ? number - (1 << (kept - 1)) : number);
}

static void store(void *row, size_t index, uint16_t bits, uint16_t format, double value)
{
    unsigned char *bytes = (unsigned char *)row + index * (bits / 8);
    if (bits % 8) {
        uint64_t word = (uint64_t)(int64_t)value;
        for (size_t k = 0; k < bits; k++) {
            size_t bit = index * bits + k;
            if (word >> (bits - 1 - k) & 1)
                ((unsigned char *)row)[bit / 8] |= (unsigned char)(0x80 >> bit % 8);
        }
    } else if (format == SAMPLEFORMAT_IEEEFP && bits >= 32) {
        float single = (float)value;
        memcpy(bytes, bits == 64 ? (void *)&value : (void *)&single, bits / 8);
    } else {
        int64_t whole = value < 9e18 ? (int64_t)value : (int64_t)(uint64_t)value;
        int8_t whole8 = (int8_t)whole;
        int16_t whole16 = (int16_t)whole;
        int32_t whole32 = (int32_t)whole;
        memcpy(bytes,
               bits == 8    ? (void *)&whole8
               : bits == 16 ? (void *)&whole16
               : bits == 32 ? (void *)&whole32
                            : (void *)&whole,
               bits / 8);
    }
}

/* ---- Tags ---- */

static void set_tags(TIFF *tiff, const make_tiff_options *o)
{
    TIFFSetField(tiff, TIFFTAG_IMAGEWIDTH, o->width);
    TIFFSetField(tiff, TIFFTAG_IMAGELENGTH, o->height);
    TIFFSetField(tiff, TIFFTAG_BITSPERSAMPLE, o->bits);
    TIFFSetField(tiff, TIFFTAG_SAMPLEFORMAT, o->format);
    TIFFSetField(tiff, TIFFTAG_SAMPLESPERPIXEL, o->bands);
    TIFFSetField(tiff, TIFFTAG_PLANARCONFIG, o->separate ? PLANARCONFIG_SEPARATE : PLANARCONFIG_CONTIG);
    if (o->photometric)
        TIFFSetField(tiff, TIFFTAG_PHOTOMETRIC, o->photometric);
    TIFFSetField(tiff, TIFFTAG_COMPRESSION, o->codec);
    if (o->predictor)
        TIFFSetField(tiff, TIFFTAG_PREDICTOR, o->predictor);
    if (o->block_width) {
        TIFFSetField(tiff, TIFFTAG_TILEWIDTH, o->block_width);
        TIFFSetField(tiff, TIFFTAG_TILELENGTH, o->block_height);
    } else {
        TIFFSetField(tiff, TIFFTAG_ROWSPERSTRIP, o->block_height ? o->block_height : o->height);
    }
}

static void set_private_tags(TIFF *tiff, const make_tiff_options *o)
{
    static const TIFFFieldInfo fields[] = {
        {33550, TIFF_VARIABLE2, TIFF_VARIABLE2, TIFF_DOUBLE, FIELD_CUSTOM, 1, 1, "scale"},
        {33922, TIFF_VARIABLE2, TIFF_VARIABLE2, TIFF_DOUBLE, FIELD_CUSTOM, 1, 1, "ties"},
        {34264, TIFF_VARIABLE2, TIFF_VARIABLE2, TIFF_DOUBLE, FIELD_CUSTOM, 1, 1, "matrix"},
        {34735, TIFF_VARIABLE2, TIFF_VARIABLE2, TIFF_SHORT, FIELD_CUSTOM, 1, 1, "keys"},
        {34736, TIFF_VARIABLE2, TIFF_VARIABLE2, TIFF_DOUBLE, FIELD_CUSTOM, 1, 1, "doubles"},
        {34737, TIFF_VARIABLE2, TIFF_VARIABLE2, TIFF_ASCII, FIELD_CUSTOM, 1, 1, "ascii"},
        {42112, TIFF_VARIABLE2, TIFF_VARIABLE2, TIFF_ASCII, FIELD_CUSTOM, 1, 1, "metadata"},
        {42113, TIFF_VARIABLE2, TIFF_VARIABLE2, TIFF_ASCII, FIELD_CUSTOM, 1, 1, "nodata"},
    };
    TIFFMergeFieldInfo(tiff, fields, sizeof fields / sizeof *fields);
    if (o->scale)
        TIFFSetField(tiff, 33550, (uint32_t)3, o->scale);
    if (o->ties)
        TIFFSetField(tiff, 33922, (uint32_t)(6 * (o->tie_count ? o->tie_count : 1)), o->ties);
    if (o->matrix)
        TIFFSetField(tiff, 34264, (uint32_t)16, o->matrix);
    if (o->keys) {
        uint16_t directory[4 * 101] = {1, 1, 0, (uint16_t)o->key_count};
        memcpy(directory + 4, o->keys, o->key_count * 4 * sizeof *directory);
        TIFFSetField(tiff, 34735, (uint32_t)(4 * (o->key_count + 1)), directory);
    }
    if (o->key_doubles)
        TIFFSetField(tiff, 34736, (uint32_t)o->key_double_count, o->key_doubles);
    const char *const texts[] = {o->key_ascii, o->metadata, o->nodata};
    const uint32_t tags[] = {34737, 42112, 42113};
    for (int k = 0; k < 3; k++)
        if (texts[k])
            TIFFSetField(tiff, tags[k], (uint32_t)strlen(texts[k]) + 1, texts[k]);
}

/* ---- Data ---- */

typedef struct block {
    uint32_t x, y, width, height; /* within the raster, and the size of the block */
    unsigned band, bands;         /* first and number */
} block;

static void fill_block(const make_tiff_options *o, const block *at, unsigned char *data, size_t row_bytes)
{
    memset(data, 0, row_bytes * at->height);
    for (uint32_t y = 0; y < at->height && at->y + y < o->height; y++)
        for (uint32_t x = 0; x < at->width && at->x + x < o->width; x++)
            for (unsigned k = 0; k < at->bands; k++)
                store(data + y * row_bytes, (size_t)x * at->bands + k, o->bits, o->format,
                      o->value(at->band + k, at->x + x, at->y + y, o->bits, o->format));
}

static bool write_block(TIFF *tiff, const make_tiff_options *o, uint32_t number, const block *at)
{
    size_t row_bytes = ((size_t)at->width * at->bands * o->bits + 7) / 8;
    unsigned char *data = malloc(row_bytes * at->height);
    if (!data)
        return false;
    fill_block(o, at, data, row_bytes);
    tmsize_t bytes = (tmsize_t)(row_bytes * at->height);
    tmsize_t done = o->block_width ? TIFFWriteEncodedTile(tiff, number, data, bytes)
                                   : TIFFWriteEncodedStrip(tiff, number, data, bytes);
    free(data);
    return done >= 0;
}

static bool write_blocks(TIFF *tiff, const make_tiff_options *o)
{
    uint32_t width = o->block_width ? o->block_width : o->width, height = o->block_height ? o->block_height : o->height;
    uint32_t number = 0;
    for (unsigned band = 0; band < (o->separate ? o->bands : 1); band++)
        for (uint32_t y = 0; y < o->height; y += height)
            for (uint32_t x = 0; x < o->width; x += width, number++) {
                block at = {x, y, width, height, band, o->separate ? 1 : o->bands};
                if (!o->block_width && y + height > o->height)
                    at.height = o->height - y;
                if (o->leave_out && number % o->leave_out == 0)
                    continue;
                if (!write_block(tiff, o, number, &at))
                    return false;
            }
    return true;
}

static bool write_overviews(TIFF *tiff, unsigned count)
{
    for (unsigned k = 0; k < count; k++) {
        uint8_t sample = 0;
        TIFFCreateDirectory(tiff);
        const make_tiff_options o = {.width = 1, .height = 1, .bands = 1, .bits = 8, .format = 1, .codec = 1};
        TIFFSetField(tiff, TIFFTAG_SUBFILETYPE, FILETYPE_REDUCEDIMAGE);
        set_tags(tiff, &o);
        if (TIFFWriteEncodedStrip(tiff, 0, &sample, 1) < 0 || !TIFFWriteDirectory(tiff))
            return false;
    }
    return true;
}

static bool write_all(TIFF *tiff, const make_tiff_options *o)
{
    if (o->directory_first) {
        TIFFDeferStrileArrayWriting(tiff);
        if (!TIFFWriteCheck(tiff, o->block_width != 0, "make_tiff") || !TIFFWriteDirectory(tiff) ||
            !TIFFSetDirectory(tiff, 0))
            return false;
    }
    if (!write_blocks(tiff, o))
        return false;
    if (o->directory_first)
        return TIFFForceStrileArrayWriting(tiff);
    return TIFFWriteDirectory(tiff) && write_overviews(tiff, o->overviews);
}

static int silent(TIFF *tiff, void *user, const char *module, const char *format, va_list arguments)
{
    (void)tiff, (void)user, (void)module, (void)format, (void)arguments;
    return 1;
}

static TIFF *open_silently(const char *path, const char *mode)
{
    TIFFOpenOptions *options = TIFFOpenOptionsAlloc();
    TIFFOpenOptionsSetErrorHandlerExtR(options, silent, NULL);
    TIFFOpenOptionsSetWarningHandlerExtR(options, silent, NULL);
    TIFF *tiff = TIFFOpenExt(path, mode, options);
    TIFFOpenOptionsFree(options);
    return tiff;
}

/* Block for block as it is compressed. */
static bool copy_blocks(TIFF *from, TIFF *to, bool tiled)
{
    static unsigned char data[1 << 16];
    uint32_t count = tiled ? TIFFNumberOfTiles(from) : TIFFNumberOfStrips(from);
    for (uint32_t k = 0; k < count; k++) {
        tmsize_t bytes =
            tiled ? TIFFReadRawTile(from, k, data, sizeof data) : TIFFReadRawStrip(from, k, data, sizeof data);
        if (bytes < 0 || (tiled ? TIFFWriteRawTile(to, k, data, bytes) : TIFFWriteRawStrip(to, k, data, bytes)) < 0)
            return false;
    }
    return true;
}

/* libtiff 4.5 encodes predictor 3 wrongly in files of the other byte order than the machine's. What it should write
 * does not depend on the order, so it is taken from a file of the right one. */
static bool write_by_way_of_twin(TIFF *tiff, const char *path, const make_tiff_options *o)
{
    char twin[256];
    make_tiff_options other = *o;
    other.big_endian = other.directory_first = false;
    snprintf(twin, sizeof twin, "%s.twin", path);
    TIFF *from = make_tiff(twin, &other) ? open_silently(twin, "r") : NULL;
    bool done = from && copy_blocks(from, tiff, o->block_width != 0);
    if (from)
        TIFFClose(from);
    remove(twin);
    return done && TIFFWriteDirectory(tiff);
}

bool make_tiff(const char *path, const make_tiff_options *options)
{
    make_tiff_options o = *options;
    if (!o.format)
        o.format = o.bits ? SAMPLEFORMAT_UINT : SAMPLEFORMAT_IEEEFP;
    o.bits = o.bits ? o.bits : 32;
    o.bands = o.bands ? o.bands : 1;
    o.codec = o.codec ? o.codec : COMPRESSION_NONE;
    o.value = o.value ? o.value : make_tiff_value;
    char mode[8];
    snprintf(mode, sizeof mode, "w%c%c", o.big_endian ? 'b' : 'l', o.big_tiff ? '8' : '4');
    TIFF *tiff = open_silently(path, mode);
    if (!tiff)
        return false;
    set_tags(tiff, &o);
    set_private_tags(tiff, &o);
    bool done = o.big_endian && o.predictor == 3 ? write_by_way_of_twin(tiff, path, &o) : write_all(tiff, &o);
    TIFFClose(tiff);
    return done;
}
