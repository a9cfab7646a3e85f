#include "lib/scene/layer_rules.h"

#include "lib/base/error.h"

#include <jansson.h>

#include <math.h>
#include <string.h>

static const char *const class_names[LAYER_CLASSES] = {"rock", "scree", "soil", "snow"};
static const char *const fact_names[LAYER_FACTS] = {"slope", "height", "curvature", "sigma"};

/* Of temperate mountains: rock where it is too steep for anything to lie, scree at its angle of repose below that, snow
 * high up where it is not too steep, soil elsewhere. */
static const layer_rules built_in = {{
    {1, {[LAYER_SLOPE] = {true, 36, 46, HUGE_VAL, HUGE_VAL}}},
    {1, {[LAYER_SLOPE] = {true, 26, 32, 37, 45}}},
    {1, {[LAYER_SLOPE] = {true, -HUGE_VAL, -HUGE_VAL, 24, 34}}},
    {3,
     {[LAYER_SLOPE] = {true, -HUGE_VAL, -HUGE_VAL, 40, 52}, [LAYER_HEIGHT] = {true, 2700, 3100, HUGE_VAL, HUGE_VAL}}},
}};

static double on_ramp(const layer_ramp *r, double x)
{
    if (!r->given)
        return 1;
    if (isnan(x))
        return 0;
    double up = x >= r->b ? 1 : x <= r->a ? 0 : (x - r->a) / (r->b - r->a);
    double down = x <= r->c ? 1 : x >= r->d ? 0 : (r->d - x) / (r->d - r->c);
    return up < down ? up : down;
}

void layer_rules_weigh(const layer_rules *rules, const double facts[LAYER_FACTS], float out[LAYER_CLASSES])
{
    enum { REST = 2 };
    double weights[LAYER_CLASSES], sum = 0;
    for (int c = 0; c < LAYER_CLASSES; c++) {
        weights[c] = rules->classes[c].weight;
        for (int f = 0; f < LAYER_FACTS; f++)
            weights[c] *= on_ramp(&rules->classes[c].ramps[f], facts[f]);
        sum += weights[c];
    }
    for (int c = 0; c < LAYER_CLASSES; c++)
        out[c] = sum > 0 ? (float)(weights[c] / sum) : c == REST;
}

bool layer_rules_use(const layer_rules *rules, int fact)
{
    for (int c = 0; c < LAYER_CLASSES; c++)
        if (rules->classes[c].ramps[fact].given)
            return true;
    return false;
}

/* ---- Files ---- */

/* Two numbers, from where it rises to where it is 1, or four; null is no bound. */
static bool read_ramp(json_t *list, layer_ramp *out)
{
    size_t count = json_array_size(list);
    double n[4] = {0, 0, HUGE_VAL, HUGE_VAL};
    if (count != 2 && count != 4)
        return false;
    for (size_t k = 0; k < count; k++) {
        json_t *item = json_array_get(list, k);
        if (!json_is_number(item) && !json_is_null(item))
            return false;
        n[k] = json_is_number(item) ? json_number_value(item) : k < 2 ? -HUGE_VAL : HUGE_VAL;
    }
    *out = (layer_ramp){true, n[0], n[1], n[2], n[3]};
    return n[0] <= n[1] && n[1] <= n[2] && n[2] <= n[3];
}

static tl_status read_class(const char *path, const char *name, json_t *from, struct layer_class *out, tl_error *error)
{
    const char *key;
    json_t *value;
    *out = (struct layer_class){.weight = 1};
    json_object_foreach(from, key, value)
    {
        int fact = 0;
        while (fact < LAYER_FACTS && strcmp(fact_names[fact], key) != 0)
            fact++;
        if (strcmp(key, "weight") == 0 && json_is_number(value) && json_number_value(value) >= 0)
            out->weight = json_number_value(value);
        else if (fact == LAYER_FACTS || !read_ramp(value, &out->ramps[fact]))
            return tl_fail(
                error, TL_ERROR_DATA,
                "%s: %s.%.40s is no rule; give slope, height, curvature or sigma as [0 at, 1 from] or [0 at, "
                "1 from, 1 to, 0 at], rising, or a weight",
                path, name, key);
    }
    return TL_OK;
}

static tl_status read_classes(const char *path, json_t *root, layer_rules *out, tl_error *error)
{
    const char *key;
    json_t *value;
    *out = (layer_rules){0}; /* classes that are not named have no weight */
    if (!json_is_object(root))
        return tl_fail(error, TL_ERROR_DATA, "%s: an object of rules for rock, scree, soil and snow is wanted", path);
    json_object_foreach(root, key, value)
    {
        int c = 0;
        while (c < LAYER_CLASSES && strcmp(class_names[c], key) != 0)
            c++;
        if (c == LAYER_CLASSES || !json_is_object(value))
            return tl_fail(error, TL_ERROR_DATA, "%s: no rule is for '%.40s'; there are rock, scree, soil and snow",
                           path, key);
        tl_status status = read_class(path, key, value, &out->classes[c], error);
        if (status != TL_OK)
            return status;
    }
    return TL_OK;
}

tl_status layer_rules_read(const char *path, layer_rules *out, tl_error *error)
{
    *out = built_in;
    if (!path)
        return TL_OK;
    json_error_t where;
    json_t *root = json_load_file(path, JSON_REJECT_DUPLICATES, &where);
    if (!root)
        return tl_fail(error, TL_ERROR_DATA, "%s: line %d: %s", path, where.line, where.text);
    tl_status status = read_classes(path, root, out, error);
    json_decref(root);
    return status;
}
