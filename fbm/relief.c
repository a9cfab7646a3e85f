#include "fbm/relief.h"

#include "fbm/relief_kernel.h"

#include <string.h>

static int64_t half(int64_t a)
{
    return (a - (a & 1)) / 2;
}

fbm_window fbm_relief_support(fbm_window children)
{
    fbm_window in = {.i = half(children.i) - FBM_RELIEF_MARGIN, .j = half(children.j) - FBM_RELIEF_MARGIN};
    in.width = (size_t)(half(children.i + (int64_t)children.width - 1) + FBM_RELIEF_MARGIN + 1 - in.i);
    in.height = (size_t)(half(children.j + (int64_t)children.height - 1) + FBM_RELIEF_MARGIN + 1 - in.j);
    in.stride = in.width;
    return in;
}

/* The kernel lays its rings out in this, with their margins: 16 of 8 rows of cells and 2 of 8 double rows of children,
 * and 38 rows. */
size_t fbm_relief_scratch(size_t width)
{
    size_t columns = width / 2 + 1 + 2 * FBM_RELIEF_MARGIN;
    return (columns + 32) * (8 * (16 + 2 * 4) + 38);
}

size_t fbm_energy_scratch(size_t width, size_t height)
{
    return 7 * (width + 2 * FBM_ENERGY_MARGIN + 32) * (height + 2 * FBM_ENERGY_MARGIN);
}

void fbm_relief_refine(const fbm_relief_step *step, const float *heights, const float *energy, fbm_window in,
                       float *out, float *out_energy, fbm_window children, float *scratch)
{
    fbm_relief_kernels()[0]->refine(fbm_kernels()[0], step, heights, energy, in, out, out_energy, children, scratch);
}

void fbm_relief_add_sums(const fbm_relief_step *step, const float *heights, const float *energy, fbm_window in,
                         fbm_window children, float *scratch, fbm_relief_sums *sums)
{
    fbm_relief_kernels()[0]->add_sums(fbm_kernels()[0], step, heights, energy, in, children, scratch, sums);
}

void fbm_relief_add_slopes(const fbm_relief_step *step, const float *heights, fbm_window in, fbm_window children,
                           float *scratch, fbm_slopes *slopes)
{
    fbm_relief_kernels()[0]->add_slopes(step, heights, in, children, scratch, slopes);
}

void fbm_relief_add_fit(const fbm_relief_step *step, const float *means, fbm_window in, const float *samples,
                        fbm_window children, const double shares[2], double steep, float *scratch, fbm_relief_fit *fit)
{
    fbm_relief_kernels()[0]->add_fit(step, means, in, samples, children, shares, steep, scratch, fit);
}

void fbm_relief_energy(const float *heights, fbm_window in, float *out, fbm_window out_window, float *scratch)
{
    fbm_relief_kernels()[0]->energy(heights, in, out, out_window, scratch);
}

double fbm_slopes_median(const fbm_slopes *slopes)
{
    uint64_t before = 0;
    for (uint32_t bin = 0; bin < FBM_SLOPE_BINS; bin++) {
        before += slopes->bins[bin];
        if (2 * before < slopes->count || !before)
            continue;
        uint32_t bits = bin << 16 | 0x8000;
        float middle;
        memcpy(&middle, &bits, sizeof middle);
        return (double)middle;
    }
    return 0;
}
