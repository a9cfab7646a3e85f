#include "lib/scene/camera.h"

#include <math.h>

static const double radian = 3.14159265358979323846 / 180;
static const double pitch = 33, margin = 0.93; /* of an automatic view: degrees below the horizon; used part */

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross(const double a[3], const double b[3], double out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static void normalise(double a[3])
{
    double length = sqrt(dot(a, a));
    for (int k = 0; k < 3; k++)
        a[k] /= length;
}

void scene_camera_look(scene_camera *camera, const double eye[3], const double target[3], double fov, int width,
                       int height)
{
    const double up[3] = {0, 0, 1}, north[3] = {0, 1, 0};
    *camera = (scene_camera){.width = width, .height = height, .focal = width / 2.0 / tan(fov / 2 * radian)};
    for (int k = 0; k < 3; k++) {
        camera->eye[k] = eye[k];
        camera->ahead[k] = target[k] - eye[k];
    }
    normalise(camera->ahead);
    /* straight up or down, "up" has no direction on the screen: north is at the top instead */
    bool vertical = hypot(camera->ahead[0], camera->ahead[1]) < 1e-9;
    cross(camera->ahead, vertical ? north : up, camera->right);
    normalise(camera->right);
    cross(camera->ahead, camera->right, camera->down);
}

void scene_camera_view(const scene_camera *camera, const double position[3], double out[3])
{
    double d[3];
    for (int k = 0; k < 3; k++)
        d[k] = position[k] - camera->eye[k];
    out[0] = dot(camera->right, d) * camera->focal;
    out[1] = dot(camera->down, d) * camera->focal;
    out[2] = dot(camera->ahead, d);
}

static void corner_of(const scene_box *box, int corner, double out[3])
{
    for (int k = 0; k < 3; k++)
        out[k] = corner >> k & 1 ? box->high[k] : box->low[k];
}

bool scene_camera_outline(const scene_camera *camera, const scene_box *box, scene_outline *o)
{
    double wide = camera->width / 2, high = camera->height / 2;
    int behind = 31;
    const double far_away = (double)INFINITY;
    *o = (scene_outline){far_away, far_away, -far_away, -far_away, far_away};
    for (int corner = 0; corner < 8; corner++) {
        double position[3], v[3];
        corner_of(box, corner, position);
        scene_camera_view(camera, position, v);
        behind &= (v[2] <= 0) | (v[0] < -wide * v[2]) << 1 | (v[0] > wide * v[2]) << 2 | (v[1] < -high * v[2]) << 3 |
                  (v[1] > high * v[2]) << 4;
        o->nearest = fmin(o->nearest, v[2]);
        o->x0 = fmin(o->x0, v[0] / v[2]);
        o->x1 = fmax(o->x1, v[0] / v[2]);
        o->y0 = fmin(o->y0, v[1] / v[2]);
        o->y1 = fmax(o->y1, v[1] / v[2]);
    }
    if (!(o->nearest > 0))
        *o = (scene_outline){-wide, -high, wide, high, o->nearest};
    return !behind;
}

/* Looks at `target` from `distance`. */
static void look_from_south(scene_camera *c, const double target[3], double distance, double fov, int width, int height)
{
    const double eye[3] = {target[0], target[1] - distance * cos(pitch * radian),
                           target[2] + distance * sin(pitch * radian)};
    scene_camera_look(c, eye, target, fov, width, height);
}

static bool fits(const scene_camera *c, const scene_box *box, scene_outline *o)
{
    scene_camera_outline(c, box, o);
    return o->nearest > 0 && o->x1 - o->x0 <= margin * c->width && o->y1 - o->y0 <= margin * c->height;
}

void scene_camera_fit(scene_camera *camera, const scene_box *box, double fov, int width, int height)
{
    double target[3], size = 0;
    for (int k = 0; k < 3; k++) {
        target[k] = box->low[k] / 2 + box->high[k] / 2;
        size += box->high[k] - box->low[k];
    }
    for (int round = 0; round < 6; round++) {
        scene_outline o;
        double low = -10, high = 20; /* logarithms of distance / size: 0.001 of it, where nothing fits, to a million */
        for (int step = 0; step < 48; step++) {
            double middle = (low + high) / 2;
            look_from_south(camera, target, size * exp2(middle), fov, width, height);
            if (fits(camera, box, &o))
                high = middle;
            else
                low = middle;
        }
        double distance = size * exp2(high);
        look_from_south(camera, target, distance, fov, width, height);
        fits(camera, box, &o);
        /* move the middle of the outline to that of the picture */
        double shift = (o.y0 + o.y1) / 2 / camera->focal * distance;
        for (int k = 0; k < 3; k++)
            target[k] += camera->down[k] * shift;
    }
}
