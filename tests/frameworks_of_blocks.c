/* Prints what frameworks of many rasters are, one a line: for tests/check_blocks.sh. */
#include "lib/talus.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>

#define assert_non_null(p) (void)(p)
#include "tests/grids.h"

static uint64_t hash_of(uint64_t hash, const void *bytes, size_t count)
{
    for (size_t k = 0; k < count; k++)
        hash = (hash ^ ((const unsigned char *)bytes)[k]) * UINT64_C(0x100000001b3);
    return hash;
}

/* A triangle, the least of its corners first. */
typedef struct triangle {
    uint32_t corners[3];
} triangle;

static int compare(const void *a, const void *b)
{
    const triangle *one = a, *two = b;
    for (int k = 0; k < 3; k++)
        if (one->corners[k] != two->corners[k])
            return one->corners[k] < two->corners[k] ? -1 : 1;
    return 0;
}

/* Vertices as they come, triangles as a set: blocks decide the order in which these are drawn. */
static int print_mesh(const char *what, int round, const tl_framework *framework)
{
    tl_mesh *mesh = NULL;
    if (!framework || tl_framework_mesh(framework, &mesh, NULL) != TL_OK)
        return 1;
    triangle *all = malloc((mesh->triangle_count + 1) * sizeof *all);
    for (size_t t = 0; t < mesh->triangle_count; t++) {
        const uint32_t *c = mesh->indices + 3 * t;
        int least = c[0] < c[1] && c[0] < c[2] ? 0 : c[1] < c[2] ? 1 : 2;
        for (int k = 0; k < 3; k++)
            all[t].corners[k] = c[(least + k) % 3];
    }
    qsort(all, mesh->triangle_count, sizeof *all, compare);
    uint64_t hash = hash_of(UINT64_C(0xcbf29ce484222325), mesh->vertices, mesh->vertex_count * sizeof *mesh->vertices);
    hash = hash_of(hash, all, mesh->triangle_count * sizeof *all);
    printf("%s %d: %zu vertices, %zu triangles, bound %.9g, %016llx\n", what, round, mesh->vertex_count,
           mesh->triangle_count, tl_framework_max_error(framework), (unsigned long long)hash);
    free(all);
    tl_mesh_destroy(mesh);
    return 0;
}

static int print_round(int round)
{
    static const double bounds[] = {0, 1, 3, 20};
    grid of = make_grid(40 + random_below(700), 40 + random_below(700), (terrain)(round % TERRAIN_WIDE),
                        (voids)(round % 3 ? VOIDS_NONE : round % VOIDS_KINDS));
    tl_source *source = open_grid(&of);
    tl_framework *plain = tl_framework_build(source, &(tl_framework_options){.max_error = bounds[round % 4]}, NULL);
    int failed = print_mesh("built", round, plain);
    tl_framework_destroy(plain);
    tl_pyramid *pyramid = tl_pyramid_create(source, &(tl_pyramid_options){.exact = true}, NULL);
    for (int budget = 0; !failed && pyramid && budget < 2; budget++) {
        tl_selection selection = {.max_error = bounds[(round + 1) % 4],
                                  .vertices = budget ? (uint64_t)(of.width * of.height / 2) : 0};
        tl_framework *chosen = tl_framework_from_pyramid(pyramid, source, &selection, NULL);
        if (!chosen && budget)
            printf("budget %d: refused\n", round); /* fewer than what voids and rims take */
        else
            failed = print_mesh(budget ? "budget" : "chosen", round, chosen);
        tl_framework_destroy(chosen);
    }
    tl_pyramid_destroy(pyramid);
    tl_source_destroy(source);
    free(of.z);
    return failed || !pyramid;
}

int main(void)
{
    random_state = 2;
    int failed = 0;
    for (int round = 0; !failed && round < 24; round++)
        failed = print_round(round);
    return failed;
}
