/* Summits, pits and passes by topological persistence, and the lines between them.
 *
 * Samples are taken from the highest to the lowest. One that has no higher neighbour begins a hill; one that has
 * neighbours in several hills joins them: it is the pass at which all but the hill with the highest summit end, and the
 * drop from such a summit to its pass is its persistence. Pits are the same upside down. Equal heights are ordered by
 * their index (simulation of simplicity), so that a plateau has one summit and no sample is in doubt. Neighbours are
 * the eight around a sample; voids are none. */
#include "dem/framework.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>

enum { BAND = 256, NEIGHBOURS = 8 };

static const uint32_t NONE = UINT32_MAX;
/* Heights, two orders, the hill, its end and the kinds of each sample. */
static const double BYTES_A_SAMPLE = 21;

static const int32_t steps[NEIGHBOURS][2] = {{-1, -1}, {0, -1}, {1, -1}, {-1, 0}, {1, 0}, {-1, 1}, {0, 1}, {1, 1}};

/* The end of a hill. */
typedef struct meeting {
    uint32_t summit, pass;
    uint32_t own, other; /* neighbours of the pass from which the summit's hill and the one that goes on are climbed */
    float persistence;
} meeting;

typedef struct finder {
    const tl_features_options *options;
    int64_t width, height;
    float *z;
    uint32_t *order; /* valid samples, rising */
    size_t count;
    uint32_t *hill; /* parent in the forest of hills, whose roots are summits; NONE: not yet reached */
    uint32_t *end;  /* by summit: its meeting */
    meeting *meetings;
    size_t meeting_count, capacity;
    unsigned char *kinds;
    bool down; /* pits instead of summits */
    double steep[NEIGHBOURS];
} finder;

/* ---- Order ----------------------------------------------------------------------------------------- */

/* Bits of a float that rise with it; both zeros are one. */
static inline uint32_t key_of(float z)
{
    uint32_t bits;
    z += 0.0f;
    memcpy(&bits, &z, sizeof bits);
    return bits & UINT32_C(0x80000000) ? ~bits : bits | UINT32_C(0x80000000);
}

static inline uint32_t digit(const finder *self, uint32_t sample, int shift)
{
    return key_of(self->z[sample]) >> shift & 0xffff;
}

/* One stable pass of a radix sort. */
static void sort_by(const finder *self, const uint32_t *from, uint32_t *to, int shift, size_t *counts)
{
    memset(counts, 0, 0x10000 * sizeof *counts);
    for (size_t k = 0; k < self->count; k++)
        counts[digit(self, from[k], shift)]++;
    size_t sum = 0;
    for (size_t d = 0; d < 0x10000; d++) {
        size_t own = counts[d];
        counts[d] = sum;
        sum += own;
    }
    for (size_t k = 0; k < self->count; k++)
        to[counts[digit(self, from[k], shift)]++] = from[k];
}

/* Uses `hill` as the other half of the sort. */
static tl_status sort_samples(finder *self, tl_error *error)
{
    size_t samples = (size_t)self->width * (size_t)self->height, *counts = tl_alloc(0x10000, sizeof *counts);
    if (!counts)
        return tl_fail_memory(error, "the features");
    for (size_t k = 0; k < samples; k++)
        if (!isnan(self->z[k]))
            self->order[self->count++] = (uint32_t)k;
    sort_by(self, self->order, self->hill, 0, counts);
    sort_by(self, self->hill, self->order, 16, counts);
    free(counts);
    return TL_OK;
}

/* Whether a comes before b: higher, or where pits are sought lower. */
static inline bool before(const finder *self, uint32_t a, uint32_t b)
{
    bool lower = self->z[a] < self->z[b] || (self->z[a] == self->z[b] && a < b);
    return lower == self->down && a != b;
}

/* The neighbour k of a sample, or NONE. */
static inline uint32_t neighbour(const finder *self, uint32_t of, int k)
{
    int64_t x = of % self->width + steps[k][0], y = of / self->width + steps[k][1];
    if (x < 0 || y < 0 || x >= self->width || y >= self->height)
        return NONE;
    uint32_t at = (uint32_t)(y * self->width + x);
    return isnan(self->z[at]) ? NONE : at;
}

/* ---- Hills ----------------------------------------------------------------------------------------- */

static uint32_t summit_of(const finder *self, uint32_t at)
{
    while (self->hill[at] != at) {
        self->hill[at] = self->hill[self->hill[at]];
        at = self->hill[at];
    }
    return at;
}

static bool add_meeting(finder *self, const meeting *add)
{
    if (self->meeting_count == self->capacity) {
        size_t capacity = self->capacity ? 2 * self->capacity : 1024;
        meeting *more = realloc(self->meetings, capacity * sizeof *more);
        if (!more)
            return false;
        self->meetings = more;
        self->capacity = capacity;
    }
    self->end[add->summit] = (uint32_t)self->meeting_count;
    self->meetings[self->meeting_count++] = *add;
    return true;
}

/* How steeply the way from `of` to its neighbour k rises (or falls). */
static inline double slope_to(const finder *self, uint32_t of, uint32_t to, int k)
{
    double rise = (double)self->z[to] - (double)self->z[of];
    return (self->down ? -rise : rise) * self->steep[k];
}

/* The hills that meet at a sample, by summit, and from where each is climbed. */
typedef struct hills {
    uint32_t summit[NEIGHBOURS], from[NEIGHBOURS];
    double slope[NEIGHBOURS];
    int count;
} hills;

static hills hills_at(const finder *self, uint32_t at)
{
    hills found = {.count = 0};
    for (int k = 0; k < NEIGHBOURS; k++) {
        uint32_t to = neighbour(self, at, k);
        if (to == NONE || self->hill[to] == NONE)
            continue;
        uint32_t summit = summit_of(self, to);
        double slope = slope_to(self, at, to, k);
        int i = 0;
        while (i < found.count && found.summit[i] != summit)
            i++;
        if (i == found.count || slope > found.slope[i])
            found.summit[i] = summit, found.from[i] = to, found.slope[i] = slope;
        found.count += i == found.count;
    }
    return found;
}

static bool reach_sample(finder *self, uint32_t at)
{
    hills met = hills_at(self, at);
    int first = 0;
    for (int i = 1; i < met.count; i++)
        if (before(self, met.summit[i], met.summit[first]))
            first = i;
    self->hill[at] = met.count ? met.summit[first] : at;
    for (int i = 0; i < met.count; i++) {
        if (i == first)
            continue;
        const meeting add = {met.summit[i], at, met.from[i], met.from[first],
                             fabsf(self->z[met.summit[i]] - self->z[at])};
        self->hill[met.summit[i]] = met.summit[first];
        if (!add_meeting(self, &add))
            return false;
    }
    return true;
}

static bool matters(const finder *self, uint32_t summit)
{
    return self->end[summit] == NONE ||
           (double)self->meetings[self->end[summit]].persistence >= self->options->persistence;
}

/* ---- Lines ----------------------------------------------------------------------------------------- */

/* The steepest way on from a sample, or NONE on a summit. */
static uint32_t climb(const finder *self, uint32_t at)
{
    uint32_t best = NONE;
    double steepest = 0;
    for (int k = 0; k < NEIGHBOURS; k++) {
        uint32_t to = neighbour(self, at, k);
        if (to == NONE || !before(self, to, at))
            continue;
        double slope = slope_to(self, at, to, k);
        if (best == NONE || slope > steepest || (slope == steepest && before(self, to, best)))
            best = to, steepest = slope;
    }
    return best;
}

/* Follows a line up to a summit that matters. From one that does not, it goes on at the pass where that hill ends. */
static void trace(finder *self, uint32_t at)
{
    const unsigned char line = self->down ? TL_FEATURE_VALLEY : TL_FEATURE_RIDGE;
    while (!(self->kinds[at] & line)) {
        self->kinds[at] |= line;
        uint32_t next = climb(self, at);
        if (next == NONE) {
            if (matters(self, at))
                return;
            const meeting *end = &self->meetings[self->end[at]];
            self->kinds[end->pass] |= line;
            next = end->other;
        }
        at = next;
    }
}

/* ---- All ------------------------------------------------------------------------------------------- */

/* Whether a hill that never ends rises by the persistence asked for above the opposite extreme. */
static bool rises(const finder *self, uint32_t summit)
{
    float low = self->z[self->order[0]], high = self->z[self->order[self->count - 1]];
    return self->end[summit] != NONE || (double)(high - low) >= self->options->persistence;
}

static tl_status sweep(finder *self, bool down, tl_error *error)
{
    size_t samples = (size_t)self->width * (size_t)self->height;
    self->down = down;
    self->meeting_count = 0;
    memset(self->hill, 0xff, samples * sizeof *self->hill);
    memset(self->end, 0xff, samples * sizeof *self->end);
    for (size_t k = 0; k < self->count; k++) {
        if (!reach_sample(self, self->order[down ? k : self->count - 1 - k]))
            return tl_fail_memory(error, "the features");
        if (k % (1 << 20) == 0 && tl_run_check(self->options->run, error) != TL_OK)
            return TL_ERROR_CANCELLED;
    }
    for (size_t k = 0; k < self->count; k++) {
        uint32_t at = self->order[k];
        if (climb(self, at) == NONE && matters(self, at) && rises(self, at))
            self->kinds[at] |= down ? TL_FEATURE_PIT : TL_FEATURE_SUMMIT;
    }
    for (size_t k = 0; k < self->meeting_count; k++) {
        const meeting *each = &self->meetings[k];
        if (!((double)each->persistence >= self->options->persistence))
            continue;
        self->kinds[each->pass] |= TL_FEATURE_PASS;
        if (self->options->lines) {
            trace(self, each->own);
            trace(self, each->other);
        }
    }
    return TL_OK;
}

static tl_status collect(const finder *self, tl_features *out, tl_error *error)
{
    size_t samples = (size_t)self->width * (size_t)self->height;
    for (size_t k = 0; k < samples; k++)
        out->count += self->kinds[k] != 0;
    out->items = tl_alloc(out->count, sizeof *out->items);
    if (!out->items)
        return tl_fail_memory(error, "the features");
    tl_feature *to = out->items;
    for (size_t k = 0; k < samples; k++)
        if (self->kinds[k])
            *to++ = (tl_feature){.i = (int32_t)((int64_t)k % self->width),
                                 .j = (int32_t)((int64_t)k / self->width),
                                 .z = self->z[k],
                                 .kinds = self->kinds[k]};
    return TL_OK;
}

static tl_status find(finder *self, const tl_source *dem, tl_features *out, tl_error *error)
{
    size_t samples = (size_t)self->width * (size_t)self->height;
    self->z = tl_alloc(samples, sizeof *self->z);
    self->order = tl_alloc(samples, sizeof *self->order);
    self->hill = tl_alloc(samples, sizeof *self->hill);
    self->end = tl_alloc(samples, sizeof *self->end);
    self->kinds = calloc(samples ? samples : 1, 1);
    if (!self->z || !self->order || !self->hill || !self->end || !self->kinds)
        return tl_fail_memory(error, "the features");
    tl_status status = TL_OK;
    for (int64_t y = 0; status == TL_OK && y < self->height; y += BAND) {
        tl_window window = {0, y, self->width, tl_int64_min(BAND, self->height - y)};
        status = tl_source_read(dem, dem->info.level, window, self->z + y * self->width, error);
    }
    if (status == TL_OK) {
        tl_heights_clean(self->z, samples);
        status = sort_samples(self, error);
    }
    if (status == TL_OK && self->count)
        status = sweep(self, false, error);
    if (status == TL_OK && self->count)
        status = sweep(self, true, error);
    return status == TL_OK ? collect(self, out, error) : status;
}

/* Ways to the neighbours by the cells' shape. */
static void measure_ways(finder *self, const tl_georef *georef)
{
    bool known = georef->cell_x > 0 && georef->cell_y > 0;
    for (int k = 0; k < NEIGHBOURS; k++)
        self->steep[k] =
            1 / hypot(steps[k][0] * (known ? georef->cell_x : 1), steps[k][1] * (known ? georef->cell_y : 1));
}

tl_status tl_features_find(const tl_source *dem, const tl_features_options *options, tl_features **out, tl_error *error)
{
    const tl_source_info *info = &dem->info;
    finder self = {.options = options, .width = info->width, .height = info->height};
    double samples = (double)info->width * (double)info->height;
    if (!(options->persistence >= 0))
        return tl_fail(error, TL_ERROR_ARGUMENT, "a persistence of %g: must be 0 or larger", options->persistence);
    if (samples >= (double)UINT32_MAX)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: more than 2^32 samples; look for features in parts", info->name);
    tl_status status = tl_run_fits(options->run, BYTES_A_SAMPLE * samples, info->name, "finding its features", error);
    if (status != TL_OK)
        return status;
    tl_features *made = calloc(1, sizeof *made);
    measure_ways(&self, &info->georef);
    status = made ? find(&self, dem, made, error) : tl_fail_memory(error, "the features");
    free(self.z);
    free(self.order);
    free(self.hill);
    free(self.end);
    free(self.kinds);
    free(self.meetings);
    if (status == TL_OK)
        *out = made;
    else
        tl_features_destroy(made);
    return status;
}

void tl_features_destroy(tl_features *features)
{
    if (!features)
        return;
    free(features->items);
    free(features);
}

tl_status tl_features_force(const tl_features *features, tl_framework *framework, tl_error *error)
{
    for (size_t k = 0; features && k < features->count; k++) {
        const tl_feature *each = &features->items[k];
        if (each->i < 0 || each->j < 0 || each->i >= framework->info.width || each->j >= framework->info.height)
            return tl_fail(error, TL_ERROR_ARGUMENT, "%s: a feature at column %d, row %d lies outside of it",
                           framework->info.name, each->i, each->j);
        tl_framework_force(framework, each->i, each->j);
    }
    return TL_OK;
}
