"""Loads what `loomtree convert RUN --to pc2,usd --out DIR` wrote into Blender: cloth and bodies as meshes, each with a
Mesh Cache modifier, the frame rate and the range of frames.

    blender --python scripts/blender_import.py -- DIR             opens it
    blender -b --python scripts/blender_import.py -- DIR a.blend  saves it

`File > Import > Universal Scene Description` takes DIR/run.usda as well. In Houdini it is one SOP: File, or
LOP > Reference, with DIR/run.usda.
"""

import glob
import os
import re
import struct
import sys

import bpy


def frames_per_second(folder):
    """That of the stage beside the caches; 24 without one."""
    stage = os.path.join(folder, "run.usda")
    if not os.path.exists(stage):
        return 24.0
    with open(stage) as lines:
        head = lines.read(2000)
    return float(re.search(r"timeCodesPerSecond = (\S+)", head).group(1))


def load(folder):
    """Adds an object per cache of the folder; returns them by name."""
    objects, samples = {}, 1
    for cache in sorted(glob.glob(os.path.join(folder, "*.pc2"))):
        name = os.path.splitext(os.path.basename(cache))[0]
        with open(cache, "rb") as file:
            header = struct.unpack("<12siiffi", file.read(32))
        samples = max(samples, header[5])
        # The importer turns the object, not its vertices, so the cache needs no other axes.
        bpy.ops.wm.obj_import(
            filepath=os.path.join(folder, name + ".obj"), use_split_objects=False, use_split_groups=False)
        item = bpy.context.selected_objects[0]
        item.name = name
        modifier = item.modifiers.new("loomtree", "MESH_CACHE")
        modifier.cache_format = "PC2"
        modifier.filepath = os.path.abspath(cache)
        modifier.frame_start = 0.0
        objects[name] = item
    scene = bpy.context.scene
    rate = frames_per_second(folder)
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = scene.render.fps / rate
    scene.frame_start, scene.frame_end = 0, samples - 1
    scene.frame_set(0)
    return objects


if __name__ == "__main__":
    arguments = sys.argv[sys.argv.index("--") + 1:]
    for loaded in load(arguments[0]):
        print("loaded", loaded)
    if len(arguments) > 1:
        bpy.ops.wm.save_as_mainfile(filepath=os.path.abspath(arguments[1]))
