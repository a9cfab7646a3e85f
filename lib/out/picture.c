/* Pictures as PNG files. */
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/png_encoder.h"
#include "lib/scene/north_up.h"
#include "lib/scene/render.h"

#include <math.h>

static tl_status check_view(const char *path, const tl_preview_options *o, tl_error *error)
{
    if (!(o->fov == 0 || (o->fov >= 1 && o->fov <= 170)))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: a field of view of %g degrees was asked for; 1...170 is possible",
                       path, o->fov);
    if (!o->view_given)
        return TL_OK;
    bool same = true;
    for (int k = 0; k < 3; k++) {
        if (!isfinite(o->eye[k]) || !isfinite(o->target[k]))
            return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the eye and the target must be finite", path);
        same = same && o->eye[k] == o->target[k];
    }
    return same ? tl_fail(error, TL_ERROR_ARGUMENT, "%s: the eye and the target are the same point; move one", path)
                : TL_OK;
}

static tl_status check(const tl_source *beside, const char *path, const tl_preview_options *o, tl_error *error)
{
    const int most = SCENE_PICTURE_MAX;
    if (o->width < 0 || o->width > most || o->height < 0 || o->height > most)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: a picture of %d x %d pixels was asked for; 1...%d is possible",
                       path, o->width, o->height, most);
    if (!isfinite(o->sun_azimuth) || !(o->sun_elevation >= 0 && o->sun_elevation <= 90))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the sun's elevation must be within 0...90 degrees", path);
    if (!(o->exaggeration >= 0 && o->exaggeration <= 1e6))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the exaggeration must be within 0...1000000", path);
    if (o->colour && (o->grey || !o->perspective))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: a raster of colours goes with a perspective that is not grey",
                       path);
    if (!o->perspective)
        return TL_OK;
    if (beside)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: two rasters side by side are drawn from above only", path);
    return check_view(path, o, error);
}

tl_status out_picture_write(const scene_picture *picture, tl_output *output, const tl_run *run, tl_error *error)
{
    enum { BAND = 64 };
    out_png encoder = {0};
    unsigned char *made = picture->rgba ? NULL : tl_alloc_grid(picture->width, BAND, 4);
    if (!picture->rgba && !made)
        return tl_fail_memory(error, tl_output_path(output));
    tl_status status = out_png_begin(&encoder, output, OUT_PNG_RGBA8, picture->width, picture->height);
    for (int64_t y = 0; y < picture->height && status == TL_OK; y += BAND) {
        int64_t rows = picture->height - y < BAND ? picture->height - y : BAND;
        status = tl_run_check(run, &encoder.error);
        if (status == TL_OK && made)
            status = picture->rows(picture->context, y, rows, made, &encoder.error);
        if (status == TL_OK)
            status = out_png_rows(&encoder, made ? made : picture->rgba + y * picture->width * 4, rows);
    }
    if (status == TL_OK)
        status = out_png_end(&encoder);
    out_png_finish(&encoder);
    free(made);
    if (status != TL_OK && error)
        *error = encoder.error;
    return status;
}

static tl_status draw(const tl_source *source, const tl_source *beside, const tl_preview_options *options,
                      tl_output *output, tl_error *error)
{
    scene_picture picture = {0};
    tl_status status = options->perspective ? scene_perspective(source, options, &picture, error)
                                            : scene_hillshade(source, beside, options, &picture, error);
    if (status == TL_OK)
        status = out_picture_write(&picture, output, options->run, error);
    scene_picture_finish(&picture);
    return status;
}

tl_status tl_write_preview(const tl_source *source, const tl_source *beside, const char *path,
                           const tl_preview_options *options, tl_error *error)
{
    const tl_preview_options defaults = {0};
    options = options ? options : &defaults;
    tl_error local = {0};
    error = error ? error : &local;
    tl_status status = check(beside, path, options, error);
    if (status != TL_OK)
        return status;
    tl_output *output = tl_output_open(path, options->overwrite, error); /* first: a refusal should not take minutes */
    if (!output)
        return error->status;
    tl_source *upright = scene_north_up(source, error);
    tl_source *second = upright && beside ? scene_north_up(beside, error) : NULL;
    status = upright && (second || !beside) ? draw(upright, second, options, output, error) : error->status;
    tl_source_destroy(second);
    tl_source_destroy(upright);
    if (status == TL_OK)
        return tl_output_commit(output, error);
    tl_output_abort(output);
    return status;
}
