/* The report as a page: one file, readable in print, in the dark and in the light. */
#include "cmd/report/report.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const char *const head =
    "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n"
    "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n"
    "<style>\n"
    ":root { color-scheme: light dark; --ink: #1c2024; --paper: #fdfdfc; --soft: #667; --line: #d5d8dc; --bad: #b3261e "
    "}\n"
    "@media (prefers-color-scheme: dark) { :root { --ink: #e6e6e3; --paper: #16191c; --soft: #9aa; --line: #3a4046; "
    "--bad: #ff8a80 }\n"
    "  figure svg { filter: invert(1) hue-rotate(180deg) } }\n"
    "body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 70rem; "
    "margin: 2rem auto; padding: 0 1rem }\n"
    "h1 { font-size: 1.6rem } h2 { margin-top: 2.5rem; border-bottom: 1px solid var(--line) } h3 { margin-bottom: "
    ".2rem }\n"
    "p.note, figcaption, .spread, th small { color: var(--soft) } .spread, th small { font-size: .8em; font-weight: "
    "normal }\n"
    "div.wide { overflow-x: auto }\n"
    "table { border-collapse: collapse; font-variant-numeric: tabular-nums } th, td { padding: .15rem .7rem; "
    "border-bottom: 1px solid var(--line); text-align: right; vertical-align: top }\n"
    "td.text, th.text { text-align: left } tr.failed td { color: var(--bad); font-weight: bold }\n"
    "figure { display: inline-block; width: 30rem; max-width: 100%; margin: 1rem 1rem 0 0; vertical-align: top } "
    "figure svg { width: 100%; height: auto }\n"
    "@media print { body { max-width: none; margin: 0 } h2 { break-before: page } h2:first-of-type { break-before: "
    "auto } figure, tr { break-inside: avoid }\n"
    "  :root { --ink: #000; --paper: #fff } figure svg { filter: none } }\n"
    "</style>\n";

static void put(FILE *out, const char *text)
{
    for (; text && *text; text++)
        switch (*text) {
        case '<':
            fputs("&lt;", out);
            break;
        case '>':
            fputs("&gt;", out);
            break;
        case '&':
            fputs("&amp;", out);
            break;
        case '"':
            fputs("&quot;", out);
            break;
        default:
            fputc(*text, out);
        }
}

/* Four significant digits; whole numbers in groups of three. */
static void put_number(FILE *out, double value)
{
    char digits[64];
    if (value != floor(value) || fabs(value) >= 1e15) {
        fprintf(out, "%.4g", value);
        return;
    }
    snprintf(digits, sizeof digits, "%.0f", fabs(value));
    size_t length = strlen(digits);
    if (value < 0)
        fputs("−", out);
    for (size_t k = 0; k < length; k++) {
        fputc(digits[k], out);
        if ((length - k) % 3 == 1 && k + 1 < length)
            fputs("&#8239;", out);
    }
}

static void put_value(FILE *out, const json_t *value)
{
    bool text = json_is_string(value);
    fprintf(out, "<td%s>", text ? " class=\"text\"" : "");
    if (text)
        put(out, json_string_value(value));
    else if (json_is_number(value))
        put_number(out, json_number_value(value));
    else if (json_is_object(value)) {
        put_number(out, json_number_value(json_object_get(value, "value")));
        fputs(" <span class=\"spread\">", out);
        put_number(out, json_number_value(json_object_get(value, "low")));
        fputs(" … ", out);
        put_number(out, json_number_value(json_object_get(value, "high")));
        fprintf(out, ", n&#8239;=&#8239;%lld</span>", (long long)json_integer_value(json_object_get(value, "count")));
    } else
        fputs("–", out);
    fputs("</td>", out);
}

static void put_heads(FILE *out, const json_t *table)
{
    size_t k;
    const json_t *column, *first = json_array_get(json_object_get(table, "rows"), 0);
    fputs("<thead><tr>", out);
    json_array_foreach(json_object_get(table, "columns"), k, column)
    {
        bool text = json_is_string(json_object_get(first, report_text_of(column, "key")));
        fprintf(out, "<th%s>", text ? " class=\"text\"" : "");
        put(out, report_text_of(column, "title"));
        if (*report_text_of(column, "unit")) {
            fputs("<br><small>", out);
            put(out, report_text_of(column, "unit"));
            fputs("</small>", out);
        }
        fputs("</th>", out);
    }
    fputs("</tr></thead>\n", out);
}

static void put_table(FILE *out, const json_t *table, const json_t *plots)
{
    size_t k, c;
    const json_t *row, *column, *plot;
    fputs("<h3>", out);
    put(out, report_text_of(table, "title"));
    fputs("</h3>\n", out);
    if (*report_text_of(table, "note")) {
        fputs("<p class=\"note\">", out);
        put(out, report_text_of(table, "note"));
        fputs("</p>\n", out);
    }
    json_array_foreach(json_object_get(table, "plots"), k, plot)
    {
        const char *picture = json_string_value(json_object_get(plots, report_text_of(plot, "key")));
        if (picture) {
            fputs("<figure>", out);
            fputs(picture, out);
            fputs("<figcaption>", out);
            put(out, report_text_of(plot, "title"));
            fprintf(out, " (%s.csv)</figcaption></figure>\n", report_text_of(plot, "key"));
        }
    }
    fputs("<div class=\"wide\"><table>\n", out);
    put_heads(out, table);
    fputs("<tbody>\n", out);
    json_array_foreach(json_object_get(table, "rows"), k, row)
    {
        bool failed = strcmp(report_text_of(row, "verdict"), "failed") == 0;
        fputs(failed ? "<tr class=\"failed\">" : "<tr>", out);
        json_array_foreach(json_object_get(table, "columns"), c, column)
            put_value(out, json_object_get(row, report_text_of(column, "key")));
        fputs("</tr>\n", out);
    }
    fputs("</tbody></table></div>\n", out);
}

/* The members of an object, a line each. */
static void put_facts(FILE *out, const json_t *object)
{
    const char *key;
    json_t *value;
    json_object_foreach((json_t *)object, key, value)
    { /* is not changed */
        fputs("<tr><td class=\"text\">", out);
        for (const char *c = key; *c; c++)
            fputc(*c == '_' ? ' ' : *c, out);
        fputs("</td><td class=\"text\">", out);
        if (json_is_string(value))
            put(out, json_string_value(value));
        else if (json_is_boolean(value))
            fputs(json_is_true(value) ? "yes" : "no", out);
        else if (json_is_array(value)) {
            size_t k;
            const json_t *word;
            json_array_foreach(value, k, word)
            {
                put(out, k ? " " : "");
                put(out, json_string_value(word));
            }
        } else
            put_number(out, json_number_value(value));
        fputs("</td></tr>\n", out);
    }
}

static void put_page(FILE *out, const json_t *root, const json_t *plots)
{
    size_t k, t;
    const json_t *section, *table;
    fputs(head, out);
    fputs("<title>", out);
    put(out, report_text_of(root, "title"));
    fputs("</title>\n</head>\n<body>\n<h1>", out);
    put(out, report_text_of(root, "title"));
    fputs("</h1>\n<nav><ol>\n", out);
    json_array_foreach(json_object_get(root, "sections"), k, section)
    {
        fprintf(out, "<li><a href=\"#%s\">", report_text_of(section, "key"));
        put(out, report_text_of(section, "title"));
        fputs("</a></li>\n", out);
    }
    fputs("</ol></nav>\n<div class=\"wide\"><table><tbody>\n", out);
    put_facts(out, json_object_get(root, "model"));
    put_facts(out, json_object_get(root, "machine"));
    put_facts(out, json_object_get(root, "made"));
    fputs("</tbody></table></div>\n<p class=\"note\">Small figures behind a number are the range of n measurements, "
          "whose "
          "median it is. Times are of one thread where nothing else is said.</p>\n",
          out);
    json_array_foreach(json_object_get(root, "sections"), k, section)
    {
        fprintf(out, "<section>\n<h2 id=\"%s\">%zu. ", report_text_of(section, "key"), k + 1);
        put(out, report_text_of(section, "title"));
        fputs("</h2>\n<p>", out);
        put(out, report_text_of(section, "text"));
        fputs("</p>\n", out);
        json_array_foreach(json_object_get(section, "tables"), t, table) put_table(out, table, plots);
        fputs("</section>\n", out);
    }
    fputs("</body>\n</html>\n", out);
}

tl_status report_write_page(const report *self, const json_t *plots, tl_error *error)
{
    char *text = NULL;
    size_t length;
    FILE *out = open_memstream(&text, &length);
    bool good = out != NULL;
    if (good) {
        put_page(out, self->root, plots);
        good = !ferror(out);
        good = fclose(out) == 0 && good;
    }
    tl_status status = TL_OK;
    if (good)
        status = report_write_file(self, "report.html", text, error);
    else {
        error->status = status = TL_ERROR_MEMORY;
        snprintf(error->text, sizeof error->text, "%s/report.html: not enough memory", self->folder);
    }
    free(text);
    return status;
}
