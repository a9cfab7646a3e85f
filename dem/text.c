#include "dem/text.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

dem_locale dem_locale_enter(void)
{
    dem_locale locale = {.own = newlocale(LC_ALL_MASK, "C", (locale_t)0)};
    if (locale.own)
        locale.before = uselocale(locale.own);
    return locale;
}

void dem_locale_leave(dem_locale locale)
{
    if (!locale.own)
        return;
    uselocale(locale.before);
    freelocale(locale.own);
}

/* What Microsoft's C library printed for numbers that are none: 1.#INF, -1.#IND, 1.#QNAN. */
static double special_number(const char *mark, double sign)
{
    return strncmp(mark, "#INF", 4) == 0 ? sign * (double)INFINITY : (double)NAN;
}

bool dem_parse_number(const char *text, double *value)
{
    char *end;
    dem_locale locale = dem_locale_enter();
    double number = strtod(text, &end);
    dem_locale_leave(locale);
    if (end == text)
        return false;
    *value = *end == '#' ? special_number(end, number) : number;
    return true;
}

/* Whether the tag from `item` to `end` has the attribute name="value". Its first 255 bytes are looked at: no writer
 * makes longer ones, and time stays linear in the length of the text. */
static bool has_attribute(const char *item, const char *end, const char *name, const char *value)
{
    char tag[256], wanted[64];
    snprintf(tag, sizeof tag, "%.*s", (int)(end - item < 255 ? end - item : 255), item);
    snprintf(wanted, sizeof wanted, " %s=\"%s\"", name, value);
    return strstr(tag, wanted) != NULL;
}

bool dem_band_item(const char *metadata, unsigned band, const char *role, double *value)
{
    char number[16];
    snprintf(number, sizeof number, "%u", band);
    for (const char *item = strstr(metadata, "<Item "), *end; item; item = strstr(end, "<Item ")) {
        end = strchr(item, '>');
        if (!end)
            return false;
        if (has_attribute(item, end, "sample", number) && has_attribute(item, end, "role", role))
            return dem_parse_number(end + 1, value);
    }
    return false;
}
