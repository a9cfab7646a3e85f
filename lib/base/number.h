/* Numbers as text. */
#ifndef TL_BASE_NUMBER_H
#define TL_BASE_NUMBER_H

#include <stdio.h>
#include <stdlib.h>

enum { TL_NUMBER_TEXT = 32 };

/* The shortest of the decimal forms that read back as this very double: 0.8, not 0.80000000000000004. */
static inline void tl_number_text(double value, char text[TL_NUMBER_TEXT])
{
    for (int digits = 15; digits <= 17; digits++) {
        snprintf(text, TL_NUMBER_TEXT, "%.*g", digits, value);
        if (strtod(text, NULL) == value)
            return;
    }
}

#endif
