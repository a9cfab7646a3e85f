/* Marks by what triangles cover: bounds that vary over the raster, of which a triangle must keep the smallest, and
 * voids. */
#include "dem/framework_pyramid.h"

#include "lib/base/error.h"

/* A vertex of the lattice. */
typedef struct spot {
    int64_t x, y;
} spot;

typedef struct marker {
    tl_framework *framework;
    const tl_pyramid *pyramid;
    const float *limits;
    int64_t width, height;
} marker;

static inline bool inside(const marker *self, spot at)
{
    return at.x < self->width && at.y < self->height;
}

static inline float limit_at(const marker *self, spot at)
{
    return inside(self, at) ? self->limits[at.y * self->width + at.x] : HUGE_VALF;
}

/* The smallest bound in a triangle, whose splitting vertex is marked if its error is larger, as are those of all
 * triangles in it. The error that the pyramid has of a vertex is at least that of the triangles it splits, so what is
 * not marked keeps its bound; it may be that of a smaller triangle nearby, whose bound is larger, so a few are marked
 * without need where the bound changes. */
static float mark_triangle(const marker *self, spot a, spot b, spot apex, int depth)
{
    float least = fminf(limit_at(self, apex), fminf(limit_at(self, a), limit_at(self, b)));
    bool beyond = (a.x >= self->width && b.x >= self->width && apex.x >= self->width) ||
                  (a.y >= self->height && b.y >= self->height && apex.y >= self->height);
    if (!depth || beyond)
        return least;
    spot middle = {(a.x + b.x) / 2, (a.y + b.y) / 2};
    least = fminf(least, mark_triangle(self, apex, a, middle, depth - 1));
    least = fminf(least, mark_triangle(self, b, apex, middle, depth - 1));
    if (inside(self, middle)) {
        size_t sample = (size_t)(middle.y * self->width + middle.x);
        if (tl_pyramid_value(self->pyramid, tl_pyramid_key(self->pyramid, sample)) > (double)least)
            tl_bit_set(self->framework->split, self->framework->words, middle.x, middle.y);
    }
    return least;
}

enum { HAS_VOID = 1, HAS_GROUND = 2 };

/* What a triangle covers; one that has both is split. */
static int mark_mixed(const marker *self, spot a, spot b, spot apex, int depth)
{
    const spot corners[3] = {a, b, apex};
    int found = 0;
    bool beyond_x = true, beyond_y = true;
    for (int k = 0; k < 3; k++) {
        beyond_x &= corners[k].x >= self->width, beyond_y &= corners[k].y >= self->height;
        if (inside(self, corners[k]))
            found |= isnan(limit_at(self, corners[k])) ? HAS_VOID : HAS_GROUND;
    }
    if (!depth || beyond_x || beyond_y)
        return found;
    spot middle = {(a.x + b.x) / 2, (a.y + b.y) / 2};
    found |= mark_mixed(self, apex, a, middle, depth - 1) | mark_mixed(self, b, apex, middle, depth - 1);
    if (found == (HAS_VOID | HAS_GROUND) && inside(self, middle))
        tl_bit_set(self->framework->split, self->framework->words, middle.x, middle.y);
    return found;
}

static void close_marks(tl_framework *framework)
{
    const size_t words = framework->words;
    for (int64_t y = 0; y < framework->info.height; y++)
        for (size_t w = 0; w < words; w++)
            for (uint64_t left = framework->split[(size_t)y * words + w]; left; left &= left - 1)
                tl_framework_force(framework, (int64_t)(w * 64) + __builtin_ctzll(left), y);
}

void tl_framework_mark_voids(tl_framework *framework, const float *heights)
{
    marker self = {framework, NULL, heights, framework->info.width, framework->info.height};
    int64_t end = INT64_C(1) << framework->lattice_log;
    const spot nw = {0, 0}, ne = {end, 0}, sw = {0, end}, se = {end, end};
    mark_mixed(&self, nw, se, ne, 2 * framework->lattice_log);
    mark_mixed(&self, se, nw, sw, 2 * framework->lattice_log);
    close_marks(framework);
}

void tl_framework_mark_limits(tl_framework *framework, const tl_pyramid *pyramid, const float *limits)
{
    marker self = {framework, pyramid, limits, framework->info.width, framework->info.height};
    int64_t end = INT64_C(1) << framework->lattice_log;
    const spot nw = {0, 0}, ne = {end, 0}, sw = {0, end}, se = {end, end};
    mark_triangle(&self, nw, se, ne, 2 * framework->lattice_log);
    mark_triangle(&self, se, nw, sw, 2 * framework->lattice_log);
    close_marks(framework);
}
