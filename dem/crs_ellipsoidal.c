#include "dem/crs_ellipsoidal.h"

#include "dem/crs.h"
#include "dem/crs_map.h"
#include "lib/base/error.h"
#include "lib/base/number.h"
#include "lib/base/size.h"

#include <geotiff/geokeys.h>
#include <geotiff/geovalues.h>
#include <geotiff/xtiffio.h>
#include <math.h>
#include <proj_experimental.h>
#include <stdio.h>
#include <string.h>

const char dem_ellipsoidal_name[] = "ellipsoidal height";

static const double survey_foot = 1200.0 / 3937.0;

/* EPSG's codes of the ellipsoids that GeoTIFF 1.0 lists heights for, and how those are counted. */
enum { FIRST_LISTED = 7001, LAST_LISTED = 7033, TO_HEIGHTS = -2000 };

static int listed_heights(int ellipsoid)
{
    return ellipsoid >= FIRST_LISTED && ellipsoid <= LAST_LISTED ? ellipsoid + TO_HEIGHTS : 0;
}

static const char *horizontal_wkt(const tl_crs *crs)
{
    return crs->horizontal_wkt ? crs->horizontal_wkt : crs->wkt;
}

/* ---- PROJ's object ---- */

static const char *unit_name(double metres)
{
    return fabs(metres - 1) < 1e-12                ? "metre"
           : fabs(metres - 0.3048) < 1e-12         ? "foot"
           : fabs(metres / survey_foot - 1) < 1e-9 ? "US survey foot"
                                                   : "unknown";
}

/* Behind the bracket that closes the one before `text`; NULL where none does. Quoted text holds no brackets. */
static const char *closed(const char *text)
{
    bool quoted = false;
    for (int depth = 1; *text; text++) {
        quoted ^= *text == '"';
        depth += quoted ? 0 : (*text == '[') - (*text == ']');
        if (depth == 0)
            return text + 1;
    }
    return NULL;
}

/* PROJ changes the units of all axes of a map at once, so that of the heights is written into its text. */
static PJ *with_unit_of_height(PJ_CONTEXT *context, const char *wkt, double metres)
{
    static const char mark[] = "\"ellipsoidal height (h)\"", unit_mark[] = "LENGTHUNIT[";
    const char *axis = wkt ? strstr(wkt, mark) : NULL, *unit = axis ? strstr(axis, unit_mark) : NULL;
    const char *rest = unit ? closed(unit + strlen(unit_mark)) : NULL;
    size_t room = wkt ? strlen(wkt) + 128 : 0;
    char *text = rest ? malloc(room) : NULL, number[TL_NUMBER_TEXT];
    if (!text)
        return NULL;
    tl_number_text(metres, number);
    snprintf(text, room, "%.*sLENGTHUNIT[\"%s\",%s]%s", (int)(unit - wkt), wkt, unit_name(metres), number, rest);
    PJ *crs = proj_create(context, text);
    free(text);
    return crs;
}

static PJ *replace(PJ *old, PJ *made)
{
    if (!made)
        return old;
    proj_destroy(old);
    return made;
}

PJ *dem_crs_promote(PJ_CONTEXT *context, PJ *crs, double metres)
{
    static const char *const options[] = {"MULTILINE=NO", NULL};
    crs = replace(crs, proj_crs_promote_to_3D(context, NULL, crs));
    if (fabs(metres - 1) < 1e-12)
        return crs;
    if (proj_get_type(crs) == PJ_TYPE_GEOGRAPHIC_3D_CRS)
        return replace(crs, proj_crs_alter_cs_linear_unit(context, crs, unit_name(metres), metres, NULL, NULL));
    return replace(crs, with_unit_of_height(context, proj_as_wkt(context, crs, PJ_WKT2_2019, options), metres));
}

/* Whether the heights of a compound CRS are depths. */
static bool counts_down(PJ_CONTEXT *context, const PJ *whole)
{
    PJ *part = proj_get_type(whole) == PJ_TYPE_COMPOUND_CRS ? proj_crs_get_sub_crs(context, whole, 1) : NULL;
    PJ *system = part ? proj_crs_get_coordinate_system(context, part) : NULL;
    const char *direction = NULL;
    bool down = system && proj_cs_get_axis_info(context, system, 0, NULL, NULL, &direction, NULL, NULL, NULL, NULL) &&
                direction && strcmp(direction, "down") == 0;
    proj_destroy(system);
    proj_destroy(part);
    return down;
}

/* ---- keys ---- */

static int code_of(const PJ *object)
{
    const char *authority = object ? proj_get_id_auth_name(object, 0) : NULL;
    const char *code = authority && strcmp(authority, "EPSG") == 0 ? proj_get_id_code(object, 0) : NULL;
    return code ? atoi(code) : 0;
}

/* EPSG's code of an ellipsoid, by that of a CRS on it, or, for the two that most are on, by its shape. */
static int ellipsoid_code(PJ_CONTEXT *context, const tl_crs *crs)
{
    char text[16];
    snprintf(text, sizeof text, "%d", crs->epsg);
    PJ *listed = crs->epsg ? proj_create_from_database(context, "EPSG", text, PJ_CATEGORY_CRS, 0, NULL) : NULL;
    PJ *ellipsoid = listed ? proj_get_ellipsoid(context, listed) : NULL;
    int code = code_of(ellipsoid);
    proj_destroy(ellipsoid);
    proj_destroy(listed);
    if (code || fabs(crs->semi_major - 6378137) > 1e-3)
        return code;
    return fabs(1 / crs->flattening - 298.257223563) < 1e-7   ? Ellipse_WGS_84
           : fabs(1 / crs->flattening - 298.257222101) < 1e-7 ? Ellipse_GRS_1980
                                                              : 0;
}

/* What tells in a GeoTIFF that heights count from the ellipsoid of a CRS: the code of its longitudes, latitudes and
 * heights, or of the ellipsoid. */
static int key_of(PJ_CONTEXT *context, const PJ *object, const tl_crs *crs)
{
    int own = proj_get_type(object) == PJ_TYPE_GEOGRAPHIC_3D_CRS ? code_of(object) : 0;
    int listed = listed_heights(ellipsoid_code(context, crs));
    return own ? own : listed ? listed : KvUserDefined;
}

int dem_crs_vertical_key(const tl_crs *crs)
{
    if (!crs->vertical_name)
        return 0;
    if (strcmp(crs->vertical_name, dem_ellipsoidal_name) != 0)
        return crs->vertical_epsg > 0 && crs->vertical_epsg < KvUserDefined ? crs->vertical_epsg : KvUserDefined;
    PJ_CONTEXT *context = dem_proj_context();
    PJ *object = context ? proj_create(context, crs->wkt) : NULL;
    int key = object ? key_of(context, object, crs) : KvUserDefined;
    proj_destroy(object);
    if (context)
        proj_context_destroy(context);
    return key;
}

static bool is_vertical(uint16_t key)
{
    return key == VerticalCSTypeGeoKey || key == VerticalCitationGeoKey || key == VerticalDatumGeoKey ||
           key == VerticalUnitsGeoKey;
}

static void add_key(tl_crs *to, const uint16_t entry[4])
{
    memcpy(to->key_directory + to->key_directory_count, entry, 4 * sizeof *entry);
    to->key_directory_count += 4;
    to->key_directory[3]++; /* the header's count */
}

int dem_crs_unit_key(double metres)
{
    return fabs(metres - 1) < 1e-12                ? Linear_Meter
           : fabs(metres - 0.3048) < 1e-12         ? Linear_Foot
           : fabs(metres / survey_foot - 1) < 1e-9 ? Linear_Foot_US_Survey
                                                   : 0;
}

/* Room for as many keys as `from` has and three more, and copies of what they point to. */
static bool begin_keys(const tl_crs *from, tl_crs *to)
{
    static const uint16_t header[4] = {1, 1, 0, 0};
    size_t ascii = from->key_ascii ? strlen(from->key_ascii) : 0;
    to->key_directory = tl_alloc(from->key_directory_count + 16, sizeof *to->key_directory);
    to->key_doubles = tl_alloc(from->key_double_count, sizeof *to->key_doubles);
    to->key_ascii = malloc(ascii + sizeof dem_ellipsoidal_name + 1);
    if (!to->key_directory || !to->key_doubles || !to->key_ascii)
        return false;
    memcpy(to->key_directory, header, sizeof header);
    to->key_directory_count = 4;
    to->key_double_count = from->key_double_count;
    if (from->key_double_count)
        memcpy(to->key_doubles, from->key_doubles, from->key_double_count * sizeof *to->key_doubles);
    memcpy(to->key_ascii, ascii ? from->key_ascii : "", ascii + 1);
    return true;
}

/* The keys of the horizontal part, and what tells that heights count from the ellipsoid; false when out of memory. A
 * CRS without keys gets none. */
static bool make_keys(PJ_CONTEXT *context, const PJ *object, const tl_crs *from, double metres, tl_crs *to)
{
    int code = key_of(context, object, from), unit = dem_crs_unit_key(metres);
    if (from->key_directory_count < 4)
        return true;
    if (!begin_keys(from, to))
        return false;
    for (size_t at = 4; at + 4 <= from->key_directory_count; at += 4)
        if (!is_vertical(from->key_directory[at]))
            add_key(to, from->key_directory + at);
    add_key(to, (const uint16_t[4]){VerticalCSTypeGeoKey, 0, 1, (uint16_t)code});
    if (code == KvUserDefined) {
        size_t at = strlen(to->key_ascii);
        strcat(strcpy(to->key_ascii + at, dem_ellipsoidal_name), "|");
        add_key(to, (const uint16_t[4]){VerticalCitationGeoKey, TIFFTAG_GEOASCIIPARAMS,
                                        (uint16_t)sizeof dem_ellipsoidal_name, (uint16_t)at});
    }
    if (unit)
        add_key(to, (const uint16_t[4]){VerticalUnitsGeoKey, 0, 1, (uint16_t)unit});
    return true;
}

/* ---- ours ---- */

static tl_status make(PJ_CONTEXT *context, PJ *object, const tl_crs *crs, double metres, const char *path, tl_crs **out,
                      tl_error *error)
{
    static const char *const options[] = {"MULTILINE=NO", NULL};
    tl_crs *made = NULL;
    tl_status status = dem_crs_from_text(proj_as_wkt(context, object, PJ_WKT2_2019, options), path, &made, error);
    if (status != TL_OK)
        return status;
    char *name = strdup(crs->name);
    if (name) {
        free(made->name);
        made->name = name;
    }
    made->epsg = crs->epsg;
    if (!name || !make_keys(context, object, crs, metres, made)) {
        tl_crs_release(made);
        return tl_fail_memory(error, path);
    }
    *out = made;
    return TL_OK;
}

static tl_status check(PJ_CONTEXT *context, const tl_crs *crs, const char *path, tl_error *error)
{
    if (crs->vertical_name && strcmp(crs->vertical_name, dem_ellipsoidal_name) == 0)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: its heights count from the ellipsoid already (%s); take no geoid",
                       path, crs->name);
    PJ *whole = proj_create(context, crs->wkt);
    bool known = whole != NULL, down = known && counts_down(context, whole);
    proj_destroy(whole);
    if (down)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %s are depths; make heights of them before taking a geoid", path,
                       crs->vertical_name);
    return known ? TL_OK
                 : tl_fail(error, TL_ERROR_DATA,
                           "%s: PROJ does not know its CRS %s, so it can be given no other heights", path, crs->name);
}

tl_status dem_crs_make_ellipsoidal(const tl_crs *crs, double metres, const char *path, const tl_crs **out,
                                   tl_error *error)
{
    PJ_CONTEXT *context = dem_proj_context();
    if (!context)
        return tl_fail_memory(error, path);
    tl_crs *made = NULL;
    tl_status status = check(context, crs, path, error);
    PJ *object = status == TL_OK ? proj_create(context, horizontal_wkt(crs)) : NULL;
    if (status == TL_OK && !object)
        status = tl_fail(error, TL_ERROR_DATA, "%s: PROJ does not know its CRS %s", path, crs->name);
    if (object) {
        object = dem_crs_promote(context, object, metres);
        status = make(context, object, crs, metres, path, &made, error);
    }
    proj_destroy(object);
    proj_context_destroy(context);
    if (status == TL_OK)
        *out = made;
    return status;
}

double dem_crs_prime_meridian(const tl_crs *crs)
{
    double longitude = 0, unit = 0;
    PJ_CONTEXT *context = dem_proj_context();
    PJ *object = context ? proj_create(context, horizontal_wkt(crs)) : NULL;
    PJ *meridian = object ? proj_get_prime_meridian(context, object) : NULL;
    if (!meridian || !proj_prime_meridian_get_parameters(context, meridian, &longitude, &unit, NULL))
        longitude = unit = 0;
    proj_destroy(meridian);
    proj_destroy(object);
    if (context)
        proj_context_destroy(context);
    return longitude * unit * 57.295779513082320877;
}
