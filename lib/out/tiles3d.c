/* Pyramids of 3D Tiles 1.1: the source's own lattice, in an implicit quadtree. */
#include "lib/out/tiles3d.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/out/tile_pictures.h"
#include "lib/out/tile_schemes.h"

#include "lib/out/triangles.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

enum { SKIRT_LEVELS = 3 };

static tl_window window(const out_pyramid *p)
{
    return scene_own_lattice_window(p->lattice);
}

static tl_status read_heights(const out_pyramid *p, tl_window w, float *out, tl_error *error)
{
    return scene_own_lattice_read(p->lattice, w, out, error);
}

static double sag(const out_pyramid *p, int lattice, int size)
{
    return scene_own_lattice_sag(p->lattice, ldexp(1, size + 1 + 2 * (p->deepest - lattice)));
}

/* ---- Contents ---- */

typedef struct worker {
    out_glb_encoder *encoder;
    out_tile_painter *painter; /* NULL: no pictures */
} worker;

static void finish_worker(void *context)
{
    worker *w = context;
    out_glb_encoder_destroy(w->encoder);
    out_tile_painter_destroy(w->painter);
    free(w);
}

static void *begin_worker(const out_pyramid *p, tl_error *error)
{
    const out_glb_style style = {.normals = !p->options->no_normals,
                                 .compressed = p->options->coding == TL_CODING_COMPRESSED,
                                 .attribution = p->options->attribution};
    worker *w = calloc(1, sizeof *w);
    if (!w) {
        tl_fail_memory(error, p->folder);
        return NULL;
    }
    w->encoder = out_glb_encoder_create(p->lattice, &style, error);
    w->painter = w->encoder && p->options->textures ? out_tile_painter_create(p, error) : NULL;
    if (w->encoder && (w->painter || !p->options->textures))
        return w;
    finish_worker(w);
    return NULL;
}

/* Down from an edge to that of a neighbour up to SKIRT_LEVELS levels coarser: the errors of both, where errors at most
 * double from level to level, as bounds do. */
static double skirt_of(const out_pyramid *p, const out_piece_tile *tile)
{
    return fmax(tile->error, out_pyramid_bound(p, tile->level)) * (1 + (1 << SKIRT_LEVELS));
}

static tl_status encode(const out_pyramid *p, void *context, const out_drawn_tile *drawn, out_piece_tile *tile,
                        const void **bytes, tl_error *error)
{
    int64_t cells = (int64_t)OUT_TILE_CELLS << (p->deepest - tile->level);
    worker *w = context;
    out_glb_tile glb = {.drawn = drawn,
                        .x = tile->column * cells,
                        .y = tile->row * cells,
                        .step = cells / drawn->mesh->cells,
                        .skirt = skirt_of(p, tile)};
    out_glb_facts facts;
    size_t count = 0;
    out_tile_pictures pictures;
    tl_status status = w->painter ? out_tile_paint(w->painter, &glb, &pictures, error) : TL_OK;
    if (w->painter)
        glb.pictures = &pictures;
    if (status == TL_OK)
        status = out_glb_encode(w->encoder, &glb, bytes, &count, &facts, error);
    tile->bytes = (int64_t)count;
    if (status != TL_OK || !count)
        return status;
    /* rounding moves vertices by sqrt(3) / 2 of a step in any direction */
    tile->error += 0.8661 * facts.quantum * hypot(1, facts.steepest);
    for (int k = 0; k < 6; k++)
        tile->region[k] = facts.region[k];
    return TL_OK;
}

static void name(const out_piece_tile *tile, char *out, size_t room)
{
    snprintf(out, room, "content/%d/%lld/%lld.glb", tile->level, (long long)tile->column, (long long)tile->row);
}

/* ---- The whole ---- */

static const out_scheme own = {.index = "tileset.json",
                               .roots = 1,
                               .keeps_tiles = true,
                               .window = window,
                               .read = read_heights,
                               .sag = sag,
                               .begin_worker = begin_worker,
                               .finish_worker = finish_worker,
                               .encode = encode,
                               .name = name,
                               .finish = out_tileset_write};

/* A sixteenth of a cell: as near as what globes take a level for is to it. */
static tl_status choose_levels(out_pyramid *p, tl_error *error)
{
    const tl_tiles_options *o = p->options;
    const tl_window w = scene_own_lattice_window(p->lattice);
    const tl_georef *georef = &p->source->info.georef;
    while (p->deepest < TL_TILE_LEVELS &&
           ((int64_t)OUT_TILE_CELLS << p->deepest) < (w.width > w.height ? w.width : w.height) - 1)
        p->deepest++;
    if (p->deepest >= TL_TILE_LEVELS)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: has more samples than %d levels hold; take a part of it by --bbox", p->source->info.name,
                       TL_TILE_LEVELS);
    if (o->last_level_given && o->last_level != p->deepest)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: the last level of 3D Tiles is that of the samples, %d; --extra-levels makes more",
                       p->folder, p->deepest);
    if (o->first_level < 0 || o->first_level > p->deepest)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the first level must be 0 ... %d", p->folder, p->deepest);
    p->max_error = o->max_error > 0 ? o->max_error : fmax(georef->cell_x, georef->cell_y) / 16;
    p->report.spacing = fmax(georef->cell_x, georef->cell_y);
    return TL_OK;
}

tl_status out_write_3d_tiles(const tl_source *source, const char *folder, const tl_tiles_options *options,
                             tl_tiles_report *out, tl_error *error)
{
    out_pyramid p = {.scheme = &own, .source = source, .folder = folder, .options = options};
    if (options->coding == TL_CODING_COMPRESSED && !OUT_HAS_CODECS)
        return out_lacks_codecs(folder, error);
    scene_own_lattice *lattice = scene_own_lattice_create(source, error);
    if (!lattice)
        return TL_ERROR_ARGUMENT;
    p.lattice = lattice;
    meshopt_encodeVertexVersion(0); /* those of the extension */
    meshopt_encodeIndexVersion(1);
    tl_status status = choose_levels(&p, error);
    if (status == TL_OK)
        status = out_pyramid_make(&p, error);
    if (status == TL_OK)
        *out = p.report;
    scene_own_lattice_destroy(lattice);
    out_pyramid_finish(&p);
    return status;
}
