#include "lib/out/texture_tiles.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <string.h>

enum {
    LEAST_TEXELS_LOG = 8, /* on a tile's side */
    MOST_TEXELS_LOG = 12,
    MOST_TILES = 256, /* each is a draw call */
    DEEPEST = 32,
    NO_EDGE = 63
};

typedef struct cutting {
    const tl_mesh *mesh;
    uint32_t *order, *spare; /* triangles */
    unsigned char *edges;    /* logarithms of the triangles' shortest */
    int texels_log;
    out_texture_tile *tiles;
    size_t count, room;
    bool failed; /* no memory */
} cutting;

static int shortest_edge(const tl_mesh *mesh, size_t triangle)
{
    int shortest = NO_EDGE;
    for (size_t k = 0; k < 3; k++) {
        const tl_vertex *p = &mesh->vertices[mesh->indices[3 * triangle + k]];
        const tl_vertex *q = &mesh->vertices[mesh->indices[3 * triangle + (k + 1) % 3]];
        int64_t x = (int64_t)p->i - q->i, y = (int64_t)p->j - q->j;
        int64_t length = tl_int64_max(x < 0 ? -x : x, y < 0 ? -y : y);
        int step = 0;
        if (!length)
            continue;
        for (; length > 1; length /= 2)
            step++;
        shortest = step < shortest ? step : shortest;
    }
    return shortest;
}

int out_finest_edge(const tl_mesh *mesh)
{
    int finest = NO_EDGE;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        int edge = shortest_edge(mesh, t);
        finest = edge < finest ? edge : finest;
    }
    return finest;
}

/* The quarter of a tile, or 4: none, that a triangle lies in, its rim included. `half` is the first column and row of
 * the tile's second half. */
static int quarter_of(const tl_mesh *mesh, size_t triangle, const int64_t half[2])
{
    int quarter = 0;
    for (int a = 0; a < 2; a++) {
        int64_t low = INT64_MAX, high = INT64_MIN;
        for (size_t k = 0; k < 3; k++) {
            const tl_vertex *v = &mesh->vertices[mesh->indices[3 * triangle + k]];
            low = tl_int64_min(low, a ? v->j : v->i);
            high = tl_int64_max(high, a ? v->j : v->i);
        }
        if (low < half[a] && high > half[a])
            return 4;
        quarter |= (low >= half[a]) << a;
    }
    return quarter;
}

static void add_tile(cutting *c, size_t first, size_t end, int side)
{
    if (first == end)
        return;
    if (c->count == c->room) {
        size_t room = c->room ? 2 * c->room : 64;
        out_texture_tile *more = realloc(c->tiles, room * sizeof *more);
        if (!more) {
            c->failed = true;
            return;
        }
        c->tiles = more;
        c->room = room;
    }
    int finest = NO_EDGE;
    for (size_t t = first; t < end; t++)
        finest = c->edges[c->order[t]] < finest ? c->edges[c->order[t]] : finest;
    int spacing = side > c->texels_log ? side - c->texels_log : 0;
    spacing = finest < NO_EDGE && finest > spacing ? finest : spacing;
    c->tiles[c->count++] = (out_texture_tile){.first_triangle = first, .triangles = end - first, .spacing = spacing};
}

/* Brings the triangles first ... end - 1 of `order` into the order of their quarters; ends[q] is behind those of q. */
static void sort_quarters(cutting *c, size_t first, size_t end, const int64_t half[2], size_t ends[5])
{
    size_t next = first;
    memcpy(c->spare + first, c->order + first, (end - first) * sizeof *c->order);
    for (int q = 0; q < 5; q++) {
        for (size_t t = first; t < end; t++)
            if (quarter_of(c->mesh, c->spare[t], half) == q)
                c->order[next++] = c->spare[t];
        ends[q] = next;
    }
}

/* A square of 2^side samples. */
static void divide(cutting *c, size_t first, size_t end, int side, const int64_t at[2])
{
    int finest = NO_EDGE;
    for (size_t t = first; t < end; t++)
        finest = c->edges[c->order[t]] < finest ? c->edges[c->order[t]] : finest;
    if (side <= c->texels_log || side - c->texels_log <= finest) {
        add_tile(c, first, end, side);
        return;
    }
    int64_t width = INT64_C(1) << (side - 1), half[2] = {at[0] + width, at[1] + width};
    size_t ends[5];
    sort_quarters(c, first, end, half, ends);
    for (int q = 0; q < 4; q++) {
        const int64_t corner[2] = {at[0] + (q & 1) * width, at[1] + (q >> 1) * width};
        size_t begin = q ? ends[q - 1] : first;
        if (ends[q] > begin)
            divide(c, begin, ends[q], side - 1, corner);
    }
    add_tile(c, ends[3], end, side);
}

static void find_boxes(cutting *c)
{
    for (size_t k = 0; k < c->count; k++) {
        out_texture_tile *tile = &c->tiles[k];
        for (int a = 0; a < 2; a++)
            tile->low[a] = INT64_MAX, tile->high[a] = INT64_MIN;
        for (size_t t = 0; t < 3 * tile->triangles; t++) {
            const tl_vertex *v =
                &c->mesh->vertices[c->mesh->indices[3 * (size_t)c->order[tile->first_triangle + t / 3] + t % 3]];
            for (int a = 0; a < 2; a++) {
                tile->low[a] = tl_int64_min(tile->low[a], a ? v->j : v->i);
                tile->high[a] = tl_int64_max(tile->high[a], a ? v->j : v->i);
            }
        }
    }
}

/* Whether texels twice as far apart would still be two a side. */
static bool has_room(const out_texture_tile *tile)
{
    int64_t side = tl_int64_min(tile->high[0] - tile->low[0], tile->high[1] - tile->low[1]);
    return side >> tile->spacing >= 2;
}

/* Doubles all spacings until there are few enough texels. */
static void keep_budget(cutting *c, uint64_t most)
{
    for (int round = 0; round < DEEPEST; round++) {
        double texels = 0;
        for (size_t k = 0; k < c->count; k++) {
            const out_texture_tile *tile = &c->tiles[k];
            double across = (double)((tile->high[0] - tile->low[0]) >> tile->spacing) + 1;
            texels += across * (double)(((tile->high[1] - tile->low[1]) >> tile->spacing) + 1);
        }
        if (texels <= (double)most)
            return;
        for (size_t k = 0; k < c->count; k++)
            c->tiles[k].spacing += has_room(&c->tiles[k]);
    }
}

/* The mesh's vertices once for each tile; its triangles by these. */
static void copy_tiles(const cutting *c, out_texture_tiles *out, uint32_t *numbers, uint32_t *stamps)
{
    size_t next = 0;
    for (size_t k = 0; k < c->count; k++) {
        out_texture_tile *tile = &c->tiles[k];
        tile->first_vertex = next;
        for (size_t t = 3 * tile->first_triangle; t < 3 * (tile->first_triangle + tile->triangles); t++) {
            uint32_t from = c->mesh->indices[3 * (size_t)c->order[t / 3] + t % 3];
            if (stamps[from] != k + 1) {
                stamps[from] = (uint32_t)k + 1;
                numbers[from] = (uint32_t)next;
                if (out->from) {
                    out->from[next] = from;
                    out->mesh.vertices[next] = c->mesh->vertices[from];
                }
                next++;
            }
            if (out->from)
                out->mesh.indices[t] = numbers[from];
        }
        tile->vertices = next - tile->first_vertex;
    }
    out->mesh.vertex_count = next;
}

static bool make_mesh(const cutting *c, out_texture_tiles *out)
{
    uint32_t *numbers = tl_alloc(c->mesh->vertex_count, sizeof *numbers);
    uint32_t *stamps = calloc(c->mesh->vertex_count, sizeof *stamps);
    out->mesh = *c->mesh;
    out->mesh.vertices = NULL, out->mesh.indices = NULL;
    bool good = numbers && stamps;
    if (good) {
        copy_tiles(c, out, numbers, stamps); /* counts */
        memset(stamps, 0, c->mesh->vertex_count * sizeof *stamps);
        out->mesh.vertices = tl_alloc(out->mesh.vertex_count, sizeof *out->mesh.vertices);
        out->mesh.indices = tl_alloc(c->mesh->triangle_count, 3 * sizeof *out->mesh.indices);
        out->from = tl_alloc(out->mesh.vertex_count, sizeof *out->from);
        good = out->mesh.vertices && out->mesh.indices && out->from && out->mesh.vertex_count < UINT32_MAX;
    }
    if (good)
        copy_tiles(c, out, numbers, stamps);
    free(numbers);
    free(stamps);
    return good;
}

/* The square at the lattice's corner that holds the mesh; its side's logarithm. */
static int root_side(const tl_mesh *mesh)
{
    int64_t high = 1;
    int side = 0;
    for (size_t k = 0; k < mesh->vertex_count; k++)
        high = tl_int64_max(high, tl_int64_max(mesh->vertices[k].i, mesh->vertices[k].j));
    while (INT64_C(1) << side < high)
        side++;
    return side;
}

static void choose_tiles(cutting *c)
{
    const int64_t corner[2] = {0, 0};
    int side = root_side(c->mesh);
    for (c->texels_log = LEAST_TEXELS_LOG; c->texels_log <= MOST_TEXELS_LOG && !c->failed; c->texels_log++) {
        c->count = 0;
        for (size_t t = 0; t < c->mesh->triangle_count; t++)
            c->order[t] = (uint32_t)t;
        divide(c, 0, c->mesh->triangle_count, side, corner);
        if (c->count <= MOST_TILES)
            break;
    }
}

tl_status out_texture_tiles_init(out_texture_tiles *tiles, const tl_mesh *mesh, uint64_t most, const char *path,
                                 tl_error *error)
{
    cutting c = {.mesh = mesh};
    *tiles = (out_texture_tiles){.tiles = NULL};
    c.order = tl_alloc(mesh->triangle_count, sizeof *c.order);
    c.spare = tl_alloc(mesh->triangle_count, sizeof *c.spare);
    c.edges = tl_alloc(mesh->triangle_count, 1);
    c.failed = !c.order || !c.spare || !c.edges;
    for (size_t t = 0; !c.failed && t < mesh->triangle_count; t++)
        c.edges[t] = (unsigned char)shortest_edge(mesh, t);
    if (!c.failed)
        choose_tiles(&c);
    if (!c.failed) {
        find_boxes(&c);
        keep_budget(&c, most);
        c.failed = !make_mesh(&c, tiles);
    }
    tiles->tiles = c.tiles;
    tiles->count = c.count;
    free(c.order);
    free(c.spare);
    free(c.edges);
    if (!c.failed)
        return TL_OK;
    out_texture_tiles_finish(tiles);
    return tl_fail_memory(error, path);
}

void out_texture_tiles_finish(out_texture_tiles *tiles)
{
    free(tiles->tiles);
    free(tiles->from);
    free(tiles->mesh.vertices);
    free(tiles->mesh.indices);
    *tiles = (out_texture_tiles){.tiles = NULL};
}
