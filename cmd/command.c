#include "cmd/command.h"

#include "cmd/completions.h"

#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>

const char *const progress_names[] = {
    [PROGRESS_BAR] = "bar", [PROGRESS_JSON] = "json", [PROGRESS_NONE] = "none", [PROGRESS_NONE + 1] = NULL};

const char *const frame_names[] = {
    [TL_FRAME_DEFAULT] = "default", [TL_FRAME_ENU] = "enu",   [TL_FRAME_PROJECTED] = "projected",
    [TL_FRAME_PIXEL] = "pixel",     [TL_FRAME_ECEF] = "ecef", NULL};

static void print_help(const command *self, const option_group *groups)
{
    printf("talus %s: %s\n\nUsage: talus %s %s\n", self->name, self->summary, self->name, self->arguments);
    options_help(groups);
    if (*self->notes)
        printf("\n%s\n", self->notes);
}

static void print_usage(const command *self)
{
    fprintf(stderr, "Usage: talus %s %s\n'talus help %s' tells more.\n", self->name, self->arguments, self->name);
}

bool command_misses_input(const command *self)
{
    complain("an input file is missing");
    print_usage(self);
    return false;
}

bool command_begin(const command *self, int argc, const char **argv, command_help help, const option_group *groups,
                   int inputs, arguments *rest, int *status)
{
    *rest = (arguments){0};
    parse_result result = help ? PARSE_HELP : options_parse(self->name, argc, argv, groups, rest);
    if (result == PARSE_HELP) {
        if (help > HELP_TEXT)
            completions_of_command(help, self, groups);
        else
            print_help(self, groups);
        arguments_free(rest);
        *status = help > HELP_TEXT ? EXIT_DONE : command_done();
        return false;
    }
    size_t least = inputs == ANY_INPUTS ? 0
                   : inputs < 0         ? 1
                                        : (size_t)inputs,
           most = inputs < 0 ? SIZE_MAX : (size_t)inputs;
    if (result == PARSE_OK && (rest->count < least || rest->count > most)) {
        if (rest->count > most)
            complain("'%s' is one argument too many; the output goes behind -o", rest->names[inputs]);
        else
            complain("an input file is missing");
        result = PARSE_BAD;
    }
    for (size_t i = 0; result == PARSE_OK && i < rest->count; i++)
        if (!*rest->names[i]) {
            complain("the input's name is empty");
            result = PARSE_BAD;
        }
    if (result == PARSE_BAD || result == PARSE_FAILED) {
        if (result == PARSE_BAD)
            print_usage(self);
        arguments_free(rest);
        *status = result == PARSE_BAD ? EXIT_USAGE : EXIT_FAILED;
        return false;
    }
    return true;
}

/* What the program takes however little it does. */
static const size_t own_bytes = 24 << 20;

/* What --memory leaves: a quarter for blocks of the input, the rest for what a command does. */
static size_t left_bytes(const common *options)
{
    return ((size_t)(options->memory ? options->memory : DEFAULT_MEMORY) << 20) - own_bytes;
}

tl_run command_run(const common *options, progress *bar)
{
    tl_run run = progress_run(bar, options->quiet ? PROGRESS_NONE : (progress_style)options->progress,
                              (unsigned)options->threads);
    run.memory = left_bytes(options) / 4 * 3;
    return run;
}

static tl_source *open_files(const common *options, const arguments *inputs, const tl_run *quietly, tl_error *error)
{
    const tl_dem_options dem = {.band = (unsigned)options->band,
                                .feather = options->feather,
                                .memory = left_bytes(options) / 4,
                                .run = quietly};
    if (inputs->count == 1 && !options->feather && !options->band)
        return tl_open_with(inputs->names[0], &dem, error);
    return tl_dem_open((const char *const *)inputs->names, inputs->count, &dem, error);
}

/* Whether --voids is understood. */
static bool void_options(const common *options, const tl_run *run, tl_void_options *out, tl_error *error)
{
    *out = (tl_void_options){.nodata_given = options->nodata_given, .nodata = (float)options->nodata, .run = run};
    const char *rule = options->voids;
    if (!rule || strcmp(rule, "keep") == 0)
        return true;
    if (strcmp(rule, "fill") == 0) {
        out->rule = TL_VOIDS_FILL;
        return true;
    }
    char *end;
    out->rule = TL_VOIDS_VALUE;
    out->value = strtof(rule, &end);
    if (end != rule && !*end && isfinite(out->value))
        return true;
    error->status = TL_ERROR_ARGUMENT;
    snprintf(error->text, sizeof error->text, "--voids: keep, fill or a height is wanted, not '%.100s'", rule);
    return false;
}

/* Puts a source over the last one; NULL: it could not be made, and nothing can be used. */
static void put_over(opened_input *opened, tl_source *made)
{
    if (made && made != opened->source)
        opened->steps[opened->step_count++] = made;
    opened->source = made;
}

/* The part of the file that is asked for. */
static tl_status choose_window(const common *options, const tl_source_info *info, tl_window *out, tl_error *error)
{
    const int64_t *w = options->window;
    if (options->window_given && options->box_given) {
        error->status = TL_ERROR_ARGUMENT;
        snprintf(error->text, sizeof error->text, "--window and --bbox name two parts; give one of them");
        return error->status;
    }
    *out = options->window_given ? (tl_window){w[0], w[1], w[2], w[3]} : (tl_window){0, 0, info->width, info->height};
    return options->box_given ? tl_cut_of_box(info, options->box, out, error) : TL_OK;
}

static void cut(const common *options, opened_input *opened, tl_error *error)
{
    if (!opened->source)
        return;
    if (choose_window(options, &opened->source->info, &opened->window, error) != TL_OK)
        put_over(opened, NULL);
    else if (options->window_given || options->box_given)
        put_over(opened, tl_cut_create(opened->source, opened->window, error));
}

/* Whether an output would take the place of an input. */
static bool is_input(const common *options, const arguments *inputs, tl_error *error)
{
    struct stat output, input;
    if (!options->output || stat(options->output, &output) != 0)
        return false;
    for (size_t k = 0; k < inputs->count; k++)
        if (stat(inputs->names[k], &input) == 0 && input.st_dev == output.st_dev && input.st_ino == output.st_ino) {
            *error = (tl_error){.status = TL_ERROR_ARGUMENT};
            snprintf(error->text, sizeof error->text, "%.300s: is the input too; name another output", options->output);
            return true;
        }
    return false;
}

opened_input command_open(const common *options, const arguments *inputs, const tl_run *run, tl_error *error)
{
    /* opening has no progress to speak of */
    const tl_run quietly = {.threads = run->threads, .cancel = run->cancel, .memory = run->memory};
    const tl_geoid_options geoid = {.grid = options->geoid, .memory = left_bytes(options) / 16};
    tl_void_options voids;
    opened_input opened = {0};
    if (is_input(options, inputs, error))
        return opened;
    if (void_options(options, run, &voids, error))
        put_over(&opened, open_files(options, inputs, &quietly, error));
    opened.file = opened.source;
    if (opened.source && opened.source->info.contents && !options->any_contents) {
        *error = (tl_error){.status = TL_ERROR_DATA};
        snprintf(error->text, sizeof error->text,
                 "%.300s: holds %.60s, no heights; name the heightfield that it was made of", opened.source->info.name,
                 opened.source->info.contents);
        command_close(&opened);
        return opened;
    }
    cut(options, &opened, error);
    /* a height that is given to voids counts from where the file's heights do */
    if (opened.source && (voids.rule != TL_VOIDS_KEEP || voids.nodata_given))
        put_over(&opened, tl_voids_create(opened.source, &voids, error));
    if (opened.source && geoid.grid && strcmp(geoid.grid, "none") != 0)
        put_over(&opened, tl_geoid_create(opened.source, &geoid, error));
    if (!opened.source)
        command_close(&opened);
    return opened;
}

void command_close(opened_input *opened)
{
    while (opened->step_count)
        tl_source_destroy(opened->steps[--opened->step_count]);
    *opened = (opened_input){0};
}

int command_failed(progress *bar, const tl_error *error)
{
    progress_end(bar);
    complain("%s", error->text);
    return error->status == TL_ERROR_CANCELLED ? EXIT_INTERRUPTED : EXIT_FAILED;
}

void command_say(const common *options, const char *format, ...)
{
    if (options->quiet)
        return;
    va_list list;
    va_start(list, format);
    vfprintf(stderr, format, list);
    va_end(list);
    fputc('\n', stderr);
}

int command_done(void)
{
    if (fflush(stdout) == 0 && !ferror(stdout))
        return EXIT_DONE;
    complain("cannot write to standard output: %s", strerror(errno));
    return EXIT_FAILED;
}

static void complain_of_ending(const char *path, bool grid, bool mesh)
{
    fprintf(stderr, "talus: %s: the name's ending must be one of", path);
    const char *separator = " ";
    for (const tl_format *f = tl_formats(); f->ending; f++)
        if ((grid && f->grid) || (mesh && f->mesh)) {
            fprintf(stderr, "%s.%s", separator, f->ending);
            separator = ", ";
        }
    fputc('\n', stderr);
}

bool command_ends_with(const char *path, const char *ending)
{
    size_t length = path ? strlen(path) : 0, end = strlen(ending);
    return length > end && strcasecmp(path + length - end, ending) == 0;
}

bool command_texture_names(const char *name, const char *text, unsigned *out)
{
    static const char *const names[] = {"colour", "normal"}; /* by tl_texture's bits */
    const char *at = text;
    *out = 0;
    for (size_t length; at; at = at[length] ? at + length + 1 : NULL) {
        length = strcspn(at, ",");
        int k = 0;
        while (k < 2 && (strlen(names[k]) != length || strncmp(at, names[k], length) != 0))
            k++;
        if (k == 2) {
            char word[32];
            snprintf(word, sizeof word, "%.*s", (int)length, at);
            complain_of_choice(name, word, names, 2, sizeof *names);
            return false;
        }
        *out |= 1u << k;
    }
    return true;
}

bool command_textures(const common *options, unsigned *out)
{
    const char *at = options->textures;
    *out = 0;
    if (!at && !options->texture_size)
        return true;
    if (!at || !command_ends_with(options->output, ".glb")) {
        complain(at ? "--texture is for .glb; other formats have none" : "--texture-size is for --texture KINDS");
        return false;
    }
    return command_texture_names("texture", at, out);
}

bool command_split_ok(const common *options)
{
    bool good = !options->split || command_ends_with(options->output, ".glb");
    if (!good)
        complain("--split is for .glb; other formats have no limit of 4 GiB");
    return good;
}

bool command_output_ok(const common *options, bool grid, bool mesh)
{
    if (!options->output || !*options->output) {
        complain("no output named; give -o FILE");
        return false;
    }
    const tl_format *format = tl_format_of(options->output);
    if (format && ((grid && format->grid) || (mesh && format->mesh)))
        return true;
    complain_of_ending(options->output, grid, mesh);
    return false;
}
