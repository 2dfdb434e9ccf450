"""Runs: progress, errors, interrupts, processes."""

import logging
import multiprocessing
import os
import signal
import subprocess
import sys
import threading

import pytest
import splatvk
from samples import PHOTOS


def test_progress(made):
    _, events = made
    kinds = {event.kind for event in events}
    assert {"begin", "step", "end", "overall"} <= kinds
    stages = [event.stage for event in events if event.kind == "begin"]
    assert "splats" in stages and "cameras" in stages
    numbers = [event.number for event in events if event.kind == "overall"]
    assert all(1 <= stage <= stages for stage, stages in numbers)


def test_wrong_inputs(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(splatvk.InputError, match="nowhere") as caught:
        splatvk.reconstruct(tmp_path / "nowhere", out=out)
    assert isinstance(caught.value, ValueError) and "\n" not in str(caught.value)
    with pytest.raises(splatvk.InputError, match="max_sise"):
        splatvk.reconstruct(PHOTOS, out=out, max_sise=160)
    with pytest.raises(splatvk.InputError, match="preset|variant"):
        splatvk.reconstruct(PHOTOS, out=out, preset="best")
    assert not out.exists()


def test_exception_of_observer_stops_the_work(tmp_path):
    def observer(event):
        if event.kind == "begin" and event.stage == "cameras":
            raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        splatvk.reconstruct(PHOTOS, out=tmp_path / "out", max_size=160, progress=observer)
    assert not (tmp_path / "out").exists()


def test_interrupt(tmp_path):
    out = tmp_path / "out"
    timer = threading.Timer(2, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        splatvk.reconstruct(PHOTOS, out=out, max_size=320)
    timer.join()
    assert not out.exists()


def test_train_logs(scene, tmp_path, caplog):
    cameras = scene.path / "cameras" / "transforms.json"
    with caplog.at_level(logging.DEBUG, logger="splatvk"):
        trained = splatvk.train(PHOTOS, cameras, out=tmp_path / "out", max_size=160, iterations=5)
    assert not trained.has_language and len(trained.cameras) == 4
    assert "splats begins" in caplog.text


def _answer_in_child(scene, queue):
    try:
        scene.render(0)
        queue.put("rendered")
    except splatvk.ForkError as error:
        queue.put(str(error))


def test_forked_child_is_refused(scene):
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_answer_in_child, args=(scene, queue))
    child.start()
    assert "spawn" in queue.get(timeout=20)
    child.join()


def test_command_line():
    run = [sys.executable, "-m", "splatvk"]
    told = subprocess.run([*run, "--version"], capture_output=True, text=True, check=True)
    assert splatvk.__version__ in told.stdout
    wrong = subprocess.run([*run, "rnu"], capture_output=True, text=True)
    assert wrong.returncode == 2 and "did you mean run" in wrong.stderr
