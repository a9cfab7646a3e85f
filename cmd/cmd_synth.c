#include "cmd/command.h"
#include "cmd/same_as.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <unistd.h>

static const char *const compressions[] = {[TL_COMPRESSION_DEFAULT] = "default", [TL_COMPRESSION_NONE] = "none",
                                           [TL_COMPRESSION_ZIP] = "zip",         [TL_COMPRESSION_ZIPS] = "zips",
                                           [TL_COMPRESSION_PIZ] = "piz",         [TL_COMPRESSION_DEFLATE] = "deflate",
                                           [TL_COMPRESSION_ZSTD] = "zstd",       [TL_COMPRESSION_LZW] = "lzw",
                                           [TL_COMPRESSION_LERC] = "lerc",       NULL};
static const char *const mips[] = {[TL_MIP_NONE] = "none", [TL_MIP_LATTICE] = "lattice", [TL_MIP_BOX] = "box", NULL};
static const char *const supports[] = {
    [TL_SUPPORT_RASTER] = "raster", [TL_SUPPORT_AREA] = "area", [TL_SUPPORT_POINT] = "point", NULL};

enum { LAYERS_AS_EXR, LAYERS_AS_PNG };
static const char *const layer_formats[] = {[LAYERS_AS_EXR] = "exr", [LAYERS_AS_PNG] = "png", NULL};

typedef struct settings {
    common common;
    tl_field_options field;
    tl_noise_options noise;
    int64_t levels, seed;
    int compression, mip, frame, support;
    const char *layers, *layer_rules;
    int layer_format;
    const char *preset;
    int64_t tile;
    double quantum; /* step of the heights */
    bool quantum_given;
    double lerc_error;
    bool lerc_error_given, mip_given, cog, mask, half, one_file;
    bool size_given, hurst_given, delta_given;
    double max_error; /* of the framework that the DEM is reduced to first */
    bool max_error_given, verify;
    const char *hurst_map, *delta_map, *sigma_map;
    const char *same_as; /* an output to be made again */
    const char *record;  /* of the command line */
    char **files;        /* what was written, by the names that it has or had; see written() */
    size_t file_count;
} settings;

/* One more file that was written; takes the name. Out of memory it is forgotten. */
static void written(settings *set, char *path)
{
    char **more = path ? realloc(set->files, (set->file_count + 1) * sizeof *more) : NULL;
    if (!more) {
        free(path);
        return;
    }
    set->files = more;
    set->files[set->file_count++] = path;
}

/* The output's name with something else in place of its ending; to be freed. */
static char *name_beside(const settings *set, const char *instead)
{
    const char *output = set->common.output, *dot = strrchr(output, '.');
    size_t stem = dot ? (size_t)(dot - output) : strlen(output), room = stem + strlen(instead) + 1;
    char *path = malloc(room);
    if (path)
        snprintf(path, room, "%.*s%s", (int)stem, output, instead);
    return path;
}

/* The heights' file and what is written beside it under any name; those that are not there do not matter. */
static void note_output(settings *set)
{
    const char *output = set->common.output;
    size_t room = strlen(output) + sizeof ".json";
    char *json = malloc(room);
    if (json)
        snprintf(json, room, "%s.json", output);
    written(set, strdup(output));
    if (command_ends_with(output, ".r16") || command_ends_with(output, ".raw"))
        written(set, json);
    else
        free(json);
    if (command_ends_with(output, ".png") || set->preset)
        written(set, name_beside(set, ".json"));
    if (set->common.voids && strcmp(set->common.voids, "keep") != 0)
        written(set, name_beside(set, ".validity.tif"));
}

static void note_tiles(settings *set, const tl_preset_report *report)
{
    for (int64_t k = 0; k < report->columns * report->rows && report->columns * report->rows > 1; k++) {
        char tile[64];
        snprintf(tile, sizeof tile, "_x%lld_y%lld%s", (long long)(k % report->columns),
                 (long long)(k / report->columns), strrchr(set->common.output, '.'));
        written(set, name_beside(set, tile));
    }
}

/* Compares with the file of --same-as, and lets go of the names. */
static int compare_same(settings *set, const arguments *rest, int status)
{
    if (status == EXIT_DONE && set->same_as) {
        note_output(set);
        status = same_as_compare(set->same_as, &set->common, rest, set->files, set->file_count);
    }
    for (size_t k = 0; k < set->file_count; k++)
        free(set->files[k]);
    free(set->files);
    return status;
}

static void report(const settings *set, const tl_source *made, double seconds)
{
    double samples = (double)made->info.width * (double)made->info.height;
    command_say(&set->common, "%s: %lld x %lld samples, cells of %.4g x %.4g m, %.2f s (%.1f M samples/s)",
                set->common.output, (long long)made->info.width, (long long)made->info.height, made->info.georef.cell_x,
                made->info.georef.cell_y, seconds, seconds > 0 ? samples / seconds / 1e6 : 0);
    for (size_t i = 0; i < made->info.parameter_count; i++)
        command_say(&set->common, "  %s: %s", made->info.parameters[i].name, made->info.parameters[i].value);
}

/* Writes what a preset asks for, and tells what to type into its importer. */
static tl_status write_preset(settings *set, const tl_source *made, const tl_run *run, tl_error *error)
{
    const tl_preset_options options = {
        .preset = set->preset, .tile = set->tile, .overwrite = set->common.overwrite, .run = run};
    tl_preset_report report;
    tl_status status = tl_write_preset(made, set->common.output, &options, &report, error);
    if (status != TL_OK)
        return status;
    note_tiles(set, &report);
    double share = (double)report.window.width * (double)report.window.height /
                   ((double)made->info.width * (double)made->info.height);
    command_say(&set->common,
                "%s: %lld x %lld tiles of %lld x %lld samples, from column %lld, row %lld, %.3g %% of all; %g ... %g",
                set->preset, (long long)report.columns, (long long)report.rows, (long long)report.tile_width,
                (long long)report.tile_height, (long long)report.window.x, (long long)report.window.y, 100 * share,
                (double)report.low, (double)report.high);
    for (char *rest, *line = strtok_r(report.import, "\n", &rest); line; line = strtok_r(NULL, "\n", &rest))
        command_say(&set->common, "  %s", line);
    return TL_OK;
}

static tl_status write_samples(settings *set, const tl_source *made, const tl_run *run, tl_error *error)
{
    if (set->preset)
        return write_preset(set, made, run, error);
    tl_mip usual = made->info.type == TL_RASTER_AREA ? TL_MIP_BOX : TL_MIP_LATTICE;
    tl_write_options options = {.overwrite = set->common.overwrite,
                                .texture_size = (int)set->common.texture_size,
                                .split = (size_t)set->common.split,
                                .cog = set->cog,
                                .mask = set->mask,
                                .lerc_error = set->lerc_error,
                                .half_error = set->half ? set->quantum / 2 : 0,
                                .validity = set->common.voids && strcmp(set->common.voids, "keep") != 0,
                                .compression = (tl_compression)set->compression,
                                .mip = set->cog && !set->mip_given ? usual : (tl_mip)set->mip,
                                .frame = (tl_frame)set->frame,
                                .run = run};
    command_textures(&set->common, &options.textures);
    return tl_write_grid(made, set->common.output, &options, error);
}

/* Heights and layers into one file. */
static tl_status write_together(const settings *set, const tl_source *heights, const tl_source *surface,
                                const tl_run *run, tl_error *error)
{
    enum { MOST = 64 };
    const tl_layer_options options = {.rules = set->layer_rules,
                                      .overwrite = set->common.overwrite,
                                      .compression = (tl_compression)set->compression,
                                      .run = run};
    const char *kinds[MOST];
    char *list = strdup(set->layers), *rest;
    size_t count = 0;
    for (char *kind = list ? strtok_r(list, ",", &rest) : NULL; kind && count < MOST; kind = strtok_r(NULL, ",", &rest))
        kinds[count++] = kind;
    tl_status status = TL_ERROR_MEMORY;
    if (list)
        status = tl_write_layers(heights, surface, kinds, count, set->common.output, &options, error);
    else
        *error = (tl_error){TL_ERROR_MEMORY, "not enough memory for a name"};
    free(list);
    return status;
}

/* With the command line in the record, from which --same-as makes it again. */
static tl_status write_recorded(settings *set, const tl_source *heights, const tl_source *surface, const tl_run *run,
                                tl_error *error)
{
    const tl_parameter line = {"command", set->record};
    tl_source *made = tl_recorded_create(heights, &line, set->record ? 1 : 0, error);
    tl_status status = !made           ? TL_ERROR_MEMORY
                       : set->one_file ? write_together(set, made, surface, run, error)
                                       : write_samples(set, made, run, error);
    tl_source_destroy(made);
    return status;
}

static tl_status write_grid(settings *set, const tl_source *made, const tl_run *run, tl_error *error)
{
    tl_source *steps = set->quantum_given ? tl_quantized_create(made, set->quantum, error) : NULL;
    if (set->quantum_given && !steps)
        return TL_ERROR_MEMORY;
    tl_status status = write_recorded(set, steps ? steps : made, made, run, error);
    tl_source_destroy(steps);
    return status;
}

/* The table of weights loses below 0.1: see fbm/weights.h. */
static void warn_of_loss(const settings *set)
{
    double hurst = set->field.hurst_given ? set->field.hurst : set->noise.hurst;
    const char *scheme = set->field.scheme ? set->field.scheme : set->noise.scheme;
    if (hurst > 0 && hurst < .1 && (!scheme || !strcmp(scheme, "stationary")))
        command_say(
            &set->common,
            "warning: below a Hurst exponent of 0.1 the structure function is up to 9 %% off that of fractional "
            "Brownian motion");
}

/* "terrain.exr" and "normal" to "terrain.normal.exr"; free it. */
static char *layer_path(const settings *set, const char *kind)
{
    const char *output = set->common.output, *ending = layer_formats[set->layer_format];
    size_t stem = (size_t)(strrchr(output, '.') - output), room = stem + strlen(kind) + strlen(ending) + 3;
    char *path = malloc(room);
    if (path)
        snprintf(path, room, "%.*s.%s.%s", (int)stem, output, kind, ending);
    return path;
}

static tl_status write_layer(settings *set, const tl_source *made, const char *kind, const tl_run *run, tl_error *error)
{
    const tl_layer_options options = {.rules = set->layer_rules,
                                      .overwrite = set->common.overwrite,
                                      .compression = (tl_compression)set->compression,
                                      .run = run};
    char *path = layer_path(set, kind);
    if (!path) {
        *error = (tl_error){TL_ERROR_MEMORY, "not enough memory for a name"};
        return TL_ERROR_MEMORY;
    }
    tl_status status = tl_write_layer(made, kind, path, &options, error);
    if (status == TL_OK) {
        command_say(&set->common, "%s", path);
        written(set, path);
    } else
        free(path);
    return status;
}

/* Told before the work: a layer that cannot be, or whose file is there. */
static tl_status check_layers(const settings *set, const tl_source *made, tl_error *error)
{
    const tl_layer_options options = {.rules = set->layer_rules};
    char *list = set->layers ? strdup(set->layers) : NULL, *rest;
    tl_status status = TL_OK;
    for (char *kind = list ? strtok_r(list, ",", &rest) : NULL; kind && status == TL_OK;
         kind = strtok_r(NULL, ",", &rest)) {
        char *path = layer_path(set, kind);
        tl_source *layer = tl_layer_create(made, kind, 0, &options, error);
        status = layer ? TL_OK : error->status;
        if (layer && path && !set->one_file && !set->common.overwrite && access(path, F_OK) == 0) {
            *error = (tl_error){.status = TL_ERROR_IO};
            snprintf(error->text, sizeof error->text, "%.300s: exists already; name another file or give --overwrite",
                     path);
            status = TL_ERROR_IO;
        }
        tl_source_destroy(layer);
        free(path);
    }
    free(list);
    return status;
}

static tl_status write_layers(settings *set, const tl_source *made, const tl_run *run, progress *bar, tl_error *error)
{
    char *list = set->layers && !set->one_file ? strdup(set->layers) : NULL, *rest;
    tl_status status = TL_OK;
    if (set->layers && !set->one_file && !list) {
        *error = (tl_error){TL_ERROR_MEMORY, "not enough memory for the layers' names"};
        return TL_ERROR_MEMORY;
    }
    for (char *kind = list ? strtok_r(list, ",", &rest) : NULL; kind && status == TL_OK;
         kind = strtok_r(NULL, ",", &rest)) {
        progress_stage(bar, kind);
        status = write_layer(set, made, kind, run, error);
        progress_end(bar);
    }
    free(list);
    return status;
}

static int write_out(settings *set, const tl_source *made, const tl_run *run, progress *bar)
{
    tl_error error;
    progress_stage(bar, "synthesis");
    note_output(set); /* while there is memory for it */
    if (check_layers(set, made, &error) != TL_OK || write_grid(set, made, run, &error) != TL_OK)
        return command_failed(bar, &error);
    report(set, made, progress_end(bar));
    if (write_layers(set, made, run, bar, &error) != TL_OK) {
        for (size_t k = 0; k < set->file_count; k++) /* a failed run leaves nothing */
            unlink(set->files[k]);
        return command_failed(bar, &error);
    }
    warn_of_loss(set);
    return EXIT_DONE;
}

/* Whether the output's format holds what is asked for. */
static bool layers_ok(const settings *set)
{
    char *list = set->layers ? strdup(set->layers) : NULL, *rest;
    bool good = !(set->layers && set->preset);
    if (!good)
        complain("--layers and --preset exclude each other");
    for (char *name = list ? strtok_r(list, ",", &rest) : NULL; name && good; name = strtok_r(NULL, ",", &rest)) {
        const tl_layer_kind *kind = tl_layers();
        while (kind->name && strcmp(kind->name, name) != 0)
            kind++;
        good = kind->name;
        if (!good) {
            size_t count = 0;
            while (tl_layers()[count].name)
                count++;
            complain_of_choice("layers", name, &tl_layers()->name, count, sizeof *kind);
        }
    }
    free(list);
    return good;
}

static bool grid_output_ok(const settings *set)
{
    if (!layers_ok(set))
        return false;
    unsigned textures;
    if (!command_textures(&set->common, &textures) || !command_split_ok(&set->common))
        return false;
    if (set->preset && (set->mip || set->compression || set->cog || set->mask)) {
        complain("--preset decides how files are written; leave --mip, --compression, --cog and --mask away");
        return false;
    }
    if (set->tile && !set->preset) {
        complain("--tile is for --preset; give that too, or leave it away");
        return false;
    }
    const tl_format *format = tl_format_of(set->common.output);
    bool exr = format && strcmp(format->ending, "exr") == 0, tif = format && strncmp(format->ending, "tif", 3) == 0;
    if (set->mip && !exr && !tif)
        complain("--mip: only .exr and .tif hold coarser levels, not %s; leave it out", set->common.output);
    else if (set->mask && !tif)
        complain("--mask is for .tif, not %s; leave it out", set->common.output);
    else if (set->cog && !tif)
        complain("--cog: is an order of .tif, not of %s; leave it out", set->common.output);
    else if (set->half && (!exr || !set->quantum_given || set->preset))
        complain("--half is for .exr, with --height-quantum Q: heights move by less than that");
    else if (set->one_file && (!exr || !set->layers || set->layer_format != LAYERS_AS_EXR || set->mip || set->half))
        complain("--one-file puts --layers into the .exr of the heights; without --layer-format png, --mip and --half");
    else if (set->one_file && set->common.voids && strcmp(set->common.voids, "keep") != 0)
        complain("--one-file holds no validity, which --voids %s writes beside the heights; leave one of them away",
                 set->common.voids);
    else if (set->lerc_error_given && set->compression != TL_COMPRESSION_LERC)
        complain("--lerc-error is for --compression lerc; give that too, or leave it away");
    else
        return true;
    return false;
}

/* ---- synth ---- */

/* What is refined: the DEM, or what its framework, made here or read, keeps of it. */
typedef struct ground {
    opened_input opened;
    tl_framework *framework;
    tl_source *restored;
    const tl_source *dem; /* NULL: out of a framework's file */
} ground;

static void close_ground(ground *of)
{
    tl_source_destroy(of->restored);
    tl_framework_destroy(of->framework);
    if (of->opened.source)
        command_close(&of->opened);
}

/* The source to refine; NULL on failure. */
static const tl_source *open_ground(const settings *set, const arguments *inputs, const tl_run *run, ground *of,
                                    tl_error *error)
{
    bool file = inputs->count == 1 && tl_framework_is_file(inputs->names[0]);
    *of = (ground){.dem = NULL};
    const common *c = &set->common;
    bool cut = c->window_given || c->box_given, kept = !c->voids || strcmp(c->voids, "keep") == 0;
    if (file && (set->max_error_given || cut || c->geoid || c->nodata_given || c->band || !kept)) {
        *error = (tl_error){.status = TL_ERROR_ARGUMENT};
        snprintf(
            error->text, sizeof error->text,
            "%.300s: is a framework, which is taken whole with its own bound; leave --max-error, --window, --bbox, "
            "--geoid, --band, --nodata and --voids away",
            inputs->names[0]);
        return NULL;
    }
    if (file)
        of->framework = tl_framework_load(inputs->names[0], run, error);
    else {
        of->opened = command_open(&set->common, inputs, run, error);
        of->dem = of->opened.source;
        if (!of->dem || !set->max_error_given)
            return of->dem;
        double moved = (set->quantum_given ? set->quantum / (set->half ? 1 : 2) : 0) + set->lerc_error;
        double bound = set->max_error - moved;
        if (bound < 0) {
            *error = (tl_error){.status = TL_ERROR_ARGUMENT};
            snprintf(error->text, sizeof error->text,
                     "%s alone %s heights by more than --max-error %g; take a smaller one",
                     !set->lerc_error      ? "--height-quantum"
                     : !set->quantum_given ? "--lerc-error"
                                           : "--height-quantum and --lerc-error",
                     set->lerc_error && set->quantum_given ? "move" : "moves", set->max_error);
            return NULL;
        }
        tl_framework_options options = {.max_error = bound, .frame = TL_FRAME_PIXEL, .run = run};
        of->framework = tl_framework_build(of->dem, &options, error);
    }
    if (!of->framework)
        return NULL;
    tl_restore_options options = {.hurst_given = set->field.hurst_given,
                                  .delta_given = set->field.delta_given,
                                  .hurst = set->field.hurst,
                                  .delta = set->field.delta,
                                  .seed = set->field.seed,
                                  .run = run};
    of->restored = tl_framework_restore(of->framework, of->dem, &options, error);
    return of->restored;
}

static void report_framework(const settings *set, const ground *of)
{
    if (of->framework)
        command_say(&set->common, "framework: %zu points (%.3g %% of the samples), error <= %g",
                    tl_framework_point_count(of->framework),
                    100 * (double)tl_framework_point_count(of->framework) /
                        ((double)of->restored->info.width * (double)of->restored->info.height),
                    tl_framework_max_error(of->framework));
}

/* The largest difference between the DEM and every `step`-th sample of `level` of a source; infinite where one of them
 * is void and the other is not. */
static tl_status compare(const tl_source *dem, const tl_source *made, int level, int64_t step, bool rounded,
                         double *worst, tl_error *error)
{
    int64_t width = (dem->info.width - 1) * step + 1;
    float *rows = calloc((size_t)(dem->info.width + width), sizeof *rows), *other = rows + dem->info.width;
    tl_status status = TL_OK;
    *worst = 0;
    for (int64_t y = 0; rows && status == TL_OK && y < dem->info.height; y++) {
        status = tl_source_read(dem, dem->info.level, (tl_window){0, y, dem->info.width, 1}, rows, error);
        if (status == TL_OK)
            status = tl_source_read(made, level, (tl_window){0, y * step, width, 1}, other, error);
        for (int64_t x = 0; status == TL_OK && x < dem->info.width; x++) {
            double off = fabs((double)rows[x] - (double)other[x * step]);
            if (rounded) /* a multiple of the quantum, as the nearest float */
                off = fmax(off - fabs((double)other[x * step]) * 0x1p-24, 0);
            if (isnan(off))
                off = isnan(rows[x]) && isnan(other[x * step]) ? 0 : HUGE_VAL;
            *worst = off > *worst ? off : *worst;
        }
    }
    free(rows);
    if (rows)
        return status;
    *error = (tl_error){TL_ERROR_MEMORY, "not enough memory to verify"};
    return TL_ERROR_MEMORY;
}

/* Measures what was made against the DEM: its level 0, and, where samples are points, those in the file. */
static int verify(const settings *set, const ground *of, const tl_source *field, progress *bar)
{
    tl_error error;
    double inside = 0, outside = 0;
    progress_stage(bar, "verifying");
    const char *output = set->common.output;
    bool grid =
        command_ends_with(output, ".exr") || command_ends_with(output, ".tif") || command_ends_with(output, ".tiff");
    bool points = field->info.type == TL_RASTER_POINT || set->levels == 0;
    tl_source *file = grid && points ? tl_open(set->common.output, &error) : NULL;
    tl_status status = grid && points && !file ? TL_ERROR_IO : compare(of->dem, field, 0, 1, false, &inside, &error);
    if (status == TL_OK && file)
        status =
            compare(of->dem, file, file->info.level, INT64_C(1) << set->levels, set->quantum_given, &outside, &error);
    tl_source_destroy(file);
    if (status != TL_OK) {
        unlink(set->common.output); /* a failed run leaves nothing */
        return command_failed(bar, &error);
    }
    progress_end(bar);
    double worst = fmax(inside, outside);
    if (!(worst <= set->max_error)) {
        complain("%s: %.9g from the DEM, more than %.9g; that is a fault of talus, please report it",
                 set->common.output, worst, set->max_error);
        unlink(set->common.output);
        return EXIT_FAILED;
    }
    command_say(&set->common, "verified: largest error %.7g%s", worst, file ? ", in the file" : ", before refinement");
    return EXIT_DONE;
}

/* Opens "RASTER" or "RASTER:BAND". */
static tl_source *open_map(const char *text, const tl_run *run, tl_error *error)
{
    const char *colon = strrchr(text, ':');
    size_t length = strlen(text), digits = colon ? strspn(colon + 1, "0123456789") : 0;
    bool band = digits > 0 && digits < 6 && colon[1 + digits] == 0;
    char *path = malloc(length + 1);
    if (!path) {
        *error = (tl_error){TL_ERROR_MEMORY, "not enough memory for a name"};
        return NULL;
    }
    memcpy(path, text, length + 1);
    tl_dem_options options = {.run = run};
    if (band) {
        path[colon - text] = 0;
        options.band = (unsigned)strtoul(colon + 1, NULL, 10);
    }
    tl_source *map = tl_open_with(path, &options, error);
    free(path);
    return map;
}

/* The field over a model, with the maps that are asked for; NULL on failure. */
static tl_source *make_field(settings *set, const tl_source *dem, tl_source *maps[2], tl_error *error)
{
    const char *const names[2] = {set->hurst_map, set->sigma_map ? set->sigma_map : set->delta_map};
    for (int k = 0; k < 2; k++)
        if (names[k]) {
            maps[k] = open_map(names[k], set->field.run, error);
            if (!maps[k])
                return NULL;
        }
    set->field.hurst_map = maps[0];
    set->field.delta_map = maps[1];
    set->field.delta_map_is_sigma = set->sigma_map != NULL;
    return tl_field_create(dem, &set->field, error);
}

static int synth(settings *set, const arguments *inputs)
{
    progress bar;
    tl_error error;
    tl_run run = command_run(&set->common, &bar);
    ground of;
    const tl_source *dem = open_ground(set, inputs, &run, &of, &error);
    if (!dem) {
        close_ground(&of);
        return command_failed(&bar, &error);
    }
    report_framework(set, &of);
    progress_stage(&bar, "measuring");
    set->field.run = &run;
    tl_source *maps[2] = {NULL, NULL}, *field = make_field(set, dem, maps, &error);
    int status = field ? write_out(set, field, &run, &bar) : command_failed(&bar, &error);
    if (status == EXIT_DONE && set->verify)
        status = verify(set, &of, field, &bar);
    tl_source_destroy(field);
    tl_source_destroy(maps[0]);
    tl_source_destroy(maps[1]);
    close_ground(&of);
    return status;
}

/* Schemes that a command has. */
static size_t schemes_of(bool noise, tl_scheme out[16])
{
    size_t count = 0;
    for (const tl_scheme *s = tl_schemes(); s->name && count < 16; s++)
        if (noise ? s->noise : s->field)
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

/* What synth and noise write, and how. */
#define GRID_OUTPUT(s)                                                                                                \
    COMMON_OUTPUT((s).common), TEXTURE_OPTIONS((s).common), SPLIT_OPTION((s).common),                                 \
        {"compression",                                                                                               \
         0,                                                                                                           \
         OPTION_CHOICE,                                                                                               \
         &(s).compression,                                                                                            \
         NULL,                                                                                                        \
         "KIND",                                                                                                      \
         "of .exr: none, zip, zips or piz; of .tif: none, deflate, zstd, lzw or lerc (default: zip, deflate)",        \
         0,                                                                                                           \
         0,                                                                                                           \
         compressions},                                                                                               \
        {"mask", 0, OPTION_FLAG, &(s).mask, NULL, NULL, "in a .tif, tell voids by masks too, beside NaN as nodata",   \
         0,      0, NULL},                                                                                            \
        {"half",                                                                                                      \
         0,                                                                                                           \
         OPTION_FLAG,                                                                                                 \
         &(s).half,                                                                                                   \
         NULL,                                                                                                        \
         NULL,                                                                                                        \
         "an .exr of half floats, refused where a height would move by more than --height-quantum",                   \
         0,                                                                                                           \
         0,                                                                                                           \
         NULL},                                                                                                       \
        {"lerc-error",                                                                                                \
         0,                                                                                                           \
         OPTION_NUMBER,                                                                                               \
         &(s).lerc_error,                                                                                             \
         &(s).lerc_error_given,                                                                                       \
         "E",                                                                                                         \
         "by how much --compression lerc may move a height, in the DEM's unit, 1e-30...1e30 (default: not at all)",   \
         1e-30,                                                                                                       \
         1e30,                                                                                                        \
         NULL},                                                                                                       \
        {"cog", 0, OPTION_FLAG, &(s).cog, NULL, NULL, "a .tif in the order of cloud-optimised ones, with overviews",  \
         0,     0, NULL},                                                                                             \
        {"height-quantum",                                                                                            \
         0,                                                                                                           \
         OPTION_NUMBER,                                                                                               \
         &(s).quantum,                                                                                                \
         &(s).quantum_given,                                                                                          \
         "Q",                                                                                                         \
         "round heights to multiples of Q, in the DEM's unit, 1e-30...1e30: smaller files (default: as they are)",    \
         1e-30,                                                                                                       \
         1e30,                                                                                                        \
         NULL},                                                                                                       \
        {"preset",                                                                                                    \
         0,                                                                                                           \
         OPTION_TEXT,                                                                                                 \
         &(s).preset,                                                                                                 \
         NULL,                                                                                                        \
         "PROGRAM",                                                                                                   \
         "write for unreal, unity, godot, blender or houdini: sizes, names and order of rows, and what to type into " \
         "its importer",                                                                                              \
         0,                                                                                                           \
         0,                                                                                                           \
         NULL},                                                                                                       \
        {"tile",                                                                                                      \
         0,                                                                                                           \
         OPTION_INTEGER,                                                                                              \
         &(s).tile,                                                                                                   \
         NULL,                                                                                                        \
         "N",                                                                                                         \
         "samples on a side of the tiles of a preset (default: chosen)",                                              \
         1,                                                                                                           \
         65536,                                                                                                       \
         NULL},                                                                                                       \
        {"same-as",                                                                                                   \
         0,                                                                                                           \
         OPTION_TEXT,                                                                                                 \
         &(s).same_as,                                                                                                \
         NULL,                                                                                                        \
         "FILE",                                                                                                      \
         "make this output again: the options that are recorded in it, with those given here over them",              \
         0,                                                                                                           \
         0,                                                                                                           \
         NULL},                                                                                                       \
    {                                                                                                                 \
        "mip", 0, OPTION_CHOICE, &(s).mip, &(s).mip_given, "KIND",                                                    \
            "coarser levels in an .exr or .tif, of every second sample or of means (default: none; with --cog: "      \
            "lattice for points, box for areas)",                                                                     \
            0, 0, mips                                                                                                \
    }

static bool synth_ok(const settings *set)
{
    bool good = (!set->field.scheme || names_scheme(set->field.scheme, false)) &&
                command_output_ok(&set->common, true, true) && grid_output_ok(set);
    if (good && set->delta_map && set->sigma_map) {
        complain("--delta-map and --sigma-map say the same; give one of them");
        good = false;
    }
    if (good && set->verify && !set->max_error_given) {
        complain("--verify measures against --max-error E; give that too");
        good = false;
    }
    return good;
}

/* The options of --same-as's file, where it is given, with the command line's over them. */
static bool take_record(const command *self, int argc, const char **argv, const option_group *groups, settings *set,
                        arguments *rest)
{
    bool good = !set->same_as || (same_as_parse(self, set->same_as, argc, argv, groups, rest) &&
                                  !same_as_is_output(set->same_as, &set->common));
    set->record = rest->record;
    return good;
}

static int run_synth(const command *self, int argc, const char **argv, command_help help)
{
    settings set = {.levels = 4};
    const option detail[] = {
        {"levels", 'l', OPTION_INTEGER, &set.levels, NULL, "N",
         "halvings of the DEM's spacing, 0...30 (default: 4, 16 times finer)", 0, 30, NULL},
        FRACTAL_OPTIONS(set.seed, set.field),
        {"hurst-map", 0, OPTION_TEXT, &set.hurst_map, NULL, "RASTER[:BAND]",
         "--hurst from place to place, as the first band of stats --maps", 0, 0, NULL},
        {"delta-map", 0, OPTION_TEXT, &set.delta_map, NULL, "RASTER[:BAND]", "--delta from place to place", 0, 0, NULL},
        {"sigma-map", 0, OPTION_TEXT, &set.sigma_map, NULL, "RASTER[:BAND]",
         "--delta from place to place, told by sigma of the finest octave, as the second band of stats --maps", 0, 0,
         NULL},
        {"max-error", 'e', OPTION_NUMBER, &set.max_error, &set.max_error_given, "E",
         "reduce the DEM to its framework first; what that drops is made again, within E of every sample, 0...1e30", 0,
         1e30, NULL},
        {"verify", 0, OPTION_FLAG, &set.verify, NULL, NULL, "with --max-error: measure the result against the DEM", 0,
         0, NULL},
        {"support", 0, OPTION_CHOICE, &set.support, NULL, "KIND",
         "what samples stand for: as the raster says, means over cells, or points (default: raster)", 0, 0, supports},
        {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option output[] = {GRID_OUTPUT(set),
                             {"layers", 0, OPTION_TEXT, &set.layers, NULL, "KINDS",
                              "write these beside the heights, with commas between: normal, tangent, slope, curvature, "
                              "splat, colour, albedo, sigma, hurst, mask",
                              0, 0, NULL},
                             {"layer-format", 0, OPTION_CHOICE, &set.layer_format, NULL, "FORMAT",
                              "of the layers (default: exr)", 0, 0, layer_formats},
                             {"one-file", 0, OPTION_FLAG, &set.one_file, NULL, NULL,
                              "put the layers into the .exr of the heights, as channels KIND.R ...", 0, 0, NULL},
                             {"layer-rules", 0, OPTION_TEXT, &set.layer_rules, NULL, "FILE",
                              "a JSON file that says where splat has rock, scree, soil and snow", 0, 0, NULL},
                             {"frame", 0, OPTION_CHOICE, &set.frame, NULL, "FRAME",
                              "coordinates of a mesh (default: enu where the CRS is known)", 0, 0, frame_names},
                             {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"Detail", detail}, {"Input", input}, {"Output", output}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, ANY_INPUTS, &rest, &status)) {
        if (help == HELP_TEXT || (!help && status == EXIT_DONE))
            list_schemes(false);
        return status;
    }
    if (!take_record(self, argc, argv, groups, &set, &rest) || (!rest.count && !command_misses_input(self))) {
        arguments_free(&rest);
        return EXIT_USAGE;
    }
    set.field.levels = (int)set.levels;
    set.field.seed = (uint64_t)set.seed;
    set.field.support = (tl_support)set.support;
    status = synth_ok(&set) ? synth(&set, &rest) : EXIT_USAGE;
    status = compare_same(&set, &rest, status);
    arguments_free(&rest);
    return status;
}

const command command_synth = {"synth", "add fractal detail below the samples of an elevation model",
                               "DEM... [--levels N] -o OUTPUT",
                               INPUT_NOTES "\n\nFormats: .exr, .tif, .png, .r16 (16 bit) and .raw (floats), these with "
                                           "a .json beside them, .glb, .obj, .ply, .stl.\n\n"
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

static int run_noise(const command *self, int argc, const char **argv, command_help help)
{
    settings set = {.noise = {.size = 1024, .hurst = 0.8, .delta = 1}};
    const option surface[] = {
        {"size", 'n', OPTION_INTEGER, &set.noise.size, NULL, "N", "samples on a side, 1...2^24 (default: 1024)", 1,
         16777216, NULL},
        {"hurst", 0, OPTION_NUMBER, &set.noise.hurst, NULL, "H", "Hurst exponent, 0.01...0.99 (default: 0.8)", 0.01,
         0.99, NULL},
        {"delta", 0, OPTION_NUMBER, &set.noise.delta, NULL, "D",
         "standard deviation of the height difference over one sample, 0...1e30 (default: 1)", 0, 1e30, NULL},
        {"seed", 's', OPTION_INTEGER, &set.seed, NULL, "N", "another seed, another surface, 0...2^62 (default: 0)", 0,
         0x1p62, NULL},
        {"scheme", 0, OPTION_TEXT, &set.noise.scheme, NULL, "NAME", "way to refine, listed below (default: the first)",
         0, 0, NULL},
        {"aspect", 0, OPTION_NUMBER, &set.noise.aspect, NULL, "R",
         "width of a cell over its height, 0.2...5; delta is then over the height (default: 1)", 0.2, 5, NULL},
        {0}};
    const option output[] = {GRID_OUTPUT(set), {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"Surface", surface}, {"Output", output}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, 0, &rest, &status)) {
        if (help == HELP_TEXT || (!help && status == EXIT_DONE))
            list_schemes(true);
        return status;
    }
    if (!take_record(self, argc, argv, groups, &set, &rest)) {
        arguments_free(&rest);
        return EXIT_USAGE;
    }
    set.noise.seed = (uint64_t)set.seed;
    bool good = (!set.noise.scheme || names_scheme(set.noise.scheme, true)) &&
                command_output_ok(&set.common, true, true) && grid_output_ok(&set);
    status = good ? noise(&set) : EXIT_USAGE;
    status = compare_same(&set, &rest, status);
    arguments_free(&rest);
    return status;
}

const command command_noise = {"noise", "make a fractional Brownian surface",
                               "[--size N] [--hurst H] [--delta D] -o OUTPUT",
                               "Formats: .exr, .tif, .png, .r16 (16 bit) and .raw (floats), these with a .json beside "
                               "them, .glb, .obj, .ply, .stl.\n\n"
                               "Example: talus noise --size 2048 --hurst 0.7 -o noise.exr",
                               run_noise};
