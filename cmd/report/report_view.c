/* The fourth section: pixels asked for and found, by selector; a flight; and what a scene does not need. */
#include "cmd/report/report.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum { MOST_TRIANGLES = 12000000, LEVELS = 4, FRAMES_QUICK = 12, FRAMES = 60, RUNS = 3 };
static const char *const selectors[] = {"quadtree", "chunk", "roam"};

/* A scene: a model, what is made below it, and where the eye stands. */
typedef struct scene {
    const tl_source *dem;
    tl_source *field;
    tl_pyramid *pyramid;
    tl_view view;
    tl_mesh *reference; /* at a quarter of a pixel */
} scene;

/* ---- The scene ---- */

/* Of the row nearest to the middle that has valid samples the one nearest to the middle column. */
static tl_status find_stand(const report *self, int64_t *i, int64_t *j, tl_error *error)
{
    const tl_source_info *info = &self->dem->info;
    float *row = malloc((size_t)info->width * sizeof *row);
    tl_status status = TL_OK;
    if (!row) {
        error->status = status = TL_ERROR_MEMORY;
        snprintf(error->text, sizeof error->text, "the report: not enough memory for a row");
    }
    for (int64_t k = 0; k < 2 * info->height && status == TL_OK; k++) {
        int64_t y = info->height / 2 + (k & 1 ? -(k + 1) / 2 : k / 2);
        if (y < 0 || y >= info->height)
            continue;
        if (self->run->cancel && *self->run->cancel) {
            error->status = TL_ERROR_CANCELLED;
            error->text[0] = 0;
        }
        status = self->run->cancel && *self->run->cancel
                     ? TL_ERROR_CANCELLED
                     : tl_source_read(self->dem, 0, (tl_window){0, y, info->width, 1}, row, error);
        for (int64_t m = 0; m < 2 * info->width && status == TL_OK; m++) {
            int64_t x = info->width / 2 + (m & 1 ? -(m + 1) / 2 : m / 2);
            if (x >= 0 && x < info->width && !isnan(row[x])) {
                *i = x, *j = y;
                free(row);
                return TL_OK;
            }
        }
    }
    free(row);
    if (status != TL_OK)
        return status;
    error->status = TL_ERROR_DATA;
    snprintf(error->text, sizeof error->text, "%.200s: has no height to look from", info->name);
    return TL_ERROR_DATA;
}

static tl_status place_eye(const report *self, tl_view *out, tl_error *error)
{
    int64_t i = 0, j = 0;
    const tl_georef *at = &self->dem->info.georef;
    tl_status status = find_stand(self, &i, &j, error);
    if (status != TL_OK)
        return status;
    double x = (double)i, y = (double)j;
    *out = (tl_view){.above_ground = true, .pitch = -5, .fov = 60};
    out->width = self->quick ? 960 : 1920;
    out->height = self->quick ? 540 : 1080;
    if (at->crs && at->located)
        status = tl_georef_to_lonlat(at, 1, &x, &y, error);
    else
        y = -y;
    out->eye[0] = x, out->eye[1] = y;
    /* some cells up: a plain, a hill or a country has a view of its own size */
    out->eye[2] = fmax(2, 10 * sqrt(at->cell_x * at->cell_y));
    return status;
}

static tl_status open_scene(const report *self, scene *out, tl_error *error)
{
    tl_field_options below = {.levels = LEVELS, .support = TL_SUPPORT_POINT, .run = self->run};
    tl_pyramid_options errors = {.frame = TL_FRAME_PROJECTED, .run = self->run};
    *out = (scene){.dem = self->dem};
    tl_status status = place_eye(self, &out->view, error);
    if (status == TL_OK && !(out->field = tl_field_create(self->dem, &below, error)))
        status = error->status;
    if (status == TL_OK && !(out->pyramid = tl_pyramid_create(self->dem, &errors, error)))
        status = error->status;
    tl_lod_options finest = {.pixel_error = .25, .budget = MOST_TRIANGLES, .run = self->run};
    if (status == TL_OK)
        status = tl_select(out->field, out->dem, out->pyramid, &out->view, &finest, &out->reference, NULL, error);
    return status;
}

static void close_scene(scene *self)
{
    tl_mesh_destroy(self->reference);
    tl_pyramid_destroy(self->pyramid);
    tl_source_destroy(self->field);
}

/* ---- Pixels asked for and found ---- */

static tl_status add_view(const report *self, const scene *s, tl_selector selector, double asked, json_t *table,
                          tl_error *error)
{
    tl_lod_options options = {.selector = selector, .pixel_error = asked, .budget = MOST_TRIANGLES, .run = self->run};
    tl_mesh *mesh = NULL;
    tl_lod_stats stats;
    tl_view_report found;
    measured milliseconds = {.count = 0};
    tl_status status = TL_OK;
    for (int k = 0; k < RUNS && status == TL_OK; k++) {
        tl_mesh_destroy(mesh);
        mesh = NULL;
        status = tl_select(s->field, s->dem, s->pyramid, &s->view, &options, &mesh, &stats, error);
        measured_add(&milliseconds, 1e3 * stats.seconds);
    }
    if (status == TL_OK)
        status = tl_view_measure(mesh, s->reference, s->dem, &s->view, self->run, &found, error);
    if (status == TL_OK) {
        json_t *row = report_row(table);
        report_text(row, "selector", selectors[selector]);
        report_number(row, "asked", asked);
        report_number(row, "half", found.parallax.half);
        report_number(row, "ninety_nine", found.parallax.ninety_nine);
        report_number(row, "thousand", found.parallax.thousand);
        report_number(row, "largest", found.parallax.largest);
        report_number(row, "samples", (double)found.parallax.count);
        report_number(row, "edges", found.silhouette.thousand);
        report_number(row, "triangles", (double)stats.triangles);
        report_number(row, "tiles", (double)stats.tiles_made);
        report_measured(row, "milliseconds", &milliseconds);
        report_text(row, "verdict", found.parallax.thousand <= asked ? "kept" : "failed");
    }
    tl_mesh_destroy(mesh);
    return status;
}

static tl_status add_views(const report *self, const scene *s, json_t *section, tl_error *error)
{
    static const double asked[] = {4, 2, 1};
    char note[384];
    snprintf(
        note, sizeof note,
        "%d x %d pixels, 60 degrees, northwards, from %.0f m above the ground at %.6g, %.6g, up to %d levels below the "
        "samples. Found: how far each pixel's ground is shifted against the same view at a quarter of a pixel. Times "
        "are those of choosing the triangles, with all threads.",
        s->view.width, s->view.height, s->view.eye[2], s->view.eye[0], s->view.eye[1], LEVELS);
    json_t *table = report_table(section, "selectors", "Pixels asked for and found", note);
    report_column(table, "selector", "selector", "");
    report_column(table, "asked", "asked", "pixels");
    report_column(table, "half", "50 %", "pixels");
    report_column(table, "ninety_nine", "99 %", "pixels");
    report_column(table, "thousand", "99.9 %", "pixels");
    report_column(table, "largest", "largest", "pixels");
    report_column(table, "samples", "pixels compared", "");
    report_column(table, "edges", "silhouettes, 99.9 %", "pixels");
    report_column(table, "triangles", "triangles", "");
    report_column(table, "tiles", "tiles synthesised", "");
    report_column(table, "milliseconds", "time", "ms");
    report_column(table, "verdict", "99.9 % within what was asked", "");
    tl_status status = TL_OK;
    for (int selector = 0; selector < 3; selector++)
        for (size_t k = 0; k < sizeof asked / sizeof *asked && status == TL_OK; k++)
            status = add_view(self, s, (tl_selector)selector, asked[k], table, error);
    report_add_plot(table, &(report_plot){"view_error", "Error found (99.9 %), by triangles", "triangles", "thousand",
                                          "selector", true, true, false});
    report_add_plot(table, &(report_plot){"view_time", "Error found (99.9 %), by time", "milliseconds", "thousand",
                                          "selector", true, true, false});
    return status;
}

/* ---- A flight ---- */

static void add_frame(json_t *table, size_t frame, const tl_lod_stats *stats)
{
    json_t *row = report_row(table);
    report_number(row, "frame", (double)frame);
    report_number(row, "triangles", (double)stats->triangles);
    report_number(row, "visited", (double)stats->visited);
    report_number(row, "split", (double)stats->split);
    report_number(row, "merged", (double)stats->merged);
    report_number(row, "tiles", (double)stats->tiles_made);
    report_number(row, "milliseconds", 1e3 * stats->seconds);
}

static tl_status add_flight(const report *self, const scene *s, json_t *section, tl_error *error)
{
    json_t *table =
        report_table(section, "flight", "A flight by roam",
                     "A hundredth of the height and 0.1 degrees a frame. The first frame is made from nothing, the "
                     "others from the one before.");
    report_column(table, "frame", "frame", "");
    report_column(table, "triangles", "triangles", "");
    report_column(table, "visited", "nodes looked at", "");
    report_column(table, "split", "split", "");
    report_column(table, "merged", "merged", "");
    report_column(table, "tiles", "tiles synthesised", "");
    report_column(table, "milliseconds", "time", "ms");
    tl_lod_options options = {.pixel_error = 1, .run = self->run};
    tl_roam *roam = tl_roam_create(s->field, s->dem, s->pyramid, &options, error);
    if (!roam)
        return error->status;
    tl_view view = s->view;
    bool degrees = s->dem->info.georef.crs && s->dem->info.georef.located;
    double step = .01 * view.eye[2] *
                  (degrees ? fabs(s->dem->info.georef.transform[5]) / s->dem->info.georef.cell_y
                           : 1 / s->dem->info.georef.cell_y);
    size_t frames = self->quick ? FRAMES_QUICK : FRAMES;
    tl_status status = TL_OK;
    for (size_t k = 0; k < frames && status == TL_OK; k++) {
        tl_lod_stats stats;
        status = tl_roam_look(roam, &view, &stats, error);
        if (status == TL_ERROR_DATA || (status == TL_ERROR_ARGUMENT && k)) { /* the rim, or a void */
            status = TL_OK;
            break;
        }
        if (status == TL_OK)
            add_frame(table, k, &stats);
        view.eye[1] += step;
        view.heading += .1;
    }
    tl_roam_destroy(roam);
    report_add_plot(table,
                    &(report_plot){"flight_time", "Time a frame", "frame", "milliseconds", NULL, false, true, false});
    return status;
}

/* ---- What a scene does not need ---- */

static tl_status add_scene(const report *self, const scene *s, const char *name, unsigned keep, json_t *table,
                           tl_error *error)
{
    tl_lod_options options = {.pixel_error = 1, .budget = MOST_TRIANGLES, .keep = keep, .run = self->run};
    tl_mesh *mesh = NULL;
    tl_lod_stats stats;
    tl_status status = tl_select(s->field, s->dem, s->pyramid, &s->view, &options, &mesh, &stats, error);
    tl_mesh_destroy(mesh);
    if (status == TL_ERROR_MEMORY) { /* what is left out is what makes it fit */
        json_t *row = report_row(table);
        report_text(row, "rules", name);
        report_text(row, "remark", error->text);
        return TL_OK;
    }
    if (status != TL_OK)
        return status;
    json_t *row = report_row(table);
    report_text(row, "rules", name);
    report_number(row, "blocks", (double)stats.dem_blocks);
    report_number(row, "read", (double)stats.dem_samples);
    report_number(row, "tiles", (double)stats.tiles_made);
    report_number(row, "synthesised", (double)stats.samples_made);
    report_number(row, "written", (double)stats.triangles);
    report_number(row, "beside", (double)stats.culled[0]);
    report_number(row, "away", (double)stats.culled[1]);
    report_number(row, "horizon", (double)stats.culled[2]);
    report_number(row, "ridges", (double)stats.culled[3]);
    report_number(row, "milliseconds", 1e3 * stats.seconds);
    return TL_OK;
}

static tl_status add_scenes(const report *self, const scene *s, json_t *section, tl_error *error)
{
    static const struct {
        const char *name;
        unsigned keep;
    } cases[] = {{"all rules", 0},
                 {"what is beside the screen is kept", TL_CULL_FRUSTUM},
                 {"what looks away is kept", TL_CULL_BACK},
                 {"what is behind the horizon is kept", TL_CULL_HORIZON},
                 {"what is behind ridges is kept", TL_CULL_RIDGE},
                 {"everything is kept", TL_CULL_FRUSTUM | TL_CULL_BACK | TL_CULL_HORIZON | TL_CULL_RIDGE}};
    json_t *table = report_table(section, "left_out", "What the scene does not need",
                                 "The same view at a pixel, with each rule that leaves ground out switched off: what "
                                 "was read of the model, made below "
                                 "its samples, and written as triangles; and how many nodes each rule left out before "
                                 "anything below them was read or "
                                 "made. The picture is the same in all rows.");
    report_column(table, "rules", "scene", "");
    report_column(table, "blocks", "blocks read", "");
    report_column(table, "read", "samples of windows read", "");
    report_column(table, "tiles", "tiles synthesised", "");
    report_column(table, "synthesised", "samples synthesised", "");
    report_column(table, "written", "triangles", "");
    report_column(table, "beside", "left out beside the screen", "nodes");
    report_column(table, "away", "looking away", "nodes");
    report_column(table, "horizon", "behind the horizon", "nodes");
    report_column(table, "ridges", "behind ridges", "nodes");
    report_column(table, "milliseconds", "time", "ms");
    report_column(table, "remark", "remark", "");
    tl_status status = TL_OK;
    for (size_t k = 0; k < sizeof cases / sizeof *cases && status == TL_OK; k++)
        status = add_scene(self, s, cases[k].name, cases[k].keep, table, error);
    double all = ((double)self->dem->info.width - 1) * ((double)self->dem->info.height - 1) * pow(4, LEVELS);
    json_t *row = report_row(table);
    report_text(row, "rules", "the whole field at its finest level");
    report_number(row, "read", (double)self->dem->info.width * (double)self->dem->info.height);
    report_number(row, "synthesised", all);
    report_number(row, "written", 2 * all);
    return status;
}

tl_status report_view(report *self, tl_error *error)
{
    json_t *section =
        report_section(self, "view", "View: the error in the picture, a flight, and what is left out",
                       "What an eye in the middle of the model sees, refined as far as its pixels ask for.");
    scene s;
    progress_stage(self->bar, "report: view");
    tl_status status = open_scene(self, &s, error);
    if (status == TL_OK)
        status = add_views(self, &s, section, error);
    if (status == TL_OK)
        status = add_flight(self, &s, section, error);
    if (status == TL_OK)
        status = add_scenes(self, &s, section, error);
    close_scene(&s);
    return status;
}
