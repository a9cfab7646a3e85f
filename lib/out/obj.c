/* Wavefront OBJ: text, so every frame keeps its full precision. */
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/out/frame.h"
#include "lib/out/out.h"

#include <stdio.h>

enum { BATCH = 1024 };

static tl_status write_header(const tl_mesh *mesh, const out_frame *frame, tl_output *output, tl_error *error)
{
    char line[512];
    const double *o = out_frame_origin(frame);
    int length = snprintf(line, sizeof line, "# talus %s, frame %s, %zu vertices, %zu triangles\n", tl_version(),
                          out_frame_names[out_frame_kind(frame)], mesh->vertex_count, mesh->triangle_count);
    tl_status status = tl_output_append(output, line, (size_t)length, error);
    if (status == TL_OK && out_frame_kind(frame) == TL_FRAME_ENU) {
        length = snprintf(line, sizeof line, "# origin longitude %.12g latitude %.12g height %.6f\n", o[0], o[1], o[2]);
        status = tl_output_append(output, line, (size_t)length, error);
    }
    for (size_t i = 0; i < mesh->parameter_count && status == TL_OK; i++) {
        length = snprintf(line, sizeof line, "# %.60s: %.300s\n", mesh->parameters[i].name, mesh->parameters[i].value);
        status = tl_output_append(output, line, (size_t)length, error);
    }
    return status;
}

static tl_status write_vertices(const tl_mesh *mesh, out_frame *frame, const tl_run *run, tl_output *output,
                                tl_error *error)
{
    double xyz[BATCH][3];
    char line[128];
    /* micrometres of geocentric coordinates are 13 digits */
    bool wide = out_frame_kind(frame) == TL_FRAME_ECEF;
    int level = wide ? 13 : 12, upright = wide ? 13 : 9;
    tl_status status = TL_OK;
    for (size_t k = 0; k < mesh->vertex_count && status == TL_OK; k += BATCH) {
        size_t n = mesh->vertex_count - k < BATCH ? mesh->vertex_count - k : BATCH;
        status = out_frame_apply(frame, mesh->vertices + k, n, xyz, error);
        for (size_t i = 0; i < n && status == TL_OK; i++) {
            int length = snprintf(line, sizeof line, "v %.*g %.*g %.*g\n", level, xyz[i][0], level, xyz[i][1], upright,
                                  xyz[i][2]);
            status = tl_output_append(output, line, (size_t)length, error);
        }
        if (status == TL_OK)
            status = tl_run_check(run, error);
    }
    return status;
}

static tl_status write_faces(const tl_mesh *mesh, bool flip, const tl_run *run, tl_output *output, tl_error *error)
{
    char line[80];
    tl_status status = TL_OK;
    for (size_t t = 0; t < mesh->triangle_count && status == TL_OK; t++) {
        const uint32_t *c = mesh->indices + 3 * t;
        /* 64 bits, since OBJ counts from 1 */
        int length = snprintf(line, sizeof line, "f %llu %llu %llu\n", c[0] + 1ull, c[flip ? 2 : 1] + 1ull,
                              c[flip ? 1 : 2] + 1ull);
        status = tl_output_append(output, line, (size_t)length, error);
        if (t % 65536 == 0 && status == TL_OK)
            status = tl_run_check(run, error);
    }
    return status;
}

tl_status out_obj_write(const tl_mesh *mesh, tl_output *output, const tl_write_options *options, tl_error *error)
{
    out_frame *frame = out_frame_create(mesh, options->frame, tl_output_path(output), error);
    if (!frame)
        return TL_ERROR_DATA;
    bool flip = !out_frame_faces_up(frame);
    tl_status status = write_header(mesh, frame, output, error);
    if (status == TL_OK)
        status = write_vertices(mesh, frame, options->run, output, error);
    if (status == TL_OK)
        status = write_faces(mesh, flip, options->run, output, error);
    out_frame_destroy(frame);
    return status;
}
