#!/usr/bin/python3
"""Fractional noise by every scheme of talus and by libnoise, side by side, as a Markdown table.

  noise.py TALUS [--size 1024] [--hurst 0.3,0.5,0.8] [--seeds 16]

libnoise (Debian's libnoise-dev), g++ and python3-numpy are needed. The columns, over SEEDS surfaces of SIZE x SIZE samples:
H by a line through the structure functions of the lags 1, 2, 4 ... 32 (four directions pooled), with the standard error of
its mean over the seeds; the worst |ln| of the structure function over that of the H asked, its scale fitted, at these lags and
directions; the largest over the smallest variance of increments of one sample, by their place modulo 8 on the lattice, which
is 1 but for sampling where increments are stationary; CPU nanoseconds a sample of the whole process, the least of three."""
import argparse
import pathlib
import subprocess
import sys
import tempfile

import numpy

from measure import increments, measured, read_raw, structure

HERE = pathlib.Path(__file__).resolve().parent
LAGS = (1, 2, 4, 8, 16, 32)
SCHEMES = ("stationary", "exact", "square", "square-square", "diamond-square", "successive")
PERIOD = 8


def by_place(z):
    """Mean squares of increments of one sample along rows, by their place modulo PERIOD."""
    squares = increments(z, 1)[0] ** 2
    squares = squares[: squares.shape[0] // PERIOD * PERIOD, : squares.shape[1] // PERIOD * PERIOD]
    return squares.reshape(squares.shape[0] // PERIOD, PERIOD, -1, PERIOD).mean(axis=(0, 2))


def row(name, commands, hurst, size, raw):
    used = measured(commands[0])
    if not used:
        print(f"{name} failed: {' '.join(commands[0])}", file=sys.stderr)
        return None
    functions, places = [], []
    for command in commands:
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        z = read_raw(raw, size)
        functions.append(structure(z, LAGS))
        places.append(by_place(z))
    logs = numpy.log(numpy.array(functions).mean(axis=2))
    slopes = [numpy.polyfit(numpy.log(LAGS), log, 1)[0] / 2 for log in logs]
    diagonal = numpy.array([1, 1, 2, 2])
    model = (numpy.array(LAGS)[:, None] ** 2 * diagonal) ** hurst
    ratio = numpy.log(numpy.mean(functions, axis=0) / model)
    ratio -= (ratio.max() + ratio.min()) / 2
    place = numpy.mean(places, axis=0)
    error = numpy.std(slopes, ddof=1) / len(slopes) ** 0.5
    return (f"| {hurst:g} | {name} | {numpy.mean(slopes):.3f} ± {error:.3f} | {abs(ratio).max():.3f} | "
            f"{place.max() / place.min():.2f} | {1e9 * used[0] / size ** 2:.1f} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("talus")
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--hurst", default="0.3,0.5,0.8")
    parser.add_argument("--seeds", type=int, default=16)
    arguments = parser.parse_args()
    size, seeds = arguments.size, range(1, arguments.seeds + 1)
    print("| H asked | noise | H found | worst deviation | by place | CPU, ns |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        raw, peer = f"{folder}/noise.raw", f"{folder}/libnoise"
        subprocess.run(["g++", "-O2", "-o", peer, str(HERE / "libnoise.cpp"), "-lnoise"], check=True)
        for hurst in map(float, arguments.hurst.split(",")):
            every = {f"talus, {scheme}": [[arguments.talus, "noise", "--size", str(size), "--hurst", str(hurst), "--seed", str(seed),
                                           "--scheme", scheme, "--threads", "1", "--quiet", "--overwrite", "-o", raw] for seed in seeds]
                     for scheme in SCHEMES}
            every["libnoise, Perlin"] = [[peer, str(size), str(hurst), str(seed), raw] for seed in seeds]
            for name, commands in every.items():
                line = row(name, commands, hurst, size, raw)
                if line:
                    print(line, flush=True)


if __name__ == "__main__":
    main()
