"""Run inside of Blender: imports what it is told to, and prints what it found, a line of JSON a file."""
import array
import hashlib
import json
import os
import sys

import bpy
import numpy

numpy.bool = bool # Debian's importer of glTF still asks its newer numpy for it


def image(path):
    """The bytes of the red channel from the last row up, as floats."""
    loaded = bpy.data.images.load(path)
    loaded.colorspace_settings.name = "Non-Color"
    width, height = loaded.size
    values = array.array("f", [0.0]) * (width * height * 4)
    loaded.pixels.foreach_get(values)
    red = values[0::4]
    rows = [red[y * width:(y + 1) * width] for y in range(height - 1, -1, -1)]
    return {"width": width, "height": height, "sha256": hashlib.sha256(b"".join(row.tobytes() for row in rows)).hexdigest()}


def mesh(path):
    before = set(bpy.data.objects)
    kind = os.path.splitext(path)[1]
    if kind == ".glb":
        bpy.ops.import_scene.gltf(filepath=path)
    elif kind == ".obj":
        bpy.ops.wm.obj_import(filepath=path, forward_axis="Y", up_axis="Z")
    elif kind == ".ply":
        bpy.ops.import_mesh.ply(filepath=path)
    else:
        bpy.ops.import_mesh.stl(filepath=path)
    bpy.context.view_layer.update()
    made = [o for o in bpy.data.objects if o not in before and o.type == "MESH"]
    points = [o.matrix_world @ v.co for o in made for v in o.data.vertices]
    up = sum((p.area * (o.matrix_world.to_3x3() @ p.normal).z) for o in made for p in o.data.polygons)
    found = {"triangles": sum(len(o.data.polygons) for o in made), "up": up,
             "low": [min(p[a] for p in points) for a in range(3)], "high": [max(p[a] for p in points) for a in range(3)],
             "textures": sorted({n.image.name for m in bpy.data.materials if m.node_tree
                                 for n in m.node_tree.nodes if n.type == "TEX_IMAGE" and n.image})}
    for o in made:
        bpy.data.objects.remove(o)
    return found


for name in sys.argv[sys.argv.index("--") + 1:]:
    try:
        told = image(name) if name.endswith((".exr", ".png")) else mesh(name)
    except Exception as failure:  # the importers raise what they like
        told = {"failed": str(failure)}
    print("JUDGED " + json.dumps({"name": os.path.basename(name), **told}))
