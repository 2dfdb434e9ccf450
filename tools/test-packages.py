"""Makes a scene of photos and asks it, and asks the scene of the command line: run by tools/test-packages in a bare system.

python test-packages.py PHOTOS SCENE
"""

import sys
import time

begin = time.monotonic()

import splatvk  # noqa: E402

answer = splatvk.reconstruct(sys.argv[1], out="two-lines", preset="draft", max_size=320).query("yellow lemon")
print(f"{answer!r} {time.monotonic() - begin:.0f} s after the start")
assert answer.presence == "found", answer

scene = splatvk.load(sys.argv[2])
print(scene)
for text, there in [("lemon", True), ("blue mug", True), ("green apple", False)]:
    answer = scene.query(text)
    print(f"{text}: {answer.verdict}")
    assert (answer.presence == "found") == there, (text, answer.presence)
