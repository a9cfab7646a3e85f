#include "lib/scene/cell_store.h"

#include "lib/base/error.h"
#include "lib/base/number.h"
#include "lib/base/size.h"

#include <assert.h>
#include <pthread.h>
#include <string.h>

/* Cells on a side of a block, and blocks that are kept: as many columns as the raster has, so that a row of windows
 * finds what the row above it left, but at least LEAST_ROWS rows of them. */
enum { SIDE = 8, CELLS = SIDE * SIDE, BLOCKS = 1 << 14, LEAST_ROWS = 16 };

typedef struct block {
    int64_t i, j;
    double cells[CELLS];
} block;

/* Blocks that a thread is making: those in a rectangle of them. It lies on the maker's stack. */
typedef struct claim {
    int64_t left, top, right, below;
    struct claim *next;
} claim;

struct scene_cell_store {
    pthread_mutex_t lock;   /* over the blocks and the claims */
    pthread_cond_t changed; /* a claim has gone */
    claim *claims;
    int64_t columns, rows; /* powers of 2: block (i, j) is kept at their remainders */
    block **blocks;        /* NULL: none yet */
};

scene_cell_store *scene_cell_store_create(int64_t width)
{
    scene_cell_store *store = calloc(1, sizeof *store);
    if (!store)
        return NULL;
    store->blocks = calloc(BLOCKS, sizeof *store->blocks);
    if (!store->blocks) {
        free(store);
        return NULL;
    }
    pthread_mutex_init(&store->lock, NULL);
    pthread_cond_init(&store->changed, NULL);
    store->columns = 16;
    while (store->columns < BLOCKS / LEAST_ROWS && store->columns * SIDE < width)
        store->columns *= 2;
    store->rows = BLOCKS / store->columns;
    return store;
}

void scene_cell_store_destroy(scene_cell_store *store)
{
    if (!store)
        return;
    pthread_mutex_destroy(&store->lock);
    pthread_cond_destroy(&store->changed);
    for (size_t k = 0; k < BLOCKS; k++)
        free(store->blocks[k]);
    free(store->blocks);
    free(store);
}

fbm_window scene_cell_store_window(fbm_window w)
{
    const int64_t side = SIDE, mask = side - 1;
    int64_t right = (w.i + (int64_t)w.width + mask) & ~mask, below = (w.j + (int64_t)w.height + mask) & ~mask;
    fbm_window out = {.i = w.i & ~mask, .j = w.j & ~mask};
    out.width = out.stride = (size_t)(right - out.i);
    out.height = (size_t)(below - out.j);
    return out;
}

static block **block_of(const scene_cell_store *store, int64_t i, int64_t j)
{
    return &store->blocks[(j & (store->rows - 1)) * store->columns + (i & (store->columns - 1))];
}

/* The first cell of block (i, j) in the numbers of a window. */
static double *cells_in(fbm_window w, double *numbers, int64_t i, int64_t j)
{
    return numbers + (size_t)(j * SIDE - w.j) * w.width + (size_t)(i * SIDE - w.i);
}

static void copy_block(const double *from, size_t from_stride, double *to, size_t to_stride)
{
    for (size_t row = 0; row < SIDE; row++)
        memcpy(to + row * to_stride, from + row * from_stride, SIDE * sizeof *to);
}

/* A rectangle of blocks, none where left >= right. */
typedef claim blocks;

static const blocks no_blocks = {INT64_MAX, INT64_MAX, INT64_MIN, INT64_MIN, NULL};

static void include(blocks *of, int64_t i, int64_t j)
{
    of->left = tl_int64_min(of->left, i);
    of->top = tl_int64_min(of->top, j);
    of->right = tl_int64_max(of->right, i + 1);
    of->below = tl_int64_max(of->below, j + 1);
}

static bool lies_in(const blocks *of, int64_t i, int64_t j)
{
    return i >= of->left && i < of->right && j >= of->top && j < of->below;
}

static bool covers(const blocks *of, const blocks *others)
{
    return of->left <= others->left && of->top <= others->top && of->right >= others->right &&
           of->below >= others->below;
}

static bool is_claimed(const scene_cell_store *store, int64_t i, int64_t j)
{
    for (const claim *c = store->claims; c; c = c->next)
        if (lies_in(c, i, j))
            return true;
    return false;
}

static void give_up(scene_cell_store *store, const claim *mine)
{
    claim **at = &store->claims;
    while (*at != mine)
        at = &(*at)->next;
    *at = mine->next;
    pthread_cond_broadcast(&store->changed);
}

/* Takes what is there of the blocks `of` of a window. What is not and nobody makes is to be made: the blocks around it;
 * true: there are none such, but some that another thread makes, `others` around these. Under the lock. */
static bool take(const scene_cell_store *store, fbm_window w, blocks of, double *out, blocks *missing, blocks *others)
{
    *missing = *others = no_blocks;
    for (int64_t j = of.top; j < of.below; j++)
        for (int64_t i = of.left; i < of.right; i++) {
            const block *b = *block_of(store, i, j);
            if (b && b->i == i && b->j == j)
                copy_block(b->cells, SIDE, cells_in(w, out, i, j), w.width);
            else
                include(is_claimed(store, i, j) ? others : missing, i, j);
        }
    return missing->left >= missing->right && others->left < others->right;
}

/* Hands out what was made, and keeps it where there is memory for it. Under the lock. */
static void keep(scene_cell_store *store, fbm_window made, double *numbers, fbm_window w, double *out)
{
    const int64_t i0 = made.i / SIDE, j0 = made.j / SIDE;
    for (int64_t j = j0; j < j0 + (int64_t)made.height / SIDE; j++)
        for (int64_t i = i0; i < i0 + (int64_t)made.width / SIDE; i++) {
            const double *from = cells_in(made, numbers, i, j);
            copy_block(from, made.width, cells_in(w, out, i, j), w.width);
            block **b = block_of(store, i, j);
            if (!*b)
                *b = malloc(sizeof **b);
            if (!*b)
                continue;
            (*b)->i = i;
            (*b)->j = j;
            copy_block(from, made.width, (*b)->cells, SIDE);
        }
}

/* Makes blocks that this thread has claimed. */
static tl_status make_blocks(scene_cell_store *store, const blocks *of, scene_cell_store_make make, const void *context,
                             fbm_window w, double *out, const char *name, tl_error *error)
{
    fbm_window made = {of->left * SIDE, of->top * SIDE, (size_t)(of->right - of->left) * SIDE,
                       (size_t)(of->below - of->top) * SIDE, (size_t)(of->right - of->left) * SIDE};
    double *numbers = tl_alloc_grid((int64_t)made.width, (int64_t)made.height, sizeof *numbers);
    tl_status status = numbers ? make(context, made, numbers, error) : tl_fail_memory(error, name);
    pthread_mutex_lock(&store->lock);
    if (status == TL_OK)
        keep(store, made, numbers, w, out);
    give_up(store, of);
    pthread_mutex_unlock(&store->lock);
    free(numbers);
    return status;
}

/* Who waits for another thread's blocks has made his own and claims none, so that nobody waits for him; what the other
 * failed to make, or what has lost its place since, he then makes himself. */
tl_status scene_cell_store_read(scene_cell_store *store, fbm_window w, scene_cell_store_make make, const void *context,
                                double *out, const char *name, tl_error *error)
{
    assert(w.i % SIDE == 0 && w.j % SIDE == 0 && w.width % SIDE == 0 && w.height % SIDE == 0);
    blocks wanted = {w.i / SIDE, w.j / SIDE, w.i / SIDE + (int64_t)w.width / SIDE,
                     w.j / SIDE + (int64_t)w.height / SIDE, NULL};
    while (wanted.left < wanted.right) {
        blocks missing, others;
        pthread_mutex_lock(&store->lock);
        while (take(store, w, wanted, out, &missing, &others)) {
            wanted = others;
            pthread_cond_wait(&store->changed, &store->lock);
        }
        const bool any = missing.left < missing.right;
        if (any) {
            missing.next = store->claims;
            store->claims = &missing;
        }
        pthread_mutex_unlock(&store->lock);
        tl_status status = any ? make_blocks(store, &missing, make, context, w, out, name, error) : TL_OK;
        if (status != TL_OK)
            return status;
        wanted = any && covers(&missing, &others) ? no_blocks : others;
    }
    return TL_OK;
}
