#include "fbm/statistics.h"

#include "fbm/elementary.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

const int fbm_directions[FBM_DIRECTIONS][2] = {{1, 0}, {0, 1}, {1, 1}, {1, -1}};

/* ---- sums ---- */

enum { LANES = 4 }; /* interleaved sums, in a fixed order, that a compiler can keep side by side */

typedef struct lanes {
    double count[LANES], first[LANES], second[LANES], third[LANES], fourth[LANES];
} lanes;

static inline double increment_at(const float *a, const float *b, const float *c, size_t k)
{
    return c ? ((double)a[k] - (double)b[k]) + ((double)c[k] - (double)b[k]) : (double)b[k] - (double)a[k];
}

static inline void add_one(double v, bool shape, size_t lane, lanes *sum)
{
    bool known = v - v == 0; /* neither NaN nor infinite */
    double d = known ? v : 0, square = d * d;
    sum->count[lane] += known ? 1 : 0;
    sum->second[lane] += square;
    if (shape) {
        sum->first[lane] += d;
        sum->third[lane] += square * d;
        sum->fourth[lane] += square * square;
    }
}

/* `shape` and whether c is NULL are known to callers, so that each of them gets a loop of its own. */
static inline void add_row(const float *a, const float *b, const float *c, size_t count, bool shape, lanes *sum)
{
    lanes own = *sum; /* in registers */
    size_t k = 0;
    for (; k + LANES <= count; k += LANES)
        for (size_t lane = 0; lane < LANES; lane++)
            add_one(increment_at(a, b, c, k + lane), shape, lane, &own);
    for (; k < count; k++)
        add_one(increment_at(a, b, c, k), shape, k % LANES, &own);
    *sum = own;
}

static void add_any_row(const float *a, ptrdiff_t step, int order, size_t count, bool shape, lanes *sum)
{
    if (order == 1 && !shape)
        add_row(a, a + step, NULL, count, false, sum);
    else if (order == 1)
        add_row(a, a + step, NULL, count, true, sum);
    else if (!shape)
        add_row(a, a + step, a + 2 * step, count, false, sum);
    else
        add_row(a, a + step, a + 2 * step, count, true, sum);
}

static double total(const double lane[LANES])
{
    return (lane[0] + lane[1]) + (lane[2] + lane[3]);
}

void fbm_increments_add(const float *heights, size_t width, size_t height, size_t lag, int order, int direction,
                        bool shape, fbm_moments *moments)
{
    size_t span = lag * (size_t)order;
    bool across = fbm_directions[direction][0] != 0, down = fbm_directions[direction][1] != 0;
    bool rising = fbm_directions[direction][1] < 0;
    if ((across && span >= width) || (down && span >= height))
        return;
    ptrdiff_t step =
        (ptrdiff_t)lag * fbm_directions[direction][0] + (ptrdiff_t)(lag * width) * fbm_directions[direction][1];
    size_t columns = across ? width - span : width, rows = down ? height - span : height;
    lanes sum = {{0}, {0}, {0}, {0}, {0}};
    for (size_t y = 0; y < rows; y++) {
        const float *a = heights + (y + (rising ? span : 0)) * width;
        add_any_row(a, step, order, columns, shape, &sum);
    }
    const fbm_moments part = {(uint64_t)total(sum.count), total(sum.first), total(sum.second), total(sum.third),
                              total(sum.fourth)};
    fbm_moments_merge(moments, &part);
}

void fbm_moments_merge(fbm_moments *sum, const fbm_moments *part)
{
    sum->count += part->count;
    sum->first += part->first;
    sum->second += part->second;
    sum->third += part->third;
    sum->fourth += part->fourth;
}

void fbm_positions_add(const float *heights, size_t width, size_t height, uint64_t x, uint64_t y,
                       fbm_positions *positions)
{
    for (size_t j = 1; j + 1 < height; j++)
        for (size_t i = 1; i + 1 < width; i++) {
            const float *at = heights + j * width + i;
            double middle = 2 * (double)*at;
            double row = (double)at[-1] + (double)at[1] - middle;
            double column = (double)*(at - width) + (double)at[width] - middle;
            if (!isfinite(row + column))
                continue;
            size_t position = (size_t)((y + j) % 8 * 8 + (x + i) % 8);
            positions->rows[position] += row * row;
            positions->columns[position] += column * column;
            positions->count[position]++;
        }
}

/* ---- fBm's covariance of increments ---- */

enum { TABLE = 256, NEAR = 24, AREA_STEPS = 12, AREA_REACH = 6 };

/* E|Z(x + r) - Z(x)|^2 at lattice displacements r, for delta = 1. */
typedef struct variogram {
    double hurst, cell_x, cell_y;
    bool area;
    double *table; /* (TABLE + 1)^2 */
} variogram;

static double square_at(const variogram *v, double x, double y)
{
    x *= v->cell_x;
    y *= v->cell_y;
    return x * x + y * y;
}

static double power_at(const variogram *v, double x, double y)
{
    return fbm_pow(square_at(v, x, y), v->hurst);
}

/* The power of means over cells far off, of that of points. The difference of two uniform points of a cell has the
 * triangular density, of which only the variance counts there: the Laplacian of r^2H is 4 H^2 r^(2H - 2), half of it
 * times 1/6. */
static double of_means(const variogram *v, double square, double power)
{
    return power * (1 + v->hurst * v->hurst / 3 / square * v->cell_x * v->cell_y);
}

/* The same for means over cells, but for a constant. */
static double power_of_means(const variogram *v, int x, int y)
{
    if (x > AREA_REACH || y > AREA_REACH)
        return of_means(v, square_at(v, x, y), power_at(v, x, y));
    double sum = 0, weights = 0;
    for (int a = 0; a < AREA_STEPS; a++)
        for (int b = 0; b < AREA_STEPS; b++) {
            double u = 2 * (a + 0.5) / AREA_STEPS - 1, w = 2 * (b + 0.5) / AREA_STEPS - 1;
            double weight = (1 - fabs(u)) * (1 - fabs(w));
            sum += weight * power_at(v, x + u, y + w);
            weights += weight;
        }
    return sum / weights;
}

/* Near exponent 1 second differences are small remainders, for which means are not known well enough; their
 * correlations are then as those of points. */
static bool variogram_init(variogram *v, const fbm_sampling *s, double hurst, int reach)
{
    *v =
        (variogram){.hurst = hurst, .cell_x = s->cell_x, .cell_y = s->cell_y, .area = s->area && fabs(hurst - 1) > 0.1};
    v->table = calloc((TABLE + 1) * (TABLE + 1), sizeof *v->table);
    double *squares = malloc((size_t)(reach + 1) * sizeof *squares);
    for (int y = 0; v->table && squares && y <= reach; y++) {
        double *row = v->table + y * (TABLE + 1);
        for (int x = 0; x <= reach; x++)
            squares[x] = square_at(v, x, y);
        fbm_pow_all(squares, hurst, row, (size_t)reach + 1);
        for (int x = 0; v->area && x <= reach; x++)
            row[x] = x > AREA_REACH || y > AREA_REACH ? of_means(v, squares[x], row[x]) : power_of_means(v, x, y);
    }
    bool good = v->table && squares;
    free(squares);
    if (!good) {
        free(v->table);
        v->table = NULL;
    }
    return good;
}

static double variogram_at(const variogram *v, int x, int y)
{
    x = abs(x);
    y = abs(y);
    return x <= TABLE && y <= TABLE ? v->table[y * (TABLE + 1) + x] : power_at(v, x, y);
}

/* One kind of increment. */
typedef struct increment {
    int order, lag, direction;
} increment;

static const int stencils[3][3] = {{0}, {-1, 1, 0}, {1, -2, 1}};

/* Displacements of the places that two increments have to do with, and their weights. */
typedef struct pairing {
    int count, x[9], y[9];
    double weight[9];
} pairing;

static pairing pair_up(increment a, increment b)
{
    pairing p = {.count = 0};
    for (int i = 0; i <= a.order; i++)
        for (int j = 0; j <= b.order; j++) {
            p.x[p.count] = j * b.lag * fbm_directions[b.direction][0] - i * a.lag * fbm_directions[a.direction][0];
            p.y[p.count] = j * b.lag * fbm_directions[b.direction][1] - i * a.lag * fbm_directions[a.direction][1];
            p.weight[p.count++] = 0.5 * stencils[a.order][i] * stencils[b.order][j];
        }
    return p;
}

/* Covariance of two increments r apart: only the variogram is needed, for the weights add up to 0. */
static double paired_covariance(const variogram *v, const pairing *p, int rx, int ry)
{
    double sum = 0;
    for (int k = 0; k < p->count; k++)
        sum -= p->weight[k] * variogram_at(v, rx + p->x[k], ry + p->y[k]);
    return sum;
}

static double covariance_at(const variogram *v, increment a, increment b, int rx, int ry)
{
    pairing p = pair_up(a, b);
    return paired_covariance(v, &p, rx, ry);
}

/* Positions that an increment has in the raster. */
static void positions_of(const fbm_sampling *s, increment a, double size[2])
{
    double span = a.order * a.lag;
    size[0] = s->width - (fbm_directions[a.direction][0] ? span : 0);
    size[1] = s->height - (fbm_directions[a.direction][1] ? span : 0);
}

/* Displacements at which correlations are summed: all near ones, then rings of cells twice as wide as those before. */
typedef struct node {
    int x, y;
    double weight; /* displacements that it stands for, times the share of the raster that has both ends */
} node;

static double share_at(int x, int y, double width, double height)
{
    double a = 1 - abs(x) / width, b = 1 - abs(y) / height;
    return a > 0 && b > 0 ? a * b : 0;
}

static size_t ring(node *nodes, size_t count, int step, double width, double height)
{
    for (int j = -NEAR; j < NEAR; j++)
        for (int i = -NEAR; i < NEAR; i++) {
            bool inside = step > 1 && i >= -NEAR / 2 && i < NEAR / 2 && j >= -NEAR / 2 && j < NEAR / 2;
            /* the first of a cell's two middles: what it shifts cancels with the cell across */
            int x = step * i + (step - 1) / 2, y = step * j + (step - 1) / 2;
            double share = inside ? 0 : share_at(x, y, width, height);
            if (share > 0)
                nodes[count++] = (node){x, y, share * step * step};
        }
    return count;
}

enum { RINGS = 24, RING_NODES = 4 * NEAR * NEAR };

/* Increments of order 2 know nothing of each other beyond some ten lags: rho^2 falls as r^(4H - 8). */
static node *make_nodes(const fbm_sampling *s, size_t *count)
{
    node *nodes = malloc(RINGS * (size_t)RING_NODES * sizeof *nodes);
    *count = 0;
    double limit = s->width > s->height ? s->width : s->height;
    if (s->order == 2 && limit > 128)
        limit = 128;
    for (int k = 0; nodes && k < RINGS && (k == 0 || NEAR * ldexp(1, k - 1) < limit); k++)
        *count = ring(nodes, *count, 1 << k, s->width, s->height);
    return nodes;
}

/* Sum of w(r) rho(r)^power over displacements: with n! / N, the covariance of two means of Hermite polynomials. */
static double correlation_sum(const variogram *v, const node *nodes, size_t count, increment a, increment b, int power)
{
    /* above exponent 1 it is +1/2 |h|^2H that is a covariance of second differences */
    double scale = (v->hurst > 1 ? -1 : 1) / sqrt(covariance_at(v, a, a, 0, 0) * covariance_at(v, b, b, 0, 0));
    const pairing pair = pair_up(a, b);
    double sum = 0;
    for (size_t k = 0; k < count; k++) {
        double rho = scale * paired_covariance(v, &pair, nodes[k].x, nodes[k].y), product = rho;
        for (int p = 1; p < power; p++)
            product *= rho;
        sum += nodes[k].weight * product;
    }
    return sum;
}

static increment increment_of(int order, size_t value)
{
    return (increment){order, 1 << (value / FBM_DIRECTIONS), (int)(value % FBM_DIRECTIONS)};
}

static bool fits(const fbm_sampling *s, increment a)
{
    double size[2];
    positions_of(s, a, size);
    return size[0] >= 1 && size[1] >= 1;
}

/* Exponents beyond this give increments whose correlations do not add up. */
static double covariance_hurst(const fbm_sampling *s, double hurst)
{
    double most = s->order == 2 ? 1.45 : 0.99;
    hurst = hurst > most ? most : hurst < 0.01 ? 0.01 : hurst;
    return fabs(hurst - 1) < 1e-4 ? 0.9999 : hurst; /* at 1 all increments of order 2 are 0 */
}

static double positions_count(const fbm_sampling *s, increment a)
{
    double size[2];
    positions_of(s, a, size);
    return size[0] * size[1];
}

bool fbm_increment_covariance(const fbm_sampling *s, double hurst, double covariance[FBM_FIT_VALUES][FBM_FIT_VALUES])
{
    variogram v;
    size_t count;
    node *nodes = make_nodes(s, &count);
    bool good = variogram_init(&v, s, covariance_hurst(s, hurst), TABLE) && nodes;
    memset(covariance, 0, FBM_FIT_VALUES * sizeof *covariance);
    for (size_t i = 0; good && i < FBM_FIT_VALUES; i++)
        for (size_t j = i; j < FBM_FIT_VALUES; j++) {
            increment a = increment_of(s->order, i), b = increment_of(s->order, j);
            if (!fits(s, a) || !fits(s, b))
                continue;
            double n = sqrt(positions_count(s, a) * positions_count(s, b));
            covariance[i][j] = covariance[j][i] = 2 / n * correlation_sum(&v, nodes, count, a, b, 2);
        }
    free(v.table);
    free(nodes);
    return good;
}

/* ---- fits ---- */

enum { UNKNOWNS = 1 + FBM_DIRECTIONS, MIN_COUNT = 64, ROUNDS = 12 };

/* Cholesky's factor of a symmetric positive matrix of n rows, in place (lower half); false where it has none. */
static bool factorize(double *m, int n)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) {
            double sum = m[i * n + j];
            for (int k = 0; k < j; k++)
                sum -= m[i * n + k] * m[j * n + k];
            if (i == j && !(sum > 0))
                return false;
            m[i * n + j] = i == j ? sqrt(sum) : sum / m[j * n + j];
        }
    return true;
}

/* Solves L x = b in place. */
static void forward(const double *factor, int n, double *b)
{
    for (int i = 0; i < n; i++) {
        for (int k = 0; k < i; k++)
            b[i] -= factor[i * n + k] * b[k];
        b[i] /= factor[i * n + i];
    }
}

static void backward(const double *factor, int n, double *b)
{
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++)
            b[i] -= factor[k * n + i] * b[k];
        b[i] /= factor[i * n + i];
    }
}

/* The values that take part in a fit. */
typedef struct observations {
    int count;
    size_t index[FBM_FIT_VALUES];
    double mean[FBM_FIT_VALUES];  /* mean squares without the noise's share */
    double scale[FBM_FIT_VALUES]; /* the relative error's, for what is missing and for what was taken off */
    int lags;
    bool hidden; /* by noise, at some lag */
} observations;

/* White noise of variance 1 leaves the sum of its squared weights in an increment. */
static double noise_gain(int order)
{
    return order == 2 ? 6 : 2;
}

/* A lag is taken where all directions tell more than four times the noise. */
static observations observe(const fbm_sampling *s, const fbm_moment_table moments)
{
    observations o = {0};
    double share = s->noise * noise_gain(s->order);
    for (int lag = 0; lag < FBM_FIT_LAGS; lag++) {
        observations next = o;
        bool many = true, loud = true;
        for (int d = 0; d < FBM_DIRECTIONS; d++) {
            size_t value = (size_t)(lag * FBM_DIRECTIONS + d);
            const fbm_moments *m = &moments[value];
            double raw = m->count ? m->second / (double)m->count : 0, clean = raw - share;
            double whole = positions_count(s, increment_of(s->order, value));
            many = many && m->count >= MIN_COUNT;
            loud = loud && raw > 4 * share && raw > 0 && isfinite(raw);
            next.index[next.count] = value;
            next.mean[next.count] = clean;
            next.scale[next.count++] = loud && many ? raw / clean * sqrt(whole / (double)m->count) : 0;
        }
        o.hidden = o.hidden || (many && !loud);
        next.hidden = o.hidden;
        next.lags++;
        if (many && loud)
            o = next;
    }
    return o;
}

/* The logarithm of the mean square that fBm with delta 1 has, for each value. All displacements are powers of two, and
 * those along both diagonals alike. */
static void model_logs(const fbm_sampling *s, const observations *o, double hurst, double *logs)
{
    enum { POWERS = FBM_FIT_LAGS + 1, AXES = 3 };
    variogram v = {.hurst = hurst, .cell_x = s->cell_x, .cell_y = s->cell_y, .area = s->area};
    double origin = v.area ? power_of_means(&v, 0, 0) : 0, at[POWERS][AXES];
    for (int k = 0; k < POWERS; k++)
        for (int axis = 0; axis < AXES; axis++) {
            int x = fbm_directions[axis][0] << k, y = fbm_directions[axis][1] << k;
            at[k][axis] = v.area ? power_of_means(&v, x, y) : power_at(&v, x, y);
        }
    for (int k = 0; k < o->count; k++) {
        size_t lag = o->index[k] / FBM_DIRECTIONS, direction = o->index[k] % FBM_DIRECTIONS;
        size_t axis = direction < AXES ? direction : AXES - 1;
        double one = at[lag][axis] - origin, two = at[lag + 1][axis] - origin;
        logs[k] = log(fabs(s->order == 2 ? 4 * one - two : one));
    }
}

static double not_one(double hurst)
{
    return fabs(hurst - 1) < 1e-5 ? 1 - 1e-5 : hurst;
}

/* Residuals and the columns of the design, each multiplied by the inverse of the covariance's factor. */
typedef struct system {
    int count;
    double factor[FBM_FIT_VALUES * FBM_FIT_VALUES];
    double columns[UNKNOWNS][FBM_FIT_VALUES], residual[FBM_FIT_VALUES];
    double normal[UNKNOWNS * UNKNOWNS]; /* factored */
} system_t;

/* Mean squares of first differences are all but the same number where H is high, more so than their covariance is known
 * from sums over coarse cells: a little independent error, which only widens what is stated, keeps the least squares
 * from taking their differences for knowledge. */
static const double first_order_ridge = 0.03;

static bool weigh(const observations *o, int order, const double covariance[FBM_FIT_VALUES][FBM_FIT_VALUES],
                  system_t *e)
{
    double ridge = order == 1 ? first_order_ridge : 0;
    e->count = o->count;
    for (int i = 0; i < o->count; i++)
        for (int j = 0; j < o->count; j++)
            e->factor[i * o->count + j] =
                o->scale[i] * o->scale[j] * covariance[o->index[i]][o->index[j]] * (i == j ? 1 + ridge : 1);
    return factorize(e->factor, o->count);
}

/* One step of Gauss and Newton for (H, 2 log amplitude by direction). */
static bool improve(const fbm_sampling *s, const observations *o,
                    const double covariance[FBM_FIT_VALUES][FBM_FIT_VALUES], system_t *e, double unknown[UNKNOWNS])
{
    double low[FBM_FIT_VALUES], high[FBM_FIT_VALUES], here[FBM_FIT_VALUES];
    const double step = 1e-3;
    double hurst = not_one(unknown[0]);
    model_logs(s, o, hurst, here);
    model_logs(s, o, not_one(hurst - step), low);
    model_logs(s, o, not_one(hurst + step), high);
    memset(e->columns, 0, sizeof e->columns);
    for (int k = 0; k < o->count; k++) {
        size_t direction = o->index[k] % FBM_DIRECTIONS;
        /* the mean of a logarithm is lower than the logarithm of the mean by half its variance */
        double bias = 0.5 * o->scale[k] * o->scale[k] * covariance[o->index[k]][o->index[k]];
        e->residual[k] = log(o->mean[k]) + bias - here[k] - unknown[1 + direction];
        e->columns[0][k] = (high[k] - low[k]) / (not_one(hurst + step) - not_one(hurst - step));
        e->columns[1 + direction][k] = 1;
    }
    forward(e->factor, e->count, e->residual);
    double right[UNKNOWNS];
    for (int i = 0; i < UNKNOWNS; i++)
        forward(e->factor, e->count, e->columns[i]);
    for (int i = 0; i < UNKNOWNS; i++) {
        right[i] = 0;
        for (int k = 0; k < e->count; k++)
            right[i] += e->columns[i][k] * e->residual[k];
        for (int j = 0; j < UNKNOWNS; j++) {
            double sum = 0;
            for (int k = 0; k < e->count; k++)
                sum += e->columns[i][k] * e->columns[j][k];
            e->normal[i * UNKNOWNS + j] = sum;
        }
    }
    if (!factorize(e->normal, UNKNOWNS))
        return false;
    forward(e->normal, UNKNOWNS, right);
    backward(e->normal, UNKNOWNS, right);
    for (int i = 0; i < UNKNOWNS; i++)
        unknown[i] += right[i];
    double most = s->order == 2 ? 1.95 : 1.2;
    unknown[0] = unknown[0] > most ? most : unknown[0] < 0.002 ? 0.002 : unknown[0];
    return isfinite(unknown[0]);
}

/* Variance of a linear function of the unknowns. */
static double variance_of(const system_t *e, const double gradient[UNKNOWNS])
{
    double half[UNKNOWNS], sum = 0;
    memcpy(half, gradient, sizeof half);
    forward(e->normal, UNKNOWNS, half);
    for (int i = 0; i < UNKNOWNS; i++)
        sum += half[i] * half[i];
    return sum;
}

static double covariance_of(const system_t *e, const double a[UNKNOWNS], const double b[UNKNOWNS])
{
    double sums[UNKNOWNS], differences[UNKNOWNS];
    for (int i = 0; i < UNKNOWNS; i++) {
        sums[i] = a[i] + b[i];
        differences[i] = a[i] - b[i];
    }
    return 0.25 * (variance_of(e, sums) - variance_of(e, differences));
}

/* The mean amplitude and its second harmonic by direction. Amplitudes are twice the logarithm of standard deviations;
 * with four directions d the least squares of m + c cos 2a + s sin 2a are m = the mean, when rows, columns and
 * diagonals lie at right angles and at half of them; other cells tilt the diagonals. */
static void amplitudes(const fbm_sampling *s, double mean[UNKNOWNS], double cosine[UNKNOWNS], double sine[UNKNOWNS])
{
    double tilt = atan2(s->cell_y, s->cell_x), c = cos(2 * tilt), d = sin(2 * tilt);
    memset(mean, 0, UNKNOWNS * sizeof *mean);
    memset(cosine, 0, UNKNOWNS * sizeof *cosine);
    memset(sine, 0, UNKNOWNS * sizeof *sine);
    /* rows give m + C, columns m - C, the diagonals m + C c +- S d */
    cosine[1] = 0.5;
    cosine[2] = -0.5;
    sine[3] = 0.5 / d;
    sine[4] = -0.5 / d;
    for (int k = 1; k < UNKNOWNS; k++)
        mean[k] = 0.25;
    /* the diagonals' part of C */
    mean[1] -= 0.25 * c;
    mean[2] += 0.25 * c;
}

static void tell_anisotropy(const fbm_sampling *s, const system_t *e, const double unknown[UNKNOWNS], fbm_fit *out)
{
    double mean[UNKNOWNS], cosine[UNKNOWNS], sine[UNKNOWNS], c = 0, d = 0;
    amplitudes(s, mean, cosine, sine);
    for (int k = 1; k < UNKNOWNS; k++) {
        c += cosine[k] * unknown[k];
        d += sine[k] * unknown[k];
    }
    double cc = variance_of(e, cosine), dd = variance_of(e, sine), cd = covariance_of(e, cosine, sine);
    double length = sqrt(c * c + d * d);
    out->anisotropy =
        exp(length); /* from +length to -length in the variance's logarithm, half of it in the deviation's */
    double along = length > 0 ? (c * c * cc + 2 * c * d * cd + d * d * dd) / (length * length) : cc;
    out->anisotropy_error = out->anisotropy * sqrt(along > 0 ? along : 0);
    out->angle = 0.5 * atan2(d, c);
    double determinant = cc * dd - cd * cd;
    out->isotropy_chance = determinant > 0 ? exp(-0.5 * (c * c * dd - 2 * c * d * cd + d * d * cc) / determinant) : 1;
}

static void tell(const fbm_sampling *s, const observations *o, const system_t *e, const double unknown[UNKNOWNS],
                 fbm_fit *out)
{
    const double hurst_alone[UNKNOWNS] = {1};
    double mean[UNKNOWNS], cosine[UNKNOWNS], sine[UNKNOWNS], log_variance = 0, chi = 0;
    out->hurst = unknown[0];
    out->hurst_error = sqrt(variance_of(e, hurst_alone));
    amplitudes(s, mean, cosine, sine);
    for (int k = 1; k < UNKNOWNS; k++)
        log_variance += mean[k] * unknown[k];
    for (int k = 0; k < o->count; k++)
        chi += e->residual[k] * e->residual[k];
    out->freedom = o->count - UNKNOWNS;
    out->misfit = out->freedom > 0 ? chi / out->freedom : 0;
    out->lags = o->lags;
    if (out->hurst >= 0.995)
        out->refusal = FBM_FIT_SMOOTH;
    else {
        out->delta = exp(0.5 * log_variance);
        out->delta_error = out->delta * 0.5 * sqrt(variance_of(e, mean));
    }
    tell_anisotropy(s, e, unknown, out);
}

/* A first guess: the slope of the mean logarithms. */
static double first_guess(const observations *o)
{
    double sx = 0, sy = 0, sxx = 0, sxy = 0;
    for (int k = 0; k < o->count; k++) {
        double x = (double)(o->index[k] / FBM_DIRECTIONS), y = log(o->mean[k]) / (2 * log(2.0));
        sx += x;
        sy += y;
        sxx += x * x;
        sxy += x * y;
    }
    double slope = (o->count * sxy - sx * sy) / (o->count * sxx - sx * sx);
    return slope > 1.9 ? 1.9 : slope < 0.02 ? 0.02 : slope;
}

bool fbm_fit_increments(const fbm_sampling *s, const fbm_moment_table moments,
                        const double given[FBM_FIT_VALUES][FBM_FIT_VALUES], fbm_fit *out)
{
    observations o = observe(s, moments);
    *out = (fbm_fit){.refusal = o.hidden ? FBM_FIT_FLAT : FBM_FIT_SMALL};
    if (o.lags < 2)
        return true;
    double own[FBM_FIT_VALUES][FBM_FIT_VALUES], unknown[UNKNOWNS] = {first_guess(&o)};
    system_t e;
    for (int pass = 0; pass < (given ? 1 : 2); pass++) {
        if (!given && !fbm_increment_covariance(s, unknown[0], own))
            return false;
        const double(*covariance)[FBM_FIT_VALUES] = given ? given : (const double(*)[FBM_FIT_VALUES])own;
        bool good = weigh(&o, s->order, covariance, &e);
        double before = (double)NAN;
        for (int round = 0; good && round < ROUNDS && !(fabs(unknown[0] - before) < 1e-9); round++) {
            before = unknown[0];
            good = improve(s, &o, covariance, &e, unknown);
        }
        if (!good)
            return true;
    }
    out->refusal = FBM_FIT_GOOD;
    tell(s, &o, &e, unknown, out);
    return true;
}

/* ---- normality and lattice positions ---- */

static void shape(const fbm_moments *m, double noise, double *skewness, double *kurtosis)
{
    double n = (double)m->count, mean = m->first / n, variance = m->second / n - mean * mean;
    double third = m->third / n - 3 * mean * m->second / n + 2 * mean * mean * mean;
    double fourth =
        m->fourth / n - 4 * mean * m->third / n + 6 * mean * mean * m->second / n - 3 * mean * mean * mean * mean;
    double scale = variance - noise > 0.25 * variance ? variance - noise : variance;
    *skewness = third / (scale * sqrt(scale));
    *kurtosis = (fourth / (variance * variance) - 3) * (variance / scale) * (variance / scale);
}

bool fbm_normality_of(const fbm_sampling *s, const fbm_moment_table moments, int lag, double hurst, fbm_normality *out)
{
    const fbm_moments *m = &moments[lag * FBM_DIRECTIONS];
    *out = (fbm_normality){0};
    if (m[0].count < 1000 || m[1].count < 1000 || !(m[0].second > 0) || !(m[1].second > 0))
        return true;
    variogram v;
    size_t count;
    node *nodes = make_nodes(s, &count);
    bool good = variogram_init(&v, s, covariance_hurst(s, hurst), TABLE) && nodes;
    double third = 0, fourth = 0;
    for (int i = 0; good && i < 2; i++) {
        double skewness, kurtosis;
        shape(&m[i], s->noise * noise_gain(s->order), &skewness, &kurtosis);
        out->skewness += 0.5 * skewness;
        out->kurtosis += 0.5 * kurtosis;
        for (int j = 0; j < 2; j++) {
            increment a = {s->order, 1 << lag, i}, b = {s->order, 1 << lag, j};
            double n = sqrt((double)m[i].count * (double)m[j].count);
            third += 0.25 / n * 6 * correlation_sum(&v, nodes, count, a, b, 3);
            fourth += 0.25 / n * 24 * correlation_sum(&v, nodes, count, a, b, 4);
        }
    }
    free(v.table);
    free(nodes);
    if (!good || !(third > 0) || !(fourth > 0))
        return good;
    out->known = true;
    out->skewness_error = sqrt(third);
    out->kurtosis_error = sqrt(fourth);
    double a = out->skewness / out->skewness_error, b = out->kurtosis / out->kurtosis_error;
    out->chance = exp(-0.5 * (a * a + b * b));
    return true;
}

/* z that a normal variable exceeds with this chance, by halving. */
static double exceeded_by(double chance)
{
    double low = 0, high = 10;
    for (int k = 0; k < 60; k++) {
        double middle = 0.5 * (low + high);
        *(0.5 * erfc(middle / sqrt(2)) > chance ? &low : &high) = middle;
    }
    return low;
}

/* Relative variance of a position's mean, times its count: increments along rows and columns, `step` samples apart. -1:
 * out of memory. */
static double position_variance(double hurst, int step)
{
    const fbm_sampling s = {.order = 2, .width = 1, .height = 1, .cell_x = 1, .cell_y = 1};
    variogram v;
    double sum = 0;
    const increment kinds[2] = {{2, 1, 0}, {2, 1, 1}};
    if (!variogram_init(&v, &s, covariance_hurst(&s, hurst), 24))
        return -1;
    double scale = 1 / covariance_at(&v, kinds[0], kinds[0], 0, 0);
    for (int y = -16; y <= 16; y += step)
        for (int x = -16; x <= 16; x += step)
            for (int k = 0; k < 4; k++) {
                /* the middles lie `step` apart: the column's begins one to the right of and one above the row's */
                int shift = (k & 1) - (k >> 1);
                double rho = scale * covariance_at(&v, kinds[k >> 1], kinds[k & 1], x + shift, y - shift);
                sum += 0.25 * 2 * rho * rho;
            }
    free(v.table);
    return sum;
}

double fbm_position_ratio(const fbm_positions *p, int octave, double hurst, double *limit)
{
    size_t side = (size_t)1 << octave;
    double rows[FBM_POSITIONS] = {0}, columns[FBM_POSITIONS] = {0}, count[FBM_POSITIONS] = {0};
    double all_rows = 0, all_columns = 0, all = 0, least = HUGE_VAL, low = HUGE_VAL, high = 0;
    for (size_t k = 0; k < FBM_POSITIONS; k++) {
        size_t to = k / 8 % side * side + k % 8 % side;
        rows[to] += p->rows[k];
        columns[to] += p->columns[k];
        count[to] += (double)p->count[k];
        all_rows += p->rows[k];
        all_columns += p->columns[k];
        all += (double)p->count[k];
    }
    *limit = 0;
    for (size_t k = 0; k < side * side; k++) {
        double mean = 0.5 * all / count[k] * (rows[k] / all_rows + columns[k] / all_columns);
        least = fmin(least, count[k]);
        low = fmin(low, mean);
        high = fmax(high, mean);
    }
    if (!(least >= 16) || !(all_rows > 0) || !(all_columns > 0))
        return 0;
    double z = exceeded_by(0.005 / (double)(side * side)), variance = position_variance(hurst, (int)side);
    if (variance < 0)
        return -1;
    *limit = exp(2 * z * sqrt(variance / least));
    return low > 0 ? high / low : HUGE_VAL;
}
