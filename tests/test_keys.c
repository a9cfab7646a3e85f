/* CRSs through files: GeoTIFF to EXR and back, with keys and without. */
#include "dem/crs.h"
#include "dem/crs_keys.h"
#include "lib/talus.h"
#include "make_tiff.h"

#include <dirent.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

static char folder[64], paths[4][96]; /* of a GeoTIFF, an EXR, another GeoTIFF, and one with keys of its own */

static tl_source *open_ok(const char *path)
{
    tl_error error;
    tl_source *source = tl_open(path, &error);
    if (!source)
        fail_msg("%s", error.text);
    return source;
}

static void write_ok(const tl_source *source, const char *path)
{
    tl_error error;
    if (tl_write_grid(source, path, &(tl_write_options){.overwrite = true}, &error) != TL_OK)
        fail_msg("%s", error.text);
}

/* Two by two heights at the place of a CRS; what they point to is the CRS's. */
static tl_source *small(const tl_crs *crs, double height_unit)
{
    static const float heights[4] = {1, 2, 3, 4};
    tl_source_info info = {.width = 2, .height = 2, .name = "small", .has_voids = false};
    info.georef = (tl_georef){.crs = crs,
                              .located = true,
                              .transform = {10, 0.5, 0, 20, 0, -0.5},
                              .height_unit = height_unit,
                              .cell_x = 1,
                              .cell_y = 1};
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    assert_non_null(source);
    return source;
}

/* Whether a point of one map is the same place on the other, to a millimetre, on the same ellipsoid. Datums without a
 * code have names only, which ESRI spells otherwise than PROJ. */
static bool same_map(const tl_crs *a, const tl_crs *b)
{
    double x = 10.25, y = a->geographic ? 50.125 : 80;
    dem_projection *p = dem_projection_create(a, NULL), *q = dem_projection_create(b, NULL);
    dem_projection_from_lonlat(p, 1, &x, &y);
    double to_x = x, to_y = y, back_x = x, back_y = y;
    dem_projection_to_lonlat(p, 1, &to_x, &to_y);
    dem_projection_to_lonlat(q, 1, &back_x, &back_y);
    dem_projection_destroy(p);
    dem_projection_destroy(q);
    return a->geographic == b->geographic && fabs(a->semi_major - b->semi_major) < 1e-6 &&
           fabs(a->flattening - b->flattening) < 1e-12 && fabs(to_x - back_x) < 1e-8 && fabs(to_y - back_y) < 1e-8;
}

/* Both mean the same in every respect; `what` is for messages. */
static void same_crs(const tl_georef *a, const tl_georef *b, const char *what)
{
    if (!a->crs || !b->crs)
        fail_msg("%s: lost", what);
    if (!dem_crs_equivalent(a->crs, b->crs) && !same_map(a->crs, b->crs))
        fail_msg("%s: became another: %s", what, tl_crs_wkt(b->crs));
    if (tl_crs_epsg(a->crs) != tl_crs_epsg(b->crs))
        fail_msg("%s: EPSG:%d became EPSG:%d", what, tl_crs_epsg(a->crs), tl_crs_epsg(b->crs));
    if (strcmp(tl_crs_vertical_name(a->crs), tl_crs_vertical_name(b->crs)) != 0)
        fail_msg("%s: heights '%s' became '%s'", what, tl_crs_vertical_name(a->crs), tl_crs_vertical_name(b->crs));
    assert_int_equal(tl_crs_vertical_epsg(a->crs), tl_crs_vertical_epsg(b->crs));
    if (!(fabs(a->height_unit / b->height_unit - 1) < 1e-9))
        fail_msg("%s: a unit of height of %.9g m became %.9g m", what, a->height_unit, b->height_unit);
}

static void same_keys(const tl_crs *a, const tl_crs *b)
{
    char *first = dem_crs_keys_text(a), *second = dem_crs_keys_text(b);
    assert_non_null(first);
    assert_non_null(second);
    assert_string_equal(first, second);
    free(first);
    free(second);
}

/* Texts of every kind of CRS, as a program may give them, or an EXR that has no keys. */
static const char *const systems[] = {
    "EPSG:4326",
    "EPSG:32632",
    "EPSG:2274",
    "EPSG:4326+5773",
    "EPSG:25832+5783",
    "EPSG:2274+6360",
    "EPSG:4979",
    "EPSG:4807",
    "EPSG:2056",
    "EPSG:3031",
    "+proj=lcc +lat_1=30 +lat_2=60 +lat_0=45 +lon_0=10 +x_0=4000000 +y_0=2800000 +ellps=GRS80 +units=m",
    "+proj=aea +lat_1=29.5 +lat_2=45.5 +lat_0=23 +lon_0=-96 +datum=NAD83 +units=us-ft",
    "+proj=tmerc +lat_0=0 +lon_0=15.5 +k=0.99987 +x_0=123456.789 +y_0=-5000 +ellps=bessel",
    "+proj=laea +lat_0=52 +lon_0=10 +ellps=WGS84",
    "+proj=longlat +a=3396190 +b=3376200",
    "+proj=longlat +R=1737400",
    "+proj=stere +lat_0=90 +lon_0=0 +k=1 +a=3396190 +b=3376200",
    "+proj=eqc +lat_ts=0 +lon_0=180 +R=1737400",
};

/* GDAL reads a definition in words where the keys call the model the user's own, and nowhere else. */
static void knows_definition(const tl_crs *crs)
{
    int model = 0;
    for (size_t at = 4; at + 4 <= crs->key_directory_count; at += 4)
        if (crs->key_directory[at] == 1024)
            model = crs->key_directory[at + 3];
    assert_int_equal(model, crs->geographic ? 2 : tl_crs_epsg(crs) ? 1 : 32767);
}

static void systemsWithoutKeysSurviveGeotiffAndExr(void **state)
{
    (void)state;
    for (size_t k = 0; k < sizeof systems / sizeof *systems; k++) {
        tl_crs *crs = NULL;
        assert_int_equal(dem_crs_from_text(systems[k], "test", &crs, NULL), TL_OK);
        tl_source *source = small(crs, crs->vertical_unit > 0 ? crs->vertical_unit : 1), *back[3];
        write_ok(source, paths[0]);
        back[0] = open_ok(paths[0]);
        write_ok(source, paths[1]);
        back[1] = open_ok(paths[1]);
        write_ok(back[1], paths[2]);
        back[2] = open_ok(paths[2]);
        knows_definition(back[2]->info.georef.crs);
        for (int i = 0; i < 3; i++) {
            same_crs(&source->info.georef, &back[i]->info.georef, systems[k]);
            tl_source_destroy(back[i]);
        }
        tl_source_destroy(source);
        tl_crs_release(crs);
    }
}

/* What keys say beyond a CRS's meaning (names, parameters, datum shifts) is in the last file as in the first. */
static void through_all(const tl_source *file, const char *what)
{
    tl_source *source = small(file->info.georef.crs, file->info.georef.height_unit);
    write_ok(source, paths[0]);
    tl_source *first = open_ok(paths[0]);
    write_ok(first, paths[1]);
    tl_source *middle = open_ok(paths[1]);
    write_ok(middle, paths[2]);
    tl_source *last = open_ok(paths[2]);
    same_crs(&source->info.georef, &last->info.georef, what);
    if (source->info.georef.crs->key_directory_count)
        same_keys(first->info.georef.crs, last->info.georef.crs);
    tl_source_destroy(last);
    tl_source_destroy(middle);
    tl_source_destroy(first);
    tl_source_destroy(source);
}

/* A user-defined Lambert conformal conic on a user-defined datum with a shift, in feet. */
static const uint16_t lambert_keys[] = {
    1024,  0,     1,    1,     1025, 0,     1,     1,     1026, 34737, 7,     0,    2048, 0,     1,     32767, 2049,
    34737, 6,     7,    2050,  0,    1,     32767, 2054,  0,    1,     9102,  2056, 0,    1,     32767, 2057,  34736,
    1,     0,     2059, 34736, 1,    1,     2062,  34736, 7,    2,     3072,  0,    1,    32767, 3074,  0,     1,
    32767, 3075,  0,    1,     8,    3076,  0,     1,     9003, 3078,  34736, 1,    9,    3079,  34736, 1,     10,
    3084,  34736, 1,    11,    3085, 34736, 1,     12,    3086, 34736, 1,     13,   3087, 34736, 1,     14};
static const double lambert_doubles[] = {
    6378206.4,      294.978698213898,  -8,     160, 176, 0.1, -0.2, 0.3, 1.5, 28 + 23 / 60.0, 30 + 17 / 60.0, -99,
    27 + 50 / 60.0, 2000000.123456789, 1 / 3.0};

static void userDefinedKeysComeThroughUnchanged(void **state)
{
    (void)state;
    tl_source *file = open_ok(paths[3]);
    const tl_crs *crs = file->info.georef.crs;
    assert_non_null(crs);
    assert_int_equal(tl_crs_epsg(crs), 0);
    assert_int_equal(strncmp(tl_crs_wkt(crs), "BOUNDCRS[", 9), 0);
    assert_non_null(strstr(tl_crs_wkt(crs), "\"Z-axis translation\",176"));
    assert_non_null(strstr(tl_crs_wkt(crs), "\"Z-axis rotation\",0.3"));
    write_ok(file, paths[1]);
    tl_source *middle = open_ok(paths[1]);
    assert_string_equal(tl_crs_wkt(middle->info.georef.crs), tl_crs_wkt(crs));
    write_ok(middle, paths[2]);
    tl_source *last = open_ok(paths[2]);
    assert_string_equal(tl_crs_wkt(last->info.georef.crs), tl_crs_wkt(crs));
    assert_true(last->info.georef.cell_x == file->info.georef.cell_x);
    same_crs(&file->info.georef, &last->info.georef, "user-defined keys");
    tl_source_destroy(last);
    tl_source_destroy(middle);
    through_all(file, "user-defined keys");
    tl_source_destroy(file);
}

/* What stands in the attribute may be anything. */
static void unsoundTextsOfKeysAreLeftOut(void **state)
{
    (void)state;
    static const char *const texts[] = {"",
                                        ";;",
                                        "1 1 0",
                                        "1 1 0;;;;",
                                        "x",
                                        "1 1 0 1 1024 0 1 -1;;",
                                        "99999999999999999999999999 1 0 1;zz;",
                                        "1 1 0 9 2057 34736 1 5 2059 34736 9 0;3ff0000000000000;",
                                        "1 1 0 1 2057 34736 1 0;7ff0000000000000;",
                                        "1 1 0 1 1026 34737 99 0;;short|"};
    for (size_t k = 0; k < sizeof texts / sizeof *texts; k++) {
        tl_crs *crs = NULL;
        assert_int_equal(dem_crs_from_text("EPSG:4326", "test", &crs, NULL), TL_OK);
        assert_int_equal(dem_crs_take_keys(crs, texts[k], "test", NULL), TL_OK);
        if (crs->key_directory_count > 4)
            fail_msg("'%s' became keys", texts[k]);
        tl_source *source = small(crs, 1);
        write_ok(source, paths[0]);
        tl_source_destroy(source);
        tl_crs_release(crs);
    }
}

static bool is_tiff(const char *name)
{
    const char *dot = strrchr(name, '.');
    return dot && (strcmp(dot, ".tif") == 0 || strcmp(dot, ".tiff") == 0);
}

static size_t through_folder(const char *shared, const char *part)
{
    char place[512], path[1024];
    size_t seen = 0;
    snprintf(place, sizeof place, "%s/%s", shared, part);
    DIR *dir = opendir(place);
    for (struct dirent *e; dir && (e = readdir(dir));) {
        snprintf(path, sizeof path, "%s/%s", place, e->d_name);
        tl_source *file = is_tiff(e->d_name) ? tl_dem_open((const char *const[]){path}, 1, NULL, NULL) : NULL;
        if (file && file->info.georef.crs) {
            through_all(file, e->d_name);
            seen++;
        }
        tl_source_destroy(file);
    }
    if (dir)
        closedir(dir);
    return seen;
}

static void crsOfRealFilesSurvive(void **state)
{
    (void)state;
    char place[512];
    const char *shared = getenv("TALUS_SHARED"), *root = getenv("TALUS_SOURCE_ROOT");
    if (shared)
        snprintf(place, sizeof place, "%s", shared);
    else
        snprintf(place, sizeof place, "%s/../shared/data", root ? root : ".");
    size_t seen = through_folder(place, "dem") + through_folder(place, "odd") + through_folder(place, "variants");
    print_message("%zu files\n", seen);
    if (!seen)
        skip();
}

/* Before talus writes one: libgeotiff, once at work, makes libtiff take its tags in another way. */
static bool make_user_defined(void)
{
    const double scale[] = {10, 10, 0}, tie[] = {0, 0, 0, 2963503.91, 254759.80, 0};
    return make_tiff(paths[3], &(make_tiff_options){.width = 3,
                                                    .height = 3,
                                                    .keys = lambert_keys,
                                                    .key_count = sizeof lambert_keys / sizeof *lambert_keys / 4,
                                                    .key_doubles = lambert_doubles,
                                                    .key_double_count = 15,
                                                    .key_ascii = "My map|Mine |",
                                                    .scale = scale,
                                                    .ties = tie});
}

static int make_folder(void **state)
{
    (void)state;
    static const char *const names[] = {"first.tif", "middle.exr", "last.tif", "keys.tif"};
    strcpy(folder, "/tmp/talus-keys-XXXXXX");
    if (!mkdtemp(folder))
        return -1;
    for (int k = 0; k < 4; k++)
        snprintf(paths[k], sizeof paths[k], "%s/%s", folder, names[k]);
    return make_user_defined() ? 0 : -1;
}

static int remove_folder(void **state)
{
    (void)state;
    for (int k = 0; k < 4; k++)
        unlink(paths[k]);
    return rmdir(folder);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(systemsWithoutKeysSurviveGeotiffAndExr),
        cmocka_unit_test(userDefinedKeysComeThroughUnchanged),
        cmocka_unit_test(unsoundTextsOfKeysAreLeftOut),
        cmocka_unit_test(crsOfRealFilesSurvive),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
