/* Input files, of which any number can be known while only some are open. */
#ifndef DEM_FILE_POOL_H
#define DEM_FILE_POOL_H

#include "lib/talus.h"

/* Keeps at most about `limit` of its files open: the one that was used the longest ago is closed first, and opened
 * again when it is needed. Files that are in use stay open, so the limit gives way to the number of threads. */
typedef struct dem_file_pool dem_file_pool;

/* NULL when out of memory. */
dem_file_pool *dem_file_pool_create(unsigned limit);
/* Its files must be closed before. Takes NULL. */
void dem_file_pool_destroy(dem_file_pool *pool);

typedef struct dem_file dem_file;

/* Opens `path`, which must be a regular file. `pool` NULL: it stays open until dem_file_close. */
dem_file *dem_file_open(const char *path, dem_file_pool *pool, tl_error *error);
/* Nobody may use it. Takes NULL. */
void dem_file_close(dem_file *file);

const char *dem_file_path(const dem_file *file);
/* Size in bytes when it was opened first. */
int64_t dem_file_size(const dem_file *file);

/* From acquire to release the file is open and may be read. Thread-safe. Fails where it must be opened again and cannot
 * be, or is not the same any more. */
tl_status dem_file_acquire(dem_file *file, tl_error *error);
void dem_file_release(dem_file *file);

/* Reads up to `count` bytes at `offset`; how many there were, -1 (and errno) when the system refuses. */
int64_t dem_file_read_at(const dem_file *file, void *out, int64_t count, int64_t offset);

/* `let_go` is called, with the pool locked, whenever the pool closes the file, so that what was kept for its next use
 * can be freed. */
void dem_file_when_closed(dem_file *file, void (*let_go)(void *user), void *user);

#endif
