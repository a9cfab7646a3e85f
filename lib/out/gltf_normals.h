/* Normals of vertices by the ground that a mesh stands for, not by its own triangles: one of few triangles is shaded
 * like one of all, and parts agree. */
#ifndef OUT_GLTF_NORMALS_H
#define OUT_GLTF_NORMALS_H

#include "lib/out/frame.h"

/* Where columns, rows and heights point to in glTF's axes (Y up), anywhere over a mesh. */
typedef struct gltf_directions gltf_directions;

typedef struct gltf_direction {
    double along[3], down[3]; /* by a column, and by a row, at the height in question */
    double up[3];             /* by a unit of height */
} gltf_direction;

/* NULL when out of memory. */
gltf_directions *gltf_directions_create(const tl_mesh *mesh, const out_frame *frame, const char *path, tl_error *error);
void gltf_directions_destroy(gltf_directions *directions);
/* At a place of the mesh; false where the frame has no coordinates around it, as beyond the limb of a hemisphere. */
bool gltf_direction_at(const gltf_directions *directions, double i, double j, double z, gltf_direction *out);

/* glTF's Y points up: (east, north, up) becomes (x, z up, -y). */
void gltf_turn(const double in[3], double out[3]);
void gltf_cross(const double a[3], const double b[3], double out[3]);
void gltf_scale_to_one(double v[3]);

/* Writes the normal of vertex k to normals[k * stride] and on. Slopes are those of layers (lib/scene/layers.h): central
 * differences of samples of `ground`, over whose finest lattice the mesh lies; one-sided at the rim and beside voids.
 * Of a field whose levels nest they are those of its level whose spacing is the vertex's shortest edge: of a view's
 * mesh, the level that was chosen there. Of other sources they are meant over a square as wide as the power of two
 * samples below that edge, up to 128, or as fits between rims and voids: those of single samples would be speckles on
 * large triangles. Left as they are: normals
 * of vertices over voids, of those below the ground in a mesh with a base, and where there are no directions. */
tl_status gltf_ground_normals(const tl_mesh *mesh, const tl_source *ground, const gltf_directions *directions,
                              const tl_run *run, float *normals, size_t stride, tl_error *error);

#endif
