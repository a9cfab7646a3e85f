#include "cmd/command.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

typedef struct settings {
    common common;
    double max_error; /* asked for; or what a budget comes to */
    bool max_error_given, verify;
    int frame, mesh, borders, diagonal, coding;
    double skirt, base;
    int64_t triangles, vertices; /* budgets; 0: none */
    const char *keep;
    double share; /* of the samples, by --keep; 0: none */
    const char *error_cache;
    const char *error_map;
    opened_input map;
    double bound_of_voids; /* of the map: what was asked for, or -1 */
    bool points;
    int features; /* index into feature_names */
} settings;

static const char *const mesh_names[] = {[TL_MESH_QUADTREE] = "quadtree", [TL_MESH_TIN] = "tin", NULL};

enum { BORDERS_FREE, BORDERS_CANONICAL };
static const char *const border_names[] = {[BORDERS_FREE] = "free", [BORDERS_CANONICAL] = "canonical", NULL};

enum { DIAGONAL_LONGEST_EDGE, DIAGONAL_LOWER };
static const char *const diagonal_names[] = {
    [DIAGONAL_LONGEST_EDGE] = "longest-edge", [DIAGONAL_LOWER] = "lower", NULL};

enum { FEATURES_NONE, FEATURES_POINTS, FEATURES_LINES };
static const char *const feature_names[] = {
    [FEATURES_NONE] = "none", [FEATURES_POINTS] = "points", [FEATURES_LINES] = "lines", NULL};

static const char *const coding_names[] = {
    [TL_CODING_PLAIN] = "float", [TL_CODING_QUANTIZED] = "quantized", [TL_CODING_COMPRESSED] = "meshopt", NULL};

/* What the numbers of the output file round. */
static tl_rounding file_rounding(const settings *set, const tl_source *dem)
{
    tl_write_options options = {.frame = (tl_frame)set->frame, .coding = (tl_mesh_coding)set->coding};
    tl_rounding rounding = tl_write_rounding(&dem->info, set->common.output, &options);
    if (set->coding != TL_CODING_PLAIN) /* steps reach down to the floor, too */
        rounding.upright += 0.51 / 65535 * (set->skirt + set->base);
    return rounding;
}

static int report_check(const settings *set, const tl_mesh_report *check)
{
    if (check->exceeding) {
        complain("%s: %llu samples are above their bounds, by %.3g at column %lld, row %lld; that is a fault of talus, "
                 "please report it",
                 set->common.output, (unsigned long long)check->exceeding, check->max_excess, (long long)check->worst_i,
                 (long long)check->worst_j);
        return EXIT_FAILED;
    }
    if (!(check->max_error <= set->max_error)) {
        complain(
            "%s: its numbers are %.3g more than %.9g from the DEM at column %lld, row %lld; if they are too coarse "
            "for that, leave --coding away, or use .ply with --frame projected or pixel; there it would be a fault "
            "of talus, please report it",
            set->common.output, check->max_error - set->max_error, set->max_error, (long long)check->worst_i,
            (long long)check->worst_j);
        return EXIT_FAILED;
    }
    if (check->samples == 0)
        command_say(&set->common, "verified: no triangle covers a sample; %llu samples are uncovered",
                    (unsigned long long)check->uncovered);
    else
        command_say(&set->common,
                    "verified: largest error %.7g at column %lld, row %lld; rms %.4g; %llu samples, %llu uncovered",
                    check->max_error, (long long)check->worst_i, (long long)check->worst_j, check->rms_error,
                    (unsigned long long)check->samples, (unsigned long long)check->uncovered);
    return EXIT_DONE;
}

/* What goes below the surface that was checked. */
static tl_status add_below(const settings *set, tl_mesh *mesh, tl_error *error)
{
    if (set->skirt > 0)
        return tl_mesh_add_skirt(mesh, set->skirt, error);
    return set->base > 0 ? tl_mesh_add_base(mesh, set->base, error) : TL_OK;
}

/* Writes the mesh; and checks what the file has, by its own numbers. */
static int write_and_check(const settings *set, const tl_source *dem, tl_mesh *mesh, const tl_run *run, progress *bar)
{
    tl_error error;
    tl_mesh_report check = {0};
    progress_stage(bar, "writing");
    tl_write_options options = {.overwrite = set->common.overwrite,
                                .frame = (tl_frame)set->frame,
                                .coding = (tl_mesh_coding)set->coding,
                                .ground = dem,
                                .texture_size = (int)set->common.texture_size,
                                .split = (size_t)set->common.split,
                                .run = run};
    command_textures(&set->common, &options.textures);
    if (add_below(set, mesh, &error) != TL_OK || tl_write_mesh(mesh, set->common.output, &options, &error) != TL_OK)
        return command_failed(bar, &error);
    progress_end(bar);
    /* steps of 16 bits may be too coarse for the bound, however many samples are kept */
    if (!set->verify && set->coding == TL_CODING_PLAIN)
        return EXIT_DONE;
    progress_stage(bar, "verifying");
    int status = EXIT_DONE;
    tl_selection bounds = {.max_error = set->bound_of_voids, .max_error_map = set->map.source};
    if (tl_mesh_verify_file(set->common.output, mesh, dem, set->error_map ? &bounds : NULL, options.frame, run, &check,
                            &error) != TL_OK)
        status = command_failed(bar, &error);
    progress_end(bar);
    status = status == EXIT_DONE ? report_check(set, &check) : status;
    if (status != EXIT_DONE)
        unlink(set->common.output); /* a failed run leaves nothing */
    return status;
}

static void report(const settings *set, const tl_source *dem, uint64_t isolated, const tl_mesh *mesh, double seconds)
{
    double samples = (double)dem->info.width * (double)dem->info.height;
    command_say(&set->common, "%s: %zu triangles, %zu vertices (%.3g %% of the samples), error <= %g, %.2f s",
                set->common.output, mesh->triangle_count, mesh->vertex_count,
                100 * (double)mesh->vertex_count / samples, set->max_error, seconds);
    if (isolated)
        command_say(&set->common, "%llu valid samples lie alone among voids and are in no triangle",
                    (unsigned long long)isolated);
}

/* Whether the mesh comes out of an error pyramid. */
static bool by_pyramid(const settings *set)
{
    return set->triangles || set->vertices || set->share > 0 || set->error_cache || set->error_map;
}

/* Whether the DEM's heights are too many to be held, which a pyramid need not do. */
static bool too_large(const settings *set, const tl_source *dem, const tl_run *run)
{
    double bytes = 5 * (double)dem->info.width * (double)dem->info.height;
    return set->mesh == TL_MESH_QUADTREE && set->borders == BORDERS_FREE && run->memory && bytes > (double)run->memory;
}

/* The pyramid from the cache, where it fits the DEM; *status tells why there is none. */
static tl_pyramid *load_pyramid(const settings *set, const tl_source *dem, const tl_pyramid_options *options,
                                tl_status *status, tl_error *error)
{
    struct stat there;
    *status = TL_OK;
    if (!set->error_cache || stat(set->error_cache, &there) != 0)
        return NULL;
    tl_pyramid *pyramid = tl_pyramid_load(set->error_cache, dem, options, error);
    if (pyramid)
        command_say(&set->common, "%s: error pyramid used again", set->error_cache);
    else if (error->status == TL_ERROR_DATA)
        command_say(&set->common, "%s; made again", error->text);
    else
        *status = error->status;
    return pyramid;
}

/* Where the bound holds: points alone have no surface but that over the lattice. */
static tl_frame mesh_frame(const settings *set)
{
    return set->points ? TL_FRAME_PIXEL : (tl_frame)set->frame;
}

static tl_pyramid *make_pyramid(const settings *set, const tl_source *dem, const tl_run *run, tl_error *error)
{
    tl_pyramid_options options = {.frame = mesh_frame(set), .run = run};
    if (!set->points)
        options.rounding = file_rounding(set, dem);
    tl_write_options writing = {.overwrite = true, .run = run};
    tl_status status;
    tl_pyramid *pyramid = load_pyramid(set, dem, &options, &status, error);
    if (pyramid || status != TL_OK)
        return pyramid;
    pyramid = tl_pyramid_create(dem, &options, error);
    if (pyramid && set->error_cache && tl_pyramid_save(pyramid, set->error_cache, &writing, error) != TL_OK) {
        tl_pyramid_destroy(pyramid);
        return NULL;
    }
    return pyramid;
}

/* The framework out of a pyramid. */
static tl_framework *select_framework(const settings *set, const tl_source *dem, const tl_features *features,
                                      const tl_run *run, tl_error *error)
{
    double samples = (double)dem->info.width * (double)dem->info.height;
    tl_selection selection = {.max_error = set->max_error,
                              .triangles = (uint64_t)set->triangles,
                              .vertices = set->share > 0 ? (uint64_t)fmax(1, floor(samples * set->share))
                                                         : (uint64_t)set->vertices,
                              .features = features,
                              .run = run};
    if (set->error_map) {
        selection.max_error_map = set->map.source;
        selection.max_error = set->bound_of_voids;
    }
    tl_pyramid *pyramid = make_pyramid(set, dem, run, error);
    tl_framework *framework = pyramid ? tl_framework_from_pyramid(pyramid, dem, &selection, error) : NULL;
    tl_pyramid_destroy(pyramid);
    return framework;
}

static tl_framework *make_framework(settings *set, const tl_source *dem, const tl_features *features, const tl_run *run,
                                    tl_error *error)
{
    tl_framework_options options = {
        .max_error = set->max_error, .frame = mesh_frame(set), .features = features, .run = run};
    if (!set->points)
        options.rounding = file_rounding(set, dem);
    tl_framework *framework = by_pyramid(set) || too_large(set, dem, run)
                                  ? select_framework(set, dem, features, run, error)
                                  : tl_framework_build(dem, &options, error);
    if (framework)
        set->max_error = tl_framework_max_error(framework);
    return framework;
}

static tl_status make_mesh(settings *set, const tl_source *dem, const tl_features *features, const tl_run *run,
                           tl_mesh **mesh, uint64_t *isolated, tl_error *error)
{
    if (by_pyramid(set) || too_large(set, dem, run) || features) {
        tl_framework *framework = make_framework(set, dem, features, run, error);
        tl_status status = framework ? tl_framework_mesh(framework, mesh, error) : error->status;
        *isolated = framework ? tl_framework_isolated_count(framework) : 0;
        tl_framework_destroy(framework);
        return status;
    }
    tl_simplify_options options = {.max_error = set->max_error,
                                   .frame = (tl_frame)set->frame,
                                   .rounding = file_rounding(set, dem),
                                   .kind = (tl_mesh_kind)set->mesh,
                                   .canonical_borders = set->borders == BORDERS_CANONICAL,
                                   .run = run};
    return tl_simplify(dem, &options, mesh, isolated, error);
}

/* Turns squares to their lower diagonals, if asked to, and tells what that does. */
static tl_status turn_diagonals(const settings *set, const tl_source *dem, const tl_run *run, tl_mesh *mesh,
                                tl_error *error)
{
    if (set->diagonal == DIAGONAL_LONGEST_EDGE)
        return TL_OK;
    tl_diagonal_options options = {
        .max_error = set->max_error, .frame = (tl_frame)set->frame, .rounding = file_rounding(set, dem), .run = run};
    tl_diagonal_report found;
    tl_status status = tl_mesh_lower_diagonals(mesh, dem, &options, &found, error);
    if (status == TL_OK)
        command_say(&set->common,
                    "diagonals: %llu squares, %llu low already, %llu turned, %llu held by the bound; rms error at the "
                    "%llu samples in what was turned: %.4g, before %.4g",
                    (unsigned long long)found.squares, (unsigned long long)found.lower,
                    (unsigned long long)found.turned, (unsigned long long)found.held, (unsigned long long)found.samples,
                    found.rms_after, found.rms_before);
    return status;
}

/* ---- Features and points ---- */

static void report_features(const settings *set, const tl_features *features, double samples)
{
    size_t counts[5] = {0};
    for (size_t k = 0; k < features->count; k++)
        for (int kind = 0; kind < 5; kind++)
            counts[kind] += features->items[k].kinds >> kind & 1;
    command_say(&set->common,
                "features: %zu summits, %zu pits, %zu passes, %zu on ridges, %zu in valleys; %.3g %% of "
                "the samples",
                counts[0], counts[1], counts[2], counts[3], counts[4], 100 * (double)features->count / samples);
}

/* Finds the features that are asked for; none is good too. */
static tl_status find_features(const settings *set, const tl_source *dem, const tl_run *run, tl_features **out,
                               tl_error *error)
{
    if (set->features == FEATURES_NONE)
        return TL_OK;
    tl_features_options options = {.persistence = set->max_error, .lines = set->features == FEATURES_LINES, .run = run};
    tl_status status = tl_features_find(dem, &options, out, error);
    if (status == TL_OK)
        report_features(set, *out, (double)dem->info.width * (double)dem->info.height);
    return status;
}

/* Reads a written framework back, and measures its surface. */
static int verify_points(const settings *set, const tl_source *dem, const tl_run *run, progress *bar)
{
    tl_error error;
    tl_mesh *mesh = NULL;
    tl_mesh_report check = {0};
    progress_stage(bar, "verifying");
    tl_framework *framework = tl_framework_load(set->common.output, run, &error);
    int status = EXIT_DONE;
    if (!framework || tl_framework_mesh(framework, &mesh, &error) != TL_OK ||
        tl_mesh_verify(mesh, dem, run, &check, &error) != TL_OK)
        status = command_failed(bar, &error);
    progress_end(bar);
    tl_mesh_destroy(mesh);
    tl_framework_destroy(framework);
    return status == EXIT_DONE ? report_check(set, &check) : status;
}

static int write_points(settings *set, const tl_source *dem, const tl_features *features, const tl_run *run,
                        progress *bar)
{
    tl_error error;
    tl_points_options options = {
        .overwrite = set->common.overwrite, .features = features, .frame = (tl_frame)set->frame, .run = run};
    tl_framework *framework = make_framework(set, dem, features, run, &error);
    int status = EXIT_DONE;
    if (!framework || tl_framework_save(framework, dem, set->common.output, &options, &error) != TL_OK)
        status = command_failed(bar, &error);
    double seconds = progress_end(bar), samples = (double)dem->info.width * (double)dem->info.height;
    if (status == EXIT_DONE && set->verify && (status = verify_points(set, dem, run, bar)) != EXIT_DONE)
        unlink(set->common.output);
    struct stat there = {0};
    if (status == EXIT_DONE && stat(set->common.output, &there) == 0)
        command_say(&set->common, "%s: %zu points (%.3g %% of the samples), error <= %g, %lld bytes, %.2f s",
                    set->common.output, tl_framework_point_count(framework),
                    100 * (double)tl_framework_point_count(framework) / samples, set->max_error,
                    (long long)there.st_size, seconds);
    tl_framework_destroy(framework);
    return status;
}

static int write_mesh(settings *set, const tl_source *dem, const tl_features *features, const tl_run *run,
                      progress *bar)
{
    tl_error error;
    tl_mesh *mesh = NULL;
    uint64_t isolated = 0;
    int status;
    if (make_mesh(set, dem, features, run, &mesh, &isolated, &error) != TL_OK ||
        turn_diagonals(set, dem, run, mesh, &error) != TL_OK)
        status = command_failed(bar, &error);
    else {
        double seconds = progress_end(bar);
        status = write_and_check(set, dem, mesh, run, bar);
        if (status == EXIT_DONE)
            report(set, dem, isolated, mesh, seconds);
    }
    tl_mesh_destroy(mesh);
    return status;
}

/* The map of bounds, which are not heights. */
static tl_status open_map(settings *set, const tl_run *run, tl_error *error)
{
    if (!set->error_map)
        return TL_OK;
    char *name = (char *)set->error_map;
    common plain = set->common;
    plain.voids = plain.geoid = NULL;
    plain.nodata_given = false, plain.band = 0;
    set->map = command_open(&plain, &(arguments){.names = &name, .count = 1}, run, error);
    set->bound_of_voids = set->max_error_given ? set->max_error : -1;
    return set->map.source ? TL_OK : error->status;
}

static int simplify(settings *set, const arguments *inputs)
{
    progress bar;
    tl_error error;
    tl_run run = command_run(&set->common, &bar);
    struct stat there; /* told before the work; tl_write_mesh looks again */
    if (!set->common.overwrite && lstat(set->common.output, &there) == 0) {
        complain("%s: exists already; name another file or give --overwrite", set->common.output);
        return EXIT_FAILED;
    }
    opened_input opened = command_open(&set->common, inputs, &run, &error);
    const tl_source *dem = opened.source;
    if (!dem)
        return command_failed(&bar, &error);
    progress_stage(&bar, "simplifying");
    tl_features *features = NULL;
    int status;
    if (open_map(set, &run, &error) != TL_OK || find_features(set, dem, &run, &features, &error) != TL_OK)
        status = command_failed(&bar, &error);
    else
        status =
            set->points ? write_points(set, dem, features, &run, &bar) : write_mesh(set, dem, features, &run, &bar);
    tl_features_destroy(features);
    command_close(&set->map);
    command_close(&opened);
    return status;
}

/* Whether --keep is understood. */
static bool read_share(settings *set)
{
    if (!set->keep)
        return true;
    char *end;
    double percent = strtod(set->keep, &end);
    if (end != set->keep && (!*end || strcmp(end, "%") == 0) && percent > 0 && percent <= 100) {
        set->share = percent / 100;
        return true;
    }
    complain("--keep: a share in percent, above 0 and up to 100, is wanted, not '%.100s'", set->keep);
    return false;
}

static bool points_output_ok(const settings *set)
{
    static const char *const endings[] = {".geojson", ".json", ".csv", ".ply", ".tif", ".tiff"};
    for (size_t k = 0; k < sizeof endings / sizeof *endings; k++)
        if (command_ends_with(set->common.output, endings[k]))
            return true;
    complain("%s; points are written to .geojson, .csv, .ply or .tif",
             set->common.output ? set->common.output : "no output named; give -o FILE");
    return false;
}

static bool settings_ok(settings *set)
{
    unsigned textures;
    int rules =
        (set->max_error_given || set->error_map) + (set->triangles > 0) + (set->vertices > 0) + (set->keep != NULL);
    if (rules == 0)
        complain("no error bound given; give --max-error E, in the DEM's unit of height, or --budget N");
    else if (rules > 1)
        complain("--max-error, --budget, --budget-vertices and --keep exclude each other; give one");
    else if (!read_share(set))
        return false;
    else if (set->skirt > 0 && set->base > 0)
        complain("--skirt and --base exclude each other: a solid has walls already");
    else if (by_pyramid(set) && (set->mesh != TL_MESH_QUADTREE || set->borders != BORDERS_FREE))
        complain("--budget, --budget-vertices, --keep, --max-error-map and --error-cache are for quadtree meshes with "
                 "free borders; "
                 "leave --mesh and --borders away");
    else if ((set->points || set->features) && (set->mesh != TL_MESH_QUADTREE || set->borders != BORDERS_FREE))
        complain("--points and --features are for quadtree meshes with free borders; leave --mesh and --borders away");
    else if (set->diagonal != DIAGONAL_LONGEST_EDGE && (set->points || set->mesh != TL_MESH_QUADTREE || set->error_map))
        complain("--diagonal lower is for quadtree meshes under one bound; leave --mesh, --points and --max-error-map "
                 "away");
    else if (set->coding != TL_CODING_PLAIN && !command_ends_with(set->common.output, ".glb"))
        complain("--coding is for .glb; other formats have but one");
    else if (!command_textures(&set->common, &textures) || !command_split_ok(&set->common))
        return false;
    else if (set->common.split && (set->verify || set->coding != TL_CODING_PLAIN))
        complain("--split goes without --verify, which reads one file back, and without --coding");
    else if (set->features && !set->max_error_given)
        complain("--features needs --max-error E, which tells what matters");
    else if (set->points && (set->skirt > 0 || set->base > 0))
        complain("--points have no --skirt and no --base");
    else if (set->points && set->verify && !command_ends_with(set->common.output, ".tif") &&
             !command_ends_with(set->common.output, ".tiff"))
        complain("--verify measures a surface; of --points only .tif has one");
    else
        return true;
    return false;
}

static int run(const command *self, int argc, const char **argv, command_help help)
{
    settings set = {0};
    const option shape[] = {
        {"max-error", 'e', OPTION_NUMBER, &set.max_error, &set.max_error_given, "E",
         "largest vertical distance of any sample from the mesh, in the DEM's unit, 0...1e30 (needed)", 0, 1e30, NULL},
        {"max-error-map", 0, OPTION_TEXT, &set.error_map, NULL, "RASTER",
         "a bound for each sample, of as many samples as the DEM; --max-error is then that of its voids", 0, 0, NULL},
        {"budget", 0, OPTION_INTEGER, &set.triangles, NULL, "N",
         "instead of --max-error: at most N triangles, those that matter most, 1...4e9", 1, 4e9, NULL},
        {"budget-vertices", 0, OPTION_INTEGER, &set.vertices, NULL, "N", "the same for vertices", 1, 4e9, NULL},
        {"keep", 0, OPTION_TEXT, &set.keep, NULL, "SHARE", "the same for a share of the samples, as 48.76%", 0, 0,
         NULL},
        {"mesh", 0, OPTION_CHOICE, &set.mesh, NULL, "KIND",
         "quadtree, or tin: irregular, less than half the triangles, slower (default: quadtree)", 0, 0, mesh_names},
        {"borders", 0, OPTION_CHOICE, &set.borders, NULL, "RULE",
         "canonical: by the rim's samples alone, so that tiles that share them join without a crack; a tin always has "
         "these (default: free)",
         0, 0, border_names},
        {"diagonal", 0, OPTION_CHOICE, &set.diagonal, NULL, "RULE",
         "which way squares of two triangles are cut: longest-edge, by their place, or lower, along the lower diagonal "
         "where the bound allows it (default: longest-edge)",
         0, 0, diagonal_names},
        {"points", 0, OPTION_FLAG, &set.points, NULL, NULL,
         "write the points alone: .geojson, .csv, .ply, or .tif, which synth takes in place of the DEM", 0, 0, NULL},
        {"features", 0, OPTION_CHOICE, &set.features, NULL, "KIND",
         "keep summits, pits and passes of at least the bound's height or depth (points), and ridges and valleys "
         "(lines; default: none)",
         0, 0, feature_names},
        {"skirt", 0, OPTION_NUMBER, &set.skirt, NULL, "DEPTH",
         "hang walls this deep below the rim and the rims of voids, in the DEM's unit, 1e-6...1e30", 1e-6, 1e30, NULL},
        {"base", 0, OPTION_NUMBER, &set.base, NULL, "THICKNESS",
         "close the mesh to a solid with walls and a floor this far below its lowest point, 1e-6...1e30", 1e-6, 1e30,
         NULL},
        {"error-cache", 0, OPTION_TEXT, &set.error_cache, NULL, "FILE",
         "a GeoTIFF that keeps what every bound and budget needs: used again while the DEM stays the same", 0, 0, NULL},
        {"coding", 0, OPTION_CHOICE, &set.coding, NULL, "CODING",
         "of a .glb: float, quantized (positions in 16 bits, which count into the bound), or meshopt (these "
         "compressed; default: float)",
         0, 0, coding_names},
        {"verify", 0, OPTION_FLAG, &set.verify, NULL, NULL,
         "read the written file back and measure it against every sample", 0, 0, NULL},
        {"frame", 0, OPTION_CHOICE, &set.frame, NULL, "FRAME",
         "coordinates of the mesh (default: enu where the CRS is known)", 0, 0, frame_names},
        {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option output[] = {COMMON_OUTPUT(set.common), TEXTURE_OPTIONS(set.common), SPLIT_OPTION(set.common), {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {
        {"Simplification", shape}, {"Input", input}, {"Output", output}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status))
        return status;
    bool good =
        settings_ok(&set) && (set.points ? points_output_ok(&set) : command_output_ok(&set.common, false, true));
    status = good ? simplify(&set, &rest) : EXIT_USAGE;
    arguments_free(&rest);
    return status;
}

const command command_simplify = {
    "simplify", "simplify an elevation model to a mesh under a strict error bound", "DEM... --max-error E -o MESH",
    "Formats: .glb, .obj, .ply, .stl. Frames: enu is metres east, north and up of the raster's middle;\n"
    "projected is the DEM's own coordinates; pixel is column, row, height.\n\n" INPUT_NOTES "\n\n"
    "Example: talus simplify dem.tif --max-error 5 --verify -o mesh.glb",
    run};
