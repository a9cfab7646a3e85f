/* Pictures of the ground below a mesh, as textures: texels are samples of a level of a source. */
#ifndef OUT_TEXTURE_H
#define OUT_TEXTURE_H

#include "lib/base/output.h"
#include "lib/scene/layers.h"
#include "lib/talus.h"

enum { OUT_TEXTURE_SIZE = 4096 }; /* texels on a side, at most, unless told otherwise */

typedef struct out_texture {
    tl_source *ground;       /* heights at the texels */
    const tl_source *whole;  /* whose range of heights the colours spread over */
    double first[2], step;   /* column and row of the first texel's centre, and the way to the next, in samples */
    int64_t low[2], high[2]; /* columns and rows of the mesh */
} out_texture;

/* The texels for the part of `surface` that the mesh covers: samples of its finest level that has at most `most` (0:
 * OUT_TEXTURE_SIZE) a side. Borrows `surface`, over whose finest lattice the mesh lies. */
tl_status out_texture_open(const tl_mesh *mesh, const tl_source *surface, int most, out_texture *out, tl_error *error);
/* The same of the columns and rows low ... high, at texels 2^spacing samples apart, which lie on the corners of a box
 * that has corners there; boxes side by side share those of their common edge. */
tl_status out_texture_open_box(const tl_source *surface, const int64_t low[2], const int64_t high[2], int spacing,
                               out_texture *out, tl_error *error);
void out_texture_close(out_texture *texture);
/* Texture coordinates of a sample: texel (p, q), whose centre is ((p + 1/2) / width, (q + 1/2) / height), lies on the
 * sample that it was made from. Beyond the outermost texels' centres they stop. */
void out_texture_place(const out_texture *texture, double i, double j, float uv[2]);
/* A layer (lib/scene/layers.h) as a PNG, in a file that gets no name, which the caller aborts; NULL on failure. Voids
 * take what is beside them. */
tl_output *out_texture_paint(const out_texture *texture, const char *layer, const char *path, const tl_run *run,
                             uint64_t *bytes, tl_error *error);
/* The same by a layer over any lattice of the surface, as bytes that free() frees and that have room for whole words;
 * on one thread. */
unsigned char *out_texture_bytes(const out_texture *texture, const scene_layer *layer, const char *path,
                                 const tl_run *run, uint64_t *bytes, tl_error *error);
/* A window of a layer in 8 bits, rows without gaps. Voids take what is beside them in their row; a row without any
 * height is grey, or level. */
tl_status out_texture_pixels(const scene_layer *layer, tl_window window, unsigned char *rgba, tl_error *error);

#endif
