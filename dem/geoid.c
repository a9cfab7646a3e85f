/* Heights above the ellipsoid: a source's own, plus the undulation of a geoid under each sample. PROJ looks it up in a
 * grid, some four million a second, and bilinearly, so that it has kinks; it is interpolated from a control grid for
 * each block of samples, and blocks are kept. A block's undulations depend on nothing but its place. */
#include "dem/block_cache.h"
#include "dem/control_grid.h"
#include "dem/crs.h"
#include "dem/crs_ellipsoidal.h"
#include "dem/crs_map.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"

#include <errno.h>
#include <math.h>
#include <proj.h>
#include <pthread.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

enum {
    BLOCK = 256, /* samples on a side */
    BLOCK_SAMPLES = BLOCK * BLOCK,
    SMALLEST = 16, /* samples on a side of what is looked up one by one, where a control grid would not pay */
    SHARE = 16,    /* of a window's samples, one is the most that its control grid may look up */
    COARSEST = 62,
    KEPT_BYTES = 16 << 20,
};

/* Metres. The error is measured in the middles of the control grid's cells, where it must be below half of this. Where
 * the function has a kink, the error of cubic interpolation is at most 3.2 times what the worst middle shows (at a kink
 * close to the rim; over all places of one): 0.4 mm. */
static const double tolerance = 2.5e-4;

static const char grid_alias[] = "talus_geoid";
/* PROJ's names of the grid of EGM96, in the order in which they are tried. */
static const char *const egm96_names[] = {"egm96_15.gtx", "us_nga_egm96_15.tif"};

/* What one thread needs for exact undulations. */
typedef struct lookup {
    PJ_CONTEXT *context;
    PJ *shift;
    dem_projection *projection;
    struct lookup *next; /* among the idle ones */
} lookup;

typedef struct geoid_source {
    tl_source source;
    const tl_source *original;
    char *grid;     /* as the user named it */
    char *path;     /* of the file, where the user named one */
    const char *id; /* what PROJ is asked for */
    double meridian;
    dem_block_cache *cache;
    uint64_t keys[COARSEST + 1]; /* by level, finest first */
    pthread_mutex_t lock;
    lookup *idle;
    tl_parameter *parameters;
    const tl_crs *crs;
} geoid_source;

/* ---- undulations, exactly ---- */

static void lookup_destroy(lookup *l)
{
    if (!l)
        return;
    proj_destroy(l->shift);
    if (l->context)
        proj_context_destroy(l->context);
    dem_projection_destroy(l->projection);
    free(l);
}

/* A file is found by its own path, whatever characters that has. */
static const char *find_file(PJ_CONTEXT *context, const char *name, void *path)
{
    (void)context;
    return strcmp(name, grid_alias) == 0 ? path : NULL;
}

/* Without a grid that PROJ can read `shift` is NULL. */
static tl_status lookup_create(const geoid_source *g, const char *id, lookup **out, tl_error *error)
{
    lookup *l = calloc(1, sizeof *l);
    if (!l)
        return tl_fail_memory(error, g->grid);
    l->context = dem_proj_context();
    tl_error own = {0};
    l->projection = l->context ? dem_projection_create(g->original->info.georef.crs, &own) : NULL;
    if (!l->projection) {
        tl_status status = l->context ? own.status : tl_fail_memory(&own, g->grid);
        if (error)
            *error = own;
        lookup_destroy(l);
        return status;
    }
    char definition[128];
    snprintf(definition, sizeof definition, "+proj=vgridshift +grids=%s +multiplier=1", id);
    proj_context_set_file_finder(l->context, find_file, g->path);
    l->shift = proj_create(l->context, definition);
    *out = l;
    return TL_OK;
}

static tl_status lookup_take(const geoid_source *g, lookup **out, tl_error *error)
{
    geoid_source *self = (geoid_source *)g;
    pthread_mutex_lock(&self->lock);
    lookup *found = self->idle;
    if (found)
        self->idle = found->next;
    pthread_mutex_unlock(&self->lock);
    tl_status status = found ? TL_OK : lookup_create(g, g->id, &found, error);
    if (status == TL_OK && !found->shift) {
        lookup_destroy(found);
        status = tl_fail(error, TL_ERROR_IO, "%s: PROJ cannot read it any more", g->grid);
    }
    if (status == TL_OK)
        *out = found;
    return status;
}

static void lookup_give_back(const geoid_source *g, lookup *l)
{
    geoid_source *self = (geoid_source *)g;
    pthread_mutex_lock(&self->lock);
    l->next = self->idle;
    self->idle = l;
    pthread_mutex_unlock(&self->lock);
}

/* Positions of level 0 where the samples of a level lie: the middles of their cells, or the points themselves. */
static void to_finest(const tl_source_info *info, int level, size_t n, double *i, double *j)
{
    double size = ldexp(1, -level), shift = info->type == TL_RASTER_AREA ? (size - 1) / 2 : 0;
    for (size_t k = 0; k < n; k++) {
        i[k] = i[k] * size + shift;
        j[k] = j[k] * size + shift;
    }
}

/* Sample positions become longitudes (east of Greenwich) and latitudes, in degrees. */
static void to_lonlat(const geoid_source *g, lookup *l, size_t n, double *i, double *j)
{
    const double *t = g->original->info.georef.transform;
    for (size_t k = 0; k < n; k++) {
        double x = t[0] + t[1] * i[k] + t[2] * j[k], y = t[3] + t[4] * i[k] + t[5] * j[k];
        i[k] = x;
        j[k] = y;
    }
    dem_projection_to_lonlat(l->projection, n, i, j);
    for (size_t k = 0; k < n; k++) {
        i[k] += g->meridian;
        if (fabs(j[k]) > 90 && fabs(j[k]) < 90 + 1e-6) /* rounding must not push a sample over the pole */
            j[k] = copysign(90, j[k]);
    }
}

/* Undulations in metres; NaN where the grid has none. Overwrites i and j. */
static void undulations(const geoid_source *g, lookup *l, int level, size_t n, double *i, double *j, double *out)
{
    const double radians = 0.017453292519943295;
    to_finest(&g->source.info, level, n, i, j);
    to_lonlat(g, l, n, i, j);
    for (size_t k = 0; k < n; k++) {
        i[k] *= radians;
        j[k] *= radians;
        out[k] = 0;
    }
    proj_trans_generic(l->shift, PJ_FWD, i, sizeof *i, n, j, sizeof *j, n, out, sizeof *out, n, NULL, 0, 0);
    for (size_t k = 0; k < n; k++)
        if (!isfinite(out[k]) || !isfinite(i[k]))
            out[k] = (double)NAN;
}

/* ---- blocks ---- */

typedef struct block_job {
    const geoid_source *g;
    lookup *lookup;
    int level;
    double i[BLOCK], j[BLOCK], row[BLOCK];
} block_job;

static void evaluate(void *context, size_t n, const double *i, const double *j, double *out)
{
    block_job *job = context;
    for (size_t done = 0; done < n; done += BLOCK) {
        size_t part = n - done < BLOCK ? n - done : BLOCK;
        memcpy(job->i, i + done, part * sizeof *i);
        memcpy(job->j, j + done, part * sizeof *j);
        undulations(job->g, job->lookup, job->level, part, job->i, job->j, out + done);
    }
}

/* Cut at the rim of the level. */
static tl_status block_window(const geoid_source *g, int level, int64_t column, int64_t row, tl_window *out,
                              tl_error *error)
{
    int64_t width, height, x = column * BLOCK, y = row * BLOCK;
    tl_status status = tl_source_size(&g->source, level, &width, &height, error);
    if (status == TL_OK)
        *out = (tl_window){x, y, tl_int64_min(BLOCK, width - x), tl_int64_min(BLOCK, height - y)};
    return status;
}

/* The samples of a window, from its control grid, or one by one where there is none. */
static void fill_rows(block_job *job, const dem_control_grid *grid, tl_window window, float *block)
{
    double i[BLOCK], j[BLOCK];
    size_t width = (size_t)window.width;
    for (int64_t y = window.y; y < window.y + window.height; y++) {
        for (size_t k = 0; k < width; k++) {
            i[k] = (double)window.x + (double)k;
            j[k] = (double)y;
        }
        if (grid)
            dem_control_grid_apply(grid, width, i, j, job->row);
        else
            undulations(job->g, job->lookup, job->level, width, i, j, job->row);
        float *out = block + y % BLOCK * BLOCK + window.x % BLOCK;
        for (size_t k = 0; k < width; k++)
            out[k] = (float)job->row[k];
    }
}

static tl_window quarter(tl_window w, int k)
{
    int64_t left = (w.width + 1) / 2, upper = (w.height + 1) / 2;
    return (tl_window){k & 1 ? w.x + left : w.x, k & 2 ? w.y + upper : w.y, k & 1 ? w.width - left : left,
                       k & 2 ? w.height - upper : upper};
}

/* Fills the window's part of a block. Where a kink goes through it, which would need a fine control grid all over, its
 * quarters are filled one by one. */
static tl_status fill_window(block_job *job, tl_window window, float *block, tl_error *error)
{
    dem_control_function function = {
        .components = 1, .evaluate = evaluate, .context = job, .weights = {1}, .tolerance = tolerance};
    dem_control_grid *grid = NULL;
    bool small = window.width <= SMALLEST || window.height <= SMALLEST;
    tl_status status = TL_OK;
    if (!small)
        status =
            dem_control_grid_create(&function, window, (size_t)(window.width * window.height) / SHARE, &grid, error);
    if (status == TL_OK && (small || grid))
        fill_rows(job, grid, window, block);
    for (int k = 0; status == TL_OK && !small && !grid && k < 4; k++)
        status = fill_window(job, quarter(window, k), block, error);
    dem_control_grid_destroy(grid);
    return status;
}

/* The block's undulations in metres, new. */
static tl_status make_block(const geoid_source *g, int level, int64_t column, int64_t row, float **out, tl_error *error)
{
    float *made = calloc(BLOCK_SAMPLES, sizeof *made);
    block_job *job = malloc(sizeof *job);
    tl_window window = {0};
    tl_status status = made && job ? TL_OK : tl_fail_memory(error, g->grid);
    if (status == TL_OK)
        status = block_window(g, level, column, row, &window, error);
    if (status == TL_OK) {
        *job = (block_job){.g = g, .level = level};
        status = lookup_take(g, &job->lookup, error);
    }
    if (status == TL_OK) {
        status = fill_window(job, window, made, error);
        lookup_give_back(g, job->lookup);
    }
    free(job);
    if (status == TL_OK)
        *out = made;
    else
        free(made);
    return status;
}

/* The block (column, row), pinned. */
static tl_status get_block(const geoid_source *g, int level, int64_t column, int64_t row, dem_cached_block **out,
                           tl_error *error)
{
    int64_t across = tl_div_up(g->source.info.width, BLOCK); /* of the finest level: enough for all */
    uint64_t key = g->keys[-level] + (uint64_t)(row * across + column);
    *out = dem_block_cache_find(g->cache, key);
    if (*out)
        return TL_OK;
    dem_block_cache_lock(g->cache, key);
    *out = dem_block_cache_find(g->cache, key);
    float *made = NULL;
    tl_status status = *out ? TL_OK : make_block(g, level, column, row, &made, error);
    if (status == TL_OK && made) {
        *out = dem_block_cache_add(g->cache, key, made, BLOCK_SAMPLES);
        status = *out ? TL_OK : tl_fail_memory(error, g->grid);
    }
    dem_block_cache_unlock(g->cache, key);
    return status;
}

/* ---- reading ---- */

static tl_status fail_uncovered(const geoid_source *g, int level, int64_t x, int64_t y, tl_error *error)
{
    lookup *l;
    double i = (double)x, j = (double)y;
    tl_status status = lookup_take(g, &l, error);
    if (status != TL_OK)
        return status;
    to_finest(&g->source.info, level, 1, &i, &j);
    to_lonlat(g, l, 1, &i, &j);
    lookup_give_back(g, l);
    return tl_fail(error, TL_ERROR_DATA,
                   "%s: the geoid grid %s has no value at longitude %.6g, latitude %.6g, where there are heights; name "
                   "a grid that covers all of them",
                   g->source.info.name, g->grid, i, j);
}

/* Adds the undulations of a block to the part of the window that lies in it. */
static tl_status add_part(const geoid_source *g, int level, tl_window window, tl_window part, const float *block,
                          float *heights, tl_error *error)
{
    double unit = g->source.info.georef.height_unit;
    for (int64_t y = part.y; y < part.y + part.height; y++) {
        float *row = heights + (y - window.y) * window.width - window.x;
        const float *add = block + y % BLOCK * BLOCK;
        for (int64_t x = part.x; x < part.x + part.width; x++) {
            if (isnan(row[x]))
                continue;
            if (isnan(add[x % BLOCK]))
                return fail_uncovered(g, level, x, y, error);
            row[x] = (float)((double)row[x] + (double)add[x % BLOCK] / unit);
        }
    }
    return TL_OK;
}

static bool any_height(tl_window window, tl_window part, const float *heights)
{
    for (int64_t y = part.y; y < part.y + part.height; y++)
        for (int64_t x = part.x; x < part.x + part.width; x++)
            if (!isnan(heights[(y - window.y) * window.width + x - window.x]))
                return true;
    return false;
}

static tl_status geoid_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    const geoid_source *g = (const geoid_source *)self;
    tl_status status = tl_source_read(g->original, level, window, out, error);
    for (int64_t y = window.y; status == TL_OK && y < window.y + window.height; y = (y / BLOCK + 1) * BLOCK)
        for (int64_t x = window.x; status == TL_OK && x < window.x + window.width; x = (x / BLOCK + 1) * BLOCK) {
            tl_window part = {x, y, tl_int64_min((x / BLOCK + 1) * BLOCK, window.x + window.width) - x,
                              tl_int64_min((y / BLOCK + 1) * BLOCK, window.y + window.height) - y};
            dem_cached_block *block;
            if (!any_height(window, part, out))
                continue;
            status = get_block(g, level, x / BLOCK, y / BLOCK, &block, error);
            if (status != TL_OK)
                return status;
            status = add_part(g, level, window, part, dem_cached_block_heights(block), out, error);
            dem_block_cache_unpin(g->cache, block);
        }
    return status;
}

static tl_status geoid_size(const tl_source *self, int level, int64_t *width, int64_t *height, tl_error *error)
{
    if (level < -COARSEST)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: has no level %d", self->info.name, level);
    return tl_source_size(((const geoid_source *)self)->original, level, width, height, error);
}

static tl_status geoid_validity(const tl_source *self, int level, tl_window window, unsigned char *out, tl_error *error)
{
    return tl_source_validity(((const geoid_source *)self)->original, level, window, out, error);
}

static void geoid_destroy(tl_source *self)
{
    geoid_source *g = (geoid_source *)self;
    for (lookup *l = g->idle, *next; l; l = next) {
        next = l->next;
        lookup_destroy(l);
    }
    pthread_mutex_destroy(&g->lock);
    dem_block_cache_destroy(g->cache);
    tl_crs_release(g->crs);
    free(g->parameters);
    free(g->grid);
    free(g->path);
    free(g);
}

/* ---- making ---- */

static bool is_egm96(const char *name)
{
    return strcmp(name, "egm96") == 0;
}

/* EGM96 is above the ellipsoid of WGS 84. GRS 80 has the same to a tenth of a millimetre, and its datums lie within two
 * metres; others do not lie where WGS 84 does. */
static tl_status check_place(const tl_source_info *info, const char *grid, tl_error *error)
{
    const tl_crs *crs = info->georef.crs;
    if (!crs || !info->georef.located)
        return tl_fail(error, TL_ERROR_DATA, "%s: its %s is not known, so no geoid can be looked up", info->name,
                       crs ? "place" : "coordinate reference system");
    bool wgs84 = fabs(crs->semi_major - 6378137) < 0.01 && fabs(crs->flattening - 1 / 298.257223563) < 1e-9;
    if (is_egm96(grid) && !wgs84)
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: %s is not on the ellipsoid of WGS 84, which EGM96 lies above; warp it to WGS 84 first",
                       info->name, crs->name);
    return info->level == 0 ? TL_OK
                            : tl_fail(error, TL_ERROR_ARGUMENT,
                                      "%s: is refined already; take the geoid from the elevation model", info->name);
}

/* Whether the grid can be read: PROJ opens one late whose name it has met before. Places that a good grid does not
 * cover are no matter here. */
static bool is_readable(PJ *shift)
{
    proj_trans(shift, PJ_FWD, proj_coord(0, 0, 0, 0));
    bool good = proj_errno(shift) != PROJ_ERR_INVALID_OP_FILE_NOT_FOUND_OR_INVALID;
    proj_errno_reset(shift);
    return good;
}

/* Opens the grid once; the lookup is the first idle one. */
static tl_status try_grid(geoid_source *g, const char *id, tl_error *error)
{
    lookup *l = NULL;
    tl_status status = lookup_create(g, id, &l, error);
    if (status != TL_OK)
        return status;
    if (!l->shift || !is_readable(l->shift)) {
        lookup_destroy(l);
        return TL_OK;
    }
    g->id = id;
    lookup_give_back(g, l);
    return TL_OK;
}

static tl_status find_grid(geoid_source *g, tl_error *error)
{
    size_t names = sizeof egm96_names / sizeof *egm96_names;
    tl_status status = TL_OK;
    if (is_egm96(g->grid)) {
        for (size_t k = 0; status == TL_OK && !g->id && k < names; k++)
            status = try_grid(g, egm96_names[k], error);
        return status != TL_OK || g->id
                   ? status
                   : tl_fail(error, TL_ERROR_IO,
                             "egm96: PROJ has no grid %s; install it (Debian: package proj-data) or name a grid file",
                             egm96_names[0]);
    }
    g->path = strdup(g->grid);
    if (!g->path)
        return tl_fail_memory(error, g->grid);
    struct stat there;
    if (access(g->path, R_OK) != 0 || stat(g->path, &there) != 0)
        return tl_fail_system(error, g->path, "read", errno);
    if (!S_ISREG(there.st_mode))
        return tl_fail(error, TL_ERROR_DATA, "%s: not a file; name a grid of geoid heights, .gtx or GeoTIFF", g->grid);
    status = try_grid(g, grid_alias, error);
    return status != TL_OK || g->id
               ? status
               : tl_fail(error, TL_ERROR_DATA, "%s: no grid of geoid heights that PROJ can read; .gtx and GeoTIFF are",
                         g->grid);
}

static tl_status note_grid(geoid_source *g, tl_error *error)
{
    tl_source_info *info = &g->source.info;
    const char *slash = strrchr(g->grid, '/');
    char *name = strdup(slash ? slash + 1 : g->grid);
    g->parameters = tl_parameters_copy(info->parameters, info->parameter_count);
    tl_status status = !name || (info->parameter_count && !g->parameters) ? tl_fail_memory(error, info->name) : TL_OK;
    if (status == TL_OK) {
        tl_make_printable(name);
        status = tl_parameters_add(&g->parameters, &info->parameter_count, "geoid", name, error);
    }
    info->parameters = g->parameters;
    free(name);
    return status;
}

static tl_status prepare(geoid_source *g, size_t memory, tl_error *error)
{
    tl_source_info *info = &g->source.info;
    int64_t blocks = tl_div_up(info->width, BLOCK) * tl_div_up(info->height, BLOCK);
    tl_status status = dem_crs_make_ellipsoidal(info->georef.crs, info->georef.height_unit, info->name, &g->crs, error);
    if (status != TL_OK)
        return status;
    g->meridian = dem_crs_prime_meridian(info->georef.crs);
    g->cache = dem_block_cache_create(memory ? memory : KEPT_BYTES, (uint64_t)blocks);
    if (!g->cache)
        return tl_fail_memory(error, g->grid);
    for (int k = 0; k <= COARSEST; k++)
        g->keys[k] = dem_block_cache_keys(g->cache);
    status = find_grid(g, error);
    if (status != TL_OK)
        return status;
    info->georef.crs = g->crs;
    return note_grid(g, error);
}

tl_source *tl_geoid_create(const tl_source *source, const tl_geoid_options *options, tl_error *error)
{
    const char *name = source->info.name;
    if (check_place(&source->info, options->grid, error) != TL_OK)
        return NULL;
    geoid_source *g = calloc(1, sizeof *g);
    char *grid = g ? strdup(options->grid) : NULL;
    if (!grid) {
        free(g);
        tl_fail_memory(error, name);
        return NULL;
    }
    g->source = (tl_source){.info = source->info,
                            .read = geoid_read,
                            .size = source->size ? geoid_size : NULL,
                            .validity = geoid_validity,
                            .destroy = geoid_destroy};
    g->source.info.quantum = 0;
    g->original = source;
    g->grid = grid;
    pthread_mutex_init(&g->lock, NULL);
    if (prepare(g, options->memory, error) == TL_OK)
        return &g->source;
    geoid_destroy(&g->source);
    return NULL;
}
