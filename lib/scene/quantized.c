/* Heights rounded to multiples of a step, so that they compress. */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/size.h"
#include "lib/talus.h"

#include <math.h>

typedef struct quantized {
    tl_source source;
    const tl_source *original;
    double quantum;
    tl_parameter *parameters;
} quantized;

static tl_status quantized_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const quantized *q = (const quantized *)self;
    tl_status status = tl_source_read(q->original, level, window, out, error);
    for (int64_t k = 0; status == TL_OK && k < window.width * window.height; k++) {
        /* ties to even, so that nothing drifts up */
        double steps = rint((double)out[k] / q->quantum);
        out[k] = (float)(steps * q->quantum);
    }
    return status;
}

static tl_status quantized_size(const tl_source *self, int level, int64_t *width, int64_t *height, tl_error *error)
{
    return tl_source_size(((const quantized *)self)->original, level, width, height, error);
}

static tl_status quantized_validity(const tl_source *self, int level, tl_window window, unsigned char *out,
                                    tl_error *error)
{
    return tl_source_validity(((const quantized *)self)->original, level, window, out, error);
}

static void quantized_destroy(tl_source *self)
{
    quantized *q = (quantized *)self;
    tl_crs_release(self->info.georef.crs);
    free(q->parameters);
    free(q);
}

static tl_status copy_parameters(quantized *q, tl_error *error)
{
    const tl_source_info *from = &q->original->info;
    char text[TL_NUMBER_TEXT];
    tl_status status = TL_OK;
    size_t count = 0;
    for (size_t i = 0; i < from->parameter_count && status == TL_OK; i++)
        status = tl_parameters_add(&q->parameters, &count, from->parameters[i].name, from->parameters[i].value, error);
    tl_number_text(q->quantum, text);
    if (status == TL_OK)
        status = tl_parameters_add(&q->parameters, &count, "height_quantum", text, error);
    q->source.info.parameters = q->parameters;
    q->source.info.parameter_count = count;
    return status;
}

tl_source *tl_quantized_create(const tl_source *source, double quantum, tl_error *error)
{
    if (!(quantum > 0 && quantum <= 1e30)) {
        tl_fail(error, TL_ERROR_ARGUMENT, "the height quantum must be above 0 and at most 1e30, not %g", quantum);
        return NULL;
    }
    quantized *q = calloc(1, sizeof *q);
    if (!q) {
        tl_fail_memory(error, source->info.name);
        return NULL;
    }
    q->source = (tl_source){.info = source->info,
                            .read = quantized_read,
                            .size = quantized_size,
                            .validity = source->validity ? quantized_validity : NULL,
                            .destroy = quantized_destroy};
    q->original = source;
    q->quantum = quantum;
    q->source.info.quantum = quantum;
    q->source.info.parameters = NULL;
    q->source.info.parameter_count = 0;
    tl_crs_retain(q->source.info.georef.crs);
    if (copy_parameters(q, error) == TL_OK)
        return &q->source;
    quantized_destroy(&q->source);
    return NULL;
}
