/* How coarse the numbers of mesh files are. */
#include "lib/base/georef.h"
#include "lib/talus.h"

#include <math.h>
#include <string.h>

/* Half a unit in the last place, relative: of single precision, and of thirteen, twelve and nine decimal
 * digits. */
static const double SINGLE = 0x1p-24, THIRTEEN = 5e-13, TWELVE = 5e-12, NINE = 5e-9;

static bool is_ending(const char *path, const char *ending)
{
    const tl_format *format = tl_format_of(path);
    return format && strcmp(format->ending, ending) == 0;
}

/* Metres in a tangent plane: coordinates end half a raster from the middle, where the ground is a sag below it. */
static tl_rounding in_space(const tl_source_info *grid, bool text)
{
    const tl_georef *georef = &grid->georef;
    double width = (double)grid->width * georef->cell_x, height = (double)grid->height * georef->cell_y;
    double reach = 0.75 * (width + height); /* cells at the rim may be larger than in the middle */
    double radius = georef->crs && georef->crs->semi_major > 0 ? georef->crs->semi_major : 6.378e6;
    double along = (text ? TWELVE : SINGLE) * reach * sqrt(2.0), upright = text ? NINE : SINGLE;
    return (tl_rounding){.along = along / fmin(georef->cell_x, georef->cell_y),
                         .upright = upright * reach * reach / (2 * radius) / georef->height_unit,
                         .of_range = upright};
}

/* In each of three coordinates: thirteen digits of what no place of the Earth exceeds, or single precision of what the
 * raster is long. */
static tl_rounding from_centre(const tl_source_info *grid, bool single)
{
    const tl_georef *georef = &grid->georef;
    double radius = georef->crs && georef->crs->semi_major > 0 ? georef->crs->semi_major : 6.378e6;
    double reach = 1.5 * ((double)grid->width * georef->cell_x + (double)grid->height * georef->cell_y) + 1;
    double off = sqrt(3.0) * (single ? SINGLE * reach : THIRTEEN * 1.01 * radius);
    return (tl_rounding){.along = off / fmin(georef->cell_x, georef->cell_y), .upright = off / georef->height_unit};
}

/* A map's coordinates: whole in text, less than the raster is wide in single precision. */
static tl_rounding on_map(const tl_source_info *grid, bool text)
{
    const double *t = grid->georef.transform;
    double width = (double)grid->width, height = (double)grid->height;
    double x = fabs(t[1]) * width + fabs(t[2]) * height, y = fabs(t[4]) * width + fabs(t[5]) * height;
    /* one more for what is taken off in whole units */
    double off = text ? TWELVE * hypot(x + fabs(t[0]), y + fabs(t[3])) : SINGLE * hypot(x + 1, y + 1);
    double cell = fabs(t[1] * t[5] - t[2] * t[4]) / fmax(hypot(t[1], t[4]), hypot(t[2], t[5]));
    return (tl_rounding){.along = off / cell};
}

/* Coordinates of 16 bits add half a step in each direction: of what the raster takes at most, and a hundredth for what
 * steps and their ends round. */
static void add_steps(const tl_source_info *grid, tl_frame frame, tl_rounding *to)
{
    const double half = 0.505 / 65535;
    const tl_georef *georef = &grid->georef;
    const double *t = georef->transform;
    double width = (double)grid->width, height = (double)grid->height, cell = 1;
    double x = width, y = height; /* extents, in the unit that `cell` is in */
    to->of_range += half;
    if (frame == TL_FRAME_PIXEL && fmax(width, height) <= 65535)
        return; /* steps of one sample */
    if (frame == TL_FRAME_PROJECTED) {
        x = fabs(t[1]) * width + fabs(t[2]) * height, y = fabs(t[4]) * width + fabs(t[5]) * height;
        cell = fabs(t[1] * t[5] - t[2] * t[4]) / fmax(hypot(t[1], t[4]), hypot(t[2], t[5]));
    } else if (frame == TL_FRAME_ENU) {
        double reach = 0.75 * (width * georef->cell_x + height * georef->cell_y);
        double radius = georef->crs && georef->crs->semi_major > 0 ? georef->crs->semi_major : 6.378e6;
        x = y = 2 * reach;
        cell = fmin(georef->cell_x, georef->cell_y);
        to->upright += half * reach * reach / (2 * radius) / georef->height_unit;
    }
    to->along += half * hypot(x, y) / cell;
}

tl_rounding tl_write_rounding(const tl_source_info *grid, const char *path, const tl_write_options *options)
{
    bool text = is_ending(path, "obj"), glb = is_ending(path, "glb");
    tl_frame frame = options->frame;
    if (frame == TL_FRAME_DEFAULT)
        frame = grid->georef.crs && grid->georef.located ? TL_FRAME_ENU : TL_FRAME_PROJECTED;
    tl_rounding rounding = {0};
    if (frame == TL_FRAME_ECEF && !glb) /* which is as in the tangent plane */
        return from_centre(grid, is_ending(path, "stl"));
    if (frame == TL_FRAME_ECEF)
        frame = TL_FRAME_ENU;
    if (frame == TL_FRAME_ENU)
        rounding = in_space(grid, text);
    else if (frame == TL_FRAME_PROJECTED && !is_ending(path, "ply"))
        rounding = on_map(grid, text);
    if (glb && frame == TL_FRAME_PROJECTED)
        rounding.of_range = SINGLE; /* heights count from that of the first vertex */
    if (glb && options->coding != TL_CODING_PLAIN)
        add_steps(grid, frame, &rounding);
    return rounding;
}
