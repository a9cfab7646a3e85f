/* Coordinate reference systems: what the keys mean, longitude and latitude, local frames, cells in metres. */
#include "dem/crs.h"
#include "dem/geographiclib.h"
#include "lib/talus.h"
#include "make_tiff.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

static const double wgs84_a = 6378137, wgs84_f = 1 / 298.257223563, radians = 0.017453292519943295;
static char folder[64], path[96];

static tl_crs *crs_of(const char *text)
{
    tl_crs *crs = NULL;
    tl_error error = {0};
    if (dem_crs_from_text(text, "test", &crs, &error) != TL_OK)
        fail_msg("%s", error.text);
    return crs;
}

static void close_to(double value, double expected, double tolerance)
{
    if (!(fabs(value - expected) <= tolerance))
        fail_msg("%.15g instead of %.15g +- %g", value, expected, tolerance);
}

static void to_lonlat(const tl_crs *crs, double x, double y, double lonlat[2])
{
    dem_projection *projection = dem_projection_create(crs, NULL);
    assert_non_null(projection);
    dem_projection_to_lonlat(projection, 1, &x, &y);
    dem_projection_destroy(projection);
    lonlat[0] = x;
    lonlat[1] = y;
}

/* A file with these keys; its source. */
static tl_source *open_with(const uint16_t *keys, unsigned count, const double *doubles, unsigned double_count,
                            const char *ascii, const double *scale, const double *tie)
{
    assert_true(make_tiff(path, &(make_tiff_options){.width = 3,
                                                     .height = 3,
                                                     .keys = keys,
                                                     .key_count = count,
                                                     .key_doubles = doubles,
                                                     .key_double_count = double_count,
                                                     .key_ascii = ascii,
                                                     .scale = scale,
                                                     .ties = tie}));
    tl_source *source = tl_dem_open((const char *const[]){path}, 1, NULL, NULL);
    assert_non_null(source);
    return source;
}

static void utmAgreesWithGeographicLib(void **state)
{
    (void)state;
    const struct {
        const char *text, *name;
        int epsg, zone;
        bool north;
    } zones[] = {{"EPSG:32633", "WGS 84 / UTM zone 33N", 32633, 33, true},
                 {"EPSG:32719", "WGS 84 / UTM zone 19S", 32719, 19, false}};
    for (size_t k = 0; k < 2; k++) {
        tl_crs *crs = crs_of(zones[k].text);
        assert_string_equal(tl_crs_name(crs), zones[k].name);
        assert_int_equal(tl_crs_epsg(crs), zones[k].epsg);
        assert_false(tl_crs_is_geographic(crs));
        assert_true(crs->unit == 1 && crs->semi_major == wgs84_a);
        close_to(crs->flattening, wgs84_f, 1e-15);
        assert_non_null(strstr(tl_crs_wkt(crs), "PROJCRS"));
        assert_null(strchr(tl_crs_wkt(crs), '\n'));
        for (double easting = 200000; easting <= 800000; easting += 150000)
            for (double northing = 1000000; northing < 9000000; northing += 1500000) {
                double lonlat[2], longitude, latitude;
                to_lonlat(crs, easting, northing, lonlat);
                assert_true(dem_utm_to_lonlat(zones[k].zone, zones[k].north, easting, northing, &longitude, &latitude));
                close_to(lonlat[0], longitude, 1e-9); /* 0.1 mm */
                close_to(lonlat[1], latitude, 1e-9);
            }
        tl_crs_release(crs);
    }
}

/* IOGP Guidance Note 7-2, Popular Visualisation Pseudo Mercator: coordinates of 1 cm, angles of 0.001". */
static void webMercatorAgreesWithThePublishedExample(void **state)
{
    (void)state;
    tl_crs *crs = crs_of("EPSG:3857");
    double lonlat[2];
    to_lonlat(crs, -11169055.58, 2800000.00, lonlat);
    close_to(lonlat[0], -(100 + 20 / 60.0), 0.0005 / 3600 + 0.005 / 111000);
    close_to(lonlat[1], 24 + 22 / 60.0 + 54.433 / 3600, 0.0005 / 3600 + 0.005 / 111000);
    tl_crs_release(crs);
}

/* IOGP Guidance Note 7-2, Lambert Conic Conformal (2SP), with keys that give every parameter, in feet of 1/100. */
static void userDefinedLambertAgreesWithThePublishedExample(void **state)
{
    (void)state;
    const uint16_t keys[] = {1024, 0,     1, 1,     1025, 0,     1, 1, 2048, 0,     1, 4267,  2054, 0,     1, 9102,
                             3072, 0,     1, 32767, 3073, 34737, 9, 0, 3074, 0,     1, 32767, 3075, 0,     1, 8,
                             3076, 0,     1, 9003,  3078, 34736, 1, 0, 3079, 34736, 1, 1,     3084, 34736, 1, 2,
                             3085, 34736, 1, 3,     3086, 34736, 1, 4, 3087, 34736, 1, 5};
    const double doubles[] = {28 + 23 / 60.0, 30 + 17 / 60.0, -99, 27 + 50 / 60.0, 2000000, 0};
    const double scale[] = {10, 10, 0}, tie[] = {0, 0, 0, 2963503.91, 254759.80, 0};
    tl_source *source = open_with(keys, 15, doubles, 6, "Texas SC|", scale, tie);
    const tl_georef *georef = &source->info.georef;
    assert_non_null(georef->crs);
    assert_string_equal(tl_crs_name(georef->crs), "Texas SC");
    assert_int_equal(tl_crs_epsg(georef->crs), 0);
    close_to(georef->crs->unit, 1200.0 / 3937.0, 1e-15);
    close_to(georef->crs->semi_major, 6378206.4, 1e-6);
    close_to(georef->cell_x, 10 * 1200.0 / 3937.0, 1e-12);
    assert_int_equal(georef->crs->key_directory_count, 64);
    assert_int_equal(georef->crs->key_double_count, 6);
    double lonlat[2];
    to_lonlat(georef->crs, 2963503.91, 254759.80, lonlat);
    close_to(lonlat[0], -96, 0.005 * 0.3048 / 97000); /* half a hundredth of a foot in a degree of longitude there */
    close_to(lonlat[1], 28.5, 0.005 * 0.3048 / 110000);
    tl_source_destroy(source);
}

static void ellipsoidsOfOtherBodiesAreKept(void **state)
{
    (void)state;
    const uint16_t keys[] = {1024, 0,     1, 2,     1025, 0,     1, 1,     2048, 0,     1, 32767,
                             2049, 34737, 5, 0,     2050, 0,     1, 32767, 2054, 0,     1, 9102,
                             2056, 0,     1, 32767, 2057, 34736, 1, 0,     2058, 34736, 1, 1};
    const double doubles[] = {3396190, 3376200}, scale[] = {1.0 / 64, 1.0 / 64, 0}, tie[] = {1.5, 1.5, 0, 0, 0, 0};
    tl_source *source = open_with(keys, 9, doubles, 2, "Mars|", scale, tie);
    const tl_georef *georef = &source->info.georef;
    assert_non_null(georef->crs);
    assert_true(tl_crs_is_geographic(georef->crs));
    assert_string_equal(tl_crs_name(georef->crs), "Mars");
    close_to(georef->crs->semi_major, 3396190, 1e-6);
    close_to(georef->crs->flattening, (3396190.0 - 3376200.0) / 3396190.0, 1e-12);
    close_to(georef->cell_x, 3396190 * radians / 64, 1e-6);
    tl_source_destroy(source);
}

static void anglesInGradsBecomeDegrees(void **state)
{
    (void)state;
    const uint16_t keys[] = {1024, 0, 1, 2, 1025, 0, 1, 2, 2048, 0, 1, 4326, 2054, 0, 1, 9105};
    const double scale[] = {1, 1, 0}, tie[] = {0, 0, 0, 10, 50, 0};
    tl_source *source = open_with(keys, 4, NULL, 0, NULL, scale, tie);
    const double *t = source->info.georef.transform;
    close_to(t[0], 9, 1e-12);
    close_to(t[1], 0.9, 1e-12);
    close_to(t[3], 45, 1e-12);
    close_to(t[5], -0.9, 1e-12);
    assert_int_equal(source->info.georef.crs->key_directory[4 + 4 * 3 + 3], 9102);
    tl_source_destroy(source);
}

static void crsThatNobodyKnowsLeavesTheHeightsReadable(void **state)
{
    (void)state;
    const uint16_t bad_code[] = {1024, 0, 1, 1, 3072, 0, 1, 1};
    const uint16_t nothing[] = {1024, 0, 1, 1, 3072, 0, 1, 32767};
    const uint16_t beyond[] = {1024, 0, 1, 1, 3072, 0, 1, 32767, 3073, 34737, 60000, 60000, 3078, 34736, 1, 999};
    const uint16_t *const lists[] = {bad_code, nothing, beyond};
    const unsigned counts[] = {2, 2, 4};
    const double scale[] = {10, 10, 0}, tie[] = {0, 0, 0, 0, 0, 0};
    for (int k = 0; k < 3; k++) {
        tl_source *source = open_with(lists[k], counts[k], NULL, 0, "x|", scale, tie);
        assert_null(source->info.georef.crs);
        assert_true(source->info.georef.located && source->info.georef.cell_x == 10);
        float height;
        assert_int_equal(tl_source_read(source, 0, (tl_window){1, 1, 1, 1}, &height, NULL), TL_OK);
        tl_source_destroy(source);
    }
}

static void feetOfHeightAreKnown(void **state)
{
    (void)state;
    uint16_t keys[] = {1024, 0, 1, 2, 2048, 0, 1, 4326, 4099, 0, 1, 9001};
    const double metres[] = {1, 0.3048, 1200.0 / 3937.0};
    for (uint16_t k = 0; k < 3; k++) {
        keys[11] = (uint16_t)(9001 + k);
        tl_source *source = open_with(keys, 3, NULL, 0, NULL, NULL, NULL);
        assert_true(source->info.georef.height_unit == metres[k]);
        tl_source_destroy(source);
    }
}

static void verticalKeysGiveNameCodeAndUnit(void **state)
{
    (void)state;
    const struct {
        uint16_t code, unit; /* 0: no such key */
        const char *citation, *name;
        int epsg;
        double metres;
        const char *wkt; /* how it begins */
    } cases[] = {
        {0, 0, NULL, "", 0, 1, "GEOGCRS"},
        {0, 9002, NULL, "", 0, 0.3048, "GEOGCRS"},
        {5703, 0, NULL, "NAVD88 height", 5703, 1, "COMPOUNDCRS"},
        {5703, 9003, NULL, "NAVD88 height", 0, 1200.0 / 3937.0, "COMPOUNDCRS"},
        {5703, 9001, NULL, "NAVD88 height", 5703, 1, "COMPOUNDCRS"},
        {8228, 0, NULL, "NAVD88 height (ft)", 8228, 0.3048, "COMPOUNDCRS"},
        {6360, 0, NULL, "NAVD88 height (ftUS)", 6360, 1200.0 / 3937.0, "COMPOUNDCRS"},
        {5103, 0, NULL, "NAVD88 height", 5703, 1, "COMPOUNDCRS"}, /* GeoTIFF 1.0 */
        {5030, 0, NULL, "ellipsoidal height", 0, 1, "GEOGCRS"},
        {5030, 9002, NULL, "ellipsoidal height", 0, 0.3048, "GEOGCRS"},
        {4979, 9001, NULL, "ellipsoidal height", 0, 1, "GEOGCRS"}, /* GeoTIFF 1.1 */
        {32767, 9003, "Ellipsoidal height|", "ellipsoidal height", 0, 1200.0 / 3937.0, "GEOGCRS"},
        {32767, 9002, "Old gauge|", "Old gauge", 0, 0.3048, "COMPOUNDCRS"},
        {4326, 0, NULL, "", 0, 1, "GEOGCRS"}, /* none of heights */
    };
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        uint16_t keys[20] = {1024, 0, 1, 2, 2048, 0, 1, 4326};
        unsigned count = 2;
        const struct {
            uint16_t key, place, length, value;
        } more[] = {{4096, 0, 1, cases[k].code},
                    {4097, 34737, cases[k].citation ? (uint16_t)strlen(cases[k].citation) : 0, 0},
                    {4099, 0, 1, cases[k].unit}};
        for (int m = 0; m < 3; m++)
            if (m == 1 ? cases[k].citation != NULL : more[m].value != 0)
                memcpy(keys + 4 * count++, &more[m], sizeof more[m]);
        tl_source *source = open_with(keys, count, NULL, 0, cases[k].citation, NULL, NULL);
        const tl_georef *georef = &source->info.georef;
        assert_string_equal(tl_crs_vertical_name(georef->crs), cases[k].name);
        assert_int_equal(tl_crs_vertical_epsg(georef->crs), cases[k].epsg);
        close_to(georef->height_unit, cases[k].metres, 1e-12);
        assert_int_equal(strncmp(tl_crs_wkt(georef->crs), cases[k].wkt, strlen(cases[k].wkt)), 0);
        assert_int_equal(tl_crs_epsg(georef->crs), 4326);
        /* the text alone means the same */
        tl_crs *again = crs_of(tl_crs_wkt(georef->crs));
        assert_string_equal(tl_crs_vertical_name(again), cases[k].name);
        assert_int_equal(tl_crs_epsg(again), 4326);
        tl_crs_release(again);
        tl_source_destroy(source);
    }
}

static void compoundSystemsProjectLikeTheirHorizontalPart(void **state)
{
    (void)state;
    const struct {
        const char *text, *vertical;
        int code;
    } cases[] = {{"EPSG:7405", "ODN height", 5701}, {"EPSG:27700+5701", "ODN height", 5701}, {"EPSG:27700", "", 0}};
    double expected[2] = {0, 0};
    tl_crs *first = crs_of(cases[0].text);
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        tl_crs *crs = crs_of(cases[k].text);
        assert_int_equal(tl_crs_epsg(crs), 27700);
        assert_string_equal(tl_crs_vertical_name(crs), cases[k].vertical);
        assert_int_equal(tl_crs_vertical_epsg(crs), cases[k].code);
        assert_true(dem_crs_equivalent(first, crs));
        double lonlat[2];
        to_lonlat(crs, 400000, 200000, lonlat);
        close_to(lonlat[0], k ? expected[0] : -2, k ? 0 : 1e-3);
        close_to(lonlat[1], k ? expected[1] : 51.698, k ? 0 : 1e-3);
        memcpy(expected, lonlat, sizeof expected);
        tl_crs_release(crs);
    }
    tl_crs_release(first);
}

static void textsOfEveryKindGiveTheHorizontalCrs(void **state)
{
    (void)state;
    const struct {
        const char *text;
        int epsg;
        bool geographic;
    } cases[] = {{"EPSG:4326", 4326, true},
                 {"EPSG:4979", 4326, true},
                 {"EPSG:2193", 2193, false},
                 {"EPSG:7405", 27700, false},
                 {"EPSG:3031", 3031, false},
                 {"+proj=utm +zone=11 +datum=WGS84", 0, false},
                 {"+proj=longlat +R=1737400", 0, true}};
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        tl_crs *crs = crs_of(cases[k].text), *again = NULL;
        assert_int_equal(tl_crs_epsg(crs), cases[k].epsg);
        assert_int_equal(tl_crs_is_geographic(crs), cases[k].geographic);
        /* its WKT means the same */
        assert_int_equal(dem_crs_from_text(tl_crs_wkt(crs), "again", &again, NULL), TL_OK);
        assert_string_equal(tl_crs_name(again), tl_crs_name(crs));
        assert_int_equal(tl_crs_epsg(again), tl_crs_epsg(crs));
        assert_true(again->semi_major == crs->semi_major && again->unit == crs->unit);
        tl_crs_release(again);
        tl_crs_release(crs);
    }
    const char *const wrong[] = {"", "EPSG:", "EPSG:999999", "PROJCRS[", "+proj=nothing", "EPSG:5703", "EPSG:4978"};
    for (size_t k = 0; k < sizeof wrong / sizeof *wrong; k++) {
        tl_error error = {0};
        tl_crs *crs = NULL;
        assert_int_equal(dem_crs_from_text(wrong[k], "FILE", &crs, &error), TL_ERROR_DATA);
        assert_null(crs);
        assert_non_null(strstr(error.text, "FILE"));
    }
}

static void northingFirstSystemsKeepEastingAsX(void **state)
{
    (void)state;
    tl_crs *crs = crs_of("EPSG:2193"); /* its axes are northing, easting */
    double lonlat[2];
    to_lonlat(crs, 1600000, 10000000, lonlat); /* its origin, on the equator at 173 degrees east */
    close_to(lonlat[0], 173, 1e-9);
    close_to(lonlat[1], 0, 1e-9);
    tl_crs_release(crs);
}

static void pointsWithoutAnImageAreNan(void **state)
{
    (void)state;
    tl_crs *crs = crs_of("EPSG:3035"); /* equal-area: the plane beyond the Earth's disc is empty */
    double x[3] = {4321000, 1e9, (double)NAN}, y[3] = {3210000, 1e9, 0};
    dem_projection *projection = dem_projection_create(crs, NULL);
    dem_projection_to_lonlat(projection, 3, x, y);
    close_to(x[0], 10, 1e-9);
    close_to(y[0], 52, 1e-9);
    assert_true(isnan(x[1]) && isnan(y[1]) && isnan(x[2]) && isnan(y[2]));
    dem_projection_destroy(projection);
    dem_projection_destroy(NULL);
    tl_crs_release(crs);
}

static void localFrameIsEastNorthUp(void **state)
{
    (void)state;
    tl_crs *crs = crs_of("EPSG:4326");
    double xyz[3];
    dem_local_frame *frame = dem_local_frame_create(crs, 10, 0, 50, NULL);
    dem_local_frame_forward(frame, 10, 0, 150, xyz);
    close_to(xyz[0], 0, 1e-8);
    close_to(xyz[1], 0, 1e-8);
    close_to(xyz[2], 100, 1e-8);
    /* the equator is a circle; the rounding of a coordinate of 6e6 m is 1e-9 m */
    double angle = 0.01 * radians, radius = wgs84_a + 50;
    dem_local_frame_forward(frame, 10.01, 0, 50, xyz);
    close_to(xyz[0], radius * sin(angle), 1e-8);
    close_to(xyz[1], 0, 1e-8);
    close_to(xyz[2], -2 * radius * sin(angle / 2) * sin(angle / 2), 1e-8);
    dem_local_frame_forward(frame, 10, 0.01, 50, xyz);
    assert_true(fabs(xyz[0]) < 1e-8 && xyz[1] > 1105 && xyz[1] < 1106 && xyz[2] < 0);
    dem_local_frame_destroy(frame);
    dem_local_frame_destroy(NULL);
    tl_error error = {0};
    assert_null(dem_local_frame_create(crs, 10, 91, 0, &error));
    assert_int_equal(error.status, TL_ERROR_ARGUMENT);
    tl_crs_release(crs);
}

/* Radii of curvature at a latitude: along the meridian and across it. */
static void radii_of(double a, double f, double latitude, double *meridian, double *normal)
{
    double e2 = f * (2 - f), s = sin(latitude * radians), w = 1 - e2 * s * s;
    *normal = a / sqrt(w);
    *meridian = a * (1 - e2) / (w * sqrt(w));
}

static void radii(double latitude, double *meridian, double *normal)
{
    radii_of(wgs84_a, wgs84_f, latitude, meridian, normal);
}

/* Ellipsoids of other bodies, by the IAU; Vesta's is the flattest that anyone has mapped. */
static const struct body {
    const char *name, *crs;
    double a, b;
} bodies[] = {{"Moon", "+proj=longlat +R=1737400", 1737400, 1737400},
              {"Mars", "+proj=longlat +a=3396190 +b=3376200", 3396190, 3376200},
              {"Mercury", "+proj=longlat +a=2440530 +b=2438260", 2440530, 2438260},
              {"Vesta", "+proj=longlat +a=280900 +b=226200", 280900, 226200}};
enum { BODIES = sizeof bodies / sizeof *bodies };

/* Cartesian coordinates from the body's centre. */
static void geocentric(double a, double f, double longitude, double latitude, double height, double out[3])
{
    double meridian, normal, l = longitude * radians, p = latitude * radians;
    radii_of(a, f, latitude, &meridian, &normal);
    out[0] = (normal + height) * cos(p) * cos(l);
    out[1] = (normal + height) * cos(p) * sin(l);
    out[2] = ((1 - f) * (1 - f) * normal + height) * sin(p);
}

static void localFramesFitEveryBody(void **state)
{
    (void)state;
    const double origins[][3] = {{0, 0, 0}, {137.4, -4.6, -4500}, {-179.99, 77, 21000}, {12, -89.5, 100}};
    for (int k = 0; k < BODIES; k++)
        for (int o = 0; o < 4; o++) {
            tl_crs *crs = crs_of(bodies[k].crs);
            double a = bodies[k].a, f = (a - bodies[k].b) / a, l = origins[o][0] * radians, p = origins[o][1] * radians;
            dem_local_frame *frame = dem_local_frame_create(crs, origins[o][0], origins[o][1], origins[o][2], NULL);
            double centre[3], there[3], xyz[3];
            geocentric(a, f, origins[o][0], origins[o][1], origins[o][2], centre);
            for (int step = -2; step <= 2; step++) {
                double longitude = origins[o][0] + 0.3 * step, latitude = origins[o][1] + 0.2 * step,
                       height = 1000 * step;
                geocentric(a, f, longitude, latitude, height, there);
                double d[3] = {there[0] - centre[0], there[1] - centre[1], there[2] - centre[2]};
                dem_local_frame_forward(frame, longitude, latitude, height, xyz);
                /* coordinates of 3e6 m round to 5e-10 m, and some are subtracted */
                close_to(xyz[0], -sin(l) * d[0] + cos(l) * d[1], 1e-8);
                close_to(xyz[1], -sin(p) * cos(l) * d[0] - sin(p) * sin(l) * d[1] + cos(p) * d[2], 1e-8);
                close_to(xyz[2], cos(p) * cos(l) * d[0] + cos(p) * sin(l) * d[1] + sin(p) * d[2], 1e-8);
            }
            dem_local_frame_destroy(frame);
            tl_crs_release(crs);
        }
}

static void cellsOfEveryBodyAreGeodesics(void **state)
{
    (void)state;
    const double step = 1 / 128.0, latitudes[] = {0.0, -4.6, 65, -89};
    for (int k = 0; k < BODIES; k++)
        for (int j = 0; j < 4; j++) {
            tl_crs *crs = crs_of(bodies[k].crs);
            tl_georef georef = {.crs = crs, .located = true, .transform = {7, step, 0, latitudes[j] + step, 0, -step}};
            assert_int_equal(dem_georef_measure(&georef, 3, 3, NULL), TL_OK);
            double meridian, normal, a = bodies[k].a;
            radii_of(a, (a - bodies[k].b) / a, latitudes[j], &meridian, &normal);
            /* the arc's bend: the square of the step, 1.9e-8, over 24, more where the radius itself changes */
            close_to(georef.cell_x / (normal * cos(latitudes[j] * radians) * step * radians), 1, 1e-7);
            close_to(georef.cell_y / (meridian * step * radians), 1, 1e-7);
            tl_crs_release(crs);
        }
}

/* Maps of other bodies have their own degrees: the closed forms on spheres. */
static void mapsOfOtherBodiesHaveTheirDegrees(void **state)
{
    (void)state;
    const double moon = 1737400, mars = 3396190, pi = 3.14159265358979323846;
    tl_crs *pole = crs_of("+proj=stere +lat_0=-90 +lon_0=0 +R=1737400");
    tl_crs *plate = crs_of("+proj=eqc +lat_ts=0 +lon_0=180 +R=3396190");
    double lonlat[2];
    to_lonlat(pole, 100000, 50000, lonlat);
    close_to(lonlat[0], atan2(100000, 50000) / radians, 1e-9);
    close_to(lonlat[1], -(90 - 2 * atan(hypot(100000, 50000) / (2 * moon)) / radians), 1e-9);
    to_lonlat(plate, -1000000, 500000, lonlat);
    close_to(lonlat[0], 180 - 1000000 / mars * 180 / pi, 1e-9);
    close_to(lonlat[1], 500000 / mars * 180 / pi, 1e-9);
    tl_georef georef = {.crs = pole, .located = true, .transform = {-5000, 20, 0, 5000, 0, -20}, .height_unit = 1};
    assert_int_equal(dem_georef_measure(&georef, 501, 501, NULL), TL_OK);
    assert_true(georef.cell_x == 20 && georef.cell_y == 20);
    tl_source_info info = {.width = 501, .height = 501, .type = TL_RASTER_POINT, .georef = georef, .name = "pole"};
    double bounds[4];
    assert_int_equal(tl_source_bounds(&info, bounds, NULL), TL_OK);
    close_to(bounds[0], -180, 0);
    close_to(bounds[2], 180, 0);
    close_to(bounds[1], -90, 0);
    close_to(bounds[3], -(90 - 2 * atan(5000 * sqrt(2) / (2 * moon)) / radians), 1e-9);
    tl_crs_release(pole);
    tl_crs_release(plate);
}

static void geographicCellsAreGeodesics(void **state)
{
    (void)state;
    tl_crs *crs = crs_of("EPSG:4326");
    const double latitudes[] = {0, 45, 89.9, -60}, step = 1 / 3600.0;
    for (int k = 0; k < 4; k++) {
        tl_georef georef = {.crs = crs, .located = true, .transform = {7, step, 0, latitudes[k] + step, 0, -step}};
        assert_int_equal(dem_georef_measure(&georef, 3, 3, NULL), TL_OK);
        double meridian, normal;
        radii(latitudes[k], &meridian, &normal);
        /* arc and geodesic differ by the square of the step, 2e-11, over 24; coordinates round to 1e-14 / 3e-4 */
        double x = normal * cos(latitudes[k] * radians) * step * radians, y = meridian * step * radians;
        close_to(georef.cell_x / x, 1, 1e-9);
        close_to(georef.cell_y / y, 1, 1e-9);
    }
    tl_crs_release(crs);
}

static void cellsOfGlobalAndSenselessRastersAreFinite(void **state)
{
    (void)state;
    tl_crs *crs = crs_of("EPSG:4326");
    tl_georef world = {.crs = crs, .located = true, .transform = {0, 360, 0, 0, 0, -180}};
    assert_int_equal(dem_georef_measure(&world, 1, 1, NULL), TL_OK);
    close_to(world.cell_x, 2 * 3.141592653589793 * wgs84_a, 1e-3);
    assert_true(world.cell_y > 1.98e7 && world.cell_y < 2.01e7);
    tl_georef wrong = {.crs = crs, .located = true, .transform = {500000, 30, 0, 4000000, 0, -30}};
    assert_int_equal(dem_georef_measure(&wrong, 10, 10, NULL), TL_OK);
    assert_true(wrong.cell_x == 30 && wrong.cell_y == 30);
    tl_crs_release(crs);
}

/* Width x height cells from a corner of the extent; `bounds` as expected, to `tolerance` degrees. */
static void expect_bounds(const char *text, const double corner[2], double cell, int width, int height,
                          const double expected[4], double tolerance)
{
    tl_crs *crs = crs_of(text);
    tl_source_info info = {.width = width, .height = height, .name = "raster"};
    info.georef = (tl_georef){
        .crs = crs, .located = true, .transform = {corner[0] + cell / 2, cell, 0, corner[1] - cell / 2, 0, -cell}};
    double bounds[4];
    tl_error error = {0};
    if (tl_source_bounds(&info, bounds, &error) != TL_OK)
        fail_msg("%s: %s", text, error.text);
    for (int k = 0; k < 4; k++)
        close_to(bounds[k], expected[k], tolerance);
    tl_crs_release(crs);
}

static void boundsHoldPolesAndTheAntimeridian(void **state)
{
    (void)state;
    const double up_left[2] = {-1e6, 1e6}, across[2] = {179, 1}, world[2] = {-180, 90}, turned[2] = {0, 90};
    double south[4] = {-180, -90, 180, 0};
    tl_crs *polar = crs_of("EPSG:3031");
    double corner[2];
    to_lonlat(polar, -1e6, -1e6, corner); /* of the square, the farthest from the pole */
    south[3] = corner[1];
    tl_crs_release(polar);
    expect_bounds("EPSG:3031", up_left, 1e4, 200, 200, south, 1e-9);
    expect_bounds("EPSG:4326", across, 0.5, 4, 4, (const double[]){179, -1, 181, 1}, 1e-12);
    expect_bounds("EPSG:4326", world, 0.5, 720, 360, (const double[]){-180, -90, 180, 90}, 1e-9);
    expect_bounds("EPSG:4326", turned, 0.5, 720, 360, (const double[]){0, -90, 360, 90}, 1e-9);
    /* the meridian of zone 1 is at 177 degrees west; 500 km more to the west are beyond the antimeridian */
    const double west[2] = {0, 50};
    tl_crs *zone = crs_of("EPSG:32601");
    double left[2], right[2];
    to_lonlat(zone, 0, 0, left);
    to_lonlat(zone, 1e6, 0, right);
    close_to(left[0] - 360, -354 - right[0], 1e-9); /* symmetric about the meridian */
    expect_bounds("EPSG:32601", west, 100, 10000, 1, (const double[]){left[0], -4.51e-4, right[0] + 360, 4.53e-4},
                  2e-6);
    tl_crs_release(zone);
    tl_source_info nowhere = {.width = 1, .height = 1, .name = "raster"};
    double bounds[4], i = 0, j = 0;
    tl_error error = {0};
    assert_int_equal(tl_source_bounds(&nowhere, bounds, &error), TL_ERROR_DATA);
    assert_int_equal(tl_georef_to_lonlat(&nowhere.georef, 1, &i, &j, NULL), TL_ERROR_DATA);
}

static void projectedCellsAreColumnLengths(void **state)
{
    (void)state;
    tl_crs *crs = crs_of("EPSG:2225"); /* in US survey feet */
    tl_georef georef = {.crs = crs, .located = true, .transform = {0, 3, 8, 0, 4, -6}};
    assert_int_equal(dem_georef_measure(&georef, 10, 10, NULL), TL_OK);
    close_to(georef.cell_x, 5 * 1200.0 / 3937.0, 1e-12);
    close_to(georef.cell_y, 10 * 1200.0 / 3937.0, 1e-12);
    tl_crs_release(crs);
}

static int make_folder(void **state)
{
    (void)state;
    const char *place = getenv("TMPDIR");
    snprintf(folder, sizeof folder, "%.40s/talus-XXXXXX", place ? place : "/tmp");
    if (!mkdtemp(folder))
        return -1;
    snprintf(path, sizeof path, "%s/crs.tif", folder);
    return 0;
}

static int remove_folder(void **state)
{
    (void)state;
    unlink(path);
    return rmdir(folder);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(utmAgreesWithGeographicLib),
        cmocka_unit_test(webMercatorAgreesWithThePublishedExample),
        cmocka_unit_test(userDefinedLambertAgreesWithThePublishedExample),
        cmocka_unit_test(ellipsoidsOfOtherBodiesAreKept),
        cmocka_unit_test(anglesInGradsBecomeDegrees),
        cmocka_unit_test(crsThatNobodyKnowsLeavesTheHeightsReadable),
        cmocka_unit_test(feetOfHeightAreKnown),
        cmocka_unit_test(verticalKeysGiveNameCodeAndUnit),
        cmocka_unit_test(compoundSystemsProjectLikeTheirHorizontalPart),
        cmocka_unit_test(textsOfEveryKindGiveTheHorizontalCrs),
        cmocka_unit_test(northingFirstSystemsKeepEastingAsX),
        cmocka_unit_test(pointsWithoutAnImageAreNan),
        cmocka_unit_test(localFrameIsEastNorthUp),
        cmocka_unit_test(localFramesFitEveryBody),
        cmocka_unit_test(cellsOfEveryBodyAreGeodesics),
        cmocka_unit_test(mapsOfOtherBodiesHaveTheirDegrees),
        cmocka_unit_test(geographicCellsAreGeodesics),
        cmocka_unit_test(cellsOfGlobalAndSenselessRastersAreFinite),
        cmocka_unit_test(boundsHoldPolesAndTheAntimeridian),
        cmocka_unit_test(projectedCellsAreColumnLengths),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
