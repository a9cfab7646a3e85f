/* What of a raster cannot be seen: boxes around its parts, and rules over them. Each rule is one of a convex region
 * that is hidden, so that a box is hidden when its corners are. */
#include "lib/scene/view.h"
#include "lib/scene/view_frame.h"

#include <math.h>

enum { FEW = 3, MANY = 17, PARTS = 6 };

void scene_box_corner(const scene_box *box, int corner, double out[3])
{
    for (int a = 0; a < 3; a++)
        out[a] = corner >> a & 1 ? box->high[a] : box->low[a];
}

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* ---- boxes ---- */

/* Places of n x n points over an extent, at one height. */
typedef struct sheet {
    int n;
    const double *parts;
    double height;
} sheet;

static double sheet_at(const sheet *s, int row, int column, int axis)
{
    const double *part = s->parts + (row * s->n + column) * PARTS;
    return part[axis] + s->height * part[3 + axis];
}

/* The box of a sheet's points along one axis, and what the sheet bulges between them: bilinear interpolation is off by
 * an eighth of both second differences over a cell, which is doubled as they are not quite the same everywhere. */
static void bound_axis(const sheet *s, int axis, double *low, double *high)
{
    double bulge = 0, least = (double)INFINITY, most = -(double)INFINITY;
    for (int r = 0; r < s->n; r++)
        for (int c = 0; c < s->n; c++) {
            double at = sheet_at(s, r, c, axis), across = 0, along = 0;
            if (c > 0 && c < s->n - 1)
                across = sheet_at(s, r, c - 1, axis) - 2 * at + sheet_at(s, r, c + 1, axis);
            if (r > 0 && r < s->n - 1)
                along = sheet_at(s, r - 1, c, axis) - 2 * at + sheet_at(s, r + 1, c, axis);
            bulge = fmax(bulge, fabs(across) + fabs(along));
            least = at < least ? at : least;
            most = at > most ? at : most;
        }
    *low = fmin(*low, least - bulge / 4);
    *high = fmax(*high, most + bulge / 4);
}

/* Samples n x n points of the extent; false where one has no place. */
static bool sample(const scene_view *view, const scene_extent *e, int n, double *parts)
{
    double i[MANY * MANY], j[MANY * MANY];
    double right = (double)(view->dem->info.width - 1), bottom = (double)(view->dem->info.height - 1);
    double i0 = fmin(fmax(e->i0, 0), right), i1 = fmin(fmax(e->i1, 0), right);
    double j0 = fmin(fmax(e->j0, 0), bottom), j1 = fmin(fmax(e->j1, 0), bottom);
    for (int k = 0; k < n * n; k++) {
        i[k] = i0 + (i1 - i0) * (k % n) / (n - 1);
        j[k] = j0 + (j1 - j0) * (k / n) / (n - 1);
    }
    scene_places_parts(view->places, (size_t)(n * n), i, j, parts);
    double sum = 0;
    for (int k = 0; k < n * n * PARTS; k++)
        sum += parts[k];
    return isfinite(sum);
}

static void bound(const scene_view *view, const scene_extent *e, int n, const double *parts, scene_box *out)
{
    double metres = view->dem->info.georef.height_unit;
    const sheet sheets[2] = {{n, parts, e->low * metres}, {n, parts, e->high * metres}};
    for (int a = 0; a < 3; a++) {
        out->low[a] = (double)INFINITY;
        out->high[a] = -(double)INFINITY;
        for (int k = 0; k < 2; k++)
            bound_axis(&sheets[k], a, &out->low[a], &out->high[a]);
        /* sums of numbers of this size are rounded by less */
        double more = view->slack + 1e-14 * (fabs(out->low[a]) + fabs(out->high[a]));
        out->low[a] -= more;
        out->high[a] += more;
    }
}

/* Whether an extent is bent so much that a few points do not tell how. */
static bool bends(const double *parts)
{
    double bend = 0, size = 0;
    const double *middle = parts + PARTS * (FEW * FEW / 2);
    for (int k = 0; k < FEW * FEW / 2; k++)
        for (int a = 0; a < 3; a++) {
            double from = parts[PARTS * k + a], to = parts[PARTS * (FEW * FEW - 1 - k) + a];
            bend = fmax(bend, fabs(from - 2 * middle[a] + to));
            size = fmax(size, fabs(from - to));
        }
    return bend > 0.02 * size + 1e-6;
}

void scene_view_box(const scene_view *view, const scene_extent *extent, scene_box *out)
{
    const double everywhere = 1e30;
    double parts[MANY * MANY * PARTS];
    if (sample(view, extent, FEW, parts)) {
        bool many = bends(parts);
        if (!many || sample(view, extent, MANY, parts)) {
            bound(view, extent, many ? MANY : FEW, parts, out);
            return;
        }
    }
    for (int a = 0; a < 3; a++) {
        out->low[a] = -everywhere;
        out->high[a] = everywhere;
    }
}

/* ---- rules ---- */

static bool beside_screen(const scene_view *view, const scene_box *box)
{
    const double *eye = view->camera.eye;
    for (int k = 0; k < 5; k++) {
        const double *n = view->planes[k];
        double most = 0;
        for (int a = 0; a < 3; a++)
            most += n[a] * ((n[a] > 0 ? box->high[a] : box->low[a]) - eye[a]);
        if (most < 0)
            return true;
    }
    return false;
}

/* Faces no steeper than `slope` have normals within the angle b = atan(slope) of the way up, and that is within some
 * angle g of the way up in the middle, u. All look away from an eye that sees each of their points p in a direction
 * within 90 degrees - b - g of u: u (p - eye) > sin(b + g) |p - eye|, which is a convex cone. */
static bool looks_away(const scene_view *view, const scene_extent *extent, const scene_box *box, double slope)
{
    if (!(slope < 1e6) || box->high[2] <= view->camera.eye[2])
        return false; /* from above, ground looks away only behind the horizon */
    double parts[FEW * FEW * PARTS], apart = 0;
    if (!sample(view, extent, FEW, parts))
        return false;
    const double *up = parts + PARTS * (FEW * FEW / 2) + 3;
    for (int k = 0; k < FEW * FEW; k++) {
        const double *other = parts + PARTS * k + 3;
        const double d[3] = {other[0] - up[0], other[1] - up[1], other[2] - up[2]};
        apart = fmax(apart, sqrt(dot(d, d)));
    }
    double length = sqrt(dot(up, up)), turn = 1.1 * apart + 1e-6;
    if (!(turn < 0.1))
        return false;
    /* sin(b + g) <= sin b + g */
    double sine = slope / sqrt(1 + slope * slope) + turn;
    for (int corner = 0; corner < SCENE_BOX_CORNERS; corner++) {
        double p[3];
        scene_box_corner(box, corner, p);
        for (int a = 0; a < 3; a++)
            p[a] -= view->camera.eye[a];
        if (!(dot(up, p) > sine * length * sqrt(dot(p, p))))
            return false;
    }
    return true;
}

/* Behind a sphere that is inside of the Earth: in the cone of its shadow, and behind the circle where that touches it.
 * [As a test for one point: Cozzi and Ring 2011, 3D Engine Design for Virtual Globes, horizon culling.] */
static bool beyond_horizon(const scene_view *view, const scene_box *box)
{
    double sphere = view->radius + view->floor, above = view->camera.eye[2] - view->floor;
    if (!isfinite(sphere) || !(sphere > 0) || !(above > 0))
        return false;
    /* from the eye to the centre, straight down; to the touching circle, squared; a part in 10^9 is for rounding */
    double down = sphere + above, touch2 = above * (2 * sphere + above), more = 1 + 1e-9;
    for (int corner = 0; corner < SCENE_BOX_CORNERS; corner++) {
        double p[3];
        scene_box_corner(box, corner, p);
        p[2] -= view->camera.eye[2];
        double along = -p[2] * down;
        if (!(along > touch2 * more && along * along > touch2 * dot(p, p) * more))
            return false;
    }
    return true;
}

unsigned scene_view_hides(const scene_view *view, const scene_extent *extent, const scene_box *box, double slope,
                          unsigned rules)
{
    if (rules & SCENE_HIDDEN_FRUSTUM && beside_screen(view, box))
        return SCENE_HIDDEN_FRUSTUM;
    if (rules & SCENE_HIDDEN_BACK && looks_away(view, extent, box, slope))
        return SCENE_HIDDEN_BACK;
    if (rules & SCENE_HIDDEN_HORIZON && beyond_horizon(view, box))
        return SCENE_HIDDEN_HORIZON;
    return 0;
}
