/* The errors of all triangles of a block of the lattice, exactly: built once an instruction set. */
#ifndef TL_DEM_FRAMEWORK_KERNEL_H
#define TL_DEM_FRAMEWORK_KERNEL_H

#include "dem/framework.h"

/* A block and what is found of it. Vertices are counted from its corner; see tl_patch for the words. An error is the
 * largest of a vertex's own triangles and of all below, rounded up to a float: infinite where the vertex must split
 * (its triangles are mixed, or reach over the rim), -infinite where there is nothing but voids. */
typedef struct tl_error_block {
    const float *heights; /* of vertex (0, 0), with a frame of one sample; TL_ERROR_PAD more may be read behind them */
    int64_t stride;
    int64_t width, height, rim_x, rim_y, x, y;
    bool voids;
    double rounding;      /* of a plane's height against a sample; 0 where all is exact */
    const double *add;    /* [TL_SIZES] what to add to a triangle's error by its size */
    float *errors;        /* [(TL_BLOCK + 1)^2] by vertex, those of the block's corners excepted */
    float *centres;       /* [(TL_BLOCK / 2 + 3)^2] scratch, and */
    float *across, *down; /* [(TL_BLOCK / 4 + 1)^2] */
    double *rows;         /* [3 * (TL_BLOCK / 2 + 4)] */
    float *parts;         /* [8 * (TL_BLOCK / 2 + 4)] */
} tl_error_block;

enum { TL_ERROR_PAD = 8, TL_ERROR_STRIDE = TL_BLOCK + 1 };

/* The triangle of a square of the lattice that lies below ('\': left of) its diagonal, or above (right of) it. */
typedef enum tl_half { TL_HALF_FIRST, TL_HALF_SECOND } tl_half;

typedef struct tl_error_kernel {
    const char *name;
    /* Fills in `errors` for a block of side `side`, a power of two >= 2. */
    void (*block)(const tl_error_block *block, int64_t side);
    /* The largest distance of the samples of half a square of `side` from the plane through the values at the square's
     * corners (NW, NE, SW, SE), of which those of the half count. `z` is the NW sample. */
    double (*half)(const float *z, int64_t stride, int64_t side, bool rising, tl_half half, const double corners[4]);
    /* Codes of errors: the steps of floats with four bits of mantissa, from base + 1, rounded up. */
    void (*encode)(const float *errors, int64_t count, int32_t base, unsigned char *codes);
} tl_error_kernel;

/* Kernels that run here, the fastest first, ended by NULL. */
const tl_error_kernel *const *tl_error_kernels(void);

#endif
