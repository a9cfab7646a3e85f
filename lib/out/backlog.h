/* Tiles that are finished before their turn: workers go on instead of waiting for one that has no processor just now,
 * and the file's bytes are still those of tiles one after the other. */
#ifndef OUT_BACKLOG_H
#define OUT_BACKLOG_H

#include "lib/base/parallel.h"

#include <pthread.h>
#include <stdbool.h>

enum { OUT_BACKLOG = 4 }; /* tiles a worker may be ahead by, copies of which are kept */

typedef struct out_late_tile {
    void *bytes; /* kept for the next tile */
    size_t count, capacity;
    bool here;
} out_late_tile;

typedef struct out_backlog {
    /* Writes one tile; called in order of tiles and by one worker at a time. */
    tl_status (*write)(void *context, uint64_t tile, const void *bytes, size_t count, tl_error *error);
    void *context;
    pthread_mutex_t lock; /* guards all below */
    uint64_t next, room;  /* the tile whose turn it is; how many lie in `late`, tile k in k % room */
    bool busy;            /* somebody writes, or has failed to: then nobody writes behind it */
    out_late_tile *late;
} out_backlog;

/* For loops of this many workers, one loop after the other. out_backlog_finish() is due also after a failure. `name` is
 * that of the file. */
tl_status out_backlog_init(out_backlog *backlog, unsigned workers, const char *name, tl_error *error);
void out_backlog_finish(out_backlog *backlog);
/* Before each loop. */
void out_backlog_restart(out_backlog *backlog);
/* Inside of an item, which must not take a turn besides: writes the item's tile when it is its turn, and those after it
 * that are there; else keeps a copy for whoever comes to it. When the loop has ended well, all is written.
 * TL_ERROR_CANCELLED where the loop has failed. */
tl_status out_backlog_add(out_backlog *backlog, tl_parallel *loop, uint64_t tile, const void *bytes, size_t count,
                          tl_error *error);

/* The same of a buffer of `capacity` bytes from malloc, 0: it is only lent. Where the tile has to wait, *buffer becomes
 * another of that size. */
tl_status out_backlog_give(out_backlog *backlog, tl_parallel *loop, uint64_t tile, void **buffer, size_t count,
                           size_t capacity, tl_error *error);

#endif
