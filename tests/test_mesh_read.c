#define _GNU_SOURCE /* mkdtemp */
#include "dem/crs.h"
#include "lib/base/georef.h"
#include "lib/out/mesh_read.h"
#include "lib/talus.h"

#include <math.h>
#include <proj.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include <cmocka.h>

#include "tests/grids.h"

static char folder[] = "/tmp/talus-test-XXXXXX";
static const char *const endings[] = {"ply", "obj", "glb", "stl"};

static int make_folder(void **state)
{
    (void)state;
    return mkdtemp(folder) ? 0 : -1;
}

static int remove_folder(void **state)
{
    (void)state;
    return rmdir(folder);
}

static const char *path_of(const char *ending)
{
    static char path[64];
    snprintf(path, sizeof path, "%s/mesh.%s", folder, ending);
    return path;
}

static tl_source *open_hills(grid *of, bool holes)
{
    *of = make_grid(60, 40, TERRAIN_EIGHTHS, holes ? VOIDS_FEW : VOIDS_NONE);
    tl_source *source = open_grid(of);
    const double transform[6] = {356000.25, 2, 0, 5699000.5, 0, -3};
    memcpy(source->info.georef.transform, transform, sizeof transform);
    source->info.georef.located = true;
    return source;
}

static tl_mesh *write_coded(const tl_source *source, double max_error, const char *path, tl_frame frame,
                            tl_mesh_coding coding)
{
    tl_framework *framework = tl_framework_build(source, &(tl_framework_options){.max_error = max_error}, NULL);
    tl_mesh *mesh = NULL;
    tl_error error = {0};
    assert_int_equal(tl_framework_mesh(framework, &mesh, NULL), TL_OK);
    tl_write_options options = {.overwrite = true, .frame = frame, .coding = coding};
    if (tl_write_mesh(mesh, path, &options, &error) != TL_OK)
        fail_msg("%s", error.text);
    tl_framework_destroy(framework);
    return mesh;
}

static tl_mesh *write_mesh(const tl_source *source, double max_error, const char *path, tl_frame frame)
{
    return write_coded(source, max_error, path, frame, TL_CODING_PLAIN);
}

/* The file has the error that the mesh has, but for what rounding of its numbers adds. */
static void filesAreAsFarFromTheDemAsTheirMeshes(void **state)
{
    static const tl_frame frames[] = {TL_FRAME_PIXEL, TL_FRAME_PROJECTED};
    (void)state;
    for (int round = 0; round < 16; round++) {
        grid of;
        random_state = (uint64_t)round;
        tl_source *source = open_hills(&of, round & 8);
        const char *path = path_of(endings[round & 3]);
        tl_frame frame = frames[round >> 2 & 1];
        tl_mesh *mesh = write_mesh(source, 3, path, frame);
        tl_mesh_report own, read;
        tl_error error = {0};
        assert_int_equal(tl_mesh_verify(mesh, source, NULL, &own, NULL), TL_OK);
        if (tl_mesh_verify_file(path, mesh, source, NULL, frame, NULL, &read, &error) != TL_OK)
            fail_msg("%s", error.text);
        /* floats of a map's offsets below 256 round by 2^-17, over slopes below 70 in a cell of 2 */
        assert_true(fabs(read.max_error - own.max_error) <= (frame == TL_FRAME_PIXEL ? 0 : 2 * 70 * 0x1p-17));
        assert_int_equal(read.samples, own.samples);
        assert_int_equal(read.uncovered, own.uncovered);
        tl_mesh_destroy(mesh);
        tl_source_destroy(source);
        assert_int_equal(unlink(path), 0);
        free(of.z);
    }
}

/* A vertex that is off in the file, which the mesh in memory does not know. */
static void filesTellWhatMemoryDoesNot(void **state)
{
    grid of;
    (void)state;
    random_state = 3;
    tl_source *source = open_hills(&of, false);
    const char *path = path_of("ply");
    tl_mesh *mesh = write_mesh(source, 1, path, TL_FRAME_PIXEL);
    FILE *file = fopen(path, "r+b");
    char head[8192];
    size_t count = fread(head, 1, sizeof head - 1, file);
    head[count] = 0;
    char *end = strstr(head, "end_header\n");
    assert_non_null(end);
    float z = 1e4f;
    assert_int_equal(fseek(file, end + 11 - head + 12 * 7 + 8, SEEK_SET), 0);
    assert_int_equal(fwrite(&z, sizeof z, 1, file), 1);
    fclose(file);
    tl_mesh_report read;
    assert_int_equal(tl_mesh_verify_file(path, mesh, source, NULL, TL_FRAME_PIXEL, NULL, &read, NULL), TL_OK);
    assert_true(read.max_error > 9000);
    tl_mesh_destroy(mesh);
    tl_source_destroy(source);
    assert_int_equal(unlink(path), 0);
    free(of.z);
}

/* Each sample is held to its own bound: those of a map, and the number where that is void. */
static void samplesAreHeldToTheirOwnBounds(void **state)
{
    grid of, map;
    (void)state;
    random_state = 5;
    tl_source *source = open_hills(&of, false);
    const char *path = path_of("ply");
    tl_mesh *mesh = write_mesh(source, 6, path, TL_FRAME_PIXEL);
    size_t samples = (size_t)of.width * (size_t)of.height;
    map = (grid){of.width, of.height, malloc(samples * sizeof(float))};
    for (size_t k = 0; k < samples; k++)
        map.z[k] = 6;
    tl_source *limits = open_grid(&map);
    tl_selection bounds = {.max_error = 6, .max_error_map = limits};
    tl_mesh_report read;
    assert_int_equal(tl_mesh_verify_file(path, mesh, source, &bounds, TL_FRAME_PIXEL, NULL, &read, NULL), TL_OK);
    assert_int_equal(read.exceeding, 0);
    assert_true(read.max_error > 3);
    double worst = read.max_error;
    int64_t i = read.worst_i, j = read.worst_j;
    map.z[j * of.width + i] = 2;
    assert_int_equal(tl_mesh_verify_file(path, mesh, source, &bounds, TL_FRAME_PIXEL, NULL, &read, NULL), TL_OK);
    assert_int_equal(read.exceeding, 1);
    assert_true(read.max_excess == worst - 2 && read.worst_i == i && read.worst_j == j);
    map.z[j * of.width + i] = NAN;
    assert_int_equal(tl_mesh_verify_file(path, mesh, source, &bounds, TL_FRAME_PIXEL, NULL, &read, NULL), TL_OK);
    assert_int_equal(read.exceeding, 0);
    bounds = (tl_selection){.max_error = 0};
    assert_int_equal(tl_mesh_verify_file(path, mesh, source, &bounds, TL_FRAME_PIXEL, NULL, &read, NULL), TL_OK);
    assert_true(read.exceeding > 100 && read.max_excess == worst);
    tl_source_destroy(limits);
    map.height--;
    limits = open_grid(&map);
    tl_error error;
    bounds.max_error_map = limits;
    assert_int_equal(tl_mesh_verify_file(path, mesh, source, &bounds, TL_FRAME_PIXEL, NULL, &read, &error),
                     TL_ERROR_DATA);
    assert_non_null(strstr(error.text, "give one for each"));
    tl_source_destroy(limits);
    tl_mesh_destroy(mesh);
    tl_source_destroy(source);
    assert_int_equal(unlink(path), 0);
    free(of.z);
    free(map.z);
}

/* Positions in steps are off by what tl_write_rounding says at most; encoding them loses nothing. */
static void stepsAddWhatIsSaid(void **state)
{
    static const tl_frame frames[] = {TL_FRAME_PIXEL, TL_FRAME_PROJECTED};
    (void)state;
    const char *path = path_of("glb");
    for (int round = 0; round < 8; round++) {
        grid of;
        random_state = (uint64_t)round;
        tl_source *source = open_hills(&of, round & 4);
        tl_mesh_report own, read[2];
        tl_error error = {0};
        for (int coding = TL_CODING_QUANTIZED; coding <= TL_CODING_COMPRESSED; coding++) {
            tl_mesh *mesh = write_coded(source, 3, path, frames[round & 1], (tl_mesh_coding)coding);
            assert_int_equal(tl_mesh_verify(mesh, source, NULL, &own, NULL), TL_OK);
            if (tl_mesh_verify_file(path, mesh, source, NULL, frames[round & 1], NULL, &read[coding - 1], &error) !=
                TL_OK)
                fail_msg("%s", error.text);
            tl_mesh_destroy(mesh);
        }
        /* the encoder may turn a triangle's corners, so sums round differently */
        assert_true(fabs(read[0].max_error - read[1].max_error) < 1e-9);
        assert_true(fabs(read[0].rms_error - read[1].rms_error) < 1e-9);
        assert_int_equal(read[1].samples, read[0].samples);
        assert_int_equal(read[0].samples, own.samples);
        assert_true(read[0].max_error != own.max_error); /* they are steps */
        tl_write_options options = {.frame = frames[round & 1], .coding = TL_CODING_QUANTIZED};
        tl_rounding rounding = tl_write_rounding(&source->info, path, &options);
        float low = INFINITY, high = -INFINITY;
        for (int k = 0; k < of.width * of.height; k++) {
            low = fminf(low, of.z[k]);
            high = fmaxf(high, of.z[k]);
        }
        double range = (double)high - (double)low, most = rounding.upright + rounding.of_range * range +
                                                          rounding.along * range * 1.5; /* no steeper than that */
        assert_true(fabs(read[0].max_error - own.max_error) <= most);
        assert_true((rounding.along > 0) == (options.frame == TL_FRAME_PROJECTED));
        tl_source_destroy(source);
        assert_int_equal(unlink(path), 0);
        free(of.z);
    }
}

/* Hills on the ellipsoid, flat ones and steep ones, of narrow cells and wide ones: a mesh that counts the steps keeps
 * its bound by the file's own numbers. */
static void boundsCountTheSteps(void **state)
{
    (void)state;
    const char *path = path_of("glb");
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text("EPSG:32633", "test", &crs, NULL), TL_OK);
    for (int round = 0; round < 6; round++) {
        grid of = {200, 150, malloc(200 * 150 * sizeof(float))};
        double cell = round & 1 ? 900 : 30, high = round < 2 ? 0.02 : round < 4 ? 0.5 : 8;
        for (int k = 0; k < 200 * 150; k++)
            of.z[k] = (float)(cell * high * sin(k % 200 * .3) * cos(k / 200 * .21));
        tl_source *source = open_grid(&of);
        const double transform[6] = {400000, cell, 0, 5100000, 0, -cell};
        memcpy(source->info.georef.transform, transform, sizeof transform);
        source->info.georef.located = true;
        source->info.georef.crs = crs;
        source->info.georef.cell_x = source->info.georef.cell_y = cell;
        tl_write_options writing = {.overwrite = true, .coding = TL_CODING_QUANTIZED};
        tl_framework_options options = {.max_error = cell * high * 0.06,
                                        .rounding = tl_write_rounding(&source->info, path, &writing)};
        tl_framework *framework = tl_framework_build(source, &options, NULL);
        tl_mesh *mesh = NULL;
        tl_mesh_report read;
        tl_error error = {0};
        assert_int_equal(tl_framework_mesh(framework, &mesh, NULL), TL_OK);
        assert_true(mesh->vertex_count < 200 * 150); /* there was something to leave out */
        if (tl_write_mesh(mesh, path, &writing, &error) != TL_OK ||
            tl_mesh_verify_file(path, mesh, source, NULL, TL_FRAME_ENU, NULL, &read, &error) != TL_OK)
            fail_msg("%s", error.text);
        if (!(read.max_error <= options.max_error && read.max_error > options.max_error / 3))
            fail_msg("cells of %g, heights of %g: %g instead of %g", cell, cell * high, read.max_error,
                     options.max_error);
        assert_int_equal(read.samples, 200 * 150);
        tl_mesh_destroy(mesh);
        tl_framework_destroy(framework);
        tl_source_destroy(source);
        free(of.z);
    }
    assert_int_equal(unlink(path), 0);
    tl_crs_release(crs);
}

/* Distance of the file's vertices from where PROJ has those of the mesh, at most; by the nearest, as files order them
 * as they like. */
static double farthest_from_proj(const char *path, const tl_mesh *mesh)
{
    out_mesh_file file;
    assert_int_equal(out_mesh_read(path, &file, NULL), TL_OK);
    PJ *geocentric = proj_create_crs_to_crs(NULL, "EPSG:4979", "EPSG:4978", NULL);
    assert_non_null(geocentric);
    double farthest = 0;
    for (size_t k = 0; k < mesh->vertex_count; k += 97) {
        const tl_vertex *v = &mesh->vertices[k];
        double x = v->i, y = v->j, nearest = HUGE_VAL;
        assert_int_equal(tl_georef_to_lonlat(&mesh->georef, 1, &x, &y, NULL), TL_OK);
        PJ_COORD at = proj_trans(geocentric, PJ_FWD, proj_coord(y, x, (double)v->z, 0));
        for (size_t n = 0; n < file.vertex_count; n++)
            nearest = fmin(nearest,
                           hypot(hypot(file.xyz[n][0] - at.v[0], file.xyz[n][1] - at.v[1]), file.xyz[n][2] - at.v[2]));
        farthest = fmax(farthest, nearest);
    }
    proj_destroy(geocentric);
    out_mesh_free(&file);
    return farthest;
}

/* Every format has them where PROJ has them, and keeps the bound. */
static void geocentricMeshesLieWhereTheyShould(void **state)
{
    (void)state;
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text("EPSG:32633", "test", &crs, NULL), TL_OK);
    for (int kind = 0; kind < 6; kind++) {
        const char *path = path_of(kind < 4 ? endings[kind] : "glb");
        tl_mesh_coding coding = kind < 4 ? TL_CODING_PLAIN : kind == 4 ? TL_CODING_QUANTIZED : TL_CODING_COMPRESSED;
        grid of = {120, 90, malloc(120 * 90 * sizeof(float))};
        for (int k = 0; k < 120 * 90; k++)
            of.z[k] = (float)(900 + 40 * sin(k % 120 * .3) * cos(k / 120 * .21));
        tl_source *source = open_grid(&of);
        const double transform[6] = {400000, 30, 0, 5100000, 0, -30};
        memcpy(source->info.georef.transform, transform, sizeof transform);
        source->info.georef.located = true;
        source->info.georef.crs = crs;
        source->info.georef.cell_x = source->info.georef.cell_y = 30;
        tl_write_options writing = {.overwrite = true, .coding = coding, .frame = TL_FRAME_ECEF};
        tl_framework_options options = {
            .max_error = 2, .frame = TL_FRAME_ECEF, .rounding = tl_write_rounding(&source->info, path, &writing)};
        tl_framework *framework = tl_framework_build(source, &options, NULL);
        tl_mesh *mesh = NULL;
        tl_mesh_report read;
        assert_int_equal(tl_framework_mesh(framework, &mesh, NULL), TL_OK);
        assert_int_equal(tl_write_mesh(mesh, path, &writing, NULL), TL_OK);
        assert_int_equal(tl_mesh_verify_file(path, mesh, source, NULL, TL_FRAME_ECEF, NULL, &read, NULL), TL_OK);
        assert_true(read.max_error <= 2 && read.max_error > 1);
        assert_int_equal(read.samples, 120 * 90);
        /* half a step of 16 bits over 3.6 km, or of single precision; micrometres of text and doubles */
        double off = farthest_from_proj(path, mesh), most = kind >= 4 ? 0.05 : kind >= 2 ? 4e-4 : 2e-6;
        if (!(off <= most))
            fail_msg("%s: %g m from where it should be", path, off);
        tl_mesh_destroy(mesh);
        tl_framework_destroy(framework);
        tl_source_destroy(source);
        free(of.z);
        assert_int_equal(unlink(path), 0);
    }
    tl_crs_release(crs);
}

static size_t load(const char *path, unsigned char **bytes)
{
    FILE *file = fopen(path, "rb");
    assert_non_null(file);
    fseek(file, 0, SEEK_END);
    size_t count = (size_t)ftell(file);
    *bytes = malloc(count + 1);
    rewind(file);
    assert_int_equal(fread(*bytes, 1, count, file), count);
    fclose(file);
    return count;
}

static void store(const char *path, const unsigned char *bytes, size_t count)
{
    FILE *file = fopen(path, "wb");
    assert_non_null(file);
    assert_int_equal(fwrite(bytes, 1, count, file), count);
    assert_int_equal(fclose(file), 0);
}

/* Damaged files are read, or refused by a line that names them; never worse, and never triangles of nothing. */
static void damagedFilesAreRefusedOrRead(void **state)
{
    (void)state;
    for (int kind = 0; kind < 6; kind++) {
        grid of;
        random_state = (uint64_t)kind;
        tl_source *source = open_hills(&of, false);
        const char *path = path_of(kind < 4 ? endings[kind] : "glb");
        tl_mesh_coding coding = kind < 4 ? TL_CODING_PLAIN : kind == 4 ? TL_CODING_QUANTIZED : TL_CODING_COMPRESSED;
        tl_mesh_destroy(write_coded(source, 8, path, TL_FRAME_PROJECTED, coding));
        unsigned char *bytes;
        size_t count = load(path, &bytes), refused = 0;
        for (int round = 0; round < 600; round++) {
            size_t kept = round % 3 ? count : (size_t)(random_bits() % (count + 1));
            size_t at = (size_t)(random_bits() % (round % 2 ? count : 1000 < count ? 1000 : count));
            unsigned char before = bytes[at];
            bytes[at] = (unsigned char)random_bits();
            store(path, bytes, kept);
            bytes[at] = before;
            out_mesh_file file;
            tl_error error = {0};
            if (out_mesh_read(path, &file, &error) != TL_OK) {
                assert_non_null(strstr(error.text, path));
                refused++;
                continue;
            }
            for (size_t k = 0; k < 3 * file.triangle_count; k++)
                assert_true(file.indices[k] < file.vertex_count);
            out_mesh_free(&file);
        }
        assert_true(refused > 50);
        free(bytes);
        tl_source_destroy(source);
        assert_int_equal(unlink(path), 0);
        free(of.z);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(filesAreAsFarFromTheDemAsTheirMeshes),
        cmocka_unit_test(filesTellWhatMemoryDoesNot),
        cmocka_unit_test(samplesAreHeldToTheirOwnBounds),
        cmocka_unit_test(stepsAddWhatIsSaid),
        cmocka_unit_test(boundsCountTheSteps),
        cmocka_unit_test(geocentricMeshesLieWhereTheyShould),
        cmocka_unit_test(damagedFilesAreRefusedOrRead),
    };
    return cmocka_run_group_tests(tests, make_folder, remove_folder);
}
