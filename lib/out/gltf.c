/* glTF 2.0 binary (GLB): one mesh with positions and normals, in meshoptimizer's order for the vertex cache and fetch.
 */
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/frame.h"
#include "lib/out/out.h"

#include <jansson.h>
#include <meshoptimizer.h>

#include <math.h>
#include <string.h>

enum { BATCH = 1024, GLB_MAGIC = 0x46546c67, CHUNK_JSON = 0x4e4f534a, CHUNK_BINARY = 0x004e4942 };
enum {
    ARRAY_BUFFER = 34962,
    ELEMENT_ARRAY_BUFFER = 34963,
    COMPONENT_U32 = 5125,
    COMPONENT_FLOAT = 5126,
    MODE_TRIANGLES = 4
};

typedef struct vertex {
    float position[3], normal[3];
} vertex;

typedef struct model {
    vertex *vertices;
    size_t vertex_count;
    uint32_t *indices;
    size_t index_count;
    float low[3], high[3]; /* of the positions */
    double origin[3];      /* added to positions by the node, so that the floats are small */
} model;

/* glTF's Y points up: (east, north, up) becomes (x, z up, -y). */
static void to_gltf(const double in[3], double out[3])
{
    out[0] = in[0];
    out[1] = in[2];
    out[2] = -in[1];
}

static tl_status first_position(const tl_mesh *mesh, out_frame *frame, double origin[3], tl_error *error)
{
    double xyz[1][3] = {{0}};
    tl_status status = TL_OK;
    /* a node's translation is exact in a reader that computes in double; map coordinates need it */
    if (mesh->vertex_count && out_frame_kind(frame) == TL_FRAME_PROJECTED)
        status = out_frame_apply(frame, mesh->vertices, 1, xyz, error);
    to_gltf(xyz[0], origin);
    return status;
}

static tl_status place_vertices(const tl_mesh *mesh, out_frame *frame, model *m, tl_error *error)
{
    double xyz[BATCH][3];
    for (int a = 0; a < 3; a++) {
        m->low[a] = INFINITY;
        m->high[a] = -INFINITY;
    }
    for (size_t k = 0; k < mesh->vertex_count; k += BATCH) {
        size_t n = mesh->vertex_count - k < BATCH ? mesh->vertex_count - k : BATCH;
        tl_status status = out_frame_apply(frame, mesh->vertices + k, n, xyz, error);
        if (status != TL_OK)
            return status;
        for (size_t i = 0; i < n; i++) {
            double at[3];
            vertex placed = {{0}, {0}};
            to_gltf(xyz[i], at);
            for (int a = 0; a < 3; a++) {
                placed.position[a] = (float)(at[a] - m->origin[a]);
                m->low[a] = fminf(m->low[a], placed.position[a]);
                m->high[a] = fmaxf(m->high[a], placed.position[a]);
            }
            m->vertices[k + i] = placed;
        }
    }
    return TL_OK;
}

/* Normals weighted by the triangles' areas. */
static void add_normals(model *m)
{
    for (size_t t = 0; t < m->index_count; t += 3) {
        vertex *v[3];
        double e[2][3];
        for (int k = 0; k < 3; k++)
            v[k] = &m->vertices[m->indices[t + (size_t)k]];
        for (int a = 0; a < 3; a++) {
            e[0][a] = (double)v[1]->position[a] - (double)v[0]->position[a];
            e[1][a] = (double)v[2]->position[a] - (double)v[0]->position[a];
        }
        for (int a = 0; a < 3; a++) {
            double n = e[0][(a + 1) % 3] * e[1][(a + 2) % 3] - e[0][(a + 2) % 3] * e[1][(a + 1) % 3];
            for (int k = 0; k < 3; k++)
                v[k]->normal[a] += (float)n;
        }
    }
    for (size_t k = 0; k < m->vertex_count; k++) {
        float *n = m->vertices[k].normal;
        double length = sqrt((double)n[0] * (double)n[0] + (double)n[1] * (double)n[1] + (double)n[2] * (double)n[2]);
        for (int a = 0; a < 3; a++)
            n[a] = length > 0 && isfinite(length) ? (float)((double)n[a] / length) : a == 1;
    }
}

static tl_status build(const tl_mesh *mesh, out_frame *frame, model *m, const char *path, tl_error *error)
{
    m->vertex_count = mesh->vertex_count;
    m->index_count = 3 * mesh->triangle_count;
    vertex *placed = tl_alloc(m->vertex_count, sizeof *placed);
    m->vertices = tl_alloc(m->vertex_count, sizeof *m->vertices);
    m->indices = tl_alloc(m->index_count, sizeof *m->indices);
    if (!placed || !m->vertices || !m->indices) {
        free(placed);
        return tl_fail_memory(error, path);
    }
    /* the pixel frame has rows for y: its picture is mirrored, so its triangles are turned to face up */
    bool flip = !out_frame_faces_up(frame);
    meshopt_optimizeVertexCache(m->indices, mesh->indices, m->index_count, m->vertex_count);
    for (size_t t = 0; flip && t < m->index_count; t += 3) {
        uint32_t swapped = m->indices[t + 1];
        m->indices[t + 1] = m->indices[t + 2];
        m->indices[t + 2] = swapped;
    }
    vertex *ordered = m->vertices;
    m->vertices = placed;
    tl_status status = place_vertices(mesh, frame, m, error);
    if (status == TL_OK)
        add_normals(m);
    m->vertices = ordered;
    if (status == TL_OK)
        m->vertex_count =
            meshopt_optimizeVertexFetch(ordered, m->indices, m->index_count, placed, m->vertex_count, sizeof *placed);
    free(placed);
    return status;
}

/* ---- JSON ---- */

static json_t *triple(const float v[3])
{
    return json_pack("[f,f,f]", (double)v[0], (double)v[1], (double)v[2]);
}

static json_t *extras(const tl_mesh *mesh, const out_frame *frame)
{
    json_t *object = json_pack("{s:s, s:s, s:f}", "talus", tl_version(), "frame",
                               out_frame_names[out_frame_kind(frame)], "max_error", mesh->max_error);
    if (mesh->georef.crs) {
        json_object_set_new(object, "crs", json_string(tl_crs_name(mesh->georef.crs)));
        json_object_set_new(object, "crs_wkt", json_string(tl_crs_wkt(mesh->georef.crs)));
    }
    const double *o = out_frame_origin(frame);
    if (out_frame_kind(frame) == TL_FRAME_ENU)
        json_object_set_new(object, "origin",
                            json_pack("{s:f, s:f, s:f}", "longitude", o[0], "latitude", o[1], "height", o[2]));
    json_t *parameters = json_object();
    for (size_t i = 0; i < mesh->parameter_count; i++)
        json_object_set_new(parameters, mesh->parameters[i].name, json_string(mesh->parameters[i].value));
    json_object_set_new(object, "parameters", parameters);
    return object;
}

static json_t *accessor(int view, size_t offset, int component, size_t count, const char *type)
{
    return json_pack("{s:i, s:I, s:i, s:I, s:s}", "bufferView", view, "byteOffset", (json_int_t)offset, "componentType",
                     component, "count", (json_int_t)count, "type", type);
}

static json_t *geometry(const model *m)
{
    size_t vertex_bytes = m->vertex_count * sizeof(vertex), index_bytes = m->index_count * sizeof(uint32_t);
    json_t *position = accessor(0, 0, COMPONENT_FLOAT, m->vertex_count, "VEC3");
    json_object_set_new(position, "min", triple(m->low));
    json_object_set_new(position, "max", triple(m->high));
    return json_pack("{s:[o,o,o], s:[{s:i,s:I,s:I,s:i,s:i},{s:i,s:I,s:I,s:i}], s:[{s:I}]}", "accessors", position,
                     accessor(0, 12, COMPONENT_FLOAT, m->vertex_count, "VEC3"),
                     accessor(1, 0, COMPONENT_U32, m->index_count, "SCALAR"), "bufferViews", "buffer", 0, "byteOffset",
                     (json_int_t)0, "byteLength", (json_int_t)vertex_bytes, "byteStride", (int)sizeof(vertex), "target",
                     ARRAY_BUFFER, "buffer", 0, "byteOffset", (json_int_t)vertex_bytes, "byteLength",
                     (json_int_t)index_bytes, "target", ELEMENT_ARRAY_BUFFER, "buffers", "byteLength",
                     (json_int_t)(vertex_bytes + index_bytes));
}

static char *describe(const tl_mesh *mesh, const out_frame *frame, const model *m)
{
    json_t *node = json_pack("{s:i, s:s}", "mesh", 0, "name", "terrain");
    if (m->origin[0] != 0 || m->origin[1] != 0 || m->origin[2] != 0)
        json_object_set_new(node, "translation", json_pack("[f,f,f]", m->origin[0], m->origin[1], m->origin[2]));
    json_t *root =
        json_pack("{s:{s:s, s:s, s:o}, s:i, s:[{s:[i]}], s:[o], s:[{s:[{s:{s:i,s:i}, s:i, s:i, s:i}]}], "
                  "s:[{s:{s:[f,f,f,f], s:f, s:f}}]}",
                  "asset", "version", "2.0", "generator", "talus", "extras", extras(mesh, frame), "scene", 0, "scenes",
                  "nodes", 0, "nodes", node, "meshes", "primitives", "attributes", "POSITION", 0, "NORMAL", 1,
                  "indices", 2, "mode", MODE_TRIANGLES, "material", 0, "materials", "pbrMetallicRoughness",
                  "baseColorFactor", 0.55, 0.52, 0.46, 1.0, "metallicFactor", 0.0, "roughnessFactor", 1.0);
    json_t *arrays = m->index_count ? geometry(m) : NULL;
    char *text = NULL;
    if (root && arrays && json_object_update(root, arrays) == 0)
        text = json_dumps(root, JSON_COMPACT | JSON_REAL_PRECISION(17));
    json_decref(arrays);
    json_decref(root);
    return text;
}

/* ---- file ---- */

static tl_status write_words(tl_output *output, const uint32_t *words, size_t count, tl_error *error)
{
    return tl_output_append(output, words, count * sizeof *words, error);
}

static tl_status write_file(const model *m, const char *json, tl_output *output, tl_error *error)
{
    size_t text = strlen(json), padded = (text + 3) / 4 * 4;
    uint64_t binary = (uint64_t)m->vertex_count * sizeof(vertex) + (uint64_t)m->index_count * sizeof(uint32_t);
    uint64_t whole = 12 + 8 + padded + 8 + binary;
    if (whole > UINT32_MAX)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: %zu triangles need more than the 4 GiB of a GLB; refine by fewer levels or use .ply",
                       tl_output_path(output), m->index_count / 3);
    const uint32_t head[5] = {GLB_MAGIC, 2, (uint32_t)whole, (uint32_t)padded, CHUNK_JSON};
    const uint32_t binary_head[2] = {(uint32_t)binary, CHUNK_BINARY};
    tl_status status = write_words(output, head, 5, error);
    if (status == TL_OK)
        status = tl_output_append(output, json, text, error);
    if (status == TL_OK)
        status = tl_output_append(output, "   ", padded - text, error);
    if (status == TL_OK)
        status = write_words(output, binary_head, 2, error);
    if (status == TL_OK)
        status = tl_output_append(output, m->vertices, m->vertex_count * sizeof *m->vertices, error);
    return status == TL_OK ? write_words(output, m->indices, m->index_count, error) : status;
}

tl_status out_gltf_write(const tl_mesh *mesh, tl_output *output, const tl_write_options *options, tl_error *error)
{
    const char *path = tl_output_path(output);
    if (!mesh->triangle_count)
        return tl_fail(error, TL_ERROR_DATA, "%s: there is no triangle to write, and glTF has no empty meshes", path);
    if ((double)mesh->vertex_count * sizeof(vertex) + (double)mesh->triangle_count * 12 > UINT32_MAX)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: %zu triangles need more than the 4 GiB of a GLB; refine by fewer levels or use .ply", path,
                       mesh->triangle_count);
    tl_status status = tl_run_check(options->run, error);
    out_frame *frame = status == TL_OK ? out_frame_create(mesh, options->frame, path, error) : NULL;
    if (!frame)
        return status == TL_OK ? TL_ERROR_DATA : status;
    model m = {0};
    status = first_position(mesh, frame, m.origin, error);
    if (status == TL_OK)
        status = build(mesh, frame, &m, path, error);
    char *json = status == TL_OK ? describe(mesh, frame, &m) : NULL;
    if (status == TL_OK)
        status = json ? write_file(&m, json, output, error) : tl_fail_memory(error, path);
    free(json);
    free(m.vertices);
    free(m.indices);
    out_frame_destroy(frame);
    return status;
}
