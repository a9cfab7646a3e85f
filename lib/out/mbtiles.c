/* A finished pyramid in one file: MBTiles, which is a table of tiles in SQLite [github.com/mapbox/mbtiles-spec]. */
#include "lib/base/error.h"
#include "lib/out/tile_pyramid.h"

#include <stdio.h>
#include <string.h>

#ifndef TL_HAVE_SQLITE

tl_status tl_pack_mbtiles(const char *folder, const char *path, bool overwrite, tl_error *error)
{
    (void)folder;
    (void)overwrite;
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: MBTiles need SQLite; build talus with -Dmbtiles=enabled", path);
}

#else

#include <dirent.h>
#include <errno.h>
#include <sqlite3.h>
#include <stdlib.h>
#include <unistd.h>

typedef struct packing {
    const char *folder, *path;
    sqlite3 *database;
    sqlite3_stmt *insert;
    tl_error *error;
} packing;

static tl_status failed(const packing *p)
{
    return tl_fail(p->error, TL_ERROR_IO, "%s: cannot be written: %s", p->path,
                   p->database ? sqlite3_errmsg(p->database) : "not enough memory");
}

static tl_status run(const packing *p, const char *command)
{
    return sqlite3_exec(p->database, command, NULL, NULL, NULL) == SQLITE_OK ? TL_OK : failed(p);
}

/* ---- What it says of itself ---- */

static tl_status say(const packing *p, const char *name, const char *value)
{
    sqlite3_stmt *statement = NULL;
    bool good =
        sqlite3_prepare_v2(p->database, "INSERT INTO metadata VALUES (?, ?)", -1, &statement, NULL) == SQLITE_OK &&
        sqlite3_bind_text(statement, 1, name, -1, SQLITE_TRANSIENT) == SQLITE_OK &&
        sqlite3_bind_text(statement, 2, value, -1, SQLITE_TRANSIENT) == SQLITE_OK &&
        sqlite3_step(statement) == SQLITE_DONE;
    sqlite3_finalize(statement);
    return good ? TL_OK : failed(p);
}

static tl_status describe(const packing *p, const json_t *layer)
{
    char text[256];
    const json_t *bounds = json_object_get(layer, "bounds");
    const char *name = json_string_value(json_object_get(layer, "name"));
    tl_status status = say(p, "name", name ? name : "terrain");
    if (status == TL_OK)
        status = say(p, "format", "application/vnd.quantized-mesh");
    if (status == TL_OK)
        status = say(p, "crs", "EPSG:4326");
    if (status == TL_OK)
        status = say(p, "scheme", "tms");
    for (int k = 0; k < 2 && status == TL_OK; k++) {
        snprintf(text, sizeof text, "%lld",
                 (long long)json_integer_value(json_object_get(layer, k ? "maxzoom" : "minzoom")));
        status = say(p, k ? "maxzoom" : "minzoom", text);
    }
    snprintf(text, sizeof text, "%.9g,%.9g,%.9g,%.9g", json_number_value(json_array_get(bounds, 0)),
             json_number_value(json_array_get(bounds, 1)), json_number_value(json_array_get(bounds, 2)),
             json_number_value(json_array_get(bounds, 3)));
    if (status == TL_OK)
        status = say(p, "bounds", text);
    const char *attribution = json_string_value(json_object_get(layer, "attribution"));
    if (status == TL_OK && attribution)
        status = say(p, "attribution", attribution);
    /* the whole index, for servers that hand it on */
    char *whole = status == TL_OK ? json_dumps(layer, JSON_COMPACT | JSON_REAL_PRECISION(17)) : NULL;
    if (status == TL_OK)
        status = whole ? say(p, "json", whole) : tl_fail_memory(p->error, p->path);
    free(whole);
    return status;
}

/* ---- Tiles ---- */

static int by_number(const void *a, const void *b)
{
    const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

/* Numbers that name what is in a folder, rising; NULL and 0: none. *bad: it cannot be read. */
static int64_t *list_numbers(const char *path, const char *ending, size_t *count, bool *bad)
{
    int64_t *numbers = NULL;
    size_t room = 0;
    DIR *directory = opendir(path);
    *count = 0;
    *bad = !directory;
    for (struct dirent *entry; !*bad && (entry = readdir(directory));) {
        char *end;
        long long number = strtoll(entry->d_name, &end, 10);
        if (end == entry->d_name || strcmp(end, ending) != 0)
            continue;
        if (*count == room) {
            room = room ? 2 * room : 64;
            int64_t *more = realloc(numbers, room * sizeof *more);
            *bad = !more;
            numbers = more ? more : numbers;
        }
        if (!*bad)
            numbers[(*count)++] = number;
    }
    if (directory)
        closedir(directory);
    if (numbers)
        qsort(numbers, *count, sizeof *numbers, by_number);
    return numbers;
}

static tl_status add_tile(const packing *p, const char *file, int64_t level, int64_t column, int64_t row)
{
    FILE *in = fopen(file, "rb");
    long size = in && fseek(in, 0, SEEK_END) == 0 ? ftell(in) : -1;
    unsigned char *bytes = size >= 0 && fseek(in, 0, SEEK_SET) == 0 ? malloc((size_t)size + 1) : NULL;
    bool good = bytes && fread(bytes, 1, (size_t)size, in) == (size_t)size;
    int code = errno;
    if (in)
        fclose(in);
    tl_status status = good ? TL_OK : tl_fail_system(p->error, file, "read", code);
    if (good &&
        (sqlite3_bind_int64(p->insert, 1, level) != SQLITE_OK ||
         sqlite3_bind_int64(p->insert, 2, column) != SQLITE_OK || sqlite3_bind_int64(p->insert, 3, row) != SQLITE_OK ||
         sqlite3_bind_blob64(p->insert, 4, bytes, (uint64_t)size, SQLITE_STATIC) != SQLITE_OK ||
         sqlite3_step(p->insert) != SQLITE_DONE || sqlite3_reset(p->insert) != SQLITE_OK))
        status = failed(p);
    free(bytes);
    return status;
}

static tl_status add_column(const packing *p, const char *folder, int64_t level, int64_t column)
{
    size_t count;
    bool bad;
    int64_t *rows = list_numbers(folder, ".terrain", &count, &bad);
    tl_status status = bad ? tl_fail_system(p->error, folder, "read", errno) : TL_OK;
    for (size_t k = 0; k < count && status == TL_OK; k++) {
        char file[4352];
        snprintf(file, sizeof file, "%s/%lld.terrain", folder, (long long)rows[k]);
        status = add_tile(p, file, level, column, rows[k]);
    }
    free(rows);
    return status;
}

static tl_status add_level(const packing *p, int64_t level)
{
    char folder[4200];
    size_t count;
    bool bad;
    snprintf(folder, sizeof folder, "%s/%lld", p->folder, (long long)level);
    int64_t *columns = list_numbers(folder, "", &count, &bad);
    tl_status status = bad ? tl_fail_system(p->error, folder, "read", errno) : TL_OK;
    for (size_t k = 0; k < count && status == TL_OK; k++) {
        char inner[4300];
        snprintf(inner, sizeof inner, "%s/%lld", folder, (long long)columns[k]);
        status = add_column(p, inner, level, columns[k]);
    }
    free(columns);
    return status;
}

static tl_status fill(packing *p, const json_t *layer, const char *part)
{
    if (sqlite3_open(part, &p->database) != SQLITE_OK)
        return failed(p);
    tl_status status =
        run(p, "PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; PRAGMA application_id = 0x4d504258; BEGIN;"
               "CREATE TABLE metadata (name text, value text);"
               "CREATE TABLE tiles (zoom_level integer, tile_column integer, tile_row integer, tile_data blob);");
    if (status == TL_OK)
        status = describe(p, layer);
    if (status == TL_OK &&
        sqlite3_prepare_v2(p->database, "INSERT INTO tiles VALUES (?, ?, ?, ?)", -1, &p->insert, NULL) != SQLITE_OK)
        status = failed(p);
    json_int_t first = json_integer_value(json_object_get(layer, "minzoom")),
               last = json_integer_value(json_object_get(layer, "maxzoom"));
    for (json_int_t level = first; level <= last && status == TL_OK; level++)
        status = add_level(p, level);
    sqlite3_finalize(p->insert);
    if (status == TL_OK)
        status = run(p, "CREATE UNIQUE INDEX tile_index ON tiles (zoom_level, tile_column, tile_row); COMMIT;");
    if (sqlite3_close(p->database) != SQLITE_OK && status == TL_OK)
        status = failed(p);
    return status;
}

tl_status tl_pack_mbtiles(const char *folder, const char *path, bool overwrite, tl_error *error)
{
    packing p = {.folder = folder, .path = path, .error = error};
    if (!overwrite && access(path, F_OK) == 0)
        return tl_fail(error, TL_ERROR_IO, "%s: exists already; name another file or remove it", path);
    size_t room = strlen(path) + sizeof ".part";
    char *index = out_inside(folder, "layer.json"), *part = malloc(room);
    json_t *layer = index ? json_load_file(index, 0, NULL) : NULL;
    tl_status status = index && part ? TL_OK : tl_fail_memory(error, path);
    if (status == TL_OK && !json_is_integer(json_object_get(layer, "maxzoom")))
        status = tl_fail(error, TL_ERROR_DATA, "%s: is no finished folder of quantized-mesh tiles", folder);
    if (status == TL_OK && part) {
        snprintf(part, room, "%s.part", path);
        unlink(part);
        status = fill(&p, layer, part);
        if (status == TL_OK && rename(part, path))
            status = tl_fail_system(error, path, "write", errno);
        if (status != TL_OK)
            unlink(part);
    }
    json_decref(layer);
    free(part);
    free(index);
    return status;
}

#endif
