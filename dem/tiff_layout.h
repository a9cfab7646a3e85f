/* How the samples of a TIFF's first image lie in the file, and what its numbers mean as heights. */
#ifndef DEM_TIFF_LAYOUT_H
#define DEM_TIFF_LAYOUT_H

#include "dem/tiff_file.h"

typedef enum dem_sample_kind { DEM_SAMPLE_UINT, DEM_SAMPLE_INT, DEM_SAMPLE_FLOAT } dem_sample_kind;

/* From a stored number v to a height: void where void_low <= v <= void_high, else offset + scale v. */
typedef struct dem_value_rule {
    double scale, offset;
    bool plain; /* scale 1 and offset 0: the number is the height, to the bit */
    double void_low, void_high;
} dem_value_rule;

typedef struct dem_layout {
    int64_t width, height;
    int64_t block_width, block_height; /* of a tile or a strip; the last ones may be cut by the raster's edge */
    int64_t across, down;              /* blocks */
    bool tiled, separate;              /* separate: a block holds one band */
    unsigned bands, band;              /* band counted from 0 */
    int bits;
    dem_sample_kind kind;
    char sample_type[16]; /* "int16" */
    uint16_t codec;
    int predictor;
    bool big_tiff, big_endian;
    int64_t row_bytes;  /* of a decoded row of a block */
    int64_t chunk_rows; /* rows of a block that are decoded and kept together: all, or a part of a large strip */
    bool has_nodata;
    double nodata;
    dem_value_rule rule;
    bool has_voids;
    double quantum;
} dem_layout;

/* Reads the directory at which `handle` stands. `band` counts from 1; 0 is the first, which is then refused where the
 * image is a colour picture. */
tl_status dem_layout_read(dem_tiff_handle *handle, unsigned band, dem_layout *out, tl_error *error);

/* A reduced copy of the image, each of its samples standing for exactly 2^halvings of the image's either way. */
typedef struct dem_overview {
    int halvings;
    uint64_t directory; /* its offset */
    dem_layout layout;
} dem_overview;

enum { DEM_MAX_OVERVIEWS = 32 };

/* Looks through the directories behind the handle's for reduced copies of the image `main`. Gives how many there are;
 * those that can stand for a level go to out[DEM_MAX_OVERVIEWS], and their number to *usable. The handle moves on:
 * close it, do not read blocks with it. */
unsigned dem_overviews_read(dem_tiff_handle *handle, const dem_layout *main, dem_overview *out, unsigned *usable);

/* Short name of a TIFF compression scheme, as "deflate"; "unknown" for others. */
const char *dem_codec_name(uint16_t codec);
/* The largest number of bytes that one compressed byte of this scheme can stand for; 0: no such limit. */
int64_t dem_codec_expansion(uint16_t codec);

#endif
