/* A CSV for each plot, and its picture by gnuplot, which is run as a program of its own. */
#include "cmd/report/report.h"

#include <errno.h>
#include <fcntl.h>
#include <spawn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <unistd.h>

extern char **environ;

enum { SERIES = 32 };

static const json_t *column_of(const json_t *table, const char *key)
{
    size_t k;
    const json_t *column;
    json_array_foreach(json_object_get(table, "columns"), k,
                       column) if (strcmp(report_text_of(column, "key"), key) == 0) return column;
    return NULL;
}

/* The middle, the lower and the upper end; false where it is not known. */
static bool numbers_of(const json_t *value, double out[3])
{
    if (json_is_object(value)) {
        out[0] = json_number_value(json_object_get(value, "value"));
        out[1] = json_number_value(json_object_get(value, "low"));
        out[2] = json_number_value(json_object_get(value, "high"));
        return true;
    }
    out[0] = out[1] = out[2] = json_number_value(value);
    return json_is_number(value);
}

/* The texts of the column that tells curves apart, in the order of the rows. */
static size_t list_series(const json_t *table, const char *key, const char *out[SERIES])
{
    size_t k, count = 0;
    const json_t *row;
    if (!*key) {
        out[0] = "";
        return 1;
    }
    json_array_foreach(json_object_get(table, "rows"), k, row)
    {
        const char *name = report_text_of(row, key);
        size_t at = 0;
        while (at < count && strcmp(out[at], name) != 0)
            at++;
        if (at == count && count < SERIES)
            out[count++] = name;
    }
    return count;
}

/* ---- CSV ---- */

static void put_field(FILE *out, const char *text)
{
    bool quote = strpbrk(text, ",\"\n") != NULL;
    if (quote)
        fputc('"', out);
    for (; *text; text++) {
        if (*text == '"')
            fputc('"', out);
        fputc(*text, out);
    }
    if (quote)
        fputc('"', out);
}

static void put_csv(FILE *out, const json_t *table, const json_t *plot)
{
    size_t k;
    const json_t *row;
    const char *keys[] = {report_text_of(plot, "x"), report_text_of(plot, "y")},
               *series = report_text_of(plot, "series");
    fprintf(out, "%s%s%s,%s,%s_low,%s_high,count\n", series, *series ? "," : "", keys[0], keys[1], keys[1], keys[1]);
    json_array_foreach(json_object_get(table, "rows"), k, row)
    {
        double x[3], y[3];
        const json_t *value = json_object_get(row, keys[1]);
        if (!numbers_of(json_object_get(row, keys[0]), x) || !numbers_of(value, y))
            continue;
        if (*series) {
            put_field(out, report_text_of(row, series));
            fputc(',', out);
        }
        const json_t *count = json_object_get(value, "count");
        fprintf(out, "%.9g,%.9g,%.9g,%.9g,%lld\n", x[0], y[0], y[1], y[2],
                json_is_object(value) ? (long long)json_integer_value(count) : 1);
    }
}

/* ---- Pictures ---- */

/* A text between double quotes of gnuplot's. */
static void put_quoted(FILE *out, const char *text)
{
    fputc('"', out);
    for (; *text; text++) {
        if (*text == '"' || *text == '\\')
            fputc('\\', out);
        fputc(*text, out);
    }
    fputc('"', out);
}

static void put_label(FILE *out, const json_t *table, const char *axis, const char *key)
{
    char label[256];
    const json_t *column = column_of(table, key);
    const char *unit = report_text_of(column, "unit");
    snprintf(label, sizeof label, *unit ? "%s, %s" : "%s", report_text_of(column, "title"), unit);
    fprintf(out, "set %slabel ", axis);
    put_quoted(out, label);
    fputc('\n', out);
}

/* The points of one curve; how many. */
static size_t put_points(FILE *out, const json_t *table, const json_t *plot, const char *name)
{
    size_t k, count = 0;
    const json_t *row;
    const char *series = report_text_of(plot, "series");
    bool logs[2] = {json_is_true(json_object_get(plot, "log_x")), json_is_true(json_object_get(plot, "log_y"))};
    json_array_foreach(json_object_get(table, "rows"), k, row)
    {
        double x[3], y[3];
        if ((*series && strcmp(report_text_of(row, series), name) != 0) ||
            !numbers_of(json_object_get(row, report_text_of(plot, "x")), x) ||
            !numbers_of(json_object_get(row, report_text_of(plot, "y")), y) || (logs[0] && !(x[0] > 0)) ||
            (logs[1] && !(y[1] > 0)))
            continue;
        fprintf(out, "%.9g %.9g %.9g %.9g\n", x[0], y[0], y[1], y[2]);
        count++;
    }
    return count;
}

static void put_script(FILE *out, const json_t *table, const json_t *plot)
{
    const char *names[SERIES];
    size_t count = list_series(table, report_text_of(plot, "series"), names), drawn[SERIES];
    fputs("set terminal svg size 660,420 dynamic noenhanced font \"sans-serif,12\" linewidth 1.2\n"
          "set encoding utf8\nset grid lc rgb \"#cccccc\" lw 0.5\nset key outside right top\nset border 3\nset tics "
          "nomirror\n",
          out);
    fprintf(out, "set terminal svg name \"%s\"\n", report_text_of(plot, "key"));
    put_label(out, table, "x", report_text_of(plot, "x"));
    put_label(out, table, "y", report_text_of(plot, "y"));
    if (json_is_true(json_object_get(plot, "log_x")))
        fputs("set logscale x\nset format x \"%.3g\"\n", out);
    if (json_is_true(json_object_get(plot, "log_y")))
        fputs("set logscale y\nset format y \"%.3g\"\n", out);
    size_t some = 0;
    for (size_t k = 0; k < count; k++) {
        fprintf(out, "$s%zu << EOD\n", k);
        drawn[k] = put_points(out, table, plot, names[k]);
        some += drawn[k];
        fputs("EOD\n", out);
    }
    if (!some)
        fputs("set label \"nothing to show\" at graph 0.5,0.5 center\nset xrange [1:10]\nset yrange [1:10]\nplot NaN "
              "notitle\n",
              out);
    const char *how = json_is_true(json_object_get(plot, "points")) ? "yerrorbars" : "yerrorlines";
    bool first = true;
    for (size_t k = 0; k < count; k++) {
        if (!drawn[k])
            continue;
        fprintf(out, "%s $s%zu using 1:2:3:4 with %s pt %zu ps 0.7 title ", first ? "plot" : ", ", k, how, k % 13 + 4);
        put_quoted(out, names[k]);
        first = false;
    }
    fputc('\n', out);
}

/* The whole of a descriptor. */
static char *read_all(int from)
{
    char *text = NULL, bytes[65536];
    size_t length;
    ssize_t got;
    FILE *out = open_memstream(&text, &length);
    while (out && ((got = read(from, bytes, sizeof bytes)) > 0 || (got < 0 && errno == EINTR)))
        if (got > 0)
            fwrite(bytes, 1, (size_t)got, out);
    if (out && fclose(out) == 0)
        return text;
    free(text);
    return NULL;
}

/* Runs gnuplot on a script; its standard output, or NULL where it is not there or failed. */
static char *run_gnuplot(FILE *script)
{
    int ends[2];
    pid_t child;
    char *arguments[] = {"gnuplot", "-d", "-", NULL};
    if (fflush(script) || lseek(fileno(script), 0, SEEK_SET) < 0 || pipe(ends))
        return NULL;
    posix_spawn_file_actions_t actions;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_adddup2(&actions, fileno(script), 0);
    posix_spawn_file_actions_adddup2(&actions, ends[1], 1);
    posix_spawn_file_actions_addclose(&actions, ends[0]);
    posix_spawn_file_actions_addopen(&actions, 2, "/dev/null", O_WRONLY, 0);
    int failed = posix_spawnp(&child, "gnuplot", &actions, NULL, arguments, environ);
    posix_spawn_file_actions_destroy(&actions);
    close(ends[1]);
    char *text = failed ? NULL : read_all(ends[0]);
    close(ends[0]);
    int result = 0;
    while (!failed && waitpid(child, &result, 0) < 0 && errno == EINTR)
        ;
    if (text && (result || !strstr(text, "<svg"))) {
        free(text);
        text = NULL;
    }
    return text;
}

/* The SVG of a plot, to be set into a page; NULL: none. */
static json_t *draw(const json_t *table, const json_t *plot)
{
    FILE *script = tmpfile();
    if (!script)
        return NULL;
    put_script(script, table, plot);
    char *text = run_gnuplot(script);
    fclose(script);
    const char *from = text ? strstr(text, "<svg") : NULL; /* without the XML declaration */
    json_t *picture = from ? json_string(from) : NULL;
    free(text);
    return picture;
}

static tl_status write_csv(const report *self, const json_t *table, const json_t *plot, tl_error *error)
{
    char name[256], *text = NULL;
    size_t length;
    snprintf(name, sizeof name, "%s.csv", report_text_of(plot, "key"));
    FILE *out = open_memstream(&text, &length);
    if (out)
        put_csv(out, table, plot);
    if (!out || fclose(out)) {
        free(text);
        error->status = TL_ERROR_MEMORY;
        snprintf(error->text, sizeof error->text, "%s/%s: not enough memory", self->folder, name);
        return TL_ERROR_MEMORY;
    }
    tl_status status = report_write_file(self, name, text, error);
    free(text);
    return status;
}

tl_status report_draw(const report *self, json_t *plots, bool *drawn, tl_error *error)
{
    size_t s, t, p;
    const json_t *section, *table, *plot;
    *drawn = true;
    json_array_foreach(json_object_get(self->root, "sections"), s, section)
        json_array_foreach(json_object_get(section, "tables"), t, table)
            json_array_foreach(json_object_get(table, "plots"), p, plot)
    {
        if (write_csv(self, table, plot, error) != TL_OK)
            return error->status;
        json_t *picture = draw(table, plot);
        if (picture)
            json_object_set_new(plots, report_text_of(plot, "key"), picture);
        else
            *drawn = false;
    }
    return TL_OK;
}
