/* CRSs in files of other formats than GeoTIFF: their keys as text, and texts that stand for keys. */
#ifndef DEM_CRS_KEYS_H
#define DEM_CRS_KEYS_H

#include "lib/base/georef.h"

/* The GeoTIFF keys that a CRS came with, as one text, to be freed: the directory's numbers, then the doubles by their
 * bits, each in 16 hexadecimal digits, then the text of the keys, with semicolons between the three. NULL where it has
 * none, or when out of memory. */
char *dem_crs_keys_text(const tl_crs *crs);
/* Gives the keys in such a text to a CRS that has none. What is no such text changes nothing; only running out of
 * memory fails. */
tl_status dem_crs_take_keys(tl_crs *crs, const char *text, const char *path, tl_error *error);

/* The horizontal part of a CRS in ESRI's form of WKT, which GeoTIFF keys may quote, to be freed; NULL where there is
 * none. */
char *dem_crs_esri_text(const tl_crs *crs);

/* EPSG code of the datum of a CRS's horizontal part, 0 where it has none. */
int dem_crs_datum_code(const tl_crs *crs);

#endif
