#include "lib/base/error.h"
#include "lib/scene/render.h"
tl_status scene_perspective(const tl_source *source, const tl_preview_options *options, scene_picture *picture,
                            tl_error *error)
{
    (void)options; (void)picture;
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: being written", source->info.name);
}
