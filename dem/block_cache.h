/* Decoded blocks of rasters, kept within a budget of bytes and shared by threads. */
#ifndef DEM_BLOCK_CACHE_H
#define DEM_BLOCK_CACHE_H

#include <stddef.h>
#include <stdint.h>

typedef struct dem_block_cache dem_block_cache;

/* A block in the cache. It stays while it is pinned. */
typedef struct dem_cached_block dem_cached_block;

/* A cache that drops blocks, the least recently used first, while it holds more than `budget` bytes. `blocks` is how
 * many there are to expect, which sizes the table. NULL when out of memory. */
dem_block_cache *dem_block_cache_create(size_t budget, uint64_t blocks);
/* No block may be pinned. Takes NULL. */
void dem_block_cache_destroy(dem_block_cache *cache);

/* The first of 2^36 consecutive keys that nobody else has got from this cache. */
uint64_t dem_block_cache_keys(dem_block_cache *cache);

/* Threads that want the same block wait for each other instead of decoding it twice. A thread holds at most one of
 * these locks; keys may share one, so some waits are needless. */
void dem_block_cache_lock(dem_block_cache *cache, uint64_t key);
void dem_block_cache_unlock(dem_block_cache *cache, uint64_t key);

/* The block `key`, pinned, or NULL where the cache does not hold it. */
dem_cached_block *dem_block_cache_find(dem_block_cache *cache, uint64_t key);
/* Adds a block and pins it; `heights` (from malloc, `count` items) becomes the cache's. Where another thread was faster
 * its block is kept and given. NULL when out of memory; `heights` is freed then too. */
dem_cached_block *dem_block_cache_add(dem_block_cache *cache, uint64_t key, float *heights, size_t count);
void dem_block_cache_unpin(dem_block_cache *cache, dem_cached_block *block);

const float *dem_cached_block_heights(const dem_cached_block *block);

#endif
