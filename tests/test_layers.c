/* Layers over heights: what they tell of surfaces whose shape is known. */
#define _GNU_SOURCE /* mkdtemp */
#include "lib/base/size.h"
#include "lib/scene/layers.h"
#include "lib/scene/north_up.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

#include "tests/near.h"

enum { WIDTH = 61, HEIGHT = 47 };

typedef double (*surface)(double x, double y);

static double plane(double x, double y)
{
    return 0.5 * x - 0.25 * y + 7; /* metres east and north */
}

static double bowl(double x, double y)
{
    return 0.001 * (x * x + y * y) / 2;
}

static double waves(double x, double y)
{
    return 30 * sin(x / 40) * cos(y / 55) + 0.2 * x;
}

/* Cells of 10 x 20 m; heights in feet where `unit` says so. */
static tl_source *make(surface of, double unit, float *heights)
{
    tl_source_info info = {.width = WIDTH, .height = HEIGHT, .type = TL_RASTER_POINT, .name = "surface"};
    info.georef = (tl_georef){
        .located = true, .transform = {-300, 10, 0, 460, 0, -20}, .cell_x = 10, .cell_y = 20, .height_unit = unit};
    for (int j = 0; j < HEIGHT; j++)
        for (int i = 0; i < WIDTH; i++)
            heights[j * WIDTH + i] = (float)(of(-300 + 10.0 * i, 460 - 20.0 * j) / unit);
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    assert_non_null(source);
    return source;
}

static float *read_layer(const tl_source *heights, const char *kind, const tl_layer_options *options, tl_window window)
{
    tl_error error;
    scene_layer *layer = scene_layer_create(heights, kind, options, &error);
    if (!layer)
        fail_msg("%s", error.text);
    float *out = tl_alloc(scene_layer_kind(layer)->channels * (size_t)(window.width * window.height), sizeof *out);
    assert_int_equal(scene_layer_read(layer, window, out, &error), TL_OK);
    scene_layer_destroy(layer);
    return out;
}

static const tl_window whole = {0, 0, WIDTH, HEIGHT};

static void planesHaveTheirNormalEverywhere(void **state)
{
    (void)state;
    static float heights[WIDTH * HEIGHT];
    for (int feet = 0; feet < 2; feet++) {
        tl_source *source = make(plane, feet ? 0.3048 : 1, heights);
        float *normal = read_layer(source, "normal", NULL, whole), *slope = read_layer(source, "slope", NULL, whole);
        float *tangent = read_layer(source, "tangent", NULL, whole),
              *bend = read_layer(source, "curvature", NULL, whole);
        double length = sqrt(1 + 0.25 + 0.0625);
        for (int k = 0; k < WIDTH * HEIGHT; k++) { /* the rim too */
            assert_near((double)normal[k], -0.5 / length, 1e-5);
            assert_near((double)normal[WIDTH * HEIGHT + k], 0.25 / length, 1e-5);
            assert_near((double)normal[2 * WIDTH * HEIGHT + k], 1 / length, 1e-5);
            assert_near((double)slope[k], atan(hypot(0.5, 0.25)) * 180 / 3.14159265358979, 1e-3);
            assert_near((double)bend[k], 0, 1e-6);
        }
        assert_memory_equal(normal, tangent, 3 * sizeof *normal * WIDTH * HEIGHT); /* north is up */
        free(normal), free(slope), free(tangent), free(bend);
        tl_source_destroy(source);
    }
}

static void hollowsCurveUpwards(void **state)
{
    (void)state;
    static float heights[WIDTH * HEIGHT];
    tl_source *source = make(bowl, 1, heights);
    float *bend = read_layer(source, "curvature", NULL, whole);
    int middle = 23 * WIDTH + 30; /* x = 0, y = 0: a sphere of 1000 m touches there */
    assert_near((double)bend[middle], 0.001, 1e-6);
    for (int j = 1; j < HEIGHT - 1; j++)
        for (int i = 1; i < WIDTH - 1; i++)
            assert_true((double)bend[j * WIDTH + i] > 0.0007);
    free(bend);
    tl_source_destroy(source);
}

/* Windows that are read alone are those of the whole, also beside voids. */
static void windowsJoin(void **state)
{
    (void)state;
    static float heights[WIDTH * HEIGHT];
    tl_source *source = make(waves, 1, heights);
    heights[20 * WIDTH + 20] = NAN;
    for (const tl_layer_kind *kind = tl_layers(); kind->name; kind++) {
        if (strcmp(kind->name, "sigma") == 0 || strcmp(kind->name, "hurst") == 0 || strcmp(kind->name, "mask") == 0)
            continue; /* of fields, and one that voids have too: below */
        float *all = read_layer(source, kind->name, NULL, whole);
        assert_true(isnan(all[20 * WIDTH + 20]) && !isnan(all[20 * WIDTH + 21]));
        for (int y = 0; y < HEIGHT; y += 16)
            for (int x = 0; x < WIDTH; x += 16) {
                tl_window part = {x, y, tl_int64_min(16, WIDTH - x), tl_int64_min(16, HEIGHT - y)};
                float *alone = read_layer(source, kind->name, NULL, part);
                for (size_t c = 0; c < kind->channels; c++)
                    for (int64_t row = 0; row < part.height; row++)
                        assert_memory_equal(alone + ((int64_t)c * part.height + row) * part.width,
                                            all + (int64_t)c * WIDTH * HEIGHT + (part.y + row) * WIDTH + part.x,
                                            (size_t)part.width * sizeof *alone);
                free(alone);
            }
        free(all);
    }
    tl_source_destroy(source);
}

static void sharesAddUpToOne(void **state)
{
    (void)state;
    static float heights[WIDTH * HEIGHT];
    tl_source *source = make(waves, 1, heights);
    float *splat = read_layer(source, "splat", NULL, whole);
    const size_t n = (size_t)WIDTH * HEIGHT;
    double most = 0;
    for (size_t k = 0; k < n; k++) {
        assert_near((double)splat[k] + (double)splat[n + k] + (double)splat[2 * n + k] + (double)splat[3 * n + k], 1,
                    1e-6);
        most = fmax(most, (double)splat[n + k]);
        assert_true(splat[3 * n + k] == 0); /* no snow below 2,700 m */
    }
    assert_true(most > 0.2); /* scree on the steepest parts */
    free(splat);
    tl_source_destroy(source);
}

static tl_layer_options write_rules(char folder[64], const char *text, char path[96])
{
    strcpy(folder, "/tmp/talus-test-XXXXXX");
    assert_non_null(mkdtemp(folder));
    snprintf(path, 96, "%s/rules.json", folder);
    FILE *file = fopen(path, "w");
    fputs(text, file);
    fclose(file);
    return (tl_layer_options){.rules = path};
}

static void rulesShareTheGround(void **state)
{
    (void)state;
    static float heights[WIDTH * HEIGHT];
    char folder[64], path[96];
    tl_source *source = make(plane, 1, heights);
    tl_layer_options options = write_rules(
        folder, "{\"rock\": {\"height\": [0, 100]}, \"snow\": {\"height\": [null, null, 0, 100], \"weight\": 1}}",
        path);
    float *splat = read_layer(source, "splat", &options, whole);
    const size_t n = (size_t)WIDTH * HEIGHT;
    for (size_t k = 0; k < n; k++) {
        double rock = fmin(fmax((double)heights[k] / 100, 0), 1);
        assert_near((double)splat[k], rock, 1e-6);
        assert_near((double)splat[3 * n + k], 1 - rock, 1e-6);
    }
    free(splat);
    unlink(path), rmdir(folder);
    tl_source_destroy(source);
}

static void wrongRulesAreTold(void **state)
{
    (void)state;
    static const struct {
        const char *text, *told;
    } cases[] = {{"{\"rock\": {\"slope\": [5]}}", "rock.slope"},
                 {"{\"rock\": {\"slope\": [9, 5]}}", "rock.slope"},
                 {"{\"grass\": {}}", "'grass'"},
                 {"{\"soil\": {\"weight\": -1}}", "soil.weight"},
                 {"[1]", "an object"},
                 {"{\"rock\": ", "line 1"}};
    static float heights[WIDTH * HEIGHT];
    tl_source *source = make(plane, 1, heights);
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        char folder[64], path[96];
        tl_error error;
        tl_layer_options options = write_rules(folder, cases[k].text, path);
        assert_null(tl_layer_create(source, "splat", 0, &options, &error));
        assert_non_null(strstr(error.text, cases[k].told));
        assert_non_null(strstr(error.text, path));
        unlink(path), rmdir(folder);
    }
    tl_error error;
    assert_null(tl_layer_create(source, "shade", 0, NULL, &error));
    assert_non_null(strstr(error.text, "no layer 'shade'"));
    assert_null(tl_layer_create(source, "normal", 3, NULL, &error));
    assert_null(tl_layer_create(source, "sigma", 0, NULL, &error));
    assert_non_null(strstr(error.text, "--support point"));
    assert_int_equal(tl_write_layer(source, "normal", "x.tif", NULL, &error), TL_ERROR_ARGUMENT);
    assert_int_equal(tl_write_layer(source, "curvature", "x.png", NULL, &error), TL_ERROR_ARGUMENT);
    assert_int_equal(access("x.png", F_OK), -1);
    tl_source_destroy(source);
}

/* Exponents of a map, at the places of the finer lattice. */
static void hurstIsThatOfTheMap(void **state)
{
    (void)state;
    static float heights[WIDTH * HEIGHT], exponents[WIDTH * HEIGHT];
    tl_source *source = make(waves, 1, heights), *map = make(waves, 1, exponents);
    for (int k = 0; k < WIDTH * HEIGHT; k++)
        exponents[k] = 0.2f + 0.6f * (float)(k % WIDTH) / (WIDTH - 1);
    tl_field_options options = {
        .levels = 1, .hurst_map = map, .delta_given = true, .delta = 4, .support = TL_SUPPORT_POINT};
    tl_source *field = tl_field_create(source, &options, NULL);
    assert_non_null(field);
    float *hurst = read_layer(field, "hurst", NULL, (tl_window){10, 5, 40, 30});
    for (int k = 0; k < 40 * 30; k++)
        assert_near((double)hurst[k], 0.2 + 0.6 * (10 + k % 40) / 2.0 / (WIDTH - 1), 1e-5);
    free(hurst);
    tl_source_destroy(field);
    tl_source_destroy(map);
    tl_source_destroy(source);
}

/* Voids are 0, and what was filled is a half. */
static void masksTellWhatIsKnown(void **state)
{
    (void)state;
    static float heights[WIDTH * HEIGHT];
    tl_source *source = make(waves, 1, heights);
    heights[20 * WIDTH + 20] = NAN;
    tl_source *filled = tl_voids_create(source, &(tl_void_options){.rule = TL_VOIDS_FILL}, NULL);
    for (int kind = 0; kind < 2; kind++) {
        float *mask = read_layer(kind ? filled : source, "mask", NULL, whole);
        for (int k = 0; k < WIDTH * HEIGHT; k++)
            assert_true((double)mask[k] == (k != 20 * WIDTH + 20 ? 1 : kind ? 0.5 : 0));
        free(mask);
    }
    tl_source_destroy(filled);
    tl_source_destroy(source);
}

/* As strong as the place is rough: delta of the model where the strength is one. */
static void sigmaIsThatOfTheField(void **state)
{
    (void)state;
    static float heights[WIDTH * HEIGHT];
    tl_source *source = make(waves, 1, heights);
    tl_field_options options = {.levels = 2, .hurst_given = true, .hurst = 0.5, .delta_given = true, .delta = 4};
    tl_source *field = tl_field_create(source, &options, NULL);
    assert_non_null(field);
    float *sigma = read_layer(field, "sigma", NULL, (tl_window){3, 5, 40, 30});
    for (int k = 0; k < 40 * 30; k++)
        assert_near((double)sigma[k], 4 * pow(0.25, 0.5), 1e-5); /* over a quarter of the spacing */
    free(sigma);
    float *hurst = read_layer(field, "hurst", NULL, (tl_window){3, 5, 40, 30});
    for (int k = 0; k < 40 * 30; k++)
        assert_near((double)hurst[k], 0.5, 1e-6);
    free(hurst);
    tl_source_destroy(field);
    tl_source_destroy(source);
}

/* A map that says the same everywhere gives what the one exponent gives; of others, fBm's rule holds place by place. */
static void sigmaFollowsTheMapOfExponents(void **state)
{
    (void)state;
    static float heights[WIDTH * HEIGHT], exponents[WIDTH * HEIGHT];
    tl_source *source = make(waves, 1, heights), *map = make(waves, 1, exponents);
    for (int ramp = 0; ramp < 2; ramp++) {
        for (int k = 0; k < WIDTH * HEIGHT; k++)
            exponents[k] = ramp ? 0.2f + 0.6f * (float)(k % WIDTH) / (WIDTH - 1) : 0.25f;
        tl_field_options options = {
            .levels = 3, .hurst_map = map, .delta_given = true, .delta = 4, .support = TL_SUPPORT_POINT};
        tl_source *field = tl_field_create(source, &options, NULL);
        assert_non_null(field);
        float *sigma = read_layer(field, "sigma", NULL, (tl_window){10, 5, 40, 30});
        for (int k = 0; k < 40 * 30; k++) {
            double hurst = ramp ? 0.2 + 0.6 * (10 + k % 40) / 8.0 / (WIDTH - 1) : 0.25;
            assert_near((double)sigma[k], 4 * pow(0.125, hurst), 1e-5);
        }
        free(sigma);
        tl_source_destroy(field);
    }
    tl_source_destroy(map);
    tl_source_destroy(source);
}

/* Whatever way rows and columns are stored, a layer's upright samples are those of the heights turned first. */
static void turnedLayersAreThoseOfTurnedHeights(void **state)
{
    (void)state;
    static const char *const names[] = {"normal", "tangent", "slope", "curvature", "colour", "splat", "mask"};
    static float heights[WIDTH * HEIGHT];
    tl_source *source = make(waves, 1, heights);
    heights[700] = NAN;
    for (int turns = 0; turns < 4; turns++) {
        double *t = source->info.georef.transform;
        t[1] = turns & 1 ? -fabs(t[1]) : fabs(t[1]);
        t[5] = turns & 2 ? fabs(t[5]) : -fabs(t[5]);
        tl_source *upright = scene_north_up(source, NULL);
        for (size_t n = 0; n < sizeof names / sizeof *names; n++) {
            const tl_window part = {3, 4, 50, 20};
            scene_layer *layer = scene_layer_create(source, names[n], NULL, NULL);
            size_t channels = scene_layer_kind(layer)->channels, count = channels * 50 * 20;
            float *wanted = read_layer(upright, names[n], NULL, part), *found = malloc(count * sizeof *found);
            assert_int_equal(scene_layer_read_upright(layer, part, found, NULL), TL_OK);
            for (size_t k = 0; k < count; k++)
                if (!isnan(wanted[k]) || !isnan(found[k]))
                    assert_near((double)found[k], (double)wanted[k], 1e-6); /* of some, rows are summed backwards */
            free(found);
            free(wanted);
            scene_layer_destroy(layer);
        }
        tl_source_destroy(upright);
    }
    tl_source_destroy(source);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(planesHaveTheirNormalEverywhere),
        cmocka_unit_test(hollowsCurveUpwards),
        cmocka_unit_test(windowsJoin),
        cmocka_unit_test(sharesAddUpToOne),
        cmocka_unit_test(rulesShareTheGround),
        cmocka_unit_test(wrongRulesAreTold),
        cmocka_unit_test(sigmaIsThatOfTheField),
        cmocka_unit_test(sigmaFollowsTheMapOfExponents),
        cmocka_unit_test(turnedLayersAreThoseOfTurnedHeights),
        cmocka_unit_test(hurstIsThatOfTheMap),
        cmocka_unit_test(masksTellWhatIsKnown),
    };
    return cmocka_run_group_tests_name("layers", tests, NULL, NULL);
}
