"""Answers to texts."""

import numpy as np
import pytest
import splatvk


def test_answer(scene):
    answer = scene.query("lemon")
    camera = scene.cameras[0]
    assert answer.text == "lemon" and answer.presence in ("found", "unsure", "absent")
    assert answer.mask().shape == answer.heat().shape == (camera.height, camera.width)
    assert answer.mask().dtype == bool and answer.heat().dtype == np.float32
    assert answer.splats.shape == (len(scene),)
    if answer.things:
        thing = answer.things[0]
        assert (thing.box[0] <= thing.center).all() and (thing.center <= thing.box[1]).all()
        assert np.allclose(np.linalg.norm(thing.oriented_box, axis=1), thing.size)
        assert thing.metres is None and answer.splats[thing.splats].all()


def test_other_views(scene):
    answer = scene.query("lemon")
    other = scene.query("lemon", camera=2)
    assert np.array_equal(answer.mask(2), other.mask())
    assert answer.camera == scene.cameras[0] and other.camera == scene.cameras[2]


def test_texts_are_checked(scene):
    with pytest.raises(splatvk.InputError):
        scene.query("")
    with pytest.raises(splatvk.InputError, match="no language"):
        bare = scene.path / "point_cloud.ply"
        splatvk.load(bare).query("lemon", camera=scene.cameras[0])
