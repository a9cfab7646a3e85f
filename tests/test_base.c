/* The floor: errors, sizes, parallel loops, output files, sources over arrays. */
#define _GNU_SOURCE /* mkdtemp */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/output.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>

#include <cmocka.h>

#include <dirent.h>
#include <fcntl.h>
#include <math.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

/* ---- errors and sizes ---- */

static void errorTextIsOnePrintableLine(void **state)
{
    (void)state;
    tl_error error;
    assert_int_equal(tl_fail(&error, TL_ERROR_DATA, "%s: bad", "evil\n\033[31mname"), TL_ERROR_DATA);
    assert_string_equal(error.text, "evil??[31mname: bad");
    assert_int_equal(tl_fail(NULL, TL_ERROR_IO, "nobody listens"), TL_ERROR_IO);
}

static void everyStatusHasAName(void **state)
{
    (void)state;
    for (int s = TL_OK; s <= TL_ERROR_CANCELLED; s++)
        assert_string_not_equal(tl_status_name((tl_status)s), "unknown status");
    assert_string_equal(tl_status_name((tl_status)99), "unknown status");
}

static void productsThatOverflowAreRefused(void **state)
{
    (void)state;
    size_t product = 7;
    assert_false(tl_size_mul(SIZE_MAX / 2, 3, &product));
    assert_true(tl_size_mul(1000, 1000, &product));
    assert_int_equal(product, 1000000);
    assert_null(tl_alloc(SIZE_MAX / 2, 4));
    assert_null(tl_alloc_grid(INT64_MAX, INT64_MAX, 4));
    assert_null(tl_alloc_grid(-1, 4, 4));
    void *none = tl_alloc(0, 4);
    assert_non_null(none);
    free(none);
}

/* ---- parallel loops ---- */

typedef struct marks {
    atomic_int seen[1000];
    atomic_uint most_workers;
    uint64_t order[1000];
    size_t ordered;
    uint64_t fail_at;
} marks;

static tl_status mark(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    marks *m = context;
    if (item == m->fail_at)
        return tl_fail(error, TL_ERROR_DATA, "item %d", (int)item);
    atomic_fetch_add(&m->seen[item], 1);
    if (worker > atomic_load(&m->most_workers))
        atomic_store(&m->most_workers, worker);
    return TL_OK;
}

static void parallelForRunsEveryItemOnce(void **state)
{
    (void)state;
    for (unsigned threads = 1; threads <= 5; threads++) {
        marks m = {.fail_at = UINT64_MAX};
        tl_run run = {.threads = threads};
        assert_int_equal(tl_parallel_for(&run, 1000, 1000, mark, &m, NULL), TL_OK);
        for (int i = 0; i < 1000; i++)
            assert_int_equal(m.seen[i], 1);
        assert_true(m.most_workers < tl_parallel_workers(&run, 1000));
    }
    assert_int_equal(tl_parallel_for(NULL, 0, 0, mark, NULL, NULL), TL_OK);
    assert_int_equal(tl_parallel_workers(&(tl_run){.threads = 8}, 3), 3);
}

static void parallelForReportsTheFailure(void **state)
{
    (void)state;
    for (unsigned threads = 1; threads <= 4; threads++) {
        marks m = {.fail_at = 500};
        tl_run run = {.threads = threads};
        tl_error error = {0};
        assert_int_equal(tl_parallel_for(&run, 1000, 1000, mark, &m, &error), TL_ERROR_DATA);
        assert_string_equal(error.text, "item 500");
    }
}

static tl_status take_turn(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)worker;
    marks *m = context;
    if (!tl_parallel_wait_turn(loop, item))
        return tl_fail(error, TL_ERROR_CANCELLED, "gave up");
    if (item == m->fail_at)
        return tl_fail(error, TL_ERROR_IO, "item %d", (int)item);
    m->order[m->ordered++] = item; /* no lock: only one item at a time is here */
    tl_parallel_end_turn(loop, item);
    return TL_OK;
}

static void turnsComeInOrder(void **state)
{
    (void)state;
    marks m = {.fail_at = UINT64_MAX};
    tl_run run = {.threads = 4};
    assert_int_equal(tl_parallel_for(&run, 1000, 1000, take_turn, &m, NULL), TL_OK);
    for (uint64_t i = 0; i < 1000; i++)
        assert_int_equal(m.order[i], i);
}

static void nobodyGoesOnBehindAFailedTurn(void **state)
{
    (void)state;
    marks m = {.fail_at = 100};
    tl_run run = {.threads = 4};
    tl_error error = {0};
    assert_int_equal(tl_parallel_for(&run, 1000, 1000, take_turn, &m, &error), TL_ERROR_IO);
    assert_string_equal(error.text, "item 100"); /* the cause, not those that gave up for it */
    assert_int_equal(m.ordered, 100);
}

typedef struct cancelling {
    int flag;
    uint64_t at;
} cancelling;

static tl_status cancel_at(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)worker;
    cancelling *c = context;
    if (item == c->at)
        *(volatile int *)&c->flag = 1; /* keeps its turn: the others wait until the flag is seen */
    else if (!tl_parallel_wait_turn(loop, item))
        return tl_fail(error, TL_ERROR_CANCELLED, "gave up");
    else
        tl_parallel_end_turn(loop, item);
    return TL_OK;
}

static void cancellingEndsTheLoopAndWakesWaiters(void **state)
{
    (void)state;
    cancelling c = {.at = 10};
    tl_run run = {.threads = 1, .cancel = &c.flag};
    tl_error error = {0};
    assert_int_equal(tl_parallel_for(&run, 1000, 1000, cancel_at, &c, &error), TL_ERROR_CANCELLED);
    c.flag = 0;
    run.threads = 3;
    assert_int_equal(tl_parallel_for(&run, 1000, 1000, cancel_at, &c, &error), TL_ERROR_CANCELLED);
}

static void keep_last(void *user, uint64_t done, uint64_t total)
{
    uint64_t *last = user;
    assert_true(done >= last[0] && done <= total);
    last[0] = done;
    last[1] = total;
}

static void progressEndsAtTheWhole(void **state)
{
    (void)state;
    for (unsigned threads = 1; threads <= 2; threads++) {
        uint64_t last[2] = {0, 0};
        marks m = {.fail_at = UINT64_MAX};
        tl_run run = {.threads = threads, .progress = keep_last, .user = last};
        assert_int_equal(tl_parallel_for(&run, 1000, 777, mark, &m, NULL), TL_OK);
        assert_int_equal(last[0], 777);
        assert_int_equal(last[1], 777);
    }
}

/* ---- output files ---- */

typedef struct folder {
    char name[64];
    char path[128];
} folder;

static int makeFolder(void **state)
{
    folder *f = calloc(1, sizeof *f);
    strcpy(f->name, "/tmp/talus-test-XXXXXX");
    assert_non_null(mkdtemp(f->name));
    snprintf(f->path, sizeof f->path, "%s/file.bin", f->name);
    *state = f;
    return 0;
}

static int removeFolder(void **state)
{
    folder *f = *state;
    unlink(f->path);
    rmdir(f->name);
    free(f);
    return 0;
}

static int entries(const char *name)
{
    DIR *dir = opendir(name);
    int count = 0;
    for (struct dirent *e; (e = readdir(dir));)
        count += strcmp(e->d_name, ".") != 0 && strcmp(e->d_name, "..") != 0;
    closedir(dir);
    return count;
}

static void outputAppearsOnlyWhenComplete(void **state)
{
    const folder *f = *state;
    tl_error error;
    tl_output *output = tl_output_open(f->path, false, &error);
    assert_non_null(output);
    char byte = 'x';
    for (int i = 0; i < 600000; i++) /* more than the buffer holds */
        assert_int_equal(tl_output_append(output, &byte, 1, &error), TL_OK);
    assert_int_equal(access(f->path, F_OK), -1);
    assert_int_equal(tl_output_commit(output, &error), TL_OK);
    struct stat status;
    assert_int_equal(stat(f->path, &status), 0);
    assert_int_equal(status.st_size, 600000);
    assert_int_equal(entries(f->name), 1);
}

static void abortedOutputLeavesNothing(void **state)
{
    const folder *f = *state;
    tl_output *output = tl_output_open(f->path, false, NULL);
    assert_non_null(output);
    assert_int_equal(tl_output_append(output, "abc", 3, NULL), TL_OK);
    tl_output_abort(output);
    tl_output_abort(NULL);
    assert_int_equal(entries(f->name), 0);
}

static void write_text(const char *path, bool overwrite, const char *text)
{
    tl_output *output = tl_output_open(path, overwrite, NULL);
    assert_non_null(output);
    assert_int_equal(tl_output_append(output, text, strlen(text), NULL), TL_OK);
    assert_int_equal(tl_output_commit(output, NULL), TL_OK);
}

static void existingFileIsKeptUnlessOverwriting(void **state)
{
    const folder *f = *state;
    write_text(f->path, false, "old");
    tl_error error;
    assert_null(tl_output_open(f->path, false, &error));
    assert_non_null(strstr(error.text, "--overwrite"));
    write_text(f->path, true, "newer");
    struct stat status;
    assert_int_equal(stat(f->path, &status), 0);
    assert_int_equal(status.st_size, 5);
    assert_int_equal(entries(f->name), 1);
}

static void replacedFileKeepsPermissionsAndLinks(void **state)
{
    const folder *f = *state;
    char link_path[160], name[400], longest[256];
    struct stat status;
    write_text(f->path, false, "old");
    assert_int_equal(chmod(f->path, 0600), 0);
    snprintf(link_path, sizeof link_path, "%s/link", f->name);
    assert_int_equal(symlink("file.bin", link_path), 0);
    write_text(link_path, true, "newer");
    assert_int_equal(lstat(link_path, &status), 0);
    assert_true(S_ISLNK(status.st_mode));
    assert_int_equal(stat(f->path, &status), 0);
    assert_int_equal(status.st_size, 5);
    assert_int_equal(status.st_mode & 0777, 0600);
    unlink(link_path);
    /* a name as long as names may be can be replaced too */
    memset(longest, 'x', 255);
    longest[255] = '\0';
    snprintf(name, sizeof name, "%s/%s", f->name, longest);
    write_text(name, false, "one");
    write_text(name, true, "two");
    unlink(name);
    assert_int_equal(entries(f->name), 1);
}

static void fileThatAppearsMeanwhileIsNotReplaced(void **state)
{
    const folder *f = *state;
    tl_error error;
    tl_output *output = tl_output_open(f->path, false, &error);
    assert_non_null(output);
    write_text(f->path, false, "theirs");
    assert_int_equal(tl_output_append(output, "ours", 4, &error), TL_OK);
    assert_int_equal(tl_output_commit(output, &error), TL_ERROR_IO);
    struct stat status;
    assert_int_equal(stat(f->path, &status), 0);
    assert_int_equal(status.st_size, 6);
    assert_int_equal(entries(f->name), 1);
}

static void impossibleOutputsAreRefusedAtOnce(void **state)
{
    const folder *f = *state;
    tl_error error;
    char path[160];
    assert_null(tl_output_open("", false, &error));
    assert_null(tl_output_open(f->name, true, &error));
    assert_non_null(strstr(error.text, "directory"));
    snprintf(path, sizeof path, "%s/none/file", f->name);
    assert_null(tl_output_open(path, false, &error));
    assert_non_null(strstr(error.text, "No such file"));
    assert_int_equal(error.status, TL_ERROR_IO);
}

static void fullDiskIsTold(void **state)
{
    (void)state;
    /* /dev/full refuses every write, whatever is opened on it; the descriptor of an output is replaced by one to it */
    tl_output *output = tl_output_open("/tmp/talus-test-full", true, NULL);
    assert_non_null(output);
    int full = open("/dev/full", O_WRONLY);
    assert_true(full >= 0 && dup2(full, tl_output_descriptor(output)) >= 0);
    close(full);
    tl_error error;
    assert_int_equal(tl_output_write_at(output, "x", 1, 0, &error), TL_ERROR_IO);
    assert_non_null(strstr(error.text, "No space left"));
    tl_output_abort(output);
}

/* ---- sources and meshes ---- */

static tl_source_info info_of(int64_t width, int64_t height)
{
    return (tl_source_info){.width = width, .height = height, .georef = tl_georef_none(), .name = "array"};
}

static void arraySourceReadsWindows(void **state)
{
    (void)state;
    float heights[12], part[4];
    for (int i = 0; i < 12; i++)
        heights[i] = (float)i;
    tl_source_info info = info_of(4, 3);
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    assert_non_null(source);
    assert_int_equal(tl_source_read(source, 0, (tl_window){1, 1, 2, 2}, part, NULL), TL_OK);
    assert_true(part[0] == 5 && part[1] == 6 && part[2] == 9 && part[3] == 10);
    int64_t width, height;
    tl_error error;
    assert_int_equal(tl_source_size(source, 1, &width, &height, &error), TL_ERROR_ARGUMENT);
    tl_source_destroy(source);
    tl_source_destroy(NULL);
}

static void meshKeepsItsParameters(void **state)
{
    (void)state;
    const tl_parameter given[2] = {{"a", "1"}, {"b", "two"}};
    tl_source_info info = info_of(2, 2);
    info.parameters = given;
    info.parameter_count = 2;
    tl_mesh *mesh = tl_mesh_create(4, 2, &info, NULL);
    assert_non_null(mesh);
    assert_int_equal(tl_mesh_add_parameter(mesh, "c", "three", NULL), TL_OK);
    assert_int_equal(mesh->parameter_count, 3);
    assert_string_equal(mesh->parameters[1].value, "two");
    assert_string_equal(mesh->parameters[2].name, "c");
    tl_mesh_destroy(mesh);
    tl_mesh_destroy(NULL);
}

static void crsLivesUntilItsLastOwner(void **state)
{
    (void)state;
    tl_crs *crs = tl_crs_allocate();
    crs->name = strdup("name");
    crs->wkt = strdup("");
    assert_ptr_equal(tl_crs_retain(crs), crs);
    tl_crs_release(crs);
    assert_string_equal(tl_crs_name(crs), "name");
    tl_crs_release(crs);
    tl_crs_release(NULL);
    assert_null(tl_crs_retain(NULL));
}

/* 200 x 150 heights of 100 ... 899.9, of which every 500th is `low` and the one behind it `high`, where these are not
 * NaN. */
static size_t findSuspects(float low, float high, unsigned threads, tl_suspect out[TL_MAX_SUSPECTS])
{
    enum { WIDTH = 200, HEIGHT = 150 };
    static float heights[WIDTH * HEIGHT];
    for (int k = 0; k < WIDTH * HEIGHT; k++) {
        heights[k] = 100 + (float)(k * 7919 % 8000) / 10;
        if (k % 500 == 0 && !isnan(low))
            heights[k] = low;
        if (k % 500 == 1 && !isnan(high))
            heights[k] = high;
    }
    heights[17] = NAN;
    tl_source_info info = {.width = WIDTH, .height = HEIGHT, .name = "heights", .georef = tl_georef_none()};
    tl_source *source = tl_array_source_create(heights, &info, NULL);
    const tl_run run = {.threads = threads};
    size_t count = 99;
    assert_int_equal(tl_source_suspects(source, &run, out, &count, NULL), TL_OK);
    tl_source_destroy(source);
    return count;
}

static void lonelyHeightsAreSuspects(void **state)
{
    (void)state;
    /* the rest has a range of 799.9: a value with a name must be 80 away, one without 400 */
    static const struct {
        float low, high;
        size_t count;
    } cases[] = {{NAN, NAN, 0},  {-9999, NAN, 1}, {NAN, 32767, 1}, {-9999, 65535, 2}, {-1e37f, 3.4028235e38f, 2},
                 {-310, NAN, 1}, {-290, NAN, 0},  {NAN, 1310, 1},  {NAN, 1290, 0},    {-32768, 1e6f, 2},
                 {0, NAN, 0}};
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        tl_suspect found[TL_MAX_SUSPECTS];
        assert_int_equal(findSuspects(cases[k].low, cases[k].high, 2, found), cases[k].count);
        for (size_t i = 0; i < cases[k].count; i++) {
            assert_true(found[i].value == cases[k].low || found[i].value == cases[k].high);
            assert_int_equal(found[i].count, 60);
        }
    }
}

static void suspectsNeedARest(void **state)
{
    (void)state;
    static const struct {
        float heights[6];
        size_t count;
    } cases[] = {{{0, 1, 0, 1, 0, 1}, 0},
                 {{5, 5, 5, 5, 5, 5}, 0},
                 {{NAN, NAN, NAN, NAN, NAN, NAN}, 0},
                 {{-9999, 5, 5, 5, 5, 5}, 1},
                 {{-9999, -9999, NAN, NAN, NAN, NAN}, 0},
                 {{-9999, 7, 7, 8, 65535, 9}, 2},
                 {{0, 1, 2, 3, 4, 900}, 0}};
    tl_source_info info = {.width = 3, .height = 2, .name = "six", .georef = tl_georef_none()};
    for (size_t k = 0; k < sizeof cases / sizeof *cases; k++) {
        tl_source *source = tl_array_source_create(cases[k].heights, &info, NULL);
        tl_suspect found[TL_MAX_SUSPECTS];
        size_t count = 99;
        assert_int_equal(tl_source_suspects(source, NULL, found, &count, NULL), TL_OK);
        assert_int_equal(count, cases[k].count);
        tl_source_destroy(source);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(errorTextIsOnePrintableLine),
        cmocka_unit_test(everyStatusHasAName),
        cmocka_unit_test(productsThatOverflowAreRefused),
        cmocka_unit_test(parallelForRunsEveryItemOnce),
        cmocka_unit_test(parallelForReportsTheFailure),
        cmocka_unit_test(turnsComeInOrder),
        cmocka_unit_test(nobodyGoesOnBehindAFailedTurn),
        cmocka_unit_test(cancellingEndsTheLoopAndWakesWaiters),
        cmocka_unit_test(progressEndsAtTheWhole),
        cmocka_unit_test_setup_teardown(outputAppearsOnlyWhenComplete, makeFolder, removeFolder),
        cmocka_unit_test_setup_teardown(abortedOutputLeavesNothing, makeFolder, removeFolder),
        cmocka_unit_test_setup_teardown(existingFileIsKeptUnlessOverwriting, makeFolder, removeFolder),
        cmocka_unit_test_setup_teardown(replacedFileKeepsPermissionsAndLinks, makeFolder, removeFolder),
        cmocka_unit_test_setup_teardown(fileThatAppearsMeanwhileIsNotReplaced, makeFolder, removeFolder),
        cmocka_unit_test_setup_teardown(impossibleOutputsAreRefusedAtOnce, makeFolder, removeFolder),
        cmocka_unit_test(fullDiskIsTold),
        cmocka_unit_test(arraySourceReadsWindows),
        cmocka_unit_test(meshKeepsItsParameters),
        cmocka_unit_test(crsLivesUntilItsLastOwner),
        cmocka_unit_test(lonelyHeightsAreSuspects),
        cmocka_unit_test(suspectsNeedARest),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
