#include "lib/scene/chain.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <assert.h>
#include <pthread.h>
#include <string.h>

/* windows[l]: what level l must hold so that the target can be made. */
static void plan(const scene_chain *chain, const scene_chain_target *target, fbm_window *windows)
{
    int level = target->level;
    windows[level] = target->centres ? fbm_centres_support(chain->steps[level].scheme, target->window) : target->window;
    for (; level > 0; level--)
        windows[level - 1] = fbm_refine_support(chain->steps[level - 1].scheme, windows[level]);
}

fbm_window scene_chain_support(const scene_chain *chain, const scene_chain_target *target)
{
    fbm_window windows[SCENE_LEVEL_MAX + 1];
    plan(chain, target, windows);
    return windows[0];
}

typedef struct buffers {
    float *level[2], *map[2]; /* of even and of odd levels */
    float *scratch;
} buffers;

static void buffers_free(buffers *b)
{
    free(b->level[0]);
    free(b->level[1]);
    free(b->map[0]);
    free(b->map[1]);
    free(b->scratch);
}

/* Room for every window of the plan but the one that is written straight to the caller. */
static bool buffers_allocate(buffers *b, const fbm_window *windows, const scene_chain_target *target, bool mapped)
{
    size_t most[2] = {1, 1}, width = 1;
    int kept = target->centres ? target->level : target->level - 1;
    for (int l = 0; l <= target->level; l++) {
        size_t samples;
        if (!tl_size_mul(windows[l].width, windows[l].height, &samples))
            return false;
        if (l <= kept && samples > most[l & 1])
            most[l & 1] = samples;
        width = windows[l].width > width ? windows[l].width : width;
    }
    b->level[0] = tl_alloc(most[0], sizeof(float));
    b->level[1] = tl_alloc(most[1], sizeof(float));
    b->scratch = tl_alloc(fbm_refine_scratch(2 * width), sizeof(float));
    for (int k = 0; k < 2 && mapped; k++) {
        b->map[k] = tl_alloc(most[k], sizeof(float));
        if (!b->map[k])
            return false;
    }
    return b->level[0] && b->level[1] && b->scratch;
}

static void copy_rows(const float *from, fbm_window window, float *to)
{
    for (size_t row = 0; row < window.height; row++)
        memcpy(to + row * window.stride, from + row * window.width, window.width * sizeof *to);
}

/* The map of the next level, bilinear between the vertices of this one. */
static void refine_map(const buffers *b, int level, const fbm_window *windows)
{
    fbm_step means = {.scheme = fbm_scheme_find("square")};
    means.scheme->weights(.5, &means.weights);
    fbm_refine(&means, b->map[level & 1], windows[level], b->map[(level + 1) & 1], windows[level + 1], b->scratch);
}

static void refine_all(const scene_chain *chain, const scene_chain_target *target, const fbm_window *windows,
                       buffers *b)
{
    int whole_levels = target->centres ? target->level : target->level - 1; /* levels made into buffers */
    for (int l = 0; l < whole_levels; l++) {
        fbm_refine_mapped(&chain->steps[l], b->level[l & 1], b->map[l & 1], windows[l], b->level[(l + 1) & 1],
                          windows[l + 1], b->scratch);
        if (chain->mapped)
            refine_map(b, l, windows);
    }
    if (target->centres)
        fbm_centres_mapped(&chain->steps[target->level], b->level[target->level & 1], b->map[target->level & 1],
                           windows[target->level], target->out, target->window, b->scratch);
    else if (target->level > 0)
        fbm_refine_mapped(&chain->steps[whole_levels], b->level[whole_levels & 1], b->map[whole_levels & 1],
                          windows[whole_levels], target->out, target->window, b->scratch);
    else
        copy_rows(b->level[0], target->window, target->out);
}

tl_status scene_chain_run(const scene_chain *chain, const scene_chain_target *target, scene_chain_load load,
                          void *context, const char *name, tl_error *error)
{
    assert(target->level >= 0 && target->level <= SCENE_LEVEL_MAX);
    fbm_window windows[SCENE_LEVEL_MAX + 1];
    plan(chain, target, windows);
    buffers b = {0};
    tl_status status = TL_OK;
    if (target->level == 0 && !target->centres)
        windows[0].stride = windows[0].width; /* the buffer is dense; refined windows already are */
    if (!buffers_allocate(&b, windows, target, chain->mapped))
        status = tl_fail_memory(error, name);
    /* level 0 that goes to the caller still needs a buffer of its own */
    if (status == TL_OK && target->level == 0 && !target->centres) {
        free(b.level[0]);
        b.level[0] = tl_alloc_grid((int64_t)windows[0].width, (int64_t)windows[0].height, sizeof(float));
        free(b.map[0]);
        b.map[0] =
            chain->mapped ? tl_alloc_grid((int64_t)windows[0].width, (int64_t)windows[0].height, sizeof(float)) : NULL;
        if (!b.level[0] || (chain->mapped && !b.map[0]))
            status = tl_fail_memory(error, name);
    }
    if (status == TL_OK)
        status = load(context, windows[0], b.level[0], b.map[0], error);
    if (status == TL_OK)
        refine_all(chain, target, windows, &b);
    buffers_free(&b);
    return status;
}

const fbm_scheme *scene_scheme(const char *name, tl_error *error)
{
    const fbm_scheme *scheme = name ? fbm_scheme_find(name) : &fbm_schemes[0];
    if (!scheme)
        tl_fail(error, TL_ERROR_ARGUMENT, "scheme '%s': there is none of this name", name);
    return scheme;
}

enum { SCHEMES_MAX = 16 };

static tl_scheme schemes[SCHEMES_MAX];

static void list_schemes(void)
{
    schemes[0] = (tl_scheme){.name = SCENE_TERRAIN, .summary = "detail shaped by the place, as real terrain has it"};
    for (size_t i = 0; fbm_schemes[i].name; i++) {
        assert(i + 2 < SCHEMES_MAX);
        schemes[i + 1] = (tl_scheme){.name = fbm_schemes[i].name, .summary = fbm_schemes[i].summary, .noise = true};
    }
}

const tl_scheme *tl_schemes(void)
{
    static pthread_once_t once = PTHREAD_ONCE_INIT;
    pthread_once(&once, list_schemes);
    return schemes;
}
