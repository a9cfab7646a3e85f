/* The options of a view, which several commands share. */
#ifndef CMD_VIEW_OPTIONS_H
#define CMD_VIEW_OPTIONS_H

#include "cmd/options.h"
#include "lib/talus.h"

typedef struct view_options {
    tl_view view; /* what the options say; defaults elsewhere */
    const char *camera, *viewport;
    bool eye_given, heading_given, pitch_given, roll_given, fov_given, refraction_given;
} view_options;

/* The rows of the options in a `view_options`, for use inside of an array of options. */
#define VIEW_OPTIONS(v)                                                                                                  \
    {"eye",                                                                                                              \
     0,                                                                                                                  \
     OPTION_TRIPLE,                                                                                                      \
     (v).view.eye,                                                                                                       \
     &(v).eye_given,                                                                                                     \
     "LON,LAT,HEIGHT",                                                                                                   \
     "where to look from: degrees, metres above the datum; columns and negative rows where there is no CRS",             \
     0,                                                                                                                  \
     0,                                                                                                                  \
     NULL},                                                                                                              \
        {"target",                                                                                                       \
         0,                                                                                                              \
         OPTION_TRIPLE,                                                                                                  \
         (v).view.target,                                                                                                \
         &(v).view.target_given,                                                                                         \
         "LON,LAT,HEIGHT",                                                                                               \
         "where to look, as --eye, instead of --heading and --pitch",                                                    \
         0,                                                                                                              \
         0,                                                                                                              \
         NULL},                                                                                                          \
        {"heading",                                                                                                      \
         0,                                                                                                              \
         OPTION_NUMBER,                                                                                                  \
         &(v).view.heading,                                                                                              \
         &(v).heading_given,                                                                                             \
         "DEG",                                                                                                          \
         "clockwise from north, -360...360 (default: 0)",                                                                \
         -360,                                                                                                           \
         360,                                                                                                            \
         NULL},                                                                                                          \
        {"pitch",                                                                                                        \
         0,                                                                                                              \
         OPTION_NUMBER,                                                                                                  \
         &(v).view.pitch,                                                                                                \
         &(v).pitch_given,                                                                                               \
         "DEG",                                                                                                          \
         "above the horizon, -90 (down) ... 90 (default: 0)",                                                            \
         -90,                                                                                                            \
         90,                                                                                                             \
         NULL},                                                                                                          \
        {"roll", 0,   OPTION_NUMBER, &(v).view.roll, &(v).roll_given, "DEG", "right side down, -360...360 (default: 0)", \
         -360,   360, NULL},                                                                                             \
        {"fov",                                                                                                          \
         0,                                                                                                              \
         OPTION_NUMBER,                                                                                                  \
         &(v).view.fov,                                                                                                  \
         &(v).fov_given,                                                                                                 \
         "DEG",                                                                                                          \
         "horizontal field of view, 0.01...179 (default: 60)",                                                           \
         0.01,                                                                                                           \
         179,                                                                                                            \
         NULL},                                                                                                          \
        {"viewport", 0, OPTION_TEXT, &(v).viewport, NULL, "WxH", "pixels, each 1...32768 (default: 1920x1080)",          \
         0,          0, NULL},                                                                                           \
        {"above-ground",                                                                                                 \
         0,                                                                                                              \
         OPTION_FLAG,                                                                                                    \
         &(v).view.above_ground,                                                                                         \
         NULL,                                                                                                           \
         NULL,                                                                                                           \
         "the eye's height counts from the ground",                                                                      \
         0,                                                                                                              \
         0,                                                                                                              \
         NULL},                                                                                                          \
        {"target-above-ground",                                                                                          \
         0,                                                                                                              \
         OPTION_FLAG,                                                                                                    \
         &(v).view.target_above_ground,                                                                                  \
         NULL,                                                                                                           \
         NULL,                                                                                                           \
         "the target's height counts from the ground",                                                                   \
         0,                                                                                                              \
         0,                                                                                                              \
         NULL},                                                                                                          \
        {"projected", 0, OPTION_FLAG, &(v).view.projected, NULL, NULL, "eye and target are in CRS coordinates",          \
         0,           0, NULL},                                                                                          \
        {"flat", 0, OPTION_FLAG, &(v).view.flat, NULL, NULL, "no curvature of the Earth", 0, 0, NULL},                   \
        {"refraction",                                                                                                   \
         0,                                                                                                              \
         OPTION_NUMBER,                                                                                                  \
         &(v).view.refraction,                                                                                           \
         &(v).refraction_given,                                                                                          \
         "K",                                                                                                            \
         "share of the curvature that the air takes off, 0...0.9; 0.13 by day (default: 0)",                             \
         0,                                                                                                              \
         0.9,                                                                                                            \
         NULL},                                                                                                          \
    {                                                                                                                    \
        "camera", 0, OPTION_TEXT, &(v).camera, NULL, "FILE",                                                             \
            "the view from a JSON or glTF; options beside it go before what it says", 0, 0, NULL                         \
    }

/* Completes what was parsed. False: told on stderr, for wrong usage. */
bool view_options_ok(view_options *options);
/* Puts what the options say over a view that comes from a file. */
void view_options_apply(const view_options *options, tl_view *view);
/* The one view that is meant: the options' alone, or over that of the camera file. */
tl_status view_options_view(const view_options *options, tl_view *out, tl_error *error);

#endif
