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

/* Reads the corners, the middle, the validity and two coarser levels of a source, a few thousand samples in all. Ends
 * the process where what it reads breaks what the header says of sources. */
void fuzz_read(const tl_source *source);

/* Ends the process unless the condition holds: a finding. */
void fuzz_expect(bool condition);

#endif
