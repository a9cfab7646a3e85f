/* Heights above the ellipsoid: undulations as PROJ has them, units, coverage, and what the CRS becomes. */
#include "dem/crs.h"
#include "lib/talus.h"

#include <math.h>
#include <proj.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

static char folder[64];

/* A raster of equal heights, with its CRS and array. */
typedef struct plain {
    tl_source *source;
    tl_crs *crs;
    float *heights;
    tl_source_info info;
} plain;

static plain plain_raster(const char *crs, const double t[6], int64_t width, int64_t height, tl_raster_type type,
                          float value)
{
    plain p = {.heights = malloc((size_t)(width * height) * sizeof(float))};
    for (int64_t k = 0; k < width * height; k++)
        p.heights[k] = value;
    if (crs)
        assert_int_equal(dem_crs_from_text(crs, "test", &p.crs, NULL), TL_OK);
    p.info = (tl_source_info){.width = width, .height = height, .type = type, .name = "test", .quantum = 1};
    p.info.georef = (tl_georef){.crs = p.crs, .located = t != NULL, .transform = {0, 1, 0, 0, 0, -1}, .height_unit = 1};
    if (t)
        memcpy(p.info.georef.transform, t, 6 * sizeof *t);
    dem_georef_measure(&p.info.georef, width, height, NULL);
    p.source = tl_array_source_create(p.heights, &p.info, NULL);
    assert_non_null(p.source);
    return p;
}

static void plain_finish(plain *p)
{
    tl_source_destroy(p->source);
    tl_crs_release(p->crs);
    free(p->heights);
}

static tl_source *above_ellipsoid(const plain *p, const char *grid)
{
    tl_error error = {0};
    tl_source *made = tl_geoid_create(p->source, &(tl_geoid_options){.grid = grid}, &error);
    if (!made)
        fail_msg("%s", error.text);
    return made;
}

/* PROJ's own way from heights of EGM96 to heights above the ellipsoid; NULL where it has no grid. */
static PJ *reference(PJ_CONTEXT *context)
{
    PJ *any = proj_create_crs_to_crs(context, "EPSG:4326+5773", "EPSG:4979", NULL);
    PJ *operation = any ? proj_normalize_for_visualization(context, any) : NULL;
    proj_destroy(any);
    PJ_COORD at = proj_trans(operation, PJ_FWD, proj_coord(10, 50, 0, 0));
    if (operation && fabs(at.lpz.z) > 1 && isfinite(at.lpz.z))
        return operation;
    proj_destroy(operation);
    return NULL;
}

/* The largest |undulation - PROJ's| over a raster of heights of 0, in metres. */
static double worst_difference(const tl_source *made, int level, PJ *operation)
{
    int64_t width, height;
    assert_int_equal(tl_source_size(made, level, &width, &height, NULL), TL_OK);
    float *row = malloc((size_t)width * sizeof *row);
    double *x = malloc((size_t)width * sizeof *x), *y = malloc((size_t)width * sizeof *y), worst = 0;
    double size = ldexp(1, -level), shift = made->info.type == TL_RASTER_AREA ? (size - 1) / 2 : 0;
    for (int64_t j = 0; j < height; j++) {
        tl_error error = {0};
        if (tl_source_read(made, level, (tl_window){0, j, width, 1}, row, &error) != TL_OK)
            fail_msg("%s", error.text);
        for (int64_t i = 0; i < width; i++) {
            x[i] = (double)i * size + shift;
            y[i] = (double)j * size + shift;
        }
        assert_int_equal(tl_georef_to_lonlat(&made->info.georef, (size_t)width, x, y, NULL), TL_OK);
        for (int64_t i = 0; i < width; i++) {
            PJ_COORD truth = proj_trans(operation, PJ_FWD, proj_coord(x[i], fmin(fmax(y[i], -90), 90), 0, 0));
            worst = fmax(worst, fabs((double)row[i] * made->info.georef.height_unit - truth.lpz.z));
        }
    }
    free(row);
    free(x);
    free(y);
    return worst;
}

/* Rasters of all scales against the kinks of the grid, which lie 0.25 degrees apart. */
static const struct place {
    const char *name, *crs;
    double transform[6];
    int64_t width, height;
    tl_raster_type type;
} places[] = {
    {"the globe", "EPSG:4326", {-180, 0.5, 0, 90, 0, -0.5}, 720, 361, TL_RASTER_POINT},
    {"the globe from 0 to 360", "EPSG:4326", {0.25, 0.5, 0, 89.75, 0, -0.5}, 720, 360, TL_RASTER_AREA},
    {"Fiji, across the antimeridian", "EPSG:4326", {177.013, 0.01, 0, -15.009, 0, -0.01}, 600, 300, TL_RASTER_AREA},
    {"the Alps at 1 second", "EPSG:4326", {10.97, 1 / 3600., 0, 47.03, 0, -1 / 3600.}, 700, 300, TL_RASTER_AREA},
    {"the Alps at 9 seconds", "EPSG:4326", {6.97, 1 / 400., 0, 47.03, 0, -1 / 400.}, 700, 600, TL_RASTER_POINT},
    {"the Andes in UTM", "EPSG:32719", {400000, 90, 0, 6400000, 0, -90}, 520, 400, TL_RASTER_AREA},
    {"the South Pole", "EPSG:3031", {-256000, 1000, 0, 256000, 0, -1000}, 513, 513, TL_RASTER_POINT},
    {"Tennessee in feet", "EPSG:2274+8228", {1900000, 300, 0, 700000, 0, -300}, 300, 300, TL_RASTER_AREA},
    {"a rotated grid", "EPSG:32632", {500000, 60, 35, 5200000, 35, -60}, 300, 300, TL_RASTER_AREA},
    {"a single sample", "EPSG:4326", {86.925, 1e-4, 0, 27.988, 0, -1e-4}, 1, 1, TL_RASTER_AREA},
};

static void undulationsAreThoseOfProjToAMillimetre(void **state)
{
    (void)state;
    PJ_CONTEXT *context = proj_context_create();
    PJ *operation = reference(context);
    for (size_t k = 0; operation && k < sizeof places / sizeof *places; k++) {
        plain p =
            plain_raster(places[k].crs, places[k].transform, places[k].width, places[k].height, places[k].type, 0);
        tl_source *made = above_ellipsoid(&p, "egm96");
        double worst = worst_difference(made, 0, operation);
        print_message("%s: %.3f mm\n", places[k].name, worst * 1000);
        if (!(worst < 5e-4))
            fail_msg("%s: %g m from PROJ", places[k].name, worst);
        tl_source_destroy(made);
        plain_finish(&p);
    }
    bool skipped = !operation;
    proj_destroy(operation);
    proj_context_destroy(context);
    if (skipped)
        skip();
}

static bool has_egm96(void)
{
    PJ_CONTEXT *context = proj_context_create();
    PJ *operation = reference(context);
    bool found = operation != NULL;
    proj_destroy(operation);
    proj_context_destroy(context);
    return found;
}

/* What is read does not depend on the window, and voids stay voids. */
static void windowsArePartsOfTheWhole(void **state)
{
    (void)state;
    if (!has_egm96())
        skip();
    plain p =
        plain_raster("EPSG:4326", (double[]){6.97, 1 / 400., 0, 47.03, 0, -1 / 400.}, 600, 520, TL_RASTER_AREA, 7);
    p.heights[3 * 600 + 300] = NAN;
    tl_source *made = above_ellipsoid(&p, "egm96"), *again = above_ellipsoid(&p, "egm96");
    float *whole = malloc(600 * 520 * sizeof *whole), part[70 * 90];
    assert_int_equal(tl_source_read(made, 0, (tl_window){0, 0, 600, 520}, whole, NULL), TL_OK);
    assert_true(isnan(whole[3 * 600 + 300]));
    for (int64_t at = 0; at < 430; at += 43) {
        assert_int_equal(tl_source_read(again, 0, (tl_window){at, at, 70, 90}, part, NULL), TL_OK);
        for (int64_t y = 0; y < 90; y++)
            assert_memory_equal(part + y * 70, whole + (at + y) * 600 + at, 70 * sizeof *part);
    }
    unsigned char validity[2];
    assert_int_equal(tl_source_validity(made, 0, (tl_window){299, 3, 2, 1}, validity, NULL), TL_OK);
    assert_int_equal(validity[0], TL_MEASURED);
    assert_int_equal(validity[1], TL_VOID);
    free(whole);
    tl_source_destroy(made);
    tl_source_destroy(again);
    plain_finish(&p);
}

/* ---- a grid of one's own ---- */

static void put(FILE *file, const void *value, size_t size)
{
    const unsigned char *bytes = value; /* a .gtx is big-endian */
    for (size_t k = size; k-- > 0;)
        fputc(bytes[k], file);
}

/* The plane 2 + longitude / 10 + latitude / 5 over 0...4 degrees east and 40...44 north, at every half degree. */
static const char *make_gtx(const char *name)
{
    static char path[128];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *file = fopen(path, "wb");
    assert_non_null(file);
    const double corner[4] = {40, 0, 0.5, 0.5};
    const int32_t size[2] = {9, 9};
    for (int k = 0; k < 4; k++)
        put(file, &corner[k], sizeof corner[k]);
    for (int k = 0; k < 2; k++)
        put(file, &size[k], sizeof size[k]);
    for (int j = 0; j < 9; j++)
        for (int i = 0; i < 9; i++) {
            float value = (float)(2 + 0.05 * i + (40 + 0.5 * j) / 5);
            put(file, &value, sizeof value);
        }
    assert_int_equal(fclose(file), 0);
    return path;
}

static double plane(double longitude, double latitude)
{
    return 2 + longitude / 10 + latitude / 5;
}

static void feetGetUndulationsInFeet(void **state)
{
    (void)state;
    const double foot = 0.3048;
    plain p = plain_raster("EPSG:4326", (double[]){1, 0.01, 0, 43, 0, -0.01}, 50, 40, TL_RASTER_POINT, 1000);
    ((tl_source *)p.source)->info.georef.height_unit = foot;
    tl_source *made = above_ellipsoid(&p, make_gtx("a grid, with a name.gtx"));
    float heights[50];
    assert_int_equal(tl_source_read(made, 0, (tl_window){0, 20, 50, 1}, heights, NULL), TL_OK);
    for (int i = 0; i < 50; i++) /* 4e-5: half the last digit of a float */
        if (!(fabs((double)heights[i] - (1000 + plane(1 + 0.01 * i, 42.8) / foot)) < 5e-4 / foot + 4e-5))
            fail_msg("column %d: %.9g", i, (double)heights[i]);
    assert_true(made->info.georef.height_unit == foot);
    assert_non_null(strstr(tl_crs_wkt(made->info.georef.crs), "LENGTHUNIT[\"foot\",0.3048]"));
    assert_string_equal(tl_crs_vertical_name(made->info.georef.crs), "ellipsoidal height");
    assert_int_equal(tl_crs_epsg(made->info.georef.crs), 4326);
    assert_true(made->info.quantum == 0);
    tl_source_destroy(made);
    plain_finish(&p);
}

/* Longitudes of a CRS count from its own prime meridian, those of grids from Greenwich. */
static void longitudesFromParisAreShifted(void **state)
{
    (void)state;
    plain p = plain_raster("EPSG:4807", (double[]){0, 0.01, 0, 43, 0, -0.01}, 10, 10, TL_RASTER_POINT, 0);
    tl_source *made = above_ellipsoid(&p, make_gtx("paris.gtx"));
    double i = 5, j = 5, paris = 2.5969213 * 0.9; /* grads */
    float height;
    assert_int_equal(tl_georef_to_lonlat(&made->info.georef, 1, &i, &j, NULL), TL_OK);
    assert_int_equal(tl_source_read(made, 0, (tl_window){5, 5, 1, 1}, &height, NULL), TL_OK);
    assert_true(fabs((double)height - plane(i + paris, j)) < 5e-4);
    tl_source_destroy(made);
    plain_finish(&p);
}

static void heightsBeyondTheGridAreRefusedAndVoidsAreNot(void **state)
{
    (void)state;
    plain p = plain_raster("EPSG:4326", (double[]){3.5, 0.1, 0, 43, 0, -0.1}, 20, 10, TL_RASTER_POINT, 5);
    tl_source *made = above_ellipsoid(&p, make_gtx("small.gtx"));
    float heights[200];
    tl_error error = {0};
    assert_int_equal(tl_source_read(made, 0, (tl_window){0, 0, 5, 10}, heights, NULL), TL_OK);
    assert_int_equal(tl_source_read(made, 0, (tl_window){0, 0, 20, 10}, heights, &error), TL_ERROR_DATA);
    assert_non_null(strstr(error.text, "longitude 4.1, latitude 43"));
    assert_non_null(strstr(error.text, "small.gtx"));
    for (int k = 0; k < 200; k++)
        if (k % 20 > 5)
            p.heights[k] = NAN;
    assert_int_equal(tl_source_read(made, 0, (tl_window){0, 0, 20, 10}, heights, NULL), TL_OK);
    assert_true(fabs((double)heights[0] - 5 - plane(3.5, 43)) < 5e-4);
    assert_true(isnan(heights[19]));
    tl_source_destroy(made);
    plain_finish(&p);
}

/* A level's sample gets the undulation at its own place: that of an area's cell, or the point itself. */
static void coarserLevelsAreAtTheirOwnPlaces(void **state)
{
    (void)state;
    char path[128];
    for (int type = 0; type < 2; type++) {
        plain p = plain_raster("EPSG:4326", (double[]){1, 0.01, 0, 43, 0, -0.01}, 64, 64, (tl_raster_type)type, 100);
        snprintf(path, sizeof path, "%s/levels%d.tif", folder, type);
        assert_int_equal(tl_write_grid(p.source, path, NULL, NULL), TL_OK);
        tl_source *file = tl_open(path, NULL);
        assert_non_null(file);
        tl_source *made = tl_geoid_create(file, &(tl_geoid_options){.grid = make_gtx("levels.gtx")}, NULL);
        assert_non_null(made);
        float heights[16 * 16];
        assert_int_equal(tl_source_read(made, -2, (tl_window){0, 0, 16, 16}, heights, NULL), TL_OK);
        double shift = type == TL_RASTER_AREA ? 1.5 : 0;
        for (int k = 0; k < 256; k++) {
            double i = k % 16 * 4 + shift, j = k / 16 * 4 + shift;
            if (!(fabs((double)heights[k] - 100 - plane(1 + 0.01 * i, 43 - 0.01 * j)) < 5e-4))
                fail_msg("type %d, sample %d: %.9g", type, k, (double)heights[k]);
        }
        tl_source_destroy(made);
        tl_source_destroy(file);
        plain_finish(&p);
    }
}

/* ---- what the CRS becomes ---- */

static void filesTellThatHeightsAreEllipsoidal(void **state)
{
    (void)state;
    static const char *const systems[] = {"EPSG:4326",      "EPSG:4269",      "EPSG:32631",
                                          "EPSG:4326+5773", "EPSG:2154+5720", "EPSG:23031"};
    static const char *const endings[] = {"tif", "exr"};
    char path[128];
    tl_write_options options = {.overwrite = true};
    for (size_t k = 0; k < sizeof systems / sizeof *systems; k++) {
        tl_crs *crs;
        assert_int_equal(dem_crs_from_text(systems[k], "test", &crs, NULL), TL_OK);
        double t[6] = {1, 0.001, 0, 42, 0, -0.001};
        if (!tl_crs_is_geographic(crs)) {
            dem_projection *projection = dem_projection_create(crs, NULL);
            dem_projection_from_lonlat(projection, 1, &t[0], &t[3]);
            dem_projection_destroy(projection);
            t[1] = 30;
            t[5] = -30;
        }
        plain p = plain_raster(systems[k], t, 8, 8, TL_RASTER_AREA, 1);
        tl_source *made = above_ellipsoid(&p, make_gtx("files.gtx"));
        for (int e = 0; e < 2; e++) {
            snprintf(path, sizeof path, "%s/made.%s", folder, endings[e]);
            assert_int_equal(tl_write_grid(made, path, &options, NULL), TL_OK);
            tl_source *back = tl_open(path, NULL);
            assert_non_null(back);
            assert_string_equal(tl_crs_vertical_name(back->info.georef.crs), "ellipsoidal height");
            assert_int_equal(tl_crs_epsg(back->info.georef.crs), tl_crs_epsg(crs));
            tl_error error = {0};
            assert_null(tl_geoid_create(back, &(tl_geoid_options){.grid = "egm96"}, &error));
            assert_non_null(strstr(error.text, k == 5 ? "not on the ellipsoid" : "already"));
            tl_source_destroy(back);
        }
        tl_source_destroy(made);
        plain_finish(&p);
        tl_crs_release(crs);
    }
}

static void expect_refused(const plain *p, const char *grid, tl_status status, const char *word)
{
    tl_error error = {0};
    tl_source *made = tl_geoid_create(p->source, &(tl_geoid_options){.grid = grid}, &error);
    if (made)
        fail_msg("taken: %s with %s", p->crs ? tl_crs_wkt(p->crs) : "no CRS", grid);
    assert_int_equal(error.status, status);
    if (!strstr(error.text, word))
        fail_msg("'%s' lacks '%s'", error.text, word);
}

static void whatHasNoGeoidIsRefused(void **state)
{
    (void)state;
    const double t[6] = {1, 0.001, 0, 42, 0, -0.001};
    plain nowhere = plain_raster("EPSG:4326", NULL, 4, 4, TL_RASTER_AREA, 0);
    plain unknown = plain_raster(NULL, t, 4, 4, TL_RASTER_AREA, 0);
    plain above = plain_raster("EPSG:4979", t, 4, 4, TL_RASTER_AREA, 0);
    plain depths = plain_raster("EPSG:4326+5715", t, 4, 4, TL_RASTER_AREA, 0);
    plain mars = plain_raster("+proj=longlat +a=3396190 +b=3376200", t, 4, 4, TL_RASTER_AREA, 0);
    plain good = plain_raster("EPSG:4326", t, 4, 4, TL_RASTER_AREA, 0);
    expect_refused(&nowhere, "egm96", TL_ERROR_DATA, "place");
    expect_refused(&unknown, "egm96", TL_ERROR_DATA, "coordinate reference system");
    expect_refused(&above, "egm96", TL_ERROR_ARGUMENT, "already");
    expect_refused(&depths, "egm96", TL_ERROR_ARGUMENT, "depth");
    expect_refused(&mars, "egm96", TL_ERROR_ARGUMENT, "EGM96");
    expect_refused(&good, "/nowhere/absent.gtx", TL_ERROR_IO, "/nowhere/absent.gtx");
    expect_refused(&good, folder, TL_ERROR_DATA, folder);
    char path[128];
    snprintf(path, sizeof path, "%s/short.gtx", folder);
    FILE *file = fopen(path, "wb");
    fputs("no grid", file);
    fclose(file);
    expect_refused(&good, path, TL_ERROR_DATA, "short.gtx");
    tl_source *on_mars = above_ellipsoid(&mars, make_gtx("areoid.gtx")); /* one's own grid is one's own business */
    tl_source_destroy(on_mars);
    plain_finish(&nowhere);
    plain_finish(&unknown);
    plain_finish(&above);
    plain_finish(&depths);
    plain_finish(&mars);
    plain_finish(&good);
}

static int make_folder(void **state)
{
    (void)state;
    strcpy(folder, "/tmp/talus-geoid-XXXXXX");
    return mkdtemp(folder) ? 0 : -1;
}

static int remove_folder(void **state)
{
    (void)state;
    char command[128];
    snprintf(command, sizeof command, "rm -r %s", folder);
    return system(command);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(undulationsAreThoseOfProjToAMillimetre),
        cmocka_unit_test(windowsArePartsOfTheWhole),
        cmocka_unit_test(feetGetUndulationsInFeet),
        cmocka_unit_test(longitudesFromParisAreShifted),
        cmocka_unit_test(heightsBeyondTheGridAreRefusedAndVoidsAreNot),
        cmocka_unit_test(coarserLevelsAreAtTheirOwnPlaces),
        cmocka_unit_test(filesTellThatHeightsAreEllipsoidal),
        cmocka_unit_test(whatHasNoGeoidIsRefused),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
