"""The judges of tests/judges/run.sh: PROGRAM FOLDER. A line a check; exit status 1 if one failed."""
import array
import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys

PROGRAM, FOLDER = os.path.abspath(sys.argv[1]), os.path.abspath(sys.argv[2])
HERE = os.path.dirname(os.path.abspath(__file__))
DEM = os.path.join(HERE, "..", "..", "examples", "jacksboro.tif")
NPM = os.environ.get("TALUS_NPM", "")
passed, failed, skipped = 0, [], []


def check(name, good, why=""):
    global passed
    print(f"{'ok  ' if good else 'FAIL'} {name}{'' if good else ': ' + str(why)}", flush=True)
    if good:
        passed += 1
    else:
        failed.append(name)


def skip(name, missing):
    print(f"skip {name}: {missing} is not here", flush=True)
    skipped.append(name)


def have(*programs):
    return all(shutil.which(program) for program in programs)


def run(*command, **options):
    return subprocess.run([str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                          cwd=FOLDER, check=False, **options)


def path(name):
    return os.path.join(FOLDER, name)


def talus(*words):
    done = run(PROGRAM, *words)
    if done.returncode:
        sys.exit(f"talus {' '.join(map(str, words))}: {done.stdout}")
    return done.stdout


def info(name):
    return json.loads(talus("info", "--json", name))


def near(a, b, tolerance):
    return len(a) == len(b) and all(abs(x - y) <= tolerance for x, y in zip(a, b))


# ---- Rasters ----

COMPRESSIONS = ("none", "zip", "zips", "piz")


def write_rasters():
    """One field in all raster formats, the north in the first row of each."""
    for compression in COMPRESSIONS:
        talus("synth", DEM, "-l", 2, "--compression", compression, "-q", "-o", f"{compression}.exr")
    talus("synth", DEM, "-l", 2, "--mip", "lattice", "-q", "-o", "mip.exr")
    talus("synth", "none.exr", "-l", 0, "--support", "area", "-q", "-o", "plain.tif")
    talus("synth", "none.exr", "-l", 0, "--support", "area", "-q", "-o", "plain.raw")
    talus("synth", "none.exr", "-l", 0, "--support", "area", "-q", "-o", "plain.png")
    talus("synth", "none.exr", "-l", 0, "--support", "area", "-q", "-o", "plain.r16")


def heights():
    values = array.array("f")
    with open(path("plain.raw"), "rb") as file:
        values.frombytes(file.read())
    return values


def judge_exr():
    values = heights()
    for name in [f"{c}.exr" for c in COMPRESSIONS] + ["mip.exr"]:
        if have("exrheader", "exrinfo"):
            header, listing = run("exrheader", name), run("exrinfo", "-v", name)
            check(f"exrheader {name}", header.returncode == 0 and "Y, 32-bit floating-point" in header.stdout, header.stdout)
            check(f"exrinfo {name}", listing.returncode == 0 and "gdal:crsWkt" in listing.stdout, listing.stdout)
        else:
            skip(f"OpenEXR's tools {name}", "openexr")
        if not have("oiiotool"):
            skip(f"oiiotool {name}", "openimageio-tools")
            continue
        stats = run("oiiotool", "--stats", name).stdout
        low, high = (float(re.search(rf"Stats {word}: *(\S+)", stats).group(1)) for word in ("Min", "Max"))
        check(f"oiiotool --stats {name}", near((low, high), (min(values), max(values)), 1e-4), stats)
        different = run("oiiotool", "--fail", "0", "--diff", name, "plain.tif")
        check(f"oiiotool --diff {name} plain.tif", different.returncode == 0, different.stdout)


def judge_geotiff():
    talus("synth", DEM, "-l", 2, "--cog", "-q", "-o", "cog.tif")
    talus("synth", DEM, "-l", 2, "-q", "-o", "flat.tif")
    about = info("flat.tif")
    if not have("gdalinfo", "gdal_translate"):
        skip("GDAL", "gdal-bin")
        return
    for name in ("cog.tif", "flat.tif"):
        seen = json.loads(run("gdalinfo", "-json", "-mm", name).stdout)
        check(f"gdalinfo {name}: CRS", 'ID["EPSG",4269]' in seen["coordinateSystem"]["wkt"], seen["coordinateSystem"])
        corners = [seen["cornerCoordinates"][corner] for corner in ("lowerLeft", "upperRight")]
        corners = [choose(corner[a] for corner in corners) for choose in (min, max) for a in (0, 1)]
        check(f"gdalinfo {name}: extent", near(corners, about["georeference"]["extent"], 1e-7), corners)
        band = seen["bands"][0]
        check(f"gdalinfo {name}: range", near((band["computedMin"], band["computedMax"]),
                                              (about["heights"]["low"], about["heights"]["high"]), 1e-3), band)
        check(f"gdalinfo {name}: no nodata, as there is no void", band.get("noDataValue") is None, band)
        check(f"gdalinfo {name}: record", seen["metadata"][""].get("talus_levels") == "2", seen["metadata"])
        back = run("gdal_translate", "-q", "-of", "ENVI", name, f"{name}.bin")
        check(f"gdal_translate {name}", back.returncode == 0, back.stdout)
    talus("synth", DEM, "-l", 1, "--nodata", 400, "--cog", "-q", "-o", "voids.tif")
    band = json.loads(run("gdalinfo", "-json", "-stats", "voids.tif").stdout)["bands"][0]
    voids = info("voids.tif")["heights"]
    valid = float(band["metadata"][""]["STATISTICS_VALID_PERCENT"])
    check("gdalinfo: nodata", str(band.get("noDataValue")).lower() == "nan" and voids["voids"] > 0 and
          abs(valid - 100 * (1 - voids["voids"] / voids["samples"])) < 0.02, band)
    with open(path("cog.tif.bin"), "rb") as one, open(path("flat.tif.bin"), "rb") as other:
        check("the cloud-optimised file has the same samples", one.read() == other.read())
    seen = json.loads(run("gdalinfo", "-json", "cog.tif").stdout)
    check("gdalinfo: layout", seen["metadata"].get("IMAGE_STRUCTURE", {}).get("LAYOUT") == "COG", seen["metadata"])
    check("gdalinfo: overviews", len(seen["bands"][0].get("overviews", [])) >= 2, seen["bands"][0].get("overviews"))
    validator = run(sys.executable, "-m", "osgeo_utils.samples.validate_cloud_optimized_geotiff", "--full-check=yes", "cog.tif")
    if "No module named" in validator.stdout:
        validator = run("/usr/bin/python3", "-m", "osgeo_utils.samples.validate_cloud_optimized_geotiff", "--full-check=yes",
                        "cog.tif")
    if "No module named" in validator.stdout:
        skip("the validator of cloud-optimised files", "python3-gdal")
    else:
        check("the validator of cloud-optimised files", "is a valid cloud optimized" in validator.stdout and
              "warning" not in validator.stdout.lower(), validator.stdout)


def judge_png():
    values = heights()
    with open(path("plain.json"), encoding="utf-8") as file:
        about = json.load(file)
    with open(path("plain.r16"), "rb") as file:
        r16 = array.array("H", file.read())
    worst = max(abs(about["offset"] + about["scale"] * v - z) for v, z in zip(r16, values))
    check("R16: half a step", worst <= 0.5 * about["scale"] + 1e-4, worst)
    if not have("oiiotool"):
        skip("oiiotool plain.png", "openimageio-tools")
        return
    stats = run("oiiotool", "--stats", "plain.png").stdout
    low, high = (int(re.search(rf"Stats {word}: *(\d+)", stats).group(1)) for word in ("Min", "Max"))
    check("oiiotool --stats plain.png", (low, high) == (min(r16), max(r16)) and high == 65535, stats)


# ---- Meshes ----

CODINGS = ("float", "quantized", "meshopt")


def write_meshes():
    for coding in CODINGS:
        talus("simplify", DEM, "-e", 5, "--coding", coding, "--verify", "-q", "-o", f"{coding}.glb")
    for ending in ("obj", "ply", "stl"):
        talus("simplify", DEM, "-e", 5, "--verify", "-q", "-o", f"mesh.{ending}")
    talus("simplify", DEM, "-e", 5, "--frame", "ecef", "--verify", "-q", "-o", "ecef.glb")
    talus("view", DEM, "--eye", "-84.25,36.55,300", "--above-ground", "--heading", 120, "-l", 2, "--morph", "-q", "-o", "view.glb")
    talus("simplify", DEM, "-e", 20, "--texture", "colour,normal", "--texture-size", 512, "-q", "-o", "painted.glb")
    # solid, for printing
    talus("simplify", DEM, "-e", 20, "--base", 50, "-q", "-o", "solid.stl")


GLBS = [f"{coding}.glb" for coding in CODINGS] + ["ecef.glb", "view.glb", "painted.glb"]


def judge_gltf():
    validator = os.path.join(NPM, "gltf-validator")
    if have("node") and os.path.isdir(validator):
        script = ("const v=require(process.argv[1]),fs=require('fs');v.validateBytes(new Uint8Array(fs.readFileSync("
                  "process.argv[2]))).then(r=>console.log(JSON.stringify(r.issues)))")
        for name in GLBS:
            issues = json.loads(run("node", "-e", script, validator, name).stdout)
            check(f"glTF validator {name}", issues["numErrors"] == issues["numWarnings"] == 0, issues)
    else:
        skip("glTF validator", "npm's gltf-validator")
    packer = os.path.join(NPM, "gltfpack", "cli.js")
    if have("node") and os.path.exists(packer):
        for name in GLBS:
            done = run("node", packer, "-i", name, "-o", "packed.glb", "-v")
            triangles = re.search(r"input: .*?(\d+) triangles", done.stdout)
            check(f"gltfpack {name}", done.returncode == 0 and triangles and
                  int(triangles.group(1)) == info(name)["triangles"], done.stdout)
    else:
        skip("gltfpack", "npm's gltfpack")


def judge_assimp():
    if not have("assimp"):
        skip("assimp", "assimp-utils")
        return
    for name in ("float.glb", "mesh.obj", "mesh.ply", "mesh.stl", "solid.stl"):
        seen, about = run("assimp", "info", name), info(name)
        low, high = (([float(x) for x in re.search(rf"{word} point\s*\(?([-\d.e+ ]+)", seen.stdout).group(1).split()]
                      if re.search(rf"{word} point", seen.stdout) else []) for word in ("Minimum", "Maximum"))
        want_low, want_high = list(about["low"]), list(about["high"])
        if name.endswith(".glb"): # as it stands in the file: y up
            want_low, want_high = ([want_low[0], want_low[2], -want_high[1]], [want_high[0], want_high[2], -want_low[1]])
        check(f"assimp {name}: size", near(low, want_low, 0.01) and near(high, want_high, 0.01), seen.stdout)
        faces = re.search(r"Faces:\s*(\d+)", seen.stdout)
        check(f"assimp {name}: triangles", faces and int(faces.group(1)) == about["triangles"], seen.stdout)


def judge_blender():
    if not have("blender"):
        skip("Blender", "blender")
        return
    names = [f"{c}.exr" for c in COMPRESSIONS] + ["float.glb", "quantized.glb", "view.glb", "painted.glb", "mesh.obj", "mesh.ply", "mesh.stl"]
    # its Python looks for its modules beside the first python3 of the path, which may be another
    done = run(shutil.which("blender"), "-b", "--factory-startup", "--python", os.path.join(HERE, "blender_judge.py"), "--",
               *[path(name) for name in names], env={**os.environ, "PATH": "/usr/bin:/bin"})
    found = {told["name"]: told for told in (json.loads(line[7:]) for line in done.stdout.splitlines()
                                             if line.startswith("JUDGED "))}
    raw, grid = hashlib.sha256(heights().tobytes()).hexdigest(), info("none.exr")
    for name in names:
        told = found.get(name, {"failed": done.stdout[-2000:]})
        if "failed" in told:
            check(f"Blender {name}", False, told["failed"].strip().splitlines()[-1])
        elif name.endswith(".exr"):
            check(f"Blender {name}: heights, bit by bit", told["sha256"] == raw and
                  (told["width"], told["height"]) == (grid["width"], grid["height"]), told)
        else:
            about = info(name)
            check(f"Blender {name}: size in metres", near(told["low"], about["low"], 0.02) and
                  near(told["high"], about["high"], 0.02), f"{told} {about}")
            # the importers may drop triangles of no area
            check(f"Blender {name}: triangles", abs(told["triangles"] - about["triangles"]) <= 1e-4 * about["triangles"], told)
            if name == "painted.glb":
                check("Blender painted.glb: textures", len(told["textures"]) >= 2, told)
            check(f"Blender {name}: looks up", told["up"] > 0 and math.isfinite(told["up"]), told)


write_rasters()
write_meshes()
judge_exr()
judge_geotiff()
judge_png()
judge_gltf()
judge_assimp()
judge_blender()
print(f"{passed} passed, {len(failed)} failed, {len(skipped)} skipped")
sys.exit(bool(failed))
