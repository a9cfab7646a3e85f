/* From samples of a grid to coordinates that a mesh file holds. */
#ifndef OUT_FRAME_H
#define OUT_FRAME_H

#include "lib/talus.h"

typedef struct out_frame out_frame;

/* A frame for the grid that `mesh` lies over. TL_FRAME_DEFAULT is resolved: see out_frame_kind. TL_FRAME_ENU and
 * TL_FRAME_ECEF are refused where the CRS or the place is unknown. */
out_frame *out_frame_create(const tl_mesh *mesh, tl_frame kind, const char *path, tl_error *error);
void out_frame_destroy(out_frame *frame);
tl_frame out_frame_kind(const out_frame *frame);
/* Origin of the tangent plane of an ENU or ECEF frame: longitude, latitude in degrees, height in metres; zeros for the
 * other frames. */
const double *out_frame_origin(const out_frame *frame);
/* Coordinates of n vertices. TL_ERROR_DATA where one has none, as beyond the edge of a map of a hemisphere. */
tl_status out_frame_apply(out_frame *frame, const tl_vertex *vertices, size_t n, double (*xyz)[3], tl_error *error);
/* Coordinates of one place, between samples too, without any interpolation; false where it has none. */
bool out_frame_place(const out_frame *frame, double i, double j, double z, double xyz[3]);
/* Of an ENU or ECEF frame: its tangent plane's axes (east, north, up) and origin, geocentric. */
void out_frame_tangent(const out_frame *frame, double axes[3][3], double centre[3]);
void out_frame_to_ecef(const out_frame *frame, const double enu[3], double out[3]);
void out_frame_from_ecef(const out_frame *frame, const double ecef[3], double out[3]);
/* Whether its x and y run to the right and upwards seen from above, so that the mesh's triangles face up. */
bool out_frame_faces_up(const out_frame *frame);

extern const char *const out_frame_names[]; /* by tl_frame */

#endif
