/* Numbers in the texts of files, read the same way whatever the process's locale. */
#ifndef DEM_TEXT_H
#define DEM_TEXT_H

#include <locale.h>
#include <stdbool.h>

/* The calling thread's locale becomes "C" until dem_locale_leave, for libraries that print or read numbers. */
typedef struct dem_locale {
    locale_t own, before; /* 0: could not be made, nothing changed */
} dem_locale;

dem_locale dem_locale_enter(void);
void dem_locale_leave(dem_locale locale);

/* The number that `text` begins with ("nan" and "inf" too); false, *value untouched, where it begins with none. */
bool dem_parse_number(const char *text, double *value);

/* The item <Item sample="BAND" role="ROLE">number</Item> of a GDAL_METADATA text, band counted from 0; false, *value
 * untouched, where there is none. */
bool dem_band_item(const char *metadata, unsigned band, const char *role, double *value);

#endif
