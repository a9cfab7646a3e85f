#include "dem/levels.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>

/* Samples of the base are read in pieces of at most this size; columns first from the top to the bottom, so that
 * the blocks of a row of pieces stay in the cache. */
enum { PIECE_COLUMNS = 2048, PIECE_ROWS = 64, MAX_HALVINGS = 62 };

/* For areas ceil(size / 2^k) cells, for points floor((size - 1) / 2^k) + 1 samples: the same number. */
static int64_t reduced(int64_t size, int halvings)
{
    return ((size - 1) >> halvings) + 1;
}

tl_status dem_level_size(const tl_source *source, int level, int64_t *width, int64_t *height, tl_error *error)
{
    const tl_source_info *info = &source->info;
    int64_t longer = tl_int64_max(info->width, info->height);
    if (level > 0 || level < -MAX_HALVINGS || (level < 0 && (longer - 1) >> (-level - 1) == 0))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no level %d", info->name, level);
    *width = reduced(info->width, -level);
    *height = reduced(info->height, -level);
    return TL_OK;
}

/* A part of the window, as the samples of the base that it is made of: whole cells, or one. */
typedef struct piece_job {
    const dem_level_base *base;
    int halvings;
    tl_window part; /* in samples of the level */
    float *piece;   /* as many samples as a piece has at most */
    double *sums;   /* of the cells of the part */
    int64_t *counts;
} piece_job;

/* ---- Areas ---- */

static void add_row(const piece_job *job, const float *heights, tl_window from, int64_t row)
{
    int64_t line = (((from.y + row) >> job->halvings) - job->part.y) * job->part.width;
    for (int64_t k = 0; k < from.width; k++) {
        float height = heights[row * from.width + k];
        int64_t cell = line + ((from.x + k) >> job->halvings) - job->part.x;
        if (isnan(height))
            continue;
        job->sums[cell] += (double)height;
        job->counts[cell]++;
    }
}

static tl_status add_piece(const piece_job *job, tl_window from, tl_error *error)
{
    tl_status status = job->base->read(job->base->context, from, job->piece, error);
    for (int64_t row = 0; row < from.height && status == TL_OK; row++)
        add_row(job, job->piece, from, row);
    return status;
}

/* A cell's samples are added in an order that depends on the cell alone: pieces begin with a cell. */
static tl_status make_means(const piece_job *job, float *out, int64_t stride, tl_error *error)
{
    tl_window part = job->part;
    int64_t x0 = part.x << job->halvings, y0 = part.y << job->halvings;
    int64_t x1 = tl_int64_min((part.x + part.width) << job->halvings, job->base->width);
    int64_t y1 = tl_int64_min((part.y + part.height) << job->halvings, job->base->height);
    for (int64_t k = 0; k < part.width * part.height; k++)
        job->sums[k] = 0, job->counts[k] = 0;
    for (int64_t x = x0; x < x1; x += PIECE_COLUMNS)
        for (int64_t y = y0; y < y1; y += PIECE_ROWS) {
            tl_window from = {x, y, tl_int64_min(PIECE_COLUMNS, x1 - x), tl_int64_min(PIECE_ROWS, y1 - y)};
            tl_status status = add_piece(job, from, error);
            if (status != TL_OK)
                return status;
        }
    for (int64_t row = 0; row < part.height; row++)
        for (int64_t k = 0; k < part.width; k++) {
            int64_t cell = row * part.width + k, count = job->counts[cell];
            out[row * stride + k] = count ? (float)(job->sums[cell] / (double)count) : NAN;
        }
    return TL_OK;
}

/* ---- Points ---- */

static tl_status pick_samples(const piece_job *job, float *out, int64_t stride, tl_error *error)
{
    tl_window part = job->part;
    int64_t step = (int64_t)1 << job->halvings;
    tl_window from = {part.x * step, 0, (part.width - 1) * step + 1, 1};
    for (int64_t row = 0; row < part.height; row++) {
        from.y = (part.y + row) * step;
        tl_status status = job->base->read(job->base->context, from, job->piece, error);
        if (status != TL_OK)
            return status;
        for (int64_t k = 0; k < part.width; k++)
            out[row * stride + k] = job->piece[k * step];
    }
    return TL_OK;
}

/* ---- All ---- */

static tl_status make_parts(piece_job *job, tl_window window, float *out, tl_error *error)
{
    int64_t columns = tl_int64_max(1, PIECE_COLUMNS >> tl_int64_min(job->halvings, 30));
    int64_t rows = tl_int64_max(1, PIECE_ROWS >> tl_int64_min(job->halvings, 30));
    bool area = job->base->type == TL_RASTER_AREA;
    for (int64_t x = 0; x < window.width; x += columns)
        for (int64_t y = 0; y < window.height; y += rows) {
            job->part = (tl_window){window.x + x, window.y + y, tl_int64_min(columns, window.width - x),
                                    tl_int64_min(rows, window.height - y)};
            float *to = out + y * window.width + x;
            tl_status status = (area ? make_means : pick_samples)(job, to, window.width, error);
            if (status != TL_OK)
                return status;
        }
    return TL_OK;
}

/* What a piece has of the base's samples one way: small windows need little memory. */
static int64_t piece_side(int64_t most, int64_t size, int halvings)
{
    return size < most && halvings < 16 ? tl_int64_min(most, size << halvings) : most;
}

tl_status dem_level_read(const dem_level_base *base, int halvings, tl_window window, float *out, tl_error *error)
{
    if (halvings == 0)
        return base->read(base->context, window, out, error);
    int64_t most = piece_side(PIECE_COLUMNS, window.width, halvings) * piece_side(PIECE_ROWS, window.height, halvings);
    /* half as many either way, or one */
    int64_t cells = tl_int64_min(PIECE_COLUMNS * PIECE_ROWS / 4, window.width * window.height);
    piece_job job = {.base = base, .halvings = halvings};
    job.piece = tl_alloc((size_t)most, sizeof *job.piece);
    job.sums = tl_alloc((size_t)cells, sizeof *job.sums);
    job.counts = tl_alloc((size_t)cells, sizeof *job.counts);
    tl_status status = TL_OK;
    if (!job.piece || !job.sums || !job.counts)
        status = tl_fail_memory(error, base->name);
    else
        status = make_parts(&job, window, out, error);
    free(job.piece);
    free(job.sums);
    free(job.counts);
    return status;
}
