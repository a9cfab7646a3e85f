/* Control grids: the stated error holds, for coordinates and in frames of meshes. */
#include "dem/control_grid.h"
#include "dem/crs.h"
#include "lib/out/frame.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <cmocka.h>

typedef struct lonlat {
    dem_projection *projection;
    double transform[6];
    size_t calls;
} lonlat;

static void evaluate(void *context, size_t n, const double *i, const double *j, double *out)
{
    lonlat *self = context;
    const double *t = self->transform;
    for (size_t k = 0; k < n; k++) {
        double x = t[0] + t[1] * i[k] + t[2] * j[k], y = t[3] + t[4] * i[k] + t[5] * j[k];
        dem_projection_to_lonlat(self->projection, 1, &x, &y);
        out[2 * k] = x;
        out[2 * k + 1] = y;
    }
    self->calls += n;
}

/* A number in 0 ... 1 that looks random. */
static double scatter(uint64_t *state)
{
    *state = *state * 6364136223846793005u + 1442695040888963407u;
    return (double)(*state >> 11) / 9007199254740992.0;
}

static void longitudesStayWithinTheStatedError(void **state)
{
    (void)state;
    const struct {
        const char *text;
        double transform[6];
        int64_t width, height;
    } cases[] = {
        {"EPSG:32611", {300000, 30, 0, 4.5e6, 0, -30}, 10000, 10000},
        {"EPSG:27700", {0, 50, 0, 1.2e6, 0, -50}, 14000, 24000},
        {"EPSG:3035", {2.6e6, 1000, 100, 5e6, 100, -1000}, 4000, 4000}, /* PROJ's, turned */
        {"EPSG:2154", {1e5, 1, 0, 7e6, 0, -1}, 1000, 3},
        {"EPSG:3857", {-2e7, 4000, 0, 1e7, 0, -4000}, 9000, 5000},
    };
    const double degree = 111320;
    for (size_t c = 0; c < sizeof cases / sizeof *cases; c++) {
        tl_crs *crs = NULL;
        assert_int_equal(dem_crs_from_text(cases[c].text, "test", &crs, NULL), TL_OK);
        lonlat self = {.projection = dem_projection_create(crs, NULL)};
        memcpy(self.transform, cases[c].transform, sizeof self.transform);
        dem_control_function f = {2, evaluate, &self, {degree, degree}, 1e-3};
        dem_control_grid *grid = NULL;
        tl_window window = {10, 20, cases[c].width, cases[c].height};
        assert_int_equal(dem_control_grid_create(&f, window, 1 << 20, &grid, NULL), TL_OK);
        if (!grid)
            fail_msg("%s: no grid", cases[c].text);
        assert_true(dem_control_grid_error(grid) <= 0.5e-3);
        uint64_t seed = c;
        double worst = 0;
        for (int k = 0; k < 20000; k++) {
            double i = 10 + floor(scatter(&seed) * (double)window.width),
                   j = 20 + floor(scatter(&seed) * (double)window.height), made[2], truth[2];
            dem_control_grid_apply(grid, 1, &i, &j, made);
            evaluate(&self, 1, &i, &j, truth);
            worst = fmax(worst, degree * (fabs(made[0] - truth[0]) + fabs(made[1] - truth[1])));
        }
        if (!(worst <= 1e-3))
            fail_msg("%s: %g m", cases[c].text, worst);
        dem_control_grid_destroy(grid);
        dem_projection_destroy(self.projection);
        tl_crs_release(crs);
    }
    dem_control_grid_destroy(NULL);
}

static void jump(void *context, size_t n, const double *i, const double *j, double *out)
{
    for (size_t k = 0; k < n; k++)
        out[k] = *(const double *)context * (i[k] > 499.9) + j[k];
}

static void noGridIsMadeOfWhatIsNotSmooth(void **state)
{
    (void)state;
    const double heights[] = {1, (double)NAN};
    for (int k = 0; k < 2; k++) {
        double height = heights[k];
        dem_control_function f = {1, jump, &height, {1}, 1e-3};
        dem_control_grid *grid = (dem_control_grid *)&f;
        assert_int_equal(dem_control_grid_create(&f, (tl_window){0, 0, 1000, 1000}, 100000, &grid, NULL), TL_OK);
        assert_null(grid);
    }
}

static void valuesDoNotDependOnTheOrder(void **state)
{
    (void)state;
    double height = 0;
    dem_control_function f = {1, jump, &height, {1}, 1e-3};
    dem_control_grid *grid = NULL;
    assert_int_equal(dem_control_grid_create(&f, (tl_window){0, 0, 50, 40}, 1000, &grid, NULL), TL_OK);
    assert_non_null(grid);
    enum { N = 2000 };
    double i[N], j[N], all[N], one;
    for (int k = 0; k < N; k++) {
        i[k] = k % 50;
        j[k] = (double)(k / 50);
    }
    dem_control_grid_apply(grid, N, i, j, all);
    for (int k = N - 1; k >= 0; k--) {
        dem_control_grid_apply(grid, 1, &i[k], &j[k], &one);
        assert_true(one == all[k]);
        assert_true(fabs(one - j[k]) < 1e-9);
    }
    dem_control_grid_destroy(grid);
}

/* A full mesh of side x side vertices. */
static tl_mesh lattice_mesh(int side, const tl_crs *crs, const double transform[6])
{
    tl_mesh mesh = {.vertex_count = (size_t)side * (size_t)side};
    mesh.vertices = malloc(mesh.vertex_count * sizeof *mesh.vertices);
    assert_non_null(mesh.vertices);
    for (int32_t j = 0; j < side; j++)
        for (int32_t i = 0; i < side; i++)
            mesh.vertices[(size_t)j * (size_t)side + (size_t)i] = (tl_vertex){i, j, (float)((i * 7 + j * 13) % 4000)};
    mesh.georef = (tl_georef){.crs = crs, .located = true, .height_unit = 1};
    memcpy(mesh.georef.transform, transform, sizeof mesh.georef.transform);
    assert_int_equal(dem_georef_measure(&mesh.georef, side, side, NULL), TL_OK);
    return mesh;
}

static void largeMeshesLandWhereTheFormulasSay(void **state)
{
    (void)state;
    const struct {
        const char *text;
        double transform[6];
    } cases[] = {{"EPSG:32611", {4e5, 30, 0, 4e6, 0, -30}},
                 {"EPSG:4326", {179.5, 1.0 / 1200, 0, 60, 0, -1.0 / 1200}},
                 {"EPSG:3031", {-1e5, 200, 0, 1e5, 0, -200}},   /* over the pole */
                 {"EPSG:4326", {-180, 0.33, 0, 90, 0, -0.17}}}; /* the whole globe: each vertex by itself */
    enum { SIDE = 1030, BATCH = 5000 };
    for (size_t c = 0; c < sizeof cases / sizeof *cases; c++) {
        tl_crs *crs = NULL;
        assert_int_equal(dem_crs_from_text(cases[c].text, "test", &crs, NULL), TL_OK);
        tl_mesh mesh = lattice_mesh(SIDE, crs, cases[c].transform);
        out_frame *frame = out_frame_create(&mesh, TL_FRAME_ENU, "test", NULL);
        assert_non_null(frame);
        const double *o = out_frame_origin(frame), *t = mesh.georef.transform;
        dem_local_frame *local = dem_local_frame_create(crs, o[0], o[1], o[2], NULL);
        dem_projection *projection = dem_projection_create(crs, NULL);
        double(*xyz)[3] = malloc(mesh.vertex_count * sizeof *xyz), worst = 0;
        clock_t begin = clock();
        assert_int_equal(out_frame_apply(frame, mesh.vertices, mesh.vertex_count, xyz, NULL), TL_OK);
        if (getenv("TALUS_VERBOSE"))
            printf("%s: %.1f M vertices/s\n", cases[c].text,
                   (double)mesh.vertex_count / 1e6 / ((double)(clock() - begin) / CLOCKS_PER_SEC));
        for (size_t k = 0; k < mesh.vertex_count; k += 97) {
            const tl_vertex *v = &mesh.vertices[k];
            double x = t[0] + t[1] * v->i + t[2] * v->j, y = t[3] + t[4] * v->i + t[5] * v->j, at[3];
            dem_projection_to_lonlat(projection, 1, &x, &y);
            dem_local_frame_forward(local, x, y, (double)v->z, at);
            for (int a = 0; a < 3; a++)
                worst = fmax(worst, fabs(at[a] - xyz[k][a]));
        }
        if (!(worst <= 1e-3))
            fail_msg("%s: %g m", cases[c].text, worst);
        if (getenv("TALUS_VERBOSE"))
            printf("%s: %.2g m\n", cases[c].text, worst);
        free(xyz);
        dem_projection_destroy(projection);
        dem_local_frame_destroy(local);
        out_frame_destroy(frame);
        free(mesh.vertices);
        tl_crs_release(crs);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(longitudesStayWithinTheStatedError),
        cmocka_unit_test(noGridIsMadeOfWhatIsNotSmooth),
        cmocka_unit_test(valuesDoNotDependOnTheOrder),
        cmocka_unit_test(largeMeshesLandWhereTheFormulasSay),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
