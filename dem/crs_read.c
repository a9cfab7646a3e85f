/* CRSs from GeoTIFF keys and from text. libgeotiff makes sense of the keys, PROJ of everything else. */
#include "dem/crs.h"

#include "dem/crs_ellipsoidal.h"
#include "dem/crs_map.h"
#include "dem/crs_shift.h"
#include "dem/geokeys.h"
#include "dem/text.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <geotiff/geo_normalize.h>
#include <geotiff/geo_simpletags.h>
#include <geotiff/geo_tiffp.h>
#include <geotiff/geotiff.h>
#include <geotiff/geovalues.h>
#include <math.h>
#include <proj.h>
#include <proj_experimental.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>

static const double degrees_per_radian = 57.295779513082320877;

/* ---- From PROJ's object to ours ---- */

/* Takes `old` and gives what was made of it, or `old` itself where that failed. */
static PJ *replace(PJ *old, PJ *made)
{
    if (!made)
        return old;
    proj_destroy(old);
    return made;
}

/* The horizontal, two-dimensional CRS in a compound, bound or three-dimensional one. */
static PJ *horizontal(PJ_CONTEXT *context, PJ *crs)
{
    for (int depth = 0; crs && depth < 4; depth++) {
        PJ_TYPE type = proj_get_type(crs);
        if (type == PJ_TYPE_COMPOUND_CRS)
            crs = replace(crs, proj_crs_get_sub_crs(context, crs, 0));
        else if (type == PJ_TYPE_BOUND_CRS)
            crs = replace(crs, proj_get_source_crs(context, crs));
        else if (type == PJ_TYPE_GEOGRAPHIC_3D_CRS || type == PJ_TYPE_PROJECTED_CRS)
            return replace(crs, proj_crs_demote_to_2D(context, NULL, crs));
        else
            break;
    }
    return crs;
}

/* A CRS that lost its code with its third axis, with the code again; the CRS itself where EPSG has no other of the same
 * name and meaning. */
static PJ *with_code(PJ_CONTEXT *context, PJ *crs)
{
    int *confidence = NULL;
    PJ_OBJ_LIST *found =
        crs && !proj_get_id_code(crs, 0) ? proj_identify(context, crs, "EPSG", NULL, &confidence) : NULL;
    if (found && proj_list_get_count(found) && confidence && confidence[0] == 100)
        crs = replace(crs, proj_list_get(context, found, 0));
    proj_int_list_destroy(confidence);
    proj_list_destroy(found);
    return crs;
}

/* What one unit of an axis is in metres or radians; 0 where it cannot be told. */
static double unit_of_axis(PJ_CONTEXT *context, const PJ *crs, int axis)
{
    double unit = 0;
    PJ *system = proj_crs_get_coordinate_system(context, crs);
    if (system && !proj_cs_get_axis_info(context, system, axis, NULL, NULL, NULL, &unit, NULL, NULL, NULL))
        unit = 0;
    proj_destroy(system);
    return unit;
}

static double axis_unit(PJ_CONTEXT *context, const PJ *crs)
{
    return unit_of_axis(context, crs, 0);
}

static int axis_count(PJ_CONTEXT *context, const PJ *crs)
{
    PJ *system = proj_crs_get_coordinate_system(context, crs);
    int count = system ? proj_cs_get_axis_count(context, system) : 0;
    proj_destroy(system);
    return count;
}

static bool read_ellipsoid(PJ_CONTEXT *context, const PJ *crs, tl_crs *out)
{
    double inverse = 0;
    PJ *ellipsoid = proj_get_ellipsoid(context, crs);
    bool found = ellipsoid &&
                 proj_ellipsoid_get_parameters(context, ellipsoid, &out->semi_major, NULL, NULL, &inverse) &&
                 isfinite(out->semi_major) && out->semi_major > 0;
    out->flattening = inverse ? 1 / inverse : 0;
    proj_destroy(ellipsoid);
    return found;
}

static char *wkt_of(PJ_CONTEXT *context, const PJ *crs)
{
    const char *const options[] = {"MULTILINE=NO", NULL};
    const char *wkt = proj_as_wkt(context, crs, PJ_WKT2_2019, options);
    return strdup(wkt ? wkt : "");
}

static int epsg_of(const PJ *crs)
{
    const char *authority = proj_get_id_auth_name(crs, 0), *code = proj_get_id_code(crs, 0);
    return authority && code && strcmp(authority, "EPSG") == 0 ? atoi(code) : 0;
}

static bool read_names(PJ_CONTEXT *context, const PJ *crs, tl_crs *out)
{
    const char *name = proj_get_name(crs);
    out->name = strdup(name && *name ? name : "unknown");
    out->wkt = wkt_of(context, crs);
    out->epsg = epsg_of(crs);
    return out->name && out->wkt;
}

/* Fills in everything but the keys from a CRS that is projected, or geographic and in degrees. */
static tl_status describe(PJ_CONTEXT *context, const PJ *crs, const char *path, tl_crs **out, tl_error *error)
{
    tl_crs *made = tl_crs_allocate();
    if (!made || !read_names(context, crs, made)) {
        tl_crs_release(made);
        return tl_fail_memory(error, path);
    }
    made->geographic = proj_get_type(crs) != PJ_TYPE_PROJECTED_CRS;
    made->unit = made->geographic ? 1 : axis_unit(context, crs);
    if (!(made->unit > 0) || !read_ellipsoid(context, crs, made)) {
        tl_status status =
            tl_fail(error, TL_ERROR_DATA, "%s: its CRS %s has no sound unit and ellipsoid", path, made->name);
        tl_crs_release(made);
        return status;
    }
    *out = made;
    return TL_OK;
}

/* ---- Heights ---- */

/* The vertical CRS in a compound one, without what binds it to another; NULL where there is none. */
static PJ *vertical_part(PJ_CONTEXT *context, const PJ *whole)
{
    PJ *part = proj_get_type(whole) == PJ_TYPE_COMPOUND_CRS ? proj_crs_get_sub_crs(context, whole, 1) : NULL;
    if (part && proj_get_type(part) == PJ_TYPE_BOUND_CRS)
        part = replace(part, proj_get_source_crs(context, part));
    if (!part || proj_get_type(part) == PJ_TYPE_VERTICAL_CRS)
        return part;
    proj_destroy(part);
    return NULL;
}

/* Makes `wkt` that of the whole and keeps that of the horizontal part. */
static bool set_whole(PJ_CONTEXT *context, const PJ *whole, tl_crs *crs)
{
    char *wkt = whole ? wkt_of(context, whole) : NULL;
    if (!wkt)
        return false;
    if (!*wkt) {
        free(wkt);
        return true;
    }
    crs->horizontal_wkt = crs->wkt;
    crs->wkt = wkt;
    return true;
}

/* The vertical part of `whole`, or its third axis, or its datum shift, goes into a CRS that was made of its horizontal
 * part; false when out of memory. `altered`: the horizontal part has another unit now. */
static bool read_heights(PJ_CONTEXT *context, const PJ *whole, PJ *horizontal_crs, bool altered, tl_crs *crs)
{
    PJ *vertical = vertical_part(context, whole);
    bool good = true;
    if (vertical) {
        const char *name = proj_get_name(vertical);
        /* without its own code, for then its parts keep theirs in the text */
        PJ *rebuilt = proj_create_compound_crs(context, proj_get_name(whole), horizontal_crs, vertical);
        crs->vertical_name = strdup(name && *name ? name : "unknown");
        crs->vertical_epsg = epsg_of(vertical);
        crs->vertical_unit = axis_unit(context, vertical);
        good = crs->vertical_name && set_whole(context, rebuilt ? rebuilt : whole, crs);
        proj_destroy(rebuilt);
        proj_destroy(vertical);
    } else if (axis_count(context, whole) == 3 && !altered) {
        crs->vertical_name = strdup(dem_ellipsoidal_name);
        crs->vertical_unit = unit_of_axis(context, whole, 2);
        good = crs->vertical_name && set_whole(context, whole, crs);
    } else if (proj_get_type(whole) == PJ_TYPE_BOUND_CRS && !altered)
        good = set_whole(context, whole, crs);
    if (!isfinite(crs->vertical_unit) || crs->vertical_unit < 0)
        crs->vertical_unit = 0;
    return good;
}

/* ---- The whole ---- */

/* `whole` may be NULL. A geographic CRS gets degrees; *to_degrees is what its own unit was in degrees. */
static tl_status make_crs(PJ_CONTEXT *context, const PJ *whole, const char *path, tl_crs **out, double *to_degrees,
                          tl_error *error)
{
    PJ *crs = whole ? horizontal(context, proj_clone(context, whole)) : NULL;
    if (whole && proj_get_type(whole) != PJ_TYPE_COMPOUND_CRS && axis_count(context, whole) == 3)
        crs = with_code(context, crs);
    PJ_TYPE type = crs ? proj_get_type(crs) : PJ_TYPE_UNKNOWN;
    *to_degrees = 1;
    if (type != PJ_TYPE_PROJECTED_CRS && type != PJ_TYPE_GEOGRAPHIC_2D_CRS) {
        proj_destroy(crs);
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: its coordinate reference system is not one of maps or of longitude "
                       "and latitude that PROJ knows",
                       path);
    }
    if (type == PJ_TYPE_GEOGRAPHIC_2D_CRS) {
        double degrees = axis_unit(context, crs) * degrees_per_radian;
        if (degrees > 0 && fabs(degrees - 1) > 1e-9) { /* the degree itself is given with 15 digits */
            *to_degrees = degrees;
            crs = replace(
                crs, proj_crs_alter_cs_angular_unit(context, crs, "degree", 1 / degrees_per_radian, "EPSG", "9122"));
        }
    }
    tl_crs *made = NULL;
    tl_status status = describe(context, crs, path, &made, error);
    if (status == TL_OK && !read_heights(context, whole, crs, *to_degrees != 1, made)) {
        tl_crs_release(made);
        status = tl_fail_memory(error, path);
    }
    proj_destroy(crs);
    if (status == TL_OK)
        *out = made;
    return status;
}

/* The same; takes `whole`. */
static tl_status finish(PJ_CONTEXT *context, PJ *whole, const char *path, tl_crs **out, double *to_degrees,
                        tl_error *error)
{
    tl_status status = make_crs(context, whole, path, out, to_degrees, error);
    proj_destroy(whole);
    return status;
}

tl_status dem_crs_from_text(const char *text, const char *path, tl_crs **out, tl_error *error)
{
    double to_degrees;
    PJ_CONTEXT *context = dem_proj_context();
    if (!context)
        return tl_fail_memory(error, path);
    PJ *crs = proj_create(context, text);
    /* a PROJ string is an operation unless it says otherwise */
    if (crs && !proj_is_crs(crs) && strstr(text, "+proj=")) {
        char whole[1024];
        snprintf(whole, sizeof whole, "%s +type=crs", text);
        crs = replace(crs, proj_create(context, whole));
    }
    tl_status status = finish(context, crs, path, out, &to_degrees, error);
    proj_context_destroy(context);
    return status;
}

/* ---- From keys to PROJ's object ---- */

static bool is_code(unsigned code)
{
    return code > 0 && code < KvUserDefined;
}

static PJ *from_code(PJ_CONTEXT *context, unsigned code)
{
    char text[16];
    snprintf(text, sizeof text, "%u", code);
    PJ *crs = proj_create_from_database(context, "EPSG", text, PJ_CATEGORY_CRS, 0, NULL);
    return crs ? crs : proj_create_from_database(context, "ESRI", text, PJ_CATEGORY_CRS, 0, NULL);
}

/* A citation's name: what stands before the first bar, without ESRI's "PCS Name = ". */
static void read_citation(const dem_geokeys *keys, uint16_t key, const char *prefix, char *name, size_t size)
{
    char *text = dem_geokeys_text(keys, key);
    const char *begin = text ? text : "";
    if (strncmp(begin, prefix, strlen(prefix)) == 0)
        begin += strlen(prefix);
    size_t length = strcspn(begin, "|");
    if (length && length < size && !memchr(begin, '\n', length))
        snprintf(name, size, "%.*s", (int)length, begin);
    free(text);
}

static PJ *degrees_system(PJ_CONTEXT *context)
{
    return proj_create_ellipsoidal_2D_cs(context, PJ_ELLPS2D_LATITUDE_LONGITUDE, NULL, 0);
}

/* The geographic CRS under the keys: by its code, by its datum's, or by its ellipsoid. */
static PJ *geographic_from(PJ_CONTEXT *context, const GTIFDefn *definition, const dem_geokeys *keys)
{
    PJ *crs = is_code((uint16_t)definition->GCS) ? from_code(context, (uint16_t)definition->GCS) : NULL;
    if (crs || !(definition->SemiMajor > 0) || !(definition->SemiMinor > 0))
        return crs;
    char name[128] = "unknown", code[16];
    read_citation(keys, GeogCitationGeoKey, "GCS Name = ", name, sizeof name);
    PJ *system = degrees_system(context), *datum = NULL;
    snprintf(code, sizeof code, "%u", (unsigned)(uint16_t)definition->Datum);
    if (is_code((uint16_t)definition->Datum))
        datum = proj_create_from_database(context, "EPSG", code, PJ_CATEGORY_DATUM, 0, NULL);
    double flat = definition->SemiMajor - definition->SemiMinor;
    if (datum)
        crs = proj_create_geographic_crs_from_datum(context, name, datum, system);
    if (!crs)
        crs = proj_create_geographic_crs(context, name, name, name, definition->SemiMajor,
                                         flat > 0 ? definition->SemiMajor / flat : 0,
                                         definition->PMLongToGreenwich == 0 ? "Greenwich" : "unknown",
                                         definition->PMLongToGreenwich, "degree", 1 / degrees_per_radian, system);
    proj_destroy(datum);
    proj_destroy(system);
    return crs;
}

/* libgeotiff prints parameters with few digits (k with 6, metres with 3). The parameter that a printed number stands
 * for, or the number itself where it is none. */
static double full_precision(const GTIFDefn *definition, const char *digits, double printed)
{
    const char *point = strchr(digits, '.');
    int decimals = point ? (int)strspn(point + 1, "0123456789") : 0;
    double best = printed, distance = 0.6 * pow(10, -decimals);
    for (int k = 0; k < definition->nParms && k < MAX_GTIF_PROJPARMS; k++) {
        double off = fabs(definition->ProjParm[k] - printed);
        if (off < distance) {
            distance = off;
            best = definition->ProjParm[k];
        }
    }
    return best;
}

/* The PROJ string of a definition, at full precision and in metres; false where libgeotiff has none. */
static bool proj_string(GTIFDefn *definition, char *out, size_t size)
{
    static const char *const precise[] = {"+k=",   "+k_0=",  "+x_0=",   "+y_0=",  "+lat_",
                                          "+lon_", "+lonc=", "+alpha=", "+gamma="};
    /* units are left out below; a code that the database does not have would make PROJ print */
    const short unit = definition->UOMLength;
    definition->UOMLength = Linear_Meter;
    char *text = GTIFGetProj4Defn(definition), *rest = NULL;
    definition->UOMLength = unit;
    size_t length = 0;
    if (!text)
        return false;
    for (char *word = strtok_r(text, " ", &rest); word && length < size; word = strtok_r(NULL, " ", &rest)) {
        const char *value = strchr(word, '=');
        bool number = false;
        if (strncmp(word, "+units", 6) == 0 || strncmp(word, "+to_meter", 9) == 0)
            continue;
        for (size_t k = 0; value && k < sizeof precise / sizeof *precise; k++)
            number |= strncmp(word, precise[k], strlen(precise[k])) == 0;
        if (number)
            length += (size_t)snprintf(out + length, size - length, "%.*s=%.17g ", (int)(value - word), word,
                                       full_precision(definition, value, strtod(value + 1, NULL)));
        else
            length += (size_t)snprintf(out + length, size - length, "%s ", word);
    }
    GTIFFreeMemory(text);
    if (length + sizeof "+units=m +type=crs" > size)
        return false;
    strcpy(out + length, "+units=m +type=crs");
    return strstr(out, "+proj=") && !strstr(out, "+proj=longlat");
}

/* Gives the axes of a projected CRS the file's unit, where it is another. */
static PJ *with_unit(PJ_CONTEXT *context, PJ *crs, double metres)
{
    double own = crs ? axis_unit(context, crs) : 0;
    if (!(own > 0) || !(metres > 0) || fabs(metres / own - 1) < 1e-9)
        return crs;
    const char *name = fabs(metres - 0.3048) < 1e-12           ? "foot"
                       : fabs(metres - 1200.0 / 3937.0) < 1e-9 ? "US survey foot"
                       : metres == 1                           ? "metre"
                                                               : "unknown";
    return replace(crs, proj_crs_alter_cs_linear_unit(context, crs, name, metres, NULL, NULL));
}

static PJ *projected_from_parameters(PJ_CONTEXT *context, GTIFDefn *definition, const dem_geokeys *keys,
                                     const char *name)
{
    char text[1024];
    if (!proj_string(definition, text, sizeof text))
        return NULL;
    PJ *crs = proj_create(context, text), *base = geographic_from(context, definition, keys);
    crs = horizontal(context, crs);
    if (crs && proj_get_type(crs) == PJ_TYPE_PROJECTED_CRS) {
        if (base)
            crs = replace(crs, proj_crs_alter_geodetic_crs(context, crs, base));
        crs = replace(crs, proj_alter_name(context, crs, name));
    }
    proj_destroy(base);
    return with_unit(context, crs, definition->UOMLengthInMeters);
}

/* ArcGIS writes the WKT itself into a citation. */
static PJ *from_esri_text(PJ_CONTEXT *context, const dem_geokeys *keys)
{
    static const uint16_t citations[] = {GTCitationGeoKey, PCSCitationGeoKey};
    static const char prefix[] = "ESRI PE String = ";
    PJ *crs = NULL;
    for (size_t k = 0; !crs && k < 2; k++) {
        char *text = dem_geokeys_text(keys, citations[k]);
        if (text && strncmp(text, prefix, strlen(prefix)) == 0)
            crs = proj_create(context, text + strlen(prefix));
        free(text);
    }
    return crs;
}

/* The unit of length that ERDAS IMAGINE names in a citation, against which the code of the CRS does not count; 0 where
 * there is none. */
static double imagine_unit(const dem_geokeys *keys)
{
    static const struct {
        const char *name;
        double metres;
    } units[] = {{"us_survey_feet", 1200.0 / 3937.0},
                 {"us_survey_foot", 1200.0 / 3937.0},
                 {"international_feet", 0.3048},
                 {"international_foot", 0.3048},
                 {"feet", 0.3048},
                 {"meters", 1}};
    static const char mark[] = "GeoTIFF Units = ";
    const char *unit = strstr(keys->ascii, mark);
    for (size_t k = 0; unit && k < sizeof units / sizeof *units; k++)
        if (strncasecmp(unit + strlen(mark), units[k].name, strlen(units[k].name)) == 0)
            return units[k].metres;
    return 0;
}

static PJ *projected_from(PJ_CONTEXT *context, GTIFDefn *definition, const dem_geokeys *keys)
{
    uint16_t code = 0, unit;
    char name[128] = "unknown";
    dem_geokeys_short(keys, ProjectedCSTypeGeoKey, &code);
    PJ *crs = is_code(code) ? from_code(context, code) : NULL;
    if (crs && dem_geokeys_short(keys, ProjLinearUnitsGeoKey, &unit))
        return with_unit(context, crs, definition->UOMLengthInMeters);
    if (crs)
        return with_unit(context, crs, imagine_unit(keys));
    read_citation(keys, GTCitationGeoKey, "PCS Name = ", name, sizeof name);
    read_citation(keys, PCSCitationGeoKey, "PCS Name = ", name, sizeof name);
    /* written by ArcGIS with the parameters of the ellipsoidal Mercator, which it is not */
    if (strncmp(name, "WGS_1984_Web_Mercator", 21) == 0)
        return from_code(context, 3857);
    return projected_from_parameters(context, definition, keys, name);
}

static PJ *from_definition(PJ_CONTEXT *context, GTIFDefn *definition, const dem_geokeys *keys)
{
    uint16_t model = 0, projected = 0, geographic = 0;
    dem_geokeys_short(keys, GTModelTypeGeoKey, &model);
    dem_geokeys_short(keys, ProjectedCSTypeGeoKey, &projected);
    dem_geokeys_short(keys, GeographicTypeGeoKey, &geographic);
    PJ *crs = is_code(projected) ? NULL : from_esri_text(context, keys);
    if (crs)
        return crs;
    if (model != ModelTypeProjected && model != ModelTypeGeographic)
        model = projected ? ModelTypeProjected : geographic ? ModelTypeGeographic : model;
    if (model == ModelTypeProjected)
        return projected_from(context, definition, keys);
    return model == ModelTypeGeographic ? geographic_from(context, definition, keys) : NULL;
}

/* ---- Heights by their keys ---- */

/* The codes that GeoTIFF 1.0 lists: 5101 to 5106 name what EPSG has as 5701 to 5706, 5001 to 5033 heights above
 * ellipsoids. */
enum { FIRST_ELLIPSOID = 5001, LAST_ELLIPSOID = 5033, FIRST_OLD = 5101, LAST_OLD = 5106, OLD_TO_EPSG = 600 };

/* The vertical CRS of a code; NULL where that is none. A code of longitudes, latitudes and heights, as 4979, stands for
 * heights above their ellipsoid too. */
static PJ *vertical_from_code(PJ_CONTEXT *context, unsigned code, bool *ellipsoidal)
{
    *ellipsoidal = code >= FIRST_ELLIPSOID && code <= LAST_ELLIPSOID;
    if (code >= FIRST_OLD && code <= LAST_OLD)
        code += OLD_TO_EPSG;
    PJ *crs = is_code(code) && !*ellipsoidal ? from_code(context, code) : NULL;
    if (!crs || proj_get_type(crs) == PJ_TYPE_VERTICAL_CRS)
        return crs;
    *ellipsoidal = proj_get_type(crs) == PJ_TYPE_GEOGRAPHIC_3D_CRS;
    proj_destroy(crs);
    return NULL;
}

/* One that the file names without a code. */
static PJ *vertical_from_name(PJ_CONTEXT *context, const dem_geokeys *keys)
{
    char name[128] = "", code[16];
    uint16_t datum_code = 0;
    read_citation(keys, VerticalCitationGeoKey, "VCS Name = ", name, sizeof name);
    if (!*name)
        return NULL;
    dem_geokeys_short(keys, VerticalDatumGeoKey, &datum_code);
    snprintf(code, sizeof code, "%u", (unsigned)datum_code);
    PJ *datum =
        is_code(datum_code) ? proj_create_from_database(context, "EPSG", code, PJ_CATEGORY_DATUM, 0, NULL) : NULL;
    PJ *crs = proj_create_vertical_crs(context, name, datum ? proj_get_name(datum) : name, "metre", 1);
    proj_destroy(datum);
    return crs;
}

static bool has_heights(const dem_geokeys *keys)
{
    uint16_t code = 0;
    char *name = dem_geokeys_text(keys, VerticalCitationGeoKey);
    bool any = name || (dem_geokeys_short(keys, VerticalCSTypeGeoKey, &code) && code);
    free(name);
    return any;
}

/* Takes a CRS (or NULL) and adds the heights that the keys speak of. */
static PJ *with_heights(PJ_CONTEXT *context, PJ *crs, const dem_geokeys *keys)
{
    uint16_t code = 0, unit = 0;
    bool ellipsoidal;
    dem_geokeys_short(keys, VerticalCSTypeGeoKey, &code);
    crs = horizontal(context, crs);
    if (!crs)
        return NULL;
    PJ *vertical = vertical_from_code(context, code, &ellipsoidal);
    char citation[64] = "";
    read_citation(keys, VerticalCitationGeoKey, "", citation, sizeof citation);
    if (ellipsoidal || (!vertical && strcasecmp(citation, dem_ellipsoidal_name) == 0))
        return dem_crs_promote(context, crs, dem_geokeys_height_unit(keys));
    if (!vertical)
        vertical = vertical_from_name(context, keys);
    if (!vertical)
        return crs;
    if (dem_geokeys_short(keys, VerticalUnitsGeoKey, &unit) && is_code(unit))
        vertical = with_unit(context, vertical, dem_geokeys_height_unit(keys));
    char name[320];
    snprintf(name, sizeof name, "%.150s + %.150s", proj_get_name(crs), proj_get_name(vertical));
    crs = replace(crs, proj_create_compound_crs(context, name, crs, vertical));
    proj_destroy(vertical);
    return crs;
}

/* ---- From a file to keys ---- */

__attribute__((format(printf, 3, 4))) static void ignore_message(GTIF *gtif, int level, const char *message, ...)
{
    (void)gtif;
    (void)level;
    (void)message;
}

/* A copy of the directory whose unit of angles PROJ knows: about another one PROJ prints, and it counts as degrees. */
static uint16_t *known_directory(PJ_CONTEXT *context, const dem_geokeys *keys)
{
    uint16_t *directory = malloc(keys->directory_count * sizeof *directory);
    if (!directory)
        return NULL;
    memcpy(directory, keys->directory, keys->directory_count * sizeof *directory);
    for (size_t i = 4; i + 4 <= keys->directory_count; i += 4) {
        uint16_t *entry = directory + i;
        char code[8];
        snprintf(code, sizeof code, "%u", entry[3]);
        if (entry[0] == GeogAngularUnitsGeoKey && entry[1] == 0 && entry[3] != KvUserDefined &&
            !proj_uom_get_info_from_database(context, "EPSG", code, NULL, NULL, NULL))
            entry[3] = Angular_Degree;
    }
    return directory;
}

/* libgeotiff over our checked copy of the keys, so that it neither meets unsound ones nor depends on how the process
 * has set up libtiff. */
static PJ *crs_from_keys(PJ_CONTEXT *context, const dem_geokeys *keys, uint16_t *directory, bool *starved)
{
    PJ *crs = NULL;
    TIFFMethod methods;
    ST_TIFF *tags = ST_Create();
    *starved = !tags;
    if (!tags)
        return NULL;
    ST_SetKey(tags, TIFFTAG_GEOKEYDIRECTORY, (int)keys->directory_count, STT_SHORT, directory); /* it copies */
    if (keys->double_count)
        ST_SetKey(tags, TIFFTAG_GEODOUBLEPARAMS, (int)keys->double_count, STT_DOUBLE, keys->doubles);
    if (keys->ascii_count)
        ST_SetKey(tags, TIFFTAG_GEOASCIIPARAMS, (int)keys->ascii_count + 1, STT_ASCII, keys->ascii);
    GTIFSetSimpleTagsMethods(&methods);
    GTIF *gtif = GTIFNewWithMethodsEx(tags, &methods, ignore_message, NULL);
    GTIFDefn *definition = GTIFAllocDefn();
    *starved = !definition;
    if (gtif && definition) {
        GTIFAttachPROJContext(gtif, context);
        GTIFGetDefn(gtif, definition);
        crs = from_definition(context, definition, keys);
        if (has_heights(keys))
            crs = with_heights(context, crs, keys);
        else if (!is_code((uint16_t)definition->GCS)) /* EPSG knows better where a code is given */
            crs = dem_crs_bind(context, crs, keys);
    }
    GTIFFreeDefn(definition);
    if (gtif)
        GTIFFree(gtif);
    ST_Destroy(tags);
    return crs;
}

/* Degrees in one unit of the file's angles by their own key; 0 where it says nothing. */
static double angle_in_degrees(const dem_geokeys *keys)
{
    uint16_t code = 0;
    double radians = 0;
    dem_geokeys_short(keys, GeogAngularUnitsGeoKey, &code);
    switch (code) {
    case Angular_Radian:
        return degrees_per_radian;
    case Angular_Degree:
        return 1;
    case Angular_Arc_Minute:
        return 1.0 / 60;
    case Angular_Arc_Second:
        return 1.0 / 3600;
    case Angular_Grad:
    case Angular_Gon:
        return 0.9;
    case KvUserDefined:
        dem_geokeys_double(keys, GeogAngularUnitSizeGeoKey, &radians);
        radians *= degrees_per_radian;
        if (!(radians > 0) || !isfinite(radians))
            return 0;
        return fabs(radians - 1) < 1e-9 ? 1 : radians;
    default:
        return 0;
    }
}

/* Moves the keys into the CRS, with the unit that its coordinates have now. */
static void keep_keys(tl_crs *crs, dem_geokeys *keys, bool in_degrees)
{
    for (size_t i = 4; in_degrees && i + 4 <= keys->directory_count; i += 4)
        if (keys->directory[i] == GeogAngularUnitsGeoKey && keys->directory[i + 1] == 0)
            keys->directory[i + 3] = Angular_Degree;
    crs->key_directory = keys->directory;
    crs->key_doubles = keys->doubles;
    crs->key_ascii = keys->ascii;
    crs->key_directory_count = keys->directory_count;
    crs->key_double_count = keys->double_count;
    *keys = (dem_geokeys){0};
}

static tl_status from_keys(dem_geokeys *keys, const char *path, tl_crs **out, double *scale, tl_error *error)
{
    PJ_CONTEXT *context = dem_proj_context();
    if (!context)
        return tl_fail_memory(error, path);
    uint16_t *directory = known_directory(context, keys);
    if (!directory) {
        proj_context_destroy(context);
        return tl_fail_memory(error, path);
    }
    dem_locale locale = dem_locale_enter();
    tl_crs *crs = NULL;
    bool starved;
    PJ *made = crs_from_keys(context, keys, directory, &starved);
    free(directory);
    tl_status status = starved ? tl_fail_memory(error, path) : finish(context, made, path, &crs, scale, error);
    dem_locale_leave(locale);
    proj_context_destroy(context);
    if (status != TL_OK)
        return status;
    uint16_t height_unit;
    if (crs->vertical_name && dem_geokeys_short(keys, VerticalUnitsGeoKey, &height_unit) && is_code(height_unit))
        crs->vertical_unit = dem_geokeys_height_unit(keys);
    double said = angle_in_degrees(keys);
    if (crs->geographic && said > 0)
        *scale = said;
    keep_keys(crs, keys, crs->geographic && *scale != 1);
    *out = crs;
    return TL_OK;
}

tl_status dem_crs_from_tiff_scaled(struct tiff *tiff, const char *path, tl_crs **out, double *scale, tl_error *error)
{
    dem_geokeys keys;
    tl_crs *crs = NULL;
    *scale = 1;
    tl_status status = dem_geokeys_read(tiff, path, &keys, error);
    if (status == TL_OK && keys.directory_count > 4) {
        uint16_t model, code;
        bool named = dem_geokeys_short(&keys, GTModelTypeGeoKey, &model) ||
                     dem_geokeys_short(&keys, ProjectedCSTypeGeoKey, &code) ||
                     dem_geokeys_short(&keys, GeographicTypeGeoKey, &code);
        if (named)
            status = from_keys(&keys, path, &crs, scale, error);
    }
    dem_geokeys_finish(&keys);
    if (status == TL_OK)
        *out = crs;
    return status;
}

tl_status dem_crs_from_tiff(struct tiff *tiff, const char *path, tl_crs **out, tl_error *error)
{
    double scale;
    return dem_crs_from_tiff_scaled(tiff, path, out, &scale, error);
}
