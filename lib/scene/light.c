#include "lib/scene/light.h"

#include <math.h>
#include <pthread.h>
#include <stdlib.h>

/* ---- colours ---- */

typedef struct stop {
    float at;
    unsigned hex;
} stop;

/* Greens of valleys, dry slopes, rock, and pale summits: muted, so that the light carries the shape, and brighter with
 * every step, so that no colour looks like a ridge. */
static const stop land[] = {{0.00f, 0x849d80}, {0.18f, 0x9aaf89}, {0.36f, 0xb6bb97}, {0.54f, 0xcbbf9e},
                            {0.70f, 0xcab294}, {0.84f, 0xc9b7a4}, {0.94f, 0xdcd6ce}, {1.00f, 0xf1efeb}};
static const stop sea[] = {{0.00f, 0x1f3f6e}, {0.35f, 0x35669a}, {0.70f, 0x659bc0}, {1.00f, 0xb4d6dd}};
enum { STOPS_MAX = 8, LAND = sizeof land / sizeof *land, SEA = sizeof sea / sizeof *sea };
static const unsigned plain = 0xd9d8d5;

/* Depth below which heights cannot be those of dry land, but for the shores of the Dead Sea. */
static const float sea_depth = -150;

scene_rgb scene_mix(scene_rgb a, scene_rgb b, float t)
{
    return (scene_rgb){a.r + (b.r - a.r) * t, a.g + (b.g - a.g) * t, a.b + (b.b - a.b) * t};
}

static float decode(unsigned byte)
{
    double v = byte / 255.0;
    return (float)(v <= 0.04045 ? v / 12.92 : pow((v + 0.055) / 1.055, 2.4));
}

scene_rgb scene_rgb_of(unsigned hex)
{
    return (scene_rgb){decode(hex >> 16 & 255), decode(hex >> 8 & 255), decode(hex & 255)};
}

/* Slope of a ramp's channel at stop k: between its neighbours, 0 at the ends. */
static float tangent(const stop *ramp, const float *values, int k, int last)
{
    if (k == 0 || k == last)
        return 0;
    return (values[1] - values[-1]) / (ramp[k + 1].at - ramp[k - 1].at);
}

/* Cubic between stops k and k + 1: a broken line would show as contours at its stops. */
static float between(const stop *ramp, const float *values, int k, int last, float t)
{
    float width = ramp[k + 1].at - ramp[k].at, x = (t - ramp[k].at) / width;
    float a = tangent(ramp, values + k, k, last) * width, b = tangent(ramp, values + k + 1, k + 1, last) * width;
    float rise = values[k + 1] - values[k];
    return values[k] + x * (a + x * (3 * rise - 2 * a - b + x * (a + b - 2 * rise)));
}

static scene_rgb on_ramp(const stop *ramp, int stops, float t)
{
    float r[STOPS_MAX], g[STOPS_MAX], b[STOPS_MAX];
    for (int k = 0; k < stops; k++) {
        scene_rgb c = scene_rgb_of(ramp[k].hex);
        r[k] = c.r;
        g[k] = c.g;
        b[k] = c.b;
    }
    t = t > 0 ? t < 1 ? t : 1 : 0;
    int k = 0, last = stops - 1;
    while (k + 1 < last && t > ramp[k + 1].at)
        k++;
    return (scene_rgb){between(ramp, r, k, last, t), between(ramp, g, k, last, t), between(ramp, b, k, last, t)};
}

static int by_height(const void *a, const void *b)
{
    float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

static size_t drop_voids(float *heights, size_t count)
{
    size_t kept = 0;
    for (size_t i = 0; i < count; i++)
        if (isfinite(heights[i]))
            heights[kept++] = heights[i];
    return kept;
}

static scene_rgb colour_at(float height, float low, float high, bool with_sea)
{
    if (with_sea && height < 0)
        return on_ramp(sea, SEA, (height - low) / ((high < 0 ? high : 0) - low));
    float foot = with_sea ? 0 : low;
    return on_ramp(land, LAND, high > foot ? (height - foot) / (high - foot) : 0.35f);
}

void scene_palette_init(scene_palette *palette, float *heights, size_t count, bool grey, bool sea_level)
{
    count = drop_voids(heights, count);
    float low = 0, high = 0;
    if (count) {
        qsort(heights, count, sizeof *heights, by_height);
        low = heights[count / 200];
        high = heights[count - 1 - count / 200];
    }
    bool with_sea = sea_level && count && heights[count / 20] < sea_depth;
    palette->low = low;
    palette->high = high;
    float range = high / 2 - low / 2; /* halves, for the range may exceed what a float holds */
    palette->scale = range > 0 ? SCENE_PALETTE_STEPS / 2 / range : 0;
    for (int k = 0; k <= SCENE_PALETTE_STEPS; k++) {
        float height = low + range * 2 / SCENE_PALETTE_STEPS * (float)k;
        palette->colours[k] = grey ? scene_rgb_of(plain) : colour_at(height, low, high, with_sea);
    }
}

scene_rgb scene_palette_at(const scene_palette *palette, float height)
{
    float step = (height - palette->low) * palette->scale;
    if (!(step > 0)) /* also 0 times infinity */
        return palette->colours[0];
    return palette->colours[step < SCENE_PALETTE_STEPS ? (int)step : SCENE_PALETTE_STEPS];
}

/* ---- light ---- */

static void direction(float out[3], double azimuth, double elevation)
{
    const double radian = 3.14159265358979323846 / 180;
    out[0] = (float)(sin(azimuth * radian) * cos(elevation * radian));
    out[1] = (float)(cos(azimuth * radian) * cos(elevation * radian));
    out[2] = (float)sin(elevation * radian);
}

void scene_light_init(scene_light *light, double azimuth, double elevation)
{
    direction(light->sun, azimuth, elevation);
    direction(light->fill, azimuth - 80, 30);
}

static float facing(const float light[3], const float normal[3])
{
    float cosine = light[0] * normal[0] + light[1] * normal[1] + light[2] * normal[2];
    return cosine > 0 ? cosine : 0;
}

/* Keeps values up to 0.75 and bends the rest towards 1, so that no slope is burnt out. */
static float shoulder(float x)
{
    const float knee = 0.75f;
    if (x <= knee)
        return x;
    float over = (x - knee) / (1 - knee);
    return knee + (1 - knee) * over / (1 + over);
}

scene_rgb scene_lit(const scene_light *light, scene_rgb colour, float east, float north, float shadow)
{
    /* steeper than this is a wall in any picture, and squares stay finite */
    const float wall = 1e4f;
    east = east > wall ? wall : east < -wall ? -wall : east;
    north = north > wall ? wall : north < -wall ? -wall : north;
    float length = 1 / sqrtf(east * east + north * north + 1);
    return scene_lit_normal(light, colour, (const float[3]){-east * length, -north * length, length}, shadow);
}

scene_rgb scene_lit_normal(const scene_light *light, scene_rgb colour, const float normal[3], float shadow)
{
    float sun = 0.98f * facing(light->sun, normal) * shadow;
    float fill = 0.14f * facing(light->fill, normal);
    float sky = 0.26f * (0.5f + 0.5f * normal[2]);
    /* a warm sun, and a cool sky where it does not reach */
    return (scene_rgb){shoulder(colour.r * (1.03f * sun + 0.92f * sky + 0.95f * fill)),
                       shoulder(colour.g * (1.00f * sun + 0.99f * sky + 0.98f * fill)),
                       shoulder(colour.b * (0.93f * sun + 1.22f * sky + 1.08f * fill))};
}

/* ---- sRGB ---- */

enum { ENCODE_STEPS = 8192 };
static unsigned char encoded[ENCODE_STEPS + 1];
static pthread_once_t encode_once = PTHREAD_ONCE_INIT;

static void fill_encoded(void)
{
    for (int k = 0; k <= ENCODE_STEPS; k++) {
        double v = k / (double)ENCODE_STEPS;
        v = v <= 0.0031308 ? 12.92 * v : 1.055 * pow(v, 1 / 2.4) - 0.055;
        encoded[k] = (unsigned char)(v * 255 + 0.5);
    }
}

void scene_encode_prepare(void)
{
    pthread_once(&encode_once, fill_encoded);
}

unsigned char scene_encode(float linear)
{
    if (!(linear > 0))
        return encoded[0];
    return encoded[linear < 1 ? (int)(linear * ENCODE_STEPS + 0.5f) : ENCODE_STEPS];
}
