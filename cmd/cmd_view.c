#include "cmd/command.h"
#include "cmd/lod_options.h"
#include "cmd/picture_options.h"
#include "cmd/view_options.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

typedef struct settings {
    common common;
    view_options view;
    lod_options lod;
    picture_options picture;
    int frame;
    bool json, measure, morph;
} settings;

/* What the command is about, in messages. */
static const char *name_of(const settings *set)
{
    return set->common.output ? set->common.output : set->picture.picture ? set->picture.picture : "view";
}

static void report(const settings *set, const tl_lod_stats *s, double seconds)
{
    command_say(&set->common,
                "%s: %llu triangles, %llu vertices, finest level %d, error <= %.3g pixels; %llu tiles of %llu samples "
                "made, %llu blocks of the DEM read; chosen in %.2f s, written in %.2f s",
                name_of(set), (unsigned long long)s->triangles, (unsigned long long)s->vertices, s->finest_level,
                s->pixel_error, (unsigned long long)s->tiles_made, (unsigned long long)s->samples_made,
                (unsigned long long)s->dem_blocks, s->seconds, seconds);
    command_say(&set->common,
                "left out: %llu nodes beside the screen, %llu that look away, %llu behind the horizon, %llu behind "
                "ridges",
                (unsigned long long)s->culled[0], (unsigned long long)s->culled[1], (unsigned long long)s->culled[2],
                (unsigned long long)s->culled[3]);
}

/* Most likely the eye is elsewhere than was meant. */
static void warn_of_nothing(const settings *set, const tl_lod_stats *s)
{
    if (s->triangles == 0)
        command_say(&set->common,
                    "warning: nothing is in sight; does the eye (longitude first, then latitude) stand over the DEM, "
                    "and look at it?");
}

static int print_json(const tl_lod_stats *stats, const tl_view_report *measured)
{
    json_t *root = lod_stats_json(stats);
    if (measured)
        json_object_set_new(root, "measured", view_report_json(measured));
    if (json_dumpf(root, stdout, JSON_INDENT(2)) == 0)
        putchar('\n');
    json_decref(root);
    return command_done();
}

/* The mesh, the picture, or both. */
static tl_status write_outputs(const settings *set, const tl_mesh *mesh, const lod_ground *ground, const tl_view *view,
                               const tl_run *run, tl_error *error)
{
    const tl_source *dem = ground->opened.source;
    tl_write_options writing = {.overwrite = set->common.overwrite,
                                .frame = (tl_frame)set->frame,
                                .parent_heights = set->morph,
                                .ground = ground->field,
                                .texture_size = (int)set->common.texture_size,
                                .run = run};
    command_textures(&set->common, &writing.textures);
    tl_view_picture_options look = set->picture.look;
    look.overwrite = set->common.overwrite;
    look.run = run;
    tl_status status = TL_OK;
    if (set->common.output)
        status = tl_write_mesh(mesh, set->common.output, &writing, error);
    if (status == TL_OK && set->picture.picture) {
        status = tl_view_write_picture(mesh, dem, view, 1, set->picture.picture, &look, error);
        if (status != TL_OK && set->common.output)
            unlink(set->common.output); /* a failed run leaves nothing */
    }
    return status;
}

/* Beside the same view of the same field, refined until a quarter of the error is left, and a quarter of a pixel. */
static tl_status measure(const settings *set, const lod_ground *ground, const tl_mesh *mesh, const tl_view *view,
                         const tl_run *run, tl_view_report *out, tl_error *error)
{
    double asked = set->lod.lod.pixel_error > 0 ? set->lod.lod.pixel_error : 1;
    const tl_lod_options finer = {
        .pixel_error = asked < 1 ? asked / 4 : 0.25, .keep = set->lod.lod.keep, .run = set->lod.lod.run};
    tl_mesh *reference = NULL;
    tl_lod_stats stats;
    tl_status status =
        tl_select(ground->field, ground->opened.source, ground->pyramid, view, &finer, &reference, &stats, error);
    if (status == TL_OK)
        status = tl_view_measure(mesh, reference, ground->opened.source, view, run, out, error);
    tl_mesh_destroy(reference);
    return status;
}

static int write_view(const settings *set, const lod_ground *ground, const tl_run *run, progress *bar)
{
    tl_error error;
    tl_view view;
    tl_mesh *mesh = NULL;
    tl_lod_stats stats;
    tl_view_report measured;
    progress_stage(bar, "selecting");
    tl_status status = view_options_view(&set->view, &view, &error);
    if (status == TL_OK)
        status = tl_select(ground->field, ground->opened.source, ground->pyramid, &view, &set->lod.lod, &mesh, &stats,
                           &error);
    progress_stage(bar, "writing");
    if (status == TL_OK)
        status = write_outputs(set, mesh, ground, &view, run, &error);
    double seconds = progress_end(bar);
    if (status == TL_OK && set->measure) {
        progress_stage(bar, "measuring the picture");
        status = measure(set, ground, mesh, &view, run, &measured, &error);
    }
    tl_mesh_destroy(mesh);
    if (status != TL_OK)
        return command_failed(bar, &error);
    report(set, &stats, seconds);
    warn_of_nothing(set, &stats);
    lod_warn_of_ground(&set->common, &stats);
    if (set->measure) {
        char text[VIEW_REPORT_TEXT];
        view_report_text(&measured, text, sizeof text);
        command_say(&set->common, "measured: %s", text);
    }
    return set->json ? print_json(&stats, set->measure ? &measured : NULL) : EXIT_DONE;
}

static int view(settings *set, const arguments *inputs)
{
    progress bar;
    tl_error error;
    tl_run run = command_run(&set->common, &bar);
    lod_ground ground;
    struct stat there; /* told before the work; tl_write_mesh looks again */
    const char *const outputs[] = {set->common.output, set->picture.picture, set->picture.look.depth};
    for (int k = 0; k < 3; k++)
        if (outputs[k] && !set->common.overwrite && lstat(outputs[k], &there) == 0) {
            complain("%s: exists already; name another file or give --overwrite", outputs[k]);
            return EXIT_FAILED;
        }
    progress_stage(&bar, "measuring");
    if (lod_ground_open(&set->common, &set->lod, inputs, (tl_frame)set->frame, set->common.output, &run, &ground,
                        &error) != TL_OK)
        return command_failed(&bar, &error);
    int status = write_view(set, &ground, &run, &bar);
    lod_ground_close(&ground);
    return status;
}

static bool morph_ok(const settings *set)
{
    if (!set->morph || command_ends_with(set->common.output, ".glb"))
        return true;
    complain("--morph is for a .glb; name one behind -o");
    return false;
}

static int run(const command *self, int argc, const char **argv, command_help help)
{
    settings set = {.lod = {.levels = 6}};
    const option place[] = {VIEW_OPTIONS(set.view), {0}};
    const option depth[] = {LOD_OPTIONS(set.lod), {0}};
    const option detail[] = {DETAIL_OPTIONS(set.lod), {0}};
    const option picture[] = {PICTURE_OPTIONS(set.picture),
                              {"measure", 0, OPTION_FLAG, &set.measure, NULL, NULL,
                               "compare the picture with that of the field refined four times as far", 0, 0, NULL},
                              {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option output[] = {COMMON_OUTPUT(set.common),
                             TEXTURE_OPTIONS(set.common),
                             {"frame", 0, OPTION_CHOICE, &set.frame, NULL, "FRAME",
                              "coordinates of the mesh (default: enu where the CRS is known)", 0, 0, frame_names},
                             {"morph", 0, OPTION_FLAG, &set.morph, NULL, NULL,
                              "in a .glb, with the surface before each vertex came: a morph target, and the attribute "
                              "_PARENT_HEIGHT",
                              0, 0, NULL},
                             {"json", 0, OPTION_FLAG, &set.json, NULL, NULL, "print statistics as JSON", 0, 0, NULL},
                             {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"View", place},  {"Depth", depth},   {"Detail", detail},   {"Picture", picture},
                                   {"Input", input}, {"Output", output}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status))
        return status;
    bool mesh = set.common.output || !(set.picture.picture || set.measure);
    unsigned textures;
    bool good = view_options_ok(&set.view) && lod_options_ok(&set.lod) && picture_options_ok(&set.picture) &&
                (!mesh || command_output_ok(&set.common, false, true)) && morph_ok(&set) &&
                command_textures(&set.common, &textures);
    status = good ? view(&set, &rest) : EXIT_USAGE;
    arguments_free(&rest);
    return status;
}

const command command_view = {
    "view", "choose the triangles that one view of refined terrain needs",
    "DEM... --eye LON,LAT,HEIGHT [--target LON,LAT,HEIGHT] [-o MESH] [--picture FILE.png]",
    "Formats: .glb, .obj, .ply, .stl. Nothing is made, read or written where it cannot be seen. The DEM's samples are\n"
    "taken for heights at points.\n\n" INPUT_NOTES "\n\n"
    "Examples: talus view dem.tif --eye -84.25,36.55,300 --above-ground --heading 120 -o view.glb\n"
    "          talus view dem.tif --eye -84.25,36.55,300 --above-ground --heading 120 --picture view.png --measure",
    run};
