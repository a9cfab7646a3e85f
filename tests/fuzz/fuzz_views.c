/* Files of views, as JSON, glTF or GLB, and rules of layers; the first byte chooses. */
#include "fuzz.h"
#include "lib/scene/layer_rules.h"

#include <math.h>
#include <stdlib.h>

static void check_view(const tl_view *view)
{
    for (int a = 0; a < 3; a++)
        fuzz_expect(isfinite(view->eye[a]) && isfinite(view->target[a]));
    fuzz_expect(isfinite(view->heading) && isfinite(view->pitch) && isfinite(view->roll));
    fuzz_expect(isfinite(view->fov) && isfinite(view->refraction));
    fuzz_expect(view->width >= 0 && view->height >= 0);
}

static void read_views(const char *path)
{
    enum { FRAMES = 5 };
    tl_error error = {0};
    tl_view_key *keys = NULL;
    size_t count = 0;
    tl_view frames[FRAMES];
    if (tl_view_path_read(path, &keys, &count, &error) != TL_OK) {
        fuzz_error(&error);
        return;
    }
    fuzz_expect(keys && count >= 1);
    for (size_t k = 0; k < count; k++)
        check_view(&keys[k].view);
    if (tl_view_path_sample(keys, count, FRAMES, frames, &error) != TL_OK)
        fuzz_error(&error);
    free(keys);
}

/* Shares of the ground add up to 1, whatever the rules are. */
static void read_rules(const char *path)
{
    static const double facts[][LAYER_FACTS] = {
        {0, 0, 0, 0}, {35, 1800, 0.01, 2}, {90, 8800, 1e30, 1e30}, {1, -400, -1e30, 0}};
    tl_error error = {0};
    layer_rules rules;
    if (layer_rules_read(path, &rules, &error) != TL_OK) {
        fuzz_error(&error);
        return;
    }
    for (size_t k = 0; k < sizeof facts / sizeof *facts; k++) {
        float shares[LAYER_CLASSES];
        double sum = 0;
        layer_rules_weigh(&rules, facts[k], shares);
        for (int c = 0; c < LAYER_CLASSES; c++) {
            fuzz_expect(shares[c] >= 0 && shares[c] <= 1);
            sum += (double)shares[c];
        }
        fuzz_expect(fabs(sum - 1) < 1e-6);
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    const char *path = size ? fuzz_file(data + 1, size - 1) : NULL;
    if (path)
        (data[0] & 1 ? read_rules : read_views)(path);
    return 0;
}
