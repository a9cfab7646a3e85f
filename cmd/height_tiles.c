#include "cmd/height_tiles.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

const char *const height_tile_compressions[] = {
    [TL_COMPRESSION_DEFAULT] = "default", [TL_COMPRESSION_NONE] = "none", [TL_COMPRESSION_ZIP] = "zip",
    [TL_COMPRESSION_ZIPS] = "zips",       [TL_COMPRESSION_PIZ] = "piz",   [TL_COMPRESSION_DEFLATE] = "deflate",
    [TL_COMPRESSION_ZSTD] = "zstd",       [TL_COMPRESSION_LZW] = "lzw",   NULL};

/* Whether there is such a preset, and its program takes such files. */
static bool takes(const char *preset, const char *format)
{
    const tl_preset *p = tl_presets();
    while (p->name && strcmp(p->name, preset) != 0)
        p++;
    const char *found = p->name ? strstr(p->endings, format) : NULL;
    return found && strchr(" ", found[strlen(format)]);
}

static bool preset_ok(const height_tiles *self, const char *format, const tl_tiles_options *parts)
{
    if (!self->preset)
        return true;
    if (parts->resume || parts->shards || parts->finish || parts->last_level_given || parts->dry_run)
        complain("--preset makes one level at once; leave --levels, --resume, --shard, --finish and --dry-run away");
    else if (self->range || self->compression)
        complain("--preset decides how files are written; leave --range and --compression away");
    else if (!takes(self->preset, format))
        complain("--preset %s does not take --format %s, or is none; see 'talus help synth'", self->preset, format);
    else
        return true;
    return false;
}

bool height_tiles_ok(height_tiles *self, const char *format, const tl_tiles_options *parts)
{
    tl_grid_tiles_options *o = &self->options;
    int kind = 0;
    char rest;
    const char *ending;
    while ((ending = tl_grid_tiles_ending((tl_grid_tiles_format)kind)) && strcmp(ending, format) != 0)
        kind++;
    if (!ending) {
        if (self->tile || self->range || self->compression || self->preset)
            complain("--%s is for tiles of heights: --format exr, tif, png, r16 or raw", self->tile    ? "tile"
                                                                                         : self->range ? "range"
                                                                                         : self->compression
                                                                                             ? "compression"
                                                                                             : "preset");
        return !(self->tile || self->range || self->compression || self->preset);
    }
    *o = (tl_grid_tiles_options){.format = (tl_grid_tiles_format)kind,
                                 .tile = self->tile,
                                 .levels_given = parts->last_level_given,
                                 .first_level = parts->first_level,
                                 .last_level = parts->last_level,
                                 .compression = (tl_compression)self->compression,
                                 .resume = parts->resume,
                                 .shard = parts->shard,
                                 .shards = parts->shards,
                                 .finish = parts->finish,
                                 .dry_run = parts->dry_run};
    o->range_given = self->range != NULL;
    if (self->range && sscanf(self->range, "%lf,%lf%c", &o->low, &o->high, &rest) != 2) {
        complain("--range: LOW,HIGH is wanted, two heights, not '%s'", self->range);
        return false;
    }
    bool coded = o->format == TL_GRID_TILES_PNG16 || o->format == TL_GRID_TILES_R16;
    if (self->range && !coded) {
        complain("--range is for --format png and r16; others keep heights as they are");
        return false;
    }
    return preset_ok(self, format, parts);
}

/* In FOLDER/FOLDER.ENDING, or FOLDER_x0_y0.ENDING and so on. */
static tl_status make_preset(const height_tiles *self, const common *shared, const char *format,
                             const tl_source *source, const tl_run *run, tl_error *error)
{
    char path[4200], folder[2048];
    tl_preset_report made;
    const tl_preset_options options = {.preset = self->preset, .tile = self->tile, .run = run};
    snprintf(folder, sizeof folder, "%s", shared->output);
    for (size_t length = strlen(folder); length > 1 && folder[length - 1] == '/';)
        folder[--length] = 0;
    const char *slash = strrchr(folder, '/'), *name = slash ? slash + 1 : folder;
    bool good = *name && strcmp(name, ".") != 0 && strcmp(name, "..") != 0;
    snprintf(path, sizeof path, "%s/%s.%s", folder, good ? name : "terrain", format);
    bool made_folder = mkdir(folder, 0777) == 0;
    if (!made_folder && errno != EEXIST) {
        error->status = TL_ERROR_IO;
        snprintf(error->text, sizeof error->text, "%.200s: cannot be made a folder: %s", folder, strerror(errno));
        return TL_ERROR_IO;
    }
    if (tl_write_preset(source, path, &options, &made, error) != TL_OK) {
        if (made_folder)
            rmdir(folder);
        return error->status;
    }
    command_say(shared,
                "%s: %lld x %lld tiles of %lld x %lld samples, %lld x %lld of %lld x %lld from the middle, heights "
                "from %g to %g",
                self->preset, (long long)made.columns, (long long)made.rows, (long long)made.tile_width,
                (long long)made.tile_height, (long long)made.window.width, (long long)made.window.height,
                (long long)source->info.width, (long long)source->info.height, (double)made.low, (double)made.high);
    for (char *rest, *line = strtok_r(made.import, "\n", &rest); line; line = strtok_r(NULL, "\n", &rest))
        command_say(shared, "  %s", line);
    return TL_OK;
}

void height_tiles_say_forecast(const common *shared, const tl_tiles_forecast *f, uint64_t bytes)
{
    char spread[64] = "";
    if (f->spread > 0)
        snprintf(spread, sizeof spread, ", give or take %.0f %%", ceil(100 * f->spread));
    command_say(
        shared,
        "%s: about %.3g MB%s, and %.3g s with %u thread%s, besides the disk's time; by %llu tiles that were made "
        "and not kept",
        shared->output, 1e-6 * (double)bytes, spread, f->seconds, f->threads, f->threads == 1 ? "" : "s",
        (unsigned long long)f->sampled);
}

static void tell(const height_tiles *self, const common *shared, const tl_grid_tiles_report *r)
{
    uint64_t tiles = 0, bytes = 0;
    if (r->already) {
        command_say(shared, "%s: is complete already", shared->output);
        return;
    }
    for (int k = r->first_level; k <= r->last_level; k++) {
        const tl_grid_tiles_level *l = &r->levels[k];
        tiles += l->tiles;
        bytes += l->bytes;
        command_say(shared, "level %-3d %8llu of %lld x %lld tiles, %lld x %lld samples", k,
                    (unsigned long long)l->tiles, (long long)l->columns, (long long)l->rows, (long long)l->width,
                    (long long)l->height);
    }
    if (self->options.dry_run) {
        command_say(shared, "%s: at most %llu tiles", shared->output, (unsigned long long)tiles);
        height_tiles_say_forecast(shared, &r->forecast, bytes);
    } else
        command_say(shared, "%s: %llu tiles, %llu bytes, heights from %g to %g%s", shared->output,
                    (unsigned long long)tiles, (unsigned long long)bytes, (double)r->low, (double)r->high,
                    r->complete ? "" : "; not complete until --finish");
}

tl_status height_tiles_make(const height_tiles *self, const common *shared, const char *format, const tl_source *source,
                            const tl_run *run, tl_error *error)
{
    if (self->preset)
        return make_preset(self, shared, format, source, run, error);
    tl_grid_tiles_options options = self->options;
    tl_grid_tiles_report made;
    options.run = run;
    tl_status status = tl_write_grid_tiles(source, shared->output, &options, &made, error);
    if (status == TL_OK)
        tell(self, shared, &made);
    return status;
}
