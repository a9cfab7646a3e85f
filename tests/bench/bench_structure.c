/* Deviation of the structure function from fractional Brownian motion, by exact covariance, for every scheme: the table
 * of doc/accuracy.md. No sampling, so no spread. */
#include "fbm/covariance.h"
#include "tests/bench/bench.h"

#include <stdio.h>

enum { LEVELS = 4, CELLS = 2 };

/* Cells that are not square, 3 levels (2 where rows are halved twice). */
static int print_aspects(void)
{
    static const double hursts[] = {0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 0.99},
                        aspects[] = {1.3, 0.85, 0.72, 0.5, 0.36, 0.3, 0.25, 0.2};
    printf("pointwise deviation in %% by aspect (rows) and H\n%6s", "");
    for (size_t h = 0; h < sizeof hursts / sizeof *hursts; h++)
        printf(" %8.2f", hursts[h]);
    for (size_t a = 0; a < sizeof aspects / sizeof *aspects; a++) {
        int halvings = fbm_aspect_halvings(aspects[a]);
        printf("\n%6.2f", aspects[a]);
        for (size_t h = 0; h < sizeof hursts / sizeof *hursts; h++) {
            fbm_row_weights rows[2];
            fbm_weights weights;
            fbm_deviation d;
            double values[FBM_WEIGHT_VALUES];
            for (int k = 0; k < halvings; k++) {
                fbm_values_rows(hursts[h], aspects[a] * (1 << k), halvings == 2 && k == 0, values);
                fbm_row_weights_round(values, &rows[k]);
            }
            fbm_values_stationary(hursts[h], aspects[a] * (1 << halvings), values);
            fbm_weights_round(values, &weights);
            fbm_refinement r = {fbm_schemes, hursts[h], aspects[a], &weights, halvings, rows};
            if (fbm_refinement_deviation(&r, halvings == 2 ? 2 : 3, halvings ? 1 : 2, &d) != FBM_OK)
                return 1;
            printf(" %8.3f", 100 * d.point);
        }
    }
    puts("");
    return 0;
}

int main(void)
{
    static const double hursts[] = {0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 0.99};
    bench_print_machine();
    printf("%d levels, %d cells; deviations in %%\n%-14s %5s %10s %10s %12s %8s\n", LEVELS, CELLS, "scheme", "H",
           "pointwise", "mean", "mean scaled", "ratio");
    for (const fbm_scheme *scheme = fbm_schemes; scheme->name; scheme++)
        for (size_t k = 0; k < sizeof hursts / sizeof *hursts; k++) {
            fbm_weights weights;
            fbm_deviation d;
            scheme->weights(hursts[k], &weights);
            if (fbm_structure_deviation(scheme, &weights, hursts[k], LEVELS, CELLS, &d) != FBM_OK)
                return 1;
            printf("%-14s %5.2f %10.4f %10.4f %12.4f %8.4f\n", scheme->name, hursts[k], 100 * d.point, 100 * d.mean,
                   100 * d.mean_scaled, d.ratio);
        }
    return print_aspects();
}
