#include "lib/scene/zbuffer.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

enum {
    SUBPIXELS = 256,
    GUARD = 1 << 20,  /* pixels around the block within which corners lie: edge functions then stay below 2^62 */
    CLIPPED_MAX = 10, /* corners of a triangle cut by five planes: each adds one at most */
};

void scene_zbuffer_clear(scene_zbuffer *buffer)
{
    memset(buffer->fragments, 0, (size_t)buffer->width * (size_t)buffer->height * sizeof *buffer->fragments);
}

/* ---- rasterising ---- */

/* A corner on the block's own grid of subpixels. */
typedef struct spot {
    int64_t x, y;
    float nearness, height, east, north; /* the last three over w, so that they are linear on the screen */
} spot;

/* Corners lie within the guard but for what clipping lost to rounding, which can be all where coordinates are 1e30. */
static int64_t snap(double pixels)
{
    double most = 2.0 * GUARD;
    if (!(pixels > -most)) /* also NaN */
        pixels = -most;
    return (int64_t)floor((pixels < most ? pixels : most) * SUBPIXELS + 0.5);
}

static spot project(const scene_zbuffer *z, const scene_corner *c)
{
    double nearness = 1 / c->w;
    spot s;
    s.x = snap(c->x * nearness - z->left);
    s.y = snap(c->y * nearness - z->top);
    s.nearness = (float)nearness;
    s.height = (float)((double)c->height * nearness);
    s.east = (float)((double)c->east * nearness);
    s.north = (float)((double)c->north * nearness);
    return s;
}

static int64_t twice_area(const spot *a, const spot *b, const spot *c)
{
    return (b->x - a->x) * (c->y - a->y) - (b->y - a->y) * (c->x - a->x);
}

/* An edge function, at least 0 inside: it grows by dx from pixel to pixel and by dy from row to row. A pixel's centre
 * on the edge itself belongs to one side only: that is what the bias is for. */
typedef struct edge {
    int64_t start, dx, dy, bias;
} edge;

static edge edge_of(const spot *from, const spot *to, int64_t x, int64_t y)
{
    int64_t ex = to->x - from->x, ey = to->y - from->y;
    edge e = {.dx = -ey * SUBPIXELS, .dy = ex * SUBPIXELS};
    e.start = ex * (y - from->y) - ey * (x - from->x);
    e.bias = ey < 0 || (ey == 0 && ex > 0) ? 0 : -1;
    return e;
}

static void shade_fragment(scene_fragment *f, const spot *const s[3], const double part[3])
{
    double nearness = 0, height = 0, east = 0, north = 0;
    for (int k = 0; k < 3; k++)
        nearness += part[k] * (double)s[k]->nearness;
    if (!(nearness > (double)f->nearness))
        return;
    for (int k = 0; k < 3; k++) {
        height += part[k] * (double)s[k]->height;
        east += part[k] * (double)s[k]->east;
        north += part[k] * (double)s[k]->north;
    }
    *f = (scene_fragment){(float)nearness, (float)(height / nearness), (float)(east / nearness),
                          (float)(north / nearness)};
}

static int64_t low3(int64_t a, int64_t b, int64_t c)
{
    int64_t m = a < b ? a : b;
    return m < c ? m : c;
}

static int64_t high3(int64_t a, int64_t b, int64_t c)
{
    return -low3(-a, -b, -c);
}

/* The first pixel whose centre is at or behind a position, and the last one at or before it. */
static int64_t first_pixel(int64_t position)
{
    int64_t p = (position + SUBPIXELS / 2 - 1) >> 8;
    return p < 0 ? 0 : p;
}

static int64_t last_pixel(int64_t position, int size)
{
    int64_t p = (position - SUBPIXELS / 2) >> 8;
    return p > size - 1 ? size - 1 : p;
}

static void fill(scene_zbuffer *z, const spot *a, const spot *b, const spot *c)
{
    int64_t area = twice_area(a, b, c);
    if (area == 0)
        return;
    if (area < 0) {
        const spot *swap = b;
        b = c;
        c = swap;
        area = -area;
    }
    int64_t x0 = first_pixel(low3(a->x, b->x, c->x)), x1 = last_pixel(high3(a->x, b->x, c->x), z->width);
    int64_t y0 = first_pixel(low3(a->y, b->y, c->y)), y1 = last_pixel(high3(a->y, b->y, c->y), z->height);
    if (x0 > x1 || y0 > y1)
        return;
    int64_t x = x0 * SUBPIXELS + SUBPIXELS / 2, y = y0 * SUBPIXELS + SUBPIXELS / 2;
    const spot *const corners[3] = {a, b, c};
    edge e[3] = {edge_of(b, c, x, y), edge_of(c, a, x, y), edge_of(a, b, x, y)};
    double scale = 1 / (double)area;
    for (int64_t row = y0; row <= y1; row++) {
        int64_t v[3] = {e[0].start, e[1].start, e[2].start};
        scene_fragment *line = z->fragments + row * z->width;
        for (int64_t column = x0; column <= x1; column++) {
            if (((v[0] + e[0].bias) | (v[1] + e[1].bias) | (v[2] + e[2].bias)) >= 0) {
                const double part[3] = {(double)v[0] * scale, (double)v[1] * scale, (double)v[2] * scale};
                shade_fragment(&line[column], corners, part);
            }
            for (int k = 0; k < 3; k++)
                v[k] += e[k].dx;
        }
        for (int k = 0; k < 3; k++)
            e[k].start += e[k].dy;
    }
}

/* ---- clipping ---- */

/* A half-space x * X + y * Y + w * W >= offset. */
typedef struct plane {
    double x, y, w, offset;
} plane;

static double side(const plane *p, const scene_corner *c)
{
    return p->x * c->x + p->y * c->y + p->w * c->w - p->offset;
}

static scene_corner between(const scene_corner *a, const scene_corner *b, double t)
{
    float s = (float)t;
    return (scene_corner){a->x + (b->x - a->x) * t,          a->y + (b->y - a->y) * t,
                          a->w + (b->w - a->w) * t,          a->height + (b->height - a->height) * s,
                          a->east + (b->east - a->east) * s, a->north + (b->north - a->north) * s};
}

static int clip(const plane *p, const scene_corner *in, int count, scene_corner *out)
{
    int kept = 0;
    for (int k = 0; k < count; k++) {
        const scene_corner *a = &in[k], *b = &in[(k + 1) % count];
        double sa = side(p, a), sb = side(p, b);
        if (sa >= 0)
            out[kept++] = *a;
        if ((sa >= 0) != (sb >= 0))
            out[kept++] = between(a, b, sa / (sa - sb));
    }
    return kept;
}

/* The planes that corners must be inside of: in front of the eye, and not so far aside that integers overflow. */
static void planes_of(const scene_zbuffer *z, plane out[5])
{
    double guard = GUARD * 0.999; /* so that rounding does not leave it again */
    double right = z->left + z->width + guard, bottom = z->top + z->height + guard;
    out[0] = (plane){0, 0, 1, z->near_plane};
    out[1] = (plane){1, 0, guard - z->left, 0};
    out[2] = (plane){-1, 0, right, 0};
    out[3] = (plane){0, 1, guard - z->top, 0};
    out[4] = (plane){0, -1, bottom, 0};
}

/* For each plane a bit: whether the corner is outside. */
static int outside(const plane planes[5], const scene_corner *c)
{
    int bits = 0;
    for (int k = 0; k < 5; k++)
        bits |= (side(&planes[k], c) < 0) << k;
    return bits;
}

static void clip_and_fill(scene_zbuffer *z, const plane planes[5], int cuts, const scene_corner corners[3])
{
    scene_corner polygons[2][CLIPPED_MAX];
    memcpy(polygons[0], corners, 3 * sizeof *corners);
    int count = 3, current = 0;
    for (int k = 0; k < 5 && count >= 3; k++)
        if (cuts >> k & 1) {
            count = clip(&planes[k], polygons[current], count, polygons[!current]);
            current = !current;
        }
    if (count < 3)
        return;
    spot first = project(z, &polygons[current][0]), last = project(z, &polygons[current][1]);
    for (int k = 2; k < count; k++) {
        spot next = project(z, &polygons[current][k]);
        fill(z, &first, &last, &next);
        last = next;
    }
}

void scene_zbuffer_triangle(scene_zbuffer *buffer, const scene_corner *a, const scene_corner *b, const scene_corner *c)
{
    plane planes[5];
    planes_of(buffer, planes);
    int oa = outside(planes, a), ob = outside(planes, b), oc = outside(planes, c);
    if (oa & ob & oc)
        return;
    if (oa | ob | oc) {
        const scene_corner corners[3] = {*a, *b, *c};
        clip_and_fill(buffer, planes, oa | ob | oc, corners);
        return;
    }
    spot sa = project(buffer, a), sb = project(buffer, b), sc = project(buffer, c);
    fill(buffer, &sa, &sb, &sc);
}

int scene_zbuffer_hides(const scene_zbuffer *buffer, double x0, double y0, double x1, double y1, double w)
{
    int left = (int)fmax(floor(x0 - buffer->left), 0), right = (int)fmin(ceil(x1 - buffer->left), buffer->width);
    int top = (int)fmax(floor(y0 - buffer->top), 0), bottom = (int)fmin(ceil(y1 - buffer->top), buffer->height);
    for (int y = top; y < bottom; y++)
        for (int x = left; x < right; x++)
            if (!((double)buffer->fragments[y * buffer->width + x].nearness * w > 1))
                return 0;
    return 1;
}
