/* From marked vertices to triangles. */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/scene/lod.h"

#include <math.h>
#include <string.h>

enum { DRAWN = 1024 };

typedef struct drawing {
    const lod *l;
    const lod_leaf *leaves;
    size_t count;
    const float *heights; /* NULL: the vertices' own */
    uint64_t *counts;     /* of the triangles of each item; then of those before */
    uint32_t *indices;    /* NULL: only counted */
} drawing;

/* Where one item's triangles go. */
typedef struct sink {
    const lod *l;
    const scene_tile *last;
    uint32_t *out;
    uint64_t count;
    lod_list legs[2]; /* uint32_t: vertices along the legs of a triangle beside a void */
    bool failed;
} sink;

static void emit(sink *to, uint32_t a, uint32_t b, uint32_t c)
{
    if (to->out) {
        uint32_t *out = to->out + 3 * to->count;
        out[0] = a, out[1] = b, out[2] = c;
    }
    to->count++;
}

static bool is_void(const sink *to, uint32_t vertex)
{
    return isnan(lod_at(to->l, vertex)->z);
}

/* ---- Beside voids ---- */

static void add_to_leg(sink *to, int leg, uint32_t vertex)
{
    lod_list *list = &to->legs[leg];
    if (lod_list_grow(list, 1, sizeof vertex))
        ((uint32_t *)list->items)[list->count++] = vertex;
    else
        to->failed = true;
}

/* The marked vertices behind a up to b. */
static void walk_leg(sink *to, int leg, uint32_t a, uint32_t b)
{
    const lod_vertex *from = lod_at(to->l, a), *end = lod_at(to->l, b);
    int32_t dx = end->x - from->x, dy = end->y - from->y;
    if (!((dx | dy) & 1)) {
        scene_slot slot = scene_tiles_find(to->l->tiles, from->x + dx / 2, from->y + dy / 2, &to->last);
        if (slot.tile && scene_slot_marked(slot)) {
            uint32_t middle = slot.tile->slots[slot.at].vertex;
            walk_leg(to, leg, a, middle);
            walk_leg(to, leg, middle, b);
            return;
        }
    }
    add_to_leg(to, leg, b);
}

/* A triangle of half a cell, a right angle at `apex`, that is not split, but whose neighbours across the legs may be:
 * strips between the vertices on both legs. */
static void draw_fan(sink *to, uint32_t a, uint32_t b, uint32_t apex)
{
    to->legs[0].count = to->legs[1].count = 0;
    walk_leg(to, 0, apex, a);
    walk_leg(to, 1, apex, b);
    if (to->failed)
        return;
    const uint32_t *one = to->legs[0].items, *two = to->legs[1].items;
    size_t i = 0, j = 0;
    emit(to, apex, one[0], two[0]);
    while (i + 1 < to->legs[0].count || j + 1 < to->legs[1].count) {
        bool first = (i + 1) * to->legs[1].count <= (j + 1) * to->legs[0].count;
        if (j + 1 == to->legs[1].count || (first && i + 1 < to->legs[0].count)) {
            emit(to, one[i], one[i + 1], two[j]);
            i++;
        } else {
            emit(to, one[i], two[j + 1], two[j]);
            j++;
        }
    }
}

/* Half a cell: where one end of its diagonal is void, the cell is drawn with the other diagonal, by the half whose
 * right angle comes first. */
static void draw_half_cell(sink *to, const lod_triangle *t)
{
    bool a = is_void(to, t->a), b = is_void(to, t->b);
    if (is_void(to, t->apex) || (a && b))
        return;
    if (!a && !b) {
        draw_fan(to, t->a, t->b, t->apex);
        return;
    }
    const lod_vertex *one = lod_at(to->l, t->a), *two = lod_at(to->l, t->b), *apex = lod_at(to->l, t->apex);
    int32_t x = one->x + two->x - apex->x, y = one->y + two->y - apex->y;
    if (apex->y > y || (apex->y == y && apex->x > x))
        return;
    scene_slot slot = scene_tiles_find(to->l->tiles, x, y, &to->last);
    if (!slot.tile || !scene_slot_marked(slot))
        return;
    uint32_t opposite = slot.tile->slots[slot.at].vertex;
    if (is_void(to, opposite))
        return;
    if (b)
        draw_fan(to, opposite, t->apex, t->a);
    else
        draw_fan(to, t->apex, opposite, t->b);
}

/* ---- All leaves ---- */

static void draw(sink *to, const lod_triangle *t, int depth)
{
    const lod *l = to->l;
    uint32_t middle = lod_splitter(l, t, depth, &to->last);
    if (middle != LOD_NONE) {
        lod_triangle halves[2] = {{t->apex, t->a, middle, 0, 0}, {t->b, t->apex, middle, 0, 0}};
        draw(to, &halves[0], depth + 1);
        draw(to, &halves[1], depth + 1);
    } else if (l->voids && depth == 2 * (l->lattice_log - l->levels))
        draw_half_cell(to, t);
    else if (!is_void(to, t->a) && !is_void(to, t->b) && !is_void(to, t->apex))
        emit(to, t->a, t->b, t->apex);
}

static tl_status draw_item(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    drawing *self = context;
    sink to = {.l = self->l, .out = self->indices ? self->indices + 3 * self->counts[item] : NULL};
    size_t end = (size_t)(item + 1) * DRAWN < self->count ? (size_t)(item + 1) * DRAWN : self->count;
    for (size_t k = (size_t)item * DRAWN; k < end; k++)
        draw(&to, &self->leaves[k].triangle, self->leaves[k].depth);
    if (!self->indices)
        self->counts[item] = to.count;
    free(to.legs[0].items);
    free(to.legs[1].items);
    return to.failed ? tl_fail_memory(error, "the view's triangles") : TL_OK;
}

static uint64_t items_of(const drawing *self)
{
    return (self->count + DRAWN - 1) / DRAWN;
}

static tl_status count_all(drawing *self, const tl_run *run, uint64_t *count, tl_error *error)
{
    tl_status status = tl_parallel_for(run, items_of(self), 0, draw_item, self, error);
    *count = 0;
    for (uint64_t k = 0; k < items_of(self); k++) {
        uint64_t own = self->counts[k];
        self->counts[k] = *count;
        *count += own;
    }
    return status;
}

/* Numbers the vertices in the order in which triangles have them; the indices become these numbers. */
static size_t number_vertices(const lod *l, uint32_t *indices, uint64_t triangles, uint32_t *numbers)
{
    uint32_t used = 0;
    for (size_t k = 0; k < l->vertices.count; k++)
        numbers[k] = LOD_NONE;
    for (uint64_t k = 0; k < 3 * triangles; k++) {
        uint32_t *number = &numbers[indices[k]];
        if (*number == LOD_NONE)
            *number = used++;
        indices[k] = *number;
    }
    return used;
}

static tl_mesh *assemble(const lod *l, const float *heights, const uint32_t *numbers, size_t used, uint32_t **indices,
                         uint64_t triangles, tl_error *error)
{
    tl_mesh *mesh = tl_mesh_create(used, 0, &l->field->info, error);
    if (!mesh)
        return NULL;
    free(mesh->indices);
    mesh->indices = *indices;
    mesh->triangle_count = (size_t)triangles;
    *indices = NULL;
    int finer = l->field->info.level - l->levels;
    for (size_t k = 0; k < l->vertices.count; k++) {
        const lod_vertex *v = lod_at(l, (uint32_t)k);
        if (numbers[k] != LOD_NONE)
            mesh->vertices[numbers[k]] =
                (tl_vertex){v->x * (INT32_C(1) << finer), v->y * (INT32_C(1) << finer), heights ? heights[k] : v->z};
    }
    return mesh;
}

static tl_status too_many(const lod *l, uint64_t triangles, tl_error *error)
{
    return tl_fail(error, TL_ERROR_MEMORY,
                   "%s: the view's %llu triangles are more than memory holds; allow a larger pixel error",
                   l->dem->info.name, (unsigned long long)triangles);
}

static tl_status draw_all(drawing *self, const tl_run *run, tl_mesh **out, tl_error *error)
{
    uint64_t triangles;
    const lod *l = self->l;
    tl_status status = count_all(self, run, &triangles, error);
    if (status != TL_OK)
        return status;
    uint32_t *indices = triangles < UINT32_MAX ? tl_alloc((size_t)triangles, 3 * sizeof *indices) : NULL;
    uint32_t *numbers = tl_alloc(l->vertices.count, sizeof *numbers);
    self->indices = indices;
    status = indices && numbers ? tl_parallel_for(run, items_of(self), 0, draw_item, self, error)
                                : too_many(l, triangles, error);
    if (status == TL_OK) {
        size_t used = number_vertices(l, indices, triangles, numbers);
        *out = assemble(l, self->heights, numbers, used, &indices, triangles, error);
        status = *out ? TL_OK : TL_ERROR_MEMORY;
    }
    free(indices);
    free(numbers);
    return status;
}

static tl_status draw_or_count(const lod *l, const lod_leaf *leaves, size_t count, const float *heights, tl_mesh **out,
                               uint64_t *triangles, tl_error *error)
{
    drawing self = {.l = l, .leaves = leaves, .count = count, .heights = heights};
    tl_run quiet = l->run ? *l->run : (tl_run){0};
    quiet.progress = NULL;
    self.counts = tl_alloc((size_t)items_of(&self), sizeof *self.counts);
    tl_status status = self.counts ? TL_OK : tl_fail_memory(error, "the view's triangles");
    if (status == TL_OK)
        status = out ? draw_all(&self, &quiet, out, error) : count_all(&self, &quiet, triangles, error);
    free(self.counts);
    return status;
}

tl_status lod_draw(lod *l, const lod_leaf *leaves, size_t count, const float *heights, tl_mesh **out, tl_error *error)
{
    return draw_or_count(l, leaves, count, heights, out, NULL, error);
}

tl_status lod_count(lod *l, const lod_leaf *leaves, size_t count, uint64_t *triangles, tl_error *error)
{
    return draw_or_count(l, leaves, count, NULL, NULL, triangles, error);
}
