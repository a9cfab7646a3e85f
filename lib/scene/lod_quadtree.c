/* Breadth first, with two queues: all triangles of one size are looked at together, so that what they need is made
 * together, and then those that they are split into. */
#include "dem/framework.h"
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/scene/lod.h"

#include <math.h>

enum { TESTED = 512, SLICE = 256 * TESTED /* triangles whose verdicts are kept at a time */ };

/* What is hidden by a rule that is switched off is searched for in a second pass, with the rules that are left. It may
 * not split what is seen: so switching rules off changes nothing that is seen, to the last triangle. */
typedef struct search {
    lod *l;
    lod_list current, next; /* lod_triangle */
    lod_verdict *verdicts;  /* of a slice of the current ones */
    size_t first, end;      /* of this slice */
    lod_list *leaves;
    lod_list hidden;  /* lod_leaf: by rules that are switched off; by depth */
    size_t taken;     /* of these, in the second pass */
    uint64_t *seen;   /* keys of the middles of what the first pass draws, by open addressing; NULL in that pass */
    size_t seen_room; /* a power of two */
    unsigned rules;
    int depth;
} search;

static tl_status test_item(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    (void)error;
    const search *self = context;
    size_t first = self->first + (size_t)item * TESTED;
    size_t end = first + TESTED < self->end ? first + TESTED : self->end;
    const lod_triangle *triangles = self->current.items;
    for (size_t k = first; k < end; k++)
        self->verdicts[k - self->first] = lod_test(self->l, &triangles[k], self->depth, self->rules);
    return TL_OK;
}

tl_status lod_want_block(lod *l, lod_triangle *t, tl_error *error)
{
    const lod_vertex *a = lod_at(l, t->a), *b = lod_at(l, t->b), *apex = lod_at(l, t->apex);
    int64_t i = tl_int64_min(tl_int64_min(a->x, b->x), apex->x) / l->cell;
    int64_t j = tl_int64_min(tl_int64_min(a->y, b->y), apex->y) / l->cell;
    return scene_tiles_want_block(l->tiles, i, j, &t->block, error);
}

static tl_status test_slice(search *self, tl_error *error)
{
    const lod *l = self->l;
    size_t count = self->end - self->first;
    tl_run quiet = l->run ? *l->run : (tl_run){0};
    quiet.progress = NULL;
    if (count <= 4 * TESTED)
        quiet.threads = 1;
    return tl_parallel_for(&quiet, (count + TESTED - 1) / TESTED, 0, test_item, self, error);
}

/* What becomes of a triangle with its verdict; it stays in `current` where `keep` is set. */
typedef tl_status decide(search *self, lod_triangle *t, const lod_verdict *v, bool *keep, tl_error *error);

/* Looks at all current triangles, and decides on each in turn. */
static tl_status sift(search *self, decide *on, tl_error *error)
{
    lod_triangle *triangles = self->current.items;
    size_t kept = 0, count = self->current.count;
    tl_status status = TL_OK;
    for (self->first = 0; self->first < count && status == TL_OK; self->first = self->end) {
        self->end = self->first + SLICE < count ? self->first + SLICE : count;
        status = test_slice(self, error);
        for (size_t k = self->first; k < self->end && status == TL_OK; k++) {
            bool keep = false;
            status = on(self, &triangles[k], &self->verdicts[k - self->first], &keep, error);
            if (keep)
                triangles[kept++] = triangles[k];
        }
    }
    self->current.count = kept;
    return status;
}

static int rule_index(unsigned rule)
{
    return __builtin_ctz(rule);
}

bool lod_opposite(const lod *l, const lod_triangle *t, int32_t *x, int32_t *y)
{
    const lod_vertex *a = lod_at(l, t->a), *b = lod_at(l, t->b), *apex = lod_at(l, t->apex);
    *x = a->x + (b->x - apex->x);
    *y = a->y + (b->y - apex->y);
    return isnan(a->z) != isnan(b->z) && !isnan(apex->z);
}

tl_status lod_leave(lod *l, const lod_triangle *t, int depth, lod_list *leaves, tl_error *error)
{
    if (!lod_list_grow(leaves, 1, sizeof(lod_leaf)))
        return tl_fail_memory(error, "the view's triangles");
    ((lod_leaf *)leaves->items)[leaves->count++] = (lod_leaf){*t, depth};
    l->certain += !isnan(lod_at(l, t->a)->z) && !isnan(lod_at(l, t->b)->z) && !isnan(lod_at(l, t->apex)->z);
    int32_t x, y;
    return lod_opposite(l, t, &x, &y) ? lod_ask(l, x, y, error) : TL_OK;
}

/* ---- The second pass ---- */

static uint64_t vertex_key(int32_t x, int32_t y)
{
    return ((uint64_t)(uint32_t)x << 32 | (uint32_t)y) + 1;
}

static size_t seen_slot(const search *self, uint64_t key)
{
    size_t at = (size_t)((key * UINT64_C(0x9e3779b97f4a7c15)) >> 20) & (self->seen_room - 1);
    while (self->seen[at] && self->seen[at] != key)
        at = (at + 1) & (self->seen_room - 1);
    return at;
}

/* Notes the middles of all that is drawn of a leaf, which may be split for others. */
static void note_leaf(search *self, const lod_triangle *t, int depth, const scene_tile **last)
{
    int32_t x, y;
    uint32_t middle = lod_splitter(self->l, t, depth, last);
    if (middle != LOD_NONE) {
        note_leaf(self, &(lod_triangle){t->apex, t->a, middle, 0, 0}, depth + 1, last);
        note_leaf(self, &(lod_triangle){t->b, t->apex, middle, 0, 0}, depth + 1, last);
    } else if (depth < 2 * self->l->lattice_log) {
        lod_middle(self->l, t, &x, &y);
        self->seen[seen_slot(self, vertex_key(x, y))] = vertex_key(x, y);
    }
}

/* Leaves are drawn as so many triangles at most as there are leaves and vertices. */
static tl_status note_seen(search *self, tl_error *error)
{
    const scene_tile *last = NULL;
    const lod_leaf *leaves = self->leaves->items;
    for (self->seen_room = 1024; self->seen_room < 2 * (self->leaves->count + 2 * self->l->vertices.count);)
        self->seen_room *= 2;
    self->seen = calloc(self->seen_room, sizeof *self->seen);
    if (!self->seen)
        return tl_fail_memory(error, "the view's triangles");
    for (size_t k = 0; k < self->leaves->count; k++)
        note_leaf(self, &leaves[k].triangle, leaves[k].depth, &last);
    return TL_OK;
}

static bool is_seen(const search *self, int32_t x, int32_t y)
{
    return self->seen[seen_slot(self, vertex_key(x, y))] != 0;
}

/* Whether a vertex is on the side of a cell of the model that is seen and not split. Where a corner of it is void it
 * cannot be split, and its halves are drawn with all vertices on its sides. */
static bool beside_seen_cell(const search *self, int32_t x, int32_t y)
{
    int32_t cell = self->l->cell, half = cell / 2;
    bool across = x & (cell - 1), down = y & (cell - 1);
    if (across == down)
        return false;
    int32_t i = across ? (x & -cell) + half : x, j = down ? (y & -cell) + half : y;
    return across ? is_seen(self, i, j - half) || is_seen(self, i, j + half)
                  : is_seen(self, i - half, j) || is_seen(self, i + half, j);
}

/* Whether marking a vertex, and all that it needs, changes nothing that is drawn of the first pass. */
static bool is_free(const search *self, int32_t x, int32_t y, const scene_tile **last)
{
    const lod *l = self->l;
    scene_slot slot = scene_tiles_find(l->tiles, x, y, last);
    if (slot.tile && scene_slot_marked(slot))
        return true;
    if (is_seen(self, x, y) || beside_seen_cell(self, x, y))
        return false;
    int64_t up[2][2];
    tl_lattice_parents(x, y, up);
    for (int k = 0; k < 2; k++)
        if (up[k][0] >= 0 && up[k][1] >= 0 && up[k][0] <= l->right && up[k][1] <= l->bottom &&
            !is_free(self, (int32_t)up[k][0], (int32_t)up[k][1], last))
            return false;
    return true;
}

static bool may_split(const search *self, const lod_triangle *t)
{
    const scene_tile *last = NULL;
    int32_t x, y;
    lod_middle(self->l, t, &x, &y);
    return !self->seen || is_free(self, x, y, &last);
}

/* A leaf of the second pass is left out where the corner that its drawing needs would split what is seen, or where it
 * would have to be split and must not be: then it would be drawn over voids. */
static tl_status leave(search *self, const lod_triangle *t, bool whole, tl_error *error)
{
    const scene_tile *last = NULL;
    int32_t x, y;
    if (self->seen && (!whole || (lod_opposite(self->l, t, &x, &y) && !is_free(self, x, y, &last))))
        return TL_OK;
    return lod_leave(self->l, t, self->depth, self->leaves, error);
}

/* ---- One depth ---- */

/* Leaves out a hidden triangle, or lays it aside for the second pass. */
static tl_status leave_out(search *self, const lod_triangle *t, unsigned rule, tl_error *error)
{
    if (!(rule & self->l->options->keep)) {
        self->l->stats.culled[rule_index(rule)]++;
        return TL_OK;
    }
    if (!lod_list_grow(&self->hidden, 1, sizeof(lod_leaf)))
        return tl_fail_memory(error, "the view's triangles");
    ((lod_leaf *)self->hidden.items)[self->hidden.count++] = (lod_leaf){*t, self->depth};
    return TL_OK;
}

/* Sorts triangles into leaves, and those whose middles are to be asked for, which stay. */
static tl_status sort_out(search *self, lod_triangle *t, const lod_verdict *v, bool *keep, tl_error *error)
{
    lod *l = self->l;
    if (v->state == LOD_HIDDEN)
        return leave_out(self, t, v->rule, error);
    if (v->state == LOD_DROPPED)
        return TL_OK;
    if (v->state == LOD_SPLIT && may_split(self, t)) {
        t->step = v->step;
        *keep = true;
        return TL_OK;
    }
    l->stats.pixel_error = fmax(l->stats.pixel_error, self->seen ? 0 : (double)v->pixels);
    lod_spare(l, v->priority);
    return leave(self, t, v->state != LOD_SPLIT || v->pixels < HUGE_VALF, error);
}

/* Asks for the middles, and queues the halves. */
static tl_status split_all(search *self, tl_error *error)
{
    lod *l = self->l;
    const lod_triangle *triangles = self->current.items;
    size_t before = l->asked.count; /* opposite corners */
    tl_status status = TL_OK;
    for (size_t k = 0; k < self->current.count && status == TL_OK; k++) {
        int32_t x, y;
        lod_middle(l, &triangles[k], &x, &y);
        status = lod_ask(l, x, y, error);
    }
    if (status == TL_OK)
        status = lod_mark_asked(l, error);
    self->next.count = 0;
    if (status == TL_OK && !lod_list_grow(&self->next, 2 * self->current.count, sizeof(lod_triangle)))
        return tl_fail_memory(error, "the view's triangles");
    for (size_t k = 0; k < self->current.count && status == TL_OK; k++) {
        const lod_triangle *t = &triangles[k];
        uint32_t middle = lod_asked(l, before + k)->vertex;
        if (middle == LOD_NONE) {
            status = leave(self, t, true, error);
            continue;
        }
        lod_triangle *to = (lod_triangle *)self->next.items + self->next.count;
        to[0] = (lod_triangle){t->apex, t->a, middle, t->block, t->step};
        to[1] = (lod_triangle){t->b, t->apex, middle, t->block, t->step};
        self->next.count += 2;
        l->stats.split++;
    }
    return status;
}

/* Lets what is not hidden stay. */
static tl_status leave_hidden(search *self, lod_triangle *t, const lod_verdict *v, bool *keep, tl_error *error)
{
    *keep = v->state != LOD_HIDDEN && v->state != LOD_DROPPED;
    return v->state == LOD_HIDDEN ? leave_out(self, t, v->rule, error) : TL_OK;
}

/* Looks for the blocks of what is not hidden. */
static tl_status enter_blocks(search *self, tl_error *error)
{
    lod *l = self->l;
    tl_status status = sift(self, leave_hidden, error);
    lod_triangle *triangles = self->current.items;
    for (size_t k = 0; k < self->current.count && status == TL_OK; k++)
        status = lod_want_block(l, &triangles[k], error);
    return status == TL_OK ? scene_tiles_make(l->tiles, l->run, error) : status;
}

static tl_status one_depth(search *self, tl_error *error)
{
    lod *l = self->l;
    tl_status status = tl_run_check(l->run, error);
    if (status == TL_OK)
        status = lod_fits(l,
                          (self->current.room + self->next.room) * sizeof(lod_triangle) +
                              self->leaves->room * sizeof(lod_leaf) + SLICE * sizeof *self->verdicts,
                          error);
    if (status == TL_OK && self->depth == lod_block_depth(l))
        status = enter_blocks(self, error);
    l->stats.visited += self->current.count;
    l->asked.count = 0;
    if (status == TL_OK)
        status = sift(self, sort_out, error);
    if (status == TL_OK)
        status = split_all(self, error);
    return status;
}

/* Takes the laid aside triangles of this depth in. */
static tl_status take_hidden(search *self, tl_error *error)
{
    const lod_leaf *hidden = self->hidden.items;
    while (self->taken < self->hidden.count && hidden[self->taken].depth == self->depth) {
        if (!lod_list_grow(&self->current, 1, sizeof(lod_triangle)))
            return tl_fail_memory(error, "the view's triangles");
        ((lod_triangle *)self->current.items)[self->current.count++] = hidden[self->taken++].triangle;
    }
    return TL_OK;
}

/* Searches from the queue on, and from what is laid aside. */
static tl_status search_all(search *self, uint64_t limit, tl_error *error)
{
    lod *l = self->l;
    tl_status status = TL_OK;
    for (self->depth = 0; status == TL_OK && !l->overflow && self->depth <= 2 * l->lattice_log; self->depth++) {
        if (self->seen)
            status = take_hidden(self, error);
        if (status != TL_OK || !self->current.count)
            continue;
        status = one_depth(self, error);
        lod_list done = self->current;
        self->current = self->next;
        self->next = done;
        self->next.count = 0;
        l->overflow = limit && l->certain > limit;
    }
    return status == TL_OK && !l->overflow ? lod_close(l, error) : status;
}

static tl_status search_hidden(search *self, uint64_t limit, tl_error *error)
{
    tl_status status = note_seen(self, error);
    self->rules &= ~self->l->options->keep;
    self->current.count = 0;
    return status == TL_OK ? search_all(self, limit, error) : status;
}

tl_status lod_quadtree(lod *l, uint64_t limit, lod_list *leaves, tl_error *error)
{
    search self = {.l = l, .leaves = leaves, .rules = l->rules};
    self.verdicts = tl_alloc(SLICE, sizeof *self.verdicts);
    tl_status status = self.verdicts && lod_list_grow(&self.current, 2, sizeof(lod_triangle))
                           ? TL_OK
                           : tl_fail_memory(error, "the view");
    if (status == TL_OK) {
        lod_roots(l, self.current.items);
        self.current.count = 2;
        status = search_all(&self, limit, error);
    }
    if (status == TL_OK && !l->overflow && self.hidden.count)
        status = search_hidden(&self, limit, error);
    free(self.current.items);
    free(self.next.items);
    free(self.verdicts);
    free(self.hidden.items);
    free(self.seen);
    return status;
}
