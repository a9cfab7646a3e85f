/* Faults, injected into a program by LD_PRELOAD. What fails is told by the environment:
 *   FAULT_ALLOC=K      the K-th allocation, from 1, fails, and those behind it too with FAULT_LASTING=1
 *   FAULT_SCOPE=all    counts the allocations of all libraries; else only those that talus's own code asks for
 *   FAULT_CALL=K       the K-th call of the system by talus's own code fails: with EIO, or, where it makes a file,
 * EACCES FAULT_SHORT=SEED   reads and writes are shortened, and every fourth or so is interrupted (EINTR)
 *   FAULT_SPACE=BYTES  the disk is full after so many bytes
 *   FAULT_LOG=FILE     where to tell, when the process ends: the number of allocations and calls, the module that asked
 *                      for what failed, and each block of talus's own that was not freed ("leak MODULE OFFSET")
 * A call belongs to the module (program or library) that its return address lies in. The process must not be one of
 * many: children run without faults. */
#define _GNU_SOURCE
#undef _FILE_OFFSET_BITS /* else pread is another name of pread64, and both are defined here */
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <link.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

#define EXPORT __attribute__((visibility("default"), noinline))
#define CALLER ((uintptr_t)__builtin_return_address(0))
/* The next definition of a function, looked up once. */
#define REAL(name) ((__typeof__(&name))find_real(#name, &real_##name))
#define DECLARE_REAL(name) static _Atomic(void *) real_##name

/* glibc's own, which need no look-up that would allocate. */
void *__libc_malloc(size_t size);
void *__libc_calloc(size_t count, size_t size);
void *__libc_realloc(void *block, size_t size);
void *__libc_memalign(size_t alignment, size_t size);
void __libc_free(void *block);

enum { MOST_RANGES = 8, TABLE = 1 << 20 };

typedef struct range {
    uintptr_t from, to;
} range;

static range ours[MOST_RANGES];
static int range_count;
static bool all, lasting, shorten, ready;
static long fail_alloc, fail_call, seed;
static atomic_long allocations, calls, space = -1;
static int log_file = -1;

DECLARE_REAL(read);
DECLARE_REAL(pread);
DECLARE_REAL(write);
DECLARE_REAL(pwrite);
DECLARE_REAL(open);
DECLARE_REAL(rename);
DECLARE_REAL(link);
DECLARE_REAL(linkat);
DECLARE_REAL(mkdir);
DECLARE_REAL(ftruncate);
DECLARE_REAL(fsync);
DECLARE_REAL(fopen);
DECLARE_REAL(pthread_create);

static void *find_real(const char *name, _Atomic(void *) *slot)
{
    void *found = atomic_load(slot);
    if (!found)
        atomic_store(slot, found = dlsym(RTLD_NEXT, name));
    return found;
}

static bool is_ours(uintptr_t address)
{
    for (int k = 0; k < range_count; k++)
        if (address >= ours[k].from && address < ours[k].to)
            return true;
    return false;
}

/* ---- what talus's code holds ---- */

typedef struct held {
    void *block;
    uintptr_t caller;
} held;

static held *table; /* open addressing; a block that was freed leaves the place to another */
static atomic_flag table_busy = ATOMIC_FLAG_INIT;
#define FREED ((void *)1)

static size_t place_of(const void *block)
{
    return ((uintptr_t)block >> 4) * 0x9e3779b97f4a7c15u >> 44;
}

static void lock_table(void)
{
    while (atomic_flag_test_and_set(&table_busy))
        ;
}

static void hold(void *block, uintptr_t caller)
{
    if (!table || !block || !is_ours(caller))
        return;
    lock_table();
    size_t k = place_of(block);
    for (size_t tries = 0; tries < TABLE && table[k].block && table[k].block != FREED; tries++)
        k = (k + 1) % TABLE;
    table[k] = (held){block, caller};
    atomic_flag_clear(&table_busy);
}

static void drop(void *block)
{
    if (!table || !block)
        return;
    lock_table();
    size_t k = place_of(block);
    for (size_t tries = 0; tries < TABLE && table[k].block; tries++, k = (k + 1) % TABLE)
        if (table[k].block == block) {
            table[k].block = FREED;
            break;
        }
    atomic_flag_clear(&table_busy);
}

/* ---- what failed, told at once, for the process may not come to its end ---- */

static void tell_address(int log, const char *what, uintptr_t address)
{
    Dl_info info;
    char line[4200];
    bool known = dladdr((void *)address, &info) && info.dli_fname;
    int length = snprintf(line, sizeof line, "%s %s 0x%lx\n", what, known ? info.dli_fname : "?",
                          (unsigned long)(known ? address - (uintptr_t)info.dli_fbase : address));
    if (length > 0 && length < (int)sizeof line && REAL(write)(log, line, (size_t)length) != length)
        abort(); /* no test without a log */
}

static void tell(const char *what, uintptr_t address)
{
    int kept = errno;
    if (log_file >= 0)
        tell_address(log_file, what, address);
    errno = kept;
}

/* ---- allocations ---- */

static bool alloc_fails(uintptr_t caller)
{
    if (!ready || !(all || is_ours(caller)))
        return false;
    long k = atomic_fetch_add(&allocations, 1) + 1;
    if (!fail_alloc || !(lasting ? k >= fail_alloc : k == fail_alloc))
        return false;
    if (k == fail_alloc)
        tell("failed", caller);
    errno = ENOMEM;
    return true;
}

EXPORT void *malloc(size_t size)
{
    if (alloc_fails(CALLER))
        return NULL;
    void *block = __libc_malloc(size);
    hold(block, CALLER);
    return block;
}

EXPORT void *calloc(size_t count, size_t size)
{
    if (alloc_fails(CALLER))
        return NULL;
    void *block = __libc_calloc(count, size);
    hold(block, CALLER);
    return block;
}

EXPORT void *realloc(void *old, size_t size)
{
    if (alloc_fails(CALLER))
        return NULL;
    drop(old);
    void *block = __libc_realloc(old, size);
    hold(block, CALLER);
    return block;
}

EXPORT void *aligned_alloc(size_t alignment, size_t size)
{
    if (alloc_fails(CALLER))
        return NULL;
    void *block = __libc_memalign(alignment, size);
    hold(block, CALLER);
    return block;
}

EXPORT int posix_memalign(void **out, size_t alignment, size_t size)
{
    if (alloc_fails(CALLER))
        return ENOMEM;
    void *block = __libc_memalign(alignment, size);
    if (!block)
        return ENOMEM;
    hold(block, CALLER);
    *out = block;
    return 0;
}

EXPORT void free(void *block)
{
    drop(block);
    __libc_free(block);
}

static char *copy(const char *text, size_t length, uintptr_t caller)
{
    char *made = alloc_fails(caller) ? NULL : __libc_malloc(length + 1);
    if (made) {
        memcpy(made, text, length);
        made[length] = '\0';
        hold(made, caller);
    }
    return made;
}

EXPORT char *strdup(const char *text)
{
    return copy(text, strlen(text), CALLER);
}

EXPORT char *strndup(const char *text, size_t most)
{
    return copy(text, strnlen(text, most), CALLER);
}

EXPORT int pthread_create(pthread_t *thread, const pthread_attr_t *attributes, void *(*start)(void *), void *argument)
{
    if (is_ours(CALLER) && alloc_fails(CALLER))
        return EAGAIN;
    return REAL(pthread_create)(thread, attributes, start, argument);
}

/* ---- calls of the system ---- */

static bool call_fails(uintptr_t caller, int code)
{
    if (!ready || !is_ours(caller) || atomic_fetch_add(&calls, 1) + 1 != fail_call || !fail_call)
        return false;
    tell("failed", caller);
    errno = code;
    return true;
}

/* 0: interrupted; else how much of `count` is done. */
static size_t part_of(size_t count, uintptr_t caller)
{
    static atomic_ulong state;
    if (!ready || !shorten || !is_ours(caller) || !count)
        return count;
    uint64_t x = ((uint64_t)atomic_fetch_add(&state, 1) + (uint64_t)seed * 977) * 0x9e3779b97f4a7c15u;
    x ^= x >> 31;
    x *= 0xbf58476d1ce4e5b9u;
    x ^= x >> 29;
    return x % 4 == 0 ? 0 : x % 4 == 1 ? 1 + (size_t)(x >> 8) % count : count;
}

#define INTERRUPTED(count) ((count) == 0 && asked != 0 ? (errno = EINTR, true) : false)

/* Of `count` bytes, those that fit on the disk; 0 with errno set where none does. */
static size_t taken(int descriptor, size_t count)
{
    struct stat status;
    if (atomic_load(&space) < 0 || fstat(descriptor, &status) != 0 || !S_ISREG(status.st_mode) || !count)
        return count;
    long left = atomic_fetch_sub(&space, (long)count);
    size_t fit = left <= 0 ? 0 : (size_t)left < count ? (size_t)left : count;
    atomic_fetch_add(&space, (long)(count - fit)); /* so that what is left never goes below 0 */
    if (!fit)
        errno = ENOSPC;
    return fit;
}

EXPORT ssize_t read(int descriptor, void *out, size_t asked)
{
    size_t count = part_of(asked, CALLER);
    if (INTERRUPTED(count) || call_fails(CALLER, EIO))
        return -1;
    return REAL(read)(descriptor, out, count);
}

EXPORT ssize_t pread(int descriptor, void *out, size_t asked, off_t offset)
{
    size_t count = part_of(asked, CALLER);
    if (INTERRUPTED(count) || call_fails(CALLER, EIO))
        return -1;
    return REAL(pread)(descriptor, out, count, offset);
}

EXPORT ssize_t pread64(int descriptor, void *out, size_t asked, off_t offset)
{
    size_t count = part_of(asked, CALLER);
    if (INTERRUPTED(count) || call_fails(CALLER, EIO))
        return -1;
    return REAL(pread)(descriptor, out, count, offset);
}

EXPORT ssize_t write(int descriptor, const void *from, size_t asked)
{
    size_t count = part_of(asked, CALLER);
    if (INTERRUPTED(count) || call_fails(CALLER, EIO))
        return -1;
    count = taken(descriptor, count);
    return !count && asked ? -1 : REAL(write)(descriptor, from, count);
}

static ssize_t write_at(int descriptor, const void *from, size_t asked, off_t offset, uintptr_t caller)
{
    size_t count = part_of(asked, caller);
    if (INTERRUPTED(count) || call_fails(caller, EIO))
        return -1;
    count = taken(descriptor, count);
    return !count && asked ? -1 : REAL(pwrite)(descriptor, from, count, offset);
}

EXPORT ssize_t pwrite(int descriptor, const void *from, size_t asked, off_t offset)
{
    return write_at(descriptor, from, asked, offset, CALLER);
}

EXPORT ssize_t pwrite64(int descriptor, const void *from, size_t asked, off_t offset)
{
    return write_at(descriptor, from, asked, offset, CALLER);
}

static mode_t mode_of(int flags, va_list list)
{
    return flags & (O_CREAT | O_TMPFILE) ? va_arg(list, mode_t) : 0;
}

EXPORT int open(const char *path, int flags, ...)
{
    va_list list;
    va_start(list, flags);
    mode_t mode = mode_of(flags, list);
    va_end(list);
    return call_fails(CALLER, EACCES) ? -1 : REAL(open)(path, flags, mode);
}

EXPORT int open64(const char *path, int flags, ...)
{
    va_list list;
    va_start(list, flags);
    mode_t mode = mode_of(flags, list);
    va_end(list);
    return call_fails(CALLER, EACCES) ? -1 : REAL(open)(path, flags | O_LARGEFILE, mode);
}

EXPORT FILE *fopen(const char *path, const char *mode)
{
    return call_fails(CALLER, EACCES) ? NULL : REAL(fopen)(path, mode);
}

EXPORT FILE *fopen64(const char *path, const char *mode)
{
    return call_fails(CALLER, EACCES) ? NULL : REAL(fopen)(path, mode);
}

EXPORT int rename(const char *from, const char *to)
{
    return call_fails(CALLER, EIO) ? -1 : REAL(rename)(from, to);
}

EXPORT int link(const char *from, const char *to)
{
    return call_fails(CALLER, EIO) ? -1 : REAL(link)(from, to);
}

EXPORT int linkat(int from_folder, const char *from, int to_folder, const char *to, int flags)
{
    return call_fails(CALLER, EIO) ? -1 : REAL(linkat)(from_folder, from, to_folder, to, flags);
}

EXPORT int mkdir(const char *path, mode_t mode)
{
    return call_fails(CALLER, EACCES) ? -1 : REAL(mkdir)(path, mode);
}

EXPORT int ftruncate(int descriptor, off_t length)
{
    return call_fails(CALLER, EIO) ? -1 : REAL(ftruncate)(descriptor, length);
}

EXPORT int ftruncate64(int descriptor, off_t length)
{
    return call_fails(CALLER, EIO) ? -1 : REAL(ftruncate)(descriptor, length);
}

EXPORT int fsync(int descriptor)
{
    return call_fails(CALLER, EIO) ? -1 : REAL(fsync)(descriptor);
}

/* ---- beginning and end ---- */

static int note_ours(struct dl_phdr_info *info, size_t size, void *context)
{
    const char *path = info->dlpi_name;
    const char *name = strrchr(path, '/') ? strrchr(path, '/') + 1 : path;
    bool first = !*(bool *)context; /* the program itself comes first, without a name */
    *(bool *)context = true;
    (void)size;
    if (!first && strncmp(name, "libtalus", 8) != 0)
        return 0;
    for (int k = 0; k < info->dlpi_phnum && range_count < MOST_RANGES; k++)
        if (info->dlpi_phdr[k].p_type == PT_LOAD && info->dlpi_phdr[k].p_flags & PF_X) {
            uintptr_t from = info->dlpi_addr + info->dlpi_phdr[k].p_vaddr;
            ours[range_count++] = (range){from, from + info->dlpi_phdr[k].p_memsz};
        }
    return 0;
}

static long number(const char *name, long otherwise)
{
    const char *text = getenv(name);
    return text ? atol(text) : otherwise;
}

__attribute__((constructor)) static void begin(void)
{
    bool seen = false;
    dl_iterate_phdr(note_ours, &seen);
    const char *scope = getenv("FAULT_SCOPE"), *path = getenv("FAULT_LOG");
    all = scope && strcmp(scope, "all") == 0;
    lasting = number("FAULT_LASTING", 0) != 0;
    fail_alloc = number("FAULT_ALLOC", 0);
    fail_call = number("FAULT_CALL", 0);
    seed = number("FAULT_SHORT", 0);
    shorten = getenv("FAULT_SHORT") != NULL;
    atomic_store(&space, number("FAULT_SPACE", -1));
    if (path) {
        log_file = REAL(open)(path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0666);
        table = __libc_calloc(TABLE, sizeof *table);
    }
    unsetenv("LD_PRELOAD");
    ready = true;
}

__attribute__((destructor)) static void end(void)
{
    char line[96];
    ready = false;
    held *left = table;
    table = NULL;
    if (log_file < 0)
        return;
    for (size_t k = 0; left && k < TABLE; k++)
        if (left[k].block && left[k].block != FREED)
            tell("leak", left[k].caller);
    int length =
        snprintf(line, sizeof line, "allocations %ld\ncalls %ld\n", atomic_load(&allocations), atomic_load(&calls));
    if (REAL(write)(log_file, line, (size_t)length) != length)
        abort();
}
