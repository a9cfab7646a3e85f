#include "lib/scene/lattice_level.h"

#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/scene/field.h"

#include <math.h>
#include <string.h>

enum { MOST_HALVINGS = 40, ROOM = 1 << 20 /* samples that are read at once, but for a row */ };

typedef struct lattice_level {
    tl_source source;
    const tl_source *from;
    int level;             /* of `from` that is read */
    int64_t skip;          /* its samples in one of these */
    int64_t width, height; /* of that level */
} lattice_level;

/* Every skip-th sample of every skip-th row. */
static tl_status read_points(const lattice_level *l, tl_window window, float *out, tl_error *error)
{
    tl_window row = {window.x * l->skip, 0, (window.width - 1) * l->skip + 1, 1};
    float *samples = tl_alloc_grid(row.width, 1, sizeof *samples);
    tl_status status = samples ? TL_OK : tl_fail_memory(error, l->source.info.name);
    for (int64_t y = 0; y < window.height && status == TL_OK; y++) {
        row.y = (window.y + y) * l->skip;
        status = tl_source_read(l->from, l->level, row, samples, error);
        for (int64_t x = 0; x < window.width && status == TL_OK; x++)
            out[y * window.width + x] = samples[x * l->skip];
    }
    free(samples);
    return status;
}

/* Adds rows of samples to the sums of the cells that they lie in. */
static void add_rows(const float *samples, tl_window window, int64_t skip, double *sums, int64_t *counts)
{
    for (int64_t y = 0; y < window.height; y++)
        for (int64_t x = 0; x < window.width; x++) {
            double z = (double)samples[y * window.width + x];
            if (!isnan(z)) {
                sums[x / skip] += z;
                counts[x / skip]++;
            }
        }
}

static tl_status read_means(const lattice_level *l, tl_window window, float *out, tl_error *error)
{
    tl_window w = {window.x * l->skip, 0, 0, 0};
    w.width = tl_int64_min(window.width * l->skip, l->width - w.x);
    int64_t rows = tl_int64_max(1, tl_int64_min(l->skip, ROOM / w.width));
    float *samples = tl_alloc_grid(w.width, rows, sizeof *samples);
    double *sums = tl_alloc_grid(window.width, 1, sizeof *sums);
    int64_t *counts = tl_alloc_grid(window.width, 1, sizeof *counts);
    tl_status status = samples && sums && counts ? TL_OK : tl_fail_memory(error, l->source.info.name);
    for (int64_t y = 0; y < window.height && status == TL_OK; y++) {
        int64_t first = (window.y + y) * l->skip, end = tl_int64_min(first + l->skip, l->height);
        memset(sums, 0, (size_t)window.width * sizeof *sums);
        memset(counts, 0, (size_t)window.width * sizeof *counts);
        for (w.y = first; w.y < end && status == TL_OK; w.y += w.height) {
            w.height = tl_int64_min(rows, end - w.y);
            status = tl_source_read(l->from, l->level, w, samples, error);
            if (status == TL_OK)
                add_rows(samples, w, l->skip, sums, counts);
        }
        for (int64_t x = 0; x < window.width; x++)
            out[y * window.width + x] = counts[x] ? (float)(sums[x] / (double)counts[x]) : NAN;
    }
    free(samples);
    free(sums);
    free(counts);
    return status;
}

static tl_status level_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const lattice_level *l = (const lattice_level *)self;
    (void)level; /* there is one */
    if (l->skip == 1)
        return tl_source_read(l->from, l->level, window, out, error);
    return self->info.type == TL_RASTER_AREA ? read_means(l, window, out, error) : read_points(l, window, out, error);
}

static void level_destroy(tl_source *self)
{
    free(self);
}

/* Samples of the new level are 2^halvings as far apart; means stand in the middle of theirs. */
static void place(tl_source_info *info, int halvings)
{
    double step = ldexp(1, halvings), offset = info->type == TL_RASTER_AREA ? (step - 1) / 2 : 0;
    double *t = info->georef.transform;
    for (int a = 0; a < 2; a++) {
        t[3 * a] += offset * (t[3 * a + 1] + t[3 * a + 2]);
        t[3 * a + 1] *= step;
        t[3 * a + 2] *= step;
    }
    info->georef.cell_x *= step;
    info->georef.cell_y *= step;
}

tl_source *scene_lattice_level_create(const tl_source *source, int halvings, tl_error *error)
{
    if (halvings < 0 || halvings > MOST_HALVINGS) {
        tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no level %d times coarser", source->info.name, halvings);
        return NULL;
    }
    lattice_level *l = calloc(1, sizeof *l);
    if (!l) {
        tl_fail_memory(error, source->info.name);
        return NULL;
    }
    const tl_source *model = scene_field_dem(source);
    int own = model ? (halvings < source->info.level ? halvings : source->info.level)
                    : 0; /* halvings that the field has itself */
    l->source = (tl_source){.info = source->info, .read = level_read, .destroy = level_destroy};
    l->from = source;
    l->level = source->info.level - own;
    l->skip = INT64_C(1) << (halvings - own);
    tl_source_info *info = &l->source.info;
    tl_status status = tl_source_size(source, l->level, &l->width, &l->height, error);
    info->level = 0;
    info->width = status == TL_OK ? tl_div_up(l->width, l->skip) : 1;
    info->height = status == TL_OK ? tl_div_up(l->height, l->skip) : 1;
    info->block_width = info->block_height = 0;
    info->quantum = info->type == TL_RASTER_AREA && halvings ? 0 : info->quantum;
    place(info, halvings);
    if (status == TL_OK)
        return &l->source;
    free(l);
    return NULL;
}
