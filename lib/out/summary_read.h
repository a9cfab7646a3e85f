/* Summaries of files that are no meshes of triangles in a frame, but tell what a summary holds. `out` is empty before;
 * on failure its record is to be freed too. */
#ifndef OUT_SUMMARY_READ_H
#define OUT_SUMMARY_READ_H

#include "lib/talus.h"

/* Points that tl_framework_save wrote, a line each: held one by one. */
tl_status out_csv_summary(const char *path, tl_mesh_summary *out, tl_error *error);
tl_status out_geojson_summary(const char *path, tl_mesh_summary *out, tl_error *error);
/* A tile of quantized-mesh. */
tl_status out_terrain_summary(const char *path, tl_mesh_summary *out, tl_error *error);

#endif
