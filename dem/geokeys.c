#include "dem/geokeys.h"

#include "lib/base/error.h"
#include "lib/base/number.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

enum {
    TAG_PIXEL_SCALE = 33550,
    TAG_TIE_POINTS = 33922,
    TAG_MATRIX = 34264,
    TAG_DIRECTORY = 34735,
    TAG_DOUBLES = 34736,
    TAG_ASCII = 34737,
    MAX_KEYS = 100, /* what libgeotiff takes; the standard has fewer */
    MAX_TIE_POINTS = 10000,
};

/* ---- Keys ---- */

/* libgeotiff prints parameters with all their digits into buffers of 64 to 512 bytes on its stack, after multiplying
 * them by the size of a unit. 1e15 squared has 31 digits, of which those hold what it prints; no length, angle or unit
 * of any body is larger. */
static bool doubles_are_sane(const double *values, size_t count)
{
    for (size_t k = 0; k < count; k++)
        if (!(fabs(values[k]) <= 1e15))
            return false;
    return true;
}

/* Whether what an entry (key, tag that holds it, count, value or offset) points to is there. */
static bool entry_is_sound(const dem_geokeys *keys, const uint16_t entry[4])
{
    size_t end = (size_t)entry[2] + entry[3];
    switch (entry[1]) {
    case 0:
        return entry[2] == 1;
    case TAG_DOUBLES:
        return end <= keys->double_count && entry[2] > 0 && doubles_are_sane(keys->doubles + entry[3], entry[2]);
    case TAG_ASCII:
        return end <= keys->ascii_count;
    default: /* shorts behind the directory: no key of the standard is an array of them */
        return false;
    }
}

static void keep_sound_entries(dem_geokeys *keys)
{
    size_t kept = 0, count = (keys->directory_count - 4) / 4;
    if (keys->directory[3] < count)
        count = keys->directory[3];
    for (size_t i = 0; i < count && kept < MAX_KEYS; i++) {
        const uint16_t *entry = keys->directory + 4 + 4 * i;
        if (entry_is_sound(keys, entry))
            memmove(keys->directory + 4 + 4 * kept++, entry, 4 * sizeof *entry);
    }
    keys->directory[3] = (uint16_t)kept;
    keys->directory_count = 4 + 4 * kept;
}

static void *copy_of(const void *items, size_t count, size_t size)
{
    void *copy = tl_alloc(count, size);
    if (copy && count)
        memcpy(copy, items, count * size);
    return copy;
}

tl_status dem_geokeys_read(TIFF *tiff, const char *path, dem_geokeys *out, tl_error *error)
{
    size_t directory_count, double_count;
    const uint16_t *directory = dem_tiff_array(tiff, TAG_DIRECTORY, TIFF_SHORT, &directory_count);
    const double *doubles = dem_tiff_array(tiff, TAG_DOUBLES, TIFF_DOUBLE, &double_count);
    *out = (dem_geokeys){0};
    if (!directory || directory_count < 4)
        return TL_OK;
    out->directory = copy_of(directory, directory_count, sizeof *directory);
    out->doubles = copy_of(doubles, double_count, sizeof *doubles);
    out->ascii = dem_tiff_text(tiff, TAG_ASCII);
    if (!out->ascii)
        out->ascii = calloc(1, 1);
    out->directory_count = directory_count;
    out->double_count = double_count;
    return dem_geokeys_check(out, path, error);
}

tl_status dem_geokeys_check(dem_geokeys *keys, const char *path, tl_error *error)
{
    if (!keys->directory || !keys->doubles || !keys->ascii) {
        dem_geokeys_finish(keys);
        return tl_fail_memory(error, path);
    }
    keys->ascii_count = strlen(keys->ascii);
    keep_sound_entries(keys);
    return TL_OK;
}

void dem_geokeys_finish(dem_geokeys *keys)
{
    free(keys->directory);
    free(keys->doubles);
    free(keys->ascii);
    *keys = (dem_geokeys){0};
}

static const uint16_t *find(const dem_geokeys *keys, uint16_t key, uint16_t location)
{
    for (size_t i = 4; i + 4 <= keys->directory_count; i += 4)
        if (keys->directory[i] == key && keys->directory[i + 1] == location)
            return keys->directory + i;
    return NULL;
}

bool dem_geokeys_short(const dem_geokeys *keys, uint16_t key, uint16_t *value)
{
    const uint16_t *entry = find(keys, key, 0);
    if (entry)
        *value = entry[3];
    return entry != NULL;
}

bool dem_geokeys_double(const dem_geokeys *keys, uint16_t key, double *value)
{
    const uint16_t *entry = find(keys, key, TAG_DOUBLES);
    if (entry)
        *value = keys->doubles[entry[3]];
    return entry != NULL;
}

size_t dem_geokeys_doubles(const dem_geokeys *keys, uint16_t key, double *values, size_t room)
{
    const uint16_t *entry = find(keys, key, TAG_DOUBLES);
    for (size_t k = 0; entry && k < entry[2] && k < room; k++)
        values[k] = keys->doubles[entry[3] + k];
    return entry ? entry[2] : 0;
}

char *dem_geokeys_text(const dem_geokeys *keys, uint16_t key)
{
    const uint16_t *entry = find(keys, key, TAG_ASCII);
    if (!entry)
        return NULL;
    size_t length = entry[2];
    const char *text = keys->ascii + entry[3];
    while (length && (text[length - 1] == '|' || text[length - 1] == ' '))
        length--;
    return strndup(text, length);
}

tl_raster_type dem_geokeys_raster_type(const dem_geokeys *keys)
{
    uint16_t value;
    bool point = dem_geokeys_short(keys, TL_KEY_RASTER_TYPE, &value) && value == TL_RASTER_IS_POINT;
    return point ? TL_RASTER_POINT : TL_RASTER_AREA;
}

double dem_unit_of_length(uint16_t code)
{
    return code == TL_UNIT_FOOT ? 0.3048 : code == TL_UNIT_US_SURVEY_FOOT ? 1200.0 / 3937.0 : 1.0;
}

double dem_geokeys_height_unit(const dem_geokeys *keys)
{
    uint16_t value = 0;
    dem_geokeys_short(keys, TL_KEY_VERTICAL_UNIT, &value);
    return dem_unit_of_length(value);
}

/* ---- Position ---- */

/* From raster coordinates (which for area rasters count from the corner of the first cell) to those of samples. */
static void shift_to_samples(double t[6], tl_raster_type type)
{
    if (type != TL_RASTER_AREA)
        return;
    t[0] += 0.5 * (t[1] + t[2]);
    t[3] += 0.5 * (t[4] + t[5]);
}

/* Rows run south: the second scale counts down, and its sign is disregarded, as GDAL does, for the writers of negative
 * ones mean the same. */
static bool from_scale(TIFF *tiff, double t[6])
{
    size_t scales, numbers;
    const double *scale = dem_tiff_array(tiff, TAG_PIXEL_SCALE, TIFF_DOUBLE, &scales);
    const double *tie = dem_tiff_array(tiff, TAG_TIE_POINTS, TIFF_DOUBLE, &numbers);
    if (!scale || scales < 2 || !tie || numbers < 6 || scale[0] == 0 || scale[1] == 0)
        return false;
    t[1] = scale[0];
    t[2] = t[4] = 0;
    t[5] = -fabs(scale[1]);
    t[0] = tie[3] - tie[0] * t[1];
    t[3] = tie[4] - tie[1] * t[5];
    return tl_transform_is_usable(t);
}

static bool from_matrix(TIFF *tiff, double t[6])
{
    size_t count;
    const double *m = dem_tiff_array(tiff, TAG_MATRIX, TIFF_DOUBLE, &count);
    if (!m || count < 16)
        return false;
    const double transform[6] = {m[3], m[0], m[1], m[7], m[4], m[5]};
    memcpy(t, transform, sizeof transform);
    return tl_transform_is_usable(t);
}

/* Twice the signed area of the triangle of raster positions a, b, c (tie points are i, j, k, x, y, z). */
static double area(const double *a, const double *b, const double *c)
{
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
}

/* The affine map through three tie points, from differences to the first. */
static void through(const double *a, const double *b, const double *c, double t[6])
{
    double whole = area(a, b, c);
    for (int axis = 0; axis < 2; axis++) {
        double db = b[3 + axis] - a[3 + axis], dc = c[3 + axis] - a[3 + axis];
        double *row = t + 3 * axis;
        row[1] = (db * (c[1] - a[1]) - dc * (b[1] - a[1])) / whole;
        row[2] = (dc * (b[0] - a[0]) - db * (c[0] - a[0])) / whole;
        row[0] = a[3 + axis] - row[1] * a[0] - row[2] * a[1];
    }
}

static bool fits(const double *ties, size_t count, const double t[6])
{
    /* a thousandth of a cell: what is left of coordinates that were written with few digits */
    double limit = 1e-3 * (fabs(t[1]) + fabs(t[2]) + fabs(t[4]) + fabs(t[5]));
    for (size_t k = 0; k < count; k++) {
        const double *p = ties + 6 * k;
        double dx = t[0] + t[1] * p[0] + t[2] * p[1] - p[3], dy = t[3] + t[4] * p[0] + t[5] * p[1] - p[4];
        if (!(fabs(dx) <= limit && fabs(dy) <= limit))
            return false;
    }
    return true;
}

/* Three tie points that span a large triangle: the first, the one farthest from it, and the one that adds most area. */
static bool from_tie_points(TIFF *tiff, double t[6])
{
    size_t numbers;
    const double *ties = dem_tiff_array(tiff, TAG_TIE_POINTS, TIFF_DOUBLE, &numbers);
    size_t count = numbers / 6;
    if (!ties || count < 3 || count > MAX_TIE_POINTS)
        return false;
    const double *b = ties, *c = ties;
    for (size_t k = 1; k < count; k++)
        if (hypot(ties[6 * k] - ties[0], ties[6 * k + 1] - ties[1]) > hypot(b[0] - ties[0], b[1] - ties[1]))
            b = ties + 6 * k;
    for (size_t k = 1; k < count; k++)
        if (fabs(area(ties, b, ties + 6 * k)) > fabs(area(ties, b, c)))
            c = ties + 6 * k;
    if (!(fabs(area(ties, b, c)) > 0))
        return false;
    through(ties, b, c, t);
    return tl_transform_is_usable(t) && fits(ties, count, t);
}

bool dem_tiff_transform(TIFF *tiff, tl_raster_type type, double transform[6])
{
    double t[6];
    if (!from_scale(tiff, t) && !from_matrix(tiff, t) && !from_tie_points(tiff, t))
        return false;
    shift_to_samples(t, type);
    memcpy(transform, t, sizeof t);
    return true;
}
