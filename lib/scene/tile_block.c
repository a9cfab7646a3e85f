#include "lib/scene/tile_block.h"

#include "dem/framework_pyramid.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { SIDE = SCENE_BLOCK_SIDE, ROW = SCENE_BLOCK_VERTICES };

tl_status scene_block_init(scene_block *block, bool lost, tl_error *error)
{
    *block = (scene_block){.z = tl_alloc_grid(ROW, ROW, sizeof *block->z),
                           .lost = lost ? tl_alloc_grid(SIDE, SIDE, sizeof *block->lost) : NULL,
                           .errors = tl_alloc_grid(ROW, ROW, sizeof *block->errors),
                           .rising = lost ? tl_alloc_grid(ROW, ROW, sizeof *block->rising) : NULL};
    if (block->z && block->errors && (!lost || (block->lost && block->rising)))
        return TL_OK;
    scene_block_finish(block);
    return tl_fail_memory(error, "a block of tiles");
}

void scene_block_finish(scene_block *block)
{
    free(block->z);
    free(block->lost);
    free(block->errors);
    free(block->rising);
    *block = (scene_block){0};
}

/* ---- Errors ---- */

static tl_status measure_samples(scene_block *block, tl_error *error)
{
    const tl_source_info info = {
        .width = ROW, .height = ROW, .type = TL_RASTER_POINT, .georef = tl_georef_none(), .name = "a block of tiles"};
    const tl_run run = {.threads = 1};
    /* as floats: codes are relative to the block's own range, and would differ from those of the neighbours */
    const tl_pyramid_options options = {.exact = true, .frame = TL_FRAME_PIXEL, .run = &run};
    tl_source *source = tl_array_source_create(block->z, &info, error);
    tl_pyramid *pyramid = source ? tl_pyramid_create(source, &options, error) : NULL;
    if (pyramid) { /* which are of the same size */
        float *swapped = block->errors;
        block->errors = pyramid->errors;
        pyramid->errors = swapped;
    }
    tl_pyramid_destroy(pyramid);
    tl_source_destroy(source);
    return pyramid ? TL_OK : TL_ERROR_MEMORY;
}

static float lost_at(const scene_block *block, int x, int y)
{
    return x >= 0 && y >= 0 && x < SIDE && y < SIDE ? block->lost[y * SIDE + x] : 0;
}

static float greater(float a, float b)
{
    return a > b ? a : b;
}

static void raise_to(float *lost, const int64_t parents[2][2], float by)
{
    for (int k = 0; k < 2; k++)
        if (parents[k][0] >= 0 && parents[k][1] >= 0 && parents[k][0] < ROW && parents[k][1] < ROW) {
            float *at = &lost[parents[k][1] * ROW + parents[k][0]];
            *at = greater(*at, by);
        }
}

static void raise_parents(float *lost, int s, bool centres)
{
    for (int y = centres ? s : 0; y < ROW; y += centres ? 2 * s : s)
        for (int x = centres || (y / s) % 2 == 0 ? s : 0; x < ROW; x += 2 * s) {
            int64_t parents[2][2];
            if (!(lost[y * ROW + x] > 0))
                continue; /* as all over ground that is not known */
            tl_lattice_parents(x, y, parents);
            raise_to(lost, (const int64_t(*)[2])parents, lost[y * ROW + x]);
        }
}

/* Of the four cells around each vertex of a row. */
static void gather_row(const scene_block *block, int y, float *restrict out)
{
    const float *above = block->lost + y * SIDE, *below = above - SIDE;
    out[0] = greater(lost_at(block, 0, y - 1), lost_at(block, 0, y));
    for (int x = 1; x < SIDE; x++) {
        float lower = y > 0 ? greater(below[x - 1], below[x]) : 0,
              upper = y < SIDE ? greater(above[x - 1], above[x]) : 0;
        out[x] = greater(lower, upper);
    }
    out[SIDE] = greater(lost_at(block, SIDE - 1, y - 1), lost_at(block, SIDE - 1, y));
}

/* What the cells under each vertex and all that depend on it have lost, into `out`: those of the smallest triangles lie
 * in the four cells around their vertex, and what a vertex depends on takes over from it. */
static void gather_lost(const scene_block *block, float *out)
{
    for (int y = 0; y < ROW; y++)
        gather_row(block, y, out + y * ROW);
    for (int s = 1; s < SCENE_RIM; s *= 2) {
        raise_parents(out, s, false);
        raise_parents(out, s, true);
    }
}

tl_status scene_block_measure(scene_block *block, tl_error *error)
{
    tl_status status = measure_samples(block, error);
    if (status != TL_OK || !block->lost)
        return status;
    gather_lost(block, block->rising);
    for (size_t k = 0; k < (size_t)ROW * ROW; k++)
        block->errors[k] += block->rising[k];
    return TL_OK;
}

/* ---- Tiles ---- */

tl_status scene_tile_mesh_init(scene_tile_mesh *mesh, tl_error *error)
{
    size_t most = (SCENE_RIM + 1) * (SCENE_RIM + 1);
    *mesh = (scene_tile_mesh){.vertices = tl_alloc(most, sizeof *mesh->vertices),
                              .indices = tl_alloc(most, 6 * sizeof *mesh->indices),
                              .numbers = tl_alloc(most, sizeof *mesh->numbers)};
    if (mesh->vertices && mesh->indices && mesh->numbers)
        return TL_OK;
    scene_tile_mesh_finish(mesh);
    return tl_fail_memory(error, "a tile");
}

void scene_tile_mesh_finish(scene_tile_mesh *mesh)
{
    free(mesh->vertices);
    free(mesh->indices);
    free(mesh->numbers);
    *mesh = (scene_tile_mesh){0};
}

typedef struct drawing {
    const scene_block *block;
    int x, y; /* of the tile in the block */
    const double *limits;
    scene_tile_mesh *mesh;
} drawing;

typedef struct place {
    int i, j;
} place;

static uint32_t number_of(const drawing *d, place p)
{
    scene_tile_mesh *mesh = d->mesh;
    int32_t *number = &mesh->numbers[p.j * (mesh->cells + 1) + p.i];
    if (*number < 0) {
        *number = (int32_t)mesh->vertex_count;
        mesh->vertices[mesh->vertex_count++] = (struct scene_tile_vertex){
            (int16_t)p.i, (int16_t)p.j, d->block->z[(size_t)(d->y + p.j) * ROW + (size_t)(d->x + p.i)]};
    }
    return (uint32_t)*number;
}

static bool is_void(const drawing *d, place a, place b, place c)
{
    const float *z = d->block->z + (size_t)d->y * ROW + (size_t)d->x;
    return isnan(z[a.j * ROW + a.i]) || isnan(z[b.j * ROW + b.i]) || isnan(z[c.j * ROW + c.i]);
}

/* The triangle a, b, c, counter-clockwise, with its right angle at a. */
static void draw_triangle(const drawing *d, place a, place b, place c, int size)
{
    scene_tile_mesh *mesh = d->mesh;
    if (size) { /* its hypotenuse has a middle on the lattice */
        place middle = {(b.i + c.i) / 2, (b.j + c.j) / 2};
        double error = (double)d->block->errors[(size_t)(d->y + middle.j) * ROW + (size_t)(d->x + middle.i)];
        if (error > d->limits[size]) {
            draw_triangle(d, middle, a, b, size - 1);
            draw_triangle(d, middle, c, a, size - 1);
            return;
        }
        if (is_void(d, a, b, c))
            return;
        mesh->error = error > mesh->error ? error : mesh->error;
    } else if (is_void(d, a, b, c))
        return;
    else if (d->block->lost) {                                    /* half a cell, of which finer lattices know more */
        int x = (a.i + b.i + c.i) / 3, y = (a.j + b.j + c.j) / 3; /* rounds down into it */
        double lost = (double)d->block->lost[(size_t)(d->y + y) * SIDE + (size_t)(d->x + x)];
        mesh->lost = lost > mesh->lost ? lost : mesh->lost;
    }
    uint32_t *corner = mesh->indices + 3 * mesh->triangle_count++;
    corner[0] = number_of(d, a);
    corner[1] = number_of(d, b);
    corner[2] = number_of(d, c);
}

void scene_tile_draw(const scene_block *block, int x, int y, int cells, const double limits[SCENE_TILE_SIZES],
                     scene_tile_mesh *mesh)
{
    const drawing d = {block, x, y, limits, mesh};
    mesh->cells = cells;
    mesh->vertex_count = mesh->triangle_count = 0;
    mesh->error = mesh->lost = 0;
    memset(mesh->numbers, 0xff, (size_t)(cells + 1) * (size_t)(cells + 1) * sizeof *mesh->numbers);
    int size = cells > 1 ? tl_size_of(cells / 2, true) : 0;
    const place sw = {0, 0}, se = {cells, 0}, ne = {cells, cells}, nw = {0, cells};
    if ((x / cells + y / cells) % 2 == 0) { /* the diagonal goes from the south-west to the north-east */
        draw_triangle(&d, se, ne, sw, size);
        draw_triangle(&d, nw, sw, ne, size);
    } else {
        draw_triangle(&d, sw, se, nw, size);
        draw_triangle(&d, ne, nw, se, size);
    }
}
