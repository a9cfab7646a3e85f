/* What `info` tells of a mesh file. */
#ifndef CMD_MESH_INFO_H
#define CMD_MESH_INFO_H

#include "cmd/command.h"

/* Whether a name ends like a mesh that talus writes. */
bool mesh_info_is_for(const char *path);
/* Tells it on stdout; an exit status. */
int mesh_info_print(const char *path, bool json, const common *shared);

#endif
