/* The inside of the strict framework: its data, and the decision over one patch of the lattice.
 *
 * The lattice is virtual: (2^k + 1)^2 vertices from sample (0, 0), k as small as covers the raster. At stage s (a power
 * of two) it has two kinds of vertices that may split triangles:
 *
 * - centres, (odd s, odd s): the middle of a square of side 2 s, which its diagonal cuts into two triangles. The
 *   diagonal runs through the middle of the parent's square: '\' where the square's column plus row is even, else '/'.
 * - edge points, (odd s, even s) and (even s, odd s): the middle of a side of such a square, the hypotenuse of a
 *   triangle on either side whose right angle is at the centre of the square there.
 *
 * A triangle is made by splitting a larger one at the vertex of its right angle, so that vertex is its "parent".
 * Triangles outside of the raster do not exist; those that reach over its right or bottom rim are always split. */
#ifndef TL_DEM_FRAMEWORK_H
#define TL_DEM_FRAMEWORK_H

#include "lib/talus.h"

enum { TL_BLOCK_LOG = 8, TL_BLOCK = 1 << TL_BLOCK_LOG };

/* A triangle that ties in a sample which no cell draws: see framework_ties.c. */
typedef struct tl_tie {
    int32_t x[3], y[3];
} tl_tie;

struct tl_framework {
    tl_source_info info; /* of the DEM; what it points to is the framework's own */
    double max_error;
    bool bends; /* the bound holds in a frame where the lattice is bent */
    unsigned threads;
    int lattice_log; /* k */
    int64_t block; /* side of the squares that are decided alone: TL_BLOCK, or the whole lattice where it is smaller */
    bool voids;    /* the raster may have void samples, or has no cells at all */
    int64_t columns, rows;    /* of blocks */
    size_t words;             /* of 64 samples in a row of the two bitmaps */
    uint64_t *split, *points; /* vertices that split triangles; corners of triangles that are drawn */
    uint32_t *rank;           /* [row][block column]: number of points before */
    float *heights;           /* of the points, row by row */
    size_t point_count, isolated_count;
    tl_tie *ties;
    size_t tie_count;
};

static inline bool tl_bit(const uint64_t *bits, size_t words, int64_t x, int64_t y)
{
    return bits[(size_t)y * words + (size_t)(x >> 6)] >> (x & 63) & 1;
}

static inline void tl_bit_set(uint64_t *bits, size_t words, int64_t x, int64_t y)
{
    bits[(size_t)y * words + (size_t)(x >> 6)] |= UINT64_C(1) << (x & 63);
}

/* Sizes of triangles, from 1: those that edge points of stage 1 split (hypotenuse 2), centres of stage 1 (hypotenuse
 * 2 sqrt 2), edge points of stage 2, and so on: the square of the hypotenuse is 2^(size + 1). Size 0 is half a cell. */
enum { TL_SIZES = 2 * 32 + 1 };
static inline int tl_size_of(int64_t s, bool centre)
{
    return 2 * __builtin_ctzll((unsigned long long)s) + 1 + centre;
}

/* The largest rise over one cell, in units of height, of any triangle of each size (but those with voids). */
tl_status tl_framework_rises(const float *heights, int64_t width, int64_t height, int lattice_log, const tl_run *run,
                             double rises[TL_SIZES], tl_error *error);

/* Fills in `points`, their number, rank and heights, and the number of isolated samples, from `split` and the DEM's
 * heights (width * height, NaN for voids). */
tl_status tl_framework_find_points(tl_framework *framework, const float *dem, const tl_run *run, tl_error *error);

/* Finds the ties of the valid samples that are not `joined`: bitmaps like those of the framework. Marks the samples of
 * the ties as joined and as points. */
tl_status tl_framework_tie(tl_framework *framework, const uint64_t *valid, uint64_t *joined, tl_error *error);

/* A rectangle of the lattice whose triangles are decided together, coarser and coarser. */
typedef struct tl_patch {
    const float *heights; /* of vertex (0, 0); `stride` from row to row */
    int64_t stride;
    int64_t width, height; /* edges to decide: vertices 0 ... width, 0 ... height */
    int64_t rim_x, rim_y;  /* last column and row of the raster, counted from vertex (0, 0) */
    int64_t x, y;          /* vertex (0, 0) on the lattice */
    unsigned char *split;  /* one byte for every vertex at multiples of 2^split_log: set where needed */
    int64_t split_stride;
    int split_log;
    /* What the error of a triangle may reach, by its size: see tl_size_of. In flat frames max_error for all, in bent
     * ones less what a triangle of that size is away from the lattice; below 0 it must be split. */
    double limit[TL_SIZES];
    double rounding; /* of the whole patch: what the nested sum must stay below its limit by */
    bool careful;    /* double arithmetic rounds on these heights: add its bound to every error */
    /* Bounds of the error of the triangles that a vertex splits: infinite where it is needed, -infinite where all is
     * void or outside. Of centres (with a neutral frame), of horizontal and of vertical edge points. */
    float *centres, *across, *down;
} tl_patch;

/* Number of squares of side 2 s along `length` edges. */
static inline int64_t tl_patch_squares(int64_t length, int64_t s)
{
    return (length + 2 * s - 1) / (2 * s);
}

/* Items in a row of `centres` for `squares` squares: an even number and a frame. */
static inline int64_t tl_patch_centre_stride(int64_t squares)
{
    return (squares + 1) / 2 * 2 + 2;
}

/* Decides all of stage 1 of a patch of samples: its edge points, then its centres. `voids` tells whether NaN may occur.
 * The heights need a frame of one sample, mirrored at the patch's borders. `scratch` is memory of
 * tl_patch_scratch(width) bytes, aligned for doubles. */
void tl_patch_decide_samples(const tl_patch *patch, bool voids, void *scratch);
static inline size_t tl_patch_scratch(int64_t width)
{
    return ((size_t)tl_patch_squares(width, 1) + 4) * (3 * sizeof(double) + 8 * sizeof(float)) + sizeof(double);
}
/* Decides row `row` of the edge points of stage s > 1 (0 ... squares of the height), after the centres of s / 2. */
void tl_patch_decide_edges(const tl_patch *patch, int64_t s, int64_t row);
/* Makes the frame of `centres` for stage s, after the edge points of that stage. */
void tl_patch_frame_centres(const tl_patch *patch, int64_t s);
/* Decides row `row` of the centres of stage s > 1, after the frame. */
void tl_patch_decide_centres(const tl_patch *patch, int64_t s, int64_t row);

/* Bound of the rounding error of evaluating a plane through heights of magnitude m at a sample: interpolation by
 * weights or by slopes takes at most ten roundings of terms of at most 4 m. */
static inline double tl_plane_rounding(double magnitude)
{
    return magnitude * (40 * 0x1p-53);
}

#endif
