#include "cmd/command.h"
#include "cmd/json_info.h"
#include "cmd/mesh_info.h"

#include <jansson.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MEMORY = 64 }; /* megabytes */

typedef struct settings {
    common common;
    bool json;
} settings;

enum { MAX_OVERVIEWS = 64 };

typedef struct facts {
    const tl_source_info *info;
    tl_dem_details details; /* of a GeoTIFF only */
    bool has_details;
    const tl_source *source; /* the files as they are */
    tl_range range;
    tl_roughness roughness;
    tl_suspect suspects[TL_MAX_SUSPECTS];
    size_t suspect_count;
    tl_dem_size overviews[MAX_OVERVIEWS];
    unsigned overview_count;
    bool has_bounds;
    double bounds[4];                    /* degrees */
    double corner_lon[4], corner_lat[4]; /* from the first of the first row clockwise */
    bool has_window;
    tl_window window;
    tl_dem_cost cost; /* of the window, where it can be told */
    bool has_cost;
} facts;

/* CRS coordinates of the footprint: cells for area rasters, samples for points. */
static void extent(const tl_source_info *info, double low[2], double high[2])
{
    double margin = info->type == TL_RASTER_AREA ? 0.5 : 0;
    const double *t = info->georef.transform;
    low[0] = low[1] = (double)INFINITY;
    high[0] = high[1] = -(double)INFINITY;
    for (int corner = 0; corner < 4; corner++) {
        double i = corner & 1 ? (double)info->width - 1 + margin : -margin;
        double j = corner & 2 ? (double)info->height - 1 + margin : -margin;
        for (int k = 0; k < 2; k++) {
            double value = t[3 * k] + t[3 * k + 1] * i + t[3 * k + 2] * j;
            low[k] = fmin(low[k], value);
            high[k] = fmax(high[k], value);
        }
    }
}

static json_t *number(double value)
{
    return isfinite(value) ? json_real(value) : json_null();
}

/* JSON is UTF-8, names of files are any bytes: those beyond ASCII become '?' where they are not UTF-8. */
static json_t *string(const char *text)
{
    json_t *value = json_string(text);
    char *copy = value ? NULL : strdup(text);
    if (!copy)
        return value;
    for (char *c = copy; *c; c++)
        if ((unsigned char)*c >= 0x80)
            *c = '?';
    value = json_string(copy);
    free(copy);
    return value;
}

/* Corners of the footprint, in place of sample positions; NaN where they have no longitude and latitude. */
static tl_status find_corners(facts *f, tl_error *error)
{
    const tl_source_info *info = f->info;
    double margin = info->type == TL_RASTER_AREA ? 0.5 : 0;
    double right = (double)info->width - 1 + margin, bottom = (double)info->height - 1 + margin;
    const double i[4] = {-margin, right, right, -margin}, j[4] = {-margin, -margin, bottom, bottom};
    memcpy(f->corner_lon, i, sizeof i);
    memcpy(f->corner_lat, j, sizeof j);
    tl_status status = tl_georef_to_lonlat(&info->georef, 4, f->corner_lon, f->corner_lat, error);
    for (int k = 0; k < 4 && status != TL_OK; k++)
        f->corner_lon[k] = f->corner_lat[k] = (double)NAN;
    return status;
}

static void add_degrees(json_t *object, const facts *f)
{
    json_t *corners = json_array(), *bounds = f->has_bounds ? json_array() : json_null();
    for (int k = 0; k < 4; k++) {
        json_array_append_new(corners, json_pack("[o,o]", number(f->corner_lon[k]), number(f->corner_lat[k])));
        if (f->has_bounds)
            json_array_append_new(bounds, number(f->bounds[k]));
    }
    json_object_set_new(object, "extent_degrees", bounds);
    json_object_set_new(object, "corners_degrees", corners);
}

static json_t *code_json(int epsg)
{
    return epsg ? json_integer(epsg) : json_null();
}

static json_t *crs_json(const tl_crs *crs)
{
    const char *vertical = tl_crs_vertical_name(crs);
    json_t *heights =
        !*vertical ? json_null()
                   : json_pack("{s:o, s:o}", "name", string(vertical), "epsg", code_json(tl_crs_vertical_epsg(crs)));
    return json_pack("{s:o, s:o, s:b, s:o, s:o}", "name", string(tl_crs_name(crs)), "epsg", code_json(tl_crs_epsg(crs)),
                     "geographic", tl_crs_is_geographic(crs), "vertical", heights, "wkt", string(tl_crs_wkt(crs)));
}

static json_t *georef_json(const facts *f)
{
    const tl_source_info *info = f->info;
    const tl_georef *g = &info->georef;
    double low[2], high[2];
    extent(info, low, high);
    json_t *transform = json_array();
    for (int k = 0; k < 6; k++)
        json_array_append_new(transform, json_real(g->transform[k]));
    json_t *object =
        json_pack("{s:b, s:o, s:[o,o,o,o], s:[o,o], s:o}", "located", g->located, "sample_transform", transform,
                  "extent", number(low[0]), number(low[1]), number(high[0]), number(high[1]), "cell_metres",
                  number(g->cell_x), number(g->cell_y), "height_unit_metres", number(g->height_unit));
    add_degrees(object, f);
    json_object_set_new(object, "crs", g->crs ? crs_json(g->crs) : json_null());
    return object;
}

static json_t *file_json(const facts *f)
{
    const tl_dem_details *d = &f->details;
    json_t *sizes = json_array();
    for (unsigned k = 0; k < f->overview_count; k++)
        json_array_append_new(
            sizes, json_pack("[I,I]", (json_int_t)f->overviews[k].width, (json_int_t)f->overviews[k].height));
    json_t *object =
        json_pack("{s:s, s:s, s:i, s:s, s:[I,I], s:b, s:s, s:i, s:i, s:o, s:f, s:f, s:i, s:I}", "type", d->sample_type,
                  "codec", d->codec, "predictor", d->predictor, "layout", d->tiled ? "tiles" : "strips", "block",
                  (json_int_t)d->block_width, (json_int_t)d->block_height, "bigtiff", d->big_tiff, "byte_order",
                  d->big_endian ? "big" : "little", "bands", (int)d->bands, "band", (int)d->band, "nodata",
                  d->has_nodata ? number(d->nodata) : json_null(), "scale", d->scale, "offset", d->offset, "overviews",
                  (int)d->overviews, "bytes", (json_int_t)d->bytes);
    json_object_set_new(object, "overview_sizes", sizes);
    return object;
}

static json_t *window_json(const facts *f)
{
    const tl_window *w = &f->window;
    json_t *object = json_pack("{s:I, s:I, s:I, s:I}", "x", (json_int_t)w->x, "y", (json_int_t)w->y, "width",
                               (json_int_t)w->width, "height", (json_int_t)w->height);
    if (f->has_cost)
        json_object_update_new(object, json_pack("{s:I, s:I, s:I}", "blocks", (json_int_t)f->cost.blocks,
                                                 "stored_bytes", (json_int_t)f->cost.stored_bytes, "decoded_bytes",
                                                 (json_int_t)f->cost.decoded_bytes));
    return object;
}

/* The files of a mosaic; of nothing else, for one file is told of in full. */
static size_t file_count(const facts *f)
{
    size_t count = tl_dem_member_count(f->source);
    return count > 1 ? count : 0;
}

static json_t *files_json(const facts *f)
{
    json_t *list = json_array();
    tl_dem_member m;
    for (size_t k = 0; k < file_count(f) && tl_dem_get_member(f->source, k, &m, NULL) == TL_OK; k++)
        json_array_append_new(list, json_pack("{s:o, s:I, s:I, s:[I,I,I,I], s:b}", "name", string(m.source->info.name),
                                              "width", (json_int_t)m.source->info.width, "height",
                                              (json_int_t)m.source->info.height, "window", (json_int_t)m.window.x,
                                              (json_int_t)m.window.y, (json_int_t)m.window.width,
                                              (json_int_t)m.window.height, "interpolated", m.resampled));
    return list;
}

static void print_files(const facts *f)
{
    tl_dem_member m;
    size_t count = file_count(f);
    if (count)
        printf("files        %zu\n", count);
    for (size_t k = 0; k < count && tl_dem_get_member(f->source, k, &m, NULL) == TL_OK; k++)
        printf("             %s: %lld x %lld at column %lld, row %lld%s\n", m.source->info.name,
               (long long)m.source->info.width, (long long)m.source->info.height, (long long)m.window.x,
               (long long)m.window.y, m.resampled ? ", interpolated" : "");
}

static json_t *suspects_json(const facts *f)
{
    json_t *list = json_array();
    for (size_t k = 0; k < f->suspect_count; k++)
        json_array_append_new(list, json_pack("{s:f, s:I}", "value", (double)f->suspects[k].value, "samples",
                                              (json_int_t)f->suspects[k].count));
    return list;
}

/* The fewest digits that --nodata makes the same float of. */
static void short_float(float value, char text[32])
{
    for (int digits = 6; digits <= 9; digits++) {
        snprintf(text, 32, "%.*g", digits, (double)value);
        if (strtof(text, NULL) == value)
            return;
    }
}

static void print_suspects(const facts *f)
{
    char value[32];
    for (size_t k = 0; k < f->suspect_count; k++) {
        short_float(f->suspects[k].value, value);
        printf("suspect      %s in %llu samples: perhaps void; try --nodata %s\n", value,
               (unsigned long long)f->suspects[k].count, value);
    }
}

static void print_json(const facts *f)
{
    const tl_source_info *info = f->info;
    json_t *object = json_pack("{s:o, s:I, s:I, s:i, s:s, s:f, s:o}", "name", string(info->name), "width",
                               (json_int_t)info->width, "height", (json_int_t)info->height, "level", info->level,
                               "raster_type", info->type == TL_RASTER_AREA ? "area" : "point", "quantum", info->quantum,
                               "georeference", georef_json(f));
    if (info->contents)
        json_object_set_new(object, "contents", string(info->contents));
    json_object_set_new(object, "file", f->has_details ? file_json(f) : json_null());
    if (file_count(f))
        json_object_set_new(object, "files", files_json(f));
    if (f->has_window)
        json_object_set_new(object, "window", window_json(f));
    json_object_set_new(object, "heights",
                        json_pack("{s:o, s:o, s:o, s:I, s:I}", "low", number((double)f->range.low), "high",
                                  number((double)f->range.high), "mean", number(f->range.mean), "samples",
                                  (json_int_t)f->range.samples, "voids", (json_int_t)f->range.voids));
    json_object_set_new(object, "suspects", suspects_json(f));
    json_object_set_new(object, "roughness",
                        f->roughness.measurable
                            ? json_pack("{s:f, s:f}", "sigma", f->roughness.sigma, "hurst", f->roughness.hurst)
                            : json_null());
    json_t *parameters = json_object();
    for (size_t i = 0; i < info->parameter_count; i++)
        json_object_set_new(parameters, info->parameters[i].name, string(info->parameters[i].value));
    json_object_set_new(object, "parameters", parameters);
    json_dumpf(object, stdout, JSON_INDENT(2) | JSON_REAL_PRECISION(15));
    putchar('\n');
    json_decref(object);
}

/* Without the control characters that a name may hold, for they may drive a terminal. */
static void print_plain(const char *text)
{
    for (; *text; text++)
        putchar((unsigned char)*text < 0x20 || *text == 0x7f ? '?' : *text);
}

static void print_overviews(const facts *f)
{
    for (unsigned k = 0; k < f->overview_count; k++)
        printf("%s%lld x %lld", k ? ", " : "overviews    ", (long long)f->overviews[k].width,
               (long long)f->overviews[k].height);
    if (f->overview_count)
        putchar('\n');
}

static void print_file(const facts *f)
{
    const tl_dem_details *d = &f->details;
    printf("file         %lld bytes, %s%s-endian, %s, codec %s", (long long)d->bytes, d->big_tiff ? "BigTIFF, " : "",
           d->big_endian ? "big" : "little", d->sample_type, d->codec);
    if (d->predictor > 1)
        printf(" with predictor %d", d->predictor);
    printf(", %s of %lld x %lld\n", d->tiled ? "tiles" : "strips", (long long)d->block_width,
           (long long)d->block_height);
    if (d->bands > 1)
        printf("band         %u of %u\n", d->band, d->bands);
    print_overviews(f);
    if (d->has_nodata)
        printf("nodata       %.9g\n", d->nodata);
    if (d->scale != 1 || d->offset != 0)
        printf("heights are  %g + %g * stored\n", d->offset, d->scale);
}

static void print_crs(const tl_crs *crs)
{
    printf("CRS          ");
    print_plain(crs ? tl_crs_name(crs) : "unknown");
    if (crs && tl_crs_epsg(crs))
        printf(" (EPSG:%d)", tl_crs_epsg(crs));
    putchar('\n');
    if (!crs || !*tl_crs_vertical_name(crs))
        return;
    printf("vertical     ");
    print_plain(tl_crs_vertical_name(crs));
    if (tl_crs_vertical_epsg(crs))
        printf(" (EPSG:%d)", tl_crs_vertical_epsg(crs));
    putchar('\n');
}

static void print_place(const facts *f)
{
    const tl_source_info *info = f->info;
    const tl_georef *g = &info->georef;
    double low[2], high[2];
    extent(info, low, high);
    print_crs(g->crs);
    if (g->located)
        printf("extent       %.10g ... %.10g, %.10g ... %.10g\n", low[0], high[0], low[1], high[1]);
    else
        printf("extent       unknown: the file does not say where it lies\n");
    if (f->has_bounds && !tl_crs_is_geographic(g->crs))
        printf("degrees      %.9f ... %.9f, %.9f ... %.9f\n", f->bounds[0], f->bounds[2], f->bounds[1], f->bounds[3]);
    printf("cell         %.6g x %.6g m%s\n", g->cell_x, g->cell_y, g->crs ? "" : " (taken for metres)");
}

static void print_text(const facts *f)
{
    const tl_source_info *info = f->info;
    print_plain(info->name);
    printf("\nsize         %lld x %lld samples, %s\n", (long long)info->width, (long long)info->height,
           info->type == TL_RASTER_AREA ? "each the mean of its cell (area)" : "each a point");
    if (info->contents)
        printf("contents     %s, no heights\n", info->contents);
    if (f->has_details)
        print_file(f);
    print_files(f);
    print_place(f);
    const tl_range *r = &f->range;
    if (r->voids < r->samples)
        printf("heights      %.9g ... %.9g, mean %.6g", (double)r->low, (double)r->high, r->mean);
    else
        printf("heights      none: every sample is void");
    printf(info->quantum > 0 ? ", in steps of %g\n" : "\n", info->quantum);
    if (info->georef.height_unit != 1)
        printf("height unit  %.9g m\n", info->georef.height_unit);
    printf("voids        %llu of %llu samples (%.3g %%)\n", (unsigned long long)r->voids,
           (unsigned long long)r->samples, 100 * (double)r->voids / (double)r->samples);
    print_suspects(f);
    if (f->roughness.measurable)
        printf("roughness    sigma %.4g over the finest octave, exponent %.3g\n", f->roughness.sigma,
               f->roughness.hurst);
    if (f->has_cost)
        printf("window       %llu blocks, %llu bytes in the file, %llu decoded\n", (unsigned long long)f->cost.blocks,
               (unsigned long long)f->cost.stored_bytes, (unsigned long long)f->cost.decoded_bytes);
    for (size_t i = 0; i < info->parameter_count; i++)
        printf("%s%s: %s\n", i ? "             " : "made by      ", info->parameters[i].name,
               info->parameters[i].value);
}

/* All that is known without reading samples. What cannot be told is left out, but for want of memory. */
static tl_status look(facts *f, tl_error *error)
{
    f->has_details = tl_dem_get_details(f->source, &f->details, NULL) == TL_OK;
    tl_status status = tl_source_bounds(f->info, f->bounds, error);
    f->has_bounds = status == TL_OK;
    if (status == TL_ERROR_MEMORY || find_corners(f, error) == TL_ERROR_MEMORY)
        return TL_ERROR_MEMORY;
    if (f->has_details)
        tl_dem_get_overviews(f->source, f->overviews, MAX_OVERVIEWS, &f->overview_count, NULL);
    f->has_cost = f->has_window && f->window.x + f->window.width <= f->source->info.width &&
                  tl_dem_get_cost(f->source, f->window, &f->cost, NULL) == TL_OK;
    return TL_OK;
}

static int inform(const settings *set, const arguments *inputs)
{
    progress bar;
    tl_error error;
    tl_run run = command_run(&set->common, &bar);
    opened_input opened = command_open(&set->common, inputs, &run, &error);
    const tl_source *source = opened.source;
    if (!source)
        return command_failed(&bar, &error);
    facts f = {.info = &source->info, .source = opened.file};
    f.has_window = set->common.window_given || set->common.box_given;
    f.window = opened.window;
    int status = EXIT_DONE;
    progress_stage(&bar, "reading");
    if (look(&f, &error) != TL_OK || tl_source_range(source, &run, &f.range, &error) != TL_OK ||
        tl_source_suspects(source, &run, f.suspects, &f.suspect_count, &error) != TL_OK ||
        tl_roughness_measure(source, &run, &f.roughness, &error) != TL_OK)
        status = command_failed(&bar, &error);
    else {
        progress_end(&bar);
        (set->json ? print_json : print_text)(&f);
        status = command_done();
    }
    command_close(&opened);
    return status;
}

static int run(const command *self, int argc, const char **argv, command_help help)
{
    settings set = {.common = {.any_contents = true}};
    const option output[] = {
        {"json", 'j', OPTION_FLAG, &set.json, NULL, NULL, "for machines: one JSON object", 0, 0, NULL}, {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"Output", output}, {"Input", input}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status))
        return status;
    bool tiles = rest.count == 1 && json_info_is_for(rest.names[0]);
    bool mesh = !tiles && rest.count == 1 && mesh_info_is_for(rest.names[0]);
    if (!set.common.memory && !mesh)
        set.common.memory = MEMORY; /* each block is looked at once or twice, one after the other */
    status = tiles  ? json_info_print(rest.names[0], set.json)
             : mesh ? mesh_info_print(rest.names[0], set.json, &set.common)
                    : inform(&set, &rest);
    arguments_free(&rest);
    return status;
}

const command command_info = {"info", "tell what a raster or a mesh holds", "RASTER...|MESH|TILES [--json]",
                              INPUT_NOTES "\n\nWithout --memory, info of a raster takes 64 MB. Meshes are .glb, "
                                          ".obj, .ply and .stl as talus writes them; points, .geojson and .csv; TILES, "
                                          "the folders of tiles, a .terrain in one, and what --preset writes.",
                              run};
