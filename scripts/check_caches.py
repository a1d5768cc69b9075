#!/usr/bin/env python3
"""Reads what `loomtree convert RUN --to usd,usdc,abc,mdd,pc2,vtu,ply --out DIR` wrote with other programs and compares it with
the PLY files beside it: every position of every frame must have the same bits (MDD in Blender: within 1e-6 m, because the
times of MDD are rounded), every triangle the same corners. Formats that are not there are left out; the up axis is that of
run.usda.

    pip install usd-core alembic3d vtk numpy      # Pixar's USD, Alembic, VTK
    pip install bpy numpy                         # Blender, in an environment of its own: it wants another numpy
    python3 scripts/check_caches.py DIR           # with each of the two
"""

import glob
import importlib
import os
import re
import sys

import numpy


def there(name):
    """The module, or none with a line that says so."""
    try:
        return importlib.import_module(name)
    except ImportError:
        print(f"{name} is not installed: not checked with it")
        return None


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


def truth(folder):
    """Of every mesh, by name: numbers of its frames, its positions in them, its triangles."""
    meshes = {}
    for path in sorted(glob.glob(os.path.join(folder, "*_[0-9][0-9][0-9][0-9][0-9][0-9].ply"))):
        name, frame = os.path.basename(path)[:-11], int(path[-10:-4])
        positions, triangles = read_ply(path)
        numbers, frames, _ = meshes.setdefault(name, ([], [], triangles))
        numbers.append(frame)
        frames.append(positions)
    assert meshes, f"no PLY files in {folder}"
    return meshes


def same(expected, found, what):
    found = numpy.ascontiguousarray(found, dtype="f4").reshape(-1, 3)
    assert found.shape == expected.shape and found.tobytes() == numpy.ascontiguousarray(expected).tobytes(), what


def y_up(positions):
    return numpy.stack([positions[:, 0], positions[:, 2], -positions[:, 1]], axis=1)


def usd(path, meshes):
    """Pixar's USD: points, extents, faces, texture coordinates. Returns whether z is up."""
    from pxr import Usd, UsdGeom, UsdUtils
    stage = Usd.Stage.Open(path)
    found = {prim.GetName(): UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)}
    assert sorted(found) == sorted(meshes), (sorted(found), sorted(meshes))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    for name, (numbers, frames, triangles) in meshes.items():
        mesh = found[name]
        assert list(mesh.GetPointsAttr().GetTimeSamples()) == numbers, name
        assert mesh.ValidateTopology(mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(),
                                     len(frames[0])), name
        for number, positions in zip(numbers, frames):
            same(positions, mesh.GetPointsAttr().Get(number), f"{path}: {name}, frame {number}")
            low, high = numpy.array(mesh.GetExtentAttr().Get(number))
            assert (low == positions.min(0)).all() and (high == positions.max(0)).all(), f"{name}, frame {number}"
        indices = numpy.array(mesh.GetFaceVertexIndicesAttr().Get())
        assert (indices.reshape(-1, 3) == triangles).all(), name
        uv = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
        corners = 0 if not uv else len(uv.Get())
        assert corners in (0, indices.size), name
    print(f"{path}: {len(meshes)} meshes, {stage.GetTimeCodesPerSecond()} time codes per second: equal bits (USD)")
    return UsdGeom.GetStageUpAxis(stage) == "Z"


def alembic(path, meshes, z_up):
    """Alembic's own library: points, boxes, faces and their winding, times."""
    from alembic3d import Abc, AbcGeom
    top = Abc.IArchive(path).getTop()
    assert top.getNumChildren() == len(meshes)
    for i in range(top.getNumChildren()):
        child = top.getChild(i)
        numbers, frames, triangles = meshes[child.getName()]
        schema = AbcGeom.IPolyMesh(top, child.getName()).getSchema()
        assert schema.getNumSamples() == len(frames), child.getName()
        times = schema.getTimeSampling()
        for k, positions in enumerate(frames):
            # A number of a sample would be taken for a time.
            sample = schema.getValue(Abc.ISampleSelector(float(times.getSampleTime(k))))
            expected = y_up(positions) if z_up else positions
            same(expected, numpy.asarray(memoryview(sample.getPositions())), f"{child.getName()}, sample {k}")
            corners = numpy.array(list(sample.getFaceIndices())).reshape(-1, 3)
            assert (corners[:, ::-1] == triangles).all(), child.getName()
        uv = schema.getUVsParam()
        assert not uv.valid() or len(uv.getExpandedValue().getVals()) == triangles.size, child.getName()
        step = times.getSampleTime(1) - times.getSampleTime(0)
        assert abs(times.getSampleTime(0) - numbers[0] * step) < 1e-9, "the first frame is at its time"
    print(f"{path}: {len(meshes)} meshes: equal bits (Alembic)")


def grids(folder, meshes):
    """VTK: points and cells of every frame."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader
    files = sorted(glob.glob(os.path.join(folder, "run_[0-9]*.vtu")))
    names = None
    for k, path in enumerate(files):
        reader = vtkXMLUnstructuredGridReader()
        reader.SetFileName(path)
        reader.Update()
        grid = reader.GetOutput()
        points = vtk_to_numpy(grid.GetPoints().GetData())
        ranges = {mesh[1][k].tobytes(): name for name, mesh in meshes.items()}
        at, order = 0, []
        while at < len(points):
            for data, name in ranges.items():
                count = len(meshes[name][1][k])
                if name not in order and points[at:at + count].tobytes() == data:
                    order.append(name)
                    at += count
                    break
            else:
                raise AssertionError(f"{path}: points from {at} on are of no mesh")
        assert len(order) == len(meshes) and names in (None, order), path
        names = order
        both = [grid.GetCellData(), grid.GetPointData()]
        arrays = [data.GetArrayName(i) for data in both for i in range(data.GetNumberOfArrays())]
    print(f"{folder}: {len(files)} grids with {', '.join(arrays)}: equal bits (VTK)")


def blender(folder, meshes, z_up):
    """Blender plays every format. Its own up axis is z, so what it turns is compared after a rounding of its rotation."""
    import bpy

    def frame_of(numbers, number):
        bpy.context.scene.frame_set(number)
        return bpy.context.evaluated_depsgraph_get()

    def played(objects, formats, exact):
        for item in objects:
            name = item.name.split(".")[0]
            name = name if name in meshes else item.data.name.split(".")[0]
            numbers, frames, _ = meshes[name]
            for number, positions in zip(numbers, frames):
                graph = frame_of(numbers, number)
                mesh = item.evaluated_get(graph).to_mesh()
                found = numpy.empty(3 * len(mesh.vertices), dtype="f4")
                mesh.vertices.foreach_get("co", found)
                expected = y_up(positions) if formats == "abc" and z_up else positions
                if formats == "abc":
                    # Blender turns points from y up to z up, exactly.
                    expected = numpy.stack([expected[:, 0], -expected[:, 2], expected[:, 1]], axis=1)
                if exact:
                    same(expected, found, f"{formats}: {name}, frame {number}")
                else:
                    assert numpy.abs(found.reshape(-1, 3) - expected).max() < 1e-6, f"{formats}: {name}, frame {number}"
        print(f"{folder}: {formats}: {len(objects)} meshes: {'equal bits' if exact else 'within 1e-6 m'} (Blender)")

    for ending in ["usda", "usdc", "abc"]:
        path = os.path.join(folder, f"run.{ending}")
        if not os.path.exists(path):
            continue
        bpy.ops.wm.read_factory_settings(use_empty=True)
        if ending == "abc":
            rate = re.search(rb"FramesPerTimeUnit=([0-9.]+)", open(path, "rb").read())
            bpy.context.scene.render.fps = round(float(rate.group(1)))
            bpy.ops.wm.alembic_import(filepath=path, set_frame_range=True, as_background_job=False)
        else:
            bpy.ops.wm.usd_import(filepath=path, set_frame_range=True)
        objects = [item for item in bpy.data.objects if item.type == "MESH"]
        assert len(objects) == len(meshes), [item.name for item in objects]
        played(objects, ending, True)
    for ending in ["pc2", "mdd"]:
        objects = []
        bpy.ops.wm.read_factory_settings(use_empty=True)
        for name, (numbers, frames, triangles) in meshes.items():
            path = os.path.join(folder, f"{name}.{ending}")
            if not os.path.exists(path):
                continue
            mesh = bpy.data.meshes.new(name)
            mesh.from_pydata(frames[0].tolist(), [], triangles.tolist())
            item = bpy.data.objects.new(name, mesh)
            bpy.context.collection.objects.link(item)
            cache = item.modifiers.new("cache", "MESH_CACHE")
            cache.cache_format, cache.filepath, cache.frame_start = ending.upper(), path, numbers[0]
            objects.append(item)
        if objects:
            played(objects, ending, ending == "pc2")


def main(folder):
    meshes = truth(folder)
    text = os.path.join(folder, "run.usda")
    z_up = os.path.exists(text) and b'upAxis = "Z"' in open(text, "rb").read(1000)
    if there("pxr"):
        for ending in ["usda", "usdc"]:
            path = os.path.join(folder, f"run.{ending}")
            if os.path.exists(path):
                assert usd(path, meshes) == z_up or ending == "usdc"
    path = os.path.join(folder, "run.abc")
    if os.path.exists(path) and there("alembic3d"):
        alembic(path, meshes, z_up)
    if glob.glob(os.path.join(folder, "run_[0-9]*.vtu")) and there("vtk"):
        grids(folder, meshes)
    if there("bpy"):
        blender(folder, meshes, z_up)


if __name__ == "__main__":
    main(sys.argv[1])
