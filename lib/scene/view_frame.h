/* The inside of a scene_view, for the files that implement lib/scene/view.h. */
#ifndef SCENE_VIEW_FRAME_H
#define SCENE_VIEW_FRAME_H

#include "lib/scene/view.h"
#include "lib/scene/view_place.h"

struct scene_view {
    tl_view given;
    const tl_source *dem;
    scene_places *places;
    scene_camera camera;
    double planes[5][3]; /* normals of the frustum, through the eye, inwards: ahead, and the screen's sides */
    double widest;       /* (distance / distance ahead)^2 in a corner of the screen */
    double radius;       /* of the sphere inside of the Earth under the eye */
    double floor;        /* metres: no ground is lower */
    bool has_holes;      /* the ground may have voids */
    double slack;        /* metres: places are as exact as that */
};

/* The height of the ground in metres, between samples bilinear; `what` names the thing above it in messages. */
tl_status scene_ground_height(const tl_source *dem, const char *what, double i, double j, double *out, tl_error *error);

enum { SCENE_BOX_CORNERS = 8 };
void scene_box_corner(const scene_box *box, int corner, double out[3]);

#endif
