/* What coordinate reference systems mean: from GeoTIFF keys or WKT, to longitude and latitude, to local frames. */
#ifndef DEM_CRS_H
#define DEM_CRS_H

#include "lib/base/georef.h"

struct tiff; /* libtiff's TIFF */

/* The CRS of an open GeoTIFF, with one reference; *out is NULL where the file has none. The keys are kept in it. */
tl_status dem_crs_from_tiff(struct tiff *tiff, const char *path, tl_crs **out, tl_error *error);
/* The same, and what the file's coordinates must be multiplied by to be those of the CRS: 1, unless it is geographic
 * and the file's angles are not in degrees. */
tl_status dem_crs_from_tiff_scaled(struct tiff *tiff, const char *path, tl_crs **out, double *scale, tl_error *error);
/* The CRS of a WKT text (any version), "EPSG:CODE" or a PROJ string; `path` names the file that it is from in messages.
 */
tl_status dem_crs_from_text(const char *text, const char *path, tl_crs **out, tl_error *error);

/* Whether two CRSs give the same places the same horizontal coordinates, by their codes or, where one has none, by
 * PROJ's judgement.
 */
bool dem_crs_equivalent(const tl_crs *a, const tl_crs *b);

/* Between coordinates of a CRS and longitude (east of its own prime meridian) and latitude in degrees on its own datum.
 * GeographicLib's where it has the projection, else PROJ's. Thread-safe as long as each thread has its own. */
typedef struct dem_projection dem_projection;
dem_projection *dem_projection_create(const tl_crs *crs, tl_error *error);
void dem_projection_destroy(dem_projection *projection);
/* In place, n points; x, y become longitude, latitude. What cannot be transformed becomes NaN. */
void dem_projection_to_lonlat(dem_projection *projection, size_t n, double *x, double *y);
/* The other way; longitude, latitude become x, y. */
void dem_projection_from_lonlat(dem_projection *projection, size_t n, double *longitude, double *latitude);
/* Whose formulas it uses: "GeographicLib", "PROJ", or "none" for longitude and latitude themselves. */
const char *dem_projection_engine(const dem_projection *projection);

/* Metres east, north and up in the plane tangent to the ellipsoid at an origin. */
typedef struct dem_local_frame dem_local_frame;
dem_local_frame *dem_local_frame_create(const tl_crs *crs, double longitude, double latitude, double height,
                                        tl_error *error);
void dem_local_frame_destroy(dem_local_frame *frame);
/* Longitude, latitude (degrees) and height (metres) to xyz[3]. */
void dem_local_frame_forward(const dem_local_frame *frame, double longitude, double latitude, double height,
                             double xyz[3]);

/* Fills in cell_x and cell_y of `georef`, whose crs, located and transform are set, for a raster of width x height
 * samples, and height_unit by the vertical part of the CRS where it is 1. Where the transform puts
 * the raster's middle beyond a pole, so that its angles cannot be meant, a degree counts as a metre, as units of an
 * unknown CRS do; a raster that is not located has cells of 1. */
tl_status dem_georef_measure(tl_georef *georef, int64_t width, int64_t height, tl_error *error);

/* Whether a raster in longitude and latitude goes once around: its columns are 360 degrees, to half a cell. */
bool dem_georef_goes_around(const tl_georef *georef, int64_t width);

#endif
