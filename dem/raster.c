#include "dem/raster.h"

#include "dem/crs.h"
#include "dem/geokeys.h"
#include "dem/levels.h"
#include "dem/tiff_blocks.h"
#include "dem/tiff_record.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <string.h>

typedef struct dem_source {
    tl_source source;
    dem_file *file;
    dem_tiff_file *tiff;
    dem_layout layout;
    dem_block_cache *cache, *own_cache;
    dem_blocks *blocks;
    const tl_crs *crs;
    unsigned overview_count; /* in the file */
    unsigned usable;         /* those that stand for levels */
    dem_overview *overviews;
    dem_blocks **overview_blocks;
    tl_parameter *parameters;
} dem_source;

static tl_status read_blocks(const void *blocks, tl_window window, float *out, tl_error *error)
{
    return dem_blocks_read((dem_blocks *)blocks, window, out, error);
}

/* From the coarsest overview that is not coarser than the level. */
static tl_status read_level(const dem_source *dem, int level, tl_window window, float *out, tl_error *error)
{
    const tl_source_info *info = &dem->source.info;
    dem_level_base base = {.read = read_blocks,
                           .context = dem->blocks,
                           .width = info->width,
                           .height = info->height,
                           .type = info->type,
                           .name = info->name};
    int done = 0;
    for (unsigned k = 0; k < dem->usable; k++) {
        const dem_overview *overview = &dem->overviews[k];
        if (overview->halvings > -level || overview->halvings <= done)
            continue;
        done = overview->halvings;
        base.context = dem->overview_blocks[k];
        base.width = overview->layout.width;
        base.height = overview->layout.height;
    }
    return dem_level_read(&base, -level - done, window, out, error);
}

static tl_status dem_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const dem_source *dem = (const dem_source *)self;
    return level ? read_level(dem, level, window, out, error) : dem_blocks_read(dem->blocks, window, out, error);
}

static void dem_destroy(tl_source *self)
{
    dem_source *dem = (dem_source *)self;
    for (unsigned k = 0; k < dem->usable; k++)
        dem_blocks_destroy(dem->overview_blocks[k]);
    free(dem->overview_blocks);
    free(dem->overviews);
    dem_blocks_destroy(dem->blocks);
    dem_block_cache_destroy(dem->own_cache);
    dem_tiff_file_destroy(dem->tiff);
    dem_file_close(dem->file);
    tl_crs_release(dem->crs);
    free(dem->parameters);
    free(dem);
}

/* Whether the keys are the very ones that a CRS was made of. */
static bool same_keys(const dem_geokeys *keys, const tl_crs *crs)
{
    if (!crs || !keys->directory_count || keys->directory_count != crs->key_directory_count ||
        keys->double_count != crs->key_double_count || !keys->ascii != !crs->key_ascii)
        return false;
    return memcmp(keys->directory, crs->key_directory, keys->directory_count * sizeof *keys->directory) == 0 &&
           (!keys->double_count ||
            memcmp(keys->doubles, crs->key_doubles, keys->double_count * sizeof *keys->doubles) == 0) &&
           (!keys->ascii || strcmp(keys->ascii, crs->key_ascii) == 0);
}

/* A CRS that cannot be made out leaves the heights readable. Running out of memory is another matter. */
static tl_status make_crs(dem_source *dem, TIFF *tiff, double *to_degrees, tl_error *error)
{
    tl_error ignored = {0};
    tl_crs *crs = NULL;
    *to_degrees = 1;
    tl_status status = dem_crs_from_tiff_scaled(tiff, dem->source.info.name, &crs, to_degrees, &ignored);
    dem->crs = crs;
    if (status != TL_ERROR_MEMORY)
        return TL_OK;
    if (error)
        *error = ignored;
    return status;
}

/* Where `known` is of the same keys it serves again: a kept directory is in degrees. */
static tl_status read_crs(dem_source *dem, TIFF *tiff, const dem_geokeys *keys, const tl_crs *known, double *to_degrees,
                          tl_error *error)
{
    *to_degrees = 1;
    if (!same_keys(keys, known))
        return make_crs(dem, tiff, to_degrees, error);
    dem->crs = tl_crs_retain(known);
    return TL_OK;
}

static tl_status read_georef(dem_source *dem, TIFF *tiff, const tl_crs *known, tl_error *error)
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
    status = read_crs(dem, tiff, &keys, known, &to_degrees, error);
    dem_geokeys_finish(&keys);
    if (status != TL_OK)
        return status;
    georef->crs = dem->crs;
    georef->located = dem_tiff_transform(tiff, info->type, georef->transform);
    for (int k = 0; georef->located && k < 6; k++)
        georef->transform[k] *= to_degrees;
    info->wraps = dem_georef_goes_around(georef, info->width);
    return dem_georef_measure(georef, info->width, info->height, error);
}

static tl_status prepare_blocks(dem_source *dem, dem_block_cache *shared, const tl_dem_options *options,
                                tl_error *error)
{
    const dem_layout *layout = &dem->layout;
    if (!shared)
        dem->own_cache = dem_block_cache_create(dem_cache_budget(options), (uint64_t)(layout->across * layout->down));
    dem->cache = shared ? shared : dem->own_cache;
    if (!dem->cache)
        return tl_fail_memory(error, dem->source.info.name);
    dem->blocks = dem_blocks_create(dem->tiff, 0, layout, dem->cache, error);
    return dem->blocks ? TL_OK : TL_ERROR_MEMORY;
}

static tl_status read_directory(dem_source *dem, dem_tiff_handle *handle, const dem_sharing *sharing,
                                const tl_dem_options *options, tl_error *error)
{
    tl_source_info *info = &dem->source.info;
    tl_status status = dem_layout_read(handle, options->band, &dem->layout, error);
    if (status != TL_OK)
        return status;
    info->width = dem->layout.width;
    info->height = dem->layout.height;
    info->has_voids = dem->layout.has_voids;
    info->quantum = dem->layout.quantum;
    info->block_width = dem->layout.block_width;
    info->block_height = dem->layout.block_height;
    status = read_georef(dem, handle->tiff, sharing->crs, error);
    if (status == TL_OK)
        status = dem_record_read(handle->tiff, info->name, &dem->parameters, &info->parameter_count, error);
    info->parameters = dem->parameters;
    return status == TL_OK ? prepare_blocks(dem, sharing->cache, options, error) : status;
}

static tl_status keep_overviews(dem_source *dem, const dem_overview *found, unsigned usable, tl_error *error)
{
    dem->overviews = malloc(usable * sizeof *dem->overviews);
    dem->overview_blocks = calloc(usable, sizeof(dem_blocks *));
    if (!dem->overviews || !dem->overview_blocks)
        return tl_fail_memory(error, dem->source.info.name);
    memcpy(dem->overviews, found, usable * sizeof *found);
    for (; dem->usable < usable; dem->usable++) {
        const dem_overview *overview = &found[dem->usable];
        dem_blocks *blocks = dem_blocks_create(dem->tiff, overview->directory, &overview->layout, dem->cache, error);
        if (!blocks)
            return TL_ERROR_MEMORY;
        dem->overview_blocks[dem->usable] = blocks;
    }
    return TL_OK;
}

/* How the copies of a file were made is not known. Means can be told apart from a choice of samples by nothing but
 * their values, so only for areas, whose levels are means, are they taken at all. */
static tl_status read_overviews(dem_source *dem, dem_tiff_handle *handle, bool exact, tl_error *error)
{
    dem_overview found[DEM_MAX_OVERVIEWS];
    unsigned usable;
    dem->overview_count = dem_overviews_read(handle, &dem->layout, found, &usable);
    if (!usable || exact || dem->source.info.type != TL_RASTER_AREA)
        return TL_OK;
    return keep_overviews(dem, found, usable, error);
}

/* The first handle reads the directory, walks on through those of the overviews, and is used up by that; without
 * overviews it goes to the pool. */
static tl_status open_source(dem_source *dem, const dem_sharing *sharing, const tl_dem_options *options,
                             tl_error *error)
{
    dem_tiff_handle *handle;
    tl_status status = dem_tiff_take(dem->tiff, 0, &handle, error);
    if (status != TL_OK)
        return status;
    status = read_directory(dem, handle, sharing, options, error);
    if (status == TL_OK)
        status = dem_tiff_check(handle, error);
    if (TIFFLastDirectory(handle->tiff)) {
        dem_tiff_give_back(dem->tiff, handle);
        return status;
    }
    if (status == TL_OK)
        status = read_overviews(dem, handle, options->exact_levels, error);
    if (status == TL_OK)
        status = dem_tiff_check(handle, error);
    dem_tiff_drop(dem->tiff, handle);
    return status;
}

tl_source *dem_raster_create(dem_file *file, const dem_sharing *sharing, const tl_dem_options *options, tl_error *error)
{
    dem_source *dem = calloc(1, sizeof *dem);
    if (!dem) {
        tl_fail_memory(error, dem_file_path(file));
        dem_file_close(file);
        return NULL;
    }
    dem->source = (tl_source){.read = dem_read, .size = dem_level_size, .destroy = dem_destroy};
    dem->source.info.name = dem_file_path(file);
    dem->file = file;
    dem->tiff = dem_tiff_file_create(file, error);
    if (dem->tiff && open_source(dem, sharing, options, error) == TL_OK)
        return &dem->source;
    dem_destroy(&dem->source);
    return NULL;
}

uint64_t dem_raster_reduced(const tl_source *source)
{
    uint64_t levels = 0;
    const dem_source *dem = (const dem_source *)source;
    for (unsigned k = 0; source->read == dem_read && k < dem->usable; k++)
        if (dem->overviews[k].halvings > 0 && dem->overviews[k].halvings < 64)
            levels |= UINT64_C(1) << dem->overviews[k].halvings;
    return levels;
}

bool dem_raster_details(const tl_source *source, tl_dem_details *out)
{
    if (source->read != dem_read)
        return false;
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
        .overviews = dem->overview_count,
        .bytes = dem_tiff_file_size(dem->tiff),
    };
    return true;
}
