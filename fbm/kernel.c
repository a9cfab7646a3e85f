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
 * of the pairs. Taps follow them. Those of edges come behind those of centres.
 *
 * Coefficients lie in planes, coefficient k of vertex v at [k * stride + v], so that loops run over vertices and points
 * whatever the distance between them. What is made of a row is made in whole vectors, and rows of scratch have room for
 * that; what is read of the caller's and written to him is not. */
enum {
    LANES = 8,
    SQUARE_CENTRES = 6,
    SQUARE_EDGES = 6,
    CENTRES = 9,
    EDGES = 11,
    PLANES = CENTRES + EDGES,
    BLOCK = 1 << FBM_PLACES_SHIFT
};

static size_t least(size_t a, size_t b)
{
    return a < b ? a : b;
}

/* Whether a plane is of taps. */
ALWAYS_INLINE bool is_tap(bool square, int plane)
{
    return square ? plane % SQUARE_CENTRES >= 3 : (plane >= 5 && plane < CENTRES) || plane >= CENTRES + 7;
}

/* The loops over the coefficients of a vertex; `size` is a constant where they are called. */
ALWAYS_INLINE void mix_values(const float *restrict a, const float *restrict b, float part, size_t size,
                              float *restrict out)
{
    for (size_t k = 0; k < size; k++)
        out[k] = a[k] + part * (b[k] - a[k]);
}

/* Between the knots about an exponent, of nodes weighted by `nodes`. */
ALWAYS_INLINE void unit_vertex(const fbm_places_table *table, int node_count, const float *nodes, float hurst,
                               size_t size, float *restrict sum)
{
    const size_t all = size * (size_t)node_count;
    const float place = (hurst - FBM_PLACES_LOW) * FBM_PLACES_KNOTS_PER_UNIT;
    const int32_t floor = (int32_t)place, before = floor < FBM_PLACES_STEPS ? floor : FBM_PLACES_STEPS - 1;
    const float *from = table->values + (size_t)before * all, part = place - (float)before;
    float mixed[PLANES];
    mix_values(from, from + all, part, size, sum);
    for (int n = 1; n < node_count; n++) {
        mix_values(from + (size_t)n * size, from + all + (size_t)n * size, part, size, mixed);
        for (size_t k = 0; k < size; k++)
            sum[k] = (n > 1 ? sum[k] : nodes[0] * sum[k]) + nodes[n] * mixed[k];
    }
}

/* Vertices by eights, which are then turned into planes. */
ALWAYS_INLINE void unit_vertices(const fbm_places_table *table, bool square, int node_count, const float *nodes,
                                 const float *hurst, const float *roots, size_t size, size_t count, size_t stride,
                                 float *restrict out)
{
    float sums[LANES][PLANES];
    for (size_t x = 0; x < count; x += LANES) {
        const size_t n = least(count - x, LANES);
        for (size_t i = 0; i < n; i++)
            unit_vertex(table, node_count, nodes, hurst[x + i], size, sums[i]);
        for (size_t k = 0; k < size; k++)
            for (size_t i = 0; i < n; i++)
                out[k * stride + x + i] = is_tap(square, (int)k) ? sums[i][k] * roots[x + i] : sums[i][k];
    }
}

static void place_unit(const fbm_places_table *table, const float *nodes, const float *hurst, const float *roots,
                       size_t count, size_t stride, float *out)
{
    if (table->square)
        unit_vertices(table, true, 1, nodes, hurst, roots, SQUARE_CENTRES + SQUARE_EDGES, count, stride, out);
    else
        unit_vertices(table, false, table->nodes, nodes, hurst, roots, PLANES, count, stride, out);
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

/* ---- Points by place --------------------------------------------------------------------------- */

/* Eight floats, and where they lie, which is aligned to one float. Whatever the instruction set has, compilers make of
 * it. */
typedef float eight __attribute__((vector_size(LANES * sizeof(float))));
typedef float eight_floats __attribute__((vector_size(LANES * sizeof(float)), aligned(sizeof(float)), may_alias));
#define AT(p) ((eight) * (const eight_floats *)(p))
#define PUT(p) (*(eight_floats *)(p))

/* Room of a plane, an odd multiple of a cache line, and the vertices of one that are made at a time. */
enum { ROOM = 144, PIECE = 128, PARTS = 2 * LANES };

/* a + b, or a b, of `count` numbers, the last eight of them twice rather than one by one. */
#define COMBINE(name, operation)                                                               \
    static inline void name(const float *a, const float *b, float *restrict out, size_t count) \
    {                                                                                          \
        size_t x = 0;                                                                          \
        for (; x + LANES <= count; x += LANES)                                                 \
            PUT(out + x) = AT(a + x) operation AT(b + x);                                      \
        if (x < count && count >= LANES) {                                                     \
            x = count - LANES;                                                                 \
            PUT(out + x) = AT(a + x) operation AT(b + x);                                      \
        } else                                                                                 \
            for (; x < count; x++)                                                             \
                out[x] = a[x] operation b[x];                                                  \
    }
COMBINE(add_rows, +)
COMBINE(multiply_rows, *)
#undef COMBINE

static void place_scale(bool square, const float *strengths, size_t count, const float *unit, size_t stride, float *out)
{
    for (int k = 0; k < (square ? SQUARE_CENTRES + SQUARE_EDGES : PLANES); k++, unit += stride, out += count)
        if (is_tap(square, k))
            multiply_rows(unit, strengths, out, count);
        else
            for (size_t x = 0; x < count; x++)
                out[x] = unit[x];
}

/* Planes of a row's vertices from `vertex` on, part of the way between two rows of them. */
static void blend_planes(const fbm_place_row *row, size_t vertex, size_t vertices, size_t planes, float *restrict out)
{
    const float part = row->part;
    for (size_t k = 0; k < planes; k++, out += ROOM) {
        const float *a = row->above + k * row->stride + vertex, *b = row->below + k * row->stride + vertex;
        for (size_t x = 0; x < vertices; x += LANES)
            PUT(out + x) = AT(a + x) + part * (AT(b + x) - AT(a + x));
    }
}

/* What a job's points are made of. */
typedef struct place_rows {
    const float *at, *sums[4], *g[3]; /* side[1]; the rows that were added up; noise */
    float *out;
} place_rows;

static place_rows rows_from(const place_rows *rows, size_t x)
{
    place_rows out = {.at = rows->at + x, .out = rows->out + x};
    for (int k = 0; k < 4; k++)
        out.sums[k] = rows->sums[k] + x;
    for (int k = 0; k < 3; k++)
        out.g[k] = rows->g[k] + x;
    return out;
}

#if defined(__clang__) || __GNUC__ >= 12
#define SHUFFLE(v, ...) __builtin_shufflevector(v, v, __VA_ARGS__)
#else
typedef int32_t eight_places __attribute__((vector_size(LANES * sizeof(int32_t))));
#define SHUFFLE(v, ...) __builtin_shuffle(v, (eight_places){__VA_ARGS__})
#endif
#define ALL(p) ((p)[0] - (eight){0})
/* What eight points that begin with a block take of the vertices before and behind each; where they have two of
 * them, `last` is the first one's, taken over from the eight before. */
#define MIX(before, behind) (AT(parts) * (before) + AT(parts + PARTS) * (behind))
#define OF0(p) MIX(AT(p), AT((p) + 1))
#define OF1(p) MIX(SHUFFLE(AT(p), 0, 0, 1, 1, 2, 2, 3, 3), SHUFFLE(AT(p), 1, 1, 2, 2, 3, 3, 4, 4))
#define OF2(p) MIX(SHUFFLE(AT(p), 0, 0, 0, 0, 1, 1, 1, 1), SHUFFLE(AT(p), 1, 1, 1, 1, 2, 2, 2, 2))
#define OF3(p, last) MIX(last, ALL((p) + 1))
#define OF(p, last) (shift == 0 ? OF0(p) : shift == 1 ? OF1(p) : shift == 2 ? OF2(p) : OF3(p, last))
#define C(k) OF(c + (k)*ROOM, last[k])
/* before anything is written, so that nothing is loaded twice */
#define KEEP_LAST                                    \
    for (size_t k = 0; k < EDGES && shift == 3; k++) \
        last[k] = ALL(c + k * ROOM + 1);

ALWAYS_INLINE void centre_eight(const place_rows *rows, size_t x, const float *c, const float *parts, eight *last,
                                bool noisy, int shift, bool square)
{
    const float *near = rows->sums[0] + x, *middle = rows->sums[1] + x, *far = rows->sums[2] + x,
                *beside = rows->sums[3] + x, *own = rows->g[1] + x;
    const eight n = AT(near + 2) + AT(near + 3), a = AT(near + 1) + AT(near + 4), b = AT(middle + 2) + AT(middle + 3),
                c2 = AT(middle + 1) + AT(middle + 4), d = AT(near) + AT(near + 5), e = AT(far + 2) + AT(far + 3);
    eight sum;
    if (square)
        sum = .25F * n + ((C(0) * ((a + b) - 2.F * n) + C(1) * (c2 - n)) + C(2) * ((d + e) - 2.F * n));
    else
        sum = .25F * n + (((C(0) * (a - n) + C(1) * (b - n)) + C(2) * (c2 - n)) + (C(3) * (d - n) + C(4) * (e - n)));
    if (noisy) {
        const eight sides = AT(own) + AT(own + 2), corners = AT(beside) + AT(beside + 2);
        if (square)
            sum += C(3) * AT(own + 1) + (C(4) * (sides + AT(beside + 1)) + C(5) * corners);
        else
            sum += (C(5) * AT(own + 1) + C(6) * sides) + (C(7) * AT(beside + 1) + C(8) * corners);
    }
    KEEP_LAST
    PUT(rows->out + x) = sum;
}

ALWAYS_INLINE void edge_eight(const place_rows *rows, size_t x, const float *c, const float *parts, eight *last,
                              bool noisy, int shift, bool square)
{
    const float *at = rows->at + x, *beside = rows->sums[0] + x, *near = rows->sums[1] + x, *far = rows->sums[2] + x,
                *other = rows->sums[3] + x;
    const eight n = AT(at + 1) + AT(at + 2), a = AT(near + 1), b = AT(beside + 1) + AT(beside + 2),
                c2 = AT(near) + AT(near + 2), d = AT(far + 1), e = AT(at) + AT(at + 3), f = AT(far) + AT(far + 2),
                g = AT(beside) + AT(beside + 3);
    eight sum;
    if (square) {
        const eight m = n + a;
        sum = .25F * m + ((C(0) * ((b + c2) - 2.F * m) + C(1) * ((d + e) - m)) + C(2) * ((f + g) - 2.F * m));
    } else
        sum = .5F * n + (((C(0) * (a - n) + C(1) * (b - 2.F * n)) + (C(2) * (c2 - 2.F * n) + C(3) * (d - n))) +
                         ((C(4) * (e - n) + C(5) * (f - 2.F * n)) + C(6) * (g - 2.F * n)));
    if (noisy) {
        const float *above = rows->g[0] + x, *own = rows->g[1] + x, *below = rows->g[2] + x;
        const eight corners = AT(other + 1) + AT(other + 2), sides = AT(own) + AT(own + 2),
                    ends = AT(above + 1) + AT(below + 1);
        if (square)
            sum += C(3) * AT(own + 1) + (C(4) * corners + C(5) * (sides + ends));
        else
            sum += (C(7) * AT(own + 1) + C(8) * corners) + (C(9) * sides + C(10) * ends);
    }
    KEEP_LAST
    PUT(rows->out + x) = sum;
}

ALWAYS_INLINE void make_eights(const place_rows *rows, size_t count, const float *c, const float *parts, bool edges,
                               bool noisy, int shift, bool square)
{
    const place_rows here = *rows; /* which nothing that is written can change */
    eight last[EDGES];
    for (size_t k = 0; k < EDGES; k++)
        last[k] = ALL(c + k * ROOM);
    for (size_t x = 0; x < count; x += LANES, c += LANES >> shift)
        if (edges)
            edge_eight(&here, x, c, parts, last, noisy, shift, square);
        else
            centre_eight(&here, x, c, parts, last, noisy, shift, square);
}

#undef KEEP_LAST
#undef C
#undef OF
#undef OF0
#undef OF1
#undef OF2
#undef OF3
#undef MIX
#undef ALL
#undef SHUFFLE

/* Points of a job by eights that begin with a block, or, of one that has not eight points, by one that begins within;
 * at `parts` are the shares of the vertices before, and PARTS behind those of the next ones. Not inlined, for
 * coefficients are then at fixed distances from one pointer, which a processor adds as it loads. */
typedef void eights(const place_rows *rows, size_t count, const float *coefficients, const float *parts);
#define EIGHTS(name, edges, noisy, shift, square)                                                               \
    static __attribute__((noinline)) void name(const place_rows *rows, size_t count, const float *coefficients, \
                                               const float *parts)                                              \
    {                                                                                                           \
        make_eights(rows, count, coefficients, parts, edges, noisy, shift, square);                             \
    }
#define EACH(name, edges, noisy)                  \
    EIGHTS(name##0, edges, noisy, 0, false)       \
    EIGHTS(name##1, edges, noisy, 1, false)       \
    EIGHTS(name##2, edges, noisy, 2, false)       \
    EIGHTS(name##3, edges, noisy, 3, false)       \
    EIGHTS(name##0_square, edges, noisy, 0, true) \
    EIGHTS(name##1_square, edges, noisy, 1, true) \
    EIGHTS(name##2_square, edges, noisy, 2, true) \
    EIGHTS(name##3_square, edges, noisy, 3, true)
#define NAMES(name)                                                        \
    {                                                                      \
        {name##0, name##1, name##2, name##3},                              \
        {                                                                  \
            name##0_square, name##1_square, name##2_square, name##3_square \
        }                                                                  \
    }
EACH(smooth_centres, false, false)
EACH(noisy_centres, false, true)
EACH(smooth_edges, true, false)
EACH(noisy_edges, true, true)
/* by [edges][noisy][square][shift] */
static eights *const all_eights[2][2][2][FBM_PLACES_SHIFT + 1] = {{NAMES(smooth_centres), NAMES(noisy_centres)},
                                                                  {NAMES(smooth_edges), NAMES(noisy_edges)}};
#undef EIGHTS
#undef EACH
#undef NAMES

/* Shares of the vertices before and behind a row's points, which begin anew with every block. */
static void make_parts(const fbm_place_row *row, float parts[2 * PARTS])
{
    const int32_t block = 1 << row->shift;
    const float unit = 1 / (float)(2 * block);
    for (int32_t x = 0; x < PARTS; x++) {
        parts[PARTS + x] = (float)(2 * (x & (block - 1)) + row->half) * unit;
        parts[x] = 1 - parts[PARTS + x];
    }
}

/* What an eight makes beyond its block, the next makes again. */
static void walk(const place_rows *rows, bool edges, bool noisy, const fbm_place_row *row, size_t count)
{
    eights *const make = all_eights[edges][noisy][row->square][row->shift];
    const size_t coefficients = row->square ? SQUARE_CENTRES : edges ? EDGES : CENTRES;
    const size_t block = (size_t)1 << row->shift;
    _Alignas(64) float planes[EDGES * ROOM];
    float parts[2 * PARTS];
    make_parts(row, parts);
    for (size_t x = 0, end; x < count; x = end) {
        const size_t first = (row->first + x) >> row->shift, offset = (row->first + x) & (block - 1);
        end = least(count, ((first + PIECE) << row->shift) - row->first);
        blend_planes(row, first, ((row->first + end - 1) >> row->shift) + 2 - first, coefficients, planes);
        place_rows here = rows_from(rows, x);
        if (offset) {
            make(&here, LANES, planes, parts + offset);
            x += block - offset;
            here = rows_from(rows, x);
        }
        if (x < end)
            make(&here, end - x, planes + (offset > 0), parts);
    }
}

static void place_centres(const fbm_centre_job *job, const fbm_place_row *row, size_t count)
{
    float *const *p = job->partial;
    const float *noise = job->g[0] ? job->g[1] : p[3];
    for (int k = 0; k < 3; k++)
        add_rows(job->z[2 - k], job->z[3 + k], p[k], count + 5);
    if (job->g[0])
        add_rows(job->g[0], job->g[2], p[3], count + 2);
    const place_rows rows = {p[3], {p[0], p[1], p[2], p[3]}, {noise, noise, noise}, job->out};
    walk(&rows, false, job->g[0] != NULL, row, count);
}

static void place_edges(const fbm_edge_job *job, const fbm_place_row *row, size_t count)
{
    float *const *p = job->partial;
    const float *const *g = job->g[0] ? job->g : (const float *const *)p;
    add_rows(job->side[0], job->side[2], p[0], count + 3);
    add_rows(job->same[1], job->same[2], p[1], count + 2);
    add_rows(job->same[0], job->same[3], p[2], count + 2);
    if (job->g[0])
        add_rows(job->other[0], job->other[1], p[3], count + 3);
    const place_rows rows = {job->side[1], {p[0], p[1], p[2], p[3]}, {g[0], g[1], g[2]}, job->out};
    walk(&rows, true, job->g[0] != NULL, row, count);
}

#undef AT
#undef PUT
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
    .strengths = strengths,
    .mean2 = mean2,
    .mean4 = mean4,
    .scale2 = scale2,
    .scale4 = scale4,
    .interleave = interleave,
};
