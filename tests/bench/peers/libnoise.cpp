// Fractional noise by libnoise's Perlin module: libnoise SIZE HURST SEED FILE.f32. Four units a side, as its tutorials
// have it; octaves down to two samples; persistence 2^-H, which is what a fractional exponent H means there.
#include <libnoise/noise.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <vector>

int main(int argc, char **argv)
{
    if (argc != 5)
        return 2;
    const int size = std::atoi(argv[1]);
    const double units = 4;
    noise::module::Perlin perlin;
    perlin.SetSeed(std::atoi(argv[3]));
    perlin.SetLacunarity(2);
    perlin.SetPersistence(std::pow(2.0, -std::atof(argv[2])));
    perlin.SetOctaveCount(static_cast<int>(std::log2(size / units)));
    std::vector<float> row(size);
    FILE *file = std::fopen(argv[4], "wb");
    if (!file)
        return 1;
    bool good = true;
    for (int y = 0; y < size; y++) {
        for (int x = 0; x < size; x++)
            row[x] = static_cast<float>(perlin.GetValue(x * units / size, y * units / size, 0));
        good = std::fwrite(row.data(), sizeof row[0], row.size(), file) == row.size() && good;
    }
    return std::fclose(file) == 0 && good ? 0 : 1;
}
