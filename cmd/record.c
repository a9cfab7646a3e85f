#include "cmd/record.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

size_t record_value_size(const option *o)
{
    switch (o->kind) {
    case OPTION_FLAG:
        return sizeof(bool);
    case OPTION_CHOICE:
        return sizeof(int);
    case OPTION_INTEGER:
        return sizeof(int64_t);
    case OPTION_WINDOW:
        return 4 * sizeof(int64_t);
    case OPTION_NUMBER:
        return sizeof(double);
    case OPTION_TRIPLE:
        return 3 * sizeof(double);
    case OPTION_BOX:
        return 4 * sizeof(double);
    case OPTION_TEXT:
        return sizeof(const char *);
    }
    return 0;
}

void record_values(const option *const *options, size_t count, option_value *out)
{
    memset(out, 0, count * sizeof *out);
    for (size_t k = 0; k < count; k++)
        memcpy(&out[k], options[k]->target, record_value_size(options[k]));
}

static bool is_one_of(const char *name, const char *const *names)
{
    while (*names && strcmp(*names, name) != 0)
        names++;
    return *names;
}

bool record_leaves_out(const char *name)
{
    static const char *const names[] = {"output", "overwrite", "threads", "memory", "progress",
                                        "quiet",  "verify",    "same-as", "json",   NULL};
    return is_one_of(name, names);
}

static bool names_a_file(const option *o)
{
    static const char *const names[] = {"geoid", "hurst-map", "delta-map", "sigma-map", "layer-rules", NULL};
    return is_one_of(o->name, names);
}

/* A word as a shell, and popt, read it. */
static void put_word(FILE *to, const char *word)
{
    static const char plain[] = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_./:,@%+=-";
    if (*word && word[strspn(word, plain)] == 0) {
        fprintf(to, " %s", word);
        return;
    }
    fputs(" \"", to);
    for (; *word; word++)
        fprintf(to, strchr("\"\\", *word) ? "\\%c" : "%c", *word);
    fputc('"', to);
}

/* The shortest digits that read back as this number. */
static void number_text(double value, char text[32])
{
    for (int digits = 6; digits <= 17; digits++) {
        snprintf(text, 32, "%.*g", digits, value);
        if (strtod(text, NULL) == value)
            return;
    }
}

static const char *without_folders(const char *path)
{
    const char *slash = strrchr(path, '/');
    return slash && slash[1] ? slash + 1 : path;
}

static void put_value(FILE *to, const option *o, const option_value *value)
{
    char text[160] = "", one[32];
    size_t parts = record_value_size(o) / sizeof(double); /* as large as an int64_t */
    switch (o->kind) {
    case OPTION_FLAG:
        return;
    case OPTION_CHOICE:
        put_word(to, o->choices[value->choice]);
        return;
    case OPTION_TEXT:
        put_word(to, names_a_file(o) ? without_folders(value->text) : value->text);
        return;
    default:
        break;
    }
    for (size_t k = 0; k < parts; k++) {
        if (o->kind == OPTION_INTEGER || o->kind == OPTION_WINDOW)
            snprintf(one, sizeof one, "%lld", (long long)value->integers[k]);
        else
            number_text(value->numbers[k], one);
        snprintf(text + strlen(text), sizeof text - strlen(text), "%s%s", k ? "," : "", one);
    }
    put_word(to, text);
}

static bool is_default(const option *o, const option_value *now, const option_value *before)
{
    if (o->kind == OPTION_TEXT)
        return now->text == before->text || (now->text && before->text && strcmp(now->text, before->text) == 0);
    return !(o->given && *o->given) && memcmp(now, before, record_value_size(o)) == 0;
}

/* A name without folders; one that would be an option is put so that it is none. False: there is no memory. */
static bool put_name(FILE *to, const char *path)
{
    const char *name = without_folders(path);
    size_t room = strlen(name) + 3;
    char *safe = malloc(room);
    if (safe) {
        snprintf(safe, room, "%s%s", *name == '-' ? "./" : "", name);
        put_word(to, safe);
    }
    bool put = safe != NULL;
    free(safe);
    return put;
}

char *record_make(const char *command, const option *const *options, size_t count, const option_value *before,
                  const arguments *rest)
{
    char *text = NULL;
    size_t size;
    FILE *to = open_memstream(&text, &size);
    if (!to)
        return NULL;
    fputs(command, to);
    for (size_t k = 0; k < count; k++) {
        option_value now = {.integers = {0}};
        memcpy(&now, options[k]->target, record_value_size(options[k]));
        if (record_leaves_out(options[k]->name) || is_default(options[k], &now, &before[k]))
            continue;
        fprintf(to, " --%s", options[k]->name);
        put_value(to, options[k], &now);
    }
    bool whole = true;
    for (size_t k = 0; k < rest->count; k++)
        whole &= put_name(to, rest->names[k]);
    whole &= !ferror(to);
    if (fclose(to) == 0 && whole)
        return text;
    free(text);
    return NULL;
}
