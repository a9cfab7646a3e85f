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

static inline float larger4(float a, float b, float c, float d)
{
    float m = a > b ? a : b, n = c > d ? c : d;
    return m > n ? m : n;
}

/* A float that is not smaller than `bound` >= 0, without a branch: the bits of floats are ordered as they are. */
static inline float rounded_up(double bound)
{
    float f = (float)bound;
    uint32_t bits;
    memcpy(&bits, &f, sizeof bits);
    bits += (double)f < bound;
    memcpy(&f, &bits, sizeof f);
    return f;
}

/* The bound of a vertex whose triangles have this error, or NEEDED. What overflowed (or is infinity less infinity)
 * compares as false, and is needed. */
static inline float settled(double error, double limit)
{
    return error <= limit ? rounded_up(error) : NEEDED;
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
static float scanned(const scan *from, double max_error)
{
    double error = from->error;
    if (from->careful)
        error += tl_plane_rounding(from->magnitude);
    return settled(error, max_error);
}

static inline void mark(const tl_patch *patch, int64_t x, int64_t y)
{
    patch->split[(y >> patch->split_log) * patch->split_stride + (x >> patch->split_log)] = 1;
}

/* What can be said of a vertex z between a and b whose children have at most the bound `children`, without a scan:
 * its own bound, NEEDED, NOTHING, or NAN where only a scan can tell. */
static inline float staged(const tl_patch *patch, float children, double a, double z, double b)
{
    if (isinf(children))
        return children;
    double error = fabs(z - 0.5 * (a + b)), sum = error + (double)children;
    if (sum <= patch->sum_limit ||
        (sum == 0 && a == b)) /* the latter: children of bound 0 are flat where rounding counts */
        return rounded_up(sum);
    return error <= patch->max_error ? NAN : NEEDED;
}

static scan new_scan(const tl_patch *patch)
{
    return (scan){.stride = patch->stride, .limit = patch->max_error, .careful = patch->careful};
}

/* Whether the triangle below (or right of) an edge at `at` reaches over the rim; one that begins there is outside. */
static inline bool reaches_over(int64_t at, int64_t s, int64_t rim)
{
    return at < rim && at + s > rim;
}

/* The horizontal edge point (x, y) of stage s. */
static float decide_across(const tl_patch *patch, int64_t x, int64_t y, int64_t s, float children)
{
    if (x > patch->rim_x || y > patch->rim_y)
        return NOTHING; /* its triangles reach over the rim with the square's centre, or do not exist */
    if (x + s > patch->rim_x || reaches_over(y, s, patch->rim_y))
        return NEEDED;
    const float *z = patch->heights + y * patch->stride + x;
    float bound = staged(patch, children, (double)z[-s], (double)z[0], (double)z[s]);
    if (!isnan(bound))
        return bound;
    scan to = new_scan(patch);
    if (y > 0)
        scan_across(&to, z, s, -patch->stride);
    if (y < patch->height && y < patch->rim_y)
        scan_across(&to, z, s, patch->stride);
    return scanned(&to, patch->max_error);
}

/* The vertical edge point (x, y) of stage s. */
static float decide_down(const tl_patch *patch, int64_t x, int64_t y, int64_t s, float children)
{
    if (x > patch->rim_x || y > patch->rim_y)
        return NOTHING;
    if (y + s > patch->rim_y || reaches_over(x, s, patch->rim_x))
        return NEEDED;
    const float *z = patch->heights + y * patch->stride + x;
    int64_t below = s * patch->stride;
    float bound = staged(patch, children, (double)z[-below], (double)z[0], (double)z[below]);
    if (!isnan(bound))
        return bound;
    scan to = new_scan(patch);
    scan_down(&to, z, s, x > 0, x < patch->width && x < patch->rim_x);
    return scanned(&to, patch->max_error);
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
    float bound = staged(patch, children, (double)z[-end], (double)z[0], (double)z[end]);
    if (!isnan(bound))
        return bound;
    scan to = new_scan(patch);
    const float *first = z - s * patch->stride - s;
    if (rising)
        scan_rising(&to, first, 2 * s);
    else
        scan_falling(&to, first, 2 * s);
    return scanned(&to, patch->max_error);
}

void tl_patch_decide_edges(const tl_patch *patch, int64_t s, int64_t row)
{
    int64_t columns = tl_patch_squares(patch->width, s), rows = tl_patch_squares(patch->height, s);
    int64_t stride = tl_patch_centre_stride(tl_patch_squares(patch->width, s / 2));
    const float *above = patch->centres + 2 * row * stride + 1; /* the frame shifts rows and columns by one */
    const float *here = above + stride, *below = here + stride;
    for (int64_t i = 0; i < columns; i++) {
        float children = larger4(above[2 * i], above[2 * i + 1], here[2 * i], here[2 * i + 1]);
        float bound = decide_across(patch, (2 * i + 1) * s, 2 * row * s, s, children);
        patch->across[row * columns + i] = bound;
        if (bound == NEEDED)
            mark(patch, (2 * i + 1) * s, 2 * row * s);
    }
    for (int64_t i = 0; row < rows && i <= columns; i++) {
        float children = larger4(here[2 * i - 1], here[2 * i], below[2 * i - 1], below[2 * i]);
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
        bool inside = y > 0 && y <= rows;
        for (int64_t x = 0; x < stride; x++)
            if (!inside || x == 0 || x > columns)
                patch->centres[y * stride + x] = NOTHING;
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
        float children = larger4(above[i], below[i], left[i], left[i + 1]);
        out[i] = decide_centre(patch, x, y, s, is_rising(patch, i, row, s), children);
        if (out[i] == NEEDED && x <= patch->rim_x && y <= patch->rim_y)
            mark(patch, x, y);
    }
}

/* ---- Stage 1: four samples a triangle, no scans -------------------------------------------------- */

/* The edge point z between z[-step] and z[step], right angles at z[-aside] and z[aside]. */
static inline float sample_edge(const float *z, int64_t step, int64_t aside, double limit, bool careful, bool voids)
{
    if (voids) {
        int count = isnan(z[0]) + isnan(z[-step]) + isnan(z[step]) + isnan(z[-aside]) + isnan(z[aside]);
        if (count)
            return count == 5 ? NOTHING : NEEDED;
    }
    return settled(midpoint_error((double)z[-step], (double)z[0], (double)z[step], careful), limit);
}

static inline void sample_across(const tl_patch *patch, int64_t y, float *out, bool careful, bool voids)
{
    int64_t columns = tl_patch_squares(patch->width, 1), stride = patch->stride;
    const float *z = patch->heights + y * stride + 1;
    unsigned char *split = patch->split + y * patch->split_stride + 1;
    bool outside = y > patch->rim_y;
    for (int64_t i = 0; i < columns; i++) {
        out[i] = outside ? NOTHING : sample_edge(z + 2 * i, 1, stride, patch->max_error, careful, voids);
        split[2 * i] = out[i] == NEEDED;
    }
    if (!outside && 2 * columns > patch->rim_x) { /* the last one reaches over the rim */
        out[columns - 1] = NEEDED;
        split[2 * columns - 2] = 1;
    }
}

static inline void sample_down(const tl_patch *patch, int64_t y, float *out, bool careful, bool voids)
{
    int64_t columns = tl_patch_squares(patch->width, 1), stride = patch->stride;
    const float *z = patch->heights + y * stride;
    unsigned char *split = patch->split + y * patch->split_stride;
    bool over = y + 1 > patch->rim_y;
    for (int64_t i = 0; i <= columns && 2 * i <= patch->rim_x; i++) {
        out[i] = over ? NEEDED : sample_edge(z + 2 * i, stride, 1, patch->max_error, careful, voids);
        split[2 * i] = out[i] == NEEDED;
    }
    if (2 * columns > patch->rim_x)
        out[columns] = NOTHING;
}

/* A triangle around a centre of stage 1 covers, beside its corners, the centre and the midpoints of its legs, whose
 * errors are those of the edge points: the largest is its error, exactly. */
static inline float sample_centre(const float *z, int64_t end, float children, double limit, bool careful, bool voids)
{
    if (voids && children == NOTHING)
        return NOTHING;
    double error = midpoint_error((double)z[-end], (double)z[0], (double)z[end], careful);
    return settled(larger(error, (double)children), limit);
}

static inline void sample_centres(const tl_patch *patch, int64_t row, const float *above, const float *below,
                                  const float *left, bool careful, bool voids)
{
    int64_t columns = tl_patch_squares(patch->width, 1), y = 2 * row + 1, stride = patch->stride;
    const float *z = patch->heights + y * stride + 1;
    unsigned char *split = patch->split + y * patch->split_stride + 1;
    float *out = patch->centres + (row + 1) * tl_patch_centre_stride(columns) + 1;
    for (int64_t i = 0; i < columns; i++) {
        float children = larger4(above[i], below[i], left[i], left[i + 1]);
        int64_t end = stride + (is_rising(patch, i, row, 1) ? -1 : 1);
        out[i] = sample_centre(z + 2 * i, end, children, patch->max_error, careful, voids);
        split[2 * i] = out[i] == NEEDED;
    }
    if (2 * columns > patch->rim_x) {
        out[columns - 1] = NEEDED;
        split[2 * columns - 2] = 1;
    }
    for (int64_t i = 0; i < columns && y + 1 > patch->rim_y; i++) {
        out[i] = NEEDED;
        split[2 * i] = 1;
    }
}

static inline void decide_samples(tl_patch *patch, float *rows, bool careful, bool voids)
{
    int64_t pitch = tl_patch_squares(patch->width, 1) + 1, count = tl_patch_squares(patch->height, 1);
    float *above = rows, *below = rows + pitch, *down = below + pitch;
    sample_across(patch, 0, above, careful, voids);
    for (int64_t row = 0; row < count; row++) {
        sample_down(patch, 2 * row + 1, down, careful, voids);
        sample_across(patch, 2 * row + 2, below, careful, voids);
        sample_centres(patch, row, above, below, down, careful, voids);
        float *swap = above;
        above = below;
        below = swap;
    }
}

void tl_patch_decide_samples(tl_patch *patch, bool voids, float *rows)
{
    tl_patch_frame_centres(patch, 1);
    if (patch->careful)
        decide_samples(patch, rows, true, voids);
    else if (voids)
        decide_samples(patch, rows, false, true);
    else
        decide_samples(patch, rows, false, false);
}
