#include "dem/bend.h"

#include "lib/base/error.h"

#include <float.h>
#include <math.h>
#include <stdlib.h>

struct dem_space {
    const tl_georef *georef;
    dem_projection *projection;
    dem_local_frame *local;
    double step; /* of second differences, in cells */
};

bool dem_frame_bends(const tl_georef *georef, tl_frame frame)
{
    return (frame == TL_FRAME_DEFAULT || frame == TL_FRAME_ENU || frame == TL_FRAME_ECEF) && georef->crs &&
           georef->located;
}

static void lonlat(const dem_space *space, double i, double j, double *longitude, double *latitude)
{
    const double *t = space->georef->transform;
    *longitude = t[0] + t[1] * i + t[2] * j;
    *latitude = t[3] + t[4] * i + t[5] * j;
    dem_projection_to_lonlat(space->projection, 1, longitude, latitude);
}

/* Without its local frame. */
static dem_space *begin(const tl_georef *georef, const char *name, tl_error *error)
{
    dem_space *space = calloc(1, sizeof *space);
    if (!space) {
        tl_fail_memory(error, name);
        return NULL;
    }
    /* Second differences over a kilometre are a tenth of a metre where positions round to nanometres, and a kilometre
     * is 1/6000 of the radius of what is differentiated. */
    double cell = fmax(georef->cell_x, georef->cell_y);
    space->step = cell > 0 && cell <= DBL_MAX ? 1000 / cell : 1;
    space->georef = georef;
    space->projection = dem_projection_create(georef->crs, error);
    if (space->projection)
        return space;
    dem_space_destroy(space);
    return NULL;
}

dem_space *dem_space_create(const tl_georef *georef, int64_t width, int64_t height, const char *name, tl_error *error)
{
    dem_space *space = begin(georef, name, error);
    double x, y;
    if (!space)
        return NULL;
    lonlat(space, 0.5 * (double)(width - 1), 0.5 * (double)(height - 1), &x, &y);
    if (isfinite(x) && isfinite(y))
        space->local = dem_local_frame_create(georef->crs, x, y, 0, error);
    else
        tl_fail(error, TL_ERROR_DATA, "%s: the raster's middle has no longitude and latitude in %s; use %s", name,
                tl_crs_name(georef->crs), "--frame projected");
    if (space->local)
        return space;
    dem_space_destroy(space);
    return NULL;
}

dem_space *dem_space_create_at(const tl_georef *georef, const double origin[3], const char *name, tl_error *error)
{
    dem_space *space = begin(georef, name, error);
    if (space)
        space->local = dem_local_frame_create(georef->crs, origin[0], origin[1], origin[2], error);
    if (space && space->local)
        return space;
    dem_space_destroy(space);
    return NULL;
}

void dem_space_destroy(dem_space *space)
{
    if (!space)
        return;
    dem_projection_destroy(space->projection);
    dem_local_frame_destroy(space->local);
    free(space);
}

void dem_space_at(const dem_space *space, double i, double j, double h, double xyz[3], double up[3])
{
    double longitude, latitude;
    lonlat(space, i, j, &longitude, &latitude);
    dem_local_frame_forward(space->local, longitude, latitude, h, xyz);
    if (!up)
        return;
    const double rise = 0x1p20; /* metres: rounding of the difference is a part in 10^15 of it */
    dem_local_frame_forward(space->local, longitude, latitude, h + rise, up);
    for (int a = 0; a < 3; a++)
        up[a] = (up[a] - xyz[a]) / rise;
}

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* Parts a vector in its upright length and its level one. */
static void part(const double v[3], const double up[3], double *upright, double *level)
{
    *upright = dot(v, up);
    *level = sqrt(fmax(dot(v, v) - *upright * *upright, 0));
}

/* The smaller and the larger root of the symmetric matrix a b, b c. */
static void eigenvalues(double a, double b, double c, double *low, double *high)
{
    double middle = 0.5 * (a + c), spread = hypot(0.5 * (a - c), b);
    *low = middle - spread;
    *high = middle + spread;
}

/* From differences around one point. */
static dem_bend bend_at(const dem_space *space, double i, double j, double top)
{
    double at[3][3][3], up[3], first[2][3], second[3][3], d = space->step;
    for (int row = -1; row <= 1; row++)
        for (int column = -1; column <= 1; column++)
            dem_space_at(space, i + column * d, j + row * d, top, at[row + 1][column + 1], row || column ? NULL : up);
    for (int a = 0; a < 3; a++) {
        double twice = 2 * at[1][1][a];
        first[0][a] = (at[1][2][a] - at[1][0][a]) / (2 * d);
        first[1][a] = (at[2][1][a] - at[0][1][a]) / (2 * d);
        second[0][a] = (at[1][2][a] - twice + at[1][0][a]) / (d * d);
        second[1][a] = (at[2][2][a] - at[2][0][a] - at[0][2][a] + at[0][0][a]) / (4 * d * d);
        second[2][a] = (at[2][1][a] - twice + at[0][1][a]) / (d * d);
    }
    double upright[3], level[3], low, high;
    for (int k = 0; k < 3; k++)
        part(second[k], up, &upright[k], &level[k]);
    dem_bend bend;
    eigenvalues(upright[0], upright[1], upright[2], &low, &high);
    bend.upright = fmax(fabs(low), fabs(high));
    /* no unit direction (c, s) has more of the sum of c c, 2 c s and s s times these than their norm */
    bend.level = sqrt(level[0] * level[0] + 2 * level[1] * level[1] + level[2] * level[2]);
    eigenvalues(dot(first[0], first[0]), dot(first[0], first[1]), dot(first[1], first[1]), &low, &high);
    bend.cell = sqrt(fmax(low, 0));
    return bend;
}

/* Not a number, where there is no such place: as bad as can be. */
static double worst_if_nan(double a)
{
    return isnan(a) ? HUGE_VAL : a;
}

dem_bend dem_space_bend(const dem_space *space, double x, double y, double width, double height, double top)
{
    dem_bend most = {0, 0, HUGE_VAL}, least = {HUGE_VAL, HUGE_VAL, 0};
    for (int row = 1; row <= 3; row++)
        for (int column = 1; column <= 3; column++) {
            dem_bend at = bend_at(space, x + column * width / 4, y + row * height / 4, top);
            most = (dem_bend){fmax(most.upright, worst_if_nan(at.upright)), fmax(most.level, worst_if_nan(at.level)),
                              isnan(at.cell) ? 0 : fmin(most.cell, at.cell)};
            least = (dem_bend){fmin(least.upright, at.upright), fmin(least.level, at.level), fmax(least.cell, at.cell)};
        }
    /* What changes evenly changes by as much again on the way to the rim. A hundredth is for what does not, for the
     * turn of the vertical within a triangle, and for the rounding of all this. */
    most.upright = worst_if_nan((2 * most.upright - least.upright) * 1.01);
    most.level = worst_if_nan((2 * most.level - least.level) * 1.01);
    most.cell = fmax((2 * most.cell - least.cell) / 1.01, 0);
    return most;
}

dem_bend dem_bend_worse(dem_bend a, dem_bend b)
{
    return (dem_bend){fmax(a.upright, b.upright), fmax(a.level, b.level), fmin(a.cell, b.cell)};
}

double dem_bend_error(const dem_bend *bend, double length2, double rise)
{
    double slope = rise > 0 ? rise / bend->cell : 0;
    double shift = slope > 0 ? slope * (bend->level + 2 * slope * bend->upright) : 0;
    return worst_if_nan(length2 / 8 * (bend->upright + shift));
}
