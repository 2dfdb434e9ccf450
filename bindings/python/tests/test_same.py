"""Results of the package are those of the command, and long use keeps its memory."""

import gc
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import splatvk
from samples import PHOTOS

OPTIONS = {"max_size": 160, "iterations": 10, "preset": "draft", "views": 3}
LOOPS = 200
WARM_UP = 20


def command(*arguments):
    run = [sys.executable, "-m", "splatvk", *map(str, arguments)]
    return subprocess.run(run, capture_output=True, text=True, check=True).stdout


def test_scene_and_answer_are_those_of_the_command(tmp_path):
    made = splatvk.reconstruct(PHOTOS, out=tmp_path / "package", deterministic=True, **OPTIONS)
    options = [f"--{k.replace('_', '-')}={v}" for k, v in OPTIONS.items()]
    command("run", PHOTOS, "--out", tmp_path / "command", "--deterministic", *options)
    for name in ["point_cloud.ply", "seen.npy", "language/features.npz"]:
        own, other = [(tmp_path / place / name).read_bytes() for place in ("package", "command")]
        assert own == other, name
    loaded = splatvk.load(tmp_path / "command")
    for array in ["means", "scales", "quats", "opacities", "sh", "seen", "codes"]:
        own, other = getattr(made, array), getattr(loaded, array)
        assert np.array_equal(own, other), array
    # Files hold cameras with fewer digits than the memory of a run.
    stored = splatvk.load(tmp_path / "package")
    assert all(np.array_equal(a.w2c, b.w2c) for a, b in zip(stored.cameras, loaded.cameras, strict=True))
    assert all(np.allclose(a.w2c, b.w2c) for a, b in zip(made.cameras, loaded.cameras, strict=True))
    answer = stored.query("lemon")
    asked = json.loads(command("query", tmp_path / "command", "lemon", "--json"))
    [record] = asked["queries"]
    assert (answer.presence, answer.p_value) == (record["presence"], record["p_value"])
    assert len(answer.things) == len(record["instances"])


def resident():
    """Resident memory of the process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_memory_is_stable_over_many_scenes(scene):
    path, camera = scene.path, scene.cameras[0]
    sizes = []
    for loop in range(LOOPS):
        other = splatvk.load(path)
        other.render(camera, ["rgb", "depth"])
        other[np.arange(100)].means.sum()
        # A question loads the words anew, a second on two cores.
        if loop % 5 == 0:
            other.query("lemon").mask()
        del other
        if loop >= WARM_UP and loop % 20 == 0:
            gc.collect()
            sizes.append(resident())
    assert sizes[-1] - sizes[0] < 30, sizes
