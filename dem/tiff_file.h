/* A TIFF file that many threads read: one descriptor, several libtiff handles over it, and libtiff's messages caught.
 */
#ifndef DEM_TIFF_FILE_H
#define DEM_TIFF_FILE_H

#include "dem/file_pool.h"

#include <tiffio.h>

typedef struct dem_tiff_file dem_tiff_file;

/* A libtiff handle at one of the file's directories. One thread at a time uses it. */
typedef struct dem_tiff_handle {
    TIFF *tiff;
    const dem_tiff_file *file;
    uint64_t directory; /* offset of its directory, 0: the first */
    const void *owner;  /* see dem_tiff_keep */
    int64_t next_row;   /* for its owner; 0 at first */
    uint64_t position;
    int trouble;       /* errno of the first reading that the system failed, 0: none */
    char message[200]; /* libtiff's first complaint since dem_tiff_forget */
    void *scratch;     /* see dem_tiff_scratch */
    size_t scratch_bytes;
    struct dem_tiff_handle *next;
} dem_tiff_handle;

/* Whether the first bytes of a file are those of a TIFF. */
bool dem_is_tiff(const unsigned char head[4]);

/* Borrows `file`. */
dem_tiff_file *dem_tiff_file_create(dem_file *file, tl_error *error);
/* All handles must be back. Takes NULL. */
void dem_tiff_file_destroy(dem_tiff_file *file);
const char *dem_tiff_file_path(const dem_tiff_file *file);
/* Size in bytes when it was opened. */
int64_t dem_tiff_file_size(const dem_tiff_file *file);

/* A handle for this thread until dem_tiff_give_back, at the directory with this offset (0: the first). */
tl_status dem_tiff_take(dem_tiff_file *file, uint64_t directory, dem_tiff_handle **out, tl_error *error);
void dem_tiff_give_back(dem_tiff_file *file, dem_tiff_handle *handle);
/* Gives a handle back for the owner's next dem_tiff_take_kept alone, standing where it stands. */
void dem_tiff_keep(dem_tiff_file *file, dem_tiff_handle *handle, const void *owner);
/* The handle that was kept; *out is NULL where there is none, or no longer. */
tl_status dem_tiff_take_kept(dem_tiff_file *file, const void *owner, dem_tiff_handle **out, tl_error *error);

/* Closes a handle instead of giving it back. */
void dem_tiff_drop(dem_tiff_file *file, dem_tiff_handle *handle);

/* Memory for the handle's user, of undefined content, until the next call; NULL when out of memory. */
void *dem_tiff_scratch(dem_tiff_handle *handle, size_t bytes);

void dem_tiff_forget(dem_tiff_handle *handle);
/* An error, described, where the system has failed to read for this handle, or to give memory for a tag: libtiff takes
 * a tag that it cannot read for one that is not there, and goes on. */
tl_status dem_tiff_check(const dem_tiff_handle *handle, tl_error *error);
/* What libtiff said, or `otherwise` where it said nothing. */
const char *dem_tiff_message(const dem_tiff_handle *handle, const char *otherwise);

/* The values of an array tag that libtiff may or may not know, as `type` (TIFF_SHORT, TIFF_DOUBLE or TIFF_ASCII);
 * NULL where the tag is absent or of another type. They belong to the handle and live until its directory changes. */
const void *dem_tiff_array(TIFF *tiff, uint32_t tag, TIFFDataType type, size_t *count);
/* The text of an ASCII tag as a string of its own, ended by a zero; NULL where there is none, or no memory, which
 * dem_tiff_check tells. */
char *dem_tiff_text(TIFF *tiff, uint32_t tag);

#endif
