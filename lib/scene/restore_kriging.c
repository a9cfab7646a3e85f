#include "lib/scene/restore.h"

#include "fbm/elementary.h"
#include "fbm/weights.h"

#include <math.h>
#include <string.h>

/* One site of each orbit in a centre's picture; the others by the symmetries of the square. An edge's picture is this
 * one turned by 45 degrees and smaller by sqrt(2). */
static const int32_t orbits[][2] = {{2, 2}, {6, 2}, {6, 6}, {10, 2}, {2, 0}, {4, 0}, {4, 2}, {3, 3}, {4, 4}};

static void add_orbit(int32_t (*to)[2], int *count, int32_t a, int32_t b)
{
    const int32_t all[8][2] = {{a, b}, {-a, b}, {a, -b}, {-a, -b}, {b, a}, {-b, a}, {b, -a}, {-b, -a}};
    int first = *count;
    for (int k = 0; k < 8; k++) {
        int i = first;
        while (i < *count && (to[i][0] != all[k][0] || to[i][1] != all[k][1]))
            i++;
        if (i == *count) {
            to[i][0] = all[k][0], to[i][1] = all[k][1];
            ++*count;
        }
    }
}

static void place_sites(scene_kriging *self)
{
    int count = 0;
    for (size_t k = 0; k < sizeof orbits / sizeof *orbits; k++)
        add_orbit(self->sites[SCENE_CENTRES], &count, orbits[k][0], orbits[k][1]);
    for (int i = 0; i < SCENE_SITES; i++) {
        const int32_t *at = self->sites[SCENE_CENTRES][i];
        self->sites[SCENE_EDGES][i][0] = (at[0] - at[1]) / 2; /* all are both even or both odd, or (4, 2), (2, 0) */
        self->sites[SCENE_EDGES][i][1] = (at[0] + at[1]) / 2;
    }
}

static double half_square(double x, double y, double hurst, double aspect)
{
    double square = x * x * aspect * aspect + y * y;
    return square > 0 ? 0.5 * fbm_pow(square, hurst) : 0;
}

/* ---- The solution -------------------------------------------------------------------------------- */

/* Solves the n x n system in place, by elimination with pivots by column; the last column is the right side. */
static void solve(double (*a)[SCENE_SITES + 2], int n)
{
    for (int k = 0; k < n; k++) {
        int pivot = k;
        for (int i = k + 1; i < n; i++)
            if (fabs(a[i][k]) > fabs(a[pivot][k]))
                pivot = i;
        for (int j = k; j <= n && pivot != k; j++) {
            double swap = a[k][j];
            a[k][j] = a[pivot][j], a[pivot][j] = swap;
        }
        for (int i = k + 1; i < n; i++) {
            double factor = a[k][k] != 0 ? a[i][k] / a[k][k] : 0;
            for (int j = k; factor != 0 && j <= n; j++)
                a[i][j] -= factor * a[k][j];
        }
    }
    for (int k = n - 1; k >= 0; k--) {
        for (int j = k + 1; j < n; j++)
            a[k][n] -= a[k][j] * a[j][n];
        a[k][n] = a[k][k] != 0 ? a[k][n] / a[k][k] : 0;
    }
}

static const uint64_t all_coarse = (UINT64_C(1) << SCENE_COARSE) - 1;

void scene_kriging_solve(const scene_kriging *self, scene_half half, uint64_t known, scene_weights *out)
{
    if (known == all_coarse && self->tabulated) {
        *out = self->table[half];
        return;
    }
    int at[SCENE_SITES], n = 0;
    double a[SCENE_SITES + 1][SCENE_SITES + 2];
    for (int i = 0; i < SCENE_SITES; i++)
        if (known >> i & 1)
            at[n++] = i;
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++)
            a[i][j] = self->between[half][at[i]][at[j]];
        a[i][n] = a[n][i] = 1;
        a[i][n + 1] = self->to[half][at[i]];
    }
    a[n][n] = 0, a[n][n + 1] = 1;
    solve(a, n + 1);
    double variance = a[n][n + 1];
    memset(out->weights, 0, sizeof out->weights);
    for (int i = 0; i < n; i++) {
        out->weights[at[i]] = a[i][n + 1];
        variance += a[i][n + 1] * self->to[half][at[i]];
    }
    out->sigma = variance > 0 ? sqrt(variance) : 0;
}

/* ---- The residual ---------------------------------------------------------------------------------- */

/* Covariance of the residuals at a vertex and at another, `x`, `y` in S / 4 from it, both predicted from all coarse
 * sites: weights that sum to 0 (with -1 at the vertex) turn half squares of increments into covariances. */
static double residual_covariance(const scene_kriging *self, scene_half half, const scene_weights *w, int32_t x,
                                  int32_t y, double hurst, double aspect)
{
    double sum = 0;
    for (int i = -1; i < SCENE_COARSE; i++)
        for (int j = -1; j < SCENE_COARSE; j++) {
            double a = i < 0 ? -1 : w->weights[i], b = j < 0 ? -1 : w->weights[j];
            double dx = (j < 0 ? 0 : self->sites[half][j][0]) + x - (i < 0 ? 0 : self->sites[half][i][0]);
            double dy = (j < 0 ? 0 : self->sites[half][j][1]) + y - (i < 0 ? 0 : self->sites[half][i][1]);
            sum -= a * b * half_square(dx, dy, hurst, aspect);
        }
    return sum;
}

/* Taps t of unit variance with 2 t0 t1 + 4 t1 t2 = near and 2 t0 t2 + 2 t1^2 = next, the autocovariances of such a
 * filter, by iteration: both are small. */
static void find_taps(double near, double next, double taps[3])
{
    double t0 = 1, t1 = 0, t2 = 0;
    for (int k = 0; k < 200; k++) {
        t1 = near / (2 * t0 + 4 * t2);
        t2 = (next - 2 * t1 * t1) / (2 * t0);
        double rest = 1 - 4 * t1 * t1 - 4 * t2 * t2;
        t0 = rest > 0.01 ? sqrt(rest) : 0.1;
    }
    double norm = 1 / sqrt(t0 * t0 + 4 * t1 * t1 + 4 * t2 * t2);
    taps[0] = t0 * norm, taps[1] = t1 * norm, taps[2] = t2 * norm;
}

/* Weights, deviation and filter of a half step by the table, whose noise is for the spacing S = 4. */
static void tabulate(scene_kriging *self, scene_half half, double hurst)
{
    static const int orbit_of[] = {0, 1, 3, 4}; /* among a centre's weights, the sites' orbits in their order */
    double values[FBM_WEIGHT_VALUES], *taps = self->taps[half];
    scene_weights *out = &self->table[half];
    fbm_values_table(hurst, values);
    *out = (scene_weights){.sigma = 0};
    for (int i = 0; i < SCENE_COARSE; i++)
        out->weights[i] = values[orbit_of[i < 4 ? 0 : i < 12 ? 1 : i < 16 ? 2 : 3]];
    const double t[3] = {values[6], values[7], values[9]}; /* edges have the same ones, at 2^(-1/2) of the spacing */
    double norm = sqrt(t[0] * t[0] + 4 * t[1] * t[1] + 4 * t[2] * t[2]);
    out->sigma = norm * fbm_exp2((half == SCENE_CENTRES ? 2 : 1.5) * hurst);
    for (int k = 0; k < 3; k++)
        taps[k] = t[k] / norm;
}

void scene_kriging_init(scene_kriging *self, double hurst, double aspect)
{
    place_sites(self);
    self->tabulated = false;
    for (int half = 0; half < 2; half++) {
        int32_t(*sites)[2] = self->sites[half];
        for (int i = 0; i < SCENE_SITES; i++) {
            self->to[half][i] = half_square(sites[i][0], sites[i][1], hurst, aspect);
            for (int j = 0; j < SCENE_SITES; j++)
                self->between[half][i][j] =
                    half_square(sites[i][0] - sites[j][0], sites[i][1] - sites[j][1], hurst, aspect);
        }
        if (aspect == 1) {
            tabulate(self, (scene_half)half, hurst);
            continue;
        }
        scene_weights w;
        scene_kriging_solve(self, (scene_half)half, all_coarse, &w);
        double c[3] = {0};
        for (int k = 0; k < 4; k++) {
            static const int32_t axes[4][2] = {{4, 0}, {0, 4}, {-4, 0}, {0, -4}},
                                 diagonals[4][2] = {{4, 4}, {-4, 4}, {4, -4}, {-4, -4}};
            int32_t near[2] = {axes[k][0], axes[k][1]}, next[2] = {diagonals[k][0], diagonals[k][1]};
            if (half == SCENE_EDGES) {
                near[0] = diagonals[k][0] / 2, near[1] = diagonals[k][1] / 2;
                next[0] = axes[k][0], next[1] = axes[k][1];
            }
            c[1] += residual_covariance(self, (scene_half)half, &w, near[0], near[1], hurst, aspect) / 4;
            c[2] += residual_covariance(self, (scene_half)half, &w, next[0], next[1], hurst, aspect) / 4;
        }
        c[0] = residual_covariance(self, (scene_half)half, &w, 0, 0, hurst, aspect);
        find_taps(c[0] > 0 ? c[1] / c[0] : 0, c[0] > 0 ? c[2] / c[0] : 0, self->taps[half]);
    }
    self->tabulated = aspect == 1;
}
