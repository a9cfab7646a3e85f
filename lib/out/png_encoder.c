#include "lib/out/png_encoder.h"

#include "lib/base/error.h"

#include <png.h>

#include <setjmp.h>

/* libpng's errors jump: every function that calls into it sets the jump's target anew. */

static void on_error(png_structp png, png_const_charp text)
{
    out_png *self = png_get_error_ptr(png);
    if (self->error.status == TL_OK)
        tl_fail(&self->error, TL_ERROR_IO, "%s: libpng cannot write it: %s", tl_output_path(self->output), text);
    png_longjmp(png, 1);
}

static void on_warning(png_structp png, png_const_charp text)
{
    (void)png;
    (void)text;
}

static void on_write(png_structp png, png_bytep bytes, size_t count)
{
    out_png *self = png_get_io_ptr(png);
    if (tl_output_append(self->output, bytes, count, &self->error) != TL_OK)
        png_error(png, "cannot write");
}

static void on_flush(png_structp png)
{
    (void)png;
}

tl_status out_png_begin(out_png *self, tl_output *output, out_png_kind kind, int64_t width, int64_t height)
{
    bool grey = kind == OUT_PNG_GREY16;
    self->output = output;
    self->row_bytes = (size_t)width * (grey ? 2 : 4);
    self->png = png_create_write_struct(PNG_LIBPNG_VER_STRING, self, on_error, on_warning);
    self->info = self->png ? png_create_info_struct(self->png) : NULL;
    if (!self->info)
        return tl_fail_memory(&self->error, tl_output_path(output));
    if (setjmp(png_jmpbuf(self->png)))
        return self->error.status;
    png_set_user_limits(self->png, PNG_UINT_31_MAX, PNG_UINT_31_MAX);
    png_set_write_fn(self->png, self, on_write, on_flush);
    png_set_IHDR(self->png, self->info, (png_uint_32)width, (png_uint_32)height, grey ? 16 : 8,
                 grey ? PNG_COLOR_TYPE_GRAY : PNG_COLOR_TYPE_RGB_ALPHA, PNG_INTERLACE_NONE,
                 PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
    if (grey) { /* the low bytes of heights are noise: trying harder takes three times as long for 3 % */
        png_set_filter(self->png, 0, PNG_FILTER_PAETH);
        png_set_compression_level(self->png, 1);
    }
    png_write_info(self->png, self->info);
    return TL_OK;
}

tl_status out_png_rows(out_png *self, const unsigned char *rows, int64_t count)
{
    if (setjmp(png_jmpbuf(self->png)))
        return self->error.status;
    for (int64_t row = 0; row < count; row++)
        png_write_row(self->png, rows + (size_t)row * self->row_bytes);
    return TL_OK;
}

tl_status out_png_end(out_png *self)
{
    if (setjmp(png_jmpbuf(self->png)))
        return self->error.status;
    png_write_end(self->png, self->info);
    return TL_OK;
}

void out_png_finish(out_png *self)
{
    png_destroy_write_struct(&self->png, &self->info);
}
