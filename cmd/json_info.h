/* What `info` tells of folders of tiles, and of the JSON files that stand for several files. */
#ifndef CMD_JSON_INFO_H
#define CMD_JSON_INFO_H

#include <stdbool.h>

/* Whether `path` is such a JSON file, the folder that it lies in, or a tile that a preset made. */
bool json_info_is_for(const char *path);
/* Tells it on stdout; an exit status. */
int json_info_print(const char *path, bool json);

#endif
