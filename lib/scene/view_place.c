#include "lib/scene/view_place.h"

#include "dem/control_grid.h"
#include "dem/crs.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"

#include <math.h>
#include <pthread.h>
#include <stdlib.h>

enum { BATCH = 256, PARTS = 6, BUDGET = 1 << 17, NEAR = 0, WHOLE = 1 };

static const double near_side = 1e6;   /* metres: of the finer grid around the eye */
static const double finest = 1e-4;     /* metres: tolerance near the eye */
static const double up_step = 1e4;     /* metres: the way up is a straight line, so any will do */
static const double highest = 1e4;     /* metres: heights for which the tolerances are meant */
static const double pixel_part = 0.01; /* of a pixel: tolerance far away */

struct scene_places {
    const tl_source_info *info;
    bool global; /* positions are longitude and latitude */
    bool bent;   /* places are turned by `share` */
    double share, radius;
    dem_projection *projection;
    dem_local_frame *local;
    pthread_mutex_t lock; /* over the projection, which is for one thread at a time */
    double affine[6];     /* of rasters without a CRS: x = a[0] + a[1] i + a[2] j, y = a[3] + a[4] i + a[5] j */
    dem_control_grid *grids[2];
    tl_window near; /* of grids[NEAR] */
    double origin[2];
};

/* ---- exact places ---- */

/* The angle of a point around the sphere's centre becomes smaller, its height stays. */
static void turn(const scene_places *p, double xyz[3])
{
    double r = p->radius, aside = hypot(xyz[0], xyz[1]), up = r + xyz[2];
    double angle = atan2(aside, up), height = hypot(aside, up) - r, out = r * angle, rise = 0;
    if (p->share > 0) {
        double bigger = r / p->share, turned = p->share * angle, half = sin(turned / 2);
        out = (bigger + height) * sin(turned);
        rise = height * cos(turned) - 2 * bigger * half * half;
    }
    double factor = aside > 0 ? out / aside : 0;
    xyz[0] *= factor;
    xyz[1] *= factor;
    xyz[2] = rise;
}

static void place_lonlat(const scene_places *p, double longitude, double latitude, double parts[PARTS])
{
    dem_local_frame_forward(p->local, longitude, latitude, 0, parts);
    dem_local_frame_forward(p->local, longitude, latitude, up_step, parts + 3);
    if (p->bent) {
        turn(p, parts);
        turn(p, parts + 3);
    }
    for (int a = 0; a < 3; a++)
        parts[3 + a] = (parts[3 + a] - parts[a]) / up_step;
    if (p->bent && p->share == 0) {
        parts[3] = parts[4] = parts[2] = 0;
        parts[5] = 1;
    }
}

static void crs_position(const tl_georef *g, double i, double j, double *x, double *y)
{
    const double *t = g->transform;
    *x = t[0] + t[1] * i + t[2] * j;
    *y = t[3] + t[4] * i + t[5] * j;
}

/* dem_control_function.evaluate. */
static void evaluate(void *context, size_t n, const double *i, const double *j, double *out)
{
    scene_places *p = context;
    for (size_t done = 0; done < n; done += BATCH) {
        double x[BATCH], y[BATCH];
        size_t count = n - done < BATCH ? n - done : BATCH;
        for (size_t k = 0; k < count; k++)
            crs_position(&p->info->georef, i[done + k], j[done + k], &x[k], &y[k]);
        pthread_mutex_lock(&p->lock);
        dem_projection_to_lonlat(p->projection, count, x, y);
        pthread_mutex_unlock(&p->lock);
        for (size_t k = 0; k < count; k++)
            place_lonlat(p, x[k], y[k], out + (done + k) * PARTS);
    }
}

void scene_places_point(const scene_places *p, const double position[2], double height, double xyz[3])
{
    if (p->global) {
        double parts[PARTS];
        place_lonlat(p, position[0], position[1], parts);
        for (int a = 0; a < 3; a++)
            xyz[a] = parts[a] + height * parts[3 + a];
        return;
    }
    double i, j;
    scene_places_sample(p, position, &i, &j);
    const double *a = p->affine;
    xyz[0] = a[0] + a[1] * i + a[2] * j;
    xyz[1] = a[3] + a[4] * i + a[5] * j;
    xyz[2] = height;
}

/* ---- positions ---- */

bool scene_places_is_global(const scene_places *p)
{
    return p->global;
}

const double *scene_places_origin(const scene_places *p)
{
    return p->origin;
}

double scene_places_radius(const scene_places *p)
{
    return !p->global || (p->bent && p->share == 0) ? (double)INFINITY : p->bent ? p->radius / p->share : p->radius;
}

void scene_places_unproject(const scene_places *p, double position[2])
{
    if (p->global)
        dem_projection_to_lonlat(p->projection, 1, &position[0], &position[1]);
}

static void invert(const double t[6], double x, double y, double *i, double *j)
{
    double determinant = t[1] * t[5] - t[2] * t[4];
    x -= t[0];
    y -= t[3];
    *i = (t[5] * x - t[2] * y) / determinant;
    *j = (t[1] * y - t[4] * x) / determinant;
}

static double outside(double i, int64_t width)
{
    return fmax(fmax(-i, i - (double)(width - 1)), 0);
}

void scene_places_sample(const scene_places *p, const double position[2], double *i, double *j)
{
    const tl_georef *g = &p->info->georef;
    double x = position[0], y = position[1];
    if (p->global)
        dem_projection_from_lonlat(p->projection, 1, &x, &y);
    invert(g->transform, x, y, i, j);
    if (!p->global || !tl_crs_is_geographic(g->crs))
        return;
    /* the same meridian has other names: the one nearest to the raster's columns counts */
    for (int turns = -2; turns <= 2; turns++) {
        double column, row;
        invert(g->transform, x + 360 * turns, y, &column, &row);
        if (outside(column, p->info->width) < outside(*i, p->info->width)) {
            *i = column;
            *j = row;
        }
    }
}

/* ---- lifecycle ---- */

static tl_status begin_global(scene_places *p, bool projected, scene_bending bending, tl_error *error)
{
    const tl_georef *g = &p->info->georef;
    p->projection = dem_projection_create(g->crs, error);
    if (!p->projection)
        return TL_ERROR_DATA;
    const double given[2] = {p->origin[0], p->origin[1]};
    if (projected)
        scene_places_unproject(p, p->origin);
    if (!isfinite(p->origin[0]) || !isfinite(p->origin[1]))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: the eye at %.10g, %.10g has no longitude and latitude in %s; move it", p->info->name,
                       given[0], given[1], tl_crs_name(g->crs));
    p->local = dem_local_frame_create(g->crs, p->origin[0], p->origin[1], 0, error);
    if (!p->local)
        return TL_ERROR_DATA;
    double polar = 1 - g->crs->flattening;
    p->radius = g->crs->semi_major * polar * polar;
    p->bent = bending.flat || bending.refraction > 0;
    p->share = bending.flat ? 0 : 1 - bending.refraction;
    return TL_OK;
}

/* A raster whose place is not known has its cells' sizes, and rows that go down. */
static void begin_plain(scene_places *p)
{
    const double *origin = p->origin;
    const tl_georef *g = &p->info->georef;
    double scale_x = 1, scale_y = 1;
    if (!g->located && g->cell_x > 0 && g->cell_y > 0) {
        scale_x = g->cell_x;
        scale_y = g->cell_y;
    }
    for (int k = 0; k < 6; k++)
        p->affine[k] = (g->transform[k] - (k == 0 ? origin[0] : k == 3 ? origin[1] : 0)) * (k < 3 ? scale_x : scale_y);
}

scene_places *scene_places_create(const tl_source *dem, const double origin[2], bool projected, scene_bending bending,
                                  tl_error *error)
{
    scene_places *p = calloc(1, sizeof *p);
    if (!p || pthread_mutex_init(&p->lock, NULL) != 0) {
        free(p);
        tl_fail_memory(error, "the view");
        return NULL;
    }
    p->info = &dem->info;
    p->origin[0] = origin[0];
    p->origin[1] = origin[1];
    p->global = dem->info.georef.crs && dem->info.georef.located;
    tl_status status = TL_OK;
    if (p->global)
        status = begin_global(p, projected, bending, error);
    else
        begin_plain(p);
    if (status == TL_OK)
        return p;
    scene_places_destroy(p);
    return NULL;
}

void scene_places_destroy(scene_places *p)
{
    if (!p)
        return;
    for (int k = 0; k < 2; k++)
        dem_control_grid_destroy(p->grids[k]);
    dem_projection_destroy(p->projection);
    dem_local_frame_destroy(p->local);
    pthread_mutex_destroy(&p->lock);
    free(p);
}

/* Samples within half of near_side of the origin, as the cells in the raster's middle go. */
static tl_window near_window(const tl_source_info *info, double i, double j)
{
    const double cells[2] = {info->georef.cell_x, info->georef.cell_y}, at[2] = {i, j};
    const int64_t sizes[2] = {info->width, info->height};
    int64_t first[2], count[2];
    for (int a = 0; a < 2; a++) {
        double reach = cells[a] > 0 ? near_side / 2 / cells[a] : 0, last = (double)(sizes[a] - 1);
        double from = fmin(fmax(floor(at[a] - reach), 0), last), to = fmin(fmax(ceil(at[a] + reach), 0), last);
        first[a] = (int64_t)from;
        count[a] = (int64_t)to - first[a] + 1;
    }
    return (tl_window){first[0], first[1], count[0], count[1]};
}

static double origin_distance(scene_places *p, double i, double j)
{
    double parts[PARTS];
    evaluate(p, 1, &i, &j, parts);
    return sqrt(parts[0] * parts[0] + parts[1] * parts[1] + parts[2] * parts[2]);
}

/* Metres from the origin to what of the raster is outside of the window, at least: places along its border, and along
 * that of a raster that goes around. Halved, for the border between them. */
static double outside_distance(scene_places *p, tl_window w)
{
    enum { STEPS = 16 };
    double least = (double)INFINITY, across = (double)(w.width - 1), down = (double)(w.height - 1);
    for (int k = 0; k <= STEPS; k++) {
        double x = (double)w.x + across * k / STEPS, y = (double)w.y + down * k / STEPS;
        if (p->info->wraps)
            least = fmin(least, fmin(origin_distance(p, 0, y), origin_distance(p, (double)(p->info->width - 1), y)));
        if (w.y > 0)
            least = fmin(least, origin_distance(p, x, (double)w.y));
        if (w.y + w.height < p->info->height)
            least = fmin(least, origin_distance(p, x, (double)w.y + down));
        if (w.x > 0)
            least = fmin(least, origin_distance(p, (double)w.x, y));
        if (w.x + w.width < p->info->width)
            least = fmin(least, origin_distance(p, (double)w.x + across, y));
    }
    return isfinite(least) ? least / 2 : 0;
}

static tl_status make_grid(scene_places *p, int which, tl_window window, double tolerance, tl_error *error)
{
    const dem_control_function f = {.components = PARTS,
                                    .evaluate = evaluate,
                                    .context = p,
                                    .weights = {1, 1, 1, highest, highest, highest},
                                    .tolerance = tolerance};
    return dem_control_grid_create(&f, window, BUDGET, &p->grids[which], error);
}

/* The tolerance for what is outside of the window around the eye. */
static double far_tolerance(scene_places *p, tl_window near, double tolerance, double pixel)
{
    return fmax(tolerance, pixel_part * pixel * outside_distance(p, near));
}

tl_status scene_places_prepare(scene_places *p, double distance, double pixel, tl_error *error)
{
    if (!p->global)
        return TL_OK;
    const tl_source_info *info = p->info;
    double i, j, tolerance = fmax(finest, pixel_part * pixel * (distance - 10 * highest));
    scene_places_sample(p, p->origin, &i, &j);
    tl_window whole = {0, 0, info->width, info->height}, near = whole;
    if (isfinite(i) && isfinite(j))
        near = near_window(info, i, j);
    tl_status status = TL_OK;
    if (near.width < whole.width || near.height < whole.height) {
        status = make_grid(p, NEAR, near, tolerance, error);
        tolerance = far_tolerance(p, near, tolerance, pixel);
        p->near = near;
    }
    return status == TL_OK ? make_grid(p, WHOLE, whole, tolerance, error) : status;
}

/* ---- places ---- */

static double error_of(const dem_control_grid *grid)
{
    const double between = 1.07; /* see dem_control_grid_create */
    return grid ? between * dem_control_grid_error(grid) : 0;
}

double scene_places_error(const scene_places *p, bool anywhere)
{
    double near = error_of(p->grids[p->grids[NEAR] ? NEAR : WHOLE]);
    return anywhere ? fmax(near, error_of(p->grids[WHOLE])) : near;
}

static bool contains(const tl_window *w, double i, double j)
{
    return i >= (double)w->x && i <= (double)(w->x + w->width - 1) && j >= (double)w->y &&
           j <= (double)(w->y + w->height - 1);
}

enum { EXACT = 2 };

/* Which of the grids gives a point. */
static int chosen(const scene_places *p, double i, double j)
{
    const tl_window whole = {0, 0, p->info->width, p->info->height};
    if (p->grids[NEAR] && contains(&p->near, i, j))
        return NEAR;
    return p->grids[WHOLE] && contains(&whole, i, j) ? WHOLE : EXACT;
}

static void plain_parts(const scene_places *p, size_t n, const double *i, const double *j, double *out)
{
    const double *a = p->affine;
    for (size_t k = 0; k < n; k++, out += PARTS) {
        out[0] = a[0] + a[1] * i[k] + a[2] * j[k];
        out[1] = a[3] + a[4] * i[k] + a[5] * j[k];
        out[2] = out[3] = out[4] = 0;
        out[5] = 1;
    }
}

void scene_places_parts(const scene_places *p, size_t n, const double *i, const double *j, double *out)
{
    if (!p->global) {
        plain_parts(p, n, i, j, out);
        return;
    }
    for (size_t k = 0, end; k < n; k = end) {
        int grid = chosen(p, i[k], j[k]);
        for (end = k + 1; end < n && chosen(p, i[end], j[end]) == grid;)
            end++;
        if (grid == EXACT)
            evaluate((scene_places *)p, end - k, i + k, j + k, out + k * PARTS); /* the lock is all that changes */
        else
            dem_control_grid_apply(p->grids[grid], end - k, i + k, j + k, out + k * PARTS);
    }
}

void scene_places_at(const scene_places *p, size_t n, const double *i, const double *j, const float *z,
                     double (*xyz)[3])
{
    double parts[BATCH * PARTS], metres = p->info->georef.height_unit;
    for (size_t done = 0; done < n; done += BATCH) {
        size_t count = n - done < BATCH ? n - done : BATCH;
        scene_places_parts(p, count, i + done, j + done, parts);
        for (size_t k = 0; k < count; k++)
            for (size_t a = 0; a < 3; a++)
                xyz[done + k][a] = parts[PARTS * k + a] + (double)z[done + k] * metres * parts[PARTS * k + 3 + a];
    }
}
