/* Sizes that cannot overflow unnoticed. */
#ifndef TL_BASE_SIZE_H
#define TL_BASE_SIZE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

/* Whether a * b fits; the product is stored only then. */
static inline bool tl_size_mul(size_t a, size_t b, size_t *product)
{
    return !__builtin_mul_overflow(a, b, product);
}

static inline bool tl_int64_mul(int64_t a, int64_t b, int64_t *product)
{
    return !__builtin_mul_overflow(a, b, product);
}

/* malloc of count items of `size` bytes; NULL where the product overflows. Never returns NULL for 0 bytes only. */
static inline void *tl_alloc(size_t count, size_t size)
{
    size_t bytes;
    if (!tl_size_mul(count, size, &bytes))
        return NULL;
    return malloc(bytes ? bytes : 1);
}

/* The same, for a width x height grid of items. Negative sizes give NULL. */
static inline void *tl_alloc_grid(int64_t width, int64_t height, size_t size)
{
    size_t count;
    if (width < 0 || height < 0 || !tl_size_mul((size_t)width, (size_t)height, &count))
        return NULL;
    return tl_alloc(count, size);
}

static inline int64_t tl_int64_min(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

static inline int64_t tl_int64_max(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

/* ceil(a / b) for a >= 0, b > 0. */
static inline int64_t tl_div_up(int64_t a, int64_t b)
{
    return a / b + (a % b != 0);
}

#endif
