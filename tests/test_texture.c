/* Textures and parts of GLBs: what lies where, decoded by hand and by libpng. */
#include "dem/crs.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/out/layer_paint.h"
#include "lib/scene/layers.h"
#include "lib/scene/light.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>

#include <cmocka.h>

#include "tests/near.h"

#include <jansson.h>
#include <math.h>
#include <png.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

enum { WIDTH = 67, HEIGHT = 50 };

typedef struct bench {
    float *heights;
    tl_source *source;
    tl_mesh *mesh;
    char path[64];
} bench;

/* A file's parts. */
typedef struct glb {
    unsigned char *bytes;
    const unsigned char *binary;
    size_t size;
    json_t *json;
} glb;

static int setUp(void **state)
{
    bench *b = calloc(1, sizeof *b);
    b->heights = tl_alloc_grid(WIDTH, HEIGHT, sizeof *b->heights);
    for (int k = 0; k < WIDTH * HEIGHT; k++)
        b->heights[k] = (float)(300 + 60 * sin(k % WIDTH * .2) * cos(k / WIDTH * .15) + k % WIDTH);
    const tl_source_info info = {.width = WIDTH,
                                 .height = HEIGHT,
                                 .type = TL_RASTER_POINT,
                                 .georef = {.located = true,
                                            .transform = {400015, 30, 0, 3999985, 0, -30},
                                            .cell_x = 30,
                                            .cell_y = 30,
                                            .height_unit = 1},
                                 .name = "waves"};
    b->source = tl_array_source_create(b->heights, &info, NULL);
    assert_int_equal(tl_mesh_from_source(b->source, NULL, &b->mesh, NULL), TL_OK);
    snprintf(b->path, sizeof b->path, "texture-%ld.glb", (long)getpid());
    *state = b;
    return 0;
}

static int tearDown(void **state)
{
    bench *b = *state;
    unlink(b->path);
    tl_mesh_destroy(b->mesh);
    tl_source_destroy(b->source);
    free(b->heights);
    free(b);
    return 0;
}

static glb read_glb(const char *path)
{
    glb out = {0};
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    fseek(f, 0, SEEK_END);
    out.size = (size_t)ftell(f);
    rewind(f);
    out.bytes = malloc(out.size);
    assert_int_equal(fread(out.bytes, 1, out.size, f), out.size);
    fclose(f);
    uint32_t text;
    memcpy(&text, out.bytes + 12, 4);
    out.json = json_loadb((const char *)out.bytes + 20, text, 0, NULL);
    assert_non_null(out.json);
    out.binary = out.bytes + 28 + text;
    return out;
}

static glb write_glb(const bench *b, tl_write_options options)
{
    tl_error error;
    options.overwrite = true;
    options.ground = b->source;
    if (tl_write_mesh(b->mesh, b->path, &options, &error) != TL_OK)
        fail_msg("%s", error.text);
    return read_glb(b->path);
}

static void close_glb(glb *g)
{
    json_decref(g->json);
    free(g->bytes);
}

static json_t *item(json_t *root, const char *list, json_int_t index)
{
    json_t *found = json_array_get(json_object_get(root, list), (size_t)index);
    assert_non_null(found);
    return found;
}

static json_int_t whole(json_t *object, const char *name)
{
    return json_integer_value(json_object_get(object, name));
}

/* Vertex k's numbers of an attribute, as a reader has them. */
static void attribute(const glb *g, const char *name, size_t k, size_t count, double *out)
{
    json_t *mesh = item(g->json, "meshes", 0);
    json_t *attributes = json_object_get(json_array_get(json_object_get(mesh, "primitives"), 0), "attributes");
    assert_non_null(json_object_get(attributes, name));
    json_t *accessor = item(g->json, "accessors", whole(attributes, name));
    json_t *view = item(g->json, "bufferViews", whole(accessor, "bufferView"));
    const unsigned char *at = g->binary + whole(view, "byteOffset") + whole(accessor, "byteOffset") +
                              (json_int_t)k * whole(view, "byteStride");
    for (size_t c = 0; c < count; c++) {
        float f;
        int16_t i;
        uint16_t u;
        bool normalized = json_is_true(json_object_get(accessor, "normalized"));
        switch (whole(accessor, "componentType")) {
        case 5126:
            memcpy(&f, at + 4 * c, 4);
            out[c] = (double)f;
            break;
        case 5122:
            memcpy(&i, at + 2 * c, 2);
            out[c] = normalized ? fmax(i / 32767.0, -1) : i;
            break;
        default:
            memcpy(&u, at + 2 * c, 2);
            out[c] = normalized ? u / 65535.0 : u;
        }
    }
}

static double of_node(const glb *g, const char *name, size_t a, double otherwise)
{
    json_t *list = json_object_get(item(g->json, "nodes", 0), name);
    return list ? json_number_value(json_array_get(list, a)) : otherwise;
}

/* Column and row of vertex k, by its place: columns run along x, rows along z. */
static void sample_of(const bench *b, const glb *g, size_t k, int *i, int *j)
{
    double at[3];
    const double *t = b->source->info.georef.transform;
    attribute(g, "POSITION", k, 3, at);
    for (size_t a = 0; a < 3; a++)
        at[a] = at[a] * of_node(g, "scale", a, 1) + of_node(g, "translation", a, 0);
    *i = (int)lrint((at[0] - t[0]) / t[1]);
    *j = (int)lrint((-at[2] - t[3]) / t[5]);
}

static unsigned char *decode_png(const glb *g, json_int_t texture, int *width, int *height)
{
    json_t *image = item(g->json, "images", whole(item(g->json, "textures", texture), "source"));
    json_t *view = item(g->json, "bufferViews", whole(image, "bufferView"));
    png_image png = {.version = PNG_IMAGE_VERSION};
    assert_true(png_image_begin_read_from_memory(&png, g->binary + whole(view, "byteOffset"),
                                                 (size_t)whole(view, "byteLength")));
    png.format = PNG_FORMAT_RGB;
    unsigned char *out = malloc(PNG_IMAGE_SIZE(png));
    assert_true(png_image_finish_read(&png, NULL, out, 0, NULL));
    *width = (int)png.width;
    *height = (int)png.height;
    return out;
}

static json_int_t texture_of(const glb *g, const char *name)
{
    json_t *material = item(g->json, "materials", 0);
    json_t *holder = strcmp(name, "normalTexture") == 0 ? material : json_object_get(material, "pbrMetallicRoughness");
    assert_non_null(json_object_get(holder, name));
    return whole(json_object_get(holder, name), "index");
}

/* A layer's bytes at every sample. */
static unsigned char *paint(const tl_source *source, const char *kind)
{
    const tl_source_info *info = &source->info;
    size_t samples = (size_t)(info->width * info->height);
    scene_layer *layer = scene_layer_create(source, kind, NULL, NULL);
    float *values = tl_alloc(3 * samples, sizeof *values);
    unsigned char *out = malloc(3 * samples), rgba[4];
    assert_int_equal(scene_layer_read(layer, (tl_window){0, 0, info->width, info->height}, values, NULL), TL_OK);
    scene_encode_prepare();
    for (size_t k = 0; k < samples; k++) {
        out_layer_paint(scene_layer_kind(layer), values + k, samples, rgba);
        memcpy(out + 3 * k, rgba, 3);
    }
    scene_layer_destroy(layer);
    free(values);
    return out;
}

static const tl_mesh_coding codings[] = {TL_CODING_PLAIN, TL_CODING_QUANTIZED};

/* A texel's centre lies where its sample lies: the coordinates of sample (i, j) are those of texel (i, j)'s centre. */
static void texelsLieOnTheirSamples(void **state)
{
    bench *b = *state;
    for (int south = 0; south < 2; south++)
        for (int coding = 0; coding < 2; coding++) {
            b->source->info.georef.transform[5] = south ? 30 : -30;
            b->mesh->georef = b->source->info.georef;
            glb g = write_glb(
                b, (tl_write_options){.textures = TL_TEXTURE_COLOUR | TL_TEXTURE_NORMAL, .coding = codings[coding]});
            const char *const layers[2] = {"albedo", "tangent"};
            const char *const names[2] = {"baseColorTexture", "normalTexture"};
            for (int n = 0; n < 2; n++) {
                int width, height;
                unsigned char *png = decode_png(&g, texture_of(&g, names[n]), &width, &height);
                unsigned char *wanted = paint(b->source, layers[n]);
                assert_int_equal(width, WIDTH);
                assert_int_equal(height, HEIGHT);
                for (size_t k = 0; k < b->mesh->vertex_count; k++) {
                    double uv[2];
                    int i, j;
                    attribute(&g, "TEXCOORD_0", k, 2, uv);
                    sample_of(b, &g, k, &i, &j);
                    /* half a step of 16 bits, in texels, or single precision */
                    assert_near(uv[0] * width - 0.5, i, coding ? 0.51 * WIDTH / 65535 : 1e-4);
                    assert_near(uv[1] * height - 0.5, j, coding ? 0.51 * HEIGHT / 65535 : 1e-4);
                    assert_memory_equal(png + 3 * (j * WIDTH + i), wanted + 3 * (j * WIDTH + i), 3);
                }
                free(wanted);
                free(png);
            }
            close_glb(&g);
        }
}

/* The normal that a reader makes of vertex and texture is that of the ground: (east, up, south) of glTF's axes. */
static void normalsAreThoseOfTheGround(void **state)
{
    bench *b = *state;
    for (int south = 0; south < 2; south++)
        for (int coding = 0; coding < 2; coding++) {
            double *t = b->source->info.georef.transform;
            t[5] = south ? 30 : -30;
            b->mesh->georef = b->source->info.georef;
            glb g = write_glb(b, (tl_write_options){.textures = TL_TEXTURE_NORMAL, .coding = codings[coding]});
            int width, height;
            unsigned char *png = decode_png(&g, texture_of(&g, "normalTexture"), &width, &height);
            for (size_t k = 0; k < b->mesh->vertex_count; k += 7) {
                double up[3], along[4], across[3], n[3], length[2] = {0, 0}, sum = 0, wanted[3];
                int i, j;
                sample_of(b, &g, k, &i, &j);
                if (i < 1 || j < 1 || i > WIDTH - 2 || j > HEIGHT - 2)
                    continue;
                attribute(&g, "NORMAL", k, 3, up);
                attribute(&g, "TANGENT", k, 4, along);
                for (size_t a = 0; a < 3; a++) { /* by the node's scale and its inverse */
                    up[a] /= of_node(&g, "scale", a, 1);
                    along[a] *= of_node(&g, "scale", a, 1);
                    length[0] += up[a] * up[a];
                    length[1] += along[a] * along[a];
                }
                for (int a = 0; a < 3; a++) {
                    up[a] /= sqrt(length[0]);
                    along[a] /= sqrt(length[1]);
                }
                for (int a = 0; a < 3; a++)
                    across[a] =
                        along[3] * (up[(a + 1) % 3] * along[(a + 2) % 3] - up[(a + 2) % 3] * along[(a + 1) % 3]);
                const unsigned char *texel = png + 3 * (j * WIDTH + i);
                for (int a = 0; a < 3; a++) {
                    n[a] = (texel[0] / 127.5 - 1) * along[a] + (texel[1] / 127.5 - 1) * across[a] +
                           (texel[2] / 127.5 - 1) * up[a];
                    sum += n[a] * n[a];
                }
                const float *z = b->heights + j * WIDTH + i;
                double x = (double)(z[1] - z[-1]) / 60, y = (double)(z[WIDTH] - z[-WIDTH]) / (2 * t[5]);
                double one = sqrt(1 + x * x + y * y);
                wanted[0] = -x / one, wanted[1] = 1 / one, wanted[2] = y / one;
                for (int a = 0; a < 3; a++) /* three bytes' half steps, and normals and tangents of 16 bits */
                    assert_near(n[a] / sqrt(sum), wanted[a], 0.5 / 127.5 * sqrt(3.0) + 1e-3);
            }
            free(png);
            close_glb(&g);
        }
}

/* A mesh over a part, with fewer texels than samples: each second sample, counted from the raster's first. */
static void texturesKeepTheirSize(void **state)
{
    bench *b = *state;
    glb g = write_glb(b, (tl_write_options){.textures = TL_TEXTURE_COLOUR, .texture_size = 40});
    int width, height;
    unsigned char *png = decode_png(&g, 0, &width, &height), *wanted = paint(b->source, "albedo");
    assert_int_equal(width, 34); /* of samples 0, 2 ... 66 */
    assert_int_equal(height, 25);
    for (int q = 0; q < height; q++)
        for (int p = 0; p < width; p++)
            assert_memory_equal(png + 3 * (q * width + p), wanted + 3 * (2 * q * WIDTH + 2 * p), 3);
    double uv[2];
    for (size_t k = 0; k < b->mesh->vertex_count; k++) {
        int i, j;
        attribute(&g, "TEXCOORD_0", k, 2, uv);
        sample_of(b, &g, k, &i, &j);
        assert_near(uv[0] * width - 0.5, i / 2.0, 1e-4);
        assert_near(uv[1] * height - 0.5, fmin(j / 2.0, 24), 1e-4); /* the last row lies beyond the last texel */
    }
    free(png);
    free(wanted);
    close_glb(&g);
}

static void whatHasNoMetresHasNoNormals(void **state)
{
    bench *b = *state;
    tl_error error;
    tl_write_options options = {.textures = TL_TEXTURE_NORMAL, .frame = TL_FRAME_PIXEL, .ground = b->source};
    assert_int_equal(tl_write_mesh(b->mesh, b->path, &options, &error), TL_ERROR_ARGUMENT);
    assert_non_null(strstr(error.text, "metres"));
    options = (tl_write_options){.textures = TL_TEXTURE_COLOUR};
    assert_int_equal(tl_write_mesh(b->mesh, b->path, &options, &error), TL_ERROR_ARGUMENT);
    assert_int_not_equal(access(b->path, F_OK), 0);
}

static size_t count_of(const glb *g, const char *name)
{
    json_t *primitive = json_array_get(json_object_get(item(g->json, "meshes", 0), "primitives"), 0);
    json_int_t index =
        strcmp(name, "indices") == 0 ? whole(primitive, name) : whole(json_object_get(primitive, "attributes"), name);
    return (size_t)whole(item(g->json, "accessors", index), "count");
}

/* Place and normal of each sample's vertex, in glTF's coordinates; those that are known already must be the same. */
static size_t gather(const bench *b, const glb *g, double (*known)[6])
{
    size_t count = count_of(g, "POSITION"), shared = 0;
    for (size_t k = 0; k < count; k++) {
        double at[6];
        int i, j;
        attribute(g, "POSITION", k, 3, at);
        attribute(g, "NORMAL", k, 3, at + 3);
        sample_of(b, g, k, &i, &j);
        double *before = known[j * WIDTH + i];
        if (!isnan(before[0])) {
            assert_memory_equal(before, at, sizeof at);
            shared++;
        }
        memcpy(before, at, sizeof at);
    }
    return shared;
}

/* Parts have the vertices of the whole, to the bit, and on their common rims all of them. */
static void partsJoin(void **state)
{
    bench *b = *state;
    enum { SPLIT = 500 };
    double(*known)[6] = malloc(sizeof *known * WIDTH * HEIGHT);
    for (int k = 0; k < WIDTH * HEIGHT; k++)
        known[k][0] = (double)NAN;
    glb g = write_glb(b, (tl_write_options){0});
    assert_int_equal(gather(b, &g, known), 0);
    close_glb(&g);
    unlink(b->path);
    tl_error error;
    const tl_write_options options = {.split = SPLIT};
    assert_int_equal(tl_write_mesh(b->mesh, b->path, &options, &error), TL_OK);
    assert_int_not_equal(access(b->path, F_OK), 0);
    size_t triangles = 0, vertices = 0, files = 0;
    for (int x = 0; x < 20; x++)
        for (int y = 0; y < 20; y++) {
            char path[96];
            snprintf(path, sizeof path, "%.*s_x%d_y%d.glb", (int)strlen(b->path) - 4, b->path, x, y);
            if (access(path, F_OK) != 0)
                continue;
            glb part = read_glb(path);
            size_t count = count_of(&part, "indices") / 3;
            assert_true(count > 0 && count <= SPLIT);
            assert_int_equal(gather(b, &part, known), count_of(&part, "POSITION"));
            triangles += count;
            vertices += count_of(&part, "POSITION");
            files++;
            close_glb(&part);
            unlink(path);
        }
    assert_int_equal(triangles, b->mesh->triangle_count);
    assert_true(vertices > b->mesh->vertex_count);
    assert_true(files >= triangles / SPLIT && files < 4 * triangles / SPLIT);
    assert_int_equal(
        tl_write_mesh(b->mesh, b->path, &(tl_write_options){.split = SPLIT, .coding = TL_CODING_QUANTIZED}, &error),
        TL_ERROR_ARGUMENT);
    free(known);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup_teardown(texelsLieOnTheirSamples, setUp, tearDown),
        cmocka_unit_test_setup_teardown(normalsAreThoseOfTheGround, setUp, tearDown),
        cmocka_unit_test_setup_teardown(texturesKeepTheirSize, setUp, tearDown),
        cmocka_unit_test_setup_teardown(partsJoin, setUp, tearDown),
        cmocka_unit_test_setup_teardown(whatHasNoMetresHasNoNormals, setUp, tearDown),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
