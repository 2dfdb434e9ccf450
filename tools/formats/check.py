"""The checks of tools/formats/check: every format through a reader or writer that is not ours, JSON against its schemas."""
import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path

import gsply
import numpy as np
import OpenEXR
import plyfile
import pycolmap
import pygltflib
from gsply.spz import read_spz, write_spz
from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match
from referencing import Registry, Resource

import node_readers

SCHEMAS = Path(__file__).resolve().parents[2] / "docs/use/schemas"
SPLATVK, SCENE = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
WORK = Path(tempfile.mkdtemp(prefix="splatvk-formats-"))
C0 = 0.28209479177387814
# Parity of the SH basis in (y, z): what a turn by 180° about x changes, degrees 1 to 3.
TURN = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1])


def run(*args):
    subprocess.run([SPLATVK, *map(str, args)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def close(what, got, expected, bound):
    worst = float(np.max(np.abs(np.asarray(got, np.float64) - np.asarray(expected, np.float64)) - bound))
    assert worst <= 0, f"{what}: beyond the format's precision by {worst:.2e}"


def sigmoid(x):
    return 1 / (1 + np.exp(-np.asarray(x, np.float64)))


def unit(q):
    q = np.asarray(q, np.float64)
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def same_rotations(what, got, expected, bound):
    dots = np.abs(np.sum(unit(got) * unit(expected), axis=1))
    assert dots.min() >= 1 - bound, f"{what}: rotations differ, |q·q'| = {dots.min():.6f}"


def random_splats(n, degree, seed):
    rng = np.random.default_rng(seed)
    k = (degree + 1) ** 2 - 1
    return {
        "means": rng.normal(0, 3, (n, 3)).astype("f4"),
        "scales": rng.uniform(-6, 0, (n, 3)).astype("f4"),
        "quats": unit(rng.normal(size=(n, 4))).astype("f4"),
        "opacities": rng.uniform(-4, 4, n).astype("f4"),
        "sh0": rng.uniform(-1.5, 1.5, (n, 3)).astype("f4"),
        "shN": rng.uniform(-0.9, 0.9, (n, k, 3)).astype("f4"),
    }


def write_ply(path, s):
    """The INRIA layout, by plyfile."""
    n, k = s["shN"].shape[:2]
    rest = s["shN"].transpose(0, 2, 1).reshape(n, 3 * k)
    columns = [("xyz"[i], s["means"][:, i]) for i in range(3)] + [(f"f_dc_{i}", s["sh0"][:, i]) for i in range(3)]
    columns += [(f"f_rest_{i}", rest[:, i]) for i in range(3 * k)] + [("opacity", s["opacities"])]
    columns += [(f"scale_{i}", s["scales"][:, i]) for i in range(3)] + [(f"rot_{i}", s["quats"][:, i]) for i in range(4)]
    table = np.empty(n, dtype=[(name, "f4") for name, _ in columns])
    for name, values in columns:
        table[name] = values
    plyfile.PlyData([plyfile.PlyElement.describe(table, "vertex")]).write(str(path))


def read_ply(path):
    v = plyfile.PlyData.read(str(path))["vertex"]
    stack = lambda names: np.stack([v[name] for name in names], axis=1)
    k = sum(p.name.startswith("f_rest_") for p in v.properties) // 3
    n = len(v["x"])
    rest = stack([f"f_rest_{i}" for i in range(3 * k)]).reshape(n, 3, k).transpose(0, 2, 1) if k else np.zeros((n, 0, 3))
    return {
        "means": stack("xyz"), "scales": stack([f"scale_{i}" for i in range(3)]),
        "quats": stack([f"rot_{i}" for i in range(4)]), "opacities": np.asarray(v["opacity"]),
        "sh0": stack([f"f_dc_{i}" for i in range(3)]), "shN": rest,
    }


def of_gsply(d):
    k = 0 if d.shN is None else np.asarray(d.shN).shape[1]
    return {
        "means": d.means, "scales": d.scales, "quats": d.quats, "opacities": np.asarray(d.opacities).reshape(-1),
        "sh0": d.sh0, "shN": np.asarray(d.shN) if k else np.zeros((len(d.means), 0, 3)),
    }


def turned(s):
    """The same splats with y and z turned round."""
    k = s["shN"].shape[1]
    flip = np.array([1, -1, -1])
    return {**s, "means": s["means"] * flip, "quats": s["quats"] * np.array([1, 1, -1, -1]),
            "shN": s["shN"] * TURN[None, :k, None]}


def read_gltf(path):
    """Accessors by pygltflib, in the scene's axes; KHR_gaussian_splatting holds scales and opacities themselves."""
    file = pygltflib.GLTF2().load(str(path))
    (primitive,) = file.meshes[0].primitives
    extension = primitive.extensions["KHR_gaussian_splatting"]
    assert primitive.mode == 0 and file.extensionsUsed == ["KHR_gaussian_splatting"]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    types = {5123: "<u2", 5126: "<f4"}

    def values(name):
        accessor = file.accessors[vars(primitive.attributes)[name]]
        view = file.bufferViews[accessor.bufferView]
        data = file.get_data_from_buffer_uri(file.buffers[0].uri) if file.buffers[0].uri else file.binary_blob()
        n = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        return np.frombuffer(data, types[accessor.componentType], accessor.count * n, view.byteOffset).reshape(-1, n)

    own = lambda name: values("KHR_gaussian_splatting:" + name)
    a = own("OPACITY").astype("f8").reshape(-1)
    means = values("POSITION")
    position = file.accessors[primitive.attributes.POSITION]
    assert position.min == means.min(0).tolist() and position.max == means.max(0).tolist()
    degree = max(d for d in range(4) if f"KHR_gaussian_splatting:SH_DEGREE_{d}_COEF_0" in vars(primitive.attributes))
    rest = [own(f"SH_DEGREE_{d}_COEF_{n}") for d in range(1, degree + 1) for n in range(2 * d + 1)]
    # The colour for programs without the extension is linear light.
    c = np.clip(0.5 + C0 * own("SH_DEGREE_0_COEF_0").astype("f8"), 0, 1)
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    close("glTF COLOR_0", values("COLOR_0") / 65535, np.column_stack([linear, a]), 1e-5)
    x, y, z, w = own("ROTATION").T
    return {**turned({
        "means": means, "scales": np.log(own("SCALE")), "quats": own("ROTATION"),
        "opacities": np.log(a / (1 - a)), "sh0": own("SH_DEGREE_0_COEF_0"),
        "shN": np.stack(rest, axis=1) if rest else np.zeros((len(means), 0, 3)),
    }), "quats": np.stack([x, -w, z, -y], 1)}  # the scene is turned, not the splats' own axes


def write_gltf(path, s):
    """The same layout, interleaved and half of it quantised, below a node that turns and doubles it; by pygltflib."""
    w, x, y, z = s["quats"].T
    t = {**turned(s), "quats": np.stack([-x, w, -z, y], 1)}
    turn = np.sqrt(0.5)  # a quarter turn about z: the file's x is the scene's -y
    n, k = t["shN"].shape[:2]
    back = {"means": np.stack([t["means"][:, 1], -t["means"][:, 0], t["means"][:, 2]], 1) / 2}
    product = np.array([[turn, 0, 0, turn], [0, turn, turn, 0], [0, -turn, turn, 0], [-turn, 0, 0, turn]])
    quats = t["quats"] @ product.T
    row = np.dtype([("POSITION", "<f4", 3), ("SCALE", "<f4", 3), ("ROTATION", "<i2", 4), ("OPACITY", "<u2"), ("pad", "<u2"),
                    ("SH", "<f4", 3)])
    data = np.zeros(n, row)
    data["POSITION"], data["SCALE"], data["SH"] = back["means"], np.exp(t["scales"]) / 2, t["sh0"]
    data["ROTATION"] = np.round(quats[:, [1, 2, 3, 0]] * 32767)
    data["OPACITY"] = np.round(sigmoid(t["opacities"]) * 65535)
    names = {"POSITION": ("VEC3", 5126, False), "SCALE": ("VEC3", 5126, False), "ROTATION": ("VEC4", 5122, True),
             "OPACITY": ("SCALAR", 5123, True), "SH": ("VEC3", 5126, False)}
    attributes, accessors = {}, []
    for name, (kind, component, normalized) in names.items():
        full = {"POSITION": name, "SH": "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"}.get(name, "KHR_gaussian_splatting:" + name)
        attributes[full] = len(accessors)
        accessors.append(pygltflib.Accessor(bufferView=0, byteOffset=row.fields[name][1], componentType=component,
                                            normalized=normalized, count=n, type=kind))
    extension = {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    file = pygltflib.GLTF2(
        scene=0, scenes=[pygltflib.Scene(nodes=[0])],
        nodes=[pygltflib.Node(children=[1], rotation=[0, 0, turn, turn]), pygltflib.Node(mesh=0, scale=[2, 2, 2])],
        meshes=[pygltflib.Mesh(primitives=[pygltflib.Primitive(
            mode=0, attributes=pygltflib.Attributes(**attributes), extensions=extension)])],
        accessors=accessors, bufferViews=[pygltflib.BufferView(buffer=0, byteLength=data.nbytes, byteStride=row.itemsize)],
        buffers=[pygltflib.Buffer(byteLength=data.nbytes)], extensionsUsed=["KHR_gaussian_splatting"])
    file.set_binary_blob(data.tobytes())
    file.save(str(path))


def compare(what, got, expected, means, scales, rotation, opacity, sh0, sh):
    close(f"{what} positions", got["means"], expected["means"], means)
    close(f"{what} scales", got["scales"], expected["scales"], scales)
    same_rotations(what, got["quats"], expected["quats"], rotation)
    close(f"{what} opacity", sigmoid(got["opacities"]), sigmoid(expected["opacities"]), opacity)
    close(f"{what} colours", C0 * np.asarray(got["sh0"]), C0 * np.asarray(expected["sh0"]), C0 * sh0)
    assert got["shN"].shape == expected["shN"].shape, f"{what}: SH {got['shN'].shape}"
    if sh is not None and expected["shN"].size:
        close(f"{what} SH", got["shN"], expected["shN"], sh)
    print(f"ok  {what}")


# Half a step of each format, and a little for f32 on the way; spz: 24-bit positions, scales in sixteenths, colours in
# 1/38.25, nine bits of a rotation component.
SPZ = dict(means=2e-5, scales=0.0313, rotation=1e-5, opacity=0.00197, sh0=0.0131, sh=0.0040)


def packed_bounds(s):
    """Half a step of the coarsest axis, were all of the scene one chunk."""
    span = lambda a: float(np.ptp(a, axis=0).max())
    return dict(means=span(s["means"]) / 2046, scales=span(s["scales"]) / 2046 + 1e-5, rotation=1e-5, opacity=0.00197,
                sh0=span(s["sh0"]) / 510 + 1e-5, sh=0.0157)


def by_position(got, expected):
    """Rows of `got` that belong to the rows of `expected`, for formats that sort; every row is used once."""
    d = ((got["means"][None] - expected["means"][:, None]) ** 2).sum(-1)
    rows = d.argmin(1)
    assert len(set(rows)) == len(rows), "two splats of the file are one of the scene's"
    return rows, {k: np.asarray(v)[rows] for k, v in got.items()}


def splats():
    for degree in range(4):
        s = random_splats(900, degree, degree)
        source = WORK / f"in{degree}.ply"
        write_ply(source, s)
        exact = dict(means=0, scales=0, rotation=1e-6, opacity=1e-7, sh0=0, sh=0)
        out = WORK / "out.ply"
        run("export", source, "--format", "ply", "--ply-degree", degree, "--force", "--out", out)
        compare(f"ply degree {degree}: plyfile", read_ply(out), s, **exact)
        compare(f"ply degree {degree}: gsply", of_gsply(gsply.plyread(str(out))), s, **exact)

        out = WORK / "out.compressed.ply"
        run("export", source, "--format", "compressed-ply", "--force", "--out", out)
        _, got = by_position(of_gsply(gsply.plyread(str(out))), s)
        compare(f"compressed ply degree {degree}: gsply", got, s, **packed_bounds(s))

        out = WORK / "out.spz"
        for version in (3, 4):
            run("export", source, "--format", "spz", "--spz-version", version, "--force", "--out", out)
            compare(f"spz {version} degree {degree}: gsply", turned(of_gsply(read_spz(str(out)))), s, **SPZ)

        for kind in ("glb", "gltf"):
            out = WORK / f"out.{kind}"
            run("export", source, "--format", kind, "--force", "--out", out)
            compare(f"{kind} degree {degree}: pygltflib", read_gltf(out), s, means=0, scales=1e-6, rotation=1e-6,
                    opacity=1e-7, sh0=0, sh=1e-6)
        others(s, degree)
    s = random_splats(900, 0, 7)
    write_ply(WORK / "in.ply", s)
    run("export", WORK / "in.ply", "--format", "splat", "--out", WORK / "out.splat")
    row = np.dtype([("means", "f4", 3), ("scales", "f4", 3), ("colour", "u1", 4), ("quats", "u1", 4)])
    f = np.fromfile(WORK / "out.splat", row)
    got = {
        "means": f["means"], "scales": np.log(f["scales"]), "quats": (f["quats"].astype("f8") - 128) / 128,
        "opacities": np.log((f["colour"][:, 3] + 1e-9) / (255 - f["colour"][:, 3] + 1e-9)),
        "sh0": (f["colour"][:, :3] / 255 - 0.5) / C0, "shN": np.zeros((len(f), 0, 3)),
    }
    visible = np.abs(C0 * s["sh0"]).max(1) < 0.5  # the format clamps colours to [0, 1]
    _, got = by_position(got, s)
    pick = lambda t: {k: np.asarray(v)[visible] for k, v in t.items()}
    compare("splat: numpy record array", pick(got), pick(s), 0, 1e-5, 1e-4, 0.00197, 0.0071, None)


def others(s, degree):
    """Files that other programs wrote, read by splatvk."""
    back = WORK / "back.ply"

    def through(name, **bounds):
        run("export", WORK / name, "--format", "ply", "--ply-degree", degree, "--force", "--out", back)
        got = read_ply(back)
        if "compressed" in name:
            _, got = by_position(got, s)
        compare(f"reading {name} degree {degree}", got, s, **bounds)

    n, k = s["shN"].shape[:2]
    data = gsply.GSData.from_arrays(**{key: s[key] for key in ("means", "scales", "quats", "opacities", "sh0")},
                                    shN=s["shN"] if k else None)
    gsply.plywrite(str(WORK / "gsply.compressed.ply"), data, compressed=True)
    through("gsply.compressed.ply", **{**packed_bounds(s), "sh": 0.033})
    if degree == 0:
        write_gltf(WORK / "pygltflib.glb", s)
        through("pygltflib.glb", means=1e-5, scales=1e-5, rotation=1e-6, opacity=1e-5, sh0=0, sh=0)
    t = turned(s)
    data = gsply.GSData.from_arrays(**{key: t[key].astype("f4") for key in ("means", "scales", "quats", "opacities", "sh0")},
                                    shN=t["shN"].astype("f4") if k else None)
    for version in (3, 4):
        write_spz(str(WORK / f"gsply-v{version}.spz"), data, version=version, fractional_bits=14)
        through(f"gsply-v{version}.spz", **{**SPZ, "means": 4e-5})


def matrices():
    """World to camera of the scene, by stem, from its transforms.json."""
    out = {}
    for f in json.loads((SCENE / "cameras/transforms.json").read_text())["frames"]:
        m = np.linalg.inv(np.array(f["transform_matrix"]) @ np.diag([1, -1, -1, 1.0]))
        out[Path(f["file_path"]).stem] = (m, np.array([f["fl_x"], f["fl_y"], f["cx"], f["cy"]]))
    return out


def cameras():
    expected = matrices()
    for kind in ("colmap", "colmap-bin"):
        run("export", SCENE, "--raw", "--format", kind, "--out", WORK / kind)
        model = pycolmap.Reconstruction(str(WORK / kind))
        assert model.num_images() == len(expected) and model.num_points3D() > 100
        for image in model.images.values():
            m, intrinsics = expected[Path(image.name).stem]
            close(f"{kind} pose", image.cam_from_world().matrix(), m[:3], 1e-9)
            close(f"{kind} intrinsics", image.camera.params, intrinsics, 1e-9)
        print(f"ok  {kind}: pycolmap")
    run("export", SCENE, "--raw", "--format", "transforms", "--out", WORK / "transforms.json")
    # What pycolmap writes is read by splatvk: the same pictures come out.
    model = pycolmap.Reconstruction(str(WORK / "colmap-bin"))
    for kind in ("text", "binary"):
        folder = WORK / f"pycolmap-{kind}"
        folder.mkdir()
        getattr(model, f"write_{kind}")(str(folder))
        run("render", SCENE, "--cameras", folder, "--out", WORK / kind, "--format", "npy")
    run("render", SCENE, "--cameras", WORK / "transforms.json", "--out", WORK / "own", "--format", "npy")
    for stem in expected:
        own = np.load(WORK / "own" / f"{stem}_rgb.npy")
        for kind in ("text", "binary"):
            # Poses that differ in the last digit of a double move a pixel by less than this.
            close(f"rendered with pycolmap's {kind}", np.load(WORK / kind / f"{stem}_rgb.npy"), own, 1e-3)
    print("ok  models written by pycolmap")


def linear(v):
    a = np.abs(v)
    return np.copysign(np.where(a <= 0.04045, a / 12.92, ((a + 0.055) / 1.055) ** 2.4), v)


def images():
    channels = "rgb,alpha,depth,features,codes"
    run("render", SCENE, "--cameras", SCENE / "cameras/transforms.json", "--out", WORK / "maps", "--channels", channels,
        "--format", "exr,npy")
    for stem in matrices():
        with OpenEXR.File(str(WORK / "maps" / f"{stem}.exr"), separate_channels=True) as file:
            got = {name: c.pixels for name, c in file.channels().items()}
        load = lambda part: np.load(WORK / "maps" / f"{stem}_{part}.npy")
        for k, name in enumerate("RGB"):
            # OpenEXR holds linear light, npy what the splats hold: sRGB, continued above 1.
            close(f"EXR {name}", got[name], linear(load("rgb")[..., k]), 1e-5)
        close("EXR A", got["A"], load("alpha"), 0)
        close("EXR Z", got["Z"], load("depth"), 0)
        first = 0
        for level in "sml":
            if not (WORK / "maps" / f"{stem}_features_{level}.npy").exists():
                continue
            features = load(f"features_{level}")
            for k in range(features.shape[2]):
                close("EXR features", got[f"feat.{first + k:02d}"], features[..., k], 0)
            first += features.shape[2]
            close("EXR codes", got[f"code.{level}"], load(f"codes_{level}"), 0)
    print("ok  EXR: OpenEXR against npy: numpy")


def language():
    """Features travel with their splats through a format that sorts them."""
    out = WORK / "scene.compressed.ply"
    run("export", SCENE, "--raw", "--format", "compressed-ply", "--out", out)
    side = np.load(str(out) + ".language.npz")
    features = np.load(SCENE / "language/features.npz")
    whole, packed = read_ply(SCENE / "point_cloud.ply"), of_gsply(gsply.plyread(str(out)))
    # What no photo shows is left out.
    seen = np.load(SCENE / "seen.npy") >= 0.05
    whole = {"means": whole["means"][seen]}
    span = np.ptp(whole["means"], axis=0).max() / 2046

    def carried(arrays, level):
        return np.stack([arrays[f"{kind}_{level}"] for kind in ("first", "second", "share", "reliability")], axis=1)

    for level in (name[-1] for name in features.files if name.startswith("first_")):
        # What only one splat carries tells where that splat went; its position must have gone there, too.
        ours = carried(features, level)[seen]
        unique, first, count = np.unique(ours, axis=0, return_index=True, return_counts=True)
        where = {f.tobytes(): i for f, i, n in zip(unique, first, count) if n == 1}
        known = {f.tobytes() for f in unique}
        rows = [f.tobytes() for f in carried(side, level)]
        assert len(rows) == len(ours) and known.issuperset(rows), f"level {level}: not what the scene's splats carry"
        pairs = np.array([(r, where[f]) for r, f in enumerate(rows) if f in where])
        assert len(pairs) == len(where) > 100, f"level {level}: {len(pairs)} of {len(where)} splats found again"
        close(f"language level {level}", packed["means"][pairs[:, 0]], whole["means"][pairs[:, 1]], span)
        print(f"ok  language beside compressed ply, level {level}: {len(pairs)} splats found again")
    # And through splatvk again: the file with its side file answers.
    run("query", out, "lemon", "--cameras", SCENE / "cameras/transforms.json", "--out", WORK / "answers")
    print("ok  language beside compressed ply answers a query")


def validators():
    """A function that holds a value to a schema of docs/use/schemas, by the name of the schema."""
    schemas = {p.name.removesuffix(".schema.json"): json.loads(p.read_text()) for p in SCHEMAS.glob("*.schema.json")}
    registry = Registry().with_resources((s["$id"], Resource.from_contents(s)) for s in schemas.values())
    for name, schema in schemas.items():
        Draft202012Validator.check_schema(schema)
        assert schema["$id"].endswith(f"/{name}.schema.json"), f"{name}.schema.json: its $id is {schema['$id']}"

    def hold(name, value, place):
        error = best_match(Draft202012Validator(schemas[name], registry=registry).iter_errors(value))
        assert error is None, f"{place}: {error.json_path}: {error.message} ({name}.schema.json)"

    return sorted(set(schemas) - {"common"}), hold


def read_lines(text):
    return [json.loads(line) for line in text.splitlines()]


def grey(path, pixels):
    """An 8-bit greyscale PNG."""
    h, w = pixels.shape
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    rows = np.column_stack([np.zeros(h, "u1"), pixels.astype("u1")]).tobytes()
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", w, h, 8, 0, 0, 0, 0))
                     + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))


def ground_truth(folder):
    """Ground truth of the scene's own cameras, photos and depth; the left half of each photo is the object, and the first
    photo is a held-out frame, too. Returns the content of ground_truth.json."""
    frames = []
    for name in ("images", "masks", "depth", "used"):
        (folder / name).mkdir(parents=True)
    poses = matrices()
    for split, stem in [("train", stem) for stem in poses] + [("test", next(iter(poses)))]:
        m, (fx, fy, cx, cy) = poses[stem]
        depth = np.load(WORK / "maps" / f"{stem}_depth.npy")
        h, w = depth.shape
        name = stem if split == "train" else "held_out"
        (folder / f"images/{name}.png").write_bytes((SCENE / f"cameras/images/{stem}.png").read_bytes())
        grey(folder / f"masks/{name}.png", np.repeat([np.arange(w) < w // 2], h, axis=0))
        grey(folder / f"used/{name}.png", 255 * np.repeat([np.arange(w) < w * 0.9], h, axis=0))
        np.savez(folder / f"depth/{name}.npz", depth=depth)
        frames.append({"file": f"images/{name}.png", "split": split, "fx": fx, "fy": fy, "cx": cx, "cy": cy,
                       "world_to_camera": m.tolist()})
    truth = {"width": w, "height": h, "labels": {"1": "lemon"}, "up": [0, -1, 0], "frames": frames}
    (folder / "ground_truth.json").write_text(json.dumps(truth))
    return truth


def examples(names, hold):
    """Every schema has an example that fits it."""
    for name in names:
        example = SCHEMAS / "examples" / (f"{name}.jsonl" if name == "log" else f"{name}.json")
        for value in read_lines(example.read_text()) if name == "log" else [json.loads(example.read_text())]:
            hold(name, value, example.name)
    strays = {p.stem for p in (SCHEMAS / "examples").iterdir()} - set(names)
    assert not strays, f"examples without a schema: {strays}"
    print(f"ok  examples of {len(names)} JSON schemas")


def json_formats():
    """Examples of docs/use/schemas, and JSON that splatvk writes now, against their schemas."""
    names, hold = validators()
    examples(names, hold)
    # Stages of training stay in a folder of their own; models and ONNX Runtime are those that are installed.
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share"
    home, installed = WORK / "home", Path(os.environ.get("SPLATVK_HOME") or Path(data) / "splatvk")
    home.mkdir()
    for part in ("lib", "models"):
        (home / part).symlink_to(installed / part)

    def said(name, *args):
        """Holds the output of a command with --json to a schema, and its log to that of logs; returns the log's events. Without
        a name the command may fail."""
        done = subprocess.run([SPLATVK, "--log", "json", *map(str, args)], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                              env={**os.environ, "SPLATVK_HOME": str(home)})
        lines = read_lines(done.stderr.decode())
        for line in lines:
            hold("log", line, f"log of {args[0]}")
        if name is not None:
            assert done.returncode == 0, lines
            hold(name, json.loads(done.stdout), f"output of {args[0]}")
        return {line["event"] for line in lines}

    def scene(folder):
        for file, name in [("scene.json", "scene"), ("run.json", "run"), ("cameras/photos.json", "photos"),
                           ("cameras/transforms.json", "transforms"), ("cameras/original/transforms.json", "transforms"),
                           ("cameras/original/transforms.json", "transforms-read")]:
            hold(name, json.loads((folder / file).read_text()), folder / file)

    scene(SCENE)
    hold("answers", json.loads((WORK / "answers/answers.json").read_text()), "answers.json")
    hold("transforms", json.loads((WORK / "transforms.json").read_text()), "export --format transforms")
    print("ok  JSON of the scene directory, its answers and its exported cameras")

    truth = WORK / "truth"
    hold("ground_truth", ground_truth(truth), "ground_truth.json")
    events = said("answers", "query", SCENE, "a mug without a handle", "--json")
    events |= said("eval", "eval", SCENE, "--ground-truth", truth, "--out", WORK / "eval", "--json")
    hold("eval", json.loads((WORK / "eval/eval.json").read_text()), "eval.json")
    events |= said("measure", "measure", SCENE, "0,0,1 - 1,0,1", "--json")
    events |= said("objects", "objects", SCENE, "--json")
    edited = WORK / "edited"
    shutil.copytree(SCENE, edited)
    run("edit", edited, "--delete", "opacity<0.2", "--recolour", "seen>1=#36f")
    hold("edits", json.loads((edited / "edits.json").read_text()), "edits.json")
    events |= said("models-list", "models", "list", "--json")
    events |= said("doctor", "doctor", "--json")
    said(None, "bench", "--splats", 500, "--width", 64, "--height", 48, "--features", 0, "--repeats", 1, "--json",
         WORK / "bench.json")
    hold("bench", json.loads((WORK / "bench.json").read_text()), "bench --json")
    # A scene without language, with masks and a scale; the examples of camera files are rendered from it.
    small = WORK / "small"
    cameras = SCENE / "cameras"
    events |= said("train", "train", "--images", cameras / "images", "--cameras", cameras / "transforms.json", "--points",
                   SCENE / "point_cloud.ply", "--photo-masks", truth / "used", "--iterations", 10, "--max-size", 64, "--preset",
                   "draft", "--out", small, "--json")
    events |= said("measure", "measure", small, "--scale", "0,0,1 - 1,0,1 = 21cm", "--json")
    scene(small)
    for name in ("cameras", "transforms", "transforms-read"):
        said(None, "render", small, "--cameras", SCHEMAS / f"examples/{name}.json", "--out", WORK / f"by-{name}")
        assert any(WORK.glob(f"by-{name}/*.png")), f"{name}.json: nothing was rendered"
    shutil.copy(SCHEMAS / "examples/views.json", small / "views.json")
    said(None, "render", small, "--view", "From the right", "--height", 48, "--out", WORK / "by-view")
    assert any(WORK.glob("by-view/*.png")), "views.json: nothing was rendered"
    events |= said(None, "query", WORK / "nowhere", "lemon")
    assert events >= {"begin", "step", "figures", "end", "error"}, f"the logs only have {sorted(events)}"
    print("ok  output and logs of query, eval, measure, train, models list, doctor and bench")


splats()
node_readers.check(sys.modules[__name__])
cameras()
images()
language()
json_formats()
