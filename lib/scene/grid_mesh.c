/* A whole grid as a mesh: two triangles a cell. */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

enum { BAND = 64 }; /* rows read at once */

typedef struct reading {
    const tl_source *source;
    float *heights;
} reading;

static tl_status read_band(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    (void)loop;
    (void)worker;
    const reading *r = context;
    const tl_source_info *info = &r->source->info;
    int64_t y = (int64_t)item * BAND;
    tl_window window = {0, y, info->width, tl_int64_min(BAND, info->height - y)};
    return tl_source_read(r->source, info->level, window, r->heights + y * info->width, error);
}

/* The triangles of the cell whose first corner is a: b to the right, c below, d opposite. Counter-clockwise from above,
 * with rows running south. The diagonal joins b and c, unless one of these is the only void. */
static int cell_triangles(const float *heights, uint32_t a, uint32_t width, uint32_t out[6])
{
    uint32_t b = a + 1, c = a + width, d = c + 1;
    bool va = !isnan(heights[a]), vb = !isnan(heights[b]), vc = !isnan(heights[c]), vd = !isnan(heights[d]);
    int count = 0;
    const uint32_t acb[3] = {a, c, b}, bcd[3] = {b, c, d}, acd[3] = {a, c, d}, adb[3] = {a, d, b};
    if (va && vb && vc)
        memcpy(out + 3 * count++, acb, sizeof acb);
    if (vb && vc && vd)
        memcpy(out + 3 * count++, bcd, sizeof bcd);
    if (va && vc && vd && !vb)
        memcpy(out + 3 * count++, acd, sizeof acd);
    if (va && vb && vd && !vc)
        memcpy(out + 3 * count++, adb, sizeof adb);
    return count;
}

/* Counts the triangles, and writes them when out is not NULL. */
static size_t triangulate(const float *heights, int64_t width, int64_t height, uint32_t *out)
{
    size_t count = 0;
    uint32_t corners[6];
    for (int64_t j = 0; j + 1 < height; j++)
        for (int64_t i = 0; i + 1 < width; i++) {
            int made = cell_triangles(heights, (uint32_t)(j * width + i), (uint32_t)width, corners);
            if (out)
                memcpy(out + 3 * count, corners, (size_t)made * 3 * sizeof *out);
            count += (size_t)made;
        }
    return count;
}

/* Keeps the samples that a triangle uses, in order, and renames them in the triangles. numbers[] is scratch. */
static void gather_vertices(tl_mesh *mesh, const float *heights, int64_t width, int64_t height, uint32_t *numbers)
{
    size_t samples = (size_t)(width * height), used = 0;
    memset(numbers, 0, samples * sizeof *numbers);
    for (size_t k = 0; k < 3 * mesh->triangle_count; k++)
        numbers[mesh->indices[k]] = 1;
    for (size_t k = 0; k < samples; k++)
        if (numbers[k]) {
            mesh->vertices[used] =
                (tl_vertex){(int32_t)((int64_t)k % width), (int32_t)((int64_t)k / width), heights[k]};
            numbers[k] = (uint32_t)used++;
        }
    mesh->vertex_count = used;
    for (size_t k = 0; k < 3 * mesh->triangle_count; k++)
        mesh->indices[k] = numbers[mesh->indices[k]];
}

tl_status tl_mesh_from_source(const tl_source *source, const tl_run *run, tl_mesh **out, tl_error *error)
{
    const tl_source_info *info = &source->info;
    int64_t samples;
    if (!tl_int64_mul(info->width, info->height, &samples) || samples > INT64_C(1) << 31)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: %lld x %lld samples are too many for one mesh; refine by fewer levels", info->name,
                       (long long)info->width, (long long)info->height);
    reading r = {.source = source, .heights = tl_alloc((size_t)samples, sizeof(float))};
    uint32_t *numbers = tl_alloc((size_t)samples, sizeof *numbers);
    tl_mesh *mesh = NULL;
    tl_status status = r.heights && numbers ? TL_OK : tl_fail_memory(error, "the mesh of all samples");
    if (status == TL_OK)
        status = tl_parallel_for(run, (uint64_t)tl_div_up(info->height, BAND), (uint64_t)samples, read_band, &r, error);
    if (status == TL_OK) {
        size_t triangles = triangulate(r.heights, info->width, info->height, NULL);
        mesh = tl_mesh_create((size_t)samples, triangles, info, error);
        status = mesh ? TL_OK : TL_ERROR_MEMORY;
    }
    if (status == TL_OK) {
        triangulate(r.heights, info->width, info->height, mesh->indices);
        gather_vertices(mesh, r.heights, info->width, info->height, numbers);
        *out = mesh;
    }
    free(numbers);
    free(r.heights);
    return status;
}
