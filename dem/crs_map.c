#include "dem/crs_map.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

/* Codes of parameters in the EPSG registry. */
enum {
    NONE = 0,
    NATURAL_LATITUDE = 8801,
    NATURAL_LONGITUDE = 8802,
    NATURAL_SCALE = 8805,
    FALSE_EASTING = 8806,
    FALSE_NORTHING = 8807,
    ORIGIN_LATITUDE = 8821,
    ORIGIN_LONGITUDE = 8822,
    PARALLEL_1 = 8823,
    PARALLEL_2 = 8824,
    ORIGIN_EASTING = 8826,
    ORIGIN_NORTHING = 8827,
    POLAR_PARALLEL = 8832,
    POLAR_LONGITUDE = 8833,
    ELLIPSOID_SCALE = 1038,
};

/* The projection methods of the EPSG registry that GeographicLib has, and which parameter means what in each. A
 * parameter that a method does not have counts as 0, a scale as 1. */
static const struct method {
    int code;
    dem_map_kind kind;
    int latitude, longitude, easting, northing, scale, parallels[2];
} methods[] = {
    {9807,
     DEM_MAP_TRANSVERSE_MERCATOR,
     NATURAL_LATITUDE,
     NATURAL_LONGITUDE,
     FALSE_EASTING,
     FALSE_NORTHING,
     NATURAL_SCALE,
     {NONE, NONE}},
    /* Lambert with one parallel, the same with another origin, with two parallels, and Michigan's */
    {9801,
     DEM_MAP_CONFORMAL_CONIC,
     NATURAL_LATITUDE,
     NATURAL_LONGITUDE,
     FALSE_EASTING,
     FALSE_NORTHING,
     NATURAL_SCALE,
     {NATURAL_LATITUDE, NATURAL_LATITUDE}},
    {1102,
     DEM_MAP_CONFORMAL_CONIC,
     ORIGIN_LATITUDE,
     ORIGIN_LONGITUDE,
     ORIGIN_EASTING,
     ORIGIN_NORTHING,
     NATURAL_SCALE,
     {NATURAL_LATITUDE, NATURAL_LATITUDE}},
    {9802,
     DEM_MAP_CONFORMAL_CONIC,
     ORIGIN_LATITUDE,
     ORIGIN_LONGITUDE,
     ORIGIN_EASTING,
     ORIGIN_NORTHING,
     NONE,
     {PARALLEL_1, PARALLEL_2}},
    {1051,
     DEM_MAP_CONFORMAL_CONIC,
     ORIGIN_LATITUDE,
     ORIGIN_LONGITUDE,
     ORIGIN_EASTING,
     ORIGIN_NORTHING,
     ELLIPSOID_SCALE,
     {PARALLEL_1, PARALLEL_2}},
    {9822,
     DEM_MAP_ALBERS,
     ORIGIN_LATITUDE,
     ORIGIN_LONGITUDE,
     ORIGIN_EASTING,
     ORIGIN_NORTHING,
     NONE,
     {PARALLEL_1, PARALLEL_2}},
    /* variants A, B and C; B's origin is the pole */
    {9810,
     DEM_MAP_POLAR_STEREOGRAPHIC,
     NATURAL_LATITUDE,
     NATURAL_LONGITUDE,
     FALSE_EASTING,
     FALSE_NORTHING,
     NATURAL_SCALE,
     {NATURAL_LATITUDE, NONE}},
    {9829,
     DEM_MAP_POLAR_STEREOGRAPHIC,
     NONE,
     POLAR_LONGITUDE,
     FALSE_EASTING,
     FALSE_NORTHING,
     NONE,
     {POLAR_PARALLEL, NONE}},
    {9830,
     DEM_MAP_POLAR_STEREOGRAPHIC,
     POLAR_PARALLEL,
     POLAR_LONGITUDE,
     ORIGIN_EASTING,
     ORIGIN_NORTHING,
     NONE,
     {POLAR_PARALLEL, NONE}},
    {9804,
     DEM_MAP_MERCATOR,
     NATURAL_LATITUDE,
     NATURAL_LONGITUDE,
     FALSE_EASTING,
     FALSE_NORTHING,
     NATURAL_SCALE,
     {NONE, NONE}},
    {9805, DEM_MAP_MERCATOR, NONE, NATURAL_LONGITUDE, FALSE_EASTING, FALSE_NORTHING, NONE, {PARALLEL_1, NONE}},
    {1024,
     DEM_MAP_WEB_MERCATOR,
     NATURAL_LATITUDE,
     NATURAL_LONGITUDE,
     FALSE_EASTING,
     FALSE_NORTHING,
     NONE,
     {NONE, NONE}},
};

typedef struct reader {
    PJ_CONTEXT *context;
    const PJ *conversion;
} reader;

/* A parameter in degrees, metres or 1; `absent` where the conversion does not have it. */
static double parameter(const reader *r, int code, double absent)
{
    int count = proj_coordoperation_get_param_count(r->context, r->conversion);
    for (int k = 0; code && k < count; k++) {
        const char *authority = NULL, *text = NULL, *unit = NULL, *category = NULL;
        double value = 0, factor = 1;
        if (!proj_coordoperation_get_param(r->context, r->conversion, k, NULL, &authority, &text, &value, NULL, &factor,
                                           &unit, NULL, NULL, &category) ||
            !authority || strcasecmp(authority, "EPSG") != 0 || !text || atoi(text) != code)
            continue;
        if (!category || strcmp(category, "angular") != 0)
            return value * factor;
        /* the factor of the degree has 15 digits */
        return unit && strcmp(unit, "degree") == 0 ? value : value * factor * 57.295779513082320877;
    }
    return absent;
}

static const struct method *find_method(const reader *r)
{
    const char *authority = NULL, *code = NULL;
    if (!proj_coordoperation_get_method_info(r->context, r->conversion, NULL, &authority, &code) || !authority ||
        !code || strcasecmp(authority, "EPSG") != 0)
        return NULL;
    for (size_t k = 0; k < sizeof methods / sizeof *methods; k++)
        if (methods[k].code == atoi(code))
            return &methods[k];
    return NULL;
}

/* Both axes in the unit of the CRS, one to the east and one to the north; at a pole both run the same way. */
static bool axes_are_common(PJ_CONTEXT *context, const PJ *object, const tl_crs *crs, bool polar)
{
    PJ *system = proj_crs_get_coordinate_system(context, object);
    bool east = false, north = false, same = system && proj_cs_get_axis_count(context, system) == 2;
    const char *first = NULL;
    for (int k = 0; same && k < 2; k++) {
        const char *direction = NULL;
        double unit = 0;
        same = proj_cs_get_axis_info(context, system, k, NULL, NULL, &direction, &unit, NULL, NULL, NULL) &&
               direction && fabs(unit / crs->unit - 1) < 1e-12;
        if (!same)
            break;
        east |= strcmp(direction, "east") == 0;
        north |= strcmp(direction, "north") == 0;
        if (k == 1 && first)
            polar &= strcmp(first, direction) == 0 && (north || strcmp(direction, "south") == 0);
        first = direction;
    }
    proj_destroy(system);
    return same && ((east && north) || polar);
}

static void fill_in(const reader *r, const struct method *m, const tl_crs *crs, dem_map_definition *out)
{
    *out = (dem_map_definition){
        .kind = m->kind,
        .semi_major = crs->semi_major,
        .flattening = crs->flattening,
        .longitude = parameter(r, m->longitude, 0),
        .latitude = parameter(r, m->latitude, 0),
        .parallels = {parameter(r, m->parallels[0], 0), parameter(r, m->parallels[1], 0)},
        .scale = parameter(r, m->scale, 1),
        .easting = parameter(r, m->easting, 0),
        .northing = parameter(r, m->northing, 0),
        .unit = crs->unit,
    };
    if (m->kind == DEM_MAP_POLAR_STEREOGRAPHIC && m->latitude == NONE)
        out->latitude = copysign(90, out->parallels[0]);
}

bool dem_crs_map(PJ_CONTEXT *context, const PJ *object, const tl_crs *crs, dem_map_definition *out)
{
    reader r = {.context = context};
    PJ *conversion = proj_crs_get_coordoperation(context, object);
    r.conversion = conversion;
    const struct method *method = conversion ? find_method(&r) : NULL;
    bool found = method && axes_are_common(context, object, crs, method->kind == DEM_MAP_POLAR_STEREOGRAPHIC);
    if (found)
        fill_in(&r, method, crs, out);
    proj_destroy(conversion);
    /* a Mercator off the equator, and a polar one that is oblique, are matters of interpretation: PROJ's */
    if (found && method->kind == DEM_MAP_MERCATOR)
        found = out->latitude == 0;
    if (found && method->code == 9810)
        found = fabs(out->latitude) == 90;
    return found;
}
