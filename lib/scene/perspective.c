/* The picture from a point of view: tiles of triangles of about a pixel, into a z-buffer, block by block. */
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/scene/camera.h"
#include "lib/scene/light.h"
#include "lib/scene/mesh_colour.h"
#include "lib/scene/render.h"
#include "lib/scene/tile_grid.h"
#include "lib/scene/zbuffer.h"

#include <math.h>
#include <string.h>

enum {
    SUPER = 2, /* fragments a pixel each way */
    BLOCK_WIDTH = 256,
    BLOCK_HEIGHT = 128, /* pixels drawn at once: their fragments stay in the second-level cache */
    NEAR_SAMPLES = 512, /* least side of the windows in which close-ups are read: a few tiles of a file */
    PALETTE_SAMPLES = 1 << 16,
    DEFAULT_WIDTH = 1920,
    DEFAULT_HEIGHT = 1080,
    GRID_BYTES = SCENE_GRID * SCENE_GRID * sizeof(float),
};

typedef struct tile {
    scene_tile_id id;
    double distance;       /* from the eye to its box, for the order of drawing */
    scene_outline outline; /* in fragments */
    float *heights;        /* GRID_BYTES; NULL for tiles of steps that the pyramid holds */
} tile;

typedef struct scene {
    scene_pyramid pyramid;
    scene_ground ground;
    scene_camera camera; /* its pixels are fragments */
    scene_palette palette;
    scene_colours *colours; /* NULL: by height */
    scene_light light;
    double low, high; /* of all ground, exaggerated metres */
    double foot;
    double near_plane, haze; /* metres; at the latter half of the light is lost; 0: clear air */
    tile *tiles;             /* front to back */
    size_t tile_count, tile_room;
    scene_picture *picture;
} scene;

/* ---- tiles ---- */

/* The part of the raster that a tile covers, in samples. */
static void tile_samples(const scene_pyramid *p, scene_tile_id id, int64_t *x0, int64_t *x1, int64_t *y0, int64_t *y1)
{
    const tl_source_info *info = &p->source->info;
    int64_t size = (int64_t)SCENE_TILE << id.step;
    *x0 = id.column * size;
    *y0 = id.row * size;
    *x1 = tl_int64_min(*x0 + size, info->width - 1);
    *y1 = tl_int64_min(*y0 + size, info->height - 1);
}

/* False where all is void. */
static bool tile_box(const scene *s, scene_tile_id id, scene_box *box)
{
    const tl_source_info *info = &s->pyramid.source->info;
    scene_bounds bounds = scene_pyramid_bounds(&s->pyramid, id.step, id.column, id.row);
    int64_t x0, x1, y0, y1;
    tile_samples(&s->pyramid, id, &x0, &x1, &y0, &y1);
    double middle_x = (double)(info->width - 1) / 2, middle_y = (double)(info->height - 1) / 2;
    *box = (scene_box){{((double)x0 - middle_x) * s->ground.cell_x, (middle_y - (double)y1) * s->ground.cell_y,
                        (double)bounds.low * s->ground.metres},
                       {((double)x1 - middle_x) * s->ground.cell_x, (middle_y - (double)y0) * s->ground.cell_y,
                        (double)bounds.high * s->ground.metres}};
    /* vertices of coarse steps are means that reach over the tile's rim */
    double reach = ldexp(fmax(s->ground.cell_x, s->ground.cell_y), id.step);
    box->low[2] = fmax(box->low[2] - reach, s->low);
    box->high[2] = fmin(box->high[2] + reach, s->high);
    bool side = x0 == 0 || y0 == 0 || x1 == info->width - 1 || y1 == info->height - 1;
    if (side || info->has_voids) /* walls */
        box->low[2] = s->foot;
    return bounds.low <= bounds.high;
}

static double outside_of(double position, double low, double high)
{
    return position < low ? low - position : position > high ? position - high : 0;
}

static tl_status add_tile(scene *s, scene_tile_id id, double distance, const scene_outline *outline, tl_error *error)
{
    if (s->tile_count == s->tile_room) {
        size_t room = s->tile_room ? 2 * s->tile_room : 256;
        tile *grown = room < SIZE_MAX / sizeof *grown ? realloc(s->tiles, room * sizeof *grown) : NULL;
        if (!grown)
            return tl_fail_memory(error, "the view");
        s->tiles = grown;
        s->tile_room = room;
    }
    s->tiles[s->tile_count++] = (tile){.id = id, .distance = distance, .outline = *outline};
    return TL_OK;
}

/* Adds the tiles under `id` that may be seen, of the coarsest step whose cells are a pixel at most where it is nearest.
 */
static tl_status select_tiles(scene *s, scene_tile_id id, tl_error *error)
{
    scene_box box;
    scene_outline outline;
    if (!tile_box(s, id, &box) || !scene_camera_outline(&s->camera, &box, &outline))
        return TL_OK;
    double dx = outside_of(s->ground.eye[0], box.low[0], box.high[0]),
           dy = outside_of(s->ground.eye[1], box.low[1], box.high[1]),
           dz = outside_of(s->camera.eye[2], box.low[2], box.high[2]);
    double pixel = scene_ground_pixel(&s->ground, s->ground.eye[0] + dx, s->ground.eye[1] + dy);
    if (id.step == 0 || pixel >= ldexp(1, id.step))
        return add_tile(s, id, hypot(hypot(dx, dy), dz), &outline, error);
    const scene_lattice *finer = &s->pyramid.lattices[id.step - 1];
    tl_status status = TL_OK;
    for (int k = 0; k < 4 && status == TL_OK; k++) {
        scene_tile_id child = {id.step - 1, 2 * id.column + (k & 1), 2 * id.row + (k >> 1)};
        if (child.column * SCENE_TILE < finer->width - 1 && child.row * SCENE_TILE < finer->height - 1)
            status = select_tiles(s, child, error);
    }
    return status;
}

static int front_to_back(const void *a, const void *b)
{
    const tile *s = a, *t = b;
    if (s->distance != t->distance)
        return s->distance < t->distance ? -1 : 1;
    if (s->id.step != t->id.step)
        return s->id.step - t->id.step;
    int64_t order = s->id.row != t->id.row ? s->id.row - t->id.row : s->id.column - t->id.column;
    return order < 0 ? -1 : order > 0;
}

/* ---- close-ups: tiles finer than the pyramid's base, made from the source ---- */

/* Tiles below one square of the raster, which are read at once. */
typedef struct close_up {
    int64_t column, row; /* of squares */
    size_t tile;         /* index in scene.tiles */
} close_up;

typedef struct close_ups {
    scene *scene;
    int square;     /* log2 of the samples on a side of a square */
    close_up *list; /* by square */
    size_t *starts; /* of the squares in the list, and its end */
} close_ups;

static int by_square(const void *a, const void *b)
{
    const close_up *s = a, *t = b;
    int64_t order = s->row != t->row ? s->row - t->row : s->column - t->column;
    if (order == 0)
        return s->tile < t->tile ? -1 : s->tile > t->tile;
    return order < 0 ? -1 : 1;
}

/* Reads one square, with a margin of two of the coarsest cells needed, and makes its tiles. */
static tl_status read_square(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const close_ups *c = context;
    scene *s = c->scene;
    const scene_pyramid *p = &s->pyramid;
    const tl_source_info *info = &p->source->info;
    int64_t x0 = INT64_MAX, x1 = 0, y0 = INT64_MAX, y1 = 0;
    int step = p->base;
    for (size_t k = c->starts[item]; k < c->starts[item + 1]; k++) {
        const tile *t = &s->tiles[c->list[k].tile];
        int64_t left, right, up, down;
        tile_samples(p, t->id, &left, &right, &up, &down);
        x0 = tl_int64_min(x0, left);
        x1 = tl_int64_max(x1, right);
        y0 = tl_int64_min(y0, up);
        y1 = tl_int64_max(y1, down);
        step = t->id.step < step ? t->id.step : step;
    }
    int64_t margin = INT64_C(2) << p->base;
    x0 = tl_int64_max(0, x0 - margin) >> step;
    y0 = tl_int64_max(0, y0 - margin) >> step;
    x1 = tl_int64_min(p->lattices[step].width - 1, tl_div_up(tl_int64_min(info->width - 1, x1 + margin), 1 << step));
    y1 = tl_int64_min(p->lattices[step].height - 1, tl_div_up(tl_int64_min(info->height - 1, y1 + margin), 1 << step));
    scene_lattice lattices[SCENE_STEPS];
    tl_status status = scene_near_init(lattices, p, step, (tl_window){x0, y0, x1 - x0 + 1, y1 - y0 + 1}, error);
    if (status != TL_OK)
        return status;
    for (size_t k = c->starts[item]; k < c->starts[item + 1]; k++) {
        const tile *t = &s->tiles[c->list[k].tile];
        double x[SCENE_GRID], y[SCENE_GRID];
        scene_tile_positions(&s->ground, t->id, x, y);
        scene_tile_heights(&s->ground, lattices, t->id, x, y, t->heights);
    }
    scene_near_finish(lattices, p);
    return TL_OK;
}

static tl_status list_close_ups(close_ups *c, size_t count, tl_error *error)
{
    scene *s = c->scene;
    size_t listed = 0;
    for (size_t k = 0; k < s->tile_count; k++) {
        tile *t = &s->tiles[k];
        if (t->id.step >= s->pyramid.base)
            continue;
        t->heights = malloc(GRID_BYTES);
        if (!t->heights)
            return tl_fail_memory(error, "the view");
        int64_t x0, x1, y0, y1;
        tile_samples(&s->pyramid, t->id, &x0, &x1, &y0, &y1);
        c->list[listed++] = (close_up){x0 >> c->square, y0 >> c->square, k};
    }
    qsort(c->list, count, sizeof *c->list, by_square);
    return TL_OK;
}

static tl_status make_close_ups(scene *s, const tl_run *run, tl_error *error)
{
    size_t count = 0, squares = 0;
    for (size_t k = 0; k < s->tile_count; k++)
        count += s->tiles[k].id.step < s->pyramid.base;
    if (count == 0)
        return TL_OK;
    /* a tile of the step below the base is one square at least */
    int square = 9 > s->pyramid.base + 5 ? 9 : s->pyramid.base + 5;
    _Static_assert(NEAR_SAMPLES == 1 << 9 && SCENE_TILE == 1 << 6, "the logarithms above");
    close_ups c = {.scene = s, .square = square};
    c.list = tl_alloc(count, sizeof *c.list);
    c.starts = tl_alloc(count + 1, sizeof *c.starts);
    tl_status status = c.list && c.starts ? list_close_ups(&c, count, error) : tl_fail_memory(error, "the view");
    for (size_t k = 0; k < count && status == TL_OK; k++)
        if (k == 0 || c.list[k].row != c.list[k - 1].row || c.list[k].column != c.list[k - 1].column)
            c.starts[squares++] = k;
    if (status == TL_OK) {
        c.starts[squares] = count;
        status = tl_parallel_for(run, squares, 0, read_square, &c, error);
    }
    free(c.list);
    free(c.starts);
    return status;
}

/* ---- drawing a tile ---- */

/* What one worker needs for drawing tiles. */
typedef struct easel {
    scene_zbuffer buffer;
    double x[SCENE_GRID], y[SCENE_GRID];
    float heights[SCENE_GRID * SCENE_GRID];
    scene_corner corners[SCENE_GRID * SCENE_GRID];
} easel;

static void see(const scene *s, double x, double y, double z, scene_corner *corner)
{
    double v[3];
    scene_camera_view(&s->camera, (const double[3]){x, y, z}, v);
    corner->x = v[0];
    corner->y = v[1];
    corner->w = v[2];
}

/* The slope from a to b, whichever neighbours are there. */
static float slope(const easel *e, int here, int before, int after, double at_before, double at_here, double at_after,
                   double metres)
{
    float low = e->heights[before], high = e->heights[after];
    double rise = 0, run = 1;
    if (!isnan(low) && !isnan(high)) {
        rise = (double)high - (double)low;
        run = at_after - at_before;
    } else if (!isnan(high)) {
        rise = (double)high - (double)e->heights[here];
        run = at_after - at_here;
    } else if (!isnan(low)) {
        rise = (double)e->heights[here] - (double)low;
        run = at_here - at_before;
    }
    double result = rise * metres / run;
    return (float)fmin(fmax(result, -1e6), 1e6);
}

static void place_corners(const scene *s, easel *e, int columns, int rows)
{
    for (int j = 1; j <= rows + 1; j++)
        for (int i = 1; i <= columns + 1; i++) {
            int k = j * SCENE_GRID + i;
            if (isnan(e->heights[k]))
                continue;
            scene_corner *c = &e->corners[k];
            see(s, e->x[i], e->y[j], (double)e->heights[k] * s->ground.metres, c);
            c->height = e->heights[k];
            c->east = slope(e, k, k - 1, k + 1, e->x[i - 1], e->x[i], e->x[i + 1], s->ground.metres);
            c->north = slope(e, k, k - SCENE_GRID, k + SCENE_GRID, e->y[j - 1], e->y[j], e->y[j + 1], s->ground.metres);
        }
}

/* The corner of a cell that alone is missing; 4: none is, -1: more are, so that nothing is drawn there. */
static int missing_corner(const easel *e, int k)
{
    const int at[4] = {k, k + 1, k + SCENE_GRID + 1, k + SCENE_GRID};
    int missing = 4;
    for (int n = 0; n < 4; n++)
        if (isnan(e->heights[at[n]])) {
            if (missing != 4)
                return -1;
            missing = n;
        }
    return missing;
}

/* One cell; with a corner missing the triangle of the others. The diagonal joins the corners that differ less, so that
 * ridges and valleys are not cut into teeth. */
static void draw_cell(easel *e, int k)
{
    const int at[4] = {k, k + 1, k + SCENE_GRID + 1, k + SCENE_GRID};
    int missing = missing_corner(e, k), first = (missing + 1) & 3;
    if (missing < 0)
        return;
    if (missing == 4) {
        float falling = fabsf(e->heights[at[0]] - e->heights[at[2]]),
              rising = fabsf(e->heights[at[1]] - e->heights[at[3]]);
        first = rising < falling;
        scene_zbuffer_triangle(&e->buffer, &e->corners[at[first]], &e->corners[at[first + 2]],
                               &e->corners[at[(first + 3) & 3]]);
    }
    scene_zbuffer_triangle(&e->buffer, &e->corners[at[first]], &e->corners[at[(first + 1) & 3]],
                           &e->corners[at[(first + 2) & 3]]);
}

/* A curtain from the vertices a and b down by `drop` metres, or, as a wall that looks towards (east, north), to the
 * model's foot. */
typedef struct curtain {
    bool wall;
    float east, north;
    double drop;
} curtain;

static void hang(const scene *s, const easel *e, const curtain *t, int k, scene_corner *top, scene_corner *bottom)
{
    *top = e->corners[k];
    if (t->wall) {
        top->height = NAN; /* says that the slopes are a direction */
        top->east = t->east;
        top->north = t->north;
    }
    *bottom = *top;
    double z = t->wall ? s->foot : (double)e->heights[k] * s->ground.metres - t->drop;
    see(s, e->x[k % SCENE_GRID], e->y[k / SCENE_GRID], z, bottom);
}

static void draw_curtain(const scene *s, easel *e, const curtain *t, int a, int b)
{
    if (isnan(e->heights[a]) || isnan(e->heights[b]))
        return;
    scene_corner top[2], bottom[2];
    hang(s, e, t, a, &top[0], &bottom[0]);
    hang(s, e, t, b, &top[1], &bottom[1]);
    scene_zbuffer_triangle(&e->buffer, &top[0], &top[1], &bottom[1]);
    scene_zbuffer_triangle(&e->buffer, &top[0], &bottom[1], &bottom[0]);
}

/* Hides the hair-fine gaps at tiles of another step: as deep as a cell is long, and hence about a pixel. */
static void draw_skirts(const scene *s, easel *e, scene_tile_id id, int columns, int rows)
{
    const scene_lattice *l = &s->pyramid.lattices[id.step];
    const curtain skirt = {.drop = ldexp(fmin(s->ground.cell_x, s->ground.cell_y), id.step)};
    int corner = SCENE_GRID + 1;
    const int first[4] = {corner, corner + rows * SCENE_GRID, corner, corner + columns};
    const bool end[4] = {id.row == 0, id.row * SCENE_TILE + rows == l->height - 1, id.column == 0,
                         id.column * SCENE_TILE + columns == l->width - 1};
    for (int k = 0; k < 4; k++) {
        int stride = k < 2 ? 1 : SCENE_GRID, count = k < 2 ? columns : rows;
        for (int n = 0; n < count && !end[k]; n++)
            draw_curtain(s, e, &skirt, first[k] + n * stride, first[k] + (n + 1) * stride);
    }
}

/* A wall on the edge from vertex k on between two cells, if only one of them is drawn; `rim`: it is on the raster's
 * side, and so looks straight outwards. Rims of voids are stairs, whose every step would be lit another way: all
 * of them are taken to look south, as from where a model is seen. */
static void draw_wall(const scene *s, easel *e, int k, bool along_row, bool rim)
{
    int stride = along_row ? 1 : SCENE_GRID, before = k - (along_row ? SCENE_GRID : 1);
    bool here = missing_corner(e, k) >= 0;
    if (here == (missing_corner(e, before) >= 0))
        return;
    curtain wall = {.wall = true, .north = rim ? 0 : -1};
    if (rim && along_row)
        wall.north = here ? 1 : -1;
    else if (rim)
        wall.east = here ? -1 : 1;
    draw_curtain(s, e, &wall, k, k + stride);
}

/* Walls around all that is drawn: the raster's sides and the rims of voids. */
static void draw_walls(const scene *s, easel *e, scene_tile_id id, int columns, int rows)
{
    const scene_lattice *l = &s->pyramid.lattices[id.step];
    int64_t x = id.column * SCENE_TILE - 1, y = id.row * SCENE_TILE - 1; /* of the grid's first vertex */
    for (int j = 1; j <= rows + 1; j++)
        for (int i = 1; i <= columns + 1; i++) {
            int k = j * SCENE_GRID + i;
            if (i <= columns)
                draw_wall(s, e, k, true, y + j == 0 || y + j == l->height - 1);
            if (j <= rows)
                draw_wall(s, e, k, false, x + i == 0 || x + i == l->width - 1);
            int missing = i <= columns && j <= rows ? missing_corner(e, k) : 4;
            if (missing < 0 || missing == 4)
                continue;
            const int at[4] = {k, k + 1, k + SCENE_GRID + 1, k + SCENE_GRID};
            const curtain wall = {.wall = true, .north = -1};
            draw_curtain(s, e, &wall, at[(missing + 1) & 3], at[(missing + 3) & 3]);
        }
}

static bool has_rim(const easel *e, int columns, int rows)
{
    for (int j = 0; j <= rows + 2; j++)
        for (int i = 0; i <= columns + 2; i++)
            if (isnan(e->heights[j * SCENE_GRID + i]))
                return true;
    return false;
}

static void draw_tile(const scene *s, easel *e, const tile *t)
{
    int columns, rows;
    scene_tile_cells(&s->pyramid, t->id, &columns, &rows);
    scene_tile_positions(&s->ground, t->id, e->x, e->y);
    if (t->heights)
        memcpy(e->heights, t->heights, GRID_BYTES);
    else
        scene_tile_heights(&s->ground, s->pyramid.lattices, t->id, e->x, e->y, e->heights);
    place_corners(s, e, columns, rows);
    for (int j = 1; j <= rows; j++)
        for (int i = 1; i <= columns; i++)
            draw_cell(e, j * SCENE_GRID + i);
    draw_skirts(s, e, t->id, columns, rows);
    if (has_rim(e, columns, rows))
        draw_walls(s, e, t->id, columns, rows);
}

static bool worth_drawing(const scene_zbuffer *z, const scene_outline *o)
{
    if (o->x1 < z->left || o->x0 > z->left + z->width || o->y1 < z->top || o->y0 > z->top + z->height)
        return false;
    return !(o->nearest > 0) || !scene_zbuffer_hides(z, o->x0, o->y0, o->x1, o->y1, o->nearest);
}

/* ---- colours ---- */

static scene_rgb sky(const scene *s, double x, double y)
{
    const scene_camera *c = &s->camera;
    double up = c->right[2] * x / c->focal + c->down[2] * y / c->focal + c->ahead[2];
    double a = x / c->focal, b = y / c->focal;
    float sine = (float)(up / sqrt(1 + a * a + b * b));
    const scene_rgb horizon = {0.72f, 0.79f, 0.86f}, zenith = {0.20f, 0.36f, 0.62f}, below = {0.56f, 0.61f, 0.66f};
    return sine > 0 ? scene_mix(horizon, zenith, sine * (2 - sine)) : scene_mix(horizon, below, -sine);
}

/* The colour that lies on the ground at a fragment, `x` and `y` of them from straight ahead. */
static scene_rgb ground_colour(const scene *s, const scene_fragment *f, double x, double y)
{
    const scene_camera *c = &s->camera;
    const tl_source_info *info = &s->pyramid.source->info;
    double a = x / c->focal, b = y / c->focal, ahead = 1 / (double)f->nearness;
    double east = c->eye[0] + ahead * (c->right[0] * a + c->down[0] * b + c->ahead[0]),
           north = c->eye[1] + ahead * (c->right[1] * a + c->down[1] * b + c->ahead[1]);
    double pixel = SUPER * ahead * sqrt(1 + a * a + b * b) / c->focal;
    scene_rgb colour;
    if (s->colours && scene_colours_at(s->colours, east / s->ground.cell_x + (double)(info->width - 1) / 2,
                                       (double)(info->height - 1) / 2 - north / s->ground.cell_y, pixel, &colour))
        return colour;
    return scene_palette_at(&s->palette, f->height);
}

static scene_rgb fragment_colour(const scene *s, const scene_fragment *f, double x, double y)
{
    if (!(f->nearness > 0))
        return sky(s, x, y);
    scene_rgb colour;
    if (isnan(f->height)) {
        const scene_rgb stone = {0.50f, 0.47f, 0.44f};
        const float steep = 1e3f;
        colour = scene_lit(&s->light, stone, -f->east * steep, -f->north * steep, 1);
    } else {
        colour = scene_lit(&s->light, ground_colour(s, f, x, y), f->east, f->north, 1);
    }
    if (s->haze == 0)
        return colour;
    const scene_rgb air = {0.66f, 0.74f, 0.83f};
    double distance = 1 / ((double)f->nearness * s->haze);
    float lost = (float)(distance * distance / (1 + distance * distance));
    return scene_mix(colour, air, isnan(lost) ? 1 : lost);
}

/* A threshold in (-0.5, 0.5) steps of a byte, by position: a slow gradient comes out without bands. */
static float dither(int64_t x, int64_t y)
{
    uint32_t h = (uint32_t)x * 0x9e3779b1u ^ (uint32_t)y * 0x85ebca77u;
    h = (h ^ h >> 15) * 0x2c1b3c6du;
    h = (h ^ h >> 12) * 0x297a2d39u;
    return ((float)((h ^ h >> 15) >> 8) + 0.5f) / 16777216 - 0.5f;
}

static void resolve(const scene *s, const scene_zbuffer *z, int64_t left, int64_t top)
{
    for (int y = 0; y < z->height / SUPER; y++)
        for (int x = 0; x < z->width / SUPER; x++) {
            scene_rgb sum = {0, 0, 0};
            bool air = true;
            for (int k = 0; k < SUPER * SUPER; k++) {
                int u = x * SUPER + k % SUPER, v = y * SUPER + k / SUPER;
                const scene_fragment *f = &z->fragments[v * z->width + u];
                scene_rgb c = fragment_colour(s, f, z->left + u + 0.5, z->top + v + 0.5);
                air = air && !(f->nearness > 0);
                sum = (scene_rgb){sum.r + c.r, sum.g + c.g, sum.b + c.b};
            }
            const float share = 1.0f / (SUPER * SUPER);
            float blur = air ? dither(left + x, top + y) * (SUPER * SUPER) / 127 : 0;
            sum = (scene_rgb){sum.r + blur * 0.8f, sum.g + blur * 0.8f, sum.b + blur * 0.8f};
            unsigned char *out = s->picture->rgba + ((top + y) * s->picture->width + left + x) * 4;
            out[0] = scene_encode(sum.r * share);
            out[1] = scene_encode(sum.g * share);
            out[2] = scene_encode(sum.b * share);
            out[3] = 255;
        }
}

/* ---- the picture ---- */

static tl_status draw_block(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const scene *s = context;
    int64_t columns = tl_div_up(s->picture->width, BLOCK_WIDTH);
    int64_t left = (int64_t)item % columns * BLOCK_WIDTH, top = (int64_t)item / columns * BLOCK_HEIGHT;
    easel *e = malloc(sizeof *e);
    if (!e)
        return tl_fail_memory(error, "the picture");
    e->buffer = (scene_zbuffer){.width = SUPER * (int)tl_int64_min(BLOCK_WIDTH, s->picture->width - left),
                                .height = SUPER * (int)tl_int64_min(BLOCK_HEIGHT, s->picture->height - top),
                                .left = (double)(SUPER * left) - s->camera.width / 2,
                                .top = (double)(SUPER * top) - s->camera.height / 2,
                                .near_plane = s->near_plane};
    scene_zbuffer *z = &e->buffer;
    z->fragments = tl_alloc_grid(z->width, z->height, sizeof *z->fragments);
    if (!z->fragments) {
        free(e);
        return tl_fail_memory(error, "the picture");
    }
    scene_zbuffer_clear(z);
    for (size_t k = 0; k < s->tile_count; k++)
        if (worth_drawing(z, &s->tiles[k].outline))
            draw_tile(s, e, &s->tiles[k]);
    resolve(s, z, left, top);
    free(z->fragments);
    free(e);
    return TL_OK;
}

static tl_status draw(scene *s, const tl_run *run, tl_error *error)
{
    tl_status status = select_tiles(s, (scene_tile_id){.step = s->pyramid.top}, error);
    if (status != TL_OK)
        return status;
    if (s->tile_count)
        qsort(s->tiles, s->tile_count, sizeof *s->tiles, front_to_back);
    status = make_close_ups(s, run, error);
    if (status != TL_OK)
        return status;
    int64_t columns = tl_div_up(s->picture->width, BLOCK_WIDTH), rows = tl_div_up(s->picture->height, BLOCK_HEIGHT);
    return tl_parallel_for(run, (uint64_t)(columns * rows), 0, draw_block, s, error);
}

/* ---- the scene ---- */

/* From CRS coordinates (and metres above the datum) to the scene's frame, stretched as the heights are. */
static bool to_scene(const tl_source_info *info, double exaggeration, const double in[3], double out[3])
{
    const double *t = info->georef.transform, far_away = 1e15;
    double determinant = t[1] * t[5] - t[2] * t[4], x = in[0] - t[0], y = in[1] - t[3];
    double i = (x * t[5] - y * t[2]) / determinant, j = (y * t[1] - x * t[4]) / determinant;
    out[0] = (i - (double)(info->width - 1) / 2) * info->georef.cell_x;
    out[1] = ((double)(info->height - 1) / 2 - j) * info->georef.cell_y;
    out[2] = in[2] * exaggeration;
    return fabs(out[0]) < far_away && fabs(out[1]) < far_away && fabs(out[2]) < far_away; /* false also for NaN */
}

static tl_status place_camera(scene *s, const tl_preview_options *o, double exaggeration, const scene_box *box,
                              tl_error *error)
{
    const tl_source_info *info = &s->pyramid.source->info;
    int width = (int)s->picture->width * SUPER, height = (int)s->picture->height * SUPER;
    double fov = o->fov != 0 ? o->fov : 50, eye[3], target[3];
    if (!o->view_given) {
        scene_camera_fit(&s->camera, box, fov, width, height);
        return TL_OK;
    }
    if (!to_scene(info, exaggeration, o->eye, eye) || !to_scene(info, exaggeration, o->target, target))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the eye or the target is too far away; are they in its CRS?",
                       info->name);
    if (eye[0] == target[0] && eye[1] == target[1] && eye[2] == target[2])
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the eye and the target are the same point; move one", info->name);
    scene_camera_look(&s->camera, eye, target, fov, width, height);
    return TL_OK;
}

static void measure(scene *s, scene_box *box)
{
    const tl_source_info *info = &s->pyramid.source->info;
    scene_bounds all = scene_pyramid_bounds(&s->pyramid, s->pyramid.top, 0, 0);
    double east = (double)(info->width - 1) / 2 * s->ground.cell_x,
           north = (double)(info->height - 1) / 2 * s->ground.cell_y;
    s->low = (double)all.low * s->ground.metres;
    s->high = (double)all.high * s->ground.metres;
    s->foot = s->low - 0.03 * fmin(east, north) - 0.08 * (s->high - s->low);
    *box = (scene_box){{-east, -north, s->foot}, {east, north, s->high}};
}

/* Colours by the heights of the coarsest lattice that has enough of them. */
static tl_status choose_colours(scene *s, const tl_preview_options *o, tl_error *error)
{
    int step = s->pyramid.top;
    while (step > s->pyramid.base &&
           s->pyramid.lattices[step].width * s->pyramid.lattices[step].height < PALETTE_SAMPLES)
        step--;
    const scene_lattice *l = &s->pyramid.lattices[step];
    double all = (double)l->width * (double)l->height;
    float *heights = tl_alloc(PALETTE_SAMPLES, sizeof *heights);
    if (!heights)
        return tl_fail_memory(error, "the view");
    for (size_t k = 0; k < PALETTE_SAMPLES; k++)
        heights[k] = l->heights[(size_t)((double)k / PALETTE_SAMPLES * all)];
    scene_palette_init(&s->palette, heights, PALETTE_SAMPLES, o->grey,
                       scene_has_sea_level(&s->pyramid.source->info.georef));
    free(heights);
    return TL_OK;
}

static tl_status prepare(scene *s, const tl_preview_options *o, tl_error *error)
{
    const tl_source_info *info = &s->pyramid.source->info;
    double exaggeration = o->exaggeration != 0 ? o->exaggeration : 1;
    s->ground = (scene_ground){.pyramid = &s->pyramid,
                               .cell_x = info->georef.cell_x,
                               .cell_y = info->georef.cell_y,
                               .metres = info->georef.height_unit * exaggeration};
    scene_box box;
    measure(s, &box);
    if (!(s->low <= s->high))
        return tl_fail(error, TL_ERROR_DATA, "%s: has no valid heights, so there is nothing to look at", info->name);
    if (o->view_given)
        s->haze = 1.8 * hypot(box.high[0] - box.low[0], box.high[1] - box.low[1]);
    tl_status status = place_camera(s, o, exaggeration, &box, error);
    if (status != TL_OK)
        return status;
    double cell = fmax(info->georef.cell_x, info->georef.cell_y);
    s->near_plane = 1e-3 * fmin(info->georef.cell_x, info->georef.cell_y);
    s->ground.eye[0] = s->camera.eye[0];
    s->ground.eye[1] = s->camera.eye[1];
    s->ground.rise = outside_of(s->camera.eye[2], s->low, s->high);
    s->ground.per_metre = SUPER / s->camera.focal / cell;
    /* by default from behind the shoulder of an eye in the south */
    bool given = o->sun_azimuth != 0 || o->sun_elevation != 0;
    scene_light_init(&s->light, given ? o->sun_azimuth : 235, given ? o->sun_elevation : 35);
    scene_encode_prepare();
    if (o->colour && !(s->colours = scene_colours_open(o->colour, s->pyramid.source, o->run, error)))
        return error->status;
    return choose_colours(s, o, error);
}

static void scene_finish(scene *s)
{
    for (size_t k = 0; k < s->tile_count; k++)
        free(s->tiles[k].heights);
    free(s->tiles);
    scene_colours_destroy(s->colours);
    scene_pyramid_finish(&s->pyramid);
    free(s);
}

/* Pixels of the picture: what is asked for, else 16 : 9. */
static tl_status start_picture(const tl_preview_options *o, scene_picture *picture, tl_error *error)
{
    int64_t width = o->width, height = o->height;
    if (!width)
        width = height ? (height * DEFAULT_WIDTH + DEFAULT_HEIGHT / 2) / DEFAULT_HEIGHT : DEFAULT_WIDTH;
    if (!height)
        height = (width * DEFAULT_HEIGHT + DEFAULT_WIDTH / 2) / DEFAULT_WIDTH;
    return scene_picture_init(picture, width, tl_int64_max(height, 1), error);
}

tl_status scene_perspective(const tl_source *source, const tl_preview_options *options, scene_picture *picture,
                            tl_error *error)
{
    const tl_source_info *info = &source->info;
    if (info->width < 2 || info->height < 2)
        return tl_fail(error, TL_ERROR_DATA, "%s: a perspective needs at least 2 x 2 samples; this is %lld x %lld",
                       info->name, (long long)info->width, (long long)info->height);
    scene *s = calloc(1, sizeof *s);
    if (!s)
        return tl_fail_memory(error, "the view");
    tl_run quiet = options->run ? *options->run : (tl_run){0};
    quiet.progress = NULL; /* most of the work is in the reading */
    s->picture = picture;
    tl_status status = start_picture(options, picture, error);
    if (status == TL_OK)
        status = scene_pyramid_init(&s->pyramid, source, options->run, error);
    if (status == TL_OK)
        status = prepare(s, options, error);
    if (status == TL_OK)
        status = draw(s, &quiet, error);
    scene_finish(s);
    if (status != TL_OK)
        scene_picture_finish(picture);
    return status;
}
