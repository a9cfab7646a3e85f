/* Every triangle of a block against every sample that it covers: a level costs two visits a sample, one for its edge
 * points and one for its centres, whatever the size of the triangles. All sums are exact wherever heights have few
 * enough bits, and a maximum does not depend on the order, so that each instruction set finds the same. */
#include "dem/framework_kernel.h"

#include <math.h>
#include <string.h>

#ifdef __AVX2__
#include <immintrin.h>
#endif

#define JOIN_(a, b) a##_##b
#define JOIN(a, b) JOIN_(a, b)
#define NAMED(name) JOIN(name, TL_KERNEL)
#define TEXT_(a) #a
#define TEXT(a) TEXT_(a)

static const float NEEDED = INFINITY, NOTHING = -INFINITY;

/* ---- Four doubles ----------------------------------------------------------------------------------- */

#ifdef __AVX2__
typedef __m256d lanes;

static inline lanes all_of(double a)
{
    return _mm256_set1_pd(a);
}

static inline lanes ramp(double first, double step)
{
    return _mm256_add_pd(_mm256_set1_pd(first), _mm256_mul_pd(_mm256_set1_pd(step), _mm256_set_pd(3, 2, 1, 0)));
}

static inline lanes plus(lanes a, lanes b)
{
    return _mm256_add_pd(a, b);
}

static inline lanes most_of(lanes a, lanes b)
{
    return _mm256_max_pd(a, b);
}

/* |value - z| of four samples */
static inline lanes off_by(lanes value, const float *z)
{
    return _mm256_andnot_pd(_mm256_set1_pd(-0.0), _mm256_sub_pd(value, _mm256_cvtps_pd(_mm_loadu_ps(z))));
}

/* The first `count` of four. */
static inline lanes first_of(lanes a, int64_t count)
{
    __m256i kept = _mm256_cmpgt_epi64(_mm256_set1_epi64x(count), _mm256_set_epi64x(3, 2, 1, 0));
    return _mm256_and_pd(a, _mm256_castsi256_pd(kept));
}

static inline double most_in(lanes a)
{
    __m128d both = _mm_max_pd(_mm256_castpd256_pd128(a), _mm256_extractf128_pd(a, 1));
    return _mm_cvtsd_f64(_mm_max_sd(both, _mm_unpackhi_pd(both, both)));
}
#else
typedef struct lanes {
    double at[4];
} lanes;

static inline lanes all_of(double a)
{
    return (lanes){{a, a, a, a}};
}

static inline lanes ramp(double first, double step)
{
    return (lanes){{first, first + step, first + step * 2, first + step * 3}};
}

static inline lanes plus(lanes a, lanes b)
{
    for (int k = 0; k < 4; k++)
        a.at[k] += b.at[k];
    return a;
}

static inline lanes most_of(lanes a, lanes b)
{
    for (int k = 0; k < 4; k++)
        a.at[k] = a.at[k] > b.at[k] ? a.at[k] : b.at[k];
    return a;
}

static inline lanes off_by(lanes value, const float *z)
{
    for (int k = 0; k < 4; k++)
        value.at[k] = fabs(value.at[k] - (double)z[k]);
    return value;
}

static inline lanes first_of(lanes a, int64_t count)
{
    for (int k = 0; k < 4; k++)
        a.at[k] = k < count ? a.at[k] : 0;
    return a;
}

static inline double most_in(lanes a)
{
    double m = a.at[0] > a.at[1] ? a.at[0] : a.at[1], n = a.at[2] > a.at[3] ? a.at[2] : a.at[3];
    return m > n ? m : n;
}
#endif

/* ---- Scans ------------------------------------------------------------------------------------------ */

/* Compares `count` >= 1 samples with value, value + slope, ... The last four overlap those before. */
static inline lanes scan_piece(lanes worst, const float *z, int64_t count, double value, double slope)
{
    lanes at = ramp(value, slope);
    if (count < 4)
        return most_of(worst, first_of(off_by(at, z), count));
    lanes step = all_of(4 * slope);
    int64_t i = 0;
    for (; i + 4 <= count; i += 4) {
        worst = most_of(worst, off_by(at, z + i));
        at = plus(at, step);
    }
    if (i < count)
        worst = most_of(worst, off_by(ramp(value + slope * (double)(count - 4), slope), z + count - 4));
    return worst;
}

/* The triangles on the horizontal edge of 2 s around the sample z. */
static inline double scan_across(const float *z, int64_t stride, int64_t s, bool above, bool below)
{
    double left = (double)z[-s], right = (double)z[s], middle = 0.5 * (left + right);
    double along = (right - left) / (double)(2 * s);
    double up = above ? ((double)z[-s * stride] - middle) / (double)s : 0;
    double down = below ? ((double)z[s * stride] - middle) / (double)s : 0;
    lanes worst = scan_piece(all_of(0), z - s + 1, 2 * s - 1, left + along, along);
    for (int64_t t = 1; t < s; t++) {
        int64_t half = s - t;
        double value = middle - along * (double)half;
        if (above)
            worst = scan_piece(worst, z - t * stride - half, 2 * half + 1, value + up * (double)t, along);
        if (below)
            worst = scan_piece(worst, z + t * stride - half, 2 * half + 1, value + down * (double)t, along);
    }
    return most_in(worst);
}

/* The triangles on the vertical edge. */
static inline double scan_down(const float *z, int64_t stride, int64_t s, bool left, bool right)
{
    double above = (double)z[-s * stride], below = (double)z[s * stride], middle = 0.5 * (above + below);
    double along = (below - above) / (double)(2 * s);
    double leftwards = left ? ((double)z[-s] - middle) / (double)s : 0;
    double rightwards = right ? ((double)z[s] - middle) / (double)s : 0;
    lanes worst = all_of(0);
    for (int64_t y = 1 - s; y < s; y++) {
        int64_t half = s - (y < 0 ? -y : y);
        const float *row = z + y * stride;
        double value = middle + along * (double)y;
        if (left)
            worst = scan_piece(worst, row - half, half + 1, value + leftwards * (double)half, -leftwards);
        if (right)
            worst = scan_piece(worst, row, half + 1, value, rightwards);
    }
    return most_in(worst);
}

/* A half of a square: rows y of columns 0 ... y (first half, falling), y ... side (second), 0 ... side - y (first,
 * rising) or side - y ... side. */
static inline double scan_half(const float *z, int64_t stride, int64_t side, bool rising, tl_half half,
                               const double corners[4])
{
    double nw = corners[0], ne = corners[1], sw = corners[2], se = corners[3], per = 1 / (double)side;
    bool top = rising == (half == TL_HALF_FIRST); /* its horizontal side is the upper one */
    bool west = half == TL_HALF_FIRST;
    double along = (top ? ne - nw : se - sw) * per, down = (west ? sw - nw : se - ne) * per;
    double first =
        rising && !west ? se - along * (double)side - down * (double)side : nw; /* the plane at the NW corner */
    lanes worst = all_of(0);
    for (int64_t y = 0; y <= side; y++, z += stride) {
        int64_t from = west ? 0 : rising ? side - y : y, to = !west ? side : rising ? side - y : y;
        double value = first + down * (double)y + along * (double)from;
        worst = scan_piece(worst, z + from, to - from + 1, value, along);
    }
    return most_in(worst);
}

/* ---- Errors ----------------------------------------------------------------------------------------- */

static inline double larger(double a, double b)
{
    return a > b ? a : b;
}

/* The error of a vertex from that of its own triangles, flat where their corners are all as high, which is exact in any
 * arithmetic. */
static inline float settle(const tl_error_block *block, double error, bool flat, int size, float children)
{
    if (!(flat && error == 0))
        error += block->rounding;
    float own = tl_rounded_up(error + block->add[size]);
    return own > children ? own : children;
}

static inline float across_error(const tl_error_block *block, int64_t x, int64_t y, int64_t s, float children)
{
    if (x > block->rim_x || y > block->rim_y)
        return NOTHING;
    if (x + s > block->rim_x || tl_reaches_over(y, s, block->rim_y))
        return NEEDED;
    if (isinf(children))
        return children;
    const float *z = block->heights + y * block->stride + x;
    bool above = y > 0, below = y < block->height && y < block->rim_y;
    double error = scan_across(z, block->stride, s, above, below);
    bool flat = z[-s] == z[s] && (!above || z[-s * block->stride] == z[s]) && (!below || z[s * block->stride] == z[s]);
    return settle(block, error, flat, tl_size_of(s, false), children);
}

static inline float down_error(const tl_error_block *block, int64_t x, int64_t y, int64_t s, float children)
{
    if (x > block->rim_x || y > block->rim_y)
        return NOTHING;
    if (y + s > block->rim_y || tl_reaches_over(x, s, block->rim_x))
        return NEEDED;
    if (isinf(children))
        return children;
    const float *z = block->heights + y * block->stride + x;
    bool left = x > 0, right = x < block->width && x < block->rim_x;
    double error = scan_down(z, block->stride, s, left, right);
    float a = z[-s * block->stride], b = z[s * block->stride];
    bool flat = a == b && (!left || z[-s] == a) && (!right || z[s] == a);
    return settle(block, error, flat, tl_size_of(s, false), children);
}

static inline bool is_rising(const tl_error_block *block, int64_t column, int64_t row, int64_t s)
{
    return (block->x / (2 * s) + block->y / (2 * s) + column + row) & 1;
}

static inline float centre_error(const tl_error_block *block, int64_t x, int64_t y, int64_t s, bool rising,
                                 float children)
{
    if (x + s > block->rim_x || y + s > block->rim_y)
        return NEEDED;
    if (isinf(children))
        return children;
    const float *z = block->heights + (y - s) * block->stride + x - s, *end = z + 2 * s * block->stride;
    const double corners[4] = {(double)z[0], (double)z[2 * s], (double)end[0], (double)end[2 * s]};
    double first = scan_half(z, block->stride, 2 * s, rising, TL_HALF_FIRST, corners);
    double second = scan_half(z, block->stride, 2 * s, rising, TL_HALF_SECOND, corners);
    bool flat = z[0] == z[2 * s] && z[0] == end[0] && z[0] == end[2 * s];
    return settle(block, larger(first, second), flat, tl_size_of(s, true), children);
}

/* ---- Stage by stage --------------------------------------------------------------------------------- */

static inline void put(const tl_error_block *block, int64_t x, int64_t y, float error)
{
    block->errors[y * TL_ERROR_STRIDE + x] = error;
}

static void frame_centres(const tl_error_block *block, int64_t s)
{
    int64_t columns = tl_patch_squares(block->width, s), rows = tl_patch_squares(block->height, s);
    int64_t stride = tl_patch_centre_stride(columns), height = tl_patch_centre_stride(rows);
    for (int64_t y = 0; y < height; y++) {
        float *row = block->centres + y * stride;
        bool inside = y > 0 && y <= rows;
        row[0] = NOTHING;
        for (int64_t x = inside ? columns + 1 : 1; x < stride; x++)
            row[x] = NOTHING;
    }
}

static inline __attribute__((always_inline)) void edge_rows(const tl_error_block *block, int64_t s)
{
    int64_t columns = tl_patch_squares(block->width, s), rows = tl_patch_squares(block->height, s);
    int64_t stride = tl_patch_centre_stride(tl_patch_squares(block->width, s / 2));
    for (int64_t row = 0; row <= rows; row++) {
        const float *above = block->centres + 2 * row * stride + 1; /* the frame shifts rows and columns by one */
        const float *here = above + stride, *below = here + stride;
        for (int64_t i = 0; i < columns; i++) {
            int64_t x = (2 * i + 1) * s, y = 2 * row * s;
            float children = tl_larger4(above[2 * i], above[2 * i + 1], here[2 * i], here[2 * i + 1]);
            float error = across_error(block, x, y, s, children);
            block->across[row * columns + i] = error;
            put(block, x, y, error);
        }
        for (int64_t i = 0; row < rows && i <= columns; i++) {
            int64_t x = 2 * i * s, y = (2 * row + 1) * s;
            float children = tl_larger4(here[2 * i - 1], here[2 * i], below[2 * i - 1], below[2 * i]);
            float error = down_error(block, x, y, s, children);
            block->down[row * (columns + 1) + i] = error;
            put(block, x, y, error);
        }
    }
}

static inline __attribute__((always_inline)) void centre_rows(const tl_error_block *block, int64_t s)
{
    int64_t columns = tl_patch_squares(block->width, s), rows = tl_patch_squares(block->height, s);
    int64_t stride = tl_patch_centre_stride(columns);
    for (int64_t row = 0; row < rows; row++) {
        const float *above = block->across + row * columns, *below = above + columns;
        const float *left = block->down + row * (columns + 1);
        float *out = block->centres + (row + 1) * stride + 1;
        for (int64_t i = 0; i < columns; i++) {
            int64_t x = (2 * i + 1) * s, y = (2 * row + 1) * s;
            float children = tl_larger4(above[i], below[i], left[i], left[i + 1]);
            out[i] = centre_error(block, x, y, s, is_rising(block, i, row, s), children);
            put(block, x, y, out[i]);
        }
    }
}

static inline __attribute__((always_inline)) void stage(const tl_error_block *block, int64_t s)
{
    edge_rows(block, s);
    frame_centres(block, s);
    centre_rows(block, s);
}

/* ---- Stage 1 ---------------------------------------------------------------------------------------- */

/* Columns 2 i and 2 i + 1 of a row; odd[-1] and odd[columns] may be read. */
typedef struct parted {
    float *even, *odd;
} parted;

typedef struct sampler {
    const tl_error_block *block;
    int64_t columns; /* squares */
    bool careful, voids;
    parted rows[4]; /* row y at (y + 1) & 3 */
    double *across[2], *down;
} sampler;

static inline parted part_of(const sampler *self, int64_t y)
{
    return self->rows[(y + 1) & 3];
}

static inline void part(sampler *self, int64_t y)
{
    if (y > self->block->height + 1)
        return; /* beyond the frame, for edge points that are outside */
    const float *z = self->block->heights + y * self->block->stride;
    parted to = part_of(self, y);
    int64_t columns = self->columns;
    float *restrict even = to.even, *restrict odd = to.odd;
    odd[-1] = z[-1];
    for (int64_t i = 0; i < columns; i++) {
        even[i] = z[2 * i];
        odd[i] = z[2 * i + 1];
    }
    even[columns] = z[2 * columns];
    if (2 * columns == self->block->width)
        odd[columns] = z[2 * columns + 1];
}

/* The distance of the sample z from the middle of a and b. */
static inline double midpoint_error(const sampler *self, float a, float z, float b)
{
    double error = fabs((double)z - 0.5 * ((double)a + (double)b));
    if (self->careful && !(error == 0 && a == b))
        error += self->block->rounding;
    return error;
}

/* Edge points z between a and b with right angles at c and d. */
static inline void sample_edges(const sampler *self, const float *restrict a, const float *restrict z,
                                const float *restrict b, const float *restrict c, const float *restrict d,
                                double *restrict out, int64_t count)
{
    for (int64_t i = 0; i < count; i++)
        out[i] = midpoint_error(self, a[i], z[i], b[i]);
    for (int64_t i = 0; self->voids && i < count; i++) {
        int known = (a[i] == a[i]) + (b[i] == b[i]) + (z[i] == z[i]) + (c[i] == c[i]) + (d[i] == d[i]);
        out[i] = known == 5 ? out[i] : known ? HUGE_VAL : -HUGE_VAL;
    }
}

static inline void sample_across(const sampler *self, int64_t y, double *restrict out)
{
    const tl_error_block *block = self->block;
    parted above = part_of(self, y - 1), here = part_of(self, y), below = part_of(self, y + 1);
    float *restrict errors = block->errors + y * TL_ERROR_STRIDE + 1;
    double add = block->add[tl_size_of(1, false)];
    if (y > block->rim_y) {
        for (int64_t i = 0; i < self->columns; i++)
            out[i] = -HUGE_VAL;
        return;
    }
    sample_edges(self, here.even, here.odd, here.even + 1, above.odd, below.odd, out, self->columns);
    if (2 * self->columns > block->rim_x)
        out[self->columns - 1] = HUGE_VAL; /* reaches over the rim */
    for (int64_t i = 0; i < self->columns; i++)
        errors[2 * i] = tl_rounded_up(out[i] + add);
}

static inline void sample_down(const sampler *self, int64_t y, double *out)
{
    const tl_error_block *block = self->block;
    parted above = part_of(self, y - 1), here = part_of(self, y), below = part_of(self, y + 1);
    int64_t count = 2 * self->columns > block->rim_x ? self->columns : self->columns + 1;
    sample_edges(self, above.even, here.even, below.even, here.odd - 1, here.odd, out, count);
    for (int64_t i = 0; i < count && y + 1 > block->rim_y; i++)
        out[i] = HUGE_VAL;
    if (count == self->columns)
        out[count] = -HUGE_VAL; /* outside */
}

/* A triangle around a centre of stage 1 covers, beside its corners, the centre and the midpoints of its legs, whose
 * errors are those of the edge points. */
static inline void sample_centres(const sampler *self, int64_t row, const double *restrict above,
                                  const double *restrict below, const double *restrict down, float *restrict out)
{
    const tl_error_block *block = self->block;
    parted north = part_of(self, 2 * row), here = part_of(self, 2 * row + 1), south = part_of(self, 2 * row + 2);
    int64_t rising = is_rising(block, 0, row, 1);
    double edge = block->add[tl_size_of(1, false)], centre = block->add[tl_size_of(1, true)],
           most_add = larger(edge, centre);
    float *restrict errors = block->errors + (2 * row + 1) * TL_ERROR_STRIDE;
    for (int64_t i = 0; i < self->columns; i++) {
        int64_t turned = (i + rising) & 1;
        double error = midpoint_error(self, north.even[i + turned], here.odd[i], south.even[i + 1 - turned]) + centre;
        double most = larger(larger(above[i], below[i]), larger(down[i], down[i + 1]));
        error = larger(error, most + most_add);
        out[i] = tl_rounded_up(self->voids && most == -HUGE_VAL ? -HUGE_VAL : error);
    }
    if (2 * self->columns > block->rim_x)
        out[self->columns - 1] = NEEDED;
    for (int64_t i = 0; i < self->columns && 2 * row + 2 > block->rim_y; i++)
        out[i] = NEEDED;
    for (int64_t i = 0; i < self->columns; i++) {
        errors[2 * i] = tl_rounded_up(down[i] + edge);
        errors[2 * i + 1] = out[i];
    }
    errors[2 * self->columns] = tl_rounded_up(down[self->columns] + edge);
}

static inline __attribute__((always_inline)) void find_samples(sampler *self, bool careful, bool voids)
{
    self->careful = careful; /* constants, for the copy of all this that is made for them */
    self->voids = voids;
    int64_t stride = tl_patch_centre_stride(self->columns), rows = tl_patch_squares(self->block->height, 1);
    for (int64_t y = -1; y < 2; y++)
        part(self, y);
    sample_across(self, 0, self->across[0]);
    for (int64_t row = 0; row < rows; row++) {
        double *above = self->across[row & 1], *below = self->across[~row & 1];
        part(self, 2 * row + 2);
        part(self, 2 * row + 3);
        sample_down(self, 2 * row + 1, self->down);
        sample_across(self, 2 * row + 2, below);
        sample_centres(self, row, above, below, self->down, self->block->centres + (row + 1) * stride + 1);
    }
}

static void stage_of_samples(const tl_error_block *block)
{
    sampler self = {.block = block, .columns = tl_patch_squares(block->width, 1)};
    size_t pitch = TL_BLOCK / 2 + 4;
    self.across[0] = block->rows, self.across[1] = block->rows + pitch, self.down = block->rows + 2 * pitch;
    float *parts = block->parts + 1;
    for (int i = 0; i < 4; i++, parts += 2 * pitch)
        self.rows[i] = (parted){parts, parts + pitch};
    frame_centres(block, 1);
    if (block->rounding > 0 && block->voids)
        find_samples(&self, true, true);
    else if (block->rounding > 0)
        find_samples(&self, true, false);
    else if (block->voids)
        find_samples(&self, false, true);
    else
        find_samples(&self, false, false);
}

/* ---- The kernel ------------------------------------------------------------------------------------- */

static void find_block(const tl_error_block *block, int64_t side)
{
    stage_of_samples(block);
    if (side > 2)
        stage(block, 2);
    if (side > 4)
        stage(block, 4);
    for (int64_t s = 8; 2 * s <= side; s *= 2)
        stage(block, s);
}

static double find_half(const float *z, int64_t stride, int64_t side, bool rising, tl_half half,
                        const double corners[4])
{
    return scan_half(z, stride, side, rising, half, corners);
}

static void encode(const float *restrict errors, int64_t count, int32_t base, unsigned char *restrict codes)
{
    for (int64_t i = 0; i < count; i++) {
        int32_t bits;
        memcpy(&bits, &errors[i], sizeof bits);
        int32_t code = ((bits > 0 ? bits : 0) + 0x7ffff) >> 19;
        code -= base;
        code = code < 1 ? 1 : code;
        code = code > 254 ? 255 : code;
        codes[i] = (unsigned char)(bits > 0 ? code : 0);
    }
}

extern const tl_error_kernel NAMED(tl_error_kernel);
const tl_error_kernel NAMED(tl_error_kernel) = {TEXT(TL_KERNEL), find_block, find_half, encode};
