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

#include <string.h>

/* Blocks that are decided alone: 2^8 samples on a side stay in a core's cache. At least 2^6, the bits of a word. */
#ifndef TL_FRAMEWORK_BLOCK_LOG
#define TL_FRAMEWORK_BLOCK_LOG 8
#endif
enum { TL_BLOCK_LOG = TL_FRAMEWORK_BLOCK_LOG, TL_BLOCK = 1 << TL_BLOCK_LOG };

/* A triangle that ties in a sample which no cell draws: see framework_ties.c. */
typedef struct tl_tie {
    int32_t x[3], y[3];
} tl_tie;

enum { TL_STAGES = 32 };

struct tl_framework {
    tl_source_info info; /* of the DEM; what it points to is the framework's own */
    double max_error;
    bool bends; /* the bound holds in a frame where the lattice is bent */
    unsigned threads;
    size_t memory;   /* bytes that the mesh may take; 0: any */
    int lattice_log; /* k */
    int64_t block; /* side of the squares that are decided alone: TL_BLOCK, or the whole lattice where it is smaller */
    bool voids;    /* the raster may have void samples, or has no cells at all */
    int64_t columns, rows;    /* of blocks */
    size_t words;             /* of 64 samples in a row of the two bitmaps */
    uint64_t valid_count;     /* samples that are not void */
    uint64_t *split, *points; /* vertices that split triangles; corners of triangles that are drawn */
    uint32_t *rank;           /* [row][block column]: number of points before */
    float *heights;           /* of the points, row by row */
    size_t point_count, isolated_count;
    tl_tie *ties;
    size_t tie_count;
    /* Of one that came out of a file: what fills it between its points; else 0. The spreads are by stage, s = 1, 2, 4
     * and so on: factors on the standard deviation that fBm of this exponent and delta 1 leaves there, in S / 4. */
    double hurst, spread[TL_STAGES];
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

/* A framework without marks over a raster like this; refuses bounds and sizes that cannot be. */
tl_framework *tl_framework_create(const tl_source_info *info, double max_error, const tl_run *run, tl_error *error);

/* Rows of a DEM: an array of them all (NaN for voids), or a source to read. */
typedef struct tl_rows {
    const float *all;
    const tl_source *source; /* where `all` is NULL */
} tl_rows;

/* Fills in `points`, their number, rank and heights, ties and the number of isolated samples, from `split` and the
 * DEM's heights. */
tl_status tl_framework_find_points(tl_framework *framework, const tl_rows *dem, const tl_run *run, tl_error *error);

/* Forces every feature. `features` may be NULL. */
tl_status tl_features_force(const tl_features *features, tl_framework *framework, tl_error *error);

/* Marks what a bound that varies needs: `limits` has one for each sample of the pyramid's raster. */
void tl_framework_mark_limits(tl_framework *framework, const tl_pyramid *pyramid, const float *limits);

/* Heights of the points among samples x ... x + count - 1 of row y; NaN for the others. */
void tl_framework_heights(const tl_framework *framework, int64_t x, int64_t y, int64_t count, float *out);

/* Marks what voids need, the NaN among heights: triangles that hold some of them are split. */
void tl_framework_mark_voids(tl_framework *framework, const float *heights);

/* Number of triangles of the mesh. */
tl_status tl_framework_count_triangles(const tl_framework *framework, size_t *count, tl_error *error);

/* A rectangle of heights. */
typedef struct tl_heights {
    const float *z;
    int64_t stride, width, height;
} tl_heights;

/* Makes infinite heights voids: no surface passes them. */
void tl_heights_clean(float *z, size_t count);
/* The largest |height|; *voids becomes whether there are voids. */
float tl_heights_magnitude(const tl_heights *of, bool *voids);
/* Whether interpolation in triangles of legs up to 2^log rounds in double arithmetic, of heights up to `magnitude`. */
bool tl_heights_round(const tl_heights *of, float magnitude, int log);

/* The vertices whose triangles must be split so that (x, y) can split its own: the right angles of these. */
void tl_lattice_parents(int64_t x, int64_t y, int64_t out[2][2]);

/* Makes (x, y) split its triangles, and all vertices that it needs for that. Where a vertex does not split, its
 * triangles keep the bound, so more splits never break it. Before tl_framework_find_points. */
void tl_framework_force(tl_framework *framework, int64_t x, int64_t y);

/* Eight bytes of 0 or 1 to as many bits, the first the lowest: the factor moves byte k by 56 - 7 k bits, so that all
 * meet in the highest byte. */
static inline uint64_t tl_pack8(const unsigned char *bytes)
{
    uint64_t eight;
    memcpy(&eight, bytes, sizeof eight);
#if __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
    eight = __builtin_bswap64(eight);
#endif
    return eight * UINT64_C(0x0102040810204080) >> 56;
}

static inline uint64_t tl_pack_bits(const unsigned char *bytes, int64_t count)
{
    uint64_t bits = 0;
    int64_t i = 0;
    for (; i + 8 <= count; i += 8)
        bits |= tl_pack8(bytes + i) << i;
    for (; i < count; i++)
        bits |= (uint64_t)bytes[i] << i;
    return bits;
}

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

static inline float tl_larger4(float a, float b, float c, float d)
{
    float m = a > b ? a : b, n = c > d ? c : d;
    return m > n ? m : n;
}

/* A float that is not smaller than `error` >= 0 or infinite, without a branch: the bits of such floats are ordered as
 * they are. */
static inline float tl_rounded_up(double error)
{
    float f = (float)error;
    uint32_t bits;
    memcpy(&bits, &f, sizeof bits);
    bits += (double)f < error;
    memcpy(&f, &bits, sizeof f);
    return f;
}

/* Whether the triangle below (or right of) an edge at `at` reaches over the rim; one that begins there is outside. */
static inline bool tl_reaches_over(int64_t at, int64_t s, int64_t rim)
{
    return at < rim && at + s > rim;
}

/* Bound of the rounding error of evaluating a plane through heights of magnitude m at a sample: interpolation by
 * weights or by slopes takes at most ten roundings of terms of at most 4 m. */
static inline double tl_plane_rounding(double magnitude)
{
    return magnitude * (40 * 0x1p-53);
}

/* The same where a plane's heights are summed up step by step, four samples at
 * a time, along a block. */
static inline double tl_error_rounding(double magnitude)
{
    return magnitude * ((80 + 4 * (TL_BLOCK / 4)) * 0x1p-53);
}

static inline bool tl_rounds(const tl_rounding *rounding)
{
    return rounding->along > 0 || rounding->upright > 0 || rounding->of_range > 0;
}

/* What rounded corners add to the error of a triangle that rises by `rise` in a cell, units of height: the plane is
 * lifted, and shifted over its slope, which has changed a little itself. What of_range adds is in `upright` already. */
static inline double tl_rounding_error(const tl_rounding *rounding, double rise)
{
    return rounding->upright + 1.01 * rounding->along * rise;
}

#endif
