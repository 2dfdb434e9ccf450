"""Edits: selections as on the command line, and undo."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
import splatvk


@pytest.fixture
def copy(scene, tmp_path):
    return shutil.copytree(scene.path, tmp_path / "scene")


def test_selections_are_those_of_the_command_line(scene, copy):
    editor = splatvk.Editor(copy)
    solid = editor.select("opacity>0.5")
    assert np.array_equal(solid.splats, scene.opacities >= 0.5) and len(solid) == solid.splats.sum()
    assert not solid.doubts and 0 < solid.share < 1
    same = editor.select([{"pick": {"range": {"property": "opacity", "least": 0.5}}}])
    assert np.array_equal(same.splats, solid.splats)
    program = [sys.executable, "-m", "splatvk", "edit", copy, "--delete", "opacity>0.5"]
    program += ["--dry-run", "--json"]
    printed = json.loads(subprocess.run(program, check=True, capture_output=True).stdout)
    assert printed["made"][0]["splats"] == len(solid)


def test_edits_can_be_undone(scene, copy):
    editor = splatvk.Editor(copy)
    count = editor.delete("opacity<0.5")
    # A deletion takes along splats behind the deleted ones, which no photo shows.
    left = len(editor.scene())
    assert count == (scene.opacities < 0.5).sum() and 0 < left <= len(scene) - count
    assert len(splatvk.load(copy)) == left
    assert len(splatvk.load(copy, edits=False)) == len(scene)
    editor.recolour("seen>1", "#36f")
    editor.move("opacity>0.9", (0.0, 0.1, 0.0))
    assert [list(edit["operation"]) for edit in editor.edits] == [["delete"], ["recolour"], ["move"]]
    while editor.undo():
        pass
    assert np.array_equal(splatvk.load(copy).means, scene.means)
    assert editor.redo() and len(editor.edits) == 1


def test_refusals_change_nothing(copy):
    editor = splatvk.Editor(copy)
    for selection in ("id:l99", "age<3", "zorblax of the quindle", [{"pick": {}}]):
        with pytest.raises(splatvk.InputError):
            editor.delete(selection)
    with pytest.raises(splatvk.InputError, match="leaves no splat"):
        editor.delete("opacity>0")
    assert not editor.edits and not (copy / "edits.json").exists()


def test_things_can_be_deleted_by_id(copy):
    things = [thing for thing in splatvk.objects(copy, min_share=0) if thing["level"] == "o"]
    editor = splatvk.Editor(copy)
    smallest = min(things, key=lambda thing: thing["splats"])
    assert editor.delete(f"id:{smallest['id']}") >= smallest["splats"]
    left = [thing for thing in splatvk.objects(copy, min_share=0) if thing["id"] == smallest["id"]]
    assert not left or left[0]["splats"] != smallest["splats"]
    with pytest.raises(splatvk.InputError, match="no language"):
        splatvk.objects(train_only(copy))


def train_only(copy):
    """The scene without its language."""
    manifest = json.loads((copy / "scene.json").read_text())
    manifest.pop("language")
    (copy / "scene.json").write_text(json.dumps(manifest))
    return copy


def test_label(scene, tmp_path):
    scene.save(tmp_path / "foreign.ply")
    cameras = scene.path / "cameras"
    labelled = splatvk.label(
        tmp_path / "foreign.ply",
        images=cameras / "images",
        cameras=cameras / "transforms.json",
        out=tmp_path / "labelled",
        max_size=160,
    )
    assert labelled.has_language and np.array_equal(labelled.means, scene.means)
    assert (tmp_path / "labelled" / "scene.json").exists()
