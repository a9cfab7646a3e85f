#include "dem/tiff_file.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <errno.h>
#include <pthread.h>
#include <stdio.h>
#include <string.h>

enum {
    MAX_IDLE = 16,                   /* handles kept for the next reader */
    MAX_IDLE_SCRATCH = 16 << 20,     /* bytes of scratch that an idle one keeps */
    MIN_ALLOCATION_LIMIT = 64 << 20, /* bytes that libtiff may ask for at once, whatever the file's size */
    MAX_ALLOCATION_LIMIT = 1 << 30,
};

struct dem_tiff_file {
    dem_file *file;
    const char *path; /* the file's */
    int64_t size;
    pthread_mutex_t lock; /* guards the list of idle handles */
    dem_tiff_handle *idle;
    unsigned idle_count; /* of those that nobody keeps */
};

/* ---- libtiff's I/O and messages ---- */

static tmsize_t read_bytes(thandle_t user, void *out, tmsize_t count)
{
    dem_tiff_handle *handle = user;
    int64_t got = dem_file_read_at(handle->file->file, out, count, (int64_t)handle->position);
    if (got < 0 && !handle->trouble)
        handle->trouble = errno;
    handle->position += got > 0 ? (uint64_t)got : 0;
    return got > 0 ? got : 0;
}

static tmsize_t write_bytes(thandle_t user, void *bytes, tmsize_t count)
{
    (void)user;
    (void)bytes;
    (void)count;
    return 0;
}

static toff_t seek(thandle_t user, toff_t offset, int whence)
{
    dem_tiff_handle *handle = user;
    uint64_t base = whence == SEEK_CUR ? handle->position : whence == SEEK_END ? (uint64_t)handle->file->size : 0;
    /* off_t is signed: a position beyond it can hold nothing */
    if (base + offset > (uint64_t)INT64_MAX)
        return (toff_t)-1;
    return handle->position = base + offset;
}

static int close_nothing(thandle_t user)
{
    (void)user;
    return 0;
}

static toff_t size_of(thandle_t user)
{
    return (toff_t)((dem_tiff_handle *)user)->file->size;
}

/* libtiff reports tags that it cannot take as errors, and goes on. */
static bool is_harmless(const char *format)
{
    return strncmp(format, "Defined set_field_type", 22) == 0;
}

static int catch_error(TIFF *tiff, void *user, const char *module, const char *format, va_list arguments)
{
    (void)tiff;
    (void)module;
    dem_tiff_handle *handle = user;
    if (!handle->message[0] && !is_harmless(format))
        vsnprintf(handle->message, sizeof handle->message, format, arguments);
    return 1; /* handled: the process's own handlers, which print, are not called */
}

static int ignore_warning(TIFF *tiff, void *user, const char *module, const char *format, va_list arguments)
{
    (void)tiff;
    (void)user;
    (void)module;
    (void)format;
    (void)arguments;
    return 1;
}

void dem_tiff_forget(dem_tiff_handle *handle)
{
    handle->message[0] = 0;
}

tl_status dem_tiff_check(const dem_tiff_handle *handle, tl_error *error)
{
    return handle->trouble ? tl_fail_system(error, handle->file->path, "read", handle->trouble) : TL_OK;
}

/* libtiff begins some messages with the file's name, which ours do already. */
const char *dem_tiff_message(const dem_tiff_handle *handle, const char *otherwise)
{
    const char *path = handle->file->path, *message = handle->message;
    size_t length = strlen(path);
    if (strncmp(message, path, length) == 0 && strncmp(message + length, ": ", 2) == 0)
        message += length + 2;
    return *message ? message : otherwise;
}

/* ---- Handles ---- */

/* Tables and compressed blocks come from the file, so what libtiff may allocate is bounded by the file's size; 8 covers
 * tables of 16-bit entries, which are widened to 64 bits, with room to grow. */
static tmsize_t allocation_limit(const dem_tiff_file *file)
{
    if (file->size > MAX_ALLOCATION_LIMIT / 8)
        return (tmsize_t)tl_int64_max(MAX_ALLOCATION_LIMIT, file->size);
    return (tmsize_t)tl_int64_max(MIN_ALLOCATION_LIMIT, 8 * file->size);
}

/* r: read; O, D: load the tables of block offsets in pieces and when needed, for they may be larger than the rest;
 * m: no memory mapping, so that a file cut short by someone else is an error and no signal. */
static TIFF *open_tiff(dem_tiff_handle *handle)
{
    TIFFOpenOptions *options = TIFFOpenOptionsAlloc();
    if (!options)
        return NULL;
    TIFFOpenOptionsSetMaxSingleMemAlloc(options, allocation_limit(handle->file));
    TIFFOpenOptionsSetErrorHandlerExtR(options, catch_error, handle);
    TIFFOpenOptionsSetWarningHandlerExtR(options, ignore_warning, handle);
    TIFF *tiff = TIFFClientOpenExt(handle->file->path, "rDOm", handle, read_bytes, write_bytes, seek, close_nothing,
                                   size_of, NULL, NULL, options);
    TIFFOpenOptionsFree(options);
    return tiff;
}

static void free_handle(dem_tiff_handle *handle)
{
    TIFFClose(handle->tiff);
    free(handle->scratch);
    free(handle);
}

static tl_status open_handle(const dem_tiff_file *file, uint64_t directory, dem_tiff_handle **out, tl_error *error)
{
    dem_tiff_handle *handle = calloc(1, sizeof *handle);
    if (!handle)
        return tl_fail_memory(error, file->path);
    handle->file = file;
    handle->directory = directory;
    handle->tiff = open_tiff(handle);
    if (!handle->tiff || (directory && !TIFFSetSubDirectory(handle->tiff, directory))) {
        tl_status status = dem_tiff_check(handle, error);
        if (status == TL_OK)
            status = tl_fail(error, TL_ERROR_DATA, "%s: cannot read the TIFF directory (is the file complete?): %s",
                             file->path, dem_tiff_message(handle, "no reason given"));
        if (handle->tiff)
            free_handle(handle);
        else
            free(handle);
        return status;
    }
    dem_tiff_forget(handle);
    *out = handle;
    return TL_OK;
}

void dem_tiff_drop(dem_tiff_file *file, dem_tiff_handle *handle)
{
    free_handle(handle);
    dem_file_release(file->file);
}

void *dem_tiff_scratch(dem_tiff_handle *handle, size_t bytes)
{
    if (bytes <= handle->scratch_bytes)
        return handle->scratch;
    free(handle->scratch);
    handle->scratch = malloc(bytes);
    handle->scratch_bytes = handle->scratch ? bytes : 0;
    return handle->scratch;
}

/* Takes an idle handle out of the list: one that `owner` keeps, or one at `directory` that nobody does. */
static dem_tiff_handle *take_idle(dem_tiff_file *file, uint64_t directory, const void *owner)
{
    pthread_mutex_lock(&file->lock);
    dem_tiff_handle **link = &file->idle;
    while (*link && ((*link)->owner != owner || (!owner && (*link)->directory != directory)))
        link = &(*link)->next;
    dem_tiff_handle *handle = *link;
    if (handle) {
        *link = handle->next;
        file->idle_count -= !owner;
    }
    pthread_mutex_unlock(&file->lock);
    if (handle)
        dem_tiff_forget(handle);
    return handle;
}

tl_status dem_tiff_take(dem_tiff_file *file, uint64_t directory, dem_tiff_handle **out, tl_error *error)
{
    tl_status status = dem_file_acquire(file->file, error);
    if (status != TL_OK)
        return status;
    *out = take_idle(file, directory, NULL);
    if (!*out)
        status = open_handle(file, directory, out, error);
    if (status != TL_OK)
        dem_file_release(file->file);
    return status;
}

tl_status dem_tiff_take_kept(dem_tiff_file *file, const void *owner, dem_tiff_handle **out, tl_error *error)
{
    tl_status status = dem_file_acquire(file->file, error);
    if (status != TL_OK)
        return status;
    *out = take_idle(file, 0, owner);
    if (!*out)
        dem_file_release(file->file);
    return TL_OK;
}

/* False where there are enough idle ones already. */
static bool put_idle(dem_tiff_file *file, dem_tiff_handle *handle)
{
    pthread_mutex_lock(&file->lock);
    bool keep = handle->owner || file->idle_count < MAX_IDLE;
    if (keep) {
        handle->next = file->idle;
        file->idle = handle;
        file->idle_count += !handle->owner;
    }
    pthread_mutex_unlock(&file->lock);
    return keep;
}

void dem_tiff_give_back(dem_tiff_file *file, dem_tiff_handle *handle)
{
    if (handle->scratch_bytes > MAX_IDLE_SCRATCH) {
        free(handle->scratch);
        handle->scratch = NULL;
        handle->scratch_bytes = 0;
    }
    if (!put_idle(file, handle))
        free_handle(handle);
    dem_file_release(file->file);
}

void dem_tiff_keep(dem_tiff_file *file, dem_tiff_handle *handle, const void *owner)
{
    handle->owner = owner;
    dem_tiff_give_back(file, handle);
}

/* What the pool does when it closes the file: handles hold memory too. */
static void drop_idle(void *user)
{
    dem_tiff_file *file = user;
    pthread_mutex_lock(&file->lock);
    for (dem_tiff_handle *handle = file->idle, *next; handle; handle = next) {
        next = handle->next;
        free_handle(handle);
    }
    file->idle = NULL;
    file->idle_count = 0;
    pthread_mutex_unlock(&file->lock);
}

/* ---- The file ---- */

bool dem_is_tiff(const unsigned char head[4])
{
    static const unsigned char signatures[4][4] = {
        {'I', 'I', 42, 0}, {'M', 'M', 0, 42}, {'I', 'I', 43, 0}, {'M', 'M', 0, 43}};
    for (size_t i = 0; i < sizeof signatures / sizeof *signatures; i++)
        if (memcmp(head, signatures[i], sizeof signatures[i]) == 0)
            return true;
    return false;
}

dem_tiff_file *dem_tiff_file_create(dem_file *base, tl_error *error)
{
    dem_tiff_file *file = calloc(1, sizeof *file);
    if (!file) {
        tl_fail_memory(error, dem_file_path(base));
        return NULL;
    }
    file->file = base;
    file->path = dem_file_path(base);
    file->size = dem_file_size(base);
    pthread_mutex_init(&file->lock, NULL);
    dem_file_when_closed(base, drop_idle, file);
    return file;
}

void dem_tiff_file_destroy(dem_tiff_file *file)
{
    if (!file)
        return;
    dem_file_when_closed(file->file, NULL, NULL);
    drop_idle(file);
    pthread_mutex_destroy(&file->lock);
    free(file);
}

const char *dem_tiff_file_path(const dem_tiff_file *file)
{
    return file->path;
}

int64_t dem_tiff_file_size(const dem_tiff_file *file)
{
    return file->size;
}

/* ---- Tags ---- */

/* libtiff counts in 16 or 32 bits depending on who registered the tag: itself for an unknown one, or libgeotiff, where
 * another part of the process has used it. */
const void *dem_tiff_array(TIFF *tiff, uint32_t tag, TIFFDataType type, size_t *count)
{
    const TIFFField *field = TIFFFindField(tiff, tag, TIFF_ANY);
    const void *values = NULL;
    *count = 0;
    if (!field || TIFFFieldDataType(field) != type)
        return NULL;
    if (!TIFFFieldPassCount(field)) {
        if (type != TIFF_ASCII || !TIFFGetField(tiff, tag, &values) || !values)
            return NULL;
        *count = strlen(values);
        return values;
    }
    if (TIFFFieldReadCount(field) == TIFF_VARIABLE2) {
        uint32_t items = 0;
        if (!TIFFGetField(tiff, tag, &items, &values))
            return NULL;
        *count = items;
    } else {
        uint16_t items = 0;
        if (!TIFFGetField(tiff, tag, &items, &values))
            return NULL;
        *count = items;
    }
    return *count ? values : NULL;
}

char *dem_tiff_text(TIFF *tiff, uint32_t tag)
{
    size_t count;
    const char *text = dem_tiff_array(tiff, tag, TIFF_ASCII, &count);
    char *copy = text ? strndup(text, count) : NULL;
    dem_tiff_handle *handle = TIFFClientdata(tiff);
    if (text && !copy && !handle->trouble)
        handle->trouble = ENOMEM;
    return copy;
}
