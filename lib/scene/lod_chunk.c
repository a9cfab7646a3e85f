/* Chunks: squares of 32 x 32 steps, each with the step that its distance asks for, a power of two. First a quadtree of
 * chunks is found: one whose steps are too coarse is divided in four. Then its triangles are searched for as those of
 * the quadtree are, but split down to their chunk's step. */
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/scene/lod.h"

#include "dem/framework_pyramid.h"

#include <math.h>

enum { STEPS_LOG = 5 };

typedef enum chunk_state { CHUNK_NONE = 0, CHUNK_DIVIDED, CHUNK_DRAWN, CHUNK_HIDDEN } chunk_state;

typedef struct chunk {
    uint64_t key; /* 0: none */
    unsigned char state, rule;
} chunk;

struct lod_chunks {
    chunk *items; /* by open addressing */
    size_t room, count;
};

/* A square of 2^log steps of the finest lattice. */
typedef struct square {
    int32_t x, y, log;
} square;

static uint64_t key_of(int32_t x, int32_t y, int log)
{
    return (uint64_t)(log + 1) << 58 | (uint64_t)(x >> log) << 29 | (uint64_t)(y >> log);
}

static chunk *find(const struct lod_chunks *c, uint64_t key)
{
    uint64_t mixed = (key ^ key >> 31) * UINT64_C(0x9e3779b97f4a7c15);
    size_t at = (size_t)(mixed >> 20) & (c->room - 1);
    while (c->items[at].key && c->items[at].key != key)
        at = (at + 1) & (c->room - 1);
    return &c->items[at];
}

static tl_status put(struct lod_chunks *c, chunk item, tl_error *error)
{
    if (2 * (c->count + 1) > c->room) {
        struct lod_chunks bigger = {NULL, c->room ? 2 * c->room : 1024, 0};
        bigger.items = calloc(bigger.room, sizeof *bigger.items);
        if (!bigger.items)
            return tl_fail_memory(error, "the view's chunks");
        for (size_t k = 0; k < c->room; k++)
            if (c->items[k].key)
                *find(&bigger, c->items[k].key) = c->items[k];
        free(c->items);
        c->items = bigger.items;
        c->room = bigger.room;
    }
    *find(c, item.key) = item;
    c->count++;
    return TL_OK;
}

bool lod_chunk_says(const struct lod_chunks *c, int32_t x, int32_t y, int log, int *step_log, unsigned *hidden)
{
    const chunk *found = c->room ? find(c, key_of(x, y, log)) : NULL;
    *hidden = found && found->key ? found->rule : 0;
    if (!found || found->state != CHUNK_DRAWN)
        return false;
    *step_log = log > STEPS_LOG ? log - STEPS_LOG : 0;
    return true;
}

/* The largest error of the triangles between the steps of a chunk, in metres. */
static double error_of(const lod *l, const square *s, uint32_t block)
{
    int step = s->log - STEPS_LOG, depth = 2 * (l->lattice_log - step);
    double most = 0;
    scene_cells cells;
    if (block != LOD_NONE) {
        int log = s->log - l->levels;
        scene_block_at(l->tiles, block, s->x / l->cell, s->y / l->cell, log > 0 ? log : 0, &cells);
    }
    double more = lod_residual_at(l, block == LOD_NONE ? NULL : &cells, depth);
    if (step - 1 < l->levels) /* what splits the triangles is below the samples */
        return more * l->unit;
    int32_t half = INT32_C(1) << (step - 1);
    for (int32_t y = s->y + half; y < s->y + (INT32_C(1) << s->log) && y <= l->bottom; y += 2 * half)
        for (int32_t x = s->x + half; x < s->x + (INT32_C(1) << s->log) && x <= l->right; x += 2 * half) {
            double own = tl_pyramid_error(l->pyramid, x / l->cell, y / l->cell);
            if (own < HUGE_VAL && own > most) /* the others are split anyway */
                most = own;
        }
    return (most + more) * l->unit;
}

static scene_extent extent_of(const lod *l, const square *s, uint32_t block)
{
    double side = ldexp(1, s->log), low, high;
    scene_extent e = {s->x / (double)l->cell,
                      s->y / (double)l->cell,
                      fmin(s->x + side, (double)l->right) / l->cell,
                      fmin(s->y + side, (double)l->bottom) / l->cell,
                      0,
                      0};
    lod_wide_range(l, s->x / l->cell, s->y / l->cell, (int64_t)ceil(e.i1), (int64_t)ceil(e.j1), &low, &high);
    double more = lod_residual(l, NULL);
    if (block != LOD_NONE) {
        scene_cells cells;
        int log = s->log - l->levels;
        scene_block_at(l->tiles, block, s->x / l->cell, s->y / l->cell, log > 2 ? log : 2, &cells);
        if (cells.low <= cells.high)
            low = (double)cells.low, high = (double)cells.high;
        more = lod_residual(l, &cells);
    }
    e.low = low - more, e.high = high + more;
    return e;
}

/* Decides about one chunk. */
static tl_status look_at(lod *l, const square *s, chunk *out, tl_error *error)
{
    uint32_t block = LOD_NONE;
    scene_box box;
    *out = (chunk){.key = key_of(s->x, s->y, s->log), .state = CHUNK_DRAWN};
    scene_extent extent = extent_of(l, s, LOD_NONE);
    scene_view_box(l->view, &extent, &box);
    out->rule = (unsigned char)scene_view_hides(l->view, &extent, &box, HUGE_VAL,
                                                l->rules & (TL_CULL_FRUSTUM | TL_CULL_HORIZON));
    int log = s->log - l->levels;
    if (!out->rule && l->ridges && log >= 0 && lod_ridges_hide(l->ridges, s->x / l->cell, s->y / l->cell, log))
        out->rule = TL_CULL_RIDGE;
    if (!(out->rule & ~l->options->keep) && log <= SCENE_TILE_LOG) {
        tl_status status = scene_tiles_want_block(l->tiles, s->x / l->cell, s->y / l->cell, &block, error);
        if (status == TL_OK)
            status = scene_tiles_make(l->tiles, l->run, error);
        if (status != TL_OK)
            return status;
        extent = extent_of(l, s, block);
        scene_view_box(l->view, &extent, &box);
        if (!out->rule)
            out->rule = (unsigned char)scene_view_hides(l->view, &extent, &box, HUGE_VAL, l->rules & TL_CULL_FRUSTUM);
    }
    if (out->rule & ~l->options->keep)
        out->state = CHUNK_HIDDEN;
    else if (s->log > STEPS_LOG && lod_wants(l, 2 * (l->lattice_log - s->log + STEPS_LOG), error_of(l, s, block),
                                             scene_view_distance(l->view, &box)))
        out->state = CHUNK_DIVIDED;
    return TL_OK;
}

static tl_status search(lod *l, struct lod_chunks *chunks, square s, tl_error *error)
{
    chunk found;
    if (s.x >= l->right || s.y >= l->bottom)
        return TL_OK;
    l->stats.visited++;
    tl_status status = look_at(l, &s, &found, error);
    if (status == TL_OK)
        status = put(chunks, found, error);
    if (found.state == CHUNK_HIDDEN)
        l->stats.culled[__builtin_ctz(found.rule)]++;
    if (status != TL_OK || found.state != CHUNK_DIVIDED)
        return status;
    int32_t half = INT32_C(1) << (s.log - 1);
    for (int k = 0; k < 4 && status == TL_OK; k++)
        status = search(l, chunks, (square){s.x + (k & 1 ? half : 0), s.y + (k & 2 ? half : 0), s.log - 1}, error);
    return status;
}

tl_status lod_chunk(lod *l, uint64_t limit, lod_list *leaves, tl_error *error)
{
    struct lod_chunks chunks = {NULL, 0, 0};
    tl_status status = search(l, &chunks, (square){0, 0, l->lattice_log}, error);
    l->chunks = &chunks;
    if (status == TL_OK)
        status = lod_quadtree(l, limit, leaves, error);
    l->chunks = NULL;
    free(chunks.items);
    return status;
}
