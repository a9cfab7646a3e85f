#include "lib/out/tiles3d.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { LEVELS = OUT_SUBTREE_LEVELS, CHILDREN = 1 << 2 * LEVELS, TILES = (CHILDREN - 1) / 3 };
enum { SUBTREE_MAGIC = 0x74627573, HEADER = 24, SAMPLES = 33 };

static const double pi = 3.14159265358979323846;

/* ---- The tiles and those above them ---- */

static tl_status add_node(out_nodes *nodes, int level, const out_node *node, tl_error *error)
{
    size_t count = nodes->levels[level].count, room = nodes->levels[level].room, bytes;
    if (count == room) {
        room = 2 * room + 64;
        out_node *more = tl_size_mul(room, sizeof *more, &bytes) ? realloc(nodes->levels[level].nodes, bytes) : NULL;
        if (!more)
            return tl_fail_memory(error, "the tiles' index");
        nodes->levels[level].nodes = more;
        nodes->levels[level].room = room;
    }
    nodes->levels[level].nodes[count] = *node;
    nodes->levels[level].count++;
    return TL_OK;
}

static int compare_nodes(const void *a, const void *b)
{
    const out_node *p = a, *q = b;
    if (p->row != q->row)
        return p->row < q->row ? -1 : 1;
    return (p->column > q->column) - (p->column < q->column);
}

/* What contains both. */
static void merge(out_node *into, const out_node *more)
{
    for (int k = 0; k < 6; k++) {
        bool low = k < 2 || k == 4;
        into->region[k] = low ? fmin(into->region[k], more->region[k]) : fmax(into->region[k], more->region[k]);
    }
    into->error = fmax(into->error, more->error);
    into->content = into->content || more->content;
}

/* Sorts a level, and makes one of those at one place. */
static void settle(out_nodes *nodes, int level)
{
    out_node *all = nodes->levels[level].nodes;
    size_t kept = 0, count = nodes->levels[level].count;
    if (count)
        qsort(all, count, sizeof *all, compare_nodes);
    for (size_t k = 0; k < count; k++)
        if (kept && compare_nodes(&all[kept - 1], &all[k]) == 0)
            merge(&all[kept - 1], &all[k]);
        else
            all[kept++] = all[k];
    nodes->levels[level].count = kept;
}

tl_status out_nodes_gather(const out_piece_tile *tiles, size_t count, int deepest, out_nodes *nodes, tl_error *error)
{
    tl_status status = TL_OK;
    *nodes = (out_nodes){.levels = {{NULL, 0, 0}}};
    for (size_t k = 0; k < count && status == TL_OK; k++) {
        out_node node = {tiles[k].column, tiles[k].row, {0}, tiles[k].error, true};
        memcpy(node.region, tiles[k].region, sizeof node.region);
        if (tiles[k].bytes)
            status = add_node(nodes, tiles[k].level, &node, error);
    }
    for (int level = deepest; level >= 0 && status == TL_OK; level--) {
        settle(nodes, level);
        for (size_t k = 0; level && k < nodes->levels[level].count && status == TL_OK; k++) {
            out_node parent = nodes->levels[level].nodes[k];
            parent.column /= 2;
            parent.row /= 2;
            parent.content = false;
            status = add_node(nodes, level - 1, &parent, error);
        }
    }
    return status;
}

void out_nodes_finish(out_nodes *nodes)
{
    for (int level = 0; level < OUT_TILE_LEVELS; level++)
        free(nodes->levels[level].nodes);
}

const out_node *out_nodes_find(const out_nodes *nodes, int level, int64_t column, int64_t row)
{
    const out_node wanted = {.column = column, .row = row};
    if (level >= OUT_TILE_LEVELS || !nodes->levels[level].count)
        return NULL;
    return bsearch(&wanted, nodes->levels[level].nodes, nodes->levels[level].count, sizeof wanted, compare_nodes);
}

/* ---- Subtrees ---- */

/* Of a subtree. */
typedef struct subtree {
    unsigned char tiles[(TILES + 7) / 8], contents[(TILES + 7) / 8], children[CHILDREN / 8];
    int tile_count, content_count, child_count;
    double regions[TILES][6], errors[TILES];
} subtree;

/* Every second bit of a Morton number, from the lowest on. */
static int64_t half_of(int morton)
{
    int64_t out = 0;
    for (int bit = 0; bit < LEVELS; bit++)
        out |= (int64_t)(morton >> 2 * bit & 1) << bit;
    return out;
}

static void set_bit(unsigned char *bits, int at, int *count)
{
    bits[at / 8] |= (unsigned char)(1 << at % 8);
    ++*count;
}

/* Regions of 3D Tiles have longitudes within half a turn; the western one is greater across the antimeridian. */
static void write_region(const double region[6], double out[6])
{
    memcpy(out, region, 6 * sizeof *out);
    if (region[2] - region[0] >= 2 * pi) {
        out[0] = -pi, out[2] = pi;
        return;
    }
    for (int k = 0; k < 4; k += 2)
        if (fabs(out[k]) > pi)
            out[k] -= 2 * pi * rint(out[k] / (2 * pi));
}

static void fill_subtree(const out_nodes *nodes, int level, int64_t column, int64_t row, int deepest, subtree *s)
{
    for (int below = 0, at = 0; below <= LEVELS; at += 1 << 2 * below, below++)
        for (int m = 0; m < 1 << 2 * below; m++) {
            const out_node *node = level + below > deepest
                                       ? NULL
                                       : out_nodes_find(nodes, level + below, (column << below) + half_of(m),
                                                        (row << below) + half_of(m >> 1));
            if (!node)
                continue;
            if (below == LEVELS) {
                set_bit(s->children, m, &s->child_count);
                continue;
            }
            write_region(node->region, s->regions[s->tile_count]);
            s->errors[s->tile_count] = node->error;
            set_bit(s->tiles, at + m, &s->tile_count);
            if (node->content)
                set_bit(s->contents, at + m, &s->content_count);
        }
}

/* The parts of the binary chunk, each at a multiple of 8 bytes. */
typedef struct parts {
    json_t *views;
    const void *bytes[5];
    size_t sizes[5], count, whole;
} parts;

static int add_part(parts *p, const void *bytes, size_t size)
{
    json_array_append_new(p->views, json_pack("{s:i, s:I, s:I}", "buffer", 0, "byteOffset", (json_int_t)p->whole,
                                              "byteLength", (json_int_t)size));
    p->bytes[p->count] = bytes;
    p->sizes[p->count] = size;
    p->whole += (size + 7) / 8 * 8;
    return (int)p->count++;
}

static json_t *describe_bits(parts *p, const unsigned char *bits, int set, int all)
{
    if (set == 0 || set == all)
        return json_pack("{s:i}", "constant", set != 0);
    int view = add_part(p, bits, (size_t)(all + 7) / 8);
    return json_pack("{s:i, s:i}", "bitstream", view, "availableCount", set);
}

static char *describe_subtree(const subtree *s, parts *p)
{
    size_t count = (size_t)s->tile_count;
    *p = (parts){.views = json_array()};
    json_t *tiles = describe_bits(p, s->tiles, s->tile_count, TILES);
    json_t *contents = describe_bits(p, s->contents, s->content_count, TILES);
    json_t *children = describe_bits(p, s->children, s->child_count, CHILDREN);
    int regions = add_part(p, s->regions, count * sizeof *s->regions);
    int errors = add_part(p, s->errors, count * sizeof *s->errors);
    json_t *root = json_pack("{s:[{s:I}], s:o, s:[{s:s, s:I, s:{s:{s:i}, s:{s:i}}}], s:i, s:o, s:[o], s:o}", "buffers",
                             "byteLength", (json_int_t)p->whole, "bufferViews", p->views, "propertyTables", "class",
                             "tile", "count", (json_int_t)count, "properties", "region", "values", regions,
                             "geometricError", "values", errors, "tileMetadata", 0, "tileAvailability", tiles,
                             "contentAvailability", contents, "childSubtreeAvailability", children);
    char *text = root ? json_dumps(root, JSON_COMPACT) : NULL;
    json_decref(root);
    return text;
}

static unsigned char *join_subtree(const char *text, const parts *p, size_t *count)
{
    size_t length = strlen(text), room = (length + 7) / 8 * 8;
    const uint32_t head[6] = {SUBTREE_MAGIC, 1, (uint32_t)room, 0, (uint32_t)p->whole, 0};
    unsigned char *out = calloc(1, HEADER + room + p->whole), *at = out ? out + HEADER + room : NULL;
    if (!out)
        return NULL;
    memcpy(out, head, sizeof head);
    memset(out + HEADER, ' ', room);
    memcpy(out + HEADER, text, length);
    for (size_t k = 0; k < p->count; k++) {
        memcpy(at, p->bytes[k], p->sizes[k]);
        at += (p->sizes[k] + 7) / 8 * 8;
    }
    *count = HEADER + room + p->whole;
    return out;
}

unsigned char *out_subtree_encode(const out_nodes *nodes, int level, int64_t column, int64_t row, int deepest,
                                  size_t *count)
{
    subtree *s = calloc(1, sizeof *s);
    parts p;
    if (!s)
        return NULL;
    fill_subtree(nodes, level, column, row, deepest, s);
    char *text = describe_subtree(s, &p);
    unsigned char *out = text ? join_subtree(text, &p, count) : NULL;
    free(text);
    free(s);
    return out;
}

static tl_status write_subtrees(const out_pyramid *p, const out_nodes *nodes, int level, tl_error *error)
{
    tl_status status = TL_OK;
    for (size_t k = 0; k < nodes->levels[level].count && status == TL_OK; k++) {
        const out_node *node = &nodes->levels[level].nodes[k];
        char name[96];
        size_t count;
        snprintf(name, sizeof name, "subtrees/%d/%lld/%lld.subtree", level, (long long)node->column,
                 (long long)node->row);
        unsigned char *bytes = out_subtree_encode(nodes, level, node->column, node->row, p->deepest, &count);
        status =
            bytes ? out_write_inside(p->folder, name, bytes, count, true, error) : tl_fail_memory(error, p->folder);
        free(bytes);
    }
    return status;
}

/* ---- The root ---- */

/* The region of the whole square, so that readers who divide it evenly find the tiles; false where there is none on
 * the globe, or the tiles are no boxes of longitude and latitude. */
static bool square_region(const out_pyramid *p, scene_placer *placer, const out_node *root, double out[6])
{
    const double side = (double)((int64_t)OUT_TILE_CELLS << p->deepest), x[2] = {0, side}, y[2] = {0, side};
    double longitude[2], latitude[2];
    if (!scene_own_lattice_is_geographic(p->lattice))
        return false;
    scene_placer_lonlat(placer, 2, x, y, longitude, latitude);
    /* to the west a whole turn less where it begins beyond the antimeridian */
    double turn = 2 * pi * rint(longitude[0] / (2 * pi));
    const double region[6] = {longitude[0] - turn, latitude[0],     longitude[1] - turn,
                              latitude[1],         root->region[4], root->region[5]};
    memcpy(out, region, sizeof region);
    return region[2] <= pi && region[3] <= pi / 2 && region[1] >= -pi / 2;
}

/* A box whose first two axes run along columns and rows at the source's middle; grown to hold places of the content. */
typedef struct box {
    double centre[3], axes[3][3], low[3], high[3];
} box;

static void scale_to_one(double v[3])
{
    double length = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
    for (int a = 0; a < 3; a++)
        v[a] /= length;
}

static void cross(const double a[3], const double b[3], double out[3])
{
    for (int k = 0; k < 3; k++)
        out[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
}

/* step: metres of a cell along both axes. */
static void find_axes(scene_placer *placer, const tl_window *all, box *b, double step[2])
{
    const double x = 0.5 * (double)(all->width - 1), y = 0.5 * (double)(all->height - 1);
    const double px[3] = {x, x + 0.5, x}, py[3] = {y, y, y + 0.5};
    double longitude[3], latitude[3], at[3][3], along[2] = {0, 0};
    scene_placer_lonlat(placer, 3, px, py, longitude, latitude);
    for (int k = 0; k < 3; k++)
        scene_to_ecef(longitude[k], latitude[k], 0, at[k]);
    memcpy(b->centre, at[0], sizeof at[0]);
    for (int k = 0; k < 2; k++) {
        for (int a = 0; a < 3; a++)
            along[k] += (at[k + 1][a] - at[0][a]) * (at[k + 1][a] - at[0][a]);
        step[k] = 2 * sqrt(along[k]);
    }
    for (int a = 0; a < 3; a++)
        b->axes[0][a] = at[1][a] - at[0][a];
    scale_to_one(b->axes[0]);
    scene_up(longitude[0], latitude[0], b->axes[2]);
    cross(b->axes[2], b->axes[0], b->axes[1]);
    scale_to_one(b->axes[1]);
    cross(b->axes[0], b->axes[1], b->axes[2]);
}

/* Makes the box hold places all over the source, at the lowest and the highest height of it. */
static void hold_content(scene_placer *placer, const tl_window *all, const out_node *root, box *b)
{
    for (int k = 0; k < SAMPLES * SAMPLES * 2; k++) {
        double x = (double)(all->width - 1) * (k / 2 % SAMPLES) / (SAMPLES - 1), longitude, latitude, at[3];
        double y = (double)(all->height - 1) * (k / 2 / SAMPLES) / (SAMPLES - 1);
        scene_placer_lonlat(placer, 1, &x, &y, &longitude, &latitude);
        scene_to_ecef(longitude, latitude, root->region[4 + k % 2], at);
        for (int axis = 0; axis < 3 && isfinite(longitude); axis++) {
            double along = 0;
            for (int a = 0; a < 3; a++)
                along += (at[a] - b->centre[a]) * b->axes[axis][a];
            b->low[axis] = fmin(b->low[axis], along);
            b->high[axis] = fmax(b->high[axis], along);
        }
    }
}

/* For maps, and across the antimeridian: the lattice's square on the plane under the source's middle. Readers who
 * divide it evenly miss the tiles by what the map and the plane differ, 0.01 % of its side at 100 km; those who read
 * the tiles' own regions do not. */
static json_t *square_box(const out_pyramid *p, scene_placer *placer, const out_node *root)
{
    const tl_window all = scene_own_lattice_window(p->lattice);
    const double side = (double)((int64_t)OUT_TILE_CELLS << p->deepest);
    double step[2];
    box b = {.low = {0}};
    find_axes(placer, &all, &b, step);
    const double size[2] = {(double)(all.width - 1), (double)(all.height - 1)};
    for (int a = 0; a < 2; a++) {
        b.low[a] = -0.5 * size[a] * step[a];
        b.high[a] = (side - 0.5 * size[a]) * step[a];
    }
    hold_content(placer, &all, root, &b);
    json_t *out = json_array();
    double half[3];
    for (int axis = 0; axis < 3; axis++)
        half[axis] = 0.5 * (b.high[axis] - b.low[axis]);
    half[2] += 1 + 0.01 * half[2]; /* for what lies between the places */
    for (int a = 0; a < 3; a++) {
        double centre = b.centre[a];
        for (int axis = 0; axis < 3; axis++)
            centre += b.axes[axis][a] * 0.5 * (b.low[axis] + b.high[axis]);
        json_array_append_new(out, json_real(centre));
    }
    for (int axis = 0; axis < 3; axis++)
        for (int a = 0; a < 3; a++)
            json_array_append_new(out, json_real(b.axes[axis][a] * half[axis]));
    return json_pack("{s:o}", "box", out);
}

/* NULL: out of memory. */
static json_t *describe_volume(const out_pyramid *p, const out_node *root)
{
    double region[6];
    scene_placer *placer = scene_placer_create(p->lattice, NULL);
    if (!placer)
        return NULL;
    bool square = square_region(p, placer, root, region), wide = root->region[2] - root->region[0] > 0.5;
    json_t *around = !square && !wide ? square_box(p, placer, root) : NULL;
    scene_placer_destroy(placer);
    if (!square && !wide)
        return around;
    if (!square)
        write_region(root->region, region);
    return json_pack("{s:[f,f,f,f,f,f]}", "region", region[0], region[1], region[2], region[3], region[4], region[5]);
}

/* Readers who halve it from level to level must not fall below a level's own. */
static double halving_error(const out_nodes *nodes, int deepest)
{
    double error = 0;
    for (int level = 0; level <= deepest; level++)
        for (size_t k = 0; k < nodes->levels[level].count; k++)
            error = fmax(error, ldexp(nodes->levels[level].nodes[k].error, level));
    return error;
}

static json_t *describe_schema(void)
{
    return json_pack("{s:s, s:{s:{s:{s:{s:s, s:s, s:b, s:i, s:s}, s:{s:s, s:s, s:s}}}}}", "id", "talus", "classes",
                     "tile", "properties", "region", "type", "SCALAR", "componentType", "FLOAT64", "array", 1, "count",
                     6, "semantic", "TILE_BOUNDING_REGION", "geometricError", "type", "SCALAR", "componentType",
                     "FLOAT64", "semantic", "TILE_GEOMETRIC_ERROR");
}

static char *describe_tileset(const out_pyramid *p, const out_nodes *nodes)
{
    const double *r = nodes->levels[0].nodes[0].region;
    double error = halving_error(nodes, p->deepest);
    json_t *record = out_describe_record(p); /* with where the tiles are, of the root's square */
    json_object_set_new(record, "region", json_pack("[f,f,f,f,f,f]", r[0], r[1], r[2], r[3], r[4], r[5]));
    json_t *implicit =
        json_pack("{s:s, s:i, s:i, s:{s:s}}", "subdivisionScheme", "QUADTREE", "subtreeLevels", LEVELS,
                  "availableLevels", p->deepest + 1, "subtrees", "uri", "subtrees/{level}/{x}/{y}.subtree");
    json_t *root = json_pack("{s:{s:s, s:s}, s:f, s:o, s:{s:o, s:f, s:s, s:{s:s}, s:o}, s:{s:o}}", "asset", "version",
                             "1.1", "generator", "talus", "geometricError", 2 * error, "schema", describe_schema(),
                             "root", "boundingVolume", describe_volume(p, &nodes->levels[0].nodes[0]), "geometricError",
                             error, "refine", "REPLACE", "content", "uri", "content/{level}/{x}/{y}.glb",
                             "implicitTiling", implicit, "extras", "talus", record);
    char *text = root ? json_dumps(root, JSON_INDENT(1) | JSON_REAL_PRECISION(17)) : NULL;
    json_decref(root);
    return text;
}

tl_status out_tileset_write(const out_pyramid *p, tl_error *error)
{
    out_nodes nodes;
    tl_status status = out_nodes_gather(p->tiles, p->tile_count, p->deepest, &nodes, error);
    if (status == TL_OK && !nodes.levels[0].count)
        status = tl_fail(error, TL_ERROR_DATA, "%s: no cell of it is known; --nodata, --band or --voids may help",
                         p->source->info.name);
    for (int level = 0; level <= p->deepest && status == TL_OK; level += LEVELS)
        status = write_subtrees(p, &nodes, level, error);
    char *text = status == TL_OK ? describe_tileset(p, &nodes) : NULL;
    if (status == TL_OK)
        status = text ? out_write_inside(p->folder, p->scheme->index, text, strlen(text), true, error)
                      : tl_fail_memory(error, p->folder);
    free(text);
    out_nodes_finish(&nodes);
    return status;
}
