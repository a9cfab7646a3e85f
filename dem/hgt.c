/* SRTM .hgt files: heights as big-endian 16-bit integers, row by row from the north, and nothing else. Where they lie
 * is in the file's name: N48W125 is the degree cell whose south-western corner is there. The samples are points, the
 * outer ones on the cell's edges. */
#include "dem/crs.h"
#include "dem/levels.h"
#include "dem/raster.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <ctype.h>
#include <errno.h>
#include <math.h>
#include <string.h>
#include <strings.h>

enum { VOID_HEIGHT = -32768, LARGEST_SIDE = 1 << 16, RAW_BYTES = 2 * LARGEST_SIDE };

typedef struct hgt_source {
    tl_source source;
    dem_file *file;
} hgt_source;

bool dem_hgt_named(const char *path)
{
    size_t length = strlen(path);
    return length > 4 && strcasecmp(path + length - 4, ".hgt") == 0;
}

/* ---- Reading ---- */

static void convert(const unsigned char *raw, int64_t count, float *out)
{
    for (int64_t k = 0; k < count; k++) {
        int height = raw[2 * k] << 8 | raw[2 * k + 1];
        height -= height >= 32768 ? 65536 : 0;
        out[k] = height == VOID_HEIGHT ? NAN : (float)height;
    }
}

/* Rows that are whole follow each other in the file: several at once, where they fit. */
static tl_status read_rows(const hgt_source *hgt, tl_window window, unsigned char *raw, float *out, tl_error *error)
{
    int64_t width = hgt->source.info.width;
    int64_t at_once = window.width == width ? tl_int64_max(1, RAW_BYTES / (2 * width)) : 1;
    for (int64_t row = 0; row < window.height; row += at_once) {
        int64_t count = tl_int64_min(at_once, window.height - row) * window.width;
        int64_t offset = 2 * ((window.y + row) * width + window.x);
        int64_t got = dem_file_read_at(hgt->file, raw, 2 * count, offset);
        if (got < 0)
            return tl_fail_system(error, hgt->source.info.name, "read", errno);
        if (got != 2 * count)
            return tl_fail(error, TL_ERROR_IO, "%s: ends at row %lld; it was cut short while it was being read",
                           hgt->source.info.name, (long long)(window.y + row));
        convert(raw, count, out + row * window.width);
    }
    return TL_OK;
}

static tl_status read_window(const void *context, tl_window window, float *out, tl_error *error)
{
    const hgt_source *hgt = context;
    unsigned char *raw = malloc(RAW_BYTES);
    if (!raw)
        return tl_fail_memory(error, hgt->source.info.name);
    tl_status status = dem_file_acquire(hgt->file, error);
    if (status == TL_OK) {
        status = read_rows(hgt, window, raw, out, error);
        dem_file_release(hgt->file);
    }
    free(raw);
    return status;
}

static tl_status hgt_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const tl_source_info *info = &self->info;
    dem_level_base base = {.read = read_window,
                           .context = self,
                           .width = info->width,
                           .height = info->height,
                           .type = info->type,
                           .name = info->name};
    return dem_level_read(&base, -level, window, out, error);
}

/* ---- Name and size ---- */

/* Degrees behind one of two letters, as "N48"; false where it is none. */
static bool parse_degrees(const char *text, char positive, char negative, int digits, int *degrees)
{
    int value = 0, letter = toupper((unsigned char)text[0]);
    if (letter != positive && letter != negative)
        return false;
    for (int k = 1; k <= digits; k++) {
        if (!isdigit((unsigned char)text[k]))
            return false;
        value = 10 * value + text[k] - '0';
    }
    *degrees = letter == positive ? value : -value;
    return true;
}

static tl_status parse_name(const char *path, int *longitude, int *latitude, tl_error *error)
{
    const char *slash = strrchr(path, '/'), *name = slash ? slash + 1 : path;
    if (parse_degrees(name, 'N', 'S', 2, latitude) && parse_degrees(name + 3, 'E', 'W', 3, longitude) &&
        !isdigit((unsigned char)name[7]) && *latitude >= -90 && *latitude < 90 && abs(*longitude) <= 180)
        return TL_OK;
    return tl_fail(error, TL_ERROR_DATA,
                   "%s: an .hgt file says by its name where it lies, as N48W125.hgt does; this name does not", path);
}

/* Square, but for the tiles of 1 by 2 arc-seconds that some archives have north of 50 degrees. */
static tl_status parse_size(const dem_file *file, tl_source_info *info, tl_error *error)
{
    int64_t bytes = dem_file_size(file), side = llround(sqrt((double)bytes / 2));
    if (side >= 2 && side <= LARGEST_SIDE && 2 * side * side == bytes)
        info->width = info->height = side;
    else if (bytes == 2 * 1801 * 3601) {
        info->width = 1801;
        info->height = 3601;
    } else
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: %lld bytes are no square of 16-bit heights, as an .hgt file is (is it complete?)",
                       dem_file_path(file), (long long)bytes);
    return TL_OK;
}

static tl_status place(tl_source_info *info, int longitude, int latitude, tl_error *error)
{
    tl_georef *georef = &info->georef;
    georef->located = true;
    georef->height_unit = 1;
    const double transform[6] = {longitude, 1 / (double)(info->width - 1),  0, latitude + 1,
                                 0,         -1 / (double)(info->height - 1)};
    memcpy(georef->transform, transform, sizeof transform);
    return dem_georef_measure(georef, info->width, info->height, error);
}

/* ---- The source ---- */

static void hgt_destroy(tl_source *self)
{
    hgt_source *hgt = (hgt_source *)self;
    tl_crs_release(self->info.georef.crs);
    dem_file_close(hgt->file);
    free(hgt);
}

/* A CRS that came from TIFF keys would carry them on. */
static tl_status set_crs(tl_source_info *info, const tl_crs *known, tl_error *error)
{
    tl_crs *made = NULL;
    if (known && known->epsg == 4326 && !known->key_directory) {
        info->georef.crs = tl_crs_retain(known);
        return TL_OK;
    }
    tl_status status = dem_crs_from_text("EPSG:4326", info->name, &made, error);
    info->georef.crs = made;
    return status;
}

static tl_status describe(hgt_source *hgt, const dem_sharing *sharing, tl_error *error)
{
    tl_source_info *info = &hgt->source.info;
    int longitude = 0, latitude = 0;
    *info =
        (tl_source_info){.name = dem_file_path(hgt->file), .type = TL_RASTER_POINT, .has_voids = true, .quantum = 1};
    tl_status status = parse_name(info->name, &longitude, &latitude, error);
    if (status == TL_OK)
        status = parse_size(hgt->file, info, error);
    if (status == TL_OK)
        status = set_crs(info, sharing->crs, error);
    return status == TL_OK ? place(info, longitude, latitude, error) : status;
}

tl_source *dem_hgt_create(dem_file *file, const dem_sharing *sharing, tl_error *error)
{
    hgt_source *hgt = calloc(1, sizeof *hgt);
    if (!hgt) {
        tl_fail_memory(error, dem_file_path(file));
        dem_file_close(file);
        return NULL;
    }
    hgt->source = (tl_source){.read = hgt_read, .size = dem_level_size, .destroy = hgt_destroy};
    hgt->file = file;
    if (describe(hgt, sharing, error) == TL_OK)
        return &hgt->source;
    hgt_destroy(&hgt->source);
    return NULL;
}

bool dem_hgt_details(const tl_source *source, tl_dem_details *out)
{
    if (source->read != hgt_read)
        return false;
    *out = (tl_dem_details){
        .sample_type = "int16",
        .codec = "none",
        .predictor = 1,
        .big_endian = true,
        .block_width = source->info.width,
        .block_height = 1,
        .bands = 1,
        .band = 1,
        .has_nodata = true,
        .nodata = VOID_HEIGHT,
        .scale = 1,
        .bytes = dem_file_size(((const hgt_source *)source)->file),
    };
    return true;
}
