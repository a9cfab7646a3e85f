#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/out/heightmap_read.h"
#include "lib/out/out.h"
#include "lib/scene/north_up.h"

#include <assert.h>
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <unistd.h>

typedef tl_status (*grid_writer)(const tl_source *, tl_output *, const tl_write_options *, tl_error *);
typedef tl_status (*mesh_writer)(const tl_mesh *, tl_output *, const tl_write_options *, tl_error *);

/* One row a format. Those with a JSON file beside them open both themselves. A picture is read by its rows, without
 * georeference, so its first row is the north. */
static const struct writers {
    const char *ending;
    bool picture;
    grid_writer grid;
    mesh_writer mesh;
    tl_status (*path)(const tl_source *, const char *, const tl_write_options *, tl_error *);
} writers[] = {
    {"exr", true, out_exr_write, NULL, NULL},       {"tif", false, out_geotiff_write, NULL, NULL},
    {"tiff", false, out_geotiff_write, NULL, NULL}, {"png", true, NULL, NULL, out_png16_write},
    {"r16", true, NULL, NULL, out_r16_write},       {"raw", true, NULL, NULL, out_raw_write},
    {"glb", false, NULL, out_gltf_write, NULL},     {"obj", false, NULL, out_obj_write, NULL},
    {"ply", false, NULL, out_ply_write, NULL},      {"stl", false, NULL, out_stl_write, NULL},
};

/* In the order of `writers`. A mesh format takes grids too: as their full mesh. */
static const tl_format formats[] = {
    {"exr", "OpenEXR heightfield, 32-bit float, tiled", true, false},
    {"tif", "GeoTIFF, 32-bit float, tiled", true, false},
    {"tiff", "the same", true, false},
    {"png", "16-bit grey PNG over the range of heights, with a JSON file beside it", true, false},
    {"r16", "unsigned 16-bit values over the range of heights, with a JSON file beside them", true, false},
    {"raw", "32-bit floats row by row, with a JSON file beside them", true, false},
    {"glb", "glTF 2.0 binary mesh", true, true},
    {"obj", "Wavefront OBJ mesh", true, true},
    {"ply", "binary PLY mesh", true, true},
    {"stl", "binary STL mesh, for 3-D printing", true, true},
    {NULL, NULL, false, false},
};
_Static_assert(sizeof formats / sizeof *formats == sizeof writers / sizeof *writers + 1, "one writer a format");

const tl_format *tl_formats(void)
{
    return formats;
}

const tl_format *tl_format_of(const char *path)
{
    const char *dot = strrchr(path, '.');
    if (!dot || dot == path || dot[-1] == '/' || strchr(dot, '/'))
        return NULL;
    for (const tl_format *f = formats; f->ending; f++)
        if (strcasecmp(dot + 1, f->ending) == 0)
            return f;
    return NULL;
}

static const struct writers *writers_of(const char *path, tl_error *error)
{
    const tl_format *format = tl_format_of(path);
    if (!format) {
        tl_fail(error, TL_ERROR_ARGUMENT,
                "%s: no format has this ending; use one of exr, tif, png, r16, raw, glb, obj, ply, stl", path);
        return NULL;
    }
    const struct writers *found = &writers[format - formats];
    assert(strcmp(found->ending, format->ending) == 0);
    return found;
}

static tl_status finish(tl_output *output, tl_status status, tl_error *error)
{
    if (status == TL_OK)
        return tl_output_commit(output, error);
    tl_output_abort(output);
    return status;
}

static const tl_write_options defaults;

tl_status tl_write_mesh(const tl_mesh *mesh, const char *path, const tl_write_options *options, tl_error *error)
{
    options = options ? options : &defaults;
    const struct writers *format = writers_of(path, error);
    if (!format)
        return TL_ERROR_ARGUMENT;
    if (!format->mesh)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: .%s holds no meshes; use glb, obj, ply or stl", path,
                       format->ending);
    if (options->split && format->mesh == out_gltf_write)
        return out_gltf_write_parts(mesh, path, options, error);
    tl_output *output = tl_output_open(path, options->overwrite, error);
    if (!output)
        return TL_ERROR_IO;
    return finish(output, format->mesh(mesh, output, options, error), error);
}

static tl_status write_as_mesh(const tl_source *source, const char *path, const tl_write_options *options,
                               tl_error *error)
{
    /* vertex, triangles and numbers of a sample; a GLB has coordinates and normals of all in memory too */
    const mesh_writer write = writers_of(path, error)->mesh;
    const double sample_bytes = write == out_gltf_write ? 96 : 44;
    double samples = (double)source->info.width * (double)source->info.height;
    tl_status fits = tl_run_fits(options->run, sample_bytes * samples, path, "the full mesh", error);
    if (fits != TL_OK && samples <= 0x1p31) /* more are no mesh, whatever the memory: told below */
        return fits;
    const bool parts = options->split && write == out_gltf_write;
    tl_output *output =
        parts ? NULL : tl_output_open(path, options->overwrite, error); /* refused before the work, not after it */
    if (!output && !parts)
        return TL_ERROR_IO;
    tl_mesh *mesh = NULL;
    tl_status status = tl_mesh_from_source(source, options->run, &mesh, error);
    tl_write_options writing = *options;
    writing.ground = source;
    if (status == TL_OK)
        status = parts ? out_gltf_write_parts(mesh, path, &writing, error) : write(mesh, output, &writing, error);
    tl_mesh_destroy(mesh);
    if (parts)
        return status;
    return finish(output, status, error);
}

static tl_status write_rows(const struct writers *format, const tl_source *source, const char *path,
                            const tl_write_options *options, tl_error *error)
{
    if (format->path)
        return format->path(source, path, options, error);
    tl_output *output = tl_output_open(path, options->overwrite, error);
    if (!output)
        return TL_ERROR_IO;
    return finish(output, format->grid(source, output, options, error), error);
}

/* "x.exr" to "x.validity.tif". */
static char *validity_path(const char *path)
{
    static const char ending[] = ".validity.tif";
    size_t stem = (size_t)(strrchr(path, '.') - path);
    char *result = malloc(stem + sizeof ending);
    if (result) {
        memcpy(result, path, stem);
        memcpy(result + stem, ending, sizeof ending);
    }
    return result;
}

/* The heights, and beside them their validity, which gets its name when the heights have theirs. */
static tl_status write_with_validity(const struct writers *format, const tl_source *source, const char *path,
                                     const tl_write_options *options, tl_error *error)
{
    char *beside = validity_path(path);
    tl_output *output = beside ? tl_output_open(beside, options->overwrite, error) : NULL;
    tl_status status = beside ? TL_ERROR_IO : tl_fail_memory(error, path);
    if (output)
        status = out_validity_write(source, output, options, error);
    if (status == TL_OK)
        status = write_rows(format, source, path, options, error);
    if (output)
        status = finish(output, status, error);
    free(beside);
    return status;
}

tl_status tl_write_grid(const tl_source *source, const char *path, const tl_write_options *options, tl_error *error)
{
    options = options ? options : &defaults;
    const struct writers *format = writers_of(path, error);
    if (!format)
        return TL_ERROR_ARGUMENT;
    if (format->mesh)
        return write_as_mesh(source, path, options, error);
    tl_source *upright = format->picture ? scene_north_up(source, error) : NULL;
    if (format->picture && !upright)
        return TL_ERROR_MEMORY;
    tl_status status = (options->validity ? write_with_validity : write_rows)(format, upright ? upright : source, path,
                                                                              options, error);
    tl_source_destroy(upright);
    return status;
}

static bool is_exr(const char *path)
{
    static const unsigned char magic[4] = {0x76, 0x2f, 0x31, 0x01};
    unsigned char head[4] = {0};
    /* O_NONBLOCK: opening a named pipe without it waits for a writer */
    int descriptor = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
    if (descriptor < 0)
        return false;
    ssize_t count = pread(descriptor, head, sizeof head, 0);
    close(descriptor);
    return count == (ssize_t)sizeof head && memcmp(head, magic, sizeof head) == 0;
}

tl_source *tl_open_with(const char *path, const tl_dem_options *options, tl_error *error)
{
    if (is_exr(path))
        return out_exr_open(path, error);
    return out_heightmap_is_name(path) ? out_heightmap_open(path, error) : tl_dem_open(&path, 1, options, error);
}

tl_source *tl_open(const char *path, tl_error *error)
{
    return tl_open_with(path, NULL, error);
}
