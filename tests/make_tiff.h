/* TIFF files of every kind, for tests of the reader. */
#ifndef TESTS_MAKE_TIFF_H
#define TESTS_MAKE_TIFF_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef struct make_tiff_options {
    uint32_t width, height;
    unsigned bands;                     /* 0: 1 */
    uint16_t bits;                      /* 0: 32 */
    uint16_t format;                    /* SAMPLEFORMAT_...; 0: float where bits is 0, else unsigned */
    uint16_t codec;                     /* COMPRESSION_...; 0: none */
    uint16_t predictor, photometric;    /* 0: not written */
    uint32_t block_width, block_height; /* block_width 0: strips of block_height rows; both 0: one strip */
    bool big_endian, big_tiff, separate;
    bool directory_first;          /* the directory before the data, as in files made for reading from the start */
    uint32_t leave_out;            /* every leave_out-th block, counted from 0, is not written; 0: all are */
    unsigned overviews;            /* empty reduced copies behind the image */
    const char *nodata, *metadata; /* GDAL_NODATA and GDAL_METADATA; NULL: not written */
    const double *scale, *ties, *matrix; /* 3, 6 * tie_count and 16 numbers; NULL: not written */
    unsigned tie_count;                  /* 0: 1 where ties are given */
    const uint16_t *keys;                /* key_count entries of 4 numbers, without the header; NULL: not written */
    unsigned key_count, key_double_count;
    const double *key_doubles;
    const char *key_ascii;
    /* The number to store, which must fit the type. Half-precision samples are given as their bits. NULL:
     * make_tiff_value. */
    double (*value)(unsigned band, uint32_t x, uint32_t y, uint16_t bits, uint16_t format);
} make_tiff_options;

/* Writes the file; false where libtiff refuses the combination. */
bool make_tiff(const char *path, const make_tiff_options *options);

/* A number that looks random, exactly representable in the type and as a float. */
double make_tiff_value(unsigned band, uint32_t x, uint32_t y, uint16_t bits, uint16_t format);

#endif
