#define _GNU_SOURCE /* O_TMPFILE, linkat from /proc/self/fd */
#include "lib/base/output.h"

#include "lib/base/error.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

enum { BUFFER_BYTES = 1 << 18, MAX_NAME_TRIES = 100 };

struct tl_output {
    int descriptor;
    bool overwrite;
    bool named; /* the system has no unnamed files here: `temporary` is on disk */
    char *path, *temporary;
    uint64_t appended; /* bytes appended and flushed */
    size_t buffered;
    unsigned char *buffer;
};

/* ".talus-PID-N.part" in the path's folder: a long name has no room for additions. */
static void name_temporary(tl_output *output, unsigned attempt)
{
    const char *slash = strrchr(output->path, '/');
    int folder = slash ? (int)(slash - output->path) + 1 : 0;
    snprintf(output->temporary, strlen(output->path) + 48, "%.*s.talus-%ld-%u.part", folder, output->path,
             (long)getpid(), attempt);
}

/* A descriptor of a file that has no name yet, or -1, also where it could not be given one later. */
static int open_unnamed(const char *path)
{
    if (access("/proc/self/fd", X_OK) != 0)
        return -1;
    const char *slash = strrchr(path, '/');
    char *folder = slash ? strndup(path, (size_t)(slash - path) + 1) : strdup(".");
    if (!folder)
        return -1;
    int descriptor = open(folder, O_TMPFILE | O_RDWR | O_CLOEXEC, 0666);
    free(folder);
    return descriptor;
}

static int open_named(tl_output *output)
{
    for (unsigned attempt = 0; attempt < MAX_NAME_TRIES; attempt++) {
        name_temporary(output, attempt);
        int descriptor = open(output->temporary, O_CREAT | O_EXCL | O_RDWR | O_CLOEXEC, 0666);
        if (descriptor >= 0 || errno != EEXIST)
            return descriptor;
    }
    return -1;
}

static tl_status refuse_existing(const char *path, bool overwrite, tl_error *error)
{
    struct stat status;
    if (lstat(path, &status) != 0)
        return TL_OK;
    if (stat(path, &status) == 0 && S_ISDIR(status.st_mode))
        return tl_fail(error, TL_ERROR_IO, "%s: is a directory; name a file in it", path);
    if (!overwrite)
        return tl_fail(error, TL_ERROR_IO, "%s: exists already; name another file or give --overwrite", path);
    return TL_OK;
}

/* The file that `path` leads to when it is a link to one, which is then what is replaced; else the path. To be freed.
 */
static char *path_to_write(const char *path, bool overwrite)
{
    struct stat status;
    char *target = NULL;
    if (overwrite && lstat(path, &status) == 0 && S_ISLNK(status.st_mode))
        target = realpath(path, NULL);
    return target ? target : strdup(path);
}

/* A file that replaces another gets its permissions. */
static void keep_permissions(const tl_output *output)
{
    struct stat status;
    if (output->overwrite && stat(output->path, &status) == 0 && S_ISREG(status.st_mode) &&
        fchmod(output->descriptor, status.st_mode & 0777) != 0)
        return; /* as on file systems without permissions: those of a new file will do */
}

static void release(tl_output *output)
{
    free(output->path);
    free(output->temporary);
    free(output->buffer);
    free(output);
}

tl_output *tl_output_open(const char *path, bool overwrite, tl_error *error)
{
    size_t length = strlen(path);
    if (length == 0 || path[length - 1] == '/') {
        tl_fail(error, TL_ERROR_IO, "'%s': not the name of a file", path);
        return NULL;
    }
    if (refuse_existing(path, overwrite, error) != TL_OK)
        return NULL;
    tl_output *output = calloc(1, sizeof *output);
    if (output) {
        output->path = path_to_write(path, overwrite);
        output->temporary = output->path ? malloc(strlen(output->path) + 48) : NULL;
        output->buffer = malloc(BUFFER_BYTES);
    }
    if (!output || !output->path || !output->temporary || !output->buffer) {
        if (output)
            release(output);
        tl_fail_memory(error, path);
        return NULL;
    }
    output->overwrite = overwrite;
    output->descriptor = open_unnamed(output->path);
    if (output->descriptor < 0) {
        output->descriptor = open_named(output);
        output->named = output->descriptor >= 0;
    }
    if (output->descriptor < 0) {
        tl_fail_system(error, path, "write", errno);
        release(output);
        return NULL;
    }
    return output;
}

int tl_output_descriptor(const tl_output *output)
{
    return output->descriptor;
}

const char *tl_output_path(const tl_output *output)
{
    return output->path;
}

tl_status tl_output_write_at(tl_output *output, const void *bytes, size_t count, uint64_t offset, tl_error *error)
{
    const unsigned char *from = bytes;
    while (count) {
        ssize_t written = pwrite(output->descriptor, from, count, (off_t)offset);
        if (written < 0 && errno == EINTR)
            continue;
        if (written <= 0)
            return tl_fail_system(error, output->path, "write", written < 0 ? errno : ENOSPC);
        from += written;
        count -= (size_t)written;
        offset += (uint64_t)written;
    }
    return TL_OK;
}

tl_status tl_output_read_at(const tl_output *output, void *bytes, size_t count, uint64_t offset, tl_error *error)
{
    unsigned char *to = bytes;
    while (count) {
        ssize_t got = pread(output->descriptor, to, count, (off_t)offset);
        if (got < 0 && errno == EINTR)
            continue;
        if (got <= 0)
            return tl_fail_system(error, output->path, "read back", got < 0 ? errno : EIO);
        to += got;
        count -= (size_t)got;
        offset += (uint64_t)got;
    }
    return TL_OK;
}

tl_status tl_output_flush(tl_output *output, tl_error *error)
{
    tl_status status = tl_output_write_at(output, output->buffer, output->buffered, output->appended, error);
    output->appended += output->buffered;
    output->buffered = 0;
    return status;
}

tl_status tl_output_append(tl_output *output, const void *bytes, size_t count, tl_error *error)
{
    const unsigned char *from = bytes;
    while (count) {
        if (output->buffered == BUFFER_BYTES) {
            tl_status status = tl_output_flush(output, error);
            if (status != TL_OK)
                return status;
        }
        size_t part = BUFFER_BYTES - output->buffered;
        if (part > count)
            part = count;
        memcpy(output->buffer + output->buffered, from, part);
        output->buffered += part;
        from += part;
        count -= part;
    }
    return TL_OK;
}

/* Gives an unnamed file the name `to`; 0 or an errno value. */
static int link_unnamed(int descriptor, const char *to)
{
    char self[64];
    snprintf(self, sizeof self, "/proc/self/fd/%d", descriptor);
    return linkat(AT_FDCWD, self, AT_FDCWD, to, AT_SYMLINK_FOLLOW) == 0 ? 0 : errno;
}

/* Gives the file its name; 0 or an errno value. */
static int publish(tl_output *output)
{
    keep_permissions(output);
    if (!output->named) {
        int code = link_unnamed(output->descriptor, output->path);
        if (code != EEXIST || !output->overwrite)
            return code;
        for (unsigned attempt = 0; code == EEXIST && attempt < MAX_NAME_TRIES; attempt++) {
            name_temporary(output, attempt);
            code = link_unnamed(output->descriptor, output->temporary);
        }
        if (code != 0)
            return code;
        output->named = true;
    }
    /* link refuses an existing name, where rename would replace it */
    if (!output->overwrite && link(output->temporary, output->path) != 0)
        return errno;
    if (output->overwrite && rename(output->temporary, output->path) != 0)
        return errno;
    if (output->overwrite)
        output->named = false; /* the temporary name is gone */
    return 0;
}

tl_status tl_output_commit(tl_output *output, tl_error *error)
{
    tl_status status = tl_output_flush(output, error);
    /* network file systems tell of a failed write when a descriptor is closed, so one is, while the file has no name */
    int copy = status == TL_OK ? dup(output->descriptor) : -1;
    if (copy >= 0 && close(copy) != 0 && errno != EINTR)
        status = tl_fail_system(error, output->path, "write", errno);
    if (status == TL_OK) {
        int code = publish(output);
        if (code == EEXIST)
            status = refuse_existing(output->path, false, error);
        else if (code != 0)
            status = tl_fail_system(error, output->path, "write", code);
    }
    tl_output_abort(output);
    return status;
}

void tl_output_abort(tl_output *output)
{
    if (!output)
        return;
    if (output->named)
        unlink(output->temporary);
    close(output->descriptor);
    release(output);
}
