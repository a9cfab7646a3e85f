/* How coarse the numbers of mesh files are. */
#include "lib/base/georef.h"
#include "lib/talus.h"

#include <math.h>
#include <string.h>

/* Half a unit in the last place, relative: of single precision, and of twelve and nine decimal digits. */
static const double SINGLE = 0x1p-24, TWELVE = 5e-12, NINE = 5e-9;

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

tl_rounding tl_write_rounding(const tl_source_info *grid, const char *path, tl_frame frame)
{
    bool text = is_ending(path, "obj"), placed = grid->georef.crs && grid->georef.located;
    if (frame == TL_FRAME_ENU || (frame == TL_FRAME_DEFAULT && placed))
        return in_space(grid, text);
    if (frame == TL_FRAME_PIXEL || is_ending(path, "ply"))
        return (tl_rounding){0};
    tl_rounding map = on_map(grid, text);
    if (is_ending(path, "glb"))
        map.of_range = SINGLE; /* heights count from that of the first vertex */
    return map;
}
