/* Blocks of a lattice from which the tiles of a pyramid are cut.
 *
 * Work goes in blocks of SCENE_BLOCK cells of a lattice, with a rim of SCENE_RIM cells of their neighbours around.
 * Tiles are squares of the lattice's quadtree, of at most SCENE_RIM cells, and are drawn by the strict framework's
 * rule: a vertex splits the triangles whose hypotenuse it halves when its error is above the bound (dem/framework.h).
 * Which vertices split depends on the samples of a tile and of those around it alone, all of which lie within the rim,
 * and the errors of a vertex come out alike in every block that holds it. So tiles of one level fit together without a
 * crack, however they were made.
 *
 * The error of a vertex is that of leaving it and all that depends on it out, measured against the samples of the
 * block; what those leave out themselves of the finer lattices, `lost`, is added. */
#ifndef SCENE_TILE_BLOCK_H
#define SCENE_TILE_BLOCK_H

#include "lib/talus.h"

enum {
    SCENE_BLOCK = 1024,
    SCENE_RIM = 256,
    SCENE_BLOCK_SIDE = SCENE_BLOCK + 2 * SCENE_RIM, /* cells */
    SCENE_BLOCK_VERTICES = SCENE_BLOCK_SIDE + 1,    /* in a row */
    SCENE_TILE_SIZES = 17,                          /* 2 log2(SCENE_RIM) + 1, from 1: see tl_size_of */
};

typedef struct scene_block {
    float *z;      /* SCENE_BLOCK_VERTICES^2 heights from the south-western corner of the rim; NaN: void */
    float *lost;   /* SCENE_BLOCK_SIDE^2, a cell each: how far finer lattices are from it; NULL: nothing is lost */
    float *errors; /* by vertex, filled in by scene_block_measure */
    float *rising; /* room for it, where something is lost */
} scene_block;

/* Room for the heights, and for what is lost if asked for. */
tl_status scene_block_init(scene_block *block, bool lost, tl_error *error);
void scene_block_finish(scene_block *block);
/* Fills in the errors. */
tl_status scene_block_measure(scene_block *block, tl_error *error);

/* A tile's mesh: vertices (i, j) in cells of the lattice from its south-western corner, triangles counter-clockwise. */
typedef struct scene_tile_mesh {
    int cells; /* on a side */
    size_t vertex_count, triangle_count;
    struct scene_tile_vertex {
        int16_t i, j;
        float z;
    } * vertices;
    uint32_t *indices;
    double error;     /* of the vertices that were left out, the greatest */
    double lost;      /* of the cells that are drawn in full, the most that they have lost */
    int32_t *numbers; /* of the vertices that are taken, by place; -1 */
} scene_tile_mesh;

tl_status scene_tile_mesh_init(scene_tile_mesh *mesh, tl_error *error);
void scene_tile_mesh_finish(scene_tile_mesh *mesh);

/* Triangles with voids among their samples are split down to the cells, and those that have one are left out.
 *
 * Draws the tile of `cells` cells (a power of two) whose first vertex is vertex (x, y) of the block. limits[size]: the
 * greatest error that a vertex which splits triangles of this size may leave. */
void scene_tile_draw(const scene_block *block, int x, int y, int cells, const double limits[SCENE_TILE_SIZES],
                     scene_tile_mesh *mesh);

#endif
