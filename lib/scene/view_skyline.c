/* Ridges: how high ground stands around the eye, in buckets of azimuth.
 *
 * A sight line keeps its azimuth. Where its elevation is below that of ground over which it passes, it is in the ground
 * there, and ends before. That holds for an eye that is above the ground of its own raster, where no line comes from
 * below: not from outside of the raster, nor through a void. Elsewhere nothing is hidden.
 *
 * Ground at least `low` high over an extent hides what a straight wall along its diagonal does, up to the chord between
 * the diagonal's ends at that height: the Earth between them is higher than the chord, and the chord is over the
 * extent. Over the azimuths that the wall spans, the tangent of its elevation is a sine. */
#include "lib/base/error.h"
#include "lib/scene/view.h"
#include "lib/scene/view_frame.h"

#include <math.h>
#include <stdlib.h>

enum { BUCKETS = 4096, KEPT = 4, CORNERS = 4 };

static const double pi = 3.14159265358979323846;

/* Walls: what is farther than `distance` (level metres) hides what rises less than `rise` (up over level). Both grow
 * from the first to the last. */
typedef struct wall {
    double distance, rise;
} wall;

typedef struct bucket {
    double limit; /* walls farther than this do not count */
    int count;
    wall walls[KEPT];
} bucket;

struct scene_skyline {
    bool sees;                   /* walls hide */
    double middle, first, width; /* azimuth straight ahead; of the first bucket from there; of a bucket. Radians */
    double margin;               /* of rises: a hundredth of a pixel */
    double eye;                  /* height */
    double sine[BUCKETS + 1], cosine[BUCKETS + 1]; /* of the buckets' rims */
    bucket buckets[BUCKETS];
};

static double wrapped(double angle)
{
    return angle > pi ? angle - 2 * pi : angle < -pi ? angle + 2 * pi : angle;
}

static bool in_frustum(const scene_view *view, const double direction[3])
{
    for (int k = 0; k < 5; k++) {
        const double *n = view->planes[k];
        if (n[0] * direction[0] + n[1] * direction[1] + n[2] * direction[2] < 0)
            return false;
    }
    return true;
}

/* The azimuths on the screen: all, where it shows the zenith or the nadir, else those between its corners. */
static void set_span(scene_skyline *s, const scene_view *view)
{
    const double zenith[3] = {0, 0, 1}, nadir[3] = {0, 0, -1};
    const scene_camera *c = &view->camera;
    double low = 0, high = 0;
    s->middle = atan2(c->ahead[0], c->ahead[1]);
    if (in_frustum(view, zenith) || in_frustum(view, nadir)) {
        low = -pi;
        high = pi;
    }
    for (int corner = 0; corner < CORNERS && high < pi; corner++) {
        double right = (corner & 1 ? 1 : -1) * (c->width / 2 + 1) / c->focal,
               down = (corner & 2 ? 1 : -1) * (c->height / 2 + 1) / c->focal;
        double x = c->ahead[0] + right * c->right[0] + down * c->down[0],
               y = c->ahead[1] + right * c->right[1] + down * c->down[1];
        double azimuth = wrapped(atan2(x, y) - s->middle);
        low = fmin(low, azimuth);
        high = fmax(high, azimuth);
    }
    s->first = low;
    s->width = (high - low) / BUCKETS;
    for (int k = 0; k <= BUCKETS; k++) {
        s->sine[k] = sin(s->middle + low + k * s->width);
        s->cosine[k] = cos(s->middle + low + k * s->width);
    }
}

scene_skyline *scene_skyline_create(const scene_view *view, tl_error *error)
{
    scene_skyline *s = calloc(1, sizeof *s);
    if (!s) {
        tl_fail_memory(error, "the view");
        return NULL;
    }
    for (int k = 0; k < BUCKETS; k++)
        s->buckets[k].limit = (double)INFINITY;
    s->sees = !view->has_holes && scene_view_above_ground(view) > 0;
    s->eye = view->camera.eye[2];
    s->margin = 0.01 / view->camera.focal;
    set_span(s, view);
    return s;
}

void scene_skyline_destroy(scene_skyline *skyline)
{
    free(skyline);
}

/* ---- raising ---- */

static void add_wall(bucket *b, wall w)
{
    if (w.distance > b->limit)
        return;
    if (b->count && b->walls[b->count - 1].rise >= w.rise)
        return; /* a nearer one hides as much, or is fed too late to be worth sorting */
    while (b->count && b->walls[b->count - 1].distance >= w.distance)
        b->count--;
    if (b->count == KEPT) {
        for (int k = 1; k < KEPT; k++)
            b->walls[k - 1] = b->walls[k];
        b->count--;
    }
    b->walls[b->count++] = w;
}

/* Level metres to the line from a to b at a rim of a bucket; between two rims it is nowhere farther than at one. */
static double wall_distance(const scene_skyline *s, const double a[3], const double b[3], double area, int rim)
{
    return area / (s->sine[rim] * (b[1] - a[1]) - s->cosine[rim] * (b[0] - a[0]));
}

/* A wall from a to b, places relative to the eye. */
static void raise(scene_skyline *s, const double a[3], const double b[3])
{
    double from = wrapped(atan2(a[0], a[1]) - s->middle), to = wrapped(atan2(b[0], b[1]) - s->middle);
    if (!(fabs(from - to) < 3))
        return; /* across the seam behind the eye, or through its foot */
    /* the way up is not in the vertical plane of the sight line by what the ellipsoid differs from a sphere: 1e-5 */
    double low = fmin(from, to) + 2e-5, high = fmax(from, to) - 2e-5;
    double first = fmax(ceil((low - s->first) / s->width), 0), end = fmin(floor((high - s->first) / s->width), BUCKETS);
    double area = a[0] * b[1] - b[0] * a[1];
    if (!(first < end) || area == 0)
        return;
    /* the plane through the eye and the wall's top: up = p east + q north */
    double p = (a[2] * b[1] - b[2] * a[1]) / area, q = (a[0] * b[2] - b[0] * a[2]) / area;
    /* within a bucket a sine is not lower than at the rims by more than this */
    double sag = hypot(p, q) * s->width * s->width / 8;
    double before = p * s->sine[(int)first] + q * s->cosine[(int)first],
           until = wall_distance(s, a, b, area, (int)first);
    for (int k = (int)first; k < (int)end; k++) {
        double after = p * s->sine[k + 1] + q * s->cosine[k + 1], near = until;
        until = wall_distance(s, a, b, area, k + 1);
        add_wall(&s->buckets[k], (wall){fmax(near, until), fmin(before, after) - sag});
        before = after;
    }
}

/* The corners of an extent, in its own order around it, and its middle, at its lowest height and relative to the eye.
 */
static bool corners_of(const scene_view *view, const scene_extent *e, double out[CORNERS + 1][3])
{
    const double i[CORNERS + 1] = {e->i0, e->i1, e->i1, e->i0, (e->i0 + e->i1) / 2},
                             j[CORNERS + 1] = {e->j0, e->j0, e->j1, e->j1, (e->j0 + e->j1) / 2};
    double parts[(CORNERS + 1) * 6], height = e->low * view->dem->info.georef.height_unit;
    scene_places_parts(view->places, CORNERS + 1, i, j, parts);
    for (int k = 0; k <= CORNERS; k++)
        for (int a = 0; a < 3; a++) {
            out[k][a] = parts[6 * k + a] + height * parts[6 * k + 3 + a] - view->camera.eye[a];
            if (!isfinite(out[k][a]))
                return false;
        }
    return true;
}

void scene_skyline_raise(scene_skyline *skyline, const scene_view *view, const scene_extent *extent)
{
    double at[CORNERS + 1][3];
    if (!skyline->sees || !corners_of(view, extent, at))
        return;
    for (int k = 0; k < 2; k++) {
        double *a = at[k], *b = at[k + 2], length = 0, off = 0;
        for (int c = 0; c < 3; c++) {
            double bow = at[CORNERS][c] - (a[c] + b[c]) / 2;
            off += bow * bow;
            length += (a[c] - b[c]) * (a[c] - b[c]);
        }
        off = sqrt(off);
        if (!(off < 0.02 * sqrt(length)))
            continue; /* bent too much for what is said above */
        /* flat triangles within the extent are lower than the curved Earth by no more than the whole diagonal is */
        a[2] -= off + view->slack;
        b[2] -= off + view->slack;
        raise(skyline, a, b);
        a[2] += off + view->slack;
        b[2] += off + view->slack;
    }
}

/* ---- hiding ---- */

/* The buckets on the way from azimuth `from` to `to`. False: there are none. */
static bool buckets_of(const scene_skyline *s, double from, double to, int *first, int *last)
{
    double low = fmax(floor((from - s->first) / s->width - 1e-6), 0),
           high = fmin(floor((to - s->first) / s->width + 1e-6), BUCKETS - 1);
    if (!(low <= high))
        return false;
    *first = (int)low;
    *last = (int)high;
    return true;
}

/* Whether a bucket hides what rises `rise` at `distance`. */
static bool bucket_hides(const bucket *b, double distance, double rise)
{
    int w = b->count;
    while (w > 0 && b->walls[w - 1].distance > distance)
        w--;
    return w > 0 && b->walls[w - 1].rise > rise;
}

/* The azimuths of a rectangle beside the eye, from straight ahead. */
static void azimuths(const scene_skyline *s, const scene_box *box, double *from, double *to)
{
    double middle = wrapped(atan2(box->low[0] + box->high[0], box->low[1] + box->high[1]) - s->middle);
    *from = (double)INFINITY;
    *to = -(double)INFINITY;
    for (int corner = 0; corner < CORNERS; corner++) {
        double p[3];
        scene_box_corner(box, corner, p);
        double azimuth = middle + wrapped(wrapped(atan2(p[0], p[1]) - s->middle) - middle);
        *from = fmin(*from, azimuth);
        *to = fmax(*to, azimuth);
    }
}

/* Level metres from the eye's vertical to the nearest point of a box. */
static double level_distance(const scene_box *box)
{
    return hypot(fmax(fmax(box->low[0], -box->high[0]), 0), fmax(fmax(box->low[1], -box->high[1]), 0));
}

bool scene_skyline_hides(const scene_skyline *s, const scene_view *view, const scene_extent *extent,
                         const scene_box *box)
{
    (void)view;
    (void)extent;
    double nearest = level_distance(box);
    if (!s->sees || !(nearest > 0))
        return false;
    double up = box->high[2] - s->eye, rise = up / nearest, from, to;
    if (up < 0)
        rise = up / hypot(fmax(fabs(box->low[0]), fabs(box->high[0])), fmax(fabs(box->low[1]), fabs(box->high[1])));
    rise += s->margin * (1 + rise * rise);
    azimuths(s, box, &from, &to);
    int seen = 0;
    for (int turn = -1; turn <= 1; turn++) {
        int first, last;
        if (!buckets_of(s, from + turn * 2 * pi, to + turn * 2 * pi, &first, &last))
            continue;
        for (int k = first; k <= last; k++, seen++)
            if (!bucket_hides(&s->buckets[k], nearest, rise))
                return false;
    }
    return seen > 0;
}

void scene_skyline_leak(scene_skyline *s, const scene_box *box)
{
    double nearest = level_distance(box), from = -pi, to = pi;
    if (nearest > 0)
        azimuths(s, box, &from, &to);
    for (int turn = -1; turn <= 1; turn++) {
        int first, last;
        if (!buckets_of(s, from + turn * 2 * pi, to + turn * 2 * pi, &first, &last))
            continue;
        for (int k = first; k <= last; k++) {
            bucket *b = &s->buckets[k];
            b->limit = fmin(b->limit, nearest);
            while (b->count && b->walls[b->count - 1].distance > b->limit)
                b->count--;
        }
    }
}
