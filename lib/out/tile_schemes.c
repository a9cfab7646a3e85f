#include "lib/out/tile_schemes.h"

tl_status tl_write_terrain_tiles(const tl_source *source, const char *folder, const tl_tiles_options *options,
                                 tl_tiles_report *out, tl_error *error)
{
    static const tl_tiles_options defaults;
    options = options ? options : &defaults;
    return options->format == TL_TILES_3D ? out_write_3d_tiles(source, folder, options, out, error)
                                          : out_write_quantized_tiles(source, folder, options, out, error);
}
