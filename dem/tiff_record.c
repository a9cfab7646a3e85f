#include "dem/tiff_record.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { TAG_GDAL_METADATA = 42112, MOST_ITEMS = 64 };

static const char opening[] = "<Item name=\"talus_";

/* In place: the five entities that XML needs; others stay as they are. */
static void unescape(char *text)
{
    static const struct {
        const char *entity;
        char stands_for;
    } entities[] = {{"&amp;", '&'}, {"&lt;", '<'}, {"&gt;", '>'}, {"&quot;", '"'}, {"&apos;", '\''}};
    char *to = text;
    for (const char *from = text; *from;) {
        size_t k = 0, count = sizeof entities / sizeof *entities;
        while (k < count && strncmp(from, entities[k].entity, strlen(entities[k].entity)) != 0)
            k++;
        *to++ = k < count ? entities[k].stands_for : *from;
        from += k < count ? strlen(entities[k].entity) : 1;
    }
    *to = 0;
}

/* Cuts the next item out of the text behind *at; false: there is none. */
static bool next_item(char **at, char **name, char **value)
{
    char *start = strstr(*at, opening);
    if (!start)
        return false;
    *name = start + sizeof opening - 1;
    char *quote = strchr(*name, '"');
    if (!quote || quote[1] != '>')
        return false;
    *value = quote + 2;
    char *end = strstr(*value, "</Item>");
    if (!end)
        return false;
    *quote = *end = 0;
    *at = end + 1;
    unescape(*value);
    /* anyone may have written the file */
    tl_make_printable(*name);
    tl_make_printable(*value);
    return true;
}

tl_status dem_record_read(TIFF *tiff, const char *path, tl_parameter **list, size_t *count, tl_error *error)
{
    char *text = dem_tiff_text(tiff, TAG_GDAL_METADATA), *at = text, *name, *value;
    tl_status status = TL_OK;
    *list = NULL;
    *count = 0;
    while (text && status == TL_OK && *count < MOST_ITEMS && next_item(&at, &name, &value))
        status = tl_parameters_add(list, count, name, value, error);
    free(text);
    if (status == TL_OK)
        return TL_OK;
    free(*list);
    *list = NULL;
    return tl_fail_memory(error, path);
}
