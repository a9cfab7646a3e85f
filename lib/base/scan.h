/* Reading a source once from end to end. */
#ifndef TL_BASE_SCAN_H
#define TL_BASE_SCAN_H

#include "lib/talus.h"

/* Takes some heights of an item; those of one item come in order and on one thread, items in any order. */
typedef void tl_scan_visit(void *context, uint64_t item, unsigned worker, const float *heights, size_t count);

/* Number of items, blocks or bands of rows, that a source is scanned in. They depend on its size and blocks alone. */
uint64_t tl_scan_items(const tl_source *source);
/* Workers that a scan uses. */
unsigned tl_scan_workers(const tl_source *source, const tl_run *run);
/* Shows every height of the finest level to `visit`, in parallel, with 1 MB of memory a worker. */
tl_status tl_scan(const tl_source *source, const tl_run *run, tl_scan_visit *visit, void *context, tl_error *error);

#endif
