/* A command line told again: what of it decides the bytes of the output, so that they can be made once more.
 *
 * "synth --levels 2 --seed 7 dem.tif": the command's name, the options whose values are not the defaults, in the order
 * of the help, and the inputs without their folders. Where the command runs, how fast and into which file is left out,
 * so that equal work has equal records. */
#ifndef CMD_RECORD_H
#define CMD_RECORD_H

#include "cmd/options.h"

#include <stdint.h>

/* What an option's target holds. */
typedef union option_value {
    bool flag;
    int choice;
    int64_t integers[4];
    double numbers[4];
    const char *text;
} option_value;

/* Bytes of a target. */
size_t record_value_size(const option *o);
/* Whether an option of this name changes no byte of the output, so that records do not hold it. */
bool record_leaves_out(const char *name);
/* Takes down what the targets hold before parsing. */
void record_values(const option *const *options, size_t count, option_value *out);
/* To be freed; NULL when out of memory. */
char *record_make(const char *command, const option *const *options, size_t count, const option_value *before,
                  const arguments *rest);

#endif
