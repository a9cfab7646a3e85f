#include "cmd/completions.h"

#include <fcntl.h>
#include <locale.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

static const command *const commands[] = {&command_info,  &command_simplify, &command_synth, &command_preview,
                                          &command_noise, &command_stats,    &command_view,  &command_fly,
                                          &command_tiles, &command_serve,    &command_report};
enum { COMMAND_COUNT = sizeof commands / sizeof *commands };

static const command *find(const char *name)
{
    for (size_t i = 0; i < COMMAND_COUNT; i++)
        if (strcmp(commands[i]->name, name) == 0)
            return commands[i];
    return NULL;
}

static int unknown(const char *name)
{
    if (*name == '-') {
        complain("'%s' stands before the command; options go behind it: talus COMMAND ... %s", name, name);
        return EXIT_USAGE;
    }
    const char *names[COMMAND_COUNT + 2];
    for (size_t i = 0; i < COMMAND_COUNT; i++)
        names[i] = commands[i]->name;
    names[COMMAND_COUNT] = "help";
    names[COMMAND_COUNT + 1] = "completions";
    const char *near = nearest_name(name, names, COMMAND_COUNT + 2, sizeof *names);
    if (near)
        complain("unknown command '%s'; did you mean '%s'?", name, near);
    else
        complain("unknown command '%s'; 'talus help' lists them", name);
    return EXIT_USAGE;
}

static void print_overview(FILE *to)
{
    fprintf(to,
            "talus %s: terrain with detail below the resolution of its elevation model\n\n"
            "Usage: talus COMMAND INPUT -o OUTPUT [OPTION...]\n\nCommands:\n",
            tl_version());
    for (size_t i = 0; i < COMMAND_COUNT; i++)
        fprintf(to, "  %-11s %s\n", commands[i]->name, commands[i]->summary);
    static const char *const others[][2] = {{"help", "tell more of a command: talus help COMMAND"},
                                            {"completions", "print completions for a shell: bash, zsh or fish"},
                                            {"version", "print the version"}};
    for (size_t i = 0; i < sizeof others / sizeof *others; i++)
        fprintf(to, "  %-11s %s\n", others[i][0], others[i][1]);
    fprintf(to, "\nTry: talus synth dem.tif --levels 4 -o terrain.exr\n");
}

static int too_many(const char *surplus)
{
    complain("'%s' is one argument too many", surplus);
    return EXIT_USAGE;
}

static int help(int argc, const char **argv)
{
    if (argc > 2)
        return too_many(argv[2]);
    if (argc < 2 || strcmp(argv[1], "help") == 0 || strcmp(argv[1], "version") == 0 ||
        strcmp(argv[1], "completions") == 0) {
        print_overview(stdout);
        return command_done();
    }
    const command *named = find(argv[1]);
    return named ? named->run(named, 1, argv + 1, HELP_TEXT) : unknown(argv[1]);
}

static int version(int argc, const char **argv)
{
    if (argc > 1)
        return too_many(argv[1]);
    printf("talus %s%s%s%s\n", tl_version(), *tl_lacks() ? " (without " : "", tl_lacks(), *tl_lacks() ? ")" : "");
    return command_done();
}

/* Where the caller closed one of the three standard descriptors, the next file opened would get its number, and
 * messages would go into an output. What is put there instead refuses to be written, as a closed one does. */
static void occupy_standard_descriptors(void)
{
    int descriptor;
    do
        descriptor = open("/dev/null", O_RDONLY);
    while (descriptor >= 0 && descriptor <= STDERR_FILENO);
    if (descriptor > STDERR_FILENO)
        close(descriptor);
}

int main(int argc, char **words)
{
    const char **argv = (const char **)words;
    occupy_standard_descriptors();
    progress_catch_signals();
    setlocale(LC_CTYPE, ""); /* names of files as they are; numbers stay in the C locale */
    if (argc < 2) {
        print_overview(stderr);
        return EXIT_USAGE;
    }
    const char *name = argv[1];
    if (strcmp(name, "--version") == 0 || strcmp(name, "version") == 0)
        return version(argc - 1, argv + 1);
    if (strcmp(name, "help") == 0 || strcmp(name, "--help") == 0 || strcmp(name, "-h") == 0)
        return help(argc - 1, argv + 1);
    if (strcmp(name, "completions") == 0)
        return completions_print(argc - 1, argv + 1, commands, COMMAND_COUNT);
    const command *chosen = find(name);
    return chosen ? chosen->run(chosen, argc - 1, argv + 1, HELP_NONE) : unknown(name);
}
