/* Frameworks and error pyramids, which are GeoTIFFs, of any content. */
#include "fuzz.h"

#include <math.h>

static const tl_run run = {.threads = 1, .memory = 16 << 20};

static void read_framework(const char *path)
{
    tl_error error = {0};
    tl_mesh *mesh = NULL;
    tl_framework *framework = tl_framework_load(path, &run, &error);
    if (!framework) {
        fuzz_error(&error);
        return;
    }
    if (tl_framework_mesh(framework, &mesh, &error) != TL_OK)
        fuzz_error(&error);
    else
        for (size_t k = 0; k < 3 * mesh->triangle_count; k++)
            fuzz_expect(mesh->indices[k] < mesh->vertex_count);
    for (size_t k = 0; mesh && k < mesh->vertex_count; k++)
        fuzz_expect(isfinite(mesh->vertices[k].z) &&
                    tl_framework_has_point(framework, mesh->vertices[k].i, mesh->vertices[k].j));
    tl_mesh_destroy(mesh);
    tl_framework_destroy(framework);
}

static void read_pyramid(const char *path)
{
    tl_error error = {0};
    tl_pyramid *pyramid = tl_pyramid_load(path, fuzz_model(), NULL, &error);
    if (!pyramid)
        fuzz_error(&error);
    else
        fuzz_expect(tl_pyramid_error(pyramid, 2, 2) >= 0);
    tl_pyramid_destroy(pyramid);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    const char *path = fuzz_file(data, size);
    if (path && tl_framework_is_file(path))
        read_framework(path);
    else if (path)
        read_pyramid(path);
    return 0;
}
