/* What a part of a DEM holds: voids, magnitudes, and whether double arithmetic is exact on it. */
#include "dem/framework.h"

#include <math.h>
#include <string.h>

/* The magnitude as an integer of the same order, above those of all finite heights for voids. */
static inline int32_t magnitude_bits(float z)
{
    int32_t bits;
    memcpy(&bits, &z, sizeof bits);
    return bits & INT32_MAX;
}

enum { FINITE_BITS = 0x7f7fffff };

/* No surface passes an infinite height: a void as well. */
void tl_heights_clean(float *z, size_t count)
{
    int32_t most = 0;
    for (size_t i = 0; i < count; i++)
        most = magnitude_bits(z[i]) > most ? magnitude_bits(z[i]) : most;
    for (size_t i = 0; most > FINITE_BITS && i < count; i++)
        if (magnitude_bits(z[i]) > FINITE_BITS)
            z[i] = NAN;
}

float tl_heights_magnitude(const tl_heights *of, bool *voids)
{
    int32_t most = 0, any = 0;
    for (int64_t y = 0; y < of->height; y++) {
        const float *z = of->z + y * of->stride;
        for (int64_t x = 0; x < of->width; x++) {
            int32_t bits = magnitude_bits(z[x]), is_void = bits > FINITE_BITS, finite = is_void ? 0 : bits;
            any |= is_void;
            most = finite > most ? finite : most;
        }
    }
    float magnitude;
    *voids = any;
    memcpy(&magnitude, &most, sizeof magnitude);
    return magnitude;
}

/* A constant c such that (z + c) - c == z only for multiples of a step that leaves double arithmetic exact. Weights of
 * a triangle of legs 2^log are integers up to 4^log, so heights up to m in steps of q are interpolated exactly while
 * m 4^log <= 2^53 q; slopes need three bits more for the same. */
static double rounding_probe(float magnitude, int log)
{
    int exponent;
    frexp((double)magnitude, &exponent);
    return ldexp(1.5, 52 + exponent + 2 * log - 50);
}

/* Whether a height is no multiple of the step behind a rounding probe. */
static bool has_finer(const tl_heights *of, double probe)
{
    int64_t finer = 0;
    for (int64_t y = 0; y < of->height; y++) {
        const float *z = of->z + y * of->stride;
        for (int64_t x = 0; x < of->width; x++)
            finer |= fabs((double)z[x] + probe - probe - (double)z[x]) > 0; /* false for a void */
    }
    return finer;
}

bool tl_heights_round(const tl_heights *of, float magnitude, int log)
{
    return has_finer(of, rounding_probe(magnitude, log));
}
