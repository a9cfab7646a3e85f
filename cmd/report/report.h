/* What `talus report` finds: sections of tables, whose numbers know their unit, their spread and how many measurements
 * they are of; and how these become a page, JSON, CSV and plots.
 *
 * Everything is kept as JSON from the start (doc/report.schema.json): a section is {key, title, text, tables}, a table
 * {key, title, note, columns: [{key, title, unit}], rows: [{key: value}], plots}. A value is a text, a number, null
 * (not known), or {value, low, high, count}: the median of `count` measurements, and the range they lie in. */
#ifndef CMD_REPORT_REPORT_H
#define CMD_REPORT_REPORT_H

#include "cmd/progress.h"
#include "lib/talus.h"

#include <jansson.h>

typedef struct report {
    json_t *root;
    const tl_source *dem; /* what is reported on */
    const tl_run *run;
    progress *bar;
    const char *folder;
    bool quick;
} report;

/* ---- Building: what memory does not hold is left out, and the report then fails as a whole ---- */

bool report_init(report *self, const char *title);
void report_finish(report *self);
json_t *report_section(report *self, const char *key, const char *title, const char *text);
/* A table that says why the rest of the last section is missing. */
void report_remark(report *self, const char *key, const char *text);
json_t *report_table(json_t *section, const char *key, const char *title, const char *note);
/* `unit` may be "": a count, a share or a text. */
void report_column(json_t *table, const char *key, const char *title, const char *unit);
json_t *report_row(json_t *table);
void report_text(json_t *row, const char *key, const char *text);
/* Null where it is not finite. */
void report_number(json_t *row, const char *key, double value);

/* A member that is a text; "" where it is none. */
const char *report_text_of(const json_t *object, const char *key);

/* A curve for each text of the column `series`, or one where it is NULL. */
typedef struct report_plot {
    const char *key, *title, *x, *y, *series;
    bool log_x, log_y, points; /* points: not joined by lines */
} report_plot;
void report_add_plot(json_t *table, const report_plot *plot);

/* ---- Repeated measurements ---- */

enum { MEASURED = 64 };
typedef struct measured {
    double values[MEASURED];
    size_t count;
} measured;

/* Takes a value; beyond MEASURED of them nothing. */
void measured_add(measured *m, double value);
double measured_mean(const measured *m);
/* Standard deviation; 0 of fewer than two. */
double measured_deviation(const measured *m);
/* Median, range and count. */
void report_measured(json_t *row, const char *key, measured *m);

/* ---- Sections ---- */

tl_status report_framework(report *self, tl_error *error);
tl_status report_field(report *self, tl_error *error);
tl_status report_amplification(report *self, tl_error *error);
tl_status report_view(report *self, tl_error *error);
tl_status report_stability(report *self, tl_error *error);
/* What the report was made with: the program, the machine and the model. */
void report_describe(report *self, int argc, const char **argv);

/* ---- Writing into the folder ---- */

/* A CSV for each plot, and a picture of it where gnuplot is there: *drawn. The pictures' texts go into `plots` as
 * {key: SVG}. */
tl_status report_draw(const report *self, json_t *plots, bool *drawn, tl_error *error);
tl_status report_write_json(const report *self, tl_error *error);
tl_status report_write_page(const report *self, const json_t *plots, tl_error *error);
/* Writes a file of the folder: it appears when it is complete. */
tl_status report_write_file(const report *self, const char *name, const char *text, tl_error *error);

#endif
