#include "lib/out/place.h"

#include "dem/crs.h"
#include "dem/crs_keys.h"
#include "lib/base/number.h"

#include <math.h>
#include <string.h>

static void place_samples(const double gdal[6], tl_georef *georef)
{
    double t[6];
    memcpy(t, gdal, sizeof t);
    t[0] += 0.5 * (t[1] + t[2]); /* from the corner of the first cell to its middle */
    t[3] += 0.5 * (t[4] + t[5]);
    georef->located = tl_transform_is_usable(t);
    if (georef->located)
        memcpy(georef->transform, t, sizeof t);
}

tl_status out_place_read(const out_place *place, const char *path, tl_source_info *info, tl_error *error)
{
    info->georef = tl_georef_none();
    if (place->transform)
        place_samples(place->transform, &info->georef);
    if (place->height_unit > 0 && isfinite(place->height_unit))
        info->georef.height_unit = place->height_unit;
    tl_crs *crs = NULL;
    /* a CRS that cannot be made out leaves the heights readable, as in a GeoTIFF */
    if (place->wkt && dem_crs_from_text(place->wkt, path, &crs, error) == TL_ERROR_MEMORY)
        return TL_ERROR_MEMORY;
    info->georef.crs = crs;
    if (crs && place->keys && dem_crs_take_keys(crs, place->keys, path, error) != TL_OK)
        return TL_ERROR_MEMORY;
    tl_status status = dem_georef_measure(&info->georef, info->width, info->height, error);
    info->wraps = status == TL_OK && dem_georef_goes_around(&info->georef, info->width);
    return status;
}
