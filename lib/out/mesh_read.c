#include "lib/out/mesh_read.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/summary_read.h"

#include "lib/out/triangles.h"
#include <jansson.h>

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>

enum {
    GLB_MAGIC = 0x46546c67,
    CHUNK_JSON = 0x4e4f534a,
    CHUNK_BINARY = 0x004e4942,
    COMPONENT_U16 = 5123,
    COMPONENT_U32 = 5125,
    COMPONENT_FLOAT = 5126
};

/* A file's bytes, ended by a zero, and what has been read of them. */
typedef struct bytes {
    const char *path;
    unsigned char *all;
    size_t count, at;
} bytes;

static tl_status malformed(const bytes *in, const char *what, tl_error *error)
{
    return tl_fail(error, TL_ERROR_DATA, "%s: %s; not a mesh as talus writes it", in->path, what);
}

static tl_status read_all(const char *path, bytes *out, tl_error *error)
{
    FILE *file = fopen(path, "rb");
    long size = -1;
    *out = (bytes){.path = path};
    if (file && fseek(file, 0, SEEK_END) == 0)
        size = ftell(file);
    out->all = size >= 0 ? malloc((size_t)size + 1) : NULL;
    bool good = out->all && fseek(file, 0, SEEK_SET) == 0 && fread(out->all, 1, (size_t)size, file) == (size_t)size;
    int code = errno;
    if (file)
        fclose(file);
    if (!good) {
        free(out->all);
        return file && size >= 0 && !out->all ? tl_fail_memory(error, path) : tl_fail_system(error, path, "read", code);
    }
    out->count = (size_t)size;
    out->all[size] = 0;
    return TL_OK;
}

/* Anyone may have written the file. */
static tl_status note(out_mesh_file *out, const char *name, const char *value, tl_error *error)
{
    enum { MOST = 64 };
    char clean[2][480];
    snprintf(clean[0], sizeof clean[0], "%s", name);
    snprintf(clean[1], sizeof clean[1], "%s", value);
    tl_make_printable(clean[0]);
    tl_make_printable(clean[1]);
    if (out->record_count == MOST)
        return TL_OK;
    return tl_parameters_add(&out->record, &out->record_count, clean[0], clean[1], error);
}

/* A comment as OBJ and PLY have it: "talus VERSION, frame NAME", "origin ...", "CRS NAME" or "NAME: VALUE". */
static tl_status note_comment(out_mesh_file *out, char *text, tl_error *error)
{
    char frame[16];
    if (sscanf(text, "talus %*[^,], frame %15[a-z]", frame) == 1)
        return note(out, "frame", frame, error);
    if (strncmp(text, "origin ", 7) == 0)
        return note(out, "origin", text + 7, error);
    if (strncmp(text, "CRS ", 4) == 0)
        return note(out, "crs", text + 4, error);
    char *colon = strstr(text, ": ");
    if (!colon)
        return TL_OK;
    *colon = 0;
    return note(out, text, colon + 2, error);
}

static bool make_room(out_mesh_file *out)
{
    size_t corners;
    if (out->vertex_count > UINT32_MAX || !tl_size_mul(out->triangle_count, 3, &corners))
        return false;
    out->xyz = tl_alloc(out->vertex_count, sizeof *out->xyz);
    out->indices = tl_alloc(corners, sizeof *out->indices);
    return out->xyz && out->indices;
}

static bool indices_good(const out_mesh_file *mesh)
{
    for (size_t k = 0; k < 3 * mesh->triangle_count; k++)
        if (mesh->indices[k] >= mesh->vertex_count)
            return false;
    return true;
}

static uint32_t word_at(const unsigned char *from)
{
    return (uint32_t)from[0] | (uint32_t)from[1] << 8 | (uint32_t)from[2] << 16 | (uint32_t)from[3] << 24;
}

static double float_at(const unsigned char *from)
{
    uint32_t bits = word_at(from);
    float value;
    memcpy(&value, &bits, sizeof value);
    return (double)value;
}

static double double_at(const unsigned char *from)
{
    uint64_t bits = word_at(from) | (uint64_t)word_at(from + 4) << 32;
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* ---- PLY ---- */

/* Takes a line of the header, without its end; false: there is none. */
static bool take_line(bytes *in, char *line, size_t room)
{
    size_t used = 0;
    while (in->at < in->count && in->all[in->at] != '\n') {
        if (used + 1 < room)
            line[used++] = (char)in->all[in->at];
        in->at++;
    }
    line[used] = 0;
    return in->at++ < in->count;
}

/* Reads the header; *wide becomes whether coordinates are doubles. */
static bool read_ply_header(bytes *in, out_mesh_file *out, bool *wide)
{
    static const char *const rest[] = {"property list uchar uint vertex_indices", "end_header"};
    char line[512], type[16];
    if (!take_line(in, line, sizeof line) || strcmp(line, "ply") != 0)
        return false;
    if (!take_line(in, line, sizeof line) || strcmp(line, "format binary_little_endian 1.0") != 0)
        return false;
    for (;;) {
        if (!take_line(in, line, sizeof line))
            return false;
        if (strncmp(line, "comment ", 8) != 0)
            break;
        if (note_comment(out, line + 8, NULL) != TL_OK)
            return false;
    }
    if (sscanf(line, "element vertex %zu", &out->vertex_count) != 1)
        return false;
    for (int a = 0; a < 3; a++) {
        char name;
        if (!take_line(in, line, sizeof line) || sscanf(line, "property %15s %c", type, &name) != 2 || name != "xyz"[a])
            return false;
        bool doubles = strcmp(type, "double") == 0;
        if ((!doubles && strcmp(type, "float") != 0) || (a && doubles != *wide))
            return false;
        *wide = doubles;
    }
    if (!take_line(in, line, sizeof line) || sscanf(line, "element face %zu", &out->triangle_count) != 1)
        return false;
    for (int i = 0; i < 2; i++)
        if (!take_line(in, line, sizeof line) || strcmp(line, rest[i]) != 0)
            return false;
    return true;
}

static tl_status read_ply(bytes *in, out_mesh_file *out, tl_error *error)
{
    enum { FACE = 13 };
    bool wide = false;
    if (!read_ply_header(in, out, &wide))
        return malformed(in, "its header", error);
    size_t size = wide ? 24 : 12, left = in->count - in->at, vertex_bytes, face_bytes;
    if (!tl_size_mul(out->vertex_count, size, &vertex_bytes) || !tl_size_mul(out->triangle_count, FACE, &face_bytes) ||
        vertex_bytes > left || left - vertex_bytes != face_bytes)
        return malformed(in, "its length", error);
    if (!make_room(out))
        return tl_fail_memory(error, in->path);
    const unsigned char *from = in->all + in->at;
    for (size_t k = 0; k < out->vertex_count; k++, from += size)
        for (int a = 0; a < 3; a++)
            out->xyz[k][a] = wide ? double_at(from + 8 * a) : float_at(from + 4 * a);
    for (size_t t = 0; t < out->triangle_count; t++, from += FACE) {
        if (*from != 3)
            return malformed(in, "a face that is no triangle", error);
        for (size_t k = 0; k < 3; k++)
            out->indices[3 * t + k] = word_at(from + 1 + 4 * k);
    }
    return TL_OK;
}

/* ---- OBJ ---- */

static tl_status read_obj(bytes *in, out_mesh_file *out, tl_error *error)
{
    for (size_t i = 0; i < in->count; i++)
        if (i == 0 || in->all[i - 1] == '\n') {
            out->vertex_count += in->all[i] == 'v' && in->all[i + 1] == ' ';
            out->triangle_count += in->all[i] == 'f' && in->all[i + 1] == ' ';
        }
    char text[512];
    tl_status status = TL_OK;
    while (status == TL_OK && in->at < in->count && in->all[in->at] == '#' && take_line(in, text, sizeof text))
        status = note_comment(out, text + (text[1] == ' ' ? 2 : 1), error);
    if (status != TL_OK || !make_room(out))
        return tl_fail_memory(error, in->path);
    size_t v = 0, f = 0;
    for (char *line = (char *)in->all; line; line = strchr(line, '\n')) {
        line += *line == '\n';
        if (line[0] == 'v' && line[1] == ' ') {
            char *at = line + 1;
            for (int a = 0; a < 3; a++)
                out->xyz[v][a] = strtod(at, &at);
            v++;
        } else if (line[0] == 'f' && line[1] == ' ') {
            char *at = line + 1;
            for (size_t k = 0; k < 3; k++) {
                unsigned long long index = strtoull(at, &at, 10);
                out->indices[3 * f + k] = index > 0 && index <= UINT32_MAX ? (uint32_t)(index - 1) : UINT32_MAX;
            }
            f++;
        }
    }
    /* a zero byte within ends the text early */
    return v == out->vertex_count && f == out->triangle_count ? TL_OK : malformed(in, "its lines", error);
}

/* ---- STL ---- */

static tl_status read_stl(bytes *in, out_mesh_file *out, tl_error *error)
{
    enum { HEAD = 84, RECORD = 50 };
    if (in->count < HEAD || (in->count - HEAD) % RECORD || word_at(in->all + HEAD - 4) != (in->count - HEAD) / RECORD)
        return malformed(in, "its length", error);
    out->triangle_count = (in->count - HEAD) / RECORD;
    out->vertex_count = 3 * out->triangle_count;
    if (!make_room(out))
        return tl_fail_memory(error, in->path);
    char head[HEAD - 3] = {0};
    double origin[3] = {0}; /* what was taken off a map's coordinates, which single precision cannot hold */
    memcpy(head, in->all, HEAD - 4);
    const char *from_text = strstr(head, " projected from ");
    if (from_text && sscanf(from_text, " projected from %lf %lf", &origin[0], &origin[1]) != 2)
        return malformed(in, "its header", error);
    from_text = strstr(head, " ecef from ");
    if (from_text && sscanf(from_text, " ecef from %lf %lf %lf", &origin[0], &origin[1], &origin[2]) != 3)
        return malformed(in, "its header", error);
    char version[32], frame[16], place[80];
    tl_status status = TL_OK;
    if (sscanf(head, "talus %31s", version) == 1)
        status = note(out, "version", version, error);
    if (status == TL_OK && sscanf(head, "talus %*s %15[a-z]", frame) == 1)
        status = note(out, "frame", frame, error);
    if (status == TL_OK && sscanf(head, "talus %*s enu at %79[-+.0-9 ]", place) == 1)
        status = note(out, "origin", place, error);
    if (status == TL_OK)
        status = note(out, "record", "none: an STL has no room for it; .glb, .ply and .obj have", error);
    if (status != TL_OK)
        return status;
    for (size_t k = 0; k < out->vertex_count; k++) {
        const unsigned char *from = in->all + HEAD + k / 3 * RECORD + 12 + k % 3 * 12;
        for (int a = 0; a < 3; a++)
            out->xyz[k][a] = float_at(from + 4 * a) + origin[a];
        out->indices[k] = (uint32_t)k;
    }
    return TL_OK;
}

/* ---- GLB ---- */

static json_t *item_of(json_t *root, const char *list, size_t index)
{
    return json_array_get(json_object_get(root, list), index);
}

static size_t size_of(json_t *object, const char *name)
{
    json_int_t value = json_integer_value(json_object_get(object, name));
    return value > 0 ? (size_t)value : 0;
}

/* What an accessor names. */
typedef struct items {
    const unsigned char *at;
    size_t count, stride;
    int component;
    unsigned char *decoded; /* what `at` points into, where it was encoded; to be freed */
} items;

/* The most that meshoptimizer's codecs make of a byte: a header byte of a vertices' block stands for 16 zero deltas
 * of four bytes' groups, a byte of the triangles' codes for a triangle. */
enum { MOST_OF_A_BYTE = 256 };

/* A part that EXT_meshopt_compression encoded, as `count` items of `stride` bytes. */
static unsigned char *decode_view(json_t *how, const bytes *binary, size_t *size)
{
    size_t start = size_of(how, "byteOffset"), length = size_of(how, "byteLength");
    size_t count = size_of(how, "count"), stride = size_of(how, "byteStride");
    const char *mode = json_string_value(json_object_get(how, "mode"));
    if (!mode || start > binary->count || length > binary->count - start || !tl_size_mul(count, stride, size) ||
        *size / MOST_OF_A_BYTE > length)
        return NULL;
    bool vertices = strcmp(mode, "ATTRIBUTES") == 0 && stride % 4 == 0 && stride > 0 && stride <= 256;
    bool triangles = strcmp(mode, "TRIANGLES") == 0 && (stride == 2 || stride == 4) && count % 3 == 0;
    unsigned char *out = vertices || triangles ? tl_alloc(*size / 4 + 1, 4) : NULL;
    int failed = -1;
    if (out && vertices)
        failed = meshopt_decodeVertexBuffer(out, count, stride, binary->all + start, length);
    else if (out)
        failed = meshopt_decodeIndexBuffer(out, count, stride, binary->all + start, length);
    if (failed) {
        free(out);
        return NULL;
    }
    return out;
}

/* Where an accessor's items of `parts` numbers lie, which may be floats or whole: `stride` from one to the next, the
 * last of them within the part. False: not so. */
static bool find_items(json_t *root, size_t index, size_t parts, const bytes *binary, items *out)
{
    json_t *accessor = item_of(root, "accessors", index);
    json_t *view = item_of(root, "bufferViews", size_of(accessor, "bufferView"));
    json_t *how = json_object_get(json_object_get(view, "extensions"), "EXT_meshopt_compression");
    size_t start = size_of(view, "byteOffset"), offset = size_of(accessor, "byteOffset"), span, room = binary->count;
    const unsigned char *base = binary->all;
    *out = (items){.count = size_of(accessor, "count"), .component = (int)size_of(accessor, "componentType")};
    size_t size = parts * (out->component == COMPONENT_U16 ? 2 : 4);
    out->stride = json_object_get(view, "byteStride") ? size_of(view, "byteStride") : size;
    if (!accessor || !view || out->stride < size || !out->count)
        return false;
    if (how) {
        base = out->decoded = decode_view(how, binary, &room);
        start = 0;
        if (!base)
            return false;
    }
    if (!tl_size_mul(out->count - 1, out->stride, &span) || start > room || offset > room - start ||
        span > room - start - offset || size > room - start - offset - span)
        return false;
    out->at = base + start + offset;
    return true;
}

static uint32_t half_word_at(const unsigned char *from)
{
    return (uint32_t)from[0] | (uint32_t)from[1] << 8;
}

/* Of positions and indices that were found. */
static tl_status take_items(json_t *node, const bytes *binary, const items *at, const items *index, out_mesh_file *out,
                            tl_error *error)
{
    json_t *translation = json_object_get(node, "translation"), *scale = json_object_get(node, "scale");
    json_t *matrix = json_object_get(node, "matrix");
    double column[4][3] = {{0}}; /* of the node's matrix */
    out->vertex_count = at->count;
    out->triangle_count = index->count / 3;
    if (!make_room(out))
        return tl_fail_memory(error, binary->path);
    for (size_t a = 0; a < 3; a++) {
        column[a][a] = scale ? json_number_value(json_array_get(scale, a)) : 1;
        column[3][a] = json_number_value(json_array_get(translation, a));
        for (size_t c = 0; matrix && c < 4; c++)
            column[c][a] = json_number_value(json_array_get(matrix, 4 * c + a));
    }
    for (size_t k = 0; k < out->vertex_count; k++) {
        const unsigned char *from = at->at + k * at->stride;
        double y_up[3] = {column[3][0], column[3][1], column[3][2]};
        for (size_t c = 0; c < 3; c++) {
            double value = at->component == COMPONENT_U16 ? half_word_at(from + 2 * c) : float_at(from + 4 * c);
            for (size_t a = 0; a < 3; a++)
                y_up[a] += value * column[c][a];
        }
        out->xyz[k][0] = y_up[0], out->xyz[k][1] = -y_up[2], out->xyz[k][2] = y_up[1];
    }
    for (size_t k = 0; k < index->count; k++) {
        const unsigned char *from = index->at + k * index->stride;
        out->indices[k] = index->component == COMPONENT_U16 ? half_word_at(from) : word_at(from);
    }
    return TL_OK;
}

static tl_status take_glb(json_t *root, const bytes *binary, out_mesh_file *out, tl_error *error)
{
    json_t *node = item_of(root, "nodes", 0), *mesh = item_of(root, "meshes", size_of(node, "mesh"));
    json_t *primitive = item_of(mesh, "primitives", 0), *attributes = json_object_get(primitive, "attributes");
    items at = {0}, index = {0};
    bool good = json_object_get(attributes, "POSITION") &&
                find_items(root, size_of(attributes, "POSITION"), 3, binary, &at) &&
                (at.component == COMPONENT_FLOAT || at.component == COMPONENT_U16) &&
                find_items(root, size_of(primitive, "indices"), 1, binary, &index) &&
                (index.component == COMPONENT_U32 || index.component == COMPONENT_U16) && index.count % 3 == 0;
    tl_status status =
        good ? take_items(node, binary, &at, &index, out, error) : malformed(binary, "its accessors", error);
    free(at.decoded);
    free(index.decoded);
    return status;
}

/* The extras that talus gives an asset. */
static tl_status note_extras(json_t *root, out_mesh_file *out, tl_error *error)
{
    json_t *extras = json_object_get(json_object_get(root, "asset"), "extras"), *value;
    json_t *origin = json_object_get(extras, "origin");
    const char *name, *frame = json_string_value(json_object_get(extras, "frame"));
    tl_status status = frame ? note(out, "frame", frame, error) : TL_OK;
    if (status == TL_OK && origin) {
        char text[128];
        snprintf(text, sizeof text, "longitude %.12g latitude %.12g height %.6f",
                 json_number_value(json_object_get(origin, "longitude")),
                 json_number_value(json_object_get(origin, "latitude")),
                 json_number_value(json_object_get(origin, "height")));
        status = note(out, "origin", text, error);
    }
    const char *crs = json_string_value(json_object_get(extras, "crs"));
    if (status == TL_OK && crs)
        status = note(out, "crs", crs, error);
    json_object_foreach(json_object_get(extras, "parameters"), name,
                        value) if (status == TL_OK && json_is_string(value)) status =
        note(out, name, json_string_value(value), error);
    return status;
}

static tl_status read_glb(bytes *in, out_mesh_file *out, tl_error *error)
{
    if (in->count < 20 || word_at(in->all) != GLB_MAGIC || word_at(in->all + 16) != CHUNK_JSON)
        return malformed(in, "its header", error);
    size_t text = word_at(in->all + 12);
    if (text > in->count - 20 || in->count - 20 - text < 8 || word_at(in->all + 24 + text) != CHUNK_BINARY)
        return malformed(in, "its chunks", error);
    bytes binary = {in->path, in->all + 28 + text, word_at(in->all + 20 + text), 0};
    if (binary.count > in->count - 28 - text)
        return malformed(in, "its length", error);
    json_t *root = json_loadb((const char *)in->all + 20, text, 0, NULL);
    tl_status status = root ? take_glb(root, &binary, out, error) : malformed(in, "its JSON", error);
    if (status == TL_OK)
        status = note_extras(root, out, error);
    json_decref(root);
    return status;
}

/* ---- Any ---- */

void out_mesh_free(out_mesh_file *file)
{
    free(file->xyz);
    free(file->indices);
    free(file->record);
    *file = (out_mesh_file){0};
}

tl_status out_mesh_read(const char *path, out_mesh_file *out, tl_error *error)
{
    static const struct {
        const char *ending;
        tl_status (*read)(bytes *, out_mesh_file *, tl_error *);
    } readers[] = {{"ply", read_ply}, {"obj", read_obj}, {"glb", read_glb}, {"stl", read_stl}};
    const tl_format *format = tl_format_of(path);
    bytes in;
    *out = (out_mesh_file){0};
    for (size_t i = 0; i < sizeof readers / sizeof *readers; i++) {
        if (!format || strcmp(format->ending, readers[i].ending) != 0)
            continue;
        tl_status status = read_all(path, &in, error);
        if (status != TL_OK)
            return status;
        status = readers[i].read(&in, out, error);
        if (status == TL_OK && !indices_good(out))
            status = malformed(&in, "a triangle of vertices that are not there", error);
        free(in.all);
        if (status != TL_OK)
            out_mesh_free(out);
        return status;
    }
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: only .glb, .obj, .ply and .stl can be read back", path);
}

/* The bytes, and at most as many again and half for coordinates and corners. */
static tl_status fits(const char *path, const tl_run *run, tl_error *error)
{
    struct stat status;
    if (stat(path, &status) != 0)
        return tl_fail_system(error, path, "read", errno);
    return tl_run_fits(run, 3.5 * (double)status.st_size, path, "reading the mesh", error);
}

/* Files of other kinds; false: `path` is none. */
static bool read_other(const char *path, tl_mesh_summary *out, tl_status *status, tl_error *error)
{
    static const struct {
        const char *ending;
        tl_status (*read)(const char *, tl_mesh_summary *, tl_error *);
    } readers[] = {{"csv", out_csv_summary}, {"geojson", out_geojson_summary}, {"terrain", out_terrain_summary}};
    const char *dot = strrchr(path, '.');
    for (size_t k = 0; dot && k < sizeof readers / sizeof *readers; k++)
        if (strcasecmp(dot + 1, readers[k].ending) == 0) {
            *out = (tl_mesh_summary){.record = NULL};
            *status = readers[k].read(path, out, error);
            if (*status != TL_OK) {
                free(out->record);
                out->record = NULL;
            }
            return true;
        }
    return false;
}

tl_status tl_mesh_read_summary(const char *path, const tl_run *run, tl_mesh_summary *out, tl_error *error)
{
    tl_status other;
    if (read_other(path, out, &other, error))
        return other;
    out_mesh_file file;
    tl_status status = fits(path, run, error);
    if (status == TL_OK)
        status = out_mesh_read(path, &file, error);
    if (status != TL_OK)
        return status;
    *out = (tl_mesh_summary){.vertex_count = file.vertex_count,
                             .triangle_count = file.triangle_count,
                             .record = file.record,
                             .record_count = file.record_count};
    for (int a = 0; a < 3; a++) {
        out->low[a] = out->high[a] = file.vertex_count ? file.xyz[0][a] : 0;
        for (size_t k = 1; k < file.vertex_count; k++) {
            out->low[a] = fmin(out->low[a], file.xyz[k][a]);
            out->high[a] = fmax(out->high[a], file.xyz[k][a]);
        }
    }
    file.record = NULL;
    out_mesh_free(&file);
    return TL_OK;
}
