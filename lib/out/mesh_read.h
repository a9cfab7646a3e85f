/* Mesh files read back: those that talus writes. */
#ifndef OUT_MESH_READ_H
#define OUT_MESH_READ_H

#include "lib/talus.h"

/* Triangles as a file has them, in the axes of the frame: a GLB's turned back, and with what was taken off
 * large coordinates added again, by a GLB's node and an STL's header. */
typedef struct out_mesh_file {
    size_t vertex_count, triangle_count;
    double (*xyz)[3];
    uint32_t *indices; /* 3 * triangle_count, below vertex_count */
    /* What the file tells of itself, cut to lines: "frame", "origin" and the mesh's own record. */
    tl_parameter *record;
    size_t record_count;
} out_mesh_file;

/* Reads a .ply, .obj, .glb or .stl. Files that talus would not write are refused; whatever the bytes, nothing worse
 * happens. */
tl_status out_mesh_read(const char *path, out_mesh_file *out, tl_error *error);
void out_mesh_free(out_mesh_file *file);

#endif
