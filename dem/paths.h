/* The files that a user's names stand for. */
#ifndef DEM_PATHS_H
#define DEM_PATHS_H

#include "lib/talus.h"

typedef struct dem_paths {
    char **names; /* each from malloc */
    size_t count, room;
} dem_paths;

/* Expands, in order: `@LIST`, a text file with one name a line (see dem/paths.c); a directory, to the .tif, .tiff and
 * .hgt files in it; a pattern with *, ? or [, where no file has this very name; all else is a file's name, and need not
 * exist. What a directory or a pattern gives is sorted by bytes. At least one name, or an error; on failure *out is
 * empty. */
tl_status dem_paths_expand(const char *const *paths, size_t count, dem_paths *out, tl_error *error);
void dem_paths_finish(dem_paths *paths);

#endif
