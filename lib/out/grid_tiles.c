/* Heightfields cut into tiles of one size, level by level: for engines and for programs that read EXR.
 *
 * Tiles are made alone, straight from the level of the source that they show, so that parts of a run need nothing of
 * each other. What is done is kept in runs of up to RUN tiles beside each other: a file in FOLDER/.talus tells them
 * when all are there, with sizes and checksums. */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/heightmap.h"
#include "lib/out/out.h"
#include "lib/out/tile_pyramid.h"
#include "lib/scene/lattice_level.h"
#include "lib/scene/north_up.h"

#include <jansson.h>
#include <libdeflate.h>

#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

enum { RUN = 16, DEFAULT_TILE = 257, PATH_ROOM = 4352, COPIES = 4 /* of a tile, that a thread has at once */ };

static const char *const endings[] = {[TL_GRID_TILES_EXR] = "exr",
                                      [TL_GRID_TILES_TIFF] = "tif",
                                      [TL_GRID_TILES_PNG16] = "png",
                                      [TL_GRID_TILES_R16] = "r16",
                                      [TL_GRID_TILES_RAW] = "raw"};

const char *tl_grid_tiles_ending(tl_grid_tiles_format format)
{
    return (size_t)format < sizeof endings / sizeof *endings ? endings[format] : NULL;
}

/* A tile that is there; bytes 0: it is void, with low > high, and there is no file. */
typedef struct tile_record {
    int64_t bytes;
    uint32_t checksum, nothing; /* so that records have no holes */
    float low, high;
} tile_record;

/* Tiles beside each other. */
typedef struct run {
    int level;
    int64_t row, first, count; /* columns */
    tile_record tiles[RUN];
    bool done;
} run;

typedef struct level {
    tl_source *source; /* NULL: is not written */
    int64_t columns, rows;
} level;

typedef struct job {
    const tl_source *source;
    const char *folder;
    const tl_grid_tiles_options *options;
    tl_grid_tiles_report *report;
    int64_t cells; /* on a side of a tile */
    bool range_known;
    tl_range range;
    out_coding code;
    tl_source *turned; /* the north first, where the source is otherwise */
    level levels[TL_GRID_TILES_LEVELS];
    char *text; /* what parts of a run must agree on */
    run *runs;  /* from the deepest level up */
    size_t run_count;
    out_pyramid work; /* what the folder's keeping needs */
    tl_tiles_options flags;
} job;

static bool is_coded(const job *j)
{
    return j->options->format == TL_GRID_TILES_PNG16 || j->options->format == TL_GRID_TILES_R16;
}

/* ---- Levels ---- */

static tl_status check_options(const tl_grid_tiles_options *o, const char *folder, tl_error *error)
{
    if (o->tile && (o->tile < 3 || o->tile > 16385 || o->tile % 2 == 0))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: tiles must be an odd number of samples, 3 ... 16385, on a side, not %lld", folder,
                       (long long)o->tile);
    if (o->shards && o->shard >= o->shards)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: there is no shard %u of %u", folder, o->shard, o->shards);
    if (o->range_given && !((float)o->low < (float)o->high && isfinite((float)o->low) && isfinite((float)o->high)))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: the range of heights (--range) must rise, in single precision, not go from %g to %g",
                       folder, o->low, o->high);
    return TL_OK;
}

/* Halvings until one tile holds all. */
static int count_levels(const tl_source_info *info, int64_t cells)
{
    int64_t longer = tl_int64_max(info->width, info->height);
    int levels = 1;
    while ((longer - 1) >> (levels - 1) > cells && levels < TL_GRID_TILES_LEVELS)
        levels++;
    return levels;
}

static tl_status open_level(job *j, int k, tl_error *error)
{
    level *l = &j->levels[k];
    l->source = scene_lattice_level_create(j->turned ? j->turned : j->source, j->report->level_count - 1 - k, error);
    if (!l->source)
        return error ? error->status : TL_ERROR_MEMORY;
    l->columns = tl_int64_max(1, tl_div_up(l->source->info.width - 1, j->cells));
    l->rows = tl_int64_max(1, tl_div_up(l->source->info.height - 1, j->cells));
    tl_grid_tiles_level *out = &j->report->levels[k];
    out->columns = l->columns;
    out->rows = l->rows;
    out->width = l->source->info.width;
    out->height = l->source->info.height;
    return TL_OK;
}

static tl_status open_levels(job *j, tl_error *error)
{
    const tl_grid_tiles_options *o = j->options;
    tl_grid_tiles_report *r = j->report;
    bool columns, rows;
    scene_north_up_turns(&j->source->info.georef, &columns, &rows);
    if ((columns || rows) && !(j->turned = scene_north_up(j->source, error)))
        return error ? error->status : TL_ERROR_MEMORY;
    r->level_count = count_levels(&j->source->info, j->cells);
    r->first_level = o->levels_given ? o->first_level : 0;
    r->last_level = o->levels_given ? o->last_level : r->level_count - 1;
    if (r->first_level < 0 || r->first_level > r->last_level || r->last_level >= r->level_count)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: has levels 0...%d of such tiles, not %d...%d",
                       j->source->info.name, r->level_count - 1, r->first_level, r->last_level);
    for (int k = r->first_level; k <= r->last_level; k++) {
        tl_status status = open_level(j, k, error);
        if (status != TL_OK)
            return status;
    }
    return TL_OK;
}

/* What 16-bit values mean: one range for all tiles, with a value for what is beyond the rim. */
static tl_status find_range(job *j, tl_error *error)
{
    const tl_grid_tiles_options *o = j->options;
    if (!is_coded(j))
        return TL_OK;
    if (o->range_given) {
        j->range = (tl_range){.low = (float)o->low, .high = (float)o->high, .samples = 2};
    } else if (o->shards)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: parts of a run cannot know the range of all heights; give it (--range LOW,HIGH)",
                       j->folder);
    else {
        tl_run quiet = o->run ? *o->run : (tl_run){0};
        quiet.progress = NULL;
        tl_status status = tl_source_range(j->source, &quiet, &j->range, error);
        if (status != TL_OK)
            return status;
        if (j->range.voids == j->range.samples)
            return tl_fail(error, TL_ERROR_DATA, "%s: all of it is void", j->source->info.name);
    }
    j->range.voids = 1;
    j->range_known = true;
    j->code = out_coding_of(&j->range);
    return TL_OK;
}

static tl_status list_runs(job *j, tl_error *error)
{
    const tl_grid_tiles_report *r = j->report;
    size_t count = 0;
    for (int k = r->first_level; k <= r->last_level; k++)
        count += (size_t)(tl_div_up(j->levels[k].columns, RUN) * j->levels[k].rows);
    j->runs = tl_alloc(count, sizeof *j->runs);
    if (!j->runs)
        return tl_fail_memory(error, j->folder);
    for (int k = r->last_level; k >= r->first_level; k--)
        for (int64_t row = 0; row < j->levels[k].rows; row++)
            for (int64_t first = 0; first < j->levels[k].columns; first += RUN)
                j->runs[j->run_count++] = (run){
                    .level = k, .row = row, .first = first, .count = tl_int64_min(RUN, j->levels[k].columns - first)};
    return TL_OK;
}

/* ---- Tiles ---- */

/* The samples of a tile, void beyond the level's rim. */
static tl_status read_tile(const job *j, const level *l, int64_t column, int64_t row, float *out, tl_error *error)
{
    int64_t side = j->cells + 1;
    tl_window w = {column * j->cells, row * j->cells, 0, 0};
    w.width = tl_int64_min(side, l->source->info.width - w.x);
    w.height = tl_int64_min(side, l->source->info.height - w.y);
    tl_status status = tl_source_read(l->source, 0, w, out, error);
    for (int64_t y = side - 1; y >= 0 && status == TL_OK && (w.width < side || w.height < side); y--) {
        if (y < w.height)
            memmove(out + y * side, out + y * w.width, (size_t)w.width * sizeof *out);
        for (int64_t x = y < w.height ? w.width : 0; x < side; x++)
            out[y * side + x] = NAN;
    }
    return status;
}

/* Where the tile lies, and how it was made. */
static tl_source_info describe_tile(const job *j, const level *l, int64_t column, int64_t row)
{
    tl_source_info info = l->source->info;
    double *t = info.georef.transform;
    for (int a = 0; a < 2; a++)
        t[3 * a] += (double)(column * j->cells) * t[3 * a + 1] + (double)(row * j->cells) * t[3 * a + 2];
    info.width = info.height = j->cells + 1;
    info.has_voids = true;
    info.wraps = false;
    return info;
}

static tl_status write_file(const job *j, const tl_source *tile, const char *path, tl_error *error)
{
    static const out_heightmap_kind kinds[] = {[TL_GRID_TILES_PNG16] = OUT_HEIGHTMAP_PNG16,
                                               [TL_GRID_TILES_R16] = OUT_HEIGHTMAP_R16,
                                               [TL_GRID_TILES_RAW] = OUT_HEIGHTMAP_RAW32};
    const tl_run alone = {.threads = 1, .cancel = j->options->run ? j->options->run->cancel : NULL};
    if (j->options->format == TL_GRID_TILES_EXR || j->options->format == TL_GRID_TILES_TIFF) {
        tl_write_options options = {.overwrite = true, .compression = j->options->compression, .run = &alone};
        return tl_write_grid(tile, path, &options, error);
    }
    tl_output *output = tl_output_open(path, true, error);
    if (!output)
        return TL_ERROR_IO;
    const out_heightmap how = {
        .kind = kinds[j->options->format], .window = {0, 0, tile->info.width, tile->info.height}, .code = j->code};
    tl_status status = out_heightmap_write(tile, &how, output, &alone, error);
    if (status == TL_OK)
        return tl_output_commit(output, error);
    tl_output_abort(output);
    return status;
}

static void name_tile(const job *j, int k, int64_t column, int64_t row, char out[PATH_ROOM])
{
    snprintf(out, PATH_ROOM, "%s/%d/%" PRId64 "_%" PRId64 ".%s", j->folder, k, column, row,
             endings[j->options->format]);
}

/* Size and checksum of a file; false where it cannot be read. */
static bool sum_file(const char *path, int64_t *bytes, uint32_t *checksum)
{
    unsigned char part[65536];
    FILE *file = fopen(path, "rb");
    *bytes = 0;
    *checksum = libdeflate_crc32(0, NULL, 0);
    for (size_t got; file && (got = fread(part, 1, sizeof part, file)) > 0; *bytes += (int64_t)got)
        *checksum = libdeflate_crc32(*checksum, part, got);
    bool good = file && !ferror(file);
    if (file)
        fclose(file);
    return good;
}

/* Heights that 16 bits do not hold are no matter for a silent cut. */
static tl_status check_range(const job *j, const out_extent *found, tl_error *error)
{
    if (!is_coded(j) || found->low > found->high || (found->low >= j->range.low && found->high <= j->range.high))
        return TL_OK;
    return tl_fail(error, TL_ERROR_DATA, "%s: has heights from %g to %g, beyond the range %g to %g; give a larger one",
                   j->source->info.name, (double)found->low, (double)found->high, (double)j->range.low,
                   (double)j->range.high);
}

static tl_status make_tile(const job *j, const run *at, int64_t column, float *z, tile_record *out, tl_error *error)
{
    char path[PATH_ROOM];
    const level *l = &j->levels[at->level];
    size_t count = (size_t)(j->cells + 1) * (size_t)(j->cells + 1);
    out_extent extent = out_extent_empty();
    tl_status status = read_tile(j, l, column, at->row, z, error);
    if (status != TL_OK)
        return status;
    out_extent_add(&extent, z, count);
    *out = (tile_record){.low = extent.low, .high = extent.high};
    if (extent.low > extent.high)
        return TL_OK;
    status = check_range(j, &extent, error);
    const tl_source_info info = describe_tile(j, l, column, at->row);
    tl_source *tile = status == TL_OK ? tl_array_source_create(z, &info, error) : NULL;
    if (status == TL_OK && !tile)
        status = TL_ERROR_MEMORY;
    name_tile(j, at->level, column, at->row, path);
    if (status == TL_OK)
        status = write_file(j, tile, path, error);
    tl_source_destroy(tile);
    if (status == TL_OK && !sum_file(path, &out->bytes, &out->checksum))
        status = tl_fail(error, TL_ERROR_IO, "%s: cannot be read back", path);
    return status;
}

/* ---- Runs, and what is kept of them ---- */

static void name_record(const run *r, char *out, size_t room)
{
    snprintf(out, room, ".talus/%d_%" PRId64 "_%" PRId64 ".run", r->level, r->row, r->first);
}

static tl_status save_run(const job *j, const run *r, tl_error *error)
{
    char name[96];
    name_record(r, name, sizeof name);
    return out_write_inside(j->folder, name, r->tiles, (size_t)r->count * sizeof *r->tiles, true, error);
}

/* Whether a run is there, and whole. */
static bool load_run(const job *j, run *r)
{
    char name[96], path[PATH_ROOM];
    name_record(r, name, sizeof name);
    snprintf(path, sizeof path, "%s/%s", j->folder, name);
    size_t count = (size_t)r->count;
    FILE *file = fopen(path, "rb");
    bool whole = file && fread(r->tiles, sizeof *r->tiles, count, file) == count && fgetc(file) == EOF;
    if (file)
        fclose(file);
    for (size_t k = 0; k < count && whole; k++) {
        int64_t bytes;
        uint32_t checksum;
        name_tile(j, r->level, r->first + (int64_t)k, r->row, path);
        whole = r->tiles[k].bytes ? sum_file(path, &bytes, &checksum) && bytes == r->tiles[k].bytes &&
                                        checksum == r->tiles[k].checksum
                                  : r->tiles[k].low > r->tiles[k].high; /* not so where a disk left zeros */
    }
    return whole;
}

typedef struct making {
    job *j;
    size_t *waiting; /* runs */
} making;

static tl_status make_run(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    making *m = context;
    job *j = m->j;
    run *r = &j->runs[m->waiting[item]];
    (void)loop;
    (void)worker;
    float *z = tl_alloc_grid(j->cells + 1, j->cells + 1, sizeof *z);
    tl_status status = z ? TL_OK : tl_fail_memory(error, j->folder);
    for (int64_t k = 0; k < r->count && status == TL_OK; k++) {
        status = tl_run_check(j->options->run, error);
        if (status == TL_OK)
            status = make_tile(j, r, r->first + k, z, &r->tiles[k], error);
    }
    free(z);
    if (status == TL_OK)
        status = save_run(j, r, error);
    r->done = status == TL_OK;
    return status;
}

static tl_status make_folders(const job *j, tl_error *error)
{
    char path[PATH_ROOM];
    for (int k = j->report->first_level; k <= j->report->last_level; k++) {
        snprintf(path, sizeof path, "%s/%d", j->folder, k);
        if (mkdir(path, 0777) && access(path, W_OK))
            return tl_fail(error, TL_ERROR_IO, "%s: cannot be made, or written into", path);
    }
    return TL_OK;
}

/* As many threads as there is room for. */
static tl_run workers_for(const job *j, size_t runs)
{
    tl_run workers = j->options->run ? *j->options->run : (tl_run){0};
    double side = (double)j->cells + 1, tile = COPIES * side * side * sizeof(float);
    workers.threads = tl_parallel_workers(j->options->run, runs);
    if (workers.memory && tile * workers.threads > (double)workers.memory)
        workers.threads = (double)workers.memory >= tile ? (unsigned)((double)workers.memory / tile) : 1;
    return workers;
}

/* Makes what is not there: all, or one shard of it. */
static tl_status make_runs(job *j, tl_error *error)
{
    const tl_grid_tiles_options *o = j->options;
    making m = {j, tl_alloc(j->run_count, sizeof *m.waiting)};
    size_t count = 0;
    for (size_t k = 0; m.waiting && k < j->run_count; k++) {
        run *r = &j->runs[k];
        r->done = (o->resume || o->shards || o->finish) && load_run(j, r);
        j->report->done_before += r->done;
        if (!r->done && (!o->shards || k % o->shards == o->shard))
            m.waiting[count++] = k;
    }
    if (m.waiting && o->finish && !o->resume && count) {
        free(m.waiting);
        return tl_fail(
            error, TL_ERROR_ARGUMENT,
            "%s: %zu of its %zu runs of tiles are not done; run the shards first, or finish all with --resume",
            j->folder, count, j->run_count);
    }
    uint64_t side = (uint64_t)j->cells + 1, samples = count * RUN * side * side;
    tl_status status = m.waiting ? make_folders(j, error) : tl_fail_memory(error, j->folder);
    double tile = COPIES * (double)(side * side) * sizeof(float);
    const tl_run workers = workers_for(j, count);
    if (status == TL_OK)
        status = tl_run_fits(o->run, tile, j->source->info.name, "cutting it into tiles", error);
    if (status == TL_OK)
        status = tl_parallel_for(&workers, count, samples, make_run, &m, error);
    free(m.waiting);
    return status;
}

/* ---- What to expect ---- */

/* Means over tiles of a level that were made and removed again. */
typedef struct level_sample {
    int64_t count, all;
    double bytes, spread; /* of a tile; two standard errors of all of them */
    double seconds;
} level_sample;

/* `j` has a folder of its own. */
static tl_status sample_level(const job *j, int k, level_sample *out, tl_error *error)
{
    enum { SHARE = 64, LEAST = 16, MOST = 48 };
    const level *l = &j->levels[k];
    double squares = 0, before = out_seconds_of_thread();
    *out = (level_sample){.all = l->columns * l->rows};
    out->count = tl_int64_min(tl_int64_min(tl_int64_max(out->all / SHARE, LEAST), MOST), out->all);
    float *z = tl_alloc_grid(j->cells + 1, j->cells + 1, sizeof *z);
    tl_status status = z ? TL_OK : tl_fail_memory(error, j->folder);
    for (int64_t n = 0; n < out->count && status == TL_OK; n++) {
        tile_record tile = {0};
        char path[PATH_ROOM];
        int64_t at = (int64_t)out_sample_place((size_t)n, (size_t)out->count, (size_t)out->all);
        const run place = {.level = k, .row = at / l->columns};
        status = tl_run_check(j->options->run, error);
        if (status == TL_OK)
            status = make_tile(j, &place, at % l->columns, z, &tile, error);
        name_tile(j, k, at % l->columns, place.row, path);
        unlink(path);
        out->bytes += (double)tile.bytes / (double)out->count;
        squares += (double)tile.bytes * (double)tile.bytes;
    }
    free(z);
    double n = (double)out->count, off = fmax(squares - n * out->bytes * out->bytes, 0);
    out->spread = out->count < out->all ? 2 * sqrt(off / (n - 1) / n * (1 - n / (double)out->all)) : 0;
    out->seconds = (out_seconds_of_thread() - before) / n;
    return status;
}

/* A tile takes time by its own samples, and by those of the source, four times as many from level to level; both by the
 * two deepest levels. */
static void expect(job *j, const level_sample sampled[2])
{
    tl_grid_tiles_report *r = j->report;
    double own = sampled[0].seconds, read = fmax((sampled[1].seconds - own) / 3, 0), seconds = 0, bytes = 0, off = 0;
    size_t runs = 0;
    for (int k = r->last_level; k >= r->first_level; k--) {
        double tiles = (double)(j->levels[k].columns * j->levels[k].rows);
        const level_sample *like = &sampled[k < r->last_level];
        runs += (size_t)(tl_div_up(j->levels[k].columns, RUN) * j->levels[k].rows);
        r->levels[k].tiles = (uint64_t)tiles;
        r->levels[k].bytes = (uint64_t)(tiles * like->bytes);
        seconds += tiles * (own + (ldexp(1, 2 * (r->last_level - k)) - 1) * read);
        bytes += tiles * like->bytes;
        off += tiles * like->spread;
    }
    r->forecast.threads = workers_for(j, runs).threads;
    r->forecast.seconds = seconds / r->forecast.threads;
    r->forecast.spread = bytes > 0 ? off / bytes : (double)NAN;
    r->forecast.sampled = (uint64_t)(sampled[0].count + sampled[1].count);
}

/* Tiles are made in a folder for what is temporary, and removed. */
static tl_status forecast(job *j, tl_error *error)
{
    const tl_grid_tiles_report *r = j->report;
    const char *place = getenv("TMPDIR"), *folder = j->folder;
    char temporary[PATH_ROOM / 2], path[PATH_ROOM];
    level_sample sampled[2] = {{0}};
    tl_status status = find_range(j, error);
    snprintf(temporary, sizeof temporary, "%s/talus-XXXXXX", place && *place ? place : "/tmp");
    if (status == TL_OK && !mkdtemp(temporary))
        status = tl_fail(error, TL_ERROR_IO, "%s: cannot be made; TMPDIR may name a place for it", temporary);
    if (status != TL_OK)
        return status;
    j->folder = temporary;
    for (int n = 0; n < 2 && status == TL_OK; n++) {
        int k = r->last_level - n;
        sampled[n] = sampled[0];
        if (k < r->first_level)
            continue;
        snprintf(path, sizeof path, "%s/%d", temporary, k);
        status = mkdir(path, 0777) ? tl_fail(error, TL_ERROR_IO, "%s: cannot be made", path)
                                   : sample_level(j, k, &sampled[n], error);
        rmdir(path);
    }
    rmdir(temporary);
    j->folder = folder;
    if (status == TL_OK)
        expect(j, sampled);
    return status;
}

/* ---- The index ---- */

static json_t *numbers(const double *values, size_t count)
{
    json_t *list = json_array();
    for (size_t k = 0; k < count; k++)
        json_array_append_new(list, json_real(values[k]));
    return list;
}

static json_t *describe_level(const job *j, int k)
{
    const tl_source_info *info = &j->levels[k].source->info;
    json_t *tiles = json_array();
    double t[6];
    for (size_t n = 0; n < j->run_count; n++)
        for (int64_t c = 0; c < j->runs[n].count && j->runs[n].level == k; c++) {
            const tile_record *tile = &j->runs[n].tiles[c];
            if (tile->bytes)
                json_array_append_new(tiles,
                                      json_pack("[I, I, f, f]", (json_int_t)(j->runs[n].first + c),
                                                (json_int_t)j->runs[n].row, (double)tile->low, (double)tile->high));
        }
    out_gdal_transform(info, t);
    return json_pack("{s:i, s:I, s:I, s:I, s:I, s:[f,f], s:o, s:o}", "level", k, "width", (json_int_t)info->width,
                     "height", (json_int_t)info->height, "columns", (json_int_t)j->levels[k].columns, "rows",
                     (json_int_t)j->levels[k].rows, "cell_metres", info->georef.cell_x, info->georef.cell_y,
                     "geotransform", numbers(t, 6), "tiles", tiles);
}

static json_t *describe(const job *j)
{
    const tl_source_info *info = &j->source->info;
    const char *ending = endings[j->options->format];
    char names[64];
    snprintf(names, sizeof names, "LEVEL/COLUMN_ROW.%s", ending);
    json_t *levels = json_array();
    for (int k = j->report->first_level; k <= j->report->last_level; k++)
        json_array_append_new(levels, describe_level(j, k));
    double bounds[4];
    bool placed = info->georef.crs && tl_source_bounds(info, bounds, NULL) == TL_OK;
    json_t *root = json_pack(
        "{s:s, s:s, s:s, s:I, s:i, s:o, s:s, s:f, s:o, s:o, s:o, s:o}", "format", ending, "names", names, "order",
        "columns from the west, rows from the north; neighbours share their outermost samples", "tile",
        (json_int_t)(j->cells + 1), "levels_of_all", j->report->level_count, "range",
        isnan(j->report->low) ? json_null() : json_pack("[f,f]", (double)j->report->low, (double)j->report->high),
        "raster_type", info->type == TL_RASTER_AREA ? "area" : "point", "height_unit_metres", info->georef.height_unit,
        "scale", is_coded(j) ? json_real(j->code.scale) : json_real(1), "offset",
        is_coded(j) ? json_real(j->code.offset) : json_real(0), "void", is_coded(j) ? json_integer(0) : json_null(),
        "bounds_degrees", placed ? numbers(bounds, 4) : json_null());
    json_object_set_new(root, "levels", levels);
    info = j->turned ? &j->turned->info : info; /* rows from the north, as in the tiles */
    json_object_set_new(root, "talus", json_pack("{s:o?}", "job", json_loads(j->text, 0, NULL)));
    out_json_add_record(root, info);
    return root;
}

static void sum_up(const job *j)
{
    tl_grid_tiles_report *r = j->report;
    r->low = INFINITY, r->high = -INFINITY;
    for (size_t n = 0; n < j->run_count; n++)
        for (int64_t c = 0; c < j->runs[n].count && j->runs[n].done; c++) {
            const tile_record *tile = &j->runs[n].tiles[c];
            if (!tile->bytes)
                continue;
            r->levels[j->runs[n].level].tiles++;
            r->levels[j->runs[n].level].bytes += (uint64_t)tile->bytes;
            r->low = fminf(r->low, tile->low);
            r->high = fmaxf(r->high, tile->high);
        }
    if (r->low > r->high)
        r->low = r->high = NAN;
}

static tl_status finish(job *j, tl_error *error)
{
    sum_up(j);
    bool all = !j->options->shards || j->options->finish; /* one of several parts is not the last */
    for (size_t k = 0; k < j->run_count; k++)
        all = all && j->runs[k].done;
    if (!all)
        return TL_OK;
    json_t *root = describe(j);
    char *text = root ? json_dumps(root, JSON_INDENT(1) | JSON_REAL_PRECISION(17)) : NULL;
    tl_status status = text ? out_write_inside(j->folder, "index.json", text, strlen(text), true, error)
                            : tl_fail_memory(error, j->folder);
    free(text);
    json_decref(root);
    if (status == TL_OK) {
        out_clear_work(&j->work);
        j->report->complete = true;
    }
    return status;
}

/* ---- The whole ---- */

/* What parts of a run must agree on. */
static char *describe_job(const job *j, uint32_t sum)
{
    const tl_grid_tiles_options *o = j->options;
    json_t *root = json_pack("{s:s, s:s, s:I, s:i, s:i, s:i, s:f, s:f, s:I, s:I, s:I}", "version", tl_version(),
                             "format", endings[o->format], "tile", (json_int_t)(j->cells + 1), "first_level",
                             j->report->first_level, "last_level", j->report->last_level, "compression",
                             (int)o->compression, "low", j->range_known ? (double)j->range.low : 0, "high",
                             j->range_known ? (double)j->range.high : 0, "width", (json_int_t)j->source->info.width,
                             "height", (json_int_t)j->source->info.height, "rows", (json_int_t)sum);
    if (root)
        out_json_add_record(root, &j->source->info);
    char *text = root ? json_dumps(root, JSON_INDENT(1) | JSON_REAL_PRECISION(17)) : NULL;
    json_decref(root);
    return text;
}

static tl_status begin(job *j, tl_error *error)
{
    uint32_t sum;
    static const out_scheme scheme = {.index = "index.json"};
    tl_status status = out_sum_rows(j->source, &sum, error);
    j->text = status == TL_OK ? describe_job(j, sum) : NULL;
    if (status == TL_OK && !j->text)
        status = tl_fail_memory(error, j->folder);
    j->flags =
        (tl_tiles_options){.resume = j->options->resume, .shards = j->options->shards, .finish = j->options->finish};
    j->work = (out_pyramid){.folder = j->folder, .source = j->source, .options = &j->flags, .scheme = &scheme};
    if (status == TL_OK && (j->flags.resume || j->flags.shards || j->flags.finish))
        j->report->already = j->report->complete = out_folder_is_complete(&j->work, j->text);
    if (status == TL_OK && !j->report->complete)
        status = out_begin_folder(&j->work, j->text, error);
    return status;
}

static tl_status work(job *j, tl_error *error)
{
    tl_status status = open_levels(j, error);
    if (status == TL_OK && j->options->dry_run)
        return forecast(j, error);
    if (status == TL_OK)
        status = find_range(j, error);
    if (status == TL_OK)
        status = list_runs(j, error);
    if (status == TL_OK)
        status = begin(j, error);
    if (status != TL_OK || j->report->complete)
        return status;
    status = make_runs(j, error);
    return status == TL_OK ? finish(j, error) : status;
}

tl_status tl_write_grid_tiles(const tl_source *source, const char *folder, const tl_grid_tiles_options *options,
                              tl_grid_tiles_report *out, tl_error *error)
{
    static const tl_grid_tiles_options defaults;
    tl_grid_tiles_report report = {0};
    options = options ? options : &defaults;
    job j = {.source = source, .folder = folder, .options = options, .report = &report};
    j.cells = (options->tile ? options->tile : DEFAULT_TILE) - 1;
    tl_status status = check_options(options, folder, error);
    if (status == TL_OK)
        status = work(&j, error);
    for (int k = 0; k < TL_GRID_TILES_LEVELS; k++)
        tl_source_destroy(j.levels[k].source);
    tl_source_destroy(j.turned);
    free(j.runs);
    free(j.text);
    if (out)
        *out = report;
    return status;
}
