/* Projections: GeographicLib against PROJ, both ways. */
#include "dem/crs.h"

#include <math.h>
#include <proj.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

enum { SIDE = 17, POINTS = SIDE * SIDE };

static const struct {
    const char *text;
    bool proj_only;
    double bounds[4]; /* west, south, east, north; all 0: the area of use that PROJ names */
} systems[] = {
    /* UTM, ten zones of either hemisphere on several ellipsoids, and its polar caps */
    {"EPSG:32601"},
    {"EPSG:32611"},
    {"EPSG:32632"},
    {"EPSG:32633"},
    {"EPSG:32660"},
    {"EPSG:32701"},
    {"EPSG:32719"},
    {"EPSG:32731"},
    {"EPSG:32755"},
    {"EPSG:32760"},
    {"EPSG:25832"},
    {"EPSG:26913"},
    {"EPSG:26711"}, /* NAD27 */
    {"EPSG:32661"}, /* northing first */
    {"EPSG:32761"},
    {"EPSG:5041"},
    {"EPSG:5042"},
    {"EPSG:27700"},
    {"EPSG:2193"},
    {"EPSG:28992", true},
    {"EPSG:2154"},
    {"EPSG:27572"}, /* longitudes from Paris, in grads; one parallel */
    {"EPSG:32041"}, /* NAD27, feet, two parallels */
    {"EPSG:6201"},  /* Michigan */
    {"EPSG:2225"},  /* US survey feet */
    {"EPSG:2913"},  /* international feet */
    {"EPSG:3035", true},
    {"EPSG:5070"},
    {"EPSG:3338"},
    {"EPSG:3577"}, /* south */
    {"EPSG:3031"},
    {"EPSG:3413"},
    {"EPSG:3857"},
    {"EPSG:3395"},
    {"EPSG:3994"}, /* Mercator with a parallel of true scale */
    {"EPSG:2048", true},
    {"+proj=lcc +lat_0=44 +lon_0=-120.5 +lat_1=43 +lat_2=45.5 +x_0=4e5 +y_0=1e5 +ellps=clrk66 +units=us-ft",
     false,
     {-126, 40, -114, 48}},
    {"+proj=tmerc +lat_0=49 +lon_0=10 +k=0.9999 +ellps=bessel", false, {-30, 5, 50, 85}},
    /* Mars and the Moon */
    {"+proj=stere +lat_0=-90 +lat_ts=-90 +lon_0=30 +a=3396190 +b=3376200", false, {-180, -90, 180, -60}},
    {"+proj=tmerc +lat_0=0 +lon_0=137 +k=0.9996 +x_0=5e5 +a=3396190 +b=3376200", false, {130, -20, 144, 20}},
    {"+proj=aea +lat_0=10 +lon_0=20 +lat_1=0 +lat_2=30 +R=1737400", false, {-20, -30, 60, 60}},
    {"+proj=merc +lon_0=-100 +R=1737400", false, {-180, -80, 180, 80}},
};

typedef struct reference {
    PJ_CONTEXT *context;
    PJ *crs, *to_lonlat;
} reference;

static void open_reference(reference *r, const tl_crs *crs)
{
    r->context = proj_context_create();
    r->crs = proj_create(r->context, crs->wkt);
    PJ *base = proj_crs_get_geodetic_crs(r->context, r->crs);
    PJ *any = proj_create_crs_to_crs_from_pj(r->context, r->crs, base, NULL, NULL);
    r->to_lonlat = proj_normalize_for_visualization(r->context, any);
    assert_non_null(r->to_lonlat);
    proj_destroy(any);
    proj_destroy(base);
}

static void close_reference(reference *r)
{
    proj_destroy(r->to_lonlat);
    proj_destroy(r->crs);
    proj_context_destroy(r->context);
}

/* A lattice of points strictly inside of the bounds. */
static void fill_area(const reference *r, size_t system, double *longitude, double *latitude)
{
    double b[4];
    memcpy(b, systems[system].bounds, sizeof b);
    if (b[0] == b[2])
        assert_true(proj_get_area_of_use(r->context, r->crs, &b[0], &b[1], &b[2], &b[3], NULL));
    if (b[2] < b[0])
        b[2] += 360;
    for (int k = 0; k < POINTS; k++) {
        longitude[k] = b[0] + (b[2] - b[0]) * (k % SIDE + 0.5) / SIDE;
        latitude[k] = b[1] + (b[3] - b[1]) * (k / SIDE + 0.5) / SIDE;
        if (longitude[k] > 180)
            longitude[k] -= 360;
    }
}

/* PROJ gives longitudes in the unit of the CRS's own geographic one: grads here and there. */
static double unit_in_degrees(const tl_crs *crs)
{
    return strstr(crs->wkt, "ANGLEUNIT[\"grad\"") ? 0.9 : 1;
}

static void both_directions_agree(size_t system)
{
    tl_crs *crs = NULL;
    tl_error error = {0};
    if (dem_crs_from_text(systems[system].text, "test", &crs, &error) != TL_OK)
        fail_msg("%s", error.text);
    dem_projection *projection = dem_projection_create(crs, &error);
    assert_non_null(projection);
    if (strcmp(dem_projection_engine(projection), systems[system].proj_only ? "PROJ" : "GeographicLib") != 0)
        fail_msg("%s: %s", systems[system].text, dem_projection_engine(projection));
    reference r;
    open_reference(&r, crs);
    double unit = unit_in_degrees(crs), longitude[POINTS], latitude[POINTS], x[POINTS], y[POINTS], worst = 0;
    fill_area(&r, system, longitude, latitude);
    memcpy(x, longitude, sizeof x);
    memcpy(y, latitude, sizeof y);
    dem_projection_from_lonlat(projection, POINTS, x, y);
    for (int k = 0; k < POINTS; k++) {
        PJ_COORD at = proj_trans(r.to_lonlat, PJ_INV, proj_coord(longitude[k] / unit, latitude[k] / unit, 0, 0));
        double off = hypot(x[k] - at.xy.x, y[k] - at.xy.y) * crs->unit;
        if (!(off < 1e-3))
            fail_msg("%s: %.9g %.9g lands at %.4f %.4f, PROJ says %.4f %.4f", systems[system].text, longitude[k],
                     latitude[k], x[k], y[k], at.xy.x, at.xy.y);
        worst = fmax(worst, off);
    }
    double back_x[POINTS], back_y[POINTS];
    memcpy(back_x, x, sizeof x);
    memcpy(back_y, y, sizeof y);
    dem_projection_to_lonlat(projection, POINTS, back_x, back_y);
    double degree = crs->semi_major * 0.017453292519943295;
    for (int k = 0; k < POINTS; k++) {
        PJ_COORD at = proj_trans(r.to_lonlat, PJ_FWD, proj_coord(x[k], y[k], 0, 0));
        double east = remainder(back_x[k] - at.xy.x * unit, 360) * cos(latitude[k] / 57.29577951308232),
               north = back_y[k] - at.xy.y * unit, off = hypot(east, north) * degree;
        if (!(off < 1e-3) || !(fabs(back_x[k]) <= 180))
            fail_msg("%s: %.4f %.4f is %.12g %.12g, PROJ says %.12g %.12g", systems[system].text, x[k], y[k], back_x[k],
                     back_y[k], at.xy.x * unit, at.xy.y * unit);
        worst = fmax(worst, off);
    }
    if (getenv("TALUS_VERBOSE"))
        printf("%-12.60s %-14s %.2g m\n", systems[system].text, dem_projection_engine(projection), worst);
    close_reference(&r);
    dem_projection_destroy(projection);
    tl_crs_release(crs);
}

static void geographicLibAgreesWithProjToAMillimetre(void **state)
{
    (void)state;
    for (size_t k = 0; k < sizeof systems / sizeof *systems; k++)
        both_directions_agree(k);
}

/* PROJ 9.1 has no polar stereographic of variant C; the example of the IOGP's Guidance Note 7-2 is given to the
 * centimetre and to a thousandth of a second. */
static void polarVariantCAgreesWithThePublishedExample(void **state)
{
    (void)state;
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text("EPSG:2985", "test", &crs, NULL), TL_OK);
    dem_projection *projection = dem_projection_create(crs, NULL);
    double x = 140 + 4 / 60.0 + 17.040 / 3600, y = -(66 + 36 / 60.0 + 18.820 / 3600);
    dem_projection_from_lonlat(projection, 1, &x, &y);
    assert_true(fabs(x - 303169.52) < 0.03 && fabs(y - 244055.72) < 0.03);
    dem_projection_destroy(projection);
    tl_crs_release(crs);
}

static void whatHasNoImageIsNan(void **state)
{
    (void)state;
    const char *const texts[] = {"EPSG:32633", "EPSG:5070", "EPSG:3031", "EPSG:2154", "EPSG:3857", "EPSG:3395"};
    for (size_t k = 0; k < sizeof texts / sizeof *texts; k++) {
        tl_crs *crs = NULL;
        assert_int_equal(dem_crs_from_text(texts[k], "test", &crs, NULL), TL_OK);
        dem_projection *projection = dem_projection_create(crs, NULL);
        double x[4] = {(double)NAN, (double)INFINITY, 0, 0}, y[4] = {0, 0, -(double)INFINITY, (double)NAN};
        dem_projection_to_lonlat(projection, 4, x, y);
        for (int p = 0; p < 4; p++)
            assert_true(isnan(x[p]) && isnan(y[p]));
        double longitude[3] = {0, 0, (double)NAN}, latitude[3] = {90.0001, (double)NAN, 0};
        dem_projection_from_lonlat(projection, 3, longitude, latitude);
        for (int p = 0; p < 3; p++)
            assert_true(isnan(longitude[p]) && isnan(latitude[p]));
        dem_projection_destroy(projection);
        tl_crs_release(crs);
    }
    /* outside of the ring of an equal-area cone, and far off a meridian */
    const char *const limited[] = {"EPSG:5070", "EPSG:32633"};
    for (int k = 0; k < 2; k++) {
        tl_crs *crs = NULL;
        assert_int_equal(dem_crs_from_text(limited[k], "test", &crs, NULL), TL_OK);
        dem_projection *projection = dem_projection_create(crs, NULL);
        double x = 1e9, y = 1e9;
        dem_projection_to_lonlat(projection, 1, &x, &y);
        assert_true(isnan(x) && isnan(y));
        dem_projection_destroy(projection);
        tl_crs_release(crs);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(geographicLibAgreesWithProjToAMillimetre),
        cmocka_unit_test(polarVariantCAgreesWithThePublishedExample),
        cmocka_unit_test(whatHasNoImageIsNan),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
