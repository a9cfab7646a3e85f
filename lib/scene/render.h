/* Pictures of sources, in memory. */
#ifndef SCENE_RENDER_H
#define SCENE_RENDER_H

#include "lib/talus.h"

enum { SCENE_PICTURE_MAX = 32768 }; /* pixels on a side */

/* 8-bit sRGB with straight alpha, row by row from the top, 4 bytes a pixel: all of them in `rgba`, or made in bands of
 * rows as they are asked for. */
typedef struct scene_picture {
    int64_t width, height;
    unsigned char *rgba; /* NULL: made by `rows` */
    void *context;
    tl_status (*rows)(void *context, int64_t y, int64_t count, unsigned char *rgba, tl_error *error);
    void (*finish)(void *context);
} scene_picture;

tl_status scene_picture_check(int64_t width, int64_t height, tl_error *error);
/* Allocates a transparent picture; refuses sizes above SCENE_PICTURE_MAX. */
tl_status scene_picture_init(scene_picture *picture, int64_t width, int64_t height, tl_error *error);
void scene_picture_finish(scene_picture *picture);

/* Both take sources as scene_north_up gives them and the checked options of tl_write_preview, and leave a picture that
 * the caller finishes; nothing when they fail. `beside` may be NULL. */
tl_status scene_hillshade(const tl_source *source, const tl_source *beside, const tl_preview_options *options,
                          scene_picture *picture, tl_error *error);
tl_status scene_perspective(const tl_source *source, const tl_preview_options *options, scene_picture *picture,
                            tl_error *error);

/* Whether heights of this raster are above a sea: those of the Earth are. */
bool scene_has_sea_level(const tl_georef *georef);

#endif
