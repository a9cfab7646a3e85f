#include "tests/bench/bench.h"

#include "bench_commit.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

/* "model name : AMD EPYC" in /proc/cpuinfo */
static void print_cpu(void)
{
    char line[512], *colon = NULL;
    FILE *file = fopen("/proc/cpuinfo", "r");
    while (file && !colon && fgets(line, sizeof line, file))
        if (!strncmp(line, "model name", 10))
            colon = strchr(line, ':');
    if (file)
        fclose(file);
    if (colon)
        line[strcspn(line, "\n")] = 0;
    printf("# cpu: %s\n", colon ? colon + 2 : "unknown");
}

void bench_print_machine(void)
{
    print_cpu();
#ifdef __clang__
    printf("# compiler: %s\n", __VERSION__);
#else
    printf("# compiler: gcc %s\n", __VERSION__);
#endif
    printf("# commit: %s\n", BENCH_COMMIT);
}

static double now(void)
{
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

double bench_minimum(void (*work)(void *context), void *context, int runs)
{
    double best = 0;
    work(context);
    for (int k = 0; k < runs; k++) {
        double begin = now();
        work(context);
        double time = now() - begin;
        if (!k || time < best)
            best = time;
    }
    return best;
}

typedef struct copy {
    void *from, *to;
    size_t bytes;
} copy;

static void run_copy(void *context)
{
    const copy *c = context;
    memcpy(c->to, c->from, c->bytes);
    /* the bytes are used, for all that the compiler knows */
    __asm__ volatile("" : : "r"(c->to) : "memory");
}

double bench_copy(size_t bytes, int runs)
{
    copy c = {malloc(bytes), malloc(bytes), bytes};
    double time = 0;
    if (c.from && c.to) {
        memset(c.from, 1, bytes);
        time = bench_minimum(run_copy, &c, runs);
    }
    free(c.from);
    free(c.to);
    return time;
}
