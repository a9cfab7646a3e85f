/* Frameworks out of an error pyramid: by threshold, or as many triangles or points as a budget allows. */
#include "dem/framework_pyramid.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

enum { BAND = 64, KEYS = 1 << 16 };

/* Which samples are marked: those of keys above `above`; and of those with this key the ones that split triangles of
 * sizes above `size`, and the first `some` of that size, row by row. This is the canonical order: what a vertex needs
 * has its key at least, and a larger size. */
typedef struct cut {
    uint32_t above;
    int size;
    uint64_t some;
} cut;

static cut everything_above(uint32_t key)
{
    return (cut){key, TL_SIZES, 0};
}

typedef struct selector {
    const tl_pyramid *pyramid;
    tl_framework *framework;
    int64_t width, height;
    uint64_t *counts; /* by worker, KEYS each */
    cut at;
    uint32_t high;       /* what the upper half of keys must be, in counting the lower ones */
    int shift;           /* of keys, to count by */
    const float *limits; /* by sample, where the bound varies; else NULL */
    bool rims;           /* triangles are counted, of which a vertex on the raster's rim makes one, others two */
    const tl_features *features;
} selector;

static inline int size_at(int64_t x, int64_t y)
{
    int64_t s = (x | y) & -(x | y);
    return tl_size_of(s, (x & s) && (y & s));
}

/* What splitting at a vertex adds. */
static inline uint64_t weight_at(const selector *self, int64_t x, int64_t y)
{
    return self->rims && x && y && x < self->width - 1 && y < self->height - 1 ? 2 : 1;
}

/* ---- Marks ------------------------------------------------------------------------------------------ */

static tl_status mark_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    const selector *self = context;
    tl_framework *framework = self->framework;
    (void)loop;
    (void)worker;
    (void)error;
    int64_t y = (int64_t)item * BAND, end = tl_int64_min(y + BAND, self->height);
    for (; y < end; y++)
        for (int64_t x = 0; x < self->width; x += 64) {
            int64_t count = tl_int64_min(64, self->width - x);
            size_t sample = (size_t)(y * self->width + x);
            unsigned char bytes[64 + 8]; /* tl_pack_bits takes eight at a time */
            for (int64_t i = 0; i < count; i++)
                bytes[i] = tl_pyramid_key(self->pyramid, sample + (size_t)i) > self->at.above;
            framework->split[(size_t)y * framework->words + (size_t)(x >> 6)] = tl_pack_bits(bytes, count);
        }
    return TL_OK;
}

/* Marks the samples of the cut's own key and size, the first of them. */
static void mark_some(const selector *self)
{
    const cut *at = &self->at;
    int64_t s = INT64_C(1) << ((at->size - 1) / 2);
    bool centre = at->size % 2 == 0;
    uint64_t left = at->some;
    for (int64_t y = centre ? s : 0; left && y < self->height; y += centre ? 2 * s : s)
        for (int64_t x = centre || !(y & s) ? s : 0; left && x < self->width; x += 2 * s)
            if (tl_pyramid_key(self->pyramid, (size_t)(y * self->width + x)) == at->above) {
                tl_bit_set(self->framework->split, self->framework->words, x, y);
                left--;
            }
}

static void mark_larger(const selector *self)
{
    for (int64_t y = 0; y < self->height; y++)
        for (int64_t x = 0; x < self->width; x++)
            if (tl_pyramid_key(self->pyramid, (size_t)(y * self->width + x)) == self->at.above && (x | y) &&
                size_at(x, y) > self->at.size)
                tl_bit_set(self->framework->split, self->framework->words, x, y);
}

/* ---- Counting --------------------------------------------------------------------------------------- */

static tl_status count_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    const selector *self = context;
    uint64_t *counts = self->counts + (size_t)worker * KEYS;
    uint32_t most = tl_pyramid_most(self->pyramid);
    (void)loop;
    (void)error;
    int64_t y = (int64_t)item * BAND, end = tl_int64_min(y + BAND, self->height);
    for (; y < end; y++)
        for (int64_t x = 0; x < self->width; x++) {
            uint32_t key = tl_pyramid_key(self->pyramid, (size_t)(y * self->width + x));
            if (key == 0 || key == most || (self->shift == 0 && key >> 16 != self->high))
                continue;
            counts[key >> self->shift & (KEYS - 1)] += weight_at(self, x, y);
        }
    return TL_OK;
}

/* Sums of weights by a part of the keys, in the first worker's counts. */
static tl_status count_keys(selector *self, const tl_run *run, tl_error *error)
{
    uint64_t bands = (uint64_t)tl_div_up(self->height, BAND);
    unsigned workers = tl_parallel_workers(run, bands);
    memset(self->counts, 0, (size_t)workers * KEYS * sizeof *self->counts);
    tl_status status = tl_parallel_for(run, bands, 0, count_band, self, error);
    for (unsigned i = 1; i < workers; i++)
        for (size_t k = 0; k < KEYS; k++)
            self->counts[k] += self->counts[(size_t)i * KEYS + k];
    return status;
}

/* Takes whole counts from the top while they fit into *left; returns the index of the first that does not, or 0. */
static size_t take_keys(const selector *self, size_t from, uint64_t *left)
{
    for (size_t k = from; k > 0; k--) {
        if (self->counts[k] > *left)
            return k;
        *left -= self->counts[k];
    }
    return 0;
}

/* Out of one key, takes what fits into `left`: whole sizes from the largest on, then row by row. */
static void take_some(selector *self, uint64_t left)
{
    uint64_t sizes[TL_SIZES] = {0};
    for (int64_t y = 0; y < self->height; y++)
        for (int64_t x = 0; x < self->width; x++)
            if (tl_pyramid_key(self->pyramid, (size_t)(y * self->width + x)) == self->at.above && (x | y))
                sizes[size_at(x, y)] += weight_at(self, x, y);
    int size = TL_SIZES - 1;
    for (; size > 0 && sizes[size] <= left; size--)
        left -= sizes[size];
    self->at.size = size;
    self->at.some = 0;
    int64_t s = INT64_C(1) << ((size - 1) / 2);
    bool centre = size % 2 == 0;
    for (int64_t y = centre ? s : 0; size > 0 && y < self->height; y += centre ? 2 * s : s)
        for (int64_t x = centre || !(y & s) ? s : 0; x < self->width; x += 2 * s) {
            if (tl_pyramid_key(self->pyramid, (size_t)(y * self->width + x)) != self->at.above)
                continue;
            if (weight_at(self, x, y) > left)
                return;
            left -= weight_at(self, x, y);
            self->at.some++;
        }
}

/* Finds the cut at which the samples above it add at most `left`. */
static tl_status find_cut(selector *self, uint64_t left, const tl_run *run, tl_error *error)
{
    bool codes = self->pyramid->codes;
    self->shift = codes ? 0 : 16;
    self->high = 0;
    tl_status status = count_keys(self, run, error);
    if (status != TL_OK)
        return status;
    size_t first = take_keys(self, KEYS - 1, &left);
    uint32_t key = (uint32_t)first;
    if (!codes) { /* now the lower halves of the keys with this upper half; keys below 2^16 have the upper half 0 */
        self->shift = 0, self->high = (uint32_t)first;
        status = count_keys(self, run, error);
        if (status != TL_OK)
            return status;
        size_t second = take_keys(self, KEYS - 1, &left);
        key = (uint32_t)first << 16 | (uint32_t)second;
    }
    self->at = everything_above(key);
    if (key)
        take_some(self, left);
    return TL_OK;
}

/* ---- Selecting ---------------------------------------------------------------------------------------- */

/* The largest key whose error is not above the threshold. */
static uint32_t key_under(const tl_pyramid *pyramid, double max_error)
{
    uint32_t low = 0, high = tl_pyramid_most(pyramid) - 1;
    while (low < high) {
        uint32_t middle = low + (high - low + 1) / 2;
        if (tl_pyramid_value(pyramid, middle) <= max_error)
            low = middle;
        else
            high = middle - 1;
    }
    return low;
}

static tl_framework *mark(selector *self, double max_error, const tl_source *dem, const tl_run *run, tl_error *error)
{
    const tl_framework *shape = self->pyramid->shape;
    tl_framework *framework = tl_framework_create(&shape->info, max_error, run, error);
    if (!framework)
        return NULL;
    self->framework = framework;
    framework->voids = shape->voids;
    framework->bends = self->pyramid->bends;
    uint64_t bands = (uint64_t)tl_div_up(self->height, BAND);
    tl_status status = self->limits ? TL_OK : tl_parallel_for(run, bands, 0, mark_band, self, error);
    if (self->limits)
        tl_framework_mark_limits(framework, self->pyramid, self->limits);
    if (status == TL_OK && self->at.size < TL_SIZES) {
        mark_larger(self);
        mark_some(self);
    }
    if (status == TL_OK)
        status = tl_features_force(self->features, framework, error);
    const tl_rows rows = {.source = dem};
    if (status == TL_OK)
        status = tl_framework_find_points(framework, &rows, run, error);
    if (status == TL_OK)
        return framework;
    tl_framework_destroy(framework);
    return NULL;
}

/* What the smallest mesh has, that of the samples which are always needed. */
static tl_status count_least(selector *self, const tl_source *dem, const tl_run *run, uint64_t *count, tl_error *error)
{
    self->at = everything_above(tl_pyramid_most(self->pyramid) - 1);
    tl_framework *least = mark(self, 0, dem, run, error);
    size_t triangles = 0;
    if (!least)
        return TL_ERROR_DATA;
    tl_status status = self->rims ? tl_framework_count_triangles(least, &triangles, error) : TL_OK;
    *count = self->rims ? triangles : tl_framework_point_count(least);
    tl_framework_destroy(least);
    return status;
}

static tl_framework *select_budget(selector *self, uint64_t budget, const tl_source *dem, const tl_run *run,
                                   tl_error *error)
{
    uint64_t least;
    if (count_least(self, dem, run, &least, error) != TL_OK)
        return NULL;
    if (least > budget) {
        tl_fail(error, TL_ERROR_ARGUMENT, "%s: a budget of %llu %s is too small, its voids and rims alone take %llu",
                dem->info.name, (unsigned long long)budget, self->rims ? "triangles" : "vertices",
                (unsigned long long)least);
        return NULL;
    }
    self->counts = tl_alloc((size_t)tl_parallel_workers(run, (uint64_t)tl_div_up(self->height, BAND)),
                            KEYS * sizeof *self->counts);
    tl_status status = self->counts ? find_cut(self, budget - least, run, error) : tl_fail_memory(error, "the budget");
    free(self->counts);
    return status == TL_OK ? mark(self, tl_pyramid_value(self->pyramid, self->at.above), dem, run, error) : NULL;
}

static bool same_raster(const tl_pyramid *pyramid, const tl_source *dem, tl_error *error)
{
    const tl_source_info *of = &pyramid->shape->info;
    if (of->width == dem->info.width && of->height == dem->info.height)
        return true;
    tl_fail(error, TL_ERROR_ARGUMENT, "%s: has %lld x %lld samples, its error pyramid %lld x %lld", dem->info.name,
            (long long)dem->info.width, (long long)dem->info.height, (long long)of->width, (long long)of->height);
    return false;
}

/* Whether a bound that varies is one everywhere; *largest becomes the largest. Voids of the map get max_error. */
static tl_status check_limits(float *limits, size_t count, const tl_source *map, double max_error, double *largest,
                              tl_error *error)
{
    *largest = 0;
    for (size_t k = 0; k < count; k++) {
        double limit = isnan(limits[k]) ? max_error : (double)limits[k];
        if (!(limit >= 0))
            return tl_fail(error, TL_ERROR_DATA, "%s: a bound of %g; bounds must be 0 or larger", map->info.name,
                           limit);
        limits[k] = (float)limit;
        if ((double)limits[k] > limit)
            limits[k] = nextafterf(limits[k], 0);
        *largest = fmax(*largest, limit);
    }
    return TL_OK;
}

static tl_framework *select_by_map(selector *self, const tl_source *dem, const tl_selection *selection, tl_error *error)
{
    const tl_source *map = selection->max_error_map;
    if (map->info.width != self->width || map->info.height != self->height) {
        tl_fail(error, TL_ERROR_ARGUMENT,
                "%s: has %lld x %lld samples, where the model has %lld x %lld; a map of bounds needs one for each "
                "sample",
                map->info.name, (long long)map->info.width, (long long)map->info.height, (long long)self->width,
                (long long)self->height);
        return NULL;
    }
    double samples = (double)self->width * (double)self->height, largest = 0;
    if (tl_run_fits(selection->run, sizeof(float) * samples, map->info.name, "the map of bounds", error) != TL_OK)
        return NULL;
    float *limits = tl_alloc_grid(self->width, self->height, sizeof *limits);
    tl_status status = limits ? TL_OK : tl_fail_memory(error, "the map of bounds");
    for (int64_t y = 0; status == TL_OK && y < self->height; y += BAND) {
        tl_window window = {0, y, self->width, tl_int64_min(BAND, self->height - y)};
        status = tl_source_read(map, map->info.level, window, limits + y * self->width, error);
    }
    if (status == TL_OK)
        status = check_limits(limits, (size_t)self->width * (size_t)self->height, map, selection->max_error, &largest,
                              error);
    self->limits = limits;
    self->at = everything_above(tl_pyramid_most(self->pyramid));
    tl_framework *framework = status == TL_OK ? mark(self, largest, dem, selection->run, error) : NULL;
    free(limits);
    return framework;
}

tl_framework *tl_framework_from_pyramid(const tl_pyramid *pyramid, const tl_source *dem, const tl_selection *selection,
                                        tl_error *error)
{
    selector self = {.pyramid = pyramid, .width = dem->info.width, .height = dem->info.height};
    self.features = selection->features;
    if (!same_raster(pyramid, dem, error))
        return NULL;
    if (selection->max_error_map && !selection->triangles && !selection->vertices)
        return select_by_map(&self, dem, selection, error);
    if (selection->triangles || selection->vertices) {
        self.rims = selection->triangles;
        return select_budget(&self, selection->triangles ? selection->triangles : selection->vertices, dem,
                             selection->run, error);
    }
    if (!(selection->max_error >= 0)) {
        tl_fail(error, TL_ERROR_ARGUMENT, "max_error %g: must be 0 or larger", selection->max_error);
        return NULL;
    }
    self.at = everything_above(key_under(pyramid, selection->max_error));
    return mark(&self, selection->max_error, dem, selection->run, error);
}
