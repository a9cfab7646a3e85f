/* A fractional Brownian surface as a source: an exact coarse field, refined. */
#include "fbm/elementary.h"
#include "fbm/exact.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/size.h"
#include "lib/scene/chain.h"

#include <assert.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

enum {
    COARSE_CELLS = 256, /* cells on a side of the exact field, at most */
    HALO = 8,           /* coarse samples beyond it that refinement can see; converges to this (see chain) */
    ROW_HALO = 3,       /* and so many more for every halving of the rows */
    BLOCK = 512,
};

typedef struct noise {
    tl_source source;
    scene_chain chain;
    int levels;         /* refinements of the exact field */
    int64_t side, halo; /* of the exact field, halo included; samples of the halo */
    float *exact;
    tl_parameter *parameters;
} noise;

static tl_status load(void *context, fbm_window window, float *buffer, float *const planes[SCENE_PLANES],
                      tl_error *error)
{
    (void)planes;
    (void)error;
    const noise *n = context;
    int64_t i = window.i + n->halo, j = window.j + n->halo;
    assert(i >= 0 && j >= 0 && i + (int64_t)window.width <= n->side && j + (int64_t)window.height <= n->side);
    for (size_t row = 0; row < window.height; row++)
        memcpy(buffer + row * window.width, n->exact + (j + (int64_t)row) * n->side + i, window.width * sizeof *buffer);
    return TL_OK;
}

static tl_status noise_read(const tl_source *self, int level, tl_window window, float *out, tl_error *error)
{
    (void)level;
    const noise *n = (const noise *)self;
    tl_status status = TL_OK;
    for (int64_t y = 0; y < window.height && status == TL_OK; y += BLOCK)
        for (int64_t x = 0; x < window.width && status == TL_OK; x += BLOCK) {
            size_t width = (size_t)tl_int64_min(BLOCK, window.width - x),
                   height = (size_t)tl_int64_min(BLOCK, window.height - y);
            scene_chain_target target = {.level = n->levels,
                                         .window = {window.x + x, window.y + y, width, height, (size_t)window.width},
                                         .out = out + y * window.width + x};
            status = scene_chain_run(&n->chain, &target, load, (void *)n, self->info.name, error);
        }
    return status;
}

static void noise_destroy(tl_source *self)
{
    noise *n = (noise *)self;
    free(n->exact);
    free(n->parameters);
    free(n);
}

static tl_status check(const tl_noise_options *o, tl_error *error)
{
    if (o->size < 1 || o->size > INT64_C(1) << 30)
        return tl_fail(error, TL_ERROR_ARGUMENT, "the size must be from 1 to 2^30 samples, not %lld",
                       (long long)o->size);
    if (!(o->hurst >= FBM_HURST_MIN && o->hurst <= FBM_HURST_MAX))
        return tl_fail(error, TL_ERROR_ARGUMENT, "the Hurst exponent must be from 0.01 to 0.99, not %g", o->hurst);
    if (!(o->delta >= 0 && o->delta <= 1e30))
        return tl_fail(error, TL_ERROR_ARGUMENT, "delta must be from 0 to 1e30, not %g", o->delta);
    if (o->aspect != 0 && !(o->aspect >= FBM_ASPECT_MIN && o->aspect <= 1 / FBM_ASPECT_MIN))
        return tl_fail(error, TL_ERROR_ARGUMENT, "the aspect must be from 0.2 to 5, not %g", o->aspect);
    return TL_OK;
}

/* Bytes of the machine; 0 where it does not tell. */
static double physical_memory(void)
{
#ifdef _SC_PHYS_PAGES
    return (double)sysconf(_SC_PHYS_PAGES) * (double)sysconf(_SC_PAGESIZE);
#else
    return 0;
#endif
}

static tl_status make_exact(noise *n, const tl_noise_options *o, tl_error *error)
{
    double delta = o->delta * fbm_exp2(o->hurst * n->levels); /* over one coarse sample */
    double aspect = n->source.info.georef.cell_x;
    size_t side = (size_t)n->side, bytes = fbm_exact_memory(side, aspect, o->hurst);
    double room = physical_memory(), need = (double)bytes + (double)side * (double)side * sizeof(float);
    if (bytes == 0 || (room > 0 && need > room))
        return tl_fail(error, TL_ERROR_MEMORY,
                       "scheme 'exact': %lld samples a side do not fit into memory (%.3g GB of %.3g); take fewer, or "
                       "'stationary'",
                       (long long)n->side, need / 1e9, room / 1e9);
    n->exact = tl_alloc_grid(n->side, n->side, sizeof *n->exact);
    fbm_status status = n->exact ? fbm_exact_cells(side, aspect, o->hurst, delta, o->seed, n->exact) : FBM_NO_MEMORY;
    return status == FBM_OK ? TL_OK : tl_fail_memory(error, "the exact field");
}

static tl_status note_all(noise *n, const tl_noise_options *o, const char *scheme, tl_error *error)
{
    char seed[TL_NUMBER_TEXT], hurst[TL_NUMBER_TEXT], delta[TL_NUMBER_TEXT], aspect[TL_NUMBER_TEXT];
    snprintf(seed, sizeof seed, "%llu", (unsigned long long)o->seed);
    tl_number_text(o->hurst, hurst);
    tl_number_text(o->delta, delta);
    tl_number_text(o->aspect, aspect);
    const tl_parameter all[] = {
        {"scheme", scheme}, {"seed", seed}, {"hurst", hurst}, {"delta", delta}, {"aspect", aspect}};
    size_t noted = sizeof all / sizeof *all - (o->aspect == 0);
    tl_source_info *info = &n->source.info;
    tl_parameter *list = NULL;
    size_t count = 0;
    tl_status status = tl_parameters_add_origin(&list, &count, info, error);
    for (size_t i = 0; i < noted && status == TL_OK; i++)
        status = tl_parameters_add(&list, &count, all[i].name, all[i].value, error);
    info->parameters = n->parameters = list;
    info->parameter_count = count;
    return status;
}

static void set_chain(noise *n, const tl_noise_options *o, const fbm_scheme *scheme, double aspect)
{
    double hursts[SCENE_LEVEL_MAX + 1], mean = fbm_pow(aspect, o->hurst / 2); /* delta over a cell's mean side */
    for (int l = 0; l < n->levels; l++) {
        fbm_step *step = &n->chain.steps[l];
        /* the finest step is always level -1, so that a larger surface is another one, but of the same kind */
        *step = (fbm_step){.scheme = scheme, .seed = o->seed, .level = l - n->levels};
        step->amplitude = (float)(o->delta * mean * fbm_exp2(o->hurst * (n->levels - l)));
        hursts[l] = o->hurst;
    }
    if (n->levels > 0)
        scene_chain_fit_aspect(&n->chain, aspect, hursts, n->levels - 1);
}

tl_source *tl_noise_create(const tl_noise_options *o, tl_error *error)
{
    bool exact = o->scheme && !strcmp(o->scheme, SCENE_EXACT);
    const fbm_scheme *scheme = exact ? fbm_schemes : scene_scheme(o->scheme, error);
    if (!scheme || check(o, error) != TL_OK)
        return NULL;
    noise *n = calloc(1, sizeof *n);
    if (!n) {
        tl_fail_memory(error, "the noise");
        return NULL;
    }
    while (!exact && ((o->size - 1) >> n->levels) > COARSE_CELLS)
        n->levels++;
    n->source = (tl_source){.info = {.width = o->size,
                                     .height = o->size,
                                     .type = scheme->cells ? TL_RASTER_AREA : TL_RASTER_POINT,
                                     .georef = tl_georef_none(),
                                     .name = "noise"},
                            .read = noise_read,
                            .destroy = noise_destroy};
    double aspect = o->aspect != 0 ? o->aspect : 1;
    n->source.info.georef.cell_x = n->source.info.georef.transform[1] = aspect;
    n->source.info.georef.located = aspect != 1;
    set_chain(n, o, scheme, aspect);
    n->halo = exact ? 0 : HALO + ROW_HALO * n->chain.shape.halvings;
    n->side = tl_div_up(o->size - 1, INT64_C(1) << n->levels) + 1 + 2 * n->halo;
    if (note_all(n, o, exact ? SCENE_EXACT : scheme->name, error) != TL_OK || make_exact(n, o, error) != TL_OK) {
        noise_destroy(&n->source);
        return NULL;
    }
    return &n->source;
}
