/* The options of a picture from a point of view, and of what is measured in it. */
#ifndef CMD_PICTURE_OPTIONS_H
#define CMD_PICTURE_OPTIONS_H

#include "cmd/options.h"
#include "lib/talus.h"

#include <jansson.h>

typedef struct picture_options {
    tl_view_picture_options look;
    const char *picture;
    bool azimuth_given, elevation_given;
} picture_options;

/* The rows of the options of light and air in a `picture_options`, for use inside of an array of options. */
#define LOOK_OPTIONS(p)                                                                                             \
    {"sun-azimuth",                                                                                                 \
     0,                                                                                                             \
     OPTION_NUMBER,                                                                                                 \
     &(p).look.sun_azimuth,                                                                                         \
     &(p).azimuth_given,                                                                                            \
     "DEG",                                                                                                         \
     "of a picture: clockwise from north, 0...360 (default: 315)",                                                  \
     0,                                                                                                             \
     360,                                                                                                           \
     NULL},                                                                                                         \
        {"sun-elevation",                                                                                           \
         0,                                                                                                         \
         OPTION_NUMBER,                                                                                             \
         &(p).look.sun_elevation,                                                                                   \
         &(p).elevation_given,                                                                                      \
         "DEG",                                                                                                     \
         "above the horizon, 1...90 (default: 45)",                                                                 \
         1,                                                                                                         \
         90,                                                                                                        \
         NULL},                                                                                                     \
        {"haze",                                                                                                    \
         0,                                                                                                         \
         OPTION_NUMBER,                                                                                             \
         &(p).look.haze,                                                                                            \
         NULL,                                                                                                      \
         "METRES",                                                                                                  \
         "at which half of the light is lost, 1...1e9 (default: clear air)",                                        \
         1,                                                                                                         \
         1e9,                                                                                                       \
         NULL},                                                                                                     \
        {"colour",                                                                                                  \
         0,                                                                                                         \
         OPTION_TEXT,                                                                                               \
         &(p).look.colour,                                                                                          \
         NULL,                                                                                                      \
         "FILE|LAYER",                                                                                              \
         "a raster of red, green and blue in the DEM's CRS; normal, slope or splat of the DEM; or hypsometric: by " \
         "height, the default",                                                                                     \
         0,                                                                                                         \
         0,                                                                                                         \
         NULL},                                                                                                     \
        {"grey", 0, OPTION_FLAG, &(p).look.grey, NULL, NULL, "shade only, no colours by height", 0, 0, NULL},       \
    {                                                                                                               \
        "facets", 0, OPTION_FLAG, &(p).look.facets, NULL, NULL,                                                     \
            "light each triangle by itself, so that one sees them", 0, 0, NULL                                      \
    }
/* Of one picture: */
#define PICTURE_OPTIONS(p)                                                                                             \
    {"picture", 'p', OPTION_TEXT, &(p).picture, NULL, "FILE.png", "draw what is seen (with this, -o may be left out)", \
     0,         0,   NULL},                                                                                            \
        {"depth-map",                                                                                                  \
         0,                                                                                                            \
         OPTION_TEXT,                                                                                                  \
         &(p).look.depth,                                                                                              \
         NULL,                                                                                                         \
         "FILE.exr",                                                                                                   \
         "of the picture: metres ahead of the eye at the middle of each pixel",                                        \
         0,                                                                                                            \
         0,                                                                                                            \
         NULL},                                                                                                        \
        LOOK_OPTIONS(p)

/* Whether a name ends with .png. */
bool picture_is_png(const char *path);
/* Completes what was parsed. False: told on stderr, for wrong usage. */
bool picture_options_ok(picture_options *options);

/* What tl_view_measure found, for people (two lines) and as JSON. */
enum { VIEW_REPORT_TEXT = 560 };
void view_report_text(const tl_view_report *report, char *text, size_t size);
json_t *view_errors_json(const tl_view_errors *errors);
json_t *view_report_json(const tl_view_report *report);

#endif
