#include "cmd/mesh_info.h"

#include <jansson.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Of files that are read as meshes and are none; NULL: another. */
static const char *format_of(const char *path)
{
    static const char *const endings[] = {".csv", ".geojson", ".terrain"};
    for (size_t k = 0; k < sizeof endings / sizeof *endings; k++)
        if (command_ends_with(path, endings[k]))
            return endings[k] + 1;
    return NULL;
}

bool mesh_info_is_for(const char *path)
{
    const tl_format *format = tl_format_of(path);
    return (format && format->mesh) || format_of(path);
}

static json_t *triple(const double v[3])
{
    return json_pack("[f,f,f]", v[0], v[1], v[2]);
}

static void print_json(const char *path, const tl_mesh_summary *s)
{
    json_t *name = json_string(path), *record = json_object();
    for (size_t k = 0; k < s->record_count; k++)
        json_object_set_new(record, s->record[k].name, json_string(s->record[k].value));
    json_t *object = json_pack("{s:o, s:s, s:I, s:I, s:o, s:o, s:o}", "name", name ? name : json_string("?"), "format",
                               format_of(path) ? format_of(path) : tl_format_of(path)->ending, "vertices",
                               (json_int_t)s->vertex_count, "triangles", (json_int_t)s->triangle_count, "low",
                               triple(s->low), "high", triple(s->high), "record", record);
    json_dumpf(object, stdout, JSON_INDENT(2) | JSON_REAL_PRECISION(15));
    putchar('\n');
    json_decref(object);
}

static void print_text(const char *path, const tl_mesh_summary *s)
{
    static const char *const axes[3] = {"x", "y", "z"};
    const char *format = format_of(path);
    if (format && strcmp(format, "terrain") != 0)
        printf("%s\npoints       %zu\n", path, s->vertex_count);
    else
        printf("%s\nmesh         %zu triangles, %zu vertices\n", path, s->triangle_count, s->vertex_count);
    for (int a = 0; a < 3; a++)
        printf("%-12s %.12g ... %.12g\n", axes[a], s->low[a], s->high[a]);
    for (size_t k = 0; k < s->record_count; k++)
        printf("%s%s: %s\n", k ? "             " : "made by      ", s->record[k].name, s->record[k].value);
}

int mesh_info_print(const char *path, bool json, const common *shared)
{
    progress bar;
    tl_error error;
    tl_run run = command_run(shared, &bar);
    tl_mesh_summary summary;
    progress_stage(&bar, "reading");
    if (tl_mesh_read_summary(path, &run, &summary, &error) != TL_OK)
        return command_failed(&bar, &error);
    progress_end(&bar);
    (json ? print_json : print_text)(path, &summary);
    free(summary.record);
    return command_done();
}
