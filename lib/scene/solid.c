/* Skirts and solids: walls below the open edges of a mesh, and a floor. */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* A side of a triangle: from corner to the next corner, by index into `indices`. */
typedef struct border {
    uint32_t low, high; /* vertices */
    uint32_t corner;
} border;

typedef struct solid {
    tl_mesh *mesh;
    border *edges; /* all sides; later the open ones alone */
    size_t count;
    uint32_t *parent;  /* of corners: which of them are one vertex */
    uint32_t *lowered; /* of vertices: the number of the one below, or NONE */
} solid;

static const uint32_t NONE = UINT32_MAX;

static uint32_t next_corner(uint32_t corner)
{
    return corner % 3 == 2 ? corner - 2 : corner + 1;
}

/* ---- Open edges ------------------------------------------------------------------------------------ */

static int compare_borders(const void *a, const void *b)
{
    const border *p = a, *q = b;
    if (p->low != q->low)
        return p->low < q->low ? -1 : 1;
    if (p->high != q->high)
        return p->high < q->high ? -1 : 1;
    return p->corner < q->corner ? -1 : p->corner > q->corner;
}

static uint32_t root(uint32_t *parent, uint32_t corner)
{
    while (parent[corner] != corner)
        corner = parent[corner] = parent[parent[corner]];
    return corner;
}

static void join(uint32_t *parent, uint32_t a, uint32_t b)
{
    a = root(parent, a), b = root(parent, b);
    parent[a > b ? a : b] = a < b ? a : b;
}

/* Keeps the sides that have no other beside them, in order of corners' triangles; joins the corners of the others. */
static void find_open(solid *self)
{
    size_t open = 0;
    for (size_t k = 0; k < self->count; k++) {
        const border *one = &self->edges[k], *other = one + 1;
        if (k + 1 < self->count && one->low == other->low && one->high == other->high) {
            join(self->parent, one->corner, next_corner(other->corner));
            join(self->parent, next_corner(one->corner), other->corner);
            k++;
        } else
            self->edges[open++] = *one;
    }
    self->count = open;
}

static tl_status begin(solid *self, tl_error *error)
{
    const tl_mesh *mesh = self->mesh;
    size_t corners;
    if (!tl_size_mul(mesh->triangle_count, 3, &corners) || corners >= NONE)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%zu triangles are too many for a skirt or a base; %s",
                       mesh->triangle_count, "use a larger max_error");
    self->edges = tl_alloc(corners, sizeof *self->edges);
    self->parent = tl_alloc(corners, sizeof *self->parent);
    if (!self->edges || !self->parent)
        return tl_fail_memory(error, "the mesh's walls");
    self->count = corners;
    for (uint32_t k = 0; k < corners; k++) {
        uint32_t a = mesh->indices[k], b = mesh->indices[next_corner(k)];
        self->edges[k] = (border){a < b ? a : b, a < b ? b : a, k};
        self->parent[k] = k;
    }
    qsort(self->edges, corners, sizeof *self->edges, compare_borders);
    find_open(self);
    return TL_OK;
}

static void finish(solid *self)
{
    free(self->edges);
    free(self->parent);
    free(self->lowered);
}

/* ---- Room ------------------------------------------------------------------------------------------ */

static tl_status grow(tl_mesh *mesh, size_t vertices, size_t triangles, tl_error *error)
{
    size_t all = mesh->vertex_count + vertices, indices;
    if (all >= NONE || !tl_size_mul(mesh->triangle_count + triangles, 3 * sizeof *mesh->indices, &indices))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%zu vertices are more than a mesh can have; use a larger max_error",
                       all);
    tl_vertex *v = realloc(mesh->vertices, (all ? all : 1) * sizeof *v);
    mesh->vertices = v ? v : mesh->vertices;
    uint32_t *t = realloc(mesh->indices, indices ? indices : 1);
    mesh->indices = t ? t : mesh->indices;
    return v && t ? TL_OK : tl_fail_memory(error, "the mesh's walls");
}

static void add_triangle(tl_mesh *mesh, uint32_t a, uint32_t b, uint32_t c)
{
    uint32_t *to = mesh->indices + 3 * mesh->triangle_count++;
    to[0] = a, to[1] = b, to[2] = c;
}

/* The wall below the open side a-b, whose triangle has it in this direction. */
static void add_wall(solid *self, uint32_t a, uint32_t b)
{
    add_triangle(self->mesh, b, a, self->lowered[a]);
    add_triangle(self->mesh, b, self->lowered[a], self->lowered[b]);
}

static void add_walls(solid *self)
{
    for (size_t k = 0; k < self->count; k++)
        add_wall(self, self->mesh->indices[self->edges[k].corner],
                 self->mesh->indices[next_corner(self->edges[k].corner)]);
}

static bool make_lowered(solid *self)
{
    size_t count = self->mesh->vertex_count;
    self->lowered = tl_alloc(count, sizeof *self->lowered);
    if (self->lowered)
        memset(self->lowered, 0xff, count * sizeof *self->lowered);
    return self->lowered;
}

static tl_status record(tl_mesh *mesh, const char *name, double value, tl_error *error)
{
    char text[TL_NUMBER_TEXT];
    tl_number_text(value, text);
    return tl_mesh_add_parameter(mesh, name, text, error);
}

/* Whether z - depth lies below z as floats, of which the files are made. */
static bool reaches_down(float z, double depth)
{
    float below = (float)((double)z - depth);
    return below < z && isfinite(below);
}

static tl_status check_depth(const tl_mesh *mesh, double depth, const char *name, tl_error *error)
{
    if (!(depth > 0 && depth <= 1e30))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s %g: must be larger than 0, and at most 1e30", name, depth);
    for (size_t k = 0; k < mesh->vertex_count; k++)
        if (!reaches_down(mesh->vertices[k].z, depth))
            return tl_fail(error, TL_ERROR_ARGUMENT, "%s %g: too little below a height of %g in single precision", name,
                           depth, (double)mesh->vertices[k].z);
    return TL_OK;
}

/* ---- Skirts ------------------------------------------------------------------------------------------ */

static tl_status hang(solid *self, double depth, tl_error *error)
{
    tl_mesh *mesh = self->mesh;
    if (!make_lowered(self))
        return tl_fail_memory(error, "the mesh's skirt");
    tl_status status =
        grow(mesh, mesh->vertex_count < 2 * self->count ? mesh->vertex_count : 2 * self->count, 2 * self->count, error);
    for (size_t k = 0; k < 2 * self->count && status == TL_OK; k++) {
        uint32_t corner = self->edges[k / 2].corner, v = mesh->indices[k % 2 ? next_corner(corner) : corner];
        if (self->lowered[v] != NONE)
            continue;
        self->lowered[v] = (uint32_t)mesh->vertex_count;
        mesh->vertices[mesh->vertex_count] = mesh->vertices[v];
        mesh->vertices[mesh->vertex_count].z = (float)((double)mesh->vertices[v].z - depth);
        mesh->vertex_count++;
    }
    if (status == TL_OK)
        add_walls(self);
    return status;
}

tl_status tl_mesh_add_skirt(tl_mesh *mesh, double depth, tl_error *error)
{
    solid self = {.mesh = mesh};
    tl_status status = check_depth(mesh, depth, "skirt", error);
    if (status == TL_OK)
        status = begin(&self, error);
    if (status == TL_OK)
        status = record(mesh, "skirt", depth, error);
    if (status == TL_OK)
        status = hang(&self, depth, error);
    finish(&self);
    return status;
}

/* ---- Solids ------------------------------------------------------------------------------------------ */

/* Gives every fan of triangles around a vertex a vertex of its own: where two parts of the mesh touch in one, their
 * walls would share an edge between four triangles. */
static tl_status part_fans(solid *self, tl_error *error)
{
    tl_mesh *mesh = self->mesh;
    size_t corners = 3 * mesh->triangle_count, more = 0;
    unsigned char *taken = calloc(mesh->vertex_count + 1, 1);
    if (!taken)
        return tl_fail_memory(error, "the mesh's base");
    for (uint32_t k = 0; k < corners; k++)
        if (self->parent[k] == k) {
            more += taken[mesh->indices[k]];
            taken[mesh->indices[k]] = 1;
        }
    tl_status status = grow(mesh, more, 0, error);
    memset(taken, 0, mesh->vertex_count);
    for (uint32_t k = 0; k < corners && status == TL_OK; k++) {
        uint32_t first = root(self->parent, k), v = mesh->indices[k];
        if (first != k) {
            mesh->indices[k] = mesh->indices[first];
        } else if (taken[v]) {
            mesh->indices[k] = (uint32_t)mesh->vertex_count;
            mesh->vertices[mesh->vertex_count++] = mesh->vertices[v];
        } else
            taken[v] = 1;
    }
    free(taken);
    return status;
}

/* A floor below every triangle, with the same corners, and the walls. */
static tl_status close_up(solid *self, double thickness, tl_error *error)
{
    tl_mesh *mesh = self->mesh;
    tl_status status = part_fans(self, error);
    size_t vertices = mesh->vertex_count, triangles = mesh->triangle_count;
    if (status == TL_OK)
        status = grow(mesh, vertices, triangles + 2 * self->count, error);
    if (status == TL_OK && !make_lowered(self))
        status = tl_fail_memory(error, "the mesh's base");
    if (status != TL_OK)
        return status;
    float lowest = INFINITY;
    for (size_t k = 0; k < vertices; k++)
        lowest = fminf(lowest, mesh->vertices[k].z);
    for (size_t k = 0; k < vertices; k++) {
        self->lowered[k] = (uint32_t)(vertices + k);
        mesh->vertices[vertices + k] = mesh->vertices[k];
        mesh->vertices[vertices + k].z = (float)((double)lowest - thickness);
    }
    mesh->vertex_count = 2 * vertices;
    for (size_t t = 0; t < triangles; t++) {
        const uint32_t *top = mesh->indices + 3 * t;
        add_triangle(mesh, self->lowered[top[0]], self->lowered[top[2]], self->lowered[top[1]]);
    }
    add_walls(self);
    return TL_OK;
}

tl_status tl_mesh_add_base(tl_mesh *mesh, double thickness, tl_error *error)
{
    solid self = {.mesh = mesh};
    tl_status status = check_depth(mesh, thickness, "base", error);
    if (status == TL_OK)
        status = begin(&self, error);
    if (status == TL_OK)
        status = record(mesh, "base", thickness, error);
    if (status == TL_OK)
        status = close_up(&self, thickness, error);
    finish(&self);
    return status;
}
