/* The functions of fbm/relief.h, built once an instruction set. Private to fbm and its tests. */
#ifndef FBM_RELIEF_KERNEL_H
#define FBM_RELIEF_KERNEL_H

#include "fbm/kernel.h"
#include "fbm/relief.h"

typedef struct fbm_relief_kernel {
    const char *name;
    void (*refine)(const fbm_kernel *noise, const fbm_relief_step *step, const float *heights, const float *energy,
                   fbm_window in, float *out, float *out_energy, fbm_window children, float *scratch);
    void (*add_sums)(const fbm_kernel *noise, const fbm_relief_step *step, const float *heights, const float *energy,
                     fbm_window in, fbm_window children, float *scratch, fbm_relief_sums *sums);
    void (*add_slopes)(const fbm_relief_step *step, const float *heights, fbm_window in, fbm_window children,
                       float *scratch, fbm_slopes *slopes);
    void (*add_fit)(const fbm_relief_step *step, const float *means, fbm_window in, const float *samples,
                    fbm_window children, const double shares[2], double steep, float *scratch, fbm_relief_fit *fit);
    void (*energy)(const float *heights, fbm_window in, float *out, fbm_window out_window, float *scratch);
} fbm_relief_kernel;

/* In the order of fbm_kernels(). */
const fbm_relief_kernel *const *fbm_relief_kernels(void);

#endif
