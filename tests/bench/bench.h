/* What benchmark programs share: the time of a function, and on what it was measured. */
#ifndef BENCH_H
#define BENCH_H

#include <stddef.h>

/* Prints "# cpu: ...", "# compiler: ..." and "# commit: ..." to stdout. */
void bench_print_machine(void);

/* Seconds of the fastest of `runs` calls of work(context), after one that is not counted: what other processes take
 * only ever adds. */
double bench_minimum(void (*work)(void *context), void *context, int runs);

/* Seconds of the fastest of `runs` copies of `bytes` bytes between two buffers of that size, the yardstick for ratios;
 * 0 when there is no memory for them. */
double bench_copy(size_t bytes, int runs);

#endif
