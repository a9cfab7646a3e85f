#include "cmd/report/report.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/utsname.h>
#include <time.h>
#include <unistd.h>

/* ---- Building ---- */

bool report_init(report *self, const char *title)
{
    json_t *name = json_string(title);
    self->root = json_pack("{s:s, s:o, s:[]}", "schema", "talus report 1", "title",
                           name ? name : json_string("?") /* no UTF-8 */, "sections");
    return self->root != NULL;
}

void report_finish(report *self)
{
    json_decref(self->root);
    self->root = NULL;
}

json_t *report_section(report *self, const char *key, const char *title, const char *text)
{
    json_t *section = json_pack("{s:s, s:s, s:s, s:[]}", "key", key, "title", title, "text", text, "tables");
    json_array_append_new(json_object_get(self->root, "sections"), section);
    return section;
}

json_t *report_table(json_t *section, const char *key, const char *title, const char *note)
{
    json_t *table = json_pack("{s:s, s:s, s:s, s:[], s:[], s:[]}", "key", key, "title", title, "note", note, "columns",
                              "rows", "plots");
    json_array_append_new(json_object_get(section, "tables"), table);
    return table;
}

void report_remark(report *self, const char *key, const char *text)
{
    char name[64];
    json_t *sections = json_object_get(self->root, "sections");
    snprintf(name, sizeof name, "%s_missing", key);
    json_t *table = report_table(json_array_get(sections, json_array_size(sections) - 1), name,
                                 "What could not be made", "The model, or a part of it, is not for this section.");
    report_column(table, "remark", "remark", "");
    report_text(report_row(table), "remark", text);
}

void report_column(json_t *table, const char *key, const char *title, const char *unit)
{
    json_array_append_new(json_object_get(table, "columns"),
                          json_pack("{s:s, s:s, s:s}", "key", key, "title", title, "unit", unit));
}

json_t *report_row(json_t *table)
{
    json_t *row = json_object();
    json_array_append_new(json_object_get(table, "rows"), row);
    return row;
}

void report_text(json_t *row, const char *key, const char *text)
{
    json_t *value = json_string(text);
    json_object_set_new(row, key, value ? value : json_string("?"));
}

const char *report_text_of(const json_t *object, const char *key)
{
    const char *text = json_string_value(json_object_get(object, key));
    return text ? text : "";
}

void report_number(json_t *row, const char *key, double value)
{
    bool whole = value == floor(value) && fabs(value) < 1e15;
    json_object_set_new(row, key,
                        !isfinite(value) ? json_null()
                        : whole          ? json_integer((json_int_t)value)
                                         : json_real(value));
}

void report_add_plot(json_t *table, const report_plot *plot)
{
    json_array_append_new(json_object_get(table, "plots"),
                          json_pack("{s:s, s:s, s:s, s:s, s:s?, s:b, s:b, s:b}", "key", plot->key, "title", plot->title,
                                    "x", plot->x, "y", plot->y, "series", plot->series, "log_x", plot->log_x, "log_y",
                                    plot->log_y, "points", plot->points));
}

/* ---- Repeated measurements ---- */

void measured_add(measured *m, double value)
{
    if (m->count < MEASURED)
        m->values[m->count++] = value;
}

double measured_mean(const measured *m)
{
    double sum = 0;
    for (size_t k = 0; k < m->count; k++)
        sum += m->values[k];
    return m->count ? sum / (double)m->count : (double)NAN;
}

double measured_deviation(const measured *m)
{
    double mean = measured_mean(m), sum = 0;
    for (size_t k = 0; k < m->count; k++)
        sum += (m->values[k] - mean) * (m->values[k] - mean);
    return m->count > 1 ? sqrt(sum / (double)(m->count - 1)) : 0;
}

static int by_value(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

void report_measured(json_t *row, const char *key, measured *m)
{
    if (!m->count) {
        json_object_set_new(row, key, json_null());
        return;
    }
    qsort(m->values, m->count, sizeof *m->values, by_value);
    double median = .5 * (m->values[(m->count - 1) / 2] + m->values[m->count / 2]);
    json_object_set_new(row, key,
                        json_pack("{s:f, s:f, s:f, s:I}", "value", median, "low", m->values[0], "high",
                                  m->values[m->count - 1], "count", (json_int_t)m->count));
}

/* ---- What it was made with ---- */

/* The processor's name, as Linux has it. */
static void name_processor(char *out, size_t room)
{
    char line[512];
    FILE *file = fopen("/proc/cpuinfo", "r");
    snprintf(out, room, "not known");
    while (file && fgets(line, sizeof line, file)) {
        char *colon = strchr(line, ':');
        if (strncmp(line, "model name", 10) == 0 && colon) {
            line[strcspn(line, "\n")] = 0;
            snprintf(out, room, "%s", colon + 1 + strspn(colon + 1, " "));
            break;
        }
    }
    if (file)
        fclose(file);
}

static json_t *describe_machine(void)
{
    struct utsname name;
    char processor[256];
    bool known = uname(&name) == 0;
    name_processor(processor, sizeof processor);
    double pages = (double)sysconf(_SC_PHYS_PAGES), page = (double)sysconf(_SC_PAGESIZE);
    return json_pack("{s:s, s:I, s:f, s:s, s:s}", "processor", processor, "processors",
                     (json_int_t)sysconf(_SC_NPROCESSORS_ONLN), "memory_gb", pages * page * 1e-9, "architecture",
                     known ? name.machine : "?", "system", known ? name.sysname : "?");
}

static json_t *describe_model(const tl_source_info *info)
{
    json_t *name = json_string(info->name);
    return json_pack("{s:o, s:I, s:I, s:f, s:f, s:s, s:s}", "name", name ? name : json_string("?"), "width",
                     (json_int_t)info->width, "height", (json_int_t)info->height, "cell_x_m", info->georef.cell_x,
                     "cell_y_m", info->georef.cell_y, "raster_type", info->type == TL_RASTER_AREA ? "area" : "point",
                     "crs", info->georef.crs ? tl_crs_name(info->georef.crs) : "not known");
}

void report_describe(report *self, int argc, const char **argv)
{
    char now[32];
    time_t seconds = time(NULL);
    struct tm utc;
    gmtime_r(&seconds, &utc);
    strftime(now, sizeof now, "%Y-%m-%dT%H:%M:%SZ", &utc);
    json_t *command = json_array();
    for (int k = 0; k < argc; k++) {
        json_t *word = json_string(argv[k]);
        json_array_append_new(command, word ? word : json_string("?"));
    }
    json_object_set_new(self->root, "made",
                        json_pack("{s:s, s:s, s:s, s:b, s:I, s:o}", "time", now, "talus", tl_version(), "compiler",
#ifdef __clang__
                                  "clang " __clang_version__,
#else
                                  "gcc " __VERSION__,
#endif
                                  "quick", self->quick, "threads",
                                  (json_int_t)(self->run->threads ? self->run->threads : sysconf(_SC_NPROCESSORS_ONLN)),
                                  "arguments", command));
    json_object_set_new(self->root, "machine", describe_machine());
    json_object_set_new(self->root, "model", describe_model(&self->dem->info));
}

/* ---- Files ---- */

static tl_status no_file(const char *path, const char *what, tl_error *error)
{
    error->status = TL_ERROR_IO;
    int length = (int)sizeof error->text / 2;
    snprintf(error->text, sizeof error->text, "%.*s: cannot be %s: %.100s", length, path, what, strerror(errno));
    return TL_ERROR_IO;
}

tl_status report_write_file(const report *self, const char *name, const char *text, tl_error *error)
{
    char path[4200], part[4216];
    snprintf(path, sizeof path, "%s/%s", self->folder, name);
    snprintf(part, sizeof part, "%s.part", path);
    FILE *file = fopen(part, "w");
    if (!file)
        return no_file(path, "written", error);
    bool good = fputs(text, file) >= 0;
    if (fclose(file) || !good || rename(part, path)) {
        no_file(path, "written", error);
        unlink(part);
        return TL_ERROR_IO;
    }
    return TL_OK;
}

tl_status report_write_json(const report *self, tl_error *error)
{
    char *text = json_dumps(self->root, JSON_INDENT(1) | JSON_REAL_PRECISION(9));
    if (!text) {
        error->status = TL_ERROR_MEMORY;
        snprintf(error->text, sizeof error->text, "%s/report.json: not enough memory", self->folder);
        return TL_ERROR_MEMORY;
    }
    tl_status status = report_write_file(self, "report.json", text, error);
    free(text);
    return status;
}
