"""Exports, meshes and things as files, and their options."""

import json

import numpy as np
import pytest
import splatvk
import trimesh


def test_exports_are_upright_unless_raw(scene, tmp_path):
    done = splatvk.export(scene, tmp_path / "upright.ply")
    raw = splatvk.export(scene.path, tmp_path / "raw.ply", raw=True, guessed=True)
    assert raw["up"] is None and raw["files"] == [str(tmp_path / "raw.ply")]
    own, moved = splatvk.load(tmp_path / "raw.ply"), splatvk.load(tmp_path / "upright.ply")
    assert np.array_equal(own.means[: len(scene)], scene.means) and raw["splats"] == len(own)
    assert done["splats"] == len(moved) == scene.seen.sum()
    assert done["up"]["axis"] == "-y" and done["summary"].startswith("upright")
    assert np.allclose(moved.means[:, 1], -(scene.means[scene.seen] @ scene.up), atol=1e-4)
    cameras = splatvk.export(scene, tmp_path / "cameras.json")
    assert cameras["cameras"] == len(json.loads((tmp_path / "cameras.json").read_text())["frames"])
    for path, options, reason in (
        ("upright.ply", {}, "upright.ply"),
        ("a.ply", {"metres": True}, "scale is not known"),
        ("a.ply", {"up": "x"}, "give -y, y or z"),
        ("a.ply", {"spz_version": 3}, "spz"),
        ("a.ply", {"format": "foo"}, "no format foo"),
    ):
        with pytest.raises(splatvk.InputError, match=reason):
            splatvk.export(scene, tmp_path / path, **options)
    assert not (tmp_path / "a.ply").exists()


def test_meshes_have_parts_and_figures(scene, tmp_path):
    file, seen = tmp_path / "scene.glb", []
    figures = splatvk.mesh(
        scene, file, triangles=4000, by_object=True, collider="hull", progress=seen.append
    )
    parts = trimesh.load(file)
    colliders = [name for name in parts.geometry if "collider" in name]
    assert 0 < figures["triangles"] <= 4000 and figures["parts"] == len(colliders) > 0
    assert figures["unit"] == "scene unit" and {event.kind for event in seen} >= {"begin", "end"}
    plain = splatvk.mesh(scene.path, tmp_path / "raw.ply", voxel=2 * figures["voxel"], raw=True)
    assert np.isclose(plain["voxel"], 2 * figures["voxel"]) and plain["parts"] == 1
    loaded = trimesh.load(tmp_path / "raw.ply")
    assert len(loaded.faces) == plain["triangles"]
    for path, options, reason in (
        ("scene.glb", {}, "scene.glb"),
        ("a.ply", {"collider": "hull"}, "collider"),
        ("a.ply", {"collider": "sphere"}, "decomposition"),
        ("a.ply", {"voxel": "2mm"}, "scale is not known"),
        ("a.ply", {"voxel": 0}, "above 0"),
        ("a.stl", {}, ".glb, .ply or .obj"),
    ):
        with pytest.raises(splatvk.InputError, match=reason):
            splatvk.mesh(scene, tmp_path / path, **options)
    with pytest.raises(KeyError):
        splatvk.mesh(scene, tmp_path / "a.ply", progress=lambda event: {}["stop"])
    assert not (tmp_path / "a.ply").exists()


def test_things_are_written(scene, tmp_path):
    out = tmp_path / "things"
    things = splatvk.objects(scene, min_share=0, out=out, format="spz")
    listed = json.loads((out / "objects.json").read_text())["objects"]
    assert things == listed and things
    objects = [thing for thing in things if thing["level"] == "o"]
    assert objects and all(len(splatvk.load(out / t["file"])) == t["splats"] for t in objects)
    with pytest.raises(splatvk.InputError, match="subpart"):
        splatvk.objects(scene, level="atom")


def test_photo_masks_and_ignored_words_are_options(tmp_path):
    from samples import PHOTOS

    (tmp_path / "masks").mkdir()
    with pytest.raises(splatvk.InputError, match="masks"):
        splatvk.reconstruct(PHOTOS, out=tmp_path / "a", photo_masks=tmp_path / "masks", ignore=["person"])
    with pytest.raises(splatvk.InputError, match="ignore"):
        splatvk.reconstruct(PHOTOS, out=tmp_path / "a", ignore=[""])
