/* A source with more in its record. */
#include "lib/base/error.h"
#include "lib/base/georef.h"

#include <stdlib.h>

typedef struct recorded {
    tl_source source;
    const tl_source *original;
    tl_parameter *parameters;
} recorded;

static tl_status recorded_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    return tl_source_read(((const recorded *)self)->original, level, window, out, error);
}

static tl_status recorded_size(const tl_source *self, int level, int64_t *width, int64_t *height, tl_error *error)
{
    return tl_source_size(((const recorded *)self)->original, level, width, height, error);
}

static tl_status recorded_validity(const tl_source *self, int level, tl_window window, unsigned char *out,
                                   tl_error *error)
{
    return tl_source_validity(((const recorded *)self)->original, level, window, out, error);
}

static void recorded_destroy(tl_source *self)
{
    recorded *r = (recorded *)self;
    tl_crs_release(self->info.georef.crs);
    free(r->parameters);
    free(r);
}

tl_source *tl_recorded_create(const tl_source *source, const tl_parameter *more, size_t count, tl_error *error)
{
    recorded *r = calloc(1, sizeof *r);
    if (!r) {
        tl_fail_memory(error, source->info.name);
        return NULL;
    }
    r->source = (tl_source){.info = source->info,
                            .read = recorded_read,
                            .size = recorded_size,
                            .validity = source->validity ? recorded_validity : NULL,
                            .destroy = recorded_destroy};
    r->original = source;
    tl_source_info *info = &r->source.info;
    tl_crs_retain(info->georef.crs);
    r->parameters = tl_parameters_copy(info->parameters, info->parameter_count);
    tl_status status =
        info->parameter_count && !r->parameters ? tl_fail_memory(error, "the record of parameters") : TL_OK;
    for (size_t k = 0; k < count && status == TL_OK; k++)
        status = tl_parameters_add(&r->parameters, &info->parameter_count, more[k].name, more[k].value, error);
    info->parameters = r->parameters;
    if (status == TL_OK)
        return &r->source;
    recorded_destroy(&r->source);
    return NULL;
}
