/* What a field that tl_field_create made adds to its elevation model, for those who choose how much of it they need. */
#ifndef SCENE_FIELD_H
#define SCENE_FIELD_H

#include "lib/talus.h"

/* The elevation model of a field; NULL where tl_field_create did not make it. The functions below ask for one that it
 * made. */
const tl_source *scene_field_dem(const tl_source *source);
/* Whether the samples of every level are samples of all finer ones, with the same heights, from the model's own on. */
bool scene_field_nests(const tl_source *source);
/* The fractal model of what is below the samples of `level`, 0 ... the field's own: standard deviation of the height
 * difference over one spacing (of cells that are not square: the geometric mean of their sides), where the strength is
 * 1, and exponent. */
void scene_field_fractal(const tl_source *source, int level, double *delta, double *hurst);
/* Factors on it at the model's samples; a window that may reach beyond the model. */
tl_status scene_field_strengths(const tl_source *source, tl_window window, float *out, tl_error *error);
/* Whether exponents vary from place to place: the strengths are then delta over a sample of the model. */
bool scene_field_has_exponents(const tl_source *source);
/* Exponents of the finest level at the model's samples; a window that may reach beyond the model. */
tl_status scene_field_hursts(const tl_source *source, tl_window window, float *out, tl_error *error);
/* The window of the model that a window of `level` is made from. */
tl_window scene_field_support(const tl_source *source, int level, tl_window window);

#endif
