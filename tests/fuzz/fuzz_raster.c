/* Elevation models of any content. */
#include "fuzz.h"

enum { LARGE_BLOCK = 1 << 16 };

static uint32_t hash(const uint8_t *data, size_t size)
{
    uint32_t sum = 2166136261u;
    for (size_t k = 0; k < size; k++)
        sum = (sum ^ data[k]) * 16777619u;
    return sum ^ sum >> 15;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const tl_run run = {.threads = 1};
    const char *path = fuzz_file(data, size);
    tl_error error = {0};
    /* the choice follows from the input, so that each input always does the same */
    const tl_dem_options options = {
        .band = size % 4 == 3 ? 2 : 0, .exact_levels = size % 2, .feather = size % 8 == 0, .run = &run};
    tl_source *source = path ? tl_dem_open(&path, 1, &options, &error) : NULL;
    fuzz_expect(source || !path || error.text[0]);
    if (source) {
        tl_dem_details details;
        tl_dem_member member;
        fuzz_expect(tl_dem_get_details(source, &details, &error) == TL_OK && details.bytes == (int64_t)size);
        fuzz_expect(tl_dem_member_count(source) == 1 && tl_dem_get_member(source, 0, &member, &error) == TL_OK);
        /* large blocks are slow, and few of them tell as much as many */
        if (details.block_width * details.block_height * details.bands <= LARGE_BLOCK || hash(data, size) % 64 == 0)
            fuzz_read(source);
    }
    tl_source_destroy(source);
    return 0;
}
