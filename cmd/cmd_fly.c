#include "cmd/command.h"
#include "cmd/lod_options.h"
#include "cmd/picture_options.h"
#include "cmd/view_options.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MOST_FRAMES = 1000000, NAME = 4096 };

typedef struct settings {
    common common;
    view_options view; /* what goes before the path's own */
    lod_options lod;
    picture_options picture; /* of frames that are pictures */
    double shutter;          /* share of the time between frames in which it is open */
    int frame;
    int64_t frames; /* 0: by the path's times, or DEFAULT_FRAMES */
    double rate;
    bool json, csv, frames_given, measure;
} settings;

enum { DEFAULT_FRAMES = 250 };

/* ---- The path ---- */

typedef struct flight {
    tl_view *views;
    size_t count;
} flight;

static size_t frame_count(const settings *set, const tl_view_key *keys, size_t count)
{
    if (set->frames_given)
        return (size_t)set->frames;
    double seconds = keys[count - 1].time - keys[0].time;
    return isnan(seconds) ? DEFAULT_FRAMES : (size_t)fmin(floor(seconds * set->rate + 1e-9) + 1, MOST_FRAMES);
}

static tl_status read_path(const settings *set, flight *out, tl_error *error)
{
    tl_view_key *keys = NULL;
    size_t count = 0;
    tl_status status = tl_view_path_read(set->view.camera, &keys, &count, error);
    if (status != TL_OK)
        return status;
    for (size_t k = 0; k < count; k++)
        view_options_apply(&set->view, &keys[k].view);
    out->count = frame_count(set, keys, count);
    out->views = calloc(out->count, sizeof *out->views);
    if (out->views)
        status = tl_view_path_sample(keys, count, out->count, out->views, error);
    else {
        error->status = status = TL_ERROR_MEMORY;
        snprintf(error->text, sizeof error->text, "%s: not enough memory for its frames", set->view.camera);
    }
    free(keys);
    return status;
}

/* ---- Frames ---- */

/* Whether a name has one number in it, as %d or %04d, and no other %. */
static bool is_pattern(const char *name)
{
    const char *percent = strchr(name, '%');
    if (!percent || strchr(percent + 1, '%'))
        return false;
    const char *at = percent + 1;
    while (*at >= '0' && *at <= '9')
        at++;
    return *at == 'd' && at - percent <= 4;
}

/* The pattern with its number; written here, as it comes from outside. */
static bool frame_name(const char *pattern, size_t frame, char name[NAME])
{
    const char *percent = strchr(pattern, '%');
    int width = atoi(percent + 1), zero = percent[1] == '0';
    const char *rest = strchr(percent, 'd') + 1;
    int written = zero ? snprintf(name, NAME, "%.*s%0*zu%s", (int)(percent - pattern), pattern, width, frame, rest)
                       : snprintf(name, NAME, "%.*s%*zu%s", (int)(percent - pattern), pattern, width, frame, rest);
    return written > 0 && written < NAME;
}

/* What is kept over the frames. */
typedef struct journey {
    const settings *set;
    const lod_ground *ground;
    const flight *path;
    const tl_run *run;
    tl_roam *roam;            /* NULL: frames start from nothing */
    tl_view_painter *painter; /* NULL: frames are no pictures */
    json_t *list;             /* statistics; NULL: not wanted */
    tl_mesh *before;          /* of the frame before, where shifts are measured; else NULL */
    double largest;           /* shift in all frames, pixels */
} journey;

static bool draws_pictures(const settings *set)
{
    return set->common.output && picture_is_png(set->common.output);
}

/* The views of a frame while the shutter is open: its own, and some of those on the way to the next. */
enum { OPEN_VIEWS = 9, FINE = 64 };
static tl_status views_of_frame(const journey *j, size_t frame, tl_view out[OPEN_VIEWS], size_t *count, tl_error *error)
{
    out[0] = j->path->views[frame];
    *count = 1;
    if (!(j->set->shutter > 0) || frame + 1 >= j->path->count)
        return TL_OK;
    const tl_view_key ends[2] = {{0, out[0]}, {1, j->path->views[frame + 1]}};
    tl_view fine[FINE + 1];
    tl_status status = tl_view_path_sample(ends, 2, FINE + 1, fine, error);
    for (int k = 0; k < OPEN_VIEWS && status == TL_OK; k++)
        out[k] = fine[(int)floor(j->set->shutter * FINE * k / (OPEN_VIEWS - 1) + 0.5)];
    *count = OPEN_VIEWS;
    return status;
}

/* The view that triangles are chosen for: with the shutter open a sixteenth more on each side, for what comes in from
 * there. */
static tl_view view_for_mesh(const settings *set, const tl_view *view)
{
    const double degree = 3.14159265358979323846 / 180, wider = 1.125;
    tl_view wide = *view;
    if (!(set->shutter > 0) || !draws_pictures(set))
        return wide;
    int width = view->width ? view->width : 1920, height = view->height ? view->height : 1080;
    double across = tan((view->fov > 0 ? view->fov : 60) / 2 * degree) * wider;
    wide.fov = fmin(2 * atan(across) / degree, 179);
    wide.width = (int)fmin(ceil(width * wider), 32768);
    wide.height = (int)fmin(ceil(height * wider), 32768);
    return wide;
}

static tl_status draw_frame(const journey *j, const tl_mesh *mesh, size_t frame, const char *name, tl_error *error)
{
    tl_view views[OPEN_VIEWS];
    size_t count;
    tl_status status = views_of_frame(j, frame, views, &count, error);
    return status == TL_OK ? tl_view_painter_write(j->painter, mesh, views, count, name, error) : status;
}

static tl_status write_frame(const journey *j, const tl_mesh *mesh, size_t frame, tl_error *error)
{
    char name[NAME];
    tl_write_options writing = {.overwrite = j->set->common.overwrite,
                                .frame = (tl_frame)j->set->frame,
                                .ground = j->ground->field,
                                .texture_size = (int)j->set->common.texture_size,
                                .run = j->run};
    command_textures(&j->set->common, &writing.textures);
    if (frame_name(j->set->common.output, frame, name))
        return draws_pictures(j->set) ? draw_frame(j, mesh, frame, name, error)
                                      : tl_write_mesh(mesh, name, &writing, error);
    error->status = TL_ERROR_ARGUMENT;
    snprintf(error->text, sizeof error->text, "%.200s: the frames' names are too long", j->set->common.output);
    return error->status;
}

/* How far this frame's triangles, in place of those of the frame before, shift the ground that both have. */
static tl_status measure_shift(journey *j, tl_mesh **mesh, const tl_view *view, tl_view_errors *out, tl_error *error)
{
    tl_view_report report = {0};
    tl_run quiet = *j->run;
    quiet.progress = NULL;
    tl_status status = TL_OK;
    if (j->before)
        status = tl_view_measure(j->before, *mesh, j->ground->opened.source, view, &quiet, &report, error);
    tl_mesh_destroy(j->before);
    j->before = *mesh;
    *mesh = NULL;
    *out = report.parallax;
    j->largest = fmax(j->largest, out->largest);
    return status;
}

static tl_status fly_frame(journey *j, const tl_view *view, size_t frame, tl_lod_stats *stats, tl_view_errors *shift,
                           tl_error *error)
{
    const bool draws = j->set->common.output || j->set->measure;
    const lod_ground *g = j->ground;
    const tl_view wide = view_for_mesh(j->set, view);
    tl_mesh *mesh = NULL;
    tl_status status;
    if (j->roam) {
        status = tl_roam_look(j->roam, &wide, stats, error);
        if (status == TL_OK && draws)
            status = tl_roam_mesh(j->roam, &mesh, error);
    } else
        status = tl_select(g->field, g->opened.source, g->pyramid, &wide, &j->set->lod.lod, &mesh, stats, error);
    if (status == TL_OK && j->set->common.output)
        status = write_frame(j, mesh, frame, error);
    if (status == TL_OK && j->set->measure)
        status = measure_shift(j, &mesh, view, shift, error);
    tl_mesh_destroy(mesh);
    return status;
}

static void tell_frame(const journey *j, size_t frame, const tl_lod_stats *s, const tl_view_errors *shift)
{
    if (j->list) {
        json_t *item = lod_stats_json(s);
        json_object_set_new(item, "frame", json_integer((json_int_t)frame));
        if (j->set->measure)
            json_object_set_new(item, "shift", view_errors_json(shift));
        json_array_append_new(j->list, item);
    }
    if (!j->set->csv)
        return;
    if (!frame)
        printf("frame,triangles,vertices,visited,split,merged,tiles_made,samples_made,dem_blocks,finest_level,"
               "pixel_error,seconds%s\n",
               j->set->measure ? ",shift" : "");
    printf("%zu,%llu,%llu,%llu,%llu,%llu,%llu,%llu,%llu,%d,%.6g,%.6f", frame, (unsigned long long)s->triangles,
           (unsigned long long)s->vertices, (unsigned long long)s->visited, (unsigned long long)s->split,
           (unsigned long long)s->merged, (unsigned long long)s->tiles_made, (unsigned long long)s->samples_made,
           (unsigned long long)s->dem_blocks, s->finest_level, s->pixel_error, s->seconds);
    if (j->set->measure)
        printf(",%.6g", shift->largest);
    putchar('\n');
}

static void report(const settings *set, size_t frames, double first, double others, uint64_t triangles)
{
    double steady = frames > 1 ? others / (double)(frames - 1) : 0;
    command_say(&set->common, "%zu frames, %.0f triangles each; %.4f s for the first, %.4f s for each of the others",
                frames, (double)triangles / (double)frames, first, steady);
}

static int fly_all(journey *j, const flight *path, progress *bar)
{
    tl_error error;
    double first = 0, others = 0;
    uint64_t triangles = 0, under = 0;
    for (size_t k = 0; k < path->count; k++) {
        tl_lod_stats stats;
        tl_view_errors shift = {0};
        if (fly_frame(j, &path->views[k], k, &stats, &shift, &error) != TL_OK)
            return command_failed(bar, &error);
        tell_frame(j, k, &stats, &shift);
        if (stats.above_ground < 0 && !under++)
            lod_warn_of_ground(&j->set->common, &stats);
        *(k ? &others : &first) += stats.seconds;
        triangles += stats.triangles;
        if (j->run->progress)
            j->run->progress(j->run->user, k + 1, path->count);
    }
    progress_end(bar);
    report(j->set, path->count, first, others, triangles);
    if (j->set->measure)
        command_say(&j->set->common,
                    "measured: from frame to frame new triangles shift no ground by more than %.3g pixels", j->largest);
    return EXIT_DONE;
}

static bool open_journey(journey *j, tl_error *error)
{
    const settings *set = j->set;
    const tl_source *dem = j->ground->opened.source;
    bool ready = true;
    if (set->lod.lod.selector == TL_SELECTOR_ROAM)
        ready = (j->roam = tl_roam_create(j->ground->field, dem, j->ground->pyramid, &set->lod.lod, error)) != NULL;
    tl_view_picture_options look = set->picture.look;
    look.overwrite = set->common.overwrite;
    look.run = j->run;
    if (ready && draws_pictures(set))
        ready = (j->painter = tl_view_painter_create(dem, &look, error)) != NULL;
    return ready;
}

static int start(const settings *set, const lod_ground *ground, const flight *path, const tl_run *run, progress *bar)
{
    tl_error error;
    journey j = {.set = set, .ground = ground, .path = path, .run = run};
    if (!open_journey(&j, &error)) {
        tl_roam_destroy(j.roam);
        return command_failed(bar, &error);
    }
    j.list = set->json ? json_array() : NULL;
    progress_stage(bar, "flying");
    int status = fly_all(&j, path, bar);
    tl_roam_destroy(j.roam);
    tl_view_painter_destroy(j.painter);
    tl_mesh_destroy(j.before);
    if (status == EXIT_DONE && j.list) {
        json_t *root = json_pack("{s:O}", "frames", j.list);
        if (json_dumpf(root, stdout, JSON_INDENT(2)) == 0)
            putchar('\n');
        json_decref(root);
    }
    json_decref(j.list);
    return status == EXIT_DONE ? command_done() : status;
}

static int fly(settings *set, const arguments *inputs)
{
    progress bar;
    tl_error error;
    tl_run run = command_run(&set->common, &bar);
    lod_ground ground;
    flight path = {0};
    progress_stage(&bar, "measuring");
    if (read_path(set, &path, &error) != TL_OK || lod_ground_open(&set->common, &set->lod, inputs, (tl_frame)set->frame,
                                                                  set->common.output, &run, &ground, &error) != TL_OK) {
        free(path.views);
        return command_failed(&bar, &error);
    }
    if (set->shutter > 0 && draws_pictures(set)) /* what one view's ridges hide, the next ones see */
        set->lod.lod.keep |= TL_CULL_RIDGE | TL_CULL_BACK | TL_CULL_HORIZON;
    int status = start(set, &ground, &path, &run, &bar);
    lod_ground_close(&ground);
    free(path.views);
    return status;
}

static bool settings_ok(settings *set)
{
    if (!set->view.camera) {
        complain("a path is wanted: --path (or --camera) with a file of several views");
        return false;
    }
    if (!view_options_ok(&set->view) || !lod_options_ok(&set->lod) || !picture_options_ok(&set->picture))
        return false;
    if (set->json && set->csv) {
        complain("--json and --csv both go to standard output; give one");
        return false;
    }
    if (set->common.output && !is_pattern(set->common.output)) {
        complain("-o: a name with the frame's number in it is wanted, as frame%%04d.glb, not '%s'", set->common.output);
        return false;
    }
    unsigned textures;
    return (!set->common.output || draws_pictures(set) || command_output_ok(&set->common, false, true)) &&
           command_textures(&set->common, &textures);
}

static int run(const command *self, int argc, const char **argv, command_help help)
{
    settings set = {.lod = {.levels = 6, .selector = TL_SELECTOR_ROAM}, .rate = 25};
    const option flying[] = {
        {"path", 0, OPTION_TEXT, &set.view.camera, NULL, "FILE",
         "keyframes: a JSON of views, or a glTF of cameras; see talus(1)", 0, 0, NULL},
        {"frames", 0, OPTION_INTEGER, &set.frames, &set.frames_given, "N",
         "frames from the first view to the last, 1...1e6 (default: by the views' times; 250 without)", 1, MOST_FRAMES,
         NULL},
        {"fps", 0, OPTION_NUMBER, &set.rate, NULL, "R",
         "frames a second of the views' times, 0.01...1000 (default: 25)", .01, 1000, NULL},
        {0}};
    const option place[] = {VIEW_OPTIONS(set.view), {0}};
    const option depth[] = {LOD_OPTIONS(set.lod), {0}};
    const option detail[] = {DETAIL_OPTIONS(set.lod), {0}};
    const option look[] = {LOOK_OPTIONS(set.picture),
                           {"shutter", 0, OPTION_NUMBER, &set.shutter, NULL, "SHARE",
                            "of the time to the next frame that a picture takes: motion blur, 0...1 (default: 0)", 0, 1,
                            NULL},
                           {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option output[] = {
        COMMON_OUTPUT(set.common),
        TEXTURE_OPTIONS(set.common),
        {"frame", 0, OPTION_CHOICE, &set.frame, NULL, "FRAME",
         "coordinates of the meshes (default: enu where the CRS is known)", 0, 0, frame_names},
        {"json", 0, OPTION_FLAG, &set.json, NULL, NULL, "print each frame's statistics as JSON", 0, 0, NULL},
        {"measure", 0, OPTION_FLAG, &set.measure, NULL, NULL,
         "tell how far, in pixels, new triangles shift ground from frame to frame", 0, 0, NULL},
        {"csv", 0, OPTION_FLAG, &set.csv, NULL, NULL, "print them as a table", 0, 0, NULL},
        {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"Flight", flying}, {"View", place},      {"Depth", depth},
                                   {"Detail", detail}, {"Pictures", look},   {"Input", input},
                                   {"Output", output}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status))
        return status;
    status = settings_ok(&set) ? fly(&set, &rest) : EXIT_USAGE;
    arguments_free(&rest);
    return status;
}

const command command_fly = {
    "fly", "choose the triangles of every frame of a flight", "DEM... --path FILE [-o FRAME%04d.glb]",
    "Views between the keyframes lie on a smooth curve: at their times, or, without times, at constant speed. With\n"
    "roam, the default, a frame costs what has changed since the one before. Frames are meshes, .glb, .obj, .ply, "
    ".stl,\n"
    "or pictures, .png. Nothing is written without -o.\n\n" INPUT_NOTES "\n\n"
    "Example: talus fly dem.tif --path keyframes.json --frames 300 --csv",
    run};
