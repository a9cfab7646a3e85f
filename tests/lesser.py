#!/usr/bin/env python3
"""A build without the parts that talus can do without: lesser.py BUILD-FOLDER, which is made where it is not there.

It must name what it lacks, link none of it, do all else, and refuse what takes such a part in one line. Prints the numbers that
summary.py reads."""
import os
import subprocess
import sys
import tempfile

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
EXAMPLE = os.path.join(ROOT, "examples", "jacksboro.tif")
PARTS = ["crs", "geographiclib", "meshopt", "png", "plots", "mbtiles", "serve"]
FOREIGN = ["libproj", "libgeotiff", "libGeographic", "libmeshoptimizer", "libpng", "libcairo", "libsqlite3", "libmicrohttpd", "libstdc++"]


def build(folder):
    if not os.path.exists(os.path.join(folder, "build.ninja")):
        options = [f"-D{part}=disabled" for part in PARTS]
        subprocess.run(["meson", "setup", folder, ROOT, "--werror", "-Dtests=false", "-Dman=disabled", "-Dbuildtype=debugoptimized", *options],
                       check=True, stdout=subprocess.DEVNULL)
    subprocess.run(["ninja", "-C", folder, "--quiet"], check=True)
    return os.path.join(folder, "cmd", "talus")


def check(program, folder, failures):
    def run(*words, status=0, says=""):
        done = subprocess.run([program, *words], cwd=folder, capture_output=True, text=True, timeout=120)
        said = done.stdout + done.stderr
        if done.returncode != status or says not in said or (status and len(done.stderr.splitlines()) != 1):
            failures.append(f"{' '.join(words)}: status {done.returncode}, {said.strip()[-300:]}")
        return said

    run("version", says="(without " + ", ".join(PARTS) + ")")
    run("info", EXAMPLE, says="74.5732 x 92.475 m")  # cells are measured all the same
    run("simplify", EXAMPLE, "--max-error", "20", "-o", "mesh.glb")
    run("info", "mesh.glb")
    run("synth", EXAMPLE, "-l", "2", "-o", "terrain.tif")
    run("info", "terrain.tif", says="4269")  # NAD83: the keys go on
    run("synth", EXAMPLE, "-l", "1", "-o", "terrain.exr")
    run("view", EXAMPLE, "--eye", "-84.25,36.55,300", "--above-ground", "--heading", "120", "-l", "2", "-o", "view.glb")
    run("tiles", EXAMPLE, "--format", "quantized-mesh", "--error", "50", "-o", "tiles")
    run("synth", EXAMPLE, "-l", "1", "-o", "terrain.png", status=1, says="without")
    run("preview", EXAMPLE, "-o", "picture.png", status=1, says="without")
    run("simplify", EXAMPLE, "--max-error", "20", "--coding", "meshopt", "-o", "small.glb", status=1, says="without")
    run("synth", EXAMPLE, "-l", "1", "--geoid", "egm96", "-o", "high.exr", status=1, says="without")
    run("stats", EXAMPLE, "-o", "plot.svg", status=1)
    left = {"terrain.png", "picture.png", "small.glb", "high.exr", "plot.svg"} & set(os.listdir(folder))
    if left:
        failures.append(f"left behind: {left}")


def main():
    program = build(sys.argv[1])
    failures = []
    needed = subprocess.run(["ldd", program], check=True, capture_output=True, text=True).stdout
    direct = subprocess.run(["readelf", "-d", os.path.join(sys.argv[1], "lib", "libtalus.so")], check=True, capture_output=True, text=True).stdout
    failures += [f"the library links {name}" for name in FOREIGN if name in direct]
    if "libproj" in needed:
        failures.append("the program comes to link libproj")
    with tempfile.TemporaryDirectory() as folder:
        check(program, folder, failures)
    for failure in failures:
        print(failure)
    print("a build without " + ", ".join(PARTS) + ": " + ("FAILED" if failures else "ok"))
    return 1 if failures else 0


sys.exit(main())
