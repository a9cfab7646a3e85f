/* A view on an elevation model: where the eye is, where samples are around it, and what of them it can see.
 *
 * The scene's frame is metres east, north and up of the tangent plane at the foot of the eye (its longitude and
 * latitude, height 0), so that numbers are small where the eye is near; of a raster without a CRS, metres along its
 * columns and against its rows. Positions on the lattice are columns and rows of level 0, with fractions, and heights
 * in the raster's unit. */
#ifndef SCENE_VIEW_H
#define SCENE_VIEW_H

#include "lib/scene/camera.h"
#include "lib/talus.h"

#include <stddef.h>

typedef struct scene_view scene_view;

/* Checks the view and places it over `dem`, which is read only where the height of the ground under the eye is asked
 * for. Borrows dem. */
scene_view *scene_view_create(const tl_view *view, const tl_source *dem, tl_error *error);
void scene_view_destroy(scene_view *view);

/* What is known of the ground sharpens the rules below: no sample is lower than `lowest` (in the raster's unit; else
 * what no ground of a planet is), and where it has no voids, ridges hide what is behind them. Before the view is used
 * by several threads. */
enum { SCENE_LOWEST_GROUND = -11500 }; /* metres */
void scene_view_know_ground(scene_view *view, double lowest, bool has_holes);

/* The eye, and the way from the frame to pixels. */
const scene_camera *scene_view_camera(const scene_view *view);
/* Places of n points; any number of threads. Curvature and refraction count. */
void scene_view_place(const scene_view *view, size_t n, const double *i, const double *j, const float *z,
                      double (*xyz)[3]);

/* Metres of the eye above the model's ground, between samples bilinear; NaN where there is none: a void, or beside the
 * raster. */
double scene_view_above_ground(const scene_view *view);

/* A rectangle of the lattice with a range of heights. */
typedef struct scene_extent {
    double i0, j0, i1, j1;
    double low, high;
} scene_extent;

/* A box around all that lies in the extent, curvature included. */
void scene_view_box(const scene_view *view, const scene_extent *extent, scene_box *out);
/* Metres from the eye to the nearest point of a box; 0 inside of it. */
double scene_view_distance(const scene_view *view, const scene_box *box);
/* Equation 3: the pixels that `length` metres at `distance` take at most, where on the screen it may be; infinite at
 * distance 0. */
double scene_view_pixels(const scene_view *view, double length, double distance);

/* Reasons not to draw. */
typedef enum scene_hidden {
    SCENE_HIDDEN_FRUSTUM = 1, /* beside the screen, or behind the eye */
    SCENE_HIDDEN_BACK = 2,    /* all its faces look away: by the cone of their normals */
    SCENE_HIDDEN_HORIZON = 4, /* behind the curve of the Earth */
    SCENE_HIDDEN_RIDGE = 8,   /* behind nearer ground: see scene_skyline */
} scene_hidden;

/* The first rule of `rules` (an or of the first three) that hides the extent, or 0. Never hides what is to be seen.
 * `slope`: the steepest slope (rise over run) of its surface in any direction; infinite where it is not known, so that
 * SCENE_HIDDEN_BACK does not apply. */
unsigned scene_view_hides(const scene_view *view, const scene_extent *extent, const scene_box *box, double slope,
                          unsigned rules);

/* How high nearer ground stands around the eye, by azimuth: to be fed from near to far. */
typedef struct scene_skyline scene_skyline;
scene_skyline *scene_skyline_create(const scene_view *view, tl_error *error);
void scene_skyline_destroy(scene_skyline *skyline);
/* Ground that is certainly there: at least `low` high over the whole extent. */
void scene_skyline_raise(scene_skyline *skyline, const scene_view *view, const scene_extent *extent);
/* Ground with holes: sight lines may come from below behind it, so that what is farther, in its azimuths, hides
 * nothing. Also fed from near to far, and before ground that is not nearer. For callers who know where the holes are,
 * and so say of the view's ground that it has none. */
void scene_skyline_leak(scene_skyline *skyline, const scene_box *box);
/* Whether all of the extent is below the skyline of what is nearer than its nearest point. */
bool scene_skyline_hides(const scene_skyline *skyline, const scene_view *view, const scene_extent *extent,
                         const scene_box *box);

#endif
