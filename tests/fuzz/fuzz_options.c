/* Command lines: the first byte chooses the command, a zero byte or a newline ends a word. They are parsed and checked
 * as the program does, up to where it would open its first file: whatever opens one is replaced, by the linker, with
 * what fails (see meson.build). */
#include "cmd/command.h"
#include "fuzz.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const command *const commands[] = {&command_info,  &command_simplify, &command_synth, &command_preview,
                                          &command_noise, &command_stats,    &command_view,  &command_fly,
                                          &command_tiles, &command_serve,    &command_report};
enum { COMMANDS = sizeof commands / sizeof *commands, MOST_WORDS = 64, MOST_BYTES = 4096 };

static void refuse(tl_error *error)
{
    if (error) {
        error->status = TL_ERROR_IO;
        snprintf(error->text, sizeof error->text, "nothing is opened here");
    }
}

opened_input __wrap_command_open(const common *options, const arguments *inputs, const tl_run *run, tl_error *error);
tl_source *__wrap_tl_open(const char *path, tl_error *error);
tl_source *__wrap_tl_open_with(const char *path, const tl_dem_options *options, tl_error *error);
tl_source *__wrap_tl_noise_create(const tl_noise_options *options, tl_error *error);
tl_status __wrap_tl_view_read(const char *path, tl_view *out, tl_error *error);
tl_status __wrap_tl_view_path_read(const char *path, tl_view_key **keys, size_t *count, tl_error *error);
tl_status __wrap_tl_mesh_read_summary(const char *path, const tl_run *run, tl_mesh_summary *out, tl_error *error);
bool __wrap_json_info_is_for(const char *path);
void *__wrap_MHD_start_daemon(unsigned flags);

opened_input __wrap_command_open(const common *options, const arguments *inputs, const tl_run *run, tl_error *error)
{
    (void)options;
    (void)inputs;
    (void)run;
    refuse(error);
    return (opened_input){0};
}

tl_source *__wrap_tl_open(const char *path, tl_error *error)
{
    (void)path;
    refuse(error);
    return NULL;
}

tl_source *__wrap_tl_open_with(const char *path, const tl_dem_options *options, tl_error *error)
{
    (void)options;
    return __wrap_tl_open(path, error);
}

tl_source *__wrap_tl_noise_create(const tl_noise_options *options, tl_error *error)
{
    fuzz_expect(options->size >= 1);
    refuse(error);
    return NULL;
}

tl_status __wrap_tl_view_read(const char *path, tl_view *out, tl_error *error)
{
    (void)path;
    (void)out;
    refuse(error);
    return TL_ERROR_IO;
}

tl_status __wrap_tl_view_path_read(const char *path, tl_view_key **keys, size_t *count, tl_error *error)
{
    (void)keys;
    (void)count;
    return __wrap_tl_view_read(path, NULL, error);
}

tl_status __wrap_tl_mesh_read_summary(const char *path, const tl_run *run, tl_mesh_summary *out, tl_error *error)
{
    (void)run;
    (void)out;
    return __wrap_tl_view_read(path, NULL, error);
}

bool __wrap_json_info_is_for(const char *path)
{
    (void)path;
    return false;
}

void *__wrap_MHD_start_daemon(unsigned flags)
{
    (void)flags;
    return NULL;
}

/* What is told goes nowhere; libFuzzer and the sanitizers keep what they had. */
static void be_silent(void)
{
    static bool silent;
    if (silent)
        return;
    stdout = fopen("/dev/null", "w");
    stderr = fopen("/dev/null", "w");
    fuzz_expect(stdout && stderr);
    silent = true;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    char text[MOST_BYTES + 1];
    const char *words[MOST_WORDS + 1];
    int count = 1;
    if (size < 1 || size > MOST_BYTES)
        return 0;
    be_silent();
    const command *chosen = commands[data[0] % COMMANDS];
    memcpy(text, data + 1, size - 1);
    text[size - 1] = 0;
    words[0] = chosen->name;
    for (size_t k = 0, from = 0; k < size && count < MOST_WORDS; k++) {
        if (text[k] && text[k] != '\n')
            continue;
        text[k] = 0;
        if (k + 1 < size || k > from)
            words[count++] = text + from;
        from = k + 1;
    }
    words[count] = NULL;
    int status = chosen->run(chosen, count, words, false);
    fuzz_expect(status == EXIT_DONE || status == EXIT_FAILED || status == EXIT_USAGE);
    return 0;
}
