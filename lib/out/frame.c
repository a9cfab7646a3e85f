#include "lib/out/frame.h"

#include "dem/control_grid.h"
#include "dem/crs.h"
#include "dem/crs_ellipsoidal.h"
#include "lib/base/error.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

const char *const out_frame_names[] = {[TL_FRAME_DEFAULT] = "default",
                                       [TL_FRAME_ENU] = "enu",
                                       [TL_FRAME_PROJECTED] = "projected",
                                       [TL_FRAME_PIXEL] = "pixel",
                                       [TL_FRAME_ECEF] = "ecef"};

struct out_frame {
    tl_frame kind;
    const char *path; /* of the output, for messages */
    const tl_georef *georef;
    dem_projection *projection; /* of ENU frames */
    dem_local_frame *local;
    dem_control_grid *grid; /* of positions on the ellipsoid and of the way up; NULL: each vertex by itself */
    double origin[3];
    double axes[3][3], centre[3]; /* of the tangent plane, geocentric: east, north, up, and its origin */
};

enum { BATCH = 1024, MANY = 1 << 20 };

static void position(const tl_georef *g, double i, double j, double *x, double *y)
{
    const double *t = g->transform;
    *x = t[0] + t[1] * i + t[2] * j;
    *y = t[3] + t[4] * i + t[5] * j;
}

/* Whether places are found in the tangent plane. */
static bool frame_is_tangent(tl_frame kind)
{
    return kind == TL_FRAME_ENU || kind == TL_FRAME_ECEF;
}

/* The vertices' box: columns, rows, heights. */
static void find_box(const tl_mesh *mesh, double low[3], double high[3])
{
    for (int a = 0; a < 3; a++) {
        low[a] = (double)INFINITY; /* a float constant */
        high[a] = -(double)INFINITY;
    }
    for (size_t k = 0; k < mesh->vertex_count; k++) {
        const double at[3] = {mesh->vertices[k].i, mesh->vertices[k].j, (double)mesh->vertices[k].z};
        for (int a = 0; a < 3; a++) {
            low[a] = fmin(low[a], at[a]);
            high[a] = fmax(high[a], at[a]);
        }
    }
    if (!mesh->vertex_count)
        low[0] = low[1] = low[2] = high[0] = high[1] = high[2] = 0;
}

/* The middle of the box, so that float coordinates are small everywhere. */
static void set_origin(out_frame *frame, const double low[3], const double high[3])
{
    position(frame->georef, 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), &frame->origin[0], &frame->origin[1]);
    frame->origin[2] = 0.5 * (low[2] + high[2]) * frame->georef->height_unit;
    dem_projection_to_lonlat(frame->projection, 1, &frame->origin[0], &frame->origin[1]);
}

/* Where samples lie on the ellipsoid, and by how much a metre of height moves them. */
static void evaluate(void *context, size_t n, const double *i, const double *j, double *out)
{
    const out_frame *frame = context;
    for (size_t done = 0; done < n; done += BATCH) {
        double x[BATCH], y[BATCH];
        size_t count = n - done < BATCH ? n - done : BATCH;
        for (size_t k = 0; k < count; k++)
            position(frame->georef, i[done + k], j[done + k], &x[k], &y[k]);
        dem_projection_to_lonlat(frame->projection, count, x, y);
        for (size_t k = 0; k < count; k++, out += 6) {
            double above[3];
            const double up = 1e4; /* metres; the way up is a straight line */
            dem_local_frame_forward(frame->local, x[k], y[k], 0, out);
            dem_local_frame_forward(frame->local, x[k], y[k], up, above);
            for (int a = 0; a < 3; a++)
                out[3 + a] = (above[a] - out[a]) / up;
        }
    }
}

/* A million vertices are worth a control grid: they land within a millimetre, or within a thousandth of a cell where
 * that is less, of where they would. */
static tl_status begin_grid(out_frame *frame, const double low[3], const double high[3], size_t vertices,
                            tl_error *error)
{
    const tl_georef *g = frame->georef;
    double height = fmax(fabs(low[2]), fabs(high[2])) * g->height_unit;
    dem_control_function f = {.components = 6,
                              .evaluate = evaluate,
                              .context = frame,
                              .weights = {1, 1, 1, height, height, height},
                              .tolerance = 1e-3 * fmin(1, fmin(g->cell_x, g->cell_y))};
    if (vertices < MANY || !isfinite(height) || !(f.tolerance > 0))
        return TL_OK;
    tl_window window = {(int64_t)low[0], (int64_t)low[1], (int64_t)(high[0] - low[0]) + 1,
                        (int64_t)(high[1] - low[1]) + 1};
    return dem_control_grid_create(&f, window, vertices / 4, &frame->grid, error);
}

/* [Hofmann-Wellenhof et al., Physical Geodesy: ellipsoidal to Cartesian coordinates] */
static void find_axes(out_frame *frame)
{
    const double degree = 0x1.1df46a2529d39p-6; /* pi / 180 */
    const tl_crs *crs = frame->georef->crs;
    double longitude = (frame->origin[0] + dem_crs_prime_meridian(crs)) * degree;
    double latitude = frame->origin[1] * degree, height = frame->origin[2];
    double c = cos(longitude), s = sin(longitude), cn = cos(latitude), sn = sin(latitude);
    double e2 = crs->flattening * (2 - crs->flattening), normal = crs->semi_major / sqrt(1 - e2 * sn * sn);
    const double axes[3][3] = {{-s, c, 0}, {-sn * c, -sn * s, cn}, {cn * c, cn * s, sn}};
    memcpy(frame->axes, axes, sizeof axes);
    frame->centre[0] = (normal + height) * cn * c;
    frame->centre[1] = (normal + height) * cn * s;
    frame->centre[2] = (normal * (1 - e2) + height) * sn;
}

static tl_status begin_enu(out_frame *frame, const tl_mesh *mesh, const char *path, tl_error *error)
{
    const tl_georef *g = frame->georef;
    if (!g->crs || !g->located)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: where the raster lies is not known, so there is no east and north; use --frame projected",
                       path);
    frame->projection = dem_projection_create(g->crs, error);
    if (!frame->projection)
        return TL_ERROR_DATA;
    double low[3], high[3];
    find_box(mesh, low, high);
    set_origin(frame, low, high);
    if (!isfinite(frame->origin[0]) || !isfinite(frame->origin[1]))
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: the raster's middle has no longitude and latitude in %s; use --frame projected", path,
                       tl_crs_name(g->crs));
    frame->local = dem_local_frame_create(g->crs, frame->origin[0], frame->origin[1], frame->origin[2], error);
    if (!frame->local)
        return TL_ERROR_DATA;
    find_axes(frame);
    return begin_grid(frame, low, high, mesh->vertex_count, error);
}

out_frame *out_frame_create(const tl_mesh *mesh, tl_frame kind, const char *path, tl_error *error)
{
    out_frame *frame = calloc(1, sizeof *frame);
    if (!frame) {
        tl_fail_memory(error, path);
        return NULL;
    }
    frame->georef = &mesh->georef;
    frame->path = path;
    if (kind == TL_FRAME_DEFAULT)
        kind = mesh->georef.crs && mesh->georef.located ? TL_FRAME_ENU : TL_FRAME_PROJECTED;
    frame->kind = kind;
    if (frame_is_tangent(kind) && begin_enu(frame, mesh, path, error) != TL_OK) {
        out_frame_destroy(frame);
        return NULL;
    }
    return frame;
}

void out_frame_destroy(out_frame *frame)
{
    if (!frame)
        return;
    dem_control_grid_destroy(frame->grid);
    dem_projection_destroy(frame->projection);
    dem_local_frame_destroy(frame->local);
    free(frame);
}

tl_frame out_frame_kind(const out_frame *frame)
{
    return frame->kind;
}

const double *out_frame_origin(const out_frame *frame)
{
    return frame->origin;
}

bool out_frame_faces_up(const out_frame *frame)
{
    const double *t = frame->georef->transform;
    if (frame->kind == TL_FRAME_PIXEL)
        return false; /* j runs down */
    return t[1] * t[5] - t[2] * t[4] < 0;
}

static void apply_grid(const out_frame *frame, const tl_vertex *v, size_t n, double (*xyz)[3])
{
    double i[BATCH], j[BATCH], place[6 * BATCH];
    for (size_t k = 0; k < n; k++) {
        i[k] = v[k].i;
        j[k] = v[k].j;
    }
    dem_control_grid_apply(frame->grid, n, i, j, place);
    for (size_t k = 0; k < n; k++) {
        double height = (double)v[k].z * frame->georef->height_unit;
        for (size_t a = 0; a < 3; a++)
            xyz[k][a] = place[6 * k + a] + height * place[6 * k + 3 + a];
    }
}

static tl_status apply_enu(out_frame *frame, const tl_vertex *v, size_t n, double (*xyz)[3], tl_error *error)
{
    double x[BATCH], y[BATCH];
    if (frame->grid) {
        apply_grid(frame, v, n, xyz);
        return TL_OK;
    }
    for (size_t k = 0; k < n; k++)
        position(frame->georef, v[k].i, v[k].j, &x[k], &y[k]);
    dem_projection_to_lonlat(frame->projection, n, x, y);
    for (size_t k = 0; k < n; k++) {
        if (!isfinite(x[k]) || !isfinite(y[k]))
            return tl_fail(
                error, TL_ERROR_DATA,
                "%s: the sample at column %d, row %d has no longitude and latitude in %s; use --frame projected",
                frame->path, v[k].i, v[k].j, tl_crs_name(frame->georef->crs));
        dem_local_frame_forward(frame->local, x[k], y[k], (double)v[k].z * frame->georef->height_unit, xyz[k]);
    }
    return TL_OK;
}

void out_frame_to_ecef(const out_frame *frame, const double enu[3], double out[3])
{
    for (int a = 0; a < 3; a++)
        out[a] =
            frame->centre[a] + frame->axes[0][a] * enu[0] + frame->axes[1][a] * enu[1] + frame->axes[2][a] * enu[2];
}

void out_frame_from_ecef(const out_frame *frame, const double ecef[3], double out[3])
{
    double d[3];
    for (int a = 0; a < 3; a++)
        d[a] = ecef[a] - frame->centre[a];
    for (int a = 0; a < 3; a++)
        out[a] = frame->axes[a][0] * d[0] + frame->axes[a][1] * d[1] + frame->axes[a][2] * d[2];
}

void out_frame_tangent(const out_frame *frame, double axes[3][3], double centre[3])
{
    memcpy(axes, frame->axes, sizeof frame->axes);
    memcpy(centre, frame->centre, sizeof frame->centre);
}

bool out_frame_place(const out_frame *frame, double i, double j, double z, double xyz[3])
{
    xyz[0] = i, xyz[1] = j, xyz[2] = z;
    if (frame->kind != TL_FRAME_PIXEL)
        position(frame->georef, i, j, &xyz[0], &xyz[1]);
    if (frame_is_tangent(frame->kind)) {
        double x = xyz[0], y = xyz[1];
        dem_projection_to_lonlat(frame->projection, 1, &x, &y);
        if (!isfinite(x) || !isfinite(y))
            return false;
        dem_local_frame_forward(frame->local, x, y, z * frame->georef->height_unit, xyz);
    }
    if (frame->kind == TL_FRAME_ECEF) {
        const double enu[3] = {xyz[0], xyz[1], xyz[2]};
        out_frame_to_ecef(frame, enu, xyz);
    }
    return isfinite(xyz[0]) && isfinite(xyz[1]) && isfinite(xyz[2]);
}

tl_status out_frame_apply(out_frame *frame, const tl_vertex *v, size_t n, double (*xyz)[3], tl_error *error)
{
    tl_status status = TL_OK;
    if (frame_is_tangent(frame->kind)) {
        for (size_t k = 0; k < n && status == TL_OK; k += BATCH)
            status = apply_enu(frame, v + k, n - k < BATCH ? n - k : BATCH, xyz + k, error);
        for (size_t k = 0; k < n && status == TL_OK && frame->kind == TL_FRAME_ECEF; k++) {
            const double enu[3] = {xyz[k][0], xyz[k][1], xyz[k][2]};
            out_frame_to_ecef(frame, enu, xyz[k]);
        }
        return status;
    }
    for (size_t k = 0; k < n; k++) {
        xyz[k][0] = v[k].i;
        xyz[k][1] = v[k].j;
        xyz[k][2] = (double)v[k].z;
        if (frame->kind == TL_FRAME_PROJECTED)
            position(frame->georef, v[k].i, v[k].j, &xyz[k][0], &xyz[k][1]);
    }
    return TL_OK;
}
