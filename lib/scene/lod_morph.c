/* Geomorphing: heights between those of a mesh and those of a coarser one, so that no vertex comes or goes with a jump.
 *
 * The pixels of a vertex are those at which it would leave the mesh: the most that a triangle wants to be split by
 * there, or that a vertex has that needs it. They change with the eye without jumps. The mesh is chosen at two thirds
 * of the pixel error that was asked for, e; a vertex of p pixels is moved from the middle of the edge that it splits to
 * its own height by the share (p - e) / e, cut to 0 ... 1. So it comes, at p = e, where the surface is, and from 2 e on
 * it is where the field is. In between, its height is off by (1 - (p - e) / e) p < e, beside the triangles' own errors
 * of up to e; few places have most of both: doc/accuracy.md. */
#include "dem/framework.h"
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/scene/lod.h"

#include <math.h>
#include <string.h>

enum { TESTED = 512 };

/* A triangle that may be split, and what the larger one wants to be split by. */
typedef struct step {
    lod_triangle triangle;
    uint32_t middle; /* the vertex that splits it, or LOD_NONE */
    float pixels;
} step;

typedef struct morph {
    lod *l;
    lod_list current, next; /* step */
    float *pixels;          /* by vertex; below 0: none */
    unsigned char *seen;    /* by vertex: it splits a triangle that is not hidden */
    uint32_t (*ends)[2];    /* of the edge that a vertex splits; LOD_NONE: none */
    uint32_t *order;        /* vertices, from coarse to fine */
    size_t ordered;
    int depth;
} morph;

/* ---- Pixels ---- */

static float least(float a, float b)
{
    return a < b ? a : b;
}

static tl_status test_item(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    (void)error;
    const morph *self = context;
    const scene_tile *last = NULL;
    size_t first = (size_t)item * TESTED, end = first + TESTED;
    end = end < self->current.count ? end : self->current.count;
    for (size_t k = first; k < end; k++) {
        step *s = (step *)self->current.items + k;
        s->middle = lod_splitter(self->l, &s->triangle, self->depth, &last);
        if (s->middle == LOD_NONE || s->pixels < 0)
            continue;
        if (self->depth >= lod_block_depth(self->l) && s->triangle.block == LOD_NONE) {
            s->pixels = -1; /* it was not looked at */
            continue;
        }
        lod_verdict v = lod_test(self->l, &s->triangle, self->depth, self->l->rules);
        s->pixels = v.state < LOD_LEAF ? -1 : least(s->pixels, v.priority);
    }
    return TL_OK;
}

static void find_blocks(const morph *self)
{
    const lod *l = self->l;
    for (size_t k = 0; k < self->current.count; k++) {
        lod_triangle *t = &((step *)self->current.items + k)->triangle;
        const lod_vertex *a = lod_at(l, t->a), *b = lod_at(l, t->b), *apex = lod_at(l, t->apex);
        int64_t i = tl_int64_min(tl_int64_min(a->x, b->x), apex->x) / l->cell;
        int64_t j = tl_int64_min(tl_int64_min(a->y, b->y), apex->y) / l->cell;
        if (!scene_tiles_find_block(l->tiles, i, j, &t->block))
            t->block = LOD_NONE;
    }
}

/* Notes what the triangles of this depth say of their middles, and queues their halves. */
static tl_status go_on(morph *self, tl_error *error)
{
    self->next.count = 0;
    if (!lod_list_grow(&self->next, 2 * self->current.count, sizeof(step)))
        return tl_fail_memory(error, "the view's triangles");
    for (size_t k = 0; k < self->current.count; k++) {
        const step *s = (const step *)self->current.items + k;
        const lod_triangle *t = &s->triangle;
        if (s->middle == LOD_NONE)
            continue;
        if (self->ends[s->middle][0] == LOD_NONE)
            self->order[self->ordered++] = s->middle;
        self->ends[s->middle][0] = t->a, self->ends[s->middle][1] = t->b;
        self->seen[s->middle] |= s->pixels >= 0;
        if (s->pixels > self->pixels[s->middle])
            self->pixels[s->middle] = s->pixels;
        step *to = (step *)self->next.items + self->next.count;
        to[0] = (step){{t->apex, t->a, s->middle, t->block, 0}, LOD_NONE, s->pixels};
        to[1] = (step){{t->b, t->apex, s->middle, t->block, 0}, LOD_NONE, s->pixels};
        self->next.count += 2;
    }
    return TL_OK;
}

static size_t bytes_of(const morph *self)
{
    return self->l->vertices.count * 21 + (self->current.room + self->next.room) * sizeof(step);
}

static tl_status descend(morph *self, tl_error *error)
{
    lod *l = self->l;
    lod_triangle roots[2];
    tl_status status =
        lod_list_grow(&self->current, 2, sizeof(step)) ? TL_OK : tl_fail_memory(error, "the view's triangles");
    if (status != TL_OK)
        return status;
    lod_roots(l, roots);
    for (int k = 0; k < 2; k++)
        ((step *)self->current.items)[self->current.count++] = (step){roots[k], LOD_NONE, HUGE_VALF};
    for (self->depth = 0; status == TL_OK && self->current.count && self->depth < 2 * l->lattice_log; self->depth++) {
        tl_run quiet = l->run ? *l->run : (tl_run){0};
        quiet.progress = NULL;
        if (self->current.count <= 4 * TESTED)
            quiet.threads = 1;
        if (self->depth == lod_block_depth(l))
            find_blocks(self);
        status = tl_run_check(l->run, error);
        if (status == TL_OK)
            status = lod_fits(l, bytes_of(self), error);
        if (status == TL_OK)
            status = tl_parallel_for(&quiet, (self->current.count + TESTED - 1) / TESTED, 0, test_item, self, error);
        if (status == TL_OK)
            status = go_on(self, error);
        lod_list done = self->current;
        self->current = self->next;
        self->next = done;
    }
    return status;
}

/* What a vertex has, those that it needs have at least. */
static void pass_on(morph *self)
{
    const lod *l = self->l;
    const scene_tile *last = NULL;
    for (size_t k = self->ordered; k-- > 0;) {
        uint32_t vertex = self->order[k];
        int64_t up[2][2];
        if (self->pixels[vertex] < 0)
            continue;
        tl_lattice_parents(lod_at(l, vertex)->x, lod_at(l, vertex)->y, up);
        for (int m = 0; m < 2; m++) {
            if (up[m][0] < 0 || up[m][1] < 0 || up[m][0] > l->right || up[m][1] > l->bottom)
                continue;
            scene_slot slot = scene_tiles_find(l->tiles, (int32_t)up[m][0], (int32_t)up[m][1], &last);
            if (!slot.tile || !scene_slot_marked(slot))
                continue;
            float *parent = &self->pixels[slot.tile->slots[slot.at].vertex];
            *parent = *parent > self->pixels[vertex] ? *parent : self->pixels[vertex];
        }
    }
}

/* ---- Heights ---- */

static double height_of(const morph *self, uint32_t vertex, const float *heights)
{
    const lod *l = self->l;
    double own = (double)lod_at(l, vertex)->z;
    double middle = .5 * ((double)heights[self->ends[vertex][0]] + (double)heights[self->ends[vertex][1]]);
    double share = ((double)self->pixels[vertex] - l->pixel_error) / l->pixel_error;
    if (!(share < 1) || isnan(middle) || isnan(own))
        return own;
    return middle + fmax(share, 0) * (own - middle);
}

static void move(const morph *self, float *heights, double *pixels)
{
    const lod *l = self->l;
    *pixels = 0;
    for (size_t k = 0; k < self->ordered; k++) {
        uint32_t vertex = self->order[k];
        const lod_vertex *v = lod_at(l, vertex);
        heights[vertex] = (float)height_of(self, vertex, heights);
        double off = fabs((double)heights[vertex] - (double)v->z) * l->unit, far = 0;
        for (int a = 0; a < 3; a++)
            far += (double)v->at[a] * (double)v->at[a];
        if (off > 0 && self->seen[vertex])
            *pixels = fmax(*pixels, scene_view_pixels(l->view, off, sqrt(far)));
    }
}

tl_status lod_morph(lod *l, float **out, double *pixels, tl_error *error)
{
    size_t count = l->vertices.count;
    morph self = {.l = l,
                  .pixels = tl_alloc(count, sizeof *self.pixels),
                  .seen = calloc(count + 1, sizeof *self.seen),
                  .ends = tl_alloc(count, sizeof *self.ends),
                  .order = tl_alloc(count, sizeof *self.order)};
    float *heights = tl_alloc(count, sizeof *heights);
    tl_status status = self.pixels && self.seen && self.ends && self.order && heights
                           ? TL_OK
                           : tl_fail_memory(error, "the view's vertices");
    for (size_t k = 0; k < count && status == TL_OK; k++) {
        heights[k] = lod_at(l, (uint32_t)k)->z;
        self.pixels[k] = -1;
        self.ends[k][0] = self.ends[k][1] = LOD_NONE;
    }
    if (status == TL_OK)
        status = descend(&self, error);
    if (status == TL_OK) {
        pass_on(&self);
        move(&self, heights, pixels);
        *out = heights;
    } else
        free(heights);
    free(self.current.items);
    free(self.next.items);
    free(self.pixels);
    free(self.seen);
    free(self.ends);
    free(self.order);
    return status;
}
