/* A small z-buffer: triangles into a block of a picture, with what the light needs to know at every pixel. */
#ifndef SCENE_ZBUFFER_H
#define SCENE_ZBUFFER_H

#include <stddef.h>

/* A corner: where it is seen from the eye, and what is known there. */
typedef struct scene_corner {
    double x, y, w;    /* right, down, ahead of the eye; the picture's plane is at w = 1 in pixels of the buffer */
    float height;      /* of the source, for its colour */
    float east, north; /* slopes */
} scene_corner;

/* What is seen at a pixel; the larger `nearness` wins. */
typedef struct scene_fragment {
    float nearness; /* 1 / w; 0: nothing */
    float height;
    float east, north;
} scene_fragment;

/* A block of a picture. Pixel (0, 0) has its centre at (left + 0.5, top + 0.5), where (0, 0) is straight ahead. */
typedef struct scene_zbuffer {
    int width, height;
    double left, top;
    double near_plane; /* > 0: what is nearer is cut off */
    scene_fragment *fragments;
} scene_zbuffer;

void scene_zbuffer_clear(scene_zbuffer *buffer);
/* Draws a triangle, whichever way round. Neighbours that share two corners leave no gap and overlap nowhere. */
void scene_zbuffer_triangle(scene_zbuffer *buffer, const scene_corner *a, const scene_corner *b, const scene_corner *c);
/* Whether everything in the rectangle (in pixels of the picture, as left and top) is nearer than w. */
int scene_zbuffer_hides(const scene_zbuffer *buffer, double x0, double y0, double x1, double y1, double w);

#endif
