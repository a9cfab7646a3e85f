/* EXR heightfields through OpenEXRCore: one tiled part, one float channel "Y" (readers such as Blender take other names
 * for colours of black), tiles compressed in parallel and written in order. */
#include "dem/crs_keys.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/backlog.h"
#include "lib/out/mip.h"
#include "lib/out/out.h"

#include <half.h>
#include <openexr.h>

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { PART = 0, NAME_LIMIT = 31, GATHER = 1 << 18 };

/* Attributes whose values are known only when all is written; patched in the header then. */
static const char low_name[] = "talus:lowest", high_name[] = "talus:highest";

typedef struct stream {
    tl_output *output;
    tl_error *error;         /* of the system, when it refused a write */
    unsigned char *gathered; /* GATHER bytes: those that come next, from `begin` on */
    uint64_t begin;
    size_t used;
} stream;

/* Writes what is gathered. */
static tl_status flush(stream *self)
{
    tl_status status = tl_output_write_at(self->output, self->gathered, self->used, self->begin, self->error);
    self->begin += self->used;
    self->used = 0;
    return status;
}

/* Bytes come in order, but each tile with a few before it: they go on in whole blocks of the file, for pages that are
 * written in two parts cost the system a quarter more. */
static tl_status gather(stream *self, const unsigned char *bytes, uint64_t count, uint64_t offset)
{
    tl_status status = TL_OK;
    if (offset != self->begin + self->used) {
        status = flush(self);
        self->begin = offset;
    }
    while (count && status == TL_OK) {
        size_t room = GATHER - (size_t)(self->begin % GATHER) - self->used, some = count < room ? (size_t)count : room;
        memcpy(self->gathered + self->used, bytes, some);
        self->used += some;
        bytes += some;
        count -= some;
        if (some == room)
            status = flush(self);
    }
    return status;
}

static int64_t on_write(exr_const_context_t context, void *user, const void *bytes, uint64_t count, uint64_t offset,
                        exr_stream_error_func_ptr_t fail)
{
    stream *self = user;
    if (gather(self, bytes, count, offset) != TL_OK)
        return fail(context, EXR_ERR_WRITE_IO, "cannot write"), -1;
    return (int64_t)count;
}

static void on_error(exr_const_context_t context, exr_result_t code, const char *text)
{
    /* the codes that calls return say enough; nothing may go to stderr */
    (void)context;
    (void)code;
    (void)text;
}

static tl_status exr_failed(exr_result_t code, const stream *to, tl_error *error)
{
    if (to->error->status != TL_OK)
        return to->error->status; /* described already, by the system's own words */
    return tl_fail(error, code == EXR_ERR_OUT_OF_MEMORY ? TL_ERROR_MEMORY : TL_ERROR_IO,
                   "%s: OpenEXR cannot write it: %s", tl_output_path(to->output), exr_get_default_error_message(code));
}

static exr_compression_t compression_of(tl_compression compression)
{
    switch (compression) {
    case TL_COMPRESSION_NONE:
        return EXR_COMPRESSION_NONE;
    case TL_COMPRESSION_ZIPS:
        return EXR_COMPRESSION_ZIPS;
    case TL_COMPRESSION_PIZ:
        return EXR_COMPRESSION_PIZ;
    default:
        return EXR_COMPRESSION_ZIP;
    }
}

/* WKT does not hold all that GeoTIFF keys do, and keys cannot be made of every WKT: both are kept. */
static exr_result_t set_keys(exr_context_t file, const tl_crs *crs)
{
    char *text = dem_crs_keys_text(crs);
    exr_result_t code = text ? exr_attr_set_string(file, PART, "geotiff:keys", text) : EXR_ERR_SUCCESS;
    free(text);
    return code;
}

static exr_result_t set_georeference(exr_context_t file, const tl_source_info *info)
{
    double t[6];
    out_gdal_transform(info, t);
    exr_attr_m33d_t matrix = {.m = {t[1], t[2], t[0], t[4], t[5], t[3], 0, 0, 1}};
    exr_result_t code = EXR_ERR_SUCCESS;
    if (info->georef.located)
        code = exr_attr_set_m33d(file, PART, "gdal:geoTransform", &matrix);
    if (code == EXR_ERR_SUCCESS && info->georef.crs && *tl_crs_wkt(info->georef.crs))
        code = exr_attr_set_string(file, PART, "gdal:crsWkt", tl_crs_wkt(info->georef.crs));
    if (code == EXR_ERR_SUCCESS && info->georef.crs)
        code = set_keys(file, info->georef.crs);
    if (code == EXR_ERR_SUCCESS)
        code = exr_attr_set_string(file, PART, "gdal:AREA_OR_POINT", info->type == TL_RASTER_AREA ? "Area" : "Point");
    if (code == EXR_ERR_SUCCESS)
        code = exr_attr_set_string(file, PART, "talus:contents", info->contents ? info->contents : "heights");
    if (code == EXR_ERR_SUCCESS)
        code = exr_attr_set_double(file, PART, "talus:heightUnit", info->georef.height_unit);
    return code;
}

static exr_result_t set_parameters(exr_context_t file, const tl_source_info *info)
{
    exr_result_t code = exr_attr_set_string(file, PART, "talus:version", tl_version());
    if (code == EXR_ERR_SUCCESS)
        code = exr_attr_set_float(file, PART, low_name, NAN);
    if (code == EXR_ERR_SUCCESS)
        code = exr_attr_set_float(file, PART, high_name, NAN);
    for (size_t i = 0; i < info->parameter_count && code == EXR_ERR_SUCCESS; i++) {
        char name[NAME_LIMIT + 1]; /* longer names need a newer reader */
        snprintf(name, sizeof name, "talus:%s", info->parameters[i].name);
        if (strcmp(name, "talus:version") != 0)
            code = exr_attr_set_string(file, PART, name, info->parameters[i].value);
    }
    return code;
}

static const char *const heights_name[] = {"Y"};

static exr_result_t set_header(exr_context_t file, const tl_source_info *info, const out_planes *planes,
                               const tl_write_options *options)
{
    exr_attr_box2i_t window;
    exr_attr_v2f_t centre;
    window.min.x = window.min.y = 0;
    window.max.x = (int32_t)info->width - 1;
    window.max.y = (int32_t)info->height - 1;
    centre.x = centre.y = 0;
    int part;
    exr_result_t code = exr_add_part(file, info->contents ? "layer" : "heights", EXR_STORAGE_TILED, &part);
    if (code ==
        EXR_ERR_SUCCESS) /* random order, for the file is complete when it gets its name; ours is always the same */
        code = exr_initialize_required_attr(file, PART, &window, &window, 1.0f, &centre, 1.0f, EXR_LINEORDER_RANDOM_Y,
                                            compression_of(options->compression));
    if (code == EXR_ERR_SUCCESS)
        code = exr_set_tile_descriptor(file, PART, OUT_TILE, OUT_TILE,
                                       options->mip ? EXR_TILE_MIPMAP_LEVELS : EXR_TILE_ONE_LEVEL,
                                       options->mip ? EXR_TILE_ROUND_UP : EXR_TILE_ROUND_DOWN);
    for (size_t k = 0; code == EXR_ERR_SUCCESS && k < planes->count; k++)
        code = exr_add_channel(file, PART, planes->names[k], options->half_error > 0 ? EXR_PIXEL_HALF : EXR_PIXEL_FLOAT,
                               EXR_PERCEPTUALLY_LINEAR, 1, 1);
    if (code == EXR_ERR_SUCCESS)
        code = set_georeference(file, info);
    if (code == EXR_ERR_SUCCESS)
        code = set_parameters(file, info);
    return code == EXR_ERR_SUCCESS ? exr_write_header(file) : code;
}

/* ---- tiles ---- */

typedef struct worker {
    float *heights;
    uint16_t *halves; /* the same, where they are stored so */
    exr_encode_pipeline_t pipeline;
    bool begun;
    out_extent extent;
    out_backlog *backlog; /* and the rest: where keep_chunk puts the tile in hand */
    tl_parallel *loop;
    uint64_t tile;
    tl_status status;
    tl_error *error;
} worker;

typedef struct writing {
    const tl_source *source;
    const out_planes *planes;
    exr_context_t file;
    out_tiling tiling; /* of the level in hand */
    int level;         /* halvings of the source's finest */
    double half_error; /* see tl_write_options */
    out_mip mip;
    worker *workers;
    out_backlog backlog;
    stream *to;
} writing;

/* OpenEXR calls this between compressing and writing. */
static exr_result_t go_on(exr_encode_pipeline_t *pipeline)
{
    (void)pipeline;
    return EXR_ERR_SUCCESS;
}

/* And this instead of writing. */
static exr_result_t keep_chunk(exr_encode_pipeline_t *pipeline)
{
    worker *self = pipeline->encoding_user_data;
    /* Readers take a chunk of the unpacked size for one that is not compressed; OpenEXR 3.1 makes compressed ones that
     * happen to be as large. What is not compressed lies in a buffer from malloc that may change places with another.
     */
    bool plain = pipeline->compressed_bytes >= pipeline->packed_bytes,
         one = pipeline->compressed_buffer == pipeline->packed_buffer;
    void *buffer = plain ? pipeline->packed_buffer : pipeline->compressed_buffer;
    self->status = out_backlog_give(self->backlog, self->loop, self->tile, &buffer,
                                    plain ? pipeline->packed_bytes : pipeline->compressed_bytes,
                                    plain ? pipeline->packed_alloc_size : 0, self->error);
    if (!plain || one)
        pipeline->compressed_buffer = buffer;
    if (plain)
        pipeline->packed_buffer = buffer;
    return self->status == TL_OK ? EXR_ERR_SUCCESS : EXR_ERR_INCORRECT_CHUNK;
}

static tl_status write_chunk(void *context, uint64_t tile, const void *bytes, size_t count, tl_error *error)
{
    const writing *w = context;
    tl_window window = out_tile_window(&w->tiling, tile);
    exr_result_t code = exr_write_tile_chunk(w->file, PART, (int)(window.x / OUT_TILE), (int)(window.y / OUT_TILE),
                                             w->level, w->level, bytes, count);
    return code == EXR_ERR_SUCCESS ? TL_OK : exr_failed(code, w->to, error);
}

/* The file keeps channels by their names' order. */
static void set_channels(const writing *w, worker *self, tl_window window)
{
    size_t samples = (size_t)(window.width * window.height);
    for (int c = 0; c < self->pipeline.channel_count; c++) {
        exr_coding_channel_info_t *channel = &self->pipeline.channels[c];
        size_t k = 0;
        while (k + 1 < w->planes->count && strcmp(w->planes->names[k], channel->channel_name) != 0)
            k++;
        int size = self->halves ? sizeof *self->halves : sizeof *self->heights;
        channel->encode_from_ptr = self->halves ? (const uint8_t *)(self->halves + k * samples)
                                                : (const uint8_t *)(self->heights + k * samples);
        channel->user_pixel_stride = size;
        channel->user_line_stride = (int32_t)window.width * size;
        channel->user_bytes_per_element = (int16_t)size;
        channel->user_data_type = self->halves ? EXR_PIXEL_HALF : EXR_PIXEL_FLOAT;
    }
}

/* One channel's rows are what the file holds already, on a machine whose bytes run as an EXR's: they need not be turned
 * sample by sample, as OpenEXR does. Whole tiles change places with its buffer, which is from malloc as ours is. */
static exr_result_t pack_rows(exr_encode_pipeline_t *pipeline)
{
    worker *self = pipeline->encoding_user_data;
    if (pipeline->packed_alloc_size == OUT_TILE * OUT_TILE * sizeof(float) && !self->halves) {
        void *theirs = pipeline->packed_buffer;
        pipeline->packed_buffer = self->heights;
        self->heights = theirs;
    } else
        memcpy(pipeline->packed_buffer, pipeline->channels[0].encode_from_ptr, pipeline->chunk.unpacked_size);
    pipeline->packed_bytes = pipeline->chunk.unpacked_size;
    return EXR_ERR_SUCCESS;
}

static exr_result_t encode(const writing *w, worker *self, tl_window window)
{
    exr_chunk_info_t chunk;
    exr_encode_pipeline_t *pipeline = &self->pipeline;
    exr_result_t code = exr_write_tile_chunk_info(w->file, PART, (int)(window.x / OUT_TILE), (int)(window.y / OUT_TILE),
                                                  w->level, w->level, &chunk);
    if (code == EXR_ERR_SUCCESS)
        code = self->begun ? exr_encoding_update(w->file, PART, &chunk, pipeline)
                           : exr_encoding_initialize(w->file, PART, &chunk, pipeline);
    if (code != EXR_ERR_SUCCESS)
        return code;
    set_channels(w, self, window);
    pipeline->encoding_user_data = self;
    code = self->begun ? EXR_ERR_SUCCESS : exr_encoding_choose_default_routines(w->file, PART, pipeline);
    self->begun = true;
    pipeline->yield_until_ready_fn = go_on;
    pipeline->write_fn = keep_chunk;
    if (w->planes->count == 1 && __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__)
        pipeline->convert_and_pack_fn = pack_rows;
    return code == EXR_ERR_SUCCESS ? exr_encoding_run(w->file, PART, pipeline) : code;
}

static tl_status read_tile(const writing *w, tl_window window, float *out, tl_error *error)
{
    if (w->planes->read)
        return w->planes->read(w->planes->context, window, out, error);
    if (w->level == 0)
        return tl_source_read(w->source, w->source->info.level, window, out, error);
    return out_mip_read(&w->mip, w->level, window, out, error);
}

/* The nearest halves, where they are near enough. */
static tl_status halve_heights(const writing *w, worker *self, size_t count, tl_error *error)
{
    for (size_t k = 0; self->halves && k < count; k++) {
        float z = self->heights[k];
        self->halves[k] = imath_float_to_half(z);
        double moved = fabs((double)imath_half_to_float(self->halves[k]) - (double)z);
        if (moved > w->half_error)
            return tl_fail(error, TL_ERROR_ARGUMENT,
                           "%s: a half float would move a height of %.9g by %.3g, more than %.3g; take floats, or a "
                           "larger height quantum",
                           tl_output_path(w->to->output), (double)z, moved, w->half_error);
    }
    return TL_OK;
}

static tl_status write_tile(void *context, tl_parallel *loop, uint64_t tile, unsigned index, tl_error *error)
{
    writing *w = context;
    worker *self = &w->workers[index];
    tl_window window = out_tile_window(&w->tiling, tile);
    tl_status status = read_tile(w, window, self->heights, error);
    if (status != TL_OK)
        return status;
    if (!w->planes->read)
        status = out_mip_add(&w->mip, w->level, window, self->heights, error);
    if (status != TL_OK)
        return status;
    out_extent_add(&self->extent, self->heights, (size_t)(window.width * window.height));
    status = halve_heights(w, self, (size_t)(window.width * window.height), error);
    if (status != TL_OK)
        return status;
    self->backlog = &w->backlog;
    self->loop = loop;
    self->tile = tile;
    self->status = TL_OK;
    self->error = error;
    exr_result_t code = encode(w, self, window);
    if (self->status != TL_OK || code == EXR_ERR_SUCCESS)
        return self->status;
    return exr_failed(code, w->to, error);
}

/* Level after level; the coarser ones are there when the finer ones are written. */
static tl_status write_levels(writing *w, const tl_run *run, tl_error *error)
{
    tl_status status = TL_OK;
    tl_run quiet = run ? *run : (tl_run){0};
    quiet.progress = NULL; /* of the coarser levels, which are no work */
    for (w->level = 0; w->level < w->mip.count && status == TL_OK; w->level++) {
        int64_t width = w->mip.levels[w->level].width, height = w->mip.levels[w->level].height;
        w->tiling = (out_tiling){tl_div_up(width, OUT_TILE), tl_div_up(height, OUT_TILE), width, height};
        uint64_t tiles = (uint64_t)w->tiling.columns * (uint64_t)w->tiling.rows;
        out_backlog_restart(&w->backlog);
        status = tl_parallel_for(w->level ? &quiet : run, tiles, (uint64_t)(width * height), write_tile, w, error);
    }
    return status;
}

static tl_status write_tiles(writing *w, const tl_run *run, out_extent *extent, tl_error *error)
{
    unsigned count = tl_parallel_workers(run, (uint64_t)w->tiling.columns * (uint64_t)w->tiling.rows);
    w->workers = calloc(count, sizeof *w->workers);
    if (!w->workers)
        return tl_fail_memory(error, tl_output_path(w->to->output));
    w->backlog = (out_backlog){.write = write_chunk, .context = w};
    tl_status status = out_backlog_init(&w->backlog, count, tl_output_path(w->to->output), error);
    for (unsigned i = 0; i < count; i++) {
        w->workers[i].extent = out_extent_empty();
        w->workers[i].heights = tl_alloc_grid(OUT_TILE, OUT_TILE, w->planes->count * sizeof(float));
        if (w->half_error > 0)
            w->workers[i].halves = tl_alloc_grid(OUT_TILE, OUT_TILE, sizeof(uint16_t));
        if (!w->workers[i].heights || (w->half_error > 0 && !w->workers[i].halves))
            status = tl_fail_memory(error, tl_output_path(w->to->output));
    }
    if (status == TL_OK)
        status = write_levels(w, run, error);
    for (unsigned i = 0; i < count; i++) {
        out_extent_merge(extent, &w->workers[i].extent);
        if (w->workers[i].begun)
            exr_encoding_destroy(w->file, &w->workers[i].pipeline);
        free(w->workers[i].heights);
        free(w->workers[i].halves);
    }
    out_backlog_finish(&w->backlog);
    free(w->workers);
    return status;
}

/* ---- the header's late values ---- */

/* In the file an attribute is its name, its type (both ended by 0), a 32-bit size and the value. */
static tl_status patch_float(tl_output *output, char *header, size_t bytes, const char *name, float value,
                             tl_error *error)
{
    char pattern[64] = {0};
    size_t length = strlen(name) + 1;
    memcpy(pattern, name, length);
    memcpy(pattern + length, "float\0\4\0\0\0", 10);
    length += 10;
    for (size_t at = 0; at + length + sizeof value <= bytes; at++)
        if (memcmp(header + at, pattern, length) == 0)
            return tl_output_write_at(output, &value, sizeof value, at + length, error);
    return tl_fail(error, TL_ERROR_IO, "%s: the header that OpenEXR wrote lacks %s", tl_output_path(output), name);
}

static tl_status patch_extent(tl_output *output, const out_extent *extent, tl_error *error)
{
    enum { HEADER_LIMIT = 1 << 20 };
    if (extent->low > extent->high)
        return TL_OK; /* all void: the range stays NaN */
    char *header = malloc(HEADER_LIMIT);
    if (!header)
        return tl_fail_memory(error, tl_output_path(output));
    ssize_t bytes = pread(tl_output_descriptor(output), header, HEADER_LIMIT, 0);
    tl_status status = patch_float(output, header, bytes > 0 ? (size_t)bytes : 0, low_name, extent->low, error);
    if (status == TL_OK)
        status = patch_float(output, header, (size_t)bytes, high_name, extent->high, error);
    free(header);
    return status;
}

static tl_status check_compression(tl_compression compression, const char *path, tl_error *error)
{
    if (compression < TL_COMPRESSION_DEFLATE)
        return TL_OK;
    return tl_fail(error, TL_ERROR_ARGUMENT,
                   "%s: deflate, zstd, lzw and lerc are compressions of GeoTIFF; use zip, zips, piz or none", path);
}

static tl_status check_size(const tl_source_info *info, const char *path, tl_error *error)
{
    /* the chunk table and the box of an EXR count in 32 bits */
    int64_t samples;
    if (info->width < INT32_MAX / 2 && info->height < INT32_MAX / 2 &&
        tl_int64_mul(info->width, info->height, &samples) && samples / OUT_TILE / OUT_TILE < INT32_MAX / 2)
        return TL_OK;
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %lld x %lld samples are too many for an EXR; refine by fewer levels",
                   path, (long long)info->width, (long long)info->height);
}

static tl_status write_exr(const tl_source *source, const out_planes *planes, tl_output *output,
                           const tl_write_options *options, tl_error *error)
{
    const char *path = tl_output_path(output);
    tl_status status = check_size(&source->info, path, error);
    if (status == TL_OK)
        status = check_compression(options->compression, path, error);
    if (status != TL_OK)
        return status;
    tl_error own = {0};
    stream to = {.output = output, .error = &own, .gathered = malloc(GATHER)};
    if (!to.gathered)
        return tl_fail_memory(error, path);
    exr_context_initializer_t start = EXR_DEFAULT_CONTEXT_INITIALIZER;
    start.error_handler_fn = on_error;
    start.user_data = &to;
    start.write_fn = on_write;
    writing w = {.source = source,
                 .planes = planes,
                 .tiling = out_tiling_of(source),
                 .half_error = options->half_error,
                 .to = &to};
    status = out_mip_init(&w.mip, options->mip, 1, source->info.width, source->info.height, options->run, path, error);
    if (status != TL_OK) {
        free(to.gathered);
        return status;
    }
    exr_result_t code = exr_start_write(&w.file, path, EXR_WRITE_FILE_DIRECTLY, &start);
    if (code != EXR_ERR_SUCCESS) {
        out_mip_finish(&w.mip);
        free(to.gathered);
        return tl_fail(error, TL_ERROR_IO, "%s: OpenEXR cannot write it: %s", path,
                       exr_get_default_error_message(code));
    }
    code = set_header(w.file, &source->info, planes, options);
    out_extent extent = out_extent_empty();
    status = code == EXR_ERR_SUCCESS ? write_tiles(&w, options->run, &extent, error) : exr_failed(code, &to, error);
    out_mip_finish(&w.mip);
    code = exr_finish(&w.file);
    if (status == TL_OK && code != EXR_ERR_SUCCESS)
        status = exr_failed(code, &to, error);
    if (status == TL_OK)
        status = flush(&to);
    free(to.gathered);
    if (own.status != TL_OK && error)
        *error = own;
    return status == TL_OK ? patch_extent(output, &extent, error) : status;
}

tl_status out_exr_write(const tl_source *source, tl_output *output, const tl_write_options *options, tl_error *error)
{
    const out_planes heights = {.count = 1, .names = heights_name};
    return write_exr(source, &heights, output, options, error);
}

tl_status out_exr_write_planes(const tl_source *source, const out_planes *planes, tl_output *output,
                               const tl_write_options *options, tl_error *error)
{
    tl_write_options plain = *options;
    plain.mip = TL_MIP_NONE;
    plain.half_error = 0;
    return write_exr(source, planes, output, &plain, error);
}
