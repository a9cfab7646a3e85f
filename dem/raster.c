#include "lib/talus.h"

#include "dem/crs.h"
#include "dem/geokeys.h"
#include "dem/tiff_blocks.h"
#include "lib/base/error.h"

#include <stdlib.h>
#include <string.h>

enum { CACHE_BYTES = 64 << 20 };

typedef struct dem_source {
    tl_source source;
    dem_tiff_file *file;
    dem_layout layout;
    dem_blocks *blocks;
    tl_crs *crs;
    unsigned overviews;
} dem_source;

static tl_status dem_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    (void)level;
    return dem_blocks_read(((const dem_source *)self)->blocks, window, out, error);
}

static void dem_destroy(tl_source *self)
{
    dem_source *dem = (dem_source *)self;
    dem_blocks_destroy(dem->blocks);
    dem_tiff_file_close(dem->file);
    tl_crs_release(dem->crs);
    free(dem);
}

/* A CRS that cannot be made out leaves the heights readable. Running out of memory is another matter. */
static tl_status read_crs(dem_source *dem, TIFF *tiff, double *to_degrees, tl_error *error)
{
    tl_error ignored = {0};
    *to_degrees = 1;
    tl_status status = dem_crs_from_tiff_scaled(tiff, dem->source.info.name, &dem->crs, to_degrees, &ignored);
    if (status != TL_ERROR_MEMORY)
        return TL_OK;
    if (error)
        *error = ignored;
    return status;
}

static tl_status read_georef(dem_source *dem, TIFF *tiff, tl_error *error)
{
    tl_source_info *info = &dem->source.info;
    tl_georef *georef = &info->georef;
    dem_geokeys keys;
    double to_degrees;
    tl_status status = dem_geokeys_read(tiff, info->name, &keys, error);
    if (status != TL_OK)
        return status;
    info->type = dem_geokeys_raster_type(&keys);
    *georef = tl_georef_none();
    georef->height_unit = dem_geokeys_height_unit(&keys);
    dem_geokeys_finish(&keys);
    status = read_crs(dem, tiff, &to_degrees, error);
    if (status != TL_OK)
        return status;
    georef->crs = dem->crs;
    georef->located = dem_tiff_transform(tiff, info->type, georef->transform);
    for (int k = 0; georef->located && k < 6; k++)
        georef->transform[k] *= to_degrees;
    return dem_georef_measure(georef, info->width, info->height, error);
}

static tl_status read_directory(dem_source *dem, dem_tiff_handle *handle, unsigned band, tl_error *error)
{
    tl_status status = dem_layout_read(handle, band, &dem->layout, error);
    if (status != TL_OK)
        return status;
    dem->source.info.width = dem->layout.width;
    dem->source.info.height = dem->layout.height;
    dem->source.info.has_voids = dem->layout.has_voids;
    dem->source.info.quantum = dem->layout.quantum;
    status = read_georef(dem, handle->tiff, error);
    if (status == TL_OK)
        dem->blocks = dem_blocks_create(dem->file, &dem->layout, CACHE_BYTES, error);
    return status == TL_OK && !dem->blocks ? TL_ERROR_MEMORY : status;
}

/* The first handle reads the directory, walks on through those of the overviews, and is used up by that; without
 * overviews it goes to the pool. */
static tl_status open_source(dem_source *dem, unsigned band, tl_error *error)
{
    dem_tiff_handle *handle;
    tl_status status = dem_tiff_take(dem->file, &handle, error);
    if (status != TL_OK)
        return status;
    status = read_directory(dem, handle, band, error);
    if (TIFFLastDirectory(handle->tiff)) {
        dem_tiff_give_back(dem->file, handle);
        return status;
    }
    if (status == TL_OK)
        dem->overviews = dem_overview_count(handle);
    dem_tiff_drop(handle);
    return status;
}

tl_source *tl_dem_open(const char *path, const tl_dem_options *options, tl_error *error)
{
    dem_source *dem = calloc(1, sizeof *dem);
    if (!dem) {
        tl_fail_memory(error, path);
        return NULL;
    }
    dem->source.read = dem_read;
    dem->source.destroy = dem_destroy;
    dem->file = dem_tiff_file_open(path, error);
    if (dem->file) {
        dem->source.info.name = dem_tiff_file_path(dem->file);
        if (open_source(dem, options ? options->band : 0, error) == TL_OK)
            return &dem->source;
    }
    dem_destroy(&dem->source);
    return NULL;
}

tl_status tl_dem_get_details(const tl_source *source, tl_dem_details *out, tl_error *error)
{
    if (source->read != dem_read)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: not an elevation model read from a TIFF file", source->info.name);
    const dem_source *dem = (const dem_source *)source;
    const dem_layout *layout = &dem->layout;
    *out = (tl_dem_details){
        .sample_type = layout->sample_type,
        .codec = dem_codec_name(layout->codec),
        .predictor = layout->predictor,
        .tiled = layout->tiled,
        .big_tiff = layout->big_tiff,
        .big_endian = layout->big_endian,
        .block_width = layout->block_width,
        .block_height = layout->block_height,
        .bands = layout->bands,
        .band = layout->band + 1,
        .has_nodata = layout->has_nodata,
        .nodata = layout->nodata,
        .scale = layout->rule.scale,
        .offset = layout->rule.offset,
        .overviews = dem->overviews,
        .bytes = dem_tiff_file_size(dem->file),
    };
    return TL_OK;
}
