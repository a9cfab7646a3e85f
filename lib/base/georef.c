#include "lib/base/georef.h"

#include "lib/base/error.h"
#include "lib/base/size.h"

#include <stdio.h>
#include <string.h>

tl_crs *tl_crs_allocate(void)
{
    tl_crs *crs = calloc(1, sizeof *crs);
    if (crs)
        atomic_init(&crs->references, 1);
    return crs;
}

const tl_crs *tl_crs_retain(const tl_crs *crs)
{
    if (crs)
        atomic_fetch_add(&((tl_crs *)crs)->references, 1);
    return crs;
}

void tl_crs_release(const tl_crs *crs)
{
    tl_crs *own = (tl_crs *)crs;
    if (!own || atomic_fetch_sub(&own->references, 1) != 1)
        return;
    free(own->name);
    free(own->wkt);
    free(own->horizontal_wkt);
    free(own->vertical_name);
    free(own->key_directory);
    free(own->key_doubles);
    free(own->key_ascii);
    free(own);
}

const char *tl_crs_name(const tl_crs *crs)
{
    return crs->name;
}

const char *tl_crs_wkt(const tl_crs *crs)
{
    return crs->wkt;
}

int tl_crs_epsg(const tl_crs *crs)
{
    return crs->epsg;
}

const char *tl_crs_vertical_name(const tl_crs *crs)
{
    return crs->vertical_name ? crs->vertical_name : "";
}

int tl_crs_vertical_epsg(const tl_crs *crs)
{
    return crs->vertical_epsg;
}

bool tl_crs_is_geographic(const tl_crs *crs)
{
    return crs->geographic;
}

tl_georef tl_georef_none(void)
{
    return (tl_georef){.transform = {0, 1, 0, 0, 0, -1}, .cell_x = 1, .cell_y = 1, .height_unit = 1};
}

tl_parameter *tl_parameters_copy(const tl_parameter *parameters, size_t count)
{
    size_t bytes = count * sizeof *parameters;
    for (size_t i = 0; i < count; i++)
        bytes += strlen(parameters[i].name) + strlen(parameters[i].value) + 2;
    tl_parameter *copy = count ? malloc(bytes) : NULL;
    if (!copy)
        return NULL;
    char *text = (char *)(copy + count);
    for (size_t i = 0; i < count; i++) {
        copy[i].name = strcpy(text, parameters[i].name);
        text += strlen(text) + 1;
        copy[i].value = strcpy(text, parameters[i].value);
        text += strlen(text) + 1;
    }
    return copy;
}

tl_status tl_parameters_add(tl_parameter **list, size_t *count, const char *name, const char *value, tl_error *error)
{
    tl_parameter *longer = tl_alloc(*count + 1, sizeof *longer);
    if (!longer)
        return tl_fail_memory(error, "the record of parameters");
    if (*count)
        memcpy(longer, *list, *count * sizeof *longer);
    longer[*count] = (tl_parameter){.name = name, .value = value};
    tl_parameter *copy = tl_parameters_copy(longer, *count + 1);
    free(longer);
    if (!copy)
        return tl_fail_memory(error, "the record of parameters");
    free(*list);
    *list = copy;
    ++*count;
    return TL_OK;
}

/* "name: value; name: value", to be freed; NULL when out of memory. */
static char *join_parameters(const tl_parameter *parameters, size_t count)
{
    size_t bytes = 1;
    for (size_t i = 0; i < count; i++)
        bytes += strlen(parameters[i].name) + strlen(parameters[i].value) + 4;
    char *text = malloc(bytes), *at = text;
    for (size_t i = 0; text && i < count; i++)
        at += snprintf(at, bytes - (size_t)(at - text), "%s%s: %s", i ? "; " : "", parameters[i].name,
                       parameters[i].value);
    return text;
}

tl_status tl_parameters_add_origin(tl_parameter **list, size_t *count, const tl_source_info *input, tl_error *error)
{
    const char *slash = strrchr(input->name, '/');
    char *name = strdup(slash ? slash + 1 : input->name);
    char *made_by = input->parameter_count ? join_parameters(input->parameters, input->parameter_count) : NULL;
    tl_status status = TL_OK;
    if (!name || (input->parameter_count && !made_by))
        status = tl_fail_memory(error, "the record of parameters");
    if (status == TL_OK)
        status = tl_parameters_add(list, count, "version", tl_version(), error);
    if (status == TL_OK) {
        tl_make_printable(name); /* any bytes may stand in a file's name */
        status = tl_parameters_add(list, count, "input", name, error);
    }
    if (status == TL_OK && made_by)
        status = tl_parameters_add(list, count, "made_by", made_by, error);
    free(name);
    free(made_by);
    return status;
}

tl_mesh *tl_mesh_create(size_t vertices, size_t triangles, const tl_source_info *grid, tl_error *error)
{
    tl_mesh *mesh = calloc(1, sizeof *mesh);
    size_t indices = 0;
    if (mesh) {
        mesh->vertices = tl_alloc(vertices, sizeof *mesh->vertices);
        mesh->indices = tl_size_mul(triangles, 3, &indices) ? tl_alloc(indices, sizeof *mesh->indices) : NULL;
        mesh->parameters = tl_parameters_copy(grid->parameters, grid->parameter_count);
        mesh->georef = grid->georef;
        tl_crs_retain(mesh->georef.crs);
    }
    if (!mesh || !mesh->vertices || !mesh->indices || (grid->parameter_count && !mesh->parameters)) {
        tl_mesh_destroy(mesh);
        tl_fail_memory(error, "the mesh");
        return NULL;
    }
    mesh->vertex_count = vertices;
    mesh->triangle_count = triangles;
    mesh->parameter_count = grid->parameter_count;
    mesh->type = grid->type;
    return mesh;
}

tl_status tl_mesh_add_parameter(tl_mesh *mesh, const char *name, const char *value, tl_error *error)
{
    return tl_parameters_add(&mesh->parameters, &mesh->parameter_count, name, value, error);
}

void tl_mesh_destroy(tl_mesh *mesh)
{
    if (!mesh)
        return;
    tl_crs_release(mesh->georef.crs);
    free(mesh->vertices);
    free(mesh->indices);
    free(mesh->parameters);
    free(mesh);
}
