#include "dem/crs.h"

#include "dem/crs_map.h"
#include "dem/geographiclib.h"
#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <proj.h>
#include <proj_experimental.h>
#include <string.h>

struct dem_projection {
    PJ_CONTEXT *context;
    dem_map *map;  /* GeographicLib's, where it has the projection */
    PJ *to_lonlat; /* else PROJ's; both NULL: coordinates are longitude and latitude already */
};

/* ---- Comparison ---- */

static void no_message(void *user, int level, const char *text)
{
    (void)user;
    (void)level;
    (void)text;
}

PJ_CONTEXT *dem_proj_context(void)
{
    PJ_CONTEXT *context = proj_context_create();
    if (context) {
        /* a level of none does not silence a missing database */
        proj_log_func(context, NULL, no_message);
        proj_log_level(context, PJ_LOG_NONE);
        proj_context_set_enable_network(context, 0);
    }
    return context;
}

static bool equivalent_wkt(const char *a, const char *b)
{
    PJ_CONTEXT *context = dem_proj_context();
    if (!context)
        return false;
    PJ *first = proj_create(context, a), *second = proj_create(context, b);
    /* the order of axes is no matter: ours is always x, y */
    bool same = first && second &&
                proj_is_equivalent_to_with_ctx(context, first, second, PJ_COMP_EQUIVALENT_EXCEPT_AXIS_ORDER_GEOGCRS);
    proj_destroy(second);
    proj_destroy(first);
    proj_context_destroy(context);
    return same;
}

static const char *horizontal_wkt(const tl_crs *crs)
{
    return crs->horizontal_wkt ? crs->horizontal_wkt : crs->wkt;
}

bool dem_crs_equivalent(const tl_crs *a, const tl_crs *b)
{
    if (a == b || (a->epsg && a->epsg == b->epsg) || (*a->wkt && strcmp(a->wkt, b->wkt) == 0))
        return true;
    return !(a->epsg && b->epsg) && equivalent_wkt(horizontal_wkt(a), horizontal_wkt(b));
}

/* ---- Projections ---- */

/* The operation from a projected CRS to its own geographic CRS in degrees, in the order x, y to longitude, latitude. */
static PJ *make_operation(PJ_CONTEXT *context, const PJ *crs)
{
    PJ *base = proj_crs_get_geodetic_crs(context, crs);
    PJ *degrees =
        base ? proj_crs_alter_cs_angular_unit(context, base, "degree", 0.017453292519943295, NULL, NULL) : NULL;
    PJ *any_order = degrees ? proj_create_crs_to_crs_from_pj(context, crs, degrees, NULL, NULL) : NULL;
    PJ *operation = any_order ? proj_normalize_for_visualization(context, any_order) : NULL;
    proj_destroy(any_order);
    proj_destroy(degrees);
    proj_destroy(base);
    return operation;
}

/* GeographicLib is exact where PROJ iterates, and much the same everywhere: PROJ has what it does not have. */
static void find_map(dem_projection *projection, const tl_crs *crs)
{
    dem_map_definition definition;
    PJ *object = proj_create(projection->context, horizontal_wkt(crs));
    if (object && dem_crs_map(projection->context, object, crs, &definition))
        projection->map = dem_map_create(&definition);
    if (object && !projection->map)
        projection->to_lonlat = make_operation(projection->context, object);
    proj_destroy(object);
}

static tl_status prepare(dem_projection *projection, const tl_crs *crs, tl_error *error)
{
    if (crs->geographic)
        return TL_OK;
    projection->context = dem_proj_context();
    if (!projection->context)
        return tl_fail_memory(error, crs->name);
    find_map(projection, crs);
    if (!projection->map && !projection->to_lonlat)
        return tl_fail(error, TL_ERROR_DATA, "PROJ cannot convert coordinates of %s to longitude and latitude",
                       crs->name);
    return TL_OK;
}

dem_projection *dem_projection_create(const tl_crs *crs, tl_error *error)
{
    dem_projection *projection = calloc(1, sizeof *projection);
    if (!projection) {
        tl_fail_memory(error, crs->name);
        return NULL;
    }
    if (prepare(projection, crs, error) == TL_OK)
        return projection;
    dem_projection_destroy(projection);
    return NULL;
}

void dem_projection_destroy(dem_projection *projection)
{
    if (!projection)
        return;
    dem_map_destroy(projection->map);
    proj_destroy(projection->to_lonlat);
    if (projection->context) /* NULL would be PROJ's default context */
        proj_context_destroy(projection->context);
    free(projection);
}

const char *dem_projection_engine(const dem_projection *projection)
{
    return projection->map ? "GeographicLib" : projection->to_lonlat ? "PROJ" : "none";
}

static void transform(PJ *operation, PJ_DIRECTION direction, size_t n, double *x, double *y)
{
    proj_trans_generic(operation, direction, x, sizeof *x, n, y, sizeof *y, n, NULL, 0, 0, NULL, 0, 0);
    for (size_t k = 0; k < n; k++)
        if (!isfinite(x[k]) || !isfinite(y[k]))
            x[k] = y[k] = (double)NAN;
}

void dem_projection_to_lonlat(dem_projection *projection, size_t n, double *x, double *y)
{
    if (projection->map)
        dem_map_to_lonlat(projection->map, n, x, y);
    else if (projection->to_lonlat)
        transform(projection->to_lonlat, PJ_FWD, n, x, y);
}

void dem_projection_from_lonlat(dem_projection *projection, size_t n, double *longitude, double *latitude)
{
    if (projection->map)
        dem_map_from_lonlat(projection->map, n, longitude, latitude);
    else if (projection->to_lonlat)
        transform(projection->to_lonlat, PJ_INV, n, longitude, latitude);
}
