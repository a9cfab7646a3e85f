/* PNG in a build without libpng. */
#include "lib/base/error.h"
#include "lib/out/png_decoder.h"
#include "lib/out/png_encoder.h"

static tl_status lacks(const char *path, tl_error *error)
{
    return tl_fail(error, TL_ERROR_ARGUMENT,
                   "%s: PNG needs libpng, which this build of talus is without; use one that has it", path);
}

tl_status out_png_begin(out_png *self, tl_output *output, out_png_kind kind, int64_t width, int64_t height)
{
    (void)kind;
    (void)width;
    (void)height;
    return lacks(tl_output_path(output), &self->error);
}

tl_status out_png_rows(out_png *self, const unsigned char *rows, int64_t count)
{
    (void)rows;
    (void)count;
    return self->error.status;
}

tl_status out_png_end(out_png *self)
{
    return self->error.status;
}

void out_png_finish(out_png *self)
{
    (void)self;
}

tl_status out_png_read_grey16(const out_png_input *input, int64_t width, int64_t height, unsigned char **samples,
                              tl_error *error)
{
    (void)width;
    (void)height;
    (void)samples;
    return lacks(input->path, error);
}
