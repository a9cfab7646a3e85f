/* From marks to points, and from points to triangles. */
#include "dem/framework.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum { BAND = 64 };

static const uint32_t NO_POINT = UINT32_MAX;

/* ---- Points -------------------------------------------------------------------------------------- */

/* A cell with at most one void corner is drawn at its finest, whichever way its diagonal runs. So a marked sample is a
 * corner of a triangle that is drawn just where some cell has it and two more valid corners: either the fourth is void,
 * so that the cell is mixed and finest; or the cell is valid, and so is the leaf that covers it, for it holds valid
 * samples and is not mixed. This is decided from the eight neighbours alone, 64 samples at a time. */
typedef struct finder {
    tl_framework *framework;
    const tl_rows *dem;
    float **rows;             /* by worker: a band that was read */
    uint64_t *valid, *joined; /* bitmaps; NULL where there are no voids. Joined: in some triangle */
    size_t *counts;           /* points by row */
} finder;

/* Rows y ... end - 1, in *out. */
static tl_status read_band(const finder *self, int64_t y, int64_t end, unsigned worker, const float **out,
                           tl_error *error)
{
    const tl_source_info *info = &self->framework->info;
    if (self->dem->all) {
        *out = self->dem->all + y * info->width;
        return TL_OK;
    }
    tl_window window = {0, y, info->width, end - y};
    tl_status status = tl_source_read(self->dem->source, info->level, window, self->rows[worker], error);
    if (status == TL_OK)
        tl_heights_clean(self->rows[worker], (size_t)(window.width * window.height));
    *out = self->rows[worker];
    return status;
}

static tl_status find_valid_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    const finder *self = context;
    const tl_source_info *info = &self->framework->info;
    (void)loop;
    int64_t y = (int64_t)item * BAND, end = tl_int64_min(y + BAND, info->height);
    const float *z;
    tl_status status = read_band(self, y, end, worker, &z, error);
    if (status != TL_OK)
        return status;
    for (; y < end; y++, z += info->width) {
        uint64_t *out = self->valid + (size_t)y * self->framework->words;
        for (int64_t x = 0; x < info->width; x++)
            out[x >> 6] |= (uint64_t)!isnan(z[x]) << (x & 63);
    }
    return TL_OK;
}

/* The bits of the western (shifted up) or eastern neighbours of word w. */
static inline uint64_t west(const uint64_t *row, size_t w)
{
    return row[w] << 1 | (w ? row[w - 1] >> 63 : 0);
}

static inline uint64_t east(const uint64_t *row, size_t w, size_t words)
{
    return row[w] >> 1 | (w + 1 < words ? row[w + 1] << 63 : 0);
}

/* Of three corners of a cell, whether two are valid. */
static inline uint64_t two_of(uint64_t a, uint64_t b, uint64_t c)
{
    return (a & b) | (c & (a | b));
}

/* The valid samples of word w that have two more valid corners in some cell. */
static uint64_t spanned(const uint64_t *above, const uint64_t *here, const uint64_t *below, size_t w, size_t words)
{
    uint64_t left = west(here, w), right = east(here, w, words);
    uint64_t cells = two_of(left, west(above, w), above[w]) | two_of(above[w], east(above, w, words), right);
    cells |= two_of(right, east(below, w, words), below[w]) | two_of(below[w], west(below, w), left);
    return here[w] & cells;
}

static void mark_lattice_corners(tl_framework *framework)
{
    int64_t end = INT64_C(1) << framework->lattice_log;
    for (int i = 0; i < 4; i++) {
        int64_t x = i & 1 ? end : 0, y = i & 2 ? end : 0;
        if (x < framework->info.width && y < framework->info.height)
            tl_bit_set(framework->points, framework->words, x, y);
    }
}

/* Keeps of row y's candidates (marks and lattice corners) those that are points; the row before the first and behind
 * the last one is `none`. */
static void find_row(const finder *self, int64_t y, const uint64_t *none)
{
    tl_framework *framework = self->framework;
    size_t words = framework->words, row = (size_t)y * words;
    const uint64_t *here = self->valid ? self->valid + row : none;
    const uint64_t *above = self->valid && y > 0 ? here - words : none;
    const uint64_t *below = self->valid && y + 1 < framework->info.height ? here + words : none;
    for (size_t w = 0; w < words; w++) {
        framework->points[row + w] |= framework->split[row + w];
        if (!self->valid)
            continue;
        self->joined[row + w] = spanned(above, here, below, w, words);
        framework->points[row + w] &= self->joined[row + w];
    }
}

static tl_status find_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    finder *self = context;
    (void)loop;
    (void)worker;
    int64_t y = (int64_t)item * BAND, end = tl_int64_min(y + BAND, self->framework->info.height);
    uint64_t *none = calloc(self->framework->words, sizeof *none);
    if (!none)
        return tl_fail_memory(error, "the framework");
    for (; y < end; y++)
        find_row(self, y, none);
    free(none);
    return TL_OK;
}

static size_t count_bits(const uint64_t *words, size_t count)
{
    size_t bits = 0;
    for (size_t w = 0; w < count; w++)
        bits += (unsigned)__builtin_popcountll(words[w]);
    return bits;
}

/* Ties in what lies alone, and counts what that leaves. */
static tl_status tie_alone(finder *self, tl_error *error)
{
    tl_framework *framework = self->framework;
    size_t words = framework->words * (size_t)framework->info.height, valid = count_bits(self->valid, words);
    framework->valid_count = valid;
    if (count_bits(self->joined, words) == valid)
        return TL_OK;
    tl_status status = tl_framework_tie(framework, self->valid, self->joined, error);
    framework->isolated_count = valid - count_bits(self->joined, words);
    return status;
}

/* Ranks and heights of a band of rows; counts[y] is the number of points before row y by now. */
static tl_status collect_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    const finder *self = context;
    tl_framework *framework = self->framework;
    (void)loop;
    int64_t columns = tl_div_up(framework->info.width, TL_BLOCK);
    int64_t y = (int64_t)item * BAND, end = tl_int64_min(y + BAND, framework->info.height);
    const float *z;
    tl_status status = read_band(self, y, end, worker, &z, error);
    if (status != TL_OK)
        return status;
    for (; y < end; y++, z += framework->info.width) {
        size_t next = self->counts[y];
        for (size_t w = 0; w < framework->words; w++) {
            if (w % (TL_BLOCK / 64) == 0)
                framework->rank[(size_t)(y * columns) + w / (TL_BLOCK / 64)] = (uint32_t)next;
            for (uint64_t left = framework->points[(size_t)y * framework->words + w]; left; left &= left - 1)
                framework->heights[next++] = z[w * 64 + (unsigned)__builtin_ctzll(left)];
        }
    }
    return TL_OK;
}

/* Counts the points before each row, and checks that indices of 32 bits are enough. */
static tl_status sum_counts(finder *self, tl_error *error)
{
    tl_framework *framework = self->framework;
    size_t sum = 0;
    for (int64_t y = 0; y < framework->info.height; y++) {
        self->counts[y] = sum;
        sum += count_bits(framework->points + (size_t)y * framework->words, framework->words);
    }
    framework->point_count = sum;
    if (sum > UINT32_MAX - 1)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %zu points are more than a mesh can have; use a larger max_error",
                       framework->info.name, sum);
    return TL_OK;
}

static tl_status find_points(finder *self, const tl_run *run, tl_error *error)
{
    tl_framework *framework = self->framework;
    uint64_t bands = (uint64_t)tl_div_up(framework->info.height, BAND);
    mark_lattice_corners(framework);
    tl_status status = TL_OK;
    if (framework->voids)
        status = tl_parallel_for(run, bands, 0, find_valid_band, self, error);
    if (status == TL_OK)
        status = tl_parallel_for(run, bands, 0, find_band, self, error);
    if (status == TL_OK && framework->voids)
        status = tie_alone(self, error);
    if (status == TL_OK)
        status = sum_counts(self, error);
    if (status != TL_OK)
        return status;
    framework->rank = tl_alloc_grid(tl_div_up(framework->info.width, TL_BLOCK), framework->info.height, 4);
    framework->heights = tl_alloc(framework->point_count, sizeof *framework->heights);
    if (!framework->rank || !framework->heights)
        return tl_fail_memory(error, "the framework");
    return tl_parallel_for(run, bands, 0, collect_band, self, error);
}

static bool make_finder(finder *self, unsigned workers)
{
    const tl_framework *framework = self->framework;
    size_t words = framework->words * (size_t)framework->info.height; /* as many as the bitmaps of the framework */
    self->counts = tl_alloc((size_t)framework->info.height, sizeof *self->counts);
    self->rows = calloc(workers, sizeof *self->rows);
    for (unsigned i = 0; self->rows && !self->dem->all && i < workers; i++) {
        self->rows[i] = tl_alloc_grid(framework->info.width, BAND, sizeof **self->rows);
        if (!self->rows[i])
            return false;
    }
    if (framework->voids) {
        self->valid = calloc(words, sizeof *self->valid);
        self->joined = calloc(words, sizeof *self->joined);
    }
    return self->counts && self->rows && (!framework->voids || (self->valid && self->joined));
}

tl_status tl_framework_find_points(tl_framework *framework, const tl_rows *dem, const tl_run *run, tl_error *error)
{
    finder self = {.framework = framework, .dem = dem};
    unsigned workers = tl_parallel_workers(run, (uint64_t)tl_div_up(framework->info.height, BAND));
    framework->valid_count = (uint64_t)framework->info.width * (uint64_t)framework->info.height;
    tl_status status =
        make_finder(&self, workers) ? find_points(&self, run, error) : tl_fail_memory(error, "the framework");
    for (unsigned i = 0; self.rows && i < workers; i++)
        free(self.rows[i]);
    free(self.rows);
    free(self.valid);
    free(self.joined);
    free(self.counts);
    return status;
}

size_t tl_framework_point_count(const tl_framework *framework)
{
    return framework->point_count;
}

size_t tl_framework_isolated_count(const tl_framework *framework)
{
    return framework->isolated_count;
}

double tl_framework_max_error(const tl_framework *framework)
{
    return framework->max_error;
}

bool tl_framework_has_point(const tl_framework *framework, int64_t i, int64_t j)
{
    return tl_bit(framework->points, framework->words, i, j);
}

/* ---- Triangles ------------------------------------------------------------------------------------- */

/* Where triangles go: counted only, while `out` is NULL. */
typedef struct sink {
    uint32_t *out;
    size_t count;
} sink;

static inline void emit(sink *to, uint32_t a, uint32_t b, uint32_t apex)
{
    if (to->out) {
        uint32_t *out = to->out + 3 * to->count;
        out[0] = a, out[1] = b, out[2] = apex;
    }
    to->count++;
}

/* A block unpacked: for each vertex whether it splits, and its index or NO_POINT. */
typedef struct unpacked {
    int64_t stride;
    unsigned char *split;
    uint32_t *index;
} unpacked;

/* A finest triangle of which not all corners are points: where that is only one end of its cell's diagonal, the cell is
 * drawn with the other diagonal (once, by the triangle whose apex comes first). */
static void draw_turned(const unpacked *from, sink *to, int32_t a, int32_t b, int32_t apex)
{
    int32_t opposite = a + b - apex;
    uint32_t first = from->index[a], second = from->index[b], third = from->index[apex], fourth = from->index[opposite];
    if (apex > opposite || third == NO_POINT || fourth == NO_POINT)
        return;
    if (first != NO_POINT && second == NO_POINT)
        emit(to, first, fourth, third);
    else if (first == NO_POINT && second != NO_POINT)
        emit(to, fourth, second, third);
}

/* Descends into the triangle on the hypotenuse a-b; vertices are offsets into `from`, `depth` the splits that are left
 * down to the finest. A leaf is drawn where all its corners are points: one that lies outside, or covers voids, has a
 * corner that is none. */
static void draw_block(const unpacked *from, sink *to, int32_t a, int32_t b, int32_t apex, int depth)
{
    int32_t middle = (a + b) / 2;
    if (depth && from->split[middle]) {
        draw_block(from, to, apex, a, middle, depth - 1);
        draw_block(from, to, b, apex, middle, depth - 1);
        return;
    }
    uint32_t first = from->index[a], second = from->index[b], third = from->index[apex];
    if (first != NO_POINT && second != NO_POINT && third != NO_POINT)
        emit(to, first, second, third);
    else if (!depth)
        draw_turned(from, to, a, b, apex);
}

typedef struct corner {
    int64_t x, y;
} corner;

typedef enum lying { LIES_INSIDE, LIES_OUTSIDE, LIES_OVER } lying;

/* How a triangle of the lattice lies to the raster. Its edges run along rows, columns and diagonals, so where it shares
 * no area with the raster, one of these directions separates them. */
static lying lie_of(const tl_framework *framework, corner a, corner b, corner c)
{
    int64_t right = framework->info.width - 1, bottom = framework->info.height - 1;
    int64_t low_x = tl_int64_min(tl_int64_min(a.x, b.x), c.x), low_y = tl_int64_min(tl_int64_min(a.y, b.y), c.y);
    int64_t low_sum = tl_int64_min(tl_int64_min(a.x + a.y, b.x + b.y), c.x + c.y);
    if (low_x >= right || low_y >= bottom || low_sum >= right + bottom)
        return LIES_OUTSIDE;
    int64_t high_x = tl_int64_max(tl_int64_max(a.x, b.x), c.x), high_y = tl_int64_max(tl_int64_max(a.y, b.y), c.y);
    return high_x <= right && high_y <= bottom ? LIES_INSIDE : LIES_OVER;
}

static corner between(corner a, corner b)
{
    return (corner){(a.x + b.x) / 2, (a.y + b.y) / 2};
}

/* Marks the vertices beyond the rim that split triangles which reach over it. */
static void mark_beyond(const tl_framework *framework, unpacked *out, corner origin, corner a, corner b, corner apex,
                        int depth)
{
    if (!depth || lie_of(framework, a, b, apex) != LIES_OVER)
        return;
    corner middle = between(a, b);
    out->split[(middle.y - origin.y) * out->stride + middle.x - origin.x] = 1;
    mark_beyond(framework, out, origin, apex, a, middle, depth - 1);
    mark_beyond(framework, out, origin, b, apex, middle, depth - 1);
}

static uint32_t rank_at(const tl_framework *framework, int64_t x, int64_t y)
{
    const uint64_t *row = framework->points + (size_t)y * framework->words;
    size_t first = (size_t)(x / TL_BLOCK), columns = (size_t)tl_div_up(framework->info.width, TL_BLOCK);
    uint32_t rank = framework->rank[(size_t)y * columns + first];
    for (size_t w = first * (TL_BLOCK / 64); w < (size_t)(x >> 6); w++)
        rank += (unsigned)__builtin_popcountll(row[w]);
    return rank + (unsigned)__builtin_popcountll(row[x >> 6] & ((UINT64_C(1) << (x & 63)) - 1));
}

void tl_framework_heights(const tl_framework *framework, int64_t x, int64_t y, int64_t count, float *out)
{
    uint32_t rank = rank_at(framework, x, y);
    for (int64_t i = 0; i < count; i++) {
        bool point = tl_bit(framework->points, framework->words, x + i, y);
        out[i] = point ? framework->heights[rank] : NAN;
        rank += point;
    }
}

static void unpack(const tl_framework *framework, corner origin, unpacked *out)
{
    int64_t size = framework->block + 1;
    int64_t columns = tl_int64_min(size, framework->info.width - origin.x);
    int64_t rows = tl_int64_min(size, framework->info.height - origin.y);
    memset(out->split, 0, (size_t)(size * size));
    memset(out->index, 0xff, (size_t)(size * size) * sizeof *out->index);
    for (int64_t y = 0; y < rows; y++) {
        const uint64_t *split = framework->split + (size_t)(origin.y + y) * framework->words + (origin.x >> 6);
        const uint64_t *points = framework->points + (size_t)(origin.y + y) * framework->words + (origin.x >> 6);
        uint32_t rank = rank_at(framework, origin.x, origin.y + y);
        for (int64_t x = 0; x < columns; x++) {
            out->split[y * size + x] = split[x >> 6] >> (x & 63) & 1;
            if (points[x >> 6] >> (x & 63) & 1)
                out->index[y * size + x] = rank++;
        }
    }
}

/* The two triangles of a square of the lattice, (a, b, first) and (b, a, second): counter-clockwise as seen on a map
 * with rows going down, which both halves of a split inherit. */
typedef struct square {
    corner a, b, first, second;
} square;

static square square_at(int64_t x, int64_t y, int64_t size)
{
    corner nw = {x, y}, ne = {x + size, y}, sw = {x, y + size}, se = {x + size, y + size};
    bool rising = (x / size + y / size) & 1;
    return rising ? (square){ne, sw, se, nw} : (square){nw, se, ne, sw};
}

typedef struct drawing {
    const tl_framework *framework;
    unpacked *blocks;  /* by worker */
    size_t *counts;    /* triangles by block; then where each block's begin */
    uint32_t *indices; /* NULL: only count */
} drawing;

/* Whether the lattice has this half of a block's square as a triangle: the vertex of its right angle made it. */
static bool exists(const tl_framework *framework, corner apex)
{
    if (framework->block == INT64_C(1) << framework->lattice_log)
        return true;
    if (apex.x >= framework->info.width || apex.y >= framework->info.height)
        return true; /* it reaches over the rim, so all above it do, and are split */
    return tl_bit(framework->split, framework->words, apex.x, apex.y);
}

/* The triangles of a block that lies inside and has no voids, without drawing them: a split makes one more of each
 * triangle around its vertex, two of them in the block or, on its border, one. */
static size_t count_block(const tl_framework *framework, corner origin)
{
    square whole = square_at(origin.x, origin.y, framework->block);
    size_t count = (size_t)exists(framework, whole.first) + exists(framework, whole.second);
    int64_t side = framework->block;
    for (int64_t y = 0; y <= side; y++) {
        const uint64_t *row = framework->split + (size_t)(origin.y + y) * framework->words + (origin.x >> 6);
        size_t all = 0, first = row[0] & 1, last = row[side >> 6] & 1;
        for (int64_t w = 0; w < side >> 6; w++)
            all += (unsigned)__builtin_popcountll(row[w]);
        bool border = y == 0 || y == side;
        count += border ? all - first : 2 * (all - first) + first + last; /* the corners split nothing inside */
    }
    return count;
}

static void draw_half(const tl_framework *framework, unpacked *block, sink *to, corner origin, corner a, corner b,
                      corner apex)
{
    if (!exists(framework, apex))
        return;
    int depth = 2 * (framework->lattice_log < TL_BLOCK_LOG ? framework->lattice_log : TL_BLOCK_LOG);
    mark_beyond(framework, block, origin, a, b, apex, depth);
    corner at[3] = {a, b, apex};
    int32_t offsets[3];
    for (int i = 0; i < 3; i++)
        offsets[i] = (int32_t)((at[i].y - origin.y) * block->stride + at[i].x - origin.x);
    draw_block(block, to, offsets[0], offsets[1], offsets[2], depth);
}

static tl_status draw_item(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    drawing *self = context;
    const tl_framework *framework = self->framework;
    (void)loop;
    (void)error;
    corner origin = {(int64_t)item % framework->columns * framework->block,
                     (int64_t)item / framework->columns * framework->block};
    bool inside =
        origin.x + framework->block < framework->info.width && origin.y + framework->block < framework->info.height;
    if (!self->indices && inside && !framework->voids && framework->block == TL_BLOCK) {
        self->counts[item] = count_block(framework, origin);
        return TL_OK;
    }
    square whole = square_at(origin.x, origin.y, framework->block);
    sink to = {self->indices ? self->indices + 3 * self->counts[item] : NULL, 0};
    unpacked *block = &self->blocks[worker];
    unpack(framework, origin, block);
    draw_half(framework, block, &to, origin, whole.a, whole.b, whole.first);
    draw_half(framework, block, &to, origin, whole.b, whole.a, whole.second);
    if (!self->indices)
        self->counts[item] = to.count;
    return TL_OK;
}

/* The triangles that are larger than a block's halves: `depth` splits are left down to these. */
static void draw_top(const tl_framework *framework, sink *to, corner a, corner b, corner apex, int depth)
{
    lying where = lie_of(framework, a, b, apex);
    if (!depth || where == LIES_OUTSIDE)
        return;
    corner middle = between(a, b);
    if (where == LIES_OVER || tl_bit(framework->split, framework->words, middle.x, middle.y)) {
        draw_top(framework, to, apex, a, middle, depth - 1);
        draw_top(framework, to, b, apex, middle, depth - 1);
    } else if (tl_bit(framework->points, framework->words, a.x, a.y) &&
               tl_bit(framework->points, framework->words, b.x, b.y) &&
               tl_bit(framework->points, framework->words, apex.x, apex.y)) {
        emit(to, rank_at(framework, a.x, a.y), rank_at(framework, b.x, b.y), rank_at(framework, apex.x, apex.y));
    }
}

static size_t draw_whole_top(const tl_framework *framework, uint32_t *indices)
{
    sink to = {indices, 0};
    int depth = framework->lattice_log > TL_BLOCK_LOG ? 2 * (framework->lattice_log - TL_BLOCK_LOG) : 0;
    square whole = square_at(0, 0, INT64_C(1) << framework->lattice_log);
    draw_top(framework, &to, whole.a, whole.b, whole.first, depth);
    draw_top(framework, &to, whole.b, whole.a, whole.second, depth);
    return to.count;
}

static void draw_ties(const tl_framework *framework, uint32_t *indices)
{
    sink to = {indices, 0};
    for (size_t i = 0; i < framework->tie_count; i++) {
        const tl_tie *tie = &framework->ties[i];
        emit(&to, rank_at(framework, tie->x[0], tie->y[0]), rank_at(framework, tie->x[1], tie->y[1]),
             rank_at(framework, tie->x[2], tie->y[2]));
    }
}

static void place_vertices(const tl_framework *framework, tl_vertex *out)
{
    const uint64_t *word = framework->points;
    size_t next = 0;
    for (int64_t y = 0; y < framework->info.height; y++)
        for (size_t w = 0; w < framework->words; w++)
            for (uint64_t left = *word++; left; left &= left - 1, next++)
                out[next] = (tl_vertex){(int32_t)(w * 64 + (unsigned)__builtin_ctzll(left)), (int32_t)y,
                                        framework->heights[next]};
}

static tl_status describe(const tl_framework *framework, tl_mesh *mesh, tl_error *error)
{
    char text[TL_NUMBER_TEXT];
    tl_number_text(framework->max_error, text);
    mesh->max_error = framework->max_error;
    free(mesh->parameters); /* those of the DEM, which go into "made_by" */
    mesh->parameters = NULL;
    mesh->parameter_count = 0;
    tl_status status = tl_parameters_add_origin(&mesh->parameters, &mesh->parameter_count, &framework->info, error);
    if (status == TL_OK)
        status = tl_mesh_add_parameter(mesh, "max_error", text, error);
    return status == TL_OK ? tl_mesh_add_parameter(mesh, "mesh", "quadtree", error) : status;
}

/* Counts all triangles but the ties, and turns the blocks' counts into sums of those before. */
static tl_status count_all(drawing *self, const tl_run *run, size_t *count, tl_error *error)
{
    const tl_framework *framework = self->framework;
    size_t blocks = (size_t)(framework->columns * framework->rows), sum = draw_whole_top(framework, NULL);
    tl_status status = tl_parallel_for(run, blocks, 0, draw_item, self, error);
    for (size_t i = 0; i < blocks; i++) {
        size_t own = self->counts[i];
        self->counts[i] = sum;
        sum += own;
    }
    *count = sum;
    return status;
}

/* Whether the mesh, beside the points themselves and the bitmaps, is within the memory that is left for it. */
static tl_status mesh_fits(const tl_framework *framework, size_t triangles, tl_error *error)
{
    const tl_run run = {.memory = framework->memory};
    double bytes = (sizeof(float) + sizeof(tl_vertex)) * (double)framework->point_count +
                   3 * sizeof(uint32_t) * (double)triangles +
                   2 * sizeof(uint64_t) * (double)framework->words * (double)framework->info.height;
    return tl_run_fits(&run, bytes, framework->info.name, "its mesh, which a larger bound makes smaller,", error);
}

static tl_status draw_all(drawing *self, const tl_run *run, tl_mesh **out, tl_error *error)
{
    const tl_framework *framework = self->framework;
    size_t sum;
    tl_status status = count_all(self, run, &sum, error);
    size_t all = sum + framework->tie_count;
    if (status == TL_OK)
        status = mesh_fits(framework, all, error);
    tl_mesh *mesh = status == TL_OK ? tl_mesh_create(framework->point_count, all, &framework->info, error) : NULL;
    if (!mesh)
        return status == TL_OK ? TL_ERROR_MEMORY : status;
    place_vertices(framework, mesh->vertices);
    draw_whole_top(framework, mesh->indices);
    draw_ties(framework, mesh->indices + 3 * sum);
    self->indices = mesh->indices;
    status = tl_parallel_for(run, (uint64_t)(framework->columns * framework->rows), 0, draw_item, self, error);
    if (status == TL_OK)
        status = describe(framework, mesh, error);
    if (status == TL_OK)
        *out = mesh;
    else
        tl_mesh_destroy(mesh);
    return status;
}

static bool make_blocks(drawing *self, unsigned workers)
{
    size_t side = (size_t)self->framework->block + 1;
    self->blocks = calloc(workers, sizeof *self->blocks);
    for (unsigned i = 0; self->blocks && i < workers; i++) {
        unpacked *each = &self->blocks[i];
        *each = (unpacked){(int64_t)side, malloc(side * side), tl_alloc(side * side, sizeof *each->index)};
        if (!each->split || !each->index)
            return false;
    }
    return self->blocks;
}

/* Draws the mesh, or only counts its triangles where out is NULL. */
static tl_status draw_or_count(const tl_framework *framework, tl_mesh **out, size_t *count, tl_error *error)
{
    drawing self = {.framework = framework};
    tl_run run = {.threads = framework->threads};
    size_t blocks = (size_t)(framework->columns * framework->rows);
    unsigned workers = tl_parallel_workers(&run, blocks);
    self.counts = tl_alloc(blocks, sizeof *self.counts);
    tl_status status = TL_OK;
    if (!self.counts || !make_blocks(&self, workers))
        status = tl_fail_memory(error, "the mesh");
    else
        status = out ? draw_all(&self, &run, out, error) : count_all(&self, &run, count, error);
    for (unsigned i = 0; self.blocks && i < workers; i++) {
        free(self.blocks[i].split);
        free(self.blocks[i].index);
    }
    free(self.blocks);
    free(self.counts);
    return status;
}

tl_status tl_framework_mesh(const tl_framework *framework, tl_mesh **out, tl_error *error)
{
    return draw_or_count(framework, out, NULL, error);
}

tl_status tl_framework_count_triangles(const tl_framework *framework, size_t *count, tl_error *error)
{
    tl_status status = draw_or_count(framework, NULL, count, error);
    *count += framework->tie_count;
    return status;
}
