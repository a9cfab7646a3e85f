/* Contents of 3D Tiles: a drawn tile as a GLB in the axes of the Earth. */
#ifndef OUT_TILE_GLB_H
#define OUT_TILE_GLB_H

#include "lib/out/tile_pyramid.h"
#include "lib/scene/own_lattice.h"

/* Pictures on a tile, PNGs. */
typedef struct out_tile_pictures {
    const unsigned char *bytes[2]; /* colours, normals; NULL: none */
    size_t count[2];
    int cells; /* on a side of the part that they show, from the tile's first vertex on; a texel is a vertex */
} out_tile_pictures;

/* What is the same for all tiles. */
typedef struct out_glb_style {
    bool normals, compressed;
    const char *attribution; /* NULL: none */
} out_glb_style;

/* A tile: its first vertex (x, y) and the cells of its lattice in vertices of the finest. */
typedef struct out_glb_tile {
    const out_drawn_tile *drawn;
    int64_t x, y, step;
    double skirt;                      /* metres down from its edges, where it has neighbours */
    const out_tile_pictures *pictures; /* NULL: none */
} out_glb_tile;

/* What the file holds. */
typedef struct out_glb_facts {
    double region[6]; /* contains it: west, south, east, north in radians, east of west, beyond half a turn if need be;
                         lowest and highest height, metres */
    double quantum;   /* positions are rounded to multiples of it, a power of two, in each axis of the Earth */
    double steepest;  /* slope of its triangles, skirts aside */
    size_t triangles, vertices;
} out_glb_facts;

typedef struct out_glb_encoder out_glb_encoder;

/* For one thread at a time. */
out_glb_encoder *out_glb_encoder_create(const scene_own_lattice *lattice, const out_glb_style *style, tl_error *error);
void out_glb_encoder_destroy(out_glb_encoder *encoder);
/* *bytes, the encoder's own until the next call, becomes the file; *count 0: nothing of the tile is known. */
tl_status out_glb_encode(out_glb_encoder *encoder, const out_glb_tile *tile, const void **bytes, size_t *count,
                         out_glb_facts *facts, tl_error *error);

#endif
