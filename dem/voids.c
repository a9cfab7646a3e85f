/* Voids filled. Holes are told apart by blocks: those that hold voids and touch each other are one group, and each
 * group is solved by itself, over its bounding box. What is filled is kept by block. */
#include "dem/membrane.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

enum {
    BLOCK = 64,
    SCAN = 8,        /* blocks on a side of a work item of the first pass */
    LARGE = 1 << 20, /* samples of a box from which on all threads work on one */
    BOX_BYTES = 21, /* a sample of a box takes while it is solved: two copies here, and in the membrane one, an unknown,
                       a right-hand side, a flag, and a third of five arrays for the coarser levels */
};

/* Blocks that hold voids and touch by a side, and all that a hole among them can see. */
typedef struct group {
    int64_t i0, j0, i1, j1; /* blocks, the last ones excluded */
    uint32_t label;
} group;

typedef struct void_source {
    tl_source source;
    const tl_source *original;
    tl_void_options options;
    int64_t columns, rows; /* of blocks */
    float **filled; /* by block; NULL: nothing filled there. [BLOCK * BLOCK] heights, NaN where the source has one */
    tl_parameter *parameters;
} void_source;

/* ---- reading ---- */

/* The original's heights, with what is declared here as nodata made void. */
static tl_status read_original(const void_source *v, int level, tl_window window, float *out, tl_error *error)
{
    tl_status status = tl_source_read(v->original, level, window, out, error);
    if (status == TL_OK && v->options.nodata_given)
        for (int64_t k = 0; k < window.width * window.height; k++)
            if (out[k] == v->options.nodata)
                out[k] = NAN;
    return status;
}

static const float *block_at(const void_source *v, int64_t x, int64_t y)
{
    return v->filled ? v->filled[y / BLOCK * v->columns + x / BLOCK] : NULL;
}

/* The height that stands for the void at (x, y); NaN where it stays one. */
static float fill_at(const void_source *v, int64_t x, int64_t y)
{
    if (v->options.rule == TL_VOIDS_VALUE)
        return v->options.value;
    const float *block = block_at(v, x, y);
    return block ? block[y % BLOCK * BLOCK + x % BLOCK] : NAN;
}

static tl_status void_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const void_source *v = (const void_source *)self;
    tl_status status = read_original(v, level, window, out, error);
    for (int64_t k = 0; status == TL_OK && k < window.width * window.height; k++)
        if (isnan(out[k]))
            out[k] = fill_at(v, window.x + k % window.width, window.y + k / window.width);
    return status;
}

/* Marks as void what is declared here as nodata. */
static tl_status drop_nodata(const void_source *v, int level, tl_window window, unsigned char *validity,
                             tl_error *error)
{
    float *heights = tl_alloc_grid(window.width, window.height, sizeof *heights);
    if (!heights)
        return tl_fail_memory(error, v->source.info.name);
    tl_status status = read_original(v, level, window, heights, error);
    for (int64_t k = 0; status == TL_OK && k < window.width * window.height; k++)
        if (isnan(heights[k]))
            validity[k] = TL_VOID;
    free(heights);
    return status;
}

static tl_status void_validity(const tl_source *self, int level, tl_window window, unsigned char *out, tl_error *error)
{
    const void_source *v = (const void_source *)self;
    tl_status status = tl_source_validity(v->original, level, window, out, error);
    if (status == TL_OK && v->options.nodata_given)
        status = drop_nodata(v, level, window, out, error);
    for (int64_t k = 0; status == TL_OK && k < window.width * window.height; k++)
        if (out[k] == TL_VOID && !isnan(fill_at(v, window.x + k % window.width, window.y + k / window.width)))
            out[k] = TL_FILLED;
    return status;
}

static void void_destroy(tl_source *self)
{
    void_source *v = (void_source *)self;
    for (int64_t b = 0; v->filled && b < v->columns * v->rows; b++)
        free(v->filled[b]);
    free(v->filled);
    free(v->parameters);
    free(v);
}

/* ---- the first pass: which blocks hold voids ---- */

typedef struct scan {
    const void_source *v;
    unsigned char *has_void; /* by block */
    unsigned char *has_valid;
} scan;

static void look_at(const scan *s, tl_window window, const float *heights)
{
    for (int64_t y = 0; y < window.height; y++)
        for (int64_t x = 0; x < window.width; x++) {
            int64_t b = (window.y + y) / BLOCK * s->v->columns + (window.x + x) / BLOCK;
            if (isnan(heights[y * window.width + x]))
                s->has_void[b] = 1;
            else
                s->has_valid[b] = 1;
        }
}

static tl_status scan_blocks(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const scan *s = context;
    const tl_source_info *info = &s->v->source.info;
    int64_t across = tl_div_up(s->v->columns, SCAN), side = SCAN * BLOCK;
    int64_t x = (int64_t)item % across * side, y = (int64_t)item / across * side;
    tl_window window = {x, y, tl_int64_min(side, info->width - x), tl_int64_min(side, info->height - y)};
    float *heights = tl_alloc_grid(window.width, window.height, sizeof *heights);
    if (!heights)
        return tl_fail_memory(error, info->name);
    tl_status status = read_original(s->v, info->level, window, heights, error);
    if (status == TL_OK)
        look_at(s, window, heights);
    free(heights);
    return status;
}

/* ---- groups ---- */

static uint32_t root_of(uint32_t *parent, uint32_t k)
{
    while (parent[k] != k) {
        parent[k] = parent[parent[k]];
        k = parent[k];
    }
    return k;
}

static void join(uint32_t *parent, uint32_t a, uint32_t b)
{
    a = root_of(parent, a);
    b = root_of(parent, b);
    if (a < b)
        parent[b] = a;
    else
        parent[a] = b;
}

/* labels[b]: the first block of b's group; b itself where it holds no void. */
static void label_blocks(const void_source *v, const unsigned char *has_void, uint32_t *labels)
{
    uint32_t count = (uint32_t)(v->columns * v->rows), columns = (uint32_t)v->columns;
    for (uint32_t b = 0; b < count; b++)
        labels[b] = b;
    for (uint32_t b = 0; b < count; b++) {
        if (!has_void[b])
            continue;
        uint32_t right = b % columns + 1 < columns ? b + 1 : v->source.info.wraps ? b + 1 - columns : b;
        if (has_void[right])
            join(labels, b, right);
        if (b + columns < count && has_void[b + columns])
            join(labels, b, b + columns);
    }
    for (uint32_t b = 0; b < count; b++)
        labels[b] = root_of(labels, b);
}

/* The groups in the order of their first blocks; groups[] has room for one a block with voids. How many there are. */
static size_t collect_groups(const void_source *v, const unsigned char *has_void, const uint32_t *labels,
                             uint32_t *index, group *groups)
{
    size_t count = 0;
    for (int64_t b = 0; b < v->columns * v->rows; b++) {
        if (!has_void[b])
            continue;
        int64_t i = b % v->columns, j = b / v->columns;
        if (labels[b] == b) {
            index[b] = (uint32_t)count;
            groups[count++] = (group){i, j, i, j, labels[b]};
        }
        group *g = &groups[index[labels[b]]];
        g->i0 = tl_int64_min(g->i0, i);
        g->i1 = tl_int64_max(g->i1, i + 1);
        g->j1 = tl_int64_max(g->j1, j + 1);
    }
    return count;
}

/* ---- solving ---- */

typedef struct filling {
    void_source *v;
    const unsigned char *has_void;
    const uint32_t *labels;
    const group *groups;
    const tl_run *inner; /* for the solver */
} filling;

static bool is_of_group(const filling *f, const group *g, int64_t block)
{
    return f->has_void[block] && f->labels[block] == g->label;
}

/* Where the columns of blocks of a group begin and how many there are, around the globe: behind the longest run of
 * columns without it. */
static void columns_around(const filling *f, const group *g, int64_t *first, int64_t *count)
{
    int64_t columns = f->v->columns, gap = 0, longest = 0;
    *first = 0;
    for (int64_t step = 0; step < 2 * columns; step++) {
        int64_t i = step % columns;
        bool used = false;
        for (int64_t j = g->j0; j < g->j1 && !used; j++)
            used = is_of_group(f, g, j * columns + i);
        if (used && gap > longest) {
            longest = gap;
            *first = i;
        }
        gap = used ? 0 : gap + 1;
    }
    *count = columns - longest;
}

/* The samples of a group and one more around, cut at the raster's rim. Around the globe the columns are counted on:
 * they begin at -1 or later, and may go beyond the last one. */
static tl_window box_of(const filling *f, const group *g)
{
    const tl_source_info *info = &f->v->source.info;
    int64_t y0 = tl_int64_max(g->j0 * BLOCK - 1, 0), y1 = tl_int64_min(g->j1 * BLOCK + 1, info->height);
    int64_t x0 = tl_int64_max(g->i0 * BLOCK - 1, 0), x1 = tl_int64_min(g->i1 * BLOCK + 1, info->width);
    if (info->wraps) {
        int64_t first, count, last;
        columns_around(f, g, &first, &count);
        last = first + count; /* excluded; the raster's last column of blocks may be narrower */
        x0 = first * BLOCK - 1;
        x1 = (last > f->v->columns ? info->width + (last - f->v->columns) * BLOCK
                                   : tl_int64_min(last * BLOCK, info->width)) +
             1;
        if (x1 - x0 >= info->width) { /* all around: the seam is cut */
            x0 = 0;
            x1 = info->width;
        }
    }
    return (tl_window){x0, y0, x1 - x0, y1 - y0};
}

static int64_t modulo(int64_t x, int64_t width)
{
    int64_t rest = x % width;
    return rest < 0 ? rest + width : rest;
}

static bool belongs(const filling *f, const group *g, int64_t x, int64_t y)
{
    return is_of_group(f, g, y / BLOCK * f->v->columns + modulo(x, f->v->source.info.width) / BLOCK);
}

/* Voids of other groups in the box get a height, so that nothing is solved there; no void of this group touches them.
 */
static void hide_others(const filling *f, const group *g, tl_window box, float *heights)
{
    float known = 0;
    for (int64_t k = box.width * box.height; k-- > 0;)
        if (!isnan(heights[k]))
            known = heights[k];
    for (int64_t k = 0; k < box.width * box.height; k++)
        if (isnan(heights[k]) && !belongs(f, g, box.x + k % box.width, box.y + k / box.width))
            heights[k] = known;
}

static tl_status keep_block(const filling *f, int64_t b, tl_window box, const float *before, const float *after,
                            tl_error *error)
{
    void_source *v = f->v;
    int64_t x0 = b % v->columns * BLOCK, y0 = b / v->columns * BLOCK;
    int64_t x1 = tl_int64_min(x0 + BLOCK, v->source.info.width), y1 = tl_int64_min(y0 + BLOCK, v->source.info.height);
    float *kept = tl_alloc(BLOCK * BLOCK, sizeof *kept);
    if (!kept)
        return tl_fail_memory(error, v->source.info.name);
    for (int k = 0; k < BLOCK * BLOCK; k++)
        kept[k] = NAN;
    for (int64_t y = y0; y < y1; y++)
        for (int64_t x = x0; x < x1; x++) {
            int64_t k = (y - box.y) * box.width + modulo(x - box.x, v->source.info.width);
            if (isnan(before[k]))
                kept[(y - y0) * BLOCK + x - x0] = after[k];
        }
    v->filled[b] = kept;
    return TL_OK;
}

static tl_status keep_group(const filling *f, const group *g, tl_window box, const float *before, const float *after,
                            tl_error *error)
{
    tl_status status = TL_OK;
    for (int64_t j = g->j0; j < g->j1; j++)
        for (int64_t i = g->i0; i < g->i1 && status == TL_OK; i++) {
            int64_t b = j * f->v->columns + i;
            if (is_of_group(f, g, b))
                status = keep_block(f, b, box, before, after, error);
        }
    return status;
}

/* Reads a band of a box whose columns may go around. */
static tl_status read_band(const void_source *v, tl_window band, float *out, tl_error *error)
{
    int64_t width = v->source.info.width;
    for (int64_t done = 0; done < band.width;) {
        int64_t x = modulo(band.x + done, width), part = tl_int64_min(band.width - done, width - x);
        tl_window window = {x, band.y, part, band.height};
        float *heights = part == band.width ? out : tl_alloc_grid(part, band.height, sizeof *heights);
        if (!heights)
            return tl_fail_memory(error, v->source.info.name);
        tl_status status = read_original(v, v->source.info.level, window, heights, error);
        for (int64_t y = 0; heights != out && status == TL_OK && y < band.height; y++)
            memcpy(out + y * band.width + done, heights + y * part, (size_t)part * sizeof *out);
        if (heights != out)
            free(heights);
        if (status != TL_OK)
            return status;
        done += part;
    }
    return TL_OK;
}

static tl_status read_box(const void_source *v, tl_window box, float *out, tl_error *error)
{
    for (int64_t y = 0; y < box.height; y += BLOCK) { /* so that the reader's cache is not asked for a whole raster */
        tl_window band = {box.x, box.y + y, box.width, tl_int64_min(BLOCK, box.height - y)};
        tl_status status = read_band(v, band, out + y * box.width, error);
        if (status != TL_OK)
            return status;
    }
    return TL_OK;
}

static tl_status fill_group(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const filling *f = context;
    const group *g = &f->groups[item];
    tl_window box = box_of(f, g);
    float *before = tl_alloc_grid(box.width, box.height, sizeof *before);
    float *after = tl_alloc_grid(box.width, box.height, sizeof *after);
    tl_status status = before && after ? read_box(f->v, box, before, error) : tl_fail_memory(error, "filling voids");
    if (status == TL_OK) {
        memcpy(after, before, (size_t)(box.width * box.height) * sizeof *after);
        hide_others(f, g, box, after);
        status = dem_membrane_fill(after, box.width, box.height, f->inner, error);
    }
    if (status == TL_OK)
        status = keep_group(f, g, box, before, after, error);
    free(before);
    free(after);
    return status;
}

/* The most samples that a box of the groups has, of all and of those that are solved side by side. */
static void largest_boxes(const filling *f, const group *groups, size_t count, int64_t *all, int64_t *small)
{
    *all = *small = 0;
    for (size_t k = 0; k < count; k++) {
        tl_window box = box_of(f, &groups[k]);
        int64_t samples = box.width * box.height;
        *all = tl_int64_max(*all, samples);
        if (samples < LARGE)
            *small = tl_int64_max(*small, samples);
    }
}

/* Fewer threads where there is no memory for one small box each. */
static unsigned threads_for(const tl_run *run, double kept, int64_t small)
{
    unsigned threads = tl_parallel_workers(run, UINT64_MAX);
    if (!run || !run->memory || !small)
        return threads;
    double fit = ((double)run->memory - kept) / ((double)small * BOX_BYTES);
    return fit < 1 ? 1 : fit < threads ? (unsigned)fit : threads;
}

/* Large groups one after the other, each by all threads; the small ones side by side. */
static tl_status fill_groups(const filling *f, group *groups, size_t count, size_t void_blocks, const tl_run *run,
                             tl_error *error)
{
    size_t small = 0;
    int64_t largest, largest_small;
    double kept = (double)void_blocks * BLOCK * BLOCK * sizeof(float);
    largest_boxes(f, groups, count, &largest, &largest_small);
    tl_status fits =
        tl_run_fits(run, (double)largest * BOX_BYTES + kept, f->v->source.info.name, "filling its voids", error);
    if (fits != TL_OK)
        return fits;
    for (size_t k = 0; k < count; k++) {
        tl_window box = box_of(f, &groups[k]);
        if (box.width * box.height < LARGE) {
            groups[small++] = groups[k];
            continue;
        }
        filling one = *f;
        one.groups = &groups[k];
        one.inner = run;
        tl_status status = fill_group(&one, NULL, 0, 0, error);
        if (status != TL_OK)
            return status;
    }
    tl_run quiet = {.threads = 1, .cancel = run ? run->cancel : NULL};
    tl_run outer = {.threads = threads_for(run, kept, largest_small), .cancel = quiet.cancel};
    filling rest = *f;
    rest.groups = groups;
    rest.inner = &quiet;
    return tl_parallel_for(&outer, small, 0, fill_group, &rest, error);
}

static tl_status solve(void_source *v, const unsigned char *has_void, size_t void_blocks, const tl_run *run,
                       tl_error *error)
{
    size_t blocks = (size_t)(v->columns * v->rows);
    uint32_t *labels = tl_alloc(blocks, sizeof *labels), *index = tl_alloc(blocks, sizeof *index);
    group *groups = tl_alloc(void_blocks, sizeof *groups);
    tl_status status = TL_OK;
    if (!labels || !index || !groups)
        status = tl_fail_memory(error, v->source.info.name);
    else {
        label_blocks(v, has_void, labels);
        size_t count = collect_groups(v, has_void, labels, index, groups);
        filling f = {.v = v, .has_void = has_void, .labels = labels};
        status = fill_groups(&f, groups, count, void_blocks, run, error);
    }
    free(labels);
    free(index);
    free(groups);
    return status;
}

static tl_status fill(void_source *v, const tl_run *run, tl_error *error)
{
    size_t blocks = (size_t)(v->columns * v->rows), void_blocks = 0;
    bool any_valid = false;
    scan s = {.v = v, .has_void = calloc(blocks, 1), .has_valid = calloc(blocks, 1)};
    v->filled = calloc(blocks, sizeof *v->filled);
    tl_status status = s.has_void && s.has_valid && v->filled ? TL_OK : tl_fail_memory(error, v->source.info.name);
    uint64_t items = (uint64_t)(tl_div_up(v->columns, SCAN) * tl_div_up(v->rows, SCAN));
    if (status == TL_OK)
        status = tl_parallel_for(run, items, (uint64_t)v->source.info.width * (uint64_t)v->source.info.height,
                                 scan_blocks, &s, error);
    for (size_t b = 0; status == TL_OK && b < blocks; b++) {
        void_blocks += s.has_void[b];
        any_valid |= s.has_valid[b];
    }
    if (status == TL_OK && void_blocks && any_valid)
        status = solve(v, s.has_void, void_blocks, run, error);
    v->source.info.has_voids = !any_valid;
    free(s.has_void);
    free(s.has_valid);
    return status;
}

static tl_status note_options(void_source *v, tl_error *error)
{
    tl_source_info *info = &v->source.info;
    char number[TL_NUMBER_TEXT];
    v->parameters = tl_parameters_copy(info->parameters, info->parameter_count);
    tl_status status = info->parameter_count && !v->parameters ? tl_fail_memory(error, info->name) : TL_OK;
    tl_number_text((double)v->options.nodata, number);
    if (status == TL_OK && v->options.nodata_given)
        status = tl_parameters_add(&v->parameters, &info->parameter_count, "nodata", number, error);
    tl_number_text((double)v->options.value, number);
    if (status == TL_OK && v->options.rule != TL_VOIDS_KEEP)
        status = tl_parameters_add(&v->parameters, &info->parameter_count, "voids",
                                   v->options.rule == TL_VOIDS_FILL ? "fill" : number, error);
    info->parameters = v->parameters;
    return status;
}

tl_source *tl_voids_create(const tl_source *source, const tl_void_options *options, tl_error *error)
{
    static const tl_void_options defaults;
    const tl_void_options *o = options ? options : &defaults;
    if (o->rule == TL_VOIDS_VALUE && !isfinite(o->value)) {
        tl_fail(error, TL_ERROR_ARGUMENT, "%s: voids cannot be given the height %g", source->info.name,
                (double)o->value);
        return NULL;
    }
    int64_t columns = tl_div_up(source->info.width, BLOCK), rows = tl_div_up(source->info.height, BLOCK);
    if (columns > UINT32_MAX / rows) {
        tl_fail(error, TL_ERROR_ARGUMENT, "%s: the raster is too large for its voids to be filled", source->info.name);
        return NULL;
    }
    void_source *v = calloc(1, sizeof *v);
    if (!v) {
        tl_fail_memory(error, source->info.name);
        return NULL;
    }
    *v = (void_source){
        .source = {.info = source->info, .read = void_read, .validity = void_validity, .destroy = void_destroy},
        .original = source,
        .options = *o,
        .columns = columns,
        .rows = rows};
    if (o->rule != TL_VOIDS_KEEP)
        v->source.info.quantum = 0; /* what is filled in is no multiple of it */
    v->source.info.has_voids = o->rule != TL_VOIDS_VALUE && (source->info.has_voids || o->nodata_given);
    tl_status status = note_options(v, error);
    if (status == TL_OK && o->rule == TL_VOIDS_FILL)
        status = fill(v, o->run, error);
    if (status == TL_OK)
        return &v->source;
    void_destroy(&v->source);
    return NULL;
}
