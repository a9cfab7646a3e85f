/* A part of a source as a source. On a raster that goes around the globe the part may begin before the last column and
 * go on behind the first one again. */
#include "dem/crs.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"

#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

typedef struct cut_source {
    tl_source source;
    const tl_source *original;
    tl_window window; /* of the original's finest level; x below its width */
    tl_parameter *parameters;
} cut_source;

static bool goes_around(const cut_source *c)
{
    return c->window.x + c->window.width > c->original->info.width;
}

/* Whether the part's cells of a coarser level are cells of the original's: it begins with one, and ends with one or at
 * the original's end. */
static bool whole_cells(const cut_source *c, int halvings)
{
    const tl_source_info *info = &c->original->info;
    int64_t rest = (INT64_C(1) << halvings) - 1, right = c->window.x + c->window.width,
            bottom = c->window.y + c->window.height;
    if (goes_around(c) || (c->window.x & rest) || (c->window.y & rest))
        return false;
    return info->type == TL_RASTER_POINT ||
           ((!(right & rest) || right == info->width) && (!(bottom & rest) || bottom == info->height));
}

static tl_status cut_size(const tl_source *self, int level, int64_t *width, int64_t *height, tl_error *error)
{
    const cut_source *c = (const cut_source *)self;
    int halvings = self->info.level - level;
    int64_t whole_width, whole_height, longer = tl_int64_max(self->info.width, self->info.height);
    if (halvings < 0 || halvings > 62 || (halvings > 0 && (longer - 1) >> (halvings - 1) == 0) ||
        (halvings > 0 && !whole_cells(c, halvings)))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: this part has no level %d", self->info.name, level);
    tl_status status = tl_source_size(c->original, level, &whole_width, &whole_height, error);
    if (status != TL_OK)
        return status;
    *width = ((self->info.width - 1) >> halvings) + 1;
    *height = ((self->info.height - 1) >> halvings) + 1;
    return TL_OK;
}

typedef tl_status (*reader)(const tl_source *, int, tl_window, void *, tl_error *);

static tl_status read_heights(const tl_source *source, int level, tl_window window, void *out, tl_error *error)
{
    return tl_source_read(source, level, window, out, error);
}

static tl_status read_validity(const tl_source *source, int level, tl_window window, void *out, tl_error *error)
{
    return tl_source_validity(source, level, window, out, error);
}

/* A part of a window that does not cross the last column, into columns of a wider one. */
static tl_status read_columns(const cut_source *c, reader read, size_t size, int level, tl_window part,
                              unsigned char *out, int64_t stride, tl_error *error)
{
    unsigned char *columns = tl_alloc_grid(part.width, part.height, size);
    if (!columns)
        return tl_fail_memory(error, c->source.info.name);
    tl_status status = read(c->original, level, part, columns, error);
    for (int64_t y = 0; status == TL_OK && y < part.height; y++)
        memcpy(out + (size_t)(y * stride) * size, columns + (size_t)(y * part.width) * size, (size_t)part.width * size);
    free(columns);
    return status;
}

static tl_status read_part(const tl_source *self, reader read, size_t size, int level, tl_window window, void *out,
                           tl_error *error)
{
    const cut_source *c = (const cut_source *)self;
    int halvings = self->info.level - level;
    int64_t width = c->original->info.width;
    tl_window theirs = {window.x + (c->window.x >> halvings), window.y + (c->window.y >> halvings), window.width,
                        window.height};
    if (!goes_around(c) || theirs.x + theirs.width <= width)
        return read(c->original, level, theirs, out, error);
    if (theirs.x >= width) {
        theirs.x -= width;
        return read(c->original, level, theirs, out, error);
    }
    tl_window left = theirs, right = theirs;
    left.width = width - theirs.x;
    right.x = 0;
    right.width = theirs.width - left.width;
    tl_status status = read_columns(c, read, size, level, left, out, window.width, error);
    return status == TL_OK ? read_columns(c, read, size, level, right, (unsigned char *)out + (size_t)left.width * size,
                                          window.width, error)
                           : status;
}

static tl_status cut_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    return read_part(self, read_heights, sizeof *out, level, window, out, error);
}

static tl_status cut_validity(const tl_source *self, int level, tl_window window, unsigned char *out, tl_error *error)
{
    return read_part(self, read_validity, 1, level, window, out, error);
}

static void cut_destroy(tl_source *self)
{
    cut_source *c = (cut_source *)self;
    free(c->parameters);
    free(c);
}

static tl_status check_part(const tl_source_info *info, tl_window w, tl_error *error)
{
    int64_t most = info->wraps ? 2 * info->width - 1 : info->width;
    if (w.x >= 0 && w.y >= 0 && w.width >= 1 && w.height >= 1 && w.x < info->width && w.y < info->height &&
        w.width <= info->width && w.width <= most - w.x && w.height <= info->height - w.y)
        return TL_OK;
    return tl_fail(error, TL_ERROR_ARGUMENT,
                   "%s: has %" PRId64 " x %" PRId64 " samples; %" PRId64 " x %" PRId64 " from column %" PRId64
                   ", row %" PRId64 " on do not lie in it",
                   info->name, info->width, info->height, w.width, w.height, w.x, w.y);
}

static tl_status describe(cut_source *c, tl_error *error)
{
    tl_source_info *info = &c->source.info;
    tl_window w = c->window;
    double *t = info->georef.transform;
    bool aligned = info->block_width > 0 && info->block_height > 0 && w.x % info->block_width == 0 &&
                   w.y % info->block_height == 0 && !goes_around(c);
    char text[96];
    info->width = w.width;
    info->height = w.height;
    info->wraps = info->wraps && w.width == c->original->info.width;
    if (!aligned)
        info->block_width = info->block_height = 0;
    t[0] += t[1] * (double)w.x + t[2] * (double)w.y;
    t[3] += t[4] * (double)w.x + t[5] * (double)w.y;
    snprintf(text, sizeof text, "%" PRId64 ",%" PRId64 ",%" PRId64 ",%" PRId64, w.x, w.y, w.width, w.height);
    c->parameters = tl_parameters_copy(info->parameters, info->parameter_count);
    tl_status status = info->parameter_count && !c->parameters ? tl_fail_memory(error, info->name) : TL_OK;
    if (status == TL_OK)
        status = tl_parameters_add(&c->parameters, &info->parameter_count, "window", text, error);
    info->parameters = c->parameters;
    return status == TL_OK ? dem_georef_measure(&info->georef, w.width, w.height, error) : status;
}

tl_source *tl_cut_create(const tl_source *source, tl_window window, tl_error *error)
{
    if (check_part(&source->info, window, error) != TL_OK)
        return NULL;
    cut_source *c = malloc(sizeof *c);
    if (!c) {
        tl_fail_memory(error, source->info.name);
        return NULL;
    }
    *c = (cut_source){
        .source = {.info = source->info, .read = cut_read, .validity = cut_validity, .destroy = cut_destroy},
        .original = source,
        .window = window};
    if (source->size)
        c->source.size = cut_size;
    if (describe(c, error) == TL_OK)
        return &c->source;
    cut_destroy(&c->source);
    return NULL;
}

/* ---- boxes ---- */

/* Samples from low to high, to a millionth of a cell; false where there are none. */
static bool samples_between(double low, double high, int64_t *first, int64_t *count)
{
    const double rounding = 1e-6;
    double from = ceil(low - rounding), to = floor(high + rounding);
    if (!(to >= from) || fabs(from) > 1e15 || fabs(to) > 1e15)
        return false;
    *first = (int64_t)from;
    *count = (int64_t)to - (int64_t)from + 1;
    return true;
}

/* The samples in a box of CRS coordinates, wherever they lie. */
static bool around_box(const tl_georef *georef, const double box[4], tl_window *out)
{
    const double *t = georef->transform;
    double determinant = t[1] * t[5] - t[2] * t[4];
    double i0 = (double)INFINITY, i1 = -i0, j0 = i0, j1 = -i0;
    for (int corner = 0; corner < 4; corner++) {
        double x = box[corner & 1 ? 2 : 0] - t[0], y = box[corner & 2 ? 3 : 1] - t[3];
        double i = (t[5] * x - t[2] * y) / determinant, j = (t[1] * y - t[4] * x) / determinant;
        i0 = fmin(i0, i);
        i1 = fmax(i1, i);
        j0 = fmin(j0, j);
        j1 = fmax(j1, j);
    }
    return samples_between(i0, i1, &out->x, &out->width) && samples_between(j0, j1, &out->y, &out->height);
}

/* Cuts a run of samples at the raster's ends; false where nothing is left. */
static bool clip(int64_t *first, int64_t *count, int64_t size)
{
    int64_t end = tl_int64_min(*first + *count, size);
    *first = tl_int64_max(*first, 0);
    *count = end - *first;
    return *count > 0;
}

/* The same for columns around the globe. */
static bool clip_columns(const tl_source_info *info, tl_window *w)
{
    if (!info->wraps)
        return clip(&w->x, &w->width, info->width);
    w->width = tl_int64_min(w->width, info->width);
    w->x %= info->width;
    w->x += w->x < 0 ? info->width : 0;
    return true;
}

/* The box moved by whole turns to where it meets the raster. */
static bool find_turn(const tl_source_info *info, const double box[4], tl_window *out)
{
    static const int turns[] = {0, 1, -1, 2, -2};
    bool geographic = info->georef.crs && tl_crs_is_geographic(info->georef.crs);
    for (int k = 0; k < (geographic ? 5 : 1); k++) {
        const double moved[4] = {box[0] + 360 * turns[k], box[1], box[2] + 360 * turns[k], box[3]};
        if (around_box(&info->georef, moved, out) && clip(&out->y, &out->height, info->height) &&
            clip_columns(info, out))
            return true;
    }
    return false;
}

tl_status tl_cut_of_box(const tl_source_info *info, const double box[4], tl_window *out, tl_error *error)
{
    bool geographic = info->georef.crs && tl_crs_is_geographic(info->georef.crs);
    double full[4] = {box[0], box[1], box[2], box[3]};
    if (geographic && full[2] < full[0]) /* across the antimeridian */
        full[2] += 360;
    for (int k = 0; k < 4; k++)
        if (!isfinite(full[k]) || full[k % 2 + 2] < full[k % 2])
            return tl_fail(error, TL_ERROR_ARGUMENT,
                           "a box from %g, %g to %g, %g holds nothing; west, south, east, north", box[0], box[1],
                           box[2], box[3]);
    tl_window found;
    if (!find_turn(info, full, &found))
        return tl_fail(
            error, TL_ERROR_ARGUMENT,
            "%s: no sample lies in the box from %g, %g to %g, %g; the extent that talus info tells is wanted",
            info->name, box[0], box[1], box[2], box[3]);
    *out = found;
    return TL_OK;
}
