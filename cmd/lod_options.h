/* The options of what a view is chosen from and how, which `view` and `fly` share. */
#ifndef CMD_LOD_OPTIONS_H
#define CMD_LOD_OPTIONS_H

#include "cmd/command.h"

#include <jansson.h>

typedef struct lod_options {
    tl_lod_options lod;
    tl_field_options field;
    int64_t levels, seed, max_level, budget;
    bool pixel_error_given, levels_given;
    const char *bands, *error_cache;
    int selector;
    bool keep[4];
} lod_options;

extern const char *const selector_names[]; /* by tl_selector, ended by NULL */

/* The rows of the options in a `lod_options`, for use inside of an array of options. */
#define DETAIL_OPTIONS(v)                                                                           \
    {"levels",                                                                                      \
     'l',                                                                                           \
     OPTION_INTEGER,                                                                                \
     &(v).levels,                                                                                   \
     NULL,                                                                                          \
     "N",                                                                                           \
     "halvings of the DEM's spacing that there may be, 0...30 (default: 6, 64 times finer)",        \
     0,                                                                                             \
     30,                                                                                            \
     NULL},                                                                                         \
        FRACTAL_OPTIONS((v).seed, (v).field),                                                       \
    {                                                                                               \
        "error-cache", 0, OPTION_TEXT, &(v).error_cache, NULL, "FILE",                              \
            "a GeoTIFF that keeps the DEM's errors: used again while it stays the same", 0, 0, NULL \
    }

#define LOD_OPTIONS(v)                                                                                                  \
    {"lod",                                                                                                             \
     0,                                                                                                                 \
     OPTION_CHOICE,                                                                                                     \
     &(v).selector,                                                                                                     \
     NULL,                                                                                                              \
     "NAME",                                                                                                            \
     "quadtree, breadth first; chunk, squares with one step each; or roam, by queues (default: quadtree)",              \
     0,                                                                                                                 \
     0,                                                                                                                 \
     selector_names},                                                                                                   \
        {"pixel-error",                                                                                                 \
         0,                                                                                                             \
         OPTION_NUMBER,                                                                                                 \
         &(v).lod.pixel_error,                                                                                          \
         &(v).pixel_error_given,                                                                                        \
         "P",                                                                                                           \
         "pixels by which the picture may differ from that of all detail, 1e-9...1e9 (default: 1; none with "           \
         "--budget)",                                                                                                   \
         1e-9,                                                                                                          \
         1e9,                                                                                                           \
         NULL},                                                                                                         \
        {"budget", 0,   OPTION_INTEGER, &(v).budget, NULL, "N", "at most so many triangles, 1...4e9 (default: any)", 1, \
         4e9,      NULL},                                                                                               \
        {"distance-bands",                                                                                              \
         0,                                                                                                             \
         OPTION_TEXT,                                                                                                   \
         &(v).bands,                                                                                                    \
         NULL,                                                                                                          \
         "M,M,...",                                                                                                     \
         "instead of a pixel error: metres within which cells are of 1, 2, 4, ... units; rising",                       \
         0,                                                                                                             \
         0,                                                                                                             \
         NULL},                                                                                                         \
        {"max-level",                                                                                                   \
         0,                                                                                                             \
         OPTION_INTEGER,                                                                                                \
         &(v).max_level,                                                                                                \
         &(v).lod.max_level_given,                                                                                      \
         "N",                                                                                                           \
         "finest level that is used, -30...30; below 0 coarser than the DEM (default: --levels)",                       \
         -30,                                                                                                           \
         30,                                                                                                            \
         NULL},                                                                                                         \
        {"geomorph",                                                                                                    \
         0,                                                                                                             \
         OPTION_FLAG,                                                                                                   \
         &(v).lod.morph,                                                                                                \
         NULL,                                                                                                          \
         NULL,                                                                                                          \
         "move vertices to their places as the eye comes nearer, so that none comes with a jump",                       \
         0,                                                                                                             \
         0,                                                                                                             \
         NULL},                                                                                                         \
        {"no-cull-frustum", 0, OPTION_FLAG, &(v).keep[0], NULL, NULL, "keep what is beside the screen", 0, 0, NULL},    \
        {"no-cull-back", 0, OPTION_FLAG, &(v).keep[1], NULL, NULL, "keep ground that looks away", 0, 0, NULL},          \
        {"no-cull-horizon",                                                                                             \
         0,                                                                                                             \
         OPTION_FLAG,                                                                                                   \
         &(v).keep[2],                                                                                                  \
         NULL,                                                                                                          \
         NULL,                                                                                                          \
         "keep what is behind the Earth's curve",                                                                       \
         0,                                                                                                             \
         0,                                                                                                             \
         NULL},                                                                                                         \
    {                                                                                                                   \
        "no-cull-ridge", 0, OPTION_FLAG, &(v).keep[3], NULL, NULL, "keep what is behind nearer ground", 0, 0, NULL      \
    }

/* Completes what was parsed. False: told on stderr, for wrong usage. */
bool lod_options_ok(lod_options *options);

/* What triangles are chosen from. */
typedef struct lod_ground {
    opened_input opened;
    tl_pyramid *pyramid;
    tl_source *field;
} lod_ground;

/* Opens the inputs; errors count in `frame`, of a mesh file `output` (NULL: none is written). */
tl_status lod_ground_open(const common *shared, lod_options *options, const arguments *inputs, tl_frame frame,
                          const char *output, const tl_run *run, lod_ground *out, tl_error *error);
void lod_ground_close(lod_ground *ground);

/* Tells of an eye that is under the ground. */
void lod_warn_of_ground(const common *shared, const tl_lod_stats *stats);
/* The statistics for machines; a new reference. */
json_t *lod_stats_json(const tl_lod_stats *stats);

#endif
