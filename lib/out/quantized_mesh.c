#include "lib/out/quantized_mesh.h"

#include "lib/base/error.h"
#include "lib/base/size.h"
#include "lib/scene/geodetic.h"

#include <libdeflate.h>

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { HEADER = 88, MOST = 32767, LEVEL = 3, OCT_NORMALS = 1, METADATA = 4, LINE = SCENE_RIM + 1 };

/* WGS 84, metres. */
static const double semi_major = 6378137, flattening = 1 / 298.257223563;
static const double degree = 3.14159265358979323846 / 180;
/* What is in no tile: the far end of the direction in which a tile that goes around half of the world lies. */
static const double far_away = 1e6;

tl_status out_terrain_buffer_init(out_terrain_buffer *buffer, tl_error *error)
{
    *buffer = (out_terrain_buffer){.compressor = libdeflate_alloc_compressor(LEVEL)};
    return buffer->compressor ? TL_OK : tl_fail_memory(error, "a tile");
}

void out_terrain_buffer_finish(out_terrain_buffer *buffer)
{
    if (buffer->compressor)
        libdeflate_free_compressor(buffer->compressor);
    free(buffer->raw);
    free(buffer->packed);
    *buffer = (out_terrain_buffer){0};
}

/* ---- Bytes ---- */

static void put(out_terrain_buffer *to, const void *bytes, size_t count)
{
    memcpy(to->raw + to->raw_count, bytes, count);
    to->raw_count += count;
}

static void put16(out_terrain_buffer *to, unsigned value)
{
    const unsigned char bytes[2] = {(unsigned char)value, (unsigned char)(value >> 8)};
    put(to, bytes, sizeof bytes);
}

static void put32(out_terrain_buffer *to, uint32_t value)
{
    put16(to, value & 0xffff);
    put16(to, value >> 16);
}

static void put_double(out_terrain_buffer *to, double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    put32(to, (uint32_t)bits);
    put32(to, (uint32_t)(bits >> 32));
}

static void put_float(out_terrain_buffer *to, float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    put32(to, bits);
}

/* Differences of a coordinate from vertex to vertex, the sign in the lowest bit. */
static void put_difference(out_terrain_buffer *to, int value, int *last)
{
    int difference = value - *last;
    *last = value;
    put16(to, (unsigned)(difference < 0 ? -2 * difference - 1 : 2 * difference));
}

/* ---- Where vertices are ---- */

/* Of a tile: sines and cosines by column and row. */
typedef struct trigonometry {
    double cos_x[LINE], sin_x[LINE], cos_y[LINE], sin_y[LINE];
    double low, high;         /* heights, metres */
    double centre[3], radius; /* of a ball around it */
} trigonometry;

static void find_trigonometry(const out_terrain_tile *tile, trigonometry *t)
{
    int cells = tile->mesh->cells;
    double side = 180 / ldexp(1, tile->level);
    for (int k = 0; k <= cells; k++) {
        double east = ((double)tile->column + (double)k / cells) * side;
        double longitude = (east < 360 ? east - 180 : -180) * degree; /* one number for the one meridian */
        double latitude = (-90 + ((double)tile->row + (double)k / cells) * side) * degree;
        t->cos_x[k] = cos(longitude), t->sin_x[k] = sin(longitude);
        t->cos_y[k] = cos(latitude), t->sin_y[k] = sin(latitude);
    }
    t->low = HUGE_VAL, t->high = -HUGE_VAL;
    for (size_t k = 0; k < tile->mesh->vertex_count; k++) {
        double z = (double)tile->mesh->vertices[k].z;
        t->low = z < t->low ? z : t->low;
        t->high = z > t->high ? z : t->high;
    }
}

/* [Hofmann-Wellenhof et al., Physical Geodesy: ellipsoidal to Cartesian coordinates] */
static void place(const trigonometry *t, int i, int j, double h, double out[3])
{
    const double e2 = flattening * (2 - flattening);
    double normal = semi_major / sqrt(1 - e2 * t->sin_y[j] * t->sin_y[j]);
    out[0] = (normal + h) * t->cos_y[j] * t->cos_x[i];
    out[1] = (normal + h) * t->cos_y[j] * t->sin_x[i];
    out[2] = (normal * (1 - e2) + h) * t->sin_y[j];
}

static void place_vertex(const out_terrain_tile *tile, const trigonometry *t, size_t k, double out[3])
{
    const struct scene_tile_vertex *v = &tile->mesh->vertices[k];
    place(t, v->i, v->j, (double)v->z, out);
}

static double greater(double a, double b)
{
    return a > b ? a : b;
}

static double dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void find_ball(const out_terrain_tile *tile, trigonometry *t)
{
    int middle = tile->mesh->cells / 2;
    double p[3];
    place(t, middle, middle, 0.5 * (t->low + t->high), t->centre);
    t->radius = 0;
    for (size_t k = 0; k < tile->mesh->vertex_count; k++) {
        place_vertex(tile, t, k, p);
        const double d[3] = {p[0] - t->centre[0], p[1] - t->centre[1], p[2] - t->centre[2]};
        t->radius = greater(t->radius, dot(d, d));
    }
    t->radius = sqrt(t->radius);
}

/* The point that lies behind the horizon only where the whole tile does: in the direction of the ball's centre, where
 * the horizons of all vertices cut it, in units of the ellipsoid's radii [Ring, "Horizon culling", 2013]. */
static void find_horizon(const out_terrain_tile *tile, const trigonometry *t, double out[3])
{
    const double radii[3] = {semi_major, semi_major, semi_major * (1 - flattening)};
    double direction[3], length, farthest = 0;
    for (int a = 0; a < 3; a++)
        direction[a] = t->centre[a] / radii[a];
    length = sqrt(dot(direction, direction));
    for (int a = 0; a < 3; a++)
        direction[a] = length > 1e-9 ? direction[a] / length : a == 0;
    for (size_t k = 0; k < tile->mesh->vertex_count; k++) {
        double p[3];
        place_vertex(tile, t, k, p);
        for (int a = 0; a < 3; a++)
            p[a] /= radii[a];
        double square = dot(p, p), along = dot(p, direction) / sqrt(square);
        double magnitude = sqrt(greater(square, 1)), across = sqrt(greater(1 - along * along, 0));
        double near = along / magnitude - across * sqrt(greater(square, 1) - 1) / magnitude;
        farthest = greater(farthest, near > 1 / far_away ? 1 / near : far_away);
    }
    for (int a = 0; a < 3; a++)
        out[a] = direction[a] * farthest;
}

/* ---- Normals ---- */

/* In the axes of the Earth, by differences of the lattice's heights, which neighbours share; rows at the poles and the
 * block's outermost ones have none beyond them. */
static void find_normal(const out_terrain_tile *tile, const trigonometry *t, const struct scene_tile_vertex *v,
                        double out[3])
{
    const float *z = tile->block->z;
    const int row = SCENE_BLOCK_VERTICES;
    int x = tile->x + v->i, y = tile->y + v->j;
    double step = 180 / ldexp(1, tile->level) / tile->mesh->cells * degree * semi_major;
    double east = ((double)z[y * row + x + 1] - (double)z[y * row + x - 1]) / (2 * step * fmax(t->cos_y[v->j], 1e-6));
    double north = ((double)z[(y + 1) * row + x] - (double)z[(y - 1) * row + x]) / (2 * step);
    double length = sqrt(1 + east * east + north * north);
    const double e = -east / length, n = -north / length, u = 1 / length;
    double cx = t->cos_x[v->i], sx = t->sin_x[v->i], cy = t->cos_y[v->j], sy = t->sin_y[v->j];
    out[0] = -sx * e - sy * cx * n + cy * cx * u;
    out[1] = cx * e - sy * sx * n + cy * sx * u;
    out[2] = cy * n + sy * u;
}

static unsigned char to_byte(double value)
{
    return (unsigned char)lrint((fmin(fmax(value, -1), 1) * 0.5 + 0.5) * 255);
}

/* Two bytes [Cigolle et al., "A survey of efficient representations for independent unit vectors", 2014]. */
static void put_octahedral(out_terrain_buffer *to, const double n[3])
{
    double sum = fabs(n[0]) + fabs(n[1]) + fabs(n[2]), x = n[0] / sum, y = n[1] / sum;
    if (n[2] < 0) {
        double folded = (1 - fabs(y)) * (x < 0 ? -1 : 1);
        y = (1 - fabs(x)) * (y < 0 ? -1 : 1);
        x = folded;
    }
    const unsigned char bytes[2] = {to_byte(x), to_byte(y)};
    put(to, bytes, sizeof bytes);
}

static void put_normals(const out_terrain_tile *tile, const trigonometry *t, out_terrain_buffer *to)
{
    const unsigned char id = OCT_NORMALS;
    put(to, &id, 1);
    put32(to, (uint32_t)(2 * tile->mesh->vertex_count));
    for (size_t k = 0; k < tile->mesh->vertex_count; k++) {
        double normal[3];
        find_normal(tile, t, &tile->mesh->vertices[k], normal);
        put_octahedral(to, normal);
    }
}

static void put_metadata(const char *text, out_terrain_buffer *to)
{
    const unsigned char id = METADATA;
    put(to, &id, 1);
    put32(to, (uint32_t)(strlen(text) + 4));
    put32(to, (uint32_t)strlen(text));
    put(to, text, strlen(text));
}

/* ---- Parts of a tile ---- */

/* The smallest power of two in which 32767 steps hold the relief, at least a millimetre; the header gives the lowest
 * and highest height in single precision, which must hold them. */
static double quantum_of(const trigonometry *t)
{
    double q = 0x1p-10;
    while ((MOST - 1) * q < t->high - t->low || 0x1p24 * q < fmax(fabs(t->low), fabs(t->high)) + (MOST + 1) * q)
        q *= 2;
    return q;
}

static void put_header(const out_terrain_tile *tile, const trigonometry *t, double low, double q,
                       out_terrain_buffer *to)
{
    double horizon[3];
    find_horizon(tile, t, horizon);
    for (int a = 0; a < 3; a++)
        put_double(to, t->centre[a]);
    put_float(to, (float)low);
    put_float(to, (float)(low + MOST * q));
    for (int a = 0; a < 3; a++)
        put_double(to, t->centre[a]);
    put_double(to, t->radius * (1 + 1e-9) + q);
    for (int a = 0; a < 3; a++)
        put_double(to, horizon[a]);
}

static void put_vertices(const scene_tile_mesh *mesh, double low, double q, out_terrain_buffer *to)
{
    int last = 0;
    put32(to, (uint32_t)mesh->vertex_count);
    for (size_t k = 0; k < mesh->vertex_count; k++)
        put_difference(to, (mesh->vertices[k].i * MOST + mesh->cells / 2) / mesh->cells, &last);
    last = 0;
    for (size_t k = 0; k < mesh->vertex_count; k++)
        put_difference(to, (mesh->vertices[k].j * MOST + mesh->cells / 2) / mesh->cells, &last);
    last = 0; /* halves go up, for tiles with any lowest height; rint would make them even steps above it */
    for (size_t k = 0; k < mesh->vertex_count; k++)
        put_difference(to, (int)floor(((double)mesh->vertices[k].z - low) / q + 0.5), &last);
}

static void put_index(out_terrain_buffer *to, bool wide, uint32_t value)
{
    if (wide)
        put32(to, value);
    else
        put16(to, value);
}

/* Each as its distance below the highest so far: vertices are numbered as they are first met. */
static void put_triangles(const scene_tile_mesh *mesh, bool wide, out_terrain_buffer *to)
{
    uint32_t highest = 0;
    while (wide && to->raw_count % 4)
        to->raw[to->raw_count++] = 0;
    put32(to, (uint32_t)mesh->triangle_count);
    for (size_t k = 0; k < 3 * mesh->triangle_count; k++) {
        put_index(to, wide, highest - mesh->indices[k]);
        highest += mesh->indices[k] == highest;
    }
}

/* The vertices of the west, south, east and north edge, in order along it. */
static void put_edges(const scene_tile_mesh *mesh, bool wide, out_terrain_buffer *to)
{
    int side = mesh->cells, row = side + 1;
    for (int edge = 0; edge < 4; edge++) {
        size_t count_at = to->raw_count;
        uint32_t count = 0;
        put32(to, 0);
        for (int k = 0; k <= side; k++) {
            int at = edge == 0 ? k * row : edge == 1 ? k : edge == 2 ? k * row + side : side * row + k;
            if (mesh->numbers[at] < 0)
                continue;
            put_index(to, wide, (uint32_t)mesh->numbers[at]);
            count++;
        }
        size_t end = to->raw_count;
        to->raw_count = count_at;
        put32(to, count);
        to->raw_count = end;
    }
}

static bool make_room(out_terrain_buffer *to, const out_terrain_tile *tile)
{
    const scene_tile_mesh *mesh = tile->mesh;
    size_t most = HEADER + 64 + 8 * mesh->vertex_count + 12 * mesh->triangle_count + 16 * (size_t)(mesh->cells + 1) +
                  (tile->metadata ? strlen(tile->metadata) + 16 : 0);
    size_t packed = libdeflate_gzip_compress_bound(to->compressor, most);
    to->raw_count = to->packed_count = 0;
    if (most > to->raw_room) {
        free(to->raw);
        to->raw = malloc(most);
        to->raw_room = to->raw ? most : 0;
    }
    if (packed > to->packed_room) {
        free(to->packed);
        to->packed = malloc(packed);
        to->packed_room = to->packed ? packed : 0;
    }
    return to->raw && to->packed;
}

tl_status out_terrain_encode(const out_terrain_tile *tile, out_terrain_buffer *buffer, double *quantum, tl_error *error)
{
    const scene_tile_mesh *mesh = tile->mesh;
    bool wide = mesh->vertex_count > 65536;
    trigonometry t;
    if (!make_room(buffer, tile))
        return tl_fail_memory(error, "a tile");
    find_trigonometry(tile, &t);
    find_ball(tile, &t);
    *quantum = quantum_of(&t);
    double low = floor(t.low / *quantum) * *quantum;
    put_header(tile, &t, low, *quantum, buffer);
    put_vertices(mesh, low, *quantum, buffer);
    put_triangles(mesh, wide, buffer);
    put_edges(mesh, wide, buffer);
    if (tile->normals)
        put_normals(tile, &t, buffer);
    if (tile->metadata)
        put_metadata(tile->metadata, buffer);
    buffer->packed_count = libdeflate_gzip_compress(buffer->compressor, buffer->raw, buffer->raw_count, buffer->packed,
                                                    buffer->packed_room);
    return buffer->packed_count ? TL_OK : tl_fail_memory(error, "a tile");
}
