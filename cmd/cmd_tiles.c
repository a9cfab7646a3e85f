#include "cmd/command.h"
#include "cmd/height_tiles.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static const char *const formats[] = {[TL_TILES_QUANTIZED_MESH] = "quantized-mesh",
                                      [TL_TILES_3D] = "3dtiles",
                                      /* of heights */ "exr",
                                      "tif",
                                      "png",
                                      "r16",
                                      "raw",
                                      NULL};

enum { CODING_QUANTIZED, CODING_COMPRESSED };
static const char *const codings[] = {[CODING_QUANTIZED] = "quantized", [CODING_COMPRESSED] = "compressed", NULL};

typedef struct settings {
    common common;
    int format, coding;
    double max_error;
    int64_t extra, seed;
    const char *levels, *shard, *attribution, *layers, *mbtiles;
    bool no_normals, resume, finish, dry_run;
    double outside;
    tl_field_options field;
    height_tiles heights;
} settings;

static bool are_heights(const settings *set)
{
    return set->format > TL_TILES_3D;
}

/* "A..B"; false, told. */
static bool read_levels(const char *text, tl_tiles_options *out)
{
    char rest;
    if (!text)
        return true;
    if (sscanf(text, "%d..%d%c", &out->first_level, &out->last_level, &rest) != 2 || out->first_level < 0 ||
        out->last_level < out->first_level || out->last_level >= TL_TILE_LEVELS) {
        complain("--levels: A..B is wanted, 0...%d and not falling, not '%s'", TL_TILE_LEVELS - 1, text);
        return false;
    }
    out->last_level_given = true;
    return true;
}

/* What runs many tasks tells each of them its number and how many there are. */
static bool shard_of_environment(long *index, long *count)
{
    static const struct {
        const char *index, *count, *first;
    } variables[] = {{"SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT", "SLURM_ARRAY_TASK_MIN"},
                     {"OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE", NULL},
                     {"PMI_RANK", "PMI_SIZE", NULL},
                     {"JOB_COMPLETION_INDEX", "JOB_COMPLETIONS", NULL},
                     {"SLURM_PROCID", "SLURM_NTASKS", NULL}};
    for (size_t k = 0; k < sizeof variables / sizeof *variables; k++) {
        const char *i = getenv(variables[k].index), *n = getenv(variables[k].count);
        const char *first = variables[k].first ? getenv(variables[k].first) : NULL;
        if (!i || !n)
            continue;
        *index = strtol(i, NULL, 10) - (first ? strtol(first, NULL, 10) : 0);
        *count = strtol(n, NULL, 10);
        return true;
    }
    return false;
}

/* "I/N", counted from 0, or "auto"; false, told. */
static bool read_shard(const char *text, tl_tiles_options *out)
{
    long index, count;
    char rest;
    if (!text)
        return true;
    if (strcmp(text, "auto") == 0) {
        if (!shard_of_environment(&index, &count)) {
            complain("--shard auto: none of SLURM_ARRAY_TASK_ID, SLURM_PROCID, OMPI_COMM_WORLD_RANK, PMI_RANK and "
                     "JOB_COMPLETION_INDEX is set with its count; give I/N");
            return false;
        }
    } else if (sscanf(text, "%ld/%ld%c", &index, &count, &rest) != 2)
        index = count = -1;
    if (count < 1 || count > 1000000 || index < 0 || index >= count) {
        complain("--shard: I/N is wanted, with I from 0 to N - 1, or auto, not '%s'", text);
        return false;
    }
    out->shard = (unsigned)index;
    out->shards = (unsigned)count;
    return true;
}

static void report(const settings *set, const tl_tiles_report *r, double seconds)
{
    const char *folder = set->common.output;
    uint64_t tiles = 0, bytes = 0;
    for (int k = r->first_level; k <= r->last_level; k++) {
        tiles += r->levels[k].tiles;
        bytes += r->levels[k].bytes;
    }
    if (set->dry_run) {
        command_say(&set->common, "%s: at most %llu tiles of levels %d ... %d from %llu blocks; cells of %.3g %s",
                    folder, (unsigned long long)tiles, r->first_level, r->last_level, (unsigned long long)r->blocks,
                    r->spacing, set->format == TL_TILES_3D ? "m" : "degrees");
        height_tiles_say_forecast(&set->common, &r->forecast, bytes);
        return;
    }
    if (r->complete && !tiles) {
        command_say(&set->common, "%s: is complete already", folder);
        return;
    }
    for (int k = r->first_level; k <= r->last_level; k++)
        if (r->levels[k].tiles)
            command_say(&set->common, "level %-3d %8llu tiles %10llu triangles %11llu bytes, error <= %.4g m", k,
                        (unsigned long long)r->levels[k].tiles, (unsigned long long)r->levels[k].triangles,
                        (unsigned long long)r->levels[k].bytes, r->levels[k].error + r->resampling);
    if (set->format == TL_TILES_QUANTIZED_MESH)
        command_say(&set->common,
                    "of each error, %.4g m are between the DEM's samples and the deepest lattice's surface",
                    r->resampling);
    command_say(&set->common, "%s: %llu tiles, %llu bytes, %.2f s%s", folder, (unsigned long long)tiles,
                (unsigned long long)bytes, seconds, r->complete ? "" : "; not complete until --finish");
}

/* The DEM, or what is made below its samples. */
static const tl_source *refine(const settings *set, const tl_source *dem, const tl_run *run, tl_source **field,
                               tl_error *error)
{
    tl_field_options options = set->field;
    options.levels = (int)set->extra;
    options.seed = (uint64_t)set->seed;
    options.run = run;
    *field = set->extra ? tl_field_create(dem, &options, error) : NULL;
    return set->extra ? *field : dem;
}

static int make_tiles(const settings *set, const arguments *inputs, const tl_tiles_options *wanted)
{
    tl_tiles_options options = *wanted;
    if (set->mbtiles && access(set->mbtiles, F_OK) == 0) { /* told before the work */
        complain("%s: exists already; name another file or remove it", set->mbtiles);
        return EXIT_FAILED;
    }
    progress bar;
    tl_error error;
    tl_tiles_report made;
    tl_source *field = NULL;
    tl_run run = command_run(&set->common, &bar);
    opened_input opened = command_open(&set->common, inputs, &run, &error);
    if (!opened.source)
        return command_failed(&bar, &error);
    progress_stage(&bar, "measuring");
    const tl_source *source = refine(set, opened.source, &run, &field, &error);
    options.run = &run;
    int status = EXIT_DONE;
    if (source)
        progress_stage(&bar, "tiles");
    if (source && are_heights(set)) {
        if (height_tiles_make(&set->heights, &set->common, formats[set->format], source, &run, &error) == TL_OK)
            progress_end(&bar);
        else
            status = command_failed(&bar, &error);
    } else if (!source || tl_write_terrain_tiles(source, set->common.output, &options, &made, &error) != TL_OK)
        status = command_failed(&bar, &error);
    else {
        report(set, &made, progress_end(&bar));
        if (set->mbtiles && made.complete && tl_pack_mbtiles(set->common.output, set->mbtiles, false, &error) != TL_OK)
            status = command_failed(&bar, &error);
        else if (set->mbtiles && made.complete)
            command_say(&set->common, "%s: all tiles, in one file", set->mbtiles);
    }
    tl_source_destroy(field);
    command_close(&opened);
    return status;
}

static bool output_ok(const settings *set)
{
    if (set->common.output && *set->common.output)
        return true;
    complain("no folder named; give -o FOLDER");
    return false;
}

/* What is for meshes only. */
static bool heights_ok(const settings *set)
{
    const char *other = set->max_error > 0  ? "error"
                        : set->outside != 0 ? "outside"
                        : set->no_normals   ? "no-normals"
                        : set->attribution  ? "attribution"
                                            : NULL;
    if (are_heights(set) && other)
        complain("--%s is for --format quantized-mesh and 3dtiles", other);
    return !are_heights(set) || !other;
}

static bool format_ok(const settings *set)
{
    if (set->mbtiles && (set->format != TL_TILES_QUANTIZED_MESH || set->dry_run)) {
        complain("--mbtiles is for --format quantized-mesh%s", set->dry_run ? ", and not for --dry-run" : "");
        return false;
    }
    if (set->format == TL_TILES_3D || (set->coding == CODING_QUANTIZED && !set->layers))
        return true;
    complain("%s is for --format 3dtiles", set->layers ? "--layers" : "--coding");
    return false;
}

static int run_tiles(const command *self, int argc, const char **argv, command_help help)
{
    settings set = {0};
    const option tiles[] = {
        {"output", 'o', OPTION_TEXT, &set.common.output, NULL, "FOLDER", "where the tiles go: a new or empty folder", 0,
         0, NULL},
        {"format", 'f', OPTION_CHOICE, &set.format, NULL, "KIND", "of the tiles (default: quantized-mesh)", 0, 0,
         formats},
        {"error", 'e', OPTION_NUMBER, &set.max_error, NULL, "METRES",
         "largest error of the deepest level, 0.001...1e6, against the lattice that the DEM is resampled to; twice as "
         "much "
         "a level above (default: a quarter of what globes take the level for)",
         0.001, 1e6, NULL},
        {"levels", 'l', OPTION_TEXT, &set.levels, NULL, "A..B",
         "of tiles (default: from 0 to the first whose cells are, at the equator, no larger than the DEM's in metres)",
         0, 0, NULL},
        {"coding", 0, OPTION_CHOICE, &set.coding, NULL, "CODING",
         "of 3dtiles: quantized (default), or compressed by EXT_meshopt_compression, for readers that know it", 0, 0,
         codings},
        {"layers", 0, OPTION_TEXT, &set.layers, NULL, "KINDS",
         "of 3dtiles: pictures on the tiles, colour (by height, without light), normal or both, with a comma", 0, 0,
         NULL},
        {"mbtiles", 0, OPTION_TEXT, &set.mbtiles, NULL, "FILE",
         "of quantized-mesh: put the finished tiles into this file, too", 0, 0, NULL},
        {"no-normals", 0, OPTION_FLAG, &set.no_normals, NULL, NULL, "leave the vertices' normals away", 0, 0, NULL},
        {"outside", 0, OPTION_NUMBER, &set.outside, NULL, "METRES",
         "height of ground that the DEM does not know, of quantized-mesh (default: 0)", -1e5, 1e5, NULL},
        {"attribution", 0, OPTION_TEXT, &set.attribution, NULL, "TEXT", "to be shown with the terrain", 0, 0, NULL},
        {"dry-run", 'n', OPTION_FLAG, &set.dry_run, NULL, NULL,
         "only tell how many tiles there will be, how large and in what time", 0, 0, NULL},
        {0}};
    const option heights[] = {HEIGHT_TILE_OPTIONS(set.heights), {0}};
    const option detail[] = {{"extra-levels", 'x', OPTION_INTEGER, &set.extra, NULL, "N",
                              "levels finer than the DEM, with fractal detail, 0...10 (default: 0)", 0, 10, NULL},
                             FRACTAL_OPTIONS(set.seed, set.field),
                             {0}};
    const option parts[] = {
        {"resume", 0, OPTION_FLAG, &set.resume, NULL, NULL, "go on with a folder where an earlier run was interrupted",
         0, 0, NULL},
        {"shard", 0, OPTION_TEXT, &set.shard, NULL, "I/N",
         "make one of N parts, counted from 0, with the others beside it; auto: as Slurm, Open MPI or Kubernetes say",
         0, 0, NULL},
        {"finish", 0, OPTION_FLAG, &set.finish, NULL, NULL, "after all shards: make the levels above and the index", 0,
         0, NULL},
        {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"Tiles", tiles},
                                   {"Of heights", heights},
                                   {"Detail", detail},
                                   {"In parts", parts},
                                   {"Input", input},
                                   {"Running", running},
                                   {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status))
        return status;
    tl_tiles_options options = {.format = (tl_tiles_format)set.format,
                                .coding = set.coding == CODING_COMPRESSED ? TL_CODING_COMPRESSED : TL_CODING_QUANTIZED,
                                .max_error = set.max_error,
                                .no_normals = set.no_normals,
                                .outside = set.outside,
                                .attribution = set.attribution,
                                .resume = set.resume,
                                .finish = set.finish,
                                .dry_run = set.dry_run};
    bool good = output_ok(&set) && format_ok(&set) && read_levels(set.levels, &options) &&
                read_shard(set.shard, &options) && heights_ok(&set) &&
                height_tiles_ok(&set.heights, formats[set.format], &options) &&
                (!set.layers || command_texture_names("layers", set.layers, &options.textures));
    status = good ? make_tiles(&set, &rest, &options) : EXIT_USAGE;
    arguments_free(&rest);
    return status;
}

const command command_tiles = {
    "tiles", "cut an elevation model into tiles for web globes", "DEM... -o FOLDER [--error METRES]",
    INPUT_NOTES "\n\nHeights are taken as above the ellipsoid; --geoid egm96 makes those above the sea so.\n\n"
                "Example: talus tiles dem.tif --geoid egm96 --error 1 -o site",
    run_tiles};
