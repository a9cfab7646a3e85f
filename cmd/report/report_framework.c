/* The first section: what a bound costs, and whether it holds. */
#include "cmd/report/report.h"

#include <math.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

enum { BOUNDS = 8, RUNS_QUICK = 3, RUNS = 5 };

/* 1, 2 or 5 times a power of ten, not above. */
static double round_down(double value)
{
    double power = pow(10, floor(log10(value)));
    return power * (value >= 5 * power ? 5 : value >= 2 * power ? 2 : 1);
}

/* Bounds that rise from a thousandth of the relief to a tenth. */
static size_t choose_bounds(const tl_range *range, double out[BOUNDS])
{
    double relief = (double)range->high - (double)range->low;
    size_t count = 0;
    for (double share = 1e-3; share < 0.15 && count < BOUNDS && relief > 0; share *= 2) {
        double bound = round_down(share * relief);
        if (!count || bound > out[count - 1])
            out[count++] = bound;
    }
    return count;
}

/* Bytes of the mesh as a GLB; NaN where it cannot be written as one. */
static double measure_file(const report *self, const tl_mesh *mesh)
{
    char path[4200];
    tl_error ignored;
    struct stat there;
    snprintf(path, sizeof path, "%s/framework.glb", self->folder);
    tl_write_options options = {.run = self->run};
    double bytes = (double)NAN;
    if (tl_write_mesh(mesh, path, &options, &ignored) == TL_OK && stat(path, &there) == 0)
        bytes = (double)there.st_size;
    unlink(path);
    return bytes;
}

static tl_status add_row(report *self, json_t *table, tl_mesh_kind kind, double bound, tl_error *error)
{
    static const char *const names[] = {"quadtree", "tin"};
    tl_run alone = *self->run;
    alone.threads = 1;
    tl_simplify_options options = {.max_error = bound, .frame = TL_FRAME_PROJECTED, .kind = kind, .run = &alone};
    measured seconds = {.count = 0}, each = {.count = 0};
    tl_mesh *mesh = NULL;
    tl_mesh_report found;
    double samples = (double)self->dem->info.width * (double)self->dem->info.height, used = 0;
    size_t runs = self->quick ? RUNS_QUICK : RUNS;
    tl_status status = TL_OK;
    for (size_t k = 0; k < runs && status == TL_OK && (k == 0 || used < 5); k++) {
        tl_mesh_destroy(mesh);
        mesh = NULL;
        double start = progress_clock();
        status = tl_simplify(self->dem, &options, &mesh, NULL, error);
        double taken = progress_clock() - start;
        used += taken;
        measured_add(&seconds, taken);
        measured_add(&each, taken / samples * 1e9);
    }
    if (status == TL_OK)
        status = tl_mesh_verify(mesh, self->dem, self->run, &found, error);
    if (status == TL_OK) {
        json_t *row = report_row(table);
        report_text(row, "mesh", names[kind]);
        report_number(row, "bound", bound);
        report_number(row, "triangles", (double)mesh->triangle_count);
        report_number(row, "largest", found.max_error);
        report_number(row, "rms", found.rms_error);
        report_number(row, "samples", (double)found.samples);
        report_measured(row, "seconds", &seconds);
        report_measured(row, "each", &each);
        report_number(row, "bytes", measure_file(self, mesh));
        report_text(row, "verdict", found.max_error <= bound ? "kept" : "failed");
    }
    tl_mesh_destroy(mesh);
    return status;
}

static void add_columns(json_t *table, const char *unit)
{
    report_column(table, "mesh", "mesh", "");
    report_column(table, "bound", "bound", unit);
    report_column(table, "triangles", "triangles", "");
    report_column(table, "largest", "largest error found", unit);
    report_column(table, "rms", "rms error", unit);
    report_column(table, "samples", "samples compared", "");
    report_column(table, "seconds", "time", "s");
    report_column(table, "each", "time a sample", "ns");
    report_column(table, "bytes", "GLB", "bytes");
    report_column(table, "verdict", "bound", "");
}

/* The pyramid of errors, from which every bound is taken out. */
static tl_status add_pyramid(report *self, json_t *section, const double *bounds, size_t count, const char *unit,
                             tl_error *error)
{
    json_t *table = report_table(section, "pyramid", "All bounds from one pyramid of errors",
                                 "Made once in the first row's time; each framework is taken out of it in its own.");
    report_column(table, "what", "step", "");
    report_column(table, "bound", "bound", unit);
    report_column(table, "points", "points", "");
    report_column(table, "seconds", "time", "s");
    tl_run alone = *self->run;
    alone.threads = 1;
    tl_pyramid_options options = {.frame = TL_FRAME_PROJECTED, .run = &alone};
    double start = progress_clock();
    tl_pyramid *pyramid = tl_pyramid_create(self->dem, &options, error);
    if (!pyramid)
        return error->status;
    json_t *row = report_row(table);
    report_text(row, "what", "pyramid");
    report_number(row, "seconds", progress_clock() - start);
    tl_status status = TL_OK;
    for (size_t k = 0; k < count && status == TL_OK; k++) {
        tl_selection selection = {.max_error = bounds[k], .run = &alone};
        start = progress_clock();
        tl_framework *framework = tl_framework_from_pyramid(pyramid, self->dem, &selection, error);
        status = framework ? TL_OK : error->status;
        if (framework) {
            row = report_row(table);
            report_text(row, "what", "framework");
            report_number(row, "bound", bounds[k]);
            report_number(row, "points", (double)tl_framework_point_count(framework));
            report_number(row, "seconds", progress_clock() - start);
        }
        tl_framework_destroy(framework);
    }
    tl_pyramid_destroy(pyramid);
    return status;
}

tl_status report_framework(report *self, tl_error *error)
{
    double bounds[BOUNDS];
    tl_range range;
    const char *unit = self->dem->info.georef.height_unit == 1 ? "m" : "units of height";
    json_t *section = report_section(self, "framework", "Framework: bound, triangles and time",
                                     "The elevation model simplified under bounds on the vertical error. The error is "
                                     "measured anew, at every sample, "
                                     "by going over the finished mesh triangle by triangle.");
    json_t *table = report_table(section, "bounds", "Meshes of two kinds",
                                 "A quadtree's triangles are halved squares; a tin's vertices are any samples.");
    add_columns(table, unit);
    progress_stage(self->bar, "report: framework");
    tl_status status = tl_source_range(self->dem, self->run, &range, error);
    size_t count = status == TL_OK ? choose_bounds(&range, bounds) : 0;
    for (int kind = TL_MESH_QUADTREE; kind <= TL_MESH_TIN; kind++)
        for (size_t k = 0; k < count && status == TL_OK; k++)
            status = add_row(self, table, (tl_mesh_kind)kind, bounds[k], error);
    report_add_plot(table, &(report_plot){"framework_triangles", "Triangles by bound", "bound", "triangles", "mesh",
                                          true, true, false});
    report_add_plot(table, &(report_plot){"framework_error", "Largest error found, by triangles", "triangles",
                                          "largest", "mesh", true, true, false});
    report_add_plot(table, &(report_plot){"framework_time", "Largest error found, by time", "seconds", "largest",
                                          "mesh", true, true, false});
    return status == TL_OK ? add_pyramid(self, section, bounds, count, unit, error) : status;
}
