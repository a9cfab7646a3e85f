/* What the writers share: their table, and the record that goes with every output. */
#ifndef OUT_OUT_H
#define OUT_OUT_H

#include "lib/base/output.h"
#include "lib/talus.h"

enum { OUT_TILE = 256 }; /* samples on a side of the tiles in which grids are pulled and stored */
enum { OUT_BANDS = 5 };  /* at most, of out_geotiff_write_bands */

/* Writers of one format each. They write into an open output and leave committing and aborting to the caller. */
tl_status out_exr_write(const tl_source *source, tl_output *output, const tl_write_options *options, tl_error *error);
tl_status out_geotiff_write(const tl_source *source, tl_output *output, const tl_write_options *options,
                            tl_error *error);
/* The validity of a source's samples as a GeoTIFF of bytes. */
tl_status out_validity_write(const tl_source *source, tl_output *output, const tl_write_options *options,
                             tl_error *error);
/* Several sources over the same lattice, 2 ... OUT_BANDS of them and mostly void, as bands of a GeoTIFF: tiles that are
 * void are left out. Its record is that of the first. */
tl_status out_geotiff_write_bands(const tl_source *const *bands, size_t count, tl_output *output,
                                  const tl_write_options *options, tl_error *error);
/* The item talus_NAME of the record in a GeoTIFF, cut at `limit` bytes; false where there is none. */
bool out_geotiff_item(const char *path, const char *name, char *text, size_t limit);
tl_status out_gltf_write(const tl_mesh *mesh, tl_output *output, const tl_write_options *options, tl_error *error);
/* As files NAME_x0_y0.glb and so on, of at most options->split triangles, which join. */
tl_status out_gltf_write_parts(const tl_mesh *mesh, const char *path, const tl_write_options *options, tl_error *error);
tl_status out_obj_write(const tl_mesh *mesh, tl_output *output, const tl_write_options *options, tl_error *error);
tl_status out_ply_write(const tl_mesh *mesh, tl_output *output, const tl_write_options *options, tl_error *error);
tl_status out_stl_write(const tl_mesh *mesh, tl_output *output, const tl_write_options *options, tl_error *error);
/* Two files, `path` and its JSON sidecar, so these open their own outputs. */
tl_status out_png16_write(const tl_source *source, const char *path, const tl_write_options *options, tl_error *error);
tl_status out_r16_write(const tl_source *source, const char *path, const tl_write_options *options, tl_error *error);
tl_status out_raw_write(const tl_source *source, const char *path, const tl_write_options *options, tl_error *error);

/* Several values a sample. */
typedef struct out_planes {
    size_t count;             /* 1 ... OUT_BANDS */
    const char *const *names; /* of the channels */
    /* The window's values, channel by channel; any number of threads. */
    tl_status (*read)(void *context, tl_window window, float *out, tl_error *error);
    void *context;
} out_planes;

/* An EXR of these channels over the lattice of `source`, whose heights it does not read. No mipmaps. */
tl_status out_exr_write_planes(const tl_source *source, const out_planes *planes, tl_output *output,
                               const tl_write_options *options, tl_error *error);

/* Opens an EXR heightfield that out_exr_write wrote. */
tl_source *out_exr_open(const char *path, tl_error *error);

/* GDAL's geotransform of a source: from the outer corner of the first cell for area rasters; for point rasters of the
 * cell whose centre the first sample is, as GDAL has it. */
void out_gdal_transform(const tl_source_info *info, double out[6]);

/* The tiles of a grid, row by row. */
typedef struct out_tiling {
    int64_t columns, rows;
    int64_t width, height; /* of the grid */
} out_tiling;

out_tiling out_tiling_of(const tl_source *source);
/* The window of a tile, cut at the grid's rim. */
tl_window out_tile_window(const out_tiling *tiling, uint64_t tile);

/* Lowest and highest height of what was written, gathered by worker. */
typedef struct out_extent {
    float low, high; /* low > high: no valid sample */
} out_extent;

out_extent out_extent_empty(void);
void out_extent_add(out_extent *extent, const float *heights, size_t count);
void out_extent_merge(out_extent *extent, const out_extent *other);

#endif
