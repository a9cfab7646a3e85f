#include "lib/scene/north_up.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

typedef struct north_up {
    tl_source source;
    const tl_source *original;
    bool rows, columns; /* whether they run backwards */
} north_up;

static void reverse(float *heights, int64_t count)
{
    for (int64_t i = 0, j = count - 1; i < j; i++, j--) {
        float swapped = heights[i];
        heights[i] = heights[j];
        heights[j] = swapped;
    }
}

static void swap_rows(float *a, float *b, int64_t width)
{
    for (int64_t i = 0; i < width; i++) {
        float swapped = a[i];
        a[i] = b[i];
        b[i] = swapped;
    }
}

void scene_north_up_turns(const tl_georef *georef, bool *columns, bool *rows)
{
    const double *t = georef->transform;
    bool upright = t[2] == 0 && t[4] == 0;
    *columns = upright && t[1] < 0;
    *rows = upright && t[5] > 0;
}

tl_window scene_turned_window(tl_window window, int64_t width, int64_t height, bool columns, bool rows)
{
    if (columns)
        window.x = width - window.x - window.width;
    if (rows)
        window.y = height - window.y - window.height;
    return window;
}

void scene_turn(float *samples, tl_window window, bool columns, bool rows)
{
    for (int64_t y = 0; columns && y < window.height; y++)
        reverse(samples + y * window.width, window.width);
    for (int64_t y = 0; rows && y < window.height / 2; y++)
        swap_rows(samples + y * window.width, samples + (window.height - 1 - y) * window.width, window.width);
}

/* Where a window lies in the original. */
static tl_status window_of_original(const north_up *n, int level, tl_window window, tl_window *out, tl_error *error)
{
    int64_t width, height;
    tl_status status = tl_source_size(n->original, level, &width, &height, error);
    if (status != TL_OK)
        return status;
    *out = scene_turned_window(window, width, height, n->columns, n->rows);
    return TL_OK;
}

static tl_status north_up_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const north_up *n = (const north_up *)self;
    tl_window theirs;
    tl_status status = window_of_original(n, level, window, &theirs, error);
    if (status == TL_OK)
        status = tl_source_read(n->original, level, theirs, out, error);
    if (status == TL_OK)
        scene_turn(out, window, n->columns, n->rows);
    return status;
}

static tl_status north_up_validity(const tl_source *self, int level, tl_window window, unsigned char *out,
                                   tl_error *error)
{
    const north_up *n = (const north_up *)self;
    size_t samples = (size_t)(window.width * window.height);
    unsigned char *turned = tl_alloc(samples, 1);
    if (!turned)
        return tl_fail_memory(error, self->info.name);
    tl_window theirs;
    tl_status status = window_of_original(n, level, window, &theirs, error);
    if (status == TL_OK)
        status = tl_source_validity(n->original, level, theirs, turned, error);
    for (int64_t y = 0; status == TL_OK && y < window.height; y++)
        for (int64_t x = 0; x < window.width; x++) {
            int64_t i = n->columns ? window.width - 1 - x : x, j = n->rows ? window.height - 1 - y : y;
            out[y * window.width + x] = turned[j * window.width + i];
        }
    free(turned);
    return status;
}

/* Coarser levels count from the original's first sample: turned round, they are those of this source only where the
 * last cell is a whole one, or the last sample one of theirs. */
static bool ends_alike(const tl_source_info *info, int64_t samples, int halvings)
{
    int64_t last = info->type == TL_RASTER_POINT ? samples - 1 : samples;
    return halvings >= 0 && halvings < 63 && (last & ((INT64_C(1) << halvings) - 1)) == 0;
}

static tl_status north_up_size(const tl_source *self, int level, int64_t *width, int64_t *height, tl_error *error)
{
    const north_up *n = (const north_up *)self;
    const tl_source_info *info = &self->info;
    int halvings = info->level - level;
    if ((n->columns && !ends_alike(info, info->width, halvings)) ||
        (n->rows && !ends_alike(info, info->height, halvings)))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no level %d with the north on top", info->name, level);
    return tl_source_size(n->original, level, width, height, error);
}

static void north_up_destroy(tl_source *self)
{
    free(self);
}

tl_source *scene_north_up(const tl_source *source, tl_error *error)
{
    north_up *n = calloc(1, sizeof *n);
    if (!n) {
        tl_fail_memory(error, source->info.name);
        return NULL;
    }
    n->source = (tl_source){.info = source->info,
                            .read = north_up_read,
                            .validity = north_up_validity,
                            .size = north_up_size,
                            .destroy = north_up_destroy};
    n->original = source;
    double *t = n->source.info.georef.transform;
    scene_north_up_turns(&source->info.georef, &n->columns, &n->rows);
    if (n->columns || n->rows)
        n->source.info.block_width = n->source.info.block_height = 0; /* they do not begin at this corner */
    if (n->columns) {
        t[0] += t[1] * (double)(source->info.width - 1);
        t[1] = -t[1];
    }
    if (n->rows) {
        t[3] += t[5] * (double)(source->info.height - 1);
        t[5] = -t[5];
    }
    return &n->source;
}
