"""Scenes as OpenUSD files, with the schema ParticleField3DGaussianSplat of OpenUSD 26.03."""

import logging
import os
import tempfile
from pathlib import Path

import numpy as np

from .errors import InputError, MissingError

ENDINGS = (".usd", ".usda", ".usdc")
# Axes of the file, in rows, by the one that points up; a scene is right, down, forward.
_AXES = {
    "y": np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]], np.float64),
    "z": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float64),
}


def write(scene, path, up="y", force=False):
    """Writes `scene` with the axis `up` upwards, and metersPerUnit where its metres are known."""
    path = Path(path)
    if up not in _AXES:
        raise InputError(f"up {up!r}: USD has y or z up")
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"{path}: USD files end in {', '.join(ENDINGS)}")
    if path.exists() and not force:
        raise InputError(f"{path}: exists; give another name, or force=True to replace it")
    if len(scene) == 0:
        raise InputError(f"{path}: the scene has no splats")
    try:
        from pxr import Usd, UsdVol
    except ImportError as error:
        raise MissingError("USD files need the package usd-core: pip install splatvk[usd]") from error
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        version = ".".join(map(str, Usd.GetVersion()[1:]))
        raise MissingError(f"OpenUSD {version} has no Gaussian splats: pip install 'usd-core>=26.3'")
    if scene.antialiased:
        logging.getLogger("splatvk").warning(
            "the scene is antialiased and USD cannot say so: programs draw its thin splats too heavy"
        )
    # It appears complete or not at all.
    with tempfile.TemporaryDirectory(dir=path.absolute().parent, prefix=".splatvk-") as folder:
        part = Path(folder) / path.name
        _write(scene, part, up)
        os.replace(part, path)


def _write(scene, path, up):
    from pxr import Gf, Kind, Usd, UsdGeom, UsdVol, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y if up == "y" else UsdGeom.Tokens.z)
    metres = scene.metres_per_unit
    # Without the metadata, readers take centimetres.
    UsdGeom.SetStageMetersPerUnit(stage, 1.0 if metres is None else metres)
    root = UsdGeom.Xform.Define(stage, "/Scene")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    turn = np.eye(4)
    # Gf multiplies row vectors.
    turn[:3, :3] = (_AXES[up] @ _levelled(scene.up)).T
    root.AddTransformOp().Set(Gf.Matrix4d(turn.tolist()))

    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Scene/Splats")
    # The harmonics hold sRGB values, as those of 3DGS do.
    Usd.ColorSpaceAPI.Apply(splats.GetPrim()).CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)
    means, scales = np.array(scene.means), np.array(scene.scales)
    reach = 3 * scales.max(axis=1, keepdims=True)
    bounds = np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)])
    splats.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(bounds.astype(np.float32)))
    splats.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(means))
    splats.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
    # Quaternions lie in memory as x, y, z, w.
    quats = np.ascontiguousarray(np.array(scene.quats)[:, [1, 2, 3, 0]])
    splats.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(quats))
    splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(np.array(scene.opacities)))
    splats.CreateRadianceSphericalHarmonicsDegreeAttr(scene.sh_degree)
    sh = np.array(scene.sh)
    flat = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(sh.reshape(-1, 3)))
    harmonics = UsdGeom.Primvar(splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(flat))
    harmonics.SetElementSize(sh.shape[1])
    harmonics.SetInterpolation(UsdGeom.Tokens.vertex)
    stage.Save()


def _levelled(up):
    """The smallest rotation that makes -y of the direction up; none where it is not known."""
    if up is None:
        return np.eye(3)
    x, y, z = np.asarray(up, np.float64) / np.linalg.norm(up)
    if y > 1 - 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    # Rodrigues' formula about up × -y.
    cross = np.array([[0, x, 0], [-x, 0, -z], [0, z, 0]])
    return np.eye(3) + cross + cross @ cross / (1 - y)
