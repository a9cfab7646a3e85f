/* Triangles that are kept from view to view: a binary tree of them, of which a split queue makes more and a merge queue
 * fewer, until no leaf wants to be split and nothing that is split wants not to be.
 *
 * A vertex is marked while something holds it: the triangles (two at most) that want to be split there, and the marked
 * vertices of which it is a parent. So what a split forces goes when the last one that forced it goes, and the marks
 * are those that a search from nothing finds, whatever came before.
 *
 * A verdict is good for a while: see lod_verdict.margin. Only those that the eye's movement has used up are made again,
 * and only their corners are placed anew. */
#include "dem/framework.h"
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/scene/lod.h"

#include <math.h>
#include <stdatomic.h>
#include <string.h>

enum { TESTED = 512, REFERENCES = 3, RIDGE_RULE = 3 /* log2 of TL_CULL_RIDGE */ };

/* Verdicts do not hold closer to their change than this share of the distance: places are interpolated, from view to
 * view a little differently, to far less than a pixel. */
static const double UNSURE = 5e-4;
/* Places of the same samples in two views are as far apart to this share, or the views are bent differently. */
static const double RIGID = 1e-5;

typedef struct node {
    lod_triangle triangle;
    uint32_t children; /* the first of two; LOD_NONE: a leaf */
    uint32_t held;     /* a vertex that its drawing needs, or LOD_NONE */
    float priority, pixels, margin, beside[2], far;
    float moved, turned[2]; /* the eye's way and the planes', when its verdict was made */
    unsigned char state;    /* lod_state; whether it is split is told by `children` */
    unsigned char rule;     /* index of what hides it */
    signed char depth;
    bool live, stuck; /* stuck: its middle is in a void */
} node;

struct tl_roam {
    lod l;
    tl_lod_options options;
    tl_run run;
    lod_list nodes;                     /* node: two roots, then pairs */
    lod_list free_nodes, free_vertices; /* uint32_t */
    lod_list holds, places;             /* unsigned char, by vertex: who hold it; whether to be placed */
    lod_list fresh, busy;               /* uint32_t: vertices whose parents are not held yet */
    lod_list stale, queue, next;        /* uint32_t: nodes */
    lod_list leaves;                    /* lod_leaf */
    bool seen_any, failed;
    atomic_bool enters;      /* some of the tested nodes have no block yet, and may be seen */
    double moved, turned[2]; /* the eye's way, in metres; of normals' ends: see lod_verdict */
    double planes[5][3];     /* of the last view */
    tl_view view;            /* the last one */
    scene_camera camera;
    double references[REFERENCES][3];
    uint64_t split, merged;
};

static node *node_at(const tl_roam *r, uint32_t index)
{
    return (node *)r->nodes.items + index;
}

static uint32_t *numbers(const lod_list *list)
{
    return list->items;
}

static tl_status no_memory(tl_error *error)
{
    return tl_fail_memory(error, "the view's triangles");
}

static tl_status push(lod_list *list, uint32_t number, tl_error *error)
{
    if (!lod_list_grow(list, 1, sizeof number))
        return no_memory(error);
    numbers(list)[list->count++] = number;
    return TL_OK;
}

/* ---- Vertices and who hold them ---- */

static tl_status new_vertex(tl_roam *r, int32_t x, int32_t y, float z, uint32_t *out, tl_error *error)
{
    lod *l = &r->l;
    if (r->free_vertices.count)
        *out = numbers(&r->free_vertices)[--r->free_vertices.count];
    else {
        if (l->vertices.count >= LOD_NONE - 1 || !lod_list_grow(&l->vertices, 1, sizeof(lod_vertex)) ||
            !lod_list_grow(&r->holds, 1, 1) || !lod_list_grow(&r->places, 1, 1))
            return no_memory(error);
        *out = (uint32_t)l->vertices.count++;
        r->holds.count = r->places.count = l->vertices.count;
    }
    *lod_at(l, *out) = (lod_vertex){.x = x, .y = y, .z = z};
    ((unsigned char *)r->holds.items)[*out] = 0;
    ((unsigned char *)r->places.items)[*out] = 0;
    return push(&r->fresh, *out, error);
}

/* Holds a vertex whose tile is made; LOD_NONE where it cannot be one. */
static tl_status hold(tl_roam *r, int32_t x, int32_t y, uint32_t *out, tl_error *error)
{
    const scene_tile *last = NULL;
    lod *l = &r->l;
    scene_slot slot = scene_tiles_find(l->tiles, x, y, &last);
    *out = LOD_NONE;
    if (!scene_slot_marked(slot)) {
        float z = slot.tile->slots[slot.at].z;
        if (isnan(z) && ((x | y) & (l->cell - 1)))
            return TL_OK;
        tl_status status = new_vertex(r, x, y, z, out, error);
        if (status != TL_OK)
            return status;
        scene_slot_mark(slot, *out);
    }
    *out = slot.tile->slots[slot.at].vertex;
    ((unsigned char *)r->holds.items)[*out]++;
    return TL_OK;
}

/* The parents of a vertex that are on the raster; their number. */
static int parents_of(const tl_roam *r, uint32_t vertex, int32_t out[2][2])
{
    const lod_vertex *v = lod_at(&r->l, vertex);
    int64_t up[2][2];
    int count = 0;
    tl_lattice_parents(v->x, v->y, up);
    for (int k = 0; k < 2; k++)
        if (up[k][0] >= 0 && up[k][1] >= 0 && up[k][0] <= r->l.right && up[k][1] <= r->l.bottom) {
            out[count][0] = (int32_t)up[k][0];
            out[count++][1] = (int32_t)up[k][1];
        }
    return count;
}

/* Lets go of a vertex; of its parents, where it was the last who held it. */
static tl_status release(tl_roam *r, uint32_t vertex, tl_error *error)
{
    const scene_tile *last = NULL;
    int32_t up[2][2];
    if (--((unsigned char *)r->holds.items)[vertex])
        return TL_OK;
    const lod_vertex *v = lod_at(&r->l, vertex);
    scene_slot_unmark(scene_tiles_find(r->l.tiles, v->x, v->y, &last), v->z);
    tl_status status = push(&r->free_vertices, vertex, error);
    int count = parents_of(r, vertex, up);
    for (int k = 0; k < count && status == TL_OK; k++) {
        scene_slot slot = scene_tiles_find(r->l.tiles, up[k][0], up[k][1], &last);
        if (slot.tile && scene_slot_marked(slot))
            status = release(r, slot.tile->slots[slot.at].vertex, error);
    }
    return status;
}

static tl_status want(tl_roam *r, int32_t x, int32_t y, tl_error *error)
{
    scene_slot slot;
    return scene_tiles_want(r->l.tiles, x, y, &slot, error);
}

static tl_status hold_parents(tl_roam *r, tl_error *error)
{
    int32_t up[2][2];
    uint32_t held;
    tl_status status = TL_OK;
    for (size_t k = 0; k < r->busy.count && status == TL_OK; k++)
        for (int count = parents_of(r, numbers(&r->busy)[k], up); count > 0 && status == TL_OK; count--)
            status = want(r, up[count - 1][0], up[count - 1][1], error);
    if (status == TL_OK)
        status = scene_tiles_make(r->l.tiles, r->l.run, error);
    for (size_t k = 0; k < r->busy.count && status == TL_OK; k++)
        for (int count = parents_of(r, numbers(&r->busy)[k], up); count > 0 && status == TL_OK; count--)
            status = hold(r, up[count - 1][0], up[count - 1][1], &held, error);
    return status;
}

/* Holds the parents of all fresh vertices, and theirs. */
static tl_status settle(tl_roam *r, tl_error *error)
{
    tl_status status = TL_OK;
    while (r->fresh.count && status == TL_OK) {
        lod_list done = r->busy;
        r->busy = r->fresh;
        r->fresh = done;
        r->fresh.count = 0;
        status = hold_parents(r, error);
    }
    return status;
}

/* ---- Nodes ---- */

static tl_status new_pair(tl_roam *r, uint32_t *out, tl_error *error)
{
    if (r->free_nodes.count) {
        *out = numbers(&r->free_nodes)[--r->free_nodes.count];
        return TL_OK;
    }
    if (r->nodes.count >= LOD_NONE - 2 || !lod_list_grow(&r->nodes, 2, sizeof(node)))
        return no_memory(error);
    *out = (uint32_t)r->nodes.count;
    r->nodes.count += 2;
    return TL_OK;
}

static void begin_node(tl_roam *r, uint32_t index, lod_triangle triangle, int depth)
{
    *node_at(r, index) = (node){.triangle = triangle,
                                .children = LOD_NONE,
                                .held = LOD_NONE,
                                .priority = -1,
                                .margin = -1,
                                .depth = (signed char)depth,
                                .live = true};
}

/* The merge of all that a node is split into. */
static tl_status collapse(tl_roam *r, uint32_t index, tl_error *error)
{
    node *n = node_at(r, index);
    tl_status status = TL_OK;
    if (n->held != LOD_NONE) {
        status = release(r, n->held, error);
        n->held = LOD_NONE;
    }
    uint32_t children = n->children;
    if (children == LOD_NONE || status != TL_OK)
        return status;
    for (uint32_t k = 0; k < 2 && status == TL_OK; k++) {
        status = collapse(r, children + k, error);
        node_at(r, children + k)->live = false;
    }
    uint32_t middle = node_at(r, children)->triangle.apex;
    n->children = LOD_NONE;
    r->merged++;
    if (status == TL_OK)
        status = push(&r->free_nodes, children, error);
    return status == TL_OK ? release(r, middle, error) : status;
}

/* Whether a node is to be split by its last verdict. */
static bool wants(const tl_roam *r, const node *n)
{
    return n->state >= LOD_LEAF && !n->stuck && (double)n->priority > r->l.pixel_error;
}

/* ---- Verdicts ---- */

typedef struct testing {
    tl_roam *r;
    const lod_list *list;
} testing;

static void judge(tl_roam *r, node *n)
{
    lod_verdict v = lod_test(&r->l, &n->triangle, n->depth, r->l.rules);
    n->state = v.state;
    n->rule = v.rule ? (unsigned char)__builtin_ctz(v.rule) : 0;
    n->priority = v.priority;
    n->pixels = v.pixels;
    n->margin = v.margin;
    n->beside[0] = v.beside[0], n->beside[1] = v.beside[1];
    n->far = v.far;
    n->moved = (float)r->moved;
    n->turned[0] = (float)r->turned[0], n->turned[1] = (float)r->turned[1];
    /* nothing is known of it yet but that it may be seen */
    if (n->depth == lod_block_depth(&r->l) && n->triangle.block == LOD_NONE) {
        n->margin = -1;
        atomic_store(&r->enters, true);
    }
}

static tl_status test_item(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    (void)error;
    const testing *self = context;
    size_t end = (size_t)(item + 1) * TESTED < self->list->count ? (size_t)(item + 1) * TESTED : self->list->count;
    for (size_t k = (size_t)item * TESTED; k < end; k++)
        judge(self->r, node_at(self->r, numbers(self->list)[k]));
    return TL_OK;
}

static tl_run quiet_run(const tl_roam *r, size_t count)
{
    tl_run run = r->run;
    run.progress = NULL;
    if (count <= 4 * TESTED)
        run.threads = 1;
    return run;
}

static tl_status test_list(tl_roam *r, const lod_list *list, tl_error *error)
{
    testing self = {r, list};
    tl_run run = quiet_run(r, list->count);
    r->l.stats.visited += list->count;
    return tl_parallel_for(&run, (list->count + TESTED - 1) / TESTED, 0, test_item, &self, error);
}

/* Those that are seen where blocks begin get theirs, and are tested with what it tells. */
static tl_status enter_blocks(tl_roam *r, const lod_list *list, tl_error *error)
{
    int depth = lod_block_depth(&r->l);
    tl_status status = TL_OK;
    r->busy.count = 0;
    for (size_t k = 0; k < list->count && status == TL_OK && r->enters; k++) {
        node *n = node_at(r, numbers(list)[k]);
        if (n->depth == depth && n->triangle.block == LOD_NONE && n->state >= LOD_LEAF) {
            status = lod_want_block(&r->l, &n->triangle, error);
            if (status == TL_OK && n->triangle.block != LOD_NONE)
                status = push(&r->busy, numbers(list)[k], error);
        }
    }
    if (status == TL_OK)
        status = scene_tiles_make(r->l.tiles, r->l.run, error);
    for (size_t k = 0; k < r->busy.count && status == TL_OK; k++)
        judge(r, node_at(r, numbers(&r->busy)[k]));
    return status;
}

static tl_status test_nodes(tl_roam *r, const lod_list *list, tl_error *error)
{
    atomic_store(&r->enters, false);
    tl_status status = test_list(r, list, error);
    return status == TL_OK ? enter_blocks(r, list, error) : status;
}

/* Whether the eye's movement has used a verdict up. */
static bool is_stale(const tl_roam *r, const node *n)
{
    bool behind = n->state == LOD_HIDDEN && n->rule == RIDGE_RULE;
    if (lod_at_ridge(&r->l, n->depth) && n->state != LOD_DROPPED && (behind || n->state != LOD_HIDDEN) &&
        lod_behind_ridge(&r->l, &n->triangle, n->depth) != behind)
        return true;
    if (behind)
        return false;
    double far = (double)n->far, moved = r->moved - (double)n->moved + UNSURE * far + 1e-6 * r->moved;
    if (moved >= (double)n->margin)
        return true;
    for (int k = 0; k < 2; k++) {
        double turned = r->turned[k] - (double)n->turned[k] + 1e-6 * r->turned[k];
        if (moved + turned * (far + moved) >= (double)n->beside[k])
            return true;
    }
    return false;
}

static tl_status list_stale(tl_roam *r, bool all, tl_error *error)
{
    r->stale.count = 0;
    tl_status status = TL_OK;
    unsigned char *places = r->places.items;
    for (size_t k = 0; k < r->nodes.count && status == TL_OK; k++) {
        const node *n = node_at(r, (uint32_t)k);
        if (!n->live || (!all && !is_stale(r, n)))
            continue;
        places[n->triangle.a] = places[n->triangle.b] = places[n->triangle.apex] = 1;
        status = push(&r->stale, (uint32_t)k, error);
    }
    return status;
}

static tl_status place_item(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    (void)error;
    const tl_roam *r = context;
    unsigned char *places = r->places.items;
    size_t end = (size_t)(item + 1) * TESTED < r->places.count ? (size_t)(item + 1) * TESTED : r->places.count;
    uint32_t wanted[LOD_PLACED];
    size_t count = 0;
    for (size_t k = (size_t)item * TESTED; k < end; k++) {
        if (places[k])
            wanted[count++] = (uint32_t)k;
        places[k] = 0;
        if (count == LOD_PLACED) {
            lod_place_some(&r->l, wanted, count);
            count = 0;
        }
    }
    lod_place_some(&r->l, wanted, count);
    return TL_OK;
}

static tl_status place_wanted(tl_roam *r, tl_error *error)
{
    tl_run run = quiet_run(r, r->places.count);
    return tl_parallel_for(&run, (r->places.count + TESTED - 1) / TESTED, 0, place_item, r, error);
}

/* ---- Queues ---- */

/* A leaf beside a void may be drawn with the corner across its diagonal: see lod_opposite. */
static tl_status hold_opposite(tl_roam *r, uint32_t index, tl_error *error)
{
    node *n = node_at(r, index);
    int32_t x, y;
    if (n->depth != 2 * (r->l.lattice_log - r->l.levels) || n->state < LOD_LEAF || n->children != LOD_NONE ||
        n->held != LOD_NONE || !lod_opposite(&r->l, &n->triangle, &x, &y))
        return TL_OK;
    tl_status status = want(r, x, y, error);
    if (status == TL_OK)
        status = scene_tiles_make(r->l.tiles, r->l.run, error);
    return status == TL_OK ? hold(r, x, y, &n->held, error) : status;
}

/* The merge queue: of the nodes of a list, those that are split and do not want to be. */
static tl_status merge_all(tl_roam *r, const lod_list *list, tl_error *error)
{
    tl_status status = TL_OK;
    for (size_t k = 0; k < list->count && status == TL_OK; k++) {
        const node *n = node_at(r, numbers(list)[k]);
        if (n->live && (n->children != LOD_NONE || n->held != LOD_NONE) && !wants(r, n))
            status = collapse(r, numbers(list)[k], error);
    }
    return status;
}

static tl_status split_node(tl_roam *r, uint32_t index, tl_error *error)
{
    int32_t x, y;
    uint32_t middle = LOD_NONE, pair = LOD_NONE;
    lod_triangle t = node_at(r, index)->triangle;
    lod_middle(&r->l, &t, &x, &y);
    tl_status status = hold(r, x, y, &middle, error);
    if (status != TL_OK)
        return status;
    if (middle == LOD_NONE) {
        node_at(r, index)->stuck = true;
        return hold_opposite(r, index, error);
    }
    status = new_pair(r, &pair, error);
    if (status != TL_OK)
        return status;
    int depth = node_at(r, index)->depth + 1;
    begin_node(r, pair, (lod_triangle){t.apex, t.a, middle, t.block, 0}, depth);
    begin_node(r, pair + 1, (lod_triangle){t.b, t.apex, middle, t.block, 0}, depth);
    node_at(r, index)->children = pair;
    ((unsigned char *)r->places.items)[middle] = 1;
    r->split++;
    status = push(&r->next, pair, error);
    return status == TL_OK ? push(&r->next, pair + 1, error) : status;
}

static tl_status place_busy_item(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    (void)error;
    const tl_roam *r = context;
    size_t first = (size_t)item * LOD_PLACED, left = r->busy.count - first;
    lod_place_some(&r->l, numbers(&r->busy) + first, left < LOD_PLACED ? left : LOD_PLACED);
    return TL_OK;
}

/* Places the middles that the queue was split at, each once: some are held since another view. */
static tl_status place_middles(tl_roam *r, tl_error *error)
{
    unsigned char *places = r->places.items;
    tl_status status = TL_OK;
    r->busy.count = 0;
    for (size_t k = 0; k < r->next.count && status == TL_OK; k += 2) {
        uint32_t middle = node_at(r, numbers(&r->next)[k])->triangle.apex;
        if (places[middle])
            status = push(&r->busy, middle, error);
        places[middle] = 0;
    }
    tl_run run = quiet_run(r, r->busy.count);
    return status == TL_OK
               ? tl_parallel_for(&run, (r->busy.count + LOD_PLACED - 1) / LOD_PLACED, 0, place_busy_item, r, error)
               : status;
}

/* Splits the nodes of the queue, in one go, and tests what comes of it. */
static tl_status split_batch(tl_roam *r, tl_error *error)
{
    tl_status status = tl_run_check(r->l.run, error);
    if (status == TL_OK)
        status = lod_fits(&r->l, r->nodes.room * sizeof(node) + r->leaves.room * sizeof(lod_leaf), error);
    for (size_t k = 0; k < r->queue.count && status == TL_OK; k++) {
        int32_t x, y;
        lod_middle(&r->l, &node_at(r, numbers(&r->queue)[k])->triangle, &x, &y);
        status = want(r, x, y, error);
    }
    if (status == TL_OK)
        status = scene_tiles_make(r->l.tiles, r->l.run, error);
    r->next.count = 0;
    for (size_t k = 0; k < r->queue.count && status == TL_OK; k++)
        status = split_node(r, numbers(&r->queue)[k], error);
    if (status == TL_OK)
        status = place_middles(r, error);
    return status == TL_OK ? test_nodes(r, &r->next, error) : status;
}

/* Queues the leaves of a list that want to be split. */
static tl_status queue_leaves(tl_roam *r, const lod_list *list, tl_error *error)
{
    tl_status status = TL_OK;
    r->queue.count = 0;
    for (size_t k = 0; k < list->count && status == TL_OK; k++) {
        uint32_t index = numbers(list)[k];
        const node *n = node_at(r, index);
        if (!n->live || n->children != LOD_NONE)
            continue;
        status = wants(r, n) ? push(&r->queue, index, error) : hold_opposite(r, index, error);
    }
    return status;
}

/* The split queue, until it is empty. */
static tl_status split_all(tl_roam *r, const lod_list *list, tl_error *error)
{
    tl_status status = queue_leaves(r, list, error);
    while (r->queue.count && status == TL_OK) {
        status = split_batch(r, error);
        if (status == TL_OK)
            status = queue_leaves(r, &r->next, error);
    }
    return status == TL_OK ? settle(r, error) : status;
}

/* ---- Movement ---- */

static void sub(const double a[3], const double b[3], double out[3])
{
    for (int k = 0; k < 3; k++)
        out[k] = a[k] - b[k];
}

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void cross(const double a[3], const double b[3], double out[3])
{
    for (int k = 0; k < 3; k++)
        out[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
}

static bool unit(double v[3])
{
    double length = sqrt(dot(v, v));
    for (int k = 0; k < 3; k++)
        v[k] /= length;
    return length > 0 && isfinite(length);
}

/* Right-handed axes that go with three points. */
static bool axes_of(const double p[REFERENCES][3], double out[3][3])
{
    double side[3];
    sub(p[1], p[0], out[0]);
    sub(p[2], p[0], side);
    if (!unit(out[0]))
        return false;
    cross(out[0], side, out[2]);
    if (!unit(out[2]))
        return false;
    cross(out[2], out[0], out[1]);
    return true;
}

/* v from the last view's frame to this one's. */
static void turn(const double from[3][3], const double to[3][3], const double v[3], double out[3])
{
    out[0] = out[1] = out[2] = 0;
    for (int k = 0; k < 3; k++)
        for (int a = 0; a < 3; a++)
            out[a] += dot(from[k], v) * to[k][a];
}

static bool is_rigid(const double a[REFERENCES][3], const double b[REFERENCES][3])
{
    for (int k = 0; k < REFERENCES; k++) {
        double one[3], two[3];
        sub(a[(k + 1) % REFERENCES], a[k], one);
        sub(b[(k + 1) % REFERENCES], b[k], two);
        double before = sqrt(dot(one, one)), after = sqrt(dot(two, two));
        if (!(fabs(before - after) <= RIGID * before))
            return false;
    }
    return true;
}

/* How far the eye went from the last view to this, and the planes' normals; false: no telling. */
static bool compare_views(const tl_roam *r, const double now[REFERENCES][3], double *moved, double turned[2])
{
    const scene_camera *before = &r->camera, *after = r->l.camera;
    double from[3][3], to[3][3], relative[3], eye[3], step[3];
    if (before->focal != after->focal || before->width != after->width || before->height != after->height ||
        !is_rigid(r->references, now) || !axes_of(r->references, from) || !axes_of(now, to))
        return false;
    sub(before->eye, r->references[0], relative);
    turn(from, to, relative, eye);
    for (int k = 0; k < 3; k++)
        step[k] = now[0][k] + eye[k] - after->eye[k];
    *moved = sqrt(dot(step, step));
    turned[0] = turned[1] = 0;
    for (int k = 0; k < 5; k++) {
        double there[3];
        turn(from, to, r->planes[k], there);
        sub(there, r->l.planes[k], there);
        turned[k > 2] = fmax(turned[k > 2], sqrt(dot(there, there)) + 1e-7);
    }
    return true;
}

static void place_references(const tl_roam *r, const scene_view *view, double out[REFERENCES][3])
{
    double right = (double)(r->l.dem->info.width - 1), bottom = (double)(r->l.dem->info.height - 1);
    const double i[REFERENCES] = {0, right, 0}, j[REFERENCES] = {0, 0, bottom};
    const float z[REFERENCES] = {r->l.filling, r->l.filling, r->l.filling};
    scene_view_place(view, REFERENCES, i, j, z, out);
}

/* Whether all verdicts are to be made again. */
static bool move(tl_roam *r)
{
    double now[REFERENCES][3], moved = 0, turned[2] = {0, 0};
    place_references(r, r->l.view, now);
    bool known = r->seen_any && !r->options.budget && compare_views(r, now, &moved, turned);
    r->moved = known ? r->moved + moved : 0;
    for (int k = 0; k < 2; k++)
        r->turned[k] = known ? r->turned[k] + turned[k] : 0;
    memcpy(r->planes, r->l.planes, sizeof r->planes);
    r->camera = *r->l.camera;
    memcpy(r->references, now, sizeof now);
    return !known;
}

/* ---- The whole ---- */

static tl_status begin(tl_roam *r, tl_error *error)
{
    lod_triangle roots[2];
    lod *l = &r->l;
    tl_status status = lod_mark_corners(l, error);
    size_t count = l->vertices.count;
    if (status == TL_OK && (!lod_list_grow(&r->holds, count, 1) || !lod_list_grow(&r->places, count, 1) ||
                            !lod_list_grow(&r->nodes, 2, sizeof(node))))
        return no_memory(error);
    if (status != TL_OK)
        return status;
    r->holds.count = r->places.count = count;
    memset(r->holds.items, 1, count);
    memset(r->places.items, 0, count);
    lod_roots(l, roots);
    r->nodes.count = 2;
    begin_node(r, 0, roots[0], 0);
    begin_node(r, 1, roots[1], 0);
    return TL_OK;
}

static tl_status list_all(tl_roam *r, tl_error *error)
{
    tl_status status = TL_OK;
    r->stale.count = 0;
    for (size_t k = 0; k < r->nodes.count && status == TL_OK; k++)
        if (node_at(r, (uint32_t)k)->live)
            status = push(&r->stale, (uint32_t)k, error);
    return status;
}

/* The leaves as they are drawn, in the order of the tree. */
static tl_status gather(tl_roam *r, uint32_t index, tl_error *error)
{
    const node *n = node_at(r, index);
    tl_status status = TL_OK;
    if (n->children != LOD_NONE) {
        status = gather(r, n->children, error);
        return status == TL_OK ? gather(r, node_at(r, index)->children + 1, error) : status;
    }
    if (n->state < LOD_LEAF)
        return TL_OK;
    if (!lod_list_grow(&r->leaves, 1, sizeof(lod_leaf)))
        return no_memory(error);
    ((lod_leaf *)r->leaves.items)[r->leaves.count++] = (lod_leaf){n->triangle, n->depth};
    return TL_OK;
}

static tl_status gather_all(tl_roam *r, tl_error *error)
{
    r->leaves.count = 0;
    tl_status status = gather(r, 0, error);
    return status == TL_OK ? gather(r, 1, error) : status;
}

static tl_status count_triangles(tl_roam *r, uint64_t *out, tl_error *error)
{
    tl_status status = gather_all(r, error);
    return status == TL_OK ? lod_count(&r->l, r->leaves.items, r->leaves.count, out, error) : status;
}

static tl_status try_error(void *context, double pixel_error, bool *fits, tl_error *error)
{
    tl_roam *r = context;
    uint64_t triangles = 0;
    lod_allow(&r->l, pixel_error);
    tl_status status = list_all(r, error);
    if (status == TL_OK)
        status = merge_all(r, &r->stale, error);
    if (status == TL_OK)
        status = split_all(r, &r->stale, error);
    if (status == TL_OK)
        status = count_triangles(r, &triangles, error);
    for (size_t k = 0; k < r->nodes.count; k++) {
        const node *n = node_at(r, (uint32_t)k);
        if (n->live && n->children == LOD_NONE && n->state >= LOD_LEAF && !n->stuck)
            lod_spare(&r->l, n->priority);
    }
    *fits = triangles <= r->options.budget;
    return status;
}

static tl_status update(tl_roam *r, tl_error *error)
{
    bool first = !r->nodes.count;
    tl_status status = first ? begin(r, error) : TL_OK;
    if (status == TL_OK)
        status = list_stale(r, move(r) || first, error);
    if (status == TL_OK)
        status = place_wanted(r, error);
    if (status == TL_OK)
        status = test_nodes(r, &r->stale, error);
    if (status != TL_OK)
        return status;
    if (r->options.budget) { /* from the same place in every view: where more is hidden of a finer surface, it may have
                                fewer triangles, and then the search's end depends on its way */
        int at = LOD_BUDGET_START;
        double least = r->options.morph ? LOD_MORPH * r->options.pixel_error : r->options.pixel_error;
        return lod_search_budget(&r->l, least, LOD_BUDGET_STEP, &at, try_error, r, error);
    }
    status = merge_all(r, &r->stale, error);
    return status == TL_OK ? split_all(r, &r->stale, error) : status;
}

static void fill_stats(const tl_roam *r, tl_lod_stats *out)
{
    lod_fill_stats(&r->l, out);
    out->split = r->split;
    out->merged = r->merged;
    out->pixel_error = 0;
    out->finest_level = r->l.levels - r->l.lattice_log;
    memset(out->culled, 0, sizeof out->culled);
    for (size_t k = 0; k < r->nodes.count; k++) {
        const node *n = node_at(r, (uint32_t)k);
        if (!n->live)
            continue;
        if (n->children != LOD_NONE) {
            int level = r->l.levels - (r->l.lattice_log - 1 - n->depth / 2);
            out->finest_level = level > out->finest_level ? level : out->finest_level;
        } else if (n->state == LOD_HIDDEN)
            out->culled[n->rule]++;
        else if (n->state >= LOD_LEAF)
            out->pixel_error = fmax(out->pixel_error, (double)n->pixels);
    }
    out->vertices = r->l.vertices.count - r->free_vertices.count;
}

/* Where rules are switched off, what they hide depends on all that is seen: it is searched for from nothing. */
static tl_status select_kept(const tl_roam *r, const tl_view *view, tl_mesh **out, tl_lod_stats *stats, tl_error *error)
{
    tl_lod_options options = r->options;
    options.selector = TL_SELECTOR_QUADTREE;
    return tl_select(r->l.field, r->l.dem, r->l.pyramid, view, &options, out, stats, error);
}

static tl_status look_kept(tl_roam *r, const tl_view *view, tl_lod_stats *stats, tl_error *error)
{
    tl_mesh *mesh = NULL;
    tl_status status = select_kept(r, view, &mesh, stats, error);
    tl_mesh_destroy(mesh);
    r->view = *view;
    r->seen_any = true;
    return status;
}

enum { LISTS = 11 };
static lod_list *list_of(tl_roam *r, size_t which)
{
    lod_list *const all[LISTS] = {&r->nodes, &r->free_nodes, &r->free_vertices, &r->holds, &r->places, &r->fresh,
                                  &r->busy,  &r->stale,      &r->queue,         &r->next,  &r->leaves};
    return all[which];
}

/* Forgets all that was looked at before. */
static tl_status forget(tl_roam *r, tl_error *error)
{
    const lod *l = &r->l;
    const tl_source *field = l->field, *dem = l->dem;
    const tl_pyramid *pyramid = l->pyramid;
    for (size_t k = 0; k < LISTS; k++) {
        free(list_of(r, k)->items);
        *list_of(r, k) = (lod_list){0};
    }
    lod_finish(&r->l);
    r->seen_any = false;
    return lod_init(&r->l, field, dem, pyramid, &r->options, error);
}

static tl_status look_from(tl_roam *r, const scene_view *from, tl_error *error)
{
    lod_turn(&r->l, from);
    tl_status status = lod_ridges_create(&r->l, &r->l.ridges, error);
    return status == TL_OK ? update(r, error) : status;
}

/* What earlier views have left, and this one does not need, may take the memory: then it starts from nothing. */
static tl_status look_anyhow(tl_roam *r, const scene_view *from, tl_error *error)
{
    bool more = r->nodes.count > 0;
    tl_status status = look_from(r, from, error);
    if (status != TL_ERROR_MEMORY || !more)
        return status;
    status = forget(r, error);
    return status == TL_OK ? look_from(r, from, error) : status;
}

tl_status tl_roam_look(tl_roam *r, const tl_view *view, tl_lod_stats *stats, tl_error *error)
{
    double start = lod_now();
    lod *l = &r->l;
    if (r->failed)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: a view before failed; start again", l->dem->info.name);
    if (r->options.keep)
        return look_kept(r, view, stats, error);
    scene_view *from = scene_view_create(view, l->dem, error);
    if (!from)
        return TL_ERROR_ARGUMENT;
    scene_view_know_ground(from, (double)l->low, false); /* lod_ridges.c knows where the voids are */
    r->split = r->merged = 0;
    tl_status status = TL_OK;
    l->stats.above_ground = (double)NAN;
    if (!l->empty)
        status = look_anyhow(r, from, error);
    double seconds = lod_now() - start;
    r->view = *view;
    r->seen_any = true;
    r->failed = status != TL_OK;
    if (status == TL_OK && stats) {
        fill_stats(r, stats);
        stats->seconds = seconds;
        stats->triangles = 0;
        if (!l->empty)
            status = count_triangles(r, &stats->triangles, error);
    }
    scene_view_destroy(from);
    l->view = NULL;
    l->camera = NULL;
    return status;
}

/* Sees from the last view again, for where its vertices are. */
static tl_status morph(tl_roam *r, float **heights, tl_error *error)
{
    lod *l = &r->l;
    double moved;
    scene_view *from = scene_view_create(&r->view, l->dem, error);
    if (!from)
        return TL_ERROR_ARGUMENT;
    scene_view_know_ground(from, (double)l->low, false);
    l->view = from;
    l->camera = scene_view_camera(from);
    tl_status status = lod_place(l, 0, error);
    if (status == TL_OK)
        status = lod_morph(l, heights, &moved, error);
    scene_view_destroy(from);
    l->view = NULL;
    l->camera = NULL;
    return status;
}

static tl_status draw_mesh(tl_roam *r, tl_mesh **out, tl_error *error)
{
    float *heights = NULL;
    tl_status status = r->options.morph && !r->l.empty ? morph(r, &heights, error) : TL_OK;
    if (status == TL_OK)
        status = lod_draw(&r->l, r->leaves.items, r->leaves.count, heights, out, error);
    free(heights);
    return status;
}

tl_status tl_roam_mesh(tl_roam *r, tl_mesh **out, tl_error *error)
{
    tl_mesh *mesh = NULL;
    lod *l = &r->l;
    if (!r->seen_any || r->failed)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: there is no view yet; give one", l->dem->info.name);
    if (r->options.keep)
        return select_kept(r, &r->view, out, NULL, error);
    tl_status status = TL_OK;
    if (!l->empty)
        status = gather_all(r, error);
    if (status == TL_OK)
        status = draw_mesh(r, &mesh, error);
    if (status == TL_OK)
        status = lod_describe(l, &r->view, mesh, error);
    if (status == TL_OK)
        *out = mesh;
    else
        tl_mesh_destroy(mesh);
    return status;
}

tl_roam *tl_roam_create(const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid,
                        const tl_lod_options *options, tl_error *error)
{
    static const tl_lod_options defaults;
    tl_roam *r = calloc(1, sizeof *r);
    if (!r) {
        tl_fail_memory(error, "the view");
        return NULL;
    }
    r->options = options ? *options : defaults;
    if (r->options.run)
        r->run = *r->options.run;
    r->options.run = &r->run;
    r->options.selector = TL_SELECTOR_ROAM;
    if (lod_init(&r->l, field, dem, pyramid, &r->options, error) == TL_OK)
        return r;
    tl_roam_destroy(r);
    return NULL;
}

void tl_roam_destroy(tl_roam *r)
{
    if (!r)
        return;
    for (size_t k = 0; k < LISTS; k++)
        free(list_of(r, k)->items);
    lod_finish(&r->l);
    free(r);
}

tl_status lod_roam_once(const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid, const tl_view *view,
                        const tl_lod_options *options, tl_mesh **out, tl_lod_stats *stats, tl_error *error)
{
    double start = lod_now();
    tl_mesh *mesh = NULL;
    tl_lod_stats found;
    tl_roam *r = tl_roam_create(field, dem, pyramid, options, error);
    if (!r)
        return TL_ERROR_ARGUMENT;
    tl_status status = tl_roam_look(r, view, &found, error);
    if (status == TL_OK)
        status = tl_roam_mesh(r, &mesh, error);
    tl_roam_destroy(r);
    if (status != TL_OK)
        return status;
    found.vertices = mesh->vertex_count;
    found.seconds = lod_now() - start;
    if (stats)
        *stats = found;
    *out = mesh;
    return TL_OK;
}
