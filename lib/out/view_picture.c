/* Pictures of meshes from a point of view, as PNG, and their depths as EXR. */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/out/png_encoder.h"
#include "lib/scene/mesh_picture.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { MOST_VIEWS = 1024 };

static tl_status write_depth(const scene_painter *painter, const tl_mesh *mesh, const scene_view *view,
                             const tl_view_picture_options *o, tl_error *error)
{
    const scene_camera *c = scene_view_camera(view);
    float *depth = NULL;
    tl_status status = scene_paint_depth(painter, mesh, view, &depth, error);
    if (status != TL_OK)
        return status;
    const tl_source_info info = {.width = (int64_t)c->width,
                                 .height = (int64_t)c->height,
                                 .georef = tl_georef_none(),
                                 .has_voids = true,
                                 .contents = "depth",
                                 .name = o->depth};
    tl_source *source = tl_array_source_create(depth, &info, error);
    status = source
                 ? tl_write_grid(source, o->depth, &(tl_write_options){.overwrite = o->overwrite, .run = o->run}, error)
                 : TL_ERROR_MEMORY;
    tl_source_destroy(source);
    free(depth);
    return status;
}

static tl_status draw(const scene_painter *painter, const tl_mesh *mesh, const scene_view *const *views, size_t count,
                      const tl_view_picture_options *o, tl_output *output, tl_error *error)
{
    scene_picture picture = {0};
    tl_status status = scene_paint(painter, mesh, views, count, &picture, error);
    if (status == TL_OK)
        status = out_picture_write(&picture, output, o->run, error);
    scene_picture_finish(&picture);
    if (status == TL_OK && o->depth)
        status = write_depth(painter, mesh, views[0], o, error);
    return status;
}

/* Opens the views and draws. */
static tl_status draw_views(const tl_mesh *mesh, const tl_source *dem, const tl_view *views, size_t count,
                            const tl_view_picture_options *o, tl_output *output, tl_error *error)
{
    scene_view **opened = calloc(count, sizeof *opened);
    if (!opened)
        return tl_fail_memory(error, "the picture");
    scene_painter *painter = scene_painter_create(dem, o, error);
    bool ready = painter != NULL;
    for (size_t k = 0; k < count && ready; k++)
        ready = (opened[k] = scene_view_create(&views[k], dem, error)) != NULL;
    tl_status status =
        ready ? draw(painter, mesh, (const scene_view *const *)opened, count, o, output, error) : error->status;
    for (size_t k = 0; k < count; k++)
        scene_view_destroy(opened[k]);
    free(opened);
    scene_painter_destroy(painter);
    return status;
}

tl_status tl_view_write_picture(const tl_mesh *mesh, const tl_source *dem, const tl_view *views, size_t count,
                                const char *path, const tl_view_picture_options *options, tl_error *error)
{
    const tl_view_picture_options defaults = {0};
    options = options ? options : &defaults;
    tl_error local = {0};
    error = error ? error : &local;
    if (count < 1 || count > MOST_VIEWS)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %zu views were asked for; 1...%d make a picture", path, count,
                       MOST_VIEWS);
    const tl_format *format = options->depth ? tl_format_of(options->depth) : NULL;
    if (options->depth && !(format && strcmp(format->ending, "exr") == 0))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: depths go into an .exr", options->depth);
    tl_output *output = tl_output_open(path, options->overwrite, error);
    if (!output)
        return error->status;
    tl_status status = draw_views(mesh, dem, views, count, options, output, error);
    if (status == TL_OK)
        return tl_output_commit(output, error);
    tl_output_abort(output);
    return status;
}
