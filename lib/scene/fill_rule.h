/* Which pixels a triangle covers: the rule that both rasterisers share. Corners are snapped to a grid of subpixels and
 * edges decided in integers, so that neighbours leave no gap and overlap nowhere. */
#ifndef SCENE_FILL_RULE_H
#define SCENE_FILL_RULE_H

#include <math.h>
#include <stdint.h>

enum {
    SCENE_SUBPIXELS = 256,
    SCENE_GUARD = 1 << 20 /* pixels around the block within which corners lie: edge functions then stay below 2^62 */
};

/* A place on the block's own grid of subpixels. */
typedef struct scene_pixel {
    int64_t x, y;
} scene_pixel;

/* Corners lie within the guard but for what clipping lost to rounding, which can be all where coordinates are 1e30. */
static inline int64_t scene_snap(double pixels)
{
    double most = 2.0 * SCENE_GUARD;
    if (!(pixels > -most)) /* also NaN */
        pixels = -most;
    return (int64_t)floor((pixels < most ? pixels : most) * SCENE_SUBPIXELS + 0.5);
}

static inline int64_t scene_twice_area(scene_pixel a, scene_pixel b, scene_pixel c)
{
    return (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
}

/* An edge function, at least 0 inside: it grows by dx from pixel to pixel and by dy from row to row. A pixel's centre
 * on the edge itself belongs to one side only: that is what the bias is for. */
typedef struct scene_edge {
    int64_t start, dx, dy, bias;
} scene_edge;

static inline scene_edge scene_edge_of(scene_pixel from, scene_pixel to, scene_pixel at)
{
    int64_t ex = to.x - from.x, ey = to.y - from.y;
    scene_edge e = {.dx = -ey * SCENE_SUBPIXELS, .dy = ex * SCENE_SUBPIXELS};
    e.start = ex * (at.y - from.y) - ey * (at.x - from.x);
    e.bias = ey < 0 || (ey == 0 && ex > 0) ? 0 : -1;
    return e;
}

/* The pixels whose centres may be inside of a triangle, within a block; x0 > x1 or y0 > y1: none. */
typedef struct scene_span {
    int64_t x0, y0, x1, y1;
} scene_span;

static inline int64_t scene_low3(int64_t a, int64_t b, int64_t c)
{
    int64_t m = a < b ? a : b;
    return m < c ? m : c;
}

/* The first pixel whose centre is at or behind a position, and the last one at or before it. */
static inline int64_t scene_first_pixel(int64_t position)
{
    int64_t p = (position + SCENE_SUBPIXELS / 2 - 1) >> 8;
    return p < 0 ? 0 : p;
}

static inline int64_t scene_last_pixel(int64_t position, int size)
{
    int64_t p = (position - SCENE_SUBPIXELS / 2) >> 8;
    return p > size - 1 ? size - 1 : p;
}

static inline scene_span scene_span_of(scene_pixel a, scene_pixel b, scene_pixel c, int width, int height)
{
    return (scene_span){scene_first_pixel(scene_low3(a.x, b.x, c.x)), scene_first_pixel(scene_low3(a.y, b.y, c.y)),
                        scene_last_pixel(-scene_low3(-a.x, -b.x, -c.x), width),
                        scene_last_pixel(-scene_low3(-a.y, -b.y, -c.y), height)};
}

/* The centre of a pixel. */
static inline scene_pixel scene_centre(int64_t x, int64_t y)
{
    return (scene_pixel){x * SCENE_SUBPIXELS + SCENE_SUBPIXELS / 2, y * SCENE_SUBPIXELS + SCENE_SUBPIXELS / 2};
}

#endif
