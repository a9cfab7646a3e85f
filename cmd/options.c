#include "cmd/options.h"

#include "cmd/record.h"

#include <errno.h>
#include <math.h>
#include <popt.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { MAX_OPTIONS = 64, HELP_CODE = MAX_OPTIONS + 1, HELP_COLUMN = 26 };

void complain(const char *format, ...)
{
    va_list list;
    va_start(list, format);
    fputs("talus: ", stderr);
    vfprintf(stderr, format, list);
    fputc('\n', stderr);
    va_end(list);
}

/* Levenshtein's distance, two rows of the table; names longer than the rows are far from everything. */
static size_t distance(const char *a, const char *b)
{
    enum { LONGEST = 63 };
    size_t row[LONGEST + 1], length_a = strlen(a), length_b = strlen(b);
    if (length_a > LONGEST || length_b > LONGEST)
        return SIZE_MAX;
    for (size_t j = 0; j <= length_b; j++)
        row[j] = j;
    for (size_t i = 1; i <= length_a; i++) {
        size_t diagonal = row[0];
        row[0] = i;
        for (size_t j = 1; j <= length_b; j++) {
            size_t best = diagonal + (a[i - 1] != b[j - 1]);
            if (row[j] + 1 < best)
                best = row[j] + 1;
            if (row[j - 1] + 1 < best)
                best = row[j - 1] + 1;
            diagonal = row[j];
            row[j] = best;
        }
    }
    return row[length_b];
}

static const char *name_at(const void *names, size_t i, size_t stride)
{
    return *(const char *const *)((const char *)names + i * stride);
}

const char *nearest_name(const char *text, const void *names, size_t count, size_t stride)
{
    const char *best = NULL;
    size_t best_distance = SIZE_MAX;
    for (size_t i = 0; i < count; i++) {
        const char *name = name_at(names, i, stride);
        size_t d = distance(text, name);
        /* a third of the letters may be wrong, and two swapped ones in four, but "dots" is not "none" */
        if (d < best_distance && d <= (strlen(name) + 2) / 3) {
            best_distance = d;
            best = name;
        }
    }
    return best;
}

void complain_of_choice(const char *name, const char *text, const void *names, size_t count, size_t stride)
{
    fprintf(stderr, "talus: --%s: '%s' is none of", name, text);
    for (size_t i = 0; i < count; i++)
        fprintf(stderr, "%s %s", i ? "," : "", name_at(names, i, stride));
    const char *near = nearest_name(text, names, count, stride);
    if (near)
        fprintf(stderr, "; did you mean %s?", near);
    fputc('\n', stderr);
}

/* ---- values ---- */

static bool parse_double(const char *text, char **end, double *out)
{
    errno = 0;
    *out = strtod(text, end);
    return *end != text && errno != ERANGE && isfinite(*out);
}

static bool number_value(const option *o, const char *text)
{
    char *end;
    double value;
    if (!parse_double(text, &end, &value) || *end || value < o->low || value > o->high) {
        complain("--%s: a number from %g to %g is wanted, not '%s'", o->name, o->low, o->high, text);
        return false;
    }
    *(double *)o->target = value;
    return true;
}

static bool integer_value(const option *o, const char *text)
{
    char *end;
    errno = 0;
    long long value = strtoll(text, &end, 10);
    /* compared as integers: above 2^53 a double would round the value, and with it the limit */
    if (end == text || *end || errno == ERANGE || value < (long long)o->low || value > (long long)o->high) {
        complain("--%s: a whole number from %.0f to %.0f is wanted, not '%s'", o->name, o->low, o->high, text);
        return false;
    }
    *(int64_t *)o->target = value;
    return true;
}

static bool numbers_value(const option *o, const char *text, int count)
{
    double values[4];
    const char *at = text;
    for (int k = 0; k < count; k++) {
        char *end;
        if (!parse_double(at, &end, &values[k]) || *end != (k < count - 1 ? ',' : '\0')) {
            complain("--%s: %s numbers %s are wanted, not '%s'", o->name, count == 3 ? "three" : "four", o->argument,
                     text);
            return false;
        }
        at = end + 1;
    }
    memcpy(o->target, values, (size_t)count * sizeof *values);
    return true;
}

static bool window_value(const option *o, const char *text)
{
    int64_t values[4];
    const char *at = text;
    for (int k = 0; k < 4; k++) {
        char *end;
        errno = 0;
        values[k] = strtoll(at, &end, 10);
        if (end == at || errno == ERANGE || values[k] < k / 2 || *end != (k < 3 ? ',' : '\0')) {
            complain("--%s: %s is wanted, whole numbers, columns and rows counted from 0, not '%s'", o->name,
                     o->argument, text);
            return false;
        }
        at = end + 1;
    }
    memcpy(o->target, values, sizeof values);
    return true;
}

static bool choice_value(const option *o, const char *text)
{
    int count = 0;
    for (; o->choices[count]; count++)
        if (strcmp(o->choices[count], text) == 0) {
            *(int *)o->target = count;
            return true;
        }
    complain_of_choice(o->name, text, o->choices, (size_t)count, sizeof *o->choices);
    return false;
}

static bool take_value(const option *o, const char *text)
{
    if (o->given)
        *o->given = true;
    switch (o->kind) {
    case OPTION_FLAG:
        *(bool *)o->target = true;
        return true;
    case OPTION_INTEGER:
        return integer_value(o, text);
    case OPTION_NUMBER:
        return number_value(o, text);
    case OPTION_TRIPLE:
        return numbers_value(o, text, 3);
    case OPTION_BOX:
        return numbers_value(o, text, 4);
    case OPTION_WINDOW:
        return window_value(o, text);
    case OPTION_CHOICE:
        return choice_value(o, text);
    case OPTION_TEXT:
        *(const char **)o->target = text;
        return true;
    }
    return false;
}

/* ---- parsing ---- */

static size_t flatten(const option_group *groups, const option *flat[MAX_OPTIONS])
{
    size_t count = 0;
    for (; groups->heading; groups++)
        for (const option *o = groups->options; o->name && count < MAX_OPTIONS; o++)
            flat[count++] = o;
    return count;
}

static void complain_of_option(poptContext context, int code, const option *const *flat, size_t count)
{
    const char *bad = poptBadOption(context, POPT_BADOPTION_NOALIAS);
    if (code != POPT_ERROR_BADOPT) {
        complain("%s: %s", bad, code == POPT_ERROR_NOARG ? "a value is missing" : poptStrerror(code));
        return;
    }
    const char *names[MAX_OPTIONS];
    for (size_t i = 0; i < count; i++)
        names[i] = flat[i]->name;
    char text[64];
    snprintf(text, sizeof text, "%s", bad + strspn(bad, "-"));
    text[strcspn(text, "=")] = '\0';
    const char *near = nearest_name(text, names, count, sizeof *names);
    if (near)
        complain("unknown option %s; did you mean --%s?", bad, near);
    else
        complain("unknown option %s", bad);
}

static parse_result run_popt(poptContext context, const option *const *flat, size_t count, arguments *rest)
{
    int code;
    while ((code = poptGetNextOpt(context)) > 0) {
        if (code == HELP_CODE)
            return PARSE_HELP;
        char *text = poptGetOptArg(context);
        if (text)
            rest->texts[rest->text_count++] = text;
        if (!take_value(flat[code - 1], text))
            return PARSE_BAD;
    }
    if (code < -1) {
        complain_of_option(context, code, flat, count);
        return PARSE_BAD;
    }
    return PARSE_OK;
}

/* popt frees its own copies of the names with the context. */
static bool collect_names(poptContext context, arguments *rest)
{
    const char *name;
    while ((name = poptGetArg(context))) {
        if (!(rest->names[rest->count] = strdup(name)))
            return false;
        rest->count++;
    }
    return true;
}

void options_undo(const option_group *groups, const arguments *rest)
{
    const option *flat[MAX_OPTIONS];
    size_t count = flatten(groups, flat);
    for (size_t k = 0; rest->before && k < count; k++) {
        memcpy(flat[k]->target, &rest->before[k], record_value_size(flat[k]));
        if (flat[k]->given)
            *flat[k]->given = false;
    }
}

void arguments_free(arguments *rest)
{
    for (size_t i = 0; i < rest->count; i++)
        free(rest->names[i]);
    for (size_t i = 0; i < rest->text_count; i++)
        free(rest->texts[i]);
    free(rest->names);
    free(rest->texts);
    free(rest->record);
    free(rest->before);
    *rest = (arguments){0};
}

static void fill_table(struct poptOption *table, const option *const *flat, size_t count)
{
    for (size_t i = 0; i < count; i++)
        table[i] = (struct poptOption){.longName = flat[i]->name,
                                       .shortName = flat[i]->letter,
                                       .argInfo = flat[i]->kind == OPTION_FLAG ? POPT_ARG_NONE : POPT_ARG_STRING,
                                       .val = (int)i + 1};
    table[count] =
        (struct poptOption){.longName = "help", .shortName = 'h', .argInfo = POPT_ARG_NONE, .val = HELP_CODE};
    table[count + 1] = (struct poptOption){0};
}

parse_result options_parse(const char *command, int argc, const char **argv, const option_group *groups,
                           arguments *rest)
{
    const option *flat[MAX_OPTIONS];
    size_t count = flatten(groups, flat);
    struct poptOption table[MAX_OPTIONS + 2];
    fill_table(table, flat, count);
    size_t words = (size_t)argc + 1; /* each word is one name or one text at most */
    *rest = (arguments){.names = calloc(words, sizeof *rest->names),
                        .texts = calloc(words, sizeof *rest->texts),
                        .before = calloc(count + 1, sizeof *rest->before)};
    if (rest->before)
        record_values(flat, count, rest->before);
    poptContext context =
        rest->names && rest->texts && rest->before ? poptGetContext(command, argc, argv, table, 0) : NULL;
    parse_result result = context ? run_popt(context, flat, count, rest) : PARSE_BAD;
    if (!context || (result == PARSE_OK && !collect_names(context, rest))) {
        complain("not enough memory for the options");
        result = PARSE_FAILED;
    }
    if (context)
        poptFreeContext(context);
    if (result == PARSE_OK && !(rest->record = record_make(command, flat, count, rest->before, rest))) {
        complain("not enough memory for the options");
        result = PARSE_FAILED;
    }
    return result;
}

/* ---- help ---- */

static void print_option(const option *o)
{
    char left[96];
    int length = o->letter ? snprintf(left, sizeof left, "  -%c, --%s", o->letter, o->name)
                           : snprintf(left, sizeof left, "      --%s", o->name);
    if (o->argument)
        length += snprintf(left + length, sizeof left - (size_t)length, " %s", o->argument);
    if (length > HELP_COLUMN)
        printf("%s\n%*s  %s", left, HELP_COLUMN, "", o->help);
    else
        printf("%-*s  %s", HELP_COLUMN, left, o->help);
    if (o->choices) {
        fputs(":", stdout);
        for (int i = 0; o->choices[i]; i++)
            printf("%s %s", i ? "," : "", o->choices[i]);
    }
    putchar('\n');
}

void options_help(const option_group *groups)
{
    for (; groups->heading; groups++) {
        printf("\n%s:\n", groups->heading);
        for (const option *o = groups->options; o->name; o++)
            print_option(o);
    }
}
