/* What a file holds beside its samples: reduced copies, and what reading a part of it costs. The file is opened again,
 * so that sources need not keep what only few ask for. */
#include "dem/raster.h"
#include "dem/tiff_layout.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <string.h>

enum { MAX_DIRECTORIES = 4096 };

typedef struct inspection {
    dem_file *file;
    dem_tiff_file *tiff;
    dem_tiff_handle *handle;
} inspection;

static void finish(inspection *self)
{
    if (self->handle)
        dem_tiff_drop(self->tiff, self->handle);
    dem_tiff_file_destroy(self->tiff);
    dem_file_close(self->file);
}

static tl_status begin(inspection *self, const char *path, tl_error *error)
{
    tl_error own = {0};
    *self = (inspection){.file = dem_file_open(path, NULL, &own)};
    self->tiff = self->file ? dem_tiff_file_create(self->file, &own) : NULL;
    if (self->tiff)
        dem_tiff_take(self->tiff, 0, &self->handle, &own);
    if (self->handle)
        return TL_OK;
    finish(self);
    if (error)
        *error = own;
    return own.status;
}

static bool is_reduced(TIFF *tiff)
{
    uint32_t kind = 0;
    TIFFGetField(tiff, TIFFTAG_SUBFILETYPE, &kind);
    return (kind & FILETYPE_REDUCEDIMAGE) && !(kind & FILETYPE_MASK);
}

tl_status tl_dem_get_overviews(const tl_source *dem, tl_dem_size *out, unsigned capacity, unsigned *count,
                               tl_error *error)
{
    tl_dem_details details;
    inspection self;
    tl_status status = tl_dem_get_details(dem, &details, error);
    if (status != TL_OK || !details.overviews) {
        *count = status == TL_OK ? 0 : *count;
        return status;
    }
    status = begin(&self, dem->info.name, error);
    if (status != TL_OK)
        return status;
    unsigned found = 0;
    TIFF *tiff = self.handle->tiff;
    for (unsigned k = 0; k < MAX_DIRECTORIES && found < capacity && TIFFReadDirectory(tiff); k++) {
        uint32_t width = 0, height = 0;
        if (!is_reduced(tiff) || !TIFFGetField(tiff, TIFFTAG_IMAGEWIDTH, &width) ||
            !TIFFGetField(tiff, TIFFTAG_IMAGELENGTH, &height))
            continue;
        out[found++] = (tl_dem_size){width, height};
    }
    *count = found;
    status = dem_tiff_check(self.handle, error);
    finish(&self);
    return status;
}

/* Blocks from the first to the last, both included. */
typedef struct span {
    int64_t left, top, right, bottom;
} span;

static span blocks_of(tl_window w, int64_t block_width, int64_t block_height)
{
    return (span){w.x / block_width, w.y / block_height, (w.x + w.width - 1) / block_width,
                  (w.y + w.height - 1) / block_height};
}

/* A block without bytes is a hole in a sparse file. */
static uint64_t stored_bytes(TIFF *tiff, const dem_layout *layout, span blocks)
{
    uint64_t bytes = 0;
    int64_t first = layout->separate ? (int64_t)layout->band * layout->across * layout->down : 0;
    for (int64_t row = blocks.top; row <= blocks.bottom; row++)
        for (int64_t column = blocks.left; column <= blocks.right; column++) {
            int failed = 0;
            uint64_t count =
                TIFFGetStrileByteCountWithErr(tiff, (uint32_t)(first + row * layout->across + column), &failed);
            bytes += failed ? 0 : count;
        }
    return bytes;
}

static tl_status tiff_cost(const tl_source *dem, unsigned band, tl_window window, tl_dem_cost *out, tl_error *error)
{
    inspection self;
    dem_layout layout;
    tl_status status = begin(&self, dem->info.name, error);
    if (status != TL_OK)
        return status;
    status = dem_layout_read(self.handle, band, &layout, error);
    if (status == TL_OK && (layout.width != dem->info.width || layout.height != dem->info.height))
        status = tl_fail(error, TL_ERROR_IO, "%s: has changed since it was opened", dem->info.name);
    if (status == TL_OK) {
        span blocks = blocks_of(window, layout.block_width, layout.block_height);
        uint64_t count = (uint64_t)(blocks.right - blocks.left + 1) * (uint64_t)(blocks.bottom - blocks.top + 1);
        *out = (tl_dem_cost){count, stored_bytes(self.handle->tiff, &layout, blocks),
                             count * (uint64_t)layout.block_height * (uint64_t)layout.row_bytes};
    }
    finish(&self);
    return status;
}

tl_status tl_dem_get_cost(const tl_source *dem, tl_window window, tl_dem_cost *out, tl_error *error)
{
    tl_dem_details details;
    tl_status status = tl_dem_get_details(dem, &details, error);
    if (status != TL_OK)
        return status;
    if (!dem_hgt_details(dem, &details))
        return tiff_cost(dem, details.band, window, out, error);
    uint64_t bytes = 2 * (uint64_t)dem->info.width * (uint64_t)window.height; /* rows of int16 */
    *out = (tl_dem_cost){(uint64_t)window.height, bytes, bytes};
    return TL_OK;
}
