/* How steep the triangles of each size are: the largest over the whole raster, whether they will be drawn or not. */
#include "dem/framework.h"

#include "lib/base/error.h"
#include "lib/base/parallel.h"
#include "lib/base/size.h"

#include <math.h>
#include <string.h>

/* Largest differences at one side S of squares: of the ends of horizontal and of vertical sides, and of the centre from
 * the middle of a side. */
typedef struct differences {
    float across, down, inwards;
} differences;

typedef struct riser {
    const float *heights;
    int64_t width, height, side;
    differences *found; /* by worker */
} riser;

static inline float larger(float a, float b)
{
    return a > b ? a : b; /* b where a is not a number, and b never is */
}

static inline float at(const riser *self, int64_t x, int64_t y)
{
    return x < self->width && y < self->height ? self->heights[y * self->width + x] : NAN;
}

static void measure_cells(const riser *self, int64_t y, differences *out)
{
    const float *z = self->heights + y * self->width;
    for (int64_t x = 0; x + 1 < self->width; x++)
        out->across = larger(fabsf(z[x + 1] - z[x]), out->across);
    for (int64_t x = 0; y + 1 < self->height && x < self->width; x++)
        out->down = larger(fabsf(z[x + self->width] - z[x]), out->down);
}

static void measure_squares(const riser *self, int64_t y, differences *out)
{
    int64_t side = self->side, s = side / 2;
    for (int64_t x = 0; x < self->width; x += side) {
        float a = at(self, x, y), b = at(self, x + side, y), c = at(self, x, y + side),
              d = at(self, x + side, y + side);
        float middle = at(self, x + s, y + s);
        out->across = larger(fabsf(b - a), out->across);
        out->down = larger(fabsf(c - a), out->down);
        out->inwards = larger(fabsf(middle - 0.5F * (a + b)), out->inwards);
        out->inwards = larger(fabsf(middle - 0.5F * (c + d)), out->inwards);
        out->inwards = larger(fabsf(middle - 0.5F * (a + c)), out->inwards);
        out->inwards = larger(fabsf(middle - 0.5F * (b + d)), out->inwards);
    }
}

static tl_status measure_row(void *context, tl_parallel *loop, uint64_t item, unsigned worker, tl_error *error)
{
    riser *self = context;
    differences *out = &self->found[worker], own = *out;
    (void)loop;
    (void)error;
    if (self->side == 1)
        measure_cells(self, (int64_t)item, &own);
    else
        measure_squares(self, (int64_t)item * self->side, &own);
    *out = own;
    return TL_OK;
}

/* All differences at one side. */
static tl_status measure(riser *self, unsigned workers, const tl_run *run, differences *out, tl_error *error)
{
    memset(self->found, 0, workers * sizeof *self->found);
    tl_status status = tl_parallel_for(run, (uint64_t)tl_div_up(self->height, self->side), 0, measure_row, self, error);
    *out = (differences){0};
    for (unsigned i = 0; i < workers; i++) {
        out->across = larger(self->found[i].across, out->across);
        out->down = larger(self->found[i].down, out->down);
        out->inwards = larger(self->found[i].inwards, out->inwards);
    }
    return status;
}

tl_status tl_framework_rises(const float *heights, int64_t width, int64_t height, int lattice_log, const tl_run *run,
                             double rises[TL_SIZES], tl_error *error)
{
    unsigned workers = tl_parallel_workers(run, (uint64_t)height);
    riser self = {heights, width, height, 1, calloc(workers, sizeof *self.found)};
    tl_status status = self.found ? TL_OK : tl_fail_memory(error, "the framework");
    memset(rises, 0, TL_SIZES * sizeof *rises);
    for (int log = 0; status == TL_OK && log <= lattice_log; log++) {
        differences found;
        self.side = INT64_C(1) << log;
        status = measure(&self, workers, run, &found, error);
        double side = (double)self.side, across = (double)found.across / side, down = (double)found.down / side;
        rises[2 * log] = hypot(across, down); /* legs of a side's length */
        if (log)                              /* a side for a hypotenuse, and the right angle in the centre */
            rises[2 * log - 1] = hypot(fmax(across, down), (double)found.inwards / (side / 2));
    }
    free(self.found);
    return status;
}
