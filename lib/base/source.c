#include "lib/base/error.h"
#include "lib/base/size.h"

#include <assert.h>
#include <math.h>
#include <string.h>

tl_status tl_source_size(const tl_source *source, int level, int64_t *width, int64_t *height, tl_error *error)
{
    if (level == source->info.level) {
        *width = source->info.width;
        *height = source->info.height;
        return TL_OK;
    }
    if (!source->size || level > source->info.level)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no level %d", source->info.name, level);
    return source->size(source, level, width, height, error);
}

/* The level must be held, and the window lie inside of it. */
static tl_status check_window(const tl_source *source, int level, tl_window window, tl_error *error)
{
    int64_t width, height;
    tl_status status = tl_source_size(source, level, &width, &height, error);
    if (status != TL_OK)
        return status;
    (void)window; /* in builds without assertions */
    assert(window.x >= 0 && window.y >= 0 && window.width >= 0 && window.height >= 0);
    assert(window.width <= width - window.x && window.height <= height - window.y);
    return TL_OK;
}

tl_status tl_source_read(const tl_source *source, int level, tl_window window, float *out, tl_error *error)
{
    tl_status status = check_window(source, level, window, error);
    return status == TL_OK ? source->read(source, level, window, out, error) : status;
}

static tl_status validity_of_heights(const tl_source *source, int level, tl_window window, unsigned char *out,
                                     tl_error *error)
{
    float *heights = tl_alloc_grid(window.width, window.height, sizeof *heights);
    if (!heights)
        return tl_fail_memory(error, source->info.name);
    tl_status status = source->read(source, level, window, heights, error);
    for (int64_t k = 0; status == TL_OK && k < window.width * window.height; k++)
        out[k] = isnan(heights[k]) ? TL_VOID : TL_MEASURED;
    free(heights);
    return status;
}

tl_status tl_source_validity(const tl_source *source, int level, tl_window window, unsigned char *out, tl_error *error)
{
    tl_status status = check_window(source, level, window, error);
    if (status != TL_OK)
        return status;
    return source->validity ? source->validity(source, level, window, out, error)
                            : validity_of_heights(source, level, window, out, error);
}

void tl_source_destroy(tl_source *source)
{
    if (source && source->destroy)
        source->destroy(source);
}

typedef struct array_source {
    tl_source source;
    const float *heights;
} array_source;

static tl_status array_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    (void)level;
    (void)error;
    const float *heights = ((const array_source *)self)->heights;
    for (int64_t row = 0; row < window.height; row++)
        memcpy(out + row * window.width, heights + (window.y + row) * self->info.width + window.x,
               (size_t)window.width * sizeof *out);
    return TL_OK;
}

static void array_destroy(tl_source *self)
{
    free(self);
}

tl_source *tl_array_source_create(const float *heights, const tl_source_info *info, tl_error *error)
{
    assert(info->width > 0 && info->height > 0 && info->level == 0 && info->name);
    array_source *self = malloc(sizeof *self);
    if (!self) {
        tl_fail_memory(error, info->name);
        return NULL;
    }
    *self = (array_source){.source = {.info = *info, .read = array_read, .destroy = array_destroy}, .heights = heights};
    return &self->source;
}
