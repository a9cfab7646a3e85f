/* Coordinate reference systems in a build without PROJ: of a GeoTIFF whether it is geographic, its unit, its name and
 * its code, as its keys give them, and the keys themselves, which go on into GeoTIFFs. Nothing is looked up: where the
 * keys give no ellipsoid it is that of WGS 84. Longitude and latitude stay what they are; of projected coordinates
 * they cannot be found. */
#include "dem/crs.h"
#include "dem/crs_ellipsoidal.h"
#include "dem/crs_keys.h"
#include "dem/geokeys.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <string.h>

static const double wgs84_semi_major = 6378137, wgs84_flattening = 1 / 298.257223563;
enum { USER_DEFINED = 32767, CODE_WGS84 = 4326 };

static tl_status lacks(const char *path, const char *what, tl_error *error)
{
    return tl_fail(error, TL_ERROR_ARGUMENT,
                   "%s: %s needs PROJ, which this build of talus is without; use one that has it", path, what);
}

/* ---- Reading ---- */

static void take_ellipsoid(const dem_geokeys *keys, tl_crs *crs)
{
    double major, minor, inverse;
    crs->semi_major = wgs84_semi_major;
    crs->flattening = wgs84_flattening;
    if (!dem_geokeys_double(keys, TL_KEY_SEMI_MAJOR_AXIS, &major) || !(major > 0))
        return;
    if (dem_geokeys_double(keys, TL_KEY_INVERSE_FLATTENING, &inverse) && inverse > 1) {
        crs->semi_major = major;
        crs->flattening = 1 / inverse;
    } else if (dem_geokeys_double(keys, TL_KEY_SEMI_MINOR_AXIS, &minor) && minor > 0 && minor <= major) {
        crs->semi_major = major;
        crs->flattening = 1 - minor / major;
    }
}

static void take_unit(const dem_geokeys *keys, tl_crs *crs)
{
    uint16_t code = 0;
    double size;
    dem_geokeys_short(keys, TL_KEY_LINEAR_UNIT, &code);
    crs->unit = crs->geographic ? 1 : dem_unit_of_length(code);
    if (!crs->geographic && code == USER_DEFINED && dem_geokeys_double(keys, TL_KEY_LINEAR_UNIT_SIZE, &size) &&
        size > 0)
        crs->unit = size;
}

static bool take_name(const dem_geokeys *keys, tl_crs *crs)
{
    crs->name = dem_geokeys_text(keys, TL_KEY_CITATION);
    if (!crs->name)
        crs->name = dem_geokeys_text(keys, crs->geographic ? TL_KEY_GEODETIC_CITATION : TL_KEY_PROJECTED_CITATION);
    if (!crs->name)
        crs->name = strdup("of an unknown name");
    crs->wkt = strdup("");
    return crs->name && crs->wkt;
}

/* Moves the keys into the CRS. */
static void keep_keys(dem_geokeys *keys, tl_crs *crs)
{
    crs->key_directory = keys->directory;
    crs->key_doubles = keys->doubles;
    crs->key_ascii = keys->ascii;
    crs->key_directory_count = keys->directory_count;
    crs->key_double_count = keys->double_count;
    *keys = (dem_geokeys){.directory = NULL};
}

static tl_status from_keys(dem_geokeys *keys, const char *path, tl_crs **out, tl_error *error)
{
    uint16_t model = 0, code = 0;
    tl_crs *crs = tl_crs_allocate();
    if (!crs)
        return tl_fail_memory(error, path);
    dem_geokeys_short(keys, TL_KEY_MODEL_TYPE, &model);
    bool projected = dem_geokeys_short(keys, TL_KEY_PROJECTED_CRS, &code);
    crs->geographic = model ? model == TL_MODEL_GEOGRAPHIC : !projected;
    if (crs->geographic && dem_geokeys_short(keys, TL_KEY_ANGULAR_UNIT, &code) && code != TL_UNIT_DEGREE) {
        tl_crs_release(crs);
        return lacks(path, "angles in other units than degrees", error);
    }
    code = 0;
    dem_geokeys_short(keys, crs->geographic ? TL_KEY_GEODETIC_CRS : TL_KEY_PROJECTED_CRS, &code);
    crs->epsg = code < USER_DEFINED ? code : 0;
    take_ellipsoid(keys, crs);
    take_unit(keys, crs);
    if (!take_name(keys, crs)) {
        tl_crs_release(crs);
        return tl_fail_memory(error, path);
    }
    keep_keys(keys, crs);
    *out = crs;
    return TL_OK;
}

tl_status dem_crs_from_tiff_scaled(struct tiff *tiff, const char *path, tl_crs **out, double *scale, tl_error *error)
{
    dem_geokeys keys;
    uint16_t value;
    *scale = 1;
    tl_status status = dem_geokeys_read(tiff, path, &keys, error);
    if (status == TL_OK && (dem_geokeys_short(&keys, TL_KEY_MODEL_TYPE, &value) ||
                            dem_geokeys_short(&keys, TL_KEY_PROJECTED_CRS, &value) ||
                            dem_geokeys_short(&keys, TL_KEY_GEODETIC_CRS, &value)))
        status = from_keys(&keys, path, out, error);
    dem_geokeys_finish(&keys);
    return status;
}

tl_status dem_crs_from_tiff(struct tiff *tiff, const char *path, tl_crs **out, tl_error *error)
{
    double scale;
    return dem_crs_from_tiff_scaled(tiff, path, out, &scale, error);
}

/* Of texts only this one: files of the SRTM are in it. */
tl_status dem_crs_from_text(const char *text, const char *path, tl_crs **out, tl_error *error)
{
    if (strcmp(text, "EPSG:4326") != 0)
        return lacks(path, "a coordinate reference system as a text", error);
    tl_crs *crs = tl_crs_allocate();
    if (!crs)
        return tl_fail_memory(error, path);
    crs->name = strdup("WGS 84");
    crs->wkt = strdup("");
    crs->epsg = CODE_WGS84;
    crs->geographic = true;
    crs->unit = 1;
    crs->semi_major = wgs84_semi_major;
    crs->flattening = wgs84_flattening;
    if (!crs->name || !crs->wkt) {
        tl_crs_release(crs);
        return tl_fail_memory(error, path);
    }
    *out = crs;
    return TL_OK;
}

bool dem_crs_equivalent(const tl_crs *a, const tl_crs *b)
{
    if (a == b || (a->epsg && a->epsg == b->epsg))
        return true;
    return a->key_directory_count && a->key_directory_count == b->key_directory_count &&
           a->key_double_count == b->key_double_count &&
           memcmp(a->key_directory, b->key_directory, a->key_directory_count * sizeof *a->key_directory) == 0 &&
           (!a->key_double_count ||
            memcmp(a->key_doubles, b->key_doubles, a->key_double_count * sizeof *a->key_doubles) == 0) &&
           strcmp(a->key_ascii ? a->key_ascii : "", b->key_ascii ? b->key_ascii : "") == 0;
}

/* ---- Coordinates ---- */

struct dem_projection {
    char nothing;
};

dem_projection *dem_projection_create(const tl_crs *crs, tl_error *error)
{
    if (!crs->geographic) {
        lacks(crs->name, "finding longitude and latitude", error);
        return NULL;
    }
    dem_projection *projection = calloc(1, sizeof *projection);
    if (!projection)
        tl_fail_memory(error, crs->name);
    return projection;
}

void dem_projection_destroy(dem_projection *projection)
{
    free(projection);
}

void dem_projection_to_lonlat(dem_projection *projection, size_t n, double *x, double *y)
{
    (void)projection;
    (void)n;
    (void)x;
    (void)y;
}

void dem_projection_from_lonlat(dem_projection *projection, size_t n, double *longitude, double *latitude)
{
    (void)projection;
    (void)n;
    (void)longitude;
    (void)latitude;
}

const char *dem_projection_engine(const dem_projection *projection)
{
    (void)projection;
    return "none";
}

/* ---- Heights, and what other files say of a CRS ---- */

const char dem_ellipsoidal_name[] = "ellipsoidal height";

int dem_crs_vertical_key(const tl_crs *crs)
{
    (void)crs;
    return 0;
}

int dem_crs_unit_key(double metres)
{
    (void)metres;
    return 0;
}

tl_status dem_crs_make_ellipsoidal(const tl_crs *crs, double metres, const char *path, const tl_crs **out,
                                   tl_error *error)
{
    (void)crs;
    (void)metres;
    (void)out;
    return lacks(path, "heights above the ellipsoid", error);
}

double dem_crs_prime_meridian(const tl_crs *crs)
{
    (void)crs;
    return 0;
}

tl_source *tl_geoid_create(const tl_source *source, const tl_geoid_options *options, tl_error *error)
{
    (void)options;
    lacks(source->info.name, "a geoid", error);
    return NULL;
}

char *dem_crs_keys_text(const tl_crs *crs)
{
    (void)crs;
    return NULL;
}

tl_status dem_crs_take_keys(tl_crs *crs, const char *text, const char *path, tl_error *error)
{
    (void)crs;
    (void)text;
    (void)path;
    (void)error;
    return TL_OK;
}

char *dem_crs_esri_text(const tl_crs *crs)
{
    (void)crs;
    return NULL;
}

int dem_crs_datum_code(const tl_crs *crs)
{
    (void)crs;
    return 0;
}
