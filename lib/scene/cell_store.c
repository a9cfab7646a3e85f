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

struct scene_cell_store {
    pthread_mutex_t lock;  /* over the blocks */
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

/* Takes what is there; the window around what is not, of no width where all is. */
static fbm_window take(scene_cell_store *store, fbm_window w, double *out)
{
    int64_t left = INT64_MAX, top = INT64_MAX, right = INT64_MIN, below = INT64_MIN;
    const int64_t i0 = w.i / SIDE, j0 = w.j / SIDE, i1 = i0 + (int64_t)w.width / SIDE,
                  j1 = j0 + (int64_t)w.height / SIDE;
    pthread_mutex_lock(&store->lock);
    for (int64_t j = j0; j < j1; j++)
        for (int64_t i = i0; i < i1; i++) {
            const block *b = *block_of(store, i, j);
            if (b && b->i == i && b->j == j) {
                copy_block(b->cells, SIDE, cells_in(w, out, i, j), w.width);
                continue;
            }
            left = tl_int64_min(left, i);
            top = tl_int64_min(top, j);
            right = tl_int64_max(right, i + 1);
            below = tl_int64_max(below, j + 1);
        }
    pthread_mutex_unlock(&store->lock);
    if (left > right)
        return (fbm_window){.width = 0};
    size_t width = (size_t)(right - left) * SIDE;
    return (fbm_window){left * SIDE, top * SIDE, width, (size_t)(below - top) * SIDE, width};
}

/* Hands out what was made, and keeps it where there is memory for it. */
static void keep(scene_cell_store *store, fbm_window made, double *numbers, fbm_window w, double *out)
{
    const int64_t i0 = made.i / SIDE, j0 = made.j / SIDE;
    pthread_mutex_lock(&store->lock);
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
    pthread_mutex_unlock(&store->lock);
}

tl_status scene_cell_store_read(scene_cell_store *store, fbm_window w, scene_cell_store_make make, const void *context,
                                double *out, const char *name, tl_error *error)
{
    assert(w.i % SIDE == 0 && w.j % SIDE == 0 && w.width % SIDE == 0 && w.height % SIDE == 0);
    fbm_window missing = take(store, w, out);
    if (missing.width == 0)
        return TL_OK;
    double *numbers = tl_alloc_grid((int64_t)missing.width, (int64_t)missing.height, sizeof *numbers);
    if (!numbers)
        return tl_fail_memory(error, name);
    tl_status status = make(context, missing, numbers, error);
    if (status == TL_OK)
        keep(store, missing, numbers, w, out);
    free(numbers);
    return status;
}
