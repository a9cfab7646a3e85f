/* Prints the table of fbm/weights.c as fbm/tune.h derives it, beside what the table has now: `ninja weights-table` in
 * the build folder. Takes some 20 minutes, or, by `tests/weights_table H ...`, less for the rows of these exponents
 * alone. */
#include "fbm/tune.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

static bool is_asked_for(int argc, char **argv, double hurst)
{
    for (int k = 1; k < argc; k++)
        if (fabs(strtod(argv[k], NULL) - hurst) < 1e-9)
            return true;
    return argc == 1;
}

int main(int argc, char **argv)
{
    fbm_table_row row, derived;
    printf("/* Worst deviations of the structure function, in %%, at the lags that are tuned and at those held out:\n"
           " * of this row, and of the same one in the table now.\n *\n * H, w0 ... w3, t0 ... t2 */\n");
    for (int k = 0; fbm_table_row_at(k, &row); k++) {
        fbm_tuning now, then;
        if (!is_asked_for(argc, argv, row.hurst))
            continue;
        if (fbm_tune(row.hurst, 3, 4, &derived) != FBM_OK || fbm_tune_measure(&derived, &now) != FBM_OK ||
            fbm_tune_measure(&row, &then) != FBM_OK)
            return 1;
        const double *w = derived.w, *t = derived.t;
        printf("{%g, %.9g, %.9g, %.9g, %.9g, %.9g, %.9g, %.9g}, /* %.3f %.3f, %.3f %.3f */\n", row.hurst, w[0], w[1],
               w[2], w[3], t[0], t[1], t[2], 100 * now.tuned, 100 * now.held_out, 100 * then.tuned,
               100 * then.held_out);
        fflush(stdout);
    }
    return 0;
}
