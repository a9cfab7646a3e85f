/* A framework as a sparse GeoTIFF, and back.
 *
 * Three bands, void where no point is kept: the height; the Hurst exponent and the standard deviation of the height
 * difference over one sample of what lies between. Where the elevation model itself is void the exponent is 0, so that
 * holes are not taken for ground without points. The splits of the triangles follow from the points and the holes: a
 * vertex splits just where it is a point, or one that needs it is, or where its triangles hold some of a hole. */
#include "lib/out/points.h"

#include "fbm/elementary.h"
#include "fbm/weights.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/out.h"
#include "lib/scene/restore.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum { BANDS = 3, ROWS = 64, TEXT = 64, SPREADS = TL_STAGES * 20 };

#define LABEL "framework"

/* ---- Writing ---- */

typedef struct band {
    tl_source base;
    const tl_framework *framework;
    const tl_source *dem; /* of the exponent's band, where there are voids; else NULL */
    int index;
    float value;
} band;

static tl_status read_band(const tl_source *base, int level, tl_window window, float *out, tl_error *error)
{
    const band *self = (const band *)base;
    float *dem = self->dem ? tl_alloc_grid(window.width, window.height, sizeof *dem) : NULL;
    (void)level;
    if (self->dem && !dem)
        return tl_fail_memory(error, "the points");
    tl_status status = self->dem ? tl_source_read(self->dem, self->dem->info.level, window, dem, error) : TL_OK;
    if (dem)
        tl_heights_clean(dem, status == TL_OK ? (size_t)(window.width * window.height) : 0);
    for (int64_t y = 0; status == TL_OK && y < window.height; y++) {
        float *row = out + y * window.width;
        tl_framework_heights(self->framework, window.x, window.y + y, window.width, row);
        for (int64_t x = 0; self->index > 0 && x < window.width; x++)
            row[x] = !isnan(row[x]) ? self->value : dem && isnan(dem[y * window.width + x]) ? 0 : NAN;
    }
    free(dem);
    return status;
}

static tl_status note_all(const tl_framework *framework, double hurst, const double *spread, tl_parameter **list,
                          size_t *count, tl_error *error)
{
    char bound[TL_NUMBER_TEXT], exponent[TL_NUMBER_TEXT], spreads[SPREADS] = "";
    tl_number_text(framework->max_error, bound);
    tl_number_text(hurst, exponent);
    size_t used = 0;
    for (int k = 0; k < TL_STAGES; k++)
        used += (size_t)snprintf(spreads + used, sizeof spreads - used, "%s%.9g", k ? " " : "", spread[k]);
    const tl_parameter all[] = {{LABEL, "1"}, {"max_error", bound}, {"hurst", exponent}, {"spread", spreads}};
    tl_status status = TL_OK;
    for (size_t k = 0; status == TL_OK && k < sizeof all / sizeof *all; k++)
        status = tl_parameters_add(list, count, all[k].name, all[k].value, error);
    return status == TL_OK ? tl_parameters_add_origin(list, count, &framework->info, error) : status;
}

tl_status out_points_geotiff(const tl_framework *framework, const tl_source *dem, tl_output *output,
                             const tl_points_options *options, tl_error *error)
{
    double hurst, spread[TL_STAGES];
    tl_parameter *list = NULL;
    size_t count = 0;
    tl_status status = scene_restore_measure(framework, dem, options->run, &hurst, spread, error);
    if (status == TL_OK)
        status = note_all(framework, hurst, spread, &list, &count, error);
    band bands[BANDS];
    const tl_source *sources[BANDS];
    bool voids = framework->valid_count < (uint64_t)framework->info.width * (uint64_t)framework->info.height;
    for (int k = 0; k < BANDS; k++) {
        bands[k] = (band){.base = {.info = framework->info, .read = read_band},
                          .framework = framework,
                          .dem = voids && k == 1 ? dem : NULL,
                          .index = k,
                          .value = (float)(k == 1 ? hurst : spread[0] * fbm_exp2(hurst))};
        bands[k].base.info.parameters = list;
        bands[k].base.info.parameter_count = count;
        bands[k].base.info.has_voids = true;
        sources[k] = &bands[k].base;
    }
    const tl_write_options writing = {.run = options->run};
    if (status == TL_OK)
        status = out_geotiff_write_bands(sources, BANDS, output, &writing, error);
    free(list);
    return status;
}

/* ---- Reading ---- */

static bool item_number(const char *path, const char *name, double low, double high, double *out)
{
    char text[TEXT], *end;
    if (!out_geotiff_item(path, name, text, sizeof text))
        return false;
    *out = strtod(text, &end);
    return end != text && *out >= low && *out <= high;
}

bool tl_framework_is_file(const char *path)
{
    char text[TEXT];
    return out_geotiff_item(path, LABEL, text, sizeof text) && strcmp(text, "1") == 0;
}

static tl_source *open_band(const char *path, unsigned index, tl_error *error)
{
    return tl_dem_open(&path, 1, &(tl_dem_options){.band = index}, error);
}

/* Heights of the points into `to`, which gets NaN in holes and 0 where no point is; marks the points. */
static tl_status read_points(tl_framework *framework, const tl_source *heights, const tl_source *exponents, float *to,
                             tl_error *error)
{
    const tl_source_info *info = &framework->info;
    float *known = tl_alloc_grid(info->width, ROWS, sizeof *known);
    tl_status status = known ? TL_OK : tl_fail_memory(error, "the framework");
    for (int64_t y = 0; status == TL_OK && y < info->height; y += ROWS) {
        tl_window window = {0, y, info->width, tl_int64_min(ROWS, info->height - y)};
        size_t count = (size_t)(window.width * window.height);
        float *z = to + y * info->width;
        status = tl_source_read(heights, 0, window, z, error);
        if (status == TL_OK)
            status = tl_source_read(exponents, 0, window, known, error);
        tl_heights_clean(z, status == TL_OK ? count : 0);
        for (size_t k = 0; status == TL_OK && k < count; k++) {
            if (!isnan(z[k]))
                tl_framework_force(framework, (int64_t)k % info->width, y + (int64_t)k / info->width);
            else if (known[k] == 0)
                framework->voids = true;
            else
                z[k] = 0;
        }
    }
    free(known);
    return status;
}

static tl_status load(tl_framework *framework, const tl_source *heights, const char *path, const tl_run *run,
                      tl_error *error)
{
    const tl_source_info *info = &framework->info;
    tl_source *exponents = open_band(path, 2, error);
    if (!exponents)
        return TL_ERROR_DATA;
    float *z = tl_alloc_grid(info->width, info->height, sizeof *z);
    tl_status status = z ? read_points(framework, heights, exponents, z, error) : tl_fail_memory(error, path);
    if (status == TL_OK && framework->voids)
        tl_framework_mark_voids(framework, z);
    framework->voids |= !framework->columns || !framework->rows;
    const tl_rows rows = {.all = z};
    if (status == TL_OK)
        status = tl_framework_find_points(framework, &rows, run, error);
    free(z);
    tl_source_destroy(exponents);
    return status;
}

static bool read_spreads(const char *path, double out[TL_STAGES])
{
    char text[SPREADS], *at = text, *end;
    if (!out_geotiff_item(path, "spread", text, sizeof text))
        return false;
    for (int k = 0; k < TL_STAGES; k++, at = end) {
        out[k] = strtod(at, &end);
        if (end == at || !(out[k] >= 0 && out[k] <= 1e30))
            return false;
    }
    return true;
}

tl_framework *tl_framework_load(const char *path, const tl_run *run, tl_error *error)
{
    double bound, hurst, spread[TL_STAGES];
    if (!tl_framework_is_file(path) || !item_number(path, "max_error", 0, 1e30, &bound) ||
        !item_number(path, "hurst", FBM_HURST_MIN, FBM_HURST_MAX, &hurst) || !read_spreads(path, spread)) {
        tl_fail(error, TL_ERROR_ARGUMENT, "%s: not a framework that talus wrote; name another file", path);
        return NULL;
    }
    tl_source *heights = open_band(path, 1, error);
    if (!heights)
        return NULL;
    tl_framework *framework = NULL;
    double samples = (double)heights->info.width * (double)heights->info.height;
    if (tl_run_fits(run, 6 * samples, path, "its framework", error) == TL_OK)
        framework = tl_framework_create(&heights->info, bound, run, error);
    tl_status status = framework ? load(framework, heights, path, run, error) : TL_ERROR_MEMORY;
    tl_source_destroy(heights);
    if (status == TL_OK) {
        framework->hurst = hurst;
        memcpy(framework->spread, spread, sizeof spread);
        return framework;
    }
    tl_framework_destroy(framework);
    return NULL;
}
