/* Numbers as text. */
#ifndef TL_BASE_NUMBER_H
#define TL_BASE_NUMBER_H

#include <math.h>
#include <stdbool.h>
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

/* Whether a georeference's transform has an inverse, and steps so small that positions of samples and areas of cells
 * overflow nowhere, whatever file it comes from. */
static inline bool tl_transform_is_usable(const double t[6])
{
    for (int k = 0; k < 6; k++)
        if (!(fabs(t[k]) <= (k % 3 ? 1e100 : 1e300)))
            return false;
    return t[1] * t[5] - t[2] * t[4] != 0;
}

#endif
