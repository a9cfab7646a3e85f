/* Heights as plain numbers, row by row: 16-bit PNG, R16 and raw floats. Beside whole ones stands a JSON file that says
 * what the numbers mean. */
#ifndef OUT_HEIGHTMAP_H
#define OUT_HEIGHTMAP_H

#include "lib/out/out.h"
#include "lib/out/png_encoder.h"

#include <jansson.h>

typedef enum out_heightmap_kind {
    OUT_HEIGHTMAP_PNG16 = 0,
    OUT_HEIGHTMAP_R16,  /* unsigned 16-bit values, the low byte first */
    OUT_HEIGHTMAP_RAW32 /* floats, the low byte first */
} out_heightmap_kind;

/* height = offset + scale * value; value 0 is void where there are voids. */
typedef struct out_coding {
    double offset, scale;
    int first; /* value of the lowest height */
} out_coding;

/* Over the whole range. */
out_coding out_coding_of(const tl_range *range);

typedef struct out_heightmap {
    out_heightmap_kind kind;
    tl_window window; /* of the source's finest level */
    out_coding code;  /* of 16-bit values; heights outside of its range are cut off */
    bool bottom_up;   /* the last row first; not for PNG, whose first row is the top */
} out_heightmap;

tl_status out_heightmap_write(const tl_source *source, const out_heightmap *how, tl_output *output, const tl_run *run,
                              tl_error *error);

/* Name of the JSON file: "x.png" to "x.json"; the others keep their ending, "x.r16.json", so that they do not share
 * one. To be freed; NULL when out of memory. */
char *out_sidecar_path(const char *path, out_heightmap_kind kind);

/* Adds where a grid lies and how it was made: geotransform, crs, crs_wkt and parameters. */
void out_json_add_record(json_t *object, const tl_source_info *info);

#endif
