#include "lib/talus.h"

const char *tl_version(void)
{
    return TL_VERSION;
}

const char *tl_lacks(void)
{
    return TL_LACKS;
}
