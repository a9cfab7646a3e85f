#include "cmd/picture_options.h"

#include "cmd/command.h"

#include <stdio.h>
#include <string.h>

bool picture_is_png(const char *path)
{
    return command_ends_with(path, ".png");
}

bool picture_options_ok(picture_options *o)
{
    if (o->picture && !picture_is_png(o->picture)) {
        complain("--picture: a name that ends with .png is wanted, not '%s'", o->picture);
        return false;
    }
    if (o->look.depth && !o->picture) {
        complain("--depth-map goes with --picture");
        return false;
    }
    if (o->look.depth && !command_ends_with(o->look.depth, ".exr")) {
        complain("--depth-map: a name that ends with .exr is wanted, not '%s'", o->look.depth);
        return false;
    }
    if (o->look.colour && strcmp(o->look.colour, "hypsometric") == 0)
        o->look.colour = NULL;
    if (o->look.colour && o->picture && strcmp(o->look.colour, o->picture) == 0) {
        complain("%s: is the picture's colours; name another --picture", o->picture);
        return false;
    }
    if (o->look.colour && o->look.grey) {
        complain("--grey goes without --colour");
        return false;
    }
    if (o->azimuth_given && !o->elevation_given)
        o->look.sun_elevation = 45;
    if (o->elevation_given && !o->azimuth_given)
        o->look.sun_azimuth = 315;
    return true;
}

static int errors_text(const char *name, const tl_view_errors *e, char *text, size_t size)
{
    return snprintf(text, size,
                    "%s %.3g pixels at half of %llu, %.3g at 90 %%, %.3g at 99 %%, %.3g at 99.9 %%, %.3g at most", name,
                    e->half, (unsigned long long)e->count, e->ninety, e->ninety_nine, e->thousand, e->largest);
}

void view_report_text(const tl_view_report *r, char *text, size_t size)
{
    char parallax[240], silhouette[240];
    errors_text("parallax", &r->parallax, parallax, sizeof parallax);
    errors_text("silhouettes", &r->silhouette, silhouette, sizeof silhouette);
    snprintf(text, size, "%s; %llu points are missing\nmeasured: %s", parallax, (unsigned long long)r->missing,
             silhouette);
}

json_t *view_errors_json(const tl_view_errors *e)
{
    return json_pack("{s:I, s:f, s:f, s:f, s:f, s:f}", "count", (json_int_t)e->count, "p50", e->half, "p90", e->ninety,
                     "p99", e->ninety_nine, "p999", e->thousand, "max", e->largest);
}

json_t *view_report_json(const tl_view_report *r)
{
    return json_pack("{s:o, s:o, s:I}", "parallax", view_errors_json(&r->parallax), "silhouette",
                     view_errors_json(&r->silhouette), "missing", (json_int_t)r->missing);
}
