/* Statistics of fBm over exponents, strengths, shapes of cells, seeds, sizes of tiles, levels and generators, with
 * tolerances from the sampling distribution of what is measured. */
#include "fbm/covariance.h"
#include "fbm/refine.h"
#include "lib/base/georef.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

/* What is measured is the mean square Q of second differences z(x - h) - 2 z(x) + z(x + h) in a tile. They are
 * Gaussian, with the covariance c that follows from the structure function, so Q has the mean c(0) and, over N places,
 * the variance 2 / N^2 sum of c^2 over all pairs. Q is then nearly a chi-square of nu = 2 c(0)^2 / var degrees of
 * freedom (Satterthwaite), and the cube root of Q / c(0) nearly normal (Wilson and Hilferty). By Bonferroni's bound
 * none of the at most TRIALS scores of a sweep is beyond LIMIT but in one of 10,000 runs with new seeds: 10^-4 / 1000
 * on two sides. Second differences forget within few lags, so nu is hundreds and more, which these approximations need.
 */
enum { TRIALS = 1000 };
static const double LIMIT = 5.33;

typedef struct trial {
    double hurst, delta, aspect; /* delta is over a cell's height */
    uint64_t seed;
    const char *scheme;    /* NULL: stationary */
    int side, levels, lag; /* of the tile; refined from the DEM; in samples of the tile */
    bool down;             /* differences along columns, not rows */
} trial;

static int trials;

/* |h|^(2H) of dx columns and dy rows. */
static double structure(const trial *t, double dx, double dy)
{
    return pow(hypot(dx * t->aspect, dy), 2 * t->hurst);
}

/* Covariance of two second differences (dx, dy) apart, for delta 1. */
static double covariance(const trial *t, int dx, int dy)
{
    static const int weights[5] = {1, -4, 6, -4, 1};
    double sum = 0;
    for (int k = 0; k < 5; k++) {
        int step = (k - 2) * t->lag;
        sum -= .5 * weights[k] * structure(t, dx + (t->down ? 0 : step), dy + (t->down ? step : 0));
    }
    return sum;
}

static double degrees_of_freedom(const trial *t)
{
    int across = t->side - (t->down ? 0 : 2 * t->lag), down = t->side - (t->down ? 2 * t->lag : 0);
    double sum = 0, places = (double)across * down, mean = covariance(t, 0, 0);
    for (int dy = 1 - down; dy < down; dy++)
        for (int dx = 0; dx < across; dx++) {
            double c = covariance(t, dx, dy);
            sum += (dx ? 2 : 1) * (double)(across - dx) * (down - abs(dy)) * c * c;
        }
    return mean * mean * places * places / sum;
}

/* The mean square over its expectation. */
static double relative_square(const trial *t, const float *z)
{
    int across = t->side - (t->down ? 0 : 2 * t->lag), down = t->side - (t->down ? 2 * t->lag : 0);
    int step = t->down ? t->lag * t->side : t->lag;
    double sum = 0, unit = t->delta * pow(.5, t->levels * t->hurst);
    for (int y = 0; y < down; y++)
        for (int x = 0; x < across; x++) {
            const float *at = z + y * t->side + x;
            double d = (double)at[0] - 2 * (double)at[step] + (double)at[2 * step];
            sum += d * d;
        }
    return sum / ((double)across * down) / (covariance(t, 0, 0) * unit * unit);
}

/* The largest deviation of the scheme's structure function, exactly. */
static double deviation_of(double hurst, double aspect)
{
    static double last[3]; /* exponent, aspect, deviation */
    int halvings = fbm_aspect_halvings(aspect);
    double values[FBM_WEIGHT_VALUES];
    fbm_row_weights rows[2];
    fbm_weights weights;
    fbm_deviation found;
    if (last[0] == hurst && last[1] == aspect)
        return last[2];
    for (int k = 0; k < halvings; k++) {
        fbm_values_rows(hurst, ldexp(aspect, k), halvings == 2 && k == 0, values);
        fbm_row_weights_round(values, &rows[k]);
    }
    fbm_values_stationary(hurst, ldexp(aspect, halvings), values);
    fbm_weights_round(values, &weights);
    fbm_refinement refinement = {fbm_schemes, hurst, aspect, &weights, halvings, rows};
    assert_int_equal(fbm_refinement_deviation(&refinement, 2, halvings == 2 ? 1 : 2, &found), FBM_OK);
    last[0] = hurst, last[1] = aspect, last[2] = found.mean;
    return found.mean;
}

/* That, as it appears in 4 S(h) - S(2 h), which second differences have. */
static double bias(const trial *t)
{
    double one = structure(t, t->down ? 0 : 1, t->down ? 1 : 0), two = structure(t, t->down ? 0 : 2, t->down ? 2 : 0);
    return t->scheme ? 0 : deviation_of(t->hurst, t->aspect) * (4 * one + two) / (4 * one - two);
}

static double score(double relative, double freedom)
{
    return (cbrt(relative) - (1 - 2 / (9 * freedom))) / sqrt(2 / (9 * freedom));
}

/* The score of what is nearest among the expectations that the scheme's own deviation allows. */
static double nearest_score(const trial *t, const float *z)
{
    double freedom = degrees_of_freedom(t), off = bias(t), relative = relative_square(t, z);
    double low = score(relative / (1 - off), freedom), high = score(relative / (1 + off), freedom);
    trials++;
    return low > 0 && high < 0 ? 0 : fabs(low) < fabs(high) ? low : high;
}

static void check(const trial *t, const float *z)
{
    double found = nearest_score(t, z);
    if (!(fabs(found) <= LIMIT))
        fail_msg("%s, H %g, delta %g, aspect %g, seed %llu, tile of %d, %d levels, lag %d %s: score %.2f",
                 t->scheme ? t->scheme : "stationary", t->hurst, t->delta, t->aspect, (unsigned long long)t->seed,
                 t->side, t->levels, t->lag, t->down ? "down" : "across", found);
}

static tl_source *make_noise(const trial *t, int size)
{
    tl_source *out = tl_noise_create(&(tl_noise_options){.size = size,
                                                         .hurst = t->hurst,
                                                         .delta = t->delta,
                                                         .seed = t->seed,
                                                         .scheme = t->scheme,
                                                         .aspect = t->aspect},
                                     NULL);
    assert_non_null(out);
    return out;
}

static float *read_tile(const tl_source *source, int64_t x, int64_t y, int side)
{
    float *z = malloc((size_t)side * (size_t)side * sizeof *z);
    assert_non_null(z);
    assert_int_equal(tl_source_read(source, source->info.level, (tl_window){x, y, side, side}, z, NULL), TL_OK);
    return z;
}

static void check_all_lags(trial t, const float *z, int most)
{
    for (t.lag = 1; t.lag <= most; t.lag *= 2)
        for (int down = 0; down < 2; down++) {
            t.down = down;
            check(&t, z);
        }
}

static const double hursts[] = {.1, .3, .5, .7, .9};
static const double deltas[] = {1e-3, 1, 1e4};

static void noiseHasTheStatisticsOfFbm(void **state)
{
    (void)state;
    static const double aspects[] = {1, .8, .5, .3};
    static const int sides[] = {33, 64, 100};
    trials = 0;
    for (int h = 0; h < 5; h++)
        for (int a = 0; a < 4; a++)
            for (int k = 0; k < 3; k++) {
                trial t = {hursts[h],  deltas[(h + a + k) % 3],
                           aspects[a], (uint64_t)(100 * h + 10 * a + k),
                           NULL,       sides[k],
                           0,          1,
                           false};
                tl_source *noise = make_noise(&t, 2000); /* three levels below an exact one of 250 */
                float *z = read_tile(noise, 613 * k + 7, 999 - 333 * k, t.side);
                check_all_lags(t, z, 4);
                free(z);
                tl_source_destroy(noise);
            }
    assert_true(trials <= TRIALS);
}

static void exactNoiseHasTheStatisticsOfFbm(void **state)
{
    (void)state;
    trials = 0;
    for (int h = 0; h < 5; h++)
        for (int k = 0; k < 3; k++) {
            trial t = {hursts[h], deltas[k], 1, (uint64_t)(h + 5 * k), "exact", 65, 0, 1, false};
            tl_source *noise = make_noise(&t, 128);
            float *z = read_tile(noise, 5, 17, t.side);
            check_all_lags(t, z, 4);
            free(z);
            tl_source_destroy(noise);
        }
    assert_true(trials <= TRIALS);
}

/* Tiles of any level below a model, which lie anywhere in it, the rim too. */
static void everyLevelHasTheStatisticsOfFbm(void **state)
{
    (void)state;
    static const double aspects[] = {1, .75, .4};
    trials = 0;
    for (int h = 0; h < 5; h++)
        for (int a = 0; a < 3; a++)
            for (int levels = 1; levels <= 5; levels += 2) {
                trial t = {hursts[h], 3, aspects[a], (uint64_t)(50 * h + 10 * a + levels), NULL, 65, levels, 1, false};
                tl_source *noise = make_noise(&t, 60);
                noise->info.georef.cell_x = t.aspect;
                noise->info.georef.cell_y = 1;
                /* the field's delta is over the geometric mean of a cell's sides */
                tl_field_options options = {.levels = levels,
                                            .hurst_given = true,
                                            .hurst = t.hurst,
                                            .delta_given = true,
                                            .delta = t.delta * pow(t.aspect, t.hurst / 2),
                                            .scheme = "stationary",
                                            .seed = t.seed + 1};
                tl_source *field = tl_field_create(noise, &options, NULL);
                assert_non_null(field);
                for (int place = 0; place < 2; place++) {
                    float *z = read_tile(field, place ? field->info.width - t.side : 0, place ? 33 : 0, t.side);
                    check_all_lags(t, z, 8);
                    free(z);
                }
                tl_source_destroy(field);
                tl_source_destroy(noise);
            }
    assert_true(trials <= TRIALS);
}

static double largest_score(trial t, const float *z)
{
    double largest = 0;
    for (t.lag = 1; t.lag <= 4; t.lag *= 2)
        for (int down = 0; down < 2; down++) {
            t.down = down;
            largest = fmax(largest, fabs(nearest_score(&t, z)));
        }
    return largest;
}

/* The sweep can fail: an exponent off by 0.1, a strength by 10 %, cells taken for squares, other schemes. */
static void wrongStatisticsAreNoticed(void **state)
{
    (void)state;
    const trial t = {.hurst = .5, .delta = 1, .aspect = .8, .seed = 77, .side = 128};
    trial wrong[3] = {t, t, t};
    wrong[0].hurst = .6;
    wrong[1].delta = 1.1;
    wrong[2].aspect = 1;
    tl_source *noise = make_noise(&t, 128);
    float *z = read_tile(noise, 0, 0, 128);
    assert_true(largest_score(t, z) <= LIMIT);
    for (int k = 0; k < 3; k++)
        assert_true(largest_score(wrong[k], z) > LIMIT);
    free(z);
    tl_source_destroy(noise);
    static const char *const schemes[] = {"square", "diamond-square", "successive"};
    for (int k = 0; k < 3; k++) {
        trial other = {.hurst = .7, .delta = 1, .aspect = 1, .seed = 7, .scheme = schemes[k], .side = 128};
        noise = make_noise(&other, 2000);
        z = read_tile(noise, 0, 0, 128);
        other.scheme = NULL;
        assert_true(largest_score(other, z) > LIMIT);
        free(z);
        tl_source_destroy(noise);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(noiseHasTheStatisticsOfFbm),
        cmocka_unit_test(exactNoiseHasTheStatisticsOfFbm),
        cmocka_unit_test(everyLevelHasTheStatisticsOfFbm),
        cmocka_unit_test(wrongStatisticsAreNoticed),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
