"""Readers and writers of raster and mesh files for the tests, written against the formats' specifications and sharing nothing
with talus: what talus writes is judged by other eyes."""
import array
import json
import math
import struct
import sys
import zlib


class Grid:
    """width x height heights, row by row; what else the file said is in `about`."""

    def __init__(self, width, height, values, about=None):
        self.width, self.height, self.values, self.about = width, height, values, about or {}

    def __getitem__(self, place):
        i, j = place
        return self.values[j * self.width + i]


def floats(raw):
    values = array.array("f")
    values.frombytes(raw)
    if sys.byteorder == "big":
        values.byteswap()
    return values


def same(a, b):
    return a == b or (math.isnan(a) and math.isnan(b))


# ---- TIFF (TIFF 6.0, GeoTIFF 1.1) ----

def write_tiff(path, width, height, values, point=None, origin=None, cell=(1, 1), epsg=None, nodata=None):
    """A float32 TIFF of one strip. point: True, False or None (no georeference); origin: the tie point."""
    pixels = struct.pack(f"<{width * height}f", *values)
    entries = [(256, 3, [width]), (257, 3, [height]), (258, 3, [32]), (259, 3, [1]), (262, 3, [1]), (273, 4, [8]),
               (277, 3, [1]), (278, 3, [height]), (279, 4, [len(pixels)]), (339, 3, [3])]
    if origin:
        entries += [(33550, 12, [cell[0], cell[1], 0.0]), (33922, 12, [0.0, 0.0, 0.0, origin[0], origin[1], 0.0])]
    if point is not None:
        geographic = epsg == 4326
        keys = [(1024, 2 if geographic else 1), (1025, 2 if point else 1)]
        if epsg:
            keys.append((2048 if geographic else 3072, epsg))
        entries.append((34735, 3, [1, 1, 0, len(keys)] + [n for key, value in keys for n in (key, 0, 1, value)]))
    if nodata is not None:
        entries.append((42113, 2, nodata.encode() + b"\0"))
    with open(path, "wb") as file:
        file.write(tiff_bytes(pixels, entries))


def tiff_bytes(pixels, entries):
    start = 8 + len(pixels)
    later, directory = b"", struct.pack("<H", len(entries))
    behind = start + 2 + 12 * len(entries) + 4
    for tag, kind, value in entries:
        packed = value if kind == 2 else struct.pack("<%d%s" % (len(value), {3: "H", 4: "I", 12: "d"}[kind]), *value)
        count = len(value)
        if len(packed) <= 4:
            field = packed.ljust(4, b"\0")
        else:
            field = struct.pack("<I", behind + len(later))
            later += packed + b"\0" * (len(packed) % 2)
        directory += struct.pack("<HHI", tag, kind, count) + field
    return struct.pack("<2sHI", b"II", 42, start) + pixels + directory + struct.pack("<I", 0) + later


def read_tiff(path):
    """A little-endian classic TIFF of float32 or int16 samples, without compression or with deflate."""
    with open(path, "rb") as file:
        data = file.read()
    assert data[:4] == b"II*\0", "not a little-endian classic TIFF"
    tags, at = {}, struct.unpack_from("<I", data, 4)[0]
    for k in range(struct.unpack_from("<H", data, at)[0]):
        tag, kind, count = struct.unpack_from("<HHI", data, at + 2 + 12 * k)
        size, code = {1: (1, "B"), 2: (1, "s"), 3: (2, "H"), 4: (4, "I"), 12: (8, "d")}[kind]
        where = at + 2 + 12 * k + 8 if size * count <= 4 else struct.unpack_from("<I", data, at + 2 + 12 * k + 8)[0]
        tags[tag] = data[where:where + count] if kind == 2 else struct.unpack_from(f"<{count}{code}", data, where)
    width, height = tags[256][0], tags[257][0]
    sample = {32: 4, 16: 2}[tags[258][0]]
    if 324 in tags:
        block_width, block_height, offsets, counts = tags[322][0], tags[323][0], tags[324], tags[325]
    else:
        block_width, block_height, offsets, counts = width, tags.get(278, [height])[0], tags[273], tags[279]
    across = -(-width // block_width)
    rows = [bytearray(width * sample) for _ in range(height)]
    for k, (offset, count) in enumerate(zip(offsets, counts)):
        block = data[offset:offset + count]
        if tags[259][0] in (8, 32946):
            block = zlib.decompress(block)
        x, y = k % across * block_width, k // across * block_height
        for row in range(min(block_height, height - y)):
            line = block[row * block_width * sample:(row + 1) * block_width * sample]
            line = unpredict(line, tags.get(317, [1])[0], sample)
            keep = min(block_width, width - x) * sample
            rows[y + row][x * sample:x * sample + keep] = line[:keep]
    raw = b"".join(rows)
    values = floats(raw) if sample == 4 else array.array("h", raw)
    return Grid(width, height, values, tags)


def unpredict(line, predictor, sample):
    if predictor == 1:
        return line
    if predictor == 2:
        count, total, out = len(line) // sample, 0, []
        for value in struct.unpack(f"<{count}H", line):
            total = (total + value) & 0xffff
            out.append(total)
        return struct.pack(f"<{count}H", *out)
    line, total = bytearray(line), 0
    for k, byte in enumerate(line):
        total = (total + byte) & 0xff
        line[k] = total
    count = len(line) // sample
    out = bytearray(len(line))
    for byte in range(sample):
        out[sample - 1 - byte::sample] = line[byte * count:(byte + 1) * count]
    return bytes(out)


# ---- EXR (OpenEXR File Layout) ----

def read_exr(path):
    """A tiled EXR of one float channel, without compression or with ZIP."""
    with open(path, "rb") as file:
        data = file.read()
    magic, version = struct.unpack_from("<II", data)
    assert magic == 20000630 and version & 0x200, "not a tiled EXR"
    at, attributes = 8, {}
    while data[at]:
        name, at = exr_string(data, at)
        kind, at = exr_string(data, at)
        size = struct.unpack_from("<I", data, at)[0]
        attributes[name] = (kind, data[at + 4:at + 4 + size])
        at += 4 + size
    at += 1
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"][1])
    width, height = right - left + 1, bottom - top + 1
    tile_width, tile_height, _ = struct.unpack("<IIB", attributes["tiles"][1])
    tiles = -(-width // tile_width) * -(-height // tile_height)
    raw = bytearray(4 * width * height)
    for offset in struct.unpack_from(f"<{tiles}Q", data, at):
        column, row, level_x, level_y, size = struct.unpack_from("<5i", data, offset)
        assert level_x == 0 and level_y == 0
        x, y = column * tile_width, row * tile_height
        across, down = min(tile_width, width - x), min(tile_height, height - y)
        block = data[offset + 20:offset + 20 + size]
        if size != across * down * 4:  # a tile that does not shrink is stored as it is
            assert attributes["compression"][1] == b"\3", "a compression that this reader does not know"
            block = exr_unzip(block)
        for k in range(down):
            raw[4 * ((y + k) * width + x):4 * ((y + k) * width + x + across)] = block[4 * k * across:4 * (k + 1) * across]
    return Grid(width, height, floats(bytes(raw)), attributes)


def exr_string(data, at):
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 1


def exr_unzip(block):
    """deflate, then differences of bytes, then the two halves interleaved."""
    packed = bytearray(zlib.decompress(block))
    for k in range(1, len(packed)):
        packed[k] = (packed[k - 1] + packed[k] - 128) & 0xff
    half = (len(packed) + 1) // 2
    out = bytearray(len(packed))
    out[0::2], out[1::2] = packed[:half], packed[half:]
    return bytes(out)


# ---- PNG (W3C Portable Network Graphics) ----

def read_png16(path):
    """A 16-bit grey PNG."""
    with open(path, "rb") as file:
        data = file.read()
    assert data[:8] == b"\x89PNG\r\n\x1a\n", "not a PNG"
    at, image, header = 8, b"", None
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        chunk = data[at + 8:at + 8 + size]
        assert zlib.crc32(kind + chunk) == struct.unpack_from(">I", data, at + 8 + size)[0], "wrong checksum"
        header = struct.unpack(">IIBBBBB", chunk) if kind == b"IHDR" else header
        image += chunk if kind == b"IDAT" else b""
        at += 12 + size
    width, height, depth, colour, _, _, interlaced = header
    assert (depth, colour, interlaced) == (16, 0, 0), "not a 16-bit grey PNG"
    lines, stride = zlib.decompress(image), 2 * width + 1
    above, values = bytearray(2 * width), array.array("H")
    for row in range(height):
        above = png_row(lines[row * stride], bytearray(lines[row * stride + 1:(row + 1) * stride]), above)
        values.extend(struct.unpack(f">{width}H", above))
    return Grid(width, height, values)


def png_row(kind, line, above):
    step = 2
    if kind == 2:
        return bytearray((a + b) & 0xff for a, b in zip(line, above))
    for k in range(len(line)) if kind else ():
        left = line[k - step] if k >= step else 0
        corner = above[k - step] if k >= step else 0
        guess = {1: left, 3: (left + above[k]) // 2, 4: paeth(left, above[k], corner)}[kind]
        line[k] = (line[k] + guess) & 0xff
    return line


def paeth(left, above, corner):
    to_left, to_above, to_corner = abs(above - corner), abs(left - corner), abs(left + above - 2 * corner)
    if to_left <= to_above and to_left <= to_corner:
        return left
    return above if to_above <= to_corner else corner


# ---- meshes ----

class Mesh:
    """positions: flat x, y, z, ...; indices: flat, three a triangle."""

    def __init__(self, positions, indices, about=None):
        self.positions, self.indices, self.about = positions, indices, about


def read_glb(path):
    """The first primitive of a GLB (glTF 2.0), its accessors held against what they state."""
    with open(path, "rb") as file:
        data = file.read()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data)), "not a whole GLB"
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    about = json.loads(data[20:20 + size])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and 28 + size + binary_size == len(data)
    binary = data[28 + size:]

    def accessor(index, code, width):
        a = about["accessors"][index]
        view = about["bufferViews"][a["bufferView"]]
        size = width * array.array(code).itemsize
        stride = view.get("byteStride", size)
        assert a.get("byteOffset", 0) + stride * (a["count"] - 1) + size <= view["byteLength"]
        start = view.get("byteOffset", 0) + a.get("byteOffset", 0)
        values = array.array(code)
        values.frombytes(b"".join(binary[at:at + size] for at in range(start, start + stride * a["count"], stride)))
        return values, a

    primitive = about["meshes"][0]["primitives"][0]
    assert primitive.get("mode", 4) == 4
    positions, stated = accessor(primitive["attributes"]["POSITION"], "f", 3)
    assert stated["componentType"] == 5126 and stated["type"] == "VEC3"
    for k in range(3):
        assert stated["min"][k] == min(positions[k::3]) and stated["max"][k] == max(positions[k::3]), "false min or max"
    normals, stated = accessor(primitive["attributes"]["NORMAL"], "f", 3)
    assert len(normals) == len(positions)
    for x, y, z in zip(normals[0::3], normals[1::3], normals[2::3]):
        assert abs(x * x + y * y + z * z - 1) < 1e-5, "a normal that is not of unit length"
    code = {5123: "H", 5125: "I"}[about["accessors"][primitive["indices"]]["componentType"]]
    indices, stated = accessor(primitive["indices"], code, 1)
    assert stated["type"] == "SCALAR" and len(indices) % 3 == 0
    assert max(indices) < len(positions) // 3, "an index out of range"
    return Mesh(positions, indices, about)


def read_ply(path):
    """A binary little-endian PLY of x, y, z and triangles."""
    with open(path, "rb") as file:
        data = file.read()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    header = data[:end].decode("ascii", "replace").split("\n")
    assert header[0] == "ply" and header[1] == "format binary_little_endian 1.0"
    counts, codes, element = {}, [], None
    for words in (line.split() for line in header):
        if words[:1] == ["element"]:
            element = words[1]
            counts[element] = int(words[2])
        if words[:1] == ["property"] and element == "vertex":
            codes.append({"float": "f", "double": "d", "int": "i", "float32": "f", "float64": "d"}[words[1]])
    vertex = struct.Struct("<" + "".join(codes))
    positions = array.array("d")
    for k in range(counts["vertex"]):
        positions.extend(vertex.unpack_from(data, end + k * vertex.size)[:3])
    at, face = end + counts["vertex"] * vertex.size, struct.Struct("<B3I")
    indices = array.array("I")
    for k in range(counts["face"]):
        three, *corners = face.unpack_from(data, at + k * face.size)
        assert three == 3
        indices.extend(corners)
    assert at + counts["face"] * face.size == len(data), "bytes behind the last face"
    return Mesh(positions, indices, header)


def read_obj(path):
    positions, indices = array.array("d"), array.array("I")
    with open(path, encoding="utf-8") as file:
        for words in map(str.split, file):
            if words[:1] == ["v"]:
                positions.extend(map(float, words[1:4]))
            elif words[:1] == ["f"]:
                indices.extend(int(word.split("/")[0]) - 1 for word in words[1:4])
    return Mesh(positions, indices)
