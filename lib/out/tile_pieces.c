#include "lib/out/tile_pieces.h"

#include "lib/base/error.h"
#include "lib/base/output.h"
#include "lib/base/size.h"

#include <libdeflate.h>

#include <errno.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum {
    HEIGHTS = OUT_PIECE_ROW * OUT_PIECE_ROW,
    CELLS = OUT_PIECE * OUT_PIECE,
    VALUES_BYTES = 4 * HEIGHTS + 2 * CELLS,
    QUICK = 1,
    MOST_TILES = 1 << 12,
    MAGIC = 0x33504c54
};

/* At the head of a file; all in the machine's own order, for a piece stays where it was made. */
typedef struct head {
    uint32_t magic, checksum;    /* of all that follows */
    uint64_t tile_count, packed; /* packed: bytes of the values; 0: none */
    double resampling;
} head;

static char *path_of(const out_piece *piece, const char *folder)
{
    size_t room = strlen(folder) + 96;
    char *path = malloc(room);
    if (path)
        snprintf(path, room, "%s/.talus/%d_%lld_%lld.piece", folder, piece->level, (long long)piece->column,
                 (long long)piece->row);
    return path;
}

static uint32_t checksum_of(const head *h, const out_piece_tile *tiles, const unsigned char *packed)
{
    const size_t skipped = offsetof(head, tile_count);
    uint32_t sum = libdeflate_crc32(0, (const unsigned char *)h + skipped, sizeof *h - skipped);
    sum = h->tile_count ? libdeflate_crc32(sum, tiles, h->tile_count * sizeof *tiles) : sum;
    return h->packed ? libdeflate_crc32(sum, packed, h->packed) : sum;
}

/* The upper half of a float's bits, rounded up: heights that are lost are never understated. */
static uint16_t round_up(float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return (uint16_t)((bits >> 16) + ((bits & 0xffff) != 0));
}

static float widen(uint16_t half)
{
    uint32_t bits = (uint32_t)half << 16;
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Bytes of a kind beside each other compress better. */
static void pack_values(const out_piece *piece, unsigned char *to)
{
    for (size_t k = 0; k < HEIGHTS; k++) {
        uint32_t bits;
        memcpy(&bits, &piece->z[k], sizeof bits);
        for (int b = 0; b < 4; b++)
            to[(size_t)b * HEIGHTS + k] = (unsigned char)(bits >> 8 * b);
    }
    to += 4 * (size_t)HEIGHTS;
    for (size_t k = 0; k < CELLS; k++) {
        uint16_t half = round_up(piece->lost[k]);
        to[k] = (unsigned char)half;
        to[CELLS + k] = (unsigned char)(half >> 8);
    }
}

static void unpack_values(const unsigned char *from, out_piece *piece)
{
    for (size_t k = 0; k < HEIGHTS; k++) {
        uint32_t bits = 0;
        for (int b = 0; b < 4; b++)
            bits |= (uint32_t)from[(size_t)b * HEIGHTS + k] << 8 * b;
        memcpy(&piece->z[k], &bits, sizeof bits);
    }
    from += 4 * (size_t)HEIGHTS;
    for (size_t k = 0; k < CELLS; k++)
        piece->lost[k] = widen((uint16_t)(from[k] | from[CELLS + k] << 8));
}

static tl_status write_all(const out_piece *piece, const char *path, const unsigned char *packed, size_t count,
                           tl_error *error)
{
    head h = {.magic = MAGIC, .tile_count = piece->tile_count, .packed = count, .resampling = piece->resampling};
    h.checksum = checksum_of(&h, piece->tiles, packed);
    tl_output *output = tl_output_open(path, true, error);
    if (!output)
        return TL_ERROR_IO;
    tl_status status = tl_output_append(output, &h, sizeof h, error);
    if (status == TL_OK)
        status = tl_output_append(output, piece->tiles, piece->tile_count * sizeof *piece->tiles, error);
    if (status == TL_OK)
        status = tl_output_append(output, packed, count, error);
    if (status == TL_OK)
        return tl_output_commit(output, error);
    tl_output_abort(output);
    return status;
}

tl_status out_piece_save(const out_piece *piece, const char *folder, tl_error *error)
{
    char *path = path_of(piece, folder);
    struct libdeflate_compressor *compressor = libdeflate_alloc_compressor(QUICK);
    size_t room = compressor ? libdeflate_deflate_compress_bound(compressor, VALUES_BYTES) : 0, count = 0;
    unsigned char *values = malloc(VALUES_BYTES), *packed = malloc(room ? room : 1);
    tl_status status = TL_OK;
    if (!path || !compressor || !values || !packed)
        status = tl_fail_memory(error, folder);
    else if (piece->z) {
        pack_values(piece, values);
        count = libdeflate_deflate_compress(compressor, values, VALUES_BYTES, packed, room);
    }
    if (status == TL_OK)
        status = write_all(piece, path, packed, count, error);
    if (compressor)
        libdeflate_free_compressor(compressor);
    free(packed);
    free(values);
    free(path);
    return status;
}

/* ---- Reading ---- */

static bool unpack(const unsigned char *packed, size_t count, out_piece *piece)
{
    struct libdeflate_decompressor *decompressor = libdeflate_alloc_decompressor();
    unsigned char *values = malloc(VALUES_BYTES);
    piece->z = tl_alloc(HEIGHTS, sizeof *piece->z);
    piece->lost = tl_alloc(CELLS, sizeof *piece->lost);
    bool good =
        decompressor && values && piece->z && piece->lost &&
        libdeflate_deflate_decompress(decompressor, packed, count, values, VALUES_BYTES, NULL) == LIBDEFLATE_SUCCESS;
    if (good)
        unpack_values(values, piece);
    if (decompressor)
        libdeflate_free_decompressor(decompressor);
    free(values);
    return good;
}

/* The values are looked at even where they are not wanted: what has rotted is found before it is built on. */
static bool read_values(FILE *file, const head *h, out_piece *piece, bool samples)
{
    unsigned char *packed = h->packed <= 2 * VALUES_BYTES ? malloc(h->packed + 1) : NULL;
    bool good = packed && fread(packed, 1, h->packed + 1, file) == h->packed &&
                checksum_of(h, piece->tiles, packed) == h->checksum;
    if (good && samples && h->packed)
        good = unpack(packed, h->packed, piece);
    free(packed);
    return good;
}

static bool read_file(FILE *file, out_piece *piece, bool samples)
{
    head h;
    if (fread(&h, sizeof h, 1, file) != 1 || h.magic != MAGIC || h.tile_count > MOST_TILES)
        return false;
    piece->tile_count = h.tile_count;
    piece->tiles = tl_alloc(h.tile_count + 1, sizeof *piece->tiles);
    if (!piece->tiles || fread(piece->tiles, sizeof *piece->tiles, h.tile_count, file) != h.tile_count)
        return false;
    for (uint64_t k = 0; k < h.tile_count; k++)
        if (piece->tiles[k].level < 0 || piece->tiles[k].level >= TL_TILE_LEVELS || piece->tiles[k].bytes < 0)
            return false;
    if (!read_values(file, &h, piece, samples))
        return false;
    piece->resampling = h.resampling;
    return true;
}

tl_status out_piece_load(out_piece *piece, const char *folder, bool samples, bool *found, tl_error *error)
{
    char *path = path_of(piece, folder);
    *found = false;
    if (!path)
        return tl_fail_memory(error, folder);
    FILE *file = fopen(path, "rb");
    tl_status status = file || errno == ENOENT ? TL_OK : tl_fail_system(error, path, "read", errno);
    if (file) {
        *found = read_file(file, piece, samples);
        fclose(file);
    }
    if (!*found)
        out_piece_finish(piece);
    free(path);
    return status;
}

void out_piece_finish(out_piece *piece)
{
    free(piece->tiles);
    free(piece->z);
    free(piece->lost);
    piece->tiles = NULL;
    piece->z = piece->lost = NULL;
    piece->tile_count = 0;
}
