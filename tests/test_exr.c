/* EXRs of several channels and of half floats, read back by OpenEXR itself. */
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/talus.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>

#include <cmocka.h>
#include <openexr.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { WIDTH = 300, HEIGHT = 270, TILE = 256 };

typedef struct bench {
    float *heights;
    tl_source *source;
    char one[64], other[64];
} bench;

static int setUp(void **state)
{
    bench *b = calloc(1, sizeof *b);
    b->heights = tl_alloc_grid(WIDTH, HEIGHT, sizeof *b->heights);
    for (int k = 0; k < WIDTH * HEIGHT; k++)
        b->heights[k] =
            k % 997 == 5 ? NAN : (float)(300 + 200 * sin(k % WIDTH * .03) * cos(k / WIDTH * .02) + k % 13 * .1);
    const tl_source_info info = {.width = WIDTH,
                                 .height = HEIGHT,
                                 .georef = {.located = true,
                                            .transform = {400015, 30, 0, 3999985, 0, -30},
                                            .cell_x = 30,
                                            .cell_y = 30,
                                            .height_unit = 1},
                                 .has_voids = true,
                                 .name = "steps"};
    b->source = tl_array_source_create(b->heights, &info, NULL);
    snprintf(b->one, sizeof b->one, "exr-%ld.exr", (long)getpid());
    snprintf(b->other, sizeof b->other, "exr-%ld-2.exr", (long)getpid());
    *state = b;
    return 0;
}

static int tearDown(void **state)
{
    bench *b = *state;
    unlink(b->one);
    unlink(b->other);
    tl_source_destroy(b->source);
    free(b->heights);
    free(b);
    return 0;
}

/* One tile's values of a channel; false where there is no such channel. */
static bool read_tile(exr_context_t file, int x, int y, const char *name, float *tile, exr_chunk_info_t *chunk)
{
    exr_decode_pipeline_t pipeline = EXR_DECODE_PIPELINE_INITIALIZER;
    bool found = false;
    assert_int_equal(exr_read_tile_chunk_info(file, 0, x, y, 0, 0, chunk), EXR_ERR_SUCCESS);
    assert_int_equal(exr_decoding_initialize(file, 0, chunk, &pipeline), EXR_ERR_SUCCESS);
    for (int c = 0; c < pipeline.channel_count; c++) {
        exr_coding_channel_info_t *channel = &pipeline.channels[c];
        bool asked = strcmp(channel->channel_name, name) == 0;
        found |= asked;
        channel->decode_to_ptr = asked ? (uint8_t *)tile : NULL;
        channel->user_pixel_stride = channel->user_bytes_per_element = sizeof *tile;
        channel->user_line_stride = chunk->width * (int32_t)sizeof *tile;
        channel->user_data_type = EXR_PIXEL_FLOAT;
    }
    assert_int_equal(exr_decoding_choose_default_routines(file, 0, &pipeline), EXR_ERR_SUCCESS);
    assert_int_equal(exr_decoding_run(file, 0, &pipeline), EXR_ERR_SUCCESS);
    exr_decoding_destroy(file, &pipeline);
    return found;
}

/* All of a channel; free it. NULL where there is none. */
static float *read_channel(const char *path, const char *name)
{
    static float tile[TILE * TILE];
    exr_context_t file;
    exr_context_initializer_t start = EXR_DEFAULT_CONTEXT_INITIALIZER;
    float *out = tl_alloc_grid(WIDTH, HEIGHT, sizeof *out);
    bool found = true;
    assert_int_equal(exr_start_read(&file, path, &start), EXR_ERR_SUCCESS);
    for (int y = 0; y < HEIGHT; y += TILE)
        for (int x = 0; x < WIDTH; x += TILE) {
            exr_chunk_info_t chunk;
            found &= read_tile(file, x / TILE, y / TILE, name, tile, &chunk);
            for (int v = 0; v < chunk.height; v++)
                memcpy(out + (y + v) * WIDTH + x, tile + v * chunk.width, (size_t)chunk.width * sizeof *out);
        }
    exr_finish(&file);
    if (found)
        return out;
    free(out);
    return NULL;
}

static void check_channel(const char *a, const char *name_a, const char *b, const char *name_b)
{
    float *one = read_channel(a, name_a), *other = read_channel(b, name_b);
    assert_non_null(one);
    assert_non_null(other);
    assert_memory_equal(one, other, WIDTH * HEIGHT * sizeof *one);
    free(one);
    free(other);
}

static void ok(tl_status status, const tl_error *error)
{
    if (status != TL_OK)
        fail_msg("%s", error->text);
}

static void oneFileHoldsWhatSeveralDo(void **state)
{
    bench *b = *state;
    const char *const kinds[] = {"normal", "slope", "splat"};
    const char *const channels[][4] = {{"R", "G", "B"}, {"Y"}, {"R", "G", "B", "A"}};
    const tl_layer_options options = {.overwrite = true};
    tl_error error;
    for (int south = 0; south < 2; south++) { /* rows from the south are turned */
        b->source->info.georef.transform[5] = south ? 30 : -30;
        ok(tl_write_layers(b->source, NULL, kinds, 3, b->one, &options, &error), &error);
        for (size_t k = 0; k < 3; k++) {
            ok(tl_write_layer(b->source, kinds[k], b->other, &options, &error), &error);
            for (size_t c = 0; c < 4 && channels[k][c]; c++) {
                char name[32];
                snprintf(name, sizeof name, "%s.%s", kinds[k], channels[k][c]);
                check_channel(b->one, name, b->other, channels[k][c]);
            }
        }
        ok(tl_write_grid(b->source, b->other, &(tl_write_options){.overwrite = true}, &error), &error);
        check_channel(b->one, "Y", b->other, "Y");
        tl_source *back = tl_open(b->one, &error); /* our own reader finds the heights among them */
        assert_non_null(back);
        assert_null(back->info.contents);
        float row[WIDTH];
        ok(tl_source_read(back, 0, (tl_window){0, 7, WIDTH, 1}, row, &error), &error);
        assert_memory_equal(row, b->heights + (south ? HEIGHT - 8 : 7) * WIDTH, sizeof row);
        tl_source_destroy(back);
    }
    const char *const twice[] = {"slope", "slope"};
    assert_int_equal(tl_write_layers(b->source, NULL, twice, 2, b->one, &options, &error), TL_ERROR_ARGUMENT);
    assert_int_equal(tl_write_layers(b->source, NULL, kinds, 1, "layers.tif", &options, &error), TL_ERROR_ARGUMENT);
}

static void halfFloatsOnlyWhereTheyAreNear(void **state)
{
    const bench *b = *state;
    tl_error error;
    /* heights of 100 ... 512 lie a quarter apart as half floats, 512 ... 1024 a half */
    tl_write_options options = {.overwrite = true, .half_error = 0.25, .mip = TL_MIP_BOX};
    ok(tl_write_grid(b->source, b->one, &options, &error), &error);
    tl_source *back = tl_open(b->one, &error);
    assert_non_null(back);
    float *heights = tl_alloc_grid(WIDTH, HEIGHT, sizeof *heights);
    ok(tl_source_read(back, 0, (tl_window){0, 0, WIDTH, HEIGHT}, heights, &error), &error);
    double worst = 0;
    for (int k = 0; k < WIDTH * HEIGHT; k++) {
        assert_int_equal(isnan(heights[k]) != 0, isnan(b->heights[k]) != 0);
        if (!isnan(heights[k]))
            worst = fmax(worst, fabs((double)heights[k] - (double)b->heights[k]));
    }
    assert_true(worst > 0.06 && worst <= 0.25);
    free(heights);
    tl_source_destroy(back);
    options.half_error = 0.06;
    assert_int_equal(tl_write_grid(b->source, b->other, &options, &error), TL_ERROR_ARGUMENT);
    assert_non_null(strstr(error.text, "half float"));
    b->heights[0] = 1e5f; /* beyond all half floats */
    options.half_error = 1000;
    assert_int_equal(tl_write_grid(b->source, b->other, &options, &error), TL_ERROR_ARGUMENT);
    assert_int_not_equal(access(b->other, F_OK), 0);
}

static void layersAreNoHeights(void **state)
{
    const bench *b = *state;
    const tl_layer_options options = {.overwrite = true};
    tl_error error;
    ok(tl_write_layer(b->source, "slope", b->one, &options, &error), &error);
    tl_source *slope = tl_open(b->one, &error);
    assert_non_null(slope);
    assert_string_equal(slope->info.contents, "slope");
    tl_source_destroy(slope);
    ok(tl_write_layer(b->source, "normal", b->one, &options, &error), &error);
    assert_null(tl_open(b->one, &error));
    assert_non_null(strstr(error.text, "holds normal, no heights"));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup_teardown(oneFileHoldsWhatSeveralDo, setUp, tearDown),
        cmocka_unit_test_setup_teardown(halfFloatsOnlyWhereTheyAreNear, setUp, tearDown),
        cmocka_unit_test_setup_teardown(layersAreNoHeights, setUp, tearDown),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
