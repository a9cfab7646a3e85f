#include "dem/tiff_samples.h"

#include <float.h>
#include <math.h>
#include <string.h>

/* Every height that a float cannot hold is a void, infinities among them. */
static inline float finish(const dem_value_rule *rule, double stored, float height)
{
    bool is_void = (stored >= rule->void_low && stored <= rule->void_high) || !(fabsf(height) <= FLT_MAX);
    return is_void ? NAN : height;
}

float dem_height_of(const dem_value_rule *rule, double stored)
{
    return finish(rule, stored, rule->plain ? (float)stored : (float)(rule->offset + rule->scale * stored));
}

/* One loop a type, so that the compiler can make vectors of them. The number itself is converted where the rule is
 * plain, for a 64-bit one would be rounded twice by way of double. */
#define DEFINE_CONVERSION(name, type)                                                                          \
    static void name(const dem_value_rule *rule, const void *samples, size_t stride, size_t count, float *out) \
    {                                                                                                          \
        const type *in = samples;                                                                              \
        if (rule->plain)                                                                                       \
            for (size_t k = 0; k < count; k++)                                                                 \
                out[k] = finish(rule, (double)in[k * stride], (float)in[k * stride]);                          \
        else                                                                                                   \
            for (size_t k = 0; k < count; k++)                                                                 \
                out[k] = finish(rule, (double)in[k * stride],                                                  \
                                (float)(rule->offset + rule->scale * (double)in[k * stride]));                 \
    }

DEFINE_CONVERSION(from_uint8, uint8_t)
DEFINE_CONVERSION(from_uint16, uint16_t)
DEFINE_CONVERSION(from_uint32, uint32_t)
DEFINE_CONVERSION(from_uint64, uint64_t)
DEFINE_CONVERSION(from_int8, int8_t)
DEFINE_CONVERSION(from_int16, int16_t)
DEFINE_CONVERSION(from_int32, int32_t)
DEFINE_CONVERSION(from_int64, int64_t)
DEFINE_CONVERSION(from_float32, float)
DEFINE_CONVERSION(from_float64, double)

typedef void conversion(const dem_value_rule *rule, const void *samples, size_t stride, size_t count, float *out);

/* By kind, then by bits: 8, 16, 32, 64. */
static conversion *const conversions[3][4] = {
    [DEM_SAMPLE_UINT] = {from_uint8, from_uint16, from_uint32, from_uint64},
    [DEM_SAMPLE_INT] = {from_int8, from_int16, from_int32, from_int64},
    [DEM_SAMPLE_FLOAT] = {NULL, NULL, from_float32, from_float64},
};

/* A binary floating-point number of 1 sign bit, `exponent_bits` and `mantissa_bits`, as IEEE 754 lays them out. */
static double small_float(uint32_t word, int exponent_bits, int mantissa_bits)
{
    uint32_t mantissa = word & ((1u << mantissa_bits) - 1);
    int largest = (1 << exponent_bits) - 1, bias = largest / 2;
    int exponent = (int)(word >> mantissa_bits) & largest;
    double size;
    if (exponent == largest)
        size = mantissa ? (double)NAN : (double)INFINITY;
    else if (exponent == 0)
        size = ldexp(mantissa, 1 - bias - mantissa_bits);
    else
        size = ldexp(mantissa + (1u << mantissa_bits), exponent - bias - mantissa_bits);
    return word >> (exponent_bits + mantissa_bits) ? -size : size;
}

static bool machine_is_little_endian(void)
{
    const uint16_t one = 1;
    unsigned char first;
    memcpy(&first, &one, 1);
    return first;
}

static uint32_t three_bytes(const unsigned char *bytes, bool lowest_first)
{
    return lowest_first ? bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16
                        : bytes[2] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[0] << 16;
}

/* 24 bits. Floats have the file's byte order; integers are bit strings, the highest first, in files of either order.
 * libtiff takes both for numbers and swaps their bytes in files of the other order than the machine's. */
static uint32_t word24(const dem_layout *layout, const unsigned char *bytes)
{
    bool little = machine_is_little_endian();
    return three_bytes(bytes, layout->kind == DEM_SAMPLE_FLOAT ? little : little == layout->big_endian);
}

/* Samples that are not whole bytes follow each other bit by bit, the highest first. */
static uint32_t packed_bits(const unsigned char *row, size_t first_bit, int bits)
{
    uint64_t word = 0;
    size_t byte = first_bit / 8, last = (first_bit + (size_t)bits - 1) / 8;
    for (size_t k = byte; k <= last; k++)
        word = word << 8 | row[k];
    word >>= (last + 1) * 8 - first_bit - (size_t)bits;
    return (uint32_t)(word & ((UINT64_C(1) << bits) - 1));
}

/* The number that the lowest `bits` of a word are in two's complement. */
static double signed_value(uint32_t word, int bits)
{
    return word >> (bits - 1) ? (double)word - ldexp(1, bits) : (double)word;
}

static double odd_sample(const dem_layout *layout, const unsigned char *row, size_t index)
{
    int bits = layout->bits;
    uint16_t half;
    if (layout->kind == DEM_SAMPLE_FLOAT && bits == 16) {
        memcpy(&half, row + 2 * index, sizeof half);
        return small_float(half, 5, 10);
    }
    uint32_t word = bits == 24 ? word24(layout, row + 3 * index) : packed_bits(row, index * (size_t)bits, bits);
    if (layout->kind == DEM_SAMPLE_FLOAT)
        return small_float(word, 7, 16);
    return layout->kind == DEM_SAMPLE_INT ? signed_value(word, bits) : (double)word;
}

void dem_samples_to_heights(const dem_layout *layout, const void *row, size_t count, float *heights)
{
    size_t stride = layout->separate ? 1 : layout->bands, first = layout->separate ? 0 : layout->band;
    int bits = layout->bits, column = bits == 8 ? 0 : bits == 16 ? 1 : bits == 32 ? 2 : bits == 64 ? 3 : -1;
    conversion *convert = column < 0 ? NULL : conversions[layout->kind][column];
    if (convert) {
        convert(&layout->rule, (const char *)row + first * (size_t)(bits / 8), stride, count, heights);
        return;
    }
    for (size_t k = 0; k < count; k++)
        heights[k] = dem_height_of(&layout->rule, odd_sample(layout, row, first + k * stride));
}
