/* Ties: triangles for samples that no cell can draw.
 *
 * A valid sample of which no cell has two more valid corners is alone: the end of a row one sample wide, or a sample
 * beside a slanting rim. It is tied in by a triangle between three valid samples, of twice the area of one half, that
 * is, one unit: by Pick's theorem such a triangle has no sample inside nor on its edges. So a tie covers its corners
 * only, keeps any bound, and covers no void; and what is drawn of cells depends on the voids alone, so that ties are
 * the same for every bound. A tie may not share area with what is drawn of a cell nor with another tie.
 *
 * The corners of ties are vertices of the mesh already: a tie needs room at its corner, so that one of the four direct
 * neighbours there is void, and the triangles which such a sample splits are mixed, therefore split. An edge of a tie
 * between two such vertices is either whole in the mesh, or new.
 *
 * Samples are taken row by row. First, and a few times, those are tied that reach two samples which are in the mesh
 * (cells' or tied before), so that rows are followed from where they are rooted; then any that reach two valid ones.
 * Of several ties that are possible, the one with the shortest longest edge is made. */
#include "dem/framework.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <string.h>

/* Columns and rows that a tie reaches at most from its sample, and between any two of its corners. */
enum { REACH = 3, SIDE = 2 * REACH + 1, CELLS_SIDE = SIDE - 1, ROOTED_SWEEPS = 4 };
/* Squares of the raster by which ties are found again: those that share area lie in squares that touch. */
enum { SQUARE_LOG = 3 };

typedef struct offset {
    int32_t x, y;
} offset;

/* A tie of the sample (0, 0). Windows are bits, (x, y) of -REACH ... REACH at (y + REACH) * SIDE + x + REACH; a cell is
 * at its north-western corner. */
typedef struct shape {
    offset a, b;          /* in the order of the mesh's triangles after (0, 0) */
    int32_t longest, sum; /* squares of edges */
    uint64_t needs;       /* a and b */
    uint64_t whole;       /* cells that it shares area with; */
    uint64_t halves[4];   /* with the half of them that lacks the corner NW, NE, SW, SE */
} shape;

typedef struct tier {
    tl_framework *framework;
    const uint64_t *valid;
    uint64_t *joined; /* samples in the mesh */
    shape *shapes;
    size_t shape_count, capacity;
    int64_t columns;        /* of squares */
    uint32_t *first, *next; /* ties by square and by tie, from 1 */
} tier;

/* ---- Geometry ------------------------------------------------------------------------------------ */

static inline int64_t area2(offset a, offset b, offset c)
{
    return (int64_t)(b.x - a.x) * (c.y - a.y) - (int64_t)(b.y - a.y) * (c.x - a.x);
}

/* Whether one of the edges of t has all of the triangle u on its outer side. */
static bool edge_parts(const offset t[3], const offset u[3])
{
    int64_t inside = area2(t[0], t[1], t[2]);
    for (int k = 0; k < 3; k++) {
        int outer = 0;
        for (int i = 0; i < 3; i++) {
            int64_t area = area2(t[k], t[(k + 1) % 3], u[i]);
            outer += inside > 0 ? area <= 0 : area >= 0;
        }
        if (outer == 3)
            return true;
    }
    return false;
}

/* Two triangles share no area just where an edge of either separates them. */
static bool share_area(const offset t[3], const offset u[3])
{
    return !edge_parts(t, u) && !edge_parts(u, t);
}

/* ---- Shapes --------------------------------------------------------------------------------------- */

static inline uint64_t window_bit(int32_t x, int32_t y)
{
    return UINT64_C(1) << ((y + REACH) * SIDE + x + REACH);
}

static void mark_cells(shape *to)
{
    const offset own[3] = {{0, 0}, to->a, to->b};
    for (int32_t y = -REACH; y < REACH; y++)
        for (int32_t x = -REACH; x < REACH; x++) {
            const offset corners[4] = {{x, y}, {x + 1, y}, {x, y + 1}, {x + 1, y + 1}};
            for (int lacking = 0; lacking < 4; lacking++) {
                offset half[3];
                for (int k = 0, i = 0; i < 4; i++)
                    if (i != lacking)
                        half[k++] = corners[i];
                if (!share_area(own, half))
                    continue;
                to->halves[lacking] |= window_bit(x, y);
                to->whole |= window_bit(x, y);
            }
        }
}

static inline int32_t length2(offset a, offset b)
{
    return (a.x - b.x) * (a.x - b.x) + (a.y - b.y) * (a.y - b.y);
}

static int compare_shapes(const void *a, const void *b)
{
    const shape *p = a, *q = b;
    if (p->longest != q->longest)
        return p->longest < q->longest ? -1 : 1;
    if (p->sum != q->sum)
        return p->sum < q->sum ? -1 : 1;
    return p->needs < q->needs ? -1 : p->needs > q->needs;
}

static void add_shape(tier *self, offset a, offset b)
{
    const offset origin = {0, 0};
    if (abs(a.x - b.x) > REACH || abs(a.y - b.y) > REACH || area2(origin, a, b) != -1)
        return; /* each shape comes both ways round: -1 is counter-clockwise where rows go down */
    int32_t p = length2(origin, a), q = length2(origin, b), r = length2(a, b);
    shape *to = &self->shapes[self->shape_count++];
    *to = (shape){.a = a, .b = b, .needs = window_bit(a.x, a.y) | window_bit(b.x, b.y), .sum = p + q + r};
    to->longest = p > q ? p : q;
    to->longest = r > to->longest ? r : to->longest;
    mark_cells(to);
}

static bool make_shapes(tier *self)
{
    enum { SAMPLES = SIDE * SIDE };
    self->shapes = malloc(SAMPLES * SAMPLES / 2 * sizeof *self->shapes); /* of two orders one is taken */
    if (!self->shapes)
        return false;
    for (int i = 0; i < SAMPLES * SAMPLES; i++) {
        int first = i / SAMPLES, second = i % SAMPLES;
        add_shape(self, (offset){first % SIDE - REACH, first / SIDE - REACH},
                  (offset){second % SIDE - REACH, second / SIDE - REACH});
    }
    qsort(self->shapes, self->shape_count, sizeof *self->shapes, compare_shapes);
    return true;
}

/* ---- Ties that lie near --------------------------------------------------------------------------- */

static inline size_t square_of(const tier *self, int32_t x, int32_t y)
{
    return (size_t)(y >> SQUARE_LOG) * (size_t)self->columns + (size_t)(x >> SQUARE_LOG);
}

static bool meets_in_square(const tier *self, size_t square, const offset triangle[3])
{
    for (uint32_t i = self->first[square]; i; i = self->next[i - 1]) {
        const tl_tie *tie = &self->framework->ties[i - 1];
        offset other[3];
        for (int k = 0; k < 3; k++)
            other[k] = (offset){tie->x[k], tie->y[k]};
        if (share_area(triangle, other))
            return true;
    }
    return false;
}

/* Whether a tie of the sample triangle[0] would share area with another. */
static bool meets_tie(const tier *self, const offset triangle[3])
{
    const tl_source_info *info = &self->framework->info;
    int64_t x0 = tl_int64_max(triangle[0].x >> SQUARE_LOG, 1) - 1,
            y0 = tl_int64_max(triangle[0].y >> SQUARE_LOG, 1) - 1;
    int64_t x1 = tl_int64_min((triangle[0].x >> SQUARE_LOG) + 1, (info->width - 1) >> SQUARE_LOG);
    int64_t y1 = tl_int64_min((triangle[0].y >> SQUARE_LOG) + 1, (info->height - 1) >> SQUARE_LOG);
    for (int64_t y = y0; y <= y1; y++)
        for (int64_t x = x0; x <= x1; x++)
            if (meets_in_square(self, (size_t)(y * self->columns + x), triangle))
                return true;
    return false;
}

static bool grow(tier *self)
{
    tl_framework *framework = self->framework;
    if (framework->tie_count < self->capacity)
        return true;
    size_t capacity = self->capacity ? 2 * self->capacity : 64, bytes;
    if (!tl_size_mul(capacity, sizeof *framework->ties, &bytes) || capacity >= UINT32_MAX)
        return false;
    tl_tie *ties = realloc(framework->ties, bytes);
    framework->ties = ties ? ties : framework->ties;
    uint32_t *next = realloc(self->next, capacity * sizeof *next);
    self->next = next ? next : self->next;
    self->capacity = ties && next ? capacity : self->capacity;
    return ties && next;
}

static bool add_tie(tier *self, const offset triangle[3])
{
    tl_framework *framework = self->framework;
    if (!grow(self))
        return false;
    tl_tie *to = &framework->ties[framework->tie_count];
    size_t square = square_of(self, triangle[0].x, triangle[0].y);
    self->next[framework->tie_count++] = self->first[square];
    self->first[square] = (uint32_t)framework->tie_count;
    for (int k = 0; k < 3; k++) {
        to->x[k] = triangle[k].x, to->y[k] = triangle[k].y;
        if (tl_bit(self->joined, framework->words, triangle[k].x, triangle[k].y))
            continue; /* a point already */
        tl_bit_set(self->joined, framework->words, triangle[k].x, triangle[k].y);
        tl_bit_set(framework->points, framework->words, triangle[k].x, triangle[k].y);
    }
    return true;
}

/* ---- One sample ------------------------------------------------------------------------------------ */

/* Bits x ... x + SIDE - 1 of a row; what lies outside is 0. */
static uint64_t row_bits(const uint64_t *row, size_t words, int64_t x)
{
    uint64_t mask = (UINT64_C(1) << SIDE) - 1;
    if (x < 0)
        return row[0] << -x & mask;
    size_t w = (size_t)x >> 6, shift = (size_t)x & 63;
    uint64_t bits = row[w] >> shift;
    if (shift > 64 - SIDE && w + 1 < words)
        bits |= row[w + 1] << (64 - shift);
    return bits & mask;
}

static uint64_t window_of(const tier *self, const uint64_t *bits, int64_t x, int64_t y)
{
    uint64_t window = 0;
    for (int64_t row = -REACH; row <= REACH; row++)
        if (y + row >= 0 && y + row < self->framework->info.height)
            window |= row_bits(bits + (size_t)(y + row) * self->framework->words, self->framework->words, x - REACH)
                      << (row + REACH) * SIDE;
    return window;
}

/* The cells of a window that are drawn whole, and those of which the half is that lacks each corner. */
typedef struct drawn {
    uint64_t whole, halves[4];
} drawn;

static drawn drawn_in(uint64_t valid)
{
    uint64_t cells = 0;
    for (int row = 0; row < CELLS_SIDE; row++)
        cells |= ((UINT64_C(1) << CELLS_SIDE) - 1) << row * SIDE;
    uint64_t nw = valid, ne = valid >> 1, sw = valid >> SIDE, se = valid >> (SIDE + 1);
    return (drawn){cells & nw & ne & sw & se,
                   {cells & ~nw & ne & sw & se, cells & nw & ~ne & sw & se, cells & nw & ne & ~sw & se,
                    cells & nw & ne & sw & ~se}};
}

static inline bool meets_cell(const shape *each, const drawn *in)
{
    uint64_t met = each->whole & in->whole;
    for (int k = 0; k < 4; k++)
        met |= each->halves[k] & in->halves[k];
    return met;
}

/* Ties the sample (x, y) to two samples out of `ends`, where that is possible. False: out of memory. */
static bool tie_sample(tier *self, const uint64_t *ends, int32_t x, int32_t y)
{
    uint64_t able = window_of(self, ends, x, y);
    drawn in = drawn_in(window_of(self, self->valid, x, y));
    for (size_t i = 0; i < self->shape_count; i++) {
        const shape *each = &self->shapes[i];
        if ((each->needs & ~able) || meets_cell(each, &in))
            continue;
        const offset triangle[3] = {{x, y}, {x + each->a.x, y + each->a.y}, {x + each->b.x, y + each->b.y}};
        if (!meets_tie(self, triangle))
            return add_tie(self, triangle);
    }
    return true;
}

static bool sweep(tier *self, const uint64_t *ends)
{
    const tl_framework *framework = self->framework;
    for (int64_t y = 0; y < framework->info.height; y++)
        for (size_t w = 0; w < framework->words; w++) {
            size_t at = (size_t)y * framework->words + w;
            for (uint64_t left = self->valid[at] & ~self->joined[at]; left; left &= left - 1) {
                int32_t x = (int32_t)(w * 64 + (unsigned)__builtin_ctzll(left));
                if (!tl_bit(self->joined, framework->words, x, y) && !tie_sample(self, ends, x, (int32_t)y))
                    return false;
            }
        }
    return true;
}

/* ---- All of them ------------------------------------------------------------------------------------ */

static bool tie_all(tier *self)
{
    size_t before = SIZE_MAX;
    for (int i = 0; i < ROOTED_SWEEPS && self->framework->tie_count != before; i++) {
        before = self->framework->tie_count;
        if (!sweep(self, self->joined))
            return false;
    }
    return sweep(self, self->valid);
}

tl_status tl_framework_tie(tl_framework *framework, const uint64_t *valid, uint64_t *joined, tl_error *error)
{
    const tl_source_info *info = &framework->info;
    tier self = {.framework = framework, .valid = valid, .joined = joined};
    self.columns = (info->width >> SQUARE_LOG) + 1;
    self.first = calloc((size_t)((info->height >> SQUARE_LOG) + 1) * (size_t)self.columns, sizeof *self.first);
    bool made = self.first && make_shapes(&self) && tie_all(&self);
    free(self.first);
    free(self.next);
    free(self.shapes);
    return made ? TL_OK : tl_fail_memory(error, "the framework");
}
