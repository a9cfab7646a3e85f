/* Height maps that talus wrote, as sources: 16-bit PNG, R16 and raw floats with the JSON file beside them. */
#ifndef OUT_HEIGHTMAP_READ_H
#define OUT_HEIGHTMAP_READ_H

#include "lib/talus.h"

/* Whether a name ends like one of them. */
bool out_heightmap_is_name(const char *path);
/* A PNG is decoded whole, into two bytes a sample; the others are read as windows are asked for. TL_ERROR_DATA where
 * the JSON file is missing, is of something else, or does not fit. */
tl_source *out_heightmap_open(const char *path, tl_error *error);

#endif
