/* 3D Tiles: subtrees that tell which files there are, volumes that hold what they should, bounds that hold at every
 * sample, edges that neighbours share, and the same bytes from any threads and shards and after any break. Files are
 * read by a decoder of the test's own. */
#include "dem/crs.h"
#include "dem/crs_ellipsoidal.h"
#include "lib/talus.h"

#include <jansson.h>
#include <meshoptimizer.h>

#include <dirent.h>
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cmocka.h>

#include "grids.h"

static char folder[64];
static const double pi = 3.14159265358979323846;
static const double semi_major = 6378137, flattening = 1 / 298.257223563;

/* ---- Rasters ---- */

typedef struct ground {
    const char *name, *crs;
    double transform[6];
    int width, height;
    tl_raster_type type;
    double wave;  /* samples of the shortest */
    double noise; /* metres */
    int holes;    /* 1: blocks, 2: a third of all samples */
    double height_unit;
    double max_error; /* metres */
} ground;

static const ground grounds[] = {
    {"degrees", "EPSG:4326", {10, 1 / 1200., 0, 47.3, 0, -1 / 1200.}, 300, 200, 0, 30, 2, 0, 1, 3},
    {"points in UTM, in feet", "EPSG:32632", {500000, 30, 0, 5200000, 0, -30}, 200, 150, 1, 20, 1, 0, 0.3048, 2},
    {"a rotated map", "EPSG:32632", {500000, 26, 15, 5200000, 15, -26}, 150, 200, 0, 20, 1, 0, 1, 2},
    {"south up", "EPSG:4326", {-60.5, 0.001, 0, -30.2, 0, 0.001}, 150, 130, 0, 20, 1, 0, 1, 2},
    {"from Paris", "EPSG:4807", {2, 0.001, 0, 50, 0, -0.001}, 100, 100, 0, 20, 1, 0, 1, 2},
    {"across the antimeridian", "EPSG:4326", {179.3, 0.005, 0, -15, 0, -0.005}, 300, 200, 1, 20, 1, 0, 1, 4},
    {"a map across the antimeridian", "EPSG:32601", {337000, 300, 0, 7200000, 0, -300}, 150, 150, 1, 20, 1, 0, 1, 6},
    {"the globe", "EPSG:4326", {-179.5, 1, 0, 89.5, 0, -1}, 360, 180, 0, 40, 20, 0, 1, 500},
    {"the globe by points", "EPSG:4326", {0, 1, 0, 90, 0, -1}, 360, 181, 1, 40, 20, 0, 1, 500},
    {"the globe in an odd width", "EPSG:4326", {-180, 0.96, 0, 89.52, 0, -0.96}, 375, 187, 0, 40, 20, 0, 1, 200},
    {"around the South Pole", "EPSG:3031", {-256000, 4000, 0, 256000, 0, -4000}, 129, 129, 1, 20, 1, 0, 1, 20},
    {"holes", "EPSG:4326", {7, 0.001, 0, 46, 0, -0.001}, 300, 200, 0, 25, 2, 1, 1, 5},
    {"a third of it void", "EPSG:4326", {7, 0.001, 0, 46, 0, -0.001}, 150, 140, 1, 25, 2, 2, 1, 5},
    {"noise, every vertex counts", "EPSG:4326", {7, 0.002, 0, 1.06, 0, -0.002}, 140, 140, 1, 25, 300, 0, 1, .01},
    {"a cell", "EPSG:4326", {7, 0.01, 0, 1, 0, -0.01}, 2, 2, 0, 25, 1, 0, 1, 1},
    {"a row of cells", "EPSG:4326", {7, 0.01, 0, 1, 0, -0.01}, 300, 2, 0, 25, 1, 0, 1, 1},
    {"one tile", "EPSG:4326", {7, 0.01, 0, 1, 0, -0.01}, 65, 65, 0, 25, 1, 0, 1, 1},
    {"one cell more", "EPSG:4326", {7, 0.01, 0, 1, 0, -0.01}, 66, 65, 0, 25, 1, 0, 1, 1},
    {"several blocks", "EPSG:32632", {500000, 30, 0, 5200000, 0, -30}, 1101, 530, 1, 50, 2, 1, 1, 60},
    {"up to the edge of a block", "EPSG:4326", {7, 0.001, 0, 46, 0, -0.001}, 1025, 300, 1, 50, 2, 0, 1, 60},
};
enum { GROUNDS = sizeof grounds / sizeof grounds[0] };

static bool hole(const ground *g, int i, int j)
{
    if (g->holes == 1)
        return (i / 37 + j / 23) % 5 == 0 || (i + 2 * j) % 197 < 6;
    return g->holes == 2 && random_below(3) == 0;
}

static tl_source *open_ground(const ground *g, float **heights)
{
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text(g->crs, g->name, &crs, NULL), TL_OK);
    *heights = malloc((size_t)g->width * (size_t)g->height * sizeof **heights);
    random_state = 5;
    double k = 2 * pi / g->wave, high = 8 * g->wave;
    for (int j = 0; j < g->height; j++)
        for (int i = 0; i < g->width; i++) {
            double z = 500 + high * sin(k * 0.3 * i + 0.2 * k * j) * cos(k * 0.4 * j) + 9 * sin(k * i) * sin(k * j);
            z += g->noise * random_below(1000) / 1000;
            (*heights)[j * g->width + i] = hole(g, i, j) ? NAN : (float)(z / g->height_unit);
        }
    tl_source_info info = {
        .width = g->width, .height = g->height, .type = g->type, .has_voids = g->holes, .name = g->name};
    info.georef = (tl_georef){.crs = crs, .located = true, .height_unit = g->height_unit};
    memcpy(info.georef.transform, g->transform, sizeof g->transform);
    assert_int_equal(dem_georef_measure(&info.georef, g->width, g->height, NULL), TL_OK);
    info.wraps = dem_georef_goes_around(&info.georef, g->width);
    tl_source *source = tl_array_source_create(*heights, &info, NULL);
    assert_non_null(source);
    return source;
}

static void close_ground(tl_source *source, float *heights)
{
    const tl_crs *crs = source->info.georef.crs;
    tl_source_destroy(source);
    tl_crs_release(crs);
    free(heights);
}

static tl_tiles_options options_of(const ground *g)
{
    return (tl_tiles_options){.format = TL_TILES_3D, .max_error = g->max_error};
}

static tl_tiles_report write_tiles(const tl_source *source, const char *to, const tl_tiles_options *options)
{
    tl_error error = {0};
    tl_tiles_report report;
    if (tl_write_terrain_tiles(source, to, options, &report, &error) != TL_OK)
        fail_msg("%s: %s", source->info.name, error.text);
    return report;
}

/* ---- Folders ---- */

static char *name_in(const char *where, const char *name)
{
    char *path = malloc(strlen(where) + strlen(name) + 2);
    sprintf(path, "%s/%s", where, name);
    return path;
}

static unsigned char *read_whole(const char *path, size_t *count)
{
    FILE *file = fopen(path, "rb");
    struct stat status;
    if (!file)
        fail_msg("%s is not there", path);
    assert_int_equal(fstat(fileno(file), &status), 0);
    *count = (size_t)status.st_size;
    unsigned char *bytes = malloc(*count + 1);
    assert_int_equal(fread(bytes, 1, *count + 1, file), *count);
    fclose(file);
    return bytes;
}

/* Calls `visit` for every file below a folder, by its name within it. */
static void walk(const char *root, const char *below, void (*visit)(void *, const char *, const char *), void *context)
{
    char *here = name_in(root, below);
    DIR *directory = opendir(here);
    struct dirent *entry;
    assert_non_null(directory);
    while ((entry = readdir(directory))) {
        if (strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0)
            continue;
        char *inner = name_in(below, entry->d_name), *path = name_in(root, inner);
        struct stat status;
        assert_int_equal(lstat(path, &status), 0);
        if (S_ISDIR(status.st_mode))
            walk(root, inner, visit, context);
        else
            visit(context, path, inner);
        free(path);
        free(inner);
    }
    closedir(directory);
    free(here);
}

static uint64_t mixed(uint64_t sum, const void *bytes, size_t count)
{
    const unsigned char *b = bytes;
    for (size_t k = 0; k < count; k++)
        sum = (sum ^ b[k]) * UINT64_C(1099511628211);
    return sum;
}

static void add_file(void *context, const char *path, const char *name)
{
    size_t count;
    unsigned char *bytes = read_whole(path, &count);
    *(uint64_t *)context += mixed(mixed(UINT64_C(14695981039346656037), name, strlen(name) + 1), bytes, count);
    free(bytes);
}

/* Of names and contents of all files, in whatever order. */
static uint64_t tree_of(const char *where)
{
    uint64_t sum = 0;
    walk(where, ".", add_file, &sum);
    return sum;
}

static void count_contents(void *context, const char *path, const char *name)
{
    (void)path;
    *(size_t *)context += strstr(name, ".glb") != NULL;
}

static void remove_tree(const char *where)
{
    char command[160];
    snprintf(command, sizeof command, "rm -rf '%s'", where);
    assert_int_equal(system(command), 0);
}

/* ---- Subtrees ---- */

typedef struct node {
    int level;
    int64_t x, y;
    double region[6], error;
    bool content;
} node;

typedef struct tree {
    json_t *index;
    node *nodes;
    size_t count;
} tree;

static const node *find_node(const tree *t, int level, int64_t x, int64_t y)
{
    for (size_t k = 0; k < t->count; k++)
        if (t->nodes[k].level == level && t->nodes[k].x == x && t->nodes[k].y == y)
            return &t->nodes[k];
    return NULL;
}

typedef struct subtree {
    unsigned char *bytes;
    json_t *head;
    const unsigned char *body;
} subtree;

static const unsigned char *view_of(const subtree *s, json_t *number, size_t *count)
{
    json_t *view = json_array_get(json_object_get(s->head, "bufferViews"), (size_t)json_integer_value(number));
    size_t offset = (size_t)json_integer_value(json_object_get(view, "byteOffset"));
    assert_int_equal(offset % 8, 0);
    *count = (size_t)json_integer_value(json_object_get(view, "byteLength"));
    return s->body + offset;
}

static bool bit_of(const subtree *s, json_t *availability, int at)
{
    size_t count;
    json_t *constant = json_object_get(availability, "constant");
    if (constant)
        return json_integer_value(constant);
    const unsigned char *bits = view_of(s, json_object_get(availability, "bitstream"), &count);
    assert_in_range(at / 8, 0, count - 1);
    return bits[at / 8] >> at % 8 & 1;
}

static int64_t unzip_bits(int morton)
{
    int64_t out = 0;
    for (int bit = 0; bit < 8; bit++)
        out |= (int64_t)(morton >> 2 * bit & 1) << bit;
    return out;
}

static void open_subtree(subtree *s, const char *where, int level, int64_t x, int64_t y)
{
    char name[96];
    uint64_t sizes[2];
    size_t count;
    snprintf(name, sizeof name, "subtrees/%d/%lld/%lld.subtree", level, (long long)x, (long long)y);
    char *path = name_in(where, name);
    s->bytes = read_whole(path, &count);
    free(path);
    assert_memory_equal(s->bytes, "subt\1\0\0\0", 8);
    memcpy(sizes, s->bytes + 8, sizeof sizes);
    assert_int_equal(24 + sizes[0] + sizes[1], count);
    s->head = json_loadb((const char *)s->bytes + 24, sizes[0], 0, NULL);
    assert_non_null(s->head);
    s->body = s->bytes + 24 + sizes[0];
}

static void read_subtree(tree *t, const char *where, int level, int64_t x, int64_t y)
{
    enum { LEVELS = 5 };
    subtree s;
    size_t count, seen = 0;
    open_subtree(&s, where, level, x, y);
    json_t *properties = json_object_get(json_array_get(json_object_get(s.head, "propertyTables"), 0), "properties");
    const unsigned char *regions =
        view_of(&s, json_object_get(json_object_get(properties, "region"), "values"), &count);
    const unsigned char *errors =
        view_of(&s, json_object_get(json_object_get(properties, "geometricError"), "values"), &count);
    json_t *contents = json_array_get(json_object_get(s.head, "contentAvailability"), 0);
    for (int below = 0, at = 0; below < LEVELS; at += 1 << 2 * below, below++)
        for (int m = 0; m < 1 << 2 * below; m++) {
            bool content = bit_of(&s, contents, at + m);
            if (!bit_of(&s, json_object_get(s.head, "tileAvailability"), at + m)) {
                assert_false(content);
                continue;
            }
            t->nodes = realloc(t->nodes, (t->count + 1) * sizeof *t->nodes);
            node *n = &t->nodes[t->count++];
            *n = (node){.level = level + below,
                        .x = (x << below) + unzip_bits(m),
                        .y = (y << below) + unzip_bits(m >> 1),
                        .content = content};
            memcpy(n->region, regions + 48 * seen, 48);
            memcpy(&n->error, errors + 8 * seen++, 8);
        }
    assert_int_equal(8 * seen, count);
    for (int m = 0; m < 1 << 2 * LEVELS; m++)
        if (bit_of(&s, json_object_get(s.head, "childSubtreeAvailability"), m))
            read_subtree(t, where, level + LEVELS, (x << LEVELS) + unzip_bits(m), (y << LEVELS) + unzip_bits(m >> 1));
    json_decref(s.head);
    free(s.bytes);
}

static void open_tree(tree *t, const char *where)
{
    char *path = name_in(where, "tileset.json");
    *t = (tree){.index = json_load_file(path, 0, NULL)};
    free(path);
    assert_non_null(t->index);
    read_subtree(t, where, 0, 0, 0);
}

static void close_tree(tree *t)
{
    json_decref(t->index);
    free(t->nodes);
}

/* ---- Contents ---- */

typedef struct content {
    size_t vertices, triangles;
    double (*at)[3];     /* metres in the axes of the Earth */
    double (*place)[3];  /* longitude and latitude (radians), height */
    double (*sample)[2]; /* column and row of the source */
    int8_t (*normal)[4];
    uint32_t *corners;
    bool *ground; /* vertices of triangles that do not stand upright */
    double quantum;
} content;

static json_t *member(json_t *of, const char *list, size_t number)
{
    return json_array_get(json_object_get(of, list), number);
}

static const unsigned char *accessor_of(json_t *head, const unsigned char *body, size_t number, size_t *count,
                                        size_t *stride)
{
    json_t *accessor = member(head, "accessors", number);
    json_t *view = member(head, "bufferViews", (size_t)json_integer_value(json_object_get(accessor, "bufferView")));
    json_t *step = json_object_get(view, "byteStride");
    int type = (int)json_integer_value(json_object_get(accessor, "componentType"));
    *count = (size_t)json_integer_value(json_object_get(accessor, "count"));
    *stride = step ? (size_t)json_integer_value(step) : type == 5125 ? 4 : 2;
    return body + json_integer_value(json_object_get(view, "byteOffset"));
}

/* Longitude, latitude, height: by iteration, which is exact to a nanometre far from the Earth's centre. */
static void to_place(const double at[3], double out[3])
{
    const double e2 = flattening * (2 - flattening);
    double r = hypot(at[0], at[1]), latitude = atan2(at[2], r * (1 - e2));
    for (int k = 0; k < 4; k++) { /* each adds two digits and more */
        double s = sin(latitude), n = semi_major / sqrt(1 - e2 * s * s);
        latitude = atan2(at[2] + e2 * n * s, r);
    }
    double s = sin(latitude);
    out[0] = atan2(at[1], at[0]);
    out[1] = latitude;
    out[2] = r * cos(latitude) + at[2] * s - semi_major * sqrt(1 - e2 * s * s);
}

static void to_earth(const double place[3], double out[3], double up[3])
{
    const double e2 = flattening * (2 - flattening), s = sin(place[1]), c = cos(place[1]);
    double n = semi_major / sqrt(1 - e2 * s * s);
    up[0] = c * cos(place[0]), up[1] = c * sin(place[0]), up[2] = s;
    out[0] = (n + place[2]) * up[0];
    out[1] = (n + place[2]) * up[1];
    out[2] = (n * (1 - e2) + place[2]) * s;
}

/* Samples from places. */
typedef struct locator {
    const tl_source *source;
    dem_projection *projection;
    double meridian;
} locator;

static void locate(const locator *l, const double place[3], double near, double out[2])
{
    const double *t = l->source->info.georef.transform;
    double x = place[0] * 180 / pi - l->meridian, y = place[1] * 180 / pi;
    dem_projection_from_lonlat(l->projection, 1, &x, &y);
    if (tl_crs_is_geographic(l->source->info.georef.crs))
        x -= 360 * rint((x - (t[0] + t[1] * near)) / 360);
    double whole = t[1] * t[5] - t[2] * t[4];
    x -= t[0], y -= t[3];
    out[0] = (t[5] * x - t[2] * y) / whole;
    out[1] = (t[1] * y - t[4] * x) / whole;
}

static void take_vertices(content *c, json_t *head, const unsigned char *body)
{
    size_t stride, normals;
    const unsigned char *positions = accessor_of(head, body, 0, &c->vertices, &stride);
    const unsigned char *directions = accessor_of(head, body, 1, &normals, &stride);
    json_t *matrix = json_object_get(member(head, "nodes", 0), "matrix");
    double m[16];
    assert_int_equal(normals, c->vertices);
    for (size_t k = 0; k < 16; k++)
        m[k] = json_number_value(json_array_get(matrix, k));
    c->quantum = m[0];
    assert_true(m[0] == m[5] && m[0] == m[10] && frexp(m[0], &(int){0}) == 0.5);
    c->at = calloc(c->vertices, sizeof *c->at);
    c->place = calloc(c->vertices, sizeof *c->place);
    c->sample = calloc(c->vertices, sizeof *c->sample);
    c->normal = calloc(c->vertices, sizeof *c->normal);
    c->ground = calloc(c->vertices, sizeof *c->ground);
    for (size_t k = 0; k < c->vertices; k++) {
        uint16_t p[3];
        memcpy(p, positions + 8 * k, sizeof p);
        memcpy(c->normal[k], directions + 4 * k, 4);
        c->at[k][0] = m[12] + m[0] * p[0];
        c->at[k][2] = m[13] + m[0] * p[1];
        c->at[k][1] = -(m[14] + m[0] * p[2]);
        to_place(c->at[k], c->place[k]);
    }
}

/* Skirts stand upright, but for the rounding of their ends: seen from above they are at most two steps wide. */
static bool is_ground(const content *c, const uint32_t *v)
{
    double earth[3], up[3], twice = 0, longest = 0, e[3][3];
    to_earth(c->place[v[0]], earth, up);
    for (int k = 0; k < 3; k++) {
        double rise = 0, length = 0;
        for (int a = 0; a < 3; a++)
            rise += (c->at[v[(k + 1) % 3]][a] - c->at[v[k]][a]) * up[a];
        for (int a = 0; a < 3; a++) {
            e[k][a] = c->at[v[(k + 1) % 3]][a] - c->at[v[k]][a] - rise * up[a];
            length += e[k][a] * e[k][a];
        }
        longest = fmax(longest, length);
    }
    for (int a = 0; a < 3; a++)
        twice += (e[0][(a + 1) % 3] * e[1][(a + 2) % 3] - e[0][(a + 2) % 3] * e[1][(a + 1) % 3]) * up[a];
    return twice > 3 * c->quantum * sqrt(longest);
}

/* near: a column close to the tile, of rasters that go around. */
static void open_content(content *c, const char *where, const node *n, const locator *l, double near)
{
    char name[96];
    size_t count, stride;
    snprintf(name, sizeof name, "content/%d/%lld/%lld.glb", n->level, (long long)n->x, (long long)n->y);
    char *path = name_in(where, name);
    unsigned char *bytes = read_whole(path, &count);
    uint32_t text;
    free(path);
    memcpy(&text, bytes + 12, sizeof text);
    json_t *head = json_loadb((const char *)bytes + 20, text, 0, NULL);
    assert_non_null(head);
    *c = (content){0};
    take_vertices(c, head, bytes + 28 + text);
    const unsigned char *indices = accessor_of(head, bytes + 28 + text, 2, &count, &stride);
    c->triangles = count / 3;
    c->corners = calloc(count, sizeof *c->corners);
    for (size_t k = 0; k < count; k++)
        memcpy(&c->corners[k], indices + stride * k, stride);
    for (size_t k = 0; k < c->vertices; k++)
        locate(l, c->place[k], near, c->sample[k]);
    for (size_t k = 0; k < count; k++)
        if (is_ground(c, c->corners + k / 3 * 3))
            c->ground[c->corners[k]] = true;
    json_decref(head);
    free(bytes);
}

static void close_content(content *c)
{
    free(c->at);
    free(c->place);
    free(c->sample);
    free(c->normal);
    free(c->corners);
    free(c->ground);
}

/* ---- The pyramids of all grounds, made once ---- */

static struct pyramid {
    float *heights;
    tl_source *source;
    char *where;
    tl_tiles_report report;
    tree tree;
    locator locator;
} pyramids[GROUNDS];

static const struct pyramid *pyramid_of(int k)
{
    struct pyramid *p = &pyramids[k];
    if (p->source)
        return p;
    char name[16];
    snprintf(name, sizeof name, "ground-%d", k);
    p->source = open_ground(&grounds[k], &p->heights);
    const tl_tiles_options options = options_of(&grounds[k]);
    p->where = name_in(folder, name);
    p->report = write_tiles(p->source, p->where, &options);
    assert_true(p->report.complete);
    open_tree(&p->tree, p->where);
    p->locator = (locator){p->source, dem_projection_create(p->source->info.georef.crs, NULL),
                           dem_crs_prime_meridian(p->source->info.georef.crs)};
    return p;
}

static void remove_pyramids(void)
{
    for (int k = 0; k < GROUNDS; k++)
        if (pyramids[k].source) {
            remove_tree(pyramids[k].where);
            dem_projection_destroy(pyramids[k].locator.projection);
            close_tree(&pyramids[k].tree);
            close_ground(pyramids[k].source, pyramids[k].heights);
            free(pyramids[k].where);
        }
}

static double middle_of(const struct pyramid *p, const node *n)
{
    return ((double)n->x + 0.5) * (double)((int64_t)64 << (p->report.last_level - n->level));
}

/* ---- Volumes ---- */

static void subtreesTellWhichContentsThereAre(void **state)
{
    (void)state;
    for (int g = 0; g < GROUNDS; g++) {
        const struct pyramid *p = pyramid_of(g);
        size_t files = 0, told = 0;
        walk(p->where, ".", count_contents, &files);
        for (size_t k = 0; k < p->tree.count; k++) {
            const node *n = &p->tree.nodes[k];
            char name[96];
            snprintf(name, sizeof name, "content/%d/%lld/%lld.glb", n->level, (long long)n->x, (long long)n->y);
            char *path = name_in(p->where, name);
            assert_int_equal(access(path, F_OK) == 0, n->content);
            free(path);
            told += n->content;
            assert_in_range(n->level, 0, p->report.last_level);
        }
        assert_int_equal(files, told);
        assert_true(told > 0);
    }
}

/* By how much the eastern end lies behind the western one. */
static double turn(double from, double to)
{
    double way = fmod(to - from, 2 * pi);
    return way < 0 ? way + 2 * pi : way;
}

static double width_of(const double region[6])
{
    return region[2] - region[0] >= 2 * pi ? 2 * pi : turn(region[0], region[2]);
}

static void regionsHoldThoseOfTheirChildrenAndErrorsFall(void **state)
{
    (void)state;
    for (int g = 0; g < GROUNDS; g++) {
        const struct pyramid *p = pyramid_of(g);
        for (size_t k = 0; k < p->tree.count; k++) {
            const node *n = &p->tree.nodes[k];
            const double *r = n->region;
            assert_true(fabs(r[0]) <= pi && fabs(r[2]) <= pi && fabs(r[1]) <= pi / 2 && fabs(r[3]) <= pi / 2);
            assert_true(r[1] < r[3] && r[4] < r[5] && n->error > 0);
            if (!n->level)
                continue;
            const node *parent = find_node(&p->tree, n->level - 1, n->x / 2, n->y / 2);
            assert_non_null(parent);
            const double *q = parent->region, tiny = 1e-12; /* turns are subtracted */
            assert_true(n->error <= parent->error);
            assert_true(q[1] <= r[1] && q[3] >= r[3] && q[4] <= r[4] && q[5] >= r[5]);
            assert_true(width_of(q) >= 2 * pi || turn(q[0] - tiny, r[0]) + width_of(r) <= width_of(q) + 2 * tiny);
        }
    }
}

static void expect_inside(const double region[6], const double at[3], const char *name)
{
    double place[3];
    to_place(at, place);
    const double tiny = 1e-14; /* radians: what to_place rounds by; heights to a micrometre */
    bool along = width_of(region) >= 2 * pi || turn(region[0] - tiny, place[0]) <= width_of(region) + 2 * tiny;
    bool upright = place[2] >= region[4] - 1e-6 && place[2] <= region[5] + 1e-6;
    if (!along || !upright || place[1] < region[1] - tiny || place[1] > region[3] + tiny)
        fail_msg("%s: %.9f %.9f %.3f is not in its region %.9f %.9f %.9f %.9f %.3f %.3f", name, place[0], place[1],
                 place[2], region[0], region[1], region[2], region[3], region[4], region[5]);
}

/* Corners, and places between them on every triangle: those are what bulges out. */
static void regionsHoldTheirContents(void **state)
{
    (void)state;
    static const double weights[][3] = {{1, 0, 0}, {.5, .5, 0}, {0, .5, .5}, {.5, 0, .5}, {1 / 3., 1 / 3., 1 / 3.}};
    for (int g = 0; g < GROUNDS; g++) {
        const struct pyramid *p = pyramid_of(g);
        for (size_t k = 0; k < p->tree.count; k++) {
            content c;
            if (!p->tree.nodes[k].content)
                continue;
            open_content(&c, p->where, &p->tree.nodes[k], &p->locator, 0);
            for (size_t t = 0; t < c.triangles; t++)
                for (size_t w = 0; w < sizeof weights / sizeof *weights; w++) {
                    double at[3] = {0, 0, 0};
                    for (int corner = 0; corner < 3; corner++)
                        for (int a = 0; a < 3; a++)
                            at[a] += weights[w][corner] * c.at[c.corners[3 * t + (size_t)corner]][a];
                    expect_inside(p->tree.nodes[k].region, at, grounds[g].name);
                }
            close_content(&c);
        }
    }
}

static void acrossTheAntimeridianTheEastIsLessThanTheWest(void **state)
{
    (void)state;
    for (int g = 0; g < GROUNDS; g++)
        if (strstr(grounds[g].name, "antimeridian")) {
            const double *r = pyramid_of(g)->tree.nodes[0].region;
            assert_true(r[0] > 3 && r[2] < -3);
        }
}

/* ---- Errors ---- */

typedef struct cover {
    const struct pyramid *p;
    unsigned char *seen; /* by sample */
    double worst;
} cover;

/* How far a sample is from a triangle, along the vertical; NAN where it is not over or under it; *beside: nor at its
 * rim. */
static double offset_of(const content *c, const uint32_t *v, const double at[3], const double up[3], bool *beside)
{
    double e[2][3], d[3], n[3], q[3], det = 0, u = 0, w = 0, t = 0;
    for (int a = 0; a < 3; a++) {
        e[0][a] = c->at[v[1]][a] - c->at[v[0]][a];
        e[1][a] = c->at[v[2]][a] - c->at[v[0]][a];
        d[a] = at[a] - c->at[v[0]][a];
    }
    for (int a = 0; a < 3; a++) { /* Moeller and Trumbore */
        int b = (a + 1) % 3, f = (a + 2) % 3;
        n[a] = up[b] * e[1][f] - up[f] * e[1][b];
        q[a] = d[b] * e[0][f] - d[f] * e[0][b];
    }
    for (int a = 0; a < 3; a++) {
        det += e[0][a] * n[a];
        u += d[a] * n[a];
        w += up[a] * q[a];
        t += e[1][a] * q[a];
    }
    u /= det, w /= det, t /= det;
    double least = fmin(fmin(u, w), 1 - u - w), across = 0, longest = 0;
    for (int a = 0; a < 3; a++) {
        double edge = e[1][a] - e[0][a];
        across += pow(e[0][(a + 1) % 3] * e[1][(a + 2) % 3] - e[0][(a + 2) % 3] * e[1][(a + 1) % 3], 2);
        longest += fmax(fmax(e[0][a] * e[0][a], e[1][a] * e[1][a]), edge * edge);
    }
    /* rounding moves the rim by less than a step, and parallels and maps bend away from flat edges: up to 70 degrees by
     * less than three times what the Earth does */
    double beyond = c->quantum + 3 * longest / (8 * semi_major);
    *beside = least < -beyond * sqrt(longest / across);
    return least >= 0 ? fabs(t) : (double)NAN;
}

static void compare_sample(cover *o, const content *c, const uint32_t *v, int i, int j)
{
    const tl_source_info *info = &o->p->source->info;
    const double *t = info->georef.transform;
    int column = info->wraps ? (i % (int)info->width + (int)info->width) % (int)info->width : i;
    if (column < 0 || j < 0 || column >= info->width || j >= info->height)
        return;
    double z = (double)o->p->heights[j * info->width + column], at[3], up[3];
    double place[3] = {t[0] + t[1] * i + t[2] * j, t[3] + t[4] * i + t[5] * j, z * info->georef.height_unit};
    dem_projection_to_lonlat(o->p->locator.projection, 1, &place[0], &place[1]);
    place[0] = (place[0] + o->p->locator.meridian) * pi / 180;
    place[1] *= pi / 180;
    to_earth(place, at, up);
    if (isnan(z))
        return;
    bool beside;
    double off = offset_of(c, v, at, up, &beside);
    o->seen[j * info->width + column] |= !beside;
    o->worst = off > o->worst ? off : o->worst;
}

static void compare_triangle(cover *o, const content *c, const uint32_t *v)
{
    double low[2] = {HUGE_VAL, HUGE_VAL}, high[2] = {-HUGE_VAL, -HUGE_VAL};
    for (int k = 0; k < 3; k++)
        for (int a = 0; a < 2; a++) {
            low[a] = fmin(low[a], c->sample[v[k]][a]);
            high[a] = fmax(high[a], c->sample[v[k]][a]);
        }
    for (int j = (int)ceil(low[1] - 0.01); j <= high[1] + 0.01; j++)
        for (int i = (int)ceil(low[0] - 0.01); i <= high[0] + 0.01; i++)
            compare_sample(o, c, v, i, j);
}

/* At a pole, longitudes have no meaning. */
static bool at_pole(const struct pyramid *p)
{
    return p->source->info.wraps;
}

static void everySampleIsWithinTheErrorOfItsTiles(void **state)
{
    (void)state;
    for (int g = 0; g < GROUNDS; g++) {
        const struct pyramid *p = pyramid_of(g);
        size_t samples = (size_t)grounds[g].width * (size_t)grounds[g].height;
        if (at_pole(p))
            continue;
        /* of large ones the deepest, which is drawn from the samples, and one that is drawn from pieces */
        for (int level = p->report.last_level; level >= 0; level -= samples > 200000 ? 3 : 1) {
            cover o = {p, calloc(samples, 1), 0};
            for (size_t k = 0; k < p->tree.count; k++) {
                const node *n = &p->tree.nodes[k];
                content c;
                if (n->level != level || !n->content)
                    continue;
                open_content(&c, p->where, n, &p->locator, middle_of(p, n));
                o.worst = 0;
                for (size_t t = 0; t < c.triangles; t++)
                    if (is_ground(&c, c.corners + 3 * t))
                        compare_triangle(&o, &c, c.corners + 3 * t);
                if (o.worst > n->error)
                    fail_msg("%s: tile %d/%lld/%lld is %g m off, and tells %g", grounds[g].name, level, (long long)n->x,
                             (long long)n->y, o.worst, n->error);
                close_content(&c);
            }
            for (size_t k = 0; k < samples && !grounds[g].holes; k++)
                if (!o.seen[k])
                    fail_msg("%s: sample %zu is under no triangle of level %d", grounds[g].name, k, level);
            free(o.seen);
        }
    }
}

/* ---- Edges ---- */

/* Whether b has all the ground's vertices of a that lie on their common edge, at the same place with the same normal.
 */
static size_t expect_shared(const content *a, const content *b, int axis, double edge, bool holes, const char *name)
{
    size_t shared = 0, count = 0, *border = calloc(b->vertices, sizeof *border);
    for (size_t k = 0; k < b->vertices; k++)
        if (b->ground[k] && fabs(b->sample[k][axis] - edge) <= 0.02)
            border[count++] = k;
    for (size_t k = 0; k < a->vertices; k++) {
        if (!a->ground[k] || fabs(a->sample[k][axis] - edge) > 0.02)
            continue;
        size_t at = 0;
        while (at < count && fabs(a->sample[k][!axis] - b->sample[border[at]][!axis]) > 0.02)
            at++;
        size_t other = at < count ? border[at] : b->vertices;
        if (other == b->vertices && holes)
            continue;
        if (other == b->vertices || memcmp(a->at[k], b->at[other], sizeof *a->at) != 0 ||
            memcmp(a->normal[k], b->normal[other], 3) != 0)
            fail_msg("%s: a vertex at %f, %f is not its neighbour's", name, a->sample[k][0], a->sample[k][1]);
        shared++;
    }
    free(border);
    return shared;
}

static void neighboursShareTheirEdgesAndNormals(void **state)
{
    (void)state;
    size_t shared = 0, pairs = 0;
    for (int g = 0; g < GROUNDS; g++) {
        const struct pyramid *p = pyramid_of(g);
        const double *t = grounds[g].transform;
        bool turned = t[1] * t[5] - t[2] * t[4] < 0;
        for (size_t k = 0; k < p->tree.count && !at_pole(p); k++)
            for (int axis = 0; axis < 2; axis++) {
                const node *n = &p->tree.nodes[k], *m = find_node(&p->tree, n->level, n->x + !axis, n->y + axis);
                content a, b;
                bool large = grounds[g].width > 1000 && n->level == p->report.last_level;
                if (!m || !n->content || !m->content || (large && (n->x + 3 * n->y) % 5))
                    continue;
                int64_t cells = (int64_t)64 << (p->report.last_level - n->level);
                double edge = (double)((axis ? m->y : m->x) * cells);
                if (axis && turned)
                    edge = grounds[g].height - 1 - edge;
                open_content(&a, p->where, n, &p->locator, middle_of(p, n));
                open_content(&b, p->where, m, &p->locator, middle_of(p, n));
                if (a.quantum == b.quantum) {
                    shared += expect_shared(&a, &b, axis, edge, grounds[g].holes, grounds[g].name);
                    shared += expect_shared(&b, &a, axis, edge, grounds[g].holes, grounds[g].name);
                    pairs++;
                }
                close_content(&a);
                close_content(&b);
            }
    }
    assert_true(pairs > 100 && shared > 2 * pairs); /* each has the two ends of an edge, twice */
}

/* The column at which a raster goes around, as a tile has it: heights of the ground by row, and of the ends of skirts.
 */
typedef struct rim {
    double row[1024], z[1024];
    size_t count;
} rim;

static void add_to_rim(rim *r, double row, double z)
{
    size_t at = r->count++;
    assert_true(r->count < 1024);
    for (; at > 0 && r->row[at - 1] > row; at--)
        r->row[at] = r->row[at - 1], r->z[at] = r->z[at - 1];
    r->row[at] = row, r->z[at] = z;
}

static void find_rims(const content *c, double column, rim *land, rim *ends)
{
    *land = *ends = (rim){.count = 0};
    for (size_t k = 0; k < c->vertices; k++)
        if (fabs(c->sample[k][0] - column) <= 0.02 && fabs(c->place[k][1]) < 1.56) /* not at a pole */
            add_to_rim(c->ground[k] ? land : ends, c->sample[k][1], c->place[k][2]);
}

static double height_on(const rim *r, double row)
{
    size_t k = 1;
    while (k + 1 < r->count && r->row[k] < row)
        k++;
    double f = fmin(fmax((row - r->row[k - 1]) / (r->row[k] - r->row[k - 1]), 0), 1);
    return r->z[k - 1] + f * (r->z[k] - r->z[k - 1]);
}

/* Whether skirts under one side's rim reach down to the other's ground, everywhere along it. */
static void expect_covered(const rim *land, const rim *ends, const rim *other, double quantum, const char *name)
{
    assert_true(land->count > 1 && ends->count == land->count && other->count > 1);
    for (size_t k = 0; k < ends->count; k++) {
        assert_true(fabs(ends->row[k] - land->row[k]) < 0.04 && ends->z[k] < land->z[k]);
        double there = height_on(other, ends->row[k]);
        if (ends->z[k] > there + 2 * quantum)
            fail_msg("%s: at row %g a skirt ends at %g m, over the other side's %g", name, ends->row[k], ends->z[k],
                     there);
    }
}

static void skirtsCloseTheSeamOfTheGlobe(void **state)
{
    (void)state;
    size_t pairs = 0;
    for (int g = 0; g < GROUNDS; g++) {
        const struct pyramid *p = pyramid_of(g);
        for (size_t k = 0; k < p->tree.count && p->source->info.wraps; k++) {
            const node *n = &p->tree.nodes[k], *m;
            int64_t cells = (int64_t)64 << (p->report.last_level - n->level);
            m = find_node(&p->tree, n->level, (grounds[g].width - 1) / cells, n->y);
            if (n->x || !n->content || !m || !m->content)
                continue;
            content west, east;
            rim grounds_of[2], ends_of[2];
            open_content(&west, p->where, n, &p->locator, 0);
            open_content(&east, p->where, m, &p->locator, grounds[g].width);
            find_rims(&west, 0, &grounds_of[0], &ends_of[0]);
            find_rims(&east, grounds[g].width, &grounds_of[1], &ends_of[1]);
            double quantum = fmax(west.quantum, east.quantum);
            expect_covered(&grounds_of[0], &ends_of[0], &grounds_of[1], quantum, grounds[g].name);
            expect_covered(&grounds_of[1], &ends_of[1], &grounds_of[0], quantum, grounds[g].name);
            close_content(&west);
            close_content(&east);
            pairs++;
        }
    }
    assert_true(pairs >= 15); /* of three globes */
}

/* ---- The same bytes ---- */

static int numbered(const char *name)
{
    int k = 0;
    while (strcmp(grounds[k].name, name) != 0)
        k++;
    return k;
}

static uint64_t tree_by(const tl_source *source, const tl_tiles_options *base, unsigned threads, unsigned shards)
{
    const tl_run run = {.threads = threads};
    tl_tiles_options options = *base;
    char *where = name_in(folder, "same");
    options.run = &run;
    options.shards = shards;
    for (unsigned k = 0; k < shards; k++) { /* 5 and 7 have no common divisor, 5 and 2 neither: all, out of order */
        options.shard = (5 * k + 3) % shards;
        assert_false(write_tiles(source, where, &options).complete);
    }
    options.shards = options.shard = 0;
    options.finish = shards > 0;
    assert_true(write_tiles(source, where, &options).complete);
    uint64_t sum = tree_of(where);
    remove_tree(where);
    free(where);
    return sum;
}

static void threadsAndShardsDoNotChangeAByte(void **state)
{
    (void)state;
    const struct pyramid *p = pyramid_of(numbered("several blocks"));
    tl_tiles_options options = options_of(&grounds[numbered("several blocks")]);
    uint64_t sum = tree_by(p->source, &options, 1, 0);
    assert_true(sum == tree_of(p->where));
    assert_true(sum == tree_by(p->source, &options, 3, 0));
    assert_true(sum == tree_by(p->source, &options, 2, 7));
    p = pyramid_of(numbered("degrees"));
    options = options_of(&grounds[numbered("degrees")]);
    options.textures = TL_TEXTURE_COLOUR | TL_TEXTURE_NORMAL;
    options.coding = TL_CODING_COMPRESSED;
    sum = tree_by(p->source, &options, 1, 0);
    assert_true(sum == tree_by(p->source, &options, 2, 2));
}

/* Does away with or cuts some files, tiles and pieces alike, but not what tells the job. */
static void damage(void *context, const char *path, const char *name)
{
    int *count = context;
    size_t bytes;
    if (strstr(name, "job.json"))
        return;
    int kind = (*count)++ % 14;
    unsigned char *data = read_whole(path, &bytes);
    if (kind == 3)
        assert_int_equal(unlink(path), 0);
    if (kind == 7)
        assert_int_equal(truncate(path, (off_t)bytes / 2), 0);
    if (kind == 11) {
        FILE *file = fopen(path, "r+b");
        fseek(file, (long)(bytes * 2 / 3), SEEK_SET);
        fputc(data[bytes * 2 / 3] ^ 4, file);
        fclose(file);
    }
    free(data);
}

static void resumingMendsWhatIsMissingOrBroken(void **state)
{
    (void)state;
    const int g = numbered("several blocks");
    const struct pyramid *p = pyramid_of(g);
    int count = 0;
    tl_tiles_options options = options_of(&grounds[g]);
    char *where = name_in(folder, "mended");
    options.shards = 1; /* all blocks of the deepest lattice, and their pieces */
    write_tiles(p->source, where, &options);
    walk(where, ".", damage, &count);
    options.shards = 0;
    options.resume = true;
    assert_true(write_tiles(p->source, where, &options).complete);
    assert_true(tree_of(p->where) == tree_of(where));
    assert_true(write_tiles(p->source, where, &options).complete); /* once more does no harm */
    assert_true(tree_of(p->where) == tree_of(where));
    remove_tree(where);
    free(where);
}

/* ---- Codings ---- */

static void compressedPositionsAreTheSame(void **state)
{
    (void)state;
    const int g = numbered("holes");
    const struct pyramid *p = pyramid_of(g);
    tl_tiles_options options = options_of(&grounds[g]);
    options.coding = TL_CODING_COMPRESSED;
    char *where = name_in(folder, "compressed"), *paths[2];
    write_tiles(p->source, where, &options);
    paths[0] = name_in(p->where, "content/0/0/0.glb");
    paths[1] = name_in(where, "content/0/0/0.glb");
    unsigned char *bytes[2], *decoded = NULL;
    const unsigned char *plain = NULL;
    size_t count = 0, stride, size;
    json_t *heads[2];
    for (int k = 0; k < 2; k++) {
        uint32_t text;
        bytes[k] = read_whole(paths[k], &size);
        memcpy(&text, bytes[k] + 12, sizeof text);
        heads[k] = json_loadb((const char *)bytes[k] + 20, text, 0, NULL);
        const unsigned char *body = bytes[k] + 28 + text;
        if (!k) {
            plain = accessor_of(heads[k], body, 0, &count, &stride);
            continue;
        }
        json_t *packed = json_object_get(json_object_get(member(heads[k], "bufferViews", 0), "extensions"),
                                         "EXT_meshopt_compression");
        decoded = malloc(8 * count);
        assert_int_equal(json_integer_value(json_object_get(packed, "count")), count);
        assert_int_equal(meshopt_decodeVertexBuffer(decoded, count, 8,
                                                    body + json_integer_value(json_object_get(packed, "byteOffset")),
                                                    (size_t)json_integer_value(json_object_get(packed, "byteLength"))),
                         0);
    }
    assert_memory_equal(plain, decoded, 8 * count);
    for (int k = 0; k < 2; k++) {
        json_decref(heads[k]);
        free(bytes[k]);
        free(paths[k]);
    }
    free(decoded);
    remove_tree(where);
    free(where);
}

/* ---- Refusals ---- */

static void expect_refused(const ground *g, const tl_tiles_options *options, const char *word)
{
    float *heights;
    tl_error error = {0};
    tl_tiles_report report;
    tl_source *source = open_ground(g, &heights);
    char *where = name_in(folder, "refused");
    assert_true(tl_write_terrain_tiles(source, where, options, &report, &error) != TL_OK);
    if (!strstr(error.text, word))
        fail_msg("%s: '%s' does not speak of '%s'", g->name, error.text, word);
    free(where);
    close_ground(source, heights);
}

static void whatHasNoCellsIsRefused(void **state)
{
    (void)state;
    ground g = grounds[numbered("a cell")];
    tl_tiles_options options = options_of(&g);
    g.width = 1;
    expect_refused(&g, &options, "2 x 2");
    g.height = 1;
    expect_refused(&g, &options, "2 x 2");
    g = grounds[numbered("degrees")];
    options.last_level = 7;
    options.last_level_given = true;
    expect_refused(&g, &options, "--extra-levels");
}

static void otherJobsAreRefused(void **state)
{
    (void)state;
    const int g = numbered("holes");
    const struct pyramid *p = pyramid_of(g);
    tl_error error = {0};
    tl_tiles_report report;
    tl_tiles_options options = options_of(&grounds[g]);
    options.resume = true;
    options.coding = TL_CODING_COMPRESSED;
    assert_true(tl_write_terrain_tiles(p->source, p->where, &options, &report, &error) != TL_OK);
    options = options_of(&grounds[g]);
    assert_true(tl_write_terrain_tiles(p->source, p->where, &options, &report, &error) != TL_OK);
    options.resume = true;
    assert_int_equal(tl_write_terrain_tiles(p->source, p->where, &options, &report, &error), TL_OK);
}

/* Levels that are not asked for have no contents, but lead to those that are. */
static void levelsAboveTheFirstHaveNoContents(void **state)
{
    (void)state;
    const int g = numbered("degrees");
    const struct pyramid *p = pyramid_of(g);
    tl_tiles_options options = options_of(&grounds[g]);
    tree t;
    options.first_level = 2;
    char *where = name_in(folder, "lower");
    write_tiles(p->source, where, &options);
    open_tree(&t, where);
    assert_int_equal(t.count, p->tree.count);
    for (size_t k = 0; k < t.count; k++)
        assert_int_equal(t.nodes[k].content, t.nodes[k].level >= 2);
    close_tree(&t);
    remove_tree(where);
    free(where);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(subtreesTellWhichContentsThereAre),
        cmocka_unit_test(regionsHoldThoseOfTheirChildrenAndErrorsFall),
        cmocka_unit_test(regionsHoldTheirContents),
        cmocka_unit_test(acrossTheAntimeridianTheEastIsLessThanTheWest),
        cmocka_unit_test(everySampleIsWithinTheErrorOfItsTiles),
        cmocka_unit_test(neighboursShareTheirEdgesAndNormals),
        cmocka_unit_test(skirtsCloseTheSeamOfTheGlobe),
        cmocka_unit_test(threadsAndShardsDoNotChangeAByte),
        cmocka_unit_test(resumingMendsWhatIsMissingOrBroken),
        cmocka_unit_test(compressedPositionsAreTheSame),
        cmocka_unit_test(whatHasNoCellsIsRefused),
        cmocka_unit_test(otherJobsAreRefused),
        cmocka_unit_test(levelsAboveTheFirstHaveNoContents),
    };
    const char *base = getenv("TMPDIR");
    snprintf(folder, sizeof folder, "%.40s/talus-tiles3d-XXXXXX", base ? base : "/tmp");
    if (!mkdtemp(folder))
        return 1;
    int failed = cmocka_run_group_tests(tests, NULL, NULL);
    remove_pyramids();
    remove_tree(folder);
    return failed;
}
