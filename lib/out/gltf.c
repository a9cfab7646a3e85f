/* glTF 2.0 binary (GLB): one mesh with positions and normals, textures on request, in meshoptimizer's order for the
 * vertex cache and fetch. Plain, it has floats. Quantised (KHR_mesh_quantization), positions are 16-bit steps from the
 * mesh's lowest corner, by a scale and a translation of the node, an axis each: heights have finer steps than the
 * ground. Compressed, these are encoded by meshoptimizer (EXT_meshopt_compression), losslessly. */
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/frame.h"
#include "lib/out/gltf_normals.h"
#include "lib/out/out.h"
#include "lib/out/texture.h"
#include "lib/out/texture_tiles.h"
#include "lib/scene/field.h"

#include "lib/out/triangles.h"
#include <jansson.h>

#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

enum { BATCH = 1024, STEPS = 65535, GLB_MAGIC = 0x46546c67, CHUNK_JSON = 0x4e4f534a, CHUNK_BINARY = 0x004e4942 };
enum {
    ARRAY_BUFFER = 34962,
    ELEMENT_ARRAY_BUFFER = 34963,
    COMPONENT_I16 = 5122,
    COMPONENT_U16 = 5123,
    COMPONENT_U32 = 5125,
    COMPONENT_FLOAT = 5126,
    MODE_TRIANGLES = 4,
    LINEAR = 9729,
    LINEAR_MIPMAP_LINEAR = 9987,
    CLAMP_TO_EDGE = 33071
};

typedef struct vertex {
    float position[3], normal[3];
} vertex;

/* The same in 16 bits; what is left over fills words up. */
typedef struct packed {
    uint16_t position[3], none;
    int16_t normal[3], nothing;
} packed;

/* A part of the binary chunk: items of one kind, encoded or not. */
typedef struct view {
    unsigned char *bytes;
    size_t size;          /* of the bytes */
    size_t count, stride; /* of the items, decoded */
    const char *mode;     /* of EXT_meshopt_compression; NULL: never encoded */
    int target;           /* 0: none */
    tl_output *file;      /* where the bytes are, if not in memory: a PNG */
} view;

/* How a vertex moves to where the surface was before it came, and its height there. */
typedef struct morph {
    float by[3], height;
} morph;

/* How textures lie on the surface. */
typedef struct skin {
    float tangent[4], uv[2];
} skin;

enum { VIEWS = 8, KINDS = 2 /* of textures */ };

typedef struct model {
    tl_mesh_coding coding;
    bool level_steps; /* horizontal steps are 1: those of the lattice */
    double step[3];   /* of quantised positions */
    view *views;      /* VIEWS, and KINDS a tile */
    int view_count;
    vertex *vertices;
    morph *morphs; /* NULL: not asked for */
    skin *skins;   /* the same */
    unsigned textures;
    out_texture texture;         /* of a mesh in one tile */
    out_texture_tiles tiles;     /* of others; else there are none */
    out_texture *tile_textures;  /* one a tile */
    gltf_directions *directions; /* of the whole mesh, where any are asked for: borrowed */
    bool tangents;
    int indices_view, morph_view, tangent_view, uv_view, image_view;
    size_t vertex_count;
    uint32_t *indices;
    size_t index_count;
    float low[3], high[3];        /* of the positions */
    double origin[3];             /* added to positions by the node, so that the floats are small */
    bool geocentric;              /* the node's matrix takes the tangent plane to where it lies */
    double axes[3][3], centre[3]; /* of the tangent plane */
} model;

static tl_status first_position(const tl_mesh *mesh, out_frame *frame, double origin[3], tl_error *error)
{
    double xyz[1][3] = {{0}};
    tl_status status = TL_OK;
    /* a node's translation is exact in a reader that computes in double; map coordinates need it */
    if (mesh->vertex_count && out_frame_kind(frame) == TL_FRAME_PROJECTED)
        status = out_frame_apply(frame, mesh->vertices, 1, xyz, error);
    gltf_turn(xyz[0], origin);
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
            gltf_turn(xyz[i], at);
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

/* Normals of the triangles, weighted by their areas. */
static void add_mesh_normals(model *m)
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

/* Those of the ground where that is at hand and known; m->vertices are in the mesh's order. */
static tl_status add_normals(const tl_mesh *mesh, model *m, const tl_write_options *options, tl_error *error)
{
    add_mesh_normals(m);
    if (!options->ground)
        return TL_OK;
    return gltf_ground_normals(mesh, options->ground, m->directions, options->run, m->vertices->normal,
                               sizeof(vertex) / sizeof(float), error);
}

/* Fills m->morphs, of vertices in the mesh's order. */
static tl_status place_morphs(const tl_mesh *mesh, out_frame *frame, const vertex *placed, model *m, tl_error *error)
{
    float *heights = tl_alloc(mesh->vertex_count, sizeof *heights);
    tl_status status = heights ? tl_mesh_parent_heights(mesh, heights, error) : tl_fail_memory(error, "the mesh");
    for (size_t k = 0; k < mesh->vertex_count && status == TL_OK; k += BATCH) {
        tl_vertex moved[BATCH];
        double xyz[BATCH][3], at[3];
        size_t n = mesh->vertex_count - k < BATCH ? mesh->vertex_count - k : BATCH;
        for (size_t i = 0; i < n; i++) {
            moved[i] = mesh->vertices[k + i];
            moved[i].z = heights[k + i];
        }
        status = out_frame_apply(frame, moved, n, xyz, error);
        for (size_t i = 0; i < n && status == TL_OK; i++) {
            gltf_turn(xyz[i], at);
            m->morphs[k + i].height = heights[k + i];
            for (int a = 0; a < 3; a++)
                m->morphs[k + i].by[a] = (float)(at[a] - m->origin[a] - (double)placed[k + i].position[a]);
        }
    }
    free(heights);
    return status;
}

/* Puts an array beside the vertices, which may be NULL, into their order. */
static bool remap_more(void **items, size_t count, size_t size, const uint32_t *remap)
{
    if (!*items)
        return true;
    void *ordered = tl_alloc(count, size);
    if (!ordered)
        return false;
    meshopt_remapVertexBuffer(ordered, *items, count, size, remap);
    free(*items);
    *items = ordered;
    return true;
}

/* Vertices in the order in which triangles ask for them; m->vertices has room for all. */
static tl_status order_vertices(model *m, const vertex *placed, const char *path, tl_error *error)
{
    if (!m->morphs && !m->skins) {
        m->vertex_count = meshopt_optimizeVertexFetch(m->vertices, m->indices, m->index_count, placed, m->vertex_count,
                                                      sizeof *placed);
        return TL_OK;
    }
    size_t count = m->vertex_count;
    uint32_t *remap = tl_alloc(count, sizeof *remap);
    if (!remap)
        return tl_fail_memory(error, path);
    m->vertex_count = meshopt_optimizeVertexFetchRemap(remap, m->indices, m->index_count, count);
    meshopt_remapVertexBuffer(m->vertices, placed, count, sizeof *placed, remap);
    bool good = remap_more((void **)&m->morphs, count, sizeof *m->morphs, remap) &&
                remap_more((void **)&m->skins, count, sizeof *m->skins, remap);
    meshopt_remapIndexBuffer(m->indices, m->indices, m->index_count, remap);
    free(remap);
    return good ? TL_OK : tl_fail_memory(error, path);
}

/* ---- Textures ---- */

/* Fills m->skins, of vertices in the mesh's order, and, where the texture has the normals, makes theirs point up. */
static tl_status place_skins(const tl_mesh *mesh, vertex *placed, model *m, const char *path, tl_error *error)
{
    size_t tile = 0;
    for (size_t k = 0; k < mesh->vertex_count; k++) {
        const tl_vertex *v = &mesh->vertices[k];
        skin *s = &m->skins[k];
        gltf_direction d;
        double up[3];
        *s = (skin){{0}, {0}};
        while (m->tiles.count && k >= m->tiles.tiles[tile].first_vertex + m->tiles.tiles[tile].vertices)
            tile++;
        out_texture_place(m->tiles.count ? &m->tile_textures[tile] : &m->texture, v->i, v->j, s->uv);
        if (!m->tangents)
            continue;
        if (!gltf_direction_at(m->directions, v->i, v->j, (double)v->z, &d))
            return tl_fail(error, TL_ERROR_DATA, "%s: around column %d, row %d directions are not known; leave %s away",
                           path, v->i, v->j, "the normal texture");
        gltf_cross(d.down, d.along, up);
        gltf_scale_to_one(d.along);
        gltf_scale_to_one(d.up);
        for (int a = 0; a < 3; a++) {
            placed[k].normal[a] = (float)d.up[a];
            s->tangent[a] = (float)d.along[a];
        }
        s->tangent[3] = up[0] * d.up[0] + up[1] * d.up[1] + up[2] * d.up[2] < 0 ? -1 : 1; /* -1: mirrored */
    }
    return TL_OK;
}

/* Slopes in metres are no slopes where coordinates are none. */
static tl_status check_metres(const tl_mesh *mesh, const out_frame *frame, const char *path, tl_error *error)
{
    const tl_crs *crs = mesh->georef.crs;
    tl_frame kind = out_frame_kind(frame);
    if (kind == TL_FRAME_ENU || (kind == TL_FRAME_PROJECTED && !(crs && tl_crs_is_geographic(crs))))
        return TL_OK;
    return tl_fail(error, TL_ERROR_ARGUMENT,
                   "%s: a normal texture is for coordinates in metres, as of the frames enu and ecef; leave it away",
                   path);
}

static tl_status open_texture(const tl_mesh *mesh, const out_frame *frame, model *m, const tl_write_options *options,
                              const char *path, tl_error *error)
{
    if (!options->ground || options->texture_size < 0)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: textures need the ground that they show, and a size above 0",
                       path);
    tl_status status = TL_OK;
    if (m->textures & TL_TEXTURE_NORMAL)
        status = check_metres(mesh, frame, path, error);
    if (status == TL_OK)
        status = out_texture_open(mesh, options->ground, options->texture_size, &m->texture, error);
    m->tangents = m->textures & TL_TEXTURE_NORMAL;
    return status;
}

/* Whether the mesh's finest triangles are finer than the texels of one texture, as they are beside a view's eye: then
 * it is cut into tiles. */
static bool asks_for_tiles(const tl_mesh *mesh, const model *m, const tl_source *ground)
{
    return scene_field_nests(ground) && m->texture.step > ldexp(1, out_finest_edge(mesh));
}

static const char *const texture_layers[KINDS] = {"albedo", "tangent"}; /* by tl_texture's bits */

typedef struct tile_painting {
    const model *m;
    const scene_layer *layers[KINDS];
    int kinds;
    const char *path;
    const tl_run *run;
} tile_painting;

static tl_status paint_tile(void *context, tl_parallel *loop, uint64_t tile, unsigned worker, tl_error *error)
{
    const tile_painting *p = context;
    (void)loop;
    (void)worker;
    for (int k = 0; k < p->kinds; k++) {
        view *v = &p->m->views[p->m->image_view + (int)tile * p->kinds + k];
        uint64_t bytes = 0;
        v->bytes = out_texture_bytes(&p->m->tile_textures[tile], p->layers[k], p->path, p->run, &bytes, error);
        if (!v->bytes)
            return TL_ERROR_IO;
        v->size = v->count = (size_t)bytes;
        v->stride = 1;
    }
    return TL_OK;
}

static tl_status add_tile_images(model *m, const char *path, const tl_run *run, tl_error *error)
{
    scene_layer *made[KINDS] = {NULL, NULL};
    tile_painting p = {.m = m, .path = path, .run = run};
    tl_run quiet = run ? *run : (tl_run){0};
    quiet.progress = NULL;
    tl_status status = TL_OK;
    for (int k = 0; k < KINDS && status == TL_OK; k++) {
        if (!(m->textures >> k & 1))
            continue;
        const out_texture *first = &m->tile_textures[0];
        p.layers[p.kinds] = made[k] = scene_layer_create_over(first->ground, texture_layers[k], first->whole, error);
        status = made[k] ? TL_OK : TL_ERROR_IO;
        p.kinds++;
    }
    m->image_view = m->view_count;
    m->view_count += p.kinds * (int)m->tiles.count;
    if (status == TL_OK)
        status = tl_parallel_for(&quiet, m->tiles.count, m->tiles.count, paint_tile, &p, error);
    for (int k = 0; k < KINDS; k++)
        scene_layer_destroy(made[k]);
    return status;
}

/* The pictures, as parts of the binary chunk behind all others. */
static tl_status add_images(model *m, const char *path, const tl_run *run, tl_error *error)
{
    if (m->tiles.count)
        return add_tile_images(m, path, run, error);
    tl_status status = TL_OK;
    m->image_view = m->view_count;
    for (int k = 0; k < KINDS && status == TL_OK; k++) {
        if (!(m->textures >> k & 1))
            continue;
        uint64_t bytes;
        tl_output *file = out_texture_paint(&m->texture, texture_layers[k], path, run, &bytes, error);
        if (!file)
            return TL_ERROR_IO;
        m->views[m->view_count++] = (view){.file = file, .size = (size_t)bytes, .count = (size_t)bytes, .stride = 1};
    }
    return status;
}

/* Vertices that are placed already, of a part of a larger mesh. */
static void take_vertices(const vertex *ready, model *m)
{
    memcpy(m->vertices, ready, m->vertex_count * sizeof *ready);
    for (int a = 0; a < 3; a++) {
        m->low[a] = INFINITY;
        m->high[a] = -INFINITY;
        for (size_t k = 0; k < m->vertex_count; k++) {
            m->low[a] = fminf(m->low[a], ready[k].position[a]);
            m->high[a] = fmaxf(m->high[a], ready[k].position[a]);
        }
    }
}

/* Triangles in the order of the vertex cache. The pixel frame has rows for y: its picture is mirrored, so its triangles
 * are turned to face up. */
static void order_triangles_for(const tl_mesh *mesh, const out_frame *frame, model *m)
{
    bool flip = !out_frame_faces_up(frame);
    if (!m->tiles.count)
        meshopt_optimizeVertexCache(m->indices, mesh->indices, m->index_count, m->vertex_count);
    else
        memcpy(m->indices, mesh->indices, m->index_count * sizeof *m->indices);
    for (size_t k = 0; k < m->tiles.count && mesh == &m->tiles.mesh; k++) {
        const out_texture_tile *tile = &m->tiles.tiles[k];
        uint32_t *indices = m->indices + 3 * tile->first_triangle;
        for (size_t c = 0; c < 3 * tile->triangles; c++)
            indices[c] -= (uint32_t)tile->first_vertex;
        meshopt_optimizeVertexCache(indices, indices, 3 * tile->triangles, tile->vertices);
        for (size_t c = 0; c < 3 * tile->triangles; c++)
            indices[c] += (uint32_t)tile->first_vertex;
    }
    for (size_t t = 0; flip && t < m->index_count; t += 3) {
        uint32_t swapped = m->indices[t + 1];
        m->indices[t + 1] = m->indices[t + 2];
        m->indices[t + 2] = swapped;
    }
}

/* All vertices in the frame of the whole, with normals of the ground or by all triangles: so parts of it join. */
static tl_status place_all(const tl_mesh *mesh, out_frame *frame, const model *start, vertex *placed,
                           const tl_write_options *options, const char *path, tl_error *error)
{
    model m = *start;
    m.vertex_count = mesh->vertex_count;
    m.index_count = 3 * mesh->triangle_count;
    m.vertices = placed;
    m.indices = tl_alloc(m.index_count, sizeof *m.indices);
    if (!m.indices)
        return tl_fail_memory(error, path);
    order_triangles_for(mesh, frame, &m); /* sums of normals depend on it */
    tl_status status = place_vertices(mesh, frame, &m, error);
    if (status == TL_OK && !(m.textures & TL_TEXTURE_NORMAL)) /* else they point up */
        status = add_normals(mesh, &m, options, error);
    free(m.indices);
    return status;
}

/* Cuts the mesh into the tiles of textures; *ready becomes its vertices, placed, to be freed. `all`: those of the whole
 * mesh, or NULL. */
static tl_status cut(const tl_mesh *mesh, out_frame *frame, model *m, const vertex *all, vertex **ready,
                     const tl_write_options *options, const char *path, tl_error *error)
{
    const uint64_t size = options->texture_size ? (uint64_t)options->texture_size : OUT_TEXTURE_SIZE;
    out_texture_close(&m->texture);
    tl_status status = out_texture_tiles_init(&m->tiles, mesh, size * size, path, error);
    if (status != TL_OK)
        return status;
    vertex *placed = all ? NULL : tl_alloc(mesh->vertex_count, sizeof *placed);
    *ready = tl_alloc(m->tiles.mesh.vertex_count, sizeof **ready);
    m->tile_textures = calloc(m->tiles.count, sizeof *m->tile_textures);
    if ((!all && !placed) || !*ready || !m->tile_textures)
        status = tl_fail_memory(error, path);
    for (size_t k = 0; k < m->tiles.count && status == TL_OK; k++) {
        const out_texture_tile *tile = &m->tiles.tiles[k];
        status =
            out_texture_open_box(options->ground, tile->low, tile->high, tile->spacing, &m->tile_textures[k], error);
    }
    if (status == TL_OK && !all)
        status = place_all(mesh, frame, m, placed, options, path, error);
    for (size_t k = 0; k < m->tiles.mesh.vertex_count && status == TL_OK; k++)
        (*ready)[k] = (all ? all : placed)[m->tiles.from[k]];
    free(placed);
    return status;
}

/* `ready`: the vertices, placed, with their normals; NULL: they are placed here. */
static tl_status build(const tl_mesh *mesh, out_frame *frame, model *m, const vertex *ready,
                       const tl_write_options *options, const char *path, tl_error *error)
{
    bool morphs = options->parent_heights;
    m->vertex_count = mesh->vertex_count;
    m->index_count = 3 * mesh->triangle_count;
    vertex *placed = tl_alloc(m->vertex_count, sizeof *placed);
    m->vertices = tl_alloc(m->vertex_count, sizeof *m->vertices);
    m->indices = tl_alloc(m->index_count, sizeof *m->indices);
    m->morphs = morphs ? tl_alloc(m->vertex_count, sizeof *m->morphs) : NULL;
    m->skins = m->textures ? tl_alloc(m->vertex_count, sizeof *m->skins) : NULL;
    if (!placed || !m->vertices || !m->indices || (morphs && !m->morphs) || (m->textures && !m->skins)) {
        free(placed);
        return tl_fail_memory(error, path);
    }
    order_triangles_for(mesh, frame, m);
    vertex *ordered = m->vertices;
    m->vertices = placed;
    tl_status status = TL_OK;
    if (ready)
        take_vertices(ready, m);
    else
        status = place_vertices(mesh, frame, m, error);
    if (status == TL_OK && !m->tangents && !ready)
        status = add_normals(mesh, m, options, error);
    if (status == TL_OK && m->textures)
        status = place_skins(mesh, placed, m, path, error);
    if (status == TL_OK && morphs)
        status = place_morphs(mesh, frame, placed, m, error);
    m->vertices = ordered;
    if (status == TL_OK)
        status = order_vertices(m, placed, path, error);
    free(placed);
    return status;
}

/* ---- Parts of the binary chunk ---- */

static view *add_view(model *m, size_t count, size_t stride, int target, const char *mode)
{
    view *v = &m->views[m->view_count++];
    *v = (view){.count = count, .stride = stride, .size = count * stride, .target = target, .mode = mode};
    v->bytes = tl_alloc((v->size + 3) / 4, 4);
    if (v->bytes)
        memset(v->bytes + v->size, 0, (4 - v->size % 4) % 4);
    return v->bytes ? v : NULL;
}

static bool small_indices(const model *m)
{
    return m->vertex_count < STEPS; /* the largest of 16 bits restarts a primitive */
}

static bool add_indices(model *m)
{
    bool small = small_indices(m);
    m->indices_view = m->view_count;
    view *v =
        add_view(m, m->index_count, small ? sizeof(uint16_t) : sizeof *m->indices, ELEMENT_ARRAY_BUFFER, "TRIANGLES");
    for (size_t k = 0; v && small && k < m->index_count; k++) {
        uint16_t index = (uint16_t)m->indices[k];
        memcpy(v->bytes + k * sizeof index, &index, sizeof index);
    }
    if (v && !small)
        memcpy(v->bytes, m->indices, v->size);
    return v;
}

/* The steps between positions. */
static void choose_steps(model *m)
{
    for (int a = 0; a < 3; a++) {
        double range = (double)m->high[a] - (double)m->low[a];
        bool whole = m->level_steps && a != 1 && range <= STEPS;
        m->step[a] = whole || !(range > 0) ? 1 : range / STEPS;
    }
}

/* Positions and normals apart, as they are encoded best. A reader turns normals by the inverse of the node's scale, so
 * that is put in before. */
static bool add_packed(model *m)
{
    view *positions = add_view(m, m->vertex_count, 8, ARRAY_BUFFER, "ATTRIBUTES");
    view *normals = positions ? add_view(m, m->vertex_count, 8, ARRAY_BUFFER, "ATTRIBUTES") : NULL;
    for (size_t k = 0; normals && k < m->vertex_count; k++) {
        const vertex *from = &m->vertices[k];
        packed to = {{0}, 0, {0}, 0};
        double n[3], longest = 0;
        for (int a = 0; a < 3; a++) {
            to.position[a] = (uint16_t)lrint(((double)from->position[a] - (double)m->low[a]) / m->step[a]);
            n[a] = (double)from->normal[a] * m->step[a];
            longest += n[a] * n[a];
        }
        longest = sqrt(longest);
        for (int a = 0; a < 3; a++)
            to.normal[a] = (int16_t)lrint(longest > 0 ? 32767 * n[a] / longest : a == 1 ? 32767 : 0);
        memcpy(positions->bytes + 8 * k, &to, 8);
        memcpy(normals->bytes + 8 * k, (const unsigned char *)&to + offsetof(packed, normal), 8);
    }
    return normals;
}

/* Replaces a part's bytes by encoded ones. */
static bool encode(view *v, size_t vertex_count)
{
    bool triangles = v->target == ELEMENT_ARRAY_BUFFER;
    size_t room = triangles ? meshopt_encodeIndexBufferBound(v->count, vertex_count)
                            : meshopt_encodeVertexBufferBound(v->count, v->stride);
    unsigned char *bytes = tl_alloc((room + 3) / 4, 4);
    if (!bytes)
        return false;
    if (!triangles)
        v->size = meshopt_encodeVertexBuffer(bytes, room, v->bytes, v->count, v->stride);
    else if (v->stride == sizeof(uint16_t)) {
        uint32_t *wide = tl_alloc(v->count, sizeof *wide);
        for (size_t k = 0; wide && k < v->count; k++) {
            uint16_t index;
            memcpy(&index, v->bytes + 2 * k, sizeof index);
            wide[k] = index;
        }
        v->size = wide ? meshopt_encodeIndexBuffer(bytes, room, wide, v->count) : 0;
        free(wide);
    } else
        v->size = meshopt_encodeIndexBuffer(bytes, room, (const uint32_t *)(void *)v->bytes, v->count);
    free(v->bytes);
    v->bytes = bytes;
    memset(bytes + v->size, 0, (4 - v->size % 4) % 4);
    return v->size > 0;
}

/* Tangents, if there are any, and texture coordinates, in the coding's own numbers. */
static bool add_skins(model *m)
{
    bool plain = m->coding == TL_CODING_PLAIN;
    view *tangents = NULL, *places;
    m->tangent_view = m->view_count;
    if (m->tangents)
        tangents = add_view(m, m->vertex_count, plain ? 16 : 8, ARRAY_BUFFER, "ATTRIBUTES");
    m->uv_view = m->view_count;
    places = add_view(m, m->vertex_count, plain ? 8 : 4, ARRAY_BUFFER, "ATTRIBUTES");
    if (!places || (m->tangents && !tangents))
        return false;
    for (size_t k = 0; k < m->vertex_count; k++) {
        const skin *s = &m->skins[k];
        int16_t tangent[4];
        uint16_t uv[2];
        double t[3];
        for (int a = 0; a < 2; a++)
            uv[a] = (uint16_t)lrintf(s->uv[a] * STEPS);
        for (int a = 0; a < 3; a++) /* a reader turns them by the node's scale */
            t[a] = (double)s->tangent[a] / (plain ? 1 : m->step[a]);
        gltf_scale_to_one(t);
        for (int a = 0; a < 3; a++)
            tangent[a] = (int16_t)lrint(32767 * t[a]);
        tangent[3] = s->tangent[3] < 0 ? -32767 : 32767;
        memcpy(places->bytes + k * places->stride, plain ? (const void *)s->uv : uv, places->stride);
        if (tangents)
            memcpy(tangents->bytes + k * tangents->stride, plain ? (const void *)s->tangent : tangent,
                   tangents->stride);
    }
    return true;
}

static bool add_morphs(model *m)
{
    m->morph_view = m->view_count;
    view *v = add_view(m, m->vertex_count, sizeof *m->morphs, ARRAY_BUFFER, NULL);
    if (v)
        memcpy(v->bytes, m->morphs, v->size);
    return v;
}

static tl_status make_views(model *m, const char *path, tl_error *error)
{
    bool good = true;
    if (m->coding == TL_CODING_PLAIN) {
        view *v = add_view(m, m->vertex_count, sizeof *m->vertices, ARRAY_BUFFER, NULL);
        good = v;
        if (v)
            memcpy(v->bytes, m->vertices, v->size);
    } else {
        choose_steps(m);
        good = add_packed(m);
    }
    free(m->vertices); /* the largest of all, and done with */
    m->vertices = NULL;
    good = good && (!m->skins || add_skins(m)) && (!m->morphs || add_morphs(m)) && add_indices(m);
    if (m->coding == TL_CODING_COMPRESSED) {
        meshopt_encodeVertexVersion(0); /* those of the extension */
        meshopt_encodeIndexVersion(1);
        for (int k = 0; k < m->view_count; k++)
            good = good && encode(&m->views[k], m->vertex_count);
    }
    return good ? TL_OK : tl_fail_memory(error, path);
}

static void free_model(model *m)
{
    for (int k = 0; k < m->view_count; k++) {
        free(m->views[k].bytes);
        tl_output_abort(m->views[k].file);
    }
    free(m->views);
    if (m->texture.ground)
        out_texture_close(&m->texture);
    for (size_t k = 0; m->tile_textures && k < m->tiles.count; k++)
        if (m->tile_textures[k].ground)
            out_texture_close(&m->tile_textures[k]);
    free(m->tile_textures);
    out_texture_tiles_finish(&m->tiles);
    free(m->skins);
    free(m->vertices);
    free(m->morphs);
    free(m->indices);
}

/* ---- JSON ---- */

static json_t *triple(const double v[3])
{
    return json_pack("[f,f,f]", v[0], v[1], v[2]);
}

static json_t *extras(const tl_mesh *mesh, const out_frame *frame, bool geocentric)
{
    tl_frame kind = geocentric ? TL_FRAME_ECEF : out_frame_kind(frame);
    json_t *object = json_pack("{s:s, s:s, s:f}", "talus", tl_version(), "frame", out_frame_names[kind], "max_error",
                               mesh->max_error);
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

static json_t *accessor(int part, size_t offset, int component, size_t count, const char *type)
{
    return json_pack("{s:i, s:I, s:i, s:I, s:s}", "bufferView", part, "byteOffset", (json_int_t)offset, "componentType",
                     component, "count", (json_int_t)count, "type", type);
}

/* The least and the greatest position, as they are stored. */
static void add_bounds(const model *m, json_t *position)
{
    double low[3] = {0}, high[3];
    for (int a = 0; a < 3; a++) {
        low[a] = (double)m->low[a], high[a] = (double)m->high[a];
        if (m->coding != TL_CODING_PLAIN) {
            high[a] = (double)lrint((high[a] - low[a]) / m->step[a]);
            low[a] = 0;
        }
    }
    bool whole = m->coding != TL_CODING_PLAIN;
    json_object_set_new(position, "min", whole ? json_pack("[i,i,i]", 0, 0, 0) : triple(low));
    json_object_set_new(position, "max",
                        whole ? json_pack("[i,i,i]", (int)high[0], (int)high[1], (int)high[2]) : triple(high));
}

/* The same of the ways that vertices move. */
static void add_range(const model *m, json_t *by)
{
    double low[3], high[3];
    for (int a = 0; a < 3; a++) {
        low[a] = HUGE_VAL, high[a] = -HUGE_VAL;
        for (size_t k = 0; k < m->vertex_count; k++) {
            low[a] = fmin(low[a], (double)m->morphs[k].by[a]);
            high[a] = fmax(high[a], (double)m->morphs[k].by[a]);
        }
    }
    json_object_set_new(by, "min", triple(low));
    json_object_set_new(by, "max", triple(high));
}

/* An accessor whose whole numbers stand for -1 ... 1. */
static json_t *normalized(const model *m, json_t *accessor)
{
    if (m->coding != TL_CODING_PLAIN)
        json_object_set_new(accessor, "normalized", json_true());
    return accessor;
}

/* The indices of a tile, or of all. */
static json_t *index_accessor(const model *m, size_t tile)
{
    bool small = small_indices(m);
    const out_texture_tile *t = m->tiles.count ? &m->tiles.tiles[tile] : NULL;
    size_t item = small ? sizeof(uint16_t) : sizeof(uint32_t);
    return accessor(m->indices_view, t ? 3 * t->first_triangle * item : 0, small ? COMPONENT_U16 : COMPONENT_U32,
                    t ? 3 * t->triangles : m->index_count, "SCALAR");
}

static json_t *accessors(const model *m)
{
    bool plain = m->coding == TL_CODING_PLAIN;
    json_t *position = accessor(0, 0, plain ? COMPONENT_FLOAT : COMPONENT_U16, m->vertex_count, "VEC3");
    json_t *normal =
        accessor(plain ? 0 : 1, plain ? 12 : 0, plain ? COMPONENT_FLOAT : COMPONENT_I16, m->vertex_count, "VEC3");
    add_bounds(m, position);
    normalized(m, normal);
    json_t *list = json_pack("[o,o,o]", position, normal, index_accessor(m, 0));
    if (m->morphs) {
        json_t *by = accessor(m->morph_view, 0, COMPONENT_FLOAT, m->vertex_count, "VEC3");
        add_range(m, by);
        json_array_append_new(list, by);
        json_array_append_new(list, accessor(m->morph_view, 12, COMPONENT_FLOAT, m->vertex_count, "SCALAR"));
    }
    if (m->tangents)
        json_array_append_new(list, normalized(m, accessor(m->tangent_view, 0, plain ? COMPONENT_FLOAT : COMPONENT_I16,
                                                           m->vertex_count, "VEC4")));
    if (m->skins)
        json_array_append_new(list, normalized(m, accessor(m->uv_view, 0, plain ? COMPONENT_FLOAT : COMPONENT_U16,
                                                           m->vertex_count, "VEC2")));
    for (size_t tile = 1; tile < m->tiles.count; tile++)
        json_array_append_new(list, index_accessor(m, tile));
    return list;
}

static size_t padded(size_t bytes)
{
    return (bytes + 3) / 4 * 4;
}

/* Buffer 0 is the file's own chunk. What is encoded there stands, decoded, in a buffer 1 that is nowhere. */
static json_t *buffer_views(const model *m, size_t *stored, size_t *decoded)
{
    json_t *list = json_array();
    *stored = *decoded = 0;
    for (int k = 0; k < m->view_count; k++) {
        const view *v = &m->views[k];
        bool encoded = m->coding == TL_CODING_COMPRESSED && v->mode, vertices = v->target == ARRAY_BUFFER;
        size_t bytes = v->count * v->stride;
        json_t *item = json_pack("{s:i,s:I,s:I}", "buffer", encoded ? 1 : 0, "byteOffset",
                                 (json_int_t)(encoded ? *decoded : *stored), "byteLength", (json_int_t)bytes);
        if (v->target)
            json_object_set_new(item, "target", json_integer(v->target));
        if (vertices)
            json_object_set_new(item, "byteStride", json_integer((json_int_t)v->stride));
        if (encoded)
            json_object_set_new(item, "extensions",
                                json_pack("{s:{s:i,s:I,s:I,s:I,s:I,s:s}}", "EXT_meshopt_compression", "buffer", 0,
                                          "byteOffset", (json_int_t)*stored, "byteLength", (json_int_t)v->size,
                                          "byteStride", (json_int_t)v->stride, "count", (json_int_t)v->count, "mode",
                                          v->mode));
        json_array_append_new(list, item);
        *stored += padded(v->size);
        *decoded += encoded ? padded(bytes) : 0;
    }
    return list;
}

static void add_geometry(const model *m, json_t *root)
{
    size_t stored, decoded;
    json_object_set_new(root, "accessors", accessors(m));
    json_object_set_new(root, "bufferViews", buffer_views(m, &stored, &decoded));
    json_t *buffers = json_pack("[{s:I}]", "byteLength", (json_int_t)stored);
    if (m->coding == TL_CODING_COMPRESSED)
        json_array_append_new(buffers, json_pack("{s:I,s:{s:{s:b}}}", "byteLength", (json_int_t)decoded, "extensions",
                                                 "EXT_meshopt_compression", "fallback", 1));
    json_object_set_new(root, "buffers", buffers);
    if (m->coding == TL_CODING_PLAIN)
        return;
    json_t *used = json_pack("[s]", "KHR_mesh_quantization");
    if (m->coding == TL_CODING_COMPRESSED)
        json_array_append_new(used, json_string("EXT_meshopt_compression"));
    json_object_set_new(root, "extensionsUsed", used);
    json_object_set_new(root, "extensionsRequired", json_copy(used));
}

/* Of a model in the tangent plane, whose steps and corner are those of quantised positions, column by column. */
static json_t *geocentric_matrix(const model *m, const double corner[3])
{
    const double one[3] = {1, 1, 1}, *step = m->coding == TL_CODING_PLAIN ? one : m->step;
    const double *const axes[3] = {m->axes[0], m->axes[2], m->axes[1]}; /* east, up, north, which points backwards */
    const double sign[3] = {1, 1, -1};
    double place[3], turned[3];
    json_t *matrix = json_array();
    memcpy(place, m->centre, sizeof place);
    for (int c = 0; c < 3; c++) {
        gltf_turn(axes[c], turned);
        for (int a = 0; a < 3; a++) {
            json_array_append_new(matrix, json_real(sign[c] * step[c] * turned[a]));
            place[a] += sign[c] * corner[c] * axes[c][a];
        }
        json_array_append_new(matrix, json_real(0));
    }
    gltf_turn(place, turned);
    for (int a = 0; a < 3; a++)
        json_array_append_new(matrix, json_real(turned[a]));
    json_array_append_new(matrix, json_real(1));
    return matrix;
}

static json_t *describe_node(const model *m)
{
    json_t *node = json_pack("{s:i, s:s}", "mesh", 0, "name", "terrain");
    double at[3];
    bool plain = m->coding == TL_CODING_PLAIN;
    for (int a = 0; a < 3; a++)
        at[a] = m->origin[a] + (plain ? 0 : (double)m->low[a]);
    if (m->geocentric) {
        json_object_set_new(node, "matrix", geocentric_matrix(m, at));
        return node;
    }
    if (at[0] != 0 || at[1] != 0 || at[2] != 0)
        json_object_set_new(node, "translation", triple(at));
    if (!plain)
        json_object_set_new(node, "scale", triple(m->step));
    return node;
}

/* The surface before the vertices came, at weight 1. */
static void add_target(json_t *root)
{
    json_t *mesh = json_array_get(json_object_get(root, "meshes"), 0);
    json_t *primitive = json_array_get(json_object_get(mesh, "primitives"), 0);
    json_object_set_new(primitive, "targets", json_pack("[{s:i}]", "POSITION", 3));
    json_object_set_new(json_object_get(primitive, "attributes"), "_PARENT_HEIGHT", json_integer(4));
    json_object_set_new(mesh, "weights", json_pack("[f]", 0.0));
    json_object_set_new(mesh, "extras", json_pack("{s:[s]}", "targetNames", "parent"));
}

/* One primitive and material for each tile, of the same vertices, from those of the first. */
static void add_tiles(const model *m, int indices, json_t *root)
{
    json_t *mesh = json_array_get(json_object_get(root, "meshes"), 0);
    json_t *primitives = json_object_get(mesh, "primitives"), *materials = json_object_get(root, "materials");
    json_t *images = json_object_get(root, "images"), *textures = json_object_get(root, "textures");
    size_t kinds = json_array_size(images);
    for (size_t tile = 1; tile < m->tiles.count; tile++) {
        json_t *primitive = json_copy(json_array_get(primitives, 0));
        json_t *material = json_deep_copy(json_array_get(materials, 0));
        json_t *colour = json_object_get(json_object_get(material, "pbrMetallicRoughness"), "baseColorTexture");
        json_t *normal = json_object_get(material, "normalTexture");
        json_int_t first = (json_int_t)(tile * kinds), next = first;
        json_object_set_new(primitive, "indices", json_integer(indices + (json_int_t)tile - 1));
        json_object_set_new(primitive, "material", json_integer((json_int_t)tile));
        if (colour)
            json_object_set_new(colour, "index", json_integer(next++));
        if (normal)
            json_object_set_new(normal, "index", json_integer(next++));
        for (; first < next; first++) {
            json_array_append_new(images,
                                  json_pack("{s:I,s:s}", "bufferView", m->image_view + first, "mimeType", "image/png"));
            json_array_append_new(textures, json_pack("{s:i,s:I}", "sampler", 0, "source", first));
        }
        json_array_append_new(primitives, primitive);
        json_array_append_new(materials, material);
    }
}

/* Colours and normals of the material, and where vertices lie on them. */
static void add_textures(const model *m, json_t *root)
{
    json_t *mesh = json_array_get(json_object_get(root, "meshes"), 0);
    json_t *attributes = json_object_get(json_array_get(json_object_get(mesh, "primitives"), 0), "attributes");
    json_t *material = json_array_get(json_object_get(root, "materials"), 0);
    json_t *surface = json_object_get(material, "pbrMetallicRoughness");
    json_t *images = json_array(), *textures = json_array();
    int next = m->morphs ? 5 : 3, count = 0; /* accessors */
    if (m->tangents)
        json_object_set_new(attributes, "TANGENT", json_integer(next++));
    json_object_set_new(attributes, "TEXCOORD_0", json_integer(next));
    if (m->textures & TL_TEXTURE_COLOUR) {
        json_object_set_new(surface, "baseColorTexture", json_pack("{s:i}", "index", count++));
        json_object_set_new(surface, "baseColorFactor", json_pack("[f,f,f,f]", 1.0, 1.0, 1.0, 1.0));
    }
    if (m->textures & TL_TEXTURE_NORMAL)
        json_object_set_new(material, "normalTexture", json_pack("{s:i}", "index", count++));
    for (int k = 0; k < count; k++) {
        json_array_append_new(images, json_pack("{s:i,s:s}", "bufferView", m->image_view + k, "mimeType", "image/png"));
        json_array_append_new(textures, json_pack("{s:i,s:i}", "sampler", 0, "source", k));
    }
    json_object_set_new(root, "images", images);
    json_object_set_new(root, "textures", textures);
    json_object_set_new(root, "samplers",
                        json_pack("[{s:i,s:i,s:i,s:i}]", "magFilter", LINEAR, "minFilter", LINEAR_MIPMAP_LINEAR,
                                  "wrapS", CLAMP_TO_EDGE, "wrapT", CLAMP_TO_EDGE));
    add_tiles(m, next + 1, root);
}

static char *describe(const tl_mesh *mesh, const out_frame *frame, const model *m)
{
    json_t *root = json_pack("{s:{s:s, s:s, s:o}, s:i, s:[{s:[i]}], s:[o], s:[{s:[{s:{s:i,s:i}, s:i, s:i, s:i}]}], "
                             "s:[{s:{s:[f,f,f,f], s:f, s:f}}]}",
                             "asset", "version", "2.0", "generator", "talus", "extras",
                             extras(mesh, frame, m->geocentric), "scene", 0, "scenes", "nodes", 0, "nodes",
                             describe_node(m), "meshes", "primitives", "attributes", "POSITION", 0, "NORMAL", 1,
                             "indices", 2, "mode", MODE_TRIANGLES, "material", 0, "materials", "pbrMetallicRoughness",
                             "baseColorFactor", 0.55, 0.52, 0.46, 1.0, "metallicFactor", 0.0, "roughnessFactor", 1.0);
    if (root)
        add_geometry(m, root);
    if (root && m->morphs)
        add_target(root);
    if (root && m->textures)
        add_textures(m, root);
    char *text = root ? json_dumps(root, JSON_COMPACT | JSON_REAL_PRECISION(17)) : NULL;
    json_decref(root);
    return text;
}

/* ---- file ---- */

static tl_status write_words(tl_output *output, const uint32_t *words, size_t count, tl_error *error)
{
    return tl_output_append(output, words, count * sizeof *words, error);
}

static tl_status too_large(const char *path, size_t triangles, tl_error *error)
{
    return tl_fail(
        error, TL_ERROR_ARGUMENT,
        "%s: %zu triangles need more than the 4 GiB of a GLB; give --split N, for files of N triangles, or use "
        ".ply",
        path, triangles);
}

static tl_status copy_file(const view *from, tl_output *output, tl_error *error)
{
    unsigned char piece[1 << 14];
    tl_status status = TL_OK;
    for (size_t at = 0; at < from->size && status == TL_OK; at += sizeof piece) {
        size_t some = from->size - at < sizeof piece ? from->size - at : sizeof piece;
        status = tl_output_read_at(from->file, piece, some, at, error);
        if (status == TL_OK)
            status = tl_output_append(output, piece, some, error);
    }
    return status == TL_OK ? tl_output_append(output, "\0\0\0", padded(from->size) - from->size, error) : status;
}

static tl_status write_file(const model *m, const char *json, tl_output *output, tl_error *error)
{
    size_t text = strlen(json), room = padded(text);
    uint64_t binary = 0;
    for (int k = 0; k < m->view_count; k++)
        binary += padded(m->views[k].size);
    uint64_t whole = 12 + 8 + room + 8 + binary;
    if (whole > UINT32_MAX)
        return too_large(tl_output_path(output), m->index_count / 3, error);
    const uint32_t head[5] = {GLB_MAGIC, 2, (uint32_t)whole, (uint32_t)room, CHUNK_JSON};
    const uint32_t binary_head[2] = {(uint32_t)binary, CHUNK_BINARY};
    tl_status status = write_words(output, head, 5, error);
    if (status == TL_OK)
        status = tl_output_append(output, json, text, error);
    if (status == TL_OK)
        status = tl_output_append(output, "   ", room - text, error);
    if (status == TL_OK)
        status = write_words(output, binary_head, 2, error);
    for (int k = 0; status == TL_OK && k < m->view_count; k++)
        status = m->views[k].file ? copy_file(&m->views[k], output, error)
                                  : tl_output_append(output, m->views[k].bytes, padded(m->views[k].size), error);
    return status;
}

/* A mesh, or a part of one in whose frame it is placed: then its vertices are `ready`. */
static tl_status write_model(const tl_mesh *mesh, out_frame *frame, const model *start, const vertex *ready,
                             const tl_write_options *options, tl_output *output, tl_error *error)
{
    const char *path = tl_output_path(output);
    model m = *start;
    tl_status status = TL_OK;
    vertex *ready_tiles = NULL;
    const tl_mesh *whole = mesh;
    if (m.textures)
        status = open_texture(mesh, frame, &m, options, path, error);
    if (status == TL_OK && m.textures && asks_for_tiles(mesh, &m, options->ground)) {
        status = cut(mesh, frame, &m, ready, &ready_tiles, options, path, error);
        mesh = status == TL_OK ? &m.tiles.mesh : whole;
        ready = ready_tiles;
    }
    m.views = calloc(VIEWS + KINDS * m.tiles.count, sizeof *m.views);
    if (status == TL_OK && !m.views)
        status = tl_fail_memory(error, path);
    if (status == TL_OK)
        status = build(mesh, frame, &m, ready, options, path, error);
    if (status == TL_OK)
        status = make_views(&m, path, error);
    if (status == TL_OK && m.textures)
        status = add_images(&m, path, options->run, error);
    char *json = status == TL_OK ? describe(mesh, frame, &m) : NULL;
    if (status == TL_OK)
        status = json ? write_file(&m, json, output, error) : tl_fail_memory(error, path);
    free(json);
    free(ready_tiles);
    free_model(&m);
    return status;
}

/* The frame of a mesh, and what all models in it have in common. */
static tl_status begin(const tl_mesh *mesh, const char *path, const tl_write_options *options, out_frame **frame,
                       model *start, tl_error *error)
{
    if (!mesh->triangle_count)
        return tl_fail(error, TL_ERROR_DATA, "%s: there is no triangle to write, and glTF has no empty meshes", path);
    if (options->coding == TL_CODING_COMPRESSED && !OUT_HAS_CODECS)
        return out_lacks_codecs(path, error);
    if (options->parent_heights && options->coding != TL_CODING_PLAIN)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: heights of parents are kept as floats; leave the coding away",
                       path);
    tl_status status = tl_run_check(options->run, error);
    bool geocentric = options->frame == TL_FRAME_ECEF; /* floats hold a tangent plane's metres, not the Earth's */
    tl_frame kind = geocentric ? TL_FRAME_ENU : options->frame;
    *frame = status == TL_OK ? out_frame_create(mesh, kind, path, error) : NULL;
    if (!*frame)
        return status == TL_OK ? TL_ERROR_DATA : status;
    *start = (model){
        .coding = options->coding, .level_steps = out_frame_kind(*frame) == TL_FRAME_PIXEL, .geocentric = geocentric};
    start->textures = options->textures & (TL_TEXTURE_COLOUR | TL_TEXTURE_NORMAL);
    out_frame_tangent(*frame, start->axes, start->centre);
    if (options->ground)
        start->directions = gltf_directions_create(mesh, *frame, path, error);
    if (options->ground && !start->directions)
        return TL_ERROR_MEMORY;
    return first_position(mesh, *frame, start->origin, error);
}

tl_status out_gltf_write(const tl_mesh *mesh, tl_output *output, const tl_write_options *options, tl_error *error)
{
    const char *path = tl_output_path(output);
    double least =
        options->coding == TL_CODING_PLAIN ? sizeof(vertex) : sizeof(packed); /* bytes a vertex, not encoded */
    if (options->coding != TL_CODING_COMPRESSED &&
        (double)mesh->vertex_count * least + (double)mesh->triangle_count * 6 > UINT32_MAX)
        return too_large(path, mesh->triangle_count, error);
    model start = {.directions = NULL};
    out_frame *frame = NULL;
    tl_status status = begin(mesh, path, options, &frame, &start, error);
    if (status == TL_OK)
        status = write_model(mesh, frame, &start, NULL, options, output, error);
    gltf_directions_destroy(start.directions);
    out_frame_destroy(frame);
    return status;
}

/* ---- Parts ---- */

typedef struct parts {
    const tl_mesh *mesh;
    int64_t across; /* tiles each way */
    int64_t low[2], size[2];
    uint32_t *order;   /* triangles, tile by tile */
    size_t *first;     /* in `order`, of each tile; across^2 + 1 */
    uint32_t *numbers; /* of the mesh's vertices in the part in hand; UINT32_MAX: not there */
    vertex *placed;    /* all vertices, with their normals */
    tl_mesh part;      /* in hand, with room for the largest */
    vertex *ready;
} parts;

/* The tile of a triangle, by its centroid: three times the sums, so that all is whole. */
static size_t tile_of(const parts *p, size_t triangle)
{
    const uint32_t *corner = p->mesh->indices + 3 * triangle;
    int64_t at[2] = {0, 0};
    for (int k = 0; k < 3; k++) {
        at[0] += p->mesh->vertices[corner[k]].i - p->low[0];
        at[1] += p->mesh->vertices[corner[k]].j - p->low[1];
    }
    for (int a = 0; a < 2; a++)
        at[a] = tl_int64_min(at[a] * p->across / (3 * p->size[a]), p->across - 1);
    return (size_t)(at[1] * p->across + at[0]);
}

/* Triangles of each tile go to first[tile + 1]; the most of one. */
static size_t count_triangles(parts *p)
{
    size_t tiles = (size_t)(p->across * p->across), most = 0;
    memset(p->first, 0, (tiles + 1) * sizeof *p->first);
    for (size_t t = 0; t < p->mesh->triangle_count; t++)
        p->first[tile_of(p, t) + 1]++;
    for (size_t k = 1; k <= tiles; k++)
        most = p->first[k] > most ? p->first[k] : most;
    return most;
}

/* As few tiles as hold at most `split` triangles each. */
static tl_status choose_tiles(parts *p, size_t split, size_t *most, const char *path, tl_error *error)
{
    enum { MOST_ACROSS = 1024 };
    for (p->across = 1; p->across <= MOST_ACROSS;) {
        free(p->first);
        p->first = tl_alloc((size_t)(p->across * p->across) + 1, sizeof *p->first);
        if (!p->first)
            return tl_fail_memory(error, path);
        *most = count_triangles(p);
        if (*most <= split)
            return TL_OK;
        double more = sqrt((double)*most / (double)split);
        p->across = tl_int64_max(p->across + 1, (int64_t)((double)p->across * fmin(more, 4)));
    }
    return tl_fail(error, TL_ERROR_ARGUMENT,
                   "%s: parts of %zu triangles would be more than a million; take larger ones", path, split);
}

static tl_status order_triangles(parts *p, const char *path, tl_error *error)
{
    size_t tiles = (size_t)(p->across * p->across);
    size_t *next = tl_alloc(tiles, sizeof *next);
    p->order = tl_alloc(p->mesh->triangle_count, sizeof *p->order);
    if (!next || !p->order) {
        free(next);
        return tl_fail_memory(error, path);
    }
    for (size_t k = 0; k < tiles; k++) {
        p->first[k + 1] += p->first[k];
        next[k] = p->first[k];
    }
    for (size_t t = 0; t < p->mesh->triangle_count; t++)
        p->order[next[tile_of(p, t)]++] = (uint32_t)t;
    free(next);
    return TL_OK;
}

static void take_part(parts *p, size_t tile)
{
    tl_mesh *part = &p->part;
    part->vertex_count = 0;
    part->triangle_count = p->first[tile + 1] - p->first[tile];
    for (size_t t = 0; t < part->triangle_count; t++)
        for (size_t k = 0; k < 3; k++) {
            uint32_t from = p->mesh->indices[3 * (size_t)p->order[p->first[tile] + t] + k];
            if (p->numbers[from] == UINT32_MAX) {
                p->numbers[from] = (uint32_t)part->vertex_count;
                part->vertices[part->vertex_count] = p->mesh->vertices[from];
                p->ready[part->vertex_count++] = p->placed[from];
            }
            part->indices[3 * t + k] = p->numbers[from];
        }
    for (size_t t = 0; t < part->triangle_count; t++)
        for (size_t k = 0; k < 3; k++)
            p->numbers[p->mesh->indices[3 * (size_t)p->order[p->first[tile] + t] + k]] = UINT32_MAX;
}

/* "mesh.glb" to "mesh_x2_y0.glb"; to be freed. */
static char *part_path(const parts *p, const char *path, size_t tile)
{
    size_t stem = (size_t)(strrchr(path, '.') - path), room = strlen(path) + 32, across = (size_t)p->across;
    char *out = malloc(room);
    if (out)
        snprintf(out, room, "%.*s_x%zu_y%zu%s", (int)stem, path, tile % across, tile / across, path + stem);
    return out;
}

static tl_status write_part(parts *p, size_t tile, out_frame *frame, const model *start, const char *path,
                            const tl_write_options *options, tl_error *error)
{
    char *name = part_path(p, path, tile);
    if (!name)
        return tl_fail_memory(error, path);
    tl_output *output = tl_output_open(name, options->overwrite, error);
    tl_status status = output ? TL_OK : TL_ERROR_IO;
    if (status == TL_OK) {
        take_part(p, tile);
        status = write_model(&p->part, frame, start, p->ready, options, output, error);
    }
    if (status == TL_OK)
        status = tl_output_commit(output, error);
    else
        tl_output_abort(output);
    free(name);
    return status;
}

/* After a failure: parts that replaced nothing go. */
static void remove_parts(const parts *p, size_t count, const char *path, const tl_write_options *options)
{
    for (size_t tile = 0; tile < count && !options->overwrite; tile++) {
        char *name = p->first[tile + 1] > p->first[tile] ? part_path(p, path, tile) : NULL;
        if (name)
            unlink(name);
        free(name);
    }
}

static tl_status make_room(parts *p, size_t most, const char *path, tl_error *error)
{
    size_t vertices = p->mesh->vertex_count < 3 * most ? p->mesh->vertex_count : 3 * most;
    p->part = *p->mesh;
    p->part.vertices = tl_alloc(vertices, sizeof *p->part.vertices);
    p->part.indices = tl_alloc(3 * most, sizeof *p->part.indices);
    p->ready = tl_alloc(vertices, sizeof *p->ready);
    p->placed = tl_alloc(p->mesh->vertex_count, sizeof *p->placed);
    p->numbers = tl_alloc(p->mesh->vertex_count, sizeof *p->numbers);
    if (!p->part.vertices || !p->part.indices || !p->ready || !p->placed || !p->numbers)
        return tl_fail_memory(error, path);
    memset(p->numbers, 0xff, p->mesh->vertex_count * sizeof *p->numbers);
    return TL_OK;
}

static void find_size(parts *p)
{
    int64_t high[2] = {INT64_MIN, INT64_MIN};
    p->low[0] = p->low[1] = INT64_MAX;
    for (size_t k = 0; k < p->mesh->vertex_count; k++) {
        const int64_t at[2] = {p->mesh->vertices[k].i, p->mesh->vertices[k].j};
        for (int a = 0; a < 2; a++) {
            p->low[a] = tl_int64_min(p->low[a], at[a]);
            high[a] = tl_int64_max(high[a], at[a]);
        }
    }
    for (int a = 0; a < 2; a++)
        p->size[a] = tl_int64_max(high[a] - p->low[a], 1);
}

tl_status out_gltf_write_parts(const tl_mesh *mesh, const char *path, const tl_write_options *options, tl_error *error)
{
    if (options->coding != TL_CODING_PLAIN || options->parent_heights)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: parts have floats, so that they join, and no heights of parents; leave these away", path);
    model start = {.directions = NULL};
    out_frame *frame = NULL;
    parts p = {.mesh = mesh};
    size_t most = 0;
    tl_status status = begin(mesh, path, options, &frame, &start, error);
    find_size(&p);
    if (status == TL_OK)
        status = choose_tiles(&p, options->split, &most, path, error);
    if (status == TL_OK)
        status = order_triangles(&p, path, error);
    if (status == TL_OK)
        status = make_room(&p, most, path, error);
    if (status == TL_OK)
        status = place_all(mesh, frame, &start, p.placed, options, path, error);
    size_t tile = 0, tiles = (size_t)(p.across * p.across);
    for (; status == TL_OK && tile < tiles; tile++)
        if (p.first[tile + 1] > p.first[tile])
            status = write_part(&p, tile, frame, &start, path, options, error);
    if (status != TL_OK && tile)
        remove_parts(&p, tile - 1, path, options);
    gltf_directions_destroy(start.directions);
    out_frame_destroy(frame);
    free(p.first);
    free(p.order);
    free(p.numbers);
    free(p.placed);
    free(p.ready);
    free(p.part.vertices);
    free(p.part.indices);
    return status;
}
