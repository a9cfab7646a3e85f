#include "lib/scene/geodetic.h"

#include "dem/control_grid.h"
#include "dem/crs.h"
#include "dem/crs_ellipsoidal.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"

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

/* ---- Interpolation ---- */

/* A part of the source. */
typedef struct part {
    tl_window window;
    float *z;
} part;

/* Weights of Catmull and Rom's cubic for four samples, `f` from the second to the third. */
static void cubic(double f, double w[4])
{
    w[0] = f * (-0.5 + f * (1 - 0.5 * f));
    w[1] = 1 + f * f * (-2.5 + 1.5 * f);
    w[2] = f * (0.5 + f * (2 - 1.5 * f));
    w[3] = f * f * (-0.5 + 0.5 * f);
}

static int64_t clamp(int64_t value, int64_t size)
{
    return value < 0 ? 0 : value >= size ? size - 1 : value;
}

/* Sample (i, j) of a raster that may go around. */
static float sample(const part *p, const tl_source_info *info, int64_t i, int64_t j)
{
    i = info->wraps ? i : clamp(i, info->width);
    j = clamp(j, info->height);
    return p->z[(j - p->window.y) * p->window.width + (i - p->window.x)];
}

static float bilinear(const part *p, const tl_source_info *info, int64_t i, int64_t j, double fx, double fy)
{
    double sum = 0, weights = 0;
    for (int k = 0; k < 4; k++) {
        float z = sample(p, info, i + (k & 1), j + (k >> 1));
        double w = (k & 1 ? fx : 1 - fx) * (k >> 1 ? fy : 1 - fy);
        if (isfinite(z)) {
            sum += w * (double)z;
            weights += w;
        }
    }
    return weights >= 0.5 ? (float)(sum / weights) : NAN; /* void where most of it is */
}

static float interpolate(const part *p, const tl_source_info *info, double x, double y)
{
    int64_t i = (int64_t)floor(x), j = (int64_t)floor(y);
    double fx = x - (double)i, fy = y - (double)j, wx[4], wy[4], sum = 0;
    const tl_window *w = &p->window;
    bool inside = i > w->x && j > w->y && i + 2 < w->x + w->width && j + 2 < w->y + w->height;
    cubic(fx, wx);
    cubic(fy, wy);
    for (int row = 0; row < 4; row++) {
        float rim[4];
        const float *z = rim;
        if (inside)
            z = p->z + (j + row - 1 - w->y) * w->width + (i - 1 - w->x);
        else
            for (int column = 0; column < 4; column++)
                rim[column] = sample(p, info, i + column - 1, j + row - 1);
        sum += wy[row] * (wx[0] * (double)z[0] + wx[1] * (double)z[1] + wx[2] * (double)z[2] + wx[3] * (double)z[3]);
    }
    return isfinite(sum) ? (float)sum : bilinear(p, info, i, j, fx, fy);
}

/* Whether a position has a height at all. */
static bool covered(const tl_source_info *info, double x, double y)
{
    /* the rim itself, for positions that round */
    double margin = info->type == TL_RASTER_AREA ? 0.5 + 1e-9 : 1e-6;
    bool along = info->wraps || (x >= -margin && x <= (double)info->width - 1 + margin);
    return along && y >= -margin && y <= (double)info->height - 1 + margin;
}

/* The samples that positions ask for; false: none. */
static bool find_part(const tl_source_info *info, const double *at, size_t n, tl_window *out)
{
    double low[2] = {HUGE_VAL, HUGE_VAL}, high[2] = {-HUGE_VAL, -HUGE_VAL};
    for (size_t k = 0; k < n; k++)
        if (covered(info, at[2 * k], at[2 * k + 1]))
            for (int a = 0; a < 2; a++) {
                low[a] = at[2 * k + (size_t)a] < low[a] ? at[2 * k + (size_t)a] : low[a];
                high[a] = at[2 * k + (size_t)a] > high[a] ? at[2 * k + (size_t)a] : high[a];
            }
    if (!(low[0] <= high[0]))
        return false;
    int64_t x0 = (int64_t)floor(low[0]) - 1, x1 = (int64_t)floor(high[0]) + 2;
    int64_t y0 = clamp((int64_t)floor(low[1]) - 1, info->height), y1 = clamp((int64_t)floor(high[1]) + 2, info->height);
    if (!info->wraps) {
        x0 = clamp(x0, info->width);
        x1 = clamp(x1, info->width);
    }
    *out = (tl_window){x0, y0, x1 - x0 + 1, y1 - y0 + 1};
    return true;
}

/* Columns x ... x + count - 1 of the raster into column `to` of the part. */
static tl_status read_columns(const tl_source *source, part *p, int64_t x, int64_t count, int64_t to, tl_error *error)
{
    const tl_window *w = &p->window;
    if (count == w->width)
        return tl_source_read(source, source->info.level, (tl_window){x, w->y, count, w->height}, p->z, error);
    float *columns = tl_alloc_grid(count, w->height, sizeof *columns);
    if (!columns)
        return tl_fail_memory(error, source->info.name);
    tl_status status =
        tl_source_read(source, source->info.level, (tl_window){x, w->y, count, w->height}, columns, error);
    for (int64_t y = 0; y < w->height && status == TL_OK; y++)
        memcpy(p->z + y * w->width + to, columns + y * count, (size_t)count * sizeof *columns);
    free(columns);
    return status;
}

/* Columns may be beyond a raster that goes around. */
static tl_status read_part(const tl_source *source, part *p, tl_error *error)
{
    int64_t width = source->info.width;
    tl_status status = TL_OK;
    for (int64_t done = 0; done < p->window.width && status == TL_OK;) {
        int64_t x = ((p->window.x + done) % width + width) % width;
        int64_t count = tl_int64_min(p->window.width - done, width - x);
        status = read_columns(source, p, x, count, done, error);
        done += count;
    }
    return status;
}

/* ---- Reading ---- */

typedef struct patch {
    tl_window window; /* of vertices, at most PATCH on a side */
    float *out;       /* its first vertex */
    int64_t stride;
} patch;

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

static void fill_patch(const scene_geodetic *g, const patch *of, const double *at, const part *p)
{
    const tl_source_info *info = &g->source->info;
    const tl_window *w = &of->window;
    for (int64_t y = 0; y < w->height; y++)
        for (int64_t x = 0; x < w->width; x++) {
            const double *here = at + 2 * (y * w->width + x);
            float z = p && covered(info, here[0], here[1]) ? interpolate(p, info, here[0], here[1]) : NAN;
            of->out[y * of->stride + x] = z * (float)info->georef.height_unit;
        }
}

static void find_patch(const scene_geodetic *g, const tl_window *w, double *at)
{
    double i[PATCH], j[PATCH];
    int64_t columns = scene_geodetic_columns(g->level);
    for (int64_t y = 0; y < w->height; y++) {
        double *row = at + 2 * y * w->width;
        int64_t line = w->y + y - g->window.y;
        for (int64_t x = 0; x < w->width; x++) {
            /* the turn in which the window counts, so that equal vertices have equal positions */
            int64_t column = ((w->x + x - g->window.x) % columns + columns) % columns;
            i[x] = (double)(g->window.x + clamp(column, g->window.width));
            j[x] = (double)(g->window.y + clamp(line, g->window.height));
        }
        find_positions(g, (size_t)w->width, i, j, row);
        for (int64_t x = 0; x < w->width; x++) {
            int64_t column = ((w->x + x - g->window.x) % columns + columns) % columns;
            if (column >= g->window.width || line < 0 || line >= g->window.height)
                row[2 * x] = row[2 * x + 1] = (double)NAN; /* beyond what positions are known for */
        }
    }
}

static tl_status read_patch(const scene_geodetic *g, const patch *of, tl_error *error)
{
    double at[2 * PATCH * PATCH];
    const tl_source_info *info = &g->source->info;
    const tl_window *w = &of->window;
    part p = {.z = NULL};
    find_patch(g, w, at);
    if (!find_part(info, at, (size_t)(w->width * w->height), &p.window)) {
        fill_patch(g, of, at, NULL);
        return TL_OK;
    }
    if (p.window.width * p.window.height > MOST_SAMPLES && w->width * w->height > 1)
        return read_quarters(g, of, error);
    p.z = tl_alloc_grid(p.window.width, p.window.height, sizeof *p.z);
    tl_status status = p.z ? read_part(g->source, &p, error) : tl_fail_memory(error, info->name);
    if (status == TL_OK)
        fill_patch(g, of, at, &p);
    free(p.z);
    return status;
}

tl_status scene_geodetic_read(const scene_geodetic *g, tl_window window, float *out, tl_error *error)
{
    tl_status status = TL_OK;
    for (int64_t y = 0; y < window.height && status == TL_OK; y += PATCH)
        for (int64_t x = 0; x < window.width && status == TL_OK; x += PATCH) {
            patch here = {{window.x + x, window.y + y, tl_int64_min(PATCH, window.width - x),
                           tl_int64_min(PATCH, window.height - y)},
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
    int64_t i = clamp((int64_t)u, c->cells), j = clamp((int64_t)v, c->cells);
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
    return find_part(&g->source->info, at, SIDE * SIDE, out);
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
    part row = {.z = tl_alloc((size_t)w.width, sizeof *row.z)};
    tl_status status = longitude && latitude && row.z ? TL_OK : tl_fail_memory(error, info->name);
    for (int64_t line = 0; line < w.height && status == TL_OK; line++) {
        row.window = (tl_window){w.x, w.y + line, w.width, 1};
        status = read_part(g->source, &row, error);
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
