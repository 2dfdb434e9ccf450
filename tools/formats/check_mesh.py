"""The checks of tools/formats/check-mesh: names, sizes and colours of meshes through readers that are not ours."""
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh

SPLATVK, SCENE, HOME = (Path(p).resolve() for p in sys.argv[1:4])
WORK = Path(tempfile.mkdtemp(prefix="splatvk-meshes-"))
NAME = SCENE.name
VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then(r => console.log(JSON.stringify(r)));
"""


def mesh(name, *options):
    line = [SPLATVK, "mesh", SCENE, WORK / name, "--triangles", "20000", "--json", *options]
    done = subprocess.run([*map(str, line)], check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.clip(linear, 0, 1) ** (1 / 2.4) - 0.055)


def same_box(what, vertices, figures):
    size = np.ptp(np.asarray(vertices, float), axis=0)
    worst = np.max(np.abs(size / figures["size"] - 1))
    assert worst < 1e-3, f"{what}: its size is {size}, splatvk says {figures['size']}"
    # Half a percent of the vertices may lie below the ground.
    low, high = np.percentile(vertices[:, 1], [1, 99])
    assert low > -0.01 * (high - low), f"{what}: it does not stand on the ground"


def linear_colours(part):
    """COLOR_0, which trimesh keeps beside the material."""
    values = np.asarray(part.visual.vertex_attributes["color"], float)[:, :3]
    return values / 65535 if values.max() > 1 else values


def glb(figures):
    scene = trimesh.load(WORK / "a.glb")
    names = set(scene.graph.nodes)
    assert {NAME, f"{NAME}_collider"} <= names, names
    part = scene.geometry[NAME]
    assert len(part.faces) == figures["triangles"] and part.vertex_normals.shape == part.vertices.shape
    same_box("trimesh, glb", part.vertices, figures)
    hull = scene.geometry[f"{NAME}_collider"]
    assert hull.is_watertight and hull.is_convex, "the collider is not a convex solid"
    assert hull.volume > 0, "the collider is inside out"
    return part


def others(first):
    """Colours and triangles of ply and obj are those of glb: sRGB bytes of its linear numbers."""
    linear = linear_colours(first)
    for name in ["a.ply", "a.obj"]:
        figures = mesh(name)
        got = trimesh.load(WORK / name, process=False, maintain_order=True)
        assert len(got.faces) == figures["triangles"], name
        same_box(f"trimesh, {name}", got.vertices, figures)
        colours = got.visual.vertex_colors[:, :3] / 255.0
        off = abs(np.median(colours, axis=0) - srgb(np.median(linear, axis=0)))
        assert off.max() < 0.02, f"{name}: the middle colour is off by {off}"


def validator():
    if not (HOME / "node_modules/gltf-validator").is_dir():
        return "left out"
    run = ["node", "-e", VALIDATE, str(WORK / "a.glb")]
    done = subprocess.run(run, check=True, capture_output=True, text=True, cwd=HOME)
    issues = json.loads(done.stdout)["issues"]
    assert issues["numErrors"] == 0 and issues["numWarnings"] == 0, issues["messages"][:5]
    return f"no errors, no warnings, {issues['numInfos']} remarks"


def blender(figures, first):
    try:
        import bpy
    except ImportError:
        return "left out"
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(WORK / "a.glb"))
    objects = {o.name: o for o in bpy.data.objects}
    # The node of the scene and the part have one name: Blender numbers the second.
    part = next(o for o in objects.values() if o.type == "MESH" and "_collider" not in o.name)
    assert part.name.split(".")[0] == NAME and part.parent.name.split(".")[0] == NAME, list(objects)
    assert objects[f"{NAME}_collider"].parent is part
    x, y, z = figures["size"]
    # Blender has z up.
    assert np.allclose(part.dimensions, [x, z, y], rtol=1e-3), (part.dimensions[:], figures["size"])
    assert len(part.data.polygons) == figures["triangles"]
    values = np.array([c.color[:3] for c in part.data.color_attributes[0].data])
    linear = linear_colours(first)
    off = abs(np.median(values, axis=0) - np.median(linear, axis=0))
    assert off.max() < 0.03, f"Blender's middle colour is off by {off}"
    return f"Blender {bpy.app.version_string}: {x:.3f} x {y:.3f} x {z:.3f}, names and colours are right"


try:
    figures = mesh("a.glb", "--collider", "hull")
    first = glb(figures)
    print(f"glb    trimesh: {figures['triangles']} triangles, unit {figures['unit']}")
    print(f"glb    Khronos validator: {validator()}")
    others(first)
    print("ply    trimesh: same triangles, size and colours")
    print("obj    trimesh: same triangles, size and colours")
    print(f"glb    {blender(figures, first)}")
finally:
    shutil.rmtree(WORK)
