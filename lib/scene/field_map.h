/* A raster of numbers that go with the samples of an elevation model, on a lattice of its own. */
#ifndef SCENE_FIELD_MAP_H
#define SCENE_FIELD_MAP_H

#include "fbm/window.h"
#include "lib/talus.h"

typedef struct scene_field_map {
    const tl_source *source; /* NULL: none, `fallback` everywhere */
    double to[6]; /* sample (i, j) of the model lies at (to[0] + to[1] i + to[2] j, to[3] + ...) of the map */
    int64_t turn; /* columns of the model after which they come again; 0: they do not */
    int across,
        down; /* places about a sample of the model, along its row and its column, that its number is the mean of:
                 1, or more of a map that is finer than the model, so that none of its samples is passed over */
    double fallback; /* where the map is void */
    double least;    /* of its numbers and `fallback` */
    double low, high;
} scene_field_map;

/* What numbers are called in messages, what a map may hold, and the range that they are brought to. */
typedef struct scene_field_map_rule {
    const char *what; /* "Hurst exponents" */
    double low, high;
    double nearest_low, nearest_high;
} scene_field_map_rule;

/* Lays a map over a model: by place where both are located, which must be in one CRS (as far as that is known); else
 * it covers the model from edge to edge. The map is read once to see whether it keeps the rule. `map` NULL: none. */
tl_status scene_field_map_open(const tl_source *map, const tl_source_info *model, const scene_field_map_rule *rule,
                               double fallback, const tl_run *run, scene_field_map *out, tl_error *error);
/* Numbers at a window of the model's samples, which may reach beyond it, without gaps: bilinear between the map's
 * samples, beyond them as at its rim; of a finer map the mean over the sample's cell. */
tl_status scene_field_map_read(const scene_field_map *map, fbm_window window, float *out, tl_error *error);

#endif
