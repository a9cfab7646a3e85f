/* Coarser levels in EXRs. */
#include "lib/base/georef.h"
#include "lib/out/mip.h"

#include <openexr.h>

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

enum { WIDTH = 601, HEIGHT = 303 };

static float height_at(int64_t x, int64_t y)
{
    return (x / 3 + y / 5) % 11 == 0 ? NAN : (float)(x * 7 % 100) + (float)y / 4;
}

static bool same(float a, float b)
{
    return a == b || (isnan(a) && isnan(b));
}

/* What a level has at a sample, straight from the definition. */
static float wanted(tl_mip kind, int level, int64_t width, int64_t height, int64_t x, int64_t y)
{
    if (level == 0)
        return height_at(x, y);
    int64_t w = width, h = height;
    for (int k = 1; k < level; k++) {
        w = (w + 1) / 2;
        h = (h + 1) / 2;
    }
    if (kind == TL_MIP_LATTICE)
        return height_at(x << level, y << level);
    double sum = 0;
    int count = 0;
    for (int k = 0; k < 4; k++) {
        int64_t u = 2 * x + (k & 1), v = 2 * y + (k >> 1);
        float z = u < w && v < h ? wanted(kind, level - 1, width, height, u, v) : NAN;
        if (!isnan(z)) {
            sum += (double)z;
            count++;
        }
    }
    return count ? (float)(sum / count) : NAN;
}

/* The first tile of a level. */
static void read_tile(exr_context_t file, int level, float *out, int32_t *width, int32_t *height)
{
    exr_chunk_info_t chunk;
    exr_decode_pipeline_t pipeline = EXR_DECODE_PIPELINE_INITIALIZER;
    assert_int_equal(exr_get_level_sizes(file, 0, level, level, width, height), EXR_ERR_SUCCESS);
    assert_int_equal(exr_read_tile_chunk_info(file, 0, 0, 0, level, level, &chunk), EXR_ERR_SUCCESS);
    assert_int_equal(exr_decoding_initialize(file, 0, &chunk, &pipeline), EXR_ERR_SUCCESS);
    int32_t columns = *width < 256 ? *width : 256;
    pipeline.channels[0].decode_to_ptr = (uint8_t *)out;
    pipeline.channels[0].user_pixel_stride = sizeof *out;
    pipeline.channels[0].user_line_stride = columns * (int32_t)sizeof *out;
    pipeline.channels[0].user_bytes_per_element = sizeof *out;
    pipeline.channels[0].user_data_type = EXR_PIXEL_FLOAT;
    assert_int_equal(exr_decoding_choose_default_routines(file, 0, &pipeline), EXR_ERR_SUCCESS);
    assert_int_equal(exr_decoding_run(file, 0, &pipeline), EXR_ERR_SUCCESS);
    exr_decoding_destroy(file, &pipeline);
}

static void check_file(const char *path, tl_mip kind)
{
    static float tile[256 * 256];
    exr_context_t file;
    exr_context_initializer_t start = EXR_DEFAULT_CONTEXT_INITIALIZER;
    int32_t levels_x, levels_y, width, height;
    assert_int_equal(exr_start_read(&file, path, &start), EXR_ERR_SUCCESS);
    assert_int_equal(exr_get_tile_levels(file, 0, &levels_x, &levels_y), EXR_ERR_SUCCESS);
    assert_int_equal(levels_x, 11); /* 601, 301, 151, 76, 38, 19, 10, 5, 3, 2, 1 */
    for (int level = 0; level < levels_x; level++) {
        read_tile(file, level, tile, &width, &height);
        int32_t columns = width < 256 ? width : 256, rows = height < 256 ? height : 256;
        for (int32_t y = 0; y < rows; y++)
            for (int32_t x = 0; x < columns; x++)
                if (!same(tile[y * columns + x], wanted(kind, level, WIDTH, HEIGHT, x, y)))
                    fail_msg("level %d at %d, %d", level, x, y);
    }
    assert_int_equal(width, 1);
    assert_int_equal(height, 1);
    exr_finish(&file);
}

static void levelsGoDownToOneSample(void **state)
{
    (void)state;
    static float heights[WIDTH * HEIGHT];
    for (int64_t k = 0; k < WIDTH * HEIGHT; k++)
        heights[k] = height_at(k % WIDTH, k / WIDTH);
    tl_source_info info = {
        .width = WIDTH, .height = HEIGHT, .georef = tl_georef_none(), .name = "steps", .has_voids = true};
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    char path[64];
    snprintf(path, sizeof path, "mip-%ld.exr", (long)getpid());
    for (int kind = TL_MIP_LATTICE; kind <= TL_MIP_BOX; kind++) {
        tl_error error = {0};
        tl_write_options options = {.overwrite = true, .mip = (tl_mip)kind};
        if (tl_write_grid(source, path, &options, &error) != TL_OK)
            fail_msg("%s", error.text);
        check_file(path, (tl_mip)kind);
        tl_source *again = tl_open(path, &error); /* our own reader takes the finest */
        assert_non_null(again);
        float z;
        assert_int_equal(tl_source_read(again, 0, (tl_window){600, 302, 1, 1}, &z, NULL), TL_OK);
        assert_true(same(z, height_at(600, 302)));
        tl_source_destroy(again);
        unlink(path);
    }
    tl_source_destroy(source);
}

/* The same from a file, where memory is short. */
static void levelsGoToDiskBeyondTheMemoryGiven(void **state)
{
    (void)state;
    static float tile[256 * 256], read[256 * 256];
    tl_error error = {0};
    char path[64];
    snprintf(path, sizeof path, "mip-%ld", (long)getpid());
    for (int small = 0; small < 2; small++) {
        out_mip mip;
        const tl_run run = {.memory = small ? 1 << 10 : 1 << 30};
        assert_int_equal(out_mip_init(&mip, TL_MIP_LATTICE, 1, WIDTH, HEIGHT, &run, path, &error), TL_OK);
        assert_int_equal(mip.spool != NULL, small);
        for (int64_t y = 0; y < HEIGHT; y += 256)
            for (int64_t x = 0; x < WIDTH; x += 256) {
                tl_window w = {x, y, WIDTH - x < 256 ? WIDTH - x : 256, HEIGHT - y < 256 ? HEIGHT - y : 256};
                for (int64_t k = 0; k < w.width * w.height; k++)
                    tile[k] = height_at(x + k % w.width, y + k / w.width);
                assert_int_equal(out_mip_add(&mip, 0, w, tile, &error), TL_OK);
            }
        assert_int_equal(out_mip_read(&mip, 1, (tl_window){256, 0, 45, 152}, read, &error), TL_OK);
        for (int64_t k = 0; k < 45 * 152; k++)
            assert_true(same(read[k], height_at(2 * (256 + k % 45), 2 * (k / 45))));
        out_mip_finish(&mip);
        assert_int_not_equal(access(path, F_OK), 0);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(levelsGoDownToOneSample),
        cmocka_unit_test(levelsGoToDiskBeyondTheMemoryGiven),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
