#include "lib/out/png_decoder.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <png.h>

#include <setjmp.h>

typedef struct decoding {
    const out_png_input *input;
    uint64_t at;
    tl_error failure;
} decoding;

static void on_error(png_structp png, png_const_charp text)
{
    decoding *self = png_get_error_ptr(png);
    if (self->failure.status == TL_OK)
        tl_fail(&self->failure, TL_ERROR_DATA, "%s: the PNG cannot be read: %s", self->input->path, text);
    png_longjmp(png, 1);
}

static void on_warning(png_structp png, png_const_charp text)
{
    (void)png;
    (void)text;
}

static void on_read(png_structp png, png_bytep to, size_t count)
{
    decoding *self = png_get_io_ptr(png);
    if (self->input->read(self->input->context, to, count, self->at, &self->failure) != TL_OK)
        png_error(png, "cannot read");
    self->at += count;
}

static void decode(decoding *self, png_structp png, png_infop info, int64_t width, int64_t height,
                   unsigned char **samples)
{
    if (setjmp(png_jmpbuf(png)))
        return;
    png_set_user_limits(png, PNG_UINT_31_MAX, PNG_UINT_31_MAX);
    png_set_read_fn(png, self, on_read);
    png_read_info(png, info);
    if (png_get_bit_depth(png, info) != 16 || png_get_color_type(png, info) != PNG_COLOR_TYPE_GRAY ||
        png_get_interlace_type(png, info) != PNG_INTERLACE_NONE)
        png_error(png, "not one of 16-bit grey");
    if (png_get_image_width(png, info) != (png_uint_32)width || png_get_image_height(png, info) != (png_uint_32)height)
        png_error(png, "its size is not that in the JSON file");
    *samples = tl_alloc_grid(width, height, 2);
    if (!*samples) {
        tl_fail_memory(&self->failure, self->input->path);
        return;
    }
    png_set_swap(png);
    for (int64_t y = 0; y < height; y++)
        png_read_row(png, *samples + (size_t)(y * width) * 2, NULL);
}

tl_status out_png_read_grey16(const out_png_input *input, int64_t width, int64_t height, unsigned char **samples,
                              tl_error *error)
{
    decoding self = {.input = input};
    png_structp png = png_create_read_struct(PNG_LIBPNG_VER_STRING, &self, on_error, on_warning);
    png_infop info = png ? png_create_info_struct(png) : NULL;
    if (info)
        decode(&self, png, info, width, height, samples);
    else
        tl_fail_memory(&self.failure, input->path);
    if (png)
        png_destroy_read_struct(&png, &info, NULL);
    if (self.failure.status != TL_OK && error)
        *error = self.failure;
    return self.failure.status;
}
