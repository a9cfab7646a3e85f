#include "lib/out/heightmap_read.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/out/heightmap.h"
#include "lib/out/place.h"
#include "lib/out/png_decoder.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <unistd.h>

enum { JSON_LIMIT = 1 << 20 };

typedef struct heightmap {
    tl_source source;
    char *path, *beside;
    int descriptor;
    out_heightmap_kind kind;
    out_coding code;
    bool zero_is_void;
    unsigned char *samples; /* of a PNG, the low byte first */
    tl_parameter *parameters;
} heightmap;

static const struct {
    const char *ending;
    out_heightmap_kind kind;
} kinds[] = {{".png", OUT_HEIGHTMAP_PNG16}, {".r16", OUT_HEIGHTMAP_R16}, {".raw", OUT_HEIGHTMAP_RAW32}};

/* OUT_HEIGHTMAP_RAW32 + 1: none. */
static out_heightmap_kind kind_of(const char *path)
{
    size_t length = strlen(path);
    for (size_t k = 0; k < sizeof kinds / sizeof *kinds; k++)
        if (length > 4 && strcasecmp(path + length - 4, kinds[k].ending) == 0)
            return kinds[k].kind;
    return OUT_HEIGHTMAP_RAW32 + 1;
}

bool out_heightmap_is_name(const char *path)
{
    return kind_of(path) <= OUT_HEIGHTMAP_RAW32;
}

/* ---- Reading ---- */

static size_t sample_bytes(const heightmap *self)
{
    return self->kind == OUT_HEIGHTMAP_RAW32 ? 4 : 2;
}

static void decode(const heightmap *self, const unsigned char *from, size_t count, float *out)
{
    for (size_t i = 0; i < count && self->kind != OUT_HEIGHTMAP_RAW32; i++) {
        unsigned value = (unsigned)from[2 * i] | (unsigned)from[2 * i + 1] << 8;
        out[i] = self->zero_is_void && !value ? NAN : (float)(self->code.offset + self->code.scale * value);
    }
    for (size_t i = 0; i < count && self->kind == OUT_HEIGHTMAP_RAW32; i++) {
        uint32_t bits = (uint32_t)from[4 * i] | (uint32_t)from[4 * i + 1] << 8 | (uint32_t)from[4 * i + 2] << 16 |
                        (uint32_t)from[4 * i + 3] << 24;
        memcpy(&out[i], &bits, sizeof bits);
        out[i] = isfinite(out[i]) ? out[i] : NAN;
    }
}

static tl_status read_bytes(const heightmap *self, unsigned char *to, size_t count, uint64_t offset, tl_error *error)
{
    while (count) {
        ssize_t got = pread(self->descriptor, to, count, (off_t)offset);
        if (got < 0 && errno == EINTR)
            continue;
        if (got < 0)
            return tl_fail_system(error, self->path, "read", errno);
        if (got == 0)
            return tl_fail(error, TL_ERROR_DATA, "%s: became shorter while it was read", self->path);
        to += got;
        count -= (size_t)got;
        offset += (uint64_t)got;
    }
    return TL_OK;
}

static tl_status read_window(const tl_source *base, int level, tl_window window, float *out, tl_error *error)
{
    (void)level;
    const heightmap *self = (const heightmap *)base;
    size_t size = sample_bytes(self), row = (size_t)window.width * size;
    unsigned char *bytes = self->samples ? NULL : tl_alloc(row, 1);
    tl_status status = self->samples || bytes ? TL_OK : tl_fail_memory(error, self->path);
    for (int64_t y = window.y; y < window.y + window.height && status == TL_OK; y++, out += window.width) {
        uint64_t at = ((uint64_t)y * (uint64_t)base->info.width + (uint64_t)window.x) * size;
        if (!self->samples)
            status = read_bytes(self, bytes, row, at, error);
        if (status == TL_OK)
            decode(self, self->samples ? self->samples + at : bytes, (size_t)window.width, out);
    }
    free(bytes);
    return status;
}

static void close_heightmap(tl_source *base)
{
    heightmap *self = (heightmap *)base;
    if (self->descriptor >= 0)
        close(self->descriptor);
    tl_crs_release(base->info.georef.crs);
    free(self->parameters);
    free(self->samples);
    free(self->beside);
    free(self->path);
    free(self);
}

/* ---- The JSON file ---- */

static tl_status strange(const heightmap *self, const char *what, tl_error *error)
{
    return tl_fail(error, TL_ERROR_DATA, "%s: %s; talus writes it beside the heights of %s", self->beside, what,
                   self->path);
}

static tl_status load_json(const heightmap *self, json_t **out, tl_error *error)
{
    struct stat status;
    if (stat(self->beside, &status) != 0 && errno == ENOENT)
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: there is no %s that says what its numbers mean; only heights that talus wrote are read",
                       self->path, self->beside);
    *out = NULL;
    if (stat(self->beside, &status) != 0)
        return tl_fail_system(error, self->beside, "read", errno);
    if (S_ISREG(status.st_mode) && status.st_size <= JSON_LIMIT)
        *out = json_load_file(self->beside, 0, NULL);
    return json_is_object(*out) ? TL_OK : strange(self, "not the JSON that is expected", error);
}

static double number(json_t *object, const char *name)
{
    return json_number_value(json_object_get(object, name));
}

static bool take_numbers(heightmap *self, json_t *json)
{
    tl_source_info *info = &self->source.info;
    info->width = json_integer_value(json_object_get(json, "width"));
    info->height = json_integer_value(json_object_get(json, "height"));
    self->code = (out_coding){.offset = number(json, "offset"), .scale = number(json, "scale")};
    self->zero_is_void = json_is_integer(json_object_get(json, "void"));
    info->has_voids = self->zero_is_void || self->kind == OUT_HEIGHTMAP_RAW32;
    info->quantum = self->kind == OUT_HEIGHTMAP_RAW32 ? 0 : fabs(self->code.scale);
    const char *type = json_string_value(json_object_get(json, "raster_type"));
    info->type = type && strcmp(type, "point") == 0 ? TL_RASTER_POINT : TL_RASTER_AREA;
    double furthest = fabs(self->code.offset) + 65535 * fabs(self->code.scale);
    return info->width > 0 && info->height > 0 && info->width <= INT32_MAX && info->height <= INT32_MAX &&
           (double)info->width * (double)info->height < 0x1p60 && furthest <= 3e38;
}

static tl_status take_place(heightmap *self, json_t *json, tl_error *error)
{
    json_t *numbers = json_object_get(json, "geotransform");
    double transform[6];
    for (size_t k = 0; k < 6; k++)
        transform[k] = json_number_value(json_array_get(numbers, k));
    const out_place place = {.transform = json_array_size(numbers) == 6 ? transform : NULL,
                             .wkt = json_string_value(json_object_get(json, "crs_wkt")),
                             .height_unit = number(json, "height_unit_metres")};
    return out_place_read(&place, self->path, &self->source.info, error);
}

static tl_status take_record(heightmap *self, json_t *json, tl_error *error)
{
    const char *name;
    json_t *value;
    tl_source_info *info = &self->source.info;
    tl_status status = TL_OK;
    json_object_foreach(json_object_get(json, "parameters"), name, value) if (status == TL_OK && json_is_string(value))
        status = tl_parameters_add(&self->parameters, &info->parameter_count, name, json_string_value(value), error);
    for (size_t k = 0; k < info->parameter_count; k++) {
        tl_make_printable((char *)self->parameters[k].name); /* in the list's own block */
        tl_make_printable((char *)self->parameters[k].value);
    }
    info->parameters = self->parameters;
    return status;
}

static tl_status read_json(heightmap *self, tl_error *error)
{
    json_t *json = NULL;
    tl_status status = load_json(self, &json, error);
    if (status == TL_OK && !take_numbers(self, json))
        status = strange(self, "its width, height, scale or offset cannot be", error);
    if (status == TL_OK)
        status = take_place(self, json, error);
    if (status == TL_OK)
        status = take_record(self, json, error);
    json_decref(json);
    return status;
}

/* ---- PNG ---- */

static tl_status read_png_bytes(void *context, void *to, size_t count, uint64_t at, tl_error *error)
{
    return read_bytes(context, to, count, at, error);
}

static tl_status read_png(heightmap *self, tl_error *error)
{
    const tl_source_info *grid = &self->source.info;
    const out_png_input input = {read_png_bytes, self, self->path};
    return out_png_read_grey16(&input, grid->width, grid->height, &self->samples, error);
}

/* ---- Opening ---- */

static tl_status check_length(const heightmap *self, tl_error *error)
{
    struct stat status;
    const tl_source_info *info = &self->source.info;
    if (fstat(self->descriptor, &status) != 0)
        return tl_fail_system(error, self->path, "read", errno);
    int64_t wanted = info->width * info->height * (int64_t)sample_bytes(self);
    return status.st_size == wanted
               ? TL_OK
               : tl_fail(error, TL_ERROR_DATA, "%s: %lld bytes, but %lld x %lld samples are %lld", self->path,
                         (long long)status.st_size, (long long)info->width, (long long)info->height, (long long)wanted);
}

static tl_status begin(heightmap *self, tl_error *error)
{
    /* O_NONBLOCK: opening a named pipe without it waits for a writer */
    self->descriptor = open(self->path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
    if (self->descriptor < 0)
        return tl_fail_system(error, self->path, "read", errno);
    tl_status status = read_json(self, error);
    if (status != TL_OK)
        return status;
    return self->kind == OUT_HEIGHTMAP_PNG16 ? read_png(self, error) : check_length(self, error);
}

tl_source *out_heightmap_open(const char *path, tl_error *error)
{
    heightmap *self = calloc(1, sizeof *self);
    if (self) {
        *self = (heightmap){.source = {.read = read_window, .destroy = close_heightmap},
                            .kind = kind_of(path),
                            .descriptor = -1,
                            .path = strdup(path)};
        self->beside = out_sidecar_path(path, self->kind);
        self->source.info.name = self->path;
    }
    if (!self || !self->path || !self->beside)
        tl_fail_memory(error, path);
    else if (begin(self, error) == TL_OK)
        return &self->source;
    if (self)
        close_heightmap(&self->source);
    return NULL;
}
