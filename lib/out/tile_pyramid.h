/* How pyramids of tiles are made, whatever the tiles are: in blocks, in parts, and so that a run may end at any moment.
 *
 * Blocks of the deepest lattice are made first, each alone: their tiles of the deepest three levels, and a piece that
 * holds every second vertex. The blocks of the next lattice are put together from these pieces, and so on up to the
 * lattice of the root tiles; from all but the deepest, tiles of 256 cells are drawn. What is particular to a lattice
 * and to a kind of file is a scheme. */
#ifndef OUT_TILE_PYRAMID_H
#define OUT_TILE_PYRAMID_H

#include "lib/out/tile_list.h"
#include "lib/out/tile_pieces.h"
#include "lib/scene/tile_block.h"
#include "lib/talus.h"

#include <jansson.h>

enum {
    OUT_TILE_CELLS = 64, /* on a side of a tile, of the lattice of its own level */
    OUT_ROOT_LATTICE = 2,
};

typedef struct out_scheme out_scheme;

typedef struct out_block_place {
    int64_t column, row;
} out_block_place;

typedef struct out_pyramid {
    const out_scheme *scheme;
    void *lattice; /* the scheme's */
    const tl_source *source;
    const char *folder;
    const tl_tiles_options *options;
    int deepest;      /* lattice, and tile level */
    double max_error; /* of the deepest level, metres */
    uint32_t sum;     /* of some of the source's heights */
    out_tile_list list;
    tl_tiles_report report;
    out_piece_tile *tiles; /* all that were made, where the scheme keeps them */
    size_t tile_count, tile_room;
    /* of the lattice in work */
    int level;
    out_block_place *blocks;
    size_t block_count;
    out_block_place *finer; /* those of the lattice before */
    size_t finer_count;
    out_piece *pieces;                 /* of these blocks, without samples */
    bool rehearses;                    /* blocks are made, but nothing is written */
    struct out_block_worker **workers; /* kept from one lattice above the deepest to the next */
    unsigned worker_count;
} out_pyramid;

/* A tile that is drawn, to become a file. */
typedef struct out_drawn_tile {
    const scene_block *block;
    const scene_tile_mesh *mesh;
    int x, y;                   /* of the tile's first vertex in the block */
    const unsigned char *known; /* of all vertices of the block: whether the source has a height for it */
    const out_tile_list *below; /* the tiles of deeper levels */
} out_drawn_tile;

struct out_scheme {
    const char *index; /* the file that is written last */
    int roots;         /* tiles of level 0, beside each other; two go around the world */
    bool covers;       /* ground that the source does not know is drawn too, and all roots are there */
    bool keeps_tiles;  /* `finish` asks for them */
    /* Vertices around all samples of the deepest lattice. */
    tl_window (*window)(const out_pyramid *pyramid);
    /* Heights at vertices of the deepest lattice, row by row from the south; NaN: not known. */
    tl_status (*read)(const out_pyramid *pyramid, tl_window window, float *out, tl_error *error);
    /* How far the source's samples are from the surface over the heights of a block of the deepest lattice, metres.
     * NULL: its vertices are the samples. */
    tl_status (*compare)(const out_pyramid *pyramid, const out_block_place *at, const float *z, double *worst,
                         tl_error *error);
    /* How far triangles of a size (see tl_size_of) are from their own heights because the lattice is bent, metres. */
    double (*sag)(const out_pyramid *pyramid, int lattice, int size);
    /* What a thread needs to encode tiles; NULL: failed, told. */
    void *(*begin_worker)(const out_pyramid *pyramid, tl_error *error);
    void (*finish_worker)(void *worker);
    /* Makes the file: *bytes and tile->bytes; 0 bytes: there is no file. Adds what it moves the surface by to
     * tile->error, and fills in tile->region if it likes. */
    tl_status (*encode)(const out_pyramid *pyramid, void *worker, const out_drawn_tile *drawn, out_piece_tile *tile,
                        const void **bytes, tl_error *error);
    /* The file of a tile, in the folder. */
    void (*name)(const out_piece_tile *tile, char *out, size_t room);
    /* Writes what leads to the tiles, the index last. */
    tl_status (*finish)(const out_pyramid *pyramid, tl_error *error);
};

/* Everything: `pyramid` has its scheme, lattice, source, folder, options, levels and bound. */
tl_status out_pyramid_make(out_pyramid *pyramid, tl_error *error);
void out_pyramid_finish(out_pyramid *pyramid);

/* Of a dry run: what there will be, into the report. `pyramid` has its blocks. */
tl_status out_pyramid_forecast(out_pyramid *pyramid, tl_error *error);

/* Which of `all` places to take as sample `number` of `count`: one from each stretch, at an irregular place of it, so
 * that the columns of a grid that is counted by rows are all met. */
size_t out_sample_place(size_t number, size_t count, size_t all);
double out_seconds_of_thread(void); /* of a processor */

/* Of the run: as many threads as the memory has room for. */
tl_run out_pyramid_run(const out_pyramid *pyramid);
/* From a lattice's blocks to those around them in the next coarser one. */
tl_status out_pyramid_go_up(out_pyramid *pyramid, tl_error *error);
/* The most tiles of a level that there can be: all that the source's box touches. */
uint64_t out_pyramid_foreseen(const out_pyramid *pyramid, int level);
/* The bound that a level's tiles are drawn to, metres. */
double out_pyramid_bound(const out_pyramid *pyramid, int level);
/* Blocks of a lattice beside and above each other. */
int64_t out_blocks_across(const out_pyramid *pyramid, int level);
int64_t out_blocks_down(int level);
int out_compare_blocks(const void *a, const void *b); /* for qsort */

/* ---- One block ---- */

typedef struct out_block_worker out_block_worker;

out_block_worker *out_block_worker_create(const out_pyramid *pyramid, tl_error *error);
void out_block_worker_destroy(const out_pyramid *pyramid, out_block_worker *worker);
/* Makes the tiles and the piece of a block. */
tl_status out_block_make(const out_pyramid *pyramid, out_block_worker *worker, const out_block_place *at,
                         out_piece *piece, tl_error *error);
/* Whether the files of a block are what its piece says. */
bool out_block_is_whole(const out_pyramid *pyramid, const out_piece *piece);

/* ---- The folder ---- */

/* "FOLDER/name", to be freed; NULL when out of memory. */
char *out_inside(const char *folder, const char *name);
/* Writes a file in the folder, and the folders on the way. */
tl_status out_write_inside(const char *folder, const char *name, const void *bytes, size_t count, bool overwrite,
                           tl_error *error);
/* What all who work on a folder must agree on; to be freed. */
char *out_describe_job(const out_pyramid *pyramid);
/* Makes the folder, or finds in it the same job. */
tl_status out_begin_folder(const out_pyramid *pyramid, const char *job, tl_error *error);
/* Whether a pyramid is there already, of this very job. */
bool out_folder_is_complete(const out_pyramid *pyramid, const char *job);
/* Removes the pieces, and last what says that they belong to a job; what cannot be removed does no harm. */
void out_clear_work(const out_pyramid *pyramid);
/* Sum of some rows of the heights: another model of the same shape is noticed without reading it all. */
tl_status out_sum_rows(const tl_source *source, uint32_t *sum, tl_error *error);
/* The record that an index holds: {"version", "errors", "resampling", the source's parameters, "job"}. */
json_t *out_describe_record(const out_pyramid *pyramid);

#endif
