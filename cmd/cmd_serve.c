#define _XOPEN_SOURCE 700 /* realpath */
/* A folder on 127.0.0.1, for browsers on this machine. */
#include "cmd/command.h"

#ifdef TL_HAVE_MICROHTTPD
#include <microhttpd.h>
#endif

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#ifdef TL_HAVE_MICROHTTPD
enum { PORT = 8080, MOST_WORKERS = 4 };

typedef struct server {
    char root[PATH_MAX];   /* without links and dots */
    char viewer[PATH_MAX]; /* of the page; "" where the folder brings its own, or there is none */
    int port;
} server;

/* ---- Files ---- */

static const struct {
    const char *ending, *type;
    bool gzip; /* files of this kind are packed */
} types[] = {{".terrain", "application/vnd.quantized-mesh", true},
             {".json", "application/json", false},
             {".html", "text/html; charset=utf-8", false},
             {".js", "text/javascript; charset=utf-8", false},
             {".mjs", "text/javascript; charset=utf-8", false},
             {".css", "text/css; charset=utf-8", false},
             {".wasm", "application/wasm", false},
             {".glb", "model/gltf-binary", false},
             {".subtree", "application/octet-stream", false},
             {".png", "image/png", false},
             {".jpg", "image/jpeg", false},
             {".svg", "image/svg+xml", false},
             {".xml", "application/xml", false}};

/* Opens ROOT/URL where that is a file in ROOT, links followed; a folder stands for its index.html. -1: it is not. */
static int open_inside(const char *root, const char *url, char path[PATH_MAX])
{
    char wanted[PATH_MAX];
    struct stat status;
    size_t length = strlen(root);
    if (snprintf(wanted, sizeof wanted, "%s/%s", root, url) >= (int)sizeof wanted || !realpath(wanted, path))
        return -1;
    if (stat(path, &status) == 0 && S_ISDIR(status.st_mode)) {
        if (snprintf(wanted, sizeof wanted, "%.*s/index.html", PATH_MAX - 16, path) >= (int)sizeof wanted ||
            !realpath(wanted, path))
            return -1;
    }
    if (strncmp(path, root, length) != 0 || (path[length] != '/' && length > 1))
        return -1; /* by dots or by a link */
    int descriptor = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK | O_NOFOLLOW);
    if (descriptor >= 0 && (fstat(descriptor, &status) != 0 || !S_ISREG(status.st_mode))) {
        close(descriptor);
        descriptor = -1;
    }
    return descriptor;
}

/* ---- Answers ---- */

static enum MHD_Result answer_text(struct MHD_Connection *connection, unsigned code, const char *text)
{
    struct MHD_Response *response = MHD_create_response_from_buffer(strlen(text), (void *)text, MHD_RESPMEM_MUST_COPY);
    if (!response)
        return MHD_NO;
    MHD_add_response_header(response, "Content-Type",
                            *text == '<' ? "text/html; charset=utf-8" : "text/plain; charset=utf-8");
    enum MHD_Result result = MHD_queue_response(connection, code, response);
    MHD_destroy_response(response);
    return result;
}

static enum MHD_Result answer_file(struct MHD_Connection *connection, int descriptor, const char *path)
{
    struct stat status;
    struct MHD_Response *response =
        fstat(descriptor, &status) == 0 ? MHD_create_response_from_fd64((uint64_t)status.st_size, descriptor) : NULL;
    if (!response) {
        close(descriptor);
        return MHD_NO;
    }
    for (size_t k = 0; k < sizeof types / sizeof *types; k++)
        if (command_ends_with(path, types[k].ending)) {
            MHD_add_response_header(response, "Content-Type", types[k].type);
            if (types[k].gzip)
                MHD_add_response_header(response, "Content-Encoding", "gzip");
        }
    MHD_add_response_header(response, "Cache-Control", "no-cache"); /* tiles are made again under the same names */
    MHD_add_response_header(response, "X-Content-Type-Options", "nosniff");
    enum MHD_Result result = MHD_queue_response(connection, MHD_HTTP_OK, response);
    MHD_destroy_response(response);
    return result;
}

/* A page of another site may have its own name point here; then the browser tells that name. */
static bool is_our_name(const server *self, struct MHD_Connection *connection)
{
    char names[2][32];
    const char *host = MHD_lookup_connection_value(connection, MHD_HEADER_KIND, "Host");
    snprintf(names[0], sizeof names[0], "127.0.0.1:%d", self->port);
    snprintf(names[1], sizeof names[1], "localhost:%d", self->port);
    return host && (strcasecmp(host, names[0]) == 0 || strcasecmp(host, names[1]) == 0);
}

/* The page's files stand before those of the folder, which are all under /data/ too. */
static int find_file(const server *self, const char *url, char path[PATH_MAX])
{
    static const char data[] = "/data/";
    if (*self->viewer && strncmp(url, data, sizeof data - 1) == 0)
        return open_inside(self->root, url + sizeof data - 1, path);
    int descriptor = *self->viewer ? open_inside(self->viewer, url, path) : -1;
    return descriptor >= 0 ? descriptor : open_inside(self->root, url, path);
}

static const char no_page[] =
    "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>talus</title>"
    "<p>This folder has no page of its own. <code>examples/viewer/build.sh</code> makes one that shows terrain; "
    "<code>talus serve FOLDER --viewer examples/viewer/dist</code> serves it with the folder."
    "<p><a href=\"layer.json\">layer.json</a>, <a href=\"tileset.json\">tileset.json</a></html>";

static enum MHD_Result answer(void *user, struct MHD_Connection *connection, const char *url, const char *method,
                              const char *version, const char *upload, size_t *upload_size, void **state)
{
    (void)version;
    (void)upload;
    const server *self = user;
    static int seen;
    char path[PATH_MAX];
    if (!*state) { /* the header alone: a body may follow, and is not wanted */
        *state = &seen;
        return MHD_YES;
    }
    if (*upload_size) {
        *upload_size = 0;
        return MHD_YES;
    }
    if (strcmp(method, "GET") != 0 && strcmp(method, "HEAD") != 0)
        return answer_text(connection, MHD_HTTP_METHOD_NOT_ALLOWED, "only GET and HEAD\n");
    if (!is_our_name(self, connection))
        return answer_text(connection, MHD_HTTP_FORBIDDEN, "only for 127.0.0.1\n");
    int descriptor = find_file(self, url, path);
    if (descriptor >= 0)
        return answer_file(connection, descriptor, path);
    if (strcmp(url, "/") == 0)
        return answer_text(connection, MHD_HTTP_OK, no_page);
    return answer_text(connection, MHD_HTTP_NOT_FOUND, "there is no such file\n");
}

/* ---- Serving ---- */

static struct MHD_Daemon *start(server *self, uint16_t port)
{
    struct sockaddr_in place = {
        .sin_family = AF_INET, .sin_port = htons(port), .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    struct MHD_Daemon *daemon = MHD_start_daemon(
        MHD_USE_INTERNAL_POLLING_THREAD | MHD_USE_AUTO, port, NULL, NULL, answer, self, MHD_OPTION_SOCK_ADDR, &place,
        MHD_OPTION_THREAD_POOL_SIZE, (unsigned)MOST_WORKERS, MHD_OPTION_CONNECTION_TIMEOUT, 30u, MHD_OPTION_END);
    if (!daemon)
        return NULL;
    const union MHD_DaemonInfo *info = MHD_get_daemon_info(daemon, MHD_DAEMON_INFO_BIND_PORT);
    self->port = info ? info->port : port;
    return daemon;
}

/* The folder without links and dots. */
static bool find_root(const char *name, const char *what, char out[PATH_MAX])
{
    struct stat status;
    if (realpath(name, out) && stat(out, &status) == 0 && S_ISDIR(status.st_mode))
        return true;
    complain("%s: %s", name, errno == ENOENT ? what : "is no folder that can be read");
    return false;
}

static int serve(server *self, uint16_t port, const common *shared)
{
    progress bar;
    tl_run run = command_run(shared, &bar);
    struct MHD_Daemon *daemon = start(self, port);
    if (!daemon) {
        complain("cannot listen at 127.0.0.1:%u: %s; name another port by --port", port, strerror(errno));
        return EXIT_FAILED;
    }
    printf("http://127.0.0.1:%d/\n", self->port);
    if (fflush(stdout) == 0)
        command_say(shared, "%s; end with Ctrl-C", self->root);
    const struct timespec while_waiting = {0, 100 * 1000 * 1000};
    while (!(run.cancel && *run.cancel))
        nanosleep(&while_waiting, NULL);
    MHD_stop_daemon(daemon);
    return EXIT_DONE;
}

static int run_serve(const command *self, int argc, const char **argv, command_help help)
{
    common shared = {.progress = PROGRESS_NONE};
    int64_t port = PORT;
    const char *viewer = NULL;
    const option options[] = {
        {"port", 'p', OPTION_INTEGER, &port, NULL, "N", "of 127.0.0.1, 0...65535; 0: any that is free (default: 8080)",
         0, 65535, NULL},
        {"viewer", 0, OPTION_TEXT, &viewer, NULL, "FOLDER",
         "a page to show it with, as examples/viewer/build.sh makes it; the folder is then under /data/ too", 0, 0,
         NULL},
        {"quiet", 'q', OPTION_FLAG, &shared.quiet, NULL, NULL, "print nothing but errors and the address", 0, 0, NULL},
        {0}};
    const option_group groups[] = {{"Serving", options}, {0}};
    arguments rest;
    int status;
    server here = {.port = 0};
    if (!command_begin(self, argc, argv, help, groups, 1, &rest, &status))
        return status;
    bool good =
        find_root(rest.names[0], "there is no such folder", here.root) &&
        (!viewer || find_root(viewer, "there is no such folder; examples/viewer/build.sh makes one", here.viewer));
    status = good ? serve(&here, (uint16_t)port, &shared) : EXIT_FAILED;
    arguments_free(&rest);
    return status;
}

#else
static int run_serve(const command *self, int argc, const char **argv, command_help help)
{
    const option_group groups[] = {{0}};
    arguments rest;
    int status;
    if (command_begin(self, argc, argv, help, groups, 1, &rest, &status)) {
        complain(
            "this talus was built without libmicrohttpd, which serve needs; any server of files on this machine will "
            "do that sends .terrain with Content-Encoding: gzip");
        status = EXIT_FAILED;
        arguments_free(&rest);
    }
    return status;
}
#endif

const command command_serve = {"serve", "show a folder of tiles to browsers on this machine", "FOLDER [--port N]",
                               "Listens at 127.0.0.1 alone, and serves files in the folder alone.", run_serve};
