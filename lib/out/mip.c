#include "lib/out/mip.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <assert.h>
#include <math.h>

tl_status out_mip_init(out_mip *mip, tl_mip kind, int64_t width, int64_t height, const tl_run *run, const char *name,
                       tl_error *error)
{
    *mip = (out_mip){.kind = kind, .count = 1};
    mip->levels[0].width = width;
    mip->levels[0].height = height;
    if (kind == TL_MIP_NONE)
        return TL_OK;
    tl_status status = tl_run_fits(run, (double)width * (double)height * 4 / 3, name, "its coarser levels", error);
    while (status == TL_OK && (width > 1 || height > 1)) {
        struct out_mip_level *next = &mip->levels[mip->count++];
        width = (width + 1) / 2;
        height = (height + 1) / 2;
        next->width = width;
        next->height = height;
        next->heights = tl_alloc_grid(width, height, sizeof *next->heights);
        if (!next->heights)
            status = tl_fail_memory(error, name);
    }
    if (status != TL_OK)
        out_mip_finish(mip);
    return status;
}

void out_mip_finish(out_mip *mip)
{
    for (int k = 0; k < mip->count; k++)
        free(mip->levels[k].heights);
    mip->count = 0;
}

/* The mean of what is known of 2 x 2 samples, fewer at the rim. */
static float mean_of(const float *z, int64_t stride, bool right, bool below)
{
    double sum = 0;
    int count = 0;
    for (int k = 0; k < 4; k++) {
        if ((k & 1 && !right) || (k & 2 && !below))
            continue;
        float height = z[(k & 1) + (k & 2 ? stride : 0)];
        if (!isnan(height)) {
            sum += (double)height;
            count++;
        }
    }
    return count ? (float)(sum / count) : NAN;
}

void out_mip_add(out_mip *mip, int level, tl_window window, const float *heights)
{
    if (level + 1 >= mip->count)
        return;
    assert(window.x % 2 == 0 && window.y % 2 == 0);
    struct out_mip_level *next = &mip->levels[level + 1];
    for (int64_t y = 0; y < window.height; y += 2)
        for (int64_t x = 0; x < window.width; x += 2) {
            const float *z = heights + y * window.width + x;
            next->heights[(window.y + y) / 2 * next->width + (window.x + x) / 2] =
                mip->kind == TL_MIP_LATTICE ? *z
                                            : mean_of(z, window.width, x + 1 < window.width, y + 1 < window.height);
        }
}
