"""Scenes in the types of other packages."""

import numpy as np

_SH_C0 = 0.28209479177387814


def to_gsplat(scene):
    """Arguments of gsplat's `rasterization` as a dict of arrays, which `torch.from_numpy` takes."""
    cameras = scene.cameras
    arguments = {
        "means": np.array(scene.means),
        "quats": np.array(scene.quats),
        "scales": np.array(scene.scales),
        "opacities": np.array(scene.opacities),
        "colors": np.array(scene.sh),
        "sh_degree": scene.sh_degree,
        "rasterize_mode": "antialiased" if scene.antialiased else "classic",
    }
    if cameras:
        arguments["viewmats"] = np.stack([c.w2c for c in cameras]).astype(np.float32)
        arguments["Ks"] = np.stack([c.K for c in cameras]).astype(np.float32)
        arguments["width"] = cameras[0].width
        arguments["height"] = cameras[0].height
    return arguments


def to_trimesh(scene):
    """The centres of the splats with their colours, a `trimesh.PointCloud`."""
    import trimesh

    colours = np.clip(0.5 + _SH_C0 * scene.sh[:, 0], 0, 1)
    rgba = np.concatenate([colours, scene.opacities[:, None]], axis=1)
    return trimesh.PointCloud(np.array(scene.means), (255 * rgba).round().astype(np.uint8))


def to_pycolmap(scene):
    """Cameras and points as a `pycolmap.Reconstruction`, from the scene's directory."""
    import pycolmap

    from .errors import InputError

    model = scene.path and scene.path / "cameras" / "colmap"
    if not model or not model.is_dir():
        raise InputError("only a scene directory has a COLMAP model; save the scene to one first")
    return pycolmap.Reconstruction(str(model))
