/* Meshes, points and tiles of terrain; the first byte chooses the ending. */
#include "fuzz.h"

#include <stdio.h>
#include <stdlib.h>

static const char *const endings[] = {"glb", "obj", "ply", "stl", "csv", "geojson", "terrain"};
enum { ENDINGS = sizeof endings / sizeof *endings, MESHES = 4 };

static const tl_run run = {.threads = 1, .memory = 64 << 20};

static void summarize(const char *path)
{
    tl_error error = {0};
    tl_mesh_summary summary;
    if (tl_mesh_read_summary(path, &run, &summary, &error) != TL_OK) {
        fuzz_error(&error);
        return;
    }
    for (size_t k = 0; k < summary.record_count; k++) {
        fuzz_text(summary.record[k].name);
        fuzz_text(summary.record[k].value);
    }
    free(summary.record);
}

/* Against the mesh that the seeds hold. */
static void verify(const char *path)
{
    static tl_mesh *mesh;
    tl_error error = {0};
    tl_mesh_report report;
    if (!mesh)
        fuzz_expect(tl_mesh_from_source(fuzz_model(), &run, &mesh, NULL) == TL_OK);
    if (tl_mesh_verify_file(path, mesh, fuzz_model(), NULL, TL_FRAME_PIXEL, &run, &report, &error) != TL_OK)
        fuzz_error(&error);
    else
        fuzz_expect(report.samples + report.uncovered <= 25);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    char name[16];
    if (!size)
        return 0;
    unsigned kind = data[0] % ENDINGS;
    snprintf(name, sizeof name, "m.%s", endings[kind]);
    const char *path = fuzz_named(name, data + 1, size - 1);
    summarize(path);
    if (kind < MESHES)
        verify(path);
    return 0;
}
