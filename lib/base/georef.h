/* The shared data of coordinate reference systems, and how meshes are owned. What a CRS *means* (projecting, frames)
 * is in dem/crs.h. */
#ifndef TL_BASE_GEOREF_H
#define TL_BASE_GEOREF_H

#include "lib/talus.h"

#include <stdatomic.h>

struct tl_crs {
    atomic_uint references;
    char *name, *wkt;     /* never NULL */
    char *horizontal_wkt; /* without the vertical part; NULL: `wkt` has none */
    char *vertical_name;  /* NULL: none */
    int epsg;             /* of the horizontal part; 0: none */
    int vertical_epsg;
    double vertical_unit; /* metres in one unit of height by the vertical part; 0: it has none */
    bool geographic;
    double unit;                   /* metres in one unit of projected coordinates; 1 for geographic ones */
    double semi_major, flattening; /* of the ellipsoid, metres and 1 */
    /* The GeoTIFF keys that it came from, so that a GeoTIFF can be given the same; NULL and 0 where there were none. */
    uint16_t *key_directory;
    double *key_doubles;
    char *key_ascii;
    size_t key_directory_count, key_double_count; /* items */
};

/* A CRS with one reference and everything else 0; NULL when out of memory. */
tl_crs *tl_crs_allocate(void);
/* One more reference; takes and returns NULL too. */
const tl_crs *tl_crs_retain(const tl_crs *crs);
/* Drops a reference; the last one frees the CRS and all its members. Takes NULL. */
void tl_crs_release(const tl_crs *crs);

/* The georeference of a raster that has none: x = i, y = -j, in metres. */
tl_georef tl_georef_none(void);

/* A mesh with uninitialised arrays of the given sizes over `grid`: georeference (with a reference to its CRS), raster
 * type and a copy of the parameters come from there. NULL, described, when out of memory. */
tl_mesh *tl_mesh_create(size_t vertices, size_t triangles, const tl_source_info *grid, tl_error *error);
/* Adds a parameter to a mesh's record (copies both strings). */
tl_status tl_mesh_add_parameter(tl_mesh *mesh, const char *name, const char *value, tl_error *error);

/* Adds a parameter (copies of both strings) to a list that free() frees, as tl_parameters_copy makes them. */
tl_status tl_parameters_add(tl_parameter **list, size_t *count, const char *name, const char *value, tl_error *error);
/* Adds what every record begins with: this version, the input's name without its folders, and how the input was made
 * itself, where it has a record ("made_by": "name: value; ..."). */
tl_status tl_parameters_add_origin(tl_parameter **list, size_t *count, const tl_source_info *input, tl_error *error);

/* Deep copy of `count` parameters, one block that free() frees; NULL for none, or when out of memory. */
tl_parameter *tl_parameters_copy(const tl_parameter *parameters, size_t count);

#endif
