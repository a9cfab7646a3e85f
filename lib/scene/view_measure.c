/* How far the picture of one mesh is from that of another: see tl_view_measure. */
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/scene/mesh_picture.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
    SAMPLES = 4, /* of a pixel, each way */
    REACH = 4 * SAMPLES,
    CHUNK_ROWS = 256,
    STEPS = 256, /* of the histograms, in a pixel */
    BINS = 16 * STEPS,
    LOGS = 32, /* sizes of triangles, as powers of two */
    NOBODY = -1,
};

static const double edge_step = 1.1; /* ratio of distances that makes an edge */

/* ---- Distributions ---- */

typedef struct histogram {
    uint64_t bins[BINS + 1]; /* the last: all above */
    uint64_t count;
    double largest;
} histogram;

static void add(histogram *h, double error)
{
    double bin = ceil(error * STEPS);
    h->bins[bin < BINS ? (int)bin : BINS]++;
    h->count++;
    h->largest = fmax(h->largest, error);
}

static void merge(histogram *h, const histogram *other)
{
    for (int k = 0; k <= BINS; k++)
        h->bins[k] += other->bins[k];
    h->count += other->count;
    h->largest = fmax(h->largest, other->largest);
}

/* What a share of the errors is not above. */
static double quantile(const histogram *h, double share)
{
    uint64_t wanted = (uint64_t)ceil(share * (double)h->count), sum = 0;
    for (int k = 0; k < BINS; k++) {
        sum += h->bins[k];
        if (sum >= wanted)
            return fmin((double)k / STEPS, h->largest);
    }
    return h->largest;
}

static tl_view_errors summary(const histogram *h)
{
    return (tl_view_errors){h->count,          quantile(h, 0.5),   quantile(h, 0.9),
                            quantile(h, 0.99), quantile(h, 0.999), h->largest};
}

/* ---- Finding the triangle over a place of the lattice ---- */

/* Triangles by the cells of 2^log columns and rows that their boxes share area with; log is that of the box's larger
 * side, so that they are four at most. */
typedef struct entry {
    int32_t column, row, log;
    uint32_t triangle;
    int64_t next; /* in the same slot; NOBODY: none */
} entry;

typedef struct finder {
    const tl_mesh *mesh;
    entry *entries;
    size_t count, room;
    int64_t *slots;
    size_t slot_count; /* a power of two */
    bool used[LOGS];
} finder;

static size_t slot_of(const finder *f, int32_t column, int32_t row, int32_t log)
{
    uint64_t key = ((uint64_t)(uint32_t)column << 32 | (uint32_t)row) + (uint64_t)log * UINT64_C(0x9e3779b97f4a7c15);
    key = (key ^ key >> 30) * UINT64_C(0xbf58476d1ce4e5b9);
    key = (key ^ key >> 27) * UINT64_C(0x94d049bb133111eb);
    return (size_t)(key ^ key >> 31) & (f->slot_count - 1);
}

static tl_status put(finder *f, entry e, tl_error *error)
{
    if (f->count == f->room) {
        size_t room = f->room ? f->room + f->room / 2 : 1024;
        entry *grown = room < SIZE_MAX / sizeof *grown ? realloc(f->entries, room * sizeof *grown) : NULL;
        if (!grown)
            return tl_fail_memory(error, "the measurement");
        f->entries = grown;
        f->room = room;
    }
    size_t slot = slot_of(f, e.column, e.row, e.log);
    e.next = f->slots[slot];
    f->slots[slot] = (int64_t)f->count;
    f->entries[f->count++] = e;
    return TL_OK;
}

static int log_of(int64_t size)
{
    int log = 0;
    while (log < LOGS - 2 && INT64_C(1) << log < size)
        log++;
    return log;
}

static tl_status put_triangle(finder *f, uint32_t t, tl_error *error)
{
    int64_t i0 = INT64_MAX, i1 = INT64_MIN, j0 = INT64_MAX, j1 = INT64_MIN;
    for (size_t k = 0; k < 3; k++) {
        const tl_vertex *v = &f->mesh->vertices[f->mesh->indices[3 * (size_t)t + k]];
        i0 = tl_int64_min(i0, v->i);
        i1 = tl_int64_max(i1, v->i);
        j0 = tl_int64_min(j0, v->j);
        j1 = tl_int64_max(j1, v->j);
    }
    if (i0 == i1 || j0 == j1)
        return TL_OK;
    int log = log_of(tl_int64_max(i1 - i0, j1 - j0));
    f->used[log] = true;
    tl_status status = TL_OK;
    for (int64_t row = j0 >> log; row <= (j1 - 1) >> log && status == TL_OK; row++)
        for (int64_t column = i0 >> log; column <= (i1 - 1) >> log && status == TL_OK; column++)
            status = put(f, (entry){(int32_t)column, (int32_t)row, log, t, NOBODY}, error);
    return status;
}

static tl_status finder_init(finder *f, const tl_mesh *mesh, tl_error *error)
{
    *f = (finder){.mesh = mesh, .slot_count = 1024};
    while (f->slot_count < mesh->triangle_count && f->slot_count < SIZE_MAX / 64)
        f->slot_count *= 2;
    f->slots = tl_alloc(f->slot_count, sizeof *f->slots);
    if (!f->slots)
        return tl_fail_memory(error, "the measurement");
    for (size_t k = 0; k < f->slot_count; k++)
        f->slots[k] = NOBODY;
    tl_status status = TL_OK;
    for (size_t t = 0; t < mesh->triangle_count && status == TL_OK; t++)
        status = put_triangle(f, (uint32_t)t, error);
    return status;
}

static void finder_finish(finder *f)
{
    free(f->entries);
    free(f->slots);
}

/* The shares of a triangle's corners at a place; false where it is outside by more than rounding. */
static bool shares_at(const tl_mesh *mesh, uint32_t t, double i, double j, double shares[3])
{
    const tl_vertex *v[3];
    for (size_t k = 0; k < 3; k++)
        v[k] = &mesh->vertices[mesh->indices[3 * (size_t)t + k]];
    double ax = (double)v[1]->i - v[0]->i, ay = (double)v[1]->j - v[0]->j, bx = (double)v[2]->i - v[0]->i,
           by = (double)v[2]->j - v[0]->j, x = i - v[0]->i, y = j - v[0]->j, area = ax * by - ay * bx;
    shares[1] = (x * by - y * bx) / area;
    shares[2] = (ax * y - ay * x) / area;
    shares[0] = 1 - shares[1] - shares[2];
    const double hair = -1e-6;
    return shares[0] >= hair && shares[1] >= hair && shares[2] >= hair;
}

static bool find(const finder *f, double i, double j, uint32_t *triangle, double shares[3])
{
    for (int log = 0; log < LOGS; log++) {
        if (!f->used[log])
            continue;
        int32_t column = (int32_t)floor(ldexp(i, -log)), row = (int32_t)floor(ldexp(j, -log));
        for (int64_t k = f->slots[slot_of(f, column, row, log)]; k != NOBODY; k = f->entries[k].next) {
            const entry *e = &f->entries[k];
            if (e->column == column && e->row == row && e->log == log &&
                shares_at(f->mesh, e->triangle, i, j, shares)) {
                *triangle = e->triangle;
                return true;
            }
        }
    }
    return false;
}

/* On the far rims of cells, a hair before. */
static bool find_near(const finder *f, double i, double j, uint32_t *triangle, double shares[3])
{
    const double hair = 1e-7;
    return find(f, i, j, triangle, shares) || find(f, i - hair, j - hair, triangle, shares) ||
           find(f, i + hair, j - hair, triangle, shares) || find(f, i - hair, j + hair, triangle, shares);
}

/* ---- Measuring ---- */

typedef struct measuring {
    const scene_stage *mesh, *reference;
    finder finder;
    int width, height; /* samples */
    int band_rows, chunk_bands, margin_bands;
    histogram *parallax, *silhouette; /* by worker */
    uint64_t *missing;
} measuring;

/* Rows of both pictures around a chunk: metres ahead, infinite for the sky. */
typedef struct sheet {
    int top, rows;
    float *mesh, *reference;
} sheet;

static void measure_parallax(const measuring *m, const scene_hit *hit, double x, double y, unsigned worker)
{
    scene_point seen;
    uint32_t triangle;
    double shares[3], at[3] = {0};
    scene_stage_point(m->reference, hit, x, y, true, &seen);
    double i = seen.i, j = seen.j;
    scene_stage_lattice(m->mesh, &i, &j);
    bool found = find_near(&m->finder, i, j, &triangle, shares);
    for (size_t k = 0; k < 3 && found; k++) {
        const double *corner = scene_stage_vertex(m->mesh, m->finder.mesh->indices[3 * (size_t)triangle + k]);
        for (int a = 0; a < 3; a++)
            at[a] += shares[k] * corner[a];
    }
    if (!(at[2] > 0)) {
        m->missing[worker]++;
        return;
    }
    double across = at[0] / at[2] - seen.at[0] / seen.at[2], down = at[1] / at[2] - seen.at[1] / seen.at[2];
    add(&m->parallax[worker], hypot(across, down) / SAMPLES);
}

/* Draws a band of a picture into its rows of a sheet. */
static void draw_band(const scene_stage *stage, int band, scene_canvas *canvas, float *rows)
{
    scene_stage_draw(stage, band, canvas);
    size_t count = (size_t)canvas->width * (size_t)canvas->height;
    for (size_t k = 0; k < count; k++)
        rows[k] = canvas->hits[k].nearness > 0 ? 1 / canvas->hits[k].nearness : INFINITY;
}

static bool alike(float a, float b)
{
    if (isinf(a) || isinf(b))
        return isinf(a) && isinf(b);
    return (double)a <= (double)b * edge_step && (double)b <= (double)a * edge_step;
}

/* Whether one of the four neighbours of a sample is much nearer or farther. */
static bool is_edge(const sheet *s, const float *picture, int width, int x, int y)
{
    const float *at = picture + (size_t)y * (size_t)width + x;
    return (x > 0 && !alike(*at, at[-1])) || (x < width - 1 && !alike(*at, at[1])) ||
           (y > 0 && !alike(*at, at[-width])) || (y < s->rows - 1 && !alike(*at, at[width]));
}

/* Squared distance, in samples, to the nearest sample of a picture that is not farther (`nearer`) or not nearer than
 * wanted; at most REACH^2. */
static int nearest_such(const sheet *s, const float *picture, double wanted, bool nearer, int width, int x, int y)
{
    int best = REACH * REACH;
    double sign = nearer ? 1 : -1, limit = nearer ? wanted * edge_step : -wanted / edge_step;
    for (int dy = 0; dy * dy < best; dy++)
        for (int side = dy ? -1 : 1; side <= 1; side += 2) {
            int row = y + side * dy;
            if (row < 0 || row >= s->rows)
                continue;
            const float *line = picture + (size_t)row * (size_t)width;
            for (int dx = 0; dx * dx + dy * dy < best; dx++)
                if ((x + dx < width && sign * (double)line[x + dx] <= limit) ||
                    (x - dx >= 0 && sign * (double)line[x - dx] <= limit))
                    best = dx * dx + dy * dy;
        }
    return best;
}

/* How far around a sample one must look in the other picture to see what is as near, and what is as far: what lies
 * between them may be hidden by less than that. */
static double displacement(const sheet *s, const float *other, float wanted, int width, int x, int y)
{
    double here = (double)other[(size_t)y * (size_t)width + (size_t)x];
    if (here <= (double)wanted * edge_step && here >= (double)wanted / edge_step)
        return 0;
    int near = nearest_such(s, other, (double)wanted, true, width, x, y),
        far = nearest_such(s, other, (double)wanted, false, width, x, y);
    return sqrt(near > far ? near : far);
}

static void measure_edges(const measuring *m, const sheet *s, int first, int end, unsigned worker)
{
    const float *pictures[2] = {s->reference, s->mesh};
    for (int k = 0; k < 2; k++)
        for (int y = first; y < end; y++)
            for (int x = 0; x < m->width; x++) {
                float here = pictures[k][(size_t)y * (size_t)m->width + (size_t)x];
                if (is_edge(s, pictures[k], m->width, x, y))
                    add(&m->silhouette[worker], displacement(s, pictures[!k], here, m->width, x, y) / SAMPLES);
            }
}

/* The samples nearest to the middles of pixels. */
static void measure_band(const measuring *m, const scene_canvas *canvas, unsigned worker)
{
    int shift = (int)(canvas->top + m->height / 2.0);
    for (int y = 0; y < canvas->height; y++)
        for (int x = SAMPLES / 2; x < canvas->width && (y + shift) % SAMPLES == SAMPLES / 2; x += SAMPLES) {
            const scene_hit *hit = &canvas->hits[(size_t)y * (size_t)canvas->width + (size_t)x];
            if (hit->nearness > 0)
                measure_parallax(m, hit, canvas->left + x + 0.5, canvas->top + y + 0.5, worker);
        }
}

static tl_status measure_chunk(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    const measuring *m = context;
    int bands = scene_stage_bands(m->mesh), own = (int)item * m->chunk_bands;
    int own_end = own + m->chunk_bands < bands ? own + m->chunk_bands : bands;
    int first = own > m->margin_bands ? own - m->margin_bands : 0;
    int end = own_end + m->margin_bands < bands ? own_end + m->margin_bands : bands;
    sheet s = {.top = first * m->band_rows};
    s.rows = (int)tl_int64_min((int64_t)end * m->band_rows, m->height) - s.top;
    scene_canvas canvas = {.hits = tl_alloc(scene_stage_band_hits(m->mesh), sizeof *canvas.hits)};
    s.mesh = tl_alloc_grid(m->width, s.rows, sizeof *s.mesh);
    s.reference = tl_alloc_grid(m->width, s.rows, sizeof *s.reference);
    tl_status status = canvas.hits && s.mesh && s.reference ? TL_OK : tl_fail_memory(error, "the measurement");
    for (int band = first; band < end && status == TL_OK; band++) {
        size_t at = (size_t)(band - first) * (size_t)m->band_rows * (size_t)m->width;
        draw_band(m->mesh, band, &canvas, s.mesh + at);
        draw_band(m->reference, band, &canvas, s.reference + at);
        if (band >= own && band < own_end)
            measure_band(m, &canvas, worker);
    }
    if (status == TL_OK)
        measure_edges(m, &s, own * m->band_rows - s.top,
                      (int)tl_int64_min((int64_t)own_end * m->band_rows, m->height) - s.top, worker);
    free(canvas.hits);
    free(s.mesh);
    free(s.reference);
    return status;
}

static tl_status measure_all(measuring *m, const scene_camera *camera, const tl_run *run, tl_view_report *out,
                             tl_error *error)
{
    m->width = (int)camera->width * SAMPLES;
    m->height = (int)camera->height * SAMPLES;
    m->band_rows = (int)(scene_stage_band_hits(m->mesh) / (size_t)m->width);
    m->chunk_bands = (int)tl_div_up(CHUNK_ROWS, m->band_rows);
    m->margin_bands = (int)tl_div_up(REACH, m->band_rows);
    uint64_t chunks = (uint64_t)tl_div_up(scene_stage_bands(m->mesh), m->chunk_bands);
    unsigned workers = tl_parallel_workers(run, chunks);
    m->parallax = calloc(workers, sizeof *m->parallax);
    m->silhouette = calloc(workers, sizeof *m->silhouette);
    m->missing = calloc(workers, sizeof *m->missing);
    tl_status status = m->parallax && m->silhouette && m->missing ? TL_OK : tl_fail_memory(error, "the measurement");
    if (status == TL_OK)
        status = tl_parallel_for(run, chunks, (uint64_t)m->width * (uint64_t)m->height, measure_chunk, m, error);
    for (unsigned k = 1; k < workers && status == TL_OK; k++) {
        merge(&m->parallax[0], &m->parallax[k]);
        merge(&m->silhouette[0], &m->silhouette[k]);
        m->missing[0] += m->missing[k];
    }
    if (status == TL_OK)
        *out = (tl_view_report){summary(&m->parallax[0]), summary(&m->silhouette[0]), m->missing[0]};
    free(m->parallax);
    free(m->silhouette);
    free(m->missing);
    return status;
}

tl_status tl_view_measure(const tl_mesh *mesh, const tl_mesh *reference, const tl_source *dem, const tl_view *view,
                          const tl_run *run, tl_view_report *out, tl_error *error)
{
    tl_error local = {0};
    error = error ? error : &local;
    error->status = TL_OK;
    scene_view *opened = scene_view_create(view, dem, error);
    if (!opened)
        return error->status;
    const scene_camera *camera = scene_view_camera(opened);
    const scene_stage_options o = {.samples = SAMPLES, .exaggeration = 1, .run = run};
    measuring m = {0};
    scene_stage *stages[2] = {scene_stage_create(mesh, dem, opened, &o, error), NULL};
    if (stages[0])
        stages[1] = scene_stage_create(reference, dem, opened, &o, error);
    m.mesh = stages[0];
    m.reference = stages[1];
    tl_status status = stages[1] ? finder_init(&m.finder, mesh, error) : error->status;
    if (status == TL_OK)
        status = measure_all(&m, camera, run, out, error);
    finder_finish(&m.finder);
    scene_stage_destroy(stages[0]);
    scene_stage_destroy(stages[1]);
    scene_view_destroy(opened);
    return status;
}
