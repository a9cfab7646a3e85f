#include "lib/base/error.h"

#include <errno.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

/* Bytes of the UTF-8 sequence at `c`, 0 where there is none (RFC 3629: no overlong forms, no surrogates). */
static size_t sequence_length(const unsigned char *c)
{
    size_t length = c[0] < 0x80 ? 1 : c[0] < 0xc2 ? 0 : c[0] < 0xe0 ? 2 : c[0] < 0xf0 ? 3 : c[0] < 0xf5 ? 4 : 0;
    for (size_t i = 1; i < length; i++)
        if ((c[i] & 0xc0) != 0x80)
            return 0;
    bool overlong = (c[0] == 0xe0 && c[1] < 0xa0) || (c[0] == 0xf0 && c[1] < 0x90);
    bool beyond = (c[0] == 0xed && c[1] >= 0xa0) || (c[0] == 0xf4 && c[1] >= 0x90);
    return overlong || beyond ? 0 : length;
}

void tl_make_printable(char *text)
{
    unsigned char *c = (unsigned char *)text;
    while (*c) {
        size_t length = sequence_length(c);
        bool control = *c < 0x20 || *c == 0x7f || (*c == 0xc2 && c[1] < 0xa0);
        if (length > 0 && !control)
            c += length;
        else
            *c++ = '?';
    }
}

tl_status tl_fail(tl_error *error, tl_status status, const char *format, ...)
{
    if (error) {
        va_list arguments;
        va_start(arguments, format);
        vsnprintf(error->text, sizeof error->text, format, arguments);
        va_end(arguments);
        tl_make_printable(error->text);
        error->status = status;
    }
    return status;
}

tl_status tl_fail_memory(tl_error *error, const char *what)
{
    return tl_fail(error, TL_ERROR_MEMORY, "not enough memory for %s", what);
}

tl_status tl_fail_system(tl_error *error, const char *path, const char *action, int code)
{
    char reason[128];
    /* XSI strerror_r, which fills the buffer; strerror is not safe with threads */
    if (strerror_r(code, reason, sizeof reason) != 0)
        snprintf(reason, sizeof reason, "error %d", code);
    return tl_fail(error, code == ENOMEM ? TL_ERROR_MEMORY : TL_ERROR_IO, "%s: cannot %s: %s", path, action, reason);
}

const char *tl_status_name(tl_status status)
{
    static const char *const names[] = {
        [TL_OK] = "success",         [TL_ERROR_ARGUMENT] = "bad argument", [TL_ERROR_DATA] = "bad data",
        [TL_ERROR_IO] = "I/O error", [TL_ERROR_MEMORY] = "out of memory",  [TL_ERROR_CANCELLED] = "cancelled",
    };
    size_t index = (size_t)status;
    return index < sizeof names / sizeof *names ? names[index] : "unknown status";
}
