/* Plots of statistics, drawn by cairo. */
#include "lib/base/error.h"
#include "lib/base/output.h"

#include <math.h>
#include <stdio.h>
#include <string.h>
#include <strings.h>

#ifndef TL_HAVE_CAIRO

tl_status tl_statistics_plot(const tl_statistics *statistics, const char *title, const char *path, bool overwrite,
                             tl_error *error)
{
    (void)statistics;
    (void)title;
    (void)overwrite;
    return tl_fail(error, TL_ERROR_ARGUMENT, "%s: plots need cairo; build talus with -Dplots=enabled", path);
}

#else

#include <cairo-svg.h>
#include <cairo.h>

enum { WIDTH = 960, HEIGHT = 760, LEFT = 64, RIGHT = 12, TOP = 34, BOTTOM = 40 };

/* A panel with logarithmic axes. */
typedef struct panel {
    double x, y, width, height; /* of its inner rectangle */
    double low[2], high[2];     /* log10 of what its edges mean */
} panel;

static double across(const panel *p, double value)
{
    return p->x + p->width * (log10(value) - p->low[0]) / (p->high[0] - p->low[0]);
}

static double upwards(const panel *p, double value)
{
    return p->y + p->height * (1 - (log10(value) - p->low[1]) / (p->high[1] - p->low[1]));
}

/* Takes a point into the panel's range. */
static void reach(panel *p, double x, double y)
{
    const double at[2] = {x, y};
    if (!(x > 0) || !(y > 0) || !isfinite(x) || !isfinite(y))
        return;
    for (int k = 0; k < 2; k++) {
        p->low[k] = fmin(p->low[k], log10(at[k]));
        p->high[k] = fmax(p->high[k], log10(at[k]));
    }
}

static panel panel_at(int column, int row)
{
    double width = WIDTH / 2.0, height = HEIGHT / 2.0;
    return (panel){.x = column * width + LEFT,
                   .y = row * height + TOP,
                   .width = width - LEFT - RIGHT,
                   .height = height - TOP - BOTTOM,
                   .low = {1e9, 1e9},
                   .high = {-1e9, -1e9}};
}

/* Room around what was reached; false: nothing was. */
static bool settle(panel *p)
{
    for (int k = 0; k < 2; k++) {
        if (p->low[k] > p->high[k])
            return false;
        double margin = 0.05 * fmax(p->high[k] - p->low[k], 0.5);
        p->low[k] -= margin;
        p->high[k] += margin;
    }
    return true;
}

static void text_at(cairo_t *c, double x, double y, double alignment, const char *text)
{
    cairo_text_extents_t size;
    cairo_text_extents(c, text, &size);
    cairo_move_to(c, x - alignment * size.width, y);
    cairo_show_text(c, text);
}

static void grid_line(cairo_t *c, const panel *p, int axis, double value)
{
    char label[32];
    snprintf(label, sizeof label, "%.3g", value);
    cairo_set_source_rgb(c, .88, .88, .88);
    if (axis == 0) {
        cairo_move_to(c, across(p, value), p->y);
        cairo_rel_line_to(c, 0, p->height);
    } else {
        cairo_move_to(c, p->x, upwards(p, value));
        cairo_rel_line_to(c, p->width, 0);
    }
    cairo_stroke(c);
    cairo_set_source_rgb(c, .2, .2, .2);
    if (axis == 0)
        text_at(c, across(p, value), p->y + p->height + 14, .5, label);
    else
        text_at(c, p->x - 5, upwards(p, value) + 4, 1, label);
}

/* Lines at powers of ten, and at 2 and 5 of them where there are few. */
static void grid_axis(cairo_t *c, const panel *p, int axis)
{
    static const double between[] = {1, 2, 5};
    double span = p->high[axis] - p->low[axis];
    int step = span > 8 ? (int)(span / 5) : 1;
    for (int power = (int)floor(p->low[axis]); power <= (int)ceil(p->high[axis]); power++)
        for (int k = 0; k < (span < 2.5 ? 3 : 1); k++) {
            double value = between[k] * pow(10, power), at = log10(value);
            if (at > p->low[axis] && at < p->high[axis] && (k || power % step == 0))
                grid_line(c, p, axis, value);
        }
}

static void frame(cairo_t *c, const panel *p, const char *title, const char *below)
{
    cairo_set_line_width(c, 1);
    grid_axis(c, p, 0);
    grid_axis(c, p, 1);
    cairo_set_source_rgb(c, .2, .2, .2);
    cairo_rectangle(c, p->x, p->y, p->width, p->height);
    cairo_stroke(c);
    text_at(c, p->x, p->y - 6, 0, title);
    text_at(c, p->x + .5 * p->width, p->y + p->height + 30, .5, below);
}

static const double colours[][3] = {{.12, .35, .70}, {.80, .30, .10}, {.15, .55, .25}, {.55, .25, .60}};
static const char *const directions[] = {"rows", "columns", "falling diagonal", "rising diagonal"};

static void dot(cairo_t *c, const panel *p, double x, double y, int colour)
{
    if (!(x > 0) || !(y > 0) || !isfinite(y))
        return;
    cairo_set_source_rgb(c, colours[colour][0], colours[colour][1], colours[colour][2]);
    cairo_arc(c, across(p, x), upwards(p, y), 2.6, 0, 6.2831853);
    cairo_fill(c);
}

static void line(cairo_t *c, const panel *p, const double from[2], const double to[2])
{
    if (!(from[1] > 0) || !(to[1] > 0) || !isfinite(from[1]) || !isfinite(to[1]))
        return;
    cairo_save(c);
    cairo_rectangle(c, p->x, p->y, p->width, p->height);
    cairo_clip(c);
    cairo_set_source_rgb(c, .1, .1, .1);
    cairo_move_to(c, across(p, from[0]), upwards(p, from[1]));
    cairo_line_to(c, across(p, to[0]), upwards(p, to[1]));
    cairo_stroke(c);
    cairo_restore(c);
}

static void legend(cairo_t *c, const panel *p)
{
    for (int d = 0; d < TL_STATISTICS_DIRECTIONS; d++) {
        cairo_set_source_rgb(c, colours[d][0], colours[d][1], colours[d][2]);
        text_at(c, p->x + 8, p->y + 16 + 14 * d, 0, directions[d]);
    }
}

/* Along a diagonal a lag is longer; cells count as square here. */
static double length(const tl_lag *lag, int direction)
{
    return (double)lag->lag * (direction >= 2 ? 1.41421356237 : 1);
}

/* The mean squares of one order, and the line of the fit. */
static void draw_lags(cairo_t *c, const tl_statistics *s, int order)
{
    panel p = panel_at(order - 1, 0);
    for (size_t k = 0; k < s->lag_count; k++)
        for (int d = 0; d < TL_STATISTICS_DIRECTIONS; d++)
            reach(&p, length(&s->lags[k], d), order == 1 ? s->lags[k].structure[d] : s->lags[k].second[d]);
    if (!settle(&p))
        return;
    const tl_fbm_estimate *e = &s->estimates[order == 1 ? 1 : 0];
    char title[120];
    snprintf(title, sizeof title, "%s%s%.3f", order == 1 ? "Structure function" : "Second-order increments, squared",
             e->refusal ? "" : ": H ", e->refusal ? 0 : e->hurst);
    if (e->refusal)
        *strrchr(title, '0') = '\0';
    frame(c, &p, order == 1 ? title : title, "lag (samples)");
    for (size_t k = 0; k < s->lag_count; k++)
        for (int d = 0; d < TL_STATISTICS_DIRECTIONS; d++)
            dot(c, &p, length(&s->lags[k], d), order == 1 ? s->lags[k].structure[d] : s->lags[k].second[d], d);
    legend(c, &p);
    if (e->refusal || !e->delta_known)
        return;
    double factor = e->delta * e->delta * (order == 1 ? 1 : 4 - pow(4, e->hurst));
    double from = pow(10, p.low[0]), to = pow(10, p.high[0]);
    line(c, &p, (const double[2]){from, factor * pow(from, 2 * e->hurst)},
         (const double[2]){to, factor * pow(to, 2 * e->hurst)});
}

static void draw_spectrum(cairo_t *c, const tl_statistics *s)
{
    panel p = panel_at(0, 1);
    char title[80];
    for (size_t k = 0; k < s->wave_count; k++)
        reach(&p, s->waves[k], s->power[k]);
    if (!settle(&p))
        return;
    snprintf(title, sizeof title, s->slope > 0 ? "Power spectrum: slope -%.3f" : "Power spectrum", s->slope);
    frame(c, &p, title, "cycles a sample");
    for (size_t k = 0; k < s->wave_count; k++)
        dot(c, &p, s->waves[k], s->power[k], 0);
    if (!(s->slope > 0) || s->wave_count < 8)
        return;
    double x = s->waves[7], y = s->power[7], from = pow(10, p.low[0]), to = pow(10, p.high[0]);
    line(c, &p, (const double[2]){from, y * pow(from / x, -s->slope)},
         (const double[2]){to, y * pow(to / x, -s->slope)});
}

static void draw_octaves(cairo_t *c, const tl_statistics *s)
{
    panel p = panel_at(1, 1);
    for (size_t k = 0; k < s->octave_count; k++)
        reach(&p, s->octaves[k].cells, s->octaves[k].sigma);
    if (!settle(&p))
        return;
    frame(c, &p, "Sigma of each octave", "spacing (samples)");
    for (size_t k = 0; k < s->octave_count; k++)
        dot(c, &p, s->octaves[k].cells, s->octaves[k].sigma, 1);
}

static void draw(cairo_surface_t *surface, const tl_statistics *s, const char *title)
{
    cairo_t *c = cairo_create(surface);
    cairo_set_source_rgb(c, 1, 1, 1);
    cairo_paint(c);
    cairo_select_font_face(c, "sans-serif", CAIRO_FONT_SLANT_NORMAL, CAIRO_FONT_WEIGHT_NORMAL);
    cairo_set_font_size(c, 11);
    cairo_set_source_rgb(c, 0, 0, 0);
    text_at(c, LEFT, 14, 0, title);
    draw_lags(c, s, 1);
    draw_lags(c, s, 2);
    draw_spectrum(c, s);
    draw_octaves(c, s);
    cairo_destroy(c);
}

typedef struct sink {
    tl_output *output;
    tl_error *error;
    tl_status status;
} sink;

static cairo_status_t append(void *user, const unsigned char *bytes, unsigned count)
{
    sink *to = user;
    if (to->status == TL_OK)
        to->status = tl_output_append(to->output, bytes, count, to->error);
    return to->status == TL_OK ? CAIRO_STATUS_SUCCESS : CAIRO_STATUS_WRITE_ERROR;
}

tl_status tl_statistics_plot(const tl_statistics *statistics, const char *title, const char *path, bool overwrite,
                             tl_error *error)
{
    const char *dot_at = strrchr(path, '.');
    bool svg = dot_at && strcasecmp(dot_at, ".svg") == 0;
    if (!svg && (!dot_at || strcasecmp(dot_at, ".png") != 0))
        return tl_fail(error, TL_ERROR_ARGUMENT, "%s: the plot's name must end with .svg or .png", path);
    sink to = {.output = tl_output_open(path, overwrite, error), .error = error};
    if (!to.output)
        return error ? error->status : TL_ERROR_IO;
    cairo_surface_t *surface = svg ? cairo_svg_surface_create_for_stream(append, &to, WIDTH, HEIGHT)
                                   : cairo_image_surface_create(CAIRO_FORMAT_RGB24, WIDTH, HEIGHT);
    draw(surface, statistics, title);
    cairo_status_t drawn = cairo_surface_status(surface);
    if (drawn == CAIRO_STATUS_SUCCESS && !svg)
        drawn = cairo_surface_write_to_png_stream(surface, append, &to);
    cairo_surface_finish(surface);
    if (drawn == CAIRO_STATUS_SUCCESS)
        drawn = cairo_surface_status(surface);
    cairo_surface_destroy(surface);
    if (to.status == TL_OK && drawn != CAIRO_STATUS_SUCCESS)
        to.status = tl_fail(error, TL_ERROR_MEMORY, "%s: cannot draw: %s", path, cairo_status_to_string(drawn));
    if (to.status == TL_OK)
        return tl_output_commit(to.output, error);
    tl_output_abort(to.output);
    return to.status;
}

#endif
