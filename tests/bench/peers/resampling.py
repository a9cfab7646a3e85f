#!/usr/bin/python3
"""A DEM averaged down and amplified again, by talus and by gdalwarp, side by side, as a Markdown table.

  resampling.py TALUS DEM [--levels 3]

gdalwarp (Debian's gdal-bin) and python3-numpy are needed. The means of blocks of 2^LEVELS samples are all that the programs
see; cells of degrees become metres at the DEM's middle. The columns: the worst |ln| ratio of the structure function to the DEM's
own at the lags 1, 2, 4 ... 2^(LEVELS + 1) in four directions; the mean of |dz| over one sample, as a share of the DEM's own (1 is right, less is too smooth); the root mean square
distance from the DEM (a smooth surface wins it: detail that is made stands elsewhere than the real); CPU nanoseconds a sample of
the whole process, the least of three."""
import argparse
import json
import math
import pathlib
import subprocess
import sys
import tempfile

import numpy

from measure import increments, measured, read_raw, structure

METHODS = ("near", "bilinear", "cubic", "cubicspline", "lanczos")
METRES_A_DEGREE = 111000


def shape_of(path):
    """Width and height in samples, and those of a cell in metres."""
    found = json.loads(subprocess.run(["gdalinfo", "-json", str(path)], check=True, capture_output=True, text=True).stdout)
    _, cell_x, _, north, _, cell_y = map(abs, found["geoTransform"])
    if cell_y < 0.1:  # degrees
        cell_x, cell_y = METRES_A_DEGREE * cell_x * math.cos(math.radians(north - cell_y * found["size"][1] / 2)), METRES_A_DEGREE * cell_y
    return (*found["size"], cell_x, cell_y)


def translate(source, to, *options):
    subprocess.run(["gdal_translate", "-q", *options, str(source), str(to)], check=True)


def steepness(z):
    return numpy.mean([numpy.mean(abs(d)) for d in increments(z, 1)[:2]])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("talus")
    parser.add_argument("dem", type=pathlib.Path)
    parser.add_argument("--levels", type=int, default=3)
    arguments = parser.parse_args()
    factor = 2 ** arguments.levels
    width, height, cell_x, cell_y = shape_of(arguments.dem)
    width, height = width // factor * factor, height // factor * factor
    with tempfile.TemporaryDirectory() as folder:
        fine, coarse, made, raw = (f"{folder}/{name}" for name in ("fine.tif", "coarse.tif", "made.tif", "made.f32"))
        corner = ["0", "0", str(width * cell_x), str(height * cell_y)]  # west, south, east, north, in metres
        flat = ["-a_ullr", corner[0], corner[3], corner[2], corner[1], "-a_srs", "EPSG:32632", "-ot", "Float32"]
        translate(arguments.dem, fine, "-srcwin", "0", "0", str(width), str(height), *flat, "-mo", "AREA_OR_POINT=Area")
        warp = ["gdalwarp", "-q", "-overwrite", "-et", "0"]
        subprocess.run([*warp, "-r", "average", "-tr", str(factor * cell_x), str(factor * cell_y), "-te", *corner, fine, coarse], check=True)
        translate(fine, raw, "-of", "ENVI")
        truth = read_raw(raw, width)
        lags = [2 ** k for k in range(arguments.levels + 2)]
        wanted = structure(truth, lags)
        every = {"talus": [arguments.talus, "synth", coarse, "--levels", str(arguments.levels), "--threads", "1", "--quiet",
                           "--overwrite", "-o", made]}
        for method in METHODS:
            every[f"gdalwarp, {method}"] = [*warp, "-r", method, "-ts", str(width), str(height), "-te", *corner, coarse, made]
        print("| amplified by | structure | steepness | rms | CPU, ns |")
        print("|---|---|---|---|---|")
        for name, command in every.items():
            used = measured(command)
            if not used:
                print(f"{name} failed: {' '.join(command)}", file=sys.stderr)
                continue
            translate(made, raw, "-of", "ENVI")
            z = read_raw(raw, width)
            ratio = numpy.log(structure(z, lags) / wanted)
            print(f"| {name} | {abs(ratio).max():.2f} | {steepness(z) / steepness(truth):.2f} | "
                  f"{numpy.sqrt(numpy.mean((z - truth) ** 2)):.1f} | {1e9 * used[0] / (width * height):.0f} |", flush=True)


if __name__ == "__main__":
    main()
