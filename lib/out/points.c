/* Characteristic points as text and as PLY. */
#include "lib/out/points.h"

#include "dem/crs.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/out.h"

#include <jansson.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>

enum { BATCH = 256, LINE = 512 };

static const struct {
    const char *ending;
    out_points_writer *write;
} writers[] = {{"geojson", out_points_geojson}, {"json", out_points_geojson}, {"csv", out_points_csv},
               {"ply", out_points_ply},         {"tif", out_points_geotiff},  {"tiff", out_points_geotiff}};

static const tl_points_options defaults;

/* ---- Points, one by one ---- */

/* A walk over the points and, beside them, the features. */
typedef struct walk {
    const tl_framework *framework;
    const tl_features *features;
    size_t word, point, feature;
    uint64_t left;
} walk;

typedef struct walked {
    tl_vertex at;
    unsigned kinds;
} walked;

static walk start_walk(const tl_framework *framework, const tl_features *features)
{
    return (walk){.framework = framework, .features = features, .left = framework->points[0]};
}

static unsigned kinds_of(walk *self, const tl_vertex *at)
{
    const tl_features *f = self->features;
    while (f && self->feature < f->count &&
           (f->items[self->feature].j < at->j ||
            (f->items[self->feature].j == at->j && f->items[self->feature].i < at->i)))
        self->feature++;
    if (!f || self->feature == f->count || f->items[self->feature].i != at->i || f->items[self->feature].j != at->j)
        return 0;
    return f->items[self->feature].kinds;
}

/* The next points, at most `most`; 0 behind the last. */
static size_t take_points(walk *self, walked *out, size_t most)
{
    const tl_framework *of = self->framework;
    size_t count = 0, words = of->words * (size_t)of->info.height;
    while (count < most && self->point < of->point_count) {
        while (!self->left && ++self->word < words)
            self->left = of->points[self->word];
        int32_t column = (int32_t)(self->word % of->words * 64) + __builtin_ctzll(self->left);
        walked *to = &out[count++];
        to->at = (tl_vertex){column, (int32_t)(self->word / of->words), of->heights[self->point++]};
        to->kinds = kinds_of(self, &to->at);
        self->left &= self->left - 1;
    }
    return count;
}

static void kinds_text(unsigned kinds, char text[64])
{
    static const char *const names[] = {"summit", "pit", "pass", "ridge", "valley"};
    size_t used = 0;
    text[0] = '\0';
    for (int k = 0; k < 5; k++)
        if (kinds >> k & 1)
            used += (size_t)snprintf(text + used, 64 - used, "%s%s", used ? " " : "", names[k]);
}

/* The shortest text of a height that reads back as this float. */
static void float_text(float value, char text[TL_NUMBER_TEXT])
{
    for (int digits = 6; digits <= 9; digits++) {
        snprintf(text, TL_NUMBER_TEXT, "%.*g", digits, (double)value);
        if (strtof(text, NULL) == value)
            return;
    }
}

static void coordinates_of(const tl_georef *georef, const tl_vertex *at, double *x, double *y)
{
    const double *t = georef->transform;
    *x = t[0] + t[1] * at->i + t[2] * at->j;
    *y = t[3] + t[4] * at->i + t[5] * at->j;
}

/* ---- CSV ---- */

tl_status out_points_csv(const tl_framework *framework, const tl_source *dem, tl_output *output,
                         const tl_points_options *options, tl_error *error)
{
    walk of = start_walk(framework, options->features);
    walked points[BATCH];
    const char *head = options->features ? "column,row,x,y,height,feature\n" : "column,row,x,y,height\n";
    tl_status status = tl_output_append(output, head, strlen(head), error);
    (void)dem;
    for (size_t n; status == TL_OK && (n = take_points(&of, points, BATCH)) > 0;) {
        for (size_t k = 0; status == TL_OK && k < n; k++) {
            char line[LINE], x[TL_NUMBER_TEXT], y[TL_NUMBER_TEXT], z[TL_NUMBER_TEXT], kinds[64];
            double at[2];
            coordinates_of(&framework->info.georef, &points[k].at, &at[0], &at[1]);
            tl_number_text(at[0], x);
            tl_number_text(at[1], y);
            float_text(points[k].at.z, z);
            kinds_text(points[k].kinds, kinds);
            int used = snprintf(line, LINE, "%d,%d,%s,%s,%s%s%s\n", points[k].at.i, points[k].at.j, x, y, z,
                                options->features ? "," : "", kinds);
            status = tl_output_append(output, line, (size_t)used, error);
        }
        if (status == TL_OK)
            status = tl_run_check(options->run, error);
    }
    return status;
}

/* ---- GeoJSON ---- */

/* RFC 7946 knows longitude and latitude in degrees and metres of height. Other coordinates, which its section 4 leaves
 * to those who have agreed on them, are written where they are asked for by name, with a member that tells them. */
typedef struct json_writer {
    const tl_framework *framework;
    bool lonlat, pixels;
    dem_projection *projection; /* NULL: coordinates are longitude and latitude already */
    tl_output *output;
    bool some;
} json_writer;

static tl_status write_feature(json_writer *self, const walked *point, const double at[2], tl_error *error)
{
    char line[LINE], x[TL_NUMBER_TEXT], y[TL_NUMBER_TEXT], z[TL_NUMBER_TEXT], kinds[64];
    double unit = self->lonlat ? self->framework->info.georef.height_unit : 1;
    if (self->lonlat) { /* a hundredth of a millimetre */
        snprintf(x, sizeof x, "%.10g", at[0]);
        snprintf(y, sizeof y, "%.10g", at[1]);
    } else {
        tl_number_text(at[0], x);
        tl_number_text(at[1], y);
    }
    if (unit == 1)
        float_text(point->at.z, z);
    else
        tl_number_text((double)point->at.z * unit, z);
    kinds_text(point->kinds, kinds);
    int used = snprintf(line, LINE,
                        "%s{\"type\":\"Feature\",\"geometry\":{\"type\":\"Point\",\"coordinates\":[%s,%s,%s]},"
                        "\"properties\":{\"column\":%d,\"row\":%d%s%s%s}}",
                        self->some ? ",\n" : "", x, y, z, point->at.i, point->at.j,
                        point->kinds ? ",\"feature\":\"" : "", kinds, point->kinds ? "\"" : "");
    self->some = true;
    return tl_output_append(self->output, line, (size_t)used, error);
}

static tl_status write_features(json_writer *self, const walked *points, size_t n, tl_error *error)
{
    const tl_georef *georef = &self->framework->info.georef;
    double x[BATCH], y[BATCH];
    for (size_t k = 0; k < n; k++) {
        coordinates_of(georef, &points[k].at, &x[k], &y[k]);
        if (self->pixels)
            x[k] = points[k].at.i, y[k] = points[k].at.j;
    }
    if (self->projection)
        dem_projection_to_lonlat(self->projection, n, x, y);
    for (size_t k = 0; k < n; k++) {
        const double at[2] = {x[k], y[k]};
        if (isnan(x[k]) || isnan(y[k]))
            return tl_fail(error, TL_ERROR_DATA, "%s: the point at column %d, row %d has no longitude and latitude",
                           tl_output_path(self->output), points[k].at.i, points[k].at.j);
        tl_status status = write_feature(self, &points[k], at, error);
        if (status != TL_OK)
            return status;
    }
    return TL_OK;
}

/* How the points were made, as a member of the collection; to be freed. */
static char *describe_record(const tl_framework *framework)
{
    tl_parameter *list = NULL;
    size_t count = 0;
    char bound[TL_NUMBER_TEXT];
    tl_number_text(tl_framework_max_error(framework), bound);
    json_t *record = json_object();
    bool good = tl_parameters_add_origin(&list, &count, &framework->info, NULL) == TL_OK &&
                tl_parameters_add(&list, &count, "max_error", bound, NULL) == TL_OK;
    for (size_t k = 0; good && k < count; k++)
        json_object_set_new(record, list[k].name, json_string(list[k].value));
    char *text = good ? json_dumps(record, JSON_COMPACT) : NULL;
    json_decref(record);
    free(list);
    return text;
}

static tl_status begin_json(json_writer *self, tl_error *error)
{
    const tl_crs *crs = self->framework->info.georef.crs;
    char head[LINE], name[200] = "";
    size_t used = 0;
    for (const char *c = crs && !self->pixels ? tl_crs_name(crs) : "columns and rows"; *c && used < 190; c++)
        if (*c != '"' && *c != '\\' && (unsigned char)*c >= ' ')
            name[used++] = *c;
    name[used] = '\0';
    int length = snprintf(head, LINE,
                          "{\"type\":\"FeatureCollection\"%s%s%s,\"talus\":", self->lonlat ? "" : ",\"coordinates\":\"",
                          self->lonlat ? "" : name, self->lonlat ? "" : "\"");
    char *record = describe_record(self->framework);
    if (!record)
        return tl_fail_memory(error, tl_output_path(self->output));
    tl_status status = tl_output_append(self->output, head, (size_t)length, error);
    if (status == TL_OK)
        status = tl_output_append(self->output, record, strlen(record), error);
    free(record);
    return status == TL_OK ? tl_output_append(self->output, ",\"features\":[\n", 14, error) : status;
}

tl_status out_points_geojson(const tl_framework *framework, const tl_source *dem, tl_output *output,
                             const tl_points_options *options, tl_error *error)
{
    const tl_georef *georef = &framework->info.georef;
    json_writer self = {.framework = framework,
                        .output = output,
                        .lonlat = options->frame == TL_FRAME_DEFAULT,
                        .pixels = options->frame == TL_FRAME_PIXEL};
    (void)dem;
    if (options->frame == TL_FRAME_ENU || options->frame == TL_FRAME_ECEF)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: GeoJSON has no local frames; use the default, projected or pixel",
                       tl_output_path(output));
    if (self.lonlat && (!georef->crs || !georef->located))
        return tl_fail(error, TL_ERROR_DATA,
                       "%s: GeoJSON is in longitude and latitude, and the CRS is not known; use the frame pixel or "
                       "projected",
                       tl_output_path(output));
    if (self.lonlat && !(self.projection = dem_projection_create(georef->crs, error)))
        return TL_ERROR_DATA;
    walk of = start_walk(framework, options->features);
    walked points[BATCH];
    tl_status status = begin_json(&self, error);
    for (size_t n; status == TL_OK && (n = take_points(&of, points, BATCH)) > 0;) {
        status = write_features(&self, points, n, error);
        if (status == TL_OK)
            status = tl_run_check(options->run, error);
    }
    dem_projection_destroy(self.projection);
    return status == TL_OK ? tl_output_append(output, "\n]}\n", 4, error) : status;
}

/* ---- PLY ---- */

tl_status out_points_ply(const tl_framework *framework, const tl_source *dem, tl_output *output,
                         const tl_points_options *options, tl_error *error)
{
    tl_mesh *mesh = tl_mesh_create(framework->point_count, 0, &framework->info, error);
    if (!mesh)
        return TL_ERROR_MEMORY;
    (void)dem;
    walk of = start_walk(framework, NULL);
    walked points[BATCH];
    size_t at = 0;
    for (size_t n; (n = take_points(&of, points, BATCH)) > 0;)
        for (size_t k = 0; k < n; k++)
            mesh->vertices[at++] = points[k].at;
    const tl_write_options writing = {.frame = options->frame, .run = options->run};
    tl_status status = out_ply_write(mesh, output, &writing, error);
    tl_mesh_destroy(mesh);
    return status;
}

/* ---- By the ending ---- */

tl_status tl_framework_save(const tl_framework *framework, const tl_source *dem, const char *path,
                            const tl_points_options *options, tl_error *error)
{
    const char *dot = strrchr(path, '.');
    out_points_writer *write = NULL;
    options = options ? options : &defaults;
    for (size_t k = 0; dot && k < sizeof writers / sizeof *writers; k++)
        if (strcasecmp(dot + 1, writers[k].ending) == 0)
            write = writers[k].write;
    if (!write)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: no format for points has this ending; use geojson, csv, ply or tif", path);
    tl_output *output = tl_output_open(path, options->overwrite, error);
    if (!output)
        return TL_ERROR_IO;
    tl_status status = write(framework, dem, output, options, error);
    if (status == TL_OK)
        return tl_output_commit(output, error);
    tl_output_abort(output);
    return status;
}
