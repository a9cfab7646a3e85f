#include "dem/block_cache.h"

#include "lib/base/size.h"

#include <pthread.h>

enum { MAX_BUCKETS = 1 << 16, LOCKS = 64, KEY_BITS = 36 };

struct dem_cached_block {
    uint64_t key;
    float *heights;
    size_t bytes; /* with this struct */
    unsigned pins;
    dem_cached_block *in_bucket;     /* next of the same bucket */
    dem_cached_block *older, *newer; /* neighbours in the order of use */
};

struct dem_block_cache {
    pthread_mutex_t lock;
    size_t budget, bytes;
    dem_cached_block *oldest, *newest;
    uint64_t ranges; /* of keys, given away */
    pthread_mutex_t decoding[LOCKS];
    uint64_t mask; /* buckets - 1 */
    dem_cached_block *buckets[];
};

dem_block_cache *dem_block_cache_create(size_t budget, uint64_t blocks)
{
    uint64_t count = 16;
    while (count < blocks && count < MAX_BUCKETS)
        count *= 2;
    dem_block_cache *cache = calloc(1, sizeof *cache + (size_t)count * sizeof *cache->buckets);
    if (!cache)
        return NULL;
    cache->budget = budget;
    cache->mask = count - 1;
    pthread_mutex_init(&cache->lock, NULL);
    for (size_t i = 0; i < LOCKS; i++)
        pthread_mutex_init(&cache->decoding[i], NULL);
    return cache;
}

void dem_block_cache_destroy(dem_block_cache *cache)
{
    if (!cache)
        return;
    for (dem_cached_block *block = cache->oldest, *next; block; block = next) {
        next = block->newer;
        free(block->heights);
        free(block);
    }
    pthread_mutex_destroy(&cache->lock);
    for (size_t i = 0; i < LOCKS; i++)
        pthread_mutex_destroy(&cache->decoding[i]);
    free(cache);
}

uint64_t dem_block_cache_keys(dem_block_cache *cache)
{
    pthread_mutex_lock(&cache->lock);
    uint64_t range = cache->ranges++;
    pthread_mutex_unlock(&cache->lock);
    return range << KEY_BITS;
}

/* Keys of neighbouring blocks are consecutive, so their low bits spread well; an odd factor spreads rasters of few
 * blocks. */
static uint64_t spread(uint64_t key)
{
    return key + (key >> KEY_BITS) * 0x9e3779b1;
}

void dem_block_cache_lock(dem_block_cache *cache, uint64_t key)
{
    pthread_mutex_lock(&cache->decoding[spread(key) % LOCKS]);
}

void dem_block_cache_unlock(dem_block_cache *cache, uint64_t key)
{
    pthread_mutex_unlock(&cache->decoding[spread(key) % LOCKS]);
}

static void order_remove(dem_block_cache *cache, dem_cached_block *block)
{
    *(block->older ? &block->older->newer : &cache->oldest) = block->newer;
    *(block->newer ? &block->newer->older : &cache->newest) = block->older;
}

static void order_append(dem_block_cache *cache, dem_cached_block *block)
{
    block->older = cache->newest;
    block->newer = NULL;
    *(cache->newest ? &cache->newest->newer : &cache->oldest) = block;
    cache->newest = block;
}

static dem_cached_block **bucket_of(dem_block_cache *cache, uint64_t key)
{
    return &cache->buckets[spread(key) & cache->mask];
}

static dem_cached_block *find_and_pin(dem_block_cache *cache, uint64_t key)
{
    dem_cached_block *block = *bucket_of(cache, key);
    while (block && block->key != key)
        block = block->in_bucket;
    if (block) {
        block->pins++;
        order_remove(cache, block);
        order_append(cache, block);
    }
    return block;
}

dem_cached_block *dem_block_cache_find(dem_block_cache *cache, uint64_t key)
{
    pthread_mutex_lock(&cache->lock);
    dem_cached_block *block = find_and_pin(cache, key);
    pthread_mutex_unlock(&cache->lock);
    return block;
}

static void drop(dem_block_cache *cache, dem_cached_block *block)
{
    dem_cached_block **link = bucket_of(cache, block->key);
    while (*link != block)
        link = &(*link)->in_bucket;
    *link = block->in_bucket;
    order_remove(cache, block);
    cache->bytes -= block->bytes;
    free(block->heights);
    free(block);
}

static void evict(dem_block_cache *cache)
{
    for (dem_cached_block *block = cache->oldest, *next; block && cache->bytes > cache->budget; block = next) {
        next = block->newer;
        if (!block->pins)
            drop(cache, block);
    }
}

dem_cached_block *dem_block_cache_add(dem_block_cache *cache, uint64_t key, float *heights, size_t count)
{
    dem_cached_block *block = malloc(sizeof *block);
    if (!block) {
        free(heights);
        return NULL;
    }
    pthread_mutex_lock(&cache->lock);
    dem_cached_block *present = find_and_pin(cache, key);
    if (!present) {
        dem_cached_block **bucket = bucket_of(cache, key);
        *block = (dem_cached_block){
            .key = key,
            .heights = heights,
            .bytes = sizeof *block + count * sizeof *heights,
            .pins = 1,
            .in_bucket = *bucket,
        };
        *bucket = block;
        cache->bytes += block->bytes;
        order_append(cache, block);
        evict(cache);
    }
    pthread_mutex_unlock(&cache->lock);
    if (!present)
        return block;
    free(heights);
    free(block);
    return present;
}

/* Where one block alone exceeds the budget it stays until the next one comes: the next window probably needs it. */
void dem_block_cache_unpin(dem_block_cache *cache, dem_cached_block *block)
{
    pthread_mutex_lock(&cache->lock);
    block->pins--;
    pthread_mutex_unlock(&cache->lock);
}

const float *dem_cached_block_heights(const dem_cached_block *block)
{
    return block->heights;
}
