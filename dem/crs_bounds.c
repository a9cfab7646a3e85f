/* Where a raster lies on its globe. */
#include "dem/crs.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

/* From sample positions to coordinates of the CRS. */
static void place(const tl_georef *georef, size_t count, double *i, double *j)
{
    const double *t = georef->transform;
    for (size_t k = 0; k < count; k++) {
        double x = t[0] + t[1] * i[k] + t[2] * j[k], y = t[3] + t[4] * i[k] + t[5] * j[k];
        i[k] = x;
        j[k] = y;
    }
}

static dem_projection *projection_of(const tl_georef *georef, tl_error *error)
{
    if (georef->crs && georef->located)
        return dem_projection_create(georef->crs, error);
    tl_fail(error, TL_ERROR_DATA, "the raster has no longitudes: its %s is not known",
            georef->crs ? "place" : "coordinate reference system");
    return NULL;
}

tl_status tl_georef_to_lonlat(const tl_georef *georef, size_t count, double *i, double *j, tl_error *error)
{
    tl_error own = {0};
    dem_projection *projection = projection_of(georef, &own);
    if (!projection) {
        if (error)
            *error = own;
        return own.status;
    }
    place(georef, count, i, j);
    dem_projection_to_lonlat(projection, count, i, j);
    dem_projection_destroy(projection);
    return TL_OK;
}

/* Points an edge: what lies between two of them is missed by at most the edge's own bend over EDGE squared. */
enum { EDGE = 64, RING = 4 * EDGE };

/* The outline of the cells, or of the samples of a point raster, in order. */
static void outline(const tl_source_info *info, double *i, double *j)
{
    double margin = info->type == TL_RASTER_AREA ? 0.5 : 0;
    double low = -margin, right = (double)(info->width - 1) + margin, bottom = (double)(info->height - 1) + margin;
    const double corners[5][2] = {{low, low}, {right, low}, {right, bottom}, {low, bottom}, {low, low}};
    for (int k = 0; k < RING; k++) {
        const double *from = corners[k / EDGE], *to = corners[k / EDGE + 1];
        double part = (double)(k % EDGE) / EDGE;
        i[k] = from[0] + part * (to[0] - from[0]);
        j[k] = from[1] + part * (to[1] - from[1]);
    }
}

/* Whether a pole (latitude 90 or -90) lies in the raster. */
static bool holds_pole(const tl_source_info *info, dem_projection *projection, double latitude)
{
    const double *t = info->georef.transform;
    double x = 0, y = latitude, determinant = t[1] * t[5] - t[2] * t[4];
    double margin = info->type == TL_RASTER_AREA ? 0.5 : 0;
    dem_projection_from_lonlat(projection, 1, &x, &y);
    double i = (t[5] * (x - t[0]) - t[2] * (y - t[3])) / determinant;
    double j = (t[1] * (y - t[3]) - t[4] * (x - t[0])) / determinant;
    return i >= -margin && i <= (double)(info->width - 1) + margin && j >= -margin &&
           j <= (double)(info->height - 1) + margin;
}

/* Longitudes of neighbours on the outline are less than half a turn apart. False: a point has none. */
static bool measure(double *longitude, const double *latitude, double bounds[4])
{
    bounds[0] = bounds[1] = (double)INFINITY;
    bounds[2] = bounds[3] = -(double)INFINITY;
    for (int k = 0; k < RING; k++) {
        if (!isfinite(longitude[k]) || !isfinite(latitude[k]))
            return false;
        if (k)
            longitude[k] -= 360 * round((longitude[k] - longitude[k - 1]) / 360);
        bounds[0] = fmin(bounds[0], longitude[k]);
        bounds[1] = fmin(bounds[1], latitude[k]);
        bounds[2] = fmax(bounds[2], longitude[k]);
        bounds[3] = fmax(bounds[3], latitude[k]);
    }
    /* the west comes to -180 ... 180, where -180 may have been rounded */
    double turns = 360 * floor((bounds[0] + 180) / 360 + 1e-9);
    bounds[0] -= turns;
    bounds[2] -= turns;
    bounds[1] = fmax(bounds[1], -90);
    bounds[3] = fmin(bounds[3], 90);
    return bounds[1] <= bounds[3];
}

tl_status tl_source_bounds(const tl_source_info *info, double bounds[4], tl_error *error)
{
    double longitude[RING], latitude[RING], found[4];
    tl_error own = {0};
    dem_projection *projection = projection_of(&info->georef, &own);
    if (!projection) {
        if (error)
            *error = own;
        return own.status;
    }
    outline(info, longitude, latitude);
    place(&info->georef, RING, longitude, latitude);
    dem_projection_to_lonlat(projection, RING, longitude, latitude);
    bool good = measure(longitude, latitude, found);
    for (int sign = -1; good && !info->georef.crs->geographic && sign <= 1; sign += 2)
        if (holds_pole(info, projection, 90 * sign)) {
            found[0] = -180;
            found[2] = 180;
            found[sign < 0 ? 1 : 3] = 90 * sign;
        }
    dem_projection_destroy(projection);
    if (!good)
        return tl_fail(error, TL_ERROR_DATA, "%s: a part of its rim has no longitude and latitude in %s", info->name,
                       tl_crs_name(info->georef.crs));
    memcpy(bounds, found, sizeof found);
    return TL_OK;
}
