/* Pyramids of quantized-mesh tiles.
 *
 * Blocks of the deepest lattice are made first, each alone: their tiles of the deepest three levels, and a piece that
 * holds every second vertex. The blocks of the next lattice are put together from these pieces, and so on up to the
 * lattice of the root tiles; from all but the deepest, tiles of 256 cells are drawn. */
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/number.h"
#include "lib/base/output.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"
#include "lib/out/quantized_mesh.h"
#include "lib/out/tile_list.h"
#include "lib/out/tile_pieces.h"
#include "lib/scene/geodetic.h"

#include <jansson.h>
#include <libdeflate.h>

#include <dirent.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

enum {
    ROW = SCENE_BLOCK_VERTICES,
    ROOT_LATTICE = 2,
    METADATA_LEVELS = 10,
    WORKER_BYTES = 80 << 20, /* 65 MB are measured */
    /* Vertices around what is known take heights from there, so that the step down to the height outside is beyond what
     * is known, on every lattice. More are read around a block, so that this comes out alike in all blocks. */
    GROWTH = 4,
    WIDE = ROW + 2 * GROWTH,
};

static const double earth = 6378137, pi = 3.14159265358979323846;

/* What globes take a level's error for: that of 65 x 65 samples a tile along the equator, by a rule of thumb. */
static double nominal_error(int level)
{
    return earth * 2 * pi * 0.25 / (65 * 2) / ldexp(1, level);
}

typedef struct block_place {
    int64_t column, row;
} block_place;

typedef struct job {
    const tl_source *source;
    const char *folder;
    const tl_tiles_options *options;
    scene_geodetic *lattice;
    int deepest;      /* lattice, and tile level */
    double max_error; /* of the deepest level */
    uint32_t sum;     /* of some of the source's heights */
    out_tile_list list;
    tl_tiles_report report;
    /* of the lattice in work */
    int level;
    block_place *blocks;
    size_t block_count;
    block_place *finer; /* those of the lattice before */
    size_t finer_count;
    out_piece *pieces; /* of these blocks, without samples */
} job;

typedef struct worker {
    bool begun;
    scene_block block;
    scene_tile_mesh mesh;
    out_terrain_buffer buffer;
    float *wide;          /* WIDE^2 heights, NaN where none is known; at first */
    unsigned char *known; /* of the block's vertices: whether they have a height of the source */
} worker;

/* ---- Bounds ---- */

/* Flat triangles lie under the round Earth by h^2 / 8 R in the middle of a hypotenuse h; half as much again is for
 * parallels, which are no straight lines, under slopes of up to 45 degrees. */
static double sag(int lattice, int size)
{
    double cell = scene_geodetic_step(lattice) * pi / 180;
    return 1.5 * earth * cell * cell * ldexp(1, size + 1) / 8;
}

/* The bound of a level. A tile has no more than 256 cells on a side: at the top, what the Earth's curve takes of them
 * is more than small bounds allow. */
static double bound_of(const job *j, int level)
{
    double doubled = j->max_error * ldexp(1, j->deepest - level);
    int lattice = level + 2 < j->deepest ? level + 2 : j->deepest;
    int cells_log = 6 + lattice - level;
    return level == j->deepest ? doubled : fmax(doubled, 2 * sag(lattice, 2 * (cells_log > 7 ? 1 : 0) + 1));
}

static void find_limits(const job *j, int level, double limits[SCENE_TILE_SIZES])
{
    double bound = bound_of(j, level);
    for (int size = 0; size < SCENE_TILE_SIZES; size++)
        limits[size] = bound - sag(j->level, size);
}

/* ---- Heights of a block ---- */

static int64_t blocks_across(int level)
{
    return tl_int64_max(scene_geodetic_columns(level) / SCENE_BLOCK, 1);
}

static int64_t blocks_down(int level)
{
    return tl_int64_max(scene_geodetic_rows(level) / SCENE_BLOCK, 1);
}

/* The mean of the known ones around a vertex; NaN where there are none. */
static float mean_around(const float *z, int x, int y)
{
    double sum = 0;
    int count = 0;
    for (int k = 0; k < 9; k++) {
        int i = x + k % 3 - 1, j = y + k / 3 - 1;
        if (i < 0 || j < 0 || i >= WIDE || j >= WIDE || !isfinite(z[j * WIDE + i]))
            continue;
        sum += (double)z[j * WIDE + i];
        count++;
    }
    return count ? (float)(sum / count) : NAN;
}

/* One vertex outwards. `rows` has room for two rows, those as they were. */
static void grow(float *z, float *rows)
{
    float *fresh = rows, *last = rows + WIDE;
    for (int y = 0; y < WIDE; y++) {
        for (int x = 0; x < WIDE; x++)
            fresh[x] = isfinite(z[y * WIDE + x]) ? z[y * WIDE + x] : mean_around(z, x, y);
        /* the row before is not looked at any more */
        if (y)
            memcpy(z + (size_t)(y - 1) * WIDE, last, WIDE * sizeof *z);
        float *swapped = fresh;
        fresh = last;
        last = swapped;
    }
    memcpy(z + (size_t)(WIDE - 1) * WIDE, last, WIDE * sizeof *z);
}

/* Takes the block out of the wide heights, without what is not known; *empty: nothing is known in its core. */
static tl_status take_heights(const job *j, worker *w, bool *empty, tl_error *error)
{
    bool all = true;
    *empty = true;
    for (int y = 0; y < ROW; y++)
        for (int x = 0; x < ROW; x++) {
            bool known = isfinite(w->wide[(y + GROWTH) * WIDE + x + GROWTH]);
            w->known[y * ROW + x] = known;
            all = all && known;
            if (known && x >= SCENE_RIM && y >= SCENE_RIM && x <= SCENE_RIM + SCENE_BLOCK &&
                y <= SCENE_RIM + SCENE_BLOCK)
                *empty = false;
        }
    float *rows = all || *empty ? NULL : tl_alloc(2 * WIDE, sizeof *rows);
    if (!all && !*empty && !rows)
        return tl_fail_memory(error, "a block of tiles");
    for (int k = 0; rows && k < GROWTH; k++)
        grow(w->wide, rows);
    free(rows);
    for (int y = 0; y < ROW; y++)
        for (int x = 0; x < ROW; x++) {
            float z = w->wide[(y + GROWTH) * WIDE + x + GROWTH];
            w->block.z[y * ROW + x] = isfinite(z) ? z : (float)j->options->outside;
        }
    return TL_OK;
}

static tl_status read_heights(const job *j, const block_place *at, worker *w, tl_error *error)
{
    int64_t rim = SCENE_RIM + GROWTH;
    const tl_window window = {at->column * SCENE_BLOCK - rim, at->row * SCENE_BLOCK - rim, WIDE, WIDE};
    return scene_geodetic_read(j->lattice, window, w->wide, error);
}

/* The vertices and cells that a piece gives to a block, from vertex (x0, y0) of its wide heights on. Of the vertices
 * that two pieces have, one may not know what the other does. */
static void paste(const out_piece *piece, int64_t x0, int64_t y0, worker *w)
{
    for (int64_t y = tl_int64_max(0, -y0); y < tl_int64_min(OUT_PIECE_ROW, WIDE - y0); y++)
        for (int64_t x = tl_int64_max(0, -x0); x < tl_int64_min(OUT_PIECE_ROW, WIDE - x0); x++) {
            int64_t i = x0 + x - GROWTH, j = y0 + y - GROWTH;
            float z = piece->z[y * OUT_PIECE_ROW + x];
            if (isfinite(z))
                w->wide[(y0 + y) * WIDE + x0 + x] = z;
            if (x < OUT_PIECE && y < OUT_PIECE && i >= 0 && j >= 0 && i < SCENE_BLOCK_SIDE && j < SCENE_BLOCK_SIDE)
                w->block.lost[j * SCENE_BLOCK_SIDE + i] = piece->lost[y * OUT_PIECE + x];
        }
}

static int compare_blocks(const void *a, const void *b)
{
    const block_place *p = a, *q = b;
    if (p->row != q->row)
        return p->row < q->row ? -1 : 1;
    return (p->column > q->column) - (p->column < q->column);
}

/* From the pieces of the finer lattice. A piece is as wide as the world of the lattice of the roots. */
static tl_status gather_heights(const job *j, const block_place *at, worker *w, tl_error *error)
{
    int64_t across = blocks_across(j->level + 1), down = blocks_down(j->level + 1);
    tl_status status = TL_OK;
    for (size_t k = 0; k < (size_t)WIDE * WIDE; k++)
        w->wide[k] = NAN;
    memset(w->block.lost, 0, (size_t)SCENE_BLOCK_SIDE * SCENE_BLOCK_SIDE * sizeof *w->block.lost);
    for (int k = 0; k < 16 && status == TL_OK; k++) {
        int64_t column = 2 * at->column + k % 4 - 1, row = 2 * at->row + k / 4 - 1;
        bool found;
        out_piece piece = {.level = j->level + 1, .column = (column % across + across) % across, .row = row};
        const block_place wanted = {piece.column, row};
        if (row < 0 || row >= down || !bsearch(&wanted, j->finer, j->finer_count, sizeof wanted, compare_blocks))
            continue;
        status = out_piece_load(&piece, j->folder, true, &found, error);
        if (status == TL_OK && !found)
            status = tl_fail(error, TL_ERROR_DATA,
                             "%s/.talus: block %lld, %lld of level %d is gone or broken; run again "
                             "with --resume",
                             j->folder, (long long)piece.column, (long long)row, piece.level);
        if (status == TL_OK && piece.z)
            paste(&piece, column * OUT_PIECE - at->column * SCENE_BLOCK + SCENE_RIM + GROWTH,
                  row * OUT_PIECE - at->row * SCENE_BLOCK + SCENE_RIM + GROWTH, w);
        out_piece_finish(&piece);
    }
    return status;
}

/* ---- Which tiles a block has ---- */

static bool any_known(const worker *w, int x, int y, int cells)
{
    for (int row = SCENE_RIM + y; row <= SCENE_RIM + y + cells; row++)
        if (memchr(w->known + (size_t)row * ROW + SCENE_RIM + x, 1, (size_t)cells + 1))
            return true;
    return false;
}

/* Whether tile (column, row) of a level is there; x, y: its first vertex in the block's core. */
static bool is_there(const job *j, const worker *w, int level, int64_t column, int64_t row, int x, int y)
{
    if (level == 0)
        return true; /* globes ask for both roots */
    if (j->level == j->deepest)
        return any_known(w, x, y, SCENE_TILE_CELLS << (j->deepest - level));
    for (int k = 0; k < 4; k++)
        if (out_tile_list_has(&j->list, level + 1, 2 * column + k % 2, 2 * row + k / 2))
            return true;
    return false;
}

/* ---- Metadata ---- */

/* Ten levels of tiles under a tile, of a sorted list; to be freed. */
static char *describe_below(const out_tile_list *list, int level, int64_t column, int64_t row, int deepest)
{
    json_t *available = json_array(), *root = json_pack("{s:o}", "available", available);
    for (int below = 1; below <= METADATA_LEVELS && level + below <= deepest; below++) {
        const out_tile_place first = {row << below, column << below},
                             last = {((row + 1) << below) - 1, ((column + 1) << below) - 1};
        json_array_append_new(available, out_tile_list_ranges(list, level + below, first, last));
    }
    char *text = root ? json_dumps(root, JSON_COMPACT) : NULL;
    json_decref(root);
    return text;
}

/* ---- Tiles ---- */

static tl_status make_folder(const char *path, tl_error *error)
{
    return mkdir(path, 0777) == 0 || errno == EEXIST ? TL_OK : tl_fail_system(error, path, "make", errno);
}

/* Whether a file holds what was written into it. */
static bool is_whole(const char *path, const out_piece_tile *tile)
{
    size_t wanted = (size_t)tile->bytes;
    FILE *file = fopen(path, "rb");
    unsigned char *bytes = file ? malloc(wanted + 1) : NULL;
    bool whole =
        bytes && fread(bytes, 1, wanted + 1, file) == wanted && libdeflate_crc32(0, bytes, wanted) == tile->checksum;
    free(bytes);
    if (file)
        fclose(file);
    return whole;
}

static tl_status write_tile(const job *j, const out_piece_tile *tile, const out_terrain_buffer *bytes, tl_error *error)
{
    size_t room = strlen(j->folder) + 96;
    char *path = malloc(room);
    if (!path)
        return tl_fail_memory(error, j->folder);
    snprintf(path, room, "%s/%d", j->folder, tile->level);
    tl_status status = make_folder(path, error);
    snprintf(path, room, "%s/%d/%lld", j->folder, tile->level, (long long)tile->column);
    if (status == TL_OK)
        status = make_folder(path, error);
    snprintf(path, room, "%s/%d/%lld/%lld.terrain", j->folder, tile->level, (long long)tile->column,
             (long long)tile->row);
    /* one that is there from a run that was killed stays as it is */
    bool there = status == TL_OK && is_whole(path, tile);
    tl_output *output = status == TL_OK && !there ? tl_output_open(path, true, error) : NULL;
    if (status == TL_OK && !there && !output)
        status = TL_ERROR_IO;
    if (output) {
        status = tl_output_append(output, bytes->packed, bytes->packed_count, error);
        if (status == TL_OK)
            status = tl_output_commit(output, error);
        else
            tl_output_abort(output);
    }
    free(path);
    return status;
}

/* How far rounding places moves a surface up or down: half a step of 32767 over the tile, along its steepest edge. */
static double shift_of(const worker *w, int x, int y)
{
    const scene_tile_mesh *mesh = &w->mesh;
    const unsigned char *known = w->known + (SCENE_RIM + y) * ROW + SCENE_RIM + x;
    double steepest = 0; /* squared */
    for (size_t k = 0; k < 3 * mesh->triangle_count; k++) {
        const struct scene_tile_vertex *a = &mesh->vertices[mesh->indices[k]],
                                       *b = &mesh->vertices[mesh->indices[k % 3 == 2 ? k - 2 : k + 1]];
        double i = a->i - b->i, l = a->j - b->j, rise = (double)a->z - (double)b->z;
        double slope = rise * rise / (i * i + l * l);
        /* the wall around what is known is no ground */
        if (slope > steepest && known[a->j * ROW + a->i] && known[b->j * ROW + b->i])
            steepest = slope;
    }
    return sqrt(steepest) * mesh->cells / 32767;
}

/* Draws, encodes and writes the tile whose first vertex is (x, y) of the block's core. */
static tl_status make_tile(const job *j, worker *w, const double *limits, const out_tile_list *below, int x, int y,
                           out_piece_tile *tile, tl_error *error)
{
    int cells = SCENE_TILE_CELLS << (j->level - tile->level);
    double quantum = 0;
    scene_tile_draw(&w->block, SCENE_RIM + x, SCENE_RIM + y, cells, limits, &w->mesh);
    char *metadata = tile->level % METADATA_LEVELS == 0 && tile->level < j->deepest
                         ? describe_below(below, tile->level, tile->column, tile->row, j->deepest)
                         : NULL;
    const out_terrain_tile terrain = {.level = tile->level,
                                      .column = tile->column,
                                      .row = tile->row,
                                      .mesh = &w->mesh,
                                      .block = &w->block,
                                      .x = SCENE_RIM + x,
                                      .y = SCENE_RIM + y,
                                      .normals = !j->options->no_normals,
                                      .metadata = metadata};
    tl_status status = out_terrain_encode(&terrain, &w->buffer, &quantum, error);
    free(metadata);
    if (status != TL_OK)
        return status;
    tile->bytes = (int64_t)w->buffer.packed_count;
    tile->checksum = libdeflate_crc32(0, w->buffer.packed, w->buffer.packed_count);
    tile->triangles = w->mesh.triangle_count;
    tile->vertices = w->mesh.vertex_count;
    /* what the limits let pass, with the sag of the largest triangles, is below the bound */
    double left_out = fmin(w->mesh.error + sag(j->level, SCENE_TILE_SIZES - 1), bound_of(j, tile->level));
    tile->error = fmax(left_out, w->mesh.lost + sag(j->level, 0));
    tile->error += quantum / 2 + shift_of(w, x, y);
    return write_tile(j, tile, &w->buffer, error);
}

/* The places of the tiles of one level in a block; false: out of memory. */
static tl_status list_tiles(const job *j, const worker *w, const block_place *at, int level, out_piece *piece,
                            out_tile_list *below, tl_error *error)
{
    int cells = SCENE_TILE_CELLS << (j->level - level), across = SCENE_BLOCK / cells;
    tl_status status = TL_OK;
    for (int k = 0; k < across * across && status == TL_OK; k++) {
        int64_t column = at->column * across + k % across, row = at->row * across + k / across;
        if (column >= INT64_C(2) << level || row >= INT64_C(1) << level ||
            !is_there(j, w, level, column, row, k % across * cells, k / across * cells))
            continue;
        piece->tiles[piece->tile_count++] = (out_piece_tile){.level = level, .column = column, .row = row};
        if (below)
            status = out_tile_list_add(below, level, column, row, error);
    }
    return status;
}

static tl_status make_tiles(const job *j, worker *w, const block_place *at, out_piece *piece, tl_error *error)
{
    bool deepest = j->level == j->deepest;
    int first = j->level - 2 > 0 ? j->level - 2 : 0, last = deepest ? j->level : j->level - 2;
    enum { MOST = 16 * 16 + 8 * 8 + 4 * 4 };
    out_tile_list below = {0};
    tl_status status = TL_OK;
    piece->tiles = calloc(MOST, sizeof *piece->tiles);
    if (!piece->tiles)
        return tl_fail_memory(error, j->folder);
    for (int level = last; level >= first && status == TL_OK; level--)
        status = list_tiles(j, w, at, level, piece, deepest ? &below : NULL, error);
    out_tile_list_sort(&below);
    for (size_t k = 0; k < piece->tile_count && status == TL_OK; k++) {
        out_piece_tile *tile = &piece->tiles[k];
        int cells = SCENE_TILE_CELLS << (j->level - tile->level), across = SCENE_BLOCK / cells;
        double limits[SCENE_TILE_SIZES];
        find_limits(j, tile->level, limits);
        if (tile->level >= j->options->first_level)
            status =
                make_tile(j, w, limits, deepest ? &below : &j->list, (int)(tile->column - at->column * across) * cells,
                          (int)(tile->row - at->row * across) * cells, tile, error);
    }
    out_tile_list_finish(&below);
    return status;
}

/* ---- Blocks ---- */

/* Whether one of the nine vertices around this one is known. */
static bool known_around(const worker *w, size_t at)
{
    for (size_t k = 0; k < 9; k++)
        if (w->known[at + (k / 3) * ROW + k % 3 - ROW - 1])
            return true;
    return false;
}

/* Every second vertex of the core, those too that took heights from their neighbours, so that coarser lattices have the
 * same there, and what the cells between them have lost: the error of the vertex in their middle is that of the two
 * triangles of the cell. Nothing is lost where nothing is known. */
static tl_status fill_piece(const worker *w, out_piece *piece, tl_error *error)
{
    piece->z = tl_alloc_grid(OUT_PIECE_ROW, OUT_PIECE_ROW, sizeof *piece->z);
    piece->lost = tl_alloc_grid(OUT_PIECE, OUT_PIECE, sizeof *piece->lost);
    if (!piece->z || !piece->lost)
        return tl_fail_memory(error, "a block of tiles");
    for (int y = 0; y < OUT_PIECE_ROW; y++)
        for (int x = 0; x < OUT_PIECE_ROW; x++)
            piece->z[y * OUT_PIECE_ROW + x] =
                w->wide[(size_t)(SCENE_RIM + GROWTH + 2 * y) * WIDE + (size_t)(SCENE_RIM + GROWTH + 2 * x)];
    for (int y = 0; y < OUT_PIECE; y++)
        for (int x = 0; x < OUT_PIECE; x++) {
            size_t at = (size_t)(SCENE_RIM + 2 * y) * ROW + (size_t)(SCENE_RIM + 2 * x);
            piece->lost[y * OUT_PIECE + x] = known_around(w, at + ROW + 1) ? w->block.errors[at + ROW + 1] : 0;
        }
    return TL_OK;
}

static tl_status begin_worker(const job *j, worker *w, tl_error *error)
{
    bool deepest = j->level == j->deepest;
    if (w->begun)
        return TL_OK;
    w->begun = true;
    w->known = malloc((size_t)ROW * ROW);
    w->wide = tl_alloc_grid(WIDE, WIDE, sizeof *w->wide);
    if (!w->known || !w->wide)
        return tl_fail_memory(error, "a block of tiles");
    tl_status status = scene_block_init(&w->block, !deepest, error);
    if (status == TL_OK)
        status = scene_tile_mesh_init(&w->mesh, error);
    return status == TL_OK ? out_terrain_buffer_init(&w->buffer, error) : status;
}

static void finish_worker(worker *w)
{
    scene_block_finish(&w->block);
    scene_tile_mesh_finish(&w->mesh);
    out_terrain_buffer_finish(&w->buffer);
    free(w->known);
    free(w->wide);
}

typedef struct round_of_work {
    job *j;
    worker *workers;
} round_of_work;

/* Whether the files of a block are what its piece says. */
static bool tiles_are_whole(const job *j, const out_piece *piece)
{
    size_t room = strlen(j->folder) + 96;
    char *path = malloc(room);
    bool whole = path;
    for (size_t k = 0; k < piece->tile_count && whole; k++) {
        const out_piece_tile *tile = &piece->tiles[k];
        if (tile->level < j->options->first_level)
            continue;
        snprintf(path, room, "%s/%d/%lld/%lld.terrain", j->folder, tile->level, (long long)tile->column,
                 (long long)tile->row);
        whole = is_whole(path, tile);
    }
    free(path);
    return whole;
}

static tl_status make_block(const job *j, worker *w, const block_place *at, out_piece *piece, tl_error *error)
{
    bool empty = false;
    tl_status status = begin_worker(j, w, error);
    if (status == TL_OK)
        status = j->level == j->deepest ? read_heights(j, at, w, error) : gather_heights(j, at, w, error);
    if (status == TL_OK)
        status = take_heights(j, w, &empty, error);
    empty = empty && j->level == j->deepest; /* the roots are always there */
    if (status == TL_OK && !empty)
        status = scene_block_measure(&w->block, error);
    if (status == TL_OK && !empty && j->level == j->deepest)
        status = scene_geodetic_compare(j->lattice, at->column * SCENE_BLOCK, at->row * SCENE_BLOCK, SCENE_BLOCK,
                                        w->block.z + SCENE_RIM * ROW + SCENE_RIM, ROW, &piece->resampling, error);
    if (status == TL_OK && !empty)
        status = make_tiles(j, w, at, piece, error);
    if (status == TL_OK && !empty && j->level > ROOT_LATTICE)
        status = fill_piece(w, piece, error);
    return status == TL_OK ? out_piece_save(piece, j->folder, error) : status;
}

static tl_status do_block(void *context, tl_parallel *loop, uint64_t item, unsigned index, tl_error *error)
{
    (void)loop;
    const round_of_work *r = context;
    job *j = r->j;
    const block_place *at = &j->blocks[item];
    out_piece *piece = &j->pieces[item];
    bool found = false;
    *piece = (out_piece){.level = j->level, .column = at->column, .row = at->row};
    tl_status status = out_piece_load(piece, j->folder, false, &found, error);
    if (status == TL_OK && found && tiles_are_whole(j, piece)) {
        __atomic_add_fetch(&j->report.done_before, 1, __ATOMIC_RELAXED);
        return TL_OK;
    }
    out_piece_finish(piece);
    if (status == TL_OK && j->options->finish && j->level == j->deepest)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: block %lld, %lld is not done; run the shards first", j->folder,
                       (long long)at->column, (long long)at->row);
    if (status == TL_OK)
        status = make_block(j, &r->workers[index], at, piece, error);
    free(piece->z);
    free(piece->lost);
    piece->z = piece->lost = NULL;
    return status;
}

/* What the blocks of a lattice have made goes into the list and the report. */
static tl_status take_pieces(job *j, tl_error *error)
{
    tl_status status = TL_OK;
    for (size_t b = 0; b < j->block_count; b++) {
        for (size_t k = 0; k < j->pieces[b].tile_count && status == TL_OK; k++) {
            const out_piece_tile *tile = &j->pieces[b].tiles[k];
            tl_tiles_level *level = &j->report.levels[tile->level];
            status = out_tile_list_add(&j->list, tile->level, tile->column, tile->row, error);
            if (tile->level < j->options->first_level)
                continue;
            level->tiles++;
            level->triangles += tile->triangles;
            level->vertices += tile->vertices;
            level->bytes += (uint64_t)tile->bytes;
            level->error = fmax(level->error, tile->error);
        }
        j->report.resampling = fmax(j->report.resampling, j->pieces[b].resampling);
        out_piece_finish(&j->pieces[b]);
    }
    out_tile_list_sort(&j->list);
    return status;
}

/* Threads that the memory has room for. */
static tl_run run_of(const job *j)
{
    static const tl_run none;
    tl_run run = j->options->run ? *j->options->run : none;
    unsigned most = tl_parallel_workers(&run, UINT64_MAX >> 1);
    size_t room = run.memory ? run.memory / WORKER_BYTES : most;
    run.threads = room < 1 ? 1 : room < most ? (unsigned)room : most;
    return run;
}

static tl_status do_lattice(job *j, tl_error *error)
{
    const tl_run run = run_of(j);
    unsigned count = tl_parallel_workers(&run, j->block_count);
    round_of_work r = {j, calloc(count, sizeof *r.workers)};
    j->pieces = calloc(j->block_count, sizeof *j->pieces);
    tl_status status = r.workers && j->pieces ? TL_OK : tl_fail_memory(error, j->folder);
    j->report.blocks += j->block_count;
    if (status == TL_OK && j->block_count)
        status = tl_parallel_for(&run, j->block_count, j->block_count * SCENE_BLOCK * SCENE_BLOCK, do_block, &r, error);
    for (unsigned k = 0; r.workers && k < count; k++)
        finish_worker(&r.workers[k]);
    free(r.workers);
    if (status == TL_OK)
        status = take_pieces(j, error);
    for (size_t b = 0; status != TL_OK && j->pieces && b < j->block_count; b++)
        out_piece_finish(&j->pieces[b]);
    free(j->pieces);
    j->pieces = NULL;
    return status;
}

/* ---- Which blocks there are ---- */

static void sort_blocks(job *j)
{
    size_t kept = 0;
    if (j->block_count)
        qsort(j->blocks, j->block_count, sizeof *j->blocks, compare_blocks);
    for (size_t k = 0; k < j->block_count; k++)
        if (!k || compare_blocks(&j->blocks[k], &j->blocks[kept - 1]) != 0)
            j->blocks[kept++] = j->blocks[k];
    j->block_count = kept;
}

static int64_t floor_div(int64_t a, int64_t b)
{
    return a >= 0 ? a / b : -((b - 1 - a) / b);
}

/* Those that the source touches. */
static tl_status list_blocks(job *j, tl_error *error)
{
    tl_window window = scene_geodetic_window(j->lattice);
    int64_t across = blocks_across(j->deepest), down = blocks_down(j->deepest);
    int64_t x0 = floor_div(window.x, SCENE_BLOCK), x1 = floor_div(window.x + window.width - 1, SCENE_BLOCK);
    int64_t y0 = floor_div(window.y, SCENE_BLOCK), y1 = floor_div(window.y + window.height - 1, SCENE_BLOCK);
    y1 = tl_int64_min(y1, down - 1);
    x1 = tl_int64_min(x1, x0 + across - 1);
    j->blocks = tl_alloc_grid(x1 - x0 + 1, y1 - y0 + 1, sizeof *j->blocks);
    if (!j->blocks)
        return tl_fail_memory(error, j->folder);
    for (int64_t y = y0; y <= y1; y++)
        for (int64_t x = x0; x <= x1; x++)
            j->blocks[j->block_count++] = (block_place){((x % across) + across) % across, y};
    sort_blocks(j);
    return TL_OK;
}

/* Those of the shard, or the ones around them in the next coarser lattice. */
static void take_shard(job *j)
{
    size_t kept = 0;
    for (size_t k = j->options->shard; k < j->block_count; k += j->options->shards)
        j->blocks[kept++] = j->blocks[k];
    j->block_count = kept;
}

static tl_status go_up(job *j, tl_error *error)
{
    free(j->finer);
    j->finer = tl_alloc(j->block_count, sizeof *j->finer);
    j->finer_count = j->finer ? j->block_count : 0;
    if (!j->finer)
        return tl_fail_memory(error, j->folder);
    memcpy(j->finer, j->blocks, j->block_count * sizeof *j->finer);
    int64_t across = blocks_across(j->level);
    for (size_t k = 0; k < j->block_count; k++) {
        j->blocks[k].column = across > 1 ? j->blocks[k].column / 2 : 0;
        j->blocks[k].row = blocks_down(j->level) > 1 ? j->blocks[k].row / 2 : 0;
    }
    sort_blocks(j);
    j->level--;
    return TL_OK;
}

/* ---- The folder ---- */

static char *inside(const char *folder, const char *name)
{
    size_t room = strlen(folder) + strlen(name) + 2;
    char *path = malloc(room);
    if (path)
        snprintf(path, room, "%s/%s", folder, name);
    return path;
}

static tl_status write_text(const char *folder, const char *name, const char *text, bool overwrite, tl_error *error)
{
    char *path = inside(folder, name);
    tl_output *output = path ? tl_output_open(path, overwrite, error) : NULL;
    tl_status status = output ? tl_output_append(output, text, strlen(text), error)
                       : path ? TL_ERROR_IO
                              : tl_fail_memory(error, folder);
    if (output && status == TL_OK)
        status = tl_output_commit(output, error);
    else
        tl_output_abort(output);
    free(path);
    return status;
}

/* Of some rows of the heights: another model of the same shape is noticed without reading it all. */
static tl_status sum_rows(const tl_source *source, uint32_t *sum, tl_error *error)
{
    enum { ROWS = 16 };
    const tl_source_info *info = &source->info;
    float *row = tl_alloc((size_t)info->width, sizeof *row);
    tl_status status = row ? TL_OK : tl_fail_memory(error, info->name);
    *sum = 0;
    for (int64_t k = 0; k < ROWS && status == TL_OK; k++) {
        const tl_window window = {0, (2 * k + 1) * info->height / (2 * ROWS), info->width, 1};
        status = tl_source_read(source, info->level, window, row, error);
        for (int64_t x = 0; status == TL_OK && x < info->width; x++)
            row[x] = isnan(row[x]) ? NAN : row[x]; /* one kind of them */
        if (status == TL_OK)
            *sum = libdeflate_crc32(*sum, row, (size_t)info->width * sizeof *row);
    }
    free(row);
    return status;
}

/* What all who work on a folder must agree on. */
static char *describe_job(const job *j)
{
    const tl_source_info *info = &j->source->info;
    json_t *root =
        json_pack("{s:s, s:i, s:f, s:i, s:b, s:f, s:I, s:I}", "version", tl_version(), "deepest", j->deepest,
                  "max_error", j->max_error, "first_level", j->options->first_level, "normals", !j->options->no_normals,
                  "outside", j->options->outside, "width", (json_int_t)info->width, "height", (json_int_t)info->height);
    json_t *transform = json_array();
    for (int k = 0; k < 6; k++)
        json_array_append_new(transform, json_real(info->georef.transform[k]));
    json_object_set_new(root, "transform", transform);
    json_object_set_new(root, "crs", json_string(tl_crs_name(info->georef.crs)));
    json_object_set_new(root, "rows", json_integer(j->sum));
    json_t *parameters = json_object();
    for (size_t k = 0; k < info->parameter_count; k++)
        json_object_set_new(parameters, info->parameters[k].name, json_string(info->parameters[k].value));
    json_object_set_new(root, "parameters", parameters);
    char *text = json_dumps(root, JSON_INDENT(1) | JSON_REAL_PRECISION(17));
    json_decref(root);
    return text;
}

static bool holds(const char *folder, const char *name, const char *text)
{
    char *path = inside(folder, name), *found = malloc(strlen(text) + 2);
    FILE *file = path && found ? fopen(path, "rb") : NULL;
    size_t length = strlen(text);
    bool same = file && fread(found, 1, length + 1, file) == length && memcmp(found, text, length) == 0;
    if (file)
        fclose(file);
    free(found);
    free(path);
    return same;
}

/* But for what a run leaves behind that was killed when it had just begun. */
static bool is_empty(const char *folder)
{
    DIR *directory = opendir(folder);
    struct dirent *entry;
    bool empty = true;
    while (directory && empty && (entry = readdir(directory)))
        empty = strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0 ||
                strncmp(entry->d_name, ".talus", 6) == 0;
    if (directory)
        closedir(directory);
    return empty;
}

static bool exists(const char *folder, const char *name)
{
    char *path = inside(folder, name);
    bool there = path && access(path, F_OK) == 0;
    free(path);
    return there;
}

/* Makes the folder, or finds in it the same job. */
static tl_status begin_folder(const job *j, const char *text, tl_error *error)
{
    bool go_on = j->options->resume || j->options->shards || j->options->finish;
    tl_status status = make_folder(j->folder, error);
    if (status != TL_OK)
        return status;
    /* in this order: another shard begins before it writes tiles */
    bool empty = is_empty(j->folder), begun = exists(j->folder, ".talus/job.json");
    if (!begun && !empty)
        return tl_fail(error, TL_ERROR_IO, "%s: is not empty, and holds no tiles that were begun; name another folder",
                       j->folder);
    if (begun && !go_on)
        return tl_fail(error, TL_ERROR_IO,
                       "%s: holds tiles that were begun; go on with them by --resume, or name another folder",
                       j->folder);
    char *path = inside(j->folder, ".talus");
    status = path ? make_folder(path, error) : tl_fail_memory(error, j->folder);
    free(path);
    if (status == TL_OK && !begun) /* of several shards one is the first */
        write_text(j->folder, ".talus/job.json", text, false, NULL);
    if (status == TL_OK && !holds(j->folder, ".talus/job.json", text))
        return tl_fail(error, TL_ERROR_ARGUMENT,
                       "%s: was begun with another source or other options; name another folder", j->folder);
    return status;
}

/* Removes the pieces, and last what says that they belong to a job; what cannot be removed does no harm. */
static void clear_work(const job *j)
{
    char *work = inside(j->folder, ".talus");
    DIR *directory = work ? opendir(work) : NULL;
    struct dirent *entry;
    while (directory && (entry = readdir(directory))) {
        char *path = inside(work, entry->d_name);
        if (path && entry->d_name[0] != '.' && strcmp(entry->d_name, "job.json") != 0)
            unlink(path);
        free(path);
    }
    if (directory)
        closedir(directory);
    char *said = inside(j->folder, ".talus/job.json");
    if (said)
        unlink(said);
    if (work)
        rmdir(work);
    free(said);
    free(work);
}

/* ---- layer.json ---- */

static json_t *describe_levels(const job *j)
{
    json_t *available = json_array();
    for (int level = 0; level <= j->deepest; level++) {
        const out_tile_place first = {0, 0}, last = {INT64_MAX, INT64_MAX};
        json_t *ranges =
            level < j->options->first_level ? json_array() : out_tile_list_ranges(&j->list, level, first, last);
        json_array_append_new(available, ranges);
    }
    return available;
}

static json_t *describe_errors(const job *j)
{
    json_t *errors = json_array();
    for (int level = 0; level <= j->deepest; level++)
        json_array_append_new(errors, json_real(j->report.levels[level].error));
    return errors;
}

static char *describe_layer(const job *j)
{
    double bounds[4], meridian_bounds[4];
    if (tl_source_bounds(&j->source->info, bounds, NULL) != TL_OK)
        return NULL;
    memcpy(meridian_bounds, bounds, sizeof bounds);
    if (bounds[2] > 180) /* across the antimeridian: all the way around */
        meridian_bounds[0] = -180, meridian_bounds[2] = 180;
    json_t *root = json_pack("{s:s, s:s, s:s, s:s, s:s, s:[s], s:s, s:[f,f,f,f], s:i, s:i, s:i}", "tilejson", "2.1.0",
                             "format", "quantized-mesh-1.0", "version", "1.0.0", "scheme", "tms", "projection",
                             "EPSG:4326", "tiles", "{z}/{x}/{y}.terrain?v={version}", "name", "terrain", "bounds",
                             meridian_bounds[0], meridian_bounds[1], meridian_bounds[2], meridian_bounds[3], "minzoom",
                             j->options->first_level, "maxzoom", j->deepest, "metadataAvailability", METADATA_LEVELS);
    json_t *extensions = json_array();
    if (!j->options->no_normals)
        json_array_append_new(extensions, json_string("octvertexnormals"));
    json_array_append_new(extensions, json_string("metadata"));
    json_object_set_new(root, "extensions", extensions);
    if (j->options->attribution)
        json_object_set_new(root, "attribution", json_string(j->options->attribution));
    json_object_set_new(root, "available", describe_levels(j));
    json_t *record = json_pack("{s:s, s:o, s:f}", "version", tl_version(), "errors", describe_errors(j), "resampling",
                               j->report.resampling);
    for (size_t k = 0; k < j->source->info.parameter_count; k++)
        json_object_set_new(record, j->source->info.parameters[k].name,
                            json_string(j->source->info.parameters[k].value));
    char *job_text = describe_job(j);
    json_object_set_new(record, "job", job_text ? json_loads(job_text, 0, NULL) : NULL);
    free(job_text);
    json_object_set_new(root, "talus", record);
    char *text = json_dumps(root, JSON_INDENT(1) | JSON_REAL_PRECISION(17));
    json_decref(root);
    return text;
}

/* Whether a pyramid is there already, of this very job. */
static bool is_complete(const job *j, const char *text)
{
    char *path = inside(j->folder, "layer.json");
    json_t *layer = path ? json_load_file(path, 0, NULL) : NULL, *wanted = json_loads(text, 0, NULL);
    json_t *made = json_object_get(json_object_get(layer, "talus"), "job");
    bool same = made && wanted && json_equal(made, wanted);
    json_decref(wanted);
    json_decref(layer);
    free(path);
    return same;
}

static tl_status finish_folder(job *j, tl_error *error)
{
    char *text = describe_layer(j);
    tl_status status = text ? write_text(j->folder, "layer.json", text, true, error) : tl_fail_memory(error, j->folder);
    free(text);
    if (status != TL_OK)
        return status;
    clear_work(j);
    j->report.complete = true;
    return TL_OK;
}

/* ---- The whole ---- */

static tl_status check_options(const tl_tiles_options *o, const char *folder, tl_error *error)
{
    if (!(o->max_error >= 0 && o->max_error <= 1e6) || !(fabs(o->outside) <= 1e5))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: bounds are 0...1e6 m, heights outside within 100 km", folder);
    if (o->shards && (o->shard >= o->shards || o->finish))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: a shard is one of 0 ... %u, and does not finish", folder,
                       o->shards - 1);
    return TL_OK;
}

static tl_status choose_levels(job *j, tl_error *error)
{
    const tl_tiles_options *o = j->options;
    j->deepest = o->last_level_given ? o->last_level : scene_geodetic_level(&j->source->info);
    if (j->deepest < 0 || j->deepest >= TL_TILE_LEVELS || o->first_level < 0 || o->first_level > j->deepest)
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: levels must be 0 ... %d, the first not behind the last (%d)",
                       j->folder, TL_TILE_LEVELS - 1, j->deepest);
    j->max_error = o->max_error > 0 ? o->max_error : nominal_error(j->deepest) / 4;
    j->report.first_level = o->first_level;
    j->report.last_level = j->deepest;
    j->report.spacing = scene_geodetic_step(j->deepest);
    return TL_OK;
}

/* The most tiles that there can be: all that the source's box touches. */
static void foresee(job *j)
{
    tl_window w = scene_geodetic_window(j->lattice);
    j->report.blocks = j->block_count;
    for (int level = j->deepest; level >= j->options->first_level; level--) {
        int64_t cells = (int64_t)SCENE_TILE_CELLS << (j->deepest - level);
        int64_t across = floor_div(w.x + w.width - 1, cells) - floor_div(w.x, cells) + 1;
        int64_t down = floor_div(w.y + w.height - 1, cells) - floor_div(w.y, cells) + 1;
        j->report.levels[level].tiles =
            level == 0
                ? 2
                : (uint64_t)(tl_int64_min(across, INT64_C(2) << level) * tl_int64_min(down, INT64_C(1) << level));
    }
}

static tl_status work(job *j, tl_error *error)
{
    tl_status status = list_blocks(j, error);
    if (status != TL_OK || j->options->dry_run) {
        foresee(j);
        return status;
    }
    status = sum_rows(j->source, &j->sum, error);
    if (status != TL_OK)
        return status;
    char *text = describe_job(j);
    if (text && (j->options->resume || j->options->finish) && is_complete(j, text)) {
        free(text);
        clear_work(j); /* which may not have come to its end */
        j->report.complete = true;
        return TL_OK;
    }
    status = text ? begin_folder(j, text, error) : tl_fail_memory(error, j->folder);
    free(text);
    if (status == TL_OK && j->options->shards)
        take_shard(j);
    j->level = j->deepest;
    if (status == TL_OK)
        status = do_lattice(j, error);
    if (status == TL_OK && !j->options->shards && j->deepest > 0 && !j->list.levels[j->deepest].count) {
        clear_work(j);
        rmdir(j->folder);
        return tl_fail(error, TL_ERROR_DATA, "%s: no height is known in it; --nodata, --band or --voids may help",
                       j->source->info.name);
    }
    while (status == TL_OK && !j->options->shards && j->level > ROOT_LATTICE &&
           j->level - 2 > j->options->first_level) {
        status = go_up(j, error);
        if (status == TL_OK)
            status = do_lattice(j, error);
    }
    return status == TL_OK && !j->options->shards ? finish_folder(j, error) : status;
}

tl_status tl_write_terrain_tiles(const tl_source *source, const char *folder, const tl_tiles_options *options,
                                 tl_tiles_report *out, tl_error *error)
{
    static const tl_tiles_options defaults;
    job j = {.source = source, .folder = folder, .options = options ? options : &defaults};
    tl_status status = check_options(j.options, folder, error);
    if (status == TL_OK)
        status = choose_levels(&j, error);
    if (status == TL_OK) {
        j.lattice = scene_geodetic_create(source, j.deepest, error);
        status = j.lattice ? work(&j, error) : TL_ERROR_DATA;
    }
    if (status == TL_OK)
        *out = j.report;
    scene_geodetic_destroy(j.lattice);
    out_tile_list_finish(&j.list);
    free(j.blocks);
    free(j.finer);
    return status;
}
