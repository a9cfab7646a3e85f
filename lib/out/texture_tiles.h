/* A mesh in square tiles of its lattice, each fine enough for a texture of its own. */
#ifndef OUT_TEXTURE_TILES_H
#define OUT_TEXTURE_TILES_H

#include "lib/talus.h"

#include <stdbool.h>

/* Texels have the spacing of the finest vertices of a tile's triangles. */
typedef struct out_texture_tile {
    size_t first_vertex, vertices;
    size_t first_triangle, triangles;
    int64_t low[2], high[2]; /* columns and rows of its triangles */
    int spacing;             /* logarithm of the way between texels, in samples of the lattice */
} out_texture_tile;

typedef struct out_texture_tiles {
    out_texture_tile *tiles;
    size_t count;
    tl_mesh mesh; /* its triangles tile by tile, vertices on borders once for each tile; CRS and record are borrowed */
    uint32_t *from; /* of each of its vertices, that of the original */
} out_texture_tiles;

/* The logarithm of the shortest edge of any triangle, in samples along a column or row; walls have none. */
int out_finest_edge(const tl_mesh *mesh);
/* Cuts a mesh over `ground`. A tile is divided while its finest triangles' vertices are nearer than 1/256 of its side,
 * or 1/512 and so on where that makes fewer than some hundreds; triangles that lie in no quarter stay whole, with a
 * tile of the larger size. All spacings are doubled until the texels of all are at most `most`. `path` is for messages.
 * After a failure there is nothing to finish. */
tl_status out_texture_tiles_init(out_texture_tiles *tiles, const tl_mesh *mesh, uint64_t most, const char *path,
                                 tl_error *error);
void out_texture_tiles_finish(out_texture_tiles *tiles);

#endif
