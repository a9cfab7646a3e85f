/* Powers, logarithms and turns from additions and multiplications alone, so that their last bit does not depend on the
 * C library nor on the instructions that it chooses for a processor. For tables and amplitudes, not for samples: about
 * 20 ns. */
#ifndef FBM_ELEMENTARY_H
#define FBM_ELEMENTARY_H

#include <stddef.h>

/* 2^x, to 3 units in the last place. 0 below -1080, infinite above 1024. */
double fbm_exp2(double x);
/* log2 of a finite x > 0, to 3 units in the last place of max(1, |result|). */
double fbm_log2(double x);
/* x^y for finite x >= 0; 0^0 is 1. The relative error is that of the exponent, |y log2 x| 2^-52. */
double fbm_pow(double x, double y);
/* out[k] = fbm_pow(x[k], y), to the last bit, several times as fast: what one waits for the others use. May be in
 * place. */
void fbm_pow_all(const double *x, double y, double *out, size_t count);
/* Cosine and sine of the turn 2 pi k / n, n > 0, n < 2^48, to 2^-52. Exact at multiples of a quarter turn. */
void fbm_turn(size_t k, size_t n, double *cosine, double *sine);

#endif
