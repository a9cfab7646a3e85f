#include "dem/crs_keys.h"

#include "dem/crs_map.h"
#include "dem/geokeys.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <ctype.h>
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

/* libgeotiff takes 100 keys, the standard has fewer, and none has more than a few numbers. */
enum { MOST_NUMBERS = 4096 };

char *dem_crs_keys_text(const tl_crs *crs)
{
    const char *ascii = crs->key_ascii ? crs->key_ascii : "";
    size_t room = 6 * crs->key_directory_count + 17 * crs->key_double_count + strlen(ascii) + 3, at = 0;
    char *text = crs->key_directory_count < 4 ? NULL : malloc(room);
    if (!text)
        return NULL;
    for (size_t k = 0; k < crs->key_directory_count; k++)
        at += (size_t)snprintf(text + at, room - at, k ? " %u" : "%u", (unsigned)crs->key_directory[k]);
    text[at++] = ';';
    for (size_t k = 0; k < crs->key_double_count; k++) {
        uint64_t bits;
        memcpy(&bits, &crs->key_doubles[k], sizeof bits);
        at += (size_t)snprintf(text + at, room - at, k ? " %016" PRIx64 : "%016" PRIx64, bits);
    }
    snprintf(text + at, room - at, ";%s", ascii);
    return text;
}

/* Numbers up to a semicolon, behind which *text is then: their count, of which those that fit are stored; 0 where
 * something else stands there. */
static size_t read_numbers(const char **text, int base, uint64_t *numbers)
{
    size_t count = 0;
    const char *at = *text;
    while (*at && *at != ';') {
        char *end;
        at += *at == ' ';
        if (!isxdigit((unsigned char)*at) || count == MOST_NUMBERS)
            return 0;
        numbers[count++] = strtoull(at, &end, base);
        if (end == at)
            return 0;
        at = end;
    }
    *text = *at ? at + 1 : at;
    return count;
}

static void fill(dem_geokeys *keys, const char *text, uint64_t *numbers)
{
    keys->directory_count = read_numbers(&text, 10, numbers);
    keys->directory = tl_alloc(keys->directory_count, sizeof *keys->directory);
    for (size_t k = 0; keys->directory && k < keys->directory_count; k++)
        keys->directory[k] = (uint16_t)numbers[k];
    keys->double_count = read_numbers(&text, 16, numbers);
    keys->doubles = tl_alloc(keys->double_count, sizeof *keys->doubles);
    if (keys->doubles && keys->double_count)
        memcpy(keys->doubles, numbers, keys->double_count * sizeof *numbers);
    keys->ascii = strdup(text);
}

tl_status dem_crs_take_keys(tl_crs *crs, const char *text, const char *path, tl_error *error)
{
    uint64_t *numbers = tl_alloc(MOST_NUMBERS, sizeof *numbers);
    if (!numbers)
        return tl_fail_memory(error, path);
    dem_geokeys keys = {0};
    fill(&keys, text, numbers);
    free(numbers);
    if (keys.directory_count < 4 || crs->key_directory_count) {
        dem_geokeys_finish(&keys);
        return TL_OK;
    }
    tl_status status = dem_geokeys_check(&keys, path, error);
    if (status != TL_OK)
        return status;
    crs->key_directory = keys.directory;
    crs->key_doubles = keys.doubles;
    crs->key_ascii = keys.ascii;
    crs->key_directory_count = keys.directory_count;
    crs->key_double_count = keys.double_count;
    return TL_OK;
}

char *dem_crs_esri_text(const tl_crs *crs)
{
    static const char *const options[] = {"MULTILINE=NO", NULL};
    PJ_CONTEXT *context = dem_proj_context();
    PJ *object = context ? proj_create(context, crs->horizontal_wkt ? crs->horizontal_wkt : crs->wkt) : NULL;
    const char *text = object ? proj_as_wkt(context, object, PJ_WKT1_ESRI, options) : NULL;
    char *copy = text ? strdup(text) : NULL;
    proj_destroy(object);
    if (context)
        proj_context_destroy(context);
    return copy;
}

int dem_crs_datum_code(const tl_crs *crs)
{
    PJ_CONTEXT *context = dem_proj_context();
    PJ *object = context ? proj_create(context, crs->horizontal_wkt ? crs->horizontal_wkt : crs->wkt) : NULL;
    PJ *datum = object ? proj_crs_get_datum_forced(context, object) : NULL;
    const char *authority = datum ? proj_get_id_auth_name(datum, 0) : NULL;
    const char *code = authority && strcmp(authority, "EPSG") == 0 ? proj_get_id_code(datum, 0) : NULL;
    int number = code ? atoi(code) : 0;
    proj_destroy(datum);
    proj_destroy(object);
    if (context)
        proj_context_destroy(context);
    return number;
}
