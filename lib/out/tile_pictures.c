#include "lib/out/tile_pictures.h"

#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/out/png_encoder.h"
#include "lib/out/texture.h"
#include "lib/scene/layers.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

enum { KINDS = 2, MOST_SIDE = SCENE_RIM + 1 };

struct out_tile_painter {
    tl_source ground; /* the lattice in work, its first row the last of the lattice, as far as the block in hand goes */
    const out_pyramid *pyramid;
    scene_layer *layers[KINDS];
    const out_drawn_tile *drawn;
    int64_t x, y; /* of the block's first vertex, of the lattice */
    unsigned char *rgba, *bytes[KINDS];
    size_t room[KINDS];
};

static tl_status ground_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const out_tile_painter *p = (const out_tile_painter *)self;
    (void)level;
    (void)error;
    for (int64_t y = 0; y < window.height; y++)
        for (int64_t x = 0; x < window.width; x++) {
            int64_t i = window.x + x - p->x, j = self->info.height - 1 - (window.y + y) - p->y;
            bool inside = i >= 0 && j >= 0 && i < SCENE_BLOCK_VERTICES && j < SCENE_BLOCK_VERTICES;
            out[y * window.width + x] = inside ? p->drawn->block->z[j * SCENE_BLOCK_VERTICES + i] : NAN;
        }
    return TL_OK;
}

/* The lattice in work as a raster of metres; a vertex beyond the last samples may be in it. */
static void set_ground(out_tile_painter *p)
{
    const tl_source_info *info = &p->pyramid->source->info;
    const tl_window all = p->pyramid->scheme->window(p->pyramid);
    const double *t = info->georef.transform;
    const int64_t step = INT64_C(1) << (p->pyramid->deepest - p->pyramid->level);
    tl_source_info *to = &p->ground.info;
    *to = *info;
    to->level = 0;
    to->wraps = false;
    to->has_voids = true;
    to->width = tl_div_up(all.width - 1, step) + 1;
    to->height = tl_div_up(all.height - 1, step) + 1;
    bool turned = t[1] * t[5] - t[2] * t[4] < 0; /* see scene_own_lattice */
    double last = (double)((to->height - 1) * step), first = turned ? (double)(info->height - 1) - last : last;
    for (int a = 0; a < 2; a++) {
        to->georef.transform[3 * a] = t[3 * a] + t[3 * a + 2] * first;
        to->georef.transform[3 * a + 1] = t[3 * a + 1] * (double)step;
        to->georef.transform[3 * a + 2] = t[3 * a + 2] * (double)(turned ? step : -step);
    }
    to->georef.cell_x *= (double)step;
    to->georef.cell_y *= (double)step;
    to->georef.height_unit = 1;
}

out_tile_painter *out_tile_painter_create(const out_pyramid *pyramid, tl_error *error)
{
    static const char *const names[KINDS] = {"albedo", "tangent"}; /* by tl_texture's bits */
    out_tile_painter *p = calloc(1, sizeof *p);
    if (!p) {
        tl_fail_memory(error, "a tile's pictures");
        return NULL;
    }
    p->pyramid = pyramid;
    p->ground.read = ground_read;
    set_ground(p);
    p->rgba = tl_alloc_grid(MOST_SIDE, MOST_SIDE, 4);
    bool good = p->rgba;
    if (!good)
        tl_fail_memory(error, "a tile's pictures");
    for (int k = 0; k < KINDS && good; k++)
        if (pyramid->options->textures >> k & 1) {
            p->layers[k] = scene_layer_create_over(&p->ground, names[k], pyramid->source, error);
            good = p->layers[k];
        }
    if (good)
        return p;
    out_tile_painter_destroy(p);
    return NULL;
}

void out_tile_painter_destroy(out_tile_painter *p)
{
    if (!p)
        return;
    for (int k = 0; k < KINDS; k++) {
        scene_layer_destroy(p->layers[k]);
        free(p->bytes[k]);
    }
    free(p->rgba);
    free(p);
}

/* The PNG, in a file that gets no name. */
static tl_status encode(out_tile_painter *p, int k, int side, size_t *count, tl_error *error)
{
    const scene_picture picture = {.width = side, .height = side, .rgba = p->rgba};
    struct stat written;
    char *path = out_inside(p->pyramid->folder, ".talus/picture");
    tl_output *output = path ? tl_output_open(path, true, error) : NULL;
    tl_status status = output ? out_picture_write(&picture, output, NULL, error)
                       : path ? TL_ERROR_IO
                              : tl_fail_memory(error, p->pyramid->folder);
    if (status == TL_OK)
        status = tl_output_flush(output, error);
    if (status == TL_OK && fstat(tl_output_descriptor(output), &written) != 0)
        status = tl_fail(error, TL_ERROR_IO, "%s: a picture cannot be read back", p->pyramid->folder);
    *count = status == TL_OK ? (size_t)written.st_size : 0;
    if (*count > p->room[k]) {
        free(p->bytes[k]);
        p->bytes[k] = malloc(*count);
        p->room[k] = p->bytes[k] ? *count : 0;
    }
    if (status == TL_OK)
        status = p->bytes[k] ? tl_output_read_at(output, p->bytes[k], *count, 0, error)
                             : tl_fail_memory(error, "a tile's pictures");
    tl_output_abort(output);
    free(path);
    return status;
}

tl_status out_tile_paint(out_tile_painter *p, const out_glb_tile *tile, out_tile_pictures *out, tl_error *error)
{
    const int cells = tile->drawn->mesh->cells, side = cells + 1;
    tl_status status = TL_OK;
    *out = (out_tile_pictures){.cells = cells};
    p->drawn = tile->drawn;
    p->x = tile->x / tile->step - tile->drawn->x;
    p->y = tile->y / tile->step - tile->drawn->y;
    const tl_window window = {tile->x / tile->step, p->ground.info.height - 1 - (tile->y / tile->step + cells), side,
                              side};
    for (int k = 0; k < KINDS && status == TL_OK; k++) {
        if (!p->layers[k])
            continue;
        status = out_texture_pixels(p->layers[k], window, p->rgba, error);
        if (status == TL_OK)
            status = encode(p, k, side, &out->count[k], error);
        out->bytes[k] = p->bytes[k];
    }
    return status;
}
