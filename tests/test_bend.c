#include "dem/crs.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

/* ---- Rasters on the ground --------------------------------------------------------------------------- */

typedef struct ground {
    int side;
    const char *crs;
    double x, y, cell; /* of the first sample; CRS units */
    double relief;     /* metres */
    double height_unit;
} ground;

static const ground grounds[] = {
    {1025, "EPSG:32630", 400000, 5000000, 100, 0, 1},       /* flat, 102 km wide */
    {513, "EPSG:32630", 166000, 9300000, 300, 900, 0.3048}, /* the rim of a zone, far north, heights in feet */
    {513, "EPSG:4326", 10, 47, 1 / 300.0, 1500, 1},         /* cells longer than wide */
    {257, "EPSG:4326", -30, 84, 1 / 60.0, 300, 1},          /* narrow cells, and meridians that meet */
    {257, "EPSG:3857", 1000000, 9000000, 500, 2000, 1},     /* a scale that changes fast with latitude */
    {257, "EPSG:3031", -600000, 700000, 1000, 1000, 1},     /* around a pole */
    {129, "EPSG:4326", 170, 60, 1, 3000, 1},                /* over the antimeridian, to the south of the equator */
};
enum { GROUNDS = sizeof grounds / sizeof grounds[0] };

static float height_at(const ground *of, int i, int j)
{
    double u = 2 * i / (of->side - 1.0) - 1, v = 2 * j / (of->side - 1.0) - 1;
    double z = of->relief * (sin(5 * u + 2 * v) * cos(3 * v - u) + 0.05 * sin(90 * u) * sin(70 * v));
    return (float)floor(z / of->height_unit);
}

static tl_source *open_ground(const ground *of, float **heights)
{
    tl_crs *crs = NULL;
    tl_error error = {0};
    if (dem_crs_from_text(of->crs, "ground", &crs, &error) != TL_OK)
        fail_msg("%s", error.text);
    *heights = malloc((size_t)of->side * (size_t)of->side * sizeof **heights);
    for (int k = 0; k < of->side * of->side; k++)
        (*heights)[k] = height_at(of, k % of->side, k / of->side);
    tl_source_info info = {.width = of->side, .height = of->side, .name = "ground"};
    info.georef = (tl_georef){.crs = crs,
                              .located = true,
                              .transform = {of->x, of->cell, 0, of->y, 0, -of->cell},
                              .height_unit = of->height_unit};
    assert_int_equal(dem_georef_measure(&info.georef, of->side, of->side, NULL), TL_OK);
    return tl_array_source_create(*heights, &info, NULL);
}

static void close_ground(tl_source *source, float *heights)
{
    const tl_crs *crs = source->info.georef.crs;
    tl_source_destroy(source);
    tl_crs_release(crs);
    free(heights);
}

static tl_mesh *simplified(const tl_source *source, double max_error, tl_frame frame)
{
    tl_error error = {0};
    tl_mesh *mesh = NULL;
    tl_framework *framework =
        tl_framework_build(source, &(tl_framework_options){.max_error = max_error, .frame = frame}, &error);
    if (!framework || tl_framework_mesh(framework, &mesh, &error) != TL_OK)
        fail_msg("%s", error.text);
    tl_framework_destroy(framework);
    return mesh;
}

/* ---- The definition -------------------------------------------------------------------------------- */

typedef struct place {
    double at[3], up[3];
} place;

/* Where all samples are, at their heights. */
static place *find_places(const ground *of, const tl_source *source, const float *z)
{
    const tl_georef *g = &source->info.georef;
    place *out = malloc((size_t)of->side * (size_t)of->side * sizeof *out);
    dem_projection *projection = dem_projection_create(g->crs, NULL);
    dem_local_frame *local = dem_local_frame_create(g->crs, 20, 40, 0, NULL); /* anywhere: frames are rigid */
    for (int k = 0; k < of->side * of->side; k++) {
        double x = of->x + of->cell * (k % of->side), y = of->y - of->cell * (k / of->side), above[3];
        double h = (double)z[k] * of->height_unit;
        dem_projection_to_lonlat(projection, 1, &x, &y);
        dem_local_frame_forward(local, x, y, h, out[k].at);
        dem_local_frame_forward(local, x, y, h + 1e6, above);
        for (int a = 0; a < 3; a++)
            out[k].up[a] = (above[a] - out[k].at[a]) / 1e6;
    }
    dem_projection_destroy(projection);
    dem_local_frame_destroy(local);
    return out;
}

static double determinant(const double a[3], const double b[3], const double c[3])
{
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0]);
}

/* Metres along the vertical of p to the plane of a, b, c, by Cramer's rule. */
static double distance(const place *a, const place *b, const place *c, const place *p)
{
    double ab[3], ac[3], pa[3];
    for (int k = 0; k < 3; k++) {
        ab[k] = b->at[k] - a->at[k];
        ac[k] = c->at[k] - a->at[k];
        pa[k] = a->at[k] - p->at[k];
    }
    return fabs(determinant(ab, ac, pa) / determinant(ab, ac, p->up));
}

static long area2(const tl_vertex *a, const tl_vertex *b, long x, long y)
{
    return (long)(b->i - a->i) * (y - a->j) - (long)(b->j - a->j) * (x - a->i);
}

/* The largest distance, in units of height, of any sample from the triangles that cover it on the lattice. */
static double worst_distance(const ground *of, const tl_mesh *mesh, const place *places)
{
    double worst = 0;
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        const tl_vertex *v[3];
        const place *p[3];
        for (int k = 0; k < 3; k++) {
            v[k] = &mesh->vertices[mesh->indices[3 * t + (size_t)k]];
            p[k] = &places[v[k]->j * of->side + v[k]->i];
        }
        int x0 = (int)fmin(fmin(v[0]->i, v[1]->i), v[2]->i), x1 = (int)fmax(fmax(v[0]->i, v[1]->i), v[2]->i);
        int y0 = (int)fmin(fmin(v[0]->j, v[1]->j), v[2]->j), y1 = (int)fmax(fmax(v[0]->j, v[1]->j), v[2]->j);
        for (int y = y0; y <= y1; y++)
            for (int x = x0; x <= x1; x++)
                if (area2(v[0], v[1], x, y) <= 0 && area2(v[1], v[2], x, y) <= 0 && area2(v[2], v[0], x, y) <= 0)
                    worst = fmax(worst, distance(p[0], p[1], p[2], &places[y * of->side + x]));
    }
    return worst / of->height_unit;
}

static tl_mesh_report verified(const tl_mesh *mesh, const tl_source *source, tl_frame frame, unsigned threads)
{
    tl_mesh_report report = {0};
    tl_error error = {0};
    if (tl_mesh_verify_in(mesh, source, frame, &(tl_run){.threads = threads}, &report, &error) != TL_OK)
        fail_msg("%s", error.text);
    return report;
}

/* Positions of 6.4e6 m round to 1e-9 m; a few of these and a division by the height's unit follow. */
static const double ROUNDING = 1e-7;

static void check_ground(const ground *of, double max_error)
{
    float *heights;
    tl_source *source = open_ground(of, &heights);
    place *places = find_places(of, source, heights);
    tl_mesh *mesh = simplified(source, max_error, TL_FRAME_ENU);
    double worst = worst_distance(of, mesh, places);
    tl_mesh_report report = verified(mesh, source, TL_FRAME_ENU, 1), again = verified(mesh, source, TL_FRAME_ENU, 3);
    if (!(worst <= max_error + ROUNDING) || !(report.max_error <= max_error + ROUNDING))
        fail_msg("%s, %g: off by %.9g, verified as %.9g", of->crs, max_error, worst, report.max_error);
    assert_memory_equal(&report, &again, sizeof report);
    assert_int_equal(report.samples, of->side * of->side);
    assert_int_equal(report.uncovered, 0);
    tl_mesh_destroy(mesh);
    free(places);
    close_ground(source, heights);
}

static void frameworkKeepsBoundInEnuFrames(void **state)
{
    (void)state;
    for (size_t k = 1; k < GROUNDS; k++) {
        check_ground(&grounds[k], 1);
        check_ground(&grounds[k], 35);
    }
}

/* On flat ground the sag is all that there is: a triangle may be as large as its chord allows, and is. */
static void frameworkSplitsFlatGroundNoMoreThanItsSagAsks(void **state)
{
    (void)state;
    float *heights;
    tl_source *source = open_ground(&grounds[0], &heights);
    place *places = find_places(&grounds[0], source, heights);
    tl_mesh *flat = simplified(source, 1, TL_FRAME_PROJECTED), *mesh = simplified(source, 1, TL_FRAME_DEFAULT);
    assert_int_equal(flat->triangle_count, 2);
    /* the diagonal of 144.8 km: L^2 / 8 R = 411 m, where R is 6,365 to 6,389 km there; the scale of UTM is 0.9996 to
     * 1.0000 */
    double sag = worst_distance(&grounds[0], flat, places);
    assert_true(sag > 409 && sag < 413);
    tl_mesh_report seen = verified(flat, source, TL_FRAME_ENU, 0), level = verified(flat, source, TL_FRAME_PIXEL, 0);
    assert_true(fabs(seen.max_error - sag) < ROUNDING && level.max_error == 0);
    /* 1 m of sag allows 7.14 km: the next smaller hypotenuse is 6.4 km, of 102.4^2 / (6.4^2 / 4) triangles */
    assert_int_equal(mesh->triangle_count, 1024);
    double rest = worst_distance(&grounds[0], mesh, places);
    assert_true(rest > 0.79 && rest <= 1);
    tl_mesh_destroy(flat);
    tl_mesh_destroy(mesh);
    free(places);
    close_ground(source, heights);
}

static void frameworkOfFlatFramesDoesNotBend(void **state)
{
    (void)state;
    for (size_t k = 1; k < GROUNDS; k++) {
        float *heights;
        tl_source *source = open_ground(&grounds[k], &heights);
        const tl_crs *crs = source->info.georef.crs;
        tl_mesh *there = simplified(source, 10, TL_FRAME_PIXEL);
        source->info.georef.crs = NULL;
        tl_mesh *nowhere = simplified(source, 10, TL_FRAME_DEFAULT);
        source->info.georef.crs = crs;
        assert_int_equal(there->triangle_count, nowhere->triangle_count);
        assert_memory_equal(there->indices, nowhere->indices, 3 * there->triangle_count * sizeof *there->indices);
        tl_mesh_destroy(there);
        tl_mesh_destroy(nowhere);
        close_ground(source, heights);
    }
}

/* No bound but 0 is kept by every sample's own triangles, and then exactly. */
static void verifyFindsNothingOnFullMeshes(void **state)
{
    (void)state;
    float *heights;
    tl_source *source = open_ground(&grounds[3], &heights);
    tl_mesh *mesh = simplified(source, 0, TL_FRAME_ENU);
    assert_int_equal(mesh->vertex_count, 257 * 257);
    assert_true(verified(mesh, source, TL_FRAME_ENU, 0).max_error == 0);
    tl_mesh_destroy(mesh);
    close_ground(source, heights);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(frameworkKeepsBoundInEnuFrames),
        cmocka_unit_test(frameworkSplitsFlatGroundNoMoreThanItsSagAsks),
        cmocka_unit_test(frameworkOfFlatFramesDoesNotBend),
        cmocka_unit_test(verifyFindsNothingOnFullMeshes),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
