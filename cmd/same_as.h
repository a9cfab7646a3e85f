/* Making an output once more, by the record in it. */
#ifndef CMD_SAME_AS_H
#define CMD_SAME_AS_H

#include "cmd/command.h"

/* Parses the options that are recorded in the file `same_as`, and then the command line's own over them, into the
 * groups' targets; *rest, as options_parse left it, is made anew, with the recorded inputs where the command line has
 * none. Files of the record are looked for here, then beside `same_as`. False, told: there is no record, it is of
 * another command, or a file of it is not found. */
bool same_as_parse(const command *self, const char *same_as, int argc, const char **argv, const option_group *groups,
                   arguments *rest);

/* Whether the output is the very file that is to be made again: then told. */
bool same_as_is_output(const char *same_as, const common *shared);

/* Whether the output is what it was: told; an exit status. Of a preset's tiles, that of the same name. One that is not
 * goes, with all of `files`, what the run wrote. Only where the record is the same and both are of one format, else
 * nothing is compared. */
int same_as_compare(const char *same_as, const common *shared, const arguments *rest, char *const *files, size_t count);

#endif
