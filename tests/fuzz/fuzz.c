#define _GNU_SOURCE /* memfd_create */
#include "fuzz.h"

#include <fcntl.h>
#include <ftw.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

enum {
    SIDE = 24,               /* samples on a window's side */
    COARSE_SAMPLES = 1 << 14 /* of the finest level, under a window of a coarser one */
};

void fuzz_expect(bool condition)
{
    if (!condition)
        abort();
}

const char *fuzz_file(const uint8_t *data, size_t size)
{
    static int descriptor = -1;
    static char path[64];
    if (descriptor < 0) {
        descriptor = memfd_create("fuzz", MFD_CLOEXEC);
        snprintf(path, sizeof path, "/proc/self/fd/%d", descriptor);
    }
    if (descriptor < 0 || ftruncate(descriptor, 0) != 0 || pwrite(descriptor, data, size, 0) != (ssize_t)size)
        return NULL;
    return path;
}

static char folder[64];

static int remove_one(const char *path, const struct stat *status, int kind, struct FTW *where)
{
    (void)status;
    (void)kind;
    (void)where;
    return remove(path);
}

static void remove_folder(void)
{
    nftw(folder, remove_one, 8, FTW_DEPTH | FTW_PHYS);
}

const char *fuzz_folder(void)
{
    if (!*folder) {
        snprintf(folder, sizeof folder, "%s/talus-fuzz-XXXXXX", access("/dev/shm", W_OK) == 0 ? "/dev/shm" : "/tmp");
        fuzz_expect(mkdtemp(folder) != NULL);
        atexit(remove_folder);
    }
    return folder;
}

const char *fuzz_named(const char *name, const uint8_t *data, size_t size)
{
    static char path[128];
    snprintf(path, sizeof path, "%s/%s", fuzz_folder(), name);
    int descriptor = open(path, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    bool good = descriptor >= 0 && write(descriptor, data, size) == (ssize_t)size;
    if (descriptor >= 0)
        close(descriptor);
    fuzz_expect(good);
    return path;
}

const tl_source *fuzz_model(void)
{
    enum { ROW = 5 };
    static float heights[ROW * ROW];
    static tl_source *source;
    static const tl_source_info info = {
        .width = ROW,
        .height = ROW,
        .type = TL_RASTER_POINT,
        .georef = {.transform = {0, 1, 0, 0, 0, -1}, .cell_x = 1, .cell_y = 1, .height_unit = 1},
        .name = "model"};
    for (int k = 0; k < ROW * ROW && !source; k++)
        heights[k] = (float)(k * k % 37);
    source = source ? source : tl_array_source_create(heights, &info, NULL);
    fuzz_expect(source != NULL);
    return source;
}

static int64_t smaller(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

/* A sample is finite or NaN, and NaN where the validity says void. */
static void check_samples(const tl_source *source, int level, tl_window window, const float *heights)
{
    static unsigned char validity[SIDE * SIDE];
    tl_error error = {0};
    if (tl_source_validity(source, level, window, validity, &error) != TL_OK)
        return;
    for (int64_t k = 0; k < window.width * window.height; k++) {
        fuzz_expect(!isinf(heights[k]) && (validity[k] == TL_VOID) == (isnan(heights[k]) != 0));
        fuzz_expect(level != source->info.level || source->info.has_voids || !isnan(heights[k]));
    }
}

void fuzz_text(const char *text)
{
    for (const char *c = text; *c; c++)
        fuzz_expect((unsigned char)*c >= ' ' && *c != 0x7f);
}

void fuzz_error(const tl_error *error)
{
    fuzz_expect(error->status != TL_OK && error->text[0]);
    fuzz_text(error->text);
}

static void read_window(const tl_source *source, int level, tl_window window)
{
    static float heights[SIDE * SIDE];
    tl_error error = {0};
    if (tl_source_read(source, level, window, heights, &error) == TL_OK)
        check_samples(source, level, window, heights);
    else
        fuzz_error(&error);
}

static void read_coarser(const tl_source *source, int level)
{
    int64_t width, height;
    tl_error error = {0};
    if (tl_source_size(source, level, &width, &height, &error) != TL_OK)
        return;
    fuzz_expect(width >= 1 && height >= 1);
    int64_t side = smaller(SIDE, (int64_t)sqrt(COARSE_SAMPLES >> (2 * (source->info.level - level))));
    tl_window window = {0, 0, smaller(width, side), smaller(height, side)};
    read_window(source, level, window);
    window.x = width - window.width;
    window.y = height - window.height;
    read_window(source, level, window);
}

static void check_info(const tl_source_info *info)
{
    fuzz_expect(info->width >= 1 && info->height >= 1 && info->name && info->quantum >= 0);
    fuzz_expect(isfinite(info->georef.cell_x) && isfinite(info->georef.cell_y));
    fuzz_expect(info->georef.cell_x > 0 && info->georef.cell_y > 0 && info->georef.height_unit > 0);
    for (int k = 0; k < 6; k++)
        fuzz_expect(isfinite(info->georef.transform[k]));
    if (info->georef.crs)
        fuzz_expect(tl_crs_name(info->georef.crs) && tl_crs_wkt(info->georef.crs));
}

void fuzz_read(const tl_source *source)
{
    const tl_source_info *info = &source->info;
    check_info(info);
    tl_window window = {0, 0, smaller(SIDE, info->width), smaller(SIDE, info->height)};
    int64_t right = info->width - window.width, bottom = info->height - window.height;
    const int64_t corners[3][2] = {{0, 0}, {right / 2, bottom / 2}, {right, bottom}};
    for (int k = 0; k < (right || bottom ? 3 : 1); k++) {
        window.x = corners[k][0];
        window.y = corners[k][1];
        read_window(source, info->level, window);
    }
    read_coarser(source, info->level - 1);
    read_coarser(source, info->level - 3);
}
