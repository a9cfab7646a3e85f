#include "lib/out/tile_list.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <assert.h>
#include <stdlib.h>
#include <string.h>

void out_tile_list_finish(out_tile_list *list)
{
    for (int k = 0; k < OUT_TILE_LEVELS; k++)
        free(list->levels[k].places);
    *list = (out_tile_list){0};
}

tl_status out_tile_list_add(out_tile_list *list, int level, int64_t column, int64_t row, tl_error *error)
{
    assert(level >= 0 && level < OUT_TILE_LEVELS);
    size_t *room = &list->levels[level].room, more = *room ? 2 * *room : 64;
    if (list->levels[level].count == *room) {
        out_tile_place *places = tl_alloc(more, sizeof *places);
        if (!places)
            return tl_fail_memory(error, "the list of tiles");
        if (*room)
            memcpy(places, list->levels[level].places, *room * sizeof *places);
        free(list->levels[level].places);
        list->levels[level].places = places;
        *room = more;
    }
    list->levels[level].places[list->levels[level].count++] = (out_tile_place){row, column};
    list->levels[level].sorted = false;
    return TL_OK;
}

static int compare(const void *a, const void *b)
{
    const out_tile_place *p = a, *q = b;
    if (p->row != q->row)
        return p->row < q->row ? -1 : 1;
    return (p->column > q->column) - (p->column < q->column);
}

void out_tile_list_sort(out_tile_list *list)
{
    for (int level = 0; level < OUT_TILE_LEVELS; level++) {
        out_tile_place *places = list->levels[level].places;
        size_t count = list->levels[level].count, kept = 0;
        if (list->levels[level].sorted || !count)
            continue;
        qsort(places, count, sizeof *places, compare);
        for (size_t k = 0; k < count; k++)
            if (!k || compare(&places[k], &places[kept - 1]) != 0)
                places[kept++] = places[k];
        list->levels[level].count = kept;
        list->levels[level].sorted = true;
    }
}

bool out_tile_list_has(const out_tile_list *list, int level, int64_t column, int64_t row)
{
    const out_tile_place key = {row, column};
    return list->levels[level].count &&
           bsearch(&key, list->levels[level].places, list->levels[level].count, sizeof key, compare) != NULL;
}

/* ---- Rectangles ---- */

typedef struct rectangle {
    int64_t start_x, end_x, start_y, end_y;
} rectangle;

/* Rectangles that may still grow upwards are those that end in the last row; they are kept in order of columns. */
typedef struct growing {
    rectangle *items;
    size_t count, first_open;
} growing;

/* A run of tiles in a row: on top of the rectangle with the same columns, or one of its own. */
static void add_run(growing *g, size_t *open, size_t open_end, int64_t start, int64_t end, int64_t row)
{
    while (*open < open_end && (g->items[*open].end_y != row - 1 || g->items[*open].start_x < start))
        ++*open;
    if (*open < open_end && g->items[*open].start_x == start && g->items[*open].end_x == end) {
        g->items[*open].end_y = row;
        /* moved to the end, so that those of the last row stand together */
        g->items[g->count++] = g->items[*open];
        g->items[*open].end_y = g->items[*open].start_y - 1; /* dropped */
        return;
    }
    g->items[g->count++] = (rectangle){start, end, row, row};
}

static json_t *to_json(const growing *g)
{
    json_t *list = json_array();
    for (size_t k = 0; k < g->count; k++) {
        const rectangle *r = &g->items[k];
        if (r->end_y >= r->start_y)
            json_array_append_new(list, json_pack("{s:I,s:I,s:I,s:I}", "startX", (json_int_t)r->start_x, "startY",
                                                  (json_int_t)r->start_y, "endX", (json_int_t)r->end_x, "endY",
                                                  (json_int_t)r->end_y));
    }
    return list;
}

static bool is_within(const out_tile_place *p, out_tile_place first, out_tile_place last)
{
    return p->column >= first.column && p->column <= last.column && p->row >= first.row && p->row <= last.row;
}

json_t *out_tile_list_ranges(const out_tile_list *list, int level, out_tile_place first, out_tile_place last)
{
    const out_tile_place *places = list->levels[level].places;
    size_t count = list->levels[level].count, open = 0, open_end = 0;
    growing g = {.items = tl_alloc(count + 1, sizeof *g.items)};
    if (!g.items)
        return NULL;
    int64_t row = INT64_MIN;
    for (size_t k = 0; k < count;) {
        if (!is_within(&places[k], first, last)) {
            k++;
            continue;
        }
        if (places[k].row != row) {
            row = places[k].row;
            open = open_end; /* what the row before last left is closed */
            open_end = g.count;
        }
        size_t end = k;
        while (end + 1 < count && places[end + 1].row == row && places[end + 1].column == places[end].column + 1 &&
               is_within(&places[end + 1], first, last))
            end++;
        add_run(&g, &open, open_end, places[k].column, places[end].column, row);
        k = end + 1;
    }
    json_t *ranges = to_json(&g);
    free(g.items);
    return ranges;
}
