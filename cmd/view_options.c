#include "cmd/view_options.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

enum { LARGEST = 32768 };

static bool side(const char *text, char **end, int *out)
{
    errno = 0;
    long value = strtol(text, end, 10);
    *out = (int)value;
    return *end != text && errno == 0 && value >= 1 && value <= LARGEST;
}

static bool take_viewport(view_options *o)
{
    char *end;
    if (!o->viewport)
        return true;
    if (side(o->viewport, &end, &o->view.width) && (*end == 'x' || *end == 'X') &&
        side(end + 1, &end, &o->view.height) && !*end)
        return true;
    complain("--viewport: WIDTHxHEIGHT is wanted, each from 1 to %d, as 1920x1080, not '%s'", LARGEST, o->viewport);
    return false;
}

bool view_options_ok(view_options *o)
{
    if (!take_viewport(o))
        return false;
    if (!o->eye_given && !o->camera) {
        complain("where to look from is wanted: --eye, or --camera with a file");
        return false;
    }
    if (o->view.target_given && (o->heading_given || o->pitch_given)) {
        complain("--target goes without --heading and --pitch");
        return false;
    }
    if (o->view.target_above_ground && !o->view.target_given && !o->camera) {
        complain("--target-above-ground goes with --target");
        return false;
    }
    return true;
}

static void apply_direction(const view_options *o, tl_view *view)
{
    if (o->view.target_given) {
        view->target_given = true;
        memcpy(view->target, o->view.target, sizeof view->target);
        view->target_above_ground = o->view.target_above_ground;
    } else if (o->heading_given || o->pitch_given) {
        view->target_given = false;
    }
    if (o->heading_given)
        view->heading = o->view.heading;
    if (o->pitch_given)
        view->pitch = o->view.pitch;
    if (o->roll_given)
        view->roll = o->view.roll;
}

void view_options_apply(const view_options *o, tl_view *view)
{
    if (o->eye_given) {
        memcpy(view->eye, o->view.eye, sizeof view->eye);
        view->above_ground = o->view.above_ground;
    }
    apply_direction(o, view);
    if (o->fov_given)
        view->fov = o->view.fov;
    if (o->viewport) {
        view->width = o->view.width;
        view->height = o->view.height;
    }
    if (o->refraction_given)
        view->refraction = o->view.refraction;
    view->flat |= o->view.flat;
    view->projected |= o->view.projected;
    view->above_ground |= o->view.above_ground;
    view->target_above_ground |= o->view.target_above_ground;
}

tl_status view_options_view(const view_options *o, tl_view *out, tl_error *error)
{
    tl_view view = {0};
    tl_status status = o->camera ? tl_view_read(o->camera, &view, error) : TL_OK;
    if (status != TL_OK)
        return status;
    view_options_apply(o, &view);
    *out = view;
    return TL_OK;
}
