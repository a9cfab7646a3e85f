/* The inside of the error pyramid. */
#ifndef TL_DEM_FRAMEWORK_PYRAMID_H
#define TL_DEM_FRAMEWORK_PYRAMID_H

#include "dem/framework.h"

#include <math.h>

/* What views know of the raster without reading it again: the heights of every eighth sample of every eighth row, and
 * of squares of 16 x 16 cells the range of heights, rims included, and whether there are voids. A tenth of a byte a
 * sample. */
enum { TL_OVERVIEW_LOG = 3, TL_SQUARE_LOG = 4 };
typedef struct tl_square_facts {
    float low, high; /* low > high: all void */
    bool voids;
} tl_square_facts;

struct tl_pyramid {
    tl_framework *shape; /* without marks: the raster's description and the lattice's */
    tl_frame frame;
    bool bends;           /* the frame is bent against the lattice: see bend.h */
    unsigned char *codes; /* by sample; NULL: `errors` are kept */
    float *errors;
    int32_t base;      /* of the codes: see tl_error_kernel */
    uint64_t checksum; /* of the DEM's heights */
    float *ranges;     /* lowest and highest height of each of the shape's blocks, rims included; low > high: void */
    int64_t overview_columns, overview_rows, square_columns, square_rows;
    float *overview;
    tl_square_facts *squares;
};

/* Keys are codes, or the bits of errors: ordered as errors are. */
static inline uint32_t tl_pyramid_key(const tl_pyramid *pyramid, size_t sample)
{
    uint32_t bits;
    if (pyramid->codes)
        return pyramid->codes[sample];
    memcpy(&bits, &pyramid->errors[sample], sizeof bits);
    return bits;
}

/* The key of samples that are always needed. */
static inline uint32_t tl_pyramid_most(const tl_pyramid *pyramid)
{
    return pyramid->codes ? 255 : UINT32_C(0x7f800000);
}

/* The error behind a key. */
static inline double tl_pyramid_value(const tl_pyramid *pyramid, uint32_t key)
{
    uint32_t bits = pyramid->codes && key && key < 255 ? (key + (uint32_t)pyramid->base) << 19 : key;
    float value;
    if (pyramid->codes && key == 255)
        return HUGE_VAL;
    memcpy(&value, &bits, sizeof value);
    return (double)value;
}

/* A pyramid with room for its errors, all 0. */
tl_pyramid *tl_pyramid_allocate(const tl_source_info *info, const tl_pyramid_options *options, tl_error *error);

/* Finds the checksum of the DEM, with all that the errors depend on, and whether it has voids. */
tl_status tl_pyramid_look(tl_pyramid *pyramid, const tl_source *dem, const tl_pyramid_options *options,
                          tl_error *error);

#endif
