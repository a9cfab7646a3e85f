#include "dem/control_grid.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

enum { STENCIL = 4, FIRST_CELLS = 4, MAX_CELLS = 1 << 14 };

struct dem_control_grid {
    size_t components;
    int across, down; /* cells; nodes are one more */
    double x, y, step_x, step_y;
    double error;
    double *values; /* nodes row by row, `components` each */
};

/* Cubic Lagrange weights of the nodes 0, 1, 2, 3 at t. */
static void lagrange(double t, double w[STENCIL])
{
    double a = t - 1, b = t - 2, c = t - 3;
    w[0] = -(a * b * c) / 6;
    w[1] = t * b * c / 2;
    w[2] = -(t * a * c) / 2;
    w[3] = t * a * b / 6;
}

/* The first node of the stencil for position u, in cells: its cell in the middle, but for the rim. */
static int stencil_of(double u, int cells)
{
    int first = (int)floor(u) - 1, last = cells + 1 - STENCIL;
    return first < 0 ? 0 : first > last ? last : first;
}

/* The four columns of a stencil, each combined along the rows by the weights of one j. */
static inline void combine(const dem_control_grid *grid, size_t components, int column, int row,
                           const double wy[STENCIL], double *out)
{
    size_t stride = ((size_t)grid->across + 1) * components;
    const double *v = grid->values + (size_t)row * stride + (size_t)column * components;
    for (size_t k = 0; k < STENCIL * components; k++)
        out[k] = wy[0] * v[k] + wy[1] * v[k + stride] + wy[2] * v[k + 2 * stride] + wy[3] * v[k + 3 * stride];
}

/* Inlined with a constant number of components. */
static inline void apply(const dem_control_grid *grid, size_t components, size_t n, const double *i, const double *j,
                         double *out)
{
    double columns[STENCIL * DEM_CONTROL_COMPONENTS] = {0}, last_j = (double)NAN;
    int last_column = -1;
    for (size_t k = 0; k < n; k++, out += components) {
        double u = (i[k] - grid->x) / grid->step_x, wx[STENCIL];
        int column = stencil_of(u, grid->across);
        if (column != last_column || j[k] != last_j) {
            double v = (j[k] - grid->y) / grid->step_y, wy[STENCIL];
            int row = stencil_of(v, grid->down);
            lagrange(v - row, wy);
            combine(grid, components, column, row, wy, columns);
            last_column = column;
            last_j = j[k];
        }
        lagrange(u - column, wx);
        for (size_t c = 0; c < components; c++)
            out[c] = wx[0] * columns[c] + wx[1] * columns[c + components] + wx[2] * columns[c + 2 * components] +
                     wx[3] * columns[c + 3 * components];
    }
}

void dem_control_grid_apply(const dem_control_grid *grid, size_t n, const double *i, const double *j, double *out)
{
    switch (grid->components) {
    case 1:
        apply(grid, 1, n, i, j, out);
        break;
    case 2:
        apply(grid, 2, n, i, j, out);
        break;
    case 6:
        apply(grid, 6, n, i, j, out);
        break;
    default:
        apply(grid, grid->components, n, i, j, out);
    }
}

double dem_control_grid_error(const dem_control_grid *grid)
{
    return grid->error;
}

void dem_control_grid_destroy(dem_control_grid *grid)
{
    if (!grid)
        return;
    free(grid->values);
    free(grid);
}

/* Positions of a row of `count` points, the first at (x, y). */
static void fill_row(double *i, double *j, int count, double x, double y, double step)
{
    for (int k = 0; k < count; k++) {
        i[k] = x + k * step;
        j[k] = y;
    }
}

static bool sample_nodes(dem_control_grid *grid, const dem_control_function *f, double *i, double *j)
{
    size_t row = ((size_t)grid->across + 1) * f->components;
    for (int r = 0; r <= grid->down; r++) {
        fill_row(i, j, grid->across + 1, grid->x, grid->y + r * grid->step_y, grid->step_x);
        f->evaluate(f->context, (size_t)grid->across + 1, i, j, grid->values + (size_t)r * row);
    }
    for (size_t k = 0; k < row * ((size_t)grid->down + 1); k++)
        if (!isfinite(grid->values[k]))
            return false;
    return true;
}

/* The largest error in the cells' middles; infinite where the function is not finite. `scratch`: two rows of values. */
static double measure(const dem_control_grid *grid, const dem_control_function *f, double *i, double *j,
                      double *scratch)
{
    double worst = 0, *truth = scratch, *made = scratch + (size_t)grid->across * f->components;
    for (int r = 0; r < grid->down; r++) {
        fill_row(i, j, grid->across, grid->x + grid->step_x / 2, grid->y + (r + 0.5) * grid->step_y, grid->step_x);
        f->evaluate(f->context, (size_t)grid->across, i, j, truth);
        dem_control_grid_apply(grid, (size_t)grid->across, i, j, made);
        for (int k = 0; k < grid->across; k++) {
            double sum = 0;
            for (size_t c = 0; c < f->components; c++)
                sum += f->weights[c] * fabs(truth[(size_t)k * f->components + c] - made[(size_t)k * f->components + c]);
            if (!isfinite(sum))
                return (double)INFINITY;
            worst = fmax(worst, sum);
        }
    }
    return worst;
}

/* One attempt; *done tells whether it is good enough or hopeless. */
static tl_status attempt(dem_control_grid *grid, const dem_control_function *f, bool *good, bool *done, tl_error *error)
{
    size_t across = (size_t)grid->across + 1;
    grid->values = tl_alloc_grid((int64_t)across, grid->down + 1, f->components * sizeof(double));
    double *scratch = tl_alloc(across, (2 * f->components + 2) * sizeof(double));
    tl_status status = grid->values && scratch ? TL_OK : tl_fail_memory(error, "a control grid");
    if (status == TL_OK) {
        double *i = scratch, *j = scratch + across;
        bool finite = sample_nodes(grid, f, i, j);
        grid->error = finite ? measure(grid, f, i, j, scratch + 2 * across) : (double)INFINITY;
        *good = grid->error <= f->tolerance / 2;
        *done = *good || !isfinite(grid->error);
    }
    free(scratch);
    return status;
}

tl_status dem_control_grid_create(const dem_control_function *function, tl_window window, size_t budget,
                                  dem_control_grid **out, tl_error *error)
{
    dem_control_grid *grid = calloc(1, sizeof *grid);
    if (!grid)
        return tl_fail_memory(error, "a control grid");
    bool good = false, done = false;
    tl_status status = TL_OK;
    grid->components = function->components;
    grid->x = (double)window.x;
    grid->y = (double)window.y;
    for (int cells = FIRST_CELLS; status == TL_OK && !done && cells <= MAX_CELLS; cells *= 2) {
        size_t cost = 2 * (size_t)cells * (size_t)cells;
        if (cost > budget)
            break;
        budget -= cost;
        grid->across = grid->down = cells;
        /* a window of one column or row has no extent, but any step will do for it */
        grid->step_x = (double)tl_int64_max(window.width - 1, 1) / cells;
        grid->step_y = (double)tl_int64_max(window.height - 1, 1) / cells;
        free(grid->values);
        grid->values = NULL;
        status = attempt(grid, function, &good, &done, error);
    }
    if (status != TL_OK || !good) {
        dem_control_grid_destroy(grid);
        grid = NULL;
    }
    if (status == TL_OK)
        *out = grid;
    return status;
}
