#define _GNU_SOURCE /* sched_getaffinity, pthread_cond_clockwait */
#include "lib/base/parallel.h"

#include "lib/base/error.h"

#include <pthread.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <time.h>

enum {
    MAX_WORKERS = 512,
    PROGRESS_INTERVAL_NS = 100000000,
    THREAD_BYTES = 4 << 20, /* that a worker takes for what it reads, makes and writes */
};

struct tl_parallel {
    const tl_run *run;
    uint64_t items;
    tl_parallel_item body;
    void *context;
    atomic_uint_fast64_t next, done;
    atomic_bool stop;
    pthread_mutex_t lock; /* guards all below */
    pthread_cond_t changed;
    uint64_t turn;
    unsigned running;
    uint64_t failed_item;
    tl_error failure; /* status TL_OK: none */
};

typedef struct worker {
    tl_parallel *loop;
    unsigned index;
    pthread_t thread;
} worker;

static unsigned processors(void)
{
    cpu_set_t set;
    CPU_ZERO(&set);
    /* more processors than cpu_set_t holds: one failure, and a single thread, is the safe reading */
    if (sched_getaffinity(0, sizeof set, &set) != 0)
        return 1;
    int count = CPU_COUNT(&set);
    return count > 0 ? (unsigned)count : 1;
}

unsigned tl_parallel_workers(const tl_run *run, uint64_t items)
{
    uint64_t count = run && run->threads ? run->threads : processors();
    if (count > MAX_WORKERS)
        count = MAX_WORKERS;
    if (run && run->memory && count > run->memory / THREAD_BYTES)
        count = run->memory / THREAD_BYTES;
    if (count > items)
        count = items;
    return count ? (unsigned)count : 1;
}

static bool cancelled(const tl_run *run)
{
    return run && run->cancel && __atomic_load_n(run->cancel, __ATOMIC_RELAXED);
}

tl_status tl_run_check(const tl_run *run, tl_error *error)
{
    return cancelled(run) ? tl_fail(error, TL_ERROR_CANCELLED, "interrupted") : TL_OK;
}

/* Whether a new failure tells more than the one on record: a cause more than an item that gave up, then the first item.
 */
static bool tells_more(const tl_parallel *loop, uint64_t item, const tl_error *error)
{
    bool old_gave_up = loop->failure.status == TL_ERROR_CANCELLED, new_gave_up = error->status == TL_ERROR_CANCELLED;
    if (loop->failure.status == TL_OK || old_gave_up != new_gave_up)
        return loop->failure.status == TL_OK || old_gave_up;
    return item < loop->failed_item;
}

static void record_failure(tl_parallel *loop, uint64_t item, const tl_error *error)
{
    pthread_mutex_lock(&loop->lock);
    if (tells_more(loop, item, error)) {
        loop->failure = *error;
        loop->failed_item = item;
    }
    atomic_store(&loop->stop, true);
    pthread_cond_broadcast(&loop->changed);
    pthread_mutex_unlock(&loop->lock);
}

/* Takes and runs one item; false when there is none left or the loop has stopped. */
static bool step(tl_parallel *loop, unsigned index)
{
    if (atomic_load(&loop->stop))
        return false;
    uint64_t item = atomic_fetch_add(&loop->next, 1);
    if (item >= loop->items)
        return false;
    tl_error error = {0};
    tl_status status = tl_run_check(loop->run, &error);
    if (status == TL_OK)
        status = loop->body(loop->context, loop, item, index, &error);
    if (status != TL_OK) {
        error.status = status;
        record_failure(loop, item, &error);
        return false;
    }
    atomic_fetch_add(&loop->done, 1);
    return true;
}

static void *work(void *argument)
{
    worker *self = argument;
    tl_parallel *loop = self->loop;
    while (step(loop, self->index))
        ;
    pthread_mutex_lock(&loop->lock);
    loop->running--;
    pthread_cond_broadcast(&loop->changed);
    pthread_mutex_unlock(&loop->lock);
    return NULL;
}

static void report(tl_parallel *loop, uint64_t samples)
{
    if (!loop->run || !loop->run->progress)
        return;
    uint64_t done = atomic_load(&loop->done);
    uint64_t share = loop->items ? (uint64_t)((double)samples * (double)done / (double)loop->items) : samples;
    loop->run->progress(loop->run->user, done == loop->items ? samples : share, samples);
}

static int64_t clock_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

/* Reports when the last report, at *last, is long enough ago. */
static void report_at_times(tl_parallel *loop, uint64_t samples, int64_t *last)
{
    int64_t now = clock_ns();
    if (now - *last < PROGRESS_INTERVAL_NS)
        return;
    *last = now;
    report(loop, samples);
}

static void wait_for_workers(tl_parallel *loop, uint64_t samples)
{
    int64_t last = clock_ns();
    pthread_mutex_lock(&loop->lock);
    while (loop->running) {
        int64_t end = clock_ns() + PROGRESS_INTERVAL_NS;
        struct timespec until = {.tv_sec = end / 1000000000, .tv_nsec = end % 1000000000};
        pthread_cond_clockwait(&loop->changed, &loop->lock, CLOCK_MONOTONIC, &until);
        bool raised = cancelled(loop->run);
        pthread_mutex_unlock(&loop->lock);
        if (raised) { /* an item may be waiting for its turn, and would not look at the flag itself */
            tl_error error = {0};
            tl_run_check(loop->run, &error);
            record_failure(loop, UINT64_MAX, &error);
        }
        report_at_times(loop, samples, &last); /* a turn that ends wakes this thread too */
        pthread_mutex_lock(&loop->lock);
    }
    pthread_mutex_unlock(&loop->lock);
}

static void run_on_caller(tl_parallel *loop, uint64_t samples)
{
    int64_t last = clock_ns();
    while (step(loop, 0))
        report_at_times(loop, samples, &last);
}

/* Starts up to `count` threads; how many there are. */
static unsigned start_workers(tl_parallel *loop, worker *workers, unsigned count)
{
    unsigned started = 0;
    pthread_mutex_lock(&loop->lock); /* so that `running` is right before a worker ends */
    for (; started < count; started++) {
        workers[started] = (worker){.loop = loop, .index = started};
        if (pthread_create(&workers[started].thread, NULL, work, &workers[started]) != 0)
            break;
        loop->running++;
    }
    pthread_mutex_unlock(&loop->lock);
    return started;
}

tl_status tl_parallel_for(const tl_run *run, uint64_t items, uint64_t samples, tl_parallel_item body, void *context,
                          tl_error *error)
{
    tl_parallel loop = {.run = run, .items = items, .body = body, .context = context};
    unsigned count = tl_parallel_workers(run, items), started = 0;
    worker *workers = count > 1 ? malloc(count * sizeof *workers) : NULL;
    pthread_mutex_init(&loop.lock, NULL);
    pthread_cond_init(&loop.changed, NULL);
    if (workers)
        started = start_workers(&loop, workers, count);
    if (started)
        wait_for_workers(&loop, samples);
    else /* one worker, or a system that gives no more threads: the work is done all the same */
        run_on_caller(&loop, samples);
    for (unsigned i = 0; i < started; i++)
        pthread_join(workers[i].thread, NULL);
    free(workers);
    pthread_cond_destroy(&loop.changed);
    pthread_mutex_destroy(&loop.lock);
    if (loop.failure.status != TL_OK) {
        if (error)
            *error = loop.failure;
        return loop.failure.status;
    }
    report(&loop, samples);
    return TL_OK;
}

bool tl_parallel_wait_near(tl_parallel *loop, uint64_t item, uint64_t ahead)
{
    pthread_mutex_lock(&loop->lock);
    while (item - loop->turn >= ahead && !atomic_load(&loop->stop))
        pthread_cond_wait(&loop->changed, &loop->lock);
    bool good = !atomic_load(&loop->stop);
    pthread_mutex_unlock(&loop->lock);
    return good;
}

bool tl_parallel_wait_turn(tl_parallel *loop, uint64_t item)
{
    return tl_parallel_wait_near(loop, item, 1);
}

void tl_parallel_end_turn(tl_parallel *loop, uint64_t item)
{
    pthread_mutex_lock(&loop->lock);
    loop->turn = item + 1;
    pthread_cond_broadcast(&loop->changed);
    pthread_mutex_unlock(&loop->lock);
}

tl_status tl_run_fits(const tl_run *run, double bytes, const char *name, const char *work, tl_error *error)
{
    if (!run || !run->memory || bytes <= (double)run->memory)
        return TL_OK;
    /* of what the program is given a quarter goes to the reader, so a third more than what is missing is enough */
    const double mega = 1 << 20, missing = (bytes - (double)run->memory) * 4 / 3;
    return tl_fail(error, TL_ERROR_MEMORY,
                   "%s: %s takes %.0f MB, where %.0f MB are left for it; raise --memory by %.0f MB", name, work,
                   bytes / mega + 0.5, (double)run->memory / mega, missing / mega + 1);
}
