"""USD files, read with OpenUSD itself and held by its validators."""

import sys

import numpy as np
import pytest
import splatvk

pytest.importorskip("pxr")
from pxr import Usd, UsdGeom, UsdValidation, UsdVol  # noqa: E402


def get(attribute):
    return np.array(attribute.Get())


@pytest.mark.parametrize("name, up", [("a.usdc", "y"), ("a.usda", "z")])
def test_usd_holds_the_scene(scene, tmp_path, name, up):
    path = tmp_path / name
    scene.to_usd(path, up=up)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == up.upper()
    assert UsdGeom.GetStageMetersPerUnit(stage) == (scene.metres_per_unit or 1)
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Scene/Splats"))
    assert splats and stage.GetDefaultPrim().GetPath() == "/Scene"
    assert np.array_equal(get(splats.GetPositionsAttr()), scene.means)
    assert np.array_equal(get(splats.GetScalesAttr()), scene.scales)
    assert np.array_equal(get(splats.GetOpacitiesAttr()), scene.opacities)
    sh = splats.GetRadianceSphericalHarmonicsCoefficientsAttr()
    assert np.array_equal(get(sh).reshape(scene.sh.shape), scene.sh)
    assert UsdGeom.Primvar(sh).GetElementSize() == scene.sh.shape[1] == (scene.sh_degree + 1) ** 2
    for quat, (w, x, y, z) in zip(splats.GetOrientationsAttr().Get()[:50], scene.quats, strict=False):
        assert np.allclose([quat.GetReal(), *quat.GetImaginary()], [w, x, y, z])
    # The direction up of the scene is the axis of the file, and forward stays away from the viewer.
    world = UsdGeom.Xformable(splats).ComputeLocalToWorldTransform(Usd.TimeCode.Default())

    def turned(v):
        return np.array(world.TransformDir(tuple(map(float, v))))

    assert np.allclose(turned(scene.up), np.eye(3)["xyz".index(up)], atol=1e-6)
    assert turned([0, 0, 1]) @ {"y": [0, 0, -1], "z": [0, 1, 0]}[up] > 0.5
    low, high = get(splats.GetExtentAttr())
    assert (low < scene.means.min(axis=0)).all() and (high > scene.means.max(axis=0)).all()
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert not errors, [e.GetMessage() for e in errors]
    # They do notice what is missing.
    stage.ClearDefaultPrim()
    assert UsdValidation.ValidationContext(validators).Validate(stage)


def test_save_knows_usd_by_its_ending(scene, tmp_path):
    path = tmp_path / "b.usdc"
    scene.save(path)
    stage = Usd.Stage.Open(str(path))
    assert stage.GetPrimAtPath("/Scene/Splats") and UsdGeom.GetStageUpAxis(stage) == "Y"
    del stage
    with pytest.raises(splatvk.InputError, match="force"):
        scene.save(path)
    scene.save(path, force=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.usdc"]
    with pytest.raises(splatvk.InputError, match="y or z"):
        scene.to_usd(tmp_path / "c.usdc", up="x")
    with pytest.raises(splatvk.InputError, match="usdc"):
        scene.to_usd(tmp_path / "c.obj")


def test_missing_package_is_named(scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(splatvk.MissingError, match=r"splatvk\[usd\]"):
        scene.save(tmp_path / "d.usdc")
