#include "lib/scene/pyramid.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

enum { BASE_CELLS = 4096, SQUARE_LOG = 10, TILE_LOG = 6 };

static int64_t vertices(int64_t samples, int step)
{
    return tl_div_up(samples - 1, INT64_C(1) << step) + 1;
}

/* ---- one step coarser ---- */

/* The vertices first ... first + count - 1 of step k that vertex i of `coarse` vertices of step k + 1 is made of. */
static int parents(int64_t i, int64_t coarse, int64_t fine, int64_t *first)
{
    *first = i == 0 ? 0 : i == coarse - 1 ? fine - 1 : 2 * i - 1;
    return i == 0 || i == coarse - 1 ? 1 : 3;
}

static float mean(const scene_lattice *fine, int64_t x, int columns, int64_t y, int rows)
{
    static const float weights[2][3] = {{1, 0, 0}, {0.25f, 0.5f, 0.25f}};
    const float *row = fine->heights + (y - fine->window.y) * fine->window.width + (x - fine->window.x);
    float sum = 0, valid = 0;
    for (int j = 0; j < rows; j++, row += fine->window.width)
        for (int i = 0; i < columns; i++)
            if (!isnan(row[i])) {
                float weight = weights[columns > 1][i] * weights[rows > 1][j];
                sum += weight * row[i];
                valid += weight;
            }
    return valid >= 0.5f ? sum / valid : NAN;
}

static float mean_at(const scene_lattice *fine, const scene_lattice *coarse, int64_t x, int64_t y)
{
    int64_t left, up;
    int columns = parents(x, coarse->width, fine->width, &left), rows = parents(y, coarse->height, fine->height, &up);
    return mean(fine, left, columns, up, rows);
}

/* Means around every second sample of the middle of three rows, if all are valid; NaN or infinite otherwise. */
static void means_of_rows(const float *above, const float *row, const float *below, int64_t count, float *restrict out)
{
    for (int64_t i = 0; i < count; i++) {
        int64_t k = 2 * i;
        float corners = (above[k] + above[k + 2]) + (below[k] + below[k + 2]);
        float sides = (above[k + 1] + below[k + 1]) + (row[k] + row[k + 2]);
        out[i] = 0.0625f * corners + 0.125f * sides + 0.25f * row[k + 1];
    }
}

/* Fills coarse->heights for its window; fine's window must hold all that it is made of. */
static void coarsen(const scene_lattice *fine, scene_lattice *coarse)
{
    tl_window w = coarse->window, f = fine->window;
    int64_t first = tl_int64_max(w.x, 1), last = tl_int64_min(w.x + w.width, coarse->width - 1); /* those inside */
    for (int64_t y = w.y; y < w.y + w.height; y++) {
        float *out = coarse->heights + (y - w.y) * w.width - w.x;
        bool inside = y > 0 && y < coarse->height - 1 && first < last;
        if (inside) {
            const float *row = fine->heights + (2 * y - f.y) * f.width + (2 * first - 1 - f.x);
            means_of_rows(row - f.width, row, row + f.width, last - first, out + first);
        }
        for (int64_t x = w.x; x < w.x + w.width; x++)
            if (!inside || x < first || x >= last || !isfinite(out[x]))
                out[x] = mean_at(fine, coarse, x, y);
    }
}

static void span_finer(int64_t *first, int64_t *count, int64_t fine)
{
    int64_t low = tl_int64_max(0, 2 * *first - 1), high = tl_int64_min(fine - 1, 2 * (*first + *count - 1) + 1);
    *first = low;
    *count = high - low + 1;
}

/* The window of the next finer lattice that a window is made of. */
static tl_window finer(tl_window w, const scene_lattice *fine)
{
    span_finer(&w.x, &w.width, fine->width);
    span_finer(&w.y, &w.height, fine->height);
    return w;
}

static tl_window whole(const scene_lattice *l)
{
    return (tl_window){0, 0, l->width, l->height};
}

static tl_status hold(scene_lattice *l, tl_window window, tl_error *error)
{
    l->window = window;
    l->heights = tl_alloc_grid(window.width, window.height, sizeof *l->heights);
    return l->heights ? TL_OK : tl_fail_memory(error, "the view");
}

static tl_status read_lattice(const tl_source *source, scene_lattice *l, tl_error *error)
{
    tl_status status = tl_source_read(source, source->info.level, l->window, l->heights, error);
    if (status != TL_OK)
        return status;
    size_t count = (size_t)(l->window.width * l->window.height);
    for (size_t i = 0; i < count; i++)
        if (!isfinite(l->heights[i]))
            l->heights[i] = NAN;
    return TL_OK;
}

/* ---- the whole raster ---- */

/* Bounds of the samples x0 ... x1, y0 ... y1, as far as the lattice holds them. */
static scene_bounds bound(const scene_lattice *l, int64_t x0, int64_t x1, int64_t y0, int64_t y1)
{
    scene_bounds b = {INFINITY, -INFINITY};
    const tl_window w = l->window;
    x0 = tl_int64_max(x0, w.x);
    x1 = tl_int64_min(x1, w.x + w.width - 1);
    y1 = tl_int64_min(y1, w.y + w.height - 1);
    for (int64_t y = tl_int64_max(y0, w.y); y <= y1; y++) {
        const float *row = l->heights + (y - w.y) * w.width - w.x;
        for (int64_t x = x0; x <= x1; x++) {
            b.low = row[x] < b.low ? row[x] : b.low;
            b.high = row[x] > b.high ? row[x] : b.high;
        }
    }
    return b;
}

/* Bounds of the blocks in a square, with all the samples that vertices of the base in them are made of. */
static void bound_blocks(scene_pyramid *p, const scene_lattice *samples, int64_t column, int64_t row)
{
    const tl_source_info *info = &p->source->info;
    int64_t size = INT64_C(1) << p->block, each = INT64_C(1) << (p->square - p->block), margin = INT64_C(1) << p->base;
    int64_t columns = tl_div_up(info->width - 1, size), rows = tl_div_up(info->height - 1, size);
    for (int64_t y = row * each; y < tl_int64_min(rows, (row + 1) * each); y++)
        for (int64_t x = column * each; x < tl_int64_min(columns, (column + 1) * each); x++)
            p->bounds[0][y * columns + x] =
                bound(samples, x * size - margin, (x + 1) * size + margin, y * size - margin, (y + 1) * size + margin);
}

/* Vertices of the base in square k of one axis; the last square has the last vertex too. */
static void square_span(int64_t square, int cells_log, int64_t count, int64_t *first, int64_t *size)
{
    *first = square << cells_log;
    int64_t end = (square + 1) << cells_log;
    *size = (end >= count - 1 ? count : end) - *first;
}

/* Fills local[0 ... base] one after the other, each only as long as the next one needs it. */
static tl_status reduce(scene_pyramid *p, scene_lattice *local, int64_t column, int64_t row, tl_error *error)
{
    for (int k = 0; k <= p->base; k++) {
        tl_status status = hold(&local[k], local[k].window, error);
        if (status == TL_OK && k == 0)
            status = read_lattice(p->source, &local[0], error);
        if (status != TL_OK)
            return status;
        if (k == 0) {
            bound_blocks(p, &local[0], column, row);
        } else {
            coarsen(&local[k - 1], &local[k]);
            free(local[k - 1].heights);
            local[k - 1].heights = NULL;
        }
    }
    return TL_OK;
}

static tl_status read_square(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    scene_pyramid *p = context;
    scene_lattice *base = &p->lattices[p->base], local[SCENE_STEPS];
    int64_t columns = tl_div_up(p->source->info.width - 1, INT64_C(1) << p->square);
    int64_t column = (int64_t)item % columns, row = (int64_t)item / columns;
    tl_window w;
    square_span(column, p->square - p->base, base->width, &w.x, &w.width);
    square_span(row, p->square - p->base, base->height, &w.y, &w.height);
    memcpy(local, p->lattices, sizeof local);
    local[p->base].window = w;
    for (int k = 0; k <= p->base; k++)
        local[k].heights = NULL;
    for (int k = p->base - 1; k >= 0; k--)
        local[k].window = finer(local[k + 1].window, &local[k]);
    tl_status status = reduce(p, local, column, row, error);
    for (int64_t y = 0; y < w.height && status == TL_OK; y++)
        memcpy(base->heights + (w.y + y) * base->width + w.x, local[p->base].heights + y * w.width,
               (size_t)w.width * sizeof *base->heights);
    for (int k = 0; k <= p->base; k++)
        free(local[k].heights);
    return status;
}

static void merge_bounds(scene_pyramid *p, int k, int64_t columns, int64_t rows)
{
    int64_t finer_columns = p->block_columns[k - 1];
    for (int64_t y = 0; y < rows; y++)
        for (int64_t x = 0; x < columns; x++) {
            scene_bounds b = p->bounds[k - 1][y * finer_columns + x];
            scene_bounds *to = &p->bounds[k][y / 2 * p->block_columns[k] + x / 2];
            to->low = fminf(to->low, b.low);
            to->high = fmaxf(to->high, b.high);
        }
}

static tl_status allocate_bounds(scene_pyramid *p, tl_error *error)
{
    const tl_source_info *info = &p->source->info;
    for (int k = 0; k == 0 || p->block + k - 1 < p->top + TILE_LOG; k++) {
        int64_t size = INT64_C(1) << (p->block + k);
        int64_t columns = tl_div_up(info->width - 1, size), rows = tl_div_up(info->height - 1, size);
        p->block_columns[k] = columns;
        p->bounds[k] = tl_alloc_grid(columns, rows, sizeof *p->bounds[k]);
        if (!p->bounds[k])
            return tl_fail_memory(error, info->name);
        for (int64_t i = 0; i < columns * rows; i++)
            p->bounds[k][i] = (scene_bounds){INFINITY, -INFINITY};
        p->block_levels = k + 1;
    }
    return TL_OK;
}

static tl_status build(scene_pyramid *p, const tl_run *run, tl_error *error)
{
    const tl_source_info *info = &p->source->info;
    tl_status status = allocate_bounds(p, error);
    for (int k = p->base; k <= p->top && status == TL_OK; k++)
        status = hold(&p->lattices[k], whole(&p->lattices[k]), error);
    int64_t size = INT64_C(1) << p->square, block = INT64_C(1) << p->block;
    uint64_t squares = (uint64_t)(tl_div_up(info->width - 1, size) * tl_div_up(info->height - 1, size));
    if (status == TL_OK)
        status = tl_parallel_for(run, squares, (uint64_t)(info->width * info->height), read_square, p, error);
    for (int k = p->base + 1; k <= p->top && status == TL_OK; k++)
        coarsen(&p->lattices[k - 1], &p->lattices[k]);
    for (int k = 1; k < p->block_levels && status == TL_OK; k++) {
        int64_t finer_size = block << (k - 1);
        merge_bounds(p, k, tl_div_up(info->width - 1, finer_size), tl_div_up(info->height - 1, finer_size));
    }
    return status;
}

/* Of the lattices that are held, and the squares that are in work with the step after them. */
static double bytes_of(const scene_pyramid *p, const tl_run *run)
{
    double side = ldexp(1, p->square) + ldexp(4, p->base), samples = 0;
    for (int k = p->base; k <= p->top; k++)
        samples += (double)p->lattices[k].width * (double)p->lattices[k].height;
    side = fmin(side, (double)tl_int64_max(p->source->info.width, p->source->info.height));
    return sizeof(float) * (samples + 1.25 * side * side * tl_parallel_workers(run, UINT64_MAX));
}

tl_status scene_pyramid_init(scene_pyramid *pyramid, const tl_source *source, const tl_run *run, tl_error *error)
{
    *pyramid = (scene_pyramid){.source = source};
    int64_t longest = tl_int64_max(source->info.width, source->info.height);
    while (vertices(longest, pyramid->base) - 1 > BASE_CELLS)
        pyramid->base++;
    pyramid->top = pyramid->base;
    while (vertices(longest, pyramid->top) - 1 > SCENE_TILE)
        pyramid->top++;
    for (int k = 0; k <= pyramid->top; k++) {
        pyramid->lattices[k].width = vertices(source->info.width, k);
        pyramid->lattices[k].height = vertices(source->info.height, k);
    }
    /* read in squares of 1024 samples, whatever the raster's size, but of a cell of the base at least; bounds are those
     * of the base's tiles where a square holds such */
    pyramid->square = pyramid->base > SQUARE_LOG ? pyramid->base : SQUARE_LOG;
    pyramid->block = pyramid->base + TILE_LOG < pyramid->square ? pyramid->base + TILE_LOG : pyramid->square;
    tl_status status = tl_run_fits(run, bytes_of(pyramid, run), source->info.name, "drawing it", error);
    if (status == TL_OK)
        status = build(pyramid, run, error);
    if (status != TL_OK)
        scene_pyramid_finish(pyramid);
    return status;
}

void scene_pyramid_finish(scene_pyramid *pyramid)
{
    for (int k = 0; k < SCENE_STEPS; k++) {
        free(pyramid->lattices[k].heights);
        free(pyramid->bounds[k]);
    }
    *pyramid = (scene_pyramid){0};
}

scene_bounds scene_pyramid_bounds(const scene_pyramid *pyramid, int step, int64_t column, int64_t row)
{
    int log = step + TILE_LOG, k = log > pyramid->block ? log - pyramid->block : 0;
    int shift = log < pyramid->block ? pyramid->block - log : 0;
    return pyramid->bounds[k][(row >> shift) * pyramid->block_columns[k] + (column >> shift)];
}

/* ---- close-ups ---- */

/* The window of a coarser lattice that covers a window, with a cell more each way. */
static void span_coarser(int64_t *first, int64_t *count, int64_t coarse)
{
    int64_t low = tl_int64_max(0, *first / 2 - 1), high = tl_int64_min(coarse - 1, (*first + *count - 1) / 2 + 2);
    *first = low;
    *count = high - low + 1;
}

static tl_window join(tl_window a, tl_window b)
{
    int64_t x0 = tl_int64_min(a.x, b.x), x1 = tl_int64_max(a.x + a.width, b.x + b.width);
    int64_t y0 = tl_int64_min(a.y, b.y), y1 = tl_int64_max(a.y + a.height, b.y + b.height);
    return (tl_window){x0, y0, x1 - x0, y1 - y0};
}

/* What each lattice must hold: enough for those who look at it, and for the next coarser one to be made of. */
static void near_windows(scene_lattice *lattices, int step, int base, tl_window w)
{
    for (int k = 0; k < base; k++) {
        if (k > step) {
            span_coarser(&w.x, &w.width, lattices[k].width);
            span_coarser(&w.y, &w.height, lattices[k].height);
        }
        lattices[k].window = k < step ? (tl_window){0} : w;
    }
    for (int k = base - 2; k >= 0; k--) {
        tl_window needed = finer(lattices[k + 1].window, &lattices[k]);
        lattices[k].window = k < step ? needed : join(lattices[k].window, needed);
    }
}

tl_status scene_near_init(scene_lattice lattices[SCENE_STEPS], const scene_pyramid *pyramid, int step, tl_window w,
                          tl_error *error)
{
    memcpy(lattices, pyramid->lattices, sizeof pyramid->lattices);
    near_windows(lattices, step, pyramid->base, w);
    tl_status status = TL_OK;
    for (int k = 0; k < pyramid->base && status == TL_OK; k++) {
        status = hold(&lattices[k], lattices[k].window, error);
        if (status == TL_OK && k == 0)
            status = read_lattice(pyramid->source, &lattices[0], error);
        else if (status == TL_OK)
            coarsen(&lattices[k - 1], &lattices[k]);
    }
    if (status != TL_OK)
        scene_near_finish(lattices, pyramid);
    return status;
}

void scene_near_finish(scene_lattice lattices[SCENE_STEPS], const scene_pyramid *pyramid)
{
    for (int k = 0; k < pyramid->base; k++) {
        free(lattices[k].heights);
        lattices[k].heights = NULL;
    }
}
