/* EXR heightfields of any content. */
#include "fuzz.h"

#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    const char *path = fuzz_file(data, size);
    tl_error error = {0};
    tl_source *source = path ? tl_open(path, &error) : NULL;
    fuzz_expect(source || !path || error.text[0]);
    if (source) {
        for (size_t k = 0; k < source->info.parameter_count; k++)
            fuzz_expect(strlen(source->info.parameters[k].name) < size && source->info.parameters[k].value);
        fuzz_read(source);
    }
    tl_source_destroy(source);
    return 0;
}
