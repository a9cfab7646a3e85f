/* The keys through libgeotiff. */
#include "lib/out/geotiff_keys.h"

#include "dem/crs_ellipsoidal.h"
#include "dem/crs_keys.h"

#include <geotiff/geokeys.h>
#include <geotiff/geotiff.h>
#include <geotiff/geotiffio.h>
#include <geotiff/geovalues.h>
#include <geotiff/xtiffio.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

void out_geokeys_register(void)
{
    XTIFFInitialize();
}

/* The keys that the CRS came with, but for the raster type, which is ours. */
static bool copy_keys(GTIF *keys, const tl_crs *crs)
{
    const uint16_t *d = crs->key_directory;
    bool good = true;
    for (size_t at = 4; good && at + 4 <= crs->key_directory_count; at += 4) {
        geokey_t id = (geokey_t)d[at];
        size_t count = d[at + 2], offset = d[at + 3];
        if (id == GTRasterTypeGeoKey)
            continue;
        if (d[at + 1] == 0)
            good = GTIFKeySet(keys, id, TYPE_SHORT, 1, (int)offset) == 1;
        else if (d[at + 1] == TIFFTAG_GEODOUBLEPARAMS && offset + count <= crs->key_double_count)
            good = count == 1 ? GTIFKeySet(keys, id, TYPE_DOUBLE, 1, crs->key_doubles[offset]) == 1
                              : GTIFKeySet(keys, id, TYPE_DOUBLE, (int)count, crs->key_doubles + offset) == 1;
        else if (d[at + 1] == TIFFTAG_GEOASCIIPARAMS && crs->key_ascii && offset + count <= strlen(crs->key_ascii)) {
            char *text = strndup(crs->key_ascii + offset, count ? count - 1 : 0); /* without the closing '|' */
            good = text && GTIFKeySet(keys, id, TYPE_ASCII, 0, text) == 1;
            free(text);
        }
    }
    return good;
}

static bool set_short(GTIF *keys, geokey_t key, int value)
{
    return GTIFKeySet(keys, key, TYPE_SHORT, 1, value) == 1;
}

static bool set_double(GTIF *keys, geokey_t key, double value)
{
    return GTIFKeySet(keys, key, TYPE_DOUBLE, 1, value) == 1;
}

static bool set_text(GTIF *keys, geokey_t key, const char *text)
{
    return GTIFKeySet(keys, key, TYPE_ASCII, 0, text) == 1;
}

/* Longitude and latitude without a code: the datum where that has one, and the ellipsoid. */
static bool set_ellipsoid(GTIF *keys, const tl_crs *crs)
{
    int datum = dem_crs_datum_code(crs);
    return set_short(keys, GeographicTypeGeoKey, KvUserDefined) && set_text(keys, GeogCitationGeoKey, crs->name) &&
           set_short(keys, GeogGeodeticDatumGeoKey, datum > 0 && datum < KvUserDefined ? datum : KvUserDefined) &&
           set_short(keys, GeogAngularUnitsGeoKey, Angular_Degree) &&
           set_short(keys, GeogEllipsoidGeoKey, KvUserDefined) &&
           set_double(keys, GeogSemiMajorAxisGeoKey, crs->semi_major) &&
           (crs->flattening > 0 ? set_double(keys, GeogInvFlatteningGeoKey, 1 / crs->flattening)
                                : set_double(keys, GeogSemiMinorAxisGeoKey, crs->semi_major)) &&
           set_double(keys, GeogPrimeMeridianLongGeoKey, dem_crs_prime_meridian(crs));
}

/* A map without a code: its definition in the words of ESRI, which GDAL reads where the model is the user's own. */
static bool set_definition(GTIF *keys, const tl_crs *crs)
{
    static const char mark[] = "ESRI PE String = ";
    char *definition = dem_crs_esri_text(crs);
    size_t room = definition ? strlen(definition) + sizeof mark : 0;
    char *text = definition ? malloc(room) : NULL;
    if (text)
        snprintf(text, room, "%s%s", mark, definition);
    bool good =
        !text || (set_short(keys, GTModelTypeGeoKey, KvUserDefined) &&
                  set_short(keys, ProjectedCSTypeGeoKey, KvUserDefined) && set_text(keys, PCSCitationGeoKey, text));
    free(definition);
    free(text);
    return good;
}

static bool set_heights(GTIF *keys, const tl_crs *crs, double unit)
{
    int code = crs->vertical_name ? dem_crs_vertical_key(crs) : 0, unit_code = dem_crs_unit_key(unit);
    bool good = true;
    if (code > 0) {
        good = set_short(keys, VerticalCSTypeGeoKey, code);
        if (code == KvUserDefined)
            good = good && set_text(keys, VerticalCitationGeoKey, crs->vertical_name);
    }
    if (unit_code && (code > 0 || unit_code != Linear_Meter))
        good = good && set_short(keys, VerticalUnitsGeoKey, unit_code);
    return good;
}

/* Keys for a CRS that came without. */
static bool make_keys(GTIF *keys, const tl_crs *crs, double height_unit)
{
    bool good = set_short(keys, GTModelTypeGeoKey, crs->geographic ? ModelTypeGeographic : ModelTypeProjected) &&
                set_text(keys, GTCitationGeoKey, crs->name);
    if (crs->epsg > 0 && crs->epsg < KvUserDefined)
        good = good && set_short(keys, crs->geographic ? GeographicTypeGeoKey : ProjectedCSTypeGeoKey, crs->epsg);
    else
        good = good && (crs->geographic ? set_ellipsoid(keys, crs) : set_definition(keys, crs));
    return good && set_heights(keys, crs, height_unit);
}

bool out_geokeys_write(TIFF *tiff, const tl_source_info *info)
{
    const tl_crs *crs = info->georef.crs;
    GTIF *keys = GTIFNew(tiff);
    if (!keys)
        return false;
    bool good =
        set_short(keys, GTRasterTypeGeoKey, info->type == TL_RASTER_AREA ? RasterPixelIsArea : RasterPixelIsPoint);
    if (good && crs)
        good = crs->key_directory_count ? copy_keys(keys, crs) : make_keys(keys, crs, info->georef.height_unit);
    good = good && GTIFWriteKeys(keys) == 1;
    GTIFFree(keys);
    return good;
}
