/* Heights as game engines and modellers import them: sizes, order of rows, names, and the numbers to type in. */
#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/heightmap.h"
#include "lib/out/out.h"
#include "lib/scene/north_up.h"

#include <jansson.h>

#include <math.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>
#include <unistd.h>

enum { SIZES = 8, MOST_TILES = 1 << 16, PATH_ROOM = 64 };

/* Numbers that importers are told. */
typedef struct numbers {
    double cell_x, cell_y, low, high; /* metres */
    double step;                      /* of 16-bit values, metres */
    double middle;                    /* height of value 32768, metres */
    double unit;                      /* of heights, metres */
    int64_t width, height;            /* of a tile, samples */
} numbers;

typedef struct engine {
    int64_t sizes[SIZES]; /* of tiles, the largest first; none: any size, in one file */
    bool bottom_up;       /* rows and tiles count from the south */
    int (*tell)(const numbers *, char *, size_t);
} engine;

/* Landscapes of Unreal: whole components of 1 or 4 sections of 63 or 127 quads. A value is (v - 32768) / 128 times the
 * scale's Z, in centimetres. */
static int tell_unreal(const numbers *n, char *out, size_t room)
{
    return snprintf(out, room,
                    "Landscape, Import from File: Scale X %.9g, Y %.9g, Z %.9g\n"
                    "Location Z %.9g (centimetres; the height of the value 32768)",
                    100 * n->cell_x, 100 * n->cell_y, fmax(100 * 128 * n->step, 1e-3), 100 * n->middle);
}

/* Unity's first row is that at z = 0. */
static int tell_unity(const numbers *n, char *out, size_t room)
{
    return snprintf(out, room,
                    "Import Raw: Depth Bit 16, Resolution %lld, Byte Order Windows, no vertical flip\n"
                    "Terrain Size X %.9g, Y %.9g, Z %.9g; position Y %.9g (metres)",
                    (long long)n->width, (double)(n->width - 1) * n->cell_x, fmax(n->high - n->low, 1e-3),
                    (double)(n->height - 1) * n->cell_y, n->low);
}

static int tell_godot(const numbers *n, char *out, size_t room)
{
    return snprintf(out, room,
                    "Terrain3D importer: r16 range %.9g, %.9g; r16 size %lld, %lld; vertex spacing %.9g%s\n"
                    "HTerrain importer: 16 bits, little endian, min height %.9g, max height %.9g; map scale X %.9g, "
                    "Z %.9g",
                    n->low, n->high, (long long)n->width, (long long)n->height, n->cell_x,
                    fabs(n->cell_y / n->cell_x - 1) > 1e-3 ? " (it has but one: scale its Z by the cells' height)" : "",
                    n->low, n->high, n->cell_x, n->cell_y);
}

static int tell_blender(const numbers *n, char *out, size_t room)
{
    return snprintf(out, room,
                    "Plane of X %.9g m, Y %.9g m, subdivided into %lld x %lld; Displace modifier with the image as\n"
                    "texture: coordinates UV, colour space Non-Color, extension Extend, Midlevel 0, Strength %.9g",
                    (double)n->width * n->cell_x, (double)n->height * n->cell_y, (long long)n->width,
                    (long long)n->height, n->unit);
}

static int tell_houdini(const numbers *n, char *out, size_t room)
{
    return snprintf(out, room,
                    "HeightField File: Size by Grid Spacing %.9g (columns; rows %.9g), Height Scale %.9g\n"
                    "(%.9g x %.9g m in all)",
                    n->cell_x, n->cell_y, n->unit, (double)n->width * n->cell_x, (double)n->height * n->cell_y);
}

static const tl_preset presets[] = {
    {"unreal", "Unreal Engine's landscapes: 16-bit tiles of 127 ... 8129 samples", "png r16"},
    {"unity", "Unity's terrains: 16-bit tiles of 33 ... 4097 samples, the south first", "r16"},
    {"godot", "Godot's Terrain3D and HTerrain: 16-bit tiles of 513 ... 4097 samples", "r16"},
    {"blender", "Blender: one EXR for a displaced plane", "exr"},
    {"houdini", "Houdini's height fields: one EXR", "exr"},
    {NULL, NULL, NULL},
};

/* In the order of `presets`. */
static const engine engines[] = {
    {{8129, 4033, 2017, 1009, 505, 253, 127}, false, tell_unreal},
    {{4097, 2049, 1025, 513, 257, 129, 65, 33}, true, tell_unity},
    {{4097, 2049, 1025, 513}, false, tell_godot},
    {{0}, false, tell_blender},
    {{0}, false, tell_houdini},
};

const tl_preset *tl_presets(void)
{
    return presets;
}

/* ---- Choice ---- */

static const tl_preset *find(const char *name, tl_error *error)
{
    for (const tl_preset *p = presets; p->name; p++)
        if (name && strcmp(p->name, name) == 0)
            return p;
    tl_fail(error, TL_ERROR_ARGUMENT, "no preset '%.60s'; use one of unreal, unity, godot, blender, houdini",
            name ? name : "");
    return NULL;
}

static tl_status check_ending(const tl_preset *preset, const char *path, tl_error *error)
{
    const char *dot = strrchr(path, '.');
    char list[32], *rest;
    snprintf(list, sizeof list, "%s", preset->endings);
    for (char *ending = strtok_r(list, " ", &rest); ending; ending = strtok_r(NULL, " ", &rest))
        if (dot && strcasecmp(dot + 1, ending) == 0)
            return TL_OK;
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %s takes files that end with %s (one of these); name one so", path,
                   preset->name, preset->endings);
}

/* Tiles of `size` samples that share their outermost ones. */
static int64_t tiles_along(int64_t samples, int64_t size)
{
    return samples < size ? 0 : (samples - 1) / (size - 1);
}

static double covered(int64_t width, int64_t height, int64_t size)
{
    return (double)(tiles_along(width, size) * (size - 1)) * (double)(tiles_along(height, size) * (size - 1));
}

/* The largest size that covers three quarters of what any can. */
static int64_t choose_size(const engine *of, int64_t width, int64_t height)
{
    double best = 0;
    for (int k = 0; k < SIZES && of->sizes[k]; k++)
        best = fmax(best, covered(width, height, of->sizes[k]));
    for (int k = 0; k < SIZES && of->sizes[k]; k++)
        if (best > 0 && covered(width, height, of->sizes[k]) >= 0.75 * best)
            return of->sizes[k];
    return 0;
}

static bool has_size(const engine *of, int64_t size)
{
    for (int k = 0; k < SIZES && of->sizes[k]; k++)
        if (of->sizes[k] == size)
            return true;
    return false;
}

static void list_sizes(const engine *of, char *out, size_t room)
{
    size_t used = 0;
    out[0] = 0;
    for (int k = 0; k < SIZES && of->sizes[k] && used < room; k++)
        used += (size_t)snprintf(out + used, room - used, k ? ", %lld" : "%lld", (long long)of->sizes[k]);
}

/* Fills in sizes, numbers of tiles and the window. */
static tl_status lay_out(const tl_preset *preset, const engine *of, const tl_source_info *info, int64_t tile,
                         tl_preset_report *out, tl_error *error)
{
    char sizes[80];
    list_sizes(of, sizes, sizeof sizes);
    *out = (tl_preset_report){.tile_width = info->width, .tile_height = info->height, .columns = 1, .rows = 1};
    out->window = (tl_window){0, 0, info->width, info->height};
    if (!of->sizes[0] && tile)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s takes one file of any size; leave the size of tiles away",
                       preset->name);
    if (!of->sizes[0])
        return TL_OK;
    if (tile && !has_size(of, tile))
        return tl_fail(error, TL_ERROR_ARGUMENT, "tiles of %lld samples are none of %s's; take one of %s",
                       (long long)tile, preset->name, sizes);
    int64_t size = tile ? tile : choose_size(of, info->width, info->height);
    int64_t columns = size ? tiles_along(info->width, size) : 0, rows = size ? tiles_along(info->height, size) : 0;
    if (columns < 1 || rows < 1)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: %lld x %lld samples do not fill a tile of %s, whose sizes are %s; use more levels",
                       info->name, (long long)info->width, (long long)info->height, preset->name, sizes);
    if (columns > MOST_TILES / rows)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: %lld x %lld tiles are too many; use larger ones or fewer levels",
                       info->name, (long long)columns, (long long)rows);
    out->tile_width = out->tile_height = size;
    out->columns = columns, out->rows = rows;
    out->window.width = columns * (size - 1) + 1, out->window.height = rows * (size - 1) + 1;
    out->window.x = (info->width - out->window.width) / 2, out->window.y = (info->height - out->window.height) / 2;
    return TL_OK;
}

/* ---- Files ---- */

typedef struct writing {
    const tl_preset *preset;
    const engine *of;
    const tl_source *part; /* of the source, from the north down: what the tiles cover */
    const char *path;
    const tl_preset_options *options;
    tl_preset_report *report;
    out_coding code;
    size_t done; /* tiles that have their names */
    bool *older; /* by tile: replaced one that was there */
} writing;

/* "land.r16" to "land_x1_y0.r16", "land.json"; free it. */
static char *name_of(const char *path, const char *middle, const char *ending)
{
    const char *dot = strrchr(path, '.');
    size_t stem = (size_t)(dot - path), room = stem + strlen(middle) + strlen(ending) + 1;
    char *out = malloc(room);
    if (out)
        snprintf(out, room, "%.*s%s%s", (int)stem, path, middle, ending);
    return out;
}

/* Tile k, row by row in the program's own order. */
static char *tile_name(const writing *w, size_t k)
{
    char middle[PATH_ROOM] = "";
    const tl_preset_report *r = w->report;
    if (r->columns * r->rows > 1)
        snprintf(middle, sizeof middle, "_x%lld_y%lld", (long long)((int64_t)k % r->columns),
                 (long long)((int64_t)k / r->columns));
    return name_of(w->path, middle, strrchr(w->path, '.'));
}

static tl_window tile_window(const writing *w, size_t k)
{
    const tl_preset_report *r = w->report;
    int64_t column = (int64_t)k % r->columns, row = (int64_t)k / r->columns;
    if (w->of->bottom_up)
        row = r->rows - 1 - row;
    return (tl_window){column * (r->tile_width - 1), row * (r->tile_height - 1), r->tile_width, r->tile_height};
}

static tl_status write_tile(writing *w, size_t k, const tl_run *run, tl_error *error)
{
    char *path = tile_name(w, k);
    w->older[k] = path && access(path, F_OK) == 0;
    tl_output *output = path ? tl_output_open(path, w->options->overwrite, error) : NULL;
    tl_status status = output ? TL_OK : path ? TL_ERROR_IO : tl_fail_memory(error, w->path);
    if (status == TL_OK) {
        out_heightmap how = {.kind =
                                 strcasecmp(strrchr(path, '.'), ".png") == 0 ? OUT_HEIGHTMAP_PNG16 : OUT_HEIGHTMAP_R16,
                             .window = tile_window(w, k),
                             .code = w->code,
                             .bottom_up = w->of->bottom_up};
        status = out_heightmap_write(w->part, &how, output, run, error);
        if (status == TL_OK)
            status = tl_output_commit(output, error);
        else
            tl_output_abort(output);
        w->done += status == TL_OK;
    }
    free(path);
    return status;
}

/* Takes back what is there already, but for tiles that replaced others: these stay. */
static void take_back(const writing *w)
{
    for (size_t k = 0; k < w->done; k++) {
        char *path = tile_name(w, k);
        if (path && !w->older[k])
            unlink(path);
        free(path);
    }
}

static tl_status write_exr(writing *w, tl_error *error)
{
    w->older[0] = access(w->path, F_OK) == 0;
    tl_output *output = tl_output_open(w->path, w->options->overwrite, error);
    if (!output)
        return TL_ERROR_IO;
    tl_write_options options = {.overwrite = w->options->overwrite, .run = w->options->run};
    tl_status status = out_exr_write(w->part, output, &options, error);
    if (status == TL_OK)
        status = tl_output_commit(output, error);
    else
        tl_output_abort(output);
    w->done += status == TL_OK;
    return status;
}

/* ---- The index ---- */

static const char *base_of(const char *path)
{
    const char *slash = strrchr(path, '/');
    return slash ? slash + 1 : path;
}

static json_t *list_tiles(const writing *w)
{
    json_t *list = json_array();
    for (size_t k = 0; k < (size_t)(w->report->columns * w->report->rows); k++) {
        tl_window at = tile_window(w, k);
        char *path = tile_name(w, k);
        json_array_append_new(list, json_pack("{s:s, s:I, s:I}", "file", path ? base_of(path) : "", "x",
                                              (json_int_t)at.x, "y", (json_int_t)at.y));
        free(path);
    }
    return list;
}

static json_t *list_lines(const char *text)
{
    json_t *list = json_array();
    while (*text) {
        size_t length = strcspn(text, "\n");
        json_array_append_new(list, json_stringn(text, length));
        text += length + (text[length] == '\n');
    }
    return list;
}

static json_t *describe(const writing *w)
{
    const tl_source_info *info = &w->part->info;
    const tl_preset_report *r = w->report;
    bool floats = !w->of->sizes[0];
    json_t *root = json_pack("{s:s, s:I, s:I, s:I, s:I, s:f, s:f, s:f, s:f, s:b, s:[f,f], s:f, s:o, s:o}", "preset",
                             w->preset->name, "width", (json_int_t)info->width, "height", (json_int_t)info->height,
                             "tile_width", (json_int_t)r->tile_width, "tile_height", (json_int_t)r->tile_height,
                             "scale", floats ? 1 : w->code.scale, "offset", floats ? 0 : w->code.offset, "lowest",
                             (double)r->low, "highest", (double)r->high, "bottom_up", w->of->bottom_up, "cell_metres",
                             info->georef.cell_x, info->georef.cell_y, "height_unit_metres", info->georef.height_unit,
                             "tiles", list_tiles(w), "import", list_lines(r->import));
    if (!root)
        return NULL;
    out_json_add_record(root, info);
    return root;
}

static tl_status write_index(const writing *w, tl_output *output, tl_error *error)
{
    json_t *root = describe(w);
    char *text = root ? json_dumps(root, JSON_INDENT(2) | JSON_REAL_PRECISION(17)) : NULL;
    tl_status status = text ? tl_output_append(output, text, strlen(text), error) : tl_fail_memory(error, w->path);
    if (status == TL_OK)
        status = tl_output_append(output, "\n", 1, error);
    free(text);
    json_decref(root);
    return status;
}

/* ---- The whole ---- */

static tl_status find_range(writing *w, tl_error *error)
{
    tl_range range;
    tl_run quiet = w->options->run ? *w->options->run : (tl_run){0};
    quiet.progress = NULL;
    tl_status status = tl_source_range(w->part, &quiet, &range, error);
    if (status != TL_OK)
        return status;
    if (range.voids == range.samples)
        return tl_fail(error, TL_ERROR_DATA, "%s: all of what would be written is void", w->part->info.name);
    range.voids = 0; /* they become the lowest height */
    w->code = out_coding_of(&range);
    w->report->low = range.low, w->report->high = range.high;
    const tl_georef *g = &w->part->info.georef;
    numbers n = {.cell_x = g->cell_x,
                 .cell_y = g->cell_y,
                 .low = (double)range.low * g->height_unit,
                 .high = (double)range.high * g->height_unit,
                 .step = w->code.scale * g->height_unit,
                 .middle = (w->code.offset + 32768 * w->code.scale) * g->height_unit,
                 .unit = g->height_unit,
                 .width = w->report->tile_width,
                 .height = w->report->tile_height};
    w->of->tell(&n, w->report->import, sizeof w->report->import);
    return TL_OK;
}

static tl_status write_all(writing *w, tl_error *error)
{
    char *beside = name_of(w->path, "", ".json");
    tl_output *index = beside ? tl_output_open(beside, w->options->overwrite, error) : NULL;
    tl_status status = index ? find_range(w, error) : beside ? TL_ERROR_IO : tl_fail_memory(error, w->path);
    w->older = calloc((size_t)(w->report->columns * w->report->rows), sizeof *w->older);
    if (status == TL_OK && !w->older)
        status = tl_fail_memory(error, w->path);
    if (status == TL_OK)
        status = write_index(w, index, error);
    if (status == TL_OK && !w->of->sizes[0])
        status = write_exr(w, error);
    for (size_t k = 0; status == TL_OK && w->of->sizes[0] && k < (size_t)(w->report->columns * w->report->rows); k++)
        status = write_tile(w, k, w->options->run, error);
    if (status == TL_OK)
        status = tl_output_commit(index, error);
    else if (index)
        tl_output_abort(index);
    if (status != TL_OK && w->older)
        take_back(w);
    free(w->older);
    free(beside);
    return status;
}

tl_status tl_write_preset(const tl_source *source, const char *path, const tl_preset_options *options,
                          tl_preset_report *out, tl_error *error)
{
    const tl_preset *preset = find(options->preset, error);
    if (!preset)
        return TL_ERROR_ARGUMENT;
    const engine *of = &engines[preset - presets];
    tl_preset_report report;
    const double *t = source->info.georef.transform;
    tl_status status = check_ending(preset, path, error);
    if (status == TL_OK && (t[2] != 0 || t[4] != 0))
        status = tl_fail(error, TL_ERROR_ARGUMENT,
                         "%s: its rows and columns do not run along the axes, which no such program knows; turn it "
                         "first, as gdalwarp does",
                         source->info.name);
    if (status == TL_OK)
        status = lay_out(preset, of, &source->info, options->tile, &report, error);
    if (status != TL_OK)
        return status;
    tl_source *upright = scene_north_up(source, error);
    tl_source *part = upright ? tl_cut_create(upright, report.window, error) : NULL;
    writing w = {.preset = preset, .of = of, .part = part, .path = path, .options = options, .report = &report};
    status = part ? write_all(&w, error) : TL_ERROR_MEMORY;
    tl_source_destroy(part);
    tl_source_destroy(upright);
    if (t[5] > 0) /* the rows of the source run the other way */
        report.window.y = source->info.height - report.window.y - report.window.height;
    if (t[1] < 0)
        report.window.x = source->info.width - report.window.x - report.window.width;
    if (status == TL_OK && out)
        *out = report;
    return status;
}
