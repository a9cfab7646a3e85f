/* Pyramids of tiles: edges that neighbours share, bounds that hold at every sample, the same bytes from any threads and
 * shards and after any break. Tiles are read by a decoder of the test's own. */
#include "dem/crs.h"
#include "lib/scene/geodetic.h"
#include "lib/talus.h"

#include <libdeflate.h>

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

/* ---- Rasters ---- */

typedef struct ground {
    const char *name, *crs;
    double transform[6];
    int width, height;
    tl_raster_type type;
    double wave;  /* samples of the shortest */
    double noise; /* metres */
    double offset;
    int holes; /* 1: blocks, 2: a third of all samples, 3: all but few */
    double height_unit;
    double max_error; /* metres */
    int last_level;   /* 0: chosen */
} ground;

static const ground grounds[] = {
    {"several blocks", "EPSG:4326", {10, 1 / 1800., 0, 47.3, 0, -1 / 1800.}, 700, 400, 0, 30, 2, 800, 0, 1, 5, 0},
    {"points in UTM, in feet", "EPSG:32632", {500000, 30, 0, 5200000, 0, -30}, 400, 300, 1, 20, 1, 0, 0, 0.3048, 2, 0},
    {"a rotated map", "EPSG:32632", {500000, 26, 15, 5200000, 15, -26}, 300, 200, 0, 20, 1, 500, 0, 1, 2, 0},
    {"south up", "EPSG:4326", {-60.5, 0.001, 0, -30.2, 0, 0.001}, 300, 250, 0, 20, 1, 90, 0, 1, 2, 0},
    {"across the antimeridian", "EPSG:4326", {179.3, 0.005, 0, -15, 0, -0.005}, 300, 200, 1, 20, 1, 30, 0, 1, 4, 0},
    {"the same from the other side",
     "EPSG:4326",
     {-180.7, 0.005, 0, -15, 0, -0.005},
     300,
     200,
     1,
     20,
     1,
     30,
     0,
     1,
     4,
     0},
    {"the globe", "EPSG:4326", {-179.75, 0.5, 0, 89.75, 0, -0.5}, 720, 360, 0, 40, 20, 500, 0, 1, 100, 4},
    {"the globe by points", "EPSG:4326", {0, 0.5, 0, 90, 0, -0.5}, 720, 361, 1, 40, 20, 500, 0, 1, 100, 4},
    {"the cap of the north", "EPSG:4326", {-180, 0.25, 0, 90, 0, -0.125}, 1440, 9, 1, 90, 1, 0, 0, 1, 20, 5},
    {"around the South Pole", "EPSG:3031", {-256000, 4000, 0, 256000, 0, -4000}, 129, 129, 1, 20, 1, 2000, 0, 1, 20, 4},
    {"holes", "EPSG:4326", {7, 0.001, 0, 46, 0, -0.001}, 400, 300, 0, 25, 2, 1500, 1, 1, 5, 0},
    {"a third of it void", "EPSG:4326", {7, 0.001, 0, 46, 0, -0.001}, 200, 150, 1, 25, 2, 1500, 2, 1, 5, 0},
    {"single samples", "EPSG:4326", {7, 0.001, 0, 46, 0, -0.001}, 200, 150, 0, 25, 2, 1500, 3, 1, 5, 0},
    {"noise, every vertex counts", "EPSG:4326", {7, 0.002, 0, 1.06, 0, -0.002}, 300, 300, 1, 25, 300, 0, 0, 1, .01, 0},
    {"far above the ground", "EPSG:4326", {7, 0.01, 0, 1, 0, -0.01}, 60, 60, 1, 25, 0.2, 90000, 0, 1, .1, 0},
    {"two samples", "EPSG:4326", {7, 0.01, 0, 1, 0, -0.01}, 2, 1, 0, 25, 1, 50, 0, 1, 1, 0},
    {"up to the edge of a block",
     "EPSG:4326",
     {0.0078125, 0.015625, 0, 1, 0, -0.015625},
     359,
     90,
     0,
     25,
     5,
     900,
     0,
     1,
     30,
     8},
    {"only roots", "EPSG:4326", {-177.5, 5, 0, 87.5, 0, -5}, 72, 36, 0, 15, 50, 300, 0, 1, 100, 1},
};
enum { GROUNDS = sizeof grounds / sizeof grounds[0] };

static bool hole(const ground *g, int i, int j)
{
    switch (g->holes) {
    case 1:
        return (i / 37 + j / 23) % 3 == 0 || (i + 2 * j) % 97 < 6;
    case 2:
        return random_below(3) == 0;
    case 3:
        return random_below(40) != 0;
    default:
        return false;
    }
}

static tl_source *open_ground(const ground *g, float **heights)
{
    tl_crs *crs = NULL;
    assert_int_equal(dem_crs_from_text(g->crs, g->name, &crs, NULL), TL_OK);
    *heights = malloc((size_t)g->width * (size_t)g->height * sizeof **heights);
    random_state = 5;
    double k = 2 * 3.14159265358979 / g->wave, high = 8 * g->wave;
    for (int j = 0; j < g->height; j++)
        for (int i = 0; i < g->width; i++) {
            double z =
                g->offset + high * sin(k * 0.3 * i + 0.2 * k * j) * cos(k * 0.4 * j) + 9 * sin(k * i) * sin(k * j);
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

/* Levels above the fourth last are like those below them; a few grounds go up to the roots. */
static tl_tiles_options options_of(const ground *g, const tl_source *source)
{
    int deepest = g->last_level ? g->last_level : scene_geodetic_level(&source->info);
    bool whole = g->last_level > 0;
    return (tl_tiles_options){.max_error = g->max_error,
                              .first_level = whole || deepest < 3 ? 0 : deepest - 3,
                              .last_level = g->last_level,
                              .last_level_given = g->last_level > 0};
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

static void remove_file(void *context, const char *path, const char *name)
{
    (void)context;
    (void)name;
    assert_int_equal(unlink(path), 0);
}

static void remove_tree(const char *where)
{
    char command[160];
    walk(where, ".", remove_file, NULL);
    snprintf(command, sizeof command, "rm -rf '%s'", where);
    assert_int_equal(system(command), 0);
}

/* ---- Tiles ---- */

typedef struct tile {
    bool there;
    int level;
    int64_t column, row;
    uint32_t vertices, triangles;
    int *u, *v;
    double *h, quantum;
    uint32_t *corners;
    uint32_t edge_count[4], *edges[4];
    unsigned char *normals;
} tile;

typedef struct reader {
    const unsigned char *at, *end;
} reader;

static uint32_t take(reader *r, int bytes)
{
    uint32_t value = 0;
    assert_true(r->end - r->at >= bytes);
    for (int b = 0; b < bytes; b++)
        value |= (uint32_t)*r->at++ << 8 * b;
    return value;
}

static float take_float(reader *r)
{
    uint32_t bits = take(r, 4);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static int *take_coordinates(reader *r, uint32_t count)
{
    int *out = malloc(count * sizeof *out), value = 0;
    for (uint32_t k = 0; k < count; k++) {
        uint32_t code = take(r, 2);
        value += (int)(code >> 1) ^ -(int)(code & 1);
        assert_in_range(value, 0, 32767);
        out[k] = value;
    }
    return out;
}

static unsigned char *unzip(const unsigned char *bytes, size_t count, size_t *unpacked)
{
    struct libdeflate_decompressor *d = libdeflate_alloc_decompressor();
    size_t room = bytes[count - 4] | (size_t)bytes[count - 3] << 8 | (size_t)bytes[count - 2] << 16;
    unsigned char *out = malloc(room + 1);
    assert_int_equal(libdeflate_gzip_decompress(d, bytes, count, out, room, unpacked), LIBDEFLATE_SUCCESS);
    libdeflate_free_decompressor(d);
    return out;
}

static void take_indices(tile *t, reader *r, const unsigned char *start)
{
    int wide = t->vertices > 65536 ? 4 : 2;
    uint32_t highest = 0;
    while (wide == 4 && (r->at - start) % 4)
        r->at++;
    t->triangles = take(r, 4);
    t->corners = malloc(3 * t->triangles * sizeof *t->corners);
    for (uint32_t k = 0; k < 3 * t->triangles; k++) {
        uint32_t code = take(r, wide);
        t->corners[k] = highest - code;
        assert_true(t->corners[k] < t->vertices);
        highest += code == 0;
    }
    for (int e = 0; e < 4; e++) {
        t->edge_count[e] = take(r, 4);
        t->edges[e] = malloc((t->edge_count[e] + 1) * sizeof *t->edges[e]);
        for (uint32_t k = 0; k < t->edge_count[e]; k++)
            t->edges[e][k] = take(r, wide);
    }
}

static tile read_tile(const char *where, int level, int64_t column, int64_t row)
{
    tile t = {.level = level, .column = column, .row = row};
    char name[96];
    size_t packed_count, count;
    snprintf(name, sizeof name, "%d/%lld/%lld.terrain", level, (long long)column, (long long)row);
    char *path = name_in(where, name);
    t.there = access(path, F_OK) == 0;
    if (t.there) {
        unsigned char *packed = read_whole(path, &packed_count), *raw = unzip(packed, packed_count, &count);
        reader r = {raw + 24, raw + count};
        double low = (double)take_float(&r), high = (double)take_float(&r);
        r.at = raw + 88;
        t.quantum = (high - low) / 32767;
        t.vertices = take(&r, 4);
        t.u = take_coordinates(&r, t.vertices);
        t.v = take_coordinates(&r, t.vertices);
        int *h = take_coordinates(&r, t.vertices);
        t.h = malloc(t.vertices * sizeof *t.h);
        for (uint32_t k = 0; k < t.vertices; k++)
            t.h[k] = low + h[k] * t.quantum;
        free(h);
        take_indices(&t, &r, raw);
        if (r.at < r.end && *r.at == 1) {
            r.at++;
            assert_int_equal(take(&r, 4), 2 * t.vertices);
            t.normals = malloc(2 * t.vertices);
            memcpy(t.normals, r.at, 2 * t.vertices);
        }
        free(raw);
        free(packed);
    }
    free(path);
    return t;
}

static void tile_finish(tile *t)
{
    free(t->u);
    free(t->v);
    free(t->h);
    free(t->corners);
    free(t->normals);
    for (int e = 0; e < 4; e++)
        free(t->edges[e]);
    *t = (tile){0};
}

typedef struct places {
    int level;
    size_t count;
    int64_t (*items)[2];
} places;

static void add_place(void *context, const char *path, const char *name)
{
    places *p = context;
    int level;
    long long column, row;
    (void)path;
    if (sscanf(name, "./%d/%lld/%lld.terrain", &level, &column, &row) != 3 || level != p->level)
        return;
    p->items = realloc(p->items, (p->count + 1) * sizeof *p->items);
    p->items[p->count][0] = column;
    p->items[p->count++][1] = row;
}

static places places_of(const char *where, int level)
{
    places p = {.level = level};
    walk(where, ".", add_place, &p);
    return p;
}

/* ---- Pyramids of all grounds, each made once ---- */

static struct pyramid {
    float *heights;
    tl_source *source;
    char *where;
    tl_tiles_report report;
} pyramids[GROUNDS];

static const struct pyramid *pyramid_of(int k)
{
    struct pyramid *p = &pyramids[k];
    if (p->source)
        return p;
    char name[16];
    snprintf(name, sizeof name, "ground-%d", k);
    p->source = open_ground(&grounds[k], &p->heights);
    const tl_tiles_options options = options_of(&grounds[k], p->source);
    p->where = name_in(folder, name);
    p->report = write_tiles(p->source, p->where, &options);
    return p;
}

static void remove_pyramids(void)
{
    for (int k = 0; k < GROUNDS; k++)
        if (pyramids[k].source) {
            remove_tree(pyramids[k].where);
            close_ground(pyramids[k].source, pyramids[k].heights);
            free(pyramids[k].where);
        }
}

/* ---- Edges ---- */

/* Edge 2 (east) of a and 0 (west) of b, or 3 (north) and 1 (south). */
static void compare_edges(const tile *a, const tile *b, int edge, const char *name)
{
    int other = edge - 2;
    const int *pa = edge == 2 ? a->v : a->u, *pb = edge == 2 ? b->v : b->u;
    assert_int_equal(a->edge_count[edge], b->edge_count[other]);
    for (uint32_t k = 0; k < a->edge_count[edge]; k++) {
        uint32_t i = a->edges[edge][k], j = b->edges[other][k];
        assert_int_equal((edge == 2 ? a->u : a->v)[i], 32767);
        assert_int_equal((edge == 2 ? b->u : b->v)[j], 0);
        assert_int_equal(pa[i], pb[j]);
        assert_memory_equal(a->normals + 2 * i, b->normals + 2 * j, 2);
        /* equal floats, each rounded to its tile's own quantum */
        double most = a->quantum == b->quantum ? 0 : (a->quantum + b->quantum) / 2;
        if (!(fabs(a->h[i] - b->h[j]) <= most))
            fail_msg("%s: level %d, tile %d, %d, edge %d: heights %.9g and %.9g; quanta %g and %g", name, a->level,
                     (int)a->column, (int)a->row, edge, a->h[i], b->h[j], a->quantum, b->quantum);
    }
}

static size_t compare_level(const char *where, int level, const char *name)
{
    places p = places_of(where, level);
    size_t compared = 0;
    for (size_t k = 0; k < p.count; k++) {
        tile t = read_tile(where, level, p.items[k][0], p.items[k][1]);
        tile east = read_tile(where, level, (t.column + 1) % (INT64_C(2) << level), t.row);
        tile north = read_tile(where, level, t.column, t.row + 1);
        assert_true(t.vertices >= 4 && t.triangles >= 2);
        if (east.there)
            compare_edges(&t, &east, 2, name);
        if (north.there)
            compare_edges(&t, &north, 3, name);
        compared += (size_t)east.there + (size_t)north.there;
        tile_finish(&t);
        tile_finish(&east);
        tile_finish(&north);
    }
    free(p.items);
    return compared;
}

static void neighboursShareTheirEdgesAndNormals(void **state)
{
    (void)state;
    for (int k = 0; k < GROUNDS; k++) {
        const struct pyramid *p = pyramid_of(k);
        size_t compared = 0;
        for (int level = p->report.first_level; level <= p->report.last_level; level++)
            compared += compare_level(p->where, level, grounds[k].name);
        assert_true(compared > 0 || grounds[k].width == 2);
    }
}

/* ---- Bounds ---- */

enum { BINS = 64, SLOTS = 1 << 14 };

/* Triangles by the parts of their tile that they touch. */
typedef struct index_of_tile {
    tile t;
    uint32_t *first, *triangles;
} index_of_tile;

static void bins_of(const tile *t, uint32_t triangle, int out[4])
{
    const uint32_t *c = t->corners + 3 * triangle;
    int low[2] = {32767, 32767}, high[2] = {0, 0};
    for (int k = 0; k < 3; k++)
        for (int a = 0; a < 2; a++) {
            int p = a ? t->v[c[k]] : t->u[c[k]];
            low[a] = p < low[a] ? p : low[a];
            high[a] = p > high[a] ? p : high[a];
        }
    for (int a = 0; a < 2; a++) {
        out[a] = low[a] * BINS / 32768;
        out[2 + a] = high[a] * BINS / 32768;
    }
}

static void make_index(index_of_tile *x)
{
    size_t total = 0;
    x->first = calloc(BINS * BINS + 2, sizeof *x->first);
    for (int pass = 0; pass < 2; pass++) {
        for (uint32_t k = 0; k < x->t.triangles; k++) {
            int b[4];
            bins_of(&x->t, k, b);
            for (int j = b[1]; j <= b[3]; j++)
                for (int i = b[0]; i <= b[2]; i++)
                    if (pass)
                        x->triangles[x->first[j * BINS + i + 1]++] = k;
                    else
                        x->first[j * BINS + i + 2]++;
        }
        if (pass)
            break;
        for (int k = 2; k <= BINS * BINS + 1; k++) {
            total += x->first[k];
            x->first[k] += x->first[k - 1];
        }
        x->triangles = malloc((total + 1) * sizeof *x->triangles);
    }
}

/* The surface at (u, v) in steps; NaN: no triangle is there. */
static double surface_at(const index_of_tile *x, double u, double v)
{
    const tile *t = &x->t;
    int bin = (int)(fmin(v, 32767) * BINS / 32768) * BINS + (int)(fmin(u, 32767) * BINS / 32768);
    for (uint32_t k = x->first[bin]; k < x->first[bin + 1]; k++) {
        const uint32_t *c = t->corners + 3 * x->triangles[k];
        double ax = t->u[c[0]], ay = t->v[c[0]];
        double bx = t->u[c[1]] - ax, by = t->v[c[1]] - ay, cx = t->u[c[2]] - ax, cy = t->v[c[2]] - ay;
        double whole = bx * cy - by * cx, p = ((u - ax) * cy - (v - ay) * cx) / whole,
               q = (bx * (v - ay) - by * (u - ax)) / whole;
        assert_true(whole > 0); /* counter-clockwise, and none without an area */
        if (p >= -1e-9 && q >= -1e-9 && p + q <= 1 + 1e-9)
            return t->h[c[0]] + p * (t->h[c[1]] - t->h[c[0]]) + q * (t->h[c[2]] - t->h[c[0]]);
    }
    return NAN;
}

typedef struct pyramid_level {
    const char *where;
    int level;
    index_of_tile *tiles[SLOTS]; /* by column and row; read at first use */
} pyramid_level;

typedef struct measured {
    double worst, sum;
    size_t samples, bare; /* bare: under no tile */
} measured;

static const index_of_tile *tile_under(pyramid_level *l, int64_t column, int64_t row)
{
    size_t slot = (size_t)(column * 131 + row) % SLOTS;
    for (; l->tiles[slot]; slot = (slot + 1) % SLOTS)
        if (l->tiles[slot]->t.column == column && l->tiles[slot]->t.row == row)
            return l->tiles[slot];
    index_of_tile *x = l->tiles[slot] = malloc(sizeof *x);
    *x = (index_of_tile){.t = read_tile(l->where, l->level, column, row)};
    if (x->t.there)
        make_index(x);
    return x;
}

static void level_finish(pyramid_level *l)
{
    for (size_t k = 0; k < SLOTS; k++) {
        if (!l->tiles[k])
            continue;
        tile_finish(&l->tiles[k]->t);
        free(l->tiles[k]->first);
        free(l->tiles[k]->triangles);
        free(l->tiles[k]);
    }
}

/* Longitudes and latitudes of all samples. */
static double *degrees_of(const tl_source *source)
{
    size_t count = (size_t)(source->info.width * source->info.height);
    double *at = malloc(2 * count * sizeof *at);
    for (size_t k = 0; k < count; k++) {
        at[k] = (double)(k % (size_t)source->info.width);
        at[count + k] = (double)(k / (size_t)source->info.width);
    }
    assert_int_equal(tl_georef_to_lonlat(&source->info.georef, count, at, at + count, NULL), TL_OK);
    return at;
}

static measured measure_level(const tl_source *source, const float *heights, const double *at, const char *where,
                              int level)
{
    pyramid_level l = {.where = where, .level = level};
    measured m = {0};
    size_t count = (size_t)(source->info.width * source->info.height);
    double side = 180 / ldexp(1, level);
    for (size_t k = 0; k < count; k++) {
        double x = (at[k] + 180) / side, y = (at[count + k] + 90) / side, around = ldexp(2, level);
        if (!isfinite(heights[k]))
            continue;
        x -= around * floor(x / around);
        int64_t column = (int64_t)x, row = (int64_t)fmin(fmax(y, 0), ldexp(1, level) - 1);
        const index_of_tile *under = tile_under(&l, column, row);
        m.samples++;
        if (!under->t.there) {
            m.bare++;
            continue;
        }
        double z = surface_at(under, (x - (double)column) * 32767, (y - (double)row) * 32767);
        double off = fabs(z - (double)heights[k] * source->info.georef.height_unit);
        if (!isfinite(z))
            fail_msg("%s: level %d has a gap at %.9g, %.9g", source->info.name, level, at[k], at[count + k]);
        m.worst = fmax(m.worst, off);
        m.sum += off * off;
    }
    level_finish(&l);
    return m;
}

static void everySampleIsWithinTheBound(void **state)
{
    (void)state;
    for (int k = 0; k < GROUNDS; k++) {
        const ground *g = &grounds[k];
        const struct pyramid *p = pyramid_of(k);
        const tl_tiles_report *report = &p->report;
        double *at = degrees_of(p->source);
        for (int level = report->first_level; level <= report->last_level; level++) {
            measured m = measure_level(p->source, p->heights, at, p->where, level);
            double stated = report->levels[level].error + report->resampling;
            if (getenv("TALUS_TILES_SHOW"))
                print_message("%s: level %d: %.4g of %.4g (resampling %.4g), %zu of %zu bare\n", g->name, level,
                              m.worst, stated, report->resampling, m.bare, m.samples);
            /* of single samples some lie where more than half of what is around them is void */
            if (m.bare && !g->holes)
                fail_msg("%s: level %d: %zu of %zu samples are under no tile", g->name, level, m.bare, m.samples);
            if (!(m.worst <= stated * (1 + 1e-6)))
                fail_msg("%s: level %d is %.6g m off, stated are %.6g + %.6g m", g->name, level, m.worst,
                         report->levels[level].error, report->resampling);
        }
        free(at);
    }
}

/* ---- The same bytes ---- */

static const ground *named(const char *name)
{
    for (int k = 0; k < GROUNDS; k++)
        if (strcmp(grounds[k].name, name) == 0)
            return &grounds[k];
    fail_msg("no ground %s", name);
    return NULL;
}

static const char *const several[] = {"several blocks", "the globe by points"};
enum { SEVERAL = sizeof several / sizeof several[0] };

static uint64_t tree_by(const tl_source *source, const tl_tiles_options *base, unsigned threads, unsigned shards)
{
    const tl_run run = {.threads = threads};
    tl_tiles_options options = *base;
    char *where = name_in(folder, "same");
    options.run = &run;
    options.shards = shards;
    /* 5 and 7 have no common divisor, 1 and 2 neither: all shards, out of order */
    for (unsigned k = 0; k < shards; k++) {
        options.shard = (5 * k + 3) % shards;
        assert_false(write_tiles(source, where, &options).complete);
    }
    options.shards = options.shard = 0;
    options.finish = shards > 0;
    assert_true(write_tiles(source, where, &options).complete);
    uint64_t tree = tree_of(where);
    remove_tree(where);
    free(where);
    return tree;
}

static void threadsAndShardsDoNotChangeAByte(void **state)
{
    (void)state;
    for (int k = 0; k < SEVERAL; k++) {
        const ground *g = named(several[k]);
        float *heights;
        tl_source *source = open_ground(g, &heights);
        const tl_tiles_options options = options_of(g, source);
        uint64_t tree = tree_by(source, &options, 1, 0);
        assert_true(tree == tree_by(source, &options, 3, 0));
        unsigned shards = k ? 7 : 2;
        assert_true(tree == tree_by(source, &options, 2, shards));
        close_ground(source, heights);
    }
}

/* Does away with or cuts every seventh file, tiles and pieces alike, but not what tells the job. */
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
    for (int k = 1; k < SEVERAL; k++) {
        const ground *g = named(several[k]);
        float *heights;
        int count = k;
        tl_source *source = open_ground(g, &heights);
        tl_tiles_options options = options_of(g, source);
        uint64_t tree = tree_by(source, &options, 2, 0);
        char *where = name_in(folder, "mended");
        options.shards = 1; /* all blocks of the deepest lattice, and their pieces */
        write_tiles(source, where, &options);
        walk(where, ".", damage, &count);
        options.shards = 0;
        options.resume = true;
        assert_true(write_tiles(source, where, &options).complete);
        assert_true(tree == tree_of(where));
        assert_true(write_tiles(source, where, &options).complete); /* once more does no harm */
        assert_true(tree == tree_of(where));
        remove_tree(where);
        free(where);
        close_ground(source, heights);
    }
}

typedef struct stop {
    volatile int cancel;
    int calls;
} stop;

static void stop_soon(void *user, uint64_t done, uint64_t total)
{
    stop *s = user;
    (void)done;
    (void)total;
    if (--s->calls <= 0)
        s->cancel = 1;
}

static void cancelledRunsGoOnWhereTheyWere(void **state)
{
    (void)state;
    const ground *g = named("the globe by points");
    float *heights;
    tl_source *source = open_ground(g, &heights);
    tl_tiles_options options = options_of(g, source);
    uint64_t tree = tree_by(source, &options, 2, 0), kept = 0;
    char *where = name_in(folder, "cancelled");
    tl_status status = TL_ERROR_CANCELLED;
    int runs = 0;
    options.resume = true;
    for (; status == TL_ERROR_CANCELLED && runs < 200; runs++) {
        stop s = {.calls = 2 + runs / 4};
        const tl_run run = {.threads = 2, .cancel = &s.cancel, .progress = stop_soon, .user = &s};
        tl_tiles_report report;
        tl_error error;
        options.run = &run;
        status = tl_write_terrain_tiles(source, where, &options, &report, &error);
        kept = status == TL_OK ? report.done_before : 0;
    }
    assert_int_equal(status, TL_OK);
    assert_true(runs > 1 && kept > 0);
    assert_true(tree == tree_of(where));
    remove_tree(where);
    free(where);
    close_ground(source, heights);
}

static void expect_refused(const tl_source *source, const char *where, const tl_tiles_options *options,
                           const char *words)
{
    tl_error error = {0};
    tl_tiles_report report;
    assert_int_not_equal(tl_write_terrain_tiles(source, where, options, &report, &error), TL_OK);
    if (!strstr(error.text, words))
        fail_msg("'%s' does not say '%s'", error.text, words);
}

static void otherJobsAreRefused(void **state)
{
    (void)state;
    const ground *g = named("two samples");
    float *heights;
    tl_source *source = open_ground(g, &heights);
    char *where = name_in(folder, "other");
    tl_tiles_options options = options_of(g, source);
    options.shards = 2;
    options.shard = 1; /* which has nothing to do: there is one block */
    write_tiles(source, where, &options);
    options.shards = 0;
    expect_refused(source, where, &options, "--resume");
    options.finish = true;
    expect_refused(source, where, &options, "run the shards first");
    options.finish = false;
    options.resume = true;
    options.outside = 7;
    expect_refused(source, where, &options, "other options");
    options.outside = 0;
    assert_true(write_tiles(source, where, &options).complete);
    options.max_error *= 2;
    expect_refused(source, where, &options, "finished tiles");
    options.resume = false;
    expect_refused(source, where, &options, "finished tiles");
    remove_tree(where);
    free(where);
    close_ground(source, heights);
}

static void whatWasKilledAtTheVeryBeginOrEndGoesOn(void **state)
{
    (void)state;
    const ground *g = named("two samples");
    float *heights;
    tl_source *source = open_ground(g, &heights);
    char *where = name_in(folder, "begun"), *work = name_in(where, ".talus");
    tl_tiles_options options = options_of(g, source);
    uint64_t tree = tree_by(source, &options, 1, 0);
    assert_int_equal(mkdir(where, 0777), 0);
    assert_int_equal(mkdir(work, 0777), 0);
    options.resume = true;
    assert_true(write_tiles(source, where, &options).complete);
    assert_true(tree == tree_of(where));
    assert_int_equal(mkdir(work, 0777), 0); /* and layer.json is there */
    assert_true(write_tiles(source, where, &options).complete);
    assert_int_not_equal(access(work, F_OK), 0);
    assert_true(tree == tree_of(where));
    remove_tree(where);
    free(work);
    free(where);
    close_ground(source, heights);
}

/* ---- Indices ---- */

static void tilesOfManyVerticesHaveWideIndices(void **state)
{
    (void)state;
    const struct pyramid *made = pyramid_of((int)(named("noise, every vertex counts") - grounds));
    places p = places_of(made->where, made->report.last_level - 2);
    uint32_t most = 0;
    for (size_t k = 0; k < p.count; k++) {
        tile t = read_tile(made->where, p.level, p.items[k][0], p.items[k][1]);
        most = t.vertices > most ? t.vertices : most;
        tile_finish(&t);
    }
    assert_true(most > 65536);
    free(p.items);
}

static int make_temporary(void **state)
{
    (void)state;
    strcpy(folder, "/tmp/talus-tiles-XXXXXX");
    return mkdtemp(folder) ? 0 : -1;
}

static int remove_temporary(void **state)
{
    (void)state;
    char command[160];
    remove_pyramids();
    snprintf(command, sizeof command, "rm -rf '%s'", folder);
    return system(command);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(neighboursShareTheirEdgesAndNormals),    cmocka_unit_test(everySampleIsWithinTheBound),
        cmocka_unit_test(threadsAndShardsDoNotChangeAByte),       cmocka_unit_test(resumingMendsWhatIsMissingOrBroken),
        cmocka_unit_test(cancelledRunsGoOnWhereTheyWere),         cmocka_unit_test(otherJobsAreRefused),
        cmocka_unit_test(whatWasKilledAtTheVeryBeginOrEndGoesOn), cmocka_unit_test(tilesOfManyVerticesHaveWideIndices),
    };
    return cmocka_run_group_tests(tests, make_temporary, remove_temporary);
}
