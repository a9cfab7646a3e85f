/* The error pyramid: for every sample the largest threshold at which it is still needed, in two passes over blocks of
 * the DEM, which is never held as a whole.
 *
 * The first pass looks at heights: their range, which the codes' scale comes from, the corners of blocks, and what bent
 * frames ask for. The second finds the errors of each block's triangles, and compares the block with all larger
 * triangles over it: these are planes through corners of blocks, and a block, or its half below or above its diagonal,
 * lies in a single one of each size. What is left, borders between blocks and what lies above them, is small. */
#include "dem/framework_pyramid.h"

#include "dem/bend.h"
#include "dem/framework_kernel.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <stdatomic.h>

enum { FRAME = TL_BLOCK + 3, LAST = TL_BLOCK };

/* Bytes a sample of the bitmaps of the pyramid's shape and of one framework. */
static const double BITMAPS = 0.5;
/* What tl_pyramid.overview and tl_pyramid.squares take of a sample. */
static const double OVERVIEW = 4. / 64 + 12. / 256;

/* What the first pass finds of a block. */
typedef struct block_facts {
    float magnitude, low, high; /* the latter two where it is not void */
    bool voids, all_void, rounds;
    uint64_t hash;
    dem_bend bend;
} block_facts;

/* Working memory of one worker. */
typedef struct scratch {
    float *read, *heights, *errors, *centres, *across, *down, *parts;
    double *rows;
    dem_space *space;       /* where the frame bends */
    double rises[TL_SIZES]; /* of triangles within blocks, units of height in a cell */
} scratch;

typedef struct builder {
    tl_pyramid *pyramid;
    const tl_framework *shape; /* of the pyramid */
    const tl_source *dem;
    const tl_error_kernel *kernel;
    int64_t width, height, side;
    block_facts *facts, all;
    scratch *scratch;
    unsigned workers;
    float *corners; /* heights at multiples of the block's side */
    int64_t corner_columns;
    atomic_uint *top;         /* errors of the vertices there, bits of floats */
    uint32_t *borders;        /* keys of each block's right column, then of its bottom row */
    double highest;           /* sample or 0, metres; where the frame bends */
    double rises[TL_SIZES];   /* of triangles and their neighbours, metres in a cell */
    double top_add[TL_SIZES]; /* of the top */
    double top_rounding;
    tl_run run;
    tl_rounding rounding;
    bool only_looks; /* at what the checksum needs */
} builder;

/* ---- Reading a block -------------------------------------------------------------------------------- */

/* Vertices 0 ... width, 0 ... height of block `item`. */
typedef struct block_place {
    int64_t column, row, x, y, width, height;
} block_place;

static block_place place_of(const builder *self, uint64_t item)
{
    block_place at = {.column = (int64_t)item % self->shape->columns, .row = (int64_t)item / self->shape->columns};
    at.x = at.column * self->side, at.y = at.row * self->side;
    at.width = tl_int64_min(self->side, self->width - 1 - at.x);
    at.height = tl_int64_min(self->side, self->height - 1 - at.y);
    return at;
}

/* Reads a block into the worker's `read`, (width + 1) * (height + 1). */
static tl_status read_block(const builder *self, const block_place *at, const scratch *own, tl_error *error)
{
    tl_window window = {at->x, at->y, at->width + 1, at->height + 1};
    tl_status status = tl_source_read(self->dem, self->shape->info.level, window, own->read, error);
    if (status == TL_OK)
        tl_heights_clean(own->read, (size_t)(window.width * window.height));
    return status;
}

/* Copies what was read into a frame of one mirrored sample. */
static const float *frame_block(const block_place *at, const scratch *own)
{
    const float *from = own->read;
    float *to = own->heights + FRAME + 1;
    for (int64_t y = 0; y <= at->height; y++, to += FRAME, from += at->width + 1) {
        memcpy(to, from, (size_t)(at->width + 1) * sizeof *to);
        to[-1] = to[1];
        to[at->width + 1] = to[at->width - 1];
    }
    size_t bytes = (size_t)(at->width + 3) * sizeof *to;
    memcpy(own->heights, own->heights + 2 * FRAME, bytes);
    memcpy(own->heights + (at->height + 2) * FRAME, own->heights + at->height * FRAME, bytes);
    return own->heights + FRAME + 1;
}

/* ---- The first pass --------------------------------------------------------------------------------- */

static inline uint64_t mix(uint64_t hash, uint64_t value)
{
    hash = (hash ^ value) * UINT64_C(0x9E3779B97F4A7C15);
    return hash ^ hash >> 29;
}

/* Of the block's own samples: those of the next blocks count there. */
static uint64_t hash_block(const float *z, const block_place *at, int64_t columns, int64_t rows)
{
    uint64_t hash[4] = {1, 2, 3, 4};
    for (int64_t y = 0; y < rows; y++) {
        const float *row = z + y * (at->width + 1);
        for (int64_t x = 0; x < columns; x++) {
            uint32_t bits = 0x7fc00000; /* of all voids */
            if (row[x] == row[x])
                memcpy(&bits, &row[x], sizeof bits);
            hash[x & 3] = mix(hash[x & 3], bits);
        }
    }
    return mix(mix(mix(hash[0], hash[1]), hash[2]), hash[3]);
}

static void find_range(const float *z, int64_t count, block_facts *out)
{
    float low = HUGE_VALF, high = -HUGE_VALF;
    for (int64_t i = 0; i < count; i++) {
        low = z[i] < low ? z[i] : low; /* false for a void */
        high = z[i] > high ? z[i] : high;
    }
    out->low = low, out->high = high, out->all_void = low > high;
}

/* The block's corners that no other block stores. */
static void store_corners(builder *self, const block_place *at, const float *z)
{
    bool last_column = at->column == self->shape->columns - 1, last_row = at->row == self->shape->rows - 1;
    for (int64_t j = 0; j <= (last_row && at->height == self->side); j++)
        for (int64_t i = 0; i <= (last_column && at->width == self->side); i++)
            self->corners[(at->row + j) * self->corner_columns + at->column + i] =
                z[j * self->side * (at->width + 1) + i * self->side];
}

/* Whether errors are more than distances from planes. */
static bool shifts(const builder *self)
{
    return self->pyramid->bends || tl_rounds(&self->rounding);
}

static tl_status look_at_rises(const builder *self, const block_place *at, scratch *own, tl_error *error)
{
    static const tl_run alone = {.threads = 1};
    double rises[TL_SIZES];
    int log = self->shape->lattice_log < TL_BLOCK_LOG ? self->shape->lattice_log : TL_BLOCK_LOG;
    tl_status status = tl_framework_rises(own->read, at->width + 1, at->height + 1, log, &alone, rises, error);
    for (int size = 0; status == TL_OK && size < TL_SIZES; size++)
        own->rises[size] = fmax(own->rises[size], rises[size]);
    return status;
}

static void note_overview(const builder *self, const block_place *at, const float *z)
{
    tl_pyramid *to = self->pyramid;
    const int64_t step = INT64_C(1) << TL_OVERVIEW_LOG;
    bool last_column = at->column == self->shape->columns - 1, last_row = at->row == self->shape->rows - 1;
    for (int64_t j = 0; j < self->side + last_row && j <= at->height; j += step)
        for (int64_t i = 0; i < self->side + last_column && i <= at->width; i += step)
            to->overview[(at->y + j) / step * to->overview_columns + (at->x + i) / step] = z[j * (at->width + 1) + i];
}

static void note_square(const block_place *at, const float *z, int64_t x, int64_t y, tl_square_facts *out)
{
    const int64_t side = INT64_C(1) << TL_SQUARE_LOG;
    *out = (tl_square_facts){HUGE_VALF, -HUGE_VALF, false};
    for (int64_t j = y; j <= y + side && j <= at->height; j++)
        for (int64_t i = x; i <= x + side && i <= at->width; i++) {
            float here = z[j * (at->width + 1) + i];
            out->low = here < out->low ? here : out->low; /* false for a void */
            out->high = here > out->high ? here : out->high;
            out->voids |= here != here;
        }
}

static void note_squares(const builder *self, const block_place *at, const float *z)
{
    tl_pyramid *to = self->pyramid;
    const int64_t side = INT64_C(1) << TL_SQUARE_LOG;
    for (int64_t y = 0; y < at->height; y += side)
        for (int64_t x = 0; x < at->width; x += side)
            note_square(at, z, x, y, &to->squares[(at->y + y) / side * to->square_columns + (at->x + x) / side]);
}

static tl_status look_at_block(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    builder *self = context;
    scratch *own = &self->scratch[worker];
    block_facts *found = &self->facts[item];
    block_place at = place_of(self, item);
    (void)loop;
    tl_status status = read_block(self, &at, own, error);
    if (status != TL_OK)
        return status;
    tl_heights of = {own->read, at.width + 1, at.width + 1, at.height + 1};
    found->magnitude = tl_heights_magnitude(&of, &found->voids);
    found->hash = hash_block(own->read, &at, tl_int64_min(self->side, self->width - at.x),
                             tl_int64_min(self->side, self->height - at.y));
    find_range(own->read, of.width * of.height, found);
    note_overview(self, &at, own->read);
    note_squares(self, &at, own->read);
    if (self->only_looks)
        return TL_OK;
    found->rounds = tl_heights_round(&of, found->magnitude, self->shape->lattice_log);
    store_corners(self, &at, own->read);
    return shifts(self) ? look_at_rises(self, &at, own, error) : TL_OK;
}

/* The rises of all triangles, of a sample's own or of the one beside it: see look_at_frame in framework.c. */
static tl_status sum_rises(builder *self, tl_error *error)
{
    const tl_source_info *info = &self->shape->info;
    double own[TL_SIZES + 1] = {0}, top[TL_SIZES];
    for (unsigned i = 0; i < self->workers; i++)
        for (int size = 0; size < TL_SIZES; size++)
            own[size] = fmax(own[size], self->scratch[i].rises[size]);
    int log = self->shape->lattice_log - TL_BLOCK_LOG;
    int64_t rows = (self->height - 1) / self->side + 1;
    tl_status status =
        log <= 0 ? TL_OK : tl_framework_rises(self->corners, self->corner_columns, rows, log, &self->run, top, error);
    for (int size = 1; log > 0 && status == TL_OK && size + 2 * TL_BLOCK_LOG < TL_SIZES; size++)
        own[size + 2 * TL_BLOCK_LOG] = top[size] / TL_BLOCK;
    for (int size = 1; size < TL_SIZES; size++)
        self->rises[size] = info->georef.height_unit * fmax(own[size], fmax(own[size - 1], own[size + 1]));
    double high = fmax(0, (double)self->all.high), low = fmin(0, (double)self->all.low); /* as in framework.c */
    self->highest = info->georef.height_unit * high;
    self->rounding.upright += self->rounding.of_range * (high - low);
    return status;
}

static void sum_facts(builder *self)
{
    size_t blocks = (size_t)(self->shape->columns * self->shape->rows);
    self->all =
        (block_facts){.low = HUGE_VALF, .high = -HUGE_VALF, .hash = mix((uint64_t)self->width, (uint64_t)self->height)};
    for (size_t i = 0; i < blocks; i++) {
        const block_facts *each = &self->facts[i];
        self->all.magnitude = each->magnitude > self->all.magnitude ? each->magnitude : self->all.magnitude;
        self->all.low = each->low < self->all.low ? each->low : self->all.low;
        self->all.high = each->high > self->all.high ? each->high : self->all.high;
        self->all.voids |= each->voids;
        self->all.rounds |= each->rounds;
        self->all.hash = mix(self->all.hash, each->hash);
    }
}

/* ---- Limits of bent frames -------------------------------------------------------------------------- */

/* What is added to the errors of triangles on a lattice that is bent like this. */
static void fill_add(const builder *self, const dem_bend *bend, double add[TL_SIZES])
{
    double unit = self->shape->info.georef.height_unit;
    add[0] = 0;
    for (int size = 1; size < TL_SIZES; size++) {
        add[size] = self->pyramid->bends ? dem_bend_error(bend, ldexp(1, size + 1), self->rises[size]) / unit : 0;
        add[size] += tl_rounding_error(&self->rounding, self->rises[size] / unit);
    }
}

static void bend_blocks(builder *self)
{
    size_t blocks = (size_t)(self->shape->columns * self->shape->rows);
    for (size_t i = 0; self->pyramid->bends && i < blocks; i++) {
        block_place at = place_of(self, i);
        dem_bend *bend = &self->facts[i].bend;
        *bend = dem_space_bend(self->scratch[0].space, (double)at.x, (double)at.y, (double)at.width, (double)at.height,
                               self->highest);
        self->all.bend = i ? dem_bend_worse(self->all.bend, *bend) : *bend;
    }
    fill_add(self, &self->all.bend, self->top_add);
}

/* The codes' scale: the largest errors, at most the relief and what bending adds, come below the last step. */
static int32_t find_base(const builder *self)
{
    double relief = self->all.low <= self->all.high ? (double)self->all.high - (double)self->all.low : 0;
    int largest = tl_size_of(INT64_C(1) << self->shape->lattice_log, false);
    double most = relief + self->top_add[largest < TL_SIZES ? largest : TL_SIZES - 1];
    int exponent = 0;
    frexp(most < 0x1p127 ? most : 0x1p127, &exponent);                           /* most <= 2^exponent */
    int32_t base = (exponent + 127) * 16 - 254, last = (0x7f800000 >> 19) - 255; /* so that infinity has code 255 */
    return base < 0 ? 0 : base < last ? base : last;
}

/* ---- The second pass: the top over a block ------------------------------------------------------------ */

/* A plane over corners of blocks: value + across (i - column) + down (j - row). */
typedef struct plane {
    double value, across, down;
    int64_t column, row;
    bool flat;
} plane;

static inline double corner_at(const builder *self, int64_t column, int64_t row)
{
    return (double)self->corners[row * self->corner_columns + column];
}

static inline double plane_at(const plane *of, int64_t column, int64_t row)
{
    return of->value + of->across * (double)(column - of->column) + of->down * (double)(row - of->row);
}

/* The half, a block's or a larger square's, that is being compared. */
typedef struct tile {
    const builder *of;
    const float *z; /* of the block's corner */
    block_place at;
    bool rising;
    double own; /* no error of the block's own halves is larger */
} tile;

static inline float float_up(double a)
{
    float f = (float)a;
    return (double)f < a ? nextafterf(f, INFINITY) : f;
}

static void raise(atomic_uint *to, uint32_t bits)
{
    uint32_t old = atomic_load_explicit(to, memory_order_relaxed);
    while (old < bits &&
           !atomic_compare_exchange_weak_explicit(to, &old, bits, memory_order_relaxed, memory_order_relaxed))
        ;
}

static inline uint32_t bits_of(float f)
{
    uint32_t bits;
    memcpy(&bits, &f, sizeof bits);
    return bits;
}

/* Compares half a block with a plane, which belongs to the vertex (column, row) and has this size. What cannot raise
 * the vertex's error is not looked at: the block's own error and the largest difference of both planes is a bound. */
static void compare_half(const tile *self, tl_half half, const plane *with, int64_t column, int64_t row, int size)
{
    const builder *of = self->of;
    double values[4], off = 0;
    for (int k = 0; k < 4; k++) {
        int64_t i = self->at.column + (k & 1), j = self->at.row + (k >> 1);
        values[k] = plane_at(with, i, j);
        bool first_only = k == (self->rising ? 0 : 2), second_only = k == (self->rising ? 3 : 1);
        if (!(half == TL_HALF_FIRST ? second_only : first_only))
            off = fmax(off, fabs(values[k] - corner_at(of, i, j)));
    }
    atomic_uint *to = &of->top[row * of->corner_columns + column];
    double add = of->top_add[size], rounding = of->top_rounding;
    if (bits_of(float_up(self->own + off + rounding + add)) <= atomic_load_explicit(to, memory_order_relaxed))
        return;
    double error = of->kernel->half(self->z, FRAME, TL_BLOCK, self->rising, half, values);
    raise(to, bits_of(float_up(error + (with->flat && error == 0 ? 0 : rounding) + add)));
}

/* A square of the lattice of side 2 s blocks. */
typedef struct top_square {
    int64_t column, row, s;
    bool rising;
} top_square;

/* The plane of the half of the square, cut by its diagonal, in which the point (x, y) / 3 lies; false: it reaches out
 * of the raster, as its right-angled corner or an end of its diagonal does. */
static bool centre_plane(const builder *self, const top_square *in, int64_t x, int64_t y, plane *out)
{
    int64_t side = 2 * in->s, dx = x - 3 * in->column, dy = y - 3 * in->row;
    if ((in->column + side) * TL_BLOCK >= self->width || (in->row + side) * TL_BLOCK >= self->height)
        return false; /* either half has corners in the last column and in the last row */
    double nw = corner_at(self, in->column, in->row), ne = corner_at(self, in->column + side, in->row);
    double sw = corner_at(self, in->column, in->row + side), se = corner_at(self, in->column + side, in->row + side);
    bool west = in->rising ? dx + dy < 3 * side : dx < dy, top = in->rising == west;
    double per = 1 / (double)side;
    *out = (plane){nw, (top ? ne - nw : se - sw) * per, (west ? sw - nw : se - ne) * per, in->column, in->row, false};
    if (in->rising && !west)
        out->value = se, out->column += side, out->row += side;
    double right = top ? (west ? nw : ne) : (west ? sw : se); /* at its right angle */
    out->flat = in->rising ? right == ne && right == sw : right == nw && right == se;
    return true;
}

/* The same of the quarter of the square between its middle and a side; *column, *row become the side's middle. */
static bool edge_plane(const builder *self, const top_square *in, int64_t x, int64_t y, plane *out, int64_t *column,
                       int64_t *row)
{
    int64_t s = in->s, i = in->column + s, j = in->row + s, dx = x - 3 * i, dy = y - 3 * j;
    bool across = (dy < 0 ? -dy : dy) > (dx < 0 ? -dx : dx);
    int64_t toward = (across ? dy : dx) < 0 ? -1 : 1;
    *column = across ? i : i + toward * s, *row = across ? j + toward * s : j;
    int64_t far_column = across ? i + s : tl_int64_max(i, *column), far_row = across ? tl_int64_max(j, *row) : j + s;
    if (far_column * TL_BLOCK >= self->width || far_row * TL_BLOCK >= self->height)
        return false;
    double a = across ? corner_at(self, i - s, *row) : corner_at(self, *column, j - s);
    double b = across ? corner_at(self, i + s, *row) : corner_at(self, *column, j + s);
    double apex = corner_at(self, i, j), middle = 0.5 * (a + b), along = (b - a) / (double)(2 * s);
    double outwards = (middle - apex) / (double)s * (double)toward;
    *out = (plane){middle, across ? along : outwards, across ? outwards : along, *column, *row, a == b && a == apex};
    return true;
}

/* Compares a block without voids with all larger triangles that cover it. */
static void compare_with_top(const tile *self)
{
    const builder *of = self->of;
    int64_t lattice = INT64_C(1) << (of->shape->lattice_log - TL_BLOCK_LOG);
    for (int k = 0; k < 2; k++) {
        tl_half half = k ? TL_HALF_SECOND : TL_HALF_FIRST;
        int64_t x = 3 * self->at.column + 1 + k, y = 3 * self->at.row + 1 + (self->rising ? k : !k); /* its centroid */
        for (int64_t s = 1; 2 * s <= lattice; s *= 2) {
            int64_t column, row, side = 2 * s;
            top_square in = {self->at.column / side * side, self->at.row / side * side, s, false};
            in.rising = (self->at.column / side + self->at.row / side) & 1;
            plane with;
            if (edge_plane(of, &in, x, y, &with, &column, &row))
                compare_half(self, half, &with, column, row, tl_size_of(s * TL_BLOCK, false));
            if (centre_plane(of, &in, x, y, &with))
                compare_half(self, half, &with, in.column + s, in.row + s, tl_size_of(s * TL_BLOCK, true));
        }
    }
}

/* ---- The second pass: a block's own ------------------------------------------------------------------- */

static void store_row(const builder *self, int64_t x, int64_t y, const float *errors, int64_t count)
{
    tl_pyramid *to = self->pyramid;
    size_t at = (size_t)(y * self->width + x);
    if (to->codes)
        self->kernel->encode(errors, count, to->base, to->codes + at);
    for (int64_t i = 0; !to->codes && i < count; i++)
        to->errors[at + (size_t)i] = errors[i] > 0 ? errors[i] : 0;
}

static uint32_t key_of(const builder *self, float error)
{
    unsigned char code;
    if (!self->pyramid->codes)
        return error > 0 ? bits_of(error) : 0;
    self->kernel->encode(&error, 1, self->pyramid->base, &code);
    return code;
}

/* Stores the block's own errors, and those of its right column and bottom row beside. */
static void store_block(const builder *self, const block_place *at, uint64_t item, const float *errors)
{
    int64_t side = self->side;
    int64_t columns = tl_int64_min(side, at->width + 1), rows = tl_int64_min(side, at->height + 1);
    uint32_t *right = self->borders + item * 2 * (uint64_t)(side + 1), *bottom = right + side + 1;
    for (int64_t y = 0; y < rows; y++)
        store_row(self, at->x, at->y + y, errors + y * TL_ERROR_STRIDE, columns);
    for (int64_t i = 0; i <= side; i++) {
        right[i] = at->width == side && i <= at->height ? key_of(self, errors[i * TL_ERROR_STRIDE + side]) : 0;
        bottom[i] = at->height == side && i <= at->width ? key_of(self, errors[side * TL_ERROR_STRIDE + i]) : 0;
    }
}

/* Whether all errors of a block are 0: all of it is in one plane, and no triangle of it reaches over the raster's rim.
 */
static bool is_level(const builder *self, const block_place *at, const block_facts *facts)
{
    return facts->low == facts->high && !facts->voids && at->width == self->side && at->height == self->side &&
           !shifts(self);
}

static tl_status find_block(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    builder *self = context;
    const scratch *own = &self->scratch[worker];
    const block_facts *facts = &self->facts[item];
    block_place at = place_of(self, item);
    (void)loop;
    tl_status status = read_block(self, &at, own, error);
    if (status != TL_OK)
        return status;
    double add[TL_SIZES];
    fill_add(self, &facts->bend, add);
    tl_error_block block = {.heights = frame_block(&at, own),
                            .stride = FRAME,
                            .width = at.width,
                            .height = at.height,
                            .rim_x = self->width - 1 - at.x,
                            .rim_y = self->height - 1 - at.y,
                            .x = at.x,
                            .y = at.y,
                            .voids = facts->voids,
                            .rounding = facts->rounds ? tl_error_rounding((double)facts->magnitude) : 0,
                            .add = add,
                            .errors = own->errors,
                            .centres = own->centres,
                            .across = own->across,
                            .down = own->down,
                            .rows = own->rows,
                            .parts = own->parts};
    for (int k = 0; k < 4; k++)
        own->errors[(k >> 1) * self->side * TL_ERROR_STRIDE + (k & 1) * self->side] = 0;
    if (is_level(self, &at, facts))
        memset(own->errors, 0, (size_t)TL_ERROR_STRIDE * TL_ERROR_STRIDE * sizeof *own->errors);
    else if (self->side > 1)
        self->kernel->block(&block, self->side);
    store_block(self, &at, item, own->errors);
    float middle = own->errors[self->side / 2 * TL_ERROR_STRIDE + self->side / 2];
    if (self->shape->lattice_log > TL_BLOCK_LOG && at.width == LAST && at.height == LAST && isfinite(middle)) {
        tile of = {self, block.heights, at, (at.column + at.row) & 1, (double)middle};
        compare_with_top(&of);
    }
    return TL_OK;
}

/* ---- Between blocks --------------------------------------------------------------------------------- */

/* Raises the key of a sample; false: it is as high already. */
static bool raise_key(tl_pyramid *pyramid, size_t sample, uint32_t key)
{
    if (tl_pyramid_key(pyramid, sample) >= key)
        return false;
    if (pyramid->codes)
        pyramid->codes[sample] = (unsigned char)key;
    else
        memcpy(&pyramid->errors[sample], &key, sizeof key);
    return true;
}

static void merge_borders(const builder *self)
{
    int64_t side = self->side;
    for (int64_t block = 0; block < self->shape->columns * self->shape->rows; block++) {
        int64_t x = block % self->shape->columns * side, y = block / self->shape->columns * side;
        const uint32_t *right = self->borders + block * 2 * (side + 1), *bottom = right + side + 1;
        for (int64_t i = 0; i <= side; i++) {
            if (right[i])
                raise_key(self->pyramid, (size_t)((y + i) * self->width + x + side), right[i]);
            if (bottom[i])
                raise_key(self->pyramid, (size_t)((y + side) * self->width + x + i), bottom[i]);
        }
    }
}

/* Raises the vertices that (x, y) needs, and those that they need, to its key; but not those of the top. */
static void raise_parents(const builder *self, int64_t x, int64_t y)
{
    int64_t stack[256][2], top_mask = self->side - 1; /* each of at most 128 levels leaves one vertex behind */
    uint32_t key = tl_pyramid_key(self->pyramid, (size_t)(y * self->width + x));
    size_t depth = key ? 1 : 0;
    stack[0][0] = x, stack[0][1] = y;
    while (depth) {
        depth--;
        int64_t up[2][2];
        tl_lattice_parents(stack[depth][0], stack[depth][1], up);
        for (int i = 0; i < 2; i++) {
            int64_t px = up[i][0], py = up[i][1];
            if (px < 0 || py < 0 || px >= self->width || py >= self->height || !((px | py) & top_mask) ||
                !raise_key(self->pyramid, (size_t)(py * self->width + px), key))
                continue;
            stack[depth][0] = px, stack[depth++][1] = py;
        }
    }
}

static void raise_across_borders(const builder *self)
{
    int64_t side = self->side;
    for (int64_t y = side; y < self->height; y += side)
        for (int64_t x = 0; x < self->width; x++)
            if (x & (side - 1))
                raise_parents(self, x, y);
    for (int64_t x = side; x < self->width; x += side)
        for (int64_t y = 0; y < self->height; y++)
            if (y & (side - 1))
                raise_parents(self, x, y);
}

/* ---- Above blocks ----------------------------------------------------------------------------------- */

static void raise_by_child(const builder *self, uint32_t *key, int64_t x, int64_t y)
{
    if (x < 0 || y < 0 || x >= self->width || y >= self->height)
        return;
    uint32_t child = tl_pyramid_key(self->pyramid, (size_t)(y * self->width + x));
    *key = child > *key ? child : *key;
}

/* Settles the vertex (x, y) of stage s: its children are `step` away, along rows and columns or along diagonals. */
static void settle_top(const builder *self, int64_t x, int64_t y, int64_t s)
{
    int64_t right = self->width - 1, bottom = self->height - 1;
    bool odd_x = x / s & 1, odd_y = y / s & 1, over;
    if (x > right || y > bottom)
        return;
    if (odd_x && odd_y)
        over = x + s > right || y + s > bottom;
    else if (odd_x)
        over = x + s > right || tl_reaches_over(y, s, bottom);
    else
        over = y + s > bottom || tl_reaches_over(x, s, right);
    uint32_t bits =
        atomic_load_explicit(&self->top[y / TL_BLOCK * self->corner_columns + x / TL_BLOCK], memory_order_relaxed);
    float error;
    memcpy(&error, &bits, sizeof error);
    uint32_t key = over ? tl_pyramid_most(self->pyramid) : key_of(self, error);
    for (int k = 0; k < 4; k++) {
        int64_t sx = k & 1 ? 1 : -1, sy = k & 2 ? 1 : -1;
        if (odd_x && odd_y)
            raise_by_child(self, &key, x + (k & 1 ? sy * s : 0), y + (k & 1 ? 0 : sy * s));
        else
            raise_by_child(self, &key, x + sx * s / 2, y + sy * s / 2);
    }
    raise_key(self->pyramid, (size_t)(y * self->width + x), key);
}

static void settle_all_top(const builder *self)
{
    int64_t lattice = INT64_C(1) << self->shape->lattice_log;
    for (int64_t s = self->side; 2 * s <= lattice; s *= 2) {
        for (int64_t y = 0; y < self->height; y += s)
            for (int64_t x = y / s & 1 ? 0 : s; x < self->width; x += 2 * s)
                settle_top(self, x, y, s);
        for (int64_t y = s; y < self->height; y += 2 * s)
            for (int64_t x = s; x < self->width; x += 2 * s)
                settle_top(self, x, y, s);
    }
}

/* ---- Building ----------------------------------------------------------------------------------------- */

static tl_status make_scratch(builder *self, tl_error *error)
{
    const tl_source_info *info = &self->shape->info;
    self->scratch = calloc(self->workers, sizeof *self->scratch);
    for (unsigned i = 0; self->scratch && i < self->workers; i++) {
        scratch *each = &self->scratch[i];
        const size_t square = (size_t)FRAME * FRAME, half = TL_BLOCK / 2 + 4, quarter = TL_BLOCK / 4 + 1;
        each->read = tl_alloc(square, sizeof(float));
        each->heights = calloc(square + TL_ERROR_PAD, sizeof(float)); /* beyond the rim all is read, but nothing used */
        each->errors = calloc((size_t)TL_ERROR_STRIDE * TL_ERROR_STRIDE, sizeof(float));
        each->centres = tl_alloc(half * half, sizeof(float));
        each->across = tl_alloc(quarter * quarter, sizeof(float));
        each->down = tl_alloc(quarter * quarter, sizeof(float));
        each->parts = tl_alloc(8 * half, sizeof(float));
        each->rows = tl_alloc(3 * half, sizeof(double));
        if (!each->read || !each->heights || !each->errors || !each->centres || !each->across || !each->down ||
            !each->parts || !each->rows)
            return tl_fail_memory(error, "the error pyramid");
        if (self->pyramid->bends &&
            !(each->space = dem_space_create(&info->georef, self->width, self->height, info->name, error)))
            return TL_ERROR_DATA;
    }
    return self->scratch ? TL_OK : tl_fail_memory(error, "the error pyramid");
}

static tl_status make_builder(builder *self, tl_error *error)
{
    size_t blocks = (size_t)(self->shape->columns * self->shape->rows);
    size_t corners = (size_t)self->corner_columns * (size_t)((self->height - 1) / self->side + 1);
    self->facts = calloc(blocks, sizeof *self->facts);
    self->corners = tl_alloc(corners, sizeof *self->corners);
    self->top = calloc(corners, sizeof *self->top);
    self->borders = tl_alloc(blocks, 2 * (size_t)(self->side + 1) * sizeof *self->borders);
    if (!self->facts || !self->corners || !self->top || !self->borders)
        return tl_fail_memory(error, "the error pyramid");
    return make_scratch(self, error);
}

static void free_builder(builder *self)
{
    for (unsigned i = 0; self->scratch && i < self->workers; i++) {
        scratch *each = &self->scratch[i];
        free(each->read);
        free(each->heights);
        free(each->errors);
        free(each->centres);
        free(each->across);
        free(each->down);
        free(each->parts);
        free(each->rows);
        dem_space_destroy(each->space);
    }
    free(self->scratch);
    free(self->facts);
    free(self->corners);
    free(self->top);
    free(self->borders);
}

static uint64_t mix_number(uint64_t hash, double number)
{
    uint64_t bits;
    memcpy(&bits, &number, sizeof bits);
    return mix(hash, bits);
}

/* What errors depend on besides heights: where bent frames have their samples, and what files round. */
static uint64_t hash_frame(const builder *self, uint64_t hash)
{
    const tl_georef *georef = &self->shape->info.georef;
    if (self->pyramid->bends) {
        for (int k = 0; k < 6; k++)
            hash = mix_number(hash, georef->transform[k]);
        hash = mix_number(hash, georef->height_unit);
        for (const char *c = tl_crs_wkt(georef->crs); *c; c++)
            hash = mix(hash, (unsigned char)*c);
    }
    if (tl_rounds(&self->rounding)) {
        hash = mix_number(hash, self->rounding.along);
        hash = mix_number(hash, self->rounding.upright);
        hash = mix_number(hash, self->rounding.of_range);
    }
    return hash;
}

/* The first pass. */
static tl_status look(builder *self, tl_error *error)
{
    uint64_t blocks = (uint64_t)(self->shape->columns * self->shape->rows);
    tl_status status = make_builder(self, error);
    tl_run quietly = self->run; /* it takes little */
    quietly.progress = NULL;
    if (status == TL_OK)
        status = tl_parallel_for(&quietly, blocks, 0, look_at_block, self, error);
    if (status != TL_OK)
        return status;
    sum_facts(self);
    self->pyramid->checksum = hash_frame(self, self->all.hash);
    for (uint64_t k = 0; k < blocks; k++) {
        self->pyramid->ranges[2 * k] = self->facts[k].low;
        self->pyramid->ranges[2 * k + 1] = self->facts[k].high;
    }
    self->pyramid->shape->voids = self->all.voids;
    return TL_OK;
}

static tl_status build(builder *self, tl_error *error)
{
    uint64_t blocks = (uint64_t)(self->shape->columns * self->shape->rows);
    uint64_t samples = (uint64_t)self->width * (uint64_t)self->height;
    tl_status status = look(self, error);
    if (status != TL_OK || self->only_looks)
        return status;
    if (shifts(self))
        status = sum_rises(self, error);
    bend_blocks(self);
    self->top_rounding = self->all.rounds ? tl_error_rounding((double)self->all.magnitude) : 0;
    self->pyramid->base = find_base(self);
    if (status == TL_OK)
        status = tl_parallel_for(&self->run, blocks, samples, find_block, self, error);
    if (status != TL_OK)
        return status;
    merge_borders(self);
    raise_across_borders(self);
    settle_all_top(self);
    return TL_OK;
}

tl_pyramid *tl_pyramid_allocate(const tl_source_info *info, const tl_pyramid_options *options, tl_error *error)
{
    double samples = (double)info->width * (double)info->height;
    if (tl_run_fits(options->run, ((options->exact ? sizeof(float) : 1) + BITMAPS + OVERVIEW) * samples, info->name,
                    "its error pyramid", error) != TL_OK)
        return NULL;
    tl_pyramid *pyramid = calloc(1, sizeof *pyramid);
    if (!pyramid) {
        tl_fail_memory(error, "the error pyramid");
        return NULL;
    }
    pyramid->shape = tl_framework_create(info, 0, options->run, error);
    if (pyramid->shape) {
        size_t count = (size_t)info->width * (size_t)info->height; /* its bitmaps have an eighth */
        pyramid->frame = options->frame;
        pyramid->bends = dem_frame_bends(&info->georef, options->frame);
        pyramid->codes = options->exact ? NULL : calloc(count, 1);
        pyramid->errors = options->exact ? calloc(count, sizeof *pyramid->errors) : NULL;
        size_t blocks = (size_t)(pyramid->shape->columns * pyramid->shape->rows);
        pyramid->ranges = tl_alloc(blocks, 2 * sizeof *pyramid->ranges);
        pyramid->overview_columns = (info->width - 1) / (1 << TL_OVERVIEW_LOG) + 1;
        pyramid->overview_rows = (info->height - 1) / (1 << TL_OVERVIEW_LOG) + 1;
        pyramid->square_columns = tl_div_up(info->width - 1, 1 << TL_SQUARE_LOG);
        pyramid->square_rows = tl_div_up(info->height - 1, 1 << TL_SQUARE_LOG);
        pyramid->overview = tl_alloc_grid(pyramid->overview_columns, pyramid->overview_rows, sizeof *pyramid->overview);
        pyramid->squares =
            calloc((size_t)(pyramid->square_columns * pyramid->square_rows + 1), sizeof *pyramid->squares);
        if ((pyramid->codes || pyramid->errors) && pyramid->ranges && pyramid->overview && pyramid->squares)
            return pyramid;
        tl_fail(error, TL_ERROR_MEMORY, "%s: not enough memory for the errors of its %lld x %lld samples", info->name,
                (long long)info->width, (long long)info->height);
    }
    tl_pyramid_destroy(pyramid);
    return NULL;
}

static tl_status run_builder(tl_pyramid *pyramid, const tl_source *dem, const tl_pyramid_options *options,
                             bool only_looks, tl_error *error)
{
    const tl_framework *shape = pyramid->shape;
    builder self = {.pyramid = pyramid,
                    .shape = shape,
                    .dem = dem,
                    .kernel = *tl_error_kernels(),
                    .width = dem->info.width,
                    .height = dem->info.height,
                    .side = shape->block,
                    .corner_columns = (dem->info.width - 1) / shape->block + 1,
                    .rounding = options->rounding,
                    .only_looks = only_looks};
    if (options->run)
        self.run = *options->run;
    self.workers = tl_parallel_workers(&self.run, (uint64_t)(shape->columns * shape->rows));
    bool no_cells = !shape->columns || !shape->rows;
    pyramid->shape->voids = no_cells;
    tl_status status = no_cells ? TL_OK : build(&self, error);
    free_builder(&self);
    return status;
}

tl_status tl_pyramid_look(tl_pyramid *pyramid, const tl_source *dem, const tl_pyramid_options *options, tl_error *error)
{
    return run_builder(pyramid, dem, options, true, error);
}

tl_pyramid *tl_pyramid_create(const tl_source *dem, const tl_pyramid_options *options, tl_error *error)
{
    static const tl_pyramid_options defaults = {0};
    options = options ? options : &defaults;
    tl_pyramid *pyramid = tl_pyramid_allocate(&dem->info, options, error);
    if (pyramid && run_builder(pyramid, dem, options, false, error) == TL_OK)
        return pyramid;
    tl_pyramid_destroy(pyramid);
    return NULL;
}

double tl_pyramid_error(const tl_pyramid *pyramid, int64_t i, int64_t j)
{
    return tl_pyramid_value(pyramid, tl_pyramid_key(pyramid, (size_t)(j * pyramid->shape->info.width + i)));
}

void tl_pyramid_destroy(tl_pyramid *pyramid)
{
    if (!pyramid)
        return;
    tl_framework_destroy(pyramid->shape);
    free(pyramid->codes);
    free(pyramid->errors);
    free(pyramid->ranges);
    free(pyramid->overview);
    free(pyramid->squares);
    free(pyramid);
}
