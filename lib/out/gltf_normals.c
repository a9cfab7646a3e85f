#include "lib/out/gltf_normals.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/scene/field.h"
#include "lib/scene/layers.h"

#include <math.h>
#include <string.h>

void gltf_turn(const double in[3], double out[3])
{
    out[0] = in[0];
    out[1] = in[2];
    out[2] = -in[1];
}

void gltf_cross(const double a[3], const double b[3], double out[3])
{
    for (int k = 0; k < 3; k++)
        out[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
}

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

void gltf_scale_to_one(double v[3])
{
    double length = sqrt(dot(v, v));
    for (int k = 0; k < 3 && length > 0; k++)
        v[k] /= length;
}

/* ---- Directions ---- */

/* Places on each side where they are known. Between them they are linear: over a raster 60 degrees wide that is off by
 * (60 / 32 degrees)^2 / 8, a hundred-and-thirty-thousandth of a turn; over one of a degree by less than floats hold. */
enum { PLACES = 33, ALONG = 0, DOWN, UP, ALONG_UP, DOWN_UP, VECTORS };

typedef struct place {
    bool known;
    double v[VECTORS][3]; /* ALONG_UP, DOWN_UP: what a unit of height adds to ALONG and DOWN, which are of height 0 */
} place;

struct gltf_directions {
    double at[2][PLACES]; /* columns, and rows */
    place places[PLACES][PLACES];
};

static void find_box(const tl_mesh *mesh, double low[2], double high[2])
{
    for (size_t k = 0; k < mesh->vertex_count; k++) {
        const double at[2] = {mesh->vertices[k].i, mesh->vertices[k].j};
        for (int a = 0; a < 2; a++) {
            low[a] = k ? fmin(low[a], at[a]) : at[a];
            high[a] = k ? fmax(high[a], at[a]) : at[a];
        }
    }
}

/* The way from one place to another, for each unit. */
static bool way(const out_frame *frame, const double from[3], const double to[3], double by, double out[3])
{
    double p[3], q[3], difference[3];
    if (!out_frame_place(frame, from[0], from[1], from[2], p) || !out_frame_place(frame, to[0], to[1], to[2], q))
        return false;
    for (int k = 0; k < 3; k++)
        difference[k] = (q[k] - p[k]) / by;
    gltf_turn(difference, out);
    return true;
}

/* By a column or a row: over half of one to both sides, or to the one where there are coordinates. */
static bool way_along(const out_frame *frame, const double at[2], int axis, double z, double out[3])
{
    static const double reach[3][2] = {{-0.5, 0.5}, {-0.5, 0}, {0, 0.5}};
    for (int k = 0; k < 3; k++) {
        double from[3] = {at[0], at[1], z}, to[3] = {at[0], at[1], z};
        from[axis] += reach[k][0], to[axis] += reach[k][1];
        if (way(frame, from, to, to[axis] - from[axis], out))
            return true;
    }
    return false;
}

static place find_place(const out_frame *frame, const double at[2])
{
    const double rise = 1024; /* any: the way up is a straight line */
    const double foot[3] = {at[0], at[1], 0}, head[3] = {at[0], at[1], rise};
    place p = {.known = way(frame, foot, head, rise, p.v[UP])};
    for (int axis = 0; axis < 2 && p.known; axis++) {
        double *level = p.v[axis ? DOWN : ALONG], *more = p.v[axis ? DOWN_UP : ALONG_UP];
        p.known = way_along(frame, at, axis, 0, level) && way_along(frame, at, axis, rise, more);
        for (int k = 0; k < 3 && p.known; k++)
            more[k] = (more[k] - level[k]) / rise;
    }
    return p;
}

gltf_directions *gltf_directions_create(const tl_mesh *mesh, const out_frame *frame, const char *path, tl_error *error)
{
    gltf_directions *d = malloc(sizeof *d);
    double low[2] = {0, 0}, high[2] = {0, 0};
    if (!d) {
        tl_fail_memory(error, path);
        return NULL;
    }
    find_box(mesh, low, high);
    for (int a = 0; a < 2; a++)
        for (int k = 0; k < PLACES; k++)
            d->at[a][k] = low[a] + (high[a] - low[a]) * k / (PLACES - 1);
    for (int y = 0; y < PLACES; y++)
        for (int x = 0; x < PLACES; x++) {
            const double at[2] = {d->at[0][x], d->at[1][y]};
            d->places[y][x] = find_place(frame, at);
        }
    return d;
}

void gltf_directions_destroy(gltf_directions *directions)
{
    free(directions);
}

/* The place before `at`, and how far it is on the way to the next. */
static int before(const double *places, double at, double *share)
{
    double step = places[1] - places[0];
    double t = step > 0 ? (at - places[0]) / step : 0;
    int k = t > 0 ? t < PLACES - 2 ? (int)t : PLACES - 2 : 0;
    *share = t - k;
    return k;
}

bool gltf_direction_at(const gltf_directions *directions, double i, double j, double z, gltf_direction *out)
{
    double a, b, mixed[VECTORS][3];
    int x = before(directions->at[0], i, &a), y = before(directions->at[1], j, &b);
    const place *upper = &directions->places[y][x], *lower = &directions->places[y + 1][x];
    if (!upper[0].known || !upper[1].known || !lower[0].known || !lower[1].known)
        return false;
    for (int v = 0; v < VECTORS; v++)
        for (int k = 0; k < 3; k++)
            mixed[v][k] = (1 - b) * ((1 - a) * upper[0].v[v][k] + a * upper[1].v[v][k]) +
                          b * ((1 - a) * lower[0].v[v][k] + a * lower[1].v[v][k]);
    for (int k = 0; k < 3; k++) {
        out->along[k] = mixed[ALONG][k] + z * mixed[ALONG_UP][k];
        out->down[k] = mixed[DOWN][k] + z * mixed[DOWN_UP][k];
        out->up[k] = mixed[UP][k];
    }
    return true;
}

/* The normal of a surface that rises by these units of height a column and a row. */
static bool normal_at(const gltf_directions *directions, const tl_vertex *v, const double slopes[2], float *out)
{
    gltf_direction d;
    double normal[3];
    if (!gltf_direction_at(directions, v->i, v->j, (double)v->z, &d))
        return false;
    for (int k = 0; k < 3; k++) {
        d.along[k] += slopes[0] * d.up[k];
        d.down[k] += slopes[1] * d.up[k];
    }
    gltf_cross(d.along, d.down, normal);
    gltf_scale_to_one(normal);
    double upwards = dot(normal, d.up); /* below 0 where rows run upwards on a map */
    for (int k = 0; k < 3; k++)
        out[k] = (float)(upwards < 0 ? -normal[k] : normal[k]);
    return upwards != 0;
}

/* ---- The ground's levels ---- */

enum {
    STEPS = 31,
    BLOCK_LOG = 8, /* of the samples that are read at once, at most, beside those around */
    SQUARE_LOG = 6 /* of the largest square over which slopes are meant, on a side, halved: 4 blocks are read for one */
};

/* Heights at every 2^k-th sample of the lattice. */
typedef struct grid {
    const tl_source *from;
    int level;
    bool means; /* of the cells between them */
    int64_t width, height;
} grid;

typedef struct job {
    const tl_mesh *mesh;
    const tl_source *ground;
    const gltf_directions *directions;
    bool has_base;
    bool nests;              /* each vertex has a grid; else all have the finest, and slopes are meant over squares */
    grid grids[STEPS];       /* by the logarithm of their step */
    unsigned char *steps;    /* logarithms of the vertices' shortest edges */
    uint32_t *order, *spare; /* vertices, block by block */
    uint32_t *first;         /* in `order`, of each block that has any, and the end */
    size_t blocks;
    float *normals;
    size_t stride;
} job;

/* The grids that there are; returns their number. */
static int find_grids(job *self)
{
    const tl_source *model = scene_field_dem(self->ground);
    for (int step = 0; step < STEPS; step++) {
        grid *g = &self->grids[step];
        g->level = self->ground->info.level - step;
        g->from = model && g->level < 0 ? model : self->ground;
        g->means = g->level < 0 && g->from->info.type == TL_RASTER_AREA;
        if ((step && !self->nests) || tl_source_size(g->from, g->level, &g->width, &g->height, NULL) != TL_OK)
            return step;
    }
    return STEPS;
}

static void note_edge(job *self, uint32_t a, uint32_t b)
{
    const tl_vertex *p = &self->mesh->vertices[a], *q = &self->mesh->vertices[b];
    int64_t x = (int64_t)p->i - q->i, y = (int64_t)p->j - q->j;
    int64_t length = tl_int64_max(x < 0 ? -x : x, y < 0 ? -y : y);
    unsigned char step = 0;
    if (!length) /* of a wall */
        return;
    for (; length > 1; length /= 2)
        step++;
    self->steps[a] = self->steps[a] < step ? self->steps[a] : step;
    self->steps[b] = self->steps[b] < step ? self->steps[b] : step;
}

/* The step of each vertex's shortest edge: that of its grid, on which it lies, or of its square. */
static void choose_steps(job *self)
{
    const tl_mesh *mesh = self->mesh;
    int grids = find_grids(self);
    memset(self->steps, self->nests ? grids - 1 : SQUARE_LOG + 1, mesh->vertex_count);
    for (size_t t = 0; t < mesh->triangle_count; t++)
        for (size_t k = 0; k < 3; k++)
            note_edge(self, mesh->indices[3 * t + k], mesh->indices[3 * t + (k + 1) % 3]);
    for (size_t k = 0; self->nests && k < mesh->vertex_count; k++) {
        int64_t both = (int64_t)mesh->vertices[k].i | mesh->vertices[k].j;
        while (both & ((INT64_C(1) << self->steps[k]) - 1))
            self->steps[k]--;
    }
}

static tl_status check_place(const job *self, tl_error *error)
{
    const tl_source_info *info = &self->ground->info;
    for (size_t k = 0; k < self->mesh->vertex_count; k++) {
        const tl_vertex *v = &self->mesh->vertices[k];
        if (v->i < 0 || v->j < 0 || v->i >= info->width || v->j >= info->height)
            return tl_fail(error, TL_ERROR_ARGUMENT,
                           "%s: the mesh has a vertex at column %d, row %d, which is not on this ground", info->name,
                           v->i, v->j);
    }
    return TL_OK;
}

/* ---- Blocks ---- */

/* The logarithm of the step of a vertex's grid. */
static int grid_of(const job *self, uint32_t vertex)
{
    return self->nests ? self->steps[vertex] : 0;
}

/* Where a vertex lies in its grid: column and row of its block, and the grid's step. */
static uint32_t digit(const job *self, uint32_t vertex, int which)
{
    const tl_vertex *v = &self->mesh->vertices[vertex];
    int step = grid_of(self, vertex);
    return which == 2 ? (uint32_t)step : (uint32_t)((which ? v->j : v->i) >> step >> BLOCK_LOG);
}

/* Sorts by one digit, and keeps the order of equal ones. */
static bool sort_by(job *self, int which)
{
    const int64_t sizes[3] = {self->ground->info.width, self->ground->info.height, 0};
    size_t kinds = which == 2 ? STEPS : (size_t)(sizes[which] >> BLOCK_LOG) + 1;
    size_t count = self->mesh->vertex_count, sum = 0;
    size_t *next = calloc(kinds, sizeof *next);
    if (!next)
        return false;
    for (size_t k = 0; k < count; k++)
        next[digit(self, self->order[k], which)]++;
    for (size_t k = 0; k < kinds; k++) {
        size_t here = next[k];
        next[k] = sum;
        sum += here;
    }
    for (size_t k = 0; k < count; k++)
        self->spare[next[digit(self, self->order[k], which)]++] = self->order[k];
    uint32_t *sorted = self->spare;
    self->spare = self->order;
    self->order = sorted;
    free(next);
    return true;
}

static bool begins_block(const job *self, size_t k)
{
    for (int which = 0; k && which < 3; which++)
        if (digit(self, self->order[k], which) != digit(self, self->order[k - 1], which))
            return true;
    return !k;
}

static bool find_blocks(job *self)
{
    size_t count = self->mesh->vertex_count;
    for (size_t k = 0; k < count; k++)
        self->order[k] = (uint32_t)k;
    for (int which = 0; which < 3; which++)
        if (!sort_by(self, which))
            return false;
    for (size_t k = 0; k < count; k++)
        self->blocks += begins_block(self, k);
    self->first = tl_alloc(self->blocks + 1, sizeof *self->first);
    size_t block = 0;
    for (size_t k = 0; self->first && k < count; k++)
        if (begins_block(self, k))
            self->first[block++] = (uint32_t)k;
    if (self->first)
        self->first[block] = (uint32_t)count;
    return self->first;
}

/* ---- Slopes ---- */

typedef struct patch {
    tl_window window;
    float *heights;
} patch;

static double height_at(const patch *p, int64_t x, int64_t y)
{
    x -= p->window.x, y -= p->window.y;
    bool inside = x >= 0 && y >= 0 && x < p->window.width && y < p->window.height;
    return inside ? (double)p->heights[y * p->window.width + x] : (double)NAN;
}

/* Where four means meet: by both differences, or by the one that is there, or level. */
static double slope_of_means(double a, double b, double c, double d)
{
    double one = b - a, other = d - c;
    if (isnan(one) || isnan(other))
        return isnan(one) ? isnan(other) ? 0 : other : one;
    return 0.5 * (one + other);
}

/* How far a square around a sample may reach, to all sides alike, without leaving the grid; 0: it is on the rim. */
static int64_t reach_of(const job *self, const grid *g, uint32_t vertex)
{
    const tl_vertex *v = &self->mesh->vertices[vertex];
    int64_t reach = self->nests || !self->steps[vertex] ? 1 : INT64_C(1) << (self->steps[vertex] - 1);
    reach = tl_int64_min(reach, tl_int64_min(v->i, g->width - 1 - v->i));
    return tl_int64_min(reach, tl_int64_min(v->j, g->height - 1 - v->j));
}

/* The mean slopes over a square: by the differences of its opposite sides, whose ends count half. NaN beside voids. */
static void slopes_over(const patch *p, int64_t x, int64_t y, int64_t reach, double slopes[2])
{
    slopes[0] = slopes[1] = 0;
    for (int64_t k = -reach; k <= reach; k++) {
        double share = k == -reach || k == reach ? 0.5 : 1;
        slopes[0] += share * (height_at(p, x + reach, y + k) - height_at(p, x - reach, y + k));
        slopes[1] += share * (height_at(p, x + k, y + reach) - height_at(p, x + k, y - reach));
    }
    for (int a = 0; a < 2; a++)
        slopes[a] /= (double)(4 * reach * reach);
}

/* Units of height by a column and by a row of the grid. */
static void slopes_at(const grid *g, const patch *p, int64_t x, int64_t y, double slopes[2])
{
    double here = height_at(p, x, y), left = height_at(p, x - 1, y), above = height_at(p, x, y - 1);
    if (g->means) {
        double corner = height_at(p, x - 1, y - 1);
        slopes[0] = slope_of_means(left, here, corner, above);
        slopes[1] = slope_of_means(above, here, corner, left);
        return;
    }
    slopes[0] = scene_slope(left, here, height_at(p, x + 1, y), 1);
    slopes[1] = scene_slope(above, here, height_at(p, x, y + 1), 1);
}

/* The samples that the vertices of a block need. */
static tl_status read_patch(const job *self, size_t block, const grid *g, int step, patch *p, tl_error *error)
{
    int64_t low[2] = {INT64_MAX, INT64_MAX}, high[2] = {0, 0};
    for (size_t k = self->first[block]; k < self->first[block + 1]; k++) {
        const tl_vertex *v = &self->mesh->vertices[self->order[k]];
        const int64_t at[2] = {v->i >> step, v->j >> step};
        int64_t reach = self->nests ? 1 : tl_int64_max(reach_of(self, g, self->order[k]), 1);
        for (int a = 0; a < 2; a++) {
            low[a] = tl_int64_min(low[a], at[a] - reach);
            high[a] = tl_int64_max(high[a], at[a] + reach);
        }
    }
    int64_t x = tl_int64_max(low[0], 0), y = tl_int64_max(low[1], 0);
    p->window = (tl_window){x, y, tl_int64_min(high[0] + 1, g->width) - x, tl_int64_min(high[1] + 1, g->height) - y};
    p->heights = tl_alloc_grid(p->window.width, p->window.height, sizeof *p->heights);
    return p->heights ? tl_source_read(g->from, g->level, p->window, p->heights, error)
                      : tl_fail_memory(error, self->ground->info.name);
}

static void add_normal(const job *self, const grid *g, const patch *p, uint32_t vertex)
{
    const tl_vertex *v = &self->mesh->vertices[vertex];
    int step = grid_of(self, vertex);
    double here = height_at(p, v->i >> step, v->j >> step), slopes[2] = {(double)NAN, (double)NAN};
    if (isnan(here) || (self->has_base && (double)v->z < here))
        return;
    for (int64_t reach = self->nests ? 1 : reach_of(self, g, vertex); reach > 1; reach /= 2) {
        slopes_over(p, v->i, v->j, reach, slopes);
        if (!isnan(slopes[0]) && !isnan(slopes[1]))
            break;
    }
    if (isnan(slopes[0]) || isnan(slopes[1]))
        slopes_at(g, p, v->i >> step, v->j >> step, slopes);
    for (int a = 0; a < 2; a++)
        slopes[a] = ldexp(slopes[a], -step);
    float normal[3];
    if (normal_at(self->directions, v, slopes, normal))
        memcpy(self->normals + vertex * self->stride, normal, sizeof normal);
}

static tl_status add_block(void *context, tl_parallel *loop, uint64_t block, unsigned worker, tl_error *error)
{
    const job *self = context;
    int step = grid_of(self, self->order[self->first[block]]);
    const grid *g = &self->grids[step];
    patch p = {.heights = NULL};
    (void)loop;
    (void)worker;
    tl_status status = read_patch(self, block, g, step, &p, error);
    for (size_t k = self->first[block]; k < self->first[block + 1] && status == TL_OK; k++)
        add_normal(self, g, &p, self->order[k]);
    free(p.heights);
    return status;
}

static bool has_base(const tl_mesh *mesh)
{
    for (size_t k = 0; k < mesh->parameter_count; k++)
        if (strcmp(mesh->parameters[k].name, "base") == 0)
            return true;
    return false;
}

tl_status gltf_ground_normals(const tl_mesh *mesh, const tl_source *ground, const gltf_directions *directions,
                              const tl_run *run, float *normals, size_t stride, tl_error *error)
{
    job self = {.mesh = mesh, .ground = ground, .directions = directions, .normals = normals, .stride = stride};
    tl_run quiet = run ? *run : (tl_run){0};
    quiet.progress = NULL;
    self.has_base = has_base(mesh);
    self.nests = scene_field_nests(ground);
    tl_status status = check_place(&self, error);
    if (status != TL_OK)
        return status;
    self.steps = tl_alloc(mesh->vertex_count, 1);
    self.order = tl_alloc(mesh->vertex_count, sizeof *self.order);
    self.spare = tl_alloc(mesh->vertex_count, sizeof *self.spare);
    bool good = self.steps && self.order && self.spare;
    if (good)
        choose_steps(&self);
    good = good && find_blocks(&self);
    status = good ? tl_parallel_for(&quiet, self.blocks, mesh->vertex_count, add_block, &self, error)
                  : tl_fail_memory(error, ground->info.name);
    free(self.steps);
    free(self.order);
    free(self.spare);
    free(self.first);
    return status;
}
