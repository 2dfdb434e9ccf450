"""A scene of four small photos, made once per session."""

import numpy as np
import pytest
import splatvk
from samples import PHOTOS


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """The scene with the events of its run."""
    events = []
    scene = splatvk.reconstruct(
        PHOTOS,
        out=tmp_path_factory.mktemp("scenes") / "breakfast",
        views=4,
        max_size=160,
        iterations=30,
        preset="draft",
        progress=events.append,
    )
    return scene, events


@pytest.fixture
def scene(made):
    return made[0]


@pytest.fixture(autouse=True)
def numpy_warns_never():
    with np.errstate(all="raise"):
        yield
