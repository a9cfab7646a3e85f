#include "fbm/rng.h"

#include "fbm/kernel.h"

void fbm_noise_row(uint64_t seed, int32_t level, fbm_noise_kind kind, int64_t row, int64_t first, size_t count,
                   float *out)
{
    fbm_kernels()[0]->noise(seed, level, kind, row, first, count, out);
}
