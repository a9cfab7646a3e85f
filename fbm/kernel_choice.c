/* Which kernels this processor runs, found once. */
#include "fbm/kernel.h"
#include "fbm/relief_kernel.h"

#include <stdatomic.h>
#include <stdbool.h>

extern const fbm_kernel fbm_kernel_plain;
extern const fbm_relief_kernel fbm_relief_kernel_plain;
#ifdef FBM_HAVE_AVX2
extern const fbm_kernel fbm_kernel_avx512, fbm_kernel_avx2;
extern const fbm_relief_kernel fbm_relief_kernel_avx512, fbm_relief_kernel_avx2;
#endif

static const fbm_kernel *const all[] = {
#ifdef FBM_HAVE_AVX2
    &fbm_kernel_avx512,
    &fbm_kernel_avx2,
#endif
    &fbm_kernel_plain,
    NULL,
};

static const fbm_relief_kernel *const all_terrain[] = {
#ifdef FBM_HAVE_AVX2
    &fbm_relief_kernel_avx512,
    &fbm_relief_kernel_avx2,
#endif
    &fbm_relief_kernel_plain,
    NULL,
};

/* Index of the first entry of `all` that runs here. Every processor that runs one entry runs those behind it. */
static size_t find_best(void)
{
    size_t best = 0;
#ifdef FBM_HAVE_AVX2
    bool wide = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
                __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw");
    best = __builtin_cpu_supports("avx2") ? !wide : 2;
#endif
    return best;
}

static size_t best_index(void)
{
    /* Threads that race here store the same value. */
    static atomic_size_t chosen; /* 0: not yet; else the index + 1 */
    size_t index = atomic_load_explicit(&chosen, memory_order_relaxed);
    if (!index) {
        index = find_best() + 1;
        atomic_store_explicit(&chosen, index, memory_order_relaxed);
    }
    return index - 1;
}

const fbm_kernel *const *fbm_kernels(void)
{
    return all + best_index();
}

const fbm_relief_kernel *const *fbm_relief_kernels(void)
{
    return all_terrain + best_index();
}
