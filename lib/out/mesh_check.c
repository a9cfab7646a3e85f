/* The check on mesh files: what was written is read back, found again on the lattice, and measured. */
#include "dem/bend.h"
#include "dem/verify.h"
#include "lib/base/error.h"
#include "lib/base/georef.h"
#include "lib/base/size.h"
#include "lib/out/frame.h"
#include "lib/out/mesh_read.h"

#include <float.h>
#include <math.h>
#include <string.h>

/* A vertex of the file is at a sample if it is this near, in cells: no more than a quarter of one from it, and half a
 * cell from every other. */
static const double NEAR = 0.25;

static const uint32_t NONE = UINT32_MAX;

typedef struct checker {
    const char *path;
    const tl_mesh *mesh; /* as it was written */
    tl_frame kind;
    bool bent;
    double origin[3];
    double cell;            /* side of the squares that vertices are found by, in the frame's unit */
    double (*ideal)[2];     /* of the mesh's vertices: where they should be, level */
    uint32_t *first, *next; /* by square (hashed) and by vertex */
    size_t mask;
    out_mesh_file file;
    double (*at)[3]; /* of the file's vertices */
} checker;

/* ---- Where vertices should be ------------------------------------------------------------------------ */

static void on_map(const tl_georef *georef, double i, double j, double out[2])
{
    const double *t = georef->transform;
    out[0] = t[0] + t[1] * i + t[2] * j;
    out[1] = t[3] + t[4] * i + t[5] * j;
}

/* By other formulas than the writers': their frames are made for a picture of the whole. */
static tl_status find_ideal(checker *self, const char *name, tl_error *error)
{
    const tl_georef *georef = &self->mesh->georef;
    dem_space *space = self->bent ? dem_space_create_at(georef, self->origin, name, error) : NULL;
    if (self->bent && !space)
        return TL_ERROR_DATA;
    for (size_t k = 0; k < self->mesh->vertex_count; k++) {
        const tl_vertex *v = &self->mesh->vertices[k];
        double xyz[3] = {v->i, v->j};
        if (self->bent)
            dem_space_at(space, v->i, v->j, georef->height_unit * (double)v->z, xyz, NULL);
        else if (self->kind == TL_FRAME_PROJECTED)
            on_map(georef, v->i, v->j, xyz);
        self->ideal[k][0] = xyz[0], self->ideal[k][1] = xyz[1];
    }
    dem_space_destroy(space);
    return TL_OK;
}

/* The shortest step of the lattice in the frame. */
static double step_of(const checker *self)
{
    const tl_georef *georef = &self->mesh->georef;
    const double *t = georef->transform;
    if (self->bent) /* rows shrink towards a pole, and the middle's cell is not the smallest */
        return fmin(georef->cell_x, georef->cell_y) / 2;
    if (self->kind == TL_FRAME_PIXEL)
        return 1;
    return fabs(t[1] * t[5] - t[2] * t[4]) / fmax(hypot(t[1], t[4]), hypot(t[2], t[5]));
}

/* ---- Finding them again ------------------------------------------------------------------------------ */

static size_t square_of(const checker *self, double x, double y)
{
    uint64_t h =
        (uint64_t)(int64_t)x * UINT64_C(0x9E3779B97F4A7C15) ^ (uint64_t)(int64_t)y * UINT64_C(0xBF58476D1CE4E5B9);
    return (size_t)(h ^ h >> 31) & self->mask;
}

static tl_status sort_ideal(checker *self, tl_error *error)
{
    size_t count = self->mesh->vertex_count, squares = 1;
    while (squares < count)
        squares *= 2;
    self->mask = squares - 1;
    self->first = tl_alloc(squares, sizeof *self->first);
    self->next = tl_alloc(count, sizeof *self->next);
    if (!self->first || !self->next)
        return tl_fail_memory(error, self->path);
    memset(self->first, 0xff, squares * sizeof *self->first);
    for (size_t k = 0; k < count; k++) {
        double x = floor(self->ideal[k][0] / self->cell), y = floor(self->ideal[k][1] / self->cell);
        if (!(fabs(x) < 1e18 && fabs(y) < 1e18))
            return tl_fail(error, TL_ERROR_DATA, "%s: a vertex has no place in this frame", self->path);
        size_t square = square_of(self, x, y);
        self->next[k] = self->first[square];
        self->first[square] = (uint32_t)k;
    }
    return TL_OK;
}

/* The mesh's vertex at a place of the file, or NONE. */
static uint32_t find_vertex(const checker *self, const double xyz[3])
{
    double x = floor(xyz[0] / self->cell), y = floor(xyz[1] / self->cell);
    if (!(fabs(x) < 1e18 && fabs(y) < 1e18))
        return NONE;
    for (int n = 0; n < 9; n++)
        for (uint32_t k = self->first[square_of(self, x + n % 3 - 1, y + n / 3 - 1)]; k != NONE; k = self->next[k])
            if (hypot(xyz[0] - self->ideal[k][0], xyz[1] - self->ideal[k][1]) <= NEAR * self->cell)
                return k;
    return NONE;
}

/* A place of a flat frame as column, row and height; what the numbers of a map cannot tell from a sample is one. */
static void to_lattice(const checker *self, const double xyz[3], const tl_vertex *sample, double out[3])
{
    const double *t = self->mesh->georef.transform;
    double ideal[2] = {sample->i, sample->j};
    if (self->kind == TL_FRAME_PROJECTED)
        on_map(&self->mesh->georef, sample->i, sample->j, ideal);
    double x = xyz[0] - ideal[0], y = xyz[1] - ideal[1], i = x, j = y;
    if (fabs(x) <= 4 * DBL_EPSILON * fabs(ideal[0]) && fabs(y) <= 4 * DBL_EPSILON * fabs(ideal[1]))
        i = j = 0;
    else if (self->kind == TL_FRAME_PROJECTED) {
        double whole = t[1] * t[5] - t[2] * t[4];
        i = (x * t[5] - y * t[2]) / whole;
        j = (y * t[1] - x * t[4]) / whole;
    }
    out[0] = sample->i + i, out[1] = sample->j + j, out[2] = xyz[2];
}

/* The file's mesh over the lattice, without walls and floors: triangles that are upright or look down. */
static tl_status take_surface(checker *self, bool faces_up, tl_mesh *out, tl_error *error)
{
    for (size_t k = 0; k < self->file.vertex_count; k++) {
        uint32_t found = find_vertex(self, self->file.xyz[k]);
        if (found == NONE)
            return tl_fail(error, TL_ERROR_DATA, "%s: vertex %zu of the file is at no sample of the mesh", self->path,
                           k);
        out->vertices[k] = self->mesh->vertices[found];
        if (self->bent)
            memcpy(self->at[k], self->file.xyz[k], sizeof self->at[k]);
        else
            to_lattice(self, self->file.xyz[k], &out->vertices[k], self->at[k]);
    }
    for (size_t t = 0; t < self->file.triangle_count; t++) {
        const uint32_t *corner = self->file.indices + 3 * t;
        const tl_vertex *a = &out->vertices[corner[0]], *b = &out->vertices[corner[1]], *c = &out->vertices[corner[2]];
        int64_t area = (int64_t)(b->i - a->i) * (c->j - a->j) - (int64_t)(b->j - a->j) * (c->i - a->i);
        if (faces_up ? area < 0 : area > 0)
            memcpy(out->indices + 3 * out->triangle_count++, corner, 3 * sizeof *corner);
    }
    return TL_OK;
}

/* ---- The whole ------------------------------------------------------------------------------------------ */

static tl_status measure(checker *self, bool faces_up, const tl_source *source, const tl_selection *bounds,
                         const tl_run *run, tl_mesh_report *out, tl_error *error)
{
    tl_mesh surface = {.vertex_count = self->file.vertex_count};
    surface.vertices = tl_alloc(self->file.vertex_count, sizeof *surface.vertices);
    surface.indices = tl_alloc(self->file.triangle_count, 3 * sizeof *surface.indices);
    self->ideal = tl_alloc(self->mesh->vertex_count, sizeof *self->ideal);
    self->at = tl_alloc(self->file.vertex_count, sizeof *self->at);
    tl_status status = TL_OK;
    if (!surface.vertices || !surface.indices || !self->ideal || !self->at)
        status = tl_fail_memory(error, self->path);
    if (status == TL_OK)
        status = find_ideal(self, source->info.name, error);
    if (status == TL_OK)
        status = sort_ideal(self, error);
    if (status == TL_OK)
        status = take_surface(self, faces_up, &surface, error);
    dem_placed placed = {(const double(*)[3])self->at, {self->origin[0], self->origin[1], self->origin[2]}};
    if (status == TL_OK)
        status = dem_verify_placed(&surface, &placed, source, bounds, self->kind, run, out, error);
    free(surface.vertices);
    free(surface.indices);
    free(self->ideal);
    free(self->at);
    free(self->first);
    free(self->next);
    return status;
}

tl_status tl_mesh_verify_file(const char *path, const tl_mesh *mesh, const tl_source *source,
                              const tl_selection *bounds, tl_frame frame, const tl_run *run, tl_mesh_report *out,
                              tl_error *error)
{
    checker self = {.path = path, .mesh = mesh};
    out_frame *made = out_frame_create(mesh, frame, path, error);
    if (!made)
        return TL_ERROR_DATA;
    self.kind = out_frame_kind(made);
    self.bent = dem_frame_bends(&mesh->georef, self.kind);
    self.cell = step_of(&self);
    memcpy(self.origin, out_frame_origin(made), sizeof self.origin);
    bool faces_up = out_frame_faces_up(made);
    tl_status status = out_mesh_read(path, &self.file, error);
    for (size_t k = 0; status == TL_OK && self.kind == TL_FRAME_ECEF && k < self.file.vertex_count; k++) {
        const double geocentric[3] = {self.file.xyz[k][0], self.file.xyz[k][1], self.file.xyz[k][2]};
        out_frame_from_ecef(made, geocentric, self.file.xyz[k]);
    }
    out_frame_destroy(made);
    if (status == TL_OK)
        status = measure(&self, faces_up, source, bounds, run, out, error);
    out_mesh_free(&self.file);
    return status;
}
