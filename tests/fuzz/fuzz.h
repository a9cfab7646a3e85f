/* What the fuzz targets share: the bytes of an input as a file in memory, and reading a source about as a command does.
 */
#ifndef TESTS_FUZZ_H
#define TESTS_FUZZ_H

#include "lib/talus.h"

#include <stddef.h>
#include <stdint.h>

/* The entry that libFuzzer, AFL++ and replay.c call. */
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/* Name of a file that holds these bytes, until the next call; NULL where the system does not give one. */
const char *fuzz_file(const uint8_t *data, size_t size);

/* A file of this name in a folder of the process's own, which goes when the process ends without a finding; its path,
 * until the next call. */
const char *fuzz_named(const char *name, const uint8_t *data, size_t size);
/* That folder. */
const char *fuzz_folder(void);

/* A grid of 5 x 5 heights without a place: the seeds that are made of a model are made of this one. */
const tl_source *fuzz_model(void);

/* Reads the corners, the middle, the validity and two coarser levels of a source, a few thousand samples in all. Ends
 * the process where what it reads breaks what the header says of sources. */
void fuzz_read(const tl_source *source);

/* A failed call's error is told, in one line without control characters. */
void fuzz_error(const tl_error *error);
void fuzz_text(const char *text);

/* Ends the process unless the condition holds: a finding. */
void fuzz_expect(bool condition);

#endif
