/* The order and the codecs of triangles and vertices: meshoptimizer's, or what stands in for it. */
#ifndef OUT_TRIANGLES_H
#define OUT_TRIANGLES_H

#include "lib/base/error.h"

#ifdef TL_HAVE_MESHOPT
#include <meshoptimizer.h>
enum { OUT_HAS_CODECS = 1 };
#else
#include <stddef.h>
enum { OUT_HAS_CODECS = 0 }; /* encoders give nothing, decoders fail */

void meshopt_optimizeVertexCache(unsigned *to, const unsigned *indices, size_t count, size_t vertices);
size_t meshopt_optimizeVertexFetch(void *to, unsigned *indices, size_t count, const void *from, size_t vertices,
                                   size_t size);
size_t meshopt_optimizeVertexFetchRemap(unsigned *to, const unsigned *indices, size_t count, size_t vertices);
void meshopt_remapVertexBuffer(void *to, const void *from, size_t vertices, size_t size, const unsigned *remap);
void meshopt_remapIndexBuffer(unsigned *to, const unsigned *indices, size_t count, const unsigned *remap);
void meshopt_encodeVertexVersion(int version);
void meshopt_encodeIndexVersion(int version);
size_t meshopt_encodeVertexBufferBound(size_t vertices, size_t size);
size_t meshopt_encodeIndexBufferBound(size_t count, size_t vertices);
size_t meshopt_encodeVertexBuffer(unsigned char *to, size_t room, const void *from, size_t vertices, size_t size);
size_t meshopt_encodeIndexBuffer(unsigned char *to, size_t room, const unsigned *indices, size_t count);
int meshopt_decodeVertexBuffer(void *to, size_t vertices, size_t size, const unsigned char *from, size_t room);
int meshopt_decodeIndexBuffer(void *to, size_t count, size_t size, const unsigned char *from, size_t room);
#endif

static inline tl_status out_lacks_codecs(const char *path, tl_error *error)
{
    return tl_fail(
        error, TL_ERROR_ARGUMENT,
        "%s: compressed triangles need meshoptimizer, which this build of talus is without; quantized ones do not",
        path);
}

#endif
