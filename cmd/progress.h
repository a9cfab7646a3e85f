/* Progress and interruption of one command. */
#ifndef CMD_PROGRESS_H
#define CMD_PROGRESS_H

#include "lib/talus.h"

typedef enum progress_style { PROGRESS_BAR, PROGRESS_JSON, PROGRESS_NONE } progress_style;

typedef struct progress {
    progress_style style;
    bool drawn;       /* a bar stands on the terminal's line */
    const char *what; /* "synthesis", "framework" */
    double started;   /* seconds, monotonic */
} progress;

/* A tl_run with `threads` workers that reports to `self` and ends on SIGINT and SIGTERM. A bar is drawn only where
 * stderr is a terminal. */
tl_run progress_run(progress *self, progress_style style, unsigned threads);
/* Starts a stage. */
void progress_stage(progress *self, const char *what);
/* Removes the bar; seconds since the stage began. */
double progress_end(progress *self);

/* Catches SIGINT and SIGTERM: the first raises the flag of every progress_run, the second ends the process. */
void progress_catch_signals(void);
bool progress_interrupted(void);
double progress_clock(void);

#endif
