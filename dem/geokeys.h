/* The GeoTIFF keys of a file, checked, and where its samples lie. */
#ifndef DEM_GEOKEYS_H
#define DEM_GEOKEYS_H

#include "dem/tiff_file.h"

/* Numbers of keys and values, of the GeoTIFF standard (OGC 19-008r4), that are read without libgeotiff too. */
enum {
    TL_KEY_MODEL_TYPE = 1024,
    TL_KEY_RASTER_TYPE = 1025,
    TL_KEY_CITATION = 1026,
    TL_KEY_GEODETIC_CRS = 2048,
    TL_KEY_GEODETIC_CITATION = 2049,
    TL_KEY_ANGULAR_UNIT = 2054,
    TL_KEY_SEMI_MAJOR_AXIS = 2057,
    TL_KEY_SEMI_MINOR_AXIS = 2058,
    TL_KEY_INVERSE_FLATTENING = 2059,
    TL_KEY_PROJECTED_CRS = 3072,
    TL_KEY_PROJECTED_CITATION = 3073,
    TL_KEY_LINEAR_UNIT = 3076,
    TL_KEY_LINEAR_UNIT_SIZE = 3077,
    TL_KEY_VERTICAL_UNIT = 4099,
    TL_MODEL_PROJECTED = 1,
    TL_MODEL_GEOGRAPHIC = 2,
    TL_RASTER_IS_AREA = 1,
    TL_RASTER_IS_POINT = 2,
    TL_UNIT_DEGREE = 9102,
    TL_UNIT_FOOT = 9002,
    TL_UNIT_US_SURVEY_FOOT = 9003,
};

/* Every entry of the directory is sound: what it points to is there. */
typedef struct dem_geokeys {
    uint16_t *directory; /* header and entries, 4 numbers each; NULL: the file has no keys */
    double *doubles;
    char *ascii; /* ended by a zero */
    size_t directory_count, double_count, ascii_count;
} dem_geokeys;

tl_status dem_geokeys_read(TIFF *tiff, const char *path, dem_geokeys *out, tl_error *error);
/* Drops the entries that are not sound from keys whose directory (of 4 numbers or more), doubles and text come from
 * anywhere, each from malloc. Where one of them is NULL: out of memory, and all are freed. */
tl_status dem_geokeys_check(dem_geokeys *keys, const char *path, tl_error *error);
void dem_geokeys_finish(dem_geokeys *keys);

/* Values of single keys; false, or NULL, where a key is not there as that type. */
bool dem_geokeys_short(const dem_geokeys *keys, uint16_t key, uint16_t *value);
bool dem_geokeys_double(const dem_geokeys *keys, uint16_t key, double *value);
/* The numbers of a key, at most `room` of them; how many there are, 0 where the key is not there. */
size_t dem_geokeys_doubles(const dem_geokeys *keys, uint16_t key, double *values, size_t room);
/* A copy, without the bar that ends it; the caller frees it. */
char *dem_geokeys_text(const dem_geokeys *keys, uint16_t key);

/* AREA where the keys do not say POINT. */
tl_raster_type dem_geokeys_raster_type(const dem_geokeys *keys);
/* Metres in a unit of length, by its code: feet, else a metre. */
double dem_unit_of_length(uint16_t code);
/* Metres in one unit of height. */
double dem_geokeys_height_unit(const dem_geokeys *keys);

/* The transform of sample positions from the pixel scale and tie point, the transformation matrix, or tie points that
 * fit an affine map; false, `transform` untouched, where there is none of them. */
bool dem_tiff_transform(TIFF *tiff, tl_raster_type type, double transform[6]);

#endif
