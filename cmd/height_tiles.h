/* Tiles of heights, of `talus tiles`. */
#ifndef CMD_HEIGHT_TILES_H
#define CMD_HEIGHT_TILES_H

#include "cmd/command.h"

typedef struct height_tiles {
    tl_grid_tiles_options options;
    int64_t tile;
    int compression;
    const char *range, *preset;
} height_tiles;

extern const char *const height_tile_compressions[];

#define HEIGHT_TILE_OPTIONS(h)                                                                                    \
    {"tile",                                                                                                      \
     0,                                                                                                           \
     OPTION_INTEGER,                                                                                              \
     &(h).tile,                                                                                                   \
     NULL,                                                                                                        \
     "N",                                                                                                         \
     "samples on a side, the outermost shared, odd (default: 257; of a preset: chosen)",                          \
     3,                                                                                                           \
     16385,                                                                                                       \
     NULL},                                                                                                       \
        {"range",                                                                                                 \
         0,                                                                                                       \
         OPTION_TEXT,                                                                                             \
         &(h).range,                                                                                              \
         NULL,                                                                                                    \
         "LOW,HIGH",                                                                                              \
         "of png and r16: heights of the least and the greatest value, for all tiles (default: measured)",        \
         0,                                                                                                       \
         0,                                                                                                       \
         NULL},                                                                                                   \
        {"compression",                                                                                           \
         0,                                                                                                       \
         OPTION_CHOICE,                                                                                           \
         &(h).compression,                                                                                        \
         NULL,                                                                                                    \
         "NAME",                                                                                                  \
         "of exr and tif (default: zip, deflate)",                                                                \
         0,                                                                                                       \
         0,                                                                                                       \
         height_tile_compressions},                                                                               \
    {                                                                                                             \
        "preset", 0, OPTION_TEXT, &(h).preset, NULL, "NAME",                                                      \
            "of png, r16 and exr: the finest level alone, with the sizes, names and order that a program wants: " \
            "unreal, unity, godot, blender, houdini",                                                             \
            0, 0, NULL                                                                                            \
    }

/* Reads what is left as text; told and false where it makes no sense. `format` is a name of a file's ending. */
bool height_tiles_ok(height_tiles *self, const char *format, const tl_tiles_options *parts);
/* Tells what a dry run expects, of tiles of any kind. */
void height_tiles_say_forecast(const common *shared, const tl_tiles_forecast *forecast, uint64_t bytes);
/* Makes the tiles and tells of them. */
tl_status height_tiles_make(const height_tiles *self, const common *shared, const char *format, const tl_source *source,
                            const tl_run *run, tl_error *error);

#endif
