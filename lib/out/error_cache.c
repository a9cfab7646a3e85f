/* Error pyramids as GeoTIFFs: bytes of codes or floats of errors, a map of where a model needs its samples. One item of
 * metadata says what they were made of. */
#include "dem/framework_pyramid.h"
#include "dem/tiff_file.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/out.h"

#include <float.h>
#include <inttypes.h>
#include <stdio.h>

enum {
    GDAL_METADATA = 42112,
    LABEL_LIMIT = 200,
    BAND = 64,
    BASE_LIMIT = (0x7f800000 >> 19) - 255 /* codes above it would pass infinity */
};

#define ITEM "error_pyramid"

/* ---- The label ---- */

/* What a pyramid's file must say to be this one's; `contents` is the checksum of its keys and their base. */
static void make_label(const tl_pyramid *pyramid, uint64_t contents, char text[LABEL_LIMIT])
{
    snprintf(text, LABEL_LIMIT, "2 talus %s of %016" PRIx64 " %s %s base %d contents %016" PRIx64, tl_version(),
             pyramid->checksum, pyramid->bends ? "bent" : "flat", pyramid->codes ? "codes" : "floats",
             (int)pyramid->base, contents);
}

static uint64_t mix(uint64_t hash, uint64_t value)
{
    hash = (hash ^ value) * UINT64_C(0x9E3779B97F4A7C15);
    return hash ^ hash >> 29;
}

static uint64_t sum_contents(const tl_pyramid *pyramid)
{
    size_t samples = (size_t)pyramid->shape->info.width * (size_t)pyramid->shape->info.height;
    uint64_t hash[4] = {1, 2, 3, 4 + (uint64_t)pyramid->base};
    for (size_t i = 0; i < samples; i++)
        hash[i & 3] = mix(hash[i & 3], tl_pyramid_key(pyramid, i));
    return mix(mix(mix(hash[0], hash[1]), hash[2]), hash[3]);
}

/* ---- Saving ---- */

/* A pyramid as a source: errors are its heights, codes its validity. */
typedef struct shown {
    tl_source base;
    const tl_pyramid *pyramid;
} shown;

static tl_status read_errors(const tl_source *base, int level, tl_window window, float *out, tl_error *error)
{
    const tl_pyramid *pyramid = ((const shown *)base)->pyramid;
    (void)level;
    (void)error;
    for (int64_t y = window.y; y < window.y + window.height; y++, out += window.width) {
        const float *from = pyramid->errors + y * base->info.width + window.x;
        for (int64_t x = 0; x < window.width; x++)
            out[x] = from[x] <= FLT_MAX ? from[x] : FLT_MAX; /* rasters have no infinite heights */
    }
    return TL_OK;
}

static tl_status read_codes(const tl_source *base, int level, tl_window window, unsigned char *out, tl_error *error)
{
    const tl_pyramid *pyramid = ((const shown *)base)->pyramid;
    (void)level;
    (void)error;
    for (int64_t y = window.y; y < window.y + window.height; y++, out += window.width)
        memcpy(out, pyramid->codes + y * base->info.width + window.x, (size_t)window.width);
    return TL_OK;
}

tl_status tl_pyramid_save(const tl_pyramid *pyramid, const char *path, const tl_write_options *options, tl_error *error)
{
    char label[LABEL_LIMIT];
    const tl_parameter parameter = {ITEM, label};
    shown self = {.base = {.info = pyramid->shape->info, .read = read_errors, .validity = read_codes},
                  .pyramid = pyramid};
    self.base.info.has_voids = false;
    self.base.info.parameters = &parameter;
    self.base.info.parameter_count = 1;
    make_label(pyramid, sum_contents(pyramid), label);
    tl_write_options quick = *options;
    quick.compression = TL_COMPRESSION_DEFAULT;
    tl_output *output = tl_output_open(path, options->overwrite, error);
    if (!output)
        return TL_ERROR_IO;
    tl_status status = pyramid->codes ? out_validity_write(&self.base, output, &quick, error)
                                      : out_geotiff_write(&self.base, output, &quick, error);
    if (status == TL_OK)
        return tl_output_commit(output, error);
    tl_output_abort(output);
    return status;
}

/* ---- Loading ---- */

static bool find_item(dem_tiff_file *file, const char *name, char *text, size_t limit)
{
    char start[80];
    dem_tiff_handle *handle;
    if (dem_tiff_take(file, 0, &handle, NULL) != TL_OK)
        return false;
    snprintf(start, sizeof start, "<Item name=\"talus_%.40s\">", name);
    char *metadata = dem_tiff_text(handle->tiff, GDAL_METADATA);
    dem_tiff_give_back(file, handle);
    const char *from = metadata ? strstr(metadata, start) : NULL;
    const char *to = from ? strstr(from += strlen(start), "</Item>") : NULL;
    bool found = to && (size_t)(to - from) < limit;
    if (found)
        snprintf(text, limit, "%.*s", (int)(to - from), from);
    free(metadata);
    return found;
}

bool out_geotiff_item(const char *path, const char *name, char *text, size_t limit)
{
    dem_file *file = dem_file_open(path, NULL, NULL);
    dem_tiff_file *tiff = file ? dem_tiff_file_create(file, NULL) : NULL;
    bool found = tiff && find_item(tiff, name, text, limit);
    dem_tiff_file_destroy(tiff);
    dem_file_close(file);
    return found;
}

static tl_status read_label(const char *path, char label[LABEL_LIMIT], tl_error *error)
{
    if (out_geotiff_item(path, ITEM, label, LABEL_LIMIT))
        return TL_OK;
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: not an error pyramid of talus; name another file", path);
}

/* False where a value is no error and no code. */
static bool take_rows(tl_pyramid *to, int64_t y, int64_t rows, const float *values)
{
    size_t width = (size_t)to->shape->info.width, first = (size_t)y * width;
    for (size_t i = 0; i < width * (size_t)rows; i++) {
        if (!(values[i] >= 0) || (to->codes && values[i] > 255))
            return false;
        if (to->codes)
            to->codes[first + i] = (unsigned char)values[i];
        else
            to->errors[first + i] = values[i] < FLT_MAX ? values[i] : INFINITY;
    }
    return true;
}

static tl_status read_keys(tl_pyramid *to, const tl_source *from, tl_error *error)
{
    const tl_source_info *info = &to->shape->info;
    float *rows = tl_alloc_grid(info->width, BAND, sizeof *rows);
    tl_status status = rows ? TL_OK : tl_fail_memory(error, "the error pyramid");
    for (int64_t y = 0; status == TL_OK && y < info->height; y += BAND) {
        tl_window window = {0, y, info->width, tl_int64_min(BAND, info->height - y)};
        status = tl_source_read(from, from->info.level, window, rows, error);
        if (status == TL_OK && !take_rows(to, y, window.height, rows))
            status = tl_fail(error, TL_ERROR_DATA, "%s: is damaged", from->info.name);
    }
    free(rows);
    return status;
}

static tl_status load(tl_pyramid *to, const char *path, const char *label, tl_error *error)
{
    const tl_source_info *info = &to->shape->info;
    char expected[LABEL_LIMIT];
    const char *base = strstr(label, " base ");
    to->base = base ? (int32_t)strtol(base + 6, NULL, 10) : 0;
    make_label(to, 0, expected);
    const char *contents = strstr(expected, " contents ");
    if (to->base < 0 || to->base > BASE_LIMIT || strncmp(expected, label, (size_t)(contents - expected)) != 0)
        return tl_fail(error, TL_ERROR_DATA, "%s: was made of other heights, or by another version", path);
    tl_source *from = tl_dem_open(&path, 1, NULL, error);
    if (!from)
        return TL_ERROR_DATA;
    tl_status status = TL_OK;
    if (from->info.width != info->width || from->info.height != info->height)
        status = tl_fail(error, TL_ERROR_DATA, "%s: was made of a raster of another size", path);
    if (status == TL_OK)
        status = read_keys(to, from, error);
    tl_source_destroy(from);
    if (status != TL_OK)
        return status;
    make_label(to, sum_contents(to), expected);
    return strcmp(expected, label) == 0 ? TL_OK : tl_fail(error, TL_ERROR_DATA, "%s: is damaged", path);
}

tl_pyramid *tl_pyramid_load(const char *path, const tl_source *dem, const tl_pyramid_options *options, tl_error *error)
{
    static const tl_pyramid_options defaults = {0};
    char label[LABEL_LIMIT];
    options = options ? options : &defaults;
    if (read_label(path, label, error) != TL_OK)
        return NULL;
    tl_pyramid *pyramid = tl_pyramid_allocate(&dem->info, options, error);
    if (!pyramid)
        return NULL;
    tl_status status = tl_pyramid_look(pyramid, dem, options, error);
    if (status == TL_OK)
        status = load(pyramid, path, label, error);
    if (status == TL_OK)
        return pyramid;
    tl_pyramid_destroy(pyramid);
    return NULL;
}
