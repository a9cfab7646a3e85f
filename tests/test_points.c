#include "lib/scene/restore.h"
#include "lib/talus.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

#include "tests/grids.h"

static char folder[] = "/tmp/talus-test-XXXXXX";

static int make_folder(void **state)
{
    (void)state;
    return mkdtemp(folder) ? 0 : -1;
}

static int remove_folder(void **state)
{
    (void)state;
    return rmdir(folder);
}

static const char *path_of(const char *name)
{
    static char path[100];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    return path;
}

static tl_framework *build(const tl_source *source, double max_error)
{
    tl_error error = {0};
    tl_framework *out = tl_framework_build(source, &(tl_framework_options){.max_error = max_error}, &error);
    if (!out)
        fail_msg("%s", error.text);
    return out;
}

static tl_source *restore(const tl_framework *framework, const tl_source *dem, const tl_restore_options *options)
{
    tl_error error = {0};
    tl_source *out = tl_framework_restore(framework, dem, options, &error);
    if (!out)
        fail_msg("%s", error.text);
    return out;
}

static float *read_all(const tl_source *source)
{
    float *z = malloc((size_t)(source->info.width * source->info.height) * sizeof *z);
    assert_non_null(z);
    tl_window all = {0, 0, source->info.width, source->info.height};
    assert_int_equal(tl_source_read(source, source->info.level, all, z, NULL), TL_OK);
    return z;
}

/* ---- Files ---- */

static void expect_same_mesh(const tl_framework *a, const tl_framework *b)
{
    tl_mesh *m = NULL, *n = NULL;
    assert_int_equal(tl_framework_mesh(a, &m, NULL), TL_OK);
    assert_int_equal(tl_framework_mesh(b, &n, NULL), TL_OK);
    assert_int_equal(m->vertex_count, n->vertex_count);
    assert_int_equal(m->triangle_count, n->triangle_count);
    assert_memory_equal(m->vertices, n->vertices, m->vertex_count * sizeof *m->vertices);
    assert_memory_equal(m->indices, n->indices, 3 * m->triangle_count * sizeof *m->indices);
    tl_mesh_destroy(m);
    tl_mesh_destroy(n);
}

static void frameworksComeBackFromTheirFiles(void **state)
{
    (void)state;
    random_state = 81;
    for (int k = 0; k < 40; k++) {
        grid of = make_grid(1 + random_below(600), 1 + random_below(300), (terrain)random_below(TERRAINS),
                            k % 2 ? VOIDS_NONE : (voids)random_below(VOIDS_KINDS));
        tl_source *source = open_grid(&of);
        tl_framework *made = build(source, (double)(1 << random_below(7)));
        const char *path = path_of("points.tif");
        tl_error error = {0};
        if (tl_framework_save(made, source, path, NULL, &error) != TL_OK)
            fail_msg("%s", error.text);
        assert_true(tl_framework_is_file(path));
        assert_int_equal(tl_framework_save(made, source, path, NULL, NULL), TL_ERROR_IO); /* exists */
        tl_framework *again = tl_framework_load(path, NULL, &error);
        if (!again)
            fail_msg("%s", error.text);
        assert_true(tl_framework_max_error(made) == tl_framework_max_error(again));
        assert_int_equal(tl_framework_isolated_count(made), tl_framework_isolated_count(again));
        expect_same_mesh(made, again);
        unlink(path);
        tl_framework_destroy(made);
        tl_framework_destroy(again);
        tl_source_destroy(source);
        free(of.z);
    }
}

static void otherFilesAreNoFrameworks(void **state)
{
    (void)state;
    random_state = 82;
    grid of = make_grid(40, 30, TERRAIN_HILLS, VOIDS_NONE);
    tl_source *source = open_grid(&of);
    const char *path = path_of("heights.tif");
    tl_error error;
    assert_int_equal(tl_write_grid(source, path, NULL, NULL), TL_OK);
    assert_false(tl_framework_is_file(path));
    assert_null(tl_framework_load(path, NULL, &error));
    assert_int_equal(error.status, TL_ERROR_ARGUMENT);
    unlink(path);
    assert_false(tl_framework_is_file(path));
    tl_source_destroy(source);
    free(of.z);
}

/* Lines of a text file that hold `part`. */
static size_t count_lines(const char *path, const char *part)
{
    char line[1000];
    size_t count = 0;
    FILE *file = fopen(path, "r");
    assert_non_null(file);
    while (fgets(line, sizeof line, file))
        count += strstr(line, part) != NULL;
    fclose(file);
    return count;
}

static void pointsAreWrittenAsText(void **state)
{
    (void)state;
    random_state = 83;
    grid of = make_grid(90, 70, TERRAIN_HILLS, VOIDS_FEW);
    tl_source *source = open_grid(&of);
    tl_features *features = NULL;
    tl_framework *framework = build(source, 4);
    size_t points = tl_framework_point_count(framework), summits = 0;
    assert_int_equal(tl_features_find(source, &(tl_features_options){.persistence = 4}, &features, NULL), TL_OK);
    for (size_t k = 0; k < features->count; k++)
        summits += features->items[k].kinds & TL_FEATURE_SUMMIT &&
                   tl_framework_has_point(framework, features->items[k].i, features->items[k].j);
    assert_true(summits > 0);
    tl_points_options options = {.features = features, .frame = TL_FRAME_PIXEL};
    const char *path = path_of("points.csv");
    assert_int_equal(tl_framework_save(framework, source, path, &options, NULL), TL_OK);
    assert_int_equal(count_lines(path, ","), points + 1);
    assert_int_equal(count_lines(path, "summit"), summits);
    unlink(path);
    path = path_of("points.geojson");
    assert_int_equal(tl_framework_save(framework, source, path, &options, NULL), TL_OK);
    assert_int_equal(count_lines(path, "\"Point\""), points);
    assert_int_equal(count_lines(path, "summit"), summits);
    unlink(path);
    options.frame = TL_FRAME_DEFAULT; /* longitude and latitude, of a raster without a CRS */
    assert_int_equal(tl_framework_save(framework, source, path, &options, NULL), TL_ERROR_DATA);
    assert_int_not_equal(access(path, F_OK), 0);
    path = path_of("points.xyz");
    assert_int_equal(tl_framework_save(framework, source, path, &options, NULL), TL_ERROR_ARGUMENT);
    tl_features_destroy(features);
    tl_framework_destroy(framework);
    tl_source_destroy(source);
    free(of.z);
}

/* ---- Elevation models again ---- */

static void check_restored(const grid *of, const tl_framework *framework, const float *z, double bound, bool known)
{
    size_t isolated = 0;
    for (int k = 0; k < of->width * of->height; k++) {
        bool lost = isnan(z[k]) && !isnan(of->z[k]);
        isolated += lost;
        assert_true(!isnan(of->z[k]) || isnan(z[k]));
        if (isnan(of->z[k]) || lost)
            continue;
        assert_true(fabs((double)z[k] - (double)of->z[k]) <= bound);
        if (tl_framework_has_point(framework, k % of->width, k / of->width))
            assert_true(z[k] == of->z[k]);
    }
    assert_int_equal(isolated, known ? 0 : tl_framework_isolated_count(framework));
}

/* Alone, the surface is known to a float's rounding, of heights below 1000. */
static void restoredHeightsKeepTheBound(void **state)
{
    (void)state;
    random_state = 84;
    for (int k = 0; k < 40; k++) {
        grid of = make_grid(1 + random_below(300), 1 + random_below(200), (terrain)random_below(3),
                            k % 2 ? VOIDS_NONE : (voids)random_below(VOIDS_KINDS));
        tl_source *source = open_grid(&of);
        double bound = k % 7 ? (double)(1 << random_below(7)) : 0;
        tl_framework *framework = build(source, bound);
        tl_restore_options options = {.seed = (uint64_t)k};
        if (k % 3 == 0) { /* noise that would break every bound */
            options.hurst_given = options.delta_given = true;
            options.hurst = 0.1 + 0.2 * (k % 5), options.delta = 1000;
        }
        for (int alone = 0; alone < 2; alone++) {
            tl_source *made = restore(framework, alone ? NULL : source, &options);
            float *z = read_all(made);
            check_restored(&of, framework, z, alone ? 2 * bound + 1000 * 0x1p-23 : bound, !alone);
            free(z);
            tl_source_destroy(made);
        }
        tl_framework_destroy(framework);
        tl_source_destroy(source);
        free(of.z);
    }
}

static void restoringDoesNotDependOnThreadsNorOnTheModel(void **state)
{
    (void)state;
    random_state = 85;
    grid of = make_grid(700, 400, TERRAIN_EIGHTHS, VOIDS_BLOCKS);
    tl_source *source = open_grid(&of);
    tl_framework *framework = build(source, 8);
    float *first = NULL;
    for (unsigned threads = 1; threads <= 5; threads += 2) {
        tl_run run = {.threads = threads};
        tl_source *made = restore(framework, source, &(tl_restore_options){.seed = 5, .run = &run});
        float *z = read_all(made);
        for (int k = 0; first && k < of.width * of.height; k++)
            assert_memory_equal(&z[k], &first[k], sizeof *z);
        tl_window part = {311, 205, 90, 70};
        float window[90 * 70];
        assert_int_equal(tl_source_read(made, 0, part, window, NULL), TL_OK);
        for (int y = 0; y < 70; y++)
            assert_memory_equal(window + y * 90, z + (205 + y) * 700 + 311, 90 * sizeof *z);
        if (first)
            free(z);
        else
            first = z;
        tl_source_destroy(made);
    }
    free(first);
    tl_framework_destroy(framework);
    tl_source_destroy(source);
    free(of.z);
}

/* ---- Statistics across levels ---- */

enum { SIDE = 65, MIDDLE = 32, COARSE = 16, FIELDS = 400, GROUPS = 20 };

/* Everything west of the middle is known, of the east every 16th sample and what conforming triangles need between. */
static tl_framework *half_known(const tl_source *source)
{
    static tl_feature items[SIDE * SIDE];
    tl_features known = {0, items};
    for (int j = 0; j < SIDE; j++)
        for (int i = 0; i < SIDE; i++)
            if (i <= MIDDLE || (i % COARSE == 0 && j % COARSE == 0))
                items[known.count++] = (tl_feature){.i = i, .j = j};
    return tl_framework_build(source, &(tl_framework_options){.max_error = 1e30, .features = &known}, NULL);
}

/* Mean square of increments of `lag` columns that begin less than `lag` west of the border, up to 8 east of it. */
static double increments(const float *z, int lag)
{
    double sum = 0;
    int count = 0;
    for (int y = 4; y < SIDE - 4; y++)
        for (int x = MIDDLE - lag + 1; x < MIDDLE + 8; x++, count++) {
            double step = (double)z[y * SIDE + x + lag] - (double)z[y * SIDE + x];
            sum += step * step;
        }
    return sum / count;
}

/* Deviation from lag^2H, in *deviation, and its standard error by groups of independent fields, in *spread. */
static void measure_border(double hurst, int lag, bool ignores, double *deviation, double *spread)
{
    double groups[GROUPS] = {0}, mean = 0, square = 0;
    for (int k = 0; k < FIELDS; k++) {
        tl_noise_options noise = {.size = SIDE, .hurst = hurst, .delta = 1, .seed = (uint64_t)k};
        tl_source *field = tl_noise_create(&noise, NULL);
        float *exact = read_all(field);
        grid of = {SIDE, SIDE, exact};
        tl_source *source = open_grid(&of);
        tl_framework *framework = half_known(source);
        tl_restore_options options = {
            .hurst_given = true, .delta_given = true, .hurst = hurst, .delta = 1, .seed = (uint64_t)k + 100000};
        tl_source *made = scene_restore(framework, NULL, &options, ignores, NULL);
        assert_non_null(made);
        float *z = read_all(made);
        /* the field's own increments in the same places: what they are off by chance, those made are too */
        groups[k % GROUPS] += (increments(z, lag) - increments(exact, lag)) / pow(lag, 2 * hurst) * GROUPS / FIELDS;
        free(z);
        free(exact);
        tl_source_destroy(made);
        tl_framework_destroy(framework);
        tl_source_destroy(source);
        tl_source_destroy(field);
    }
    for (int g = 0; g < GROUPS; g++)
        mean += groups[g] / GROUPS;
    for (int g = 0; g < GROUPS; g++)
        square += (groups[g] - mean) * (groups[g] - mean);
    *deviation = mean;
    *spread = sqrt(square / (GROUPS - 1) / GROUPS);
}

/* Increments across the border between levels are those of fBm to 3 %. The standard error is measured, and below 0.9 %;
 * four of them are allowed on top, so that a false alarm comes once in 10,000 runs of one case; the seeds are fixed. */
static void incrementsAcrossLevelsAreThoseOfFbm(void **state)
{
    static const double hursts[] = {0.3, 0.7};
    (void)state;
    for (int h = 0; h < 2; h++)
        for (int lag = 1; lag <= 4; lag *= 2) {
            double deviation, spread;
            measure_border(hursts[h], lag, false, &deviation, &spread);
            print_message("H %.1f lag %d: %+.2f %% +- %.2f\n", hursts[h], lag, 100 * deviation, 100 * spread);
            assert_true(spread < 0.009);
            assert_true(fabs(deviation) <= 0.03 + 4 * spread);
        }
}

/* The solution of the textbook: the mean of two samples at distance 1 on either side, with variance 1 - 2^(2H) / 4. */
static void krigingOfTwoSamplesIsTheirMean(void **state)
{
    scene_kriging kriging;
    scene_weights w;
    (void)state;
    scene_kriging_init(&kriging, 0.6, 1);
    uint64_t known = 0;
    for (int i = 0; i < SCENE_SITES; i++)
        if (abs(kriging.sites[SCENE_EDGES][i][0]) == 2 && kriging.sites[SCENE_EDGES][i][1] == 0)
            known |= UINT64_C(1) << i;
    assert_int_equal(__builtin_popcountll(known), 2);
    scene_kriging_solve(&kriging, SCENE_EDGES, known, &w);
    double sum = 0;
    for (int i = 0; i < SCENE_SITES; i++) {
        sum += w.weights[i];
        assert_true(!(known >> i & 1) || fabs(w.weights[i] - 0.5) < 1e-12);
    }
    assert_true(fabs(sum - 1) < 1e-12);
    assert_true(fabs(w.sigma * w.sigma - pow(2, 1.2) * (1 - pow(2, 1.2) / 4)) < 1e-12);
}

static void sitesAreDistinctAndTheCoarseOnesOnTheLattice(void **state)
{
    scene_kriging kriging;
    (void)state;
    scene_kriging_init(&kriging, 0.6, 1);
    for (int half = 0; half < 2; half++)
        for (int i = 0; i < SCENE_SITES; i++) {
            const int32_t *a = kriging.sites[half][i];
            if (i < SCENE_COARSE && half == SCENE_CENTRES)
                assert_true(a[0] % 4 && a[1] % 4 && a[0] % 2 == 0 && a[1] % 2 == 0);
            if (i < SCENE_COARSE && half == SCENE_EDGES) /* corners and centres around the middle of a side */
                assert_true(a[0] % 2 == 0 && a[1] % 2 == 0 && (a[0] + a[1]) % 4);
            for (int j = 0; j < i; j++)
                assert_true(a[0] != kriging.sites[half][j][0] || a[1] != kriging.sites[half][j][1]);
        }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(frameworksComeBackFromTheirFiles),
        cmocka_unit_test(otherFilesAreNoFrameworks),
        cmocka_unit_test(pointsAreWrittenAsText),
        cmocka_unit_test(restoredHeightsKeepTheBound),
        cmocka_unit_test(restoringDoesNotDependOnThreadsNorOnTheModel),
        cmocka_unit_test(incrementsAcrossLevelsAreThoseOfFbm),
        cmocka_unit_test(krigingOfTwoSamplesIsTheirMean),
        cmocka_unit_test(sitesAreDistinctAndTheCoarseOnesOnTheLattice),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
