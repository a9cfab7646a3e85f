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
    .mean2 = mean2,
    .mean4 = mean4,
    .scale2 = scale2,
    .scale4 = scale4,
    .interleave = interleave,
};
