/* Which kernels this processor runs, found once. */
#include "dem/framework_kernel.h"

#include <stdatomic.h>

extern const tl_error_kernel tl_error_kernel_plain;
#ifdef TL_HAVE_AVX2
extern const tl_error_kernel tl_error_kernel_avx2;
#endif

static const tl_error_kernel *const all[] = {
#ifdef TL_HAVE_AVX2
    &tl_error_kernel_avx2,
#endif
    &tl_error_kernel_plain,
    NULL,
};

const tl_error_kernel *const *tl_error_kernels(void)
{
    /* Threads that race here store the same value. */
    static atomic_size_t chosen; /* 0: not yet; else the index + 1 */
    size_t index = atomic_load_explicit(&chosen, memory_order_relaxed);
    if (!index) {
        index = 1;
#ifdef TL_HAVE_AVX2
        index += !__builtin_cpu_supports("avx2");
#endif
        atomic_store_explicit(&chosen, index, memory_order_relaxed);
    }
    return all + index - 1;
}
