#include "lib/scene/view_file.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <errno.h>
#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>

enum { LARGEST_FILE = 1 << 26, MOST_KEYS = 1 << 20 };

/* ---- members ---- */

typedef enum member_kind { TRIPLE, NUMBER, WHOLE, TRUTH } member_kind;

typedef struct member {
    const char *name;
    member_kind kind;
    size_t offset; /* in a tl_view_key */
} member;

#define VIEW_MEMBER(name, kind)                                            \
    {                                                                      \
#name, kind, offsetof(tl_view_key, view) + offsetof(tl_view, name) \
    }
static const member members[] = {
    VIEW_MEMBER(eye, TRIPLE),        VIEW_MEMBER(target, TRIPLE),
    VIEW_MEMBER(projected, TRUTH),   VIEW_MEMBER(above_ground, TRUTH),
    VIEW_MEMBER(heading, NUMBER),    VIEW_MEMBER(target_above_ground, TRUTH),
    VIEW_MEMBER(pitch, NUMBER),      VIEW_MEMBER(roll, NUMBER),
    VIEW_MEMBER(fov, NUMBER),        VIEW_MEMBER(width, WHOLE),
    VIEW_MEMBER(height, WHOLE),      VIEW_MEMBER(flat, TRUTH),
    VIEW_MEMBER(refraction, NUMBER), {"time", NUMBER, offsetof(tl_view_key, time)},
};
enum { MEMBERS = sizeof members / sizeof *members };
static const char views_name[] = "views";

static const member *member_named(const char *name)
{
    for (int k = 0; k < MEMBERS; k++)
        if (strcmp(members[k].name, name) == 0)
            return &members[k];
    return NULL;
}

static bool take_triple(const json_t *value, double out[3])
{
    if (json_array_size(value) != 3)
        return false;
    double numbers[3];
    for (size_t k = 0; k < 3; k++) {
        const json_t *item = json_array_get(value, k);
        if (!json_is_number(item))
            return false;
        numbers[k] = json_number_value(item);
    }
    memcpy(out, numbers, sizeof numbers);
    return true;
}

static bool take_value(const member *m, const json_t *value, tl_view_key *key)
{
    void *at = (char *)key + m->offset;
    switch (m->kind) {
    case TRIPLE:
        return take_triple(value, at);
    case NUMBER:
        *(double *)at = json_number_value(value);
        return json_is_number(value);
    case WHOLE:
        if (!json_is_integer(value) || json_integer_value(value) < 0 || json_integer_value(value) > 1 << 30)
            return false;
        *(int *)at = (int)json_integer_value(value);
        return true;
    case TRUTH:
        *(bool *)at = json_is_true(value);
        return json_is_boolean(value);
    }
    return false;
}

static tl_status take_members(const json_t *object, const char *path, tl_view_key *key, tl_error *error)
{
    static const char *const wanted[] = {
        [TRIPLE] = "an array of three numbers", [NUMBER] = "a number", [WHOLE] = "a whole number", [TRUTH] = "a truth"};
    const char *name;
    json_t *value;
    if (!json_is_object(object))
        return tl_fail(error, TL_ERROR_DATA, "%s: a view is an object with members as \"eye\"", path);
    json_object_foreach((json_t *)object, name, value)
    {
        const member *m = member_named(name);
        if (!m && strcmp(name, views_name) == 0)
            continue;
        if (!m)
            return tl_fail(error, TL_ERROR_DATA, "%s: a view has no member '%s'; see \"Camera files\" in talus(1)",
                           path, name);
        if (!take_value(m, value, key))
            return tl_fail(error, TL_ERROR_DATA, "%s: '%s' of a view is %s", path, name, wanted[m->kind]);
        key->view.target_given |= m->offset == members[1].offset;
    }
    return TL_OK;
}

/* ---- files ---- */

static tl_status views_of(const json_t *root, const char *path, tl_view_key **keys, size_t *count, tl_error *error)
{
    tl_view_key base = {.time = (double)NAN};
    const json_t *list = json_is_array(root) ? root : json_object_get(root, views_name);
    tl_status status = json_is_array(root) ? TL_OK : take_members(root, path, &base, error);
    if (status != TL_OK)
        return status;
    if (!list && !json_object_get(root, "eye"))
        return tl_fail(error, TL_ERROR_DATA, "%s: there is no \"eye\" in it, nor \"views\" that have one", path);
    size_t n = list ? json_array_size(list) : 1;
    if (n == 0 || n > MOST_KEYS)
        return tl_fail(error, TL_ERROR_DATA, "%s: \"views\" is an array of 1 to %d views", path, MOST_KEYS);
    tl_view_key *made = tl_alloc(n, sizeof *made);
    if (!made)
        return tl_fail_memory(error, path);
    for (size_t k = 0; k < n && status == TL_OK; k++) {
        made[k] = base;
        const json_t *view = list ? json_array_get(list, k) : NULL;
        if (view)
            status = take_members(view, path, &made[k], error);
        if (status == TL_OK && view && !json_object_get(view, "eye") && !json_object_get(root, "eye"))
            status = tl_fail(error, TL_ERROR_DATA, "%s: view %zu has no \"eye\"", path, k + 1);
    }
    if (status != TL_OK) {
        free(made);
        return status;
    }
    *keys = made;
    *count = n;
    return TL_OK;
}

/* The JSON chunk of a GLB is the first: behind 12 bytes of header come its length and kind. */
static bool glb_json(const unsigned char *bytes, size_t size, size_t *from, size_t *length)
{
    if (size < 20 || memcmp(bytes, "glTF", 4) != 0 || memcmp(bytes + 16, "JSON", 4) != 0)
        return false;
    *from = 20;
    *length = 0;
    for (size_t k = 0; k < 4; k++)
        *length |= (size_t)bytes[12 + k] << 8 * k;
    return *length <= size - 20;
}

/* The beginning of a file, which is all of a JSON and of a GLB's. */
static tl_status load(const char *path, char **bytes, size_t *size, tl_error *error)
{
    FILE *file = fopen(path, "rb");
    if (!file)
        return tl_fail_system(error, path, "open it", errno);
    tl_status status = TL_OK;
    size_t room = 1 << 16, got = 0;
    char *text = NULL;
    for (;;) {
        char *grown = realloc(text, room);
        if (!grown) {
            status = tl_fail_memory(error, path);
            break;
        }
        text = grown;
        got += fread(text + got, 1, room - got, file);
        if (got < room || room >= LARGEST_FILE)
            break;
        room *= 2;
    }
    if (status == TL_OK && ferror(file))
        status = tl_fail_system(error, path, "read it", errno);
    fclose(file);
    if (status != TL_OK) {
        free(text);
        return status;
    }
    *bytes = text;
    *size = got;
    return TL_OK;
}

static json_t *parse(const char *bytes, size_t size, const char *path, tl_error *error)
{
    size_t from = 0, length = size;
    if (size >= 4 && memcmp(bytes, "glTF", 4) == 0 && !glb_json((const unsigned char *)bytes, size, &from, &length)) {
        tl_fail(error, TL_ERROR_DATA, "%s: it begins as a GLB, but has no whole JSON; write it again", path);
        return NULL;
    }
    json_error_t why;
    json_t *root = json_loadb(bytes + from, length, JSON_REJECT_DUPLICATES, &why);
    if (!root)
        tl_fail(error, TL_ERROR_DATA, "%s: line %d: %s; a camera file is a JSON or a glTF", path, why.line, why.text);
    return root;
}

tl_status tl_view_path_read(const char *path, tl_view_key **keys, size_t *count, tl_error *error)
{
    char *bytes = NULL;
    size_t size = 0;
    tl_status status = load(path, &bytes, &size, error);
    if (status != TL_OK)
        return status;
    json_t *root = parse(bytes, size, path, error);
    free(bytes);
    if (!root)
        return TL_ERROR_DATA;
    status = json_object_get(root, "asset") ? scene_view_from_gltf(root, path, keys, count, error)
                                            : views_of(root, path, keys, count, error);
    json_decref(root);
    return status;
}

tl_status tl_view_read(const char *path, tl_view *out, tl_error *error)
{
    tl_view_key *keys = NULL;
    size_t count = 0;
    tl_status status = tl_view_path_read(path, &keys, &count, error);
    if (status == TL_OK && count != 1)
        status = tl_fail(error, TL_ERROR_DATA, "%s: it holds %zu views, and one is wanted", path, count);
    if (status == TL_OK)
        *out = keys[0].view;
    free(keys);
    return status;
}
