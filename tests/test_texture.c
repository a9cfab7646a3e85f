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
static void check_parts(const bench *b, unsigned textures)
{
    enum { SPLIT = 500 };
    double(*known)[6] = malloc(sizeof *known * WIDTH * HEIGHT);
    for (int k = 0; k < WIDTH * HEIGHT; k++)
        known[k][0] = (double)NAN;
    glb g = write_glb(b, (tl_write_options){.textures = textures});
    assert_int_equal(gather(b, &g, known), 0);
    close_glb(&g);
    unlink(b->path);
    tl_error error;
    const tl_write_options options = {.split = SPLIT, .ground = b->source, .textures = textures};
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

static void partsJoin(void **state)
{
    check_parts(*state, 0);
    check_parts(*state, TL_TEXTURE_NORMAL);
}

/* ---- Normals of the ground ---- */

/* The normal of vertex k, as a reader has it: by the node's scale, or turned by its matrix. */
static void normal_of(const glb *g, size_t k, double out[3])
{
    json_t *matrix = json_object_get(item(g->json, "nodes", 0), "matrix");
    double stored[3], length = 0;
    attribute(g, "NORMAL", k, 3, stored);
    for (size_t a = 0; a < 3; a++) {
        out[a] = matrix ? 0 : stored[a] / of_node(g, "scale", a, 1);
        for (size_t c = 0; matrix && c < 3; c++) {
            double column = 0; /* a turn and a scale: the inverse divides by the scale's square */
            for (size_t r = 0; r < 3; r++)
                column += pow(json_number_value(json_array_get(matrix, 4 * c + r)), 2);
            out[a] += json_number_value(json_array_get(matrix, 4 * c + a)) * stored[c] / column;
        }
        length += out[a] * out[a];
    }
    for (int a = 0; a < 3; a++)
        out[a] /= sqrt(length);
}

/* Largest difference between a normal of 16-bit steps and the true one: each of its numbers, which are scaled by the
 * node's steps, is off by half a step at most. */
static double coarseness(const glb *g, const double n[3])
{
    double length = 0, off = 0;
    for (size_t a = 0; a < 3; a++)
        length += pow(n[a] * of_node(g, "scale", a, 1), 2);
    for (size_t a = 0; a < 3; a++)
        off += pow(0.5 / 32767 * sqrt(length) / of_node(g, "scale", a, 1), 2);
    return 2 * sqrt(off); /* and it is made one long again */
}

/* Whole multiples of 1/64: exact in floats, and so are their central differences. */
static double bowl(int i, int j)
{
    return 1000 + i * i / 64.0 - j * j / 32.0 + i * j / 64.0 + 2 * i - j;
}

static void fill(bench *b, double (*height)(int, int))
{
    for (int k = 0; k < WIDTH * HEIGHT; k++)
        b->heights[k] = (float)height(k % WIDTH, k / WIDTH);
}

static void simplify(bench *b, double max_error)
{
    tl_mesh_destroy(b->mesh);
    assert_int_equal(tl_simplify(b->source, &(tl_simplify_options){.max_error = max_error, .frame = TL_FRAME_PIXEL},
                                 &b->mesh, NULL, NULL),
                     TL_OK);
}

static void assert_normal(const double found[3], const double wanted[3], double tolerance)
{
    for (int a = 0; a < 3; a++)
        assert_near(found[a], wanted[a], tolerance);
}

static bool on_rim(int i, int j)
{
    return i == 0 || j == 0 || i == WIDTH - 1 || j == HEIGHT - 1;
}

/* Of a tenth of the vertices, each has the normal of the paraboloid, whatever triangles are around it. */
static void simplifiedMeshesHaveTheGroundsNormals(void **state)
{
    bench *b = *state;
    double *t = b->source->info.georef.transform;
    fill(b, bowl);
    for (int south = 0; south < 2; south++) {
        t[5] = south ? 30 : -30;
        simplify(b, 10);
        assert_true(b->mesh->vertex_count < WIDTH * HEIGHT / 10);
        for (int coding = 0; coding < 2; coding++) {
            glb g = write_glb(b, (tl_write_options){.coding = codings[coding], .frame = TL_FRAME_PROJECTED});
            for (size_t k = 0; k < b->mesh->vertex_count; k++) {
                int i, j;
                double n[3];
                sample_of(b, &g, k, &i, &j);
                if (on_rim(i, j))
                    continue;
                double x = (i / 32.0 + j / 64.0 + 2) / t[1], y = (-j / 16.0 + i / 64.0 - 1) / t[5];
                double one = sqrt(1 + x * x + y * y), wanted[3] = {-x / one, 1 / one, y / one};
                normal_of(&g, k, n);
                assert_normal(n, wanted, coding ? coarseness(&g, wanted) : 2e-7);
            }
            close_glb(&g);
        }
    }
}

static double plane(int i, int j)
{
    return (i % 9 == 4 && j % 7 < 3) || (i > 40 && j < 12) ? (double)NAN : 500 + 12 * i + 7 * j;
}

/* Beside voids and at the rim differences are one-sided, which is the same for a plane. */
static void planesAreEvenBesideVoids(void **state)
{
    bench *b = *state;
    fill(b, plane);
    simplify(b, 0);
    const tl_frame frames[] = {TL_FRAME_PIXEL, TL_FRAME_PROJECTED};
    for (int f = 0; f < 2; f++) {
        glb g = write_glb(b, (tl_write_options){.frame = frames[f]});
        double x = f ? 12 / 30.0 : 12, y = f ? 7 / -30.0 : 7, one = sqrt(1 + x * x + y * y);
        const double wanted[3] = {-x / one, 1 / one, y / one};
        assert_true(count_of(&g, "NORMAL") > 100);
        for (size_t k = 0; k < count_of(&g, "NORMAL"); k++) {
            double n[3];
            normal_of(&g, k, n);
            assert_normal(n, wanted, 2e-7);
        }
        close_glb(&g);
    }
}

/* The normal above the ellipsoid of WGS 84 of heights that change by x a radian of longitude and y a radian of
 * latitude, geocentric: steps east and north are those of the radii of curvature. */
static void geocentric_normal(double longitude, double latitude, double h, double x, double y, double out[3])
{
    const double a = 6378137, f = 1 / 298.257223563, e2 = f * (2 - f);
    double sl = sin(longitude), cl = cos(longitude), sp = sin(latitude), cp = cos(latitude);
    double w = 1 - e2 * sp * sp, east = x / ((a / sqrt(w) + h) * cp), north = y / (a * (1 - e2) / (w * sqrt(w)) + h);
    double one = sqrt(1 + east * east + north * north);
    out[0] = (cl * cp + sl * east + sp * cl * north) / one;
    out[1] = (sl * cp - cl * east + sp * sl * north) / one;
    out[2] = (sp - cp * north) / one;
}

/* Over a raster in longitude and latitude, by the ellipsoid's geometry: in the file of geocentric coordinates, and,
 * turned by the same matrix, in that of the tangent plane. */
static void normalsStandOnTheEllipsoid(void **state)
{
    bench *b = *state;
    const double radian = 3.14159265358979323846 / 180, step = 1.0 / 1200;
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text("EPSG:4326", "test", &crs, NULL), TL_OK);
    fill(b, bowl);
    b->source->info.georef =
        (tl_georef){.crs = crs, .located = true, .transform = {7.5, step, 0, 46.4, 0, -step}, .height_unit = 1};
    b->source->info.georef.cell_x = 64, b->source->info.georef.cell_y = 92.6;
    simplify(b, 10);
    glb flat = write_glb(b, (tl_write_options){.frame = TL_FRAME_ENU});
    glb round = write_glb(b, (tl_write_options){.frame = TL_FRAME_ECEF});
    assert_int_equal(count_of(&flat, "NORMAL"), count_of(&round, "NORMAL"));
    int checked = 0;
    for (size_t k = 0; k < count_of(&round, "NORMAL"); k++) {
        double n[3], at[3], level[3], same[3], best = HUGE_VAL, wanted[3] = {0};
        attribute(&round, "NORMAL", k, 3, level);
        attribute(&flat, "NORMAL", k, 3, same);
        assert_normal(level, same, 0);
        attribute(&flat, "POSITION", k, 3, at);
        normal_of(&round, k, n);
        bool rim = false;
        for (size_t v = 0; v < b->mesh->vertex_count; v++) { /* that whose height and place these are */
            int i = b->mesh->vertices[v].i, j = b->mesh->vertices[v].j;
            double east = (i - (WIDTH - 1) / 2.0) * 64.1, south = (j - (HEIGHT - 1) / 2.0) * 92.6;
            double off = hypot(at[0] - east, at[2] - south);
            if (off > best)
                continue;
            best = off;
            rim = on_rim(i, j);
            geocentric_normal((7.5 + i * step) * radian, (46.4 - j * step) * radian, bowl(i, j),
                              (i / 32.0 + j / 64.0 + 2) / (step * radian),
                              (-j / 16.0 + i / 64.0 - 1) / (-step * radian), wanted);
        }
        assert_true(best < 30);
        const double turned[3] = {wanted[0], wanted[2], -wanted[1]};
        if (!rim)
            assert_normal(n, turned, 3e-7), checked++;
    }
    assert_true(checked > 50);
    close_glb(&flat);
    close_glb(&round);
    b->source->info.georef.crs = NULL;
    tl_mesh_destroy(b->mesh);
    b->mesh = NULL;
    tl_crs_release(crs);
}

/* Edges of 4, 2 and 1 samples of a field of two levels: slopes are those over 4, 2 and 1 samples to both sides. */
static void fieldsHaveTheNormalsOfTheirLevels(void **state)
{
    bench *b = *state;
    const tl_field_options options = {
        .levels = 2, .seed = 3, .scheme = "stationary", .hurst = 0.5, .delta = 9, .support = TL_SUPPORT_POINT};
    tl_source *field = tl_field_create(b->source, &options, NULL);
    assert_non_null(field);
    enum { X = 100, Y = 80 };
    tl_mesh mesh = {.vertex_count = 3, .triangle_count = 1, .georef = field->info.georef};
    tl_vertex vertices[3];
    uint32_t corners[3] = {0, 2, 1};
    mesh.vertices = vertices;
    mesh.indices = corners;
    for (int step = 1; step <= 4; step *= 2) {
        const tl_window around = {X - step, Y - step, 2 * step + 1, 2 * step + 1};
        float heights[81];
        assert_int_equal(tl_source_read(field, 2, around, heights, NULL), TL_OK);
        int side = 2 * step + 1, middle = step * side + step;
        for (int v = 0; v < 3; v++)
            vertices[v] = (tl_vertex){X + (v == 1) * step, Y + (v == 2) * step, heights[middle]};
        tl_error error;
        if (tl_write_mesh(&mesh, b->path, &(tl_write_options){.overwrite = true, .ground = field}, &error) != TL_OK)
            fail_msg("%s", error.text);
        glb g = read_glb(b->path);
        double x = (double)(heights[middle + step] - heights[middle - step]) / (2 * step * 7.5);
        double y = (double)(heights[middle + step * side] - heights[middle - step * side]) / (2 * step * -7.5);
        double one = sqrt(1 + x * x + y * y), n[3], at[3], last = HUGE_VAL;
        const double wanted[3] = {-x / one, 1 / one, y / one};
        size_t first = 0;
        for (size_t k = 0; k < 3; k++) { /* the vertex at X, Y is the most western and the most northern */
            attribute(&g, "POSITION", k, 3, at);
            if (at[0] + at[2] < last)
                last = at[0] + at[2], first = k;
        }
        normal_of(&g, first, n);
        assert_normal(n, wanted, 1e-6);
        close_glb(&g);
    }
    tl_source_destroy(field);
}

/* The mean slopes of the bilinear surface over the cells within `reach` of a sample. */
static void slopes_of_cells(const bench *b, int i, int j, int reach, double slopes[2])
{
    slopes[0] = slopes[1] = 0;
    for (int y = j - reach; y < j + reach; y++)
        for (int x = i - reach; x < i + reach; x++) {
            const float *z = b->heights + y * WIDTH + x;
            slopes[0] += ((double)z[1] - (double)z[0] + (double)z[WIDTH + 1] - (double)z[WIDTH]) / 2;
            slopes[1] += ((double)z[WIDTH] - (double)z[0] + (double)z[WIDTH + 1] - (double)z[1]) / 2;
        }
    for (int a = 0; a < 2; a++)
        slopes[a] /= 4 * reach * reach;
}

/* Where the shortest edge is 4, 8 or 16 samples, slopes are meant over a square of that size; nearer to the rim over as
 * large a one as there is. */
static void normalsAreMeansOverTheShortestEdge(void **state)
{
    bench *b = *state;
    uint32_t random = 1, corners[3] = {0, 2, 1};
    for (int k = 0; k < WIDTH * HEIGHT; k++) {
        random = random * 1664525 + 1013904223;
        b->heights[k] = (float)(300 + 5 * (k % WIDTH) + (random >> 24) / 4.0);
    }
    tl_vertex vertices[3];
    tl_mesh mesh = {.vertices = vertices,
                    .vertex_count = 3,
                    .indices = corners,
                    .triangle_count = 1,
                    .georef = b->source->info.georef};
    for (int near = 0; near < 2; near++)
        for (int edge = 4; edge <= 16; edge *= 2) {
            const int x = near ? 1 : 20, y = 17, reach = near ? 1 : edge / 2;
            for (int v = 0; v < 3; v++) /* a longer edge along rows, and a vertex whose square is not the first's */
                vertices[v] = (tl_vertex){x + (v == 1) * (edge + 1), y + (v == 2) * edge, 300};
            tl_error error;
            if (tl_write_mesh(&mesh, b->path, &(tl_write_options){.overwrite = true, .ground = b->source}, &error) !=
                TL_OK)
                fail_msg("%s", error.text);
            glb g = read_glb(b->path);
            double slopes[2], n[3];
            slopes_of_cells(b, x, y, reach, slopes);
            if (reach == 1) /* over one sample to each side it is that through the sample itself */
                for (int a = 0; a < 2; a++) {
                    const float *z = b->heights + y * WIDTH + x;
                    slopes[a] = (double)(z[a ? WIDTH : 1] - z[a ? -WIDTH : -1]) / 2;
                }
            double one = sqrt(1 + pow(slopes[0] / 30, 2) + pow(slopes[1] / 30, 2));
            const double wanted[3] = {-slopes[0] / 30 / one, 1 / one, -slopes[1] / 30 / one};
            for (size_t k = 0; k < 3; k++) {
                int i, j;
                sample_of(b, &g, k, &i, &j);
                normal_of(&g, k, n);
                if (i == x && j == y)
                    assert_normal(n, wanted, 2e-7);
            }
            close_glb(&g);
        }
}

/* A floor looks down; a skirt is lit as the rim that it hangs from. */
static void whatHangsBelowIsNoGround(void **state)
{
    bench *b = *state;
    for (int k = 0; k < WIDTH * HEIGHT; k++)
        b->heights[k] = (float)(300 + 12 * (k % WIDTH));
    for (int base = 0; base < 2; base++) {
        simplify(b, 1);
        assert_int_equal(base ? tl_mesh_add_base(b->mesh, 50, NULL) : tl_mesh_add_skirt(b->mesh, 50, NULL), TL_OK);
        glb g = write_glb(b, (tl_write_options){0});
        double x = 12 / 30.0, one = sqrt(1 + x * x);
        const double wanted[3] = {-x / one, 1 / one, 0};
        for (size_t k = 0; k < count_of(&g, "NORMAL"); k++) {
            int i, j;
            double n[3], at[3];
            attribute(&g, "POSITION", k, 3, at);
            sample_of(b, &g, k, &i, &j);
            normal_of(&g, k, n);
            bool below = at[1] + of_node(&g, "translation", 1, 0) < 299 + 12 * i;
            if (base && below)
                assert_true(n[1] < 0);
            else
                assert_normal(n, wanted, 2e-7);
        }
        close_glb(&g);
    }
}

static void othersGroundIsRefused(void **state)
{
    bench *b = *state;
    tl_error error;
    tl_source_info info = b->source->info;
    info.width = WIDTH - 1;
    tl_source *narrow = tl_array_source_create(b->heights, &info, NULL);
    assert_int_equal(tl_write_mesh(b->mesh, b->path, &(tl_write_options){.ground = narrow}, &error), TL_ERROR_ARGUMENT);
    assert_non_null(strstr(error.text, "not on this ground"));
    tl_source_destroy(narrow);
}

/* ---- Tiles of a view's textures ---- */

enum { DEEP = 4, ACROSS = (WIDTH - 1) << DEEP, DOWN = (HEIGHT - 1) << DEEP };

/* The field whose right isosceles triangles get finer towards a corner: squares that are halved while they touch it. */
static void add_square(tl_mesh *mesh, int x, int y, int side)
{
    if (side > 1 && x <= ACROSS / 2 && ACROSS / 2 <= x + side && y <= DOWN / 2 && DOWN / 2 <= y + side) {
        for (int q = 0; q < 4; q++)
            add_square(mesh, x + (q & 1) * side / 2, y + (q >> 1) * side / 2, side / 2);
        return;
    }
    if (x + side > ACROSS || y + side > DOWN)
        return;
    uint32_t first = (uint32_t)mesh->vertex_count;
    for (int c = 0; c < 4; c++)
        mesh->vertices[mesh->vertex_count++] = (tl_vertex){x + (c & 1) * side, y + (c >> 1) * side, 300};
    const uint32_t corners[6] = {first, first + 2, first + 1, first + 1, first + 2, first + 3};
    memcpy(mesh->indices + 3 * mesh->triangle_count, corners, sizeof corners);
    mesh->triangle_count += 2;
}

/* Where a tile's texel (0, 0) lies and how far it is to the next, in samples, by two of its vertices an axis. */
typedef struct laid {
    double first[2], step[2];
} laid;

typedef struct tile_view {
    size_t count;     /* of corners */
    size_t *vertices; /* of the shared arrays */
    int *places;      /* columns and rows */
    double *texels;   /* where they lie in the picture: 0 is the middle of the first */
    int width, height;
    unsigned char *png;
    laid at;
} tile_view;

static tile_view open_tile(const tl_source *field, const glb *g, size_t tile)
{
    json_t *primitive = json_array_get(json_object_get(item(g->json, "meshes", 0), "primitives"), tile);
    json_t *indices = item(g->json, "accessors", whole(primitive, "indices"));
    json_t *material = item(g->json, "materials", whole(primitive, "material"));
    json_t *colour = json_object_get(json_object_get(material, "pbrMetallicRoughness"), "baseColorTexture");
    const double *t = field->info.georef.transform;
    tile_view out = {.count = (size_t)whole(indices, "count")};
    const unsigned char *at = g->binary +
                              whole(item(g->json, "bufferViews", whole(indices, "bufferView")), "byteOffset") +
                              whole(indices, "byteOffset");
    out.vertices = malloc(out.count * sizeof *out.vertices);
    out.places = malloc(2 * out.count * sizeof *out.places);
    out.texels = malloc(2 * out.count * sizeof *out.texels);
    out.png = decode_png(g, whole(colour, "index"), &out.width, &out.height);
    double low[2] = {HUGE_VAL, HUGE_VAL}, high[2] = {-HUGE_VAL, -HUGE_VAL}, texel_low[2], texel_high[2];
    for (size_t k = 0; k < out.count; k++) {
        uint16_t small;
        uint32_t index;
        memcpy(&small, at + 2 * k, 2);
        memcpy(&index, at + 4 * k, 4);
        out.vertices[k] = whole(indices, "componentType") == 5123 ? small : index;
        double place[3], uv[2];
        attribute(g, "POSITION", out.vertices[k], 3, place);
        attribute(g, "TEXCOORD_0", out.vertices[k], 2, uv);
        for (size_t a = 0; a < 3; a++)
            place[a] = place[a] * of_node(g, "scale", a, 1) + of_node(g, "translation", a, 0);
        const double sample[2] = {(place[0] - t[0]) / t[1], (-place[2] - t[3]) / t[5]};
        for (int a = 0; a < 2; a++) {
            out.places[2 * k + (size_t)a] = (int)lrint(sample[a]);
            double texel = uv[a] * (a ? out.height : out.width) - 0.5;
            out.texels[2 * k + (size_t)a] = texel;
            if (sample[a] < low[a])
                low[a] = sample[a], texel_low[a] = texel;
            if (sample[a] > high[a])
                high[a] = sample[a], texel_high[a] = texel;
        }
    }
    for (int a = 0; a < 2; a++) {
        out.at.step[a] = (high[a] - low[a]) / (texel_high[a] - texel_low[a]);
        out.at.first[a] = low[a] - texel_low[a] * out.at.step[a];
    }
    return out;
}

static void close_tile(tile_view *tile)
{
    free(tile->vertices);
    free(tile->places);
    free(tile->texels);
    free(tile->png);
}

static int shortest_of(const tile_view *tile)
{
    int shortest = INT32_MAX;
    for (size_t k = 0; k < tile->count; k++) {
        size_t next = k % 3 == 2 ? k - 2 : k + 1;
        int x = abs(tile->places[2 * k] - tile->places[2 * next]);
        int y = abs(tile->places[2 * k + 1] - tile->places[2 * next + 1]), edge = x > y ? x : y;
        shortest = edge < shortest ? edge : shortest;
    }
    return shortest;
}

/* Each texel has the colour of the field's sample where the vertices' coordinates lay it: so texels of neighbours that
 * lie on one sample are equal, too. */
static void check_colours(const tl_source *field, const unsigned char *wanted, const tile_view *tile)
{
    for (int q = 0; q < tile->height; q++)
        for (int p = 0; p < tile->width; p++) {
            double x = tile->at.first[0] + p * tile->at.step[0], y = tile->at.first[1] + q * tile->at.step[1];
            assert_near(x, rint(x), 0.05); /* single precision's error grows over the tile */
            assert_near(y, rint(y), 0.05);
            size_t k = (size_t)(lrint(y) * field->info.width + lrint(x));
            assert_memory_equal(tile->png + 3 * (q * tile->width + p), wanted + 3 * k, 3);
        }
}

/* Vertices lie in the middle of the texel of their own sample, at the borders of tiles too: what is left and right of a
 * border has one colour there. */
static void check_vertices(const tl_source *field, const unsigned char *wanted, const tile_view *tile)
{
    for (size_t k = 0; k < tile->count; k++) {
        const double *at = tile->texels + 2 * k;
        for (int a = 0; a < 2; a++)
            assert_near(at[a], rint(at[a]), 1e-4); /* of 257 texels, in single precision */
        size_t texel = (size_t)(lrint(at[1]) * tile->width + lrint(at[0]));
        size_t sample = (size_t)(tile->places[2 * k + 1] * field->info.width + tile->places[2 * k]);
        assert_memory_equal(tile->png + 3 * texel, wanted + 3 * sample, 3);
    }
}

/* Triangles by the places of their corners, the smallest first. */
static int compare_triangles(const void *a, const void *b)
{
    return memcmp(a, b, 6 * sizeof(int));
}

static void note_triangle(const int places[6], int *out)
{
    int first = 0;
    for (int c = 1; c < 3; c++)
        first = compare_triangles((int[6]){places[2 * c], places[2 * c + 1]},
                                  (int[6]){places[2 * first], places[2 * first + 1]}) < 0
                    ? c
                    : first;
    for (int c = 0; c < 3; c++)
        memcpy(out + 2 * c, places + 2 * ((first + c) % 3), 2 * sizeof *out);
}

static void check_triangles(const tl_mesh *mesh, int *found)
{
    int *wanted = malloc(6 * mesh->triangle_count * sizeof *wanted);
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        int places[6];
        for (size_t c = 0; c < 3; c++) {
            const tl_vertex *v = &mesh->vertices[mesh->indices[3 * t + c]];
            places[2 * c] = v->i, places[2 * c + 1] = v->j;
        }
        note_triangle(places, wanted + 6 * t);
    }
    qsort(wanted, mesh->triangle_count, 6 * sizeof *wanted, compare_triangles);
    qsort(found, mesh->triangle_count, 6 * sizeof *found, compare_triangles);
    assert_memory_equal(found, wanted, 6 * mesh->triangle_count * sizeof *found);
    free(wanted);
}

typedef struct near_view {
    tl_source *field;
    tl_mesh mesh;
    unsigned char *wanted; /* colours of all samples */
} near_view;

static near_view open_near_view(bench *b)
{
    const tl_field_options options = {.levels = DEEP,
                                      .seed = 3,
                                      .scheme = "stationary",
                                      .hurst = 0.5,
                                      .delta = 9,
                                      .hurst_given = true,
                                      .delta_given = true,
                                      .support = TL_SUPPORT_POINT};
    enum { ROOM = 4096 };
    near_view v = {.field = tl_field_create(b->source, &options, NULL)};
    assert_non_null(v.field);
    assert_int_equal(v.field->info.width, ACROSS + 1);
    v.mesh = (tl_mesh){.georef = v.field->info.georef,
                       .vertices = malloc(ROOM * sizeof(tl_vertex)),
                       .indices = malloc(6 * ROOM * sizeof(uint32_t))};
    for (int k = 0; k < 4; k++)
        add_square(&v.mesh, (k & 1) * 1024, (k >> 1) * 1024, 1024);
    v.wanted = paint(v.field, "albedo");
    return v;
}

static void close_near_view(near_view *v)
{
    tl_source_destroy(v->field);
    free(v->mesh.vertices);
    free(v->mesh.indices);
    free(v->wanted);
}

/* Of a mesh that is finest at one place: the tile there has the finest texels, others those of their own vertices or of
 * 256 on the side of their square. No triangle is lost or doubled. */
static void check_tiles(bench *b, near_view *v, tl_mesh_coding coding, int size, int finest, bool budget)
{
    tl_error error;
    const tl_write_options options = {
        .overwrite = true, .ground = v->field, .textures = TL_TEXTURE_COLOUR, .texture_size = size, .coding = coding};
    if (tl_write_mesh(&v->mesh, b->path, &options, &error) != TL_OK)
        fail_msg("%s", error.text);
    glb g = read_glb(b->path);
    size_t tiles = json_array_size(json_object_get(item(g.json, "meshes", 0), "primitives")), triangles = 0;
    int *found = malloc(6 * v->mesh.triangle_count * sizeof *found), least = INT32_MAX;
    int64_t texels = 0;
    assert_true(tiles > 1 && tiles <= 256);
    for (size_t k = 0; k < tiles; k++) {
        tile_view tile = open_tile(v->field, &g, k);
        int step = (int)lrint(tile.at.step[0]), own = shortest_of(&tile);
        assert_near(tile.at.step[0], tile.at.step[1], 0.01 * step);
        assert_true(budget || step <= own);
        least = step < least ? step : least;
        texels += (int64_t)tile.width * tile.height;
        if (coding == TL_CODING_PLAIN)
            check_colours(v->field, v->wanted, &tile);
        if (coding == TL_CODING_PLAIN && !budget)
            check_vertices(v->field, v->wanted, &tile);
        for (size_t t = 0; t < tile.count / 3 && triangles < v->mesh.triangle_count; t++)
            note_triangle(tile.places + 6 * t, found + 6 * triangles++);
        close_tile(&tile);
    }
    assert_int_equal(least, finest);
    assert_true(texels <= (int64_t)size * size);
    assert_int_equal(triangles, v->mesh.triangle_count);
    check_triangles(&v->mesh, found);
    free(found);
    close_glb(&g);
}

static void texturesFollowTheTrianglesOfAView(void **state)
{
    bench *b = *state;
    near_view v = open_near_view(b);
    check_tiles(b, &v, TL_CODING_PLAIN, 700, 1, false);
    check_tiles(b, &v, TL_CODING_QUANTIZED, 700, 1, false);
    close_near_view(&v);
}

/* With fewer texels than that takes, all are coarser alike. */
static void texturesOfAViewKeepTheirBudget(void **state)
{
    bench *b = *state;
    near_view v = open_near_view(b);
    check_tiles(b, &v, TL_CODING_PLAIN, 190, 2, true);
    close_near_view(&v);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup_teardown(texelsLieOnTheirSamples, setUp, tearDown),
        cmocka_unit_test_setup_teardown(normalsAreThoseOfTheGround, setUp, tearDown),
        cmocka_unit_test_setup_teardown(texturesKeepTheirSize, setUp, tearDown),
        cmocka_unit_test_setup_teardown(partsJoin, setUp, tearDown),
        cmocka_unit_test_setup_teardown(simplifiedMeshesHaveTheGroundsNormals, setUp, tearDown),
        cmocka_unit_test_setup_teardown(planesAreEvenBesideVoids, setUp, tearDown),
        cmocka_unit_test_setup_teardown(normalsStandOnTheEllipsoid, setUp, tearDown),
        cmocka_unit_test_setup_teardown(fieldsHaveTheNormalsOfTheirLevels, setUp, tearDown),
        cmocka_unit_test_setup_teardown(normalsAreMeansOverTheShortestEdge, setUp, tearDown),
        cmocka_unit_test_setup_teardown(whatHangsBelowIsNoGround, setUp, tearDown),
        cmocka_unit_test_setup_teardown(othersGroundIsRefused, setUp, tearDown),
        cmocka_unit_test_setup_teardown(texturesFollowTheTrianglesOfAView, setUp, tearDown),
        cmocka_unit_test_setup_teardown(texturesOfAViewKeepTheirBudget, setUp, tearDown),
        cmocka_unit_test_setup_teardown(whatHasNoMetresHasNoNormals, setUp, tearDown),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
