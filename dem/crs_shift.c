#include "dem/crs_shift.h"

#include <proj_experimental.h>
#include <stdbool.h>

#define RADIANS_PER_SECOND 4.84813681109536e-06

enum { TRANSLATION = 3, HELMERT = 7, TO_WGS84 = 2062 /* GeogTOWGS84GeoKey, which the standard lacks */ };

/* EPSG's parameters of Helmert's transformation in the convention of position vectors; the first three are those of a
 * translation. */
static const PJ_PARAM_DESCRIPTION helmert[HELMERT] = {
    {"X-axis translation", "EPSG", "8605", 0, "metre", 1, PJ_UT_LINEAR},
    {"Y-axis translation", "EPSG", "8606", 0, "metre", 1, PJ_UT_LINEAR},
    {"Z-axis translation", "EPSG", "8607", 0, "metre", 1, PJ_UT_LINEAR},
    {"X-axis rotation", "EPSG", "8608", 0, "arc-second", RADIANS_PER_SECOND, PJ_UT_ANGULAR},
    {"Y-axis rotation", "EPSG", "8609", 0, "arc-second", RADIANS_PER_SECOND, PJ_UT_ANGULAR},
    {"Z-axis rotation", "EPSG", "8610", 0, "arc-second", RADIANS_PER_SECOND, PJ_UT_ANGULAR},
    {"Scale difference", "EPSG", "8611", 0, "parts per million", 1e-6, PJ_UT_SCALE},
};

static PJ *shift_of(PJ_CONTEXT *context, PJ *from, PJ *to, const double *values, int count)
{
    PJ_PARAM_DESCRIPTION parameters[HELMERT];
    for (int k = 0; k < count; k++) {
        parameters[k] = helmert[k];
        parameters[k].value = values[k];
    }
    bool whole = count == HELMERT;
    return proj_create_transformation(context, "to WGS 84 by the keys", NULL, NULL, from, to, NULL,
                                      whole ? "Position Vector transformation (geog2D domain)"
                                            : "Geocentric translations (geog2D domain)",
                                      "EPSG", whole ? "9606" : "9603", count, parameters, -1);
}

PJ *dem_crs_bind(PJ_CONTEXT *context, PJ *crs, const dem_geokeys *keys)
{
    double values[HELMERT];
    size_t count = dem_geokeys_doubles(keys, TO_WGS84, values, HELMERT);
    if (!crs || (count != TRANSLATION && count != HELMERT))
        return crs;
    PJ *base = proj_crs_get_geodetic_crs(context, crs), *hub = proj_create(context, "EPSG:4326");
    PJ *shift = base && hub ? shift_of(context, base, hub, values, (int)count) : NULL;
    PJ *bound = shift ? proj_crs_create_bound_crs(context, crs, hub, shift) : NULL;
    proj_destroy(shift);
    proj_destroy(hub);
    proj_destroy(base);
    if (!bound)
        return crs;
    proj_destroy(crs);
    return bound;
}
