/* The vertices of a mesh: marks in tiles. */
#include "dem/framework.h"
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/scene/lod.h"

#include <math.h>

bool lod_list_grow(lod_list *list, size_t more, size_t size)
{
    size_t need, bytes;
    if (__builtin_add_overflow(list->count, more, &need))
        return false;
    if (need <= list->room)
        return true;
    size_t half = list->room + list->room / 2, room = need > half ? need + 256 : half;
    void *bigger = tl_size_mul(room, size, &bytes) ? realloc(list->items, bytes) : NULL;
    if (!bigger)
        return false;
    list->items = bigger;
    list->room = room;
    return true;
}

tl_status lod_fits(const lod *l, size_t others, tl_error *error)
{
    size_t bytes = scene_tiles_bytes(l->tiles) + l->vertices.room * sizeof(lod_vertex) +
                   l->asked.room * sizeof(lod_request) + others;
    return tl_run_fits(l->run, (double)bytes, l->dem->info.name, "its view, which a larger pixel error makes smaller,",
                       error);
}

int lod_depth_of(const lod *l, int32_t x, int32_t y)
{
    int stage = __builtin_ctz((uint32_t)(x | y));
    bool centre = x >> stage & y >> stage & 1;
    return 2 * (l->lattice_log - 1 - stage) + !centre;
}

static bool is_corner(const lod *l, int32_t x, int32_t y)
{
    return ((x | y) & ((INT32_C(1) << l->lattice_log) - 1)) == 0;
}

tl_status lod_ask(lod *l, int32_t x, int32_t y, tl_error *error)
{
    if (!lod_list_grow(&l->asked, 1, sizeof(lod_request)))
        return tl_fail_memory(error, "the view's vertices");
    lod_request *to = (lod_request *)l->asked.items + l->asked.count++;
    *to = (lod_request){.x = x, .y = y, .vertex = LOD_NONE};
    return scene_tiles_want(l->tiles, x, y, &to->slot, error);
}

void lod_place_some(const lod *l, const uint32_t *vertices, size_t count)
{
    double i[LOD_PLACED] = {0}, j[LOD_PLACED] = {0}, xyz[LOD_PLACED][3];
    float z[LOD_PLACED] = {0};
    for (size_t k = 0; k < count; k++) {
        const lod_vertex *v = lod_at(l, vertices[k]);
        i[k] = (double)(v->x < l->right ? v->x : l->right) / l->cell;
        j[k] = (double)(v->y < l->bottom ? v->y : l->bottom) / l->cell;
        z[k] = isnan(v->z) ? l->filling : v->z;
    }
    scene_view_place(l->view, count, i, j, z, xyz);
    for (size_t k = 0; k < count; k++)
        for (int a = 0; a < 3; a++)
            lod_at(l, vertices[k])->at[a] = (float)(xyz[k][a] - l->camera->eye[a]);
}

typedef struct placing {
    const lod *l;
    size_t first;
} placing;

static tl_status place_item(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    (void)error;
    const placing *self = context;
    size_t first = self->first + item * LOD_PLACED, count = 0;
    uint32_t vertices[LOD_PLACED];
    for (; count < LOD_PLACED && first + count < self->l->vertices.count; count++)
        vertices[count] = (uint32_t)(first + count);
    lod_place_some(self->l, vertices, count);
    return TL_OK;
}

tl_status lod_place(const lod *l, size_t first, tl_error *error)
{
    placing self = {l, first};
    size_t count = l->vertices.count - first;
    tl_run quiet = l->run ? *l->run : (tl_run){0};
    quiet.progress = NULL;
    if (count <= 4 * LOD_PLACED)
        quiet.threads = 1;
    return tl_parallel_for(&quiet, (count + LOD_PLACED - 1) / LOD_PLACED, 0, place_item, &self, error);
}

/* Makes a vertex of what was asked for, where it can be one. */
static tl_status mark(lod *l, lod_request *r, tl_error *error)
{
    if (scene_slot_marked(r->slot)) {
        r->vertex = r->slot.tile->slots[r->slot.at].vertex;
        return TL_OK;
    }
    float z = r->slot.tile->slots[r->slot.at].z;
    bool corner = is_corner(l, r->x, r->y);
    int depth = corner ? 0 : lod_depth_of(l, r->x, r->y);
    bool below = !corner && l->levels - (l->lattice_log - 1 - depth / 2) > 0;
    if (isnan(z) && below)
        return TL_OK;
    lod_list *list = &l->by_depth[depth];
    if (l->vertices.count >= LOD_NONE - 1 || !lod_list_grow(&l->vertices, 1, sizeof(lod_vertex)) ||
        !lod_list_grow(list, 1, sizeof(uint32_t)))
        return tl_fail_memory(error, "the view's vertices");
    r->vertex = (uint32_t)l->vertices.count++;
    *lod_at(l, r->vertex) = (lod_vertex){.x = r->x, .y = r->y, .z = z};
    if (!corner)
        ((uint32_t *)list->items)[list->count++] = r->vertex;
    scene_slot_mark(r->slot, r->vertex);
    return TL_OK;
}

tl_status lod_mark_asked(lod *l, tl_error *error)
{
    size_t first = l->vertices.count;
    tl_status status = scene_tiles_make(l->tiles, l->run, error);
    for (size_t k = 0; k < l->asked.count && status == TL_OK; k++)
        status = mark(l, (lod_request *)l->asked.items + k, error);
    return status == TL_OK ? lod_place(l, first, error) : status;
}

/* Asks for the parents of a vertex, unless they are marked or split nothing. */
static tl_status ask_parents(lod *l, uint32_t vertex, const scene_tile **last, tl_error *error)
{
    int64_t up[2][2];
    tl_lattice_parents(lod_at(l, vertex)->x, lod_at(l, vertex)->y, up);
    tl_status status = TL_OK;
    for (int k = 0; k < 2 && status == TL_OK; k++) {
        if (up[k][0] < 0 || up[k][1] < 0 || up[k][0] > l->right || up[k][1] > l->bottom)
            continue;
        scene_slot slot = scene_tiles_find(l->tiles, (int32_t)up[k][0], (int32_t)up[k][1], last);
        if (!slot.tile || !scene_slot_marked(slot))
            status = lod_ask(l, (int32_t)up[k][0], (int32_t)up[k][1], error);
    }
    return status;
}

tl_status lod_close(lod *l, tl_error *error)
{
    tl_status status = TL_OK;
    for (int depth = 2 * l->lattice_log - 1; depth > 0 && status == TL_OK; depth--) {
        const scene_tile *last = NULL;
        const lod_list *list = &l->by_depth[depth];
        l->asked.count = 0;
        for (size_t k = 0; k < list->count && status == TL_OK; k++)
            status = ask_parents(l, ((const uint32_t *)list->items)[k], &last, error);
        if (status == TL_OK)
            status = lod_mark_asked(l, error);
    }
    return status;
}

void lod_clear(lod *l)
{
    const scene_tile *last = NULL;
    for (size_t k = 0; k < l->vertices.count; k++) {
        const lod_vertex *v = lod_at(l, (uint32_t)k);
        scene_slot slot = scene_tiles_find(l->tiles, v->x, v->y, &last);
        scene_slot_unmark(slot, v->z);
    }
    l->vertices.count = 0;
    for (int depth = 0; depth < LOD_DEPTHS; depth++)
        l->by_depth[depth].count = 0;
}

uint32_t lod_splitter(const lod *l, const lod_triangle *t, int depth, const scene_tile **last)
{
    int32_t x, y;
    if (depth >= 2 * l->lattice_log)
        return LOD_NONE;
    lod_middle(l, t, &x, &y);
    scene_slot slot = scene_tiles_find(l->tiles, x, y, last);
    return slot.tile && scene_slot_marked(slot) ? slot.tile->slots[slot.at].vertex : LOD_NONE;
}

void lod_roots(const lod *l, lod_triangle out[2])
{
    const uint32_t *c = l->corners;
    out[0] = (lod_triangle){c[0], c[3], c[1], LOD_NONE, 0};
    out[1] = (lod_triangle){c[3], c[0], c[2], LOD_NONE, 0};
}
