/* Which tiles of a pyramid there are. */
#ifndef OUT_TILE_LIST_H
#define OUT_TILE_LIST_H

#include "lib/talus.h"

#include <jansson.h>

enum { OUT_TILE_LEVELS = 32 };

typedef struct out_tile_place {
    int64_t row, column; /* from the south-west */
} out_tile_place;

typedef struct out_tile_list {
    struct {
        out_tile_place *places;
        size_t count, room;
        bool sorted;
    } levels[OUT_TILE_LEVELS];
} out_tile_list;

void out_tile_list_finish(out_tile_list *list);
tl_status out_tile_list_add(out_tile_list *list, int level, int64_t column, int64_t row, tl_error *error);
/* Sorts what was added, and drops what was added twice. */
void out_tile_list_sort(out_tile_list *list);
/* Of a sorted list. */
bool out_tile_list_has(const out_tile_list *list, int level, int64_t column, int64_t row);

/* The tiles of a level with columns and rows from first to last, as rectangles: [{"startX", "startY", "endX", "endY"}],
 * ends included. Of a sorted list; NULL when out of memory. */
json_t *out_tile_list_ranges(const out_tile_list *list, int level, out_tile_place first, out_tile_place last);

#endif
