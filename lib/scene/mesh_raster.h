/* Triangles into a block of a picture whose pixels know which one is seen, and how near: all else about a pixel follows
 * from its triangle. */
#ifndef SCENE_MESH_RASTER_H
#define SCENE_MESH_RASTER_H

#include <stdint.h>

/* What is seen at a pixel; the larger `nearness` wins, and of equal ones the first. */
typedef struct scene_hit {
    float nearness; /* 1 / metres ahead; 0: nothing */
    uint32_t triangle;
} scene_hit;

/* A block of a picture. Pixel (0, 0) has its centre at (left + 0.5, top + 0.5), where (0, 0) is straight ahead. */
typedef struct scene_canvas {
    int width, height;
    double left, top;
    scene_hit *hits;
} scene_canvas;

void scene_canvas_clear(scene_canvas *canvas);
/* Draws a triangle, whichever way round. A corner is right, down and ahead of the eye; the picture's plane is at 1
 * ahead in pixels. What is behind the eye, or nearer than a hundredth of a millimetre, is cut off. Neighbours that
 * share two corners leave no gap and overlap nowhere. */
void scene_canvas_draw(scene_canvas *canvas, const double a[3], const double b[3], const double c[3],
                       uint32_t triangle);

#endif
