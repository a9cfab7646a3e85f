#include "lib/scene/geodetic.h"

#include "dem/control_grid.h"
#include "dem/crs.h"
#include "dem/crs_ellipsoidal.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/scene/source_part.h"

#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>

enum {
    PATCH = 64,             /* vertices on a side that are looked up together */
    MOST_SAMPLES = 1 << 22, /* that are read for a patch; patches whose samples are farther apart are cut */
    GRID_SHARE = 64,
};

struct scene_geodetic {
    const tl_source *source;
    int level;
    double meridian;   /* of the CRS, degrees east of Greenwich */
    double inverse[4]; /* from CRS coordinates to samples */
    bool upright;      /* columns and rows of vertices are columns and rows of samples */
    tl_window window;
    dem_control_grid *grid;     /* vertex to sample; NULL: one by one */
    pthread_mutex_t lock;       /* of the projection */
    dem_projection *projection; /* NULL: the CRS is geographic */
};

int scene_geodetic_level(const tl_source_info *info)
{
    const double metres = 6371000 * 3.14159265358979323846 / 180; /* of a degree */
    double cell = fmin(info->georef.cell_x, info->georef.cell_y) / metres;
    int level = 0;
    /* a thousandth is for what the length of a degree differs by */
    while (level < SCENE_GEODETIC_DEEPEST && scene_geodetic_step(level) > cell * 1.001)
        level++;
    return level;
}

/* ---- Vertex to sample ---- */

/* A longitude that the raster's columns may have, of a raster in degrees: the turn that puts it next to the middle. */
static double nearest_turn(const scene_geodetic *g, double longitude)
{
    const tl_source_info *info = &g->source->info;
    const double *t = info->georef.transform;
    double middle = t[0] + 0.5 * (t[1] * (double)(info->width - 1) + t[2] * (double)(info->height - 1));
    return longitude - 360 * rint((longitude - middle) / 360);
}

/* Sample positions of vertices; NaN where the map has none. The caller holds the lock where there is a projection. */
static void locate(const scene_geodetic *g, size_t n, const double *i, const double *j, double *out)
{
    const double *t = g->source->info.georef.transform;
    double step = scene_geodetic_step(g->level);
    for (size_t k = 0; k < n; k++) {
        double x = -180 + i[k] * step - g->meridian, y = -90 + j[k] * step;
        if (g->projection) {
            x -= 360 * rint(x / 360);
            dem_projection_from_lonlat(g->projection, 1, &x, &y);
        } else
            x = nearest_turn(g, x);
        x -= t[0], y -= t[3];
        out[2 * k] = g->inverse[0] * x + g->inverse[1] * y;
        out[2 * k + 1] = g->inverse[2] * x + g->inverse[3] * y;
    }
}

static void evaluate(void *context, size_t n, const double *i, const double *j, double *out)
{
    locate(context, n, i, j, out);
}

static void find_positions(const scene_geodetic *g, size_t n, const double *i, const double *j, double *out)
{
    if (g->grid) {
        dem_control_grid_apply(g->grid, n, i, j, out);
        return;
    }
    scene_geodetic *self = (scene_geodetic *)g; /* the lock is no part of its value */
    if (g->projection)
        pthread_mutex_lock(&self->lock);
    locate(g, n, i, j, out);
    if (g->projection)
        pthread_mutex_unlock(&self->lock);
}

/* ---- Making ---- */

static tl_status check(const tl_source_info *info, tl_error *error)
{
    const tl_georef *g = &info->georef;
    if (g->crs && g->located)
        return TL_OK;
    return tl_fail(error, TL_ERROR_ARGUMENT,
                   "%s: where on the globe it lies is not known; tiles of the globe need a CRS", info->name);
}

/* The box of the samples, and of an area raster's cells, in vertices. */
static tl_status find_window(scene_geodetic *g, tl_error *error)
{
    double bounds[4], step = scene_geodetic_step(g->level);
    tl_status status = tl_source_bounds(&g->source->info, bounds, error);
    if (status != TL_OK)
        return status;
    double west = bounds[0] + g->meridian, east = bounds[2] + g->meridian;
    g->window.x = (int64_t)floor((west + 180) / step) - 1;
    g->window.width = (int64_t)ceil((east + 180) / step) + 2 - g->window.x;
    g->window.y = tl_int64_max((int64_t)floor((bounds[1] + 90) / step) - 1, 0);
    g->window.height =
        tl_int64_min((int64_t)ceil((bounds[3] + 90) / step) + 1, scene_geodetic_rows(g->level)) + 1 - g->window.y;
    g->window.width = tl_int64_min(g->window.width, scene_geodetic_columns(g->level));
    return TL_OK;
}

/* A thousandth of a sample is a thousandth of what resampling smooths. */
static tl_status make_grid(scene_geodetic *g, tl_error *error)
{
    const dem_control_function function = {
        .components = 2, .evaluate = evaluate, .context = g, .weights = {1, 1}, .tolerance = 1e-3};
    double vertices = (double)g->window.width * (double)g->window.height;
    size_t budget = (size_t)fmin(fmax(vertices / GRID_SHARE, 1 << 14), 1 << 24);
    return g->projection ? dem_control_grid_create(&function, g->window, budget, &g->grid, error) : TL_OK;
}

static tl_status begin(scene_geodetic *g, tl_error *error)
{
    const tl_georef *georef = &g->source->info.georef;
    const double *t = georef->transform;
    double whole = t[1] * t[5] - t[2] * t[4];
    const double inverse[4] = {t[5] / whole, -t[2] / whole, -t[4] / whole, t[1] / whole};
    memcpy(g->inverse, inverse, sizeof inverse);
    g->meridian = dem_crs_prime_meridian(georef->crs);
    if (!tl_crs_is_geographic(georef->crs))
        g->projection = dem_projection_create(georef->crs, error);
    if (!g->projection && !tl_crs_is_geographic(georef->crs))
        return TL_ERROR_DATA;
    g->upright = !g->projection && inverse[1] == 0 && inverse[2] == 0;
    tl_status status = find_window(g, error);
    return status == TL_OK ? make_grid(g, error) : status;
}

scene_geodetic *scene_geodetic_create(const tl_source *source, int level, tl_error *error)
{
    scene_geodetic *g = check(&source->info, error) == TL_OK ? calloc(1, sizeof *g) : NULL;
    if (!g) {
        if (source->info.georef.crs && source->info.georef.located)
            tl_fail_memory(error, source->info.name);
        return NULL;
    }
    g->source = source;
    g->level = level;
    pthread_mutex_init(&g->lock, NULL);
    if (begin(g, error) == TL_OK)
        return g;
    scene_geodetic_destroy(g);
    return NULL;
}

void scene_geodetic_destroy(scene_geodetic *g)
{
    if (!g)
        return;
    dem_control_grid_destroy(g->grid);
    dem_projection_destroy(g->projection);
    pthread_mutex_destroy(&g->lock);
    free(g);
}

tl_window scene_geodetic_window(const scene_geodetic *g)
{
    return g->window;
}

/* ---- Reading ---- */

typedef struct patch {
    tl_window window; /* of vertices, at most PATCH or SCENE_PART_MOST on a side */
    float *out;       /* its first vertex */
    int64_t stride;
} patch;

/* Samples' positions of its vertices: of all, row by row; of its columns and rows where these are the samples', too. */
typedef union places {
    double all[2 * PATCH * PATCH];
    struct {
        double x[SCENE_PART_MOST], y[SCENE_PART_MOST];
    } grid;
} places;

static tl_status read_patch(const scene_geodetic *g, const patch *of, tl_error *error);

/* In four, where the samples under it lie far apart: around a pole of a map. */
static tl_status read_quarters(const scene_geodetic *g, const patch *of, tl_error *error)
{
    const tl_window *w = &of->window;
    int64_t half[2] = {(w->width + 1) / 2, (w->height + 1) / 2};
    tl_status status = TL_OK;
    for (int k = 0; k < 4 && status == TL_OK; k++) {
        int64_t x = k & 1 ? half[0] : 0, y = k >> 1 ? half[1] : 0;
        patch quarter = {
            {w->x + x, w->y + y, k & 1 ? w->width - half[0] : half[0], k >> 1 ? w->height - half[1] : half[1]},
            of->out + y * of->stride + x,
            of->stride};
        if (quarter.window.width > 0 && quarter.window.height > 0)
            status = read_patch(g, &quarter, error);
    }
    return status;
}

static void fill_patch(const scene_geodetic *g, const patch *of, const places *at, const scene_part *p)
{
    const tl_source_info *info = &g->source->info;
    const tl_window *w = &of->window;
    const float unit = (float)info->georef.height_unit;
    const bool grid = p && g->upright;
    if (grid)
        scene_part_heights(p, info, w->width, at->grid.x, w->height, at->grid.y, of->out, of->stride);
    for (int64_t y = 0; y < w->height; y++) {
        float *row = of->out + y * of->stride;
        for (int64_t x = 0; x < w->width && !grid; x++) {
            size_t k = 2 * (size_t)(y * w->width + x);
            row[x] = p ? scene_part_height(p, info, at->all[k], at->all[k + 1]) : NAN;
        }
        for (int64_t x = 0; x < w->width; x++)
            row[x] *= unit;
    }
}

/* Vertices in the turn in which the window counts, so that equal ones have equal positions; false: beyond what
 * positions are known for, and in `out` the nearest that is not. */
static bool known_column(const scene_geodetic *g, int64_t x, double *out)
{
    int64_t columns = scene_geodetic_columns(g->level), column = ((x - g->window.x) % columns + columns) % columns;
    *out = (double)(g->window.x + scene_clamp(column, g->window.width));
    return column < g->window.width;
}

static bool known_row(const scene_geodetic *g, int64_t y, double *out)
{
    *out = (double)(g->window.y + scene_clamp(y - g->window.y, g->window.height));
    return y >= g->window.y && y < g->window.y + g->window.height;
}

static void find_all(const scene_geodetic *g, const tl_window *w, double *at)
{
    double i[PATCH], j[PATCH];
    bool known[PATCH];
    for (int64_t x = 0; x < w->width; x++)
        known[x] = known_column(g, w->x + x, &i[x]);
    for (int64_t y = 0; y < w->height; y++) {
        double *row = at + 2 * y * w->width;
        bool inside = known_row(g, w->y + y, &j[0]);
        for (int64_t x = 1; x < w->width; x++)
            j[x] = j[0];
        find_positions(g, (size_t)w->width, i, j, row);
        for (int64_t x = 0; x < w->width; x++)
            if (!inside || !known[x])
                row[2 * x] = row[2 * x + 1] = (double)NAN;
    }
}

/* Of a lattice whose columns and rows are the samples'. */
static void find_grid(const scene_geodetic *g, const tl_window *w, places *at)
{
    double i, j, position[2];
    known_row(g, w->y, &j);
    for (int64_t x = 0; x < w->width; x++) {
        bool known = known_column(g, w->x + x, &i);
        locate(g, 1, &i, &j, position);
        at->grid.x[x] = known ? position[0] : (double)NAN;
    }
    known_column(g, w->x, &i);
    for (int64_t y = 0; y < w->height; y++) {
        bool known = known_row(g, w->y + y, &j);
        locate(g, 1, &i, &j, position);
        at->grid.y[y] = known ? position[1] : (double)NAN;
    }
}

static tl_status read_patch(const scene_geodetic *g, const patch *of, tl_error *error)
{
    places at;
    const tl_source_info *info = &g->source->info;
    const tl_window *w = &of->window;
    scene_part p = {.z = NULL};
    if (g->upright)
        find_grid(g, w, &at);
    else
        find_all(g, w, at.all);
    if (!(g->upright ? scene_part_find_grid(info, w->width, at.grid.x, w->height, at.grid.y, &p.window)
                     : scene_part_find(info, (size_t)(w->width * w->height), at.all, &p.window))) {
        fill_patch(g, of, &at, NULL);
        return TL_OK;
    }
    if (p.window.width * p.window.height > MOST_SAMPLES && w->width * w->height > 1)
        return read_quarters(g, of, error);
    p.z = tl_alloc_grid(p.window.width, p.window.height, sizeof *p.z);
    tl_status status = p.z ? scene_part_read(g->source, &p, error) : tl_fail_memory(error, info->name);
    if (status == TL_OK)
        fill_patch(g, of, &at, &p);
    free(p.z);
    return status;
}

tl_status scene_geodetic_read(const scene_geodetic *g, tl_window window, float *out, tl_error *error)
{
    const int64_t side = g->upright ? SCENE_PART_MOST : PATCH;
    tl_status status = TL_OK;
    for (int64_t y = 0; y < window.height && status == TL_OK; y += side)
        for (int64_t x = 0; x < window.width && status == TL_OK; x += side) {
            patch here = {{window.x + x, window.y + y, tl_int64_min(side, window.width - x),
                           tl_int64_min(side, window.height - y)},
                          out + y * window.width + x,
                          window.width};
            status = read_patch(g, &here, error);
        }
    return status;
}

/* ---- Comparing ---- */

typedef struct comparison {
    const scene_geodetic *g;
    int64_t x, y;
    int cells;
    const float *z;
    int64_t stride;
    double worst;
} comparison;

/* The surface at (u, v) cells from the first vertex; the diagonals of the smallest squares meet at their odd vertices.
 */
static double surface(const comparison *c, double u, double v)
{
    int64_t i = scene_clamp((int64_t)u, c->cells), j = scene_clamp((int64_t)v, c->cells);
    double fu = u - (double)i, fv = v - (double)j;
    const float *z = c->z + j * c->stride + i;
    double sw = (double)z[0], se = (double)z[1], nw = (double)z[c->stride], ne = (double)z[c->stride + 1];
    if (((c->x + i) ^ (c->y + j)) & 1) /* the diagonal falls to the south-east */
        return fu + fv <= 1 ? sw + fu * (se - sw) + fv * (nw - sw) : ne + (1 - fu) * (nw - ne) + (1 - fv) * (se - ne);
    return fu >= fv ? sw + fu * (se - sw) + fv * (ne - se) : sw + fv * (nw - sw) + fu * (ne - nw);
}

/* A row of samples, whose places are in degrees. */
static void compare_row(comparison *c, const float *row, const double *longitude, const double *latitude, int64_t count)
{
    const scene_geodetic *g = c->g;
    double unit = g->source->info.georef.height_unit, per_degree = 1 / scene_geodetic_step(g->level);
    double around = (double)scene_geodetic_columns(g->level), middle = (double)c->x + 0.5 * c->cells;
    for (int64_t k = 0; k < count; k++) {
        double u = (longitude[k] + g->meridian + 180) * per_degree, v = (latitude[k] + 90) * per_degree;
        u -= around * rint((u - middle) / around);
        u -= (double)c->x, v -= (double)c->y;
        if (!(u >= 0 && v >= 0 && u <= c->cells && v <= c->cells) || !isfinite(row[k]))
            continue;
        double off = fabs(surface(c, u, v) - (double)row[k] * unit);
        c->worst = off > c->worst ? off : c->worst;
    }
}

/* The samples under the block, by places all over it; false: none. */
static bool find_samples(const comparison *c, tl_window *out)
{
    enum { SIDE = 33 };
    const scene_geodetic *g = c->g;
    double at[2 * SIDE * SIDE], i[SIDE], j[SIDE];
    for (int row = 0; row < SIDE; row++) {
        for (int k = 0; k < SIDE; k++) {
            i[k] = (double)c->x + (double)c->cells * k / (SIDE - 1);
            j[k] = (double)c->y + (double)c->cells * row / (SIDE - 1);
            if (g->grid) { /* nothing is known beyond its window */
                i[k] = fmin(fmax(i[k], (double)g->window.x), (double)(g->window.x + g->window.width - 1));
                j[k] = fmin(fmax(j[k], (double)g->window.y), (double)(g->window.y + g->window.height - 1));
            }
        }
        find_positions(g, SIDE, i, j, at + 2 * SIDE * row);
    }
    for (int k = 0; k < 2 * SIDE * SIDE; k++) { /* to the raster, as its rim may lie between two of the places */
        int64_t size = k % 2 ? g->source->info.height : g->source->info.width;
        if (k % 2 || !g->source->info.wraps)
            at[k] = fmin(fmax(at[k], 0), (double)(size - 1));
    }
    return scene_part_find(&g->source->info, SIDE * SIDE, at, out);
}

/* Places of a row's samples, in degrees. */
static tl_status find_degrees(const scene_geodetic *g, tl_window w, double *longitude, double *latitude,
                              tl_error *error)
{
    const tl_georef *georef = &g->source->info.georef;
    const double *t = georef->transform;
    for (int64_t k = 0; k < w.width; k++) {
        double i = (double)(w.x + k), j = (double)w.y;
        longitude[k] = g->projection ? i : t[0] + t[1] * i + t[2] * j;
        latitude[k] = g->projection ? j : t[3] + t[4] * i + t[5] * j;
    }
    return g->projection ? tl_georef_to_lonlat(georef, (size_t)w.width, longitude, latitude, error) : TL_OK;
}

tl_status scene_geodetic_compare(const scene_geodetic *g, int64_t x, int64_t y, int cells, const float *z,
                                 int64_t stride, double *worst, tl_error *error)
{
    comparison c = {g, x, y, cells, z, stride, 0};
    const tl_source_info *info = &g->source->info;
    tl_window w;
    *worst = 0;
    if (!find_samples(&c, &w))
        return TL_OK;
    w.width = tl_int64_min(w.width, info->width);
    double *longitude = tl_alloc((size_t)w.width, sizeof *longitude);
    double *latitude = tl_alloc((size_t)w.width, sizeof *latitude);
    scene_part row = {.z = tl_alloc((size_t)w.width, sizeof *row.z)};
    tl_status status = longitude && latitude && row.z ? TL_OK : tl_fail_memory(error, info->name);
    for (int64_t line = 0; line < w.height && status == TL_OK; line++) {
        row.window = (tl_window){w.x, w.y + line, w.width, 1};
        status = scene_part_read(g->source, &row, error);
        if (status == TL_OK)
            status = find_degrees(g, row.window, longitude, latitude, error);
        if (status == TL_OK)
            compare_row(&c, row.z, longitude, latitude, w.width);
    }
    *worst = c.worst;
    free(row.z);
    free(longitude);
    free(latitude);
    return status;
}
