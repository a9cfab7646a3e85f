#include "cmd/json_info.h"

#include "cmd/command.h"

#include <jansson.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

typedef struct index_file {
    char *path;
    json_t *root;
    const char *format; /* "quantized-mesh", "3dtiles", "heights" or "preset"; NULL: another */
} index_file;

static const char *format_of(const json_t *root)
{
    if (json_object_get(root, "tilejson"))
        return "quantized-mesh";
    if (json_object_get(json_object_get(root, "asset"), "version") && json_object_get(root, "geometricError"))
        return "3dtiles";
    if (json_is_string(json_object_get(root, "names")) && json_is_array(json_object_get(root, "levels")))
        return "heights";
    return json_is_string(json_object_get(root, "preset")) && json_is_array(json_object_get(root, "tiles")) ? "preset"
                                                                                                            : NULL;
}

/* `length` characters of a name and what comes behind them. */
static bool try_file(const char *name, size_t length, const char *behind, index_file *out)
{
    enum { MOST_BYTES = 1 << 28 };
    struct stat status;
    size_t room = length + strlen(behind) + 1;
    *out = (index_file){.path = malloc(room)};
    if (out->path)
        snprintf(out->path, room, "%.*s%s", (int)length, name, behind);
    if (out->path && stat(out->path, &status) == 0 && S_ISREG(status.st_mode) && status.st_size < MOST_BYTES)
        out->root = json_load_file(out->path, 0, NULL);
    out->format = format_of(out->root);
    if (out->format)
        return true;
    json_decref(out->root);
    free(out->path);
    *out = (index_file){.path = NULL};
    return false;
}

/* How many characters of "land_x1_y0" come before the tile's place; all where there is none. */
static size_t stem_of(const char *path, size_t length)
{
    size_t at = length;
    for (int k = 0; k < 2; k++) {
        size_t digits = at;
        while (digits && path[digits - 1] >= '0' && path[digits - 1] <= '9')
            digits--;
        if (digits == at || digits < 2 || path[digits - 1] != (k ? 'x' : 'y') || path[digits - 2] != '_')
            return length;
        at = digits - 2;
    }
    return at;
}

static bool find_index(const char *path, index_file *out)
{
    struct stat status;
    size_t length = strlen(path);
    if (stat(path, &status) == 0 && S_ISDIR(status.st_mode))
        return try_file(path, length, "/layer.json", out) || try_file(path, length, "/tileset.json", out) ||
               try_file(path, length, "/index.json", out);
    if (command_ends_with(path, ".json"))
        return try_file(path, length, "", out);
    if (!command_ends_with(path, ".r16") && !command_ends_with(path, ".png"))
        return false;
    return try_file(path, stem_of(path, length - 4), ".json", out) && strcmp(out->format, "preset") == 0;
}

static void close_index(index_file *index)
{
    json_decref(index->root);
    free(index->path);
}

bool json_info_is_for(const char *path)
{
    index_file index = {.path = NULL};
    bool found = find_index(path, &index);
    close_index(&index);
    return found;
}

/* ---- What is in it ---- */

static double number(const json_t *object, const char *name)
{
    return json_number_value(json_object_get(object, name));
}

/* Tiles of a layer.json, by its ranges of columns and rows. */
static json_int_t count_tiles(const json_t *root)
{
    size_t level, k;
    json_t *ranges, *range;
    double count = 0;
    json_array_foreach(json_object_get(root, "available"), level, ranges) json_array_foreach(ranges, k, range) count +=
        (number(range, "endX") - number(range, "startX") + 1) * (number(range, "endY") - number(range, "startY") + 1);
    return count < 1e15 ? (json_int_t)count : 0;
}

static void add_text(json_t *record, const char *name, const json_t *value)
{
    char text[32];
    if (json_is_number(value)) {
        snprintf(text, sizeof text, "%.15g", json_number_value(value));
        json_object_set_new(record, name, json_string(text));
    } else if (json_is_string(value))
        json_object_set_new(record, name, json_string(json_string_value(value)));
}

static void add_texts(json_t *record, json_t *from)
{
    const char *name;
    json_t *value;
    json_object_foreach(from, name, value) add_text(record, name, value);
}

/* How it was made, texts all: the members of "talus" or "parameters", and of tiles the largest errors. */
static json_t *record_of(const index_file *index)
{
    json_t *record = json_object(), *talus = json_object_get(index->root, "talus");
    talus = talus ? talus : json_object_get(json_object_get(index->root, "extras"), "talus");
    bool own = talus && strcmp(index->format, "heights") != 0;
    add_texts(record, own ? talus : json_object_get(index->root, "parameters"));
    const json_t *errors = json_object_get(talus, "errors");
    if (json_array_size(errors))
        add_text(record, "error_of_the_deepest_level", json_array_get(errors, json_array_size(errors) - 1));
    return record;
}

static void describe_heights(const json_t *root, json_t *out)
{
    const json_t *levels = json_object_get(root, "levels"), *range = json_object_get(root, "range");
    const json_t *last = json_array_get(levels, json_array_size(levels) - 1);
    double tiles = 0;
    size_t k;
    const json_t *level;
    json_array_foreach(levels, k, level) tiles += (double)json_array_size(json_object_get(level, "tiles"));
    json_object_set_new(out, "tiles", json_integer((json_int_t)tiles));
    json_object_set_new(
        out, "levels", json_pack("[i,i]", (int)number(json_array_get(levels, 0), "level"), (int)number(last, "level")));
    json_object_set(out, "names", json_object_get(root, "names"));
    json_object_set(out, "width", json_object_get(last, "width"));
    json_object_set(out, "height", json_object_get(last, "height"));
    json_object_set(out, "tile_width", json_object_get(root, "tile"));
    json_object_set(out, "tile_height", json_object_get(root, "tile"));
    json_object_set(out, "lowest", json_array_get(range, 0));
    json_object_set(out, "highest", json_array_get(range, 1));
    json_object_set(out, "scale", json_object_get(root, "scale"));
    json_object_set(out, "offset", json_object_get(root, "offset"));
}

static json_t *describe(const char *path, const index_file *index)
{
    const json_t *root = index->root;
    json_t *name = json_string(path), *file = json_string(index->path), *out; /* NULL: not UTF-8 */
    out = json_pack("{s:o, s:s, s:o}", "name", name ? name : json_string("?"), "format", index->format, "index",
                    file ? file : json_string("?"));
    if (strcmp(index->format, "quantized-mesh") == 0) {
        json_object_set_new(out, "tiles", json_integer(count_tiles(root)));
        json_object_set_new(out, "levels",
                            json_pack("[i,i]", (int)number(root, "minzoom"), (int)number(root, "maxzoom")));
        json_object_set(out, "bounds", json_object_get(root, "bounds"));
    } else if (strcmp(index->format, "3dtiles") == 0)
        json_object_set_new(out, "geometric_error", json_real(number(root, "geometricError")));
    else if (strcmp(index->format, "heights") == 0)
        describe_heights(root, out);
    else {
        json_object_set_new(out, "tiles", json_integer((json_int_t)json_array_size(json_object_get(root, "tiles"))));
        json_object_set(out, "preset", json_object_get(root, "preset"));
        static const char *const numbers[] = {"width",  "height",  "tile_width", "tile_height",
                                              "lowest", "highest", "scale",      "offset"};
        for (size_t k = 0; k < sizeof numbers / sizeof *numbers; k++)
            json_object_set(out, numbers[k], json_object_get(root, numbers[k]));
    }
    json_object_set_new(out, "record", record_of(index));
    return out;
}

/* ---- Text ---- */

/* Anyone may have written the file, and control characters may drive a terminal. */
static void print_plain(const char *text)
{
    for (; *text; text++)
        putchar((unsigned char)*text < 0x20 || *text == 0x7f ? '?' : *text);
}

static void print_head(const char *path, const index_file *index, const json_t *about)
{
    const json_t *bounds = json_object_get(about, "bounds"), *levels = json_object_get(about, "levels");
    print_plain(path);
    if (strcmp(index->format, "quantized-mesh") == 0) {
        printf("\ntiles        %.0f of quantized-mesh, levels %.0f to %.0f\n", number(about, "tiles"),
               json_number_value(json_array_get(levels, 0)), json_number_value(json_array_get(levels, 1)));
        printf("degrees      %.9f ... %.9f, %.9f ... %.9f\n", json_number_value(json_array_get(bounds, 0)),
               json_number_value(json_array_get(bounds, 2)), json_number_value(json_array_get(bounds, 1)),
               json_number_value(json_array_get(bounds, 3)));
    } else if (strcmp(index->format, "3dtiles") == 0)
        printf("\ntiles        3D Tiles; the error where none is shown is %.6g m\n", number(about, "geometric_error"));
    else if (strcmp(index->format, "heights") == 0) {
        printf("\ntiles        %.0f of %.0f x %.0f samples, ", number(about, "tiles"), number(about, "tile_width"),
               number(about, "tile_height"));
        print_plain(json_is_string(json_object_get(about, "names")) ? json_string_value(json_object_get(about, "names"))
                                                                    : "?");
        printf(
            ", levels %.0f to %.0f\nsize         %.0f x %.0f samples of the last level\nheights      %.9g ... %.9g\n",
            json_number_value(json_array_get(levels, 0)), json_number_value(json_array_get(levels, 1)),
            number(about, "width"), number(about, "height"), number(about, "lowest"), number(about, "highest"));
    } else {
        printf("\ntiles        %.0f of %.0f x %.0f samples for ", number(about, "tiles"), number(about, "tile_width"),
               number(about, "tile_height"));
        print_plain(json_string_value(json_object_get(about, "preset")));
        printf(", together %.0f x %.0f\nheights      %.9g ... %.9g, stored as %.9g + %.9g * number\n",
               number(about, "width"), number(about, "height"), number(about, "lowest"), number(about, "highest"),
               number(about, "offset"), number(about, "scale"));
    }
}

static void print_text(const char *path, const index_file *index, const json_t *about)
{
    const char *name, *before = "made by      ";
    json_t *value;
    print_head(path, index, about);
    json_object_foreach(json_object_get(about, "record"), name, value)
    {
        fputs(before, stdout);
        print_plain(name);
        fputs(": ", stdout);
        print_plain(json_string_value(value));
        putchar('\n');
        before = "             ";
    }
}

int json_info_print(const char *path, bool json)
{
    index_file index = {.path = NULL};
    if (!find_index(path, &index)) {
        close_index(&index);
        complain("%s: cannot be read any more", path);
        return EXIT_FAILED;
    }
    json_t *about = describe(path, &index);
    if (json) {
        json_dumpf(about, stdout, JSON_INDENT(2) | JSON_REAL_PRECISION(15));
        putchar('\n');
    } else
        print_text(path, &index, about);
    json_decref(about);
    close_index(&index);
    return command_done();
}
