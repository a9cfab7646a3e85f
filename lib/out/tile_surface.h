/* The surface of a drawn tile in space: cut where the lattice ends, with normals and skirts, and a region around it. */
#ifndef OUT_TILE_SURFACE_H
#define OUT_TILE_SURFACE_H

#include "lib/out/tile_glb.h"

typedef struct out_surface_vertex {
    double x, y, z;     /* vertex of the finest lattice, metres */
    double gradient[2]; /* metres of height in a cell of the tile's lattice */
    double longitude, latitude;
    double at[3];                /* metres in the axes of the Earth */
    float normal[3], tangent[3]; /* tangent: along rows, where a picture has the normals */
} out_surface_vertex;

typedef struct out_surface {
    const scene_own_lattice *lattice;
    scene_placer *placer;
    out_surface_vertex *vertices;
    uint32_t *indices;
    size_t vertex_count, index_count, ground_count; /* ground: indices without skirts */
    size_t vertex_room, index_room;
    uint32_t *table; /* of cut vertices, by place */
} out_surface;

tl_status out_surface_init(out_surface *surface, const scene_own_lattice *lattice, tl_error *error);
void out_surface_finish(out_surface *surface);
/* Fills in all but the rounding: facts->quantum must be known to be added to the region by out_surface_widen. */
tl_status out_surface_build(out_surface *surface, const out_glb_tile *tile, out_glb_facts *facts, tl_error *error);
/* Makes room in the region for vertices that move by up to so many metres. */
void out_surface_widen(out_glb_facts *facts, double metres);

#endif
