/* Verification of meshes whose vertices are not quite at their samples, as in files. */
#ifndef DEM_VERIFY_H
#define DEM_VERIFY_H

#include "lib/talus.h"

/* Where the vertices of a mesh are: column, row and height where the frame is flat, which triangles cover which samples
 * being decided by the vertices' own samples; else metres in the ENU frame with this origin (longitude, latitude,
 * height). */
typedef struct dem_placed {
    const double (*at)[3];
    double origin[3];
} dem_placed;

/* As tl_mesh_verify_in, with the planes of triangles through these places; NULL: through the vertices. `bounds` as in
 * tl_mesh_verify_file. */
tl_status dem_verify_placed(const tl_mesh *mesh, const dem_placed *placed, const tl_source *source,
                            const tl_selection *bounds, tl_frame frame, const tl_run *run, tl_mesh_report *out,
                            tl_error *error);

#endif
