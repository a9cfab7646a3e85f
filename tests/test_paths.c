/* What names stand for which files. */
#include "dem/paths.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cmocka.h>

static char folder[64];

static void make_file(const char *name, const char *content)
{
    char path[256];
    snprintf(path, sizeof path, "%s/%s", folder, name);
    FILE *file = fopen(path, "wb");
    assert_non_null(file);
    fputs(content, file);
    fclose(file);
}

static int make_world(void **state)
{
    (void)state;
    char sub[128];
    strcpy(folder, "/tmp/talus-paths-XXXXXX");
    if (!mkdtemp(folder))
        return -1;
    static const char *const subs[] = {"tiles", "tiles/deeper.tif", "none", "od[d"};
    for (size_t k = 0; k < sizeof subs / sizeof *subs; k++) {
        snprintf(sub, sizeof sub, "%s/%s", folder, subs[k]);
        if (mkdir(sub, 0700) != 0)
            return -1;
    }
    static const char *const names[] = {"tiles/b.tif",       "tiles/a.TIFF",
                                        "tiles/N01E001.hgt", "tiles/a.tif.aux.xml",
                                        "tiles/.x.tif",      "tiles/deeper.tif/c.tif",
                                        "one.tif",           "[one].tif",
                                        "none/readme.txt",   "od[d/x.tif"};
    for (size_t k = 0; k < sizeof names / sizeof *names; k++)
        make_file(names[k], "");
    return 0;
}

static int remove_world(void **state)
{
    (void)state;
    char command[128];
    snprintf(command, sizeof command, "rm -rf '%s'", folder);
    return system(command);
}

/* Expands names that are relative to the folder, and compares with names that are too. '@' stays in front. */
static void expect(const char *const *given, const char *const *wanted)
{
    char full[4][256];
    const char *paths[4];
    size_t count = 0;
    for (; given[count]; count++) {
        bool list = given[count][0] == '@';
        snprintf(full[count], sizeof full[count], "%s%s/%s", list ? "@" : "", folder, given[count] + list);
        paths[count] = full[count];
    }
    dem_paths found;
    tl_error error = {0};
    if (dem_paths_expand(paths, count, &found, &error) != TL_OK)
        fail_msg("%s", error.text);
    size_t k = 0;
    for (; wanted[k]; k++) {
        assert_true(k < found.count);
        assert_true(strncmp(found.names[k], folder, strlen(folder)) == 0);
        assert_string_equal(found.names[k] + strlen(folder) + 1, wanted[k]);
    }
    assert_int_equal(found.count, k);
    dem_paths_finish(&found);
}

static void expect_refusal(const char *given, tl_status status, const char *part)
{
    char path[300];
    const char *paths[1] = {path};
    bool list = given[0] == '@';
    snprintf(path, sizeof path, "%s%s/%s", list ? "@" : "", folder, given + list);
    tl_error error = {0};
    dem_paths found = {0};
    assert_int_equal(dem_paths_expand(paths, 1, &found, &error), status);
    assert_int_equal(error.status, status);
    assert_int_equal(found.count, 0);
    if (!strstr(error.text, part) || !strstr(error.text, folder) || strchr(error.text, '\n'))
        fail_msg("\"%s\" does not say: %s", error.text, part);
}

#define NAMES(...) ((const char *const[]){__VA_ARGS__, NULL})

static void aFileStandsForItself(void **state)
{
    (void)state;
    expect(NAMES("one.tif"), NAMES("one.tif"));
    expect(NAMES("absent.tif", "one.tif"), NAMES("absent.tif", "one.tif"));
    expect(NAMES("[one].tif"), NAMES("[one].tif")); /* there is a file of this very name */
}

static void aDirectoryStandsForItsRastersInOrder(void **state)
{
    (void)state;
    /* what is hidden, of another ending, or deeper, is not meant */
    expect(NAMES("tiles"), NAMES("tiles/N01E001.hgt", "tiles/a.TIFF", "tiles/b.tif"));
    expect(NAMES("one.tif", "tiles/deeper.tif/"), NAMES("one.tif", "tiles/deeper.tif/c.tif"));
    expect_refusal("none", TL_ERROR_DATA, "no .tif, .tiff or .hgt file");
}

static void aPatternStandsForMatchesInOrder(void **state)
{
    (void)state;
    expect(NAMES("tiles/*.t*"), NAMES("tiles/a.tif.aux.xml", "tiles/b.tif"));
    expect(NAMES("tiles/[ab].[tT]*", "one.tif"),
           NAMES("tiles/a.TIFF", "tiles/a.tif.aux.xml", "tiles/b.tif", "one.tif"));
    expect(NAMES("t?les/b.tif"), NAMES("tiles/b.tif"));
    expect_refusal("*.png", TL_ERROR_IO, "no file");
}

static void aListStandsForItsLines(void **state)
{
    (void)state;
    make_file("list.txt",
              "# tiles of the north\n\n  tiles/b.tif \r\none.tif\n#absent.tif\ntiles/[N]*.hgt\ntiles/deeper.tif");
    expect(NAMES("@list.txt"), NAMES("tiles/b.tif", "one.tif", "tiles/N01E001.hgt", "tiles/deeper.tif/c.tif"));
    make_file("tiles/list", "b.tif\n");
    expect(NAMES("@tiles/list", "one.tif"), NAMES("tiles/b.tif", "one.tif"));
    char text[160];
    snprintf(text, sizeof text, "%s/one.tif\n", folder); /* an absolute name */
    make_file("tiles/list", text);
    expect(NAMES("@tiles/list"), NAMES("one.tif"));
}

static void listsThatAreNoneAreRefused(void **state)
{
    (void)state;
    make_file("empty.txt", "# nothing\n\n");
    expect_refusal("@empty.txt", TL_ERROR_DATA, "names no files");
    make_file("nested.txt", "@list.txt\n");
    expect_refusal("@nested.txt", TL_ERROR_DATA, "holds no lists");
    expect_refusal("@absent.txt", TL_ERROR_IO, "cannot read");
    expect_refusal("@tiles", TL_ERROR_DATA, "not a regular file");
    char path[128];
    snprintf(path, sizeof path, "%s/binary", folder);
    FILE *file = fopen(path, "wb");
    assert_non_null(file);
    fwrite("II*\0\10\0\0\0", 1, 8, file);
    fclose(file);
    expect_refusal("@binary", TL_ERROR_DATA, "not a list");
}

static void noNameIsAnError(void **state)
{
    (void)state;
    tl_error error = {0};
    dem_paths found;
    assert_int_equal(dem_paths_expand(NULL, 0, &found, &error), TL_ERROR_ARGUMENT);
}

static void aListOfAHundredThousandNames(void **state)
{
    (void)state;
    char path[128];
    snprintf(path, sizeof path, "@%s/long.txt", folder);
    FILE *file = fopen(path + 1, "wb");
    assert_non_null(file);
    for (int k = 0; k < 100000; k++)
        fprintf(file, "tile_%d.tif\n", k);
    fclose(file);
    dem_paths found;
    tl_error error = {0};
    assert_int_equal(dem_paths_expand((const char *const[]){path}, 1, &found, &error), TL_OK);
    assert_int_equal(found.count, 100000);
    assert_non_null(strstr(found.names[99999], "/tile_99999.tif"));
    dem_paths_finish(&found);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(aFileStandsForItself),
        cmocka_unit_test(aDirectoryStandsForItsRastersInOrder),
        cmocka_unit_test(aPatternStandsForMatchesInOrder),
        cmocka_unit_test(aListStandsForItsLines),
        cmocka_unit_test(listsThatAreNoneAreRefused),
        cmocka_unit_test(noNameIsAnError),
        cmocka_unit_test(aListOfAHundredThousandNames),
    };
    return cmocka_run_group_tests(tests, make_world, remove_world);
}
