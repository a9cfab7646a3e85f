#include "dem/file_pool.h"

#include "lib/base/error.h"

#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

struct dem_file {
    char *path;
    int descriptor;    /* -1: not open */
    struct stat first; /* as it was when it was opened first */
    dem_file_pool *pool;
    unsigned users;
    dem_file *older, *newer; /* neighbours in the order of use, while it is open in a pool */
    void (*let_go)(void *user);
    void *user;
};

struct dem_file_pool {
    pthread_mutex_t lock; /* guards all of the pool, and what its files change */
    unsigned limit, open;
    dem_file *oldest, *newest;
};

dem_file_pool *dem_file_pool_create(unsigned limit)
{
    dem_file_pool *pool = calloc(1, sizeof *pool);
    if (!pool)
        return NULL;
    pool->limit = limit;
    pthread_mutex_init(&pool->lock, NULL);
    return pool;
}

void dem_file_pool_destroy(dem_file_pool *pool)
{
    if (!pool)
        return;
    pthread_mutex_destroy(&pool->lock);
    free(pool);
}

/* ---- Order of use ---- */

static void order_remove(dem_file_pool *pool, dem_file *file)
{
    *(file->older ? &file->older->newer : &pool->oldest) = file->newer;
    *(file->newer ? &file->newer->older : &pool->newest) = file->older;
}

static void order_append(dem_file_pool *pool, dem_file *file)
{
    file->older = pool->newest;
    file->newer = NULL;
    *(pool->newest ? &pool->newest->newer : &pool->oldest) = file;
    pool->newest = file;
}

static void close_descriptor(dem_file *file)
{
    close(file->descriptor);
    file->descriptor = -1;
    if (file->pool) {
        order_remove(file->pool, file);
        file->pool->open--;
    }
    if (file->let_go)
        file->let_go(file->user);
}

/* Closes the file that nobody has used for the longest time; false where all are in use. */
static bool close_oldest(dem_file_pool *pool)
{
    dem_file *file = pool->oldest;
    while (file && file->users)
        file = file->newer;
    if (!file)
        return false;
    close_descriptor(file);
    return true;
}

/* ---- Opening ---- */

/* O_NONBLOCK: opening a named pipe without it waits for a writer. Where the process may open no more files, others of
 * the pool are closed. */
static int open_path(const dem_file *file)
{
    int descriptor;
    do
        descriptor = open(file->path, O_RDONLY | O_CLOEXEC | O_NONBLOCK);
    while (descriptor < 0 &&
           (errno == EINTR || ((errno == EMFILE || errno == ENFILE) && file->pool && close_oldest(file->pool))));
    return descriptor;
}

static tl_status check_kind(const dem_file *file, const struct stat *now, tl_error *error)
{
    if (S_ISDIR(now->st_mode))
        return tl_fail(error, TL_ERROR_DATA, "%s: is a directory; name a GeoTIFF file in it", file->path);
    if (!S_ISREG(now->st_mode))
        return tl_fail(error, TL_ERROR_DATA, "%s: not a regular file; copy its content to one", file->path);
    return TL_OK;
}

static bool same_file(const struct stat *a, const struct stat *b)
{
    return a->st_dev == b->st_dev && a->st_ino == b->st_ino && a->st_size == b->st_size &&
           a->st_mtim.tv_sec == b->st_mtim.tv_sec && a->st_mtim.tv_nsec == b->st_mtim.tv_nsec;
}

static tl_status open_file(dem_file *file, bool again, tl_error *error)
{
    struct stat now;
    int descriptor = open_path(file);
    if (descriptor < 0)
        return tl_fail_system(error, file->path, "read", errno);
    tl_status status = TL_OK;
    if (fstat(descriptor, &now) != 0)
        status = tl_fail_system(error, file->path, "examine", errno);
    else if (again && !same_file(&now, &file->first))
        status = tl_fail(error, TL_ERROR_IO, "%s: was changed while it was being read; run again", file->path);
    else
        status = check_kind(file, &now, error);
    if (status != TL_OK) {
        close(descriptor);
        return status;
    }
    if (!again) /* then it is what it was, and others may be looking at it */
        file->first = now;
    file->descriptor = descriptor;
    if (file->pool) {
        order_append(file->pool, file);
        file->pool->open++;
    }
    return TL_OK;
}

tl_status dem_file_acquire(dem_file *file, tl_error *error)
{
    dem_file_pool *pool = file->pool;
    if (!pool)
        return TL_OK;
    pthread_mutex_lock(&pool->lock);
    tl_status status = TL_OK;
    if (file->descriptor < 0) {
        while (pool->open >= pool->limit && close_oldest(pool))
            ;
        status = open_file(file, true, error);
    } else {
        order_remove(pool, file);
        order_append(pool, file);
    }
    file->users += status == TL_OK;
    pthread_mutex_unlock(&pool->lock);
    return status;
}

void dem_file_release(dem_file *file)
{
    dem_file_pool *pool = file->pool;
    if (!pool)
        return;
    pthread_mutex_lock(&pool->lock);
    file->users--;
    if (!file->users && pool->open > pool->limit)
        close_oldest(pool);
    pthread_mutex_unlock(&pool->lock);
}

static tl_status open_first(dem_file *file, tl_error *error)
{
    dem_file_pool *pool = file->pool;
    if (!pool)
        return open_file(file, false, error);
    pthread_mutex_lock(&pool->lock);
    while (pool->open >= pool->limit && close_oldest(pool))
        ;
    tl_status status = open_file(file, false, error);
    pthread_mutex_unlock(&pool->lock);
    return status;
}

dem_file *dem_file_open(const char *path, dem_file_pool *pool, tl_error *error)
{
    dem_file *file = calloc(1, sizeof *file);
    char *copy = file ? strdup(path) : NULL;
    if (!copy) {
        free(file);
        tl_fail_memory(error, path);
        return NULL;
    }
    file->path = copy;
    file->descriptor = -1;
    file->pool = pool;
    if (open_first(file, error) == TL_OK)
        return file;
    dem_file_close(file);
    return NULL;
}

void dem_file_close(dem_file *file)
{
    if (!file)
        return;
    if (file->pool)
        pthread_mutex_lock(&file->pool->lock);
    if (file->descriptor >= 0)
        close_descriptor(file);
    if (file->pool)
        pthread_mutex_unlock(&file->pool->lock);
    free(file->path);
    free(file);
}

/* ---- Use ---- */

const char *dem_file_path(const dem_file *file)
{
    return file->path;
}

int64_t dem_file_size(const dem_file *file)
{
    return file->first.st_size;
}

void dem_file_when_closed(dem_file *file, void (*let_go)(void *user), void *user)
{
    if (file->pool)
        pthread_mutex_lock(&file->pool->lock);
    file->let_go = let_go;
    file->user = user;
    if (file->pool)
        pthread_mutex_unlock(&file->pool->lock);
}

int64_t dem_file_read_at(const dem_file *file, void *out, int64_t count, int64_t offset)
{
    int64_t done = 0;
    while (done < count) {
        ssize_t got = pread(file->descriptor, (char *)out + done, (size_t)(count - done), (off_t)(offset + done));
        if (got < 0 && errno == EINTR)
            continue;
        if (got < 0 && done == 0)
            return -1;
        if (got <= 0)
            break;
        done += got;
    }
    return done;
}
