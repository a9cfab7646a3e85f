#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/out/tile_pyramid.h"

#include <libdeflate.h>

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum {
    ROW = SCENE_BLOCK_VERTICES,
    /* Vertices around what is known take heights from there, so that the step down to the height outside is beyond what
     * is known, on every lattice. More are read around a block, so that this comes out alike in all blocks. */
    GROWTH = 4,
    WIDE = ROW + 2 * GROWTH,
};

struct out_block_worker {
    scene_block block;
    scene_tile_mesh mesh;
    void *encoder;        /* the scheme's */
    float *wide;          /* WIDE^2 heights, NaN where none is known; at first */
    unsigned char *known; /* of the block's vertices: whether they have a height of the source */
};

/* ---- Bounds ---- */

static void find_limits(const out_pyramid *p, int level, double limits[SCENE_TILE_SIZES])
{
    double bound = out_pyramid_bound(p, level);
    for (int size = 0; size < SCENE_TILE_SIZES; size++)
        limits[size] = bound - p->scheme->sag(p, p->level, size);
}

/* ---- Heights of a block ---- */

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

/* Where the known heights of a row lie, first > last: nowhere; and which of them have none unknown between them. */
typedef struct reach {
    int first, last, solid_first, solid_last;
} reach;

static reach reach_of(const float *row)
{
    reach out = {0, WIDE - 1, 0, WIDE - 1};
    while (out.first < WIDE && !isfinite(row[out.first]))
        out.first++;
    while (out.last > out.first && !isfinite(row[out.last]))
        out.last--;
    if (out.first == WIDE)
        return (reach){WIDE, -1, WIDE, -1};
    out.solid_first = out.solid_last = out.first;
    while (out.solid_last < out.last && isfinite(row[out.solid_last + 1]))
        out.solid_last++;
    return out;
}

/* The columns of row y that have something known around them, or in them. */
static reach near_row(const reach *rows, int y)
{
    reach out = rows[y];
    for (int k = y > 0 ? y - 1 : 0; k <= y + 1 && k < WIDE; k++) {
        out.first = rows[k].first < out.first ? rows[k].first : out.first;
        out.last = rows[k].last > out.last ? rows[k].last : out.last;
    }
    if (out.first <= out.last) {
        out.first -= out.first > 0;
        out.last += out.last < WIDE - 1;
    }
    return out;
}

/* Row y as it will be; false: as it is. */
static bool grow_row(const float *z, int y, const reach *near, float *out)
{
    if (near->first > near->last || (near->solid_first == near->first && near->solid_last == near->last))
        return false;
    memcpy(out, z + (size_t)y * WIDE, WIDE * sizeof *z);
    for (int x = near->first; x <= near->last; x++) {
        if (x == near->solid_first)
            x = near->solid_last;
        else if (!isfinite(out[x]))
            out[x] = mean_around(z, x, y);
    }
    return true;
}

/* One vertex outwards. `rows` has room for two rows; reaches are those of the rows, and become those of what has
 * grown. */
static void grow(float *z, float *rows, reach *reaches, reach *grown)
{
    bool waits = false; /* the row before, which is looked at until this one is done */
    for (int y = 0; y <= WIDE; y++) {
        bool changes = false;
        if (y < WIDE) {
            grown[y] = near_row(reaches, y);
            changes = grow_row(z, y, &grown[y], rows + y % 2 * WIDE);
        }
        if (waits)
            memcpy(z + (size_t)(y - 1) * WIDE, rows + (y - 1) % 2 * WIDE, WIDE * sizeof *z);
        waits = changes;
    }
    memcpy(reaches, grown, WIDE * sizeof *reaches);
}

static tl_status grow_all(float *z, tl_error *error)
{
    float *rows = tl_alloc(2 * WIDE, sizeof *rows);
    reach *reaches = tl_alloc(2 * WIDE, sizeof *reaches);
    for (int y = 0; reaches && y < WIDE; y++)
        reaches[y] = reach_of(z + (size_t)y * WIDE);
    for (int k = 0; rows && reaches && k < GROWTH; k++)
        grow(z, rows, reaches, reaches + WIDE);
    bool done = rows && reaches;
    free(rows);
    free(reaches);
    return done ? TL_OK : tl_fail_memory(error, "a block of tiles");
}

/* The last vertices of a lattice that have samples, or lie beside the last: what is beyond copies them. */
static void find_end(const out_pyramid *p, int64_t end[2])
{
    const tl_window w = p->scheme->window(p);
    const int64_t last[2] = {w.x + w.width - 1, w.y + w.height - 1};
    for (int a = 0; a < 2; a++)
        end[a] = tl_div_up(last[a], INT64_C(1) << (p->deepest - p->level));
}

static int64_t between(int64_t value, int64_t low, int64_t high)
{
    return value < low ? low : value > high ? high : value;
}

/* Beyond a lattice that ends, heights go on as they were at its rim; tiles do not show this, and errors come out as
 * they would without it. */
static void go_on_beyond(const out_pyramid *p, const out_block_place *at, out_block_worker *w)
{
    int64_t end[2], x0 = at->column * SCENE_BLOCK - SCENE_RIM - GROWTH, y0 = at->row * SCENE_BLOCK - SCENE_RIM - GROWTH;
    find_end(p, end);
    for (int64_t y = 0; y < WIDE; y++) {
        float *row = w->wide + y * WIDE;
        const float *from = w->wide + (between(y0 + y, 0, end[1]) - y0) * WIDE;
        for (int64_t x = 0; x < WIDE; x++) {
            int64_t inner = between(x0 + x, 0, end[0]) - x0;
            if (inner != x || from != row)
                row[x] = from[inner];
        }
    }
}

/* Whether all of a row's heights are known, and which. */
static bool find_known_row(const float *z, unsigned char *known)
{
    unsigned all = 1;
    for (int x = 0; x < ROW; x++) {
        known[x] = isfinite(z[x]) != 0;
        all &= known[x];
    }
    return all != 0;
}

/* Fills in what is known; *empty: nothing is in the block's core. Whether all is. */
static bool find_known(out_block_worker *w, bool *empty)
{
    bool all = true;
    *empty = true;
    for (int y = 0; y < ROW; y++) {
        unsigned char *known = w->known + (size_t)y * ROW;
        bool row = find_known_row(w->wide + (size_t)(y + GROWTH) * WIDE + GROWTH, known);
        all = all && row;
        if (*empty && y >= SCENE_RIM && y <= SCENE_RIM + SCENE_BLOCK)
            *empty = !memchr(known + SCENE_RIM, 1, SCENE_BLOCK + 1);
    }
    return all;
}

/* Takes the block out of the wide heights; where all ground is drawn, without what is not known. */
static tl_status take_heights(const out_pyramid *p, const out_block_place *at, out_block_worker *w, bool *empty,
                              tl_error *error)
{
    if (!p->scheme->covers)
        go_on_beyond(p, at, w);
    bool all = find_known(w, empty);
    tl_status status = p->scheme->covers && !all && !*empty ? grow_all(w->wide, error) : TL_OK;
    const float outside = p->scheme->covers ? (float)p->options->outside : NAN;
    for (int y = 0; y < ROW; y++) {
        const float *z = w->wide + (size_t)(y + GROWTH) * WIDE + GROWTH;
        float *out = w->block.z + (size_t)y * ROW;
        for (int x = 0; x < ROW; x++)
            out[x] = isfinite(z[x]) ? z[x] : outside;
    }
    return status;
}

static tl_status read_heights(const out_pyramid *p, const out_block_place *at, out_block_worker *w, tl_error *error)
{
    int64_t rim = SCENE_RIM + GROWTH;
    const tl_window window = {at->column * SCENE_BLOCK - rim, at->row * SCENE_BLOCK - rim, WIDE, WIDE};
    return p->scheme->read(p, window, w->wide, error);
}

/* The vertices and cells that a piece gives to a block, from vertex (x0, y0) of its wide heights on. Of the vertices
 * that two pieces have, one may not know what the other does. */
static void paste(const out_piece *piece, int64_t x0, int64_t y0, out_block_worker *w)
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

/* From the pieces of the finer lattice. A piece is as wide as the world of the lattice of the roots. */
static tl_status gather_heights(const out_pyramid *p, const out_block_place *at, out_block_worker *w, tl_error *error)
{
    int64_t across = out_blocks_across(p, p->level + 1), down = out_blocks_down(p->level + 1);
    tl_status status = TL_OK;
    for (size_t k = 0; k < (size_t)WIDE * WIDE; k++)
        w->wide[k] = NAN;
    memset(w->block.lost, 0, (size_t)SCENE_BLOCK_SIDE * SCENE_BLOCK_SIDE * sizeof *w->block.lost);
    for (int k = 0; k < 16 && status == TL_OK; k++) {
        int64_t column = 2 * at->column + k % 4 - 1, row = 2 * at->row + k / 4 - 1;
        bool found;
        out_piece piece = {.level = p->level + 1, .column = (column % across + across) % across, .row = row};
        if (p->scheme->roots == 1 && (column < 0 || column >= across)) /* this lattice does not go around */
            continue;
        const out_block_place wanted = {piece.column, row};
        if (row < 0 || row >= down || !bsearch(&wanted, p->finer, p->finer_count, sizeof wanted, out_compare_blocks))
            continue;
        status = out_piece_load(&piece, p->folder, true, &found, error);
        if (status == TL_OK && !found)
            status = tl_fail(error, TL_ERROR_DATA,
                             "%s/.talus: block %lld, %lld of level %d is gone or broken; run again "
                             "with --resume",
                             p->folder, (long long)piece.column, (long long)row, piece.level);
        if (status == TL_OK && piece.z)
            paste(&piece, column * OUT_PIECE - at->column * SCENE_BLOCK + SCENE_RIM + GROWTH,
                  row * OUT_PIECE - at->row * SCENE_BLOCK + SCENE_RIM + GROWTH, w);
        out_piece_finish(&piece);
    }
    return status;
}

/* ---- Which tiles a block has ---- */

static bool any_known(const out_block_worker *w, int x, int y, int cells)
{
    for (int row = SCENE_RIM + y; row <= SCENE_RIM + y + cells; row++)
        if (memchr(w->known + (size_t)row * ROW + SCENE_RIM + x, 1, (size_t)cells + 1))
            return true;
    return false;
}

/* Whether a tile begins before a lattice ends, where it does. */
static bool begins_inside(const out_pyramid *p, int level, int64_t column, int64_t row)
{
    const tl_window w = p->scheme->window(p);
    int64_t cells = (int64_t)OUT_TILE_CELLS << (p->deepest - level);
    return p->scheme->covers || (column * cells < w.x + w.width - 1 && row * cells < w.y + w.height - 1);
}

/* Whether tile (column, row) of a level is there; x, y: its first vertex in the block's core. */
static bool is_there(const out_pyramid *p, const out_block_worker *w, int level, int64_t column, int64_t row, int x,
                     int y)
{
    if (level == 0 && p->scheme->covers)
        return true; /* globes ask for both roots */
    if (p->level == p->deepest)
        return begins_inside(p, level, column, row) && any_known(w, x, y, OUT_TILE_CELLS << (p->deepest - level));
    for (int k = 0; k < 4; k++)
        if (out_tile_list_has(&p->list, level + 1, 2 * column + k % 2, 2 * row + k / 2))
            return true;
    return false;
}

/* ---- Tiles ---- */

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

static tl_status write_tile(const out_pyramid *p, const out_piece_tile *tile, const void *bytes, tl_error *error)
{
    char name[96];
    if (p->rehearses)
        return TL_OK;
    p->scheme->name(tile, name, sizeof name);
    char *path = out_inside(p->folder, name);
    if (!path)
        return tl_fail_memory(error, p->folder);
    /* one that is there from a run that was killed stays as it is */
    bool there = is_whole(path, tile);
    free(path);
    return there ? TL_OK : out_write_inside(p->folder, name, bytes, (size_t)tile->bytes, true, error);
}

/* Draws, encodes and writes the tile whose first vertex is (x, y) of the block's core. */
static tl_status make_tile(const out_pyramid *p, out_block_worker *w, const double *limits, const out_tile_list *below,
                           int x, int y, out_piece_tile *tile, tl_error *error)
{
    int cells = OUT_TILE_CELLS << (p->level - tile->level);
    const void *bytes = NULL;
    scene_tile_draw(&w->block, SCENE_RIM + x, SCENE_RIM + y, cells, limits, &w->mesh);
    /* what the limits let pass, with the sag of the largest triangles, is below the bound */
    double left_out =
        fmin(w->mesh.error + p->scheme->sag(p, p->level, SCENE_TILE_SIZES - 1), out_pyramid_bound(p, tile->level));
    tile->error = fmax(left_out, w->mesh.lost + p->scheme->sag(p, p->level, 0));
    const out_drawn_tile drawn = {.block = &w->block,
                                  .mesh = &w->mesh,
                                  .x = SCENE_RIM + x,
                                  .y = SCENE_RIM + y,
                                  .known = w->known,
                                  .below = below};
    tl_status status = p->scheme->encode(p, w->encoder, &drawn, tile, &bytes, error);
    if (status != TL_OK || !tile->bytes)
        return status;
    tile->checksum = libdeflate_crc32(0, bytes, (size_t)tile->bytes);
    tile->triangles = w->mesh.triangle_count;
    tile->vertices = w->mesh.vertex_count;
    return write_tile(p, tile, bytes, error);
}

/* The places of the tiles of one level in a block; false: out of memory. */
static tl_status list_tiles(const out_pyramid *p, const out_block_worker *w, const out_block_place *at, int level,
                            out_piece *piece, out_tile_list *below, tl_error *error)
{
    int cells = OUT_TILE_CELLS << (p->level - level), across = SCENE_BLOCK / cells;
    tl_status status = TL_OK;
    for (int k = 0; k < across * across && status == TL_OK; k++) {
        int64_t column = at->column * across + k % across, row = at->row * across + k / across;
        if (column >= (int64_t)p->scheme->roots << level || row >= INT64_C(1) << level ||
            !is_there(p, w, level, column, row, k % across * cells, k / across * cells))
            continue;
        piece->tiles[piece->tile_count++] = (out_piece_tile){.level = level, .column = column, .row = row};
        if (below)
            status = out_tile_list_add(below, level, column, row, error);
    }
    return status;
}

static tl_status make_tiles(const out_pyramid *p, out_block_worker *w, const out_block_place *at, out_piece *piece,
                            tl_error *error)
{
    bool deepest = p->level == p->deepest;
    int first = p->level - 2 > 0 ? p->level - 2 : 0, last = deepest ? p->level : p->level - 2;
    enum { MOST = 16 * 16 + 8 * 8 + 4 * 4 };
    out_tile_list below = {0};
    tl_status status = TL_OK;
    piece->tiles = calloc(MOST, sizeof *piece->tiles);
    if (!piece->tiles)
        return tl_fail_memory(error, p->folder);
    for (int level = last; level >= first && status == TL_OK; level--)
        status = list_tiles(p, w, at, level, piece, deepest ? &below : NULL, error);
    out_tile_list_sort(&below);
    for (size_t k = 0; k < piece->tile_count && status == TL_OK; k++) {
        out_piece_tile *tile = &piece->tiles[k];
        int cells = OUT_TILE_CELLS << (p->level - tile->level), across = SCENE_BLOCK / cells;
        double limits[SCENE_TILE_SIZES];
        find_limits(p, tile->level, limits);
        if (tile->level >= p->options->first_level)
            status =
                make_tile(p, w, limits, deepest ? &below : &p->list, (int)(tile->column - at->column * across) * cells,
                          (int)(tile->row - at->row * across) * cells, tile, error);
    }
    out_tile_list_finish(&below);
    return status;
}

/* ---- Blocks ---- */

/* Whether one of the nine vertices around this one is known. */
static bool known_around(const out_block_worker *w, size_t at)
{
    for (size_t k = 0; k < 9; k++)
        if (w->known[at + (k / 3) * ROW + k % 3 - ROW - 1])
            return true;
    return false;
}

/* The coarser cell's surface at vertex (i, j) of the 3 x 3 that it spans from `at` on; NaN where it has none. */
static double coarse_surface(const float *z, int i, int j, bool falls)
{
    const double sw = (double)z[0], se = (double)z[2], nw = (double)z[2 * ROW], ne = (double)z[2 * ROW + 2];
    const double u = 0.5 * i, v = 0.5 * j;
    if (i == 1 && j == 1) /* it takes but the diagonal's ends */
        return falls ? 0.5 * (nw + se) : 0.5 * (sw + ne);
    if (falls) /* the diagonal, to the south-east */
        return u + v <= 1 ? sw + u * (se - sw) + v * (nw - sw) : ne + (1 - u) * (nw - ne) + (1 - v) * (se - ne);
    return u >= v ? sw + u * (se - sw) + v * (ne - se) : sw + v * (nw - sw) + u * (ne - nw);
}

/* What a cell loses that is not known everywhere: of its vertices that have a height under a triangle of the coarser
 * surface, and of the finer cells. The finer triangles of its half are cut out of the coarser ones, so that nothing is
 * farther between the vertices. */
static float lost_beside_voids(const out_block_worker *w, size_t at, bool falls)
{
    const float *z = w->block.z + at;
    double worst = 0, lost = 0;
    for (int k = 0; k < 9; k++) {
        double off = fabs((double)z[k / 3 * ROW + k % 3] - coarse_surface(z, k % 3, k / 3, falls));
        worst = off > worst ? off : worst; /* false for NaN */
    }
    for (size_t k = 0; w->block.lost && k < 4; k++)
        lost = fmax(lost, (double)w->block.lost[(at / ROW + k / 2) * SCENE_BLOCK_SIDE + at % ROW + k % 2]);
    return nextafterf((float)(worst + lost), INFINITY);
}

/* Every second vertex of the core, those too that took heights from their neighbours, so that coarser lattices have the
 * same there, and what the cells between them have lost: the error of the vertex in their middle is that of the two
 * triangles of the cell. Nothing is lost where nothing is known. */
static tl_status fill_piece(const out_block_worker *w, out_piece *piece, tl_error *error)
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
            float lost = known_around(w, at + ROW + 1) ? w->block.errors[at + ROW + 1] : 0;
            piece->lost[y * OUT_PIECE + x] = isfinite(lost) ? lost : lost_beside_voids(w, at, (x ^ y) & 1);
        }
    return TL_OK;
}

out_block_worker *out_block_worker_create(const out_pyramid *p, tl_error *error)
{
    out_block_worker *w = calloc(1, sizeof *w);
    if (!w) {
        tl_fail_memory(error, "a block of tiles");
        return NULL;
    }
    w->known = malloc((size_t)ROW * ROW);
    w->wide = tl_alloc_grid(WIDE, WIDE, sizeof *w->wide);
    tl_status status = w->known && w->wide ? TL_OK : tl_fail_memory(error, "a block of tiles");
    if (status == TL_OK)
        status = scene_block_init(&w->block, p->level < p->deepest, error);
    if (status == TL_OK)
        status = scene_tile_mesh_init(&w->mesh, error);
    w->encoder = status == TL_OK ? p->scheme->begin_worker(p, error) : NULL;
    if (w->encoder)
        return w;
    out_block_worker_destroy(p, w);
    return NULL;
}

void out_block_worker_destroy(const out_pyramid *p, out_block_worker *w)
{
    if (!w)
        return;
    scene_block_finish(&w->block);
    scene_tile_mesh_finish(&w->mesh);
    if (w->encoder)
        p->scheme->finish_worker(w->encoder);
    free(w->known);
    free(w->wide);
    free(w);
}

bool out_block_is_whole(const out_pyramid *p, const out_piece *piece)
{
    bool whole = true;
    for (size_t k = 0; k < piece->tile_count && whole; k++) {
        const out_piece_tile *tile = &piece->tiles[k];
        char name[96];
        if (tile->level < p->options->first_level || !tile->bytes)
            continue;
        p->scheme->name(tile, name, sizeof name);
        char *path = out_inside(p->folder, name);
        whole = path && is_whole(path, tile);
        free(path);
    }
    return whole;
}

tl_status out_block_make(const out_pyramid *p, out_block_worker *w, const out_block_place *at, out_piece *piece,
                         tl_error *error)
{
    bool empty = false, deepest = p->level == p->deepest;
    tl_status status = deepest ? read_heights(p, at, w, error) : gather_heights(p, at, w, error);
    if (status == TL_OK)
        status = take_heights(p, at, w, &empty, error);
    empty = empty && (deepest || !p->scheme->covers); /* the roots of globes are always there */
    if (status == TL_OK && !empty)
        status = scene_block_measure(&w->block, error);
    if (status == TL_OK && !empty && deepest && p->scheme->compare)
        status = p->scheme->compare(p, at, w->block.z + SCENE_RIM * ROW + SCENE_RIM, &piece->resampling, error);
    if (status == TL_OK && !empty)
        status = make_tiles(p, w, at, piece, error);
    if (status == TL_OK && !empty && p->level > OUT_ROOT_LATTICE)
        status = fill_piece(w, piece, error);
    return status == TL_OK && !p->rehearses ? out_piece_save(piece, p->folder, error) : status;
}
