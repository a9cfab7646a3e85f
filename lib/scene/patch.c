#include "lib/scene/patch.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

void scene_patch_free(scene_patch *patch)
{
    free(patch->heights);
    free(patch->known);
    *patch = (scene_patch){0};
}

static bool inside_columns(const tl_source_info *dem, fbm_window w)
{
    return w.i >= 0 && w.i + (int64_t)w.width <= dem->width;
}

/* Whether the DEM has all of the window; one that goes around the globe has every column. */
static bool inside(const tl_source_info *dem, fbm_window w)
{
    return (dem->wraps || inside_columns(dem, w)) && w.j >= 0 && w.j + (int64_t)w.height <= dem->height;
}

fbm_window scene_widened(fbm_window w, int by)
{
    w.i -= by;
    w.j -= by;
    w.width += 2 * (size_t)by;
    w.height += 2 * (size_t)by;
    w.stride = w.width;
    return w;
}

/* Reads a part of the DEM to where it belongs in the window: its first sample to `out`. */
static tl_status read_part(const tl_source *dem, tl_window part, float *out, size_t stride, tl_error *error)
{
    float *heights = tl_alloc_grid(part.width, part.height, sizeof *heights);
    if (!heights)
        return tl_fail_memory(error, dem->info.name);
    tl_status status = tl_source_read(dem, 0, part, heights, error);
    for (int64_t row = 0; row < part.height && status == TL_OK; row++)
        memcpy(out + (size_t)row * stride, heights + row * part.width, (size_t)part.width * sizeof *out);
    free(heights);
    return status;
}

/* The rows y0 ... y1 - 1 of a window, column by column around the globe. */
static tl_status read_around(const tl_source *dem, fbm_window w, int64_t y0, int64_t y1, float *out, tl_error *error)
{
    int64_t around = dem->info.width, x = (w.i % around + around) % around;
    tl_status status = TL_OK;
    for (int64_t done = 0, n; done < (int64_t)w.width && status == TL_OK; done += n, x = 0) {
        n = tl_int64_min(around - x, (int64_t)w.width - done);
        status = read_part(dem, (tl_window){x, y0, n, y1 - y0}, out + done, w.width, error);
    }
    return status;
}

/* Reads what the DEM has of the window; the rest becomes NaN. */
static tl_status read_ground(const tl_source *dem, fbm_window w, float *out, tl_error *error)
{
    bool columns = inside_columns(&dem->info, w);
    if (columns && inside(&dem->info, w))
        return tl_source_read(dem, 0, (tl_window){w.i, w.j, (int64_t)w.width, (int64_t)w.height}, out, error);
    for (size_t k = 0; k < w.width * w.height; k++)
        out[k] = NAN;
    int64_t y0 = tl_int64_max(w.j, 0), y1 = tl_int64_min(w.j + (int64_t)w.height, dem->info.height);
    if (y0 >= y1)
        return TL_OK;
    float *first = out + (size_t)(y0 - w.j) * w.width;
    if (dem->info.wraps && !columns)
        return read_around(dem, w, y0, y1, first, error);
    int64_t x0 = tl_int64_max(w.i, 0), x1 = tl_int64_min(w.i + (int64_t)w.width, dem->info.width);
    if (x0 >= x1)
        return TL_OK;
    return read_part(dem, (tl_window){x0, y0, x1 - x0, y1 - y0}, first + (x0 - w.i), w.width, error);
}

/* The height of an unknown sample, from its neighbours that are known after `pass` passes: the mean, over the eight
 * directions, of the nearest height and `trend` times the step to it. For fBm on a line the best guess behind two known
 * samples has trend 2^(2H-1) - 1: flat at H = 1/2, straight at H = 1. NaN where no neighbour is known. */
static float grow_sample(scene_growth growth, const scene_patch *g, size_t x, size_t y, unsigned char pass)
{
    float sum = 0;
    int count = 0;
    for (int dy = -1; dy <= 1; dy++)
        for (int dx = -1; dx <= 1; dx++) {
            size_t x1 = x + (size_t)dx, y1 = y + (size_t)dy, x2 = x1 + (size_t)dx, y2 = y1 + (size_t)dy;
            /* sizes wrap around below 0, so one comparison does for both ends */
            if ((!dx && !dy) || x1 >= g->window.width || y1 >= g->window.height)
                continue;
            size_t k1 = y1 * g->window.width + x1, k2 = y2 * g->window.width + x2;
            if (g->known[k1] == 0 || g->known[k1] > pass)
                continue;
            bool second = x2 < g->window.width && y2 < g->window.height && g->known[k2] && g->known[k2] <= pass;
            sum += g->heights[k1] + (second ? growth.trend * (g->heights[k1] - g->heights[k2]) : 0);
            count++;
        }
    return count ? sum / (float)count : NAN;
}

/* Fills the unknown samples ring by ring. known[k] is 0 for unknown, 1 for the DEM's, p + 1 for those of pass p; a pass
 * sees only those before it, so the result does not depend on the order of samples nor on where the window lies. */
static void grow(scene_growth growth, scene_patch *g)
{
    for (int pass = 1; pass <= growth.rings; pass++)
        for (size_t y = 0; y < g->window.height; y++)
            for (size_t x = 0; x < g->window.width; x++) {
                size_t k = y * g->window.width + x;
                if (g->known[k])
                    continue;
                float height = grow_sample(growth, g, x, y, (unsigned char)pass);
                if (isfinite(height)) {
                    g->heights[k] = height;
                    g->known[k] = (unsigned char)(pass + 1);
                }
            }
    /* nothing that is kept can see what is left; it only must not be NaN */
    for (size_t k = 0; k < g->window.width * g->window.height; k++)
        if (!g->known[k])
            g->heights[k] = 0;
}

static tl_status allocate(scene_patch *g, fbm_window w, bool with_known, const char *name, tl_error *error)
{
    *g = (scene_patch){.window = w};
    g->heights = tl_alloc_grid((int64_t)w.width, (int64_t)w.height, sizeof *g->heights);
    g->known = with_known ? tl_alloc_grid((int64_t)w.width, (int64_t)w.height, 1) : NULL;
    if (g->heights && (g->known || !with_known))
        return TL_OK;
    scene_patch_free(g);
    return tl_fail_memory(error, name);
}

/* Cuts the inner window `w` out of a wider ground. */
static void crop(const scene_patch *wide, scene_patch *g)
{
    fbm_window w = g->window;
    size_t dx = (size_t)(w.i - wide->window.i), dy = (size_t)(w.j - wide->window.j);
    for (size_t row = 0; row < w.height; row++) {
        size_t from = (dy + row) * wide->window.width + dx;
        memcpy(g->heights + row * w.width, wide->heights + from, w.width * sizeof *g->heights);
        memcpy(g->known + row * w.width, wide->known + from, w.width);
    }
}

static tl_status read_with_rim(const tl_source *dem, scene_growth growth, fbm_window w, scene_patch *g, tl_error *error)
{
    const char *name = dem->info.name;
    scene_patch wide;
    tl_status status = allocate(&wide, scene_widened(w, 2 * growth.rings), true, name, error);
    if (status != TL_OK)
        return status;
    status = read_ground(dem, wide.window, wide.heights, error);
    if (status == TL_OK)
        status = allocate(g, w, true, name, error);
    if (status == TL_OK) {
        for (size_t k = 0; k < wide.window.width * wide.window.height; k++)
            wide.known[k] = !isnan(wide.heights[k]);
        grow(growth, &wide);
        crop(&wide, g);
    }
    scene_patch_free(&wide);
    return status;
}

static bool all_known(const float *heights, size_t count)
{
    for (size_t k = 0; k < count; k++)
        if (isnan(heights[k]))
            return false;
    return true;
}

tl_status scene_patch_read(const tl_source *dem, scene_growth growth, fbm_window w, scene_patch *g, tl_error *error)
{
    if (inside(&dem->info, w)) {
        tl_status status = allocate(g, w, false, dem->info.name, error);
        if (status == TL_OK)
            status = read_ground(dem, w, g->heights, error);
        if (status != TL_OK || all_known(g->heights, w.width * w.height))
            return status;
        scene_patch_free(g);
    }
    return read_with_rim(dem, growth, w, g, error);
}
