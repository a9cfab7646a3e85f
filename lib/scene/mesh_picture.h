/* Pictures of meshes: placed for a view, drawn band by band into a canvas, then lit pixel by pixel. */
#ifndef SCENE_MESH_PICTURE_H
#define SCENE_MESH_PICTURE_H

#include "lib/scene/mesh_raster.h"
#include "lib/scene/render.h"
#include "lib/scene/view.h"

/* ---- Stages: a mesh as a view has it ---- */

typedef struct scene_stage scene_stage;

typedef struct scene_stage_options {
    int samples;         /* of a pixel, each way */
    double exaggeration; /* factor on heights */
    bool normals;        /* of vertices are wanted */
    const tl_run *run;
} scene_stage_options;

/* Places all vertices of a mesh whose lattice lies over that of `dem`. Borrows mesh and view. */
scene_stage *scene_stage_create(const tl_mesh *mesh, const tl_source *dem, const scene_view *view,
                                const scene_stage_options *options, tl_error *error);
void scene_stage_destroy(scene_stage *stage);

/* The picture is drawn in bands of rows. */
int scene_stage_bands(const scene_stage *stage);
/* Draws one into a canvas, whose hits the caller has allocated for scene_stage_band_hits. Any number of threads. */
void scene_stage_draw(const scene_stage *stage, int band, scene_canvas *canvas);
size_t scene_stage_band_hits(const scene_stage *stage);

/* A point of a triangle, by the direction from the eye: right and down, in samples from straight ahead. */
typedef struct scene_point {
    double i, j;     /* on the lattice of the model */
    double height;   /* of the mesh there, not exaggerated */
    double at[3];    /* right and down of the eye, in samples at 1 m ahead; metres ahead */
    float normal[3]; /* east, north, up; of length 1 */
} scene_point;

/* What a hit shows in the direction of the sample's middle. */
void scene_stage_point(const scene_stage *stage, const scene_hit *hit, double x, double y, bool facet,
                       scene_point *out);

/* Where a vertex of its mesh is, as scene_point.at. */
const double *scene_stage_vertex(const scene_stage *stage, uint32_t vertex);
/* From the lattice of the model to that of the mesh. */
void scene_stage_lattice(const scene_stage *stage, double *i, double *j);

/* ---- Pictures ---- */

typedef struct scene_painter scene_painter;

/* Chooses colours for the heights of `dem`. Checks the options. */
scene_painter *scene_painter_create(const tl_source *dem, const tl_view_picture_options *options, tl_error *error);
void scene_painter_destroy(scene_painter *painter);
/* A picture of what `count` views of the same size see, the mean of their light. */
tl_status scene_paint(const scene_painter *painter, const tl_mesh *mesh, const scene_view *const *views, size_t count,
                      scene_picture *out, tl_error *error);
/* Metres ahead at the middle of each pixel, NaN where nothing is; width * height of them, freed by free(). */
tl_status scene_paint_depth(const scene_painter *painter, const tl_mesh *mesh, const scene_view *view, float **out,
                            tl_error *error);

#endif
