/* The power spectrum of a raster's windows, and the fBm that has the same. */
#ifndef FBM_SPECTRUM_H
#define FBM_SPECTRUM_H

#include "fbm/status.h"

#include <stdbool.h>
#include <stddef.h>

enum { FBM_SPECTRUM_SIDE_MAX = 128, FBM_SPECTRUM_SIDE_MIN = 32 };

/* Adds |FFT|^2 of a side x side window (a power of two, 32 ... 128), less its least-squares plane and tapered by Hann's
 * cosine along both axes, to power[side * side]: frequency (i, j) at j * side + i, scaled so that white noise of
 * variance 1 has the power 1. Heights are multiplied by `scale` first, which should bring them near 1. All of them must
 * be finite. */
fbm_status fbm_spectrum_add(const float *heights, size_t side, double scale, double *power);

typedef struct fbm_spectrum_fit {
    bool known;
    double hurst, hurst_error; /* the power falls as k^-(2 hurst + 2) */
    double delta;              /* over the unit distance, in heights times the scale */
} fbm_spectrum_fit;

/* The H and delta whose spectrum is likeliest to give the mean power of `windows` windows (P. Whittle 1953; the
 * likelihood of independent exponential ordinates). The model is delta^2 c(H) |k|^-(2H+2), aliased by sampling and
 * smeared by the taper, plus white noise of variance `noise`; frequencies from 5 cycles a window to 3/4 of Nyquist's.
 * The error counts ordinates as dependent as the taper makes them. cell_x, cell_y: distance of samples. `area`: samples
 * are means over their cells. */
fbm_status fbm_spectrum_fit_power(const double *power, size_t side, double windows, double cell_x, double cell_y,
                                  bool area, double noise, fbm_spectrum_fit *out);

/* Mean power at frequencies of k - 1/2 ... k + 1/2 cycles a window, for k = 1 ... side / 2, to radial[k - 1]. */
void fbm_spectrum_radial(const double *power, size_t side, double *radial);

#endif
