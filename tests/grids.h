/* Small rasters of many kinds, for tests: include behind cmocka.h. */
#ifndef GRIDS_H
#define GRIDS_H

#include "lib/talus.h"

#include <math.h>
#include <stdlib.h>

typedef struct grid {
    int width, height;
    float *z;
} grid;

static uint64_t random_state;

static inline uint64_t random_bits(void)
{
    uint64_t z = random_state += UINT64_C(0x9E3779B97F4A7C15);
    z = (z ^ z >> 30) * UINT64_C(0xBF58476D1CE4E5B9);
    z = (z ^ z >> 27) * UINT64_C(0x94D049BB133111EB);
    return z ^ z >> 31;
}

static inline int random_below(int n)
{
    return (int)(random_bits() % (uint64_t)n);
}

typedef enum terrain { TERRAIN_NOISE, TERRAIN_HILLS, TERRAIN_EIGHTHS, TERRAIN_PLANE, TERRAIN_WIDE, TERRAINS } terrain;

/* All but TERRAIN_WIDE have few enough bits for double arithmetic to be exact, so that a bound is met or missed without
 * doubt. */
static inline float terrain_height(terrain kind, int x, int y, const double wave[4])
{
    double hills = 40 * sin(wave[0] * x + wave[1] * y) + 25 * cos(wave[2] * x - wave[3] * y);
    switch (kind) {
    case TERRAIN_NOISE:
        return (float)random_below(20);
    case TERRAIN_HILLS:
        return (float)(floor(hills) + random_below(3));
    case TERRAIN_EIGHTHS:
        return (float)(floor(hills * 8) / 8 + 500);
    case TERRAIN_PLANE:
        return (float)(3 * x - 2 * y + (random_below(300) == 0));
    default: /* mantissas of 24 random bits over forty powers of two */
        return ldexpf((float)(random_bits() & 0xffffff) * (random_below(2) ? 1.0f : -1.0f), random_below(40) - 40);
    }
}

typedef enum voids {
    VOIDS_NONE,
    VOIDS_FEW,
    VOIDS_THIRD,
    VOIDS_HALF,
    VOIDS_MANY,
    VOIDS_BLOCKS,
    VOIDS_CHECKERBOARD,
    VOIDS_ROWS,
    VOIDS_DIAGONALS,
    VOIDS_KINDS
} voids;

static inline bool is_void(voids kind, int x, int y)
{
    switch (kind) {
    case VOIDS_FEW:
        return random_below(40) == 0;
    case VOIDS_THIRD:
        return random_below(10) < 3;
    case VOIDS_HALF:
        return random_below(2);
    case VOIDS_MANY:
        return random_below(10) < 7;
    case VOIDS_ROWS: /* a plain with single rows and columns that grow out of it and now and then break off */
        return x > 20 && y > 20 && x % 3 && y % 4 && random_below(30);
    case VOIDS_DIAGONALS:
        return (x + y) % 5 && (x - y) % 7 && random_below(40);
    case VOIDS_BLOCKS: /* a third of the plane, with straight and slanting rims */
        return (x / 11 + y / 7) % 3 == 0 || (x + y) % 60 < 9;
    case VOIDS_CHECKERBOARD:
        return (x + y) & 1;
    default:
        return false;
    }
}

static inline grid make_grid(int width, int height, terrain kind, voids holes)
{
    grid out = {width, height, malloc((size_t)width * (size_t)height * sizeof(float))};
    double wave[4];
    assert_non_null(out.z);
    for (int i = 0; i < 4; i++)
        wave[i] = 0.02 + 0.001 * random_below(200);
    for (int y = 0; y < height; y++)
        for (int x = 0; x < width; x++) {
            float z = terrain_height(kind, x, y, wave);
            out.z[y * width + x] = is_void(holes, x, y) ? NAN : z;
        }
    return out;
}

static inline tl_source *open_grid(const grid *from)
{
    static const tl_parameter made[] = {{"made", "by a test"}};
    tl_source_info info = {.width = from->width,
                           .height = from->height,
                           .has_voids = true,
                           .name = "grid",
                           .parameters = made,
                           .parameter_count = 1};
    info.georef = (tl_georef){.transform = {0, 1, 0, 0, 0, -1}, .cell_x = 1, .cell_y = 1, .height_unit = 1};
    tl_source *source = tl_array_source_create(from->z, &info, NULL);
    assert_non_null(source);
    return source;
}

#endif
