#include "cmd/command.h"
#include "cmd/lod_options.h"
#include "cmd/view_options.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

typedef struct settings {
    common common;
    view_options view;
    lod_options lod;
    int frame;
    bool json;
} settings;

static void report(const settings *set, const tl_lod_stats *s, double seconds)
{
    command_say(&set->common,
                "%s: %llu triangles, %llu vertices, finest level %d, error <= %.3g pixels; %llu tiles of %llu samples "
                "made, %llu blocks of the DEM read; %.2f s, of which %.2f s for the view",
                set->common.output, (unsigned long long)s->triangles, (unsigned long long)s->vertices, s->finest_level,
                s->pixel_error, (unsigned long long)s->tiles_made, (unsigned long long)s->samples_made,
                (unsigned long long)s->dem_blocks, seconds, s->seconds);
    command_say(&set->common,
                "left out: %llu nodes beside the screen, %llu that look away, %llu behind the horizon, %llu behind "
                "ridges",
                (unsigned long long)s->culled[0], (unsigned long long)s->culled[1], (unsigned long long)s->culled[2],
                (unsigned long long)s->culled[3]);
}

static int print_json(const tl_lod_stats *stats)
{
    json_t *root = lod_stats_json(stats);
    if (json_dumpf(root, stdout, JSON_INDENT(2)) == 0)
        putchar('\n');
    json_decref(root);
    return command_done();
}

static int write_view(const settings *set, const lod_ground *ground, const tl_run *run, progress *bar)
{
    tl_error error;
    tl_view view;
    tl_mesh *mesh = NULL;
    tl_lod_stats stats;
    const tl_write_options writing = {.overwrite = set->common.overwrite, .frame = (tl_frame)set->frame, .run = run};
    progress_stage(bar, "selecting");
    tl_status status = view_options_view(&set->view, &view, &error);
    if (status == TL_OK)
        status = tl_select(ground->field, ground->opened.source, ground->pyramid, &view, &set->lod.lod, &mesh, &stats,
                           &error);
    progress_stage(bar, "writing");
    if (status == TL_OK)
        status = tl_write_mesh(mesh, set->common.output, &writing, &error);
    tl_mesh_destroy(mesh);
    if (status != TL_OK)
        return command_failed(bar, &error);
    report(set, &stats, progress_end(bar));
    return set->json ? print_json(&stats) : EXIT_DONE;
}

static int view(settings *set, const arguments *inputs)
{
    progress bar;
    tl_error error;
    tl_run run = command_run(&set->common, &bar);
    lod_ground ground;
    struct stat there; /* told before the work; tl_write_mesh looks again */
    if (!set->common.overwrite && lstat(set->common.output, &there) == 0) {
        complain("%s: exists already; name another file or give --overwrite", set->common.output);
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

static int run(const command *self, int argc, const char **argv, bool help)
{
    settings set = {.lod = {.levels = 6}};
    const option place[] = {VIEW_OPTIONS(set.view), {0}};
    const option depth[] = {LOD_OPTIONS(set.lod), {0}};
    const option detail[] = {DETAIL_OPTIONS(set.lod), {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option output[] = {COMMON_OUTPUT(set.common),
                             {"frame", 0, OPTION_CHOICE, &set.frame, NULL, "FRAME",
                              "coordinates of the mesh (default: enu where the CRS is known)", 0, 0, frame_names},
                             {"json", 0, OPTION_FLAG, &set.json, NULL, NULL, "print statistics as JSON", 0, 0, NULL},
                             {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"View", place},
                                   {"Depth", depth},
                                   {"Detail", detail},
                                   {"Input", input},
                                   {"Output", output},
                                   {"Running", running},
                                   {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status))
        return status;
    bool good = view_options_ok(&set.view) && lod_options_ok(&set.lod) && command_output_ok(&set.common, false, true);
    status = good ? view(&set, &rest) : EXIT_USAGE;
    arguments_free(&rest);
    return status;
}

const command command_view = {
    "view", "choose the triangles that one view of refined terrain needs",
    "DEM... --eye LON,LAT,HEIGHT [--target LON,LAT,HEIGHT] -o MESH",
    "Formats: .glb, .obj, .ply, .stl. Nothing is made, read or written where it cannot be seen. The DEM's samples are\n"
    "taken for heights at points.\n\n" INPUT_NOTES "\n\n"
    "Example: talus view dem.tif --eye 7.65,45.95,300 --above-ground --heading 200 -o view.glb",
    run};
