/* A window is made in blocks. Each goes through the layers of the plan, the finest first: heights of the first are
 * copied, those of the others are interpolated from a block of the layer's own lattice, which is made in the same way.
 *
 * Hard joins: a sample that has a height keeps it. Feathered ones: the k-th member that has one counts with weight w_k
 * times (1 - w) of all before it, where w rises from the member's rim inwards and is 1 from 32 samples on. So the first
 * alone counts where it is deep inside, nothing jumps at the rim of any, and where two overlap by less than 32 samples
 * the change takes all of the overlap.
 *
 * A coarser level is made from the finest, but for one that every file holds a reduced copy of, with its cells on those
 * of the mosaic: there blocks of that level are put together in the same way. */
#include "dem/mosaic.h"

#include "dem/crs.h"
#include "dem/levels.h"
#include "dem/mosaic_plan.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

enum { BLOCK_COLUMNS = 4096, BLOCK_SAMPLES = 1 << 18, FEATHER = 32 };

typedef struct mosaic {
    tl_source source;
    tl_source **members;
    size_t count;
    dem_plan plan;
    dem_file_pool *pool;
    dem_block_cache *cache;
    struct first_place {
        size_t layer, placement;
    } * places; /* of each member: the first that it has */
    bool feather;
    uint64_t reduced; /* bit k: level -k can be put together from the members' own */
    char *name;
} mosaic;

/* ---- A block ---- */

/* What feathered heights are made of. */
typedef struct mix {
    double sum, weight, rest; /* of w * rest * height, of w * rest; the product of all 1 - w */
    int count;
} mix;

/* A block of a lattice that fills up with heights. */
typedef struct canvas {
    const mosaic *owner;
    int halvings; /* the block is one of level -halvings; all that is said of places is at the finest one */
    tl_window window;
    float *heights, *own; /* the second is freed with it */
    int64_t missing;      /* samples without a height */
    mix *mixes;           /* feathered joins only */
    float *part;          /* room for what a member gives; NULL until it is needed */
    dem_hits hits;
} canvas;

static int64_t area_of(tl_window window)
{
    return window.width * window.height;
}

static void canvas_finish(canvas *c)
{
    free(c->own);
    free(c->mixes);
    free(c->part);
    free(c->hits.numbers);
}

/* `heights` is room for the window's heights; NULL: the canvas has its own. */
static tl_status canvas_init(canvas *c, const mosaic *owner, tl_window window, float *heights, tl_error *error)
{
    *c = (canvas){.owner = owner, .window = window, .heights = heights, .missing = area_of(window)};
    if (!heights)
        c->heights = c->own = tl_alloc_grid(window.width, window.height, sizeof *c->own);
    if (owner->feather)
        c->mixes = tl_alloc_grid(window.width, window.height, sizeof *c->mixes);
    if (!c->heights || (owner->feather && !c->mixes)) {
        canvas_finish(c);
        return tl_fail_memory(error, owner->name);
    }
    for (int64_t k = 0; k < c->missing; k++)
        c->heights[k] = NAN;
    for (int64_t k = 0; c->mixes && k < c->missing; k++)
        c->mixes[k] = (mix){.rest = 1};
    return TL_OK;
}

static int64_t index_in(const canvas *c, int64_t x, int64_t y)
{
    return (y - c->window.y) * c->window.width + x - c->window.x;
}

/* Whether more members can change anything in this part. */
static bool wants(const canvas *c, tl_window part)
{
    if (c->mixes)
        return true;
    if (c->missing == area_of(c->window))
        return true;
    for (int64_t y = part.y; c->missing && y < part.y + part.height; y++)
        for (int64_t x = part.x; x < part.x + part.width; x++)
            if (isnan(c->heights[index_in(c, x, y)]))
                return true;
    return false;
}

/* Offers a height for a sample, with the weight that it has in feathered joins. */
static inline void offer(canvas *c, int64_t at, float height, double weight)
{
    if (isnan(height))
        return;
    bool first = isnan(c->heights[at]);
    if (first) {
        c->heights[at] = height;
        c->missing--;
    }
    if (!c->mixes)
        return;
    mix *m = &c->mixes[at];
    m->sum += weight * m->rest * (double)height;
    m->weight += weight * m->rest;
    m->rest *= 1 - weight;
    m->count++;
}

/* A height that only one member gave is its own, to the bit. */
static void settle(canvas *c)
{
    for (int64_t k = 0; c->mixes && k < area_of(c->window); k++)
        if (c->mixes[k].count > 1)
            c->heights[k] = (float)(c->mixes[k].sum / c->mixes[k].weight);
}

/* ---- Members on the block's own lattice ---- */

/* The weight falls to 0 at the first sample outside of the member. */
static double rim_weight(tl_window place, int64_t x, int64_t y)
{
    int64_t left = x - place.x, right = place.x + place.width - 1 - x;
    int64_t above = y - place.y, below = place.y + place.height - 1 - y;
    int64_t rim = tl_int64_min(tl_int64_min(left, right), tl_int64_min(above, below));
    return rim >= FEATHER ? 1 : (double)(rim + 1) / (FEATHER + 1);
}

/* Where a member lies at the canvas's level; at coarser ones members begin with a cell. */
static tl_window place_on(const canvas *c, const dem_placement *p)
{
    tl_window place = p->place;
    int64_t right = place.x + place.width - 1, bottom = place.y + place.height - 1;
    place.x >>= c->halvings;
    place.y >>= c->halvings;
    place.width = (right >> c->halvings) - place.x + 1;
    place.height = (bottom >> c->halvings) - place.y + 1;
    return place;
}

/* The member's own window for a part of its place. */
static tl_window own_window(const dem_placement *p, tl_window place, tl_window part)
{
    tl_window own = {part.x - place.x, part.y - place.y, part.width, part.height};
    if (p->mirror_x)
        own.x = place.width - own.x - own.width;
    if (p->mirror_y)
        own.y = place.height - own.y - own.height;
    return own;
}

static void merge_part(canvas *c, const dem_placement *p, tl_window part)
{
    for (int64_t row = 0; row < part.height; row++) {
        int64_t from = (p->mirror_y ? part.height - 1 - row : row) * part.width;
        int64_t at = index_in(c, part.x, part.y + row);
        for (int64_t k = 0; k < part.width; k++) {
            float height = c->part[from + (p->mirror_x ? part.width - 1 - k : k)];
            offer(c, at + k, height, c->mixes ? rim_weight(p->place, part.x + k, part.y + row) : 1);
        }
    }
}

static int64_t count_voids(const float *heights, int64_t count)
{
    int64_t voids = 0;
    for (int64_t k = 0; k < count; k++)
        voids += isnan(heights[k]) != 0;
    return voids;
}

static tl_status paste_member(canvas *c, const dem_placement *p, tl_error *error)
{
    tl_window place = place_on(c, p), part = dem_window_common(place, c->window);
    if (dem_window_empty(part) || !wants(c, part))
        return TL_OK;
    bool direct =
        !c->mixes && !p->mirror_x && !p->mirror_y && c->missing == area_of(part) && area_of(part) == area_of(c->window);
    if (!direct && !c->part)
        c->part = tl_alloc_grid(c->window.width, c->window.height, sizeof *c->part);
    if (!direct && !c->part)
        return tl_fail_memory(error, c->owner->name);
    tl_status status =
        tl_source_read(p->source, -c->halvings, own_window(p, place, part), direct ? c->heights : c->part, error);
    if (status != TL_OK)
        return status;
    if (direct)
        c->missing = count_voids(c->heights, c->missing);
    else
        merge_part(c, p, part);
    return TL_OK;
}

/* The samples of the finest level under a window. */
static tl_window at_finest(const canvas *c, tl_window window)
{
    const int64_t step = INT64_C(1) << c->halvings; /* windows may begin before the first sample */
    return (tl_window){window.x * step, window.y * step, window.width * step, window.height * step};
}

static tl_status paste_layer(canvas *c, const dem_layer *layer, tl_error *error)
{
    if (!dem_bins_find(layer->bins, at_finest(c, c->window), &c->hits))
        return tl_fail_memory(error, c->owner->name);
    for (size_t k = 0; k < c->hits.count && (c->mixes || c->missing); k++) {
        tl_status status = paste_member(c, &layer->placements[c->hits.numbers[k]], error);
        if (status != TL_OK)
            return status;
    }
    return TL_OK;
}

/* ---- Members on other lattices ---- */

/* A place between samples of a lattice: the nearest sample, its neighbour on the other side, and that one's weight, 0
 * ... 1/2. */
typedef struct between {
    int64_t near, far;
    double weight;
} between;

static between split(double position)
{
    const double rounding = 1e-6;
    double low = floor(position), part = position - low;
    int64_t i = (int64_t)low;
    if (part < rounding)
        return (between){i, i, 0};
    if (part > 1 - rounding)
        return (between){i + 1, i + 1, 0};
    return part < 0.5 - rounding ? (between){i, i + 1, part} : (between){i + 1, i, 1 - part};
}

/* A block of the layer's lattice, and which of its samples a member covers. */
typedef struct layer_block {
    canvas canvas;
    unsigned char *known; /* areas only: elsewhere what has no height is not known */
} layer_block;

typedef struct corner {
    enum { ABSENT, VOID, HEIGHT } state;
    double height, weight;
} corner;

static corner corner_at(const layer_block *b, int64_t x, int64_t y)
{
    const canvas *c = &b->canvas;
    tl_window w = c->window;
    if (x < w.x || y < w.y || x >= w.x + w.width || y >= w.y + w.height)
        return (corner){.state = ABSENT};
    int64_t at = index_in(c, x, y);
    if (isnan(c->heights[at]))
        return (corner){.state = b->known && !b->known[at] ? ABSENT : VOID};
    return (corner){HEIGHT, (double)c->heights[at], c->mixes ? 1 - c->mixes[at].rest : 1};
}

/* Bilinear, where all samples that count are known. Only the outer half of an area's outermost cells has no samples
 * beyond it: there the cell's own height goes on. */
static float interpolate(const layer_block *b, const between *x, const between *y, double *weight)
{
    corner p = corner_at(b, x->near, y->near);
    if (p.state != HEIGHT)
        return NAN;
    corner a = x->weight > 0 ? corner_at(b, x->far, y->near) : p;
    corner q = y->weight > 0 ? corner_at(b, x->near, y->far) : p;
    corner d = x->weight > 0 && y->weight > 0 ? corner_at(b, x->far, y->far) : x->weight > 0 ? a : q;
    if (b->known && d.state == ABSENT)
        d = a.state == HEIGHT ? a : q.state == HEIGHT ? q : p;
    if (b->known && a.state == ABSENT)
        a = p;
    if (b->known && q.state == ABSENT)
        q = p;
    if (a.state != HEIGHT || q.state != HEIGHT || d.state != HEIGHT)
        return NAN;
    double u = x->weight, v = y->weight;
    *weight = (1 - v) * ((1 - u) * p.weight + u * a.weight) + v * ((1 - u) * q.weight + u * d.weight);
    return (float)((1 - v) * ((1 - u) * p.height + u * a.height) + v * ((1 - u) * q.height + u * d.height));
}

/* Marks what the members of the hits cover. */
static void mark_known(layer_block *b, const dem_layer *layer)
{
    const canvas *c = &b->canvas;
    memset(b->known, 0, (size_t)area_of(c->window));
    for (size_t k = 0; k < c->hits.count; k++) {
        tl_window part = dem_window_common(layer->placements[c->hits.numbers[k]].place, c->window);
        for (int64_t y = part.y; y < part.y + part.height; y++)
            memset(b->known + index_in(c, part.x, y), 1, (size_t)part.width);
    }
}

static void layer_block_finish(layer_block *b)
{
    canvas_finish(&b->canvas);
    free(b->known);
}

static tl_status layer_block_read(layer_block *b, const mosaic *owner, const dem_layer *layer, tl_window window,
                                  tl_error *error)
{
    b->known = NULL;
    tl_status status = canvas_init(&b->canvas, owner, window, NULL, error);
    if (status != TL_OK)
        return status;
    status = paste_layer(&b->canvas, layer, error);
    if (status == TL_OK && layer->area) {
        b->known = tl_alloc_grid(window.width, window.height, 1);
        if (b->known)
            mark_known(b, layer);
        else
            status = tl_fail_memory(error, owner->name);
    }
    settle(&b->canvas);
    if (status != TL_OK)
        layer_block_finish(b);
    return status;
}

/* The layer's samples around a part of the mosaic. */
static tl_window around(const dem_layer *layer, tl_window part)
{
    double c0 = layer->c0 + layer->cs * (double)part.x, c1 = c0 + layer->cs * (double)(part.width - 1);
    double r0 = layer->r0 + layer->rs * (double)part.y, r1 = r0 + layer->rs * (double)(part.height - 1);
    int64_t x0 = (int64_t)floor(fmin(c0, c1)) - 1, x1 = (int64_t)ceil(fmax(c0, c1)) + 1;
    int64_t y0 = (int64_t)floor(fmin(r0, r1)) - 1, y1 = (int64_t)ceil(fmax(r0, r1)) + 1;
    return dem_window_common((tl_window){x0, y0, x1 - x0 + 1, y1 - y0 + 1}, layer->bounds);
}

static void fill_from(canvas *c, const layer_block *b, const dem_layer *layer, tl_window part, const between *columns)
{
    for (int64_t y = part.y; y < part.y + part.height; y++) {
        between row = split(layer->r0 + layer->rs * (double)y);
        for (int64_t k = 0; k < part.width; k++) {
            int64_t at = index_in(c, part.x + k, y);
            if (!c->mixes && !isnan(c->heights[at]))
                continue;
            double weight = 1;
            float height = interpolate(b, &columns[k], &row, &weight);
            offer(c, at, height, weight);
        }
    }
}

static tl_status paste_resampled(canvas *c, const dem_layer *layer, tl_error *error)
{
    tl_window part = dem_window_common(layer->cover, c->window);
    if (dem_window_empty(part) || !wants(c, part))
        return TL_OK;
    tl_window source = around(layer, part);
    if (dem_window_empty(source))
        return TL_OK;
    between *columns = tl_alloc((size_t)part.width, sizeof *columns);
    if (!columns)
        return tl_fail_memory(error, c->owner->name);
    for (int64_t k = 0; k < part.width; k++)
        columns[k] = split(layer->c0 + layer->cs * (double)(part.x + k));
    layer_block block;
    tl_status status = layer_block_read(&block, c->owner, layer, source, error);
    if (status == TL_OK) {
        fill_from(c, &block, layer, part, columns);
        layer_block_finish(&block);
    }
    free(columns);
    return status;
}

static tl_status fill_block(canvas *c, tl_error *error)
{
    const dem_plan *plan = &c->owner->plan;
    tl_status status = paste_layer(c, &plan->layers[0], error);
    if (status != TL_OK || plan->count == 1 || (!c->mixes && !c->missing))
        return status;
    if (!dem_bins_find(plan->covers, c->window, &c->hits))
        return tl_fail_memory(error, c->owner->name);
    for (size_t k = 0; k < c->hits.count && status == TL_OK && (c->mixes || c->missing); k++)
        status = paste_resampled(c, &plan->layers[c->hits.numbers[k] + 1], error);
    return status;
}

/* ---- Reading ---- */

typedef struct reading {
    const mosaic *mosaic;
    int halvings; /* of the level that is put together */
} reading;

static tl_status read_block(const reading *r, tl_window block, float *out, int64_t stride, tl_error *error)
{
    canvas c;
    bool dense = block.width == stride || block.height == 1;
    tl_status status = canvas_init(&c, r->mosaic, block, dense ? out : NULL, error);
    if (status != TL_OK)
        return status;
    c.halvings = r->halvings;
    status = fill_block(&c, error);
    settle(&c);
    for (int64_t row = 0; row < block.height && status == TL_OK && !dense; row++)
        memcpy(out + row * stride, c.heights + row * block.width, (size_t)block.width * sizeof *out);
    canvas_finish(&c);
    return status;
}

static tl_status read_blocks(const void *context, tl_window window, float *out, tl_error *error)
{
    int64_t columns = tl_int64_min(window.width, BLOCK_COLUMNS);
    int64_t rows = columns ? BLOCK_SAMPLES / columns : 1;
    for (int64_t y = 0; y < window.height; y += rows)
        for (int64_t x = 0; x < window.width; x += columns) {
            tl_window block = {window.x + x, window.y + y, tl_int64_min(columns, window.width - x),
                               tl_int64_min(rows, window.height - y)};
            tl_status status = read_block(context, block, out + y * window.width + x, window.width, error);
            if (status != TL_OK)
                return status;
        }
    return TL_OK;
}

static tl_status mosaic_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const tl_source_info *info = &self->info;
    reading r = {.mosaic = (const mosaic *)self, .halvings = -level};
    while (r.halvings > 0 && !(r.mosaic->reduced >> r.halvings & 1))
        r.halvings--;
    dem_level_base base = {.read = read_blocks,
                           .context = &r,
                           .width = ((info->width - 1) >> r.halvings) + 1,
                           .height = ((info->height - 1) >> r.halvings) + 1,
                           .type = info->type,
                           .name = info->name};
    return dem_level_read(&base, -level - r.halvings, window, out, error);
}

/* ---- Making ---- */

/* What members hold does not outlive them. */
static void mosaic_destroy(tl_source *self)
{
    mosaic *m = (mosaic *)self;
    dem_plan_finish(&m->plan);
    for (size_t k = 0; k < m->count; k++)
        tl_source_destroy(m->members[k]);
    free(m->members);
    free(m->places);
    tl_crs_release(self->info.georef.crs);
    dem_block_cache_destroy(m->cache);
    dem_file_pool_destroy(m->pool);
    free(m->name);
    free(m);
}

/* A step that all heights are multiples of: the smallest, where it goes into all others. 0 where heights are made
 * between those of the members. */
static double common_quantum(const mosaic *m)
{
    double low = m->members[0]->info.quantum;
    for (size_t k = 1; k < m->count; k++)
        low = fmin(low, m->members[k]->info.quantum);
    if (!(low > 0) || m->feather || m->plan.count > 1)
        return 0;
    for (size_t k = 0; k < m->count; k++) {
        double ratio = m->members[k]->info.quantum / low;
        if (fabs(ratio - nearbyint(ratio)) > 1e-9 * ratio)
            return 0;
    }
    return low;
}

static tl_status describe(mosaic *m, tl_error *error)
{
    tl_source_info *info = &m->source.info;
    const dem_layer *own = &m->plan.layers[0];
    const tl_source_info *finest = &own->placements[0].source->info;
    *info = (tl_source_info){.width = m->plan.width,
                             .height = m->plan.height,
                             .type = finest->type,
                             .georef = finest->georef,
                             .has_voids = true,
                             .quantum = common_quantum(m),
                             .name = m->name};
    const double transform[6] = {own->x0, own->dx, 0, own->y0, 0, own->dy};
    memcpy(info->georef.transform, transform, sizeof transform);
    tl_crs_retain(info->georef.crs);
    info->wraps = dem_georef_goes_around(&info->georef, info->width);
    return dem_georef_measure(&info->georef, info->width, info->height, error);
}

static tl_status note_places(mosaic *m, size_t count, tl_error *error)
{
    m->places = tl_alloc(count, sizeof *m->places);
    if (!m->places)
        return tl_fail_memory(error, m->name);
    for (size_t k = m->plan.count; k-- > 0;)
        for (size_t p = m->plan.layers[k].count; p-- > 0;)
            m->places[m->plan.layers[k].placements[p].member] = (struct first_place){k, p};
    return TL_OK;
}

/* Levels that all members have copies of, and begin with a cell of. */
static uint64_t reduced_levels(const mosaic *m)
{
    const dem_layer *own = &m->plan.layers[0];
    uint64_t levels = m->plan.count == 1 && !m->feather ? UINT64_MAX : 0;
    for (size_t k = 0; k < own->count && levels; k++) {
        const dem_placement *p = &own->placements[k];
        uint64_t x = (uint64_t)p->place.x, y = (uint64_t)p->place.y;
        levels &= p->mirror_x || p->mirror_y ? 0 : dem_raster_reduced(p->source);
        for (int halvings = 1; halvings < 63; halvings++)
            if ((x | y) & ((UINT64_C(1) << halvings) - 1))
                levels &= ~(UINT64_C(1) << halvings);
    }
    return levels;
}

static tl_status assemble(mosaic *m, tl_source **members, size_t count, const char *name, tl_error *error)
{
    m->name = strdup(name);
    if (!m->name)
        return tl_fail_memory(error, name);
    tl_status status = dem_plan_make(members, count, &m->plan, error);
    if (status == TL_OK)
        status = note_places(m, count, error);
    if (status != TL_OK)
        return status;
    m->members = members;
    m->count = count;
    m->reduced = reduced_levels(m);
    return describe(m, error);
}

tl_source *dem_mosaic_create(tl_source **members, size_t count, const dem_sharing *sharing, const char *name,
                             const tl_dem_options *options, tl_error *error)
{
    mosaic *m = calloc(1, sizeof *m);
    if (!m) {
        tl_fail_memory(error, name);
        return NULL;
    }
    m->source = (tl_source){.read = mosaic_read, .size = dem_level_size, .destroy = mosaic_destroy};
    m->feather = options->feather;
    if (assemble(m, members, count, name, error) == TL_OK) {
        m->pool = sharing->pool;
        m->cache = sharing->cache;
        return &m->source;
    }
    m->members = NULL;
    m->count = 0;
    mosaic_destroy(&m->source);
    return NULL;
}

tl_source *const *dem_mosaic_members(const tl_source *source, size_t *count)
{
    if (source->read != mosaic_read)
        return NULL;
    *count = ((const mosaic *)source)->count;
    return ((const mosaic *)source)->members;
}

/* What the layer covers of the mosaic tells nothing of one member, so a member that is interpolated is placed by its
 * outer samples. */
static tl_window place_between(const dem_layer *layer, tl_window place)
{
    double x0 = ((double)place.x - layer->c0) / layer->cs, x1 = x0 + (double)(place.width - 1) / layer->cs;
    double y0 = ((double)place.y - layer->r0) / layer->rs, y1 = y0 + (double)(place.height - 1) / layer->rs;
    int64_t x = (int64_t)floor(fmin(x0, x1)), y = (int64_t)floor(fmin(y0, y1));
    return (tl_window){x, y, (int64_t)ceil(fmax(x0, x1)) - x + 1, (int64_t)ceil(fmax(y0, y1)) - y + 1};
}

tl_window dem_mosaic_place(const tl_source *source, size_t index, bool *resampled)
{
    const mosaic *m = (const mosaic *)source;
    struct first_place at = m->places[index];
    const dem_layer *layer = &m->plan.layers[at.layer];
    tl_window place = layer->placements[at.placement].place;
    *resampled = at.layer > 0;
    return dem_window_common(*resampled ? place_between(layer, place) : place,
                             (tl_window){0, 0, m->plan.width, m->plan.height});
}
