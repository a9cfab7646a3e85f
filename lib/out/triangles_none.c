/* In a build without meshoptimizer triangles keep their order, vertices stand in the order in which triangles ask for
 * them, and nothing is encoded. */
#include "lib/out/triangles.h"

#include <stdlib.h>
#include <string.h>

void meshopt_optimizeVertexCache(unsigned *to, const unsigned *indices, size_t count, size_t vertices)
{
    (void)vertices;
    memmove(to, indices, count * sizeof *to);
}

size_t meshopt_optimizeVertexFetchRemap(unsigned *to, const unsigned *indices, size_t count, size_t vertices)
{
    size_t next = 0;
    memset(to, 0xff, vertices * sizeof *to);
    for (size_t k = 0; k < count; k++)
        if (to[indices[k]] == ~0U)
            to[indices[k]] = (unsigned)next++;
    return next;
}

void meshopt_remapVertexBuffer(void *to, const void *from, size_t vertices, size_t size, const unsigned *remap)
{
    for (size_t k = 0; k < vertices; k++)
        if (remap[k] != ~0U)
            memcpy((char *)to + remap[k] * size, (const char *)from + k * size, size);
}

void meshopt_remapIndexBuffer(unsigned *to, const unsigned *indices, size_t count, const unsigned *remap)
{
    for (size_t k = 0; k < count; k++)
        to[k] = remap[indices[k]];
}

/* Without memory for the remapping, the vertices stay where they are. */
size_t meshopt_optimizeVertexFetch(void *to, unsigned *indices, size_t count, const void *from, size_t vertices,
                                   size_t size)
{
    unsigned *remap = malloc(vertices * sizeof *remap + 1);
    if (!remap) {
        memmove(to, from, vertices * size);
        return vertices;
    }
    size_t used = meshopt_optimizeVertexFetchRemap(remap, indices, count, vertices);
    if (to == from) {
        void *copy = malloc(vertices * size + 1);
        if (copy) {
            memcpy(copy, from, vertices * size);
            meshopt_remapVertexBuffer(to, copy, vertices, size, remap);
            meshopt_remapIndexBuffer(indices, indices, count, remap);
        } else
            used = vertices;
        free(copy);
    } else {
        meshopt_remapVertexBuffer(to, from, vertices, size, remap);
        meshopt_remapIndexBuffer(indices, indices, count, remap);
    }
    free(remap);
    return used;
}

void meshopt_encodeVertexVersion(int version)
{
    (void)version;
}

void meshopt_encodeIndexVersion(int version)
{
    (void)version;
}

size_t meshopt_encodeVertexBufferBound(size_t vertices, size_t size)
{
    return vertices * size;
}

size_t meshopt_encodeIndexBufferBound(size_t count, size_t vertices)
{
    (void)vertices;
    return count * sizeof(unsigned);
}

size_t meshopt_encodeVertexBuffer(unsigned char *to, size_t room, const void *from, size_t vertices, size_t size)
{
    (void)to;
    (void)room;
    (void)from;
    (void)vertices;
    (void)size;
    return 0;
}

size_t meshopt_encodeIndexBuffer(unsigned char *to, size_t room, const unsigned *indices, size_t count)
{
    (void)to;
    (void)room;
    (void)indices;
    (void)count;
    return 0;
}

int meshopt_decodeVertexBuffer(void *to, size_t vertices, size_t size, const unsigned char *from, size_t room)
{
    (void)to;
    (void)vertices;
    (void)size;
    (void)from;
    (void)room;
    return -1;
}

int meshopt_decodeIndexBuffer(void *to, size_t count, size_t size, const unsigned char *from, size_t room)
{
    (void)to;
    (void)count;
    (void)size;
    (void)from;
    (void)room;
    return -1;
}
