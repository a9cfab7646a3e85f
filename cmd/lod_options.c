#include "cmd/lod_options.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

const char *const selector_names[] = {
    [TL_SELECTOR_QUADTREE] = "quadtree", [TL_SELECTOR_CHUNK] = "chunk", [TL_SELECTOR_ROAM] = "roam", NULL};

static bool take_bands(lod_options *o)
{
    const char *at = o->bands;
    o->lod.band_count = 0;
    while (at && *at && o->lod.band_count < TL_LOD_BANDS) {
        char *end;
        double band = strtod(at, &end), before = o->lod.band_count ? o->lod.bands[o->lod.band_count - 1] : 0;
        if (end == at || (*end && *end != ',') || !(band > before) || isinf(band))
            break;
        o->lod.bands[o->lod.band_count++] = band;
        at = *end ? end + 1 : end;
    }
    if (!o->bands || (!*at && o->lod.band_count))
        return true;
    complain("--distance-bands: 1 to %d rising numbers of metres are wanted, as 50,100,200, not '%s'", TL_LOD_BANDS,
             o->bands);
    return false;
}

static bool knows_scheme(const char *name)
{
    const tl_scheme *schemes = tl_schemes();
    size_t count = 0;
    for (; schemes[count].name; count++)
        if (schemes[count].field && (!name || strcmp(schemes[count].name, name) == 0))
            return true;
    complain_of_choice("scheme", name, &schemes->name, count, sizeof *schemes);
    return false;
}

bool lod_options_ok(lod_options *o)
{
    if (!take_bands(o) || !knows_scheme(o->field.scheme))
        return false;
    if (o->bands && (o->pixel_error_given || o->budget)) {
        complain("--distance-bands goes without --pixel-error and --budget");
        return false;
    }
    if (o->bands && o->lod.morph) {
        complain("--geomorph goes by pixel errors, not with --distance-bands");
        return false;
    }
    if (o->lod.max_level_given && o->max_level > o->levels) {
        complain("--max-level %d is beyond --levels %d; allow more levels", (int)o->max_level, (int)o->levels);
        return false;
    }
    o->field.levels = (int)o->levels;
    o->field.seed = (uint64_t)o->seed;
    o->field.support = TL_SUPPORT_POINT; /* vertices of one level are vertices of the next */
    o->lod.selector = (tl_selector)o->selector;
    o->lod.budget = (uint64_t)o->budget;
    o->lod.max_level = (int)o->max_level;
    for (int k = 0; k < 4; k++)
        o->lod.keep |= o->keep[k] ? 1U << k : 0;
    return true;
}

/* The pyramid from the cache, where it fits the DEM; *status tells why there is none. */
static tl_pyramid *load_pyramid(const common *shared, const char *cache, const tl_source *dem,
                                const tl_pyramid_options *options, tl_status *status, tl_error *error)
{
    struct stat there;
    *status = TL_OK;
    if (!cache || stat(cache, &there) != 0)
        return NULL;
    tl_pyramid *pyramid = tl_pyramid_load(cache, dem, options, error);
    if (pyramid)
        command_say(shared, "%s: error pyramid used again", cache);
    else if (error->status == TL_ERROR_DATA)
        command_say(shared, "%s; made again", error->text);
    else
        *status = error->status;
    return pyramid;
}

static tl_pyramid *make_pyramid(const common *shared, const char *cache, const tl_source *dem,
                                const tl_pyramid_options *options, tl_error *error)
{
    tl_status status;
    tl_pyramid *pyramid = load_pyramid(shared, cache, dem, options, &status, error);
    if (pyramid || status != TL_OK)
        return pyramid;
    const tl_write_options writing = {.overwrite = true, .run = options->run};
    pyramid = tl_pyramid_create(dem, options, error);
    if (pyramid && cache && tl_pyramid_save(pyramid, cache, &writing, error) != TL_OK) {
        tl_pyramid_destroy(pyramid);
        return NULL;
    }
    return pyramid;
}

tl_status lod_ground_open(const common *shared, lod_options *o, const arguments *inputs, tl_frame frame,
                          const char *output, const tl_run *run, lod_ground *out, tl_error *error)
{
    *out = (lod_ground){.opened = command_open(shared, inputs, run, error)};
    const tl_source *dem = out->opened.source;
    if (!dem)
        return error->status;
    tl_pyramid_options errors = {.frame = frame, .run = run};
    const tl_write_options writing = {.frame = frame};
    if (output)
        errors.rounding = tl_write_rounding(&dem->info, output, &writing);
    out->pyramid = make_pyramid(shared, o->error_cache, dem, &errors, error);
    o->field.run = run;
    out->field = out->pyramid ? tl_field_create(dem, &o->field, error) : NULL;
    o->lod.run = run;
    if (out->field)
        return TL_OK;
    lod_ground_close(out);
    return error->status;
}

void lod_ground_close(lod_ground *ground)
{
    tl_source_destroy(ground->field);
    tl_pyramid_destroy(ground->pyramid);
    command_close(&ground->opened);
    *ground = (lod_ground){0};
}

void lod_warn_of_ground(const common *shared, const tl_lod_stats *stats)
{
    if (stats->above_ground < 0)
        command_say(shared,
                    "warning: the eye is %.3g m under the ground, which is seen from above only; give it a greater "
                    "height, or --above-ground",
                    -stats->above_ground);
}

static json_t *count(uint64_t value)
{
    return json_integer((json_int_t)value);
}

json_t *lod_stats_json(const tl_lod_stats *s)
{
    json_t *culled = json_pack("{s:o, s:o, s:o, s:o}", "frustum", count(s->culled[0]), "back", count(s->culled[1]),
                               "horizon", count(s->culled[2]), "ridge", count(s->culled[3]));
    return json_pack("{s:o, s:o, s:o, s:o, s:o, s:o, s:o, s:o, s:o, s:o, s:o, s:i, s:o, s:o, s:f}", "triangles",
                     count(s->triangles), "vertices", count(s->vertices), "visited", count(s->visited), "split",
                     count(s->split), "merged", count(s->merged), "culled", culled, "tiles_made", count(s->tiles_made),
                     "tiles_used", count(s->tiles_used), "samples_made", count(s->samples_made), "dem_blocks",
                     count(s->dem_blocks), "dem_samples", count(s->dem_samples), "finest_level", s->finest_level,
                     "pixel_error", isfinite(s->pixel_error) ? json_real(s->pixel_error) : json_null(), "above_ground",
                     isfinite(s->above_ground) ? json_real(s->above_ground) : json_null(), "seconds", s->seconds);
}
