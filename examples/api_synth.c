/* Fractal detail below an elevation model's samples, by the library:
 *   cc api_synth.c $(pkg-config --cflags --libs talus) -o api_synth && ./api_synth dem.tif terrain.exr 4 */
#include <stdio.h>
#include <stdlib.h>
#include <talus.h>

/* Opens, refines and writes; what went wrong is in *error. */
static tl_status synthesize(const char *input, const char *output, int levels, tl_error *error)
{
    tl_source *dem = tl_open(input, error);
    if (!dem)
        return error->status;
    tl_status status;
    tl_field_options options = {.levels = levels}; /* all else: measured from the model, seed 0 */
    tl_source *terrain = tl_field_create(dem, &options, error);
    if (terrain) {
        status = tl_write_grid(terrain, output, NULL, error);
        if (status == TL_OK)
            printf("talus %s: %lld x %lld samples\n", tl_version(), (long long)terrain->info.width,
                   (long long)terrain->info.height);
    } else
        status = error->status;
    tl_source_destroy(terrain); /* before what it was made from */
    tl_source_destroy(dem);
    return status;
}

int main(int argc, char **argv)
{
    if (argc != 4) {
        fprintf(stderr, "Usage: %s DEM OUTPUT LEVELS\n", argv[0]);
        return 2;
    }
    tl_error error;
    if (synthesize(argv[1], argv[2], atoi(argv[3]), &error) == TL_OK)
        return 0;
    fprintf(stderr, "%s\n", error.text);
    return 1;
}
