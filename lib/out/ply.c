/* Binary little-endian PLY: double coordinates where the frame needs them, floats in the pixel and ENU frames. */
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/out/frame.h"
#include "lib/out/out.h"

#include <stdio.h>
#include <string.h>

enum { BATCH = 1024, HEADER_LIMIT = 8192 };

static tl_status write_header(const tl_mesh *mesh, const out_frame *frame, const char *type, tl_output *output,
                              tl_error *error)
{
    char text[HEADER_LIMIT];
    const double *o = out_frame_origin(frame);
    int used = snprintf(text, sizeof text, "ply\nformat binary_little_endian 1.0\ncomment talus %s, frame %s\n",
                        tl_version(), out_frame_names[out_frame_kind(frame)]);
    if (out_frame_kind(frame) == TL_FRAME_ENU)
        used += snprintf(text + used, sizeof text - (size_t)used,
                         "comment origin longitude %.12g latitude %.12g height %.6f\n", o[0], o[1], o[2]);
    if (mesh->georef.crs)
        used +=
            snprintf(text + used, sizeof text - (size_t)used, "comment CRS %.200s\n", tl_crs_name(mesh->georef.crs));
    for (size_t i = 0; i < mesh->parameter_count && used < HEADER_LIMIT / 2; i++)
        used += snprintf(text + used, sizeof text - (size_t)used, "comment %.60s: %.200s\n", mesh->parameters[i].name,
                         mesh->parameters[i].value);
    used += snprintf(text + used, sizeof text - (size_t)used,
                     "element vertex %zu\nproperty %s x\nproperty %s y\nproperty %s z\nelement face %zu\n"
                     "property list uchar uint vertex_indices\nend_header\n",
                     mesh->vertex_count, type, type, type, mesh->triangle_count);
    return tl_output_append(output, text, (size_t)used, error);
}

static tl_status write_vertices(const tl_mesh *mesh, out_frame *frame, bool wide, tl_output *output, tl_error *error)
{
    double xyz[BATCH][3];
    tl_status status = TL_OK;
    for (size_t k = 0; k < mesh->vertex_count && status == TL_OK; k += BATCH) {
        size_t n = mesh->vertex_count - k < BATCH ? mesh->vertex_count - k : BATCH;
        status = out_frame_apply(frame, mesh->vertices + k, n, xyz, error);
        if (status != TL_OK)
            return status;
        float narrow[BATCH][3];
        for (size_t i = 0; i < n; i++)
            for (int a = 0; a < 3; a++)
                narrow[i][a] = (float)xyz[i][a];
        status = wide ? tl_output_append(output, xyz, n * sizeof *xyz, error)
                      : tl_output_append(output, narrow, n * sizeof *narrow, error);
    }
    return status;
}

static tl_status write_faces(const tl_mesh *mesh, bool flip, const tl_run *run, tl_output *output, tl_error *error)
{
    tl_status status = TL_OK;
    for (size_t t = 0; t < mesh->triangle_count && status == TL_OK; t++) {
        unsigned char face[13] = {3};
        const uint32_t *corner = mesh->indices + 3 * t;
        const uint32_t turned[3] = {corner[0], corner[2], corner[1]};
        memcpy(face + 1, flip ? turned : corner, 12);
        status = tl_output_append(output, face, sizeof face, error);
        if (t % 65536 == 0 && status == TL_OK)
            status = tl_run_check(run, error);
    }
    return status;
}

tl_status out_ply_write(const tl_mesh *mesh, tl_output *output, const tl_write_options *options, tl_error *error)
{
    out_frame *frame = out_frame_create(mesh, options->frame, tl_output_path(output), error);
    if (!frame)
        return TL_ERROR_DATA;
    /* 24 bits hold a sample's column and row below 2^24, and metres of an ENU frame to 4 mm at 50 km; not a map's
     * coordinates or those from the centre of the Earth */
    bool wide = out_frame_kind(frame) == TL_FRAME_PROJECTED || out_frame_kind(frame) == TL_FRAME_ECEF;
    tl_status status = write_header(mesh, frame, wide ? "double" : "float", output, error);
    if (status == TL_OK)
        status = write_vertices(mesh, frame, wide, output, error);
    if (status == TL_OK)
        status = write_faces(mesh, !out_frame_faces_up(frame), options->run, output, error);
    out_frame_destroy(frame);
    return status;
}
