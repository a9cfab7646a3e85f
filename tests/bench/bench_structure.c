/* Deviation of the structure function from fractional Brownian motion, by exact covariance, for every scheme: the table
 * of doc/accuracy.md. No sampling, so no spread. */
#include "fbm/covariance.h"
#include "tests/bench/bench.h"

#include <stdio.h>

enum { LEVELS = 4, CELLS = 2 };

int main(void)
{
    static const double hursts[] = {0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 0.99};
    bench_print_machine();
    printf("%d levels, %d cells; deviations in %%\n%-12s %5s %10s %10s %12s %8s\n", LEVELS, CELLS, "scheme", "H",
           "pointwise", "mean", "mean scaled", "ratio");
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++)
        for (size_t k = 0; k < sizeof hursts / sizeof *hursts; k++) {
            fbm_weights weights;
            fbm_deviation d;
            scheme->weights(hursts[k], &weights);
            if (fbm_structure_deviation(scheme, &weights, hursts[k], LEVELS, CELLS, &d) != FBM_OK)
                return 1;
            printf("%-12s %5.2f %10.4f %10.4f %12.4f %8.4f\n", scheme->name, hursts[k], 100 * d.point, 100 * d.mean,
                   100 * d.mean_scaled, d.ratio);
        }
    return 0;
}
