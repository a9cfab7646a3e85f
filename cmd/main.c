#include "cmd/command.h"

#include <locale.h>
#include <stdio.h>
#include <string.h>

static const command *const commands[] = {&command_info, &command_simplify, &command_synth, &command_preview,
                                          &command_noise};
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
    const char *names[COMMAND_COUNT + 1];
    for (size_t i = 0; i < COMMAND_COUNT; i++)
        names[i] = commands[i]->name;
    names[COMMAND_COUNT] = "help";
    const char *near = nearest_name(name, names, COMMAND_COUNT + 1, sizeof *names);
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
        fprintf(to, "  %-10s %s\n", commands[i]->name, commands[i]->summary);
    fprintf(to, "  %-10s %s\n  %-10s %s\n", "help", "tell more of a command: talus help COMMAND", "version",
            "print the version");
    fprintf(to, "\nTry: talus synth dem.tif --levels 4 -o terrain.exr\n");
}

static int help(int argc, const char **argv)
{
    if (argc < 2) {
        print_overview(stdout);
        return command_done();
    }
    const command *named = find(argv[1]);
    return named ? named->run(named, 1, argv + 1, true) : unknown(argv[1]);
}

int main(int argc, char **words)
{
    const char **argv = (const char **)words;
    setlocale(LC_CTYPE, ""); /* names of files as they are; numbers stay in the C locale */
    if (argc < 2) {
        print_overview(stderr);
        return EXIT_USAGE;
    }
    if (strcmp(argv[1], "--version") == 0 || strcmp(argv[1], "version") == 0) {
        printf("talus %s\n", tl_version());
        return command_done();
    }
    if (strcmp(argv[1], "help") == 0 || strcmp(argv[1], "--help") == 0 || strcmp(argv[1], "-h") == 0)
        return help(argc - 1, argv + 1);
    const command *chosen = find(argv[1]);
    if (!chosen)
        return unknown(argv[1]);
    progress_catch_signals();
    return chosen->run(chosen, argc - 1, argv + 1, false);
}
