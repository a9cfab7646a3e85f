/* Options as tables: one row an option gives its parsing, its range check and its line in the help. */
#ifndef CMD_OPTIONS_H
#define CMD_OPTIONS_H

#include <stdbool.h>
#include <stddef.h>

/* Exit statuses, as the man page states them. */
enum { EXIT_DONE = 0, EXIT_FAILED = 1, EXIT_USAGE = 2, EXIT_INTERRUPTED = 130 };

typedef enum option_kind {
    OPTION_FLAG,    /* bool: set by its presence */
    OPTION_INTEGER, /* int64_t */
    OPTION_NUMBER,  /* double */
    OPTION_TRIPLE,  /* double[3]: A,B,C */
    OPTION_BOX,     /* double[4]: A,B,C,D */
    OPTION_WINDOW,  /* int64_t[4]: column and row, from 0, and columns and rows, from 1 */
    OPTION_TEXT,    /* const char * */
    OPTION_CHOICE,  /* int: index into `choices` */
} option_kind;

typedef struct option {
    const char *name; /* long name, without dashes */
    char letter;      /* one-letter name, 0: none */
    option_kind kind;
    void *target;               /* by kind; untouched when the option is not given */
    bool *given;                /* set to true when the option is given; NULL: not wanted */
    const char *argument;       /* what stands for the value in the help, as "METRES"; NULL for flags */
    const char *help;           /* one line with unit and default */
    double low, high;           /* of integers and numbers, both included */
    const char *const *choices; /* names, ended by NULL */
} option;

/* A group of options under one heading; a list of groups ends with a heading of NULL, a list of options with a name of
 * NULL. */
typedef struct option_group {
    const char *heading;
    const option *options;
} option_group;

/* What a command line held beside its options, and the texts that its options point to. All is owned. */
typedef struct arguments {
    char **names;
    size_t count;
    char **texts;
    size_t text_count;
    char *record;               /* the command line again, as record.h has it; NULL: not built */
    union option_value *before; /* what the targets held, in the order of the options */
} arguments;

typedef enum parse_result {
    PARSE_OK,
    PARSE_HELP,
    PARSE_BAD,
    PARSE_FAILED /* the system did, not the user */
} parse_result;

/* Parses argv[1 ...] of the command `command`. Mistakes are told on stderr, with the accepted range and the nearest
 * name. Whatever the result, the caller frees *rest, after the last use of the options. */
parse_result options_parse(const char *command, int argc, const char **argv, const option_group *groups,
                           arguments *rest);

/* Gives the targets back what they held before they were parsed into *rest. */
void options_undo(const option_group *groups, const arguments *rest);

void arguments_free(arguments *rest);

/* Prints every group's options on stdout. */
void options_help(const option_group *groups);

/* The name nearest to `text` in count names, stride bytes apart (each a const char *); NULL when none is near. */
const char *nearest_name(const char *text, const void *names, size_t count, size_t stride);

/* Tells on stderr that `text` is none of the names that --NAME takes, and which is nearest; names as in nearest_name.
 */
void complain_of_choice(const char *name, const char *text, const void *names, size_t count, size_t stride);

/* "talus: MESSAGE" on stderr. */
__attribute__((format(printf, 1, 2))) void complain(const char *format, ...);

#endif
