/* Pyramids of quantized-mesh tiles for globes, in the geographic scheme. */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/out/quantized_mesh.h"
#include "lib/out/tile_pyramid.h"
#include "lib/out/tile_schemes.h"
#include "lib/scene/geodetic.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { METADATA_LEVELS = 10 };

static const double earth = 6378137, pi = 3.14159265358979323846;

/* What globes take a level's error for: that of 65 x 65 samples a tile along the equator, by a rule of thumb. */
static double nominal_error(int level)
{
    return earth * 2 * pi * 0.25 / (65 * 2) / ldexp(1, level);
}

/* Flat triangles lie under the round Earth by h^2 / 8 R in the middle of a hypotenuse h; half as much again is for
 * parallels, which are no straight lines, under slopes of up to 45 degrees. */
static double sag(const out_pyramid *p, int lattice, int size)
{
    (void)p;
    double cell = scene_geodetic_step(lattice) * pi / 180;
    return 1.5 * earth * cell * cell * ldexp(1, size + 1) / 8;
}

/* ---- Metadata ---- */

/* Ten levels of tiles under a tile, of a sorted list; to be freed. NULL: out of memory. */
static char *describe_below(const out_tile_list *list, int level, int64_t column, int64_t row, int deepest)
{
    json_t *available = json_array(), *root = json_pack("{s:o}", "available", available);
    bool good = root != NULL;
    for (int below = 1; good && below <= METADATA_LEVELS && level + below <= deepest; below++) {
        const out_tile_place first = {row << below, column << below},
                             last = {((row + 1) << below) - 1, ((column + 1) << below) - 1};
        good = json_array_append_new(available, out_tile_list_ranges(list, level + below, first, last)) == 0;
    }
    char *text = good ? json_dumps(root, JSON_COMPACT) : NULL;
    json_decref(root);
    return text;
}

/* ---- Tiles ---- */

/* How far rounding places moves a surface up or down: half a step of 32767 over the tile, along its steepest edge. */
static double shift_of(const out_drawn_tile *drawn)
{
    const scene_tile_mesh *mesh = drawn->mesh;
    const unsigned char *known = drawn->known + drawn->y * SCENE_BLOCK_VERTICES + drawn->x;
    double steepest = 0; /* squared */
    for (size_t k = 0; k < 3 * mesh->triangle_count; k++) {
        const struct scene_tile_vertex *a = &mesh->vertices[mesh->indices[k]],
                                       *b = &mesh->vertices[mesh->indices[k % 3 == 2 ? k - 2 : k + 1]];
        double i = a->i - b->i, l = a->j - b->j, rise = (double)a->z - (double)b->z;
        double slope = rise * rise / (i * i + l * l);
        /* the wall around what is known is no ground */
        if (slope > steepest && known[a->j * SCENE_BLOCK_VERTICES + a->i] && known[b->j * SCENE_BLOCK_VERTICES + b->i])
            steepest = slope;
    }
    return sqrt(steepest) * mesh->cells / 32767;
}

/* ---- layer.json ---- */

/* NULL: out of memory. */
static json_t *describe_levels(const out_pyramid *p)
{
    json_t *available = json_array();
    bool good = available != NULL;
    for (int level = 0; good && level <= p->deepest; level++) {
        const out_tile_place first = {0, 0}, last = {INT64_MAX, INT64_MAX};
        json_t *ranges =
            level < p->options->first_level ? json_array() : out_tile_list_ranges(&p->list, level, first, last);
        good = json_array_append_new(available, ranges) == 0;
    }
    if (good)
        return available;
    json_decref(available);
    return NULL;
}

static char *describe_layer(const out_pyramid *p)
{
    double bounds[4], meridian_bounds[4];
    if (tl_source_bounds(&p->source->info, bounds, NULL) != TL_OK)
        return NULL;
    memcpy(meridian_bounds, bounds, sizeof bounds);
    if (bounds[2] > 180) /* across the antimeridian: all the way around */
        meridian_bounds[0] = -180, meridian_bounds[2] = 180;
    json_t *root = json_pack("{s:s, s:s, s:s, s:s, s:s, s:[s], s:s, s:[f,f,f,f], s:i, s:i, s:i}", "tilejson", "2.1.0",
                             "format", "quantized-mesh-1.0", "version", "1.0.0", "scheme", "tms", "projection",
                             "EPSG:4326", "tiles", "{z}/{x}/{y}.terrain?v={version}", "name", "terrain", "bounds",
                             meridian_bounds[0], meridian_bounds[1], meridian_bounds[2], meridian_bounds[3], "minzoom",
                             p->options->first_level, "maxzoom", p->deepest, "metadataAvailability", METADATA_LEVELS);
    json_t *extensions = json_array();
    if (!p->options->no_normals)
        json_array_append_new(extensions, json_string("octvertexnormals"));
    json_array_append_new(extensions, json_string("metadata"));
    json_object_set_new(root, "extensions", extensions);
    if (p->options->attribution)
        json_object_set_new(root, "attribution", json_string(p->options->attribution));
    bool good = json_object_set_new(root, "available", describe_levels(p)) == 0;
    json_object_set_new(root, "talus", out_describe_record(p));
    char *text = good ? json_dumps(root, JSON_INDENT(1) | JSON_REAL_PRECISION(17)) : NULL;
    json_decref(root);
    return text;
}

static tl_status finish(const out_pyramid *p, tl_error *error)
{
    char *text = describe_layer(p);
    tl_status status = text ? out_write_inside(p->folder, p->scheme->index, text, strlen(text), true, error)
                            : tl_fail_memory(error, p->folder);
    free(text);
    return status;
}

/* ---- The scheme ---- */

static tl_window window(const out_pyramid *p)
{
    return scene_geodetic_window(p->lattice);
}

static tl_status read_heights(const out_pyramid *p, tl_window window, float *out, tl_error *error)
{
    return scene_geodetic_read(p->lattice, window, out, error);
}

static tl_status compare(const out_pyramid *p, const out_block_place *at, const float *z, double *worst,
                         tl_error *error)
{
    return scene_geodetic_compare(p->lattice, at->column * SCENE_BLOCK, at->row * SCENE_BLOCK, SCENE_BLOCK, z,
                                  SCENE_BLOCK_VERTICES, worst, error);
}

static void *begin_worker(const out_pyramid *p, tl_error *error)
{
    out_terrain_buffer *buffer = malloc(sizeof *buffer);
    if (buffer && out_terrain_buffer_init(buffer, error) == TL_OK)
        return buffer;
    free(buffer);
    tl_fail_memory(error, p->folder);
    return NULL;
}

static void finish_worker(void *worker)
{
    out_terrain_buffer_finish(worker);
    free(worker);
}

static tl_status encode(const out_pyramid *p, void *worker, const out_drawn_tile *drawn, out_piece_tile *tile,
                        const void **bytes, tl_error *error)
{
    out_terrain_buffer *buffer = worker;
    double quantum = 0;
    const bool tells = tile->level % METADATA_LEVELS == 0 && tile->level < p->deepest;
    char *metadata = tells ? describe_below(drawn->below, tile->level, tile->column, tile->row, p->deepest) : NULL;
    if (tells && !metadata)
        return tl_fail_memory(error, p->folder);
    const out_terrain_tile terrain = {.level = tile->level,
                                      .column = tile->column,
                                      .row = tile->row,
                                      .mesh = drawn->mesh,
                                      .block = drawn->block,
                                      .x = drawn->x,
                                      .y = drawn->y,
                                      .normals = !p->options->no_normals,
                                      .metadata = metadata};
    tl_status status = out_terrain_encode(&terrain, buffer, &quantum, error);
    free(metadata);
    tile->error += quantum / 2 + shift_of(drawn);
    tile->bytes = (int64_t)buffer->packed_count;
    *bytes = buffer->packed;
    return status;
}

static void name(const out_piece_tile *tile, char *out, size_t room)
{
    snprintf(out, room, "%d/%lld/%lld.terrain", tile->level, (long long)tile->column, (long long)tile->row);
}

static const out_scheme geographic = {.index = "layer.json",
                                      .roots = 2,
                                      .covers = true,
                                      .window = window,
                                      .read = read_heights,
                                      .compare = compare,
                                      .sag = sag,
                                      .begin_worker = begin_worker,
                                      .finish_worker = finish_worker,
                                      .encode = encode,
                                      .name = name,
                                      .finish = finish};

static tl_status choose_levels(out_pyramid *p, tl_error *error)
{
    const tl_tiles_options *o = p->options;
    p->deepest = o->last_level_given ? o->last_level : scene_geodetic_level(&p->source->info);
    if (p->deepest < 0 || p->deepest >= TL_TILE_LEVELS || o->first_level < 0 || o->first_level > p->deepest)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: levels must be 0 ... %d, the first not behind the last (%d)",
                       p->folder, TL_TILE_LEVELS - 1, p->deepest);
    p->max_error = o->max_error > 0 ? o->max_error : nominal_error(p->deepest) / 4;
    p->report.spacing = scene_geodetic_step(p->deepest);
    return TL_OK;
}

tl_status out_write_quantized_tiles(const tl_source *source, const char *folder, const tl_tiles_options *options,
                                    tl_tiles_report *out, tl_error *error)
{
    out_pyramid p = {.scheme = &geographic, .source = source, .folder = folder, .options = options};
    tl_status status = choose_levels(&p, error);
    if (status == TL_OK) {
        p.lattice = scene_geodetic_create(source, p.deepest, error);
        status = p.lattice ? out_pyramid_make(&p, error) : TL_ERROR_DATA;
    }
    if (status == TL_OK)
        *out = p.report;
    scene_geodetic_destroy(p.lattice);
    out_pyramid_finish(&p);
    return status;
}
