/* The per-sample arithmetic of noise and refinement, in plain C that compilers vectorise. Built once an instruction set
 * with FBM_KERNEL naming the table; the results are the same bits, because every operation is elementwise, in a fixed
 * order, and nothing is contracted. */
#include "fbm/kernel.h"

#ifndef FBM_KERNEL
#define FBM_KERNEL plain
#endif
#define JOIN_(a, b) a##b
#define JOIN(a, b) JOIN_(a, b)
#define TEXT_(a) #a
#define TEXT(a) TEXT_(a)

/* ---- Noise ------------------------------------------------------------------------------------- */

/* Multipliers and shifts of D. Stafford's finaliser "mix 13", as in splitmix64. */
static uint64_t mix(uint64_t x)
{
    x += 0x9e3779b97f4a7c15U;
    x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9U;
    x = (x ^ x >> 27) * 0x94d049bb133111ebU;
    return x ^ x >> 31;
}

/* Key of 2^32 columns: `high` is the upper half of the column, so that nothing repeats beyond. */
static uint64_t row_key(uint64_t seed, int32_t level, fbm_noise_kind kind, int64_t row, int32_t high)
{
    uint64_t key = mix(seed);
    key = mix(key ^ ((uint64_t)(uint32_t)level << 8 | (uint64_t)kind));
    key = mix(key ^ (uint64_t)row);
    return mix(key ^ (uint64_t)(uint32_t)high);
}

/* Columns are spaced by the odd multiplier `a` and start at `b` before they are hashed. Two rows coincide in more than
 * a few columns only where their multipliers agree up to a sign in the low bits, which a single additive key would do
 * for every pair: rows would be shifted copies of each other. */
static void gauss_run(uint32_t a, uint32_t b, uint32_t first, size_t count, float *restrict out)
{
    uint32_t x = first * a + b;
    for (size_t k = 0; k < count; k++, x += a) {
        uint32_t h = x;
        /* two rounds of xor-shift and multiply, constants of C. Wellons' search (bias 0.17 of 1000) */
        h = (h ^ h >> 16) * 0x7feb352dU;
        h = (h ^ h >> 15) * 0x846ca68bU;
        h ^= h >> 16;
        uint32_t h2 = h * 0x9e3779b1U;
        h2 ^= h2 >> 15;
        int32_t sum = (int32_t)((h & 0xffff) + (h >> 16) + (h2 & 0xffff) + (h2 >> 16));
        /* mean 4 * 65535 / 2, standard deviation sqrt(4 (65536^2 - 1) / 12) */
        float s = (float)(sum - 131070) * (1.0F / 37837.2F);
        float q = s * s;
        out[k] = s * (((0.00032150294F * q - 0.0020742221F) * q + 0.016791672F) * q + 0.95876814F);
    }
}

static void noise_row(uint64_t seed, int32_t level, fbm_noise_kind kind, int64_t row, int64_t first, size_t count,
                      float *out)
{
    while (count) {
        uint32_t low = (uint32_t)((uint64_t)first & 0xffffffffU);
        int32_t high = (int32_t)((first - (int64_t)low) / ((int64_t)1 << 32));
        uint64_t key = row_key(seed, level, kind, row, high);
        uint64_t left = ((uint64_t)1 << 32) - low;
        size_t run = count < left ? count : (size_t)left;
        gauss_run((uint32_t)key | 1, (uint32_t)(key >> 32), low, run, out);
        out += run;
        count -= run;
        first = (int64_t)((uint64_t)first + run);
    }
}

/* ---- The 24-point stencil ---------------------------------------------------------------------- */

/* Vertical partial sums of the rows about a centre, for the columns 1/2 (u), 3/2 (v) and 5/2 (q) cells away. */
static void centre_partials(const fbm_centre_job *job, size_t count, float *restrict u, float *restrict v,
                            float *restrict q)
{
    const float *restrict z0 = job->z[0], *restrict z1 = job->z[1], *restrict z2 = job->z[2], *restrict z3 = job->z[3],
                          *restrict z4 = job->z[4], *restrict z5 = job->z[5];
    const float w0 = job->w[0], w1 = job->w[1], w2 = job->w[2], w3 = job->w[3], w4 = job->w[4], w5 = job->w[5];
    for (size_t k = 0; k < count; k++) {
        float near = z2[k] + z3[k], middle = z1[k] + z4[k], far = z0[k] + z5[k];
        u[k] = (w0 * near + w2 * middle) + w5 * far;
        v[k] = w1 * near + w3 * middle;
        q[k] = w4 * near;
    }
}

static void centre_noise_partials(const fbm_centre_job *job, size_t count, float *restrict m0, float *restrict m1)
{
    const float *restrict above = job->g[0], *restrict at = job->g[1], *restrict below = job->g[2];
    const float t0 = job->t[0], t1 = job->t[1], t2 = job->t[2], t3 = job->t[3];
    for (size_t k = 0; k < count; k++) {
        float beside = above[k] + below[k];
        m0[k] = t0 * at[k] + t2 * beside;
        m1[k] = t1 * at[k] + t3 * beside;
    }
}

static void centre_sums(const float *restrict u, const float *restrict v, const float *restrict q, size_t count,
                        float *restrict out)
{
    for (size_t x = 0; x < count; x++)
        out[x] = (u[x + 2] + u[x + 3]) + (v[x + 1] + v[x + 4]) + (q[x] + q[x + 5]);
}

static void centre_noisy_sums(const float *restrict u, const float *restrict v, const float *restrict q,
                              const float *restrict m0, const float *restrict m1, size_t count, float *restrict out)
{
    for (size_t x = 0; x < count; x++)
        out[x] = (u[x + 2] + u[x + 3]) + (v[x + 1] + v[x + 4]) + (q[x] + q[x + 5]) + (m0[x + 1] + (m1[x] + m1[x + 2]));
}

static void centres(const fbm_centre_job *job, size_t count)
{
    float *const *p = job->partial;
    centre_partials(job, count + 5, p[0], p[1], p[2]);
    if (!job->g[0]) {
        centre_sums(p[0], p[1], p[2], count, job->out);
        return;
    }
    centre_noise_partials(job, count + 2, p[3], p[4]);
    centre_noisy_sums(p[0], p[1], p[2], p[3], p[4], count, job->out);
}

/* Partial sums over the lattice half a cell off: columns 1/2 (a) and 3/2 (b) cells away. */
static void side_partials(const fbm_edge_job *job, size_t count, float *restrict a, float *restrict b)
{
    const float *restrict above = job->side[0], *restrict at = job->side[1], *restrict below = job->side[2];
    const float w0 = job->w[0], w2 = job->w[2], w5 = job->w[5], w7 = job->w[7];
    for (size_t k = 0; k < count; k++) {
        float beside = above[k] + below[k];
        a[k] = w0 * at[k] + w2 * beside;
        b[k] = w5 * at[k] + w7 * beside;
    }
}

static void side_noisy_partials(const fbm_edge_job *job, size_t count, float *restrict a, float *restrict b)
{
    const float *restrict above = job->side[0], *restrict at = job->side[1], *restrict below = job->side[2],
                          *restrict g0 = job->other[0], *restrict g1 = job->other[1];
    const float w0 = job->w[0], w2 = job->w[2], w5 = job->w[5], w7 = job->w[7], t1 = job->t[1];
    for (size_t k = 0; k < count; k++) {
        float beside = above[k] + below[k];
        a[k] = (w0 * at[k] + w2 * beside) + t1 * (g0[k] + g1[k]);
        b[k] = w5 * at[k] + w7 * beside;
    }
}

/* Partial sums over the lattice of the edges' own columns: the column itself (d) and those one cell away (e). */
static void same_partials(const fbm_edge_job *job, size_t count, float *restrict d, float *restrict e)
{
    const float *restrict c0 = job->same[0], *restrict c1 = job->same[1], *restrict c2 = job->same[2],
                          *restrict c3 = job->same[3];
    const float w1 = job->w[1], w3 = job->w[3], w4 = job->w[4], w6 = job->w[6];
    for (size_t k = 0; k < count; k++) {
        float near = c1[k] + c2[k], far = c0[k] + c3[k];
        d[k] = w1 * near + w4 * far;
        e[k] = w3 * near + w6 * far;
    }
}

static void same_noisy_partials(const fbm_edge_job *job, size_t count, float *restrict d, float *restrict e)
{
    const float *restrict c0 = job->same[0], *restrict c1 = job->same[1], *restrict c2 = job->same[2],
                          *restrict c3 = job->same[3], *restrict above = job->g[0], *restrict at = job->g[1],
                          *restrict below = job->g[2];
    const float w1 = job->w[1], w3 = job->w[3], w4 = job->w[4], w6 = job->w[6], t0 = job->t[0], t2 = job->t[2],
                t3 = job->t[3];
    for (size_t k = 0; k < count; k++) {
        float near = c1[k] + c2[k], far = c0[k] + c3[k];
        d[k] = (w1 * near + w4 * far) + (t0 * at[k] + t3 * (above[k] + below[k]));
        e[k] = (w3 * near + w6 * far) + t2 * at[k];
    }
}

static void edge_sums(const float *restrict a, const float *restrict b, const float *restrict d,
                      const float *restrict e, size_t count, float *restrict out)
{
    for (size_t x = 0; x < count; x++)
        out[x] = (a[x + 1] + a[x + 2]) + (b[x] + b[x + 3]) + (d[x + 1] + (e[x] + e[x + 2]));
}

static void edges(const fbm_edge_job *job, size_t count)
{
    float *const *p = job->partial;
    if (job->g[0]) {
        side_noisy_partials(job, count + 3, p[0], p[1]);
        same_noisy_partials(job, count + 2, p[2], p[3]);
    } else {
        side_partials(job, count + 3, p[0], p[1]);
        same_partials(job, count + 2, p[2], p[3]);
    }
    edge_sums(p[0], p[1], p[2], p[3], count, job->out);
}

#define ALWAYS_INLINE static inline __attribute__((always_inline)) /* so that choices are constants in the loops */

/* ---- Coefficients by place --------------------------------------------------------------------- */

/* A point is the mean of the orbit next to it and the weighted differences of the others from that: whatever the
 * weights, a plateau stays as it is. Weights 0 ... are those of the second orbit on; of squares, where orbits pair up,
 * of the pairs. Taps follow them. */
enum { SQUARE_SIZE = 8, SIZE = 16, BLOCK = 1 << FBM_PLACES_SHIFT, CHUNK = 64, ROOM = CHUNK + BLOCK };

static void add_rows(const float *restrict a, const float *restrict b, float *restrict out, size_t count)
{
    for (size_t k = 0; k < count; k++)
        out[k] = a[k] + b[k];
}

/* The loops over the coefficients of a vertex; `size` is a constant where they are called. */
ALWAYS_INLINE void mix_values(const float *restrict a, const float *restrict b, float part, size_t size,
                              float *restrict out)
{
    for (size_t k = 0; k < size; k++)
        out[k] = a[k] + part * (b[k] - a[k]);
}

ALWAYS_INLINE void scale_noise(const float *restrict in, const float *restrict taps, float factor, size_t size,
                               float *restrict out)
{
    for (size_t k = 0; k < size; k++)
        out[k] = in[k] * (taps[k] * factor + (1 - taps[k]));
}

ALWAYS_INLINE void subtract(const float *restrict a, const float *restrict b, size_t size, float *restrict out)
{
    for (size_t k = 0; k < size; k++)
        out[k] = a[k] - b[k];
}

/* Between the knots about an exponent, of nodes weighted by `nodes`. */
ALWAYS_INLINE void unit_vertices(const fbm_places_table *table, int node_count, const float *nodes, const float *hurst,
                                 const float *roots, size_t size, size_t count, float *restrict out)
{
    const size_t all = size * (size_t)node_count;
    float sum[2 * SIZE], mixed[2 * SIZE];
    for (size_t x = 0; x < count; x++) {
        const float place = (hurst[x] - FBM_PLACES_LOW) * FBM_PLACES_KNOTS_PER_UNIT;
        const int32_t floor = (int32_t)place, before = floor < FBM_PLACES_STEPS ? floor : FBM_PLACES_STEPS - 1;
        const float *from = table->values + (size_t)before * all, part = place - (float)before;
        mix_values(from, from + all, part, size, sum);
        for (int n = 1; n < node_count; n++) {
            mix_values(from + n * size, from + all + n * size, part, size, mixed);
            for (size_t k = 0; k < size; k++)
                sum[k] = (n > 1 ? sum[k] : nodes[0] * sum[k]) + nodes[n] * mixed[k];
        }
        scale_noise(sum, table->taps, roots[x], size, out + x * size);
    }
}

static void place_unit(const fbm_places_table *table, const float *nodes, const float *hurst, const float *roots,
                       size_t count, float *out)
{
    if (table->square)
        unit_vertices(table, 1, nodes, hurst, roots, 2 * SQUARE_SIZE, count, out);
    else
        unit_vertices(table, table->nodes, nodes, hurst, roots, 2 * SIZE, count, out);
}

ALWAYS_INLINE void scale_vertices(const float *taps, const float *strengths, size_t size, size_t count,
                                  const float *unit, float *out)
{
    for (size_t x = 0; x < count; x++) {
        scale_noise(unit + 2 * x * size, taps, strengths[x], size, out + 4 * x * size);
        scale_noise(unit + (2 * x + 1) * size, taps + size, strengths[x], size, out + (4 * x + 2) * size);
    }
    for (size_t half = 0; half + 1 < 2 * count; half++) { /* what the next vertex has more */
        float *at = out + 2 * half * size;
        if (half + 2 < 2 * count)
            subtract(at + 4 * size, at, size, at + size);
    }
    for (size_t k = 0; k < size && count; k++) /* points on the last vertex take nothing of a next one */
        out[(4 * count - 3) * size + k] = out[(4 * count - 1) * size + k] = 0;
}

static void place_scale(const fbm_places_table *table, const float *strengths, size_t count, const float *unit,
                        float *out)
{
    if (table->square)
        scale_vertices(table->taps, strengths, SQUARE_SIZE, count, unit, out);
    else
        scale_vertices(table->taps, strengths, SIZE, count, unit, out);
}

static void place_values(const float *a, const float *b, float part, bool square, size_t count, float *out)
{
    if (square)
        for (size_t x = 0; x < count; x++)
            mix_values(a + 4 * SQUARE_SIZE * x, b + 4 * SQUARE_SIZE * x, part, 2 * SQUARE_SIZE,
                       out + 2 * SQUARE_SIZE * x);
    else
        for (size_t x = 0; x < count; x++)
            mix_values(a + 4 * SIZE * x, b + 4 * SIZE * x, part, 2 * SIZE, out + 2 * SIZE * x);
}

static void strengths(const float *restrict strength, const float *restrict hurst, float fall, float *restrict out,
                      size_t count)
{
    for (size_t x = 0; x < count; x++) {
        float power = -fall * hurst[x], limited = power > -120 ? power : -120;
        int32_t whole = (int32_t)(limited + 16384.5F) - 16384; /* of a positive number it is the floor */
        float r = (limited - (float)whole) * .69314718F;
        /* Taylor's series: the next term is below 4e-8 */
        float sum =
            1 + r * (1 + r * (.5F + r * (.16666667F + r * (.041666667F + r * (.0083333333F + r * .0013888889F)))));
        union {
            int32_t bits;
            float value;
        } scale = {.bits = (int32_t)((uint32_t)(whole + 127) << 23)};
        out[x] = strength[x] * (sum * scale.value);
    }
}

/* The coefficients of a run of points: linear between two vertices, or, of blocks too short for a vector, one by one.
 */
typedef struct place_run {
    const float *values; /* of the first vertex; NULL: `rows` are */
    const float *rows;   /* coefficient k of point x is at [k * ROOM + x] */
    const float *part;   /* of the way to the next vertex, by point */
} place_run;

static const float parts[2][2 * BLOCK] = {{0, .125F, .25F, .375F, .5F, .625F, .75F, .875F},
                                          {.0625F, .1875F, .3125F, .4375F, .5625F, .6875F, .8125F, .9375F}};

/* Coefficient k of point x. */
#define C(k) (ramp ? values[k] + part[x] * values[size + (k)] : rows[(k)*ROOM + x])

ALWAYS_INLINE void centre_predictor(place_run run, bool ramp, bool square, const float *restrict near,
                                    const float *restrict middle, const float *restrict far, size_t count,
                                    float *restrict out)
{
    const float *restrict values = run.values, *restrict rows = run.rows, *restrict part = run.part;
    const size_t size = square ? SQUARE_SIZE : SIZE;
    for (size_t x = 0; x < count; x++) {
        const float n = near[x + 2] + near[x + 3];
        const float a = near[x + 1] + near[x + 4], b = middle[x + 2] + middle[x + 3], c = middle[x + 1] + middle[x + 4];
        const float d = near[x] + near[x + 5], e = far[x + 2] + far[x + 3];
        if (square)
            out[x] = .25F * n + ((C(0) * ((a + b) - 2 * n) + C(1) * (c - n)) + C(2) * ((d + e) - 2 * n));
        else
            out[x] =
                .25F * n + (((C(0) * (a - n) + C(1) * (b - n)) + C(2) * (c - n)) + (C(3) * (d - n) + C(4) * (e - n)));
    }
}

ALWAYS_INLINE void centre_noise(place_run run, bool ramp, bool square, const float *restrict at,
                                const float *restrict beside, size_t count, float *restrict out)
{
    const float *restrict values = run.values, *restrict rows = run.rows, *restrict part = run.part;
    const size_t size = square ? SQUARE_SIZE : SIZE;
    for (size_t x = 0; x < count; x++) {
        const float own = at[x + 1], sides = at[x] + at[x + 2], ends = beside[x + 1],
                    corners = beside[x] + beside[x + 2];
        if (square)
            out[x] += C(3) * own + (C(4) * (sides + ends) + C(5) * corners);
        else
            out[x] += (C(5) * own + C(6) * sides) + (C(7) * ends + C(8) * corners);
    }
}

ALWAYS_INLINE void edge_predictor(place_run run, bool ramp, bool square, const float *restrict at,
                                  const float *restrict beside, const float *restrict near, const float *restrict far,
                                  size_t count, float *restrict out)
{
    const float *restrict values = run.values, *restrict rows = run.rows, *restrict part = run.part;
    const size_t size = square ? SQUARE_SIZE : SIZE;
    for (size_t x = 0; x < count; x++) {
        const float n = at[x + 1] + at[x + 2], a = near[x + 1];
        const float b = beside[x + 1] + beside[x + 2], c = near[x] + near[x + 2], d = far[x + 1], e = at[x] + at[x + 3],
                    f = far[x] + far[x + 2], g = beside[x] + beside[x + 3];
        if (square) {
            const float m = n + a;
            out[x] = .25F * m + ((C(0) * ((b + c) - 2 * m) + C(1) * ((d + e) - m)) + C(2) * ((f + g) - 2 * m));
        } else
            out[x] = .5F * n + (((C(0) * (a - n) + C(1) * (b - 2 * n)) + (C(2) * (c - 2 * n) + C(3) * (d - n))) +
                                ((C(4) * (e - n) + C(5) * (f - 2 * n)) + C(6) * (g - 2 * n)));
    }
}

ALWAYS_INLINE void edge_noise(place_run run, bool ramp, bool square, const float *restrict above,
                              const float *restrict at, const float *restrict below, const float *restrict other,
                              size_t count, float *restrict out)
{
    const float *restrict values = run.values, *restrict rows = run.rows, *restrict part = run.part;
    const size_t size = square ? SQUARE_SIZE : SIZE;
    for (size_t x = 0; x < count; x++) {
        const float own = at[x + 1], corners = other[x + 1] + other[x + 2], sides = at[x] + at[x + 2],
                    ends = above[x + 1] + below[x + 1];
        if (square)
            out[x] += C(3) * own + (C(4) * corners + C(5) * (sides + ends));
        else
            out[x] += (C(7) * own + C(8) * corners) + (C(9) * sides + C(10) * ends);
    }
}

ALWAYS_INLINE void centre_run(const fbm_centre_job *job, place_run run, bool ramp, bool square, size_t x, size_t count)
{
    float *const *p = job->partial;
    centre_predictor(run, ramp, square, p[0] + x, p[1] + x, p[2] + x, count, job->out + x);
    if (job->g[0])
        centre_noise(run, ramp, square, job->g[1] + x, p[3] + x, count, job->out + x);
}

ALWAYS_INLINE void edge_run(const fbm_edge_job *job, place_run run, bool ramp, bool square, size_t x, size_t count)
{
    float *const *p = job->partial;
    edge_predictor(run, ramp, square, job->side[1] + x, p[0] + x, p[1] + x, p[2] + x, count, job->out + x);
    if (job->g[0])
        edge_noise(run, ramp, square, job->g[0] + x, job->g[1] + x, job->g[2] + x, p[3] + x, count, job->out + x);
}

/* Either, at points x ... x + count - 1 of a job. */
ALWAYS_INLINE void any_run(const void *job, bool edges, place_run run, bool ramp, bool square, size_t x, size_t count)
{
    if (edges)
        edge_run(job, run, ramp, square, x, count);
    else
        centre_run(job, run, ramp, square, x, count);
}

/* Points whose blocks are whole vectors. */
ALWAYS_INLINE void walk_blocks(const void *job, bool edges, const fbm_place_row *row, bool square, size_t count)
{
    const size_t stride = square ? 2 * SQUARE_SIZE : 2 * SIZE;
    const float *values = row->values + (row->first >> FBM_PLACES_SHIFT) * stride;
    size_t offset = row->first & (BLOCK - 1);
    for (size_t x = 0; x < count; values += stride, offset = 0) {
        const place_run run = {values, NULL, parts[row->half] + offset};
        size_t n = BLOCK - offset < count - x ? BLOCK - offset : count - x;
        if (count - x >= BLOCK) /* the next block makes its own points again */
            any_run(job, edges, run, true, square, x, BLOCK);
        else
            any_run(job, edges, run, true, square, x, n);
        x += n;
    }
}

/* The coefficients of whole blocks, point by point. */
ALWAYS_INLINE void expand_blocks(const float *restrict values, size_t block, const float *restrict part,
                                 size_t coefficients, size_t size, size_t blocks, float *restrict out)
{
    for (size_t b = 0; b < blocks; b++)
        for (size_t k = 0; k < coefficients; k++)
            for (size_t x = 0; x < block; x++)
                out[k * ROOM + b * block + x] = values[2 * size * b + k] + part[x] * values[2 * size * b + size + k];
}

/* Those of the points from column `at` on. Returns where the first of them is. */
ALWAYS_INLINE size_t expand(const fbm_place_row *row, size_t at, size_t coefficients, size_t size, size_t count,
                            float *restrict out)
{
    static const float fours[2][4] = {{0, .25F, .5F, .75F}, {.125F, .375F, .625F, .875F}};
    static const float twos[2][2] = {{0, .5F}, {.25F, .75F}}, ones[2][1] = {{0}, {.5F}};
    const size_t offset = at & (((size_t)1 << row->shift) - 1), first = at >> row->shift,
                 blocks = ((at + count - 1) >> row->shift) + 1 - first;
    const float *values = row->values + first * 2 * size;
    if (row->shift == 2)
        expand_blocks(values, 4, fours[row->half], coefficients, size, blocks, out);
    else if (row->shift == 1)
        expand_blocks(values, 2, twos[row->half], coefficients, size, blocks, out);
    else
        expand_blocks(values, 1, ones[row->half], coefficients, size, blocks, out);
    return offset;
}

ALWAYS_INLINE void walk_chunks(const void *job, bool edges, const fbm_place_row *row, bool square, size_t count)
{
    const size_t size = square ? SQUARE_SIZE : SIZE, coefficients = square ? 6 : edges ? 11 : 9;
    float rows[(SIZE - 5) * ROOM];
    for (size_t x = 0; x < count; x += CHUNK) {
        size_t n = count - x < CHUNK ? count - x : CHUNK;
        size_t offset = expand(row, row->first + x, coefficients, size, n, rows);
        any_run(job, edges, (place_run){NULL, rows + offset, NULL}, false, square, x, n);
    }
}

static inline void place_points(const void *job, bool edges, const fbm_place_row *row, size_t count)
{
    if (row->shift == FBM_PLACES_SHIFT && row->square)
        walk_blocks(job, edges, row, true, count);
    else if (row->shift == FBM_PLACES_SHIFT)
        walk_blocks(job, edges, row, false, count);
    else if (row->square)
        walk_chunks(job, edges, row, true, count);
    else
        walk_chunks(job, edges, row, false, count);
}

static void place_centres(const fbm_centre_job *job, const fbm_place_row *row, size_t count)
{
    float *const *p = job->partial;
    for (int k = 0; k < 3; k++)
        add_rows(job->z[2 - k], job->z[3 + k], p[k], count + 5);
    if (job->g[0])
        add_rows(job->g[0], job->g[2], p[3], count + 2);
    place_points(job, false, row, count);
}

static void place_edges(const fbm_edge_job *job, const fbm_place_row *row, size_t count)
{
    float *const *p = job->partial;
    add_rows(job->side[0], job->side[2], p[0], count + 3);
    add_rows(job->same[1], job->same[2], p[1], count + 2);
    add_rows(job->same[0], job->same[3], p[2], count + 2);
    if (job->g[0])
        add_rows(job->other[0], job->other[1], p[3], count + 3);
    place_points(job, true, row, count);
}

#undef C
#undef ALWAYS_INLINE

/* ---- Means ------------------------------------------------------------------------------------- */

static void mean2(const float *restrict a, const float *restrict b, const float *restrict g, float t,
                  float *restrict out, size_t count)
{
    if (g)
        for (size_t x = 0; x < count; x++)
            out[x] = 0.5F * (a[x] + b[x]) + t * g[x];
    else
        for (size_t x = 0; x < count; x++)
            out[x] = 0.5F * (a[x] + b[x]);
}

static void mean4(const float *restrict a, const float *restrict b, const float *restrict g, float t,
                  float *restrict out, size_t count)
{
    if (g)
        for (size_t x = 0; x < count; x++)
            out[x] = 0.25F * ((a[x] + a[x + 1]) + (b[x] + b[x + 1])) + t * g[x];
    else
        for (size_t x = 0; x < count; x++)
            out[x] = 0.25F * ((a[x] + a[x + 1]) + (b[x] + b[x + 1]));
}

static void scale2(const float *restrict a, const float *restrict b, float *restrict g, size_t count)
{
    for (size_t x = 0; x < count; x++)
        g[x] *= 0.5F * (a[x] + b[x]);
}

static void scale4(const float *restrict a, const float *restrict b, float *restrict g, size_t count)
{
    for (size_t x = 0; x < count; x++)
        g[x] *= 0.25F * ((a[x] + a[x + 1]) + (b[x] + b[x + 1]));
}

static void interleave(const float *restrict even, const float *restrict odd, float *restrict out, size_t count)
{
    for (size_t x = 0; x < count; x++) {
        out[2 * x] = even[x];
        out[2 * x + 1] = odd[x];
    }
}

extern const fbm_kernel JOIN(fbm_kernel_, FBM_KERNEL);
const fbm_kernel JOIN(fbm_kernel_, FBM_KERNEL) = {
    .name = TEXT(FBM_KERNEL),
    .noise = noise_row,
    .centres = centres,
    .edges = edges,
    .place_centres = place_centres,
    .place_edges = place_edges,
    .place_unit = place_unit,
    .place_scale = place_scale,
    .place_values = place_values,
    .strengths = strengths,
    .mean2 = mean2,
    .mean4 = mean4,
    .scale2 = scale2,
    .scale4 = scale4,
    .interleave = interleave,
};
