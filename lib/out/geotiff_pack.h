/* Tiles of a GeoTIFF as the bytes that the file holds. */
#ifndef OUT_GEOTIFF_PACK_H
#define OUT_GEOTIFF_PACK_H

#include "lib/talus.h"

typedef struct out_packing {
    const char *path; /* for messages */
    tl_compression compression;
    bool bytes;        /* of validity; else floats */
    size_t bands;      /* more than one: mostly void, interleaved and not predicted */
    double lerc_error; /* by which lerc may move a height; 0: not at all */
} out_packing;

/* TL_ERROR_ARGUMENT where this libtiff does not have the compression, or where it is none of TIFF's. */
tl_status out_packing_check(const out_packing *packing, tl_error *error);
/* TIFF's number of the compression. */
int out_packing_codec(const out_packing *packing);
/* Whether TIFF's predictor 3 goes before the compression. */
bool out_packing_predicts(const out_packing *packing);

typedef struct out_packer out_packer;

/* One a thread; NULL without memory. Borrows `packing`. */
out_packer *out_packer_create(const out_packing *packing);
void out_packer_destroy(out_packer *packer);
/* Packs a whole tile of samples, band after band. *out holds until the next call. */
tl_status out_packer_pack(out_packer *packer, const void *samples, const void **out, size_t *count, tl_error *error);

#endif
