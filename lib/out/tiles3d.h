/* What leads to the contents of 3D Tiles: tileset.json and subtrees. */
#ifndef OUT_TILES3D_H
#define OUT_TILES3D_H

#include "lib/out/tile_pyramid.h"
#include "lib/scene/own_lattice.h"

enum { OUT_SUBTREE_LEVELS = 5 };

/* A tile, its content or that of tiles below it. */
typedef struct out_node {
    int64_t column, row;
    double region[6];
    double error; /* metres, that of no tile below is greater */
    bool content;
} out_node;

typedef struct out_nodes {
    struct {
        out_node *nodes; /* by row and column */
        size_t count, room;
    } levels[OUT_TILE_LEVELS];
} out_nodes;

/* The tiles, and all above them. */
tl_status out_nodes_gather(const out_piece_tile *tiles, size_t count, int deepest, out_nodes *nodes, tl_error *error);
void out_nodes_finish(out_nodes *nodes);
const out_node *out_nodes_find(const out_nodes *nodes, int level, int64_t column, int64_t row);

/* Bytes of the subtree whose root is a tile of a level, to be freed; NULL when out of memory. Levels go down to
 * `deepest`. */
unsigned char *out_subtree_encode(const out_nodes *nodes, int level, int64_t column, int64_t row, int deepest,
                                  size_t *count);

/* Writes all subtrees, then tileset.json. */
tl_status out_tileset_write(const out_pyramid *pyramid, tl_error *error);

#endif
