#include "dem/bins.h"

#include "lib/base/size.h"

#include <math.h>
#include <string.h>

struct dem_bins {
    tl_window *rectangles;
    size_t count;
    tl_window bounds;
    int64_t width, height; /* of a bin */
    int64_t columns, rows; /* bins */
    size_t *start;         /* of each bin's numbers, row by row; one more at the end */
    uint32_t *numbers;
};

tl_window dem_window_common(tl_window a, tl_window b)
{
    int64_t x0 = tl_int64_max(a.x, b.x), x1 = tl_int64_min(a.x + a.width, b.x + b.width);
    int64_t y0 = tl_int64_max(a.y, b.y), y1 = tl_int64_min(a.y + a.height, b.y + b.height);
    return (tl_window){x0, y0, x1 - x0, y1 - y0};
}

bool dem_window_empty(tl_window window)
{
    return window.width <= 0 || window.height <= 0;
}

static tl_window bounds_of(const tl_window *rectangles, size_t count)
{
    int64_t x0 = INT64_MAX, y0 = INT64_MAX, x1 = INT64_MIN, y1 = INT64_MIN;
    for (size_t k = 0; k < count; k++) {
        x0 = tl_int64_min(x0, rectangles[k].x);
        y0 = tl_int64_min(y0, rectangles[k].y);
        x1 = tl_int64_max(x1, rectangles[k].x + rectangles[k].width);
        y1 = tl_int64_max(y1, rectangles[k].y + rectangles[k].height);
    }
    return (tl_window){x0, y0, x1 - x0, y1 - y0};
}

/* The bins that a window touches, in bins; empty where it lies outside. */
static tl_window touched(const dem_bins *bins, tl_window window)
{
    tl_window inside = dem_window_common(window, bins->bounds);
    if (dem_window_empty(inside))
        return (tl_window){0};
    int64_t x0 = (inside.x - bins->bounds.x) / bins->width, y0 = (inside.y - bins->bounds.y) / bins->height;
    int64_t x1 = (inside.x + inside.width - 1 - bins->bounds.x) / bins->width;
    int64_t y1 = (inside.y + inside.height - 1 - bins->bounds.y) / bins->height;
    return (tl_window){x0, y0, x1 - x0 + 1, y1 - y0 + 1};
}

static void divide(dem_bins *bins, int64_t columns, int64_t rows)
{
    bins->width = tl_div_up(bins->bounds.width, columns);
    bins->height = tl_div_up(bins->bounds.height, rows);
    bins->columns = tl_div_up(bins->bounds.width, bins->width);
    bins->rows = tl_div_up(bins->bounds.height, bins->height);
}

static double entries(const dem_bins *bins)
{
    double total = 0;
    for (size_t k = 0; k < bins->count; k++) {
        tl_window bin = touched(bins, bins->rectangles[k]);
        total += (double)bin.width * (double)bin.height;
    }
    return total;
}

/* About as many bins as rectangles, each of the rectangles' mean shape; fewer where the rectangles overlap so much that
 * most would be in most bins. */
static void choose_bins(dem_bins *bins)
{
    double shape = (double)bins->bounds.width / (double)bins->bounds.height;
    int64_t columns = llround(fmin(fmax(sqrt((double)bins->count * shape), 1), (double)bins->count));
    int64_t rows = tl_div_up((int64_t)bins->count, columns);
    divide(bins, columns, rows);
    while (entries(bins) > 8 * (double)bins->count + 64 && (columns > 1 || rows > 1)) {
        columns = tl_div_up(columns, 2);
        rows = tl_div_up(rows, 2);
        divide(bins, columns, rows);
    }
}

/* Counts, then places; going through the rectangles in order keeps every bin's numbers in order. */
static bool fill_bins(dem_bins *bins)
{
    size_t cells = (size_t)(bins->columns * bins->rows);
    bins->start = calloc(cells + 2, sizeof *bins->start);
    bins->numbers = tl_alloc((size_t)entries(bins), sizeof *bins->numbers);
    if (!bins->start || !bins->numbers)
        return false;
    for (int pass = 0; pass < 2; pass++) {
        for (size_t k = 0; k < bins->count; k++) {
            tl_window bin = touched(bins, bins->rectangles[k]);
            for (int64_t y = bin.y; y < bin.y + bin.height; y++)
                for (int64_t x = bin.x; x < bin.x + bin.width; x++) {
                    size_t *at = &bins->start[y * bins->columns + x + (pass ? 1 : 2)];
                    if (pass)
                        bins->numbers[*at] = (uint32_t)k;
                    ++*at;
                }
        }
        for (size_t k = 2; !pass && k < cells + 2; k++)
            bins->start[k] += bins->start[k - 1];
    }
    return true;
}

dem_bins *dem_bins_create(const tl_window *rectangles, size_t count)
{
    dem_bins *bins = calloc(1, sizeof *bins);
    if (!bins)
        return NULL;
    bins->rectangles = tl_alloc(count, sizeof *bins->rectangles);
    bins->count = count;
    if (bins->rectangles && count) {
        memcpy(bins->rectangles, rectangles, count * sizeof *rectangles);
        bins->bounds = bounds_of(rectangles, count);
        choose_bins(bins);
    }
    if (bins->rectangles && (!count || fill_bins(bins)))
        return bins;
    dem_bins_destroy(bins);
    return NULL;
}

void dem_bins_destroy(dem_bins *bins)
{
    if (!bins)
        return;
    free(bins->rectangles);
    free(bins->start);
    free(bins->numbers);
    free(bins);
}

static bool append(dem_hits *hits, uint32_t number)
{
    if (hits->count == hits->room) {
        size_t room = hits->room ? 2 * hits->room : 16;
        uint32_t *numbers = realloc(hits->numbers, room * sizeof *numbers);
        if (!numbers)
            return false;
        hits->numbers = numbers;
        hits->room = room;
    }
    hits->numbers[hits->count++] = number;
    return true;
}

/* A rectangle that lies in several of the bins is taken from the first of them alone. */
static bool search_bin(const dem_bins *bins, int64_t x, int64_t y, tl_window range, tl_window window, dem_hits *hits)
{
    size_t bin = (size_t)(y * bins->columns + x);
    for (size_t k = bins->start[bin]; k < bins->start[bin + 1]; k++) {
        tl_window rectangle = bins->rectangles[bins->numbers[k]];
        tl_window home = touched(bins, rectangle);
        if (tl_int64_max(home.x, range.x) != x || tl_int64_max(home.y, range.y) != y ||
            dem_window_empty(dem_window_common(rectangle, window)))
            continue;
        if (!append(hits, bins->numbers[k]))
            return false;
    }
    return true;
}

static int by_number(const void *a, const void *b)
{
    uint32_t first = *(const uint32_t *)a, second = *(const uint32_t *)b;
    return (first > second) - (first < second);
}

bool dem_bins_find(const dem_bins *bins, tl_window window, dem_hits *hits)
{
    hits->count = 0;
    if (!bins->count)
        return true;
    tl_window range = touched(bins, window);
    for (int64_t y = range.y; y < range.y + range.height; y++)
        for (int64_t x = range.x; x < range.x + range.width; x++)
            if (!search_bin(bins, x, y, range, window, hits))
                return false;
    if (hits->count > 1)
        qsort(hits->numbers, hits->count, sizeof *hits->numbers, by_number);
    return true;
}
