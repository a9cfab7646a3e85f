/* Layers in 8 bits. */
#ifndef OUT_LAYER_PAINT_H
#define OUT_LAYER_PAINT_H

#include "lib/talus.h"

/* A sample's bytes: normals from -1 ... 1, slopes of 0 ... 90 degrees, shares as they are, colours as sRGB; all 0 where
 * it is void. Channel c of the sample is values[c * stride]. Call scene_encode_prepare before. */
void out_layer_paint(const tl_layer_kind *kind, const float *values, size_t stride, unsigned char out[4]);

#endif
