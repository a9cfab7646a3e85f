#include "lib/scene/mesh_raster.h"

#include "lib/scene/fill_rule.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

enum {
    PLANES = 5,
    CLIPPED_MAX = 3 + PLANES, /* corners of a triangle cut by the planes: each adds one at most */
};

static const double near_plane = 1e-5; /* metres: the places of corners are rounded to less */

void scene_canvas_clear(scene_canvas *canvas)
{
    memset(canvas->hits, 0, (size_t)canvas->width * (size_t)canvas->height * sizeof *canvas->hits);
}

/* ---- rasterising ---- */

typedef struct spot {
    scene_pixel at;
    double nearness;
} spot;

static spot project(const scene_canvas *z, const double corner[3])
{
    double nearness = 1 / corner[2];
    return (spot){{scene_snap(corner[0] * nearness - z->left), scene_snap(corner[1] * nearness - z->top)}, nearness};
}

/* The pixels of a row, from the first on. */
static void fill_row(scene_hit *line, int64_t count, const scene_edge e[3], double nearness, double step,
                     uint32_t triangle)
{
    int64_t v[3] = {e[0].start + e[0].bias, e[1].start + e[1].bias, e[2].start + e[2].bias};
    for (int64_t k = 0; k < count; k++) {
        if ((v[0] | v[1] | v[2]) >= 0) {
            float n = (float)(nearness + step * (double)k);
            if (n > line[k].nearness)
                line[k] = (scene_hit){n, triangle};
        }
        for (int c = 0; c < 3; c++)
            v[c] += e[c].dx;
    }
}

static void fill(scene_canvas *z, const spot *a, const spot *b, const spot *c, uint32_t triangle)
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
    scene_edge e[3] = {scene_edge_of(b->at, c->at, at), scene_edge_of(c->at, a->at, at),
                       scene_edge_of(a->at, b->at, at)};
    const double near[3] = {a->nearness, b->nearness, c->nearness};
    double scale = 1 / (double)area, step = 0;
    for (int k = 0; k < 3; k++)
        step += (double)e[k].dx * scale * near[k];
    for (int64_t row = in.y0; row <= in.y1; row++) {
        double nearness = 0;
        for (int k = 0; k < 3; k++)
            nearness += (double)e[k].start * scale * near[k];
        fill_row(z->hits + row * z->width + in.x0, in.x1 - in.x0 + 1, e, nearness, step, triangle);
        for (int k = 0; k < 3; k++)
            e[k].start += e[k].dy;
    }
}

/* ---- clipping ---- */

/* A half-space: p times the position is at least `offset`. */
typedef struct plane {
    double p[3], offset;
} plane;

static double side(const plane *h, const double at[3])
{
    return h->p[0] * at[0] + h->p[1] * at[1] + h->p[2] * at[2] - h->offset;
}

static int clip(const plane *h, double (*in)[3], int count, double (*out)[3])
{
    int kept = 0;
    for (int k = 0; k < count; k++) {
        const double *a = in[k], *b = in[(k + 1) % count];
        double sa = side(h, a), sb = side(h, b);
        if (sa >= 0)
            memcpy(out[kept++], a, sizeof in[k]);
        if ((sa >= 0) == (sb >= 0))
            continue;
        /* from the inside out, so that both triangles on an edge find the same point */
        const double *from = sa >= 0 ? a : b, *to = sa >= 0 ? b : a;
        double t = sa >= 0 ? sa / (sa - sb) : sb / (sb - sa);
        for (int c = 0; c < 3; c++)
            out[kept][c] = from[c] + (to[c] - from[c]) * t;
        kept++;
    }
    return kept;
}

/* The planes that corners must be inside of: in front of the eye, and not so far aside that integers overflow. */
static void planes_of(const scene_canvas *z, plane out[PLANES])
{
    double guard = SCENE_GUARD * 0.999; /* so that rounding does not leave it again */
    double left = guard - z->left, right = z->left + z->width + guard;
    double above = guard - z->top, below = z->top + z->height + guard;
    out[0] = (plane){{0, 0, 1}, near_plane};
    out[1] = (plane){{1, 0, left}, 0};
    out[2] = (plane){{-1, 0, right}, 0};
    out[3] = (plane){{0, 1, above}, 0};
    out[4] = (plane){{0, -1, below}, 0};
}

static void clip_and_fill(scene_canvas *z, const plane planes[PLANES], int cuts, double (*corners)[3],
                          uint32_t triangle)
{
    double polygons[2][CLIPPED_MAX][3];
    memcpy(polygons[0], corners, 3 * sizeof *corners);
    int count = 3, current = 0;
    for (int k = 0; k < PLANES && count >= 3; k++)
        if (cuts >> k & 1) {
            count = clip(&planes[k], polygons[current], count, polygons[!current]);
            current = !current;
        }
    if (count < 3)
        return;
    spot first = project(z, polygons[current][0]), last = project(z, polygons[current][1]);
    for (int k = 2; k < count; k++) {
        spot next = project(z, polygons[current][k]);
        fill(z, &first, &last, &next, triangle);
        last = next;
    }
}

/* Whether a corner needs no cutting: its pixel is as far from the block as is allowed, at most. */
static bool inside(const scene_canvas *z, const double at[3])
{
    double reach = SCENE_GUARD / 2 * at[2];
    return at[2] >= near_plane && fabs(at[0] - z->left * at[2]) < reach && fabs(at[1] - z->top * at[2]) < reach;
}

void scene_canvas_draw(scene_canvas *canvas, const double a[3], const double b[3], const double c[3], uint32_t triangle)
{
    if (inside(canvas, a) && inside(canvas, b) && inside(canvas, c)) {
        spot sa = project(canvas, a), sb = project(canvas, b), sc = project(canvas, c);
        fill(canvas, &sa, &sb, &sc, triangle);
        return;
    }
    double corners[3][3];
    memcpy(corners[0], a, sizeof corners[0]);
    memcpy(corners[1], b, sizeof corners[1]);
    memcpy(corners[2], c, sizeof corners[2]);
    plane planes[PLANES];
    planes_of(canvas, planes);
    int all = (1 << PLANES) - 1, any = 0;
    for (int k = 0; k < 3; k++) {
        int bits = 0;
        for (int p = 0; p < PLANES; p++)
            bits |= (side(&planes[p], corners[k]) < 0) << p;
        all &= bits;
        any |= bits;
    }
    if (all)
        return;
    clip_and_fill(canvas, planes, any, corners, triangle);
}
