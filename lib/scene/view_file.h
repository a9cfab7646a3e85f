/* Camera files, beneath tl_view_path_read. */
#ifndef SCENE_VIEW_FILE_H
#define SCENE_VIEW_FILE_H

#include "lib/talus.h"

#include <jansson.h>

/* The cameras of a glTF's JSON. `path` names it in messages. */
tl_status scene_view_from_gltf(const json_t *root, const char *path, tl_view_key **keys, size_t *count,
                               tl_error *error);

#endif
