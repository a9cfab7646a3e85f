#!/usr/bin/python3
"""Terrain meshes by talus and by its peers, side by side, as a Markdown table.

  meshes.py TALUS DEM FOLDER [--install] [--size 1025] [--errors 5,20,50]

The first SIZE x SIZE samples of the DEM (SIZE is 2^k + 1, as martini asks) are simplified by `talus simplify`, by
@mapbox/martini and by delatin, which npm has put into FOLDER; with --install, npm is asked to do so first. Nothing else
uses the network, and no test runs this. GDAL and node are needed.

Every mesh is measured by mesh.mjs against every sample: the error in the table is the true one. CPU and memory are those
of the whole process, with starting, reading and writing; each is the least of three runs."""
import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

from measure import measured

HERE = pathlib.Path(__file__).resolve().parent
PEERS = {"martini": "@mapbox/martini@0.2.0", "delatin": "delatin@0.2.0"}


def cut(dem, size, folder):
    tif, raw = folder / "dem.tif", folder / "dem.f32"
    window = ["-q", "-srcwin", "0", "0", str(size), str(size)]
    subprocess.run(["gdal_translate", *window, str(dem), str(tif)], check=True)
    subprocess.run(["gdal_translate", "-q", "-of", "ENVI", "-ot", "Float32", str(tif), str(raw)], check=True)
    return tif, raw


def rows(arguments, folder):
    tif, raw = cut(arguments.dem, arguments.size, folder)
    size, mesh, script = str(arguments.size), str(folder / "mesh.ply"), str(HERE / "mesh.mjs")
    talus = [arguments.talus, "simplify", str(tif), "--frame", "pixel", "--threads", "1", "--overwrite", "-o", mesh]
    for error in arguments.errors.split(","):
        programs = {
            "talus, quadtree": [*talus, "--max-error", error],
            "talus, tin": [*talus, "--max-error", error, "--mesh", "tin"],
        }
        for peer in PEERS:
            programs[peer] = ["node", script, peer, str(arguments.folder), str(raw), size, error, mesh]
        for name, command in programs.items():
            used = measured(command)
            if not used:
                print(f"{name} failed: {' '.join(command)}", file=sys.stderr)
                continue
            found = json.loads(subprocess.run(["node", script, "check", str(raw), size, mesh], check=True,
                                              capture_output=True, text=True).stdout)
            strict = "yes" if found["error"] <= float(error) and not found["uncovered"] else "no"
            yield f"| {error} | {name} | {found['triangles']:,} | {found['error']:.4g} | {strict} | {used[0]:.2f} | {used[1]:.0f} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("talus")
    parser.add_argument("dem", type=pathlib.Path)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--install", action="store_true")
    parser.add_argument("--size", type=int, default=1025)
    parser.add_argument("--errors", default="5,20,50")
    arguments = parser.parse_args()
    if arguments.install:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        subprocess.run(["npm", "install", "--prefix", str(arguments.folder), "--no-save", "--ignore-scripts",
                        *PEERS.values()], check=True, stdout=sys.stderr)
    print("| error asked | program | triangles | true error | kept | CPU, s | memory, MB |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for row in rows(arguments, pathlib.Path(folder)):
            print(row, flush=True)


if __name__ == "__main__":
    main()
