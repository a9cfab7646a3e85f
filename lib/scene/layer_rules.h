/* Rules that share the ground out among four kinds, from a JSON file. */
#ifndef SCENE_LAYER_RULES_H
#define SCENE_LAYER_RULES_H

#include "lib/talus.h"

/* What rules may ask for. */
enum { LAYER_SLOPE, LAYER_HEIGHT, LAYER_CURVATURE, LAYER_SIGMA, LAYER_FACTS };
enum { LAYER_CLASSES = 4 };

/* A trapezium over one fact: 0 up to a, rising to 1 at b, 1 up to c, falling to 0 at d. */
typedef struct layer_ramp {
    bool given;
    double a, b, c, d;
} layer_ramp;

typedef struct layer_rules {
    struct layer_class {
        double weight;
        layer_ramp ramps[LAYER_FACTS];
    } classes[LAYER_CLASSES];
} layer_rules;

/* Reads a file, or takes the built-in rules for NULL. */
tl_status layer_rules_read(const char *path, layer_rules *out, tl_error *error);
bool layer_rules_use(const layer_rules *rules, int fact);
/* Shares that add up to 1: each class's weight times its ramps; all of the third where none has any. */
void layer_rules_weigh(const layer_rules *rules, const double facts[LAYER_FACTS], float out[LAYER_CLASSES]);

#endif
