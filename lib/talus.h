/* talus: terrain with detail below the resolution of its elevation model.
 *
 * This header is the whole public interface, and its manual. Conventions that hold throughout:
 *
 * - A *source* is anything that has heights on a grid. Sample (i, j) is column i, row j, both from 0,
 *   row 0 the first of the file (north, for most rasters). A height that is not known (a void) is NaN.
 * - *Levels* name lattices: level 0 is the elevation model's own samples, level l > 0 has half the
 *   spacing of level l - 1. A source holds the levels up to its own `info.level`.
 * - Functions that can fail return a tl_status (TL_OK is 0) or NULL, and describe the failure in the
 *   caller's tl_error, one line that names the file, the thing and the remedy. The tl_error pointer may
 *   be NULL. A failed call leaves its outputs untouched and nothing half-written on disk.
 * - Option structs: zero is the default of every member, so name only what you change.
 * - Everything returned by a create or open function is the caller's, until the matching destroy; a
 *   destroyer takes NULL. A source borrows the source that it was made from: destroy it first.
 * - A const tl_source may be read by any number of threads at once. Equal inputs give equal bytes,
 *   whatever the number of threads, the order of reading or the instruction set.
 * - Breaking a stated precondition (a NULL that is not allowed, a window outside of the grid) is a
 *   programming error and may end in a failed assertion.
 */
#ifndef TALUS_H
#define TALUS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#if defined(TL_BUILDING) && defined(__GNUC__)
#define TL_API __attribute__((visibility("default")))
#else
#define TL_API
#endif

/* The version of the library, as "0.1.0". */
TL_API const char *tl_version(void);
/* What this build was made without, by the names of the build's options, as "meshopt, png"; "" where it has all.
 * Functions that need such a part fail with TL_ERROR_ARGUMENT, and say so. */
TL_API const char *tl_lacks(void);

/* ---- Errors ------------------------------------------------------------------------------------ */

typedef enum tl_status {
    TL_OK = 0,
    TL_ERROR_ARGUMENT,  /* an option or parameter that cannot be honoured */
    TL_ERROR_DATA,      /* the input is malformed, or of a kind that talus does not take */
    TL_ERROR_IO,        /* the system refused to read or write */
    TL_ERROR_MEMORY,    /* not enough memory */
    TL_ERROR_CANCELLED, /* tl_run.cancel was raised */
} tl_status;

/* A failure, described. The caller owns it; `text` is one line without a newline at its end. */
typedef struct tl_error {
    tl_status status;
    char text[480];
} tl_error;

/* A short English name of a status, as "I/O error"; never NULL. */
TL_API const char *tl_status_name(tl_status status);

/* ---- Running: threads, progress, cancellation -------------------------------------------------- */

/* How long-running calls run. NULL where a tl_run is asked for means all defaults. */
typedef struct tl_run {
    unsigned threads; /* worker threads; 0: one a processor that this process may use */
    /* Polled, by any thread, atomically; when it becomes non-zero the call ends with TL_ERROR_CANCELLED. NULL: never.
     */
    const volatile int *cancel;
    /* Called on the calling thread only, at most about ten times a second and once at the end, with the
     * work done and the whole work in samples. NULL: not wanted. */
    void (*progress)(void *user, uint64_t done, uint64_t total);
    void *user; /* handed to progress */
    /* Bytes that the call may take for itself, beside what its sources keep; 0: as many as it needs. One that needs
     * more fails with TL_ERROR_MEMORY and tells how many: filled voids, whole meshes, frameworks and pictures are kept
     * in memory; grids are written in tiles, which take some 4 MB a thread whatever this says. */
    size_t memory;
} tl_run;

/* ---- Georeference ------------------------------------------------------------------------------ */

/* What a sample stands for. An area sample is the mean over its cell, a point sample the height at its
 * position (GeoTIFF's RasterPixelIsArea and RasterPixelIsPoint). */
typedef enum tl_raster_type { TL_RASTER_AREA = 0, TL_RASTER_POINT } tl_raster_type;

/* A coordinate reference system, shared and immutable; reference-counted by its owners. */
typedef struct tl_crs tl_crs;

/* The CRS of "EPSG:CODE", a WKT text of any version or a PROJ string; NULL, TL_ERROR_DATA, where PROJ knows none. */
TL_API tl_crs *tl_crs_create(const char *definition, tl_error *error);
/* For those of tl_crs_create; the CRS of a source goes with the source. Takes NULL. */
TL_API void tl_crs_destroy(tl_crs *crs);
/* Name of the CRS, as "NAD83 / UTM zone 11N"; never NULL. */
TL_API const char *tl_crs_name(const tl_crs *crs);
/* WKT2:2019 of the CRS on one line, a COMPOUNDCRS where it has a vertical part, a BOUNDCRS where a GeoTIFF without a
 * code gives a shift to WGS 84 (which is handed on, and never made); "" where it cannot be had. */
TL_API const char *tl_crs_wkt(const tl_crs *crs);
/* EPSG code of the CRS (of its horizontal part), 0 where it has none. */
TL_API int tl_crs_epsg(const tl_crs *crs);
/* Name of the vertical CRS that heights count in, as "NAVD88 height (ft)", or "ellipsoidal height"; "" where the data
 * do not say. */
TL_API const char *tl_crs_vertical_name(const tl_crs *crs);
/* EPSG code of the vertical CRS, 0 where it has none. */
TL_API int tl_crs_vertical_epsg(const tl_crs *crs);
/* Whether its coordinates are longitude and latitude (in degrees, in this order, always). */
TL_API bool tl_crs_is_geographic(const tl_crs *crs);

/* Where a grid lies. Positions are those of samples: for area rasters the cells' centres, for point rasters
 * the points themselves, so that half-cell conventions end at the readers and writers. */
typedef struct tl_georef {
    const tl_crs *crs; /* NULL: not known */
    bool located;      /* whether `transform` comes from the data; else it is {0,1,0, 0,0,-1}: x = i, y = -j */
    /* CRS coordinates of sample (i, j): x = t[0] + t[1] i + t[2] j, y = t[3] + t[4] i + t[5] j. */
    double transform[6];
    /* Metres between neighbouring samples along a row and along a column, at the middle of the raster
     * (geodesic where the CRS is geographic). One unit of an unknown CRS counts as a metre. */
    double cell_x, cell_y;
    double height_unit; /* metres in one unit of height, 1 where the file does not say otherwise */
} tl_georef;

/* ---- Sources ----------------------------------------------------------------------------------- */

/* A rectangle of samples: columns x ... x + width - 1, rows y ... y + height - 1. */
typedef struct tl_window {
    int64_t x, y;
    int64_t width, height;
} tl_window;

/* A parameter that made a source, for the record that travels with every output. Both strings are UTF-8. */
typedef struct tl_parameter {
    const char *name, *value;
} tl_parameter;

typedef struct tl_source_info {
    int64_t width, height; /* samples, at level `level`; both at least 1 */
    int level;             /* the finest level that it holds: 0 for elevation models */
    tl_raster_type type;
    tl_georef georef; /* of the samples of level `level` */
    bool has_voids;   /* false: certainly no NaN; true: NaN may occur */
    bool wraps;       /* its columns go once around the globe: behind the last one comes column 0 again */
    double quantum; /* step between representable heights (1 for an integer DEM without scale), 0 for continuous ones */
    /* What is decoded at once, from the grid's corner on: whole blocks are read with least work. 0: no matter. */
    int64_t block_width, block_height;
    const char *name;     /* what to call it in messages: the file, mostly; never NULL */
    const char *contents; /* what the numbers are where they are no heights: "slope", "depth"; NULL: heights */
    const tl_parameter *parameters; /* how it was made; NULL when parameter_count is 0 */
    size_t parameter_count;
} tl_source_info;

/* What is known of a sample. */
typedef enum tl_validity {
    TL_VOID = 0,       /* nothing: the height is NaN */
    TL_FILLED = 1,     /* made up, as by tl_voids_create */
    TL_MEASURED = 255, /* in the data, or refined from such samples */
} tl_validity;

/* A grid of heights. Make your own by filling in this struct: it is the whole contract. */
typedef struct tl_source tl_source;
struct tl_source {
    tl_source_info info;
    /* Writes the window's heights, row by row without gaps, to out[window.width * window.height].
     * `level` must be one that the source holds: `info.level` always is; coarser ones are those for which
     * tl_source_size succeeds. Thread-safe. */
    tl_status (*read)(const tl_source *self, int level, tl_window window, float *out, tl_error *error);
    /* Size at a coarser level than info.level; NULL: only info.level is held. */
    tl_status (*size)(const tl_source *self, int level, int64_t *width, int64_t *height, tl_error *error);
    /* Writes a tl_validity for each sample of the window, likewise. NULL: void where the height is NaN, else measured.
     */
    tl_status (*validity)(const tl_source *self, int level, tl_window window, unsigned char *out, tl_error *error);
    void (*destroy)(tl_source *self); /* NULL: nothing to free */
};

/* Size in samples at a level that the source holds; TL_ERROR_ARGUMENT for others. */
TL_API tl_status tl_source_size(const tl_source *source, int level, int64_t *width, int64_t *height, tl_error *error);
/* Reads a window, which must lie inside of the grid of that level. */
TL_API tl_status tl_source_read(const tl_source *source, int level, tl_window window, float *out, tl_error *error);
/* The validity of the samples of a window. */
TL_API tl_status tl_source_validity(const tl_source *source, int level, tl_window window, unsigned char *out,
                                    tl_error *error);
TL_API void tl_source_destroy(tl_source *source);

/* Sample positions (which may be fractions, and outside of the grid) to longitude, east of the CRS's own prime
 * meridian, and latitude, in degrees on the CRS's own datum; in place, `count` points. Where there are none: NaN.
 * TL_ERROR_DATA where CRS or place are not known. */
TL_API tl_status tl_georef_to_lonlat(const tl_georef *georef, size_t count, double *i, double *j, tl_error *error);
/* Fills in cell_x and cell_y, in metres, of a georef whose crs, located and transform are set, for a raster of this
 * many samples; and height_unit where it is 1 and the CRS has a vertical part. A raster that is not located has cells
 * of 1.
 */
TL_API tl_status tl_georef_measure(tl_georef *georef, int64_t width, int64_t height, tl_error *error);
/* The box of longitudes and latitudes (as above) around a raster: west, south, east, north, of the cells of an area
 * raster and of the samples of a point raster. West is in -180 ... 180, and east beyond 180 where the antimeridian is
 * crossed; a raster with a pole in it goes from -180 to 180. Measured at 65 points an edge. */
TL_API tl_status tl_source_bounds(const tl_source_info *info, double bounds[4], tl_error *error);

/* A source over the caller's array of info->width * info->height heights, which must outlive it (as must
 * all that `info` points to). info->level must be 0. */
TL_API tl_source *tl_array_source_create(const float *heights, const tl_source_info *info, tl_error *error);

/* Opens a raster that talus can read: an EXR heightfield that talus wrote, by its content; a .png, .r16 or .raw that it
 * wrote, with the JSON file beside it; or whatever tl_dem_open takes. A record of how talus made it is in its
 * parameters. */
TL_API tl_source *tl_open(const char *path, tl_error *error);

/* Heights rounded to multiples of `quantum` (units of height, above 0): a field in steps of 1/64 m takes half the room
 * in a compressed file. No height moves by more than half of it. */
TL_API tl_source *tl_quantized_create(const tl_source *source, double quantum, tl_error *error);

/* The same source with `count` more parameters in its record (both strings are copied). */
TL_API tl_source *tl_recorded_create(const tl_source *source, const tl_parameter *more, size_t count, tl_error *error);

/* ---- Elevation models -------------------------------------------------------------------------- */

typedef struct tl_dem_options {
    unsigned band; /* counted from 1; 0: the first */
    /* Where files overlap, blend them over at most 32 samples from the rim of the one that comes first. false: the
     * first that has a height gives it. */
    bool feather;
    /* Make every coarser level from full resolution. false: take the reduced copies that a file of area samples holds
     * where they are smaller by exactly a power of two, of a mosaic where all its files hold them; how they were made
     * is not known, so they may not be means. */
    bool exact_levels;
    unsigned open_files; /* of a mosaic, at a time, beside those that are being read; 0: 64 */
    size_t memory;       /* bytes of decoded blocks kept for the next windows, beside those in use; 0: 64 MB */
    const tl_run *run;   /* for opening several files */
} tl_dem_options;

/* Opens elevation models. Each of the `count` paths (at least one) is a GeoTIFF; an SRTM file named by its
 * south-western corner, as N48W125.hgt; a directory, for the .tif, .tiff and .hgt files in it; a pattern with *, ? or [
 * for files' names; or @LIST, a text file with one name a line, relative to its own folder, where # begins a comment.
 * Nothing but the files' headers is read yet.
 *
 * Several files become one source. They must be in the same CRS, and not rotated in it. Its lattice, raster type and
 * CRS are those of the file with the smallest cells (of equal ones, the first), its extent holds all files, and what no
 * file covers is void. Where files overlap, the one with the smallest cells gives the height, then one on the mosaic's
 * lattice, then the first; where that is void, the next. Samples of files on the mosaic's lattice (to a thousandth of a
 * cell) are copied; others are interpolated, bilinearly, where all samples that count are known. Longitudes are shifted
 * by whole turns so that the extent is as narrow as can be: tiles on both sides of the antimeridian lie beside each
 * other. `quantum` is the smallest of the files' where all are multiples of it, else, and where heights are
 * interpolated or feathered, 0. */
TL_API tl_source *tl_dem_open(const char *const *paths, size_t count, const tl_dem_options *options, tl_error *error);

/* As tl_open, with options for elevation models; they mean nothing for an EXR. */
TL_API tl_source *tl_open_with(const char *path, const tl_dem_options *options, tl_error *error);

/* Sources that tl_dem_open made hold coarser levels, down to a single sample. Level -k of a point raster has the
 * samples whose column and row are multiples of 2^k, that of an area raster the means of the valid samples of 2^k x 2^k
 * cells, fewer at the right and lower rim: ceil(size / 2^k) in either case. */

/* One of the files of an elevation model. */
typedef struct tl_dem_member {
    const tl_source *source; /* the file alone; it belongs to the model. tl_dem_get_details takes it */
    tl_window window;        /* the model's samples between its outermost ones */
    bool resampled;          /* it lies on another lattice than the model, so its heights are interpolated */
} tl_dem_member;

/* How many files a source that tl_dem_open made reads; 0 for other sources. */
TL_API size_t tl_dem_member_count(const tl_source *dem);
/* Files in the order in which they were given. */
TL_API tl_status tl_dem_get_member(const tl_source *dem, size_t index, tl_dem_member *out, tl_error *error);

/* A part of a source as a source, as if there were no more: its own first sample is the window's. The window lies in
 * the finest level; on a raster that wraps it may go on behind the last column with the first one. Coarser levels are
 * held where the part's cells of that level are the source's own. TL_ERROR_ARGUMENT where the window does not lie in
 * it. */
TL_API tl_source *tl_cut_create(const tl_source *source, tl_window window, tl_error *error);
/* The window of the samples (of area rasters: cells' centres) in a box of CRS coordinates, west, south, east, north, or
 * the lowest and highest x and y; cut at the raster's rim. In longitude and latitude a box with its east below its west
 * crosses the antimeridian, and whole turns do not count. TL_ERROR_ARGUMENT where there are none. */
TL_API tl_status tl_cut_of_box(const tl_source_info *info, const double box[4], tl_window *out, tl_error *error);

/* What a file says of itself; strings live as long as the source. */
typedef struct tl_dem_details {
    const char *sample_type; /* "int16", "float32", ... */
    const char *codec;       /* "deflate", "lzw", "none", ... */
    int predictor;           /* 1, 2 or 3, as in the TIFF tag */
    bool tiled, big_tiff, big_endian;
    int64_t block_width, block_height;
    unsigned bands, band; /* band counted from 1 */
    bool has_nodata;
    double nodata;        /* as in the GDAL_NODATA tag */
    double scale, offset; /* height = offset + scale * stored */
    unsigned overviews;   /* reduced-resolution copies in the file */
    int64_t bytes;        /* size of the file */
} tl_dem_details;

/* Details of a source that tl_dem_open made of one file; TL_ERROR_ARGUMENT for any other. */
TL_API tl_status tl_dem_get_details(const tl_source *dem, tl_dem_details *out, tl_error *error);

typedef struct tl_dem_size {
    int64_t width, height;
} tl_dem_size;

/* Sizes of the reduced copies in the file, in its order: at most `capacity` go to `out`, and their number to *count.
 * For the same sources as tl_dem_get_details. */
TL_API tl_status tl_dem_get_overviews(const tl_source *dem, tl_dem_size *out, unsigned capacity, unsigned *count,
                                      tl_error *error);

/* What has to be read for a window of level 0. */
typedef struct tl_dem_cost {
    uint64_t blocks;        /* tiles or strips (rows of a .hgt file) that it touches */
    uint64_t stored_bytes;  /* that they take in the file; 0 for the holes of a sparse one */
    uint64_t decoded_bytes; /* all samples of these blocks, as the file's type */
} tl_dem_cost;

/* The cost of a window, which must lie in the grid. For the same sources as tl_dem_get_details. */
TL_API tl_status tl_dem_get_cost(const tl_source *dem, tl_window window, tl_dem_cost *out, tl_error *error);

/* Range and void share of a source's finest level, read once from end to end. */
typedef struct tl_range {
    float low, high; /* NaN where no sample is valid */
    uint64_t samples, voids;
    double mean; /* of the valid samples */
} tl_range;

TL_API tl_status tl_source_range(const tl_source *source, const tl_run *run, tl_range *out, tl_error *error);

enum { TL_MAX_SUSPECTS = 4 };

/* A height that probably stands for void. */
typedef struct tl_suspect {
    float value;
    uint64_t count; /* samples that have it */
} tl_suspect;

/* Values at either end of a source's heights that are far from all others: those of more than 16 samples (or a
 * ten-thousandth of all) that are farther from the next than half of the range of the rest, if the rest has at least 8
 * different heights; and -9999, -32768 and the like, by a tenth of that range. Reads the source once. `*count` is at
 * most TL_MAX_SUSPECTS. */
TL_API tl_status tl_source_suspects(const tl_source *source, const tl_run *run, tl_suspect out[TL_MAX_SUSPECTS],
                                    size_t *count, tl_error *error);

/* ---- Voids -------------------------------------------------------------------------------------- */

typedef enum tl_void_rule {
    TL_VOIDS_KEEP = 0, /* voids stay voids */
    TL_VOIDS_FILL,     /* a membrane from the rim of each hole: Laplace's equation, to 2e-5 of the heights' range */
    TL_VOIDS_VALUE,    /* one height for all */
} tl_void_rule;

typedef struct tl_void_options {
    bool nodata_given; /* heights equal to `nodata` count as voids too: for files that do not declare it */
    float nodata;
    tl_void_rule rule;
    float value;       /* for TL_VOIDS_VALUE; finite */
    const tl_run *run; /* filling reads the source once, and the surroundings of its voids twice */
} tl_void_options;

/* A source whose voids are treated by a rule; its tl_source_validity tells which samples were filled. Filling keeps
 * the filled samples in memory, in blocks of 64 x 64. While it works it needs some 20 bytes a sample of the box around
 * a group of blocks that hold voids and touch: for scattered voids that is the whole raster. Voids of a raster without
 * any valid sample stay voids. Only the source's finest level is held. */
TL_API tl_source *tl_voids_create(const tl_source *source, const tl_void_options *options, tl_error *error);

/* ---- Heights above the ellipsoid ---------------------------------------------------------------- */

typedef struct tl_geoid_options {
    /* "egm96", from PROJ's own grids, or a file that PROJ reads as a grid of undulations: .gtx or GeoTIFF. */
    const char *grid;
    size_t memory; /* bytes of undulations kept for the next windows; 0: 16 MB */
} tl_geoid_options;

/* Heights above the ellipsoid of an elevation model whose heights count from a geoid (as "above sea level" does): each
 * height plus the geoid's undulation at the sample, to 0.5 mm of what PROJ gives there, in the model's unit of height.
 * The CRS becomes the one with ellipsoidal heights on the same horizontal CRS, and the raster has no quantum. It fails
 * where place or CRS are not known or heights are ellipsoidal already, with "egm96" also where the CRS is not on the
 * ellipsoid of WGS 84 or GRS 80; a file's undulations are taken for those above the CRS's own ellipsoid, on its own
 * datum. Reading fails at heights that the grid does not cover. Coarser levels are those that `source` holds. */
TL_API tl_source *tl_geoid_create(const tl_source *source, const tl_geoid_options *options, tl_error *error);

/* ---- Meshes ------------------------------------------------------------------------------------ */

/* A vertex at the sample (i, j) of a grid, height z in the grid's unit. */
typedef struct tl_vertex {
    int32_t i, j;
    float z;
} tl_vertex;

/* Triangles over the samples of one grid. Counter-clockwise as seen from above when j points south
 * (so that the faces look up in every right-handed frame with z upwards). */
typedef struct tl_mesh {
    size_t vertex_count, triangle_count;
    tl_vertex *vertices;
    uint32_t *indices; /* 3 * triangle_count */
    tl_georef georef;  /* of the grid; the mesh holds a reference to its CRS */
    tl_raster_type type;
    double max_error;         /* the bound it was made under, in units of height; 0: every sample is a vertex */
    tl_parameter *parameters; /* how it was made, owned by the mesh */
    size_t parameter_count;
} tl_mesh;

TL_API void tl_mesh_destroy(tl_mesh *mesh);

/* Coordinates of mesh vertices. */
typedef enum tl_frame {
    TL_FRAME_DEFAULT = 0, /* ENU where the CRS is known, else projected */
    TL_FRAME_ENU,         /* metres east, north and up of the tangent plane at the grid's middle (glTF: its Y up) */
    TL_FRAME_PROJECTED,   /* CRS coordinates and heights as they are */
    TL_FRAME_PIXEL,       /* column, row (downwards), height: sample positions, not cell corners */
    /* Metres from the centre of the ellipsoid (X towards Greenwich, Z north), on the CRS's own datum, heights taken for
     * ellipsoidal ones. A GLB has ENU positions and a node whose matrix takes them there. */
    TL_FRAME_ECEF,
} tl_frame;

/* The full grid as a mesh: two triangles a cell, none where a corner is void (one where only one is). Grids
 * of more than 2^31 samples are refused. */
TL_API tl_status tl_mesh_from_source(const tl_source *source, const tl_run *run, tl_mesh **out, tl_error *error);

/* Hangs a wall of `depth` units of height, > 0, below every open edge of a mesh: it hides cracks towards a neighbour of
 * another detail. */
TL_API tl_status tl_mesh_add_skirt(tl_mesh *mesh, double depth, tl_error *error);
/* Closes a mesh to a solid with a floor `thickness` units of height, > 0, below its lowest vertex: every edge then has
 * two triangles, and all face outwards. For 3-D printing. */
TL_API tl_status tl_mesh_add_base(tl_mesh *mesh, double thickness, tl_error *error);

/* What a rescan of a mesh against every sample of a grid finds. */
typedef struct tl_mesh_report {
    double max_error; /* largest |mesh - sample|, in units of height */
    double rms_error;
    int64_t worst_i, worst_j; /* where it is; -1 where no sample is covered */
    uint64_t samples;         /* valid samples that a triangle covers */
    uint64_t uncovered;       /* valid samples that no triangle covers */
    /* Where bounds were given (see tl_mesh_verify_file): samples whose error is above their bound, and the largest
     * excess, which is at worst_i, worst_j then. */
    uint64_t exceeding;
    double max_excess;
} tl_mesh_report;

/* Compares a mesh (of vertices on the source's finest grid) with every sample of the source, in double
 * precision, triangle by triangle. */
TL_API tl_status tl_mesh_verify(const tl_mesh *mesh, const tl_source *source, const tl_run *run, tl_mesh_report *out,
                                tl_error *error);
/* The same in the frame that the mesh is written in: in an ENU frame, the distance of every sample from the flat
 * triangles along the ellipsoid's vertical through it. Samples of the raster's rim that the chords there leave out are
 * measured from the plane of the triangle that covers them on the lattice. */
TL_API tl_status tl_mesh_verify_in(const tl_mesh *mesh, const tl_source *source, tl_frame frame, const tl_run *run,
                                   tl_mesh_report *out, tl_error *error);

/* ---- Features ---------------------------------------------------------------------------------- */

/* What a sample is; a set of these. */
typedef enum tl_feature_kind {
    TL_FEATURE_SUMMIT = 1, /* higher than all eight neighbours; of equal ones the last, row by row, is the highest */
    TL_FEATURE_PIT = 2,
    TL_FEATURE_PASS = 4,   /* where two hills, or two hollows, meet */
    TL_FEATURE_RIDGE = 8,  /* on the steepest way up from a pass to a summit */
    TL_FEATURE_VALLEY = 16 /* on the steepest way down from a pass to a pit */
} tl_feature_kind;

typedef struct tl_feature {
    int32_t i, j;
    float z;
    unsigned kinds; /* of tl_feature_kind */
} tl_feature;

/* Features row by row. */
typedef struct tl_features {
    size_t count;
    tl_feature *items;
} tl_features;

typedef struct tl_features_options {
    /* What matters, in units of height: a summit at least so high above the highest pass that leads to a higher one, a
     * pit likewise (topological persistence), and these passes. The highest sample and the lowest count where they are
     * so far apart. */
    double persistence;
    bool lines; /* ridges and valleys too */
    const tl_run *run;
} tl_features_options;

/* Finds the features of an elevation model, which is held in memory: 21 bytes a sample. */
TL_API tl_status tl_features_find(const tl_source *dem, const tl_features_options *options, tl_features **out,
                                  tl_error *error);
TL_API void tl_features_destroy(tl_features *features);

/* ---- Framework --------------------------------------------------------------------------------- */

/* The characteristic points of an elevation model under a strict error bound: the restricted quadtree
 * triangulation (right isosceles triangles by longest-edge bisection) in which no sample is farther than
 * max_error from the surface. */
typedef struct tl_framework tl_framework;

/* How far the numbers of a mesh file may move a vertex: see tl_write_rounding. */
typedef struct tl_rounding {
    double along;    /* along the ground, in cells */
    double upright;  /* upwards, in units of height, and */
    double of_range; /* as much again for each unit in the range of heights */
} tl_rounding;

typedef struct tl_framework_options {
    double max_error; /* largest vertical distance allowed at any sample, in units of height; >= 0 */
    const tl_run *run;
    /* The frame that the mesh will be written in, where the bound holds. In ENU frames samples lie on the curved
     * ellipsoid and triangles are flat, so that a wide one sags below level ground: by 2 m if it is 10 km wide. The
     * other frames have flat lattices. */
    tl_frame frame;
    tl_rounding rounding;        /* of the file that the mesh will be written to, which counts into the bound */
    const tl_features *features; /* samples that become characteristic points whatever the bound; NULL: none */
} tl_framework_options;

TL_API tl_framework *tl_framework_build(const tl_source *dem, const tl_framework_options *options, tl_error *error);
TL_API void tl_framework_destroy(tl_framework *framework);

/* Number of characteristic points. */
TL_API size_t tl_framework_point_count(const tl_framework *framework);
/* Valid samples that are in no triangle. One that no cell with three valid corners holds, as at the end of a row one
 * sample wide, is tied in by a triangle that reaches up to three samples far and passes no other sample; what is left
 * is farther off, or would pass voids. */
TL_API size_t tl_framework_isolated_count(const tl_framework *framework);
/* The largest vertical distance that was asked for or, of a framework that came from a budget, that it keeps. */
TL_API double tl_framework_max_error(const tl_framework *framework);
/* Whether sample (i, j), which must lie in the grid, is a characteristic point. */
TL_API bool tl_framework_has_point(const tl_framework *framework, int64_t i, int64_t j);
/* The conforming mesh over the characteristic points; it does not need the DEM any more. */
TL_API tl_status tl_framework_mesh(const tl_framework *framework, tl_mesh **out, tl_error *error);

/* ---- Simplified meshes --------------------------------------------------------------------------- */

/* Kinds of meshes that keep a bound on their error. */
typedef enum tl_mesh_kind {
    TL_MESH_QUADTREE = 0, /* that of the framework */
    TL_MESH_TIN, /* irregular: a finer framework's mesh, its vertices moved onto neighbours while the bound holds. A
                    half to a quarter of the triangles, in ten times the time or more */
} tl_mesh_kind;

typedef struct tl_simplify_options {
    double max_error;     /* largest vertical distance allowed at any sample, in units of height; >= 0 */
    tl_frame frame;       /* as in tl_framework_options */
    tl_rounding rounding; /* likewise */
    tl_mesh_kind kind;
    /* Choose the vertices on the raster's rim by its own samples alone, so that meshes of rasters that share their
     * outermost samples join without a crack. A TIN always does. (The rim may keep more where voids touch its second
     * row; in ENU frames, beside ground steeper than 4 in 1.) */
    bool canonical_borders;
    const tl_run *run;
} tl_simplify_options;

/* Simplifies an elevation model to a mesh: no sample is farther than max_error from it, in double arithmetic; every
 * vertex is a sample. *uncovered (may be NULL) becomes the number of valid samples in no triangle, which lie alone
 * among voids. A TIN takes some 80 to 120 bytes a sample of memory where the bound is so small that it starts from
 * all. */
TL_API tl_status tl_simplify(const tl_source *dem, const tl_simplify_options *options, tl_mesh **out,
                             uint64_t *uncovered, tl_error *error);

/* ---- Diagonals ------------------------------------------------------------------------------------ */

typedef struct tl_diagonal_options {
    double max_error;     /* the bound that the mesh keeps, and goes on to keep */
    tl_frame frame;       /* as in tl_framework_options */
    tl_rounding rounding; /* likewise */
    const tl_run *run;
} tl_diagonal_options;

typedef struct tl_diagonal_report {
    uint64_t squares; /* pairs of triangles that are halves of one square, upright or on a corner */
    uint64_t lower;   /* of these, cut along the lower diagonal already, or level */
    uint64_t turned;  /* that were cut along the higher one, and are turned */
    uint64_t held;    /* that would break the bound, and are left */
    uint64_t samples; /* inside of those that were turned, and their rms errors */
    double rms_before, rms_after;
} tl_diagonal_report;

/* Cuts the squares of a mesh by longest-edge bisection along the lower of their diagonals, the one whose ends are lower
 * in the mean, where the bound allows it: the rule of Hu and Wang's patches. `dem` is the model that the mesh was made
 * of; samples inside of squares that are to be turned are read. `out` may be NULL. When it fails, the mesh may be
 * turned in parts; it is a good mesh all the same. */
TL_API tl_status tl_mesh_lower_diagonals(tl_mesh *mesh, const tl_source *dem, const tl_diagonal_options *options,
                                         tl_diagonal_report *out, tl_error *error);

/* ---- Frameworks for every bound ------------------------------------------------------------------ */

/* For every sample the largest bound at which the framework still needs it: so all frameworks of an elevation model.
 * Made in two passes over the model, which is never held as a whole. A pyramid may be used by any number of threads at
 * once, and does not need the model between its uses. */
typedef struct tl_pyramid tl_pyramid;

typedef struct tl_pyramid_options {
    /* Keep errors as floats, in 4 bytes a sample. Else they are kept in one, rounded up to the next float with four
     * bits of mantissa (1, 1.0625 ... 1.9375, 2, 2.125 ...; by 3 % on average, and down to 2^-15.8 of the model's range
     * of heights): strict all the same, and for bounds that are such numbers themselves, as 0.5, 1, 5, 20 or 100, as
     * good. */
    bool exact;
    tl_frame frame;       /* see tl_framework_options */
    tl_rounding rounding; /* likewise */
    const tl_run *run;
} tl_pyramid_options;

/* `options` may be NULL. */
TL_API tl_pyramid *tl_pyramid_create(const tl_source *dem, const tl_pyramid_options *options, tl_error *error);
TL_API void tl_pyramid_destroy(tl_pyramid *pyramid);
/* The largest bound at which sample (i, j), which must lie in the grid, splits triangles; infinite where it always
 * does: beside voids, and where triangles would reach over the rim. */
TL_API double tl_pyramid_error(const tl_pyramid *pyramid, int64_t i, int64_t j);

/* What to take out of a pyramid: `triangles`, or `vertices`, or all that `max_error` needs. */
typedef struct tl_selection {
    double max_error; /* the bound, >= 0 */
    /* A bound, >= 0, for each sample of the model, where not NULL: a triangle keeps the smallest of the samples that it
     * covers. `max_error` is that of the map's voids. Not for budgets. */
    const tl_source *max_error_map;
    /* Where not 0: at most so many, and as many as there can be: samples are taken by falling error, those that split
     * larger triangles first where errors are equal, then row by row. Fewer than what voids and rims take alone is
     * refused. */
    uint64_t triangles, vertices;
    const tl_features *features; /* become points too, and count into budgets; NULL: none */
    const tl_run *run;
} tl_selection;

/* The framework of a selection. `dem` is the model of the pyramid; its heights are read once, twice with voids and
 * budgets. Those of larger bounds and smaller budgets are parts of each other. */
TL_API tl_framework *tl_framework_from_pyramid(const tl_pyramid *pyramid, const tl_source *dem,
                                               const tl_selection *selection, tl_error *error);

/* ---- The field --------------------------------------------------------------------------------- */

/* A way to refine a lattice, found by name. */
typedef struct tl_scheme {
    const char *name;    /* "stationary" */
    const char *summary; /* one line */
    bool noise;          /* tl_noise_create has it: it needs no elevation model */
    bool field;          /* tl_field_create has it: it goes on from heights that are there */
} tl_scheme;

/* The schemes, ended by an entry whose name is NULL. */
TL_API const tl_scheme *tl_schemes(void);

/* What the samples of an elevation model stand for, as far as refinement goes; where they lie is not changed by it. */
typedef enum tl_support {
    TL_SUPPORT_RASTER = 0, /* what the raster's own type says */
    TL_SUPPORT_AREA,       /* means over cells */
    TL_SUPPORT_POINT,      /* heights at their positions */
} tl_support;

typedef struct tl_field_options {
    int levels; /* halvings of the DEM's spacing, 0 ... 30 */
    /* A name of tl_schemes() with `field`; NULL: "terrain" where neither hurst nor delta nor a map is given, else
     * "stationary". */
    const char *scheme;
    bool hurst_given, delta_given;
    double hurst; /* Hurst exponent of every level below the DEM, 0.01 ... 0.99; where not given, measured */
    double delta; /* standard deviation of the height difference of neighbouring DEM samples in the fractal model,
                     in units of height, >= 0; where not given, measured from the DEM */
    uint64_t seed;
    const tl_run *run; /* for the measurement, which reads the DEM once */
    tl_support support;
    /* Rasters of the Hurst exponent (0 ... 2; the nearest of 0.01 ... 0.99 is taken) and of delta (0 ... 1e30, in units
     * of height) from place to place, for schemes of fBm; NULL: one value everywhere. They are laid over the DEM by
     * coordinates where both are georeferenced, in one CRS, else from edge to edge, and are sampled bilinearly at the
     * DEM's samples; beyond a map's rim its last values go on, and where it is void the DEM's own value holds: `hurst`
     * and `delta`, else what is measured. Between the samples both go on bilinearly, and an octave l below the DEM has
     * the amplitude delta 2^(-l H) of the place. A map of the exponent is for the scheme "stationary"; the exponent of
     * every octave below is then the map's. Both are read once when the field is created, and must outlive it. */
    const tl_source *hurst_map, *delta_map;
    /* The delta map holds sigma of the finest octave instead, as the second band of tl_statistics_write_maps does;
     * delta is then that of fBm with this detail and the place's exponent. */
    bool delta_map_is_sigma;
} tl_field_options;

/* The terrain below the DEM's samples: a source at level options->levels. A point raster of W x H samples
 * becomes (W-1) 2^l + 1 by (H-1) 2^l + 1, and every 2^l-th sample is the DEM's own (but for the scheme "successive",
 * which moves it). An area raster becomes W 2^l by H 2^l cells on the same footprint. Voids stay voids. Cells that are
 * not square are followed, for geographic rasters from row to row; schemes of fBm refuse cells beyond 0.2 ... 5 times
 * as wide as high. */
TL_API tl_source *tl_field_create(const tl_source *dem, const tl_field_options *options, tl_error *error);

typedef struct tl_restore_options {
    bool hurst_given, delta_given;
    double hurst, delta; /* as in tl_field_options; where not given, those of the framework's file, else measured */
    uint64_t seed;
    const tl_run *run;
} tl_restore_options;

/* The elevation model again, of the same samples, from its framework alone or with the model: points keep their
 * heights, and what was dropped is the triangles' surface with fractal detail, made from coarse to fine by kriging of
 * what is known around. No sample is farther than the framework's bound from the surface; given the model, none is
 * farther from it either, else twice as far at most. (That of a framework whose bound varies is the largest.) Samples
 * in no triangle are the model's, or void. It is made here and kept, 4 bytes a sample, and refines as any model does by
 * tl_field_create. Needs the framework and the model only until it returns. */
TL_API tl_source *tl_framework_restore(const tl_framework *framework, const tl_source *dem,
                                       const tl_restore_options *options, tl_error *error);

/* Roughness of an elevation model: the detail that its finest halving of spacing added. */
typedef struct tl_roughness {
    bool measurable; /* false: too small, too flat or too void to tell; the rest is then 0 */
    double sigma;    /* standard deviation of the detail of the finest octave, units of height */
    /* Exponent between the two finest octaves; above 1 on smooth hillslopes. The second octave is that of 2 x 2 means,
     * as suits rasters of cell means; of a surface sampled at true points it reads 0.4 to 0.6 too low. Of a raster
     * that is too small to tell, the exponent that terrain as rough as this usually has. */
    double hurst;
} tl_roughness;

TL_API tl_status tl_roughness_measure(const tl_source *dem, const tl_run *run, tl_roughness *out, tl_error *error);

typedef struct tl_noise_options {
    int64_t size; /* samples on a side, at least 1 */
    double hurst; /* in (0, 1) */
    double delta; /* standard deviation of the height difference over one sample, >= 0 */
    uint64_t seed;
    const char *scheme; /* a name of tl_schemes() with `noise`; NULL: "stationary" */
    double aspect;      /* width of a cell over its height, 0.2 ... 5; 0: 1. delta is over the height. */
} tl_noise_options;

/* A fractional Brownian surface of size x size samples at unit spacing: S(h) = delta^2 |h|^(2 hurst). */
TL_API tl_source *tl_noise_create(const tl_noise_options *options, tl_error *error);

typedef struct tl_precision_options {
    int levels; /* 0 ... 30 */
    /* Exponents of the samples at level 0 in turn, 0.01 ... 0.99; two that differ only with `by_place`, which makes the
     * weights of every place as maps of the exponent do. */
    double hurst[2];
    bool by_place;
    double delta;        /* 0 ... 1e30 */
    int64_t column, row; /* of the window's first sample at the deepest level, within 2^60 */
    uint64_t seed;
} tl_precision_options;

typedef struct tl_precision {
    double largest; /* difference, in the unit of delta; infinite where a height is not finite */
    uint64_t samples;
} tl_precision;

/* What single precision costs the scheme "stationary": `levels` refinements of heights within +-delta, in a window of
 * 21 x 17 samples, against the same recursion in long double with the same noise. */
TL_API tl_status tl_precision_measure(const tl_precision_options *options, tl_precision *out, tl_error *error);

/* ---- Views ------------------------------------------------------------------------------------- */

/* Where a picture is taken from. */
typedef struct tl_view {
    /* Longitude and latitude in degrees on the raster's own datum (CRS coordinates where `projected` is set, or the
     * raster has no CRS: columns and negative rows), and metres above the datum that heights count from, or above the
     * ground there. */
    double eye[3];
    bool projected;
    bool above_ground;        /* the eye's height; `target_above_ground` is the target's */
    bool target_given;        /* look there, and not by heading, pitch and roll */
    bool target_above_ground; /* target[2] */
    double target[3];         /* as eye */
    /* Degrees: heading clockwise from north, pitch above the horizon (-90 ... 90), roll clockwise as seen from behind:
     * the right side goes down. Roll counts with a target too. */
    double heading, pitch, roll;
    double fov;        /* horizontal field of view in degrees, 0.01 ... 179; 0: 60 */
    int width, height; /* of the viewport in pixels, at most 32768; both 0: 1920 x 1080 */
    bool flat;         /* no curvature of the Earth: heights count from the tangent plane at the eye's foot */
    /* Share of the Earth's curvature that refraction takes off what is seen, 0 ... 0.9: 0.13 by day. */
    double refraction;
} tl_view;

/* A view on a path. */
typedef struct tl_view_key {
    double time; /* seconds; NaN: the file does not say */
    tl_view view;
} tl_view_key;

/* Reads views from a camera file: the members of tl_view by their names in a JSON, as {"eye": [11.3, 46.7, 300],
 * "above_ground": true, "heading": 120}; several of them, with "time", as {"views": [...]}, where members beside
 * "views" count for each view that does not say otherwise; or the cameras of a glTF (.gltf, .glb) with the origin that
 * talus writes into the asset's extras: perspective ones, placed by nodes. *keys is freed by free(). TL_ERROR_DATA
 * where the file holds no views, or members that are not known. */
TL_API tl_status tl_view_path_read(const char *path, tl_view_key **keys, size_t *count, tl_error *error);
/* The same for a file of one view. */
TL_API tl_status tl_view_read(const char *path, tl_view *out, tl_error *error);
/* `frames` views along the smooth curve through the keys, from the first to the last, at equal steps of their times or,
 * where these are NaN, at equal steps of the way. Keys must agree in all that is no number, and in the viewport. */
TL_API tl_status tl_view_path_sample(const tl_view_key *keys, size_t count, size_t frames, tl_view *out,
                                     tl_error *error);

/* Ways to choose the triangles. */
typedef enum tl_selector {
    TL_SELECTOR_QUADTREE = 0, /* breadth first, with two queues */
    TL_SELECTOR_CHUNK,        /* tiles with a step that is a power of two, edges rebuilt towards coarser neighbours */
    TL_SELECTOR_ROAM,         /* triangles by falling error, from a queue */
} tl_selector;

/* Rules that leave out what cannot be seen; see tl_lod_options.keep. */
typedef enum tl_culling {
    TL_CULL_FRUSTUM = 1, /* beside the screen, or behind the eye */
    TL_CULL_BACK = 2,    /* ground that looks away, by the cone of its normals */
    TL_CULL_HORIZON = 4, /* behind the curve of the Earth */
    TL_CULL_RIDGE = 8,   /* behind nearer ground */
} tl_culling;

enum { TL_LOD_BANDS = 32 };

typedef struct tl_lod_options {
    tl_selector selector;
    double
        pixel_error; /* pixels by which the picture may differ, > 0; 0: 1, or none where there is a budget or bands */
    /* Most triangles; 0: any number. Where the pixel error does not take them all, the rest is not used. */
    uint64_t budget;
    /* Instead of the pixel error: within distances[k] metres cells of unit 2^k samples of the finest level, beyond
     * the last twice as large again; rising. */
    size_t band_count;
    double bands[TL_LOD_BANDS];
    int max_level; /* finest level that may be used; 0: the field's own. Negative ones are coarser than the DEM */
    bool max_level_given;
    unsigned keep; /* an or of tl_culling: rules that are switched off */
    /* Vertices come and go where the surface is, and move to their places as the eye comes nearer: no vertex
     * jumps. Takes the triangles of two thirds of the pixel error; not with bands. */
    bool morph;
    const tl_run *run; /* its memory bounds what the choice keeps, beside the mesh */
} tl_lod_options;

typedef struct tl_lod_stats {
    uint64_t triangles, vertices;
    uint64_t visited, split;         /* nodes of the hierarchy; of tl_roam those that were looked at again, and split */
    uint64_t merged;                 /* of tl_roam: nodes that are not split any more */
    uint64_t culled[4];              /* nodes, by rule: frustum, back, horizon, ridge */
    uint64_t tiles_made, tiles_used; /* tiles of the field that were synthesised, and times one was asked for */
    uint64_t samples_made;
    uint64_t dem_blocks, dem_samples; /* blocks of the DEM that were read, and samples of windows of it */
    int finest_level;
    double pixel_error;  /* the largest that is left, by the bounds used; infinite at distance 0 */
    double above_ground; /* metres of the eye above the DEM; NaN where that has none */
    double seconds;
} tl_lod_stats;

/* The triangles of a field for a view. `field` is one of tl_field_create over `dem`, with the support of points (a
 * vertex of one level is a vertex of all finer ones); `pyramid` is that of `dem`. Vertices are on the lattice of the
 * field's finest level; the mesh has no cracks, and nothing where it was culled. */
TL_API tl_status tl_select(const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid, const tl_view *view,
                           const tl_lod_options *options, tl_mesh **out, tl_lod_stats *stats, tl_error *error);

/* Triangles that are kept from view to view: a flight costs what changes. The triangles for a view are those of
 * tl_select, whatever was looked at before. */
typedef struct tl_roam tl_roam;

/* As tl_select; options->selector does not matter, and options->run is copied. Borrows the three. */
TL_API tl_roam *tl_roam_create(const tl_source *field, const tl_source *dem, const tl_pyramid *pyramid,
                               const tl_lod_options *options, tl_error *error);
/* Looks from another view. Of the statistics, `seconds` are those of choosing the triangles, `vertices` are all that
 * are kept, and `pixel_error` is by what was found when a triangle was last looked at. After a failure only the
 * destroyer is left. `stats` may be NULL. */
TL_API tl_status tl_roam_look(tl_roam *roam, const tl_view *view, tl_lod_stats *stats, tl_error *error);
/* The mesh for the last view. */
TL_API tl_status tl_roam_mesh(tl_roam *roam, tl_mesh **out, tl_error *error);
TL_API void tl_roam_destroy(tl_roam *roam);

/* For each vertex of a mesh of tl_select, tl_roam_mesh or tl_framework_mesh the height of the middle of the edge that
 * it splits: where the surface was before the vertex came. Moved from there to its own height over some frames, a
 * vertex comes without a jump. Its own height where an end of that edge is not in the mesh. `out` has room for all. */
TL_API tl_status tl_mesh_parent_heights(const tl_mesh *mesh, float *out, tl_error *error);

/* How tl_view_write_picture draws. */
typedef struct tl_view_picture_options {
    double sun_azimuth, sun_elevation; /* degrees, clockwise from north and above the horizon (0 ... 90), at the eye's
                                          foot; both 0: 315 and 45 */
    double haze;                       /* metres at which half of the light is lost in the air; 0: clear */
    double exaggeration;               /* factor on the mesh's heights, not on the eye's, 0 ... 1e6; 0: 1 */
    bool grey;                         /* no colours by height */
    /* A raster in dem's CRS that is laid over the mesh: bands of red, green and blue bytes, or one of grey. Or one of
     * these layers of dem: normal, slope (white: 90 degrees), splat (rock and scree in greys, soil green, snow white).
     * Where it has none, and where this is NULL: colours by height. Far ground has the means of what a pixel covers. */
    const char *colour;
    bool facets; /* light each triangle by itself; else by normals at its corners, means over the triangles
                    around weighted by their areas, so that no triangle shows */
    const char
        *depth; /* also write an EXR of this name: metres ahead of the eye (along the middle of the picture) at
                   the middle of each pixel, float32, void where nothing is seen; of the first view. NULL: none */
    bool overwrite;
    const tl_run *run;
} tl_view_picture_options;

/* Draws a mesh that tl_select made over `dem` (or any mesh over a lattice with dem's place) as a PNG, with four samples
 * a pixel. Faces are seen from above only, and where there are none there is sky. The colours of heights are those of
 * the whole of `dem`, a sample of which is read. Of several views of the same size the picture is the mean of the light
 * that they get: motion blur. Equal for any number of threads. */
TL_API tl_status tl_view_write_picture(const tl_mesh *mesh, const tl_source *dem, const tl_view *views, size_t count,
                                       const char *path, const tl_view_picture_options *options, tl_error *error);

/* What many pictures of one model share: its colours are read once. Borrows `dem`, and copies the options but not
 * their texts and their run. The pictures are those of tl_view_write_picture. The destroyer takes NULL. */
typedef struct tl_view_painter tl_view_painter;
TL_API tl_view_painter *tl_view_painter_create(const tl_source *dem, const tl_view_picture_options *options,
                                               tl_error *error);
TL_API tl_status tl_view_painter_write(const tl_view_painter *painter, const tl_mesh *mesh, const tl_view *views,
                                       size_t count, const char *path, tl_error *error);
TL_API void tl_view_painter_destroy(tl_view_painter *painter);

/* A distribution of errors on the screen, in pixels. */
typedef struct tl_view_errors {
    uint64_t count;
    double half, ninety, ninety_nine, thousand; /* what 50, 90, 99 and 99.9 % of them are not above; within 1/256 */
    double largest;
} tl_view_errors;

/* How far the picture of a mesh is from that of a reference; see tl_view_measure. */
typedef struct tl_view_report {
    tl_view_errors parallax;
    tl_view_errors silhouette;
    uint64_t missing; /* points of the reference over which the mesh has no triangle, or one behind the eye */
} tl_view_report;

/* Compares a mesh with a finer one over the same lattice, as `view` has them. At the middle of each pixel where the
 * reference shows ground, *parallax* is the distance on the screen between that point and the mesh's point at the same
 * column and row of the lattice (both as the flat triangles have it there): how far the picture of a piece of ground is
 * shifted, whether or not the mesh's own relief then hides it. *Silhouettes* are what parallax leaves out: with 4 x 4
 * samples a pixel, at every sample beside an edge of the reference's picture (one of its four neighbours is nearer or
 * farther ahead by more than a tenth, or sky), how far around it one must look in the mesh's picture to see something
 * as near and something as far, to a tenth (sky is farthest): how far the edge is shifted. And the same from the edges
 * of the mesh's picture to that of the reference. It comes in steps of a quarter of a pixel; 4 stands for 4 or more.
 * Takes some 70 bytes a triangle of the mesh and 16 of the reference. */
TL_API tl_status tl_view_measure(const tl_mesh *mesh, const tl_mesh *reference, const tl_source *dem,
                                 const tl_view *view, const tl_run *run, tl_view_report *out, tl_error *error);

/* ---- Statistics -------------------------------------------------------------------------------- */

/* How like fractional Brownian motion a raster is: E|Z(x + h) - Z(x)|^2 = delta^2 |h|^(2 hurst), with h in samples (of
 * cells that are not square: in sqrt(cell_x cell_y)). Errors are one standard deviation of the estimate for Gaussian
 * fBm sampled as the raster is, computed from its covariance; real terrain, which is no single power law, has a
 * `misfit` above 1. */

enum {
    TL_STATISTICS_LAGS = 32,
    TL_STATISTICS_DIRECTIONS = 4, /* along rows, along columns, to the next column and row, and to the row before */
    TL_STATISTICS_FITTED = 4,     /* lags 1, 2, 4 and 8 */
    TL_STATISTICS_OCTAVES = 16,
    TL_STATISTICS_WAVES = 64,
};

/* Mean squared increments over `lag` columns and rows, by direction; NaN where there are none. */
typedef struct tl_lag {
    int64_t lag;
    double structure[TL_STATISTICS_DIRECTIONS]; /* Z(x + h) - Z(x), as they are: rounding included */
    double second[TL_STATISTICS_DIRECTIONS];    /* Z(x) - 2 Z(x + h) + Z(x + 2h) */
} tl_lag;

typedef struct tl_fbm_estimate {
    const char *name;    /* "increments" (second-order), "structure" (function, first-order) or "spectrum" */
    const char *refusal; /* why it tells nothing; NULL: it does */
    double hurst, hurst_error;
    bool delta_known; /* false where hurst is 1 or more, which no fBm has */
    double delta, delta_error;
    double misfit; /* chi-square over its degrees of freedom; 0: not known */
} tl_fbm_estimate;

/* The detail that halving the spacing adds, octave 0 the finest: as tl_roughness, with rounding taken off. */
typedef struct tl_octave {
    double cells;    /* spacing of the children, in samples: 2^octave */
    double sigma;    /* 0: not known */
    double exponent; /* log2 of the next octave's sigma over this one's; NaN: not known */
    /* The Hurst exponent of fBm with this exponent: the same for area rasters; of a point raster the finest octaves,
     * which are means of few points, are put right. NaN: none in 0.01 ... 0.99. */
    double hurst;
    uint64_t count;
} tl_octave;

typedef struct tl_statistics {
    uint64_t samples, voids;
    double noise; /* variance of the rounding that was taken off: that of the quantum, or of floats this large */
    size_t lag_count;
    tl_lag lags[TL_STATISTICS_LAGS]; /* up to a quarter of the shorter side */
    /* By second-order increments, the structure function and the spectrum. The first is the sharpest: its error for
     * 65 x 65 samples is about 0.02. The second falls off above hurst 0.7, as all that use first-order increments. */
    tl_fbm_estimate estimates[3];
    double slope, slope_error; /* of the power spectrum in the plane, k^-slope: 2 hurst + 2 */
    size_t wave_count;         /* 0: no window of 32 samples or more is without voids */
    double waves[TL_STATISTICS_WAVES], power[TL_STATISTICS_WAVES]; /* cycles a sample; height^2, white noise is flat */
    /* Largest over smallest standard deviation of increments by direction, the azimuth of the largest (degrees
     * clockwise from the grid's north, 0 ... 180), and the chance of isotropic fBm to look so. 0: not known. */
    double anisotropy, anisotropy_error, azimuth, isotropy_chance;
    /* Largest over smallest variance of second-order increments over one sample, by their middle's column and row
     * modulo 2, 4 and 8; stationary increments with these tails stay below the limit with a probability of 0.99. 0: not
     * known. */
    double positions[3], position_limits[3];
    /* Of second-order increments over normality_lag samples (the shortest at which rounding does not count; 0: not
     * known): skewness and excess kurtosis, and the chance of Gaussian fBm to depart as far: reject below 0.01, and one
     * Gaussian field in a hundred is. */
    int64_t normality_lag;
    double skewness, skewness_error, kurtosis, kurtosis_error, normality_chance;
    size_t octave_count;
    tl_octave octaves[TL_STATISTICS_OCTAVES];
} tl_statistics;

/* Measures the finest level of a source, which is read once, in parallel (and windows of it again, for the spectrum).
 * Voids, and heights that were filled into them, are left out. Takes some 25 MB and 8 MB a worker, whatever the size.
 */
TL_API tl_status tl_statistics_measure(const tl_source *source, const tl_run *run, tl_statistics *out, tl_error *error);

/* What a raster ought to be. */
typedef struct tl_expectation {
    bool hurst_given, delta_given;
    double hurst, delta;
    double tolerance; /* of hurst, and of delta as a fraction of it; 0: 0.05 */
} tl_expectation;

/* TL_ERROR_DATA, with the estimate by second-order increments and its error, where it is farther off or not known. */
TL_API tl_status tl_statistics_expect(const tl_statistics *statistics, const tl_expectation *expected, const char *name,
                                      tl_error *error);

/* Local maps. */
typedef struct tl_map_options {
    int window; /* samples on a side, 33 ... 513; 0: 65 */
    int stride; /* samples between windows, 8 ... 512; 0: 32 */
    bool overwrite;
    const tl_run *run;
} tl_map_options;

/* Writes a GeoTIFF with five bands, a cell for every `stride` samples: H by second-order increments, sigma of the
 * finest octave, azimuth of the roughest direction, the error of H, and the number of increments that H rests on. NaN
 * where the data do not tell. Takes 20 bytes a cell. */
TL_API tl_status tl_statistics_write_maps(const tl_source *source, const char *path, const tl_map_options *options,
                                          tl_error *error);

/* Draws the structure functions, the spectrum and the octaves as .svg or .png. TL_ERROR_ARGUMENT where the library was
 * built without cairo. */
TL_API tl_status tl_statistics_plot(const tl_statistics *statistics, const char *title, const char *path,
                                    bool overwrite, tl_error *error);

/* ---- Writing ----------------------------------------------------------------------------------- */

/* A format that talus writes, found by the ending of the file's name. */
typedef struct tl_format {
    const char *ending;  /* "exr", without the dot, lower case */
    const char *summary; /* one line */
    bool grid, mesh;     /* what it holds */
} tl_format;

/* The formats, ended by an entry whose ending is NULL. */
TL_API const tl_format *tl_formats(void);
/* The format of a path by its ending, upper or lower case; NULL where there is none. */
TL_API const tl_format *tl_format_of(const char *path);

typedef enum tl_compression {
    TL_COMPRESSION_DEFAULT = 0, /* EXR: zip; GeoTIFF: deflate */
    TL_COMPRESSION_NONE,
    TL_COMPRESSION_ZIP,  /* EXR (16 rows at a time), and deflate for GeoTIFF */
    TL_COMPRESSION_ZIPS, /* EXR (row by row) */
    TL_COMPRESSION_PIZ,  /* EXR (wavelet) */
    /* GeoTIFF, as far as libtiff was built with it */
    TL_COMPRESSION_DEFLATE,
    TL_COMPRESSION_ZSTD,
    TL_COMPRESSION_LZW,
    TL_COMPRESSION_LERC, /* of floats, within lerc_error */
} tl_compression;

/* Coarser levels beside a grid, in the same file. */
typedef enum tl_mip {
    TL_MIP_NONE = 0,
    TL_MIP_LATTICE, /* every second sample: each level's samples are the grid's own */
    TL_MIP_BOX,     /* means of 2 x 2 samples, of those that are known */
} tl_mip;

/* How a GLB keeps positions. */
typedef enum tl_mesh_coding {
    TL_CODING_PLAIN = 0,  /* single precision */
    TL_CODING_QUANTIZED,  /* steps of 16 bits from the mesh's lowest corner, by KHR_mesh_quantization: half the size */
    TL_CODING_COMPRESSED, /* the same, encoded by EXT_meshopt_compression: a tenth, for readers that know it */
} tl_mesh_coding;

typedef enum tl_texture {
    TL_TEXTURE_COLOUR = 1, /* colours by height, without light */
    TL_TEXTURE_NORMAL = 2,
} tl_texture;

typedef struct tl_write_options {
    bool overwrite; /* replace an existing file; else TL_ERROR_IO */
    bool validity;  /* of grids, not meshes: also write each sample's tl_validity, to NAME.validity.tif for NAME.exr */
    tl_compression compression;
    /* EXR: a mipmap down to one sample; GeoTIFF: overviews down to one tile of 256 x 256. Sizes are rounded up. They
     * take a third of the grid while it is written, of memory or, where the run may not take that, of disk. */
    tl_mip mip;
    bool mask; /* GeoTIFF: also masks of one bit a sample, beside the NaN that voids are */
    bool cog;  /* GeoTIFF: in the order of cloud-optimised ones, by a second file without a name beside the first */
    /* TL_COMPRESSION_LERC: by how much a height may move, in the source's unit; 0: not at all. */
    double lerc_error;
    /* EXR, above 0: as half floats, where this moves no height by more than that; else TL_ERROR_ARGUMENT. 0: floats. */
    double half_error;
    tl_frame frame;
    tl_mesh_coding coding; /* of meshes in GLB; others keep theirs */
    /* GLB, of meshes that tl_mesh_parent_heights knows: also write these, as the attribute _PARENT_HEIGHT, and the ways
     * there as a morph target, "parent". */
    bool parent_heights;
    /* GLB: the source over whose finest lattice the mesh lies. Vertices have its normals, turned into the frame: of
     * slopes of its finest level, meant over a square as wide as the vertex's shortest edge (128 samples at most), or,
     * of a field of point samples, of the level whose spacing is that edge; by central differences, one-sided at the
     * rim and beside voids. NULL: normals are those of the mesh's own triangles, weighted by their areas. */
    const tl_source *ground;
    /* GLB: textures of `ground`: tl_texture values, added. Texels are samples of its finest level that has at most
     * texture_size (0: 4096) a side, a PNG each. Where that is coarser than the finest triangles of a mesh over a
     * field of point samples, as in a view, the mesh is cut into squares, primitives with pictures of their own: texels
     * are samples of the level of a square's own finest vertices, or of one that is coarser by as much for all, so that
     * there are at most texture_size^2 together. With TL_TEXTURE_NORMAL the vertices' own normals point up and tangents
     * along rows: the texture holds the slopes, in metres. */
    unsigned textures;
    int texture_size;
    /* GLB, above 0: files NAME_x0_y0.glb and so on, tiles of the mesh from its first column and row, of at most so many
     * triangles each. All are in one frame, and join, also by their normals; each has textures of its own. With plain
     * coding and without heights of parents. */
    size_t split;
    const tl_run *run;
} tl_write_options;

/* Writes the finest level of a source to `path`, in the format of its ending (EXR, GeoTIFF, 16-bit PNG, R16 and raw
 * floats with a JSON file beside them, or a full mesh). All but GeoTIFF have the north in their first row, whatever the
 * order of the source; GeoTIFF keeps the source's. Tiles are made in parallel and written as they come, so memory does
 * not grow with the output. The file appears under its name only when it is complete. */
TL_API tl_status tl_write_grid(const tl_source *source, const char *path, const tl_write_options *options,
                               tl_error *error);
/* Writes a mesh to `path` (GLB, OBJ, PLY or STL by its ending). An STL in map coordinates counts from a whole unit near
 * its first vertex, which its header names: single precision is too coarse for them. */
TL_API tl_status tl_write_mesh(const tl_mesh *mesh, const char *path, const tl_write_options *options, tl_error *error);

/* A bound of the rounding in a mesh file of this name over a grid, by the options' frame and coding: none where its
 * numbers hold what the frame asks for. */
TL_API tl_rounding tl_write_rounding(const tl_source_info *grid, const char *path, const tl_write_options *options);
/* Reads back the file that tl_write_mesh made of `mesh` in `frame`, and compares it with every sample of the source as
 * tl_mesh_verify_in does, but with the numbers that the file has. Triangles that are upright or look down, walls and
 * floors, count for nothing. `bounds`, unless NULL, holds the bound, or the map of bounds, that the samples are held to
 * one by one; no more of it is used. TL_ERROR_DATA where the file is not such a mesh. */
TL_API tl_status tl_mesh_verify_file(const char *path, const tl_mesh *mesh, const tl_source *source,
                                     const tl_selection *bounds, tl_frame frame, const tl_run *run, tl_mesh_report *out,
                                     tl_error *error);
/* What a mesh file holds. */
typedef struct tl_mesh_summary {
    size_t vertex_count, triangle_count;
    double low[3], high[3]; /* of the coordinates, in the axes of the frame (a GLB's turned back) */
    /* "frame", "origin", "crs" where the file tells, then how the mesh was made; one block that free() frees, NULL for
     * none. */
    tl_parameter *record;
    size_t record_count;
} tl_mesh_summary;

/* Reads a .glb, .obj, .ply or .stl that talus wrote, in memory; or points, .geojson or .csv, whose "vertices" they are,
 * and a .terrain of tl_tiles_make, in degrees where its name has its level, column and row. TL_ERROR_DATA where it is
 * damaged, or of a kind that talus would not write; TL_ERROR_MEMORY where it takes more than run->memory. */
TL_API tl_status tl_mesh_read_summary(const char *path, const tl_run *run, tl_mesh_summary *out, tl_error *error);
/* Writes an error pyramid to `path` as a GeoTIFF of bytes, or of floats where it is exact. */
TL_API tl_status tl_pyramid_save(const tl_pyramid *pyramid, const char *path, const tl_write_options *options,
                                 tl_error *error);
/* Reads one that tl_pyramid_save wrote, instead of tl_pyramid_create with the same options, which may be NULL. `dem` is
 * read once for its checksum. TL_ERROR_DATA where the file is damaged, or was made of other heights, with other options
 * or by another version: then make it again; TL_ERROR_ARGUMENT where it is no pyramid at all. */
TL_API tl_pyramid *tl_pyramid_load(const char *path, const tl_source *dem, const tl_pyramid_options *options,
                                   tl_error *error);

typedef struct tl_points_options {
    bool overwrite;
    const tl_features *features; /* whose kinds are told beside the points, in CSV and GeoJSON; NULL: none */
    /* GeoJSON: longitude and latitude on the CRS's own datum and metres of height, as RFC 7946 wants (WGS 84 and what
     * is within metres of it), or by name TL_FRAME_PROJECTED or TL_FRAME_PIXEL. PLY: as for meshes. CSV has columns,
     * rows, CRS coordinates and heights whatever this says. */
    tl_frame frame;
    const tl_run *run;
} tl_points_options;

/* Writes the characteristic points: .geojson, .csv, .ply, or .tif, the sparse framework: a GeoTIFF of the model's
 * lattice with three bands, void where no point is kept: height, Hurst exponent and the standard deviation of the
 * height difference over one sample, both of the whole model. Where the model is void the second band is 0. `dem` is
 * the model of the framework, read once for the .tif. */
TL_API tl_status tl_framework_save(const tl_framework *framework, const tl_source *dem, const char *path,
                                   const tl_points_options *options, tl_error *error);
/* Whether a file is a framework that tl_framework_save wrote. */
TL_API bool tl_framework_is_file(const char *path);
/* Reads the framework back: the same points, triangles and bound. TL_ERROR_ARGUMENT where it is none. */
TL_API tl_framework *tl_framework_load(const char *path, const tl_run *run, tl_error *error);

/* ---- Layers -------------------------------------------------------------------------------------- */

/* What can be told of every sample beside its height. */
typedef struct tl_layer_kind {
    const char *name;    /* "normal" */
    const char *summary; /* one line */
    size_t channels;     /* values a sample, 1 ... 4 */
    const char *channel_names[4];
} tl_layer_kind;

/* The kinds, ended by an entry whose name is NULL. Slopes are those of central differences in metres, for geographic
 * rasters by the ellipsoid at the row's latitude; windows made apart join. */
TL_API const tl_layer_kind *tl_layers(void);

typedef struct tl_layer_options {
    /* Of splat: a JSON file of rules, or NULL for built-in ones (temperate mountains). For each of rock, scree, soil
     * and snow an object of ramps over slope (degrees), height (metres), curvature (1/m) and sigma (metres), [0 at, 1
     * from] or [0 at, 1 from, 1 to, 0 at], rising, with null for no bound, and a weight (1). Shares are weights times
     * ramps, scaled to add up to 1. */
    const char *rules;
    bool overwrite;
    tl_compression compression; /* of EXR and GeoTIFF */
    const tl_run *run;
} tl_layer_options;

/* One channel of a layer as a source: NaN where the height is void. TL_ERROR_ARGUMENT for kinds that are not there, and
 * for sigma over heights that tl_field_create did not make. */
TL_API tl_source *tl_layer_create(const tl_source *heights, const char *kind, size_t channel,
                                  const tl_layer_options *options, tl_error *error);
/* Writes a layer: .exr with its channels; .png with 8 bits (normals from -1 ... 1, slopes from 0 ... 90 degrees, mask
 * and hurst from 0 ... 1, shares, sRGB; not curvature and sigma); .tif where it has one channel. Pictures have the
 * north in their first row. */
TL_API tl_status tl_write_layer(const tl_source *heights, const char *kind, const char *path,
                                const tl_layer_options *options, tl_error *error);

/* Writes heights, as channel Y, and layers of them into one EXR: channels KIND.CHANNEL, as normal.R; those of one value
 * KIND.Y. `surface` is what the layers are made of, over the same lattice; NULL: `heights`. No mipmaps, no half floats.
 * tl_open reads the heights. */
TL_API tl_status tl_write_layers(const tl_source *heights, const tl_source *surface, const char *const *kinds,
                                 size_t count, const char *path, const tl_layer_options *options, tl_error *error);

/* ---- Game engines and modellers ------------------------------------------------------------------- */

/* What a program imports best. */
typedef struct tl_preset {
    const char *name;    /* "unreal" */
    const char *summary; /* one line */
    const char *endings; /* of files that it takes, the best first, with spaces between: "png r16" */
} tl_preset;

/* The presets, ended by an entry whose name is NULL. */
TL_API const tl_preset *tl_presets(void);

typedef struct tl_preset_options {
    const char *preset; /* a name of tl_presets() */
    int64_t tile;       /* samples on a side of a tile, one that the program takes; 0: chosen */
    bool overwrite;
    const tl_run *run; /* the source is read twice: for the range of heights, and to be written */
} tl_preset_options;

typedef struct tl_preset_report {
    int64_t tile_width, tile_height; /* samples */
    int64_t columns, rows;           /* of tiles; neighbours share their outermost samples */
    tl_window window;                /* of the source that the tiles cover together, in its middle */
    float low, high;                 /* of the heights in it */
    char import[640];                /* what to type into the program's importer, a line each */
} tl_preset_report;

/* Writes a source for a program: as many whole tiles of a size that it takes as cover most of the source, from its
 * middle, all over one range of heights, in the order of rows and by the names that the program wants: NAME.r16 for one
 * tile, NAME_x0_y0.r16 and so on for more; and NAME.json, which tells where they lie and what their numbers mean. Voids
 * become the lowest height, since no program knows them. TL_ERROR_ARGUMENT where the source is smaller than the
 * smallest tile, and where its rows do not run along the axes. When it fails nothing new is left; with `overwrite` some
 * tiles may have been replaced. */
TL_API tl_status tl_write_preset(const tl_source *source, const char *path, const tl_preset_options *options,
                                 tl_preset_report *out, tl_error *error);

/* ---- Tiles of the globe ---------------------------------------------------------------------------- */

enum { TL_TILE_LEVELS = 25 };

typedef enum tl_tiles_format {
    TL_TILES_QUANTIZED_MESH, /* quantized-mesh 1.0, for globes: see tl_write_terrain_tiles */
    TL_TILES_3D,             /* 3D Tiles 1.1: implicit tiling, GLB */
} tl_tiles_format;

typedef struct tl_tiles_options {
    tl_tiles_format format;
    tl_mesh_coding coding; /* of 3D Tiles: steps of 16 bits, unless TL_CODING_COMPRESSED encodes these */
    unsigned textures;     /* of 3D Tiles: bits of tl_texture */
    /* Largest vertical distance, in metres, of the tiles of the deepest level from the heights on their lattice, > 0;
     * it doubles from level to level upwards. 0: a quarter of what globes take the level for, 77067 m / 2^level. */
    double max_error;
    int first_level; /* the coarsest level that is written; 0: from the two roots on */
    int last_level;  /* the deepest, where last_level_given; else the first whose cells are no larger than the source's
                      */
    bool last_level_given;
    bool no_normals;         /* leave out the normals of vertices */
    double outside;          /* metres: the height of ground that the source does not know */
    const char *attribution; /* for the page that shows it; NULL: none */
    /* Go on with what an earlier call with the same options and source has left in the folder. */
    bool resume;
    /* One of `shards` parts, counted from 0, that may run at the same time on any machines with one folder: it makes
     * every shards-th block of the deepest lattice. `finish` then makes all the rest. shards 0: everything. */
    unsigned shard, shards;
    bool finish;
    bool dry_run; /* write nothing; tell how many tiles there will be at most, and what to expect */
    const tl_run *run;
} tl_tiles_options;

typedef struct tl_tiles_level {
    uint64_t tiles, triangles, vertices, bytes;
    double error; /* metres: no tile's surface is farther from the heights on the deepest lattice */
} tl_tiles_level;

/* What a dry run expects, from tiles that it makes, without keeping them, from places all over the source. */
typedef struct tl_tiles_forecast {
    uint64_t sampled; /* such tiles */
    double seconds;   /* of so many threads that have a core each, without what the disk takes */
    unsigned threads;
    double spread; /* two standard errors of all levels' bytes, as a share of them; NaN: not known */
} tl_tiles_forecast;

typedef struct tl_tiles_report {
    int first_level, last_level;
    tl_tiles_level levels[TL_TILE_LEVELS];
    /* Metres: the largest difference between the source's samples and the surface over the deepest lattice; it comes on
     * top of the levels' errors. */
    double resampling;
    double spacing;               /* of the deepest lattice: degrees; metres of 3D Tiles */
    uint64_t blocks, done_before; /* of the work; those that an earlier call had done */
    bool complete;                /* the pyramid can be shown: layer.json or tileset.json is there */
    tl_tiles_forecast forecast;   /* of a dry run, whose levels tell the most tiles there can be and bytes to expect */
} tl_tiles_report;

/* Writes a source as a pyramid of tiles for globes. Heights are taken as above the ellipsoid (see tl_geoid_create).
 * The folder must be empty or not there, unless resume, shards or finish go on with it. Levels above the deepest are
 * drawn from every second vertex of the next ones, and count what these leave out. Tiles of one level share the
 * vertices of their edges. Takes some 64 MB a worker. TL_ERROR_ARGUMENT where it is not known where the source lies.
 *
 * TL_TILES_QUANTIZED_MESH: quantized-mesh 1.0, FOLDER/LEVEL/COLUMN/ROW.terrain in the geographic scheme (EPSG:4326,
 * rows from the south), gzipped, and FOLDER/layer.json. The deepest level is 64 x 64 cells of the lattice a tile, onto
 * which the source is interpolated by a cubic.
 *
 * TL_TILES_3D: 3D Tiles 1.1, FOLDER/content/LEVEL/COLUMN/ROW.glb of the implicit quadtree over the source's own
 * lattice, 64 x 64 of its cells a tile of the last level, with FOLDER/subtrees and FOLDER/tileset.json: nothing is
 * resampled, any CRS will do, and voids are holes, whose rims move by up to a cell of a level. Its report's last level
 * is that of the samples; options->last_level, if given, must be it, and `outside` says nothing. Every tile has a
 * region that holds it and all below it, and as its geometric error the greatest of theirs. */
TL_API tl_status tl_write_terrain_tiles(const tl_source *source, const char *folder, const tl_tiles_options *options,
                                        tl_tiles_report *out, tl_error *error);

/* Packs a finished folder of quantized-mesh tiles into one file, MBTiles (SQLite; rows from the south, tiles gzipped as
 * they are, layer.json as the metadata "json"). The folder stays. Equal folders give equal files. TL_ERROR_ARGUMENT
 * where the library was built without SQLite. */
TL_API tl_status tl_pack_mbtiles(const char *folder, const char *path, bool overwrite, tl_error *error);

/* ---- Tiles of heights ------------------------------------------------------------------------------ */

typedef enum tl_grid_tiles_format {
    TL_GRID_TILES_EXR = 0,
    TL_GRID_TILES_TIFF,
    TL_GRID_TILES_PNG16, /* 16 bits over one range of heights for all tiles, 0 where it is void */
    TL_GRID_TILES_R16,   /* the same without a header, the low byte first */
    TL_GRID_TILES_RAW,   /* floats, the low byte first */
} tl_grid_tiles_format;

enum { TL_GRID_TILES_LEVELS = 40 };

/* What the names of its files end with, "exr"; NULL: there is no such format, nor any behind it. */
TL_API const char *tl_grid_tiles_ending(tl_grid_tiles_format format);

typedef struct tl_grid_tiles_options {
    tl_grid_tiles_format format;
    int64_t tile; /* samples on a side, odd: neighbours share their outermost ones; 0: 257 */
    /* Level 0 is one tile, and each has twice the samples a side of the one above it, the last those of the source. */
    bool levels_given;
    int first_level, last_level;
    bool range_given; /* of 16-bit heights, in the source's unit; else it is measured, which reads the source once more
                       */
    double low, high;
    tl_compression compression; /* EXR and GeoTIFF */
    bool resume;                /* these four as in tl_tiles_options */
    unsigned shard, shards;
    bool finish;
    bool dry_run;
    const tl_run *run;
} tl_grid_tiles_options;

typedef struct tl_grid_tiles_level {
    int64_t width, height; /* samples */
    int64_t columns, rows; /* of tiles, void ones among them */
    uint64_t tiles, bytes; /* that are there */
} tl_grid_tiles_level;

typedef struct tl_grid_tiles_report {
    int level_count, first_level, last_level;
    tl_grid_tiles_level levels[TL_GRID_TILES_LEVELS];
    float low, high;            /* of all tiles; NaN: none has heights */
    uint64_t done_before;       /* runs of tiles that an earlier call had made */
    bool complete;              /* index.json is there */
    bool already;               /* it was there before; nothing was done, and nothing is counted */
    tl_tiles_forecast forecast; /* as in tl_tiles_report */
} tl_grid_tiles_report;

/* Cuts a source into square tiles of heights of all its levels: FOLDER/LEVEL/COLUMN_ROW.ENDING, columns from the west
 * and rows from the north, and FOLDER/index.json, which tells their places, range and meaning. All are whole: beyond
 * the source's rim they are void, and those that are void altogether are left out. Levels of a raster of points are its
 * every second, fourth ... sample; those of an area raster means over the larger cells. A file appears when it is
 * complete; equal options and sources give equal files, for any threads and shards. Takes some 16 bytes a sample of a
 * tile for each worker. TL_ERROR_DATA where heights are beyond the range given. */
TL_API tl_status tl_write_grid_tiles(const tl_source *source, const char *folder, const tl_grid_tiles_options *options,
                                     tl_grid_tiles_report *out, tl_error *error);

/* ---- Pictures ---------------------------------------------------------------------------------- */

typedef struct tl_preview_options {
    int width, height; /* pixels, at most 32768; 0: the source's own shape, at most 2048 on the longer side (hillshade),
                          1920 x 1080 (perspective) */
    double sun_azimuth, sun_elevation; /* degrees, clockwise from north and above the horizon (0 ... 90); both 0: 315
                                          and 45 (hillshade), 235 and 35 (perspective) */
    double exaggeration;               /* factor on heights (and on the eye's and the target's), 0 ... 1e6; 0: 1 */
    bool grey;                         /* no hypsometric colours */
    bool perspective;                  /* look from `eye` to `target` instead of straight down */
    /* CRS coordinates (or columns and negative rows where there is no CRS) and height above the datum in metres. */
    double eye[3], target[3];
    bool view_given;    /* false: a view over the whole raster from the south is chosen */
    double fov;         /* horizontal field of view in degrees, 1 ... 170; 0: 50 */
    const char *colour; /* of a perspective: as in tl_view_picture_options */
    bool overwrite;
    const tl_run *run;
} tl_preview_options;

/* Draws a source as a PNG: hillshade from above, with north at the top and as many metres a pixel both ways, or a
 * perspective, as a model with walls around it. Voids are transparent (in a perspective one sees through
 * them). If both width and height are asked for, what the raster does not fill is transparent too.
 * `beside` may name a second source, drawn to the right of the first with the same colours on the same ground (by
 * coordinates if both have the same CRS, else both cover the same); hillshade only. The finer of the two is then shown
 * with a sample a pixel, as much of the middle as fits into width x height (of both together; by default at most
 * 2048 x 1020), so that one sees what it has more than the other. */
TL_API tl_status tl_write_preview(const tl_source *source, const tl_source *beside, const char *path,
                                  const tl_preview_options *options, tl_error *error);

#ifdef __cplusplus
}
#endif

#endif
