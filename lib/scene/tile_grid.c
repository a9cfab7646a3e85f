#include "lib/scene/tile_grid.h"

#include "lib/base/size.h"

#include <math.h>

/* Coarser steps than a tile's own that its vertices may be taken from. A tile's farthest vertex is 2^SPAN times as far
 * as its nearest only in pictures of some ten pixels; there the skirts must do. */
enum { SPAN = 4 };

/* A position on a lattice: between vertices index and index + 1. */
typedef struct place {
    int64_t index;
    float part;
} place;

static int64_t sample_of(int64_t vertex, int step, int64_t samples)
{
    return tl_int64_min(vertex << step, samples - 1);
}

static place place_on(int64_t sample, int step, int64_t samples, int64_t vertices)
{
    int64_t index = tl_int64_min(sample >> step, vertices - 2);
    int64_t low = index << step, high = sample_of(index + 1, step, samples);
    return (place){index, (float)(sample - low) / (float)(high - low)};
}

void scene_tile_cells(const scene_pyramid *pyramid, scene_tile_id tile, int *columns, int *rows)
{
    const scene_lattice *l = &pyramid->lattices[tile.step];
    *columns = (int)tl_int64_min(SCENE_TILE, l->width - 1 - tile.column * SCENE_TILE);
    *rows = (int)tl_int64_min(SCENE_TILE, l->height - 1 - tile.row * SCENE_TILE);
}

static int64_t clamp(int64_t vertex, int64_t vertices)
{
    return vertex < 0 ? 0 : vertex >= vertices ? vertices - 1 : vertex;
}

void scene_tile_positions(const scene_ground *ground, scene_tile_id tile, double x[SCENE_GRID], double y[SCENE_GRID])
{
    const scene_lattice *l = &ground->pyramid->lattices[tile.step];
    const tl_source_info *info = &ground->pyramid->source->info;
    for (int k = 0; k < SCENE_GRID; k++) {
        int64_t i = clamp(tile.column * SCENE_TILE + k - 1, l->width);
        int64_t j = clamp(tile.row * SCENE_TILE + k - 1, l->height);
        x[k] = ((double)sample_of(i, tile.step, info->width) - (double)(info->width - 1) / 2) * ground->cell_x;
        y[k] = ((double)(info->height - 1) / 2 - (double)sample_of(j, tile.step, info->height)) * ground->cell_y;
    }
}

double scene_ground_pixel(const scene_ground *ground, double x, double y)
{
    double dx = x - ground->eye[0], dy = y - ground->eye[1];
    return sqrt(dx * dx + dy * dy + ground->rise * ground->rise) * ground->per_metre;
}

static float at(const scene_lattice *l, place x, place y)
{
    const float *p = l->heights + (y.index - l->window.y) * l->window.width + (x.index - l->window.x);
    float corners[4] = {p[0], p[1], p[l->window.width], p[l->window.width + 1]};
    float weights[4] = {(1 - x.part) * (1 - y.part), x.part * (1 - y.part), (1 - x.part) * y.part, x.part * y.part};
    float sum = weights[0] * corners[0] + weights[1] * corners[1] + weights[2] * corners[2] + weights[3] * corners[3];
    if (!isnan(sum))
        return sum;
    float valid = sum = 0;
    for (int k = 0; k < 4; k++)
        if (!isnan(corners[k])) {
            sum += weights[k] * corners[k];
            valid += weights[k];
        }
    return valid >= 0.5f ? sum / valid : NAN;
}

/* The step whose cells are a pixel at most, and the way to the next one, continuous in q. */
static int step_of(double q, int least, int most, float *part)
{
    int exponent;
    double mantissa = frexp(q, &exponent); /* q = mantissa * 2^exponent, mantissa in [0.5, 1) */
    *part = (float)(2 * mantissa - 1);
    int step = exponent - 1;
    if (step < least || step >= most) {
        *part = 0;
        step = step < least ? least : most;
    }
    return step;
}

typedef struct places {
    place x[SPAN + 1][SCENE_GRID], y[SPAN + 1][SCENE_GRID];
} places;

static void find_places(const scene_pyramid *p, scene_tile_id tile, int most, places *out)
{
    const tl_source_info *info = &p->source->info;
    const scene_lattice *l = &p->lattices[tile.step];
    for (int k = 0; k < SCENE_GRID; k++) {
        int64_t i = sample_of(clamp(tile.column * SCENE_TILE + k - 1, l->width), tile.step, info->width);
        int64_t j = sample_of(clamp(tile.row * SCENE_TILE + k - 1, l->height), tile.step, info->height);
        for (int s = tile.step; s <= most; s++) {
            out->x[s - tile.step][k] = place_on(i, s, info->width, p->lattices[s].width);
            out->y[s - tile.step][k] = place_on(j, s, info->height, p->lattices[s].height);
        }
    }
}

void scene_tile_heights(const scene_ground *ground, const scene_lattice *lattices, scene_tile_id tile, const double *x,
                        const double *y, float heights[SCENE_GRID * SCENE_GRID])
{
    const scene_pyramid *p = ground->pyramid;
    places where;
    int columns, rows, most = tile.step + SPAN < p->top ? tile.step + SPAN : p->top;
    scene_tile_cells(p, tile, &columns, &rows);
    find_places(p, tile, most, &where);
    /* outside of the raster there is nothing */
    const scene_lattice *l = &p->lattices[tile.step];
    int first_x = tile.column == 0, last_x = columns + 1 + (tile.column * SCENE_TILE + columns < l->width - 1);
    int first_y = tile.row == 0, last_y = rows + 1 + (tile.row * SCENE_TILE + rows < l->height - 1);
    for (int j = 0; j < SCENE_GRID; j++)
        for (int i = 0; i < SCENE_GRID; i++) {
            float *out = &heights[j * SCENE_GRID + i];
            *out = NAN;
            if (i < first_x || i > last_x || j < first_y || j > last_y)
                continue;
            float part;
            int s = step_of(scene_ground_pixel(ground, x[i], y[j]), tile.step, most, &part), k = s - tile.step;
            *out = at(&lattices[s], where.x[k][i], where.y[k][j]);
            if (part > 0) {
                float coarse = at(&lattices[s + 1], where.x[k + 1][i], where.y[k + 1][j]);
                *out = isnan(coarse) ? *out : *out * (1 - part) + coarse * part;
            }
        }
}
