"""The judge of 3D Tiles: PROGRAM FOLDER [NPM]. Makes tiles of models in several CRSs, reads every subtree and every
content on its own, and checks that contents lie in their regions, regions in their parents', that errors fall, that
neighbours share their edges, and that the surface is as near to the model as it says. With NPM (a folder of npm modules
that has gltf-validator) every content must have no error. A line a check; exit status 1 if one failed."""
import glob
import json
import math
import os
import struct
import subprocess
import sys

try:
    import numpy as np
    from osgeo import gdal, osr
except ImportError as missing:
    print(f"skip 3D Tiles: {missing}")
    sys.exit(0)

PROGRAM, FOLDER = os.path.abspath(sys.argv[1]), os.path.abspath(sys.argv[2])
NPM = os.path.abspath(sys.argv[3]) if len(sys.argv) > 3 else ""
HERE = os.path.dirname(os.path.abspath(__file__))
DEM = os.path.join(HERE, "..", "..", "examples", "jacksboro.tif")
A, F = 6378137.0, 1 / 298.257223563
E2 = F * (2 - F)
failed = []


def check(name, good, why=""):
    print(f"{'ok  ' if good else 'FAIL'} {name}{': ' + str(why) if why != '' else ''}", flush=True)
    if not good:
        failed.append(name)


def run(*words):
    return subprocess.run([str(word) for word in words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                          check=False)


# ---- Reading ----


def morton(x, y):
    return sum((x >> b & 1) << 2 * b | (y >> b & 1) << 2 * b + 1 for b in range(16))


class Tileset:
    """All tiles, by (level, x, y): their region and error, and whether they have a content."""
    def __init__(self, folder):
        self.folder = folder
        with open(os.path.join(folder, "tileset.json"), encoding="utf-8") as file:
            self.json = json.load(file)
        self.root = self.json["root"]
        self.implicit = self.root["implicitTiling"]
        self.tiles = {}
        self.read_subtree(0, 0, 0)

    def read_subtree(self, level, x, y):
        name = self.implicit["subtrees"]["uri"].format(level=level, x=x, y=y)
        with open(os.path.join(self.folder, name), "rb") as file:
            data = file.read()
        magic, version, text, binary = struct.unpack_from("<4sIQQ", data)
        assert magic == b"subt" and version == 1 and len(data) == 24 + text + binary and text % 8 == binary % 8 == 0
        head, body = json.loads(data[24:24 + text]), data[24 + text:]

        def view(number):
            v = head["bufferViews"][number]
            assert v["byteOffset"] % 8 == 0
            return body[v["byteOffset"]:v["byteOffset"] + v["byteLength"]]

        def bits(available, count):
            if "constant" in available:
                return [available["constant"]] * count
            stream = view(available["bitstream"])
            assert len(stream) == (count + 7) // 8
            out = [stream[k // 8] >> k % 8 & 1 for k in range(count)]
            assert sum(out) == available["availableCount"]
            assert all(not stream[k // 8] >> k % 8 & 1 for k in range(count, 8 * len(stream)))
            return out

        levels = self.implicit["subtreeLevels"]
        count = (4 ** levels - 1) // 3
        tiles, contents = bits(head["tileAvailability"], count), bits(head["contentAvailability"][0], count)
        children = bits(head["childSubtreeAvailability"], 4 ** levels)
        table = head["propertyTables"][head["tileMetadata"]]
        assert table["count"] == sum(tiles)
        regions = np.frombuffer(view(table["properties"]["region"]["values"]), "<f8").reshape(-1, 6)
        errors = np.frombuffer(view(table["properties"]["geometricError"]["values"]), "<f8")
        assert len(regions) == len(errors) == table["count"]
        number, offset = 0, 0
        places = {}
        for below in range(levels + 1):
            for m in range(4 ** below):
                places[offset + m] = (below, m)
            offset += 4 ** below
        for k in range(count):
            below, m = places[k]
            i, j = sum((m >> 2 * b & 1) << b for b in range(below)), sum((m >> 2 * b + 1 & 1) << b for b in range(below))
            if tiles[k]:
                self.tiles[level + below, (x << below) + i, (y << below) + j] = (
                    regions[number], errors[number], bool(contents[k]))
                number += 1
            else:
                assert not contents[k]
        for m in range(4 ** levels):
            if children[m]:
                i = sum((m >> 2 * b & 1) << b for b in range(levels))
                j = sum((m >> 2 * b + 1 & 1) << b for b in range(levels))
                self.read_subtree(level + levels, (x << levels) + i, (y << levels) + j)

    def path(self, key):
        return os.path.join(self.folder, self.root["content"]["uri"].format(level=key[0], x=key[1], y=key[2]))


def read_glb(path):
    """Positions in the axes of the Earth, normals there, triangles, texture coordinates."""
    with open(path, "rb") as file:
        data = file.read()
    length = struct.unpack_from("<I", data, 12)[0]
    head, body = json.loads(data[20:20 + length]), data[28 + length:]
    types = {5120: "i1", 5123: "<u2", 5125: "<u4"}

    def accessor(number):
        a = head["accessors"][number]
        v = head["bufferViews"][a["bufferView"]]
        parts = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[a["type"]]
        kind = np.dtype(types[a["componentType"]])
        stride = v.get("byteStride", kind.itemsize * parts)
        raw = np.frombuffer(body, "u1", stride * a["count"], v["byteOffset"]).reshape(a["count"], stride)
        return np.ascontiguousarray(raw[:, :kind.itemsize * parts]).view(kind).reshape(a["count"], parts)

    primitive = head["meshes"][0]["primitives"][0]
    matrix = np.array(head["nodes"][0]["matrix"]).reshape(4, 4).T
    at = accessor(primitive["attributes"]["POSITION"]).astype(float) @ matrix[:3, :3].T + matrix[:3, 3]
    normals = accessor(primitive["attributes"]["NORMAL"]).astype(float) / 127
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T  # y up to z up
    return at @ turn, normals @ turn, accessor(primitive["indices"]).reshape(-1, 3), matrix[0, 0]


def to_geodetic(p):
    """Longitude, latitude, height [Bowring; iterated]."""
    x, y, z = p.T
    r = np.hypot(x, y)
    latitude = np.arctan2(z, r * (1 - E2))
    for _ in range(6):
        n = A / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + E2 * n * np.sin(latitude), r)
    n = A / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
    height = r * np.cos(latitude) + z * np.sin(latitude) - A * np.sqrt(1 - E2 * np.sin(latitude) ** 2)
    return np.arctan2(y, x), latitude, height


def outside(region, longitude, latitude, height):
    """By how far points are not in a region: metres."""
    west, south, east, north, low, high = region
    width = (east - west) % (2 * math.pi) if east - west < 2 * math.pi else 2 * math.pi
    along = (longitude - west + 1e-13) % (2 * math.pi)
    across = np.where(along <= width + 2e-13, 0, np.minimum(along - width, 2 * math.pi - along)) * np.cos(latitude) * A
    return max(across.max(), ((south - latitude) * A).max(), ((latitude - north) * A).max(), (low - height).max(),
               (height - high).max())


def unwrapped(region, near):
    """A region with its longitudes in the turn beside `near`'s western one."""
    west, south, east, north, low, high = region
    east += 2 * math.pi * (east < west)
    turn = 2 * math.pi * round((west + east - near[0] - near[2]) / (4 * math.pi))
    return np.array([west - turn, south, east - turn, north, low, high])


# ---- Checks ----


def inside_parent(tiles):
    worst = 0
    for (level, x, y), (region, error, _) in tiles.items():
        if not level:
            continue
        parent, above, _ = tiles[level - 1, x // 2, y // 2]
        p = unwrapped(parent, unwrapped(parent, parent))
        r = unwrapped(region, p)
        worst = max(worst, p[0] - r[0], p[1] - r[1], r[2] - p[2], r[3] - p[3], (p[4] - r[4]) / A, (r[5] - p[5]) / A)
        if error > above:
            return f"{level}/{x}/{y}: its error is greater than that of its parent"
    return f"a region sticks {worst} out of its parent's" if worst > 1e-12 else ""


def in_box(box, points):
    centre, axes = np.array(box[:3]), np.array(box[3:]).reshape(3, 3)
    half = np.linalg.norm(axes, axis=1)
    return np.max(np.abs((points - centre) @ (axes / half[:, None]).T) - half)


def derived(root, level, x, y):
    """What readers make of the root's volume who divide it evenly."""
    parts = 2 ** level
    if "region" in root:
        w, s, e, n, low, high = root["region"]
        return "region", [w + (e - w) * x / parts, s + (n - s) * y / parts, w + (e - w) * (x + 1) / parts,
                          s + (n - s) * (y + 1) / parts, low, high]
    box = np.array(root["box"])
    centre, u, v, n = box[:3], box[3:6], box[6:9], box[9:]
    middle = centre + u * ((2 * x + 1) / parts - 1) + v * ((2 * y + 1) / parts - 1)
    return "box", [*middle, *(u / parts), *(v / parts), *n]


def look_at(name, folder):
    tileset = Tileset(folder)
    tiles = tileset.tiles
    files = {os.path.relpath(p, folder) for p in glob.glob(folder + "/content/*/*/*.glb")}
    wanted = {os.path.relpath(tileset.path(k), folder) for k, t in tiles.items() if t[2]}
    check(f"{name}: {len(tiles)} tiles, subtrees tell which contents there are", files == wanted, "")
    why = inside_parent(tiles)
    check(f"{name}: regions lie in their parents' and errors fall", not why, why)
    worst, derived_worst, normals = 0, 0, 0
    by_level = {}
    for key, (region, _, content) in tiles.items():
        if not content:
            continue
        points, n, faces, quantum = read_glb(tileset.path(key))
        # between the corners too: the middles of the edges and of the triangles
        corners = points[faces]
        all_points = np.concatenate([points, corners.mean(axis=1), (corners + np.roll(corners, 1, 1)).reshape(-1, 3) / 2])
        worst = max(worst, outside(region, *to_geodetic(all_points)))
        kind, volume = derived(tileset.root["boundingVolume"], *key)
        off = outside(volume, *to_geodetic(points)) if kind == "region" else in_box(volume, points)
        size = np.ptp(points, axis=0).max()
        derived_worst = max(derived_worst, off / size)
        normals = max(normals, np.abs(np.linalg.norm(n, axis=1) - 1).max())
        by_level.setdefault(key[0], {})[key[1:]] = (points, n, quantum)
    check(f"{name}: contents lie in their regions", worst < 1e-6, f"{worst:.3g} m outside at most")
    bound = 1e-3 if "region" in tileset.root["boundingVolume"] else 5e-2
    check(f"{name}: contents lie in volumes that readers divide evenly, to {bound} of their size",
          derived_worst < bound, f"{derived_worst:.3g}")
    check(f"{name}: normals have length 1 within their rounding", normals < 0.01, f"{normals:.3g}")
    share_edges(name, by_level)
    return tileset


def share_edges(name, by_level):
    """Neighbours of a level have the same vertices on their common edge, where their steps are the same."""
    lonely, shared, turned = 0, 0, 0
    for tiles in by_level.values():
        for (x, y), (points, n, quantum) in tiles.items():
            for other in ((x + 1, y), (x, y + 1)):
                if other not in tiles or tiles[other][2] != quantum:
                    continue
                mine = {tuple(p): tuple(m) for p, m in zip(points, n)}
                theirs = {tuple(p): tuple(m) for p, m in zip(tiles[other][0], tiles[other][1])}
                common = mine.keys() & theirs.keys()
                lonely += not common
                shared += len(common)
                turned += sum(mine[p] != theirs[p] for p in common)
    check(f"{name}: neighbours share vertices on their edges, and normals there", shared and not lonely and not turned,
          f"{shared} shared, {lonely} pairs without, {turned} normals differ")


def heights_agree(name, tileset, dem):
    """Posts of the model against the surface of the deepest level."""
    data = gdal.Open(dem)
    t, z = data.GetGeoTransform(), data.ReadAsArray().astype(float)
    nodata = data.GetRasterBand(1).GetNoDataValue()
    to = osr.SpatialReference()
    to.ImportFromEPSG(4326)
    to.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    source = data.GetSpatialRef()
    source.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    if source.IsGeographic():
        to = source
    move = osr.CoordinateTransformation(source, to)
    dice = np.random.default_rng(8)
    rows, columns = dice.integers(0, z.shape[0], 1000), dice.integers(0, z.shape[1], 1000)
    levels = tileset.json["extras"]["talus"]["errors"]
    deepest = len(levels) - 1
    faces = []
    for key, (_, _, content) in tileset.tiles.items():
        if key[0] == deepest and content:
            points, _, triangles, _ = read_glb(tileset.path(key))
            longitude, latitude, height = to_geodetic(points)
            faces.append(np.stack([longitude % (2 * math.pi), latitude, height], 1)[triangles])
    faces = np.concatenate(faces)
    flat = faces[:, :, :2]
    area = np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
    faces = faces[area > 1e-3 * np.median(area[area > 0])]  # skirts are upright
    low, high = faces[:, :, :2].min(axis=1), faces[:, :, :2].max(axis=1)
    worst, seen = 0, 0
    for row, column in zip(rows, columns):
        if nodata is not None and z[row, column] == nodata:
            continue
        x, y = t[0] + t[1] * (column + 0.5) + t[2] * (row + 0.5), t[3] + t[4] * (column + 0.5) + t[5] * (row + 0.5)
        longitude, latitude, _ = move.TransformPoint(x, y)
        p = np.radians([longitude % 360, latitude])
        near = faces[np.all((low <= p + 1e-9) & (high >= p - 1e-9), axis=1)]
        off = np.inf
        for a, b, c in near:
            m = np.array([b[:2] - a[:2], c[:2] - a[:2]]).T
            u, v = np.linalg.solve(m, p - a[:2])
            if min(u, v, 1 - u - v) > -1e-3:
                off = min(off, abs(a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2]) - z[row, column]))
        seen += off < np.inf
        worst = max(worst, off if off < np.inf else 0)
    check(f"{name}: {seen} posts are within the error told", seen > 900 and worst <= levels[-1],
          f"{worst:.3f} of {levels[-1]:.3f} m")


def validate(name, folder):
    if not NPM:
        print("skip gltf-validator: no folder of npm modules was named", flush=True)
        return
    done = subprocess.run(["node", os.path.join(HERE, "glb.mjs"), folder], env={**os.environ, "TALUS_NPM": NPM},
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    check(f"{name}: gltf-validator finds no error", done.returncode == 0, done.stdout.strip()[-400:])


def make(name, dem, *words):
    folder = os.path.join(FOLDER, name)
    done = run(PROGRAM, "tiles", dem, "-q", "-f", "3dtiles", "-o", folder, *words)
    check(f"{name}: tiles are made", done.returncode == 0, done.stdout)
    return folder if done.returncode == 0 else None


def warp(name, *words):
    path = os.path.join(FOLDER, name + ".tif")
    run("gdalwarp", "-q", "-overwrite", *words, DEM, path)
    return path


def main():
    os.makedirs(FOLDER, exist_ok=True)
    models = {
        "degrees": (DEM, []),
        "utm": (warp("utm", "-t_srs", "EPSG:32616", "-tr", "80", "80", "-r", "cubic"), ["--voids", "keep"]),
        "fine": (DEM, ["--extra-levels", "2", "--coding", "quantized"]),
        "antimeridian": (None, []),
    }
    path = os.path.join(FOLDER, "antimeridian.tif")
    run("gdal_translate", "-q", "-a_srs", "EPSG:4326", "-a_ullr", "179.85", "66.1", "180.2", "65.8", DEM, path)
    models["antimeridian"] = (path, [])
    for name, (dem, words) in models.items():
        folder = make(name, dem, *words)
        if not folder:
            continue
        tileset = look_at(name, folder)
        if name != "fine":
            heights_agree(name, tileset, dem)
        validate(name, folder)
    folder = make("compressed", DEM, "--coding", "compressed")
    if folder:
        validate("compressed", folder)


main()
sys.exit(bool(failed))
