/* A TIFF file that many threads read: one descriptor, several libtiff handles over it, and libtiff's messages caught.
 */
#ifndef DEM_TIFF_FILE_H
#define DEM_TIFF_FILE_H

#include "lib/talus.h"

#include <tiffio.h>

typedef struct dem_tiff_file dem_tiff_file;

/* A libtiff handle at the file's first directory. One thread at a time uses it. */
typedef struct dem_tiff_handle {
    TIFF *tiff;
    const dem_tiff_file *file;
    uint64_t position;
    char message[200]; /* libtiff's first complaint since dem_tiff_forget */
    void *scratch;     /* see dem_tiff_scratch */
    size_t scratch_bytes;
    struct dem_tiff_handle *next;
} dem_tiff_handle;

/* Opens `path`, which must be a regular file that begins as TIFF files do. */
dem_tiff_file *dem_tiff_file_open(const char *path, tl_error *error);
/* All handles must be back. Takes NULL. */
void dem_tiff_file_close(dem_tiff_file *file);
const char *dem_tiff_file_path(const dem_tiff_file *file);
/* Size in bytes when it was opened. */
int64_t dem_tiff_file_size(const dem_tiff_file *file);

/* A handle for this thread until dem_tiff_give_back. */
tl_status dem_tiff_take(dem_tiff_file *file, dem_tiff_handle **out, tl_error *error);
void dem_tiff_give_back(dem_tiff_file *file, dem_tiff_handle *handle);

/* Closes a handle instead of giving it back. */
void dem_tiff_drop(dem_tiff_handle *handle);

/* Memory for the handle's user, of undefined content, until the next call; NULL when out of memory. */
void *dem_tiff_scratch(dem_tiff_handle *handle, size_t bytes);

void dem_tiff_forget(dem_tiff_handle *handle);
/* What libtiff said, or `otherwise` where it said nothing. */
const char *dem_tiff_message(const dem_tiff_handle *handle, const char *otherwise);

/* The values of an array tag that libtiff may or may not know, as `type` (TIFF_SHORT, TIFF_DOUBLE or TIFF_ASCII);
 * NULL where the tag is absent or of another type. They belong to the handle and live until its directory changes. */
const void *dem_tiff_array(TIFF *tiff, uint32_t tag, TIFFDataType type, size_t *count);
/* The text of an ASCII tag as a string of its own, ended by a zero; NULL where there is none or no memory. */
char *dem_tiff_text(TIFF *tiff, uint32_t tag);

#endif
