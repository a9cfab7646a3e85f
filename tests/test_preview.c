/* Pictures, judged by their pixels. */
#define _GNU_SOURCE /* mkdtemp */
#include "lib/base/size.h"
#include "lib/scene/resample.h"
#include "lib/scene/zbuffer.h"
#include "lib/talus.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>

#include <cmocka.h>

#include <dirent.h>
#include <math.h>
#include <png.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

static char folder[64], picture_path[96];

static int setUp(void **state)
{
    (void)state;
    strcpy(folder, "/tmp/talus-preview-XXXXXX");
    assert_non_null(mkdtemp(folder));
    snprintf(picture_path, sizeof picture_path, "%s/picture.png", folder);
    return 0;
}

static int entries(void)
{
    DIR *dir = opendir(folder);
    int count = -2; /* . and .. */
    while (readdir(dir))
        count++;
    closedir(dir);
    return count;
}

static int tearDown(void **state)
{
    (void)state;
    unlink(picture_path);
    assert_int_equal(entries(), 0);
    rmdir(folder);
    return 0;
}

/* ---- sources from functions ---- */

typedef float (*height_function)(double east, double south);

/* A raster over f; its first sample is at (east, south), and so is its coordinate (east, -south). */
typedef struct made {
    tl_source source;
    height_function f;
    double east, south, cell;
    bool south_up;
} made;

static tl_status made_read(const tl_source *self, int level, tl_window w, float *out, tl_error *error)
{
    (void)level;
    (void)error;
    const made *m = (const made *)self;
    for (int64_t y = 0; y < w.height; y++)
        for (int64_t x = 0; x < w.width; x++) {
            int64_t row = m->south_up ? self->info.height - 1 - w.y - y : w.y + y;
            *out++ = m->f(m->east + (double)(w.x + x) * m->cell, m->south + (double)row * m->cell);
        }
    return TL_OK;
}

static made make(height_function f, int64_t width, int64_t height, double cell)
{
    made m = {.f = f, .cell = cell};
    m.source.read = made_read;
    m.source.info = (tl_source_info){.width = width, .height = height, .has_voids = true, .name = "made"};
    m.source.info.georef = (tl_georef){
        .located = true, .transform = {0, cell, 0, 0, 0, -cell}, .cell_x = cell, .cell_y = cell, .height_unit = 1};
    return m;
}

/* The same raster with its rows stored from south to north. */
static made turned(made m)
{
    m.south_up = true;
    double *t = m.source.info.georef.transform;
    t[3] += t[5] * (double)(m.source.info.height - 1);
    t[5] = -t[5];
    return m;
}

static made moved(made m, double east, double south)
{
    m.east = m.source.info.georef.transform[0] = east;
    m.south = south;
    m.source.info.georef.transform[3] = -south;
    return m;
}

static double hash(double x, double y)
{
    uint32_t h = (uint32_t)(int64_t)floor(x) * 0x9e3779b1u ^ (uint32_t)(int64_t)floor(y) * 0x85ebca77u;
    h = (h ^ h >> 15) * 0x2c1b3c6du;
    h = (h ^ h >> 12) * 0x297a2d39u;
    return (h ^ h >> 15) / 4294967296.0;
}

static float flat(double x, double y)
{
    (void)x;
    (void)y;
    return 100;
}

static float faces_north_west(double x, double y)
{
    return (float)(0.4 * (x + y));
}

static float faces_south_east(double x, double y)
{
    return (float)(-0.4 * (x + y));
}

static float hills(double x, double y)
{
    return (float)(30 * sin(x * 0.021) * cos(y * 0.017) + 12 * sin(x * 0.06 + y * 0.05));
}

static float rough(double x, double y)
{
    return (float)(20 * hash(x, y));
}

static float all_void(double x, double y)
{
    (void)x;
    (void)y;
    return NAN;
}

/* ---- pictures ---- */

typedef struct image {
    int64_t width, height;
    unsigned char *rgba;
} image;

static image slurp(void)
{
    png_image png = {.version = PNG_IMAGE_VERSION};
    if (!png_image_begin_read_from_file(&png, picture_path))
        fail_msg("%s", png.message);
    assert_int_equal(png.format, PNG_FORMAT_RGBA);
    image result = {png.width, png.height, malloc(PNG_IMAGE_SIZE(png))};
    if (!png_image_finish_read(&png, NULL, result.rgba, 0, NULL))
        fail_msg("%s", png.message);
    return result;
}

static image drawn_beside(const made *a, const made *b, tl_preview_options options)
{
    tl_error error = {0};
    options.overwrite = true;
    if (tl_write_preview(&a->source, b ? &b->source : NULL, picture_path, &options, &error) != TL_OK)
        fail_msg("%s", error.text);
    return slurp();
}

static image drawn(made a, tl_preview_options options)
{
    return drawn_beside(&a, NULL, options);
}

static const unsigned char *pixel(const image *p, int64_t x, int64_t y)
{
    assert_true(x >= 0 && y >= 0 && x < p->width && y < p->height);
    return p->rgba + (y * p->width + x) * 4;
}

static int brightness(const image *p, int64_t x, int64_t y)
{
    const unsigned char *c = pixel(p, x, y);
    return c[0] + c[1] + c[2];
}

static void same_pixels(image a, image b)
{
    assert_int_equal(a.width, b.width);
    assert_int_equal(a.height, b.height);
    assert_memory_equal(a.rgba, b.rgba, a.width * a.height * 4);
    free(a.rgba);
    free(b.rgba);
}

/* Largest difference of any channel, and the mean one. */
static int difference(const image *a, int64_t ax, const image *b, int64_t bx, int64_t width, double *mean)
{
    int worst = 0;
    *mean = 0;
    for (int64_t y = 0; y < a->height; y++)
        for (int64_t x = 0; x < width; x++)
            for (int k = 0; k < 4; k++) {
                int d = abs(pixel(a, ax + x, y)[k] - pixel(b, bx + x, y)[k]);
                worst = d > worst ? d : worst;
                *mean += d / (4.0 * (double)(width * a->height));
            }
    return worst;
}

/* ---- hillshade ---- */

static void slopesTowardsTheSunAreBrighter(void **state)
{
    (void)state;
    for (int perspective = 0; perspective <= 1; perspective++) {
        tl_preview_options o = {.grey = true, .perspective = perspective, .width = 100, .height = 100};
        o.sun_azimuth = 315;
        o.sun_elevation = 45;
        o.view_given = true;
        memcpy(o.eye, (double[3]){50, -80, 300}, sizeof o.eye);
        memcpy(o.target, (double[3]){50, -50, 0}, sizeof o.target);
        image lit = drawn(make(faces_north_west, 101, 101, 1), o), level = drawn(make(flat, 101, 101, 1), o),
              away = drawn(make(faces_south_east, 101, 101, 1), o);
        assert_true(brightness(&lit, 50, 50) > brightness(&level, 50, 50) + 10);
        assert_true(brightness(&level, 50, 50) > brightness(&away, 50, 50) + 10);
        free(lit.rgba);
        free(level.rgba);
        free(away.rgba);
    }
}

static void northIsUpForBothOrdersOfRows(void **state)
{
    (void)state;
    made m = make(hills, 300, 200, 1);
    same_pixels(drawn(m, (tl_preview_options){0}), drawn(turned(m), (tl_preview_options){0}));
    tl_preview_options o = {.perspective = true, .width = 200, .height = 120};
    same_pixels(drawn(m, o), drawn(turned(m), o));
    o.view_given = true;
    memcpy(o.eye, (double[3]){20, -180, 90}, sizeof o.eye);
    memcpy(o.target, (double[3]){200, -60, 10}, sizeof o.target);
    same_pixels(drawn(m, o), drawn(turned(m), o));
}

static float island(double x, double y)
{
    return x >= 40 && x <= 60 && y >= 10 && y <= 20 ? 5.0f : NAN;
}

static void voidsAreTransparent(void **state)
{
    (void)state;
    image p = drawn(make(island, 100, 50, 1), (tl_preview_options){0});
    assert_int_equal(p.width, 100);
    assert_int_equal(p.height, 50);
    for (int64_t y = 0; y < 50; y++)
        for (int64_t x = 0; x < 100; x++)
            assert_int_equal(pixel(&p, x, y)[3], isnan(island((double)x, (double)y)) ? 0 : 255);
    free(p.rgba);
    /* 4 times enlarged and 4 times reduced, away from the rims */
    p = drawn(make(island, 100, 50, 1), (tl_preview_options){.width = 400});
    assert_int_equal(pixel(&p, 200, 60)[3], 255);
    assert_int_equal(pixel(&p, 140, 60)[3], 0);
    free(p.rgba);
    p = drawn(make(island, 100, 50, 1), (tl_preview_options){.width = 25});
    assert_int_equal(pixel(&p, 12, 3)[3], 255);
    assert_int_equal(pixel(&p, 8, 3)[3], 0);
    free(p.rgba);
    p = drawn(make(all_void, 100, 50, 1), (tl_preview_options){0});
    for (int64_t k = 0; k < p.width * p.height; k++)
        assert_int_equal(p.rgba[4 * k + 3], 0);
    free(p.rgba);
}

/* A plane has one slope, so its picture has one grey, whatever the size: any pattern comes from resampling. */
static void planesAreEvenAtEverySize(void **state)
{
    (void)state;
    const int widths[] = {0, 37, 100, 150, 211, 299, 301, 777};
    for (size_t k = 0; k < sizeof widths / sizeof *widths; k++) {
        image p = drawn(make(faces_north_west, 300, 200, 1), (tl_preview_options){.width = widths[k], .grey = true});
        int middle = brightness(&p, p.width / 2, p.height / 2);
        for (int64_t y = 2; y < p.height - 2; y++)
            for (int64_t x = 2; x < p.width - 2; x++)
                assert_in_range(brightness(&p, x, y), middle - 3, middle + 3); /* a step of rounding a channel */
        free(p.rgba);
    }
}

static void pixelsAreSquareInMetres(void **state)
{
    (void)state;
    made m = make(hills, 100, 100, 1);
    m.source.info.georef.cell_y = 1.5;
    image p = drawn(m, (tl_preview_options){0});
    assert_int_equal(p.width, 100);
    assert_int_equal(p.height, 150);
    free(p.rgba);
    p = drawn(make(hills, 5000, 100, 1), (tl_preview_options){0}); /* three samples a pixel */
    assert_int_equal(p.width, 1667);
    assert_int_equal(p.height, 33);
    free(p.rgba);
    /* a size of another shape: what the raster does not fill is transparent */
    p = drawn(make(hills, 100, 100, 1), (tl_preview_options){.width = 300, .height = 100});
    assert_int_equal(p.width, 300);
    assert_int_equal(p.height, 100);
    assert_int_equal(pixel(&p, 50, 50)[3], 0);
    assert_int_equal(pixel(&p, 150, 50)[3], 255);
    free(p.rgba);
}

static void besideShowsEqualSourcesEqually(void **state)
{
    (void)state;
    made m = make(hills, 400, 300, 2);
    image p = drawn_beside(&m, &m, (tl_preview_options){0});
    assert_int_equal(p.width, 2 * 400 + 8);
    assert_int_equal(p.height, 300);
    double mean;
    assert_int_equal(difference(&p, 0, &p, 408, 400, &mean), 0);
    for (int64_t y = 0; y < p.height; y++)
        for (int64_t x = 400; x < 408; x++)
            assert_int_equal(pixel(&p, x, y)[3], 0);
    free(p.rgba);
    made t = turned(m);
    p = drawn_beside(&m, &t, (tl_preview_options){.width = 208, .height = 64});
    assert_int_equal(p.width, 208);
    assert_int_equal(p.height, 64);
    assert_int_equal(difference(&p, 0, &p, 108, 100, &mean), 0);
    free(p.rgba);
}

/* Hills some 20 coarse cells long, sampled at 8 m and at 1 m. The coarse picture differs from the fine one by the error
 * of cubic interpolation, 0.02 of the slope at this wavelength, below one grey level on average; one that is moved by
 * half a coarse cell (a mix-up of areas and points) differs by more than twice that. */
static void besideShowsTheSameGround(void **state)
{
    (void)state;
    made coarse = moved(make(hills, 200, 200, 8), 3.5, 3.5), fine = make(hills, 1600, 1600, 1);
    image p = drawn_beside(&coarse, &fine, (tl_preview_options){.grey = true});
    double mean, shifted;
    assert_int_equal(p.width, 2048);
    assert_int_equal(p.height, 1020);
    difference(&p, 0, &p, 1028, 1020, &mean);
    difference(&p, 0, &p, 1028 + 4, 1016, &shifted);
    if (!(mean < 1 && shifted > 2 * mean))
        fail_msg("mean difference %g, moved by half a cell %g", mean, shifted);
    free(p.rgba);
    /* by shape, when the second raster does not say where it is */
    fine.source.info.georef.located = false;
    p = drawn_beside(&coarse, &fine, (tl_preview_options){.grey = true});
    difference(&p, 0, &p, 1028, 1020, &mean);
    assert_true(mean < 1);
    free(p.rgba);
}

static void besideRefusesAnotherPlace(void **state)
{
    (void)state;
    made a = make(hills, 100, 100, 1), b = moved(a, 5000, 0);
    tl_error error;
    assert_int_equal(tl_write_preview(&a.source, &b.source, picture_path, &(tl_preview_options){0}, &error),
                     TL_ERROR_ARGUMENT);
    assert_non_null(strstr(error.text, "does not cover"));
    assert_int_equal(entries(), 0);
}

static void resamplingTakesMeansOfValidSamples(void **state)
{
    (void)state;
    enum { SIDE = 60, STEP = 5, PIXELS = SIDE / STEP };
    float *heights = malloc(SIDE * SIDE * sizeof *heights);
    for (int k = 0; k < SIDE * SIDE; k++)
        heights[k] = hash(k, 7) < 0.2 ? NAN : (float)hash(k, 3);
    tl_source_info info = {.width = SIDE, .height = SIDE, .has_voids = true, .name = "random"};
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    scene_axis axis = {(STEP - 1) / 2.0, STEP, PIXELS};
    scene_raster raster;
    assert_int_equal(scene_raster_init(&raster, PIXELS, PIXELS, NULL), TL_OK);
    assert_int_equal(scene_resample(source, &axis, &axis, NULL, &raster, NULL), TL_OK);
    for (int y = 0; y < PIXELS; y++)
        for (int x = 0; x < PIXELS; x++) {
            double sum = 0, count = 0;
            for (int k = 0; k < STEP * STEP; k++) {
                float z = heights[(y * STEP + k / STEP) * SIDE + x * STEP + k % STEP];
                sum += isnan(z) ? 0 : (double)z;
                count += !isnan(z);
            }
            assert_true(fabs((double)raster.heights[y * PIXELS + x] - sum / count) < 1e-6);
            assert_true(fabs((double)raster.coverage[y * PIXELS + x] / 255 - count / (STEP * STEP)) < 0.5001 / 255);
        }
    scene_raster_finish(&raster);
    tl_source_destroy(source);
    free(heights);
}

/* Holds two coarser levels, and remembers the finest one that was read. */
typedef struct layered {
    tl_source source;
    int finest_read;
} layered;

static tl_status layered_size(const tl_source *self, int level, int64_t *width, int64_t *height, tl_error *error)
{
    (void)error;
    if (level < -2 || level > 0)
        return TL_ERROR_ARGUMENT;
    *width = ((self->info.width - 1) >> -level) + 1;
    *height = ((self->info.height - 1) >> -level) + 1;
    return TL_OK;
}

/* A plane, so that means are the plane at cells' middles. */
static tl_status layered_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    (void)error;
    layered *l = (layered *)self;
    double size = ldexp(1, -level);
    l->finest_read = level > l->finest_read ? level : l->finest_read;
    for (int64_t k = 0; k < window.width * window.height; k++) {
        double x = ((double)(window.x + k % window.width) + 0.5) * size - 0.5;
        double y = ((double)(window.y + k / window.width) + 0.5) * size - 0.5;
        out[k] = (float)(3 * x - 2 * y + 7);
    }
    return TL_OK;
}

static void largePixelsAreMadeFromCoarserLevels(void **state)
{
    (void)state;
    const struct {
        double step;
        int level; /* that is read */
        tl_raster_type type;
    } cases[] = {{3.9, 0, TL_RASTER_AREA}, {4, -1, TL_RASTER_AREA},     {7.7, -1, TL_RASTER_AREA},
                 {8, -2, TL_RASTER_AREA},  {100.3, -2, TL_RASTER_AREA}, {100.3, 0, TL_RASTER_POINT}};
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        layered l = {.source = {.info = {.width = 4096, .height = 4096, .type = cases[k].type, .name = "layered"},
                                .read = layered_read,
                                .size = layered_size},
                     .finest_read = -100};
        scene_axis axis = {cases[k].step, cases[k].step, 30};
        scene_raster raster;
        assert_int_equal(scene_raster_init(&raster, 30, 30, NULL), TL_OK);
        assert_int_equal(scene_resample(&l.source, &axis, &axis, &(tl_run){.threads = 1}, &raster, NULL), TL_OK);
        assert_int_equal(l.finest_read, cases[k].level);
        for (int p = 0; cases[k].type == TL_RASTER_AREA && p < 900; p++) {
            double x = axis.origin + axis.step * (p % 30), y = axis.origin + axis.step * (p / 30);
            assert_true(fabs((double)raster.heights[p] - (3 * x - 2 * y + 7)) < 1e-3);
        }
        scene_raster_finish(&raster);
    }
}

/* ---- z-buffer ---- */

enum { BUFFER = 200 };

static void neighbouringTrianglesLeaveNoGap(void **state)
{
    (void)state;
    enum { GRID = 41 };
    scene_zbuffer z = {.width = BUFFER, .height = BUFFER, .left = -BUFFER / 2, .top = -BUFFER / 2, .near_plane = 1e-6};
    z.fragments = malloc(BUFFER * BUFFER * sizeof *z.fragments);
    scene_zbuffer_clear(&z);
    scene_corner corners[GRID * GRID];
    for (int k = 0; k < GRID * GRID; k++) {
        int i = k % GRID, j = k / GRID;
        double w = 1 + 3 * hash(k, 1), x = (i - 20 + 0.4 * hash(k, 2)) * 6, y = (j - 20 + 0.4 * hash(k, 3)) * 6;
        corners[k] = (scene_corner){x * w, y * w, w, (float)w, 0, 0};
    }
    for (int k = 0; k + GRID + 1 < GRID * GRID; k++)
        if (k % GRID + 1 < GRID) {
            scene_zbuffer_triangle(&z, &corners[k], &corners[k + 1], &corners[k + GRID]);
            scene_zbuffer_triangle(&z, &corners[k + 1], &corners[k + GRID], &corners[k + GRID + 1]);
        }
    for (int k = 0; k < BUFFER * BUFFER; k++) {
        const scene_fragment *f = &z.fragments[k];
        assert_true(f->nearness > 0);
        /* height is w at the corners, hence everywhere, if it is interpolated in space and not on the screen */
        assert_true(fabs((double)f->height * (double)f->nearness - 1) < 1e-5);
    }
    free(z.fragments);
}

static void cutTrianglesKeepTheirPlane(void **state)
{
    (void)state;
    /* ground 2 below an eye that looks ahead: from behind the eye to far ahead, and far to both sides */
    scene_zbuffer z = {.width = BUFFER, .height = BUFFER, .left = -BUFFER / 2, .top = -BUFFER / 2, .near_plane = 1e-3};
    z.fragments = malloc(BUFFER * BUFFER * sizeof *z.fragments);
    scene_zbuffer_clear(&z);
    double focal = 100, wide = 1e9;
    const scene_corner c[4] = {{-wide * focal, 2 * focal, -50, -50, 0, 0},
                               {wide * focal, 2 * focal, -50, -50, 0, 0},
                               {wide * focal, 2 * focal, 1e4, 1e4, 0, 0},
                               {-wide * focal, 2 * focal, 1e4, 1e4, 0, 0}};
    scene_zbuffer_triangle(&z, &c[0], &c[1], &c[2]);
    scene_zbuffer_triangle(&z, &c[0], &c[2], &c[3]);
    for (int y = 0; y < BUFFER; y++)
        for (int x = 0; x < BUFFER; x++) {
            const scene_fragment *f = &z.fragments[y * BUFFER + x];
            double below = y + 0.5 - BUFFER / 2, w = 2 * focal / below; /* where the pixel's ray meets the ground */
            assert_int_equal(f->nearness > 0, below > 0 && w < 1e4);
            if (below > 2) /* subpixels of 1/256 move rays by 1e-3 of it at most */
                assert_true(fabs((double)f->height / w - 1) < 4e-3);
        }
    free(z.fragments);
}

/* ---- perspective ---- */

static float one_patch(double x, double y)
{
    return fabs(x - 700) <= 40 && fabs(y - 300) <= 40 ? 50.0f : NAN;
}

static void theTargetIsInTheMiddle(void **state)
{
    (void)state;
    made m = make(one_patch, 101, 81, 10);
    tl_preview_options o = {.perspective = true, .view_given = true, .width = 160, .height = 90, .fov = 20};
    memcpy(o.eye, (double[3]){300, -900, 600}, sizeof o.eye);
    memcpy(o.target, (double[3]){700, -300, 50}, sizeof o.target);
    image p = drawn(m, o);
    /* the sky is grey-blue, lowlands green */
    assert_true(pixel(&p, 80, 45)[1] > pixel(&p, 80, 45)[2]);
    assert_true(pixel(&p, 40, 45)[1] < pixel(&p, 40, 45)[2]);
    assert_true(pixel(&p, 120, 45)[1] < pixel(&p, 120, 45)[2]);
    free(p.rgba);
    o.exaggeration = 3; /* stretches the eye and the target with the ground */
    p = drawn(m, o);
    assert_true(pixel(&p, 80, 45)[1] > pixel(&p, 80, 45)[2]);
    free(p.rgba);
}

/* Rough enough that the steps of neighbouring tiles differ by pixels; high ground out of sight keeps all that is seen
 * in the greens, which the bright sky never has (dark slopes in the haze may be bluish). */
static float spiky(double x, double y)
{
    return y < 300 ? 2000 : (float)(60 * hash(x / 2, y / 2));
}

static void surfacesHaveNoCracks(void **state)
{
    (void)state;
    made m = make(spiky, 3000, 3000, 1);
    const double eyes[][3] = {{1500, -2700, 700}, {1500, -2500, 150}, {700, -2900, 1500}};
    for (size_t k = 0; k < sizeof eyes / sizeof *eyes; k++) {
        tl_preview_options o = {.perspective = true, .view_given = true, .width = 480, .height = 400, .fov = 35};
        memcpy(o.eye, eyes[k], sizeof o.eye);
        memcpy(o.target, (double[3]){1500, -1800, 0}, sizeof o.target);
        if (k == 1)
            memcpy(o.target, (double[3]){1500, -2300, 0}, sizeof o.target);
        image p = drawn(m, o);
        for (int64_t y = 0; y < p.height; y++)
            for (int64_t x = 0; x < p.width; x++)
                if (pixel(&p, x, y)[1] <= pixel(&p, x, y)[2] && pixel(&p, x, y)[1] > 180)
                    fail_msg("view %zu: sky at %d, %d", k, (int)x, (int)y);
        free(p.rgba);
    }
}

static float waves(double x, double y)
{
    return (float)(3 * sin(x * 0.35) * sin(y * 0.29) + 2 * sin(x * 1.1 + y));
}

/* A raster too large to be held shows the same as a small one that is held whole. */
static void closeUpsAreReadFromTheSource(void **state)
{
    (void)state;
    made large = make(waves, 9001, 1201, 1), small = moved(make(waves, 1025, 1025, 1), 4096, 64);
    const double heights[] = {12, 60, 400};
    for (int k = 0; k < 3; k++) {
        tl_preview_options o = {.perspective = true, .view_given = true, .grey = true, .width = 320, .height = 200};
        memcpy(o.eye, (double[3]){4600, -600, heights[k]}, sizeof o.eye);
        memcpy(o.target, (double[3]){4605, -600 + heights[k] / 2, 0}, sizeof o.target);
        image a = drawn(large, o), b = drawn(small, o);
        double mean;
        int worst = difference(&a, 0, &b, 0, a.width, &mean);
        /* haze depends on the raster's size: at 400 m it takes (400 / 2600)^2 = 2 % of the small one's light, a few
         * levels; below that, rounding is left */
        if (mean > (k == 2 ? 4 : 1) || worst > (k == 2 ? 12 : 4))
            fail_msg("%g m above: mean difference %g, worst %d", heights[k], mean, worst);
        free(a.rgba);
        free(b.rgba);
    }
}

/* ---- both ---- */

static void threadsDoNotChangeThePicture(void **state)
{
    (void)state;
    made m = make(hills, 5000, 900, 1);
    tl_run one = {.threads = 1}, three = {.threads = 3};
    tl_preview_options o = {.run = &one}, q = {.run = &three};
    same_pixels(drawn(m, o), drawn(m, q));
    o.perspective = q.perspective = true;
    o.width = q.width = 700;
    same_pixels(drawn(m, o), drawn(m, q));
    o.view_given = q.view_given = true;
    memcpy(o.eye, (double[3]){800, -500, 60}, sizeof o.eye);
    memcpy(o.target, (double[3]){900, -400, 0}, sizeof o.target);
    memcpy(q.eye, o.eye, sizeof o.eye);
    memcpy(q.target, o.target, sizeof o.target);
    same_pixels(drawn(m, o), drawn(m, q));
}

static float huge(double x, double y)
{
    return hash(x, y) < 0.5 ? -1e30f : 1e30f;
}

static float largest(double x, double y)
{
    return hash(x, y) < 0.5 ? -3e38f : 3e38f;
}

static float infinite(double x, double y)
{
    return hash(x, y) < 0.5 ? -INFINITY : INFINITY;
}

static float checkerboard(double x, double y)
{
    return (int64_t)(x + y) % 2 ? NAN : 5.0f;
}

static float one_sample(double x, double y)
{
    return x == 3 && y == 2 ? 5.0f : NAN;
}

/* Every combination ends in a picture or in one clear error. */
static void extremesEndWell(void **state)
{
    (void)state;
    const height_function functions[] = {flat,     hills,        rough,      huge,    largest,
                                         infinite, checkerboard, one_sample, all_void};
    const int64_t sizes[][2] = {{1, 1}, {1, 50}, {50, 1}, {2, 2}, {3, 2}, {70, 66}};
    const double views[][6] = {
        {30, -30, -50, 31, -20, 0},  {30, -30, 100, 30, -30, 0},      {30, -30, 100, 30, -30, 200},
        {0, 0, 1e9, 1, -1, 0},       {30.5, -30.5, 5, 31, -31, 1e8},  {1e9, -1e9, 10, 0, 0, 0},
        {10, -10, 1e30, 20, -20, 0}, {30, -30, 1, 30, -30 + 1e-9, 1}, {5, 5, 0, 60, -60, 0}};
    const double fovs[] = {1, 50, 170};
    enum { VIEWS = sizeof views / sizeof *views };
    for (size_t f = 0; f < sizeof functions / sizeof *functions; f++)
        for (size_t s = 0; s < sizeof sizes / sizeof *sizes; s++)
            for (int v = -2; v < VIEWS; v++) {
                made m = make(functions[f], sizes[s][0], sizes[s][1], 1);
                tl_preview_options o = {.width = 40, .height = 23, .overwrite = true};
                o.perspective = v >= -1;
                o.view_given = v >= 0;
                o.fov = fovs[(f + s + (size_t)(v + 2)) % 3];
                if (v >= 0) {
                    memcpy(o.eye, views[v], sizeof o.eye);
                    memcpy(o.target, views[v] + 3, sizeof o.target);
                }
                tl_error error = {0};
                tl_status status = tl_write_preview(&m.source, NULL, picture_path, &o, &error);
                if (status != TL_OK) {
                    assert_int_equal(error.status, status);
                    assert_true(strlen(error.text) > 10 && !strchr(error.text, '\n'));
                    assert_int_equal(entries(), 0);
                } else {
                    image p = slurp();
                    assert_int_equal(p.width, 40);
                    free(p.rgba);
                    unlink(picture_path);
                }
                if (v == -2)
                    assert_int_equal(status, TL_OK);
            }
}

static float finer_than_pixels(double x, double y)
{
    return (float)(x * 1e-3 + y * 1e-4);
}

/* A raster of a million columns, seen whole: many samples a pixel, and a picture one pixel high. */
static void longRastersAreReadInBoundedWindows(void **state)
{
    (void)state;
    image p = drawn(make(finer_than_pixels, 1000000, 3, 1), (tl_preview_options){0});
    assert_int_equal(p.width, 2045); /* 489 samples a pixel */
    assert_int_equal(p.height, 1);
    free(p.rgba);
    p = drawn(make(finer_than_pixels, 70000, 40, 1), (tl_preview_options){.width = 1, .height = 1});
    assert_int_equal(pixel(&p, 0, 0)[3], 255);
    free(p.rgba);
    p = drawn(make(finer_than_pixels, 70000, 40, 1),
              (tl_preview_options){.perspective = true, .width = 200, .height = 50});
    free(p.rgba);
    made thin = make(hills, 400, 400, 1);
    thin.source.info.georef.cell_y = 1000; /* cells of 1 : 1000 */
    p = drawn(thin, (tl_preview_options){0});
    assert_int_equal(p.height, 2041); /* 196 m a pixel */
    assert_int_equal(p.width, 2);
    free(p.rgba);
    p = drawn(thin, (tl_preview_options){.perspective = true, .width = 200});
    assert_int_equal(p.height, 113); /* 16 : 9 */
    free(p.rgba);
}

static void wrongOptionsAreRefused(void **state)
{
    (void)state;
    made m = make(hills, 20, 20, 1);
    tl_preview_options same = {.perspective = true, .view_given = true, .eye = {1, 2, 3}, .target = {1, 2, 3}};
    tl_preview_options nowhere = {.perspective = true, .view_given = true, .eye = {(double)NAN, 2, 3}};
    const tl_preview_options wrong[] = {
        same,
        nowhere,
        {.perspective = true, .fov = 171},
        {.perspective = true, .fov = 0.5},
        {.width = -1},
        {.height = 40000},
        {.sun_elevation = 91},
        {.sun_azimuth = (double)INFINITY},
        {.exaggeration = -1},
    };
    for (size_t k = 0; k < sizeof wrong / sizeof *wrong; k++) {
        tl_error error = {0};
        assert_int_equal(tl_write_preview(&m.source, NULL, picture_path, &wrong[k], &error), TL_ERROR_ARGUMENT);
        assert_true(strlen(error.text) > 20);
        assert_int_equal(entries(), 0);
    }
    tl_error error = {0};
    tl_preview_options perspective = {.perspective = true};
    assert_int_equal(tl_write_preview(&m.source, &m.source, picture_path, &perspective, &error), TL_ERROR_ARGUMENT);
    image p = drawn(m, (tl_preview_options){0});
    free(p.rgba);
    assert_int_equal(tl_write_preview(&m.source, NULL, picture_path, NULL, &error), TL_ERROR_IO);
    assert_int_equal(entries(), 1);
}

static void cancelledPicturesLeaveNothing(void **state)
{
    (void)state;
    made m = make(hills, 3000, 3000, 1);
    volatile int cancel = 1;
    tl_run run = {.cancel = &cancel};
    for (int perspective = 0; perspective <= 1; perspective++) {
        tl_preview_options o = {.perspective = perspective, .run = &run};
        tl_error error;
        assert_int_equal(tl_write_preview(&m.source, NULL, picture_path, &o, &error), TL_ERROR_CANCELLED);
        assert_int_equal(entries(), 0);
    }
}

#define WITH_FOLDER(test) cmocka_unit_test_setup_teardown(test, setUp, tearDown)

int main(void)
{
    const struct CMUnitTest tests[] = {
        WITH_FOLDER(slopesTowardsTheSunAreBrighter),
        WITH_FOLDER(northIsUpForBothOrdersOfRows),
        WITH_FOLDER(voidsAreTransparent),
        WITH_FOLDER(planesAreEvenAtEverySize),
        WITH_FOLDER(pixelsAreSquareInMetres),
        WITH_FOLDER(besideShowsEqualSourcesEqually),
        WITH_FOLDER(besideShowsTheSameGround),
        WITH_FOLDER(besideRefusesAnotherPlace),
        cmocka_unit_test(resamplingTakesMeansOfValidSamples),
        cmocka_unit_test(largePixelsAreMadeFromCoarserLevels),
        cmocka_unit_test(neighbouringTrianglesLeaveNoGap),
        cmocka_unit_test(cutTrianglesKeepTheirPlane),
        WITH_FOLDER(theTargetIsInTheMiddle),
        WITH_FOLDER(surfacesHaveNoCracks),
        WITH_FOLDER(closeUpsAreReadFromTheSource),
        WITH_FOLDER(threadsDoNotChangeThePicture),
        WITH_FOLDER(extremesEndWell),
        WITH_FOLDER(longRastersAreReadInBoundedWindows),
        WITH_FOLDER(wrongOptionsAreRefused),
        WITH_FOLDER(cancelledPicturesLeaveNothing),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
