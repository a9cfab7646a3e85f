/* The unit of decoding and caching is the chunk: a tile, a strip, or some rows of a strip that is too large to be kept
 * whole. Chunks are numbered row by row of the raster: (block row * chunks a block + part) * blocks across + column. */
#include "dem/tiff_blocks.h"

#include "dem/tiff_samples.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

struct dem_blocks {
    dem_tiff_file *file;
    uint64_t directory;
    dem_layout layout;
    dem_block_cache *cache;
    uint64_t first_key; /* of chunk 0 in the cache */
    int64_t parts;      /* chunks a block */
};

typedef struct chunk {
    int64_t index;
    int64_t column, row; /* of the block, in blocks */
    int64_t first, rows; /* rows of the raster, within the block; rows beyond the raster's last are not among them */
} chunk;

dem_blocks *dem_blocks_create(dem_tiff_file *file, uint64_t directory, const dem_layout *layout, dem_block_cache *cache,
                              tl_error *error)
{
    dem_blocks *blocks = malloc(sizeof *blocks);
    if (!blocks) {
        tl_fail_memory(error, dem_tiff_file_path(file));
        return NULL;
    }
    *blocks = (dem_blocks){.file = file,
                           .directory = directory,
                           .layout = *layout,
                           .cache = cache,
                           .first_key = dem_block_cache_keys(cache),
                           .parts = tl_div_up(layout->block_height, layout->chunk_rows)};
    return blocks;
}

void dem_blocks_destroy(dem_blocks *blocks)
{
    free(blocks);
}

static uint64_t key_of(const dem_blocks *blocks, const chunk *self)
{
    return blocks->first_key + (uint64_t)self->index;
}

static chunk chunk_at(const dem_blocks *blocks, int64_t column, int64_t y)
{
    const dem_layout *layout = &blocks->layout;
    chunk self = {.column = column, .row = y / layout->block_height};
    int64_t top = self.row * layout->block_height, part = (y - top) / layout->chunk_rows;
    self.index = (self.row * blocks->parts + part) * layout->across + column;
    self.first = top + part * layout->chunk_rows;
    int64_t end = tl_int64_min(self.first + layout->chunk_rows, top + layout->block_height);
    self.rows = tl_int64_min(end, layout->height) - self.first;
    return self;
}

/* ---- Decoding ---- */

static uint32_t block_number(const dem_layout *layout, const chunk *self)
{
    int64_t plane = layout->separate ? (int64_t)layout->band * layout->across * layout->down : 0;
    return (uint32_t)(plane + self->row * layout->across + self->column);
}

static tl_status fail_block(const dem_blocks *blocks, const chunk *self, const dem_tiff_handle *handle, tl_error *error)
{
    const dem_layout *layout = &blocks->layout;
    int64_t x = self->column * layout->block_width;
    return tl_fail(error, TL_ERROR_DATA,
                   "%s: the %s at column %lld, row %lld cannot be decoded (is the file complete?): %s",
                   dem_tiff_file_path(blocks->file), layout->tiled ? "tile" : "strip", (long long)x,
                   (long long)self->first, dem_tiff_message(handle, "it holds too few bytes"));
}

/* Whether a block of `bytes` compressed bytes can hold the chunk: a check against files of a few bytes that would have
 * gigabytes allocated. Small ones are left to the decoder, which tells more. */
static bool is_plausible(const dem_layout *layout, const chunk *self, uint64_t bytes)
{
    int64_t expansion = dem_codec_expansion(layout->codec), decoded = layout->row_bytes * self->rows;
    return !expansion || decoded < (1 << 18) || (double)bytes * (double)expansion >= (double)decoded;
}

/* Rows of a block, each `row_bytes` long, to heights. */
static void convert_rows(const dem_layout *layout, const chunk *self, const char *rows, float *heights)
{
    for (int64_t row = 0; row < self->rows; row++)
        dem_samples_to_heights(layout, rows + row * layout->row_bytes, (size_t)layout->block_width,
                               heights + row * layout->block_width);
}

static tl_status decode_block(dem_blocks *blocks, const chunk *self, dem_tiff_handle *handle, float *heights,
                              tl_error *error)
{
    const dem_layout *layout = &blocks->layout;
    /* rows of a tile below the raster's last are not asked for: some writers leave them out */
    tmsize_t bytes = (tmsize_t)(self->rows * layout->row_bytes);
    char *raw = dem_tiff_scratch(handle, (size_t)bytes);
    if (!raw)
        return tl_fail_memory(error, dem_tiff_file_path(blocks->file));
    memset(raw, 0, (size_t)bytes); /* some decoders call it a success when they fill in a part */
    uint32_t number = block_number(layout, self);
    tmsize_t got = layout->tiled ? TIFFReadEncodedTile(handle->tiff, number, raw, bytes)
                                 : TIFFReadEncodedStrip(handle->tiff, number, raw, bytes);
    tl_status status = got == bytes ? TL_OK : fail_block(blocks, self, handle, error);
    if (status == TL_OK)
        convert_rows(layout, self, raw, heights);
    return status;
}

/* Decides what a block's table entry says before anything is allocated for it. */
static tl_status look_up_block(const dem_blocks *blocks, const chunk *self, dem_tiff_handle *handle, bool *sparse,
                               tl_error *error)
{
    int failed = 0;
    uint64_t bytes = TIFFGetStrileByteCountWithErr(handle->tiff, block_number(&blocks->layout, self), &failed);
    if (failed)
        return fail_block(blocks, self, handle, error);
    *sparse = bytes == 0;
    uint64_t size = (uint64_t)dem_tiff_file_size(blocks->file); /* whatever the table says */
    if (*sparse || is_plausible(&blocks->layout, self, bytes < size ? bytes : size))
        return TL_OK;
    return fail_block(blocks, self, handle, error);
}

/* *heights stays NULL for a sparse block. */
static tl_status decode_whole(dem_blocks *blocks, const chunk *self, dem_tiff_handle *handle, float **heights,
                              tl_error *error)
{
    const dem_layout *layout = &blocks->layout;
    bool sparse;
    tl_status status = look_up_block(blocks, self, handle, &sparse, error);
    if (status != TL_OK || sparse)
        return status;
    *heights = tl_alloc_grid(layout->block_width, self->rows, sizeof **heights);
    if (!*heights)
        return tl_fail_memory(error, dem_tiff_file_path(blocks->file));
    status = decode_block(blocks, self, handle, *heights, error);
    if (status != TL_OK)
        free(*heights);
    return status;
}

static tl_status load_whole(dem_blocks *blocks, const chunk *self, dem_cached_block **out, tl_error *error)
{
    float *heights = NULL;
    dem_tiff_handle *handle;
    tl_status status = dem_tiff_take(blocks->file, blocks->directory, &handle, error);
    if (status != TL_OK)
        return status;
    status = decode_whole(blocks, self, handle, &heights, error);
    dem_tiff_give_back(blocks->file, handle);
    if (status != TL_OK || !heights)
        return status;
    *out = dem_block_cache_add(blocks->cache, key_of(blocks, self), heights,
                               (size_t)(blocks->layout.block_width * self->rows));
    return *out ? TL_OK : tl_fail_memory(error, dem_tiff_file_path(blocks->file));
}

/* ---- Large strips: decoded from the top, by one handle that remembers how far it is ---- */

/* Decodes the rows of one chunk at the stream's place. */
static tl_status decode_rows(dem_blocks *blocks, const chunk *self, dem_tiff_handle *handle, char *row, float *heights,
                             tl_error *error)
{
    const dem_layout *layout = &blocks->layout;
    for (int64_t k = 0; k < self->rows; k++) {
        uint16_t plane = layout->separate ? (uint16_t)layout->band : 0;
        memset(row, 0, (size_t)layout->row_bytes);
        if (TIFFReadScanline(handle->tiff, row, (uint32_t)(self->first + k), plane) != 1)
            return fail_block(blocks, self, handle, error);
        dem_samples_to_heights(layout, row, (size_t)layout->width, heights + k * layout->width);
    }
    return TL_OK;
}

static tl_status stream_chunk(dem_blocks *blocks, const chunk *self, dem_tiff_handle *handle, dem_cached_block **out,
                              tl_error *error)
{
    const dem_layout *layout = &blocks->layout;
    tl_status status = TL_OK;
    float *heights = tl_alloc_grid(layout->width, self->rows, sizeof *heights);
    char *row = malloc((size_t)layout->row_bytes);
    if (!heights || !row)
        status = tl_fail_memory(error, dem_tiff_file_path(blocks->file));
    else
        status = decode_rows(blocks, self, handle, row, heights, error);
    free(row);
    if (status != TL_OK) {
        free(heights);
        handle->next_row = INT64_MAX; /* wherever it stands: start again */
        return status;
    }
    handle->next_row = self->first + self->rows;
    *out = dem_block_cache_add(blocks->cache, key_of(blocks, self), heights, (size_t)(layout->width * self->rows));
    return *out ? TL_OK : tl_fail_memory(error, dem_tiff_file_path(blocks->file));
}

/* Every row above must be decoded first; what passes by goes into the cache, for it is likely to be wanted too. */
static tl_status stream_to(dem_blocks *blocks, const chunk *self, dem_tiff_handle *handle, dem_cached_block **out,
                           tl_error *error)
{
    int64_t top = self->row * blocks->layout.block_height;
    bool sparse;
    tl_status status = look_up_block(blocks, self, handle, &sparse, error);
    if (status != TL_OK || sparse)
        return status;
    int64_t from = handle->next_row > top && handle->next_row <= self->first ? handle->next_row : top;
    for (int64_t y = from;;) {
        chunk at = chunk_at(blocks, 0, y);
        status = stream_chunk(blocks, &at, handle, out, error);
        if (status != TL_OK || at.index == self->index)
            return status;
        dem_block_cache_unpin(blocks->cache, *out);
        y = at.first + at.rows;
    }
}

static tl_status load_streamed(dem_blocks *blocks, const chunk *self, dem_cached_block **out, tl_error *error)
{
    dem_tiff_handle *handle;
    tl_status status = dem_tiff_take_kept(blocks->file, blocks, &handle, error);
    if (status == TL_OK && !handle)
        status = dem_tiff_take(blocks->file, blocks->directory, &handle, error);
    if (status != TL_OK)
        return status;
    status = stream_to(blocks, self, handle, out, error);
    dem_tiff_keep(blocks->file, handle, blocks);
    return status;
}

/* ---- Reading ---- */

/* The chunk, pinned; NULL where the file leaves its block out. */
static tl_status get_chunk(dem_blocks *blocks, const chunk *self, dem_cached_block **out, tl_error *error)
{
    uint64_t key = key_of(blocks, self);
    *out = dem_block_cache_find(blocks->cache, key);
    if (*out)
        return TL_OK;
    bool streamed = blocks->parts > 1;
    uint64_t lock = streamed ? blocks->first_key : key;
    dem_block_cache_lock(blocks->cache, lock);
    tl_status status = TL_OK;
    *out = dem_block_cache_find(blocks->cache, key);
    if (!*out)
        status = (streamed ? load_streamed : load_whole)(blocks, self, out, error);
    dem_block_cache_unlock(blocks->cache, lock);
    return status;
}

/* What stands in a block that is left out: nodata, as the samples' type holds it, or 0. A nodata value outside of the
 * type is the nearest number of it, as for GDAL, and then no void. */
static double absent_sample(const dem_layout *layout)
{
    if (!layout->has_nodata || layout->kind == DEM_SAMPLE_FLOAT)
        return layout->has_nodata ? layout->nodata : 0;
    bool has_sign = layout->kind == DEM_SAMPLE_INT;
    double high = ldexp(1, layout->bits - has_sign) - 1, low = has_sign ? -high - 1 : 0;
    return isnan(layout->nodata) ? 0 : fmin(fmax(round(layout->nodata), low), high);
}

/* Copies what a chunk and the window share; `heights` NULL: a block that is left out. */
static void copy_chunk(const dem_layout *layout, const chunk *self, const float *heights, tl_window window, float *out)
{
    int64_t left = self->column * layout->block_width;
    int64_t x0 = tl_int64_max(window.x, left), x1 = tl_int64_min(window.x + window.width, left + layout->block_width);
    int64_t y0 = tl_int64_max(window.y, self->first);
    int64_t y1 = tl_int64_min(window.y + window.height, self->first + self->rows);
    float absent = dem_height_of(&layout->rule, absent_sample(layout));
    for (int64_t y = y0; y < y1; y++) {
        float *row = out + (y - window.y) * window.width + (x0 - window.x);
        if (heights)
            memcpy(row, heights + (y - self->first) * layout->block_width + (x0 - left),
                   (size_t)(x1 - x0) * sizeof *row);
        for (int64_t k = 0; !heights && k < x1 - x0; k++)
            row[k] = absent;
    }
}

static tl_status read_chunk(dem_blocks *blocks, const chunk *self, tl_window window, float *out, tl_error *error)
{
    dem_cached_block *block;
    tl_status status = get_chunk(blocks, self, &block, error);
    if (status != TL_OK)
        return status;
    copy_chunk(&blocks->layout, self, block ? dem_cached_block_heights(block) : NULL, window, out);
    if (block)
        dem_block_cache_unpin(blocks->cache, block);
    return TL_OK;
}

tl_status dem_blocks_read(dem_blocks *blocks, tl_window window, float *out, tl_error *error)
{
    const dem_layout *layout = &blocks->layout;
    if (window.width == 0 || window.height == 0)
        return TL_OK;
    int64_t last_column = (window.x + window.width - 1) / layout->block_width;
    for (int64_t y = window.y; y < window.y + window.height;) {
        chunk at = {0};
        for (int64_t column = window.x / layout->block_width; column <= last_column; column++) {
            at = chunk_at(blocks, column, y);
            tl_status status = read_chunk(blocks, &at, window, out, error);
            if (status != TL_OK)
                return status;
        }
        y = at.first + at.rows;
    }
    return TL_OK;
}
