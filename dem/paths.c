/* A list file has one name a line; spaces around it, empty lines and lines that begin with # count for nothing. Names
 * are relative to the list's folder, and may be directories and patterns, but no lists. */
#include "dem/paths.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <glob.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <unistd.h>

enum { MAX_NAMES = 1000000 };

void dem_paths_finish(dem_paths *paths)
{
    for (size_t k = 0; k < paths->count; k++)
        free(paths->names[k]);
    free(paths->names);
    *paths = (dem_paths){0};
}

static tl_status grow(dem_paths *paths, const char *name, tl_error *error)
{
    if (paths->count >= MAX_NAMES)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: more than %d input files; give fewer at once", name, MAX_NAMES);
    size_t room = paths->room ? 2 * paths->room : 16;
    char **names = realloc(paths->names, room * sizeof *names);
    if (!names)
        return tl_fail_memory(error, name);
    paths->names = names;
    paths->room = room;
    return TL_OK;
}

/* Adds FOLDER/NAME, or NAME alone where the folder is of no length or the name says all. */
static tl_status add(dem_paths *paths, const char *folder, size_t folder_length, const char *name, tl_error *error)
{
    tl_status status = paths->count == paths->room ? grow(paths, name, error) : TL_OK;
    if (status != TL_OK)
        return status;
    if (*name == '/')
        folder_length = 0;
    size_t bytes = folder_length + strlen(name) + 2;
    char *joined = malloc(bytes);
    if (!joined)
        return tl_fail_memory(error, name);
    bool slash = folder_length && folder[folder_length - 1] != '/';
    snprintf(joined, bytes, "%.*s%s%s", (int)folder_length, folder, slash ? "/" : "", name);
    paths->names[paths->count++] = joined;
    return TL_OK;
}

static int by_bytes(const void *a, const void *b)
{
    return strcmp(*(char *const *)a, *(char *const *)b);
}

static void sort_from(dem_paths *paths, size_t first)
{
    if (paths->count > first)
        qsort(paths->names + first, paths->count - first, sizeof *paths->names, by_bytes);
}

/* ---- Directories and patterns ---- */

static bool is_directory(const char *path)
{
    struct stat status;
    return stat(path, &status) == 0 && S_ISDIR(status.st_mode);
}

static bool is_raster_name(const char *name)
{
    static const char *const endings[] = {".tif", ".tiff", ".hgt"};
    const char *dot = strrchr(name, '.');
    for (size_t k = 0; dot && dot != name && name[0] != '.' && k < sizeof endings / sizeof *endings; k++)
        if (strcasecmp(dot, endings[k]) == 0)
            return true;
    return false;
}

/* Adds the entry of a directory; one that is a directory itself is left out again. */
static tl_status add_entry(dem_paths *paths, const char *path, const char *name, tl_error *error)
{
    tl_status status = add(paths, path, strlen(path), name, error);
    if (status == TL_OK && is_directory(paths->names[paths->count - 1]))
        free(paths->names[--paths->count]);
    return status;
}

static tl_status add_entries(dem_paths *paths, const char *path, DIR *directory, tl_error *error)
{
    tl_status status = TL_OK;
    const struct dirent *entry;
    errno = 0;
    while (status == TL_OK && (entry = readdir(directory)) != NULL) {
        if (is_raster_name(entry->d_name))
            status = add_entry(paths, path, entry->d_name, error);
        errno = 0;
    }
    return status == TL_OK && errno ? tl_fail_system(error, path, "read", errno) : status;
}

static tl_status add_directory(dem_paths *paths, const char *path, tl_error *error)
{
    size_t first = paths->count;
    DIR *directory = opendir(path);
    if (!directory)
        return tl_fail_system(error, path, "read", errno);
    tl_status status = add_entries(paths, path, directory, error);
    closedir(directory);
    if (status == TL_OK && paths->count == first)
        return tl_fail(error, TL_ERROR_DATA, "%s: no .tif, .tiff or .hgt file is in this directory", path);
    sort_from(paths, first);
    return status;
}

static tl_status add_matches(dem_paths *paths, const char *pattern, const glob_t *found, tl_error *error)
{
    size_t first = paths->count;
    for (size_t k = 0; k < found->gl_pathc; k++) {
        if (is_directory(found->gl_pathv[k]))
            continue;
        tl_status status = add(paths, "", 0, found->gl_pathv[k], error);
        if (status != TL_OK)
            return status;
    }
    if (paths->count == first)
        return tl_fail(error, TL_ERROR_IO, "%s: no file has a name of this pattern", pattern);
    sort_from(paths, first);
    return TL_OK;
}

/* The order of glob() depends on the locale, so it is not asked for. */
static tl_status add_pattern(dem_paths *paths, const char *pattern, tl_error *error)
{
    glob_t found = {0};
    int result = glob(pattern, GLOB_NOSORT, NULL, &found);
    tl_status status;
    if (result == GLOB_NOSPACE)
        status = tl_fail_memory(error, pattern);
    else
        status = add_matches(paths, pattern, &found, error);
    globfree(&found);
    return status;
}

static tl_status add_name(dem_paths *paths, const char *name, tl_error *error)
{
    struct stat status;
    if (is_directory(name))
        return add_directory(paths, name, error);
    if (strpbrk(name, "*?[") && lstat(name, &status) != 0)
        return add_pattern(paths, name, error);
    return add(paths, "", 0, name, error);
}

/* ---- Lists ---- */

static char *trimmed(char *line)
{
    static const char spaces[] = " \t\r\n\f\v";
    line += strspn(line, spaces);
    size_t length = strlen(line);
    while (length && strchr(spaces, line[length - 1]))
        length--;
    line[length] = 0;
    return line;
}

/* The name of a line, relative to the list's folder, expanded. */
static tl_status add_line(dem_paths *paths, const char *list, const char *name, tl_error *error)
{
    const char *slash = strrchr(list, '/');
    dem_paths joined = {0};
    if (*name == '@')
        return tl_fail(error, TL_ERROR_DATA, "%s: names the list %s; a list holds no lists", list, name);
    tl_status status = add(&joined, list, slash ? (size_t)(slash + 1 - list) : 0, name, error);
    if (status == TL_OK)
        status = add_name(paths, joined.names[0], error);
    dem_paths_finish(&joined);
    return status;
}

static tl_status add_lines(dem_paths *paths, const char *list, FILE *file, tl_error *error)
{
    char *line = NULL;
    size_t room = 0, first = paths->count;
    tl_status status = TL_OK;
    ssize_t length;
    errno = 0;
    while (status == TL_OK && (length = getline(&line, &room, file)) >= 0) {
        if (memchr(line, 0, (size_t)length)) {
            status = tl_fail(error, TL_ERROR_DATA, "%s: not a list of names, one a line", list);
            break;
        }
        const char *name = trimmed(line);
        if (*name && *name != '#')
            status = add_line(paths, list, name, error);
        errno = 0;
    }
    if (status == TL_OK && ferror(file))
        status = tl_fail_system(error, list, "read", errno);
    free(line);
    if (status == TL_OK && paths->count == first)
        status = tl_fail(error, TL_ERROR_DATA, "%s: the list names no files", list);
    return status;
}

/* A regular file: reading anything else, as a named pipe, may wait for ever. */
static tl_status add_list(dem_paths *paths, const char *list, tl_error *error)
{
    struct stat status;
    int descriptor = open(list, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
    if (descriptor < 0)
        return tl_fail_system(error, list, "read", errno);
    bool regular = fstat(descriptor, &status) == 0 && S_ISREG(status.st_mode);
    FILE *file = regular ? fdopen(descriptor, "r") : NULL;
    if (!file) {
        close(descriptor);
        return regular ? tl_fail_memory(error, list)
                       : tl_fail(error, TL_ERROR_DATA, "%s: not a regular file, so no list of names", list);
    }
    tl_status result = add_lines(paths, list, file, error);
    fclose(file);
    return result;
}

tl_status dem_paths_expand(const char *const *paths, size_t count, dem_paths *out, tl_error *error)
{
    tl_status status = TL_OK;
    *out = (dem_paths){0};
    for (size_t k = 0; k < count && status == TL_OK; k++)
        status = paths[k][0] == '@' ? add_list(out, paths[k] + 1, error) : add_name(out, paths[k], error);
    if (status == TL_OK && !out->count)
        status = tl_fail(error, TL_ERROR_ARGUMENT, "no input file is given");
    if (status != TL_OK)
        dem_paths_finish(out);
    return status;
}
