#include "lib/talus.h"

const char *tl_version(void)
{
    return TL_VERSION;
}
