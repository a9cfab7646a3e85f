/* The kinds of pyramids, for the one function that users call. */
#ifndef OUT_TILE_SCHEMES_H
#define OUT_TILE_SCHEMES_H

#include "lib/talus.h"

/* lib/talus.h: tl_write_terrain_tiles, by format. */
tl_status out_write_quantized_tiles(const tl_source *source, const char *folder, const tl_tiles_options *options,
                                    tl_tiles_report *out, tl_error *error);
tl_status out_write_3d_tiles(const tl_source *source, const char *folder, const tl_tiles_options *options,
                             tl_tiles_report *out, tl_error *error);

#endif
