/* Parallel loops over POSIX threads. */
#ifndef TL_BASE_PARALLEL_H
#define TL_BASE_PARALLEL_H

#include "lib/talus.h"

typedef struct tl_parallel tl_parallel;

/* One item of a loop. `worker` is below the number that tl_parallel_workers gives: index per-worker scratch with it.
 * Outputs of different items must be disjoint. A failure ends the loop, and the first by item index among those that
 * ran is what tl_parallel_for reports; an item that only gave up (see tl_parallel_wait_turn) returns
 * TL_ERROR_CANCELLED. */
typedef tl_status (*tl_parallel_item)(void *context, tl_parallel *loop, uint64_t item, unsigned worker,
                                      tl_error *error);

/* Number of workers that a loop of `items` items will use under `run` (which may be NULL): at least 1. */
unsigned tl_parallel_workers(const tl_run *run, uint64_t items);

/* Runs items 0 ... items - 1. They are handed out in this order by an atomic counter, so an item may wait for a
 * smaller one (see tl_parallel_wait_turn). Progress is reported on the calling thread, in units of
 * `samples` / `items` an item. */
tl_status tl_parallel_for(const tl_run *run, uint64_t items, uint64_t samples, tl_parallel_item body, void *context,
                          tl_error *error);

/* Inside of an item: waits until every smaller item has passed its turn. False: the loop has failed or was
 * cancelled, give up. A failing item keeps its turn, so that nobody goes on behind it. Between this and
 * tl_parallel_end_turn at most one item of the loop runs, in order of items. */
bool tl_parallel_wait_turn(tl_parallel *loop, uint64_t item);
/* The same for an item that need not be the first of all: until fewer than `ahead` smaller ones are before their turn's
 * end. */
bool tl_parallel_wait_near(tl_parallel *loop, uint64_t item, uint64_t ahead);
void tl_parallel_end_turn(tl_parallel *loop, uint64_t item);

/* TL_ERROR_MEMORY, described, where `bytes` are more than the run may take: `name` is the thing, `work` what is done
 * with it, as "filling its voids". */
tl_status tl_run_fits(const tl_run *run, double bytes, const char *name, const char *work, tl_error *error);

/* TL_ERROR_CANCELLED, described, when the run's cancel flag is up; else TL_OK. */
tl_status tl_run_check(const tl_run *run, tl_error *error);

#endif
