#include "lib/scene/tile_cache.h"

#include "dem/framework_pyramid.h"
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/scene/field.h"

#include <assert.h>
#include <math.h>
#include <string.h>

enum {
    SQUARES = 4096 + 1024 + 256 + 64 + 16 + 4 + 1, /* of 1 ... 64 cells */
    WIDE_SQUARES = 256 + 64 + 16 + 4 + 1,          /* of 4 ... 64 cells */
    BLOCK_MARGIN = 1,
    BLOCK_SAMPLES = SCENE_TILE + 1 + 2 * BLOCK_MARGIN,
    NOMINAL_BLOCK = 256, /* of models that are read in blocks of no certain size */
};

struct scene_block {
    uint64_t key;
    bool made;
    uint16_t strength[SQUARES], bend[SQUARES], rise[SQUARES]; /* upper halves of floats, rounded up */
    float low[WIDE_SQUARES], high[WIDE_SQUARES];
    bool voids[WIDE_SQUARES];
};

/* A set of things with a `key` as their first member, by open addressing. */
typedef struct table {
    void **items;
    size_t room, count; /* room: a power of two, or 0 */
} table;

struct scene_tiles {
    const tl_source *field, *dem;
    const tl_pyramid *pyramid;
    int levels;
    size_t memory; /* bytes; 0: any */
    table tiles;
    scene_block **blocks;
    size_t block_count, block_room, made_blocks;
    table block_table; /* of `numbered` */
    scene_tile **pending;
    size_t pending_count, pending_room;
    uint64_t clock;
    scene_tile_counts counts;
    int64_t dem_columns, dem_rows; /* of blocks of the model */
    uint64_t *touched;             /* a bit for each */
};

typedef struct numbered {
    uint64_t key;
    uint32_t number;
} numbered;

/* ---- Tables ---- */

static uint64_t mix(uint64_t key)
{
    key ^= key >> 32;
    key *= UINT64_C(0x9e3779b97f4a7c15);
    return key ^ key >> 29;
}

static void *table_find(const table *t, uint64_t key)
{
    for (size_t at = mix(key) & (t->room - 1); t->room; at = (at + 1) & (t->room - 1)) {
        void *item = t->items[at];
        uint64_t here;
        if (!item)
            return NULL;
        memcpy(&here, item, sizeof here);
        if (here == key)
            return item;
    }
    return NULL;
}

static void table_put(table *t, void *item)
{
    uint64_t key;
    memcpy(&key, item, sizeof key);
    size_t at = mix(key) & (t->room - 1);
    while (t->items[at])
        at = (at + 1) & (t->room - 1);
    t->items[at] = item;
    t->count++;
}

/* Room for one more. */
static bool table_grow(table *t)
{
    if (2 * (t->count + 1) <= t->room)
        return true;
    table bigger = {calloc(t->room ? 2 * t->room : 1024, sizeof(void *)), t->room ? 2 * t->room : 1024, 0};
    if (!bigger.items)
        return false;
    for (size_t k = 0; k < t->room; k++)
        if (t->items[k])
            table_put(&bigger, t->items[k]);
    free(t->items);
    *t = bigger;
    return true;
}

/* ---- Life ---- */

scene_tiles *scene_tiles_create(const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid, int levels,
                                const tl_run *run, tl_error *error)
{
    scene_tiles *t = calloc(1, sizeof *t);
    if (!t) {
        tl_fail_memory(error, "the view's tiles");
        return NULL;
    }
    t->field = field;
    t->dem = dem;
    t->pyramid = pyramid;
    t->levels = levels;
    t->memory = run ? run->memory : 0;
    int64_t width = dem->info.block_width ? dem->info.block_width : NOMINAL_BLOCK;
    int64_t height = dem->info.block_height ? dem->info.block_height : NOMINAL_BLOCK;
    t->dem_columns = tl_div_up(dem->info.width, width);
    t->dem_rows = tl_div_up(dem->info.height, height);
    t->touched = calloc((size_t)(t->dem_columns * t->dem_rows / 64 + 1), sizeof *t->touched);
    if (t->touched)
        return t;
    scene_tiles_destroy(t);
    tl_fail_memory(error, "the view's tiles");
    return NULL;
}

void scene_tiles_destroy(scene_tiles *t)
{
    if (!t)
        return;
    for (size_t k = 0; k < t->tiles.room; k++)
        free(t->tiles.items[k]);
    for (size_t k = 0; k < t->block_table.room; k++)
        free(t->block_table.items[k]);
    for (size_t k = 0; k < t->block_count; k++)
        free(t->blocks[k]);
    free(t->tiles.items);
    free(t->block_table.items);
    free(t->blocks);
    free(t->pending);
    free(t->touched);
    free(t);
}

scene_tile_counts scene_tiles_counts(const scene_tiles *t)
{
    return t->counts;
}

void scene_tiles_count_again(scene_tiles *t)
{
    t->counts = (scene_tile_counts){0};
    memset(t->touched, 0, (size_t)(t->dem_columns * t->dem_rows / 64 + 1) * sizeof *t->touched);
}

/* Counts what a window of the model costs. */
static void count_dem(scene_tiles *t, tl_window w)
{
    const tl_source_info *info = &t->dem->info;
    int64_t width = info->block_width ? info->block_width : NOMINAL_BLOCK;
    int64_t height = info->block_height ? info->block_height : NOMINAL_BLOCK;
    if (w.width <= 0 || w.height <= 0)
        return;
    t->counts.dem_samples += (uint64_t)(w.width * w.height);
    for (int64_t y = w.y / height; y <= (w.y + w.height - 1) / height; y++)
        for (int64_t x = w.x / width; x <= (w.x + w.width - 1) / width; x++) {
            uint64_t block = (uint64_t)(y * t->dem_columns + x), bit = UINT64_C(1) << (block & 63);
            t->counts.dem_blocks += !(t->touched[block >> 6] & bit);
            t->touched[block >> 6] |= bit;
        }
}

/* ---- Where a vertex is ---- */

static int key_level(uint64_t key)
{
    return (int)(key >> 58) - 31;
}

static int64_t key_x(uint64_t key)
{
    return (int64_t)(key >> 29 & ((1 << 29) - 1));
}

static int64_t key_y(uint64_t key)
{
    return (int64_t)(key & ((1 << 29) - 1));
}

static uint64_t key_of(int level, int64_t x, int64_t y)
{
    return (uint64_t)(level + 31) << 58 | (uint64_t)x << 29 | (uint64_t)y;
}

/* The tile level of a vertex; its key and slot. */
static inline uint64_t place_of(const scene_tiles *t, int32_t x, int32_t y, uint32_t *at)
{
    uint32_t both = (uint32_t)x | (uint32_t)y;
    int stage = both ? __builtin_ctz(both) : 30, level = t->levels - stage;
    if (level <= -TL_OVERVIEW_LOG)
        level = -TL_OVERVIEW_LOG - (-level - TL_OVERVIEW_LOG) / SCENE_TILE_LOG * SCENE_TILE_LOG;
    else if (level < 0)
        level = 0;
    int shift = t->levels - level;
    uint32_t i = (uint32_t)x >> shift, j = (uint32_t)y >> shift;
    *at = (j & (SCENE_TILE - 1)) << SCENE_TILE_LOG | (i & (SCENE_TILE - 1));
    return key_of(level, i >> SCENE_TILE_LOG, j >> SCENE_TILE_LOG);
}

scene_slot scene_tiles_find(const scene_tiles *t, int32_t x, int32_t y, const scene_tile **last)
{
    scene_slot slot;
    uint64_t key = place_of(t, x, y, &slot.at);
    slot.tile = *last && (*last)->key == key ? (scene_tile *)*last : table_find(&t->tiles, key);
    if (slot.tile)
        *last = slot.tile;
    return slot;
}

void scene_slot_mark(scene_slot s, uint32_t vertex)
{
    s.tile->marks[s.at >> SCENE_TILE_LOG] |= UINT64_C(1) << (s.at & (SCENE_TILE - 1));
    s.tile->slots[s.at].vertex = vertex;
    s.tile->marked++;
}

void scene_slot_unmark(scene_slot s, float z)
{
    s.tile->marks[s.at >> SCENE_TILE_LOG] &= ~(UINT64_C(1) << (s.at & (SCENE_TILE - 1)));
    s.tile->slots[s.at].z = z;
    s.tile->marked--;
}

/* ---- Wanting ---- */

/* Doubles an array that is full. */
static bool grow(void **items, size_t count, size_t *room, size_t size)
{
    if (count < *room)
        return true;
    size_t more = *room ? 2 * *room : 256;
    size_t bytes;
    void *bigger = tl_size_mul(more, size, &bytes) ? realloc(*items, bytes) : NULL;
    if (!bigger)
        return false;
    *items = bigger;
    *room = more;
    return true;
}

size_t scene_tiles_bytes(const scene_tiles *t)
{
    return t->tiles.count * sizeof(scene_tile) + t->block_count * sizeof(scene_block);
}

/* Tiles below level 0 are parts of the pyramid's overview. */
static void fill_by_overview(const scene_tiles *t, scene_tile *tile)
{
    const tl_pyramid *p = t->pyramid;
    int shift = -key_level(tile->key) - TL_OVERVIEW_LOG;
    for (int64_t k = 0; k < SCENE_TILE_SLOTS; k++) {
        int64_t x = ((key_x(tile->key) << SCENE_TILE_LOG) + k % SCENE_TILE) << shift;
        int64_t y = ((key_y(tile->key) << SCENE_TILE_LOG) + k / SCENE_TILE) << shift;
        tile->slots[k].z =
            x < p->overview_columns && y < p->overview_rows ? p->overview[y * p->overview_columns + x] : NAN;
    }
    tile->made = true;
}

static tl_status add_tile(scene_tiles *t, uint64_t key, scene_tile **out, tl_error *error)
{
    if (!table_grow(&t->tiles) || !(*out = malloc(sizeof **out)))
        return tl_fail_memory(error, "the view's tiles");
    **out = (scene_tile){.key = key};
    table_put(&t->tiles, *out);
    return TL_OK;
}

tl_status scene_tiles_want(scene_tiles *t, int32_t x, int32_t y, scene_slot *out, tl_error *error)
{
    uint64_t key = place_of(t, x, y, &out->at);
    out->tile = table_find(&t->tiles, key);
    t->counts.tiles_used++;
    if (!out->tile) {
        tl_status status = add_tile(t, key, &out->tile, error);
        if (status != TL_OK)
            return status;
        if (key_level(key) >= 0) {
            if (!grow((void **)&t->pending, t->pending_count, &t->pending_room, sizeof(scene_tile *)))
                return tl_fail_memory(error, "the view's tiles");
            t->pending[t->pending_count++] = out->tile;
        } else
            fill_by_overview(t, out->tile);
    }
    out->tile->wanted = t->clock;
    return TL_OK;
}

tl_status scene_tiles_want_block(scene_tiles *t, int64_t i, int64_t j, uint32_t *block, tl_error *error)
{
    uint64_t key = key_of(0, i >> SCENE_TILE_LOG, j >> SCENE_TILE_LOG);
    numbered *found = table_find(&t->block_table, key);
    if (found) {
        *block = found->number;
        return TL_OK;
    }
    if (!table_grow(&t->block_table) ||
        !grow((void **)&t->blocks, t->block_count, &t->block_room, sizeof(scene_block *)))
        return tl_fail_memory(error, "the view's tiles");
    found = malloc(sizeof *found);
    scene_block *made = found ? malloc(sizeof *made) : NULL;
    if (!made) {
        free(found);
        return tl_fail_memory(error, "the view's tiles");
    }
    *found = (numbered){key, (uint32_t)t->block_count};
    made->key = key;
    made->made = false;
    t->blocks[t->block_count++] = made;
    table_put(&t->block_table, found);
    *block = found->number;
    return TL_OK;
}

bool scene_tiles_find_block(const scene_tiles *t, int64_t i, int64_t j, uint32_t *block)
{
    const numbered *found = table_find(&t->block_table, key_of(0, i >> SCENE_TILE_LOG, j >> SCENE_TILE_LOG));
    if (!found || !t->blocks[found->number]->made)
        return false;
    *block = found->number;
    return true;
}

/* ---- Making tiles ---- */

static tl_window within(tl_window w, int64_t width, int64_t height)
{
    int64_t right = tl_int64_min(w.x + w.width, width), bottom = tl_int64_min(w.y + w.height, height);
    tl_window out = {tl_int64_max(w.x, 0), tl_int64_max(w.y, 0), 0, 0};
    out.width = tl_int64_max(right - out.x, 0);
    out.height = tl_int64_max(bottom - out.y, 0);
    return out;
}

/* The part of a tile that is on the raster. */
static tl_window tile_window(const scene_tiles *t, const scene_tile *tile)
{
    int level = key_level(tile->key);
    tl_window w = {key_x(tile->key) << SCENE_TILE_LOG, key_y(tile->key) << SCENE_TILE_LOG, SCENE_TILE, SCENE_TILE};
    const tl_source_info *dem = &t->dem->info;
    return within(w, ((dem->width - 1) << level) + 1, ((dem->height - 1) << level) + 1);
}

static tl_status make_tile(const scene_tiles *t, scene_tile *tile, tl_error *error)
{
    float heights[SCENE_TILE_SLOTS];
    tl_window w = tile_window(t, tile);
    int level = key_level(tile->key);
    tl_status status = TL_OK;
    if (w.width && w.height)
        status = tl_source_read(level ? t->field : t->dem, level, w, heights, error);
    if (status != TL_OK)
        return status;
    if (w.width && w.height)
        tl_heights_clean(heights, (size_t)(w.width * w.height));
    for (int64_t y = 0; y < SCENE_TILE; y++)
        for (int64_t x = 0; x < SCENE_TILE; x++)
            tile->slots[y * SCENE_TILE + x].z = x < w.width && y < w.height ? heights[y * w.width + x] : NAN;
    tile->made = true;
    return TL_OK;
}

/* ---- Making blocks ---- */

static uint16_t upper_half(float value)
{
    uint32_t bits;
    value = value < 3e38F ? value : 3e38F;
    memcpy(&bits, &value, sizeof bits);
    return (uint16_t)((bits + 0xffff) >> 16);
}

static float from_half(uint16_t half)
{
    uint32_t bits = (uint32_t)half << 16;
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Samples of a block and BLOCK_MARGIN around it; NaN beyond the raster. */
typedef struct block_ground {
    float z[BLOCK_SAMPLES * BLOCK_SAMPLES], strength[(SCENE_TILE + 1) * (SCENE_TILE + 1)];
} block_ground;

static tl_status read_ground(const scene_tiles *t, const scene_block *block, block_ground *g, tl_error *error)
{
    int64_t x = key_x(block->key) << SCENE_TILE_LOG, y = key_y(block->key) << SCENE_TILE_LOG;
    tl_window all = {x - BLOCK_MARGIN, y - BLOCK_MARGIN, BLOCK_SAMPLES, BLOCK_SAMPLES};
    tl_window w = within(all, t->dem->info.width, t->dem->info.height);
    float *read = tl_alloc((size_t)(w.width * w.height), sizeof *read);
    tl_status status = read ? tl_source_read(t->dem, 0, w, read, error) : tl_fail_memory(error, "the view's tiles");
    for (int k = 0; k < BLOCK_SAMPLES * BLOCK_SAMPLES; k++)
        g->z[k] = NAN;
    if (status == TL_OK) {
        tl_heights_clean(read, (size_t)(w.width * w.height));
        for (int64_t r = 0; r < w.height; r++)
            memcpy(g->z + (w.y - all.y + r) * BLOCK_SAMPLES + w.x - all.x, read + r * w.width,
                   (size_t)w.width * sizeof *read);
        tl_window vertices = {x, y, SCENE_TILE + 1, SCENE_TILE + 1};
        if (t->field->info.level > 0)
            status = scene_field_strengths(t->field, vertices, g->strength, error);
        else
            memset(g->strength, 0, sizeof g->strength);
    }
    free(read);
    return status;
}

static inline float at_least(float a, float b)
{
    return b > a ? b : a; /* a where b is NaN */
}

/* Half of the second difference around a sample, along rows and columns. */
static float second(const float *z, ptrdiff_t step)
{
    return fabsf(z[-step] - 2 * z[0] + z[step]);
}

/* Smooth ground between samples is off the plane of a triangle by at most an eighth of its second derivative along the
 * hypotenuse, here the diagonal of a cell, over the square of that: z_xx + 2 z_xy + z_yy. */
static void find_cell(const block_ground *g, int x, int y, scene_cells *out)
{
    const float *z = g->z + (y + BLOCK_MARGIN) * BLOCK_SAMPLES + x + BLOCK_MARGIN;
    const float *s = g->strength + y * (SCENE_TILE + 1) + x;
    const ptrdiff_t down = BLOCK_SAMPLES;
    float across = 0, along = 0, twist = at_least(0, fabsf(z[0] - z[1] - z[down] + z[down + 1]));
    for (int k = 0; k < 4; k++) {
        const float *corner = z + (k & 1) + (k >> 1) * down;
        across = at_least(across, second(corner, 1));
        along = at_least(along, second(corner, down));
    }
    *out = (scene_cells){.bend = (across + along + 2 * twist) / 8,
                         .strength = at_least(at_least(s[0], s[1]), at_least(s[SCENE_TILE + 1], s[SCENE_TILE + 2]))};
    out->rise = at_least(at_least(0, fabsf(z[1] - z[0])), fabsf(z[down] - z[0]));
    out->rise = at_least(at_least(out->rise, fabsf(z[down + 1] - z[1])), fabsf(z[down + 1] - z[down]));
}

/* Where the squares of 2^log cells begin. */
static int first_square(int log)
{
    int first = 0;
    for (int k = 0; k < log; k++)
        first += SCENE_TILE_SLOTS >> 2 * k;
    return first;
}

static void merge_squares(uint16_t *values)
{
    for (int log = 1; log <= SCENE_TILE_LOG; log++) {
        const uint16_t *from = values + first_square(log - 1);
        uint16_t *to = values + first_square(log);
        int side = SCENE_TILE >> log;
        for (int k = 0; k < side * side; k++) {
            const uint16_t *four = from + k / side * 2 * (2 * side) + k % side * 2;
            uint16_t a = four[0] > four[1] ? four[0] : four[1];
            uint16_t b = four[2 * side] > four[2 * side + 1] ? four[2 * side] : four[2 * side + 1];
            to[k] = a > b ? a : b;
        }
    }
}

/* The range of samples of every square of 4 cells or more, its rim included. */
static void find_ranges(const block_ground *g, scene_block *block)
{
    const int base = first_square(2);
    for (int log = 2; log <= SCENE_TILE_LOG; log++) {
        int side = SCENE_TILE >> log, first = first_square(log) - base, finer = first_square(log - 1) - base;
        for (int k = 0; k < side * side; k++) {
            float low = HUGE_VALF, high = -HUGE_VALF;
            bool voids = false;
            for (int m = 0; log == 2 && m < 25; m++) {
                float z =
                    g->z[(k / side * 4 + m / 5 + BLOCK_MARGIN) * BLOCK_SAMPLES + k % side * 4 + m % 5 + BLOCK_MARGIN];
                low = z < low ? z : low;
                high = z > high ? z : high;
                voids = voids || isnan(z);
            }
            for (int m = 0; log > 2 && m < 4; m++) {
                int part = finer + (2 * (k / side) + m / 2) * 2 * side + 2 * (k % side) + m % 2;
                low = block->low[part] < low ? block->low[part] : low;
                high = block->high[part] > high ? block->high[part] : high;
                voids = voids || block->voids[part];
            }
            block->voids[first + k] = voids;
            block->low[first + k] = low;
            block->high[first + k] = high;
        }
    }
}

static tl_status make_block(const scene_tiles *t, scene_block *block, tl_error *error)
{
    block_ground *g = malloc(sizeof *g);
    tl_status status = g ? read_ground(t, block, g, error) : tl_fail_memory(error, "the view's tiles");
    for (int k = 0; status == TL_OK && k < SCENE_TILE_SLOTS; k++) {
        scene_cells cell;
        find_cell(g, k % SCENE_TILE, k / SCENE_TILE, &cell);
        block->strength[k] = upper_half(cell.strength);
        block->bend[k] = upper_half(cell.bend);
        block->rise[k] = upper_half(cell.rise);
    }
    if (status == TL_OK) {
        merge_squares(block->strength);
        merge_squares(block->bend);
        merge_squares(block->rise);
        find_ranges(g, block);
        block->made = true;
    }
    free(g);
    return status;
}

void scene_block_at(const scene_tiles *t, uint32_t number, int64_t i, int64_t j, int log, scene_cells *out)
{
    const scene_block *block = t->blocks[number];
    assert(block->made);
    int side = SCENE_TILE >> log, x = (int)(i & (SCENE_TILE - 1)) >> log, y = (int)(j & (SCENE_TILE - 1)) >> log;
    int at = first_square(log) + y * side + x, wide = at - first_square(2);
    *out = (scene_cells){.strength = from_half(block->strength[at]),
                         .bend = from_half(block->bend[at]),
                         .rise = from_half(block->rise[at])};
    if (log >= 2) {
        out->low = block->low[wide];
        out->high = block->high[wide];
        out->voids = block->voids[wide];
    }
}

/* ---- All that was wanted ---- */

static tl_status make_item(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    scene_tiles *t = context;
    (void)loop;
    (void)worker;
    size_t blocks = t->block_count - t->made_blocks;
    if (item < blocks)
        return make_block(t, t->blocks[t->made_blocks + item], error);
    item -= blocks;
    return make_tile(t, t->pending[item], error);
}

/* Drops tiles without marks that were not wanted since the last time. */
static tl_status make_room(scene_tiles *t, tl_error *error)
{
    if (!t->memory || scene_tiles_bytes(t) <= t->memory)
        return TL_OK;
    table left = {calloc(t->tiles.room, sizeof(void *)), t->tiles.room, 0};
    if (!left.items)
        return tl_fail_memory(error, "the view's tiles");
    for (size_t k = 0; k < t->tiles.room; k++) {
        scene_tile *tile = t->tiles.items[k];
        if (tile && (tile->marked || tile->wanted == t->clock))
            table_put(&left, tile);
        else
            free(tile);
    }
    free(t->tiles.items);
    t->tiles = left;
    if (scene_tiles_bytes(t) <= t->memory)
        return TL_OK;
    return tl_fail(error, TL_ERROR_MEMORY,
                   "%s: the tiles that this view needs take %.0f MB, and %.0f may be used; allow more memory, or a "
                   "larger pixel error",
                   t->dem->info.name, ceil((double)scene_tiles_bytes(t) * 1e-6), floor((double)t->memory * 1e-6));
}

static void count_wanted(scene_tiles *t)
{
    for (size_t k = t->made_blocks; k < t->block_count; k++) {
        uint64_t key = t->blocks[k]->key;
        tl_window w = {key_x(key) << SCENE_TILE_LOG, key_y(key) << SCENE_TILE_LOG, SCENE_TILE + 1, SCENE_TILE + 1};
        count_dem(t, scene_field_support(t->field, 0, w));
    }
    for (size_t k = 0; k < t->pending_count; k++) {
        int level = key_level(t->pending[k]->key);
        tl_window w = tile_window(t, t->pending[k]);
        if (!w.width || !w.height)
            continue;
        count_dem(t, level > 0 ? scene_field_support(t->field, level, w) : w);
        t->counts.tiles_made += level > 0;
        t->counts.samples_made += level > 0 ? (uint64_t)(w.width * w.height) : 0;
    }
}

tl_status scene_tiles_make(scene_tiles *t, const tl_run *run, tl_error *error)
{
    uint64_t items = t->block_count - t->made_blocks + t->pending_count;
    tl_status status = make_room(t, error);
    t->clock++;
    if (status != TL_OK || !items)
        return status;
    count_wanted(t);
    tl_run quiet = run ? *run : (tl_run){0};
    quiet.progress = NULL;
    status = tl_parallel_for(&quiet, items, 0, make_item, t, error);
    t->made_blocks = t->block_count;
    t->pending_count = 0;
    return status;
}
