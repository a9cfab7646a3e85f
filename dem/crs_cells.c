/* What needs no more of a CRS than its ellipsoid and units: local frames, and the size of cells. */
#include "dem/crs.h"
#include "dem/geographiclib.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>

struct dem_local_frame {
    void *tangent;
};

/* ---- Local frames ---- */

dem_local_frame *dem_local_frame_create(const tl_crs *crs, double longitude, double latitude, double height,
                                        tl_error *error)
{
    dem_local_frame *frame = calloc(1, sizeof *frame);
    if (!frame) {
        tl_fail_memory(error, crs->name);
        return NULL;
    }
    frame->tangent = dem_tangent_create(crs->semi_major, crs->flattening, longitude, latitude, height);
    if (frame->tangent)
        return frame;
    free(frame);
    tl_fail(error, TL_ERROR_ARGUMENT, "no local frame can be laid at longitude %.9g, latitude %.9g, height %.9g",
            longitude, latitude, height);
    return NULL;
}

void dem_local_frame_destroy(dem_local_frame *frame)
{
    if (!frame)
        return;
    dem_tangent_destroy(frame->tangent);
    free(frame);
}

void dem_local_frame_forward(const dem_local_frame *frame, double longitude, double latitude, double height,
                             double xyz[3])
{
    dem_tangent_forward(frame->tangent, longitude, latitude, height, xyz);
}

/* ---- Cells ---- */

/* Metres of one step (dx, dy) in degrees about the middle (x, y). A step of more than 10 degrees is measured on a part
 * of it, for the geodesic of a long one leaves the parallel far behind. */
static double geodesic_step(const tl_crs *crs, double x, double y, double dx, double dy)
{
    double largest = fmax(fabs(dx), fabs(dy)), part = largest > 10 ? 10 / largest : 1;
    double south = fmax(y - dy * part / 2, -90), north = fmin(y + dy * part / 2, 90);
    if (dy < 0) {
        south = fmin(y - dy * part / 2, 90);
        north = fmax(y + dy * part / 2, -90);
    }
    return dem_geodesic_length(crs->semi_major, crs->flattening, x - dx * part / 2, south, x + dx * part / 2, north) /
           part;
}

tl_crs *tl_crs_create(const char *definition, tl_error *error)
{
    tl_crs *made = NULL;
    return dem_crs_from_text(definition, definition, &made, error) == TL_OK ? made : NULL;
}

void tl_crs_destroy(tl_crs *crs)
{
    tl_crs_release(crs);
}

tl_status tl_georef_measure(tl_georef *georef, int64_t width, int64_t height, tl_error *error)
{
    return dem_georef_measure(georef, width, height, error);
}

tl_status dem_georef_measure(tl_georef *georef, int64_t width, int64_t height, tl_error *error)
{
    (void)error;
    const double *t = georef->transform;
    const tl_crs *crs = georef->crs;
    double unit = georef->located && crs ? crs->unit : 1;
    if (crs && crs->vertical_unit > 0 && georef->height_unit == 1)
        georef->height_unit = crs->vertical_unit;
    georef->cell_x = hypot(t[1], t[4]) * unit;
    georef->cell_y = hypot(t[2], t[5]) * unit;
    if (!georef->located || !crs || !crs->geographic)
        return TL_OK;
    double i = 0.5 * (double)(width - 1), j = 0.5 * (double)(height - 1);
    double x = t[0] + t[1] * i + t[2] * j, y = t[3] + t[4] * i + t[5] * j;
    double along_row = geodesic_step(crs, x, y, t[1], t[4]), along_column = geodesic_step(crs, x, y, t[2], t[5]);
    if (along_row > 0 && along_column > 0 && isfinite(along_row) && isfinite(along_column)) {
        georef->cell_x = along_row;
        georef->cell_y = along_column;
    }
    return TL_OK;
}

bool dem_georef_goes_around(const tl_georef *georef, int64_t width)
{
    const double *t = georef->transform;
    if (!georef->located || !georef->crs || !georef->crs->geographic || t[2] != 0 || t[4] != 0)
        return false;
    return fabs((double)width * fabs(t[1]) - 360) <= fabs(t[1]) / 2;
}
