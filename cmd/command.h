/* The commands of the program: a table, and what they share. */
#ifndef CMD_COMMAND_H
#define CMD_COMMAND_H

#include "cmd/options.h"
#include "cmd/progress.h"
#include "lib/talus.h"

/* In place of work: all options for people, or for the completion of a shell. */
typedef enum command_help { HELP_NONE, HELP_TEXT, HELP_FOR_BASH, HELP_FOR_ZSH, HELP_FOR_FISH } command_help;

typedef struct command {
    const char *name;
    const char *summary;   /* one line */
    const char *arguments; /* what follows the name, as "DEM -o OUTPUT" */
    const char *notes;     /* a paragraph or example for the help; may be "" */
    /* argv[0] is the command's name; returns an exit status. With help, only prints its options. */
    int (*run)(const struct command *self, int argc, const char **argv, command_help help);
} command;

extern const command command_info, command_simplify, command_synth, command_preview, command_noise, command_stats,
    command_view, command_fly, command_tiles, command_serve, command_report;

enum { DEFAULT_MEMORY = 512, OPENED_STEPS = 4 };

/* Options that most commands have. */
typedef struct common {
    const char *output;
    bool overwrite, quiet, feather;
    bool any_contents; /* the input need not be heights */
    const char *voids; /* keep, fill or a number */
    const char *geoid; /* none, egm96 or a file */
    int64_t window[4]; /* first column and row, columns, rows */
    double box[4];     /* west, south, east, north */
    bool window_given, box_given;
    double nodata;
    bool nodata_given;
    int64_t band; /* 0: the first */
    int64_t threads;
    int64_t memory;       /* MB; 0: DEFAULT_MEMORY */
    const char *textures; /* colour,normal; see command_textures */
    int64_t texture_size, split;
    int progress; /* index into the names of progress_style */
} common;

/* The rows of the options in a `common`, for use inside of an array of options. */
#define COMMON_INPUT(c)                                                                                            \
    {"window",                                                                                                     \
     0,                                                                                                            \
     OPTION_WINDOW,                                                                                                \
     (c).window,                                                                                                   \
     &(c).window_given,                                                                                            \
     "X,Y,W,H",                                                                                                    \
     "only this part: first column and row, from 0, columns and rows",                                             \
     0,                                                                                                            \
     0,                                                                                                            \
     NULL},                                                                                                        \
        {"bbox",                                                                                                   \
         0,                                                                                                        \
         OPTION_BOX,                                                                                               \
         (c).box,                                                                                                  \
         &(c).box_given,                                                                                           \
         "W,S,E,N",                                                                                                \
         "only the samples in this box of CRS coordinates (longitude, latitude where geographic)",                 \
         0,                                                                                                        \
         0,                                                                                                        \
         NULL},                                                                                                    \
                                                                                                                   \
        {"band",                                                                                                   \
         0,                                                                                                        \
         OPTION_INTEGER,                                                                                           \
         &(c).band,                                                                                                \
         NULL,                                                                                                     \
         "N",                                                                                                      \
         "the band that holds the heights, 1...65535 (default: 1)",                                                \
         1,                                                                                                        \
         65535,                                                                                                    \
         NULL},                                                                                                    \
        {"nodata",                                                                                                 \
         0,                                                                                                        \
         OPTION_NUMBER,                                                                                            \
         &(c).nodata,                                                                                              \
         &(c).nodata_given,                                                                                        \
         "VALUE",                                                                                                  \
         "a height that stands for void, besides what the file declares",                                          \
         -3.5e38,                                                                                                  \
         3.5e38,                                                                                                   \
         NULL},                                                                                                    \
        {"voids",                                                                                                  \
         0,                                                                                                        \
         OPTION_TEXT,                                                                                              \
         &(c).voids,                                                                                               \
         NULL,                                                                                                     \
         "RULE",                                                                                                   \
         "keep; fill, by a smooth surface from the rim; or a height for all (default: keep)",                      \
         0,                                                                                                        \
         0,                                                                                                        \
         NULL},                                                                                                    \
        {"geoid",                                                                                                  \
         0,                                                                                                        \
         OPTION_TEXT,                                                                                              \
         &(c).geoid,                                                                                               \
         NULL,                                                                                                     \
         "GEOID",                                                                                                  \
         "what heights count from, to make them ellipsoidal: none, egm96 or a grid FILE (default: none)",          \
         0,                                                                                                        \
         0,                                                                                                        \
         NULL},                                                                                                    \
    {                                                                                                              \
        "feather", 0, OPTION_FLAG, &(c).feather, NULL, NULL,                                                       \
            "blend files where they overlap, over at most 32 samples (default: the finest, then the first)", 0, 0, \
            NULL                                                                                                   \
    }
#define COMMON_OUTPUT(c)                                                                                       \
    {"output", 'o', OPTION_TEXT, &(c).output, NULL, "FILE", "where to write; the ending chooses the format",   \
     0,        0,   NULL},                                                                                     \
    {                                                                                                          \
        "overwrite", 0, OPTION_FLAG, &(c).overwrite, NULL, NULL, "replace the output if it exists", 0, 0, NULL \
    }
#define TEXTURE_OPTIONS(c)                                                                  \
    {"texture",                                                                             \
     0,                                                                                     \
     OPTION_TEXT,                                                                           \
     &(c).textures,                                                                         \
     NULL,                                                                                  \
     "KINDS",                                                                               \
     "of a .glb: pictures of the ground in it: colour, normal or colour,normal",            \
     0,                                                                                     \
     0,                                                                                     \
     NULL},                                                                                 \
    {                                                                                       \
        "texture-size", 0, OPTION_INTEGER, &(c).texture_size, NULL, "N",                    \
            "texels on a side of these, at most, 1...16384 (default: 4096)", 1, 16384, NULL \
    }
#define SPLIT_OPTION(c)                                                                                            \
    {                                                                                                              \
        "split", 0, OPTION_INTEGER, &(c).split, NULL, "N",                                                         \
            "of a .glb: files NAME_x0_y0.glb and so on, of at most N triangles, 1000...2^31 (default: one)", 1000, \
            2147483648, NULL                                                                                       \
    }
/* How detail is made, in all commands that make it: rows of an int64_t and a tl_field_options. */
#define FRACTAL_OPTIONS(number, f)                                                                                 \
    {"seed", 's', OPTION_INTEGER, &(number), NULL, "N", "another seed, another terrain, 0...2^62 (default: 0)", 0, \
     0x1p62, NULL},                                                                                                \
        {"hurst",                                                                                                  \
         0,                                                                                                        \
         OPTION_NUMBER,                                                                                            \
         &(f).hurst,                                                                                               \
         &(f).hurst_given,                                                                                         \
         "H",                                                                                                      \
         "Hurst exponent of the detail, 0.01...0.99 (default: measured from the DEM, octave by octave)",           \
         0.01,                                                                                                     \
         0.99,                                                                                                     \
         NULL},                                                                                                    \
        {"delta",                                                                                                  \
         0,                                                                                                        \
         OPTION_NUMBER,                                                                                            \
         &(f).delta,                                                                                               \
         &(f).delta_given,                                                                                         \
         "D",                                                                                                      \
         "standard deviation of the height difference over one DEM sample, in the DEM's unit, 0...1e30 (default: " \
         "measured)",                                                                                              \
         0,                                                                                                        \
         1e30,                                                                                                     \
         NULL},                                                                                                    \
    {                                                                                                              \
        "scheme", 0, OPTION_TEXT, &(f).scheme, NULL, "NAME",                                                       \
            "way to refine, of those that 'talus help synth' lists (default: terrain; stationary with --hurst, "   \
            "--delta or a map)",                                                                                   \
            0, 0, NULL                                                                                             \
    }

#define COMMON_RUNNING(c)                                                                                              \
    {"threads", 't', OPTION_INTEGER, &(c).threads, NULL, "N", "worker threads, 1...512 (default: one a processor)", 1, \
     512,       NULL},                                                                                                 \
        {"memory",                                                                                                     \
         0,                                                                                                            \
         OPTION_INTEGER,                                                                                               \
         &(c).memory,                                                                                                  \
         NULL,                                                                                                         \
         "MB",                                                                                                         \
         "to stay in, 32...1048576; a quarter keeps blocks of the input (default: 512)",                               \
         32,                                                                                                           \
         1048576,                                                                                                      \
         NULL},                                                                                                        \
        {"progress",                                                                                                   \
         0,                                                                                                            \
         OPTION_CHOICE,                                                                                                \
         &(c).progress,                                                                                                \
         NULL,                                                                                                         \
         "STYLE",                                                                                                      \
         "on stderr; a bar only on a terminal (default: bar)",                                                         \
         0,                                                                                                            \
         0,                                                                                                            \
         progress_names},                                                                                              \
    {                                                                                                                  \
        "quiet", 'q', OPTION_FLAG, &(c).quiet, NULL, NULL, "print nothing but errors and data", 0, 0, NULL             \
    }

extern const char *const progress_names[], *const frame_names[]; /* by progress_style and tl_frame, ended by NULL */

enum { ANY_INPUTS = -2 };

/* Parses the command's options and checks that `inputs` file names stand beside them (-1: one or more). False: the
 * caller ends with *status. */
bool command_begin(const command *self, int argc, const char **argv, command_help help, const option_group *groups,
                   int inputs, arguments *rest, int *status);

/* "An input file is missing" and the usage; false. */
bool command_misses_input(const command *self);

/* The tl_run of a command; reports to *bar. */
tl_run command_run(const common *options, progress *bar);
/* What a command reads: files, and what the options make of them, one source over the other. */
typedef struct opened_input {
    tl_source *source; /* to be used; NULL: could not be opened */
    tl_source *file;   /* as it is */
    tl_window window;  /* the part of it that is used */
    tl_source *steps[OPENED_STEPS];
    int step_count;
} opened_input;

/* Opens the inputs as one source: an EXR, or elevation models. */
opened_input command_open(const common *options, const arguments *inputs, const tl_run *run, tl_error *error);
void command_close(opened_input *opened);
/* What COMMAND's help says of its inputs. */
#define INPUT_NOTES                                                                                                  \
    "Inputs are GeoTIFFs, SRTM .hgt files, directories of them, patterns or @LIST (a file of names); several make "  \
    "one\n"                                                                                                          \
    "elevation model, in which the finest wins where they overlap, then the first. Or one .exr, .png, .r16 or .raw " \
    "that talus wrote."
/* Tells the error on stderr; the exit status that it means. */
int command_failed(progress *bar, const tl_error *error);
/* A line on stderr, unless quiet. */
__attribute__((format(printf, 2, 3))) void command_say(const common *options, const char *format, ...);
/* Flushes stdout; EXIT_DONE, or EXIT_FAILED with a message when it could not be written. */
int command_done(void);
/* Whether a name, or NULL, ends like this, in upper or lower case; one that is nothing but the ending does not. */
/* Told and false where --split is given and the output is no .glb. */
bool command_split_ok(const common *options);
/* The tl_texture values of the option --texture, added; told and false where it names others or the output is no .glb.
 */
bool command_textures(const common *options, unsigned *out);
/* The same of a list of names. */
bool command_texture_names(const char *name, const char *kinds, unsigned *out);
bool command_ends_with(const char *path, const char *ending);

/* Whether an output was named and has an ending that talus writes as `grid` or `mesh`; else told. */
bool command_output_ok(const common *options, bool grid, bool mesh);

#endif
