#include "lib/out/backlog.h"

#include "lib/base/error.h"

#include <stdlib.h>
#include <string.h>

tl_status out_backlog_init(out_backlog *backlog, unsigned workers, const char *name, tl_error *error)
{
    pthread_mutex_init(&backlog->lock, NULL);
    backlog->room = (uint64_t)workers * OUT_BACKLOG;
    backlog->late = calloc(backlog->room, sizeof *backlog->late);
    return backlog->late ? TL_OK : tl_fail_memory(error, name);
}

void out_backlog_finish(out_backlog *backlog)
{
    for (uint64_t k = 0; backlog->late && k < backlog->room; k++)
        free(backlog->late[k].bytes);
    free(backlog->late);
    pthread_mutex_destroy(&backlog->lock);
}

void out_backlog_restart(out_backlog *backlog)
{
    backlog->next = 0;
}

static tl_status copy_tile(out_late_tile *late, const void *bytes, size_t count, tl_error *error)
{
    if (count > late->capacity) {
        free(late->bytes);
        late->bytes = malloc(count);
        late->capacity = late->bytes ? count : 0;
        if (!late->bytes)
            return tl_fail_memory(error, "tiles that wait for their turn");
    }
    if (count)
        memcpy(late->bytes, bytes, count);
    late->count = count;
    return TL_OK;
}

/* Whether it is this tile's turn, and nobody writes; else its copy, if there is one, is left to who comes to it. */
static bool begin(out_backlog *backlog, uint64_t tile, out_late_tile *copy)
{
    pthread_mutex_lock(&backlog->lock);
    bool first = backlog->next == tile && !backlog->busy;
    if (first)
        backlog->busy = true;
    else if (copy)
        copy->here = true;
    pthread_mutex_unlock(&backlog->lock);
    return first;
}

/* Goes on to the next tile; NULL where it is not there yet. Its place is taken again only when its turn has ended. */
static const out_late_tile *take_next(out_backlog *backlog)
{
    pthread_mutex_lock(&backlog->lock);
    out_late_tile *late = &backlog->late[++backlog->next % backlog->room];
    bool here = late->here;
    backlog->busy = here;
    late->here = false;
    pthread_mutex_unlock(&backlog->lock);
    return here ? late : NULL;
}

/* Takes the tile itself, and gives the buffer of one that was written before for it. */
static bool swap_tile(out_late_tile *late, void **bytes, size_t count, size_t capacity)
{
    void *other = late->capacity == capacity ? late->bytes : malloc(capacity);
    if (!other)
        return false;
    if (late->bytes != other)
        free(late->bytes);
    late->bytes = *bytes;
    late->capacity = capacity;
    late->count = count;
    *bytes = other;
    return true;
}

tl_status out_backlog_add(out_backlog *backlog, tl_parallel *loop, uint64_t tile, const void *bytes, size_t count,
                          tl_error *error)
{
    void *theirs = (void *)bytes; /* left alone where its capacity is 0 */
    return out_backlog_give(backlog, loop, tile, &theirs, count, 0, error);
}

tl_status out_backlog_give(out_backlog *backlog, tl_parallel *loop, uint64_t tile, void **buffer, size_t count,
                           size_t capacity, tl_error *error)
{
    const void *bytes = *buffer;
    if (!tl_parallel_wait_near(loop, tile, backlog->room))
        return tl_fail(error, TL_ERROR_CANCELLED, "interrupted");
    if (!begin(backlog, tile, NULL)) {
        out_late_tile *copy = &backlog->late[tile % backlog->room]; /* free, for the tile before there had its turn */
        bool taken = capacity && swap_tile(copy, buffer, count, capacity);
        tl_status status = taken ? TL_OK : copy_tile(copy, bytes, count, error);
        if (status != TL_OK || !begin(backlog, tile, copy))
            return status;
    }
    tl_status status = backlog->write(backlog->context, tile, bytes, count, error);
    while (status == TL_OK) {
        const out_late_tile *late = take_next(backlog);
        tl_parallel_end_turn(loop, tile++);
        if (!late)
            break;
        status = backlog->write(backlog->context, tile, late->bytes, late->count, error);
    }
    return status;
}
