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
    int frame, mesh, borders;
    double skirt, base;
    int64_t triangles, vertices; /* budgets; 0: none */
    const char *keep;
    double share; /* of the samples, by --keep; 0: none */
    const char *error_cache;
    const char *error_map;
} settings;

static const char *const mesh_names[] = {[TL_MESH_QUADTREE] = "quadtree", [TL_MESH_TIN] = "tin", NULL};

enum { BORDERS_FREE, BORDERS_CANONICAL };
static const char *const border_names[] = {[BORDERS_FREE] = "free", [BORDERS_CANONICAL] = "canonical", NULL};

static int report_check(const settings *set, const tl_mesh_report *check)
{
    if (!(check->max_error <= set->max_error)) {
        complain(
            "%s: its numbers are %.3g more than %.9g from the DEM at column %lld, row %lld; if they are too coarse "
            "for that, use .ply with --frame projected or pixel; there it would be a fault of talus, please "
            "report it",
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
    tl_write_options options = {.overwrite = set->common.overwrite, .frame = (tl_frame)set->frame, .run = run};
    if (add_below(set, mesh, &error) != TL_OK || tl_write_mesh(mesh, set->common.output, &options, &error) != TL_OK)
        return command_failed(bar, &error);
    progress_end(bar);
    if (!set->verify)
        return EXIT_DONE;
    progress_stage(bar, "verifying");
    int status = EXIT_DONE;
    if (tl_mesh_verify_file(set->common.output, mesh, dem, options.frame, run, &check, &error) != TL_OK)
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

static tl_pyramid *make_pyramid(const settings *set, const tl_source *dem, const tl_run *run, tl_error *error)
{
    tl_pyramid_options options = {.frame = (tl_frame)set->frame,
                                  .rounding = tl_write_rounding(&dem->info, set->common.output, (tl_frame)set->frame),
                                  .run = run};
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

static tl_status select_mesh(settings *set, const tl_source *dem, const tl_run *run, tl_mesh **mesh, uint64_t *isolated,
                             tl_error *error)
{
    double samples = (double)dem->info.width * (double)dem->info.height;
    tl_selection selection = {.max_error = set->max_error,
                              .triangles = (uint64_t)set->triangles,
                              .vertices = set->share > 0 ? (uint64_t)fmax(1, floor(samples * set->share))
                                                         : (uint64_t)set->vertices,
                              .run = run};
    opened_input map = {0};
    if (set->error_map) {
        char *name = (char *)set->error_map;
        common plain = set->common; /* the map has bounds, not heights */
        plain.voids = plain.geoid = NULL;
        plain.nodata_given = false, plain.band = 0;
        map = command_open(&plain, &(arguments){.names = &name, .count = 1}, run, error);
        if (!map.source)
            return error->status;
        selection.max_error_map = map.source;
        selection.max_error = set->max_error_given ? set->max_error : -1;
    }
    tl_pyramid *pyramid = make_pyramid(set, dem, run, error);
    tl_framework *framework = pyramid ? tl_framework_from_pyramid(pyramid, dem, &selection, error) : NULL;
    tl_status status = framework ? tl_framework_mesh(framework, mesh, error) : error->status;
    if (status == TL_OK) {
        set->max_error = tl_framework_max_error(framework);
        *isolated = tl_framework_isolated_count(framework);
    }
    tl_framework_destroy(framework);
    tl_pyramid_destroy(pyramid);
    if (set->error_map)
        command_close(&map);
    return status;
}

static tl_status make_mesh(settings *set, const tl_source *dem, const tl_run *run, tl_mesh **mesh, uint64_t *isolated,
                           tl_error *error)
{
    if (by_pyramid(set) || too_large(set, dem, run))
        return select_mesh(set, dem, run, mesh, isolated, error);
    tl_simplify_options options = {.max_error = set->max_error,
                                   .frame = (tl_frame)set->frame,
                                   .rounding = tl_write_rounding(&dem->info, set->common.output, (tl_frame)set->frame),
                                   .kind = (tl_mesh_kind)set->mesh,
                                   .canonical_borders = set->borders == BORDERS_CANONICAL,
                                   .run = run};
    return tl_simplify(dem, &options, mesh, isolated, error);
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
    tl_mesh *mesh = NULL;
    uint64_t isolated = 0;
    int status = EXIT_DONE;
    if (make_mesh(set, dem, &run, &mesh, &isolated, &error) != TL_OK)
        status = command_failed(&bar, &error);
    else {
        double seconds = progress_end(&bar);
        status = write_and_check(set, dem, mesh, &run, &bar);
        if (status == EXIT_DONE)
            report(set, dem, isolated, mesh, seconds);
    }
    tl_mesh_destroy(mesh);
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

static bool settings_ok(settings *set)
{
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
    else
        return true;
    return false;
}

static int run(const command *self, int argc, const char **argv, bool help)
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
        {"skirt", 0, OPTION_NUMBER, &set.skirt, NULL, "DEPTH",
         "hang walls this deep below the rim and the rims of voids, in the DEM's unit, 1e-6...1e30", 1e-6, 1e30, NULL},
        {"base", 0, OPTION_NUMBER, &set.base, NULL, "THICKNESS",
         "close the mesh to a solid with walls and a floor this far below its lowest point, 1e-6...1e30", 1e-6, 1e30,
         NULL},
        {"error-cache", 0, OPTION_TEXT, &set.error_cache, NULL, "FILE",
         "a GeoTIFF that keeps what every bound and budget needs: used again while the DEM stays the same", 0, 0, NULL},
        {"verify", 0, OPTION_FLAG, &set.verify, NULL, NULL,
         "read the written file back and measure it against every sample", 0, 0, NULL},
        {"frame", 0, OPTION_CHOICE, &set.frame, NULL, "FRAME",
         "coordinates of the mesh (default: enu where the CRS is known)", 0, 0, frame_names},
        {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option output[] = {COMMON_OUTPUT(set.common), {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {
        {"Simplification", shape}, {"Input", input}, {"Output", output}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status))
        return status;
    bool good = settings_ok(&set) && command_output_ok(&set.common, false, true);
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
