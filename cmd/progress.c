#include "cmd/progress.h"

#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { BAR_WIDTH = 28 };

static volatile int interrupted;

static void on_signal(int number)
{
    (void)number;
    __atomic_store_n(&interrupted, 1, __ATOMIC_RELAXED);
}

void progress_catch_signals(void)
{
    struct sigaction action = {.sa_handler = on_signal,
                               .sa_flags = (int)SA_RESETHAND}; /* a second one ends the process */
    sigemptyset(&action.sa_mask);
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    signal(SIGPIPE, SIG_IGN); /* a closed stdout is found when it is flushed, and told as an error */
    signal(SIGXFSZ, SIG_IGN); /* so is a file above the limit of the shell's ulimit -f */
}

bool progress_interrupted(void)
{
    return __atomic_load_n(&interrupted, __ATOMIC_RELAXED);
}

double progress_clock(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void draw_bar(progress *self, uint64_t done, uint64_t total)
{
    double share = total ? (double)done / (double)total : 1, seconds = progress_clock() - self->started;
    char bar[BAR_WIDTH + 1];
    int filled = (int)(share * BAR_WIDTH);
    memset(bar, '#', (size_t)filled);
    memset(bar + filled, '.', (size_t)(BAR_WIDTH - filled));
    bar[BAR_WIDTH] = '\0';
    double rate = seconds > 0 ? (double)done / seconds / 1e6 : 0;
    fprintf(stderr, "\r\033[K%s [%s] %3d %%  %.1f M samples/s", self->what, bar, (int)(100 * share), rate);
    if (share > 0 && share < 1)
        fprintf(stderr, "  %.0f s left", seconds * (1 - share) / share);
    fflush(stderr);
    self->drawn = true;
}

static void report(void *user, uint64_t done, uint64_t total)
{
    progress *self = user;
    if (self->style == PROGRESS_BAR)
        draw_bar(self, done, total);
    else
        fprintf(stderr, "{\"stage\":\"%s\",\"done\":%llu,\"total\":%llu,\"seconds\":%.3f}\n", self->what,
                (unsigned long long)done, (unsigned long long)total, progress_clock() - self->started);
}

tl_run progress_run(progress *self, progress_style style, unsigned threads)
{
    if (style == PROGRESS_BAR && !isatty(STDERR_FILENO))
        style = PROGRESS_NONE;
    *self = (progress){.style = style, .what = "", .started = progress_clock()};
    return (tl_run){
        .threads = threads, .cancel = &interrupted, .progress = style == PROGRESS_NONE ? NULL : report, .user = self};
}

void progress_stage(progress *self, const char *what)
{
    progress_end(self);
    self->what = what;
    self->started = progress_clock();
}

double progress_end(progress *self)
{
    if (self->drawn)
        fputs("\r\033[K", stderr);
    self->drawn = false;
    return progress_clock() - self->started;
}
