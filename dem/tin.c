#include "dem/tin.h"

#include "dem/bend.h"
#include "dem/framework.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <float.h>
#include <math.h>
#include <string.h>

/* What the start of an irregular mesh keeps of its bound. Collapsing from 0.5, 0.6 or 0.7 of it ends in numbers of
 * triangles within 1 % of each other; from there to the whole, which leaves little to choose, they rise by up to 6 %.
 */
static const double START = 0.6;

enum {
    READ_ROWS = 256,
    WINDOW = 512, /* samples between the lines that triangles of the start do not cross, but for larger ones */
    STRIP = 256,  /* width of the windows over these lines */
    PHASES = 4
};

typedef struct builder {
    const tl_source *dem;
    const tl_simplify_options *options;
    float *heights;
    int64_t width, height;
    bool voids, rim_voids;
    double magnitude; /* largest |height| */
    double top;       /* the highest sample or 0, metres */
    bool exact;       /* double arithmetic does not round on these heights */
    tl_tin_soup soup;
    tl_tin_mark *settled;
    double share; /* of the bound, that the start keeps */
    /* Of the start's triangles, by class of their edges: the largest rise, and the largest product of it and the rise
     * along the edge. */
    double rise[TL_TIN_CLASSES], product[TL_TIN_CLASSES];
    bool bends, shaped; /* whether the frame is bent; and whether triangles are judged by class, for that or for the
                           rounding of the file's numbers */
    tl_rounding rounding;
    dem_space *space;
    dem_bend bend, rim_bend[4]; /* of the whole raster, and of the sides of its rim; none in flat frames */
} builder;

/* ---- Reading ------------------------------------------------------------------------------------- */

static tl_status read_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    builder *self = context;
    (void)loop;
    (void)worker;
    int64_t y = (int64_t)item * READ_ROWS;
    tl_window window = {0, y, self->width, tl_int64_min(READ_ROWS, self->height - y)};
    float *to = self->heights + y * self->width;
    tl_status status = tl_source_read(self->dem, self->dem->info.level, window, to, error);
    for (int64_t k = 0; status == TL_OK && k < window.width * window.height; k++)
        if (isinf(to[k])) /* no surface passes it */
            to[k] = NAN;
    return status;
}

/* Weights of a triangle in a window are below 2^21, so multiples of 2^-10 below 2^21 are interpolated exactly. */
static void inspect(builder *self)
{
    float low = 0, high = 0;
    int64_t finer = 0, voids = 0;
    for (int64_t k = 0; k < self->width * self->height; k++) {
        float z = self->heights[k];
        low = z < low ? z : low;
        high = z > high ? z : high;
        voids += isnan(z);
        finer += fabs((double)z * 1024 + 0x1.8p52 - 0x1.8p52 - (double)z * 1024) > 0;
    }
    self->magnitude = (double)fmaxf(-low, high);
    self->top = (double)high * self->dem->info.georef.height_unit;
    self->rounding = self->options->rounding;
    self->rounding.upright += self->rounding.of_range * ((double)high - (double)low);
    self->exact = !finer && self->magnitude < 0x1p21;
    self->voids = voids;
    for (int64_t x = 0; x < self->width; x++)
        self->rim_voids |= isnan(self->heights[x]) || isnan(self->heights[(self->height - 1) * self->width + x]);
    for (int64_t y = 0; y < self->height; y++)
        self->rim_voids |= isnan(self->heights[y * self->width]) || isnan(self->heights[(y + 1) * self->width - 1]);
}

/* Whether the heights and so many bytes beside them are within what the run may take. */
static tl_status run_fits(const builder *self, double bytes, tl_error *error)
{
    double heights = (double)sizeof(float) * (double)self->width * (double)self->height;
    return tl_run_fits(self->options->run, heights + bytes, self->dem->info.name, "simplifying it", error);
}

static tl_status read_dem(builder *self, tl_error *error)
{
    const tl_run *run = self->options->run;
    tl_status fits = run_fits(self, 0, error);
    if (fits != TL_OK)
        return fits;
    self->heights = tl_alloc_grid(self->width, self->height, sizeof *self->heights);
    if (!self->heights)
        return tl_fail(error, TL_ERROR_MEMORY, "%s: not enough memory for its %lld x %lld samples",
                       self->dem->info.name, (long long)self->width, (long long)self->height);
    tl_run quiet = run ? *run : (tl_run){0};
    quiet.progress = NULL;
    tl_status status = tl_parallel_for(&quiet, (uint64_t)tl_div_up(self->height, READ_ROWS), 0, read_band, self, error);
    if (status == TL_OK)
        inspect(self);
    return status;
}

/* ---- The inner raster ------------------------------------------------------------------------------ */

/* All samples but the outermost, from memory. */
typedef struct inner {
    tl_source source;
    const float *heights;
    int64_t stride;
} inner;

static tl_status read_inner(const tl_source *source, int level, tl_window window, float *out, tl_error *error)
{
    const inner *self = (const inner *)source;
    (void)level;
    (void)error;
    for (int64_t y = 0; y < window.height; y++)
        memcpy(out + y * window.width, self->heights + (window.y + y + 1) * self->stride + window.x + 1,
               (size_t)window.width * sizeof *out);
    return TL_OK;
}

static inner make_inner(const builder *self)
{
    inner made = {.source = {.info = self->dem->info, .read = read_inner}, .heights = self->heights};
    made.stride = self->width;
    made.source.info.width -= 2;
    made.source.info.height -= 2;
    made.source.info.has_voids = self->voids;
    double *t = made.source.info.georef.transform;
    t[0] += t[1] + t[2];
    t[3] += t[4] + t[5];
    return made;
}

/* Takes over a mesh of the inner raster, whose triangles run the other way round. */
static void take_mesh(builder *self, tl_mesh *mesh)
{
    tl_tin_soup *soup = &self->soup;
    soup->vertices = mesh->vertices;
    soup->vertex_count = soup->vertex_room = mesh->vertex_count;
    soup->triangles = mesh->indices;
    soup->triangle_count = soup->triangle_room = mesh->triangle_count;
    mesh->vertices = NULL;
    mesh->indices = NULL;
    for (size_t k = 0; k < soup->vertex_count; k++) {
        soup->vertices[k].i++;
        soup->vertices[k].j++;
    }
    for (size_t t = 0; t < soup->triangle_count; t++) {
        uint32_t *corner = soup->triangles + 3 * t, swap = corner[1];
        corner[1] = corner[2];
        corner[2] = swap;
    }
}

/* The framework inside of the rim. */
static tl_status start_inside(builder *self, tl_error *error)
{
    if (self->width < 3 || self->height < 3)
        return TL_OK;
    inner source = make_inner(self);
    tl_run quiet = self->options->run ? *self->options->run : (tl_run){0};
    quiet.progress = NULL;
    tl_framework_options options = {.max_error = self->options->max_error * self->share,
                                    .frame = self->options->frame,
                                    .rounding = self->options->rounding,
                                    .run = &quiet};
    tl_framework *framework = tl_framework_build(&source.source, &options, error);
    tl_mesh *mesh = NULL;
    tl_status status = framework ? TL_OK : error->status;
    if (framework) /* less than two triangles a vertex */
        status = run_fits(self, (sizeof(tl_vertex) + 24.0) * (double)tl_framework_point_count(framework), error);
    if (status == TL_OK)
        status = tl_framework_mesh(framework, &mesh, error);
    tl_framework_destroy(framework);
    if (mesh)
        take_mesh(self, mesh);
    tl_mesh_destroy(mesh);
    return status;
}

/* ---- Bent frames ----------------------------------------------------------------------------------- */

/* Edges of the rim are chosen for ground that rises by no more than this beside them. */
static const double USUAL_SLOPE = 4;

static double rim_sag(const void *context, int side, double length, double rise)
{
    const builder *self = context;
    const dem_bend *bend = &self->rim_bend[side];
    double unit = self->dem->info.georef.height_unit;
    double metres = fmax(rise * unit, USUAL_SLOPE * bend->cell), bound = self->options->max_error;
    double sag = dem_bend_error(bend, length * length, metres) / unit;
    double rounded = tl_rounds(&self->rounding) ? tl_rounding_error(&self->rounding, metres / unit) : 0;
    /* two tiles round differently, but both leave this much */
    return sag + (rounded > 0 ? fmax(rounded, bound / 64) : 0);
}

/* Rounded up to a 64th of itself: two tiles that share a side agree, though each looks from its own middle. */
static double coarser(double a)
{
    int exponent;
    double part = frexp(a, &exponent);
    return isfinite(a) ? ldexp(ceil(part * 64) / 64, exponent) : a;
}

/* How each side of the rim is bent, which depends on its own samples alone. */
static void look_at_rim(builder *self)
{
    double right = (double)(self->width - 1), bottom = (double)(self->height - 1);
    const double boxes[4][4] = {{0, 0, right, 0}, {0, bottom, right, 0}, {0, 0, 0, bottom}, {right, 0, 0, bottom}};
    for (int side = 0; side < 4; side++) {
        const double *box = boxes[side];
        float top = 0;
        for (int64_t k = 0; k <= (int64_t)fmax(box[2], box[3]); k++) {
            int64_t x = (int64_t)box[0] + (box[2] > 0 ? k : 0), y = (int64_t)box[1] + (box[3] > 0 ? k : 0);
            float z = self->heights[y * self->width + x];
            top = z > top ? z : top; /* false for a void */
        }
        double metres = (double)top * self->dem->info.georef.height_unit;
        dem_bend bend = dem_space_bend(self->space, box[0], box[1], box[2], box[3], metres);
        self->rim_bend[side] = (dem_bend){coarser(bend.upright), coarser(bend.level), coarser(bend.cell) * (63.0 / 65)};
    }
}

/* The rise of a triangle, and along its edges. */
static void find_rise(const tl_vertex *const v[3], double *whole, double along[3], int64_t length2[3])
{
    double x[3], y[3], z[3];
    for (int k = 0; k < 3; k++) {
        const tl_vertex *a = v[k], *b = v[(k + 1) % 3];
        x[k] = (double)b->i - a->i, y[k] = (double)b->j - a->j, z[k] = (double)b->z - (double)a->z;
        length2[k] = ((int64_t)b->i - a->i) * ((int64_t)b->i - a->i) + ((int64_t)b->j - a->j) * ((int64_t)b->j - a->j);
        along[k] = fabs(z[k]) / sqrt((double)length2[k]);
    }
    *whole = hypot(z[0] * y[1] - z[1] * y[0], z[1] * x[0] - z[0] * x[1]) / fabs(x[0] * y[1] - y[0] * x[1]);
}

static void find_rises(builder *self)
{
    memset(self->rise, 0, sizeof self->rise);
    memset(self->product, 0, sizeof self->product);
    for (size_t t = 0; t < self->soup.triangle_count; t++) {
        const tl_vertex *v[3];
        double rise, along[3];
        int64_t length2[3];
        for (int k = 0; k < 3; k++)
            v[k] = &self->soup.vertices[self->soup.triangles[3 * t + (size_t)k]];
        find_rise(v, &rise, along, length2);
        for (int k = 0; k < 3; k++) {
            int class = tl_tin_class(length2[k]);
            self->rise[class] = fmax(self->rise[class], rise);
            self->product[class] = fmax(self->product[class], rise * along[k]);
        }
    }
}

/* Bound, in metres, of what a sample's error may differ by that an edge of a class leaves on the other side, where one
 * of the start's triangles is: the edge is bent sideways by at most that much, and the triangle rises over it. */
static double across_edge(const builder *self, const dem_bend *bend, int class)
{
    double unit = self->dem->info.georef.height_unit;
    double slope = self->rise[class] > 0 ? self->rise[class] * unit / bend->cell : 0;
    double product = self->product[class] > 0 ? self->product[class] * unit / bend->cell * unit / bend->cell : 0;
    double rounded = unit * tl_rounding_error(&self->rounding, self->rise[class]);
    return ldexp(1, class + 1) / 8 * (slope * bend->level + 2 * product * bend->upright) + rounded;
}

/* Bound of what the bend adds to the error of a triangle: the sag, and the shift of a sample over the slope of its own
 * triangle and over that of a neighbour. Their common edge is no longer than either, so a neighbour counts with its own
 * class if that is smaller. And what rounding adds. */
static double bent_by(const builder *self, const dem_bend *bend, double squared, double rise)
{
    double unit = self->dem->info.georef.height_unit, sag = dem_bend_error(bend, squared, 0);
    return 2 * dem_bend_error(bend, squared, rise) - sag + unit * tl_rounding_error(&self->rounding, rise / unit);
}

/* The largest rise that adds no more than `share`, to a part in 10^6; 0 where there is none. */
static double allowed_rise(const builder *self, const dem_bend *bend, double squared, double share)
{
    double low = 0, high = bend->cell; /* a slope of 1 */
    while (high < 1e6 * bend->cell && bent_by(self, bend, squared, high) <= share)
        low = high, high *= 2;
    for (int k = 0; k < 20; k++) {
        double middle = 0.5 * (low + high);
        if (bent_by(self, bend, squared, middle) <= share)
            low = middle;
        else
            high = middle;
    }
    return low;
}

/* The share of the bound that the start leaves: what it keeps itself counts twice where it was cut. */
static double left_over(const builder *self)
{
    return 1 - (self->rim_voids ? 2 : 1) * self->share;
}

/* What errors and rises may reach by class in a window that is bent like this. New triangles may rise as much as costs
 * no more than a 64th of the bound, or as three times their sag on level ground: steeper slivers are refused.
 * Triangles of the start may lie beside them, so they must not add more than is left there either. */
static void fill_limits(const builder *self, const dem_bend *bend, tl_tin_ground *ground)
{
    double unit = self->dem->info.georef.height_unit, old = 0, new = 0, bound = self->options->max_error *unit;
    for (int k = 0; k < TL_TIN_CLASSES; k++) {
        double squared = ldexp(1, k + 1), share = fmax(bound / 64, 3 * bent_by(self, bend, squared, 0));
        double rise = allowed_rise(self, bend, squared, share);
        old = fmax(old, across_edge(self, bend, k));
        new = fmax(new, bent_by(self, bend, squared, rise));
        ground->limit[k] = new <= bound *left_over(self) ? (bound - new - old) / unit : -1;
        ground->rise[k] = rise / unit;
    }
}

/* ---- Windows --------------------------------------------------------------------------------------- */

/* Windows repeat every WINDOW samples from (1 + x, 1 + y); the first and the last hold the rim too. The first phase has
 * them side by side; the others lie over the lines between those, over vertical ones, over horizontal ones, and over
 * the ends of these. */
typedef struct phase {
    int64_t x, y, width, height;
} phase;

static const phase phases[PHASES] = {
    {0, 0, WINDOW, WINDOW},
    {WINDOW - STRIP / 2, 0, STRIP, WINDOW},
    {-WINDOW / 2, WINDOW - STRIP / 2, WINDOW, STRIP},
    {WINDOW / 2 - STRIP / 2, WINDOW - STRIP / 2, STRIP, STRIP},
};

typedef struct step {
    builder *self;
    const phase *shape;
    int64_t columns, rows;  /* of windows */
    uint32_t *triangles;    /* by window; those in none come last */
    size_t *first, *counts; /* of each window */
    tl_tin_patch **patches; /* by worker */
    dem_space **spaces;     /* likewise */
    tl_tin_ground ground;
} step;

/* Windows along `length` samples: one more than fit, as they may begin before the first. */
static int64_t window_count(int64_t length)
{
    return length / WINDOW + 2;
}

/* The samples that window k takes along one direction: from *from up to and with *to; false where there are none. */
static bool window_reach(int64_t length, int64_t offset, int64_t size, int64_t k, int64_t *from, int64_t *to)
{
    *from = 1 + k * WINDOW + offset;
    *to = *from + size;
    int64_t middle = *from + STRIP / 2;
    bool beyond = *from >= length - 1 || (*from >= length - 2 && *from > 1) || *to <= 1;
    if (beyond || (size == STRIP && (middle <= 1 || middle >= length - 2))) /* no line is there */
        return false;
    *from = *from <= 1 ? 0 : *from;
    *to = *to >= length - 2 ? length - 1 : *to;
    return true;
}

/* The window along one direction that holds low ... high, or -1. */
static int64_t window_of(int64_t length, int64_t offset, int64_t size, int64_t low, int64_t high)
{
    int64_t inside = tl_int64_min(tl_int64_max(low, 1), tl_int64_max(length - 2, 1)) - 1 - offset;
    int64_t guess = inside >= 0 ? inside / WINDOW : -1, from, to;
    for (int64_t k = guess; k >= guess - 1 && k >= -1; k--)
        if (k + 1 < window_count(length) && window_reach(length, offset, size, k, &from, &to) && from <= low &&
            high <= to)
            return k + 1;
    return -1;
}

static int64_t least(int64_t a, int64_t b, int64_t c)
{
    return tl_int64_min(a, tl_int64_min(b, c));
}

static int64_t most(int64_t a, int64_t b, int64_t c)
{
    return tl_int64_max(a, tl_int64_max(b, c));
}

static size_t window_of_triangle(const step *r, const uint32_t *corner)
{
    const tl_vertex *v = r->self->soup.vertices, *a = v + corner[0], *b = v + corner[1], *c = v + corner[2];
    const phase *shape = r->shape;
    int64_t column = window_of(r->self->width, shape->x, shape->width, least(a->i, b->i, c->i), most(a->i, b->i, c->i));
    int64_t row = column < 0 ? -1
                             : window_of(r->self->height, shape->y, shape->height, least(a->j, b->j, c->j),
                                         most(a->j, b->j, c->j));
    return (size_t)(row < 0 ? r->columns * r->rows : row * r->columns + column);
}

/* Sorts the triangles by window. */
static void distribute(step *r)
{
    const tl_tin_soup *soup = &r->self->soup;
    size_t windows = (size_t)(r->columns * r->rows), sum = 0;
    memset(r->counts, 0, (windows + 1) * sizeof *r->counts);
    for (size_t t = 0; t < soup->triangle_count; t++)
        r->counts[window_of_triangle(r, soup->triangles + 3 * t)]++;
    for (size_t k = 0; k <= windows; k++) {
        r->first[k] = sum;
        sum += r->counts[k];
        r->counts[k] = 0;
    }
    for (size_t t = 0; t < soup->triangle_count; t++) {
        const uint32_t *from = soup->triangles + 3 * t;
        size_t k = window_of_triangle(r, from);
        memcpy(r->triangles + 3 * (r->first[k] + r->counts[k]++), from, 3 * sizeof *from);
    }
}

/* Puts what the windows left back, in their order. */
static void gather_up(step *r)
{
    tl_tin_soup *soup = &r->self->soup;
    soup->triangle_count = 0;
    for (size_t k = 0; k <= (size_t)(r->columns * r->rows); k++) {
        memcpy(soup->triangles + 3 * soup->triangle_count, r->triangles + 3 * r->first[k],
               3 * r->counts[k] * sizeof *soup->triangles);
        soup->triangle_count += r->counts[k];
    }
}

static tl_status run_window(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    step *r = context;
    builder *self = r->self;
    (void)loop;
    int64_t x, y, right, bottom;
    if (!r->counts[item] ||
        !window_reach(self->width, r->shape->x, r->shape->width, (int64_t)item % r->columns - 1, &x, &right) ||
        !window_reach(self->height, r->shape->y, r->shape->height, (int64_t)item / r->columns - 1, &y, &bottom))
        return TL_OK;
    tl_window window = {x, y, right - x + 1, bottom - y + 1};
    tl_tin_ground ground = r->ground;
    if (ground.shaped) {
        dem_bend bend = self->bend;
        if (self->bends)
            bend = dem_space_bend(r->spaces[worker], (double)x, (double)y, (double)(right - x), (double)(bottom - y),
                                  self->top);
        fill_limits(self, &bend, &ground);
    }
    return tl_tin_patch_run(r->patches[worker], &ground, self->soup.vertices, self->settled, window,
                            r->triangles + 3 * r->first[item], &r->counts[item], error);
}

static tl_status run_phase(step *r, const tl_run *run, tl_error *error)
{
    builder *self = r->self;
    distribute(r);
    uint64_t samples = r->shape == phases ? (uint64_t)(self->width * self->height) : 0;
    tl_run own = run ? *run : (tl_run){0};
    own.progress = samples ? own.progress : NULL;
    tl_status status = tl_parallel_for(&own, (uint64_t)(r->columns * r->rows), samples, run_window, r, error);
    if (status == TL_OK)
        gather_up(r);
    return status;
}

static tl_status make_workers(step *r, unsigned workers, tl_error *error)
{
    const tl_source_info *info = &r->self->dem->info;
    r->patches = calloc(workers, sizeof(tl_tin_patch *));
    r->spaces = calloc(workers, sizeof(dem_space *));
    for (unsigned k = 0; r->patches && r->spaces && k < workers; k++) {
        r->patches[k] = tl_tin_patch_create(WINDOW + 4);
        if (!r->patches[k])
            return tl_fail_memory(error, "the mesh");
        r->spaces[k] =
            r->self->bends ? dem_space_create(&info->georef, info->width, info->height, info->name, error) : NULL;
        if (r->self->bends && !r->spaces[k])
            return error->status;
    }
    return r->patches && r->spaces ? TL_OK : tl_fail_memory(error, "the mesh");
}

static void free_workers(step *r, unsigned workers)
{
    for (unsigned k = 0; k < workers; k++) {
        if (r->patches)
            tl_tin_patch_destroy(r->patches[k]);
        if (r->spaces)
            dem_space_destroy(r->spaces[k]);
    }
    free(r->patches);
    free(r->spaces);
}

/* The mesh twice over, a mark for each vertex, and what the workers need for a window: 16 bytes a sample and some 190 a
 * vertex. */
static tl_status collapse_fits(const builder *self, unsigned workers, tl_error *error)
{
    const double side = (WINDOW + 4.0) * (WINDOW + 4.0), vertices = (double)self->soup.vertex_count;
    double patches = workers * (16 * side + 190 * fmin(vertices, side));
    return run_fits(self, 24.0 * (double)self->soup.triangle_count + 13 * vertices + patches, error);
}

static tl_status collapse_all(builder *self, tl_error *error)
{
    const tl_run *run = self->options->run;
    step r = {.self = self, .columns = window_count(self->width), .rows = window_count(self->height)};
    size_t windows = (size_t)(r.columns * r.rows) + 1;
    r.ground = (tl_tin_ground){.heights = self->heights,
                               .width = self->width,
                               .height = self->height,
                               .max_error = self->options->max_error,
                               .rounding = self->exact ? 0 : tl_plane_rounding(self->magnitude),
                               .shaped = self->shaped};
    unsigned workers = tl_parallel_workers(run, windows - 1);
    tl_status status = collapse_fits(self, workers, error);
    if (status != TL_OK)
        return status;
    r.triangles = tl_alloc(self->soup.triangle_count, 3 * sizeof *r.triangles);
    r.first = tl_alloc(windows, sizeof *r.first);
    r.counts = tl_alloc(windows, sizeof *r.counts);
    self->settled = calloc(self->soup.vertex_count + 1, sizeof *self->settled);
    bool made = r.triangles && r.first && r.counts && self->settled;
    status = made ? make_workers(&r, workers, error) : tl_fail_memory(error, "the mesh");
    for (int k = 0; k < PHASES && status == TL_OK; k++) {
        r.shape = &phases[k];
        status = run_phase(&r, run, error);
    }
    free_workers(&r, workers);
    free(r.triangles);
    free(r.first);
    free(r.counts);
    return status;
}

/* ---- The mesh -------------------------------------------------------------------------------------- */

static tl_status describe(const builder *self, tl_mesh *mesh, tl_error *error)
{
    char text[TL_NUMBER_TEXT];
    tl_number_text(self->options->max_error, text);
    mesh->max_error = self->options->max_error;
    free(mesh->parameters); /* those of the DEM, which go into "made_by" */
    mesh->parameters = NULL;
    mesh->parameter_count = 0;
    tl_status status = tl_parameters_add_origin(&mesh->parameters, &mesh->parameter_count, &self->dem->info, error);
    if (status == TL_OK)
        status = tl_mesh_add_parameter(mesh, "max_error", text, error);
    const char *kind = self->options->kind == TL_MESH_TIN ? "tin" : "quadtree";
    if (status == TL_OK)
        status = tl_mesh_add_parameter(mesh, "mesh", kind, error);
    return status == TL_OK ? tl_mesh_add_parameter(mesh, "borders", "canonical", error) : status;
}

/* Numbers the vertices that triangles still have; `number` has room for all. Returns how many there are. */
static size_t renumber(const tl_tin_soup *soup, uint32_t *number)
{
    size_t next = 0;
    memset(number, 0, soup->vertex_count * sizeof *number);
    for (size_t k = 0; k < 3 * soup->triangle_count; k++)
        number[soup->triangles[k]] = 1;
    for (size_t k = 0; k < soup->vertex_count; k++)
        number[k] = number[k] ? (uint32_t)next++ : UINT32_MAX;
    return next;
}

static tl_status make_mesh(const builder *self, tl_mesh **out, tl_error *error)
{
    const tl_tin_soup *soup = &self->soup;
    uint32_t *number = tl_alloc(soup->vertex_count, sizeof *number);
    if (!number)
        return tl_fail_memory(error, "the mesh");
    tl_mesh *mesh = tl_mesh_create(renumber(soup, number), soup->triangle_count, &self->dem->info, error);
    for (size_t k = 0; mesh && k < soup->vertex_count; k++)
        if (number[k] != UINT32_MAX)
            mesh->vertices[number[k]] = soup->vertices[k];
    for (size_t t = 0; mesh && t < soup->triangle_count; t++) {
        const uint32_t *from = soup->triangles + 3 * t;
        uint32_t *to = mesh->indices + 3 * t;
        to[0] = number[from[0]], to[1] = number[from[2]], to[2] = number[from[1]];
    }
    free(number);
    tl_status status = mesh ? describe(self, mesh, error) : TL_ERROR_MEMORY;
    if (status == TL_OK)
        *out = mesh;
    else
        tl_mesh_destroy(mesh);
    return status;
}

/* ---- The whole ------------------------------------------------------------------------------------- */

static tl_status look_at_frame(builder *self, tl_error *error)
{
    const tl_source_info *info = &self->dem->info;
    double cell = fmin(info->georef.cell_x, info->georef.cell_y);
    self->bend = (dem_bend){0, 0, cell > 0 ? cell : 1};
    for (int side = 0; side < 4; side++)
        self->rim_bend[side] = self->bend;
    if (!self->bends)
        return TL_OK;
    self->space = dem_space_create(&info->georef, self->width, self->height, info->name, error);
    if (!self->space)
        return error->status;
    self->bend = dem_space_bend(self->space, 0, 0, (double)(self->width - 1), (double)(self->height - 1), self->top);
    look_at_rim(self);
    return TL_OK;
}

/* Whether the triangles of the rim, which may be steep, add no more to the error of what lies beside them than is left.
 */
static bool start_holds(builder *self)
{
    double worst = 0, bound = self->options->max_error * self->dem->info.georef.height_unit;
    find_rises(self);
    for (int k = 0; k < TL_TIN_CLASSES; k++)
        worst = fmax(worst, across_edge(self, &self->bend, k));
    return worst <= bound * left_over(self);
}

static void free_soup(tl_tin_soup *soup)
{
    free(soup->vertices);
    free(soup->triangles);
    *soup = (tl_tin_soup){0};
}

/* The mesh of the inner raster and the rim around it. What is cut beside voids moves by as much again. In a bent frame
 * the start is made finer until it leaves enough to that. */
static tl_status start(builder *self, tl_error *error)
{
    tl_tin_rim rim = {
        self->heights, self->width, self->height, self->options->max_error, WINDOW, self->shaped ? rim_sag : NULL,
        self};
    self->share = self->rim_voids ? 0.5 : self->options->kind == TL_MESH_TIN ? START : 1;
    self->share *= self->shaped ? 15.0 / 16 : 1;
    tl_status status;
    for (int tries = 0;; tries++, self->share /= 2) {
        status = start_inside(self, error);
        if (status == TL_OK)
            status = tl_tin_add_rim(&rim, &self->soup, error);
        if (status != TL_OK || !self->shaped || start_holds(self) || tries == 8)
            return status;
        free_soup(&self->soup);
    }
}

static tl_status build(builder *self, tl_error *error)
{
    tl_status status = read_dem(self, error);
    self->bends = dem_frame_bends(&self->dem->info.georef, self->options->frame);
    self->shaped = self->bends || tl_rounds(&self->rounding);
    if (status == TL_OK && self->shaped)
        status = look_at_frame(self, error);
    if (status == TL_OK)
        status = start(self, error);
    if (status == TL_OK && self->options->kind == TL_MESH_TIN && self->soup.triangle_count)
        status = collapse_all(self, error);
    return status;
}

/* The framework's own mesh, with what it knows of lone samples. */
static tl_status simplify_plainly(const tl_source *dem, const tl_simplify_options *options, tl_mesh **out,
                                  uint64_t *uncovered, tl_error *error)
{
    tl_framework_options plain = {
        .max_error = options->max_error, .frame = options->frame, .rounding = options->rounding, .run = options->run};
    tl_framework *framework = tl_framework_build(dem, &plain, error);
    tl_status status = framework ? tl_framework_mesh(framework, out, error) : error->status;
    if (status == TL_OK && uncovered)
        *uncovered = tl_framework_isolated_count(framework);
    tl_framework_destroy(framework);
    return status;
}

static tl_status check(const tl_source_info *info, double max_error, tl_error *error)
{
    if (!(max_error >= 0 && max_error <= DBL_MAX))
        return tl_fail(error, TL_ERROR_ARGUMENT, "max_error %g: must be a finite number, 0 or larger", max_error);
    if (info->width > INT32_MAX || info->height > INT32_MAX || info->width > INT32_MAX / info->height)
        return tl_fail(error, TL_ERROR_DATA, "%s: %lld x %lld samples, more than 2^31 - 1 for one such mesh; %s",
                       info->name, (long long)info->width, (long long)info->height,
                       "cut it in parts that share their outermost samples, which join without a crack");
    return TL_OK;
}

/* Only where there are voids can a sample be left out. */
static tl_status count_uncovered(const builder *self, const tl_mesh *mesh, uint64_t *uncovered, tl_error *error)
{
    tl_mesh_report report = {0};
    tl_run quiet = self->options->run ? *self->options->run : (tl_run){0};
    quiet.progress = NULL;
    tl_status status = self->voids ? tl_mesh_verify(mesh, self->dem, &quiet, &report, error) : TL_OK;
    if (status == TL_OK)
        *uncovered = report.uncovered;
    return status;
}

tl_status tl_simplify(const tl_source *dem, const tl_simplify_options *options, tl_mesh **out, uint64_t *uncovered,
                      tl_error *error)
{
    tl_error own = {0};
    error = error ? error : &own; /* it tells why a framework is none */
    bool cells = dem->info.width > 1 && dem->info.height > 1;
    if (!cells || (options->kind == TL_MESH_QUADTREE && !options->canonical_borders))
        return simplify_plainly(dem, options, out, uncovered, error);
    tl_status status = check(&dem->info, options->max_error, error);
    if (status != TL_OK)
        return status;
    builder self = {.dem = dem, .options = options, .width = dem->info.width, .height = dem->info.height};
    tl_mesh *mesh = NULL;
    status = build(&self, error);
    if (status == TL_OK)
        status = make_mesh(&self, &mesh, error);
    if (status == TL_OK && uncovered)
        status = count_uncovered(&self, mesh, uncovered, error);
    if (status == TL_OK)
        *out = mesh;
    else
        tl_mesh_destroy(mesh);
    dem_space_destroy(self.space);
    free_soup(&self.soup);
    free(self.settled);
    free(self.heights);
    return status;
}
