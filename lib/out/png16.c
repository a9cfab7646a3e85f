/* 16-bit grey PNG over the range of heights, with a JSON file beside it that says what the numbers mean. */
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

/* height = offset + scale * value; value 0 is void where there are voids */
typedef struct coding {
    double offset, scale;
    int first; /* value of the lowest height */
} coding;

static coding coding_of(const tl_range *range)
{
    coding c = {.first = range->voids ? 1 : 0};
    if (range->voids == range->samples)
        return c;
    double low = (double)range->low, high = (double)range->high;
    c.scale = (high - low) / (LEVELS - c.first);
    c.offset = low - c.scale * c.first;
    return c;
}

static void encode(const coding *c, const float *heights, size_t count, unsigned char *out)
{
    for (size_t i = 0; i < count; i++) {
        int value = 0;
        if (!isnan(heights[i])) {
            double scaled = c->scale > 0 ? ((double)heights[i] - c->offset) / c->scale : c->first;
            value = (int)fmin(fmax(floor(scaled + 0.5), c->first), LEVELS);
        }
        out[2 * i] = (unsigned char)(value >> 8); /* PNG is big-endian */
        out[2 * i + 1] = (unsigned char)value;
    }
}

/* ---- bands ---- */

typedef struct writing {
    const tl_source *source;
    int64_t rows; /* of a band */
    coding code;
    out_png *encoder;
} writing;

static tl_status write_band(void *context, tl_parallel *loop, uint64_t band, unsigned worker, tl_error *error)
{
    (void)worker;
    writing *w = context;
    const tl_source_info *info = &w->source->info;
    int64_t y = (int64_t)band * w->rows;
    tl_window window = {0, y, info->width, tl_int64_min(w->rows, info->height - y)};
    size_t samples = (size_t)(window.width * window.height);
    float *heights = tl_alloc(samples, sizeof *heights);
    unsigned char *coded = tl_alloc(samples, 2);
    tl_status status = heights && coded ? tl_source_read(w->source, info->level, window, heights, error)
                                        : tl_fail_memory(error, tl_output_path(w->encoder->output));
    if (status == TL_OK) {
        encode(&w->code, heights, samples, coded);
        if (!tl_parallel_wait_turn(loop, band))
            status = tl_fail(error, TL_ERROR_CANCELLED, "interrupted");
    }
    if (status == TL_OK) {
        status = out_png_rows(w->encoder, coded, window.height);
        if (status == TL_OK)
            tl_parallel_end_turn(loop, band);
        else
            *error = w->encoder->error;
    }
    free(heights);
    free(coded);
    return status;
}

static tl_status write_image(const tl_source *source, const coding *code, tl_output *output, const tl_run *run,
                             tl_error *error)
{
    const tl_source_info *info = &source->info;
    out_png e = {0};
    int64_t rows = tl_int64_max(BAND_ROWS_MIN, tl_int64_min(BAND_ROWS_MAX, BAND_SAMPLES / info->width));
    writing w = {.source = source, .rows = rows, .code = *code, .encoder = &e};
    uint64_t samples = (uint64_t)info->width * (uint64_t)info->height;
    tl_status status = out_png_begin(&e, output, OUT_PNG_GREY16, info->width, info->height);
    if (status == TL_OK)
        status = tl_parallel_for(run, (uint64_t)tl_div_up(info->height, rows), samples, write_band, &w, &e.error);
    if (status == TL_OK)
        status = out_png_end(&e);
    out_png_finish(&e);
    if (status != TL_OK && error)
        *error = e.error;
    return status;
}

/* ---- sidecar ---- */

static json_t *sidecar(const tl_source_info *info, const tl_range *range, const coding *code)
{
    double t[6];
    out_gdal_transform(info, t);
    bool empty = range->voids == range->samples;
    json_t *object = json_pack("{s:I, s:I, s:f, s:f, s:o, s:o, s:o, s:s, s:[f,f], s:f}", "width",
                               (json_int_t)info->width, "height", (json_int_t)info->height, "scale", code->scale,
                               "offset", code->offset, "void", range->voids ? json_integer(0) : json_null(), "lowest",
                               empty ? json_null() : json_real((double)range->low), "highest",
                               empty ? json_null() : json_real((double)range->high), "raster_type",
                               info->type == TL_RASTER_AREA ? "area" : "point", "cell_metres", info->georef.cell_x,
                               info->georef.cell_y, "height_unit_metres", info->georef.height_unit);
    if (!object)
        return NULL;
    json_object_set_new(object, "meaning", json_string("height = offset + scale * value"));
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
    return object;
}

static tl_status write_sidecar(const tl_source_info *info, const tl_range *range, const coding *code, tl_output *output,
                               tl_error *error)
{
    json_t *object = sidecar(info, range, code);
    char *text = object ? json_dumps(object, JSON_INDENT(2) | JSON_REAL_PRECISION(17)) : NULL;
    tl_status status =
        text ? tl_output_append(output, text, strlen(text), error) : tl_fail_memory(error, tl_output_path(output));
    if (status == TL_OK)
        status = tl_output_append(output, "\n", 1, error);
    free(text);
    json_decref(object);
    return status;
}

/* "x.png" to "x.json". */
static char *sidecar_path(const char *path)
{
    const char *dot = strrchr(path, '.');
    size_t stem = (size_t)(dot - path);
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

static tl_status write_both(const tl_source *source, tl_output *image, tl_output *json, const tl_run *run,
                            tl_error *error)
{
    tl_range range;
    two_passes passes;
    two_passes_init(&passes, run);
    tl_status status = tl_source_range(source, &passes.run, &range, error);
    if (status != TL_OK)
        return status;
    passes.pass = 1;
    coding code = coding_of(&range);
    status = write_sidecar(&source->info, &range, &code, json, error);
    return status == TL_OK ? write_image(source, &code, image, &passes.run, error) : status;
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

tl_status out_png16_write(const tl_source *source, const char *path, const tl_write_options *options, tl_error *error)
{
    const tl_source_info *info = &source->info;
    if (info->width > INT32_MAX || info->height > INT32_MAX)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: %lld x %lld samples are too many for a PNG; refine by fewer levels", path,
                       (long long)info->width, (long long)info->height);
    char *beside = sidecar_path(path);
    tl_output *image = beside ? tl_output_open(path, options->overwrite, error) : NULL;
    tl_output *json = image ? tl_output_open(beside, options->overwrite, error) : NULL;
    tl_status status = json     ? write_both(source, image, json, options->run, error)
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
