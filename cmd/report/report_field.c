/* The second section: how near each scheme comes to fractional Brownian motion, and what a sample costs. */
#include "cmd/report/report.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { TILE = 256, LONGEST = 8, SEEDS_QUICK = 3, SEEDS = 16, SIDE_QUICK = 257, SIDE = 513, REFINED = 4097 };

/* What many fields of a scheme have in common. */
typedef struct gathered {
    const char *scheme;
    double hurst;
    size_t fields;
    size_t lag_count;
    int64_t lags[TL_STATISTICS_LAGS];
    measured structure[TL_STATISTICS_LAGS][TL_STATISTICS_DIRECTIONS]; /* over what it ought to be */
    measured hurst_found, positions, anisotropy, kurtosis, nanoseconds;
} gathered;

/* A window in the middle of a field that was refined from far coarser samples; of exact fields, which are made as a
 * whole, the field. */
static tl_status make(const gathered *g, int64_t side, uint64_t seed, tl_source **field, tl_source **window,
                      tl_error *error)
{
    bool whole = strcmp(g->scheme, "exact") == 0;
    int64_t size = whole ? side : REFINED;
    tl_noise_options options = {.size = size, .hurst = g->hurst, .delta = 1, .seed = seed, .scheme = g->scheme};
    *window = NULL;
    *field = tl_noise_create(&options, error);
    if (*field)
        *window = tl_cut_create(*field, (tl_window){(size - side) / 2, (size - side) / 2, side, side}, error);
    return *window ? TL_OK : error->status;
}

/* Reads the window in tiles on this thread; nanoseconds a sample. */
static tl_status time_tiles(const tl_source *window, double *out, tl_error *error)
{
    int64_t across = window->info.width / TILE;
    float *tile = malloc((size_t)TILE * TILE * sizeof *tile);
    tl_status status = TL_OK;
    if (!tile) {
        error->status = status = TL_ERROR_MEMORY;
        snprintf(error->text, sizeof error->text, "the report: not enough memory for a tile");
    }
    double start = progress_clock();
    for (int64_t k = 0; k < across * across && status == TL_OK; k++)
        status = tl_source_read(window, window->info.level,
                                (tl_window){k % across * TILE, k / across * TILE, TILE, TILE}, tile, error);
    *out = (progress_clock() - start) / (double)(across * across * TILE * TILE) * 1e9;
    free(tile);
    return status;
}

/* Takes one field's statistics in. */
static void take(gathered *g, const tl_statistics *s)
{
    g->fields++;
    g->lag_count = s->lag_count;
    for (size_t k = 0; k < s->lag_count; k++) {
        g->lags[k] = s->lags[k].lag;
        for (int d = 0; d < TL_STATISTICS_DIRECTIONS; d++) {
            double h = (double)s->lags[k].lag * (d < 2 ? 1 : sqrt(2));
            /* what the law makes of Z(x) - 2 Z(x + h) + Z(x + 2h): 4 S(h) - S(2h), whose estimate varies less */
            double law = (4 - pow(4, g->hurst)) * pow(h, 2 * g->hurst);
            measured_add(&g->structure[k][d], s->lags[k].second[d] / law);
        }
    }
    if (!s->estimates[0].refusal)
        measured_add(&g->hurst_found, s->estimates[0].hurst - g->hurst);
    if (s->positions[2] > 0)
        measured_add(&g->positions, s->positions[2]);
    if (s->anisotropy > 0)
        measured_add(&g->anisotropy, s->anisotropy);
    if (s->normality_lag)
        measured_add(&g->kurtosis, s->kurtosis);
}

static tl_status gather_one(const report *self, gathered *g, int64_t side, uint64_t seed, tl_error *error)
{
    tl_source *field, *window;
    tl_statistics found;
    double nanoseconds, start = progress_clock();
    tl_status status = make(g, side, seed, &field, &window, error);
    double making = (progress_clock() - start) / (double)(side * side) * 1e9;
    if (status == TL_OK)
        status = time_tiles(window, &nanoseconds, error);
    if (strcmp(g->scheme, "exact") == 0)
        nanoseconds += making; /* all of it is in memory by then */
    if (status == TL_OK)
        status = tl_statistics_measure(window, self->run, &found, error);
    if (status == TL_OK) {
        measured_add(&g->nanoseconds, nanoseconds);
        take(g, &found);
    }
    tl_source_destroy(window);
    tl_source_destroy(field);
    return status;
}

static tl_status gather(const report *self, gathered *g, tl_error *error)
{
    size_t seeds = self->quick ? SEEDS_QUICK : SEEDS;
    int64_t side = self->quick ? SIDE_QUICK : SIDE;
    tl_status status = TL_OK;
    for (size_t k = 0; k < seeds && status == TL_OK; k++)
        status = gather_one(self, g, side, 100 + k, error);
    return status;
}

/* The largest departure of the mean structure function from its law over lags up to LONGEST; *chance: what a field's
 * own spread makes of the mean there. */
static double worst_structure(const gathered *g, double *chance)
{
    double worst = 0;
    *chance = 0;
    for (size_t k = 0; k < g->lag_count && g->lags[k] <= LONGEST; k++)
        for (int d = 0; d < TL_STATISTICS_DIRECTIONS; d++) {
            const measured *m = &g->structure[k][d];
            double off = fabs(measured_mean(m) - 1);
            if (off > worst) {
                worst = off;
                *chance = measured_deviation(m) / sqrt((double)m->count);
            }
        }
    return worst;
}

static void add_row(json_t *table, gathered *g)
{
    double chance, worst = worst_structure(g, &chance);
    json_t *row = report_row(table);
    report_text(row, "scheme", g->scheme);
    report_number(row, "hurst", g->hurst);
    report_number(row, "fields", (double)g->fields);
    report_number(row, "worst", 100 * worst);
    report_number(row, "chance", 100 * chance);
    report_measured(row, "bias", &g->hurst_found);
    report_measured(row, "positions", &g->positions);
    report_measured(row, "anisotropy", &g->anisotropy);
    report_measured(row, "kurtosis", &g->kurtosis);
    report_measured(row, "each", &g->nanoseconds);
}

tl_status report_field(report *self, tl_error *error)
{
    static const double all[] = {.2, .4, .6, .8, .95}, few[] = {.3, .7};
    const double *exponents = self->quick ? few : all;
    size_t count = self->quick ? sizeof few / sizeof *few : sizeof all / sizeof *all;
    char note[512];
    json_t *section = report_section(self, "field", "Field: distance from fractional Brownian motion, and time",
                                     "Fields of each scheme that can do without a model, against the law S(h) = |h|^2H "
                                     "that they are asked for. The scheme "
                                     "exact is a reference: what it shows is the chance of so few fields.");
    snprintf(note, sizeof note,
             "Windows of %d x %d samples with different seeds, refined four times from exact fields. Structure: 4 S(h) "
             "- S(2h), the "
             "mean square of second-order increments, over lags 1 to %d in four directions, the mean of all fields; "
             "chance is its "
             "standard error there. Positions: 1 is stationary, and chance makes more of few samples.",
             self->quick ? SIDE_QUICK : SIDE, self->quick ? SIDE_QUICK : SIDE, LONGEST);
    json_t *table = report_table(section, "schemes", "Schemes", note);
    report_column(table, "scheme", "scheme", "");
    report_column(table, "hurst", "H asked", "");
    report_column(table, "fields", "fields", "");
    report_column(table, "worst", "structure function, worst", "%");
    report_column(table, "chance", "of which chance", "%");
    report_column(table, "bias", "H found less H asked", "");
    report_column(table, "positions", "variance of increments by position modulo 8, largest over smallest", "");
    report_column(table, "anisotropy", "increments by direction, largest over smallest", "");
    report_column(table, "kurtosis", "excess kurtosis of increments", "");
    report_column(table, "each", "time a sample", "ns");
    progress_stage(self->bar, "report: field");
    tl_status status = TL_OK;
    gathered *g = malloc(sizeof *g);
    if (!g) {
        error->status = TL_ERROR_MEMORY;
        snprintf(error->text, sizeof error->text, "the report: not enough memory");
        return TL_ERROR_MEMORY;
    }
    for (const tl_scheme *scheme = tl_schemes(); scheme->name && status == TL_OK; scheme++)
        for (size_t k = 0; k < count && scheme->noise && status == TL_OK; k++) {
            memset(g, 0, sizeof *g);
            g->scheme = scheme->name;
            g->hurst = exponents[k];
            status = gather(self, g, error);
            if (status == TL_OK)
                add_row(table, g);
        }
    free(g);
    report_add_plot(table, &(report_plot){"field_structure", "Worst departure of the structure function, by time",
                                          "each", "worst", "scheme", true, true, true});
    report_add_plot(table, &(report_plot){"field_positions", "Increments by lattice position, by time", "each",
                                          "positions", "scheme", true, false, true});
    return status;
}
