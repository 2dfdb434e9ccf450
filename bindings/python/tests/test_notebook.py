"""Arrays as photos, codes, other packages, and the view in notebooks."""

import json

import numpy as np
import pytest
import splatvk

PIXELS = [np.full((48, 64, 3), 0.5, np.float32)] * 2


@pytest.mark.parametrize(
    "photos, words",
    [
        ([PIXELS[0], "a.jpg"], "paths or arrays"),
        ([PIXELS[0][..., 0]] * 2, r"\(H, W, 3\) is needed, not \(48, 64\)"),
        ([PIXELS[0].astype(np.int32)] * 2, "uint8 or float32"),
        ([2 * PIXELS[0] + 1] * 2, r"not all in \[0, 1\]"),
        (["a.jpg"], "out="),
    ],
)
def test_unusable_arrays_are_refused(photos, words):
    with pytest.raises(splatvk.InputError, match=words):
        splatvk.reconstruct(photos)


def test_scene_of_arrays_is_that_of_files(scene):
    image = pytest.importorskip("PIL.Image")
    from samples import PHOTOS

    files = sorted(PHOTOS.glob("*.jpg"))
    pixels = [np.asarray(image.open(path)) for path in files]
    made = splatvk.reconstruct(
        pixels, max_size=160, iterations=10, preset="draft", language=False
    )
    assert made.path is None and len(made.cameras) == 4 and len(made) > 1000
    # Without EXIF both start from an unknown focal length.
    own, other = [[c.K[0, 0] for c in s.cameras] for s in (made, scene)]
    np.testing.assert_allclose(own, other, rtol=0.05)


def test_codes_name_the_splats_of_an_answer(scene):
    codes = scene.codes
    assert codes.shape == (len(scene), 3) and codes.dtype == np.int32
    assert codes.min() >= -1 and codes.max() >= 0 and not codes.flags.writeable
    view = scene.render(0, ["codes"])["codes"]
    camera = scene.cameras[0]
    assert view.shape == (3, camera.height, camera.width) and view.max() <= codes.max()


def test_page_holds_the_scene_and_asks(scene):
    page = scene._repr_html_()
    assert page.startswith("<iframe srcdoc=") and "v-splats" in page and len(page) < 10_000_000
    answer = json.loads(scene._ask("lemon"))
    assert answer["text"] == "lemon" and answer["level"] in (0, 1, 2)


def test_widget_brings_the_selection_back(scene):
    pytest.importorskip("anywidget")
    widget = scene.widget()
    assert not widget.mask.any()
    code = int(scene.codes[:, 2].max())
    thing = int(scene.things.max())
    widget.selection = {"selected": {"level": 3, "codes": [thing]}}
    assert widget.mask.any() and (widget.mask == (scene.things == thing)).all()
    widget.selection = {"selected": {"level": 2, "codes": [code]}, "text": "mug"}
    assert widget.text == "mug"
    assert 0 < len(scene[widget.mask]) == (scene.codes[:, 2] == code).sum()


def test_recording_has_splats_and_cameras(scene, tmp_path):
    rerun = pytest.importorskip("rerun")
    rerun.init("splatvk", spawn=False)
    rerun.save(tmp_path / "scene.rrd")
    scene.to_rerun()
    rerun.disconnect()
    assert (tmp_path / "scene.rrd").stat().st_size > len(scene) * 12
