/* What runs of tiles leave for later ones, and the indices of finished folders; the first byte chooses. Checksums are
 * made to fit, so that what is behind them is tried too. */
#include "cmd/json_info.h"
#include "fuzz.h"
#include "lib/out/tile_pieces.h"

#include <libdeflate.h>

#include <math.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>

enum { MOST_BYTES = 1 << 16, PIECE_HEAD = 8 };

static void read_piece(const uint8_t *data, size_t size)
{
    static uint8_t bytes[MOST_BYTES];
    static const uint32_t magic = 0x33504c54;
    out_piece piece = {.level = 3, .column = 2, .row = 1};
    tl_error error = {0};
    bool found;
    size = size < MOST_BYTES - PIECE_HEAD ? size : MOST_BYTES - PIECE_HEAD;
    uint32_t sum = libdeflate_crc32(0, data, size);
    memcpy(bytes, &magic, sizeof magic);
    memcpy(bytes + sizeof magic, &sum, sizeof sum);
    memcpy(bytes + PIECE_HEAD, data, size);
    fuzz_named(".talus/3_2_1.piece", bytes, size + PIECE_HEAD);
    fuzz_expect(out_piece_load(&piece, fuzz_folder(), true, &found, &error) == TL_OK);
    for (size_t k = 0; k < piece.tile_count; k++)
        fuzz_expect(piece.tiles[k].level >= 0 && piece.tiles[k].level < TL_TILE_LEVELS && piece.tiles[k].bytes >= 0);
    fuzz_expect(found || (!piece.z && !piece.tiles));
    out_piece_finish(&piece);
}

/* The program's command info of an index; what it prints goes nowhere. */
static void read_index(const char *name, const uint8_t *data, size_t size)
{
    const char *path = fuzz_named(name, data, size);
    if (!json_info_is_for(path))
        return;
    json_info_print(path, true);
    json_info_print(path, false);
}

static void read_packed(const uint8_t *data, size_t size)
{
    char path[128];
    tl_error error = {0};
    fuzz_named("layer.json", data, size);
    snprintf(path, sizeof path, "%s/tiles.mbtiles", fuzz_folder());
    if (tl_pack_mbtiles(fuzz_folder(), path, true, &error) != TL_OK)
        fuzz_error(&error);
}

static void prepare(void)
{
    static bool prepared;
    char path[128];
    if (prepared)
        return;
    snprintf(path, sizeof path, "%s/.talus", fuzz_folder());
    fuzz_expect(mkdir(path, 0700) == 0);
    stdout = fopen("/dev/null", "w");
    fuzz_expect(stdout != NULL);
    prepared = true;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    enum { SELDOM = 64 }; /* a file of SQLite takes milliseconds */
    prepare();
    if (!size)
        return 0;
    if (data[0] & 1)
        read_piece(data + 1, size - 1);
    else
        read_index("index.json", data + 1, size - 1);
    if (data[0] % SELDOM == 2)
        read_packed(data + 1, size - 1);
    return 0;
}
