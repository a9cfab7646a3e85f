/* Where a perspective is seen from. The scene's frame: metres east, north and up of the middle of the raster. */
#ifndef SCENE_CAMERA_H
#define SCENE_CAMERA_H

#include <stdbool.h>

typedef struct scene_camera {
    double eye[3];
    double right[3], down[3], ahead[3]; /* unit vectors */
    double focal;                       /* pixels at distance 1 */
    double width, height;               /* pixels */
} scene_camera;

typedef struct scene_box {
    double low[3], high[3];
} scene_box;

/* A box on the screen, in pixels from straight ahead, rightwards and downwards. */
typedef struct scene_outline {
    double x0, y0, x1, y1;
    double nearest; /* distance ahead of its nearest corner; where it is not above 0 the outline is the whole screen */
} scene_outline;

/* From eye to target, which must differ; fov: degrees from left to right. */
void scene_camera_look(scene_camera *camera, const double eye[3], const double target[3], double fov, int width,
                       int height);
/* From the south and above, with the whole box in the picture. */
void scene_camera_fit(scene_camera *camera, const scene_box *box, double fov, int width, int height);
/* Position relative to the eye: out[0] right, out[1] down (both times `focal`), out[2] ahead. */
void scene_camera_view(const scene_camera *camera, const double position[3], double out[3]);
/* False: no part of the box is on the screen (some boxes that are not are let through). */
bool scene_camera_outline(const scene_camera *camera, const scene_box *box, scene_outline *outline);

#endif
