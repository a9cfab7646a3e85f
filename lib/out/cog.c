#include "lib/out/cog.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <stdio.h>
#include <string.h>

enum {
    TILE_OFFSETS = 324,
    TILE_BYTE_COUNTS = 325,
    TYPE_SHORT = 3,
    TYPE_LONG = 4,
    TYPE_LONG8 = 16,
    MOST_IMAGES = 64,
    MOST_ENTRIES = 128,
    LEADER = 4 /* bytes before a tile and behind it */
};

/* What readers of GDAL's kind may rely on: tiles row by row, before each its size and behind it its last four bytes
 * again, so that one request fetches a tile whose offset alone is known. [gdal.org: Cloud Optimized GeoTIFF driver] */
static const char ghost[] = "GDAL_STRUCTURAL_METADATA_SIZE=000140 bytes\n"
                            "LAYOUT=IFDS_BEFORE_DATA\n"
                            "BLOCK_ORDER=ROW_MAJOR\n"
                            "BLOCK_LEADER=SIZE_AS_UINT4\n"
                            "BLOCK_TRAILER=LAST_4_BYTES_REPEATED\n"
                            "KNOWN_INCOMPATIBLE_EDITION=NO\n ";
_Static_assert(sizeof ghost - 1 == 43 + 140, "the ghost states its own size");

typedef struct entry {
    unsigned tag, type;
    uint64_t count;
    unsigned char *bytes;
} entry;

typedef struct image {
    entry entries[MOST_ENTRIES];
    size_t entry_count;
    uint64_t tiles;
    uint64_t *offsets, *sizes; /* in the file that is read */
} image;

typedef struct cog {
    const tl_output *from;
    tl_output *to;
    image *images;
    size_t image_count;
    bool big;
    uint64_t largest; /* tile, in bytes */
} cog;

/* ---- Numbers in bytes, least significant first ---- */

static uint64_t get(const unsigned char *bytes, size_t count)
{
    uint64_t value = 0;
    for (size_t k = count; k-- > 0;)
        value = value << 8 | bytes[k];
    return value;
}

static void put(unsigned char *bytes, size_t count, uint64_t value)
{
    for (size_t k = 0; k < count; k++, value >>= 8)
        bytes[k] = (unsigned char)value;
}

static size_t size_of(unsigned type)
{
    static const unsigned char sizes[] = {0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4, 0, 0, 8, 8, 8};
    return type < sizeof sizes ? sizes[type] : 0;
}

/* ---- Reading ---- */

static tl_status malformed(const cog *c, tl_error *error)
{
    return tl_fail(error, TL_ERROR_DATA, "%s: the TIFF that was to be put in order is not as it was written",
                   tl_output_path(c->to));
}

static tl_status read_entry(const cog *c, const unsigned char raw[20], entry *out, tl_error *error)
{
    *out = (entry){.tag = (unsigned)get(raw, 2), .type = (unsigned)get(raw + 2, 2), .count = get(raw + 4, 8)};
    size_t bytes;
    if (!size_of(out->type) || out->count > SIZE_MAX / 2 ||
        !tl_size_mul((size_t)out->count, size_of(out->type), &bytes))
        return malformed(c, error);
    out->bytes = tl_alloc(bytes + 8, 1);
    if (!out->bytes)
        return tl_fail_memory(error, tl_output_path(c->to));
    if (bytes > 8)
        return tl_output_read_at(c->from, out->bytes, bytes, get(raw + 12, 8), error);
    memcpy(out->bytes, raw + 12, 8);
    return TL_OK;
}

static uint64_t *numbers_of(const entry *e)
{
    uint64_t *numbers = tl_alloc((size_t)e->count, sizeof *numbers);
    size_t size = size_of(e->type);
    for (uint64_t k = 0; numbers && k < e->count; k++)
        numbers[k] = get(e->bytes + k * size, size);
    return numbers;
}

/* Takes the tiles' places out of the entries. */
static tl_status take_tiles(const cog *c, image *out, tl_error *error)
{
    for (size_t k = 0; k < out->entry_count; k++) {
        const entry *e = &out->entries[k];
        if (e->tag == TILE_OFFSETS)
            out->offsets = numbers_of(e), out->tiles = e->count;
        else if (e->tag == TILE_BYTE_COUNTS && e->count == out->tiles)
            out->sizes = numbers_of(e);
    }
    return out->offsets && out->sizes ? TL_OK : malformed(c, error);
}

static tl_status read_image(const cog *c, uint64_t *at, image *out, tl_error *error)
{
    unsigned char head[8], raw[20];
    tl_status status = tl_output_read_at(c->from, head, sizeof head, *at, error);
    uint64_t count = status == TL_OK ? get(head, 8) : 0;
    if (status == TL_OK && (count == 0 || count > MOST_ENTRIES))
        return malformed(c, error);
    for (uint64_t k = 0; status == TL_OK && k < count; k++) {
        status = tl_output_read_at(c->from, raw, sizeof raw, *at + 8 + 20 * k, error);
        if (status == TL_OK)
            status = read_entry(c, raw, &out->entries[out->entry_count++], error);
    }
    if (status == TL_OK)
        status = take_tiles(c, out, error);
    if (status == TL_OK)
        status = tl_output_read_at(c->from, head, sizeof head, *at + 8 + 20 * count, error);
    *at = get(head, 8);
    return status;
}

static tl_status read_images(cog *c, tl_error *error)
{
    unsigned char head[16];
    tl_status status = tl_output_read_at(c->from, head, sizeof head, 0, error);
    uint64_t at = status == TL_OK ? get(head + 8, 8) : 0;
    while (status == TL_OK && at && c->image_count < MOST_IMAGES) {
        image *next = &c->images[c->image_count++];
        status = read_image(c, &at, next, error);
        for (uint64_t k = 0; status == TL_OK && k < next->tiles; k++) {
            c->largest = next->sizes[k] > c->largest ? next->sizes[k] : c->largest;
            if (next->sizes[k] < LEADER || next->sizes[k] > UINT32_MAX)
                status = malformed(c, error);
        }
    }
    return status == TL_OK && at ? malformed(c, error) : status;
}

/* ---- The new layout ---- */

/* Bytes of a place in the file. */
static size_t place_size(const cog *c)
{
    return c->big ? 8 : 4;
}

static bool is_place(const entry *e)
{
    return e->tag == TILE_OFFSETS || e->tag == TILE_BYTE_COUNTS;
}

/* Bytes of an entry's values as they will be written: sizes of tiles take 32 bits. */
static uint64_t value_size(const cog *c, const entry *e)
{
    size_t one = e->tag == TILE_OFFSETS ? place_size(c) : e->tag == TILE_BYTE_COUNTS ? 4 : size_of(e->type);
    return e->count * one;
}

/* What its values take behind the directory. */
static uint64_t room_of(const cog *c, const entry *e)
{
    uint64_t bytes = value_size(c, e);
    return bytes <= place_size(c) ? 0 : (bytes + 1) / 2 * 2;
}

static uint64_t directory_size(const cog *c, const image *i)
{
    return c->big ? 8 + 20 * i->entry_count + 8 : 2 + 12 * i->entry_count + 4;
}

static uint64_t head_size(const cog *c)
{
    return ((c->big ? 16 : 8) + sizeof ghost - 1 + 1) / 2 * 2;
}

static uint64_t tables_size(const cog *c)
{
    uint64_t bytes = head_size(c);
    for (size_t k = 0; k < c->image_count; k++) {
        const image *i = &c->images[k];
        bytes += directory_size(c, i);
        for (size_t n = 0; n < i->entry_count; n++)
            bytes += room_of(c, &i->entries[n]);
    }
    return bytes;
}

static uint64_t tiles_size(const image *i)
{
    uint64_t bytes = 0;
    for (uint64_t k = 0; k < i->tiles; k++)
        bytes += i->sizes[k] + 2 * LEADER;
    return bytes;
}

/* Values of an entry; tiles of the image begin at `first`. */
static void put_values(const cog *c, const image *i, const entry *e, uint64_t first, unsigned char *to)
{
    size_t place = place_size(c);
    if (!is_place(e))
        memcpy(to, e->bytes, (size_t)value_size(c, e));
    for (uint64_t k = 0; is_place(e) && k < i->tiles; k++) {
        if (e->tag == TILE_OFFSETS)
            put(to + k * place, place, first + LEADER);
        else
            put(to + 4 * k, 4, i->sizes[k]);
        first += i->sizes[k] + 2 * LEADER;
    }
}

/* One directory at `at`. Small values go behind it, from *values on, places of tiles to *places. */
static void put_directory(const cog *c, const image *i, uint64_t at, uint64_t *values, uint64_t *places, uint64_t first,
                          uint64_t next, unsigned char *tables)
{
    size_t place = place_size(c), step = c->big ? 20 : 12;
    unsigned char *to = tables + at;
    put(to, c->big ? 8 : 2, i->entry_count);
    to += c->big ? 8 : 2;
    for (size_t k = 0; k < i->entry_count; k++, to += step) {
        const entry *e = &i->entries[k];
        unsigned type = e->tag == TILE_BYTE_COUNTS ? TYPE_LONG
                        : e->tag == TILE_OFFSETS   ? c->big ? TYPE_LONG8 : TYPE_LONG
                                                   : e->type;
        uint64_t room = room_of(c, e), *free_place = is_place(e) ? places : values;
        put(to, 2, e->tag);
        put(to + 2, 2, type);
        put(to + 4, place, e->count);
        put_values(c, i, e, first, room ? tables + *free_place : to + 4 + place);
        if (room)
            put(to + 4 + place, place, *free_place);
        *free_place += room;
    }
    put(to, place, next);
}

static void put_head(const cog *c, unsigned char *to)
{
    memcpy(to, "II", 2);
    put(to + 2, 2, c->big ? 43 : 42);
    if (c->big)
        put(to + 4, 2, 8);
    put(to + (c->big ? 8 : 4), place_size(c), head_size(c));
    memcpy(to + (c->big ? 16 : 8), ghost, sizeof ghost - 1);
}

/* All that goes before the tiles: directories with their values, then where all tiles are. */
static tl_status write_tables(const cog *c, tl_error *error)
{
    uint64_t size = tables_size(c), first = size, at = head_size(c), places = at;
    unsigned char *tables = calloc(1, (size_t)size);
    if (!tables)
        return tl_fail_memory(error, tl_output_path(c->to));
    put_head(c, tables);
    for (size_t k = 0; k < c->image_count; k++) {
        const image *i = &c->images[k];
        first += tiles_size(i);
        places += directory_size(c, i);
        for (size_t n = 0; n < i->entry_count; n++)
            places += is_place(&i->entries[n]) ? 0 : room_of(c, &i->entries[n]);
    }
    for (size_t k = 0; k < c->image_count; k++) {
        const image *i = &c->images[k];
        uint64_t values = at + directory_size(c, i), next = values;
        for (size_t n = 0; n < i->entry_count; n++)
            next += is_place(&i->entries[n]) ? 0 : room_of(c, &i->entries[n]);
        first -= tiles_size(i); /* the finest level's are the last */
        put_directory(c, i, at, &values, &places, first, k + 1 < c->image_count ? next : 0, tables);
        at = next;
    }
    tl_status status = tl_output_append(c->to, tables, (size_t)size, error);
    free(tables);
    return status;
}

static tl_status copy_tile(const cog *c, uint64_t from, size_t size, unsigned char *room, tl_error *error)
{
    put(room, LEADER, size);
    tl_status status = tl_output_read_at(c->from, room + LEADER, size, from, error);
    memcpy(room + LEADER + size, room + size, LEADER);
    return status == TL_OK ? tl_output_append(c->to, room, size + 2 * LEADER, error) : status;
}

static tl_status copy_tiles(const cog *c, const tl_run *run, tl_error *error)
{
    unsigned char *room = tl_alloc((size_t)c->largest + 2 * LEADER, 1);
    tl_status status = room ? TL_OK : tl_fail_memory(error, tl_output_path(c->to));
    for (size_t k = c->image_count; k-- > 0 && status == TL_OK;) {
        const image *i = &c->images[k];
        for (uint64_t tile = 0; tile < i->tiles && status == TL_OK; tile++) {
            status = tl_run_check(run, error);
            if (status == TL_OK)
                status = copy_tile(c, i->offsets[tile], (size_t)i->sizes[tile], room, error);
        }
    }
    free(room);
    return status;
}

static void release(cog *c)
{
    for (size_t k = 0; k < c->image_count; k++) {
        for (size_t n = 0; n < c->images[k].entry_count; n++)
            free(c->images[k].entries[n].bytes);
        free(c->images[k].offsets);
        free(c->images[k].sizes);
    }
    free(c->images);
}

tl_status out_cog_write(const tl_output *from, tl_output *to, const tl_run *run, tl_error *error)
{
    cog c = {.from = from, .to = to, .images = calloc(MOST_IMAGES, sizeof(image))};
    if (!c.images)
        return tl_fail_memory(error, tl_output_path(to));
    tl_status status = read_images(&c, error);
    uint64_t size = tables_size(&c);
    for (size_t k = 0; status == TL_OK && k < c.image_count; k++)
        size += tiles_size(&c.images[k]);
    c.big = size > UINT32_MAX;
    if (status == TL_OK)
        status = write_tables(&c, error);
    if (status == TL_OK)
        status = copy_tiles(&c, run, error);
    release(&c);
    return status == TL_OK ? tl_output_flush(to, error) : status;
}
