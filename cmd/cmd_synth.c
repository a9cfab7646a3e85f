#include "cmd/command.h"

#include <stdio.h>
#include <string.h>

static const char *const compressions[] = {
    [TL_COMPRESSION_DEFAULT] = "default", [TL_COMPRESSION_NONE] = "none", [TL_COMPRESSION_ZIP] = "zip",
    [TL_COMPRESSION_ZIPS] = "zips",       [TL_COMPRESSION_PIZ] = "piz",   NULL};
typedef struct settings {
    common common;
    tl_field_options field;
    tl_noise_options noise;
    int64_t levels, seed;
    int compression, frame;
    bool size_given, hurst_given, delta_given;
} settings;

static void report(const settings *set, const tl_source *made, double seconds)
{
    double samples = (double)made->info.width * (double)made->info.height;
    command_say(&set->common, "%s: %lld x %lld samples, cells of %.4g x %.4g m, %.2f s (%.1f M samples/s)",
                set->common.output, (long long)made->info.width, (long long)made->info.height, made->info.georef.cell_x,
                made->info.georef.cell_y, seconds, seconds > 0 ? samples / seconds / 1e6 : 0);
    for (size_t i = 0; i < made->info.parameter_count; i++)
        command_say(&set->common, "  %s: %s", made->info.parameters[i].name, made->info.parameters[i].value);
}

static int write_out(const settings *set, const tl_source *made, const tl_run *run, progress *bar)
{
    tl_error error;
    progress_stage(bar, "synthesis");
    tl_write_options options = {.overwrite = set->common.overwrite,
                                .validity = set->common.voids && strcmp(set->common.voids, "keep") != 0,
                                .compression = (tl_compression)set->compression,
                                .frame = (tl_frame)set->frame,
                                .run = run};
    if (tl_write_grid(made, set->common.output, &options, &error) != TL_OK)
        return command_failed(bar, &error);
    report(set, made, progress_end(bar));
    return EXIT_DONE;
}

/* ---- synth ---- */

static int synth(settings *set, const arguments *inputs)
{
    progress bar;
    tl_error error;
    tl_run run = command_run(&set->common, &bar);
    opened_input opened = command_open(&set->common, inputs, &run, &error);
    const tl_source *dem = opened.source;
    if (!dem)
        return command_failed(&bar, &error);
    progress_stage(&bar, "measuring");
    set->field.run = &run;
    tl_source *field = tl_field_create(dem, &set->field, &error);
    int status = field ? write_out(set, field, &run, &bar) : command_failed(&bar, &error);
    tl_source_destroy(field);
    command_close(&opened);
    return status;
}

/* Schemes that a command has. */
static size_t schemes_of(bool noise, tl_scheme out[16])
{
    size_t count = 0;
    for (const tl_scheme *s = tl_schemes(); s->name && count < 16; s++)
        if (s->noise || !noise)
            out[count++] = *s;
    return count;
}

static bool names_scheme(const char *name, bool noise)
{
    tl_scheme schemes[16];
    size_t count = schemes_of(noise, schemes);
    for (size_t i = 0; i < count; i++)
        if (strcmp(schemes[i].name, name) == 0)
            return true;
    complain_of_choice("scheme", name, &schemes->name, count, sizeof *schemes);
    return false;
}

static void list_schemes(bool noise)
{
    tl_scheme schemes[16];
    size_t count = schemes_of(noise, schemes);
    printf("\nSchemes:\n");
    for (size_t i = 0; i < count; i++)
        printf("  %-22s  %s\n", schemes[i].name, schemes[i].summary);
}

static int run_synth(const command *self, int argc, const char **argv, bool help)
{
    settings set = {.levels = 4};
    const option detail[] = {
        {"levels", 'l', OPTION_INTEGER, &set.levels, NULL, "N",
         "halvings of the DEM's spacing, 0...30 (default: 4, 16 times finer)", 0, 30, NULL},
        {"seed", 's', OPTION_INTEGER, &set.seed, NULL, "N", "another seed, another terrain, 0...2^62 (default: 0)", 0,
         0x1p62, NULL},
        {"hurst", 0, OPTION_NUMBER, &set.field.hurst, &set.field.hurst_given, "H",
         "Hurst exponent of the detail, 0.01...0.99 (default: measured from the DEM, octave by octave)", 0.01, 0.99,
         NULL},
        {"delta", 0, OPTION_NUMBER, &set.field.delta, &set.field.delta_given, "D",
         "standard deviation of the height difference over one DEM sample, in the DEM's unit, 0...1e30 (default: "
         "measured)",
         0, 1e30, NULL},
        {"scheme", 0, OPTION_TEXT, &set.field.scheme, NULL, "NAME",
         "way to refine, listed below (default: terrain; stationary with --hurst or --delta)", 0, 0, NULL},
        {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option output[] = {COMMON_OUTPUT(set.common),
                             {"compression", 0, OPTION_CHOICE, &set.compression, NULL, "KIND",
                              "of .exr and .tif (default: zip)", 0, 0, compressions},
                             {"frame", 0, OPTION_CHOICE, &set.frame, NULL, "FRAME",
                              "coordinates of a mesh (default: enu where the CRS is known)", 0, 0, frame_names},
                             {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"Detail", detail}, {"Input", input}, {"Output", output}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status)) {
        if (help || status == EXIT_DONE)
            list_schemes(false);
        return status;
    }
    set.field.levels = (int)set.levels;
    set.field.seed = (uint64_t)set.seed;
    bool good =
        (!set.field.scheme || names_scheme(set.field.scheme, false)) && command_output_ok(&set.common, true, true);
    status = good ? synth(&set, &rest) : EXIT_USAGE;
    arguments_free(&rest);
    return status;
}

const command command_synth = {
    "synth", "add fractal detail below the samples of an elevation model", "DEM... [--levels N] -o OUTPUT",
    INPUT_NOTES "\n\nFormats: .exr, .tif, .png (16 bit, with a .json beside it), .glb, .obj, .ply.\n\n"
                "Example: talus synth dem.tif --levels 4 --seed 7 -o terrain.exr",
    run_synth};

/* ---- noise ---- */

static int noise(settings *set)
{
    progress bar;
    tl_error error;
    tl_run run = command_run(&set->common, &bar);
    tl_source *field = tl_noise_create(&set->noise, &error);
    int status = field ? write_out(set, field, &run, &bar) : command_failed(&bar, &error);
    tl_source_destroy(field);
    return status;
}

static int run_noise(const command *self, int argc, const char **argv, bool help)
{
    settings set = {.noise = {.size = 1024, .hurst = 0.8, .delta = 1}};
    const option surface[] = {{"size", 'n', OPTION_INTEGER, &set.noise.size, NULL, "N",
                               "samples on a side, 1...2^24 (default: 1024)", 1, 16777216, NULL},
                              {"hurst", 0, OPTION_NUMBER, &set.noise.hurst, NULL, "H",
                               "Hurst exponent, 0.01...0.99 (default: 0.8)", 0.01, 0.99, NULL},
                              {"delta", 0, OPTION_NUMBER, &set.noise.delta, NULL, "D",
                               "standard deviation of the height difference over one sample, 0...1e30 (default: 1)", 0,
                               1e30, NULL},
                              {"seed", 's', OPTION_INTEGER, &set.seed, NULL, "N",
                               "another seed, another surface, 0...2^62 (default: 0)", 0, 0x1p62, NULL},
                              {"scheme", 0, OPTION_TEXT, &set.noise.scheme, NULL, "NAME",
                               "way to refine, listed below (default: the first)", 0, 0, NULL},
                              {0}};
    const option output[] = {COMMON_OUTPUT(set.common),
                             {"compression", 0, OPTION_CHOICE, &set.compression, NULL, "KIND",
                              "of .exr and .tif (default: zip)", 0, 0, compressions},
                             {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"Surface", surface}, {"Output", output}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, 0, &rest, &status)) {
        if (help || status == EXIT_DONE)
            list_schemes(true);
        return status;
    }
    set.noise.seed = (uint64_t)set.seed;
    bool good =
        (!set.noise.scheme || names_scheme(set.noise.scheme, true)) && command_output_ok(&set.common, true, true);
    status = good ? noise(&set) : EXIT_USAGE;
    arguments_free(&rest);
    return status;
}

const command command_noise = {"noise", "make a fractional Brownian surface",
                               "[--size N] [--hurst H] [--delta D] -o OUTPUT",
                               "Formats: .exr, .tif, .png (16 bit, with a .json beside it), .glb, .obj, .ply.\n\n"
                               "Example: talus noise --size 2048 --hurst 0.7 -o noise.exr",
                               run_noise};
