/* Views that are refused, camera files, and pictures of meshes. */
#include "dem/crs.h"
#include "lib/base/georef.h"
#include "lib/scene/mesh_colour.h"
#include "lib/scene/mesh_picture.h"
#include "lib/scene/view.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

static const double radian = 3.14159265358979323846 / 180;

/* ---- A raster ------------------------------------------------------------------------------------- */

enum { WIDE = 97, TALL = 81 };

static float heights[WIDE * TALL];

/* Hills at 36 N, cells of 3"; void in one corner where asked for. */
static tl_source *hills(bool global, bool with_void, double scale)
{
    tl_crs *crs = NULL;
    for (int k = 0; k < WIDE * TALL; k++) {
        double u = (k % WIDE) / 12.0, v = (k / WIDE) / 10.0;
        heights[k] = (float)(500 + 300 * sin(u) * cos(v) + 40 * sin(5 * u + 1) * sin(6 * v)) * (float)scale;
    }
    if (with_void)
        heights[TALL / 2 * WIDE + WIDE / 2] = NAN;
    tl_source_info info = {
        .width = WIDE, .height = TALL, .type = TL_RASTER_POINT, .has_voids = with_void, .name = "hills"};
    info.georef = tl_georef_none();
    if (global) {
        assert_int_equal(dem_crs_from_text("EPSG:4326", "hills", &crs, NULL), TL_OK);
        info.georef = (tl_georef){crs, true, {11, 1 / 1200.0, 0, 36, 0, -1 / 1200.0}, 0, 0, 1};
        dem_georef_measure(&info.georef, WIDE, TALL, NULL);
    } else {
        info.georef.cell_x = info.georef.cell_y = 90;
    }
    return tl_array_source_create(heights, &info, NULL);
}

static void finish(tl_source *source)
{
    const tl_crs *crs = source->info.georef.crs;
    tl_source_destroy(source);
    tl_crs_release((tl_crs *)crs);
}

static tl_mesh *mesh_of(const tl_source *source)
{
    tl_mesh *mesh = NULL;
    assert_int_equal(tl_mesh_from_source(source, NULL, &mesh, NULL), TL_OK);
    return mesh;
}

/* ---- Checks --------------------------------------------------------------------------------------- */

static void refuse(const tl_source *dem, tl_view view, const char *word)
{
    tl_error error = {0};
    assert_null(scene_view_create(&view, dem, &error));
    assert_int_equal(error.status, TL_ERROR_ARGUMENT);
    if (!strstr(error.text, word) || !strstr(error.text, "hills") || strchr(error.text, '\n'))
        fail_msg("'%s' says nothing of '%s'", error.text, word);
    assert_null(scene_view_create(&view, dem, NULL));
}

static void viewsThatCannotBeAreRefused(void **state)
{
    (void)state;
    tl_source *dem = hills(true, true, 1);
    const tl_view good = {.eye = {11.04, 35.97, 900}};
    tl_view v = good;
    scene_view *opened = scene_view_create(&v, dem, NULL);
    assert_non_null(opened);
    scene_view_destroy(opened);
    scene_view_destroy(NULL);
    scene_skyline_destroy(NULL);
    const double fovs[] = {-1, 0.009, 179.1, (double)NAN, (double)INFINITY};
    for (int k = 0; k < 5; k++)
        refuse(dem, (tl_view){.eye = {11.04, 35.97, 900}, .fov = fovs[k]}, "field of view");
    refuse(dem, (tl_view){.eye = {11.04, 35.97, 900}, .pitch = 91}, "pitch");
    refuse(dem, (tl_view){.eye = {11.04, 35.97, 900}, .pitch = (double)NAN}, "pitch");
    refuse(dem, (tl_view){.eye = {11.04, 35.97, 900}, .heading = (double)INFINITY}, "heading");
    refuse(dem, (tl_view){.eye = {11.04, 35.97, 900}, .roll = (double)NAN}, "roll");
    refuse(dem, (tl_view){.eye = {11.04, 35.97, 900}, .refraction = 1}, "refraction");
    refuse(dem, (tl_view){.eye = {11.04, 35.97, 900}, .width = 10}, "pixels");
    refuse(dem, (tl_view){.eye = {11.04, 35.97, 900}, .width = 32769, .height = 1}, "pixels");
    refuse(dem, (tl_view){.eye = {11.04, (double)NAN, 900}}, "eye");
    refuse(dem, (tl_view){.eye = {11.04, 90.01, 900}}, "latitude");
    refuse(dem, (tl_view){.eye = {500000, 45, 900}}, "longitude");
    v = good;
    v.target_given = true;
    memcpy(v.target, v.eye, sizeof v.target);
    refuse(dem, v, "same point");
    v.target[2] = (double)NAN;
    refuse(dem, v, "target");
    refuse(dem, (tl_view){.eye = {12, 35.97, 9}, .above_ground = true}, "not on the raster");
    refuse(dem, (tl_view){.eye = {11 + WIDE / 2 / 1200.0, 36 - TALL / 2 / 1200.0, 9}, .above_ground = true}, "void");
    v = good;
    v.target_given = v.target_above_ground = true;
    v.target[0] = 20;
    v.target[1] = 40;
    refuse(dem, v, "target");
    finish(dem);
}

/* ---- Where the eye is, and where it looks ------------------------------------------------------------ */

static void look(const tl_source *dem, const tl_view *view, double i, double j, double z, double out[2])
{
    tl_error error = {0};
    scene_view *opened = scene_view_create(view, dem, &error);
    if (!opened)
        fail_msg("%s", error.text);
    double at[1][3], seen[3];
    float height = (float)z;
    scene_view_place(opened, 1, &i, &j, &height, at);
    scene_camera_view(scene_view_camera(opened), at[0], seen);
    assert_true(seen[2] > 0);
    out[0] = seen[0] / seen[2];
    out[1] = seen[1] / seen[2];
    scene_view_destroy(opened);
}

static void targetsAreInTheMiddleAndRollTurnsAround(void **state)
{
    (void)state;
    for (int global = 0; global < 2; global++) {
        tl_source *dem = hills(global, false, 1);
        tl_view v = {
            .target_given = true, .above_ground = true, .target_above_ground = true, .width = 800, .height = 600};
        const double eye[2] = {20.25, 30.5}, target[2] = {70, 8};
        double at[2];
        for (int a = 0; a < 2; a++) {
            double scale = global ? 1 / 1200.0 : 1;
            v.eye[a] = (global ? (a ? 36 : 11) : 0) + (a ? -eye[1] : eye[0]) * scale;
            v.target[a] = (global ? (a ? 36 : 11) : 0) + (a ? -target[1] : target[0]) * scale;
        }
        v.eye[2] = 200;
        v.target[2] = 5;
        float ground = heights[8 * WIDE + 70];
        for (int roll = -90; roll <= 90; roll += 90) {
            v.roll = roll;
            look(dem, &v, target[0], target[1], (double)ground + 5, at);
            assert_true(hypot(at[0], at[1]) < 1e-2);
            look(dem, &v, target[0], target[1], (double)ground + 105, at);
            /* what is above is above; the right side down, it is to the left */
            double up = roll == 0 ? -at[1] : roll > 0 ? -at[0] : at[0], aside = roll == 0 ? at[0] : at[1];
            assert_true(up > 5 && fabs(aside) < 1e-2);
        }
        finish(dem);
    }
}

static void headingAndPitchAreThoseOfACompass(void **state)
{
    (void)state;
    tl_source *dem = hills(false, false, 1);
    const double to[4][2] = {{0, -1}, {1, 0}, {0, 1}, {-1, 0}}; /* north, east, south, west in columns and rows */
    double at[2];
    for (int k = 0; k < 4; k++) {
        tl_view v = {.eye = {40, -40, 1000}, .heading = 90 * k, .pitch = -30, .width = 100, .height = 100};
        look(dem, &v, 40 + 10 * to[k][0], 40 + 10 * to[k][1], 1000 - 900 * tan(30 * radian), at);
        assert_true(hypot(at[0], at[1]) < 1e-3);
        v.pitch = -90; /* straight down, the heading at the top */
        look(dem, &v, 40 + to[k][0], 40 + to[k][1], 0, at);
        assert_true(fabs(at[0]) < 1e-6 && at[1] < -1);
    }
    finish(dem);
}

/* ---- Camera files ------------------------------------------------------------------------------------ */

static char folder[] = "/tmp/talus-view-XXXXXX";
static char file_name[64];

static const char *in_folder(const char *name)
{
    snprintf(file_name, sizeof file_name, "%s/%s", folder, name);
    return file_name;
}

static const char *write_text(const char *text)
{
    FILE *file = fopen(in_folder("camera"), "wb");
    assert_non_null(file);
    fputs(text, file);
    fclose(file);
    return file_name;
}

static void camerasAreReadFromJson(void **state)
{
    (void)state;
    tl_view v;
    tl_error error = {0};
    assert_int_equal(tl_view_read(write_text("{\"eye\": [11, 46.5, 300], \"above_ground\": true, \"heading\": 120,"
                                             "\"pitch\": -5.5, \"roll\": 2, \"fov\": 40, \"width\": 640, \"height\": "
                                             "480, \"refraction\": 0.13}"),
                                  &v, &error),
                     TL_OK);
    assert_true(v.eye[0] == 11 && v.eye[1] == 46.5 && v.eye[2] == 300 && v.above_ground && v.heading == 120);
    assert_true(v.pitch == -5.5 && v.roll == 2 && v.fov == 40 && v.width == 640 && v.height == 480);
    assert_true(v.refraction == 0.13 && !v.target_given && !v.flat && !v.projected);
    tl_view_key *keys = NULL;
    size_t count = 0;
    assert_int_equal(tl_view_path_read(write_text("{\"fov\": 50, \"flat\": true, \"views\": [{\"eye\": [1, 2, 3], "
                                                  "\"time\": 0.5, \"target\": [4, 5, 6]}, {\"eye\": [7, 8, 9], "
                                                  "\"fov\": 10}]}"),
                                       &keys, &count, &error),
                     TL_OK);
    assert_int_equal(count, 2);
    assert_true(keys[0].time == 0.5 && keys[0].view.target_given && keys[0].view.target[2] == 6);
    assert_true(keys[0].view.fov == 50 && keys[1].view.fov == 10 && keys[1].view.flat && isnan(keys[1].time));
    assert_true(!keys[1].view.target_given && keys[1].view.eye[0] == 7);
    free(keys);
    static const struct {
        const char *text, *word;
    } bad[] = {{"", "line"},
               {"{\"eye\": [1, 2, 3]", "line"},
               {"[]", "views"},
               {"{}", "eye"},
               {"7", "line"},
               {"{\"eye\": [1, 2]}", "three numbers"},
               {"{\"eye\": [1, 2, \"3\"]}", "three numbers"},
               {"{\"eye\": [1, 2, 3], \"pich\": 4}", "pich"},
               {"{\"eye\": [1, 2, 3], \"fov\": true}", "fov"},
               {"{\"eye\": [1, 2, 3], \"width\": 1e99}", "width"},
               {"{\"views\": [{\"fov\": 3}]}", "eye"},
               {"[{\"eye\": [1, 2, 3]}, 4]", "object"},
               {"[{\"eye\": [1, 2, 3]}, {\"eye\": [1, 2, 3]}]", "2 views"},
               {"glTF\2", "GLB"}};
    for (size_t k = 0; k < sizeof bad / sizeof *bad; k++) {
        assert_int_equal(tl_view_read(write_text(bad[k].text), &v, &error), TL_ERROR_DATA);
        if (!strstr(error.text, bad[k].word))
            fail_msg("%s: '%s' says nothing of %s", bad[k].text, error.text, bad[k].word);
    }
    assert_int_equal(tl_view_read(in_folder("none"), &v, &error), TL_ERROR_IO);
}

/* A GLB that talus wrote, with a camera put into its JSON: at a place of the model, looking where it was made to. */
static void camerasAreReadFromGltf(void **state)
{
    (void)state;
    /* the frame's origin at 60 N; a camera 1000 m to the east, 2000 m to the north and 300 m up */
    const char *form = "{\"asset\": {\"version\": \"2.0\", \"extras\": {\"talus\": \"x\", \"frame\": \"enu\", "
                       "\"crs_wkt\": \"EPSG:4326\", \"origin\": {\"longitude\": 10, \"latitude\": 60, \"height\": "
                       "100}}}, \"scene\": 0, \"scenes\": [{\"nodes\": [0]}], \"nodes\": [{\"translation\": [0, 300, "
                       "0], \"children\": [1]}, {\"translation\": [1000, 0, -2000], %s \"camera\": 0}], \"cameras\": "
                       "[{\"type\": \"perspective\", \"perspective\": {\"yfov\": 0.5, \"aspectRatio\": 2, \"znear\": "
                       "1}}]}";
    static const struct {
        const char *rotation;
        double heading, pitch, roll;
    } turns[] = {{"", 0, 0, 0}, /* along -Z, which is north */
                 {"\"rotation\": [0, -0.70710678118654752, 0, 0.70710678118654752],", 90, 0, 0},  /* to the east */
                 {"\"rotation\": [0.25881904510252074, 0, 0, 0.96592582628906831],", 0, 30, 0},   /* upwards */
                 {"\"rotation\": [0, 0, -0.25881904510252074, 0.96592582628906831],", 0, 0, 30}}; /* right side down */
    dem_local_frame *frame;
    tl_crs *crs = NULL;
    tl_error error = {0};
    assert_int_equal(dem_crs_from_text("EPSG:4326", "x", &crs, NULL), TL_OK);
    frame = dem_local_frame_create(crs, 10, 60, 100, NULL);
    for (size_t k = 0; k < sizeof turns / sizeof *turns; k++) {
        char text[1024];
        tl_view v;
        double xyz[3];
        snprintf(text, sizeof text, form, turns[k].rotation);
        if (tl_view_read(write_text(text), &v, &error) != TL_OK)
            fail_msg("%s", error.text);
        dem_local_frame_forward(frame, v.eye[0], v.eye[1], v.eye[2], xyz);
        assert_true(fabs(xyz[0] - 1000) < 1e-5 && fabs(xyz[1] - 2000) < 1e-5 && fabs(xyz[2] - 300) < 1e-5);
        /* the vertical turns by 1e-4 in 1000 m of longitude at this latitude, and 3e-4 in 2000 m of latitude */
        assert_true(fabs(v.heading - turns[k].heading) < 0.05 && fabs(v.pitch - turns[k].pitch) < 0.05);
        assert_true(fabs(v.roll - turns[k].roll) < 0.05);
        assert_true(fabs(tan(v.fov / 2 * radian) - 2 * tan(0.25)) < 1e-9 && v.width == 2160 && v.height == 1080);
    }
    dem_local_frame_destroy(frame);
    tl_crs_release(crs);
    static const char *const bad[][2] = {
        {"{\"asset\": {\"version\": \"2.0\"}}", "origin"},
        {"{\"asset\": {\"extras\": {\"crs_wkt\": \"EPSG:4326\", \"origin\": {\"longitude\": 1, \"latitude\": 2, "
         "\"height\": 3}}}}",
         "camera"},
        {"{\"asset\": {\"extras\": {\"crs_wkt\": \"EPSG:4326\", \"origin\": {\"longitude\": 1, \"latitude\": 2, "
         "\"height\": 3}}}, \"scenes\": [{\"nodes\": [0]}], \"nodes\": [{\"children\": [0, 0]}]}",
         "twice"},
        {"{\"asset\": {\"extras\": {\"crs_wkt\": \"EPSG:4326\", \"origin\": {\"longitude\": 1, \"latitude\": 2, "
         "\"height\": 3}}}, \"scenes\": [{\"nodes\": [0]}], \"nodes\": [{\"camera\": 5}]}",
         "camera 5"}};
    for (size_t k = 0; k < sizeof bad / sizeof *bad; k++) {
        tl_view v;
        assert_int_equal(tl_view_read(write_text(bad[k][0]), &v, &error), TL_ERROR_DATA);
        if (!strstr(error.text, bad[k][1]))
            fail_msg("'%s' says nothing of %s", error.text, bad[k][1]);
    }
}

/* ---- Pictures ---------------------------------------------------------------------------------------- */

static scene_picture paint(const tl_source *dem, const tl_mesh *mesh, const tl_view *views, size_t count,
                           const tl_view_picture_options *options)
{
    scene_view *opened[2] = {NULL};
    tl_error error = {0};
    scene_picture picture = {0};
    for (size_t k = 0; k < count; k++)
        if (!(opened[k] = scene_view_create(&views[k], dem, &error)))
            fail_msg("%s", error.text);
    scene_painter *painter = scene_painter_create(dem, options, &error);
    if (!painter || scene_paint(painter, mesh, (const scene_view *const *)opened, count, &picture, &error) != TL_OK)
        fail_msg("%s", error.text);
    scene_painter_destroy(painter);
    for (size_t k = 0; k < count; k++)
        scene_view_destroy(opened[k]);
    return picture;
}

static void expect_same_files(const char *a, const char *b)
{
    FILE *one = fopen(a, "rb"), *two = fopen(b, "rb");
    assert_true(one && two);
    for (int c = 0; c != EOF;)
        assert_int_equal(c = getc(one), getc(two));
    fclose(one);
    fclose(two);
}

static const tl_view over = {.eye = {11.04, 35.93, 2500}, .pitch = -25, .width = 300, .height = 200, .fov = 70};

static void picturesDoNotDependOnThreads(void **state)
{
    (void)state;
    tl_source *dem = hills(true, true, 1);
    tl_mesh *mesh = mesh_of(dem);
    scene_picture first = {0};
    for (unsigned threads = 1; threads <= 3; threads++) {
        tl_run run = {.threads = threads};
        scene_picture p = paint(dem, mesh, &over, 1, &(tl_view_picture_options){.haze = 5000, .run = &run});
        if (threads == 1)
            first = p;
        else {
            assert_memory_equal(p.rgba, first.rgba, (size_t)(p.width * p.height * 4));
            scene_picture_finish(&p);
        }
    }
    scene_picture_finish(&first);
    tl_mesh_destroy(mesh);
    finish(dem);
}

/* Along the pixel's own direction, the ground's place is where the depth says. */
static void depthsAreMetresAhead(void **state)
{
    (void)state;
    tl_source *dem = hills(true, false, 0); /* level ground at height 0 */
    tl_mesh *mesh = mesh_of(dem);
    scene_painter *painter = scene_painter_create(dem, NULL, NULL);
    scene_view *view = scene_view_create(&over, dem, NULL);
    const scene_camera *c = scene_view_camera(view);
    float *depth = NULL;
    assert_int_equal(scene_paint_depth(painter, mesh, view, &depth, NULL), TL_OK);
    int seen = 0, sky = 0;
    for (int y = 0; y < 200; y++)
        for (int x = 0; x < 300; x++) {
            float w = depth[y * 300 + x];
            double a = (x + 0.5 - 150) / c->focal, b = (y + 0.5 - 100) / c->focal, p[3];
            for (int k = 0; k < 3; k++)
                p[k] = (double)w * (c->ahead[k] + a * c->right[k] + b * c->down[k]) + c->eye[k];
            if (isnan(w)) {
                sky++;
                continue;
            }
            seen++;
            /* corners are rounded by 1 / 512 of a pixel each way; the ellipsoid's radii differ from the mean one by
             * 0.3 %; triangles' chords are under it by less than a millimetre */
            double drop = (p[0] * p[0] + p[1] * p[1]) / 2 / 6371000;
            assert_true(fabs(p[2] + drop) < 0.003 * (double)w / c->focal + 0.004 * drop + 1e-3);
        }
    assert_true(seen > 10000 && sky > 1000);
    free(depth);
    scene_view_destroy(view);
    scene_painter_destroy(painter);
    tl_mesh_destroy(mesh);
    finish(dem);
}

/* Level ground is seen from above and not from below; with its rows the other way round, too. */
static void groundIsSeenFromAboveOnly(void **state)
{
    (void)state;
    for (int mirrored = 0; mirrored < 2; mirrored++)
        for (int below = 0; below < 2; below++) {
            tl_source *dem = hills(true, false, 0);
            if (mirrored) {
                dem->info.georef.transform[3] -= (TALL - 1) / 1200.0;
                dem->info.georef.transform[5] = 1 / 1200.0;
            }
            tl_mesh *mesh = mesh_of(dem);
            tl_view v = over;
            v.eye[1] = 35.96;
            v.eye[2] = below ? -500 : 500;
            v.pitch = below ? 80 : -80;
            scene_painter *painter = scene_painter_create(dem, NULL, NULL);
            scene_view *view = scene_view_create(&v, dem, NULL);
            float *depth = NULL;
            assert_int_equal(scene_paint_depth(painter, mesh, view, &depth, NULL), TL_OK);
            for (int k = 0; k < 300 * 200; k++)
                assert_int_equal(isnan(depth[k]) != 0, below);
            free(depth);
            scene_view_destroy(view);
            scene_painter_destroy(painter);
            tl_mesh_destroy(mesh);
            finish(dem);
        }
}

/* No pixel below the rim of the ground shows the sky: triangles leave no gaps, at any view. */
static void meshesHaveNoCracksOnTheScreen(void **state)
{
    (void)state;
    tl_source *dem = hills(true, false, 0);
    tl_mesh *mesh = mesh_of(dem);
    scene_painter *painter = scene_painter_create(dem, NULL, NULL);
    static const struct {
        double fov, pitch, above;
    } looks[] = {{60, -60, 3000}, {179, -90, 1}, {0.01, -90, 1e9}, {30, -80, 1e5}, {100, -85, 0.01}};
    for (size_t n = 0; n < sizeof looks / sizeof *looks; n++) {
        tl_view v = over;
        v.above_ground = true;
        v.eye[1] = 35.965;
        v.eye[2] = looks[n].above;
        v.pitch = looks[n].pitch;
        v.fov = looks[n].fov;
        scene_view *view = scene_view_create(&v, dem, NULL);
        float *depth = NULL;
        assert_int_equal(scene_paint_depth(painter, mesh, view, &depth, NULL), TL_OK);
        /* level ground is one convex piece on the screen: between two pixels of a row that show it, all do */
        int seen = 0;
        for (int y = 0; y < 200; y++) {
            int first = 300, last = -1, shown = 0;
            for (int x = 0; x < 300; x++)
                if (!isnan(depth[y * 300 + x])) {
                    first = x < first ? x : first;
                    last = x;
                    shown++;
                }
            assert_true(shown == 0 || shown == last - first + 1);
            seen += shown;
        }
        assert_true(seen > 100);
        free(depth);
        scene_view_destroy(view);
    }
    scene_painter_destroy(painter);
    tl_mesh_destroy(mesh);
    finish(dem);
}

static double brightness(const scene_picture *p)
{
    double sum = 0;
    for (int64_t k = 0; k < p->width * p->height * 4; k++)
        sum += k % 4 == 3 ? 0 : p->rgba[k];
    return sum / (double)(p->width * p->height * 3);
}

static void lightFollowsTheSun(void **state)
{
    (void)state;
    tl_source *dem = hills(true, false, 1);
    for (int k = 0; k < WIDE * TALL; k++)
        heights[k] = (float)(k / WIDE) * 60; /* falls to the north */
    tl_mesh *mesh = mesh_of(dem);
    tl_view v = over;
    v.eye[1] = 35.967;
    v.eye[2] = 8000;
    v.pitch = -90;
    v.fov = 20;
    double bright[2];
    for (int facets = 0; facets < 2; facets++) {
        for (int k = 0; k < 2; k++) {
            scene_picture p =
                paint(dem, mesh, &v, 1,
                      &(tl_view_picture_options){
                          .sun_azimuth = k ? 180 : 360, .sun_elevation = 30, .grey = true, .facets = facets});
            bright[k] = brightness(&p);
            scene_picture_finish(&p);
        }
        assert_true(bright[0] > bright[1] + 30);
    }
    tl_mesh_destroy(mesh);
    finish(dem);
}

/* A board of black and white texels, two in a cell of the model: near, each has its own colour; far, all have the mean
 * of their light; beside it there is none. */
static void coloursLieWhereTheirRasterDoes(void **state)
{
    (void)state;
    enum { SIDE = 64 };
    static float board[SIDE * SIDE];
    char path[] = "/tmp/talus_test_XXXXXX";
    char name[sizeof path + 4];
    tl_error error = {0};
    tl_source *dem = hills(true, false, 1);
    close(mkstemp(path));
    snprintf(name, sizeof name, "%s.tif", path);
    for (int k = 0; k < SIDE * SIDE; k++)
        board[k] = (k % SIDE + k / SIDE) & 1 ? 255 : 0;
    tl_source_info info = {.width = SIDE, .height = SIDE, .type = TL_RASTER_AREA, .name = "board"};
    info.georef = dem->info.georef;
    const double cell = 1 / 1200.0; /* of the model; the first texel's rim is at its sample (4, 2) */
    const double transform[6] = {11 + 4.25 * cell, cell / 2, 0, 36 - 2.25 * cell, 0, -cell / 2};
    memcpy(info.georef.transform, transform, sizeof transform);
    tl_source *source = tl_array_source_create(board, &info, &error);
    if (tl_write_grid(source, name, NULL, &error) != TL_OK)
        fail_msg("%s", error.text);
    scene_colours *colours = scene_colours_open(name, dem, NULL, &error);
    if (!colours)
        fail_msg("%s", error.text);
    scene_rgb c;
    for (int y = 0; y < SIDE; y += 7)
        for (int x = 0; x < SIDE; x += 5) {
            assert_true(scene_colours_at(colours, 4.25 + x / 2., 2.25 + y / 2., 1, &c));
            assert_true(fabsf(c.r - (float)((x + y) & 1)) < 1e-4F && c.r == c.g && c.g == c.b);
        }
    assert_true(scene_colours_at(colours, 20, 18, 4000, &c));
    assert_true(fabsf(c.g - .5F) < .01F); /* a step of a byte there is 0.0073 */
    assert_false(scene_colours_at(colours, 3.9, 18, 1, &c));
    assert_false(scene_colours_at(colours, 20, 34.1, 1, &c));
    scene_colours_destroy(colours);

    tl_source *elsewhere = hills(false, false, 1);
    assert_null(scene_colours_open(name, elsewhere, NULL, &error));
    assert_non_null(strstr(error.text, "CRS"));
    tl_mesh *mesh = mesh_of(dem);
    tl_view v = over;
    scene_picture plain = paint(dem, mesh, &v, 1, &(tl_view_picture_options){.grey = true}),
                  draped = paint(dem, mesh, &v, 1, &(tl_view_picture_options){.grey = true, .colour = name});
    int64_t bytes = plain.width * plain.height * 4, differ = 0;
    for (int64_t k = 0; k < bytes; k++)
        differ += plain.rgba[k] != draped.rgba[k];
    assert_true(differ > bytes / 100 && differ < bytes);
    scene_picture_finish(&plain);
    scene_picture_finish(&draped);
    tl_mesh_destroy(mesh);
    unlink(name);
    unlink(path);
    finish(elsewhere);
    tl_source_destroy(source);
    finish(dem);
}

/* A perspective from high above the middle of quarters that are white and black by turns. */
static void perspectivesAreDraped(void **state)
{
    (void)state;
    enum { SIDE = 120 };
    tl_error error = {0};
    tl_source *dem = hills(true, false, 1);
    const tl_source_info *info = &dem->info;
    int64_t width = info->width, height = info->height;
    float *quarters = malloc((size_t)(width * height) * sizeof *quarters);
    for (int64_t k = 0; k < width * height; k++)
        quarters[k] = (2 * (k % width) < width) != (2 * (k / width) < height) ? 255 : 0;
    tl_source_info board = {.width = width, .height = height, .type = info->type, .name = "board"};
    board.georef = info->georef;
    tl_source *source = tl_array_source_create(quarters, &board, &error);
    char name[64];
    snprintf(name, sizeof name, "%s", in_folder("quarters.tif"));
    if (tl_write_grid(source, name, NULL, &error) != TL_OK)
        fail_msg("%s", error.text);
    const double *t = info->georef.transform;
    double x = t[0] + t[1] * .5 * (double)(width - 1), y = t[3] + t[5] * .5 * (double)(height - 1);
    double metres = fmin((double)width * info->georef.cell_x, (double)height * info->georef.cell_y);
    tl_preview_options o = {.width = SIDE,
                            .height = SIDE,
                            .perspective = true,
                            .view_given = true,
                            .eye = {x, y, .8 * metres},
                            .target = {x, y - .01 * t[5], 0},
                            .fov = 40,
                            .colour = name};
    scene_picture picture = {0};
    if (scene_perspective(dem, &o, &picture, &error) != TL_OK)
        fail_msg("%s", error.text);
    for (int k = 0; k < SIDE * SIDE; k++) {
        int column = k % SIDE - SIDE / 2, row = k / SIDE - SIDE / 2;
        if (abs(column) < 5 || abs(row) < 5) /* half a sample between the quarters, and the target's, and slopes */
            continue;
        const unsigned char *c = picture.rgba + 4 * k;
        assert_true((column < 0) != (row < 0) ? c[0] > 120 : c[0] < 120);
    }
    scene_picture_finish(&picture);
    tl_source_destroy(source);
    free(quarters);
    unlink(name);
    finish(dem);
}

/* Layers by their names: on flat ground the normal is up, the slope 0; and many pictures take what one takes. */
static void layersAreDraped(void **state)
{
    (void)state;
    tl_error error = {0};
    tl_source *dem = hills(true, false, 0);
    scene_rgb c;
    const char *const kinds[] = {"normal", "slope", "splat"};
    for (int k = 0; k < 3; k++) {
        scene_colours *colours = scene_colours_open(kinds[k], dem, NULL, &error);
        if (!colours)
            fail_msg("%s", error.text);
        assert_true(scene_colours_at(colours, 20.5, 18.5, 1, &c));
        if (k == 0) /* (0, 0, 1) as bytes: 128, 128, 255 */
            assert_true(fabsf(c.r - .2159F) < .01F && fabsf(c.g - .2159F) < .01F && c.b > .99F);
        else if (k == 1)
            assert_true(c.r < .001F && c.g < .001F && c.b < .001F);
        else
            assert_true(c.g > c.b);
        scene_colours_destroy(colours);
    }
    tl_mesh *mesh = mesh_of(dem);
    const tl_view_picture_options o = {.colour = "slope", .overwrite = true};
    tl_view_painter *painter = tl_view_painter_create(dem, &o, &error);
    assert_non_null(painter);
    char one[64], two[64];
    snprintf(one, sizeof one, "%s", in_folder("one.png"));
    snprintf(two, sizeof two, "%s", in_folder("two.png"));
    for (int k = 0; k < 2; k++)
        assert_int_equal(tl_view_painter_write(painter, mesh, &over, 1, one, &error), TL_OK);
    assert_int_equal(tl_view_write_picture(mesh, dem, &over, 1, two, &o, &error), TL_OK);
    expect_same_files(one, two);
    unlink(one);
    unlink(two);
    tl_view_painter_destroy(painter);
    tl_mesh_destroy(mesh);
    finish(dem);
}

/* Two views: the mean of both, in linear light. */
static void motionBlurIsTheMeanOfTheLight(void **state)
{
    (void)state;
    tl_source *dem = hills(true, false, 1);
    tl_mesh *mesh = mesh_of(dem);
    tl_view views[2] = {over, over};
    views[1].heading = 5;
    scene_picture one = paint(dem, mesh, views, 1, NULL), other = paint(dem, mesh, views + 1, 1, NULL),
                  both = paint(dem, mesh, views, 2, NULL);
    int differ = 0;
    for (int64_t k = 0; k < one.width * one.height * 4; k++) {
        int a = one.rgba[k], b = other.rgba[k], low = a < b ? a : b, high = a + b - low;
        /* the mean of light is between both, and not below the mean of bytes, but for a step of each by dithering */
        assert_true(both.rgba[k] >= (a + b) / 2 - 2 && both.rgba[k] <= high + 1 && both.rgba[k] >= low - 1);
        differ += high - low > 20;
    }
    assert_true(differ > 1000);
    scene_picture_finish(&one);
    scene_picture_finish(&other);
    scene_picture_finish(&both);
    tl_mesh_destroy(mesh);
    finish(dem);
}

static void picturesAndDepthsAreWritten(void **state)
{
    (void)state;
    tl_source *dem = hills(false, true, 1);
    tl_mesh *mesh = mesh_of(dem);
    tl_view v = {.eye = {48, -80, 1500}, .pitch = -20, .width = 64, .height = 48};
    char path[64], depth[64];
    snprintf(path, sizeof path, "%s", in_folder("look.png"));
    snprintf(depth, sizeof depth, "%s", in_folder("look.exr"));
    tl_view_picture_options o = {.depth = depth};
    tl_error error = {0};
    assert_int_equal(tl_view_write_picture(mesh, dem, &v, 1, path, &o, &error), TL_OK);
    assert_int_equal(tl_view_write_picture(mesh, dem, &v, 1, path, &o, &error), TL_ERROR_IO);
    o.overwrite = true;
    assert_int_equal(tl_view_write_picture(mesh, dem, &v, 1, path, &o, &error), TL_OK);
    tl_source *written = tl_open(depth, &error);
    assert_non_null(written);
    assert_int_equal(written->info.width, 64);
    assert_int_equal(written->info.height, 48);
    tl_source_destroy(written);
    assert_int_equal(tl_view_write_picture(mesh, dem, &v, 0, path, &o, &error), TL_ERROR_ARGUMENT);
    o.haze = -1;
    assert_int_equal(tl_view_write_picture(mesh, dem, &v, 1, path, &o, &error), TL_ERROR_ARGUMENT);
    o = (tl_view_picture_options){.overwrite = true, .depth = "depth.obj"};
    assert_int_equal(tl_view_write_picture(mesh, dem, &v, 1, path, &o, &error), TL_ERROR_ARGUMENT);
    o.depth = NULL;
    tl_run run = {.memory = 1000};
    o.run = &run;
    assert_int_equal(tl_view_write_picture(mesh, dem, &v, 1, path, &o, &error), TL_ERROR_MEMORY);
    unlink(path);
    unlink(depth);
    tl_mesh_destroy(mesh);
    finish(dem);
}

/* ---- What is left out, and what is left over --------------------------------------------------------- */

/* A field over the hills, and its pyramid. */
typedef struct scenery {
    tl_source *dem, *field;
    tl_pyramid *pyramid;
} scenery;

static scenery open_scenery(bool with_void)
{
    tl_error error = {0};
    scenery s = {.dem = hills(true, with_void, 1)};
    s.field = tl_field_create(s.dem,
                              &(tl_field_options){.levels = 4,
                                                  .support = TL_SUPPORT_POINT,
                                                  .hurst_given = true,
                                                  .hurst = 0.7,
                                                  .delta_given = true,
                                                  .delta = 15,
                                                  .seed = 5},
                              &error);
    s.pyramid = tl_pyramid_create(s.dem, NULL, &error);
    if (!s.field || !s.pyramid)
        fail_msg("%s", error.text);
    return s;
}

static void close_scenery(scenery *s)
{
    tl_source_destroy(s->field);
    tl_pyramid_destroy(s->pyramid);
    finish(s->dem);
}

static tl_mesh *selected_by(const scenery *s, const tl_view *view, const tl_lod_options *options)
{
    tl_error error = {0};
    tl_mesh *mesh = NULL;
    tl_lod_stats stats;
    if (tl_select(s->field, s->dem, s->pyramid, view, options, &mesh, &stats, &error) != TL_OK)
        fail_msg("%s", error.text);
    return mesh;
}

static tl_mesh *selected(const scenery *s, const tl_view *view, tl_selector selector, double pixels, unsigned keep)
{
    const tl_lod_options options = {.selector = selector, .pixel_error = pixels, .keep = keep};
    return selected_by(s, view, &options);
}

static const tl_view sceneries[] = {
    {.eye = {11.03, 35.95, 30}, .above_ground = true, .heading = 20, .pitch = -3, .width = 320, .height = 180},
    {.eye = {11.06, 35.98, 5}, .above_ground = true, .heading = 200, .width = 320, .height = 180, .fov = 90},
    {.eye = {11.05, 35.94, 300},
     .above_ground = true,
     .heading = -60,
     .pitch = -15,
     .roll = 30,
     .width = 200,
     .height = 200},
    {.eye = {11.04, 35.97, 400}, .above_ground = true, .pitch = -90, .width = 200, .height = 120},
};
enum { SCENERIES = sizeof sceneries / sizeof *sceneries };

/* What the rules leave out is not seen: with and without them the same ground is in the same place, exactly. */
static void whatIsLeftOutIsNotSeen(void **state)
{
    (void)state;
    for (int with_void = 0; with_void < 2; with_void++) {
        scenery s = open_scenery(with_void);
        for (int n = 0; n < SCENERIES; n++) {
            tl_mesh *whole = selected(&s, &sceneries[n], TL_SELECTOR_QUADTREE, 1, 15),
                    *seen = selected(&s, &sceneries[n], TL_SELECTOR_QUADTREE, 1, 0);
            tl_view_report report = {{0}};
            assert_int_equal(tl_view_measure(seen, whole, s.dem, &sceneries[n], NULL, &report, NULL), TL_OK);
            assert_true(3 * seen->triangle_count < 2 * whole->triangle_count);
            assert_int_equal(report.missing, 0);
            assert_true(report.parallax.count > 10000);
            assert_true(report.parallax.largest < 1e-9 && report.silhouette.largest == 0);
            tl_mesh_destroy(whole);
            tl_mesh_destroy(seen);
        }
        close_scenery(&s);
    }
}

/* 99.9 % within the pixel error, and all within twice that, against a quarter of it; for every selector, and where
 * vertices move. */
static void picturesAreWithinThePixelError(void **state)
{
    (void)state;
    scenery s = open_scenery(true);
    int coarser = 0;
    for (int n = 0; n < SCENERIES; n++) {
        const double asked = n == 1 ? 2 : 1;
        tl_mesh *reference = selected(&s, &sceneries[n], TL_SELECTOR_QUADTREE, asked / 4, 0);
        for (int way = 0; way < 2 * (TL_SELECTOR_ROAM + 1); way++) {
            const tl_lod_options options = {.selector = (tl_selector)(way / 2), .pixel_error = asked, .morph = way & 1};
            tl_mesh *mesh = selected_by(&s, &sceneries[n], &options);
            tl_view_report report = {{0}};
            assert_int_equal(tl_view_measure(mesh, reference, s.dem, &sceneries[n], NULL, &report, NULL), TL_OK);
            assert_int_equal(report.missing, 0);
            assert_true(report.parallax.thousand <= asked && report.parallax.largest <= 2 * asked);
            assert_true(report.silhouette.thousand <= asked + 0.25 && report.silhouette.largest <= 2 * asked);
            coarser += report.parallax.ninety_nine > 0.1 && 2 * mesh->triangle_count < reference->triangle_count;
            tl_mesh_destroy(mesh);
        }
        tl_mesh_destroy(reference);
    }
    assert_true(coarser >= TL_SELECTOR_ROAM + 1); /* else there was no error to measure */
    close_scenery(&s);
}

/* The largest shift, in pixels, of ground that is in two meshes, over the frames of a slow flight. */
static double largest_shift(const scenery *s, tl_selector selector, bool morph)
{
    const tl_lod_options options = {.selector = selector, .pixel_error = 2, .morph = morph};
    tl_view view = sceneries[0];
    view.eye[2] = 100;
    double largest = 0;
    tl_mesh *before = NULL;
    for (int frame = 0; frame < 10; frame++) {
        tl_mesh *mesh = selected_by(s, &view, &options);
        tl_view_report report = {{0}};
        if (before)
            assert_int_equal(tl_view_measure(before, mesh, s->dem, &view, NULL, &report, NULL), TL_OK);
        assert_true(!before || report.parallax.count > 10000);
        largest = fmax(largest, report.parallax.largest);
        tl_mesh_destroy(before);
        before = mesh;
        view.eye[1] += 2e-5; /* 2 m */
        view.heading += 0.05;
    }
    tl_mesh_destroy(before);
    return largest;
}

/* A vertex that comes or goes moves ground by the pixel error that it comes at, and more where it was chosen for a
 * neighbour that is not seen any more; one that moves there, only by what the eye's 2 m change of it: its way of one
 * pixel error (two thirds of 2, and as much again over the bound where the noise is far out) takes from once to half
 * the distance, and nothing that is seen is nearer than 50 m. */
static void groundDoesNotJump(void **state)
{
    (void)state;
    scenery s = open_scenery(false);
    for (int selector = 0; selector <= TL_SELECTOR_ROAM; selector++) {
        double jump = largest_shift(&s, (tl_selector)selector, false),
               glide = largest_shift(&s, (tl_selector)selector, true);
        print_message("selector %d: %.3f pixels, and %.3f with moving vertices\n", selector, jump, glide);
        assert_true(jump > 0.5 && glide < 0.25 * jump);
        assert_true(glide > 0 && glide < 2);
    }
    close_scenery(&s);
}

/* A known error: level ground at two heights, seen from straight above and from the side. */
static void measuredErrorsAreTheShiftOnTheScreen(void **state)
{
    (void)state;
    tl_source *dem = hills(false, false, 0);
    tl_mesh *low = mesh_of(dem), *high = mesh_of(dem);
    for (size_t k = 0; k < high->vertex_count; k++)
        high->vertices[k].z += 7;
    for (int down = 0; down < 2; down++) {
        tl_view v = {.eye = {48, -40, 1000}, .heading = 90, .width = 200, .height = 100, .fov = 30};
        v.pitch = down ? -90 : -30;
        scene_view *view = scene_view_create(&v, dem, NULL);
        const scene_camera *c = scene_view_camera(view);
        tl_view_report same, other;
        assert_int_equal(tl_view_measure(low, low, dem, &v, NULL, &same, NULL), TL_OK);
        assert_int_equal(tl_view_measure(high, low, dem, &v, NULL, &other, NULL), TL_OK);
        assert_true(same.missing == 0 && same.parallax.largest < 1e-9 && same.silhouette.largest == 0);
        assert_true(other.missing == 0 && other.parallax.count == 200 * 100);
        /* In the middle of the picture the point rises across the line of sight by 7 cos(30); from above, a point x
         * pixels from the middle moves away from it by 7 / 993 of x. */
        double middle = c->focal * 7 * cos(30 * radian) / (1000 / sin(30 * radian) - 7 * sin(30 * radian));
        double corner = hypot(100 - 0.5, 50 - 0.5) * 7 / 993;
        if (down)
            assert_true(fabs(other.parallax.largest - corner) < 0.01 * corner);
        else
            assert_true(fabs(other.parallax.half - middle) < 0.1 * middle && other.parallax.largest > middle);
        scene_view_destroy(view);
    }
    tl_mesh_destroy(low);
    tl_mesh_destroy(high);
    finish(dem);
}

static int enter(void **state)
{
    (void)state;
    return mkdtemp(folder) ? 0 : -1;
}

static int leave(void **state)
{
    (void)state;
    unlink(in_folder("camera"));
    return rmdir(folder);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(viewsThatCannotBeAreRefused),
        cmocka_unit_test(targetsAreInTheMiddleAndRollTurnsAround),
        cmocka_unit_test(headingAndPitchAreThoseOfACompass),
        cmocka_unit_test(camerasAreReadFromJson),
        cmocka_unit_test(camerasAreReadFromGltf),
        cmocka_unit_test(picturesDoNotDependOnThreads),
        cmocka_unit_test(depthsAreMetresAhead),
        cmocka_unit_test(groundIsSeenFromAboveOnly),
        cmocka_unit_test(meshesHaveNoCracksOnTheScreen),
        cmocka_unit_test(lightFollowsTheSun),
        cmocka_unit_test(coloursLieWhereTheirRasterDoes),
        cmocka_unit_test(perspectivesAreDraped),
        cmocka_unit_test(layersAreDraped),
        cmocka_unit_test(motionBlurIsTheMeanOfTheLight),
        cmocka_unit_test(picturesAndDepthsAreWritten),
        cmocka_unit_test(measuredErrorsAreTheShiftOnTheScreen),
        cmocka_unit_test(whatIsLeftOutIsNotSeen),
        cmocka_unit_test(picturesAreWithinThePixelError),
        cmocka_unit_test(groundDoesNotJump),
    };
    return cmocka_run_group_tests(tests, enter, leave);
}
