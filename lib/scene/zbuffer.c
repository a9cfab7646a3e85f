#include "lib/scene/zbuffer.h"

#include "lib/scene/fill_rule.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

enum {
    CLIPPED_MAX = 10, /* corners of a triangle cut by five planes: each adds one at most */
};

void scene_zbuffer_clear(scene_zbuffer *buffer)
{
    memset(buffer->fragments, 0, (size_t)buffer->width * (size_t)buffer->height * sizeof *buffer->fragments);
}

/* ---- rasterising ---- */

typedef struct spot {
    scene_pixel at;
    float nearness, height, east, north; /* the last three over w, so that they are linear on the screen */
} spot;

static spot project(const scene_zbuffer *z, const scene_corner *c)
{
    double nearness = 1 / c->w;
    spot s;
    s.at.x = scene_snap(c->x * nearness - z->left);
    s.at.y = scene_snap(c->y * nearness - z->top);
    s.nearness = (float)nearness;
    s.height = (float)((double)c->height * nearness);
    s.east = (float)((double)c->east * nearness);
    s.north = (float)((double)c->north * nearness);
    return s;
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

static void fill(scene_zbuffer *z, const spot *a, const spot *b, const spot *c)
{
    scene_span in = scene_span_of(a->at, b->at, c->at, z->width, z->height);
    int64_t area = scene_twice_area(a->at, b->at, c->at);
    if (in.x0 > in.x1 || in.y0 > in.y1 || area == 0)
        return;
    if (area < 0) {
        const spot *swap = b;
        b = c;
        c = swap;
        area = -area;
    }
    scene_pixel at = scene_centre(in.x0, in.y0);
    const spot *const corners[3] = {a, b, c};
    scene_edge e[3] = {scene_edge_of(b->at, c->at, at), scene_edge_of(c->at, a->at, at),
                       scene_edge_of(a->at, b->at, at)};
    double scale = 1 / (double)area;
    for (int64_t row = in.y0; row <= in.y1; row++) {
        int64_t v[3] = {e[0].start, e[1].start, e[2].start};
        scene_fragment *line = z->fragments + row * z->width;
        for (int64_t column = in.x0; column <= in.x1; column++) {
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
    double guard = SCENE_GUARD * 0.999; /* so that rounding does not leave it again */
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
