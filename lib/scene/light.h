/* How the pictures look: colours by height, light by slope. All colours are linear until they are encoded. */
#ifndef SCENE_LIGHT_H
#define SCENE_LIGHT_H

#include "lib/talus.h"

typedef struct scene_rgb {
    float r, g, b;
} scene_rgb;

enum { SCENE_PALETTE_STEPS = 4096 };

/* Colours of heights, in the source's unit. */
typedef struct scene_palette {
    float low, high; /* the heights of the first and the last colour */
    float scale;     /* steps in one unit of height */
    scene_rgb colours[SCENE_PALETTE_STEPS + 1];
} scene_palette;

/* Spreads the colours over the heights between the quantiles of 0.5 % and 99.5 % of `heights`, which are sorted in
 * place (NaN allowed: they are left out). Heights that reach far below 0 on an Earth whose sea level is 0
 * (`sea_level`) are drawn as a sea. */
void scene_palette_init(scene_palette *palette, float *heights, size_t count, bool grey, bool sea_level);
/* Of a height that is no NaN. */
scene_rgb scene_palette_at(const scene_palette *palette, float height);

/* The sun, a dim second light from its right, and the sky. */
typedef struct scene_light {
    float sun[3], fill[3]; /* unit vectors, east, north, up */
} scene_light;

/* Degrees. */
void scene_light_init(scene_light *light, double azimuth, double elevation);
/* The light that a surface sends to the eye: `east` and `north` are its slopes (metres up a metre), `shadow` is 0 where
 * the sun is hidden, 1 where it shines. */
scene_rgb scene_lit(const scene_light *light, scene_rgb colour, float east, float north, float shadow);
/* The same by its normal, of length 1. */
scene_rgb scene_lit_normal(const scene_light *light, scene_rgb colour, const float normal[3], float shadow);

/* A byte of sRGB, for a linear value; what is below 0 or above 1 is cut. */
unsigned char scene_encode(float linear);
/* The colour of a "#RRGGBB" literal's number. */
scene_rgb scene_rgb_of(unsigned hex);
scene_rgb scene_mix(scene_rgb a, scene_rgb b, float t);

/* Must be called before scene_encode; repeated calls are free. */
void scene_encode_prepare(void);

#endif
