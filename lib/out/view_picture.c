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

struct tl_view_painter {
    scene_painter *painter;
    const tl_source *dem;
    tl_view_picture_options options;
};

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
static tl_status draw_views(const tl_view_painter *p, const tl_mesh *mesh, const tl_view *views, size_t count,
                            tl_output *output, tl_error *error)
{
    scene_view **opened = calloc(count, sizeof *opened);
    if (!opened)
        return tl_fail_memory(error, "the picture");
    bool ready = true;
    for (size_t k = 0; k < count && ready; k++)
        ready = (opened[k] = scene_view_create(&views[k], p->dem, error)) != NULL;
    tl_status status =
        ready ? draw(p->painter, mesh, (const scene_view *const *)opened, count, &p->options, output, error)
              : error->status;
    for (size_t k = 0; k < count; k++)
        scene_view_destroy(opened[k]);
    free(opened);
    return status;
}

static tl_status check_depth(const tl_view_picture_options *o, tl_error *error)
{
    const tl_format *format = o->depth ? tl_format_of(o->depth) : NULL;
    if (o->depth && !(format && strcmp(format->ending, "exr") == 0))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: depths go into an .exr", o->depth);
    return TL_OK;
}

static tl_status check_count(size_t count, const char *path, tl_error *error)
{
    if (count < 1 || count > MOST_VIEWS)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %zu views were asked for; 1...%d make a picture", path, count,
                       MOST_VIEWS);
    return TL_OK;
}

static tl_status end_output(tl_output *output, tl_status status, tl_error *error)
{
    if (status == TL_OK)
        return tl_output_commit(output, error);
    tl_output_abort(output);
    return status;
}

tl_view_painter *tl_view_painter_create(const tl_source *dem, const tl_view_picture_options *options, tl_error *error)
{
    const tl_view_picture_options defaults = {0};
    options = options ? options : &defaults;
    if (check_depth(options, error) != TL_OK)
        return NULL;
    tl_view_painter *p = calloc(1, sizeof *p);
    if (!p) {
        tl_fail_memory(error, "the picture");
        return NULL;
    }
    *p = (tl_view_painter){scene_painter_create(dem, options, error), dem, *options};
    if (p->painter)
        return p;
    free(p);
    return NULL;
}

tl_status tl_view_painter_write(const tl_view_painter *painter, const tl_mesh *mesh, const tl_view *views, size_t count,
                                const char *path, tl_error *error)
{
    tl_error local = {0};
    error = error ? error : &local;
    if (check_count(count, path, error) != TL_OK)
        return error->status;
    tl_output *output = tl_output_open(path, painter->options.overwrite, error);
    if (!output)
        return error->status;
    return end_output(output, draw_views(painter, mesh, views, count, output, error), error);
}

void tl_view_painter_destroy(tl_view_painter *painter)
{
    if (painter)
        scene_painter_destroy(painter->painter);
    free(painter);
}

tl_status tl_view_write_picture(const tl_mesh *mesh, const tl_source *dem, const tl_view *views, size_t count,
                                const char *path, const tl_view_picture_options *options, tl_error *error)
{
    tl_error local = {0};
    error = error ? error : &local;
    if (check_count(count, path, error) != TL_OK || (options && check_depth(options, error) != TL_OK))
        return error->status;
    tl_output *output = tl_output_open(path, options && options->overwrite, error); /* before colours are read */
    if (!output)
        return error->status;
    tl_view_painter *painter = tl_view_painter_create(dem, options, error);
    tl_status status = painter ? draw_views(painter, mesh, views, count, output, error) : error->status;
    tl_view_painter_destroy(painter);
    return end_output(output, status, error);
}
