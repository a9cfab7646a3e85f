/* Layers of a tile as pictures for its content: made from the heights of the tile's own lattice, a texel a vertex, so
 * that neighbours have the same texels on their common edge. */
#ifndef OUT_TILE_PICTURES_H
#define OUT_TILE_PICTURES_H

#include "lib/out/tile_glb.h"

typedef struct out_tile_painter out_tile_painter;

/* For one thread, and the tiles of the pyramid's lattice in work. Borrows the pyramid. */
out_tile_painter *out_tile_painter_create(const out_pyramid *pyramid, tl_error *error);
void out_tile_painter_destroy(out_tile_painter *painter);
/* Paints what options->textures asks for; `out` is the painter's own until the next call. tile->pictures is not looked
 * at. */
tl_status out_tile_paint(out_tile_painter *painter, const out_glb_tile *tile, out_tile_pictures *out, tl_error *error);

#endif
