/* Layers as files: EXR of their channels, 8-bit PNG, or what any grid can be written as where they have one channel. */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/out/layer_paint.h"
#include "lib/out/out.h"
#include "lib/out/png_encoder.h"
#include "lib/scene/layers.h"
#include "lib/scene/light.h"
#include "lib/scene/north_up.h"

#include <math.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>

/* ---- A channel as a source ---- */

static const tl_layer_kind *kind_of(const char *name)
{
    const tl_layer_kind *kind = tl_layers();
    while (kind->name && strcmp(kind->name, name) != 0)
        kind++;
    return kind->name ? kind : NULL;
}

typedef struct layer_source {
    tl_source source;
    scene_layer *layer;
    size_t channel;
    tl_parameter *parameters;
} layer_source;

static tl_status layer_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const layer_source *l = (const layer_source *)self;
    size_t channels = scene_layer_kind(l->layer)->channels, samples = (size_t)(window.width * window.height);
    (void)level; /* the finest is the only one */
    if (channels == 1)
        return scene_layer_read(l->layer, window, out, error);
    float *all = tl_alloc(channels * samples, sizeof *all);
    tl_status status = all ? scene_layer_read(l->layer, window, all, error) : tl_fail_memory(error, self->info.name);
    if (status == TL_OK)
        memcpy(out, all + l->channel * samples, samples * sizeof *out);
    free(all);
    return status;
}

static void layer_destroy(tl_source *self)
{
    layer_source *l = (layer_source *)self;
    scene_layer_destroy(l->layer);
    free(l->parameters);
    free(l);
}

tl_source *tl_layer_create(const tl_source *heights, const char *kind, size_t channel, const tl_layer_options *options,
                           tl_error *error)
{
    layer_source *l = calloc(1, sizeof *l);
    if (!l) {
        tl_fail_memory(error, heights->info.name);
        return NULL;
    }
    tl_source_info *info = &l->source.info;
    l->source = (tl_source){.info = heights->info, .read = layer_read, .destroy = layer_destroy};
    info->quantum = 0;
    info->georef.height_unit = 1;
    l->channel = channel;
    l->layer = scene_layer_create(heights, kind, options, error);
    info->contents = l->layer ? scene_layer_kind(l->layer)->name : NULL;
    tl_status status = l->layer ? TL_OK : TL_ERROR_ARGUMENT;
    if (l->layer && channel >= scene_layer_kind(l->layer)->channels)
        status = tl_fail(error, TL_ERROR_ARGUMENT, "layer %s has %zu channels, not %zu", kind,
                         scene_layer_kind(l->layer)->channels, channel + 1);
    if (status == TL_OK) {
        l->parameters = tl_parameters_copy(info->parameters, info->parameter_count);
        status = info->parameter_count && !l->parameters ? tl_fail_memory(error, info->name) : TL_OK;
    }
    if (status == TL_OK)
        status = tl_parameters_add(&l->parameters, &info->parameter_count, "layer", kind, error);
    info->parameters = l->parameters;
    if (status == TL_OK)
        return &l->source;
    layer_destroy(&l->source);
    return NULL;
}

/* ---- PNG ---- */

typedef struct painted {
    const tl_layer_kind *kind;
    const scene_layer *layer;
    const tl_source *channel; /* where `layer` is NULL: the only one */
    int64_t width;
} painted;

static unsigned char byte_of(double value)
{
    return (unsigned char)(value > 1 ? 255 : value > 0 ? value * 255 + 0.5 : 0);
}

/* What 8 bits of a channel go up to, from 0; 0: there is no such range. */
static double range_of(const tl_layer_kind *kind)
{
    if (strcmp(kind->name, "slope") == 0)
        return 90;
    return kind->channels > 1 || strcmp(kind->name, "mask") == 0 || strcmp(kind->name, "hurst") == 0;
}

void out_layer_paint(const tl_layer_kind *kind, const float *values, size_t stride, unsigned char out[4])
{
    memset(out, 0, 4);
    if (isnan(values[0]))
        return;
    bool shares = kind->channels == 4, colours = strcmp(kind->name, "colour") == 0 || strcmp(kind->name, "albedo") == 0;
    out[3] = 255;
    for (size_t c = 0; c < kind->channels; c++) {
        double v = (double)values[c * stride];
        out[c] = colours ? scene_encode(values[c * stride])
                         : byte_of(shares                ? v
                                   : kind->channels == 3 ? (v + 1) / 2
                                                         : v / range_of(kind));
    }
    if (kind->channels == 1)
        out[1] = out[2] = out[0];
}

static tl_status paint_rows(void *context, int64_t y, int64_t count, unsigned char *rgba, tl_error *error)
{
    const painted *self = context;
    const tl_window window = {0, y, self->width, count};
    size_t samples = (size_t)(count * self->width);
    float *values = tl_alloc(self->kind->channels * samples, sizeof *values);
    tl_status status = !values       ? tl_fail_memory(error, "a layer's rows")
                       : self->layer ? scene_layer_read_upright(self->layer, window, values, error)
                                     : tl_source_read(self->channel, self->channel->info.level, window, values, error);
    for (size_t k = 0; status == TL_OK && k < samples; k++)
        out_layer_paint(self->kind, values + k, samples, rgba + 4 * k);
    free(values);
    return status;
}

static tl_status paint(const tl_source *heights, painted *context, tl_output *output, const tl_run *run,
                       tl_error *error)
{
    context->width = heights->info.width;
    scene_picture picture = {
        .width = heights->info.width, .height = heights->info.height, .context = context, .rows = paint_rows};
    if (range_of(context->kind) == 0)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %s has no range for 8 bits; write it as .exr or .tif",
                       tl_output_path(output), context->kind->name);
    tl_status status = scene_picture_check(picture.width, picture.height, error);
    scene_encode_prepare();
    return status == TL_OK ? out_picture_write(&picture, output, run, error) : status;
}

static tl_status write_png(const tl_source *heights, const scene_layer *layer, tl_output *output, const tl_run *run,
                           tl_error *error)
{
    painted context = {.kind = scene_layer_kind(layer), .layer = layer};
    return paint(heights, &context, output, run, error);
}

/* ---- EXR ---- */

static tl_status read_planes(void *context, tl_window window, float *out, tl_error *error)
{
    return scene_layer_read_upright(context, window, out, error);
}

static tl_status write_exr(const tl_source *heights, scene_layer *layer, tl_output *output,
                           const tl_write_options *options, tl_error *error)
{
    const tl_layer_kind *kind = scene_layer_kind(layer);
    out_planes planes = {.count = kind->channels, .names = kind->channel_names, .read = read_planes, .context = layer};
    tl_source record = *heights; /* with what the file is */
    record.info.contents = kind->name;
    tl_parameter *parameters = tl_parameters_copy(heights->info.parameters, heights->info.parameter_count);
    tl_status status = TL_OK;
    if (heights->info.parameter_count && !parameters)
        status = tl_fail_memory(error, heights->info.name);
    if (status == TL_OK)
        status = tl_parameters_add(&parameters, &record.info.parameter_count, "layer", kind->name, error);
    record.info.parameters = parameters;
    if (status == TL_OK)
        status = out_exr_write_planes(&record, &planes, output, options, error);
    free(parameters);
    return status;
}

/* ---- Any ---- */

static bool ends_with(const char *path, const char *ending)
{
    const char *dot = strrchr(path, '.');
    return dot && strcasecmp(dot + 1, ending) == 0;
}

/* One file of several channels, or a picture. `upright` has the north on top; the layer is made of `heights`, which may
 * be a field, as it then would not be any more, and turned. */
static tl_status write_channels(const tl_source *heights, const tl_source *upright, const char *kind, const char *path,
                                const tl_layer_options *options, tl_error *error)
{
    scene_layer *layer = scene_layer_create(heights, kind, options, error);
    tl_output *output = layer ? tl_output_open(path, options->overwrite, error) : NULL;
    tl_status status = output ? TL_OK : layer ? TL_ERROR_IO : TL_ERROR_ARGUMENT;
    tl_write_options writing = {
        .overwrite = options->overwrite, .compression = options->compression, .run = options->run};
    if (status == TL_OK)
        status = ends_with(path, "png") ? write_png(upright, layer, output, options->run, error)
                                        : write_exr(upright, layer, output, &writing, error);
    if (status == TL_OK)
        status = tl_output_commit(output, error);
    else
        tl_output_abort(output);
    scene_layer_destroy(layer);
    return status;
}

static tl_status write_scalar(const tl_source *heights, const char *kind, const char *path,
                              const tl_layer_options *options, tl_error *error)
{
    tl_write_options writing = {
        .overwrite = options->overwrite, .compression = options->compression, .run = options->run};
    tl_source *layer = tl_layer_create(heights, kind, 0, options, error);
    tl_status status = layer ? tl_write_grid(layer, path, &writing, error) : TL_ERROR_ARGUMENT;
    tl_source_destroy(layer);
    return status;
}

/* Of one channel, as a picture: the layer is turned, and not the heights, which then would not be the field any more.
 */
static tl_status write_grey(const tl_source *heights, const char *kind, const char *path,
                            const tl_layer_options *options, tl_error *error)
{
    tl_source *layer = tl_layer_create(heights, kind, 0, options, error);
    tl_source *upright = layer ? scene_north_up(layer, error) : NULL;
    tl_output *output = upright ? tl_output_open(path, options->overwrite, error) : NULL;
    tl_status status = output ? TL_OK : upright ? TL_ERROR_IO : layer ? TL_ERROR_MEMORY : TL_ERROR_ARGUMENT;
    painted context = {.kind = kind_of(kind), .channel = upright};
    if (status == TL_OK)
        status = paint(upright, &context, output, options->run, error);
    if (status == TL_OK)
        status = tl_output_commit(output, error);
    else
        tl_output_abort(output);
    tl_source_destroy(upright);
    tl_source_destroy(layer);
    return status;
}

tl_status tl_write_layer(const tl_source *heights, const char *kind, const char *path, const tl_layer_options *options,
                         tl_error *error)
{
    const tl_layer_options defaults = {0};
    options = options ? options : &defaults;
    const tl_layer_kind *found = kind_of(kind);
    bool picture = ends_with(path, "png"), exr = ends_with(path, "exr"),
         tif = ends_with(path, "tif") || ends_with(path, "tiff");
    if (!picture && !exr && !(tif && found && found->channels == 1))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: layers are written as .exr or .png, and those of one value a sample as .tif", path);
    if (!picture && found && found->channels == 1)
        return write_scalar(heights, kind, path, options, error);
    if (found && found->channels == 1)
        return write_grey(heights, kind, path, options, error);
    tl_source *upright = scene_north_up(heights, error);
    tl_status status = upright ? write_channels(heights, upright, kind, path, options, error) : TL_ERROR_MEMORY;
    tl_source_destroy(upright);
    return status;
}

/* ---- All in one ---- */

enum { MOST_KINDS = 16, NAME_ROOM = 32 };

/* Heights, and what is made of them, as channels. */
typedef struct collection {
    const tl_source *heights;
    scene_layer *layers[MOST_KINDS];
    size_t count, channels;
    char names[1 + MOST_KINDS * SCENE_LAYER_CHANNELS][NAME_ROOM];
    const char *name_list[1 + MOST_KINDS * SCENE_LAYER_CHANNELS];
} collection;

static tl_status read_collection(void *context, tl_window window, float *out, tl_error *error)
{
    const collection *c = context;
    size_t samples = (size_t)(window.width * window.height);
    tl_status status = tl_source_read(c->heights, c->heights->info.level, window, out, error);
    for (size_t k = 0; k < c->count && status == TL_OK; k++) {
        out += samples * (k ? scene_layer_kind(c->layers[k - 1])->channels : 1);
        status = scene_layer_read_upright(c->layers[k], window, out, error);
    }
    return status;
}

static void name_channel(collection *c, const char *layer, const char *channel)
{
    snprintf(c->names[c->channels], NAME_ROOM, "%s%s%s", layer, *layer ? "." : "", channel);
    c->name_list[c->channels] = c->names[c->channels];
    c->channels++;
}

static tl_status add_layer(collection *c, const tl_source *surface, const char *name, const tl_layer_options *options,
                           tl_error *error)
{
    for (size_t k = 0; k < c->count; k++)
        if (strcmp(scene_layer_kind(c->layers[k])->name, name) == 0)
            return tl_fail(error, TL_ERROR_ARGUMENT, "the layer %.60s is asked for twice", name);
    if (c->count == MOST_KINDS)
        return tl_fail(error, TL_ERROR_ARGUMENT, "at most %d layers go into one file", MOST_KINDS);
    scene_layer *layer = scene_layer_create(surface, name, options, error);
    if (!layer)
        return TL_ERROR_ARGUMENT;
    c->layers[c->count++] = layer;
    const tl_layer_kind *kind = scene_layer_kind(layer);
    for (size_t k = 0; k < kind->channels; k++)
        name_channel(c, kind->name, kind->channels > 1 ? kind->channel_names[k] : "Y");
    return TL_OK;
}

static tl_status write_collection(collection *c, tl_output *output, const tl_layer_options *options, tl_error *error)
{
    const out_planes planes = {.count = c->channels, .names = c->name_list, .read = read_collection, .context = c};
    const tl_write_options writing = {.compression = options->compression, .run = options->run};
    char list[MOST_KINDS * NAME_ROOM] = "";
    for (size_t k = 0, used = 0; k < c->count; k++)
        used += (size_t)snprintf(list + used, sizeof list - used, "%s%s", k ? "," : "",
                                 scene_layer_kind(c->layers[k])->name);
    tl_source record = *c->heights;
    tl_parameter *parameters = tl_parameters_copy(record.info.parameters, record.info.parameter_count);
    if (record.info.parameter_count && !parameters)
        return tl_fail_memory(error, record.info.name);
    tl_status status = tl_parameters_add(&parameters, &record.info.parameter_count, "layers", list, error);
    record.info.parameters = parameters;
    if (status == TL_OK)
        status = out_exr_write_planes(&record, &planes, output, &writing, error);
    free(parameters);
    return status;
}

static tl_status collect(const tl_source *heights, const tl_source *surface, const char *const *kinds, size_t count,
                         const char *path, const tl_layer_options *options, tl_error *error)
{
    collection *c = calloc(1, sizeof *c);
    tl_output *output = NULL;
    tl_status status = c ? TL_OK : tl_fail_memory(error, path);
    if (c) {
        c->heights = heights;
        name_channel(c, "", "Y");
    }
    for (size_t k = 0; k < count && status == TL_OK; k++)
        status = add_layer(c, surface, kinds[k], options, error);
    if (status == TL_OK) {
        output = tl_output_open(path, options->overwrite, error);
        status = output ? write_collection(c, output, options, error) : TL_ERROR_IO;
    }
    if (status == TL_OK)
        status = tl_output_commit(output, error);
    else
        tl_output_abort(output);
    for (size_t k = 0; c && k < c->count; k++)
        scene_layer_destroy(c->layers[k]);
    free(c);
    return status;
}

tl_status tl_write_layers(const tl_source *heights, const tl_source *surface, const char *const *kinds, size_t count,
                          const char *path, const tl_layer_options *options, tl_error *error)
{
    const tl_layer_options defaults = {0};
    options = options ? options : &defaults;
    surface = surface ? surface : heights;
    if (!ends_with(path, "exr"))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: only an .exr holds heights and layers in one file", path);
    tl_source *upright = scene_north_up(heights, error);
    tl_status status = upright ? collect(upright, surface, kinds, count, path, options, error) : TL_ERROR_MEMORY;
    tl_source_destroy(upright);
    return status;
}
