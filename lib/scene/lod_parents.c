/* Where the vertices of a lattice mesh would be if the triangles that they split were whole. */
#include "dem/framework.h"
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/talus.h"

#include <math.h>

/* The vertices of a mesh by their places: open addressing. */
typedef struct places {
    const tl_mesh *mesh;
    uint32_t *slots; /* 1 + index; 0: none */
    size_t room;     /* a power of two */
} places;

static size_t slot_of(const places *p, int64_t i, int64_t j)
{
    uint64_t key = ((uint64_t)i << 32 | (uint64_t)j) * UINT64_C(0x9e3779b97f4a7c15);
    size_t at = (size_t)(key >> 24) & (p->room - 1);
    while (p->slots[at]) {
        const tl_vertex *v = &p->mesh->vertices[p->slots[at] - 1];
        if (v->i == i && v->j == j)
            break;
        at = (at + 1) & (p->room - 1);
    }
    return at;
}

static tl_status places_init(places *p, const tl_mesh *mesh, tl_error *error)
{
    *p = (places){.mesh = mesh, .room = 1024};
    while (p->room < 2 * mesh->vertex_count)
        p->room *= 2;
    p->slots = calloc(p->room, sizeof *p->slots);
    if (!p->slots)
        return tl_fail_memory(error, "the mesh");
    for (size_t k = 0; k < mesh->vertex_count; k++)
        p->slots[slot_of(p, mesh->vertices[k].i, mesh->vertices[k].j)] = (uint32_t)k + 1;
    return TL_OK;
}

/* The height at a place; NaN where there is no vertex. */
static double height_at(const places *p, int64_t i, int64_t j)
{
    uint32_t slot = i < 0 || j < 0 ? 0 : p->slots[slot_of(p, i, j)];
    return slot ? (double)p->mesh->vertices[slot - 1].z : (double)NAN;
}

/* The ends of the edge in whose middle a vertex is: of the parents of an edge point, which lie across it, turned by a
 * quarter; of a centre, likewise, the other two corners of its square. */
static float parent_height(const places *p, const tl_vertex *v)
{
    int64_t up[2][2];
    if (v->i == 0 && v->j == 0)
        return v->z;
    tl_lattice_parents(v->i, v->j, up);
    int64_t x = up[0][0] - v->i, y = up[0][1] - v->j;
    double middle = .5 * (height_at(p, v->i - y, v->j + x) + height_at(p, v->i + y, v->j - x));
    return isnan(middle) ? v->z : (float)middle;
}

tl_status tl_mesh_parent_heights(const tl_mesh *mesh, float *out, tl_error *error)
{
    places p;
    tl_status status = places_init(&p, mesh, error);
    for (size_t k = 0; k < mesh->vertex_count && status == TL_OK; k++)
        out[k] = parent_height(&p, &mesh->vertices[k]);
    free(p.slots);
    return status;
}
