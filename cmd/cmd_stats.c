#include "cmd/command.h"

#include <jansson.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

typedef struct settings {
    common common;
    const char *maps;
    int64_t window, stride;
    tl_expectation expected;
    bool json, tolerance_given;
} settings;

/* ---- for machines ---- */

static json_t *number(double value)
{
    return isfinite(value) ? json_real(value) : json_null();
}

static json_t *text(const char *value)
{
    json_t *string = json_string(value);
    return string ? string : json_string("?"); /* a name that is no UTF-8 */
}

static json_t *estimate_json(const tl_fbm_estimate *e)
{
    bool good = !e->refusal, delta = good && e->delta_known;
    return json_pack("{s:s, s:o, s:o, s:o, s:o, s:o, s:o}", "name", e->name, "refusal",
                     e->refusal ? json_string(e->refusal) : json_null(), "hurst", good ? number(e->hurst) : json_null(),
                     "hurst_error", good ? number(e->hurst_error) : json_null(), "delta",
                     delta ? number(e->delta) : json_null(), "delta_error",
                     delta ? number(e->delta_error) : json_null(), "misfit",
                     good && e->misfit > 0 ? number(e->misfit) : json_null());
}

static json_t *estimates_json(const tl_statistics *s)
{
    json_t *list = json_array();
    for (size_t k = 0; k < sizeof s->estimates / sizeof *s->estimates; k++)
        json_array_append_new(list, estimate_json(&s->estimates[k]));
    return list;
}

static json_t *numbers(const double *values, size_t count)
{
    json_t *list = json_array();
    for (size_t k = 0; k < count; k++)
        json_array_append_new(list, number(values[k]));
    return list;
}

static json_t *lags_json(const tl_statistics *s)
{
    json_t *list = json_array();
    for (size_t k = 0; k < s->lag_count; k++)
        json_array_append_new(list, json_pack("{s:I, s:o, s:o}", "lag", (json_int_t)s->lags[k].lag, "structure",
                                              numbers(s->lags[k].structure, TL_STATISTICS_DIRECTIONS), "second",
                                              numbers(s->lags[k].second, TL_STATISTICS_DIRECTIONS)));
    return list;
}

static json_t *octaves_json(const tl_statistics *s)
{
    json_t *list = json_array();
    for (size_t k = 0; k < s->octave_count; k++) {
        const tl_octave *o = &s->octaves[k];
        json_array_append_new(list,
                              json_pack("{s:f, s:o, s:o, s:o, s:I}", "cells", o->cells, "sigma",
                                        o->sigma > 0 ? number(o->sigma) : json_null(), "exponent", number(o->exponent),
                                        "hurst", number(o->hurst), "count", (json_int_t)o->count));
    }
    return list;
}

static json_t *positions_json(const tl_statistics *s)
{
    json_t *list = json_array();
    for (int k = 0; k < 3; k++)
        if (s->position_limits[k] > 0)
            json_array_append_new(list, json_pack("{s:i, s:o, s:o}", "modulo", 2 << k, "ratio", number(s->positions[k]),
                                                  "limit", number(s->position_limits[k])));
    return list;
}

static json_t *normality_json(const tl_statistics *s)
{
    if (!s->normality_lag)
        return json_null();
    return json_pack("{s:I, s:o, s:o, s:o, s:o, s:o}", "lag", (json_int_t)s->normality_lag, "skewness",
                     number(s->skewness), "skewness_error", number(s->skewness_error), "kurtosis", number(s->kurtosis),
                     "kurtosis_error", number(s->kurtosis_error), "chance", number(s->normality_chance));
}

static void print_json(const tl_source_info *info, const tl_statistics *s)
{
    json_t *object =
        json_pack("{s:o, s:I, s:I, s:s, s:I, s:I, s:o, s:o}", "name", text(info->name), "width",
                  (json_int_t)info->width, "height", (json_int_t)info->height, "raster_type",
                  info->type == TL_RASTER_AREA ? "area" : "point", "samples", (json_int_t)s->samples, "voids",
                  (json_int_t)s->voids, "rounding", number(sqrt(s->noise)), "estimates", estimates_json(s));
    bool isotropy = s->anisotropy > 0;
    json_object_set_new(object, "anisotropy",
                        isotropy ? json_pack("{s:o, s:o, s:o, s:o}", "ratio", number(s->anisotropy), "error",
                                             number(s->anisotropy_error), "azimuth_degrees", number(s->azimuth),
                                             "chance", number(s->isotropy_chance))
                                 : json_null());
    json_object_set_new(object, "positions", positions_json(s));
    json_object_set_new(object, "normality", normality_json(s));
    json_object_set_new(object, "octaves", octaves_json(s));
    json_object_set_new(object, "lags", lags_json(s));
    json_object_set_new(object, "spectrum",
                        s->wave_count
                            ? json_pack("{s:o, s:o, s:o, s:o}", "slope", s->slope > 0 ? number(s->slope) : json_null(),
                                        "slope_error", s->slope > 0 ? number(s->slope_error) : json_null(),
                                        "cycles_per_sample", numbers(s->waves, s->wave_count), "power",
                                        numbers(s->power, s->wave_count))
                            : json_null());
    json_dumpf(object, stdout, JSON_INDENT(2) | JSON_REAL_PRECISION(12));
    putchar('\n');
    json_decref(object);
}

/* ---- for people ---- */

static void print_estimates(const tl_statistics *s)
{
    static const char *const titles[] = {"H, increments", "H, structure", "H, spectrum"};
    for (int k = 0; k < 3; k++) {
        const tl_fbm_estimate *e = &s->estimates[k];
        printf("%-14s ", titles[k]);
        if (e->refusal) {
            printf("not known: %s\n", e->refusal);
            continue;
        }
        printf("%.4f (error %.4f)", e->hurst, e->hurst_error);
        if (e->delta_known)
            printf(", delta %.5g (error %.2g)", e->delta, e->delta_error);
        else
            printf(", smoother than any fBm: no delta");
        if (e->misfit > 2)
            printf(", misfit %.3g: no single power law", e->misfit);
        putchar('\n');
    }
    if (s->slope > 0)
        printf("spectrum       falls as k^-%.3f (error %.3f)\n", s->slope, s->slope_error);
}

static void print_shape(const tl_statistics *s)
{
    if (s->anisotropy > 0)
        printf("anisotropy     %.4f (error %.4f), roughest towards %.0f degrees; chance of isotropic fBm %.2g\n",
               s->anisotropy, s->anisotropy_error, s->azimuth, s->isotropy_chance);
    for (int k = 0; k < 3; k++)
        if (s->position_limits[k] > 0)
            printf("%-14s largest / smallest variance modulo %d: %.4f, %s %.4f\n", k ? "" : "positions", 2 << k,
                   s->positions[k],
                   s->positions[k] <= s->position_limits[k] ? "stationary: up to" : "not stationary: above",
                   s->position_limits[k]);
    if (s->normality_lag)
        printf("increments     over %lld: skewness %.4f (error %.4f), excess kurtosis %.4f (error %.4f): %s (chance "
               "%.2g)\n",
               (long long)s->normality_lag, s->skewness, s->skewness_error, s->kurtosis, s->kurtosis_error,
               s->normality_chance < 0.01 ? "not Gaussian" : "Gaussian", s->normality_chance);
}

static void print_tables(const tl_statistics *s)
{
    if (s->octave_count)
        printf("\noctave of      sigma     exponent          H\n");
    for (size_t k = 0; k < s->octave_count; k++) {
        const tl_octave *o = &s->octaves[k];
        printf("%6g cells", o->cells);
        if (o->sigma > 0)
            printf("  %10.4g", o->sigma);
        else
            printf("      hidden");
        printf(isfinite(o->exponent) ? "  %7.3f" : "        -", o->exponent);
        printf(isfinite(o->hurst) ? "  %7.3f\n" : "        -\n", o->hurst);
    }
    if (s->lag_count)
        printf("\nlag            S(lag), root: rows     columns     falling      rising\n");
    for (size_t k = 0; k < s->lag_count; k++) {
        printf("%-14lld          ", (long long)s->lags[k].lag);
        for (int d = 0; d < TL_STATISTICS_DIRECTIONS; d++)
            printf(" %11.5g", sqrt(s->lags[k].structure[d]));
        putchar('\n');
    }
}

static void print_plain(const char *line)
{
    for (; *line; line++)
        putchar((unsigned char)*line < 0x20 || *line == 0x7f ? '?' : *line);
}

static void print_text(const tl_source_info *info, const tl_statistics *s)
{
    print_plain(info->name);
    printf("\nsamples        %lld x %lld %s, %llu voids\n", (long long)info->width, (long long)info->height,
           info->type == TL_RASTER_AREA ? "cells" : "points", (unsigned long long)s->voids);
    print_estimates(s);
    print_shape(s);
    print_tables(s);
}

/* ---- the command ---- */

static tl_status make_all(const settings *set, const tl_source *source, const tl_run *run, progress *bar,
                          tl_statistics *s, tl_error *error)
{
    progress_stage(bar, "measuring");
    tl_status status = tl_statistics_measure(source, run, s, error);
    if (status == TL_OK && set->maps) {
        const tl_map_options maps = {
            .window = (int)set->window, .stride = (int)set->stride, .overwrite = set->common.overwrite, .run = run};
        progress_stage(bar, "maps");
        status = tl_statistics_write_maps(source, set->maps, &maps, error);
    }
    if (status == TL_OK && set->common.output) {
        status = tl_statistics_plot(s, source->info.name, set->common.output, set->common.overwrite, error);
        if (status != TL_OK && set->maps)
            unlink(set->maps); /* a failed run leaves nothing */
    }
    return status;
}

static int measure(const settings *set, const arguments *inputs)
{
    progress bar;
    tl_error error;
    tl_statistics s;
    tl_run run = command_run(&set->common, &bar);
    opened_input opened = command_open(&set->common, inputs, &run, &error);
    if (!opened.source)
        return command_failed(&bar, &error);
    int status = EXIT_DONE;
    const tl_source_info *info = &opened.source->info;
    if (make_all(set, opened.source, &run, &bar, &s, &error) != TL_OK)
        status = command_failed(&bar, &error);
    else {
        progress_end(&bar);
        if (set->json)
            print_json(info, &s);
        else if (!set->common.quiet)
            print_text(info, &s);
        status = command_done();
        if (status == EXIT_DONE && tl_statistics_expect(&s, &set->expected, info->name, &error) != TL_OK)
            status = command_failed(&bar, &error);
    }
    command_close(&opened);
    return status;
}

/* What can be told without reading anything. */
static bool sensible(const settings *set)
{
    const char *dot = set->common.output ? strrchr(set->common.output, '.') : NULL;
    if (set->common.output && (!dot || (strcmp(dot, ".svg") != 0 && strcmp(dot, ".png") != 0))) {
        complain("%s: the plot's name must end with .svg or .png", set->common.output);
        return false;
    }
    const tl_format *format = set->maps ? tl_format_of(set->maps) : NULL;
    if (set->maps && (!format || strncmp(format->ending, "tif", 3) != 0)) {
        complain("%s: maps are written as .tif", set->maps);
        return false;
    }
    if (set->tolerance_given && !set->expected.hurst_given && !set->expected.delta_given) {
        complain("--tolerance is of what is expected; give --expect-hurst or --expect-delta too");
        return false;
    }
    return true;
}

static int run(const command *self, int argc, const char **argv, command_help help)
{
    settings set = {0};
    const option output[] = {
        {"json", 'j', OPTION_FLAG, &set.json, NULL, NULL, "for machines: one JSON object", 0, 0, NULL},
        {"output", 'o', OPTION_TEXT, &set.common.output, NULL, "PLOT", "a plot, .svg or .png", 0, 0, NULL},
        {"maps", 'm', OPTION_TEXT, &set.maps, NULL, "FILE.tif",
         "local maps: bands H, sigma, azimuth, error of H, increments", 0, 0, NULL},
        {"map-window", 0, OPTION_INTEGER, &set.window, NULL, "N",
         "samples on a side of a map's window, 33...513 "
         "(default: 65)",
         33, 513, NULL},
        {"map-stride", 0, OPTION_INTEGER, &set.stride, NULL, "N", "samples between the windows, 8...512 (default: 32)",
         8, 512, NULL},
        {"overwrite", 0, OPTION_FLAG, &set.common.overwrite, NULL, NULL, "replace plot and maps if they exist", 0, 0,
         NULL},
        {0}};
    const option checks[] = {{"expect-hurst", 0, OPTION_NUMBER, &set.expected.hurst, &set.expected.hurst_given, "H",
                              "fail (exit status 1) where H by increments is another, 0...2", 0, 2, NULL},
                             {"expect-delta", 0, OPTION_NUMBER, &set.expected.delta, &set.expected.delta_given, "D",
                              "likewise of delta, in units of height over one sample, 0...1e30", 0, 1e30, NULL},
                             {"tolerance", 0, OPTION_NUMBER, &set.expected.tolerance, &set.tolerance_given, "T",
                              "how far H may be off, and delta as a fraction of it, 1e-6...1 (default: 0.05)", 1e-6, 1,
                              NULL},
                             {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"Output", output}, {"Checks", checks}, {"Input", input}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status))
        return status;
    status = sensible(&set) ? measure(&set, &rest) : EXIT_USAGE;
    arguments_free(&rest);
    return status;
}

const command command_stats = {"stats", "measure how like fractional Brownian motion a raster is",
                               "RASTER... [--json] [-o PLOT] [--maps FILE.tif]",
                               INPUT_NOTES "\n\nExample: talus stats dem.tif --expect-hurst 0.7 --tolerance 0.02", run};
