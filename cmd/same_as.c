#include "cmd/same_as.h"

#include "cmd/record.h"

#include <popt.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

/* The parameter `name` of a file that talus wrote, to be freed; NULL, told, where there is none. */
static char *read_parameter(const char *path, const char *name)
{
    tl_error error;
    char *value = NULL;
    const tl_format *format = tl_format_of(path);
    if (format && format->mesh) {
        complain("%s: --same-as takes .exr, .tif, .png, .r16 and .raw; a mesh does not record enough", path);
        return NULL;
    }
    tl_source *source = tl_open(path, &error);
    if (!source) {
        complain("%s", error.text);
        return NULL;
    }
    for (size_t k = 0; k < source->info.parameter_count && !value; k++)
        if (strcmp(source->info.parameters[k].name, name) == 0)
            value = strdup(source->info.parameters[k].value);
    tl_source_destroy(source);
    if (!value)
        complain("%s: does not tell the command that made it; --same-as takes what synth and noise of this version "
                 "write",
                 path);
    return value;
}

static bool is_there(const char *path)
{
    return access(path, F_OK) == 0;
}

/* A file of the record: as named, or beside `same_as`; to be freed. NULL: nowhere. "RASTER:BAND" is looked for as it
 * is and without the band. */
static char *find_file(const char *name, const char *same_as)
{
    const char *slash = strrchr(same_as, '/'), *colon = strrchr(name, ':');
    size_t folder = slash ? (size_t)(slash - same_as) + 1 : 0, length = colon ? (size_t)(colon - name) : strlen(name);
    size_t room = folder + strlen(name) + 1;
    char *path = malloc(room), *bare = malloc(room);
    bool found = false;
    for (int k = 0; path && bare && k < 2 && !found; k++) {
        snprintf(path, room, "%.*s%s", k ? (int)folder : 0, same_as, name);
        snprintf(bare, room, "%.*s%.*s", k ? (int)folder : 0, same_as, (int)length, name);
        found = is_there(path) || is_there(bare);
    }
    free(bare);
    if (found)
        return path;
    free(path);
    return NULL;
}

static bool takes_a_file(const char *word)
{
    return strcmp(word, "--hurst-map") == 0 || strcmp(word, "--delta-map") == 0 || strcmp(word, "--sigma-map") == 0 ||
           strcmp(word, "--layer-rules") == 0 || strcmp(word, "--geoid") == 0;
}

/* The words of the record with their files found, one block that free() frees; those that are not found stay as they
 * are, and what opens them tells. "egm96" and "none" are no files. */
typedef struct words {
    const char **list;
    char **owned;
    int count;
} words;

static void free_words(words *w)
{
    for (int k = 0; k < w->count; k++)
        free(w->owned[k]);
    free(w->owned);
    free(w->list);
}

/* Anyone may have written the file: what says where to write, and what to replace, is the command line's alone. */
static bool is_sound(const words *w, const char *same_as)
{
    for (int k = 1; k < w->count; k++) {
        char name[64];
        const char *word = w->list[k];
        bool number = word[0] == '-' && word[1] && strchr("0123456789.", word[1]);
        if (word[0] != '-' || number)
            continue;
        snprintf(name, sizeof name, "%s", word + strspn(word, "-"));
        name[strcspn(name, "=")] = 0;
        if (strncmp(word, "--", 2) != 0 || !*name || record_leaves_out(name)) {
            complain("%s: its record has %.60s, which talus does not record; it is not taken", same_as, word);
            return false;
        }
    }
    return true;
}

static bool split(const char *record, const char *same_as, words *out)
{
    int count;
    const char **parsed;
    if (poptParseArgvString(record, &count, &parsed) != 0)
        return false;
    *out = (words){calloc((size_t)count, sizeof *out->list), calloc((size_t)count, sizeof *out->owned), count};
    bool good = out->list && out->owned;
    for (int k = 0; k < count && good; k++) {
        char *found = k && takes_a_file(parsed[k - 1]) ? find_file(parsed[k], same_as) : NULL;
        out->list[k] = out->owned[k] = found ? found : strdup(parsed[k]);
        good = out->owned[k];
    }
    if (!good)
        out->count = 0;
    free(parsed);
    return good;
}

/* The recorded inputs, the last `inputs` words, where they lie now. */
static bool find_inputs(const char *same_as, size_t inputs, words *recorded)
{
    for (size_t k = (size_t)recorded->count - inputs; k < (size_t)recorded->count; k++) {
        char *found = find_file(recorded->list[k], same_as);
        if (!found && !strpbrk(recorded->list[k], "*?[@")) {
            complain("%s: was made of %s, which is not here and not beside it; name the input too", same_as,
                     recorded->list[k]);
            return false;
        }
        if (!found)
            continue;
        free(recorded->owned[k]);
        recorded->list[k] = recorded->owned[k] = found;
    }
    return true;
}

/* Parses the record's options and the command line's own behind them, with the record's inputs if it has none. */
static bool parse_all(const command *self, const char *same_as, words *recorded, int argc, const char **argv,
                      const option_group *groups, arguments *rest)
{
    const char **all = calloc((size_t)recorded->count + (size_t)argc + 1, sizeof *all);
    size_t own = rest->count;
    int count = 0;
    options_undo(groups, rest);
    arguments_free(rest);
    bool good = all && options_parse(self->name, recorded->count, recorded->list, groups, rest) == PARSE_OK &&
                (own || find_inputs(same_as, rest->count, recorded));
    int taken = recorded->count - (good && own ? (int)rest->count : 0);
    options_undo(groups, rest);
    arguments_free(rest);
    for (int k = 0; k < taken && good; k++)
        all[count++] = recorded->list[k];
    for (int k = 1; k < argc && good; k++)
        all[count++] = argv[k];
    good = good && options_parse(self->name, count, all, groups, rest) == PARSE_OK;
    free(all);
    return good;
}

bool same_as_parse(const command *self, const char *same_as, int argc, const char **argv, const option_group *groups,
                   arguments *rest)
{
    words recorded = {0};
    char *path = strdup(same_as); /* parsing again frees the text */
    char *record = path ? read_parameter(path, "command") : NULL;
    bool good = record && split(record, path, &recorded) && is_sound(&recorded, path);
    if (good && strcmp(recorded.list[0], self->name) != 0) {
        complain("%s: was made by talus %s, not by talus %s", path, recorded.list[0], self->name);
        good = false;
    }
    good = good && parse_all(self, path, &recorded, argc, argv, groups, rest);
    free_words(&recorded);
    free(record);
    free(path);
    return good;
}

bool same_as_is_output(const char *same_as, const common *shared)
{
    struct stat a, b;
    bool same = same_as && shared->output && stat(same_as, &a) == 0 && stat(shared->output, &b) == 0 &&
                a.st_dev == b.st_dev && a.st_ino == b.st_ino;
    if (same)
        complain("%s: is the file to be made again; name another output", shared->output);
    return same;
}

/* ---- Comparing ---- */

/* Whether two files have the same bytes; false too where one cannot be read. */
static bool equal_files(const char *a, const char *b)
{
    enum { CHUNK = 65536 };
    FILE *files[2] = {fopen(a, "rb"), fopen(b, "rb")};
    char *bytes[2] = {malloc(CHUNK), malloc(CHUNK)};
    bool equal = files[0] && files[1] && bytes[0] && bytes[1];
    for (size_t got = CHUNK; equal && got == CHUNK;) {
        got = fread(bytes[0], 1, CHUNK, files[0]);
        equal = fread(bytes[1], 1, CHUNK, files[1]) == got && memcmp(bytes[0], bytes[1], got) == 0 &&
                !ferror(files[0]) && !ferror(files[1]);
    }
    for (int k = 0; k < 2; k++) {
        free(bytes[k]);
        if (files[k])
            fclose(files[k]);
    }
    return equal;
}

/* Where a name's tile begins, as "_x1_y0.r16"; its ending where it has none. */
static const char *tile_of(const char *path)
{
    const char *dot = strrchr(path, '.'), *at = dot ? dot : path + strlen(path);
    for (int k = 0; k < 2; k++) {
        const char *digits = at;
        while (digits > path && digits[-1] >= '0' && digits[-1] <= '9')
            digits--;
        if (digits == at || digits - path < 2 || digits[-1] != (k ? 'x' : 'y') || digits[-2] != '_')
            return dot ? dot : path + strlen(path);
        at = digits - 2;
    }
    return at;
}

/* What is to be equal to `same_as`: the output, or its tile of the same name; to be freed. NULL: none is there. */
static char *counterpart(const char *same_as, const char *output)
{
    const char *dot = strrchr(output, '.'), *tile = tile_of(same_as);
    size_t stem = dot ? (size_t)(dot - output) : strlen(output), room = stem + strlen(tile) + 1;
    char *path = is_there(output) ? strdup(output) : malloc(room);
    if (path && !is_there(output))
        snprintf(path, room, "%.*s%s", (int)stem, output, tile);
    if (path && is_there(path))
        return path;
    free(path);
    return NULL;
}

int same_as_compare(const char *same_as, const common *shared, const arguments *rest, char *const *files, size_t count)
{
    const tl_format *then = tl_format_of(same_as), *now = tl_format_of(shared->output);
    char *record = then && then == now && rest->record ? read_parameter(same_as, "command") : NULL;
    char *made = record && strcmp(record, rest->record) == 0 ? counterpart(same_as, shared->output) : NULL;
    int status = EXIT_DONE;
    if (made && equal_files(same_as, made))
        command_say(shared, "%s: equal to %s, byte for byte", made, same_as);
    else if (made) {
        complain("%s: made by the same command as %s, but not equal to it, so not kept: an input or the version of "
                 "talus is another",
                 made, same_as);
        for (size_t k = 0; k < count; k++) /* a failed run leaves nothing */
            unlink(files[k]);
        status = EXIT_FAILED;
    }
    free(made);
    free(record);
    return status;
}
