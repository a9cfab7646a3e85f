/* Runs a fuzz target over files, and over the files in folders, given as arguments: for AFL++ (as `fuzz_raster @@`),
 * for compilers without libFuzzer, and as a test. */
#include "fuzz.h"

#include <dirent.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>

static bool replay_file(const char *path)
{
    FILE *file = fopen(path, "rb");
    struct stat status;
    uint8_t *data = NULL;
    size_t size = 0;
    bool good = file && fstat(fileno(file), &status) == 0;
    if (good) {
        size = (size_t)status.st_size;
        data = malloc(size ? size : 1);
        good = data && fread(data, 1, size, file) == size;
    }
    if (file)
        fclose(file);
    if (good)
        LLVMFuzzerTestOneInput(data, size);
    else
        fprintf(stderr, "%s: cannot be read\n", path);
    free(data);
    return good;
}

/* Adds the number of files run; false where one cannot be read. */
static bool replay(const char *path, unsigned *count)
{
    DIR *folder = opendir(path);
    if (!folder) {
        ++*count;
        return replay_file(path);
    }
    bool good = true;
    for (struct dirent *entry; (entry = readdir(folder));) {
        char name[4096];
        snprintf(name, sizeof name, "%s/%s", path, entry->d_name);
        if (entry->d_name[0] != '.')
            good &= replay(name, count);
    }
    closedir(folder);
    return good;
}

int main(int argc, char **argv)
{
    unsigned count = 0;
    bool good = true;
    for (int k = 1; k < argc; k++)
        good &= replay(argv[k], &count);
    printf("%u inputs\n", count);
    return good && count ? EXIT_SUCCESS : EXIT_FAILURE;
}
