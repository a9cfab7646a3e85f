/* What files of points and tiles of quantized-mesh hold, as summaries of meshes: see tl_mesh_read_summary. */
#include "lib/out/summary_read.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"

#include <jansson.h>
#include <libdeflate.h>

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>

enum { KINDS = 5, TILE_HEAD = 88, MOST_TILE_BYTES = 1 << 26 };

static tl_status strange(const char *path, const char *what, tl_error *error)
{
    return tl_fail(error, TL_ERROR_DATA, "%s: %s; not a file as talus writes it", path, what);
}

/* Anyone may have written the file. */
static tl_status note(tl_mesh_summary *out, const char *name, const char *value, tl_error *error)
{
    enum { MOST = 64 };
    char clean[2][480];
    snprintf(clean[0], sizeof clean[0], "%s", name);
    snprintf(clean[1], sizeof clean[1], "%s", value);
    tl_make_printable(clean[0]);
    tl_make_printable(clean[1]);
    return out->record_count < MOST ? tl_parameters_add(&out->record, &out->record_count, clean[0], clean[1], error)
                                    : TL_OK;
}

static void take_point(tl_mesh_summary *out, const double at[3])
{
    for (int a = 0; a < 3; a++) {
        out->low[a] = out->vertex_count ? fmin(out->low[a], at[a]) : at[a];
        out->high[a] = out->vertex_count ? fmax(out->high[a], at[a]) : at[a];
    }
    out->vertex_count++;
}

/* ---- Points, line by line ---- */

static const char *const kinds[KINDS] = {"summit", "pit", "pass", "ridge", "valley"};

typedef struct lines {
    const char *path;
    tl_mesh_summary *out;
    uint64_t counts[KINDS]; /* of features */
    bool ended;
} lines;

static void count_features(lines *self, const char *text)
{
    for (int k = 0; text && k < KINDS; k++)
        self->counts[k] += strstr(text, kinds[k]) != NULL;
}

static tl_status note_features(lines *self, tl_error *error)
{
    char text[200] = "";
    size_t used = 0;
    for (int k = 0; k < KINDS; k++)
        if (self->counts[k])
            used += (size_t)snprintf(text + used, sizeof text - used, "%s%s %llu", used ? ", " : "", kinds[k],
                                     (unsigned long long)self->counts[k]);
    return used ? note(self->out, "features", text, error) : TL_OK;
}

static tl_status read_csv_line(lines *self, char *line, bool first, tl_error *error)
{
    static const char head[] = "column,row,x,y,height";
    double at[5];
    char *end = line;
    if (first)
        return strncmp(line, head, sizeof head - 1) == 0
                   ? note(self->out, "columns", line, error)
                   : strange(self->path, "its first line does not name column, row, x, y and height", error);
    for (int k = 0; k < 5; k++) {
        char *from = end + (k > 0);
        if (k && *end != ',')
            return strange(self->path, "a line of fewer than five numbers", error);
        at[k] = strtod(from, &end);
        if (end == from)
            return strange(self->path, "a line of fewer than five numbers", error);
    }
    take_point(self->out, at + 2);
    count_features(self, end);
    return TL_OK;
}

/* The line that opens the collection, closed. */
static tl_status read_opening(lines *self, char *line, tl_error *error)
{
    size_t room = strlen(line) + 3;
    char *whole = malloc(room);
    if (!whole)
        return tl_fail_memory(error, self->path);
    snprintf(whole, room, "%s]}", line);
    json_t *root = json_loads(whole, 0, NULL), *value;
    const char *type = json_string_value(json_object_get(root, "type")), *name;
    const char *coordinates = json_string_value(json_object_get(root, "coordinates"));
    tl_status status = type && strcmp(type, "FeatureCollection") == 0
                           ? note(self->out, "coordinates", coordinates ? coordinates : "longitude, latitude", error)
                           : strange(self->path, "its first line does not open a FeatureCollection", error);
    json_object_foreach(json_object_get(root, "talus"), name, value) if (status == TL_OK && json_is_string(value))
        status = note(self->out, name, json_string_value(value), error);
    json_decref(root);
    free(whole);
    return status;
}

static tl_status read_feature(lines *self, char *line, bool first, tl_error *error)
{
    if (first)
        return read_opening(self, line, error);
    size_t length = strlen(line);
    if (line[0] == ']') {
        self->ended = true;
        return TL_OK;
    }
    if (length && line[length - 1] == ',')
        line[length - 1] = 0;
    json_t *feature = json_loads(line, 0, NULL);
    const json_t *place = json_object_get(json_object_get(feature, "geometry"), "coordinates");
    double at[3];
    for (size_t k = 0; k < 3; k++)
        at[k] = json_number_value(json_array_get(place, k));
    bool good = json_array_size(place) == 3;
    if (good)
        take_point(self->out, at);
    count_features(self, json_string_value(json_object_get(json_object_get(feature, "properties"), "feature")));
    json_decref(feature);
    return good ? TL_OK : strange(self->path, "a line that is not a point of three coordinates", error);
}

static tl_status read_lines(const char *path, tl_mesh_summary *out, bool csv, tl_error *error)
{
    lines self = {.path = path, .out = out, .ended = csv};
    FILE *file = fopen(path, "r");
    if (!file)
        return tl_fail_system(error, path, "read", errno);
    char *line = NULL;
    size_t room = 0;
    tl_status status = TL_OK;
    bool first = true;
    for (ssize_t length; status == TL_OK && (length = getline(&line, &room, file)) > 0; first = false) {
        line[strcspn(line, "\n")] = 0;
        status = csv ? read_csv_line(&self, line, first, error) : read_feature(&self, line, first, error);
    }
    if (status == TL_OK && ferror(file))
        status = tl_fail_system(error, path, "read", errno);
    if (status == TL_OK && (first || !self.ended))
        status = strange(path, "it ends too early", error);
    free(line);
    fclose(file);
    if (status == TL_OK)
        status = note_features(&self, error);
    return status == TL_OK && csv ? note(out, "record", "none: a CSV has no room for it; .geojson has", error) : status;
}

tl_status out_csv_summary(const char *path, tl_mesh_summary *out, tl_error *error)
{
    return read_lines(path, out, true, error);
}

tl_status out_geojson_summary(const char *path, tl_mesh_summary *out, tl_error *error)
{
    return read_lines(path, out, false, error);
}

/* ---- Tiles of quantized-mesh ---- */

typedef struct tile {
    unsigned char *bytes;
    size_t count;
} tile;

static uint32_t word_at(const tile *t, size_t at)
{
    if (at + 4 > t->count)
        return 0;
    const unsigned char *p = t->bytes + at;
    return p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

static float float_at(const tile *t, size_t at)
{
    uint32_t bits = word_at(t, at);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static tl_status unpack(const char *path, const unsigned char *packed, size_t count, tile *out, tl_error *error)
{
    tile whole = {(unsigned char *)packed, count};
    size_t room = count > 18 ? word_at(&whole, count - 4) : 0; /* gzip tells it at its end */
    struct libdeflate_decompressor *codec = libdeflate_alloc_decompressor();
    out->bytes = room >= TILE_HEAD + 4 && room <= MOST_TILE_BYTES ? malloc(room) : NULL;
    bool good = codec && out->bytes &&
                libdeflate_gzip_decompress(codec, packed, count, out->bytes, room, &out->count) == LIBDEFLATE_SUCCESS;
    libdeflate_free_decompressor(codec);
    return good ? TL_OK : strange(path, "not packed by gzip", error);
}

static tl_status read_tile(const char *path, tile *out, tl_error *error)
{
    struct stat there;
    FILE *file = fopen(path, "rb");
    if (!file)
        return tl_fail_system(error, path, "read", errno);
    bool sound = fstat(fileno(file), &there) == 0 && S_ISREG(there.st_mode) && there.st_size <= MOST_TILE_BYTES;
    unsigned char *packed = sound ? malloc((size_t)there.st_size + 1) : NULL;
    size_t count = packed ? fread(packed, 1, (size_t)there.st_size, file) : 0;
    fclose(file);
    tl_status status = !sound    ? strange(path, "no file, or larger than a tile can be", error)
                       : !packed ? tl_fail_memory(error, path)
                                 : unpack(path, packed, count, out, error);
    free(packed);
    return status;
}

/* The extensions behind the triangles and the four edges. */
static tl_status note_extensions(const tile *t, size_t at, tl_mesh_summary *out, tl_error *error)
{
    static const char *const names[] = {"", "octvertexnormals", "watermask", "", "metadata"};
    char text[120] = "";
    size_t used = 0, wide = out->vertex_count > 65536 ? 4 : 2;
    for (int edge = 0; edge < 4 && at < t->count; edge++)
        at += 4 + wide * word_at(t, at);
    while (at + 5 <= t->count && used < 80) {
        unsigned id = t->bytes[at];
        used += (size_t)snprintf(text + used, sizeof text - used, "%s%s", used ? ", " : "",
                                 id < sizeof names / sizeof *names && *names[id] ? names[id] : "another");
        at += 5 + (size_t)word_at(t, at + 1);
    }
    return used ? note(out, "extensions", text, error) : TL_OK;
}

/* Level, column and row, which the last three parts of the name are, tell where it lies; else it is 1 x 1. */
static tl_status note_place(const char *path, tl_mesh_summary *out, tl_error *error)
{
    int level, column, row, parts = 0, end = 0;
    const char *at = path + strlen(path);
    for (; at > path && parts < 3; at--)
        parts += at[-1] == '/';
    at += parts == 3; /* back behind the third slash from the end */
    bool told = sscanf(at, "%d/%d/%d.terrain%n", &level, &column, &row, &end) == 3 && end > 0 && level >= 0 &&
                level < TL_TILE_LEVELS && column >= 0 && row >= 0;
    out->high[0] = out->high[1] = 1;
    if (!told)
        return note(out, "frame", "from the tile's south-western corner to 1, 1; metres above the ellipsoid", error);
    double side = 180 / ldexp(1, level);
    const double corner[2] = {-180 + column * side, -90 + row * side};
    for (int a = 0; a < 2; a++) {
        out->low[a] = corner[a];
        out->high[a] = corner[a] + side;
    }
    char text[80];
    snprintf(text, sizeof text, "level %d, column %d, row %d from the south", level, column, row);
    tl_status status = note(out, "frame", "longitude and latitude in degrees, metres above the ellipsoid", error);
    return status == TL_OK ? note(out, "tile", text, error) : status;
}

tl_status out_terrain_summary(const char *path, tl_mesh_summary *out, tl_error *error)
{
    tile t = {NULL, 0};
    tl_status status = read_tile(path, &t, error);
    out->vertex_count = word_at(&t, TILE_HEAD);
    size_t wide = out->vertex_count > 65536 ? 4 : 2, at = TILE_HEAD + 4 + 6 * out->vertex_count;
    at = (at + wide - 1) / wide * wide;
    out->triangle_count = word_at(&t, at);
    if (status == TL_OK && (at > t.count || (t.count - at) / (3 * wide) < out->triangle_count))
        status = strange(path, "its counts are larger than itself", error);
    if (status == TL_OK)
        status = note_place(path, out, error);
    out->low[2] = (double)float_at(&t, 24);
    out->high[2] = (double)float_at(&t, 28);
    if (status == TL_OK)
        status = note_extensions(&t, at + 4 + 3 * wide * out->triangle_count, out, error);
    if (status == TL_OK)
        status = note(out, "record", "in the layer.json of its folder", error);
    free(t.bytes);
    return status;
}
