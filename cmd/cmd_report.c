#include "cmd/command.h"
#include "cmd/report/report.h"

#include <dirent.h>
#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>

typedef struct settings {
    common common;
    bool quick;
    const char *sections;
} settings;

typedef struct part {
    const char *name;
    tl_status (*run)(report *self, tl_error *error);
} part;

static const part parts[] = {{"framework", report_framework},
                             {"field", report_field},
                             {"amplification", report_amplification},
                             {"view", report_view},
                             {"stability", report_stability}};
enum { PARTS = sizeof parts / sizeof *parts };

/* The parts of a list with commas; told and false where it names others. */
static bool choose_parts(const char *list, bool chosen[PARTS])
{
    for (size_t k = 0; k < PARTS; k++)
        chosen[k] = !list;
    while (list && *list) {
        char name[32];
        size_t length = strcspn(list, ","), k = 0;
        snprintf(name, sizeof name, "%.*s", (int)(length < 31 ? length : 31), list);
        while (k < PARTS && strcmp(parts[k].name, name) != 0)
            k++;
        if (k == PARTS) {
            complain_of_choice("sections", name, parts, PARTS, sizeof *parts);
            return false;
        }
        chosen[k] = true;
        list += length + (list[length] == ',');
    }
    return true;
}

/* A new folder, or an empty one; with --overwrite any. Told. */
static bool make_folder(const common *options)
{
    if (mkdir(options->output, 0777) == 0)
        return true;
    DIR *folder = errno == EEXIST ? opendir(options->output) : NULL;
    if (!folder) {
        complain("%s: cannot be made a folder: %s", options->output, strerror(errno));
        return false;
    }
    bool empty = true;
    for (const struct dirent *entry; (entry = readdir(folder));)
        if (strcmp(entry->d_name, ".") != 0 && strcmp(entry->d_name, "..") != 0)
            empty = false;
    closedir(folder);
    if (!empty && !options->overwrite)
        complain("%s: is not empty; name another folder or give --overwrite", options->output);
    return empty || options->overwrite;
}

static tl_status write_all(const settings *set, report *made, tl_error *error)
{
    bool drawn;
    json_t *plots = json_object();
    tl_status status = report_draw(made, plots, &drawn, error);
    if (status == TL_OK)
        status = report_write_json(made, error);
    if (status == TL_OK)
        status = report_write_page(made, plots, error);
    json_decref(plots);
    if (status == TL_OK && !drawn)
        command_say(&set->common,
                    "warning: gnuplot is not there or failed, so pictures are missing; install gnuplot-nox");
    return status;
}

/* Cases that failed and bounds that did not hold. */
static size_t count_failures(const json_t *root)
{
    size_t s, t, r, count = 0;
    const json_t *section, *table, *row;
    json_array_foreach(json_object_get(root, "sections"), s, section)
        json_array_foreach(json_object_get(section, "tables"), t, table)
            json_array_foreach(json_object_get(table, "rows"), r, row)
    {
        const char *verdict = json_string_value(json_object_get(row, "verdict"));
        count += verdict && strcmp(verdict, "failed") == 0;
    }
    return count;
}

static int make_report(const settings *set, const arguments *inputs, int argc, const char **argv)
{
    progress bar;
    tl_error error;
    char title[4200];
    bool chosen[PARTS];
    if (!choose_parts(set->sections, chosen))
        return EXIT_USAGE;
    tl_run run = command_run(&set->common, &bar);
    opened_input opened = command_open(&set->common, inputs, &run, &error);
    if (!opened.source)
        return command_failed(&bar, &error);
    if (!make_folder(&set->common)) {
        command_close(&opened);
        return EXIT_FAILED;
    }
    double start = progress_clock();
    const char *name = strrchr(opened.source->info.name, '/');
    snprintf(title, sizeof title, "talus report on %s", name ? name + 1 : opened.source->info.name);
    report made = {.dem = opened.source, .run = &run, .bar = &bar, .folder = set->common.output, .quick = set->quick};
    tl_status status = TL_ERROR_MEMORY;
    if (report_init(&made, title)) {
        report_describe(&made, argc, argv);
        status = TL_OK;
    }
    for (size_t k = 0; k < PARTS && status == TL_OK; k++)
        if (chosen[k]) {
            status = parts[k].run(&made, &error);
            if (status == TL_ERROR_DATA || status == TL_ERROR_ARGUMENT) { /* the model is not for it; others may be */
                report_remark(&made, parts[k].name, error.text);
                status = TL_OK;
            }
        }
    if (status == TL_OK)
        status = write_all(set, &made, &error);
    size_t failures = count_failures(made.root);
    report_finish(&made);
    command_close(&opened);
    if (status != TL_OK)
        return command_failed(&bar, &error);
    progress_end(&bar);
    command_say(&set->common, "%s/report.html: %.1f s, %zu of its bounds and cases failed", set->common.output,
                progress_clock() - start, failures);
    return EXIT_DONE;
}

static int run_report(const command *self, int argc, const char **argv, command_help help)
{
    settings set = {0};
    const option made[] = {
        {"output", 'o', OPTION_TEXT, &set.common.output, NULL, "FOLDER", "where the report goes: a new or empty folder",
         0, 0, NULL},
        {"overwrite", 0, OPTION_FLAG, &set.common.overwrite, NULL, NULL, "write into a folder that is not empty", 0, 0,
         NULL},
        {"quick", 'Q', OPTION_FLAG, &set.quick, NULL, NULL, "fewer measurements, on smaller parts", 0, 0, NULL},
        {"sections", 0, OPTION_TEXT, &set.sections, NULL, "LIST",
         "only these, with commas between: framework, field, amplification, view, stability", 0, 0, NULL},
        {0}};
    const option input[] = {COMMON_INPUT(set.common), {0}};
    const option running[] = {COMMON_RUNNING(set.common), {0}};
    const option_group groups[] = {{"Report", made}, {"Input", input}, {"Running", running}, {0}};
    arguments rest;
    int status;
    if (!command_begin(self, argc, argv, help, groups, -1, &rest, &status))
        return status;
    if (!set.common.output || !*set.common.output) {
        complain("no folder named; give -o FOLDER");
        status = EXIT_USAGE;
    } else
        status = make_report(&set, &rest, argc, argv);
    arguments_free(&rest);
    return status;
}

const command command_report = {"report", "measure error against run time, and stiff cases, on an elevation model",
                                "DEM... -o FOLDER [--quick]",
                                INPUT_NOTES "\n\nWrites report.html, which needs nothing beside it, report.json with "
                                            "the same numbers, and a CSV for each plot.\n"
                                            "Pictures are drawn by gnuplot, where it is installed.\n\n"
                                            "Example: talus report dem.tif --quick -o report",
                                run_report};
