#!/usr/bin/env python3
"""Reads a stage that `loomtree convert RUN --to usd,ply --out DIR` wrote with Pixar's USD and compares it with the PLY
files beside it: every position of every frame must have the same bits, every triangle the same corners.

    pip install usd-core numpy
    python3 scripts/check_usd.py DIR
"""

import glob
import os
import re
import sys

import numpy
from pxr import Usd, UsdGeom


def read_ply(path):
    """Positions (f32) and triangles of a PLY file of loomtree."""
    data = open(path, "rb").read()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    counts = [int(n) for n in re.findall(rb"element \w+ (\d+)", data[:end])]
    positions = numpy.frombuffer(data, "<f4", 3 * counts[0], end).reshape(-1, 3)
    face = numpy.dtype([("count", "u1"), ("corners", "<i4", 3)])
    faces = numpy.frombuffer(data, face, counts[1], end + positions.nbytes)
    assert (faces["count"] == 3).all(), path
    return positions, faces["corners"]


def main(folder):
    stage = Usd.Stage.Open(os.path.join(folder, "run.usda"))
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    print(f"{stage.GetTimeCodesPerSecond()} time codes per second, up {UsdGeom.GetStageUpAxis(stage)}, "
          f"{UsdGeom.GetStageMetersPerUnit(stage)} m per unit, {len(meshes)} meshes")
    for mesh in meshes:
        name = mesh.GetPrim().GetName()
        frames = sorted(glob.glob(os.path.join(folder, f"{name}_[0-9]*.ply")))
        assert len(frames) == len(mesh.GetPointsAttr().GetTimeSamples()), name
        for path in frames:
            frame = int(path[-10:-4])
            positions, triangles = read_ply(path)
            points = numpy.array(mesh.GetPointsAttr().Get(frame), dtype="f4")
            assert points.tobytes() == positions.tobytes(), f"{name}, frame {frame}"
            indices = numpy.array(mesh.GetFaceVertexIndicesAttr().Get())
            assert (indices.reshape(-1, 3) == triangles).all(), f"{name}, frame {frame}"
            low, high = numpy.array(mesh.GetExtentAttr().Get(frame))
            assert (low == points.min(0)).all() and (high == points.max(0)).all(), f"{name}, frame {frame}"
        uv = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
        corners = 0 if not uv else len(uv.Get())
        assert corners in (0, indices.size), name
        print(f"{name}: {len(frames)} frames of {len(positions)} points and {len(triangles)} triangles, "
              f"{corners} texture coordinates: equal bits")


if __name__ == "__main__":
    main(sys.argv[1])
