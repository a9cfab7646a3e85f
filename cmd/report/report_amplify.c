/* The third section: the model averaged down, made finer again, and compared with itself. */
#include "cmd/report/report.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { QUICK_SIDE = 512, SIDE = 1024, LEAST_COARSE = 24, WINDOWS = 4, BINS = 9000, TIMED = 3, FACTORS = 4, TILE = 256 };

/* Heights on a grid. */
typedef struct grid {
    int64_t width, height;
    float *z;
} grid;

/* What is compared. */
typedef struct likeness {
    tl_statistics statistics;
    double slopes[BINS]; /* share of the slopes below k / 100 degrees */
} likeness;

static tl_status no_memory(tl_error *error)
{
    error->status = TL_ERROR_MEMORY;
    snprintf(error->text, sizeof error->text, "the report: not enough memory to compare heights");
    return TL_ERROR_MEMORY;
}

static grid grid_of(int64_t width, int64_t height)
{
    return (grid){width, height, malloc((size_t)width * (size_t)height * sizeof(float))};
}

/* ---- The truth ---- */

/* The square window, a multiple of 16 on a side, with the fewest voids of some over the model. */
static tl_status choose_window(const report *self, tl_window *out, uint64_t *voids, tl_error *error)
{
    const tl_source_info *info = &self->dem->info;
    int64_t side = self->quick ? QUICK_SIDE : SIDE;
    side = side < info->width ? side : info->width;
    side = (side < info->height ? side : info->height) / 16 * 16;
    *out = (tl_window){(info->width - side) / 2, (info->height - side) / 2, side, side};
    *voids = UINT64_MAX;
    for (int k = 0; k < WINDOWS * WINDOWS && *voids && side; k++) {
        tl_window window = {(info->width - side) * (k % WINDOWS) / (WINDOWS - 1),
                            (info->height - side) * (k / WINDOWS) / (WINDOWS - 1), side, side};
        tl_range range;
        tl_source *cut = tl_cut_create(self->dem, window, error);
        if (!cut || tl_source_range(cut, self->run, &range, error) != TL_OK) {
            tl_source_destroy(cut);
            return error->status;
        }
        tl_source_destroy(cut);
        if (range.voids < *voids) {
            *voids = range.voids;
            *out = window;
        }
    }
    return TL_OK;
}

/* Reads the window, its voids filled. */
static tl_status read_truth(const report *self, tl_window window, tl_source_info *info, grid *out, tl_error *error)
{
    tl_void_options filling = {.rule = TL_VOIDS_FILL, .run = self->run};
    tl_source *cut = tl_cut_create(self->dem, window, error);
    tl_source *filled = cut ? tl_voids_create(cut, &filling, error) : NULL;
    tl_status status = filled ? TL_OK : error->status;
    *out = grid_of(window.width, window.height);
    if (filled) {
        *info = filled->info;
        status = out->z ? tl_source_read(filled, 0, (tl_window){0, 0, window.width, window.height}, out->z, error)
                        : no_memory(error);
    }
    info->name = self->dem->info.name;
    info->has_voids = false;
    info->parameters = NULL;
    info->parameter_count = 0;
    tl_source_destroy(filled);
    tl_source_destroy(cut);
    return status;
}

static grid average(const grid *fine, int factor)
{
    grid out = grid_of(fine->width / factor, fine->height / factor);
    for (int64_t y = 0; out.z && y < out.height; y++)
        for (int64_t x = 0; x < out.width; x++) {
            double sum = 0;
            for (int64_t j = 0; j < factor; j++)
                for (int64_t i = 0; i < factor; i++)
                    sum += (double)fine->z[(y * factor + j) * fine->width + x * factor + i];
            out.z[y * out.width + x] = (float)(sum / factor / factor);
        }
    return out;
}

/* ---- Comparing ---- */

static void find_slopes(const grid *g, const tl_georef *at, double share[BINS])
{
    memset(share, 0, BINS * sizeof *share);
    for (int64_t y = 1; y + 1 < g->height; y++)
        for (int64_t x = 1; x + 1 < g->width; x++) {
            const float *z = g->z + y * g->width + x;
            double dx = ((double)z[1] - (double)z[-1]) / (2 * at->cell_x);
            double dy = ((double)z[g->width] - (double)z[-g->width]) / (2 * at->cell_y);
            double degrees = atan(hypot(dx, dy) * at->height_unit) * 180 / 3.14159265358979323846;
            share[degrees < 89.99 ? (int)(100 * degrees) : BINS - 1]++;
        }
    double sum = 0, all = (double)(g->width - 2) * (double)(g->height - 2);
    for (int k = 0; k < BINS; k++)
        share[k] = (sum += share[k] / all);
}

/* Without the frame, where every method goes beyond what it knows. */
static tl_status describe(const report *self, const grid *whole, int frame, const tl_source_info *info, likeness *out,
                          tl_error *error)
{
    grid inner = grid_of(whole->width - 2 * frame, whole->height - 2 * frame);
    if (!inner.z)
        return no_memory(error);
    for (int64_t y = 0; y < inner.height; y++)
        memcpy(inner.z + y * inner.width, whole->z + (y + frame) * whole->width + frame,
               (size_t)inner.width * sizeof *inner.z);
    find_slopes(&inner, &info->georef, out->slopes);
    tl_source_info of = *info;
    of.width = inner.width, of.height = inner.height;
    of.quantum = 0;
    of.type = TL_RASTER_POINT;
    tl_source *source = tl_array_source_create(inner.z, &of, error);
    tl_status status = source ? tl_statistics_measure(source, self->run, &out->statistics, error) : error->status;
    tl_source_destroy(source);
    free(inner.z);
    return status;
}

/* The worst |ln| of the ratio of structure functions at lags of up to two coarse samples. */
static double compare_structure(const tl_statistics *a, const tl_statistics *b, int factor)
{
    double worst = 0;
    bool compared = false;
    for (size_t k = 0; k < a->lag_count && k < b->lag_count && a->lags[k].lag <= 2 * factor; k++)
        for (int d = 0; d < TL_STATISTICS_DIRECTIONS; d++) {
            double off = fabs(log(a->lags[k].structure[d] / b->lags[k].structure[d]));
            compared = compared || !isnan(off);
            worst = fmax(worst, off);
        }
    return compared ? worst : (double)NAN;
}

/* The rms of the decimal logarithm of the ratio of spectra, between the coarse grid's shortest wave and the fine one's.
 */
static double compare_spectra(const tl_statistics *a, const tl_statistics *b, int factor)
{
    double sum = 0;
    size_t count = 0;
    for (size_t k = 0; k < a->wave_count && k < b->wave_count; k++)
        if (a->waves[k] >= .5 / factor && a->waves[k] <= .5 && a->power[k] > 0 && b->power[k] > 0) {
            sum += pow(log10(a->power[k] / b->power[k]), 2);
            count++;
        }
    return count ? sqrt(sum / (double)count) : (double)NAN;
}

/* The distance of the two distributions: what the slopes must be changed by in the mean. Degrees. */
static double compare_slopes(const double a[BINS], const double b[BINS])
{
    double sum = 0;
    for (int k = 0; k < BINS; k++)
        sum += fabs(a[k] - b[k]) / 100;
    return sum;
}

static double rms(const grid *a, const grid *b, int frame)
{
    double sum = 0;
    for (int64_t y = frame; y < a->height - frame; y++)
        for (int64_t x = frame; x < a->width - frame; x++) {
            double off = (double)a->z[y * a->width + x] - (double)b->z[y * a->width + x];
            sum += off * off;
        }
    return sqrt(sum / ((double)(a->width - 2 * frame) * (double)(a->height - 2 * frame)));
}

/* ---- Ways to make it finer ---- */

static double held(const grid *g, int64_t x, int64_t y)
{
    x = x < 0 ? 0 : x < g->width ? x : g->width - 1;
    y = y < 0 ? 0 : y < g->height ? y : g->height - 1;
    return (double)g->z[y * g->width + x];
}

/* Weights of four samples around a place, `t` behind the second: linear, or Catmull and Rom's cubic. */
static void weigh(bool cubic, double t, double w[4])
{
    if (!cubic) {
        w[0] = w[3] = 0;
        w[1] = 1 - t, w[2] = t;
        return;
    }
    w[0] = t * (-.5 + t * (1 - .5 * t));
    w[1] = 1 + t * t * (-2.5 + 1.5 * t);
    w[2] = t * (.5 + t * (2 - 1.5 * t));
    w[3] = t * t * (-.5 + .5 * t);
}

static void resample(const grid *coarse, int factor, bool cubic, grid *out)
{
    for (int64_t y = 0; y < out->height; y++) {
        double at = ((double)y + .5) / factor - .5, down[4], across[4];
        int64_t j = (int64_t)floor(at);
        weigh(cubic, at - (double)j, down);
        for (int64_t x = 0; x < out->width; x++) {
            double to = ((double)x + .5) / factor - .5, sum = 0;
            int64_t i = (int64_t)floor(to);
            weigh(cubic, to - (double)i, across);
            for (int r = 0; r < 4; r++)
                for (int c = 0; c < 4; c++)
                    sum += down[r] * across[c] * held(coarse, i - 1 + c, j - 1 + r);
            out->z[y * out->width + x] = (float)sum;
        }
    }
}

/* The coarse grid as a model whose cells are `factor` times as large. */
static tl_source *model_of(const grid *coarse, const tl_source_info *fine, int factor, tl_error *error)
{
    tl_source_info info = *fine;
    double *t = info.georef.transform, half = .5 * (factor - 1);
    info.width = coarse->width, info.height = coarse->height;
    info.type = TL_RASTER_AREA;
    info.quantum = 0;
    info.wraps = false;
    info.block_width = info.block_height = 0;
    for (int a = 0; a < 2; a++) {
        t[3 * a] += half * (t[3 * a + 1] + t[3 * a + 2]);
        t[3 * a + 1] *= factor;
        t[3 * a + 2] *= factor;
    }
    info.georef.cell_x *= factor;
    info.georef.cell_y *= factor;
    return tl_array_source_create(coarse->z, &info, error);
}

static tl_status read_tiles(const tl_source *field, grid *out, tl_error *error)
{
    float *tile = malloc((size_t)TILE * TILE * sizeof *tile);
    tl_status status = tile ? TL_OK : no_memory(error);
    for (int64_t y = 0; y < out->height && status == TL_OK; y += TILE)
        for (int64_t x = 0; x < out->width && status == TL_OK; x += TILE) {
            tl_window w = {x, y, out->width - x < TILE ? out->width - x : TILE,
                           out->height - y < TILE ? out->height - y : TILE};
            status = tl_source_read(field, field->info.level, w, tile, error);
            for (int64_t r = 0; r < w.height && status == TL_OK; r++)
                memcpy(out->z + (y + r) * out->width + x, tile + r * w.width, (size_t)w.width * sizeof *tile);
        }
    free(tile);
    return status;
}

/* Makes `out` of the coarse grid some times, on this thread. `method` is a scheme, "bilinear" or "cubic". The
 * measurement of the model, which a scheme makes once, is not in the times. */
static tl_status amplify(const report *self, const grid *coarse, const tl_source_info *fine, int log,
                         const char *method, grid *out, measured *each, tl_error *error)
{
    bool linear = strcmp(method, "bilinear") == 0, cubic = strcmp(method, "cubic") == 0;
    tl_run alone = {.threads = 1, .cancel = self->run->cancel};
    tl_field_options options = {.levels = log, .scheme = method, .run = &alone, .seed = 1};
    tl_source *dem = NULL, *field = NULL;
    tl_status status = TL_OK;
    if (!linear && !cubic) {
        dem = model_of(coarse, fine, 1 << log, error);
        field = dem ? tl_field_create(dem, &options, error) : NULL;
        status = field ? TL_OK : error->status;
    }
    for (int k = 0; k < TIMED && status == TL_OK; k++) {
        double start = progress_clock();
        if (field)
            status = read_tiles(field, out, error);
        else
            resample(coarse, 1 << log, cubic, out);
        measured_add(each, (progress_clock() - start) / ((double)out->width * (double)out->height) * 1e9);
    }
    tl_source_destroy(field);
    tl_source_destroy(dem);
    return status;
}

typedef struct comparison {
    const grid *fine, *coarse;
    const likeness *truth;
    const tl_source_info *info;
    int log;
} comparison;

static tl_status add_method(const report *self, const comparison *of, const char *method, json_t *table,
                            tl_error *error)
{
    int factor = 1 << of->log, frame = 2 * factor;
    measured each = {.count = 0};
    grid made = grid_of(of->fine->width, of->fine->height);
    likeness *found = malloc(sizeof *found);
    tl_status status = made.z && found ? TL_OK : no_memory(error);
    if (status == TL_OK)
        status = amplify(self, of->coarse, of->info, of->log, method, &made, &each, error);
    json_t *row = status == TL_OK || status == TL_ERROR_DATA || status == TL_ERROR_ARGUMENT ? report_row(table) : NULL;
    if (row) {
        report_text(row, "method", method);
        report_number(row, "factor", factor);
    }
    if (row && status != TL_OK) { /* a scheme that such a model is not for */
        report_text(row, "remark", error->text);
        status = TL_OK;
    } else if (status == TL_OK) {
        status = describe(self, &made, frame, of->info, found, error);
        if (status == TL_OK) {
            report_number(row, "structure", compare_structure(&found->statistics, &of->truth->statistics, factor));
            report_number(row, "spectrum", compare_spectra(&found->statistics, &of->truth->statistics, factor));
            report_number(row, "slope", compare_slopes(found->slopes, of->truth->slopes));
            report_number(row, "rms", rms(&made, of->fine, frame));
            report_number(row, "samples", (double)found->statistics.samples);
            report_measured(row, "each", &each);
        }
    }
    free(found);
    free(made.z);
    return status;
}

static tl_status add_factor(const report *self, const grid *fine, const tl_source_info *info, int log, json_t *table,
                            tl_error *error)
{
    int factor = 1 << log;
    grid coarse = average(fine, factor);
    likeness *truth = malloc(sizeof *truth);
    comparison of = {fine, &coarse, truth, info, log};
    tl_status status = coarse.z && truth ? describe(self, fine, 2 * factor, info, truth, error) : no_memory(error);
    for (int k = 0; k < 2 && status == TL_OK; k++)
        status = add_method(self, &of, k ? "cubic" : "bilinear", table, error);
    for (const tl_scheme *scheme = tl_schemes(); scheme->name && status == TL_OK; scheme++)
        if (scheme->field)
            status = add_method(self, &of, scheme->name, table, error);
    free(truth);
    free(coarse.z);
    return status;
}

static json_t *add_table(json_t *section, const char *unit, tl_window window, uint64_t voids)
{
    char note[512];
    snprintf(
        note, sizeof note,
        "The %lld x %lld samples from column %lld, row %lld, %llu voids of them filled, averaged over squares. "
        "Structure: "
        "worst |ln| of the ratio of structure functions over lags of up to two coarse samples, in four directions; "
        "spectrum: rms log10 of the ratio of power between both grids' shortest waves; slope: distance of the two "
        "distributions. A smooth surface wins the rms error; detail costs there.",
        (long long)window.width, (long long)window.height, (long long)window.x, (long long)window.y,
        (unsigned long long)voids);
    json_t *table = report_table(section, "methods", "Methods against the truth", note);
    report_column(table, "method", "method", "");
    report_column(table, "factor", "factor", "");
    report_column(table, "structure", "structure", "");
    report_column(table, "spectrum", "spectrum", "decades");
    report_column(table, "slope", "slope", "degrees");
    report_column(table, "rms", "rms error", unit);
    report_column(table, "samples", "samples compared", "");
    report_column(table, "each", "time a sample", "ns");
    report_column(table, "remark", "remark", "");
    report_add_plot(table, &(report_plot){"amplification_structure", "Structure, by factor", "factor", "structure",
                                          "method", true, true, false});
    report_add_plot(table, &(report_plot){"amplification_slope", "Slope, by factor", "factor", "slope", "method", true,
                                          true, false});
    report_add_plot(table, &(report_plot){"amplification_time", "Structure, by time a sample", "each", "structure",
                                          "method", true, true, true});
    return table;
}

tl_status report_amplification(report *self, tl_error *error)
{
    tl_window window;
    uint64_t voids;
    tl_source_info info;
    grid fine = {0, 0, NULL};
    const char *unit = self->dem->info.georef.height_unit == 1 ? "m" : "units of height";
    json_t *section = report_section(self, "amplification",
                                     "Amplification: the model averaged down, made finer and compared with itself",
                                     "What is made below the samples of a coarse model is compared with the finer one "
                                     "that it came from: by its statistics, "
                                     "since no detail can be guessed at its place. The numbers are those by which real "
                                     "terrain would be told from ours.");
    progress_stage(self->bar, "report: amplification");
    tl_status status = choose_window(self, &window, &voids, error);
    if (voids == UINT64_MAX)
        voids = 0; /* nothing was looked at */
    json_t *table = status == TL_OK ? add_table(section, unit, window, voids) : NULL;
    if (status == TL_OK && window.width / 2 < LEAST_COARSE) {
        json_t *row = report_row(table);
        report_text(row, "method", "none");
        report_text(row, "remark", "the model is too small to be averaged down");
        return TL_OK;
    }
    if (status == TL_OK)
        status = read_truth(self, window, &info, &fine, error);
    for (int log = 1; log <= FACTORS && status == TL_OK && window.width >> log >= LEAST_COARSE; log++)
        status = add_factor(self, &fine, &info, log, table, error);
    free(fine.z);
    return status;
}
