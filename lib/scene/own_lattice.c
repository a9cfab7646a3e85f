#include "lib/scene/own_lattice.h"

#include "dem/bend.h"
#include "dem/crs.h"
#include "dem/crs_ellipsoidal.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* WGS 84, metres. */
static const double semi_major = 6378137, flattening = 1 / 298.257223563;
static const double pi = 3.14159265358979323846;

struct scene_own_lattice {
    const tl_source *source;
    int64_t width, height; /* vertices */
    bool turned;           /* row 0 is the source's last */
    bool geographic;
    double meridian; /* degrees */
    double middle;   /* longitude, radians */
    double cell;     /* the longer side, radians */
    dem_bend bend;   /* of maps */
};

struct scene_placer {
    const scene_own_lattice *lattice;
    dem_projection *projection;
};

/* ---- Places ---- */

scene_placer *scene_placer_create(const scene_own_lattice *lattice, tl_error *error)
{
    scene_placer *placer = malloc(sizeof *placer);
    if (!placer) {
        tl_fail_memory(error, lattice->source->info.name);
        return NULL;
    }
    *placer = (scene_placer){lattice, dem_projection_create(lattice->source->info.georef.crs, error)};
    if (placer->projection)
        return placer;
    free(placer);
    return NULL;
}

void scene_placer_destroy(scene_placer *placer)
{
    if (!placer)
        return;
    dem_projection_destroy(placer->projection);
    free(placer);
}

void scene_placer_lonlat(scene_placer *placer, size_t n, const double *x, const double *y, double *longitude,
                         double *latitude)
{
    const scene_own_lattice *g = placer->lattice;
    const double *t = g->source->info.georef.transform, last = (double)(g->source->info.height - 1);
    for (size_t k = 0; k < n; k++) {
        double i = x[k], j = g->turned ? last - y[k] : y[k];
        longitude[k] = t[0] + t[1] * i + t[2] * j;
        latitude[k] = t[3] + t[4] * i + t[5] * j;
    }
    if (!g->geographic)
        dem_projection_to_lonlat(placer->projection, n, longitude, latitude);
    for (size_t k = 0; k < n; k++) {
        longitude[k] = (longitude[k] + g->meridian) * (pi / 180);
        latitude[k] *= pi / 180;
        if (!g->geographic) /* maps give a longitude within one turn: that beside the middle's */
            longitude[k] -= 2 * pi * rint((longitude[k] - g->middle) / (2 * pi));
    }
}

/* [Hofmann-Wellenhof et al., Physical Geodesy: ellipsoidal to Cartesian coordinates] */
void scene_to_ecef(double longitude, double latitude, double height, double out[3])
{
    const double e2 = flattening * (2 - flattening), s = sin(latitude), c = cos(latitude);
    double normal = semi_major / sqrt(1 - e2 * s * s);
    out[0] = (normal + height) * c * cos(longitude);
    out[1] = (normal + height) * c * sin(longitude);
    out[2] = (normal * (1 - e2) + height) * s;
}

void scene_up(double longitude, double latitude, double out[3])
{
    out[0] = cos(latitude) * cos(longitude);
    out[1] = cos(latitude) * sin(longitude);
    out[2] = sin(latitude);
}

/* ---- The lattice ---- */

static tl_status check(const tl_source_info *info, tl_error *error)
{
    const tl_georef *g = &info->georef;
    if (!g->crs || !g->located)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: where on the globe it lies is not known; tiles of the globe need a CRS", info->name);
    if (info->width < 2 || info->height < 2)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no cell; tiles need at least 2 x 2 samples", info->name);
    return TL_OK;
}

static tl_status measure_bend(scene_own_lattice *g, tl_error *error)
{
    const double top = 9000; /* the highest ground; bending changes by a thousandth up to there */
    const tl_source_info *info = &g->source->info;
    dem_space *space = dem_space_create(&info->georef, info->width, info->height, info->name, error);
    if (!space)
        return TL_ERROR_DATA;
    g->bend = dem_space_bend(space, 0, 0, (double)info->width, (double)info->height, top);
    dem_space_destroy(space);
    return TL_OK;
}

static tl_status find_middle(scene_own_lattice *g, tl_error *error)
{
    double x = 0.5 * (double)g->width, y = 0.5 * (double)g->height, latitude;
    scene_placer *placer = scene_placer_create(g, error);
    if (!placer)
        return TL_ERROR_DATA;
    scene_placer_lonlat(placer, 1, &x, &y, &g->middle, &latitude);
    scene_placer_destroy(placer);
    return isfinite(g->middle) && isfinite(latitude)
               ? TL_OK
               : tl_fail(error, TL_ERROR_DATA, "%s: its middle has no longitude and latitude in %s",
                         g->source->info.name, tl_crs_name(g->source->info.georef.crs));
}

scene_own_lattice *scene_own_lattice_create(const tl_source *source, tl_error *error)
{
    const tl_source_info *info = &source->info;
    if (check(info, error) != TL_OK)
        return NULL;
    scene_own_lattice *g = calloc(1, sizeof *g);
    if (!g) {
        tl_fail_memory(error, info->name);
        return NULL;
    }
    const double *t = info->georef.transform;
    g->source = source;
    g->width = info->width + (info->wraps ? 1 : 0);
    g->height = info->height;
    g->turned = t[1] * t[5] - t[2] * t[4] < 0;
    g->geographic = tl_crs_is_geographic(info->georef.crs);
    g->meridian = dem_crs_prime_meridian(info->georef.crs);
    g->cell = fmax(info->georef.cell_x, info->georef.cell_y) / semi_major;
    if (g->geographic)
        g->cell = fmax(hypot(t[1], t[4]), hypot(t[2], t[5])) * pi / 180;
    tl_status status = find_middle(g, error);
    if (status == TL_OK && !g->geographic)
        status = measure_bend(g, error);
    if (status == TL_OK)
        return g;
    scene_own_lattice_destroy(g);
    return NULL;
}

void scene_own_lattice_destroy(scene_own_lattice *g)
{
    free(g);
}

tl_window scene_own_lattice_window(const scene_own_lattice *g)
{
    return (tl_window){0, 0, g->width, g->height};
}

bool scene_own_lattice_goes_around(const scene_own_lattice *g)
{
    return g->source->info.wraps;
}

bool scene_own_lattice_is_geographic(const scene_own_lattice *g)
{
    const double *t = g->source->info.georef.transform;
    return g->geographic && t[1] > 0 && t[2] == 0 && t[4] == 0;
}

/* Under the round Earth triangles lie by length^2 / 8 R; parallels are bent by half as much at most (sin cos of the
 * latitude), and count by the slope. Maps are measured. */
double scene_own_lattice_sag(const scene_own_lattice *g, double length2)
{
    const double slope = 2;
    double mapped = g->geographic ? HUGE_VAL : dem_bend_error(&g->bend, length2, slope * g->bend.cell);
    return isfinite(mapped) ? mapped : (1 + 0.5 * slope) * semi_major * g->cell * g->cell * length2 / 8;
}

/* ---- Heights ---- */

static tl_status read_inside(const scene_own_lattice *g, tl_window w, float *out, int64_t stride, tl_error *error)
{
    const tl_source_info *info = &g->source->info;
    const tl_window theirs = {w.x, g->turned ? g->height - w.y - w.height : w.y, w.width, w.height};
    float *z = tl_alloc_grid(w.width, w.height, sizeof *z);
    tl_status status = z ? tl_source_read(g->source, info->level, theirs, z, error) : tl_fail_memory(error, info->name);
    for (int64_t y = 0; y < w.height && status == TL_OK; y++) {
        const float *row = z + (g->turned ? w.height - 1 - y : y) * w.width;
        for (int64_t x = 0; x < w.width; x++)
            out[y * stride + x] = isfinite(row[x]) ? row[x] * (float)info->georef.height_unit : NAN;
    }
    free(z);
    return status;
}

tl_status scene_own_lattice_read(const scene_own_lattice *g, tl_window window, float *out, tl_error *error)
{
    int64_t x0 = tl_int64_max(window.x, 0), x1 = tl_int64_min(window.x + window.width, g->width);
    int64_t y0 = tl_int64_max(window.y, 0), y1 = tl_int64_min(window.y + window.height, g->height);
    for (int64_t k = 0; k < window.width * window.height; k++)
        out[k] = NAN;
    if (y0 >= y1)
        return TL_OK;
    int64_t own = tl_int64_min(x1, g->source->info.width), row = (y0 - window.y) * window.width;
    tl_status status = TL_OK;
    if (x0 < own)
        status = read_inside(g, (tl_window){x0, y0, own - x0, y1 - y0}, out + row + x0 - window.x, window.width, error);
    if (status == TL_OK && x0 <= own && own < x1) /* the first column once more */
        status = read_inside(g, (tl_window){0, y0, 1, y1 - y0}, out + row + own - window.x, window.width, error);
    return status;
}
