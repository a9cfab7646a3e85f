/* The fifth section: what becomes of the stiff and extreme cases. */
#include "cmd/report/cases.h"
#include "cmd/report/report.h"

static void add_case(json_t *table, const report_case *c, const case_result *r)
{
    static const char *const ends[] = {"right", "refused", "failed"};
    json_t *row = report_row(table);
    report_text(row, "group", c->group);
    report_text(row, "name", c->name);
    report_text(row, "verdict", ends[r->end]);
    if (r->end == CASE_RIGHT) {
        report_number(row, "bound", r->bound);
        report_number(row, "found", r->found);
        report_number(row, "low", r->low);
        report_number(row, "high", r->high);
        report_number(row, "samples", (double)r->samples);
        if (c->fov > 0)
            report_number(row, "triangles", (double)r->triangles);
    }
    report_number(row, "milliseconds", 1e3 * r->seconds);
    report_text(row, "remark", r->text);
}

static tl_status add_precision(json_t *section, tl_error *error)
{
    json_t *table = report_table(section, "precision", "Single precision against long double",
                                 "Heights within delta of 0, refined as deep as this: the field in single precision "
                                 "against the same recursion in long double with the same noise.");
    report_column(table, "name", "case", "");
    report_column(table, "levels", "levels", "");
    report_column(table, "bound", "bound", "delta");
    report_column(table, "found", "largest difference", "delta");
    report_column(table, "samples", "samples looked at", "");
    report_column(table, "verdict", "end", "");
    report_column(table, "milliseconds", "time", "ms");
    for (const report_depth *d = report_depths; d->name; d++) {
        tl_precision found;
        double start = progress_clock();
        tl_status status = tl_precision_measure(&d->options, &found, error);
        if (status != TL_OK)
            return status;
        json_t *row = report_row(table);
        report_text(row, "name", d->name);
        report_number(row, "levels", d->options.levels);
        report_number(row, "bound", REPORT_ROUNDING);
        report_number(row, "found", found.largest / d->options.delta);
        report_number(row, "samples", (double)found.samples);
        report_text(row, "verdict", found.largest <= REPORT_ROUNDING * d->options.delta ? "right" : "failed");
        report_number(row, "milliseconds", 1e3 * (progress_clock() - start));
    }
    return TL_OK;
}

tl_status report_stability(report *self, tl_error *error)
{
    json_t *section = report_section(self, "stability", "Stability: stiff and extreme cases",
                                     "Scales that lie far apart in one scene, and models that hardly are any. Each "
                                     "case is simplified under two bounds that "
                                     "are measured anew, refined, looked at for heights that are not there or not "
                                     "finite and for the model's own samples or "
                                     "means, and, where it is a view, seen by all three selectors; within 256 MB. Each "
                                     "must end right, or in one clear "
                                     "error.");
    json_t *table = report_table(section, "cases", "Cases", "");
    report_column(table, "group", "what is extreme", "");
    report_column(table, "name", "case", "");
    report_column(table, "verdict", "end", "");
    report_column(table, "bound", "bound", "units of height");
    report_column(table, "found", "largest error found", "units of height");
    report_column(table, "low", "lowest of the field", "units of height");
    report_column(table, "high", "highest", "units of height");
    report_column(table, "samples", "samples looked at", "");
    report_column(table, "triangles", "triangles", "");
    report_column(table, "milliseconds", "time", "ms");
    report_column(table, "remark", "remark", "");
    progress_stage(self->bar, "report: stability");
    for (const report_case *c = report_cases; c->name; c++) {
        case_result found;
        if (self->run->cancel && *self->run->cancel) {
            error->status = TL_ERROR_CANCELLED;
            error->text[0] = 0;
            return TL_ERROR_CANCELLED;
        }
        tl_run run = {.threads = self->run->threads, .cancel = self->run->cancel};
        report_run_case(c, &run, &found);
        add_case(table, c, &found);
    }
    return add_precision(section, error);
}
