#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/scene/mesh_picture.h"

#include <math.h>
#include <stdlib.h>

enum { BATCH = 256, ITEM = 1 << 14, BAND_HITS = 1 << 18, BAND_ROWS = 64, BANDS_MAX = 1 << 15 };

/* The bands that a triangle may be seen in; first > last: none. */
typedef struct span {
    uint16_t first, last;
} span;

struct scene_stage {
    const tl_mesh *mesh;
    const scene_view *view;
    scene_camera camera; /* its pixels are samples */
    double lattice[6];   /* of the mesh to the model: i = l[0] + l[1] i' + l[2] j', j = l[3] + l[4] i' + l[5] j' */
    float factor;        /* on heights */
    double facing;       /* 1 where the mesh's faces look up in the view's frame, -1 where they look down */
    int band_rows, bands;
    double (*corners)[3]; /* right and down in samples at 1 m ahead, ahead in metres */
    float (*normals)[3];  /* right, down, ahead; of length 1; NULL: not wanted */
    span *spans;          /* by triangle */
};

/* ---- placing ---- */

/* Both lattices' transforms are of the same CRS. */
static bool set_lattice(scene_stage *s, const tl_georef *mesh, const tl_georef *dem)
{
    const double *m = mesh->transform, *d = dem->transform;
    double determinant = d[1] * d[5] - d[2] * d[4];
    for (int k = 0; k < 3; k++) {
        double x = m[k] - (k == 0 ? d[0] : 0), y = m[3 + k] - (k == 0 ? d[3] : 0);
        s->lattice[k] = (d[5] * x - d[2] * y) / determinant;
        s->lattice[3 + k] = (d[1] * y - d[4] * x) / determinant;
    }
    /* cells of a level are a power of two of the model's: without what rounding of the transforms left */
    for (int k = 0; k < 6; k++) {
        double exact = k % 3 ? ldexp(round(ldexp(s->lattice[k], 32)), -32) : s->lattice[k];
        if (fabs(exact - s->lattice[k]) < 1e-12)
            s->lattice[k] = exact;
    }
    s->facing = m[1] * m[5] - m[2] * m[4] < 0 ? 1 : -1;
    return isfinite(s->lattice[0] + s->lattice[1] + s->lattice[2] + s->lattice[3] + s->lattice[4] + s->lattice[5]);
}

static void model_place(const scene_stage *s, double i, double j, double *column, double *row)
{
    const double *l = s->lattice;
    *column = l[0] + l[1] * i + l[2] * j;
    *row = l[3] + l[4] * i + l[5] * j;
}

static tl_status place_vertices(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    (void)error;
    scene_stage *s = context;
    size_t end = (size_t)(item + 1) * ITEM < s->mesh->vertex_count ? (size_t)(item + 1) * ITEM : s->mesh->vertex_count;
    for (size_t from = (size_t)item * ITEM; from < end; from += BATCH) {
        double i[BATCH], j[BATCH], at[BATCH][3];
        float z[BATCH];
        size_t n = end - from < BATCH ? end - from : BATCH;
        for (size_t k = 0; k < n; k++) {
            const tl_vertex *v = &s->mesh->vertices[from + k];
            model_place(s, v->i, v->j, &i[k], &j[k]);
            z[k] = v->z * s->factor;
        }
        scene_view_place(s->view, n, i, j, z, at);
        for (size_t k = 0; k < n; k++)
            scene_camera_view(&s->camera, at[k], s->corners[from + k]);
    }
    return TL_OK;
}

static bool comes_first(const tl_vertex *a, const tl_vertex *b)
{
    return a->j != b->j ? a->j < b->j : a->i < b->i;
}

/* The vertices of a triangle, from the one that comes first on the lattice: a mesh that begins its triangles elsewhere
 * has the same picture, to the last bit. */
static void vertices_of(const scene_stage *s, size_t triangle, uint32_t out[3])
{
    const uint32_t *v = &s->mesh->indices[3 * triangle];
    const tl_vertex *all = s->mesh->vertices;
    int first = comes_first(&all[v[1]], &all[v[0]]);
    if (comes_first(&all[v[2]], &all[v[first]]))
        first = 2;
    for (int k = 0; k < 3; k++)
        out[k] = v[(first + k) % 3];
}

static void corners_of(const scene_stage *s, size_t triangle, const double *out[3])
{
    uint32_t v[3];
    vertices_of(s, triangle, v);
    for (int k = 0; k < 3; k++)
        out[k] = s->corners[v[k]];
}

static void cross(const double a[3], const double b[3], double out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* The normal of a triangle, as long as twice its area: right, down, ahead. */
static void face_normal(const scene_stage *s, size_t triangle, double out[3])
{
    const double *c[3];
    corners_of(s, triangle, c);
    const double e[3] = {c[1][0] - c[0][0], c[1][1] - c[0][1], c[1][2] - c[0][2]},
                 g[3] = {c[2][0] - c[0][0], c[2][1] - c[0][1], c[2][2] - c[0][2]};
    double f = s->camera.focal, scaled[3];
    cross(e, g, scaled);
    out[0] = s->facing * scaled[0] / f;
    out[1] = s->facing * scaled[1] / f;
    out[2] = s->facing * scaled[2] / (f * f);
}

/* One after the other, so that sums do not depend on threads; and in doubles, so that what the order of the triangles
 * changes is lost in the normals' rounding: selectors that find the same triangles give the same picture. */
static tl_status add_normals(scene_stage *s, tl_error *error)
{
    double(*sums)[3] = calloc(s->mesh->vertex_count + 1, sizeof *sums);
    if (!sums)
        return tl_fail_memory(error, "the picture");
    for (size_t t = 0; t < s->mesh->triangle_count; t++) {
        double n[3];
        face_normal(s, t, n);
        if (!isfinite(n[0] + n[1] + n[2]))
            continue;
        for (size_t k = 0; k < 3; k++) {
            double *sum = sums[s->mesh->indices[3 * t + k]];
            for (int a = 0; a < 3; a++)
                sum[a] += n[a];
        }
    }
    for (size_t k = 0; k < s->mesh->vertex_count; k++) {
        const double *n = sums[k];
        double length = sqrt(dot(n, n));
        for (int a = 0; a < 3; a++)
            s->normals[k][a] = length > 0 ? (float)(n[a] / length) : 0;
    }
    free(sums);
    return TL_OK;
}

/* ---- bands ---- */

/* The rows of a triangle on the screen, or none where it looks away or is beside it. */
static span span_of(const scene_stage *s, size_t triangle)
{
    const span none = {1, 0}, all = {0, (uint16_t)(s->bands - 1)};
    const double *c[3];
    corners_of(s, triangle, c);
    double volume[3], low = (double)INFINITY, high = -(double)INFINITY, wide = s->camera.width / 2;
    cross(c[1], c[2], volume);
    if (!(s->facing * dot(c[0], volume) < 0)) /* also NaN */
        return none;
    int left = 0, right = 0, behind = 0;
    for (int k = 0; k < 3; k++) {
        double w = c[k][2];
        behind += w <= 0;
        left += c[k][0] < -(wide + 1) * w;
        right += c[k][0] > (wide + 1) * w;
        low = fmin(low, c[k][1] / w);
        high = fmax(high, c[k][1] / w);
    }
    if (left == 3 || right == 3 || behind == 3)
        return none;
    if (behind)
        return all;
    double tall = s->camera.height / 2, first = floor((low + tall - 1) / s->band_rows),
           last = floor((high + tall + 1) / s->band_rows);
    if (last < 0 || first >= s->bands)
        return none;
    return (span){(uint16_t)fmax(first, 0), (uint16_t)fmin(last, s->bands - 1)};
}

static tl_status find_spans(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    (void)error;
    scene_stage *s = context;
    size_t count = s->mesh->triangle_count, first = (size_t)item * ITEM;
    for (size_t t = first; t < count && t < first + ITEM; t++)
        s->spans[t] = span_of(s, t);
    return TL_OK;
}

static void set_bands(scene_stage *s)
{
    int rows = (int)fmax(BAND_HITS / s->camera.width, 1);
    rows = rows > BAND_ROWS ? BAND_ROWS : rows;
    s->band_rows = rows >= 2 ? rows / 2 * 2 : 2; /* whole pixels, if a pixel has 2 samples */
    s->bands = (int)tl_div_up((int64_t)s->camera.height, s->band_rows);
}

int scene_stage_bands(const scene_stage *stage)
{
    return stage->bands;
}

size_t scene_stage_band_hits(const scene_stage *stage)
{
    return (size_t)stage->camera.width * (size_t)stage->band_rows;
}

void scene_stage_draw(const scene_stage *s, int band, scene_canvas *canvas)
{
    int64_t top = (int64_t)band * s->band_rows;
    canvas->width = (int)s->camera.width;
    canvas->height = (int)tl_int64_min(s->band_rows, (int64_t)s->camera.height - top);
    canvas->left = -s->camera.width / 2;
    canvas->top = (double)top - s->camera.height / 2;
    scene_canvas_clear(canvas);
    for (size_t t = 0; t < s->mesh->triangle_count; t++)
        if (s->spans[t].first <= band && band <= s->spans[t].last) {
            const double *c[3];
            corners_of(s, t, c);
            scene_canvas_draw(canvas, c[0], c[1], c[2], (uint32_t)t);
        }
}

/* ---- lifecycle ---- */

static tl_status fill_stage(scene_stage *s, const scene_stage_options *o, tl_error *error)
{
    size_t vertices = s->mesh->vertex_count, triangles = s->mesh->triangle_count;
    double bytes = (double)vertices * (o->normals ? 60 : 24) + (double)triangles * sizeof *s->spans;
    tl_status status = tl_run_fits(o->run, bytes, "the picture", "drawing its triangles", error);
    if (status != TL_OK)
        return status;
    s->corners = tl_alloc(vertices, sizeof *s->corners);
    s->spans = tl_alloc(triangles, sizeof *s->spans);
    s->normals = o->normals ? tl_alloc(vertices, sizeof *s->normals) : NULL;
    if (!s->corners || !s->spans || (o->normals && !s->normals))
        return tl_fail_memory(error, "the picture");
    tl_run quiet = o->run ? *o->run : (tl_run){0};
    quiet.progress = NULL;
    status = tl_parallel_for(&quiet, vertices / ITEM + 1, 0, place_vertices, s, error);
    if (status == TL_OK)
        status = tl_parallel_for(&quiet, triangles / ITEM + 1, 0, find_spans, s, error);
    if (status == TL_OK && o->normals)
        status = add_normals(s, error);
    return status;
}

scene_stage *scene_stage_create(const tl_mesh *mesh, const tl_source *dem, const scene_view *view,
                                const scene_stage_options *options, tl_error *error)
{
    scene_stage *s = calloc(1, sizeof *s);
    if (!s) {
        tl_fail_memory(error, "the picture");
        return NULL;
    }
    s->mesh = mesh;
    s->view = view;
    s->camera = *scene_view_camera(view);
    s->camera.width *= options->samples;
    s->camera.height *= options->samples;
    s->camera.focal *= options->samples;
    s->factor = (float)options->exaggeration;
    set_bands(s);
    tl_status status = TL_OK;
    if (!set_lattice(s, &mesh->georef, &dem->info.georef) || mesh->triangle_count > UINT32_MAX)
        status = tl_fail(error, TL_ERROR_ARGUMENT, "%s: the mesh does not lie over it, or has 2^32 triangles or more",
                         dem->info.name);
    if (status == TL_OK)
        status = fill_stage(s, options, error);
    if (status == TL_OK)
        return s;
    scene_stage_destroy(s);
    return NULL;
}

void scene_stage_destroy(scene_stage *stage)
{
    if (!stage)
        return;
    free(stage->corners);
    free(stage->normals);
    free(stage->spans);
    free(stage);
}

/* ---- points ---- */

/* The shares of the corners in the point where a direction meets a triangle: d is u a + v b + w c, so that u is (b x c)
 * d over the volume. Corners on the screen are rounded, so a direction may be beside the triangle by a hair: then its
 * rim counts. */
static void shares_of(const double *const corners[3], const double direction[3], double out[3])
{
    double sum = 0;
    for (int k = 0; k < 3; k++) {
        double normal[3];
        cross(corners[(k + 1) % 3], corners[(k + 2) % 3], normal);
        out[k] = dot(normal, direction);
        sum += out[k];
    }
    double kept = 0;
    for (int k = 0; k < 3; k++) {
        out[k] = out[k] / sum;
        out[k] = out[k] > 0 ? out[k] : 0;
        kept += out[k];
    }
    for (int k = 0; k < 3; k++)
        out[k] = kept > 0 ? out[k] / kept : 1 / 3.0;
}

static void mean_normal(const scene_stage *s, const uint32_t *v, const double shares[3], double out[3])
{
    for (int a = 0; a < 3; a++)
        out[a] = shares[0] * (double)s->normals[v[0]][a] + shares[1] * (double)s->normals[v[1]][a] +
                 shares[2] * (double)s->normals[v[2]][a];
}

static void set_normal(const scene_stage *s, const double n[3], float out[3])
{
    const scene_camera *c = &s->camera;
    double length = sqrt(dot(n, n));
    for (int a = 0; a < 3; a++) {
        double along = n[0] * c->right[a] + n[1] * c->down[a] + n[2] * c->ahead[a];
        out[a] = length > 0 ? (float)(along / length) : a == 2;
    }
}

void scene_stage_point(const scene_stage *s, const scene_hit *hit, double x, double y, bool facet, scene_point *out)
{
    uint32_t v[3];
    vertices_of(s, hit->triangle, v);
    const double *corners[3] = {s->corners[v[0]], s->corners[v[1]], s->corners[v[2]]}, direction[3] = {x, y, 1};
    double shares[3], i = 0, j = 0, normal[3];
    shares_of(corners, direction, shares);
    out->height = out->at[0] = out->at[1] = out->at[2] = 0;
    for (int k = 0; k < 3; k++) {
        const tl_vertex *at = &s->mesh->vertices[v[k]];
        i += shares[k] * at->i;
        j += shares[k] * at->j;
        out->height += shares[k] * (double)at->z;
        for (int a = 0; a < 3; a++)
            out->at[a] += shares[k] * corners[k][a];
    }
    model_place(s, i, j, &out->i, &out->j);
    if (facet || !s->normals)
        face_normal(s, hit->triangle, normal);
    else
        mean_normal(s, v, shares, normal);
    set_normal(s, normal, out->normal);
}

const double *scene_stage_vertex(const scene_stage *stage, uint32_t vertex)
{
    return stage->corners[vertex];
}

void scene_stage_lattice(const scene_stage *stage, double *i, double *j)
{
    const double *l = stage->lattice;
    double determinant = l[1] * l[5] - l[2] * l[4], x = *i - l[0], y = *j - l[3];
    *i = (l[5] * x - l[2] * y) / determinant;
    *j = (l[1] * y - l[4] * x) / determinant;
}
