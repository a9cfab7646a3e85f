/* From the names that a user gives to one source: a file, or a mosaic of many. */
#include "dem/mosaic.h"
#include "dem/paths.h"
#include "dem/tiff_file.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <sys/resource.h>

enum { OPEN_FILES = 64 };

/* ---- One file ---- */

static tl_status read_head(dem_file *file, unsigned char head[4], tl_error *error)
{
    tl_status status = dem_file_acquire(file, error);
    if (status != TL_OK)
        return status;
    if (dem_file_read_at(file, head, 4, 0) < 0)
        status = tl_fail_system(error, dem_file_path(file), "read", errno);
    dem_file_release(file);
    return status;
}

static tl_source *source_of(dem_file *file, const dem_sharing *sharing, const tl_dem_options *options, tl_error *error)
{
    const char *path = dem_file_path(file);
    unsigned char head[4] = {0};
    tl_status status = read_head(file, head, error);
    if (status == TL_OK && dem_is_tiff(head))
        return dem_raster_create(file, sharing, options, error);
    if (status == TL_OK && dem_file_size(file) == 0)
        tl_fail(error, TL_ERROR_DATA, "%s: the file is empty", path);
    else if (status == TL_OK && !dem_hgt_named(path))
        tl_fail(error, TL_ERROR_DATA, "%s: not a TIFF file", path);
    else if (status == TL_OK && options->band > 1)
        tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no band %u; it has 1", path, options->band);
    else if (status == TL_OK)
        return dem_hgt_create(file, sharing, error);
    dem_file_close(file);
    return NULL;
}

tl_source *dem_file_source(const char *path, const dem_sharing *sharing, const tl_dem_options *options, tl_error *error)
{
    dem_file *file = dem_file_open(path, sharing->pool, error);
    return file ? source_of(file, sharing, options, error) : NULL;
}

/* ---- Several ---- */

typedef struct opening {
    const dem_paths *paths;
    const tl_dem_options *options;
    dem_sharing sharing;
    tl_source **members;
} opening;

static tl_status open_member(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    opening *o = context;
    tl_error failure = {0};
    size_t k = (size_t)item + 1;
    o->members[k] = dem_file_source(o->paths->names[k], &o->sharing, o->options, &failure);
    if (o->members[k])
        return TL_OK;
    *error = failure;
    return failure.status;
}

/* The first alone, for its CRS is probably that of the others. */
static tl_status open_members(opening *o, tl_error *error)
{
    o->members[0] = dem_file_source(o->paths->names[0], &o->sharing, o->options, error);
    if (!o->members[0])
        return TL_ERROR_DATA;
    o->sharing.crs = o->members[0]->info.georef.crs;
    return tl_parallel_for(o->options->run, o->paths->count - 1, o->paths->count - 1, open_member, o, error);
}

static void close_members(opening *o)
{
    for (size_t k = 0; o->members && k < o->paths->count; k++)
        tl_source_destroy(o->members[k]);
    free(o->members);
    dem_block_cache_destroy(o->sharing.cache);
    dem_file_pool_destroy(o->sharing.pool);
}

/* At most half of what the process may open at once: outputs need some too. */
static unsigned open_limit(const tl_dem_options *options)
{
    unsigned wanted = options->open_files ? options->open_files : OPEN_FILES;
    struct rlimit limit;
    if (getrlimit(RLIMIT_NOFILE, &limit) == 0 && limit.rlim_cur / 2 < wanted)
        wanted = (unsigned)(limit.rlim_cur / 2);
    return wanted;
}

static tl_source *open_several(const dem_paths *paths, const char *name, const tl_dem_options *options, tl_error *error)
{
    opening o = {.paths = paths, .options = options};
    o.members = calloc(paths->count, sizeof(tl_source *));
    o.sharing.pool = dem_file_pool_create(open_limit(options));
    o.sharing.cache = dem_block_cache_create(dem_cache_budget(options), 16 * (uint64_t)paths->count);
    tl_source *joined = NULL;
    if (!o.members || !o.sharing.pool || !o.sharing.cache)
        tl_fail_memory(error, name);
    else if (open_members(&o, error) == TL_OK)
        joined = dem_mosaic_create(o.members, paths->count, &o.sharing, name, options, error);
    if (!joined)
        close_members(&o);
    return joined;
}

/* What to call several: what the user called them, where that was one name. */
static void name_several(const char *const *given, size_t count, const dem_paths *paths, char *name, size_t size)
{
    if (count == 1)
        snprintf(name, size, "%s", given[0]);
    else
        snprintf(name, size, "%s and %zu more", paths->names[0], paths->count - 1);
}

tl_source *tl_dem_open(const char *const *paths, size_t count, const tl_dem_options *options, tl_error *error)
{
    static const tl_dem_options defaults;
    static const dem_sharing nothing;
    char name[400];
    dem_paths all;
    options = options ? options : &defaults;
    if (dem_paths_expand(paths, count, &all, error) != TL_OK)
        return NULL;
    name_several(paths, count, &all, name, sizeof name);
    tl_source *source = all.count == 1 ? dem_file_source(all.names[0], &nothing, options, error)
                                       : open_several(&all, name, options, error);
    dem_paths_finish(&all);
    return source;
}

/* ---- What is known of them ---- */

tl_status tl_dem_get_details(const tl_source *source, tl_dem_details *out, tl_error *error)
{
    size_t count;
    if (dem_raster_details(source, out) || dem_hgt_details(source, out))
        return TL_OK;
    if (dem_mosaic_members(source, &count))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %zu files joined into one; each has details of its own",
                       source->info.name, count);
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: not an elevation model read from a file", source->info.name);
}

size_t tl_dem_member_count(const tl_source *source)
{
    size_t count;
    tl_dem_details details;
    if (dem_mosaic_members(source, &count))
        return count;
    return dem_raster_details(source, &details) || dem_hgt_details(source, &details);
}

tl_status tl_dem_get_member(const tl_source *source, size_t index, tl_dem_member *out, tl_error *error)
{
    size_t count = tl_dem_member_count(source), joined;
    if (index >= count)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no member %zu; it has %zu", source->info.name, index, count);
    tl_source *const *members = dem_mosaic_members(source, &joined);
    *out = (tl_dem_member){.source = members ? members[index] : source,
                           .window = {0, 0, source->info.width, source->info.height}};
    if (members)
        out->window = dem_mosaic_place(source, index, &out->resampled);
    return TL_OK;
}
