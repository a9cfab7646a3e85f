/* The staged decision: a needed child decides, else the midpoint, else the nested sum, else an exact scan. */
#include "dem/framework.h"

#include <math.h>
#include <string.h>

static const float NEEDED = INFINITY, NOTHING = -INFINITY;

/* ---- Exact scans ------------------------------------------------------------------------------- */

typedef struct scan {
    int64_t stride;
    double limit; /* stop above */
    bool careful;
    double error, magnitude;
} scan;

static inline double larger(double a, double b)
{
    return a > b ? a : b;
}

static double row_error(const float *z, int64_t count, double value, double slope)
{
    double m0 = 0, m1 = 0, m2 = 0, m3 = 0;
    int64_t i = 0;
    for (; i + 4 <= count; i += 4) {
        double at = value + slope * (double)i;
        m0 = larger(fabs(at - (double)z[i]), m0);
        m1 = larger(fabs(at + slope - (double)z[i + 1]), m1);
        m2 = larger(fabs(at + 2 * slope - (double)z[i + 2]), m2);
        m3 = larger(fabs(at + 3 * slope - (double)z[i + 3]), m3);
    }
    for (; i < count; i++)
        m0 = larger(fabs(value + slope * (double)i - (double)z[i]), m0);
    return larger(larger(m0, m1), larger(m2, m3));
}

static double row_magnitude(const float *z, int64_t count)
{
    float m = 0;
    for (int64_t i = 0; i < count; i++)
        m = fabsf(z[i]) > m ? fabsf(z[i]) : m;
    return (double)m;
}

/* Compares `count` samples with value, value + slope, ... */
static inline void scan_row(scan *to, const float *z, int64_t count, double value, double slope)
{
    to->error = larger(row_error(z, count, value, slope), to->error);
    if (to->careful)
        to->magnitude = larger(row_magnitude(z, count), to->magnitude);
}

/* Both triangles of the square of `side` whose first sample is z, cut by '\'. */
static void scan_falling(scan *to, const float *z, int64_t side)
{
    double z0 = (double)z[0], z1 = (double)z[side], per = 1 / (double)side;
    double z2 = (double)z[side * to->stride], z3 = (double)z[side * to->stride + side];
    double left_x = (z3 - z2) * per, left_y = (z2 - z0) * per;
    double right_x = (z1 - z0) * per, right_y = (z3 - z1) * per;
    for (int64_t y = 0; y <= side && to->error <= to->limit; y++, z += to->stride) {
        scan_row(to, z, y + 1, z0 + left_y * (double)y, left_x);
        scan_row(to, z + y, side - y + 1, z0 + (right_x + right_y) * (double)y, right_x);
    }
}

/* The same, cut by '/'. */
static void scan_rising(scan *to, const float *z, int64_t side)
{
    double z0 = (double)z[0], z1 = (double)z[side], per = 1 / (double)side;
    double z2 = (double)z[side * to->stride], z3 = (double)z[side * to->stride + side];
    double left_x = (z1 - z0) * per, left_y = (z2 - z0) * per;
    double right_x = (z3 - z2) * per, right_y = (z3 - z1) * per;
    for (int64_t y = 0; y <= side && to->error <= to->limit; y++, z += to->stride) {
        scan_row(to, z, side - y + 1, z0 + left_y * (double)y, left_x);
        scan_row(to, z + side - y, y + 1, z1 + (right_y - right_x) * (double)y, right_x);
    }
}

/* The triangle on the horizontal edge of 2 s around the sample z whose right angle lies s rows below (step > 0) or
 * above. */
static void scan_across(scan *to, const float *z, int64_t s, int64_t step)
{
    double middle = 0.5 * ((double)z[-s] + (double)z[s]), along = ((double)z[s] - (double)z[-s]) / (double)(2 * s);
    double inwards = ((double)z[s * step] - middle) / (double)s;
    for (int64_t t = 0; t <= s && to->error <= to->limit; t++) {
        int64_t half = s - t;
        scan_row(to, z + t * step - half, 2 * half + 1, middle + inwards * (double)t - along * (double)half, along);
    }
}

/* The triangles on the vertical edge of 2 s around the sample z: to the left, to the right, or both. */
static void scan_down(scan *to, const float *z, int64_t s, bool left, bool right)
{
    double above = (double)z[-s * to->stride], below = (double)z[s * to->stride], middle = 0.5 * (above + below);
    double along = (below - above) / (double)(2 * s);
    double leftwards = left ? ((double)z[-s] - middle) / (double)s : 0;
    double rightwards = right ? ((double)z[s] - middle) / (double)s : 0;
    for (int64_t y = -s; y <= s && to->error <= to->limit; y++) {
        int64_t half = s - (y < 0 ? -y : y);
        const float *row = z + y * to->stride;
        double value = middle + along * (double)y;
        if (left)
            scan_row(to, row - half, half + 1, value + leftwards * (double)half, -leftwards);
        if (right)
            scan_row(to, row, half + 1, value, rightwards);
    }
}

/* ---- Decisions --------------------------------------------------------------------------------- */

/* The bound of a vertex whose triangles have this error, or NEEDED. What overflowed (or is infinity less infinity)
 * compares as false, and is needed. */
static inline float settled(double error, double limit)
{
    return error <= limit ? tl_rounded_up(error) : NEEDED;
}

/* Error of the sample z between its neighbours, with its rounding where that counts. Three equal heights are met
 * exactly in any arithmetic. */
static inline double midpoint_error(double a, double z, double b, bool careful)
{
    double error = fabs(z - 0.5 * (a + b));
    if (careful && !(error == 0 && a == b))
        error += tl_plane_rounding(fabs(a) + fabs(z) + fabs(b));
    return error;
}

/* The bound after a scan. */
static float scanned(const scan *from)
{
    double error = from->error;
    if (from->careful)
        error += tl_plane_rounding(from->magnitude);
    return settled(error, from->limit);
}

static inline void mark(const tl_patch *patch, int64_t x, int64_t y)
{
    patch->split[(y >> patch->split_log) * patch->split_stride + (x >> patch->split_log)] = 1;
}

/* What can be said of a vertex z between a and b whose children have at most the bound `children`, without a scan:
 * its own bound, NEEDED, NOTHING, or NAN where only a scan can tell. */
static inline float staged(const tl_patch *patch, double limit, float children, double a, double z, double b)
{
    if (isinf(children))
        return children;
    double error = fabs(z - 0.5 * (a + b)), sum = error + (double)children;
    if (sum <= limit - patch->rounding ||
        (sum == 0 && a == b && limit >= 0)) /* the latter: children of bound 0 are flat where rounding counts */
        return tl_rounded_up(sum);
    return error <= limit ? NAN : NEEDED;
}

static scan new_scan(const tl_patch *patch, double limit)
{
    return (scan){.stride = patch->stride, .limit = limit, .careful = patch->careful};
}

/* The horizontal edge point (x, y) of stage s. */
static float decide_across(const tl_patch *patch, int64_t x, int64_t y, int64_t s, float children)
{
    if (x > patch->rim_x || y > patch->rim_y)
        return NOTHING; /* its triangles reach over the rim with the square's centre, or do not exist */
    if (x + s > patch->rim_x || tl_reaches_over(y, s, patch->rim_y))
        return NEEDED;
    const float *z = patch->heights + y * patch->stride + x;
    double limit = patch->limit[tl_size_of(s, false)];
    float bound = staged(patch, limit, children, (double)z[-s], (double)z[0], (double)z[s]);
    if (!isnan(bound))
        return bound;
    scan to = new_scan(patch, limit);
    if (y > 0)
        scan_across(&to, z, s, -patch->stride);
    if (y < patch->height && y < patch->rim_y)
        scan_across(&to, z, s, patch->stride);
    return scanned(&to);
}

/* The vertical edge point (x, y) of stage s. */
static float decide_down(const tl_patch *patch, int64_t x, int64_t y, int64_t s, float children)
{
    if (x > patch->rim_x || y > patch->rim_y)
        return NOTHING;
    if (y + s > patch->rim_y || tl_reaches_over(x, s, patch->rim_x))
        return NEEDED;
    const float *z = patch->heights + y * patch->stride + x;
    int64_t below = s * patch->stride;
    double limit = patch->limit[tl_size_of(s, false)];
    float bound = staged(patch, limit, children, (double)z[-below], (double)z[0], (double)z[below]);
    if (!isnan(bound))
        return bound;
    scan to = new_scan(patch, limit);
    scan_down(&to, z, s, x > 0, x < patch->width && x < patch->rim_x);
    return scanned(&to);
}

/* Whether the square (column, row) of side 2 s of the patch is cut by '/'. */
static inline bool is_rising(const tl_patch *patch, int64_t column, int64_t row, int64_t s)
{
    return (patch->x / (2 * s) + patch->y / (2 * s) + column + row) & 1;
}

/* The centre (x, y) of a square of side 2 s. */
static float decide_centre(const tl_patch *patch, int64_t x, int64_t y, int64_t s, bool rising, float children)
{
    if (x + s > patch->rim_x || y + s > patch->rim_y)
        return NEEDED;
    const float *z = patch->heights + y * patch->stride + x;
    int64_t end = s * patch->stride + (rising ? -s : s);
    double limit = patch->limit[tl_size_of(s, true)];
    float bound = staged(patch, limit, children, (double)z[-end], (double)z[0], (double)z[end]);
    if (!isnan(bound))
        return bound;
    scan to = new_scan(patch, limit);
    const float *first = z - s * patch->stride - s;
    if (rising)
        scan_rising(&to, first, 2 * s);
    else
        scan_falling(&to, first, 2 * s);
    return scanned(&to);
}

void tl_patch_decide_edges(const tl_patch *patch, int64_t s, int64_t row)
{
    int64_t columns = tl_patch_squares(patch->width, s), rows = tl_patch_squares(patch->height, s);
    int64_t stride = tl_patch_centre_stride(tl_patch_squares(patch->width, s / 2));
    const float *above = patch->centres + 2 * row * stride + 1; /* the frame shifts rows and columns by one */
    const float *here = above + stride, *below = here + stride;
    for (int64_t i = 0; i < columns; i++) {
        float children = tl_larger4(above[2 * i], above[2 * i + 1], here[2 * i], here[2 * i + 1]);
        float bound = decide_across(patch, (2 * i + 1) * s, 2 * row * s, s, children);
        patch->across[row * columns + i] = bound;
        if (bound == NEEDED)
            mark(patch, (2 * i + 1) * s, 2 * row * s);
    }
    for (int64_t i = 0; row < rows && i <= columns; i++) {
        float children = tl_larger4(here[2 * i - 1], here[2 * i], below[2 * i - 1], below[2 * i]);
        float bound = decide_down(patch, 2 * i * s, (2 * row + 1) * s, s, children);
        patch->down[row * (columns + 1) + i] = bound;
        if (bound == NEEDED)
            mark(patch, 2 * i * s, (2 * row + 1) * s);
    }
}

void tl_patch_frame_centres(const tl_patch *patch, int64_t s)
{
    int64_t columns = tl_patch_squares(patch->width, s), rows = tl_patch_squares(patch->height, s);
    int64_t stride = tl_patch_centre_stride(columns), height = tl_patch_centre_stride(rows);
    for (int64_t y = 0; y < height; y++) {
        float *row = patch->centres + y * stride;
        bool inside = y > 0 && y <= rows;
        row[0] = NOTHING;
        for (int64_t x = inside ? columns + 1 : 1; x < stride; x++)
            row[x] = NOTHING;
    }
}

void tl_patch_decide_centres(const tl_patch *patch, int64_t s, int64_t row)
{
    int64_t columns = tl_patch_squares(patch->width, s), stride = tl_patch_centre_stride(columns);
    const float *above = patch->across + row * columns, *below = above + columns;
    const float *left = patch->down + row * (columns + 1);
    float *out = patch->centres + (row + 1) * stride + 1;
    for (int64_t i = 0; i < columns; i++) {
        int64_t x = (2 * i + 1) * s, y = (2 * row + 1) * s;
        float children = tl_larger4(above[i], below[i], left[i], left[i + 1]);
        out[i] = decide_centre(patch, x, y, s, is_rising(patch, i, row, s), children);
        if (out[i] == NEEDED && x <= patch->rim_x && y <= patch->rim_y)
            mark(patch, x, y);
    }
}

/* ---- Stage 1: no scans ----------------------------------------------------------------------------
 *
 * Half of all vertices, in loops over plain arrays without branches: rows of samples are parted into even and odd
 * columns first. */

/* Columns 2 i and 2 i + 1 of a row; odd[-1] and, where the width is even, odd[columns] may be read. */
typedef struct parted {
    float *even, *odd;
} parted;

typedef struct sampler {
    const tl_patch *patch;
    int64_t columns; /* squares */
    bool careful, voids;
    parted rows[4];           /* row y at (y + 1) & 3 */
    double *across[2], *down; /* bounds of the edge points above, below and beside a row of centres */
} sampler;

static inline parted part_of(const sampler *self, int64_t y)
{
    return self->rows[(y + 1) & 3];
}

static void part(sampler *self, int64_t y)
{
    if (y > self->patch->height + 1)
        return; /* beyond the frame, for edge points that are outside */
    const float *z = self->patch->heights + y * self->patch->stride;
    parted to = part_of(self, y);
    int64_t columns = self->columns;
    to.odd[-1] = z[-1];
    for (int64_t i = 0; i < columns; i++) {
        to.even[i] = z[2 * i];
        to.odd[i] = z[2 * i + 1];
    }
    to.even[columns] = z[2 * columns];
    if (2 * columns == self->patch->width)
        to.odd[columns] = z[2 * columns + 1]; /* in the frame; else beyond it, and beside an edge point outside */
}

/* Edge points z between a and b with right angles at c and d. */
static inline void sample_edges(const sampler *self, const float *restrict a, const float *restrict z,
                                const float *restrict b, const float *restrict c, const float *restrict d,
                                double *restrict out, int64_t count)
{
    double limit = self->patch->limit[tl_size_of(1, false)];
    for (int64_t i = 0; i < count; i++) {
        double error = midpoint_error((double)a[i], (double)z[i], (double)b[i], self->careful);
        out[i] = error <= limit ? error : HUGE_VAL;
    }
    for (int64_t i = 0; self->voids && i < count; i++) {
        int known = (a[i] == a[i]) + (b[i] == b[i]) + (z[i] == z[i]) + (c[i] == c[i]) + (d[i] == d[i]);
        out[i] = known == 5 ? out[i] : known ? HUGE_VAL : -HUGE_VAL;
    }
}

static inline void mark_needed(unsigned char *restrict split, const double *restrict bounds, int64_t count)
{
    for (int64_t i = 0; i < count; i++)
        split[2 * i] = bounds[i] == HUGE_VAL;
}

static inline void sample_across(const sampler *self, int64_t y, double *out)
{
    const tl_patch *patch = self->patch;
    parted above = part_of(self, y - 1), here = part_of(self, y), below = part_of(self, y + 1);
    if (y > patch->rim_y) {
        for (int64_t i = 0; i < self->columns; i++)
            out[i] = -HUGE_VAL;
        return;
    }
    sample_edges(self, here.even, here.odd, here.even + 1, above.odd, below.odd, out, self->columns);
    if (2 * self->columns > patch->rim_x)
        out[self->columns - 1] = HUGE_VAL; /* reaches over the rim */
    mark_needed(patch->split + y * patch->split_stride + 1, out, self->columns);
}

static inline void sample_down(const sampler *self, int64_t y, double *out)
{
    const tl_patch *patch = self->patch;
    parted above = part_of(self, y - 1), here = part_of(self, y), below = part_of(self, y + 1);
    int64_t count = 2 * self->columns > patch->rim_x ? self->columns : self->columns + 1;
    sample_edges(self, above.even, here.even, below.even, here.odd - 1, here.odd, out, count);
    for (int64_t i = 0; i < count && y + 1 > patch->rim_y; i++)
        out[i] = HUGE_VAL;
    if (count == self->columns)
        out[count] = -HUGE_VAL; /* outside */
    mark_needed(patch->split + y * patch->split_stride, out, count);
}

/* A triangle around a centre of stage 1 covers, beside its corners, the centre and the midpoints of its legs, whose
 * errors are those of the edge points: the largest is its error, exactly. */
static inline void sample_centres(const sampler *self, int64_t row, const double *restrict above,
                                  const double *restrict below, const double *restrict down, float *restrict out)
{
    const tl_patch *patch = self->patch;
    parted north = part_of(self, 2 * row), here = part_of(self, 2 * row + 1), south = part_of(self, 2 * row + 2);
    int64_t rising = is_rising(patch, 0, row, 1);
    double limit = patch->limit[tl_size_of(1, true)];
    for (int64_t i = 0; i < self->columns; i++) {
        int64_t turned = (i + rising) & 1;
        double error = midpoint_error((double)north.even[i + turned], (double)here.odd[i],
                                      (double)south.even[i + 1 - turned], self->careful);
        double most = larger(larger(above[i], below[i]), larger(down[i], down[i + 1]));
        float bound = settled(larger(error, most), limit);
        out[i] = self->voids && most == -HUGE_VAL ? NOTHING : bound;
    }
    if (2 * self->columns > patch->rim_x)
        out[self->columns - 1] = NEEDED;
    for (int64_t i = 0; i < self->columns && 2 * row + 2 > patch->rim_y; i++)
        out[i] = NEEDED;
    unsigned char *split = patch->split + (2 * row + 1) * patch->split_stride + 1;
    for (int64_t i = 0; i < self->columns; i++)
        split[2 * i] = out[i] == NEEDED;
}

static inline __attribute__((always_inline)) void decide_samples(sampler *self, bool careful, bool voids)
{
    self->careful = careful; /* constants, for the copy of all this that is made for them */
    self->voids = voids;
    int64_t stride = tl_patch_centre_stride(self->columns), rows = tl_patch_squares(self->patch->height, 1);
    for (int64_t y = -1; y < 2; y++)
        part(self, y);
    sample_across(self, 0, self->across[0]);
    for (int64_t row = 0; row < rows; row++) {
        double *above = self->across[row & 1], *below = self->across[~row & 1];
        part(self, 2 * row + 2);
        part(self, 2 * row + 3);
        sample_down(self, 2 * row + 1, self->down);
        sample_across(self, 2 * row + 2, below);
        sample_centres(self, row, above, below, self->down, self->patch->centres + (row + 1) * stride + 1);
    }
}

void tl_patch_decide_samples(const tl_patch *patch, bool voids, void *scratch)
{
    sampler self = {.patch = patch, .columns = tl_patch_squares(patch->width, 1)};
    size_t pitch = (size_t)self.columns + 4;
    double *bounds = scratch;
    self.across[0] = bounds, self.across[1] = bounds + pitch, self.down = bounds + 2 * pitch;
    float *halves = (float *)(bounds + 3 * pitch) + 1;
    for (int i = 0; i < 4; i++, halves += 2 * pitch)
        self.rows[i] = (parted){halves, halves + pitch};
    tl_patch_frame_centres(patch, 1);
    if (patch->careful)
        decide_samples(&self, true, voids);
    else if (voids)
        decide_samples(&self, false, true);
    else
        decide_samples(&self, false, false);
}
