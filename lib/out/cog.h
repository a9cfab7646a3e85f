/* Cloud-optimised GeoTIFFs: directories first, then the coarsest level's tiles, the finest's last. */
#ifndef OUT_COG_H
#define OUT_COG_H

#include "lib/base/output.h"

/* Writes the images of a little-endian BigTIFF, of tiles without holes, to `to` in that order, as a classic TIFF where
 * 32 bits can count its bytes. Tiles are copied as they are, one at a time. */
tl_status out_cog_write(const tl_output *from, tl_output *to, const tl_run *run, tl_error *error);

#endif
