#include "lib/base/error.h"
tl_status tl_write_preview(const tl_source *source, const tl_source *beside, const char *path, const tl_preview_options *options,
                           tl_error *error)
{
    (void)source; (void)beside; (void)options;
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: being written", path);
}
