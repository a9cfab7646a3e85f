#include "lib/out/heightmap.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/out.h"
#include "lib/out/png_encoder.h"

#include <jansson.h>

#include <math.h>
#include <string.h>
#include <unistd.h>

enum { BAND_SAMPLES = 1 << 21, BAND_ROWS_MAX = 256, BAND_ROWS_MIN = 4, LEVELS = 65535 };

out_coding out_coding_of(const tl_range *range)
{
    out_coding c = {.first = range->voids ? 1 : 0};
    if (range->voids == range->samples)
        return c;
    double low = (double)range->low, high = (double)range->high;
    c.scale = (high - low) / (LEVELS - c.first);
    c.offset = low - c.scale * c.first;
    return c;
}

static void encode(const out_heightmap *how, const float *heights, size_t count, unsigned char *out)
{
    const out_coding *c = &how->code;
    bool big_endian = how->kind == OUT_HEIGHTMAP_PNG16;
    for (size_t i = 0; i < count; i++) {
        int value = 0;
        if (!isnan(heights[i])) {
            double scaled = c->scale > 0 ? ((double)heights[i] - c->offset) / c->scale : c->first;
            value = (int)fmin(fmax(floor(scaled + 0.5), c->first), LEVELS);
        }
        out[2 * i + !big_endian] = (unsigned char)(value >> 8);
        out[2 * i + big_endian] = (unsigned char)value;
    }
}

static void encode_floats(const float *heights, size_t count, unsigned char *out)
{
    for (size_t i = 0; i < count; i++) {
        uint32_t bits;
        memcpy(&bits, &heights[i], sizeof bits);
        for (int byte = 0; byte < 4; byte++)
            out[4 * i + (size_t)byte] = (unsigned char)(bits >> (8 * byte));
    }
}

static size_t sample_bytes(const out_heightmap *how)
{
    return how->kind == OUT_HEIGHTMAP_RAW32 ? 4 : 2;
}

static void flip_rows(unsigned char *rows, size_t row_bytes, int64_t count)
{
    for (int64_t a = 0, b = count - 1; a < b; a++, b--)
        for (size_t k = 0; k < row_bytes; k++) {
            unsigned char byte = rows[(size_t)a * row_bytes + k];
            rows[(size_t)a * row_bytes + k] = rows[(size_t)b * row_bytes + k];
            rows[(size_t)b * row_bytes + k] = byte;
        }
}

/* ---- bands ---- */

typedef struct writing {
    const tl_source *source;
    const out_heightmap *how;
    int64_t rows; /* of a band */
    tl_output *output;
    out_png *encoder; /* of a PNG, whose rows come in order */
} writing;

/* The rows of a band, as they will be in the file; band 0 has the file's first ones. */
static tl_status make_band(const writing *w, uint64_t band, int64_t *count, unsigned char *coded, tl_error *error)
{
    const out_heightmap *how = w->how;
    int64_t first = (int64_t)band * w->rows, y = first;
    *count = tl_int64_min(w->rows, how->window.height - first);
    if (how->bottom_up)
        y = how->window.height - first - *count;
    tl_window window = {how->window.x, how->window.y + y, how->window.width, *count};
    size_t samples = (size_t)(window.width * window.height), row_bytes = (size_t)window.width * sample_bytes(how);
    float *heights = tl_alloc(samples, sizeof *heights);
    tl_status status = heights ? tl_source_read(w->source, w->source->info.level, window, heights, error)
                               : tl_fail_memory(error, tl_output_path(w->output));
    if (status == TL_OK && how->kind == OUT_HEIGHTMAP_RAW32)
        encode_floats(heights, samples, coded);
    else if (status == TL_OK)
        encode(how, heights, samples, coded);
    if (status == TL_OK && how->bottom_up)
        flip_rows(coded, row_bytes, *count);
    free(heights);
    return status;
}

/* In order into a PNG, else wherever the band has its place. */
static tl_status put_band(writing *w, tl_parallel *loop, uint64_t band, int64_t count, const unsigned char *coded,
                          tl_error *error)
{
    size_t row_bytes = (size_t)w->how->window.width * sample_bytes(w->how);
    if (!w->encoder)
        return tl_output_write_at(w->output, coded, (size_t)count * row_bytes,
                                  band * (uint64_t)w->rows * (uint64_t)row_bytes, error);
    if (!tl_parallel_wait_turn(loop, band))
        return tl_fail(error, TL_ERROR_CANCELLED, "interrupted");
    tl_status status = out_png_rows(w->encoder, coded, count);
    if (status == TL_OK)
        tl_parallel_end_turn(loop, band);
    else if (error)
        *error = w->encoder->error;
    return status;
}

static tl_status write_band(void *context, tl_parallel *loop, uint64_t band, unsigned worker, tl_error *error)
{
    (void)worker;
    writing *w = context;
    int64_t count = 0;
    unsigned char *coded = tl_alloc((size_t)(w->rows * w->how->window.width), sample_bytes(w->how));
    tl_status status =
        coded ? make_band(w, band, &count, coded, error) : tl_fail_memory(error, tl_output_path(w->output));
    if (status == TL_OK)
        status = put_band(w, loop, band, count, coded, error);
    free(coded);
    return status;
}

tl_status out_heightmap_write(const tl_source *source, const out_heightmap *how, tl_output *output, const tl_run *run,
                              tl_error *error)
{
    const tl_window *window = &how->window;
    out_png e = {0};
    int64_t rows = tl_int64_max(BAND_ROWS_MIN, tl_int64_min(BAND_ROWS_MAX, BAND_SAMPLES / window->width));
    writing w = {.source = source, .how = how, .rows = rows, .output = output};
    uint64_t samples = (uint64_t)window->width * (uint64_t)window->height;
    tl_status status = TL_OK;
    if (how->kind == OUT_HEIGHTMAP_PNG16) {
        w.encoder = &e;
        status = out_png_begin(&e, output, OUT_PNG_GREY16, window->width, window->height);
    }
    bool begun = status == TL_OK;
    if (begun)
        status = tl_parallel_for(run, (uint64_t)tl_div_up(window->height, rows), samples, write_band, &w, error);
    if (status == TL_OK && w.encoder)
        status = out_png_end(&e);
    if (error && e.error.text[0] && (!begun || status != TL_OK))
        *error = e.error;
    out_png_finish(&e);
    return status;
}

/* ---- sidecar ---- */

void out_json_add_record(json_t *object, const tl_source_info *info)
{
    double t[6];
    out_gdal_transform(info, t);
    if (info->georef.located)
        json_object_set_new(object, "geotransform", json_pack("[f,f,f,f,f,f]", t[0], t[1], t[2], t[3], t[4], t[5]));
    if (info->georef.crs) {
        json_object_set_new(object, "crs", json_string(tl_crs_name(info->georef.crs)));
        json_object_set_new(object, "crs_wkt", json_string(tl_crs_wkt(info->georef.crs)));
    }
    json_t *parameters = json_object();
    for (size_t i = 0; i < info->parameter_count; i++)
        json_object_set_new(parameters, info->parameters[i].name, json_string(info->parameters[i].value));
    json_object_set_new(object, "parameters", parameters);
}

static const char *const meanings[] = {
    [OUT_HEIGHTMAP_PNG16] = "height = offset + scale * value",
    [OUT_HEIGHTMAP_R16] = "height = offset + scale * value; rows of unsigned 16-bit values, the low byte first",
    [OUT_HEIGHTMAP_RAW32] = "rows of 32-bit floats, the low byte first; voids are NaN"};

static json_t *sidecar(const tl_source_info *info, const tl_range *range, const out_heightmap *how)
{
    const out_coding *code = &how->code;
    bool floats = how->kind == OUT_HEIGHTMAP_RAW32;
    bool empty = range->voids == range->samples;
    json_t *object =
        json_pack("{s:I, s:I, s:f, s:f, s:o, s:o, s:o, s:s, s:[f,f], s:f}", "width", (json_int_t)info->width, "height",
                  (json_int_t)info->height, "scale", floats ? 1 : code->scale, "offset", floats ? 0 : code->offset,
                  "void", range->voids && !floats ? json_integer(0) : json_null(), "lowest",
                  empty ? json_null() : json_real((double)range->low), "highest",
                  empty ? json_null() : json_real((double)range->high), "raster_type",
                  info->type == TL_RASTER_AREA ? "area" : "point", "cell_metres", info->georef.cell_x,
                  info->georef.cell_y, "height_unit_metres", info->georef.height_unit);
    if (!object)
        return NULL;
    json_object_set_new(object, "meaning", json_string(meanings[how->kind]));
    out_json_add_record(object, info);
    return object;
}

static tl_status write_sidecar(const tl_source_info *info, const tl_range *range, const out_heightmap *how,
                               tl_output *output, tl_error *error)
{
    json_t *object = sidecar(info, range, how);
    char *text = object ? json_dumps(object, JSON_INDENT(2) | JSON_REAL_PRECISION(17)) : NULL;
    tl_status status =
        text ? tl_output_append(output, text, strlen(text), error) : tl_fail_memory(error, tl_output_path(output));
    if (status == TL_OK)
        status = tl_output_append(output, "\n", 1, error);
    free(text);
    json_decref(object);
    return status;
}

char *out_sidecar_path(const char *path, out_heightmap_kind kind)
{
    const char *dot = strrchr(path, '.');
    size_t stem = kind == OUT_HEIGHTMAP_PNG16 ? (size_t)(dot - path) : strlen(path);
    char *result = malloc(stem + sizeof ".json");
    if (result) {
        memcpy(result, path, stem);
        strcpy(result + stem, ".json");
    }
    return result;
}

/* The heights are read twice, for the numbers depend on their range; the caller sees one run of twice the work. */
typedef struct two_passes {
    tl_run run; /* what the passes get */
    const tl_run *whole;
    unsigned pass; /* 0 or 1 */
} two_passes;

static void report_pass(void *user, uint64_t done, uint64_t total)
{
    const two_passes *self = user;
    self->whole->progress(self->whole->user, self->pass * total + done, 2 * total);
}

static void two_passes_init(two_passes *self, const tl_run *run)
{
    *self = (two_passes){.whole = run};
    if (!run)
        return;
    self->run = *run;
    self->run.user = self;
    if (run->progress)
        self->run.progress = report_pass;
}

static tl_status write_both(const tl_source *source, out_heightmap_kind kind, tl_output *image, tl_output *json,
                            const tl_run *run, tl_error *error)
{
    tl_range range;
    two_passes passes;
    two_passes_init(&passes, run);
    tl_status status = tl_source_range(source, &passes.run, &range, error);
    if (status != TL_OK)
        return status;
    passes.pass = 1;
    out_heightmap how = {.kind = kind, .window = {0, 0, source->info.width, source->info.height}};
    how.code = out_coding_of(&range);
    status = write_sidecar(&source->info, &range, &how, json, error);
    return status == TL_OK ? out_heightmap_write(source, &how, image, &passes.run, error) : status;
}

/* Commits both, or neither: all bytes are written before the first has its name. The sidecar goes first: a picture
 * without it cannot be read, so it must not be the one that is there alone. */
static tl_status commit_both(tl_output *image, tl_output *json, const char *beside, bool overwrite, tl_error *error)
{
    tl_status status = tl_output_flush(image, error);
    if (status == TL_OK)
        status = tl_output_flush(json, error);
    if (status != TL_OK) {
        tl_output_abort(json);
        tl_output_abort(image);
        return status;
    }
    status = tl_output_commit(json, error);
    if (status != TL_OK) {
        tl_output_abort(image);
        return status;
    }
    status = tl_output_commit(image, error);
    if (status != TL_OK && !overwrite)
        unlink(beside); /* it is certainly ours: an older one would have been refused */
    return status;
}

static tl_status write_pair(const tl_source *source, out_heightmap_kind kind, const char *path,
                            const tl_write_options *options, tl_error *error)
{
    char *beside = out_sidecar_path(path, kind);
    tl_output *image = beside ? tl_output_open(path, options->overwrite, error) : NULL;
    tl_output *json = image ? tl_output_open(beside, options->overwrite, error) : NULL;
    tl_status status = json     ? write_both(source, kind, image, json, options->run, error)
                       : beside ? TL_ERROR_IO
                                : tl_fail_memory(error, path);
    if (status == TL_OK)
        status = commit_both(image, json, beside, options->overwrite, error);
    else {
        tl_output_abort(json);
        tl_output_abort(image);
    }
    free(beside);
    return status;
}

tl_status out_png16_write(const tl_source *source, const char *path, const tl_write_options *options, tl_error *error)
{
    const tl_source_info *info = &source->info;
    if (info->width > INT32_MAX || info->height > INT32_MAX)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: %lld x %lld samples are too many for a PNG; refine by fewer levels", path,
                       (long long)info->width, (long long)info->height);
    return write_pair(source, OUT_HEIGHTMAP_PNG16, path, options, error);
}

tl_status out_r16_write(const tl_source *source, const char *path, const tl_write_options *options, tl_error *error)
{
    return write_pair(source, OUT_HEIGHTMAP_R16, path, options, error);
}

tl_status out_raw_write(const tl_source *source, const char *path, const tl_write_options *options, tl_error *error)
{
    return write_pair(source, OUT_HEIGHTMAP_RAW32, path, options, error);
}
