"""Asks a scene for three things: run by tools/test-packages in a bare system with the scene as argument."""

import sys

import splatvk

scene = splatvk.load(sys.argv[1])
print(scene)
for text, there in [("lemon", True), ("blue mug", True), ("green apple", False)]:
    answer = scene.query(text)
    print(f"{text}: {answer.verdict}")
    assert (answer.presence == "found") == there, (text, answer.presence)
