#include "lib/out/out.h"

#include "lib/base/size.h"

#include <math.h>

void out_gdal_transform(const tl_source_info *info, double out[6])
{
    const double *t = info->georef.transform;
    for (int k = 0; k < 6; k++)
        out[k] = t[k];
    /* GDAL's pixels are cells for both raster types: a point stands in the middle of its own */
    out[0] -= 0.5 * (t[1] + t[2]);
    out[3] -= 0.5 * (t[4] + t[5]);
}

out_tiling out_tiling_of(const tl_source *source)
{
    int64_t width = source->info.width, height = source->info.height;
    return (out_tiling){tl_div_up(width, OUT_TILE), tl_div_up(height, OUT_TILE), width, height};
}

tl_window out_tile_window(const out_tiling *tiling, uint64_t tile)
{
    int64_t x = (int64_t)(tile % (uint64_t)tiling->columns) * OUT_TILE;
    int64_t y = (int64_t)(tile / (uint64_t)tiling->columns) * OUT_TILE;
    return (tl_window){x, y, tl_int64_min(OUT_TILE, tiling->width - x), tl_int64_min(OUT_TILE, tiling->height - y)};
}

out_extent out_extent_empty(void)
{
    return (out_extent){INFINITY, -INFINITY};
}

/* In lanes, so that no comparison waits for the one before: compilers make vectors of them, of this many at least. */
void out_extent_add(out_extent *extent, const float *heights, size_t count)
{
    enum { LANES = 64 };
    float low[LANES], high[LANES];
    size_t i = 0;
    for (int k = 0; k < LANES; k++) {
        low[k] = extent->low;
        high[k] = extent->high;
    }
    /* comparisons with NaN are false, so voids fall through */
    for (; i + LANES <= count; i += LANES)
        for (int k = 0; k < LANES; k++) {
            float z = heights[i + (size_t)k];
            low[k] = z < low[k] ? z : low[k];
            high[k] = z > high[k] ? z : high[k];
        }
    for (; i < count; i++) {
        low[0] = heights[i] < low[0] ? heights[i] : low[0];
        high[0] = heights[i] > high[0] ? heights[i] : high[0];
    }
    for (int k = 0; k < LANES; k++) {
        extent->low = low[k] < extent->low ? low[k] : extent->low;
        extent->high = high[k] > extent->high ? high[k] : extent->high;
    }
}

void out_extent_merge(out_extent *extent, const out_extent *other)
{
    extent->low = fminf(extent->low, other->low);
    extent->high = fmaxf(extent->high, other->high);
}
