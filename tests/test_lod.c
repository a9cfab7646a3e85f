#include "lib/scene/mesh_picture.h"
#include "lib/scene/view.h"
#include "lib/talus.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

/* ---- Worlds ---- */

static uint32_t next_random(uint32_t *state)
{
    *state = *state * 1664525U + 1013904223U;
    return *state >> 8;
}

static double uniform(uint32_t *state, double low, double high)
{
    return low + (high - low) * (double)next_random(state) / 16777216;
}

enum { VOIDS_NONE, VOIDS_FEW, VOIDS_MANY, VOIDS_CHECKERS, VOIDS_ALL, VOID_KINDS };

/* A model with all that a view needs. */
typedef struct world {
    int width, height, levels;
    float *heights;
    float *fine; /* all of the field, once it was asked for */
    tl_source *dem, *field;
    tl_pyramid *pyramid;
} world;

static bool make_void(int kind, int i, int j, uint32_t *state)
{
    switch (kind) {
    case VOIDS_FEW:
        return next_random(state) % 97 == 0;
    case VOIDS_MANY:
        return next_random(state) % 4 == 0;
    case VOIDS_CHECKERS:
        return (i + j) & 1;
    default:
        return kind == VOIDS_ALL;
    }
}

/* Hills of 100 and noise of 5 units on cells of `cell` metres. */
static world make_world(int width, int height, int levels, int voids, double cell, uint32_t seed)
{
    tl_error error;
    world w = {.width = width, .height = height, .levels = levels};
    w.heights = malloc((size_t)(width * height) * sizeof *w.heights);
    for (int j = 0; j < height; j++)
        for (int i = 0; i < width; i++) {
            double z = 100 * sin(i * .11) * cos(j * .07) + uniform(&seed, 0, 5);
            w.heights[j * width + i] = make_void(voids, i, j, &seed) ? NAN : (float)z;
        }
    tl_source_info info = {
        .width = width,
        .height = height,
        .type = TL_RASTER_POINT,
        .has_voids = voids != VOIDS_NONE,
        .name = "hills",
        .georef = {.transform = {0, 1, 0, 0, 0, -1}, .cell_x = cell, .cell_y = cell, .height_unit = 1}};
    w.dem = tl_array_source_create(w.heights, &info, &error);
    tl_field_options options = {.levels = levels,
                                .support = TL_SUPPORT_POINT,
                                .hurst_given = true,
                                .hurst = .8,
                                .delta_given = true,
                                .delta = 5,
                                .seed = 3};
    w.field = tl_field_create(w.dem, &options, &error);
    w.pyramid = tl_pyramid_create(w.dem, NULL, &error);
    assert_non_null(w.field);
    assert_non_null(w.pyramid);
    return w;
}

static void free_world(world *w)
{
    tl_source_destroy(w->field);
    tl_pyramid_destroy(w->pyramid);
    tl_source_destroy(w->dem);
    free(w->heights);
    free(w->fine);
}

/* A view from above the middle; positions are columns and negative rows. */
static tl_view view_over(const world *w, double heading, double pitch, double height)
{
    return (tl_view){.eye = {.5 * w->width, -.5 * w->height, height},
                     .heading = heading,
                     .pitch = pitch,
                     .fov = 75,
                     .width = 640,
                     .height = 400};
}

/* Arguments of one call are worked out in an order that is the compiler's: each number is drawn on its own. */
static int whole(uint32_t *state, int low, int count)
{
    return low + (int)(next_random(state) % (uint32_t)count);
}

static world random_world(int low, int count, int levels, int voids, uint32_t *state)
{
    int width = whole(state, low, count), height = whole(state, low, count);
    return make_world(width, height, levels, voids, 10, *state);
}

static tl_view random_view(const world *w, uint32_t *state)
{
    double heading = uniform(state, 0, 360), pitch = uniform(state, -80, 10), height = uniform(state, 120, 400);
    tl_view v = view_over(w, heading, pitch, height);
    v.eye[0] = uniform(state, 0, w->width);
    v.eye[1] = -uniform(state, 0, w->height);
    v.fov = uniform(state, 30, 130);
    return v;
}

static tl_mesh *select_view(const world *w, const tl_view *view, const tl_lod_options *options, tl_lod_stats *stats)
{
    tl_error error = {0};
    tl_mesh *mesh = NULL;
    if (tl_select(w->field, w->dem, w->pyramid, view, options, &mesh, stats, &error) != TL_OK)
        fail_msg("%s", error.text);
    return mesh;
}

/* ---- Meshes ---- */

static int by_number(const void *a, const void *b)
{
    uint64_t one = *(const uint64_t *)a, two = *(const uint64_t *)b;
    return one < two ? -1 : one > two;
}

static uint64_t place_key(int64_t i, int64_t j)
{
    return (uint64_t)(uint32_t)i << 32 | (uint32_t)j;
}

/* Edges, each as its lower and higher vertex. */
static uint64_t *edges_of(const tl_mesh *m)
{
    uint64_t *edges = malloc((3 * m->triangle_count + 1) * sizeof *edges);
    for (size_t t = 0; t < m->triangle_count; t++)
        for (int k = 0; k < 3; k++) {
            uint64_t a = m->indices[3 * t + (size_t)k], b = m->indices[3 * t + (size_t)(k + 1) % 3];
            edges[3 * t + (size_t)k] = a < b ? a << 32 | b : b << 32 | a;
        }
    qsort(edges, 3 * m->triangle_count, sizeof *edges, by_number);
    return edges;
}

static uint64_t *places_of(const tl_mesh *m)
{
    uint64_t *places = malloc((m->vertex_count + 1) * sizeof *places);
    for (size_t k = 0; k < m->vertex_count; k++)
        places[k] = place_key(m->vertices[k].i, m->vertices[k].j);
    qsort(places, m->vertex_count, sizeof *places, by_number);
    return places;
}

/* The lattice's edges are split in their middles, so a crack is an edge with one side whose middle is a vertex. */
static void expect_no_cracks(const tl_mesh *m)
{
    uint64_t *edges = edges_of(m), *places = places_of(m);
    for (size_t k = 1; k < m->vertex_count; k++)
        assert_int_not_equal(places[k], places[k - 1]);
    for (size_t k = 0, end; k < 3 * m->triangle_count; k = end) {
        for (end = k + 1; end < 3 * m->triangle_count && edges[end] == edges[k]; end++)
            ;
        assert_true(end - k <= 2);
        const tl_vertex *a = &m->vertices[edges[k] >> 32], *b = &m->vertices[(uint32_t)edges[k]];
        if (end - k == 2 || ((a->i + b->i) | (a->j + b->j)) & 1)
            continue;
        uint64_t middle = place_key((a->i + b->i) / 2, (a->j + b->j) / 2);
        assert_null(bsearch(&middle, places, m->vertex_count, sizeof *places, by_number));
    }
    free(edges);
    free(places);
}

/* The field's height at a vertex. (Read once as a whole: around voids one sample costs what hundreds do.) */
static float field_at(world *w, const tl_vertex *v)
{
    tl_error error;
    size_t width = ((size_t)(w->width - 1) << w->levels) + 1, height = ((size_t)(w->height - 1) << w->levels) + 1;
    if (!w->fine) {
        w->fine = malloc(width * height * sizeof *w->fine);
        assert_int_equal(tl_source_read(w->field, w->levels, (tl_window){0, 0, width, height}, w->fine, &error), TL_OK);
    }
    return w->fine[(size_t)v->j * width + (size_t)v->i];
}

/* Triangles face up, and have known corners on the field. */
static void expect_sound(world *w, const tl_mesh *m)
{
    for (size_t t = 0; t < m->triangle_count; t++) {
        const uint32_t *n = m->indices + 3 * t;
        const tl_vertex *a = &m->vertices[n[0]], *b = &m->vertices[n[1]], *c = &m->vertices[n[2]];
        int64_t area = (int64_t)(b->i - a->i) * (c->j - a->j) - (int64_t)(b->j - a->j) * (c->i - a->i);
        assert_true(area < 0);
    }
    for (size_t k = 0; k < m->vertex_count; k++) {
        float z = field_at(w, &m->vertices[k]);
        assert_memory_equal(&z, &m->vertices[k].z, sizeof z);
    }
}

/* Each triangle by its corners' places, the lowest first. */
typedef struct corners {
    uint64_t at[3];
} corners;

static int by_corners(const void *a, const void *b)
{
    return memcmp(a, b, sizeof(corners));
}

static corners triangle_of(const tl_mesh *m, size_t triangle)
{
    corners out;
    uint64_t at[3];
    for (int k = 0; k < 3; k++) {
        const tl_vertex *v = &m->vertices[m->indices[3 * triangle + (size_t)k]];
        at[k] = place_key(v->i, v->j);
    }
    int first = at[0] < at[1] ? (at[0] < at[2] ? 0 : 2) : at[1] < at[2] ? 1 : 2;
    for (int k = 0; k < 3; k++)
        out.at[k] = at[(first + k) % 3];
    return out;
}

static corners *corners_of(const tl_mesh *m)
{
    corners *out = malloc((m->triangle_count + 1) * sizeof *out);
    for (size_t t = 0; t < m->triangle_count; t++)
        out[t] = triangle_of(m, t);
    qsort(out, m->triangle_count, sizeof *out, by_corners);
    return out;
}

static void expect_same_triangles(const tl_mesh *a, const tl_mesh *b)
{
    assert_int_equal(a->triangle_count, b->triangle_count);
    corners *one = corners_of(a), *two = corners_of(b);
    assert_memory_equal(one, two, a->triangle_count * sizeof *one);
    free(one);
    free(two);
}

static void expect_same_bytes(const tl_mesh *a, const tl_mesh *b)
{
    assert_int_equal(a->triangle_count, b->triangle_count);
    assert_int_equal(a->vertex_count, b->vertex_count);
    assert_memory_equal(a->vertices, b->vertices, a->vertex_count * sizeof *a->vertices);
    assert_memory_equal(a->indices, b->indices, 3 * a->triangle_count * sizeof *a->indices);
}

/* ---- Cracks ---- */

static void noCracksAnywhere(void **state)
{
    (void)state;
    uint32_t seed = 11;
    size_t drawn = 0;
    for (int round = 0; round < 60; round++) {
        int levels = whole(&seed, 0, 4);
        world w = random_world(2, 60, levels, round % VOID_KINDS, &seed);
        for (int selector = 0; selector < 3; selector++) {
            tl_view view = random_view(&w, &seed);
            tl_lod_options options = {.selector = (tl_selector)selector, .pixel_error = exp(uniform(&seed, -1, 6))};
            options.keep = next_random(&seed) % 16;
            tl_mesh *mesh = select_view(&w, &view, &options, NULL);
            expect_no_cracks(mesh);
            expect_sound(&w, mesh);
            drawn += mesh->triangle_count;
            tl_mesh_destroy(mesh);
        }
        free_world(&w);
    }
    assert_true(drawn > 100000);
}

/* With everything kept and no detail, what is drawn is what the framework draws: no void is filled or widened. */
static void voidsAreThoseOfTheFramework(void **state)
{
    (void)state;
    for (int kind = 0; kind < VOID_KINDS; kind++) {
        tl_error error;
        world w = make_world(43, 37, 0, kind, 10, 5);
        tl_selection selection = {.max_error = 0};
        tl_framework *framework = tl_framework_from_pyramid(w.pyramid, w.dem, &selection, &error);
        tl_mesh *expected = NULL;
        assert_int_equal(tl_framework_mesh(framework, &expected, &error), TL_OK);
        tl_view view = view_over(&w, 0, -30, 300);
        tl_lod_options options = {.pixel_error = 1e-9, .keep = 15};
        tl_mesh *mesh = select_view(&w, &view, &options, NULL);
        if (kind != VOIDS_CHECKERS && tl_framework_isolated_count(framework) == 0 && kind != VOIDS_MANY)
            expect_same_triangles(mesh, expected); /* the framework ties in what lies alone among voids */
        else
            assert_true(mesh->triangle_count <= expected->triangle_count);
        tl_mesh_destroy(mesh);
        tl_mesh_destroy(expected);
        tl_framework_destroy(framework);
        free_world(&w);
    }
}

/* ---- Selectors ---- */

static void roamFindsWhatQuadtreeFinds(void **state)
{
    (void)state;
    uint32_t seed = 23;
    for (int round = 0; round < 24; round++) {
        world w = random_world(10, 60, round % 4, round % VOID_KINDS, &seed);
        tl_view view = random_view(&w, &seed);
        tl_lod_options options = {.pixel_error = exp(uniform(&seed, 0, 5)), .keep = round % 3 ? 0 : 15};
        if (round % 4 == 3)
            options = (tl_lod_options){.budget = 6000};
        tl_lod_options other = options;
        other.selector = TL_SELECTOR_ROAM;
        tl_mesh *a = select_view(&w, &view, &options, NULL), *b = select_view(&w, &view, &other, NULL);
        expect_same_triangles(a, b);
        tl_mesh_destroy(a);
        tl_mesh_destroy(b);
        free_world(&w);
    }
}

static void fly(const world *w, const tl_lod_options *options, uint32_t *seed, uint64_t *again, uint64_t *nothing)
{
    tl_error error;
    tl_roam *roam = tl_roam_create(w->field, w->dem, w->pyramid, options, &error);
    assert_non_null(roam);
    tl_view view = view_over(w, 40, -25, 250);
    for (int frame = 0; frame < 25; frame++) {
        tl_lod_stats kept, fresh;
        tl_mesh *a = NULL, *b = NULL;
        assert_int_equal(tl_roam_look(roam, &view, &kept, &error), TL_OK);
        assert_int_equal(tl_roam_mesh(roam, &a, &error), TL_OK);
        b = select_view(w, &view, options, &fresh);
        expect_same_bytes(a, b);
        expect_no_cracks(a);
        assert_int_equal(kept.triangles, a->triangle_count);
        *again += frame ? kept.visited : 0;
        *nothing += frame ? fresh.visited : 0;
        tl_mesh_destroy(a);
        tl_mesh_destroy(b);
        view.eye[0] += uniform(seed, 0, .05);
        view.eye[1] += uniform(seed, -.02, .02);
        view.heading += uniform(seed, -.1, .3);
        if (frame % 10 == 9) { /* a cut, or another lens */
            view.heading = uniform(seed, 0, 360);
            view.fov = frame == 19 ? 40 : view.fov;
        }
    }
    tl_roam_destroy(roam);
}

static void flightsEqualFreshStarts(void **state)
{
    (void)state;
    uint32_t seed = 29;
    uint64_t again = 0, nothing = 0;
    for (int kind = 0; kind < VOID_KINDS; kind++) {
        world w = make_world(66, 51, 3, kind, 10, 7);
        const tl_lod_options options[] = {
            {.selector = TL_SELECTOR_ROAM, .pixel_error = 6},
            {.selector = TL_SELECTOR_ROAM, .pixel_error = 9, .morph = true},
            {.selector = TL_SELECTOR_ROAM, .pixel_error = 3, .max_level_given = true, .max_level = 1}};
        for (size_t k = 0; k < sizeof options / sizeof *options; k++)
            fly(&w, &options[k], &seed, &again, &nothing);
        free_world(&w);
    }
    assert_true(2 * again < nothing); /* that is what it is for */
}

static void flightsKeepBudgets(void **state)
{
    (void)state;
    uint32_t seed = 31;
    uint64_t again = 0, nothing = 0;
    world w = make_world(66, 51, 3, VOIDS_FEW, 10, 7);
    tl_lod_options options = {.selector = TL_SELECTOR_ROAM, .budget = 5000};
    fly(&w, &options, &seed, &again, &nothing);
    free_world(&w);
}

static void budgetsAreKept(void **state)
{
    (void)state;
    world w = make_world(65, 65, 3, VOIDS_NONE, 10, 3);
    tl_view view = view_over(&w, 30, -30, 250);
    for (int selector = 0; selector < 3; selector++)
        for (uint64_t budget = selector == TL_SELECTOR_CHUNK ? 3200 : 800; budget <= 12800; budget *= 2) {
            tl_lod_options options = {.selector = (tl_selector)selector, .budget = budget};
            tl_mesh *mesh = select_view(&w, &view, &options, NULL);
            assert_true(mesh->triangle_count <= budget);
            if (selector != TL_SELECTOR_CHUNK) /* where steps of pixel error are 1 %, and triangles go with them */
                assert_true(mesh->triangle_count * 10 >= budget * 8);
            tl_mesh_destroy(mesh);
        }
    free_world(&w);
}

static void budgetsBelowTheCoarsestAreRefused(void **state)
{
    (void)state;
    tl_error error;
    world w = make_world(40, 40, 1, VOIDS_MANY, 10, 3);
    tl_view view = view_over(&w, 0, -60, 400);
    for (int selector = 0; selector < 3; selector++) {
        tl_lod_options options = {.selector = (tl_selector)selector, .budget = 2, .keep = 15};
        tl_mesh *mesh = NULL;
        assert_int_equal(tl_select(w.field, w.dem, w.pyramid, &view, &options, &mesh, NULL, &error), TL_ERROR_ARGUMENT);
        assert_non_null(strstr(error.text, "budget"));
        assert_null(mesh);
    }
    free_world(&w);
}

/* The search ends where no smaller error adds anything: some octaves of errors below its start, not all that there are.
 */
static void budgetsBeyondAllDetailTakeIt(void **state)
{
    (void)state;
    tl_error error;
    world w = make_world(40, 40, 1, VOIDS_MANY, 10, 3);
    tl_view view = view_over(&w, 0, -60, 400);
    for (int selector = 0; selector < 3; selector++) {
        tl_lod_options all = {.selector = (tl_selector)selector, .pixel_error = 1e-9, .keep = 15};
        tl_lod_options much = {.selector = (tl_selector)selector, .budget = UINT64_C(1) << 31, .keep = 15};
        tl_lod_stats of_all, of_much;
        tl_mesh *mesh = NULL;
        assert_int_equal(tl_select(w.field, w.dem, w.pyramid, &view, &all, &mesh, &of_all, &error), TL_OK);
        tl_mesh_destroy(mesh);
        assert_int_equal(tl_select(w.field, w.dem, w.pyramid, &view, &much, &mesh, &of_much, &error), TL_OK);
        tl_mesh_destroy(mesh);
        assert_int_equal(of_much.triangles, of_all.triangles);
        assert_true(of_much.visited <= 12 * of_all.visited);
    }
    free_world(&w);
}

/* ---- Culling ---- */

static bool has_triangle(const corners *all, size_t count, const corners *one)
{
    return bsearch(one, all, count, sizeof *all, by_corners) != NULL;
}

/* Whether a place is on the screen. */
static bool on_screen(const scene_view *view, uint64_t place, int levels, const tl_mesh *m)
{
    const scene_camera *c = scene_view_camera(view);
    int32_t x = (int32_t)(place >> 32), y = (int32_t)place;
    double i = ldexp(x, -levels), j = ldexp(y, -levels), at[1][3], out[3];
    for (size_t k = 0; k < m->vertex_count; k++)
        if (m->vertices[k].i == x && m->vertices[k].j == y) {
            scene_view_place(view, 1, &i, &j, &m->vertices[k].z, at);
            break;
        }
    scene_camera_view(c, at[0], out);
    return out[2] > 0 && fabs(out[0]) < .5 * c->width * out[2] && fabs(out[1]) < .5 * c->height * out[2];
}

/* What a picture of `view` shows: at the middle of each pixel the triangle that is seen, and how near. */
static scene_hit *look_at_mesh(const tl_mesh *m, const tl_source *dem, const scene_view *view)
{
    tl_error error = {0};
    const scene_camera *c = scene_view_camera(view);
    const scene_stage_options options = {.samples = 1, .exaggeration = 1};
    scene_stage *stage = scene_stage_create(m, dem, view, &options, &error);
    scene_hit *hits = malloc((size_t)(c->width * c->height) * sizeof *hits);
    scene_canvas canvas = {.hits = malloc(scene_stage_band_hits(stage) * sizeof *hits)};
    for (int band = 0, row = 0; band < scene_stage_bands(stage); band++, row += canvas.height) {
        scene_stage_draw(stage, band, &canvas);
        memcpy(hits + row * canvas.width, canvas.hits, (size_t)(canvas.width * canvas.height) * sizeof *hits);
    }
    free(canvas.hits);
    scene_stage_destroy(stage);
    return hits;
}

static void expect_same_picture(const tl_mesh *a, const tl_mesh *b, const tl_source *dem, const scene_view *view)
{
    const scene_camera *c = scene_view_camera(view);
    scene_hit *one = look_at_mesh(a, dem, view), *two = look_at_mesh(b, dem, view);
    for (size_t k = 0; k < (size_t)(c->width * c->height); k++) {
        assert_memory_equal(&one[k].nearness, &two[k].nearness, sizeof one->nearness);
        if (one[k].nearness > 0) {
            corners at = triangle_of(a, one[k].triangle), there = triangle_of(b, two[k].triangle);
            assert_memory_equal(&at, &there, sizeof at);
        }
    }
    free(one);
    free(two);
}

/* Every triangle that is drawn with all rules is drawn, as it is, without some; what is drawn more without that of the
 * frustum has no corner on the screen; and the pictures are the same. */
static void look_without_rules(int round, uint32_t seed, size_t *drawn, size_t *more)
{
    tl_error error;
    world w = random_world(12, 50, round % 3, round % 7 ? round % VOIDS_ALL : VOIDS_NONE, &seed);
    tl_view view = random_view(&w, &seed);
    view.fov = 60;
    scene_view *from = scene_view_create(&view, w.dem, &error);
    tl_lod_options all = {.selector = (tl_selector)(round / 2 % 3), .pixel_error = exp(uniform(&seed, 1, 5))},
                   kept = all;
    kept.keep = round % 2 ? (unsigned)TL_CULL_FRUSTUM : 1 + next_random(&seed) % 15;
    tl_mesh *a = select_view(&w, &view, &all, NULL), *b = select_view(&w, &view, &kept, NULL);
    corners *one = corners_of(a), *two = corners_of(b);
    for (size_t t = 0; t < a->triangle_count; t++)
        if (!has_triangle(two, b->triangle_count, &one[t]))
            fail_msg("round %d: triangle %zu of %zu is drawn otherwise", round, t, a->triangle_count);
    for (size_t t = 0; t < b->triangle_count && kept.keep == TL_CULL_FRUSTUM; t += 1 + b->triangle_count / 300)
        if (!has_triangle(one, a->triangle_count, &two[t]))
            for (int k = 0; k < 3; k++, ++*more)
                assert_false(on_screen(from, two[t].at[k], w.levels, b));
    scene_view_destroy(from);
    view.width /= 4, view.height /= 4;
    from = scene_view_create(&view, w.dem, &error);
    expect_same_picture(a, b, w.dem, from);
    expect_no_cracks(b);
    *drawn += a->triangle_count;
    free(one);
    free(two);
    tl_mesh_destroy(a);
    tl_mesh_destroy(b);
    scene_view_destroy(from);
    free_world(&w);
}

static void cullingChangesNothingSeen(void **state)
{
    (void)state;
    size_t drawn = 0, more = 0;
    for (int round = 0; round < 336; round++)
        look_without_rules(round, 41 + 7919U * (uint32_t)round, &drawn, &more);
    assert_true(drawn > 100000 && more > 10000);
}

/* A sixth of all directions is on a screen of 60 degrees, and what is under the eye is not. Blocks of the model count
 * as a whole, so they are small here beside what is seen; and towards a corner more than a sixth of a square is seen.
 */
static void culledGroundIsNotMadeNorRead(void **state)
{
    (void)state;
    uint32_t seed = 43;
    world w = make_world(2049, 2049, 3, VOIDS_NONE, 10, 3);
    w.dem->info.block_width = w.dem->info.block_height = 64;
    for (int round = 0; round < 4; round++) {
        tl_view view = view_over(&w, 90 * round + uniform(&seed, -15, 15), -5, 150);
        view.eye[0] = uniform(&seed, 960, 1090);
        view.eye[1] = -uniform(&seed, 960, 1090);
        view.fov = 60;
        tl_lod_options all = {.pixel_error = 3}, kept = {.pixel_error = 3, .keep = 15};
        tl_lod_stats a, b;
        tl_mesh_destroy(select_view(&w, &view, &all, &a));
        tl_mesh_destroy(select_view(&w, &view, &kept, &b));
        assert_true(a.samples_made > 0 && 4 * a.samples_made <= b.samples_made);
        assert_true(4 * a.tiles_made <= b.tiles_made && 4 * a.dem_samples <= b.dem_samples);
        assert_true(a.dem_blocks > 0 && 4 * a.dem_blocks <= b.dem_blocks);
        assert_true(a.culled[0] > 0 && a.culled[3] > 0);
    }
    free_world(&w);
}

/* ---- Depth ---- */

static void finerPixelErrorsContainCoarserOnes(void **state)
{
    (void)state;
    world w = make_world(65, 65, 3, VOIDS_FEW, 10, 3);
    tl_view view = view_over(&w, 200, -30, 250);
    uint64_t *before = NULL;
    size_t count = 0;
    for (double pixels = 64; pixels > .5; pixels /= 4) {
        tl_lod_options options = {.pixel_error = pixels, .keep = 15}; /* else a corner may come to be hidden */
        tl_lod_stats stats;
        tl_mesh *mesh = select_view(&w, &view, &options, &stats);
        uint64_t *places = places_of(mesh);
        for (size_t k = 0; k < count; k++)
            assert_non_null(bsearch(&before[k], places, mesh->vertex_count, sizeof *places, by_number));
        assert_true(mesh->vertex_count > count);
        free(before);
        before = places;
        count = mesh->vertex_count;
        tl_mesh_destroy(mesh);
    }
    free(before);
    free_world(&w);
}

static void maxLevelIsNotPassed(void **state)
{
    (void)state;
    world w = make_world(65, 65, 4, VOIDS_NONE, 10, 3);
    tl_view view = view_over(&w, 200, -30, 250);
    for (int selector = 0; selector < 3; selector++)
        for (int level = -4; level <= 3; level++) {
            tl_lod_options options = {
                .selector = (tl_selector)selector, .pixel_error = 1e-6, .max_level_given = true, .max_level = level};
            tl_lod_stats stats;
            tl_mesh *mesh = select_view(&w, &view, &options, &stats);
            int step = level < 0 ? 16 << -level : 16 >> level;
            for (size_t k = 0; k < mesh->vertex_count; k++)
                assert_true(mesh->vertices[k].i % step == 0 && mesh->vertices[k].j % step == 0);
            assert_true(mesh->triangle_count > 0 && stats.finest_level <= level);
            tl_mesh_destroy(mesh);
        }
    free_world(&w);
}

/* Within each band no edge is longer than the diagonal of its cells, measured to the nearest place of the triangle. */
static void bandsSetTheCells(void **state)
{
    (void)state;
    world w = make_world(65, 65, 3, VOIDS_NONE, 10, 3);
    tl_view view = view_over(&w, 200, -30, 250);
    const double bands[] = {260, 320, 420};
    for (int selector = 0; selector < 3; selector++) {
        tl_lod_options options = {
            .selector = (tl_selector)selector, .band_count = 3, .bands = {bands[0], bands[1], bands[2]}, .keep = 15};
        tl_mesh *mesh = select_view(&w, &view, &options, NULL);
        size_t finest = 0, coarse = 0;
        for (size_t t = 0; t < mesh->triangle_count; t++) {
            double far = 0;
            int32_t side = 0;
            for (int k = 0; k < 3; k++) {
                const tl_vertex *v = &mesh->vertices[mesh->indices[3 * t + (size_t)k]],
                                *u = &mesh->vertices[mesh->indices[3 * t + (size_t)(k + 1) % 3]];
                double x = (v->i / 8. - view.eye[0]) * 10, y = (v->j / 8. + view.eye[1]) * 10;
                far = fmax(far, sqrt(x * x + y * y + ((double)v->z - view.eye[2]) * ((double)v->z - view.eye[2])));
                side = (int32_t)fmax(side, fmax(abs(v->i - u->i), abs(v->j - u->j)));
            }
            for (int k = 0; k < 3; k++)
                if (far <= bands[k])
                    assert_true(side <= 1 << k);
            finest += side == 1;
            coarse += side > 4;
        }
        assert_true(finest > 0 && (coarse > 0 || selector == TL_SELECTOR_CHUNK)); /* which has no small squares */
        expect_no_cracks(mesh);
        tl_mesh_destroy(mesh);
    }
    free_world(&w);
}

/* ---- Extremes ---- */

static void expect_some_end(world *w, const tl_view *view, tl_lod_options options)
{
    for (int selector = 0; selector < 3; selector++) {
        tl_error error = {0};
        tl_mesh *mesh = NULL;
        options.selector = (tl_selector)selector;
        tl_status status = tl_select(w->field, w->dem, w->pyramid, view, &options, &mesh, NULL, &error);
        if (status == TL_OK) {
            expect_no_cracks(mesh);
            if (!options.morph)
                expect_sound(w, mesh);
            for (size_t k = 0; k < mesh->vertex_count; k++)
                assert_true(isfinite((double)mesh->vertices[k].z));
            assert_true(!options.budget || mesh->triangle_count <= options.budget);
        } else
            assert_true(error.text[0]);
        tl_mesh_destroy(mesh);
    }
}

static void extremeViewsEndWell(void **state)
{
    (void)state;
    world w = make_world(33, 33, 2, VOIDS_NONE, 10, 3);
    const tl_lod_options usual = {.pixel_error = 4};
    const double heights[] = {-1000, -100, 0, 100, 1e5, 1e9};
    for (size_t k = 0; k < sizeof heights / sizeof *heights; k++)
        for (double pitch = -90; pitch <= 90; pitch += 45) {
            tl_view view = view_over(&w, 10, pitch, heights[k]);
            expect_some_end(&w, &view, usual);
        }
    tl_view on_it = view_over(&w, 10, 0, 0);
    on_it.above_ground = true;
    expect_some_end(&w, &on_it, usual);
    const double fovs[] = {.01, 179};
    for (int k = 0; k < 2; k++) {
        tl_view view = view_over(&w, 10, -40, 300);
        view.fov = fovs[k];
        expect_some_end(&w, &view, usual);
        view.width = view.height = 1;
        expect_some_end(&w, &view, usual);
    }
    tl_view view = view_over(&w, 10, -40, 300);
    expect_some_end(&w, &view, (tl_lod_options){.pixel_error = 1e-6, .max_level_given = true, .max_level = 1});
    expect_some_end(&w, &view, (tl_lod_options){.pixel_error = 1e6});
    expect_some_end(&w, &view, (tl_lod_options){.budget = 2});
    expect_some_end(&w, &view, (tl_lod_options){.budget = UINT64_C(1) << 31});
    free_world(&w);
}

static void smallRastersEndWell(void **state)
{
    (void)state;
    const int sizes[][2] = {{1, 1}, {1, 9}, {9, 1}, {2, 2}, {2, 9}, {3, 2}};
    for (size_t k = 0; k < sizeof sizes / sizeof *sizes; k++)
        for (int kind = 0; kind < VOID_KINDS; kind++) {
            world w = make_world(sizes[k][0], sizes[k][1], 2, kind, 10, 3);
            tl_view view = view_over(&w, 10, -90, 200);
            expect_some_end(&w, &view, (tl_lod_options){.pixel_error = 1});
            if (kind == VOIDS_NONE && sizes[k][0] > 1 && sizes[k][1] > 1) {
                tl_mesh *mesh = select_view(&w, &view, &(tl_lod_options){.pixel_error = 1e-3}, NULL);
                assert_int_equal(mesh->triangle_count, 2 * 16 * (sizes[k][0] - 1) * (sizes[k][1] - 1));
                tl_mesh_destroy(mesh);
            }
            free_world(&w);
        }
}

/* Each extreme view over each extreme model, with options that are extreme, too. */
static void extremeViewsOfExtremeModelsEndWell(void **state)
{
    (void)state;
    const int sizes[][2] = {{1, 1}, {1, 9}, {9, 1}, {9, 9}, {17, 12}};
    const int kinds[] = {VOIDS_NONE, VOIDS_CHECKERS, VOIDS_ALL, VOIDS_FEW};
    const double heights[] = {-100, 0, 30, 1e9}, fovs[] = {.01, 60, 179};
    const tl_lod_options options[] = {{.pixel_error = 1e-6},
                                      {.pixel_error = 1e6},
                                      {.budget = 2},
                                      {.budget = UINT64_C(1) << 31},
                                      {.pixel_error = 3, .morph = true},
                                      {.budget = 300, .morph = true}};
    for (int n = 0; n < 5 * 4; n++) {
        world w = make_world(sizes[n / 4][0], sizes[n / 4][1], 1, kinds[n % 4], 10, 3);
        for (int v = 0; v < 4 * 3; v++)
            for (int o = 0; o < 6; o++) {
                tl_view view = view_over(&w, 10, v % 2 ? -90 : -5, heights[v / 3]);
                view.fov = fovs[v % 3];
                expect_some_end(&w, &view, options[o]);
            }
        free_world(&w);
    }
}

static void eyesUnderTheGroundAreTold(void **state)
{
    (void)state;
    tl_error error;
    for (int kind = VOIDS_NONE; kind < VOID_KINDS; kind += VOIDS_ALL) {
        world w = make_world(33, 33, 2, kind, 10, 3);
        tl_view view = view_over(&w, 10, -40, -200);
        tl_lod_stats stats, flown;
        tl_mesh_destroy(select_view(&w, &view, NULL, &stats));
        tl_roam *roam = tl_roam_create(w.field, w.dem, w.pyramid, NULL, &error);
        assert_int_equal(tl_roam_look(roam, &view, &flown, &error), TL_OK);
        if (kind == VOIDS_NONE) {
            assert_true(stats.above_ground < -100 && stats.above_ground > -310);
            assert_true(fabs(flown.above_ground - stats.above_ground) < 1e-9);
        } else
            assert_true(isnan(stats.above_ground) && isnan(flown.above_ground));
        tl_roam_destroy(roam);
        free_world(&w);
    }
}

/* Views that each fit the memory, in a flight that leaves more behind than fits. */
static void flightsForgetWhatMemoryDoesNotHold(void **state)
{
    (void)state;
    tl_error error;
    world w = make_world(1025, 1025, 3, VOIDS_NONE, 10, 3);
    tl_run run = {.memory = 26 << 20};
    const tl_lod_options options = {.selector = TL_SELECTOR_ROAM, .pixel_error = 3, .run = &run};
    tl_roam *roam = tl_roam_create(w.field, w.dem, w.pyramid, &options, &error);
    assert_non_null(roam);
    for (int frame = 0; frame < 8; frame++) {
        tl_view view = view_over(&w, 45 * frame, -15, 150);
        tl_mesh *kept = NULL, *fresh = select_view(&w, &view, &options, NULL);
        if (tl_roam_look(roam, &view, NULL, &error) != TL_OK || tl_roam_mesh(roam, &kept, &error) != TL_OK)
            fail_msg("%s", error.text);
        expect_same_bytes(kept, fresh);
        tl_mesh_destroy(kept);
        tl_mesh_destroy(fresh);
    }
    tl_roam_destroy(roam);
    free_world(&w);
}

static void memoryIsKept(void **state)
{
    (void)state;
    tl_error error = {0};
    tl_mesh *mesh = NULL;
    world w = make_world(65, 65, 4, VOIDS_NONE, 10, 3);
    tl_view view = view_over(&w, 10, -40, 300);
    tl_run run = {.memory = 1 << 19};
    tl_lod_options options = {.pixel_error = 1e-3, .run = &run};
    assert_int_equal(tl_select(w.field, w.dem, w.pyramid, &view, &options, &mesh, NULL, &error), TL_ERROR_MEMORY);
    assert_non_null(strstr(error.text, "memory"));
    assert_null(mesh);
    free_world(&w);
}

static void refusesWhatItCannotTake(void **state)
{
    (void)state;
    tl_error error;
    tl_mesh *mesh = NULL;
    world w = make_world(20, 20, 2, VOIDS_NONE, 10, 3);
    tl_view view = view_over(&w, 10, -40, 300);
    const tl_field_options bad[] = {{.levels = 2, .support = TL_SUPPORT_AREA},
                                    {.levels = 2, .support = TL_SUPPORT_POINT, .scheme = "successive"}};
    for (size_t k = 0; k < sizeof bad / sizeof *bad; k++) {
        tl_source *field = tl_field_create(w.dem, &bad[k], &error);
        assert_non_null(field);
        assert_int_equal(tl_select(field, w.dem, w.pyramid, &view, NULL, &mesh, NULL, &error), TL_ERROR_ARGUMENT);
        assert_non_null(strstr(error.text, "points"));
        tl_source_destroy(field);
    }
    assert_int_equal(tl_select(w.dem, w.dem, w.pyramid, &view, NULL, &mesh, NULL, &error), TL_ERROR_ARGUMENT);
    const tl_lod_options wrong[] = {{.pixel_error = -1},
                                    {.pixel_error = (double)NAN},
                                    {.pixel_error = (double)INFINITY},
                                    {.band_count = 2, .bands = {5, 5}},
                                    {.band_count = 1, .bands = {(double)NAN}},
                                    {.band_count = 1, .bands = {5}, .budget = 100}};
    for (size_t k = 0; k < sizeof wrong / sizeof *wrong; k++)
        assert_int_equal(tl_select(w.field, w.dem, w.pyramid, &view, &wrong[k], &mesh, NULL, &error),
                         TL_ERROR_ARGUMENT);
    assert_null(mesh);
    free_world(&w);
}

static void threadsChangeNoByte(void **state)
{
    (void)state;
    world w = make_world(90, 70, 3, VOIDS_FEW, 10, 3);
    tl_view view = view_over(&w, 10, -40, 300);
    for (int selector = 0; selector < 3; selector++) {
        tl_run one = {.threads = 1}, many = {.threads = 5};
        tl_lod_options a = {.selector = (tl_selector)selector, .pixel_error = 2, .run = &one}, b = a;
        b.run = &many;
        tl_mesh *first = select_view(&w, &view, &a, NULL), *second = select_view(&w, &view, &b, NULL);
        expect_same_bytes(first, second);
        tl_mesh_destroy(first);
        tl_mesh_destroy(second);
    }
    free_world(&w);
}

/* ---- Morphing ---- */

static const tl_vertex *vertex_at(const tl_mesh *m, int32_t i, int32_t j)
{
    for (size_t k = 0; k < m->vertex_count; k++)
        if (m->vertices[k].i == i && m->vertices[k].j == j)
            return &m->vertices[k];
    return NULL;
}

/* Without its finest vertices a surface is that of a level less; there the parents' heights lie on it. */
static void parentsLieOnTheCoarserSurface(void **state)
{
    (void)state;
    tl_error error;
    world w = make_world(17, 17, 2, VOIDS_NONE, 10, 3);
    tl_view view = view_over(&w, 0, -60, 300);
    tl_lod_options options = {.pixel_error = 1e-6, .keep = 15};
    tl_mesh *mesh = select_view(&w, &view, &options, NULL);
    float *parents = malloc(mesh->vertex_count * sizeof *parents);
    assert_int_equal(tl_mesh_parent_heights(mesh, parents, &error), TL_OK);
    size_t moved = 0;
    for (size_t k = 0; k < mesh->vertex_count; k++) {
        const tl_vertex *v = &mesh->vertices[k];
        bool across = (v->i & 1) && !(v->j & 1), down = !(v->i & 1) && (v->j & 1);
        if (across || down) { /* a finest edge point, between the ends of a side */
            const tl_vertex *a = vertex_at(mesh, v->i - across, v->j - down),
                            *b = vertex_at(mesh, v->i + across, v->j + down);
            assert_true(parents[k] == (float)(.5 * ((double)a->z + (double)b->z)));
        } else if (v->i & 1) { /* a centre: the diagonal falls where its square's column plus row is even */
            int rise = ((v->i - 1) / 2 + (v->j - 1) / 2) & 1 ? -1 : 1;
            const tl_vertex *a = vertex_at(mesh, v->i - 1, v->j - rise), *b = vertex_at(mesh, v->i + 1, v->j + rise);
            assert_true(parents[k] == (float)(.5 * ((double)a->z + (double)b->z)));
        }
        moved += parents[k] != v->z;
    }
    assert_true(moved > mesh->vertex_count / 2);
    free(parents);
    tl_mesh_destroy(mesh);
    free_world(&w);
}

/* ---- Paths ---- */

static void pathsPassTheirKeys(void **state)
{
    (void)state;
    tl_error error;
    tl_view views[9];
    tl_view_key keys[3] = {{.time = 0, .view = {.eye = {179.9, 10, 500}, .heading = 350, .pitch = -5, .fov = 50}},
                           {.time = 1, .view = {.eye = {-179.9, 11, 700}, .heading = 10, .pitch = -15, .fov = 60}},
                           {.time = 2, .view = {.eye = {-179.7, 12, 600}, .heading = 40, .pitch = -10, .fov = 70}}};
    assert_int_equal(tl_view_path_sample(keys, 3, 9, views, &error), TL_OK);
    for (int k = 0; k < 3; k++) {
        double turns = (views[4 * k].eye[0] - keys[k].view.eye[0]) / 360,
               heading = (views[4 * k].heading - keys[k].view.heading) / 360;
        assert_true(fabs(turns - round(turns)) < 1e-12 && fabs(heading - round(heading)) < 1e-12);
        assert_true(fabs(views[4 * k].eye[2] - keys[k].view.eye[2]) < 1e-9);
    }
    for (int f = 1; f < 9; f++) { /* the short way around */
        assert_true(fabs(views[f].eye[0] - views[f - 1].eye[0]) < .2);
        assert_true(fabs(views[f].heading - views[f - 1].heading) < 15);
    }
}

static void pathsWithoutTimesHaveOneSpeed(void **state)
{
    (void)state;
    enum { FRAMES = 200 };
    tl_error error;
    tl_view views[FRAMES];
    tl_view_key keys[4];
    const double x[4] = {0, 10, 400, 420}, y[4] = {0, 30, 0, 300};
    for (int k = 0; k < 4; k++)
        keys[k] = (tl_view_key){.time = (double)NAN, .view = {.eye = {x[k], y[k], 100}, .projected = true}};
    assert_int_equal(tl_view_path_sample(keys, 4, FRAMES, views, &error), TL_OK);
    double least = HUGE_VAL, most = 0;
    for (int f = 1; f < FRAMES; f++) {
        double step = hypot(views[f].eye[0] - views[f - 1].eye[0], views[f].eye[1] - views[f - 1].eye[1]);
        least = fmin(least, step);
        most = fmax(most, step);
    }
    /* the way is summed up over chords of 1/64 of a key's; the curve turns by at most a few degrees in one */
    assert_true(most < 1.03 * least);
    keys[2].view.above_ground = true;
    assert_int_equal(tl_view_path_sample(keys, 4, FRAMES, views, &error), TL_ERROR_ARGUMENT);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(noCracksAnywhere),
        cmocka_unit_test(voidsAreThoseOfTheFramework),
        cmocka_unit_test(roamFindsWhatQuadtreeFinds),
        cmocka_unit_test(flightsEqualFreshStarts),
        cmocka_unit_test(flightsKeepBudgets),
        cmocka_unit_test(budgetsAreKept),
        cmocka_unit_test(budgetsBelowTheCoarsestAreRefused),
        cmocka_unit_test(budgetsBeyondAllDetailTakeIt),
        cmocka_unit_test(cullingChangesNothingSeen),
        cmocka_unit_test(culledGroundIsNotMadeNorRead),
        cmocka_unit_test(finerPixelErrorsContainCoarserOnes),
        cmocka_unit_test(maxLevelIsNotPassed),
        cmocka_unit_test(bandsSetTheCells),
        cmocka_unit_test(extremeViewsEndWell),
        cmocka_unit_test(smallRastersEndWell),
        cmocka_unit_test(extremeViewsOfExtremeModelsEndWell),
        cmocka_unit_test(eyesUnderTheGroundAreTold),
        cmocka_unit_test(flightsForgetWhatMemoryDoesNotHold),
        cmocka_unit_test(memoryIsKept),
        cmocka_unit_test(refusesWhatItCannotTake),
        cmocka_unit_test(threadsChangeNoByte),
        cmocka_unit_test(parentsLieOnTheCoarserSurface),
        cmocka_unit_test(pathsPassTheirKeys),
        cmocka_unit_test(pathsWithoutTimesHaveOneSpeed),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
