/* The keys without libgeotiff: those that the CRS came with, and the raster type. */
#include "lib/out/geotiff_keys.h"

#include "dem/geokeys.h"
#include "lib/base/georef.h"

#include <pthread.h>
#include <stdlib.h>
#include <string.h>

enum { TAG_DIRECTORY = 34735, TAG_DOUBLES = 34736, TAG_ASCII = 34737 };

static TIFFExtendProc earlier;

static void add_tags(TIFF *tiff)
{
    static char names[][24] = {"ModelPixelScaleTag", "ModelTiepointTag",   "ModelTransformationTag",
                               "GeoKeyDirectoryTag", "GeoDoubleParamsTag", "GeoASCIIParamsTag"};
    static const TIFFFieldInfo fields[] = {
        {OUT_TAG_PIXEL_SCALE, -1, -1, TIFF_DOUBLE, FIELD_CUSTOM, 1, 1, names[0]},
        {OUT_TAG_TIE_POINTS, -1, -1, TIFF_DOUBLE, FIELD_CUSTOM, 1, 1, names[1]},
        {OUT_TAG_MATRIX, -1, -1, TIFF_DOUBLE, FIELD_CUSTOM, 1, 1, names[2]},
        {TAG_DIRECTORY, -1, -1, TIFF_SHORT, FIELD_CUSTOM, 1, 1, names[3]},
        {TAG_DOUBLES, -1, -1, TIFF_DOUBLE, FIELD_CUSTOM, 1, 1, names[4]},
        {TAG_ASCII, -1, -1, TIFF_ASCII, FIELD_CUSTOM, 1, 0, names[5]},
    };
    if (earlier)
        earlier(tiff);
    TIFFMergeFieldInfo(tiff, fields, sizeof fields / sizeof *fields);
}

static void register_once(void)
{
    earlier = TIFFSetTagExtender(add_tags);
}

void out_geokeys_register(void)
{
    static pthread_once_t once = PTHREAD_ONCE_INIT;
    pthread_once(&once, register_once);
}

/* Entries are in the order of their numbers. */
static bool write_directory(TIFF *tiff, const tl_crs *crs, uint16_t raster_type)
{
    size_t room = 8 + (crs ? crs->key_directory_count : 0), at = 4;
    uint16_t *all = calloc(room, sizeof *all);
    bool written = false;
    if (!all)
        return false;
    all[0] = all[1] = 1;
    for (size_t from = 4; crs && from + 4 <= crs->key_directory_count; from += 4) {
        const uint16_t *entry = crs->key_directory + from;
        if (!written && entry[0] >= TL_KEY_RASTER_TYPE) {
            memcpy(all + at, (const uint16_t[4]){TL_KEY_RASTER_TYPE, 0, 1, raster_type}, 4 * sizeof *all);
            at += 4;
            written = true;
        }
        if (entry[0] != TL_KEY_RASTER_TYPE) {
            memcpy(all + at, entry, 4 * sizeof *all);
            at += 4;
        }
    }
    if (!written) {
        memcpy(all + at, (const uint16_t[4]){TL_KEY_RASTER_TYPE, 0, 1, raster_type}, 4 * sizeof *all);
        at += 4;
    }
    all[3] = (uint16_t)(at / 4 - 1);
    bool good = TIFFSetField(tiff, TAG_DIRECTORY, (int)at, all) == 1;
    free(all);
    return good;
}

bool out_geokeys_write(TIFF *tiff, const tl_source_info *info)
{
    const tl_crs *crs = info->georef.crs;
    bool good = write_directory(tiff, crs, info->type == TL_RASTER_AREA ? TL_RASTER_IS_AREA : TL_RASTER_IS_POINT);
    if (good && crs && crs->key_double_count)
        good = TIFFSetField(tiff, TAG_DOUBLES, (int)crs->key_double_count, crs->key_doubles) == 1;
    if (good && crs && crs->key_ascii)
        good = TIFFSetField(tiff, TAG_ASCII, crs->key_ascii) == 1;
    return good;
}
