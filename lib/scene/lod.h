/* The inside of tl_select: one hierarchy of triangles, from which each selector takes what a view needs.
 *
 * The hierarchy is that of the framework (dem/framework.h), continued below the model's samples: right isosceles
 * triangles that are split in the middle of their hypotenuse, so that every triangle lies in exactly one larger one.
 * Depth 0 are the two halves of the lattice; an even depth has halves of squares, which a centre splits, an odd one
 * quarters of squares, which an edge point splits.
 *
 * A triangle *wants* to be split where the one that it lies in does, it is not hidden, and its error takes more pixels
 * than allowed (or fewer are allowed than any error takes: beside voids and over the rim). That depends on the view
 * alone. The vertices of the mesh are those at which a triangle wants to be split, and all that these need: the right
 * angles of the triangles on both sides of each (its parents, as tl_lattice_parents gives them). So all selectors that
 * look at single triangles find the same vertices, in whatever order they come; and what was hidden and is not drawn
 * changes nothing of what is seen. */
#ifndef SCENE_LOD_H
#define SCENE_LOD_H

#include "lib/base/parallel.h"
#include "lib/scene/tile_cache.h"
#include "lib/scene/view.h"
#include "lib/talus.h"

enum { LOD_DEPTHS = 2 * 30 + 1, LOD_LATTICE_MAX = 30 };

static const uint32_t LOD_NONE = UINT32_MAX;

/* A vertex that is marked. Heights of voids are NaN; their places are those of some height. */
typedef struct lod_vertex {
    int32_t x, y; /* on the lattice of the finest level that is used */
    float z;
    float at[3]; /* metres from the eye, in the scene's frame */
} lod_vertex;

/* Counter-clockwise as seen on a map with rows going down; the hypotenuse is from a to b. */
typedef struct lod_triangle {
    uint32_t a, b, apex; /* vertices */
    uint32_t block;      /* of scene_tiles, or LOD_NONE: it is larger */
    int32_t step;        /* 1 + log2 of the step of the chunk that it lies in; 0: not known */
} lod_triangle;

typedef enum lod_state {
    LOD_DROPPED, /* outside, or all void */
    LOD_HIDDEN,
    LOD_LEAF,  /* to be drawn, unless it must be split for another */
    LOD_SPLIT, /* wants to be split */
} lod_state;

/* What a test finds of a triangle. */
typedef struct lod_verdict {
    unsigned char state; /* lod_state */
    unsigned char rule;  /* tl_culling, of a hidden one */
    signed char step;    /* of its chunk: see lod_triangle */
    float priority;      /* it wants to be split where fewer pixels are allowed; infinite: always, -1: never */
    /* The verdict stays what it is while the eye has moved by less than `margin`, in metres, and by less than each of
     * `beside`, where the planes' turning counts, by the change of their normals times `far`: [0] the near plane and
     * the screen's left and right, [1] its top and bottom. For an allowed pixel error that stays. Below 0: it may
     * change at any time. Ridges are apart: see lod_at_ridge. */
    float margin, beside[2], far;
    float pixels; /* of its error; infinite where it must be split */
} lod_verdict;

/* Arrays that grow. */
typedef struct lod_list {
    void *items;
    size_t count, room;
} lod_list;

/* Room for `more` items of `size` bytes behind the last. */
bool lod_list_grow(lod_list *list, size_t more, size_t size);

typedef struct lod {
    const tl_source *field, *dem;
    const tl_pyramid *pyramid;
    const tl_lod_options *options;
    const tl_run *run;
    int levels;                /* below level 0 that are used */
    int finest;                /* the level that no split may go beyond; may be negative */
    int lattice_log;           /* of the finest lattice that is used */
    int32_t right, bottom;     /* its last column and row on the raster */
    int32_t cell;              /* 2^levels */
    float low, high;           /* of the model's samples */
    double unit;               /* metres */
    double metres_x, metres_y; /* of a cell of the model */
    double degrees;            /* of longitude in a cell's width; 0: not geographic */
    double spread[LOD_DEPTHS]; /* standard deviation of the field from the triangles of a depth where all four corners
                                  are its own; where the strength is 1 */
    double legs[LOD_DEPTHS];   /* longest legs of triangles, metres */
    double steepest;    /* slopes that the field adds to those between samples: a bound, where the strength is 1 */
    float filling;      /* height that voids are taken to have, for their places */
    double pixel_error; /* allowed */
    double next;        /* the greatest error at or below it at which something more would be split; 0: at none */
    const scene_view *view;
    const scene_camera *camera;
    double near;         /* pixels by `pixel_error`: errors are too large nearer than this times themselves */
    double planes[5][3]; /* of the frustum, through the eye, inwards, of length 1 */
    scene_tiles *tiles;
    lod_list vertices;               /* lod_vertex */
    lod_list by_depth[LOD_DEPTHS];   /* uint32_t: the vertices that split triangles of this depth */
    lod_list asked;                  /* lod_request */
    uint32_t corners[4];             /* of the lattice: NW, NE, SW, SE */
    const struct lod_chunks *chunks; /* the steps of chunks; NULL: triangles are looked at one by one */
    struct lod_ridges *ridges;       /* what ridges hide; NULL: not asked for */
    unsigned rules;                  /* tl_culling that hide */
    bool voids;                      /* the model may have some */
    bool empty;                      /* the raster has no cells, or no heights */
    uint64_t certain;                /* leaves that are drawn */
    bool overflow;                   /* a selector stopped at its limit */
    tl_lod_stats stats;
} lod;

static inline lod_vertex *lod_at(const lod *l, uint32_t vertex)
{
    return (lod_vertex *)l->vertices.items + vertex;
}

/* ---- lod.c: the world of a selection ---- */

/* Whether tiles, vertices and `others` bytes are within the run's memory. */
tl_status lod_fits(const lod *l, size_t others, tl_error *error);

tl_status lod_init(lod *l, const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid,
                   const tl_lod_options *options, tl_error *error);
void lod_finish(lod *l);
/* Looks from `view`, which is borrowed: places all vertices, and clears the statistics. */
tl_status lod_look(lod *l, const scene_view *view, tl_error *error);

/* ---- lod_test.c: what a view makes of a triangle ---- */

/* Prepares the tests for the view of `l`. */
void lod_prepare_tests(lod *l);
/* Looks at a triangle of this depth, hidden by the rules of `rules` only (an or of tl_culling). Any number of threads.
 * Its block must be made; see lod_block_depth. */
lod_verdict lod_test(const lod *l, const lod_triangle *triangle, int depth, unsigned rules);
/* Whether ridges may hide a triangle of this depth; and whether they do. */
bool lod_at_ridge(const lod *l, int depth);
bool lod_behind_ridge(const lod *l, const lod_triangle *t, int depth);
/* A bound of what the field adds to heights of the model's own triangles of cells like these; NULL: of any. The same
 * for triangles of a depth. Units of height. */
double lod_residual(const lod *l, const scene_cells *cells);
double lod_residual_at(const lod *l, const scene_cells *cells, int depth);
/* Whether triangles of a depth with this error (metres) at this distance are to be split; takes note where not. */
bool lod_wants(lod *l, int depth, double error, double distance);
/* Takes note of what is not split because fewer pixels than these are not asked for. */
static inline void lod_spare(lod *l, float priority)
{
    if ((double)priority <= l->pixel_error && (double)priority > l->next)
        l->next = (double)priority;
}
/* To be called when the allowed pixel error changes. */
void lod_allow(lod *l, double pixel_error);
/* The depth from which on triangles lie in one block of scene_tiles. */
int lod_block_depth(const lod *l);
/* The vertex that splits a triangle. */
static inline void lod_middle(const lod *l, const lod_triangle *t, int32_t *x, int32_t *y)
{
    const lod_vertex *a = lod_at(l, t->a), *b = lod_at(l, t->b);
    *x = a->x + (b->x - a->x) / 2;
    *y = a->y + (b->y - a->y) / 2;
}

/* ---- lod_ridges.c: what is behind nearer ground ---- */

typedef struct lod_ridges lod_ridges;
enum { LOD_RIDGE_LOG = 2 }; /* squares of 4 cells at least: smaller ones have no range of their own */
/* Goes over the ground from near to far. */
tl_status lod_ridges_create(lod *l, lod_ridges **out, tl_error *error);
void lod_ridges_destroy(lod_ridges *ridges);
/* Whether it found the square of 2^log cells at cell (i, j) to be hidden. (Those in a hidden square are not known.) */
bool lod_ridges_hide(const lod_ridges *ridges, int64_t i, int64_t j, int log);
/* The range of the model's heights in a rectangle of cells, by what the pyramid knows; whether it may have voids. */
bool lod_wide_range(const lod *l, int64_t i0, int64_t j0, int64_t i1, int64_t j1, double *low, double *high);

/* ---- lod_marks.c: vertices ---- */

/* One of the vertices that are to be marked together. */
typedef struct lod_request {
    int32_t x, y;
    scene_slot slot;
    uint32_t vertex; /* LOD_NONE: it cannot be, for it lies in a void below the samples */
} lod_request;

/* Asks for a vertex; lod_mark_asked marks all that were asked for. */
tl_status lod_ask(lod *l, int32_t x, int32_t y, tl_error *error);
tl_status lod_mark_asked(lod *l, tl_error *error);
static inline const lod_request *lod_asked(const lod *l, size_t index)
{
    return (const lod_request *)l->asked.items + index;
}
/* Places vertices from `first` on. */
tl_status lod_place(const lod *l, size_t first, tl_error *error);
/* Places at most LOD_PLACED. */
enum { LOD_PLACED = 128 };
void lod_place_some(const lod *l, const uint32_t *vertices, size_t count);
/* Marks what the marked vertices need, from fine to coarse. */
tl_status lod_close(lod *l, tl_error *error);
/* Takes all marks away. */
void lod_clear(lod *l);
/* The mark of the vertex that splits a triangle of this depth: its index, or LOD_NONE. */
uint32_t lod_splitter(const lod *l, const lod_triangle *t, int depth, const scene_tile **last);
/* Depth of the triangles that a vertex splits. */
int lod_depth_of(const lod *l, int32_t x, int32_t y);

/* ---- lod_draw.c: triangles ---- */

/* A triangle that is drawn, with all that it is split into. */
typedef struct lod_leaf {
    lod_triangle triangle;
    int32_t depth;
} lod_leaf;

/* The mesh of leaves, which lie side by side. `heights`: of all vertices, in place of their own; may be NULL. */
tl_status lod_draw(lod *l, const lod_leaf *leaves, size_t count, const float *heights, tl_mesh **out, tl_error *error);
/* Only the number of its triangles. */
tl_status lod_count(lod *l, const lod_leaf *leaves, size_t count, uint64_t *triangles, tl_error *error);

/* ---- lod_morph.c ---- */

/* What of the pixel error a mesh is chosen at whose vertices move. */
#define LOD_MORPH (2. / 3)

/* Heights of all vertices, freed by free(), that lie between those of the mesh and of one of twice its pixel error; and
 * the most pixels by which one of them is beside its own. All vertices must be placed. */
tl_status lod_morph(lod *l, float **out, double *pixels, tl_error *error);

/* ---- Budgets ---- */

/* Tries pixel errors of a fixed sequence, 2^(k / 64) and the one that was asked for, for a small one that stays within
 * the budget, where the next smaller one does not or none gives more. `try` sets *fits; the last try is the result. */
typedef tl_status lod_try(void *context, double pixel_error, bool *fits, tl_error *error);
tl_status lod_search_budget(const lod *l, double least, int step, int *at, lod_try *try, void *context,
                            tl_error *error);
enum { LOD_BUDGET_START = 64 * 4, LOD_BUDGET_STEP = 64 };
double lod_now(void); /* seconds */
void lod_fill_stats(const lod *l, tl_lod_stats *out);
tl_status lod_describe(const lod *l, const tl_view *view, tl_mesh *mesh, tl_error *error);
/* Looks from a view, but places no vertices. */
void lod_turn(lod *l, const scene_view *view);
tl_status lod_mark_corners(lod *l, tl_error *error);

/* ---- The selectors ---- */

/* Marks the vertices for the pixel error (or bands) of `l`, and lists the leaves (lod_leaf). Stops, when `limit` is not
 * 0, with `overflow` soon after there are more leaves than that. */
typedef tl_status lod_selector(lod *l, uint64_t limit, lod_list *leaves, tl_error *error);
tl_status lod_quadtree(lod *l, uint64_t limit, lod_list *leaves, tl_error *error);
tl_status lod_chunk(lod *l, uint64_t limit, lod_list *leaves, tl_error *error);
/* tl_select by roam, which is lod_roam.c. */
tl_status lod_roam_once(const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid, const tl_view *view,
                        const tl_lod_options *options, tl_mesh **out, tl_lod_stats *stats, tl_error *error);
/* Whether the square of 2^log steps of the finest lattice at (x, y) is a chunk that is not divided: the log2 of its
 * step. *hidden becomes the rule that hides it, divided or not, or 0. */
bool lod_chunk_says(const struct lod_chunks *chunks, int32_t x, int32_t y, int log, int *step_log, unsigned *hidden);

/* For selectors: adds a leaf, and asks for what its drawing needs. */
tl_status lod_leave(lod *l, const lod_triangle *t, int depth, lod_list *leaves, tl_error *error);
/* Asks for the block of a triangle of lod_block_depth or more. */
tl_status lod_want_block(lod *l, lod_triangle *t, tl_error *error);
/* A cell with one void corner, at the end of its diagonal, is drawn with the other diagonal: by a half of it, a leaf,
 * and the one on the other side, whose right angle (*x, *y) must be there. False: not this one. */
bool lod_opposite(const lod *l, const lod_triangle *t, int32_t *x, int32_t *y);

/* The two triangles of depth 0. */
void lod_roots(const lod *l, lod_triangle out[2]);

#endif
