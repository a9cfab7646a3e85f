#include "cmd/command.h"

#include <stdlib.h>
#include <string.h>

typedef struct settings {
    common common;
    tl_preview_options preview;
    const char *beside;
    int64_t width, height;
    bool eye_given, target_given, azimuth_given, elevation_given;
} settings;

/* What is not given is the library's choice for the kind of picture. */
static void place_sun(settings *set)
{
    bool perspective = set->preview.perspective;
    if (!set->azimuth_given && set->elevation_given)
        set->preview.sun_azimuth = perspective ? 235 : 315;
    if (!set->elevation_given && set->azimuth_given)
        set->preview.sun_elevation = perspective ? 35 : 45;
}

static bool settings_ok(settings *set)
{
    if (!command_ends_with(set->common.output, ".png")) {
        complain("a name that ends with .png is wanted behind -o");
        return false;
    }
    if (set->eye_given != set->target_given) {
        complain("--eye and --target go together");
        return false;
    }
    set->preview.view_given = set->eye_given;
    set->preview.perspective |= set->eye_given;
    if (set->preview.perspective && set->beside) {
        complain("--beside goes with a hillshade, not with a perspective");
        return false;
    }
    if (set->preview.colour && strcmp(set->preview.colour, "hypsometric") == 0)
        set->preview.colour = NULL;
    if (set->preview.colour && (set->preview.grey || !set->preview.perspective)) {
        complain("--colour goes with --perspective, and without --grey");
        return false;
    }
    if (set->preview.colour && strcmp(set->preview.colour, set->common.output) == 0) {
        complain("%s: is the picture's colours; name another -o", set->common.output);
        return false;
    }
    set->preview.width = (int)set->width;
    set->preview.height = (int)set->height;
    set->preview.overwrite = set->common.overwrite;
    place_sun(set);
    return true;
}

static int draw(settings *set, const arguments *inputs)
{
    progress bar;
    tl_error error;
    tl_run run = command_run(&set->common, &bar);
    set->preview.run = &run;
    opened_input opened = command_open(&set->common, inputs, &run, &error);
    const tl_source *source = opened.source;
    const tl_dem_options second = {.memory = run.memory / 8, .run = &run};
    tl_source *beside = source && set->beside ? tl_open_with(set->beside, &second, &error) : NULL;
    int status = EXIT_DONE;
    progress_stage(&bar, "drawing");
    if (!source || (set->beside && !beside) ||
        tl_write_preview(source, beside, set->common.output, &set->preview, &error) != TL_OK)
        status = command_failed(&bar, &error);
    else
        command_say(&set->common, "%s: drawn in %.2f s", set->common.output, progress_end(&bar));
    tl_source_destroy(beside);
    command_close(&opened);
    return status;
}

static int run(const command *self, int argc, const char **argv, command_help help)
{
    settings set = {.common = {.any_contents = true}, .preview = {.exaggeration = 1, .fov = 50}};
    const option picture[] = {
        {"width", 0, OPTION_INTEGER, &set.width, NULL, "N",
         "pixels, 1...32768 (default: the raster's own, at most 2048; 1920 in perspective)", 1, 32768, NULL},
        {"height", 0, OPTION_INTEGER, &set.height, NULL, "N",
         "pixels, 1...32768 (default: by the raster's shape; 1080 in perspective)", 1, 32768, NULL},
        {"beside", 0, OPTION_TEXT, &set.beside, NULL, "FILE", "a second raster of the same place, drawn to the right",
         0, 0, NULL},
        {"colour", 0, OPTION_TEXT, &set.preview.colour, NULL, "FILE|LAYER",
         "of a perspective: a raster of red, green and blue in the DEM's CRS; normal, slope or splat of the DEM; or "
         "hypsometric: by height, the default",
         0, 0, NULL},
        {"grey", 0, OPTION_FLAG, &set.preview.grey, NULL, NULL, "shade only, no colours by height", 0, 0, NULL},
        {0}};
    const option light[] = {{"sun-azimuth", 0, OPTION_NUMBER, &set.preview.sun_azimuth, &set.azimuth_given, "DEG",
                             "clockwise from north, 0...360 (default: 315; 235 in perspective)", 0, 360, NULL},
                            {"sun-elevation", 0, OPTION_NUMBER, &set.preview.sun_elevation, &set.elevation_given, "DEG",
                             "above the horizon, 1...90 (default: 45; 35 in perspective)", 1, 90, NULL},
                            {"exaggeration", 0, OPTION_NUMBER, &set.preview.exaggeration, NULL, "X",
                             "factor on heights, 0.01...100 (default: 1)", 0.01, 100, NULL},
                            {0}};
    const option view[] = {
        {"perspective", 'p', OPTION_FLAG, &set.preview.perspective, NULL, NULL,
         "a perspective over the whole raster, from the south", 0, 0, NULL},
        {"eye", 0, OPTION_TRIPLE, set.preview.eye, &set.eye_given, "X,Y,HEIGHT",
         "where to look from: CRS coordinates (longitude,latitude where geographic), metres above the datum", 0, 0,
         NULL},
        {"target", 0, OPTION_TRIPLE, set.preview.target, &set.target_given, "X,Y,HEIGHT", "where to look", 0, 0, NULL},
        {"fov", 0, OPTION_NUMBER, &set.preview.fov, NULL, "DEG", "horizontal field of view, 1...170 (default: 50)", 1,
         170, NULL},
        {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option output[] = {COMMON_OUTPUT(set.common), {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"Picture", picture},
                                   {"Light", light},
                                   {"View", view},
                                   {"Input", input},
                                   {"Output", output},
                                   {"Running", running},
                                   {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status))
        return status;
    status = settings_ok(&set) ? draw(&set, &rest) : EXIT_USAGE;
    arguments_free(&rest);
    return status;
}

const command command_preview = {
    "preview", "draw a raster: hillshade, or a perspective", "RASTER... -o PICTURE.png",
    INPUT_NOTES "\n\nVoids are transparent.\n\n"
                "Examples: talus preview terrain.exr -o look.png\n"
                "          talus preview terrain.exr --eye -84.3,36.4,3000 --target -84.2,36.5,400 -o view.png",
    run};
