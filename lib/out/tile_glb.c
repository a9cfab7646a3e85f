/* A tile's GLB: one node, whose matrix takes steps of a power of two to metres in the axes of the Earth, turned as
 * 3D Tiles wants it (glTF's y points up; readers turn it to z). Steps are multiples counted from the Earth's centre, so
 * that a vertex which two tiles share lies at the same place in both, to the last bit, if both have the same step. */
#include "lib/out/tile_glb.h"

#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/out/tile_surface.h"

#include "lib/out/triangles.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { STEPS = 65535, GLB_MAGIC = 0x46546c67, CHUNK_JSON = 0x4e4f534a, CHUNK_BINARY = 0x004e4942, VIEWS = 8 };
enum { POSITIONS, NORMALS, TANGENTS, PLACES, INDICES, PARTS }; /* places: of texels */
enum {
    ARRAY_BUFFER = 34962,
    ELEMENT_ARRAY_BUFFER = 34963,
    COMPONENT_I8 = 5120,
    COMPONENT_U16 = 5123,
    COMPONENT_U32 = 5125,
    LINEAR = 9729,
    LINEAR_MIPMAP_LINEAR = 9987,
    CLAMP_TO_EDGE = 33071
};

/* A vertex in the file: two parts, as readers may want the positions alone. */
typedef struct packed {
    uint16_t position[3], none;
    int8_t normal[4], tangent[4];
    uint16_t uv[2];
} packed;

/* A part of the binary chunk. */
typedef struct view {
    const void *bytes;
    size_t size;          /* in the file */
    size_t count, stride; /* of the items; stride 0: a picture */
    bool indices;
} view;

struct out_glb_encoder {
    out_surface surface;
    out_glb_style style;
    packed *vertices;
    uint32_t *indices;
    unsigned char *parts[PARTS], *encoded[PARTS];
    size_t encoded_room;
    unsigned char *file;
    size_t file_room;
};

out_glb_encoder *out_glb_encoder_create(const scene_own_lattice *lattice, const out_glb_style *style, tl_error *error)
{
    out_glb_encoder *e = calloc(1, sizeof *e);
    if (!e) {
        tl_fail_memory(error, "a tile");
        return NULL;
    }
    e->style = *style;
    if (out_surface_init(&e->surface, lattice, error) != TL_OK) {
        free(e);
        return NULL;
    }
    size_t vertices = e->surface.vertex_room, indices = e->surface.index_room;
    e->vertices = tl_alloc(vertices, sizeof *e->vertices);
    e->indices = tl_alloc(indices, sizeof *e->indices);
    e->encoded_room = meshopt_encodeVertexBufferBound(vertices, 8) + meshopt_encodeIndexBufferBound(indices, vertices);
    bool good = e->vertices && e->indices;
    for (int k = 0; k < PARTS; k++) {
        e->parts[k] = tl_alloc(k == INDICES ? indices : vertices, 8);
        e->encoded[k] = style->compressed ? malloc(e->encoded_room) : NULL;
        good = good && e->parts[k] && (e->encoded[k] || !style->compressed);
    }
    if (good)
        return e;
    out_glb_encoder_destroy(e);
    tl_fail_memory(error, "a tile");
    return NULL;
}

void out_glb_encoder_destroy(out_glb_encoder *e)
{
    if (!e)
        return;
    out_surface_finish(&e->surface);
    for (int k = 0; k < PARTS; k++) {
        free(e->parts[k]);
        free(e->encoded[k]);
    }
    free(e->vertices);
    free(e->indices);
    free(e->file);
    free(e);
}

/* ---- Rounding ---- */

/* glTF's axes: x, z, -y of the Earth's. */
static void to_gltf(const double in[3], double out[3])
{
    out[0] = in[0];
    out[1] = in[2];
    out[2] = -in[1];
}

/* A power of two; origin: of the steps, in them. */
static double find_steps(const out_surface *s, double origin[3])
{
    double low[3] = {HUGE_VAL, HUGE_VAL, HUGE_VAL}, high[3] = {-HUGE_VAL, -HUGE_VAL, -HUGE_VAL}, at[3], q = 0x1p-16;
    for (size_t k = 0; k < s->vertex_count; k++) {
        to_gltf(s->vertices[k].at, at);
        for (int a = 0; a < 3; a++) {
            low[a] = fmin(low[a], at[a]);
            high[a] = fmax(high[a], at[a]);
        }
    }
    for (int a = 0; a < 3; a++)
        while (floor(high[a] / q + 0.5) - floor(low[a] / q + 0.5) > STEPS)
            q *= 2;
    for (int a = 0; a < 3; a++)
        origin[a] = floor(low[a] / q + 0.5);
    return q;
}

static int8_t to_i8(float value)
{
    return (int8_t)lrintf(value * 127);
}

/* Texel (i, j) counted from the tile's north-west lies on a vertex; rows of pictures run down. */
static uint16_t texture_at(double cell, int cells)
{
    return (uint16_t)lrint((cell + 0.5) / (cells + 1) * STEPS);
}

static void round_vertices(out_glb_encoder *e, const out_glb_tile *t, double q, const double origin[3])
{
    const int cells = t->pictures ? t->pictures->cells : 1;
    for (size_t k = 0; k < e->surface.vertex_count; k++) {
        const out_surface_vertex *v = &e->surface.vertices[k];
        const double n[3] = {(double)v->normal[0], (double)v->normal[1], (double)v->normal[2]};
        const double east[3] = {(double)v->tangent[0], (double)v->tangent[1], (double)v->tangent[2]};
        double at[3], up[3], along[3];
        packed *to = &e->vertices[k];
        *to = (packed){.none = 0};
        to_gltf(v->at, at);
        to_gltf(n, up);
        to_gltf(east, along);
        for (int a = 0; a < 3; a++) {
            to->position[a] = (uint16_t)(floor(at[a] / q + 0.5) - origin[a]);
            to->normal[a] = to_i8((float)up[a]);
            to->tangent[a] = to_i8((float)along[a]);
        }
        to->tangent[3] = 127; /* rows of pictures run to the south */
        if (!t->pictures)
            continue;
        to->uv[0] = texture_at((v->x - (double)t->x) / (double)t->step, cells);
        to->uv[1] = texture_at(cells - (v->y - (double)t->y) / (double)t->step, cells);
    }
}

/* ---- Parts ---- */

/* For the cache of vertices, and vertices in the order in which triangles ask for them. */
static size_t order(out_glb_encoder *e)
{
    out_surface *s = &e->surface;
    meshopt_optimizeVertexCache(e->indices, s->indices, s->index_count, s->vertex_count);
    return meshopt_optimizeVertexFetch(e->vertices, e->indices, s->index_count, e->vertices, s->vertex_count,
                                       sizeof *e->vertices);
}

static void add_view(view *views, int *count, out_glb_encoder *e, int part, size_t items, size_t stride)
{
    view *v = &views[(*count)++];
    *v = (view){
        .bytes = e->parts[part], .size = items * stride, .count = items, .stride = stride, .indices = part == INDICES};
    if (!e->style.compressed)
        return;
    v->bytes = e->encoded[part];
    v->size = v->indices ? meshopt_encodeIndexBuffer(e->encoded[part], e->encoded_room, e->indices, items)
                         : meshopt_encodeVertexBuffer(e->encoded[part], e->encoded_room, e->parts[part], items, stride);
}

/* They are of no use without the normals that they stand beside. */
static bool has_tangents(const out_glb_encoder *e, const out_glb_tile *t)
{
    return e->style.normals && t->pictures && t->pictures->bytes[1];
}

/* Positions, normals and texture coordinates where there are any, then indices, then pictures. */
static int make_views(out_glb_encoder *e, const out_glb_tile *t, size_t vertices, view *views)
{
    int count = 0;
    size_t indices = e->surface.index_count;
    bool wide = vertices > STEPS; /* the last number of 16 bits is a mark in some interfaces */
    for (size_t k = 0; k < vertices; k++) {
        memcpy(e->parts[POSITIONS] + 8 * k, &e->vertices[k], 8); /* the position, and what fills up */
        memcpy(e->parts[NORMALS] + 4 * k, e->vertices[k].normal, 4);
        memcpy(e->parts[TANGENTS] + 4 * k, e->vertices[k].tangent, 4);
        memcpy(e->parts[PLACES] + 4 * k, e->vertices[k].uv, 4);
    }
    for (size_t k = 0; k < indices; k++) {
        uint16_t narrow = (uint16_t)e->indices[k];
        if (wide)
            memcpy(e->parts[INDICES] + 4 * k, &e->indices[k], 4);
        else
            memcpy(e->parts[INDICES] + 2 * k, &narrow, 2);
    }
    add_view(views, &count, e, POSITIONS, vertices, 8);
    if (e->style.normals)
        add_view(views, &count, e, NORMALS, vertices, 4);
    if (has_tangents(e, t))
        add_view(views, &count, e, TANGENTS, vertices, 4);
    if (t->pictures)
        add_view(views, &count, e, PLACES, vertices, 4);
    add_view(views, &count, e, INDICES, indices, wide ? 4 : 2);
    for (int k = 0; t->pictures && k < 2; k++)
        if (t->pictures->bytes[k])
            views[count++] = (view){.bytes = t->pictures->bytes[k], .size = t->pictures->count[k]};
    return count;
}

/* ---- JSON ---- */

static size_t padded(size_t size)
{
    return (size + 3) / 4 * 4;
}

static json_t *describe_views(const view *views, int count, bool compressed, size_t *plain, size_t *binary)
{
    json_t *all = json_array();
    *plain = *binary = 0;
    for (int k = 0; k < count; k++) {
        const view *v = &views[k];
        json_t *one = json_object();
        size_t decoded = v->stride ? v->count * v->stride : v->size;
        bool encoded = compressed && v->stride;
        json_object_set_new(one, "buffer", json_integer(encoded));
        json_object_set_new(one, "byteOffset", json_integer((json_int_t)(encoded ? *plain : *binary)));
        json_object_set_new(one, "byteLength", json_integer((json_int_t)decoded));
        if (v->stride && !v->indices)
            json_object_set_new(one, "byteStride", json_integer((json_int_t)v->stride));
        if (v->stride)
            json_object_set_new(one, "target", json_integer(v->indices ? ELEMENT_ARRAY_BUFFER : ARRAY_BUFFER));
        if (encoded) {
            json_object_set_new(one, "extensions",
                                json_pack("{s:{s:i, s:I, s:I, s:I, s:I, s:s}}", "EXT_meshopt_compression", "buffer", 0,
                                          "byteOffset", (json_int_t)*binary, "byteLength", (json_int_t)v->size,
                                          "byteStride", (json_int_t)v->stride, "count", (json_int_t)v->count, "mode",
                                          v->indices ? "TRIANGLES" : "ATTRIBUTES"));
            *plain += padded(decoded);
        }
        *binary += padded(v->size);
        json_array_append_new(all, one);
    }
    return all;
}

static void add_accessor(json_t *accessors, int component, size_t count, const char *type, bool normalized)
{
    json_t *one = json_pack("{s:i, s:i, s:I, s:s}", "bufferView", (int)json_array_size(accessors), "componentType",
                            component, "count", (json_int_t)count, "type", type);
    if (normalized)
        json_object_set_new(one, "normalized", json_true());
    json_array_append_new(accessors, one);
}

static void add_range(const out_glb_encoder *e, size_t vertices, json_t *accessor)
{
    uint16_t low[3] = {STEPS, STEPS, STEPS}, high[3] = {0, 0, 0};
    for (size_t k = 0; k < vertices; k++)
        for (int a = 0; a < 3; a++) {
            uint16_t at = e->vertices[k].position[a];
            low[a] = at < low[a] ? at : low[a];
            high[a] = at > high[a] ? at : high[a];
        }
    json_object_set_new(accessor, "min", json_pack("[i,i,i]", low[0], low[1], low[2]));
    json_object_set_new(accessor, "max", json_pack("[i,i,i]", high[0], high[1], high[2]));
}

static json_t *describe_geometry(const out_glb_encoder *e, const out_glb_tile *t, size_t vertices, json_t *attributes)
{
    json_t *accessors = json_array();
    json_object_set_new(attributes, "POSITION", json_integer(0));
    add_accessor(accessors, COMPONENT_U16, vertices, "VEC3", false);
    add_range(e, vertices, json_array_get(accessors, 0));
    if (e->style.normals) {
        json_object_set_new(attributes, "NORMAL", json_integer((json_int_t)json_array_size(accessors)));
        add_accessor(accessors, COMPONENT_I8, vertices, "VEC3", true);
    }
    if (has_tangents(e, t)) {
        json_object_set_new(attributes, "TANGENT", json_integer((json_int_t)json_array_size(accessors)));
        add_accessor(accessors, COMPONENT_I8, vertices, "VEC4", true);
    }
    if (t->pictures) {
        json_object_set_new(attributes, "TEXCOORD_0", json_integer((json_int_t)json_array_size(accessors)));
        add_accessor(accessors, COMPONENT_U16, vertices, "VEC2", true);
    }
    add_accessor(accessors, vertices > STEPS ? COMPONENT_U32 : COMPONENT_U16, e->surface.index_count, "SCALAR", false);
    return accessors;
}

static void add_pictures(const out_tile_pictures *pictures, int first, json_t *root)
{
    json_t *images = json_array(), *textures = json_array();
    json_t *material = json_array_get(json_object_get(root, "materials"), 0);
    json_t *pbr = json_object_get(material, "pbrMetallicRoughness");
    for (int k = 0; k < 2; k++) {
        if (!pictures->bytes[k])
            continue;
        json_t *slot = json_pack("{s:i}", "index", (int)json_array_size(textures));
        json_array_append_new(images, json_pack("{s:i, s:s}", "bufferView", first++, "mimeType", "image/png"));
        json_array_append_new(textures,
                              json_pack("{s:i, s:i}", "sampler", 0, "source", (int)json_array_size(textures)));
        json_object_set_new(k ? material : pbr, k ? "normalTexture" : "baseColorTexture", slot);
        if (!k)
            json_object_set_new(pbr, "baseColorFactor", json_pack("[f,f,f,f]", 1.0, 1.0, 1.0, 1.0));
    }
    json_object_set_new(root, "images", images);
    json_object_set_new(root, "textures", textures);
    json_object_set_new(root, "samplers",
                        json_pack("[{s:i, s:i, s:i, s:i}]", "magFilter", LINEAR, "minFilter", LINEAR_MIPMAP_LINEAR,
                                  "wrapS", CLAMP_TO_EDGE, "wrapT", CLAMP_TO_EDGE));
}

static json_t *describe_node(double q, const double origin[3])
{
    return json_pack("{s:i, s:[f,f,f,f,f,f,f,f,f,f,f,f,f,f,f,f]}", "mesh", 0, "matrix", q, 0.0, 0.0, 0.0, 0.0, q, 0.0,
                     0.0, 0.0, 0.0, q, 0.0, origin[0] * q, origin[1] * q, origin[2] * q, 1.0);
}

static json_t *describe_extensions(bool compressed)
{
    return compressed ? json_pack("[s,s]", "KHR_mesh_quantization", "EXT_meshopt_compression")
                      : json_pack("[s]", "KHR_mesh_quantization");
}

static char *describe(const out_glb_encoder *e, const out_glb_tile *t, size_t vertices, const view *views, int count,
                      double q, const double origin[3], size_t *binary)
{
    size_t plain;
    bool compressed = e->style.compressed;
    json_t *attributes = json_object(), *accessors = describe_geometry(e, t, vertices, attributes);
    json_t *described = describe_views(views, count, compressed, &plain, binary);
    int last = (int)json_array_size(accessors) - 1;
    json_t *buffers = json_pack("[{s:I}]", "byteLength", (json_int_t)*binary);
    if (compressed)
        json_array_append_new(buffers, json_pack("{s:I, s:{s:{s:b}}}", "byteLength", (json_int_t)plain, "extensions",
                                                 "EXT_meshopt_compression", "fallback", 1));
    json_t *root = json_pack(
        "{s:{s:s, s:s}, s:o, s:o, s:i, s:[{s:[i]}], s:[o], s:[{s:[{s:o, s:i, s:i, s:i}]}],"
        " s:[{s:{s:[f,f,f,f], s:f, s:f}}], s:o, s:o, s:o}",
        "asset", "version", "2.0", "generator", "talus", "extensionsUsed", describe_extensions(compressed),
        "extensionsRequired", describe_extensions(compressed), "scene", 0, "scenes", "nodes", 0, "nodes",
        describe_node(q, origin), "meshes", "primitives", "attributes", attributes, "indices", last, "mode", 4,
        "material", 0, "materials", "pbrMetallicRoughness", "baseColorFactor", 0.55, 0.52, 0.46, 1.0, "metallicFactor",
        0.0, "roughnessFactor", 1.0, "accessors", accessors, "bufferViews", described, "buffers", buffers);
    if (root && e->style.attribution)
        json_object_set_new(json_object_get(root, "asset"), "copyright", json_string(e->style.attribution));
    if (root && t->pictures)
        add_pictures(t->pictures, last + 1, root);
    char *text = root ? json_dumps(root, JSON_COMPACT | JSON_REAL_PRECISION(17)) : NULL;
    json_decref(root);
    return text;
}

/* ---- The file ---- */

static unsigned char *put(unsigned char *to, const void *bytes, size_t count, char filling)
{
    memcpy(to, bytes, count);
    memset(to + count, filling, padded(count) - count);
    return to + padded(count);
}

static tl_status write_file(out_glb_encoder *e, const char *json, const view *views, int count, size_t binary,
                            size_t *size, tl_error *error)
{
    size_t text = strlen(json), whole = 12 + 8 + padded(text) + 8 + binary;
    if (whole > e->file_room) {
        free(e->file);
        e->file = malloc(whole);
        e->file_room = e->file ? whole : 0;
    }
    if (!e->file)
        return tl_fail_memory(error, "a tile");
    const uint32_t head[5] = {GLB_MAGIC, 2, (uint32_t)whole, (uint32_t)padded(text), CHUNK_JSON};
    const uint32_t next[2] = {(uint32_t)binary, CHUNK_BINARY};
    unsigned char *at = put(e->file, head, sizeof head, 0);
    at = put(at, json, text, ' ');
    at = put(at, next, sizeof next, 0);
    for (int k = 0; k < count; k++)
        at = put(at, views[k].bytes, views[k].size, 0);
    *size = whole;
    return TL_OK;
}

tl_status out_glb_encode(out_glb_encoder *e, const out_glb_tile *tile, const void **bytes, size_t *count,
                         out_glb_facts *facts, tl_error *error)
{
    view views[VIEWS];
    double origin[3];
    size_t binary;
    *count = 0;
    tl_status status = out_surface_build(&e->surface, tile, facts, error);
    if (status != TL_OK || !e->surface.index_count)
        return status;
    facts->quantum = find_steps(&e->surface, origin);
    out_surface_widen(facts, facts->quantum); /* a vertex moves by sqrt(3) / 2 of it */
    round_vertices(e, tile, facts->quantum, origin);
    size_t vertices = order(e);
    int view_count = make_views(e, tile, vertices, views);
    char *json = describe(e, tile, vertices, views, view_count, facts->quantum, origin, &binary);
    status = json ? write_file(e, json, views, view_count, binary, count, error) : tl_fail_memory(error, "a tile");
    free(json);
    *bytes = e->file;
    return status;
}
