import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from splatvk.batch import _results, _row, run_row
from splatvk.batch._program import Keeper, KeeperGone
from splatvk.batch._store import open_store


@pytest.fixture
def row(photos):
    return {"id": "shop", "input": str(photos), "options": {}, "queries": ["chair"], "exports": ["glb"]}


def success_of(place):
    return json.loads(open_store(place).read("shop/_SUCCESS.json"))


def whole(place):
    """Whether the row has one result and nothing else."""
    store, success = open_store(place), success_of(place)
    assert store.names("shop") == sorted([success["at"], "_SUCCESS.json"])
    for file in success["files"]:
        assert len(store.read(f"shop/{success['at']}/{file['path']}")) == file["bytes"]
    return success


def eventually(true, seconds=10.0):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_row_is_stored_once(place, row, scratch):
    first = run_row(row, place, scratch=str(scratch))
    assert first["state"] == "done", first
    success = whole(place)
    assert {f["path"] for f in success["files"]} >= {"scene/part0.bin", "exports/scene.glb"}
    assert first["scene"] == f"{place}/shop/{success['at']}/scene"
    again = run_row(row, place, scratch=str(scratch))
    assert (again["state"], again["scene"]) == ("skipped", first["scene"])
    assert os.listdir(scratch) == []


def test_touched_photos_are_not_redone(row, photos, scratch, tmp_path):
    place = str(tmp_path / "out")
    run_row(row, place, scratch=str(scratch))
    before = success_of(place)
    os.utime(photos / "0.jpg", (1, 1))
    assert run_row(row, place, scratch=str(scratch))["state"] == "skipped"
    after = success_of(place)
    assert after["at"] == before["at"] and after["source"] != before["source"]


def test_changed_options_replace_result(place, row, scratch):
    run_row(row, place, scratch=str(scratch))
    old = success_of(place)
    changed = {**row, "options": {"max_size": 640}}
    assert run_row(changed, place, scratch=str(scratch))["state"] == "done"
    new = whole(place)
    assert new["at"] != old["at"] and new["key"] != old["key"]


def test_result_of_one_machine_is_replaced(row, scratch, tmp_path):
    place = tmp_path / "out"
    for folder in ("scene", "exports"):
        (place / "shop" / folder).mkdir(parents=True)
        (place / "shop" / folder / "x").write_text("old")
    (place / "shop" / "_SUCCESS.json").write_text(json.dumps({"key": "other", "at": "."}))
    assert run_row(row, str(place), scratch=str(scratch))["state"] == "done"
    whole(str(place))


def test_remote_inputs_are_fetched(row, photos, scratch, tmp_path, s3):
    import s3fs

    fs, base = s3fs.S3FileSystem(), f"scenes/{tmp_path.name}/photos/shop"
    fs.put([str(p) for p in sorted(photos.iterdir())], [f"{base}/{n}.jpg" for n in range(3)])
    local = run_row(row, str(tmp_path / "a"), scratch=str(scratch))
    for entry in (f"s3://{base}", f"s3://{base}/*.jpg", [f"s3://{base}/{n}.jpg" for n in range(3)]):
        place = str(tmp_path / "b")
        outcome = run_row({**row, "input": entry}, place, scratch=str(scratch))
        # Equal photos have one key, whatever their address.
        assert outcome["state"] in ("done", "skipped") and outcome["key"] == local["key"], outcome
        assert {f[0] for f in success_of(place)["source"]["files"]} == {
            f"s3://{base}/{n}.jpg" for n in range(3)
        }
    none = run_row({**row, "input": f"s3://{base}/*.png"}, str(tmp_path / "b"), scratch=str(scratch))
    assert (none["kind"], none["exit_code"]) == ("refused", 2), none


@pytest.mark.parametrize(
    "options, kind, code, attempts",
    [
        ({"refuse": 1}, "refused", 2, 1),
        ({"colour": 1}, "refused", 2, 1),
        ({"fail": 1}, "failed", 1, 1),
        ({"missing": 1}, "missing", 3, 2),
        ({"unwritable": 1}, "unwritable", 4, 2),
        ({"lost": 9}, "transient", 5, 2),
        ({"kill": 9}, "transient", -9, 2),
        ({"out_of_memory": 1}, "memory", 5, 2),
    ],
)
def test_failures_are_recorded(row, scratch, tmp_path, monkeypatch, options, kind, code, attempts):
    monkeypatch.setattr(_row, "delay", lambda _: 0.0)
    outcome = run_row({**row, "options": options}, str(tmp_path / "out"), retries=1, scratch=str(scratch))
    record = json.loads((tmp_path / "out" / "_failed" / "shop.json").read_text())
    assert [record[k] for k in ("id", "kind", "exit_code", "attempts")] == ["shop", kind, code, attempts]
    assert record["message"] == outcome["message"] != ""
    assert not (tmp_path / "out" / "shop").exists()
    assert run_row(row, str(tmp_path / "out"), scratch=str(scratch))["state"] == "done"
    assert not (tmp_path / "out" / "_failed").exists()


def test_lost_device_is_tried_again(row, scratch, tmp_path, monkeypatch):
    monkeypatch.setattr(_row, "delay", lambda _: 0.0)
    row["options"] = {"lost": 2}
    outcome = run_row(row, str(tmp_path / "out"), retries=2, scratch=str(scratch))
    assert (outcome["state"], outcome["attempts"]) == ("done", 3)


def test_memory_is_tried_smaller(row, scratch, tmp_path):
    row["options"] = {"max_size": 640, "out_of_memory": 500}
    place = str(tmp_path / "out")
    outcome = run_row(row, place, scratch=str(scratch))
    assert (outcome["state"], outcome["attempts"]) == ("done", 2)
    success = whole(place)
    assert success["smaller_max_size"] == 448
    assert success["options"] == row["options"]
    os.utime(row["input"] + "/0.jpg", (1, 1))
    assert run_row(row, place, scratch=str(scratch))["state"] == "skipped"


def test_timeout_ends_the_group(row, scratch, tmp_path, processes):
    row["options"] = {"hang": 1, "child": 1}
    outcome = run_row(row, str(tmp_path / "out"), timeout=1.0, scratch=str(scratch))
    assert outcome["kind"] == "timeout" and "after 1 s" in outcome["message"]
    assert processes() == [] and os.listdir(scratch) == []


WORKER = (
    "import sys, json; from splatvk.batch import run_row\n"
    "run_row(json.loads(sys.argv[1]), sys.argv[2], scratch=sys.argv[3])"
)
THREADED = (
    "import sys, json, threading, time; from splatvk.batch import run_row\n"
    "row, out, scratch = json.loads(sys.argv[1]), *sys.argv[2:4]\n"
    "threading.Thread(target=run_row, args=(row, out), kwargs={'scratch': scratch}).start()"
)


KILLED_BEFORE_COMMIT = (
    "import os; from splatvk.batch import _row; _row.commit = lambda *_: os.kill(os.getpid(), 9); " + WORKER
)


def test_kill_before_success_is_mended(row, scratch, tmp_path, processes):
    out = str(tmp_path / "out")
    argv = [sys.executable, "-c", KILLED_BEFORE_COMMIT, json.dumps(row), out, str(scratch)]
    assert subprocess.run(argv).returncode == -signal.SIGKILL
    eventually(lambda: processes() == [] and os.listdir(scratch) == [])
    store = open_store(out)
    (abandoned,) = store.names("shop")
    assert run_row(row, out, scratch=str(scratch))["state"] == "done"
    # Its lease is not over: it may be an upload under way.
    assert _results.sweep(store, "shop", store.names("shop")) == 0
    assert abandoned in store.names("shop")
    later = time.time() + 3600 + _results.GRACE + 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_results.time, "time", lambda: later)
        assert _results.sweep(store, "shop", store.names("shop")) == 1
    whole(out)


@pytest.mark.parametrize("code", [WORKER, THREADED])
def test_killed_worker_leaves_nothing(row, scratch, tmp_path, processes, code):
    row["options"] = {"hang": 1, "child": 1}
    out = str(tmp_path / "out")
    worker = subprocess.Popen([sys.executable, "-c", code, json.dumps(row), out, str(scratch)])
    # Worker, keeper, program and its child.
    eventually(lambda: len(processes()) == 4, 30)
    worker.kill()
    worker.wait()
    eventually(lambda: processes() == [])
    eventually(lambda: os.listdir(scratch) == [])


def test_killed_keeper_ends_program(scratch, tmp_path, processes):
    with pytest.raises(KeeperGone), Keeper(str(scratch)) as keeper:

        def kill():
            eventually(lambda: len(processes()) == 2)
            os.kill(keeper._process.pid, signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        keeper.run(["sleep", "1000"], "")
    killer.join()
    eventually(lambda: processes() == [])
    assert os.listdir(scratch) == []


def test_keeper_killed_at_start_leaves_nothing(scratch, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(KeeperGone), Keeper(str(scratch)):
        pass
    assert os.listdir(scratch) == []


def test_abandoned_scratch_is_cleared(scratch):
    scratch.mkdir()
    dead, live = scratch / "splatvk-batch-dead", scratch / "other"
    dead.mkdir(), live.mkdir()
    (dead / ".lock").touch()
    with Keeper(str(scratch)) as first, Keeper(str(scratch)) as second:
        assert first.scratch.exists() and second.scratch.exists()
        assert not dead.exists() and live.exists()


def test_two_workers_have_one_winner(place, row, scratch):
    row["options"] = {"seconds": 0.5}
    outcomes = []
    workers = [
        threading.Thread(target=lambda: outcomes.append(run_row(row, place, scratch=str(scratch))))
        for _ in range(3)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert sorted(o["state"] for o in outcomes) == ["done", "skipped", "skipped"], outcomes
    whole(place)


def test_late_upload_gives_up(row, scratch, tmp_path):
    outcome = run_row(row, str(tmp_path / "out"), lease=-1.0, scratch=str(scratch))
    assert outcome["kind"] == "transient" and "lease" in outcome["message"]
    assert not (tmp_path / "out" / "shop").exists()


def test_put_whose_answer_was_lost_counts(tmp_path):
    store = open_store(str(tmp_path))
    attempt = _results.new_attempt("k" * 64, 60)
    store.put("shop/_SUCCESS.json", json.dumps({"key": "k" * 64, "at": attempt.name}).encode())
    assert _results.commit(store, "shop", attempt, {"key": "k" * 64, "at": attempt.name})


def test_abandoned_attempts_are_swept(place, tmp_path):
    store = open_store(place)
    late, named = (_results.new_attempt("a" * 64, -500).name for _ in range(2))
    live = _results.new_attempt("a" * 64, 60).name
    for name in (late, named, live):
        store.put(f"shop/{name}/x", b"1")
    store.put("shop/_SUCCESS.json", json.dumps({"at": named}).encode())
    assert _results.sweep(store, "shop", store.names("shop")) == 1
    assert store.names("shop") == sorted(["_SUCCESS.json", named, live])


def test_broken_result_is_replaced(row, scratch, tmp_path):
    (tmp_path / "out" / "shop").mkdir(parents=True)
    (tmp_path / "out" / "shop" / "_SUCCESS.json").write_text("{")
    assert run_row(row, str(tmp_path / "out"), scratch=str(scratch))["state"] == "done"
    whole(str(tmp_path / "out"))


def test_missing_program_is_told(row, scratch, tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATVK_PROGRAM", "/nowhere/splatvk")
    outcome = run_row(row, str(tmp_path / "out"), scratch=str(scratch))
    assert (outcome["kind"], outcome["exit_code"]) == ("missing", 3), outcome
    assert not Path("/nowhere").exists()
