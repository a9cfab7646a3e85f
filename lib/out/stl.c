/* Binary STL: every triangle by itself, as its normal and its corners in single precision. */
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/frame.h"
#include "lib/out/out.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum { BATCH = 1024, HEADER = 80, RECORD = 50 };

static void put32(unsigned char *to, uint32_t value)
{
    for (int k = 0; k < 4; k++)
        to[k] = (unsigned char)(value >> 8 * k);
}

static void put_floats(unsigned char *to, const float *values, int count)
{
    for (int k = 0; k < count; k++) {
        uint32_t bits;
        memcpy(&bits, &values[k], sizeof bits);
        put32(to + 4 * k, bits);
    }
}

/* A map's coordinates, and those from the centre of the Earth, are too large for single precision: those of the first
 * vertex, rounded, are taken off. */
static tl_status place_vertices(const tl_mesh *mesh, out_frame *frame, float (*out)[3], double origin[3],
                                tl_error *error)
{
    double xyz[BATCH][3];
    for (size_t k = 0; k < mesh->vertex_count; k += BATCH) {
        size_t n = mesh->vertex_count - k < BATCH ? mesh->vertex_count - k : BATCH;
        tl_status status = out_frame_apply(frame, mesh->vertices + k, n, xyz, error);
        if (status != TL_OK)
            return status;
        int large = out_frame_kind(frame) == TL_FRAME_PROJECTED ? 2 : out_frame_kind(frame) == TL_FRAME_ECEF ? 3 : 0;
        for (int a = 0; a < large && !k; a++)
            origin[a] = floor(xyz[0][a]);
        for (size_t i = 0; i < n; i++)
            for (int a = 0; a < 3; a++)
                out[k + i][a] = (float)(xyz[i][a] - origin[a]);
    }
    return TL_OK;
}

/* A file that begins with "solid" is taken for text. */
static tl_status write_header(const tl_mesh *mesh, const out_frame *frame, const double origin[3], tl_output *output,
                              tl_error *error)
{
    unsigned char header[HEADER + 4] = {0};
    const double *o = out_frame_origin(frame);
    char text[HEADER + 1] = {0};
    int used = snprintf(text, sizeof text, "talus %s %s", tl_version(), out_frame_names[out_frame_kind(frame)]);
    if (out_frame_kind(frame) == TL_FRAME_ENU)
        snprintf(text + used, sizeof text - (size_t)used, " at %.7f %.7f %.2f", o[0], o[1], o[2]);
    else if (out_frame_kind(frame) == TL_FRAME_PROJECTED)
        snprintf(text + used, sizeof text - (size_t)used, " from %.0f %.0f", origin[0], origin[1]);
    else if (out_frame_kind(frame) == TL_FRAME_ECEF)
        snprintf(text + used, sizeof text - (size_t)used, " from %.0f %.0f %.0f", origin[0], origin[1], origin[2]);
    memcpy(header, text, HEADER);
    put32(header + HEADER, (uint32_t)mesh->triangle_count);
    return tl_output_append(output, header, sizeof header, error);
}

static void find_normal(const float *a, const float *b, const float *c, float out[3])
{
    double u[3], v[3], n[3], length;
    for (int k = 0; k < 3; k++) {
        u[k] = (double)b[k] - (double)a[k];
        v[k] = (double)c[k] - (double)a[k];
    }
    for (int k = 0; k < 3; k++)
        n[k] = u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3];
    length = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    for (int k = 0; k < 3; k++)
        out[k] = length > 0 && length <= 1e300 ? (float)(n[k] / length) : 0; /* readers take 0 as not given */
}

static tl_status write_triangles(const tl_mesh *mesh, float (*places)[3], bool flip, const tl_run *run,
                                 tl_output *output, tl_error *error)
{
    tl_status status = TL_OK;
    for (size_t t = 0; t < mesh->triangle_count && status == TL_OK; t++) {
        const uint32_t *corner = mesh->indices + 3 * t;
        const float *v[3] = {places[corner[0]], places[corner[flip ? 2 : 1]], places[corner[flip ? 1 : 2]]};
        unsigned char record[RECORD] = {0};
        float normal[3];
        find_normal(v[0], v[1], v[2], normal);
        put_floats(record, normal, 3);
        for (int k = 0; k < 3; k++)
            put_floats(record + 12 * (k + 1), v[k], 3);
        status = tl_output_append(output, record, sizeof record, error);
        if (t % 65536 == 0 && status == TL_OK)
            status = tl_run_check(run, error);
    }
    return status;
}

tl_status out_stl_write(const tl_mesh *mesh, tl_output *output, const tl_write_options *options, tl_error *error)
{
    if (mesh->triangle_count > UINT32_MAX)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %zu triangles are more than an STL can have; write a .ply",
                       tl_output_path(output), mesh->triangle_count);
    out_frame *frame = out_frame_create(mesh, options->frame, tl_output_path(output), error);
    if (!frame)
        return TL_ERROR_DATA;
    double origin[3] = {0};
    float(*places)[3] = tl_alloc(mesh->vertex_count, sizeof *places);
    tl_status status =
        places ? place_vertices(mesh, frame, places, origin, error) : tl_fail_memory(error, tl_output_path(output));
    if (status == TL_OK)
        status = write_header(mesh, frame, origin, output, error);
    if (status == TL_OK)
        status = write_triangles(mesh, places, !out_frame_faces_up(frame), options->run, output, error);
    free(places);
    out_frame_destroy(frame);
    return status;
}
