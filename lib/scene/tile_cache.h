/* Heights of a field's lattices in tiles of 64 x 64 vertices, made when they are wanted, with the marks of the vertices
 * that a mesh has; and what is known of the ground in blocks of 64 x 64 cells of the elevation model.
 *
 * Vertices are named by column and row on the lattice of level `levels`, the finest that is used: (x, y) is sample
 * (x, y) / 2^levels of the model. A vertex of a level above 0 lies in a tile of that level; those of levels 0 to -2 lie
 * in tiles of level 0, those of the next six in tiles of level -3, and so on: these come from the pyramid's overview,
 * so that coarse triangles, which reach over the rim of what is seen, have nothing read. */
#ifndef SCENE_TILE_CACHE_H
#define SCENE_TILE_CACHE_H

#include "lib/talus.h"

enum { SCENE_TILE_LOG = 6, SCENE_TILE = 1 << SCENE_TILE_LOG, SCENE_TILE_SLOTS = SCENE_TILE * SCENE_TILE };

static const uint32_t SCENE_NO_VERTEX = UINT32_MAX;

typedef struct scene_tile {
    uint64_t key;
    bool made;
    uint32_t marked; /* number of marks; one with any stays */
    uint64_t wanted; /* when it was last wanted */
    uint64_t marks[SCENE_TILE];
    /* Of a marked vertex its index, of the others the height. */
    union {
        float z;
        uint32_t vertex;
    } slots[SCENE_TILE_SLOTS];
} scene_tile;

/* A vertex in its tile. */
typedef struct scene_slot {
    scene_tile *tile;
    uint32_t at;
} scene_slot;

static inline bool scene_slot_marked(scene_slot s)
{
    return s.tile->marks[s.at >> SCENE_TILE_LOG] >> (s.at & (SCENE_TILE - 1)) & 1;
}

/* What is known of 64 x 64 cells, and of squares of 2, 4, ... 64 of them: see scene_block_at. */
typedef struct scene_block scene_block;
typedef struct scene_cells {
    float strength;  /* the largest factor on the fractal detail */
    float bend;      /* the largest distance of smooth ground between the samples from the triangles of a cell */
    float rise;      /* the largest height difference of neighbouring samples */
    float low, high; /* of the samples; low > high: all void. Of squares of 4 cells or more */
    bool voids;      /* some sample is void, or beyond the raster; likewise */
} scene_cells;

typedef struct scene_tiles scene_tiles;

typedef struct scene_tile_counts {
    uint64_t tiles_made, tiles_used, samples_made, dem_blocks, dem_samples;
} scene_tile_counts;

/* `field` is one of tl_field_create over `dem`, whose samples nest. levels <= field->info.level. Borrows all three. */
scene_tiles *scene_tiles_create(const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid, int levels,
                                const tl_run *run, tl_error *error);
void scene_tiles_destroy(scene_tiles *tiles);

/* The vertex in its tile; the tile is NULL where there is none yet. `last`, of the caller's thread, makes it faster;
 * begin with NULL. */
scene_slot scene_tiles_find(const scene_tiles *tiles, int32_t x, int32_t y, const scene_tile **last);
/* The same; makes an empty tile where there is none, and asks for the height. One thread. */
tl_status scene_tiles_want(scene_tiles *tiles, int32_t x, int32_t y, scene_slot *out, tl_error *error);
/* Reads what was wanted, in parallel. Tiles without marks that were not wanted since the last time may go where memory
 * is short, and the slots of scene_tiles_want with them. */
tl_status scene_tiles_make(scene_tiles *tiles, const tl_run *run, tl_error *error);
/* Marks a vertex, or takes its mark away: `vertex` is then to be its height again. */
void scene_slot_mark(scene_slot slot, uint32_t vertex);
void scene_slot_unmark(scene_slot slot, float z);

/* The block of cell (i, j), empty until scene_tiles_make; a number from 0. They stay. */
tl_status scene_tiles_want_block(scene_tiles *tiles, int64_t i, int64_t j, uint32_t *block, tl_error *error);
/* The same of a block that is made; false: there is none. */
bool scene_tiles_find_block(const scene_tiles *tiles, int64_t i, int64_t j, uint32_t *block);
/* What is known of the square of 2^log cells that cell (i, j) lies in, log 0 ... 6. */
void scene_block_at(const scene_tiles *tiles, uint32_t block, int64_t i, int64_t j, int log, scene_cells *out);

/* What tiles and blocks take by now. */
size_t scene_tiles_bytes(const scene_tiles *tiles);
scene_tile_counts scene_tiles_counts(const scene_tiles *tiles);
/* Starts counting again: what has been read before counts for nothing then. */
void scene_tiles_count_again(scene_tiles *tiles);

#endif
