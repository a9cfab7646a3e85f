/* Failures, written into the caller's tl_error. */
#ifndef TL_BASE_ERROR_H
#define TL_BASE_ERROR_H

#include "lib/talus.h"

/* Fills in *error (which may be NULL) and returns `status`, so that a function can end with it. The text is one
 * line: name the file, the thing and the remedy. Bytes of a file's own text that are no printable ASCII or UTF-8
 * become '?', for a name may hold a newline or a terminal's escape. */
__attribute__((format(printf, 3, 4))) tl_status tl_fail(tl_error *error, tl_status status, const char *format, ...);

/* Replaces what is no printable ASCII and no UTF-8 by '?', so that the text is one line and can go into a JSON. */
void tl_make_printable(char *text);

/* Out of memory while making `what`. */
tl_status tl_fail_memory(tl_error *error, const char *what);

/* A system call on `path` failed with errno-value `code`: "PATH: cannot DO: reason". */
tl_status tl_fail_system(tl_error *error, const char *path, const char *action, int code);

#endif
