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


def to_rerun(scene, path):
    """Logs a scene to the recording of `rerun`: Gaussians where the package has them, else points."""
    import rerun as rr

    colours = np.clip(0.5 + _SH_C0 * scene.sh[:, 0], 0, 1)
    rgba = np.concatenate([colours, scene.opacities[:, None]], axis=1)
    if scene.up is not None:
        # The data stay in scene axes; this turns the first view of Rerun.
        axis = int(np.argmax(np.abs(scene.up)))
        name = f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if scene.up[axis] > 0 else 'DOWN'}"
        rr.log(path, getattr(rr.ViewCoordinates, name), static=True)
    if hasattr(rr, "GaussianSplats3D"):
        # Rerun takes the 15 coefficients of degrees 1 to 3.
        rest = np.zeros((len(scene.means), 15, 3), np.float32)
        rest[:, : scene.sh.shape[1] - 1] = scene.sh[:, 1:]
        splats = rr.GaussianSplats3D(
            centers=scene.means,
            scales=scene.scales,
            quaternions=scene.quats[:, [1, 2, 3, 0]],
            colors=rgba,
            sh_coefficients=rest if scene.sh_degree > 0 else None,
        )
    else:
        splats = rr.Points3D(scene.means, colors=rgba, radii=scene.scales.max(axis=1))
    rr.log(f"{path}/splats", splats, static=True)
    for camera in scene.cameras:
        place = f"{path}/cameras/{camera.name.rsplit('.', 1)[0]}"
        rotation = camera.w2c[:3, :3].T
        rr.log(place, rr.Transform3D(translation=camera.center, mat3x3=rotation), static=True)
        pinhole = rr.Pinhole(
            image_from_camera=camera.K,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
        )
        rr.log(place, pinhole, static=True)


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
