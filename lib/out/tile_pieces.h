/* What a finished block of a pyramid leaves behind for the next coarser lattice, for going on after a break and for the
 * end: its tiles with their sizes and checksums, every second vertex in each direction, and what the cells between
 * these have lost. A piece appears when all tiles of its block are there, under FOLDER/.talus. */
#ifndef OUT_TILE_PIECES_H
#define OUT_TILE_PIECES_H

#include "lib/scene/tile_block.h"
#include "lib/talus.h"

enum { OUT_PIECE = SCENE_BLOCK / 2, OUT_PIECE_ROW = OUT_PIECE + 1 }; /* cells and vertices on a side */

typedef struct out_piece_tile {
    int32_t level;
    uint32_t checksum;          /* CRC-32 of the file */
    int64_t column, row, bytes; /* bytes 0: it has no file */
    uint64_t triangles, vertices;
    double error;     /* metres, a bound */
    double region[6]; /* west, south, east, north (radians), lowest and highest height; not of all schemes */
} out_piece_tile;

typedef struct out_piece {
    int level; /* of the block's lattice */
    int64_t column, row;
    double resampling; /* metres: see tl_tiles_report */
    uint64_t tile_count;
    out_piece_tile *tiles;
    /* Of all vertices, those too that the next blocks to the east and north begin with: at a pole, and beside blocks
     * where nothing is known, nobody else has them. NULL in a piece without tiles. */
    float *z;    /* OUT_PIECE_ROW^2; NaN: not known */
    float *lost; /* OUT_PIECE^2 */
} out_piece;

/* Writes FOLDER/.talus/LEVEL_COLUMN_ROW.piece. */
tl_status out_piece_save(const out_piece *piece, const char *folder, tl_error *error);
/* Reads it; *found becomes whether it is there and whole. With `samples` false z and lost stay NULL. */
tl_status out_piece_load(out_piece *piece, const char *folder, bool samples, bool *found, tl_error *error);
void out_piece_finish(out_piece *piece);

#endif
