/* Grey PNGs of 16 bits through libpng. */
#ifndef OUT_PNG_DECODER_H
#define OUT_PNG_DECODER_H

#include "lib/talus.h"

typedef struct out_png_input {
    /* Reads `count` bytes from place `at` of the file. */
    tl_status (*read)(void *context, void *to, size_t count, uint64_t at, tl_error *error);
    void *context;
    const char *path; /* for messages */
} out_png_input;

/* All samples of an image of this size, 16 bits each in this machine's order, row by row; the caller frees them. */
tl_status out_png_read_grey16(const out_png_input *input, int64_t width, int64_t height, unsigned char **samples,
                              tl_error *error);

#endif
