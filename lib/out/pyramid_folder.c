#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/output.h"
#include "lib/base/size.h"
#include "lib/out/tile_pyramid.h"

#include <fcntl.h>
#include <libdeflate.h>
#include <limits.h>

#include <dirent.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

/* ---- Files ---- */

char *out_inside(const char *folder, const char *name)
{
    size_t room = strlen(folder) + strlen(name) + 2;
    char *path = malloc(room);
    if (path)
        snprintf(path, room, "%s/%s", folder, name);
    return path;
}

static tl_status make_folder(const char *path, tl_error *error)
{
    return mkdir(path, 0777) == 0 || errno == EEXIST ? TL_OK : tl_fail_system(error, path, "make", errno);
}

/* The folders that `name` names, in the folder. */
static tl_status make_folders(const char *folder, const char *name, tl_error *error)
{
    char *path = out_inside(folder, name);
    size_t at = strlen(folder) + 1;
    tl_status status = path ? TL_OK : tl_fail_memory(error, folder);
    for (char *slash = path ? strchr(path + at, '/') : NULL; slash && status == TL_OK; slash = strchr(slash + 1, '/')) {
        *slash = 0;
        status = make_folder(path, error);
        *slash = '/';
    }
    free(path);
    return status;
}

tl_status out_write_inside(const char *folder, const char *name, const void *bytes, size_t count, bool overwrite,
                           tl_error *error)
{
    char *path = out_inside(folder, name);
    tl_status status = path ? make_folders(folder, name, error) : tl_fail_memory(error, folder);
    tl_output *output = status == TL_OK ? tl_output_open(path, overwrite, error) : NULL;
    if (status == TL_OK)
        status = output ? tl_output_append(output, bytes, count, error) : TL_ERROR_IO;
    if (output && status == TL_OK)
        status = tl_output_commit(output, error);
    else
        tl_output_abort(output);
    free(path);
    return status;
}

static bool holds(const char *folder, const char *name, const char *text)
{
    char *path = out_inside(folder, name), *found = malloc(strlen(text) + 2);
    FILE *file = path && found ? fopen(path, "rb") : NULL;
    size_t length = strlen(text);
    bool same = file && fread(found, 1, length + 1, file) == length && memcmp(found, text, length) == 0;
    if (file)
        fclose(file);
    free(found);
    free(path);
    return same;
}

/* But for what a run leaves behind that was killed when it had just begun. */
static bool is_empty(const char *folder)
{
    DIR *directory = opendir(folder);
    struct dirent *entry;
    bool empty = true;
    while (directory && empty && (entry = readdir(directory)))
        empty = strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0 ||
                strncmp(entry->d_name, ".talus", 6) == 0;
    if (directory)
        closedir(directory);
    return empty;
}

static bool exists(const char *folder, const char *name)
{
    char *path = out_inside(folder, name);
    bool there = path && access(path, F_OK) == 0;
    free(path);
    return there;
}

/* ---- The job ---- */

tl_status out_sum_rows(const tl_source *source, uint32_t *sum, tl_error *error)
{
    enum { ROWS = 16 };
    const tl_source_info *info = &source->info;
    float *row = tl_alloc((size_t)info->width, sizeof *row);
    tl_status status = row ? TL_OK : tl_fail_memory(error, info->name);
    *sum = 0;
    for (int64_t k = 0; k < ROWS && status == TL_OK; k++) {
        const tl_window window = {0, (2 * k + 1) * info->height / (2 * ROWS), info->width, 1};
        status = tl_source_read(source, info->level, window, row, error);
        for (int64_t x = 0; status == TL_OK && x < info->width; x++)
            row[x] = isnan(row[x]) ? NAN : row[x]; /* one kind of them */
        if (status == TL_OK)
            *sum = libdeflate_crc32(*sum, row, (size_t)info->width * sizeof *row);
    }
    free(row);
    return status;
}

char *out_describe_job(const out_pyramid *p)
{
    const tl_source_info *info = &p->source->info;
    json_t *root =
        json_pack("{s:s, s:i, s:f, s:i, s:b, s:f, s:I, s:I}", "version", tl_version(), "deepest", p->deepest,
                  "max_error", p->max_error, "first_level", p->options->first_level, "normals", !p->options->no_normals,
                  "outside", p->options->outside, "width", (json_int_t)info->width, "height", (json_int_t)info->height);
    json_t *transform = json_array();
    for (int k = 0; k < 6; k++)
        json_array_append_new(transform, json_real(info->georef.transform[k]));
    json_object_set_new(root, "transform", transform);
    json_object_set_new(root, "crs", json_string(tl_crs_name(info->georef.crs)));
    json_object_set_new(root, "rows", json_integer(p->sum));
    json_t *parameters = json_object();
    for (size_t k = 0; k < info->parameter_count; k++)
        json_object_set_new(parameters, info->parameters[k].name, json_string(info->parameters[k].value));
    json_object_set_new(root, "parameters", parameters);
    if (p->options->format != TL_TILES_QUANTIZED_MESH) { /* the first format has none of these */
        json_object_set_new(root, "format", json_integer(p->options->format));
        json_object_set_new(root, "coding", json_integer(p->options->coding));
        json_object_set_new(root, "textures", json_integer(p->options->textures));
    }
    char *text = json_dumps(root, JSON_INDENT(1) | JSON_REAL_PRECISION(17));
    json_decref(root);
    return text;
}

tl_status out_begin_folder(const out_pyramid *p, const char *text, tl_error *error)
{
    bool go_on = p->options->resume || p->options->shards || p->options->finish;
    tl_status status = make_folder(p->folder, error);
    if (status != TL_OK)
        return status;
    /* in this order: another shard begins before it writes tiles */
    bool empty = is_empty(p->folder), begun = exists(p->folder, ".talus/job.json");
    if (!begun && exists(p->folder, p->scheme->index))
        return tl_fail(error, TL_ERROR_IO,
                       go_on ? "%s: holds finished tiles, of another source or other options; name another folder"
                             : "%s: holds finished tiles; name another folder",
                       p->folder);
    if (!begun && !empty)
        return tl_fail(error, TL_ERROR_IO, "%s: is not empty, and holds no tiles that were begun; name another folder",
                       p->folder);
    if (begun && !go_on)
        return tl_fail(error, TL_ERROR_IO,
                       "%s: holds tiles that were begun; go on with them by --resume, or name another folder",
                       p->folder);
    char *path = out_inside(p->folder, ".talus");
    status = path ? make_folder(path, error) : tl_fail_memory(error, p->folder);
    free(path);
    if (status == TL_OK && !begun) /* of several shards one is the first */
        out_write_inside(p->folder, ".talus/job.json", text, strlen(text), false, NULL);
    if (status == TL_OK && !holds(p->folder, ".talus/job.json", text))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: was begun with another source or other options; name another folder", p->folder);
    return status;
}

/* What out_describe_record wrote, or a tileset's asset holds. */
static const json_t *job_of_index(const json_t *index)
{
    const json_t *record = json_object_get(index, "talus");
    record = record ? record : json_object_get(json_object_get(index, "extras"), "talus");
    return json_object_get(record, "job");
}

bool out_folder_is_complete(const out_pyramid *p, const char *text)
{
    char *path = out_inside(p->folder, p->scheme->index);
    json_t *layer = path ? json_load_file(path, 0, NULL) : NULL, *wanted = json_loads(text, 0, NULL);
    const json_t *made = job_of_index(layer);
    bool same = made && wanted && json_equal(made, wanted);
    json_decref(wanted);
    json_decref(layer);
    free(path);
    return same;
}

/* Allocates nothing of its own, so that a pyramid that is complete is cleared whatever the memory. */
void out_clear_work(const out_pyramid *p)
{
    char work[PATH_MAX];
    int length = snprintf(work, sizeof work, "%s/.talus", p->folder);
    DIR *directory = length > 0 && length < (int)sizeof work ? opendir(work) : NULL;
    if (!directory)
        return;
    for (const struct dirent *entry; (entry = readdir(directory));)
        if (entry->d_name[0] != '.' && strcmp(entry->d_name, "job.json") != 0)
            unlinkat(dirfd(directory), entry->d_name, 0);
    unlinkat(dirfd(directory), "job.json", 0); /* the last, for it says what the rest is */
    closedir(directory);
    rmdir(work);
}

/* ---- The record ---- */

static json_t *describe_errors(const out_pyramid *p)
{
    json_t *errors = json_array();
    for (int level = 0; level <= p->deepest; level++)
        json_array_append_new(errors, json_real(p->report.levels[level].error));
    return errors;
}

json_t *out_describe_record(const out_pyramid *p)
{
    json_t *record = json_pack("{s:s, s:o, s:f}", "version", tl_version(), "errors", describe_errors(p), "resampling",
                               p->report.resampling);
    for (size_t k = 0; k < p->source->info.parameter_count; k++)
        json_object_set_new(record, p->source->info.parameters[k].name,
                            json_string(p->source->info.parameters[k].value));
    char *job_text = out_describe_job(p);
    json_object_set_new(record, "job", job_text ? json_loads(job_text, 0, NULL) : NULL);
    free(job_text);
    return record;
}
