/* EXR heightfields that talus wrote, as sources. */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/out/out.h"
#include "lib/out/place.h"

#include <openexr.h>

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static const char heights_name[] = "Y";

enum { PART = 0, TILE_LIMIT = 4096, PREFIX = 6 /* of "talus:" */ };

typedef struct exr_source {
    tl_source source;
    exr_context_t file;
    int descriptor;
    char *path;
    int32_t tile_width, tile_height;
    tl_parameter *parameters; /* strings belong to the file's context */
} exr_source;

static int64_t on_read(exr_const_context_t context, void *user, void *buffer, uint64_t count, uint64_t offset,
                       exr_stream_error_func_ptr_t fail)
{
    exr_source *self = user;
    unsigned char *to = buffer;
    uint64_t have = 0;
    while (have < count) {
        ssize_t got = pread(self->descriptor, to + have, count - have, (off_t)(offset + have));
        if (got < 0 && errno == EINTR)
            continue;
        if (got < 0)
            return fail(context, EXR_ERR_READ_IO, "cannot read"), -1;
        if (got == 0)
            break;
        have += (uint64_t)got;
    }
    return (int64_t)have;
}

static int64_t on_size(exr_const_context_t context, void *user)
{
    (void)context;
    struct stat status;
    return fstat(((exr_source *)user)->descriptor, &status) == 0 ? status.st_size : -1;
}

static void on_error(exr_const_context_t context, exr_result_t code, const char *text)
{
    (void)context;
    (void)code;
    (void)text;
}

static tl_status damaged(const exr_source *self, exr_result_t code, tl_error *error)
{
    return tl_fail(error, code == EXR_ERR_OUT_OF_MEMORY ? TL_ERROR_MEMORY : TL_ERROR_DATA,
                   "%s: the EXR cannot be read: %s", self->path, exr_get_default_error_message(code));
}

/* ---- reading ---- */

typedef struct decoding {
    exr_decode_pipeline_t pipeline;
    bool begun;
    float *tile;
} decoding;

static exr_result_t decode_tile(const exr_source *self, decoding *d, int32_t x, int32_t y, int64_t tile_width)
{
    exr_chunk_info_t chunk;
    exr_result_t code = exr_read_tile_chunk_info(self->file, PART, x, y, 0, 0, &chunk);
    if (code == EXR_ERR_SUCCESS && (chunk.width != tile_width || chunk.height > self->tile_height))
        code = EXR_ERR_BAD_CHUNK_LEADER;
    if (code == EXR_ERR_SUCCESS)
        code = d->begun ? exr_decoding_update(self->file, PART, &chunk, &d->pipeline)
                        : exr_decoding_initialize(self->file, PART, &chunk, &d->pipeline);
    if (code != EXR_ERR_SUCCESS)
        return code;
    for (int c = 0; c < d->pipeline.channel_count; c++) {
        exr_coding_channel_info_t *channel = &d->pipeline.channels[c];
        channel->decode_to_ptr = strcmp(channel->channel_name, heights_name) == 0 ? (uint8_t *)d->tile : NULL;
        channel->user_pixel_stride = sizeof(float);
        channel->user_line_stride = (int32_t)((size_t)tile_width * sizeof(float));
        channel->user_bytes_per_element = sizeof(float);
        channel->user_data_type = EXR_PIXEL_FLOAT;
    }
    if (!d->begun)
        code = exr_decoding_choose_default_routines(self->file, PART, &d->pipeline);
    d->begun = true;
    return code == EXR_ERR_SUCCESS ? exr_decoding_run(self->file, PART, &d->pipeline) : code;
}

/* Copies what a decoded tile and the window share. */
static void copy_shared(const float *tile, tl_window box, tl_window window, float *out)
{
    int64_t x0 = tl_int64_max(box.x, window.x), x1 = tl_int64_min(box.x + box.width, window.x + window.width);
    int64_t y0 = tl_int64_max(box.y, window.y), y1 = tl_int64_min(box.y + box.height, window.y + window.height);
    for (int64_t y = y0; y < y1; y++)
        memcpy(out + (y - window.y) * window.width + (x0 - window.x), tile + (y - box.y) * box.width + (x0 - box.x),
               (size_t)(x1 - x0) * sizeof *out);
}

static tl_status exr_read(const tl_source *base, int level, tl_window window, float *out, tl_error *error)
{
    (void)level;
    const exr_source *self = (const exr_source *)base;
    if (window.width == 0 || window.height == 0)
        return TL_OK;
    decoding d = {.pipeline = EXR_DECODE_PIPELINE_INITIALIZER,
                  .tile = tl_alloc_grid(self->tile_width, self->tile_height, sizeof(float))};
    if (!d.tile)
        return tl_fail_memory(error, self->path);
    exr_result_t code = EXR_ERR_SUCCESS;
    for (int64_t ty = window.y / self->tile_height;
         ty * self->tile_height < window.y + window.height && code == EXR_ERR_SUCCESS; ty++)
        for (int64_t tx = window.x / self->tile_width;
             tx * self->tile_width < window.x + window.width && code == EXR_ERR_SUCCESS; tx++) {
            tl_window box = {tx * self->tile_width, ty * self->tile_height, 0, 0};
            box.width = tl_int64_min(self->tile_width, base->info.width - box.x);
            box.height = tl_int64_min(self->tile_height, base->info.height - box.y);
            code = decode_tile(self, &d, (int32_t)tx, (int32_t)ty, box.width);
            if (code == EXR_ERR_SUCCESS)
                copy_shared(d.tile, box, window, out);
        }
    if (d.begun)
        exr_decoding_destroy(self->file, &d.pipeline);
    free(d.tile);
    return code == EXR_ERR_SUCCESS ? TL_OK : damaged(self, code, error);
}

static void exr_destroy(tl_source *base)
{
    exr_source *self = (exr_source *)base;
    exr_finish(&self->file);
    if (self->descriptor >= 0)
        close(self->descriptor);
    tl_crs_release(base->info.georef.crs);
    free(self->parameters);
    free(self->path);
    free(self);
}

/* ---- header ---- */

static const char *text_attribute(exr_const_context_t file, const char *name)
{
    const char *text = NULL;
    int32_t length = 0;
    return exr_attr_get_string(file, PART, name, &length, &text) == EXR_ERR_SUCCESS ? text : NULL;
}

/* A channel Y of floats or halves, among others that cover every sample too. */
static bool has_heights(const exr_attr_chlist_t *channels)
{
    bool found = false;
    for (int c = 0; c < channels->num_channels; c++) {
        const exr_attr_chlist_entry_t *entry = &channels->entries[c];
        if (entry->x_sampling != 1 || entry->y_sampling != 1)
            return false;
        found |= strcmp(entry->name.str, heights_name) == 0 && entry->pixel_type != EXR_PIXEL_UINT;
    }
    return found;
}

/* What the file says that its numbers are. */
static const char *contents_of(const exr_source *self)
{
    const char *contents = text_attribute(self->file, "talus:contents");
    if (!contents)
        contents = text_attribute(self->file, "talus:layer"); /* of files before there were contents */
    if (!contents || strcmp(contents, "heights") == 0)
        return NULL;
    tl_make_printable((char *)contents);
    return contents;
}

static tl_status not_ours(const exr_source *self, tl_error *error)
{
    const char *contents = contents_of(self);
    if (contents)
        return tl_fail(error, TL_ERROR_DATA, "%s: holds %.60s, no heights; name the heightfield that it was made of",
                       self->path, contents);
    return tl_fail(error, TL_ERROR_DATA, "%s: not a heightfield of talus (one tiled part with a float channel Y)",
                   self->path);
}

static bool is_ours(exr_source *self)
{
    exr_storage_t storage;
    const exr_attr_chlist_t *channels = NULL;
    uint32_t width = 0, height = 0;
    exr_tile_level_mode_t mode;
    exr_tile_round_mode_t rounding;
    if (exr_get_storage(self->file, PART, &storage) != EXR_ERR_SUCCESS || storage != EXR_STORAGE_TILED ||
        exr_get_channels(self->file, PART, &channels) != EXR_ERR_SUCCESS || !has_heights(channels) ||
        exr_get_tile_descriptor(self->file, PART, &width, &height, &mode, &rounding) != EXR_ERR_SUCCESS)
        return false;
    self->tile_width = (int32_t)width;
    self->tile_height = (int32_t)height;
    return width > 0 && height > 0 && width <= TILE_LIMIT && height <= TILE_LIMIT;
}

static tl_status read_georeference(exr_source *self, tl_error *error)
{
    tl_source_info *info = &self->source.info;
    const char *type = text_attribute(self->file, "gdal:AREA_OR_POINT");
    info->type = type && strcmp(type, "Point") == 0 ? TL_RASTER_POINT : TL_RASTER_AREA;
    out_place place = {.wkt = text_attribute(self->file, "gdal:crsWkt"),
                       .keys = text_attribute(self->file, "geotiff:keys")};
    exr_attr_m33d_t m;
    double transform[6];
    if (exr_attr_get_m33d(self->file, PART, "gdal:geoTransform", &m) == EXR_ERR_SUCCESS) {
        const double t[6] = {m.m[2], m.m[0], m.m[1], m.m[5], m.m[3], m.m[4]};
        memcpy(transform, t, sizeof t);
        place.transform = transform;
    }
    exr_attr_get_double(self->file, PART, "talus:heightUnit", &place.height_unit);
    return out_place_read(&place, self->path, info, error);
}

static tl_status read_parameters(exr_source *self, tl_error *error)
{
    int32_t count = 0;
    exr_get_attribute_count(self->file, PART, &count);
    self->parameters = tl_alloc((size_t)count, sizeof *self->parameters);
    if (!self->parameters)
        return tl_fail_memory(error, self->path);
    size_t kept = 0;
    for (int32_t i = 0; i < count; i++) {
        const exr_attribute_t *a;
        if (exr_get_attribute_by_index(self->file, PART, EXR_ATTR_LIST_FILE_ORDER, i, &a) == EXR_ERR_SUCCESS &&
            a->type == EXR_ATTR_STRING && strncmp(a->name, "talus:", PREFIX) == 0 &&
            strcmp(a->name + PREFIX, "contents") != 0) {
            /* anyone may have written the file; the text lies in memory of the context, which is ours */
            tl_make_printable((char *)a->name);
            tl_make_printable((char *)a->string->str);
            self->parameters[kept++] = (tl_parameter){.name = a->name + PREFIX, .value = a->string->str};
        }
    }
    self->source.info.parameters = self->parameters;
    self->source.info.parameter_count = kept;
    return TL_OK;
}

static tl_status read_header(exr_source *self, tl_error *error)
{
    exr_context_initializer_t start = EXR_DEFAULT_CONTEXT_INITIALIZER;
    start.error_handler_fn = on_error;
    start.user_data = self;
    start.read_fn = on_read;
    start.size_fn = on_size;
    exr_result_t code = exr_start_read(&self->file, self->path, &start);
    if (code != EXR_ERR_SUCCESS)
        return damaged(self, code, error);
    if (!is_ours(self))
        return not_ours(self, error);
    exr_attr_box2i_t box;
    code = exr_get_data_window(self->file, PART, &box);
    if (code != EXR_ERR_SUCCESS)
        return damaged(self, code, error);
    tl_source_info *info = &self->source.info;
    info->width = (int64_t)box.max.x - box.min.x + 1;
    info->height = (int64_t)box.max.y - box.min.y + 1;
    info->name = self->path;
    info->contents = contents_of(self);
    info->block_width = self->tile_width;
    info->block_height = self->tile_height;
    info->has_voids = true;
    if (info->width < 1 || info->height < 1)
        return tl_fail(error, TL_ERROR_DATA, "%s: the EXR holds no samples", self->path);
    tl_status status = read_georeference(self, error);
    return status == TL_OK ? read_parameters(self, error) : status;
}

tl_source *out_exr_open(const char *path, tl_error *error)
{
    exr_source *self = calloc(1, sizeof *self);
    if (self) {
        *self =
            (exr_source){.source = {.read = exr_read, .destroy = exr_destroy}, .descriptor = -1, .path = strdup(path)};
        if (self->path)
            self->descriptor = open(path, O_RDONLY | O_CLOEXEC);
    }
    if (!self || !self->path)
        tl_fail_memory(error, path);
    else if (self->descriptor < 0)
        tl_fail_system(error, path, "read", errno);
    else if (read_header(self, error) == TL_OK)
        return &self->source;
    if (self)
        exr_destroy(&self->source);
    return NULL;
}
