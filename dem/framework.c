#include "dem/framework.h"

#include "dem/bend.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <float.h>
#include <math.h>
#include <string.h>

enum { READ_ROWS = 256 };

/* Its height, two bits, and what blocks remember of their rims and insides. */
static const double BYTES_A_SAMPLE = 5;

/* What a block found out about its heights. */
typedef struct findings {
    float magnitude; /* largest |height| */
    bool voids;
    bool rounds;   /* the heights are not exact in double arithmetic over the whole lattice */
    dem_bend bend; /* where the frame bends */
} findings;

typedef struct builder {
    tl_framework *framework;
    const tl_source *dem;
    float *heights;
    int64_t width, height;
    findings *found; /* by band, then by block */
    findings all;
    unsigned char *borders;  /* of each block: its right column, then its bottom row */
    float *centres;          /* bounds of the blocks' own centres: where the top begins */
    struct scratch *scratch; /* by worker */
    unsigned workers;
    double top;             /* the highest sample or 0, metres; where the frame bends */
    double rises[TL_SIZES]; /* of triangles and their neighbours, metres in a cell; where the frame bends or rounds */
    tl_rounding rounding;
    dem_space **spaces; /* by worker, likewise */
    const tl_features *features;
} builder;

/* ---- Progress over several loops ----------------------------------------------------------------- */

typedef struct phase {
    const tl_run *outer;
    uint64_t before, total;
} phase;

static void phase_progress(void *user, uint64_t done, uint64_t total)
{
    const phase *self = user;
    (void)total;
    self->outer->progress(self->outer->user, self->before + done, self->total);
}

/* The run of one loop out of several; `self` must outlive it. */
static tl_run phase_run(phase *self)
{
    tl_run run = self->outer ? *self->outer : (tl_run){0};
    run.user = self;
    run.progress = run.progress && self->total ? phase_progress : NULL;
    return run;
}

/* ---- Reading ------------------------------------------------------------------------------------- */

static tl_status read_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    builder *self = context;
    (void)loop;
    (void)worker;
    int64_t y = (int64_t)item * READ_ROWS;
    tl_window window = {0, y, self->width, tl_int64_min(READ_ROWS, self->height - y)};
    float *to = self->heights + y * self->width;
    tl_status status = tl_source_read(self->dem, self->framework->info.level, window, to, error);
    if (status == TL_OK)
        tl_heights_clean(to, (size_t)(window.width * window.height));
    return status;
}

static tl_status read_dem(builder *self, const tl_run *run, tl_error *error)
{
    uint64_t bands = (uint64_t)tl_div_up(self->height, READ_ROWS);
    return tl_parallel_for(run, bands, (uint64_t)self->width * (uint64_t)self->height, read_band, self, error);
}

/* ---- Blocks -------------------------------------------------------------------------------------- */

/* Working memory of one worker. Heights and marks have a frame of one sample around vertices 0 ... block. */
typedef struct scratch {
    float *heights, *centres, *across, *down;
    unsigned char *split;
    void *rows;
} scratch;

static int64_t framed(const tl_framework *framework)
{
    return framework->block + 3;
}

static void free_scratch(builder *self)
{
    for (unsigned i = 0; self->scratch && i < self->workers; i++) {
        scratch *each = &self->scratch[i];
        free(each->heights);
        free(each->centres);
        free(each->across);
        free(each->down);
        free(each->rows);
        free(each->split);
    }
    free(self->scratch);
}

static tl_status make_scratch(builder *self, tl_error *error)
{
    size_t side = (size_t)self->framework->block, frame = (size_t)framed(self->framework);
    self->scratch = calloc(self->workers, sizeof *self->scratch);
    for (unsigned i = 0; self->scratch && i < self->workers; i++) {
        scratch *each = &self->scratch[i];
        each->heights = calloc(frame * frame, sizeof(float)); /* beyond the rim all is read, but nothing used */
        each->split = malloc(frame * frame);
        each->centres = tl_alloc((side / 2 + 3) * (side / 2 + 3), sizeof(float));
        each->across = tl_alloc((side / 4 + 1) * (side / 4 + 1), sizeof(float));
        each->down = tl_alloc((side / 4 + 1) * (side / 4 + 1), sizeof(float));
        each->rows = malloc(tl_patch_scratch((int64_t)side));
        if (!each->heights || !each->split || !each->centres || !each->across || !each->down || !each->rows)
            return tl_fail_memory(error, "the framework");
    }
    return self->scratch ? TL_OK : tl_fail_memory(error, "the framework");
}

/* Copies vertices 0 ... width, 0 ... height from the DEM and mirrors one row and column around them. */
static void load_block(const builder *self, tl_patch *patch, float *heights)
{
    const float *from = self->heights + patch->y * self->width + patch->x;
    float *to = heights + patch->stride + 1;
    for (int64_t y = 0; y <= patch->height; y++, to += patch->stride, from += self->width) {
        memcpy(to, from, (size_t)(patch->width + 1) * sizeof *to);
        to[-1] = to[1];
        to[patch->width + 1] = to[patch->width - 1];
    }
    size_t bytes = (size_t)(patch->width + 3) * sizeof *to;
    memcpy(heights, heights + 2 * patch->stride, bytes);
    memcpy(heights + (patch->height + 2) * patch->stride, heights + patch->height * patch->stride, bytes);
    patch->heights = heights + patch->stride + 1;
}

/* Looks at a block's heights; *own_rounding becomes the rounding error within the block, 0 where there is none. */
static findings inspect_block(const tl_patch *patch, double *own_rounding, int block_log, int lattice_log)
{
    tl_heights of = {patch->heights, patch->stride, patch->width + 1, patch->height + 1};
    findings found = {.magnitude = tl_heights_magnitude(&of, &found.voids)};
    found.rounds = tl_heights_round(&of, found.magnitude, lattice_log);
    bool rounds = found.rounds && tl_heights_round(&of, found.magnitude, block_log);
    *own_rounding = rounds ? tl_plane_rounding((double)found.magnitude) : 0;
    return found;
}

/* Stores the marks: the block's own samples in the bitmap, its right column and bottom row, which belong to the next
 * blocks, beside it. The last column of the raster lies in a word of its own block then, or in one of no block. */
static void store_block(const builder *self, const tl_patch *patch, uint64_t block)
{
    tl_framework *framework = self->framework;
    int64_t side = framework->block;
    unsigned char *right = self->borders + block * 2 * (uint64_t)(side + 1), *bottom = right + side + 1;
    int64_t columns = tl_int64_min(side - 1, patch->rim_x) + 1, rows = tl_int64_min(side - 1, patch->rim_y) + 1;
    for (int64_t y = 0; y < rows; y++) {
        uint64_t *to = framework->split + (size_t)(patch->y + y) * framework->words + (patch->x >> 6);
        const unsigned char *from = patch->split + y * patch->split_stride;
        for (int64_t x = 0; x < columns; x += 64)
            to[x >> 6] = tl_pack_bits(from + x, tl_int64_min(64, columns - x));
    }
    for (int64_t i = 0; i <= side; i++) {
        right[i] = patch->rim_x >= side && i <= patch->rim_y ? patch->split[i * patch->split_stride + side] : 0;
        bottom[i] = patch->rim_y >= side && i <= patch->rim_x ? patch->split[side * patch->split_stride + i] : 0;
    }
}

/* What triangles' errors may reach on a lattice that is bent like this. */
static void fill_limits(const builder *self, const dem_bend *bend, double limit[TL_SIZES])
{
    const tl_framework *framework = self->framework;
    for (int size = 0; size < TL_SIZES; size++)
        limit[size] = framework->max_error;
    double unit = framework->info.georef.height_unit;
    for (int size = 1; size < TL_SIZES; size++) {
        if (framework->bends)
            limit[size] -= dem_bend_error(bend, ldexp(1, size + 1), self->rises[size]) / unit;
        limit[size] -= tl_rounding_error(&self->rounding, self->rises[size] / unit);
    }
}

static dem_bend set_limits(const builder *self, tl_patch *patch, unsigned worker)
{
    dem_bend bend = {0};
    if (self->framework->bends)
        bend = dem_space_bend(self->spaces[worker], (double)patch->x, (double)patch->y, (double)patch->width,
                              (double)patch->height, self->top);
    fill_limits(self, &bend, patch->limit);
    return bend;
}

static void decide_block(const tl_patch *patch, int64_t side, bool voids, void *rows)
{
    tl_patch_decide_samples(patch, voids, rows);
    for (int64_t s = 2; 2 * s <= side; s *= 2) {
        for (int64_t row = 0; row <= tl_patch_squares(patch->height, s); row++)
            tl_patch_decide_edges(patch, s, row);
        tl_patch_frame_centres(patch, s);
        for (int64_t row = 0; row < tl_patch_squares(patch->height, s); row++)
            tl_patch_decide_centres(patch, s, row);
    }
}

/* Where block (column, row) keeps its bound for the top. */
static size_t top_index(const tl_framework *framework, int64_t column, int64_t row)
{
    return (size_t)((row + 1) * tl_patch_centre_stride(framework->columns) + column + 1);
}

static tl_status run_block(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    builder *self = context;
    tl_framework *framework = self->framework;
    scratch *own = &self->scratch[worker];
    (void)loop;
    (void)error;
    int64_t column = (int64_t)item % framework->columns, row = (int64_t)item / framework->columns;
    int64_t side = framework->block, frame = framed(framework);
    tl_patch patch = {.stride = frame,
                      .split_stride = frame,
                      .split = own->split + frame + 1,
                      .x = column * side,
                      .y = row * side,
                      .centres = own->centres,
                      .across = own->across,
                      .down = own->down};
    patch.rim_x = self->width - 1 - patch.x;
    patch.rim_y = self->height - 1 - patch.y;
    patch.width = tl_int64_min(side, patch.rim_x);
    patch.height = tl_int64_min(side, patch.rim_y);
    load_block(self, &patch, own->heights);
    memset(own->split, 0, (size_t)(frame * frame));
    double rounding;
    int block_log = framework->lattice_log < TL_BLOCK_LOG ? framework->lattice_log : TL_BLOCK_LOG;
    self->found[item] = inspect_block(&patch, &rounding, block_log, framework->lattice_log);
    patch.careful = rounding > 0;
    patch.rounding = rounding;
    self->found[item].bend = set_limits(self, &patch, worker);
    if (side > 1)
        decide_block(&patch, side, self->found[item].voids, own->rows);
    store_block(self, &patch, item);
    if (side > 1) /* the one square that is left, behind its frame */
        self->centres[top_index(framework, column, row)] = own->centres[tl_patch_centre_stride(1) + 1];
    return TL_OK;
}

/* ---- Merging across the blocks' borders ------------------------------------------------------------ */

void tl_lattice_parents(int64_t x, int64_t y, int64_t out[2][2])
{
    int64_t s = (x | y) & -(x | y);
    if ((x & s) && (y & s)) {
        bool rising = ((x - s) / (2 * s) + (y - s) / (2 * s)) & 1;
        out[0][0] = x - s, out[0][1] = rising ? y - s : y + s;
        out[1][0] = x + s, out[1][1] = rising ? y + s : y - s;
    } else if (x & s) {
        out[0][0] = out[1][0] = x;
        out[0][1] = y - s, out[1][1] = y + s;
    } else {
        out[0][1] = out[1][1] = y;
        out[0][0] = x - s, out[1][0] = x + s;
    }
}

/* Marks the parents of a marked vertex, and theirs, up to those that are marked already; the top, the corners of
 * blocks, is decided later. What lies beyond the rim needs no mark: triangles that reach there are always split. */
static void force_parents(builder *self, int64_t x, int64_t y)
{
    tl_framework *framework = self->framework;
    int64_t stack[256][2], top_mask = framework->block - 1; /* each of at most 128 levels leaves one vertex behind */
    size_t depth = 1;
    stack[0][0] = x, stack[0][1] = y;
    while (depth) {
        depth--;
        int64_t up[2][2];
        tl_lattice_parents(stack[depth][0], stack[depth][1], up);
        for (int i = 0; i < 2; i++) {
            int64_t px = up[i][0], py = up[i][1];
            if (px < 0 || py < 0 || px >= self->width || py >= self->height || !((px | py) & top_mask) ||
                tl_bit(framework->split, framework->words, px, py))
                continue;
            tl_bit_set(framework->split, framework->words, px, py);
            stack[depth][0] = px, stack[depth++][1] = py;
        }
    }
}

static bool is_lattice_corner(const tl_framework *framework, int64_t x, int64_t y)
{
    return ((x | y) & ((INT64_C(1) << framework->lattice_log) - 1)) == 0;
}

/* Marks a vertex that is not yet; corners of the lattice split nothing. */
static bool mark_vertex(tl_framework *framework, int64_t x, int64_t y)
{
    if (x < 0 || y < 0 || x >= framework->info.width || y >= framework->info.height ||
        is_lattice_corner(framework, x, y) || tl_bit(framework->split, framework->words, x, y))
        return false;
    tl_bit_set(framework->split, framework->words, x, y);
    return true;
}

void tl_framework_force(tl_framework *framework, int64_t x, int64_t y)
{
    int64_t stack[256][2]; /* each of at most 128 levels leaves one vertex behind */
    size_t depth = 0;
    mark_vertex(framework, x, y); /* if it is already, its parents may still be missing */
    if (!is_lattice_corner(framework, x, y))
        stack[depth][0] = x, stack[depth++][1] = y;
    while (depth) {
        depth--;
        int64_t up[2][2];
        tl_lattice_parents(stack[depth][0], stack[depth][1], up);
        for (int i = 0; i < 2; i++)
            if (mark_vertex(framework, up[i][0], up[i][1]))
                stack[depth][0] = up[i][0], stack[depth++][1] = up[i][1];
    }
}

static void merge_borders(builder *self)
{
    tl_framework *framework = self->framework;
    int64_t side = framework->block;
    for (int64_t block = 0; block < framework->columns * framework->rows; block++) {
        int64_t x = block % framework->columns * side, y = block / framework->columns * side;
        const unsigned char *right = self->borders + block * 2 * (side + 1), *bottom = right + side + 1;
        for (int64_t i = 0; i <= side; i++) {
            if (right[i])
                tl_bit_set(framework->split, framework->words, x + side, y + i);
            if (bottom[i])
                tl_bit_set(framework->split, framework->words, x + i, y + side);
        }
    }
}

static void force_across_borders(builder *self)
{
    tl_framework *framework = self->framework;
    int64_t side = framework->block;
    for (int64_t y = side; y < self->height; y += side)
        for (int64_t x = 0; x < self->width; x++)
            if ((x & (side - 1)) && tl_bit(framework->split, framework->words, x, y))
                force_parents(self, x, y);
    for (int64_t x = side; x < self->width; x += side)
        for (int64_t y = 0; y < self->height; y++)
            if ((y & (side - 1)) && tl_bit(framework->split, framework->words, x, y))
                force_parents(self, x, y);
}

/* ---- The top: what is larger than a block ------------------------------------------------------------ */

typedef struct top_stage {
    const tl_patch *patch;
    int64_t s;
    void (*decide)(const tl_patch *, int64_t s, int64_t row);
} top_stage;

static tl_status run_top_row(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    const top_stage *stage = context;
    (void)loop;
    (void)worker;
    (void)error;
    stage->decide(stage->patch, stage->s, (int64_t)item);
    return TL_OK;
}

static tl_status decide_top(const builder *self, const tl_patch *patch, const tl_run *run, tl_error *error)
{
    tl_status status = TL_OK;
    int64_t lattice = INT64_C(1) << self->framework->lattice_log;
    for (int64_t s = self->framework->block; status == TL_OK && 2 * s <= lattice; s *= 2) {
        uint64_t rows = (uint64_t)tl_patch_squares(patch->height, s);
        top_stage stage = {patch, s, tl_patch_decide_edges};
        status = tl_parallel_for(run, rows + 1, 0, run_top_row, &stage, error);
        tl_patch_frame_centres(patch, s);
        stage.decide = tl_patch_decide_centres;
        if (status == TL_OK)
            status = tl_parallel_for(run, rows, 0, run_top_row, &stage, error);
    }
    return status;
}

/* The blocks' centres as the merge left them. */
static void seed_top(builder *self)
{
    tl_framework *framework = self->framework;
    int64_t side = framework->block;
    for (int64_t row = 0; row < framework->rows; row++)
        for (int64_t column = 0; column < framework->columns; column++) {
            int64_t x = column * side + side / 2, y = row * side + side / 2;
            if (x < self->width && y < self->height && tl_bit(framework->split, framework->words, x, y))
                self->centres[top_index(framework, column, row)] = INFINITY;
        }
}

static void store_top(builder *self, const tl_patch *patch)
{
    tl_framework *framework = self->framework;
    for (int64_t y = 0; y <= patch->height >> patch->split_log; y++)
        for (int64_t x = 0; x <= patch->width >> patch->split_log; x++)
            if (patch->split[y * patch->split_stride + x])
                tl_bit_set(framework->split, framework->words, x << patch->split_log, y << patch->split_log);
}

static tl_status run_top(builder *self, const tl_run *run, tl_error *error)
{
    tl_framework *framework = self->framework;
    tl_patch patch = {.heights = self->heights,
                      .stride = self->width,
                      .width = self->width - 1,
                      .height = self->height - 1,
                      .rim_x = self->width - 1,
                      .rim_y = self->height - 1,
                      .split_log = TL_BLOCK_LOG,
                      .centres = self->centres,
                      .careful = self->all.rounds};
    patch.rounding = self->all.rounds ? tl_plane_rounding((double)self->all.magnitude) : 0;
    fill_limits(self, &self->all.bend, patch.limit);
    patch.split_stride = (patch.width >> TL_BLOCK_LOG) + 1;
    int64_t columns = tl_patch_squares(patch.width, framework->block);
    int64_t rows = tl_patch_squares(patch.height, framework->block);
    patch.split = calloc((size_t)patch.split_stride, (size_t)(patch.height >> TL_BLOCK_LOG) + 1);
    patch.across = tl_alloc_grid(columns, rows + 1, sizeof *patch.across);
    patch.down = tl_alloc_grid(columns + 1, rows, sizeof *patch.down);
    tl_status status = TL_OK;
    if (!patch.split || !patch.across || !patch.down) {
        status = tl_fail_memory(error, "the framework");
    } else {
        seed_top(self);
        status = decide_top(self, &patch, run, error);
        store_top(self, &patch);
    }
    free(patch.split);
    free(patch.across);
    free(patch.down);
    return status;
}

/* ---- Building -------------------------------------------------------------------------------------- */

static void free_spaces(builder *self)
{
    for (unsigned i = 0; self->spaces && i < self->workers; i++)
        dem_space_destroy(self->spaces[i]);
    free(self->spaces);
}

static tl_status make_spaces(builder *self, tl_error *error)
{
    const tl_source_info *info = &self->framework->info;
    self->spaces = calloc(self->workers, sizeof(dem_space *));
    if (!self->spaces)
        return tl_fail_memory(error, "the framework");
    for (unsigned i = 0; i < self->workers; i++) {
        self->spaces[i] = dem_space_create(&info->georef, self->width, self->height, info->name, error);
        if (!self->spaces[i])
            return TL_ERROR_DATA;
    }
    return TL_OK;
}

/* What the limits of a frame that is bent or rounded are made of. A sample is shifted over a triangle's own slope or
 * that of the triangle on the other side of one of its edges, which is of the same size or of the next. */
static tl_status look_at_frame(builder *self, const tl_run *run, tl_error *error)
{
    const tl_framework *framework = self->framework;
    double own[TL_SIZES + 1] = {0}, unit = framework->info.georef.height_unit;
    tl_status status = framework->bends ? make_spaces(self, error) : TL_OK;
    if (status == TL_OK)
        status = tl_framework_rises(self->heights, self->width, self->height, framework->lattice_log, run, own, error);
    for (int size = 1; size < TL_SIZES; size++)
        self->rises[size] = unit * fmax(own[size], fmax(own[size - 1], own[size + 1]));
    float low = 0, top = 0; /* sea level is among the heights, as where a frame has its origin may be */
    for (int64_t i = 0; i < self->width * self->height; i++) {
        top = self->heights[i] > top ? self->heights[i] : top; /* false for a void */
        low = self->heights[i] < low ? self->heights[i] : low;
    }
    self->top = unit * (double)top;
    self->rounding.upright += self->rounding.of_range * ((double)top - (double)low);
    return status;
}

static tl_status decide_blocks(builder *self, const tl_run *run, tl_error *error)
{
    tl_framework *framework = self->framework;
    size_t blocks = (size_t)(framework->columns * framework->rows);
    size_t top = (size_t)tl_patch_centre_stride(framework->columns) * (size_t)tl_patch_centre_stride(framework->rows);
    self->found = calloc(blocks, sizeof *self->found);
    self->borders = tl_alloc(blocks, 2 * (size_t)(framework->block + 1));
    self->centres = tl_alloc(top, sizeof *self->centres);
    if (!self->found || !self->borders || !self->centres)
        return tl_fail_memory(error, "the framework");
    for (size_t i = 0; i < top; i++)
        self->centres[i] = -INFINITY;
    self->workers = tl_parallel_workers(run, blocks);
    tl_status status = make_scratch(self, error);
    if (status == TL_OK && (framework->bends || tl_rounds(&self->rounding)))
        status = look_at_frame(self, run, error);
    if (status == TL_OK)
        status = tl_parallel_for(run, blocks, (uint64_t)self->width * (uint64_t)self->height, run_block, self, error);
    for (size_t i = 0; status == TL_OK && i < blocks; i++) {
        if (self->found[i].magnitude > self->all.magnitude)
            self->all.magnitude = self->found[i].magnitude;
        self->all.voids |= self->found[i].voids;
        self->all.rounds |= self->found[i].rounds;
        self->all.bend = i ? dem_bend_worse(self->all.bend, self->found[i].bend) : self->found[i].bend;
    }
    return status;
}

static tl_status build(builder *self, const tl_run *run, tl_error *error)
{
    tl_framework *framework = self->framework;
    uint64_t samples = (uint64_t)self->width * (uint64_t)self->height;
    bool flat = !framework->columns || !framework->rows; /* one row or column: no triangles */
    phase reading = {run, 0, flat ? samples : 2 * samples}, deciding = {run, samples, 2 * samples}, rest = {run, 0, 0};
    tl_run run_reading = phase_run(&reading), run_deciding = phase_run(&deciding), run_rest = phase_run(&rest);
    tl_status fits = tl_run_fits(run, BYTES_A_SAMPLE * (double)samples, framework->info.name, "simplifying it", error);
    if (fits != TL_OK)
        return fits;
    self->heights = tl_alloc_grid(self->width, self->height, sizeof *self->heights);
    if (!self->heights)
        return tl_fail(error, TL_ERROR_MEMORY, "%s: not enough memory for its %lld x %lld samples",
                       framework->info.name, (long long)self->width, (long long)self->height);
    tl_status status = read_dem(self, &run_reading, error);
    if (status == TL_OK && !flat)
        status = decide_blocks(self, &run_deciding, error);
    if (status == TL_OK && !flat) {
        merge_borders(self);
        force_across_borders(self);
        if (framework->lattice_log > TL_BLOCK_LOG)
            status = run_top(self, &run_rest, error);
    }
    if (status == TL_OK && !flat)
        status = tl_features_force(self->features, framework, error);
    framework->voids = self->all.voids || flat;
    const tl_rows rows = {.all = self->heights};
    return status == TL_OK ? tl_framework_find_points(framework, &rows, &run_rest, error) : status;
}

/* A copy of the DEM's description that outlives it. */
static tl_status copy_info(tl_framework *framework, const tl_source_info *info, tl_error *error)
{
    framework->info = *info;
    tl_crs_retain(info->georef.crs);
    framework->info.name = strdup(info->name);
    framework->info.parameters = tl_parameters_copy(info->parameters, info->parameter_count);
    if (!framework->info.name || (info->parameter_count && !framework->info.parameters))
        return tl_fail_memory(error, "the framework");
    return TL_OK;
}

static tl_status lay_out(tl_framework *framework, tl_error *error)
{
    int64_t width = framework->info.width, height = framework->info.height;
    while ((INT64_C(1) << framework->lattice_log) < tl_int64_max(width, height) - 1)
        framework->lattice_log++;
    framework->block = tl_int64_min(TL_BLOCK, INT64_C(1) << framework->lattice_log);
    framework->columns = tl_div_up(width - 1, framework->block);
    framework->rows = tl_div_up(height - 1, framework->block);
    framework->words = (size_t)tl_div_up(width, 64);
    size_t words;
    if (tl_size_mul(framework->words, (size_t)height, &words)) {
        framework->split = calloc(words, sizeof *framework->split);
        framework->points = calloc(words, sizeof *framework->points);
    }
    return framework->split && framework->points ? TL_OK : tl_fail_memory(error, "the framework");
}

static tl_status check(const tl_source_info *info, double max_error, tl_error *error)
{
    if (!(max_error >= 0 && max_error <= DBL_MAX))
        return tl_fail(error, TL_ERROR_ARGUMENT, "max_error %g: must be a finite number, 0 or larger", max_error);
    if (info->width > INT32_MAX || info->height > INT32_MAX)
        return tl_fail(error, TL_ERROR_DATA, "%s: %lld x %lld samples, more than 2^31 - 1 on a side; cut it in parts",
                       info->name, (long long)info->width, (long long)info->height);
    return TL_OK;
}

tl_framework *tl_framework_create(const tl_source_info *info, double max_error, const tl_run *run, tl_error *error)
{
    if (check(info, max_error, error) != TL_OK)
        return NULL;
    tl_framework *framework = calloc(1, sizeof *framework);
    if (!framework) {
        tl_fail_memory(error, "the framework");
        return NULL;
    }
    framework->max_error = max_error;
    framework->threads = run ? run->threads : 0;
    framework->memory = run ? run->memory : 0;
    if (copy_info(framework, info, error) == TL_OK && lay_out(framework, error) == TL_OK)
        return framework;
    tl_framework_destroy(framework);
    return NULL;
}

tl_framework *tl_framework_build(const tl_source *dem, const tl_framework_options *options, tl_error *error)
{
    tl_framework *framework = tl_framework_create(&dem->info, options->max_error, options->run, error);
    if (!framework)
        return NULL;
    framework->bends = dem_frame_bends(&dem->info.georef, options->frame);
    builder self = {.framework = framework,
                    .dem = dem,
                    .width = dem->info.width,
                    .height = dem->info.height,
                    .rounding = options->rounding,
                    .features = options->features};
    tl_status status = build(&self, options->run, error);
    free(self.heights);
    free(self.found);
    free(self.borders);
    free(self.centres);
    free_scratch(&self);
    free_spaces(&self);
    if (status == TL_OK)
        return framework;
    tl_framework_destroy(framework);
    return NULL;
}

void tl_framework_destroy(tl_framework *framework)
{
    if (!framework)
        return;
    tl_crs_release(framework->info.georef.crs);
    free((char *)framework->info.name);
    free((tl_parameter *)framework->info.parameters);
    free(framework->split);
    free(framework->points);
    free(framework->rank);
    free(framework->ties);
    free(framework->heights);
    free(framework);
}
