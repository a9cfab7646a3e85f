/* Tiles of quantized-mesh 1.0, gzipped [github.com/CesiumGS/quantized-mesh]. */
#ifndef OUT_QUANTIZED_MESH_H
#define OUT_QUANTIZED_MESH_H

#include "lib/scene/tile_block.h"
#include "lib/talus.h"

/* A tile of the geographic scheme, drawn from a block. */
typedef struct out_terrain_tile {
    int level;
    int64_t column, row; /* from the south-west */
    const scene_tile_mesh *mesh;
    const scene_block *block;
    int x, y;             /* of the tile's first vertex in the block */
    bool normals;         /* write them */
    const char *metadata; /* JSON of the metadata extension; NULL: none */
} out_terrain_tile;

/* Room for tiles, to be used again by one thread. */
typedef struct out_terrain_buffer {
    unsigned char *raw, *packed; /* `packed` is the file */
    size_t raw_count, raw_room, packed_count, packed_room;
    struct libdeflate_compressor *compressor;
} out_terrain_buffer;

tl_status out_terrain_buffer_init(out_terrain_buffer *buffer, tl_error *error);
void out_terrain_buffer_finish(out_terrain_buffer *buffer);

/* Heights are rounded to *quantum, a power of two, which is the same for all tiles whose relief needs it; none moves by
 * more than half of it. */
tl_status out_terrain_encode(const out_terrain_tile *tile, out_terrain_buffer *buffer, double *quantum,
                             tl_error *error);

#endif
