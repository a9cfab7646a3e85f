/* Heights that probably stand for void in files that do not say so. One scan keeps the few lowest and highest different
 * values with their counts: whether the lowest is far from the next, and that from the rest, they tell. */
#include "lib/base/error.h"
#include "lib/base/scan.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

/* MOST suspects may be taken away from one end, and FEWEST values must be left for a range to mean something. */
enum { MOST = TL_MAX_SUSPECTS, FEWEST = 8, KEPT = MOST + FEWEST, FREQUENT = 16 };

/* The outermost values at one end, the outermost first. */
typedef struct extremes {
    float values[KEPT];
    uint64_t counts[KEPT];
    int count;
} extremes;

typedef struct tally {
    extremes low, high; /* the high ones negated, so that both ends are alike */
    uint64_t samples;   /* that are not void */
} tally;

/* The counts are whole: a value that is dropped has KEPT others beyond it and does not come back. */
static void add_value(extremes *e, float value, uint64_t count)
{
    int k = e->count;
    while (k > 0 && value < e->values[k - 1])
        k--;
    if (k > 0 && value == e->values[k - 1]) {
        e->counts[k - 1] += count;
        return;
    }
    if (k == KEPT)
        return;
    int moved = (e->count < KEPT ? e->count : KEPT - 1) - k;
    memmove(e->values + k + 1, e->values + k, (size_t)moved * sizeof *e->values);
    memmove(e->counts + k + 1, e->counts + k, (size_t)moved * sizeof *e->counts);
    e->values[k] = value;
    e->counts[k] = count;
    e->count += e->count < KEPT;
}

/* Larger than this a value need not be looked at. */
static float horizon(const extremes *e)
{
    return e->count < KEPT ? INFINITY : e->values[KEPT - 1];
}

static void add_heights(void *context, uint64_t band, unsigned worker, const float *heights, size_t count)
{
    (void)band;
    tally *t = (tally *)context + worker;
    float low = horizon(&t->low), high = -horizon(&t->high);
    for (size_t k = 0; k < count; k++) {
        float height = heights[k];
        t->samples += !isnan(height);
        if (height <= low) {
            add_value(&t->low, height, 1);
            low = horizon(&t->low);
        }
        if (height >= high) {
            add_value(&t->high, -height, 1);
            high = -horizon(&t->high);
        }
    }
}

static void join(extremes *to, const extremes *from)
{
    for (int k = 0; k < from->count; k++)
        add_value(to, from->values[k], from->counts[k]);
}

/* ---- Judging ---- */

/* What people write for void, and numbers that are no height on any body. */
static bool is_usual(float value)
{
    static const float usual[] = {-9999, -99999, -32768, -32767, 32767, 65535};
    for (size_t k = 0; k < sizeof usual / sizeof *usual; k++)
        if (value == usual[k])
            return true;
    return fabsf(value) >= 1e30f;
}

static void drop_first(extremes *e)
{
    e->count--;
    memmove(e->values, e->values + 1, (size_t)e->count * sizeof *e->values);
    memmove(e->counts, e->counts + 1, (size_t)e->count * sizeof *e->counts);
}

/* Whether the outermost value of `end` is suspect, where `other` holds those of the other end; `sign` undoes a
 * negation. A value without a name must be frequent, or at least 1e-4 of all, and farther from the next than half of
 * the range of the rest; a usual one by a tenth of it. */
static bool is_suspect(const extremes *end, const extremes *other, float sign, uint64_t samples)
{
    if (end->count < 2)
        return false;
    double gap = (double)end->values[1] - (double)end->values[0];
    double rest = -(double)other->values[0] - (double)end->values[1];
    if (is_usual(sign * end->values[0]))
        return gap > 0.1 * rest;
    bool frequent = end->counts[0] > FREQUENT || (double)end->counts[0] >= 1e-4 * (double)samples;
    return frequent && end->count > FEWEST && gap > 0.5 * rest;
}

/* The first value of one end, taken away from both, for few values are at both ends. */
static tl_suspect take(extremes *end, extremes *other, float sign)
{
    tl_suspect found = {.value = sign * end->values[0], .count = end->counts[0]};
    if (other->count && other->values[other->count - 1] == -end->values[0])
        other->count--;
    drop_first(end);
    return found;
}

static size_t judge(tally *t, tl_suspect out[TL_MAX_SUSPECTS])
{
    size_t count = 0;
    while (count < MOST) {
        if (is_suspect(&t->low, &t->high, 1, t->samples))
            out[count++] = take(&t->low, &t->high, 1);
        else if (is_suspect(&t->high, &t->low, -1, t->samples))
            out[count++] = take(&t->high, &t->low, -1);
        else
            break;
    }
    return count;
}

tl_status tl_source_suspects(const tl_source *source, const tl_run *run, tl_suspect out[TL_MAX_SUSPECTS], size_t *count,
                             tl_error *error)
{
    unsigned workers = tl_scan_workers(source, run);
    tally *tallies = calloc(workers, sizeof *tallies);
    if (!tallies)
        return tl_fail_memory(error, source->info.name);
    tl_status status = tl_scan(source, run, add_heights, tallies, error);
    for (unsigned k = 1; k < workers; k++) {
        join(&tallies[0].low, &tallies[k].low);
        join(&tallies[0].high, &tallies[k].high);
        tallies[0].samples += tallies[k].samples;
    }
    if (status == TL_OK)
        *count = judge(&tallies[0], out);
    free(tallies);
    return status;
}
