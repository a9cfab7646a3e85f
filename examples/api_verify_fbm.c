/* Checks the statistics of a surface: fractional Brownian motion of a given H and delta, or not. For the tests of any
 * program that makes such surfaces: fill an array, or open a raster.
 *   cc api_verify_fbm.c $(pkg-config --cflags --libs talus) -o api_verify_fbm && ./api_verify_fbm [RASTER HURST DELTA]
 */
#include <stdio.h>
#include <stdlib.h>
#include <talus.h>

/* Without a raster: one that is what it is said to be. */
static tl_source *make_surface(double hurst, double delta, tl_error *error)
{
    tl_noise_options options = {.size = 513, .hurst = hurst, .delta = delta, .seed = 7};
    return tl_noise_create(&options, error);
}

/* Four standard errors, which a right surface passes but once in 16,000; and nothing finer than 0.5 %. */
static double tolerance_of(const tl_fbm_estimate *estimate)
{
    double hurst = 4 * estimate->hurst_error, delta = 4 * estimate->delta_error / (estimate->delta + 1e-300);
    double larger = hurst > delta ? hurst : delta;
    return larger > 0.005 ? larger : 0.005;
}

static tl_status verify(const tl_source *surface, double hurst, double delta, tl_error *error)
{
    tl_statistics s;
    tl_status status = tl_statistics_measure(surface, NULL, &s, error);
    if (status != TL_OK)
        return status;
    const tl_fbm_estimate *e = &s.estimates[0];
    if (!e->refusal)
        printf("H %.3f +- %.3f, delta %.3f +- %.3f\n", e->hurst, e->hurst_error, e->delta, e->delta_error);
    for (int k = 0; k < 3; k++)
        if (s.positions[k] > s.position_limits[k])
            printf("not stationary: variances differ by a factor of %.2f\n", s.positions[k]);
    if (s.anisotropy > 0 && s.isotropy_chance < 0.001)
        printf("not isotropic: rougher by a factor of %.2f at %.0f degrees\n", s.anisotropy, s.azimuth);
    if (s.normality_lag && s.normality_chance < 0.001)
        printf("not Gaussian: excess kurtosis %.2f +- %.2f\n", s.kurtosis, s.kurtosis_error);
    tl_expectation expected = {.hurst_given = true,
                               .delta_given = true,
                               .hurst = hurst,
                               .delta = delta,
                               .tolerance = e->refusal ? 0 : tolerance_of(e)};
    return tl_statistics_expect(&s, &expected, surface->info.name, error);
}

int main(int argc, char **argv)
{
    if (argc != 1 && argc != 4) {
        fprintf(stderr, "Usage: %s [RASTER HURST DELTA]\n", argv[0]);
        return 2;
    }
    double hurst = argc > 1 ? atof(argv[2]) : 0.7, delta = argc > 1 ? atof(argv[3]) : 2;
    tl_error error;
    tl_source *surface = argc > 1 ? tl_open(argv[1], &error) : make_surface(hurst, delta, &error);
    tl_status status = surface ? verify(surface, hurst, delta, &error) : error.status;
    tl_source_destroy(surface);
    if (status == TL_OK)
        return 0;
    fprintf(stderr, "%s\n", error.text);
    return 1;
}
