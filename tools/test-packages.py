"""Makes a scene of four photos and asks it: run by tools/test-packages in a bare system."""

import time

import splatvk

start = time.perf_counter()
scene = splatvk.reconstruct("/work/photos", out="/work/scene", preset="draft")
print(f"{scene}: {time.perf_counter() - start:.0f} s")
for text, there in [("lemon", True), ("blue mug", True), ("teapot", False)]:
    start = time.perf_counter()
    answer = scene.query(text)
    print(f"{text}: {answer.verdict} ({time.perf_counter() - start:.1f} s)")
    assert (answer.presence == "found") == there, answer.presence
