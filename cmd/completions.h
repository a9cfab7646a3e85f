/* Completion of command lines in shells, made from the tables of commands and options. */
#ifndef CMD_COMPLETIONS_H
#define CMD_COMPLETIONS_H

#include "cmd/command.h"

/* `talus completions bash|zsh|fish`: prints what the shell reads; an exit status. */
int completions_print(int argc, const char **argv, const command *const *commands, size_t count);

/* Prints one command's part, for the shell that `help` names. */
void completions_of_command(command_help help, const command *self, const option_group *groups);

#endif
