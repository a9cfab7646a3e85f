/* Files that appear under their name only when they are complete. */
#ifndef TL_BASE_OUTPUT_H
#define TL_BASE_OUTPUT_H

#include "lib/talus.h"

/* A file being written. It has no name until tl_output_commit (where the file system has unnamed files; elsewhere a
 * hidden one in the same folder), so that a process that is killed leaves nothing behind. */
typedef struct tl_output tl_output;

/* Starts a file that will be `path`. An existing one is refused at once unless `overwrite`. */
tl_output *tl_output_open(const char *path, bool overwrite, tl_error *error);
/* The descriptor, open for reading and writing. Owned by the output. */
int tl_output_descriptor(const tl_output *output);
const char *tl_output_path(const tl_output *output);
/* Writes all bytes at `offset`, from any thread. */
tl_status tl_output_write_at(tl_output *output, const void *bytes, size_t count, uint64_t offset, tl_error *error);
/* Reads bytes that were written. */
tl_status tl_output_read_at(const tl_output *output, void *bytes, size_t count, uint64_t offset, tl_error *error);
/* Writes all bytes behind what tl_output_append wrote before (buffered; one thread). */
tl_status tl_output_append(tl_output *output, const void *bytes, size_t count, tl_error *error);
/* Writes what tl_output_append holds back, so that only the name is left to tl_output_commit. */
tl_status tl_output_flush(tl_output *output, tl_error *error);
/* Makes the file appear, complete, under its name and frees the output, also when it fails: then nothing is left. */
tl_status tl_output_commit(tl_output *output, tl_error *error);
/* Drops the file and frees the output. Takes NULL. */
void tl_output_abort(tl_output *output);

#endif
