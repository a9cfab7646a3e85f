/* PNG files through libpng, row by row. */
#ifndef OUT_PNG_ENCODER_H
#define OUT_PNG_ENCODER_H

#include "lib/base/output.h"
#include "lib/scene/render.h"
#include "lib/talus.h"

typedef enum out_png_kind { OUT_PNG_GREY16 = 0, OUT_PNG_RGBA8 } out_png_kind;

/* An encoder on the caller's memory; zero it first, and finish it also when a call failed. */
typedef struct out_png {
    struct png_struct_def *png;
    struct png_info_def *info;
    tl_output *output;
    size_t row_bytes;
    tl_error error; /* the first failure, described */
} out_png;

/* Writes the header; `output` stays the caller's. Sizes: at most 2^31 - 1. */
tl_status out_png_begin(out_png *self, tl_output *output, out_png_kind kind, int64_t width, int64_t height);
/* Writes `count` rows without gaps; 16-bit values in PNG's order, the high byte first. */
tl_status out_png_rows(out_png *self, const unsigned char *rows, int64_t count);
tl_status out_png_end(out_png *self);
void out_png_finish(out_png *self);

/* A whole picture. */
tl_status out_picture_write(const scene_picture *picture, tl_output *output, const tl_run *run, tl_error *error);

#endif
