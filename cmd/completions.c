#include "cmd/completions.h"

#include <stdio.h>
#include <string.h>

/* ---- What the shells have in common ---- */

static void print_names(const char *const *names)
{
    for (int k = 0; names[k]; k++)
        printf("%s%s", k ? " " : "", names[k]);
}

/* Whether the value may be the name of a file; of the others the shell can say nothing. */
static bool takes_file(const option *o)
{
    return o->kind == OPTION_TEXT;
}

/* Text between single quotes. Each of `special` gets a backslash. */
static void print_quoted(const char *text, const char *special)
{
    for (; *text; text++) {
        if (*text == '\'')
            fputs("'\\'", stdout);
        else if (strchr(special, *text))
            putchar('\\');
        putchar(*text);
    }
}

/* Calls `print` for each option, --help too. */
static void for_options(const command *self, const option_group *groups,
                        void (*print)(const command *self, const option *o))
{
    const option help = {.name = "help", .letter = 'h', .kind = OPTION_FLAG, .help = "tell of all options"};
    for (; groups->heading; groups++)
        for (const option *o = groups->options; o->name; o++)
            print(self, o);
    print(self, &help);
}

/* ---- bash ---- */

static void bash_name(const command *self, const option *o)
{
    (void)self;
    printf(" --%s", o->name);
}

static void bash_values(const command *self, const option *o)
{
    if (o->kind == OPTION_FLAG || takes_file(o))
        return;
    printf("    %s:--%s", self->name, o->name);
    if (o->letter)
        printf("|%s:-%c", self->name, o->letter);
    fputs(")\n", stdout);
    if (o->choices) {
        fputs("        _talus_words \"", stdout);
        print_names(o->choices);
        fputs("\"\n", stdout);
    } else
        fputs("        compopt +o default\n", stdout);
    fputs("        return ;;\n", stdout);
}

static void bash_command(const command *self, const option_group *groups)
{
    for_options(self, groups, bash_values);
    printf("    %s:*)\n        [[ $word == -* ]] && _talus_words \"", self->name);
    for_options(self, groups, bash_name);
    fputs("\" ;;\n", stdout);
}

static const char bash_begin[] = "# bash completion for talus\n"
                                 "_talus_words() { mapfile -t COMPREPLY < <(compgen -W \"$1\" -- \"$word\"); }\n"
                                 "_talus() {\n"
                                 "    local word=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD - 1]}\n"
                                 "    COMPREPLY=()\n"
                                 "    # --name=value is three words here\n"
                                 "    [[ $word == = ]] && word=\n"
                                 "    [[ $before == = ]] && before=${COMP_WORDS[COMP_CWORD - 2]}\n"
                                 "    if ((COMP_CWORD == 1)); then\n"
                                 "        _talus_words \"";
static const char bash_middle[] = "\"\n"
                                  "        return\n"
                                  "    fi\n"
                                  "    case ${COMP_WORDS[1]}:$before in\n";
static const char bash_end[] = "    esac\n"
                               "}\n"
                               "complete -o default -F _talus talus\n";

/* ---- zsh ---- */

static void zsh_option(const command *self, const option *o)
{
    (void)self;
    const char *sign = o->kind == OPTION_FLAG ? "" : "=";
    if (o->letter)
        printf(" \\\n        '(-%c --%s)'{-%c%s,--%s%s}'[", o->letter, o->name, o->letter, *sign ? "+" : "", o->name,
               sign);
    else
        printf(" \\\n        '--%s%s[", o->name, sign);
    print_quoted(o->help, "[]:\\");
    putchar(']');
    if (o->argument || o->choices) {
        putchar(':');
        print_quoted(o->argument ? o->argument : o->name, "[]:\\");
        putchar(':');
    }
    if (o->choices) {
        putchar('(');
        print_names(o->choices);
        putchar(')');
    } else if (takes_file(o))
        fputs("_files", stdout);
    putchar('\'');
}

static void zsh_command(const command *self, const option_group *groups)
{
    printf("    %s)\n        _arguments", self->name);
    for_options(self, groups, zsh_option);
    fputs(" \\\n        '*:file:_files' ;;\n", stdout);
}

static void zsh_name(const command *self)
{
    printf("        '%s:", self->name);
    print_quoted(self->summary, "");
    fputs("'\n", stdout);
}

static const char zsh_begin[] = "#compdef talus\n"
                                "_talus() {\n"
                                "    local -a commands\n"
                                "    commands=(\n";
static const char zsh_middle[] = "    )\n"
                                 "    if ((CURRENT == 2)); then\n"
                                 "        _describe command commands\n"
                                 "        return\n"
                                 "    fi\n"
                                 "    local command=$words[2]\n"
                                 "    shift words\n"
                                 "    ((CURRENT--))\n"
                                 "    case $command in\n";
static const char zsh_end[] =
    "    esac\n"
    "}\n"
    "if [[ $zsh_eval_context[-1] == loadautofunc ]]; then _talus \"$@\"; else compdef _talus talus; fi\n";

/* ---- fish ---- */

static void fish_option(const command *self, const option *o)
{
    printf("complete -c talus -n '__fish_seen_subcommand_from %s' -l %s", self->name, o->name);
    if (o->letter)
        printf(" -s %c", o->letter);
    if (o->kind != OPTION_FLAG)
        fputs(takes_file(o) ? " -r" : " -x", stdout);
    if (o->choices) {
        fputs(" -a '", stdout);
        print_names(o->choices);
        putchar('\'');
    }
    fputs(" -d '", stdout);
    print_quoted(o->help, "\\");
    fputs("'\n", stdout);
}

static void fish_name(const command *self)
{
    printf("complete -c talus -n __fish_use_subcommand -f -a %s -d '", self->name);
    print_quoted(self->summary, "\\");
    fputs("'\n", stdout);
}

/* ---- All ---- */

void completions_of_command(command_help help, const command *self, const option_group *groups)
{
    if (help == HELP_FOR_BASH)
        bash_command(self, groups);
    else if (help == HELP_FOR_ZSH)
        zsh_command(self, groups);
    else
        for_options(self, groups, fish_option);
}

static void print_parts(command_help shell, const command *const *commands, size_t count)
{
    for (size_t k = 0; k < count; k++) {
        const char *name = commands[k]->name;
        commands[k]->run(commands[k], 1, &name, shell);
    }
}

static void print_bash(const command *const *commands, size_t count)
{
    fputs(bash_begin, stdout);
    for (size_t k = 0; k < count; k++)
        printf("%s ", commands[k]->name);
    fputs("completions help version", stdout);
    fputs(bash_middle, stdout);
    print_parts(HELP_FOR_BASH, commands, count);
    fputs(bash_end, stdout);
}

static void print_zsh(const command *const *commands, size_t count)
{
    fputs(zsh_begin, stdout);
    for (size_t k = 0; k < count; k++)
        zsh_name(commands[k]);
    fputs(zsh_middle, stdout);
    print_parts(HELP_FOR_ZSH, commands, count);
    fputs(zsh_end, stdout);
}

static void print_fish(const command *const *commands, size_t count)
{
    fputs("# fish completion for talus\n", stdout);
    for (size_t k = 0; k < count; k++)
        fish_name(commands[k]);
    print_parts(HELP_FOR_FISH, commands, count);
}

int completions_print(int argc, const char **argv, const command *const *commands, size_t count)
{
    static const char *const shells[] = {"bash", "zsh", "fish"};
    void (*const print[])(const command *const *, size_t) = {print_bash, print_zsh, print_fish};
    enum { SHELLS = sizeof shells / sizeof *shells };
    for (size_t k = 0; k < SHELLS && argc == 2; k++)
        if (strcmp(argv[1], shells[k]) == 0) {
            print[k](commands, count);
            return command_done();
        }
    complain("a shell is wanted: talus completions bash, zsh or fish");
    return EXIT_USAGE;
}
