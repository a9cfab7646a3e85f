/* What nearer ground hides: squares of cells, gone over from near to far, that are either hidden or hide what is behind
 * them. Only blocks that are not hidden are read. */
#include "dem/framework_pyramid.h"
#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/scene/lod.h"

#include <math.h>
#include <string.h>

/* Squares are divided until they look so small, radians. */
static const double SMALL = .04;
/* Blocks are read together up to so many times the distance of the nearest. */
static const double FARTHER = 1.3;

typedef struct square {
    double distance;
    int32_t i, j; /* its first cell */
    int32_t log;  /* of its side in cells */
    uint32_t block;
} square;

struct lod_ridges {
    uint64_t *keys; /* of hidden squares: by open addressing, 0 for none */
    size_t room, count;
};

typedef struct sweep {
    lod *l;
    scene_skyline *skyline;
    lod_ridges *out;
    lod_list wide, fine; /* square */
} sweep;

/* ---- What is hidden ---- */

static uint64_t key_of(int64_t i, int64_t j, int log)
{
    return (uint64_t)(log + 1) << 58 | (uint64_t)(i >> log) << 29 | (uint64_t)(j >> log);
}

static size_t slot_of(const lod_ridges *r, uint64_t key)
{
    uint64_t mixed = (key ^ key >> 31) * UINT64_C(0x9e3779b97f4a7c15);
    size_t at = (size_t)(mixed >> 20) & (r->room - 1);
    while (r->keys[at] && r->keys[at] != key)
        at = (at + 1) & (r->room - 1);
    return at;
}

bool lod_ridges_hide(const lod_ridges *r, int64_t i, int64_t j, int log)
{
    return r->room && r->keys[slot_of(r, key_of(i, j, log))] != 0;
}

static tl_status hide(lod_ridges *r, const square *s, tl_error *error)
{
    if (2 * (r->count + 1) > r->room) {
        lod_ridges bigger = {NULL, r->room ? 2 * r->room : 1024, 0};
        bigger.keys = calloc(bigger.room, sizeof *bigger.keys);
        if (!bigger.keys)
            return tl_fail_memory(error, "the view's ridges");
        for (size_t k = 0; k < r->room; k++)
            if (r->keys[k])
                bigger.keys[slot_of(&bigger, r->keys[k])] = r->keys[k];
        free(r->keys);
        r->keys = bigger.keys;
        r->room = bigger.room;
    }
    uint64_t key = key_of(s->i, s->j, s->log);
    r->keys[slot_of(r, key)] = key;
    r->count++;
    return TL_OK;
}

void lod_ridges_destroy(lod_ridges *r)
{
    if (!r)
        return;
    free(r->keys);
    free(r);
}

/* ---- Squares ---- */

/* A square with what is known of its heights, and what the field may add. */
static scene_extent extent_of(const lod *l, const square *s)
{
    int64_t side = INT64_C(1) << s->log;
    scene_extent e = {s->i,
                      s->j,
                      fmin((double)(s->i + side), (double)l->dem->info.width - 1),
                      fmin((double)(s->j + side), (double)l->dem->info.height - 1),
                      0,
                      0};
    double more = lod_residual(l, NULL);
    if (s->block != LOD_NONE) {
        scene_cells cells;
        scene_block_at(l->tiles, s->block, s->i, s->j, s->log, &cells);
        more = lod_residual(l, &cells);
        e.low = (double)cells.low, e.high = (double)cells.high;
    }
    if (s->block == LOD_NONE || !(e.low <= e.high))
        lod_wide_range(l, s->i, s->j, s->i + side, s->j + side, &e.low, &e.high);
    e.low -= more;
    e.high += more;
    return e;
}

static double side_of(const lod *l, const square *s)
{
    return ldexp(fmax(l->metres_x, l->metres_y), s->log);
}

static int by_distance(const void *a, const void *b)
{
    const square *one = a, *two = b;
    if (one->distance != two->distance)
        return one->distance < two->distance ? -1 : 1;
    if (one->j != two->j)
        return one->j < two->j ? -1 : 1;
    return one->i < two->i ? -1 : one->i > two->i;
}

static void sort(lod_list *list)
{
    if (list->count)
        qsort(list->items, list->count, sizeof(square), by_distance);
}

static tl_status push(lod_list *list, square s, tl_error *error)
{
    if (!lod_list_grow(list, 1, sizeof s))
        return tl_fail_memory(error, "the view's ridges");
    ((square *)list->items)[list->count++] = s;
    return TL_OK;
}

/* Divides a square down to what is small enough, or to blocks (that are not read yet), or within its block; leaves out
 * what other rules hide. */
static tl_status divide(const sweep *self, square s, int least_log, lod_list *out, tl_error *error)
{
    const lod *l = self->l;
    if (s.i >= l->dem->info.width - 1 || s.j >= l->dem->info.height - 1)
        return TL_OK;
    scene_extent extent = extent_of(l, &s);
    scene_box box;
    scene_view_box(l->view, &extent, &box);
    if (scene_view_hides(l->view, &extent, &box, HUGE_VAL, l->rules & (TL_CULL_FRUSTUM | TL_CULL_HORIZON)))
        return TL_OK;
    s.distance = scene_view_distance(l->view, &box);
    if (s.log <= least_log || side_of(l, &s) <= SMALL * s.distance)
        return push(out, s, error);
    tl_status status = TL_OK;
    int32_t half = INT32_C(1) << (s.log - 1);
    for (int k = 0; k < 4 && status == TL_OK; k++) {
        square part = {0, s.i + (k & 1 ? half : 0), s.j + (k & 2 ? half : 0), s.log - 1, s.block};
        status = divide(self, part, least_log, out, error);
    }
    return status;
}

static bool is_hidden(const sweep *self, const square *s, scene_extent *extent)
{
    scene_box box;
    *extent = extent_of(self->l, s);
    scene_view_box(self->l->view, extent, &box);
    return scene_skyline_hides(self->skyline, self->l->view, extent, &box);
}

/* Whether it is to be divided into squares smaller than those that the pyramid knows. */
static bool needs_block(const lod *l, const square *s)
{
    return side_of(l, s) > SMALL * s->distance * (1 << (SCENE_TILE_LOG - TL_SQUARE_LOG));
}

/* Squares first ... end - 1 of `wide`: reads those blocks that are not hidden. */
static tl_status read_batch(sweep *self, size_t first, size_t end, tl_error *error)
{
    lod *l = self->l;
    tl_status status = TL_OK;
    square *squares = self->wide.items;
    for (size_t k = first; k < end && status == TL_OK; k++) {
        scene_extent extent;
        if (is_hidden(self, &squares[k], &extent)) {
            status = hide(self->out, &squares[k], error);
            squares[k].log = -1;
        } else if (squares[k].log == SCENE_TILE_LOG && needs_block(l, &squares[k]))
            status = scene_tiles_want_block(l->tiles, squares[k].i, squares[k].j, &squares[k].block, error);
    }
    return status == TL_OK ? scene_tiles_make(l->tiles, l->run, error) : status;
}

/* Whether a square may have voids. What is beyond the raster's rim is none: nobody sees through there. */
static bool has_holes(const lod *l, const square *s)
{
    int64_t side = INT64_C(1) << s->log;
    double low, high;
    scene_cells cells;
    if (!l->voids)
        return false;
    if (s->block == LOD_NONE)
        return lod_wide_range(l, s->i, s->j, s->i + side, s->j + side, &low, &high);
    scene_block_at(l->tiles, s->block, s->i, s->j, s->log, &cells);
    return cells.voids;
}

static void leak(const sweep *self, const scene_extent *extent)
{
    scene_box box;
    scene_view_box(self->l->view, extent, &box);
    scene_skyline_leak(self->skyline, &box);
}

static tl_status go_over_batch(sweep *self, size_t first, size_t end, tl_error *error)
{
    tl_status status = read_batch(self, first, end, error);
    const square *squares = self->wide.items;
    self->fine.count = 0;
    for (size_t k = first; k < end && status == TL_OK; k++)
        if (squares[k].log >= 0)
            status = divide(self, squares[k], squares[k].block == LOD_NONE ? TL_SQUARE_LOG : LOD_RIDGE_LOG, &self->fine,
                            error);
    sort(&self->fine);
    for (size_t k = 0; k < self->fine.count && status == TL_OK; k++) {
        const square *s = (const square *)self->fine.items + k;
        scene_extent extent;
        if (is_hidden(self, s, &extent))
            status = hide(self->out, s, error);
        else if (has_holes(self->l, s))
            leak(self, &extent);
        else
            scene_skyline_raise(self->skyline, self->l->view, &extent);
    }
    return status;
}

static tl_status go_over_all(sweep *self, tl_error *error)
{
    const lod *l = self->l;
    square all = {0, 0, 0, l->lattice_log - l->levels, LOD_NONE};
    int least_log = all.log < SCENE_TILE_LOG ? all.log : SCENE_TILE_LOG;
    tl_status status = divide(self, all, least_log, &self->wide, error);
    sort(&self->wide);
    const square *squares = self->wide.items;
    for (size_t first = 0, end; first < self->wide.count && status == TL_OK; first = end) {
        double limit = fmax(FARTHER * squares[first].distance, ldexp(fmax(l->metres_x, l->metres_y), SCENE_TILE_LOG));
        for (end = first + 1; end < self->wide.count && squares[end].distance <= limit; end++)
            ;
        status = go_over_batch(self, first, end, error);
        squares = self->wide.items;
    }
    return status;
}

tl_status lod_ridges_create(lod *l, lod_ridges **out, tl_error *error)
{
    sweep self = {.l = l, .out = calloc(1, sizeof *self.out)};
    self.skyline = self.out ? scene_skyline_create(l->view, error) : NULL;
    tl_status status = self.out ? TL_OK : tl_fail_memory(error, "the view's ridges");
    if (status == TL_OK)
        status = self.skyline ? go_over_all(&self, error) : TL_ERROR_MEMORY;
    scene_skyline_destroy(self.skyline);
    free(self.wide.items);
    free(self.fine.items);
    if (status == TL_OK)
        *out = self.out;
    else
        lod_ridges_destroy(self.out);
    return status;
}
