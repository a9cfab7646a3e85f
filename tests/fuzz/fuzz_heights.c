/* Heights beside a JSON file that tells what they mean (.png, .r16, .raw), .hgt files, and lists of files. The first
 * byte chooses; of the first kind, the next two are the length of the JSON, which the heights follow. */
#include "fuzz.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MOST_BYTES = 4096 };

static void use(tl_source *source, const tl_error *error)
{
    if (!source) {
        fuzz_error(error);
        return;
    }
    for (size_t k = 0; k < source->info.parameter_count; k++) {
        fuzz_text(source->info.parameters[k].name);
        fuzz_text(source->info.parameters[k].value);
    }
    fuzz_read(source);
    tl_source_destroy(source);
}

static void read_beside(const char *name, const char *json, const uint8_t *data, size_t size)
{
    tl_error error = {0};
    size_t length = size >= 2 ? (size_t)data[0] | (size_t)data[1] << 8 : size;
    if (length > size - 2 || size < 2)
        return;
    fuzz_named(json, data + 2, length);
    tl_source *source = tl_open(fuzz_named(name, data + 2 + length, size - 2 - length), &error);
    use(source, &error);
}

static void read_hgt(const uint8_t *data, size_t size)
{
    tl_error error = {0};
    const char *path = fuzz_named("N48W125.hgt", data, size);
    tl_source *source = tl_dem_open(&path, 1, NULL, &error);
    use(source, &error);
}

/* Names in it stay in the folder, where a pattern finds little; a list without names that are there is an error. */
static void read_list(const uint8_t *data, size_t size)
{
    static const uint8_t flat[] = {0, 1, 0, 2, 0, 3, 0, 4};
    static uint8_t text[MOST_BYTES];
    static bool prepared;
    static char list[160];
    tl_error error = {0};
    if (!prepared) {
        fuzz_named("N10E010.hgt", flat, sizeof flat);
        fuzz_named("N10E011.hgt", flat, sizeof flat);
        fuzz_named("S01W001.hgt", flat, sizeof flat);
        prepared = true;
    }
    size = size < MOST_BYTES ? size : MOST_BYTES;
    for (size_t k = 0; k < size; k++)
        text[k] = data[k] == '/' || data[k] == '.' ? '_' : data[k] == ';' ? '.' : data[k];
    snprintf(list, sizeof list, "@%s", fuzz_named("list", text, size));
    const char *path = list;
    tl_source *source = tl_dem_open(&path, 1, NULL, &error);
    use(source, &error);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    switch (size ? data[0] % 5 : 5) {
    case 0:
        read_beside("h.png", "h.json", data + 1, size - 1);
        break;
    case 1:
        read_beside("h.r16", "h.r16.json", data + 1, size - 1);
        break;
    case 2:
        read_beside("h.raw", "h.raw.json", data + 1, size - 1);
        break;
    case 3:
        read_hgt(data + 1, size - 1);
        break;
    case 4:
        read_list(data + 1, size - 1);
        break;
    default:
        break;
    }
    return 0;
}
