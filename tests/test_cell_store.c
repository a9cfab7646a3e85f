/* Numbers of cells that are kept are those that were made, whatever was asked for before. */
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/scene/cell_store.h"
#include "lib/talus.h"

#include <pthread.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <cmocka.h>

enum { ROUNDS = 400, MOST = 96 };

static double number_of(int64_t i, int64_t j)
{
    return (double)(i * 1000003 + j);
}

typedef struct work {
    scene_cell_store *store;
    atomic_int made; /* cells */
    bool fails;
} work;

static tl_status make(const void *context, fbm_window w, double *out, tl_error *error)
{
    work *of = *(work *const *)context;
    if (of->fails)
        return tl_fail(error, TL_ERROR_IO, "no cells");
    for (size_t k = 0; k < w.width * w.height; k++)
        out[k] = number_of(w.i + (int64_t)(k % w.width), w.j + (int64_t)(k / w.width));
    atomic_fetch_add(&of->made, (int)(w.width * w.height));
    return TL_OK;
}

/* Whether a window around (i, j) is right. */
static bool reads_right(work *of, int64_t i, int64_t j, size_t width, size_t height)
{
    fbm_window w = scene_cell_store_window((fbm_window){i, j, width, height, width});
    double *out = malloc(w.width * w.height * sizeof *out);
    bool good = out && w.i <= i && w.j <= j && w.i + (int64_t)w.width >= i + (int64_t)width &&
                w.j + (int64_t)w.height >= j + (int64_t)height &&
                scene_cell_store_read(of->store, w, make, &of, out, "cells", NULL) == TL_OK;
    for (size_t k = 0; good && k < w.width * w.height; k++)
        good = out[k] == number_of(w.i + (int64_t)(k % w.width), w.j + (int64_t)(k / w.width));
    free(out);
    return good;
}

/* Windows near by and far away, whose blocks take each other's places. */
static tl_status read_many(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    uint64_t seed = item * 0x9e3779b97f4a7c15U + 1;
    for (int round = 0; round < ROUNDS; round++) {
        seed = seed * 6364136223846793005U + 1442695040888963407U;
        const int64_t far = (int64_t)(seed >> 60) * INT64_C(1048576) - INT64_C(4194304);
        const int64_t i = (int64_t)(seed >> 50 & 255) - 128 + far, j = (int64_t)(seed >> 40 & 255) - 128 - far;
        if (!reads_right(context, i, j, 1 + (seed >> 30) % MOST, 1 + (seed >> 20) % MOST))
            return tl_fail(error, TL_ERROR_DATA, "wrong cells at %lld, %lld", (long long)i, (long long)j);
    }
    return TL_OK;
}

static void windowsOfManyThreadsAreRight(void **state)
{
    (void)state;
    work w = {.store = scene_cell_store_create(100)};
    assert_non_null(w.store);
    tl_error error = {.text = ""};
    if (tl_parallel_for(&(tl_run){.threads = 3}, 8, 0, read_many, &w, &error) != TL_OK)
        fail_msg("%s", error.text);
    scene_cell_store_destroy(w.store);
}

static void whatWasReadIsNotMadeAgain(void **state)
{
    (void)state;
    work w = {.store = scene_cell_store_create(10000)};
    assert_non_null(w.store);
    assert_true(reads_right(&w, -5, 3, 60, 40));
    const int made = w.made;
    assert_true(reads_right(&w, 10, 10, 20, 20));
    assert_true(reads_right(&w, -5, 3, 60, 40));
    assert_int_equal(w.made, made);
    assert_true(reads_right(&w, 11, 3, 60, 40)); /* two columns of six blocks more */
    assert_int_equal(w.made, made + 2 * 6 * 64);
    scene_cell_store_destroy(w.store);
}

static void whatFailedIsNotKept(void **state)
{
    (void)state;
    work w = {.store = scene_cell_store_create(1), .fails = true};
    assert_non_null(w.store);
    assert_false(reads_right(&w, 0, 0, 9, 9));
    w.fails = false;
    assert_true(reads_right(&w, 0, 0, 9, 9));
    scene_cell_store_destroy(w.store);
    scene_cell_store_destroy(NULL);
}

/* Threads that all want what one of them is making, which takes a while. */
typedef struct crowd {
    scene_cell_store *store;
    atomic_int calls, made, right;
    int fails; /* so many calls */
} crowd;

static tl_status make_slowly(const void *context, fbm_window w, double *out, tl_error *error)
{
    crowd *of = *(crowd *const *)context;
    const int call = atomic_fetch_add(&of->calls, 1);
    nanosleep(&(struct timespec){.tv_nsec = 20000000}, NULL);
    if (call < of->fails)
        return tl_fail(error, TL_ERROR_IO, "no cells");
    for (size_t k = 0; k < w.width * w.height; k++)
        out[k] = number_of(w.i + (int64_t)(k % w.width), w.j + (int64_t)(k / w.width));
    atomic_fetch_add(&of->made, (int)(w.width * w.height));
    return TL_OK;
}

/* Windows of 64 x 64, each 16 cells right of the one before. */
static void *read_slowly(void *context, int64_t number)
{
    crowd *of = context;
    const fbm_window w = {16 * number, 0, 64, 64, 64};
    double *out = malloc(w.width * w.height * sizeof *out);
    bool good = out && scene_cell_store_read(of->store, w, make_slowly, &of, out, "cells", NULL) == TL_OK;
    for (size_t k = 0; good && k < w.width * w.height; k++)
        good = out[k] == number_of(w.i + (int64_t)(k % w.width), w.j + (int64_t)(k / w.width));
    atomic_fetch_add(&of->right, good);
    free(out);
    return NULL;
}

static void *read_first(void *context)
{
    return read_slowly(context, 0);
}

static void *read_second(void *context)
{
    return read_slowly(context, 1);
}

static void read_at_once(crowd *of)
{
    pthread_t threads[4];
    for (int k = 0; k < 4; k++)
        assert_int_equal(pthread_create(&threads[k], NULL, k % 2 ? read_second : read_first, of), 0);
    for (int k = 0; k < 4; k++)
        assert_int_equal(pthread_join(threads[k], NULL), 0);
}

static void whatOneMakesOthersWaitFor(void **state)
{
    (void)state;
    crowd of = {.store = scene_cell_store_create(1000)};
    assert_non_null(of.store);
    read_at_once(&of);
    assert_int_equal(of.right, 4);
    assert_int_equal(of.made, (64 + 16) * 64); /* the same in any order: what lacks is a rectangle */
    scene_cell_store_destroy(of.store);
}

static void whatOneFailsToMakeOthersMake(void **state)
{
    (void)state;
    crowd of = {.store = scene_cell_store_create(1000), .fails = 2};
    assert_non_null(of.store);
    read_at_once(&of);
    assert_int_equal(of.right, 2); /* a call that fails is the end of one read */
    scene_cell_store_destroy(of.store);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(windowsOfManyThreadsAreRight), cmocka_unit_test(whatWasReadIsNotMadeAgain),
        cmocka_unit_test(whatFailedIsNotKept),          cmocka_unit_test(whatOneMakesOthersWaitFor),
        cmocka_unit_test(whatOneFailsToMakeOthersMake),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
